"""Window -> arrays for the device: what the baselines that go event by event need, in fixed sizes.

Ages are float32 seconds before the window's time; they are differences of int64 microseconds, so
they are as exact after hours as in the first second. The windows' own times travel as two int32,
whole seconds and microseconds, since jax has no int64.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from firenet_jax.tensors import capacity
from firenet_jax.windows import Window


def columns(window: Window, height: int, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Window of N events -> pixel, age, p, each (E,), E being `capacity(N)`.

    pixel: int32, row * width + column; height * width, which every sum over segments drops, in
    unused places and for events outside the sensor. age: float32 s. p: bool.
    """
    events, time = window
    size = capacity(len(events))
    x, y = events.x.astype(np.int32), events.y.astype(np.int32)
    seen = (0 <= x) & (x < width) & (0 <= y) & (y < height)
    pixel = np.full(size, height * width, np.int32)
    age = np.zeros(size, np.float32)
    p = np.zeros(size, bool)
    pixel[: len(events)] = np.where(seen, y * width + x, height * width)
    age[: len(events)] = (time - events.t) * 1e-6
    p[: len(events)] = events.p
    return pixel, age, p


def clock(time: int) -> np.ndarray:
    """Microseconds -> (2,) int32, whole seconds and the microseconds beyond them."""
    return np.array(divmod(time, 10**6), np.int64).astype(np.int32)


def seconds_between(earlier: jax.Array, later: ArrayLike) -> jax.Array:
    """Two times of `clock` -> float32 s."""
    seconds, microseconds = (jnp.asarray(later) - earlier).astype(jnp.float32)
    return seconds + 1e-6 * microseconds
