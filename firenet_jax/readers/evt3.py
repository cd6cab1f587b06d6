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

from typing import NamedTuple

import numpy as np

from firenet_jax.readers import unwrap

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
    base: int = -1  # column of the next vector's bit 0
    base_on: int = 0  # polarity of the next vector


def decode(state: State, words: np.ndarray) -> tuple[State, tuple[np.ndarray, ...]]:
    """(N,) uint16 -> state after them, (t, x, y, p): int64 microseconds, column, row, 0 or 1.

    Events before the first complete time, row or base are left out: their place is unknown.
    """
    kind, load = words >> 12, (words & 0xFFF).astype(np.int64)
    time, times, high = _times(state, kind, load)

    is_row = kind == 0x0
    rows = np.append(state.y, load[is_row] & 0x7FF)
    y = rows[np.cumsum(is_row)]

    is_base = kind == 0x3
    base = np.cumsum(is_base)
    starts = np.append(state.base, load[is_base] & 0x7FF)
    polarities = np.append(state.base_on, load[is_base] >> 11)
    moved = np.cumsum(np.select([kind == 0x4, kind == 0x5], [12, 8], 0))
    moved -= np.append(0, moved[is_base])[base]  # since the base was set, this word included
    widths = np.where(kind == 0x5, 8, 12)

    single = kind == 0x2
    vector = (kind == 0x4) | (kind == 0x5)
    known = (time >= 0) & (y >= 0)
    entries = np.flatnonzero(known & (single | vector & (starts[base] >= 0)))
    # A single event is a vector with one bit, at its own x.
    single, base = single[entries], base[entries]
    first = np.where(single, load[entries] & 0x7FF, starts[base] + moved[entries] - widths[entries])
    on = np.where(single, load[entries] >> 11, polarities[base])
    bits = np.where(single, 1, load[entries] & (1 << widths[entries]) - 1)
    entry, bit = np.nonzero(bits[:, None] >> np.arange(12) & 1)

    t = time[entries][entry]
    latest = np.maximum.accumulate(np.append(state.latest, t))
    t = np.where(latest[1:] - t <= JITTER, latest[1:], t)
    next_base = starts[-1] + (moved[-1] if words.size and starts[-1] >= 0 else 0)
    state = State(*map(int, (times[-1], latest[-1], high, rows[-1], next_base, polarities[-1])))
    return state, (t, first[entry] + bit, y[entries][entry], on[entry])


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
