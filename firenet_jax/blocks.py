"""Maps, kernels, biases -> maps: ConvGRU and residual block as fused operations, with gradients.

They equal the same layers applied one by one (`convolution.layer`), gradients included. Fused,
because on a CPU separate element-wise operations between two convolutions, each of which reads and
writes whole maps, take as long as the convolutions themselves. Maps are (B, H, W, 16) float32,
parameters (kernel, bias), 3x3. Functions named own_ are by machine code, those named xla_ by XLA.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

from firenet_jax import native
from firenet_jax.convolution import (
    ACTIVATIONS,
    CONVOLVED,
    by_xla,
    choose,
    convolved_by_xla,
    parameter_gradients,
    transposed_kernel,
)

Parameters = tuple[jax.Array, jax.Array]
_slope = ACTIVATIONS["sigmoid"][1]  # the derivative of the sigmoid where its value is y


def gru(h: jax.Array, x: jax.Array, gates: Parameters, candidate: Parameters) -> jax.Array:
    """r, z = sigmoid(gates([x, h])), q = tanh(candidate([x, r h])) -> h' = h + z (q - h).

    First gradients in reverse mode only. Residuals are named `CONVOLVED` (for jax.checkpoint).
    """
    return _gru(native.is_wanted(), h, x, gates, candidate)


def residual(x: jax.Array, first: Parameters, second: Parameters) -> jax.Array:
    """relu(x + second(relu(first(x)))); gradients as for `gru`."""
    return _residual(native.is_wanted(), x, first, second)


def _kept(maps):
    return tuple(checkpoint_name(each, CONVOLVED) for each in maps)


# ---- ConvGRU


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _gru(machine_code, h, x, gates, candidate):
    return _gru_forward(machine_code, h, x, gates, candidate)[0]


def _gru_forward(machine_code, h, x, gates, candidate):
    def own_gates(h, x, kernel, bias):
        return native.convolve([x, h], kernel, bias, ("none",) * 2, "gates", [h])

    def xla_gates(h, x, kernel, bias):
        reset, update = by_xla(("sigmoid", "sigmoid"), (x, h), kernel, bias)
        return reset, update, reset * h

    def own_candidate(h, update, x, left, kernel, bias):
        return native.convolve([x, left], kernel, bias, ending="candidate", operands=[h, update])

    def xla_candidate(h, update, x, left, kernel, bias):
        (q,) = by_xla(("tanh",), (x, left), kernel, bias)
        return q, h + update * (q - h)

    reset, update, left = _kept(choose(machine_code, own_gates, xla_gates, h, x, *gates))
    arguments = h, update, x, left, *candidate
    q, state = _kept(choose(machine_code, own_candidate, xla_candidate, *arguments))
    return state, (h, x, gates[0], candidate[0], reset, update, q)


def _gru_backward(machine_code, kept, by_state):
    h, x, gates, candidate, reset, update, q = kept

    def own_candidate(change, kernel, *operands):
        both = ("none", "none")
        return native.convolve([change], kernel, None, both, "candidate gradient", operands)

    def xla_candidate(change, kernel, h, reset, update, q, by_state):
        by_x, by_left = convolved_by_xla([change], kernel, 2)
        return (
            by_x,
            by_left * h * _slope(reset),
            by_state * (q - h) * _slope(update),
            by_left * reset + by_state * (1 - update),
        )

    def own_gates(changes, kernel, *operands):
        return native.convolve(changes, kernel, None, ("none",) * 2, "add both", operands)

    def xla_gates(changes, kernel, by_x, by_h):
        more_x, more_h = convolved_by_xla(changes, kernel, 2)
        return by_x + more_x, by_h + more_h

    change = by_state * update * (1 - q * q)
    left = reset * h  # recomputing is faster than storing it
    by_candidate = parameter_gradients(machine_code, (x, left), candidate, (change,))
    arguments = change, transposed_kernel(candidate), h, reset, update, q, by_state
    by_x, by_reset, by_update, by_h = choose(machine_code, own_candidate, xla_candidate, *arguments)
    changes = by_reset, by_update
    by_gates = parameter_gradients(machine_code, (x, h), gates, changes)
    arguments = changes, transposed_kernel(gates), by_x, by_h
    by_x, by_h = choose(machine_code, own_gates, xla_gates, *arguments)
    return by_h, by_x, by_gates, by_candidate


_gru.defvjp(_gru_forward, _gru_backward)


# ---- Residual block


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _residual(machine_code, x, first, second):
    return _residual_forward(machine_code, x, first, second)[0]


def _residual_forward(machine_code, x, first, second):
    def own_first(x, kernel, bias):
        return native.convolve([x], kernel, bias, ("relu",))

    def xla_first(x, kernel, bias):
        return by_xla(("relu",), (x,), kernel, bias)

    def own_second(x, between, kernel, bias):
        return native.convolve([between], kernel, bias, ending="residual", operands=[x])

    def xla_second(x, between, kernel, bias):
        return (jax.nn.relu(x + by_xla(("none",), (between,), kernel, bias)[0]),)

    (between,) = _kept(choose(machine_code, own_first, xla_first, x, *first))
    (result,) = _kept(choose(machine_code, own_second, xla_second, x, between, *second))
    return result, (x, first[0], second[0], between, result)


def _residual_backward(machine_code, kept, by_result):
    x, first, second, between, result = kept

    def own_second(change, kernel, between):
        return native.convolve([change], kernel, ending="positive", operands=[between])

    def xla_second(change, kernel, between):
        return (jnp.where(between > 0, convolved_by_xla([change], kernel, 1)[0], 0),)

    def own_first(change, kernel, by_result):
        return native.convolve([change], kernel, ending="add", operands=[by_result])

    def xla_first(change, kernel, by_result):
        return (convolved_by_xla([change], kernel, 1)[0] + by_result,)

    by_result = jnp.where(result > 0, by_result, 0)
    by_second = parameter_gradients(machine_code, (between,), second, (by_result,))
    arguments = by_result, transposed_kernel(second), between
    (change,) = choose(machine_code, own_second, xla_second, *arguments)
    by_first = parameter_gradients(machine_code, (x,), first, (change,))
    arguments = change, transposed_kernel(first), by_result
    (by_x,) = choose(machine_code, own_first, xla_first, *arguments)
    return by_x, by_first, by_second


_residual.defvjp(_residual_forward, _residual_backward)
