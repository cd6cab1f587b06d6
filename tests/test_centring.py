"""Centred updates against autodiff in the other parametrisation; means against the network's."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from firenet_jax.network import initial_params, initial_state, step
from firenet_jax.training import centring


def random_means(params):
    key = jax.random.key(3)

    def draw(zeros):
        return jax.random.normal(jax.random.fold_in(key, zeros.size), zeros.shape)

    return jax.tree.map(draw, centring._zeros(params))


def shifted(params, means, sign):
    """The same function of x - m, once the biases have moved by sign K m."""

    def change(part, m):
        return part | {"bias": part["bias"] + sign * jnp.einsum("i,hwio->o", m, part["kernel"])}

    return centring._each_layer(change, params, means)


def assert_equal(found, expected, tolerance):
    scale = max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(expected))
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=tolerance * scale)


def loss(params):
    tensors = jax.random.normal(jax.random.key(1), (2, 16, 12, 5))
    state, _ = step(params, initial_state(2, 16, 12), tensors)
    return (step(params, state, tensors)[1] ** 2).sum()


def test_gradients_are_those_of_centred_inputs():
    params = initial_params(jax.random.key(0))
    means = random_means(params)
    expected = jax.grad(lambda each: loss(shifted(each, means, -1)))(shifted(params, means, 1))
    assert_equal(centring.of_centred(jax.grad(loss)(params), means), expected, 1e-4)


def test_a_step_is_one_of_centred_inputs_with_the_mean_of_what_was_seen():
    params = initial_params(jax.random.key(0))
    seen = [random_means(params), random_means(params)]
    seen[1] = jax.tree.map(lambda m: 3 * m, seen[1])
    update = optax.GradientTransformationExtraArgs(*centring.centred(optax.sgd(1e-3)))
    state, now = update.init(params), params
    for number, means in enumerate(seen):
        gradient = jax.grad(loss)(now)
        change, state = update.update(gradient, state, now, means=means)
        running = jax.tree.map(lambda *m: sum(m) / len(m), *seen[: number + 1])  # noqa: B023
        there = shifted(now, running, 1)
        by = jax.grad(lambda each, m=running: loss(shifted(each, m, -1)))(there)
        expected = shifted(jax.tree.map(lambda p, g: p - 1e-3 * g, there, by), running, -1)
        now = optax.apply_updates(now, change)
        assert_equal(now, expected, 1e-4)


def test_what_was_seen_long_ago_is_forgotten():
    params = initial_params(jax.random.key(0))
    init, update = centring.centred(optax.identity())
    state, none = init(params), centring._zeros(params)
    count = 300
    means = jax.tree.map(lambda zeros: zeros + 5, none)
    advance = jax.jit(lambda state, means: update(params, state, means=means)[1])
    state = advance(state, means)
    for _ in range(count):
        state = advance(state, none)
    assert all(0 < float(leaf.max()) < 1e-3 for leaf in jax.tree.leaves(state.means))


@pytest.mark.parametrize("size", [(16, 12), (9, 23)])
def test_means_are_those_of_the_networks_maps(size):
    params = initial_params(jax.random.key(0))
    tensors = jax.random.normal(jax.random.key(1), (4, 2, *size, 5))
    before = initial_state(2, *size)
    for tensor in tensors[:3]:
        before, _ = step(params, before, tensor)
    after, image = step(params, before, tensors[3])
    means = centring.input_means(params, before, tensors[3])
    assert jax.tree.structure(means) == jax.tree.structure(centring._zeros(params))
    for block, behind, name in (("gru1", "res1", "g1"), ("gru2", "res2", "g2")):
        earlier, later = (getattr(state, name).mean((0, 1, 2)) for state in (before, after))
        np.testing.assert_allclose(means[block]["gates"][16:], earlier, atol=1e-5)
        np.testing.assert_allclose(means[behind]["conv1"], later, atol=1e-5)
    assert (means["head"] == 0).all()
    last = params["prediction"]
    predicted = means["prediction"] @ last["kernel"][0, 0] + last["bias"]
    np.testing.assert_allclose(predicted, image.mean(), atol=1e-5)
