"""Intensity video -> events: ESIM's sensor, with faults.

One model with two equivalent outputs: `event_list` yields time-sorted `Events` on the host,
`sequences.simulate` gives event tensors on the device. Both call `step` for each rendering of the
scene:

    L = log(0.001 + I);  a pixel emits an event, p = +1 or -1, each time L, taken as linear between
    two renderings, crosses reference + p C_p; the reference moves by p C_p, also when the
    refractory period swallows the event. Shot noise fires ON and OFF in turn, whatever L does.

(Rebecq et al., "ESIM: an open event camera simulator", CoRL 2018.) Because L is linear, the events
of a pixel between two renderings are equally spaced, and so are those left by the refractory
period: a `Run`. Time stamps are whole microseconds, as in real sensors. On the device times count
from the start of the interval in units of 1/1024 us; both outputs round them alike, and an interval
may last two seconds. (An event in the last half microsecond of a window is stamped with the
window's end. The tensor on the device includes it; cutting the list into [start, end) puts it into
the next window.)

A pixel has at most one event of noise between two renderings. `event_list` inserts renderings for
that; on the device noise is cut where there are fewer renderings than events of it.

Flickering light is part of the sensor model, not of the scene: ground-truth images do not show it.

Images are (H, W) float32 in [0, 1]. Sensors, states and runs are those of one sequence; `jax.vmap`
makes batches.
"""

import dataclasses
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeGuard, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from firenet_jax.errors import SettingsError
from firenet_jax.events import Events, concatenate
from firenet_jax.settings import check_range, check_refined, check_share, check_sizes
from firenet_jax.simulation.scenes import log_uniform

EPS = 0.001
THRESHOLD, SPREAD, REFRACTORY = 0.18, 0.03, 1e-3  # defaults, as in the paper
LEAST_THRESHOLD = 0.01  # as in ESIM
MOST_NOISE = 10_000  # events per second of a pixel: of more, each takes a rendering
NOISE_IN_LIGHT = 0.25  # times the noise in the dark
TICKS = 1024  # per microsecond
MAX_INTERVAL = 2**31 // TICKS - 1  # microseconds between two renderings
# Lamps on mains of 50 and 60 hertz flicker at 100 and 120, screens from 60 on.
FLICKER_HERTZ = (60.0, 240.0)
REACH = (0.15, 2.0)  # of a lamp, in sides of the picture
FLICKER_INTERVAL = 500  # microseconds between renderings that show it: an eighth of its period

Fault = TypeVar("Fault", float, tuple[float, float])


def _or(said: float | None, default: float) -> float:
    return default if said is None else said


def _on(fault: Fault | None) -> TypeGuard[Fault]:
    return fault is not None and fault not in (0, (0, 0), [0, 0])


@dataclass(frozen=True)
class SensorSettings:
    """The sensor: by default that of the paper, without faults; in `firenet train`, with the faults
    whose defaults are given below. Pairs are (least, greatest), drawn log-uniformly for each
    sequence. A fault is off if it is 0, or if it has no default and --faults does not set it.
    """

    threshold: float | None = None
    """Mean of the contrast thresholds, in log intensity, at least 0.01 (default: 0.18). What is
    drawn below 0.01 is 0.01."""
    threshold_spread: float | None = None
    """Standard deviation of the thresholds; ON and OFF are each drawn once per sequence (default:
    0.03)."""
    threshold_range: tuple[float, float] | None = None
    """Draw the ON threshold log-uniformly from this range instead, and OFF near it."""
    asymmetry: float = 0.1
    """With a threshold range: standard deviation of the OFF threshold, relative to ON. Then ON and
    OFF events do not cancel exactly."""
    refractory: float | None = None
    """Refractory period in seconds (default: 0.001)."""
    refractory_range: tuple[float, float] | None = None
    """Draw the refractory period log-uniformly from this range instead, once per sequence."""
    mismatch: float | None = None
    """Standard deviation of the thresholds between pixels, in log intensity; about 0.03 in real
    sensors."""
    noise: tuple[float, float] | None = None
    """Shot noise: events per second of a pixel in the dark. ON and OFF alternate."""
    noise_in_light: tuple[float, float] | None = None
    """Shot noise in full light, relative to that in the dark; between them it falls exponentially
    (default: linearly, to a quarter)."""
    leak: tuple[float, float] | None = None
    """Leak: ON events per second by which every pixel's reference drifts; about 0.1 in real
    sensors."""
    hot: tuple[float, float] | None = None
    """Share of hot pixels, which fire 10 to 500 events per second, all ON or all OFF."""
    cutoff: tuple[float, float] | None = None
    """Bandwidth of the pixels in hertz: a first-order low-pass filter on log intensity."""
    cutoff_dark: float = 0.1
    """Bandwidth in the dark, relative to full light; 1: independent of light."""
    flicker: tuple[float, float] | None = None
    """Sinusoidal flicker of a lamp or screen at 60 to 240 Hz: its amplitude relative to the mean
    intensity, greatest at a random point of the image. Not set by --faults."""
    clean: float = 0.0
    """Share of the sequences with the paper's thresholds and none of these faults (but in firenet
    train half of them have noise after a stop for good, --halt)."""
    mid_recording: bool = False
    """Start in the middle of a recording: each pixel's reference is anywhere within a threshold of
    the first rendering, instead of equal to it."""

    def __post_init__(self):
        """Raises SettingsError for invalid values."""
        for name in ("threshold_range", "refractory_range", "noise_in_light"):
            if getattr(self, name) is not None:
                check_range(name, getattr(self, name))
        for name in ("noise", "leak", "hot", "cutoff", "flicker"):
            if _on(getattr(self, name)):
                check_range(name, getattr(self, name))
        if _on(self.noise) and self.noise[1] * max((1, *(self.noise_in_light or ()))) > MOST_NOISE:
            raise SettingsError(f"noise of more than {MOST_NOISE:,} events per second of a pixel")
        if _on(self.flicker) and self.flicker[1] > 1:
            raise SettingsError(f"flicker is {self.flicker}, but light is not negative: at most 1")
        check_share("clean", self.clean, "sequences")
        if _on(self.hot) and self.hot[1] > 1:
            raise SettingsError(f"hot is {self.hot}, but is a share of the pixels: at most 1")
        check_sizes(self, "threshold")
        lowest = min(x for x in (self.threshold, *(self.threshold_range or ()), 1) if x is not None)
        if lowest < LEAST_THRESHOLD:
            raise SettingsError(
                f"a threshold of {lowest:g}, but at least {LEAST_THRESHOLD} in log intensity: with "
                "less a pixel fires without end"
            )
        others = "threshold_spread", "asymmetry", "refractory", "mismatch", "cutoff_dark"
        check_sizes(self, *others, zero=True)
        longest = max(self.refractory or 0, *(self.refractory_range or (0, 0)))
        if longest > MAX_INTERVAL * 1e-6:
            raise SettingsError(
                f"a refractory period of {longest:g} s, but at most {MAX_INTERVAL * 1e-6:.1f} s"
            )
        # A range takes precedence, so the other value would silently be ignored.
        fixed = "for a fixed one pass --{}-range VALUE VALUE"
        for name, owner, remedy in (
            ("threshold", "threshold_range", fixed.format("threshold")),
            ("threshold_spread", "threshold_range", "pass --asymmetry"),
            ("refractory", "refractory_range", fixed.format("refractory")),
        ):
            if None not in (getattr(self, owner), getattr(self, name)):
                raise SettingsError(f"{name} has no effect beside {owner}: {remedy}")


FAULTY = SensorSettings(
    refractory_range=(1e-4, 1e-3),
    mismatch=0.03,
    noise=(0.1, 10.0),
    leak=(0.01, 0.5),
    hot=(1e-4, 1e-3),
    cutoff=(100.0, 1000.0),
)
"""All faults except flicker, as strong as in real sensors."""


def with_faults(sensor: SensorSettings) -> SensorSettings:
    """FAULTY, overridden by everything that these settings change from their defaults."""
    plain = vars(SensorSettings())
    chosen = {name: value for name, value in vars(sensor).items() if value != plain[name]}
    if "refractory" in chosen:
        chosen.setdefault("refractory_range", None)
    return dataclasses.replace(FAULTY, **chosen)


def check_idle(sensor: SensorSettings) -> None:
    """Raises SettingsError for what refines a fault that is off, and so has no effect."""
    needs = {"asymmetry": "threshold_range", "noise_in_light": "noise", "cutoff_dark": "cutoff"}
    check_refined(sensor, needs, _on)


class Lamp(NamedTuple):
    """Light that flickers: intensity is multiplied by 1 + swing sin(2 pi cycles)."""

    swing: jax.Array  # (H, W)
    hertz: jax.Array  # ()
    start: jax.Array  # () cycles at the first rendering


class Noise(NamedTuple):
    """Events that nothing in the scene causes (shot noise)."""

    rate: jax.Array  # () events per second and pixel in the dark
    light: jax.Array  # () factor in full light, to which the rate falls linearly
    slope: jax.Array | None  # () of the rate's logarithm over intensity, in place of that
    random: jax.Array  # () bool, whether polarities are random; else they alternate


class Sensor(NamedTuple):
    """The sensor of one sequence. A fault that is off is None and costs nothing."""

    on: jax.Array  # () or (H, W) threshold in log intensity
    off: jax.Array
    refractory: jax.Array | None  # () int32, ticks
    drift: jax.Array | None  # (H, W) apparent rise of L in log intensity per second
    noise: Noise | None
    cutoff: jax.Array | None  # (2,) hertz in full light; factor in the dark
    phase: jax.Array | None  # (H, W) share of the first threshold already crossed where L drifts,
    # and whether noise starts with ON; otherwise all pixels would start with the same event
    start: jax.Array | None  # (H, W) first L, from 0 at OFF's threshold to 1 at ON's
    lamp: Lamp | None
    key: jax.Array  # of the noise


class SensorState(NamedTuple):
    """The state of the pixels between two renderings."""

    log: jax.Array  # (H, W) float32, L after the low-pass
    seen: jax.Array | None  # (H, W) float32, L before it; None where there is none
    above: jax.Array  # (H, W) float32, L above the reference: small, so no rounding adds up
    silent: jax.Array | None  # (H, W) int32, ticks until the refractory period is over
    noise_on: jax.Array | None  # (H, W) bool, whether the next noise event is ON
    cycles: jax.Array | None  # () float32 in [0, 1), where the lamp is in its period
    renderings: jax.Array  # () int32, how many so far; selects the random numbers of the noise


class Run(NamedTuple):
    """Events of each pixel between two renderings: at first, first + spacing, ... (H, W)."""

    first: jax.Array  # int32, ticks after the earlier rendering
    spacing: jax.Array  # int32, ticks
    count: jax.Array  # int32
    polarity: jax.Array  # float32, +1 or -1


# ---- The model


@partial(jax.jit, static_argnames=("height", "width", "settings"))
def random_sensor(
    key: jax.Array, *, height: int, width: int, settings: SensorSettings = SensorSettings()
) -> Sensor:
    """The sensor of a sequence: thresholds and faults, drawn once."""
    shape = height, width
    # Further keys are `fold_in(key, 5)` and so on: those of less than 5 are these.
    number_key, spread_key, mismatch_key, drift_key, noise_key = jax.random.split(key, 5)
    numbers = iter(jax.random.uniform(number_key, (6,)))
    spread = jax.random.normal(spread_key, (2,))

    if settings.threshold_range is None:
        mean, deviation = _or(settings.threshold, THRESHOLD), _or(settings.threshold_spread, SPREAD)
        on, off = mean + deviation * spread
    else:
        on = log_uniform(settings.threshold_range, next(numbers))
        off = on * (1 + settings.asymmetry * spread[0])
    if _on(settings.mismatch):
        own = settings.mismatch * jax.random.normal(mismatch_key, (2, *shape))
        on, off = on + own[0], off + own[1]
    on, off = (jnp.maximum(threshold, LEAST_THRESHOLD) for threshold in (on, off))

    drift = phase = None
    if _on(settings.leak) or _on(settings.hot) or _on(settings.noise):
        chance, sign, rate, phase = jax.random.uniform(drift_key, (4, *shape))
    if _on(settings.leak) or _on(settings.hot):
        drift = jnp.zeros(shape)
        if _on(settings.leak):
            drift += on * log_uniform(settings.leak, next(numbers))
        if _on(settings.hot):
            rate = 10.0 * 50.0**rate * jnp.where(sign < 0.5, on, -off)
            share = log_uniform(settings.hot, next(numbers))
            drift = jnp.where(chance < share, rate, drift)
    start = None
    if settings.mid_recording:
        start = jax.random.uniform(jax.random.fold_in(key, 5), shape)
    if settings.refractory_range is not None:
        refractory = log_uniform(settings.refractory_range, next(numbers))
    else:
        refractory = jnp.float32(_or(settings.refractory, REFRACTORY))
    silenced = settings.refractory_range is not None or settings.refractory != 0
    noise = cutoff = None
    if _on(settings.noise):
        slope = None
        if settings.noise_in_light is not None:
            low, high = map(math.log, settings.noise_in_light)
            slope = jax.random.uniform(jax.random.fold_in(key, 8), minval=low, maxval=high)
        rate = log_uniform(settings.noise, next(numbers))
        noise = Noise(rate, jnp.float32(NOISE_IN_LIGHT), slope, jnp.bool_(False))
    if _on(settings.cutoff):
        cutoff = jnp.stack([log_uniform(settings.cutoff, next(numbers)), settings.cutoff_dark])
    refractory = jnp.round(refractory * 1e6 * TICKS).astype(jnp.int32) if silenced else None
    lamp = _lamp(jax.random.fold_in(key, 7), shape, settings.flicker)
    sensor = Sensor(on, off, refractory, drift, noise, cutoff, phase, start, lamp, noise_key)
    if not settings.clean:
        return sensor
    clean_key, plain_key = jax.random.split(jax.random.fold_in(key, 6))
    clean = jax.random.uniform(clean_key) < settings.clean
    return _without_faults(sensor, clean, jax.random.normal(plain_key, (2,)))


def _lamp(
    key: jax.Array, shape: tuple[int, int], flicker: tuple[float, float] | None
) -> Lamp | None:
    """Brightest at a random place, whence its swing falls off as a Gaussian."""
    if not _on(flicker):
        return None
    numbers = jax.random.uniform(key, (6,))
    y, x = (jnp.arange(length) / max(shape) for length in shape)
    down, across = (y - numbers[0] * y[-1]) ** 2, (x - numbers[1] * x[-1]) ** 2
    away = (down[:, None] + across[None]) / log_uniform(REACH, numbers[3]) ** 2
    swing = log_uniform(flicker, numbers[2]) * jnp.exp(-away)
    return Lamp(swing, log_uniform(FLICKER_HERTZ, numbers[4]), numbers[5])


def _without_faults(sensor: Sensor, clean: jax.Array, spread: jax.Array) -> Sensor:
    """The paper's sensor if `clean` () is True; spread: (2,) normal numbers."""

    def unless(value, fault):
        return None if fault is None else jnp.where(clean, value, fault)

    on, off = THRESHOLD + SPREAD * spread
    refractory = jnp.int32(round(REFRACTORY * 1e6 * TICKS))
    return sensor._replace(
        on=unless(on, sensor.on),
        off=unless(off, sensor.off),
        refractory=unless(refractory, sensor.refractory),
        drift=unless(0.0, sensor.drift),
        noise=sensor.noise and sensor.noise._replace(rate=unless(0.0, sensor.noise.rate)),
        cutoff=unless(jnp.array([1e9, 1.0]), sensor.cutoff),  # so high that it has no effect
        lamp=sensor.lamp and sensor.lamp._replace(swing=unless(0.0, sensor.lamp.swing)),
    )


def log_intensity(image: jax.Array) -> jax.Array:
    return jnp.log(EPS + image)


def first_state(sensor: Sensor, image: jax.Array) -> SensorState:
    """The first rendering (H, W) sets every pixel's reference."""
    cycles = None if sensor.lamp is None else sensor.lamp.start
    log = log_intensity(_lit(sensor.lamp, cycles, image))
    above = jnp.zeros_like(log)
    if sensor.drift is not None and sensor.phase is not None:
        drifted = jnp.where(sensor.drift > 0, sensor.on, -sensor.off) * sensor.phase
        above = jnp.where(sensor.drift != 0, drifted, above)
    if sensor.start is not None:
        above = sensor.start * (sensor.on + sensor.off) - sensor.off
    silent = None if sensor.refractory is None else jnp.zeros(image.shape, jnp.int32)
    # From a lower bit of the phase, independent of when a pixel leaks.
    noise_on = None
    if sensor.noise is not None and sensor.phase is not None:
        noise_on = sensor.phase * 1024 % 2 < 1
    seen = None if sensor.cutoff is None else log
    return SensorState(log, seen, above, silent, noise_on, cycles, jnp.int32(0))


def _lit(lamp: Lamp | None, cycles: jax.Array | None, image: jax.Array) -> jax.Array:
    """What a rendering (H, W) looks like in the light of this moment."""
    if lamp is None or cycles is None:
        return image
    return image * (1 + lamp.swing * jnp.sin(2 * jnp.pi * cycles))


def step(
    sensor: Sensor, state: SensorState, image: jax.Array, duration: jax.Array
) -> tuple[SensorState, tuple[Run, ...]]:
    """A rendering (H, W), `duration` microseconds (int32) after the last -> (state, its events).

    One run of each pixel's crossings and, with shot noise, a second one of that.
    """
    seconds = 1e-6 * duration.astype(jnp.float32)
    ticks = TICKS * duration  # int32
    cycles = state.cycles
    if sensor.lamp is not None and cycles is not None:
        cycles = (cycles + seconds * sensor.lamp.hertz) % 1
    lit = _lit(sensor.lamp, cycles, image)
    log, seen = log_intensity(lit), None
    rise = log - state.log
    if sensor.cutoff is not None and state.seen is not None:
        seen = log
        rise = _low_pass(sensor.cutoff, state.seen, state.log, lit, seconds)
        log = state.log + rise

    if sensor.drift is not None:
        rise = rise + seconds * sensor.drift  # relative to a sinking reference, L rises

    up = rise > 0
    polarity = jnp.where(up, 1.0, -1.0)
    threshold = jnp.where(up, sensor.on, sensor.off)
    above = state.above + rise
    crossings = jnp.maximum(jnp.floor(polarity * above / threshold), 0.0)
    size = jnp.abs(rise)
    size = jnp.where(size > 0, size, 1.0)  # without a rise, nothing crosses: any finite value
    scale = ticks.astype(jnp.float32) / size
    # The first crossing, from the interval's start; rounding may put it a little outside. The
    # spacing is rounded down, so that the last crossing stays inside.
    first = threshold - polarity * state.above
    first = jnp.clip(jnp.round(first * scale), 0.0, ticks.astype(jnp.float32)).astype(jnp.int32)
    spacing = jnp.minimum(threshold * scale, ticks.astype(jnp.float32)).astype(jnp.int32)
    count = crossings.astype(jnp.int32)
    above = above - polarity * threshold * crossings
    run = Run(first, spacing, count, polarity)
    silent = None
    if sensor.refractory is not None and state.silent is not None:
        run, silent = _refractory(run, state.silent, sensor.refractory, ticks)

    runs, noise_on = (run,), state.noise_on
    if sensor.noise is not None and noise_on is not None:
        key = jax.random.fold_in(sensor.key, state.renderings)
        rate, light, slope, drawn = sensor.noise
        share = 1 - (1 - light) * image if slope is None else jnp.exp(slope * image)
        expected = seconds * rate * share
        bits = jax.random.bits(key, image.shape, jnp.uint32)
        # The time of the event uses the upper 24 bits, so the lowest bit is independent of it.
        noise_on = jnp.where(drawn, bits % 2 == 1, noise_on)
        noise = _shot_noise(bits, expected, jnp.where(noise_on, 1.0, -1.0), ticks)
        noise_on = noise_on ^ (noise.count > 0)
        runs += (noise,)
    return SensorState(log, seen, above, silent, noise_on, cycles, state.renderings + 1), runs


def _low_pass(cutoff, seen: jax.Array, log: jax.Array, lit: jax.Array, seconds) -> jax.Array:
    """The rise of a first-order low-pass of L over the interval.

    Exact for an L that is linear between two renderings, so that their number does not matter; only
    the cutoff, which grows with brightness, is taken at the interval's end.
    """
    hertz, dark = cutoff
    a = seconds * 2 * jnp.pi * hertz * (dark + (1 - dark) * lit)
    reached = -jnp.expm1(-a)  # of where L was at the beginning
    # Of what it rises by: an a-th of that in the long run, all of it where nothing gets through.
    lag = jnp.where(a > 0, reached / jnp.where(a > 0, a, 1.0), 1.0)
    return (1 - lag) * (log_intensity(lit) - seen) + reached * (seen - log)


def _refractory(run: Run, silent: jax.Array, refractory: jax.Array, ticks: jax.Array):
    """All crossings -> those that become events, and the silence left at the interval's end.

    Of equally spaced crossings the first one after the silence becomes an event, and then every
    n-th, for the least n whose n spacings cover the refractory period: again equally spaced.
    """
    spacing = jnp.maximum(run.spacing, 1).astype(jnp.float32)
    wait = jnp.maximum(silent - run.first, 0).astype(jnp.float32)
    skipped = jnp.ceil(wait / spacing)
    stride = jnp.maximum(jnp.ceil(refractory.astype(jnp.float32) / spacing), 1.0)
    left = jnp.maximum(run.count.astype(jnp.float32) - skipped, 0.0)
    count = jnp.ceil(left / stride).astype(jnp.int32)
    # Values of non-events may be large: keep them within int32.
    first = jnp.where(count > 0, skipped, 0.0).astype(jnp.int32) * run.spacing + run.first
    spacing = jnp.where(count > 1, stride, 0.0).astype(jnp.int32) * run.spacing
    last = first + (count - 1) * spacing
    silent = jnp.where(count > 0, last + refractory, silent)
    return Run(first, spacing, count, run.polarity), jnp.maximum(silent - ticks, 0)


def _shot_noise(bits: jax.Array, expected: jax.Array, polarity: jax.Array, ticks: jax.Array) -> Run:
    """At most one event per pixel and interval, at any time in it; expected: (H, W) events; bits:
    (H, W) uint32, random.

    By default the rate falls with light as in Hu, Liu and Delbruck, "v2e", CVPRW 2021; that of
    photons falls much more steeply (Cao et al., "Noise2Image", 2024). In v2e noise moves the
    pixel's reference; here it has a reference of its own, because otherwise its polarity would
    depend on the last bits of L, and so on the device. It ignores the refractory period. One random
    number decides everything: if it is below the probability, it is uniform below it.
    """
    # Not 1 - exp(-expected), the probability of at least one event of a Poisson process: with at
    # most one event per interval the rate would be a quarter too low at 0.6.
    chance = jnp.minimum(expected, 1.0)
    number = bits.astype(jnp.float32) * 2.0**-32
    fires = number < chance
    place = jnp.where(fires, number / jnp.where(fires, chance, 1.0), 0.0)
    first = (ticks.astype(jnp.float32) * place).astype(jnp.int32)
    return Run(first, jnp.zeros_like(first), fires.astype(jnp.int32), polarity)


def most_noise(noise: Noise) -> jax.Array:
    """Events per second where there are most, in the dark or in full light."""
    rate, slope = noise.rate, noise.slope
    return rate if slope is None else rate * jnp.exp(jnp.maximum(slope, 0.0))


def stamps(first, spacing, number):
    """Microseconds after the interval's start of a run's number-th event; numpy or JAX, int32."""
    return (first + number * spacing + TICKS // 2) // TICKS


# ---- Event lists


@jax.jit
def _listed(sensor, state, image, duration):
    state, runs = step(sensor, state, image, duration)
    return state, runs, sum(run.count.sum() for run in runs)


def event_list(sensor: Sensor, renderings: Iterable[tuple[int, ArrayLike]]) -> Iterator[Events]:
    """(microseconds, image (H, W)) in time order -> chunks of time-sorted events, one per interval.

    The first rendering gives no events. `scenes.rendering_times` says how dense renderings must be;
    for noise, of which there is at most one event between two, more are put between them.
    Raises SettingsError if time does not advance, or by more than two seconds.
    """
    state, previous = None, 0
    for time, image in _dense(sensor, renderings):
        if state is None:
            state, previous = _first(sensor, image), time
            continue
        duration = time - previous
        if not 0 < duration <= MAX_INTERVAL:
            raise SettingsError(
                f"renderings at {previous} and {time} us: each must come after the last, by at "
                f"most {MAX_INTERVAL} us"
            )
        state, runs, fired = _listed(sensor, state, image, jnp.int32(duration))
        if int(fired):
            yield _events(jax.device_get(runs), previous)
        previous = time


def _dense(
    sensor: Sensor, renderings: Iterable[tuple[int, ArrayLike]]
) -> Iterator[tuple[int, jax.Array]]:
    """More renderings, so that two have at most half an event of a pixel's noise between them; log
    intensity is linear from one of those that are given to the next."""
    rate, last = 0.0, None
    if sensor.noise is not None:
        rate = 2e-6 * float(most_noise(sensor.noise))  # per microsecond
    for time, image in renderings:
        time, image = int(time), jnp.asarray(image, jnp.float32)
        if rate and last is not None:
            before, seen = last
            parts = min(math.ceil(rate * (time - before)), time - before)
            for k in range(1, parts if time - before <= MAX_INTERVAL else 0):
                share = jnp.float32(k / parts)
                yield before + (time - before) * k // parts, _between(seen, image, share)
        last = time, image
        yield last


@jax.jit
def _between(before: jax.Array, after: jax.Array, share: jax.Array) -> jax.Array:
    low, high = log_intensity(before), log_intensity(after)
    return jnp.exp(low + share * (high - low)) - EPS


_first = jax.jit(first_state)


def _events(runs: tuple[Run, ...], start: int) -> Events:
    """Runs on the host -> their events, sorted by time."""
    chunks = []
    for run in runs:
        y, x = np.nonzero(run.count)
        first, spacing, count = run.first[y, x], run.spacing[y, x], run.count[y, x]
        row = np.repeat(np.arange(len(count)), count)
        number = (np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)).astype(np.int32)
        t = stamps(first[row], spacing[row], number)
        on = run.polarity[y, x][row] > 0
        chunks.append(Events.of(start + t.astype(np.int64), x[row], y[row], on))
    events = concatenate(chunks)
    return events.select(np.argsort(events.t, kind="stable"))
