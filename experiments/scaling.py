"""Events -> pictures: what does it cost as the sensor, the chunk, the batch or the rate grows?

Question: where is the cost linear and where is it not, and up to which event rate is it real time?
Measured is the whole way from events on the host to 8-bit pictures on the host (`pack` and
`events_to_pictures`), without files, along four lines through one point: 240x180 pixels, 0.35
events per pixel and window, a chunk of 8 windows, one recording. Then, for each of the paper's
resolutions, windows and million events per second: a sensor that gives fewer can be watched as it
records. Once with the default 0.35 events per pixel in a window, once with 16 times as many.

Expected: linear in pixels, windows and batch; hardly dependent on the events until their cost
reaches the network's, and then in stairs, because lists of events are padded to a few sizes.

Last, a folder of eight recordings on 1, 2 and 4 devices, and in 2 processes of one device
(`firenet reconstruct`'s `run`, from text to PNG). These devices are virtual ones that share the
cores of the CPU, two of them here: there is nothing to win, and what is measured is how much the
dealing out costs.

    python experiments/scaling.py            9 minutes on two cores
    python experiments/scaling.py --quick    1 minute; times mean nothing, saves nothing

Writes results/scaling.json and .png (scaling_gpu on a GPU).
"""

import argparse
import os
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

import jax
import matplotlib
import numpy as np
from harness import RESULTS, interleaved, on_this_device, save

from firenet_jax.events import Events
from firenet_jax.network import Weights, initial_params
from firenet_jax.reconstruction import Network, events_to_pictures, initial_session
from firenet_jax.tensors import pack

matplotlib.use("Agg")
from matplotlib import pyplot as plt  # noqa: E402

POINT = {"width": 240, "height": 180, "windows": 8, "batch": 1, "events_per_pixel": 0.35}
SENSORS = [(60, 45), (120, 90), (240, 180), (346, 260), (480, 360), (640, 480), (960, 720)]
SENSORS += [(1280, 720), (1920, 1080)]
LINES = {
    "pixels": [{"width": width, "height": height} for width, height in SENSORS],
    "windows": [{"windows": windows} for windows in (1, 2, 4, 8, 16, 32, 64)],
    "batch": [{"batch": batch} for batch in (1, 2, 4, 8, 16, 32)],
    "events_per_pixel": [{"events_per_pixel": 0.35 * 4.0**power} for power in range(-3, 4)],
}
REST = 0.3  # seconds, in which the system takes back what the case before, maybe a large one, freed
RESOLUTIONS = [(240, 180), (346, 260), (640, 480), (1280, 720)]


def random_events(count: int, width: int, height: int, seed: int) -> Events:
    rng = np.random.default_rng(seed)
    return Events.of(
        np.sort(rng.integers(0, 50_000, count)),
        rng.integers(0, width, count),
        rng.integers(0, height, count),
        rng.random(count) < 0.5,
    )


def pipeline(*, width, height, windows, batch, events_per_pixel):
    """A function that reconstructs a chunk of events from a zero state and waits for it."""
    weights = Weights(initial_params(jax.random.key(0)), normalise=True)
    size = {"height": height, "width": width}
    count = round(events_per_pixel * width * height)
    # One window again and again: its pictures do not matter, and memory does not grow.
    rows = [[random_events(count, width, height, seed) for seed in range(batch)]] * windows
    session = initial_session(batch, **size, network=Network())
    valid = np.ones((windows, batch), bool)

    def run():
        return np.asarray(events_to_pictures(weights, session, pack(rows), valid, **size)[1])

    return run


def value(name: str, case: dict) -> float:
    """Where on its line a case is."""
    return case["width"] * case["height"] if name == "pixels" else case[name]


def line(name: str, changes: list[dict], runs: int) -> list[dict]:
    """Cost along a line, and its local exponent: 1 where it is linear, 0 where it is constant."""
    cases = [POINT | change for change in changes]
    methods = {value(name, case): pipeline(**case) for case in cases}
    rows, before = [], None
    print(f"\n{name:>18} {'ms':>10} {'min':>9} {'max':>9} {'exponent':>9} {'us / unit':>11}")
    for place, seconds in interleaved(methods, runs, REST).items():
        median = float(np.median(seconds))
        exponent = None
        if before is not None:
            exponent = float(np.log(median / before[1]) / np.log(place / before[0]))
        rows.append({"at": place, "median_ms": 1e3 * median, "min_ms": 1e3 * min(seconds),
                     "max_ms": 1e3 * max(seconds), "exponent": exponent})  # fmt: skip
        shown = "-" if exponent is None else f"{exponent:.2f}"
        print(f"{place:18.4g} {1e3 * median:10.2f} {1e3 * min(seconds):9.2f} "
              f"{1e3 * max(seconds):9.2f} {shown:>9} {1e6 * median / place:11.4g}")  # fmt: skip
        before = place, median
    return rows


def repeat(run, times: int) -> None:
    for _ in range(times):
        run()


def real_time(sizes: list[tuple[int, int]], runs: int) -> list[dict]:
    """Windows and million events a second, at the default number of events and 16 times that."""
    rates = POINT["events_per_pixel"], 16 * POINT["events_per_pixel"]
    rows = []
    print(f"\n{'sensor':>10} {'events / pixel':>15} {'windows/s':>10} {'Mev/s':>8}")
    for width, height in sizes:
        # Few windows, so that the larger case is a small one at 1280x720 too; and several chunks
        # in a row, as in a stream: after a rest, the first may pass before all threads are awake.
        point = POINT | {"width": width, "height": height, "windows": 4}
        cases = {rate: pipeline(**point | {"events_per_pixel": rate}) for rate in rates}
        methods = {rate: partial(repeat, run, 5) for rate, run in cases.items()}
        for rate, seconds in interleaved(methods, runs, REST).items():
            per_second = 5 * 4 / float(np.median(seconds))
            mev = 1e-6 * round(rate * width * height) * per_second
            sensor = f"{width}x{height}"
            print(f"{sensor:>10} {rate:15.2f} {per_second:10.1f} {mev:8.2f}")
            row = {"sensor": sensor, "events_per_pixel": rate}
            rows.append(row | {"windows_per_s": per_second, "mev_per_s": mev})
    return rows


DEVICES = """
import sys, time
from pathlib import Path
from firenet_jax.commands.reconstruct import Reconstruct, run
from firenet_jax.windows import Windows
folder, output, *where = sys.argv[1:]
processes, process = map(int, where) if where else [None] * 2
recordings = tuple(sorted(Path(folder).glob("*.txt")))
choices = dict(processes=processes, process=process, windows=Windows(events_per_pixel=0.35),
    warm_up=0)
run(Reconstruct(recordings, Path(output, "compiling"), **choices))
start = time.perf_counter()
# Elsewhere: of the same output, what this process has done is not done again.
run(Reconstruct(recordings, Path(output, "measured"), **choices))
print("seconds", time.perf_counter() - start)
"""


def on_devices(recordings: int, events: int) -> list[dict]:
    """A folder of recordings, dealt out to devices and to processes: seconds, once compiled."""
    rows = []
    print(f"\n{'devices':>10} {'processes':>10} {'s':>8} {'Mev/s':>8}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for number in range(recordings):
            made = random_events(events, POINT["width"], POINT["height"], number)
            columns = zip(made.t.tolist(), made.x, made.y, made.p.astype(int), strict=True)
            lines = "".join(f"{t / 1e6:.6f} {x} {y} {p}\n" for t, x, y, p in columns)
            size = f"{POINT['width']} {POINT['height']}\n"
            (folder / f"r{number}.txt").write_text(size + lines)
        for devices, processes in ((1, 1), (2, 1), (4, 1), (1, 2)):
            count = f"--xla_force_host_platform_device_count={devices}"
            flags = f"{os.environ.get('XLA_FLAGS', '')} {count}"
            environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
            command = [sys.executable, "-c", DEVICES, folder, folder / f"out{devices}{processes}"]
            started = [
                subprocess.Popen(
                    [*command, *(["2", str(process)] if processes > 1 else [])],
                    env=environment,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.DEVNULL,
                    text=True,
                )  # fmt: skip
                for process in range(processes)
            ]
            outputs = [process.communicate()[0] for process in started]
            seconds = max(float(output.split("seconds")[1]) for output in outputs)
            mev = 1e-6 * recordings * events / seconds
            print(f"{devices:10} {processes:10} {seconds:8.2f} {mev:8.2f}")
            row = {"devices": devices, "processes": processes}
            rows.append(row | {"seconds": seconds, "mev_per_s": mev})
    return rows


def plot(lines: dict[str, list[dict]], shared: list[dict], path: Path) -> None:
    """Cost along each line, and dashed what it would be if it were linear from its last point."""
    labels = {
        "pixels": "pixels",
        "windows": "windows in a chunk",
        "batch": "recordings side by side",
        "events_per_pixel": "events per pixel and window",
    }
    figure, axes = plt.subplots(1, 5, figsize=(18, 3.8), layout="constrained")
    for axis, (name, rows) in zip(axes[:4], lines.items(), strict=True):
        places, middle = (np.array([row[key] for row in rows]) for key in ("at", "median_ms"))
        spread = [middle - [r["min_ms"] for r in rows], [r["max_ms"] for r in rows] - middle]
        axis.errorbar(places, middle, spread, fmt="o-", capsize=3, label="measured")
        axis.plot(places, middle[-1] * places / places[-1], "k--", lw=1, label="linear")
        axis.set(xscale="log", yscale="log", xlabel=labels[name])
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("ms a chunk (median; least to greatest)")
    axes[0].legend()
    names = [f"{row['devices']} dev.\n{row['processes']} proc." for row in shared]
    axes[4].bar(names, [row["mev_per_s"] for row in shared])
    axes[4].set(ylabel="Mev/s, text to PNG", xlabel="a folder of recordings, dealt out")
    point = (
        "{width}x{height}, {windows} windows, batch {batch}, {events_per_pixel} events per pixel"
    )
    figure.suptitle("events to pictures around " + point.format(**POINT), fontsize=10)
    figure.savefig(path, dpi=80)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--quick", action="store_true", help="the low ends alone, save nothing")
    options = parser.parse_args()
    few = 2 if options.quick else None
    runs = 2 if options.quick else options.runs
    lines = {name: line(name, changes[:few], runs) for name, changes in LINES.items()}
    limits = real_time(RESOLUTIONS[: 1 if options.quick else None], runs)
    shared = on_devices(recordings=2, events=50_000) if options.quick else on_devices(8, 1_000_000)
    if not options.quick:
        name = on_this_device("scaling")
        results = {"point": POINT, "lines": lines, "real_time": limits, "devices": shared}
        save(name, {"runs": runs, **results})
        plot(lines, shared, RESULTS / f"{name}.png")


if __name__ == "__main__":
    main()
