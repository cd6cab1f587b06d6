import dataclasses
import inspect
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from firenet_jax.errors import SettingsError
from firenet_jax.simulation import curricula
from firenet_jax.simulation.curricula import (
    check_motion,
    check_rare,
    random_setups,
    sequences,
    window_bounds,
)
from firenet_jax.simulation.scenes import SceneSettings
from firenet_jax.simulation.sensor import FAULTY, Noise, Sensor, SensorSettings
from firenet_jax.simulation.sequences import simulate
from firenet_jax.simulation.textures import load_textures
from firenet_jax.training.settings import Train

B, T, SIZE, RENDERINGS = 2, 6, 48, 5
SETTINGS = dict(
    batch=B,
    windows=T,
    renderings=RENDERINGS,
    motion=(2.0, 2.5),
    height=SIZE,
    width=SIZE,
    scene=SceneSettings(objects=1, pause=0.0, speed=(60.0, 400.0)),
    sensor=replace(FAULTY, flicker=(0.2, 0.4)),
)


@pytest.fixture(scope="module")
def textures():
    return load_textures(None, 8, 64, seed=2)


@pytest.mark.slow
def test_random_sequences_have_the_declared_shapes_and_do_not_retrace(textures):
    compiled = []
    for seed in range(2):
        made = sequences(jax.random.key(seed), textures, **SETTINGS)
        compiled.append((random_setups._cache_size(), simulate._cache_size()))
    assert compiled[0] == compiled[1]
    shape = T, B, SIZE, SIZE
    assert made.tensors.shape == (*shape, 5) and made.images.shape == shape
    assert made.displacement.shape == (*shape, 2) and made.visible.shape == shape
    assert made.visible.dtype == bool
    for leaf in made:
        assert np.isfinite(leaf).all()
    assert made.images.min() >= 0 and made.images.max() <= 1
    with pytest.raises(ValueError, match="6 renderings"):
        sequences(jax.random.key(0), textures, **(SETTINGS | dict(motion=(1.0, 6.0))))


@pytest.mark.slow
def test_rare_sequences_are_slow_and_calm_or_swift_before_a_blank_ground(textures):
    settings = SETTINGS | {"batch": 96, "sensor": replace(FAULTY, noise=(1.0, 1.0))}
    make = partial(random_setups, **settings)

    def made(**shares):
        return jax.jit(partial(make, **shares))(jax.random.key(3), textures)

    sensors, scenes, durations = made(slow=0.3, swift=0.2)
    pixels = np.asarray(1e-6 * durations * scenes.speed)
    slow, swift = pixels < 0.31, pixels > 15.9
    assert 0.15 < slow.mean() < 0.45 and 0.08 < swift.mean() < 0.32
    assert pixels.min() > 0.019 and pixels.max() < 90.1
    assert pixels[slow].max() > 0.2 and pixels[swift].max() > 60
    usual = pixels[~slow & ~swift]
    assert usual.max() < 2.51  # or less: a window lasts 300 ms at most
    grounds = np.asarray(scenes.textures[0]).reshape(96, -1)
    np.testing.assert_array_equal(np.ptp(grounds, axis=1) == 0, swift)
    assert len(scenes.textures) == 2 and (np.ptp(scenes.textures[1], (1, 2)) > 0.05).all()
    assert 0.2 <= grounds[swift].min() < 0.3 and 0.7 < grounds[swift].max() <= 0.8
    calm = np.asarray(sensors.noise.rate) < 0.5
    assert not calm[~slow].any() and 0.4 < calm[slow].mean() < 0.9
    even, _, _ = made(slow=1e-9, swift=0.2)
    for name in ("on", "off"):
        thresholds, before = (np.asarray(getattr(sensor, name)) for sensor in (sensors, even))
        spread, mean = before.std((1, 2)), before.mean((1, 2), keepdims=True)
        np.testing.assert_array_equal(thresholds[~slow], before[~slow])
        farther = np.maximum(mean + 4 * (before - mean), 0.01)
        np.testing.assert_allclose(thresholds[slow], farther[slow], rtol=1e-4)
        assert (0.02 < spread).all() and (spread < 0.04).all()
    with pytest.raises(ValueError, match="together less than 1"):
        made(slow=0.6, swift=0.4)


def test_what_is_not_said_is_as_in_a_training():
    trained = {field.name: field.default for field in dataclasses.fields(Train)}
    for function, names in (
        (random_setups, ("renderings", "motion", "slow", "swift")),
        (sequences, ("renderings",)),
    ):
        parameters = inspect.signature(function).parameters
        assert {name: parameters[name].default for name in names} == {n: trained[n] for n in names}
    parameters = inspect.signature(simulate).parameters
    assert parameters["renderings"].default == trained["renderings"] == 5
    assert (trained["motion"], trained["slow"], trained["swift"]) == ((1.25, 2.5), 0.0, 0.0)


def test_something_may_move_by_a_pixel_between_two_renderings_and_no_farther():
    check_motion((9.0, 5.0), 5)  # only the greatest counts here
    with pytest.raises(SettingsError, match="5.1 pixels of motion need 6 renderings, not 5"):
        check_motion((1.0, 5.1), 5)


@pytest.mark.parametrize("slow, swift", [(0.3, 0.2), (0.0, 0.0), (0.5, 0.0), (0.0, 0.25)])
def test_paces_are_those_of_slow_usual_and_swift_sequences(slow, swift):
    """The first are slow, the last swift; each kind's motion fills its range, log-uniformly."""
    kind, share = (axis.ravel() for axis in np.meshgrid(np.arange(0, 1, 0.05), [0, 0.3, 0.99]))
    kind, share = kind.astype(np.float32), share.astype(np.float32)
    speeds, motion, renderings = (30.0, 9000.0), (1.0, 4.0), 4
    found = curricula._paces(np.stack([share, kind]), speeds, motion, renderings, slow, swift)
    speed, duration, is_slow, is_swift = map(np.asarray, found)
    assert duration.dtype == np.int32
    for k in range(len(kind)):
        assert is_slow[k] == (kind[k] < np.float32(slow))
        assert is_swift[k] == (kind[k] >= np.float32(1 - swift))
        drawn = speeds[0] * (speeds[1] / speeds[0]) ** share[k]
        if is_slow[k]:
            pixels = 0.02 * (0.3 / 0.02) ** (kind[k] / slow)
        elif is_swift[k]:
            pixels = 16 * (90 / 16) ** ((kind[k] - 1 + swift) / swift)
        else:
            pixels = 4 ** ((kind[k] - slow) / (1 - slow - swift))
        microseconds = min(max(1e6 * pixels / drawn, 1000), 300_000)
        assert duration[k] == pytest.approx(microseconds, abs=1.01, rel=1e-5)
        if is_slow[k] or is_swift[k]:
            expected = 1e6 * pixels / duration[k]
        else:  # no more than a pixel between two renderings
            expected = min(drawn, 1e6 * renderings / duration[k])
        assert speed[k] == pytest.approx(expected, rel=1e-4)


def test_scenes_are_made_for_as_long_as_their_windows_last(textures, monkeypatch):
    """All windows together, in seconds, and for the speed of their sequence."""

    def random_scene(key, textures, *, duration, speed, settings, height, width):
        return duration, speed

    monkeypatch.setattr(curricula, "random_scene", random_scene)
    settings = SETTINGS | {"batch": 20, "sensor": SensorSettings()}
    make = random_setups.__wrapped__
    _, (seconds, speeds), durations = make(jax.random.key(1), textures, **settings)
    np.testing.assert_allclose(seconds, 1e-6 * T * np.asarray(durations), rtol=1e-5)
    pixels = 1e-6 * np.asarray(durations) * np.asarray(speeds)
    assert np.ptp(durations) > 1000 and (1.99 < pixels).all() and (pixels < 2.51).all()


def sensors_of(batch, **fields):
    none = dict.fromkeys(Sensor._fields)
    return Sensor(**none | {"on": np.full(batch, 0.2), "off": np.full(batch, 0.2)} | fields)


def test_slow_sequences_have_four_times_the_mismatch_and_two_thirds_hardly_any_noise():
    rng, kind = np.random.default_rng(0), np.array([0.0, 0.19, 0.21, 0.29, 0.31, 0.9])
    is_slow, slow = kind < 0.3, 0.3
    on, off = 0.1 + 0.04 * rng.standard_normal((2, 6, 5, 7))
    drift, noise = rng.random((6, 5, 7)), Noise(*rng.random((4, 6)))
    fields = {"on": on, "off": off, "noise": noise, "drift": drift}
    sensors = sensors_of(6, **jax.tree.map(jax.numpy.float32, fields))
    found = curricula._uneven(sensors, kind, is_slow, slow)
    share = np.array([0.02, 0.02, 1, 1, 1, 1])
    for name, before in (("on", on), ("off", off)):
        mean = before.mean((1, 2), keepdims=True)
        apart = np.where(is_slow[:, None, None], 4 * (before - mean), before - mean)
        np.testing.assert_allclose(
            getattr(found, name), np.maximum(mean + apart, 0.01), rtol=1e-4, atol=1e-6
        )
    expected = noise._replace(rate=share * noise.rate)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5), found.noise, expected)
    np.testing.assert_allclose(found.drift, drift * share[:, None, None], rtol=1e-5)
    bare = sensors_of(6)  # one threshold for all pixels, no noise, no leaks
    assert curricula._uneven(bare, kind, is_slow, slow) == bare


@pytest.mark.parametrize("slope", [None, -1.5])
def test_half_of_the_sequences_at_rest_are_noisy_and_half_of_these_by_chance(slope):
    batch, windows = 4000, 6
    slopes = None if slope is None else np.full(batch, slope, np.float32)
    rates, lights = (np.full(batch, value, np.float32) for value in (0.5, 0.25))
    sensors = sensors_of(batch, noise=Noise(rates, lights, slopes, np.zeros(batch, bool)))
    duration = np.where(np.arange(batch) % 2, 10_000, 40_000).astype(np.int32)
    lasts = np.arange(batch) % 3 > 0  # as long as all windows and a bit, or nearly as long
    stop = 1e-6 * windows * duration * np.where(lasts, 1.001, 0.999)
    pauses = np.stack([np.full(batch, 0.3), 0.3 + stop], -1)[:, None]
    arguments = sensors, SimpleNamespace(pauses=pauses), windows, duration
    found = curricula._noisy_at_rest(jax.random.key(0), *arguments)
    rate, light, slopes, drawn = map(np.asarray, found.noise)
    noisy = light == 1
    assert not noisy[~lasts].any() and abs(noisy[lasts].mean() - 0.5) < 0.03
    assert (rate[~noisy] == 0.5).all() and (light[~noisy] == 0.25).all()
    assert not drawn[~noisy].any() and abs(drawn[noisy].mean() - 0.5) < 0.04
    share = np.log(rate * 1e-6 * duration / 0.02)[noisy] / np.log(50)  # 0.02 to 1 in a window
    assert -0.001 < share.min() < 0.01 and 0.99 < share.max() < 1.001
    assert abs(share.mean() - 0.5) < 0.03
    assert abs(np.corrcoef(share, drawn[noisy])[0, 1]) < 0.07
    if slope is None:
        assert found.noise.slope is None
    else:
        equal = slopes == 0
        assert not equal[~noisy].any() and abs(equal[noisy].mean() - 0.4) < 0.04
        assert (slopes[~equal] == slope).all()
        assert abs(np.corrcoef(equal[noisy], drawn[noisy])[0, 1]) < 0.07
    quiet = sensors_of(batch)
    assert curricula._noisy_at_rest(jax.random.key(0), quiet, *arguments[1:]) is quiet


def test_bounds_of_windows_that_go_on():
    durations = np.array([10, 7], np.int32)
    assert window_bounds(durations, 2).tolist() == [[0, 0], [10, 7], [20, 14]]
    assert window_bounds(durations, 2).dtype == np.int32
    assert window_bounds(durations, 1, 3).tolist() == [[30, 21], [40, 28]]
    assert window_bounds(durations, 1, np.array([3, 0])).tolist() == [[30, 0], [40, 7]]


@pytest.mark.parametrize("shares", [(-0.1, 0.5), (0.5, -0.1), (0.6, 0.4), (0.7, 0.8)])
def test_shares_of_rare_sequences_leave_some_for_the_usual_ones(shares):
    check_rare(0.6, 0.3)
    check_rare(0.0, 0.0)
    with pytest.raises(SettingsError, match="together less than 1"):
        check_rare(*shares)


@pytest.mark.slow
def test_no_window_is_so_short_that_more_than_a_pixel_passes_between_renderings(textures):
    """The shortest is a millisecond, in which the fastest would move by a hundred pixels."""
    scene = replace(SETTINGS["scene"], speed=(1e5, 1e5))
    make = jax.jit(partial(random_setups, **(SETTINGS | {"batch": 4, "scene": scene})))
    _, scenes, durations = make(jax.random.key(5), textures)
    assert (np.asarray(durations) == 1000).all()
    np.testing.assert_allclose((1e-6 * durations * scenes.speed).max(), RENDERINGS, rtol=1e-5)


@pytest.mark.slow
def test_half_of_the_sequences_that_stop_for_good_are_noisy_in_any_light(textures):
    scene = replace(SETTINGS["scene"], halt=0.5)
    settings = SETTINGS | {"batch": 200, "scene": scene}
    make = jax.jit(partial(random_setups, **settings))
    sensors, scenes, durations = make(jax.random.key(4), textures)
    seconds = 1e-6 * np.asarray(durations)
    stopped = np.diff(scenes.pauses[:, 0, :2])[:, 0] > T * seconds
    rate, light, _, drawn = map(np.asarray, sensors.noise)
    noisy = light == 1
    assert 0.35 < stopped.mean() < 0.65 and not noisy[~stopped].any()
    assert 0.3 < noisy[stopped].mean() < 0.7
    in_a_window = (rate * seconds)[noisy]
    assert (in_a_window > 0.0199).all() and (in_a_window < 1.001).all()
    assert not drawn[~noisy].any() and 0.3 < drawn[noisy].mean() < 0.7
    np.testing.assert_array_equal(light[~noisy], 0.25)
    assert (rate[~noisy] <= FAULTY.noise[1]).all()


@pytest.mark.slow
def test_of_sensors_whose_noise_shows_the_dark_fewer_are_equally_noisy_at_rest(textures):
    sensor = replace(SETTINGS["sensor"], noise_in_light=(0.01, 0.5))
    settings = SETTINGS | {"batch": 200, "sensor": sensor}
    settings["scene"] = replace(SETTINGS["scene"], halt=1.0)
    make = jax.jit(partial(random_setups, **settings))
    sensors, _, _ = make(jax.random.key(4), textures)
    noisy = np.asarray(sensors.noise.light) == 1
    equal = np.asarray(sensors.noise.slope) == 0
    assert 0.1 < equal.mean() < 0.3 and noisy[equal].all()  # 0.4 of a half
    assert 0.2 < (noisy & ~equal).mean() < 0.4
