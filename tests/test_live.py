"""Streams against slow decoding; windows against the rules; pictures against the batch program."""

import contextlib
import gc
import http.client
import io
import itertools
import json
import os
import socket
import struct
import sys
import threading
import time
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from PIL import Image

from firenet_jax import cli
from firenet_jax.commands import live
from firenet_jax.errors import RecordingError
from firenet_jax.events import Events, Recording, concatenate
from firenet_jax.filters import find_hot_pixels
from firenet_jax.live import sources
from firenet_jax.live.engine import (
    Arrived,
    Figures,
    Limits,
    Waiting,
    pictures,
    valid_events,
    windows,
    without_hot_pixels,
)
from firenet_jax.live.page import Board, serve
from firenet_jax.network import Weights, initial_params
from firenet_jax.pictures import Display
from firenet_jax.reconstruction import Network, events_to_pictures, initial_session
from firenet_jax.tensors import pack

HEIGHT, WIDTH = 12, 20


def some_events(count=200, last=50_000, seed=0, start=0):
    rng = np.random.default_rng(seed)
    t = start + np.sort(rng.integers(0, last, count))
    x, y = rng.integers(0, WIDTH, count), rng.integers(0, HEIGHT, count)
    return Events.of(t, x, y, rng.integers(0, 2, count))


def rows(events):
    return list(zip(*(getattr(events, name).tolist() for name in "txyp"), strict=True))


def recording_of(tmp_path, *chunks):
    return Recording(tmp_path / "r", "test", HEIGHT, WIDTH, lambda: iter(chunks))


# ---- Wires


def written(events, wire):
    lines = {
        "t64_x16_y16_on8": lambda t, x, y, p: struct.pack("<QHHB", t, x, y, p),
        "t32_x16_y15_on1": lambda t, x, y, p: struct.pack("<IHH", t % 2**32, x, y << 1 | p),
        "text": lambda t, x, y, p: f"{t} {x} {y} {int(p)}\n".encode(),
    }
    return b"".join(lines[wire](*row) for row in rows(events))


@pytest.mark.parametrize("wire", [*sources.BINARY, "text"])
@pytest.mark.parametrize("piece", [1, 7, 64, 10_000])
def test_a_stream_cut_anywhere(wire, piece):
    events = some_events(60)
    data = written(events, wire)
    pieces = [data[k : k + piece] for k in range(0, len(data), piece)]
    found = concatenate([*sources.decoded([b"", *pieces, b""], wire)])
    assert rows(found) == rows(events)


def test_a_clock_of_32_bits_wraps_round_and_packets_may_change_places():
    events = some_events(50, last=2**32, start=2**31)  # reaches beyond the end once
    halves = events.select(slice(25)), events.select(slice(25, None))
    pieces = [written(half, "t32_x16_y15_on1") for half in halves]
    assert rows(concatenate([*sources.decoded(pieces, "t32_x16_y15_on1")])) == rows(events)
    late = Events.of([2**32 - 5, 2**32 + 5, 2**32 - 3, 2**32 + 6], *np.zeros((3, 4), int))
    found = [*sources.decoded([written(late, "t32_x16_y15_on1")], "t32_x16_y15_on1")]
    assert found[0].t.tolist() == late.t.tolist()


def test_what_is_left_over_of_a_datagram_is_no_event():
    events = some_events(6)
    data = written(events, "t64_x16_y16_on8")
    found = concatenate([*sources.decoded([data[:20], data[26:]], "t64_x16_y16_on8", True)])
    assert rows(found) == rows(events)[:1] + rows(events)[2:]


def test_text_in_seconds_with_a_header():
    text = b"20 12\n# t x y p\n0.000001 3 4 1\n\n1.5 5 6 -1\n"
    found = concatenate([*sources.decoded([text], "text")])
    assert rows(found) == [(1, 3, 4, True), (1_500_000, 5, 6, False)]


def test_text_in_seconds_stays_so_from_piece_to_piece():
    pieces = [b"0.5 1 1 1\n", b"1 2 2 1\n", b"2 2 2 1\n"]
    found = [events.t.tolist() for events in sources.decoded(pieces, "text")]
    assert found == [[500_000], [1_000_000], [2_000_000]]
    (found,) = sources.decoded([b"6e-1 1 1 1\n"], "text")
    assert found.t.tolist() == [600_000]


@pytest.mark.parametrize("unit", [1, 1e-6])
def test_text_is_read_alike_with_and_without_a_comment(unit):
    """Pieces that hold nothing but numbers are parsed at once, others line by line."""
    rng = np.random.default_rng(0)
    t = 1_589_163_148_000_000 + np.cumsum(rng.integers(0, 9, 3000))
    shown = (f"{time * unit:.{0 if unit == 1 else 6}f}" for time in t.tolist())
    x, y, p = rng.integers(0, 240, 3000), rng.integers(0, 180, 3000), rng.integers(-1, 2, 3000)
    lines = [f"{a} {b} {c} {d}\n".encode() for a, b, c, d in zip(shown, x, y, p, strict=True)]
    for between in (b"", b"# t x y p\n"):
        pieces = [between + b"".join(lines[n : n + 100]) for n in range(0, 3000, 100)]
        found = concatenate([*sources.decoded(pieces, "text")])
        for column, wanted in zip("txyp", (t, x, y, p > 0), strict=True):
            np.testing.assert_array_equal(getattr(found, column), wanted)


def test_a_last_line_of_text_may_lack_its_end():
    found = concatenate([*sources.decoded([b"1 2 3 1\n2 ", b"2 3 1"], "text")])
    assert found.t.tolist() == [1, 2]
    datagrams = [b"100 1 2 1", b"200 1 2 1\n300 1 2 0"]
    found = concatenate([*sources.decoded(datagrams, "text", datagrams=True)])
    assert found.t.tolist() == [100, 200, 300]


def test_a_line_without_end_is_refused():
    with pytest.raises(RecordingError, match="holds a line of more than 65536 bytes"):
        list(sources.decoded(itertools.repeat(b"1" * 1000), "text"))


@pytest.mark.parametrize("text", [b"GET / HTTP/1.1\n", b"1 2 3 nonsense\n", b"1 99999 3 1\n"])
def test_text_that_is_no_events_is_refused(text):
    with pytest.raises(RecordingError, match="lines of t x y p were expected"):
        list(sources.decoded([text], "text"))


def test_a_broken_line_of_text_is_left_out_and_said(caplog):
    """A stream begins within a line, and a thousand lines later a part of it is lost."""
    whole = b"".join(b"%d 2 3 1\n" % t for t in range(1000))
    pieces = [b"5 2 3 1 7 3\n" + whole, b"1000 2 3 x1e\n1001 2 3 0\n"]
    found = concatenate([*sources.decoded(pieces, "text")])
    assert found.t.tolist() == [*range(1000), 1001]
    assert "holds '5 2 3 1 7 3'" in caplog.text and "x1e" not in caplog.text
    with pytest.raises(RecordingError, match="'1 2 3' where lines of t x y p"):
        list(sources.decoded([b"0 2 3 1\n1 2 3\n1 a 3 1\n"], "text"))
    with pytest.raises(RecordingError, match="'1e10 2 3 1' where lines"):  # in the year 2286
        list(sources.decoded([b"0.5 2 3 1\n1e10 2 3 1\n"], "text"))


@pytest.mark.parametrize("first", [b"t x y p\n", b"0 3 1\n"])
def test_a_stream_may_begin_with_a_broken_line_alone(first):
    """Whether the events come with it or later is chance."""
    for pieces in ([first + b"1 2 3 1\n"], [first, b"", b"1 2 3 1\n"]):
        assert rows(concatenate([*sources.decoded(pieces, "text")])) == [(1, 2, 3, True)]
    with pytest.raises(RecordingError, match="'a b c d' where lines of t x y p"):
        list(sources.decoded(itertools.repeat(b"a b c d\n", 2), "text"))


@pytest.mark.parametrize("row", ["10 5 3 nan", "10 5 3 7", "10 1.7 3 1", "10 1 -0.9 1", "1 1 0 5"])
def test_other_columns_are_no_events(row, caplog):
    found = [*sources.decoded([b"1 2 3 1\n" + row.encode() + b"\n11 2 3 -1\n"], "text")]
    assert concatenate(found).t.tolist() == [1, 11] and f"holds '{row}'" in caplog.text


@pytest.mark.parametrize("wire", list(sources.BINARY))
def test_any_bytes_decode_to_something(wire):
    noise = np.random.default_rng(0).bytes(13 * 800)
    figures = Figures()
    for events in sources.decoded([noise], wire):
        inside = list(valid_events([events.select(slice(900))], 2**15, 2**15, figures))
        assert all((e.t >= 0).all() for e in inside)


# ---- Sockets and files


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # its socket
def test_udp_receives_what_faery_sends():
    faery = pytest.importorskip("faery")
    encoder = pytest.importorskip("faery.udp_encoder")
    events = some_events(250)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    columns = {"t": events.t, "x": events.x, "y": events.y, "on": events.p}
    array = np.zeros(len(events), faery.EVENTS_DTYPE)
    for name, column in columns.items():
        array[name] = column
    pieces = sources.udp("127.0.0.1", port)
    assert next(pieces) == b""  # nothing yet, and it does not wait for it
    encoder.encode([array], ("127.0.0.1", port))
    found = b""
    while len(found) < 13 * len(events):  # in datagrams of any size
        found += next(pieces)
    pieces.close()
    decoded = concatenate([*sources.decoded([found], "t64_x16_y16_on8", True)])
    assert rows(decoded) == rows(events)
    gc.collect()  # faery leaves its socket open: here, not in the next test


def test_tcp_reads_until_the_sender_ends():
    events = some_events(500)
    with socket.create_server(("127.0.0.1", 0)) as server:

        def send():
            connection, _ = server.accept()
            with connection:
                connection.sendall(written(events, "t64_x16_y16_on8"))

        threading.Thread(target=send, daemon=True).start()
        pieces = sources.tcp("127.0.0.1", server.getsockname()[1])
        found = concatenate([*sources.decoded(pieces, "t64_x16_y16_on8")])
    assert rows(found) == rows(events)


def test_nobody_there_is_one_sentence():
    with pytest.raises(RecordingError, match="start the program that sends"):
        sources.tcp("127.0.0.1", 1)


def test_what_comes_before_the_first_is_asked_for_waits():
    """While the network is compiled, after the page was announced."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sending:
        sending.bind(("127.0.0.1", 0))
        address = sending.getsockname()
        with pytest.raises(RecordingError, match=f"udp://127.0.0.1:{address[1]}: cannot listen"):
            sources.udp(*address)
    pieces = sources.udp(*address)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sending:
        sending.sendto(b"early", address)
    assert next(piece for piece in pieces if piece) == b"early"
    pieces.close()


def test_a_camera_that_is_unplugged_is_one_sentence(monkeypatch):
    """Against a driver with the interface of neuromorphic_drivers 0.18."""
    events = some_events()
    kind = [("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")]
    packet = SimpleNamespace(polarity_events=np.array(rows(events), kind))

    class Device(contextlib.nullcontext):
        def name(self):
            return SimpleNamespace(value="a camera")

        def properties(self):
            return SimpleNamespace(width=WIDTH, height=HEIGHT)

        def __enter__(self):
            return self

        def __iter__(self):
            yield from (
                (None, one) for one in (packet, None, SimpleNamespace(polarity_events=None))
            )
            raise RuntimeError("No such device (it may have been disconnected)")

    driver = SimpleNamespace(open=lambda iterator_timeout: Device())
    monkeypatch.setitem(sys.modules, "neuromorphic_drivers", driver)
    source, found = sources.camera(), []
    assert source[:3] == ("a camera", HEIGHT, WIDTH)
    with pytest.raises(RecordingError, match="a camera: gives no more events .No such device"):
        found.extend(source.arrivals)
    assert rows(concatenate(found)) == rows(events) and len(found) == 3


def test_a_growing_file(tmp_path):
    path, events = tmp_path / "events.bin", some_events(100)
    data = written(events, "t64_x16_y16_on8")
    path.write_bytes(data[:400])
    arrivals = sources.decoded(sources.growing(path), "t64_x16_y16_on8")
    first = [next(arrivals), next(arrivals)]
    with path.open("ab") as file:
        file.write(data[400:])
    assert rows(concatenate([*first, next(arrivals)])) == rows(events)


# ---- Replay


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


def test_a_file_that_is_begun_anew_is_said(tmp_path):
    path = tmp_path / "events.bin"
    path.write_bytes(written(some_events(100), "t64_x16_y16_on8"))
    pieces = sources.growing(path)
    assert len(next(pieces)) == 1300 and next(pieces) == b""
    path.write_bytes(b"")
    with pytest.raises(RecordingError, match=r"events\.bin: was begun anew by its writer"):
        next(pieces)


def test_a_file_that_is_replaced_is_said(tmp_path):
    """Writers of new files rename them to their names, or remove the old one before."""
    path, later = tmp_path / "events.bin", tmp_path / "later.bin"
    path.write_bytes(b"a" * 26)
    pieces = sources.growing(path)
    assert len(next(pieces)) == 26 and next(pieces) == b""
    path.rename(tmp_path / "old.bin")
    assert next(pieces) == b""  # a new one may come
    later.write_bytes(b"b" * 260)
    later.rename(path)
    with pytest.raises(RecordingError, match=r"events\.bin: was begun anew by its writer"):
        next(pieces)


@pytest.mark.parametrize("speed", [0.5, 1.0, 20.0])
def test_replay_gives_events_when_they_would_have_come(tmp_path, speed):
    chunks = some_events(300, seed=1), some_events(300, start=50_000, seed=2)
    clock, arrived = Clock(), []
    for events in sources.replay(
        recording_of(tmp_path, *chunks), speed, 2, clock=clock, sleep=clock.sleep
    ):
        arrived += [(clock.now, *row) for row in rows(events)]
    whole = rows(concatenate(list(chunks)))
    assert [row[2:] for row in arrived] == [row[1:] for row in whole * 2]
    now, t = np.array([row[:2] for row in arrived]).T
    assert (np.diff(t) >= 0).all() and t[600] > t[599]
    lateness = (now - 100.0) - (t - t[0]) / 1e6 / speed
    assert lateness.min() > -1e-9 and lateness.max() < sources.SLICE + 1e-9


def test_a_recording_that_ends_at_time_zero_is_repeated_after_it(tmp_path):
    t = np.array([-2000, -1000, 0])
    recording = recording_of(tmp_path, Events.of(t, t * 0, t * 0, t * 0))
    clock = Clock()
    found = sources.replay(recording, 1.0, 2, clock=clock, sleep=clock.sleep)
    times = np.concatenate([events.t for events in found])
    assert len(times) == 6 and (np.diff(times) > 0).all()


def test_replay_goes_on_an_hour_after_a_clock_was_set(tmp_path):
    chunk = some_events(300, seed=1)
    chunk.t[100:] += 1_700_000_000_000_000
    clock = Clock()
    arrived = [
        (clock.now, len(events))
        for events in sources.replay(
            recording_of(tmp_path, chunk), clock=clock, sleep=lambda _: clock.sleep(60)
        )
        if len(events)
    ]
    assert sum(count for _, count in arrived) == 300
    assert 3600 <= arrived[-1][0] - 100 < 3800


# ---- Windows


def cut(parts, count, longest, speed=1.0):
    """parts: (seconds of the clock, events)"""
    clock = iter([now for now, _ in parts])
    arrivals = (events for _, events in parts)
    found = windows(arrivals, count, longest, clock=lambda: next(clock), speed=speed)
    return list(found)


def test_windows_of_a_count_and_of_a_time():
    events = some_events(1000, last=400_000)
    parts = [(0.01 * k, events.select(slice(37 * k, 37 * k + 37))) for k in range(28)]
    found = cut(parts, 60, 20_000)
    assert rows(concatenate([w.events for w in found])) == rows(events)
    for window, following in itertools.pairwise(found):
        t = window.events.t
        full = len(t) == 60 or following.events.t[0] - t[0] >= 20_000
        assert full and len(t) <= 60 and t[-1] - t[0] < 20_000


def test_the_last_events_before_a_pause_do_not_wait_for_its_end():
    events, nothing = some_events(10, last=1000), Events.empty()
    parts = [(0.0, events), (0.01, nothing), (0.039, nothing), (0.041, nothing), (9.0, nothing)]
    found = cut(parts, 60, 40_000)
    assert [(len(w.events), w.at) for w in found] == [(10, 0.0)]
    parts = [(10 * now, events) for now, events in parts]  # as slow as a tenth
    assert [(len(w.events), w.at) for w in cut(parts, 60, 40_000, 0.1)] == [(10, 0.0)]
    parts[2:3] = [(0.3, some_events(5, last=1000, start=2000)), (0.35, nothing)]
    assert [len(w.events) for w in cut(parts, 60, 40_000, 0.1)] == [15]


def test_what_is_left_of_a_full_window_waits_as_long_as_what_came_with_it():
    """Not since the window's own beginning."""
    events, nothing = some_events(80, last=1000), Events.empty()
    first, rest = events.select(slice(5)), events.select(slice(5, None))
    parts = [(0.0, first), (0.03, rest), (0.06, nothing), (0.08, nothing)]
    assert [(len(w.events), w.at) for w in cut(parts, 60, 40_000)] == [(60, 0.03), (20, 0.03)]
    more = some_events(7, last=1000, start=2000)
    parts[3:] = [(0.065, more)]  # the pause was not long enough
    assert [len(w.events) for w in cut(parts, 60, 40_000)] == [60, 27]


def test_what_cannot_be_is_left_out_and_counted():
    events = Events.of([5, 6, 4, 7, 8], [0, 20, 1, 2, -1], [0, 0, 0, 12, 3], [1] * 5)
    figures = Figures()
    (found,) = valid_events([events], HEIGHT, WIDTH, figures)
    assert rows(found) == [(5, 0, 0, True)] and (figures.events, figures.bad) == (5, 4)
    with pytest.raises(RecordingError, match="--sensor-size and --wire"):
        list(valid_events([some_events(2000)], 2, 2, Figures()))


def test_hot_pixels_are_found_as_events_come_and_left_out(tmp_path):
    usual = some_events(4000, last=10**6)
    fires = np.arange(0, 10**6, 500)
    hot = Events.of(fires, fires * 0 + 7, fires * 0 + 3, fires * 0 + 1)
    whole = concatenate([usual, hot])
    whole = whole.select(np.argsort(whole.t, kind="stable"))
    cuttings = [whole.select(slice(k, k + 100)) for k in range(0, len(whole), 100)]
    found = list(without_hot_pixels([Events.empty(), *cuttings], HEIGHT, WIDTH))
    assert len(found) == len(cuttings) + 1  # an empty arrival tells the time
    late = concatenate(found[len(found) // 4 :])
    assert not np.any((late.x == 7) & (late.y == 3))
    expected = find_hot_pixels(recording_of(tmp_path, whole))
    assert expected.sum() == 1
    left = concatenate(list(without_hot_pixels(cuttings, HEIGHT, WIDTH, expected)))
    assert rows(left) == [row for row in rows(whole) if row[1:3] != (7, 3)]


def test_hot_pixels_of_a_file_and_a_camera_upside_down(tmp_path):
    events = some_events(50)
    x, y = int(events.x[0]), int(events.y[0])
    (tmp_path / "hot.txt").write_text(f"{x},{y}\n")
    asked = live.Live("-", hot_pixels=str(tmp_path / "hot.txt"), flip=True)
    (found,) = live.prepared(asked, HEIGHT, WIDTH)(iter([events]))
    assert rows(found) == [
        (t, WIDTH - 1 - a, HEIGHT - 1 - b, p) for t, a, b, p in rows(events) if (a, b) != (x, y)
    ]
    (same,) = live.prepared(live.Live("-"), HEIGHT, WIDTH)(iter([events]))
    assert rows(same) == rows(events)


@pytest.mark.parametrize("broken", [0, 2**40])
def test_a_sender_that_starts_again_is_seen_again(broken):
    before = some_events(5000, start=10**9)
    if broken:  # one time far ahead, as of a damaged packet
        before.t[-1] = broken
    after = [some_events(200, seed=k, last=9000, start=10_000 * k) for k in range(100)]
    figures = Figures()
    found = concatenate(list(valid_events([before, *after], HEIGHT, WIDTH, figures)))
    assert len(found) >= 5000 + 20_000 - 1200 and figures.bad <= 1200
    assert (np.diff(found.t) >= 0).all()
    assert rows(found)[-200:] == [(t, x, y, p) for t, x, y, p in rows(found)[-200:]]
    assert np.diff(found.t[-200:]).tolist() == np.diff(after[-1].t).tolist()


@pytest.mark.parametrize("piece", [100, 5000])
def test_a_late_time_at_the_beginning_is_survived(piece):
    events = some_events(20_000, last=10**6)
    events.t[50] = 2**45
    figures = Figures()
    arrivals = [events.select(slice(k, k + piece)) for k in range(0, 20_000, piece)]
    found = concatenate(list(valid_events(arrivals, HEIGHT, WIDTH, figures)))
    assert len(found) == 20_000 - figures.bad >= 20_000 - 1000 - piece
    assert (np.diff(found.t) >= 0).all() and figures.outside == 0


def test_a_sender_that_starts_again_at_once_is_seen_again():
    later = [some_events(500, seed=k, start=10**6 * k, last=10**6) for k in range(9)]
    arrivals = [some_events(500, start=10**9), *later]
    figures = Figures()
    found = concatenate(list(valid_events(arrivals, HEIGHT, WIDTH, figures)))
    assert len(found) >= 5000 - 1000 and (np.diff(found.t) >= 0).all()


# ---- Threads


def test_the_oldest_of_too_many_windows_is_dropped():
    figures = Figures()
    waiting = Waiting(2, figures)
    waiting.fill(Arrived(some_events(1), float(k)) for k in range(5))
    assert [window.at for window in waiting] == [3.0, 4.0] and figures.dropped == 3


def test_an_error_of_the_reader_reaches_who_takes():
    def broken():
        yield Arrived(some_events(1), 0.0)
        raise RecordingError("damaged")

    waiting, taken = Waiting(2, Figures()), []
    waiting.fill(broken())
    with pytest.raises(RecordingError, match="damaged"):
        taken += waiting
    assert len(taken) == 1 or not taken


@pytest.fixture(scope="module")
def weights():
    return Weights(initial_params(jax.random.key(0)), True)


def test_pictures_are_those_of_the_batch_program(weights):
    parts = [some_events(84, last=10_000, start=10_000 * k, seed=k) for k in range(5)]
    figures = Figures()
    source = sources.Source("parts", HEIGHT, WIDTH, iter(parts))
    found = pictures(source, weights, Limits(84, 10**6, 10), figures)
    found = np.stack(list(found))
    _, expected = events_to_pictures(
        weights, initial_session(1, HEIGHT, WIDTH, Network()), pack([[part] for part in parts]),
        np.ones((5, 1), bool), height=HEIGHT, width=WIDTH, settings=Display(), preview=True,
    )  # fmt: skip
    difference = np.abs(found.astype(int) - np.asarray(expected)[:, 0])
    assert difference.max() <= 1  # sums of another chunk may round to the next grey
    summary = figures.summary()
    assert (summary["windows"], summary["dropped_windows"], summary["events"]) == (5, 0, 420)
    assert 0 < summary["latency_ms"] <= summary["latency_95_ms"]


def test_windows_are_cut_by_the_limits_of_the_pictures(weights, monkeypatch):
    seen = []

    def noted(arrivals, count, longest, **choices):
        seen.append((count, longest, choices))
        return windows(arrivals, count, longest, **choices)

    monkeypatch.setattr("firenet_jax.live.engine.windows", noted)
    source = sources.Source("parts", HEIGHT, WIDTH, iter([some_events(84)]))
    limits = Limits(84, 10**6, 10, speed=0.25)
    assert len(list(pictures(source, weights, limits, Figures()))) == 1
    assert seen == [(84, 10**6, {"speed": 0.25})]


# ---- The page


@pytest.fixture
def page():
    board = Board()
    server = serve(board, lambda: {"events": 7}, "a <camera>", 0)
    yield board, server.server_address[1]
    board.end()
    server.shutdown()
    server.server_close()


def ask(port, path, host=None, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    headers |= {} if host is None else {"Host": host}
    connection.request("GET", path, headers={k.replace("_", "-"): v for k, v in headers.items()})
    return connection, connection.getresponse()


def test_the_page_and_its_figures(page):
    _, port = page
    connection, response = ask(port, "/")
    assert response.status == 200 and "a &lt;camera>" in response.read().decode()
    connection.close()
    connection, response = ask(port, "/figures")
    assert json.loads(response.read()) == {"events": 7}
    connection.close()


def test_nobody_else_may_ask(page):
    _, port = page
    for path, host, status in (
        ("/", "evil.example:80", 403),
        ("/", "localhost", 200),
        ("/nothing", None, 404),
    ):
        connection, response = ask(port, path, host)
        assert response.status == status
        connection.close()


@pytest.mark.parametrize("path", ["/video", "/figures"])
def test_no_page_of_somebody_else_shows_it(page, path):
    board, port = page
    board.hang(np.zeros((16, 32, 3), np.uint8))
    for site, status in {"cross-site": 403, "same-site": 403, "same-origin": 200}.items():
        connection, response = ask(port, path, Sec_Fetch_Site=site)
        assert response.status == status
        connection.close()


def test_who_has_left_the_video_is_noticed_without_new_pictures(page, monkeypatch):
    monkeypatch.setattr("firenet_jax.live.page.AGAIN", 0.02)
    before = threading.active_count()
    for connection, response in [ask(page[1], "/video") for _ in range(3)]:
        assert response.readline() == b"--picture\r\n"
        response.close()
        connection.close()
    for _ in range(100):
        if threading.active_count() <= before:
            return
        time.sleep(0.05)
    raise AssertionError(f"{threading.active_count() - before} threads are left")


def test_a_browser_that_goes_away_leaves_no_traceback(page, capfd):
    _, port = page
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        connection.send(b"GET /fig")
        time.sleep(0.1)
    time.sleep(0.2)
    assert capfd.readouterr().err == ""


def test_the_video_shows_the_newest_picture(page):
    board, port = page
    picture = np.zeros((16, 32, 3), np.uint8)
    picture[:, 16:] = 200
    board.hang(picture)
    connection, response = ask(port, "/video")
    head = [response.readline() for _ in range(4)]
    length = int(head[2].split(b":")[1])
    with Image.open(io.BytesIO(response.read(length))) as image:
        shown = np.asarray(image).astype(int)
    assert np.abs(shown - picture).max() < 8
    connection.close()


# ---- The command


def write_text(path, count=6000):
    events = some_events(count, last=300_000)
    lines = [f"{t / 1e6:.6f} {x} {y} {int(p)}\n" for t, x, y, p in rows(events)]
    path.write_text(f"{WIDTH} {HEIGHT}\n" + "".join(lines))


def test_a_recording_played(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_text(tmp_path / "a.txt")
    assert cli.main(["live", "a.txt", "--replay", "--speed", "3", "--port", "0"]) == 0
    said = capsys.readouterr().out
    assert "of 6,000 events" in said and "http://127.0.0.1:" in said


def test_a_name_that_is_no_text(tmp_path, monkeypatch):
    board, name = Board(), os.fsdecode(b"bad\xff.aedat4")
    server = serve(board, dict, name, 0)
    connection, response = ask(server.server_address[1], "/")
    assert "bad\\udcff.aedat4" in response.read().decode()
    connection.close()
    server.shutdown()
    server.server_close()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes")
def test_a_named_pipe_is_read_by_standard_input(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(RecordingError, match="is a pipe: read it by firenet live - <"):
        live.source_of(live.Live(str(tmp_path / "pipe"), sensor_size="20x12"))


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ("udp://127.0.0.1:3333", "pass --sensor-size"),
        ("udp://nowhere --sensor-size 20x12", "expected udp://HOST:PORT"),
        ("udp://[::1:3333 --sensor-size 20x12", "expected udp://HOST:PORT"),
        ("udp://[zz]:33 --sensor-size 20x12", "expected udp://HOST:PORT"),
        ("tcp://a..b:3333 --sensor-size 20x12 --port 0", "tcp://a..b:3333: "),
        ("udp://a..b:3333 --sensor-size 20x12 --port 0", "udp://a..b:3333: "),
        ("missing.bin --sensor-size 20x12", "no such file, and no source"),
        ("a.txt --replay --speed 0", "speed is 0.0"),
        ("a.txt --replay --speed inf", "speed is inf"),
        ("a.txt --replay --seconds -1", "seconds is -1.0"),
        ("a.txt --replay --seconds nan", "seconds is nan"),
        ("a.txt --replay --longest 0.0004", "longest"),
        ("a.txt --replay --longest inf", "longest"),
        ("a.txt --replay --port 70000", "ports are 0 to 65535"),
        (
            "a.txt --sensor-size 20x12 --speed 2 --repeat 3",
            "speed, repeat: no effect with a stream",
        ),
        ("a.txt --replay --wire text", "wire: no effect with a replay"),
        ("camera --sensor-size 20x12", "sensor-size: no effect with a camera"),
    ],
)
def test_mistakes_are_one_sentence(tmp_path, monkeypatch, capsys, arguments, expected):
    monkeypatch.chdir(tmp_path)
    write_text(tmp_path / "a.txt", 10)
    with contextlib.suppress(SystemExit):  # what is wrong with options alone
        assert cli.main(["live", *arguments.split()]) == 1
    assert expected in " ".join(capsys.readouterr().err.split())


def test_a_taken_port_is_one_sentence(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_text(tmp_path / "a.txt", 10)
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = str(server.getsockname()[1])
        assert cli.main(["live", "a.txt", "--replay", "--port", port]) == 1
    assert "pass another --port" in capsys.readouterr().err


def test_a_connection_that_breaks_is_told_after_what_was_seen(tmp_path, monkeypatch, capsys):
    with socket.create_server(("127.0.0.1", 0)) as server:

        def send():
            connection, _ = server.accept()
            rows = "".join(f"{200 * n} {n % 20} {n % 12} 1\n" for n in range(2000))
            connection.sendall(rows.encode())
            time.sleep(1)
            off = struct.pack("ii", 1, 0)  # closing it is a reset
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, off)
            connection.close()

        sender = threading.Thread(target=send)
        sender.start()
        source = f"TCP://127.0.0.1:{server.getsockname()[1]}"
        found = ["live", source, "--wire", "text", "--sensor-size", "20x12", "--port", "0"]
        assert cli.main(found) == 1
        sender.join()
    said = capsys.readouterr()
    assert "the connection broke" in said.err and "pictures of" in said.out


def test_it_ends_after_so_many_seconds(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_text(tmp_path / "a.txt")
    begun = time.monotonic()
    arguments = "live a.txt --replay --speed 0.01 --seconds 1 --port 0"
    assert cli.main(arguments.split()) == 0
    assert time.monotonic() - begun < 25 and "events in" in capsys.readouterr().out


def test_what_was_taken_in_time_is_seen(monkeypatch):
    """Although it was read for longer than all may take."""
    clock = itertools.count()
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    assert [len(part) for part in live._first(0.5, iter([some_events(7), some_events(9)]))] == [7]


def test_seconds_count_from_the_first_look_at_the_source(tmp_path, monkeypatch, capsys):
    """On a busy machine compiling took them all, and none were left for events."""
    monkeypatch.chdir(tmp_path)
    write_text(tmp_path / "a.txt")
    (tmp_path / "empty.txt").touch()

    def slow(*args):
        time.sleep(0.4)
        yield from pictures(*args)

    monkeypatch.setattr(live, "pictures", slow)
    end = f"--sensor-size {WIDTH}x{HEIGHT} --wire text --seconds 0.3 --port 0"
    assert cli.main(["live", "a.txt", *end.split()]) == 0
    assert "of 6,000 events" in capsys.readouterr().out
    assert cli.main(["live", "empty.txt", *end.split()]) == 0
    said = capsys.readouterr().out
    assert "0 pictures of 0 events" in said and "None" not in said


def test_wrong_times_now_and_then_do_not_stop_all():
    chunks = [some_events(10, last=900, seed=n, start=1000 * n) for n in range(600)]
    wrong = Events.of([2**50], [1], [1], [1])
    for n in range(100, 600, 50):
        parts = chunks[n].select(slice(4)), wrong, chunks[n].select(slice(4, None))
        chunks[n] = concatenate(parts)
    figures = Figures()
    found = concatenate([*valid_events(chunks, 12, 20, figures)])
    assert (figures.events, figures.bad, len(found)) == (6010, 10, 6000)
    assert (np.diff(found.t) >= 0).all() and found.t[-1] < 600_000
    first = concatenate([wrong, chunks[0]])  # nor does the very first
    assert len(concatenate([*valid_events([first, *chunks[1:]], 12, 20, Figures())])) == 6000
    # The last of a chunk cannot be told from a pause: a thousand events later it goes on from it.
    chunks[100] = concatenate([chunks[100], wrong])
    figures = Figures()
    found = concatenate([*valid_events(chunks, 12, 20, figures)])
    assert figures.bad < 1100 and found.t[-1] > 2**50


@pytest.mark.parametrize("speed", [1e20, 1e308, 1e-300])
def test_a_speed_that_no_clock_has_is_refused(speed):
    with pytest.raises(ValueError, match="a millionth to a million times"):
        live.Live("a.h5", replay=True, speed=speed)


def test_before_the_first_picture_there_is_an_empty_one():
    number, data = Board().newest(-1)
    assert number == 0 and Image.open(io.BytesIO(data)).size == (1, 1)
