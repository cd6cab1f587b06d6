import jax
import jax.numpy as jnp
import numpy as np
import pytest

from firenet_jax.foreign_call import register
from firenet_jax.machine_code import INT, POINTER, Function, Module, integer, vectors

pytestmark = pytest.mark.skipif(
    vectors() == 0 or jax.default_backend() != "cpu", reason="no machine code for this processor"
)


def test_every_part_runs_once_and_stages_wait_for_each_other():
    """Stage 0 adds 1 to each part's number, stage 1 adds its neighbour's to it (of 0: of the last).

    What stage 1 reads must be finished whoever wrote it, and no part may run twice.
    """
    parts, images, runs = 37, 3, 300
    module = Module()

    def stage(name, write):
        f = Function(module, name, [POINTER, INT, INT])
        pointers, image, part = f.arguments
        numbers, first, second = (f.load(POINTER, pointers, 8 * i) for i in range(3))
        here = f.times(f.b.add(f.times(image, parts), part), 8)
        left = f.b.srem(f.b.add(part, integer(parts - 1)), integer(parts))
        there = f.times(f.b.add(f.times(image, parts), left), 8)
        write(f, numbers, first, second, here, there)
        f.b.ret_void()
        return f.function

    def one(f, numbers, first, second, here, there):
        f.store(integer(0), second, here)
        f.store(f.b.add(f.load(INT, numbers, here), integer(1)), first, here)

    def two(f, numbers, first, second, here, there):
        value = f.b.add(f.load(INT, first, here), f.load(INT, first, there))
        f.store(f.b.add(f.load(INT, second, here), value), second, here)

    stages = [stage("one", one), stage("two", two)]
    register("firenet_test_parts", module, stages, parts, arguments=1, results=[0, 1])
    with jax.enable_x64(True):
        shape = jax.ShapeDtypeStruct((images, parts), jnp.int64)
        call = jax.jit(jax.ffi.ffi_call("firenet_test_parts", [shape, shape]))
        numbers = np.random.default_rng(0).integers(0, 1000, (images, parts))
        expected = numbers + 1 + np.roll(numbers + 1, 1, axis=1)
        for _ in range(runs):
            np.testing.assert_array_equal(call(numbers)[1], expected)
