"""Random scenes, or a video file -> simulated events in HDF5 training sets, one sequence per file.

The layout is that of event_cnn_minimal, see `storage.sequence_file`. Files appear under their names
when they are complete, so an interrupted run resumes.
"""

import contextlib
import importlib.metadata
import itertools
import math
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from time import sleep
from typing import Annotated

import jax
import numpy as np
import tyro

from firenet_jax.devices import process_of
from firenet_jax.errors import OutputError, PictureError, SettingsError
from firenet_jax.events import Events, counted
from firenet_jax.settings import check_none_idle, check_seed, parse_size
from firenet_jax.simulation.clip import read_clip, warn_if_cut
from firenet_jax.simulation.scenes import (
    Scene,
    SceneSettings,
    flow,
    random_scene,
    rendering_times,
    video,
)
from firenet_jax.simulation.sensor import (
    FLICKER_INTERVAL,
    SensorSettings,
    check_idle,
    event_list,
    random_sensor,
    with_faults,
)
from firenet_jax.simulation.textures import load_textures, pictures_in
from firenet_jax.storage import runs
from firenet_jax.storage.files import (
    check_apart,
    check_no_pipe,
    partial_name,
    remove_left,
    write_text,
)
from firenet_jax.storage.overlap import prefetch
from firenet_jax.storage.progress import bar
from firenet_jax.storage.sequence_file import Picture, write_sequence
from firenet_jax.storage.video import followed

FLOW_BITS = 11  # of the fastest pixel's flow, see `rounded_flow`
SEQUENCES_PER_POOL = 32  # sequences that share a pool of textures
TEXTURES, TEXTURE_SIZE = 64, 320  # of a pool
MIN_SAMPLE = 8  # sequences whose mean size is a fair estimate of all sizes
LONGEST_SCENE = 60.0  # seconds; a scene's clock is float32, which by then ticks in 4 us
MOST_FPS = 10_000  # with more pictures a second, rounding shows in the flow from one to the next
PATIENCE = 600  # seconds that processes wait for the first one
CLIP_SUFFIXES = (".h5", ".hdf5")
# Settings that no sequence depends on.
UNRECORDED = ("output", "sequences", "validation", "video", "overwrite", "processes", "process")
OF_SCENES = ("sequences", "validation", "seconds", "fps", "images", "scene")  # not of a video


@dataclass(frozen=True)
class Simulate:
    """Simulate events, pictures and optical flow of random scenes, or events of a video, as HDF5.

    Examples:
      firenet simulate -o data/                                   (the paper's set: 950 and 50)
      firenet simulate -o data/ --images coco/train2017 --sequences 1000 --seconds 2
      firenet simulate -o data/ --sequences 40 --faults
      firenet simulate -o events.h5 --video clip.mp4
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """A folder, which gets the folders train/ and validation/; with --video a name that ends in
    .h5."""
    sequences: int = 1000
    """Number of sequences, including those for validation. With a larger number an earlier run is
    extended."""
    validation: int | None = None
    """How many of them are for validation (default: one in twenty, as in the paper)."""
    seconds: float = 2.0
    """Duration of each sequence."""
    fps: float = 50.0
    """Pictures per second, each with its optical flow."""
    sensor_size: str | None = None
    """WIDTHxHEIGHT (default: 240x180, or the size of the video)."""
    images: Path | None = None
    """Folder of pictures for the textures, of at least 160 pixels, but for five names that are held
    out to judge by, such as flower.jpg. Default: scikit-image's photographs, if it is installed,
    and procedural textures."""
    seed: int = 0
    """Random seed."""
    video: Path | None = None
    """Convert this video file into events instead. Log intensity is interpolated linearly between
    its pictures; there is no optical flow."""
    faults: bool = False
    """Simulate the faults of real sensors: mismatch, noise, leak, hot pixels, finite bandwidth. The
    options below take precedence (--noise 0 0: all but noise)."""
    overwrite: bool = False
    """With --video: replace an existing output."""
    processes: int | None = None
    """Number of processes, on one or more machines, that share the sequences. Default: as set by
    srun or mpirun."""
    process: int | None = None
    """Index of this process, from 0."""
    scene: SceneSettings = SceneSettings()
    sensor: SensorSettings = SensorSettings()

    def __post_init__(self):
        if not 0 < self.seconds <= LONGEST_SCENE:
            raise SettingsError(
                f"seconds is {self.seconds}, but a sequence lasts more than 0 and up to "
                f"{LONGEST_SCENE:g}: make more sequences instead"
            )
        if not 0 < self.fps <= MOST_FPS:
            raise SettingsError(f"fps is {self.fps}, but must be more than 0 and up to {MOST_FPS}")
        if self.sequences < 1:
            raise SettingsError(f"sequences is {self.sequences}, but must be 1 or more")
        if self.validation is not None and not 0 <= self.validation <= self.sequences:
            raise SettingsError(
                f"validation is {self.validation}, but must be between 0 and the number of "
                f"sequences, {self.sequences}"
            )
        check_seed(self.seed)
        parse_size(self.sensor_size)
        process_of(self.process, self.processes)
        check_idle(with_faults(self.sensor) if self.faults else self.sensor)
        if self.video is not None:
            names = [*OF_SCENES, "process", "processes"]
            check_none_idle(self, names, "turning a video into events")
            if self.sensor.flicker is not None:
                raise SettingsError(
                    "flicker: pictures of a video are too far apart to show it: leave it out"
                )
        else:
            check_none_idle(self, ["overwrite"], "simulating scenes, where an earlier run goes on")
            if self.seconds * self.fps < 1:
                raise SettingsError(
                    f"{self.seconds:g} s at {self.fps:g} images per second is a single image, of "
                    "no use in training and evaluation: ask for more --seconds or --fps"
                )


# ---- Sequences


def run(settings: Simulate) -> list[Path]:
    """Does what the settings say; returns the files, those of an earlier run included. Raises
    a FirenetError with a message of one sentence."""
    process, processes = process_of(settings.process, settings.processes)
    if settings.video is not None:  # which processes do not share
        return [] if process else [simulate_clip(settings, settings.video)]
    height, width = parse_size(settings.sensor_size or "240x180")
    if settings.images is not None:
        pictures_in(settings.images)  # before there is a folder
    folder = settings.output
    if folder.is_file() or folder.suffix in CLIP_SUFFIXES:
        raise OutputError(f"{folder}: sequences go into a folder: choose another name")
    if processes == 1:
        with runs.alone_in(folder):
            open_folder(settings)
            return write_sequences(settings, height, width)
    if process:
        _wait_for(folder / "settings.json")
    mine = folder / "running" / f"{process} of {processes}"
    with runs.side_by_side_in(folder):
        open_folder(settings)
        with runs.alone_in(mine):
            written = write_sequences(settings, height, width, process, processes)
    with contextlib.suppress(OSError):  # others are still there
        mine.rmdir()
        mine.parent.rmdir()
    return written


def _wait_for(path: Path) -> None:
    """The first of several processes begins the folder. Raises OutputError if it does not."""
    for _ in range(1 + 10 * PATIENCE):
        if path.is_file():
            return
        sleep(0.1)
    raise OutputError(
        f"{path} is not there after {PATIENCE} s: start process 0 too, and look at it"
    )


def write_sequences(
    settings: Simulate, height: int, width: int, process: int = 0, processes: int = 1
) -> list[Path]:
    """Writes those that are not in the folder yet; of several processes, this one's share."""
    sensor = with_faults(settings.sensor) if settings.faults else settings.sensor
    record = describe(settings)
    held_out = settings.sequences // 20 if settings.validation is None else settings.validation
    split = {"train": settings.sequences - held_out, "validation": held_out}
    work = [
        (settings.output / name / f"{number:06d}.h5", part, number)
        for part, (name, count) in enumerate(split.items())
        for number in range(count)
    ]
    for name, count in split.items():
        there = len(list((settings.output / name).glob("??????.h5")))
        if there > count:
            raise OutputError(
                f"{settings.output / name} holds {there} sequences already, but these settings "
                f"want {count}: ask for as many --sequences and --validation or more"
            )
    work = work[process::processes]
    # Of a run that was killed; other processes are at work on theirs.
    own = [partial_name(path) for path, *_ in work]
    all_left = (path for name in split for path in (settings.output / name).glob("*.partial.h5"))
    for left in own if processes > 1 else all_left:
        remove_left(left)
    missing = [entry for entry in work if not entry[0].exists()]
    events = used = 0
    there = len(work) - len(missing)
    with bar(len(work), "seq", initial=there, smoothing=0.05) as progress:
        for done, (path, part, number) in enumerate(missing):
            if done:
                # The first few sequences say little about the size of all.
                rest = len(missing) - done
                expected = rest if done >= MIN_SAMPLE else min(rest, MIN_SAMPLE)
                _check_room(settings.output, processes * used / done * expected)  # all share it
            key = jax.random.key(settings.seed)
            for fold in (part, number):
                key = jax.random.fold_in(key, fold)
            textures = _textures(settings.images, settings.seed, part, number // SEQUENCES_PER_POOL)
            events += write_sequence(
                path,
                *sequence(key, textures, settings, sensor, height, width),
                height=height,
                width=width,
                source="esim",
                settings=record | {"part": path.parent.name, "number": number},
            )
            used += path.stat().st_size
            progress.update()
            mean = used / (done + 1)
            progress.set_postfix_str(
                f"{in_words(mean)} each, {in_words(mean * len(work))} in all", refresh=False
            )
    print(
        f"{settings.output}: {in_parts(split)}, {settings.seconds:g} s each at "
        f"{width}x{height}; new: {len(missing)}, {events:,} events, {in_words(used)}"
    )
    return [path for path, *_ in work]


def in_parts(split: dict[str, int]) -> str:
    """ "40 sequences for training and 2 for validation" """
    held = "" if split["validation"] else " (training holds out one in twenty, at least one)"
    return (
        f"{counted(split['train'], 'sequence')} for training and {split['validation']} for "
        f"validation{held}"
    )


@lru_cache(maxsize=1)
def _textures(images: Path | None, seed: int, part: int, pool: int) -> jax.Array:
    """What sequences of one pool choose their textures from, (TEXTURES, S, S)."""
    seed = int(np.random.SeedSequence([seed, part, pool]).generate_state(1)[0])
    return jax.numpy.asarray(load_textures(images, TEXTURES, TEXTURE_SIZE, seed))


def sequence(
    key: jax.Array,
    textures: jax.Array,
    settings: Simulate,
    sensor: SensorSettings,
    height: int,
    width: int,
) -> tuple[Iterator[Events], Iterator[Picture]]:
    """One random scene before one random sensor: its events, and its pictures with flow."""
    scene_key, sensor_key = jax.random.split(key)
    size = {"height": height, "width": width}
    scene = random_scene(
        scene_key, textures, duration=settings.seconds, settings=settings.scene, **size
    )
    camera = random_sensor(sensor_key, settings=sensor, **size)
    count = math.floor(settings.seconds * settings.fps + 1e-6) + 1
    times = np.round(np.arange(count) * 1e6 / settings.fps).astype(np.int64)
    times = times[times <= round(1e6 * settings.seconds)]
    bounds = np.append(times, round(1e6 * settings.seconds))
    longest = {} if camera.lamp is None else {"longest": FLICKER_INTERVAL}
    renderings = video(scene, rendering_times(scene, bounds, **longest, **size), **size)
    events = prefetch(event_list(camera, renderings), depth=64)
    return events, prefetch(_pictures(scene, times, settings.fps, height, width), depth=4)


def _pictures(scene: Scene, times: np.ndarray, fps: float, height, width) -> Iterator[Picture]:
    size = {"height": height, "width": width}
    for time, image in video(scene, times, **size):
        displacement, _ = flow(scene, 1e-6 * time - 1 / fps, 1e-6 * time, **size)
        velocity = np.moveaxis(np.asarray(displacement) * np.float32(fps), -1, 0)
        grey = np.round(np.clip(255 * np.asarray(image), 0, 255)).astype(np.uint8)
        yield Picture(time, grey, rounded_flow(velocity))


def rounded_flow(velocity: np.ndarray) -> np.ndarray:
    """Rounds to 1/2048 of the fastest pixel's flow (up to a power of two), still float32.

    The last bits of a float are noise, which does not compress: rounded flow takes a quarter of
    the room. 10 pixels of motion then are wrong by at most 0.004.
    """
    peak = float(np.abs(velocity).max())
    if not 0 < peak < np.inf:
        return np.asarray(velocity, np.float32)
    step = 2.0 ** (math.ceil(math.log2(peak)) - FLOW_BITS)
    # + 0.0 turns -0 into 0, which compresses better
    return (np.round(velocity / np.float32(step)) * np.float32(step) + 0.0).astype(np.float32)


# ---- Folders


def describe(settings: Simulate) -> dict:
    """All that a sequence depends on, apart from its number; ready for JSON."""
    return runs.recorded(
        settings,
        but=UNRECORDED,
        images=None if settings.images is None else settings.images.resolve(),
        sensor_size="{1}x{0}".format(*parse_size(settings.sensor_size or "240x180")),
        version=importlib.metadata.version("firenet-jax"),
    )


def open_folder(settings: Simulate) -> None:
    """Finds that the folder is new or one to go on with; else raises OutputError."""
    folder, record = settings.output, describe(settings)
    kept = folder / "settings.json"
    found = runs.read_record(kept, "choose another output")
    if found is None and any(folder.iterdir()):
        raise OutputError(
            f"{folder} is not empty, and holds no settings.json of an earlier run: choose another "
            "output"
        )
    empty = not next(folder.glob("*/??????.h5"), None)
    if found is not None and empty and not {"version", "scene"} <= found.keys() <= record.keys():
        others = found.keys() - record.keys()
        said = f" (it says {min(others)})" if others else ""
        raise OutputError(f"{kept} is of something else{said}: choose another output")
    if found is not None and not empty:
        runs.check_same(
            found, record, f"{folder} holds sequences of other settings",
            "choose another output, or go on with the same settings",
        )  # fmt: skip
    if found is None or runs.differences(found, record):  # first: folders alone are anyone's
        write_text(kept, runs.as_text(record) + "\n")
    for name in ("train", "validation"):
        runs.make_folder(folder / name)


def in_words(size: float) -> str:
    """Bytes -> "2.1 GB", or MB where that would be less than one."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.1f} MB"


def _check_room(folder: Path, needed: float) -> None:
    """Raises OutputError if so many bytes do not fit on the disk."""
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise OutputError(
            f"{folder}: the rest needs about {in_words(needed)}, but only {in_words(free)} "
            "are free: make room or ask for fewer --sequences; a further run goes on from here"
        )


# ---- Video files


def simulate_clip(settings: Simulate, clip: Path) -> Path:
    """A video file -> events and its pictures, as one file; returns its name."""
    path = followed(settings.output)
    if path.suffix not in CLIP_SUFFIXES:
        raise OutputError(f"{path}: with --video the output is one file: name it {path}.h5")
    check_no_pipe(clip, PictureError)
    check_apart(path, [clip])
    if path.is_dir() or (path.exists() and not settings.overwrite):
        raise OutputError(f"{path} exists: choose another output or pass --overwrite")
    runs.make_folder(path.parent)
    size = parse_size(settings.sensor_size)
    pictures = list(itertools.islice(read_clip(clip, size), 2))
    if len(pictures) < 2:
        raise PictureError(
            f"{clip}: holds fewer than two pictures, so no change: name a video file"
        )
    height, width = pictures[0].image.shape
    sensor = with_faults(settings.sensor) if settings.faults else settings.sensor
    sides = {"height": height, "width": width}
    camera = random_sensor(jax.random.key(settings.seed), settings=sensor, **sides)
    last = 0

    def renderings():
        nonlocal last
        # The sensor takes log intensity as linear between two renderings: these are the pictures.
        with bar(None, "pictures") as progress:
            for picture in read_clip(clip, size):
                yield (last := picture.time), picture.image.astype(np.float32) / 255
                progress.update()

    record = {k: v for k, v in describe(settings).items() if k not in OF_SCENES}
    record |= {"video": clip.name, "sensor_size": f"{width}x{height}"}
    events = prefetch(event_list(camera, renderings()), depth=4)
    count = write_sequence(path, events, read_clip(clip, size), settings=record, **sides)
    warn_if_cut(clip, last)
    print(f"{path}: {count:,} events of {width}x{height} pixels")
    return path
