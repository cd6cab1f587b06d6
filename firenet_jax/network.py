"""(State, event tensor) -> (State, image): FireNet as a pure function, the body of a scan.

Scheerlinck et al., WACV 2020: H (3x3 convolution, ReLU), G1 (ConvGRU), R1 (residual block), G2,
R2, P (1x1 convolution, no activation); 16 channels, zero padding, no striding, no normalisation
layers; 37,777 parameters. Event tensors are (B, H, W, 5). Images are (B, H, W) float32, nominally
0 to 1 and not clipped here. The receptive field of one step is 19x19 (through the reset gate).
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from firenet_jax import blocks, native
from firenet_jax.convolution import layer
from firenet_jax.events import BINS
from firenet_jax.settings import check_arrays

CHANNELS = 16


@partial(jax.tree_util.register_dataclass, data_fields=["params"], meta_fields=["normalise"])
@dataclass(frozen=True, eq=False)
class Weights:
    """A trained network: its parameters, and whether it expects normalised tensors."""

    params: Any
    """Nested dict of float32 arrays, kernels (3, 3, in, out)."""
    normalise: bool
    """Whether event tensors are to be normalised: FireNet True, FireNet+ False."""

    def __repr__(self) -> str:
        count = sum(getattr(leaf, "size", 1) for leaf in jax.tree.leaves(self.params))
        return f"Weights({count:,} parameters, normalise={self.normalise})"


class State(NamedTuple):
    """What the network remembers between windows: the hidden maps of its two ConvGRUs."""

    g1: jax.Array
    """(B, H, W, 16) float32, of the first."""
    g2: jax.Array
    """(B, H, W, 16) float32, of the second."""


def initial_state(batch: int, height: int, width: int) -> State:
    """The state before the first window: zeros."""
    shape = batch, height, width, CHANNELS  # two arrays, so that a state can be donated
    return State(jnp.zeros(shape, jnp.float32), jnp.zeros(shape, jnp.float32))


def check_state(state) -> None:
    """Raises TypeError for anything else, such as None."""
    if not isinstance(state, State):
        raise TypeError(
            f"the state is a {type(state).__name__}: make it with initial_state(batch, height, "
            "width)"
        )


class Conv(nn.Module):
    """Feature maps, concatenated -> one map of `features` channels per activation; kernel 3x3."""

    features: int
    activations: tuple[str, ...] = ("relu",)
    dtype: Any = jnp.float32
    kernel_init: Any = nn.initializers.he_normal()

    @nn.compact
    def parameters(self, inputs: int) -> tuple[jax.Array, jax.Array]:
        """Kernel and bias."""
        outputs = self.features * len(self.activations)
        kernel = self.param("kernel", self.kernel_init, (3, 3, inputs, outputs))
        bias = self.param("bias", nn.initializers.zeros_init(), (outputs,))
        return kernel.astype(self.dtype), bias.astype(self.dtype)

    def __call__(self, *maps: jax.Array) -> tuple[jax.Array, ...]:
        kernel, bias = self.parameters(sum(x.shape[-1] for x in maps))
        return layer([x.astype(self.dtype) for x in maps], kernel, bias, self.activations)


class ConvGRU(nn.Module):
    """h' = (1 - z) h + z q, with z, r = sigmoid(conv([x, h])) and q = tanh(conv([x, r h])).

    Kernels take the input before the state. The update gate z weighs the candidate q; in Flax's own
    cells it weighs the state. `gates` holds both gates, reset before update: one convolution with
    32 outputs is faster than two with 16.
    """

    features: int
    dtype: Any = jnp.float32

    def setup(self):
        init = nn.initializers.orthogonal()
        gates, candidate = ("sigmoid", "sigmoid"), ("tanh",)
        self.gates = Conv(self.features, gates, self.dtype, init)
        self.candidate = Conv(self.features, candidate, self.dtype, init)

    def __call__(self, h: jax.Array, x: jax.Array, exists: jax.Array | None = None) -> jax.Array:
        if exists is None and self.dtype == jnp.float32:
            convs = self.gates, self.candidate
            return blocks.gru(h, x, *(conv.parameters(2 * self.features) for conv in convs))
        r, z = self.gates(x, h)
        if exists is not None:  # free here, unlike a choice between h' and h
            z = z * exists[:, None, None, None]
        (q,) = self.candidate(x, r * h)
        return (1 - z) * h + z * q


class ResidualBlock(nn.Module):
    """relu(x + conv2(relu(conv1(x))))"""

    features: int
    dtype: Any = jnp.float32

    def setup(self):
        self.conv1 = Conv(self.features, dtype=self.dtype)
        self.conv2 = Conv(self.features, ("none",), self.dtype)

    def __call__(self, x: jax.Array) -> jax.Array:
        if self.dtype == jnp.float32:
            convs = self.conv1, self.conv2
            return blocks.residual(x, *(conv.parameters(self.features) for conv in convs))
        (between,) = self.conv1(x)
        (change,) = self.conv2(between)
        return nn.relu(x + change)


class FireNet(nn.Module):
    """The network. dtype is that of the convolutions; state and image stay float32."""

    dtype: Any = jnp.float32

    def setup(self):
        self.head = Conv(CHANNELS, dtype=self.dtype)
        self.gru1 = ConvGRU(CHANNELS, self.dtype)
        self.res1 = ResidualBlock(CHANNELS, self.dtype)
        self.gru2 = ConvGRU(CHANNELS, self.dtype)
        self.res2 = ResidualBlock(CHANNELS, self.dtype)
        # Always float32: it costs nothing, and in bfloat16 an image would have at most 8 bits.
        # Starts at grey: from black, the first steps of training shift every bias at once.
        self.prediction = nn.Conv(1, (1, 1), bias_init=nn.initializers.constant(0.5))

    def __call__(
        self, state: State, event_tensor: jax.Array, exists: jax.Array | None = None
    ) -> tuple[State, jax.Array]:
        (x,) = self.head(event_tensor)
        g1 = self.gru1(state.g1, x, exists)
        x = self.res1(g1)
        g2 = self.gru2(state.g2, x, exists)
        x = self.res2(g2)
        return State(g1, g2), self.prediction(x)[..., 0]


def step(
    params,
    state: State,
    event_tensor: jax.Array,
    exists: jax.Array | None = None,
    *,
    dtype=jnp.float32,
) -> tuple[State, jax.Array]:
    """One window: (State, (B, H, W, 5)) -> (State, (B, H, W)).

    Compiled once for each shape, also where it is called outside of `jax.jit`. On a CPU
    `reconstruct` is quicker: all of a window in one piece of machine code (`native.step`).

    event_tensor: float32, normalised if the weights expect it (`tensors.normalise`). Images are
    float32, nominally 0 to 1, not clipped.
    exists: (B,) bool; where False the state is unchanged and the image is undefined (the event
    tensor must still be finite there, for example zeros).
    dtype: of the convolutions; jnp.bfloat16 trades accuracy for speed on accelerators.
    Raises ValueError for shapes that do not match and for a dtype of more than 32 bits, TypeError
    for what is not an array or not a State.
    """
    if isinstance(params, Weights):
        raise TypeError("step takes the parameters alone: pass weights.params")
    check_state(state)
    check_arrays(event_tensor=event_tensor, exists=exists)
    shape = jnp.shape(event_tensor)
    if len(shape) != 4 or shape[-1] != BINS:
        raise ValueError(f"an event tensor of one window is (B, H, W, {BINS}), not {shape}")
    if any(jnp.shape(h)[:-1] != shape[:-1] for h in state):
        raise ValueError(
            f"the state is of {jnp.shape(state.g1)[:-1]}, but an event tensor {shape} needs "
            f"{shape[:-1]}: make it with initial_state(batch, height, width)"
        )
    if exists is not None and (exists.shape != shape[:1] or exists.dtype != bool):
        raise ValueError(
            f"exists is {exists.dtype} of shape {exists.shape}, but must be bool {shape[:1]}"
        )
    check_dtype(dtype)
    # Of float64, as numpy makes it, in a program with jax_enable_x64.
    inputs = params, state, event_tensor
    inputs = jax.tree.map(partial(jnp.asarray, dtype=jnp.float32), inputs)
    return _step(*inputs, exists, native.is_wanted(), dtype)


def check_dtype(dtype) -> None:
    """Raises ValueError for one of more than 32 bits: states and images are float32."""
    if jnp.finfo(dtype).bits > 32:
        raise ValueError(f"dtype is {jnp.dtype(dtype)}, but must be float32 or bfloat16")


@partial(jax.jit, static_argnums=(4, 5), inline=True)
def _step(params, state, event_tensor, exists, machine_code: bool, dtype):
    network: Any = FireNet(dtype)  # flax does not say what `apply` returns
    with native.by_xla_alone(not machine_code):
        return network.apply({"params": params}, state, event_tensor, exists)


def initial_params(key: jax.Array):
    """Random parameters: orthogonal for the GRUs, He normal before a ReLU, zero biases.

    With PyTorch's default, which the original uses, a signal fades to a tenth on its way to the
    image, and half of the last layers died in the first steps of training.
    """
    state, tensor = jax.eval_shape(lambda: (initial_state(1, 8, 8), jnp.zeros((1, 8, 8, BINS))))
    return FireNet().lazy_init(key, state, tensor)["params"]  # without computing an image


def multiply_adds(height: int, width: int) -> int:
    """Multiply-adds of the convolutions for one image, each counted once: 37,600 per pixel.

    Products with padding zeros are included. Table 2 of the paper has 9 % more.
    """
    c = CHANNELS
    head, residual_block, prediction = 9 * BINS * c, 2 * (9 * c * c), c
    gru = 9 * (2 * c) * (2 * c) + 9 * (2 * c) * c  # both gates, candidate
    return (head + 2 * gru + 2 * residual_block + prediction) * height * width
