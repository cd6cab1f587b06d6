import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from firenet_jax import native
from firenet_jax.convolution import kernel_gradient, layer, side_by_side


def convolve(image, kernel):
    return layer([image], kernel)[0]


def slow_convolution(image, kernel):
    """Six loops, float64."""
    rows, columns, _, outputs = kernel.shape
    batch, height, width, _ = image.shape
    result = np.zeros((batch, height, width, outputs))
    for y in range(height):
        for x in range(width):
            for i in range(rows):
                for j in range(columns):
                    v, u = y + i - rows // 2, x + j - columns // 2
                    if 0 <= v < height and 0 <= u < width:
                        result[:, y, x] += image[:, v, u] @ kernel[i, j]
    return result


def random_case(shape, seed=0, width=9):
    rows, columns, inputs, outputs = shape
    rng = np.random.default_rng(seed)
    image = rng.normal(size=(2, 7, width, inputs)).astype(np.float32)
    return image, rng.normal(size=shape).astype(np.float32)


SHAPES = [(3, 3, 5, 16), (1, 1, 16, 1), (3, 5, 4, 2), (5, 3, 2, 3)]


@pytest.mark.parametrize("shape", SHAPES)
def test_equals_the_loops(shape):
    image, kernel = random_case(shape)
    np.testing.assert_allclose(convolve(image, kernel), slow_convolution(image, kernel), atol=1e-4)


@pytest.mark.parametrize("width", [1, 2, 3, 8, 9])
@pytest.mark.parametrize("shape", [(3, 3, 16, 16), (3, 5, 4, 2), (1, 7, 2, 3)])
@pytest.mark.parametrize("pixels", [2, 4])
def test_side_by_side_it_is_the_same_at_every_width(shape, width, pixels):
    image, kernel = random_case(shape, width=width)
    result = side_by_side(image, kernel, pixels)
    np.testing.assert_allclose(result, slow_convolution(image, kernel), atol=1e-4)


@pytest.mark.parametrize("shape", SHAPES)
def test_gradients_are_those_of_the_loops(shape):
    """The convolution is linear in each argument, so a difference quotient is exact."""
    image, kernel = random_case(shape)
    cotangent = np.random.default_rng(1).normal(size=(*image.shape[:3], shape[3]))
    by_image, by_kernel = jax.vjp(convolve, image, kernel)[1](jnp.float32(cotangent))
    for gradient, function, argument in [
        (by_kernel, lambda k: slow_convolution(image, k), kernel),
        (by_image, lambda x: slow_convolution(x, kernel), image),
    ]:
        direction = np.random.default_rng(2).normal(size=argument.shape)
        expected = (function(direction) * cotangent).sum()
        assert (np.asarray(gradient) * direction).sum() == pytest.approx(expected, rel=1e-4)
    quick = kernel_gradient(jnp.asarray(image), jnp.asarray(kernel), jnp.float32(cotangent))
    np.testing.assert_allclose(quick, by_kernel, atol=1e-3)


@pytest.mark.parametrize("alone", [False, True])
@pytest.mark.parametrize("length", [1, 15, 17])
def test_a_bias_of_another_length_is_refused(length, alone):
    """XLA would stretch one of one number; machine code would read beyond it."""
    image, kernel = random_case((3, 3, 16, 16))
    with native.by_xla_alone(alone), pytest.raises(ValueError, match=rf"bias is \({length},\)"):
        layer([image], kernel, jnp.zeros(length))


def obvious_layer(maps, kernel, bias, activations):
    """What the layer is, of functions that JAX differentiates by itself."""
    known = {"none": lambda x: x, "relu": jax.nn.relu, "sigmoid": jax.nn.sigmoid, "tanh": jnp.tanh}
    numbers = "NHWC", "HWIO", "NHWC"
    maps = jnp.concatenate(maps, -1)
    sums = jax.lax.conv_general_dilated(maps, kernel, (1, 1), "SAME", dimension_numbers=numbers)
    parts = jnp.split(sums + bias[None, None, None], len(activations), -1)
    return tuple(known[name](x) for name, x in zip(activations, parts, strict=True))


@pytest.mark.parametrize("alone", [False, True])
@pytest.mark.parametrize(
    "maps, activations",
    [(1, ("relu",)), (2, ("sigmoid", "sigmoid")), (3, ("none", "tanh", "relu"))],
)
def test_activations_and_their_gradients_are_those_of_jax(maps, activations, alone):
    """Half of each map is 0 and so is half of the bias: there a ReLU has no gradient."""
    rng = np.random.default_rng(0)
    maps = [rng.normal(size=(2, 6, 9, 4)).astype(np.float32) for _ in range(maps)]
    for each in maps:
        each[:, :, :5] = 0
    outputs = 4 * len(activations)
    kernel = rng.normal(0, 0.3, (3, 3, 4 * len(maps), outputs)).astype(np.float32)
    bias = np.where(np.arange(outputs) % 2, 0, rng.normal(size=outputs)).astype(np.float32)
    weights = [rng.normal(size=(2, 6, 9, 4)).astype(np.float32) for _ in activations]
    results = []
    with native.by_xla_alone(alone):
        for function in (layer, obvious_layer):

            def weighted(*arguments, function=function):
                found = function(*arguments, activations)
                return sum((a * b).sum() for a, b in zip(found, weights, strict=True)), found

            call = jax.value_and_grad(weighted, (0, 1, 2), has_aux=True)
            results.append(jax.tree.leaves(call(maps, kernel, bias)))
    for ours, theirs in zip(*results, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4)


def strides_of(inputs, outputs, columns=3, width=9):
    """Of all convolutions in the program of a layer by XLA, for CPUs and for others."""
    image = jax.ShapeDtypeStruct((1, 7, width, inputs), jnp.float32)
    with native.by_xla_alone():
        program = jax.make_jaxpr(convolve)(image, jnp.zeros((3, columns, inputs, outputs)))
    return set(re.findall(r"window_strides=\((\d+, \d+)\)", str(program)))


@pytest.mark.parametrize(
    "inputs, outputs, expected",
    [(5, 16, {"1, 4"}), (15, 1, {"1, 4"}), (16, 16, {"1, 2"}), (16, 17, set()), (32, 16, set())],
)
def test_few_channels_are_convolved_side_by_side_on_a_cpu(inputs, outputs, expected):
    """For speed alone: four pixels beside each other, from 16 inputs on two."""
    assert strides_of(inputs, outputs) == {"1, 1"} | expected
    assert strides_of(inputs, outputs, columns=1) == {"1, 1"}


def test_a_width_that_is_not_known_is_convolved_as_it_is():
    (width,) = jax.export.symbolic_shape("w")
    assert strides_of(5, 16, width=width) == {"1, 1"}
