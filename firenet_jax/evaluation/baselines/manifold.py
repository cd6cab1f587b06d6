"""Window -> image: variational denoising on the surface of the events' times (MR).

Reinbacher, Graber, Pock, "Real-Time Intensity-Image Reconstruction for Event Cameras Using
Manifold Regularisation", BMVC 2016. Windows are consecutive, in time order; images are (H, W)
float32 in [0, 1]. Of each packet of 1000 events every ON event multiplies its pixel by c_on, every
OFF event divides it by c_off; the image f that results is denoised to u, which the next packet
multiplies. t(x, y) is the time of a pixel's last event, in seconds, smoothed, t_x and t_y its
differences, G = 1 + t_x^2 + t_y^2; u minimises

    sum sqrt(G) |grad_g u|_eps / lambda + sum sqrt(G) (u - f log u),      u_min <= u <= u_max
    grad_g u = (c1 u_x - c2 u_y,  c3 u_y - c2 u_x,  (t_x u_x + t_y u_y) / G)
    c1 = (1 + t_y^2) / G,  c2 = t_x t_y / G,  c3 = (1 + t_x^2) / G

by a fixed number of primal-dual steps. Differences are forward, 0 at the last column and row. Where
the authors' program departs from this (the third component's adjoint and metric, the border, lost
events of a pixel that has several in a packet) it is not followed.

Differences are padded here: on XLA's CPU that takes half the time of rolled images.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from firenet_jax.evaluation.baselines.packing import clock, columns, seconds_between
from firenet_jax.windows import Window


@dataclass(frozen=True)
class Manifold:
    """How events become an image; the numbers of the authors' program for recordings."""

    packet: int = 1000
    """Events between two denoisings. A window's last packet may hold fewer."""
    contrast_on: float = 1.15
    """An ON event multiplies its pixel by this."""
    contrast_off: float = 1.20
    """An OFF event divides its pixel by this."""
    fidelity: float = 180.0
    """lambda: how closely the image follows the events; less smooths more."""
    time_weight: float = 2.0
    """Factor of the time surface's differences, per second; 0 makes the manifold flat."""
    iterations: int = 49
    """Steps of each of the two minimisations (the loops of the original count 1 to 49)."""
    darkest: float = 1.0
    """u_min, shown as 0."""
    brightest: float = 2.0
    """u_max, shown as 1. The first image is half way between them."""


class ManifoldState(NamedTuple):
    """What the next window needs to know of those before. Both minimisations start where they
    ended."""

    image: jax.Array  # (H, W) float32, u, from u_min to u_max
    dual: jax.Array  # (3, H, W) float32, of u
    surface: jax.Array  # (H, W) float32 s, t relative to `time`; nan before the first window
    surface_dual: jax.Array  # (2, H, W) float32, of t
    time: jax.Array  # (2,) int32, `clock` of the last window's time


class Packets(NamedTuple):
    """A window's events, in time order, in rows of a packet each."""

    pixel: np.ndarray  # (packets, N) int32, row * W + column; H * W for unused places
    age: np.ndarray  # (packets, N) float32 seconds before the window's time
    p: np.ndarray  # (packets, N) bool
    count: np.ndarray  # () int32, packets that hold events: the first ones
    time: np.ndarray  # (2,) int32, `clock` of the window's time


class Metric(NamedTuple):
    """The surface's geometry, (H, W) float32 each, as the equations above name it."""

    c1: jax.Array
    c2: jax.Array
    c3: jax.Array
    x: jax.Array  # t_x / G
    y: jax.Array  # t_y / G
    area: jax.Array  # sqrt(G)


def initial_state(height: int, width: int, settings: Manifold = Manifold()) -> ManifoldState:
    """The state before the first window: a grey image, no pixel newer than the first event."""
    grey = (settings.darkest + settings.brightest) / 2
    return ManifoldState(
        jnp.full((height, width), grey, jnp.float32),
        jnp.zeros((3, height, width), jnp.float32),
        jnp.full((height, width), jnp.nan, jnp.float32),
        jnp.zeros((2, height, width), jnp.float32),
        jnp.zeros(2, jnp.int32),
    )


def step(
    state: ManifoldState, window: Window, settings: Manifold = Manifold()
) -> tuple[ManifoldState, jax.Array]:
    """(ManifoldState, Window of any size) -> (ManifoldState, (H, W) float32 in [0, 1])."""
    height, width = state.image.shape
    return advance(state, pack(window, height, width, settings.packet), settings)


def pack(window: Window, height: int, width: int, packet: int = 1000) -> Packets:
    """A window's events, in time order -> packets of so many events on the device."""
    pixel, age, p = (c.reshape(-1, packet) for c in columns(window, height, width, packet))
    count = np.array(-(-len(window.events) // packet), np.int32)
    return Packets(pixel, age, p, count, clock(window.time))


@partial(jax.jit, static_argnames="settings")
def advance(
    state: ManifoldState, packets: Packets, settings: Manifold = Manifold()
) -> tuple[ManifoldState, jax.Array]:
    """(ManifoldState, a packed window) -> (ManifoldState, (H, W) float32 in [0, 1]).

    A window without events changes nothing but the state's time.
    """
    elapsed = seconds_between(state.time, packets.time)
    first = -packets.age[0, 0]  # the surface begins at the time of the first event of all
    begins = jnp.isnan(state.surface) & (packets.count > 0)
    surface = jnp.where(begins, first, state.surface - elapsed)

    def denoise_packet(k, carry):
        image, dual, surface, surface_dual = carry
        pixel, age, p = packets.pixel[k], packets.age[k], packets.p[k]
        noisy = image * _contrasts(pixel, p, image.shape, settings)
        newest = jax.ops.segment_max(-age, pixel, image.size).reshape(image.shape)
        surface = jnp.where(newest > -jnp.inf, newest, surface)
        surface, surface_dual = smooth(surface, surface_dual, settings.iterations)
        geometry = metric(surface, settings.time_weight)
        image, dual = denoise(image, dual, noisy, geometry, settings)
        return image, dual, surface, surface_dual

    # A loop with as many turns as there are packets with events: unused ones cost no time.
    carry = state.image, state.dual, surface, state.surface_dual
    image, dual, surface, surface_dual = jax.lax.fori_loop(0, packets.count, denoise_packet, carry)
    shown = (image - settings.darkest) / (settings.brightest - settings.darkest)
    time = jnp.asarray(packets.time)
    return ManifoldState(image, dual, surface, surface_dual, time), shown


def _contrasts(pixel, p, shape, settings: Manifold) -> jax.Array:
    """The product over each pixel's events: c_on for ON, 1 / c_off for OFF."""
    on, off = np.log([settings.contrast_on, settings.contrast_off], dtype=np.float32)
    logs = jnp.where(p, on, -off)
    return jnp.exp(jax.ops.segment_sum(logs, pixel, math.prod(shape))).reshape(shape)


def smooth(surface: jax.Array, dual: jax.Array, iterations: int) -> tuple[jax.Array, jax.Array]:
    """TV-L1: steps towards the t that minimises sum |grad t| / 2 + sum |t - surface|.

    surface: (H, W), also the start; dual: (2, H, W), the start. Returns both, smoothed and next.
    """
    rate = math.sqrt(1 / 8)  # of both variables; 8 bounds the squared norm of the gradient

    def step(carry, _):
        t, leading, px, py = carry
        dx, dy = _differences(leading)
        px, py = px + rate * dx, py + rate * dy
        norm = jnp.maximum(1.0, 2 * jnp.sqrt(px**2 + py**2))
        px, py = px / norm, py / norm
        change = t - rate * _differences_adjoint(px, py) - surface
        shrunk = jnp.sign(change) * jnp.maximum(0.0, jnp.abs(change) - rate)
        return (surface + shrunk, 2 * (surface + shrunk) - t, px, py), None

    carry = surface, surface, *dual
    (t, _, px, py), _ = jax.lax.scan(step, carry, length=iterations)
    return t, jnp.stack([px, py])


def metric(surface: jax.Array, weight: float) -> Metric:
    """(H, W) s -> the geometry of weight times the surface, steps clipped to half a second."""
    tx, ty = (weight * jnp.clip(step, -0.5, 0.5) for step in _differences(surface))
    g = 1 + tx**2 + ty**2
    return Metric((1 + ty**2) / g, tx * ty / g, (1 + tx**2) / g, tx / g, ty / g, jnp.sqrt(g))


def gradient(geometry: Metric, image: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """(H, W) -> the three components of grad_g, (H, W) each."""
    m = geometry
    ux, uy = _differences(image)
    return m.c1 * ux - m.c2 * uy, m.c3 * uy - m.c2 * ux, m.x * ux + m.y * uy


def gradient_adjoint(geometry: Metric, p1: jax.Array, p2: jax.Array, p3: jax.Array) -> jax.Array:
    """Three components, (H, W) each -> (H, W): the transpose of `gradient`."""
    m = geometry
    return _differences_adjoint(m.c1 * p1 - m.c2 * p2 + m.x * p3, m.c3 * p2 - m.c2 * p1 + m.y * p3)


def denoise(
    image: jax.Array, dual: jax.Array, noisy: jax.Array, geometry: Metric, settings: Manifold
) -> tuple[jax.Array, jax.Array]:
    """Primal-dual steps towards the u that minimises the energy above for f = noisy.

    image: (H, W) and dual: (3, H, W), the start. Returns both after `settings.iterations` steps.
    """
    tau, huber = 0.01, 0.3
    sigma = 1 / (tau * (8 + 2 * math.sqrt(2)))  # sigma tau ||K||^2 <= 1; here ||K||^2 is below 8
    tb = tau * geometry.area

    def step(carry, _):
        u, leading, *p = carry
        p = [
            (p + sigma * slope) / (1 + huber * sigma)
            for p, slope in zip(p, gradient(geometry, leading), strict=True)
        ]
        length = jnp.sqrt(p[0] ** 2 + p[1] ** 2 + p[2] ** 2)
        norm = jnp.maximum(1.0, settings.fidelity / geometry.area * length)
        p = [component / norm for component in p]
        v = u - tau * gradient_adjoint(geometry, *p) - tb
        new = (v + jnp.sqrt(v**2 + 4 * tb * noisy)) / 2
        new = jnp.clip(new, settings.darkest, settings.brightest)
        return (new, 2 * new - u, *p), None

    (u, _, *p), _ = jax.lax.scan(step, (image, image, *dual), length=settings.iterations)
    return u, jnp.stack(p)


def _differences(image: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(H, W) -> to the right neighbour and to the one below, 0 at the last column and row."""
    x = jnp.pad(image[:, 1:] - image[:, :-1], ((0, 0), (0, 1)))
    y = jnp.pad(image[1:] - image[:-1], ((0, 1), (0, 0)))
    return x, y


def _differences_adjoint(x: jax.Array, y: jax.Array) -> jax.Array:
    """The transpose of `_differences`: minus the divergence of (x, y)."""
    x, y = x[:, :-1], y[:-1]
    across = jnp.pad(x, ((0, 0), (1, 0))) - jnp.pad(x, ((0, 0), (0, 1)))
    return across + jnp.pad(y, ((1, 0), (0, 0))) - jnp.pad(y, ((0, 1), (0, 0)))
