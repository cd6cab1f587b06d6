from dataclasses import replace
from functools import partial
from operator import attrgetter
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

from firenet_jax.errors import SettingsError
from firenet_jax.events import Events, concatenate
from firenet_jax.network import initial_state
from firenet_jax.reconstruction import reconstruct
from firenet_jax.simulation import sensor as module
from firenet_jax.simulation import sequences as sequences_module
from firenet_jax.simulation.curricula import _uneven, random_setups, sequences, window_bounds
from firenet_jax.simulation.scenes import SceneSettings, rendering_times, speeds, video
from firenet_jax.simulation.sensor import (
    EPS,
    FAULTY,
    FLICKER_INTERVAL,
    MAX_INTERVAL,
    TICKS,
    Noise,
    Sensor,
    SensorSettings,
    check_idle,
    event_list,
    first_state,
    random_sensor,
    with_faults,
)
from firenet_jax.simulation.sequences import simulate, to_and_fro
from firenet_jax.simulation.textures import load_textures
from firenet_jax.tensors import pack, voxelise
from firenet_jax.warp import warp

H, W = 12, 14


def plain_sensor(on=0.2, off=0.17, refractory=0.0):
    """Every fault off; thresholds may be arrays (H, W)."""
    return Sensor(
        on=jnp.asarray(on, jnp.float32),
        off=jnp.asarray(off, jnp.float32),
        refractory=jnp.int32(refractory * 1e6 * 1024) if refractory else None,
        drift=None,
        noise=None,
        cutoff=None,
        phase=None,
        start=None,
        lamp=None,
        key=jax.random.key(0),
    )


def shot_noise(rate, light, random=False):
    return Noise(jnp.float32(rate), jnp.float32(light), None, jnp.bool_(random))


def listed(sensor, times, logs):
    """Log intensities (n, H, W), float64 -> all events."""
    images = (np.exp(logs) - EPS).astype(np.float32)
    chunks = list(event_list(sensor, zip(times, images, strict=True)))
    return concatenate(chunks) if chunks else Events.empty()


def random_logs(seed, times):
    """A few waves of each pixel between log(0.001) and log(1.001), (n, H, W)."""
    rng = np.random.default_rng(seed)
    wave = rng.uniform(10, 150, (H, W, 3))
    phase, size = rng.uniform(0, 6, (H, W, 3)), rng.uniform(0, 1, (H, W, 3))
    seconds = 1e-6 * np.asarray(times)[:, None, None, None]
    logs = -3.0 + (size * np.sin(wave * seconds + phase)).sum(-1)
    return np.clip(logs, np.log(1.1 * EPS), 0.0)


def esim_pixel(times, logs, on, off, refractory=0.0):
    """ESIM as it stands, one crossing after the other: [(time, p)], float64 microseconds."""
    reference, last, events = logs[0], -np.inf, []
    for k in range(1, len(times)):
        before, after, start = logs[k - 1], logs[k], times[k - 1]
        p, threshold = (1, on) if after > before else (-1, off)
        while p * (after - reference) >= threshold:
            reference += p * threshold
            t = start + (reference - before) / (after - before) * (times[k] - start)
            if t - last >= refractory:
                events.append((t, p))
                last = t
    return events


def at_pixel(events, y, x):
    here = (events.y == y) & (events.x == x)
    return events.t[here], np.where(events.p[here], 1, -1)


# ---- Event lists


@pytest.mark.parametrize("refractory", [0.0, 1e-3, 7e-3])
def test_equals_the_loop_over_single_crossings(refractory):
    """Every event of every pixel, to the microsecond; the intervals are of any length."""
    rng = np.random.default_rng(1)
    times = np.cumsum(rng.integers(1, 9000, 60))
    logs = random_logs(2, times)
    images = (np.exp(logs) - EPS).astype(np.float32)
    events = listed(plain_sensor(refractory=refractory), times, logs)
    assert np.all(np.diff(events.t) >= 0) and len(events) > 2000
    on, off = float(np.float32(0.2)), float(np.float32(0.17))
    seen = np.log(EPS + images.astype(np.float64))
    total = 0
    for y in range(H):
        for x in range(W):
            expected = esim_pixel(times, seen[:, y, x], on, off, 1e6 * refractory)
            t, p = at_pixel(events, y, x)
            assert p.tolist() == [p for _, p in expected]
            np.testing.assert_allclose(t, [t for t, _ in expected], atol=1.01)
            total += len(expected)
    assert total == len(events)


def crossings(log, turns, end, on, off):
    """Analytic crossings of log(t) between its turning points, in seconds."""
    reference, events = log(0.0), []
    for start, stop in zip([0.0, *turns], [*turns, end], strict=True):
        p, threshold = (1, on) if log(stop) > log(start) else (-1, off)
        while p * (log(stop) - reference) >= threshold:
            reference += p * threshold
            level = reference
            events.append((brentq(lambda t, level=level: log(t) - level, start, stop), p))
    return events


def test_times_are_those_of_the_analytic_crossings():
    """Linear and sinusoidal log intensity, rendered every 0.1 ms: counts exact, times to 1 us.

    Between two renderings L is taken as linear, off by at most h^2 / 8 max|L''|. At a tenth of
    the greatest slope of a sinusoid of 4 Hz that is 0.3 us; rounding adds half a microsecond.
    """
    end, thresholds = 0.4, [(0.18, 0.18), (0.11, 0.23), (0.35, 0.15), (0.05, 0.061)]
    times = np.arange(0, round(1e6 * end) + 1, 100)
    shapes = []
    for slope in (3.1, -4.3, 11.3, -0.93):
        start = -6.0 if slope > 0 else -1.0
        shapes.append((lambda t, a=start, b=slope: a + b * t, [], lambda t, b=slope: np.abs(b)))
    for size, hertz, phase in [(1.5, 4.0, 0.3), (0.7, 3.1, 2.0), (2.4, 1.7, 4.0), (1.0, 4.0, 1.0)]:
        w = 2 * np.pi * hertz
        turns = [(np.pi / 2 + k * np.pi - phase) / w for k in range(-2, 20)]
        shapes.append(
            (
                lambda t, a=size, w=w, f=phase: -2.8 + a * np.sin(w * t + f),
                [t for t in turns if 0 < t < end],
                lambda t, a=size, w=w, f=phase: np.abs(a * w * np.cos(w * t + f)) / (a * w),
            )
        )
    logs = np.stack([shape(1e-6 * times) for shape, _, _ in shapes], -1)  # (n, shapes)
    logs = np.broadcast_to(logs[:, None], (len(times), len(thresholds), len(shapes)))
    on, off = np.array(thresholds).T
    wide = np.ones((1, len(shapes)))
    events = listed(plain_sensor(on[:, None] * wide, off[:, None] * wide), times, logs)
    checked = 0
    for y in range(len(thresholds)):
        for x, (shape, turns, slope) in enumerate(shapes):
            on, off = (float(np.float32(c)) for c in thresholds[y])
            expected = crossings(shape, turns, end, on, off)
            t, p = at_pixel(events, y, x)
            assert p.tolist() == [p for _, p in expected], (y, x)
            exact = np.array([t for t, _ in expected])
            steep = slope(exact) * np.ones(len(exact)) >= 0.1
            error = np.abs(t - 1e6 * exact)[steep]
            assert error.max() <= 1.0, (y, x, error.max())
            checked += steep.sum()
    assert checked > 500


def test_thresholds_summed_lead_from_the_first_log_intensity_to_the_last():
    times = np.arange(0, 300_000, 2000)
    logs = random_logs(3, times)
    events = listed(plain_sensor(), times, logs)
    level = logs[0].copy()
    np.add.at(level, (events.y, events.x), np.where(events.p, 0.2, -0.17))
    error = logs[-1] - level
    assert error.max() < 0.2 + 1e-4 and error.min() > -0.17 - 1e-4


def test_the_refractory_period_separates_events_and_moves_the_reference_all_the_same():
    """A jump of 20 thresholds within 10 ms, then stillness, then back down slowly."""
    times = np.array([0, 10_000, 60_000, 160_000])
    levels = np.array([-5.0, -5.0 + 20.5 * 0.2, -5.0 + 20.5 * 0.2, -5.0])
    logs = np.broadcast_to(levels[:, None, None], (4, 1, 1))
    events = listed(plain_sensor(refractory=1e-3), times, logs)
    assert np.diff(events.t).min() >= 999
    rising = events.t[events.p]
    # a crossing every 488 us: every third is 1 ms or more after the last one
    assert len(rising) == 7 and set(np.diff(rising)) <= {1463, 1464}
    # from 20 thresholds above: falls 4.1, of which the last of 0.17 is the 23rd
    assert (~events.p).sum() == 23


def test_events_of_an_interval_lie_in_it_and_all_are_sorted():
    times = np.arange(500, 9000, 13)
    images = (np.exp(random_logs(4, times)) - EPS).astype(np.float32)
    chunks = list(event_list(plain_sensor(0.01, 0.01), zip(times, images, strict=True)))
    for chunk in chunks:
        start = times[np.searchsorted(times, chunk.t[0], "right") - 1]
        assert chunk.t[-1] <= start + 13
    events = concatenate(chunks)
    assert len(events) > 5000 and events.t.dtype == np.int64 and np.diff(events.t).min() == 0


def test_times_that_do_not_advance_are_refused():
    image = np.full((2, 2), 0.5, np.float32)
    for second in (5, 4, 6 + MAX_INTERVAL):
        with pytest.raises(ValueError, match="renderings at 5"):
            list(event_list(plain_sensor(), [(5, image), (second, image)]))


def test_an_interval_may_be_as_long_as_its_ticks_can_be_counted():
    """Two seconds: a steady rise over 20.5 thresholds, whose last stamp is near the end."""
    assert TICKS * MAX_INTERVAL + TICKS // 2 < 2**31 <= TICKS * (MAX_INTERVAL + 1)
    levels = np.broadcast_to(np.array([-5.0, -5.0 + 20.5 * 0.2])[:, None, None], (2, 1, 1))
    events = listed(plain_sensor(), [7, 7 + MAX_INTERVAL], levels)
    expected = 7 + np.arange(1, 21) / 20.5 * MAX_INTERVAL
    np.testing.assert_allclose(events.t, expected, atol=3)


def test_an_interval_may_be_as_short_as_a_microsecond():
    image = np.full((2, 2), 0.1, np.float32)
    (events,) = event_list(plain_sensor(), [(5, image), (6, 1.3 * image)])
    assert len(events) == 4 and set(events.t) <= {5, 6}


def test_stamps_are_rounded_to_the_nearest_microsecond():
    ticks = np.arange(5000)
    expected = np.floor(ticks / 1024 + 0.5)
    np.testing.assert_array_equal(module.stamps(ticks, 0, 3), expected)
    np.testing.assert_array_equal(module.stamps(ticks - 3 * 700, 700, 3), expected)


def test_large_times_lose_no_microsecond():
    """Two days into a recording the stamps are those of its beginning."""
    times = np.arange(0, 100_000, 1000)
    logs, later = random_logs(5, times), 2 * 86400 * 10**6
    early, late = (listed(plain_sensor(), start + times, logs) for start in (0, later))
    np.testing.assert_array_equal(late.t - later, early.t)
    np.testing.assert_array_equal(late.p, early.p)


# ---- Sensors and their faults


# Every fault there is, but none to be seen: one compiled program for the tests below.
QUIET = SensorSettings(
    mismatch=1e-9, noise=(1e-9, 1e-9), leak=(1e-9, 1e-9), hot=(1e-9, 1e-9), cutoff=(1e6, 1e6)
)


def with_only(seed, **faults):
    return random_sensor(jax.random.key(seed), height=H, width=W, settings=replace(QUIET, **faults))


def still(seconds, step=10_000):
    times = np.arange(0, round(1e6 * seconds) + 1, step)
    return times, np.full((len(times), H, W), -1.0)


def test_thresholds_are_drawn_as_the_paper_says():
    sensors = jax.vmap(lambda key: random_sensor(key, height=2, width=2))(
        jax.random.split(jax.random.key(0), 2000)
    )
    for drawn in (np.asarray(sensors.on), np.asarray(sensors.off)):
        assert drawn.shape == (2000,)
        assert abs(drawn.mean() - 0.18) < 0.003 and abs(drawn.std() - 0.03) < 0.002
    assert abs(np.corrcoef(sensors.on, sensors.off)[0, 1]) < 0.1
    assert sensors.drift is None and sensors.noise is None and sensors.cutoff is None


def test_what_is_drawn_of_a_sensor_is_independent():
    settings = SensorSettings(mid_recording=True, flicker=(0.1, 0.9))
    draw = jax.vmap(lambda key: random_sensor(key, height=2, width=4, settings=settings))
    sensors = draw(jax.random.split(jax.random.key(0), 400))
    start = np.asarray(sensors.start).reshape(400, -1).T
    drawn = np.corrcoef([sensors.on, sensors.off, *start])
    assert np.abs(drawn - np.eye(len(drawn))).max() < 0.25


@pytest.mark.parametrize("asymmetry", [0.1, 0.25])
def test_wide_thresholds_and_mismatch(asymmetry):
    settings = SensorSettings(threshold_range=(0.1, 1.7), asymmetry=asymmetry)
    draw = jax.vmap(lambda key: random_sensor(key, height=2, width=2, settings=settings))
    sensors = draw(jax.random.split(jax.random.key(1), 500))
    assert 0.1 <= sensors.on.min() < 0.12 and 1.5 < sensors.on.max() <= 1.7
    assert abs(np.std(sensors.off / sensors.on) - asymmetry) < 0.2 * asymmetry
    own = random_sensor(
        jax.random.key(2), height=80, width=90, settings=SensorSettings(mismatch=0.03)
    )
    assert own.on.shape == own.off.shape == (80, 90)
    assert abs(np.std(own.on) - 0.03) < 0.001 and own.on.min() >= 0.01
    assert abs(np.corrcoef(own.on.ravel(), own.off.ravel())[0, 1]) < 0.05


def test_in_the_middle_of_a_recording_references_are_anywhere_within_a_threshold():
    settings = SensorSettings(threshold_range=(0.2, 0.2), asymmetry=0.2, mid_recording=True)
    sensor = random_sensor(jax.random.key(4), height=80, width=90, settings=settings)
    state = module.first_state(sensor, jnp.full((80, 90), 0.5))
    above, on, off = np.asarray(state.above), float(sensor.on), float(sensor.off)
    assert -off <= above.min() < 0.98 * -off and 0.98 * on < above.max() <= on
    # so a rise of log intensity by part of a threshold fires that part of the thresholds' sum
    brighter = jnp.exp(jnp.log(0.501) + 0.5 * on) - 0.001
    _, (run,) = module.step(sensor, state, jnp.full((80, 90), brighter), jnp.int32(1000))
    assert float(run.count.mean()) == pytest.approx(0.5 * on / (on + off), abs=0.02)


def test_faults_are_switched_on_but_what_is_given_stays():
    chosen = with_faults(SensorSettings(mismatch=0.01, threshold=0.3))
    assert (chosen.mismatch, chosen.threshold) == (0.01, 0.3)
    assert (chosen.noise, chosen.leak, chosen.hot) == (FAULTY.noise, FAULTY.leak, FAULTY.hot)
    chosen = with_faults(SensorSettings(mismatch=0.0, noise=(0.0, 0.0), refractory=5e-3))
    sensor = random_sensor(jax.random.key(0), height=2, width=3, settings=chosen)
    assert sensor.noise is None and sensor.on.shape == () and sensor.drift is not None
    assert sensor.refractory == 5_000 * TICKS
    # also where it is what stands there if nothing is said
    sensor = random_sensor(jax.random.key(1), height=2, width=3,
                           settings=with_faults(SensorSettings(refractory=1e-3)))  # fmt: skip
    assert sensor.refractory == 1_000 * TICKS


@pytest.mark.parametrize(
    "choice, message",
    [
        ({"noise": (0.0, 10.0)}, "noise is 0 10, but is drawn log-uniformly"),
        ({"noise_in_light": (0.0, 1.0)}, "noise_in_light is 0 1, but is drawn log-uniformly"),
        ({"leak": (0.5, 0.1)}, "the least first"), ({"hot": (0.5, 5.0)}, "share of the pixels"),
        ({"cutoff": (1.0, np.nan)}, "cutoff"), ({"threshold_range": (0.0, 1.0)}, "threshold_range"),
        ({"flicker": (0.5, 1.5)}, "light is not negative"),
        ({"flicker": (0.0, 0.5)}, "flicker is 0 0.5"),
        ({"noise": (1.0, 20_000.0)}, "noise of more than 10,000 events per second"),
        ({"threshold": 0.005}, "a threshold of 0.005, but at least 0.01"),
        ({"threshold_range": (0.001, 0.2)}, "a threshold of 0.001, but at least 0.01"),
        ({"threshold": -1.0}, "threshold is -1"), ({"refractory": -1.0}, "refractory is -1"),
        ({"mismatch": np.nan}, "mismatch"),
        ({"threshold": 0.3, "threshold_range": (0.1, 0.6)}, "--threshold-range VALUE VALUE"),
        ({"threshold": 0.18, "threshold_range": (0.1, 0.6)}, "--threshold-range VALUE VALUE"),
        ({"refractory": 5e-3, "refractory_range": (1e-4, 1e-3)}, "--refractory-range VALUE VALUE"),
    ],
)  # fmt: skip
def test_impossible_sensors(choice, message):
    with pytest.raises(ValueError, match=message):
        SensorSettings(**choice)


@pytest.mark.parametrize(
    "choice",
    [{"hot": (0.5, 1.0)}, {"flicker": (0.5, 1.0)}, {"clean": 1.0}, {"clean": 0.0},
     {"refractory": MAX_INTERVAL * 1e-6}, {"refractory_range": (1e-3, MAX_INTERVAL * 1e-6)},
     {"refractory": 0.0}, {"mismatch": 0.0}, {"cutoff_dark": 0.0}, {"asymmetry": 0.0},
     {"threshold_spread": 0.0}, {"noise": (2.0, 2.0)}, {"noise": [0, 0], "leak": (0.0, 0.0)},
     {"hot": 0, "cutoff": 0, "flicker": 0}, {"threshold_range": (0.1, 0.2), "asymmetry": 0.3}],
)  # fmt: skip
def test_sensors_at_the_edge_of_what_can_be(choice):
    assert replace(SensorSettings(), **choice) == SensorSettings(**choice)


@pytest.mark.parametrize(
    "choice, message",
    [
        ({"refractory": MAX_INTERVAL * 1.1e-6}, "at most 2.1 s"),
        ({"refractory_range": (1e-3, MAX_INTERVAL * 1.1e-6)}, "at most 2.1 s"),
        ({"clean": -0.1}, "clean is -0.1"), ({"clean": 1.1}, "clean is 1.1"),
        ({"threshold": 0.0}, "threshold is 0"), ({"cutoff_dark": -0.1}, "cutoff_dark is"),
        ({"hot": (0.5, 1.01)}, "share of the pixels"), ({"flicker": (0.5, 1.01)}, "at most 1"),
        ({"threshold_spread": 0.1, "threshold_range": (0.1, 0.6)}, "pass --asymmetry"),
    ],
)  # fmt: skip
def test_sensors_beyond_the_edge(choice, message):
    with pytest.raises(ValueError, match=message):
        SensorSettings(**choice)


@pytest.mark.parametrize("change", ["clean", "uneven"])
def test_mid_recording_begins_within_whatever_thresholds_a_sensor_ends_up_with(change):
    """Of a still scene there is no event, also where thresholds are replaced later."""
    clean = 1.0 if change == "clean" else 0.0
    drawn = SensorSettings(
        threshold_range=(0.5, 0.6), mismatch=0.03, mid_recording=True, clean=clean
    )
    sensor = random_sensor(jax.random.key(0), height=30, width=40, settings=drawn)
    if change == "uneven":
        batch = jax.tree.map(lambda leaf: leaf[None], sensor)
        uneven = _uneven(batch, jnp.zeros(1), jnp.ones(1, bool), 1.0)
        sensor = jax.tree.map(lambda leaf: leaf[0], uneven)
    seen = first_state(sensor, jnp.full((30, 40), 0.5))
    on, off = (np.broadcast_to(each, (30, 40)) for each in (sensor.on, sensor.off))
    assert (seen.above <= on).all() and (seen.above >= -off).all()
    assert 0.2 < ((seen.above + off) / (on + off)).std() < 0.35  # uniform: 0.29


@pytest.mark.parametrize(
    "more, fault",
    [({"asymmetry": 0.3}, {"threshold_range": (0.1, 0.6)}),
     ({"noise_in_light": (0.1, 0.1)}, {"noise": (1.0, 2.0)}),
     ({"cutoff_dark": 0.2}, {"cutoff": (100.0, 200.0)})],
)  # fmt: skip
def test_more_of_a_fault_that_is_off_is_refused(more, fault):
    said, option = (next(iter(each)).replace("_", "-") for each in (more, fault))
    for settings in (SensorSettings(**more, **fault), SensorSettings(**fault), FAULTY):
        check_idle(settings)
    check_idle(SensorSettings())
    with pytest.raises(SettingsError, match=f"--{said} has no effect without --{option}"):
        check_idle(SensorSettings(**more))


def test_the_sensor_if_nothing_is_said():
    """As `--help` says of it; and with all faults, as strong as in real sensors."""
    plain = SensorSettings()
    assert (EPS, TICKS) == (0.001, 1024)
    assert 1e6 / 240 / FLICKER_INTERVAL == pytest.approx(25 / 3)  # of the fastest lamp's period
    assert (plain.asymmetry, plain.cutoff_dark, plain.clean) == (0.1, 0.1, 0.0)
    assert plain.mid_recording is False and len({plain, SensorSettings(), FAULTY}) == 2
    sensor = random_sensor(jax.random.key(0), height=2, width=3)
    assert sensor.refractory == 1000 * TICKS and sensor.start is sensor.lamp is None
    bare = random_sensor(
        jax.random.key(0), height=2, width=3, settings=replace(plain, refractory=0.0)
    )
    assert bare.refractory is None and bare.on == sensor.on
    assert with_faults(plain) == FAULTY
    ranges = FAULTY.refractory_range, FAULTY.noise, FAULTY.leak, FAULTY.hot, FAULTY.cutoff
    assert ranges == ((1e-4, 1e-3), (0.1, 10.0), (0.01, 0.5), (1e-4, 1e-3), (100.0, 1000.0))
    assert FAULTY.mismatch == 0.03 and FAULTY.flicker is None


@pytest.fixture(scope="module")
def drawn():
    """2000 small sensors with every fault."""
    settings = SensorSettings(
        threshold_range=(0.1, 0.4), asymmetry=0.2, refractory_range=(1e-4, 1e-2),
        noise=(0.1, 10.0), noise_in_light=(0.01, 0.5), leak=(0.01, 0.5), cutoff=(100.0, 1000.0),
        flicker=(0.05, 0.9),
    )  # fmt: skip
    draw = partial(random_sensor, height=2, width=3, settings=settings)
    return jax.device_get(jax.jit(jax.vmap(draw))(jax.random.split(jax.random.key(0), 2000)))


def numbers_of(drawn):
    """What is drawn once for each sensor, in logarithms, and where it lies."""
    lamp, log = drawn.lamp, np.log
    # -((y - row)^2 + (x - column)^2) / reach^2, where y is 0 and 1/3, and x 0, 1/3 and 2/3
    swing = log(np.float64(lamp.swing))
    reach = np.sqrt(-2 / 9 / np.diff(swing, 2, axis=2)[:, 0, 0])
    down, across = swing[:, 1, 0] - swing[:, 0, 0], swing[:, 0, 2] - swing[:, 0, 0]
    row, column = (down * reach**2 + 1 / 9) * 3 / 2, (across * reach**2 + 4 / 9) * 3 / 4
    peak = swing[:, 0, 0] + (row**2 + column**2) / reach**2
    return {
        "on": (log(drawn.on), log(0.1), log(0.4)),
        "refractory": (log(drawn.refractory / (1e6 * TICKS)), log(1e-4), log(1e-2)),
        "noise": (log(drawn.noise.rate), log(0.1), log(10.0)),
        "light": (drawn.noise.slope, log(0.01), log(0.5)),
        "leak": (log(drawn.drift[:, 0, 0] / drawn.on), log(0.01), log(0.5)),
        "cutoff": (log(drawn.cutoff[:, 0]), log(100.0), log(1000.0)),
        "hertz": (log(lamp.hertz), log(60.0), log(240.0)),
        "start": (lamp.start, 0.0, 1.0),
        "reach": (log(reach), log(0.15), log(2.0)),
        "swing": (peak, log(0.05), log(0.9)),
        "row": (row, 0.0, 1 / 3),
        "column": (column, 0.0, 2 / 3),
    }


def test_what_is_drawn_fills_its_range_and_nothing_goes_along_with_another(drawn):
    numbers = numbers_of(drawn)
    for name, (values, least, greatest) in numbers.items():
        share = (values - least) / (greatest - least)
        assert -0.01 < share.min() < 0.02 and 0.98 < share.max() < 1.01, name
        assert abs(share.mean() - 0.5) < 0.04, name
    correlations = np.corrcoef([values for values, _, _ in numbers.values()])
    assert np.abs(correlations - np.eye(len(numbers))).max() < 0.1


def test_hot_pixels_fire_at_ten_to_five_hundred_hertz_on_or_off():
    settings = SensorSettings(threshold_range=(0.2, 0.2), asymmetry=0.5, hot=(0.3, 0.3))
    sensor = random_sensor(jax.random.key(1), height=100, width=100, settings=settings)
    drift, hot = np.asarray(sensor.drift), np.asarray(sensor.drift != 0)
    assert abs(hot.mean() - 0.3) < 0.02 and abs((drift[hot] > 0).mean() - 0.5) < 0.05
    rates = np.where(drift > 0, drift / sensor.on, -drift / sensor.off)[hot]
    assert 10 <= rates.min() < 10.2 and 490 < rates.max() <= 500.01
    assert abs(np.log(rates).mean() - np.log(10 * 500) / 2) < 0.1
    assert module.first_state(sensor, jnp.ones((100, 100))).noise_on is None  # costs nothing


def test_drifting_pixels_begin_anywhere_and_half_of_all_with_a_noise_event_on():
    """Where L rises they are above the reference, where it sinks below, and the others on it."""
    shape, phase = (200, 200), jax.random.uniform(jax.random.key(2), (200, 200))
    drift = jnp.broadcast_to(jnp.array([1.0, -1.0, 0.0, 2.0])[None].repeat(50, 1), shape)
    sensor = plain_sensor()._replace(drift=drift, phase=phase, noise=shot_noise(1.0, 0.25))
    state = module.first_state(sensor, jnp.full(shape, 0.5))
    expected = np.select([drift > 0, drift < 0], [0.2 * phase, -0.17 * phase], 0)
    np.testing.assert_allclose(state.above, expected, atol=1e-6)
    on = np.asarray(state.noise_on, float)
    assert abs(on.mean() - 0.5) < 0.02
    assert abs(np.corrcoef(on.ravel(), np.asarray(phase).ravel())[0, 1]) < 0.02


def test_a_still_scene_is_silent_without_faults():
    assert len(listed(plain_sensor(), *still(1.0))) == 0


def test_leaks_are_on_events_at_their_rate_and_not_all_at_once():
    events = listed(with_only(3, leak=(2.0, 2.0)), *still(5.0))
    assert events.p.all() and len(events) == pytest.approx(5 * 2 * H * W, rel=0.02)
    counts = np.histogram(events.t, 20)[0]
    assert counts.max() < 1.6 * counts.mean()


def noisy_sensor(rate, on=0.2, off=0.17):
    phase = jax.random.uniform(jax.random.key(1), (H, W))
    return plain_sensor(on, off)._replace(noise=shot_noise(rate, 0.25), phase=phase)


def test_shot_noise_has_its_rate_and_no_order():
    """0.6 events an interval: a Poisson process' chance of one or more would be 0.45."""
    ticks, polarity = jnp.int32(1000 * TICKS), jnp.ones(20_000)
    for expected in (0.0, 0.03, 0.6, 1.3):
        bits = jax.random.bits(jax.random.key(2), polarity.shape)
        run = module._shot_noise(bits, expected * polarity, polarity, ticks)
        fired = np.asarray(run.count)
        assert abs(fired.mean() - min(expected, 1)) <= 4 * np.sqrt(expected / len(fired))
        place = np.asarray(run.first)[fired > 0] / (1000 * TICKS)
        spread = np.histogram(place, 5, (0, 1))[0]  # histogram leaves out what is outside
        assert spread.sum() == fired.sum() and spread.std() <= 0.1 * spread.mean()


@pytest.mark.parametrize(
    "noise_in_light, light, rate", [(None, 0.0, 20.0), ((5.0, 5.0), 1.0, 100.0)]
)
def test_shot_noise_has_its_rate_however_far_apart_renderings_are(noise_in_light, light, rate):
    """Half a second: ten events of a pixel between two, or fifty in full light."""
    sensor = with_only(4, noise=(20.0, 20.0), noise_in_light=noise_in_light)
    times = np.arange(0, 2_000_001, 500_000)
    images = np.full((len(times), H, W), light, np.float32)
    events = concatenate(list(event_list(sensor, zip(times, images, strict=True))))
    expected = 2 * rate * H * W
    assert abs(len(events) - expected) < 4 * np.sqrt(expected)
    assert (np.diff(events.t) >= 0).all() and events.t[-1] <= 2_000_000


def test_renderings_between_are_on_the_line_of_log_intensity():
    """So events that are no noise stay as they are without it, to two microseconds."""
    rng = np.random.default_rng(3)
    images = rng.uniform(0.1, 1, (3, H, W)).astype(np.float32)
    times = np.array([0, 400_000, 800_000])
    noisy = noisy_sensor(0.0)._replace(noise=shot_noise(20.0, 0.25))
    dense = list(module._dense(noisy, zip(times, images, strict=True)))
    assert len(dense) == 1 + 2 * 16 and [t for t, _ in dense[::16]] == times.tolist()
    logs = np.log(EPS + np.stack([image for _, image in dense]))
    expected = np.stack([np.interp(np.arange(33), (0, 16, 32), each) for each in
                         np.log(EPS + images).reshape(3, -1).T], 1).reshape(33, H, W)  # fmt: skip
    np.testing.assert_allclose(logs, expected, atol=1e-5)
    silent = plain_sensor(0.2, 0.17)
    few, many = (
        concatenate(list(event_list(silent, each)))
        for each in (zip(times, images, strict=True), dense)
    )
    assert len(few) == len(many) > 900
    order = [np.lexsort((each.t, each.x, each.y)) for each in (few, many)]
    few, many = (each.select(index) for each, index in zip((few, many), order, strict=True))
    np.testing.assert_array_equal(few.p, many.p)
    assert np.abs(few.t - many.t).max() <= 2


@pytest.mark.parametrize(
    "noise_in_light, rates",
    [(None, (60.0, 37.5, 15.0)), ((0.25, 0.25), (60.0, 30.0, 15.0)), ((1.0, 1.0), (60.0,) * 3)],
)
def test_shot_noise_falls_with_light(noise_in_light, rates):
    """Linearly to a quarter, or exponentially to what is said."""
    sensor = with_only(4, noise=(60.0, 60.0), noise_in_light=noise_in_light)
    for light, rate in zip((0.0, 0.5, 1.0), rates, strict=True):
        times = np.arange(0, 500_001, 10_000)
        images = np.full((len(times), H, W), light, np.float32)
        chunks = event_list(sensor, zip(times, images, strict=True))
        expected = 0.5 * rate * H * W
        assert abs(sum(map(len, chunks)) - expected) < 4 * np.sqrt(expected)


def test_noise_in_light_is_drawn_from_its_range():
    settings = replace(FAULTY, noise_in_light=(0.01, 0.5))
    draw = partial(module.random_sensor, height=4, width=4, settings=settings)
    sensors = jax.vmap(draw)(jax.random.split(jax.random.key(3), 400))
    logs, rates = np.asarray(sensors.noise.slope), np.asarray(sensors.noise.rate)
    assert logs.min() >= np.log(0.0099) and logs.max() <= np.log(0.501)
    assert abs(logs.mean() - np.log(0.01 * 0.5) / 2) < 0.2
    assert abs(np.corrcoef(logs, np.log(rates))[0, 1]) < 0.2  # of each other's number


def test_shot_noise_alternates_and_leaves_the_other_events_as_they_are():
    """So it never adds up; half of the pixels begin with ON. ON and OFF are where they belong."""
    times = np.arange(0, 2_000_001, 10_000)
    events = listed(noisy_sensor(20.0), times, np.full((len(times), H, W), -2.0))
    assert np.all(np.diff(events.t) >= 0) and len(events) > 4000
    signs = [at_pixel(events, y, x)[1] for y in range(H) for x in range(W)]
    assert all((np.diff(p) != 0).all() for p in signs)
    assert abs(np.mean([p[0] > 0 for p in signs]) - 0.5) < 4 * 0.5 / np.sqrt(len(signs))
    logs = random_logs(7, times)
    clean, noisy = (listed(sensor, times, logs) for sensor in (plain_sensor(), noisy_sensor(20.0)))
    rows = [set(zip(e.t, e.x, e.y, e.p, strict=True)) for e in (clean, noisy)]
    assert rows[0] <= rows[1] and len(noisy) - len(clean) > 3000


def test_hot_pixels_are_few_and_fire_all_the_time():
    events = listed(with_only(5, hot=(0.2, 0.2)), *still(1.0))
    counts = np.bincount(events.y.astype(int) * W + events.x, minlength=H * W)
    assert 20 <= (counts > 0).sum() <= 47  # 34 expected, standard deviation 5
    rates = counts[counts > 0]
    assert rates.min() >= 9 and rates.max() <= 501
    assert 0.1 < events.p.mean() < 0.9


def test_bandwidth_lets_slow_changes_pass_and_holds_fast_ones_back():
    """A first-order low-pass of 100 Hz: a step's crossings come late, by its exponential."""
    times = np.arange(0, 20_000, 20)
    logs = np.broadcast_to(np.where(times > 0, -1.0, -3.0)[:, None, None], (1000, H, W))
    sensor = with_only(6, cutoff=(100.0, 100.0), cutoff_dark=1.0, refractory=1e-6)
    t, _ = at_pixel(listed(sensor, times, logs), 0, 0)
    k, tau = np.arange(1, len(t) + 1) - float(sensor.phase[0, 0]), 1e6 / (2 * np.pi * 100)
    expected = -tau * np.log1p(-k * float(sensor.on[0, 0]) / 2.0)
    assert len(t) >= 7
    np.testing.assert_allclose(t, expected, atol=25)
    # In the dark it is slower, where the setting says so.
    dark = with_only(6, cutoff=(100.0, 100.0), cutoff_dark=0.1, refractory=1e-6)
    assert at_pixel(listed(dark, times, logs), 0, 0)[0][0] > 1.5 * t[0]


@pytest.mark.parametrize(
    "before, light, dark", [(0.05, 0.3, 0.2), (0.9, 0.0, 0.1), (0.1, 1.0, 0.5), (0.9, 0.0, 0.0)]
)
def test_bandwidth_grows_with_light(before, light, dark):
    """From what it is in the dark to 100 Hz; what is left of a step falls exponentially."""
    sensor = plain_sensor()._replace(cutoff=jnp.array([100.0, dark]))
    state = module.first_state(sensor, jnp.full((1, 1), before))
    for duration in (1, 2000):  # it becomes light at once, and stays
        state, _ = module.step(sensor, state, jnp.full((1, 1), light), jnp.int32(duration))
    hertz = 100 * (dark + light * (1 - dark))
    start, end = np.log(0.001 + before), np.log(0.001 + light)
    expected = end + (start - end) * np.exp(-2 * np.pi * hertz * 0.0020005)
    np.testing.assert_allclose(state.log, expected, rtol=1e-4)


@pytest.mark.parametrize("hertz", [0.1, 3.0, 10.0, 1000.0])
@pytest.mark.parametrize("parts", [1, 7, 400])
def test_bandwidth_does_not_depend_on_how_often_a_ramp_is_rendered(hertz, parts):
    """y' = r (x - y) of x = x0 + s t is y = x0 + s t - s / r (1 - exp(-r t))."""
    sensor = plain_sensor()._replace(cutoff=jnp.array([hertz, 1.0]))
    times = np.linspace(0, 40_000, parts + 1).astype(int)
    images = np.exp(-3 + 2 * times / 40_000) - 0.001
    state, moved = module.first_state(sensor, jnp.full((1, 1), images[0])), 0
    for image, duration in zip(images[1:], np.diff(times), strict=True):
        state, runs = module.step(sensor, state, jnp.full((1, 1), image), jnp.int32(duration))
        moved += int(runs[0].count[0, 0])
    a = 2 * np.pi * hertz * 0.04
    expected = 2 * (1 + np.expm1(-a) / a)
    np.testing.assert_allclose(state.log[0, 0] + 3, expected, atol=2e-4)
    assert moved == int(expected / float(sensor.on) + 1e-3)


def test_a_lamp_fires_where_its_light_crosses_thresholds_and_falls_off_around_a_place():
    """Grey under a sinusoid of light is the loop over crossings; the swing is a Gaussian."""
    lamp = jax.device_get(with_only(6, flicker=(0.6, 0.6)).lamp)
    assert 60 <= lamp.hertz <= 240 and 0.5 < lamp.swing.max() <= 0.6
    swing = np.log(np.float64(lamp.swing))  # a paraboloid: curved alike everywhere, both ways
    curved = np.diff(swing, 2, axis=1), np.diff(swing, 2, axis=0)
    for each in curved:
        np.testing.assert_allclose(each, curved[0][0, 0], rtol=0.02)
    assert 0.15 <= np.sqrt(-2 / curved[0][0, 0]) / max(H, W) <= 2

    times = np.arange(0, 50_001, 100)
    events = listed(plain_sensor()._replace(lamp=lamp), times, np.full((len(times), H, W), -1.0))
    grey, turns = np.exp(-1.0) - EPS, 2 * np.pi * (lamp.start + lamp.hertz * 1e-6 * times)
    on, off = float(np.float32(0.2)), float(np.float32(0.17))
    for y, x in ((0, 0), (H // 2, W // 2), (H - 1, W - 1)):
        logs = np.log(EPS + grey * (1 + lamp.swing[y, x] * np.sin(turns)))
        expected = esim_pixel(times, logs, on, off)
        t, p = at_pixel(events, y, x)
        assert p.tolist() == [p for _, p in expected] and len(p) > 10
        np.testing.assert_allclose(t, [t for t, _ in expected], atol=1.5)


def test_the_lamp_goes_on_from_step_to_step():
    sensor = with_only(9, flicker=(0.6, 0.6))
    grey = jnp.full((H, W), 0.4)
    states = [module.first_state(sensor, grey)]
    for duration in (500, 1500, 700):
        states.append(module.step(sensor, states[-1], grey, jnp.int32(duration))[0])
    cycles = sensor.lamp.start + sensor.lamp.hertz * np.cumsum([0, 500, 1500, 700]) * 1e-6
    np.testing.assert_allclose([state.cycles for state in states], cycles % 1, atol=1e-5)
    swing = sensor.lamp.swing[None] * np.sin(2 * np.pi * cycles)[:, None, None]
    logs = np.stack([state.log for state in states])  # later by the bandwidth's microsecond
    np.testing.assert_allclose(logs, np.log(EPS + 0.4 * (1 + swing)), atol=5e-4)
    assert with_only(9).lamp is None


def test_the_same_key_gives_the_same_events():
    times = np.arange(0, 200_000, 5000)
    logs = random_logs(6, times)
    runs = []
    for seed in (7, 7, 8):
        sensor = random_sensor(jax.random.key(seed), height=H, width=W, settings=FAULTY)
        runs.append(listed(sensor, times, logs))
    for column in ("t", "x", "y", "p"):
        np.testing.assert_array_equal(getattr(runs[0], column), getattr(runs[1], column))
    assert len(runs[0]) != len(runs[2])


# ---- Event tensors

B, T, SIZE, RENDERINGS = 2, 6, 48, 5
SQUARE = {"height": SIZE, "width": SIZE}


SETTINGS = dict(batch=B, windows=T, renderings=RENDERINGS, motion=(2.0, 2.5), **SQUARE) | dict(
    scene=SceneSettings(objects=1, pause=0.0, speed=(60.0, 400.0)),
    sensor=replace(FAULTY, flicker=(0.2, 0.4)),
)


@pytest.fixture(scope="module")
def textures():
    return load_textures(None, 8, 64, seed=2)


@pytest.fixture(scope="module")
def setups(textures):
    """Sensors with every fault and a lamp, a slow and a fast scene with an object each, bounds."""
    *both, durations = random_setups(jax.random.key(8), textures, **SETTINGS)
    return *both, window_bounds(durations, SETTINGS["windows"])


@pytest.fixture(scope="module")
def scenes(setups):
    return setups[1]


@pytest.fixture(scope="module", params=["clean", "faulty"])
def simulated(request, setups):
    """The scenes before two sensors, and all that made the events."""
    sensors, scenes, bounds = setups
    if request.param == "clean":
        keys = jax.random.split(jax.random.key(4), B)
        sensors = jax.vmap(lambda key: random_sensor(key, **SQUARE))(keys)
    bounds = bounds + 1000
    simulation = simulate(sensors, scenes, bounds, renderings=RENDERINGS, **SQUARE)[1]
    return SimpleNamespace(sensors=sensors, bounds=bounds, simulation=simulation)


def of_sequence(tree, b):
    return jax.tree.map(lambda leaf: leaf[b], tree)


def rendered_at(bounds):
    """(T + 1,) -> the times at which `simulate` renders."""
    inside = [
        start + (np.arange(1, RENDERINGS + 1) * (stop - start)) // RENDERINGS
        for start, stop in zip(bounds[:-1], bounds[1:], strict=True)
    ]
    return np.concatenate([bounds[:1], *inside])


def windows_of(events, bounds):
    cuts = np.searchsorted(events.t, bounds)
    return [events.select(slice(*cut)) for cut in zip(cuts[:-1], cuts[1:], strict=True)]


@pytest.mark.optimised
def test_event_lists_give_the_tensors_of_the_device(simulated, scenes):
    """Same seed, two ways. What differs is the rounding of the picture itself: the compiler fuses
    its coordinates differently, by 1e-5 pixels, and that can move a stamp by a microsecond."""
    same = []
    for b in range(B):
        scene, sensor = (of_sequence(x, b) for x in (scenes, simulated.sensors))
        bounds = np.asarray(simulated.bounds[:, b], np.int64)
        frames = video(scene, rendered_at(bounds), **SQUARE)
        events = concatenate(list(event_list(sensor, frames)))
        rows = [[window] for window in windows_of(events, bounds)]
        limits = np.stack([bounds[:-1], bounds[1:]], -1)[:, None]
        tensors = voxelise(pack(rows, bounds=limits), **SQUARE)[:, 0]
        error = np.abs(tensors - simulated.simulation.tensors[:, b]).max(-1)
        same.append(error <= 1e-4)
        # An event at a window's very end may be in another window, else all are in both.
        microsecond = 4 / (bounds[1] - bounds[0])
        assert np.mean(error < 3 * microsecond) >= 0.9995
        assert len(events) > 0.05 * T * SIZE * SIZE
    assert np.mean(same) >= 0.999


@pytest.mark.optimised
def test_truth_belongs_to_the_windows_end(simulated, scenes):
    for b in range(B):
        frames = video(of_sequence(scenes, b), np.asarray(simulated.bounds[1:, b]), **SQUARE)
        images = np.stack([image for _, image in frames])
        np.testing.assert_allclose(images, simulated.simulation.images[:, b], atol=1e-4)


@pytest.mark.optimised
def test_no_more_than_half_a_pixel_between_two_renderings(simulated):
    length = np.linalg.norm(simulated.simulation.displacement, axis=-1)
    assert 0.5 < length.max() <= 0.5 * RENDERINGS


@pytest.mark.optimised
@pytest.mark.parametrize("simulated", ["faulty"], indirect=True)
def test_simulation_goes_on_where_it_ended(simulated, scenes):
    bounds, parts = simulated.bounds, []
    first = [next(video(of_sequence(scenes, b), bounds[:1, b], **SQUARE))[1] for b in range(B)]
    state = jax.jit(jax.vmap(module.first_state))(simulated.sensors, np.stack(first))
    for part in (bounds[: T // 2 + 1], bounds[T // 2 :]):
        state, made = simulate(
            simulated.sensors, scenes, part, state, renderings=RENDERINGS, **SQUARE
        )
        parts.append(made.tensors)
    error = jnp.abs(jnp.concatenate(parts) - simulated.simulation.tensors).max(-1)
    assert (error <= 1e-4).mean() >= 0.999


@pytest.mark.optimised
def test_to_and_fro_is_the_same_windows_forward_and_backward(simulated, scenes):
    """Backward a window ends where it began, its events are in reverse order and inverted, and
    displacements lead from its end to its beginning, as warping the one truth to the next shows."""
    data, bounds, half = simulated.simulation, simulated.bounds, T // 2
    made = jax.jit(partial(to_and_fro, **SQUARE))(data, scenes, bounds)
    order = [*range(half), *reversed(range(half))]
    back = [False] * half + [True] * half
    first = jnp.stack(
        [next(video(of_sequence(scenes, b), bounds[:1, b], **SQUARE))[1] for b in range(B)]
    )
    for k, (window, reverse) in enumerate(zip(order, back, strict=True)):
        tensors = data.tensors[window]
        np.testing.assert_array_equal(made.tensors[k], -tensors[..., ::-1] if reverse else tensors)
        before = data.images[window - 1] if window else first
        truth = before if reverse else data.images[window]
        np.testing.assert_allclose(made.images[k], truth, atol=1e-4)
        if k:
            warped, _ = warp(made.images[k - 1], made.displacement[k])
            error = jnp.abs(warped - made.images[k])
            forward = jnp.abs(warp(first, data.displacement[0])[0] - data.images[0])
            assert made.visible[k].mean() > 0.5
            limit = 2 * forward[data.visible[0]].mean()
            assert error[made.visible[k]].mean() < limit


@pytest.mark.optimised
def test_denser_renderings_give_the_same_events(scenes):
    """Half a pixel between renderings is dense enough: four times denser changes few events."""
    counts = []
    for pixels in (0.5, 0.125):
        scene = of_sequence(scenes, 1)
        times = rendering_times(scene, np.array([0, 50_000]), pixels=pixels, **SQUARE)
        events = concatenate(list(event_list(plain_sensor(), video(scene, times, **SQUARE))))
        counts.append(np.bincount(events.y.astype(int) * SIZE + events.x, minlength=SIZE**2))
    assert counts[1].mean() > 0.3
    assert np.abs(counts[0] - counts[1]).mean() < 0.05 * counts[1].mean()


def test_no_vote_is_lost_however_many_renderings_a_window_has(textures):
    """The votes of each event add up to 1: those of a pixel to a whole number."""
    size = {"height": 16, "width": 18}
    settings = SETTINGS | size | {"batch": 1, "renderings": 5, "sensor": SensorSettings()}
    sensors, scenes, durations = random_setups(jax.random.key(2), textures, **settings)
    bounds = window_bounds(durations, 2)
    _, made = simulate(sensors, scenes, bounds, renderings=3, **size)
    sums = np.asarray(made.tensors.sum(-1))
    np.testing.assert_allclose(sums, np.round(sums), atol=1e-3)
    assert np.abs(sums).sum() > 50


def test_the_runs_of_given_pictures_vote_as_their_events_do():
    """The same pictures for both outputs: nothing but the stamps' last bits may differ."""
    sensor = random_sensor(jax.random.key(9), height=H, width=W, settings=FAULTY)
    times = np.array([0, 3000, 7001, 9000, 14_000])
    images = (np.exp(random_logs(10, times)) - EPS).astype(np.float32)
    state, planes = module.first_state(sensor, jnp.asarray(images[0])), np.zeros((5, H, W), "f4")
    one_step, votes = jax.jit(module.step), jax.jit(sequences_module._votes)
    for k in range(1, len(times)):
        duration = jnp.int32(times[k] - times[k - 1])
        state, runs = one_step(sensor, state, jnp.asarray(images[k]), duration)
        planes = votes(planes, 0, runs, jnp.int32(times[k - 1]), jnp.int32(times[-1]))
    events = concatenate(list(event_list(sensor, zip(times, images, strict=True))))
    tensor = voxelise(pack([[events]], bounds=np.array([[[0, times[-1]]]])), height=H, width=W)
    planes = np.asarray(planes).transpose(1, 2, 0)
    np.testing.assert_allclose(planes, tensor[0, 0], atol=2e-5)
    assert int(state.renderings) == 4


def test_noise_of_drawn_signs_adds_up_and_alternating_noise_does_not():
    ticks = jnp.int32(1000)
    grey = jnp.full((50, 60), 0.5)
    settings = replace(module.SensorSettings(), noise=(300.0, 300.0))
    alternating = module.random_sensor(jax.random.key(1), height=50, width=60, settings=settings)
    drawn = alternating._replace(noise=shot_noise(300.0, 1.0, random=True))
    sums = []
    for sensor in (alternating, drawn):
        state, votes = module.first_state(sensor, grey), []
        for _ in range(100):
            state, (_, noise) = module.step(sensor, state, grey, ticks)
            votes.append(np.asarray(noise.count * noise.polarity))
        sums.append(np.sum(votes, 0))
        fired = np.abs(votes).mean()
    assert np.abs(sums[0]).max() == 1
    # A random walk of some thirty steps: its variance is their number.
    assert 0.25 < fired < 0.35
    np.testing.assert_allclose(sums[1].var(), 100 * fired, rtol=0.1)
    assert abs(sums[1].mean()) < 0.5


def test_a_clean_sensor_among_faulty_ones_is_the_papers(textures):
    settings = replace(FAULTY, threshold_range=(0.3, 0.6), clean=0.5, flicker=(0.5, 0.9))
    make = partial(module.random_sensor, height=8, width=9)
    keys = jax.random.split(jax.random.key(0), 200)
    sensors = jax.jit(jax.vmap(partial(make, settings=settings)))(keys)
    faulty = jax.jit(jax.vmap(partial(make, settings=replace(settings, clean=0.0))))(keys)
    clean = np.asarray(sensors.noise.rate) == 0
    assert 0.4 < clean.mean() < 0.6
    assert (np.asarray(sensors.refractory)[clean] == 1000 * TICKS).all()
    assert (np.asarray(sensors.cutoff)[clean][:, 1] == 1).all()
    for name in ("on", "off", "refractory", "drift", "noise.rate", "cutoff"):
        mixed, usual = (np.asarray(attrgetter(name)(s)) for s in (sensors, faulty))
        np.testing.assert_array_equal(mixed[~clean], usual[~clean])
    swing = np.asarray(sensors.lamp.swing)
    assert not swing[clean].any() and (swing[~clean].max((1, 2)) > 0.4).all()
    for thresholds in (np.asarray(sensors.on)[clean], np.asarray(sensors.off)[clean]):
        assert np.ptp(thresholds, (1, 2)).max() == 0 and not np.asarray(sensors.drift)[clean].any()
        assert abs(thresholds.mean() - 0.18) < 0.01 and abs(thresholds[:, 0, 0].std() - 0.03) < 0.01
    # ... and makes the events of one without faults.
    first = np.flatnonzero(clean)[0]
    one = jax.tree.map(lambda leaf: leaf[first], sensors)
    plain = make(keys[first])._replace(on=one.on[0, 0], off=one.off[0, 0])
    rng = np.random.default_rng(0)
    images = jnp.asarray(rng.uniform(size=(4, 8, 9)), jnp.float32)
    states = [module.first_state(sensor, images[0]) for sensor in (one, plain)]
    for image in images[1:]:
        (seen, runs), (expected, wanted) = (
            module.step(sensor, state, image, jnp.int32(5000))
            for sensor, state in zip((one, plain), states, strict=True)
        )
        states = [seen, expected]
        assert not runs[1].count.any() and wanted[0].count.sum() > 0
        np.testing.assert_array_equal(runs[0].count, wanted[0].count)
        np.testing.assert_allclose(runs[0].first, wanted[0].first, atol=TICKS)
    with pytest.raises(ValueError, match="clean is 2"):
        replace(settings, clean=2.0)


@pytest.mark.slow
@pytest.mark.reference
@pytest.mark.optimised
def test_the_published_weights_reconstruct_simulated_photographs(reference):
    from skimage.metrics import structural_similarity

    from firenet_jax.checkpoint import convert

    weights = convert(reference / "firenet_published.pth")
    textures = jnp.asarray(load_textures(None, 64, 256, seed=0, procedural=0.0))
    scores = []
    for seed in range(20):
        made = sequences(jax.random.key(seed), textures, batch=1, windows=10, height=160, width=160)
        images = reconstruct(weights, initial_state(1, 160, 160), made.tensors)[1]
        score = structural_similarity(
            np.asarray(made.images[-1, 0]),
            np.clip(images[-1, 0], 0, 1),
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
            data_range=1.0,
        )
        scores.append(score)
    assert np.mean(scores) >= 0.65, np.round(scores, 2)


def test_no_threshold_is_below_a_hundredth():
    """Where mismatch would make it so: a pixel of threshold 0 fires without end."""
    settings = SensorSettings(mismatch=0.2)
    sensor = random_sensor(jax.random.key(3), height=40, width=40, settings=settings)
    for threshold in (sensor.on, sensor.off):
        assert threshold.min() == np.float32(0.01)


def of_both(bounds):
    """(T + 1,) of the slow scene and (T + 1,) of the fast one -> (T + 1, 2) int32."""
    return jnp.stack([jnp.asarray(each, jnp.int32) for each in bounds], 1)


@pytest.mark.optimised
def test_each_sequence_has_the_renderings_that_it_needs(setups):
    """One at rest has the fewest, one that is fast the most, as if each were alone."""
    sensors, scenes, _ = setups
    sensors = sensors._replace(lamp=sensors.lamp._replace(swing=0 * sensors.lamp.swing))
    fewest, most = 3, 9
    lengths = 0.05 / scenes.speed[0], 2 * most / scenes.speed[1]  # of windows: pixels
    bounds = of_both([np.arange(4) * int(1e6 * length) for length in lengths])
    sensors = sensors._replace(noise=sensors.noise._replace(rate=jnp.zeros(2)))
    made = simulate(sensors, scenes, bounds, renderings=(fewest, most), **SQUARE)[1]
    for b, number in enumerate((fewest, most)):
        alone = simulate(sensors, scenes, bounds, renderings=number, **SQUARE)[1]
        assert jnp.abs(alone.tensors[:, b]).max() > 0
        for ours, expected in zip(made, alone, strict=True):
            np.testing.assert_allclose(ours[:, b], expected[:, b], atol=1e-3)


def test_renderings_are_half_a_pixel_apart_and_enough_for_noise_and_light(setups):
    sensors, scenes, bounds = setups
    sensor, scene = of_sequence(sensors, 1), of_sequence(scenes, 1)
    sensor = sensor._replace(
        noise=shot_noise(0.0, 1.0), lamp=sensor.lamp._replace(swing=jnp.zeros((SIZE, SIZE)))
    )
    bounds = jnp.arange(7, dtype=jnp.int32) * 40_000
    needed = partial(sequences_module.renderings_needed, least=1, most=10_000, **SQUARE)
    counts = needed(sensor, scene, bounds)
    times = 1e-6 * np.linspace(bounds[:-1], bounds[1:], 33)
    fastest = np.stack([speeds(scene, each, **SQUARE) for each in times.T]).max(1)
    apart = fastest * 0.04 / counts
    assert (apart <= 0.52).all() and apart.mean() > 0.3
    noisy = sensor._replace(noise=shot_noise(5000.0, 1.0, random=True))
    np.testing.assert_array_equal(needed(noisy, scene, bounds), 2 * 5000 * 0.04)
    lit = sensor._replace(lamp=sensor.lamp._replace(swing=jnp.full((SIZE, SIZE), 0.1)))
    assert (needed(lit, scene, bounds) == 10_000).all()
