"""A ROS 1 bag whose index is missing, as it was cut off -> its messages, from the beginning on.

A record is uint32 size, header, uint32 size, data; a header is fields, uint32 size and `name=value`
each. The field `op` says what a record holds:

    3  the bag's header          5  a chunk: further records, compressed as a whole
    7  a connection: its number, its topic; its type in the data, which are fields again
    2  a message: its connection, its time of recording      4, 6  indexes, which are not read
"""

import bisect
import bz2
import io
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import pyarrow as pa

from firenet_jax.readers.aedat4 import up_to

MAGIC = b"#ROSBAG V2.0\n"
CHUNK, CONNECTION, MESSAGE = 5, 7, 2
LARGEST = 1 << 28  # bytes of a record, as it is in the file and unpacked
STRIDE = 1 << 20  # bytes between two places from which reading can begin
PIECE = 1 << 16  # bytes unpacked at once: of a chunk that is cut off those that precede are there
# What damaged bytes raise here.
BROKEN = ValueError, LookupError, struct.error, OSError, EOFError


class Connection(NamedTuple):
    topic: str
    msgtype: str  # as ROS 2 writes it: dvs_msgs/msg/EventArray


class Torn:
    """Stands in for rosbags' Reader, as far as that is used here; `torn_mcap` has one of MCAP."""

    magic, format = MAGIC, "bag"  # the first bytes; what such a file is called

    def __init__(self, path: Path):
        self.path = path
        self.known: dict[int, Connection] = {}
        self.ended: Exception | None = None
        self.place = len(self.magic)  # of the record that is being read
        # All messages before such a place were recorded until its time.
        self.places, latest = [(self.place, -1)], 0
        for _, time, _ in self._messages():  # fills `known`: connections stand among the messages
            if self.place - self.places[-1][0] >= STRIDE:
                self.places.append((self.place, latest))
            latest = max(latest, time)

    @property
    def connections(self) -> list[Connection]:
        return list(self.known.values())

    def messages(self, connections, start: int | None = None) -> Iterator[tuple]:
        """(connection, time of recording in ns, bytes), not before `start`. Raises ValueError at
        the end, always: a file without an index was not closed."""
        passed = bisect.bisect_left(self.places, start or 0, key=lambda place: place[1])
        for connection, time, data in self._messages(self.places[max(passed - 1, 0)][0]):
            if connection in connections and time >= (start or 0):
                yield connection, time, data
        raise ValueError("it has no index, so it ends early") from self.ended

    def _messages(self, place: int | None = None) -> Iterator[tuple]:
        """All from this place on; None: from the beginning."""
        with open(self.path, "rb") as file:
            try:
                if file.read(len(self.magic)) != self.magic:
                    raise ValueError(f"it is no {self.format}")
                file.seek(place or len(self.magic))
                yield from self._inside(file)
            except BROKEN as error:
                self.ended = error.with_traceback(None)  # which holds what was read

    def _sorted(self, chunk: bytes) -> Iterator[tuple]:
        """The messages of a chunk by their times, as an index would have them, up to damage."""
        messages, damage = [], None
        try:
            for message in self._inside(io.BytesIO(chunk)):
                messages.append(message)
        except BROKEN as error:
            damage = error
        yield from sorted(messages, key=lambda message: message[1])
        if damage is not None:
            raise damage

    def _size(self, file: BinaryIO, count: int) -> bytes:
        """The first bytes of the next record, of which the place is kept."""
        if not isinstance(file, io.BytesIO):
            self.place = file.tell()
        return file.read(count)

    def _inside(self, file: BinaryIO) -> Iterator[tuple]:
        outermost = not isinstance(file, io.BytesIO)
        while size := self._size(file, 4):
            header = _fields(_whole(*_bytes(file, size)))
            data, missing = _bytes(file, file.read(4))
            kind = header["op"][0]
            if kind == CHUNK and outermost:  # of what is cut off the beginning is there
                unpacked, damage = _unpacked(data, header["compression"])
                yield from self._sorted(unpacked)
                if damage is not None:
                    raise damage
            elif kind == CHUNK:
                raise ValueError("a chunk within a chunk")
            _whole(data, missing)
            if kind == CONNECTION:
                package, _, name = _fields(data)["type"].decode().rpartition("/")
                number = struct.unpack("<I", header["conn"])[0]
                self.known[number] = Connection(header["topic"].decode(), f"{package}/msg/{name}")
            elif kind == MESSAGE:
                seconds, nanoseconds = struct.unpack("<II", header["time"])
                number = struct.unpack("<I", header["conn"])[0]
                yield self.known[number], seconds * 10**9 + nanoseconds, data


def _bytes(file: BinaryIO, size: bytes) -> tuple[bytes, int]:
    """(so many bytes, how many of them are not there)"""
    count = struct.unpack("<I", size)[0]
    data = file.read(count) if count <= LARGEST else b""
    return data, count - len(data)


def _whole(data: bytes, missing: int) -> bytes:
    if missing:
        raise EOFError("ends within a record")
    return data


def _fields(data: bytes) -> dict[str, bytes]:
    found, at = {}, 0
    while at < len(data):
        size = struct.unpack_from("<I", data, at)[0]
        name, _, value = data[at + 4 : at + 4 + size].partition(b"=")
        found[name.decode()] = value
        at += 4 + size
    return found


def _unpacked(data: bytes, how: bytes) -> tuple[bytes, Exception | None]:
    """-> what precedes damage, and that."""
    if how == b"none":
        return data, None
    if how == b"bz2":
        return bz2.BZ2Decompressor().decompress(data, LARGEST), None
    if how == b"lz4":
        return unpacked_by("lz4", data, LARGEST)
    raise ValueError(f"a chunk compressed by {how!r}")


def unpacked_by(codec: str, data: bytes, most: int) -> tuple[bytes, Exception | None]:
    """As `_unpacked`, of lz4 or zstd, at most so many bytes."""
    pieces = []
    try:
        with pa.CompressedInputStream(pa.BufferReader(data), codec) as stream:
            pieces.extend(up_to(stream, most, PIECE))
    except BROKEN as error:
        return b"".join(pieces), error
    return b"".join(pieces), None
