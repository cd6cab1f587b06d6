import itertools
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import references_metrics as references
from scipy.ndimage import gaussian_filter
from skimage.metrics import (
    mean_squared_error,
    peak_signal_noise_ratio,
    structural_similarity,
)

from firenet_jax.evaluation import metrics

H, W = 44, 57  # an odd side, three scales of MS-SSIM

SIMILARITIES = {
    "ssim": (metrics.ssim, references.ssim),
    "ms_ssim": (metrics.ms_ssim, references.ms_ssim),
    "haarpsi": (metrics.haarpsi, references.haarpsi),
    "cw_ssim": (metrics.cw_ssim, references.cw_ssim),
    "equalised_ssim": (metrics.equalised_ssim, references.equalised_ssim),
}
DISTANCES = {
    "mse": (metrics.mse, mean_squared_error),
    "l1": (metrics.l1, lambda image, truth: np.abs(image - truth).mean()),
    "centred": (
        metrics.centred,
        lambda image, truth: np.abs((image - image.mean()) - (truth - truth.mean())).mean(),
    ),
    "contrast": (metrics.contrast, lambda image, truth: abs(np.std(image) - np.std(truth))),
    "nlpd": (metrics.nlpd, references.nlpd),
    "gmsd": (metrics.gmsd, references.gmsd),
    "detail": (metrics.detail, references.detail),
    "equalised_mse": (metrics.equalised_mse, references.equalised_mse),
    "random_features": (
        metrics.random_features,
        partial(references.random_features, metrics.random_kernels(0)),
    ),
}
ALL = SIMILARITIES | DISTANCES
BLIND_TO_A_NEGATIVE = {"gmsd", "haarpsi", "cw_ssim", "detail", "contrast"}


def texture(seed, height=H, width=W):
    """Blobs of several sizes between 0 and 1."""
    rng = np.random.default_rng(seed)
    image = sum(s * gaussian_filter(rng.standard_normal((height, width)), s) for s in (1, 2, 5))
    return ((image - image.min()) / np.ptp(image)).astype(np.float32)


NOISY, BLURRED, NEGATIVE = (0, 0), (0, 1), (3, 1)


def cases():
    """Eight pairs, two arrays (4, 2, H, W): all tests use this one shape and compile once."""
    truth = np.stack([texture(seed) for seed in range(8)]).reshape(4, 2, H, W)
    image = truth.copy()
    image[NOISY] += 0.1 * np.random.default_rng(9).standard_normal((H, W))
    image[BLURRED] = gaussian_filter(truth[BLURRED], 2)
    image[1, 0] += 0.1
    image[1, 1] = texture(8)
    image[2, 0] *= 0.5
    image[2, 1] = np.roll(truth[2, 1], 1, axis=1)
    image[3, 0] = 0.4
    image[NEGATIVE] = 1 - truth[NEGATIVE]
    return image, truth


@pytest.mark.parametrize("name", ALL)
def test_equals_the_obvious_version(name):
    """Which is float64 and sees one image at a time: leading axes are nothing but a batch."""
    function, reference = ALL[name]
    image, truth = cases()
    actual = function(image, truth)
    assert actual.dtype == jnp.float32 and actual.shape == (4, 2)
    for i in np.ndindex(4, 2):
        expected = reference(image[i].astype(np.float64), truth[i].astype(np.float64))
        np.testing.assert_allclose(actual[i], expected, atol=1e-5)
    assert jax.eval_shape(function, image[0, 0], truth[0, 0]).shape == ()


@pytest.mark.parametrize("shape", [(11, 11), (96, 96), (180, 240)])
def test_ssim_equals_scikit_image(shape):
    truth = texture(5, *shape)
    image = truth + 0.1 * texture(6, *shape) + np.linspace(0, 0.5, shape[1], dtype=np.float32)
    np.testing.assert_allclose(metrics.ssim(image, truth), references.ssim(image, truth), atol=1e-5)


@pytest.mark.parametrize("sigma, data_range", [(1.5, 255.0), (0.8, 1.0), (2.5, 2.0)])
def test_ssim_with_other_settings(sigma, data_range):
    image, truth = (data_range * picture[NOISY] for picture in cases())
    expected = references.ssim(image, truth, sigma=sigma, data_range=data_range)
    actual = metrics.ssim(image, truth, sigma=sigma, data_range=data_range)
    np.testing.assert_allclose(actual, expected, atol=1e-5)


def test_ssim_of_faint_texture_on_white():
    """Where E x^2 - (E x)^2 in float32 would lose all digits."""
    rng = np.random.default_rng(7)
    image, truth = (1 + 0.003 * rng.standard_normal((2, H, W))).astype(np.float32)
    np.testing.assert_allclose(metrics.ssim(image, truth), references.ssim(image, truth), atol=1e-5)


def test_ssim_where_is_the_mean_of_the_map_there():
    rng = np.random.default_rng(0)
    a, b = rng.random((2, 30, 40)).astype(np.float32)
    there = rng.random((30, 40)) < 0.3
    options = {"gaussian_weights": True, "use_sample_covariance": False, "data_range": 1.0}
    _, whole = structural_similarity(a, b, full=True, **options)
    inner = np.s_[5:-5, 5:-5]
    expected = whole[inner][there[inner]].mean()
    assert abs(float(metrics.ssim_where(a, b, there)) - expected) < 1e-5
    everywhere = metrics.ssim_where(a, b, np.ones((30, 40), bool))
    assert abs(float(everywhere) - float(metrics.ssim(a, b))) < 1e-6
    assert np.isnan(metrics.ssim_where(a, b, np.zeros((30, 40), bool)))


def test_psnr_equals_scikit_image():
    image, truth = cases()
    actual = metrics.psnr(image, truth)
    for i in np.ndindex(4, 2):
        expected = peak_signal_noise_ratio(truth[i], image[i], data_range=1)
        np.testing.assert_allclose(actual[i], expected, rtol=1e-5)
    np.testing.assert_allclose(
        metrics.psnr(255 * image, 255 * truth, data_range=255.0), actual, rtol=1e-5
    )
    assert np.isposinf(metrics.psnr(truth, truth)).all()


def test_ms_ssim_takes_as_many_scales_as_fit():
    sizes = (11, 21, 22, 87, 88, 96, 128, 175, 176, 1000)
    scales = [metrics.ms_ssim_scales(size, 2000) for size in sizes]
    assert scales == [1, 1, 2, 3, 4, 4, 4, 4, 5, 5]
    truth = texture(8, 180, 177)
    image = gaussian_filter(truth, 1)
    expected = references.ms_ssim(image.astype(np.float64), truth.astype(np.float64))
    np.testing.assert_allclose(metrics.ms_ssim(image, truth), expected, atol=1e-5)


@pytest.mark.parametrize(
    "shape", [(17, 19), (33, 40), (40, 34), (67, 70), (70, 68), (136, 141)], ids=str
)
def test_cw_ssim_takes_as_many_scales_as_fit(shape):
    """One below 34 pixels, two below 68, never more than three."""
    truth = texture(8, *shape)
    image = gaussian_filter(truth, 1)
    expected = references.cw_ssim(image.astype(np.float64), truth.astype(np.float64))
    np.testing.assert_allclose(metrics.cw_ssim(image, truth), expected, atol=1e-5)


def test_factors_near_zero_are_continued_by_a_straight_line():
    """From 0.001 down: half as far from 0 is half as much, and below 0 it is 0."""
    power = lambda base: float(metrics._power(jnp.float32(base), 0.3))  # noqa: E731
    for base in (1.0, 0.5, 0.0011, 0.001):
        assert power(base) == pytest.approx(base**0.3, rel=1e-5)
    assert power(0.0005) == pytest.approx(0.5 * 0.001**0.3, rel=1e-5)
    assert power(0.0) == power(-0.5) == 0
    assert jax.grad(lambda base: metrics._power(base, 0.3))(0.0002) == pytest.approx(
        0.001**-0.7, rel=1e-4
    )


def test_a_faint_dot_on_black_is_no_black_image_to_haarpsi():
    """All its weights add up to little."""
    image, truth = np.zeros((2, 16, 16), np.float32)
    image[8:10, 8:10] = 0.1
    expected = references.haarpsi(image.astype(np.float64), truth.astype(np.float64))
    assert 0.1 < expected < 0.9
    np.testing.assert_allclose(metrics.haarpsi(image, truth), expected, atol=1e-5)


@pytest.mark.parametrize("name", ALL)
def test_equal_images(name):
    function, _ = ALL[name]
    truth = cases()[1]
    levels = np.linspace(0, 1, 8, dtype=np.float32).reshape(4, 2, 1, 1)
    flat = np.broadcast_to(levels, truth.shape)
    perfect = 1 if name in SIMILARITIES else 0
    for picture in (truth, flat):
        np.testing.assert_allclose(function(picture, picture), perfect, atol=2e-6)


@pytest.mark.parametrize("name", ALL)
def test_a_negative(name):
    """The blind ones find it as good as the image, the others worse than all else."""
    function, _ = ALL[name]
    values = np.asarray(function(*cases()))
    blurred, negative = values[BLURRED], values[NEGATIVE]
    if name in BLIND_TO_A_NEGATIVE - {"haarpsi"}:
        np.testing.assert_allclose(negative, float(name in SIMILARITIES), atol=1e-5)
    elif name == "haarpsi":  # the zeros beyond the border give it away
        assert blurred < negative < 1
    elif name in SIMILARITIES:
        assert negative <= 0 < blurred
    else:
        assert negative > 3 * blurred


def test_gmsd_is_blind_to_any_offset_and_nlpd_is_not():
    _, truth = cases()
    np.testing.assert_allclose(metrics.gmsd(truth + 0.3, truth), 0, atol=1e-5)
    assert (metrics.nlpd(truth + 0.3, truth) > 0.05).all()
    dark, bright = (np.full((H, W), value, np.float32) for value in (0.2, 0.7))
    assert metrics.nlpd(dark, bright) > 0.05


def test_equalised_ssim_ignores_tone_and_sees_faint_texture():
    _, truth = cases()
    toned = 0.1 + 0.8 * truth**0.7
    lost, kept = (1 - function(toned, truth) for function in (metrics.ssim, metrics.equalised_ssim))
    assert (kept < 0.35 * lost).all()
    faint, flat = 0.5 + 0.05 * (truth - 0.5), np.full_like(truth, 0.5)
    assert (metrics.ssim(flat, faint) > 0.9).all()  # its constants hide what is lost
    assert (metrics.equalised_ssim(flat, faint) < 0.6).all()


def test_detail_asks_how_much_there_is_and_not_where():
    """Strokes in the wrong places are better than none; L1 says the opposite."""
    truth, other = (np.float32(np.random.default_rng(seed).random((H, W)) > 0.9) for seed in (1, 2))
    blurred = gaussian_filter(truth, 3)
    assert metrics.detail(other, truth) < 0.3 * metrics.detail(blurred, truth)
    assert metrics.l1(other, truth) > metrics.l1(blurred, truth)
    np.testing.assert_allclose(metrics.detail(other + 0.3, other), 0, atol=1e-5)


def extremes():
    """Eight pairs that divide by zero if anything does, (4, 2, H, W) each."""
    truth = texture(10)
    zero, grey, white = (np.full((H, W), value, np.float32) for value in (0, 0.5, 1))
    edge = np.float32(np.arange(W) > 20) * white
    tiny = 1e-20 * texture(11)
    images = [truth, zero, grey, white, edge, zero, tiny, 1 - edge]
    truths = [truth, zero, grey, grey, edge, truth, zero, edge]
    return np.stack(images).reshape(4, 2, H, W), np.stack(truths).reshape(4, 2, H, W)


@cache
def gradients(name):
    """With respect to the image, compiled once for the tests below."""
    function = metrics.psnr if name == "psnr" else ALL[name][0]
    return jax.jit(jax.grad(lambda *pair: function(*pair).sum()))


@pytest.mark.parametrize("name", [*ALL, "psnr"])
def test_gradients_are_finite_everywhere(name):
    image, truth = extremes()
    for pair in ((image, truth), (truth, image), (image, image)):
        assert np.isfinite(gradients(name)(*pair)).all()


@pytest.mark.parametrize("name", ALL)
def test_gradient_is_the_slope_of_the_obvious_version(name):
    _, reference = ALL[name]
    image, truth = cases()
    gradient = np.asarray(gradients(name)(image, truth), np.float64)
    direction = texture(12).astype(np.float64)
    step = 1e-5
    for i in (NOISY, BLURRED):  # away from where the images agree, which is a kink
        a, b = image[i].astype(np.float64), truth[i].astype(np.float64)
        slope = reference(a + step * direction, b) - reference(a - step * direction, b)
        np.testing.assert_allclose((gradient[i] * direction).sum(), slope / (2 * step), rtol=0.01)


def moving(displacement, visible=None):
    """Two textures that have nothing to do with each other, two images of them, and a flow."""
    image, previous, truth, previous_truth = (texture(seed, 12, 15) for seed in range(20, 24))
    truth = previous_truth + 0.1 * truth
    visible = np.ones((12, 15), bool) if visible is None else visible
    return image, previous, np.float32(displacement), truth, previous_truth, visible


def test_temporal_error_equals_the_obvious_version():
    rng = np.random.default_rng(25)
    arguments = moving(rng.normal(0, 2, (12, 15, 2)), rng.random((12, 15)) < 0.8)
    expected = references.temporal_error(*arguments)
    np.testing.assert_allclose(metrics.temporal_error(*arguments), expected, atol=1e-6)
    batch = [np.stack([argument, argument[::-1]]) for argument in arguments]
    reverse = references.temporal_error(*(argument[::-1] for argument in arguments))
    np.testing.assert_allclose(metrics.temporal_error(*batch), [expected, reverse], atol=1e-6)


def test_temporal_error_is_exact_at_half_a_pixel():
    previous = texture(26)
    image = previous.copy()
    image[:, 1:] = (previous[:, 1:] + previous[:, :-1]) / 2
    half = np.broadcast_to(np.float32([0.5, 0]), (H, W, 2))
    assert metrics.temporal_error(image, previous, half, image, previous) < 1e-7
    # in the other direction, or by a whole pixel, it is not
    for wrong in (-half, 2 * half):
        assert metrics.temporal_error(image, previous, wrong, image, previous) > 1e-3


def waves(shift_x, shift_y):
    """A smooth picture of several waves, moved by so many pixels."""
    y, x = np.mgrid[:H, :W]
    x, y = x - shift_x, y - shift_y
    return np.float32(0.5 + 0.2 * np.sin(0.15 * x + 0.1 * y) + 0.2 * np.sin(0.13 * y - 0.1 * x))


@pytest.mark.parametrize("shift", [(0.5, 0.5), (1.3, -0.7), (-3.0, 2.25)])
def test_temporal_error_of_a_moving_picture_is_small(shift):
    image, previous = waves(*shift), waves(0, 0)
    displacement = np.broadcast_to(np.float32(shift), (H, W, 2))
    assert metrics.temporal_error(image, previous, displacement, image, previous) < 1e-3
    flicker = metrics.temporal_error(image + 0.1, previous, displacement, image, previous)
    share_inside = (1 - abs(shift[0]) / W) * (1 - abs(shift[1]) / H)
    np.testing.assert_allclose(flicker, 0.1 * share_inside, atol=5e-3)


def test_what_is_occluded_or_moves_in_does_not_count():
    image, previous, truth, previous_truth = (texture(seed) for seed in range(27, 31))
    visible = np.ones((H, W), bool)
    visible[10:20, 5:30] = False
    displacement = np.zeros((H, W, 2), np.float32)
    displacement[:, :3, 0] = 5  # looked up outside the picture
    arguments = previous, displacement, truth, previous_truth, visible
    expected = metrics.temporal_error(image, *arguments)
    assert expected > 0
    image = image.copy()
    image[10:20, 5:30] = 9
    image[:, :3] = 9
    displacement[10:20, 5:30] = np.nan
    np.testing.assert_allclose(metrics.temporal_error(image, *arguments), expected, rtol=1e-6)
    gradient = jax.grad(metrics.temporal_error, (0, 1))(image, *arguments)
    assert all(np.isfinite(part).all() for part in gradient)
    assert not np.asarray(gradient[0])[10:20, 5:30].any()


def test_where_the_truth_does_not_follow_the_flow_hardly_anything_counts():
    still = np.zeros((H, W, 2), np.float32)
    ones = np.ones((H, W), np.float32)
    for change, weight in [(0.0, 1.0), (0.1, np.exp(-0.5)), (1.0, np.exp(-50))]:
        error = metrics.temporal_error(ones, 0.5 * ones, still, change * ones, 0 * ones)
        np.testing.assert_allclose(error, 0.5 * weight, rtol=1e-5)


def test_the_random_network_depends_on_the_seed_alone():
    first, again, other = (metrics.random_kernels(seed) for seed in (0, 0, 1))
    for a, b, c in zip(first, again, other, strict=True):
        np.testing.assert_array_equal(a, b)
        assert (a != c).all()
    # the first numbers of numpy's first generator, as everywhere
    expected = np.sqrt(2 / 36) * np.array([1.764052, 0.400157, 0.978738])
    np.testing.assert_allclose(first[0][0, 0, 0, :3], expected, rtol=1e-6)


@pytest.mark.parametrize("name", ["mse", "ssim", "gmsd"])
def test_jitted_equals_eager_and_other_images_do_not_recompile(name):
    function, _ = ALL[name]
    image, truth = cases()
    function.clear_cache()
    compiled = function(image, truth)
    function(image + 1, truth)
    assert function._cache_size() == 1
    with jax.disable_jit():
        np.testing.assert_allclose(function(image, truth), compiled, atol=1e-6)


def test_wrong_sizes_are_refused():
    with pytest.raises(ValueError, match="cannot be compared"):
        metrics.mse(np.zeros((4, 5)), np.zeros((2, 4, 5)))
    with pytest.raises(ValueError, match="cannot be compared"):
        metrics.mse(np.zeros(4), np.zeros(4))
    with pytest.raises(ValueError, match="11"):
        metrics.ssim(np.zeros((10, 30)), np.zeros((10, 30)))
    with pytest.raises(ValueError, match="MS-SSIM needs"):
        metrics.ms_ssim(np.zeros((10, 30)), np.zeros((10, 30)))
    for function, least in ((metrics.cw_ssim, 17), (metrics.random_features, 8)):
        assert np.isfinite(function(np.zeros((least, 30)), np.ones((least, 30))))
        small = np.zeros((least - 1, 30))
        with pytest.raises(
            ValueError, match=f"{least}x{least} pixels at least, not 30x{least - 1}"
        ):
            function(small, small)


def shifted(picture, pixels):
    """Moved to the right by a part of a pixel, by the Fourier shift theorem."""
    ramp = np.exp(-2j * np.pi * np.fft.fftfreq(picture.shape[1]) * pixels)
    return np.float32(np.fft.ifft(np.fft.fft(picture, axis=1) * ramp, axis=1).real)


def test_event_correlation_equals_least_squares_block_by_block():
    rng = np.random.default_rng(13)
    image, votes = texture(14), np.float32(rng.integers(-2, 3, (H, W)))
    smooth, events = (gaussian_filter(np.float64(a), 0.7, radius=3) for a in (image, votes))
    slopes = np.pad(smooth, 1, "edge")
    slopes = (slopes[2:, 1:-1] - slopes[:-2, 1:-1], slopes[1:-1, 2:] - slopes[1:-1, :-2])
    fit = total = 0.0
    for top in range(0, H - 13, 14):
        for left in range(0, W - 13, 14):
            block = np.s_[top : top + 14, left : left + 14]
            matrix = np.stack([slope[block].ravel() for slope in slopes], -1)
            velocity = np.linalg.lstsq(matrix, events[block].ravel())[0]
            fit += ((matrix @ velocity) ** 2).sum()
            total += (events[block] ** 2).sum()
    flat = jax.grad(lambda image: metrics.event_correlation(image, votes).sum())
    assert np.isfinite(flat(np.zeros_like(image))).all() and np.isfinite(flat(image)).all()
    actual = metrics.event_correlation(np.stack([image, 1 - 3 * image]), np.stack([votes] * 2))
    np.testing.assert_allclose(actual, (fit / total) ** 0.5, rtol=1e-3)
    faint = metrics.event_correlation(np.stack([image] * 2), 1e-3 * np.stack([votes, -votes]))
    np.testing.assert_allclose(faint, (fit / total) ** 0.5, rtol=1e-3)


@pytest.mark.parametrize("angle", [0.3, 0.9, 2.2])
def test_event_correlation_before_straight_edges(angle):
    """All slopes of a block have one direction, the best velocity is hardly determined, and what
    it explains is."""
    y, x = np.mgrid[:56, :70]
    across = np.cos(angle) * x + np.sin(angle) * y
    image, votes = 0.5 + 0.4 * np.sin(across / 3), np.cos(across / 3)
    found = metrics.event_correlation(np.float32(image), np.float32(votes))
    smooth, events = (gaussian_filter(a, 0.7, radius=3) for a in (image, votes))
    slopes = np.pad(smooth, 1, "edge")
    slopes = np.stack([slopes[2:, 1:-1] - slopes[:-2, 1:-1], slopes[1:-1, 2:] - slopes[1:-1, :-2]])
    fit = 0.0
    for top, left in itertools.product(range(0, 56, 14), range(0, 70, 14)):
        block = np.s_[top : top + 14, left : left + 14]
        matrix = slopes[:, *block].reshape(2, -1).T / 2
        normal = matrix.T @ matrix
        normal += np.eye(2) * (1e-6 * np.trace(normal) + 1e-9)
        by_votes = matrix.T @ events[block].ravel()
        fit += by_votes @ np.linalg.solve(normal, by_votes)
    assert float(found) == pytest.approx((fit / (events**2).sum()) ** 0.5, abs=2e-5)


@pytest.mark.parametrize("turned", [False, True])
def test_a_slope_a_thousandth_of_the_other_explains_hardly_any_events(turned):
    """To the squares of both are added a millionth of their sum: here as much as is there."""
    y, x = np.mgrid[:56, :56]
    slope, small = 3.0, 3e-3 * np.sqrt(2) / 0.92  # of which blur and differences leave 0.92
    wave = 2 * np.pi * y / 14
    image, votes = slope * (x - 28) + small * 14 / (2 * np.pi) * np.sin(wave), np.cos(wave)
    pair = (image.T, votes.T) if turned else (image, votes)
    found = metrics.event_correlation(*(np.float32(picture) for picture in pair))
    assert float(found) == pytest.approx(np.sqrt(0.5), abs=0.02)


def test_event_correlation_prefers_the_image_that_moved():
    """To its blurred, its noisy and its displaced version, and to one that is something else."""
    noise = np.random.default_rng(15).standard_normal((3, 84, 98))
    image, other = gaussian_filter(noise[:2], (0, 1.5, 1.5), mode="wrap")
    votes = shifted(image, 0.25) - shifted(image, -0.25)
    noisy = image + 0.7 * image.std() * noise[2]
    others = [gaussian_filter(image, 2, mode="wrap"), noisy, np.roll(image, 2, 0), other]
    others = np.float32(np.stack([image, *others]))
    own, *worse, chance = metrics.event_correlation(others, np.stack([votes] * 5))
    assert own > 0.99
    assert (np.array(worse) < 0.9).all() and (np.array(worse) > chance).all()
    assert chance < 0.5
    blank = np.zeros_like(image)
    assert metrics.event_correlation(blank, votes) < 1e-3
    assert metrics.event_correlation(image, blank) == 0
    with pytest.raises(ValueError, match="14x14 pixels at least"):
        metrics.event_correlation(image[:13], votes[:13])
