"""HDF5 -> Source: the layouts of event_cnn_minimal, DSEC, MVSEC, v2e and Metavision.

    event_cnn_minimal   events/{xs, ys, ts, ps}; images/image%09d with attribute `timestamp`;
                        root attribute `sensor_resolution` (H, W)
    DSEC                events/{x, y, t, p}, t in microseconds after `t_offset`; compressed (blosc)
    MVSEC               davis/left/events, rows x, y, t, p with p -1 or 1;
                        davis/left/{image_raw, image_raw_ts}
    v2e                 events, rows t, x, y, p, t in microseconds
    Metavision          CD/events with fields x, y, p, t, in microseconds; its compression needs
                        Metavision's own plugin; root attribute `geometry` "1280x720"

Times are microseconds where they are integers, seconds where they are floating. The file is opened
anew by every pass over the events and for every frame, and read in slices.
"""

import math
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from firenet_jax.errors import RecordingError
from firenet_jax.events import Events, Frames, Rows
from firenet_jax.readers import (
    Source,
    extra,
    frame_times,
    in_chunks,
    reading,
    size_of,
    text,
    to_frame,
)
from firenet_jax.settings import MOST_PIXELS
from firenet_jax.storage.files import check_readable

SIGNATURE = b"\x89HDF\r\n\x1a\n"
COLUMNS = {"event_cnn_minimal": ("ts", "xs", "ys", "ps"), "DSEC": ("t", "x", "y", "p")}
MVSEC = "davis/left"
METAVISION = "CD/events"
ECF = 36559  # number of Metavision's compression
# Bytes of unpacked chunks that are kept of a data set: where all of a column is one chunk, it would
# else be unpacked anew for each slice.
CACHE = 1 << 26


def matches(path: Path) -> bool:
    if not path.is_file():
        return False
    if path.suffix.lower() in (".h5", ".hdf5", ".hdf"):
        return True
    with open(path, "rb") as file:
        return file.read(8) == SIGNATURE


def read(path: Path) -> Source:
    with opened(path) as file:
        layout = _layout(path, file)
        rows, count = _columns(path, file, layout)
        ends = slice(text.SNIFFED), slice(max(count - 1, 0), count)
        t = np.concatenate([np.asarray(next(iter(rows(part)))) for part in ends])
        text.warn_of_coarse_times(path, t)
        text.warn_of_whole_seconds(path, t, "store them as integers")
        frames = _frames(path, file, layout)
        size = file.attrs.get("sensor_resolution")
        if size is not None:
            size = _resolution(path, size)
        elif match := re.fullmatch(r"(\d{1,9})x(\d{1,9})", _text(file.attrs.get("geometry", ""))):
            size = int(match[2]), int(match[1])
    if size is None and frames is not None:
        size = size_of(frames)
    grey = layout == "Metavision"  # Prophesee's sensors are monochrome
    return Source(f"HDF5 ({layout})", lambda: _events(path, layout), size, count, frames, grey)


def _text(value: Any) -> str:
    return value.decode("latin-1") if isinstance(value, bytes) else str(value)


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """The file, as h5py opens it; typed Any, for a name may hold a group or a data set.

    Any exception while it is open becomes a RecordingError: damaged bytes, and groups or text where
    numbers are expected, raise every kind.
    """
    check_readable(path, RecordingError)
    with reading(path, Exception), h5py.File(path, "r", rdcc_nbytes=CACHE) as file:
        yield file


def _layout(path: Path, file: Any) -> str:
    events = file.get("events")
    if isinstance(events, h5py.Group):
        for layout, names in COLUMNS.items():
            if all(isinstance(events.get(name), h5py.Dataset) for name in names):
                return layout
    if f"{MVSEC}/events" in file:
        return "MVSEC"
    if isinstance(events, h5py.Dataset):
        return "v2e"
    if METAVISION in file:
        return "Metavision"
    found = list(map(str, file))  # names that are not UTF-8 are bytes
    if isinstance(events, h5py.Group):
        found += [f"events/{name}" for name in events]
    raise RecordingError(
        f"{path}: holds {', '.join(found) or 'nothing'}, expected the columns events/xs, ys, ts, "
        "ps (event_cnn_minimal), events/x, y, t, p (DSEC), davis/left/events (MVSEC), events (v2e) "
        "or CD/events (Metavision)"
    )


def _columns(path: Path, file: Any, layout: str) -> tuple[Callable[[slice], Iterable], int]:
    """(rows -> t, x, y, p, number of rows)"""
    if layout in ("MVSEC", "v2e"):
        events = file[f"{MVSEC}/events" if layout == "MVSEC" else "events"]
        check_stored(path, events)
        if events.ndim != 2 or events.shape[1] != 4:
            raise RecordingError(
                f"{path}: {events.name.strip('/')} has the shape {events.shape}, expected (N, 4)"
            )
        order = [2, 0, 1, 3] if layout == "MVSEC" else [0, 1, 2, 3]
        return lambda rows: events[rows].T[order], len(events)
    if layout == "Metavision":
        events = file[METAVISION]
        check_stored(path, events)
        if not set("txyp") <= set(events.dtype.names or ()) or events.ndim != 1:
            raise RecordingError(
                f"{path}: {METAVISION} is {events.dtype} of shape {events.shape}, expected rows "
                "with fields x, y, p and t"
            )
        return lambda rows: map(events[rows].__getitem__, "txyp"), len(events)

    columns = [file["events"][name] for name in COLUMNS[layout]]
    for column in columns:
        check_stored(path, column)
    if len({column.shape for column in columns}) != 1 or columns[0].ndim != 1:
        found = ", ".join(f"{column.name} {column.shape}" for column in columns)
        raise RecordingError(f"{path}: its columns differ in length: {found}")
    start = _offset(path, file) if layout == "DSEC" and "t_offset" in file else 0

    def read(rows: slice) -> Iterable:
        t, *others = (column[rows] for column in columns)
        if start and t.dtype.kind in "iu":
            t = t.astype(np.int64) + start
        return t, *others

    return read, len(columns[0])


def _offset(path: Path, file: Any) -> int:
    """Microseconds, which DSEC's times leave out."""
    offset = file["t_offset"]
    if offset.size != 1:
        raise RecordingError(f"{path}: t_offset has the shape {offset.shape}, expected one number")
    return int(np.ravel(offset[()])[0])


def check_stored(path: Path, data: Any):
    """Refuses data that lies in other files: whoever made this file would choose which are read;
    and compressions that HDF5 has no plugin for. Imports hdf5plugin, which registers further ones,
    where h5py alone lacks one."""
    # a link to another file, and a virtual data set, would do the same
    if data.external or data.is_virtual or Path(data.file.filename) != path:
        raise RecordingError(
            f"{path}: {data.name} is stored in other files: use a file that holds all its data"
        )
    created = data.id.get_create_plist()
    for number in (created.get_filter(i)[0] for i in range(created.get_nfilters())):
        if not h5py.h5z.filter_avail(number):
            extra("hdf5plugin", path)
            if not h5py.h5z.filter_avail(number):
                name = "Metavision's ECF" if number == ECF else f"filter {number}"
                raise RecordingError(
                    f"{path}: {data.name} is compressed by {name}, whose HDF5 plugin is not found: "
                    "install it and name its folder in HDF5_PLUGIN_PATH, or convert the file"
                )


def _events(path: Path, layout: str) -> Iterator[Events | Rows]:
    with opened(path) as file:
        yield from in_chunks(path, *_columns(path, file, layout))


def _resolution(path: Path, size: Any) -> tuple[int, int]:
    try:
        height, width = np.ravel(size)[:2]
        return int(height), int(width)
    except (TypeError, ValueError, OverflowError):  # text, one number alone, nan, infinity
        raise RecordingError(
            f"{path}: sensor_resolution is {size}, expected height and width in pixels: "
            "the file is damaged or of another format"
        ) from None


def _frames(path: Path, file: Any, layout: str) -> Frames | None:
    if layout == "MVSEC":
        return _mvsec_frames(path, file[MVSEC])
    if layout != "event_cnn_minimal" or "images" not in file:
        return None
    images = file["images"]
    if not isinstance(images, h5py.Group):
        raise RecordingError(
            f"{path}: images has the shape {images.shape}, expected a group of pictures"
        )
    names = in_order(images)
    if not names:
        return None
    times = np.array([images[name].attrs["timestamp"] for name in names])
    if times.size != len(names):
        raise RecordingError(
            f"{path}: pictures have timestamps of shape {times.shape[1:]}, not one"
        )
    times = times.reshape(-1)
    return Frames(
        frame_times(path, times),
        lambda i: _frame(path, f"images/{names[i]}", ...),
        lambda i: _flow(path, f"flow/{names[i].replace('image', 'flow')}"),
    )


def in_order(names: Iterable[str]) -> list[str]:
    """Names of pictures -> in their order, but by the numbers at their ends, which some programs
    write without zeros: image2 comes before image10."""

    def parts(name: str) -> tuple[str, int, str]:
        before = name.rstrip("0123456789")
        return before, int("0" + name[len(before) :]), name

    return sorted(names, key=parts)


def _mvsec_frames(path: Path, left: Any) -> Frames | None:
    pictures, times = left.get("image_raw"), left.get("image_raw_ts")
    for name, array in {"image_raw": pictures, "image_raw_ts": times}.items():
        if isinstance(array, h5py.Group):
            raise RecordingError(f"{path}: {MVSEC}/{name} is a group, expected an array")
    if pictures is None or pictures.shape[:1] == (0,):
        return None
    if times is None:
        raise RecordingError(
            f"{path}: {MVSEC}/image_raw_ts is missing: expected the time of each picture"
        )
    if pictures.ndim < 3 or times.shape != pictures.shape[:1]:
        raise RecordingError(
            f"{path}: {MVSEC}/image_raw has the shape {pictures.shape}, image_raw_ts "
            f"{times.shape}: expected pictures and the time of each"
        )
    return Frames(frame_times(path, times[:]), lambda i: _frame(path, f"{MVSEC}/image_raw", i))


def _frame(path: Path, name: str, index) -> np.ndarray:
    with opened(path) as file:
        pictures = file[name]
        check_stored(path, pictures)
        shape = pictures.shape if index is ... else pictures.shape[1:]
        if math.prod(shape) > 4 * MOST_PIXELS:  # of 4 channels; no file need hold what it claims
            raise ValueError(f"{name} claims a picture of shape {shape}")
        return to_frame(pictures[index], path)


def _flow(path: Path, name: str) -> np.ndarray | None:
    with opened(path) as file:
        if name not in file:
            return None
        velocity = file[name]
        check_stored(path, velocity)
        size = (2, *file["images"][name.removeprefix("flow/").replace("flow", "image")].shape[:2])
        if velocity.shape != size:
            raise RecordingError(f"{path}, {name}: has the shape {velocity.shape}, expected {size}")
        return velocity[()]
