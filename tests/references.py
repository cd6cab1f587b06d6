"""Slow, obvious versions of what the package does fast; numpy in float64, PyTorch for the network.

Written from the formulas alone, without the package's code.
"""

import math

import numpy as np


def event_tensor(events, height, width, bounds=None, bins=5):
    """Eq. 1 as it stands: a double loop over events and bins."""
    tensor = np.zeros((height, width, bins))
    if len(events) == 0:
        return tensor
    times = [int(t) for t in events.t]
    t_min, t_max = bounds or (min(times), max(times))
    for t, x, y, p in zip(times, events.x, events.y, events.p, strict=True):
        if not (0 <= x < width and 0 <= y < height):
            continue
        t_star = (bins - 1) * (t - t_min) / max(t_max - t_min, 1)
        for n in range(bins):
            tensor[y, x, n] += (1 if p else -1) * max(0.0, 1 - abs(n - t_star))
    return tensor


def normalised(tensor):
    """Non-zero entries to mean 0 and population standard deviation 1."""
    result = np.zeros_like(tensor)
    voted = tensor != 0
    if voted.any() and tensor[voted].std() >= 1e-6:
        result[voted] = (tensor[voted] - tensor[voted].mean()) / tensor[voted].std()
    return result


def unsharp(image, amount=0.3):
    """The 5x5 kernel of the original program, one pixel at a time, zeros beyond the border."""

    def normcdf(x):
        return 0.5 * (1 + math.erf(x / math.sqrt(2)))

    sigma, size = 1.0, 5
    interval = (2 * sigma + 1.0) / size
    edges = np.linspace(-sigma - interval / 2, sigma + interval / 2, size + 1)
    masses = np.diff([normcdf(edge) for edge in edges])
    kernel = np.sqrt(np.outer(masses, masses))
    kernel /= kernel.sum()
    height, width = image.shape
    padded = np.pad(np.asarray(image, np.float64), 2)
    blurred = np.array(
        [
            [(padded[y : y + 5, x : x + 5] * kernel).sum() for x in range(width)]
            for y in range(height)
        ]
    )
    return (1 + amount) * image - amount * blurred


def intensity_ranges(images):
    """The automatic range of each image: medians over a window that holds 11 in steady state."""
    bounds, result = [], []
    for image in images:
        if len(bounds) > 10:
            bounds.pop(0)
        bounds.append((np.clip(image.min(), 0, 0.45), np.clip(image.max(), 0.55, 1)))
        result.append(tuple(np.median(np.array(bounds), axis=0)))
    return result


def automatic_ranges(images):
    """`pictures.automatic_range` of each image, and the medians as above."""
    bounds, result = [], []
    for image in images:
        if len(bounds) > 10:
            bounds.pop(0)
        values = np.sort(image[2:-2, 2:-2], axis=None).astype(float)
        places = np.linspace(0, 1, len(values))
        low, high = np.interp([0.005, 0.995], places, values)
        low, high = low - 0.05 * (high - low), high + 0.05 * (high - low)
        missing = max(0.0, 0.35 - (high - low))
        bounds.append((low - 2 * missing / 3, high + missing / 3))
        result.append(tuple(np.median(np.array(bounds), axis=0)))
    return result


def torch_firenet(params):
    """FireNet in PyTorch (NCHW) with our parameters: a function (state, tensor) -> (state, image).

    `params` may hold numpy arrays or tensors that ask for gradients, kernels (H, W, in, out).
    """
    import torch
    import torch.nn.functional as F

    def conv(layer, x):
        kernel = torch.as_tensor(layer["kernel"]).permute(3, 2, 0, 1)
        return F.conv2d(x, kernel, torch.as_tensor(layer["bias"]), padding=kernel.shape[-1] // 2)

    def gru(layers, h, x):
        gates = torch.sigmoid(conv(layers["gates"], torch.cat([x, h], 1)))
        reset, update = gates[:, :16], gates[:, 16:]
        candidate = torch.tanh(conv(layers["candidate"], torch.cat([x, reset * h], 1)))
        return h * (1 - update) + candidate * update

    def residual(layers, x):
        return F.relu(x + conv(layers["conv2"], F.relu(conv(layers["conv1"], x))))

    def step(state, tensor):
        g1 = gru(params["gru1"], state[0], F.relu(conv(params["head"], tensor)))
        g2 = gru(params["gru2"], state[1], residual(params["res1"], g1))
        image = conv(params["prediction"], residual(params["res2"], g2))
        return (g1, g2), image

    return step
