"""An optimiser's functions -> those of one whose updates of a layer do not shift all that follows.

Maps of FireNet have means far from zero: some channels are active everywhere. So an update of a
kernel shifts all maps behind it, and at a high rate channels behind a ReLU die of it, for good.
Here gradients and updates are those of y = K (x - m) + b in place of y = K x + b, where m are the
means of a layer's inputs (Schraudolph, "Centering neural network gradient factors", 1998). The
network and its parameters are the usual ones, and rates may be three times as high.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from firenet_jax.convolution import layer
from firenet_jax.network import State

# {"gru1": {"gates": leaf, ...}, ...}: one leaf for each convolution, (inputs,) or {kernel, bias}.
Layers = dict[str, Any]
NEW = 0.03  # share of a step's means in the running ones


class Centred(NamedTuple):
    """The optimiser's state."""

    means: Layers  # running
    count: jax.Array  # () int32, steps so far
    inner: Any


def centred(inner) -> tuple[Callable, Callable]:
    """An optimiser of optax -> init and update of the same with centred inputs.

    update takes `means`, those of the step's inputs (`input_means`).
    """

    def init(params):
        return Centred(_zeros(params), jnp.int32(0), inner.init(params))

    def update(updates, state, params=None, **more):
        share = jnp.maximum(NEW, 1 / (state.count + 1))  # at first the mean of all steps
        means = jax.tree.map(lambda old, new: old + share * (new - old), state.means, more["means"])
        updates, moments = inner.update(of_centred(updates, means), state.inner, params)
        return of_usual(updates, means), Centred(means, state.count + 1, moments)

    return init, update


def of_centred(gradient, means: Layers):
    """Gradients by K and b of y = K x + b -> those of y = K (x - m) + b, for equal y."""

    def change(part, m):
        outer = m[None, None, :, None] * part["bias"][None, None, None]
        return part | {"kernel": part["kernel"] - outer}

    return _each_layer(change, gradient, means)


def of_usual(updates, means: Layers):
    """Updates of K and b of y = K (x - m) + b -> those of y = K x + b, for equal y."""

    def change(part, m):
        return part | {"bias": part["bias"] - jnp.einsum("i,hwio->o", m, part["kernel"])}

    return _each_layer(change, updates, means)


def input_means(params, state: State, tensor: jax.Array) -> Layers:
    """A state, the normalised event tensor after it (B, H, W, 5) -> means of each layer's inputs.

    Those of the head count as zero, as event tensors are normalised.
    """

    def of(*maps):
        return jnp.concatenate([each.mean((0, 1, 2)) for each in maps])

    def convolved(part, maps, activations=("relu",)):
        return layer(maps, part["kernel"], part["bias"], activations)

    def gru(parts, h, x):
        r, z = convolved(parts["gates"], [x, h], ("sigmoid", "sigmoid"))
        (candidate,) = convolved(parts["candidate"], [x, r * h], ("tanh",))
        return h + z * (candidate - h), {"gates": of(x, h), "candidate": of(x, r * h)}

    def residual(parts, x):
        (between,) = convolved(parts["conv1"], [x])
        (change,) = convolved(parts["conv2"], [between], ("none",))
        return jax.nn.relu(x + change), {"conv1": of(x), "conv2": of(between)}

    (x,) = convolved(params["head"], [tensor])
    x, gru1 = gru(params["gru1"], state.g1, x)
    x, res1 = residual(params["res1"], x)
    x, gru2 = gru(params["gru2"], state.g2, x)
    x, res2 = residual(params["res2"], x)
    means = {"gru1": gru1, "res1": res1, "gru2": gru2, "res2": res2}
    return means | {"head": jnp.zeros(tensor.shape[-1]), "prediction": of(x)}


def _each_layer(change, params, *others):
    return jax.tree.map(change, params, *others, is_leaf=lambda part: "kernel" in part)


def _zeros(params) -> Layers:
    return _each_layer(lambda part: jnp.zeros(part["kernel"].shape[2]), params)
