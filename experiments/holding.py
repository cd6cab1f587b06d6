"""Weights -> weights that show more and remember what they did: trained on truth, memory held.

Stages of train_default.py, an hour on one core each. Training on truth alone had made images better
and let them forget, so that the parts that remember were put back or kept fixed. Here all parts are
trained, and each step also has

    rest        states that earlier steps left, when nothing follows, or balanced noise: the image
                is to stay as it was before
    palindrome  windows of earlier steps backward and forward again (time reversed, polarity
                inverted), up to forty times: each image is to be that of the first round, which
                begins when the state has seen both directions

    loss = L + 20 hold (|I - I_0| + 3 |mean(I - I_0)|) for each of the two, 20 windows in a step

I_0 is what the network itself made, then: it may become another, but is to stay that. For
palindromes a stage may have, in place of that, which is smaller where there is less contrast,

    20 alike (1 - correlation(I, I_0) + 3 |mean(I - I_0)|)

Gradients reach back over the windows of a step, states go on. What is written is a moving average.
"""

import contextlib
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from at_rest import balanced

from firenet_jax.checkpoint import load_weights, save_weights
from firenet_jax.evaluation import metrics
from firenet_jax.network import State, initial_state
from firenet_jax.simulation.textures import load_textures
from firenet_jax.storage.progress import bar
from firenet_jax.training import step as steps_of
from firenet_jax.training.settings import Train
from firenet_jax.training.step import (
    TEXTURE,
    StepSettings,
    TrainState,
    images_of,
    initial_train_state,
    loss_of,
)

NOISES = np.array([0, 0.02, 0.35, 0.1], np.float32)  # events per pixel, of each place at rest
LONGEST, SHORTER = 30, 0.5  # steps of a rest; the share of those that end earlier
RAMP, DECAY = 40, 0.995  # steps until the rate is reached; of the average


class Holding(NamedTuple):
    """How a stage holds."""

    turning: int = 2  # places that go to and fro
    turns: tuple[int, int] = (6, 40)  # so many times
    hold: float = 2.0  # how much staying weighs
    alike: float = 0.0  # how much correlation weighs, in place of that
    cut: int = 64  # pixels on a side of what rests and of what goes to and fro
    faint: float = metrics.FAINT  # what is so much brighter is so for sure, in the equalised losses


class Held(NamedTuple):
    """What is held, from step to step."""

    resting: State
    before: jax.Array  # (N, C, C) images before the rest
    turning: State
    tensors: jax.Array  # (T, M, C, C, 5) of what goes to and fro
    first: tuple[jax.Array, jax.Array]  # (T, M, C, C) images of the first round, backward, forward
    passes: jax.Array  # (M,) int32, how often they have been passed


def nothing_held(windows: int, how: Holding = Holding()) -> Held:
    size = how.cut, how.cut
    moving = jnp.zeros((windows, how.turning, *size))
    return Held(
        initial_state(len(NOISES), *size), jnp.zeros((len(NOISES), *size)),
        initial_state(how.turning, *size), jnp.zeros((*moving.shape, 5)),
        (moving, moving), jnp.zeros(how.turning, jnp.int32),
    )  # fmt: skip


def moved(images: jax.Array, wanted: jax.Array, counts: jax.Array) -> jax.Array:
    """How far (T, N, C, C) images are from these, of the places (N,) that count."""
    away = (images - wanted) * counts[None, :, None, None]
    return jnp.abs(away).mean() + 3 * jnp.abs(away.mean((-2, -1))).mean()


def unlike(images: jax.Array, wanted: jax.Array, counts: jax.Array) -> jax.Array:
    """As `moved`, but by correlation, which less contrast does not raise."""
    a, b = (each - each.mean((-2, -1), keepdims=True) for each in (images, wanted))
    alike = (a * b).mean((-2, -1))
    alike /= jnp.sqrt((a * a).mean((-2, -1)) * (b * b).mean((-2, -1)) + 0.02**4)
    shift = jnp.abs((images - wanted).mean((-2, -1)))
    return ((1 - alike + 3 * shift) * counts[None]).mean()


@contextlib.contextmanager
def telling_apart(faint: float):
    """The equalised losses of what is compiled meanwhile tell apart what differs by half of this:
    the less, the more faint texture of flat areas counts."""

    def tell(faint, tones):
        metrics.FAINT, metrics.TONES = faint, tones
        metrics.equalised_ssim.clear_cache()  # what was compiled has the former
        metrics.equalised_mse.clear_cache()

    before = metrics.FAINT, metrics.TONES
    tell(faint, np.linspace(-0.1, 1.1, round(4.8 / faint) + 1, dtype=np.float32))
    try:
        yield
    finally:
        tell(*before)


def next_pass(held: Held) -> tuple[jax.Array, jax.Array]:
    """Event tensors of the next pass, backward first, and the images that are wanted."""
    back = (held.passes % 2 == 0)[None, :, None, None]
    tensors = jnp.where(back[..., None], -held.tensors[::-1, ..., ::-1], held.tensors)
    return tensors, jnp.where(back, *held.first)


@partial(jax.jit, static_argnames=("settings", "how"), donate_argnames="state")
def hold_step(
    state: TrainState, held: Held, source: tuple[jax.Array, jax.Array],
    ends: tuple[jax.Array, jax.Array], rate: jax.Array, settings: StepSettings, how: Holding,
) -> tuple[TrainState, Held, dict[str, jax.Array]]:  # fmt: skip
    """source: as of `train_step`; ends: (N,) and (M,) bool, what ends with this step; rate: by
    which the update is multiplied."""
    (key, textures), number = source, state.step
    data, (seen, before), warm = steps_of._simulated(key, textures, settings, state)
    noise_key, cut_key = jax.random.split(jax.random.fold_in(key, number + 10**6))
    size = settings.windows, len(NOISES), how.cut, how.cut, 5
    noise, (tensors, first) = balanced(noise_key, size, NOISES), next_pass(held)

    def loss(params):
        value, (terms, last, images) = loss_of(params, data, before, warm, settings)
        rested, at_rest = images_of(params, noise, settings, held.resting)
        turned, passed = images_of(params, tensors, settings, held.turning)
        rest = moved(at_rest, held.before[None], (held.before.max((-2, -1)) > 0) * 1.0)
        counts = (held.passes >= 4) * 1.0
        palindrome = (unlike if how.alike else moved)(passed, first, counts)
        terms |= {"loss": value, "rest": rest, "palindrome": palindrome}
        value += settings.windows * (how.hold * rest + (how.alike or how.hold) * palindrome)
        return value, (terms, last, images, rested, turned, passed)

    gradient, (terms, last, images, rested, turned, passed) = jax.grad(loss, has_aux=True)(
        state.params
    )
    updates, optimised = steps_of.optimiser(settings).update(
        gradient,
        state.optimiser,
        state.params,
        means=steps_of._input_means(state.params, data, last),
    )
    updates = jax.tree.map(lambda update: rate * update, updates)
    params: Any = optax.apply_updates(state.params, updates)
    state = TrainState(params, optimised, state.step + 1, (seen, last))

    # What has ended begins anew with a part of what this step saw.
    corner = jax.random.randint(cut_key, (2,), 0, settings.crop - how.cut + 1)

    def renewed(old, new, ending, axis=0, start=1):
        for i in range(2):
            new = jax.lax.dynamic_slice_in_dim(new, corner[i], how.cut, start + i)
        new = jnp.take(new, (jnp.arange(len(ending)) + number) % settings.batch, axis)
        chosen = jnp.expand_dims(ending, [n for n in range(new.ndim) if n != axis])
        return jnp.where(chosen, new, old)

    rest_ends, turn_ends = ends
    second = [
        jnp.where((held.passes == n)[None, :, None, None], passed, old)
        for n, old in zip((2, 3), held.first, strict=True)
    ]
    held = Held(
        jax.tree.map(lambda old, new: renewed(old, new, rest_ends), rested, last),
        renewed(held.before, images[-1], rest_ends),
        jax.tree.map(lambda old, new: renewed(old, new, turn_ends), turned, last),
        renewed(held.tensors, data.tensors, turn_ends, 1, 2),
        (second[0], second[1]),
        jnp.where(turn_ends, 0, held.passes + 1),
    )
    return state, held, terms


def train_and_hold(
    path: Path, settings: Train, made: Path, steps: int, how: Holding = Holding()
) -> Path:
    """Trains the weights at `path` with these settings; writes them to `made`."""
    weights, step_settings = load_weights(path), replace(settings, steps=10**7).step_settings
    textures = load_textures(
        settings.images, settings.textures, TEXTURE, settings.seed, settings.procedural
    )
    source = jax.random.key(settings.seed + 1), jnp.asarray(textures)
    state = initial_train_state(jax.tree.map(jnp.array, weights.params), step_settings)
    held = nothing_held(settings.windows, how)
    average = jax.tree.map(jnp.array, weights.params)
    rng = np.random.default_rng(settings.seed)
    left = np.ones(len(NOISES), int), np.ones(how.turning, int)  # steps of each
    with bar(steps, "step") as progress, telling_apart(how.faint):
        for k in range(steps):
            rate = min(1, (k + 1) / RAMP) * (0.02 + 0.49 * (1 + np.cos(np.pi * k / steps)))
            ends = tuple(jnp.asarray(each <= 1) for each in left)
            state, held, terms = hold_step(
                state, held, source, ends, jnp.float32(rate), step_settings, how
            )
            for each in left:
                each -= 1
            for place in np.flatnonzero(left[0] == 0):
                short = rng.random() < SHORTER
                left[0][place] = LONGEST ** rng.random() + 1 if short else LONGEST
            for place in np.flatnonzero(left[1] == 0):
                left[1][place] = rng.uniform(*how.turns)
            share = 1 - min(DECAY, (k + 1) / (k + 20))
            average = jax.tree.map(lambda a, p: a + share * (p - a), average, state.params)  # noqa: B023
            progress.update()
            progress.set_postfix(loss=f"{terms['loss']:.3f}", refresh=False)
    save_weights(made, replace(weights, params=jax.tree.map(np.asarray, average)))
    return made
