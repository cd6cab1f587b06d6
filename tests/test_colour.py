"""Colours against scikit-image's, and a mosaic's channels against recordings of their own."""

from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from skimage.color import lab2rgb, rgb2lab
from test_tensors import random_events

from firenet_jax import colour
from firenet_jax.checkpoint import load_weights
from firenet_jax.commands.reconstruct import Reconstruct, run
from firenet_jax.events import concatenate
from firenet_jax.network import Weights, initial_state
from firenet_jax.pictures import Display, Range, display, initial_display_state
from firenet_jax.reconstruction import Network, events_to_pictures, initial_session, reconstruct
from firenet_jax.simulation.sensor import event_list, random_sensor
from firenet_jax.tensors import normalise, pack, voxelise
from firenet_jax.windows import Windows

HEIGHT, WIDTH = 16, 20


def test_lab_equals_scikit_image():
    rgb = np.random.default_rng(0).random((40, 3)).astype(np.float32)
    rgb[:4] = [[0, 0, 0], [1, 1, 1], [0.01, 0.02, 0.03], [1, 0, 0]]
    expected = rgb2lab(rgb)
    np.testing.assert_allclose(colour.to_lab(rgb), expected, atol=0.02)  # its white has 4 digits
    np.testing.assert_allclose(colour.to_rgb(expected.astype(np.float32)), rgb, atol=2e-4)
    np.testing.assert_allclose(colour.to_rgb(colour.to_lab(rgb)), rgb, atol=1e-4)


def test_channels_are_the_pixels_of_the_mosaic():
    y, x = np.mgrid[:4, :6]
    tensors = np.stack([10 * y + x] * 5, -1)[None]
    red, green, blue = np.asarray(colour.channels(tensors))[0, ..., 0]
    assert red.tolist() == [[0, 2, 4], [20, 22, 24]]
    assert green.tolist() == [[1, 3, 5], [21, 23, 25]]
    assert blue.tolist() == [[11, 13, 15], [31, 33, 35]]


def test_a_rotated_mosaic_has_the_rotated_channels_and_colours():
    rng = np.random.default_rng(2)
    tensors = rng.standard_normal((1, 4, 6, 5))
    found = colour.channels(tensors[:, ::-1, ::-1], rotated=True)
    np.testing.assert_array_equal(found, colour.channels(tensors)[..., ::-1, ::-1, :])
    greys = rng.integers(90, 160, (8, 10)).astype(np.uint8)
    shades = rng.integers(90, 160, (3, 4, 5)).astype(np.uint8)
    found = colour.coloured(greys[::-1, ::-1], shades[:, ::-1, ::-1], rotated=True)
    expected = np.asarray(colour.coloured(greys, shades)).astype(int)
    assert np.abs(np.asarray(found)[::-1, ::-1] - expected).max() <= 1


def test_lightness_is_the_grey_pictures_and_colour_is_interpolated_between_its_pixels():
    rng = np.random.default_rng(1)
    greys = rng.integers(90, 160, (8, 10)).astype(np.uint8)
    shades = rng.integers(90, 160, (3, 4, 5)).astype(np.uint8)
    full = np.zeros((8, 10, 3))
    for channel, (row, column) in enumerate(colour.CORNERS):
        rows = [np.interp(np.arange(10), np.arange(column, 10, 2), r) for r in shades[channel]]
        full[..., channel] = np.stack(
            [np.interp(np.arange(8), np.arange(row, 8, 2), c) for c in np.stack(rows).T], 1
        )
    lab = rgb2lab(full / 255)
    lab[..., 0] = rgb2lab(np.stack([greys] * 3, -1) / 255)[..., 0]
    expected = 255 * np.clip(lab2rgb(lab), 0, 1)
    found = np.asarray(colour.coloured(greys, shades))
    assert found.dtype == np.uint8
    assert np.abs(found - expected).max() <= 0.6


def test_without_colour_the_picture_is_the_grey_one():
    greys = np.random.default_rng(2).integers(0, 256, (6, 8)).astype(np.uint8)
    found = np.asarray(colour.coloured(greys, np.full((3, 3, 4), 77, np.uint8))).astype(int)
    assert np.abs(found - greys[..., None]).max() <= 1


@pytest.mark.parametrize("kind", get_args(Range))
def test_each_channel_is_reconstructed_as_a_recording_of_its_own(kind):
    """Two recordings, in chunks of two windows; expected is one channel after another, at once."""
    rng, weights = np.random.default_rng(3), load_weights()
    windows = [
        [random_events(rng, n + 30 * b, HEIGHT, WIDTH) for b in range(2)]
        for n in (90, 200, 150, 120)
    ]
    size = {"height": HEIGHT, "width": WIDTH}
    settings = Display(range=kind)
    session, found = initial_session(2, HEIGHT, WIDTH, Network(color=True)), []
    for start in (0, 2):
        session, pictures = events_to_pictures(
            weights, session, pack(windows[start : start + 2]), np.ones((2, 2), bool), **size,
            network=Network(color=True), settings=settings,
        )  # fmt: skip
        found.append(pictures)

    tensors = normalise(voxelise(pack(windows), **size))
    seen = []
    raw = Weights(weights.params, normalise=False)
    for part in (tensors, *(tensors[..., r::2, c::2, :] for r, c in colour.CORNERS)):
        images = reconstruct(raw, initial_state(2, *part.shape[2:4]), part)[1]
        seen.append(display(initial_display_state(2), images, settings=settings)[1])
    expected = colour.coloured(seen[0], jnp.stack(seen[1:], 2))
    difference = np.abs(np.concatenate(found).astype(int) - expected)
    assert found[0].shape == (2, 2, HEIGHT, WIDTH, 3)
    assert difference.max() <= 3 and (difference > 0).mean() < 0.01
    assert jax.tree.leaves(session.channels)[0].shape[:2] == (2, 3)


def test_preview_of_colours():
    weights, size = load_weights(), {"height": HEIGHT, "width": WIDTH}
    session = initial_session(1, HEIGHT, WIDTH, Network(color=True))
    packed = pack([[random_events(np.random.default_rng(4), 100, HEIGHT, WIDTH)]])
    args = weights, session, packed, np.ones((1, 1), bool)
    plain = events_to_pictures(*args, **size, network=Network(color=True))[1]
    both = events_to_pictures(*args, **size, network=Network(color=True), preview=True)[1]
    assert both.shape == (1, 1, HEIGHT, 2 * WIDTH, 3)
    np.testing.assert_array_equal(both[..., WIDTH:, :], plain)


@pytest.mark.parametrize("flip", [False, True])
def test_a_red_bar_is_red(tmp_path, flip):
    """Red pixels see a bright bar pass over black ground, green and blue ones see nothing.

    Pictures are stretched, because how bright a bar is that passes depends on the weights.
    """
    height, width, count = 32, 64, 40
    sensor = random_sensor(jax.random.key(0), height=height, width=width)

    def rendering(t):
        image = np.zeros((height, width), np.float32)
        image[::2, max(t - 12, 0) : t] = 0.9
        image[:, 1::2] = 0
        return 1000 * t, image

    events = concatenate(list(event_list(sensor, map(rendering, range(count + 1)))))
    recording = tmp_path / "a.npz"
    t, x, y, p = events.t, events.x, events.y, events.p
    np.savez(recording, t=t, x=x, y=y, p=p)
    run(
        Reconstruct(
            (recording,), tmp_path / "out", windows=Windows(duration=5), warm_up=0, flip=flip,
            network=Network(color=True), display=Display(range="extremes"),
            sensor_size=f"{width}x{height}",
        )
    )  # fmt: skip
    with Image.open(max((tmp_path / "out").glob("*.png"))) as picture:
        last = np.asarray(picture, int)
    last = last[::-1, ::-1] if flip else last
    red, green, blue = np.moveaxis(last, -1, 0)
    bar = slice(4, -4), slice(count - 9, count - 3)
    before = slice(4, -4), slice(count + 10, -2)  # beyond the halo of the bar
    assert min((red - green)[bar].mean(), (red - blue)[bar].mean()) > 15
    # What has seen nothing has a level of its own in each colour, which depends on the weights.
    assert abs((red - blue)[before].mean()) < (red - blue)[bar].mean() / 3


def test_a_mosaic_has_even_sides():
    with pytest.raises(ValueError, match="21x16 cannot be a colour sensor"):
        initial_session(1, 16, 21, Network(color=True))
