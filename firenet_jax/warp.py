"""Image, displacement -> image, visible: bilinear sampling, and backward warping with it.

Images are (..., H, W) float32; displacements (..., H, W, 2) float32 in pixels, x then y, on the
grid of the result. A pixel x of the result is looked up at x - d(x) (backward warping: d is the
displacement from the earlier image to the later one, given on the later one's grid). Pixel centres
lie at whole numbers, (0, 0) top left, so a displacement of half a pixel averages two neighbours.
"""

import jax
import jax.numpy as jnp


def sample(image: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
    """(H, W) at columns x and rows y, any one shape -> its bilinear interpolation there.

    Beyond the border the value is that of the nearest border pixel. The gradient with respect to
    image, x and y is always finite.
    """
    height, width = image.shape
    x, y = jnp.clip(x, 0, width - 1.0), jnp.clip(y, 0, height - 1.0)
    # The last pixel is the right end of the last cell, so that all four neighbours exist.
    column = jnp.clip(x.astype(jnp.int32), 0, max(width - 2, 0))
    row = jnp.clip(y.astype(jnp.int32), 0, max(height - 2, 0))
    right, down = x - column, y - row
    flat, place = image.reshape(-1), row * width + column

    def at(offset: int) -> jax.Array:
        # "clip" costs nothing and keeps the index in bounds in all cases (nan, W = 1).
        return flat.at[place + offset].get(mode="clip")

    a, b = at(0), at(1)
    c, d = at(width), at(width + 1)
    # In this form weights of 0 and 1 give exactly one of the pixels.
    top, bottom = (1 - right) * a + right * b, (1 - right) * c + right * d
    return (1 - down) * top + down * bottom


@jax.jit
def warp(image: jax.Array, displacement: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(..., H, W), (..., H, W, 2) -> warped (..., H, W), visible (..., H, W) bool.

    warped(x) = image(x - displacement(x)), interpolated bilinearly. Where that position is outside
    the image, however slightly, visible is False and warped holds the nearest border pixel.
    """
    height, width = image.shape[-2:]
    if displacement.shape != (*image.shape, 2):
        raise ValueError(
            f"an image {image.shape} is warped by a displacement {(*image.shape, 2)}, "
            f"not {displacement.shape}"
        )
    row, column = jnp.meshgrid(jnp.arange(height), jnp.arange(width), indexing="ij")
    leading = range(image.ndim - 2)
    x = jnp.expand_dims(column, leading) - displacement[..., 0]
    y = jnp.expand_dims(row, leading) - displacement[..., 1]
    visible = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)

    images = image.reshape(-1, height, width)
    warped = jax.vmap(sample)(images, x.reshape(images.shape), y.reshape(images.shape))
    return warped.reshape(image.shape), visible
