import ctypes

import numpy as np
import pytest

pytest.importorskip("llvmlite")

from firenet_jax.native.llvm import (
    FLOAT,
    INT,
    LANES,
    POINTER,
    VECTOR,
    Function,
    Module,
    compiled,
    integer,
    vectors,
)

pytestmark = pytest.mark.skipif(vectors() == 0, reason="no machine code for this processor")


def function_of(name, write, *kinds, result=None):
    """A function of Python: write(Function) -> its result, or None."""
    module = Module()
    f = Function(module, name, list(kinds), result, public=True)
    value = write(f)
    _ = f.b.ret_void() if value is None else f.b.ret(value)
    types = {POINTER: ctypes.c_void_p, INT: ctypes.c_int64, FLOAT: ctypes.c_float, None: None}
    return ctypes.CFUNCTYPE(types[result], *map(types.get, kinds))(compiled(module)(name))


def of_lanes(name, write):
    """write(Function, vector) -> vector or number, as a function of an array."""

    def body(f):
        value = write(f, f.load(VECTOR, f.arguments[0]))
        f.store(value, f.arguments[1])

    function = function_of(name, body, POINTER, POINTER)

    def call(x):
        # Vectors lie at multiples of 64 bytes.
        memory = np.zeros(48 + 16, np.float32)
        start = -memory.ctypes.data // 4 % 16
        source, target = memory[start : start + 16], memory[start + 16 : start + 32]
        source[:] = x
        function(source.ctypes.data, target.ctypes.data)
        return target.copy()

    return call


@pytest.mark.parametrize("name", ["sigmoid", "tanh", "exp"])
def test_functions_of_numbers(name):
    function = of_lanes(name, lambda f, x: getattr(f, name)(x))
    exact = {"sigmoid": lambda x: 1 / (1 + np.exp(-x)), "tanh": np.tanh, "exp": np.exp}[name]
    x = np.concatenate([np.linspace(-20, 20, 4096), np.linspace(-86, 87, 160), [0.0] * 16])
    x = x.astype(np.float32)
    found = np.concatenate([function(part) for part in x.reshape(-1, LANES)])
    expected = exact(x.astype(np.float64))
    tolerance = {"sigmoid": 2e-7, "tanh": 4e-7, "exp": 4e-7 * expected}[name]
    assert np.all(np.abs(found - expected) <= tolerance)


def test_functions_of_numbers_at_the_ends():
    ends = np.array([-np.inf, -1e30, 1e30, np.inf, np.nan] + [0] * 11, np.float32)
    sigmoid = of_lanes("sigmoid_ends", lambda f, x: f.sigmoid(x))(ends)
    np.testing.assert_allclose(sigmoid[:4], [0, 0, 1, 1], atol=1e-30)
    tanh = of_lanes("tanh_ends", lambda f, x: f.tanh(x))(ends)
    np.testing.assert_allclose(tanh[:4], [-1, -1, 1, 1], atol=1e-6)
    relu = of_lanes("relu", lambda f, x: f.relu(x))(ends)
    np.testing.assert_array_equal(relu[:5], [0, 0, np.float32(1e30), np.inf, np.nan])


def test_reduce_and_splat():
    x = np.arange(16, dtype=np.float32) ** 2
    total = of_lanes(
        "total", lambda f, x: f.splat(f.reduce_add(x, f.b.extract_element(x, integer(2))))
    )
    np.testing.assert_array_equal(total(x), [x.sum() + 4] * 16)


def test_loops_carry_values():
    """The sum of i j for 2 <= i < n, 0 <= j < i."""

    def write(f):
        def outer(i, carried):
            return f.loop(0, i, lambda j, inner: [f.b.add(inner[0], f.b.mul(i, j))], carried)

        return f.loop(2, f.arguments[0], outer, [integer(0)])[0]

    function = function_of("loops", write, INT, result=INT)
    assert function(9) == sum(i * j for i in range(2, 9) for j in range(i))
