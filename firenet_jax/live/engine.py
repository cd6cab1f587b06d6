"""Events as they arrive -> windows -> pictures, each as soon as can be.

One thread reads and cuts windows, another computes. Between them at most `behind` windows wait:
when more come than this machine works off, the oldest is dropped whole and counted, so the picture
never falls behind by more than these. Latency is measured from the arrival of a window's last event
to its picture.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from firenet_jax.errors import RecordingError
from firenet_jax.events import Events, concatenate
from firenet_jax.filters import LEARN_FROM, hot_pixels_of
from firenet_jax.live.sources import Source
from firenet_jax.network import Weights
from firenet_jax.pictures import Display
from firenet_jax.reconstruction import Network, events_to_pictures, initial_session
from firenet_jax.tensors import capacity, pack

LATENCIES_KEPT = 2000  # latencies, of which median and 95th percentile are told
BAD_AFTER = 1000  # events, of which most may not be bad at the start


class Limits(NamedTuple):
    """Of windows."""

    count: int  # events in one
    longest: int  # microseconds of one
    behind: int = 2  # that may wait
    speed: float = 1.0  # of the events' time, in that of the clock


class Arrived(NamedTuple):
    """A window, and when its last event came."""

    events: Events
    at: float  # seconds of the clock


@dataclass
class Figures:
    """What is measured. Counts are since the start."""

    events: int = 0
    bad: int = 0  # outside the sensor or back in time: left out
    outside: int = 0  # of those, outside
    shown: int = 0  # windows that became pictures
    dropped: int = 0  # windows that did not
    latencies: deque = field(default_factory=lambda: deque(maxlen=LATENCIES_KEPT))  # seconds

    def summary(self) -> dict:
        """Counts, and latency's median and 95th percentile in ms over the last windows."""
        latencies = 1000 * np.array(list(self.latencies) or [np.nan])
        median, most = np.percentile(latencies, [50, 95])
        return {
            "events": self.events,
            "bad_events": self.bad,
            "windows": self.shown,
            "dropped_windows": self.dropped,
            "latency_ms": None if np.isnan(median) else round(float(median), 2),
            "latency_95_ms": None if np.isnan(most) else round(float(most), 2),
        }


def valid_events(
    arrivals: Iterable[Events], height: int, width: int, figures: Figures
) -> Iterator[Events]:
    """Passes on what can be events of this sensor, in order of time; counts the rest.

    Of times that are not in order those are left out of which there are fewer: wrong, late ones, or
    what follows them. Where one is the last to arrive at once, what follows counts as back in time,
    until there is so much that the sender's clock must have been set. Raises RecordingError where
    most of the first thousand are outside the sensor.
    """
    last, shift, behind = None, 0, 0
    for events in arrivals:
        if len(events):
            last = int(events.t.min()) if last is None else last
            back = int((events.t + shift < last).sum())  # a wrong one may be among them again
            behind = behind + back if 2 * back > len(events) else 0
            if behind >= BAD_AFTER:  # the sender's clock was set: its times go on from the last one
                shift, behind = last + 1 - int(events.t[0]), 0
            events = replace(events, t=events.t + shift) if shift else events
            latest = np.maximum.accumulate(np.maximum(events.t, last))
            inside = (events.x >= 0) & (events.y >= 0) & (events.x < width) & (events.y < height)
            good = events.t >= latest
            ahead = events.t > np.minimum.accumulate(events.t[::-1])[::-1]
            if ahead.sum() < len(good) - good.sum():  # few are wrong, not all that follow them
                good = ~ahead & (events.t >= last)
            good &= inside
            figures.events += len(events)
            if not good.all():
                figures.bad += int(len(good) - good.sum())
                figures.outside += int(len(inside) - inside.sum())
                if figures.events >= BAD_AFTER and 2 * figures.outside > figures.events:
                    raise RecordingError(
                        f"{figures.outside:,} of {figures.events:,} events lie outside a sensor of "
                        f"{width}x{height} pixels: are --sensor-size and --wire right?"
                    )
                events = events.select(good)
            if len(events):
                last = int(events.t[-1])
        yield events


def without_hot_pixels(
    arrivals: Iterable[Events], height: int, width: int, hot: np.ndarray | None = None
) -> Iterator[Events]:
    """Leaves out the events of hot pixels, (H, W) bool. Empty arrivals stay: they tell the time.

    None: pixels that are hot among the events so far, by the rule of `filters.find_hot_pixels`,
    found anew whenever the events have doubled, from one for four pixels to five million.
    """
    counts = np.zeros((height, width), np.int64)
    learning, seen, due = hot is None, 0, height * width // 4
    mask = np.zeros((height, width), bool) if hot is None else hot
    for events in arrivals:
        if learning:
            np.add.at(counts, (events.y, events.x), 1)
            seen += len(events)
            if seen >= due:
                mask, due, learning = hot_pixels_of(counts), 2 * seen, seen < LEARN_FROM
        yield events.select(~mask[events.y, events.x])


def windows(
    arrivals: Iterable[Events],
    count: int,
    longest: int,
    clock: Callable[[], float] = time.monotonic,
    speed: float = 1.0,
) -> Iterator[Arrived]:
    """Arrivals -> windows of `count` events, or what came in `longest` microseconds.

    Time is that of the events, and where none come that of the clock, `speed` times as fast: the
    last ones before a pause do not wait for its end. The last window may hold fewer.
    """
    held, size, began, arrived = [], 0, 0.0, 0.0
    for events in arrivals:
        now = clock()
        if len(events):
            began, arrived = (now if not size else began), now
            held.append(events)
            size += len(events)
            while size and (size >= count or held[-1].t[-1] - held[0].t[0] >= longest):
                whole = concatenate(held)
                stop = min(count, int(np.searchsorted(whole.t, whole.t[0] + longest)))
                yield Arrived(whole.select(slice(stop)), now)
                held, size, began = [whole.select(slice(stop, None))], size - stop, now
        elif size and 1e6 * (now - began) * speed >= longest:
            yield Arrived(concatenate(held), arrived)
            held, size = [], 0
        held = held if size else []
    if size:
        yield Arrived(concatenate(held), arrived)


class Waiting:
    """Windows on their way from one thread to another; the oldest of too many is dropped."""

    def __init__(self, most: int, figures: Figures):
        self.windows: deque[Arrived] = deque()
        self.most, self.figures = most, figures
        self.changed, self.ended, self.error = threading.Condition(), False, None

    def fill(self, windows: Iterator[Arrived]) -> None:
        """Until they end, or `close`."""
        try:
            for window in windows:
                with self.changed:
                    if self.ended:
                        break
                    if len(self.windows) == self.most:
                        self.windows.popleft()
                        self.figures.dropped += 1
                    self.windows.append(window)
                    self.changed.notify()
        except BaseException as error:  # whatever it is, the thread that takes must see it
            self.error = error
        finally:
            self.close()

    def close(self) -> None:
        with self.changed:
            self.ended = True
            self.changed.notify()

    def __iter__(self) -> Iterator[Arrived]:
        """Those that wait, as they come. Raises what `fill` met."""
        while True:
            with self.changed:
                self.changed.wait_for(lambda: self.windows or self.ended)
                if not self.windows:
                    if self.error is not None:
                        raise self.error
                    return
                window = self.windows.popleft()
            yield window


def pictures(
    source: Source,
    weights: Weights,
    limits: Limits,
    figures: Figures,
    settings: Display = Display(),
    prepare: Callable[[Iterator[Events]], Iterator[Events]] = iter,
) -> Generator[np.ndarray, None, None]:
    """A source -> pictures (H, 2 W, 3) uint8, the events beside the reconstruction.

    figures: what is measured is noted down there. prepare: from events of this sensor, in order of
    time, to those that are cut into windows.
    """
    height, width = source.height, source.width
    size = capacity(limits.count)
    session = initial_session(1, height, width, Network())
    valid = jnp.ones((1, 1), bool)

    def compute(session, events: Events):
        packed = pack([[events]], size)
        session, picture = events_to_pictures(
            weights, session, packed, valid,
            height=height, width=width, settings=settings, preview=True,
        )  # fmt: skip
        return session, np.asarray(picture)[0, 0]

    jax.block_until_ready(compute(session, Events.empty()))  # compiled before the first event

    waiting = Waiting(limits.behind, figures)
    arrivals = prepare(valid_events(source.arrivals, height, width, figures))
    cut = windows(arrivals, limits.count, limits.longest, speed=limits.speed)
    reading = threading.Thread(target=waiting.fill, args=(cut,), daemon=True)
    reading.start()
    try:
        for window in waiting:
            session, picture = compute(session, window.events)
            figures.latencies.append(time.monotonic() - window.at)
            figures.shown += 1
            yield picture
    finally:
        waiting.close()
