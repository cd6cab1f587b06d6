"""Event stream -> windows: where to cut a recording, separate from reading and from voxels.

Windows are consecutive and, without `step`, do not overlap. The last one may be partial: no event
is lost. Memory holds one window and one chunk, whatever the recording's length.
"""

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from typing import Annotated, NamedTuple

import numpy as np
import tyro

from firenet_jax.errors import RecordingError, SettingsError, logger
from firenet_jax.events import Events, Recording, concatenate, counted

MAX_GAP = 3_600_000_000  # microseconds between two events, or events and frames, of one clock
MAX_NUMBER = 2**31 - 1
DEFAULT_LONGEST = 40.0  # milliseconds: at least 25 pictures per second
USUAL_DENSITY = 0.35  # events per pixel and window
MIN_WINDOWS = 20  # of a short recording: its windows are shorter than DEFAULT_LONGEST


class Window(NamedTuple):
    """The events that become one event tensor, and so one image."""

    events: Events
    time: int  # int64 us: that of the last event; of an empty window, its end


@dataclass(frozen=True)
class Windows:
    """How to cut the events into windows, one image each. Choose at most one way."""

    events: Annotated[int | None, tyro.conf.arg(aliases=["-N"])] = None
    """A window holds this many events."""
    events_per_pixel: float | None = None
    """A window holds this many events per pixel of the sensor (default: 0.35)."""
    duration: Annotated[float | None, tyro.conf.arg(aliases=["-T"])] = None
    """A window lasts this many milliseconds, on a grid that starts at the first event."""
    frame_to_frame: bool = False
    """A window lasts from one of the camera's frames to the next."""
    step: float | None = None
    """Windows start this many events apart (milliseconds, with --duration). If this is less than
    the window, windows overlap."""
    longest: float | None = None
    """A window of events ends after this many milliseconds at the latest. If no kind of window is
    chosen: 40, or a twentieth of a recording, or part of one, shorter than 0.8 s."""

    def __post_init__(self):
        ways = [self.events, self.events_per_pixel, self.duration, self.frame_to_frame or None]
        if sum(way is not None for way in ways) > 1:
            raise SettingsError(
                "windows are cut in one way: choose one of --events, --events-per-pixel, "
                "--duration and --frame-to-frame"
            )
        for name in ("events", "events_per_pixel", "duration", "step", "longest"):
            value = getattr(self, name)
            if value is not None and not 0 < value <= MAX_NUMBER:
                raise SettingsError(
                    f"{name} is {value}, but must be more than 0, at most {MAX_NUMBER}"
                )
        if self.events is not None and self.events != int(self.events):
            raise SettingsError(f"events is {self.events}, but counts them: pass a whole number")
        if self.step is not None:
            if self.frame_to_frame:
                raise SettingsError(
                    "step overlaps windows of a fixed size, not those between frames"
                )
            if self.duration is None and self.step != int(self.step):
                raise SettingsError(f"step is {self.step}, but counts events: pass a whole number")
            window = self.duration or self.events
            if window is not None and self.step > window:
                unit = "ms" if self.duration else "events"
                raise SettingsError(
                    f"step of {self.step:g} {unit} is longer than the window, {window:g} {unit}"
                )
        if self.longest is not None:
            if self.duration is not None or self.frame_to_frame or self.step is not None:
                raise SettingsError("longest limits windows of events, which do not overlap")
        for name in ("duration", "longest", *(["step"] if self.duration is not None else [])):
            value = getattr(self, name)
            if value is not None and round(value * 1000) < 1:
                raise SettingsError(f"{name} is {value} ms, but times are whole microseconds")

    def count(self, pixels: int) -> int:
        """Events in a full window of a sensor with this many pixels (windows in time ignore it)."""
        if self.events is not None:
            return int(self.events)  # 1e4 is a number of events, too
        return max(1, round((self.events_per_pixel or USUAL_DENSITY) * pixels))


def usual(chunks: Iterable[Events]) -> Windows:
    """The default windows of a recording: 0.35 events per pixel, but at most 40 ms, so that slow
    scenes get pictures too. A recording shorter than 0.8 s gets windows of at most a twentieth of
    its length. Reads up to 0.8 s of the recording."""
    first = last = None
    for events in chunks:
        first = int(events.t[0]) if first is None else first
        last = int(events.t[-1])
        if last - first >= MIN_WINDOWS * 1000 * DEFAULT_LONGEST:
            return Windows(longest=DEFAULT_LONGEST)
    return Windows(longest=max(((last or 0) - (first or 0)) // MIN_WINDOWS, 1) / 1000)


def in_words(windows: Windows, pixels: int) -> str:
    """ "windows of 0.35 events per pixel (15,120), at most 40 ms" """
    count = windows.count(pixels)
    if windows.frame_to_frame:
        said = "windows between frames"
    elif windows.duration is not None:
        said = f"windows of {windows.duration:g} ms"
    elif windows.events is not None:
        said = f"windows of {counted(count, 'event')}"
    else:
        density = windows.events_per_pixel or USUAL_DENSITY
        said = f"windows of {density:g} events per pixel ({count:,})"
    if windows.step is not None:
        said += f", one every {windows.step:g} {'ms' if windows.duration else 'events'}"
    return said + ("" if windows.longest is None else f", at most {windows.longest:g} ms")


def cut(
    recording: Recording,
    windows: Windows,
    chunks: Iterable[Events] | None = None,
    begin: int | None = None,
    *,
    whole: bool = True,
) -> Iterator[Window]:
    """Recording -> its windows, as `windows` says.

    chunks: the recording's events after filters; None: unfiltered.
    begin: microseconds, where the first window in time begins; None: at the first event.
    whole: a window is one step of the network, which is warned of where it is dense.
    Raises RecordingError if windows between frames are requested and the recording has no frames,
    and, for windows in time, if no event comes for more than an hour; SettingsError if the step is
    longer than the window of this sensor.
    """
    chunks = iter(recording.events() if chunks is None else chunks)
    if windows.frame_to_frame:
        times = () if recording.frames is None else np.unique(recording.frames.times)
        if len(times) < 2:
            raise RecordingError(
                f"{recording.path}: windows between frames need a recording with two frames or "
                "more, each at a time of its own: use --events or --duration"
            )
        spans = partial(_frame_spans, recording.path, times)
        return _by_time(recording.path, chunks, begin, spans)
    if windows.duration is not None:
        step = windows.duration if windows.step is None else windows.step
        spans = partial(_grid_spans, windows.duration, step)
        return _by_time(recording.path, chunks, begin, spans)
    count = windows.count(recording.pixels)
    step = count if windows.step is None else int(windows.step)
    if step > count:
        raise SettingsError(f"step of {step} events is longer than the window, {count} events")
    most = count if whole else round(USUAL_DENSITY * recording.pixels)
    warn_if_unusual(min(count, most), recording.pixels)
    if windows.longest is not None:
        return _by_count_or_time(chunks, count, round(1000 * windows.longest))
    return _by_count(chunks, count, step)


def warn_if_unusual(events: float, pixels: int) -> None:
    """Warns if windows are much sparser or denser than those that the network was trained on."""
    density = events / pixels
    if not 0.1 <= density <= 1.5:
        logger.warning(
            "%s per window %s %s per pixel: fewer than 0.1 give noisy and faint images, "
            "more than 1.5 smeared ones; %g (%d events) is usual for this sensor",
            counted(round(events), "event"), "is" if events == 1 else "are",
            f"{density:,.0f}" if density >= 100 else f"{density:.3g}", USUAL_DENSITY,
            round(USUAL_DENSITY * pixels),
        )  # fmt: skip


def _by_count(chunks: Iterator[Events], count: int, step: int) -> Iterator[Window]:
    """Windows [k step, k step + count) over the numbered events; the last may be shorter."""
    held, size, covered = [], 0, 0  # events not yet dropped; of them, how many were in a window
    for chunk in chunks:
        held.append(chunk)
        size += len(chunk)
        if size < count:
            continue
        events, start = concatenate(held), 0
        while size - start >= count:
            yield _window(events, start, start + count)
            covered = start + count
            start += step
        held, size, covered = [events.select(slice(start, None))], size - start, covered - start
    if size > max(covered, 0):
        yield _window(concatenate(held), 0, size)


def _by_count_or_time(chunks: Iterator[Events], count: int, longest: int) -> Iterator[Window]:
    """Windows of `count` events that last less than `longest` microseconds; a window that would
    last longer has fewer events. None is empty."""
    held, size = [], 0  # events of no window yet
    for chunk in filter(len, chunks):
        held.append(chunk)
        size += len(chunk)
        if size < count and chunk.t[-1] - held[0].t[0] < longest:
            continue
        events, start = concatenate(held), 0
        while start < size:
            stop = int(np.searchsorted(events.t, events.t[start] + longest))
            if min(stop, start + count) >= size and stop - start < count:
                break  # it may go on in the next chunk
            stop = min(stop, start + count)
            yield _window(events, start, stop)
            start = stop
        held, size = [events.select(slice(start, None))] * (start < size), size - start
    if size:
        yield _window(concatenate(held), 0, size)


def _by_time(path, chunks: Iterator[Events], begin: int | None, spans) -> Iterator[Window]:
    """Windows of the events with start <= t < stop, for each span of `spans(begin)`.

    Ends with the first window that reaches the recording's last event. Events before `begin` are
    dropped as they come: they may be most of a recording.
    """
    if begin is not None:
        later = (chunk.select(slice(np.searchsorted(chunk.t, begin), None)) for chunk in chunks)
        chunks = filter(len, later)
    first = next(chunks, None)
    if first is None:
        return
    held, ended = first, False
    for start, stop in spans(int(first.t[0]) if begin is None else begin):
        parts = [held]
        while not ended and not (len(parts[-1]) and parts[-1].t[-1] >= stop):
            chunk = next(chunks, None)
            ended = chunk is None
            parts += [] if chunk is None else [chunk]
        held = concatenate(parts)
        a, b = np.searchsorted(held.t, [start, stop])
        yield _window(held, a, b, stop)
        if ended and b == len(held):
            return
        if held.t[b] - stop > MAX_GAP:  # a broken time: there may be billions of windows up to it
            raise RecordingError(
                f"{path}: no event from {stop / 1e6:.6f} to {held.t[b] / 1e6:.6f} s, more than an "
                "hour: leave one side out with --start or --stop, or use --events"
            )
        held = held.select(slice(a, None))


def _window(events: Events, start: int, stop: int, end: int = 0) -> Window:
    events = events.select(slice(start, stop))
    return Window(events, int(events.t[-1]) if len(events) else int(end))


def _grid_spans(duration: float, step: float, first: int) -> Iterator[tuple[int, int]]:
    """Milliseconds -> spans in microseconds. Each is computed from k, so rounding never adds up.

    In fractions, because with floats an end and the next start could round to two microseconds.
    """
    apart, long = (Fraction(str(value)) * 1000 for value in (step, duration))
    for k in itertools.count():
        yield first + round(k * apart), first + round(k * apart + long)


def _frame_spans(path, times: np.ndarray, first: int) -> Iterator[tuple[int, int]]:
    """Frame times -> spans. The frames' clock is extended before the first and after the last.

    So if frames begin late or end early, the rest of the recording is not one long window.
    """
    if max(times[0] - first, first - times[-1]) > MAX_GAP:
        raise RecordingError(
            f"{path}: its frames are from {times[0] / 1e6:.6f} to {times[-1] / 1e6:.6f} s, its "
            f"events begin at {first / 1e6:.6f} s: they are not on one clock; use --events or "
            "--duration"
        )
    interval = max(1, int(np.median(np.diff(times))))
    missing = max(0, (int(times[0]) - first) // interval)
    before = times[0] - interval * np.arange(missing, 0, -1)
    after = (int(times[-1]) + interval * k for k in itertools.count(1))
    edges = itertools.chain(before.tolist(), times.tolist(), after)
    edges = itertools.chain([first], (edge for edge in edges if edge > first))
    yield from itertools.pairwise(edges)
