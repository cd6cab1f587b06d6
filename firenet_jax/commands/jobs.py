"""Jobs (a recording, its output) -> pictures on disk: reading, device and writing overlapped.

    read      jobs -> chunks of T x B steps: recordings of one sensor size run in B slots, each
              with its own state; when a recording ends, its slot takes the next one
    compute   chunks -> pictures, by the compiled program `reconstruction.events_to_pictures`; the
              devices of a process share the slots
    write     pictures -> outputs, and positions from which an interrupted run can resume

Each stage is a thread that runs one chunk ahead, so memory holds a few chunks, whatever the length
of the recordings. A damaged recording does not stop the others.
"""

import copy
import itertools
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from tqdm import tqdm

from firenet_jax.devices import BATCH, REPLICATED, device_mesh, sharding
from firenet_jax.errors import OutputError, RecordingError, SettingsError, logger
from firenet_jax.events import Events, Recording, counted
from firenet_jax.instants import Counts, Grid, Step, in_parts, steps, warming
from firenet_jax.network import Weights
from firenet_jax.pictures import Display
from firenet_jax.reconstruction import (
    Looks,
    Network,
    Session,
    events_to_pictures,
    initial_session,
    looks_of,
)
from firenet_jax.storage import resume
from firenet_jax.storage.arrays import ArraysWriter
from firenet_jax.storage.bag import BagWriter
from firenet_jax.storage.files import no_note
from firenet_jax.storage.overlap import prefetch
from firenet_jax.storage.progress import Bytes
from firenet_jax.storage.screen import Screen
from firenet_jax.storage.video import FolderWriter, VideoWriter
from firenet_jax.tensors import PACKED_SPECS, Packed, pack_for_devices
from firenet_jax.windows import Windows, cut

Writer = FolderWriter | VideoWriter | ArraysWriter | BagWriter
RESUME_EVERY = 5.0  # seconds between two positions to resume from


class Job(NamedTuple):
    """One recording and where its pictures go."""

    recording: Recording
    output: Path
    record: dict  # everything that the pictures depend on; a resumed run must have the same
    windows: Windows
    times: np.ndarray | Grid | None  # of the images; None: one per window
    events: Callable[[], Iterator[Events]]  # after all filters
    writer: Callable[[], Writer]  # opens the output
    warm_up: int = 0  # windows of its beginning that the network sees beforehand


class Way(NamedTuple):
    """How the images of all jobs are computed and shown."""

    network: Network = Network()
    display: Display = Display()
    preview: bool = False
    rotated: bool = False  # the events are rotated by 180 degrees
    raw: bool = False  # write the network's float32 images
    at_times: bool = False  # images at given times
    chunk: int | None = None  # steps of a recording per call of the device; None: `chunk_for`
    batch: int | None = None  # slots; None: one per device
    several: bool = False  # there are several outputs: finished ones are recorded
    overwrite: bool = False


class Done(NamedTuple):
    """The result of a finished job."""

    job: Job
    pictures: int
    events: int
    steps: float  # of the network for a window, on average; 1 if none was dense
    slower: float | None  # by how much a video is slower than real time


@dataclass
class Outcome:
    """The finished and the failed jobs, by output."""

    done: dict[Path, Done] = field(default_factory=dict)
    failed: dict[Path, RecordingError] = field(default_factory=dict)
    stopped: threading.Event = field(default_factory=threading.Event)  # no more is read


@dataclass
class Running:
    """A job that has a slot."""

    job: Job
    writer: Writer
    steps: Iterator[Step] = iter(())
    ahead: Step | None = None  # the next step; None after the last
    warming: int = 0  # so many of its first steps are the warm-up
    reached: int = 0  # steps taken so far, those of an earlier run among them
    pictures: int = 0  # of these
    events: int = 0  # read so far, by this run
    read: deque[Events] | None = field(default_factory=deque)  # of them; None once `skip` is done
    written: int = 0  # pictures, by this run
    counts: Counts | None = None  # of times at which images are wanted
    error: RecordingError | None = None  # that ended its steps before their time
    refused: RecordingError | None = None  # by the writer, for a time that it cannot express

    def counting(self, chunks: Iterator[Events]) -> Iterator[Events]:
        for chunk in chunks:
            self.events += len(chunk)
            if self.read is not None:
                self.read.append(chunk)
            yield chunk

    def skip(self, count: int) -> None:
        """Passes over so many steps, whose events do not count."""
        last, read = None, self.read or deque()
        for number, step in enumerate(itertools.islice(self.steps, count)):
            if number >= self.warming and len(step.events):  # the warm-up runs backwards, too
                last = int(step.events.t[-1])
                while read and read[0].t[-1] <= last:
                    read.popleft()
        if last is not None:
            self.events = sum(int((chunk.t > last).sum()) for chunk in read)
        self.read = None

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
            self.error = coverage_error(self.job.recording, self.counts)
        return taken


def coverage_error(recording: Recording, counts: Counts) -> RecordingError | None:
    """Says which times lie outside the recording; an error where all do."""
    if not counts.seen:
        return RecordingError(
            f"{recording.path}: none of the requested times lies within it ({counts.outside}): "
            "choose other times"
        )
    if counts.early or counts.late:
        logger.warning("%s: times without an image: %s", recording.path, counts.outside)
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
    seen: np.ndarray  # (T, B) bool: False for parts of a window before its last
    looks: Looks | None  # None: each is a window, which has an image
    parts: dict[int, Part]  # by slot
    starts: dict[int, Session]  # by slot: a new recording begins here, from this state


def do_jobs(
    jobs: list[Job], way: Way, weights: Weights, outcome: Outcome, progress: tqdm, read: Bytes,
    show: bool = False,
) -> None:  # fmt: skip
    """Jobs of one sensor size -> their outputs on disk; what became of each goes to `outcome`.

    progress: moved on by what `read` has, else by events. show: the pictures of the first that is
    not done, in a window too.
    """
    wanted = min(way.batch or jax.local_device_count(), len(jobs))
    devices = min(wanted, jax.local_device_count())
    slots = -(-wanted // devices) * devices  # the same number on each device; some may stay empty
    opened: dict[Path, Writer] = {}  # of jobs that are not done
    chunks = prefetch(in_chunks(jobs, way, slots, devices, outcome, opened), depth=1)
    pictures_of = computed(chunks, jobs[0].recording, way, weights, slots, devices)
    finished = prefetch(pictures_of, depth=1, broken=outcome.stopped)
    screen, pictures = Screen() if show else None, 0
    warming = any(job.warm_up for job in jobs)
    try:
        for chunk, shown in finished:
            for slot, part in chunk.parts.items():
                looked_at = screen if slot == min(chunk.parts) else None
                pictures += write(part, shown[:, slot], looked_at)
                if part.ends:
                    finish(part.running, way, outcome)
                    del opened[part.running.job.output]
            said = "warming up" if warming and not pictures else counted(pictures, "picture")
            progress.set_postfix_str(said, refresh=False)
            progress.update(read.read() - progress.n if read.total else chunk.count)
    finally:
        finished.close()
        if screen:
            screen.close()
        chunks.close()  # else its thread would live as long as an exception that holds this frame
        for writer in opened.values():
            writer.abandon()


# ---- Read


def in_chunks(
    jobs: list[Job], way: Way, slots: int, devices: int, outcome: Outcome,
    opened: dict[Path, Writer],
) -> Iterator[Chunk]:  # fmt: skip
    """Jobs -> chunks of T x B steps, B the slots; a free slot takes the next job.

    opened: where the writers of jobs that have begun go, by their output.
    """
    length = way.chunk or chunk_for(jobs[0].recording.pixels)
    waiting = iter(jobs)
    running: dict[int, Running] = {}
    size = 0
    while True:
        starts = {}
        for slot in range(slots):
            while slot not in running and (job := next(waiting, None)) is not None:
                try:
                    running[slot], starts[slot] = start(job, way, opened)
                except RecordingError as error:
                    outcome.failed[job.output] = error
        if not running:
            return
        rows, count = [[Events.empty()] * slots for _ in range(length)], 0
        valid, seen = np.zeros((length, slots), bool), np.ones((length, slots), bool)
        parts: dict[int, Part] = {}
        taken: list[list[Step]] = [[] for _ in range(slots)]
        for slot, one in list(running.items()):
            skipped = max(one.warming - one.reached, 0)
            taken[slot] = one.take(length)
            # Of images at times, events count in the step that keeps them.
            count += sum(
                len(step.events)
                for step in taken[slot][skipped:]
                if not way.at_times or step.time is None
            )
            for t, step in enumerate(taken[slot]):
                rows[t][slot], seen[t, slot] = step.events, not step.later
            valid[: len(taken[slot]), slot] = True
            times = [step.time for step in taken[slot]]
            sizes = [step.earlier + len(step.events) for step in taken[slot]]
            ends = one.ahead is None
            parts[slot] = Part(one, times, sizes, one.reached, one.pictures, ends)
            if ends:
                del running[slot]
        events = pack_for_devices(rows, devices, size)
        size = len(events.t) // devices
        looks = looks_of(taken, length) if way.at_times else None
        yield Chunk(events, count, valid, seen, looks, parts, starts)


def chunk_for(pixels: int) -> int:
    """The default number of windows per chunk: larger chunks have less overhead, but take more
    memory."""
    if jax.default_backend() != "cpu":
        return 16
    return 8 if pixels <= 2**16 else 4


def start(job: Job, way: Way, opened: dict[Path, Writer]) -> tuple[Running, Session]:
    """Opens the stream of a job's steps, after those that an interrupted run has finished."""
    # The writer first: its lock keeps other runs from the files that are read and removed here.
    writer = opened[job.output] = job.writer()
    running = Running(job, writer)
    try:
        whole, pixels = not splits(job, way), job.recording.pixels
        windows = cut(job.recording, job.windows, running.counting(job.events()), whole=whole)
        first, windows = warming(windows, pixels, job.warm_up)
        if job.times is None:
            entries = (Step(window.events, window.time, 1.0) for window in windows)
            if not whole:
                first = [part for step in first for part in in_parts(step, pixels)]
                entries = (part for step in entries for part in in_parts(step, pixels))
        else:
            running.counts, times = Counts(), copy.copy(job.times)  # a grid counts on
            entries = steps(job.recording, job.windows, times, windows, running.counts)
        running.steps, running.warming = itertools.chain(first, entries), len(first)
        running.reached, running.pictures, session = position(job, way)
        running.skip(running.reached)
        running.ahead = next(running.steps, None)
        if running.ahead is None and not running.reached:
            raise RecordingError(
                f"{job.recording.path}: no events, or none that the filters let pass"
                + lasting(job.recording)
            )
    except (RecordingError, SettingsError) as error:
        opened.pop(job.output).abandon()
        if isinstance(error, SettingsError):  # of the sensor's size
            raise RecordingError(f"{job.recording.path}: {error}") from error
        raise
    if running.reached and isinstance(writer, FolderWriter):
        writer.keep(running.pictures)
    return running, session


def splits(job: Job, way: Way) -> bool:
    """Whether dense windows are taken in parts: not if a step is to remember nothing, if windows
    overlap, as their events would come again, or if they only update the state, as they are then
    chosen for that alone."""
    network = way.network
    return (
        network.recurrent
        and not network.whole_windows
        and job.times is None
        and job.windows.step is None
    )


def lasting(recording: Recording) -> str:
    """ ": it lasts 3.2 s", nothing where it has no events"""
    ends = [(int(chunk.t[0]), int(chunk.t[-1])) for chunk in recording.events()]
    return f": it lasts {(ends[-1][1] - ends[0][0]) / 1e6:g} s" if ends else ""


def position(job: Job, way: Way) -> tuple[int, int, Session]:
    """(steps done, their pictures on disk, the state after them) of an interrupted run; (0, 0, the
    initial state) if there is none."""
    height, width = job.recording.height, job.recording.width
    initial = initial_session(1, height, width, way.network, way.at_times)
    initial = jax.tree.map(lambda leaf: leaf[0], initial)
    resume.remove_unpublished(job.output)
    saved = resume.read_position(job.output, job.record, way.overwrite)
    path = resume.position_file(job.output)
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


# ---- Compute


def computed(
    chunks: Iterator[Chunk], recording: Recording, way: Way, weights: Weights, slots: int,
    devices: int,
) -> Iterator[tuple[Chunk, np.ndarray]]:  # fmt: skip
    """Chunks -> each with its pictures (T, B, ...), on the host.

    An accelerator has the next chunk before the last one's pictures are fetched, so that it
    never waits. A CPU has not: it would gain nothing, and each chunk in flight holds memory.
    """
    height, width = recording.height, recording.width
    mesh = device_mesh(jax.local_devices()[:devices]) if devices > 1 else None
    weights = jax.device_put(weights, sharding(REPLICATED, mesh) if mesh else None)
    session = None
    sent = deque()
    in_flight = 1 if jax.default_backend() == "cpu" else 2
    kept = time.monotonic()
    for chunk in chunks:  # there may be none, of a sensor that does not suit the settings
        session = session or initial_session(slots, height, width, way.network, way.at_times)
        for slot, state in chunk.starts.items():
            session = _set_slot(session, slot, state)
        events = chunk.events
        if mesh:
            session = jax.device_put(session, sharding(BATCH, mesh))
            events = jax.tree.map(
                lambda a, spec: jax.device_put(a, sharding(spec, mesh)), events, PACKED_SPECS
            )
        session, shown = events_to_pictures(
            weights, session, events, chunk.valid, chunk.looks, chunk.seen, height=height,
            width=width, network=way.network, settings=way.display, preview=way.preview,
            rotated=way.rotated, raw=way.raw, mesh=mesh,
        )  # fmt: skip
        states = {}
        if time.monotonic() - kept > RESUME_EVERY:
            states = {
                slot: _get_slot(session, slot)
                for slot, part in chunk.parts.items()
                if isinstance(part.running.writer, FolderWriter) and part.pictures and not part.ends
            }
            kept = time.monotonic()
        sent.append((chunk, shown, states))
        if len(sent) == in_flight:
            yield _fetched(*sent.popleft())
    yield from (_fetched(*entry) for entry in sent)


def _fetched(chunk: Chunk, shown: jax.Array, states: dict) -> tuple[Chunk, np.ndarray]:
    # A state goes to disk from here, not with the pictures, so that none waits in memory.
    for slot, state in jax.device_get(states).items():
        part = chunk.parts[slot]
        arrays = {f"state{i}": leaf for i, leaf in enumerate(jax.tree.leaves(state))}
        job = part.running.job
        resume.keep_position(job.output, job.record, part.reached, part.pictures, **arrays)
    return chunk, jax.device_get(shown)


@jax.jit
def _set_slot(session: Session, slot, start: Session) -> Session:
    return jax.tree.map(lambda all, one: all.at[slot].set(one), session, start)


@jax.jit
def _get_slot(session: Session, slot) -> Session:
    return jax.tree.map(lambda all: all[slot], session)


# ---- Write


def write(part: Part, shown: np.ndarray, screen: Screen | None) -> int:
    """A part's pictures; returns how many. Where their state was kept, a run can go on from it."""
    running, count = part.running, 0
    if running.refused:
        return 0
    try:
        for image, at, events in zip(shown, part.times, part.counts, strict=False):
            if at is not None:
                running.writer.write(image, at, events)
                count += 1
                if screen:
                    screen.show(image, str(running.job.output))
    except RecordingError as error:  # the others of the batch go on
        running.refused = error
    running.written += count
    if isinstance(running.writer, FolderWriter) and not (part.ends or running.refused):
        running.writer.flush()
        resume.publish_position(running.job.output, part.reached)
    return count


def finish(running: Running, way: Way, outcome: Outcome) -> None:
    """Its last pictures are written: the output gets its name, unless the recording failed."""
    output, writer = running.job.output, running.writer
    if error := running.refused or running.error:
        outcome.failed[output] = error
        writer.abandon()
        return
    resume.done_file(output).unlink(missing_ok=True)
    noted = partial(resume.mark_done, output, running.job.record)
    writer.finish(noted if way.several else no_note)
    slower = writer.slower if isinstance(writer, VideoWriter) else None
    own = running.reached - running.warming
    each = own / max(running.pictures, 1) if running.job.times is None else 1.0
    outcome.done[output] = Done(running.job, running.written, running.events, each, slower)
