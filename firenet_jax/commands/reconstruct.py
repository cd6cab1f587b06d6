"""Recordings -> pictures on disk: reading, device and writing overlapped, and resumable.

Recordings of one sensor size run side by side in `batch` slots, each with its own state; a slot
whose recording has ended takes the next. The devices of a process share the slots, and processes
the recordings. The host cuts windows and writes; everything between is the compiled program
`reconstruction.events_to_pictures`. Memory holds a few chunks, whatever the length of the
recordings.
"""

import copy
import dataclasses
import hashlib
import itertools
import json
import os
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import jax
import numpy as np
import tyro
from tqdm import tqdm

from firenet_jax import filters
from firenet_jax.checkpoint import load_weights
from firenet_jax.commands.times import Times, times_of
from firenet_jax.devices import BATCH, REPLICATED, device_mesh, sharding, share
from firenet_jax.errors import RecordingError, SettingsError, logger
from firenet_jax.events import Events, Recording, counted, rate_in_words, until_damage
from firenet_jax.instants import Counts, Grid, Step, check, steps
from firenet_jax.network import Weights
from firenet_jax.pictures import Display
from firenet_jax.readers import open_recording
from firenet_jax.reconstruction import (
    Looks,
    Network,
    Session,
    events_to_pictures,
    initial_session,
    looks_of,
)
from firenet_jax.settings import parse_size
from firenet_jax.storage.arrays import ArraysWriter
from firenet_jax.storage.bag import BagWriter, check_topic
from firenet_jax.storage.files import (
    OutputError,
    identity,
    named,
    partial_name,
    read_arrays,
    write_text,
    writing,
)
from firenet_jax.storage.overlap import ahead
from firenet_jax.storage.progress import Bytes, bar
from firenet_jax.storage.screen import Screen, check_screen
from firenet_jax.storage.video import (
    OTHER_FILES,
    VIDEOS,
    WHOLE,
    FolderWriter,
    VideoWriter,
    check_free,
    check_output,
    check_rate,
    followed,
    open_writer,
)
from firenet_jax.tensors import IN_LISTS, Packed, pack_for_devices
from firenet_jax.windows import LONGEST, Windows, cut, in_words, usual

# Settings that the pictures do not depend on (on the chunk only in float32's last bits), or that
# are told in another way.
ELSEWHERE = ("recordings", "output", "weights", "fps", "speed", "chunk", "batch", "overwrite")
ELSEWHERE += ("columns", "strict", "processes", "process", "show")
Writer = FolderWriter | VideoWriter | ArraysWriter | BagWriter
RESUME_EVERY = 5.0  # seconds between two saves of what a resumed run needs


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
    images), .bag or .ros2. Of several recordings one each, in the folder of that name."""
    weights: Annotated[Path | None, tyro.conf.arg(aliases=["-c"])] = None
    """Weights: .npz, a published PyTorch checkpoint, or the folder of a training run. Without:
    those that come with the package."""
    windows: Windows = Windows()
    times: Times = Times()
    display: Display = Display()
    network: Network = Network()
    preview: bool = False
    """Show the events (blue: brighter, red: darker) beside the reconstruction."""
    show: bool = False
    """Show the pictures in a window, too, while they are made; with several recordings those of the
    first that is not done."""
    hot_pixels: str | None = None
    """Ignore these pixels: a file of `x,y` lines, or `auto` to find them in the recording."""
    flip: bool = False
    """Turn the picture by 180 degrees."""
    start: float | None = None
    """Begin this many seconds after the first event."""
    stop: float | None = None
    """End this many seconds after the first event."""
    speed: float | None = None
    """How fast a video plays: 1 is real time, 0.1 ten times slower. Without: real time, and slower
    where a recording is so short that nobody could see it."""
    fps: float | None = None
    """Show each picture of a video for as long, so many per second, whatever its time."""
    names: Literal["number", "nanoseconds"] = "number"
    """Name the png files of --rate, --at, --between-frames or --triggers by their time, as Kalibr
    takes them."""
    topic: str = "/cam0/image_raw"
    """Of the images in a bag."""
    frame_id: str = "cam0"
    """The frame of coordinates that images in a bag name."""
    sensor_size: str | None = None
    """WIDTHxHEIGHT of the sensor, such as 240x180, where the recording does not say it."""
    columns: str | None = None
    """Order of the columns of a text that has no line of names, such as x,y,p,t."""
    strict: bool = False
    """Refuse a recording with a bad row or damage, instead of leaving out what cannot be read (at
    most one event in a thousand) and reading up to the damage."""
    chunk: int | None = None
    """Windows a recording gives the device at once (default: 16; on a CPU 8 of a sensor of up to
    65,536 pixels, 4 of larger ones)."""
    batch: int | None = None
    """Recordings that run side by side, shared by the devices (default: one for each device)."""
    overwrite: bool = False
    """Replace an output that exists."""
    processes: int | None = None
    """How many processes, on this machine or on many, deal the recordings out among them; where
    nothing is said, those that srun or mpirun has started."""
    process: int | None = None
    """Which one this is, from 0."""

    def __post_init__(self):
        if self.fps is not None:
            check_rate(self.output, self.fps)
            if self.speed is not None:
                raise SettingsError("fps and speed: a video has one or the other, leave one out")
        if self.speed is not None and not 1e-6 <= self.speed <= 1e6:
            raise SettingsError(f"speed is {self.speed}, but must be more than 0; 1 is real time")
        for name in ("chunk", "batch"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise SettingsError(f"{name} is {value}, but must be more than 0")
        if self.network.pad < 1:
            raise SettingsError(f"pad is {self.network.pad}, but pads to a multiple of 1 or more")
        if not self.recordings:
            raise SettingsError("no recording: name one or more files or folders")
        filters.check_span(self.start, self.stop)
        share(self.process, self.processes)
        check_topic(self.topic)
        if self.times.wanted:
            check(self.windows)
        elif self.names == "nanoseconds":
            raise SettingsError(
                "pictures are named by their time where it is chosen: with --rate, --at, "
                "--between-frames or --triggers"
            )
        if self.output.suffix == ".h5" and (self.preview or self.network.color):
            raise SettingsError(
                ".h5 holds images as the network gives them: leave out --preview and --color"
            )


class Job(NamedTuple):
    """One recording and where its pictures go."""

    recording: Recording
    output: Path
    record: str  # JSON of all that the pictures depend on; a resumed run must have the same
    windows: Windows = Windows()  # as asked for, or as they suit the recording
    speed: float = 1.0  # at which a video plays
    times: np.ndarray | Grid | None = None  # of the images; None: one for each window


@dataclass
class Running:
    """A job that has a slot."""

    job: Job
    steps: Iterator[Step]
    ahead: Step | None  # the next step; None after the last
    reached: int  # steps taken so far, those of an earlier run among them
    pictures: int  # of these
    events: list[int]  # how many were read so far
    writer: Writer
    counts: Counts | None  # of times at which images are wanted
    error: RecordingError | None = None  # that ended its steps before their time

    def take(self, count: int) -> list[Step]:
        """The next `count` steps, or as many as there are."""
        taken = []
        while self.ahead is not None and len(taken) < count:
            taken.append(self.ahead)
            try:
                self.ahead = next(self.steps, None)
            except RecordingError as error:
                self.ahead, self.error = None, error
        self.reached += len(taken)
        self.pictures += sum(step.time is not None for step in taken)
        if self.ahead is None and self.error is None and self.counts is not None:
            self.error = told(self.job.recording, self.counts)
        return taken


def told(recording: Recording, counts: Counts) -> RecordingError | None:
    """Says which times lie outside the recording; an error where all do."""
    outside = f"{counts.early} before its first event, {counts.late} after its last one"
    if not counts.seen:
        return RecordingError(
            f"{recording.path}: no image is wanted while it lasts ({outside}): choose other times"
        )
    if counts.early or counts.late:
        logger.warning("%s: times without an image: %s", recording.path, outside)
    return None


class Part(NamedTuple):
    """What a chunk holds of one recording."""

    running: Running
    times: list[int | None]  # of its images, microseconds; None: a step without one
    counts: list[int]  # of their events
    reached: int  # steps of the recording up to the last of these
    pictures: int  # of these
    ends: bool  # no steps follow


class Chunk(NamedTuple):
    """T x B steps on their way to the device, and whose they are."""

    events: Packed
    count: int  # events
    valid: np.ndarray  # (T, B) bool
    looks: Looks | None  # None: each is a window, which has an image
    parts: dict[int, Part]  # by slot
    starts: dict[int, Session]  # by slot: a new recording begins here, from this state


def run(settings: Reconstruct) -> list[Path]:
    """Does what the settings say; returns the outputs, of several processes those of this one.

    Raises RecordingError, CheckpointError, OutputError or ValueError, in one sentence."""
    weights = load_weights(settings.weights)
    if settings.show:
        check_screen()
    # Recordings have nothing to do with each other, so processes need not know of each other:
    # as one of JAX's own processes, one that is done or dies would take the others with it.
    process, processes = share(settings.process, settings.processes)
    mine = slice(process, None, processes)
    planned = plan(settings.recordings, settings.output)
    outputs = planned[mine]
    if not outputs:
        return []
    for output in outputs:  # before recordings are opened: some are read whole for their size
        check_free(output)
        if not done_file(output).is_file():
            check_output(output, settings.overwrite)
    size = parse_size(settings.sensor_size)
    jobs, failed = [], {}
    for path, output in zip(settings.recordings[mine], outputs, strict=True):
        recording = open_recording(path, size, settings.strict, settings.columns)
        if settings.network.color and recording.grey:
            raise RecordingError(
                f"{path}: says that its sensor sees no colours, --color would invent some: leave "
                "it out"
            )
        windows, speed = windows_for(recording, settings)
        try:
            times = times_of(settings.times, recording, part_of(recording, settings))
        except RecordingError as error:
            failed[output] = error
            continue
        chosen = dataclasses.replace(settings, windows=windows)
        record = describe(chosen, recording, weights, times)
        job = Job(recording, output, record, windows, speed, times)
        if is_done(job):
            logger.warning("%s: done by the run that this one continues", output)
            continue
        check_output(output, settings.overwrite)
        check_position(job, settings)
        jobs.append(job)
    began, said = time.monotonic(), {}
    counts = [job.recording.count for job in jobs]
    partly = settings.start or settings.stop or settings.windows.step
    known = None if None in counts or partly else sum(counts)
    read = Bytes([job.recording.path for job in jobs] if known is None else [])
    unit = "ev" if known or read.total is None else "B"
    with bar(known or read.total, unit, unit_scale=True, smoothing=0.1) as progress:
        for same in by_sensor_size(jobs):
            reconstruct_jobs(same, settings, weights, progress, failed, said, read)
    seconds = time.monotonic() - began
    if said:
        print(closing_line(said, {job.output: job for job in jobs}, seconds, settings.times))
    if failed:
        rest = "; the other recordings are done" if said else ""
        raise RecordingError("; ".join(map(str, failed.values())) + rest)
    if all(done_file(output).is_file() for output in planned):  # those of other processes too
        for output in planned:
            done_file(output).unlink(missing_ok=True)
    return outputs


def windows_for(recording: Recording, settings: Reconstruct) -> tuple[Windows, float]:
    """The windows, and the speed of a video: those asked for, or what suits the recording."""
    windows, speed = settings.windows, settings.speed or 1.0
    if windows == Windows():
        try:
            windows = usual(until_damage(part_of(recording, settings)))
        except RecordingError:  # told when its events are read, so that others are done
            windows = Windows(longest=LONGEST)
        longest = windows.longest or LONGEST
        if settings.speed is None and longest < LONGEST / 2:  # gone in 0.4 s
            speed = longest / LONGEST
    return windows, speed


def part_of(recording: Recording, settings: Reconstruct) -> Iterator[Events]:
    """Its events from --start to --stop."""
    if settings.start is None and settings.stop is None:
        return recording.events()
    return filters.between(recording.events(), settings.start, settings.stop)


class Said(NamedTuple):
    """What the closing line tells of an output."""

    pictures: int
    events: int
    slower: float | None  # than reality, of a video


def closing_line(
    said: dict[Path, Said], jobs: dict[Path, Job], seconds: float, times: Times = Times()
) -> str:
    """ "video.mp4: 59 pictures of 78,830 events in 15.0 s (...), windows of ...; in real time" """
    pictures, events = (sum(column) for column in list(zip(*said.values(), strict=True))[:2])
    ways = {in_words(jobs[output].windows, jobs[output].recording.pixels) for output in said}
    if len(ways) > 1:
        ways = {"windows as they suit each recording"}
    if times.wanted:
        ways = {f"{times.in_words()}, the state by {way}" for way in ways}
    factors = [entry.slower for entry in said.values() if entry.slower is not None]
    plays = ""
    if factors:
        least, most = min(factors), max(factors)
        plays = f"; plays {factor_in_words(least)}"
        if factor_in_words(most) != factor_in_words(least):
            plays += f" to {factor_in_words(most)}"
    rates = f"{pictures / seconds:.1f} pictures/s, {rate_in_words(events / seconds)}"
    return (
        f"{', '.join(map(str, said))}: {counted(pictures, 'picture')} of "
        f"{counted(events, 'event')} in {seconds:.1f} s ({rates}); {', '.join(ways)}{plays}"
    )


def factor_in_words(slower: float) -> str:
    if 0.98 < slower < 1.02:
        return "in real time"
    return f"{slower:.3g} times slower" if slower > 1 else f"{1 / slower:.3g} times faster"


def plan(recordings: tuple[Path, ...], output: Path) -> list[Path]:
    """The name of each recording's output: `output` itself if there is only one recording."""
    if len(recordings) == 1:
        return [followed(output)]
    stems = [_stem(named(path)) for path in recordings]
    twice = next((stem for stem in stems if stems.count(stem) > 1), None)
    if twice:
        raise OutputError(
            f"two recordings are named {twice} and would write the same output: run them apart"
        )
    if output.suffix in WHOLE:
        return [followed(output.with_suffix("") / f"{stem}{output.suffix}") for stem in stems]
    return [followed(output / stem) for stem in stems]


def _stem(path: Path) -> str:
    """The name without its suffix, nor with one before that: `a.txt.gz` -> `a`, `a.1.txt` -> `a.1`.

    A folder may have a dot in its name.
    """
    path = path if path.is_dir() else path.with_suffix("")
    while path.suffix.lower() in (*VIDEOS, *OTHER_FILES):
        path = path.with_suffix("")
    return path.name


def done_file(output: Path) -> Path:
    """Beside an output of several: it is whole, but others of the same run are not."""
    return output.with_name(f"{output.name}.done.json")


def done_as(job: Job) -> str:
    """What its done file says: what the output was made of, and what it is."""
    return json.dumps([job.record, identity(job.output)])


def is_done(job: Job) -> bool:
    """Whether an interrupted run of the same settings has left this output, one of several."""
    try:
        return done_file(job.output).read_text() == done_as(job)
    except (OSError, UnicodeDecodeError):
        return False


def by_sensor_size(jobs: list[Job]) -> list[list[Job]]:
    """Only recordings of the same size can share a batch."""
    groups: dict[tuple[int, int], list[Job]] = {}
    for job in jobs:
        groups.setdefault((job.recording.height, job.recording.width), []).append(job)
    return list(groups.values())


def reconstruct_jobs(
    jobs: list[Job],
    settings: Reconstruct,
    weights: Weights,
    progress: tqdm,
    failed: dict[Path, RecordingError],
    said: dict[Path, Said],
    read: Bytes,
) -> None:
    """Jobs of one sensor size -> their outputs on disk; what is to be told of each goes to `said`.

    A recording that turns out to be damaged does not keep the others from being done: its error
    goes to `failed`, by its output.
    """
    height, width = jobs[0].recording.height, jobs[0].recording.width
    wanted = min(settings.batch or jax.local_device_count(), len(jobs))
    count = min(wanted, jax.local_device_count())
    mesh = device_mesh(jax.local_devices()[:count]) if count > 1 else None
    slots = -(-wanted // count) * count  # the same number on each device; some may stay empty
    weights = jax.device_put(weights, sharding(REPLICATED, mesh) if mesh else None)
    writers: dict[Path, Writer] = {}  # of jobs that are not done
    chunks = ahead(in_chunks(jobs, settings, slots, count, failed, writers), depth=1)

    def device():
        """Chunk by chunk: (chunk, pictures on the host).

        An accelerator has the next chunk before the last one's pictures are fetched, so that it
        never waits. A CPU has not: it would gain nothing, and each chunk in flight holds memory.
        """
        session = initial_session(slots, height, width, settings.network, settings.times.wanted)
        sent = deque()
        in_flight = 1 if jax.default_backend() == "cpu" else 2
        saved = time.monotonic()
        for chunk in chunks:
            for slot, start in chunk.starts.items():
                session = _set_slot(session, slot, start)
            events = chunk.events
            if mesh:
                session = jax.device_put(session, sharding(BATCH, mesh))
                events = jax.tree.map(
                    lambda a, spec: jax.device_put(a, sharding(spec, mesh)), events, IN_LISTS
                )
            session, shown = events_to_pictures(
                weights, session, events, chunk.valid, chunk.looks, height=height, width=width,
                network=settings.network, settings=settings.display, preview=settings.preview,
                raw=settings.output.suffix == ".h5", mesh=mesh,
            )  # fmt: skip
            states = {}
            if time.monotonic() - saved > RESUME_EVERY:
                states = {
                    slot: _get_slot(session, slot)
                    for slot, part in chunk.parts.items()
                    if part.running.job.output.suffix not in WHOLE and not part.ends
                }
                saved = time.monotonic()
            sent.append((chunk, shown, states))
            if len(sent) == in_flight:
                yield fetch(*sent.popleft())
        yield from (fetch(*entry) for entry in sent)

    def fetch(chunk, shown, states):
        # A state goes to disk from here, not with the pictures, so that none waits in memory.
        for slot, state in jax.device_get(states).items():
            keep_position(chunk.parts[slot], state)
        return chunk, jax.device_get(shown)

    pictures_done: dict[Path, int] = {}
    screen = Screen() if settings.show else None
    finished = ahead(device(), depth=1)
    try:
        for chunk, shown in finished:
            for slot, part in chunk.parts.items():
                running = part.running
                for image, *of in zip(shown[:, slot], part.times, part.counts, strict=False):
                    if of[0] is not None:
                        running.writer.write(image, *of)
                        if screen and slot == min(chunk.parts):
                            screen.show(image, str(running.job.output))
                output = running.job.output
                wanted = sum(time_of is not None for time_of in part.times)
                pictures_done[output] = pictures_done.get(output, 0) + wanted
                if part.ends and running.error:
                    failed[running.job.output] = running.error
                    writers.pop(running.job.output).abandon()
                elif part.ends:
                    done_file(output).unlink(missing_ok=True)
                    running.writer.finish()
                    if isinstance(running.writer, FolderWriter):
                        (output / "resume.npz").unlink(missing_ok=True)
                    if len(settings.recordings) > 1:
                        write_text(done_file(output), done_as(running.job))
                    del writers[output]
                    said[output] = Said(
                        pictures_done[output],
                        sum(running.events),
                        getattr(running.writer, "slower", None),
                    )
                else:
                    publish_position(part)
            progress.set_postfix_str(counted(sum(pictures_done.values()), "picture"), refresh=False)
            progress.update(read.read() - progress.n if read.total else chunk.count)
    finally:
        finished.close()
        if screen:
            screen.close()
        chunks.close()  # else its thread would live as long as an exception that holds this frame
        for writer in writers.values():
            writer.abandon()


@jax.jit
def _set_slot(session: Session, slot, start: Session) -> Session:
    return jax.tree.map(lambda all, one: all.at[slot].set(one), session, start)


@jax.jit
def _get_slot(session: Session, slot) -> Session:
    return jax.tree.map(lambda all: all[slot], session)


def chunk_for(pixels: int) -> int:
    """Windows that a device takes at once, where nothing is asked: what a chunk costs by itself is
    shared by more, but they take more memory."""
    if jax.default_backend() != "cpu":
        return 16
    return 8 if pixels <= 2**16 else 4


def in_chunks(
    jobs: list[Job],
    settings: Reconstruct,
    slots: int,
    devices: int,
    failed: dict[Path, RecordingError],
    writers: dict[Path, Writer],
) -> Iterator[Chunk]:
    """Jobs -> chunks of T x B steps, B the slots; a free slot takes the next job.

    writers: where those that were opened go, by their output.
    """
    length = settings.chunk or chunk_for(jobs[0].recording.pixels)
    waiting = iter(jobs)
    running: dict[int, Running] = {}
    size = 0
    while True:
        starts = {}
        for slot in range(slots):
            while slot not in running and (job := next(waiting, None)) is not None:
                try:
                    running[slot], starts[slot] = start(job, settings, writers)
                except RecordingError as error:
                    failed[job.output] = error
        if not running:
            return
        rows = [[Events.empty()] * slots for _ in range(length)]
        valid = np.zeros((length, slots), bool)
        parts, taken = {}, [[]] * slots
        for slot, job in list(running.items()):
            taken[slot] = job.take(length)
            for t, step in enumerate(taken[slot]):
                rows[t][slot] = step.events
            valid[: len(taken[slot]), slot] = True
            times = [step.time for step in taken[slot]]
            sizes = [len(step.events) for step in taken[slot]]
            ends = job.ahead is None
            parts[slot] = Part(job, times, sizes, job.reached, job.pictures, ends)
            if job.ahead is None:
                del running[slot]
        looking = settings.times.wanted  # then events count in the step that keeps them
        count = sum(
            len(step.events)
            for group in taken
            for step in group
            if not looking or step.time is None
        )
        events = pack_for_devices(rows, devices, size)
        size = len(events.t) // devices
        looks = looks_of(taken, length) if looking else None
        yield Chunk(events, count, valid, looks, parts, starts)


def start(job: Job, settings: Reconstruct, writers: dict[Path, Writer]) -> tuple[Running, Session]:
    """Opens the stream of a job's steps, after those that an interrupted run has finished."""
    # First of all, as it keeps other runs from what is read and removed here.
    writer = writers[job.output] = writer_of(job, settings)
    try:
        recording = job.recording
        span: list[int] = []
        timed_recording = dataclasses.replace(
            recording, events=lambda: timed(recording.events(), span)
        )
        chunks = part_of(timed_recording, settings)
        if settings.hot_pixels is not None:
            chunks = filters.without(chunks, hot_pixels(settings.hot_pixels, recording))
        if settings.flip:
            chunks = filters.turned(chunks, recording.height, recording.width)
        events: list[int] = []
        chunks, counts = numbered(chunks, events), None
        if job.times is None:
            windows = cut(recording, job.windows, chunks)
            entries = (Step(window.events, window.time, 1.0) for window in windows)
        else:
            counts, times = Counts(), copy.copy(job.times)  # a grid counts on
            entries = steps(recording, job.windows, times, chunks, counts)
        done, pictures, session = load_position(job, settings)
        first = next(itertools.islice(entries, done, None), None)
        if first is None and not done:
            lasts = f": it lasts {(span[1] - span[0]) / 1e6:g} s" if span else ""
            raise RecordingError(
                f"{recording.path}: no events, or none that the filters let pass{lasts}"
            )
    except RecordingError:
        writers.pop(job.output).abandon()
        raise
    if done and isinstance(writer, FolderWriter):
        writer.keep(pictures)
        events.clear()  # those of the pictures that are there
    return Running(job, entries, first, done, pictures, events, writer, counts), session


def writer_of(job: Job, settings: Reconstruct) -> Writer:
    output = job.output
    if output.suffix == ".h5":
        return ArraysWriter(output)
    if output.suffix in (".bag", ".ros2"):
        return BagWriter(output, settings.topic, settings.frame_id)
    by_time = settings.names == "nanoseconds"
    return open_writer(output, settings.fps, job.speed, settings.times.wanted, by_time)


def timed(chunks: Iterator[Events], span: list[int]) -> Iterator[Events]:
    """The same chunks; the times of the first event and of the last go to `span`."""
    for chunk in chunks:
        span[:] = [span[0] if span else int(chunk.t[0]), int(chunk.t[-1])]
        yield chunk


def numbered(chunks: Iterator[Events], counts: list[int]) -> Iterator[Events]:
    """The same chunks; how many events each holds goes to `counts`."""
    for chunk in chunks:
        counts.append(len(chunk))
        yield chunk


def hot_pixels(choice: str, recording: Recording) -> np.ndarray:
    """`auto` or the name of a file -> (H, W) bool."""
    if choice == "auto":
        hot = filters.find_hot_pixels(recording)
        logger.warning("%s: %d hot pixels are ignored", recording.path, hot.sum())
        return hot
    return filters.read_hot_pixels(choice, recording.height, recording.width)


def describe(
    settings: Reconstruct,
    recording: Recording,
    weights: Weights,
    times: np.ndarray | Grid | None = None,
) -> str:
    """All that the pictures depend on, as JSON."""
    digest = hashlib.sha256(str(weights.normalise).encode())
    for path, leaf in jax.tree_util.tree_leaves_with_path(weights.params):
        digest.update(jax.tree_util.keystr(path).encode() + np.asarray(leaf).tobytes())
    choices = dataclasses.asdict(settings)
    for name in ELSEWHERE:
        del choices[name]
    if isinstance(times, np.ndarray):  # not the name of their file
        choices["times"] = hashlib.sha256(times.tobytes()).hexdigest()
    if settings.output.suffix not in (".bag", ".ros2"):
        del choices["topic"], choices["frame_id"]
    if settings.hot_pixels not in (None, "auto"):  # what the file holds counts, not its name
        hot = hot_pixels(settings.hot_pixels, recording)
        choices["hot_pixels"] = hashlib.sha256(hot.tobytes()).hexdigest()
    if settings.output.suffix in VIDEOS:
        choices |= {"fps": settings.fps, "speed": settings.speed}
    return json.dumps(
        {
            "recording": identity(recording.path),
            "sensor": [recording.height, recording.width],
            "weights": digest.hexdigest(),
            **choices,
        }
    )


def position_file(job: Job) -> Path:
    return partial_name(job.output) / "resume.npz"


def kept_file(part: Part) -> Path:
    return position_file(part.running.job).with_suffix(f".{part.reached}.npz")


def keep_position(part: Part, session: Session) -> None:
    """What is needed to go on after the part's last picture, which may not be on disk yet."""
    job = part.running.job
    leaves = {f"state{i}": leaf for i, leaf in enumerate(jax.tree.leaves(session))}
    with writing(job.output):
        path = kept_file(part)
        path.parent.mkdir(exist_ok=True)
        places = {"steps": part.reached, "pictures": part.pictures}
        np.savez(path, record=job.record, **places, **leaves)


def publish_position(part: Part) -> None:
    """The part's pictures are written: if its state was kept, a new run goes on from there."""
    path, writer = kept_file(part), part.running.writer
    if path.exists() and isinstance(writer, FolderWriter):
        writer.flush()
        os.replace(path, position_file(part.running.job))


def check_position(job: Job, settings: Reconstruct) -> dict[str, np.ndarray] | None:
    """What an interrupted run of the same settings has left in its folder; None if there is none.

    Raises OutputError where another run has left something, which `overwrite` allows to replace.
    """
    path = position_file(job)
    if job.output.suffix in WHOLE or not path.exists():
        return None
    saved = read_arrays(path)
    if str(saved.get("record")) == job.record:
        return saved
    if not settings.overwrite:
        raise OutputError(
            f"{path.parent} holds an unfinished run of other settings or another recording: "
            "remove it or pass --overwrite"
        )
    return None


def load_position(job: Job, settings: Reconstruct) -> tuple[int, int, Session]:
    """(steps done, their pictures on disk, the state after them) of an interrupted run; (0, 0, the
    initial state) if there is none."""
    height, width = job.recording.height, job.recording.width
    initial = initial_session(1, height, width, settings.network, settings.times.wanted)
    initial = jax.tree.map(lambda leaf: leaf[0], initial)
    path = position_file(job)
    for unpublished in path.parent.glob("resume.*.npz"):
        unpublished.unlink()
    saved = check_position(job, settings)
    if saved is None:
        if path.is_file():
            path.unlink()
        return 0, 0, initial
    tree = jax.tree.structure(initial)
    try:
        done, pictures = int(saved["steps"]), int(saved["pictures"])
        session = tree.unflatten([saved[f"state{i}"] for i in range(tree.num_leaves)])
    except KeyError as error:  # of another version of this program
        raise OutputError(f"{path} lacks {error}: remove it and run again") from error
    logger.warning("%s: going on after %d pictures", job.output, pictures)
    return done, pictures, session
