"""numpy's files -> Source: folders as EVREAL's and event_cnn_minimal's, or one .npy or .npz.

    EVREAL   event_cnn_minimal
    events_ts.npy   t.npy            (N,)       times, float64 seconds (integers: microseconds)
    events_xy.npy   xy.npy           (N, 2)     column, row
    events_p.npy    p.npy            (N,)       polarity, bool, 0 and 1, or -1 and 1
    images.npy      images.npy       (F, H, W)  frames, uint8; may be missing
    images_ts.npy   timestamps.npy   (F,)       their times, seconds
    metadata.json   metadata.json               {"sensor_resolution": [H, W]}; may be missing

    one file: rows (N, 4) of t, x, y, p; a structured array with fields of these names (or ts, xs,
    ys, ps and the like); or, of an .npz, four arrays of these names. Times as above; no size, but
    for numbers `width` and `height` in an .npz, as in the sample of a web page (`firenet export`).

The files are memory-mapped and sliced as the events are asked for; but an .npz is read whole.
"""

import json
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from firenet_jax.errors import RecordingError
from firenet_jax.events import Events, Frames, Rows
from firenet_jax.readers import Source, frame_times, in_chunks, reading, size_of, text, to_frame
from firenet_jax.storage.files import check_unpacking

# layout: files of times, coordinates, polarities, frame times
FILES = {
    "EVREAL": ("events_ts.npy", "events_xy.npy", "events_p.npy", "images_ts.npy"),
    "event_cnn_minimal": ("t.npy", "xy.npy", "p.npy", "timestamps.npy"),
}

SIDES = ("height", "width")
NPZ = 1 << 34  # bytes of all arrays in an .npz, at most
SAID = 6  # of the names of arrays in an .npz that holds no events


def matches(path: Path) -> bool:
    if path.is_file():
        return path.suffix.lower() in (".npy", ".npz")
    return path.is_dir() and _layout(path) is not None


def read(path: Path, columns: str | None = None) -> Source:
    """columns: the order of those of an (N, 4) array, such as "x,y,p,t"."""
    layout = _layout(path)
    if layout is None:
        order = None if columns is None else _order(path, columns)
        t, *_ = _of_one_file(path, order)
        text.warn_of_coarse_times(path, t)
        text.warn_of_whole_seconds(path, t, "store them as integers: a structured array, or .npz")
        return Source(
            f"numpy {path.suffix.lower()}",
            lambda: _rows(path, partial(_of_one_file, path, order)),
            _sides(path),
            len(t),
        )
    if columns is not None:
        raise RecordingError(
            f"{path}: has a file for each column, and so no order of columns: leave out --columns"
        )
    t, *_ = _columns(path, layout)
    text.warn_of_coarse_times(path, t)
    text.warn_of_whole_seconds(path, t, "store them as integers")
    frames = _frames(path, layout)
    size = _size(path)
    if size is None and frames is not None:
        size = size_of(frames)
    opened = partial(_columns, path, layout)
    return Source(f"{layout} folder", lambda: _rows(path, opened), size, len(t), frames)


def _layout(path: Path) -> str | None:
    return next((name for name, files in FILES.items() if (path / files[0]).is_file()), None)


def _mapped(path: Path) -> np.ndarray:
    with reading(path, Exception), path.open("rb") as file:  # a damaged header raises every kind
        if not file.read(6).startswith((np.lib.format.MAGIC_PREFIX, b"PK")):
            raise ValueError("it does not begin as an array of numpy does")  # who advises pickle
        array = np.load(path, mmap_mode="r", allow_pickle=False)
        if not isinstance(array, np.ndarray):
            array.close()
            raise ValueError("an .npz of another name")
        return array


def _columns(path: Path, layout: str) -> list[np.ndarray]:
    """-> t, x, y, p"""
    t, xy, p = (_mapped(path / name) for name in FILES[layout][:3])
    t, p = (column[:, 0] if column.shape[1:] == (1,) else column for column in (t, p))
    if not (t.shape == p.shape == xy.shape[:1] and xy.shape[1:] == (2,)):
        raise RecordingError(
            f"{path}: its columns do not fit together: t {t.shape}, xy {xy.shape}, p {p.shape}, "
            "expected (N,), (N, 2) and (N,)"
        )
    return [t, *xy.T, p]


def _order(path: Path, columns: str) -> list[str]:
    named = [word.strip().lower() for word in columns.split(",")]
    if sorted(named) != sorted("txyp"):
        raise RecordingError(f"{path}: columns are {columns!r}, expected an order such as x,y,p,t")
    return named


def _of_one_file(path: Path, order: list[str] | None) -> list[np.ndarray]:
    """-> t, x, y, p; order: of the columns of an (N, 4) array, if it was told."""
    if path.suffix.lower() == ".npz":
        with reading(path, Exception), zipfile.ZipFile(path) as archive:
            check_unpacking(path, archive, RecordingError)
            if sum(info.file_size for info in archive.infolist()) > NPZ:
                raise ValueError(f"claims more than {NPZ >> 30} GB")
        with reading(path, Exception), np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in _wanted(file.files)}
        if len(arrays) != 1:
            return _named(path, arrays, order)
        (array,) = arrays.values()
    else:
        array = _mapped(path)
    if array.dtype.names is not None and array.ndim == 1:
        return _named(path, {name: array[name] for name in array.dtype.names}, order)
    if array.ndim != 2 or array.shape[1] != 4 or array.dtype.kind not in "iuf":
        raise RecordingError(
            f"{path}: holds {array.dtype} of shape {array.shape}, expected rows (N, 4) of t, x, y, "
            "p or fields of these names"
        )
    if order is None and (other := text.other_order(array[: text.SNIFFED].T)):
        raise RecordingError(
            f"{path}: its columns look like {other}, not t,x,y,p: pass --columns {other}"
        )
    return [array[:, (order or list("txyp")).index(name)] for name in "txyp"]


def _sides(path: Path) -> tuple[int, int] | None:
    """(height, width) where an .npz names both."""
    if path.suffix.lower() != ".npz":
        return None
    with reading(path, Exception), np.load(path, allow_pickle=False) as file:
        if not set(SIDES) <= set(file.files):
            return None
        sides = {name: file[name] for name in SIDES}
    for name, side in sides.items():
        if side.size != 1 or side.dtype.kind not in "iu":
            raise RecordingError(
                f"{path}: {name} is {side.dtype} of shape {side.shape}, expected a number of pixels"
            )
    height, width = (int(side.item()) for side in sides.values())
    return height, width


def _wanted(names: list[str]) -> list[str]:
    """Of the arrays in an .npz those that events are read from; others may hold anything."""
    columns = [[name for name in known if name in names] for known in text.NAMES.values()]
    if all(columns):
        return [found[0] for found in columns]
    return ["events"] if "events" in names else [name for name in names if name not in SIDES]


def _named(path: Path, arrays: dict[str, np.ndarray], order: list[str] | None) -> list[np.ndarray]:
    named = [[arrays[n] for n in names if n in arrays] for names in text.NAMES.values()]
    if not all(named):
        names = [repr(name) for name in arrays]
        holds = ", ".join(names[:SAID] + ["..."] * (len(names) > SAID)) or "nothing"
        weights = ": weights go to --weights" if "head/kernel" in arrays else ""
        raise RecordingError(f"{path}: holds {holds}, expected t, x, y and p{weights}")
    if order is not None:
        raise RecordingError(
            f"{path}: its columns have names, and so no order: leave out --columns"
        )
    found = [columns[0] for columns in named]
    if len({column.shape for column in found}) != 1 or found[0].ndim != 1:
        shapes = ", ".join(str(column.shape) for column in found)
        raise RecordingError(f"{path}: columns of one length are expected, not {shapes}")
    return found


def _rows(path: Path, opened: Callable[[], list[np.ndarray]]) -> Iterator[Events | Rows]:
    columns = opened()
    yield from in_chunks(path, lambda rows: (column[rows] for column in columns), len(columns[0]))


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
