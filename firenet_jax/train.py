"""Simulated sequences -> parameters: one jitted step simulates, scans, and updates.

With `chain` more than 1 the steps of a chain see one long sequence, one part after the other
(truncated back-propagation): simulation and network go on from the states where the last step
left them, gradients stop there.

Step n is a function of the seed, n and the state alone, so a run that was interrupted and resumed
is the run that was not. A run is a folder:

    settings.json     what was asked for
    log.jsonl         one line for each logged step: losses, seconds
    checkpoints/      the whole state (orbax), the newest two
    weights.npz       the parameters that did best on the validation sequences so far
"""

import dataclasses
import json
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import orbax.checkpoint as ocp
import tyro
from tqdm import tqdm

from firenet_jax import metrics
from firenet_jax.checkpoint import load_weights, save_weights
from firenet_jax.events import logger
from firenet_jax.losses import Loss, sequence_loss
from firenet_jax.network import State, Weights, initial_params, initial_state, step
from firenet_jax.scenes import SceneSettings, load_textures
from firenet_jax.sensor import (
    FAULTY,
    SensorSettings,
    SensorState,
    first_states,
    random_setups,
    simulate,
)
from firenet_jax.tensors import normalise

TEXTURE = 256  # pixels on a side of a texture


@dataclass(frozen=True)
class Train:
    """Train FireNet on sequences that are simulated as it goes.

    Examples:
      firenet train -o run
      firenet train -o run --images coco/train2017 --steps 100000
      firenet train -o tuned --weights firenet.npz --learning-rate 1e-4
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder of the run; an interrupted run in it goes on."""
    weights: Annotated[Path | None, tyro.conf.arg(aliases=["-c"])] = None
    """Start from these weights instead of random ones."""
    images: Path | None = None
    """Folder of pictures for textures (default: scikit-image's photographs, and drawn ones)."""
    textures: int = 256
    """How many textures to cut from them."""
    procedural: float = 0.25
    """Part of the textures that is drawn instead."""
    steps: int = 20_000
    """Updates of the parameters."""
    batch: int = 2
    """Sequences in a step."""
    crop: int = 96
    """Height and width of the sequences, in pixels."""
    windows: int = 21
    """Windows in a step, L + 1 in the paper."""
    chain: int = 1
    """Steps through which a sequence goes on, its state carried from one to the next."""
    renderings: int = 5
    """Renderings in a window."""
    motion: tuple[float, float] = (1.25, 2.5)
    """Pixels by which the fastest point moves in a window, at most half of the renderings; drawn
    log-uniformly for a sequence."""
    learning_rate: float = 1e-3
    """Greatest rate of Adam, after warming up; it then falls to a hundredth along a cosine."""
    warmup: int = 200
    """Steps in which the rate rises from zero."""
    clip: float = 1.0
    """Gradients are scaled down to this norm."""
    seed: int = 0
    """Of the first parameters, the textures and all sequences."""
    bfloat16: bool = False
    """Convolutions in bfloat16."""
    remat: bool = False
    """Compute each step's maps again for the gradient: less memory, more time."""
    log_every: int = 20
    """Steps between two lines of the log."""
    validate_every: int = 500
    """Steps between two validations."""
    save_every: float = 120.0
    """Seconds between two checkpoints."""
    loss: Loss = Loss()
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
        )
        for name in positive:
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}, but must be more than 0")
        if not self.loss.l0 < self.windows <= self.loss.L + 1:
            raise ValueError(
                f"windows is {self.windows}, but the loss is over more than {self.loss.l0} and at "
                f"most {self.loss.L + 1} of them"
            )
        if self.warmup >= self.steps:
            raise ValueError(f"warmup is {self.warmup} steps of {self.steps}: use fewer")


class TrainState(NamedTuple):
    """All that a step needs from the last one."""

    params: Any
    optimiser: Any
    step: jax.Array  # () int32
    carried: tuple[SensorState, State] | None  # within a chain


def optimiser(settings: Train) -> optax.GradientTransformation:
    """Adam with clipped gradients; a step whose gradient is not finite changes nothing."""
    rate = optax.warmup_cosine_decay_schedule(
        0.0, settings.learning_rate, settings.warmup, settings.steps, settings.learning_rate / 100
    )
    adam = optax.chain(optax.clip_by_global_norm(settings.clip), optax.adam(rate))
    return optax.apply_if_finite(adam, max_consecutive_errors=10)


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
        params = jax.tree.map(jnp.asarray, weights.params)
    carried = None
    if settings.chain > 1:
        setups = jax.eval_shape(
            lambda key: _setups(key, jnp.zeros((1, TEXTURE, TEXTURE)), settings, 1),
            jax.random.key(0),
        )
        carried = jax.eval_shape(lambda *setups: _fresh(*setups, settings), *setups)
        carried = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), carried)
    return TrainState(params, optimiser(settings).init(params), jnp.int32(0), carried)


def _setups(key: jax.Array, textures: jax.Array, settings: Train, chain: int):
    """Sensors, scenes and bounds of all windows of a chain."""
    return random_setups(
        key,
        textures,
        batch=settings.batch,
        windows=chain * settings.windows,
        height=settings.crop,
        width=settings.crop,
        renderings=settings.renderings,
        motion=settings.motion,
        scene=settings.scene,
        sensor=settings.sensor,
    )


def _fresh(sensors, scenes, bounds, settings: Train) -> tuple[SensorState, State]:
    """What a sequence starts from."""
    size = settings.crop, settings.crop
    seen = first_states(sensors, scenes, bounds[0], height=size[0], width=size[1])
    return seen, initial_state(settings.batch, *size)


def _data(key, textures, settings: Train, state: TrainState | None = None):
    """Simulation of a step, the states of sensor and network before it, whether those are warm.

    Without a state: of a sequence on its own.
    """
    chain = 1 if state is None else settings.chain
    part = 0 if chain == 1 else state.step % chain
    sensors, scenes, bounds = _setups(key, textures, settings, chain)
    seen, remembered = _fresh(sensors, scenes, bounds, settings)
    warm = False
    if chain > 1:
        warm = part > 0
        choose = partial(jnp.where, warm)
        seen, remembered = jax.tree.map(choose, state.carried, (seen, remembered))
        first = part * settings.windows
        bounds = jax.lax.dynamic_slice_in_dim(bounds, first, settings.windows + 1)
    size = {"height": settings.crop, "width": settings.crop}
    seen, data = simulate(sensors, scenes, bounds, seen, renderings=settings.renderings, **size)
    return data, seen, remembered, warm


def images_of(
    params, tensors: jax.Array, settings: Train, state: State | None = None
) -> tuple[State, jax.Array]:
    """Event tensors (T, B, H, W, 5), not normalised -> last state, images (T, B, H, W).

    state: before the first window; None is the zero state.
    """
    run = partial(step, dtype=jnp.bfloat16 if settings.bfloat16 else jnp.float32)
    run = jax.checkpoint(run) if settings.remat else run

    def body(state: State, tensor: jax.Array):
        return run(params, state, tensor)

    state = initial_state(*tensors.shape[1:4]) if state is None else state
    return jax.lax.scan(body, state, normalise(tensors))


@partial(jax.jit, static_argnames="settings", donate_argnames="state")
def train_step(
    state: TrainState, key: jax.Array, textures: jax.Array, settings: Train
) -> tuple[TrainState, dict[str, jax.Array]]:
    """(state, the run's key, textures (N, S, S)) -> (state, losses): simulate, scan, update."""
    key = jax.random.fold_in(key, state.step // settings.chain)
    data, seen, remembered, warm = _data(key, textures, settings, state)

    def loss_of(params):
        last, images = images_of(params, data.tensors, settings, remembered)
        truth = data.images, data.displacement, data.visible
        loss, terms = sequence_loss(images, *truth, settings.loss, warm)
        return loss, (terms, last)

    (loss, (terms, last)), gradient = jax.value_and_grad(loss_of, has_aux=True)(state.params)
    updates, optimised = optimiser(settings).update(gradient, state.optimiser, state.params)
    params = optax.apply_updates(state.params, updates)
    terms = {"loss": loss, "gradient": optax.tree.norm(gradient), **terms}
    carried = (seen, last) if settings.chain > 1 else None
    return TrainState(params, optimised, state.step + 1, carried), terms


@partial(jax.jit, static_argnames="settings")
def validate(params, key: jax.Array, textures: jax.Array, settings: Train) -> dict:
    """Losses and metrics of one fixed batch; metrics over its images from l0 on, clipped."""
    data = _data(key, textures, settings)[0]
    images = images_of(params, data.tensors, settings)[1]
    loss, terms = sequence_loss(images, data.images, data.displacement, data.visible, settings.loss)
    shown, truths = jnp.clip(images[settings.loss.l0 :], 0, 1), data.images[settings.loss.l0 :]
    return {
        "loss": loss,
        "temporal": terms.get("temporal", jnp.zeros(())),
        "mse": metrics.mse(shown, truths).mean(),
        "ssim": metrics.ssim(shown, truths).mean(),
    }


def run(settings: Train) -> None:
    """Trains as the settings say, going on where an interrupted run stopped."""
    folder = settings.output
    _same_settings(folder, settings)
    training, others = textures_of(settings)
    key, validation_key = jax.random.split(jax.random.key(settings.seed + 1))
    validation_keys = jax.random.split(validation_key, 8)
    state = initial_train_state(settings)
    options = ocp.CheckpointManagerOptions(max_to_keep=2)
    with ocp.CheckpointManager((folder / "checkpoints").absolute(), options=options) as saved:
        if saved.latest_step() is not None:
            state = saved.restore(saved.latest_step(), args=ocp.args.StandardRestore(state))
            logger.warning("%s: going on after step %d", folder, state.step)
        log = Log(folder / "log.jsonl", int(state.step))
        best = log.best()
        last_save, done = time.monotonic(), int(state.step)
        with tqdm(total=settings.steps, initial=done, unit="step", disable=None) as progress:
            while done < settings.steps:
                state, terms = train_step(state, key, training, settings)
                done += 1
                progress.update()
                if done % settings.log_every == 0 or done == settings.steps:
                    terms = log.write(done, "train", terms)
                    progress.set_postfix(loss=f"{terms['loss']:.3f}", refresh=False)
                    _check_finite(terms, state, folder)
                if done % settings.validate_every == 0 or done == settings.steps:
                    scores = [validate(state.params, k, others, settings) for k in validation_keys]
                    means = jax.tree.map(lambda *values: np.mean(values), *scores)
                    means = log.write(done, "validation", means)
                    if means["loss"] < best:
                        best = means["loss"]
                        save_weights(folder / "weights.npz", Weights(_host(state.params), True))
                    save_weights(folder / "last.npz", Weights(_host(state.params), True))
                if time.monotonic() - last_save > settings.save_every or done == settings.steps:
                    saved.save(done, args=ocp.args.StandardSave(state))
                    last_save = time.monotonic()
    print(f"{folder / 'weights.npz'}: best validation loss {best:.4f} in {done} steps")


def textures_of(settings: Train) -> tuple[jax.Array, jax.Array]:
    """Textures to train on, and others to validate on.

    The others are cut anew, but from the same pictures: they choose between the steps of a run;
    how good a network is on pictures it never saw they do not tell.
    """

    def load(count, seed):
        return jnp.asarray(
            load_textures(settings.images, count, TEXTURE, seed, settings.procedural)
        )

    return load(settings.textures, settings.seed), load(32, settings.seed + 1)


class Log:
    """Lines of JSON; those beyond the checkpoint from which a run goes on are dropped."""

    def __init__(self, path: Path, step: int):
        self.path, self.start = path, time.monotonic()
        lines = path.read_text().splitlines() if path.exists() else []
        self.entries = [entry for line in lines if (entry := json.loads(line))["step"] <= step]
        path.write_text("".join(json.dumps(entry) + "\n" for entry in self.entries))

    def write(self, step: int, kind: str, values: dict) -> dict[str, float]:
        values = {name: float(value) for name, value in values.items()}
        entry = {"step": step, "kind": kind, **values, "seconds": time.monotonic() - self.start}
        with self.path.open("a") as file:
            file.write(json.dumps(entry) + "\n")
        return values

    def best(self) -> float:
        """The least validation loss so far."""
        losses = [entry["loss"] for entry in self.entries if entry["kind"] == "validation"]
        return min(losses, default=float("inf"))


def _host(params):
    return jax.tree.map(np.asarray, jax.device_get(params))


def _check_finite(terms: dict[str, float], state: TrainState, folder: Path) -> None:
    if not np.isfinite(terms["loss"]) and int(state.optimiser.notfinite_count) >= 10:
        raise ValueError(
            f"{folder}: ten steps in a row had no finite gradient, training has diverged: start "
            "again with a smaller --learning-rate"
        )


def _same_settings(folder: Path, settings: Train) -> None:
    """Keeps the settings in the folder; raises ValueError if a run of others is there."""
    folder.mkdir(parents=True, exist_ok=True)
    choices = {k: v for k, v in dataclasses.asdict(settings).items() if k != "output"}
    text = json.dumps(choices, default=str, indent=1)
    path = folder / "settings.json"
    if path.exists() and path.read_text() != text:
        raise ValueError(f"{folder} holds a run with other settings: choose another --output")
    path.write_text(text)
