"""Progress: percent and the time left, a line a minute where there is no terminal."""

import gzip
import os
import re
import zipfile

import numpy as np
import pytest

from firenet_jax.readers import open_recording
from firenet_jax.storage import progress
from firenet_jax.storage.progress import Bytes, bar, one_done


def test_a_line_a_minute_without_a_terminal(capsys, monkeypatch):
    now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    monkeypatch.setattr("tqdm.std.time", lambda: now)
    with bar(1000, "ev") as shown:
        for _ in range(10):
            now += 13.0
            shown.update(50)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert re.match("firenet: 25 %, 01:05 passed, 03:1[45] left", lines[0])  # 195 s
    assert re.match("firenet: 50 %, 02:10 passed, 02:(10|09) left", lines[1])


def test_the_first_may_say_nothing_of_the_others(capsys, monkeypatch):
    now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    monkeypatch.setattr("tqdm.std.time", lambda: now)
    with bar(101, "step") as shown:
        now += 75.0
        one_done(shown, first=True)
        for _ in range(25):
            now += 3.0
            one_done(shown, first=False)
    (line,) = capsys.readouterr().err.splitlines()
    assert re.match(r"firenet: 21 %, 01:00 passed, 04:00 left, +3.00s/step", line)
    with bar(10, "ev", quiet=True) as shown:
        one_done(shown, first=True)


def test_a_short_run_says_nothing(capsys):
    with bar(10, "ev") as shown:
        shown.update(10)
    with bar(10, "ev", quiet=True) as shown:
        shown.update(10)
    assert capsys.readouterr().err == ""


def test_bytes_read_of_bytes(tmp_path):
    (tmp_path / "folder").mkdir()
    for name, size in (("a.bin", 1000), ("folder/large", 5000), ("folder/small", 10)):
        (tmp_path / name).write_bytes(bytes(size))
    read = Bytes([tmp_path / "a.bin", tmp_path / "folder"])
    if read.total is None:
        return  # a system that does not tell
    assert read.total == 6000 and read.read() == 0
    with open(tmp_path / "folder" / "large", "rb", buffering=0) as file:
        file.read(3000)
        assert read.read() == 3000
        file.seek(0)  # a second pass
        assert read.read() == 3000
    with open(tmp_path / "a.bin", "rb") as file:
        file.read()
        assert read.read() == 4000


def shares(path):
    """How much of a file is said to be read when each chunk of its events has come."""
    recording, read = open_recording(path), Bytes([path])
    found = [(len(chunk), read.read() / read.total) for chunk in recording.events()]
    return [share for _, share in found], sum(count for count, _ in found)


@pytest.mark.skipif(not os.path.isdir("/proc/self/fdinfo"), reason="a system that does not tell")
@pytest.mark.parametrize("name", ["a.txt", "a.zip", "a.txt.gz"])
def test_texts_are_read_by_percent(tmp_path, name):
    rng, count = np.random.default_rng(0), 400_000
    columns = np.sort(rng.random(count)), rng.integers(0, 240, count), rng.integers(0, 180, count)
    rows = [f"{t:.6f} {x} {y} {k % 2}" for k, (t, x, y) in enumerate(zip(*columns, strict=True))]
    text = "240 180\n" + "\n".join(rows) + "\n"
    if name == "a.zip":
        with zipfile.ZipFile(tmp_path / name, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("events.txt", text)
    else:
        data = text.encode()
        (tmp_path / name).write_bytes(gzip.compress(data) if name.endswith("gz") else data)
    reached, events = shares(tmp_path / name)
    assert events == count and reached == sorted(reached)
    assert len(set(reached)) > 1 and reached[0] < 1 and reached[-1] > 0.9


@pytest.mark.skipif(not os.path.isdir("/proc/self/fdinfo"), reason="a system that does not tell")
@pytest.mark.parametrize(
    "name",
    ["evt2_sparklers.raw", "evt3_driving.raw", "davis346_59_frames.aedat4", "davis240_boxes.aedat",
     "dvs_synthetic_sweep.es", "ros1_event_camera_msgs.bag", "ros2_mcap",
     "ros2_event_camera_msgs",
     "e2vid_slider_depth.zip", "ecd_slider_depth", "ncars.dat",
     "ncaltech101_faces_easy_0001.bin"],
)  # fmt: skip
def test_recordings_are_read_by_percent_or_know_their_events(recordings, name):
    recording = open_recording(recordings / name)
    if recording.count is not None:
        assert sum(map(len, recording.events())) == recording.count
        return
    reached, _ = shares(recordings / name)
    assert reached == sorted(reached) and reached[-1] > 0.7  # at the last chunk; more may follow
