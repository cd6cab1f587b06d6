import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from skimage import exposure
from skimage.filters import rank
from skimage.morphology import disk

from firenet_jax.evaluation.equalise import equalise

ALL = ["none", "global", "local", "clahe"]
SIZES = [(180, 240), (64, 96), (64, 90), (61, 96), (45, 59), (17, 10)]


def picture(height, width, seed=0):
    """Blobs and noise between 0.1 and 0.8, uint8."""
    rng = np.random.default_rng(seed)
    image = gaussian_filter(rng.standard_normal((height, width)), 4)
    image += 0.02 * rng.standard_normal((height, width))
    image = 0.1 + 0.7 * (image - image.min()) / np.ptp(image)
    return np.rint(255 * image).astype(np.uint8)


def images(height, width, seed=0):
    """What becomes that picture when it is rounded, float32."""
    noise = np.random.default_rng(seed + 1).uniform(-0.4, 0.4, (height, width))
    return np.float32((picture(height, width, seed) + noise) / 255)


def slow_clahe(image, clip=2.0, tiles=8):
    """OpenCV's algorithm a pixel at a time: uint8 -> uint8."""
    height, width = image.shape
    rows, columns = height, width
    if height % 8 != 0 or width % 8 != 0:
        rows, columns = height + 8 - height % 8, width + 8 - width % 8

    def mirrored(i, size):
        while not 0 <= i < size:
            i = -i if i < 0 else 2 * (size - 1) - i
        return i

    h, w = rows // tiles, columns // tiles
    limit = max(int(clip * h * w / 256), 1)
    tables = {}
    for j in range(tiles):
        for i in range(tiles):
            histogram = [0] * 256
            for y in range(j * h, (j + 1) * h):
                for x in range(i * w, (i + 1) * w):
                    histogram[image[mirrored(y, height), mirrored(x, width)]] += 1
            excess = 0
            for level in range(256):
                if histogram[level] > limit:
                    excess += histogram[level] - limit
                    histogram[level] = limit
            histogram = [count + excess // 256 for count in histogram]
            left = excess % 256
            level = 0
            while left > 0:
                histogram[level] += 1
                level += max(256 // (excess % 256), 1)
                left -= 1
            total, scale = 0, np.float32(255) / np.float32(h * w)
            for level in range(256):
                total += histogram[level]
                tables[j, i, level] = np.float32(round(float(np.float32(total) * scale)))

    one, half = np.float32(1), np.float32(0.5)
    result = np.zeros_like(image)
    for y in range(height):
        v = np.float32(y) * (one / np.float32(h)) - half
        j = int(np.floor(v))
        b = v - np.float32(j)
        for x in range(width):
            u = np.float32(x) * (one / np.float32(w)) - half
            i = int(np.floor(u))
            a = u - np.float32(i)
            top, bottom = max(j, 0), min(j + 1, tiles - 1)
            left, right = max(i, 0), min(i + 1, tiles - 1)
            level = image[y, x]
            upper = tables[top, left, level] * (one - a) + tables[top, right, level] * a
            lower = tables[bottom, left, level] * (one - a) + tables[bottom, right, level] * a
            result[y, x] = round(float(upper * (one - b) + lower * b))
    return result


@pytest.mark.parametrize("size", SIZES)
def test_global_equals_scikit_image(size):
    expected = exposure.equalize_hist(picture(*size))
    np.testing.assert_allclose(equalise(images(*size), "global"), expected, atol=1e-5)


@pytest.mark.parametrize("size", SIZES)
def test_local_equals_scikit_image(size):
    expected = rank.equalize(picture(*size), disk(55)) / 255
    np.testing.assert_allclose(equalise(images(*size), "local"), expected, atol=1e-5)


def test_local_is_the_share_of_the_surroundings_that_is_not_brighter():
    image = picture(70, 130)
    y, x = np.mgrid[:70, :130]
    local = equalise(images(70, 130), "local")
    for row, column in [(0, 0), (0, 129), (35, 60), (69, 1), (60, 56), (20, 100)]:
        near = image[(y - row) ** 2 + (x - column) ** 2 <= 55**2]
        share = (near <= image[row, column]).mean()
        assert local[row, column] == pytest.approx(np.floor(255 * share) / 255, abs=1e-6)


@pytest.mark.parametrize("size", SIZES)
def test_clahe_equals_a_pixel_at_a_time(size):
    expected = slow_clahe(picture(*size))
    assert np.ptp(expected) > 100
    np.testing.assert_allclose(equalise(images(*size), "clahe"), expected / 255, atol=1e-6)


@pytest.mark.parametrize("level", [0, 100, 255])
@pytest.mark.parametrize("size", [(24, 32), (20, 30)])
def test_clahe_of_a_flat_image(size, level):
    image = np.full(size, level, np.uint8)
    expected = slow_clahe(image)
    np.testing.assert_allclose(equalise(image / 255, "clahe"), expected / 255, atol=1e-6)
    assert np.ptp(expected) == 0


def test_clahe_by_hand():
    """Tiles of 16x16 with the levels 0 to 255 once each: all tables are (level + 1) 255 / 256."""
    tile = np.random.default_rng(0).permutation(256).reshape(16, 16)
    image = np.tile(tile, (8, 8))
    expected = np.rint((image + 1) * 255 / 256)
    np.testing.assert_allclose(equalise(image / 255, "clahe"), expected / 255, atol=1e-6)


@pytest.mark.parametrize("kind", ["global", "local"])
def test_a_flat_image_is_white(kind):
    np.testing.assert_array_equal(equalise(np.full((9, 12), 0.3), kind), 1)


def test_none_clips_and_does_not_round():
    image = np.float32([[-0.5, 0.1234567], [0.5, 1.5]])
    np.testing.assert_array_equal(equalise(image, "none"), np.float32([[0, 0.1234567], [0.5, 1]]))
    assert image[0, 0] == -0.5


@pytest.mark.parametrize("kind", ALL)
def test_leading_axes_are_a_batch(kind):
    batch = np.stack([images(20, 24, seed) for seed in range(4)]).reshape(2, 2, 20, 24)
    result = equalise(batch, kind)
    assert result.shape == batch.shape and result.dtype == np.float32
    assert result.min() >= 0 and result.max() <= 1
    for place in np.ndindex(2, 2):
        np.testing.assert_array_equal(equalise(jnp.asarray(batch[place]), kind), result[place])
    assert equalise(batch[:0], kind).shape == (0, 2, 20, 24)


@pytest.mark.parametrize("kind", ALL)
def test_beyond_0_and_1_is_clipped(kind):
    image = 3 * images(20, 24) - 1
    np.testing.assert_array_equal(equalise(image, kind), equalise(np.clip(image, 0, 1), kind))


def test_what_cannot_be_equalised_is_refused():
    with pytest.raises(ValueError, match="unknown equalisation 'locale'; choose one of none, glo"):
        equalise(np.zeros((4, 5)), "locale")
    with pytest.raises(ValueError, match="rows and columns"):
        equalise(np.zeros(5), "global")
    with pytest.raises(ValueError, match="nan"):
        equalise(np.full((4, 5), np.nan), "local")
