"""Live events -> live pictures on a local web page."""

import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import urlsplit

import tyro

from firenet_jax.checkpoint import load_weights
from firenet_jax.errors import RecordingError, SettingsError
from firenet_jax.events import Events, counted
from firenet_jax.filters import read_hot_pixels, rotated
from firenet_jax.live import sources
from firenet_jax.live.engine import Figures, Limits, pictures, without_hot_pixels
from firenet_jax.live.page import Board, serve
from firenet_jax.pictures import Display
from firenet_jax.readers import open_recording
from firenet_jax.settings import check_none_idle, check_sizes, parse_size
from firenet_jax.storage.screen import Screen
from firenet_jax.windows import DEFAULT_LONGEST, USUAL_DENSITY, Windows


@dataclass(frozen=True)
class Live:
    """Watch a camera, a stream of events, or a recording as if it came from a camera.

    Prints the address of a local web page with the events, the reconstruction, the event rate and
    the latency. If more events arrive than this machine can process, whole windows are dropped and
    counted.

    Examples:
      firenet live recording.aedat4 --replay
      firenet live camera --hot-pixels auto
      firenet live udp://127.0.0.1:3333 --sensor-size 640x480
      my_program | firenet live - --sensor-size 240x180 --wire text
    """

    source: tyro.conf.Positional[str]
    """camera; udp://HOST:PORT to listen on; tcp://HOST:PORT to connect to; - for standard input; a
    file that another program writes; or with --replay a recording of any format."""
    replay: bool = False
    """Play a recording in real time."""
    speed: float = 1.0
    """With --replay: playback speed, 2 is twice as fast."""
    repeat: int = 1
    """With --replay: how often to play it."""
    weights: Annotated[str | None, tyro.conf.arg(aliases=["-c"])] = None
    """Weights of `firenet train` or a PyTorch checkpoint (default: built-in)."""
    sensor_size: str | None = None
    """WIDTHxHEIGHT of the sensor, which streams do not state."""
    wire: Literal["t64_x16_y16_on8", "t32_x16_y15_on1", "text"] = "t64_x16_y16_on8"
    """Wire format of a stream: 13 or 8 bytes per event (both as faery sends them), or a line of
    text."""
    events_per_pixel: float = USUAL_DENSITY
    """Events per window and pixel of the sensor."""
    longest: float = DEFAULT_LONGEST
    """Longest duration of a window in milliseconds."""
    behind: int = 2
    """How many windows may wait; if there are more, the oldest is dropped."""
    hot_pixels: str | None = None
    """Ignore these pixels: a file of `x,y` lines, or `auto` to find them among the events that have
    come so far."""
    flip: bool = False
    """Rotate the picture by 180 degrees."""
    port: int = 8765
    """Port of the page, on 127.0.0.1; 0: any free port."""
    show: bool = False
    """Also open a window."""
    seconds: float | None = None
    """End after this many seconds."""
    display: Display = Display()

    def __post_init__(self):
        check_sizes(self, "speed", "repeat", "behind", "seconds")
        if not 1e-6 <= self.speed <= 1e6:
            raise SettingsError(f"speed is {self.speed:g}, but is a millionth to a million times")
        if not 0 <= self.port < 2**16:
            raise SettingsError(f"port is {self.port}, but ports are 0 to 65535")
        Windows(events_per_pixel=self.events_per_pixel, longest=self.longest)  # checks them
        camera = not self.replay and self.source == "camera"
        idle = ["wire"] if self.replay else ["speed", "repeat"]
        idle += ["wire", "sensor_size"] if camera else []
        where = "replay" if self.replay else "camera" if camera else "stream (without --replay)"
        check_none_idle(self, idle, f"a {where}")


def source_of(settings: Live) -> sources.Source:
    """Raises RecordingError, or ValueError, in one sentence, for what is no source."""
    if settings.replay:
        recording = open_recording(Path(settings.source), parse_size(settings.sensor_size))
        arrivals = sources.replay(recording, settings.speed, settings.repeat)
        return sources.Source(recording.path.name, recording.height, recording.width, arrivals)
    if settings.source == "camera":
        return sources.camera()
    if settings.sensor_size is None:
        raise SettingsError(
            f"{settings.source}: a stream does not say how large the sensor is: pass --sensor-size "
            "WIDTHxHEIGHT, or --replay where this is a recording"
        )
    pieces, datagrams = _pieces(settings.source)
    arrivals = sources.decoded(pieces, settings.wire, datagrams)
    return sources.Source(settings.source, *parse_size(settings.sensor_size), arrivals)


def _pieces(source: str):
    if source == "-":
        return sources.standard_input(), False
    scheme = source.partition("://")[0].lower()
    if scheme in ("udp", "tcp"):
        try:
            address = urlsplit(source)
            host, port = address.hostname, address.port
        except ValueError:
            host = port = None
        if not host or not port:
            raise SettingsError(f"{source}: expected {scheme}://HOST:PORT")
        reach = sources.udp if scheme == "udp" else sources.tcp
        return reach(host, port), scheme == "udp"
    if Path(source).is_fifo():
        raise RecordingError(f"{source}: is a pipe: read it by firenet live - < {source}")
    if not Path(source).is_file():
        raise RecordingError(
            f"{source}: no such file, and no source: camera, udp://HOST:PORT, tcp://HOST:PORT, - "
            "(standard input), a file that is being written, or --replay RECORDING"
        )
    return sources.growing(Path(source)), False


def prepared(settings: Live, height: int, width: int) -> Callable:
    """Arrivals -> arrivals without hot pixels, rotated, as the settings say."""
    learn = settings.hot_pixels in (None, "auto")
    hot = None if learn else read_hot_pixels(str(settings.hot_pixels), height, width)

    def prepare(arrivals: Iterator[Events]) -> Iterator[Events]:
        if settings.hot_pixels is not None:
            arrivals = without_hot_pixels(arrivals, height, width, hot)
        return rotated(arrivals, height, width) if settings.flip else arrivals

    return prepare


def run(settings: Live) -> None:
    """Until the source ends, `seconds` are over or Ctrl-C; then says what was seen."""
    source = source_of(settings)
    prepare = prepared(settings, source.height, source.width)
    weights = load_weights(settings.weights)
    figures, board = Figures(), Board()
    screen = Screen() if settings.show else None
    try:
        server = serve(board, figures.summary, source.name, settings.port)
    except OSError as error:
        raise SettingsError(
            f"port {settings.port} cannot be used ({error}): pass another --port, or --port 0"
        ) from error
    address = f"http://127.0.0.1:{server.server_address[1]}/"
    size = f"{source.width}x{source.height}"
    print(f"{source.name}, {size}: open {address} to watch, Ctrl-C ends", flush=True)
    count = Windows(events_per_pixel=settings.events_per_pixel).count(source.height * source.width)
    begun = time.monotonic()
    if settings.seconds is not None:
        source = source._replace(arrivals=_first(settings.seconds, source.arrivals))
    speed = settings.speed if settings.replay else 1.0
    limits = Limits(count, round(1000 * settings.longest), settings.behind, speed)
    shown = pictures(source, weights, limits, figures, settings.display, prepare)
    try:
        for picture in shown:
            board.hang(picture)
            if screen is not None:
                screen.show(picture, source.name)
            _say(figures)
    except KeyboardInterrupt:
        pass
    except RecordingError:  # such as of a connection that broke
        if figures.shown:
            _conclude(figures, time.monotonic() - begun)
        raise
    finally:
        shown.close()
        board.end()
        if screen is not None:
            screen.close()
        server.shutdown()
        server.server_close()
    _conclude(figures, time.monotonic() - begun)


def _conclude(figures: Figures, seconds: float) -> None:
    found = figures.summary()
    if sys.stderr.isatty():
        print(file=sys.stderr)
    print(
        f"{counted(found['windows'], 'picture')} of {counted(found['events'], 'event')} in "
        f"{seconds:.1f} s, {found['dropped_windows']:,} windows dropped, "
        f"{found['bad_events']:,} events left out"
        + (
            f"; latency {found['latency_ms']} ms, 95 % below {found['latency_95_ms']} ms"
            if found["windows"]
            else ""
        )
    )


def _first(seconds: float, arrivals: Iterator[Events]) -> Iterator[Events]:
    """What comes in so long, from when it is asked for: what is compiled before does not count."""
    begun = time.monotonic()
    for events in arrivals:
        yield events  # those too that were taken in time, but read after it
        if time.monotonic() - begun >= seconds:
            return


def _say(figures: Figures) -> None:
    """On a terminal, a line that is written over."""
    if sys.stderr.isatty() and figures.shown % 25 == 0:
        print(f"\r{json.dumps(figures.summary())}", end="", file=sys.stderr, flush=True)
