"""A convolution's sums at a pixel -> its results there: activations, and what follows them.

Each is a function of vectors of 16 channels that writes instructions (`llvm.Function`). From
registers this costs nothing; as operations of XLA, each sends maps through memory once more.
"""

from collections.abc import Callable
from typing import NamedTuple

from firenet_jax.native.llvm import Function, vector

ACTIVATIONS = {
    "none": lambda f, x: x,
    "relu": Function.relu,
    "sigmoid": Function.sigmoid,
    "tanh": Function.tanh,
}


class Ending(NamedTuple):
    """What becomes of the sums of a pixel and of the same pixel of other maps, 16 channels each."""

    operands: int
    results: int
    write: Callable  # (function, sums, operands) -> results


def _gates(f: Function, sums, operands):
    """Reset, update, and what the first leaves of the state."""
    reset, update = map(f.sigmoid, sums)
    return [reset, update, f.b.fmul(reset, operands[0])]


def _candidate(f: Function, sums, operands):
    (before, update), candidate = operands, f.tanh(sums[0])
    return [candidate, f.fma(update, f.b.fsub(candidate, before), before)]


def _residual(f: Function, sums, operands):
    return [f.relu(f.b.fadd(sums[0], operands[0]))]


def _positive(f: Function, sums, operands):
    return [f.b.select(f.is_positive(operands[0]), sums[0], vector(0))]


def _add(f: Function, sums, operands):
    return [f.b.fadd(a, b) for a, b in zip(sums, operands, strict=True)]


def _candidate_gradient(f: Function, sums, operands):
    """See `blocks.gru`."""
    (by_input, by_left), (before, reset, update, candidate, by_state) = sums, operands

    def slope(y):
        return f.b.fmul(y, f.b.fsub(vector(1), y))

    change = f.b.fmul(by_state, f.b.fsub(candidate, before))
    stays = f.fma(by_left, reset, f.b.fmul(by_state, f.b.fsub(vector(1), update)))
    by_reset = f.b.fmul(f.b.fmul(by_left, before), slope(reset))
    return [by_input, by_reset, f.b.fmul(change, slope(update)), stays]


ENDINGS = {
    "gates": Ending(1, 3, _gates),
    "candidate": Ending(2, 2, _candidate),
    "residual": Ending(1, 1, _residual),
    "positive": Ending(1, 1, _positive),
    "add": Ending(1, 1, _add),
    "add both": Ending(2, 2, _add),
    "candidate gradient": Ending(5, 4, _candidate_gradient),
}
