"""EVT2.1 words -> events: those of EVT2 for up to 32 pixels of a row at once, 64 bits each.

One half is a word of EVT2 (evt2.py), whose x is that of the first pixel. Of an event the other half
says which pixels it is of: bit i, that at x + i. Which half comes first depends on the sensor, and
headers say it as `endianness`: the word of EVT2 in files of Gen4.1, IMX636 and IMX646 ("legacy"),
the pixels in those of later ones ("little"). Where a header says nothing, the words do.
"""

import re

import numpy as np

from firenet_jax.readers import evt2

KINDS = (0x0, 0x1, 0x8, 0xA, 0xE, 0xF)  # of words of EVT2


def is_legacy(header: str, words: np.ndarray) -> bool:
    """What the header says; else whether more of the first halves of (N,) uint64 than of the second
    are words of EVT2, which all are in one and few in the other."""
    if said := re.search(r"endianness[ =](legacy|little)", header):
        return said[1] == "legacy"
    first, second = (np.isin(half >> 28, KINDS).sum() for half in _halves(True, words))
    return bool(first >= second)


def decode(
    legacy: bool, state: evt2.State, words: np.ndarray
) -> tuple[evt2.State, tuple[np.ndarray, ...]]:
    """As `evt2.decode`, of (N,) uint64."""
    heads, pixels = _halves(legacy, words)
    state, columns = evt2.decode(state, heads)
    pixels = pixels[heads >> 28 < 2]
    pixels = pixels[len(pixels) - len(columns[0]) :]  # without those before the first time high
    event, bit = np.nonzero(pixels[:, None] >> np.arange(32, dtype=np.uint32) & 1)
    t, x, y, p = (column[event] for column in columns)
    return state, (t, x + bit, y, p)


def triggers(
    legacy: bool, state: evt2.State, words: np.ndarray
) -> tuple[evt2.State, tuple[np.ndarray, ...]]:
    """As `evt2.triggers`, of (N,) uint64."""
    return evt2.triggers(state, _halves(legacy, words)[0])


def _halves(legacy: bool, words: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> the words of EVT2, the pixels; (N,) uint32 each."""
    low, high = words.view("<u4").reshape(-1, 2).T
    return (low, high) if legacy else (high, low)
