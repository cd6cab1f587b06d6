"""An MCAP file that was cut off, or whose index is damaged -> its messages, from the beginning on.

The file is 8 bytes that name the format, then records: a byte that says what it holds, uint64 size.
Texts have their uint32 size before them (MCAP's specification, version 0).

    3  schema: uint16 number, name, and what is not read
    4  channel: uint16 number, uint16 schema, topic, encoding
    5  message: uint16 channel, uint32 number, uint64 time of recording in ns, uint64 time of
       publishing, data
    6  chunk: uint64 first time, last time and unpacked size, uint32 checksum, compression ("", lz4,
       zstd), uint64 size, so many bytes: further records, compressed as a whole
    others  indexes and statistics, which are not read
"""

import io
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from firenet_jax.readers import torn_bag
from firenet_jax.readers.torn_bag import LARGEST, Connection

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK = 3, 4, 5, 6
FARTHEST = 1 << 62  # bytes that can be skipped


class Torn(torn_bag.Torn):
    """Read in the same way; only what is inside differs."""

    magic, format = MAGIC, "MCAP file"

    def __init__(self, path: Path):
        self.schemas: dict[int, str] = {}
        super().__init__(path)

    def _inside(self, file: BinaryIO) -> Iterator[tuple]:
        while head := self._size(file, 9):
            kind, size = struct.unpack("<BQ", head)
            if kind not in (SCHEMA, CHANNEL, MESSAGE, CHUNK):
                if size >= FARTHEST:
                    raise ValueError("a record that goes on past the end")
                file.seek(size, io.SEEK_CUR)
                continue
            data = file.read(size) if size <= LARGEST else b""
            whole = len(data) == size
            if kind == CHUNK and not isinstance(file, io.BytesIO):
                unpacked, damage = _unpacked(data)
                yield from self._sorted(unpacked)
                if damage is not None:
                    raise damage
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


def _text(data: bytes, at: int) -> tuple[str, int]:
    """(a text, the offset after it)"""
    size = struct.unpack_from("<I", data, at)[0]
    return data[at + 4 : at + 4 + size].decode(), at + 4 + size


def _unpacked(data: bytes) -> tuple[bytes, Exception | None]:
    _, _, size, _ = struct.unpack_from("<QQQI", data)
    how, at = _text(data, 28)
    packed = struct.unpack_from("<Q", data, at)[0]
    data = data[at + 8 : at + 8 + packed]
    if how in ("lz4", "zstd"):
        return torn_bag.unpacked_by(how, data, min(size, LARGEST))
    if how:
        raise ValueError(f"a chunk compressed by {how!r}")
    return data, None
