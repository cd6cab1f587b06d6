"""Payloads of ROS's driver for iniVation's cameras -> columns: event_camera_msgs' encodings

libcaer        8 bytes an event: uint32 polarity (bit 1), y (2-16), x (17-31), int32 microseconds
libcaer_cmp    16 bits a word, much as EVT3 with rows and columns exchanged:

    bits 15-12   bits 11-0
    0  time high    bits 23-12 of the time, microseconds
    1  time low     bits 11-0 of the time
    2  column       x (bits 10-0)
    3  event        polarity (bit 11), y (bits 10-0)
    4  vector base  polarity (bit 11), y (bits 10-0) of the vectors that follow
    5  vector of 8  bit i: an event at base + i; then the base moves on by 8

Times are relative to the time_base of their message; in libcaer_cmp time high and time low are 0 at
the beginning of each message. event_camera_codecs decodes them in the same way.
"""

from typing import NamedTuple

import numpy as np

from firenet_jax.readers import unwrap
from firenet_jax.readers.vectors import Base, expand

EVENT = np.dtype([("data", "<u4"), ("t", "<i4")])


class State(NamedTuple):
    """What a message leaves to the next one; -1: not known yet."""

    x: int = -1
    base: Base = Base()  # in rows


def decode(
    state: State, words: np.ndarray, starts: np.ndarray, time_bases: np.ndarray
) -> tuple[State, tuple[np.ndarray, ...]]:
    """M messages of libcaer_cmp -> state after them, (t, x, y, p): int64 microseconds, column, row,
    0 or 1. Events before the first column or base are left out: their place is unknown.

    words: (N,) uint16 of all messages; starts: (M,) index of each message's first word;
    time_bases: (M,) int64 microseconds."""
    kind, load = words >> 12, (words & 0xFFF).astype(np.int64)
    place = np.arange(len(words))
    message = np.searchsorted(starts, place, side="right") - 1
    time = np.zeros(len(words), np.int64)
    for code, shift in ((0, 12), (1, 0)):
        last = np.maximum.accumulate(np.where(kind == code, place, -1))
        time += np.where(last >= starts[message], load[last] << shift, 0)
    time += time_bases[message]

    is_column = kind == 2
    columns = np.append(state.x, load[is_column] & 0x7FF)
    x = columns[np.cumsum(is_column)]

    width = np.where(kind == 5, 8, 0)
    base, (word, y, on) = expand(state.base, load, kind == 4, kind == 3, width, x >= 0)
    return State(int(columns[-1]), base), (time[word], x[word], y, on)


def fields(data: np.ndarray) -> tuple[np.ndarray, ...]:
    """(N,) uint32 of events -> (x, y, p): column, row, 0 or 1."""
    return data >> 17, data >> 2 & 0x7FFF, data >> 1 & 1


def decode_plain(payload: bytes, time_base: int) -> tuple[np.ndarray, ...]:
    """A message of libcaer, its time_base in microseconds -> (t, x, y, p), as above."""
    events = np.frombuffer(payload, EVENT, len(payload) // EVENT.itemsize)
    data, t = events["data"], events["t"].astype(np.int64)
    t = time_base + (unwrap(t, 31, int(t[0])) if t.size else t)
    return t, *fields(data)
