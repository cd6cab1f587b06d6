"""Columns -> Events: what an event is, and the checks that every recording passes at the door.

An event (t, x, y, p) says that the pixel in column x and row y became brighter (p true, "ON") or
darker (p false, "OFF") by one contrast threshold at time t. Times are int64 microseconds: float32
seconds lose microseconds after 16 s. A recording is a stream of `Events` chunks in time order.
"""

import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

logger = logging.getLogger("firenet_jax")

LATEST = 2**53  # microseconds, 285 years: float64 seconds lose microseconds beyond
REACH = 2**15  # pixels of a sensor's side at most: coordinates are int16


class RecordingError(ValueError):
    """A recording cannot be used; the message is one sentence: file, place, found, what to do."""

    before: "Events | None" = None
    """Of the chunk in which the damage lies, the events before it, not checked."""


@dataclass(frozen=True, eq=False, slots=True)
class Events:
    """N events in time order, one array per column."""

    t: np.ndarray  # (N,) int64, microseconds
    x: np.ndarray  # (N,) int16, column, 0 at the left
    y: np.ndarray  # (N,) int16, row, 0 at the top
    p: np.ndarray  # (N,) bool, True: brighter

    def __len__(self) -> int:
        return self.t.shape[0]

    def select(self, index) -> "Events":
        """The events that a slice, a mask or an index array picks."""
        return Events(self.t[index], self.x[index], self.y[index], self.p[index])

    @classmethod
    def of(cls, t, x, y, p) -> "Events":
        """Columns of whole numbers -> Events with the dtypes above; p: bool, 0 and 1, or -1 and 1.
        Raises ValueError for times that are no whole microseconds."""
        t, p = np.asarray(t), np.asarray(p)
        if t.dtype.kind == "f" and (t != np.rint(t)).any():
            raise ValueError("times must be whole microseconds: round 1e6 times seconds")
        return cls(
            t.astype(np.int64, copy=False),
            np.asarray(x, np.int16),
            np.asarray(y, np.int16),
            p if p.dtype == bool else p > 0,
        )

    @classmethod
    def empty(cls) -> "Events":
        return cls.of([], [], [], [])


def concatenate(chunks: list[Events]) -> Events:
    """Chunks -> one chunk; without copying when there is only one."""
    if len(chunks) == 1:
        return chunks[0]
    columns = ([getattr(chunk, name) for chunk in chunks] for name in "txyp")
    return Events(*map(np.concatenate, columns))


class Frames(NamedTuple):
    """The pictures that some cameras take beside the events."""

    times: np.ndarray  # (F,) int64, microseconds, on the clock of the events
    read: Callable[[int], np.ndarray]  # i -> (H, W) uint8


@dataclass(frozen=True)
class Recording:
    """A file or folder of events, opened but not read: memory does not grow with its length."""

    path: Path
    format: str  # in words, for people: "ECD folder"
    height: int
    width: int
    events: Callable[[], Iterator[Events]]  # every call starts from the first event
    count: int | None = None  # number of events, where the file says it
    frames: Frames | None = None

    @property
    def pixels(self) -> int:
        return self.height * self.width


def event_number(row: int) -> str:
    """The place of an event, counted from 1, in a file that has no lines."""
    return f"event {row + 1}"


def checked(
    chunks: Iterable[Events],
    path: Path,
    height: int | None,
    width: int | None,
    place: Callable[[int], str] = event_number,
) -> Iterator[Events]:
    """Passes events on up to the first one that cannot be, where it raises RecordingError.

    Time must not run backwards, within a chunk or between two; x and y must not be negative, nor
    reach the sensor's width and height where these are known. `place(row)` names the row (counted
    from 0 over the whole recording) in the words of the file: "line 7".
    """
    rows, last = 0, None
    for events in _with_rest(chunks):
        if len(events) == 0:
            continue
        t, x, y = events.t, events.x, events.y
        last = t[0] if last is None else last
        limits = [np.inf if size is None else size for size in (width, height)]
        steps = np.diff(t)
        if (
            t[0] >= last
            and (steps.size == 0 or steps.min() >= 0)
            and min(x.min(), y.min()) >= 0
            and x.max() < limits[0]
            and y.max() < limits[1]
        ):
            rows, last = rows + len(events), t[-1]
            yield events
            continue
        steps = np.insert(steps, 0, t[0] - last)
        row = int(np.argmax((steps < 0) | (x < 0) | (x >= limits[0]) | (y < 0) | (y >= limits[1])))
        if row:
            yield events.select(slice(row))  # whoever stops before the damage never meets it
        where = f"{path}, {place(rows + row)}"
        if steps[row] < 0:
            raise RecordingError(
                f"{where}: time runs backwards, from {t[row] - steps[row]} to {t[row]} us: "
                "sort the events by time, or --stop before"
            )
        name, value = ("y", y[row]) if 0 <= x[row] < limits[0] else ("x", x[row])
        if value < 0:
            raise RecordingError(
                f"{where}: {name} is {value}, but coordinates are 0 or more: the file is damaged "
                "or of another format"
            )
        raise RecordingError(
            f"{where}: {name} is {value}, outside the sensor of {width}x{height} pixels: pass the "
            "right --sensor-size WIDTHxHEIGHT"
        )


def _with_rest(chunks: Iterable[Events]) -> Iterator[Events]:
    """Also what came before the damage within a chunk."""
    try:
        yield from chunks
    except RecordingError as error:
        if error.before is not None:
            yield error.before
        raise


def until_damage(chunks: Iterable[Events]) -> Iterator[Events]:
    """Chunks up to damage, for a first look at a recording: whoever uses it will meet the error,
    or stop before. Raises it where there is nothing before."""
    seen = 0
    try:
        for events in chunks:
            seen += len(events)
            yield events
    except RecordingError:
        if not seen:
            raise


def parse_size(text: str | None) -> tuple[int, int] | None:
    """ "240x180" -> (height, width) = (180, 240)."""
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise ValueError(f"sensor size {text!r}: expected WIDTHxHEIGHT, such as 240x180")
    if max(int(width), int(height)) > REACH:
        raise ValueError(f"sensor size {text}: a side is at most {REACH} pixels")
    return int(height), int(width)
