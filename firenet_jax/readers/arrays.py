"""Arrays of one's own -> Recording: the same checks as a file's, and each says which array."""

import math
from numbers import Real
from pathlib import Path

import numpy as np

from firenet_jax.errors import RecordingError
from firenet_jax.events import Events, Recording, Rows, checked
from firenet_jax.readers import in_chunks, to_events
from firenet_jax.readers.text import NAMES

UNITS = {"s": None, "ms": 1000, "us": 1}  # microseconds; seconds are read as floating numbers


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

    t: in order; unit "s", "ms" or "us", where nothing is said microseconds if they are whole
    numbers and seconds if they are floating ones. x: column, 0 to width - 1; y: row. p: bool, 0 and
    1, or -1 and 1, true for brighter. name: what errors call it.
    The arrays are not copied: leave them as they are while the recording is used.
    Raises RecordingError, a ValueError, for columns that do not fit together and for the first
    event that cannot be.
    """
    if x is None and y is None and p is None:
        t, x, y, p = _fields(name, np.asarray(t))
    elif x is None or y is None or p is None:
        raise RecordingError(f"{name}: pass t, x, y and p, or one structured array")
    columns = dict(zip("txyp", map(np.asarray, (t, x, y, p)), strict=True))
    if len({column.shape for column in columns.values()}) != 1 or columns["t"].ndim != 1:
        shapes = ", ".join(f"{key} {column.shape}" for key, column in columns.items())
        raise RecordingError(f"{name}: columns of one length are expected, not {shapes}")
    if not columns["t"].size:
        raise RecordingError(f"{name}: holds no events")
    for side, value in (("width", width), ("height", height)):
        if not (isinstance(value, Real) and 1 <= value < math.inf and int(value) == value):
            raise RecordingError(f"{name}: {side} is {value}, but is a number of pixels")
    if unit not in (None, *UNITS):
        raise RecordingError(f"{name}: unit is {unit!r}, expected one of {', '.join(UNITS)}")
    columns["t"] = _in_unit(name, columns["t"], unit)
    width, height, path = int(width), int(height), Path(name)

    def read(rows: slice) -> Events | Rows:
        return to_events(path, rows.start, *(column[rows] for column in columns.values()))

    def events():
        return checked(in_chunks(read, len(columns["t"])), path, height, width)

    for _ in events():  # now, where the arrays come from, and not in the middle of a loop
        pass
    return Recording(path, "arrays", height, width, events, len(columns["t"]))


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
    if unit is None:
        return t
    if unit == "s":
        return t.astype(np.float64)
    return t * UNITS[unit] if t.dtype.kind in "iu" else t * (UNITS[unit] / 1e6)
