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


def columns(
    window: Window, height: int, width: int, multiple: int = 1
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Window of N events -> pixel, age, p, each (E,), E being `capacity(N)` or the next multiple.

    pixel: int32, row * width + column; height * width, which every sum over segments drops, in
    unused places and for events outside the sensor. age: float32 s. p: bool.
    """
    events, time = window
    unused = 0, -(-capacity(len(events)) // multiple) * multiple - len(events)
    x, y = events.x.astype(np.int32), events.y.astype(np.int32)
    seen = (0 <= x) & (x < width) & (0 <= y) & (y < height)
    pixel = np.where(seen, y * width + x, np.int32(height * width))
    age = ((time - events.t) * 1e-6).astype(np.float32)
    pixel = np.pad(pixel, unused, constant_values=height * width)
    return pixel, np.pad(age, unused), np.pad(events.p, unused)


def clock(time: int) -> np.ndarray:
    """Microseconds -> (2,) int32, whole seconds and the microseconds beyond them."""
    return np.array(divmod(time, 10**6), np.int64).astype(np.int32)


def seconds_between(earlier: jax.Array, later: ArrayLike) -> jax.Array:
    """Two times of `clock` -> float32 s."""
    seconds, microseconds = (jnp.asarray(later) - earlier).astype(jnp.float32)
    return seconds + 1e-6 * microseconds
