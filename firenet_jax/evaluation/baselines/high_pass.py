"""Window -> image: events summed up and slowly forgotten, a high-pass filter of each pixel (HF).

Scheerlinck, Barnes, Mahony, "Continuous-time Intensity Estimation Using Event Cameras", ACCV 2018,
for events alone, as in the authors' program. Windows are consecutive, in time order; images are
(H, W) float32 in [0, 1]. For each event (t, x, y, p) the estimate L of log intensity becomes

    L(x, y) <- exp(-alpha (t - t_last(x, y)) - kappa) L(x, y) + c_p,      alpha = 2 pi f_c

which for a window that is read at T, after N events at a pixel and read before at T0, is

    L_T = exp(-alpha (T - T0) - kappa N) L_T0 + sum_i c_p_i exp(-alpha (T - t_i) - kappa m_i)

with m_i the number of later events at that pixel: no approximation, and no loop over events.

Left out of the authors' program: contrast thresholds that adapt themselves (off by default), and
its neglect of row 0 and column 0. Pictures are not rounded to 8 bits.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from firenet_jax.evaluation.baselines.packing import clock, columns, seconds_between
from firenet_jax.pictures import bilateral
from firenet_jax.windows import Window

FIXED_RANGE = (-0.5, 1.5)  # intensities shown black and white without `adaptive_range`


@dataclass(frozen=True)
class HighPass:
    """How the filter forgets, and how its state becomes an image; the authors' numbers."""

    cutoff: float = 0.06
    """Cut-off frequency f_c in Hz: what changes more slowly is forgotten. 0 forgets nothing."""
    kappa: float = 0.06
    """What each event at a pixel makes it forget, dimensionless: a factor exp(-kappa)."""
    contrast_on: float = 0.1
    """Log intensity that an ON event adds."""
    contrast_off: float = -0.1
    """Log intensity that an OFF event adds."""
    adaptive_range: bool = True
    """Stretch the contrast to the image, the range following within 2 s; else it is fixed."""
    bilateral: float = 25.0
    """Sigma of the bilateral filter after the mapping, in grey levels of 255 and in pixels (in
    the FireNet paper 25); 0 switches it off."""


class HighPassState(NamedTuple):
    """What the next window needs to know of those before."""

    log_intensity: jax.Array  # (H, W) float32, L at `time`
    low: jax.Array  # () float32, intensity shown black; nan where there was no image yet
    high: jax.Array  # () float32, intensity shown white
    time: jax.Array  # (2,) int32, `clock` of the last window's time


class Sums(NamedTuple):
    """A window's events with what the sum above needs, unused places at the end."""

    pixel: np.ndarray  # (E,) int32, row * W + column; H * W for unused places
    age: np.ndarray  # (E,) float32 s, T - t_i
    p: np.ndarray  # (E,) bool
    later: np.ndarray  # (E,) int32, m_i
    time: np.ndarray  # (2,) int32, `clock` of T


def initial_state(height: int, width: int) -> HighPassState:
    """The state before the first window."""
    unknown = jnp.full((), jnp.nan, jnp.float32)
    zeros = jnp.zeros((height, width), jnp.float32)
    return HighPassState(zeros, unknown, unknown, jnp.zeros(2, jnp.int32))


def step(
    state: HighPassState, window: Window, settings: HighPass = HighPass()
) -> tuple[HighPassState, jax.Array]:
    """(HighPassState, Window of any size) -> (HighPassState, (H, W) float32 in [0, 1])."""
    return advance(state, pack(window, *state.log_intensity.shape), settings)


def pack(window: Window, height: int, width: int) -> Sums:
    """A window's events, in time order -> those on the device, pixel by pixel."""
    events = window.events
    # A stable order. Here and not on the device: a radix sort of 16-bit columns takes 0.1 ms for
    # 20,000 events, XLA's sort on a CPU 3 to 25 ms.
    order = np.lexsort((events.x, events.y))
    events = events.select(order)
    pixel, age, p = columns(Window(events, window.time), height, width)
    ends = np.append((np.diff(events.x) != 0) | (np.diff(events.y) != 0), True)[: len(events)]
    last = np.flatnonzero(ends)  # the last event of each pixel
    later = np.zeros_like(pixel)
    later[: len(events)] = np.repeat(last, np.diff(last, prepend=-1)) - np.arange(len(events))
    return Sums(pixel, age, p, later, clock(window.time))


@partial(jax.jit, static_argnames="settings")
def advance(
    state: HighPassState, sums: Sums, settings: HighPass = HighPass()
) -> tuple[HighPassState, jax.Array]:
    """(HighPassState, a packed window) -> (HighPassState, (H, W) float32 in [0, 1])."""
    height, width = state.log_intensity.shape
    alpha = 2 * math.pi * settings.cutoff
    per_pixel = partial(jax.ops.segment_sum, num_segments=height * width)

    # Below zero only in the first window, whose clock may be anywhere; there is nothing to forget.
    elapsed = jnp.maximum(seconds_between(state.time, sums.time), 0.0)
    contrast = jnp.where(sums.p, settings.contrast_on, settings.contrast_off)
    gained = contrast * jnp.exp(-alpha * sums.age - settings.kappa * sums.later)
    count = per_pixel(jnp.ones_like(sums.age), sums.pixel).reshape(height, width)
    kept = jnp.exp(-alpha * elapsed - settings.kappa * count) * state.log_intensity
    log_intensity = kept + per_pixel(gained, sums.pixel).reshape(height, width)

    low, high = FIXED_RANGE
    if settings.adaptive_range:
        low, high = _follow(state.low, state.high, log_intensity, elapsed)
    # exp(L + ln 1.5) - 1: the initial L, 0, is the grey in the middle, 0.5.
    intensity = 1.5 * jnp.exp(log_intensity) - 1
    image = jnp.clip((intensity - low) / (high - low), 0.0, 1.0)
    if settings.bilateral:
        image = bilateral(image, settings.bilateral)
    low, high = jnp.asarray(low, jnp.float32), jnp.asarray(high, jnp.float32)
    return HighPassState(log_intensity, low, high, jnp.asarray(sums.time)), image


def _follow(low, high, log_intensity, elapsed) -> tuple[jax.Array, jax.Array]:
    """The next range: towards what all but 0.5 % of the pixels need, by 95 % within 2 s.

    It never gets narrower than from 0.3 to 0.7. The first image has its own range at once.
    """
    pixels = log_intensity.size
    # The intensity plus 1 has no sign, as `_ranked` wants it.
    least, greatest = (
        _ranked(jnp.exp(log_intensity), math.floor(part * pixels)) for part in (0.0025, 0.9975)
    )
    least, greatest = 1.5 * least - 1 - 0.05, 1.5 * greatest - 1 + 0.05
    beta = jnp.exp(math.log(0.05) / 2 * elapsed)
    low = jnp.where(jnp.isnan(low), least, beta * low + (1 - beta) * least)
    high = jnp.where(jnp.isnan(high), greatest, beta * high + (1 - beta) * greatest)
    return jnp.minimum(low, 0.3), jnp.maximum(high, 0.7)


def _ranked(values: jax.Array, rank: int) -> jax.Array:
    """The value, of many that are 0 or more, at this place (from 0) of their ascending order.

    Floats without a sign are ordered as their bits are as integers, so the bits are found one by
    one, the greatest first. That is 10 times as fast as XLA's sort on a CPU.
    """
    bits = jax.lax.bitcast_convert_type(values, jnp.int32)

    def refine(k, found):
        candidate = found + (jnp.int32(1) << (30 - k))
        return jnp.where((bits < candidate).sum() <= rank, candidate, found)

    found = jax.lax.fori_loop(0, 31, refine, jnp.int32(0))
    return jax.lax.bitcast_convert_type(found, jnp.float32)
