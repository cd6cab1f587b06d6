"""Cameras' own files -> Source, through faery: .raw (EVT2, EVT2.1, EVT3), .es.

    .raw      Prophesee: lines of text that start with %, then words of 32, 64 or 16 bits; the size
              of the sensor is taken from the header only (faery guesses 1280x720 without)
    .es       Event Stream: 5 bytes an event, rows counted from the bottom (faery turns them round)

Edges at trigger inputs are read without faery, which skips them (evt2.py, evt3.py; those of EVT2.1
are not read). Times are microseconds. faery clamps a time that falls below an earlier one to that
one. A .raw or .es file that was cut off between two words looks whole: neither says how
long it is.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import numpy as np

from firenet_jax.errors import RecordingError
from firenet_jax.events import Events, Rows, Triggers
from firenet_jax.readers import (
    CHUNK,
    Source,
    all_triggers,
    evt2,
    evt3,
    extra,
    joined,
    to_events,
)
from firenet_jax.readers.dat import header_size, read_header

FORMATS = {".raw": "Prophesee raw", ".es": "Event Stream"}
WORD = {"2": 4, "2.0": 4, "2.1": 8, "21": 8, "3": 2, "3.0": 2}  # EVT version: bytes of a word
# of triggers, by EVT version: function, state at the beginning, type of a word
DECODERS = {
    "2": (evt2.triggers, -1, np.dtype("<u4")),
    "3": (evt3.triggers, evt3.State(), np.dtype("<u2")),
}
LARGEST = (2048, 2048)  # what EVT's 11 bits reach, so that faery refuses nothing


def matches(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in FORMATS


def read(path: Path) -> Source:
    kind = path.suffix.lower()
    faery = extra("faery", path)
    name, cut, version, start = FORMATS[kind], False, "", 0
    if kind == ".raw":
        name, size, cut, version, start = _raw_header(path)
    else:
        with _guarded(path):
            width, height = faery.events_stream_from_file(path).dimensions()
        size = (height, width)
    return Source(
        name,
        lambda: joined(_events(faery, path, cut)),
        size,
        grey=kind == ".raw",
        triggers=lambda: _triggers(path, version[:1] if WORD.get(version) != 8 else "", start),
    )


def _raw_header(path: Path) -> tuple[str, tuple[int, int] | None, bool, str, int]:
    """-> "Prophesee raw (EVT3)", (height, width) where the header states it, whether the last word
    is cut off, the EVT version, where words begin, bytes from the beginning of the file"""
    with open(path, "rb") as file:
        header = read_header(file)
        start = file.tell()
    version = re.search(r"^% (?:evt |format EVT)(\d(?:\.?\d)?)", header, re.M | re.I)
    if version is None or version[1] not in WORD:
        raise RecordingError(
            f"{path}: its header names no EVT version of 2.0, 2.1 or 3.0: the file is damaged or "
            "of another format"
        )
    cut = (path.stat().st_size - start) % WORD[version[1]] > 0
    name = f"Prophesee raw (EVT{version[1].removesuffix('.0')})"
    return name, header_size(header), cut, version[1], start


def _triggers(path: Path, version: str, start: int) -> Triggers | None:
    """version: "2" or "3"; of any other no triggers are read."""
    if version not in DECODERS:
        return None
    decode, state, kind = DECODERS[version]

    def pieces():
        now = state
        with open(path, "rb") as file:
            file.seek(start)
            while data := file.read(CHUNK * kind.itemsize):
                words = np.frombuffer(data, kind, len(data) // kind.itemsize)
                now, edges = decode(now, words)
                yield edges

    return all_triggers(pieces())


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


def _events(faery: ModuleType, path: Path, cut: bool) -> Iterator[Events | Rows]:
    row = 0
    with _guarded(path):
        stream = iter(faery.events_stream_from_file(path, dimensions_fallback=LARGEST))
    while True:
        with _guarded(path):
            packet = next(stream, None)
        if packet is None:
            break
        yield to_events(path, row, packet["t"], packet["x"], packet["y"], packet["on"])
        row += len(packet)
    if cut:
        raise RecordingError(
            f"{path}: ends within a word: the file is cut off: copy or download it again"
        )
