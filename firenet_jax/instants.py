"""(windows of a recording, times) -> steps: what the network takes in, and when it only looks.

Time and diet are two things. The state advances by windows of the density that the network likes:
each is a step whose new state S[k] is kept. An image at any other time is a step whose new state
is thrown away, of a window of about the same length that ends at that time:

    kept windows        |------ W[k] ------|---- W[k+1] ----|
    an image at t                |---------------->t

Where a share s of W[k+1] has passed at t, the image is of the last 1 - s of W[k] and what there is
of W[k+1], seen from the state (1 - s) S[k-1] + s S[k], about the one where that window begins. For
s = 0 this is the step that keeps W[k], for s = 1 the one that keeps W[k+1]: images change smoothly
across the steps that are kept, and none depends on which others are asked for, nor on the future.
(Of W[k+1]'s part alone, from S[k], images just after a kept window would be of hardly any events.)
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from firenet_jax.errors import RecordingError, SettingsError
from firenet_jax.events import Events, Recording, concatenate
from firenet_jax.windows import Window, Windows, cut

MAX_RATE = 1_000_000  # images per second: times are whole microseconds


class Step(NamedTuple):
    """What becomes one event tensor."""

    events: Events
    time: int | None  # int64 us, of an image; None: the state is kept and no image wanted
    share: float  # of the way from the state before the last one kept to that one
    new: int = 0  # of an image's events, the last so many: those since the last step that was kept


@dataclass
class Counts:
    """What happened to the times that were asked for."""

    seen: int = 0
    early: int = 0  # before the first event
    late: int = 0  # after the last one; of an endless grid 0


def steps(
    recording: Recording,
    windows: Windows,
    times: Iterable[int],
    chunks: Iterable[Events] | None = None,
    counts: Counts | None = None,
) -> Iterator[Step]:
    """Recording, times -> the steps that give an image at each time, those kept among them.

    times: microseconds on the recording's clock, in order; may be without end. Times before the
    first event and after the last one have no image. An image at t has seen the events up to t,
    those at t among them.
    chunks: the recording's events after filters; None: as they are. counts: is filled in.
    Raises SettingsError for windows that overlap or lie between frames, and RecordingError as `cut`
    does, after the steps up to the damage.
    """
    check(windows)
    counts = Counts() if counts is None else counts
    endless, times = isinstance(times, Grid), _in_order(times)
    time = next(times, None)
    before = Events.empty()
    for window, begin, end in _spans(windows, cut(recording, windows, chunks)):
        while time is not None and time < begin:  # only before the first window
            counts.early += 1
            time = next(times, None)
        while time is not None and time < end:
            yield _look(recording, windows, before, window.events, begin, int(time))
            counts.seen += 1
            time = next(times, None)
        yield Step(window.events, None, 1.0)
        before = window.events
    if time is not None and not endless:
        counts.late += 1 + sum(1 for _ in times)


def _in_order(times: Iterable[int]) -> Iterator[int]:
    """Raises SettingsError where they are not: what came before is gone."""
    last = None
    for time in times:
        if last is not None and time < last:
            raise SettingsError(f"times of images come in order, but {time} us after {last} us")
        yield time
        last = time


def check(windows: Windows) -> None:
    """Raises SettingsError for windows whose states are of no use for images at given times."""
    if windows.between_frames:
        raise SettingsError("images at given times come of windows of a size, not between frames")
    if windows.step is not None:
        raise SettingsError("images at given times come of windows that do not overlap: no step")


def _spans(windows: Windows, cutter: Iterator[Window]) -> Iterator[tuple[Window, int, int]]:
    """Windows -> (window, the time where it begins, where it ends): each begins where the last
    ended. The last window ends just after its last event."""
    first = None
    window, number, error = next(cutter, None), 0, None
    while window is not None:
        try:
            following = next(cutter, None)
        except RecordingError as damage:  # told after what came before it
            following, error = None, damage
        if windows.duration is not None:
            first = int(window.events.t[0]) if first is None else first
            begin, end = (first + round(k * _span(windows)) for k in (number, number + 1))
        else:
            begin = int(window.events.t[0])
            end = 0 if following is None else int(following.events.t[0])
        if following is None:
            end = max(int(window.events.t[-1]) if len(window.events) else window.time, begin) + 1
        yield window, begin, end
        window, number = following, number + 1
    if error is not None:
        raise error


def _span(windows: Windows) -> Fraction:
    """Microseconds of windows in time."""
    return Fraction(str(windows.duration)) * 1000


def _look(
    recording: Recording, windows: Windows, before: Events, now: Events, begin: int, time: int
) -> Step:
    """before, now: the events of the last window that is kept and of the next one."""
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
    """first + n / rate for n = number, number + 1 ... without end, rounded to microseconds.

    Each is computed from its number, so rounding never adds up, and grids of 30, 300 and 3,000
    per second share the times of the coarsest."""

    def __init__(self, first: int, rate: float, number: int = 0):
        self.first, self.number = first, number
        self.interval = 1_000_000 / Fraction(str(rate))

    def __iter__(self) -> "Grid":
        return self

    def __next__(self) -> int:
        time = self.first + round(self.number * self.interval)
        self.number += 1
        return time


def grid(first: int, rate: float, from_zero: bool = False) -> Grid:
    """Times so many per second from the first event on; from_zero: of a grid through time 0."""
    check_rate(rate)
    if not from_zero:
        return Grid(first, rate)
    return Grid(0, rate, math.ceil(first / (1_000_000 / Fraction(str(rate)))))


def check_rate(rate: float) -> None:
    """Raises SettingsError for a rate that is not above 0, or more than one a microsecond."""
    if not 0 < rate <= MAX_RATE:
        raise SettingsError(f"rate is {rate:g}, but must be above 0, at most {MAX_RATE:,} per s")
