"""Maps, kernel, bias -> maps: the convolutional layer of all networks here, and its gradient.

Images are (B, H, W, channels), kernels (rows, columns, inputs, outputs), odd sizes, zero padding,
no striding. On accelerators XLA computes everything. On a CPU, 3x3 convolutions and their gradients
are machine code of our own (`native`), if available. Otherwise XLA computes them too, rearranged
where there are few channels, except for the gradient with respect to the kernel: inside a scan,
XLA's own takes many times as long as the matrix products below.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

from firenet_jax import native

DIMENSIONS = ("NHWC", "HWIO", "NHWC")


def _plain(image: jax.Array, kernel: jax.Array) -> jax.Array:
    return jax.lax.conv_general_dilated(image, kernel, (1, 1), "SAME", dimension_numbers=DIMENSIONS)


def _convolve(image: jax.Array, kernel: jax.Array) -> jax.Array:
    _, columns, inputs, outputs = kernel.shape
    known = isinstance(image.shape[2], int)  # an exported program has a symbolic width
    if columns == 1 or inputs * outputs > 16 * 16 or not known:
        return _plain(image, kernel)
    # Fastest on a CPU: 2 (of 2, 3, 4) with 16 inputs; 4 with the event tensor's 5.
    beside = partial(side_by_side, pixels=2 if inputs >= 16 else 4)
    return jax.lax.platform_dependent(image, kernel, cpu=beside, default=_plain)


def side_by_side(image: jax.Array, kernel: jax.Array, pixels: int) -> jax.Array:
    """The same convolution with `pixels` neighbours of a row as channels of one pixel.

    With few channels, XLA on a CPU spends most of the time on its overhead per pixel. Two
    neighbours share most of their inputs: 4 columns for both instead of 3 for each. With 3 columns
    that is 1.33 times the products, a quarter of them with zeros.
    """
    rows, columns, inputs, outputs = kernel.shape
    batch, height, width, _ = image.shape
    groups = -(-width // pixels)
    # Each further pixel is reached by the same kernel, one column further to the right.
    shifted = [
        jnp.pad(kernel, ((0, 0), (j, pixels - 1 - j), (0, 0), (0, 0))) for j in range(pixels)
    ]
    kernel = jnp.stack(shifted, 3).reshape(rows, -1, inputs, pixels * outputs)
    padding = (rows // 2, rows // 2), (columns // 2, columns // 2 + pixels * groups - width)
    image = jax.lax.conv_general_dilated(
        image, kernel, (1, pixels), padding, dimension_numbers=DIMENSIONS
    )
    return image.reshape(batch, height, pixels * groups, outputs)[:, :, :width]


def layer(
    maps: Sequence[jax.Array],
    kernel: jax.Array,
    bias: jax.Array | None = None,
    activations: tuple[str, ...] = ("none",),
) -> tuple[jax.Array, ...]:
    """Maps with equal channels, concatenated and convolved -> activation(. + bias), one map each.

    (B, H, W, I / maps), (rows, columns, I, O), (O,) -> (B, H, W, O / activations); activations are
    keys of `ACTIVATIONS`. First gradients in reverse mode only; the results are their residuals,
    named `CONVOLVED` (for jax.checkpoint).
    Raises ValueError for a bias of another shape: XLA would broadcast it, machine code read beyond.
    """
    bias = jnp.zeros(kernel.shape[3], kernel.dtype) if bias is None else bias
    if bias.shape != kernel.shape[3:]:
        raise ValueError(f"the bias is {bias.shape}, but the kernel's is {kernel.shape[3:]}")
    return _layer(native.is_wanted(), activations, tuple(maps), kernel, bias)


# An activation, and its derivative as a function of its value.
ACTIVATIONS = {
    "none": (lambda x: x, jnp.ones_like),
    "relu": (jax.nn.relu, lambda y: (y > 0).astype(y.dtype)),
    "sigmoid": (jax.nn.sigmoid, lambda y: y * (1 - y)),
    "tanh": (jnp.tanh, lambda y: 1 - y * y),
}
CONVOLVED = "convolved"


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _layer(machine_code: bool, activations, maps, kernel, bias) -> tuple[jax.Array, ...]:
    def by_machine_code(maps, kernel, bias):
        return native.convolve(maps, kernel, bias, activations)

    return choose(machine_code, by_machine_code, partial(by_xla, activations), maps, kernel, bias)


def by_xla(activations, maps, kernel, bias):
    sums = convolved_by_xla(maps, kernel, 1)[0] + bias.reshape(1, 1, 1, -1)
    parts = jnp.split(sums, len(activations), -1)
    return tuple(ACTIVATIONS[name][0](x) for name, x in zip(activations, parts, strict=True))


def convolved_by_xla(maps, kernel, results: int):
    return tuple(jnp.split(_convolve(_joined(maps), kernel), results, -1))


def _joined(maps):
    return maps[0] if len(maps) == 1 else jnp.concatenate(maps, -1)


def choose(machine_code: bool, own: Callable, xla: Callable, *arguments) -> Any:
    """`native.choose` of the two; XLA's if machine code is not wanted."""
    return native.choose(own, xla, *arguments) if machine_code else xla(*arguments)


def transposed_kernel(kernel: jax.Array) -> jax.Array:
    """The kernel that maps gradients of the results to gradients of the maps."""
    return kernel[::-1, ::-1].swapaxes(2, 3)


def _forward(machine_code, activations, maps, kernel, bias):
    computed: Any = _layer(machine_code, activations, maps, kernel, bias)
    results = tuple(checkpoint_name(result, CONVOLVED) for result in computed)
    return results, (maps, kernel, results)


def _backward(machine_code, activations, kept, gradients):
    maps, kernel, results = kept
    gradients = tuple(
        gradient * ACTIVATIONS[name][1](result) if name != "none" else gradient
        for gradient, name, result in zip(gradients, activations, results, strict=True)
    )

    def images_by_machine_code(gradients, flipped):
        return native.convolve(gradients, flipped, None, ("none",) * len(maps))

    xla = partial(convolved_by_xla, results=len(maps))
    back = transposed_kernel(kernel)
    by_maps = choose(machine_code, images_by_machine_code, xla, gradients, back)
    return by_maps, *parameter_gradients(machine_code, maps, kernel, gradients)


def parameter_gradients(machine_code: bool, maps, kernel, gradients) -> tuple[jax.Array, jax.Array]:
    """Gradients of kernel and bias, from those of the layer's pre-activations."""

    def gradients_by_xla(maps, kernel, gradients):
        by = partial(jax.lax.platform_dependent, cpu=kernel_gradient, default=_xla_kernel_gradient)
        joined = _joined(gradients)
        # Summed in float32, whatever the gradients' type.
        by_bias = jnp.sum(joined, (0, 1, 2), dtype=jnp.float32).astype(kernel.dtype)
        return by(_joined(maps), kernel, joined), by_bias

    arguments = maps, kernel, gradients
    return choose(machine_code, native.gradients, gradients_by_xla, *arguments)


_layer.defvjp(_forward, _backward)


def _xla_kernel_gradient(image, kernel, gradient):
    return jax.vjp(lambda kernel: _plain(image, kernel), kernel)[1](gradient)[0]


def kernel_gradient(image: jax.Array, kernel: jax.Array, gradient: jax.Array) -> jax.Array:
    """dK[i, j] = sum over all pixels of image[y + i - r, x + j - c] gradient[y, x]^T.

    A matrix product for each row i of the kernel: the image shifted by i rows, times the gradient
    shifted for each column j of the kernel, concatenated as channels. Both are (pixels, channels):
    contracting three axes instead of one takes XLA four times as long.
    """
    rows, columns, inputs, outputs = kernel.shape
    height, width = image.shape[1:3]
    r, c = rows // 2, columns // 2
    image = jnp.pad(image, ((0, 0), (r, r), (0, 0), (0, 0)))
    gradient = jnp.pad(gradient, ((0, 0), (0, 0), (c, c), (0, 0)))
    shifted = [gradient[:, :, columns - 1 - j :][:, :, :width] for j in range(columns)]
    beside = jnp.concatenate(shifted, -1).reshape(-1, columns * outputs)
    products = [
        jnp.matmul(
            image[:, i : i + height].reshape(-1, inputs).T,
            beside,
            preferred_element_type=jnp.float32,  # a sum over all pixels: too long for bfloat16
        )
        for i in range(rows)
    ]
    products = jnp.stack(products).reshape(rows, inputs, columns, outputs)
    return products.swapaxes(1, 2).astype(kernel.dtype)
