"""Table 2 of the paper: multiply-adds and time of one forward pass, E2VID and FireNet.

Question: is FireNet as much cheaper than E2VID as the paper says, and is it here? Multiply-adds,
each counted once, come from three places: by hand (`multiply_adds`), from the convolutions of the
traced program, and half of the FLOPs that XLA counts in the compiled one (activations included,
padding's zeros not; but on a CPU the zeros of `convolution.side_by_side`, a tenth of FireNet's:
chance, that its column comes near the paper's). E2VID has two kinds of decoder: transposed
convolutions as published, and bilinear upsampling before a convolution; the paper's count is that
of the latter for both. Times are one window, batch 1, float32, on a CPU and on a GPU where there is
one.

Expected: the paper's counts are 9 % (FireNet) and 5.5 % (E2VID) above ours; FireNet takes a sixth
to an eighth of the time of E2VID on a CPU (in the paper a quarter to a half).

    python experiments/table2_computational_cost.py            5 minutes on two cores
    python experiments/table2_computational_cost.py --quick    1 minute; times mean nothing, saves
                                                               nothing

Writes results/table2_computational_cost.json and .png (table2_computational_cost_gpu on a GPU).
"""

import argparse
from functools import partial
from pathlib import Path

import jax
import matplotlib
import numpy as np
from harness import RESULTS, interleaved, on_this_device, save, table
from jax.extend.core import jaxprs_in_params

from firenet_jax import network
from firenet_jax.evaluation.baselines import e2vid
from firenet_jax.native import by_xla_alone

matplotlib.use("Agg")
from matplotlib import pyplot as plt  # noqa: E402

# GPU ms, CPU ms, GFLOP: Titan Xp, i7-6900K, multiply-adds counted once.
PAPER = {
    "E2VID": {
        "240x180": (5.52, 84.98, 21.2),
        "346x260": (10.17, 183.79, 44.5),
        "640x480": (30.88, 687.10, 147.2),
        "1280x720": (93.34, 2235.60, 441.7),
    },
    "FireNet": {
        "240x180": (1.89, 22.86, 1.8),
        "346x260": (3.22, 40.96, 3.7),
        "640x480": (10.15, 264.39, 12.6),
        "1280x720": (31.01, 1039.49, 37.8),
    },
}


def networks() -> dict[str, tuple]:
    """Name -> (params, step, initial state, multiply-adds), of all networks of the table."""
    made = {}
    for name, transposed in (("E2VID transposed", True), ("E2VID upsampling", False)):
        settings = e2vid.Settings(transposed)
        make = partial(e2vid.initial_params, settings=settings)
        parts = (e2vid.step, e2vid.initial_state, e2vid.multiply_adds)
        made[name] = make, *(partial(part, settings=settings) for part in parts)
    firenet = (network.initial_params, network.step, network.initial_state, network.multiply_adds)
    return made | {"FireNet": firenet}


def traced_multiply_adds(jaxpr) -> int:
    """Those of all convolutions of a traced program; zeros put in between are not multiplied.

    Where platforms differ (`cond`), those of the last branch: what a CPU multiplies in vain to be
    quicker (`convolution.side_by_side`) is no work of the network.
    """
    total = 0
    for equation in jaxpr.eqns:
        inner = list(jaxprs_in_params(equation.params))
        chosen = inner[-1:] if equation.primitive.name == "cond" else inner
        total += sum(traced_multiply_adds(called) for called in chosen)
        if equation.primitive.name == "conv_general_dilated":
            kernel, image = equation.invars[1].aval.shape, equation.outvars[0].aval.shape
            zeros = int(np.prod(equation.params["lhs_dilation"]))
            total += int(np.prod(kernel)) * int(np.prod(image[:3])) // zeros
    return total


def measure(resolution: str, runs: int) -> list[dict]:
    """A row for each network at this size: counts, and times on all kinds of devices here."""
    width, height = map(int, resolution.split("x"))
    devices = {"cpu": jax.devices("cpu")[0], jax.default_backend(): jax.devices()[0]}
    rows, methods = [], {}
    for name, (make, step, initial_state, by_hand) in networks().items():
        params, state = make(jax.random.key(0)), initial_state(1, height, width)
        inputs = params, state, jax.random.normal(jax.random.key(1), (1, height, width, 5))
        row = {"network": name, "resolution": resolution, "by_hand": by_hand(height, width)}
        with by_xla_alone():  # machine code's products are not in the program
            row["traced"] = traced_multiply_adds(jax.make_jaxpr(step)(*inputs).jaxpr)
        assert row["by_hand"] == row["traced"], row
        for kind, device in devices.items():
            there = jax.device_put(inputs, device)
            program = jax.jit(step).lower(*there).compile()
            if kind == jax.default_backend():
                row["compiled"] = program.cost_analysis()["flops"] / 2
            methods[name, kind] = lambda program=program, there=there: jax.block_until_ready(
                program(*there)
            )
        rows.append(row)
    print(f"\n{resolution}")
    named = {f"{name}, {kind}": method for (name, kind), method in methods.items()}
    times = {row["method"]: row for row in table(interleaved(named, runs), "FireNet, cpu")}
    for row in rows:
        gpu_ms, cpu_ms, giga = PAPER[row["network"].split()[0]][resolution]
        row["paper"] = {"gpu_ms": gpu_ms, "cpu_ms": cpu_ms, "giga_multiply_adds": giga}
        row["times"] = {kind: times[f"{row['network']}, {kind}"] for kind in devices}
    return rows


def show(rows: list[dict]) -> None:
    print(f"\n{'':28} {'multiply-adds, 10^9':^34}   {'CPU ms':^16}   {'GPU ms':^16}")
    print(f"{'':28} {'by hand':>8} {'traced':>8} {'compiled':>8} {'paper':>7}   "
          f"{'here':>8} {'paper':>7}   {'here':>8} {'paper':>7}")  # fmt: skip
    for row in rows:
        counts = [1e-9 * row[kind] for kind in ("by_hand", "traced", "compiled")]
        paper, times = row["paper"], row["times"]
        gpu = [f"{t['median_ms']:.2f}" for kind, t in times.items() if kind != "cpu"] or ["-"]
        print(
            f"{row['resolution']:10} {row['network']:17} "
            + " ".join(f"{count:8.2f}" for count in counts)
            + f" {paper['giga_multiply_adds']:7.1f}   {times['cpu']['median_ms']:8.1f} "
            f"{paper['cpu_ms']:7.1f}   {gpu[0]:>8} {paper['gpu_ms']:7.2f}"
        )


def plot(rows: list[dict], path: Path) -> None:
    """Against the number of pixels: multiply-adds, and milliseconds; the paper's dashed."""
    figure, (counts, times) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    colours = {"E2VID transposed": "tab:red", "E2VID upsampling": "tab:orange"}
    colours |= {"FireNet": "tab:blue"}
    resolutions = list(dict.fromkeys(row["resolution"] for row in rows))
    pixels = [1e-3 * np.prod([int(n) for n in text.split("x")]) for text in resolutions]
    for name, colour in colours.items():
        own = [row for row in rows if row["network"] == name]
        counts.plot(pixels, [1e-9 * r["by_hand"] for r in own], "o-", color=colour, label=name)
        for kind, marker in zip(own[0]["times"], ("o-", "s-"), strict=False):
            values = [r["times"][kind]["median_ms"] for r in own]
            times.plot(pixels, values, marker, color=colour, label=f"{name}, {kind} here")
    for name, colour in (("E2VID", "tab:red"), ("FireNet", "tab:blue")):
        gpu, cpu, giga = zip(*(PAPER[name][text] for text in resolutions), strict=True)
        counts.plot(pixels, giga, "--", color=colour, lw=1, label=f"{name}, paper")
        times.plot(pixels, cpu, "--", color=colour, lw=1, label=f"{name}, paper's 8-core CPU")
        times.plot(pixels, gpu, ":", color=colour, lw=1, label=f"{name}, paper's Titan Xp")
    counts.set(title="multiply-adds of one image", ylabel="$10^9$")
    times.set(title="one forward pass", ylabel="ms")
    for axis in (counts, times):
        axis.set(xscale="log", yscale="log", xticks=pixels)
        axis.set_xticklabels(resolutions)
        axis.minorticks_off()
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
    figure.savefig(path, dpi=90)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--quick", action="store_true", help="the smallest size, save nothing")
    options = parser.parse_args()
    resolutions = list(PAPER["FireNet"])[: 1 if options.quick else None]
    runs = 2 if options.quick else options.runs
    rows = [row for resolution in resolutions for row in measure(resolution, runs)]
    show(rows)
    if not options.quick:
        name = on_this_device("table2_computational_cost")
        save(name, {"runs": runs, "rows": rows})
        plot(rows, RESULTS / f"{name}.png")


if __name__ == "__main__":
    main()
