"""Words of single events and of vectors -> events: what EVT3 and libcaer_cmp have in common

Both set a base, and let each vector say which of the next 8 or 12 places have an event; then the
base moves on. EVT3's vectors lie along a row, libcaer_cmp's along a column. There is no loop over
words: the running count of the bases (cumsum) is, at each word, the index of the last one so far.
"""

from typing import NamedTuple

import numpy as np


class Base(NamedTuple):
    """Where the next vector's bit 0 lies (-1: not known yet), and its polarity."""

    place: int = -1
    on: int = 0


def expand(
    base: Base, load: np.ndarray, sets: np.ndarray, single: np.ndarray, width: np.ndarray, known
) -> tuple[Base, tuple[np.ndarray, ...]]:
    """(N,) words' loads of 12 bits -> the base after them, (word, place, polarity) of each event.

    sets, single: bool, whether a word sets the base (place in bits 10-0, polarity in bit 11) or is
    an event itself (the same bits); width: places that a word's vector has, 0 for other words;
    known: bool, whether the rest of a word's events is known. Vectors before the first base, and
    words that are not known, give no events."""
    latest = np.cumsum(sets)
    starts = np.append(base.place, load[sets] & 0x7FF)
    polarities = np.append(base.on, load[sets] >> 11)
    moved = np.cumsum(width)
    moved -= np.append(0, moved[sets])[latest]  # since the base was set, this word included

    end = moved[-1] if moved.size else 0
    words = np.flatnonzero(known & (single | (width > 0) & (starts[latest] >= 0)))
    load, single, latest, width = load[words], single[words], latest[words], width[words]
    vector = np.flatnonzero(~single)
    first, on, count = load & 0x7FF, load >> 11, np.ones(words.shape, int)
    first[vector] = (starts[latest] + moved[words] - width)[vector]
    on[vector] = polarities[latest[vector]]
    mask = (load[vector] & (1 << width[vector]) - 1).astype("<u2")
    bits = np.unpackbits(mask.view(np.uint8), bitorder="little")
    count[vector] = bits.reshape(-1, 16).sum(1)
    word = np.repeat(np.arange(len(words)), count)
    bit = np.zeros(word.shape, int)
    bit[~single[word]] = np.flatnonzero(bits) & 15

    place = starts[-1] + (end if starts[-1] >= 0 else 0)
    return Base(int(place), int(polarities[-1])), (words[word], first[word] + bit, on[word])
