"""Images -> pictures: what people look at, by the steps of the original program (rpg_e2vid).

Images are (T, B, H, W) float32 as the network gives them; pictures are (T, B, H, W) uint8, event
pictures (T, B, H, W, 3) uint8. Sharpened by an unsharp mask, stretched from an intensity range to
0..255, clipped, if asked for smoothed, and rounded. (The original truncates to 8 bits, which
darkens by half a level.)

By default the range follows the images, because events encode contrast only in units of the
sensor's contrast threshold: no network can know how black and how white a scene is.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import ndtr  # not norm.cdf, the same: scipy.stats takes half a second to import

from firenet_jax.errors import SettingsError
from firenet_jax.settings import check_arrays, check_sizes

HISTORY = 11  # images whose ranges have a median, which is the range shown
# Of the automatic range:
BEYOND = 0.005  # share of the pixels that may be darker than black, and that may be brighter
MARGIN = 0.05  # of the range, added at each end
NARROWEST = 0.35  # least width, so that noise is not amplified
SAMPLES = 4096  # pixels, on a grid, from which it is read
# Share of a widening to NARROWEST that goes below: an image in which nothing has been seen is then
# light grey, as most backgrounds are, and hardly changes when something darker enters.
BELOW = 2 / 3
BORDER = 2  # pixels, which the unsharp mask brightens, as there is nothing beyond them

Range = Literal["auto", "extremes", "fixed"]


@dataclass(frozen=True)
class Display:
    """How images become 8-bit pictures."""

    unsharp: float = 0.3
    """Strength of the unsharp mask; 0 switches it off."""
    range: Range = "auto"
    """What becomes black and white. auto: nearly the darkest and brightest of the last 11 images;
    extremes: the darkest and brightest (--auto_hdr of the original program); fixed: 0 and 1, as the
    original program does by default."""
    bilateral: float = 0.0
    """Smooth noise but keep edges: sigma of a bilateral filter in grey levels, such as 25; 0 turns
    it off."""

    def __post_init__(self):
        check_sizes(self, "unsharp", "bilateral", zero=True)
        if self.range not in get_args(Range):
            raise SettingsError(
                f"range is {self.range!r}, but must be one of {', '.join(get_args(Range))}"
            )


class DisplayState(NamedTuple):
    """The ranges of the last images, the newest at the end; nan before the first image."""

    low: jax.Array
    """(B, 11) float32, what is shown as black."""
    high: jax.Array
    """(B, 11) float32, what is shown as white."""


def initial_display_state(batch: int) -> DisplayState:
    """The state before the first image."""
    low, high = (jnp.full((batch, HISTORY), jnp.nan, jnp.float32) for _ in range(2))
    return DisplayState(low, high)


def _unsharp_weights() -> np.ndarray:
    """(5,) float32, whose outer product is the kernel of the original program.

    Not quite a Gaussian of sigma 1: the square root of the outer product of a normal
    distribution's masses in five cells between -1.3 and 1.3.
    """
    masses = np.diff(ndtr(np.linspace(-1.3, 1.3, 6)))
    weights = np.sqrt(masses)
    return (weights / weights.sum()).astype(np.float32)


def unsharp_kernel(amount: float) -> np.ndarray:
    """(5, 5) float32: `unsharp_mask` as one convolution, for exported networks."""
    weights = _unsharp_weights()
    kernel = -amount * np.outer(weights, weights)
    kernel[2, 2] += 1 + amount
    return kernel.astype(np.float32)


def unsharp_mask(images: jax.Array, amount: float) -> jax.Array:
    """(..., H, W) -> (1 + amount) image - amount blurred image; 5x5 kernel, zero padding."""
    blurred = images
    for axis in (-2, -1):
        size = blurred.shape[axis]
        padding = [(0, 0)] * blurred.ndim
        padding[axis] = (2, 2)
        padded = jnp.pad(blurred, padding)
        shifted = (
            float(weight) * jax.lax.slice_in_dim(padded, k, k + size, axis=axis)
            for k, weight in enumerate(_unsharp_weights())
        )
        blurred = sum(shifted, jnp.zeros_like(images))
    return (1 + amount) * images - amount * blurred


@partial(jax.jit, static_argnames="settings")
def display(
    state: DisplayState,
    images: jax.Array,
    valid: jax.Array | None = None,
    *,
    settings: Display = Display(),
) -> tuple[DisplayState, jax.Array]:
    """(DisplayState, (T, B, H, W) float32) -> (DisplayState, (T, B, H, W) uint8).

    Black and white are the medians of the last 11 images' ranges (`Display.range`): of
    `automatic_range`, or of clip(min, 0, 0.45) and clip(max, 0.55, 1). Where the range is fixed the
    state is not used.
    valid: (T, B) bool; images that are not valid leave the state as it was. None: all are.
    Raises TypeError for what is not an array. Unless the range is fixed, also TypeError for a state
    of another type, and ValueError unless images are (T, B, H, W), the state is of B recordings and
    valid is bool (T, B).
    """
    check_arrays(images=images, valid=valid)
    images = jnp.asarray(images, jnp.float32)
    if settings.unsharp:
        images = unsharp_mask(images, settings.unsharp)
    if settings.range == "fixed":
        return state, to_8_bit(images, settings.bilateral)
    if not isinstance(state, DisplayState):
        raise TypeError(
            f"the state is a {type(state).__name__}: make it with initial_display_state(batch)"
        )
    if images.ndim != 4 or len(state.low) != images.shape[1]:
        raise ValueError(
            f"images of shape {images.shape} and the state of {len(state.low)} recordings: "
            "expected (T, B, H, W), and a state of B"
        )
    if valid is None:
        valid = jnp.ones(images.shape[:2], bool)
    if valid.shape != images.shape[:2] or valid.dtype != bool:
        raise ValueError(
            f"valid is {valid.dtype} of shape {valid.shape}, but must be bool {images.shape[:2]}"
        )
    if settings.range == "auto":
        lows, highs = automatic_range(images)
    else:
        lows = jnp.clip(images.min((-2, -1)), 0, 0.45)
        highs = jnp.clip(images.max((-2, -1)), 0.55, 1)

    def remember(state, inputs):
        low, high, keep = inputs  # (B,) each
        new = DisplayState(
            jnp.append(state.low[:, 1:], low[:, None], 1),
            jnp.append(state.high[:, 1:], high[:, None], 1),
        )
        state = jax.tree.map(lambda new, old: jnp.where(keep[:, None], new, old), new, state)
        return state, (jnp.nanmedian(state.low, 1), jnp.nanmedian(state.high, 1))

    state, (low, high) = jax.lax.scan(remember, state, (lows, highs, valid))
    low, high = low[..., None, None], high[..., None, None]
    return state, to_8_bit((images - low) / (high - low), settings.bilateral)


def automatic_range(images: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(..., H, W) -> what becomes black and white in each, (...,) both.

    Half a percent of the pixels may lie beyond either end, so that a hot pixel does not take the
    range; a twentieth of the range is added at both ends; if it is then narrower than `NARROWEST`,
    two thirds of what is missing are added below and one above.
    """
    height, width = images.shape[-2:]
    if min(height, width) > 4 * BORDER:
        images = images[..., BORDER:-BORDER, BORDER:-BORDER]
    step = max(1, math.isqrt(height * width // SAMPLES))
    sampled = images[..., ::step, ::step]
    sampled = sampled.reshape(*images.shape[:-2], math.prod(sampled.shape[-2:]))
    low, high = jnp.quantile(sampled, jnp.array([BEYOND, 1 - BEYOND]), axis=-1)
    margin = MARGIN * (high - low)
    missing = jnp.maximum(NARROWEST - (high - low + 2 * margin), 0)
    return low - margin - BELOW * missing, high + margin + (1 - BELOW) * missing


def to_8_bit(images: jax.Array | np.ndarray, sigma: float = 0.0) -> jax.Array:
    """(..., H, W) float32, clipped to [0, 1] -> the same uint8, after a bilateral filter if sigma
    is not 0."""
    images = jnp.clip(images, 0, 1)
    images = bilateral(images, sigma) if sigma else images
    return jnp.round(255 * images).astype(jnp.uint8)


@partial(jax.jit, static_argnames="sigma")
def bilateral(images: jax.Array, sigma: float = 25.0) -> jax.Array:
    """Bilateral filter: (..., H, W) in [0, 1] -> the same, smoothed except across edges.

    A mean over the 13 pixels within a distance of 2. Weights are exp(-d^2 / (2 sigma^2)), for the
    distance d in pixels times for the difference in grey levels (0 to 255). The image is reflected
    at the border. As cv2.bilateralFilter(image, 5, sigma, sigma), but not rounded to 8 bits.
    """
    height, width = images.shape[-2:]
    padded = jnp.pad(images, [(0, 0)] * (images.ndim - 2) + [(2, 2)] * 2, mode="reflect")
    total = weights = jnp.zeros_like(images)
    for i in range(-2, 3):
        for j in range(-2, 3):
            if i**2 + j**2 <= 4:
                neighbour = padded[..., 2 + i : 2 + i + height, 2 + j : 2 + j + width]
                square = i**2 + j**2 + (255 * (neighbour - images)) ** 2
                weight = jnp.exp(square / (-2 * sigma**2))
                total += weight * neighbour
                weights += weight
    return total / weights


def event_pictures(tensors: jax.Array) -> jax.Array:
    """Raw event tensors (..., H, W, 5) -> (..., H, W, 3) uint8: ON blue, OFF red, else white.

    The colour shows the sign of the sum of a pixel's votes, as in the original program.
    """
    votes = jnp.round(tensors.sum(-1))[..., None]  # an event's two votes sum to 1, up to rounding
    white, blue, red = (
        jnp.array(colour, jnp.uint8) for colour in ([255] * 3, [0, 0, 255], [255, 0, 0])
    )
    return jnp.where(votes > 0, blue, jnp.where(votes < 0, red, white))
