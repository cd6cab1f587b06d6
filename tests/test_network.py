import re
from dataclasses import FrozenInstanceError
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import references
from jax.extend.core import jaxprs_in_params

from firenet_jax import native
from firenet_jax.checkpoint import convert
from firenet_jax.network import (
    Weights,
    _step,
    initial_params,
    initial_state,
    multiply_adds,
    step,
)
from firenet_jax.pictures import display, initial_display_state
from firenet_jax.reconstruction import reconstruct


def test_has_the_papers_number_of_parameters():
    params = initial_params(jax.random.key(0))
    assert sum(leaf.size for leaf in jax.tree.leaves(params)) == 37_777


def convolutions(jaxpr):
    """All convolutions of a traced program, those of functions called in it too.

    Where platforms differ (`cond`), those of the last branch, which is everyone else's.
    """
    for equation in jaxpr.eqns:
        name, inner = equation.primitive.name, list(jaxprs_in_params(equation.params))
        assert name != "dot_general"
        if name == "conv_general_dilated":
            yield equation
        for called in inner[-1:] if name == "cond" else inner:
            yield from convolutions(called)


def test_multiply_adds_are_those_of_the_traced_program():
    params, tensors = random_run(steps=1, batch=1, height=23, width=31)
    with native.by_xla_alone():
        program = jax.make_jaxpr(step)(params, initial_state(1, 23, 31), tensors[0])
    traced = 0
    for convolution in convolutions(program.jaxpr):
        kernel, image = convolution.invars[1].aval.shape, convolution.outvars[0].aval.shape
        assert image[:3] == (1, 23, 31)
        traced += 23 * 31 * int(np.prod(kernel))
    assert multiply_adds(23, 31) == traced == 23 * 31 * 37_600


def test_initial_gates_are_orthogonal_with_zero_bias():
    gates = initial_params(jax.random.key(1))["gru1"]["gates"]
    kernel = np.asarray(gates["kernel"]).reshape(-1, 32)
    np.testing.assert_allclose(kernel.T @ kernel, np.eye(32), atol=1e-5)
    assert not np.asarray(gates["bias"]).any()


def test_weights_do_not_change():
    with pytest.raises(FrozenInstanceError):
        Weights({}, True).normalise = False


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
def test_where_no_window_exists_the_state_stays(dtype):
    """And where one does, it is as if nothing had been asked."""
    params, tensors = random_run(steps=2, batch=3, height=9, width=10)
    before, _ = step(params, initial_state(3, 9, 10), tensors[0], dtype=dtype)
    wanted, expected = step(params, before, tensors[1], dtype=dtype)
    exists = np.array([True, False, True])
    after, image = step(params, before, tensors[1], jnp.asarray(exists), dtype=dtype)
    for found, old, new in zip(after, before, wanted, strict=True):
        assert np.abs(new - old).max() > 0.1
        np.testing.assert_array_equal(found[1], old[1])
        np.testing.assert_allclose(found[exists], new[exists], atol=1e-6)
    np.testing.assert_allclose(image[exists], expected[exists], atol=1e-5)


@pytest.mark.parametrize(
    "choices, fused",
    [({}, {"gru", "residual"}), ({"dtype": jnp.bfloat16}, set()),
     ({"exists": np.ones(1, bool)}, {"residual"})],
)  # fmt: skip
def test_blocks_are_fused_in_float32_where_all_windows_exist(choices, fused):
    """For speed alone; a state that may have to stay as it is needs the gates one by one."""
    params, tensors = random_run(steps=1, batch=1, height=8, width=9)
    call = partial(step, state=initial_state(1, 8, 9), event_tensor=tensors[0], **choices)
    program = str(jax.make_jaxpr(call)(params))
    assert set(re.findall(r"custom_vjp_call\[\s*name=_(gru|residual)\b", program)) == fused


def test_an_untrained_network_sees_grey():
    """From black, training's first steps end with layers whose ReLU has no gradient."""
    params, state = initial_params(jax.random.key(2)), initial_state(1, 16, 16)
    assert params["prediction"]["bias"] == 0.5
    _, image = step(params, state, jnp.zeros((1, 16, 16, 5)))
    assert abs(float(image.mean()) - 0.5) < 0.2


@pytest.mark.reference
def test_published_weights_give_the_published_images(reference):
    """The authors' own module code, eight steps from a zero state, without normalisation."""
    data = np.load(reference / "firenet_published_io.npz")
    weights = convert(reference / "firenet_published.pth")
    assert weights.normalise
    tensors = jnp.asarray(data["event_tensors"]).transpose(0, 2, 3, 1)[:, None]
    state, images = reconstruct(
        Weights(weights.params, normalise=False), initial_state(1, 45, 60), tensors
    )
    np.testing.assert_allclose(images[:, 0], data["images"][:, 0], atol=1e-5)
    np.testing.assert_allclose(state.g1[0].transpose(2, 0, 1), data["state1"][0], atol=1e-5)
    np.testing.assert_allclose(state.g2[0].transpose(2, 0, 1), data["state2"][0], atol=1e-5)


def random_run(seed=0, steps=20, batch=3, height=23, width=31):
    """Parameters with biases, images of about -1 to 2; random tensors."""
    keys = iter(jax.random.split(jax.random.key(seed), 64))
    params = initial_params(next(keys))
    params = jax.tree.map(
        lambda leaf: leaf + 0.05 * jax.random.normal(next(keys), leaf.shape), params
    )
    tensors = jax.random.normal(next(keys), (steps, batch, height, width, 5))
    return params, tensors


def torch_run(params, tensors):
    torch = pytest.importorskip("torch", reason="compares with PyTorch, which is not installed")
    params = jax.tree.map(lambda leaf: torch.tensor(np.asarray(leaf), requires_grad=True), params)
    run = references.torch_firenet(params)
    steps, batch, height, width, _ = tensors.shape
    state = (torch.zeros(batch, 16, height, width),) * 2
    images = []
    for tensor in torch.tensor(np.asarray(tensors)).permute(0, 1, 4, 2, 3):
        state, image = run(state, tensor)
        images.append(image[:, 0])
    return params, state, torch.stack(images)


@pytest.mark.reference
def test_equals_a_pytorch_twin():
    params, tensors = random_run()
    _, (g1, g2), expected = torch_run(params, tensors)
    state, images = reconstruct(Weights(params, False), initial_state(3, 23, 31), tensors)
    expected = expected.detach().numpy()
    assert expected.min() < 0 and expected.max() > 1  # nothing clips
    np.testing.assert_allclose(images, expected, atol=1e-5)
    for ours, theirs in zip(state, (g1, g2), strict=True):
        theirs = theirs.detach().permute(0, 2, 3, 1).numpy()
        np.testing.assert_allclose(ours, theirs, atol=1e-5)


@pytest.mark.reference
def test_gradients_equal_a_pytorch_twin():
    params, tensors = random_run(seed=3, steps=5, batch=2, height=15, width=18)
    theirs, _, images = torch_run(params, tensors)
    (images**2).mean().backward()

    def loss(params):
        state = initial_state(2, 15, 18)
        return (reconstruct(Weights(params, False), state, tensors)[1] ** 2).mean()

    gradient = jax.grad(loss)(params)
    for ours, leaf in zip(jax.tree.leaves(gradient), jax.tree.leaves(theirs), strict=True):
        expected = leaf.grad.numpy()
        assert np.abs(np.asarray(ours) - expected).max() <= 1e-4 * np.abs(expected).max()


def test_step_is_the_body_of_the_scan():
    params, tensors = random_run(steps=3, batch=1, height=9, width=10)
    state, images = initial_state(1, 9, 10), []
    for tensor in tensors:
        state, image = step(params, state, tensor)
        images.append(image)
    final, scanned = reconstruct(Weights(params, False), initial_state(1, 9, 10), tensors)
    np.testing.assert_allclose(np.stack(images), scanned, atol=1e-6)
    np.testing.assert_allclose(state.g2, final.g2, atol=1e-6)


def test_images_and_states_are_float32_where_others_use_float64():
    params, tensors = random_run(steps=1, batch=1, height=9, width=10)
    expected = step(params, initial_state(1, 9, 10), tensors[0])
    with jax.enable_x64(True):
        params, state = jax.tree.map(np.float64, (params, initial_state(1, 9, 10)))
        found = step(params, state, np.float64(tensors[0]))
        for run, inputs in ((step, tensors[0]), (reconstruct, tensors)):
            given = params if run is step else Weights(params, False)
            with pytest.raises(ValueError, match="dtype is float64, but must be float32 or bf"):
                run(given, state, inputs, dtype=jnp.float64)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert a.dtype == jnp.float32
        np.testing.assert_array_equal(a, b)


def test_bfloat16_stays_close_and_keeps_float32_state():
    params, tensors = random_run(steps=4, batch=1, height=16, width=16)
    weights, state = Weights(initial_params(jax.random.key(0)), False), initial_state(1, 16, 16)
    exact = reconstruct(weights, state, tensors)[1]
    state, images = reconstruct(weights, state, tensors, dtype=jnp.bfloat16)
    assert images.dtype == state.g1.dtype == jnp.float32
    assert 1e-4 < np.abs(images - exact).max() < 0.05


def test_outside_of_programs_a_step_is_compiled_once():
    params, tensors = random_run(steps=2, batch=1, height=9, width=10)
    state, compiled = initial_state(1, 9, 10), []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, seconds, **info: compiled.append(info) if "backend_compile" in event else None
    )
    try:
        for k in range(3):
            state, _ = step(params, state, tensors[k % 2])
            if k == 0:
                assert compiled
                jax.block_until_ready(state)
                compiled.clear()
        assert not compiled
    finally:
        jax.monitoring.clear_event_listeners()
    with native.by_xla_alone():  # another program, although the shapes are the same
        step(params, state, tensors[0])
    assert _step._cache_size() >= 2


def test_a_state_can_be_donated():
    params, tensors = random_run(steps=1, batch=1, height=9, width=10)
    expected = step(params, initial_state(1, 9, 10), tensors[0])
    actual = jax.jit(step, donate_argnums=1)(params, initial_state(1, 9, 10), tensors[0])
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
    images = jnp.zeros((1, 2, 12, 13))
    donating = jax.jit(display, donate_argnums=0)
    donating(initial_display_state(2), images)


def test_weights_are_told_apart_by_identity():
    weights = Weights(initial_params(jax.random.key(0)), True)
    assert weights == weights and weights != Weights(weights.params, True)
    assert len({weights, weights}) == 1


@pytest.mark.parametrize("machine_code", [True, False])
@pytest.mark.parametrize("value", [np.nan, np.uint32(0xFFFFFFFF).view(np.float32), np.inf], ids=str)
def test_what_is_not_finite_is_not_taken_for_an_empty_window(value, machine_code):
    params, tensors = random_run(steps=2, batch=1, height=9, width=10)
    tensors = jnp.asarray(tensors).at[0, 0, 4, 4, 2].set(value)
    weights = Weights(params, True)
    _, images = reconstruct(weights, initial_state(1, 9, 10), tensors, machine_code=machine_code)
    assert not np.isfinite(images[0]).any()
