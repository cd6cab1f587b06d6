"""Sensors before scenes -> event tensors, truth and optical flow, which never leave the device.

B sequences of T windows side by side: every window is rendered several times, `sensor.step` turns
each rendering into runs of events, and these vote for the bins of the window by Eq. 1 of the paper.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from firenet_jax.events import BINS
from firenet_jax.simulation.scenes import Scene, flow, render, speeds
from firenet_jax.simulation.sensor import (
    Sensor,
    SensorState,
    first_state,
    most_noise,
    stamps,
    step,
)

EVENTS_PER_PASS = 4  # of a pixel, in one pass over the picture: saves memory traffic


class Simulation(NamedTuple):
    """T windows of B sequences. Images and displacement belong to the windows' ends."""

    tensors: jax.Array
    """(T, B, H, W, 5) float32, not normalised, window bounds as t_min and t_max."""
    images: jax.Array
    """(T, B, H, W) float32 in [0, 1], the truth at the window's end."""
    displacement: jax.Array
    """(T, B, H, W, 2) float32 pixels, from the window's start to its end."""
    visible: jax.Array
    """(T, B, H, W) bool, where the displacement leads to a visible place."""


def _draw(scenes: Scene, seconds: jax.Array, *, height: int, width: int) -> jax.Array:
    """B scenes, (B,) -> (B, H, W)."""
    draw = partial(render, height=height, width=width)
    return jax.vmap(draw)(scenes, seconds).image


def first_states(
    sensors: Sensor, scenes: Scene, times: jax.Array, *, height: int, width: int
) -> SensorState:
    """The states of B sensors that see B scenes for the first time at (B,) int32 microseconds."""
    return jax.vmap(first_state)(sensors, _draw(scenes, 1e-6 * times, height=height, width=width))


@partial(jax.jit, static_argnames=("height", "width", "renderings"))
def simulate(
    sensors: Sensor,
    scenes: Scene,
    bounds: jax.Array,
    state: SensorState | None = None,
    *,
    height: int,
    width: int,
    renderings: int | tuple[int, int] = 5,
) -> tuple[SensorState, Simulation]:
    """B sensors before B scenes -> event tensors and truth, all on the device.

    bounds: (T + 1, B) int32, microseconds since the scenes' start; window t lasts from t to t + 1.
    state: what the last call returned, to go on where it ended; None starts afresh.
    renderings: number in each window, equally spaced. Nothing moves by more than a pixel between
    two if windows last at most renderings / scene.speed seconds. Or the fewest and the most: on a
    CPU only as many as a window needs (`renderings_needed`); elsewhere the most, because sequences
    are simulated side by side, and one of them needs it.
    """
    if state is None:
        state = first_states(sensors, scenes, bounds[0], height=height, width=width)
    least, most = (renderings, renderings) if isinstance(renderings, int) else renderings
    one = partial(_one_sequence, size=(height, width), least=least)
    side_by_side = jax.vmap(partial(one, counts=most), out_axes=(0, 1))
    needed = partial(renderings_needed, height=height, width=width, least=least, most=most)

    def one_by_one(*given):
        counts = jax.vmap(needed)(*given[:3])
        state, made = jax.lax.map(lambda each: one(*each), (*given, counts))
        return state, jax.tree.map(lambda leaf: leaf.swapaxes(0, 1), made)

    given = sensors, scenes, bounds.T, state
    if least == most:
        return side_by_side(*given)
    return jax.lax.platform_dependent(*given, cpu=one_by_one, default=side_by_side)


def renderings_needed(
    sensor: Sensor, scene: Scene, bounds: jax.Array, *, height: int, width: int, least, most
) -> jax.Array:
    """(T + 1,) int32 microseconds -> (T,) int32, how many renderings each window needs.

    Enough that nothing moves by more than half a pixel between two, and that a pixel has at most
    half an expected noise event between them; `most` where light flickers.
    """
    duration = 1e-6 * jnp.diff(bounds)
    times = 1e-6 * bounds[:-1, None] + duration[:, None] * jnp.array([[0.0, 0.5, 1.0]])
    seen = speeds(scene, times.ravel(), height=height, width=width).reshape(times.shape)
    needed = duration * 1.1 * seen.max(-1) / 0.5  # 10 % for what is faster between these times
    if sensor.noise is not None:
        needed = jnp.maximum(needed, 2 * duration * most_noise(sensor.noise))
    if sensor.lamp is not None:
        needed = jnp.where(sensor.lamp.swing.max() > 0, most, needed)
    return jnp.clip(jnp.ceil(needed), least, most).astype(jnp.int32)


def _one_sequence(sensor, scene, bounds, state, counts, *, size: tuple[int, int], least: int):
    """`simulate` without its axis of the batch; size: height and width.

    counts: (T,) int32 or a number, renderings in each window, `least` or more.
    """
    # Bins that votes of one rendering reach.
    span = min(-(-(BINS - 1) // least) + 2, BINS)
    height, width = size

    def window(state, inputs):
        start, end, number = inputs
        count = counts if isinstance(counts, int) else counts[number]

        def rendering(k, carry):
            state, planes, passed, _ = carry
            until = (k + 1) * (end - start) // count
            image = render(scene, 1e-6 * (start + until), height=height, width=width).image
            state, runs = step(sensor, state, image, until - passed)
            low = jnp.minimum((BINS - 1) * k // count, BINS - span)
            votes = jax.lax.dynamic_slice_in_dim(planes, low, span)
            votes = _votes(votes, low, runs, passed, end - start)
            planes = jax.lax.dynamic_update_slice_in_dim(planes, votes, low, 0)
            return state, planes, until, image

        planes, image = jnp.zeros((BINS, height, width)), jnp.zeros((height, width))
        carry = state, planes, jnp.zeros_like(start), image
        state, planes, _, image = jax.lax.fori_loop(0, count, rendering, carry)
        displacement, visible = flow(scene, 1e-6 * start, 1e-6 * end, height=height, width=width)
        return state, Simulation(planes.transpose(1, 2, 0), image, displacement, visible)

    return jax.lax.scan(window, state, (bounds[:-1], bounds[1:], jnp.arange(len(bounds) - 1)))


def to_and_fro(
    data: Simulation, scenes: Scene, bounds: jax.Array, *, height: int, width: int
) -> Simulation:
    """T windows, an even number -> T windows: the first half forward and then backward.

    Backward, time is reversed and polarity inverted: bins in reverse order, votes negated. Truth
    and displacement are those of the scene.
    bounds: (T + 1, B) int32, as in `simulate`.
    """
    half = len(data.images) // 2
    draw = partial(_draw, height=height, width=width)
    move = jax.vmap(partial(flow, height=height, width=width))
    seconds = 1e-6 * bounds[half::-1]  # of the ends of windows, backward
    displacement, visible = jax.lax.map(
        lambda ends: move(scenes, *ends), (seconds[:-1], seconds[1:])
    )
    images = jnp.concatenate([data.images[: half - 1][::-1], draw(scenes, seconds[-1])[None]])
    back = Simulation(-data.tensors[:half][::-1, ..., ::-1], images, displacement, visible)
    return jax.tree.map(lambda forth, back: jnp.concatenate([forth[:half], back]), data, back)


def _votes(planes: jax.Array, low, runs, passed: jax.Array, total: jax.Array) -> jax.Array:
    """Adds the votes of runs (H, W) by Eq. 1 to planes (n, H, W), the bins from `low` on.

    passed: () int32, microseconds from the window's start to the interval's; total: duration of
    the window. Events of a pixel are processed one after the other, all pixels in parallel, up to
    the count of the busiest one.
    """
    scale = (BINS - 1) / total.astype(jnp.float32)

    def vote(planes, run, number):
        stamp = passed + stamps(run.first, run.spacing, number)
        t_star = stamp.astype(jnp.float32) * scale
        weight = jnp.where(number < run.count, run.polarity, 0.0)
        return [
            plane + weight * jnp.maximum(0.0, 1 - jnp.abs(low + n - t_star))
            for n, plane in enumerate(planes)
        ]

    first = runs[0]
    most = first.count.max()

    def several(carry):
        number, planes = carry
        for n in range(EVENTS_PER_PASS):
            planes = vote(planes, first, number + n)
        return number + EVENTS_PER_PASS, planes

    start = jnp.int32(0), list(planes)
    _, voted = jax.lax.while_loop(lambda carry: carry[0] < most, several, start)
    for run in runs[1:]:  # noise: at most one event
        voted = vote(voted, run, 0)
    return jnp.stack(voted)
