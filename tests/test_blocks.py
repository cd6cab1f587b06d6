"""ConvGRU and residual block, and their gradients, against the formulas as they stand."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from firenet_jax import blocks, native
from firenet_jax.convolution import _plain


def sums(x, parameters):
    return _plain(x, parameters[0]) + parameters[1].reshape(1, 1, 1, -1)


def gru(h, x, gates, candidate):
    both = jax.nn.sigmoid(sums(jnp.concatenate([x, h], -1), gates))
    r, z = jnp.split(both, 2, -1)
    q = jnp.tanh(sums(jnp.concatenate([x, r * h], -1), candidate))
    return (1 - z) * h + z * q


def residual(x, first, second):
    return jax.nn.relu(x + sums(jax.nn.relu(sums(x, first)), second))


def parameters(rng, inputs, outputs, kind):
    kernel = 0.2 * rng.normal(size=(3, 3, inputs, outputs))
    return jnp.asarray(kernel, kind), jnp.asarray(rng.normal(size=outputs), kind)


def random_maps(rng, count, kind):
    return [jnp.asarray(rng.normal(size=(2, 9, 35, 16)), kind) for _ in range(count)]


def case_of(block, kind=jnp.float32):
    rng = np.random.default_rng(0)
    if block is blocks.gru:
        h, x = random_maps(rng, 2, kind)
        return h, x, parameters(rng, 32, 32, kind), parameters(rng, 32, 16, kind)
    return *random_maps(rng, 1, kind), *(parameters(rng, 16, 16, kind) for _ in range(2))


BOTH = pytest.mark.parametrize("block, formula", [(blocks.gru, gru), (blocks.residual, residual)])


def total(block, weights, *arguments):
    result = block(*arguments)
    return (result * weights).sum(), result


@BOTH
@pytest.mark.parametrize("alone", [False, True])
def test_equals_its_formula_with_all_gradients(block, formula, alone):
    case = case_of(block)
    (weights,) = random_maps(np.random.default_rng(1), 1, jnp.float32)
    places = tuple(range(1, 1 + len(case)))

    def by(block):
        function = jax.value_and_grad(partial(total, block), places, has_aux=True)
        return jax.jit(function)(weights, *case)

    with native.by_xla_alone(alone):
        found = by(lambda *case: block(*case))
    for a, b in zip(*map(jax.tree.leaves, (found, by(formula))), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-5 * max(1, np.abs(b).max()))


@BOTH
def test_gradients_are_differences_of_float64(block, formula):
    """Of the loss in a random direction, for each argument."""
    case, rng, step = case_of(block), np.random.default_rng(2), 1e-6
    (weights,) = random_maps(np.random.default_rng(1), 1, jnp.float32)
    places = tuple(range(1, 1 + len(case)))
    gradients = jax.grad(partial(total, block), places, has_aux=True)(weights, *case)[0]
    with jax.enable_x64(True):
        exact = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float64), (weights, *case))
        loss = jax.jit(lambda *arguments: total(formula, *arguments)[0])
        leaves, tree = jax.tree.flatten(exact)
        for i, gradient in enumerate(jax.tree.leaves(gradients), 1):
            direction = rng.normal(size=leaves[i].shape)
            ends = [
                float(
                    loss(
                        *tree.unflatten([*leaves[:i], leaves[i] + s * direction, *leaves[i + 1 :]])
                    )
                )
                for s in (step, -step)
            ]
            expected = (ends[0] - ends[1]) / (2 * step)
            found = float((np.asarray(gradient, np.float64) * direction).sum())
            largest = float(np.linalg.norm(gradient) * np.linalg.norm(direction))
            assert abs(found - expected) < 1e-5 * largest
