"""Columns -> the bytes of a recording, put together from the formats' descriptions alone.

Of what no library at hand writes: AEDAT-2.0 (jAER's DavisBaseCamera and DVS128), AEDAT-3.1 and
AEDAT4 (iniVation's documentation), MCAP (its specification), messages in CDR.
"""

import struct

# ---- AEDAT-2.0


def aedat2(records, *lines: str, chip: str | None = "eu.seebetter.ini.chips.davis.DAVIS240C"):
    """records: (address, time)"""
    lines = ["#!AER-DAT2.0", "# a line", *([f"# AEChip: {chip}"] if chip else []), *lines]
    head = "".join(line + "\r\n" for line in lines).encode()
    return head + b"".join(struct.pack(">II", a, t & 0xFFFFFFFF) for a, t in records)


def davis(x: int, y: int, p: int, width=240, height=180, edge=0) -> int:
    """The address of an event, x and y from the upper left corner."""
    return (height - 1 - y) << 22 | (width - 1 - x) << 12 | p << 11 | edge << 10


def dvs128(x: int, y: int, p: int) -> int:
    return (127 - y) << 8 | (127 - x) << 1 | (1 - p)


def pixel(x: int, y: int, level: int, exposed: int, height=180) -> int:
    return 1 << 31 | (height - 1 - y) << 22 | x << 12 | exposed << 10 | level


IMU = 1 << 31 | 0x155 << 12 | 3 << 10
EDGE = 1 << 10


# ---- AEDAT-3.1


def aedat31(*packets: bytes, sources=("Source 1: DAVIS240C",), kind="RAW") -> bytes:
    lines = ["#!AER-DAT3.1", f"#Format: {kind}", *(f"#{source}" for source in sources)]
    lines += ["#Start-Time: 2017-01-01 00:00:00 (TZ+0100)", "#!END-HEADER"]
    return "".join(line + "\r\n" for line in lines).encode() + b"".join(packets)


def packet31(kind: int, entries: list[bytes], wraps=0, source=1, time_at=4) -> bytes:
    size = len(entries[0]) if entries else 8
    count = len(entries)
    head = struct.pack("<hhiiiiii", kind, source, size, time_at, wraps, count, count, count)
    return head + b"".join(entries)


def polarity31(t: int, x: int, y: int, p: int, valid=1) -> bytes:
    return struct.pack("<Ii", x << 17 | y << 2 | p << 1 | valid, t)


def special31(t: int, kind: int, valid=1) -> bytes:
    return struct.pack("<Ii", kind << 1 | valid, t)


def frame31(times, picture, valid=1, corner=(0, 0)) -> bytes:
    """times: of the frame's begin and end, and of the exposure's; picture: (H, W) or (H, W, C)"""
    height, width, channels = (*picture.shape, 1)[:3]
    head = struct.pack("<I8i", channels << 1 | valid, *times, width, height, *corner)
    return head + picture.astype("<u2").tobytes()


# ---- AEDAT4: flatbuffers, whose tables say where their fields are


def _table(fields: list[tuple[str, int]]) -> bytes:
    """A table whose fields lie in this order, their places before it; what it points to follows."""
    size, places = 4, []
    for kind, _ in fields:
        size += -size % struct.calcsize(kind)
        places.append(size)
        size += struct.calcsize(kind)
    size += -size % 8
    entries = struct.pack("<HH", 4 + 2 * len(fields), size)
    entries += b"".join(struct.pack("<H", place) for place in places)
    entries += bytes(-len(entries) % 8)
    table = bytearray(struct.pack("<i", len(entries)) + bytes(size - 4))
    for place, (kind, value) in zip(places, fields, strict=True):
        struct.pack_into("<" + kind, table, place, value)
    return entries + bytes(table)


def _start(table: bytes) -> int:
    """Where the table begins behind its list of places."""
    count = struct.unpack_from("<H", table)[0]
    return count + -count % 8


def _with_field(identifier: bytes, fields) -> tuple[bytearray, int]:
    """A flatbuffer of one table, and where its last field lies, which says how far it points."""
    table = _table(fields)
    start = 8 + _start(table)
    last = struct.unpack_from("<H", table, 2 + 2 * len(fields))[0]
    return bytearray(struct.pack("<I", start) + identifier + table), start + last


def aedat4(streams: dict[int, tuple], packets) -> bytes:
    """streams: number: (kind, width, height), and perhaps a camera; packets: (stream, bytes);
    nothing is compressed"""
    nodes = "".join(
        f'<node name="{number}" path="/mainloop/output/{number}/"><attr key="typeIdentifier" '
        f'type="string">{kind}</attr><node name="info"><attr key="sizeX" type="int">{width}</attr>'
        f'<attr key="sizeY" type="int">{height}</attr>'
        + "".join(f'<attr key="source" type="string">{camera}</attr>' for camera in cameras)
        + "</node></node>"
        for number, (kind, width, height, *cameras) in streams.items()
    )
    text = f'<dv version="2.0"><node name="outInfo" path="/">{nodes}</node></dv>'.encode()
    header, place = _with_field(b"IOHE", [("i", 0), ("q", -1), ("i", 0)])
    struct.pack_into("<i", header, place, len(header) - place)
    header += struct.pack("<I", len(text)) + text + b"\0"
    data = b"".join(struct.pack("<ii", number, len(body)) + body for number, body in packets)
    return b"#!AER-DAT4.0\r\n" + struct.pack("<I", len(header)) + bytes(header) + data


def _packet4(identifier: bytes, count: int, content: bytes) -> bytes:
    """One vector in a table."""
    body, place = _with_field(identifier, [("i", 0)])
    body += bytes(-(len(body) + 4) % 8)  # entries of 8 bytes lie at multiples of 8
    struct.pack_into("<i", body, place, len(body) - place)
    body += struct.pack("<I", count) + content
    return struct.pack("<I", len(body)) + bytes(body)


def events4(events) -> bytes:
    """(t, x, y, p)"""
    return _packet4(b"EVTS", len(events), b"".join(struct.pack("<qhhb3x", *e) for e in events))


def triggers4(triggers) -> bytes:
    """(t, kind): a vector of places of tables"""
    tables, places, at = b"", [], 4 * len(triggers)
    at += -at % 8
    for time, kind in triggers:
        table = _table([("q", time), ("b", kind)])
        places.append(at + len(tables) + _start(table))
        tables += table
    offsets = b"".join(struct.pack("<I", place - 4 * i) for i, place in enumerate(places))
    return _packet4(b"TRIG", len(triggers), offsets + bytes(at - len(offsets)) + tables)


# ---- MCAP


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def _record(kind: int, content: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(content)) + content


def mcap(chunks, kind="event_camera_msgs/msg/EventPacket", pack=None, how="") -> bytes:
    """chunks: lists of (time in ns, message); no index, as of a recording that was broken off"""
    file = b"\x89MCAP0\r\n" + _record(1, _text("ros2") + _text("by hand"))
    for number, messages in enumerate(chunks):
        inside = b""
        if not number:
            inside += _record(3, struct.pack("<H", 1) + _text(kind) + _text("ros2msg") + _text(""))
            inside += _record(
                4, struct.pack("<HH", 1, 1) + _text("/events") + _text("cdr") + _text("")
            )
        for time, data in messages:
            inside += _record(5, struct.pack("<HIQQ", 1, 0, time, time) + data)
        packed = pack(inside) if pack else inside
        head = struct.pack("<QQQI", messages[0][0], messages[-1][0], len(inside), 0)
        file += _record(6, head + _text(how) + struct.pack("<Q", len(packed)) + packed)
        file += _record(7, struct.pack("<HI", 1, 0))  # an index, of nothing
    return file


def event_packet(time: int, payload: bytes, encoding: str, base=0, size=(240, 320)) -> bytes:
    """An EventPacket in CDR; time: microseconds, base: nanoseconds, size: (height, width)"""
    out = bytearray(struct.pack("<II", time // 10**6, time % 10**6 * 1000))

    def text(value: str):
        data = value.encode() + b"\0"
        out.extend(bytes(-len(out) % 4) + struct.pack("<I", len(data)) + data)

    text("camera")
    out += bytes(-len(out) % 4) + struct.pack("<II", *size)
    out += bytes(-len(out) % 8) + struct.pack("<QQ", 1, base)
    text(encoding)
    out += b"\0"
    out += bytes(-len(out) % 4) + struct.pack("<I", len(payload)) + payload
    return b"\0\1\0\0" + bytes(out)
