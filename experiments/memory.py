"""Recording of N events -> peak memory of `firenet reconstruct`, for N and N / 10.

Question: does memory grow with the length of a recording? 100 million events at 640x480 as HDF5
and 20 million as zipped text are reconstructed into a folder, each in a process of its own, and
so is a tenth of each; in turn and three times, as the peak of one file moves by tens of MB from run
to run. Expected: medians equal within 5 %, everything below 2 GB.

    python experiments/memory.py            about 25 minutes on two cores, 4 GB of disk
"""

import argparse
import statistics
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import h5py
import jax
import numpy as np
from harness import save
from tqdm import tqdm

from firenet_jax.checkpoint import save_weights
from firenet_jax.network import Weights, initial_params

HEIGHT, WIDTH = 480, 640

RUN = """
import sys
from pathlib import Path
from firenet_jax import cli
recording, output, weights = sys.argv[1:]
sys.argv[1:] = ["reconstruct", recording, "-o", output, "--weights", weights]
code = cli.program()
# Of this program alone: getrusage's peak is at least that of the process that started it.
lines = Path("/proc/self/status").read_text().splitlines()
print("peak", next(line.split()[1] for line in lines if line.startswith("VmHWM")))
sys.exit(code)
"""


def columns(count: int):
    """Random events in time order, a million at a time."""
    rng = np.random.default_rng(0)
    for start in range(0, count, 1_000_000):
        n = min(1_000_000, count - start)
        t = (start + np.arange(n)) / 10e6  # ten million events a second
        x, y = rng.integers(0, WIDTH, n), rng.integers(0, HEIGHT, n)
        yield start, t, x, y, rng.integers(0, 2, n)


def write_hdf5(path: Path, count: int) -> None:
    with h5py.File(path, "w") as file:
        file.attrs["sensor_resolution"] = [HEIGHT, WIDTH]
        kinds = {"ts": "f8", "xs": "i2", "ys": "i2", "ps": "?"}
        sets = [file.create_dataset(f"events/{n}", (count,), d) for n, d in kinds.items()]
        for start, *values in tqdm(columns(count), total=count // 1_000_000, desc=path.name):
            for dataset, column in zip(sets, values, strict=True):
                dataset[start : start + len(column)] = column


def write_text(path: Path, count: int) -> None:
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("events.txt", "w", force_zip64=True) as file,
    ):
        file.write(f"{WIDTH} {HEIGHT}\n".encode())
        for _, *values in tqdm(columns(count), total=count // 1_000_000, desc=path.name):
            rows = zip(*(column.tolist() for column in values), strict=True)
            file.write("".join(f"{t:.7f} {x} {y} {p}\n" for t, x, y, p in rows).encode())


def peak(recording: Path, folder: Path) -> float:
    """Megabytes of memory that the reconstruction of this file needs at most."""
    output, weights = folder / "out", folder / "weights.npz"
    save_weights(weights, Weights(initial_params(jax.random.key(0)), True))
    command = [sys.executable, "-c", RUN, str(recording), str(output), str(weights)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    print(done.stdout.splitlines()[0])
    return int(done.stdout.split()[-1]) / 1024


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hdf5", type=int, default=100_000_000, help="events")
    parser.add_argument("--text", type=int, default=20_000_000, help="events")
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
    kinds = {"HDF5": (".h5", write_hdf5, options.hdf5), "text": (".zip", write_text, options.text)}
    peaks = {}
    with tempfile.TemporaryDirectory() as folder:
        for kind, (suffix, write, count) in kinds.items():
            for events in (count, count // 10):
                write(Path(folder) / f"{events}{suffix}", events)
                peaks[kind, events] = []
        for _ in range(options.runs):
            for kind, events in peaks:
                with tempfile.TemporaryDirectory() as scratch:
                    recording = Path(folder) / f"{events}{kinds[kind][0]}"
                    peaks[kind, events].append(peak(recording, Path(scratch)))
    rows = [
        {"kind": kind, "events": events, "peaks_mb": each, "peak_mb": statistics.median(each)}
        for (kind, events), each in peaks.items()
    ]
    print(f"{'kind':12} {'events':>12} {'peak MB':>9}   of each run")
    for row in rows:
        each = ", ".join(f"{value:.0f}" for value in row["peaks_mb"])
        print(f"{row['kind']:12} {row['events']:12,} {row['peak_mb']:9.0f}   {each}")
    ratios = [rows[i]["peak_mb"] / rows[i + 1]["peak_mb"] for i in (0, 2)]
    print("whole against a tenth: " + ", ".join(f"{ratio:.3f}" for ratio in ratios))
    save("memory", {"rows": rows, "ratios": ratios})


if __name__ == "__main__":
    main()
