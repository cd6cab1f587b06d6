"""A camera, a stream, a growing file, a recording -> events as they arrive.

A source is an iterator of `Events` that never blocks for long: where nothing comes for a while it
yields empty ones, so that whoever listens can act on time. Bytes are decoded by a wire format:

    t64_x16_y16_on8   13 bytes an event: t u64 microseconds, x u16, y u16, polarity u8
    t32_x16_y15_on1   8 bytes: t u32 microseconds (wraps round), x u16, (y << 1 | polarity) u16
    text              a line: t x y p; t in microseconds, but in seconds from the first one on that
                      has a decimal point or an exponent

All little-endian. The binary ones are those that faery sends and receives over UDP, so its
converters and camera programs can feed this one; text is what everything can write.
"""

import contextlib
import importlib
import io
import os
import select
import socket
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np

from firenet_jax.errors import RecordingError, logger
from firenet_jax.events import Events, Recording
from firenet_jax.readers import text
from firenet_jax.windows import MAX_GAP

TICK = 0.005  # seconds between two looks at a source that has nothing
SLICE = 0.002  # seconds of a replay that arrive together
PIECE = 2**16  # bytes read at once; no datagram is larger
BINARY = {
    "t64_x16_y16_on8": np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "u1")]),
    "t32_x16_y15_on1": np.dtype([("t", "<u4"), ("x", "<u2"), ("y_on", "<u2")]),
}
FRACTION = b".", b"e", b"E"  # of which a number of seconds has one
NO_EVENTS = Events.empty()


class Source(NamedTuple):
    """Where events come from."""

    name: str  # for people
    height: int
    width: int
    arrivals: Iterator[Events]


# ---- Recordings, played


def replay(
    recording: Recording,
    speed: float = 1.0,
    repeat: int = 1,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[Events]:
    """A recording's events when they would have come, `speed` times as fast, `repeat` times.

    Times go on from one round to the next. Where this machine reads more slowly than that, events
    come as fast as they can be read. A pause, as of a clock that was set while it recorded,
    lasts no longer than an hour.
    """
    begun, first, latest, shift, last = clock(), None, None, 0, None
    part = max(1, round(1e6 * SLICE * speed))  # microseconds of the recording in a slice
    for _ in range(repeat):
        beginning = True
        for chunk in recording.events():
            first = int(chunk.t[0]) if first is None else first
            if beginning and last is not None:
                shift = last + part - int(chunk.t[0])
            beginning = False
            t = chunk.t + shift
            latest = int(t[0]) if latest is None else latest
            stops = np.flatnonzero(np.diff((t - t[0]) // part)) + 1
            start = 0
            for stop in (*stops.tolist(), len(t)):
                begun -= max(int(t[start]) - latest - MAX_GAP, 0) / 1e6 / speed
                due, latest = begun + (int(t[stop - 1]) - first) / 1e6 / speed, int(t[stop - 1])
                while (wait := due - clock()) > 0:
                    sleep(min(wait, TICK))
                    if wait > TICK:
                        yield NO_EVENTS
                yield Events(t[start:stop], *(c[start:stop] for c in (chunk.x, chunk.y, chunk.p)))
                start = stop
            last = int(t[-1])


# ---- Bytes


def udp(host: str, port: int) -> Iterator[bytes]:
    """Datagrams that come to this address from now on, each of whole events."""
    name = f"udp://{_in_address(host)}:{port}"
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listening = socket.socket(family, socket.SOCK_DGRAM)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**22)
        listening.bind((host, port))
    except (OSError, ValueError) as error:  # ValueError: no name of a host
        listening.close()
        raise RecordingError(f"{name}: cannot listen there ({error})") from error
    return _pieces(listening, name)


def tcp(host: str, port: int) -> Iterator[bytes]:
    """What the program that listens at this address sends, until it ends."""
    name = f"tcp://{_in_address(host)}:{port}"
    try:
        connection = socket.create_connection((host, port), timeout=10)
    except (OSError, ValueError) as error:  # ValueError: no name of a host
        raise RecordingError(
            f"{name}: {error}; start the program that sends events there first"
        ) from error
    return _pieces(connection, name)


def _pieces(connection: socket.socket, name: str) -> Iterator[bytes]:
    """What comes, until its end, which datagrams do not have; nothing (b"") after each TICK."""
    with connection:
        connection.settimeout(TICK)
        while True:
            try:
                piece = connection.recv(PIECE)
            except TimeoutError:
                yield b""
                continue
            except OSError as error:
                raise RecordingError(
                    f"{name}: the connection broke ({error}): start the program there again, and "
                    "then this one"
                ) from error
            if not piece and connection.type == socket.SOCK_STREAM:
                return
            yield piece


def _in_address(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def standard_input() -> Iterator[bytes]:
    """What is piped into this program, until its end."""
    pipe = cast(io.BufferedReader, sys.stdin.buffer)
    poll = None
    if hasattr(select, "poll"):  # not on Windows: pipes cannot be asked there, so this may wait
        poll = select.poll()
        poll.register(pipe.fileno(), select.POLLIN)
    while True:
        if poll is not None and not poll.poll(1000 * TICK):
            yield b""
        elif piece := pipe.read1(PIECE):
            yield piece
        else:
            return


def growing(path: Path) -> Iterator[bytes]:
    """A file that another program writes: what it holds, then what is added, without end."""
    with path.open("rb") as file:
        while True:
            piece = file.read(PIECE)
            if not piece:
                mine = os.fstat(file.fileno())
                if mine.st_size < file.tell() or not _is_still(path, mine):
                    raise RecordingError(f"{path}: was begun anew by its writer: start again")
                time.sleep(TICK)
            yield piece


def _is_still(path: Path, file: os.stat_result) -> bool:
    """Whether the path leads to this file, and not to a new one; one that is gone may come."""
    try:
        return os.path.samestat(path.stat(), file)
    except OSError:
        return True


# ---- Bytes to events


def decoded(pieces: Iterable[bytes], wire: str, datagrams: bool = False) -> Iterator[Events]:
    """Pieces of a stream, cut anywhere -> Events, an empty one for each piece without any.

    datagrams: each piece is of whole events, and what is left over of one is none.
    Raises RecordingError for text that is no events.
    """
    decode = _Text() if wire == "text" else _Binary(BINARY[wire])
    rest = b""
    for piece in pieces:
        if piece and datagrams and wire == "text":
            piece += b"\n"  # the last line of a datagram may lack its end
        events, rest = decode(rest + piece) if piece else (NO_EVENTS, rest)
        rest = b"" if datagrams else rest
        if len(rest) > PIECE:
            raise RecordingError(
                f"the stream holds a line of more than {PIECE} bytes where lines of t x y p were "
                f"expected: is --wire right? It may be {', '.join(BINARY)}"
            )
        yield events
    if isinstance(decode, _Text):
        if rest:  # so may that of a stream
            yield decode(rest + b"\n")[0]
        if not decode.whole and decode.refused:
            raise decode.refused


class _Binary:
    """Remembers how often a clock of 32 bits has wrapped round."""

    def __init__(self, kind: np.dtype):
        self.kind, self.turns, self.last = kind, 0, None

    def __call__(self, data: bytes) -> tuple[Events, bytes]:
        size = self.kind.itemsize
        whole = len(data) // size * size
        rows = np.frombuffer(data[:whole], self.kind)
        if "on" in (self.kind.names or ()):
            # A time that int64 cannot hold is nonsense, and left out as one before all others.
            t = np.where(rows["t"] < 2**62, rows["t"], 0).astype(np.int64)
            y, on = rows["y"], rows["on"] != 0
        else:
            y, on, t = rows["y_on"] >> 1, rows["y_on"] & 1 == 1, rows["t"].astype(np.int64)
            if len(t):
                steps = np.diff(t, prepend=t[0] if self.last is None else self.last)
                turns = self.turns + np.cumsum(steps < -(2**31)) - np.cumsum(steps > 2**31)
                self.turns, self.last = int(turns[-1]), int(t[-1])
                t = t + np.maximum(turns, 0) * 2**32
        # What int16 cannot hold lies outside of every sensor.
        x, y = (np.where(column < 2**15, column, -1).astype(np.int16) for column in (rows["x"], y))
        return Events(t, x, y, on), data[whole:]


class _Text:
    """Remembers that times are in seconds: of a stream's pieces some may hold whole ones alone.

    A stream may begin within a line, and a part of it may get lost: a broken line, and another one
    in each thousand, are left out."""

    def __init__(self):
        self.seconds, self.whole, self.broken = False, 0, 0
        self.refused: RecordingError | None = None  # the first broken line

    def __call__(self, data: bytes) -> tuple[Events, bytes]:
        lines, _, rest = data.rpartition(b"\n")
        rows = []
        numbers = _events(text.numbers(lines)) if lines else None
        if numbers is None or not self.seconds and any(sign in lines for sign in FRACTION):
            rows = [line.split() for line in lines.splitlines()]
            rows = [row for row in rows if len(row) not in (0, 2) and not row[0].startswith(b"#")]
            numbers = _numbers(rows)
        if rows and numbers is None:
            rows = self._without_broken(rows)
            numbers = _numbers(rows)
        if numbers is None:
            return NO_EVENTS, rest
        self.whole += len(numbers)
        self.seconds |= any(b"." in row[0] or b"e" in row[0].lower() for row in rows)
        t, x, y, p = numbers.T
        t = np.rint(1e6 * t if self.seconds else t)
        if not (np.abs(t) < 2**53).all():
            place = int(np.argmax(np.abs(t)))
            raise _refused(rows[place] if rows else lines.split()[4 * place :][:4])
        return Events(t.astype(np.int64), x.astype(np.int16), y.astype(np.int16), p > 0), rest

    def _without_broken(self, rows: list[list[bytes]]) -> list[list[bytes]]:
        """The first broken line is shown. Raises RecordingError for too many of them."""
        kept, broken = [], []
        for row in rows:
            (broken if _numbers([row]) is None else kept).append(row)
        whole = self.whole + len(kept)
        if self.broken + len(broken) > 1 + whole // 1000:
            raise _refused(broken[0])
        if not self.broken:
            self.refused = _refused(broken[0])
            logger.warning("a broken line is left out: %s", self.refused)
        self.broken += len(broken)
        return kept


def _refused(row: list[bytes]) -> RecordingError:
    shown = b" ".join(row)[:60].decode(errors="replace")
    return RecordingError(
        f"the stream holds {shown!r} where lines of t x y p were expected: is --wire right? It "
        f"may be {', '.join(BINARY)}"
    )


def _numbers(rows: list[list[bytes]]) -> np.ndarray | None:
    """Lines -> (N, 4) float64; None where one of them is no event, or there are none."""
    try:
        return _events(np.array(rows, np.float64))
    except ValueError:
        return None


def _events(numbers: np.ndarray | None) -> np.ndarray | None:
    """None if they cannot be rows of t x y p: pixels are whole, polarity is 0 or 1, or -1 or 1."""
    if numbers is None or numbers.shape[1:] != (4,):
        return None
    t, *pixels, p = np.abs(numbers).T
    pixels = np.stack(pixels)
    whole = (pixels == np.rint(pixels)).all() and (pixels < 2**15).all()
    return numbers if (t < 2**53).all() and whole and ((p == 0) | (p == 1)).all() else None


# ---- Cameras


def camera() -> Source:
    """The first camera that is plugged in, by neuromorphic_drivers (Prophesee, iniVation)."""
    try:
        drivers = importlib.import_module("neuromorphic_drivers")
    except ImportError as error:
        raise RecordingError(
            "a camera needs its drivers: pip install neuromorphic_drivers, or send its events by "
            "another program to udp://"
        ) from error
    with contextlib.ExitStack() as opened:
        try:
            device = opened.enter_context(drivers.open(iterator_timeout=TICK))
        except Exception as error:  # whatever the driver raises where there is no camera
            raise RecordingError(
                f"no camera can be opened ({error}): is one plugged in?"
            ) from error
        properties, closing = device.properties(), opened.pop_all()

    name = str(device.name().value)

    def arrivals():
        packets = iter(device)
        with closing:
            while True:
                try:
                    _, packet = next(packets)
                except Exception as error:  # whatever the driver raises where it is unplugged
                    raise RecordingError(
                        f"{name}: gives no more events ({error}): is it still plugged in?"
                    ) from error
                rows = None if packet is None else packet.polarity_events
                if rows is None or not len(rows):
                    yield NO_EVENTS
                else:
                    yield Events.of(rows["t"], rows["x"], rows["y"], rows["on"])

    return Source(name, properties.height, properties.width, arrivals())
