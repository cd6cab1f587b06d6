"""Arrays -> arrays: what is quicker as machine code of our own than as XLA's, on a CPU.

    step                        one window of the network, of packed parameters
    convolve, gradients         a 3x3 layer of training; gradients of its kernel and bias
    choose                      these or what XLA computes, as platform, export and switch have it
    by_xla_alone, is_wanted     the switch for a part of a program

Nothing else is for outside. Without llvmlite, on other processors, or with FIRENET_NATIVE=0 in the
environment, `choose` takes XLA's.
"""

import importlib

from firenet_jax.native.choice import Unavailable, by_xla_alone, choose, is_wanted

_HOME = {
    "convolve": "convolve3x3",
    "gradients": "kernel_gradient",
    "pack": "whole_step",
    "step": "whole_step",
}

__all__ = ["Unavailable", "by_xla_alone", "choose", "is_wanted", *sorted(_HOME)]


def __getattr__(name: str):
    """Raises Unavailable where there is no llvmlite, so that everything else works without it."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        module = importlib.import_module(f"{__name__}.{_HOME[name]}")
    except ImportError as error:
        raise Unavailable from error
    return getattr(module, name)
