"""Events on the host -> finished event tensor: our segment_sum against PyTorch and numpy.

Question: how long do 1,000,000 events take from int64/int16 columns on the host to a 640x480x5
tensor? Two PyTorch versions: rpg_e2vid's steps (events as one float64 array, masks, two
index_add_), and the leanest index_add_ we could write. Expected: ours at least 4 times faster than
the former and 20 times faster than numpy.add.at, in the median of 20 runs. That is measured several
times, because it moves by a third on a machine that is shared.

    python experiments/voxelisation.py            3 minutes; needs torch
"""

import argparse
import statistics
from functools import partial

import numpy as np
import torch
from harness import interleaved, save, table
from pytorch_firenet import voxelise_lean, voxelise_original

from firenet_jax.events import Events
from firenet_jax.tensors import pack, voxelise

HEIGHT, WIDTH, BINS = 480, 640, 5


def ours(events: Events):
    packed = pack([[events]])
    return voxelise(packed, height=HEIGHT, width=WIDTH).block_until_ready()


def numpy_add_at(events: Events):
    t = events.t
    times = (BINS - 1) * (t - t[0]) / float(t[-1] - t[0])
    lower = times.astype(np.int64)
    share = times - lower
    polarity = np.where(events.p, 1.0, -1.0)
    place = events.x + events.y.astype(np.int64) * WIDTH + lower * (WIDTH * HEIGHT)
    grid = np.zeros(BINS * HEIGHT * WIDTH, np.float32)
    np.add.at(grid, place, polarity * (1 - share))
    inside = lower + 1 < BINS
    np.add.at(grid, place[inside] + WIDTH * HEIGHT, (polarity * share)[inside])
    return grid.reshape(BINS, HEIGHT, WIDTH)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--events", type=int, default=1_000_000)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=7)
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    events = Events.of(
        10**15 + np.sort(rng.integers(0, 50_000, options.events)),
        rng.integers(0, WIDTH, options.events),
        rng.integers(0, HEIGHT, options.events),
        rng.random(options.events) < 0.5,
    )
    methods = {
        "ours": ours,
        "torch index_add_ (original steps)": partial(voxelise_original, height=HEIGHT, width=WIDTH),
        "torch index_add_ (leanest)": partial(voxelise_lean, height=HEIGHT, width=WIDTH),
        "numpy.add.at": numpy_add_at,
    }
    expected = np.moveaxis(numpy_add_at(events), 0, -1)
    for name, method in methods.items():
        tensor = np.asarray(method(events))
        tensor = tensor[0, 0] if name == "ours" else np.moveaxis(tensor, 0, -1)
        print(f"{name:34} largest difference from numpy {np.abs(tensor - expected).max():.1e}")
    runs = {name: partial(method, events) for name, method in methods.items()}
    repeats = []
    for _ in range(options.repeats):
        seconds = interleaved(runs, options.runs)
        repeats.append(table(seconds, "ours"))
    ratios = {
        name: sorted(row["ratio"] for rows in repeats for row in rows if row["method"] == name)
        for name in methods
    }
    for name, each in ratios.items():
        middle, least, most = statistics.median(each), each[0], each[-1]
        print(f"{name:34} {middle:.1f} times ours ({least:.1f} to {most:.1f})")
    results = {"events": options.events, "runs": options.runs, "torch": torch.__version__}
    save("voxelisation", {**results, "ratios": ratios, "repeats": repeats})


if __name__ == "__main__":
    main()
