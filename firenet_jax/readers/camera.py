"""Cameras' own files -> Source, through faery: .raw (EVT2, EVT2.1, EVT3), .aedat4, .es.

    .raw      Prophesee: lines of text that start with %, then words of 32, 64 or 16 bits; the size
              of the sensor is taken from the header only (faery guesses 1280x720 without)
    .aedat4   iniVation: packets of events and frames, compressed; frames are at mid-exposure
    .es       Event Stream: 5 bytes an event, rows counted from the bottom (turned round here)

Times are microseconds. faery holds back a time that falls below an earlier one to that one. A .raw
or .es file that was cut off between two words looks whole: neither says how long it is.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from types import ModuleType

import numpy as np

from firenet_jax.events import Events, Frames, RecordingError
from firenet_jax.readers import Source, extra, joined, to_events, to_frame
from firenet_jax.readers.dat import header_size, read_header

FORMATS = {".raw": "Prophesee raw", ".aedat4": "AEDAT4", ".es": "Event Stream"}
WORD = {"2": 4, "2.0": 4, "2.1": 8, "21": 8, "3": 2, "3.0": 2}  # version: bytes
LARGEST = (2048, 2048)  # what EVT's 11 bits reach, so that faery refuses nothing


def matches(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in FORMATS


def read(path: Path) -> Source:
    kind = path.suffix.lower()
    faery = extra("faery", path)
    frames, name = None, FORMATS[kind]
    if kind == ".raw":
        name, size = _raw_header(path)
    else:
        if kind == ".aedat4":
            _check_xml(path)
        with _guarded(path):
            width, height = faery.events_stream_from_file(path).dimensions()
        size = (height, width)
        if kind == ".aedat4":
            frames = _frames(faery, path)
    return Source(name, lambda: joined(_events(faery, path)), size, frames=frames)


def _raw_header(path: Path) -> tuple[str, tuple[int, int] | None]:
    """-> "Prophesee raw EVT3", (height, width) where the header says it"""
    with open(path, "rb") as file:
        header = read_header(file)
        start = file.tell()
    version = re.search(r"^% (?:evt |format EVT)(\d(?:\.?\d)?)", header, re.M | re.I)
    if version is None or version[1] not in WORD:
        raise RecordingError(
            f"{path}: its header names no EVT version of 2.0, 2.1 or 3.0: the file is damaged or "
            "of another format"
        )
    if (path.stat().st_size - start) % WORD[version[1]]:
        raise RecordingError(
            f"{path}: ends within a word: the file is cut off: copy or download it again"
        )
    return f"Prophesee raw (EVT{version[1].removesuffix('.0')})", header_size(header)


def _check_xml(path: Path):
    """faery ends the whole process where the header of an AEDAT4 file is not UTF-8."""
    with open(path, "rb") as file:
        size = int.from_bytes(file.read(18)[14:], "little")  # behind 14 bytes of magic
        header = file.read(min(size, 1 << 24))
    try:
        header[header.find(b"<dv") : header.rfind(b">") + 1].decode()
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: its header is damaged: copy or download it again") from error


@contextmanager
def _guarded(path: Path):
    """What faery raises becomes a RecordingError; its panics are no Exceptions."""
    try:
        yield
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise RecordingError(
            f"{path}: cannot be read ({' '.join(str(error).split())}): the file is damaged, "
            "incomplete or of another format: copy or download it again"
        ) from error


def _events(faery: ModuleType, path: Path) -> Iterator[Events]:
    row = 0
    with _guarded(path):
        stream = iter(faery.events_stream_from_file(path, dimensions_fallback=LARGEST))
    while True:
        with _guarded(path):
            packet = next(stream, None)
        if packet is None:
            return
        yield to_events(path, row, packet["t"], packet["x"], packet["y"], packet["on"])
        row += len(packet)


def _frames(faery: ModuleType, path: Path) -> Frames | None:
    """The file is read from its start only: so frames asked for in their order cost one pass."""
    times = _frame_times(faery, path)
    if not times:
        return None
    pictures, following = _pictures(faery, path), 0

    def read(i: int) -> np.ndarray:
        nonlocal pictures, following
        if i < following:
            pictures, following = _pictures(faery, path), 0
        frame = next(islice(pictures, i - following, None), None)
        following = i + 1
        if frame is None:
            raise RecordingError(f"{path}: has no frame {i + 1}: the file is damaged")
        return to_frame(frame.pixels, path)

    return Frames(np.array(times, np.int64), read)


def _frame_times(faery: ModuleType, path: Path) -> list[int]:
    """From the table at the end of the file; from the frames where it is missing."""
    with _guarded(path), faery.aedat.Decoder(path) as decoder:
        tracks = [track.id for track in decoder.tracks() if track.data_type == "frame"]
        if not tracks:
            return []
        table = [entry for entry in decoder.file_data_definitions() if entry.track_id == tracks[0]]
    if table and all(entry.elements_count == 1 for entry in table):
        return [entry.start_t for entry in table]
    return [frame.t for frame in _pictures(faery, path)]


def _pictures(faery: ModuleType, path: Path) -> Iterator:
    """The frames of the first camera that has any, in their order."""
    chosen = None
    with _guarded(path):
        decoder = faery.aedat.Decoder(path)
    while True:
        with _guarded(path):
            entry = next(decoder, None)
        if entry is None:
            return
        track, packet = entry
        if track.data_type == "frame" and chosen in (None, track.id):
            chosen = track.id
            yield packet
