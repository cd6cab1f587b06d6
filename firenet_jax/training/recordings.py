"""Recordings with frames -> sequences to train on, and how well weights do on what is held out.

A recording becomes two files of the layout that `training.batches` reads, in the
folder of the run: its beginning to learn from, and its end, held out to judge by.

    RUN/sequences/NAME.h5                up to the frame with which the end begins
    RUN/sequences/validation/NAME.h5     from that frame on
    RUN/sequences/settings.json          which recordings, and how many windows are held out

Window t lasts from one frame to the next, as in `training.batches`, and frame t is the truth at its
end. Afterwards the weights before and after are judged on the held-out ends, as `firenet
reconstruct --frame-to-frame --whole-windows` shows them: whole images, of a state that is warm.
"""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from firenet_jax.checkpoint import load_weights
from firenet_jax.errors import CheckpointError, RecordingError, logger
from firenet_jax.evaluation import metrics
from firenet_jax.evaluation.comparison import Gap
from firenet_jax.evaluation.equalise import equalise
from firenet_jax.evaluation.protocol import first_event
from firenet_jax.events import Events, Frames, Recording, counted
from firenet_jax.network import Weights, initial_state
from firenet_jax.readers import is_recording, open_recording
from firenet_jax.reconstruction import reconstruct
from firenet_jax.storage import runs
from firenet_jax.storage.files import identity, write_text
from firenet_jax.storage.sequence_file import Picture, write_sequence
from firenet_jax.tensors import tensor_chunks
from firenet_jax.training.batches import is_set
from firenet_jax.training.settings import Train
from firenet_jax.training.step import near_events
from firenet_jax.windows import Windows, cut

HELD_OUT_SHARE = 5  # one window in five is held out, but at least as many as a training step has
JUDGED_BEFORE = 10_000_000  # microseconds before the held-out end at which judging begins
WINDOWS_AT_ONCE = 8  # windows that are judged at once


class Cut(NamedTuple):
    """A recording whose last frames are held out."""

    recording: Recording
    frames: Frames
    end: int  # the frame with which the held-out end begins; the first that is judged is the next

    def frame(self, number: int) -> np.ndarray:
        """(H, W) uint8. Raises RecordingError where its size is not that of the sensor."""
        found, height, width = self.frames.read(number), self.recording.height, self.recording.width
        if found.shape != (height, width):
            raise RecordingError(
                f"{self.recording.path}, frame {number + 1}: has {found.shape[1]}x{found.shape[0]} "
                f"pixels, the sensor {width}x{height}, expected the same"
            )
        return found


def cut_off(path: Path, windows: int) -> Cut:
    """A recording, of which the last fifth is held out, or as many windows as a step has.

    Raises RecordingError where it has no frames, too few of them for both parts, or no events in
    their time.
    """
    if path.is_dir() and not is_recording(path):
        if is_set(path):
            raise RecordingError(
                f"{path}: is a folder of HDF5 sequences, of which --data takes one, alone: put all "
                "sequences into one folder"
            )
        raise RecordingError(
            f"{path}: holds no HDF5 sequences, as `firenet simulate` makes them: name another "
            "folder, or recordings themselves"
        )
    recording = open_recording(path)
    frames = recording.frames
    if frames is None or len(frames.times) < 2:
        raise RecordingError(
            f"{path}: holds no frames to learn from: use a recording of a camera that takes "
            "pictures beside the events, or a folder of HDF5 sequences"
        )
    later = np.diff(frames.times) > 0
    if not later.all():
        frame = int(np.argmin(later)) + 1
        raise RecordingError(
            f"{path}, frame {frame + 1}: its time is {frames.times[frame]} us, not after "
            f"{frames.times[frame - 1]} us, that of the frame before: the file is damaged"
        )
    count = len(frames.times) - 1
    held = max(count // HELD_OUT_SHARE, windows)
    if count - held < windows + 1:  # a start is drawn from one place or more
        raise RecordingError(
            f"{path}: has {count + 1} frames, but {2 * windows + 2} are needed to learn from "
            f"{windows} windows in a row and to hold out as many: use a longer recording, or fewer "
            "--windows (and a smaller --l0)"
        )
    try:
        first_event(recording, frames.times)
    except Gap as gap:
        raise RecordingError(
            f"{path}: {gap}: use a recording whose frames are on the clock of its events"
        ) from gap
    found = Cut(recording, frames, count - held)
    found.frame(0)  # of another size than the sensor, most often all are
    return found


def check_fit(cuts: list[Cut], settings: Train) -> None:
    """Raises RecordingError where `training.batches` would, of what is not written yet."""
    for one in cuts:
        height, width = one.recording.height, one.recording.width
        if min(height, width) < settings.crop:
            raise RecordingError(
                f"{one.recording.path}: its frames have {width}x{height} pixels, fewer than the "
                f"crop of {settings.crop}x{settings.crop}: choose a smaller --crop"
            )
    longest, total = max(cuts, key=lambda one: one.end), settings.chain * settings.windows
    if longest.end < total:
        raise RecordingError(
            f"{longest.recording.path}: has {longest.end + 1} frames to learn from, the most of "
            f"{counted(len(cuts), 'recording')}, but {total} windows in a row need {total + 1}: "
            "ask for fewer --windows or a shorter --chain"
        )


def write_sequences(cuts: list[Cut], settings: Train) -> None:
    """The files of `settings.sequences`, those that are not there yet.

    Raises OutputError where the folder holds others, RecordingError for a recording that turns out
    to be of no use; that leaves no files, which would be in the way of other recordings.
    """
    folder = settings.sequences
    held = [len(one.frames.times) - 1 - one.end for one in cuts]
    named = [identity(path)[:2] for path in settings.data]  # name and size, which a copy has, too
    record = {"recordings": named, "held_out": held}
    with runs.alone_in(folder):
        way_out = "choose another --output"
        found = runs.read_record(folder / "settings.json", way_out)
        if found is not None:
            found["recordings"] = [one[:2] for one in found["recordings"]]  # of before: and times
            runs.check_same(found, record, f"{folder} holds sequences of others", way_out)
        write_text(folder / "settings.json", runs.as_text(record))
        runs.make_folder(folder / "validation")
        new = {path: part for path, part in _parts(cuts, folder).items() if not path.exists()}
        try:
            for path, part in new.items():
                _write(path, *part)
        except RecordingError:
            for path in (*new, *([folder / "settings.json"] if found is None else [])):
                path.unlink(missing_ok=True)
            raise


def _parts(cuts: list[Cut], folder: Path) -> dict[Path, tuple[Cut, int, int | None]]:
    """File: what `_write` writes into it."""
    found = {}
    for number, one in enumerate(cuts):
        # recordings of different folders may have one name
        name = f"{number:03d}_{one.recording.path.stem}.h5"
        found[folder / name] = one, 0, one.end
        found[folder / "validation" / name] = one, one.end, None
    return found


def _write(path: Path, one: Cut, first: int, last: int | None) -> None:
    """The frames first to last, the last one included, and the events between them; times count
    from the first of them, for as seconds since 1970 they would not be whole microseconds.

    Raises RecordingError where there are no events between them."""
    numbers = range(len(one.frames.times))[first : None if last is None else last + 1]
    zero, until = (int(one.frames.times[number]) for number in (numbers[0], numbers[-1]))
    flow = one.frames.flow or (lambda number: None)
    pictures = (Picture(int(one.frames.times[n]) - zero, one.frame(n), flow(n)) for n in numbers)
    count = write_sequence(
        path,
        _between(one.recording, zero, until),
        pictures,
        height=one.recording.height,
        width=one.recording.width,
        settings={"recording": str(one.recording.path), "zero": zero},
    )
    if not count:
        what = "held out" if last is None else "to learn from"
        raise RecordingError(
            f"{one.recording.path}: no events from {zero / 1e6:.6f} to {until / 1e6:.6f} s, "
            f"between the frames {what}: use a recording with events in both parts"
        )


def _between(recording: Recording, start: int, stop: int) -> Iterator[Events]:
    """The events with start <= t < stop, as t - start."""
    for events in recording.events():
        if len(events) and events.t[0] >= stop:
            return
        part = events.select(slice(*np.searchsorted(events.t, (start, stop))))
        if len(part):
            yield Events(part.t - start, part.x, part.y, part.p)


# ---- Judging


class Score(NamedTuple):
    """Means over the held-out frames."""

    frames: int
    ssim: float
    equalised: float  # SSIM after a histogram equalisation: events tell no absolute brightness


def print_scores(cuts: list[Cut], settings: Train) -> None:
    """One line a recording: SSIM of its held-out end before and after; not before, where a run went
    on without the weights that it began with."""
    before = None
    if settings.weights is not None:
        try:
            before = load_weights(settings.weights)
        except CheckpointError as error:
            logger.warning("%s", error)
    after = load_weights(settings.output / "weights.npz")
    where = " where events were" if settings.near_events else ""
    for one in cuts:
        new = judged(after, one, settings.near_events)
        if not new.frames:
            logger.warning("%s: no events before the frames held out", one.recording.path)
            continue
        ssim, equalised = f"{new.ssim:.3f}", f"{new.equalised:.3f}"
        if before is not None:
            old = judged(before, one, settings.near_events)
            ssim = f"{old.ssim:.3f} before, {ssim} after"
            equalised = f"{old.equalised:.3f}, {equalised}"
        print(
            f"{one.recording.path}: SSIM{where} of the {new.frames} frames held out {ssim} "
            f"(equalised: {equalised})"
        )


def judged(weights: Weights, one: Cut, near: bool) -> Score:
    """How close the images of the held-out end come to the frames at their time.

    near: only where events were since judging began, at most JUDGED_BEFORE before the end.
    """
    times = one.frames.times
    first = int(np.searchsorted(times, times[one.end] - JUDGED_BEFORE))
    windows = cut(one.recording, Windows(frame_to_frame=True), begin=int(times[first]))
    windows = itertools.islice(windows, len(times) - first - 1)
    state = initial_state(1, one.recording.height, one.recording.width)
    seen, scores, number = jnp.zeros((1, *state.g1.shape[:3]), bool), [], first + 1
    for group, tensors in tensor_chunks(one.recording, windows, WINDOWS_AT_ONCE):
        state, images = reconstruct(weights, state, tensors)
        near_now = near_events(tensors) | seen
        seen = near_now[-1:]
        later = [k for k in range(len(group)) if number + k > one.end]
        if later:
            truths = np.stack([one.frame(number + k) for k in later]) / np.float32(255)
            there = near_now[np.array(later), 0] if near else np.ones(truths.shape, bool)
            chosen = np.clip(images[np.array(later), 0], 0, 1)
            pairs = (chosen, truths), (equalise(chosen, "global"), equalise(truths, "global"))
            scores.append(np.stack([metrics.ssim_where(*pair, there) for pair in pairs], -1))
        number += len(group)
    found = np.concatenate([np.zeros((0, 2)), *scores])
    found = found[np.isfinite(found).all(1)]  # where no event was near, there is nothing to compare
    return Score(len(found), *map(float, found.mean(0) if len(found) else (np.nan, np.nan)))
