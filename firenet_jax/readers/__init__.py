"""A path -> Recording: every format of the field as one stream of `Events` chunks.

A format is one module of this package with two functions:

    matches(path: Path) -> bool                    is it of this format? Cheap: name, first bytes
    read(path: Path) -> Source                     what the file holds, not checked yet

and its name in `FORMATS` below. A module raises RecordingError, in one sentence that names the file
and the place, for what it cannot read; checks that all formats share (order of time, coordinates)
are made here, by `events.checked`. Optional libraries are imported inside `read`, by `extra`. The
functions below `open_recording` are what the modules share.
"""

import importlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from firenet_jax.errors import RecordingError, logger
from firenet_jax.events import (
    MAX_TIME,
    Events,
    Frames,
    Recording,
    Rows,
    Triggers,
    checked,
    concatenate,
    event_number,
    no_triggers,
    until_damage,
)
from firenet_jax.settings import LONGEST_SIDE, MOST_PIXELS, sides
from firenet_jax.storage.files import check_no_pipe, check_readable, forbidden

# In the order in which they are asked.
FORMATS = (
    "ecd", "npy", "rosbag", "hdf5", "text", "ncaltech", "dat", "aedat4", "aedat3", "aedat2",
    "raw", "es",
)  # fmt: skip

SPIKE = 4  # times in a row that may be damaged without being taken for a turn of the clock
CHUNK = 1 << 18  # events a reader yields at once: 3 MB as Events


@dataclass(frozen=True)
class Source:
    """What a format module reads out of a file; `open_recording` turns it into a Recording."""

    format: str  # in words: "text", "HDF5 (event_cnn_minimal)"
    events: Callable[[], Iterator[Events | Rows]]  # unchecked, at most about CHUNK events each
    size: tuple[int, int] | None = None  # (height, width) where the file says it
    count: int | None = None  # number of events where the file says it
    frames: Frames | None = None
    grey: bool = False  # whether the file states that the sensor is monochrome
    triggers: Callable[[], Triggers | None] = no_triggers  # up to damage, which `events` raises
    place: Callable[[int], str] = event_number  # row, from 0 -> its name in the file: "line 7"


def open_recording(
    path: str | Path,
    sensor_size: tuple[int, int] | str | None = None,
    strict: bool = False,
    columns: str | None = None,
) -> Recording:
    """A recording of any known format -> Recording, opened but not read.

    sensor_size: (height, width) in pixels, or "WIDTHxHEIGHT". Without it the file's own is taken;
    where the file names none it is inferred by reading the events once, and a notice says so.
    A file is read up to where it is damaged, and single rows that cannot be events are left out,
    at most one in a thousand; a notice says what. strict: both raise RecordingError instead.
    columns: their order in a text or array that does not name them, such as "x,y,p,t".
    Raises RecordingError for a file that is missing, empty, damaged, of an unknown format or not
    permitted to the user, and, while the events are read, for more bad rows than that;
    SettingsError for another sensor_size.
    """
    path, sensor_size = Path(path), sides(sensor_size)
    source = _source(path, sensor_size, columns)
    rows_reported = 0

    def say(sentence: str, rows: int) -> None:
        """Logs a warning; that of a later pass over the file only if it has read further."""
        nonlocal rows_reported
        if rows > rows_reported:
            logger.warning("%s (refused if strict)", sentence)
        rows_reported = max(rows_reported, rows)

    def events(height: int | None, width: int | None) -> Iterator[Events]:
        return checked(source.events(), path, height, width, source.place, strict, say)

    size = sensor_size or _stated(path, source)
    height, width = size or _infer_size(path, events(None, None))
    return Recording(
        path=path,
        format=source.format,
        height=int(height),
        width=int(width),
        events=lambda: events(height, width),
        count=source.count,
        frames=source.frames,
        inferred=size is None,
        grey=source.grey,
        triggers=source.triggers,
    )


def is_recording(path: Path) -> bool:
    """Whether a format knows it, by its name or what a folder holds."""
    modules = (importlib.import_module(f"{__name__}.{name}") for name in FORMATS)
    return any(module.matches(path) for module in modules)


def check_exists(path: Path) -> None:
    """Raises RecordingError unless there is something of this name."""
    if not path.exists():
        raise RecordingError(f"{path}: there is no such file or folder: check the path")


def _source(path: Path, sensor_size: tuple[int, int] | None, columns: str | None) -> Source:
    """What the first format that knows the file reads from it."""
    check_exists(path)
    check_no_pipe(path, RecordingError)
    check_readable(path, RecordingError)
    if path.is_file() and path.stat().st_size == 0:
        raise RecordingError(f"{path}: the file is empty: copy or download it again")
    for name in FORMATS:
        module = importlib.import_module(f"{__name__}.{name}")
        if not module.matches(path):
            continue
        if columns is not None and name not in ("text", "npy"):
            raise RecordingError(
                f"{path}: its format sets the order of its columns: leave out --columns"
            )
        options: dict[str, Any] = {} if columns is None else {"columns": columns}
        if name == "aedat2" and sensor_size is not None:  # counts rows from the bottom
            options["size"] = sensor_size
        return module.read(path, **options)
    if {".pth", ".pt", ".ckpt"} & set(path.suffixes):  # "model.pth.tar" too, but no other archive
        raise RecordingError(f"{path}: no recording: a PyTorch checkpoint goes to --weights")
    inside = f" (if the folder holds some, name them: {path}/*)" if path.is_dir() else ""
    raise RecordingError(
        f"{path}: not a recording of a known format: expected text (.txt, .csv, .tsv) or zip, "
        "an ECD or EVREAL folder, HDF5, .npy, .npz, N-Caltech101 .bin, .dat, .raw, .aedat, "
        f".aedat4, .es, or a ROS bag{inside}"
    )


def _stated(path: Path, source: Source) -> tuple[int, int] | None:
    """The sensor's size as the file states it; None where it does not."""
    if source.size is None:
        return None
    height, width = map(int, source.size)
    if not (0 < height <= LONGEST_SIDE and 0 < width <= LONGEST_SIDE):
        raise RecordingError(
            f"{path}: states a sensor of {width}x{height} pixels, expected sides of 1 to "
            f"{LONGEST_SIDE}: pass the right --sensor-size WIDTHxHEIGHT"
        )
    _check_pixels(path, "states", height, width)
    return height, width


def _infer_size(path: Path, events: Iterator[Events]) -> tuple[int, int]:
    """(height, width) that holds all events, for a file that states no size. Reads all of it."""
    height = width = 0
    for chunk in until_damage(events):
        height = max(height, int(chunk.y.max()) + 1)
        width = max(width, int(chunk.x.max()) + 1)
    if not height:
        raise RecordingError(
            f"{path}: holds no events: check that it was recorded and copied whole"
        )
    _check_pixels(path, "has events that lie on", height, width)
    logger.warning(
        "%s names no sensor size; %dx%d inferred from its events; "
        "--sensor-size WIDTHxHEIGHT sets another and saves this pass over the file",
        path, width, height,
    )  # fmt: skip
    return height, width


def _check_pixels(path: Path, how: str, height: int, width: int) -> None:
    """Raises RecordingError for more pixels than any sensor has: all of them would be counted."""
    if height * width > MOST_PIXELS:
        raise RecordingError(
            f"{path}: {how} a sensor of {width}x{height} pixels, expected at most {MOST_PIXELS:,}: "
            "pass the right --sensor-size WIDTHxHEIGHT"
        )


def in_chunks(
    path: Path, columns: Callable[[slice], Iterable], count: int
) -> Iterator[Events | Rows]:
    """columns: rows -> t, x, y, p of these; count: of all rows. For formats with random access."""
    for start in range(0, count, CHUNK):
        yield to_events(path, start, *columns(slice(start, min(start + CHUNK, count))))


def to_chunks(
    path: Path, pieces: Iterable[Iterable], left: int = 0, whole: str = "an event"
) -> Iterator[Events | Rows]:
    """Pieces of t, x, y, p, one after the other -> a chunk each.

    left: bytes of one that is not `whole`, at the end; if there are any, RecordingError says so."""
    row = 0
    for columns in pieces:
        events = to_events(path, row, *columns)
        row += len(events)
        yield events
    if left:
        raise RecordingError(
            f"{path}: ends within {whole}: the file is cut off: copy or download it again"
        )


def joined(chunks: Iterable[Events | Rows], least: int = CHUNK // 4) -> Iterator[Events | Rows]:
    """Tiny chunks -> chunks of at least so many events, the last excepted: for formats made of
    packets. A RecordingError of `chunks` is raised after the events before it."""
    waiting, count, damage = [], 0, None
    try:
        for events in chunks:
            waiting.append(events)
            count += len(events)
            if count >= least:
                yield concatenate(waiting)
                waiting, count = [], 0
    except RecordingError as error:
        damage = error
    if count:
        yield concatenate(waiting)
    if damage is not None:
        raise damage


def all_triggers(pieces: Iterable[Iterable], *errors: type[BaseException]) -> Triggers | None:
    """Pieces of (times in microseconds, ids, polarity) -> all of them in time order, up to a
    RecordingError or one of `errors`; None if there are none."""
    columns = [[], [], []]
    try:
        for piece in pieces:
            for column, values in zip(columns, piece, strict=True):
                column.append(np.asarray(values, np.int64))
    except (RecordingError, *errors):
        pass  # reading the events raises it
    if not any(map(len, columns[0])):
        return None
    times, ids, polarity = map(np.concatenate, columns)
    order = np.argsort(times, kind="stable")
    return Triggers(times[order], ids[order], polarity[order] > 0)


def microseconds(seconds: np.ndarray) -> np.ndarray:
    """float64 seconds -> int64 microseconds, to the nearest one (exact up to 285 years)."""
    return np.rint(np.asarray(seconds, np.float64) * 1e6).astype(np.int64)


def frame_times(path: Path, times: np.ndarray) -> np.ndarray:
    """(F,) microseconds where integer, seconds where floating -> (F,) int64 microseconds.

    Raises RecordingError for a time that is not finite, or that no clock tells."""
    latest = MAX_TIME / 1e6 if times.dtype.kind == "f" else MAX_TIME
    wide = times.astype(np.float64) if times.dtype.kind == "f" else times
    right = (-latest < wide) & (wide < latest)  # not NaN
    if not right.all():
        frame = int(np.argmin(right))
        raise RecordingError(f"{path}, frame {frame + 1}: its time is {times[frame]}")
    return times.astype(np.int64) if times.dtype.kind in "iu" else microseconds(times)


def to_events(
    path: Path, row: int, t, x, y, p, *, place: Callable[[int], str] = event_number
) -> Events | Rows:
    """Columns (N,) as a file holds them -> Events, or Rows if some rows cannot be events: their
    error names the first of them, and `events.checked` decides whether to raise it.

    t: microseconds where integer, seconds where floating; p: bool, 0 and 1, or -1 and 1.
    row: the number of the first row in the recording, for `place`.
    Raises RecordingError for columns that are not numbers.
    """
    t, x, y, p = (np.asarray(column) for column in (t, x, y, p))
    if not t.size:
        return Events.empty()

    wrong: list[tuple[np.ndarray, np.ndarray, str, str]] = []  # mask, column, name, expected
    for name, column in (("the time", t), ("x", x), ("y", y), ("the polarity", p)):
        if column.dtype.kind not in "biuf":
            raise RecordingError(f"{path}: {name} is stored as {column.dtype}, expected numbers")
    latest = MAX_TIME / 1e6 if t.dtype.kind == "f" else MAX_TIME
    if not (-latest < t.min() and t.max() < latest):  # written so that NaN fails
        bad = ~((-latest < t) & (t < latest))
        wrong.append((bad, t, "the time", "expected seconds or whole microseconds"))
    for name, column in (("x", x), ("y", y)):
        if column.dtype.kind == "f" and (column != np.rint(column)).any():  # NaN differs, too
            bad = column != np.rint(column)
            wrong.append((bad, column, name, "expected a whole number of pixels"))
        if not (-LONGEST_SIDE <= column.min() and column.max() < LONGEST_SIDE):
            bad = ~((column >= -LONGEST_SIDE) & (column < LONGEST_SIDE))
            wrong.append((bad, column, name, f"expected a coordinate below {LONGEST_SIDE}"))
    if p.dtype.kind != "b":
        if p.dtype.kind == "f" or p.min() < -1 or p.max() > 1:
            bad = ~np.isin(p, (-1, 0, 1))
            if bad.any():
                wrong.append((bad, p, "the polarity", "expected 0 or 1 (or -1 or 1)"))
        p = p > 0
    if not wrong:
        return Events.of(microseconds(t) if t.dtype.kind == "f" else t, x, y, p)
    bad = np.logical_or.reduce([entry[0] for entry in wrong])
    first = int(np.argmax(bad))
    _, column, name, expected = next(entry for entry in wrong if entry[0][first])
    error = RecordingError(
        f"{path}, {place(row + first)}: {name} is {column[first]}, {expected}: "
        "the file is damaged or of another format"
    )
    t, x, y = (np.where(bad, 0, column) for column in (t, x, y))
    return Rows(Events.of(microseconds(t) if t.dtype.kind == "f" else t, x, y, p), bad, error)


def size_of(frames: Frames | None) -> tuple[int, int] | None:
    """(height, width) of the first frame; None without any. Where it cannot be read a warning says
    so: the events may still be."""
    try:
        return None if frames is None else frames.read(0).shape
    except RecordingError as error:
        logger.warning("%s", error)
        return None


def to_frame(picture: np.ndarray, path: Path) -> np.ndarray:
    """A picture as a file holds it, (H, W) or (H, W, 1, 3 or 4), uint8 or uint16 -> (H, W) uint8.

    Raises RecordingError for any other."""
    picture = np.asarray(picture)
    if picture.ndim == 3 and picture.shape[-1] == 1:
        picture = picture[..., 0]
    if picture.dtype == np.uint16:
        picture = (picture >> 8).astype(np.uint8)
    if picture.dtype == np.uint8 and picture.ndim == 3 and picture.shape[-1] in (3, 4):
        luma = picture[..., :3] @ np.array([0.299, 0.587, 0.114])  # ITU-R BT.601
        picture = np.rint(luma).astype(np.uint8)
    if picture.dtype != np.uint8 or picture.ndim != 2:
        raise RecordingError(
            f"{path}: a frame is {picture.dtype} of shape {picture.shape}, expected grey or RGB "
            "pictures of 8 bits"
        )
    return picture


def unwrap(counter: np.ndarray, bits: int, last: int) -> np.ndarray:
    """(N,) values of a counter of so many bits, which wraps around -> int64 that keeps growing.

    last: its unwrapped value just before. Falls of more than half its range are wraps, but for
    damage: where a few values rise or fall by as much and the next one goes on from before them.
    (That is not seen at the first and last of what is given.) Smaller falls are left as they are,
    for `events.checked` to judge.
    """
    counter = np.asarray(counter, np.int64)
    whole = 1 << bits
    before = np.append(last & (whole - 1), counter[:-1])
    steps = counter - before
    wraps = steps < -(whole // 2)
    late = steps > whole - (whole >> 8)  # from before the last wrap, if there was one
    places = np.flatnonzero(np.abs(steps) > whole // 2)
    places = places[places > 0]  # the first value may be any
    if len(places) > 1:
        away, again = places[:-1], places[1:]
        since = counter[again] - before[away]
        spike = (since >= 0) & (since < whole >> 8) & (again - away <= SPIKE)
        spike &= (steps[away] > 0) != (steps[again] > 0)
        high = spike & (steps[away] > 0)
        low = spike & (steps[away] < 0) & ~late[again]
        low[1:] &= ~high[:-1]  # what ends a spike begins no other
        wraps[away[low]] = wraps[again[high]] = False
        back = late & ((last >> bits) + np.cumsum(wraps) > 0)
        wraps[again[high]] = back[away[high]]  # what was taken back goes on
    turns = (last >> bits) + np.cumsum(wraps)
    return counter + ((turns - np.cumsum(late & (turns > 0))) << bits)


def extra(module: str, path: Path) -> ModuleType:
    """The optional library that this file needs, or a RecordingError that says how to get it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise RecordingError(
            f"{path}: reading this format needs {module.split('.')[0]}: "
            'in the source folder, pip install ".[formats]"'
        ) from error


@contextmanager
def reading(path: Path, *errors: type[BaseException]):
    """Turns `errors`, as libraries raise them for a damaged file, into a RecordingError that names
    it."""
    try:
        yield
    except RecordingError:
        raise
    except errors as error:
        if isinstance(error, PermissionError):
            raise RecordingError(forbidden(error.filename or path)) from error
        if isinstance(error, FileNotFoundError):
            raise RecordingError(
                f"{error.filename or path}: there is no such file: copy the "
                "recording or set that it belongs to whole"
            ) from error
        found = " ".join(str(error).split()) or type(error).__name__
        found = found if len(found) <= 200 else f"{found[:197]}..."  # zipfile quotes what it read
        raise RecordingError(
            f"{path}: cannot be read ({found}): the file is damaged, incomplete or of another "
            "format: copy or download it again"
        ) from error
