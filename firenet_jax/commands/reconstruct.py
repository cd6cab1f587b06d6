"""Recordings -> pictures on disk: the settings, the jobs made of them, the summary.

`jobs` does the work; `storage.resume` resumes an interrupted run.
"""

import dataclasses
import functools
import hashlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import jax
import numpy as np
import tyro

from firenet_jax import filters
from firenet_jax.checkpoint import load_weights
from firenet_jax.commands.jobs import Done, Job, Outcome, Way, Writer, do_jobs
from firenet_jax.commands.times import Times, times_of
from firenet_jax.devices import process_of
from firenet_jax.errors import OutputError, RecordingError, SettingsError, logger
from firenet_jax.events import Events, Recording, counted, rate_in_words, until_damage
from firenet_jax.instants import WARM_UP, Grid, check
from firenet_jax.network import Weights
from firenet_jax.pictures import Display
from firenet_jax.readers import check_exists, open_recording
from firenet_jax.reconstruction import Network
from firenet_jax.settings import check_none_idle, check_sizes, parse_size
from firenet_jax.storage import video
from firenet_jax.storage.arrays import ArraysWriter
from firenet_jax.storage.bag import BagWriter, check_topic
from firenet_jax.storage.files import check_apart, identity, named
from firenet_jax.storage.overlap import until_set
from firenet_jax.storage.progress import Bytes, bar
from firenet_jax.storage.resume import done_file, is_done, read_position
from firenet_jax.storage.runs import recorded
from firenet_jax.storage.screen import check_screen
from firenet_jax.windows import DEFAULT_LONGEST, Windows, in_words, usual

# Settings that are not part of a run's record: the pictures do not depend on them (on the chunk
# only in float32's last bits), or the record holds them in another form.
UNRECORDED = ("recordings", "output", "weights", "fps", "speed", "chunk", "batch", "overwrite")
UNRECORDED += ("strict", "processes", "process", "show")


@dataclass(frozen=True)
class Reconstruct:
    """Turn recordings of an event camera into video.

    Examples:
      firenet reconstruct recording.zip -o video.mp4
      firenet reconstruct recording.raw -o frames/ --duration 20
      firenet reconstruct a.aedat4 b.aedat4 -o videos.mp4       (videos/a.mp4, videos/b.mp4)
      firenet reconstruct recording.raw -o slow.mp4 --rate 3000 --speed 0.01
      firenet reconstruct recording.raw -o cam0.bag --at times.txt
    """

    recordings: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="RECORDING...", help_behavior_hint=""),
    ]
    """Text, zip, HDF5, ECD or EVREAL folder, .bin, .dat, .raw, .aedat, .aedat4, .es, ROS bag."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """A folder (png files and timestamps.txt), or a name that ends in .mp4, .gif, .h5 (float32
    images), .bag or .ros2. Several recordings: one each, in a folder of that name."""
    weights: Annotated[Path | None, tyro.conf.arg(aliases=["-c"])] = None
    """Weights: .npz, a published PyTorch checkpoint, or the folder of a training run. Default: the
    built-in weights."""
    windows: Windows = Windows()
    times: Times = Times()
    display: Display = Display()
    network: Network = Network()
    warm_up: int = WARM_UP
    """Before the first picture, run the network over this many windows of the beginning, forwards
    and then backwards in time, so that the first pictures are not grey; over fewer, if they hold
    more than 0.4 events per pixel on average. 0: start from a zero state, as in the paper."""
    preview: bool = False
    """Show the events (blue: brighter, red: darker) next to the reconstruction; of a dense window
    those of its last step."""
    show: bool = False
    """Also show the pictures in a window while they are computed; with several recordings, those
    of the first one that is not finished."""
    hot_pixels: str | None = None
    """Ignore these pixels: a file of `x,y` lines, or `auto` to find them in the recording."""
    flip: bool = False
    """Rotate the picture by 180 degrees."""
    start: float | None = None
    """Begin this many seconds after the first event."""
    stop: float | None = None
    """End this many seconds after the first event."""
    speed: float | None = None
    """Playback speed of a video: 1 is real time, 0.1 ten times slower. Default: real time, but
    slower if the recording is very short."""
    fps: float | None = None
    """Show this many pictures of a video per second, each for the same duration."""
    names: Literal["number", "nanoseconds"] = "number"
    """With --rate, --at, --between-frames or --triggers: name png files by number or by time in
    nanoseconds, as Kalibr expects."""
    topic: str = "/cam0/image_raw"
    """Topic of the images in the bag that is written."""
    frame_id: str = "cam0"
    """Coordinate frame of the images in the bag that is written."""
    sensor_size: str | None = None
    """WIDTHxHEIGHT of the sensor, such as 240x180, if the recording does not state it."""
    columns: str | None = None
    """Order of the columns in a text without a header line, such as x,y,p,t."""
    strict: bool = False
    """Refuse a damaged recording. Without this, it is read up to the damage, and up to one invalid
    row in a thousand is skipped."""
    chunk: int | None = None
    """Windows of a recording per call of the device (default: 16; on a CPU 8 for sensors of up to
    65,536 pixels, 4 for larger ones)."""
    batch: int | None = None
    """Recordings that run at the same time, shared by the devices (default: one per device)."""
    overwrite: bool = False
    """Replace an existing output."""
    processes: int | None = None
    """Number of processes, on one or more machines, that share the recordings. Default: as set by
    srun or mpirun."""
    process: int | None = None
    """Index of this process, from 0."""

    def __post_init__(self):
        if self.fps is not None:
            video.check_rate(self.output, self.fps)
            if self.speed is not None:
                raise SettingsError("fps and speed: a video has one or the other, leave one out")
        if self.speed is not None and not 1e-6 <= self.speed <= 1e6:
            raise SettingsError(f"speed is {self.speed}, but must be more than 0; 1 is real time")
        check_sizes(self, "chunk", "batch")
        if (self.chunk or 1) * (self.batch or 1) >= 2**15:  # `pack` would say it, after a minute
            raise SettingsError(
                f"chunk is {self.chunk or 1} and batch {self.batch or 1}, but fewer than 32768 "
                "windows fit at once"
            )
        if self.warm_up < 0:
            raise SettingsError(f"warm-up is {self.warm_up}, but must be 0 or more windows")
        if not self.network.recurrent and self.warm_up not in (0, WARM_UP):
            raise SettingsError(
                "--warm-up has no effect beside --no-recurrent, which remembers nothing: leave it "
                "out"
            )
        if self.network.whole_windows and (
            not self.network.recurrent or self.windows.step is not None or self.times.wanted
        ):
            raise SettingsError(
                "--whole-windows has no effect beside --no-recurrent, --step and images at given "
                "times, whose windows are whole: leave it out"
            )
        if self.network.pad < 1:
            raise SettingsError(f"pad is {self.network.pad}, but pads to a multiple of 1 or more")
        if not self.recordings:
            raise SettingsError("no recording: name one or more files or folders")
        filters.check_span(self.start, self.stop)
        process_of(self.process, self.processes)
        check_topic(self.topic)
        if self.times.wanted:
            check(self.windows)
        elif self.names == "nanoseconds":
            raise SettingsError(
                "pictures are named by their time where it is chosen: with --rate, --at, "
                "--between-frames or --triggers"
            )
        if self.names == "nanoseconds" and self.output.suffix in video.WHOLE:
            raise SettingsError(f"{self.output} holds no png files to name: leave out --names")
        shown = self.preview or self.network.color or self.display != Display()
        if self.output.suffix == ".h5" and shown:
            raise SettingsError(
                ".h5 holds images as the network gives them: leave out --preview, --color, "
                "--unsharp, --range and --bilateral"
            )
        _check_idle(self)


def _check_idle(settings: Reconstruct) -> None:
    """Raises SettingsError for what would have no effect on this kind of output."""
    suffix = settings.output.suffix
    if suffix not in video.WHOLE and video.like_a_file(suffix) and not settings.output.is_dir():
        return  # nothing can be written there, which is said later
    idle = [] if suffix in video.VIDEOS else ["fps", "speed"]
    idle += [] if suffix in (".bag", ".ros2") else ["topic", "frame_id"]
    kind = f"a {suffix}" if suffix in video.WHOLE else "a folder of pictures"
    check_none_idle(settings, idle, kind)


def run(settings: Reconstruct) -> list[Path]:
    """Reconstructs the recordings; returns the outputs of this process.

    Raises RecordingError, CheckpointError, OutputError or SettingsError."""
    weights = load_weights(settings.weights)
    if settings.show:
        check_screen()
    # Recordings are independent, so the processes do not use jax.distributed: there, a process that
    # ends or dies would stop the others.
    process, processes = process_of(settings.process, settings.processes)
    mine = slice(process, None, processes)
    planned = plan(settings.recordings, settings.output)
    lists = [settings.times.at, None if settings.hot_pixels == "auto" else settings.hot_pixels]
    for path in (*settings.recordings, *filter(None, lists)):
        check_exists(Path(path))  # a slip, not damage: before all, and before folders are made
    outputs = planned[mine]
    if not outputs:
        return []
    for output in outputs:  # before opening recordings: some are read whole to infer their size
        video.check_free(output)
        check_apart(output, settings.recordings)
        if not done_file(output).is_file():
            video.check_output(output, settings.overwrite)
    outcome = Outcome()
    paths = zip(settings.recordings[mine], outputs, strict=True)
    jobs = [
        job for path, output in paths if (job := job_of(path, output, settings, weights, outcome))
    ]
    began = time.monotonic()
    do_all(jobs, settings, weights, outcome)
    if outcome.done:
        done = list(outcome.done.values())
        print(closing_line(done, time.monotonic() - began, settings.times))
    if outcome.failed:
        rest = "; the other recordings are done" if outcome.done else ""
        raise RecordingError("; ".join(map(str, outcome.failed.values())) + rest)
    if all(done_file(output).is_file() for output in planned):  # those of other processes too
        for output in planned:
            done_file(output).unlink(missing_ok=True)
    return outputs


def do_all(jobs: list[Job], settings: Reconstruct, weights: Weights, outcome: Outcome) -> None:
    """Does jobs of any sensor sizes, with one progress bar."""
    way = Way(
        network=settings.network,
        display=settings.display,
        preview=settings.preview,
        rotated=settings.flip and settings.network.color,  # else it would compile anew
        raw=settings.output.suffix == ".h5",
        at_times=settings.times.wanted,
        chunk=settings.chunk,
        batch=settings.batch,
        several=len(settings.recordings) > 1,
        overwrite=settings.overwrite,
    )
    groups: dict[tuple[int, int], list[Job]] = {}  # of one size, as these can share a batch
    for job in jobs:
        groups.setdefault((job.recording.height, job.recording.width), []).append(job)
    counts = [job.recording.count for job in jobs if job.recording.count is not None]
    partly = settings.start or settings.stop or settings.windows.step
    known = None if len(counts) < len(jobs) or partly else sum(counts)
    read = Bytes([job.recording.path for job in jobs] if known is None else [])
    unit = "ev" if known or read.total is None else "B"
    with bar(known or read.total, unit, unit_scale=True, smoothing=0.1) as progress:
        for same in groups.values():
            do_jobs(same, way, weights, outcome, progress, read, settings.show)


# ---- The jobs


def plan(recordings: tuple[Path, ...], output: Path) -> list[Path]:
    """The output of each recording: `output` itself if there is only one recording.

    Raises OutputError for names that several cannot have."""
    if len(recordings) == 1:
        return [video.followed(output)]
    video.check_kind(output)
    stems = [_stem(named(path)) for path in recordings]
    if output.suffix not in video.WHOLE:
        stems = [_of_a_folder(stem) for stem in stems]
    twice = next((stem for stem in stems if stems.count(stem) > 1), None)
    if twice:
        raise OutputError(
            f"two recordings are named {twice} and would write the same output: run them apart"
        )
    if output.suffix in video.WHOLE:
        return [video.followed(output.with_suffix("") / f"{stem}{output.suffix}") for stem in stems]
    return [video.followed(output / stem) for stem in stems]


def _of_a_folder(stem: str) -> str:
    """A name that no file has: `cam.left` -> `cam_left`."""
    suffix = Path(stem).suffix
    return f"{Path(stem).stem}_{suffix[1:]}" if video.like_a_file(suffix) else stem


def _stem(path: Path) -> str:
    """The name without its suffixes: `a.txt.gz` -> `a`, but `a.1.txt` -> `a.1`. The name of a
    folder is kept."""
    path = path if path.is_dir() else path.with_suffix("")
    while path.suffix.lower() in (*video.VIDEOS, *video.OTHER_FILES):
        path = path.with_suffix("")
    return path.name


def job_of(
    path: Path, output: Path, settings: Reconstruct, weights: Weights, outcome: Outcome
) -> Job | None:
    """The job of a recording; None if an earlier run has finished it, or if it lacks the requested
    times (recorded in `outcome`).

    Raises OutputError if its output exists, RecordingError if it is no recording.
    """
    size = parse_size(settings.sensor_size)
    try:
        whole = open_recording(path, size, settings.strict, settings.columns)
    except RecordingError as error:
        if len(settings.recordings) == 1:
            raise
        logger.warning("%s", error)
        outcome.failed[output] = error
        return None
    recording = dataclasses.replace(
        whole, events=lambda: until_set(outcome.stopped, whole.events())
    )
    windows, speed = windows_for(recording, settings)
    choice = settings.hot_pixels
    hot = functools.cache(lambda: None if choice is None else hot_pixels(choice, recording))
    try:
        if settings.network.color and recording.grey:
            raise RecordingError(
                f"{path}: says that its sensor sees no colours, --color would invent some: leave "
                "it out"
            )
        times = times_of(settings.times, recording, filtered(recording, settings, hot))
        record = describe(dataclasses.replace(settings, windows=windows), recording, weights, times)
    except RecordingError as error:
        outcome.failed[output] = error
        return None
    if is_done(output, record):
        logger.warning(
            "%s: done by the run that this one continues (without %s it is made again)",
            output, done_file(output).name,
        )  # fmt: skip
        return None
    video.check_output(output, settings.overwrite)
    read_position(output, record, settings.overwrite)  # so that errors come before the work
    return Job(
        recording=recording,
        output=output,
        record=record,
        windows=windows,
        times=times,
        events=lambda: filtered(recording, settings, hot),
        writer=lambda: writer_of(output, settings, speed),
        warm_up=settings.warm_up if settings.network.recurrent else 0,
    )


def windows_for(recording: Recording, settings: Reconstruct) -> tuple[Windows, float]:
    """The windows and the video's speed: as set, or the defaults for this recording."""
    windows, speed = settings.windows, settings.speed
    if windows == Windows() or speed is None:
        try:
            found = usual(until_damage(part_of(recording, settings)))
        except RecordingError:  # reported when its events are read, so that others are done
            found = Windows(longest=DEFAULT_LONGEST)
        windows = found if windows == Windows() else windows
        longest = found.longest or DEFAULT_LONGEST
        if speed is None and longest < DEFAULT_LONGEST / 2:  # gone in 0.4 s
            speed = longest / DEFAULT_LONGEST
    return windows, speed or 1.0


def part_of(recording: Recording, settings: Reconstruct) -> Iterator[Events]:
    """Its events from --start to --stop."""
    if settings.start is None and settings.stop is None:
        return recording.events()
    return filters.between(recording.events(), settings.start, settings.stop)


def filtered(
    recording: Recording, settings: Reconstruct, hot: Callable[[], np.ndarray | None]
) -> Iterator[Events]:
    """hot: its hot pixels, which are found when the first event is asked for."""
    chunks = part_of(recording, settings)
    if (pixels := hot()) is not None:
        chunks = filters.without_hot_pixels(chunks, pixels)
    if settings.flip:
        chunks = filters.rotated(chunks, recording.height, recording.width)
    yield from chunks


def hot_pixels(choice: str, recording: Recording) -> np.ndarray:
    """`auto` or the name of a file -> (H, W) bool."""
    if choice == "auto":
        hot = filters.find_hot_pixels(recording)
        logger.warning("%s: left out: %s", recording.path, counted(int(hot.sum()), "hot pixel"))
        return hot
    return filters.read_hot_pixels(choice, recording.height, recording.width)


def writer_of(output: Path, settings: Reconstruct, speed: float) -> Writer:
    if output.suffix == ".h5":
        return ArraysWriter(output)
    if output.suffix in (".bag", ".ros2"):
        return BagWriter(output, settings.topic, settings.frame_id)
    by_time = settings.names == "nanoseconds"
    return video.open_writer(output, settings.fps, speed, settings.times.wanted, by_time)


def describe(
    settings: Reconstruct,
    recording: Recording,
    weights: Weights,
    times: np.ndarray | Grid | None = None,
) -> dict:
    """All that the pictures depend on, ready for JSON."""
    digest = hashlib.sha256(str(weights.normalise).encode())
    for path, leaf in jax.tree_util.tree_leaves_with_path(weights.params):
        digest.update(jax.tree_util.keystr(path).encode() + np.asarray(leaf).tobytes())
    told = {
        "recording": identity(recording.path),
        "sensor": [recording.height, recording.width],
        "weights": digest.hexdigest(),
    }
    if isinstance(times, np.ndarray):  # not the name of their file
        told["times"] = hashlib.sha256(times.tobytes()).hexdigest()
    if settings.hot_pixels not in (None, "auto"):  # what the file holds counts, not its name
        hot = hot_pixels(settings.hot_pixels, recording)
        told["hot_pixels"] = hashlib.sha256(hot.tobytes()).hexdigest()
    if settings.output.suffix in video.VIDEOS:
        told |= {"fps": settings.fps, "speed": settings.speed}
    of_bags = () if settings.output.suffix in (".bag", ".ros2") else ("topic", "frame_id")
    return recorded(settings, (*UNRECORDED, *of_bags), **told)


# ---- What is said at the end


def closing_line(done: list[Done], seconds: float, times: Times) -> str:
    """ "video.mp4: 59 pictures of 78,830 events in 15.0 s (...); windows of 33 ms, in 2.4 steps
    each; plays in real time" """
    pictures, events = sum(one.pictures for one in done), sum(one.events for one in done)
    ways = {in_words(one.job.windows, one.job.recording.pixels) for one in done}
    if len(ways) > 1:
        ways = {"windows as they suit each recording"}
    each = sum(one.pictures * one.steps for one in done) / max(pictures, 1)
    if each > 1.005:
        ways = {f"{way}, in {each:.3g} steps each" for way in ways}
    if times.wanted:
        ways = {f"{times.in_words()}, the state by {way}" for way in ways}
    factors = sorted(one.slower for one in done if one.slower is not None)
    # of the least and the greatest, which may read the same
    said = dict.fromkeys(factor_in_words(slower) for slower in (*factors[:1], *factors[-1:]))
    plays = f"; plays {' to '.join(said)}" if said else ""
    rates = f"{pictures / seconds:.1f} pictures/s, {rate_in_words(events / seconds)}"
    return (
        f"{', '.join(str(one.job.output) for one in done)}: {counted(pictures, 'picture')} of "
        f"{counted(events, 'event')} in {seconds:.1f} s ({rates}); {', '.join(ways)}{plays}"
    )


def factor_in_words(slower: float) -> str:
    if 0.98 < slower < 1.02:
        return "in real time"
    factor, way = (slower, "slower") if slower > 1 else (1 / slower, "faster")
    return f"{factor:,.0f} times {way}" if factor >= 100 else f"{factor:.3g} times {way}"
