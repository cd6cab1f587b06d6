"""(parameters and states, a step's data) -> (the same after it, losses): the pure step of training.

With `chain` more than 1 a sequence goes on through so many steps (truncated back-propagation
through time): simulation and network go on from the states where the last step left them,
gradients stop there. The sequences of a batch are of different lengths, up to `chain` steps, so
that each step sees states of many ages: what a recurrence does after a thousand windows is learnt
from states that are as old, what it does at first from such as begin.

Step n is a function of the seed, n and the state alone. The sequences of a batch are dealt out to
all devices of all processes; what is computed does not depend on how many these are.

Read `train_step` first: simulate, scan, differentiate, update.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optax.contrib

from firenet_jax.convolution import CONVOLVED
from firenet_jax.devices import BATCH, REPLICATED, TIME_BATCH, on_each_device, replicated, sharding
from firenet_jax.evaluation import metrics
from firenet_jax.network import State, initial_state, step
from firenet_jax.simulation.scenes import SceneSettings
from firenet_jax.simulation.sensor import (
    SensorSettings,
    SensorState,
    Simulation,
    first_states,
    random_setups,
    simulate,
    window_bounds,
)
from firenet_jax.tensors import normalise
from firenet_jax.training.losses import Loss, sequence_loss

TEXTURE = 256  # pixels on a side of a texture
NEIGHBOURHOOD = 9  # pixels on a side of the surroundings in which an event tells of a pixel


@dataclass(frozen=True)
class StepSettings:
    """What a step depends on besides its state and its data; `settings.Train` explains each.

    It is a static argument of compiled functions, so it holds nothing that may differ between two
    runs of the same program: no paths, no seed.
    """

    steps: int
    batch: int
    crop: int
    windows: int
    chain: int
    renderings: int
    motion: tuple[float, float]
    slow: float
    swift: float
    learning_rate: float
    warmup: int
    optimiser: Literal["muon", "adam"]
    clip: float
    bfloat16: bool
    remat: bool
    near_events: bool
    loss: Loss
    scene: SceneSettings
    sensor: SensorSettings


class TrainState(NamedTuple):
    """All that a step needs from the last one."""

    params: Any
    optimiser: Any
    step: jax.Array | np.int32  # () int32
    carried: tuple[SensorState, State] | None  # within a chain


def optimiser(settings: StepSettings) -> optax.GradientTransformation:
    """Of clipped gradients; a step whose gradient is not finite changes nothing.

    Muon (Jordan et al. 2024) makes the update of a kernel, as a matrix (9 inputs, outputs),
    orthogonal; 0.2 is the root mean square of Adam's usual updates (Liu et al., arXiv 2502.16982).
    Biases and the 1x1 convolution are Adam's in both cases.
    """
    rate = optax.warmup_cosine_decay_schedule(
        0.0,
        settings.learning_rate,
        settings.warmup,
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


def initial_train_state(params: Any, settings: StepSettings, simulates: bool = True) -> TrainState:
    """The state before the first step.

    simulates: whether data is simulated as it goes, so that a sensor's state is carried too.
    """
    carried = None
    if settings.chain > 1:
        ones = jnp.ones(settings.batch, jnp.int32)
        setups = jax.eval_shape(
            partial(_setups, settings=settings, lengths=ones, numbers=ones),
            jax.random.key(0),
            jnp.zeros((1, TEXTURE, TEXTURE)),
        )
        carried = jax.eval_shape(partial(_fresh, settings=settings), *setups)
        carried = carried if simulates else (None, carried[1])
        carried = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), carried)
        carried = jax.device_put(carried, sharding(BATCH))
    begun = TrainState(params, optimiser(settings).init(params), np.int32(0), None)
    return replicated(begun)._replace(carried=carried)


# ---- Simulation


def _lengths(settings: StepSettings) -> np.ndarray:
    """(B,) steps through which each sequence of a batch goes on."""
    shares = np.arange(1, settings.batch + 1) / settings.batch
    return np.round(settings.chain**shares).astype(np.int32)


def _setups(
    key: jax.Array,
    textures: jax.Array,
    settings: StepSettings,
    lengths: jax.Array,
    numbers: jax.Array,
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


def _fresh(sensors, scenes, start, settings: StepSettings) -> tuple[SensorState, State]:
    """What sequences start from at (B,) int32 microseconds."""
    size = settings.crop, settings.crop
    seen = first_states(sensors, scenes, start, height=size[0], width=size[1])
    return seen, initial_state(len(start), *size)


def _simulated(
    key: jax.Array, textures: jax.Array, settings: StepSettings, state: TrainState | None = None
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
    carried = state.carried if state is not None and chained else None

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
    params, tensors: jax.Array, settings: StepSettings, state: State | None = None
) -> tuple[State, jax.Array]:
    """Event tensors (T, B, H, W, 5), not normalised -> last state, images (T, B, H, W).

    state: before the first window; None is the zero state.
    """
    run = partial(step, dtype=jnp.bfloat16 if settings.bfloat16 else jnp.float32)
    # On a CPU what a loop keeps for the gradient goes through memory three times more (zeros, in,
    # out), a sixth of the time; as there are few windows, they can stand in the program one by one.
    one_by_one = jax.default_backend() == "cpu" and not (settings.bfloat16 or settings.remat)
    if not one_by_one:
        # Of the rest of what it needs, to keep it is slower than to compute it again.
        kept = () if settings.remat else (CONVOLVED,)
        policy = jax.checkpoint_policies.save_only_these_names(*kept)
        run = jax.checkpoint(run, policy=policy, prevent_cse=False)

    def body(state: State, tensor: jax.Array):
        return run(params, state, tensor)

    state = initial_state(*tensors.shape[1:4]) if state is None else state
    return jax.lax.scan(body, state, normalise(tensors), unroll=one_by_one or 1)


def near_events(tensors: jax.Array) -> jax.Array:
    """(T, B, H, W, bins) -> (T, B, H, W) bool: where events were, in this window or one before."""
    there = jnp.abs(tensors).max(-1)
    around = (1, 1, NEIGHBOURHOOD, NEIGHBOURHOOD)
    there = jax.lax.reduce_window(there, 0.0, jax.lax.max, around, (1, 1, 1, 1), "SAME")
    return jax.lax.cummax(there) > 0


def loss_of(params, data: Simulation, state: State | None, warm, settings: StepSettings):
    """(loss, (its terms, last state, images)) of all devices' sequences."""

    def one_device(params, data, state, warm):
        last, images = images_of(params, data.tensors, settings, state)
        truths = data.images
        if settings.near_events:  # a loss that is blind elsewhere lets the image run away there
            level = truths.mean((-2, -1), keepdims=True)
            truths = jnp.where(near_events(data.tensors), truths, level)
        truth = truths, data.displacement, data.visible
        losses = sequence_loss(images, *truth, settings.loss, warm)
        return jax.lax.pmean(losses, "devices"), (last, images)

    # A `warm` that is known, known it must stay: it is no argument of the program then.
    known = isinstance(warm, bool)
    function = partial(one_device, warm=warm) if known else one_device
    specs = (REPLICATED, TIME_BATCH, BATCH) + (() if known else (BATCH,))
    on_each = on_each_device(function, specs, (REPLICATED, (BATCH, TIME_BATCH)))
    (loss, terms), (last, images) = on_each(params, data, state, *(() if known else (warm,)))
    return loss, (terms, last, images)


def _updated(
    state: TrainState, data: Simulation, before: State | None, warm, settings: StepSettings
):
    """(state, data, the network's state before it) -> (state, losses), the network's state."""
    both = jax.value_and_grad(loss_of, has_aux=True)
    (loss, (terms, last, _)), gradient = both(state.params, data, before, warm, settings)
    updates, optimised = optimiser(settings).update(gradient, state.optimiser, state.params)
    params = optax.apply_updates(state.params, updates)
    terms = {"loss": loss, "gradient": optax.tree.norm(gradient), **terms}
    return state._replace(params=params, optimiser=optimised, step=state.step + 1), terms, last


@partial(jax.jit, static_argnames="settings", donate_argnames="state")
def train_step(
    state: TrainState, source: tuple[jax.Array, jax.Array] | Simulation, settings: StepSettings
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
            carried = cast(tuple, state.carried)[1]
            before = jax.tree.map(partial(jnp.where, later), carried, before)
            warm = jnp.broadcast_to(later, settings.batch)
    else:
        key, textures = source
        data, (seen, before), warm = _simulated(key, textures, settings, state)
    state, terms, last = _updated(state, data, before, warm, settings)
    return state._replace(carried=(seen, last) if settings.chain > 1 else None), terms


@partial(jax.jit, static_argnames="settings")
def simulated(key: jax.Array, textures: jax.Array, settings: StepSettings) -> Simulation:
    """Sequences of their own, as long as a step's."""
    return _simulated(key, textures, settings)[0]


@partial(jax.jit, static_argnames="settings")
def validate(params, data: Simulation, settings: StepSettings):
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
    return scores, jax.lax.with_sharding_constraint(pictures, sharding())
