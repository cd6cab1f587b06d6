"""Events and pictures -> one HDF5 file, a sequence to train on; whole, or not there.

The layout is that of event_cnn_minimal (Stoffregen et al. 2020), which many programs read:

    events/{xs, ys, ts, ps}   int16, int16, float64 seconds, bool; compressed
    images/image%09d          (H, W) uint8; attributes timestamp, event_idx, size
    flow/flow%09d             (2, H, W) float32, x then y, pixels per second on that image's grid;
                              attributes timestamp, size
    attributes                sensor_resolution (H, W), num_events, num_pos, num_neg, t0, tk,
                              duration, num_imgs, num_flow, source, and settings (JSON)

Flow i is the exact displacement from one picture period before image i to image i, divided by that
period. Times the period it is a displacement d for backward warping: what is at x in image i was at
x - d(x) before.
"""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np

from firenet_jax.events import Events, concatenate
from firenet_jax.storage.disk import Disk
from firenet_jax.storage.files import discard, open_alone, partial_name, publish, writing

ROWS = 1 << 16  # events in a chunk of the file, and so many are written at once
GZIP = 4  # for 50 % more time than level 1: events take 10 % less room, flow 25 %


class Picture(NamedTuple):
    """What a camera beside the events sees."""

    time: int  # microseconds
    image: np.ndarray  # (H, W) uint8
    flow: np.ndarray | None  # (2, H, W) float32, pixels per second, x then y


def write_sequence(
    path: Path,
    events: Iterable[Events],
    pictures: Iterable[Picture],
    *,
    height: int,
    width: int,
    source: str = "unknown",
    settings: dict | None = None,
) -> int:
    """Time-ordered events and pictures -> one file; returns the number of events.

    Memory does not grow with either. source: a name of the layout's list ("esim", "unknown").
    settings: what the file was made from, kept in it as JSON.
    Raises OutputError where it cannot be written. What else goes wrong goes through, but leaves
    nothing under the final name, nor beside it.
    """
    beside = partial_name(path)
    try:
        with writing(path), open_alone(beside, path) as opened:
            try:
                disk = Disk(opened)
                with h5py.File(disk, "w") as file:
                    times, flows = _write_pictures(file, disk.during(pictures), height, width)
                    count, facts = _write_events(file, disk.during(events), times)
                    file.attrs.update(
                        sensor_resolution=np.array([height, width], np.int64),
                        num_imgs=len(times),
                        num_flow=flows,
                        source=source,
                        settings=json.dumps(settings or {}),
                        **facts,
                    )
                disk.check()
                publish(opened, beside, path)
            except BaseException:
                discard(opened, beside)
                raise
    finally:
        for stream in (events, pictures):
            getattr(stream, "close", bool)()  # of generators: ends their threads, closes files
    return count


def _write_pictures(file, pictures: Iterable[Picture], height, width) -> tuple[np.ndarray, int]:
    """Returns the pictures' times (n,) int64, and how many of them have flow."""
    times, flows = [], 0
    images = file.create_group("images")
    packed = {"compression": "gzip", "compression_opts": GZIP, "shuffle": True}
    for number, picture in enumerate(pictures):
        size = picture.image.shape
        if size != (height, width):
            raise ValueError(f"picture {number} is {size}, expected {(height, width)}")
        image = images.create_dataset(
            f"image{number:09d}", data=picture.image, chunks=size, **packed
        )
        image.attrs.update(timestamp=picture.time / 1e6, size=size, type="greyscale")
        times.append(picture.time)
        if picture.flow is not None:
            flow = file.require_group("flow").create_dataset(
                f"flow{number:09d}", data=picture.flow, chunks=picture.flow.shape, **packed
            )
            flow.attrs.update(timestamp=picture.time / 1e6, size=picture.flow.shape)
            flows += 1
    return np.array(times, np.int64), flows


def _write_events(file, events: Iterable[Events], times: np.ndarray) -> tuple[int, dict]:
    """Returns how many there are, and the file's attributes about them.

    An image's event_idx is the number of events before its time: the first that is not earlier.
    """
    columns = {
        name: file.create_dataset(
            f"events/{name}", (0,), dtype, maxshape=(None,), chunks=(ROWS,),
            compression="gzip", compression_opts=GZIP, shuffle=True,
        )
        for name, dtype in (("xs", np.int16), ("ys", np.int16), ("ts", np.float64), ("ps", bool))
    }  # fmt: skip
    count = on = 0
    first = last = None
    before = np.zeros(len(times), np.int64)
    for part in _gathered(events):
        rows = slice(count, count + len(part))
        values = {"xs": part.x, "ys": part.y, "ts": part.t / 1e6, "ps": part.p}
        for name, column in columns.items():
            column.resize((rows.stop,))
            column[rows] = values[name]
        before += np.searchsorted(part.t, times)
        count, on = rows.stop, on + int(part.p.sum())
        first, last = int(part.t[0]) if first is None else first, int(part.t[-1])
    for number, index in enumerate(before):  # `values()` would keep something of each open
        file[f"images/image{number:09d}"].attrs["event_idx"] = index
    start, end = (first or 0) / 1e6, (last or 0) / 1e6
    facts = {"num_events": count, "num_pos": on, "num_neg": count - on}
    return count, facts | {"t0": start, "tk": end, "duration": end - start}


def _gathered(chunks: Iterable[Events]) -> Iterator[Events]:
    """The same events in chunks of ROWS, so that each is compressed once; the last is shorter."""
    waiting, count = [], 0
    for chunk in chunks:
        waiting.append(chunk)
        count += len(chunk)
        if count >= ROWS:
            whole = concatenate(waiting)
            full = count - count % ROWS
            for start in range(0, full, ROWS):
                yield whole.select(slice(start, start + ROWS))
            waiting, count = [whole.select(slice(full, None))], count - full
    if count:
        yield concatenate(waiting)
