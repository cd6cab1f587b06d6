"""(windows of a recording, times) -> steps: which update the state, and which only give an image.

When an image is made and what updates the state are independent. The state advances by windows of
the density that the network was trained on: each is a step whose new state S[k] is kept. An image
at any other time is a look: a step whose new state is discarded, over a window of about the same
length that ends at that time:

    kept windows        |------ W[k] ------|---- W[k+1] ----|
    an image at t                |---------------->t

If a share s of W[k+1] has passed at t, the look takes the last 1 - s of W[k] and the part of W[k+1]
so far, from the state (1 - s) S[k-1] + s S[k], roughly the state at the start of that window. For
s = 0 this is the step that keeps W[k], for s = 1 the one that keeps W[k+1], so images change
smoothly across kept steps. No image depends on which others are requested, or on the future except
through the warm-up below. (A look at the part of W[k+1] alone, from S[k], would have hardly any
events just after a kept window.)

A network that has seen nothing is grey. As the whole recording is available, the network can be
shown its first windows beforehand, forwards and then backwards in time (`warming`): then it is back
at the beginning, with a state that knows the scene.

Where each window has an image, of its end, a dense one is several steps, the last of which has the
image (`in_parts`); they all keep their state.
"""

import itertools
import math
from collections import deque
from collections.abc import Iterable, Iterator, Sized
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from firenet_jax.errors import RecordingError, SettingsError
from firenet_jax.events import Events, Recording, concatenate, with_damage
from firenet_jax.windows import MAX_GAP, Window, Windows, cut

WARM_UP = 20  # windows
MOST_WARMING = 0.4  # events per pixel and window, slightly more than in usual windows
PART = 0.5  # events per pixel of a dense window's parts
MAX_RATE = 1_000_000  # images per second: times are whole microseconds


class Step(NamedTuple):
    """The input of one step of the network."""

    events: Events
    time: int | None  # int64 us of a look's image, or of a window's; None: no image, a kept state
    share: float  # s: a step starts from (1 - s) S[k-1] + s S[k], the last two kept states
    new: int = 0  # how many of a look's last events came after the last kept step
    earlier: int = 0  # events of the same window in earlier steps
    later: int = 0  # and in later ones: the window's image is that of the last


@dataclass
class Counts:
    """How many of the requested times have an image."""

    seen: int = 0
    early: int = 0  # before the first event
    late: int = 0  # after the last event; 1 for endless ones, but 0 for a grid with an image

    @property
    def outside(self) -> str:
        """Of the events that are reconstructed, which may be a part of the recording."""
        return f"{self.early} before the first event, {self.late} after the last"


def steps(
    recording: Recording,
    windows: Windows,
    times: Iterable[int],
    cutter: Iterable[Window] | None = None,
    counts: Counts | None = None,
) -> Iterator[Step]:
    """Recording, times -> the steps that give an image at each time, and the kept ones in between.

    times: microseconds on the recording's clock, in order; may be endless. Times before the first
    event or after the last one get no image. An image at t has seen all events up to and at t.
    cutter: the recording's windows; None: those that `windows` cut. counts: filled in.
    Ends with the window in which the last of the times lies.
    Raises SettingsError for windows that overlap or lie between frames, and RecordingError as `cut`
    does, after the steps up to the damage.
    """
    check(windows)
    cutter = cut(recording, windows) if cutter is None else cutter
    counts = Counts() if counts is None else counts
    grid, sized = times if isinstance(times, Grid) else None, isinstance(times, Sized)
    times = _in_order(times)
    time = next(times, None)
    before = Events.empty()
    for window, begin, end in _spans(windows, iter(cutter)):
        pause = None if grid is None else _pause(window.events, end)
        if grid is not None and time is not None and time < begin:
            counts.early += grid.skip(begin)
        while time is not None and time < begin:  # only before the first window
            counts.early += 1
            time = next(times, None)
        while time is not None and time < (end if pause is None else pause[0] + 1):
            yield _look(recording, windows, before, window.events, begin, int(time))
            counts.seen += 1
            time = next(times, None)
        yield Step(window.events, None, 1.0)
        before = window.events
        if pause is not None:
            raise RecordingError(
                f"{recording.path}: no event from {pause[0] / 1e6:.6f} to {pause[1] / 1e6:.6f} s, "
                "more than an hour: leave one side out with --start or --stop, or use --at"
            )
        if time is None:  # no image depends on what follows, which may be hours
            return
    if time is not None and (grid is None or not counts.seen):
        counts.late += 1 + (sum(1 for _ in times) if sized else 0)


def warming(
    cutter: Iterable[Window], pixels: int, count: int = WARM_UP
) -> tuple[list[Step], Iterator[Window]]:
    """Windows -> (the first `count` of them as steps, forwards and then backwards in time; all
    windows again).

    Fewer, but at least one, once they hold more than 0.4 events per pixel on average (over at least
    20 windows), as they are kept in memory. An error while reading them is raised later, at its
    place in the second iterator.
    """
    cutter = iter(cutter)
    seen: deque[Window] = deque()
    damage, held = None, 0
    most = MOST_WARMING * max(count, WARM_UP) * pixels
    try:
        for window in itertools.islice(cutter, count):
            seen.append(window)
            held += len(window.events)
            if held > most:
                break
    except RecordingError as error:
        damage = error

    def again() -> Iterator[Window]:
        while seen:  # nothing keeps them longer
            yield seen.popleft()
        if damage is not None:
            raise damage
        yield from cutter

    forwards = [window.events for window in seen]
    backwards = [events.backwards() for events in reversed(forwards)]
    return [Step(events, None, 1.0) for events in forwards + backwards], again()


def in_parts(step: Step, pixels: int) -> list[Step]:
    """A window's step -> as many as it holds halves of an event per pixel, rounded, at least one:
    equal parts of its events, the last of which has its image.

    In one step things would move far, and the image would wash out (experiments/endurance.py).
    """
    events, count = step.events, len(step.events)
    parts = max(1, round(count / (PART * pixels)))
    edges = [count * k // parts for k in range(parts + 1)]
    return [
        step._replace(
            events=events.select(slice(start, stop)),
            time=step.time if stop == count else None,
            earlier=start,
            later=count - stop,
        )
        for start, stop in itertools.pairwise(edges)
    ]


def _in_order(times: Iterable[int]) -> Iterator[int]:
    """Raises SettingsError if they are not in order, as earlier events are no longer in memory, or
    not whole: then they may be seconds."""
    last = None
    for time in times:
        if time != time // 1:  # NaN differs, too
            raise SettingsError(
                f"times of images are whole microseconds, {time} is none: round 1e6 times seconds"
            )
        if last is not None and time < last:
            raise SettingsError(f"times of images come in order, but {time} us after {last} us")
        yield time
        last = time


def check(windows: Windows) -> None:
    """Raises SettingsError for windows that cannot be combined with images at given times."""
    if windows.frame_to_frame:
        raise SettingsError("images at given times come of windows of a size, not between frames")
    if windows.step is not None:
        raise SettingsError("images at given times come of windows that do not overlap: no step")


def _spans(windows: Windows, cutter: Iterator[Window]) -> Iterator[tuple[Window, int, int]]:
    """Windows -> (window, its begin, its end): each begins where the last one ended. The last
    window ends just after its last event."""
    first = None
    pairs: Any = itertools.pairwise(itertools.chain(with_damage(cutter), [None]))
    for number, (window, following) in enumerate(pairs):
        if isinstance(window, RecordingError):  # raised after the windows before it
            raise window
        if windows.duration is not None:
            first = int(window.events.t[0]) if first is None else first
            begin, end = (first + round(k * _span(windows)) for k in (number, number + 1))
        else:
            begin = int(window.events.t[0])
            end = int(following.events.t[0]) if isinstance(following, Window) else 0
        if not isinstance(following, Window):
            end = max(int(window.events.t[-1]) if len(window.events) else window.time, begin) + 1
        yield window, begin, end


def _span(windows: Windows) -> Fraction:
    """Microseconds per window, for windows in time."""
    return Fraction(str(windows.duration)) * 1000


def _pause(events: Events, end: int) -> tuple[int, int] | None:
    """Where no event comes for more than an hour, between two of a window's or after its last one:
    a grid may have billions of times there. None: nowhere."""
    times = np.append(events.t, end)
    if times[-1] - times[0] <= MAX_GAP:
        return None
    places = np.flatnonzero(np.diff(times) > MAX_GAP)
    return (int(times[places[0]]), int(times[places[0] + 1])) if places.size else None


def _look(
    recording: Recording, windows: Windows, before: Events, now: Events, begin: int, time: int
) -> Step:
    """before, now: the events of the last kept window and of the next one."""
    passed = now.select(slice(0, int(np.searchsorted(now.t, time, "right"))))
    if windows.duration is not None:
        share = (time - begin) / float(_span(windows))
    else:
        share = len(passed) / windows.count(recording.pixels)
        if windows.longest is not None:
            share = max(share, (time - begin) / (1000 * windows.longest))
    share = min(share, 1.0) if len(before) else 1.0
    left_out = min(int(share * len(before)), len(before))
    events = concatenate([before.select(slice(left_out, None)), passed])
    return Step(events, time, share, len(passed))


class Grid:
    """first + n / rate for n = number, number + 1, ..., endless, rounded to microseconds.

    Each is computed from its number, so rounding never adds up: grids of 30, 300 and 3,000 per
    second share the times of the coarsest."""

    def __init__(self, first: int, rate: float, number: int = 0):
        self.first, self.number = first, number
        self.interval = 1_000_000 / Fraction(str(rate))

    def __iter__(self) -> "Grid":
        return self

    def __next__(self) -> int:
        time = self.first + round(self.number * self.interval)
        self.number += 1
        return time

    def skip(self, time: int) -> int:
        """Passes over times well before this one; returns how many."""
        count = max(math.floor((time - self.first) / self.interval) - 1 - self.number, 0)
        self.number += count
        return count


def grid(first: int, rate: float, from_zero: bool = False) -> Grid:
    """Endless times in microseconds, `rate` per second: `first` and those after it.

    first: whole microseconds. from_zero: the times of the grid through 0, from `first` on.
    Raises SettingsError for a first that is not whole and for a rate that cannot be.
    """
    check_rate(rate)
    if first % 1 != 0:  # NaN and infinity too
        raise SettingsError(f"first is {first}, but must be whole microseconds")
    if not from_zero:
        return Grid(first, rate)
    return Grid(0, rate, math.ceil(first / (1_000_000 / Fraction(str(rate)))))


def check_rate(rate: float) -> None:
    """Raises SettingsError for a rate of 0 or less, or of more than one per microsecond."""
    if not 0 < rate <= MAX_RATE:
        raise SettingsError(f"rate is {rate:g}, but must be above 0, at most {MAX_RATE:,} per s")
