"""Prophesee DAT -> Source: lines of text, two bytes, then 8 bytes an event, little-endian.

% Version 2           header: lines that start with %; Width and Height may be missing
% Width 304
1 byte type           0x00 (2d) or 0x0C (contrast detection): events, in the same layout
1 byte size           8
uint32                time, microseconds; wraps around to 0 after 71.6 minutes
uint32                version 2: x bits 0-13, y bits 14-27, polarity bit 28
                      version 1: x bits 0-8,  y bits 9-16,  polarity bit 17
"""

import re
from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path

import numpy as np

from firenet_jax.errors import RecordingError
from firenet_jax.readers import CHUNK, Source, to_chunks, unwrap

TYPES = (0x00, 0x0C)
VERSIONS = {0: (9, 8), 1: (9, 8), 2: (14, 14)}  # bits of x, and of y
SIDE = r"(\d{1,9})"  # Python makes no number of more than 4,300 digits


def matches(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() == ".dat"


def read(path: Path) -> Source:
    with open(path, "rb") as file:
        header = read_header(file)
        kind = file.read(2)
        start = file.tell()
    if not header or len(kind) < 2:
        raise RecordingError(f"{path}: has no header of lines that start with %: it is no DAT file")
    if kind[0] not in TYPES or kind[1] != 8:
        raise RecordingError(
            f"{path}: holds entries of type 0x{kind[0]:02X} and {kind[1]} bytes, expected 0x00 or "
            "0x0C, which are events, and 8"
        )
    version = re.search(r"^%\s*Version[ :=]+(\d{1,9})", header, re.M)
    version = int(version[1]) if version else 0
    if version not in VERSIONS:
        raise RecordingError(f"{path}: is of version {version}, expected 0, 1 or 2")
    count, left = divmod(path.stat().st_size - start, 8)
    size, bits = header_size(header), VERSIONS[version]
    return Source(
        "Prophesee DAT",
        lambda: to_chunks(path, _columns(path, start, count, *bits), left),
        size,
        count,
        grey=True,
    )


def read_header(file: BufferedReader) -> str:
    """The lines that start with %, up to `% end` if there is one; leaves the file at the byte after
    them."""
    header = ""
    while file.peek(1)[:1] == b"%":
        start, raw = file.tell(), file.readline(1 << 16)
        if re.search(rb"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]", raw):  # a word that begins with %
            file.seek(start)
            break
        line = raw.decode("latin-1")
        header += line
        if line.strip() == "% end":
            break
    return header


def header_size(header: str) -> tuple[int, int] | None:
    """`% geometry 640x480`, `% format EVT3;height=480;width=640`, or `% Width 640` -> (480, 640)"""
    if match := re.search(rf"geometry[ =:]{SIDE}x{SIDE}", header, re.I):
        return int(match[2]), int(match[1])
    sides = "height", "width"
    height, width = (re.search(rf"\b{side}[ :=]+{SIDE}", header, re.I) for side in sides)
    return (int(height[1]), int(width[1])) if height and width else None


def _columns(path: Path, start: int, count: int, x_bits: int, y_bits: int) -> Iterator[tuple]:
    row, last = 0, 0
    with open(path, "rb") as file:
        file.seek(start)
        # Not to the end: a file that is still being written may end within an event by now.
        while data := file.read(8 * min(CHUNK, count - row)):
            t, fields = np.frombuffer(data, "<u4").reshape(-1, 2).T
            t = unwrap(t, 32, last)
            x = fields & ((1 << x_bits) - 1)
            y = fields >> x_bits & ((1 << y_bits) - 1)
            p = fields >> (x_bits + y_bits) & 1
            yield t, x, y, p
            row, last = row + len(t), int(t[-1])
