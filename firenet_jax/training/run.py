"""Settings -> weights: a run in a folder, which can be interrupted and resumed.

Step n is a function of the seed, n and the state alone (`step`), so an interrupted and resumed run
equals an uninterrupted one. A run is a folder:

    settings.json     the settings
    log.jsonl         one line per logged step: losses, seconds
    tensorboard/      the same as curves, and the pictures
    pictures/         of each validation: events, image, truth
    checkpoints/      the whole state (orbax), the newest two
    weights.npz       the parameters with the least validation loss so far
    last.npz          those of the last validation, or of where Ctrl-C stopped it
"""

import contextlib
import hashlib
import itertools
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp
from jax.experimental import multihost_utils

from firenet_jax.checkpoint import BUILT_IN, digest, load_weights
from firenet_jax.devices import TIME_BATCH, is_first, join, replicated, sharding
from firenet_jax.errors import CheckpointError, FirenetError, OutputError, SettingsError, logger
from firenet_jax.network import Weights, initial_params
from firenet_jax.simulation.sequences import Simulation
from firenet_jax.simulation.textures import load_textures, pictures_in
from firenet_jax.storage import runs
from firenet_jax.storage.files import locked, write_text
from firenet_jax.storage.progress import bar, one_done
from firenet_jax.training.batches import NO_AUGMENT, batches, find, split
from firenet_jax.training.log import Log, entries
from firenet_jax.training.settings import Train
from firenet_jax.training.step import (
    TEXTURE,
    TrainState,
    initial_train_state,
    simulated,
    train_step,
    validate,
)

VALIDATION = 8  # batches
WRITTEN = "log.jsonl", "weights.npz", "last.npz"  # in a folder without a run they are another's
UNRECORDED = "log_every", "save_every", "validate_every"  # do not affect what is computed


def run(
    settings: Train, stop: int | None = None, prepare: Callable[[], None] = lambda: None
) -> None:
    """Trains as the settings say, or resumes an interrupted run.

    stop: end after this many steps, in the middle of the schedule. prepare: makes the data; called
    when devices, weights and folder are known to be right, so that a refused start makes none.
    Raises a FirenetError if the settings do not match the folder, the weights or the devices, or if
    another run writes into the folder.
    """
    join(settings.coordinator, settings.processes, settings.process)
    _check_devices_and_data(settings)
    folder = settings.output
    _check_folder(folder, settings)
    state = first_state(_without_what_is_saved(settings))
    options = ocp.CheckpointManagerOptions(max_to_keep=2)
    with (
        locked(folder) if is_first() else contextlib.nullcontext(),  # the others do not write
        ocp.CheckpointManager((folder / "checkpoints").absolute(), options=options) as saved,
    ):
        if saved.latest_step() is not None:
            state = restored(saved, state)
            _say_how_far(folder, int(state.step), settings.steps)
        else:
            _check_nothing_is_lost(folder, settings)
        prepare()
        done = begun = int(state.step)
        sources, validation = sources_of(settings, done)
        _keep_settings(folder, settings)  # only now, so that a failed start leaves no run behind
        log = Log(folder, done)
        kept = (folder / "weights.npz").exists()
        best, last_save = log.best() if kept else math.inf, time.monotonic()
        last = min(settings.steps, stop or settings.steps)
        with (
            contextlib.closing(log),
            bar(last, "step", quiet=not is_first(), initial=done) as progress,
            _interruptible() as interrupted,
        ):
            while done < last and not interrupted:
                state, terms = train_step(state, next(sources), settings.step_settings)
                done += 1
                one_done(progress, first=done == begun + 1)
                if done % settings.log_every == 0 or done == last:
                    terms = log.write(done, "train", terms)
                    progress.set_postfix(loss=f"{terms['loss']:.3f}", refresh=False)
                    _check_finite(state, folder)
                if done % settings.validate_every == 0 or done == last:
                    best = _judge(done, state, validation, settings, log, best)
                if done == last or (done % settings.log_every == 0 and _due(last_save, settings)):
                    saved.save(done, args=ocp.args.StandardSave(state))
                    last_save = time.monotonic()
            if interrupted and saved.latest_step() != done:
                saved.save(done, args=ocp.args.StandardSave(state))
            log.keep("last.npz", _weights(state))  # after Ctrl-C, too
    if interrupted:
        raise KeyboardInterrupt(f"step {done} is saved: the same command goes on from there")
    if is_first():
        _say_result(folder, done, best)


def _without_what_is_saved(settings: Train) -> Train:
    """The settings without weights to begin with, where a checkpoint has all that came of them: by
    now they may be gone."""
    saved = (settings.output / "checkpoints").glob("*")
    return replace(settings, weights=None) if any(p.name.isdecimal() for p in saved) else settings


def _say_result(folder: Path, done: int, best: float) -> None:
    if (weights := folder / "weights.npz").exists():
        print(f"{weights}: best validation loss {best:.4f} in {done} steps")
    else:
        print(f"{folder / 'last.npz'}: after {done} steps; the best, weights.npz, is gone")


def _say_how_far(folder: Path, done: int, steps: int) -> None:
    said = f"going on after step {done}" if done < steps else f"its {done} steps are done"
    logger.warning("%s: %s", folder, said)


def restored(saved: ocp.CheckpointManager, state: Any) -> Any:
    """The newest checkpoint, as a tree of the same shapes as `state`.

    Raises CheckpointError for one that is damaged.
    """
    newest = saved.latest_step()
    before = [step for step in saved.all_steps() if step != newest]
    way_out = (
        f"remove it, and the run goes on after step {max(before)}"
        if before
        else "it is the only one: choose another --output, with --weights to begin with its weights"
    )
    try:
        return saved.restore(newest, args=ocp.args.StandardRestore(state))
    except Exception as error:  # damaged bytes raise every kind of orbax, tensorstore and JSON
        reason = " ".join(str(error).split())[:100]
        raise CheckpointError(
            f"{saved.directory / str(newest)} is damaged ({type(error).__name__}: {reason}): "
            + way_out
        ) from error


def _judge(
    done: int,
    state: TrainState,
    validation: list[Callable[[], Simulation]],
    settings: Train,
    log: Log,
    best: float,
) -> float:
    """Validates and keeps the weights; the best validation loss so far."""
    results = [validate(state.params, make(), settings.step_settings) for make in validation]
    means = jax.tree.map(lambda *scores: np.mean(scores), *(r[0] for r in results))
    means = log.write(done, "validation", means)
    log.show(done, results[0][1])
    weights = _weights(state)
    if means["loss"] < best:
        log.keep("weights.npz", weights)
    log.keep("last.npz", weights)
    return min(best, means["loss"])


def _weights(state: TrainState) -> Weights:
    return Weights(jax.tree.map(np.asarray, jax.device_get(state.params)), normalise=True)


@contextlib.contextmanager
def _interruptible():
    """A list that is no longer empty after Ctrl-C; a second Ctrl-C interrupts at once.

    So a step is never left half done. As Python handles a signal only when the step is over, a
    thread says meanwhile that it has come. With several processes, which would not save at the same
    step, and outside of the main thread, the first Ctrl-C interrupts at once."""
    pressed: list[int] = []
    if jax.process_count() > 1 or threading.current_thread() is not threading.main_thread():
        yield pressed
        return

    def once(number, frame):
        pressed.append(number)
        signal.signal(signal.SIGINT, before)

    before = signal.signal(signal.SIGINT, once)
    try:
        with _said_at_once("ends with this step and saves it; Ctrl-C again ends without"):
            yield pressed
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def _said_at_once(sentence: str):
    """Warns of the first Ctrl-C while the main thread is anywhere, in XLA too.

    Python's handler in C writes each signal's number into a pipe."""
    read, write = os.pipe()
    os.set_blocking(write, False)

    def say():
        while number := os.read(read, 1):  # nothing: it is closed
            if number[0] == signal.SIGINT:
                logger.warning(sentence)
                return

    thread = threading.Thread(target=say, daemon=True)
    thread.start()
    former = signal.set_wakeup_fd(write, warn_on_full_buffer=False)
    try:
        yield
    finally:
        signal.set_wakeup_fd(former)
        os.close(write)
        thread.join()
        os.close(read)


def _due(last_save: float, settings: Train) -> bool:
    """Whether to save a checkpoint. All processes save together, by the clock of the first one."""
    due = time.monotonic() - last_save > settings.save_every
    if jax.process_count() > 1:
        due = bool(multihost_utils.broadcast_one_to_all(np.array(due)))
    return due


def first_state(settings: Train) -> TrainState:
    """The state before the first step, with random parameters or the given weights."""
    if settings.weights is None:
        params = initial_params(jax.random.key(settings.seed))
    else:
        weights = load_weights(settings.weights)
        if not weights.normalise:
            raise CheckpointError(
                f"{settings.weights} expects tensors that are not normalised, training normalises "
                "them: start from other weights, or from none"
            )
        params = weights.params
    return initial_train_state(params, settings.step_settings, not settings.data)


def _keys(settings: Train) -> list[jax.Array]:
    """The key of the training sequences, and those of the validation sequences."""

    def keys():
        training, validation = jax.random.split(jax.random.key(settings.seed + 1))
        return [training, *jax.random.split(validation, VALIDATION)]

    return jax.jit(keys, out_shardings=sharding())()  # device_put cannot send keys to other hosts


def sources_of(settings: Train, done: int) -> tuple[Iterator, list[Callable[[], Simulation]]]:
    """The sources of `train_step` for the step after `done` and all later ones; validation batches.

    Files for validation are not used for training (`batches.split`). Textures for validation are
    other cuts of the same pictures: they serve to compare the steps of a run, not to measure how
    good a network is on unseen pictures.
    """
    if settings.data:
        files, others = split(settings.sequences)
        shape = {"batch": settings.batch, "windows": settings.windows, "crop": settings.crop}
        chain, augment = settings.chain, settings.augment
        training = batches(
            files, **shape, chain=chain, augment=augment, seed=settings.seed, first=done
        )
        fixed = batches(others, **shape, augment=NO_AUGMENT, seed=settings.seed)
        validation = [_sharded(next(fixed)) for _ in range(VALIDATION)]
        fixed.close()
        return map(_sharded, training), [partial(lambda data: data, data) for data in validation]

    def load(count, seed):
        pictures = load_textures(settings.images, count, TEXTURE, seed, settings.procedural)
        return replicated(pictures)

    training, others = load(settings.textures, settings.seed), load(32, settings.seed + 1)
    key, *keys = _keys(settings)
    return itertools.repeat((key, training)), [
        partial(simulated, key, others, settings.step_settings) for key in keys
    ]


def _sharded(data: Simulation) -> Simulation:
    """A batch, sharded over the devices; every process has read all of it."""
    if jax.device_count() == 1:
        return data

    def share_of(whole):
        whole = np.asarray(whole)
        return jax.make_array_from_callback(whole.shape, sharding(TIME_BATCH), whole.__getitem__)

    return jax.tree.map(share_of, data)


def _check_finite(state: TrainState, folder: Path) -> None:
    if int(state.optimiser.notfinite_count) >= 10:
        raise FirenetError(
            f"{folder}: ten steps in a row had no finite gradient, training has diverged: start "
            "again with a smaller --learning-rate"
        )


def _record(settings: Train) -> dict:
    """Everything that the weights depend on, and how often a run is logged and saved."""
    data = settings.data[0] if len(settings.data) == 1 else list(settings.data) or None
    but = "output", "coordinator", "processes", "process"
    told = {"files": _files(settings), "initial": _initial(settings)}
    return runs.recorded(settings, but=but, data=data, **told)


def _files(settings: Train) -> str | None:
    """Names and sizes of sequences or pictures, in short; of recordings, `prepare` sees to it."""
    folder = settings.data[0] if settings.data else settings.images
    if folder is None or settings.on_recordings:
        return None
    paths = find(folder) if settings.data else pictures_in(folder)
    found = [(str(path.relative_to(folder)), path.stat().st_size) for path in paths]
    return hashlib.sha256(repr(found).encode()).hexdigest()[:16]


def _initial(settings: Train) -> str | None:
    """The weights that a run begins with, in short. None: random ones, the built-in ones, or those
    of a file that is gone, which a run that goes on does not need."""
    if settings.weights is None or str(settings.weights) == BUILT_IN:
        return None
    try:
        return digest(load_weights(settings.weights))
    except CheckpointError:
        return None


def _check_devices_and_data(settings: Train) -> None:
    """Raises SettingsError for a batch that devices cannot share, and at once what would be found
    when all has been made ready: that there are no pictures, or no sequences."""
    if settings.batch % jax.device_count():
        raise SettingsError(
            f"batch is {settings.batch}, but the sequences of a batch are shared by "
            f"{jax.device_count()} devices: choose a multiple of that"
        )
    if settings.images is not None:
        pictures_in(settings.images)
    elif settings.data and not settings.on_recordings:
        split(settings.sequences)


def _check_nothing_is_lost(folder: Path, settings: Train) -> None:
    """Raises OutputError where a run without a checkpoint, which would begin again, has weights,
    unless it was killed before the first was due."""
    told = (entry.get("seconds") for entry in entries(folder / "log.jsonl"))
    seconds = max((each for each in told if isinstance(each, float)), default=0.0)
    for name in ("weights.npz", "last.npz"):
        if (folder / name).exists() and seconds > settings.save_every:
            raise OutputError(
                f"{folder} holds {name}, but no checkpoint to go on from: choose another --output, "
                f"with --weights {folder} to begin with its weights"
            )


def _check_folder(folder: Path, settings: Train) -> None:
    """Makes it, if it is missing. Raises OutputError for a folder of somebody else, or of a run
    with other settings."""
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder} is a file, but a run needs a folder: choose another --output")
    runs.make_folder(folder)
    found = runs.read_record(folder / "settings.json", "choose another --output")
    if found is not None and "learning_rate" not in found:
        raise OutputError(f"{folder} is a folder of something else: choose another --output")
    if found is not None:
        _check_settings(folder, found, settings)
        return
    for name in WRITTEN:
        if (folder / name).exists():
            raise OutputError(
                f"{folder} holds {name}, but no settings.json of a run: choose another --output"
            )


def _check_settings(folder: Path, found: dict, settings: Train) -> None:
    """Raises OutputError unless the run with the record `found` goes on with these settings.

    Options that did not exist when the run began count as their defaults. Those of `UNRECORDED` may
    change, and a run that is done may become longer.
    """
    now = _record(settings)
    _forget_places(found, now, settings)
    if found.get("files") is None:  # a run of before it was kept
        found["files"] = now["files"]
    if found.get("initial") not in (None, now["initial"]) and now["initial"] is not None:
        logger.warning(
            "%s has changed since the run in %s began, which goes on from its own weights: to "
            "begin with these, choose another --output", settings.weights, folder,
        )  # fmt: skip
    if found.get("warmup") == 200 and settings.warmup is None:  # of before the default was None
        found["warmup"] = None
    found = runs.completed(found, _record(Train(folder)))
    done = (folder / "checkpoints" / str(found["steps"])).is_dir()
    longer = isinstance(found["steps"], int) and found["steps"] < settings.steps
    if longer and done and not runs.differences(found, now, but=(*UNRECORDED, "steps", "initial")):
        logger.warning(
            "%s: its %d steps are done: it goes on to %d, with the rate of a run so long",
            folder, found["steps"], settings.steps,
        )  # fmt: skip
        return
    same_place = all(found[name] == now[name] for name in ("data", "images"))
    if same_place and found["files"] != now["files"]:
        what = settings.data[0] if settings.data else settings.images
        raise OutputError(
            f"{what} has changed since the run in {folder} began: choose another --output, with "
            f"--weights {folder} to begin with its weights"
        )
    may_change = (*UNRECORDED, "files", "initial")
    runs.check_same(
        found, now, f"{folder} holds a run with other settings",
        "choose another --output, or go on with the same settings", but=may_change,
    )  # fmt: skip


def _forget_places(found: dict, now: dict, settings: Train) -> None:
    """The same files and weights are known by what they are, wherever they are and however that is
    spelt; of recordings, `prepare` sees to their sizes."""
    if settings.on_recordings:
        names = [
            [Path(path).name for path in ([data] if isinstance(data, str) else data or ())]
            for data in (found.get("data"), now["data"])
        ]
        same = names[0] == names[1]
    else:
        same = now["files"] is not None and found.get("files") == now["files"]
        same = same and (found.get("data") is None) == (now["data"] is None)
    if same:
        found |= {name: now[name] for name in ("data", "images")}
    if found.get("initial") is not None and found["initial"] == now["initial"]:
        found["weights"] = now["weights"]


def _keep_settings(folder: Path, settings: Train) -> None:
    if is_first():  # only one process writes
        path, record = folder / "settings.json", _record(settings)
        before = runs.read_record(path, "choose another --output") or {}
        record["initial"] = before.get("initial") or record["initial"]  # it began once
        write_text(path, runs.as_text(record))
