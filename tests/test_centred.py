"""experiments/centred.py against autodiff in the other parametrisation, and the network's maps."""

import importlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from firenet_jax.checkpoint import load_weights
from firenet_jax.network import initial_params, initial_state, step
from firenet_jax.tensors import normalise
from firenet_jax.training.settings import Train

EXPERIMENTS = Path(__file__).parents[1] / "experiments"


@pytest.fixture
def centred(monkeypatch):
    monkeypatch.syspath_prepend(EXPERIMENTS)
    return importlib.import_module("centred")


def random_means(centred, params):
    key = jax.random.key(3)

    def draw(zeros):
        return jax.random.normal(jax.random.fold_in(key, zeros.size), zeros.shape)

    return jax.tree.map(draw, centred.no_means(params))


def test_gradients_and_updates_are_those_of_centred_inputs(centred):
    params = initial_params(jax.random.key(0))
    means = random_means(centred, params)
    tensors = jax.random.normal(jax.random.key(1), (2, 16, 12, 5))

    def usual(each):  # K (x - m) + b = K x + (b - K m)
        def change(part, m):
            return part | {"bias": part["bias"] - jnp.einsum("i,hwio->o", m, part["kernel"])}

        return centred.each_layer(each, change, means)

    def loss(each):
        state, _ = step(each, initial_state(2, 16, 12), tensors)
        return (step(each, state, tensors)[1] ** 2).sum()

    def there(part, m):  # the same function of x as `params`, with centred inputs
        return part | {"bias": part["bias"] + jnp.einsum("i,hwio->o", m, part["kernel"])}

    moved = centred.each_layer(params, there, means)
    expected = jax.grad(lambda each: loss(usual(each)))(moved)
    found = centred.of_centred(jax.grad(loss)(params), means)
    scale = max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(expected))
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4 * scale)

    update = jax.tree.map(
        lambda leaf: 1e-2 * jnp.cos(jnp.arange(leaf.size)).reshape(leaf.shape), moved
    )
    expected = usual(jax.tree.map(jnp.add, moved, update))
    found = jax.tree.map(jnp.add, params, centred.of_usual(update, means))
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_means_are_those_of_the_networks_maps(centred):
    params = initial_params(jax.random.key(0))
    tensors = 3 * jax.random.normal(jax.random.key(1), (4, 2, 16, 12, 5))
    state = initial_state(2, 16, 12)
    means = centred.input_means(params, tensors, state)
    before, after = [], []
    for tensor in normalise(tensors):
        before.append(state)
        state, _ = step(params, state, tensor)
        after.append(state)
    for block, behind, name in (("gru1", "res1", "g1"), ("gru2", "res2", "g2")):
        earlier, later = ([getattr(each, name) for each in states] for states in (before, after))
        gates, first = means[block]["gates"][16:], means[behind]["conv1"]
        np.testing.assert_allclose(gates, np.mean(earlier, (0, 1, 2, 3)), atol=1e-5)
        np.testing.assert_allclose(first, np.mean(later, (0, 1, 2, 3)), atol=1e-5)
    assert (means["head"] == 0).all()
    assert float(means["prediction"].min()) >= 0  # behind a ReLU


@pytest.mark.slow
def test_it_trains(centred, tmp_path):
    settings = Train(
        output=tmp_path / "run", textures=4, batch=2, crop=24, windows=11, chain=2, renderings=3
    )
    assert centred.run_centred(settings, minutes=1e-4) >= 1
    params = load_weights(tmp_path / "run" / "last.npz").params
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params))
    first = initial_params(jax.random.key(settings.seed))
    assert any(
        (np.asarray(a) != np.asarray(b)).any()
        for a, b in zip(jax.tree.leaves(params), jax.tree.leaves(first), strict=True)
    )
