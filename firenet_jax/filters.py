"""Event stream -> event stream: a part of the time, without hot pixels, or rotated.

Each filter maps an iterator of `Events` chunks to another and holds at most one chunk.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import median_filter

from firenet_jax.errors import RecordingError, SettingsError
from firenet_jax.events import MAX_TIME, Events, Recording, until_damage
from firenet_jax.storage.files import read_lines

LEARN_FROM = 5_000_000  # events among which hot pixels are looked for


def check_span(start: float | None, stop: float | None) -> None:
    """Raises SettingsError unless these bounds in seconds, None for no bound, are valid."""
    for name, value in (("start", start), ("stop", stop)):
        if value is not None and not abs(value) < MAX_TIME / 1e6:
            raise SettingsError(f"{name} is {value} s, but must be a time: leave it out for none")
    if start is not None and start < 0:
        raise SettingsError(f"start is {start} s, but counts from the beginning: 0 or more")
    if stop is not None and stop <= (start or 0):
        raise SettingsError(f"stop is {stop} s, but must come after the start")


def between(chunks: Iterable[Events], start: float | None, stop: float | None) -> Iterator[Events]:
    """Events with start <= t < stop, in seconds after the recording's first event."""
    first = None
    for events in chunks:
        first = events.t[0] if first is None else first
        end = np.iinfo(np.int64).max if stop is None else first + round(stop * 1e6)
        a, b = np.searchsorted(events.t, [first + round((start or 0) * 1e6), end])
        if b > a:
            yield events.select(slice(a, b))
        if b < len(events):
            return


def without_hot_pixels(chunks: Iterable[Events], hot: np.ndarray) -> Iterator[Events]:
    """Drops the events of hot pixels; hot: (H, W) bool.

    They are dropped before the recording is cut into windows, so a window of N events holds N
    useful ones. (The original program cuts first and blanks the pixels afterwards.)
    """
    for events in chunks:
        kept = events.select(~hot[events.y, events.x])
        if len(kept):
            yield kept


def rotated(chunks: Iterable[Events], height: int, width: int) -> Iterator[Events]:
    """Rotates the picture by 180 degrees, for cameras that are mounted upside down."""
    for events in chunks:
        yield replace(events, x=width - 1 - events.x, y=height - 1 - events.y)


def find_hot_pixels(recording: Recording, most: int = LEARN_FROM) -> np.ndarray:
    """Recording -> (H, W) bool: the hot pixels, found in the first events.

    A hot pixel fires alone: at least 10 times as often as the median of its 5x5 neighbourhood, and
    more often than chance allows (6 standard deviations above the mean of the other active pixels,
    which are not hot; at least 10 events). A moving edge makes neighbouring pixels fire too.
    most: number of events to read.
    """
    counts = np.zeros(recording.pixels, np.int64)
    seen = 0
    for events in until_damage(recording.events()):
        counts += np.bincount(events.flat_index(recording.width), minlength=counts.size)
        seen += len(events)
        if seen >= most:
            break
    return hot_pixels_of(counts.reshape(recording.height, recording.width))


def hot_pixels_of(counts: np.ndarray) -> np.ndarray:
    """(H, W) event counts -> (H, W) bool, by the rule of `find_hot_pixels`."""
    hot = counts >= 10 * np.maximum(median_filter(counts, size=5, mode="reflect"), 1)
    while True:  # fewer each time; where few pixels are active the hot ones would set the mean
        others = counts[(counts > 0) & ~hot]
        others = others if others.size else counts[counts > 0]  # all stand alone
        if others.size == 0:
            return hot
        usual = hot & (counts <= others.mean() + 6 * others.std())
        if not usual.any():
            return hot
        hot &= ~usual


def read_hot_pixels(path: str | Path, height: int, width: int) -> np.ndarray:
    """A text file with one `x,y` per line -> (H, W) bool, the format of rpg_e2vid; its first line
    may be these names.

    Raises RecordingError, which names the invalid line.
    """
    path = Path(path)
    hot = np.zeros((height, width), bool)
    for number, line in enumerate(read_lines(path, "list of hot pixels"), 1):
        if not line.strip() or number == 1 and "".join(line.lower().split()) == "x,y":
            continue
        try:
            x, y = (int(word) for word in line.split(","))
        except ValueError:
            raise RecordingError(
                f"{path}, line {number}: expected two whole numbers `x,y`, found {line[:40]!r}"
            ) from None
        if not (0 <= x < width and 0 <= y < height):
            raise RecordingError(
                f"{path}, line {number}: pixel {x},{y} is outside the sensor of {width}x{height}"
            )
        hot[y, x] = True
    return hot
