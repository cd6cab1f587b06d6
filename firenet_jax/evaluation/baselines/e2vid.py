"""(State, event tensor) -> (State, image): E2VID, the recurrent U-Net, as the body of a scan.

Rebecq et al., "High Speed and High Dynamic Range Video with an Event Camera", TPAMI 2019: a 5x5
convolution, three encoders (5x5 convolution with a stride of 2, ConvLSTM), two residual blocks,
three decoders that double the size, a 1x1 convolution; what an encoder gives is added to what
enters its decoder. 32 to 256 channels, zero padding, 10,710,401 parameters. Event tensors are
(B, H, W, 5) and images (B, H, W), float32, of any size: `step` pads by reflection to multiples
of 8 and crops. Batch normalisation, where a checkpoint has it, is folded into the convolutions
when it is read: it is the same function with one layer fewer.
"""

import itertools
import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import unflatten_dict

from firenet_jax.errors import CheckpointError
from firenet_jax.events import BINS
from firenet_jax.network import ResidualBlock
from firenet_jax.reconstruction import padding
from firenet_jax.storage.pytorch_file import identify, read_state_dict, refuse_unused, take

STRIDE = 8  # of the three encoders together
EPSILON = 1e-5  # PyTorch's default in a batch normalisation
TRY = "pass E2VID's checkpoint as its authors publish it (.pth.tar), or that of E2VID+"


@dataclass(frozen=True)
class Settings:
    """Which E2VID; the defaults are the published one's ("E2VID_lightweight")."""

    transposed: bool = True
    """Decoders are transposed convolutions; False: bilinear upsampling, then a convolution."""
    sigmoid: bool = True
    """The image passes a sigmoid and stays in (0, 1); E2VID+, by its code's default, has none."""
    channels: int = 32
    """Channels at full size; each encoder doubles them."""


class State(NamedTuple):
    """What the network remembers between windows: the ConvLSTMs of its three encoders.

    Both fields hold (B, H/2, W/2, 64), (B, H/4, W/4, 128) and (B, H/8, W/8, 256) float32, where
    H and W are multiples of 8.
    """

    hidden: tuple[jax.Array, jax.Array, jax.Array]
    cell: tuple[jax.Array, jax.Array, jax.Array]


def initial_state(batch: int, height: int, width: int, settings: Settings = Settings()) -> State:
    """The state before the first window of event tensors (batch, height, width, 5): zeros."""
    height, width = _padded(height, width)
    a, b, c = (
        jnp.zeros((batch, height // n, width // n, settings.channels * n), jnp.float32)
        for n in (2, 4, 8)
    )
    return State((a, b, c), (a, b, c))


def _padded(height: int, width: int) -> tuple[int, int]:
    return height + -height % STRIDE, width + -width % STRIDE


class Encoder(nn.Module):
    """x -> relu(conv(x)) -> ConvLSTM: half the size; what it gives is its hidden state.

    i, f, o, g = conv([x, h]);  c' = sigmoid(f) c + sigmoid(i) tanh(g);  h' = sigmoid(o) tanh(c')
    """

    features: int

    def setup(self):
        # PyTorch pads both sides alike; "SAME" would place the coarser pixels elsewhere.
        self.conv = nn.Conv(self.features, (5, 5), strides=2, padding=2)
        self.gates = nn.Conv(4 * self.features, (3, 3))

    def __call__(self, h: jax.Array, c: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        x = nn.relu(self.conv(x))
        i, f, o, g = jnp.split(self.gates(jnp.concatenate([x, h], -1)), 4, -1)
        c = nn.sigmoid(f) * c + nn.sigmoid(i) * nn.tanh(g)
        return nn.sigmoid(o) * nn.tanh(c), c


class E2VID(nn.Module):
    """The network, for heights and widths that are multiples of 8."""

    settings: Settings

    def setup(self):
        channels = self.settings.channels
        self.head = nn.Conv(channels, (5, 5))
        self.encoders = [Encoder(channels * n) for n in (2, 4, 8)]
        self.resblocks = [ResidualBlock(channels * 8) for _ in range(2)]
        self.decoders = [self._decoder(channels * n) for n in (4, 2, 1)]
        self.prediction = nn.Conv(1, (1, 1))

    def _decoder(self, features: int) -> nn.Module:
        if not self.settings.transposed:
            return nn.Conv(features, (5, 5))
        # The padding of the dilated image that PyTorch's padding 2, output_padding 1 amounts to.
        sides = ((2, 3), (2, 3))
        return nn.ConvTranspose(features, (5, 5), strides=(2, 2), padding=sides)

    def __call__(self, state: State, event_tensor: jax.Array) -> tuple[State, jax.Array]:
        head = x = nn.relu(self.head(event_tensor))
        hidden, cell = [], []
        for encoder, h, c in zip(self.encoders, state.hidden, state.cell, strict=True):
            x, c = encoder(h, c, x)
            hidden.append(x)
            cell.append(c)
        for block in self.resblocks:
            x = block(x)
        for decoder, skip in zip(self.decoders, reversed(hidden), strict=True):
            x = x + skip
            x = nn.relu(decoder(x if self.settings.transposed else _twice(x)))
        image = self.prediction(x + head)[..., 0]
        if self.settings.sigmoid:
            image = nn.sigmoid(image)
        return State(tuple(hidden), tuple(cell)), image


def _twice(x: jax.Array) -> jax.Array:
    """(B, H, W, C) -> (B, 2 H, 2 W, C), bilinear between the centres of pixels.

    `jax.image.resize` gives the same, but by matrix products as wide as the image.
    """
    for axis in (1, 2):
        size = x.shape[axis]
        sides = [(1, 1) if a == axis else (0, 0) for a in range(4)]
        wide = jnp.pad(x, sides, mode="edge")
        before = jax.lax.slice_in_dim(wide, 0, size, axis=axis)
        after = jax.lax.slice_in_dim(wide, 2, size + 2, axis=axis)
        pairs = jnp.stack([0.75 * x + 0.25 * before, 0.75 * x + 0.25 * after], axis + 1)
        x = pairs.reshape(*x.shape[:axis], 2 * size, *x.shape[axis + 1 :])
    return x


def step(
    params, state: State, event_tensor: jax.Array, settings: Settings = Settings()
) -> tuple[State, jax.Array]:
    """One window: (State, (B, H, W, 5)) -> (State, (B, H, W)); settings are static under jit.

    event_tensor: normalised (`tensors.normalise`) for E2VID, not normalised for E2VID+. Padded here
    by reflection to multiples of 8 (rpg_e2vid; EVREAL pads zeros), the larger half above and left.
    Whoever wants the mask of `pictures` to see the padded image pads before and crops after.
    """
    height, width = event_tensor.shape[1:3]
    (top, _), (left, _) = sides = padding(height, width, STRIDE)
    tensor = jnp.pad(event_tensor, ((0, 0), *sides, (0, 0)), mode="reflect")
    network: Any = E2VID(settings)  # flax does not say what `apply` returns
    state, image = network.apply({"params": params}, state, tensor)
    return state, image[:, top : top + height, left : left + width]


# ---- what all of it is made of


class _Layer(NamedTuple):
    """One convolution."""

    name: str  # here
    pytorch: str  # in a checkpoint
    norm: str  # of the batch normalisation after it in a checkpoint; empty where there never is
    shape: tuple[int, int, int, int]  # of its kernel: (rows, columns, inputs, outputs)
    every: int  # the whole kernel is multiplied once for each square of so many pixels
    transposed: bool = False


def _layers(settings: Settings) -> list[_Layer]:
    """All convolutions, in the order of the network."""
    c, transposed = settings.channels, settings.transposed
    layers = [_Layer("head", "head.conv2d", "", (5, 5, BINS, c), 1)]
    for i, n in enumerate((2, 4, 8)):
        ours, theirs, norm = f"encoders_{i}", f"encoders.{i}", f"encoders.{i}.conv.norm_layer"
        kernel, gates = (5, 5, c * n // 2, c * n), (3, 3, 2 * c * n, 4 * c * n)
        layers.append(_Layer(f"{ours}/conv", f"{theirs}.conv.conv2d", norm, kernel, n))
        layers.append(_Layer(f"{ours}/gates", f"{theirs}.recurrent_block.Gates", "", gates, n))
    for i, k in itertools.product((0, 1), (1, 2)):
        ours, theirs = f"resblocks_{i}/conv{k}", f"resblocks.{i}.conv{k}"
        layers.append(_Layer(ours, theirs, f"resblocks.{i}.bn{k}", (3, 3, 8 * c, 8 * c), 8))
    for i, n in enumerate((8, 4, 2)):
        theirs = f"decoders.{i}.transposed_conv2d" if transposed else f"decoders.{i}.conv2d"
        kernel, norm = (5, 5, c * n, c * n // 2), f"decoders.{i}.norm_layer"
        # Transposed, each pixel that enters meets the kernel; otherwise each pixel that leaves.
        every = n if transposed else n // 2
        layers.append(_Layer(f"decoders_{i}", theirs, norm, kernel, every, transposed))
    layers.append(_Layer("prediction", "pred.conv2d", "pred.norm_layer", (1, 1, c, 1), 1))
    return layers


def initial_params(key: jax.Array, settings: Settings = Settings()):
    """Random parameters, PyTorch's default: uniform in +-1/sqrt(fan_in), kernels and biases."""
    kinds = {}  # name -> (shape, bound)
    for layer in _layers(settings):
        rows, columns, inputs, outputs = layer.shape
        # PyTorch takes the fan-in from its kernel's axes, which a transposed convolution swaps.
        bound = (rows * columns * (outputs if layer.transposed else inputs)) ** -0.5
        kinds[f"{layer.name}/kernel"] = layer.shape, bound
        kinds[f"{layer.name}/bias"] = (outputs,), bound
    # One draw for all: with a draw for each, compiling them takes many times as long.
    sizes = [math.prod(shape) for shape, _ in kinds.values()]
    uniform = jax.random.uniform(key, (sum(sizes),), jnp.float32, -1, 1)
    parts = jnp.split(uniform, np.cumsum(sizes)[:-1])
    flat = {
        name: bound * part.reshape(shape)
        for (name, (shape, bound)), part in zip(kinds.items(), parts, strict=True)
    }
    return unflatten_dict(flat, sep="/")


def multiply_adds(height: int, width: int, settings: Settings = Settings()) -> int:
    """Multiply-adds of the convolutions for one image, on the padded size, each counted once.

    Per padded pixel 338,880 with transposed convolutions, 454,080 with upsampling (32 channels).
    Table 2 of the FireNet paper charges transposed convolutions as if they ran on their output,
    which is the second count, Settings(transposed=False), and 5.5 % more for unknown reasons.
    """
    height, width = _padded(height, width)
    return sum(
        math.prod(layer.shape) * (height // layer.every) * (width // layer.every)
        for layer in _layers(settings)
    )


# ---- PyTorch

FIRST = "encoders.0.conv.conv2d.weight"  # tells this network from others


def load(path: str | Path, *, sigmoid: bool = True) -> tuple[dict, Settings]:
    """A published PyTorch checkpoint -> (params, settings), read without running its pickle.

    The kind of decoder and the channels follow from names and shapes; sigmoid, which a state dict
    does not tell, is True for E2VID and False for E2VID+. Batch normalisation is folded: float64,
    then float32. Raises CheckpointError, one sentence, for whatever is not such a network.
    """
    path = Path(path)
    tensors = read_state_dict(path)
    _, prefix = identify(tensors, {"E2VID": FIRST}, path, "E2VID", TRY)
    first = tensors[prefix + FIRST]
    settings = Settings(
        transposed=f"{prefix}decoders.0.transposed_conv2d.weight" in tensors,
        sigmoid=sigmoid,
        channels=first.shape[1] if first.ndim == 4 else Settings.channels,
    )
    ours = partial(take, tensors, prefix, path, "E2VID", TRY)

    flat = {}
    for layer in _layers(settings):
        rows, columns, inputs, outputs = layer.shape
        if layer.transposed:
            # PyTorch scatters with this kernel, which is to gather with it turned by 180 degrees.
            kernel = ours(f"{layer.pytorch}.weight", (inputs, outputs, rows, columns))
            kernel = kernel.transpose(2, 3, 0, 1)[::-1, ::-1]
        else:
            kernel = ours(f"{layer.pytorch}.weight", (outputs, inputs, rows, columns))
            kernel = kernel.transpose(2, 3, 1, 0)
        if layer.norm and f"{prefix}{layer.norm}.running_mean" in tensors:
            mean, variance, weight, shift = (
                ours(f"{layer.norm}.{part}", (outputs,)).astype(np.float64)
                for part in ("running_mean", "running_var", "weight", "bias")
            )
            tensors.pop(f"{prefix}{layer.norm}.num_batches_tracked", None)
            with np.errstate(all="ignore"):  # a negative variance, or beyond float32: refused here
                gain = weight / np.sqrt(variance + EPSILON)
                kernel = (kernel * gain).astype(np.float32)
                bias = (shift - mean * gain).astype(np.float32)
            if not (np.isfinite(kernel).all() and np.isfinite(bias).all()):
                raise CheckpointError(
                    f"{path} holds no E2VID: {prefix + layer.pytorch!a} or the normalisation after "
                    f"it has values that are not finite; {TRY}"
                )
        else:
            bias = ours(f"{layer.pytorch}.bias", (outputs,))
        flat[f"{layer.name}/kernel"], flat[f"{layer.name}/bias"] = kernel, bias

    refuse_unused(tensors, prefix, path, "E2VID", TRY)
    return unflatten_dict(flat, sep="/"), settings
