"""Image, ground truth -> LPIPS, by weights from files that the user names.

Learned perceptual image patch similarity (Zhang et al. 2018), version 0.1, with AlexNet or
SqueezeNet 1.1: a distance, 0 if equal; papers usually report AlexNet's. It needs two PyTorch
files, read without PyTorch and not part of this package: the network as torchvision
publishes it (alexnet-owt-*.pth, squeezenet1_1-*.pth) and the linear layers of the `lpips` package
(lpips/weights/v0.1/alex.pth, squeeze.pth). Files of version 0.0 have the same names and shapes:
nothing here tells them apart.

Images are (..., H, W) grey, nominally 0 to 1 and not clipped here, 31x31 pixels at least.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from firenet_jax.errors import SettingsError
from firenet_jax.evaluation.metrics import exactly_convolved, root
from firenet_jax.storage.pytorch_file import identify, read_state_dict, take

MIN_SIDE = 31  # pixels of a side: AlexNet's last pool then makes one of them
# of the three colours in -1 to 1: ImageNet's means and deviations, rounded
SHIFT = np.array([-0.030, -0.088, -0.188], np.float32)
SCALE = np.array([0.458, 0.448, 0.450], np.float32)


class Lpips(NamedTuple):
    """Weights, as `load` makes them. Five linear layers belong to AlexNet, seven to SqueezeNet."""

    # name of a layer in its file -> (rows, columns, inputs, outputs) and (outputs,) float32
    convolutions: dict[str, tuple[jax.Array, jax.Array]]
    linear: tuple[jax.Array, ...]  # (channels,) float32 for each layer that is compared


@jax.jit
def lpips(weights: Lpips, images: jax.Array, truths: jax.Array) -> jax.Array:
    """(..., H, W), (..., H, W) -> (...,) float32, >= 0 with weights as published.

    sum_l mean_hw sum_c w_l,c (n_l(I) - n_l(G))_c^2,  n_l = f_l / (|f_l| + 1e-10)

    f_l is the output of the network's layer l and |f_l| its norm over channels c, at each place;
    the network sees grey as three equal colours. Gradients are finite, also where all of f_l is 0.
    Raises ValueError for different shapes and for images smaller than 31x31.
    """
    images, truths = jnp.asarray(images, jnp.float32), jnp.asarray(truths, jnp.float32)
    if images.shape != truths.shape or images.ndim < 2:
        raise ValueError(f"images {images.shape} cannot be compared with truths {truths.shape}")
    if min(images.shape[-2:]) < MIN_SIDE:
        size = f"{MIN_SIDE}x{MIN_SIDE}"
        raise SettingsError(f"LPIPS needs {size} pixels at least, not {images.shape[-2:]}")
    distance = jnp.float32(0)
    both = _features(weights, jnp.stack([images, truths]))
    for linear, features in zip(weights.linear, both, strict=True):
        ours, theirs = jnp.split(_unit(features), 2)
        weighted = jnp.einsum("nhwc,c->nhw", (ours - theirs) ** 2, linear, precision="highest")
        distance += weighted.mean((1, 2))
    return distance.reshape(images.shape[:-2])


def _unit(features: jax.Array) -> jax.Array:
    """Divided by the norm over channels, whose gradient is infinite at 0 and made 0 there."""
    return features / (root((features**2).sum(-1, keepdims=True)) + 1e-10)


# ---- the two networks


def _features(weights: Lpips, images: jax.Array) -> list[jax.Array]:
    """(..., H, W) -> the layers that are compared, (N, rows, columns, channels) each."""
    grey = 2 * images.reshape(-1, *images.shape[-2:], 1) - 1
    x = (grey - SHIFT.reshape(1, 1, 1, 3)) / SCALE.reshape(1, 1, 1, 3)
    network = next(n for n in NETWORKS if len(n.channels) == len(weights.linear))
    return network.features(weights.convolutions, x)


def _alexnet(convolutions: dict, x: jax.Array) -> list[jax.Array]:
    first = _convolve(convolutions["features.0"], x, stride=4, padding=2)
    second = _convolve(convolutions["features.3"], _pool(first), padding=2)
    third = _convolve(convolutions["features.6"], _pool(second), padding=1)
    fourth = _convolve(convolutions["features.8"], third, padding=1)
    fifth = _convolve(convolutions["features.10"], fourth, padding=1)
    return [first, second, third, fourth, fifth]


def _squeezenet(convolutions: dict, x: jax.Array) -> list[jax.Array]:
    def fire(index: int, x: jax.Array) -> jax.Array:
        name = f"features.{index}"
        squeezed = _convolve(convolutions[f"{name}.squeeze"], x)
        narrow = _convolve(convolutions[f"{name}.expand1x1"], squeezed)
        wide = _convolve(convolutions[f"{name}.expand3x3"], squeezed, padding=1)
        return jnp.concatenate([narrow, wide], -1)

    first = _convolve(convolutions["features.0"], x, stride=2)
    second = fire(4, fire(3, _pool(first, ceil=True)))
    third = fire(7, fire(6, _pool(second, ceil=True)))
    fourth = fire(9, _pool(third, ceil=True))
    fifth = fire(10, fourth)
    sixth = fire(11, fifth)
    return [first, second, third, fourth, fifth, sixth, fire(12, sixth)]


def _convolve(layer: tuple, x: jax.Array, stride: int = 1, padding: int = 0) -> jax.Array:
    """Convolution, bias, ReLU."""
    kernel, bias = layer
    x = exactly_convolved(x, kernel, (stride, stride), [(padding, padding)] * 2)
    return jax.nn.relu(x + bias.reshape(1, 1, 1, -1))


def _pool(x: jax.Array, ceil: bool = False) -> jax.Array:
    """The greatest of 3x3 at every other place; ceil: a last window may reach one pixel outside."""
    outside = [(0, (size - 3) % 2 if ceil else 0) for size in x.shape[1:3]]
    padding = [(0, 0), *outside, (0, 0)]
    return jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, (1, 3, 3, 1), (1, 2, 2, 1), padding)


# ---- files

_SQUEEZENET_SHAPES = {"features.0": (64, 3, 3, 3)}
for _index, _inputs, _squeezed, _expanded in (
    (3, 64, 16, 64), (4, 128, 16, 64), (6, 128, 32, 128), (7, 256, 32, 128),
    (9, 256, 48, 192), (10, 384, 48, 192), (11, 384, 64, 256), (12, 512, 64, 256),
):  # fmt: skip
    _SQUEEZENET_SHAPES |= {
        f"features.{_index}.squeeze": (_squeezed, _inputs, 1, 1),
        f"features.{_index}.expand1x1": (_expanded, _squeezed, 1, 1),
        f"features.{_index}.expand3x3": (_expanded, _squeezed, 3, 3),
    }


class _Network(NamedTuple):
    title: str
    mark: str  # a name that only this network's file has
    shapes: dict[str, tuple[int, ...]]  # convolution -> (outputs, inputs, rows, columns)
    channels: tuple[int, ...]  # of the layers that are compared
    linear_file: str  # in the lpips package
    features: Callable[[dict, jax.Array], list[jax.Array]]


NETWORKS = (
    _Network(
        title="AlexNet",
        mark="features.3.weight",
        shapes={
            "features.0": (64, 3, 11, 11),
            "features.3": (192, 64, 5, 5),
            "features.6": (384, 192, 3, 3),
            "features.8": (256, 384, 3, 3),
            "features.10": (256, 256, 3, 3),
        },
        channels=(64, 192, 384, 256, 256),
        linear_file="lpips/weights/v0.1/alex.pth",
        features=_alexnet,
    ),
    _Network(
        title="SqueezeNet 1.1",
        mark="features.3.squeeze.weight",
        shapes=_SQUEEZENET_SHAPES,
        channels=(64, 128, 256, 384, 384, 512, 512),
        linear_file="lpips/weights/v0.1/squeeze.pth",
        features=_squeezenet,
    ),
)
BACKBONES = "pass torchvision's AlexNet (alexnet-owt-*.pth) or SqueezeNet 1.1 (squeezenet1_1-*.pth)"


def load(backbone_file: str | Path, linear_file: str | Path) -> Lpips:
    """The weights out of two files of PyTorch: the network and the linear layers made for it.

    Which network it is shows in its names; its classifier is not needed. Raises CheckpointError,
    a ValueError, for what cannot be read and for names, shapes and values that do not fit.
    """
    tensors = read_state_dict(backbone_file)
    marks = {network.title: network.mark for network in NETWORKS}
    title, prefix = identify(tensors, marks, backbone_file, "network of LPIPS", BACKBONES)
    network = next(network for network in NETWORKS if network.title == title)

    ours = partial(take, tensors, prefix, backbone_file, title, BACKBONES)
    convolutions = {}
    for name, shape in network.shapes.items():
        kernel, bias = ours(f"{name}.weight", shape), ours(f"{name}.bias", shape[:1])
        convolutions[name] = jnp.asarray(kernel.transpose(2, 3, 1, 0)), jnp.asarray(bias)

    tensors = read_state_dict(linear_file)
    kind = f"linear layers of LPIPS for {title}"
    advice = f"pass {network.linear_file} of the lpips package"
    ours = partial(take, tensors, "", linear_file, kind, advice)
    linear = tuple(
        jnp.asarray(ours(f"lin{k}.model.1.weight", (1, channels, 1, 1)).ravel())
        for k, channels in enumerate(network.channels)
    )
    return Lpips(convolutions, linear)
