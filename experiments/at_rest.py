"""Weights -> the same, but that go on showing what they saw when nothing happens any more.

The last stage of train_default.py: 300 steps, a quarter of an hour on one core. Training on truth
had not kept images from drifting at rest. Here the network is its own teacher: whatever comes after
the last event, nothing or balanced noise, its image is to stay as it was, and of sequences in which
things move it is to make what it made before. Only what has a memory, or leads to it, is trained.

    loss = |I - I_0| + 3 |mean(I - I_0)| + 6 |J - J_0|

I is at rest and I_0 the image before, J is of what moves and J_0 the teacher's. Rests last up to
1,000 windows, in most of the sequences; states go on from step to step, as with `chain`, while
gradients reach back over the 20 windows of a step.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from firenet_jax.checkpoint import load_weights, save_weights
from firenet_jax.network import State, initial_state
from firenet_jax.simulation.textures import load_textures
from firenet_jax.storage.progress import bar
from firenet_jax.training.settings import Train
from firenet_jax.training.step import TEXTURE, images_of, simulated

FREE = ("gru1", "res1", "gru2")
# Events per pixel in a window, of each sequence at rest.
NOISES = np.array([0, 0, 0.02, 0.02, 0.35, 0.35, 0.1, 0.005], np.float32)
LONGEST, SHORTER = 50, 0.4  # steps of a rest; the share of those that end earlier
MOVING = 12  # batches of sequences in which things move


class Seen(NamedTuple):
    """A batch of what moves, and what the teacher makes of it."""

    tensors: jax.Array  # (T, B, H, W, 5)
    images: jax.Array  # (T, B, H, W)
    last: State


def keep_at_rest(path: Path, settings: Train, made: Path, steps: int, rate: float) -> Path:
    """Trains the weights at `path` on sequences of these settings; writes them to `made`.

    settings.batch is the number of `NOISES`, as each place of a batch rests in one of them.
    """
    weights = load_weights(path)
    step_settings = settings.step_settings
    size = settings.crop, settings.crop
    optimiser = optax.chain(
        optax.clip_by_global_norm(1.0), optax.adam(optax.cosine_decay_schedule(rate, steps, 0.02))
    )
    textures = jnp.asarray(
        load_textures(
            settings.images, settings.textures, TEXTURE, settings.seed, settings.procedural
        )
    )

    @jax.jit
    def teach(tensors):
        return images_of(weights.params, tensors, step_settings)

    @jax.jit
    def step(free, optimised, resting, before, noise, tensors, images):
        def loss(free):
            params = weights.params | free
            after, shown = images_of(params, noise, step_settings, resting)
            away = shown - before[None]
            made = images_of(params, tensors, step_settings)[1]
            moved = jnp.abs(away).mean() + 3 * jnp.abs(away.mean((-2, -1))).mean()
            return moved + 6 * jnp.abs(made - images).mean(), after

        (value, after), gradient = jax.value_and_grad(loss, has_aux=True)(free)
        updates, optimised = optimiser.update(gradient, optimised, free)
        return optax.apply_updates(free, updates), optimised, after, value

    seen = []
    for k in range(MOVING):
        tensors = simulated(jax.random.key(1000 + k), textures, step_settings).tensors
        last, images = teach(tensors)
        seen.append(Seen(tensors, images, last))

    rng, count = np.random.default_rng(settings.seed), len(NOISES)
    resting, before = initial_state(count, *size), jnp.zeros((count, *size))
    left = np.zeros(count, int)  # steps of each rest
    free = {name: weights.params[name] for name in FREE}
    optimised = optimiser.init(free)
    with bar(steps, "step") as progress:
        for k in range(steps):
            for place in np.flatnonzero(left == 0):
                one = seen[rng.integers(MOVING)]
                resting = jax.tree.map(partial(_put, place), resting, one.last)
                before = _put(place, before, one.images[-1])
                short = rng.random() < SHORTER
                left[place] = LONGEST ** rng.random() + 1 if short or k == 0 else LONGEST
            noise = balanced(jax.random.key(5000 + k), (settings.windows, count, *size, 5))
            one, half = seen[rng.integers(MOVING)], rng.choice(count, count // 2, replace=False)
            free, optimised, resting, loss = step(
                free, optimised, resting, before, noise, one.tensors[:, half], one.images[:, half]
            )
            left -= 1
            progress.update()
            progress.set_postfix(loss=f"{loss:.3f}", refresh=False)
    save_weights(made, replace(weights, params=weights.params | free))
    return made


def balanced(key: jax.Array, shape: tuple[int, ...], noises: np.ndarray = NOISES) -> jax.Array:
    """Event tensors (T, B, H, W, 5) of noise, ON as often as OFF, so many events per pixel."""
    fired_key, sign_key = jax.random.split(key)
    fired = jax.random.uniform(fired_key, shape) < noises[None, :, None, None, None] / shape[-1]
    signs = jnp.where(jax.random.bernoulli(sign_key, shape=shape), 1.0, -1.0)
    return jnp.where(fired, signs, 0.0)


def _put(place: int, whole: jax.Array, batch: jax.Array) -> jax.Array:
    return whole.at[place].set(batch[place])
