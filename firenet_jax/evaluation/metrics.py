"""Image, ground truth -> MSE, PSNR, SSIM, perceptual distances, temporal error.

Images are (..., H, W) float32, nominally 0 to 1 and not clipped here; image and ground truth have
the same shape. Leading axes are a batch: every function returns one number for each of its
entries, (...,) float32.

    distances, 0 if equal       mse  l1  nlpd  gmsd  detail  random_features  temporal_error
    similarities, 1 if equal    ssim  ms_ssim  haarpsi  cw_ssim  equalised_ssim;   psnr is in dB
    without a ground truth      event_correlation

gmsd, haarpsi, cw_ssim and detail are invariant to inverted contrast: used alone they accept
pictures with inverted polarity. All gradients are finite, for equal, flat and zero images too.

Every linear filter here is separable and applied as two matrices that include borders and
decimation: rows @ image @ columns.T. On XLA's CPU backend (40 images of 96x96, SSIM with its
gradient, two cores) that takes 5 to 8 ms. Sums of shifted images take 85 to 400, because the
compiler fuses one pass into the other and recomputes it for each tap; convolutions of one channel
take 320 to 350.
"""

import functools
import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from firenet_jax.convolution import DIMENSIONS
from firenet_jax.errors import SettingsError
from firenet_jax.warp import warp

Border = Literal["valid", "symmetric", "constant", "edge"]

# image, kernel, strides, padding -> image; in full float32 even if the default is less (TF32)
exactly_convolved = partial(
    jax.lax.conv_general_dilated, dimension_numbers=DIMENSIONS, precision="highest"
)


def _matrix(size: int, weights, border: Border = "valid", stride: int = 1) -> np.ndarray:
    """(outputs, size) float32: the matrix that correlates `size` pixels with the weights.

    border: "valid" keeps the positions where all weights are inside the image; the others are modes
    of numpy.pad and keep the size (an even number of weights reaches one farther back).
    """
    padded = np.eye(size)
    taps = len(weights)
    if border != "valid":
        padded = np.pad(padded, ((taps // 2, (taps - 1) // 2), (0, 0)), border)
    outputs = len(padded) - taps + 1
    if outputs < 1:
        raise SettingsError(f"a side of {size} pixels is too small for a filter of {taps}")
    shifted = (weight * padded[k : k + outputs] for k, weight in enumerate(weights))
    matrix = sum(shifted, np.zeros((outputs, size)))
    return matrix[::stride].astype(np.float32)


def _apply(image: jax.Array, rows: np.ndarray, columns: np.ndarray) -> jax.Array:
    """rows @ image @ columns.T, in full float32 even if the default is less (TF32)."""
    image = jnp.einsum("ih,...hw->...iw", rows, image, precision="highest")
    return jnp.einsum("...hw,jw->...hj", image, columns, precision="highest")


def _filter(image: jax.Array, down, across, border: Border = "valid", stride: int = 1) -> jax.Array:
    """Correlates the image with the outer product of two lists of weights."""
    height, width = image.shape[-2:]
    return _apply(
        image, _matrix(height, down, border, stride), _matrix(width, across, border, stride)
    )


def _halved(image: jax.Array) -> jax.Array:
    """Means of 2x2 pixels; a last odd row or column is left out."""
    return _filter(image, (0.5, 0.5), (0.5, 0.5), stride=2)


def _gaussian(sigma: float, radius: int) -> np.ndarray:
    weights = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    return weights / weights.sum()


def root(x: jax.Array) -> jax.Array:
    """The square root, with gradient 0 instead of infinity at 0."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def _mean(values: jax.Array) -> jax.Array:
    return values.mean((-2, -1))


def _deviation(values: jax.Array) -> jax.Array:
    return root(_mean((values - _mean(values)[..., None, None]) ** 2))


def _compared(image: jax.Array, truth: jax.Array) -> tuple[jax.Array, jax.Array]:
    image, truth = jnp.asarray(image, jnp.float32), jnp.asarray(truth, jnp.float32)
    if image.shape != truth.shape or image.ndim < 2:
        raise ValueError(f"an image {image.shape} cannot be compared with a truth {truth.shape}")
    return image, truth


def _measure(function: Callable[[jax.Array, jax.Array], jax.Array]):
    """Compiled, of an image and a truth that `_compared` has checked."""
    checked = functools.wraps(function)(lambda image, truth: function(*_compared(image, truth)))
    return jax.jit(checked)


@_measure
def mse(image: jax.Array, truth: jax.Array) -> jax.Array:
    """mean (I - G)^2."""
    return _mean((image - truth) ** 2)


@_measure
def l1(image: jax.Array, truth: jax.Array) -> jax.Array:
    """mean |I - G|."""
    return _mean(jnp.abs(image - truth))


@_measure
def centred(image: jax.Array, truth: jax.Array) -> jax.Array:
    """Mean absolute difference after subtracting each image's mean, as events carry no absolute
    brightness. Sees a negative.
    """
    difference = image - truth
    return _mean(jnp.abs(difference - _mean(difference)[..., None, None]))


@_measure
def contrast(image: jax.Array, truth: jax.Array) -> jax.Array:
    """Difference of the standard deviations over all pixels. Blind to a negative and to positions.

    Distances that are minimal at the mean favour grey wherever a network is unsure; this one
    rewards as much contrast as the truth has.
    """
    return jnp.abs(_deviation(image) - _deviation(truth))


@partial(jax.jit, static_argnames="data_range")
def psnr(image: jax.Array, truth: jax.Array, *, data_range: float = 1.0) -> jax.Array:
    """10 log10(range^2 / MSE) in dB; infinite, with gradient 0, for equal images."""
    error = mse(image, truth)
    differ = error > 0
    ratio = data_range**2 / jnp.where(differ, error, 1.0)
    return jnp.where(differ, 10 * jnp.log10(ratio), jnp.inf)


def _ssim_factors(image, truth, sigma, data_range) -> tuple[jax.Array, jax.Array]:
    """The two maps whose product is SSIM: luminance l, contrast times structure cs.

    From sum s = I + G and difference d = I - G, so that equal images give exactly 1:
    4 cov = v_s - v_d,  2 (v_I + v_G) = v_s + v_d,  and the same for the products of the means.
    """
    weights = _gaussian(sigma, radius=int(3.5 * sigma + 0.5))
    c1, c2 = 2 * (0.01 * data_range) ** 2, 2 * (0.03 * data_range) ** 2
    middle = data_range  # of s; subtracting it leaves variances unchanged, but more accurate
    s, d = image + truth - middle, image - truth
    mean_s, mean_d, square_s, square_d = (
        _filter(map_, weights, weights) for map_ in (s, d, s**2, d**2)
    )
    variance_s, variance_d = square_s - mean_s**2, square_d - mean_d**2
    cs = (variance_s - variance_d + c2) / (variance_s + variance_d + c2)
    square_s, square_d = (mean_s + middle) ** 2, mean_d**2
    return (square_s - square_d + c1) / (square_s + square_d + c1), cs


@partial(jax.jit, static_argnames=("sigma", "data_range"))
def ssim(
    image: jax.Array, truth: jax.Array, *, sigma: float = 1.5, data_range: float = 1.0
) -> jax.Array:
    """Structural similarity (Wang et al. 2004), -1 to 1; sees a negative (it becomes negative).

    mean (2 m_I m_G + C1)(2 cov + C2) / ((m_I^2 + m_G^2 + C1)(v_I + v_G + C2)), with means,
    variances and covariance under a Gaussian window cut at 3.5 sigma (11x11 pixels for 1.5),
    C1 = (0.01 range)^2, C2 = (0.03 range)^2, over the places where the window is inside the
    image. Equals skimage's structural_similarity with gaussian_weights=True and
    use_sample_covariance=False.
    """
    luminance, cs = _ssim_factors(*_compared(image, truth), sigma, data_range)
    return _mean(luminance * cs)


@jax.jit
def ssim_where(image: jax.Array, truth: jax.Array, there: jax.Array) -> jax.Array:
    """The mean of `ssim` over the windows whose centre is `there`, (..., H, W) bool; NaN if there
    is none."""
    luminance, cs = _ssim_factors(*_compared(image, truth), 1.5, 1.0)
    margin = WINDOW // 2
    there = there[..., margin:-margin, margin:-margin]
    return (luminance * cs * there).sum((-2, -1)) / there.sum((-2, -1))


SCALES = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
WINDOW = 11  # pixels of the window of SSIM at sigma 1.5
CW_SSIM_SIDE = 17  # pixels of the least side, so that there are 4x4 responses


def ms_ssim_scales(height: int, width: int) -> int:
    """How many of the five scales have room for the window: 5 from 176 pixels on, 4 from 88."""
    return sum(min(height, width) >> scale >= WINDOW for scale in range(len(SCALES)))


def _check_sides(image: jax.Array, least: int, needs: str) -> None:
    """Raises SettingsError for an image with a side of fewer pixels."""
    height, width = image.shape[-2:]
    if min(height, width) < least:
        raise SettingsError(f"{needs} {least}x{least} pixels at least, not {width}x{height}")


@_measure
def ms_ssim(image: jax.Array, truth: jax.Array) -> jax.Array:
    """Multi-scale SSIM (Wang, Simoncelli, Bovik 2003), 0 to 1; sees a negative (it becomes 0).

    mean(l_M cs_M)^w_M prod_{j<M} mean(cs_j)^w_j, halving the images by 2x2 means from scale to
    scale. Small images have fewer scales, whose weights are scaled to sum to 1.
    A factor below 0.001 is continued by a straight line and is 0 below 0, so that gradients stay
    finite. The gradient is 0 if one scale is anti-correlated: training that may start there needs
    another term as well.
    """
    scales = ms_ssim_scales(*image.shape[-2:])
    _check_sides(image, WINDOW, "MS-SSIM needs")
    weights = np.array(SCALES[:scales]) / sum(SCALES[:scales])
    product = jnp.ones(image.shape[:-2], jnp.float32)
    for scale, weight in enumerate(weights.tolist()):
        luminance, cs = _ssim_factors(image, truth, 1.5, 1.0)
        last = scale == scales - 1
        product *= _power(_mean(luminance * cs if last else cs), weight)
        if not last:
            image, truth = _halved(image), _halved(truth)
    return product


RANKED = 12  # rows and columns of the pixels with which every pixel is compared
FAINT = 0.05  # a pixel that is brighter by half of this is brighter for sure
TONES = np.linspace(-0.1, 1.1, 97, dtype=np.float32)  # beyond, as the first and the last


@_measure
def equalised_ssim(image: jax.Array, truth: jax.Array) -> jax.Array:
    """SSIM after a soft histogram equalisation of both images, -1 to 1; sees a negative.

    A pixel becomes the share of the image that is darker than it: the mean over 12x12 evenly spaced
    pixels q of (I - I_q) / 0.05 + 1/2, clipped to 0 to 1. Monotonic changes of brightness hardly
    matter, and texture down to a contrast of about 0.03 counts as much as strong texture. It is a
    global, differentiable version of what papers measure when they equalise (`equalise`) before
    SSIM.
    """
    return ssim(_equalised(image), _equalised(truth))


@_measure
def equalised_mse(image: jax.Array, truth: jax.Array) -> jax.Array:
    """Mean squared difference after the soft histogram equalisation of `equalised_ssim`."""
    return mse(_equalised(image), _equalised(truth))


def _equalised(image: jax.Array) -> jax.Array:
    """The shares of 97 tones are looked up and interpolated: with its gradient on a CPU four times
    as fast as to compare each pixel with all others."""
    rows, columns = (
        ((np.arange(RANKED) + 0.5) * side / RANKED).astype(int) for side in image.shape[-2:]
    )
    others = image[..., rows[:, None], columns].reshape(-1, 1, RANKED**2)
    shares = jnp.clip((TONES[None, :, None] - others) / FAINT + 0.5, 0, 1).mean(-1)
    rises = jnp.pad(jnp.diff(shares), ((0, 0), (0, 1)))

    count, (first, last) = len(TONES), TONES[[0, -1]]
    place = (image.reshape(len(others), -1) - first) * ((count - 1) / (last - first))
    place = jnp.clip(place, 0, count - 1)
    below = jnp.floor(place)
    index = below.astype(jnp.int32) + count * np.arange(len(others), dtype=np.int32)[:, None]

    def at_index(table):
        return table.ravel().at[index].get(mode="promise_in_bounds")

    return (at_index(shares) + (place - below) * at_index(rises)).reshape(image.shape)


def _power(base: jax.Array, exponent: float) -> jax.Array:
    """base^exponent; below 0.001 the straight line to 0 at 0, below 0 it stays 0."""
    least = 1e-3
    line = jnp.maximum(base, 0.0) * least ** (exponent - 1)
    return jnp.where(base > least, jnp.maximum(base, least) ** exponent, line)


@_measure
def gmsd(image: jax.Array, truth: jax.Array) -> jax.Array:
    """Gradient magnitude similarity deviation (Xue et al. 2014), 0 to 0.5.

    The standard deviation of (2 m_I m_G + c) / (m_I^2 + m_G^2 + c), m the magnitude of Prewitt's
    gradient after halving by 2x2 means, c = 170 / 255^2. Unlike in the original, the image's border
    does not count. Blind to a negative and to any offset: gmsd(1 - I, I) = 0. As a deviation it is
    also blind to errors that are the same everywhere.
    """
    image, truth = (_gradient_magnitude(_halved(picture)) for picture in (image, truth))
    constant = 170 / 255**2
    return _deviation((2 * image * truth + constant) / (image**2 + truth**2 + constant))


def _gradient_magnitude(image: jax.Array) -> jax.Array:
    mean, difference = (1 / 3, 1 / 3, 1 / 3), (1, 0, -1)
    return root(_filter(image, mean, difference) ** 2 + _filter(image, difference, mean) ** 2)


@_measure
def haarpsi(image: jax.Array, truth: jax.Array) -> jax.Array:
    """Haar wavelet perceptual similarity (Reisenhofer et al. 2018), 0 to 1.

    After halving by 2x2 means, a_1, a_2, a_3 are the coefficients of Haar filters of 2, 4 and 8
    pixels, zeros beyond the border, for two orientations o:

        S_o = 1/2 sum_{j=1,2} (2 |a_j||b_j| + C) / (a_j^2 + b_j^2 + C),  W_o = max(|a_3|, |b_3|)
        (logit( sum sigmoid(alpha S) W / sum W ) / alpha)^2,  C = 30 / 255^2, alpha = 4.2

    (logit(p / (p + q)) is log(p / q), here with q = sum sigmoid(-alpha S) W.)

    Blind to a negative, except at the border, because of the zero padding. (The authors' program
    halves with blocks that begin one pixel earlier.)
    """
    constant, alpha = 30 / 255**2, 4.2
    image, truth = _halved(image), _halved(truth)
    p, q = 0.0, 0.0
    for a, b in zip(_haar(image), _haar(truth), strict=True):  # two orientations
        similarity = sum(
            (2 * jnp.abs(a[j] * b[j]) + constant) / (a[j] ** 2 + b[j] ** 2 + constant) / 2
            for j in (0, 1)
        )
        weight = jnp.maximum(jnp.abs(a[2]), jnp.abs(b[2]))
        p += (jax.nn.sigmoid(alpha * similarity) * weight).sum((-2, -1))
        q += (jax.nn.sigmoid(-alpha * similarity) * weight).sum((-2, -1))
    some = q > 1e-6  # otherwise both images are black, and so equal
    ratio = jnp.where(some, p, math.exp(alpha)) / jnp.where(some, q, 1.0)
    return (jnp.log(ratio) / alpha) ** 2


def _haar(image: jax.Array) -> tuple[list, list]:
    """The coefficients of three scales, differences down the rows and along them."""
    down, across = [], []
    for size in (2, 4, 8):
        box = np.ones(size)
        step = np.repeat([1, -1], size // 2) / size
        down.append(_filter(image, step, box, "constant"))
        across.append(_filter(image, box, step, "constant"))
    return down, across


# Laparra et al. 2016: sigma and P of each band, P as the entries of a cross above, left of, right
# of and below its centre. The last band is the low-pass residual.
NLPD_BANDS = (
    (0.0248, (0.1011, 0.1493, 0.1460, 0.1015)),
    (0.0185, (0.0757, 0.1986, 0.1846, 0.0837)),
    (0.0179, (0.0477, 0.2138, 0.2243, 0.0467)),
    (0.0191, (0.0, 0.2503, 0.2616, 0.0)),
    (0.0220, (0.0, 0.2598, 0.2552, 0.0)),
    (0.2782, (0.0, 0.2215, 0.0717, 0.0)),
)
NLPD_FARTHER = 0.0072  # of the first band, two to the right
PYRAMID = (0.05, 0.25, 0.4, 0.25, 0.05)


@_measure
def nlpd(image: jax.Array, truth: jax.Array) -> jax.Array:
    """Normalised Laplacian pyramid distance (Laparra, Balle, Berardino, Simoncelli 2016), >= 0.

    D = mean_k sqrt(mean (z_k(I) - z_k(G))^2),  z_k = y_k / (sigma_k + P_k * |y_k|)

    with y the six bands of a Laplacian pyramid including its low-pass residual, so that the
    distance sees offsets and negatives. Bands with little contrast count as much as others, so
    noise in flat areas is penalised. P is convolved with zero padding; the pyramid mirrors the
    image on the way down and repeats its border on the way up. For a photograph it is about 0.2 if
    blurred by 1.5 pixels, 0.5 with noise of 0.1, 1.5 for a flat image and 3 for a negative.
    """
    pairs = zip(_normalised_bands(image), _normalised_bands(truth), strict=True)
    return sum((root(_mean((a - b) ** 2)) for a, b in pairs), jnp.float32(0)) / len(NLPD_BANDS)


def _normalised_bands(picture: jax.Array) -> Iterator[jax.Array]:
    for band in range(len(NLPD_BANDS) - 1):
        smaller = _filter(picture, PYRAMID, PYRAMID, "symmetric", stride=2)
        yield _divided(picture - _enlarged(smaller, *picture.shape[-2:]), band)
        picture = smaller
    yield _divided(picture, len(NLPD_BANDS) - 1)


def _enlarged(image: jax.Array, height: int, width: int) -> jax.Array:
    """To twice the size: repeat the border pixel, insert zeros, filter, times 4."""

    def matrix(size):
        padded = np.pad(np.eye((size + 1) // 2), ((1, 1), (0, 0)), "edge")
        spread = np.zeros((2 * len(padded), padded.shape[1]))
        spread[::2] = 2 * padded
        return (_matrix(len(spread), PYRAMID, "constant") @ spread)[2 : 2 + size].astype(np.float32)

    return _apply(image, matrix(height), matrix(width))


def _divided(detail: jax.Array, band: int) -> jax.Array:
    """y / (sigma + P * |y|), * a convolution: the upper entry of P weighs the pixel below."""
    sigma, (above, left, right, below) = NLPD_BANDS[band]
    farther = NLPD_FARTHER if band == 0 else 0.0
    size, activity = detail.shape, jnp.abs(detail)
    down = _matrix(size[-2], (below, 0, above), "constant")
    across = _matrix(size[-1], (farther, right, 0, left, 0), "constant")
    near = jnp.einsum("ih,...hw->...iw", down, activity, precision="highest")
    near += jnp.einsum("...hw,jw->...hj", activity, across, precision="highest")
    return detail / (sigma + near)


DETAIL_SIGMAS = (0.8, 1.6)  # pixels, of the Gaussian blurs between which lie the bands of detail


@_measure
def detail(image: jax.Array, truth: jax.Array) -> jax.Array:
    """Mean absolute difference between the local strengths of fine detail, >= 0.

    A band is the difference between the picture and its blur by a Gaussian, or between two such
    blurs. Its strength at a pixel is its root mean square under a Gaussian of 2.5 pixels.

        mean_bands mean |s(I) - s(G)|,  s = sqrt(1e-6 + G_2.5 * band^2)

    It measures how much detail there is, not its exact position, whereas other distances favour
    blur over misplaced detail. Blind to a negative and to offsets.
    """
    window = _gaussian(2.5, radius=6)

    def bands(picture):
        for sigma in DETAIL_SIGMAS:
            blur = _gaussian(sigma, radius=math.ceil(3 * sigma))
            smooth = _filter(picture, blur, blur, "symmetric")
            yield jnp.sqrt(_filter((picture - smooth) ** 2, window, window, "symmetric") + 1e-6)
            picture = smooth

    pairs = zip(bands(image), bands(truth), strict=True)
    return sum((_mean(jnp.abs(a - b)) for a, b in pairs), jnp.float32(0)) / len(DETAIL_SIGMAS)


@_measure
def cw_ssim(image: jax.Array, truth: jax.Array) -> jax.Array:
    """Complex wavelet SSIM (Sampat et al. 2009) with Gabor filters, 0 to 1.

    mean (2 |E a b*| + K) / (E |a|^2 + E |b|^2 + K), a and b the complex responses at every other
    pixel to filters of 4 orientations, wavelength 5 pixels, sigma 2, E the mean of 4x4 of them,
    K = 0.01^2 against noise in flat places, the mean over three scales (fewer below 68 pixels).
    The original has a steerable pyramid.
    Tolerates shifts of a pixel or two. Blind to a negative and to offsets.
    """
    least = CW_SSIM_SIDE
    _check_sides(image, least, "CW-SSIM needs")
    scales = sum(min(image.shape[-2:]) >> scale >= least for scale in range(3))
    similarity = jnp.float32(0)
    for scale in range(scales):
        if scale:
            image, truth = _halved(image), _halved(truth)
        similarity += _complex_similarity(_gabor(image), _gabor(truth))
    return similarity / scales


def _gabor(image: jax.Array) -> list[tuple[jax.Array, jax.Array]]:
    """Real and imaginary part of the responses in four orientations."""
    window = _gaussian(2.0, radius=5)

    def waves(wavelength):
        """The window times cos and sin, the former without its mean: flat places are zero."""
        phase = 2 * np.pi / wavelength * np.arange(-5, 6)
        cosine = window * np.cos(phase)
        return cosine - window * cosine.sum(), window * np.sin(phase)

    cos, sin = waves(5)
    c, s = waves(5 * math.sqrt(2))  # along the axes, for the diagonals
    cc, cs, sc, ss = (
        _filter(image, down, across, stride=2) for down in (c, s) for across in (c, s)
    )
    return [
        (_filter(image, window, cos, stride=2), _filter(image, window, sin, stride=2)),
        (_filter(image, cos, window, stride=2), _filter(image, sin, window, stride=2)),
        (cc - ss, cs + sc),
        (cc + ss, cs - sc),
    ]


def _complex_similarity(a: list, b: list) -> jax.Array:
    box, constant = np.ones(4) / 4, 0.01**2
    similarity = jnp.float32(0)
    for (a_real, a_imaginary), (b_real, b_imaginary) in zip(a, b, strict=True):
        real = _filter(a_real * b_real + a_imaginary * b_imaginary, box, box)
        imaginary = _filter(a_imaginary * b_real - a_real * b_imaginary, box, box)
        power = _filter(a_real**2 + a_imaginary**2 + b_real**2 + b_imaginary**2, box, box)
        modulus = root(real**2 + imaginary**2)
        similarity += _mean((2 * modulus + constant) / (power + constant))
    return similarity / len(a)


@_measure
def random_features(image: jax.Array, truth: jax.Array) -> jax.Array:
    """Distance between the features of a fixed random network, 0 to 2; sees a negative.

    mean_l mean_xy sum_c (n_l(I) - n_l(G))^2 as LPIPS (Zhang et al. 2018) with all weights 1, n_l
    the features of layer l divided by their norm over channels. Three layers of halving, 3x3
    convolution and ReLU (16, 32, 64 channels, He normal weights); the first halving turns 2x2
    pixels into 4 channels, the others take means. Liu et al. 2021 train with such features.
    """
    _check_sides(image, 8, "random features need")
    kernels = random_kernels(seed=0)
    both = (_random_layers(kernels, picture) for picture in (image, truth))
    layers = [_mean(((a - b) ** 2).sum(-1)) for a, b in zip(*both, strict=True)]
    return sum(layers, jnp.float32(0)) / len(layers)


def random_kernels(seed: int) -> list[np.ndarray]:
    """The kernels of the random network, (3, 3, inputs, outputs) float32."""
    rng = np.random.RandomState(seed)  # unlike numpy's newer generators, frozen for all versions
    return [
        (math.sqrt(2 / (9 * inputs)) * rng.standard_normal((3, 3, inputs, outputs))).astype("f4")
        for inputs, outputs in ((4, 16), (16, 32), (32, 64))
    ]


def _random_layers(kernels: list[np.ndarray], image: jax.Array) -> list[jax.Array]:
    """The features of each layer, (..., H / 2^l, W / 2^l, channels), l = 1, 2, 3."""
    leading = image.shape[:-2]
    x = _blocks((image.reshape(-1, *image.shape[-2:], 1) - 0.45) / 0.225)  # scaled as for LPIPS
    x = x.reshape(*x.shape[:3], 4)
    layers = []
    for layer, kernel in enumerate(kernels):
        if layer:
            x = _blocks(x).mean(3)
        x = jax.nn.relu(exactly_convolved(x, jnp.asarray(kernel), (1, 1), "SAME"))
        # 1e-4, small against a usual norm of 1: features of empty areas stay near zero.
        unit = x / jnp.sqrt((x**2).sum(-1, keepdims=True) + 1e-4)
        layers.append(unit.reshape(*leading, *unit.shape[1:]))
    return layers


def _blocks(x: jax.Array) -> jax.Array:
    """(N, H, W, channels) -> (N, H/2, W/2, 4, channels): the pixels of each block of 2x2."""
    batch, height, width, channels = x.shape
    x = x[:, : height // 2 * 2, : width // 2 * 2]
    x = x.reshape(batch, height // 2, 2, width // 2, 2, channels).swapaxes(2, 3)
    return x.reshape(batch, height // 2, width // 2, 4, channels)


@jax.jit
def temporal_error(
    image: jax.Array,
    previous: jax.Array,
    displacement: jax.Array,
    truth: jax.Array,
    previous_truth: jax.Array,
    visible: jax.Array | None = None,
) -> jax.Array:
    """How much an image differs from its warped predecessor (Lai et al. 2018), >= 0.

        mean( M |I_k - W(I_{k-1})| ),  M = exp(-50 (G_k - W(G_{k-1}))^2)

    displacement: (..., H, W, 2) pixels from k-1 to k, x then y, on the grid of image k; W is
    `warp.warp`. visible: (..., H, W) bool, False where image k shows what image k-1 did not.
    M is 0 there and where the warp leaves the image; the mean is over all pixels.
    Blind to errors that move along with the image, including a negative and a flat image.
    """
    image, truth = _compared(image, truth)
    if visible is None:
        visible = jnp.ones(image.shape, bool)
    # Where nothing corresponds, the displacement is arbitrary, even nan.
    displacement = jnp.where(visible[..., None], displacement, 0.0)
    warped, inside = warp(previous, displacement)
    warped_truth, _ = warp(previous_truth, displacement)
    mask = jnp.where(visible & inside, jnp.exp(-50 * (truth - warped_truth) ** 2), 0.0)
    return _mean(mask * jnp.abs(image - warped))


PATCH = 14  # pixels: the side of the blocks with one velocity in `event_correlation`


@jax.jit
def event_correlation(image: jax.Array, votes: jax.Array) -> jax.Array:
    """How well an image, if it moves, explains the next events, 0 to 1; needs no ground truth.

    votes: (..., H, W), the next event tensor summed over its bins, or any sums of polarities.

        E ~ -v . grad I,   sqrt( sum fit^2 / sum E^2 )

    the linearised model of events (Gallego, Forster, Mueggler, Scaramuzza, "Event-based camera pose
    tracking using a generative event model", 2015), with the best v for each block of 14x14 pixels,
    image and votes blurred by a Gaussian of 0.7 pixels. Misplaced or blurred edges and noise make
    it smaller; contrast and a negative do not change it. Because two numbers are fitted per block,
    even an unrelated image gets more than 0: as a baseline, rotate the votes by 180 degrees. Pixels
    beyond the last whole block do not count. 0 if there are no events.
    Raises SettingsError for images smaller than a block.
    """
    image, votes = _compared(image, votes)
    rows, columns = (side // PATCH for side in image.shape[-2:])
    if not rows * columns:
        raise SettingsError(f"{PATCH}x{PATCH} pixels at least are needed, not {image.shape[-2:]}")
    blur = _gaussian(0.7, radius=3)
    image, votes = (_filter(picture, blur, blur, "symmetric") for picture in (image, votes))
    difference = (-0.5, 0.0, 0.5)
    down, across = (
        _filter(image, *weights, "edge") for weights in ((difference, (1,)), ((1,), difference))
    )

    down, across, votes = (
        values[..., : rows * PATCH, : columns * PATCH] for values in (down, across, votes)
    )

    def summed(values):
        return values.reshape(*values.shape[:-2], rows, PATCH, columns, PATCH).sum((-3, -1))

    # The normal equations of two unknowns; a little is added so that a flat block has a solution.
    # By what of `across` is at right angles to `down`, not by their determinant: before a straight
    # edge that is all but zero, and float32 would lose three digits.
    least = 1e-6 * summed(down**2 + across**2) + 1e-9  # the gradient divides by its fourth power
    a = summed(down**2) + least
    share = summed(down * across) / a
    blocks = jnp.repeat(jnp.repeat(share, PATCH, -2), PATCH, -1)
    rest = across - blocks * down
    c = summed(rest**2) + least * (1 + share**2)
    fit = summed(down * votes) ** 2 / a + summed(rest * votes) ** 2 / c
    total = summed(votes**2).sum((-2, -1))
    part = fit.sum((-2, -1)) / jnp.where(total > 0, total, 1.0)
    return root(jnp.clip(part, 0.0, 1.0))
