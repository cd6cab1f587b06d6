"""A folder of HDF5 sequences -> batches for training, of the same type as `sequences.simulate`.

The files have the layout of event_cnn_minimal (see `storage.sequence_file`), which the data sets of
event_cnn_minimal and ssl_e2vid use, and which `firenet simulate` writes. Window t of a batch
lasts from one image of a file to the next, start <= time < end; these two times are its t_min and
t_max in Eq. 1 (see `tensors`). `images[t]` is the image at its end. The displacement is the flow
stored with that image times the window's duration, so that `warp(images[t - 1], displacement[t])`
is `images[t]` where `visible[t]`. Without flow in the file nothing is visible, and the temporal
loss is 0.

Batch n depends only on the files, the settings, the seed and n, so a resumed run continues exactly.
Threads read ahead; events become tensors on the device.
"""

import hashlib
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import grain
import jax
import jax.numpy as jnp
import numpy as np

from firenet_jax.errors import RecordingError, logger
from firenet_jax.events import BINS, Events, checked, concatenate, counted, event_number
from firenet_jax.readers import frame_times, in_chunks, to_events, to_frame
from firenet_jax.readers.hdf5 import check_stored, in_order, opened
from firenet_jax.settings import check_share, check_sizes
from firenet_jax.simulation.sequences import Simulation
from firenet_jax.storage.files import files_in
from firenet_jax.tensors import Packed, pack, voxelise
from firenet_jax.warp import warp

SUFFIXES = (".h5", ".hdf5")
FILES_PER_VALIDATION = 20  # one file in twenty is for validation, as in the paper
THREADS, AHEAD = 2, 4  # reading threads and waiting batches; HDF5 runs one thread at a time


@dataclass(frozen=True)
class Augment:
    """Augmentation of sequences, besides cropping. Pauses and hot pixels as in the training of
    FireNet+ (Stoffregen et al. 2020). Contrast thresholds vary in the data sets themselves.
    """

    flip: float = 0.5
    """Probability of a horizontal flip and, independently, of a vertical flip."""
    pauses: float = 0.05
    """Probability that the camera stops: a window without events, and the same image again."""
    stay: float = 0.9
    """Probability that the pause continues for another window."""
    hot_pixels: float = 1e-3
    """Greatest share of hot pixels, to which a standard normal number is added in all bins."""
    voxel_noise: float = 0.0
    """Standard deviation of normal noise in all entries of the tensors, including pauses. FireNet+
    used 0.1 without normalisation; with normalisation a pause would become noise of deviation 1."""

    def __post_init__(self):
        for name in ("flip", "pauses", "stay", "hot_pixels"):
            of = "pixels" if name == "hot_pixels" else "windows"
            check_share(name, getattr(self, name), of)
        check_sizes(self, "voxel_noise", zero=True)


NO_AUGMENT = Augment(flip=0.0, pauses=0.0, hot_pixels=0.0, voxel_noise=0.0)
"""For validation."""


# ---- Files


def find(folder: Path) -> list[Path]:
    """All HDF5 files in a folder and the folders in it, sorted by name.

    Raises RecordingError where there is no such folder, or none of them in it.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise RecordingError(f"{folder}: there is no such folder: name one with HDF5 sequences")
    files = sorted(path for path in files_in(folder) if path.suffix.lower() in SUFFIXES)
    files = [path for path in files if not path.stem.endswith(".partial")]  # of a run that goes on
    if not files:
        raise RecordingError(
            f"{folder}: holds no {' or '.join(SUFFIXES)} files: make some with "
            f"firenet simulate -o {folder}"
        )
    return files


def is_set(path: Path) -> bool:
    """Whether this is a folder of sequences rather than a recording."""
    return path.is_dir() and any(file.suffix.lower() in SUFFIXES for file in files_in(path))


def split(folder: Path) -> tuple[list[Path], list[Path]]:
    """A folder -> files for training, files for validation; both sorted, neither empty.

    Those in folder/validation are for validation (`firenet simulate` writes them there). Where
    there are none, one in twenty is, at least one: those whose names have the smallest hashes, so
    that the choice depends on nothing else.
    Raises RecordingError as `find` does, and where no file is left for training.
    """
    files = find(folder)
    names = {path: path.relative_to(folder).as_posix() for path in files}
    held = [path for path in files if names[path].startswith("validation/")]
    if not held:
        order = sorted(files, key=lambda path: hashlib.sha256(names[path].encode()).digest())
        held = sorted(order[: max(1, len(files) // FILES_PER_VALIDATION)])
    kept = [path for path in files if path not in set(held)]
    if not kept:
        raise RecordingError(
            f"{folder}: holds no sequence for training beside {len(held)} for validation: two "
            "files or more are needed"
        )
    return kept, held


class Facts(NamedTuple):
    """What must be known of a file before the first batch."""

    path: Path
    images: int
    height: int
    width: int


class Index(NamedTuple):
    """Where the windows of a file are."""

    names: list[str]  # F, of the images
    times: np.ndarray  # (F,) int64 microseconds
    rows: np.ndarray  # (F,) int64, events before each image


def _facts(path: Path) -> Facts:
    with opened(path) as file:
        images = file.get("images", {})
        count = len(images)
        if count < 2:
            raise RecordingError(
                f"{path}: holds {count} images, but training needs 2 or more, with the "
                "events between them: take the file out of the folder"
            )
        for name in ("xs", "ys", "ts", "ps"):
            check_stored(path, file["events"][name])
        height, width = images[next(iter(images))].shape[:2]
        sensor = tuple(int(side) for side in file.attrs.get("sensor_resolution", (height, width)))
    if len(sensor) < 2:
        raise RecordingError(
            f"{path}: its sensor_resolution has {counted(len(sensor), 'number')}, expected height "
            "and width: take the file out of the folder"
        )
    if sensor[:2] != (height, width):
        raise RecordingError(
            f"{path}: its images have {width}x{height} pixels, its events {sensor[1]}x{sensor[0]}, "
            "expected the same: take the file out of the folder"
        )
    return Facts(path, count, height, width)


def _index(path: Path) -> Index:
    with opened(path) as file:
        images, stamps = file["images"], file["events/ts"]
        names = in_order(images)
        times = np.array([images[name].attrs["timestamp"] for name in names])
        if times.size == len(names):  # MATLAB writes arrays of one
            times = times.reshape(-1)
        if not (np.diff(times) > 0).all():  # in this form NaN fails too
            image = int(np.argmin(np.diff(times) > 0)) + 1
            raise RecordingError(
                f"{path}, image {image}: its time is {times[image]}, not after {times[image - 1]}, "
                "that of the image before: the file is damaged or of another format"
            )
        times, rows = frame_times(path, times), np.zeros(len(names), np.int64)
        # Not the attribute event_idx: programs differ in what it counts, by one.

        def columns(part: slice):
            return stamps[part], *np.zeros((3, part.stop - part.start), np.int16)  # only times

        for events in checked(in_chunks(path, columns, len(stamps)), path, None, None):
            rows += np.searchsorted(events.t, times)
        if len(stamps) and rows[0] == rows[-1]:  # a file without any events is of a still camera
            raise RecordingError(
                f"{path}: none of its {counted(len(stamps), 'event')} is between its images, from "
                f"{times[0] / 1e6:.6f} to {times[-1] / 1e6:.6f} s: they are not on one clock; take "
                "the file out of the folder"
            )
    return Index(names, times, rows)


# ---- Examples


class Example(NamedTuple):
    """T windows of one file, cropped and flipped; S is the crop."""

    events: list[Events]  # T
    bounds: np.ndarray  # (T, 2) int64 microseconds
    images: np.ndarray  # (T, S, S) uint8
    displacement: np.ndarray  # (T, S, S, 2) float32; NaN: not known


def _example(
    rng: np.random.Generator,
    facts: Facts,
    index: Index,
    augment: Augment,
    *,
    windows: int,
    crop: int,
    chain: int,
    part: int,
) -> Example:
    """Part `part` of a random run of chain x windows windows; `rng` is the same for all parts."""
    total = chain * windows
    start = rng.integers(facts.images - total)
    top, left = rng.integers((facts.height - crop + 1, facts.width - crop + 1))
    down, across = rng.random(2) < augment.flip
    paused = _pauses(rng.random(total), augment)
    ends = start + np.cumsum(~paused)  # the image at the end of each window
    mine = slice(part * windows, (part + 1) * windows)
    paused, ends = paused[mine], ends[mine]
    starts = np.where(paused, ends, ends - 1)

    cut = np.s_[..., top : top + crop, left : left + crop]
    turn = np.s_[..., :: -1 if down else 1, :: -1 if across else 1]
    sign = np.array([-1 if across else 1, -1 if down else 1], np.float32)
    shape = facts.height, facts.width
    images, displacements = {}, {}
    with opened(facts.path) as file:
        rows = slice(*index.rows[[starts[0], ends[-1]]])
        events = _cropped(_read_events(file, facts, rows), top, left, crop, down, across)
        for end in np.unique(ends):
            name = index.names[end]
            picture = file["images"][name]
            channels = picture.shape[2:] if picture.size > 4 * math.prod(shape) else ()
            _check_shape(facts.path, name, (*picture.shape[:2], *channels), shape)  # not read yet
            image = to_frame(_whole(facts.path, picture), facts.path)
            images[end] = image[cut][turn]
        for end in ends[~paused]:
            name = index.names[end].replace("image", "flow")
            moved = np.full((2, crop, crop), np.nan, np.float32)
            if name in file.get("flow", ()):
                _check_shape(facts.path, name, file["flow"][name].shape, (2, *shape))
                velocity = _whole(facts.path, file["flow"][name])  # pixels per second
                seconds = np.float32(1e-6 * (index.times[end] - index.times[end - 1]))
                moved = seconds * velocity[cut][turn].astype(np.float32)
            displacements[end] = sign * np.moveaxis(moved, 0, -1)

    still = np.zeros((crop, crop, 2), np.float32)
    bounds = index.times[np.stack([starts, ends], 1)]
    places = np.searchsorted(events.t, bounds)
    return Example(
        [events.select(slice(*place)) for place in places],
        bounds,
        np.stack([images[end] for end in ends]),
        np.stack([still if p else displacements[end] for p, end in zip(paused, ends, strict=True)]),
    )


def _pauses(numbers: np.ndarray, augment: Augment) -> np.ndarray:
    """(N,) uniform random numbers -> (N,) bool, where the camera stands still; never in the first
    window, before which the network has seen nothing."""
    paused = np.zeros(len(numbers), bool)
    for n in range(1, len(numbers)):
        paused[n] = numbers[n] < (augment.stay if paused[n - 1] else augment.pauses)
    return paused


def _read_events(file: Any, facts: Facts, rows: slice) -> Events:
    columns = (file["events"][name][rows] for name in ("ts", "xs", "ys", "ps"))
    events = to_events(facts.path, rows.start, *columns)
    right = checked(
        [events], facts.path, facts.height, facts.width, lambda row: event_number(rows.start + row)
    )
    return concatenate([*right] or [Events.empty()])


def _cropped(events: Events, top, left, crop: int, down, across) -> Events:
    x, y = events.x - left, events.y - top
    inside = (0 <= x) & (x < crop) & (0 <= y) & (y < crop)
    x, y = x[inside], y[inside]
    return Events.of(
        events.t[inside],
        crop - 1 - x if across else x,
        crop - 1 - y if down else y,
        events.p[inside],
    )


def _whole(path: Path, data: Any) -> np.ndarray:
    check_stored(path, data)
    return data[()]


def _check_shape(path: Path, name: str, found: tuple[int, ...], expected: tuple[int, ...]) -> None:
    if found != expected:
        raise RecordingError(
            f"{path}, {name}: has the shape {found}, expected {expected}: the file is "
            "damaged or of another format"
        )


# ---- Batches


class Batch(NamedTuple):
    """B examples on the host. The length of `packed` is one of a few, all else is of fixed shape:
    nothing recompiles as data flows."""

    packed: Packed
    images: np.ndarray  # (T, B, S, S) uint8
    displacement: np.ndarray  # (T, B, S, S, 2) float32; NaN: not known
    numbers: np.ndarray  # (B,) uint32, of the examples since the start of training
    part: np.ndarray  # () int32, of the chain


def batches(
    files: Sequence[Path],
    *,
    batch: int,
    windows: int,
    crop: int,
    chain: int = 1,
    augment: Augment = Augment(),
    seed: int = 0,
    first: int = 0,
) -> "grain.DatasetIterator[Simulation]":
    """HDF5 files -> batches without end, each a Simulation of T = windows, B = batch and
    H = W = crop, on the device.

    chain: so many batches in a row go on with the same sequences, each where the last ended.
    seed: 0 or more, below 2^32. first: the number of the first batch, to go on with a run; the
    iterator's own get_state and set_state do so too (among iterators of one `first`).

    A file with N windows gives N // (chain windows) examples to each pass over the files, every
    pass in another order; where in the file they start and what they show of it is random.
    Raises RecordingError in one sentence, here for files without images or smaller than the crop
    and where all are too short, while iterating for what is damaged. Files that are too short are
    left out, with a warning.
    """
    examples = _long_enough(files, crop, chain * windows)
    index = cache(_index)  # of all files: 2 kB each
    order: Any = grain.MapDataset.range(len(examples)).shuffle(seed=seed).repeat()

    def load(n: int) -> Batch:
        numbers = n // chain * batch + np.arange(batch)
        loaded = []
        for number in numbers.tolist():
            entry = examples[order[number]]
            rng = np.random.default_rng((seed, number))
            loaded.append(
                _example(
                    rng, entry, index(entry.path), augment,
                    windows=windows, crop=crop, chain=chain, part=n % chain,
                )
            )  # fmt: skip
        return Batch(
            pack(
                list(zip(*(example.events for example in loaded), strict=True)),
                bounds=np.stack([example.bounds for example in loaded], 1),
            ),
            np.stack([example.images for example in loaded], 1),
            np.stack([example.displacement for example in loaded], 1),
            numbers.astype(np.uint32),
            np.array(n % chain, np.int32),
        )

    return iter(
        grain.MapDataset.range(first, sys.maxsize)
        .map(load)
        .to_iter_dataset(grain.ReadOptions(num_threads=THREADS, prefetch_buffer_size=AHEAD))
        .map(partial(_simulation, jax.random.key(seed), augment=augment))
    )


def _long_enough(files: Sequence[Path], crop: int, total: int) -> list[Facts]:
    """Each file as often as so many windows in a row fit into it. Raises RecordingError."""
    facts = [_facts(path) for path in files]
    for path, _, height, width in facts:
        if min(height, width) < crop:
            raise RecordingError(
                f"{path}: its images have {width}x{height} pixels, fewer than the crop of "
                f"{crop}x{crop}: choose a smaller --crop"
            )
    examples = [entry for entry in facts for _ in range((entry.images - 1) // total)]
    if not examples:
        longest = max(facts, key=lambda entry: entry.images)
        raise RecordingError(
            f"{longest.path}: has {longest.images} images, the most of {len(facts)} files, but "
            f"{total} windows in a row need {total + 1}: ask for fewer --windows or a shorter "
            "--chain"
        )
    short = sum(entry.images <= total for entry in facts)
    if short:
        logger.warning(
            "%d of %d files are left out: they have fewer than %d images",
            short, len(facts), total + 1,
        )  # fmt: skip
    return examples


@partial(jax.jit, static_argnames="augment")
def _simulation(key: jax.Array, batch: Batch, augment: Augment) -> Simulation:
    """Adds hot pixels and noise to the tensors; finds where the displacement can be used."""
    images = jnp.asarray(batch.images, jnp.float32) / 255
    steps, _, height, width = images.shape
    tensors = voxelise(batch.packed, height=height, width=width)

    def faults(number):
        """What is added to the tensors of an example, (T, H, W, bins); hot pixels last a chain."""
        share_key, place_key, value_key, noise_key = jax.random.split(
            jax.random.fold_in(key, number), 4
        )
        share = augment.hot_pixels * jax.random.uniform(share_key)
        hot = jax.random.uniform(place_key, (height, width)) < share
        values = jnp.where(hot, jax.random.normal(value_key, (height, width)), 0.0)
        added = jnp.broadcast_to(values[None, :, :, None], (steps, height, width, BINS))
        if augment.voxel_noise:
            noise_key = jax.random.fold_in(noise_key, batch.part)
            added += augment.voxel_noise * jax.random.normal(noise_key, added.shape)
        return added

    if augment.hot_pixels or augment.voxel_noise:
        tensors += jax.vmap(faults, out_axes=1)(batch.numbers)
    known = jnp.isfinite(batch.displacement).all(-1)
    displacement = jnp.where(known[..., None], batch.displacement, 0.0)
    _, inside = warp(images, displacement)
    return Simulation(tensors, images, displacement, known & inside)
