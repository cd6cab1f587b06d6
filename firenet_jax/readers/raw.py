"""Prophesee raw -> Source: lines of text that start with %, then words of 32, 64 or 16 bits.

% evt 3.0              or % format EVT3;height=720;width=1280: what the words are
% geometry 1280x720    the sensor, which may be missing
% t0 1000000           microseconds to be added, in files that faery wrote: their clock starts at 0
words                  of EVT2 (evt2.py), EVT2.1 (evt21.py) or EVT3 (evt3.py)

Times are microseconds of the sensor's clock. No library reads them: faery 0.7 knows no EVT2.1 and
no triggers, gives what precedes the first time high the time 0, takes every fall of EVT2's time
high for the end of its clock, and stands still for up to 16.8 s where EVT3's time high leaves out
one of the two values at the end of its own. A file that was cut off between two words looks whole:
it does not say how long it is.
"""

import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from firenet_jax.errors import RecordingError
from firenet_jax.readers import CHUNK, Source, all_triggers, evt2, evt3, evt21, joined, to_chunks
from firenet_jax.readers.dat import header_size, read_header

WORD = {"2": 4, "2.0": 4, "2.1": 8, "21": 8, "3": 2, "3.0": 2}  # EVT version: bytes of a word
EVT2, EVT3, EVT21 = np.dtype("<u4"), np.dtype("<u2"), np.dtype("<u8")
# By EVT version: function, state at the beginning, type of a word, words at once.
EVENTS = {
    "2": (evt2.decode, evt2.State(), EVT2, CHUNK),
    "2.1 legacy": (partial(evt21.decode, True), evt2.State(), EVT21, CHUNK // 32 + 1),
    "2.1": (partial(evt21.decode, False), evt2.State(), EVT21, CHUNK // 32 + 1),  # of up to 32
    "3": (evt3.decode, evt3.State(), EVT3, CHUNK // 12 + 1),  # of up to 12 events
}
TRIGGERS = {
    "2": (evt2.triggers, evt2.State(), EVT2, CHUNK),
    "2.1 legacy": (partial(evt21.triggers, True), evt2.State(), EVT21, CHUNK),
    "2.1": (partial(evt21.triggers, False), evt2.State(), EVT21, CHUNK),
    "3": (evt3.triggers, evt3.State(), EVT3, CHUNK),
}

Columns = tuple[np.ndarray, ...]  # t, x, y, p; of triggers: times, ids, polarity


class Header(NamedTuple):
    """What the lines of text say."""

    version: str  # a key of `EVENTS`
    size: tuple[int, int] | None  # (height, width)
    start: int  # where words begin, bytes from the beginning of the file
    left: int  # bytes of a last word that is cut off
    t0: int | None  # microseconds


def matches(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() == ".raw"


def read(path: Path) -> Source:
    header = _header(path)
    return Source(
        f"Prophesee raw (EVT{header.version.split()[0]})",
        lambda: joined(to_chunks(path, _decoded(path, header, EVENTS), header.left, "a word")),
        header.size,
        grey=True,
        triggers=lambda: all_triggers(_decoded(path, header, TRIGGERS)),
    )


def _header(path: Path) -> Header:
    with open(path, "rb") as file:
        text = read_header(file)
        start = file.tell()
    version = re.search(r"^% (?:evt |format EVT)(\d(?:\.?\d)?)", text, re.M | re.I)
    if version is None or version[1] not in WORD:
        raise RecordingError(
            f"{path}: its header names no EVT version of 2.0, 2.1 or 3.0: the file is damaged or "
            "of another format"
        )
    left = (path.stat().st_size - start) % WORD[version[1]]
    known = "2.1" if WORD[version[1]] == 8 else version[1][0]
    if known == "2.1":
        some = next(_words(path, start, EVT21, CHUNK), np.zeros(0, EVT21))
        known = "2.1 legacy" if evt21.is_legacy(text, some) else known
    t0 = re.search(r"^% t0 (\d{1,18})\s*$", text, re.M)
    return Header(known, header_size(text), start, left, None if t0 is None else int(t0[1]))


def _decoded(path: Path, header: Header, decoders: dict[str, tuple]) -> Iterator[Columns]:
    """What the decoder of these words makes of them, so many at a time."""
    decode: Callable
    state: Any
    decode, state, kind, most = decoders[header.version]
    if header.t0 is not None and header.version == "3":
        state = state._replace(time=0, high=0)  # its first events come before any time
    for words in _words(path, header.start, kind, most):
        state, (t, *others) = decode(state, words)
        yield t + (header.t0 or 0), *others


def _words(path: Path, start: int, kind: np.dtype, most: int) -> Iterator[np.ndarray]:
    """The words of a file, so many at a time; without a last one that is cut off."""
    with open(path, "rb") as file:
        file.seek(start)
        while data := file.read(most * kind.itemsize):
            yield np.frombuffer(data, kind, len(data) // kind.itemsize)
