"""AEDAT-2.0 -> Source: jAER's and v2e's file, an address and a time for all that a camera sends.

    #...             lines of text (aedat.py), of which `# AEChip: ...` names the chip
    uint32 address   big-endian; what its bits are depends on the chip:
        DAVIS    bit 31 clear: an event, y bits 30-22, x 21-12, polarity 11; or, with bit 10 set, an
                 edge at the trigger input
                 bit 31 set: a pixel of a picture, y and x as above; or, with bit 11 set, an IMU
                 sample, which is not read; each pixel is read twice, after its reset (bit 10 clear)
                 and after its exposure (set): the brighter it is, the further its level (bits 9-0)
                 has fallen
        DVS128   y bits 14-8, x 7-1, bit 0: 0 for brighter; bit 15: an edge at the trigger input
        DVS640   y bits 20-11, x 10-1, polarity 0: as v2e writes 640x480
    uint32 time      microseconds

Rows are counted from the bottom. Columns of events are counted from the right, those of pixels from
the left (jAER, DavisBaseCamera and DVS128). A picture is at the middle of its exposure. v2e and old
files name no chip: layout and sensor are then inferred from the addresses, the smallest sensor that
holds them. The files do not tell rising edges from falling ones.
"""

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from firenet_jax.errors import RecordingError, logger
from firenet_jax.events import Frames
from firenet_jax.readers import CHUNK, Source, aedat, all_triggers, joined, to_chunks, unwrap

PICTURE, IMU, EXPOSED = 1 << 31, 1 << 11, 1 << 10  # bits of a DAVIS
LEVEL = 0x3FF


class Layout(NamedTuple):
    """What the bits of a chip's addresses hold."""

    x: int  # its lowest bit
    x_bits: int
    y: int
    y_bits: int
    polarity: int
    brighter: int  # the polarity of events that became brighter
    edge: int  # mask: an address with any of these bits set is an edge at the trigger input
    pictures: bool
    sizes: tuple[tuple[int, int], ...]  # (height, width) of its sensors

    def column(self, address: np.ndarray) -> np.ndarray:
        return (address >> self.x & (1 << self.x_bits) - 1).astype(np.int64)

    def row(self, address: np.ndarray) -> np.ndarray:
        return (address >> self.y & (1 << self.y_bits) - 1).astype(np.int64)


DAVIS = Layout(12, 10, 22, 9, 11, 1, 1 << 10, True, ((180, 240), (260, 346), (480, 640)))
DVS128 = Layout(1, 7, 8, 7, 0, 0, 1 << 15 | 1 << 31, False, ((128, 128),))
DVS640 = Layout(1, 10, 11, 10, 0, 1, 0, False, ((480, 640),))
CHIPS = {r"davis|sbret|dvs240|dvs346": DAVIS, r"dvs128|tmpdiff128": DVS128, r"dvs640": DVS640}


class File(NamedTuple):
    path: Path
    begin: int  # of the first address, bytes from the beginning of the file
    layout: Layout
    size: tuple[int, int]  # (height, width)
    edges: bool  # whether `layout.edge` marks edges: v2e may mark noise events with it
    grey: bool  # whether the chip is monochrome


def matches(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in aedat.SUFFIXES[:2]


def read(path: Path, size: tuple[int, int] | None = None) -> Source:
    """size: (height, width) of a file that names no chip, or one of unknown size."""
    version = aedat.version(path)
    if version != "2.0":
        found = "names no version of AEDAT" if version is None else f"is AEDAT-{version}"
        raise RecordingError(
            f"{path}: {found}, expected 2.0, 3.1 or 4.0 in its first line: convert it with jAER "
            "or DV"
        )
    file = _file(path, size)
    frames = _frames(file) if file.layout.pictures else None
    return Source(
        "AEDAT-2.0",
        lambda: joined(to_chunks(path, _columns(file), (path.stat().st_size - file.begin) % 8)),
        file.size,
        frames=frames,
        grey=file.grey,
        triggers=lambda: all_triggers(_triggers(file)),
    )


def _file(path: Path, size: tuple[int, int] | None) -> File:
    with open(path, "rb") as stream:
        lines = aedat.read_header(stream)
        begin = stream.tell()
    header = "\n".join(lines)
    # v2e marks noise, which is events, where cameras mark edges; it says so in a line.
    edges = "noise events are labeled" not in header
    chip = re.search(r"^#\s*AEChip:\s*(\S+)", header, re.M)
    if chip is None:
        layout, found = _inferred(path, begin, size)
    else:
        name = chip[1].rpartition(".")[2]
        layout = next((v for part, v in CHIPS.items() if re.search(part, name, re.I)), None)
        found = aedat.sensor_size(name) or size
        if layout is None or found is None:
            raise RecordingError(
                f"{path}: is of the chip {name}, expected a DAVIS, DVS128 or DVS640: convert it "
                "to text with jAER"
            )
    return File(path, begin, layout, found, edges, chip is not None and aedat.is_grey(chip[1]))


def _inferred(
    path: Path, begin: int, size: tuple[int, int] | None
) -> tuple[Layout, tuple[int, int]]:
    """(layout, (height, width)) that fit all addresses; `size`, where given, is taken as it is."""
    used = 0  # bits that are set in any address
    reach = np.zeros(4, np.int64)  # largest row and column, as of a DAVIS and as of a DVS640
    for _, address, _ in _records(path, begin):
        address = address[address < PICTURE]
        if len(address):
            used |= int(np.bitwise_or.reduce(address))
            places = [part(address) for v in (DAVIS, DVS640) for part in (v.row, v.column)]
            reach = np.maximum(reach, [place.max() for place in places])
    if used < 1 << 16:
        name, layout, reach = "DVS128", DVS128, reach[:2] * 0
    elif not used & LEVEL:
        name, layout, reach = "DAVIS", DAVIS, reach[:2]
    elif used < 1 << 21:
        name, layout, reach = "DVS640", DVS640, reach[2:]
    else:
        raise RecordingError(
            f"{path}: names no chip (# AEChip: ...), and its addresses are neither those of a "
            "DAVIS nor of a DVS128 or DVS640: the file is damaged or of another camera"
        )
    if size is not None:
        return layout, size
    fitting = [s for s in layout.sizes if (reach < s).all()]
    size = fitting[0] if fitting else layout.sizes[-1]
    logger.warning(
        "%s names no chip; by its addresses a %s of %dx%d pixels; "
        "--sensor-size WIDTHxHEIGHT sets another size",
        path, name, size[1], size[0],
    )  # fmt: skip
    return layout, size


def _records(
    path: Path, begin: int, first: int = 0, count: int = sys.maxsize
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """(number of the first, addresses uint32, times int64), from the record `first` on."""
    with open(path, "rb") as file:
        file.seek(begin + 8 * first)
        last, number = 0, first
        while data := file.read(8 * min(CHUNK, first + count - number)):
            address, time = np.frombuffer(data[: len(data) // 8 * 8], ">u4").reshape(-1, 2).T
            if not len(address):
                return
            time = unwrap(time, 32, last)
            last = int(time[-1])
            yield number, address.astype(np.uint32), time
            number += len(address)


def _kinds(file: File, address: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) bool: which are events, which are edges"""
    edges = (address & file.layout.edge > 0) if file.edges else np.zeros(len(address), bool)
    if file.layout.pictures:
        sensor = address < PICTURE
        return sensor & ~edges, sensor & edges
    return ~edges, edges


def _columns(file: File) -> Iterator[tuple[np.ndarray, ...]]:
    (height, width), layout = file.size, file.layout
    for _, address, time in _records(file.path, file.begin):
        is_event, _ = _kinds(file, address)
        address = address[is_event]
        x, y = width - 1 - layout.column(address), height - 1 - layout.row(address)
        yield time[is_event], x, y, (address >> layout.polarity & 1) == layout.brighter


def _triggers(file: File) -> Iterator[tuple[np.ndarray, ...]]:
    for _, address, time in _records(file.path, file.begin):
        time = time[_kinds(file, address)[1]]
        yield time, np.zeros_like(time), np.ones_like(time)


# ---- Pictures: a scan of all pixels after their reset, one after their exposure


class Scan(NamedTuple):
    """One readout of all pixels, complete or not."""

    first: int  # number of its first record
    last: int
    count: int
    begin: int  # microseconds
    end: int
    total: int  # sum of its pixels' times, each from `begin` on


def _frames(file: File) -> Frames | None:
    """The complete pictures: each pixel was read after its reset and after its exposure."""
    scans: dict[int, list[Scan]] = {0: [], EXPOSED: []}
    last: dict[int, np.ndarray | None] = {0: None, EXPOSED: None}  # the pixel read last, (x, y)
    for number, address, time in _records(file.path, file.begin):
        pixel = np.flatnonzero((address & (PICTURE | IMU)) == PICTURE)
        for kind, found in scans.items():
            of_kind = pixel[(address[pixel] & EXPOSED) == kind]
            if len(of_kind):
                pieces, last[kind] = _scans(file, number, address, time, of_kind, last[kind])
                if found and pieces[0] is not None:
                    found[-1] = _merged(found[-1], pieces[0])
                found += [piece for piece in pieces[1:] if piece is not None]
    pairs = _pairs(scans[0], scans[EXPOSED], file.size[0] * file.size[1])
    if not pairs:
        return None
    times = np.array([_middle(*pair) for pair in pairs], np.int64)
    places = [(min(r.first, e.first), max(r.last, e.last)) for r, e in pairs]
    return Frames(times, lambda i: _frame(file, *places[i]))


def _scans(
    file: File, number: int, address: np.ndarray, time: np.ndarray, of_kind: np.ndarray, before
) -> tuple[list[Scan | None], np.ndarray]:
    """-> [the rest of the scan that was going on, or None; further scans ...], the last pixel

    before: the last pixel of the records before these, (x, y).
    Scans go from one corner to the opposite one, by columns or by rows, so a new one begins where
    both coordinates jump by more than half of the sensor.
    """
    place = np.stack([file.layout.column(address[of_kind]), file.layout.row(address[of_kind])], 1)
    jumps = np.abs(np.diff(place, axis=0, prepend=place[:1] if before is None else before[None]))
    height, width = file.size
    starts = (jumps[:, 0] > width // 2) & (jumps[:, 1] > height // 2)
    starts[0] |= before is None
    pieces: list[Scan | None] = []
    for rows in np.split(of_kind, np.flatnonzero(starts)):
        if not len(rows):  # the first
            pieces.append(None)
            continue
        t = time[rows]
        facts = number + rows[0], number + rows[-1], len(rows), t[0], t[-1], (t - t[0]).sum()
        pieces.append(Scan(*map(int, facts)))
    return pieces, place[-1]


def _merged(a: Scan, b: Scan) -> Scan:
    total = a.total + b.total + (b.begin - a.begin) * b.count
    return Scan(a.first, b.last, a.count + b.count, a.begin, b.end, total)


def _pairs(resets: list[Scan], exposed: list[Scan], pixels: int) -> list[tuple[Scan, Scan]]:
    """(scan after the reset, scan after the exposure) of each picture, both complete: the former is
    the last that began before the latter."""
    begins, pairs = np.array([scan.first for scan in resets]), []
    for scan in exposed:
        at = int(np.searchsorted(begins, scan.first)) - 1
        if at >= 0 and scan.count == resets[at].count == pixels:
            pairs.append((resets[at], scan))
    return pairs


def _middle(reset: Scan, exposed: Scan) -> int:
    """The middle of the exposure, microseconds. A global shutter opens after the last pixel's reset
    and closes before the first one is read; a rolling one exposes each pixel at its own time, of
    which this is the mean."""
    if reset.end <= exposed.begin:
        return (reset.end + exposed.begin) // 2
    return sum(scan.begin + scan.total // scan.count for scan in (reset, exposed)) // 2


def _frame(file: File, first: int, last: int) -> np.ndarray:
    height, width = file.size
    levels = {kind: np.zeros((height, width), np.int64) for kind in (0, EXPOSED)}
    for _, address, _ in _records(file.path, file.begin, first, last + 1 - first):
        address = address[(address & (PICTURE | IMU)) == PICTURE]
        x, y = file.layout.column(address), file.layout.row(address)
        address, x, y = (v[(x < width) & (y < height)] for v in (address, x, y))
        for kind, level in levels.items():
            of_kind = (address & EXPOSED) == kind
            level[height - 1 - y[of_kind], x[of_kind]] = address[of_kind] & LEVEL
    return (np.clip(levels[0] - levels[EXPOSED], 0, LEVEL) >> 2).astype(np.uint8)
