"""Cameras' own files -> Source, through faery: .raw (EVT2, EVT2.1, EVT3), .es.

    .raw      Prophesee: lines of text that start with %, then words of 32, 64 or 16 bits; the size
              of the sensor is taken from the header only (faery guesses 1280x720 without)
    .es       Event Stream: 5 bytes an event, rows counted from the bottom (faery turns them round)

EVT2.1 and edges at trigger inputs are read without faery, which knows neither (evt2.py, evt21.py,
evt3.py). Times are microseconds. faery clamps a time that falls below an earlier one to that
one. The times of an EVT3 file that begins within 8 ms of its clock's end are wrong by up to 16.8 s
in faery 0.7, so that such a file is read without it, too. A .raw or .es file that was cut off
between two words looks whole: neither says how long it is.
"""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from firenet_jax.errors import RecordingError
from firenet_jax.readers import (
    CHUNK,
    Source,
    all_triggers,
    evt2,
    evt3,
    evt21,
    extra,
    joined,
    to_chunks,
)
from firenet_jax.readers.dat import header_size, read_header

FORMATS = {".raw": "Prophesee raw", ".es": "Event Stream"}
WORD = {"2": 4, "2.0": 4, "2.1": 8, "21": 8, "3": 2, "3.0": 2}  # EVT version: bytes of a word
EVT2, EVT3, EVT21 = np.dtype("<u4"), np.dtype("<u2"), np.dtype("<u8")
# By EVT version: function, state at the beginning, type of a word, words at once.
EVENTS = {
    "2": (evt2.decode, -1, EVT2, CHUNK),
    "2.1 legacy": (partial(evt21.decode, True), (-1, -1), EVT21, CHUNK // 32 + 1),
    "2.1": (partial(evt21.decode, False), (-1, -1), EVT21, CHUNK // 32 + 1),  # of up to 32
    "3": (evt3.decode, evt3.State(), EVT3, CHUNK // 12 + 1),  # of up to 12 events
}
TRIGGERS = {
    "2": (evt2.triggers, -1, EVT2, CHUNK),
    "2.1 legacy": (partial(evt21.triggers, True), -1, EVT21, CHUNK),
    "2.1": (partial(evt21.triggers, False), -1, EVT21, CHUNK),
    "3": (evt3.triggers, evt3.State(), EVT3, CHUNK),
}
LATE = 4094  # from here on faery takes the first time high of an EVT3 file for a fall from 0
LARGEST = (2048, 2048)  # what EVT's 11 bits reach, so that faery refuses nothing

Columns = tuple[np.ndarray, ...]  # t, x, y, p; of triggers: times, ids, polarity


def matches(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in FORMATS


def read(path: Path) -> Source:
    kind = path.suffix.lower()
    faery = extra("faery", path)
    name, left, version, start = FORMATS[kind], 0, "", 0
    if kind == ".raw":
        name, size, left, version, start = _raw_header(path)
    else:
        with _guarded(path):
            width, height = faery.events_stream_from_file(path).dimensions()
        size = (height, width)

    def columns() -> Iterator[Columns]:
        own = partial(_decoded, path, start, *EVENTS[version]) if version in EVENTS else None
        unread = version.startswith("2.1") or version == "3" and _first_high(path, start) >= LATE
        if own is not None and unread:
            return own()
        return _of_faery(faery, path, own)

    return Source(
        name,
        lambda: joined(to_chunks(path, columns(), left, "a word")),
        size,
        grey=kind == ".raw",
        triggers=lambda: all_triggers(
            _decoded(path, start, *TRIGGERS[version]) if version in TRIGGERS else ()
        ),
    )


def _raw_header(path: Path) -> tuple[str, tuple[int, int] | None, int, str, int]:
    """-> "Prophesee raw (EVT3)", (height, width) where the header states it, bytes of a last word
    that is cut off, a key of `EVENTS`, where words begin, bytes from the beginning of the file"""
    with open(path, "rb") as file:
        header = read_header(file)
        start = file.tell()
    version = re.search(r"^% (?:evt |format EVT)(\d(?:\.?\d)?)", header, re.M | re.I)
    if version is None or version[1] not in WORD:
        raise RecordingError(
            f"{path}: its header names no EVT version of 2.0, 2.1 or 3.0: the file is damaged or "
            "of another format"
        )
    left = (path.stat().st_size - start) % WORD[version[1]]
    known = "2.1" if WORD[version[1]] == 8 else version[1][0]
    name = f"Prophesee raw (EVT{known})"
    if known == "2.1":
        some = next(_words(path, start, EVT21, CHUNK), np.zeros(0, EVT21))
        known = "2.1 legacy" if evt21.is_legacy(header, some) else known
    return name, header_size(header), left, known, start


def _decoded(
    path: Path, start: int, decode: Callable, state: Any, kind: np.dtype, most: int
) -> Iterator[Columns]:
    """What `decode` makes of the words of a file, so many at a time."""
    for words in _words(path, start, kind, most):
        state, columns = decode(state, words)
        yield columns


def _words(path: Path, start: int, kind: np.dtype, most: int) -> Iterator[np.ndarray]:
    """The words of a file, so many at a time; without a last one that is cut off."""
    with open(path, "rb") as file:
        file.seek(start)
        while data := file.read(most * kind.itemsize):
            yield np.frombuffer(data, kind, len(data) // kind.itemsize)


@contextmanager
def _guarded(path: Path):
    """Turns what faery raises into a RecordingError; a panic of its Rust code is no Exception."""
    try:
        yield
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise RecordingError(
            f"{path}: cannot be read ({' '.join(str(error).split())}): the file is damaged, "
            "incomplete or of another format: copy or download it again"
        ) from error


def _of_faery(
    faery: ModuleType, path: Path, own: Callable[[], Iterator[Columns]] | None = None
) -> Iterator[Columns]:
    """own: reads the same events without faery, which ends at the first one outside the sensor that
    the header names."""
    seen, last = 0, 0
    with _guarded(path):
        stream = iter(faery.events_stream_from_file(path, dimensions_fallback=LARGEST))
    while True:
        try:
            with _guarded(path):
                packet = next(stream, None)
        except RecordingError as error:
            if own is None or " overflow (" not in str(error):
                raise
            for columns in own():  # `events.checked` judges those outside
                skip = min(seen, len(columns[0]))
                seen -= skip
                t, x, y, p = (column[skip:] for column in columns)
                yield np.maximum(t, last), x, y, p
            return
        if packet is None:
            return
        if not len(packet):  # of an Event Stream whose bytes held no event
            continue
        yield packet["t"], packet["x"], packet["y"], packet["on"]
        seen, last = seen + len(packet), int(packet["t"][-1])


def _first_high(path: Path, start: int) -> int:
    """The first time high of an EVT3 file, 0 where none is among its first words."""
    words = next(_words(path, start, EVT3, CHUNK), np.zeros(0, EVT3))
    highs = words[words >> 12 == 0x8]
    return int(highs[0]) & 0xFFF if len(highs) else 0
