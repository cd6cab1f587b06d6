"""key -> the sequences of a training: which sensors look at which scenes, for how long, how fast.

    random_setups   a batch of sensors, scenes and durations of windows
    sequences       the same, simulated: event tensors and truth

What most sequences are like is for `scenes.SceneSettings` and `sensor.SensorSettings` to say. Here
are the rare ones, which training needs and chance would not draw: hardly any motion, very fast
motion, and noise where everything has stopped.
"""

import math
from functools import partial

import jax
import jax.numpy as jnp

from firenet_jax.errors import SettingsError
from firenet_jax.simulation.scenes import Scene, SceneSettings, log_uniform, random_scene
from firenet_jax.simulation.sensor import (
    LEAST_THRESHOLD,
    Noise,
    Sensor,
    SensorSettings,
    random_sensor,
)
from firenet_jax.simulation.sequences import Simulation, simulate

SLOW, SWIFT = (0.02, 0.3), (16.0, 90.0)  # pixels per window, in slow and swift sequences
# Slow sequences have this many times the mismatch, so that the pixels of an edge fire one by one.
SLOW_MISMATCH = 4.0
# Share of the slow sequences with hardly any faults, so that single events can be trusted.
NEARLY_NOISELESS = 2 / 3
# Half of the sequences that stop for good have this much noise, in events per pixel and window,
# equal in light and dark: at rest, windows with a fixed number of events hold nothing but noise. In
# half of these the polarities are random instead of alternating: their sums look like contrast.
# Of sensors whose noise shows what is dark, only this share is equal.
AT_REST, EQUAL_AT_REST = (0.02, 1.0), 0.4
LONGEST_WINDOW = 3e5  # microseconds


def check_rare(slow: float, swift: float) -> None:
    """Raises SettingsError unless these are shares, and less than 1 together."""
    if not (slow >= 0 and swift >= 0 and slow + swift < 1):
        raise SettingsError(
            f"slow is {slow} and swift is {swift}, but they are parts of the sequences: 0 or more, "
            "together less than 1"
        )


def check_motion(motion: tuple[float, float], renderings: int) -> None:
    """Raises SettingsError if something moves by more than a pixel between two renderings, the
    bound of Gehrig et al., "Video to Events", CVPR 2020."""
    if motion[1] > renderings:
        raise SettingsError(
            f"windows with {motion[1]} pixels of motion need {math.ceil(motion[1])} "
            f"renderings, not {renderings}"
        )


@partial(
    jax.jit,
    static_argnames="batch height width renderings motion slow swift scene sensor".split(),
)
def random_setups(
    key: jax.Array,
    textures: jax.Array,
    *,
    batch: int,
    windows: int | jax.Array,
    height: int,
    width: int,
    renderings: int = 5,
    motion: tuple[float, float] = (1.25, 2.5),
    slow: float = 0.0,
    swift: float = 0.0,
    scene: SceneSettings = SceneSettings(),
    sensor: SensorSettings = SensorSettings(),
) -> tuple[Sensor, Scene, jax.Array]:
    """key, textures (N, S, S) -> sensors, scenes, durations: B random setups for `simulate`.

    durations: (B,) int32 microseconds of each sequence's windows, 1 to 300 ms: such that at its
    fastest time the fastest point moves by `motion` pixels per window (least, greatest;
    log-uniform).
    windows: number per sequence, over which pauses are placed and the speed is measured.
    slow: share of the sequences with hardly any motion: `SLOW` pixels per window, `SLOW_MISMATCH`
    times the mismatch, and in most of them a fiftieth of the noise and leaks.
    swift: share of the sequences with very fast motion (`SWIFT` pixels per window, more than one
    between renderings) over a plain background.
    Where the settings have noise, half of the scenes that stop for good are noisy (`AT_REST`), of
    clean sensors too: at rest an image is to stay whatever comes.
    Raises SettingsError if `motion` is more than a pixel between two renderings (`check_motion`),
    or if slow and swift are not valid shares.
    """
    check_motion(motion, renderings)
    check_rare(slow, swift)
    scene_key, sensor_key, number_key = jax.random.split(key, 3)
    numbers = jax.random.uniform(number_key, (2, batch))

    speed, duration, is_slow, is_swift = _paces(
        numbers, scene.speed, motion, renderings, slow, swift
    )
    size = {"height": height, "width": width}

    def one_scene(key, duration, speed):
        seconds = 1e-6 * windows * duration
        return random_scene(key, textures, duration=seconds, speed=speed, settings=scene, **size)

    scenes = jax.vmap(one_scene)(jax.random.split(scene_key, batch), duration, speed)
    one_sensor = partial(random_sensor, settings=sensor, **size)
    sensors = jax.vmap(one_sensor)(jax.random.split(sensor_key, batch))
    if slow:
        sensors = _uneven(sensors, numbers[1], is_slow, slow)
    if swift:
        grey_key = jax.random.fold_in(number_key, 1)
        grey = jax.random.uniform(grey_key, (batch, 1, 1), minval=0.2, maxval=0.8)
        ground = jnp.where(is_swift[:, None, None], grey, scenes.textures[0])
        scenes = scenes._replace(textures=(ground, *scenes.textures[1:]))
    if scene.halt:
        rest_key = jax.random.fold_in(number_key, 2)
        sensors = _noisy_at_rest(rest_key, sensors, scenes, windows, duration)
    return sensors, scenes, duration


def _paces(
    numbers: jax.Array,
    speeds: tuple[float, float],
    motion: tuple[float, float],
    renderings: int,
    slow: float,
    swift: float,
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """(2, B) uniform numbers -> pixels per second, window duration, whether slow, whether swift;
    (B,) each. The other arguments are those of `random_setups`."""
    speed, kind = log_uniform(speeds, numbers[0]), numbers[1]
    is_slow, is_swift = kind < slow, kind >= 1 - swift
    pixels = log_uniform(motion, jnp.clip((kind - slow) / (1 - slow - swift), 0, 1))
    pixels = jnp.where(is_slow, log_uniform(SLOW, kind / (slow or 1)), pixels)
    pixels = jnp.where(is_swift, log_uniform(SWIFT, (kind - 1 + swift) / (swift or 1)), pixels)
    duration = jnp.clip(1e6 * pixels / speed, 1e3, LONGEST_WINDOW).astype(jnp.int32)
    usual = jnp.minimum(speed, 1e6 * renderings / duration)
    speed = jnp.where(is_slow | is_swift, 1e6 * pixels / duration, usual)
    return speed, duration, is_slow, is_swift


def _uneven(sensors: Sensor, kind: jax.Array, is_slow: jax.Array, slow: float) -> Sensor:
    """Slow sequences get more threshold mismatch, and most of them hardly any noise."""
    apart = jnp.where(is_slow, SLOW_MISMATCH, 1.0)[:, None, None]

    def uneven(thresholds):
        mean = thresholds.mean((-2, -1), keepdims=True)
        return jnp.maximum(mean + apart * (thresholds - mean), LEAST_THRESHOLD)

    if sensors.on.ndim == 3:  # else all pixels of a sequence have one
        sensors = sensors._replace(on=uneven(sensors.on), off=uneven(sensors.off))
    share = jnp.where(kind < NEARLY_NOISELESS * slow, 0.02, 1.0)
    if sensors.noise is not None:
        calmer = sensors.noise._replace(rate=share * sensors.noise.rate)
        sensors = sensors._replace(noise=calmer)
    if sensors.drift is not None:
        sensors = sensors._replace(drift=sensors.drift * share[:, None, None])
    return sensors


def _noisy_at_rest(
    key: jax.Array, sensors: Sensor, scenes: Scene, windows: int | jax.Array, duration: jax.Array
) -> Sensor:
    """The sensors, if noisy, with the noise of `AT_REST` in half of the sequences that stop."""
    usual = sensors.noise
    if usual is None:
        return sensors
    seconds = 1e-6 * duration
    stopped = scenes.pauses[:, 0, 1] - scenes.pauses[:, 0, 0] > windows * seconds
    noisy, share = jax.random.uniform(key, (2, len(duration)))
    rate = log_uniform(AT_REST, share) / seconds
    chosen = stopped & (noisy < 0.5)
    slope = usual.slope
    if slope is not None:
        equal = jax.random.uniform(jax.random.fold_in(key, 1), rate.shape) < EQUAL_AT_REST
        slope = jnp.where(chosen & equal, 0.0, slope)
    uniform = Noise(rate, jnp.ones_like(rate), slope, noisy < 0.25)
    usual = usual._replace(slope=slope)
    noise = jax.tree.map(lambda rest, usual: jnp.where(chosen, rest, usual), uniform, usual)
    return sensors._replace(noise=noise)


def window_bounds(durations: jax.Array, windows: int, first: jax.Array | int = 0) -> jax.Array:
    """Durations (B,) -> (windows + 1, B) int32 microseconds, of the windows from `first` on.

    first: () or (B,) int32.
    """
    first = jnp.broadcast_to(first, durations.shape)
    return (first[None] + jnp.arange(windows + 1, dtype=jnp.int32)[:, None]) * durations[None]


def sequences(
    key: jax.Array, textures: jax.Array, *, height: int, width: int, renderings: int = 5, **settings
) -> Simulation:
    """key, textures (N, S, S) -> training data; `settings` are those of `random_setups`."""
    shared = {"height": height, "width": width, "renderings": renderings}
    sensors, scenes, durations = random_setups(key, textures, **shared, **settings)
    bounds = window_bounds(durations, settings["windows"])
    return simulate(sensors, scenes, bounds, **shared)[1]
