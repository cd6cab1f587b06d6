"""Times that are asked for, against what their files say in other words."""

import logging
import os
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from test_windows import recording_of

from firenet_jax.commands.times import Times, times_of
from firenet_jax.errors import RecordingError
from firenet_jax.events import MAX_TIME
from firenet_jax.filters import read_hot_pixels
from firenet_jax.instants import Grid

T = 5_000_000 + np.arange(0, 2_000_000, 1000)  # 5 to 7 s on the sensor's clock
WANTED = [5_250_000, 5_500_000, 6_000_001]  # microseconds


@pytest.fixture
def recording():
    return recording_of(T, frames=[4_990_000, 5_030_000, 5_030_000, 5_070_000])


def read(tmp_path, recording, text, **choices):
    (tmp_path / "times.txt").write_text(text, encoding="utf-8")
    return times_of(Times(at=tmp_path / "times.txt", **choices), recording, recording.events())


@pytest.mark.parametrize(
    "text",
    [
        "5.25\n5.5\n6.000001\n",
        "5250000\n5500000\n6000001\n",
        "5250000000\n5500000000\n6000001000\n",
        "250000\n500000\n1000001\n",
        ".25\n.5\n1.000001\n",
        "250000000\n500000000\n1000001000\n",
        "5250ms\n5500 ms\n6000.001 ms\n",
        "6000001us\n5250000us\n5500000us\n",
        "# since the start, in seconds\n\n0.25\n0.5\n1.000001\n",
        "#timestamp [ns],filename\n5250000000,a.png\n5500000000,b.png\n6000001000,c.png\n",
        "index,time_us,events\n0,5250000,7\n1,5500000,8\n2,6000001,9\n",
        "# index time_us events\n0 5250000 7\n1 5500000 8\n2 6000001 9\n",
        '"stamps","file1"\n5.25,"a"\n5.5,"b"\n6.000001,"c"\n',
        "t0\n5.25\n5.5\n6.000001\n",
        "5.25 images/a.png\n5.5 images/b.png\n6.000001 images/c.png\n",
        "\ufefft\n5.25e6\n5.5e6\n6.000001e6\n",
    ],
)
def test_the_same_times_in_other_words(tmp_path, recording, text):
    choices = {"unit": "us"} if "e6" in text else {}
    found = read(tmp_path, recording, text, **choices)
    assert found.tolist() == WANTED and found.dtype == np.int64


def test_what_was_told_apart_is_said_and_options_decide(tmp_path, recording, caplog):
    with caplog.at_level(logging.WARNING):
        read(tmp_path, recording, "0\n1000000\n")
    assert "2 times are taken as microseconds, since the first event" in caplog.text
    caplog.clear()
    found = read(tmp_path, recording, "0\n1000\n", unit="ns", since="start")
    assert found.tolist() == [5_000_000, 5_000_001] and not caplog.text
    found = read(tmp_path, recording, "5\n6\n", unit="s", since="zero")
    assert found.tolist() == [5_000_000, 6_000_000]


@pytest.mark.parametrize(
    "text, times",
    [
        ("0\n100000\n2100000\n", [0, 100_000, 2_100_000]),  # microseconds, one beyond the end
        ("1\n2\n", [1_000_000, 2_000_000]),  # whole seconds, the last beyond the end
        ("0\n500\n1000\n1500\n", [0, 500_000, 1_000_000, 1_500_000]),  # whole milliseconds
        ("0\n33\n67\n100\n133\n", [0, 33_000, 67_000, 100_000, 133_000]),
        ("33.3\n66.6\n", [33_300, 66_600]),
        ("33333.0\n66667.0\n", [33_333, 66_667]),
        ("1.0e+05\n1.2e+06\n", [100_000, 1_200_000]),  # as numpy.savetxt writes them
        ("5.0e+06\n5.25e+06\n", [0, 250_000]),  # on the sensor's clock
        ("5000\n5033\n", [0, 33_000]),
        ("5\n6\n", [0, 1_000_000]),
    ],
)
def test_a_unit_is_that_whose_times_cover_the_recording(tmp_path, recording, text, times):
    """Of a finer one more times always lie within it, all in its first instant."""
    assert read(tmp_path, recording, text).tolist() == [5_000_000 + time for time in times]


def test_a_time_that_is_there_twice_is_said(tmp_path, recording, caplog):
    with caplog.at_level(logging.WARNING):
        found = read(tmp_path, recording, "0.3\n0.1\n0.1\n0.2\n", unit="s", since="start")
    assert found.tolist() == [5_100_000, 5_200_000, 5_300_000]
    assert "1 time of before: one image each" in caplog.text
    assert "its times are not in order" in caplog.text


def test_a_unit_that_is_not_that_of_the_file(tmp_path, recording, caplog):
    """It is taken, for a header may have been misunderstood, but said."""
    assert read(tmp_path, recording, "5.25s\n", unit="s", since="zero").tolist() == [5_250_000]
    assert not caplog.text
    for text in ("5250s\n", "# timestamp [s]\n5250\n", "# one every 10 s\n5250\n"):
        caplog.clear()
        assert read(tmp_path, recording, text, unit="ms", since="zero").tolist() == [5_250_000]
        assert "says that its times are in seconds, --unit takes them as mill" in caplog.text


def test_times_of_today_keep_their_microseconds(tmp_path):
    first = 1_764_000_000_000_000
    recording = recording_of(first + np.arange(1000))
    assert read(tmp_path, recording, "1764000000.000123\n").tolist() == [first + 123]
    assert read(tmp_path, recording, "1764000000000123456\n").tolist() == [first + 123]


@pytest.mark.parametrize(
    "text, said",
    [
        ("", "holds no times"),
        ("# time\n\n", "holds no times"),
        ("5.25\nsoon\n", "line 2: expected a time, found 'soon'"),
        ("5.25s\n5500ms\n", "line 2: is in ms, but before it in s"),
        ("5.25\n5500ms\n", "line 2: names a unit, but those before do not"),
        ("5 parsec\n5parsec\n", "holds no times|expected a time"),
        ("O.5\n1.0\n", "line 1: expected a time, found 'O.5'"),
        ("00:00:01.5\n00:00:02\n", "line 1: expected a time, found '00:00:01.5'"),
        ("9999.5\n", "none of its 1 time lies within the recording, 5.000000 to 6.999000 s"),
        ("9" * 400 + "\n", "none of its"),
        ("nan\n", "line 1: expected a time, found 'nan'"),
    ],
)
def test_files_that_are_of_no_use(tmp_path, recording, text, said):
    with pytest.raises(RecordingError, match=said):
        read(tmp_path, recording, text)


def test_numbers_beyond_all_times_lie_outside(tmp_path, recording):
    found = read(tmp_path, recording, "5.25\n5.5\n1e999999999\n")
    assert found[:2].tolist() == [5_250_000, 5_500_000] and found[2] == MAX_TIME
    found = read(tmp_path, recording, "5.5e-9999999999999999999\n5.25\n", unit="s", since="zero")
    assert found.tolist() == [0, 5_250_000]
    with pytest.raises(RecordingError, match="line 2: expected a time"):  # int() takes 4,300 digits
        read(tmp_path, recording, f"5.25\n1e{'9' * 5000}\n")


@pytest.mark.skipif(sys.platform == "win32", reason="no pipes with names")
def test_lists_are_read_more_than_once_so_they_are_no_pipes(tmp_path, recording):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(RecordingError, match="is a pipe or device, but is read more than once"):
        times_of(Times(at=tmp_path / "pipe"), recording, recording.events())
    with pytest.raises(RecordingError, match="is a pipe or device, but is read more than once"):
        read_hot_pixels(tmp_path / "pipe", 4, 5)


def test_a_file_that_is_not_there(tmp_path, recording):
    with pytest.raises(RecordingError, match="cannot read this list of times"):
        times_of(Times(at=tmp_path / "none.txt"), recording, recording.events())


def test_rate_frames_and_nothing(recording):
    found = times_of(Times(rate=30), recording, recording.events())
    assert isinstance(found, Grid) and next(found) == 5_000_000
    found = times_of(Times(rate=30, from_zero=True), recording, recording.events())
    assert next(found) == 5_000_000 and next(found) == 5_033_333
    frames = times_of(Times(between_frames=True), recording, recording.events())
    assert frames.tolist() == [4_990_000, 5_030_000, 5_070_000]
    assert times_of(Times(), recording, recording.events()) is None
    with pytest.raises(RecordingError, match="has no frames"):
        times_of(Times(between_frames=True), recording_of(T), iter([]))
    with pytest.raises(RecordingError, match="no events"):
        times_of(Times(rate=30), recording_of([]), iter([]))


def test_triggers(recording):
    columns = np.array([10, 30, 20, 40]), np.array([0, 0, 1, 0]), np.array([1, 0, 1, 1], bool)
    kept = {field: getattr(recording, field) for field in ("path", "frames", "events")}
    with_triggers = SimpleNamespace(**kept, triggers=lambda: columns)

    def times(**choices):
        return times_of(Times(triggers=True, **choices), with_triggers, iter([])).tolist()

    assert times() == [10, 20, 40]
    assert times(trigger_edges="falling") == [30]
    assert times(trigger_edges="both", trigger_input=0) == [10, 30, 40]
    with pytest.raises(RecordingError, match=r"none of its 4 triggers \(inputs 0, 1\)"):
        times(trigger_input=3)
    for without in (recording, SimpleNamespace(**kept, triggers=lambda: None)):
        with pytest.raises(RecordingError, match="holds no triggers"):
            times_of(Times(triggers=True), without, iter([]))


@pytest.mark.parametrize(
    "choice, said",
    [
        ({"rate": 30.0, "triggers": True}, "choose one of"),
        ({"rate": 0.0}, "rate is 0"),
        ({"from_zero": True}, "--from-zero has no effect without --rate"),
        ({"unit": "s"}, "--unit has no effect without --at"),
        ({"trigger_input": 0}, "--trigger-input has no effect without --triggers"),
    ],
)
def test_impossible_choices(choice, said):
    with pytest.raises(ValueError, match=said):
        replace(Times(), **choice)


def test_a_part_of_the_recording_has_the_same_times(tmp_path, recording):
    """--start and --stop cut, what times count from stays."""
    (tmp_path / "times.txt").write_text("0.25\n0.5\n1.000001\n")
    part = recording_of(T[600:])
    found = times_of(Times(at=tmp_path / "times.txt"), recording, part.events())
    assert found.tolist() == WANTED
