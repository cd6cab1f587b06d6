"""Simulated sequences, or files of them -> parameters: a jitted step simulates, scans, updates.

With `chain` more than 1 a sequence goes on through so many steps (truncated back-propagation
through time): simulation and network go on from the states where the last step left them,
gradients stop there. The sequences of a batch are of different lengths, up to `chain` steps, so
that each step sees states of many ages: what a recurrence does after a thousand windows is learnt
from states that are as old, what it does at first from such as begin.

Step n is a function of the seed, n and the state alone, so a run that was interrupted and resumed
is the run that was not. A run is a folder:

    settings.json     what was asked for
    log.jsonl         one line for each logged step: losses, seconds
    tensorboard/      the same as curves, and the pictures
    pictures/         each validation's: events, image, truth
    checkpoints/      the whole state (orbax), the newest two
    weights.npz       the parameters that did best on the validation sequences so far
    last.npz          those of the last validation

The sequences of a batch are dealt out to all devices of all processes; what is computed does not
depend on how many these are.
"""

import contextlib
import dataclasses
import itertools
import json
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optax.contrib
import orbax.checkpoint as ocp
import tyro
from jax.experimental import multihost_utils
from PIL import Image
from tensorboardX import SummaryWriter

from firenet_jax.checkpoint import load_weights, save_weights
from firenet_jax.convolution import CONVOLVED
from firenet_jax.devices import (
    BATCH,
    EVERYWHERE,
    TIME_BATCH,
    check_processes,
    everywhere,
    join,
    on_each_device,
    shared,
)
from firenet_jax.evaluation import metrics
from firenet_jax.events import logger
from firenet_jax.network import (
    State,
    Weights,
    initial_params,
    initial_state,
    step,
)
from firenet_jax.pictures import event_pictures
from firenet_jax.simulation.scenes import SceneSettings, check_range, check_seed
from firenet_jax.simulation.sensor import (
    FAULTY,
    SensorSettings,
    SensorState,
    Simulation,
    check_rare,
    first_states,
    random_setups,
    simulate,
    window_bounds,
)
from firenet_jax.simulation.textures import load_textures
from firenet_jax.storage.files import differences, locked, write_text
from firenet_jax.storage.progress import bar
from firenet_jax.tensors import normalise
from firenet_jax.training.batches import NOTHING, Augment, batches, split
from firenet_jax.training.losses import DISTANCES, Loss, sequence_loss

TEXTURE = 256  # pixels on a side of a texture
VALIDATION = 8  # batches
FREE = "log_every", "save_every", "validate_every"  # say nothing about what is computed
SMALLEST = 11  # pixels on a side of what validation measures: SSIM's window


@dataclass(frozen=True)
class Train:
    """Train FireNet on sequences that are simulated as it goes.

    Examples:
      firenet train -o run
      firenet train -o run --images coco/train2017 --steps 100000
      firenet simulate -o set --sequences 1000  and then  firenet train -o run --data set
      firenet train -o tuned --weights built-in --learning-rate 1e-4
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder of the run; an interrupted run in it goes on."""
    weights: Annotated[Path | None, tyro.conf.arg(aliases=["-c"])] = None
    """Start from these weights instead of random ones; built-in: those of the package."""
    data: Path | None = None
    """Folder of HDF5 sequences to train on (`firenet simulate`, or downloaded) instead of
    simulating as it goes; settings of textures, renderings, scenes and sensors play no part."""
    images: Path | None = None
    """Folder of pictures for textures (default: scikit-image's photographs, and drawn ones)."""
    textures: int = 256
    """How many textures to cut from them."""
    procedural: float = 0.25
    """Part of the textures that is drawn instead."""
    steps: int = 20_000
    """Updates of the parameters. A run that is done goes on when it is given more."""
    batch: int = 2
    """Sequences in a step."""
    crop: int = 96
    """Height and width of the sequences, in pixels."""
    windows: int = 21
    """Windows in a step, L + 1 in the paper."""
    chain: int = 1
    """Steps through which the longest sequence of a batch goes on, its state carried from one to
    the next; the others are shorter, in equal proportions (64 with 4 sequences: 3, 8, 23, 64)."""
    renderings: int = 5
    """Renderings in a window."""
    motion: tuple[float, float] = (1.25, 2.5)
    """Pixels by which the fastest point moves in a window, at most one for a rendering; drawn
    log-uniformly for a sequence."""
    slow: float = 0.0
    """Part of the sequences in which next to nothing moves: there the thresholds of pixels differ
    more, and most have next to no noise."""
    swift: float = 0.0
    """Part of the sequences in which 16 to 90 pixels pass in a window, before a blank ground."""
    learning_rate: float = 1e-3
    """Greatest rate, after warming up; it then falls to a hundredth along a cosine."""
    warmup: int = 200
    """Steps in which the rate rises from zero; fewer in a run so short that they would be more than
    a fifth of it."""
    optimiser: Literal["muon", "adam"] = "muon"
    """muon learns more from a step (experiments/compare_optimisers.py); adam is the paper's. A
    rate means the same for both: the size of an update."""
    clip: float = 1.0
    """Gradients are scaled down to this norm."""
    seed: int = 0
    """Of the first parameters, the textures and all sequences."""
    bfloat16: bool = False
    """Convolutions in bfloat16: for accelerators; on a CPU it is slower."""
    remat: bool = False
    """Compute convolutions again for the gradient: less memory, a little more time."""
    log_every: int = 20
    """Steps between two lines of the log."""
    validate_every: int = 500
    """Steps between two validations."""
    save_every: float = 120.0
    """Seconds between two checkpoints, which are made after a line of the log."""
    coordinator: str | None = None
    """host:port of process 0, where several processes train together; start each with this. Those
    that srun or Open MPI 4 has started find each other."""
    processes: int | None = None
    """How many processes."""
    process: int | None = None
    """Which one this is, from 0."""
    loss: Loss = Loss()
    augment: Augment = Augment()
    """What happens to sequences from files."""
    scene: SceneSettings = SceneSettings()
    sensor: SensorSettings = dataclasses.replace(FAULTY, threshold_range=(0.1, 0.6))

    def __post_init__(self):
        positive = (
            "textures",
            "steps",
            "batch",
            "crop",
            "chain",
            "renderings",
            "learning_rate",
            "clip",
            "log_every",
            "validate_every",
        )
        for name in positive:
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} is {getattr(self, name)}, but must be more than 0")
        if not self.loss.l0 < self.windows <= self.loss.L + 1:
            raise ValueError(
                f"windows is {self.windows}, but the loss is over more than {self.loss.l0} and at "
                f"most {self.loss.L + 1} of them"
            )
        if not any(getattr(self.loss, name) for name in DISTANCES):
            raise ValueError(f"no distance has a weight: pass one of {', '.join(DISTANCES)}")
        if self.crop < SMALLEST:
            raise ValueError(
                f"crop is {self.crop} pixels, but images smaller than {SMALLEST} cannot be judged"
            )
        check_range("motion", self.motion)
        check_rare(self.slow, self.swift)
        check_seed(self.seed)
        if not self.save_every >= 0:
            raise ValueError(f"save_every is {self.save_every} seconds, but must be 0 or more")
        if not 0 <= self.procedural <= 1:
            raise ValueError(f"procedural is {self.procedural}, but is a part of the textures, 0-1")
        if not 0 <= warming_up(self) < self.steps:
            raise ValueError(f"warmup is {self.warmup} steps of {self.steps}: use 0 or more, fewer")
        check_processes(self.coordinator, self.processes, self.process)


def warming_up(settings: Train) -> int:
    """Steps: what was asked for, or at most a fifth of a run where nothing was."""
    asked = settings.warmup != Train.warmup
    return settings.warmup if asked else min(settings.warmup, settings.steps // 5)


class TrainState(NamedTuple):
    """All that a step needs from the last one."""

    params: Any
    optimiser: Any
    step: jax.Array  # () int32
    carried: tuple[SensorState, State] | None  # within a chain


def optimiser(settings: Train) -> optax.GradientTransformation:
    """Of clipped gradients; a step whose gradient is not finite changes nothing.

    Muon (Jordan et al. 2024) makes the update of a kernel, as a matrix (9 inputs, outputs),
    orthogonal; 0.2 is the root mean square of Adam's usual updates (Liu et al., arXiv 2502.16982).
    Biases and the 1x1 convolution are Adam's in both cases.
    """
    rate = optax.warmup_cosine_decay_schedule(
        0.0,
        settings.learning_rate,
        warming_up(settings),
        settings.steps,
        settings.learning_rate / 100,
    )
    update = optax.adam(rate)
    if settings.optimiser == "muon":
        update = optax.contrib.muon(
            rate, consistent_rms=0.2, muon_weight_dimension_numbers=_as_matrices
        )
    update = optax.chain(optax.clip_by_global_norm(settings.clip), update)
    return optax.apply_if_finite(update, max_consecutive_errors=10)


def _as_matrices(params):
    """For each parameter which axes are a matrix's, or None where it is Adam's."""
    matrix = optax.contrib.MuonDimensionNumbers(reduction_axis=(0, 1, 2), output_axis=3)
    return jax.tree.map(lambda p: matrix if p.ndim == 4 and p.shape[0] > 1 else None, params)


def initial_train_state(settings: Train) -> TrainState:
    if settings.weights is None:
        params = initial_params(jax.random.key(settings.seed))
    else:
        weights = load_weights(settings.weights)
        if not weights.normalise:
            raise ValueError(
                f"{settings.weights} expects tensors that are not normalised, training normalises "
                "them: start from other weights, or from none"
            )
        params = weights.params
    carried = None
    if settings.chain > 1:
        ones = jnp.ones(settings.batch, jnp.int32)
        setups = jax.eval_shape(
            partial(_setups, settings=settings, lengths=ones, numbers=ones),
            jax.random.key(0),
            jnp.zeros((1, TEXTURE, TEXTURE)),
        )
        carried = jax.eval_shape(partial(_fresh, settings=settings), *setups)
        carried = carried if settings.data is None else (None, carried[1])
        carried = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), carried)
        carried = jax.device_put(carried, shared(BATCH))
    state = params, optimiser(settings).init(params), np.int32(0)
    return TrainState(*everywhere(state), carried)


def _keys(settings: Train) -> list[jax.Array]:
    """The key of the training sequences, and those of the validation sequences."""

    def keys():
        training, validation = jax.random.split(jax.random.key(settings.seed + 1))
        return [training, *jax.random.split(validation, VALIDATION)]

    return jax.jit(keys, out_shardings=shared())()  # devices of others take keys in no other way


# ---- Simulation


def _lengths(settings: Train) -> np.ndarray:
    """(B,) steps through which each sequence of a batch goes on."""
    shares = np.arange(1, settings.batch + 1) / settings.batch
    return np.round(settings.chain**shares).astype(np.int32)


def _setups(
    key: jax.Array, textures: jax.Array, settings: Train, lengths: jax.Array, numbers: jax.Array
):
    """Sensors, scenes and durations of a window, leading axis B, of sequences so many steps long.

    numbers: (B,) int32, how many sequences there were before in the same place of the batch.
    """

    def one(place, length, number):
        setup = random_setups(
            jax.random.fold_in(jax.random.fold_in(key, place), number),
            textures,
            batch=1,
            windows=length * settings.windows,
            height=settings.crop,
            width=settings.crop,
            renderings=settings.renderings,
            motion=settings.motion,
            slow=settings.slow,
            swift=settings.swift,
            scene=settings.scene,
            sensor=settings.sensor,
        )
        return jax.tree.map(lambda leaf: leaf[0], setup)

    return jax.vmap(one)(jnp.arange(settings.batch), lengths, numbers)


def _fresh(sensors, scenes, start, settings: Train) -> tuple[SensorState, State]:
    """What sequences start from at (B,) int32 microseconds."""
    size = settings.crop, settings.crop
    seen = first_states(sensors, scenes, start, height=size[0], width=size[1])
    return seen, initial_state(len(start), *size)


def _simulated(
    key: jax.Array, textures: jax.Array, settings: Train, state: TrainState | None = None
) -> tuple[Simulation, tuple[SensorState, State], jax.Array | bool]:
    """A step's data, the states (sensor's after it, network's before it), whether these are warm.

    Without a TrainState: sequences of their own.
    """
    chained = state is not None and settings.chain > 1
    lengths = jnp.asarray(_lengths(settings) if chained else np.ones(settings.batch, np.int32))
    step = jnp.int32(0) if state is None else state.step
    numbers, parts = step // lengths, step % lengths
    sensors, scenes, durations = _setups(key, textures, settings, lengths, numbers)
    bounds = window_bounds(durations, settings.windows, parts * settings.windows)
    carried = state.carried if chained else None

    def one_device(sensors, scenes, bounds, carried, parts):
        seen, remembered = _fresh(sensors, scenes, bounds[0], settings)
        if chained:
            choose = jax.vmap(partial(jnp.where))
            seen, remembered = jax.tree.map(partial(choose, parts > 0), carried, (seen, remembered))
        size = {"height": settings.crop, "width": settings.crop}
        seen, data = simulate(sensors, scenes, bounds, seen, renderings=settings.renderings, **size)
        return data, (seen, remembered)

    specs = BATCH, BATCH, TIME_BATCH, BATCH, BATCH
    on_each = on_each_device(one_device, specs, (TIME_BATCH, BATCH))
    data, states = on_each(sensors, scenes, bounds, carried, parts)
    return data, states, parts > 0 if chained else False


# ---- Steps


def images_of(
    params, tensors: jax.Array, settings: Train, state: State | None = None
) -> tuple[State, jax.Array]:
    """Event tensors (T, B, H, W, 5), not normalised -> last state, images (T, B, H, W).

    state: before the first window; None is the zero state.
    """
    run = partial(step, dtype=jnp.bfloat16 if settings.bfloat16 else jnp.float32)
    # What a step keeps for the gradient goes through memory twice: of the rest, that is slower than
    # to compute it again.
    kept = () if settings.remat else (CONVOLVED,)
    policy = jax.checkpoint_policies.save_only_these_names(*kept)
    run = jax.checkpoint(run, policy=policy, prevent_cse=False)

    def body(state: State, tensor: jax.Array):
        return run(params, state, tensor)

    state = initial_state(*tensors.shape[1:4]) if state is None else state
    return jax.lax.scan(body, state, normalise(tensors))


def loss_of(params, data: Simulation, state: State | None, warm, settings: Train):
    """(loss, (its terms, last state, images)) of all devices' sequences."""

    def one_device(params, data, state, warm):
        last, images = images_of(params, data.tensors, settings, state)
        truth = data.images, data.displacement, data.visible
        losses = sequence_loss(images, *truth, settings.loss, warm)
        return jax.lax.pmean(losses, "devices"), (last, images)

    # A `warm` that is known, known it must stay: it is no argument of the program then.
    known = isinstance(warm, bool)
    function = partial(one_device, warm=warm) if known else one_device
    specs = (EVERYWHERE, TIME_BATCH, BATCH) + (() if known else (BATCH,))
    on_each = on_each_device(function, specs, (EVERYWHERE, (BATCH, TIME_BATCH)))
    (loss, terms), (last, images) = on_each(params, data, state, *(() if known else (warm,)))
    return loss, (terms, last, images)


def _updated(state: TrainState, data: Simulation, before: State | None, warm, settings: Train):
    """(state, data, the network's state before it) -> (state, losses), the network's state."""
    both = jax.value_and_grad(loss_of, has_aux=True)
    (loss, (terms, last, _)), gradient = both(state.params, data, before, warm, settings)
    updates, optimised = optimiser(settings).update(gradient, state.optimiser, state.params)
    params = optax.apply_updates(state.params, updates)
    terms = {"loss": loss, "gradient": optax.tree.norm(gradient), **terms}
    return state._replace(params=params, optimiser=optimised, step=state.step + 1), terms, last


@partial(jax.jit, static_argnames="settings", donate_argnames="state")
def train_step(
    state: TrainState, source: tuple[jax.Array, jax.Array] | Simulation, settings: Train
) -> tuple[TrainState, dict[str, jax.Array]]:
    """(state, source) -> (state, losses): make data, scan, update.

    source: the run's key and textures (N, S, S), from which a step's sequences are simulated; or
    data from files.
    """
    if isinstance(source, Simulation):
        data, seen, warm = source, None, False
        size = data.images.shape[1:]
        before = initial_state(*size)
        if settings.chain > 1:
            later = state.step % settings.chain > 0
            before = jax.tree.map(partial(jnp.where, later), state.carried[1], before)
            warm = jnp.broadcast_to(later, settings.batch)
    else:
        key, textures = source
        data, (seen, before), warm = _simulated(key, textures, settings, state)
    state, terms, last = _updated(state, data, before, warm, settings)
    return state._replace(carried=(seen, last) if settings.chain > 1 else None), terms


@partial(jax.jit, static_argnames="settings")
def simulated(key: jax.Array, textures: jax.Array, settings: Train) -> Simulation:
    """Sequences of their own, as long as a step's."""
    return _simulated(key, textures, settings)[0]


@partial(jax.jit, static_argnames="settings")
def validate(params, data: Simulation, settings: Train):
    """(losses and metrics of a batch, pictures of its first sequence), from a zero state.

    Metrics are of the images from l0 on, clipped. Pictures: (T, H, W) the images, (T, H, W) the
    truth, (T, H, W, 5) the event tensors.
    """
    before = initial_state(*data.images.shape[1:])
    loss, (terms, _, images) = loss_of(params, data, before, False, settings)
    shown, truths = jnp.clip(images[settings.loss.l0 :], 0, 1), data.images[settings.loss.l0 :]
    scores = {
        "loss": loss,
        "temporal": terms.get("temporal", jnp.zeros(())),
        "mse": metrics.mse(shown, truths).mean(),
        "ssim": metrics.ssim(shown, truths).mean(),
    }
    pictures = images[:, 0], data.images[:, 0], data.tensors[:, 0]
    return scores, jax.lax.with_sharding_constraint(pictures, shared())


# ---- Runs


def run(settings: Train, stop: int | None = None) -> None:
    """Trains as the settings say, going on where an interrupted run stopped.

    stop: leave after so many steps, in the middle of the schedule.
    Raises ValueError where the settings do not fit the folder, the weights or the devices, or
    where another run writes into the folder.
    """
    join(settings.coordinator, settings.processes, settings.process)
    if settings.batch % jax.device_count():
        raise ValueError(
            f"batch is {settings.batch}, but the sequences of a batch are dealt out to "
            f"{jax.device_count()} devices: choose a multiple of that"
        )
    folder = settings.output
    _check_settings(folder, settings)
    state = initial_train_state(settings)
    options = ocp.CheckpointManagerOptions(max_to_keep=2)
    with (
        locked(folder) if _first() else contextlib.nullcontext(),  # the others do not write
        ocp.CheckpointManager((folder / "checkpoints").absolute(), options=options) as saved,
    ):
        if saved.latest_step() is not None:
            state = saved.restore(saved.latest_step(), args=ocp.args.StandardRestore(state))
            logger.warning("%s: going on after step %d", folder, state.step)
        done = int(state.step)
        sources, validation = sources_of(settings, done)
        _keep_settings(folder, settings)  # now that all is there: a failed start blocks no folder
        log = Log(folder, done)
        best, last_save = log.best(), time.monotonic()
        last = min(settings.steps, stop or settings.steps)
        with (
            bar(last, "step", quiet=not _first(), initial=done) as progress,
            _interruptible() as interrupted,
        ):
            while done < last and not interrupted:
                state, terms = train_step(state, next(sources), settings)
                done += 1
                progress.update()
                if done % settings.log_every == 0 or done == last:
                    terms = log.write(done, "train", terms)
                    progress.set_postfix(loss=f"{terms['loss']:.3f}", refresh=False)
                    _check_finite(terms, state, folder)
                if done % settings.validate_every == 0 or done == last:
                    results = [validate(state.params, make(), settings) for make in validation]
                    means = jax.tree.map(lambda *scores: np.mean(scores), *(r[0] for r in results))
                    means = log.write(done, "validation", means)
                    log.show(done, results[0][1])
                    weights = Weights(jax.tree.map(np.asarray, jax.device_get(state.params)), True)
                    if means["loss"] < best:
                        best = means["loss"]
                        log.keep("weights.npz", weights)
                    log.keep("last.npz", weights)
                logged = done % settings.log_every == 0
                if done == last or (logged and _due(last_save, settings)):
                    saved.save(done, args=ocp.args.StandardSave(state))
                    last_save = time.monotonic()
        if interrupted and saved.latest_step() != done:
            saved.save(done, args=ocp.args.StandardSave(state))
        log.close()
    if interrupted:
        raise KeyboardInterrupt(f"step {done} is saved: the same command goes on from there")
    if _first():
        print(f"{folder / 'weights.npz'}: best validation loss {best:.4f} in {done} steps")


@contextlib.contextmanager
def _interruptible():
    """A list that Ctrl-C, pressed once, puts something in; pressed again, it interrupts at once.

    So a step is never left half done. Several processes would not save at the same step: there, and
    where this is no main thread, it interrupts at once."""
    pressed: list[int] = []
    if jax.process_count() > 1 or threading.current_thread() is not threading.main_thread():
        yield pressed
        return

    def once(number, frame):
        pressed.append(number)
        signal.signal(signal.SIGINT, before)

    before = signal.signal(signal.SIGINT, once)
    try:
        yield pressed
    finally:
        signal.signal(signal.SIGINT, before)


def _due(last_save: float, settings: Train) -> bool:
    """Processes save together or not at all, so the first one's clock decides for all."""
    due = time.monotonic() - last_save > settings.save_every
    if jax.process_count() > 1:
        due = bool(multihost_utils.broadcast_one_to_all(np.array(due)))
    return due


def _first() -> bool:
    """Whether this is the process that writes and talks."""
    return jax.process_index() == 0


def sources_of(settings: Train, done: int) -> tuple[Iterator, list[Callable[[], Simulation]]]:
    """What `train_step` takes for the step after `done` and all later ones; validation batches.

    Files to validate on are no files to train on (`batches.split`). Textures to validate on are
    cut anew, but from the same pictures: they choose between the steps of a run; how good a
    network is on pictures it never saw they do not tell.
    """
    if settings.data is not None:
        files, others = split(settings.data)
        shape = {"batch": settings.batch, "windows": settings.windows, "crop": settings.crop}
        chain, augment = settings.chain, settings.augment
        training = batches(
            files, **shape, chain=chain, augment=augment, seed=settings.seed, first=done
        )
        fixed = batches(others, **shape, augment=NOTHING, seed=settings.seed)
        validation = [_dealt(next(fixed)) for _ in range(VALIDATION)]
        fixed.close()
        return map(_dealt, training), [partial(lambda data: data, data) for data in validation]

    def load(count, seed):
        pictures = load_textures(settings.images, count, TEXTURE, seed, settings.procedural)
        return everywhere(pictures)

    training, others = load(settings.textures, settings.seed), load(32, settings.seed + 1)
    key, *keys = _keys(settings)
    return itertools.repeat((key, training)), [
        partial(simulated, key, others, settings) for key in keys
    ]


def _dealt(data: Simulation) -> Simulation:
    """A batch, of which each device keeps its part; every process has read all of it."""
    if jax.device_count() == 1:
        return data

    def dealt(whole):
        whole = np.asarray(whole)
        return jax.make_array_from_callback(whole.shape, shared(TIME_BATCH), whole.__getitem__)

    return jax.tree.map(dealt, data)


class Log:
    """A run's record: log.jsonl, TensorBoard, pictures, weights; written by the first process.

    Lines beyond the checkpoint from which a run goes on are dropped.
    """

    def __init__(self, folder: Path, step: int):
        self.path, self.start = folder / "log.jsonl", time.monotonic()
        self.entries = [entry for entry in _entries(self.path) if entry["step"] <= step]
        self.board = None
        if _first():
            write_text(self.path, "".join(json.dumps(entry) + "\n" for entry in self.entries))
            self.board = SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1)

    def write(self, step: int, kind: str, values: dict) -> dict[str, float]:
        values = {name: float(value) for name, value in values.items()}
        entry = {"step": step, "kind": kind, **values, "seconds": time.monotonic() - self.start}
        if self.board is not None:
            with self.path.open("a") as file:
                file.write(json.dumps(entry) + "\n")
            for name, value in values.items():
                self.board.add_scalar(f"{kind}/{name}", value, step)
        return values

    def show(self, step: int, pictures: tuple[jax.Array, jax.Array, jax.Array]) -> None:
        """Three windows of `validate`'s pictures: events, image, truth, one window a row."""
        if self.board is None:
            return
        images, truths, tensors = pictures
        chosen = [len(images) * k // 3 - 1 for k in (1, 2, 3)]
        grey = np.asarray(jnp.concatenate([images, truths], -1)[np.array(chosen)])
        grey = np.round(255 * np.clip(grey, 0, 1)).astype(np.uint8)[..., None]
        events = np.asarray(event_pictures(tensors[np.array(chosen)]))
        sheet = np.concatenate([events, np.repeat(grey, 3, -1)], 2)  # (3, H, 3 W, 3)
        sheet = sheet.reshape(-1, *sheet.shape[2:])
        (self.path.parent / "pictures").mkdir(exist_ok=True)
        Image.fromarray(sheet).save(self.path.parent / "pictures" / f"step_{step:07d}.png")
        self.board.add_image("validation", sheet, step, dataformats="HWC")

    def keep(self, name: str, weights: Weights) -> None:
        if self.board is not None:
            save_weights(self.path.parent / name, weights)

    def best(self) -> float:
        """The least validation loss so far."""
        losses = [entry["loss"] for entry in self.entries if entry.get("kind") == "validation"]
        return min(filter(math.isfinite, losses), default=math.inf)

    def close(self) -> None:
        if self.board is not None:
            self.board.close()


def _entries(path: Path) -> Iterator[dict]:
    """Lines of a log, but what was half written when a run was killed, and what is no entry."""
    for line in path.read_bytes().splitlines() if path.exists() else []:
        with contextlib.suppress(ValueError, TypeError, RecursionError, OverflowError):
            entry = json.loads(line)
            if not (isinstance(entry, dict) and type(entry.get("step")) is int):
                continue
            if entry.get("kind") == "validation":
                entry["loss"] = float(entry.get("loss", "nothing"))
            yield entry


def _check_finite(terms: dict[str, float], state: TrainState, folder: Path) -> None:
    if not np.isfinite(terms["loss"]) and int(state.optimiser.notfinite_count) >= 10:
        raise ValueError(
            f"{folder}: ten steps in a row had no finite gradient, training has diverged: start "
            "again with a smaller --learning-rate"
        )


def _as_text(settings: Train) -> str:
    where = {"output", "coordinator", "processes", "process"}  # not what is computed
    choices = {k: v for k, v in dataclasses.asdict(settings).items() if k not in where}
    return json.dumps(choices, default=str, indent=1)


def _filled(found: dict, defaults: dict) -> dict:
    """The same with the defaults that it lacks, in the dicts within it too."""
    inner = {k: _filled(v, defaults.get(k, {})) for k, v in found.items() if isinstance(v, dict)}
    return defaults | found | inner


def _check_settings(folder: Path, settings: Train) -> None:
    """Raises ValueError if the folder holds a run of other settings.

    Options that the run there does not know, as it is older than they are, count as their defaults.
    Those of `FREE` may change.
    """
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file, but a run needs a folder: choose another --output")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "settings.json"
    if not path.exists():
        return
    try:
        found = _filled(json.loads(path.read_text()), json.loads(_as_text(Train(folder))))
    except (ValueError, AttributeError) as error:
        raise ValueError(f"{path} is damaged ({error}): choose another --output") from error
    now = json.loads(_as_text(settings))
    if found["steps"] < settings.steps and not differences(found, now, but=(*FREE, "steps")):
        if (folder / "checkpoints" / str(found["steps"])).is_dir():
            logger.warning(
                "%s: its %d steps are done: it goes on to %d, with the rate of a run so long",
                folder, found["steps"], settings.steps,
            )  # fmt: skip
            return
    if other := differences(found, now, but=FREE):
        raise ValueError(
            f"{folder} holds a run with other settings ({', '.join(other)}): choose another "
            "--output, or go on with the same settings"
        )


def _keep_settings(folder: Path, settings: Train) -> None:
    if _first():
        write_text(folder / "settings.json", _as_text(settings))  # others may be looking
