"""Pictures -> files: a folder of png, mp4 or gif, never half-written under the final name.

Pictures are (H, W) or (H, W, 3) uint8. A writer works on `<name>.partial` beside its final name
and renames it in `finish`; `write_video` does all of it.
"""

import contextlib
import itertools
import os
import re
import shutil
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any, TextIO

import av
import numpy as np
from av.error import FFmpegError
from av.filter import Graph
from PIL import Image

from firenet_jax.errors import OutputError, RecordingError, logger
from firenet_jax.storage import bag
from firenet_jax.storage.files import (
    Noted,
    discard,
    locked,
    no_note,
    open_alone,
    partial_name,
    publish,
    writing,
)
from firenet_jax.storage.runs import make_folder

VIDEOS = (".mp4", ".gif")
WHOLE = (*VIDEOS, ".h5", ".bag", ".ros2")  # made in one go; all else is a folder of png
# No folder's name ends so. A dot alone, as in out_0.35, does not make a file of it.
OTHER_FILES = (
    ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv", ".png", ".apng", ".jpg",
    ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".npy", ".npz", ".h5", ".hdf5", ".zip", ".gz",
    ".txt", ".csv", ".tsv", ".json", ".raw", ".dat", ".bin", ".es", ".aedat", ".aedat4",
    ".bag", ".db3", ".mcap",
)  # fmt: skip
LIKE_A_FILE = re.compile(r"\.[A-Za-z][A-Za-z0-9]{2,4}")  # nor is any other such ending
OURS = re.compile(r"timestamps\.txt|resume[.\w]*\.npz|(frame_\d{10,}|\d{19})\.png")  # in a folder
RATES = 0.01, 10_000  # pictures per second
GIF_CLOCK = 100  # ticks per second
GIF_RATE = 50  # pictures per second: browsers show one of a single tick for ten
MP4_CLOCK = 90_000  # ticks per second, as is usual
# Ticks between two pictures. An mp4 has 31 bits for the time between a picture and one that the
# encoder puts four places before it.
LONGEST_STEP = {".mp4": 2**28, ".gif": 2**16 - 1}
# Of colours, as FFmpeg numbers them (ITU-T H.273): what its conversion from RGB makes, and sRGB.
SD_MATRIX, LIMITED, REC_709, SRGB = 6, 1, 1, 13
LONGEST_MP4_SIDE = 16_384  # pixels, of x264
USUAL_RATE = 30  # pictures per second, the encoder's nominal rate without --fps
PNG_LEVEL = 4  # on grey pictures 25 % faster than the default 6, files 2 % larger


def followed(path: Path) -> Path:
    """What a link points to, if that can be the same kind of output, for renaming to a link would
    replace the link. Raises OutputError for a link to itself."""
    if not path.is_symlink() and path.name not in ("", ".."):
        return path
    try:
        target = path.resolve()
    except (OSError, RuntimeError) as error:
        raise OutputError(f"{path}: points to itself: choose another output") from error
    folder = target.is_dir() and path.suffix not in WHOLE
    return target if target.suffix == path.suffix or folder else path


def check_rate(path: Path, fps: float) -> None:
    """Raises OutputError unless an output can show so many pictures per second."""
    if path.suffix == ".gif" and GIF_RATE < fps <= RATES[1]:
        raise OutputError(
            f"{path}: a gif shows at most {GIF_RATE} pictures per second, not {fps:g}: choose "
            "a smaller --fps or .mp4"
        )
    if not RATES[0] <= fps <= RATES[1]:
        raise OutputError(f"fps is {fps:g}, but must be between {RATES[0]:g} and {RATES[1]:g}")


def like_a_file(suffix: str) -> bool:
    """Whether names of files end so."""
    return suffix.lower() in (*WHOLE, *OTHER_FILES) or LIKE_A_FILE.fullmatch(suffix) is not None


def check_kind(path: Path) -> None:
    """Raises OutputError if this is the name of a file that is none of our outputs."""
    happens = path.is_dir() and path.suffix.lower() not in (*WHOLE, *OTHER_FILES)
    if path.suffix not in WHOLE and like_a_file(path.suffix) and not happens:
        raise OutputError(
            f"{path}: cannot write {path.suffix} files: name a folder (for png), .mp4 or .gif, or "
            "with reconstruct .h5, .bag or .ros2"
        )


def check_output(path: Path, overwrite: bool) -> None:
    """Raises OutputError if this cannot be an output, or something is there that must not or cannot
    be replaced. Makes the folder that it will be in."""
    check_kind(path)
    if path.exists() and not (path.is_file() or path.is_dir()):  # a file would take its place
        raise OutputError(f"{path} is a pipe or device: choose a name for a file or folder")
    folder = path.suffix not in WHOLE or path.suffix == ".ros2"
    if path.is_dir() and not folder:
        what = "video" if path.suffix in VIDEOS else "file"
        raise OutputError(f"{path} is a folder: choose another name for the {what}")
    if path.is_file() and folder:
        raise OutputError(f"{path} is a file: choose another name for the folder of pictures")
    occupied = path.is_file() or (path.is_dir() and any(path.iterdir()))
    if occupied and not overwrite:
        raise OutputError(f"{path} exists: choose another output or pass --overwrite")
    if path.is_dir() and os.path.ismount(path):
        raise OutputError(f"{path} is a mount point: choose a folder in it")
    if path.is_dir() and Path.cwd().is_relative_to(path.resolve()):
        raise OutputError(f"{path} is the folder that you are in: choose a folder in it")
    begun = partial_name(path)
    if folder and (strange := _strange(begun)):
        raise OutputError(
            f"{begun} holds {strange}, which is not of an earlier run: remove it or choose another "
            "output"
        )
    if occupied and path.is_dir():
        stamped = path.suffix == ".ros2" or (path / "timestamps.txt").is_file()
        strange = _strange(path) or (None if stamped else min(path.iterdir()).name)
        if strange:
            raise OutputError(
                f"{path} holds {strange}, which this program did not write: choose another output"
            )
    make_folder(path.parent)
    if not os.access(path.parent, os.W_OK):
        raise OutputError(f"{path.parent} is not writable: choose another output")


def _strange(folder: Path) -> str | None:
    """The first of the names in a folder that none of our folders of pictures (of a .ros2: no bag)
    has."""
    if folder.suffix == ".ros2":
        return bag.strange_in(folder) if folder.is_dir() else None
    names = [entry.name for entry in folder.iterdir()] if folder.is_dir() else []
    return min((name for name in names if not OURS.fullmatch(name)), default=None)


def check_free(path: Path) -> None:
    """Raises OutputError where another run is writing this output, or its name is too long."""
    try:
        begun = partial_name(path).exists()
    except OSError as error:
        raise OutputError(f"{path}: {error.strerror}: choose a shorter output") from error
    if begun:
        with locked(partial_name(path), path):
            pass


HEADER = "# index time_us events\n"


class FolderWriter:
    """Pictures -> `frame_%010d.png` and `timestamps.txt`, which can go on where it stopped.

    timestamps.txt holds one line a picture: the time of its last event in seconds; with `at_times`
    its number, its time in microseconds and the number of its events, under `HEADER`.
    in_nanoseconds, only with at_times: names the pictures by their time, `%019d.png`, as Kalibr
    takes them. Until `finish` or `abandon` no other run can write into the folder.
    Raises OutputError where the folder cannot be written, or another run writes into it.
    """

    def __init__(self, path: Path, at_times: bool = False, in_nanoseconds: bool = False):
        self.path, self.partial = path, partial_name(path)
        self.replaced = path.with_name(f"{path.name}.replaced.partial")  # no output is named so
        self.at_times, self.in_nanoseconds = at_times, in_nanoseconds
        self.count = 0
        self.stamps: TextIO | None = None
        self.holding = contextlib.ExitStack()
        with writing(path):
            self.partial.mkdir(exist_ok=True)
            self.holding.enter_context(locked(self.partial, path))
            # Of a run that was killed while it replaced a folder.
            if self.replaced.exists() and not _strange(self.replaced):
                if path.exists():
                    shutil.rmtree(self.replaced)
                else:
                    self.replaced.rename(path)

    def keep(self, done: int) -> TextIO:
        """Goes on after so many pictures of an earlier run; what lies beyond is written again."""
        self.count = done
        with writing(self.path):
            if not done:  # none goes on from where pictures are replaced
                (self.partial / "resume.npz").unlink(missing_ok=True)
            stamps = self.stamps = (self.partial / "timestamps.txt").open("a+", newline="")
            stamps.seek(0)
            kept = list(itertools.islice(stamps, done + self.at_times if done else 0))
            stamps.truncate(sum(map(len, kept)))
            if self.at_times and not kept:
                stamps.write(HEADER)
        return stamps

    def _name(self, time: int) -> str:
        return f"{1000 * time:019d}" if self.in_nanoseconds else f"frame_{self.count:010d}"

    def write(self, picture: np.ndarray, time: int, events: int = 0) -> None:
        """time: microseconds; events: how many the picture is made of.

        Raises RecordingError for a time that makes no name."""
        stamps = self.stamps or self.keep(0)
        name = self._name(time)
        if self.in_nanoseconds and time < 0:
            raise RecordingError(
                f"{self.path}: a picture at {time} us, before 0, cannot be named by its time: "
                "leave out --names nanoseconds"
            )
        with writing(self.path):
            Image.fromarray(picture).save(self.partial / f"{name}.png", compress_level=PNG_LEVEL)
            seconds, rest = divmod(abs(time), 1_000_000)
            if self.at_times:
                stamps.write(f"{self.count} {time} {events}\n")
            else:
                stamps.write(f"{'-' * (time < 0)}{seconds}.{rest:06d}\n")
        self.count += 1

    def flush(self) -> None:
        with writing(self.path):
            if self.stamps is not None:
                self.stamps.flush()

    def _names(self) -> set[str]:
        if not self.in_nanoseconds:
            return {f"frame_{number:010d}" for number in range(self.count)}
        with (self.partial / "timestamps.txt").open() as stamps:
            return {self._name(int(line.split()[1])) for line in itertools.islice(stamps, 1, None)}

    def finish(self, noted: Noted = no_note) -> None:
        with writing(self.path):
            if self.stamps is not None:
                self.stamps.close()
            mine = self._names()
            for extra in self.partial.glob("*.png"):  # of a longer run before this one
                if extra.stem not in mine:
                    extra.unlink()
            for position in self.partial.glob("resume*.npz"):
                position.unlink()
            noted(self.partial)
            replaced = self.path.exists() and any(self.path.iterdir())
            if replaced:
                self.path.rename(self.replaced)
            if os.name == "nt":  # an open folder cannot be renamed there, and has no lock
                self.holding.close()
            self.partial.rename(self.path)
            self.holding.close()
        if replaced:
            shutil.rmtree(self.replaced, ignore_errors=True)

    def abandon(self) -> None:
        """Stops writing; a partial folder with pictures stays, for the next run to go on."""
        if self.stamps is not None:
            with contextlib.suppress(OSError):
                self.stamps.close()
        left = {entry.name: entry for entry in self.partial.glob("*")}
        with contextlib.suppress(OSError):
            if not left.keys() - {"timestamps.txt"}:
                for stamps in left.values():
                    stamps.unlink()
                self.partial.rmdir()
        self.holding.close()


class VideoWriter:
    """Pictures -> mp4 (H.264) or gif, all of one size.

    With `fps` all are shown equally long; without, from their own time to that of the next, `speed`
    times as fast, but not closer to each other than the format can express, nor farther apart: of a
    longer pause the rest is left out, and a warning says so. The last stays as long as that before.
    Raises OutputError where the file cannot be written, or another run writes it.
    """

    def __init__(self, path: Path, fps: float | None, speed: float = 1.0):
        self.path, self.partial = path, partial_name(path)
        self.rate = Fraction(fps or USUAL_RATE).limit_denominator(1000)
        self.tick, self.least = 1 / self.rate, 1  # seconds; ticks between two pictures
        gif = path.suffix == ".gif"
        if fps is None:
            self.tick = Fraction(1, GIF_CLOCK if gif else MP4_CLOCK)
            self.least = 2 if gif else MP4_CLOCK // 1000
        self.speed, self.timed = speed, fps is None
        self.first = self.last = 0  # times of pictures, microseconds
        self.at = self.step = 0  # ticks, where the last picture is, and since the one before
        self.left_out = 0  # ticks of pauses
        self.count = 0
        with writing(path):
            self.held = open_alone(self.partial, path)
            # absolute, for FFmpeg takes what precedes a colon for a protocol
            # An mp4 says how long it is in ticks of a clock of its own, by default of a thousand a
            # second: what is shown after the last whole one was lost.
            clock = {} if gif else {"movie_timescale": str(MP4_CLOCK)}
            self.container = av.open(str(self.partial.absolute()), "w", options=clock)
        self.stream: Any = None
        self.waiting: list = []  # packets, until one sees how long the last picture is shown
        self.filter: Graph | None = None

    def _start(self, height: int, width: int) -> Any:
        if self.path.suffix == ".gif":
            self.stream = self.container.add_stream("gif", rate=self.rate)
            self.stream.pix_fmt = "pal8"
            self.filter = _palette_filter(height, width, self.tick)
        else:
            if max(height, width) > LONGEST_MP4_SIDE:
                raise OutputError(
                    f"{self.path}: pictures of {width}x{height} are too large for an mp4, of which "
                    f"a side has at most {LONGEST_MP4_SIDE} pixels: choose .gif or a folder"
                )
            self.stream = self.container.add_stream("libx264", rate=self.rate)
            self.stream.pix_fmt = "yuv420p"  # what every player can show
            # With its macroblock tree, x264 makes other bytes of the same pictures now and then.
            self.stream.options = {"crf": "18", "preset": "veryfast", "mbtree": "0"}
            # Unless told, players take the matrix of SD for small pictures and of HD for large.
            codec = self.stream.codec_context
            codec.colorspace, codec.color_range = SD_MATRIX, LIMITED
            codec.color_primaries, codec.color_trc = REC_709, SRGB
        self.stream.height, self.stream.width = height, width
        self.stream.codec_context.time_base = self.tick
        return self.stream

    @property
    def slower(self) -> float | None:
        """Playing time over real time; None where all pictures are of one moment."""
        played, real = float(self.at * self.tick), (self.last - self.first) / 1e6
        return played / real if played > 0 and real > 0 else None

    def write(self, picture: np.ndarray, time: int = 0, events: int = 0) -> None:
        """time: microseconds; with `fps` only `slower` uses it. events: not used."""
        if self.path.suffix == ".mp4":  # chroma at half the size wants even sides
            odd = [(0, side % 2) for side in picture.shape[:2]]
            picture = np.pad(picture, odd + [(0, 0)] * (picture.ndim - 2), mode="edge")
        stream = self.stream or self._start(*picture.shape[:2])
        if self.filter and picture.ndim == 2:  # the filter graph was made for colours
            picture = np.stack([picture] * 3, -1)
        layout = "gray" if picture.ndim == 2 else "rgb24"
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format=layout)
        self.first, self.last = (self.first if self.count else time), time
        if self.count:
            at, self.at = self.at, self._next()
            self.step = self.at - at
        frame.pts, frame.time_base = self.at, self.tick
        self.count += 1
        if self.filter:
            self.filter.vpush(frame)
            frame = self.filter.vpull()
        with self._encoding():
            self.container.mux(self.waiting)
            self.waiting = stream.encode(frame)

    def _next(self) -> int:
        """Where the picture that follows is shown, in ticks."""
        if not self.timed:
            return self.count
        since = Fraction((self.last - self.first) / self.speed / 1e6) / self.tick
        wanted = max(self.at + self.least, round(since) - self.left_out)
        latest = self.at + LONGEST_STEP[self.path.suffix]
        if wanted > latest:
            if not self.left_out:
                logger.warning(
                    "%s: pauses are cut to %.0f minutes, about the longest that a video can hold",
                    self.path, (latest - self.at) * self.tick / 60,
                )  # fmt: skip
            self.left_out += wanted - latest
        return min(wanted, latest)

    @contextlib.contextmanager
    def _encoding(self):
        """What the encoder or the disk refuses -> OutputError."""
        try:
            with writing(self.path):
                yield
        except FFmpegError as error:
            raise OutputError(
                f"{self.path}: cannot be encoded ({error}): choose another output"
            ) from error

    def finish(self, noted: Noted = no_note) -> None:
        with self._encoding():
            if self.stream is not None:
                self.waiting += self.stream.encode(None)
            for packet in self.waiting:
                # Nothing follows the last picture, nor the last packet, which may be another's.
                if self.step and (packet.pts == self.at or packet is self.waiting[-1]):
                    packet.duration = self.step
                self.container.mux(packet)
            self.container.close()
            noted(self.partial)
            publish(self.held, self.partial, self.path)

    def abandon(self) -> None:
        """Removes the partial file: a video cannot be continued."""
        with contextlib.suppress(OSError, FFmpegError):
            self.container.close()
        discard(self.held, self.partial)


def _palette_filter(height: int, width: int, tick: Fraction) -> Graph:
    """A filter graph that gives every gif picture the 256 colours that suit it best."""
    graph: Any = Graph()  # its type hints lack formats by name
    source = graph.add_buffer(width=width, height=height, format="rgb24", time_base=tick)
    split = graph.add("split")
    palette = graph.add("palettegen", "stats_mode=single")
    use = graph.add("paletteuse", "new=1:dither=none")
    sink = graph.add("buffersink")
    source.link_to(split)
    split.link_to(use, 0, 0)
    split.link_to(palette, 1, 0)
    palette.link_to(use, 0, 1)
    use.link_to(sink)
    graph.configure()
    return graph


def open_writer(
    path: Path,
    fps: float | None = None,
    speed: float = 1.0,
    at_times: bool = False,
    in_nanoseconds: bool = False,
) -> FolderWriter | VideoWriter:
    """fps, speed: of a video, as `VideoWriter` takes them; the others of a folder.

    Raises OutputError for a rate that the output cannot show, or where another run writes it."""
    if fps is not None:
        check_rate(path, fps)
    if path.suffix in VIDEOS:
        return VideoWriter(path, fps, speed)
    if path.suffix in WHOLE:
        raise OutputError(
            f"{path}: pictures go into a folder (for png), .mp4 or .gif; only reconstruct writes "
            f"{path.suffix}"
        )
    return FolderWriter(path, at_times, in_nanoseconds)


def write_video(path: str | Path, pictures: Iterable[np.ndarray], fps: float = 30) -> None:
    """Pictures (H, W) or (H, W, 3) uint8 -> .mp4, .gif, or a folder of png; replaces what is there.

    Raises OutputError for another suffix or a name that cannot be written, ValueError for no
    pictures, and for one of another kind or of another size than the first.
    """
    path, fps = followed(Path(path)), float(fps)  # of numpy's or JAX's float32, too
    check_output(path, overwrite=True)
    writer, shape = open_writer(path, fps), None
    try:
        for number, picture in enumerate(map(np.asarray, pictures)):
            shape = shape or picture.shape
            kind = picture.ndim == 2 or picture.shape[2:] == (3,)
            if not (kind and picture.size and picture.dtype == np.uint8 and picture.shape == shape):
                raise ValueError(
                    f"picture {number + 1} is {picture.dtype} of the shape {picture.shape}, "
                    "expected uint8 (H, W) or (H, W, 3), all of one size"
                )
            writer.write(picture, round(number * 1e6 / fps))
        if shape is None:
            raise ValueError(f"{path}: there are no pictures to write")
        writer.finish()
    except BaseException:
        writer.abandon()
        raise
