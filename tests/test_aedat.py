"""AEDAT-2.0, AEDAT-3.1 and AEDAT4's triggers: files put together by hand (formats.py); samples
against a loop over their records."""

import struct

import formats
import numpy as np
import pytest
from formats import (
    EDGE,
    IMU,
    aedat2,
    aedat31,
    davis,
    dvs128,
    packet31,
    pixel,
    polarity31,
    special31,
)
from test_readers import check, events_of, refused, write

from firenet_jax.readers import aedat2 as reader2
from firenet_jax.readers import aedat3 as reader3
from firenet_jax.readers import open_recording

T = np.array([1000, 1500, 1500, 20_000, 3_000_007])
X = np.array([0, 5, 239, 7, 2])
Y = np.array([3, 0, 8, 179, 1])
P = np.array([1, 0, 0, 1, 1], bool)
EVENTS = list(zip(X.tolist(), Y.tolist(), P.tolist(), strict=True))
RECORDS = [(davis(*event), t) for event, t in zip(EVENTS, T.tolist(), strict=True)]


def edges(recording) -> list[tuple[int, int, bool]]:
    found = recording.triggers()
    assert [column.dtype.kind for column in found] == ["i", "i", "b"]
    return list(zip(*(column.tolist() for column in found), strict=True))


# ---------------------------------------------------------------- AEDAT-2.0


@pytest.mark.parametrize("chunk", [1, 2, 3, 1 << 18])
def test_davis(tmp_path, monkeypatch, chunk):
    """Events among samples of the IMU and edges at the trigger input."""
    monkeypatch.setattr(reader2, "CHUNK", chunk)
    records = [(IMU, 900), *RECORDS[:2], (EDGE, 1500), *RECORDS[2:4], (IMU, 20_001), *RECORDS[4:]]
    path = write(tmp_path / "a.aedat", aedat2([*records, (EDGE, 3_000_008)]))
    check(path, T, X, Y, P, size=None)
    recording = open_recording(path)
    assert (recording.height, recording.width, recording.format) == (180, 240, "AEDAT-2.0")
    assert recording.frames is None and recording.grey and not recording.inferred
    assert edges(recording) == [(1500, 0, True), (3_000_008, 0, True)]
    assert open_recording(write(tmp_path / "b.aedat2", aedat2(RECORDS))).triggers() is None


@pytest.mark.parametrize(
    "chip, height, width",
    [("davis.Davis346blue", 260, 346), ("davis.Davis640", 480, 640), ("DAVIS240B", 180, 240)],
)
def test_sizes_of_chips(tmp_path, chip, height, width):
    records = [(davis(x, y, 1, width, height), 5) for x, y in ((0, 0), (width - 1, height - 1))]
    path = write(tmp_path / "a.aedat", aedat2(records, chip=f"eu.seebetter.ini.chips.{chip}"))
    check(path, [5, 5], [0, width - 1], [0, height - 1], [1, 1], size=None)
    assert open_recording(path).width == width


@pytest.mark.parametrize("chip", ["ch.unizh.ini.jaer.chip.retina.DVS128", None])
def test_dvs128(tmp_path, caplog, chip):
    x, y = X % 128, Y % 128
    records = [(dvs128(*e), t) for *e, t in zip(x.tolist(), y.tolist(), P.tolist(), T, strict=True)]
    path = write(tmp_path / "a.aedat", aedat2([*records, (1 << 15, 3_000_007)], chip=chip))
    check(path, T, x, y, P, size=None)
    assert open_recording(path).height == 128
    assert edges(open_recording(path)) == [(3_000_007, 0, True)]
    assert ("names no chip; by its addresses a DVS128 of 128x128" in caplog.text) == (chip is None)


@pytest.mark.parametrize("size", [(180, 240), (260, 346), (480, 640)])
def test_v2e(tmp_path, caplog, size):
    """It names no chip, turns both axes round, and has another layout for 640x480."""
    (height, width), shifts = size, (1, 11, 0) if size == (480, 640) else (12, 22, 11)
    x, y = X * (width // 240), Y * (height // 180)
    x[3], y[3], x[4], y[4] = 0, 0, width - 1, height - 1
    fields = width - 1 - x, height - 1 - y, P
    address = sum(field.astype(int) << shift for field, shift in zip(fields, shifts, strict=True))
    line = "# This is a raw AE data file created by AEDat2Output in v2e"
    content = aedat2(zip(address.tolist(), T.tolist(), strict=True), line, chip=None)
    path = write(tmp_path / "a.aedat", content)
    check(path, T, x, y, P, size=None)
    assert (open_recording(path).height, open_recording(path).width) == size
    assert f"of {width}x{height} pixels" in caplog.text
    caplog.clear()
    check(path, T, x, y, P, size=size)
    assert not caplog.text


def test_size_of_a_file_without_a_chip_is_the_given_one(tmp_path):
    records = [(davis(3, 4, 1, 346, 260), 1), (davis(340, 250, 1, 346, 260), 2)]
    path = write(tmp_path / "a.aedat", aedat2(records[1:], chip=None))
    check(path, [2], [340], [250], [1], size=(260, 346))
    assert open_recording(path).width == 240  # the smallest that fits


def test_noise_that_v2e_labels_is_events(tmp_path):
    line = "# noise events are labeled as addressed external input events"
    records = [(davis(*event, edge=1), t) for event, t in zip(EVENTS, T.tolist(), strict=True)]
    path = write(tmp_path / "a.aedat", aedat2(records, line, chip=None))
    check(path, T, X, Y, P, size=None)
    assert open_recording(path).triggers() is None


@pytest.mark.parametrize("chunk", [1, 2, 1 << 18])
def test_times_that_start_again(tmp_path, monkeypatch, chunk):
    monkeypatch.setattr(reader2, "CHUNK", chunk)
    times = [2**31 - 1, 2**31, 2**32 - 1, 2**32 + 4]
    path = write(tmp_path / "a.aedat", aedat2([(davis(1, 1, 1), t) for t in times]))
    check(path, times, [1] * 4, [1] * 4, [1] * 4, size=None)


def test_where_the_header_ends(tmp_path):
    """The first event's first byte is that of #; a line says where the header ends."""
    first = davis(5, 179 - 0x23 * 4, 1)  # row 140 from the bottom
    assert first >> 24 == 0x23
    path = write(tmp_path / "a.aedat", aedat2([(first, 7), *RECORDS]))
    assert events_of(path, None).t.tolist()[:2] == [7, 1000]
    path = write(tmp_path / "a.aedat", aedat2([(first, 0x23230D0A)], "#End Of ASCII Header"))
    assert events_of(path, None).t.tolist() == [0x23230D0A]


def test_wrong_aedat2(tmp_path, caplog):
    whole = aedat2(RECORDS)
    cut = write(tmp_path / "cut.aedat", whole[:-3])
    refused(cut, "ends within an event: the file is cut off", size=None)
    caplog.clear()
    assert len(events_of(cut, None)) == 4
    assert "what comes before is read: 4 events" in caplog.text
    for version in ("1.0", "9.9"):
        path = write(tmp_path / "v.aedat", whole.replace(b"DAT2.0", f"DAT{version}".encode()))
        refused(path, f"is AEDAT-{version}, expected 2.0, 3.1 or 4.0", size=None)
    path = write(tmp_path / "v.aedat", whole[2:])
    refused(path, "names no version of AEDAT", size=None)
    path = write(tmp_path / "chip.aedat", aedat2(RECORDS, chip="ch.unizh.ini.jaer.CochleaAMS"))
    refused(path, "is of the chip CochleaAMS, expected a DAVIS, DVS128 or DVS640", size=None)
    path = write(tmp_path / "no.aedat", aedat2([(0x7FFFFFFF, 1)], chip=None))
    refused(path, "names no chip", "neither those of a DAVIS nor", size=None)
    outside = (400 << 12 | 3 << 22, 1500)
    path = write(tmp_path / "outside.aedat", aedat2([RECORDS[0], outside]))
    refused(path, "event 2: x is -161", size=None)


# ---- Frames of a DAVIS


def scan(order, levels, exposed, start, step):
    """Records of one reading of all pixels; levels: (H, W)"""
    height = len(levels)
    return [
        (pixel(x, y, int(levels[y, x]), exposed, height), start + i * step)
        for i, (x, y) in enumerate(order)
    ]


def orders(height, width):
    """As sensors read them out: by columns or rows, from one corner to the opposite one."""
    columns = [(x, y) for x in range(width) for y in range(height)]
    rows = [(x, y) for y in range(height) for x in range(width)]
    return [columns, columns[::-1], rows, [(width - 1 - x, y) for x, y in columns]]


@pytest.fixture
def small_sensor(monkeypatch):
    """A chip that an obvious loop can write."""
    monkeypatch.setitem(reader2.aedat.SENSORS, "davis240|dvs240|sbret", (12, 16))
    return 12, 16


@pytest.mark.parametrize("chunk", [7, 100, 1 << 18])
@pytest.mark.parametrize("order", range(4))
def test_frames_of_a_global_shutter(tmp_path, monkeypatch, small_sensor, order, chunk):
    monkeypatch.setattr(reader2, "CHUNK", chunk)
    rng, records, pictures, middles = np.random.default_rng(0), [], [], []
    order = orders(*small_sensor)[order]
    for number in range(3):
        begin = 10_000 * (number + 1)
        reset = rng.integers(500, 1024, small_sensor)
        picture = rng.integers(-20, 500, small_sensor)
        reads = scan(order, reset, 0, begin, 1)
        later = scan(order, reset - picture, 1, begin + 3000, 2)
        middles.append((begin + len(order) - 1 + begin + 3000) // 2)
        pictures.append(np.clip(picture, 0, 1023) >> 2)
        event = [(davis(3, 4, 1, 16, 12), begin + 1500)]
        records += [*reads, (IMU, begin + 1000), *event, *later]
    path = write(tmp_path / "a.aedat", aedat2(records))
    recording = open_recording(path)
    assert recording.frames.times.tolist() == middles
    for number in (2, 0, 1):
        np.testing.assert_array_equal(recording.frames.read(number), pictures[number])
    assert recording.frames.read(0).dtype == np.uint8
    check(path, [11_500, 21_500, 31_500], [3] * 3, [4] * 3, [1] * 3, size=None)


def test_frames_of_a_rolling_shutter(tmp_path, small_sensor):
    """Columns are reset and read by turns: those read are four columns behind."""
    rng, records, pictures, middles = np.random.default_rng(1), [], [], []
    columns = orders(*small_sensor)[0]
    for number in range(2):
        reset, picture = rng.integers(500, 900, small_sensor), rng.integers(0, 400, small_sensor)
        ready = scan(columns, reset, 0, 0, 0), scan(columns, reset - picture, 1, 0, 0)
        now, times = 5000 * number, ([], [])
        for column in range(16 + 4):
            for kind, at in ((0, column), (1, column - 4)):
                if 0 <= at < 16:
                    for address, _ in ready[kind][12 * at : 12 * at + 12]:
                        records.append((address, now))
                        times[kind].append(now)
                        now += 3
        pictures.append(picture >> 2)
        middles.append(np.mean(times))
    frames = open_recording(write(tmp_path / "a.aedat", aedat2(records))).frames
    assert np.abs(frames.times - middles).max() <= 1
    for number, picture in enumerate(pictures):
        np.testing.assert_array_equal(frames.read(number), picture)


def test_frames_that_are_not_whole_are_left_out(tmp_path, small_sensor):
    """The recording begins and ends within a picture, and a pixel of the second is lost."""
    order, records = orders(*small_sensor)[0], []
    for number in range(4):
        begin, level = 10_000 * number, np.full(small_sensor, 100 * number + 100)
        records += scan(order, level + 400, 0, begin, 1) + scan(order, level, 1, begin + 1000, 1)
    size = 2 * len(order)
    records = records[5 : size + 20] + records[size + 21 : -3]
    frames = open_recording(write(tmp_path / "a.aedat", aedat2(records))).frames
    assert frames.times.tolist() == [(20_000 + len(order) - 1 + 21_000) // 2]
    assert (frames.read(0) == 100).all()


# ---------------------------------------------------------------- AEDAT-3.1

PICTURE = np.arange(12).reshape(3, 4) * 5000


def polarities(first=0, last=5, **options):
    rows = zip(T[first:last].tolist(), EVENTS[first:last], strict=True)
    return packet31(1, [polarity31(t, *event) for t, event in rows], **options)


@pytest.mark.parametrize("piece", [2, 1 << 18])
def test_aedat31(tmp_path, monkeypatch, piece):
    monkeypatch.setattr(reader3, "PIECE", piece)
    specials = [(1200, 2), (1300, 3), (1400, 1), (1450, 6), (1460, 10), (1470, 4), (1480, 14)]
    bad = [polarity31(1600, 1, 1, 1, valid=0), polarity31(1700, 9, 9, 0)]
    path = write(
        tmp_path / "a.aedat",
        aedat31(
            packet31(0, [special31(*entry) for entry in specials]),
            polarities(0, 3),
            packet31(3, [bytes(36)] * 2),  # an IMU
            packet31(1, bad),
            packet31(2, [formats.frame31((0, 90, 10, 50), PICTURE)], time_at=12),
            polarities(3, 5, source=2),  # another camera
            polarities(3, 5),
            packet31(0, [special31(5, 3), special31(6, 2, valid=0)], wraps=1),
            sources=("-Source 0: DVS128", "Source 1: DAVIS240C", "Source 2: DVS128"),
        ),
    )
    check(path, *(np.insert(c, 3, v) for c, v in ((T, 1700), (X, 9), (Y, 9), (P, 0))), size=None)
    recording = open_recording(path)
    assert (recording.height, recording.width, recording.format) == (180, 240, "AEDAT-3.1")
    assert edges(recording) == [
        (1200, 0, True), (1300, 0, False), (1450, 1, True), (1460, 2, False), (1470, 0, True),
        (2**31 + 5, 0, False),
    ]  # fmt: skip
    assert recording.frames.times.tolist() == [30]
    np.testing.assert_array_equal(recording.frames.read(0), PICTURE >> 8)


def test_times_of_aedat31_that_start_again(tmp_path):
    path = write(tmp_path / "a.aedat", aedat31(polarities(), polarities(wraps=2)))
    both = (np.tile(column, 2) for column in (X, Y, P))
    check(path, np.append(T, T + 2**32), *both, size=None)


def test_frames_of_aedat31(tmp_path):
    colours = np.stack([PICTURE, PICTURE * 0, PICTURE * 0], -1)  # red
    frames = [formats.frame31((0, 0, t, t + 2), PICTURE) for t in (10, 20)]
    path = write(
        tmp_path / "a.aedat",
        aedat31(
            polarities(),
            packet31(2, frames),
            packet31(2, [formats.frame31((0, 0, 30, 32), PICTURE, valid=0)]),
            packet31(2, [formats.frame31((0, 0, 40, 42), PICTURE, corner=(1, 0))]),
            packet31(2, [formats.frame31((0, 0, 50, 52), colours)]),
        ),
    )
    found = open_recording(path).frames
    assert found.times.tolist() == [11, 21, 51]
    np.testing.assert_array_equal(found.read(1), PICTURE >> 8)
    np.testing.assert_array_equal(found.read(2), np.rint(0.299 * (PICTURE >> 8)))


def test_wrong_aedat31(tmp_path, caplog):
    whole = aedat31(polarities(0, 3), polarities(3, 5))
    cut = write(tmp_path / "cut.aedat", whole[:-3])
    refused(cut, "where no whole packet is", size=None)
    caplog.clear()
    assert len(events_of(cut, None)) == 3
    assert "what comes before is read: 3 events" in caplog.text
    refused(write(tmp_path / "a.aedat", whole.replace(b"DAT3.1", b"DAT3.0")), "is AEDAT-3.0")
    refused(write(tmp_path / "a.aedat3", whole[1:]), "names no version")
    path = write(tmp_path / "a.aedat", aedat31(polarities(), kind="SerializedTS"))
    refused(path, "stored as SerializedTS, expected RAW")
    refused(write(tmp_path / "a.aedat", aedat31(packet31(3, [bytes(36)]))), "holds no events")
    path = write(tmp_path / "a.aedat", aedat31(packet31(1, [bytes(12)] * 2)))
    refused(path, "has entries of 12 bytes")
    path = write(tmp_path / "a.aedat", aedat31(polarities(), sources=("Source 1: File",)))
    assert open_recording(path).inferred
    assert "240x180 inferred" in caplog.text


def test_a_damaged_frame_of_aedat31_is_left_out_and_told(tmp_path, caplog):
    good, bad, last = (formats.frame31((0, 0, t, t + 2), PICTURE) for t in (10, 20, 30))
    bad = bad[:20] + struct.pack("<i", 4000) + bad[24:]  # its width
    path = write(tmp_path / "a.aedat", aedat31(polarities(), packet31(2, [good, bad, last])))
    assert open_recording(path).frames.times.tolist() == [11, 31]
    assert "a.aedat: damaged frames are left out: 1, the first at byte " in caplog.text


# ---------------------------------------------------------------- AEDAT4


@pytest.mark.parametrize("name", ["a.aedat4", "a.aedat"])
def test_triggers_of_aedat4(tmp_path, name):
    rows = [(t, *event) for t, event in zip(T.tolist(), EVENTS, strict=True)]
    streams = {0: ("EVTS", 240, 180), 3: ("TRIG", 0, 0)}
    first = [(20, 0), (30, 1), (40, 2), (45, 6), (50, 3)]
    packets = [
        (3, formats.triggers4(first)),
        (0, formats.events4(rows)),
        (3, formats.triggers4([])),
    ]
    packets.append((3, formats.triggers4([(60, 4), (70, 5)])))
    whole = formats.aedat4(streams, packets)
    path = write(tmp_path / name, whole)
    check(path, T, X, Y, P, size=None)
    expected = [(30, 0, True), (40, 0, False), (50, 0, True), (60, 1, True), (70, 1, False)]
    assert edges(open_recording(path)) == expected
    assert edges(open_recording(write(path, whole[:-20]))) == expected[:3]
    path = write(tmp_path / name, formats.aedat4(streams, packets[1:2]))
    assert open_recording(path).triggers() is None
    path = write(tmp_path / name, formats.aedat4({0: streams[0]}, packets[1:2]))
    assert open_recording(path).triggers() is None


def test_of_several_cameras_in_an_aedat4_all_streams_are_of_the_first(tmp_path, caplog):
    ours, other = "DVXplorer_7", "DAVIS346_9"
    streams = {
        0: ("TRIG", 0, 0, other),
        1: ("EVTS", 640, 480, ours),
        2: ("EVTS", 346, 260, other),
        3: ("TRIG", 0, 0, ours),
    }
    rows = [(t, *event) for t, event in zip(T.tolist(), EVENTS, strict=True)]
    packets = [
        (0, formats.triggers4([(10, 1)])),
        (2, formats.events4([(5, 1, 1, 1)])),
        (1, formats.events4(rows)),
        (3, formats.triggers4([(30, 1)])),
    ]
    path = write(tmp_path / "a.aedat4", formats.aedat4(streams, packets))
    check(path, T, X, Y, P, size=None)
    recording = open_recording(path)
    assert (recording.height, recording.width, recording.grey) == (480, 640, True)
    assert edges(recording) == [(30, 0, True)]
    assert f"streams of {other}, too; reading those of {ours}" in caplog.text
    del streams[3]
    assert open_recording(write(path, formats.aedat4(streams, packets[:3]))).triggers() is None
    streams = {number: stream[:3] for number, stream in streams.items()}  # no cameras named
    path = write(tmp_path / "b.aedat4", formats.aedat4(streams, packets[:3]))
    assert edges(open_recording(path)) == [(10, 0, True)]


# ---------------------------------------------------------------- real recordings


@pytest.mark.parametrize("name, count", [("boxes", 162_771), ("rotating_disk", 374_296)])
def test_samples_against_a_loop_over_their_records(recordings, name, count):
    data = (recordings / f"davis240_{name}.aedat").read_bytes()
    begin = data.index(b"#End of Preferences for this AEChip\r\n") + 37
    expected = []
    for address, time in struct.iter_unpack(">II", data[begin:]):
        if not address >> 31:
            assert not address & EDGE
            x, y = address >> 12 & 0x3FF, address >> 22 & 0x1FF
            expected.append((time, 239 - x, 179 - y, address >> 11 & 1))
    recording = open_recording(recordings / f"davis240_{name}.aedat")
    events = events_of(recording.path, None)
    assert len(events) == len(expected) == count
    np.testing.assert_array_equal(
        np.stack([events.t, events.x, events.y, events.p], 1), np.array(expected)
    )
    assert recording.frames is None and recording.triggers() is None
