"""Readers: small files of every format, written here; what must be refused; the real recordings.

Expected events are the arrays below, or bits put together by hand from the formats' descriptions.
"""

import builtins
import contextlib
import gzip
import importlib.util
import io
import itertools
import re
import struct
import sys
import zipfile
from pathlib import Path

import formats
import h5py
import numpy as np
import pyarrow
import pytest
from PIL import Image

from firenet_jax import readers
from firenet_jax.checkpoint import load_weights, save_weights
from firenet_jax.errors import RecordingError, SettingsError
from firenet_jax.events import Events, _out_of_order, checked, concatenate
from firenet_jax.readers import (
    aedat4,
    dat,
    ecd,
    evt3,
    hdf5,
    libcaer,
    ncaltech,
    open_recording,
    raw,
    rosbag,
    text,
    torn_bag,
)

T = np.array([1000, 1500, 1500, 20_000, 3_000_007])  # microseconds
X = np.array([0, 5, 319, 7, 2])
Y = np.array([3, 0, 8, 239, 1])
P = np.array([1, 0, 0, 1, 1], bool)
EVENTS = list(zip(T.tolist(), X.tolist(), Y.tolist(), P.astype(int).tolist(), strict=True))
ROWS = [f"{t / 1e6:.6f} {x} {y} {p}" for t, x, y, p in EVENTS]
FRAME = np.arange(12, dtype=np.uint8).reshape(3, 4) * 20


def events_of(path, size=(240, 320), strict=False) -> Events:
    return concatenate([Events.empty(), *open_recording(path, size, strict).events()])


def check(path, t=T, x=X, y=Y, p=P, size=(240, 320)):
    events = events_of(path, size)
    for name, kind, expected in zip("txyp", ("i8", "i2", "i2", "?"), (t, x, y, p), strict=True):
        column = getattr(events, name)
        assert column.dtype == kind
        np.testing.assert_array_equal(column, expected)


def refused(path, *said, size=(240, 320)):
    """Reading raises RecordingError, in one sentence that names the file and says all of this."""
    with pytest.raises(RecordingError) as error:
        events_of(path, size, strict=True)
    message = str(error.value)
    assert str(path) in message and "\n" not in message
    for words in said:
        assert words in message, message


def write(path: Path, content: str | bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def without(monkeypatch, package: str):
    """As if the package were not installed."""
    for name in [name for name in sys.modules if name.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    real = builtins.__import__

    def refusing(name, *args, **kwargs):
        if name.split(".")[0] == package:
            raise ImportError(name)
        return real(name, *args, **kwargs)

    load = importlib.import_module
    monkeypatch.setattr(builtins, "__import__", refusing)
    monkeypatch.setattr(importlib, "import_module", lambda name: refusing(name) and load(name))


# ---------------------------------------------------------------- any format


def test_what_is_no_recording(tmp_path):
    refused(tmp_path / "missing.txt", "no such file")
    refused(write(tmp_path / "empty.txt", ""), "is empty")
    refused(write(tmp_path / "film.mp4", b"x"), "not a recording of a known format")
    refused(tmp_path, "not a recording of a known format", f"name them: {tmp_path}/*")
    refused(Path("/dev/null"), "is a pipe or device")


def test_sensor_size_is_inferred_with_a_notice(tmp_path, caplog):
    path = write(tmp_path / "events.txt", "\n".join(ROWS))
    recording = open_recording(path)
    assert (recording.height, recording.width) == (240, 320)
    assert "320x240 inferred" in caplog.text
    with pytest.raises(RecordingError, match="holds no events"):
        open_recording(write(tmp_path / "none.txt", "\n\n"))


def test_a_sensor_size_is_height_and_width_or_text(tmp_path):
    path = write(tmp_path / "events.txt", "\n".join(ROWS))
    for size in ((260, 346), "346x260", np.array([260, 346])):
        recording = open_recording(path, sensor_size=size)
        assert (recording.height, recording.width) == (260, 346)
    for size in (
        "346",
        346,
        (346,),
        (0, 5),
        (1.5, 3),
        (np.nan, 3),
        (np.inf, 3),
        (None, 3),
        (2**16, 2),
    ):
        with pytest.raises(SettingsError, match="expected|at most"):
            open_recording(path, sensor_size=size)


def test_numbers_that_events_cannot_hold():
    good = np.arange(3), np.arange(3), np.arange(3), np.arange(3) % 2
    for column, value, said in (
        (0, [0, 1, np.nan], "event 13: the time is nan"),
        (0, [0, 1, np.inf], "event 13: the time is inf"),
        (0, np.array([0, 2**63, 1], np.uint64), "event 12: the time is 9223372036854775808"),
        (1, [0, 40_000, 1], "event 12: x is 40000, expected a coordinate below 32768"),
        (1, [0, 1, 0.5], "event 13: x is 0.5, expected a whole number"),
        (2, np.array([-40_000, 0, 1]), "event 11: y is -40000"),
        (2, [0, np.nan, 1], "event 12: y is nan"),
        (3, [0, 1, 2], "event 13: the polarity is 2, expected 0 or 1"),
        (3, [0, 0.5, 1], "event 12: the polarity is 0.5"),
        (3, np.array([0, 255, 1], np.uint8), "event 12: the polarity is 255"),
        (0, np.array(["a", "b", "c"]), "the time is stored as <U1"),
    ):
        columns = [*good]
        columns[column] = np.asarray(value)
        with pytest.raises(RecordingError) as error:
            list(checked([readers.to_events(Path("file"), 10, *columns)], Path("file"), None, None))
        assert said in str(error.value)


def test_unwrap():
    wrapped = np.array([250, 255, 3, 2, 200, 255, 0])
    expected = np.array([250, 255, 259, 258, 456, 511, 512])
    np.testing.assert_array_equal(readers.unwrap(wrapped, 8, 0), expected)
    first = readers.unwrap(wrapped[:3], 8, 0)
    pieces = [*first, *readers.unwrap(wrapped[3:], 8, int(first[-1]))]
    np.testing.assert_array_equal(pieces, expected)
    assert readers.unwrap(np.array([], np.int64), 8, 5).size == 0
    # One value that is damaged is no turn, before the first wrap and after it; a pause may be one.
    for before, wrong in ((0, 250), (0, 129), (1, 200)):
        spike = np.array([20, 21, wrong, wrong, 21, 30]) + 256 * before
        found = readers.unwrap(spike % 256, 8, 20 + 256 * before)
        np.testing.assert_array_equal(found, spike)

    def checked_by_hand(bits, last, counter, expected):
        found = readers.unwrap(np.array(counter), bits, last)
        np.testing.assert_array_equal(found, expected)

    most = (1 << 32) - 1
    twice = [1000, most, 1001, 1002, most, 1003, 1004]
    checked_by_hand(32, 0, twice, twice)
    twice = [0, 1, 4090, 2, 3, 4091, 4, 5, 6]
    checked_by_hand(12, 0, twice, twice)
    checked_by_hand(12, 3000, [3000, 100, 3001, 3002], [3000, 100, 3001, 3002])  # a low one
    turns = [500, 3000, 4000, 4095, 0, 1, 2000, 4000, 0, 2000, 4000, 1]
    checked_by_hand(12, 0, turns, np.array(turns) + 4096 * np.repeat([0, 1, 2, 3], [4, 4, 3, 1]))
    one = 65536
    late = [20 + one, 40_000 + one, 21 + one, 65534, 25 + one, 30 + one]
    checked_by_hand(16, 20 + one, np.array(late) % one, late)
    pause = readers.unwrap(np.array([20, 200, 10, 150, 15]), 8, 0)
    np.testing.assert_array_equal(pause, [20, 200, 266, 406, 527])
    assert readers.unwrap(np.array([250, 0]), 8, 0).tolist() == [250, 256]  # the first may be any
    late = readers.unwrap(np.array([65530, 3, 65534, 65534, 9, 40_000, 1]), 16, 0)  # once round
    assert late.tolist() == [65530, 65539, 65534, 65534, 65545, 105_536, 131_073]


def test_joined():
    chunks = [Events.of([i] * 3, [0] * 3, [0] * 3, [0] * 3) for i in range(5)]
    assert [len(chunk) for chunk in readers.joined(chunks, 6)] == [6, 6, 3]
    assert list(readers.joined([Events.empty()])) == []


def test_unwrap_of_counters_some_of_whose_values_are_damaged():
    """The others are told right, whatever these are, and in pieces if there are none."""
    rng = np.random.default_rng(0)
    for _ in range(300):
        times = np.cumsum(rng.integers(0, 3, 4000)) + rng.integers(0, 4000)  # some two turns
        hit = 5 + 10 * rng.choice(398, 3, replace=False)
        counter = times % 4096
        counter[hit] = rng.integers(0, 4096, 3)
        right = np.delete(np.arange(4000), hit)
        found = readers.unwrap(counter, 12, int(times[0]))
        np.testing.assert_array_equal(found[right], times[right])
        last, pieces = int(times[0]), []
        for piece in np.array_split(times, rng.integers(1, 30)):
            pieces.append(readers.unwrap(piece % 4096, 12, last))
            last = int(pieces[-1][-1])
        np.testing.assert_array_equal(np.concatenate(pieces), times)


def test_frames_of_other_kinds():
    path = Path("file")
    np.testing.assert_array_equal(readers.to_frame(FRAME[..., None], path), FRAME)
    np.testing.assert_array_equal(readers.to_frame(FRAME.astype(np.uint16) << 8, path), FRAME)
    for colours in ([FRAME] * 3, [FRAME] * 3 + [FRAME * 0]):  # and how opaque
        np.testing.assert_array_equal(readers.to_frame(np.stack(colours, -1), path), FRAME)
    with pytest.raises(RecordingError, match="float64 of shape"):
        readers.to_frame(FRAME / 255, path)


@pytest.mark.parametrize("name, package", [("a.es", "faery"), ("a.bag", "rosbags")])
def test_missing_extra(tmp_path, monkeypatch, name, package):
    without(monkeypatch, package)
    path = write(tmp_path / name, "% evt 3.0\n")
    refused(path, package, 'in the source folder, pip install ".[formats]"')


# ---------------------------------------------------------------- text

US = [f"{t} {x} {y} {p}" for t, x, y, p in EVENTS]
XYPT = [f"{x},{y},{p},{t}" for t, x, y, p in EVENTS]
TEXTS = {
    "plain": "\n".join(ROWS) + "\n",
    "size": "320 240\n" + "\n".join(ROWS) + "\n",
    "no end": "320 240\n" + "\n".join(ROWS),
    "CRLF": "320 240\r\n" + "\r\n".join(ROWS) + "\r\n",
    "empty lines": "\n320 240\n\n" + "\n\n".join(ROWS) + "\n  \n\n",
    "tabs": "\n".join(ROWS).replace(" ", "\t"),
    "commas": "\n".join(ROWS).replace(" ", ","),
    "commas, spaces": "\n".join(ROWS).replace(" ", " , "),
    "runs of spaces": "\n".join(f"  {row} " for row in ROWS).replace(" ", "   "),
    "tabs and spaces": "\n".join(ROWS).replace(" ", " \t"),
    "byte order mark": "\ufeff" + "\n".join(ROWS),
    "byte order mark, size": "\ufeff320 240\n" + "\n".join(ROWS),
    "exponents": "\n".join(f"{t / 1e6:.9e} {x}.0 {y}e0 {p}.0" for t, x, y, p in EVENTS),
    "minus one": "\n".join(row[:-1] + row[-1].replace("0", "-1") for row in ROWS),
    "names": "x,y,note,p,t\n" + "\n".join(f"{x},{y},?,{p},{t / 1e6}" for t, x, y, p in EVENTS),
    "names with units": '# by hand\n"timestamp (s)", x, y, polarity\n'
    + "\n".join(ROWS).replace(" ", ","),
    "names with spaces": "# t x y p\n" + "\n".join(ROWS),
    "a name with a unit beside": "t,x,y,p,t_ns,x_s\n"
    + "".join(f"{row.replace(' ', ',')},7,8\n" for row in ROWS),
}


@pytest.mark.parametrize("content", TEXTS.values(), ids=TEXTS)
def test_text(tmp_path, content):
    path = write(tmp_path / "events.txt", content)
    check(path)
    recording = open_recording(path, None if "320 240" in content else (240, 320))
    assert (recording.height, recording.width, recording.format) == (240, 320, "text")


@pytest.mark.parametrize("whole", [True, False], ids=["whole", "decimals"])
@pytest.mark.parametrize(
    "name, unit",
    [("t_us", 1), ("time [us]", 1), ("timestamp (ns)", 1e-3), ("t_ns", 1e-3), ("time_ms", 1e3),
     ("ts [ms, since start]", 1e3), ("time (s)", 1e6), ("timestamp (nanoseconds)", 1e-3),
     ("t_s,t_ns", 1e-3), ("t_s,t_us", 1)],
)  # fmt: skip
def test_text_in_the_unit_that_its_names_tell(tmp_path, caplog, name, unit, whole):
    times = T if unit <= 1 or not whole else T // unit * unit
    rows = [(t, x, y, p) for t, (_, x, y, p) in zip(times, EVENTS, strict=True)]
    before = "0," * name.count(",t_")
    shown = (lambda t: round(t / unit)) if whole else (lambda t: float(t / unit))
    lines = [f"{before}{shown(t)!r},{x},{y},{p}" for t, x, y, p in rows]
    path = write(tmp_path / "a.csv", f"{name},x [px],y,p\n" + "\n".join(lines))
    np.testing.assert_array_equal(events_of(path, (240, 320)).t, times)
    assert "read as microseconds" not in caplog.text


def test_hexadecimal_is_no_number_wherever_it_is(tmp_path):
    rows = [f"{1e-4 * i:.4f} 1 2 1" for i in range(3000)]
    rows[7], rows[9] = "0.0007 0x1 2 1", "0.0009 1 0X2 1"
    path = write(tmp_path / "a.txt", "\n".join(rows))
    assert len(events_of(path)) == 2998
    refused(path, "line 8: x is 0x1, expected a whole number")


def test_a_text_is_read_again_for_one_message_only(tmp_path, monkeypatch):
    """Not for each of its blocks with an event out of order: that takes a time of n squared."""
    monkeypatch.setattr(text, "BLOCK", 1 << 15)
    again = []
    monkeypatch.setattr(text, "_place", lambda *arguments: again.append(1) or "some line")
    times = np.arange(20_000) / 1e4
    times[3000::3000] -= 1
    path = write(tmp_path / "a.txt", "".join(f"{t:.4f} 1 2 1\n" for t in times))
    assert len(events_of(path)) == 20_000 - 6
    assert len(again) == 1


@pytest.mark.parametrize("word", ["hello", "1.2.3", "nan.", "xe"])
def test_a_bad_row_says_nothing_of_the_unit_of_the_others(tmp_path, word):
    rows = [f"{50 * i} {i % 64} {i % 48} {i % 2}" for i in range(2000)]
    rows[500] = f"{word} {word} 4 1"
    path = write(tmp_path / "a.txt", "64 48\n" + "\n".join(rows))
    expected = np.delete(50 * np.arange(2000), 500)
    np.testing.assert_array_equal(events_of(path, None).t, expected)


@pytest.mark.parametrize("block", [64, 1 << 21])
@pytest.mark.parametrize(
    "off, on", [("False", "True"), ("false", "true"), ("-1", "+1"), ("0", "+1")]
)
@pytest.mark.parametrize("order", ["t x y p", "p,t,x,y", "x, y, p, t", "t\tp\tx\ty"])
def test_text_with_polarities_of_other_words(tmp_path, monkeypatch, order, off, on, block):
    monkeypatch.setattr(text, "BLOCK", block)
    rows = []
    for t, x, y, p in EVENTS:
        values = {"t": f"{t / 1e6:.6f}", "x": x, "y": y, "p": on if p else off}
        rows.append(re.sub("[txyp]", lambda name, values=values: str(values[name[0]]), order))
    path = write(tmp_path / "a.txt", order + "\n" + "\n".join(rows))
    check(path)
    write(path, order + "\n" + "\n".join([*rows, rows[-1].replace(on, "yes")]))
    expected = "False or True" if on in ("True", "true") else "0 or 1"
    refused(path, f"line 7: the polarity is yes, expected {expected}")


@pytest.mark.parametrize("word", ["+-1", "++1", "+"])
def test_a_number_has_one_sign(tmp_path, word):
    path = write(tmp_path / "a.txt", f"0.1 1 2 +1\n0.2 1 2 -1\n0.3 1 2 {word}\n")
    refused(path, f"line 3: the polarity is {word}, expected 0 or 1")


@pytest.mark.parametrize("size", ["0 0", "320 0", "999999 180"])
def test_a_sensor_that_cannot_be_is_refused(tmp_path, size):
    said = "states a sensor of " + size.replace(" ", "x")
    refused(write(tmp_path / "a.txt", f"{size}\n0.1 3 2 1\n"), said, size=None)


def test_a_sensor_with_more_pixels_than_any_is_refused(tmp_path):
    said = "a sensor of 6000x6000 pixels, expected at most 16,777,216"
    refused(write(tmp_path / "a.txt", "6000 6000\n0.1 3 2 1\n"), f"states {said}", size=None)
    path = write(tmp_path / "b.txt", "0.1 5999 5999 1\n")
    refused(path, f"has events that lie on {said}", size=None)
    with pytest.raises(SettingsError, match="a sensor has at most 16,777,216 pixels"):
        open_recording(path, "6000x6000")
    with pytest.raises(SettingsError, match="a sensor has at most 16,777,216 pixels"):
        open_recording(path, (6000, 6000))


def test_whole_seconds_are_said_as_they_may_be_microseconds(tmp_path, caplog):
    for name, step, said in (("us", 1.0, True), ("seconds", 0.125, False)):
        lines = "\n".join(f"{step * k!r} 1 2 1" for k in range(1000))
        caplog.clear()
        t = events_of(write(tmp_path / f"{name}.txt", lines), (240, 320)).t
        assert t.tolist() == [round(1e6 * step * k) for k in range(1000)]
        assert ("t_us x y p" in caplog.text) == said


@pytest.mark.parametrize("kind", ["f8", "f4"])
@pytest.mark.parametrize("form", ["h5", "folder", "npy"])
def test_times_that_may_be_wrong_are_said(tmp_path, caplog, form, kind):
    t = (1000 + 61e-6 * np.arange(2000)).astype(kind)
    whole = np.arange(2000).astype(kind)
    for times, said in ((t, "tells these times apart by 61 us"), (whole, "though whole ones")):
        caplog.clear()
        ones = np.ones(len(times), np.int16)
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}"
        if form == "h5":
            with h5py.File(path, "w") as file:
                for name, column in {"ts": times, "xs": ones, "ys": ones, "ps": ones}.items():
                    file[f"events/{name}"] = column
        elif form == "folder":
            path.mkdir()
            np.save(path / "events_ts.npy", times)
            np.save(path / "events_xy.npy", np.stack([ones, ones], -1))
            np.save(path / "events_p.npy", ones)
        else:
            path = path.with_suffix(".npy")
            np.save(path, np.stack([times, ones, ones, ones], -1).astype(kind))
        open_recording(path, (240, 320))
        assert (said in caplog.text) == (kind == "f4" or times is whole)


@pytest.mark.parametrize(
    "bad",
    [
        "0.5 1 x 1",
        "0.5 1 2",
        "0.05 1 2 1",
        "0.5 1 999 1",
        "0.5 40000 2 1",
        "nan 1 2 1",
        "0.5 1 2 7",
    ],
)
def test_events_before_the_damage_are_read(tmp_path, bad):
    good = [f"{k / 10} 1 2 1" for k in range(5)]
    recording = open_recording(
        write(tmp_path / "a.txt", "\n".join([*good, bad, *good])), (240, 320)
    )
    read = []
    with pytest.raises(RecordingError, match="line 6"):
        for events in recording.events():
            read.append(events.t)
    assert np.concatenate(read).tolist() == [100_000 * k for k in range(5)]


def test_text_in_microseconds(tmp_path, caplog):
    check(write(tmp_path / "a.csv", "t,x,y,p\n" + "\n".join(US).replace(" ", ",")))
    assert "read as microseconds" in caplog.text
    path = write(tmp_path / "metavision.csv", "%geometry:320,240\n" + "\n".join(XYPT))
    check(path, size=None)
    caplog.clear()
    check(write(tmp_path / "seconds.txt", "\n".join(ROWS)))
    assert not caplog.text


@pytest.mark.parametrize("block", [20, 33, 64, 1000])
@pytest.mark.parametrize("content", ["plain", "size", "no end", "empty lines", "CRLF"])
def test_text_in_blocks(tmp_path, monkeypatch, block, content):
    monkeypatch.setattr(text, "BLOCK", block)
    check(write(tmp_path / "events.txt", TEXTS[content]))


def test_compressed_text(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("folder/events.txt", TEXTS["size"])
        archive.writestr("__MACOSX/folder/._events.txt", "x")
    check(tmp_path / "a.zip", size=None)
    with gzip.open(tmp_path / "a.txt.gz", "wb") as file:
        file.write(TEXTS["size"].encode())
    check(tmp_path / "a.txt.gz", size=None)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_compressions_that_python_unpacks_whole_are_refused(tmp_path, method):
    """A kilobyte of them may hold gigabytes, whatever size the archive states."""
    for name, member in (("a.zip", "events.txt"), ("a.npz", "t.npy")):
        with zipfile.ZipFile(tmp_path / name, "w", method) as archive:
            archive.writestr(member, TEXTS["size"])
        refused(tmp_path / name, f"'{member}' is compressed by another method than deflate")


def test_damaged_compressed_text(tmp_path):
    content = "320 240\n" + "".join(f"{i / 1e6:.6f} {i % 320} 7 1\n" for i in range(5000))
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("events.txt", content)
    whole = (tmp_path / "a.zip").read_bytes()
    refused(write(tmp_path / "cut.zip", whole[:-100]), "cannot be read")
    refused(write(tmp_path / "no.zip", "not a zip"), "cannot be read")
    crc = struct.pack("<I", zipfile.crc32(content.encode()))
    assert whole.count(crc) == 2  # before the data and in the list at the end
    refused(write(tmp_path / "crc.zip", whole.replace(crc, b"\0" * 4)), "Bad CRC-32")
    for place in range(whole.index(b"PK\x01\x02"), len(whole)):  # the list of what is in it
        for byte in (0, whole[place] ^ 0xFF):
            path = write(tmp_path / "list.zip", whole[:place] + bytes([byte]) + whole[place + 1 :])
            with contextlib.suppress(RecordingError):
                events_of(path, (240, 320))
    packed = gzip.compress(content.encode())
    refused(write(tmp_path / "cut.txt.gz", packed[: len(packed) // 2]), "cannot be read")
    with zipfile.ZipFile(tmp_path / "two.zip", "w") as archive:
        archive.writestr("a.txt", content)
        archive.writestr("b.txt", content)
    refused(tmp_path / "two.zip", "holds 2 text files (a.txt, b.txt) where one is expected")
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("a.png", content)
        archive.writestr("b.png", content)
    refused(tmp_path / "other.zip", "holds 0 text files where one is expected")


@pytest.mark.parametrize("rows", [5000, 300_000])  # one block of text, and several
@pytest.mark.parametrize("damage", ["cut", "changed"])
def test_what_comes_before_damaged_compression_is_read(tmp_path, rows, damage):
    content = "320 240\n" + "".join(f"{i / 1e6:.6f} {i % 320} 7 1\n" for i in range(rows))
    packed = gzip.compress(content.encode())
    half = len(packed) // 2
    packed = packed[:half] + b"\xff" * 64 * (damage == "changed") + packed[half + 64 :]
    path = write(tmp_path / "a.txt.gz", packed[:half] if damage == "cut" else packed)
    times = []
    # Changed bytes may still be unpacked, to other text.
    said = "a.txt.gz: cannot be read" if damage == "cut" else "a.txt.gz"
    with pytest.raises(RecordingError, match=said):
        for events in open_recording(path, strict=True).events():
            times += events.t.tolist()
    assert times == list(range(len(times)))
    assert len(times) > 0.4 * rows


@pytest.mark.parametrize("rows", [60_000, 360_000])
def test_what_comes_before_damage_in_a_zip_is_read(tmp_path, rows):
    content = "".join(f"{i / 1e6:.6f} {i * 7919 % 320} {i % 180} {i % 2}\n" for i in range(rows))
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.txt", content)
    whole = (tmp_path / "a.zip").read_bytes()
    at = len(whole) * 9 // 10
    path = write(tmp_path / "a.zip", whole[:at] + b"\xff" * 64 + whole[at + 64 :])
    count = 0
    with contextlib.suppress(RecordingError):  # what is unpacked may still be, to other text
        for events in open_recording(path, (240, 320)).events():
            count += len(events)
    assert count > 0.8 * rows - 4000


@pytest.mark.parametrize(
    "content, said",
    [
        ("0.1 1 2 1\n\n0.2 1 2 1 9\n", "line 3: five words instead of four: '0.2 1 2 1 9'"),
        ("320 240\n0.1 1 2 1\n0.2 1 2\n", "line 3: three words instead of four"),
        ("0.1 1 2 1\n0.2\n", "line 2: one word instead of four"),
        ("t,x,y,p\n.1,1,2,1\n.2,1,2,1,7\n", "line 3: five words instead of four"),
        ("0.1 1 2 1\nnan 1 2 1\n", "line 2: the time is nan"),
        ("0.1 1 2 1\n1_0.1 1 2 1\n0.3 1 2\n", "line 2: the time is 1_0.1"),
        ("0.1 1 2 1\n\ninf 1 2 1\n", "line 3: the time is inf"),
        ("0.1 1 2 1\n0,2 1 2 1\n", "line 2: the time is 0,2, expected a number of seconds"),
        ("1 1 2 1\n0.5 1 2 1\n" * 600, "line 2"),
        ("1 1 2 1\n" * 1000 + "1.5 1 2 1\n", "line 1001: the time is 1.5, expected whole micro"),
        ("0.1 1 2 1\n0.2 one 2 1\n", "line 2: x is one, expected a whole number below 32768"),
        ("0.1 1 2 1\n0.2 1 2.5 1\n" + "0.2 1 2 1\n" * 9, "line 2: y is 2.5"),
        ("0.1 1 2 1\n0.2 1 99999999999 1\n", "line 2: y is 99999999999"),
        ("0.1 1 2 1\n\n0.2 40000 2 1\n", "line 3: x is 40000"),
        ("0.1 1 2 1\n0.2 1 2 7\n", "line 2: the polarity is 7, expected 0 or 1"),
        ("0.1 1 2 1\n0.2 1 2 True\n", "line 2: the polarity is True, expected 0 or 1"),
        ("0.1 1 2 1\n\n0.2 -1 2 1\n", "line 3: x is -1, but coordinates are 0 or more"),
        ("0.1 1 2 1\n0.2 1 240 1\n", "line 2: y is 240, outside the sensor of 320x240"),
        ("320 240\n\n0.1 1 2 1\n0.3 1 2 1\n0.2 1 2 1\n", "line 5: time runs backwards"),
        ("hello\n0.1 1 2 1\n", "line 1: 'hello' where numbers"),
        ("t,x,y\n0.1,1,2\n", "line 1: 't,x,y' where numbers, or the names of columns"),
        ("\x00\x01\x02\x03", "line 1"),
        (b"\xff\xfe0\x001\x00", "line 1"),
    ],
)
def test_wrong_text(tmp_path, content, said):
    refused(write(tmp_path / "events.txt", content), said)


def test_wrong_lines_far_into_a_text(tmp_path, monkeypatch):
    monkeypatch.setattr(text, "BLOCK", 100)
    lines = ["320 240", *(f"{i / 1e6:.6f} {i % 320} 7 1" for i in range(50))]

    def with_line(number: int, line: str) -> Path:
        changed = lines[: number - 1] + ["", line] + lines[number:]
        return write(tmp_path / "events.txt", "\n".join(changed))

    refused(with_line(40, "0.000039 1 2"), "line 41: three words")
    refused(with_line(40, "nan 1 2 1"), "line 41: the time is nan")
    refused(with_line(40, "0.000039 -3 2 1"), "line 41: x is -3")
    for number in range(30, 40):  # across the boundary of two blocks, too
        refused(with_line(number, "0.000002 1 2 1"), f"line {number + 1}: time runs backwards")
    refused(write(tmp_path / "endless.txt", "0" * 100_000), "line 1: does not end")


# ---------------------------------------------------------------- ECD


def ecd_files() -> dict[str, bytes]:
    files = {
        "events.txt": b"0.001 0 2 1\n0.0015 3 0 0\n",
        "images.txt": b"0.001 images/a.png\n0.0025 images/b.png\n",
        "calib.txt": b"1 2 3\n",
    }
    for name, picture in (("a", FRAME), ("b", FRAME[::-1])):
        Image.fromarray(picture).save(buffer := io.BytesIO(), "png")
        files[f"images/{name}.png"] = buffer.getvalue()
    return files


def ecd_folder(path: Path) -> Path:
    for name, content in ecd_files().items():
        write(path / name, content)
    return path


def check_ecd(path: Path):
    check(path, [1000, 1500], [0, 3], [2, 0], [1, 0], size=None)
    recording = open_recording(path)
    assert (recording.height, recording.width) == (3, 4)
    np.testing.assert_array_equal(recording.frames.times, [1000, 2500])
    np.testing.assert_array_equal(recording.frames.read(0), FRAME)
    np.testing.assert_array_equal(recording.frames.read(1), FRAME[::-1])


def test_ecd_folder(tmp_path):
    check_ecd(ecd_folder(tmp_path))


@pytest.mark.parametrize("folder", ["", "slider_depth/"])
def test_ecd_zip(tmp_path, folder):
    with zipfile.ZipFile(tmp_path / "slider.zip", "w") as archive:
        for name, content in ecd_files().items():
            archive.writestr(folder + name, content)
    check_ecd(tmp_path / "slider.zip")


def test_ecd_without_frames(tmp_path, caplog):
    folder = ecd_folder(tmp_path)
    (folder / "images/b.png").unlink()
    with pytest.raises(RecordingError, match="b.png: there is no such file: copy the rec"):
        open_recording(folder).frames.read(1)
    (folder / "images/a.png").unlink()
    assert open_recording(folder, (3, 4)).frames is None
    assert "images/a.png, which is not there" in caplog.text
    (folder / "images.txt").unlink()
    assert open_recording(folder, (3, 4)).frames is None


def test_ecd_whose_pictures_are_damaged(tmp_path, caplog):
    """The events can be read, and an error of any kind names the picture."""
    folder = ecd_folder(tmp_path)
    whole = (folder / "images/a.png").read_bytes()
    for place in range(len(whole)):
        write(folder / "images/a.png", whole[:place] + bytes([5]) + whole[place + 1 :])
        with contextlib.suppress(RecordingError):
            open_recording(folder, (3, 4)).frames.read(0)
    write(folder / "images/a.png", whole[:11] + b"\5" + whole[12:])
    assert events_of(folder, None).x.tolist() == [0, 3]
    assert "images/a.png: cannot be read" in caplog.text and "4x3 inferred" in caplog.text
    caplog.clear()
    assert events_of(folder, (3, 4)).x.tolist() == [0, 3]
    write(folder / "images.txt", "0.001 images/a.png\n1e300 images/b.png\n")
    refused(folder, "images.txt, frame 2: its time is 1e+300")


def test_ecd_zip_without_its_pictures(tmp_path, caplog):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        for name, content in ecd_files().items():
            if not name.endswith(".png"):
                archive.writestr(name, content)
    assert open_recording(tmp_path / "a.zip", (3, 4)).frames is None
    assert "images/a.png, which is not there" in caplog.text


def test_ecd_pictures_of_16_bits(tmp_path):
    folder = ecd_folder(tmp_path)
    Image.fromarray(FRAME.astype(np.uint16) << 8 | 0x5A).save(folder / "images/a.png")
    np.testing.assert_array_equal(open_recording(folder).frames.read(0), FRAME)


def test_wrong_ecd(tmp_path):
    folder = ecd_folder(tmp_path)
    write(folder / "events.txt", "0.1 1 2 1\n0.05 1 2 1\n")
    refused(folder, "events.txt, line 2: time runs backwards", size=None)
    write(folder / "images/b.png", b"no picture")
    with pytest.raises(RecordingError, match="b.png: cannot be read"):
        open_recording(folder).frames.read(1)
    for line in ("nan images/a.png", "0.1", "x images/a.png"):
        write(folder / "images.txt", f"0.0 images/a.png\n{line}\n")
        refused(folder, "images.txt, line 2")


@pytest.mark.parametrize("name", ["/dev/zero", "../secret.png", "images/../../a.png"])
def test_ecd_names_no_pictures_elsewhere(tmp_path, name):
    folder = ecd_folder(tmp_path / "recording")
    write(folder / "images.txt", f"0.0 images/a.png\n0.1 {name}\n")
    refused(folder, f"images.txt, line 2: '{name}' lies outside the recording")


def test_ecd_of_enormous_parts(tmp_path, monkeypatch):
    folder = ecd_folder(tmp_path)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 5)
    with pytest.raises(RecordingError, match="a.png: cannot be read .*bomb"):
        open_recording(folder, (3, 4)).frames.read(0)
    monkeypatch.setattr(ecd, "MAX_BYTES", 30)
    refused(folder, "images.txt: is larger than")


# ---------------------------------------------------------------- HDF5


def write_cnn(path: Path, t=T / 1e6, x=X, y=Y, p=P, size=(240, 320)) -> Path:
    with h5py.File(path, "w") as file:
        for name, column in zip(("ts", "xs", "ys", "ps"), (t, x, y, p), strict=True):
            file[f"events/{name}"] = column
        file["images/image000000000"] = FRAME
        file["images/image000000001"] = FRAME[::-1]
        for i, name in enumerate(sorted(file["images"])):
            file["images"][name].attrs["timestamp"] = i / 10
        if size:
            file.attrs["sensor_resolution"] = size
    return path


def check_frames(path: Path, times):
    frames = open_recording(path).frames
    np.testing.assert_array_equal(frames.times, times)
    np.testing.assert_array_equal(frames.read(1), FRAME[::-1])
    np.testing.assert_array_equal(frames.read(0), FRAME)


def test_hdf5_event_cnn_minimal(tmp_path):
    path = write_cnn(tmp_path / "a.h5")
    check(path, size=None)
    check_frames(path, [0, 100_000])
    recording = open_recording(path)
    assert (recording.height, recording.width, recording.count) == (240, 320, 5)
    check(write_cnn(tmp_path / "us.h5", t=T))  # integers: microseconds
    check(write_cnn(tmp_path / "no_suffix"))
    recording = open_recording(write_cnn(tmp_path / "b.h5", size=None, x=X % 4, y=Y % 3))
    assert (recording.height, recording.width) == (3, 4)  # of the frames
    with h5py.File(path, "a") as file:  # as MATLAB writes numbers
        for name, image in file["images"].items():
            image.attrs["timestamp"] = np.array([int(name[-1]) / 10])
    check_frames(path, [0, 100_000])
    with h5py.File(path, "a") as file:
        for image in file["images"].values():
            image.attrs["timestamp"] = [0.1, 0.2]
    refused(path, "timestamps of shape (2,), not one")


def test_a_picture_of_hdf5_that_claims_to_be_enormous_is_not_unpacked(tmp_path):
    path = write_cnn(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        del file["images/image000000001"]
        picture = file.create_dataset("images/image000000001", (40_000, 30_000), "u1", chunks=True)
        picture.attrs["timestamp"] = 0.1  # a few bytes on disk
    with pytest.raises(RecordingError, match=r"claims a picture of shape \(40000, 30000\)"):
        open_recording(path).frames.read(1)


def test_hdf5_dsec(tmp_path):
    hdf5plugin = pytest.importorskip("hdf5plugin")
    with h5py.File(tmp_path / "events.h5", "w") as file:
        for name, column, kind in zip("txyp", (T, X, Y, P), "u4 u2 u2 u1".split(), strict=True):
            packed = {"data": column.astype(kind), "compression": hdf5plugin.Blosc()}
            file.create_dataset(f"events/{name}", **packed)
        file["t_offset"] = 5_000_000_000
    check(tmp_path / "events.h5", t=T + 5_000_000_000)
    with h5py.File(tmp_path / "events.h5", "a") as file:
        del file["t_offset"]
        file["t_offset"] = [7_000_000]
    check(tmp_path / "events.h5", t=T + 7_000_000)
    with h5py.File(tmp_path / "b.h5", "w") as file:
        for name, column in zip("txyp", (T, X, Y, P), strict=True):
            file[f"events/{name}"] = column
        file.create_dataset("t_offset", (10**9,), "i8", chunks=(1000,))  # a few bytes on disk
    refused(tmp_path / "b.h5", "t_offset has the shape (1000000000,), expected one number")
    assert open_recording(tmp_path / "events.h5", (240, 320)).count == 5


def test_hdf5_without_its_compression(tmp_path, monkeypatch):
    with h5py.File(tmp_path / "events.h5", "w") as file:
        for name, column in zip("txyp", (T, X, Y, P), strict=True):
            file.create_dataset(f"events/{name}", data=column, compression="gzip")
    check(tmp_path / "events.h5")
    without(monkeypatch, "hdf5plugin")
    monkeypatch.setattr(h5py.h5z, "filter_avail", lambda number: False)
    refused(tmp_path / "events.h5", "hdf5plugin", 'in the source folder, pip install ".[formats]"')


@pytest.mark.parametrize("number, name", [(36559, "Metavision's ECF"), (40001, "filter 40001")])
def test_hdf5_whose_compression_has_no_plugin(tmp_path, number, name):
    pytest.importorskip("hdf5plugin")
    kind = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
    with h5py.File(tmp_path / "events.h5", "w") as file:
        stored = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        stored.set_chunk((100,))
        stored.set_filter(number, h5py.h5z.FLAG_OPTIONAL, ())
        space, kind = h5py.h5s.create_simple((100,)), h5py.h5t.py_create(kind)
        group = file.create_group("CD").id
        data = h5py.Dataset(h5py.h5d.create(group, b"events", kind, space, stored))
        data.id.write_direct_chunk((0,), b"packed")
    refused(tmp_path / "events.h5", f"compressed by {name}", "HDF5_PLUGIN_PATH")


def test_hdf5_mvsec(tmp_path):
    path = tmp_path / "indoor.hdf5"
    with h5py.File(path, "w") as file:
        seconds = 1.5e9 + T / 1e6
        file["davis/left/events"] = np.stack([X % 4, Y % 3, seconds, np.where(P, 1, -1)], 1)
        file["davis/left/image_raw"] = np.stack([FRAME, FRAME[::-1]])
        file["davis/left/image_raw_ts"] = [1.5e9, 1.5e9 + 0.1]
    check(path, T + 1_500_000_000_000_000, X % 4, Y % 3, size=None)
    check_frames(path, [1_500_000_000_000_000, 1_500_000_000_100_000])


def write_mvsec(path: Path, **left) -> Path:
    with h5py.File(path, "w") as file:
        file["davis/left/events"] = np.stack([X, Y, T / 1e6, np.where(P, 1, -1)], 1)
        for name, data in left.items():
            file[f"davis/left/{name}"] = data
    return path


def test_mvsec_without_pictures(tmp_path):
    nothing = {"image_raw": np.zeros((0, 3, 4), np.uint8), "image_raw_ts": np.zeros(0)}
    for left in ({}, nothing):
        path = write_mvsec(tmp_path / "a.hdf5", **left)
        check(path)
        assert open_recording(path, (240, 320)).frames is None
        assert open_recording(path).inferred


def test_wrong_pictures_of_mvsec(tmp_path):
    path, pictures = tmp_path / "a.hdf5", np.stack([FRAME, FRAME])
    for image_raw, times, said in (
        (pictures, [0.1], "image_raw has the shape (2, 3, 4), image_raw_ts (1,): expected pic"),
        (pictures, [], "image_raw_ts (0,): expected pictures and the time of each"),
        (pictures, 0.1, "image_raw_ts (): expected"),
        (7, [0.1], "image_raw has the shape (), image_raw_ts (1,): expected"),
    ):
        refused(write_mvsec(path, image_raw=image_raw, image_raw_ts=times), f"{said}")
    refused(write_mvsec(path, image_raw=pictures), "davis/left/image_raw_ts is missing: expected")
    for group in ("image_raw", "image_raw_ts"):
        arrays = {"image_raw": pictures, "image_raw_ts": [0.1, 0.2], f"{group}/a": 1}
        del arrays[group]
        refused(write_mvsec(path, **arrays), f"davis/left/{group} is a group, expected an array")


def test_pictures_of_hdf5_are_in_the_order_of_their_numbers(tmp_path):
    """Which some programs write without zeros."""
    path = write_cnn(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        del file["images"]
        for i in range(12):
            file[f"images/image{i}"] = FRAME + i
            file[f"images/image{i}"].attrs["timestamp"] = i / 10
            file[f"flow/flow{i}"] = np.full((2, *FRAME.shape), i, np.float32)
    frames = open_recording(path).frames
    np.testing.assert_array_equal(frames.times, 100_000 * np.arange(12))
    for i in range(12):
        np.testing.assert_array_equal(frames.read(i), FRAME + i)
        assert (frames.flow(i) == i).all()


def test_hdf5_in_chunks(tmp_path, monkeypatch):
    path = write_cnn(tmp_path / "a.h5")
    monkeypatch.setattr(readers, "CHUNK", 2)
    assert [len(chunk) for chunk in open_recording(path).events()] == [2, 2, 1]
    check(path)
    path = write_cnn(tmp_path / "b.h5", t=np.array([0.1, 0.2, 0.15, 0.3, 0.4]))
    refused(path, "event 3: time runs backwards")  # across the boundary of two chunks
    path = write_cnn(tmp_path / "c.h5", t=np.array([0.1, 0.2, 0.3, np.nan, 0.4]))
    refused(path, "event 4: the time is nan")


def test_wrong_hdf5(tmp_path):
    path = write_cnn(tmp_path / "a.h5", *(np.resize(column, 9000) for column in (T, X, Y, P)))
    refused(write(tmp_path / "cut.h5", path.read_bytes()[:-5000]), "cannot be read")
    refused(write(tmp_path / "text.h5", "hello"), "cannot be read")
    path = write_cnn(tmp_path / "short.h5", x=X[:-1])
    refused(path, "its columns differ in length", "/events/xs (4,)")
    refused(write_cnn(tmp_path / "big.h5", x=X + 40_000), "event 1: x is 40000")
    refused(write_cnn(tmp_path / "p.h5", p=P * 3), "event 1: the polarity is 3")
    refused(write_cnn(tmp_path / "minus.h5", y=-Y), "event 1: y is -3, but coordinates are 0 or")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["events/CD"] = X
    refused(tmp_path / "other.h5", "holds events, events/CD, expected the columns events/xs")
    with h5py.File(write_cnn(tmp_path / "group.h5"), "a") as file:
        del file["events/xs"]
        file.create_group("events/xs")
    refused(tmp_path / "group.h5", "expected the columns events/xs")
    with h5py.File(tmp_path / "shape.h5", "w") as file:
        file["davis/left/events"] = np.zeros((4, 3))
    refused(tmp_path / "shape.h5", "has the shape (4, 3), expected (N, 4)")
    with h5py.File(write_cnn(tmp_path / "frames.h5"), "a") as file:
        del file["images/image000000001"].attrs["timestamp"]
    refused(tmp_path / "frames.h5", "timestamp")
    assert not hdf5.matches(tmp_path)


# ---------------------------------------------------------------- .npy


RESOLUTION = '{"sensor_resolution": [240, 320]}'


@pytest.mark.parametrize("name", ["events", "events/xs", "images", "images/image000000000"])
@pytest.mark.parametrize("kind", ["group", "number"])
def test_cnn_with_something_else_under_a_known_name(tmp_path, name, kind):
    path = write_cnn(tmp_path / "a.h5", size=None)
    with h5py.File(path, "a") as file:
        del file[name]
        file.create_group(name) if kind == "group" else file.create_dataset(name, data=7)
    if (name, kind) == ("images", "group"):
        assert open_recording(path, (240, 320)).frames is None
    elif (name, kind) == ("images", "number"):
        refused(path, "images has the shape (), expected a group of pictures")
    else:
        refused(path)


@pytest.mark.parametrize("size", ["240x180", 180, [180], [180, np.nan]])
def test_cnn_with_a_strange_sensor_size(tmp_path, size):
    path = write_cnn(tmp_path / "a.h5", size=None)
    with h5py.File(path, "a") as file:
        file.attrs["sensor_resolution"] = size
    refused(path, f"sensor_resolution is {np.array(size)}, expected height and width in pixels")


@pytest.mark.parametrize("size", [[-24, 32], [0, 0], [100_000, 100_000]])
def test_cnn_with_a_sensor_that_cannot_be(tmp_path, size):
    refused(write_cnn(tmp_path / "a.h5", size=size), "states a sensor of", size=None)


@pytest.mark.parametrize("way", ["virtual", "link"])
def test_hdf5_does_not_read_other_files_by_links(tmp_path, way):
    write_cnn(tmp_path / "other.h5")
    path = write_cnn(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        count = len(file["events/ts"])
        if way == "link":
            del file["events"]
            file["events"] = h5py.ExternalLink("other.h5", "/events")
        else:
            del file["events/ts"]
            layout = h5py.VirtualLayout((count,), "f8")
            layout[:] = h5py.VirtualSource("other.h5", "events/ts", (count,))
            file.create_virtual_dataset("events/ts", layout)
    with pytest.raises(RecordingError, match="is stored in other files"):
        events_of(path)


@pytest.mark.parametrize("name", ["events/xs", "images/image000000001"])
def test_hdf5_does_not_read_other_files(tmp_path, name):
    write(tmp_path / "secret", bytes(1000))
    path = write_cnn(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        old = file[name]
        about = {"shape": old.shape, "dtype": old.dtype}
        stamp = old.attrs.get("timestamp", 0.0)
        del file[name]
        outside = [(str(tmp_path / "secret"), 0, h5py.h5f.UNLIMITED)]
        file.create_dataset(name, external=outside, **about).attrs["timestamp"] = stamp
    with pytest.raises(RecordingError, match=f"{name} is stored in other files"):
        recording = open_recording(path)
        recording.frames.read(1)


def test_hdf5_with_names_that_are_no_text(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file[b"\xff\xfe"] = 1
    refused(tmp_path / "a.h5", "expected the columns")


def write_npy(folder: Path, names, t=T / 1e6, p=P, metadata=RESOLUTION) -> Path:
    folder.mkdir(exist_ok=True)
    xy = np.stack([X, Y], 1).astype(np.int16)
    frames = np.stack([FRAME, FRAME[::-1]])
    for name, array in zip(names, (t, xy, p, frames, np.array([0, 0.1])), strict=True):
        np.save(folder / name, array)
    if metadata:
        write(folder / "metadata.json", metadata)
    return folder


EVREAL = ("events_ts", "events_xy", "events_p", "images", "images_ts")
MEMMAP = ("t", "xy", "p", "images", "timestamps")


@pytest.mark.parametrize("names", [EVREAL, MEMMAP], ids=["EVREAL", "event_cnn_minimal"])
def test_npy(tmp_path, names):
    path = write_npy(tmp_path, names)
    check(path, size=None)
    check_frames(path, [0, 100_000])
    assert open_recording(path).count == 5
    check(write_npy(tmp_path, names, t=T[:, None], p=P[:, None], metadata=None))
    np.save(tmp_path / "images.npy", np.zeros((0, 240, 320), np.uint8))
    np.save(tmp_path / names[4], np.zeros(0))
    assert open_recording(path, (240, 320)).frames is None
    (tmp_path / "images.npy").unlink()
    assert open_recording(path, (240, 320)).frames is None


def test_wrong_npy(tmp_path):
    refused(write_npy(tmp_path / "a", EVREAL, p=P[:-1]), "do not fit together", "p (4,)")
    refused(write_npy(tmp_path / "b", EVREAL, t=np.append(T[:-1], np.nan)), "event 5: the time is")
    folder = write_npy(tmp_path / "c", EVREAL, metadata="{")
    refused(folder, "metadata.json: cannot be read", size=None)
    folder = write_npy(tmp_path / "d", MEMMAP)
    np.save(folder / "t.npy", np.zeros((1, 0)))
    refused(folder, "its columns do not fit together")
    np.savez(tmp_path / "other.npz", a=T)
    (tmp_path / "other.npz").rename(tmp_path / "other.npy")
    refused(tmp_path / "other.npy", "other.npy: cannot be read (an .npz of another name)")
    write(folder / "t.npy", (folder / "t.npy").read_bytes()[:-8])
    refused(folder, "t.npy: cannot be read")
    np.save(folder / "t.npy", np.array([{}], object), allow_pickle=True)
    refused(folder, "t.npy: cannot be read")
    np.save(folder / "t.npy", T)
    np.save(folder / "timestamps.npy", np.array([0.1]))
    refused(folder, "has 2 frames in images.npy, but 1 times")
    for name, array in [("timestamps", np.array(["0", "1"])), ("images", np.float32(1))]:
        folder = write_npy(tmp_path / name, MEMMAP)
        np.save(folder / f"{name}.npy", array)
        refused(folder, f"{name}.npy")
    folder = write_npy(tmp_path / "e", EVREAL, metadata="[]")
    refused(folder, "metadata.json: cannot be read", size=None)


def test_npy_with_a_damaged_header(tmp_path):
    folder = write_npy(tmp_path / "a", MEMMAP)
    for path in (folder / "t.npy", folder / "timestamps.npy"):
        whole = path.read_bytes()
        for place in range(128):
            for byte in (ord("{"), whole[place] ^ 0xFF):
                path.write_bytes(whole[:place] + bytes([byte]) + whole[place + 1 :])
                with contextlib.suppress(RecordingError):
                    events_of(folder, (240, 320))
        path.write_bytes(whole)


# ---------------------------------------------------------------- N-Caltech101


def bin_event(t: int, x: int, y: int, p: int) -> bytes:
    return bytes([x, y]) + (p << 23 | t).to_bytes(3, "big")


def test_ncaltech(tmp_path, monkeypatch):
    t = np.array([6, 0x123456, 0x123456, 0x7FFFFF])
    events = [(6, 131, 2, 1), (0x123456, 0, 9, 0), (0x123456, 233, 179, 1), (0x7FFFFF, 1, 1, 0)]
    path = write(tmp_path / "a.bin", b"".join(bin_event(*event) for event in events))
    check(path, t, [131, 0, 233, 1], [2, 9, 179, 1], [1, 0, 1, 0])
    # Row 240 moves the clock on by 2^13 us.
    events = [(100, 1, 1, 1), (0, 0, 240, 0), (7, 2, 2, 0), (9, 5, 240, 1), (9, 3, 3, 1)]
    path = write(tmp_path / "b.bin", b"".join(bin_event(*event) for event in events))
    for chunk in (1000, 3, 2):
        monkeypatch.setattr(ncaltech, "CHUNK", chunk)
        check(path, [100, 8192 + 7, 2 * 8192 + 9], [1, 2, 3], [1, 2, 3], [1, 0, 1])
    refused(write(tmp_path / "cut.bin", path.read_bytes()[:-1]), "24 bytes", "multiple of 5")


@pytest.mark.parametrize("name", ["a.bin", "a.dat"])
def test_a_file_that_grows_is_read_as_far_as_it_went(tmp_path, name):
    header = b"" if name == "a.bin" else b"% Height 240\n% Width 320\n\x00\x08"
    event = bin_event(5, 1, 2, 1) if name == "a.bin" else struct.pack("<II", 5, 2 << 14 | 1)
    recording = open_recording(write(tmp_path / name, header + 4 * event), (240, 320))
    with (tmp_path / name).open("ab") as file:
        file.write(event[:3])
    assert [events.t.tolist() for events in recording.events()] == [[5] * 4]


# ---------------------------------------------------------------- DAT


def test_dat(tmp_path, monkeypatch):
    header = b"% Data file\n% Version 2\n% Width 320\n% Height 240\n"
    body = b"".join(struct.pack("<II", t, p << 28 | y << 14 | x) for t, x, y, p in EVENTS)
    for kind in (0x00, 0x0C):
        path = write(tmp_path / "a.dat", header + bytes([kind, 8]) + body)
        check(path, size=None)
        assert open_recording(path).count == 5
    for told in (b"%  Version 2", b"% Version: 2", b"% Version=2"):
        other = header.replace(b"% Version 2", told)
        check(write(tmp_path / "b.dat", other + b"\x0c\x08" + body), size=None)
    old = b"".join(struct.pack("<II", t, p << 17 | y << 9 | x) for t, x, y, p in EVENTS)
    for told in (b"% Version 1\n", b"% Version 0\n", b""):  # not told: that of the first files
        other = header.replace(b"% Version 2\n", told)
        check(write(tmp_path / "old.dat", other + b"\x0c\x08" + old))
    # 32 bits of microseconds start again after 71.6 minutes, within a chunk or between two
    times = [2**32 - 2, 2**32 - 1, 0, 5]
    body = b"".join(struct.pack("<II", t, 0) for t in times)
    path = write(tmp_path / "wrap.dat", header + b"\x00\x08" + body)
    for chunk in (100, 3, 2, 1):
        monkeypatch.setattr(dat, "CHUNK", chunk)
        zeros = [0] * 4
        check(path, [2**32 - 2, 2**32 - 1, 2**32, 2**32 + 5], zeros, zeros, zeros)
    refused(write(tmp_path / "cut.dat", path.read_bytes()[:-3]), "ends within an event")
    refused(write(tmp_path / "type.dat", header + b"\x0e\x08" + body), "type 0x0E and 8 bytes")
    nine = header.replace(b"ion 2", b"ion 9")
    refused(write(tmp_path / "version.dat", nine + b"\x00\x08"), "version 9")
    refused(write(tmp_path / "text.dat", "hello"), "no header")
    refused(write(tmp_path / "header.dat", header), "no header")


# ---------------------------------------------------------------- EVT3


def high(value):
    return 0x8000 | value & 0xFFF


def low(value):
    return 0x6000 | value


def row(y):
    return y


def single(x, p=0):
    return 0x2000 | p << 11 | x


def base(x, p=0):
    return 0x3000 | p << 11 | x


def decoded(*pieces):
    state, events = evt3.State(), []
    for words in pieces:
        state, columns = evt3.decode(state, np.array(words, np.uint16))
        events += zip(*(column.tolist() for column in columns), strict=True)
    return events


def test_evt3_words():
    words = [
        *(high(2), low(0x100), row(7), single(30, 1), single(31)),
        *(base(600, 1), 0x4000 | 0b100000000001, 0x5000 | 0b10000010, 0x5000 | 0b1),
        *(row(8), low(0x101), 0x4000 | 0b10, single(5)),
    ]
    t = 2 * 4096 + 0x100
    expected = [
        *((t, 30, 7, 1), (t, 31, 7, 0)),
        *((t, 600, 7, 1), (t, 611, 7, 1), (t, 613, 7, 1), (t, 619, 7, 1), (t, 620, 7, 1)),
        *((t + 1, 629, 8, 1), (t + 1, 5, 8, 0)),
    ]
    assert decoded(words) == expected
    for cut in range(len(words) + 1):
        assert decoded(words[:cut], words[cut:]) == expected
    assert decoded(*([word] for word in words)) == expected
    assert decoded([]) == []
    # Where a vector goes on does not depend on whether anything was told of the one before it.
    words = [row(7), base(5, 1), 0x4FFF, high(1), low(2), 0x4001]
    for cut in range(len(words) + 1):
        assert decoded(words[:cut], words[cut:]) == [(4096 + 2, 17, 7, 1)]


def test_evt3_time():
    ticks = [high(0xFFE), low(5), row(1), single(1), high(0xFFF), low(6), single(2), low(0xFFF)]
    ticks += [single(3), high(0), single(4), low(7), single(5), high(1), low(8), single(6)]
    start = 0xFFE << 12
    times = [start + 5, start + 4096 + 6, start + 8191, start + 8192, start + 8192 + 7]
    times += [start + 3 * 4096 + 8]
    for pieces in [ticks], [[word] for word in ticks], [ticks[:9], ticks[9:10], ticks[10:]]:
        assert [event[0] for event in decoded(*pieces)] == times
    # every 16.8 s, many times over
    long = [w for i in range(3 * 4096) for w in (high(i), low(0), row(0), single(0))]
    assert [event[0] for event in decoded(long)] == [i << 12 for i in range(3 * 4096)]
    # a repeated high part changes nothing
    assert decoded([high(1), low(9), row(0), high(1), single(3)]) == [(4096 + 9, 3, 0, 0)]
    # nothing is told before the first complete time, row and base
    words = [row(1), single(1), low(5), single(2), high(1), single(3), low(6), single(4)]
    assert decoded(words) == [(4096 + 6, 4, 1, 0)]
    assert decoded([high(1), low(1), single(1), row(1), 0x4001, single(2)]) == [(4097, 2, 1, 0)]
    # the sensor's small falls are evened out; others stay, to be refused
    words = [high(50), low(9), row(0), single(0), low(4), single(1), high(49), low(1), single(2)]
    assert [event[0] for event in decoded(words)] == [(50 << 12) + 9] * 3
    assert decoded([*words[:4], high(30), low(0)], [single(3)])[-1] == (30 << 12, 3, 0, 0)
    # ... and so they are after one time that is damaged
    latest, t = evt3.without_jitter(7, np.array([100, 90, 1 << 24, 110, 105, 120, 115]))
    assert t.tolist() == [100, 100, 1 << 24, 110, 110, 120, 120] and latest == 120
    times = np.array([10_000_000, 5_000_000, 9_970_000, 9_980_000, 10_000_001])
    latest, t = evt3.without_jitter(0, times)
    assert t.tolist() == [10**7, 5_000_000, 10**7, 10**7, 10_000_001] and latest == 10_000_001


# ---------------------------------------------------------------- camera files


def faery_events(faery, t=T):
    events = np.zeros(len(t), faery.EVENTS_DTYPE)
    events["t"], events["x"], events["y"], events["on"] = t, X, Y, P
    return events


@pytest.mark.parametrize("version", ["evt2", "evt3"])
def test_raw(tmp_path, version):
    faery = pytest.importorskip("faery")
    path = tmp_path / "a.raw"
    faery.events_stream_from_array(faery_events(faery), (320, 240)).to_file(path, version=version)
    check(path, size=None)
    assert open_recording(path).format == f"Prophesee raw ({version.upper()})"
    content = path.read_bytes()
    refused(write(tmp_path / "cut.raw", content[:-1]), "ends within a word")
    nameless = content.replace(b"evt ", b"ebt ").replace(b"format", b"fromat")
    refused(write(tmp_path / "no.raw", nameless), "names no EVT version")
    # by hand, without faery
    if version == "evt3":
        words = [high(1), low(2), row(3), base(4, 1), 0x5003, high(1), single(9)]
        body = np.array(words, "<u2").tobytes()
        path = write(tmp_path / "hand.raw", b"% evt 3.0\n% end\n" + body)
        check(path, [4098] * 3, [4, 5, 9], [3] * 3, [1, 1, 0])


@pytest.mark.parametrize("version", ["evt2", "evt3"])
@pytest.mark.parametrize("first", [0, 123, 2**24 - 5])
def test_raw_that_says_little_about_time(tmp_path, version, first):
    """faery writes time high only with events; its clock starts at 0, which it leaves out."""
    faery = pytest.importorskip("faery")
    t = np.concatenate([[0, 0, 7], np.arange(1, 60_000_000, 10_007)]) + first
    t = np.sort(t)
    events = np.zeros(len(t), faery.EVENTS_DTYPE)
    events["t"], events["x"], events["y"] = t, np.arange(len(t)) % 640, 7
    path = tmp_path / "a.raw"
    faery.events_stream_from_array(events, (640, 480)).to_file(path, version=version)
    found = events_of(path, None)
    assert found.t.tolist() == t.tolist()
    assert found.x.tolist() == events["x"].tolist() and (found.y == 7).all()


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_raw_times_where_a_clock_is_odd(tmp_path, version):
    """Events before the first time, whose place is unknown; a time high that falls a little, as
    sensors' do; without one of the two values at the end of the clock."""
    bits, step = (34, 1 << 6) if version == "2.0" else (24, 1 << 12)
    turn = 1 << bits
    times = turn - 9 * step + step * np.array([0, 1, 2, 1, 3, 4, 5, 6, 7, 8, 10, 12, 13])
    words = evt_words(version, [(t % turn, 3, 4, 1) for t in times.tolist()])
    early = evt_words(version, [(0, 9, 9, 0)])[4 if version == "2.0" else 2 :]
    if version == "3.0":  # without its time low
        early = early[2:]
    header = f"% evt {version}\n% geometry 640x480\n% end\n".encode()
    found = events_of(write(tmp_path / "a.raw", header + early + words), None)
    assert found.t.tolist() == np.maximum.accumulate(times).tolist()
    assert (found.x == 3).all()


@pytest.mark.parametrize(
    "header, legacy",
    [
        ("format EVT21;endianness=legacy;height=480;width=640", True),  # of IMX636
        ("format EVT21;height=480;width=640\n% endianness legacy", True),
        ("evt 2.1\n% geometry 640x480", True),  # does not say
        ("evt 2.1\n% geometry 640x480", False),
        ("format EVT21;endianness=little;height=480;width=640", False),  # of GenX320
        ("endianness little\n% format EVT21;height=480;width=640", False),
    ],
)
def test_evt21(tmp_path, monkeypatch, header, legacy):
    """Events of several pixels at once, and edges, across the end of the clock's 34 bits."""
    monkeypatch.setattr(raw, "CHUNK", 100)
    rng = np.random.default_rng(0)
    words, events, edges = [(1 << 28 | 3, 1)], [], []  # an event before the first time
    for t in np.cumsum(rng.integers(1, 400, 500)).tolist():
        t += 2**34 - 50_000
        x, y, p = rng.integers(0, (608, 480, 2)).tolist()
        pixels = int(rng.integers(1, 2**32)) if t % 2 else 1 << t % 32
        words.append((0x8 << 28 | t >> 6 & 0xFFFFFFF, 0))
        words.append((p << 28 | (t & 63) << 22 | x << 11 | y, pixels))
        words.append((0xA << 28 | (t & 63) << 22 | y % 32 << 8 | p, 0))
        words.append((0xE << 28 | (t & 63) << 22 | 0x14, 0x10203040))  # a count of events
        events += [(t, x + i, y, p) for i in range(32) if pixels >> i & 1]
        edges.append((t, y % 32, p))
    words = np.array(words, "<u4")[:, :: 1 if legacy else -1]
    content = f"% {header}\n% end\n".encode() + words.tobytes()
    path = write(tmp_path / "a.raw", content)
    check(path, *np.array(events).T, size=None)
    recording = open_recording(path)
    assert recording.format == "Prophesee raw (EVT2.1)" and recording.width == 640
    found = recording.triggers()
    assert list(zip(*(column.tolist() for column in found), strict=True)) == edges
    refused(write(tmp_path / "cut.raw", content[:-3]), "ends within a word", size=None)


@pytest.mark.parametrize(
    "header, size",
    [
        ("% evt 2.0\n", None),
        ("% format EVT3;height=720;width=1280\n% end\n", (720, 1280)),
        ("% format EVT21;width=320;height=320\n", (320, 320)),
        ("% geometry 640x480\n% evt 3.0\n", (480, 640)),
        ("% Width 304\n% Height 240\n", (240, 304)),
        ("% Width: 304\n%  Height = 240\n", (240, 304)),
    ],
)
def test_size_in_the_header(header, size):
    assert dat.header_size(header) == size


def test_es_and_aedat4(tmp_path):
    faery = pytest.importorskip("faery")
    for name, kind in (("a.es", "Event Stream"), ("a.aedat4", "AEDAT4")):
        path = tmp_path / name
        stream = faery.events_stream_from_array(faery_events(faery), (320, 240))
        stream.to_file(path, **({"zero_t0": False} if name == "a.es" else {}))
        check(path, size=None)
        recording = open_recording(path)
        assert (recording.format, recording.frames) == (kind, None)
        refused(write(tmp_path / f"other{path.suffix}", b"hello" * 9), "cannot be read")
    content = path.read_bytes()
    behind = aedat4._layout(path).end  # the table there is not read
    refused(write(tmp_path / "cut.aedat4", content[: behind - 3]), "cannot be read")
    path = write(tmp_path / "xml.aedat4", content.replace(b"outInfo", b"out\xffnfo"))
    refused(path, "header is damaged")


def test_an_event_stream_with_a_long_pause(tmp_path):
    """Of its bytes that only count time, faery makes packets without events."""
    pytest.importorskip("faery")
    header = b"Event Stream\2\0\0\1" + np.array([64, 48], "<u2").tobytes()
    event = b"\2" + np.array([3, 4], "<u2").tobytes()  # a tick of one microsecond
    content = header + event + 131072 * b"\xff" + event  # each of these is 127
    (events,) = [e for e in open_recording(write(tmp_path / "a.es", content)).events() if len(e)]
    np.testing.assert_array_equal(np.diff(events.t), [127 * 131072 + 1])


# ---------------------------------------------------------------- ROS bags

HEADER = {1: "Header", 2: "std_msgs/Header"}
MESSAGES = {
    "dvs_msgs/msg/Event": "uint16 x\nuint16 y\n{time} ts\nbool polarity\n",
    "dvs_msgs/msg/EventArray": "{header} header\nuint32 height\nuint32 width\n"
    "dvs_msgs/Event[] events\n",
    "event_camera_msgs/msg/EventPacket": "{header} header\nuint32 height\nuint32 width\n"
    "uint64 seq\nuint64 time_base\nstring encoding\nbool is_bigendian\nuint8[] events\n",
}


class Bag:
    """Writes messages with rosbags' own encoder."""

    def __init__(self, path: Path, version: int, **options):
        rosbags = pytest.importorskip("rosbags.typesys")
        stores = rosbags.Stores
        store = stores.ROS1_NOETIC if version == 1 else stores.ROS2_HUMBLE
        self.store, self.version = rosbags.get_typestore(store), version
        time = "time" if version == 1 else "builtin_interfaces/Time"
        for name, fields in MESSAGES.items():
            fields = fields.format(time=time, header=HEADER[1] if version == 1 else HEADER[2])
            self.store.register(rosbags.get_types_from_msg(fields, name))
        module = importlib.import_module(f"rosbags.rosbag{version}")
        if version == 2:
            options = {"version": 8, **options}
        self.writer = module.Writer(path, **options)
        self.writer.open()
        self.connections = {}

    def type(self, name: str):
        return self.store.types[name]

    def header(self, microseconds: int):
        stamp = self.time(microseconds * 1000)
        seq = {"seq": 0} if self.version == 1 else {}
        return self.type("std_msgs/msg/Header")(stamp=stamp, frame_id="camera", **seq)

    def time(self, nanoseconds: int):
        seconds, rest = divmod(int(nanoseconds), 10**9)
        return self.type("builtin_interfaces/msg/Time")(sec=seconds, nanosec=rest)

    def write(self, topic: str, kind: str, time: int, **fields):
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        message = self.type(kind)(header=self.header(time), **fields)
        encode = self.store.serialize_ros1 if self.version == 1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], time * 1000 + 900, encode(message, kind))

    def events(self, topic: str, time: int, t, x, y, p):
        event = self.type("dvs_msgs/msg/Event")
        events = [
            event(x=int(a), y=int(b), ts=self.time(1000 * c + 499), polarity=bool(d))
            for a, b, c, d in zip(x, y, t, p, strict=True)
        ]
        self.write(topic, "dvs_msgs/msg/EventArray", time, height=240, width=320, events=events)

    def packet(self, time: int, payload: bytes, encoding="evt3", base=0, topic="/camera/events"):
        self.write(
            topic,
            "event_camera_msgs/msg/EventPacket",
            time,
            height=240,
            width=320,
            seq=1,
            time_base=base,
            encoding=encoding,
            is_bigendian=False,
            events=np.frombuffer(payload, np.uint8),
        )

    def image(self, topic: str, time: int, picture: np.ndarray, encoding="mono8"):
        padded = np.pad(picture.reshape(len(picture), -1), ((0, 0), (0, 3)))
        self.write(
            topic,
            "sensor_msgs/msg/Image",
            time,
            height=picture.shape[0],
            width=picture.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=padded.shape[1],
            data=padded.reshape(-1),
        )

    def close(self):
        self.writer.close()


@pytest.fixture(params=["ros1", "ros2", "mcap"])
def new_bag(request, tmp_path):
    """name -> (path, Bag)"""
    version = 1 if request.param == "ros1" else 2

    def new(name: str):
        path = tmp_path / (f"{name}.bag" if version == 1 else name)
        options = {}
        if request.param == "mcap":
            rosbag2 = pytest.importorskip("rosbags.rosbag2")
            options["storage_plugin"] = rosbag2.StoragePlugin.MCAP
        return path, Bag(path, version, **options)

    return new


EPOCH = 1_600_000_000_000_000  # microseconds


def test_bag_of_event_arrays(new_bag):
    path, bag = new_bag("a")
    bag.events("/dvs/events", EPOCH, T[:3] + EPOCH, X[:3], Y[:3], P[:3])
    bag.image("/other/image_raw", EPOCH, FRAME // 2)
    bag.image("/dvs/image_raw", EPOCH + 7, FRAME)
    bag.events("/dvs/events", EPOCH + 10, [], [], [], [])
    bag.events("/dvs/events", EPOCH + 20, T[3:4] + EPOCH, X[3:4], Y[3:4], P[3:4])
    bag.image("/dvs/image_raw", EPOCH + 30, FRAME[::-1])
    bag.events("/dvs/events", EPOCH + 40, T[4:] + EPOCH, X[4:], Y[4:], P[4:])
    bag.close()
    check(path, t=T + EPOCH, size=None)
    check_frames(path, [EPOCH + 7, EPOCH + 30])
    assert open_recording(path).format == ("ROS 1 bag" if bag.version == 1 else "ROS 2 bag")


@pytest.mark.parametrize("at_once", [1, 4, 1 << 18])
def test_bag_of_evt3_packets(new_bag, monkeypatch, at_once):
    """The state goes on from message to message; the first event is at its message's time."""
    monkeypatch.setattr(rosbag, "WORDS", at_once)
    path, bag = new_bag("a")
    pieces = [
        [row(9), single(1)],  # before the first time: its place is unknown
        [high(0xFFF), low(0xFF0), row(3), single(10, 1)],
        [single(11), base(20, 1), low(0xFFF)],
        [0x5003],
        [high(0), low(4), 0x5001],
    ]
    for i, words in enumerate(pieces):
        bag.packet(EPOCH + i, np.array(words, "<u2").tobytes())
    bag.close()
    t = np.array([0, 0, 15, 15, 20]) + EPOCH + 1
    check(path, t, [10, 11, 20, 21, 28], [3] * 5, [1, 0, 1, 1, 1], size=None)


def test_bag_of_mono_packets(new_bag, caplog):
    path, bag = new_bag("a")
    for start in (0, 3):
        base, words = EVENTS[start][0], []
        for t, x, y, p in EVENTS[start : start + 3]:
            words.append(p << 63 | y << 48 | x << 32 | (t - base) * 1000)
        bag.packet(EPOCH + start, np.array(words, "<u8").tobytes(), "mono", base * 1000)
    bag.packet(EPOCH, b"", "mono", topic="/second/events")
    bag.close()
    check(path, t=T - T[0] + EPOCH, size=None)
    assert "/camera/events, /second/events hold events; reading /camera/events" in caplog.text


def test_mono_packets_are_rounded_to_the_nearest_microsecond(new_bag):
    path, bag = new_bag("a")
    words = [x << 32 | nanoseconds for x, nanoseconds in enumerate((0, 1400, 2600))]
    bag.packet(EPOCH, np.array(words, "<u8").tobytes(), "mono")
    bag.close()
    check(path, EPOCH + np.array([0, 1, 3]), [0, 1, 2], [0] * 3, [0] * 3, size=None)


@pytest.mark.parametrize("pause", [1, 6, 12, 16.7, 18, 40])  # seconds
def test_a_pause_longer_than_a_turn_of_the_sensors_clock(new_bag, pause):
    path, bag = new_bag("pause")
    times = np.arange(0, 500_000, 10_000)
    times = np.append(times, times + times[-1] + int(pause * 1e6))
    for t in times.tolist():
        clock = high(t >> 12 & 0xFFF), low(t & 0xFFF)
        if t % 3 == 1:  # a message that tells no event
            bag.packet(EPOCH + t, np.array(clock, "<u2").tobytes())
        words = *clock, row(3), single(7, 1), 0xA201
        bag.packet(EPOCH + t, np.array(words, "<u2").tobytes())
    bag.close()
    recording = open_recording(path)
    assert (concatenate([*recording.events()]).t - EPOCH).tolist() == times.tolist()
    assert (recording.triggers().times - EPOCH).tolist() == times.tolist()


def test_colour_frames_of_bags(new_bag, caplog):
    path, bag = new_bag("a")
    bag.events("/dvs/events", EPOCH, T + EPOCH, X, Y, P)
    colours = np.zeros((3, 4, 3), np.uint8)
    colours[..., 0] = 200  # red
    bag.image("/dvs/image", EPOCH, colours, "rgb8")
    bag.image("/dvs/image", EPOCH + 1, colours[..., ::-1].copy(), "bgr8")
    bag.close()
    frames = open_recording(path).frames
    for i in range(2):
        np.testing.assert_array_equal(frames.read(i), np.full((3, 4), 60))  # 0.299 * 200
    path, bag = new_bag("b")
    bag.events("/dvs/events", EPOCH, T + EPOCH, X, Y, P)
    bag.image("/dvs/image", EPOCH, FRAME, "bayer_rggb8")
    bag.close()
    assert open_recording(path).frames is None
    assert "bayer_rggb8: no frames" in caplog.text


def test_frames_of_bags_with_several_topics_of_images(new_bag, caplog):
    path, bag = new_bag("a")  # as ESIM names them
    bag.events("/cam0/events", EPOCH, T + EPOCH, X, Y, P)
    bag.image("/cam0/depthmap", EPOCH, np.zeros((3, 16), np.uint8), "32FC1")
    bag.image("/cam0/image_raw", EPOCH, FRAME)
    bag.image("/cam1/image_raw", EPOCH, FRAME[::-1])
    bag.close()
    np.testing.assert_array_equal(open_recording(path).frames.read(0), FRAME)
    assert "another camera" not in caplog.text
    path, bag = new_bag("b")
    bag.events("/prophesee/events", EPOCH, T + EPOCH, X, Y, P)
    bag.image("/realsense/image", EPOCH, FRAME)
    bag.close()
    np.testing.assert_array_equal(open_recording(path).frames.read(0), FRAME)
    assert "frames are those of /realsense/image, which may be another camera" in caplog.text


def test_wrong_bags(new_bag, tmp_path):
    path, bag = new_bag("a")
    bag.image("/dvs/image_raw", EPOCH, FRAME)
    bag.close()
    refused(path, "holds no topic of events", "/dvs/image_raw (sensor_msgs/msg/Image)")
    path, bag = new_bag("b")
    bag.packet(EPOCH, b"\0" * 8, "zip")
    bag.close()
    refused(path, "encoded as zip, expected evt3 or libcaer or libcaer_cmp or mono")
    path, bag = new_bag("c")
    bag.events("/dvs/events", EPOCH, T[[1, 0]] + EPOCH, X[:2], Y[:2], P[:2])
    bag.close()
    refused(path, "event 2: time runs backwards")
    if path.is_file():
        path, bag = new_bag("d")
        bag.events("/dvs/events", EPOCH, T[:2] + EPOCH, X[:2], Y[:2], P[:2])
        bag.close()
        refused(write(tmp_path / "cut.bag", path.read_bytes()[:-200]), "cannot be read")
        refused(write(tmp_path / "text.bag", "hello"), "cannot be read")
    else:
        (data,) = (file for file in path.iterdir() if file.suffix != ".yaml")
        write(data, data.read_bytes()[:100])
        refused(path, "cannot be read")
        write(path / "metadata.yaml", "hello")
        refused(path, "cannot be read")


@pytest.mark.parametrize("at_once", [1, 1 << 18])
def test_bag_of_packets_of_iniVations_cameras(new_bag, monkeypatch, at_once):
    """16-bit words whose times start again with each message; vectors run down a column."""
    monkeypatch.setattr(rosbag, "WORDS", at_once)
    path, bag = new_bag("a")
    pieces = [
        (0, [3 << 12 | 1, 5 << 12 | 1]),  # before the first column and base: their place is unknown
        (7_000_000, [0x0001, 0x1002, 0x2005, 0x3803, 0x4000 | 100, 0x5081]),
        (11_099_400, [0x5001, 0x2006, 0x1001, 0x3000 | 9, 0x0001, 0x3809]),
    ]
    for i, (base, words) in enumerate(pieces):
        bag.packet(EPOCH + i, np.array(words, "<u2").tobytes(), "libcaer_cmp", base)
    bag.close()
    # Message 2: (5, 3) ON, (5, 100) and (5, 107) OFF at 7,000 + 4,096 + 2 us; message 3, 11,099 us:
    # at once (5, 108) OFF, 1 us later (6, 9) OFF, and 4,096 us later (6, 9) ON.
    t = EPOCH + 1 + np.array([0, 0, 0, 1, 2, 4098])
    check(path, t, [5, 5, 5, 5, 6, 6], [3, 100, 107, 108, 9, 9], [1, 0, 0, 0, 0, 1], size=None)


def test_messages_of_iniVations_cameras_all_at_once():
    """Pieces of any length against a loop over words, as the format's description has it."""
    rng = np.random.default_rng(0)
    words = rng.choice([0, 1, 2, 3, 4, 5, 3, 5], 3000) << 12 | rng.integers(0, 4096, 3000)
    words = words.astype(np.uint16)
    starts = np.unique(np.append(0, rng.integers(0, 3000, 20)))
    bases = np.cumsum(rng.integers(0, 10**6, len(starts)))
    expected, high, low, x, base, on, message = [], 0, 0, None, None, 0, -1
    for i, word in enumerate(words.tolist()):
        if message + 1 < len(starts) and starts[message + 1] == i:
            message, high, low = message + 1, 0, 0
        kind, load = word >> 12, word & 0xFFF
        time = int(bases[message]) + (high << 12 | low)
        if kind == 0:
            high = load
        elif kind == 1:
            low = load
        elif kind == 2:
            x = load & 0x7FF
        elif kind == 3 and x is not None:
            expected.append((time, x, load & 0x7FF, load >> 11))
        elif kind == 4:
            base, on = load & 0x7FF, load >> 11
        elif kind == 5 and base is not None:
            bits = [bit for bit in range(8) if load >> bit & 1 and x is not None]
            expected += [(time, x, base + bit, on) for bit in bits]
            base += 8
    for cuts in ([0, len(starts)], [*range(len(starts) + 1)], [0, 3, 9, len(starts)]):
        state, columns = libcaer.State(), []
        for a, b in zip(cuts[:-1], cuts[1:], strict=True):
            first = starts[a]
            last = starts[b] if b < len(starts) else len(words)
            state, found = libcaer.decode(state, words[first:last], starts[a:b] - first, bases[a:b])
            columns.append(found)
        found = np.stack([np.concatenate(c) for c in zip(*columns, strict=True)], 1)
        np.testing.assert_array_equal(found, expected)


def test_bag_of_plain_packets_of_iniVations_cameras(new_bag):
    path, bag = new_bag("a")
    for base, rows in ((0, EVENTS[:3]), (1000 * 10**6, EVENTS[3:])):
        words = [(x << 17 | y << 2 | p << 1 | 1, t - base // 1000) for t, x, y, p in rows]
        words = [(data, t & 0xFFFFFFFF) for data, t in words]
        bag.packet(EPOCH, np.array(words, "<u4").tobytes(), "libcaer", base)
    bag.close()
    assert events_of(path, None).t[0] == EPOCH


def test_triggers_of_bags(new_bag):
    """They are moved as the events are, those before the first event too."""
    path, bag = new_bag("a")
    pieces = [
        [0xA100],  # before the first time
        [high(0xFFF), low(0xFF0), 0xA301, row(3), 0xA300],
        [low(0xFF2), single(11)],
        [high(0), low(4), 0xAF01, single(3)],
    ]
    for i, words in enumerate(pieces):
        bag.packet(EPOCH + i, np.array(words, "<u2").tobytes())
    bag.close()
    assert events_of(path, None).t.tolist() == [EPOCH + 2, EPOCH + 2 + 18]
    times, ids, rises = open_recording(path).triggers()
    assert times.tolist() == [EPOCH, EPOCH, EPOCH + 20]
    assert ids.tolist() == [3, 3, 15] and rises.tolist() == [True, False, True]
    path, bag = new_bag("b")
    bag.packet(EPOCH, np.array([*pieces[2], *pieces[3][:2], single(1)], "<u2").tobytes())
    bag.close()
    assert open_recording(path, (1, 20)).triggers() is None


# ---------------------------------------------------------------- MCAP


def payload(number: int) -> bytes:
    """10 events 1.024 ms after those of the last number; x counts on."""
    start = [high(number >> 2), low((number & 3) << 10), row(3)]
    return np.array([*start, *(single(10 * (number % 30) + k) for k in range(10))], "<u2").tobytes()


def packets(count: int, first=0) -> list[tuple[int, bytes]]:
    times = [EPOCH + 1024 * number for number in range(first, first + count)]
    made = (formats.event_packet(t, payload(first + i), "evt3") for i, t in enumerate(times))
    return [(1000 * t, data) for t, data in zip(times, made, strict=True)]


CHUNKS = [packets(40), packets(40, 40), packets(40, 80)]
PACK = {
    "": None,
    "lz4": lambda data: pyarrow.compress(data, "lz4", asbytes=True),
    "zstd": lambda data: pyarrow.compress(data, "zstd", asbytes=True),
}


@pytest.mark.parametrize("how", PACK)
def test_mcap_that_was_broken_off(tmp_path, caplog, how):
    """It has no index; then it is cut within its last chunk: its beginning counts if not packed."""
    pytest.importorskip("rosbags")
    whole = formats.mcap(CHUNKS, pack=PACK[how], how=how)
    t = EPOCH + 1024 * np.repeat(np.arange(120), 10)
    size = 9 + 22 + len(CHUNKS[0][0][1])  # of a message's record; an index of 15 bytes is behind
    cut = whole[:-300], 80 if how else 120 - -((15 - 300) // size)
    for name, (data, left) in (("a.mcap", (whole, 120)), ("b.mcap", cut)):
        path = write(tmp_path / name, data)
        caplog.clear()
        events = events_of(path, None)
        np.testing.assert_array_equal(events.t, t[: 10 * left])
        np.testing.assert_array_equal(events.x, np.arange(10 * left) % 300)
        assert f"what comes before is read: {10 * left:,} events" in caplog.text
        refused(path, "it has no index, so it ends early", size=None)


@pytest.mark.parametrize("encoding", ["evt3", "libcaer_cmp"])
def test_packets_before_a_damaged_one_are_read(new_bag, caplog, encoding):
    """Although many are decoded at once."""
    path, bag = new_bag("a")
    libcaer_words = np.array([0x2005, 0x3803], "<u2").tobytes()
    for k in range(20):
        data = payload(k) if encoding == "evt3" else libcaer_words
        bag.packet(EPOCH + 1024 * k, data[: -1 if k == 15 else None], encoding, base=10**6 * k)
    bag.close()
    assert len(events_of(path, (240, 320))) == 15 * (10 if encoding == "evt3" else 1)
    assert "bytes, which are no whole words" in caplog.text


@pytest.mark.parametrize("how", ["lz4", "zstd"])
def test_what_precedes_damage_of_a_packed_chunk(how):
    data = np.random.default_rng(0).integers(0, 50, 700_000).astype(np.uint8).tobytes()
    packed = pyarrow.compress(data, how, asbytes=True)
    assert torn_bag.unpacked_by(how, packed, len(data)) == (data, None)
    found, damage = torn_bag.unpacked_by(how, packed[: len(packed) // 2], len(data))
    assert 0.2 * len(data) < len(found) and data.startswith(found) and damage is not None


@pytest.mark.parametrize("chunk", [800, 100_000])
def test_a_bag_that_was_broken_off(tmp_path, monkeypatch, chunk):
    """Of its last chunk the beginning counts; no picture needs a look at all that precedes it."""
    bag = Bag(tmp_path / "a.bag", 1)
    bag.writer.chunk_threshold = chunk
    for k in range(40):
        bag.packet(EPOCH + 1000 * k, payload(k))
        bag.image("/cam", EPOCH + 1000 * k, FRAME + k)
    bag.close()
    whole = (tmp_path / "a.bag").read_bytes()
    monkeypatch.setattr(torn_bag, "STRIDE", 64)
    path = write(tmp_path / "a.bag", whole[: len(whole) // 2])
    recording = open_recording(path)
    count = len(recording.frames.times)
    assert count >= 12 and sum(map(len, recording.events())) in (10 * count, 10 * count + 10)
    read, inside = [], torn_bag.Torn._inside
    monkeypatch.setattr(
        torn_bag.Torn,
        "_inside",
        lambda self, file: (read.append(message[1]) or message for message in inside(self, file)),
    )
    for k in reversed(range(count)):
        read.clear()
        np.testing.assert_array_equal(recording.frames.read(k), FRAME + k)
        assert len(read) <= (
            26 if chunk == 800 else 160
        )  # each of a chunk is counted inside and outside


@pytest.mark.parametrize("named", [True, False])
def test_mcap_in_parts_and_without_a_storage_plugin(tmp_path, named):
    """The metadata name the parts in their order; else that of their names counts."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    (tmp_path / "bag").mkdir()
    for number, name in enumerate(["z.mcap", "a.mcap"] if named else ["a.mcap", "z.mcap"]):
        bag = Bag(tmp_path / name[0], 2, storage_plugin=rosbag2.StoragePlugin.MCAP)
        for k in range(5 * number, 5 * number + 5):
            bag.packet(EPOCH + 1024 * k, payload(k))
        bag.close()
        next((tmp_path / name[0]).glob("*.mcap")).rename(tmp_path / "bag" / name)
    told = 'rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: ""\n'
    told += "  relative_file_paths:\n    - z.mcap\n    - 'a.mcap'\n"
    write(tmp_path / "bag/metadata.yaml", told if named else "hello")
    times = EPOCH + 1024 * np.repeat(np.arange(10), 10)
    assert events_of(tmp_path / "bag", None, strict=True).t.tolist() == times.tolist()
    (tmp_path / "bag/a.mcap").unlink()
    if named:
        refused(tmp_path / "bag", "cannot be read", size=None)


def test_a_damaged_encoding_is_said_in_one_line(tmp_path):
    pytest.importorskip("rosbags")
    chunks = [[(1, formats.event_packet(EPOCH, payload(0), "ev\x1e\u20283"))]]
    with pytest.raises(RecordingError, match="encoded as ev\\?\\?3") as error:
        events_of(write(tmp_path / "a.mcap", formats.mcap(chunks)), None)
    assert len(str(error.value).splitlines()) == 1


@pytest.mark.parametrize("storage", ["", "other"])
def test_whole_mcap_without_a_storage_plugin(tmp_path, storage):
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    bag = Bag(tmp_path / "a", 2, storage_plugin=rosbag2.StoragePlugin.MCAP)
    bag.events("/dvs/events", EPOCH, T[:3] + EPOCH, X[:3], Y[:3], P[:3])
    bag.image("/dvs/image_raw", EPOCH + 7, FRAME)
    bag.events("/dvs/events", EPOCH + 20, T[3:] + EPOCH, X[3:], Y[3:], P[3:])
    bag.image("/dvs/image_raw", EPOCH + 30, FRAME[::-1])
    bag.close()
    told = (tmp_path / "a/metadata.yaml").read_text()
    assert "storage_identifier: mcap" in told
    told = told.replace("storage_identifier: mcap", f"storage_identifier: '{storage}'")
    write(tmp_path / "a/metadata.yaml", told)
    (file,) = (tmp_path / "a").glob("*.mcap")
    for path in (tmp_path / "a", file):
        check(path, t=T + EPOCH, size=None)
        check_frames(path, [EPOCH + 7, EPOCH + 30])


@pytest.mark.parametrize("name", ["my bag_0", "it's", "a-b.c"])
def test_ros2_folders_with_any_name(tmp_path, name):
    bag = Bag(tmp_path / "a", 2)
    bag.events("/dvs/events", EPOCH, T + EPOCH, X, Y, P)
    bag.close()
    (file,) = (tmp_path / "a").glob("*.db3")
    told = (tmp_path / "a/metadata.yaml").read_text()
    new = file.rename(tmp_path / "a" / f"{name}.db3")
    write(tmp_path / "a/metadata.yaml", told.replace(file.name, f'"{new.name}"'))
    check(tmp_path / "a", t=T + EPOCH, size=None)


# ---------------------------------------------------------------- triggers of Prophesee's files


def test_triggers_of_evt2(tmp_path):
    """At the times of events, across the end of the clock's 34 bits."""
    words, times = [0xA << 28], [100, 5000, 2**34 - 100, 2**34 + 70, 2**34 + 10**6]
    for i, t in enumerate(times):
        words.append(0x8 << 28 | t >> 6 & 0xFFFFFFF)
        words.append(i % 2 << 28 | (t & 63) << 22 | i << 11 | 3)
        words.append(0xA << 28 | (t & 63) << 22 | i + 20 << 8 | i % 2)
    body = np.array(words, "<u4").tobytes()
    path = write(tmp_path / "a.raw", b"% evt 2.0\n% geometry 640x480\n% end\n" + body)
    assert events_of(path, None).t.tolist() == times
    found = open_recording(path).triggers()
    assert found.times.tolist() == times and found.ids.tolist() == [20, 21, 22, 23, 24]
    assert found.polarity.tolist() == [False, True, False, True, False]


def evt_words(version, events):
    """(t, x, y, p) of each -> bytes, every event with its own time."""
    if version == "2.0":
        words = [
            (0x80000000 | t >> 6, p << 28 | (t & 63) << 22 | x << 11 | y) for t, x, y, p in events
        ]
        return np.array(words, "<u4").tobytes()
    words = [
        (0x8000 | t >> 12, 0x6000 | t & 0xFFF, y, 0x2000 | p << 11 | x) for t, x, y, p in events
    ]
    return np.array(words, "<u2").tobytes()


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_an_event_outside_the_sensor_that_a_header_names_is_left_out(tmp_path, caplog, version):
    rng = np.random.default_rng(0)
    rows = np.stack(
        [np.arange(9000) * 50, *rng.integers(0, 480, (2, 9000)), rng.integers(0, 2, 9000)]
    )
    events = rows.T.tolist()
    header = f"% evt {version}\n% geometry 640x480\n% end\n".encode()
    whole = events_of(write(tmp_path / "whole.raw", header + evt_words(version, events)), None)
    assert np.stack([whole.t, whole.x, whole.y, whole.p]).tolist() == rows.tolist()
    events[4321][1] = 700
    path = write(tmp_path / "a.raw", header + evt_words(version, events))
    found = events_of(path, None)
    kept = np.delete(rows, 4321, 1)
    assert np.stack([found.t, found.x, found.y, found.p]).tolist() == kept.tolist()
    assert "outside the sensor of 640x480" in caplog.text


def test_a_header_without_its_end_before_a_word_that_begins_like_one(tmp_path):
    events = [((0x25 << 6) + 100 * k, 3, 4, k % 2) for k in range(500)]
    assert evt_words("2.0", events)[:1] == b"%"
    header = b"% evt 2.0\n% geometry 640x480\n"
    recording = open_recording(write(tmp_path / "a.raw", header + evt_words("2.0", events)))
    assert concatenate([*recording.events()]).t.tolist() == [t for t, *_ in events]
    assert recording.triggers() is None


@pytest.mark.parametrize("first", [100, 4093 << 12, 4094 << 12, (4095 << 12) + 7])
@pytest.mark.parametrize("chunk", [1000, 1 << 18])
def test_triggers_of_evt3(tmp_path, monkeypatch, chunk, first):
    """At the times of events, while the clock starts again twice, also where it does so at once."""
    monkeypatch.setattr(raw, "CHUNK", chunk)
    words, last, times = [], (first >> 12) - 1, list(range(first, 3 << 24, 40_001))
    times[1:1] = [first + 2, first + 5]
    for i, t in enumerate(times):
        words += [high(k) for k in range(last + 1, (t >> 12) + 1)]
        last = t >> 12
        words += [low(t & 0xFFF), row(3), single(i % 640), 0xA000 | i % 16 << 8 | i % 3 % 2]
    body = np.array(words, "<u2").tobytes()
    path = write(tmp_path / "a.raw", b"% evt 3.0\n% geometry 640x480\n% end\n" + body)
    events = events_of(path, None)
    assert events.t.tolist() == times
    assert events.x.tolist() == [i % 640 for i in range(len(times))] and (events.y == 3).all()
    write(tmp_path / "cut.raw", path.read_bytes()[:-1])
    refused(tmp_path / "cut.raw", "ends within a word", size=None)
    found, order = open_recording(path).triggers(), np.arange(len(times))
    assert found.times.tolist() == times
    assert found.ids.tolist() == (order % 16).tolist()
    assert found.polarity.tolist() == (order % 3 == 1).tolist()


def test_what_has_no_triggers(tmp_path):
    assert open_recording(write(tmp_path / "a.txt", TEXTS["size"])).triggers() is None


# ---------------------------------------------------------------- real recordings

# file: needs, (height, width), whether the file says it, events, first time, seconds, x, y up to
SAMPLES = {
    "ecd_slider_depth": (None, (180, 240), True, 50_000, 3811, 0.170345, 239, 179),
    "e2vid_slider_depth.zip": (None, (180, 240), True, 50_000, 3811, 0.170345, 239, 179),
    "ncaltech101_faces_easy_0001.bin": (None, (173, 151), False, 67_445, 6, 0.299358, 150, 172),
    "ncars.dat": (None, (42, 78), False, 2_009, 0, 0.099952, 77, 41),
    "dvxplorer_face.aedat4": (None, (240, 320), True, 111_954, None, 0.589917, 319, 239),
    "davis346_frames.aedat4": (None, (260, 346), True, 117_667, None, 0.129999, 345, 259),
    "evt2_sparklers.raw": (None, (480, 640), False, 521_252, None, 0.095871, 639, 479),
    "evt3_driving.raw": (None, (720, 1280), False, 219_596, 11_718_656, 0.008801, 1279, 719),
    "dvs_synthetic_sweep.es": ("faery", (240, 320), True, 473_225, 0, 0.999, 319, 239),
    "ros1_event_camera_msgs.bag": ("rosbags", (480, 640), True, 343_474, None, 2.078178, 639, 479),
    "ros2_event_camera_msgs": ("rosbags", (480, 640), True, 343_474, None, 2.078178, 639, 479),
    "ros2_evt3_trigger": ("rosbags", (720, 1280), True, 82_469, None, 1.251317, 1279, 719),
    "ros2_mcap": ("rosbags", (260, 346), True, 571_266, None, 0.999996, 345, 259),
    "davis240_boxes.aedat": (None, (180, 240), True, 162_771, 294_976_755, 2.072651, 239, 179),
    "davis240_rotating_disk.aedat": (None, (180, 240), True, 374_296, 341_678, None, 239, 179),
}


@pytest.mark.parametrize("name", SAMPLES)
def test_sample(recordings, caplog, name):
    needs, size, says_size, count, start, seconds, x, y = SAMPLES[name]
    if needs:
        pytest.importorskip(needs)
    recording = open_recording(recordings / name)
    assert (recording.height, recording.width) == size
    assert ("inferred" in caplog.text) is not says_size
    assert recording.count in (None, count)
    for _ in range(2):  # every call starts from the first event
        events = concatenate(list(recording.events()))
        assert len(events) == count
        assert seconds is None or events.t[-1] - events.t[0] == round(seconds * 1e6)
    assert start in (None, events.t[0])
    assert (events.x.max(), events.y.max()) == (x, y)
    assert 0.3 < events.p.mean() < 0.7


def test_sample_frames(recordings):
    frames = open_recording(recordings / "ecd_slider_depth").frames
    np.testing.assert_array_equal(frames.times, [0, 38_766, 77_531, 116_296, 155_062])
    assert frames.read(4).shape == (180, 240) and frames.read(4).std() > 30
    recording = open_recording(recordings / "davis346_frames.aedat4")
    frames = recording.frames
    np.testing.assert_array_equal(np.diff(frames.times), [40_000, 40_000])
    first = next(recording.events()).t[0]
    assert 0 < frames.times[0] - first < 10_000
    in_order = [frames.read(i) for i in range(3)]
    for i in (2, 0, 0, 1):
        np.testing.assert_array_equal(frames.read(i), in_order[i])
    assert in_order[0].shape == (260, 346) and (in_order[0] != in_order[1]).any()


def test_both_ways_to_the_same_events(recordings):
    pairs = [("ecd_slider_depth", "e2vid_slider_depth.zip")]
    if importlib.util.find_spec("rosbags"):
        pairs.append(("ros1_event_camera_msgs.bag", "ros2_event_camera_msgs"))
    for pair in pairs:
        first, second = (events_of(recordings / name, None) for name in pair)
        for name in "txyp":
            np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


@pytest.mark.parametrize("name, later", [("evt2_sparklers.raw", 0), ("evt3_driving.raw", 1455)])
def test_raw_against_faery(recordings, name, later):
    """Both read the same events; times differ where the sensor takes back a time it has told.

    It says 0x32b and at once 0x320: faery stays at the later one for the 1,455 events of 11 us.
    """
    faery = pytest.importorskip("faery")
    path = recordings / name
    stream = faery.events_stream_from_file(path, dimensions_fallback=(2048, 2048))
    theirs = np.concatenate(list(stream))
    ours = events_of(path, (720, 1280))
    for one, other in zip((ours.x, ours.y, ours.p), ("x", "y", "on"), strict=True):
        np.testing.assert_array_equal(one, theirs[other])
    differ = theirs["t"].astype(np.int64) - ours.t
    assert ((differ != 0).sum(), differ.min()) == (later, 0) and differ.max() <= 11


def test_bags_against_the_sums_of_the_formats_own_tests(recordings, monkeypatch):
    """event_camera_codecs, test/decoder_test.cpp (sums of sensor times in ns, x, y, p, and of the
    triggers' times, edges, inputs); event_camera_py, tests/test_2.py (OFF and ON events).

    They even out no times, and tell the sensor's."""
    pytest.importorskip("rosbags")
    monkeypatch.setattr(evt3, "JITTER", -1)
    path = recordings / "ros2_evt3_trigger"
    with rosbag._bag(path) as bag:
        packed = b"".join(
            rosbag._packet(rosbag._Message(raw, True)).payload
            for _, raw in rosbag._raw(bag, "/event_camera/events")
        )
    words = np.frombuffer(packed, "<u2")
    sums = [int(column.sum()) for column in evt3.decode(evt3.State(), words)[1]]
    assert sums == [1_222_326_831_810, 42_078_718, 31_656_267, 41_439]
    times, ids, rises = evt3.triggers(evt3.State(), words)[1]
    assert (times.sum(), rises.sum(), ids.sum(), len(times)) == (29_096_982, 1, 0, 2)
    events, triggers = events_of(path, None), open_recording(path).triggers()
    first = evt3.decode(evt3.State(), words)[1][0][0]
    assert (triggers.times - events.t[0]).tolist() == (times - first).tolist()
    events = events_of(recordings / "ros2_mcap", None)
    assert (int((~events.p).sum()), int(events.p.sum())) == (360_223, 211_043)


def test_a_damaged_first_frame_does_not_keep_the_events_back(recordings, tmp_path):
    """Whichever of its bytes is wrong."""
    path = recordings / "davis346_frames.aedat4"
    whole, layout = path.read_bytes(), aedat4._layout(path)
    with open(path, "rb") as file:
        offset, size = next(aedat4._packets(path, file, layout, layout.frames))
        head = aedat4._unpacked(file, layout, offset, size)
    count = sum(map(len, open_recording(path).events()))
    for place in (4, 8, 12, 14, 16, 18, 20, 24, 28):
        data = struct.pack("<I", len(head)) + head[:place] + b"\xfe\x7f" + head[place + 2 :]
        packed = pyarrow.compress(data, "lz4", asbytes=True)
        start = whole[: offset - 8] + struct.pack("<ii", layout.frames, len(packed))
        damaged = write(tmp_path / "a.aedat4", start + packed + whole[offset + size :])
        assert sum(map(len, open_recording(damaged).events())) == count


def test_damaged_samples(recordings, tmp_path):
    for name in ("davis346_frames.aedat4", "ros1_event_camera_msgs.bag", "e2vid_slider_depth.zip"):
        content = (recordings / name).read_bytes()
        path = write(tmp_path / name, content[: len(content) // 2])
        refused(path, "cannot be read", size=(480, 640))


@pytest.mark.parametrize("name", ["davis346_59_frames.aedat4", "davis346_frames.aedat4"])
def test_frames_of_half_a_sample_end_at_damage(recordings, tmp_path, name):
    assert open_recording(recordings / name).frames.damage is None
    content = (recordings / name).read_bytes()
    half = open_recording(write(tmp_path / name, content[: len(content) // 2]), (480, 640))
    assert len(half.frames.times) and half.frames.damage is not None


CUT = ["davis240_boxes.aedat", "ros2_mcap/test_events_2_0.mcap",
       "davis346_frames.aedat4", "evt2_sparklers.raw", "evt3_driving.raw", "dvs_synthetic_sweep.es",
       "ncars.dat", "ncaltech101_faces_easy_0001.bin", "ros1_event_camera_msgs.bag"]  # fmt: skip


@pytest.mark.parametrize("name", CUT)
def test_half_a_sample_gives_half_of_its_events(recordings, tmp_path, caplog, name):
    """Half of the bytes, and one that is no whole event; faery alone reads half an .es file."""
    whole = events_of(recordings / name, (720, 1280))
    content = (recordings / name).read_bytes()
    recording = open_recording(
        write(tmp_path / name, content[: len(content) // 2 | 1]), (720, 1280)
    )
    for _ in range(2):
        events = concatenate(list(recording.events()))
    assert 0.1 * len(whole) < len(events) < 0.9 * len(whole)
    for column in "txyp":
        np.testing.assert_array_equal(
            getattr(events, column), getattr(whole, column)[: len(events)]
        )
    if name.endswith(".es"):
        return  # the file does not say how long it is
    assert caplog.text.count(f"what comes before is read: {len(events):,} events") == 1
    refused(
        recording.path,
        "ends early" if "bag" in name or "mcap" in name else "cut off",
        size=(720, 1280),
    )


@pytest.mark.parametrize("name", ["davis346_59_frames", "davis346_frames", "dvxplorer_face"])
def test_aedat4_against_faery(recordings, name):
    faery = pytest.importorskip("faery")
    path = recordings / f"{name}.aedat4"
    ours, packets, frames = events_of(path, None), [], []
    for track, packet in faery.aedat.Decoder(path):
        if track.data_type == "events":
            packets.append(packet)
        elif track.data_type == "frame":
            frames.append(packet)
    theirs = np.concatenate(packets)
    for column, other in (("t", "t"), ("x", "x"), ("y", "y"), ("p", "on")):
        np.testing.assert_array_equal(getattr(ours, column), theirs[other])
    found = open_recording(path).frames
    assert (found is None) == (not frames)
    for i, frame in enumerate(frames):
        assert found.times[i] == frame.t
        np.testing.assert_array_equal(found.read(i), frame.pixels)


# ---------------------------------------------------------------- single bad rows


def test_single_bad_rows_are_left_out_and_said_once(tmp_path, caplog):
    """Each kind of them, in a file of 20,000; what is left is the rest, as a loop finds it."""
    rows = [f"{i * 1e-5:.6f} {i % 320} {i % 240} {i % 2}" for i in range(20_000)]
    wrong = {5: "0.00003 1 1 1", 70: "0.0007 320 1 1", 900: "0.009 -1 1 1", 1000: "words", 6000: "",
             1200: "0.012 1 1 7", 1300: "nan 1 1 1", 1400: "0.014 1 1.5 1", 1500: "9e9 1 1 1",
             1600: "0.016 1 1", 1700: "0.017 1 1 1 1", 1800: "1e300 1 1 1"}  # fmt: skip
    for row, line in wrong.items():
        rows[row] = line
    path = write(tmp_path / "events.txt", "320 240\n" + "\n".join(rows) + "\n")
    good = [row.split() for i, row in enumerate(rows) if i not in wrong]
    for _ in range(2):
        events = events_of(path, None)
        np.testing.assert_array_equal(events.t, [round(1e6 * float(t)) for t, *_ in good])
        np.testing.assert_array_equal(events.x, [int(x) for _, x, *_ in good])
    caplog.clear()
    recording = open_recording(path)
    for _ in range(3):
        list(recording.events())
    assert len(caplog.records) == 1
    assert "events.txt, line 7: time runs backwards, from 40 to 30 us" in caplog.text
    assert "left out: 11 of 19,999 events (refused if strict)" in caplog.text  # one is empty
    refused(path, "line 7: time runs backwards", size=None)


def test_bad_rows_among_lines_that_end_as_they_did_on_old_macs(tmp_path):
    rows = [f"{i * 1e-3:.6f} {i % 20} 3 1" for i in range(3000)]
    rows[1500] = "1.5 40000 3 1"
    path = write(tmp_path / "events.txt", "\r".join(rows) + "\n")
    assert len(events_of(path, None)) == 2999


def test_a_header_that_hides_the_first_row_is_refused(tmp_path):
    """Of these rows the times would be seconds, and the size that of the events."""
    rows = "64 48\n" + "".join(f"{i * 1000} {i % 20} 3 1\n" for i in range(100))
    path = write(tmp_path / "events.txt", "# " + "c" * 60_000 + "\n" + rows)
    assert events_of(path, None).t[-1] == 99_000
    for comment in ("# " + "c" * 70_000 + "\n", "# a line of a comment\n" * 4000):
        refused(write(path, comment + rows), "first 65,536 bytes are comments", size=None)


def test_as_few_as_possible_are_left_out_for_the_order_of_time():
    """The number against all subsets of ten times."""
    rng = np.random.default_rng(0)
    for _ in range(40):
        t, last = rng.integers(0, 12, 10), int(rng.integers(0, 4))
        bad = rng.random(10) < 0.1
        out = _out_of_order(t, bad, last)
        kept = t[~out & ~bad]
        assert (np.diff(kept) >= 0).all() and (kept >= last).all()
        most = max(
            len(chosen)
            for mask in itertools.product([False, True], repeat=10)
            if (np.diff(chosen := t[np.array(mask) & ~bad]) >= 0).all() and (chosen >= last).all()
        )
        assert len(kept) == most
    spike = np.arange(1000)
    spike[500] = 10**9  # leaving out what follows it would be wrong
    assert np.flatnonzero(_out_of_order(spike, np.zeros(1000, bool), 0)).tolist() == [500]


def test_more_than_one_in_a_thousand_is_an_error_wherever_it_comes(tmp_path):
    def recording(*wrong):
        rows = [f"{i * 1e-6:.6f} {400 if i in wrong else 1} 1 1" for i in range(3000)]
        return write(tmp_path / "events.txt", "320 240\n" + "\n".join(rows) + "\n")

    assert len(events_of(recording(0, 1500, 2999), None)) == 2997
    with pytest.raises(RecordingError, match="line 2: x is 400, outside the sensor of 320x240"):
        events_of(recording(0, 1500, 2998, 2999), None)


@pytest.mark.parametrize(
    "wrong", [[0], [0, 1], [1], [99_999], [99_998, 99_999], [100_000], [99_999, 199_999], [299_999]]
)
def test_broken_times_are_left_out_wherever_they_are(tmp_path, monkeypatch, caplog, wrong):
    """Also where no earlier time tells: at the beginning, and at the end of what is read at once.
    The last time of all could be right, and stays."""
    monkeypatch.setattr(readers, "CHUNK", 100_000)
    rows = np.zeros(300_000, [("t", "i8"), ("x", "u2"), ("y", "u2"), ("p", "?")])
    rows["t"] = 10 * np.arange(len(rows))
    rows["t"][wrong] = 10**9 + np.arange(len(wrong))
    np.save(tmp_path / "a.npy", rows)
    found = events_of(tmp_path / "a.npy")
    last = wrong == [299_999]
    np.testing.assert_array_equal(found.t, rows["t"] if last else np.delete(rows["t"], wrong))
    if not last:
        assert f"left out: {len(wrong)} of 300,000 events (refused if strict)" in caplog.text
        refused(tmp_path / "a.npy", "time runs backwards, from 100000000")


# ---------------------------------------------------------------- what a new user meets


@pytest.mark.parametrize("order", ["x,y,p,t", "p,t,x,y", "x,y,t,p", "t,p,x,y"])
@pytest.mark.parametrize("seconds", [True, False])
def test_columns_in_another_order_are_asked_for(tmp_path, order, seconds):
    t = [f"{1 + i * 0.001:.6f}" if seconds else f"{10**6 + 1000 * i}" for i in range(50)]
    x, y, p = (
        [str((i * step) % size) for i in range(50)] for step, size in ((7, 300), (5, 30), (1, 2))
    )
    values = {"t": t, "x": x, "y": y, "p": p}
    rows = [",".join(row) for row in zip(*(values[key] for key in order.split(",")), strict=True)]
    path = write(tmp_path / "a.csv", "\n".join(rows))
    refused(path, f"columns look like {order}, not t,x,y,p: pass --columns {order}")
    events = concatenate(list(open_recording(path, (240, 320), columns=order).events()))
    np.testing.assert_array_equal(events.t, 10**6 + 1000 * np.arange(50))
    assert events.x.tolist() == [*map(int, x)] and events.y.tolist() == [*map(int, y)]
    with pytest.raises(RecordingError, match="columns are 'x,y', expected an order"):
        open_recording(path, columns="x,y")


def test_an_order_that_is_told_beside_a_line_of_names(tmp_path):
    """The line's unit stays; an order or a unit that contradicts it is refused."""
    rows = "".join(f"{1500 + 1000 * i},{i},{i + 1},1\n" for i in range(20))
    path = write(tmp_path / "a.csv", f"t [ns],x,y,p\n{rows}")
    for columns in (None, "t,x,y,p", "t_ns,x,y,p"):
        events = concatenate(list(open_recording(path, (240, 320), columns=columns).events()))
        np.testing.assert_array_equal(events.t, 1 + np.arange(20))
    told = "line 1: 't [ns],x,y,p', but columns are told to be {!r}: leave out --columns"
    for columns in ("t,y,x,p", "t_us,x,y,p"):
        with pytest.raises(RecordingError, match=re.escape(told.format(columns))):
            open_recording(path, (240, 320), columns=columns)


@pytest.mark.parametrize("kind", ["npz", "structured"])
def test_columns_with_names_have_no_order(tmp_path, kind):
    if kind == "npz":
        path = tmp_path / "a.npz"
        np.savez(path, t=T, x=X, y=Y, p=P)
    else:
        path = tmp_path / "a.npy"
        np.save(path, np.rec.fromarrays([T, X, Y, P], names="t,x,y,p"))
    with pytest.raises(RecordingError, match="have names, and so no order: leave out --columns"):
        open_recording(path, (240, 320), columns="x,y,t,p")


@pytest.mark.parametrize("named", [True, False])
def test_other_arrays_in_an_npz_may_hold_anything(tmp_path, named):
    events = {"t": T, "x": X, "y": Y, "p": P} if named else {"events": np.stack([T, X, Y, P], 1)}
    path = tmp_path / "a.npz"
    np.savez(path, **events, about=np.array({"a": 1}, object), K=np.eye(3))
    check(path)


def test_text_with_tabs_between_columns(tmp_path):
    text = "t\tx\ty\tp\n0.1\t1\t2\t1\n0.2\t3\t4\t0\n"
    for path in (write(tmp_path / "a.tsv", text), tmp_path / "a.tsv.gz"):
        if path.suffix == ".gz":
            path.write_bytes(gzip.compress(text.encode()))
        events = concatenate(list(open_recording(path, (240, 320)).events()))
        assert events.t.tolist() == [100_000, 200_000] and events.y.tolist() == [2, 4]
    refused(write(tmp_path / "a.csv", "t;x;y;p\n1;2;3;1\n"), "not apart by spaces, tabs or commas")


def test_which_recordings_say_that_they_are_grey(recordings):
    for name, grey in (("davis346_frames.aedat4", True), ("dvxplorer_face.aedat4", True),
                       ("ncars.dat", True), ("ecd_slider_depth", False)):  # fmt: skip
        assert open_recording(recordings / name).grey is grey


# ---------------------------------------------------------------- one file of numpy; more of HDF5


@pytest.mark.parametrize("kind", ["rows", "seconds", "structured", "named", "npz"])
def test_one_file_of_numpy(tmp_path, kind):
    path = tmp_path / ("a.npz" if kind in ("named", "npz") else "a.npy")
    columns = {"t": T, "x": X, "y": Y, "p": P}
    rows = np.stack([*columns.values()], 1)
    if kind == "rows":
        np.save(path, rows)
    elif kind == "seconds":
        np.save(path, rows * [1e-6, 1, 1, 1])
    elif kind == "structured":
        array = np.zeros(len(T), [("x", "u2"), ("y", "u2"), ("polarity", "?"), ("timestamp", "i8")])
        for name, column in zip(("timestamp", "x", "y", "polarity"), columns.values(), strict=True):
            array[name] = column
        np.save(path, array)
    elif kind == "named":
        np.savez(path, **{f"{name}s": column for name, column in columns.items()})
    else:
        np.savez_compressed(path, events=rows)
    check(path)
    assert open_recording(path).count == len(T)


def test_an_npz_may_tell_the_size_of_the_sensor(tmp_path, caplog):
    """As the sample of the web page does."""
    path, size = tmp_path / "a.npz", {"width": 400, "height": np.array([300])}
    for columns in ({"t": T, "x": X, "y": Y, "p": P}, {"events": np.stack([T, X, Y, P], 1)}):
        np.savez(path, **columns, **size)
        check(path, size=None)
        recording = open_recording(path)
        assert (recording.height, recording.width, recording.inferred) == (300, 400, False)
        assert open_recording(path, (350, 450)).width == 450
    np.savez(path, t=T, x=X, y=Y, p=P, width=400)
    assert open_recording(path).inferred
    np.savez(path, t=T, x=X, y=Y, p=P, width=400.5, height=300)
    refused(path, "width is float64 of shape (), expected a number of pixels", size=None)
    np.savez(path, t=T, x=X, y=Y, p=P, width=300, height=300)
    refused(path, "event 3: x is 319, outside the sensor of 300x300 pixels", size=None)


@pytest.mark.parametrize("name", ["a.npy", "a.npz"])
def test_a_file_of_numpy_without_rows(tmp_path, name):
    save = np.save if name == "a.npy" else np.savez
    save(tmp_path / name, np.zeros((0, 4)))
    assert open_recording(tmp_path / name, (240, 320)).count == 0
    with pytest.raises(RecordingError, match="holds no events"):
        open_recording(tmp_path / name)


def test_an_order_of_columns_that_is_told_counts_even_where_it_looks_like_another(tmp_path):
    times, y = 1e-4 * np.arange(50), np.arange(50) % 2
    np.save(tmp_path / "a.npy", np.stack([times, 3 + np.arange(50) % 7, y, np.ones(50)], 1))
    refused(tmp_path / "a.npy", "columns look like t,x,p,y")
    events = next(open_recording(tmp_path / "a.npy", (240, 320), columns="t,x,y,p").events())
    np.testing.assert_array_equal(events.y, y)


def test_wrong_files_of_numpy(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.zeros((5, 3)))
    refused(path, "float64 of shape (5, 3), expected rows (N, 4)")
    np.save(path, np.stack([X, Y, P, T], 1)[[0, 1, 2, 3, 4, 4]])
    refused(path, "columns look like x,y,p,t, not t,x,y,p: pass --columns x,y,p,t")
    np.testing.assert_array_equal(
        next(open_recording(path, (240, 320), columns="x,y,p,t").events()).t[:5], T
    )
    np.savez(tmp_path / "a.npz", t=T, x=X, y=Y[:2], p=P)
    refused(tmp_path / "a.npz", "columns of one length")
    np.savez(tmp_path / "a.npz", t=T, x=X)
    refused(tmp_path / "a.npz", "holds 't', 'x', expected t, x, y and p")
    save_weights(tmp_path / "weights.npz", load_weights())
    refused(tmp_path / "weights.npz", ", ..., expected t, x, y and p: weights go to --weights")
    write(tmp_path / "model.pth.tar", b"PK")
    refused(tmp_path / "model.pth.tar", "a PyTorch checkpoint goes to --weights")
    write(tmp_path / "recordings.tar", b"PK")
    refused(tmp_path / "recordings.tar", "not a recording of a known format")
    np.savez(tmp_path / "a.npz", events=np.array([print], object))
    refused(tmp_path / "a.npz", "cannot be read")
    write(path, b"\x93NUMPY no header")
    refused(path, "cannot be read")
    write(path, b"no array at all")
    refused(path, "cannot be read (it does not begin as an array of numpy does)")


def test_hdf5_of_v2e_and_of_metavision(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["events"] = np.stack([T, X, Y, P], 1).astype(np.uint32)
    check(path)
    assert open_recording(path, (240, 320)).format == "HDF5 (v2e)"
    with h5py.File(path, "w") as file:
        rows = np.zeros(len(T), [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
        for name, column in (("x", X), ("y", Y), ("p", P), ("t", T)):
            rows[name] = column
        file["CD/events"] = rows
        file.attrs["geometry"] = "320x240"
    check(path, size=None)
    with h5py.File(path, "a") as file:
        file.attrs["geometry"] = np.bytes_("320x240")
    check(path, size=None)
    with h5py.File(path, "w") as file:
        file["events"] = np.zeros((5, 3))
    refused(path, "events has the shape (5, 3), expected (N, 4)")
    with h5py.File(path, "w") as file:
        file["CD/events"] = np.zeros(5)
    refused(path, "expected rows with fields x, y, p and t")


@pytest.mark.parametrize("line", ["[" * 2000, "(" * 900 + "x", " " * 60_000 + "x", "t [" * 300])
def test_a_first_line_of_brackets_takes_no_time(tmp_path, line):
    """It once took minutes, in the search for units."""
    refused(write(tmp_path / "a.csv", line + "\n" + "\n".join(ROWS)), "line 1: ")
