"""N-Caltech101 and N-MNIST .bin -> Source: 40 bits an event, big-endian, nothing else in the file.

    byte 0      column
    byte 1      row
    byte 2      bit 7: polarity, 1 is ON; bits 6 to 0: bits 22 to 16 of the time
    bytes 3, 4  bits 15 to 0 of the time, microseconds

Row 240 lies below the sensor (ATIS, 304x240): such an entry is no event but an overflow of the
timer, which adds 2^13 microseconds to its own time and all later ones, as in the data set's reader.
The file names no sensor size.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from firenet_jax.errors import RecordingError
from firenet_jax.readers import CHUNK, Source, to_chunks

OVERFLOW_ROW = 240
OVERFLOW = 2**13  # microseconds


def matches(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() == ".bin"


def read(path: Path) -> Source:
    size = path.stat().st_size
    # an ATIS, and so grey
    return Source("N-Caltech101", lambda: to_chunks(path, _columns(path, size)), grey=True)


def _columns(path: Path, size: int) -> Iterator[tuple]:
    overflows = 0
    with open(path, "rb") as file:
        # Not to the end: a file that is still being written may end within an event by now.
        while data := file.read(min(5 * CHUNK, size - size % 5 - file.tell())):
            x, y, high, middle, low = np.frombuffer(data, np.uint8).reshape(-1, 5).T
            t = (high & 0x7F).astype(np.int64) << 16 | middle.astype(np.int64) << 8 | low
            is_overflow = y == OVERFLOW_ROW
            t += OVERFLOW * (overflows + np.cumsum(is_overflow))
            overflows += int(is_overflow.sum())
            yield tuple(column[~is_overflow] for column in (t, x, y, high >> 7))
    if size % 5:
        raise RecordingError(
            f"{path}: has {size} bytes, expected a multiple of 5: the file is cut off or of "
            "another format"
        )
