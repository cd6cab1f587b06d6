"""The stages of a step and of a convolution in memory between pages that nobody may touch.

A process of its own runs this, as it is killed by the first byte that is read or written beside an
array: before all of them, then, with other addresses, after them.

    python tests/guarded.py
"""

import ctypes
import mmap

import jax
import jax.numpy as jnp
import numpy as np
from test_trial import random_case

from firenet_jax import native
from firenet_jax.native import convolve3x3, endings, kernel_gradient, llvm, whole_step

PAGE = mmap.PAGESIZE
_protect = ctypes.CDLL(None, use_errno=True).mprotect
_memories = []


def guarded(array, at_end):
    """A copy of the array that ends, or begins, at a page which is not to be touched."""
    array = np.ascontiguousarray(array, np.float32)
    inside = -(-array.nbytes // PAGE) * PAGE
    memory = mmap.mmap(-1, inside + 2 * PAGE)
    _memories.append(memory)
    start = np.frombuffer(memory, np.uint8).ctypes.data
    for page in (start, start + PAGE + inside):
        assert _protect(ctypes.c_void_p(page), ctypes.c_size_t(PAGE), 0) == 0
    offset = PAGE + (inside - array.nbytes) * at_end
    copy = np.frombuffer(memory, np.float32, array.size, offset)
    copy[:] = array.ravel()
    return copy


def run(write, arrays, images, parts, at_end):
    """Stages, in order, their parts in any; write(module) -> stages. The arrays after it."""
    module = llvm.Module()
    stages = write(module)
    for stage in stages:
        stage.linkage = ""
    memory = [guarded(array, at_end) for array in arrays]
    pointers = np.array([each.ctypes.data for each in memory], np.uint64)
    address = llvm.compiled(module)
    signature = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64)
    for stage in stages:
        call = signature(address(stage.name))
        for part in np.random.default_rng(0).permutation(images * parts):
            call(pointers.ctypes.data, *divmod(int(part), parts))
    return memory


def check_step(height, width, normalise, at_end):
    rng, batch = np.random.default_rng(0), 2
    weights, state, tensors, valid = random_case(rng, height, width, batch, 1)
    packed, exists = native.pack(weights.params), valid[0].astype(jnp.float32)
    (g1, g2), image = native.step(packed, tuple(state), tensors[0], valid[0], normalise)
    size = whole_step.Size(height, width)
    before = [tensors[0], packed, exists, *state]
    after = [np.full(x.shape, np.nan) for x in (g1, g2, image)]
    scratch = np.full(batch * size.inner // 4, np.nan)
    memory = run(
        lambda module: whole_step._stages(module, size, normalise),
        [*before, *after, scratch],
        batch,
        size.down,
        at_end,
    )
    for found, expected in zip(memory, [*before, g1, g2, image], strict=False):
        np.testing.assert_array_equal(found, np.ravel(expected))


def check_layer(height, width, inputs, outputs, at_end):
    rng, batch = np.random.default_rng(0), 2
    image = rng.normal(size=(batch, height, width, inputs))
    gradient = rng.normal(size=(batch, height, width, outputs))
    kernel = rng.normal(size=(3, 3, inputs, outputs))
    image, gradient, kernel = (jnp.asarray(x, jnp.float32) for x in (image, gradient, kernel))
    layer = convolve3x3.Layer(height, width, (inputs,), ("none",), outputs, False)
    memory = run(
        lambda module: convolve3x3._stages(module, layer),
        [image, convolve3x3._kernel(layer, kernel), np.full(gradient.shape, np.nan)],
        batch,
        -(-height // convolve3x3.ROWS),
        at_end,
    )
    np.testing.assert_array_equal(memory[2], np.ravel(native.convolve([image], kernel)[0]))
    channels = (inputs,), (outputs,)
    numbers, parts = kernel_gradient._numbers(*channels), kernel_gradient._parts(height)
    memory = run(
        lambda module: kernel_gradient._stages(module, batch, height, width, *channels),
        [image, gradient, np.full(numbers, np.nan), np.full(batch * parts * numbers, np.nan)],
        batch,
        parts,
        at_end,
    )
    is_winograd = kernel_gradient._is_winograd(*channels)
    found = kernel_gradient._gradients(jnp.asarray(memory[2]), kernel, is_winograd)
    jax.tree.map(
        np.testing.assert_array_equal, found, native.gradients([image], kernel, [gradient])
    )


# Sums that an ending takes; each has a kernel of its own, of one map or two.
SUMS = {"gates": 2, "add both": 2, "candidate gradient": 2}


def check_ending(height, width, ending, at_end):
    rng, batch = np.random.default_rng(0), 2
    sums, maps = SUMS.get(ending, 1), 1 + (ending in ("gates", "candidate"))

    def normal(*shape):
        return jnp.asarray(0.3 * rng.normal(size=shape), jnp.float32)

    layer = convolve3x3.Layer(height, width, (16,) * maps, ("none",) * sums, 16, True, ending)
    images = [normal(batch, height, width, 16) for _ in range(maps)]
    others = [normal(batch, height, width, 16) for _ in range(layer.operands)]
    kernel, bias = normal(3, 3, 16 * maps, 16 * sums), normal(16 * sums)
    results = [np.full(images[0].shape, np.nan)] * layer.results
    before = [*images, convolve3x3._kernel(layer, kernel), bias, *others]
    memory = run(
        lambda module: convolve3x3._stages(module, layer),
        [*before, *results],
        batch,
        -(-height // convolve3x3.ROWS),
        at_end,
    )
    expected = native.convolve(images, kernel, bias, layer.activations, ending, others)
    for found, wanted in zip(memory, [*before, *expected], strict=True):
        np.testing.assert_array_equal(found, np.ravel(wanted))


if __name__ == "__main__":
    for at_end in (True, False):
        for size in [(1, 1), (5, 9), (13, 25), (4, 70)]:
            check_step(*size, normalise=size[0] % 2 == 1, at_end=at_end)
        for case in [
            (1, 1, 5, 16),
            (7, 9, 16, 32),
            (5, 70, 32, 16),
            (1, 1, 16, 16),
            (9, 33, 16, 16),
        ]:
            check_layer(*case, at_end=at_end)
        for ending in endings.ENDINGS:
            check_ending(5, 11, ending, at_end=at_end)
