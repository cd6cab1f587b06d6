"""Images and pictures in other files, read back by the libraries of these formats."""

import errno
import json
import os
import re
import sqlite3
import subprocess
from pathlib import Path

import h5py
import numpy as np
import pytest

from firenet_jax.errors import RecordingError
from firenet_jax.readers import open_recording
from firenet_jax.storage.arrays import ArraysWriter
from firenet_jax.storage.bag import BagWriter, check_topic
from firenet_jax.storage.files import OutputError
from firenet_jax.storage.video import FolderWriter, check_output

TIMES = [1_700_000_000_000_001 + 33_333 * k for k in range(5)]


def pictures(count=5, colours=False, height=6, width=9):
    rng = np.random.default_rng(0)
    shape = (count, height, width, 3) if colours else (count, height, width)
    return rng.integers(0, 256, shape, dtype=np.uint8)


def write(writer, images):
    for number, (image, time) in enumerate(zip(images, TIMES, strict=True)):
        writer.write(image, time, 100 + number)
    writer.finish()


def test_arrays_hold_images_times_and_events(tmp_path):
    images = pictures().astype(np.float32) / 200 - 0.1
    write(ArraysWriter(tmp_path / "images.h5"), images)
    with h5py.File(tmp_path / "images.h5") as file:
        assert file["images"].dtype == np.float32 and file["times"].dtype == np.int64
        np.testing.assert_array_equal(file["images"], images)
        assert file["times"][:].tolist() == TIMES
        assert file["events"][:].tolist() == [100, 101, 102, 103, 104]
    assert [path.name for path in tmp_path.iterdir()] == ["images.h5"]


class Full:
    """A disk with room for so many bytes."""

    def __init__(self, file, room):
        self.file, self.room = file, room

    def write(self, data):
        self.room -= len(data)
        if self.room < 0:
            raise OSError(28, "No space left on device")
        return self.file.write(data)

    def __getattr__(self, name):
        return getattr(self.file, name)


@pytest.mark.parametrize("room", [0, 500, 4000, 9000])
def test_a_full_disk_leaves_no_arrays(tmp_path, room):
    """HDF5, left to itself, ended the process."""
    writer = ArraysWriter(tmp_path / "images.h5")
    writer.disk.file = Full(writer.disk.file, room)
    with pytest.raises(OutputError, match=r"cannot write \(No space left on device\)"):
        write(writer, pictures(height=20, width=30).astype(np.float32))
    writer.abandon()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["images.bag", "images.ros2"])
@pytest.mark.parametrize("colours", [False, True])
def test_bags_are_read_back(tmp_path, name, colours):
    highlevel = pytest.importorskip("rosbags.highlevel")
    typesys = pytest.importorskip("rosbags.typesys")
    shown = pictures(colours=colours)
    write(BagWriter(tmp_path / name, "/cam7/image_raw", "left"), shown)
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    with highlevel.AnyReader([tmp_path / name], default_typestore=store) as bag:
        (connection,) = bag.connections
        assert (connection.topic, connection.msgtype) == (
            "/cam7/image_raw",
            "sensor_msgs/msg/Image",
        )
        messages = list(bag.messages())
        assert [time for _, time, _ in messages] == [1000 * time for time in TIMES]
        for (_, time, raw), picture in zip(messages, shown, strict=True):
            message = bag.deserialize(raw, connection.msgtype)
            stamp = message.header.stamp
            assert 10**9 * stamp.sec + stamp.nanosec == time and message.header.frame_id == "left"
            assert message.encoding == ("rgb8" if colours else "mono8")
            assert (message.height, message.width, message.step) == (6, 9, picture[0].size)
            np.testing.assert_array_equal(message.data.reshape(picture.shape), picture)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    if name.endswith("ros2"):
        inside = {path.name for path in (tmp_path / name).iterdir()}
        assert inside == {"metadata.yaml", "images.ros2.db3"}
        # Humble reads up to 8; in 9 the profiles are a list, at which it stops.
        said = (tmp_path / name / "metadata.yaml").read_text()
        assert re.search(r"^ *version: 8$", said, re.M) and "profiles: ''" in said


@pytest.mark.parametrize("name", ["a long walk " * 9, "it's: 2 walks"])
def test_a_bag_of_ros_2_may_have_any_name(tmp_path, name):
    highlevel = pytest.importorskip("rosbags.highlevel")
    path = tmp_path / f"{name}.ros2"
    write(BagWriter(path, "/cam7/image_raw", "left"), pictures())
    with highlevel.AnyReader([path]) as bag:
        assert len(list(bag.messages())) == 5
    assert {file.name for file in path.iterdir()} == {"metadata.yaml", f"{name}.ros2.db3"}


OF_ROS = """
import json, sys
import rosbag
with rosbag.Bag(sys.argv[1]) as bag:
    for topic, message, time in bag.read_messages():
        stamp = [message.header.stamp.to_nsec(), time.to_nsec()]
        size = [message.height, message.width, message.step]
        print(json.dumps([topic, message._type, message.header.frame_id, message.encoding, stamp,
                          size, list(message.data)]))
"""


def test_ros_itself_reads_a_bag(tmp_path):
    """By its own library, which Debian has for its own Python (python3-rosbag)."""
    pytest.importorskip("rosbags")
    python = "/usr/bin/python3"
    asked = [python, "-c", "import rosbag, sensor_msgs.msg"]
    if not Path(python).exists() or subprocess.run(asked, capture_output=True).returncode:
        pytest.skip("needs ROS's own library: Debian's python3-rosbag, python3-sensor-msgs")
    shown = pictures()
    write(BagWriter(tmp_path / "images.bag", "/cam7/image_raw", "left"), shown)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [python, "-c", OF_ROS, tmp_path / "images.bag"],
        env=environment, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(found) == len(shown)
    for (*facts, stamps, size, data), time, picture in zip(found, TIMES, shown, strict=True):
        assert facts == ["/cam7/image_raw", "sensor_msgs/Image", "left", "mono8"]
        assert stamps == [1000 * time, 1000 * time] and size == [*picture.shape, picture.shape[1]]
        assert data == picture.ravel().tolist()


@pytest.mark.parametrize("name", ["images.bag", "images.ros2"])
def test_bags_are_replaced_whole_or_left_out(tmp_path, name):
    pytest.importorskip("rosbags")
    for count in (5, 3):
        writer = BagWriter(tmp_path / name, "/image", "cam0")
        for picture, time in zip(pictures(count), TIMES, strict=False):
            writer.write(picture, time)
        writer.finish()
    with pytest.raises(OutputError, match="exists"):
        check_output(tmp_path / name, overwrite=False)
    check_output(tmp_path / name, overwrite=True)
    other = BagWriter(tmp_path / f"b.{name}", "/image", "cam0")
    other.abandon()
    other = BagWriter(tmp_path / f"b.{name}", "/image", "cam0")
    other.write(pictures()[0], 7)
    other.abandon()
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("place", ["open", "write", "close"])
def test_a_full_disk_leaves_no_bag_of_ros_2(tmp_path, monkeypatch, place):
    """Its database has a kind of error of its own."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    original = getattr(rosbag2.Writer, place)

    def full(self, *args, **kwargs):
        if place == "open":
            original(self)
        raise sqlite3.OperationalError("database or disk is full")

    monkeypatch.setattr(rosbag2.Writer, place, full)
    writer = BagWriter(tmp_path / "images.ros2", "/image", "cam0")
    with pytest.raises(OutputError, match=r"cannot write \(database or disk is full\)"):
        write(writer, pictures())
    writer.abandon()
    assert not list(tmp_path.iterdir())


def test_a_disk_that_is_full_at_the_very_end_leaves_the_bag_before(tmp_path, monkeypatch):
    """The bag's own list of its files is written last."""
    pytest.importorskip("rosbags")

    def write_bag():
        writer = BagWriter(tmp_path / "images.ros2", "/image", "cam0")
        try:
            write(writer, pictures())
        except OutputError:
            writer.abandon()
            raise

    def full(self, *args, **kwargs):
        if self.name == "metadata.yaml" and args == ("w",):
            original(self, "w").close()
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return original(self, *args, **kwargs)

    write_bag()
    before = {path.name: path.read_bytes() for path in (tmp_path / "images.ros2").iterdir()}
    original = Path.open
    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(OutputError, match="No space left"):
        write_bag()
    after = {path.name: path.read_bytes() for path in (tmp_path / "images.ros2").iterdir()}
    assert after == before and [path.name for path in tmp_path.iterdir()] == ["images.ros2"]


def test_what_a_bag_cannot_say(tmp_path):
    pytest.importorskip("rosbags")
    writer = BagWriter(tmp_path / "a.bag", "/image", "cam0")
    with pytest.raises(RecordingError, match="ROS counts from 0"):
        writer.write(pictures()[0], -1)
    for topic in ("", "/", "a b", "/cam0//image", "9a", "/caméra", "/a~b", "/~"):
        with pytest.raises(ValueError, match="topic is"):
            check_topic(topic)
    for topic in ("/cam0/image_raw", "image", "~/image"):
        check_topic(topic)


def test_a_folder_of_something_else_is_not_replaced(tmp_path):
    (tmp_path / "images.ros2").mkdir()
    (tmp_path / "images.ros2" / "thesis.txt").write_text("of two years")
    with pytest.raises(OutputError, match=r"thesis\.txt, which this program did not write"):
        check_output(tmp_path / "images.ros2", overwrite=True)
    (tmp_path / "a.h5").mkdir()
    with pytest.raises(OutputError, match="a.h5 is a folder"):
        check_output(tmp_path / "a.h5", overwrite=True)


def test_a_folder_at_times_says_index_time_and_events_and_goes_on(tmp_path):
    for in_nanoseconds in (False, True):
        out = tmp_path / f"out{in_nanoseconds}"
        writer = FolderWriter(out, True, in_nanoseconds)
        for number in range(4):  # two more than will be kept
            writer.write(pictures()[number], TIMES[number] + number, 0)
        writer.abandon()
        writer = FolderWriter(out, True, in_nanoseconds)
        writer.keep(2)
        for number in (2, 3, 4):
            writer.write(pictures()[number], TIMES[number], number)
        writer.finish()
        lines = (out / "timestamps.txt").read_text().splitlines()
        assert lines[0] == "# index time_us events"
        assert [line.split() for line in lines[1:]] == [
            [str(k), str(TIMES[k] + (k if k < 2 else 0)), str(k if k > 1 else 0)] for k in range(5)
        ]
        names = sorted(path.stem for path in out.glob("*.png"))
        if in_nanoseconds:
            assert names == [f"{1000 * int(line.split()[1]):019d}" for line in lines[1:]]
            # as Kalibr's and e2calib's makers of bags read them
            stamps = [10**9 * int(name[:-9]) + int(name[-9:]) for name in names]
            assert stamps == [1000 * int(line.split()[1]) for line in lines[1:]]
        else:
            assert names == [f"frame_{k:010d}" for k in range(5)]
        check_output(out, overwrite=True)


def test_frames_of_a_written_bag_are_no_recording(tmp_path):
    """It holds no events: what reads recordings says so."""
    pytest.importorskip("rosbags")
    write(BagWriter(tmp_path / "a.bag", "/image", "cam0"), pictures())
    with pytest.raises(ValueError, match="holds no topic of events"):
        open_recording(tmp_path / "a.bag")
