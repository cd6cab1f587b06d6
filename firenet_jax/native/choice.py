"""(by machine code, by XLA), arrays -> arrays of whichever the platform can have.

The choice is made when a program is lowered, not when it is traced: then it is known for which
platform, and whether for export, where no machine code of ours can go along.
"""

import os
import warnings
from collections.abc import Callable
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from threading import RLock
from typing import Any

import jax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir

# In the environment: 0 for never, avx2 for as it is on processors without AVX-512.
SWITCH = "FIRENET_NATIVE"


class Unavailable(Exception):
    """There is no machine code for this; XLA computes it."""


def choose(machine_code: Callable, xla: Callable, *arguments):
    """machine_code(*arguments) in programs for a CPU, xla(*arguments) elsewhere and for export.

    Both take and give the same trees of arrays; neither is differentiated. Where `machine_code`
    raises Unavailable as it is traced, and where it is switched off, it is `xla` on a CPU too.
    """
    leaves, tree = jax.tree.flatten(arguments)
    results, result_tree = jax.tree.flatten(jax.eval_shape(xla, *arguments))

    def flat(function):
        return lambda *leaves: jax.tree.leaves(function(*tree.unflatten(leaves)))

    avals = tuple(ShapedArray(result.shape, result.dtype) for result in results)
    functions = {"machine_code": flat(machine_code), "xla": flat(xla)}
    return result_tree.unflatten(_choice.bind(*leaves, **functions, results=avals))


_choice = Primitive("machine_code_or_xla")
_choice.multiple_results = True


@_choice.def_impl
def _outside_of_programs(*arguments, xla, **parameters):
    # Without programs jit would come back here, and to find a NaN's origin it would, too.
    config: Any = jax.config
    if config.jax_disable_jit or config.jax_debug_nans or config.jax_debug_infs:
        return xla(*arguments)
    return jax.jit(partial(_choice.bind, xla=xla, **parameters))(*arguments)


@_choice.def_abstract_eval
def _results(*_, results, **__):
    return results


def _batched(arguments, axes, *, machine_code, xla, results):
    size = next(x.shape[axis] for x, axis in zip(arguments, axes, strict=True) if axis is not None)
    mapped = {
        "machine_code": jax.vmap(machine_code, axes, axis_size=size),
        "xla": jax.vmap(xla, axes, axis_size=size),
        "results": tuple(ShapedArray((size, *r.shape), r.dtype) for r in results),
    }
    return _choice.bind(*arguments, **mapped), [0] * len(results)


batching.primitive_batchers[_choice] = _batched


def _by_xla(context, *arguments, xla, **_):
    return mlir.lower_fun(xla)(context, *arguments)


def _on_cpu(context, *arguments, machine_code, xla, **_):
    if not context.module_context.lowering_parameters.for_export and not switched_off():
        try:
            return mlir.lower_fun(machine_code)(context, *arguments)
        except Unavailable:
            pass
    return mlir.lower_fun(xla)(context, *arguments)


mlir.register_lowering(_choice, _by_xla)
mlir.register_lowering(_choice, _on_cpu, platform="cpu")


def switched_off() -> bool:
    return os.environ.get(SWITCH) == "0"


_by_xla_alone = ContextVar("by_xla_alone", default=False)


@contextmanager
def by_xla_alone(alone: bool = True):
    """What is traced in this context has no machine code of ours, if `alone`."""
    token = _by_xla_alone.set(alone or _by_xla_alone.get())
    try:
        yield
    finally:
        _by_xla_alone.reset(token)


def is_wanted() -> bool:
    """Not so in the context of `by_xla_alone`. Gradients are traced later, in another context."""
    return not _by_xla_alone.get()


_made: dict = {}
_failure: list[Exception] = []
_making = RLock()  # threads that ask together: a name is registered once


def made(make: Callable, *settings) -> str:
    """make(*settings), compiled and registered when first asked for -> its name.

    Raises Unavailable, as `make` does where there is none of it; and, after one warning, for ever
    once anything else went wrong, whatever it was: slower is better than not at all.
    """
    with _making:
        if _failure:
            raise Unavailable from _failure[0]
        if (make, settings) not in _made:
            try:
                _made[make, settings] = make(*settings)
            except Unavailable:
                raise
            except Exception as error:
                _failure.append(error)
                warnings.warn(
                    "firenet_jax runs by XLA alone, which is slower, as machine code of its own "
                    f"cannot be made here ({type(error).__name__}: {error}); {SWITCH}=0 in the "
                    "environment ends this warning",
                    stacklevel=2,
                )
                raise Unavailable from error
        return _made[make, settings]
