"""Columns -> Events: what an event is, and the checks that every recording passes at the door.

An event (t, x, y, p) says that the pixel in column x and row y became brighter (p true, "ON") or
darker (p false, "OFF") by one contrast threshold at time t. Times are int64 microseconds: float32
seconds lose microseconds after 16 s. A recording is a stream of `Events` chunks in time order.
"""

import bisect
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, overload

import numpy as np

from firenet_jax.errors import RecordingError

BINS = 5  # of an event tensor: what a window is split into along time (Eq. 1)
MAX_TIME = 2**53  # microseconds, 285 years: float64 seconds lose microseconds beyond


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
        Raises ValueError for columns of different lengths, and for times that are no whole
        microseconds. What the numbers are is checked by `recording` and the readers."""
        t, x, y, p = map(np.asarray, (t, x, y, p))
        if not t.shape == x.shape == y.shape == p.shape:
            raise ValueError(
                f"columns differ in length: t {t.shape}, x {x.shape}, y {y.shape}, p {p.shape}"
            )
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


@dataclass(frozen=True, eq=False, slots=True)
class Rows:
    """N rows of a file, of which some are no events."""

    events: Events  # N; of the rows that are none, any numbers
    bad: np.ndarray  # (N,) bool, which these are
    error: RecordingError  # what is to be said of the first of them

    def __len__(self) -> int:
        return len(self.events)


@overload
def concatenate(chunks: Sequence[Events]) -> Events: ...
@overload
def concatenate(chunks: Sequence[Events | Rows]) -> Events | Rows: ...
def concatenate(chunks: Sequence[Events | Rows]) -> Events | Rows:
    """Chunks -> one chunk; without copying when there is only one."""
    if len(chunks) == 1:
        return chunks[0]
    errors = [chunk.error for chunk in chunks if isinstance(chunk, Rows)]
    if errors:
        masks = [c.bad if isinstance(c, Rows) else np.zeros(len(c), bool) for c in chunks]
        events = [c if isinstance(c, Events) else c.events for c in chunks]
        return Rows(concatenate(events), np.concatenate(masks), errors[0])
    columns = ([getattr(chunk, name) for chunk in chunks] for name in "txyp")
    return Events(*map(np.concatenate, columns))


class Frames(NamedTuple):
    """The pictures that some cameras take beside the events."""

    times: np.ndarray  # (F,) int64, microseconds, on the clock of the events
    read: Callable[[int], np.ndarray]  # i -> (H, W) uint8
    # i -> (2, H, W), x then y, pixels per second up to this picture; None where a file has none
    flow: Callable[[int], np.ndarray | None] | None = None


class Triggers(NamedTuple):
    """Edges of the signals at a camera's trigger inputs, in time order."""

    times: np.ndarray  # (N,) int64, microseconds, on the clock of the events
    ids: np.ndarray  # (N,) int64, number of the input
    polarity: np.ndarray  # (N,) bool, True: rising, or a file that does not tell the edges apart


def no_triggers() -> None:
    """Of a recording that holds none."""


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
    inferred: bool = False  # whether the sensor's size is that of its events
    grey: bool = False  # whether the file says that the sensor sees no colours
    triggers: Callable[[], Triggers | None] = no_triggers  # reads the file; None: there are none

    @property
    def pixels(self) -> int:
        return self.height * self.width


def counted(number: int, noun: str) -> str:
    """1 picture, 2,000 pictures"""
    return f"{number:,} {noun}{'s' * (number != 1)}"


def rate_in_words(rate: float) -> str:
    """ "2.31 Mev/s", "46.2 kev/s", "20 ev/s" """
    for scale, unit in ((1e6, "Mev/s"), (1e3, "kev/s")):
        if rate >= scale:
            return f"{rate / scale:.3g} {unit}"
    return f"{rate:.3g} ev/s"


def event_number(row: int) -> str:
    """The place of an event, counted from 1, in a file that has no lines."""
    return f"event {row + 1}"


MAX_BAD_SHARE = 1e-3  # of the rows may be left out: beyond, the fault is not that of single events


def checked(
    chunks: "Iterable[Events | Rows]",
    path: Path,
    height: int | None,
    width: int | None,
    place: Callable[[int], str] = event_number,
    strict: bool = True,
    say: Callable[[str, int], None] = lambda what, count: None,
) -> Iterator[Events]:
    """Passes events on, without rows that cannot be events, up to where there are too many.

    Time must not run backwards, within a chunk or between two; x and y must not be negative, nor
    reach the sensor's width and height where these are known. Of rows that break the order of time
    as few are left out as can be. What is left out, and damage that ends the reading early, goes
    to `say(sentence, count)` at the end. Raises RecordingError for the first bad row where more
    than one in a thousand of those read so far are bad, and for damage before the first event;
    strict: for any. `place(row)` names the row (counted from 0 over the whole recording) in the
    words of the file: "line 7".
    """
    rows, dropped, last, first_error = 0, 0, None, None
    try:
        chunks = iter(chunks)
        while True:
            try:
                chunk = next(chunks, None)
            except RecordingError as error:
                if strict or rows == dropped:
                    raise
                say(f"{error}; what comes before is read: {counted(rows - dropped, 'event')}", rows)
                return
            if chunk is None:
                return
            events = chunk if isinstance(chunk, Events) else chunk.events
            if len(events) == 0:
                continue
            last = events.t[0] if last is None else last
            if isinstance(chunk, Events) and _is_right(events, last, height, width):
                rows, last = rows + len(events), events.t[-1]
                yield events
                continue
            bad = chunk.bad if isinstance(chunk, Rows) else np.zeros(len(events), bool)
            first, error = _first_error(chunk, path, last, height, width, place, rows)
            bad = bad | _outside(events, height, width)
            fewest = bad | _out_of_order(events.t, bad, last)
            count = int(fewest.sum())
            if strict or dropped + count > MAX_BAD_SHARE * (rows + len(events)):
                if first:  # whoever stops before the damage never meets it
                    yield events.select(slice(first))
                dropped = 0  # the error says enough
                raise error
            first_error = first_error or error
            rows, dropped = rows + len(events), dropped + count
            events = events.select(~fewest)
            if len(events):
                last = events.t[-1]
                yield events
    finally:
        if dropped:
            say(f"{first_error}; left out: {dropped:,} of {counted(rows, 'event')}", rows)


def _is_right(events: Events, last: int, height: int | None, width: int | None) -> bool:
    t, x, y = events.t, events.x, events.y
    steps = np.diff(t)
    return bool(
        t[0] >= last
        and (steps.size == 0 or steps.min() >= 0)
        and min(x.min(), y.min()) >= 0
        and (width is None or x.max() < width)
        and (height is None or y.max() < height)
    )


def _outside(events: Events, height: int | None, width: int | None) -> np.ndarray:
    outside = (events.x < 0) | (events.y < 0)
    for column, size in ((events.x, width), (events.y, height)):
        if size is not None:
            outside |= column >= size
    return outside


def _out_of_order(t: np.ndarray, bad: np.ndarray, last: int) -> np.ndarray:
    """(N,) times, which of them do not count -> the fewest to leave out so that the rest is in
    order, none before `last`: all but a longest non-decreasing subsequence (patience sorting)."""
    out = ~bad & (t < last)
    rows = np.flatnonzero(~bad & ~out)[::-1]  # from the end: of two that would do, the first stays
    times = (-t[rows]).tolist()
    if not times or bool((np.diff(t[rows]) <= 0).all()):
        return out
    tails: list[int] = []  # of the sequences of each length the one that ends earliest: its end
    places: list[int] = []  # ... and where that is
    before = [-1] * len(times)
    for place, time in enumerate(times):
        length = bisect.bisect_right(tails, time)
        if length == len(tails):
            tails.append(time)
            places.append(place)
        else:
            tails[length], places[length] = time, place
        before[place] = places[length - 1] if length else -1
    kept, place = [], places[-1]
    while place >= 0:
        kept.append(place)
        place = before[place]
    out[rows] = True
    out[rows[kept]] = False
    return out


def _first_error(
    chunk: "Events | Rows", path: Path, last: int, height, width, place, rows: int
) -> tuple[int, RecordingError]:
    """(the first row of a chunk that cannot be, what is to be said of it); rows: before it"""
    events = chunk if isinstance(chunk, Events) else chunk.events
    known = chunk.bad if isinstance(chunk, Rows) else np.zeros(len(events), bool)
    t, x, y = events.t, events.x, events.y
    steps = np.diff(t, prepend=last)
    row = int(np.argmax(known | (steps < 0) | _outside(events, height, width)))
    if isinstance(chunk, Rows) and known[row]:
        return row, chunk.error
    where = f"{path}, {place(rows + row)}"
    if steps[row] < 0:
        return row, RecordingError(
            f"{where}: time runs backwards, from {t[row] - steps[row]} to {t[row]} us: "
            "sort the events by time, or --stop before"
        )
    name, value = ("y", y[row]) if 0 <= x[row] < (width or np.inf) else ("x", x[row])
    if value < 0:
        return row, RecordingError(
            f"{where}: {name} is {value}, but coordinates are 0 or more: the file is damaged "
            "or of another format"
        )
    return row, RecordingError(
        f"{where}: {name} is {value}, outside the sensor of {width}x{height} pixels: pass the "
        "right --sensor-size WIDTHxHEIGHT"
    )


def check_recording(recording) -> None:
    """Raises TypeError for what is none, such as a path."""
    if not isinstance(recording, Recording):
        raise TypeError(
            f"the recording is a {type(recording).__name__}: pass what open_recording gives"
        )


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
