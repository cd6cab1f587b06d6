"""Pictures -> a bag of sensor_msgs/Image, by rosbags (no ROS needed), for Kalibr and other tools.

    name.bag     ROS 1
    name.ros2    ROS 2: a folder of metadata.yaml and an SQLite database, as `ros2 bag` has them

Pictures are mono8 or rgb8. A message has the picture's time in its header and as its time of
recording, for tools that read either; the header names the coordinate frame (frame_id), too.
"""

import contextlib
import importlib
import os
import re
import shutil
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np

from firenet_jax.errors import OutputError, RecordingError, SettingsError
from firenet_jax.storage.files import Noted, lock, locked, no_note, partial_name, writing

IMAGE, HEADER, TIME = (
    "sensor_msgs/msg/Image", "std_msgs/msg/Header", "builtin_interfaces/msg/Time",
)  # fmt: skip
TOPIC = re.compile(r"(~|~?/)?[A-Za-z]\w*(/[A-Za-z]\w*)*", re.ASCII)  # what ROS allows
OURS = re.compile(r"metadata\.yaml(\.tmp)?|.*\.db3(-journal|-wal|-shm)?")  # in a ROS 2 bag


def check_topic(topic: str) -> None:
    """Raises SettingsError for what is no name of a ROS topic."""
    if not TOPIC.fullmatch(topic):
        raise SettingsError(f"topic is {topic!r}, expected a ROS name such as /cam0/image_raw")


class BagWriter:
    """Used as `video.VideoWriter`. Raises OutputError where rosbags is not installed, the bag
    cannot be written, or another run writes it; RecordingError for a time that ROS cannot express.
    """

    def __init__(self, path: Path, topic: str, frame_id: str):
        self.path, self.partial = path, partial_name(path)
        self.topic, self.frame_id = topic, frame_id
        self.ros2, self.count = path.suffix == ".ros2", 0
        self.bag: Any = None
        self.holding = contextlib.ExitStack()
        try:
            self.library = importlib.import_module(f"rosbags.rosbag{1 + self.ros2}")
            types = importlib.import_module("rosbags.typesys")
        except ImportError as error:
            raise OutputError(
                f"{path}: writing bags needs rosbags: in the source folder, "
                'pip install ".[formats]"'
            ) from error
        stores = types.Stores
        self.types = types.get_typestore(stores.ROS2_HUMBLE if self.ros2 else stores.ROS1_NOETIC)

    def _start(self) -> Any:
        """At the first picture: SQLite serves only the thread that opened the database."""
        _remove(self.partial, self.path)  # of a run that was killed
        # Humble cannot read 9; all later ones read 8.
        choice = {"version": 8} if self.ros2 else {}
        bag = self.bag = self.library.Writer(self.partial, **choice)
        bag.open()
        if os.name != "nt":  # no locks there, and folders cannot be opened
            handle = os.open(self.partial, os.O_RDONLY)
            self.holding.callback(os.close, handle)
            lock(handle, self.path)
        self.connection = bag.add_connection(self.topic, IMAGE, typestore=self.types)
        return bag

    def write(self, picture: np.ndarray, time: int, events: int = 0) -> None:
        """picture: (H, W) or (H, W, 3) uint8; time: microseconds."""
        if not 0 <= time < 2**31 * 1_000_000:
            raise RecordingError(
                f"{self.path}: a picture is at {time / 1e6:.6f} s, but ROS counts from 0 to "
                f"{2**31} s: choose another output"
            )
        seconds, rest = divmod(time, 1_000_000)
        make, height, width = self.types.types, *picture.shape[:2]
        stamp = make[TIME](sec=seconds, nanosec=1000 * rest)
        number = {} if self.ros2 else {"seq": self.count}
        message = make[IMAGE](
            header=make[HEADER](stamp=stamp, frame_id=self.frame_id, **number),
            height=height,
            width=width,
            encoding="mono8" if picture.ndim == 2 else "rgb8",
            is_bigendian=0,
            step=picture[0].size,
            data=np.ascontiguousarray(picture).reshape(-1),
        )
        serialise = self.types.serialize_cdr if self.ros2 else self.types.serialize_ros1
        with _writing(self.path):
            bag = self.bag or self._start()
            bag.write(self.connection, 1000 * time, serialise(message, IMAGE))
        self.count += 1

    def finish(self, noted: Noted = no_note) -> None:
        with _writing(self.path):
            self.bag.close()
            if self.ros2:  # the database in it is named after the partial folder
                _rename_inside(self.partial, self.path.name)
            noted(self.partial)
            _remove(self.path, self.path)
            self.partial.rename(self.path)
            self.holding.close()

    def abandon(self) -> None:
        """Removes the partial bag."""
        if self.bag is None:
            return
        with contextlib.suppress(Exception):  # rosbags may raise any kind for an unfinished bag
            self.bag.close()
        with contextlib.suppress(OSError):
            if self.ros2:
                shutil.rmtree(self.partial)
            else:
                self.partial.unlink()
        self.holding.close()


@contextlib.contextmanager
def _writing(path: Path):
    """As `writing`; a full disk may also be an error of SQLite's own kind."""
    with writing(path):
        try:
            yield
        except sqlite3.Error as error:
            raise OSError(str(error)) from error


def _remove(place: Path, name: Path) -> None:
    """Removes a bag, if it is there; raises OutputError where another run writes it, or it is none.

    name: what the former error calls it."""
    if not place.exists():
        return
    with locked(place, name):
        if place.is_file():
            place.unlink()
            return
        if strange := strange_in(place):
            raise OutputError(
                f"{place} holds {strange}, which is not part of a bag: choose another output"
            )
        shutil.rmtree(place)


def strange_in(folder: Path) -> str | None:
    """The first of the names in a folder that no ROS 2 bag has."""
    return min((e.name for e in folder.iterdir() if not OURS.fullmatch(e.name)), default=None)


def _rename_inside(folder: Path, bag_name: str) -> None:
    """Names the database after the bag, in metadata.yaml too: rosbags named it after the folder."""
    metadata, name = folder / "metadata.yaml", f"{bag_name}.db3"
    yaml: Any = importlib.import_module("ruamel.yaml").YAML(typ="safe")  # comes with rosbags
    yaml.default_flow_style, yaml.width = False, 2**20  # else a long name may span lines
    told = yaml.load(metadata.read_text(encoding="utf-8"))
    bag = told["rosbag2_bagfile_information"]
    bag["relative_file_paths"], bag["files"][0]["path"] = [name], name
    (folder / f"{folder.name}.db3").rename(folder / name)
    with metadata.open("w", encoding="utf-8") as file:
        yaml.dump(told, file)
