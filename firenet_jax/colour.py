"""Grey pictures and those of a colour filter array's channels -> colour pictures.

A colour sensor (Color-DAVIS346) has a filter array that repeats every two rows and columns:

    R G        red [0::2, 0::2], green [0::2, 1::2], blue [1::2, 1::2]; the pixels at
    . B        [1::2, 0::2], white or green, are not used

Each channel is reconstructed as a recording of its own, at half the size. Lightness is taken from
the grey picture of all pixels, which is twice as sharp, and a* and b* of CIELAB from the channels
(as in rpg_e2vid; Scheerlinck et al., "CED: Color Event Camera Dataset", CVPRW 2019).
"""

import jax
import jax.numpy as jnp
import numpy as np

from firenet_jax.errors import SettingsError

CORNERS = ((0, 0), (0, 1), (1, 1))  # row and column of red, green and blue

# Linear sRGB -> CIE XYZ (IEC 61966-2-1), and XYZ of its white (D65).
XYZ = np.array(
    [[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]]
)
WHITE = XYZ.sum(1)


def check_sides(height: int, width: int) -> None:
    """Raises SettingsError unless both sides are multiples of the filter array's."""
    if height % 2 or width % 2:
        raise SettingsError(
            f"{width}x{height} cannot be a colour sensor, whose sides are even: leave out --color, "
            "or pass the right --sensor-size"
        )


def corners(rotated: bool) -> tuple[tuple[int, int], ...]:
    """Row and column of red, green and blue; rotated: of a picture rotated by 180 degrees."""
    return tuple((1 - row, 1 - column) for row, column in CORNERS) if rotated else CORNERS


def channels(tensors: jax.Array, rotated: bool = False) -> jax.Array:
    """Event tensors (..., H, W, 5), even sides -> (..., 3, H/2, W/2, 5): red, green and blue.

    rotated: they are rotated by 180 degrees, and with them the filter array."""
    each = [tensors[..., row::2, column::2, :] for row, column in corners(rotated)]
    return jnp.stack(each, -4)


def coloured(greys: jax.Array, shades: jax.Array, rotated: bool = False) -> jax.Array:
    """(..., H, W) and red, green and blue (..., 3, H/2, W/2), uint8 -> (..., H, W, 3) uint8.

    rotated: as in `channels`."""
    each = [
        _full_size(_full_size(shades[..., channel, :, :] / 255.0, row, -2), column, -1)
        for channel, (row, column) in enumerate(corners(rotated))
    ]
    lightness = to_lab(jnp.stack([greys / 255.0] * 3, -1))[..., :1]
    lab = jnp.concatenate([lightness, to_lab(jnp.stack(each, -1))[..., 1:]], -1)
    return jnp.round(255 * jnp.clip(to_rgb(lab), 0, 1)).astype(jnp.uint8)


def _full_size(values: jax.Array, first: int, axis: int) -> jax.Array:
    """Samples at first, first + 2, ... -> all positions, linearly interpolated; the first and the
    last sample are repeated beyond the ends."""
    values = jnp.moveaxis(values, axis, -1)
    outer = jnp.pad(values, [(0, 0)] * (values.ndim - 1) + [(first, 1 - first)], mode="edge")
    between = (outer[..., 1:] + outer[..., :-1]) / 2
    pairs = [values, between] if first == 0 else [between, values]
    joined = jnp.stack(pairs, -1).reshape(*values.shape[:-1], -1)
    return jnp.moveaxis(joined, -1, axis)


def to_lab(rgb: jax.Array) -> jax.Array:
    """sRGB (..., 3) in [0, 1] -> CIELAB (..., 3): L* in [0, 100], a*, b*."""
    linear = jnp.where(rgb > 0.04045, ((rgb + 0.055) / 1.055) ** 2.4, rgb / 12.92)
    xyz = jnp.einsum("...c,dc->...d", linear, (XYZ / WHITE[:, None]).astype(np.float32))
    x, y, z = jnp.moveaxis(
        jnp.where(xyz > (6 / 29) ** 3, jnp.cbrt(xyz), xyz * (29 / 6) ** 2 / 3 + 4 / 29), -1, 0
    )
    return jnp.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1)


def to_rgb(lab: jax.Array) -> jax.Array:
    """CIELAB (..., 3) -> sRGB (..., 3), outside [0, 1] for colours outside of its gamut."""
    lightness, a, b = jnp.moveaxis(lab, -1, 0)
    y = (lightness + 16) / 116
    roots = jnp.stack([y + a / 500, y, y - b / 200], -1)
    xyz = jnp.where(roots > 6 / 29, roots**3, 3 * (6 / 29) ** 2 * (roots - 4 / 29))
    inverse = np.linalg.inv(XYZ / WHITE[:, None]).astype(np.float32)
    linear = jnp.einsum("...c,dc->...d", xyz, inverse)
    bright = 1.055 * jnp.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return jnp.where(linear > 0.0031308, bright, 12.92 * linear)
