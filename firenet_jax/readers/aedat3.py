"""AEDAT-3.1 -> Source: the file of cAER and early DV, packets that hold entries of one kind each.

    #...             lines of text (aedat.py): `#Format: RAW`, `#Source 1: DAVIS240C`
    28 bytes         header of a packet: int16 kind, int16 source, int32 each: size of an entry,
                     offset of the time in it, how often the times' 31 bits have wrapped around,
                     capacity, number of entries, of valid ones
    entries          little-endian; bit 0 of each says whether it is valid; invalid ones are skipped
        0 special    uint32: kind (bits 1-7), int32 time: an edge at a trigger input, and others
        1 polarity   uint32: polarity (bit 1), y (2-16), x (17-31), int32 time
        2 frame      uint32: channels (bits 1-3), int32 each: begin and end of the frame, begin and
                     end of its exposure, width, height, column and row of its corner; uint16 pixels
        others       are skipped

Times are microseconds; a frame is at the middle of its exposure. Of several cameras the first with
events is read. Frames of parts of the sensor are skipped.
"""

import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from firenet_jax.errors import RecordingError, logger
from firenet_jax.events import Frames
from firenet_jax.readers import Source, aedat, all_triggers, joined, reading, to_chunks, to_frame
from firenet_jax.readers.libcaer import EVENT, fields

SPECIAL, POLARITY, FRAME = 0, 1, 2
HEAD = struct.Struct("<2h6i")
FRAME_HEAD = np.dtype(
    [("info", "<u4"), ("begin", "<i4"), ("end", "<i4"), ("open", "<i4"), ("shut", "<i4"),
     ("width", "<i4"), ("height", "<i4"), ("x", "<i4"), ("y", "<i4")]
)  # fmt: skip
# kind of a special entry: (input, 1 for a rising edge); a pulse counts as a rising edge
EDGES = {2: (0, 1), 3: (0, 0), 4: (0, 1), 6: (1, 1), 7: (1, 0), 8: (1, 1), 9: (2, 1), 10: (2, 0),
         11: (2, 1)}  # fmt: skip
PIECE = 1 << 18  # entries of a packet that are read at once


class Packet(NamedTuple):
    kind: int
    source: int
    size: int  # bytes of an entry
    wraps: int
    count: int
    offset: int  # of the first entry, bytes from the beginning of the file


class Layout(NamedTuple):
    """What is known of a file before its events are read."""

    path: Path
    begin: int  # of the first packet, bytes from the beginning of the file
    source: int  # the camera


def matches(path: Path) -> bool:
    return (aedat.version(path) or "").startswith("3.") or (
        path.is_file() and path.suffix.lower() == ".aedat3"
    )


def read(path: Path) -> Source:
    version = aedat.version(path)
    if version != "3.1":
        found = "names no version of AEDAT" if version is None else f"is AEDAT-{version}"
        raise RecordingError(f"{path}: {found}, expected 3.1 in its first line: convert it with DV")
    with open(path, "rb") as file:
        lines = aedat.read_header(file)
        begin = file.tell()
    header = "\n".join(lines)
    stored = re.search(r"^#Format: *(\S+)", header, re.M)
    if stored is not None and stored[1].upper() != "RAW":
        raise RecordingError(
            f"{path}: its packets are stored as {stored[1]}, expected RAW: convert it with DV"
        )
    layout = Layout(path, begin, _camera(path, begin))
    name = re.search(rf"^#Source {layout.source}: *(.+)$", header, re.M)
    return Source(
        "AEDAT-3.1",
        lambda: joined(to_chunks(path, _events(layout))),
        None if name is None else aedat.sensor_size(name[1]),
        frames=_frames(layout),
        grey=name is not None and aedat.is_grey(name[1]),
        triggers=lambda: all_triggers(_triggers(layout)),
    )


def _camera(path: Path, begin: int) -> int:
    with open(path, "rb") as file:
        found = next(
            (p for p in _packets(path, file, begin) if p.kind == POLARITY and p.count), None
        )
    if found is None:
        raise RecordingError(
            f"{path}: holds no events: check that it was recorded and copied whole"
        )
    return found.source


def _packets(path: Path, file: BinaryIO, begin: int) -> Iterator[Packet]:
    """Of all kinds; moves the file's position. Raises RecordingError at one that is not whole."""
    at, end = begin, path.stat().st_size
    while at < end:
        file.seek(at)
        head = file.read(HEAD.size).ljust(HEAD.size, b"\0")  # if cut off, it ends beyond `end`
        kind, source, size, _, wraps, _, count, _ = HEAD.unpack(head)
        offset = at + HEAD.size
        if size <= 0 or count < 0 or offset + size * count > end:
            raise RecordingError(
                f"{path}: cannot be read from byte {at} on, where no whole packet is: the file is "
                "cut off or damaged: copy or download it again"
            )
        yield Packet(kind, source, size, wraps, count, offset)
        at = offset + size * count


def _of_kind(layout: Layout, kind: int) -> Iterator[tuple[Packet, BinaryIO]]:
    with open(layout.path, "rb") as file:
        for packet in _packets(layout.path, file, layout.begin):
            if packet.kind == kind and packet.source == layout.source:
                yield packet, file


def _columns(layout: Layout, kind: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(data uint32, times int64) of the valid entries of a kind of 8 bytes each"""
    for packet, file in _of_kind(layout, kind):
        if packet.size != EVENT.itemsize:
            raise RecordingError(
                f"{layout.path}: has entries of {packet.size} bytes at byte {packet.offset}, "
                f"expected {EVENT.itemsize}: the file is damaged: copy or download it again"
            )
        for first in range(0, packet.count, PIECE):
            count = min(PIECE, packet.count - first)
            file.seek(packet.offset + first * packet.size)
            entries = np.frombuffer(file.read(count * packet.size), EVENT)
            entries = entries[entries["data"] & 1 > 0]
            yield entries["data"], entries["t"].astype(np.int64) + (packet.wraps << 31)


def _events(layout: Layout) -> Iterator[tuple[np.ndarray, ...]]:
    for data, t in _columns(layout, POLARITY):
        yield t, *fields(data)


def _triggers(layout: Layout) -> Iterator[np.ndarray]:
    for data, t in _columns(layout, SPECIAL):
        kinds = (data >> 1 & 0x7F).tolist()
        edges = [(time, *EDGES[k]) for time, k in zip(t, kinds, strict=True) if k in EDGES]
        yield np.array(edges, np.int64).reshape(-1, 3).T


def _frames(layout: Layout) -> Frames | None:
    """A damaged frame is left out, with a notice; after a damaged packet there are none, and it
    raises its error as events are read."""
    times, entries = [], []  # an entry: (offset, bytes)
    damaged, first, damage = 0, None, None
    try:
        for packet, file in _of_kind(layout, FRAME):
            for number in range(packet.count):
                offset = packet.offset + number * packet.size
                try:
                    head = _frame_head(file, offset, packet.size)
                except ValueError:
                    damaged, first = damaged + 1, offset if first is None else first
                    continue
                if head["info"] & 1 and head["x"] == head["y"] == 0:
                    begin, end = int(head["open"]), int(head["shut"])
                    times.append((begin + end) // 2 + (packet.wraps << 31))
                    entries.append((offset, packet.size))
    except RecordingError as error:
        damage = error
    if damaged:
        logger.warning(
            "%s: damaged frames are left out: %d, the first at byte %d",
            layout.path, damaged, first,
        )  # fmt: skip
    if not entries:
        return None
    at = np.array(times, np.int64)
    return Frames(at, lambda i: _frame(layout.path, *entries[i]), damage=damage)


def _frame_head(file: BinaryIO, offset: int, size: int) -> np.void:
    """Raises ValueError where its pixels do not fit into the entry."""
    file.seek(offset)
    head = np.frombuffer(file.read(min(size, FRAME_HEAD.itemsize)), FRAME_HEAD)[0]
    height, width, channels = int(head["height"]), int(head["width"]), _channels(head)
    room = size - FRAME_HEAD.itemsize
    if min(height, width) < 1 or channels not in (1, 3, 4) or 2 * height * width * channels > room:
        raise ValueError(f"a frame of {width}x{height} pixels in {size} bytes")
    return head


def _channels(head: np.void) -> int:
    return int(head["info"]) >> 1 & 7


def _frame(path: Path, offset: int, size: int) -> np.ndarray:
    with open(path, "rb") as file, reading(path, ValueError, IndexError):
        head = _frame_head(file, offset, size)
        shape = int(head["height"]), int(head["width"]), _channels(head)
        pixels = np.frombuffer(file.read(2 * int(np.prod(shape))), "<u2").reshape(shape)
    return to_frame((pixels >> 8).astype(np.uint8), path)
