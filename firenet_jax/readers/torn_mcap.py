"""An MCAP file that was cut off, or whose index is damaged -> its messages, from the beginning on.

The file is 8 bytes that name the format, then records: a byte that says what it holds, uint64 size.
Texts have their uint32 size before them (MCAP's specification, version 0).

    3  schema: uint16 number, name, and what is not read      4  channel: uint16 number, uint16
    5  message: uint16 channel, uint32 number, uint64 time       schema, topic, encoding
       of recording in ns, uint64 time of publishing, data    6  chunk: further records: 3 uint64,
    others  indexes and statistics, which are not read           uint32 checksum, compression (none,
                                                                 lz4, zstd), uint64 size
"""

import io
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import pyarrow as pa

from firenet_jax.readers.aedat4 import up_to

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK = 3, 4, 5, 6
LARGEST = 1 << 28  # bytes of a record, as it is in the file and unpacked
FARTHEST = 1 << 62  # bytes that can be passed over


class Connection(NamedTuple):
    topic: str
    msgtype: str


class Torn:
    """What a reader of rosbags offers, as far as it is used here."""

    def __init__(self, path: Path):
        self.path = path
        self.schemas: dict[int, str] = {}
        self.known: dict[int, Connection] = {}
        self.ended: Exception | None = None
        for _ in self._messages():  # channels are told before their first message
            pass

    @property
    def connections(self) -> list[Connection]:
        return list(self.known.values())

    def messages(self, connections, start: int | None = None) -> Iterator[tuple]:
        """(connection, time of recording in ns, bytes), not before `start`. Raises ValueError at
        the end: a file without an index was not closed."""
        for connection, time, data in self._messages():
            if connection in connections and time >= (start or 0):
                yield connection, time, data
        raise ValueError("it has no index, so it ends early") from self.ended

    def _messages(self) -> Iterator[tuple]:
        with open(self.path, "rb") as file:
            try:
                if file.read(len(MAGIC)) != MAGIC:
                    raise ValueError("it is no MCAP file")
                yield from self._inside(file)
            except (ValueError, KeyError, struct.error, OSError, EOFError) as error:
                self.ended = error

    def _inside(self, file: BinaryIO) -> Iterator[tuple]:
        while head := file.read(9):
            kind, size = struct.unpack("<BQ", head)
            if kind not in (SCHEMA, CHANNEL, MESSAGE, CHUNK):
                if size >= FARTHEST:
                    raise ValueError("a record that goes on behind the end")
                file.seek(size, io.SEEK_CUR)
                continue
            data = file.read(size) if size <= LARGEST else b""
            whole = len(data) == size
            if kind == CHUNK and not isinstance(file, io.BytesIO):
                yield from self._sorted(_unpacked(data))
            elif not whole or kind == CHUNK:
                raise EOFError("ends within a record, or has a chunk within a chunk")
            elif kind == SCHEMA:
                self.schemas[struct.unpack_from("<H", data)[0]] = _text(data, 2)[0]
            elif kind == CHANNEL:
                number, schema = struct.unpack_from("<HH", data)
                self.known[number] = Connection(_text(data, 4)[0], self.schemas.get(schema, ""))
            else:
                number, _, time, _ = struct.unpack_from("<HIQQ", data)
                yield self.known[number], time, data[22:]
            if not whole:
                raise EOFError("ends within a chunk")

    def _sorted(self, chunk: bytes) -> Iterator[tuple]:
        """The messages of a chunk by their times, as an index would have them, up to damage."""
        messages, damage = [], None
        try:
            for message in self._inside(io.BytesIO(chunk)):
                messages.append(message)
        except (ValueError, KeyError, struct.error, EOFError) as error:
            damage = error
        yield from sorted(messages, key=lambda message: message[1])
        if damage is not None:
            raise damage


def _text(data: bytes, at: int) -> tuple[str, int]:
    """(a text, the place behind it)"""
    size = struct.unpack_from("<I", data, at)[0]
    return data[at + 4 : at + 4 + size].decode(), at + 4 + size


def _unpacked(data: bytes) -> bytes:
    _, _, size, _ = struct.unpack_from("<QQQI", data)
    how, at = _text(data, 28)
    packed = struct.unpack_from("<Q", data, at)[0]
    data = data[at + 8 : at + 8 + packed]
    if how in ("lz4", "zstd"):
        with pa.CompressedInputStream(pa.BufferReader(data), how) as stream:
            data = up_to(stream, min(size, LARGEST))
    elif how:
        raise ValueError(f"a chunk compressed by {how!r}")
    return data
