"""The exported network in onnxruntime, beside ours: how long does a window take?

    python experiments/onnxruntime_step.py      (2 minutes on two cores)

Built-in weights, raw event tensors, normalisation inside, one recording, state carried along. Ours
is `fj.reconstruct` over as many windows in one scan, with machine code and by XLA alone; the file
for JAX and the ONNX file are called once a window, as whoever loads them would. onnxruntime
has as many threads as there are processors that this process may use.
Writes results/onnxruntime_step.json, with the largest difference of images.
"""

import argparse
import os

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
from harness import interleaved, save, table

import firenet_jax as fj
from firenet_jax.export.onnx_model import onnx_model
from firenet_jax.export.stablehlo import stablehlo
from firenet_jax.settings import parse_size


def tensors_like_events(windows: int, height: int, width: int) -> np.ndarray:
    """(T, 1, H, W, 5) float32: votes in a fifth of the entries."""
    numbers = np.random.default_rng(0)
    votes = numbers.normal(size=(windows, 1, height, width, 5))
    return np.where(numbers.random(votes.shape) < 0.2, votes, 0).astype(np.float32)


def measure(size: str, windows: int, runs: int) -> dict:
    height, width = parse_size(size)
    weights = fj.load_weights()
    tensors = tensors_like_events(windows, height, width)
    on_device = jnp.asarray(tensors)
    state = fj.initial_state(1, height, width)

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = len(os.sched_getaffinity(0))
    session = onnxruntime.InferenceSession(
        onnx_model(weights).SerializeToString(), options, providers=["CPUExecutionProvider"]
    )
    first = [np.ascontiguousarray(np.moveaxis(tensor, -1, -3)) for tensor in tensors]
    exported = jax.jit(jax.export.deserialize(bytearray(stablehlo(weights))).call)

    def ours(machine_code: bool):
        _, images = fj.reconstruct(weights, state, on_device, machine_code=machine_code)
        return np.asarray(images)

    def by_onnxruntime():
        g1 = g2 = np.zeros((1, 16, height, width), np.float32)
        images = []
        for events in first:
            image, g1, g2 = session.run(None, {"events": events, "g1": g1, "g2": g2})
            images.append(image[:, 0])
        return np.stack(images)

    def by_stablehlo():
        g1, g2, images = *state, []
        for events in on_device:
            image, g1, g2 = exported(events, g1, g2)
            images.append(image)
        return np.stack(images)

    methods = {
        "firenet_jax": lambda: ours(True),
        "firenet_jax, XLA's step": lambda: ours(False),
        "ONNX, onnxruntime": by_onnxruntime,
        "StableHLO, jax": by_stablehlo,
    }
    expected = ours(False)
    differences = {name: float(np.abs(run() - expected).max()) for name, run in methods.items()}
    print(f"\n{size}, {windows} windows a run (times below are of a run)")
    rows = table(interleaved(methods, runs), "firenet_jax")
    for row in rows:
        row["ms_per_window"] = row["median_ms"] / windows
        row["largest_difference"] = differences[row["method"]]
        print(f"{row['method']:34} {row['ms_per_window']:8.1f} ms a window, "
              f"images differ by {row['largest_difference']:.1e}")  # fmt: skip
    return {"size": size, "windows": windows, "rows": rows}


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--sizes", nargs="+", default=["240x180", "346x260", "640x480"])
    parser.add_argument("--windows", type=int, default=8)
    parser.add_argument("--runs", type=int, default=7)
    arguments = parser.parse_args()
    sizes = [measure(size, arguments.windows, arguments.runs) for size in arguments.sizes]
    threads = len(os.sched_getaffinity(0))
    save("onnxruntime_step", {"onnxruntime": onnxruntime.__version__, "threads": threads,
                              "sizes": sizes})  # fmt: skip


if __name__ == "__main__":
    main()
