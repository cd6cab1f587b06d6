import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_network import random_run

pytest.importorskip("llvmlite")

from firenet_jax import native, network
from firenet_jax.native import llvm, whole_step, winograd
from firenet_jax.network import State, Weights, initial_state
from firenet_jax.reconstruction import reconstruct
from firenet_jax.tensors import normalise

pytestmark = pytest.mark.skipif(
    jax.default_backend() != "cpu" or llvm.vectors() == 0,
    reason="no machine code for this processor",
)


def random_state(batch, height, width, seed=5):
    keys = jax.random.split(jax.random.key(seed))
    return State(*(jnp.tanh(jax.random.normal(k, (batch, height, width, 16))) for k in keys))


def scanned(step, state, tensors, exists):
    return jax.lax.scan(lambda state, inputs: step(state, *inputs), state, (tensors, exists))


def both(params, state, tensors, exists):
    """By XLA, and by machine code."""

    def plain(state, tensor, exists):
        with native.by_xla_alone():
            return network.step(params, state, tensor, exists)

    packed = native.pack(params)

    def ours(state, tensor, exists):
        return native.step(packed, state, tensor, exists)

    expected = scanned(plain, state, tensors, exists)
    after, images = scanned(ours, tuple(state), tensors, exists)
    return expected, (State(*after), images)


def slow(*sizes):
    return [pytest.param(*size, marks=pytest.mark.slow) for size in sizes]


@pytest.mark.parametrize(
    "height, width",
    [(1, 1), (7, 2), (13, 25), *slow((2, 2), (1, 5), (5, 9), (12, 24), (20, 53), (9, 346))],
)
def test_equals_the_step_of_the_network(height, width):
    """Even and odd sides, one tile and many blocks of them; images that do not exist."""
    params, tensors = random_run(steps=4, batch=3, height=height, width=width)
    exists = jnp.array([[True, True, True], [True, False, True], [False] * 3, [True] * 3])
    expected, found = both(params, random_state(3, height, width), tensors, exists)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), found, expected)


@pytest.mark.parametrize("height, width", [(1, 1), (13, 25), *slow((2, 3), (20, 53))])
def test_normalises_as_tensors_do(height, width):
    """Votes around a mean; none; all the same; and few that hardly differ."""
    params, _ = random_run(steps=1, batch=1, height=height, width=width)
    rng = np.random.default_rng(3)
    tensor = rng.normal(0.5, 3, (4, height, width, 5)) * (rng.random((4, height, width, 5)) < 0.4)
    tensor[1], tensor[2], tensor[3] = 0, -1, 1e-8 * rng.normal(size=tensor[3].shape)
    tensor = jnp.asarray(tensor, jnp.float32)
    state, packed = random_state(4, height, width), native.pack(params)
    expected = native.step(packed, tuple(state), normalise(tensor))
    found = native.step(packed, tuple(state), tensor, normalise=True)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), found, expected)
    raw = native.step(packed, tuple(state), tensor)
    assert abs(raw[1][0] - found[1][0]).max() > 1e-3  # it does make a difference


def test_arrays_that_do_not_fit_together_are_left_to_xla():
    """Machine code would read, and write, beyond their ends."""
    params, tensors = random_run(steps=1, batch=2, height=3, width=4)
    packed, (g1, g2), tensor = native.pack(params), random_state(2, 3, 4), tensors[0]
    exists = jnp.ones(2, bool)
    native.step(packed, (g1, g2), tensor, exists, np.bool_(True))
    for wrong in [
        (packed[:-1], (g1, g2), tensor, exists), (packed, (g1[:1], g2), tensor, exists),
        (packed, (g1, g2[:, :2]), tensor, exists), (packed, (g1, g2), tensor[..., :4], exists),
        (packed, (g1, g2), tensor, exists[:1]), (packed, (g1, g2), tensor.astype("int32"), exists),
        (packed, (g1.astype("bfloat16"), g2), tensor, exists),
    ]:  # fmt: skip
        with pytest.raises(native.Unavailable):
            native.step(*wrong)


@pytest.mark.parametrize("halves", [(1,), (1, 2), (5 / 8, 3 / 2)])
def test_winograd_is_a_correlation(halves):
    direction = winograd._winograd(*halves)
    rng = np.random.default_rng(0)
    pixels, kernel = rng.normal(size=direction.patch), rng.normal(size=3)
    products = (direction.kernel @ kernel) * (direction.input @ pixels)
    found = direction.output @ direction.butterfly @ products
    np.testing.assert_allclose(found, np.correlate(pixels, kernel), atol=1e-5)


def test_processors_without_avx512(monkeypatch):
    """The instructions of one run on all that have more."""
    monkeypatch.setenv("FIRENET_NATIVE", "avx2")
    assert llvm.vectors() == 8
    params, tensors = random_run(steps=2, batch=2, height=15, width=43)
    exists = jnp.ones((2, 2), bool)
    expected, found = both(params, random_state(2, 15, 43), tensors, exists)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), found, expected)


@pytest.mark.parametrize("switch", ["1", "avx2"])
def test_which_instructions_there_are(monkeypatch, switch):
    monkeypatch.setenv("FIRENET_NATIVE", switch)
    module, machine = llvm.Module(), llvm.machine()
    for stage in whole_step._stages(module, whole_step.Size(20, 40), True):
        stage.linkage = ""
    text = machine.emit_assembly(llvm.optimised(module, machine))
    assert "vfmadd" in text
    assert "%ymm" in text or llvm.vectors() == 32
    assert ("%zmm" in text) == (llvm.vectors() == 32)


def test_leaves_its_arguments_alone():
    """States change in place, but only those that nobody else sees."""
    params, tensors = random_run(steps=1, batch=1, height=11, width=14)
    state = tuple(random_state(1, 11, 14))
    before = jax.tree.map(np.array, state)
    native.step(native.pack(params), state, tensors[0])
    jax.tree.map(np.testing.assert_array_equal, state, before)


def test_can_be_mapped():
    params, tensors = random_run(steps=2, batch=4, height=9, width=14)
    weights = Weights(params, True)

    def alone(tensors):  # (T, H, W, 5)
        return reconstruct(weights, initial_state(1, 9, 14), tensors[:, None])[1][:, 0]

    expected = reconstruct(weights, initial_state(4, 9, 14), tensors)[1]
    found = jax.vmap(alone, in_axes=1, out_axes=1)(tensors)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_many_at_once_give_the_same_bits():
    params, tensors = random_run(steps=5, batch=2, height=40, width=50)
    weights = Weights(params, True)

    def run(_):
        return np.asarray(reconstruct(weights, initial_state(2, 40, 50), tensors)[1])

    first = run(0)
    with ThreadPoolExecutor(6) as pool:
        for images in pool.map(run, range(60)):
            np.testing.assert_array_equal(images, first)


def test_runs_where_xla_has_one_thread():
    script = (
        "import jax.numpy as jnp, firenet_jax as fj\n"
        "images = fj.reconstruct(fj.load_weights(), fj.initial_state(1, 30, 40), "
        "jnp.ones((50, 1, 30, 40, 5)))[1]\n"
        "assert bool(jnp.isfinite(images).all())\n"
        "from firenet_jax.native import choice\n"
        "assert choice._made and not choice._failure\n"
    )
    flags = {"XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false", "FIRENET_NATIVE": "1"}
    subprocess.run([sys.executable, "-c", script], env=os.environ | flags, check=True)
