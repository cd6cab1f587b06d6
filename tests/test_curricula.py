from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest

from firenet_jax.errors import SettingsError
from firenet_jax.simulation.curricula import check_rare, random_setups, sequences
from firenet_jax.simulation.scenes import SceneSettings
from firenet_jax.simulation.sensor import FAULTY, simulate
from firenet_jax.simulation.textures import load_textures

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
    blank = np.ptp(np.asarray(scenes.textures[0]).reshape(96, -1), axis=1) == 0
    np.testing.assert_array_equal(blank, swift)
    calm = np.asarray(sensors.noise[:, 0]) < 0.5
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


@pytest.mark.parametrize("shares", [(-0.1, 0.5), (0.5, -0.1), (0.6, 0.4), (0.7, 0.8)])
def test_shares_of_rare_sequences_leave_some_for_the_usual_ones(shares):
    check_rare(0.6, 0.3)
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
    rate, light, drawn = np.asarray(sensors.noise).T
    noisy = light == 1
    assert 0.35 < stopped.mean() < 0.65 and not noisy[~stopped].any()
    assert 0.3 < noisy[stopped].mean() < 0.7
    in_a_window = (rate * seconds)[noisy]
    assert (in_a_window > 0.0199).all() and (in_a_window < 1.001).all()
    assert not drawn[~noisy].any() and 0.3 < drawn[noisy].mean() < 0.7
    usual = sensors.noise[~noisy]
    np.testing.assert_array_equal(usual[:, 1], 0.25)
    assert (usual[:, 0] <= FAULTY.noise[1]).all()


@pytest.mark.slow
def test_of_sensors_whose_noise_shows_the_dark_fewer_are_equally_noisy_at_rest(textures):
    sensor = replace(SETTINGS["sensor"], noise_in_light=(0.01, 0.5))
    settings = SETTINGS | {"batch": 200, "sensor": sensor}
    settings["scene"] = replace(SETTINGS["scene"], halt=1.0)
    make = jax.jit(partial(random_setups, **settings))
    sensors, _, _ = make(jax.random.key(4), textures)
    noisy = np.asarray(sensors.noise)[:, 1] == 1
    equal = np.asarray(sensors.noise_slope) == 0
    assert 0.1 < equal.mean() < 0.3 and noisy[equal].all()  # 0.4 of a half
    assert 0.2 < (noisy & ~equal).mean() < 0.4
