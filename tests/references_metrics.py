"""Slow, obvious versions of the perceptual distances: numpy, scipy, float64, one image at a time.

Written from the formulas alone, without the package's code. SSIM is scikit-image's.
"""

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.signal import convolve2d
from skimage.metrics import structural_similarity


def ssim(image, truth, **kwargs):
    settings = {"data_range": 1.0, "sigma": 1.5, **kwargs}
    return structural_similarity(
        np.asarray(image, np.float64),
        np.asarray(truth, np.float64),
        gaussian_weights=True,
        use_sample_covariance=False,
        **settings,
    )


def equalised(picture):
    height, width = picture.shape
    tones = np.linspace(-0.1, 1.1, 97)
    shares = np.zeros(97)
    for i in range(12):
        for j in range(12):
            other = picture[(2 * i + 1) * height // 24, (2 * j + 1) * width // 24]
            shares += np.clip((tones - other) / 0.05 + 0.5, 0, 1) / 144
    return np.interp(picture, tones, shares)


def equalised_ssim(image, truth):
    return ssim(equalised(image), equalised(truth))


def equalised_mse(image, truth):
    return np.mean((equalised(image) - equalised(truth)) ** 2)


def halved(image):
    height, width = (side // 2 for side in image.shape)
    return np.array(
        [
            [image[2 * y : 2 * y + 2, 2 * x : 2 * x + 2].mean() for x in range(width)]
            for y in range(height)
        ]
    )


def ms_ssim(image, truth):
    weights = [0.0448, 0.2856, 0.3001, 0.2363, 0.1333]
    x = np.arange(-5, 6)
    kernel = np.exp(-(x[:, None] ** 2 + x[None] ** 2) / (2 * 1.5**2))
    kernel /= kernel.sum()
    factors = []
    while min(image.shape) >= 11 and len(factors) < 5:

        def mean(picture):
            return convolve2d(picture, kernel, "valid")

        covariance = mean(image * truth) - mean(image) * mean(truth)
        variances = mean(image**2) - mean(image) ** 2 + mean(truth**2) - mean(truth) ** 2
        cs = (2 * covariance + 0.03**2) / (variances + 0.03**2)
        luminance = (2 * mean(image) * mean(truth) + 0.01**2) / (
            mean(image) ** 2 + mean(truth) ** 2 + 0.01**2
        )
        factors.append((cs.mean(), (luminance * cs).mean()))
        image, truth = halved(image), halved(truth)
    total = sum(weights[: len(factors)])
    result = 1.0
    for scale, (cs, full) in enumerate(factors):
        factor = full if scale == len(factors) - 1 else cs
        result *= max(factor, 0) ** (weights[scale] / total)
    return result


def gmsd(image, truth):
    prewitt = np.array([[1, 0, -1]] * 3) / 3

    def magnitude(picture):
        picture = halved(picture)
        return np.hypot(
            convolve2d(picture, prewitt, "valid"), convolve2d(picture, prewitt.T, "valid")
        )

    a, b, c = magnitude(image), magnitude(truth), 170 / 255**2
    return ((2 * a * b + c) / (a**2 + b**2 + c)).std()


def detail(image, truth):
    def bands(picture):
        for sigma in (0.8, 1.6):
            # scipy cuts at an odd number of pixels too; its "reflect" is numpy's "symmetric"
            smooth = gaussian_filter(picture, sigma, radius=int(np.ceil(3 * sigma)), mode="reflect")
            yield np.sqrt(gaussian_filter((picture - smooth) ** 2, 2.5, radius=6) + 1e-6)
            picture = smooth

    return np.mean([np.abs(a - b).mean() for a, b in zip(bands(image), bands(truth), strict=True)])


def haarpsi(image, truth):
    """On 0 to 255, as published."""
    constant, alpha = 30, 4.2
    image, truth = 255 * halved(image), 255 * halved(truth)
    above, below = 0.0, 0.0
    for transposed in (False, True):

        def coefficients(picture, scale, transposed=transposed):
            size = 2**scale
            kernel = np.ones((size, size)) / size
            kernel[: size // 2] *= -1
            kernel = kernel.T if transposed else kernel
            return np.abs(convolve2d(picture, kernel, "same"))

        similarity = 0.0
        for scale in (1, 2):
            a, b = coefficients(image, scale), coefficients(truth, scale)
            similarity += (2 * a * b + constant) / (a**2 + b**2 + constant) / 2
        weight = np.maximum(coefficients(image, 3), coefficients(truth, 3))
        above += (weight / (1 + np.exp(-alpha * similarity))).sum()
        below += weight.sum()
    if below == 0:
        return 1.0
    ratio = above / below
    return (np.log(ratio / (1 - ratio)) / alpha) ** 2


NLPD_SIGMAS = [0.0248, 0.0185, 0.0179, 0.0191, 0.0220, 0.2782]
NLPD_CROSSES = [  # up, left, right, down
    [0.1011, 0.1493, 0.1460, 0.1015],
    [0.0757, 0.1986, 0.1846, 0.0837],
    [0.0477, 0.2138, 0.2243, 0.0467],
    [0, 0.2503, 0.2616, 0],
    [0, 0.2598, 0.2552, 0],
    [0, 0.2215, 0.0717, 0],
]


def nlpd(image, truth):
    smooth = np.outer([0.05, 0.25, 0.4, 0.25, 0.05], [0.05, 0.25, 0.4, 0.25, 0.05])

    def down(picture):
        return convolve2d(np.pad(picture, 2, "symmetric"), smooth, "valid")[::2, ::2]

    def up(picture, shape):
        padded = np.pad(picture, 1, "edge")
        spread = np.zeros((2 * padded.shape[0], 2 * padded.shape[1]))
        spread[::2, ::2] = 4 * padded
        filtered = convolve2d(spread, smooth, "same")[2:-2, 2:-2]
        return filtered[: shape[0], : shape[1]]

    def bands(picture):
        pyramid = []
        for _ in range(5):
            smaller = down(picture)
            pyramid.append(picture - up(smaller, picture.shape))
            picture = smaller
        pyramid.append(picture)
        for k, band in enumerate(pyramid):
            kernel = np.zeros((5, 5))
            kernel[1, 2], kernel[2, 1], kernel[2, 3], kernel[3, 2] = NLPD_CROSSES[k]
            if k == 0:
                kernel[2, 4] = 0.0072
            # convolve2d with "same" returns the larger input's size: pad for the smallest bands
            activity = convolve2d(np.pad(np.abs(band), 2), kernel, "valid")
            yield band / (NLPD_SIGMAS[k] + activity)

    pairs = zip(bands(image), bands(truth), strict=True)
    return np.mean([np.sqrt(np.mean((a - b) ** 2)) for a, b in pairs])


def cw_ssim(image, truth):
    y, x = np.mgrid[-5:6, -5:6]
    line = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 2.0**2))
    window = np.outer(line, line) / line.sum() ** 2

    def wave(u, v):
        """exp(i (u x + v y)) under the window, each real factor without its mean."""

        def factor(frequency):
            wave = np.exp(1j * frequency * np.arange(-5, 6)) * line / line.sum()
            return wave - line / line.sum() * wave.real.sum() if frequency else wave

        return np.outer(factor(v), factor(u))

    assert np.allclose(wave(0, 0), window)
    frequency, diagonal = 2 * np.pi / 5, 2 * np.pi / 5 / np.sqrt(2)
    filters = [
        wave(frequency, 0),
        wave(0, frequency),
        wave(diagonal, diagonal),
        wave(diagonal, -diagonal),
    ]
    box, constant, scores = np.ones((4, 4)) / 16, 0.01**2, []
    for scale in range(3):
        if scale:
            if min(image.shape) < 34:
                break
            image, truth = halved(image), halved(truth)
        for kernel in filters:
            # convolve2d flips the kernel, so that it takes the filter's mirror image
            a, b = (convolve2d(p, kernel[::-1, ::-1], "valid")[::2, ::2] for p in (image, truth))
            cross = convolve2d(a * b.conj(), box, "valid")
            power = convolve2d(np.abs(a) ** 2 + np.abs(b) ** 2, box, "valid")
            scores.append(((2 * np.abs(cross) + constant) / (power + constant)).mean())
    return np.mean(scores)


def random_features(kernels, image, truth):
    """kernels: of the three layers, (3, 3, in, out)."""

    def layers(picture):
        picture = (picture - 0.45) / 0.225
        height, width = (side // 2 * 2 for side in picture.shape)
        channels = [picture[y:height:2, x:width:2] for y in (0, 1) for x in (0, 1)]
        for layer, kernel in enumerate(kernels):
            if layer:
                channels = [halved(channel) for channel in channels]
            outputs = []
            for o in range(kernel.shape[-1]):
                total = sum(
                    convolve2d(channel, kernel[::-1, ::-1, i, o], "same")
                    for i, channel in enumerate(channels)
                )
                outputs.append(np.maximum(total, 0))
            channels = outputs
            stacked = np.array(channels)
            yield stacked / np.sqrt((stacked**2).sum(0) + 1e-4)

    pairs = zip(layers(image), layers(truth), strict=True)
    return np.mean([((a - b) ** 2).sum(0).mean() for a, b in pairs])


def temporal_error(image, previous, displacement, truth, previous_truth, visible):
    height, width = image.shape
    total = 0.0
    for y in range(height):
        for x in range(width):
            from_x, from_y = x - displacement[y, x, 0], y - displacement[y, x, 1]
            if not visible[y, x] or not (0 <= from_x <= width - 1 and 0 <= from_y <= height - 1):
                continue
            place = [[from_y], [from_x]]
            warped = map_coordinates(previous, place, order=1)[0]
            warped_truth = map_coordinates(previous_truth, place, order=1)[0]
            mask = np.exp(-50 * (truth[y, x] - warped_truth) ** 2)
            total += mask * abs(image[y, x] - warped)
    return total / (height * width)
