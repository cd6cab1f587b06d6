import math

import jax.numpy as jnp
import numpy as np
import pytest
import references
from scipy.ndimage import convolve

from firenet_jax.events import Events
from firenet_jax.pictures import (
    Display,
    automatic_range,
    bilateral,
    display,
    event_pictures,
    initial_display_state,
    unsharp_kernel,
    unsharp_mask,
)
from firenet_jax.tensors import pack, voxelise


def test_unsharp_mask_equals_the_5x5_kernel():
    image = np.random.default_rng(0).random((14, 19)).astype(np.float32)
    np.testing.assert_allclose(
        unsharp_mask(jnp.asarray(image), 0.3), references.unsharp(image), atol=1e-6
    )


@pytest.mark.parametrize("amount", [0.3, 1.0])
def test_unsharp_mask_is_one_convolution(amount):
    image = np.random.default_rng(0).random((14, 19)).astype(np.float32)
    kernel = unsharp_kernel(amount)
    assert kernel.sum() == pytest.approx(1, abs=1e-6)  # a grey picture stays as it is
    expected = convolve(image, kernel, mode="constant")
    np.testing.assert_allclose(unsharp_mask(jnp.asarray(image), amount), expected, atol=1e-6)


def test_what_is_not_said_is_as_the_settings_say():
    """Sharpened by 0.3, the automatic range, not smoothed; and 25 grey levels if smoothed."""
    assert Display() == Display(unsharp=0.3, range="auto", bilateral=0.0)
    assert len({Display(), Display(), Display(0)}) == 2  # arguments of a compiled function
    images = jnp.asarray(np.random.default_rng(5).random((3, 1, 12, 14)), jnp.float32)
    state = initial_display_state(1)
    shown = [display(state, images, **more)[1] for more in ({}, {"settings": Display(0.3, "auto")})]
    np.testing.assert_array_equal(*shown)
    np.testing.assert_array_equal(bilateral(images[0]), bilateral(images[0], 25.0))


@pytest.mark.parametrize("height, border", [(8, 0), (9, 2)])
def test_borders_set_no_range_where_there_is_more_than_that(height, border):
    image = np.random.default_rng(6).random((height, 20))
    inside = image[border : height - border, border : 20 - border]
    low, high = np.quantile(inside, [0.005, 0.995])
    margin = 0.05 * (high - low)
    found = automatic_range(jnp.asarray(image, jnp.float32))
    np.testing.assert_allclose(found, [low - margin, high + margin], atol=1e-5)


@pytest.mark.parametrize("height, width, apart", [(127, 129, 1), (128, 128, 2), (480, 640, 8)])
def test_the_range_is_read_from_some_4096_pixels_on_a_grid(height, width, apart):
    """All are read below four times that; whatever lies between those that are read is not seen."""
    y, x = np.mgrid[:height, :width] - 2
    bright = (y % apart == 0) & (x % apart == 0)
    low, high = automatic_range(jnp.where(bright, 1.0, 0.0))
    assert (float(low) + 2 * float(high)) / 3 == pytest.approx(1)  # more is added below
    assert float(high) - float(low) == pytest.approx(0.35)  # never narrower
    if apart == 1:
        bright = (y % 2 == 0) & (x % 2 == 0)
        assert float(automatic_range(jnp.where(bright, 1.0, 0.0))[0]) == pytest.approx(-0.05)


def test_fixed_range_clips_and_rounds():
    images = jnp.array([-0.5, 0.0, 0.5, 1.0, 1.5, 100.4 / 255, 100.6 / 255]).reshape(1, 1, 1, 7)
    state = initial_display_state(1)
    same, pictures = display(state, images, settings=Display(unsharp=0, range="fixed"))
    assert pictures.dtype == jnp.uint8
    assert pictures.ravel().tolist() == [0, 0, 128, 255, 255, 100, 101]
    np.testing.assert_array_equal(same.low, state.low)


RANGES = {"auto": references.automatic_ranges, "extremes": references.intensity_ranges}


@pytest.mark.parametrize("kind", RANGES)
def test_range_is_the_running_median(kind):
    rng = np.random.default_rng(1)
    contrast = rng.choice([0.01, 0.1, 0.4], (30, 1, 1, 1))
    images = rng.normal(rng.random((30, 1, 1, 1)), contrast, (30, 1, 16, 27)).astype(np.float32)
    _, pictures = display(
        initial_display_state(1), jnp.asarray(images), settings=Display(0, range=kind)
    )
    for t, (low, high) in enumerate(RANGES[kind](images[:, 0])):
        expected = np.clip(255 * (images[t, 0] - low) / (high - low), 0, 255)
        assert np.abs(np.asarray(pictures[t, 0], float) - expected).max() <= 0.501


def test_automatic_range_does_not_see_hot_pixels_and_does_not_blow_up_noise():
    rng = np.random.default_rng(0)
    scene = rng.uniform(0.2, 0.8, (1, 1, 90, 120)).astype(np.float32)
    hot = scene.copy()
    hot[..., rng.integers(0, 90, 10), rng.integers(0, 120, 10)] = 40.0
    state, settings = initial_display_state(1), Display(unsharp=0)
    without, seen = (
        np.asarray(display(state, each, settings=settings)[1]) for each in (scene, hot)
    )
    np.testing.assert_allclose(seen[hot < 1], without[hot < 1], atol=1)
    assert without.min() < 15 and without.max() > 240
    noise = 0.5 + 0.01 * rng.normal(size=(1, 1, 90, 120)).astype(np.float32)
    shown = np.asarray(display(state, noise, settings=settings)[1], float)
    assert shown.std() == pytest.approx(255 * 0.01 / 0.35, rel=0.05)
    assert shown.mean() == pytest.approx(255 * 0.64, abs=1)


def test_the_ground_hardly_changes_when_something_dark_enters_where_nothing_was():
    """Only the entering object is dark: with the range of an empty scene around its middle, the
    ground jumped from mid-grey to white."""
    images = np.full((24, 1, 60, 80), 0.55, np.float32)
    images[12:, :, 20:40, 30:50] = 0.1
    shown = np.asarray(display(initial_display_state(1), images)[1][:, 0, 5, 5], float)
    assert shown[0] == pytest.approx(170, abs=1)  # light grey
    assert np.abs(shown[-1] - shown[0]) < 75


def test_automatic_range_of_a_large_image_is_read_from_a_part_of_it():
    images = np.random.default_rng(3).beta(2, 5, (2, 1, 480, 640)).astype(np.float32)
    low, high = (np.asarray(end) for end in automatic_range(jnp.asarray(images)))
    every = np.quantile(images, [0.005, 0.995], axis=(-2, -1))
    margin = 0.05 * (every[1] - every[0])
    np.testing.assert_allclose([low, high], [every[0] - margin, every[1] + margin], atol=0.02)


@pytest.mark.parametrize("kind", RANGES)
def test_range_survives_chunks_and_ignores_what_is_not_valid(kind):
    rng = np.random.default_rng(2)
    images = jnp.asarray(rng.random((20, 2, 5, 5)), jnp.float32)
    settings = Display(range=kind)
    whole, expected = display(initial_display_state(2), images, settings=settings)
    state, parts = initial_display_state(2), []
    for start in range(0, 20, 3):
        part = images[start : start + 3]
        junk = jnp.full((2, 2, 5, 5), 1e9)
        valid = jnp.arange(len(part) + 2)[:, None] < jnp.array([[len(part)] * 2])
        state, shown = display(state, jnp.concatenate([part, junk]), valid, settings=settings)
        parts.append(shown[: len(part)])
    np.testing.assert_array_equal(np.concatenate(parts), expected)
    np.testing.assert_array_equal(state.high, whole.high)


def test_bilateral_filter_equals_the_loop_over_neighbours():
    rng, sigma = np.random.default_rng(4), 1.5
    image = 0.5 + rng.normal(0, 0.004, (6, 7))
    padded, expected = np.pad(image, 2, mode="reflect"), np.zeros((6, 7))
    for y, x in np.ndindex(6, 7):
        around = [(i, j) for i in range(-2, 3) for j in range(-2, 3) if math.hypot(i, j) <= 2]
        values = np.array([padded[y + 2 + i, x + 2 + j] for i, j in around])
        squares = [math.hypot(i, j) ** 2 for i, j in around] + (255 * (values - image[y, x])) ** 2
        weights = np.exp(-squares / (2 * sigma**2))
        expected[y, x] = (weights * values).sum() / weights.sum()
    found = bilateral(jnp.asarray(image, jnp.float32), sigma)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_smoothed_pictures_keep_their_edges():
    rng = np.random.default_rng(3)
    images = np.where(np.arange(12) < 6, 0.2, 0.8) + rng.normal(0, 0.02, (2, 1, 9, 12))
    images = jnp.asarray(images, jnp.float32)
    _, pictures = display(
        initial_display_state(1), images, settings=Display(unsharp=0, range="fixed", bilateral=25.0)
    )
    np.testing.assert_array_equal(pictures, np.round(255 * bilateral(jnp.clip(images, 0, 1))))
    noise = np.asarray(pictures)[..., 2:4].std(), 255 * np.asarray(images)[..., 2:4].std()
    assert noise[0] < 0.6 * noise[1]
    assert np.abs(np.asarray(pictures, int)[..., 6] - 0.8 * 255).max() < 15


@pytest.mark.parametrize("name", ["unsharp", "bilateral"])
@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf")])
def test_impossible_settings(name, value):
    with pytest.raises(ValueError, match=f"{name} is"):
        Display(**{name: value})


def test_unknown_range():
    with pytest.raises(ValueError, match="range is 'hdr', but must be one of auto, extremes"):
        Display(range="hdr")


def test_event_pictures_show_the_sign_of_the_votes():
    tensor = jnp.zeros((2, 3, 5)).at[0, 0].set(0.2).at[1, 2].set(-0.2)
    pictures = np.asarray(event_pictures(tensor))
    assert pictures[0, 0].tolist() == [0, 0, 255] and pictures[1, 2].tolist() == [255, 0, 0]
    assert (pictures == 255).all(-1).sum() == 4


def test_event_pictures_are_white_where_events_cancel():
    """The votes of ON and OFF events then sum to 0 but for rounding."""
    rng, count, width = np.random.default_rng(3), 8000, 2000
    t, pixel, p = (
        np.sort(rng.integers(0, 99_991, count)),
        *rng.integers(0, [[width], [2]], (2, count)),
    )
    events = Events.of(t, pixel, np.zeros(count, int), p)
    tensors = voxelise(pack([[events]]), height=1, width=width)
    cancel = np.bincount(pixel, 2 * p - 1, width) == 0
    assert np.asarray(tensors.sum(-1)).ravel()[cancel].any()
    pictures = np.asarray(event_pictures(tensors))[0, 0, 0]
    np.testing.assert_array_equal((pictures == 255).all(-1), cancel)


@pytest.mark.parametrize("range", ["auto", "fixed"])
def test_no_windows_are_no_pictures(range):
    state = initial_display_state(1)
    _, pictures = display(state, jnp.zeros((0, 1, 8, 9)), settings=Display(range=range))
    assert pictures.shape == (0, 1, 8, 9)


@pytest.mark.parametrize("valid", [np.ones((3, 1), int), np.ones(3, bool), np.ones((1, 3), bool)])
def test_which_are_valid_is_said_of_each_image(valid):
    with pytest.raises(ValueError, match=r"must be bool \(3, 1\)"):
        display(initial_display_state(1), jnp.zeros((3, 1, 8, 9)), valid)


@pytest.mark.parametrize("shape", [(3, 8, 9), (3, 2, 8, 9)])
def test_images_of_another_shape_are_refused(shape):
    with pytest.raises(ValueError, match=r"the state of 1 recordings: expected \(T, B, H, W\)"):
        display(initial_display_state(1), jnp.zeros(shape))
