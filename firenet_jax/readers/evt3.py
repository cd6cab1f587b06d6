"""EVT3 words -> columns: the compressed event stream of Prophesee's sensors, 16 bits a word.

    bits 15-12   bits 11-0
    0x0  row            y (bits 10-0; bit 11 tells stereo cameras apart)
    0x2  event          polarity (bit 11), x (bits 10-0)
    0x3  vector base    polarity (bit 11), x (bits 10-0) of the vectors that follow
    0x4  vector of 12   bit i: an event at base + i; then the base moves on by 12
    0x5  vector of 8    bit i: an event at base + i; then the base moves on by 8
    0x6  time low       bits 11-0 of the time, microseconds
    0x8  time high      bits 23-12 of the time, which wraps around to 0 after 16.8 s
    0xA  trigger        input (bits 11-8), edge (bit 0): 1 rises
    others              vendor's data: no events

A word changes what it names and leaves the rest, so a stream that comes in pieces needs the state
between them. There is no loop over words: the running count of the words of a kind (cumsum) is, at
each word, the index of the last one so far.
"""

import itertools
from typing import NamedTuple

import numpy as np

from firenet_jax.readers import unwrap
from firenet_jax.readers.vectors import Base, expand

# Sensors fall back to a slightly older time now and then. Falls of up to ten steps of time high are
# raised to the latest time; the ROS driver's decoder does not take those for a wrap-around either.
# Larger ones are damage, and stay for `events.checked` to judge.
JITTER = 10 << 12  # microseconds


class State(NamedTuple):
    """What a piece leaves to the next one; -1: not known yet."""

    time: int = -1  # microseconds, unwrapped
    latest: int = -1  # the largest time of all events
    high: int = -1  # the last time high, unwrapped
    y: int = -1
    base: Base = Base()  # in columns


def decode(state: State, words: np.ndarray) -> tuple[State, tuple[np.ndarray, ...]]:
    """(N,) uint16 -> state after them, (t, x, y, p): int64 microseconds, column, row, 0 or 1.

    Events before the first complete time, row or base are left out: their place is unknown.
    """
    kind, load = words >> 12, (words & 0xFFF).astype(np.int64)
    time, times, high = _times(state, kind, load)

    is_row = kind == 0x0
    rows = np.append(state.y, load[is_row] & 0x7FF)
    y = rows[np.cumsum(is_row)]

    width = np.select([kind == 0x4, kind == 0x5], [12, 8], 0)
    known = (time >= 0) & (y >= 0)
    base, (word, x, on) = expand(state.base, load, kind == 0x3, kind == 0x2, width, known)

    latest, t = without_jitter(state.latest, time[word])
    state = State(int(times[-1]), latest, high, int(rows[-1]), base)
    return state, (t, x, y[word], on)


def without_jitter(latest: int, t: np.ndarray) -> tuple[int, np.ndarray]:
    """The latest time before them, (N,) int64 -> the latest one, the times without small falls. A
    larger fall from which they do not come back begins anew: what preceded it was damaged."""
    highest = np.append(latest, t)
    falls = np.flatnonzero(np.diff(highest) < -JITTER) + 1
    to_come = np.maximum.accumulate(highest[::-1])[::-1]
    for start, stop in itertools.pairwise([0, *falls.tolist(), len(highest)]):
        part = highest[start:stop]
        if start and to_come[start] >= highest[start - 1] - JITTER:
            part[0] = max(part[0], highest[start - 1])
        np.maximum.accumulate(part, out=part)
    return int(highest[-1]), np.where(highest[1:] - t <= JITTER, highest[1:], t)


def triggers(state: State, words: np.ndarray) -> tuple[State, tuple[np.ndarray, ...]]:
    """(N,) uint16 -> state after them, of which only the time counts, (times, ids, polarity) of
    the edges at the trigger inputs: int64 microseconds, input, 0 or 1. Edges before the first
    complete time are left out."""
    kind, load = words >> 12, (words & 0xFFF).astype(np.int64)
    time, times, high = _times(state, kind, load)
    edges = np.flatnonzero((kind == 0xA) & (time >= 0))
    state = state._replace(time=int(times[-1]), high=high)
    return state, (time[edges], load[edges] >> 8, load[edges] & 1)


def _times(state: State, kind: np.ndarray, load: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """-> the time at every word, -1 before the first; all times in order, from that of `state` on;
    the last time high, unwrapped"""
    clock = np.flatnonzero((kind == 0x6) | (kind == 0x8))
    is_high = kind[clock] == 0x8
    highs = load[clock[is_high]]
    highs = np.append(state.high, unwrap(highs, 12, max(state.high, 0)))
    now = np.cumsum(is_high)
    high = highs[now]
    # Time low is 0 where time high moves on; a repetition of time high changes nothing. The first
    # time high of all tells no time before a time low comes.
    moves = is_high & (high != highs[np.maximum(now - 1, 0)]) & (now > (state.high < 0))
    says = moves | ~is_high & (high >= 0)
    told = (high << 12) + np.where(is_high, 0, load[clock])
    times = np.append(state.time, told[says])
    at = np.zeros(kind.shape, np.int64)
    at[clock[says]] = 1
    return times[np.cumsum(at)], times, int(highs[-1])
