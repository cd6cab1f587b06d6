"""Who computes: machine code or XLA; and that both take and refuse the same."""

import os
import subprocess
import sys
import warnings

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest
from test_network import random_run

from firenet_jax.native import Unavailable, choice, choose
from firenet_jax.network import State, Weights, initial_state
from firenet_jax.reconstruction import reconstruct

BOTH = pytest.mark.parametrize("machine_code", [True, False])


@pytest.fixture(scope="module")
def case():
    params, tensors = random_run(steps=3, batch=2, height=7, width=9)
    return Weights(params, False), initial_state(2, 7, 9), tensors


@pytest.fixture
def afresh(monkeypatch):
    """No program of before is used in this test, and none of it after; nothing is switched off."""
    monkeypatch.delenv("FIRENET_NATIVE", raising=False)
    jax.clear_caches()
    yield
    jax.clear_caches()


@pytest.fixture
def nothing_made(monkeypatch, afresh):
    """No machine code was made so far, and none can have failed."""
    monkeypatch.setattr(choice, "_made", {})
    monkeypatch.setattr(choice, "_failure", [])


@pytest.mark.parametrize("flag", ["jax_disable_jit", "jax_debug_nans"])
def test_without_programs_and_where_nans_are_looked_for(case, flag):
    weights, state, tensors = case
    expected = reconstruct(weights, state, tensors)[1]
    before = getattr(jax.config, flag)
    jax.config.update(flag, True)
    try:
        found = reconstruct(weights, state, tensors)[1]
        np.testing.assert_allclose(found, expected, atol=1e-5)
        if flag == "jax_debug_nans":
            with pytest.raises(FloatingPointError):
                reconstruct(weights, state, tensors.at[0, 0, 0, 0, 0].set(jnp.nan))
    finally:
        jax.config.update(flag, before)


def is_machine_code(function, *arguments):
    return "custom_call" in jax.jit(function).lower(*arguments).as_text()


def test_machine_code_is_for_cpus_where_it_is(afresh):
    def quick(x):
        return -x

    def plain(x):
        return jnp.cos(x)

    def lowered(function, **how):
        return jax.jit(function).trace(1.0).lower(**how).as_text()

    def either(x):
        return choose(quick, plain, x)

    assert "negate" in lowered(either, lowering_platforms=("cpu",))
    assert "cosine" in lowered(either, lowering_platforms=("cuda",))

    def unavailable(x):
        raise Unavailable

    assert "cosine" in lowered(lambda x: choose(unavailable, plain, x))
    mapped = jax.vmap(lambda x, y: choose(lambda x, y: x - y, lambda x, y: x + y, x, y))
    np.testing.assert_array_equal(mapped(jnp.arange(3.0), jnp.ones(3)), [-1, 0, 1])


def test_is_switched_off_by_keyword_and_environment(case, monkeypatch, afresh):
    is_here = is_machine_code(reconstruct, *case)
    assert not is_machine_code(lambda *case: reconstruct(*case, machine_code=False), *case)
    jax.clear_caches()
    monkeypatch.setenv("FIRENET_NATIVE", "0")
    assert not is_machine_code(reconstruct, *case)
    jax.clear_caches()
    monkeypatch.setenv("FIRENET_NATIVE", "1")
    assert is_machine_code(reconstruct, *case) == is_here


def test_can_be_exported(case):
    weights, state, tensors = case

    def images(params, state, tensors):
        return reconstruct(Weights(params, False), State(*state), tensors)[1]

    arguments = weights.params, tuple(state), tensors
    exported = jax.export.export(jax.jit(images))(*arguments)
    expected = reconstruct(weights, state, tensors, machine_code=False)[1]
    np.testing.assert_allclose(exported.call(*arguments), expected, atol=1e-6)


def test_without_llvmlite_xla_reconstructs():
    script = (
        "import sys; sys.modules['llvmlite'] = None\n"
        "import jax.numpy as jnp, firenet_jax as fj\n"
        "images = fj.reconstruct(fj.load_weights(), fj.initial_state(1, 9, 12), "
        "jnp.ones((2, 1, 9, 12, 5)))[1]\n"
        "assert bool(jnp.isfinite(images).all())\n"
    )
    command = [sys.executable, "-W", "error", "-c", script]
    subprocess.run(command, env=dict(os.environ), check=True)


@pytest.mark.parametrize("kind", [RuntimeError, OSError, ValueError])
def test_what_cannot_be_made_is_tried_once_and_warned_of_once(
    case, nothing_made, monkeypatch, kind
):
    whole_step = pytest.importorskip("firenet_jax.native.whole_step")
    if whole_step.vectors() == 0:
        pytest.skip("no machine code for this processor")
    tries = []

    def register(*_, **__):
        tries.append(1)
        raise kind("no pages that may be run")

    monkeypatch.setattr(whole_step, "register", register)
    expected = reconstruct(*case, machine_code=False)[1]
    with pytest.warns(UserWarning, match="no pages that may be run.*FIRENET_NATIVE=0"):
        found = reconstruct(*case)[1]
    np.testing.assert_array_equal(found, expected)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        weights, _, tensors = case
        reconstruct(weights, initial_state(2, 6, 9), tensors[:, :, 1:])
    assert len(tries) == 1


def test_another_version_of_the_interface_is_no_end(case, nothing_made, monkeypatch):
    foreign_call = pytest.importorskip("firenet_jax.native.foreign_call")
    llvm = pytest.importorskip("firenet_jax.native.llvm")
    if llvm.vectors() == 0:
        pytest.skip("no machine code for this processor")
    monkeypatch.setattr(foreign_call, "API_VERSION", (99, 0))
    weights, _, tensors = case
    with pytest.warns(UserWarning, match="slower"):
        reconstruct(weights, initial_state(2, 4, 9), tensors[:, :, 3:])


# ---- The door

SMALL_NUMBERS = ["float16", "bfloat16", "int8", "uint8", "int16", "uint16", "bool", "float8_e4m3fn"]
# Each is a program to compile: of state and parameters only some.
EXACT = [("tensors", kind) for kind in SMALL_NUMBERS]
EXACT += [("state", "float16"), ("state", "uint8"), ("params", "bfloat16")]


@BOTH
@pytest.mark.parametrize("what, kind", EXACT)
def test_exact_types_are_cast(case, machine_code, kind, what):
    weights, state, tensors = case
    rng = np.random.default_rng(3)

    def cast(tree):
        return jax.tree.map(lambda x: jnp.asarray(rng.integers(0, 2, x.shape), kind), tree)

    def float32(tree):
        return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), tree)

    if what == "tensors":
        tensors = cast(tensors)
    if what == "state":
        state = cast(state)
    if what == "params":
        weights = Weights(jax.tree.map(lambda x: x / 8, cast(weights.params)), False)
    after, images = reconstruct(weights, state, tensors, machine_code=machine_code)
    weights = Weights(float32(weights.params), False)
    expected = reconstruct(weights, float32(state), float32(tensors), machine_code=machine_code)
    assert images.dtype == after.g1.dtype == jnp.float32
    np.testing.assert_array_equal(images, expected[1])


@BOTH
@pytest.mark.parametrize("kind", ["int32", "uint32", "int64", "float64", "complex64"])
@pytest.mark.parametrize("what", ["tensors", "state", "parameters"])
def test_other_types_are_refused(case, machine_code, kind, what):
    weights, state, tensors = case
    with jax.enable_x64(True):

        def cast(tree):
            return jax.tree.map(lambda x: jnp.asarray(x, kind), tree)

        if what == "tensors":
            tensors = cast(tensors)
        if what == "state":
            state = State(state.g1, cast(state.g2))
        if what == "parameters":
            weights = Weights(cast(weights.params), False)
        with pytest.raises(ValueError, match=f"{what} are of type {kind}"):
            reconstruct(weights, state, tensors, machine_code=machine_code)


@BOTH
@pytest.mark.parametrize("shape", [(2, 8, 9, 16), (2, 7, 9, 8), (1, 7, 9, 16), (7, 9, 16), (2, 7)])
@pytest.mark.parametrize("which", ["g1", "g2"])
def test_states_of_other_shapes_are_refused(case, machine_code, shape, which):
    weights, state, tensors = case
    state = state._replace(**{which: jnp.zeros(shape)})
    with pytest.raises(ValueError, match=f"state's {which} is .*initial_state"):
        reconstruct(weights, state, tensors, machine_code=machine_code)


@BOTH
@pytest.mark.parametrize(
    "shape", [(), (2,), (3,), (1, 2), (1, 1), (2, 3), (3, 2, 1), (4, 2), (3, 3)]
)
def test_valid_of_other_shapes_is_refused(case, machine_code, shape):
    with pytest.raises(ValueError, match="valid is .*, but for event tensors"):
        reconstruct(*case, jnp.ones(shape, bool), machine_code=machine_code)


@BOTH
@pytest.mark.parametrize("kind", ["float32", "int32", "uint8"])
def test_valid_is_bool(case, machine_code, kind):
    with pytest.raises(ValueError, match=f"valid is {kind}, but must be bool"):
        reconstruct(*case, jnp.ones((3, 2), kind), machine_code=machine_code)


@BOTH
def test_valid_may_be_the_same_for_all_of_the_batch(case, machine_code):
    valid = jnp.array([[True], [False], [True]])
    found = reconstruct(*case, valid, machine_code=machine_code)
    expected = reconstruct(*case, jnp.repeat(valid, 2, 1), machine_code=machine_code)
    jax.tree.map(np.testing.assert_array_equal, found, expected)


@BOTH
@pytest.mark.parametrize("change", ["kernel", "bias", "missing", "additional", "transposed"])
def test_parameters_of_other_shapes_are_refused(case, machine_code, change):
    weights, state, tensors = case
    params = jax.tree.map(lambda x: x, weights.params)
    if change == "kernel":
        params["gru1"]["gates"]["kernel"] = jnp.zeros((3, 3, 32, 16))
    if change == "bias":
        params["head"]["bias"] = jnp.zeros(1)
    if change == "missing":
        del params["res1"]["conv1"]
    if change == "additional":
        params["head"]["scale"] = jnp.zeros(1)
    if change == "transposed":
        params["head"]["kernel"] = params["head"]["kernel"].swapaxes(2, 3)
    with pytest.raises(ValueError, match="the weights' parameter .* is .*, but FireNet's is"):
        reconstruct(Weights(params, False), state, tensors, machine_code=machine_code)


@BOTH
@pytest.mark.parametrize("shape", [(0, 2, 7, 9), (3, 0, 7, 9), (3, 2, 0, 9), (3, 2, 7, 0)])
def test_nothing_becomes_nothing(case, machine_code, shape):
    weights, tensors = case[0], jnp.zeros((*shape, 5))
    images = reconstruct(weights, initial_state(*shape[1:]), tensors, machine_code=machine_code)[1]
    assert images.shape == shape
