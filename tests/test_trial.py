"""Machine code and XLA on random cases: equal results, whoever calls, and nothing else touched.

Equal is 1e-5 of the largest number (Winograd against direct sums, after several layers), and not a
number wherever XLA's is not.
"""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from processes import FEW_OPTIMISATIONS, OLD_EMITTERS
from test_native import pytestmark as pytestmark  # where there is machine code

from firenet_jax import convolution, native
from firenet_jax.checkpoint import load_weights
from firenet_jax.network import State, Weights
from firenet_jax.reconstruction import reconstruct

BUILT_IN = load_weights(None).params


def random_case(rng, height, width, batch, steps=2, normalise=True):
    """Weights, state, votes, and which windows exist."""

    def normal(*shape):
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    params = jax.tree.map(lambda x: x + 0.02 * normal(*x.shape), BUILT_IN)
    state = State(*(jnp.tanh(normal(batch, height, width, 16)) for _ in range(2)))
    votes = rng.random((steps, batch, height, width, 5)) < rng.choice([0.01, 0.3, 1])
    tensors = normal(steps, batch, height, width, 5) * votes
    valid = jnp.asarray(rng.random((steps, batch)) < 0.8)
    return Weights(params, normalise), state, tensors, valid


def random_size(rng):
    """Of 1x1 to 200x200, small ones as often as large ones."""
    height, width = np.exp(rng.uniform(0, np.log(201), 2)).astype(int)
    return int(height), int(width), int(rng.integers(1, 6))


def assert_equal(found, expected):
    """Where ours is a number, it is theirs."""
    for a, b in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
        a, b = np.asarray(a), np.asarray(b)
        assert np.isnan(a[np.isnan(b)]).all()
        numbers = np.isfinite(a) & np.isfinite(b)
        largest = np.abs(b[numbers]).max(initial=1)
        np.testing.assert_allclose(a[numbers], b[numbers], rtol=0, atol=1e-5 * largest)


def both_ways(function):
    """function(machine_code) -> a function of arrays; asserts that both give the same."""

    def check(*arguments):
        found, expected = (jax.jit(function(ours))(*arguments) for ours in (True, False))
        assert_equal(found, expected)
        return found

    return check


def steps(machine_code):
    return lambda *case: reconstruct(*case, machine_code=machine_code)


def of_layer(machine_code):
    """Two maps -> gates, all gradients too."""

    def function(maps, kernel, bias, weights):
        def total(maps, kernel, bias):
            results = convolution.layer(maps, kernel, bias, ("sigmoid", "tanh"))
            return sum((a * b).sum() for a, b in zip(results, weights, strict=True)), results

        # The total itself cancels to nearly nothing: rounding is not small beside it.
        with native.by_xla_alone(not machine_code):
            gradients, results = jax.grad(total, (0, 1, 2), has_aux=True)(maps, kernel, bias)
        return results, gradients

    return function


def random_layer(rng, height, width, batch, inputs=16):
    def normal(*shape):
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    maps = [normal(batch, height, width, inputs) for _ in range(2)]
    kernel = 0.1 * normal(3, 3, 2 * inputs, 32)
    return maps, kernel, normal(32), [normal(batch, height, width, 16) for _ in range(2)]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_random_sizes_batches_and_masks(seed):
    rng = np.random.default_rng(seed)
    size = random_size(rng)
    both_ways(steps)(*random_case(rng, *size, normalise=bool(seed % 2)))
    both_ways(of_layer)(*random_layer(rng, *size, inputs=int(rng.choice([5, 16]))))


@pytest.mark.parametrize("what", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_stays_so_and_near(what, monkeypatch):
    """Winograd's tiles carry it by up to 4 rows a convolution.

    Held against XLA's own convolution: side by side, pixels carry it on to their neighbours too.
    """
    monkeypatch.setattr(convolution, "_convolve", convolution._plain)
    rng = np.random.default_rng(7)
    weights, state, tensors, valid = random_case(rng, 90, 40, 2, steps=1, normalise=False)
    valid = jnp.ones_like(valid)
    tensors = tensors.at[0, 1, 2, 20, 3].set(what)
    found = steps(True)(weights, state, tensors, valid)
    expected = steps(False)(weights, state, tensors, valid)
    assert_equal(found, expected)
    assert np.isfinite(found[1][0, 0]).all()  # the other image of the batch
    assert np.isfinite(found[1][0, 1, 2 + 4 * 9 + 1 :]).all()


@pytest.mark.slow
def test_eight_threads_at_once():
    """Each has sizes, masks and gradients of its own."""
    rng = np.random.default_rng(0)
    sizes = [(9, 30, 1), (30, 9, 3), (16, 16, 2), (5, 5, 1)]
    runs, layers = jax.jit(steps(True)), jax.jit(of_layer(True))
    cases = [(runs, random_case(rng, *size)) for size in sizes]
    cases += [(layers, random_layer(rng, *size)) for size in sizes]
    first = [jax.tree.map(np.asarray, function(*case)) for function, case in cases]

    def run(i):
        function, case = cases[i % len(cases)]
        found = jax.tree.map(np.asarray, function(*case))
        jax.tree.map(np.testing.assert_array_equal, found, first[i % len(cases)])

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(run, range(160)))


def random_cases():
    """One, and three as one array each."""
    rng = np.random.default_rng(1)
    cases = [random_case(rng, 6, 7, 2) for _ in range(3)]
    return cases[0], jax.tree.map(lambda *leaves: jnp.stack(leaves), *cases)


@pytest.mark.slow
def test_mapped():
    _, stacked = random_cases()
    both_ways(lambda ours: jax.vmap(steps(ours)))(*stacked)
    both_ways(lambda ours: lambda *cases: jax.lax.map(lambda x: steps(ours)(*x), cases))(*stacked)


@pytest.mark.slow
def test_differentiated_and_computed_again():
    case, stacked = random_cases()

    def gradient(machine_code):
        def loss(weights, state, tensors, valid):
            state, images = jax.checkpoint(steps(machine_code))(weights, state, tensors, valid)
            return (images**2).sum() + state.g1.sum()

        return jax.grad(loss, (0, 1, 2))

    both_ways(gradient)(*case)
    both_ways(lambda ours: jax.vmap(gradient(ours)))(*stacked)


# ---- Other processes

EQUAL = """
import jax, numpy as np

def check(seed):
    import test_trial as trial
    from firenet_jax.native import choice
    rng = np.random.default_rng(seed)
    case = trial.random_case(rng, 12, 17, 4)
    trial.assert_equal(trial.steps(True)(*case), trial.steps(False)(*case))
    assert choice._made and not choice._failure
    return seed
"""
FORKED = """
import multiprocessing, warnings
import firenet_jax.native.whole_step
if __name__ == "__main__":
    with multiprocessing.get_context("fork").Pool(2) as pool:  # JAX has not begun to work here
        assert pool.map(check, [1, 2]) == [1, 2]
    check(3)
"""
ON_DEVICES = """
from functools import partial
from jax.sharding import Mesh, NamedSharding, PartitionSpec as P
import test_trial as trial
assert jax.device_count() == 4
mesh = Mesh(np.array(jax.devices()), "b")
rng = np.random.default_rng(0)
weights, state, tensors, valid = trial.random_case(rng, 12, 17, 4)
specs = P(), P("b"), P(None, "b"), P(None, "b")
def on_each(ours):
    function = trial.steps(ours)
    return jax.shard_map(
        lambda w, s, x, v: function(w, s, x, v), mesh=mesh, in_specs=specs,
        out_specs=(P("b"), P(None, "b")), check_vma=False,
    )
found = trial.both_ways(on_each)(weights, state, tensors, valid)
trial.assert_equal(found, trial.steps(False)(weights, state, tensors, valid))
"""


def run_alone(script, **environment):
    environment = {"FIRENET_NATIVE": "1"} | FEW_OPTIMISATIONS | environment
    path = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, path))} | environment
    subprocess.run([sys.executable, "-c", EQUAL + script], env=environment, check=True)


@pytest.mark.slow
def test_on_four_devices():
    run_alone(ON_DEVICES, XLA_FLAGS=f"{OLD_EMITTERS} --xla_force_host_platform_device_count=4")


@pytest.mark.slow
def test_in_forked_processes():
    """Before JAX works: after that its threads are missing in a fork, whatever it computes."""
    run_alone(FORKED)


@pytest.mark.slow
@pytest.mark.parametrize("switch", ["1", "avx2"])
def test_nothing_is_touched_beside_the_arrays(switch):
    """Of the whole step and of a convolution and its gradients."""
    script = Path(__file__).with_name("guarded.py")
    environment = os.environ | FEW_OPTIMISATIONS | {"FIRENET_NATIVE": switch}
    subprocess.run([sys.executable, script], env=environment, check=True)


@pytest.mark.slow
def test_without_avx512():
    """Random sizes as above; by the environment, as names of what was made know nothing of it."""
    script = """
import test_trial as trial
from firenet_jax.native import llvm
assert llvm.vectors() == 8
for seed in range(40, 48):
    trial.test_random_sizes_batches_and_masks(seed)
"""
    run_alone(script, FIRENET_NATIVE="avx2")
