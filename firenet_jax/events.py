"""Columns -> Events: what an event is, and the checks that every recording must pass.

An event (t, x, y, p) says that the pixel in column x and row y became brighter (p true, "ON") or
darker (p false, "OFF") by one contrast threshold at time t. Times are int64 microseconds: float32
seconds lose microseconds after 16 s. A recording is a stream of `Events` chunks in time order.
"""

import bisect
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, TypeVar, overload

import numpy as np

from firenet_jax.errors import RecordingError

BINS = 5  # temporal bins of an event tensor (Eq. 1)
MAX_TIME = 2**53  # microseconds, 285 years: beyond it float64 loses microseconds
Item = TypeVar("Item")


@dataclass(frozen=True, eq=False, slots=True)
class Events:
    """N events in time order, one array per column."""

    t: np.ndarray
    """(N,) int64, microseconds."""
    x: np.ndarray
    """(N,) int16, column, 0 at the left."""
    y: np.ndarray
    """(N,) int16, row, 0 at the top."""
    p: np.ndarray
    """(N,) bool, True: brighter."""

    def __len__(self) -> int:
        return self.t.shape[0]

    def select(self, index) -> "Events":
        """The events that a slice, a mask or an index array picks."""
        return Events(self.t[index], self.x[index], self.y[index], self.p[index])

    def flat_index(self, width: int) -> np.ndarray:
        """(N,) int64, where each event's pixel is in a flattened picture of this width."""
        return self.y.astype(np.int64) * width + self.x

    def backwards(self) -> "Events":
        """The same seen in reversed time: what became brighter becomes darker."""
        back = self.select(slice(None, None, -1))
        if len(self):
            back = replace(back, t=self.t[0] + (self.t[-1] - back.t), p=~back.p)
        return back

    @classmethod
    def of(cls, t, x, y, p) -> "Events":
        """Columns of integers -> Events with the dtypes above; p is bool, 0 and 1, or -1 and 1.
        Raises ValueError unless the columns are of numbers, flat and of one length, the times whole
        microseconds, the coordinates whole numbers that int16 holds and p is as above. `recording`
        and the readers also check that events lie on the sensor, and in order of time."""
        t, x, y, p = map(np.asarray, (t, x, y, p))
        if not t.shape == x.shape == y.shape == p.shape:
            raise ValueError(
                f"columns differ in length: t {t.shape}, x {x.shape}, y {y.shape}, p {p.shape}"
            )
        if t.ndim != 1:
            raise ValueError(f"columns are of shape (N,), not {t.shape}")
        strange = [name for name, c in zip("txyp", (t, x, y, p), strict=True) if not _real(c)]
        if strange:
            raise ValueError(f"columns are of numbers, but {', '.join(strange)} are not")
        if not (p.dtype == bool or ((p == 0) | (p == 1) | (p == -1)).all()):
            raise ValueError(f"p must be 0 and 1, or -1 and 1, not {p.min()} to {p.max()}")
        whole = t.dtype.kind in "biu" or t.dtype.kind == "f" and bool((t == np.rint(t)).all())
        if not whole or t.size and max(t.max(), -float(t.min())) >= 2.0**63:
            raise ValueError("times must be whole microseconds: round 1e6 times seconds")
        return cls(
            t.astype(np.int64, copy=False),
            _coordinates("x", x),
            _coordinates("y", y),
            p if p.dtype == bool else p > 0,
        )

    @classmethod
    def empty(cls) -> "Events":
        """No events."""
        return cls.of([], [], [], [])


def _real(column: np.ndarray) -> bool:
    return column.dtype.kind in "biuf" or not column.size


def _coordinates(name: str, column: np.ndarray) -> np.ndarray:
    """As int16. Raises ValueError where that would be other coordinates."""
    if column.dtype == np.int16 or not column.size:
        return column.astype(np.int16, copy=False)
    whole = column.dtype.kind in "biu" or (column == np.rint(column)).all()  # NaN differs, too
    if not (whole and -(2**15) <= column.min() and column.max() < 2**15):
        raise ValueError(f"{name} must be whole numbers of pixels, at most {2**15 - 1}")
    return column.astype(np.int16)


@dataclass(frozen=True, eq=False, slots=True)
class Rows:
    """N rows of a file, some of which are not valid events."""

    events: Events  # N; arbitrary values in the bad rows
    bad: np.ndarray  # (N,) bool, the rows that are not events
    error: RecordingError  # the message for the first bad row

    def __len__(self) -> int:
        return len(self.events)


@overload
def concatenate(chunks: Sequence[Events]) -> Events: ...
@overload
def concatenate(chunks: Sequence[Events | Rows]) -> Events | Rows: ...
def concatenate(chunks: Sequence[Events | Rows]) -> Events | Rows:
    """Chunks -> one chunk. A single chunk is returned without copying."""
    if len(chunks) == 1:
        return chunks[0]
    errors = [chunk.error for chunk in chunks if isinstance(chunk, Rows)]
    if errors:
        events = [c if isinstance(c, Events) else c.events for c in chunks]
        return Rows(concatenate(events), np.concatenate([*map(_known, chunks)]), errors[0])
    columns = ([getattr(chunk, name) for chunk in chunks] for name in "txyp")
    return Events(*map(np.concatenate, columns))


class Frames(NamedTuple):
    """The pictures that some cameras record alongside the events."""

    times: np.ndarray
    """(F,) int64, microseconds, on the clock of the events."""
    read: Callable[[int], np.ndarray]
    """Index, 0 to F - 1 -> the picture (H, W) uint8."""
    flow: Callable[[int], np.ndarray | None] | None = None
    """Index -> (2, H, W) optical flow up to this picture, x then y, pixels per second; None: no
    flow."""
    damage: Exception | None = None
    """What hides those after these, if the file is damaged there."""


class Triggers(NamedTuple):
    """Edges of the signals at a camera's trigger inputs, in time order."""

    times: np.ndarray
    """(N,) int64, microseconds, on the clock of the events."""
    ids: np.ndarray
    """(N,) int64, number of the input."""
    polarity: np.ndarray
    """(N,) bool, True: rising, or the file does not distinguish the edges."""


def no_triggers() -> None:
    """None, as the triggers of a recording that has none."""


@dataclass(frozen=True)
class Recording:
    """A file or folder of events, opened but not read: memory does not grow with its length."""

    path: Path
    format: str
    """In words: "text", "AEDAT4"."""
    height: int
    """Rows of the sensor."""
    width: int
    """Columns of the sensor."""
    events: Callable[[], Iterator[Events]]
    """Called, it gives all events from the first one on, in chunks."""
    count: int | None = None
    """Number of events, if the file states it."""
    frames: Frames | None = None
    """The pictures that the camera recorded beside the events; None: none."""
    inferred: bool = False
    """Whether the sensor size was inferred from the events."""
    grey: bool = False
    """Whether the file states that the sensor is monochrome."""
    triggers: Callable[[], Triggers | None] = no_triggers
    """Called, it reads the edges at the trigger inputs; None: the file has none."""

    @property
    def pixels(self) -> int:
        """Number of pixels of the sensor."""
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
    """Where an event is, counted from 1, in a file without lines."""
    return f"event {row + 1}"


HELD = 1000  # rows at the end of a chunk that wait for the next one
MAX_BAD_SHARE = 1e-3  # of the rows; if more are bad, the whole file is suspect


def checked(
    chunks: "Iterable[Events | Rows]",
    path: Path,
    height: int | None,
    width: int | None,
    place: Callable[[int], str] = event_number,
    strict: bool = True,
    say: Callable[[str, int], None] = lambda what, count: None,
) -> Iterator[Events]:
    """Yields the valid events and drops bad rows, until there are too many of these.

    Time must not run backwards, within a chunk or between chunks. x and y must not be negative or
    lie outside the sensor, if its size is known. Of rows out of order, as few as possible are
    dropped. The end of a chunk is held until the next one has come, for it may be what is wrong;
    chunks must be long for that. At the end, `say(sentence, count)` reports what was dropped, and
    damage that ended the reading early.
    Raises RecordingError for the first bad row if more than one in a thousand rows so far are bad,
    and for damage before the first event; with `strict`, for any bad row or damage. `place(row)`
    names a row (counted from 0 over the whole recording) in the file's own terms, such as "line 7".
    """
    rows, dropped, first_error, said = 0, 0, None, []
    held, before = Events.empty(), -MAX_TIME  # a chunk's end, and the last time before it
    try:
        for chunk in with_damage(chunks):
            if isinstance(chunk, RecordingError):
                yield from filter(len, [held])
                if strict or rows == dropped:
                    raise chunk
                said = [f"{chunk}; what comes before is read: {counted(rows - dropped, 'event')}"]
                return
            events = chunk if isinstance(chunk, Events) else chunk.events
            if len(events) == 0:
                continue
            last = held.t[-1] if len(held) else before
            row, rows = rows, rows + len(events)
            if not (isinstance(chunk, Events) and _is_right(events, last, height, width)):
                first, worded = _first_error(chunk, path, last, height, width, place, row)
                bad = _known(chunk) | _outside(events, height, width)
                wrong, fewest = _fewest(held, events, bad, before)
                count = int(wrong.sum() + fewest.sum())
                if strict or dropped + count > MAX_BAD_SHARE * rows:
                    yield from filter(len, [held])
                    if first:  # so that a caller who stops before the damage never meets it
                        yield events.select(slice(first))
                    dropped = 0  # the error already says it
                    raise worded()
                first_error, dropped = first_error or worded(), dropped + count
                held = held.select(~wrong) if wrong.any() else held
                events = events.select(~fewest)
            end = max(len(events) - HELD, 0)
            for part in filter(len, [held, events.select(slice(end))]):
                before = part.t[-1]
                yield part
            held = events.select(slice(end, None))
        yield from filter(len, [held])
    finally:
        if dropped:
            said += [f"{first_error}; left out: {dropped:,} of {counted(rows, 'event')}"]
        if said:
            say("; ".join(said), rows)


def with_damage(items: Iterable[Item]) -> Iterator[Item | RecordingError]:
    """Chunks or windows, and then the error that ended them."""
    try:
        yield from items
    except RecordingError as error:
        yield error


def _fewest(
    held: Events, events: Events, bad: np.ndarray, before: int
) -> tuple[np.ndarray, np.ndarray]:
    """Of the events held, which are right and follow the time `before`, and of the next ones: which
    to leave out, (N,) bool each, among them those in `bad`, so that the rest is in order."""
    last = held.t[-1] if len(held) else before
    if (~bad & (events.t < last)).sum() <= 1:  # to blame the end of those held gains nothing
        return np.zeros(len(held), bool), bad | _out_of_order(events.t, bad, last)
    known = np.append(np.zeros(len(held), bool), bad)
    out = known | _out_of_order(np.append(held.t, events.t), known, before)
    return out[: len(held)], out[len(held) :]


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


def _known(chunk: Events | Rows) -> np.ndarray:
    return chunk.bad if isinstance(chunk, Rows) else np.zeros(len(chunk), bool)


def _outside(events: Events, height: int | None, width: int | None) -> np.ndarray:
    outside = (events.x < 0) | (events.y < 0)
    for column, size in ((events.x, width), (events.y, height)):
        if size is not None:
            outside |= column >= size
    return outside


def _out_of_order(t: np.ndarray, bad: np.ndarray, last: int) -> np.ndarray:
    """(N,) times, without those in `bad` -> a smallest set to drop so that the rest is in order and
    not before `last`: all but a longest non-decreasing subsequence (patience sorting)."""
    out = ~bad & (t < last)
    rows = np.flatnonzero(~bad & ~out)[::-1]  # from the end: of two candidates the first stays
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
) -> tuple[int, Callable[[], RecordingError]]:
    """The first bad row of a chunk, and what words its error, for which `place` may read the file
    up to there once more; rows: number of rows before the chunk."""
    events = chunk if isinstance(chunk, Events) else chunk.events
    known = _known(chunk)
    t, x, y = events.t, events.x, events.y
    steps = np.diff(t, prepend=last)
    row = int(np.argmax(known | (steps < 0) | _outside(events, height, width)))

    def worded() -> RecordingError:
        if isinstance(chunk, Rows) and known[row]:
            return chunk.error
        where = f"{path}, {place(rows + row)}"
        if steps[row] < 0:
            return RecordingError(
                f"{where}: time runs backwards, from {t[row] - steps[row]} to {t[row]} us: "
                "sort the events by time, or reconstruct what is before (--stop)"
            )
        name, value = ("y", y[row]) if 0 <= x[row] < (width or np.inf) else ("x", x[row])
        if value < 0:
            return RecordingError(
                f"{where}: {name} is {value}, but coordinates are 0 or more: the file is damaged "
                "or of another format"
            )
        return RecordingError(
            f"{where}: {name} is {value}, outside the sensor of {width}x{height} pixels: pass its "
            "right size (--sensor-size WIDTHxHEIGHT)"
        )

    return row, worded


def check_recording(recording) -> None:
    """Raises TypeError for anything else, such as a path."""
    if not isinstance(recording, Recording):
        raise TypeError(
            f"the recording is a {type(recording).__name__}: pass what open_recording gives"
        )


def until_damage(chunks: Iterable[Events]) -> Iterator[Events]:
    """Chunks up to any damage, for a first look at a recording; reading the recording itself will
    raise the error. Raises it here only if nothing comes before."""
    seen = 0
    try:
        for events in chunks:
            seen += len(events)
            yield events
    except RecordingError:
        if not seen:
            raise
