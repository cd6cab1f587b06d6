"""Arrays in memory -> Recording, with the same checks as a file; errors name the array."""

from numbers import Real
from pathlib import Path

import numpy as np

from firenet_jax.errors import RecordingError
from firenet_jax.events import MAX_TIME, Recording, checked
from firenet_jax.readers import in_chunks
from firenet_jax.readers.text import NAMES, warn_of_coarse_times, warn_of_whole_seconds
from firenet_jax.settings import LONGEST_SIDE, MOST_PIXELS

UNITS = {"s": None, "ms": 1000, "us": 1}  # in microseconds; seconds become float64


def recording(
    t,
    x=None,
    y=None,
    p=None,
    *,
    width: int,
    height: int,
    unit: str | None = None,
    name: str = "arrays",
) -> Recording:
    """Columns t, x, y, p of N events, or one structured array with fields of these names.

    t: (N,), in order. unit: "s", "ms" or "us"; None: integers are microseconds, floating numbers
    seconds. x: (N,) column, 0 to width - 1; y: (N,) row, 0 to height - 1. p: (N,) bool, 0 and 1, or
    -1 and 1, true for brighter. width, height: of the sensor, pixels. name: what errors call it.
    The arrays are not copied: do not change them while the recording is used.
    Raises RecordingError, a ValueError, for columns that do not fit together, for a width, height
    or unit that cannot be, and for the first invalid event.
    """
    if x is None and y is None and p is None:
        t, x, y, p = _fields(name, np.asarray(t))
    elif x is None or y is None or p is None:
        raise RecordingError(f"{name}: pass t, x, y and p, or one structured array")
    if any(map(np.ma.is_masked, (t, x, y, p))):
        raise RecordingError(f"{name}: some entries are masked: pass the others alone")
    columns = dict(zip("txyp", map(np.asarray, (t, x, y, p)), strict=True))
    if len({column.shape for column in columns.values()}) != 1 or columns["t"].ndim != 1:
        shapes = ", ".join(f"{key} {column.shape}" for key, column in columns.items())
        raise RecordingError(f"{name}: columns of one length are expected, not {shapes}")
    if not columns["t"].size:
        raise RecordingError(f"{name}: holds no events")
    for side, value in (("width", width), ("height", height)):
        if not (isinstance(value, Real) and 1 <= value <= LONGEST_SIDE and int(value) == value):
            raise RecordingError(
                f"{name}: {side} is {value!r}, but is a number of pixels, at most {LONGEST_SIDE}"
            )
    if width * height > MOST_PIXELS:
        raise RecordingError(
            f"{name}: a sensor of {width}x{height} pixels, expected at most {MOST_PIXELS:,}"
        )
    if unit not in (None, *UNITS):
        raise RecordingError(f"{name}: unit is {unit!r}, expected one of {', '.join(UNITS)}")
    columns["t"] = _in_unit(name, columns["t"], unit)
    width, height, path, count = int(width), int(height), Path(name), columns["t"].size

    def events():
        chunks = in_chunks(path, lambda rows: (column[rows] for column in columns.values()), count)
        return checked(chunks, path, height, width)

    for _ in events():  # raises errors here, at the caller's arrays, not in a later loop
        pass
    return Recording(path, "arrays", height, width, events, count)


def _fields(name: str, array: np.ndarray) -> list[np.ndarray]:
    if array.dtype.names is None:
        raise RecordingError(
            f"{name}: t alone is {array.dtype} of shape {array.shape}: pass t, x, y and p, or one "
            "structured array with these fields"
        )
    found = {key: [n for n in names if n in array.dtype.names] for key, names in NAMES.items()}
    if not all(found.values()):
        raise RecordingError(
            f"{name}: has the fields {', '.join(array.dtype.names)}, expected t, x, y and p"
        )
    return [array[names[0]] for names in found.values()]


def _in_unit(name: str, t: np.ndarray, unit: str | None) -> np.ndarray:
    """Whole microseconds or floating seconds, as `to_events` takes them."""
    if t.dtype.kind not in "iuf":
        raise RecordingError(f"{name}: t is {t.dtype}, expected numbers")
    warn_of_coarse_times(Path(name), t, unit or "s")
    if unit is None:
        warn_of_whole_seconds(Path(name), t, 'pass unit="us"')
        return t
    if unit == "s":
        return t.astype(np.float64)
    if t.dtype.kind == "f":
        return t.astype(np.float64) * (UNITS[unit] / 1e6)
    if UNITS[unit] == 1:
        return t
    most = MAX_TIME // UNITS[unit]
    if int(t.min()) < -most or int(t.max()) > most:
        raise RecordingError(f"{name}: t is beyond {most} {unit}: is the unit right?")
    return t.astype(np.int64) * UNITS[unit]
