"""A file of events -> a folder of PNG: how much faster than PyTorch and pandas, and what limits it?

Five million random events at 240x180 as zipped text, 0.35 events per pixel in a window: 331
pictures, the same in both programs to a grey level (asserted), by the same PNG encoder at the same
level. The other program is what the field's are, in one thread of Python: pandas reads chunks,
numpy cuts them, PyTorch makes tensors (`voxelise_original`) and images (eager, NCHW, separate
gates). Ours is `firenet reconstruct`'s `run`. Both are warm: compilation is beside, as "first".

Then our three stages, each alone: reading (parse, cut, pack), device (events to pictures, from
chunks in memory), writing. Overlapped they would take as long as the longest of them, if none
needed what another needs; one after another the sum.

    python experiments/file_to_pictures.py          3 minutes on two cores; needs torch and pandas

Writes results/file_to_pictures.json.
"""

import argparse
import tempfile
import time
import zipfile
from pathlib import Path

import jax
import numpy as np
import pandas
import torch
from harness import interleaved, on_this_device, save, table
from PIL import Image
from pytorch_firenet import FireNet, normalise, to_picture, voxelise_original

from firenet_jax.checkpoint import load_weights
from firenet_jax.commands.jobs import Job, Outcome, Way, in_chunks
from firenet_jax.commands.reconstruct import Reconstruct, run
from firenet_jax.events import Events
from firenet_jax.pictures import Display
from firenet_jax.readers import open_recording
from firenet_jax.reconstruction import events_to_pictures, initial_session
from firenet_jax.storage.video import PNG_LEVEL, FolderWriter
from firenet_jax.windows import Windows

WIDTH, HEIGHT = 240, 180
COUNT = round(0.35 * WIDTH * HEIGHT)
WINDOWS = Windows(events=COUNT)
FIXED = Display(range="fixed")  # as the other side has it


def write_text(path: Path, events: int) -> None:
    rng = np.random.default_rng(0)
    times = np.sort(rng.uniform(0, events / 1e6, events))
    columns = [times, rng.integers(0, WIDTH, events), rng.integers(0, HEIGHT, events)]
    columns.append(rng.integers(0, 2, events))
    rows = zip(*(column.tolist() for column in columns), strict=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        lines = "".join(f"{t:.6f} {x} {y} {p}\n" for t, x, y, p in rows)
        archive.writestr("events.txt", f"{WIDTH} {HEIGHT}\n{lines}")


def by_pytorch(recording: Path, output: Path) -> None:
    """The steps of the field's programs, one after the other."""
    output.mkdir()
    model = FireNet(load_weights().params, separate_gates=True).eval()
    state = [torch.zeros(1, 16, HEIGHT, WIDTH)] * 2
    chunks = pandas.read_csv(
        recording, sep=" ", header=None, skiprows=1, names=list("txyp"), chunksize=COUNT,
        dtype={"t": np.float64, "x": np.int16, "y": np.int16, "p": np.int16}, engine="c",
    )  # fmt: skip
    with torch.inference_mode(), (output / "timestamps.txt").open("w") as stamps:
        for number, chunk in enumerate(chunks):
            times = np.round(1e6 * chunk.t.to_numpy()).astype(np.int64)
            polarity = chunk.p.to_numpy().astype(bool)
            events = Events.of(times, chunk.x.to_numpy(), chunk.y.to_numpy(), polarity)
            tensor = normalise(voxelise_original(events, HEIGHT, WIDTH)[None])
            *state, image = model(*state, tensor)
            picture = to_picture(image)[0].numpy()
            name = output / f"frame_{number:010d}.png"
            Image.fromarray(picture).save(name, compress_level=PNG_LEVEL)
            stamps.write(f"{times[-1] / 1e6:.6f}\n")


def by_us(recording: Path, output: Path) -> None:
    run(Reconstruct((recording,), output, windows=WINDOWS, display=FIXED, warm_up=0))


def stages(recording: Path, folder: Path) -> dict:
    """Functions that do one stage each, the others' work done before."""
    weights = jax.device_put(load_weights())

    def reading() -> list:
        opened, output = open_recording(recording), folder / "none"
        writers = {}
        job = Job(opened, output, {}, WINDOWS, None, opened.events, lambda: FolderWriter(output))
        chunks = list(in_chunks([job], Way(), 1, 1, Outcome(), writers))
        for writer in writers.values():  # which was opened and locked its folder
            writer.abandon()
        return chunks

    chunks = reading()

    def device() -> list:
        session, pictures = initial_session(1, HEIGHT, WIDTH, Way().network), []
        for chunk in chunks:
            session, shown = events_to_pictures(
                weights, session, chunk.events, chunk.valid, height=HEIGHT, width=WIDTH,
                settings=FIXED,
            )  # fmt: skip
            pictures.append(np.asarray(shown)[:, 0])
        return pictures

    pictures = np.concatenate(device())[: sum(len(chunk.parts[0].times) for chunk in chunks)]
    outputs = (folder / f"written{number}" for number in range(1000))

    def writing() -> None:
        writer = FolderWriter(next(outputs))
        for number, picture in enumerate(pictures):
            writer.write(picture, number)
        writer.finish()

    return {"reading": reading, "device": device, "writing": writing}


def check(ours: Path, theirs: Path) -> None:
    """The same pictures, but for rounding."""
    names = sorted(path.name for path in ours.glob("*.png"))
    assert names == sorted(path.name for path in theirs.glob("*.png"))
    for name in names:
        pictures = [np.asarray(Image.open(folder / name)).astype(int) for folder in (ours, theirs)]
        assert np.abs(pictures[0] - pictures[1]).max() <= 1, name


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--events", type=int, default=5_000_000)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recording = folder / "events.zip"
        write_text(recording, options.events)
        outputs = (folder / f"out{number}" for number in range(1000))
        first = {}
        for method in (by_us, by_pytorch):
            start = time.perf_counter()
            method(recording, folder / method.__name__)
            first[method.__name__] = time.perf_counter() - start
        check(folder / "by_us", folder / "by_pytorch")
        methods = {
            "firenet_jax": lambda: by_us(recording, next(outputs)),
            "pandas, PyTorch": lambda: by_pytorch(recording, next(outputs)),
            **stages(recording, folder),
        }
        # Threads of the method before spin for a while.
        rows = table(interleaved(methods, options.runs, rest=0.5), "firenet_jax")
    medians = {row["method"]: row["median_ms"] for row in rows}
    alone = [medians[name] for name in ("reading", "device", "writing")]
    result = {
        "events": options.events,
        "first_s": first,
        "rows": rows,
        "times_faster": medians["pandas, PyTorch"] / medians["firenet_jax"],
        "of_longest_stage": medians["firenet_jax"] / max(alone),
        "of_sum_of_stages": medians["firenet_jax"] / sum(alone),
        "mev_per_s": 1e-3 * options.events / medians["firenet_jax"],
    }
    print(f"first run, s: {first['by_us']:.1f} and {first['by_pytorch']:.1f}")
    for key in ("times_faster", "of_longest_stage", "of_sum_of_stages", "mev_per_s"):
        print(f"{key:20} {result[key]:.2f}")
    save(on_this_device("file_to_pictures"), result)


if __name__ == "__main__":
    main()
