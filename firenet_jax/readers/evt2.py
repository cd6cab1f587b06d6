"""EVT2 words -> events, edges at trigger inputs: Prophesee's plain stream, 32 bits each.

bits 31-28   bits 27-0
0x0, 0x1  event      low time (bits 27-22), x (21-11), y (10-0)
0x8  time high       bits 33-6 of the time, microseconds, which wraps around after 4.8 hours
0xA  trigger         low time (bits 27-22), input (12-8), edge (bit 0): 1 rises
others               vendor's data
"""

from typing import NamedTuple

import numpy as np

from firenet_jax.readers import evt3, unwrap


class State(NamedTuple):
    """What a piece leaves to the next one; -1: not known yet."""

    high: int = -1  # the last time high, unwrapped
    latest: int = -1  # the largest time of all events


def decode(state: State, words: np.ndarray) -> tuple[State, tuple[np.ndarray, ...]]:
    """(N,) uint32 -> state after them, (t, x, y, p) int64: microseconds, column, row, 0 or 1.

    Events before the first time high are left out: their place in time is unknown.
    """
    high, t, kind, load = _timed(state.high, words, 0x0, 0x1)
    latest, t = evt3.without_jitter(state.latest, t)
    return State(high, latest), (t, load >> 11 & 0x7FF, load & 0x7FF, kind)


def triggers(state: State, words: np.ndarray) -> tuple[State, tuple[np.ndarray, ...]]:
    """(N,) uint32 -> state after them, of which only time high counts, (times, ids, polarity)
    int64: microseconds, input, 0 or 1. Edges before the first time high are left out."""
    high, t, _, load = _timed(state.high, words, 0xA)
    return state._replace(high=high), (t, load >> 8 & 0x1F, load & 1)


def _timed(high: int, words: np.ndarray, *kinds: int):
    """The time high after them; times, kinds and loads of the words of these kinds."""
    kind, load = words >> 28, (words & 0xFFFFFFF).astype(np.int64)
    is_high = kind == 0x8
    highs = np.append(high, unwrap(load[is_high], 28, max(high, 0)))
    now = highs[np.cumsum(is_high)]
    at = np.flatnonzero(np.isin(kind, kinds) & (now >= 0))
    return int(highs[-1]), (now[at] << 6) + (load[at] >> 22), kind[at], load[at]
