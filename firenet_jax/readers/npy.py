"""Folder of .npy files -> Source: the layouts of EVREAL and of event_cnn_minimal.

    EVREAL   event_cnn_minimal
    events_ts.npy   t.npy            (N,)       times, float64 seconds (integers: microseconds)
    events_xy.npy   xy.npy           (N, 2)     column, row
    events_p.npy    p.npy            (N,)       polarity, bool, 0 and 1, or -1 and 1
    images.npy      images.npy       (F, H, W)  frames, uint8; may be missing
    images_ts.npy   timestamps.npy   (F,)       their times, seconds
    metadata.json   metadata.json               {"sensor_resolution": [H, W]}; may be missing

The files are mapped, not read, and sliced as the events are asked for.
"""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from firenet_jax.events import Events, Frames, RecordingError
from firenet_jax.readers import Source, frame_times, in_chunks, reading, to_events, to_frame

# layout: files of times, coordinates, polarities, frame times
FILES = {
    "EVREAL": ("events_ts.npy", "events_xy.npy", "events_p.npy", "images_ts.npy"),
    "event_cnn_minimal": ("t.npy", "xy.npy", "p.npy", "timestamps.npy"),
}


def matches(path: Path) -> bool:
    return path.is_dir() and _layout(path) is not None


def read(path: Path) -> Source:
    layout = _layout(path)
    t, _, _ = _columns(path, layout)
    frames = _frames(path, layout)
    size = _size(path)
    if size is None and frames is not None:
        size = frames.read(0).shape
    return Source(f"{layout} folder", lambda: _events(path, layout), size, len(t), frames)


def _layout(path: Path) -> str | None:
    return next((name for name, files in FILES.items() if (path / files[0]).is_file()), None)


def _mapped(path: Path) -> np.ndarray:
    with reading(path, Exception):  # a damaged header raises every kind
        return np.load(path, mmap_mode="r", allow_pickle=False)


def _columns(path: Path, layout: str) -> list[np.ndarray]:
    t, xy, p = (_mapped(path / name) for name in FILES[layout][:3])
    t, p = (column[:, 0] if column.ndim == 2 else column for column in (t, p))
    if not (t.shape == p.shape == xy.shape[:1] and xy.shape[1:] == (2,)):
        raise RecordingError(
            f"{path}: its columns do not fit together: t {t.shape}, xy {xy.shape}, p {p.shape}, "
            "expected (N,), (N, 2) and (N,)"
        )
    return [t, xy, p]


def _events(path: Path, layout: str) -> Iterator[Events]:
    t, xy, p = _columns(path, layout)

    def read(rows: slice) -> Events:
        return to_events(path, rows.start, t[rows], xy[rows, 0], xy[rows, 1], p[rows])

    yield from in_chunks(read, len(t))


def _frames(path: Path, layout: str) -> Frames | None:
    files = path / "images.npy", path / FILES[layout][3]
    if not all(file.is_file() for file in files):
        return None
    images, times = _mapped(files[0]), np.array(_mapped(files[1])).reshape(-1)
    if not images.ndim or times.dtype.kind not in "iuf":
        raise RecordingError(
            f"{files[0]} has the shape {images.shape}, {files[1]} is {times.dtype}: expected "
            "pictures and numbers"
        )
    count = len(images)
    if len(times) != count:
        raise RecordingError(f"{path}: has {count} frames in images.npy, but {len(times)} times")
    times = frame_times(files[1], times)
    return Frames(times, lambda i: to_frame(_mapped(files[0])[i], files[0])) if count else None


def _size(path: Path) -> tuple[int, int] | None:
    path = path / "metadata.json"
    if not path.is_file():
        return None
    with reading(path, Exception):
        resolution = json.loads(path.read_bytes()).get("sensor_resolution")
        return None if resolution is None else (int(resolution[0]), int(resolution[1]))
