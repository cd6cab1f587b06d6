"""AEDAT4 -> Source: iniVation's file, packets of events and frames, each compressed by itself.

    14 bytes     #!AER-DAT4.0\\r\\n
    uint32       size of the header, a flatbuffer: compression (0 none, 1 and 2 LZ4, 3 and 4 ZSTD),
                 where the packets end (-1: not known), XML that names the streams and their sizes
    packets      int32 stream, int32 size, so many bytes: a flatbuffer after its own size
      EVTS       a vector of events, 16 bytes each: int64 time, int16 x, int16 y, bool
      FRME       times (0: of the frame, 3 and 4: of its exposure), format, width, height, pixels
      others     are skipped
    table        of all packets, compressed too; not read

Numbers are little-endian, times microseconds; a frame is at the middle of its exposure. Of several
cameras the first is read. Each offset is checked before it is followed. Libraries for this format
are not used: they end the whole process at a damaged file (faery), or are large.
"""

import contextlib
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple
from xml.etree import ElementTree

import numpy as np
import pyarrow as pa

from firenet_jax.errors import RecordingError, logger
from firenet_jax.events import MAX_TIME, Frames
from firenet_jax.readers import Source, aedat, all_triggers, joined, reading, to_chunks, to_frame

MAGIC = b"#!AER-DAT4.0\r\n"
CODECS = {0: None, 1: "lz4", 2: "lz4", 3: "zstd", 4: "zstd"}
HEADER = 1 << 24  # bytes of a header at most
PACKET = 1 << 28  # bytes of an unpacked packet at most: 16 million events
PIECE = 1 << 20  # bytes that are unpacked at once
HEAD = 1 << 10  # bytes at the beginning of a frame's packet that hold all but the pixels
EVENT = np.dtype(
    {
        "names": ["t", "x", "y", "on"],
        "formats": ["<i8", "<i2", "<i2", "u1"],
        "offsets": [0, 8, 10, 12],
        "itemsize": 16,
    }
)
CHANNELS = {0: 1, 16: 3, 24: 4}  # OpenCV's type numbers of grey, BGR, BGRA of 8 bits: channels
# kinds: (input, 1 for a rising edge); a pulse counts as a rising edge, the output as input 1
EDGES = {1: (0, 1), 2: (0, 0), 3: (0, 1), 4: (1, 1), 5: (1, 0)}
NOWHERE = -1  # the offset of what is not in the table
DAMAGED = struct.error, ValueError, IndexError, OSError  # what damaged bytes raise here


class Layout(NamedTuple):
    """What the header says."""

    codec: str | None
    begin: int  # of the first packet, bytes from the beginning of the file
    end: int | None  # of the packets; None: that of the file
    events: int  # stream
    frames: int | None  # stream; None: no frames
    size: tuple[int, int] | None  # (height, width)
    explorer: bool  # whether the camera is a DVXplorer: all of them are monochrome
    triggers: int | None  # stream; None: no triggers


def matches(path: Path) -> bool:
    return path.is_file() and (path.suffix.lower() == ".aedat4" or aedat.version(path) == "4.0")


def read(path: Path) -> Source:
    layout = _layout(path)
    frames, stream = _frames(path, layout), layout.frames
    shown_grey = frames is not None and stream is not None and _is_grey(path, layout, stream)
    return Source(
        "AEDAT4",
        lambda: joined(to_chunks(path, _events(path, layout))),
        layout.size,
        frames=frames,
        grey=layout.explorer or shown_grey,
        triggers=lambda: all_triggers(_triggers(path, layout), *DAMAGED),
    )


# ---- Flatbuffers: a table says where its fields are, a vector how long it is


def _number(data: bytes, at: int, kind: str) -> int:
    """kind: as in `struct`. Raises struct.error or ValueError where it lies outside."""
    if at < 0:
        raise ValueError("an offset before the beginning")
    return struct.unpack_from("<" + kind, data, at)[0]


def _root(data: bytes, start: int = 0) -> int:
    """Offset of the table that a flatbuffer, or an entry of a vector of tables, points to."""
    return start + _number(data, start, "I")


def _field(data: bytes, table: int, number: int, kind: str, default: int = 0) -> int:
    """A number of a table; with the kind "at" the offset that it points to."""
    entries = table - _number(data, table, "i")
    offset = 0
    if 4 + 2 * number < _number(data, entries, "H"):
        offset = _number(data, entries + 4 + 2 * number, "H")
    if not offset:
        return default
    if kind != "at":
        return _number(data, table + offset, kind)
    return table + offset + _number(data, table + offset, "I")


def _vector(data: bytes, at: int, itemsize: int) -> tuple[int, int]:
    """(offset of its first entry, how many there are)"""
    count = _number(data, at, "I")
    if at + 4 + count * itemsize > len(data):
        raise ValueError("a list that goes on past the end")
    return at + 4, count


# ---- The file


def _layout(path: Path) -> Layout:
    damaged = f"{path}: its header is damaged"
    remedy = "copy or download it again"
    with open(path, "rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise RecordingError(
                f"{path}: cannot be read as AEDAT4: its first line is not #!AER-DAT4.0: {remedy}"
            )
        try:
            size = _number(file.read(4), 0, "I")
            if size > HEADER:
                raise ValueError(f"it claims {size} bytes")
            header, begin = file.read(size), file.tell()
            table = _root(header)
            codec = _field(header, table, 0, "i")
            end = _field(header, table, 1, "q", -1)
            start, count = _vector(header, _field(header, table, 2, "at", NOWHERE), 1)
            streams = _streams(header[start : start + count])
        except (*DAMAGED, ElementTree.ParseError) as error:
            raise RecordingError(f"{damaged} ({error}): {remedy}") from error
    if codec not in CODECS:
        raise RecordingError(f"{damaged} (compression {codec}): {remedy}")
    events = next((stream for stream in streams if stream.kind == "EVTS"), None)
    if events is None:
        kinds = ", ".join(sorted({stream.kind for stream in streams})) or "nothing"
        raise RecordingError(f"{path}: holds no events, but {kinds}: record them too")
    camera = events.camera
    own = [stream for stream in streams if not camera or stream.camera in (camera, "")]
    first = {stream.kind: stream.number for stream in reversed(own)}
    if others := sorted({stream.camera for stream in streams if stream not in own}):
        found = ", ".join(others)
        logger.warning("%s: holds streams of %s, too; reading those of %s", path, found, camera)
    return Layout(
        CODECS[codec],
        begin,
        end if end >= begin else None,
        events.number,
        first.get("FRME"),
        events.size,
        camera.startswith("DVXplorer_"),
        first.get("TRIG"),
    )


class Stream(NamedTuple):
    """What the header says of a stream."""

    number: int
    kind: str
    size: tuple[int, int] | None  # (height, width); None: not stated
    camera: str  # "DAVIS346_00000459"; "": not stated


def _streams(text: bytes) -> list[Stream]:
    """From the header's XML."""
    found = []
    for node in ElementTree.fromstring(text.rstrip(b"\0").strip()).iter("node"):
        said = {attribute.get("key"): attribute.text for attribute in node.findall("attr")}
        if "typeIdentifier" not in said:
            continue
        inside = {attribute.get("key"): attribute.text for attribute in node.iter("attr")}
        height, width = inside.get("sizeY"), inside.get("sizeX")
        size = (int(height), int(width)) if height and width else None
        number, kind = int(node.get("name") or -1), said["typeIdentifier"] or ""
        found.append(Stream(number, kind, size, inside.get("source") or ""))
    return found


def _packets(path: Path, file: BinaryIO, layout: Layout, stream: int) -> Iterator[tuple[int, int]]:
    """(offset, size) of the packets of a stream; moves the file's position."""
    at, end = layout.begin, path.stat().st_size
    last = end if layout.end is None else layout.end
    while at < last:
        file.seek(at)
        head = file.read(8)
        number, size = struct.unpack("<ii", head) if len(head) == 8 else (0, -1)
        if len(head) < 8 or size < 0 or at + 8 + size > end:
            raise RecordingError(
                f"{path}: cannot be read from byte {at} on, where no whole packet is: the file is "
                "cut off or damaged: copy or download it again"
            )
        if number == stream:
            yield at + 8, size
        at += 8 + size


def _unpacked(file: BinaryIO, layout: Layout, offset: int, size: int, most: int = PACKET) -> bytes:
    """A packet's flatbuffer without the size before it; with `most`, only so many bytes of it."""
    file.seek(offset)
    data = file.read(size)
    if layout.codec:
        with pa.CompressedInputStream(pa.BufferReader(data), layout.codec) as stream:
            data = b"".join(up_to(stream, most + 1))
    if len(data) > most and most == PACKET:
        raise ValueError(f"more than {PACKET >> 20} MB unpacked")
    return data[4:]


def up_to(stream, most: int, size: int = PIECE) -> Iterator[bytes]:
    """Reads at most so many bytes, in pieces of this size: pyarrow's streams allocate all that is
    asked for at once."""
    missing = most
    while missing and (piece := stream.read(min(missing, size))):
        yield piece
        missing -= len(piece)


def _events(path: Path, layout: Layout) -> Iterator[tuple[np.ndarray, ...]]:
    with open(path, "rb") as file:
        for offset, size in _packets(path, file, layout, layout.events):
            with reading(path, *DAMAGED):
                data = _unpacked(file, layout, offset, size)
                start = _field(data, _root(data), 0, "at", NOWHERE)
                if start == NOWHERE:  # an empty packet
                    continue
                start, count = _vector(data, start, EVENT.itemsize)
                events = np.frombuffer(data, EVENT, count, start)
            yield events["t"], events["x"], events["y"], events["on"] != 0


def _triggers(path: Path, layout: Layout) -> Iterator[np.ndarray]:
    if layout.triggers is None:
        return
    with open(path, "rb") as file:
        for offset, size in _packets(path, file, layout, layout.triggers):
            data = _unpacked(file, layout, offset, size)
            start = _field(data, _root(data), 0, "at", NOWHERE)
            start, count = (0, 0) if start == NOWHERE else _vector(data, start, 4)
            edges = []
            for at in range(start, start + 4 * count, 4):
                table = _root(data, at)
                if (kind := _field(data, table, 1, "b")) in EDGES:
                    edges.append((_field(data, table, 0, "q"), *EDGES[kind]))
            yield np.array(edges, np.int64).reshape(-1, 3).T


# ---- Frames


def _frames(path: Path, layout: Layout) -> Frames | None:
    """Up to the first that is damaged; a damaged packet raises its error as events are read."""
    if layout.frames is None:
        return None
    times, packets, damage = [], [], None  # a packet: (offset, size)
    try:
        with open(path, "rb") as file:
            for offset, size in _packets(path, file, layout, layout.frames):
                times.append(_time(_unpacked(file, layout, offset, size, HEAD)))
                packets.append((offset, size))
    except (RecordingError, *DAMAGED) as error:
        damage = error
    if not packets:
        return None
    times = np.array(times[: len(packets)], np.int64)
    return Frames(times, lambda i: _frame(path, layout, packets[i]), damage=damage)


def _is_grey(path: Path, layout: Layout, stream: int) -> bool:
    """Whether the first frame has one channel: cameras with a colour filter array write more."""
    with open(path, "rb") as file, contextlib.suppress(RecordingError, *DAMAGED):
        offset, size = next(_packets(path, file, layout, stream))
        data = _unpacked(file, layout, offset, size, HEAD)
        return _field(data, _root(data), 5, "b") == 0
    return False


def _time(data: bytes) -> int:
    table = _root(data)
    begin, end = (_field(data, table, number, "q") for number in (3, 4))
    time = (begin + end) // 2 if begin and end else _field(data, table, 0, "q")
    if abs(time) >= MAX_TIME:
        raise ValueError(f"a frame at {time} us")
    return time


def _frame(path: Path, layout: Layout, packet: tuple[int, int]) -> np.ndarray:
    with open(path, "rb") as file, reading(path, *DAMAGED):
        data = _unpacked(file, layout, *packet)
        table = _root(data)
        kind = _field(data, table, 5, "b")
        width, height = (_field(data, table, number, "h") for number in (6, 7))
        if kind not in CHANNELS:
            raise ValueError(f"a frame of format {kind}")
        start, count = _vector(data, _field(data, table, 10, "at", NOWHERE), 1)
        shape = height, width, CHANNELS[kind]
        if min(height, width) < 1 or count != height * width * CHANNELS[kind]:
            raise ValueError(f"a frame of {width}x{height} in {count} bytes")
        pixels = np.frombuffer(data, np.uint8, count, start).reshape(shape)
    return to_frame(pixels[..., 2::-1] if shape[2] > 1 else pixels, path)
