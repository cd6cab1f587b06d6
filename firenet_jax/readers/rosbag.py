"""ROS bag -> Source, through rosbags (no ROS needed): ROS 1 .bag, ROS 2 folder, .mcap or .db3.

    dvs_msgs/EventArray             header, height, width, events (x, y, time, polarity)
    prophesee_event_msgs/EventArray the same
    event_camera_msgs/EventPacket   header, height, width, seq, time_base, encoding, is_bigendian,
    (once event_array_msgs/EventArray)   events: bytes, of which these encodings are read:
        evt3    16-bit words (evt3.py), edges at trigger inputs among them
        libcaer, libcaer_cmp    iniVation's cameras (libcaer.py)
        mono    64 bits: nanoseconds after time_base (bits 0-31), x (32-47), y (48-62), polarity
    sensor_msgs/Image               frames: mono8, rgb8, bgr8, mono16

Where a folder's metadata.yaml does not name the storage, its .mcap and .db3 files are opened one by
one.

Times are microseconds of the ROS clock. EventPackets carry the sensor's own clock: the first event
is put at the time in its message's header, so events and frames agree up to the transport's delay.
Messages are decoded from their bytes: ROS 1 packs fields, ROS 2 (CDR) aligns each to its size.
"""

import contextlib
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from itertools import chain, takewhile
from os.path import commonprefix
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from firenet_jax.errors import RecordingError, logger
from firenet_jax.events import Events, Frames, Rows
from firenet_jax.readers import (
    Source,
    all_triggers,
    evt3,
    extra,
    joined,
    libcaer,
    reading,
    to_chunks,
    to_frame,
    torn_bag,
    torn_mcap,
)

ARRAYS = ("dvs_msgs/msg/EventArray", "prophesee_event_msgs/msg/EventArray")
PACKETS = ("event_camera_msgs/msg/EventPacket", "event_array_msgs/msg/EventArray")
IMAGE = "sensor_msgs/msg/Image"
WORDS = 1 << 18  # words of 16 bits decoded at once: messages are tiny
WORD = {"evt3": 2, "libcaer_cmp": 2, "mono": 8}  # bytes of a word of an encoding
PAUSE = 5_000_000  # microseconds between two messages: EVT3's clock may have wrapped around
# Readers of files whose index is missing or damaged.
TORN = {".bag": torn_bag.Torn, ".mcap": torn_mcap.Torn}
ORDERS: dict[str, Literal["little", "big"]] = {"<": "little", ">": "big"}
CHANNELS = {"mono8": 1, "8UC1": 1, "mono16": 1, "16UC1": 1, "rgb8": 3, "bgr8": 3}


def matches(path: Path) -> bool:
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return path.suffix.lower() in (".bag", ".mcap", ".db3")


def read(path: Path) -> Source:
    ros2 = not _is_ros1(path)
    with reading(path, Exception), _bag(path) as bag:
        topics = {entry.topic: entry.msgtype for entry in bag.connections}
        topic = _only(path, [t for t, kind in topics.items() if kind in ARRAYS + PACKETS], topics)
        first = next((raw for _, raw in _raw(bag, topic)), None)
        size = None if first is None else _size(_Message(first, ros2))
        grey = False
        if first is not None and topics[topic] in PACKETS:
            grey = _packet(_Message(first, ros2)).encoding == "evt3"  # Prophesee: monochrome
        images = [t for t, kind in topics.items() if kind == IMAGE]
        frames = _frames(path, bag, _own_images(path, bag, images, topic))
    return Source(
        "ROS 2 bag" if ros2 else "ROS 1 bag",
        lambda: joined(_events(path, topic, topics[topic] in ARRAYS)),
        size,
        frames=frames,
        triggers=lambda: all_triggers(() if topics[topic] in ARRAYS else _triggers(path, topic)),
        grey=grey,
    )


def _own_images(path: Path, bag: Any, images: list[str], topic: str) -> str | None:
    """Of the topics of images the one whose name begins as that of the events does (/dvs/events,
    /dvs/image_raw), among those whose pictures can be read: not depth, say."""
    if len(images) > 1:
        images = [name for name in images if _encoding(path, bag, name) in CHANNELS] or images
    alike = {name: len(commonprefix([name, topic])) for name in images}
    found = max(images, key=alike.__getitem__, default=None)
    if found is not None and alike[found] <= 1 and "/" in found[1:] and "/" in topic[1:]:
        logger.warning(
            "%s: frames are those of %s, which may be another camera than that of %s",
            path, _in_a_line(found), _in_a_line(topic),
        )  # fmt: skip
    return found


def _encoding(path: Path, bag: Any, topic: str) -> str:
    """That of a topic's first image; "" where there is none to be read."""
    with contextlib.suppress(Exception):  # damaged bytes raise every kind
        for _, raw in _raw(bag, topic):
            message = _Message(raw, not _is_ros1(path))
            message.header()
            return _picture_head(message)[2]
    return ""


def _is_ros1(path: Path) -> bool:
    return path.suffix.lower() == ".bag" and path.is_file()


@contextmanager
def _bag(path: Path):
    """The bag; one that cannot be opened is read without its index, as far as it goes."""
    with contextlib.ExitStack() as stack:
        yield _opened(path, stack)


def _opened(path: Path, stack: contextlib.ExitStack):
    """A reader, whose files are open until `stack` is closed."""
    library = extra("rosbags.rosbag1" if _is_ros1(path) else "rosbags.rosbag2", path)
    try:
        return stack.enter_context(library.Reader(path))
    except Exception:  # damaged bytes raise every kind
        bag = None
        if path.is_dir():
            if files := _files(path):
                bag = _Files([_opened(file, stack) for file in files])
        elif path.suffix.lower() in TORN:
            found = path.stat()
            bag = _torn(path, found.st_size, found.st_mtime_ns)
        if bag is None or not bag.connections:
            raise
        return bag


@lru_cache(maxsize=4)
def _torn(path: Path, size: int, changed: int) -> torn_bag.Torn:
    """Kept, as a first look goes through the whole file, and each frame opens it."""
    return TORN[path.suffix.lower()](path)


def _files(path: Path) -> list[Path]:
    """The files that a folder's metadata.yaml names, in its order, or all if it names none; no file
    if one is missing."""
    text = (path / "metadata.yaml").read_bytes().decode("utf-8", "replace")
    listed = re.findall(r"(?m)(?:^\s*-|\bpath:)\s+(['\"]?)(.+?\.(?:mcap|db3))\1\s*$", text)
    names = dict.fromkeys(name.rpartition("/")[2] for _, name in listed)
    files = [path / name for name in names] or sorted(
        file for file in path.iterdir() if file.suffix in (".mcap", ".db3")
    )
    return files if all(file.is_file() for file in files) else []


class _Files:
    """Several files, one after the other, as one bag."""

    def __init__(self, bags: list):
        self.bags = bags

    @property
    def connections(self) -> list:
        return [connection for bag in self.bags for connection in bag.connections]

    def messages(self, connections, start: int | None = None) -> Iterator[tuple]:
        topics = {connection.topic for connection in connections}
        for bag in self.bags:
            if own := [entry for entry in bag.connections if entry.topic in topics]:
                yield from bag.messages(own, start)


def _only(path: Path, found: list[str], topics: dict[str, str]) -> str:
    """The first of the topics with events; a warning says so if there are several. topics: of all
    kinds, name to type, for the error if there is none."""
    if not found:
        listed = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(topics.items()))
        raise RecordingError(
            f"{path}: holds no topic of events ({', '.join((*ARRAYS, *PACKETS))}), but "
            f"{_in_a_line(listed) or 'nothing'}"
        )
    if len(found) > 1:
        logger.warning("%s: topics %s hold events; reading %s", path, ", ".join(found), found[0])
    return found[0]


def _in_a_line(text: str) -> str:
    """Replaces what cannot be printed: in a damaged name there may be line breaks."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def _raw(bag: Any, topic: str, start: int | None = None) -> Iterator[tuple[int, bytes]]:
    """(time of recording, bytes) of every message of a topic"""
    connections = [entry for entry in bag.connections if entry.topic == topic]
    for _, time, raw in bag.messages(connections, start):
        yield time, raw


class _Message:
    """The fields of a serialised message, in their order."""

    def __init__(self, raw: bytes, ros2: bool):
        self.raw, self.ros2 = raw, ros2
        self.at = self.start = 4 if self.ros2 else 0  # CDR's header, with the byte order
        self.order = ">" if self.ros2 and raw[1] == 0 else "<"

    def number(self, size: int) -> int:
        """The next unsigned integer, of so many bytes."""
        if self.ros2:
            self.at += -(self.at - self.start) % size
        return int.from_bytes(self._next(size), ORDERS[self.order])

    def _next(self, size: int) -> bytes:
        self.at += size
        if self.at > len(self.raw):
            raise ValueError("a message ends too early")
        return self.raw[self.at - size : self.at]

    def bytes(self) -> bytes:
        return self._next(self.number(4))

    def text(self) -> str:
        return bytes(self.bytes()).rstrip(b"\0").decode()

    def header(self) -> int:
        """-> time in microseconds"""
        if not self.ros2:
            self.number(4)  # a count of messages
        seconds, nanoseconds = self.number(4), self.number(4)
        self.text()  # name of the coordinate frame
        return _microseconds(seconds, nanoseconds)


def _microseconds(seconds, nanoseconds):
    return seconds * 1_000_000 + (nanoseconds + 500) // 1000


def _size(message: _Message) -> tuple[int, int]:
    """(height, width)"""
    message.header()
    return message.number(4), message.number(4)


def _events(path: Path, topic: str, arrays: bool) -> Iterator[Events | Rows]:
    ros2 = not _is_ros1(path)
    with reading(path, Exception), _bag(path) as bag:
        messages = (_Message(raw, ros2) for raw in _placed(path, _raw(bag, topic)))
        columns = _array_columns(messages) if arrays else _packet_columns(path, messages)
        yield from to_chunks(path, columns)


def _placed(path: Path, messages: Iterator[tuple[int, bytes]]) -> Iterator[bytes]:
    """The bytes of messages. `storage.progress` follows the positions of open files, but SQLite
    leaves none that tells how much it has read: a file handle of our own moves in its stead."""
    files = _files(path) if path.is_dir() else [path]  # none of a bag that is compressed as a whole
    largest = max(files, key=lambda file: file.stat().st_size, default=path)
    if largest.suffix.lower() != ".db3" or largest.is_dir():
        yield from (raw for _, raw in messages)
        return
    with open(largest, "rb", buffering=0) as handle:
        for _, raw in messages:
            handle.seek(min(handle.tell() + len(raw), largest.stat().st_size))
            yield raw


def _array_columns(messages: Iterator[_Message]) -> Iterator[tuple[np.ndarray, ...]]:
    for message in messages:
        message.header()
        _, _, count = message.number(4), message.number(4), message.number(4)
        if not count:
            continue
        data, offsets, size = message.raw[message.at :], (0, 2, 4, 8, 12), 13
        if message.ros2:
            # x and y are aligned to 2, the time to 4: two bytes of padding lie before the time of
            # every event but the first, and one after the polarity of every event but the last.
            data, offsets, size = b"%b\0\0%b\0" % (data[:4], data[4:]), (0, 2, 6, 10, 14), 16
        formats = [message.order + kind for kind in ("u2", "u2", "u4", "u4", "u1")]
        event = np.dtype(
            {"names": list("xysnp"), "formats": formats, "offsets": offsets, "itemsize": size}
        )
        events = np.frombuffer(data, event, count)
        t = _microseconds(events["s"].astype(np.int64), events["n"].astype(np.int64))
        yield t, events["x"], events["y"], events["p"]


class _Packet(NamedTuple):
    stamp: int  # microseconds
    time_base: int  # nanoseconds
    encoding: str
    words: str  # byte order of the payload's words, as numpy writes it
    payload: bytes


def _packet(message: _Message) -> _Packet:
    """Raises ValueError for one that its decoder would not take, for many are decoded at once."""
    stamp = message.header()
    _, _, _, time_base = (message.number(size) for size in (4, 4, 8, 8))
    encoding, is_big = message.text(), message.number(1)
    payload = message.bytes()
    if len(payload) % WORD.get(encoding, 1):
        raise ValueError(f"a message of {len(payload)} bytes, which are no whole words")
    if encoding == "libcaer_cmp":
        _to_microseconds(time_base)
    return _Packet(stamp, time_base, encoding, ">" if is_big else "<", payload)


def _packet_columns(path: Path, messages: Iterator[_Message]) -> Iterator[tuple[np.ndarray, ...]]:
    packets = map(_packet, messages)
    first = next(packets, None)
    if first is None:
        return
    if first.encoding not in DECODERS:
        raise RecordingError(
            f"{path}: its events are encoded as {_in_a_line(first.encoding)}, expected "
            f"{' or '.join(DECODERS)}: convert the bag to one of them"
        )
    shift = None
    packets = chain([first], _alike(packets, first.encoding))
    for stamp, (t, x, y, p) in DECODERS[first.encoding](packets):
        if len(t):
            if shift is None:
                shift = stamp - int(t[0])
            yield t + shift, x, y, p


def _alike(packets: Iterator[_Packet], encoding: str) -> Iterator[_Packet]:
    for packet in packets:
        if packet.encoding != encoding:
            found = _in_a_line(packet.encoding)
            raise ValueError(f"a message encoded as {found} among others of {encoding}")
        yield packet


def _mono(packets: Iterator[_Packet]) -> Iterator[tuple[int, tuple[np.ndarray, ...]]]:
    for packet in packets:
        words = np.frombuffer(packet.payload, packet.words + "u8")
        t = (packet.time_base + (words & 0xFFFFFFFF).astype(np.int64) + 500) // 1000
        yield packet.stamp, (t, words >> 32 & 0xFFFF, words >> 48 & 0x7FFF, words >> 63)


class _Evt3:
    """Words of packets -> columns. After a pause that the stamps tell, as where a recorder was
    stopped, it makes up for the turns of the sensor's clock in between: 16.8 s, 24 bits, each."""

    def __init__(self, decode: Callable = evt3.decode):
        self.decode = decode
        self.shift: int | None = None  # microseconds from the sensor's clock to that of the stamps
        self.last = 0  # stamp
        self.ahead = evt3.State()  # of events, up to the first

    def __call__(self, state: evt3.State, some: list[_Packet]):
        payload = b"".join(packet.payload for packet in some)
        words = np.frombuffer(payload, some[-1].words + "u2").astype(np.uint16)
        if self.shift is None:
            self.ahead, (t, *_) = evt3.decode(self.ahead, words)
            self.shift = some[-1].stamp - int(t[0]) if len(t) else None
        elif some[0].stamp - self.last > PAUSE:
            t = evt3.decode(state._replace(y=0), words)[1][0]  # of any row
            if not len(t):  # the next ones will tell
                return self.decode(state, words)
            turns = round((some[0].stamp - self.shift - int(t[0])) / (1 << 24))
            high, time = state.high + (turns << 12), state.time + (turns << 24)
            state = state._replace(high=high, time=time)
        self.last = some[-1].stamp
        return self.decode(state, words)


def _evt3(packets: Iterator[_Packet]) -> Iterator[tuple[int, tuple[np.ndarray, ...]]]:
    return _many_at_once(packets, evt3.State(), _Evt3())


def _libcaer_cmp(packets: Iterator[_Packet]) -> Iterator[tuple[int, tuple[np.ndarray, ...]]]:
    def decode(state: libcaer.State, some: list[_Packet]):
        words = [np.frombuffer(packet.payload, packet.words + "u2") for packet in some]
        starts = np.cumsum([0, *map(len, words)])[:-1]
        bases = np.array([_to_microseconds(packet.time_base) for packet in some], np.int64)
        return libcaer.decode(state, np.concatenate(words).astype(np.uint16), starts, bases)

    return _many_at_once(packets, libcaer.State(), decode)


def _many_at_once(
    packets: Iterator[_Packet],
    state: Any,
    decode: Callable,
    begun: Callable = lambda columns: len(columns[0]) > 0,
) -> Iterator[tuple[int, tuple[np.ndarray, ...]]]:
    """Message by message up to the first event, whose stamp counts; then many at once, none of them
    after a pause.

    decode: (state, packets) -> (state after them, columns). begun: of columns, whether the first
    event has come."""
    waiting, size, started, damage, last = [], 0, False, None, 0
    try:
        for packet in packets:
            if waiting and packet.stamp - last > PAUSE:
                state, columns = decode(state, waiting)
                waiting, size = [], 0
                yield last, columns
            waiting.append(packet)
            last = packet.stamp
            size += len(packet.payload)
            if started and size < 2 * WORDS:
                continue
            state, columns = decode(state, waiting)
            waiting, size, started = [], 0, started or begun(columns)
            yield last, columns
    except Exception as error:  # damage, of any kind: raised below, after what precedes it
        damage = error
    if waiting:
        yield last, decode(state, waiting)[1]
    if damage is not None:
        raise damage


def _libcaer(packets: Iterator[_Packet]) -> Iterator[tuple[int, tuple[np.ndarray, ...]]]:
    for packet in packets:
        base = _to_microseconds(packet.time_base)
        yield packet.stamp, libcaer.decode_plain(packet.payload, base)


def _to_microseconds(nanoseconds: int) -> int:
    """Raises ValueError where int64 is too small, as after damage."""
    if nanoseconds >= 1 << 63:
        raise ValueError(f"a message starts at {nanoseconds} ns")
    return (nanoseconds + 500) // 1000


DECODERS = {"evt3": _evt3, "libcaer": _libcaer, "libcaer_cmp": _libcaer_cmp, "mono": _mono}


def _triggers(path: Path, topic: str) -> Iterator[tuple[np.ndarray, ...]]:
    """Edges among the words of EVT3, moved to the ROS clock as the events are."""
    clock, found = _Evt3(evt3.triggers), []
    with contextlib.suppress(Exception), _bag(path) as bag:  # events raise it
        ros2 = not _is_ros1(path)
        packets = (_packet(_Message(raw, ros2)) for _, raw in _raw(bag, topic))
        packets = takewhile(lambda packet: packet.encoding == "evt3", packets)
        edges = _many_at_once(packets, evt3.State(), clock, lambda _: clock.shift is not None)
        found.extend(columns for _, columns in edges)
    if clock.shift is not None:
        yield from ((times + clock.shift, ids, rises) for times, ids, rises in found)


def _frames(path: Path, bag, topic: str | None) -> Frames | None:
    if topic is None:
        return None
    stamps, recorded, ros2, damage = [], [], not _is_ros1(path), None
    try:
        for time, raw in _raw(bag, topic):
            message = _Message(raw, ros2)
            stamps.append(message.header())
            if not recorded and (encoding := _picture_head(message)[2]) not in CHANNELS:
                logger.warning("%s: images of %s are %s: no frames", path, topic, encoding)
                return None
            recorded.append(time)
    except Exception as error:  # damaged bytes raise every kind; a torn bag's events raise it, too
        damage = error
        if not isinstance(bag, tuple(TORN.values())):
            found = " ".join(str(error).split())
            logger.warning("%s: reads %d images of %s (%s)", path, len(recorded), topic, found)

    def read(i: int) -> np.ndarray:
        with reading(path, Exception), _bag(path) as bag:
            for _, raw in _raw(bag, topic, recorded[i]):
                message = _Message(raw, ros2)
                if message.header() == stamps[i]:
                    return _picture(path, message)
        raise RecordingError(f"{path}: frame {i + 1} of {topic} is not there any more")

    if not recorded:
        return None
    return Frames(np.array(stamps[: len(recorded)], np.int64), read, damage=damage)


def _picture_head(message: _Message) -> tuple[int, int, str]:
    """(height, width, encoding)"""
    return message.number(4), message.number(4), message.text()


def _picture(path: Path, message: _Message) -> np.ndarray:
    height, width, encoding = _picture_head(message)
    is_big, step = message.number(1), message.number(4)
    if encoding not in CHANNELS:
        raise RecordingError(
            f"{path}: a frame is {_in_a_line(encoding)}, expected one of {', '.join(CHANNELS)}"
        )
    kind = np.dtype((">" if is_big else "<") + ("u2" if "16" in encoding else "u1"))
    rows = np.frombuffer(message.bytes(), np.uint8).reshape(height, step)
    rows = rows[:, : width * CHANNELS[encoding] * kind.itemsize].copy().view(kind)
    picture = rows.reshape(height, width, CHANNELS[encoding]).astype(kind.newbyteorder("="))
    return to_frame(picture[..., ::-1] if encoding == "bgr8" else picture, path)
