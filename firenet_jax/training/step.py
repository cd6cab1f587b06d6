"""(train state, data) -> (train state, losses): the pure training step.

With `chain` more than 1 a sequence continues through up to that many steps (truncated
back-propagation through time): simulation and network start from the states at the end of the last
step, and gradients stop there. The sequences of a batch have different lengths, up to `chain`
steps, so each step trains on states of many ages, from new ones to those after a thousand windows.

Step n is a function of the seed, n and the state alone. The sequences of a batch are sharded over
all devices of all processes; the result does not depend on their number.

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
from firenet_jax.simulation.curricula import random_setups, window_bounds
from firenet_jax.simulation.scenes import SceneSettings
from firenet_jax.simulation.sensor import SensorSettings, SensorState
from firenet_jax.simulation.sequences import Simulation, first_states, simulate, to_and_fro
from firenet_jax.tensors import normalise
from firenet_jax.training.centring import centred, input_means
from firenet_jax.training.losses import Loss, sequence_loss

TEXTURE = 256  # pixels on a side of a texture
FEWEST = 5  # renderings of a window in which next to nothing moves
NEIGHBOURHOOD = 9  # pixels: the side of the square around an event in which the truth counts


@dataclass(frozen=True)
class StepSettings:
    """The settings that a step depends on; `settings.Train` explains each.

    They are a static argument of compiled functions, so they hold nothing that may differ between
    two runs of the same program: no paths, no seed.
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
    to_and_fro: float
    learning_rate: float
    warmup: int
    optimiser: Literal["muon", "centred", "adam"]
    clip: float
    frozen: tuple[str, ...]
    bfloat16: bool
    remat: bool
    near_events: bool
    loss: Loss
    scene: SceneSettings
    sensor: SensorSettings


class TrainState(NamedTuple):
    """The state between two steps."""

    params: Any
    optimiser: Any
    step: jax.Array | np.int32  # () int32
    # Of sequences that continue, with `chain` > 1: the sensor's state, the network's and, with
    # `near_events`, (B, H, W) bool, where events have been near.
    carried: tuple[Any, ...] | None


def optimiser(settings: StepSettings) -> optax.GradientTransformation:
    """The optimiser, on clipped gradients; steps with a gradient that is not finite are skipped.

    Muon (Jordan et al. 2024) orthogonalises the update of a kernel, as a matrix (9 inputs,
    outputs); 0.2 is the usual root mean square of Adam's updates (Liu et al., arXiv 2502.16982).
    With it biases and the 1x1 convolution use Adam with Nesterov's momentum (Dozat 2016), whose
    first updates are larger than Adam's. "centred" is Muon, too, but with gradients and updates of
    centred inputs (`centring`); its `update` takes their means.
    """
    rate = optax.warmup_cosine_decay_schedule(
        0.0, settings.learning_rate, settings.warmup, settings.steps, settings.learning_rate / 100
    )
    update = optax.adam(rate)
    if settings.optimiser != "adam":
        update = optax.contrib.muon(
            rate, consistent_rms=0.2, muon_weight_dimension_numbers=_as_matrices
        )
    update = optax.chain(optax.clip_by_global_norm(settings.clip), update)
    if settings.optimiser == "centred":
        update = optax.GradientTransformationExtraArgs(*centred(update))
    return optax.apply_if_finite(update, max_consecutive_errors=2**31 - 1)


def _as_matrices(params):
    """The axes of each parameter as a matrix; None: it uses Adam."""
    matrix = optax.contrib.MuonDimensionNumbers(reduction_axis=(0, 1, 2), output_axis=3)
    return jax.tree.map(lambda p: matrix if p.ndim == 4 and p.shape[0] > 1 else None, params)


def initial_train_state(params: Any, settings: StepSettings, simulates: bool = True) -> TrainState:
    """The state before the first step.

    simulates: whether data is simulated on the fly, so that the sensor's state is carried too.
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
        if settings.near_events:
            shape = settings.batch, settings.crop, settings.crop
            carried = *carried, jax.ShapeDtypeStruct(shape, bool)
        carried = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), carried)
        carried = jax.device_put(carried, sharding(BATCH))
    begun = TrainState(params, optimiser(settings).init(params), np.int32(0), None)
    return replicated(begun)._replace(carried=carried)


# ---- Simulation


def _lengths(settings: StepSettings) -> np.ndarray:
    """(B,) the length of each sequence of a batch in steps."""
    shares = np.arange(1, settings.batch + 1) / settings.batch
    return np.round(settings.chain**shares).astype(np.int32)


def _setups(
    key: jax.Array,
    textures: jax.Array,
    settings: StepSettings,
    lengths: jax.Array,
    numbers: jax.Array,
):
    """Sensors, scenes and window durations, leading axis B, of sequences of these lengths in steps.

    numbers: (B,) int32, the number of earlier sequences in the same place of the batch.
    """

    names = "renderings", "motion", "slow", "swift", "scene", "sensor"
    shared: Any = {name: getattr(settings, name) for name in names}
    shared |= {"batch": 1, "height": settings.crop, "width": settings.crop}

    def one(place, length, number):
        own = jax.random.fold_in(jax.random.fold_in(key, place), number)
        setup = random_setups(own, textures, windows=length * settings.windows, **shared)
        return jax.tree.map(lambda leaf: leaf[0], setup)

    return jax.vmap(one)(jnp.arange(settings.batch), lengths, numbers)


def _fresh(sensors, scenes, start, settings: StepSettings) -> tuple[SensorState, State]:
    """The states of sequences that start at (B,) int32 microseconds."""
    size = settings.crop, settings.crop
    seen = first_states(sensors, scenes, start, height=size[0], width=size[1])
    return seen, initial_state(len(start), *size)


def _simulated(
    key: jax.Array, textures: jax.Array, settings: StepSettings, state: TrainState | None = None
) -> tuple[Simulation, tuple[SensorState, State], jax.Array | bool]:
    """A step's data, the states (sensor's after it, network's before it), whether these are warm.

    Without a TrainState: new sequences.
    """
    chained = state is not None and settings.chain > 1
    lengths = jnp.asarray(_lengths(settings) if chained else np.ones(settings.batch, np.int32))
    step = jnp.int32(0) if state is None else state.step
    numbers, parts = step // lengths, step % lengths
    sensors, scenes, durations = _setups(key, textures, settings, lengths, numbers)
    returns = _going_to_and_fro(key, settings, numbers)  # each of their steps is the first again
    simulated = jnp.where(returns, 0, parts)
    bounds = window_bounds(durations, settings.windows, simulated * settings.windows)
    carried = state.carried if state is not None and chained else None

    def one_device(sensors, scenes, bounds, carried, parts, simulated, returns):
        seen, remembered = _fresh(sensors, scenes, bounds[0], settings)
        if chained:
            choose = jax.vmap(partial(jnp.where))
            seen = jax.tree.map(partial(choose, simulated > 0), carried[0], seen)
            remembered = jax.tree.map(partial(choose, parts > 0), carried[1], remembered)
        size = {"height": settings.crop, "width": settings.crop}
        renderings = min(FEWEST, settings.renderings), settings.renderings
        seen, data = simulate(sensors, scenes, bounds, seen, renderings=renderings, **size)
        if settings.to_and_fro and state is not None:  # validation is the same with and without
            choose = jax.vmap(partial(jnp.where), (0, 1, 1), 1)
            data = jax.tree.map(
                partial(choose, returns), to_and_fro(data, scenes, bounds, **size), data
            )
        return data, (seen, remembered)

    specs = BATCH, BATCH, TIME_BATCH, BATCH, BATCH, BATCH, BATCH
    on_each = on_each_device(one_device, specs, (TIME_BATCH, BATCH))
    data, states = on_each(sensors, scenes, bounds, carried, parts, simulated, returns)
    return data, states, parts > 0 if chained else False


def _going_to_and_fro(key: jax.Array, settings: StepSettings, numbers: jax.Array) -> jax.Array:
    """(B,) bool: which sequences do so; numbers as in `_setups`."""

    def one(place, number):
        of_one = jax.random.fold_in(jax.random.fold_in(key, place), number)
        # Split in three, and folded with 1 and 2, it gives other numbers elsewhere.
        return jax.random.uniform(jax.random.fold_in(of_one, 3)) < settings.to_and_fro

    return jax.vmap(one)(jnp.arange(settings.batch), numbers)


# ---- Steps


def images_of(
    params, tensors: jax.Array, settings: StepSettings, state: State | None = None
) -> tuple[State, jax.Array]:
    """Event tensors (T, B, H, W, 5), not normalised -> last state, images (T, B, H, W).

    state: before the first window; None is the zero state.
    """
    run = partial(step, dtype=jnp.bfloat16 if settings.bfloat16 else jnp.float32)
    # On a CPU the residuals of a loop go through memory three more times (zeros, write, read), a
    # sixth of the time. There are few windows, so the loop is unrolled.
    one_by_one = jax.default_backend() == "cpu" and not (settings.bfloat16 or settings.remat)
    if not one_by_one:
        # All other residuals are faster to recompute than to store.
        kept = () if settings.remat else (CONVOLVED,)
        policy = jax.checkpoint_policies.save_only_these_names(*kept)
        run = jax.checkpoint(run, policy=policy, prevent_cse=False)

    def body(state: State, tensor: jax.Array):
        return run(params, state, tensor)

    state = initial_state(*tensors.shape[1:4]) if state is None else state
    return jax.lax.scan(body, state, normalise(tensors), unroll=one_by_one or 1)


def near_events(tensors: jax.Array) -> jax.Array:
    """(T, B, H, W, bins) -> (T, B, H, W) bool: near an event of this or an earlier window."""
    there = jnp.abs(tensors).max(-1)
    around = (1, 1, NEIGHBOURHOOD, NEIGHBOURHOOD)
    there = jax.lax.reduce_window(there, 0.0, jax.lax.max, around, (1, 1, 1, 1), "SAME")
    return jax.lax.cummax(there) > 0


def with_frozen(params, frozen: tuple[str, ...]):
    """The same parameters. Those of `frozen` parts ("gru2", or "gru2.candidate") have a gradient of
    zero, which is not computed, and by which no optimiser moves them.
    """

    def one(path, leaf):
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        return jax.lax.stop_gradient(leaf) if name.startswith(prefixes) else leaf

    prefixes = tuple(f"{part}." for part in frozen)
    return jax.tree_util.tree_map_with_path(one, params)


def loss_of(
    params, data: Simulation, state: State | None, warm, settings: StepSettings, near=False
):
    """(loss, (its terms, last state, images)) of all devices' sequences.

    near: (1, B, H, W) bool, where events have been near before, with `near_events`.
    """
    if settings.near_events:  # the mean elsewhere: without a loss the image would drift there
        level = data.images.mean((-2, -1), keepdims=True)
        there = near_events(data.tensors) | near
        data = data._replace(images=jnp.where(there, data.images, level))
    params = with_frozen(params, settings.frozen)

    def one_device(params, data, state, warm):
        last, images = images_of(params, data.tensors, settings, state)
        truth = data.images, data.displacement, data.visible
        mean = partial(jax.lax.pmean, axis_name="devices")
        losses = sequence_loss(images, *truth, settings.loss, warm, mean)
        return mean(losses), (last, images)

    # A constant `warm` must stay constant, so it is not an argument of the mapped function.
    known = isinstance(warm, bool)
    function = partial(one_device, warm=warm) if known else one_device
    specs = (REPLICATED, TIME_BATCH, BATCH) + (() if known else (BATCH,))
    on_each = on_each_device(function, specs, (REPLICATED, (BATCH, TIME_BATCH)))
    (loss, terms), (last, images) = on_each(params, data, state, *(() if known else (warm,)))
    return loss, (terms, last, images)


def _updated(
    state: TrainState,
    data: Simulation,
    before: State | None,
    warm,
    settings: StepSettings,
    near=False,
):
    """(state, data, the network's state before it) -> (state, losses), the network's state."""
    both = jax.value_and_grad(loss_of, has_aux=True)
    (loss, (terms, last, _)), gradient = both(state.params, data, before, warm, settings, near)
    more = {}
    if settings.optimiser == "centred":
        more = {"means": _input_means(state.params, data, last)}
    update = optimiser(settings).update
    updates, optimised = update(gradient, state.optimiser, state.params, **more)
    params = optax.apply_updates(state.params, updates)
    terms = {"loss": loss, "gradient": optax.tree.norm(gradient), **terms}
    return state._replace(params=params, optimiser=optimised, step=state.step + 1), terms, last


def _input_means(params, data: Simulation, last: State):
    """Means of each layer's inputs: those of one window more, which is the last one again."""

    def one_device(params, state, tensors):
        means = input_means(params, state, normalise(tensors)[0])
        return jax.lax.pmean(means, "devices")

    on_each = on_each_device(one_device, (REPLICATED, BATCH, TIME_BATCH), REPLICATED)
    return on_each(params, last, data.tensors[-1:])


@partial(jax.jit, static_argnames="settings", donate_argnames="state")
def train_step(
    state: TrainState, source: tuple[jax.Array, jax.Array] | Simulation, settings: StepSettings
) -> tuple[TrainState, dict[str, jax.Array]]:
    """(state, source) -> (state, losses): make data, scan, update.

    source: the run's key and textures (N, S, S), from which a step's sequences are simulated; or
    data of your own, a `Simulation` of settings.windows windows and settings.batch sequences.
    state: its arrays are donated, which saves copying them, so it cannot be used again: to take
    several steps from one state, pass `jax.tree.map(jnp.copy, state)`.
    losses: scalars by name, means over the step.
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
    remembers = settings.near_events and settings.chain > 1
    near = False
    if remembers:
        near = (cast(tuple, state.carried)[2] & jnp.asarray(warm)[:, None, None])[None]
    state, terms, last = _updated(state, data, before, warm, settings, near)
    carried = (seen, last) if settings.chain > 1 else None
    if remembers:
        now = (near | near_events(data.tensors)[-1:])[0]
        carried = seen, last, jax.lax.with_sharding_constraint(now, sharding(BATCH))
    return state._replace(carried=carried), terms


@partial(jax.jit, static_argnames="settings")
def simulated(key: jax.Array, textures: jax.Array, settings: StepSettings) -> Simulation:
    """New sequences, as long as a step's."""
    return _simulated(key, textures, settings)[0]


@partial(jax.jit, static_argnames="settings")
def validate(params, data: Simulation, settings: StepSettings):
    """(losses and metrics of a batch, pictures of its first sequence), from a zero state.

    Metrics use the images from l0 on, clipped. Pictures: images (T, H, W), truths (T, H, W) and
    event tensors (T, H, W, 5).
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
