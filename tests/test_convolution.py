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
