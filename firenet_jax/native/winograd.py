"""Patches of maps -> sums of 3x3 convolutions: Winograd's F(4x2, 3x3), as machine code.

Direct convolutions run near the processor's rate already: less time takes fewer products. Winograd
(Lavin and Gray, "Fast Algorithms for Convolutional Neural Networks", CVPR 2016, Eqs. 5 to 8) needs
24 instead of 72 for 4 rows of 2 pixels,

    Y = A^T [sum over inputs of (G g G^T) * (B^T d B)] A

with * element by element, d a patch of 6x4 pixels of an input and g its kernel. Maps have 16
channels a pixel, or whole steps of 8.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from firenet_jax.native.llvm import (
    FLOAT,
    INT,
    LANES,
    POINTER,
    VECTOR,
    Code,
    Function,
    Module,
    integer,
    vector,
    vectors,
)

PIXEL = 4 * LANES  # bytes
STEP = 8  # inputs of a convolution between two jumps


class Winograd(NamedTuple):
    """F(tile, 3): so many outputs in one direction, of `patch` pixels, with as many products."""

    tile: int
    patch: int
    kernel: np.ndarray  # G
    input: np.ndarray  # B^T
    butterfly: np.ndarray
    output: np.ndarray  # A^T is output @ butterfly


def _winograd(*halves: float) -> Winograd:
    """Interpolation at each of these numbers and its negative, at 0, and at infinity."""
    points = [*(sign * half for half in halves for sign in (1, -1)), 0.0]
    tile, patch = len(points) - 1, len(points) + 1
    kernel, polynomials = [], []
    for point in points:
        others = [other for other in points if other != point]
        scale = np.prod([point - other for other in others])
        kernel.append([point**k / scale for k in range(3)])
        polynomials.append([*np.poly(others)[::-1], 0])
    # What belongs to a number and its negative is added and subtracted first.
    butterfly, output = np.eye(patch), np.zeros((tile, patch))
    output[0, -2] = output[-1, -1] = 1
    for i, half in zip(range(0, patch, 2), halves, strict=False):
        butterfly[i : i + 2, i : i + 2] = [[1, 1], [1, -1]]
        for k in range(tile):
            output[k, i + k % 2] = half**k
    polynomials.append(np.poly(points)[::-1])
    return Winograd(
        tile,
        patch,
        np.array([*kernel, [0, 0, 1]], np.float32),
        np.array(polynomials),
        butterfly,
        output,
    )


# Of F(4, 3)'s numbers with few bits those of the least error; the usual 1 and 2 have twice of it.
# F(4, 3) in both directions is a tenth faster, but not exact to 1e-5 in all states.
ROWS, COLUMNS = _winograd(5 / 8, 3 / 2), _winograd(1)
# Two of the six rows of transformed patches at a time: with the kernels for them and the pixels
# that they are made of they stay in the nearest cache, all six would not.
GROUPS = [slice(row, row + 2) for row in range(0, ROWS.patch, 2)]
PLACES = 2 * COLUMNS.patch  # of two rows


class Tiling(NamedTuple):
    """Of images, and of their tiles."""

    height: int
    width: int

    @property
    def block(self) -> int:
        """Tiles of a row that are worked on together, their sums in registers.

        A number that leaves little over: a block of n costs about as much as n + 1. With more than
        8, caches overflow; with fewer, products wait for the sums that they are added to.
        """
        most = min(self.across, 8 if vectors() == 32 else 6)
        return min(range(1, most + 1), key=lambda n: -(-self.across // n) * (n + 1))

    @property
    def down(self) -> int:
        return -(-self.height // ROWS.tile)

    @property
    def across(self) -> int:
        return -(-self.width // COLUMNS.tile)

    @property
    def patch(self) -> tuple[int, int]:
        """Rows and columns of pixels that a block is made of."""
        return ROWS.patch, COLUMNS.tile * self.block + 2

    @property
    def place(self) -> int:
        """Bytes of one place of all tiles of a block."""
        return self.block * PIXEL


def kernels(flat: jax.Array) -> jax.Array:
    """G g G^T of kernels (9, N) -> (24, N), places by `GROUPS`."""
    return jnp.matmul(np.kron(ROWS.kernel, COLUMNS.kernel), flat, precision="highest")


def kernel_gradients(flat: jax.Array) -> jax.Array:
    """The gradients of `kernels`, (24, N) -> (9, N)."""
    return jnp.matmul(np.kron(ROWS.kernel, COLUMNS.kernel).T, flat, precision="highest")


def _linear(f: Function, matrix: np.ndarray, values: list) -> list:
    """The matrix times vectors; None for a row of zeros.

    Two rows that differ only in signs share what they have in common.
    """

    def combined(row):
        result = None
        for factor, value in zip(row, values, strict=True):
            if factor and result is None:
                result = value if factor == 1 else f.b.fmul(vector(factor), value)
            elif factor:
                result = f.fma(vector(factor), value, result)
        return result

    results = []
    for i, row in enumerate(matrix):
        before, after = matrix[i - 1], matrix[min(i + 1, len(matrix) - 1)]
        if i and np.array_equal(abs(row), abs(before)) and not np.array_equal(row, before):
            continue
        if np.array_equal(abs(row), abs(after)) and not np.array_equal(row, after):
            same = combined(np.where(row == after, row, 0))
            other = combined(np.where(row == after, 0, row))
            results += [f.b.fadd(same, other), f.b.fsub(same, other)]
        else:
            results.append(combined(row))
    return results


def transform(module: Module, size: Tiling, rows: slice) -> Code:
    """transform(upper left neighbour of a block, bytes of a row, transformed): B^T d B.

    Transformed are (places, tiles).
    """
    f = Function(module, f"transform{rows.start}", [POINTER, INT, POINTER])
    f.function.attributes.add("noinline")
    corner, line, transformed = f.arguments
    lines = [f.times(line, y) for y in range(ROWS.patch)]

    def column(pixel, x):
        pixels = [f.load_unaligned(VECTOR, pixel, line, x * PIXEL) for line in lines]
        return _linear(f, ROWS.input[rows], pixels)

    def tile(t, left):
        """The first two of its columns are the last two of the tile to the left."""
        here = f.at(corner, f.times(t, COLUMNS.tile * PIXEL))
        new = [column(here, x) for x in range(2, COLUMNS.patch)]
        columns = [left[:2], left[2:], *new]
        for i, row in enumerate(zip(*columns, strict=True)):
            for j, value in enumerate(_linear(f, COLUMNS.input, list(row))):
                f.store(value, transformed, f.times(t, PIXEL), (COLUMNS.patch * i + j) * size.place)
        return [*columns[-2], *columns[-1]]

    f.loop(0, size.block, tile, [*column(corner, 0), *column(corner, 1)])
    f.b.ret_void()
    return f.function


def multiply(module: Module, size: Tiling) -> Code:
    """multiply(transformed, kernels, rows of them to a place, sums, maps, channels of each): sums,
    (places, tiles)."""
    f = Function(module, "multiply", [POINTER, POINTER, INT, POINTER, INT, INT])
    f.function.attributes.add("noinline")
    transformed, kernels, rows, sums, maps, channels = f.arguments
    # Two sums of half as many inputs, added at the end, are rounded less; they take no longer where
    # there are registers for both.
    halves = 2 if vectors() == 32 else 1

    def place(i, _):
        def source(s, values):
            tiles = f.at(transformed, f.times(s, PLACES * size.place), f.times(i, size.place))
            row = f.b.add(f.b.mul(i, rows), f.b.mul(s, channels))
            kernel = f.at(kernels, f.times(row, PIXEL))

            def steps(i, values):
                for c in range(STEP):
                    outputs = f.load_unaligned(VECTOR, kernel, f.times(i, STEP * PIXEL), c * PIXEL)
                    numbers = f.at(tiles, f.times(i, 4 * STEP), 4 * c)
                    for t in range(size.block):
                        number, k = f.splat(f.load(FLOAT, numbers, t * PIXEL)), c % halves
                        place = k * size.block + t
                        values[place] = f.fma(number, outputs, values[place])
                return values

            return f.loop(0, f.b.sdiv(channels, integer(STEP)), steps, values)

        values = f.loop(0, maps, source, [vector(0)] * (halves * size.block))
        for t in range(size.block):
            first, *second = values[t :: size.block]
            value = f.b.fadd(first, *second) if second else first
            f.store(value, sums, f.times(i, size.place), t * PIXEL)

    f.loop(0, PLACES, place)
    f.b.ret_void()
    return f.function


def spread(module: Module, size: Tiling, rows: slice) -> Code:
    """spread(upper left pixel of a block, bytes of a row, spread): A Y A^T, of tiles of 4x2 pixels.

    Gradients go back through `restore` in this way. Spread are (places, tiles).
    """
    f = Function(module, f"spread{rows.start}", [POINTER, INT, POINTER])
    f.function.attributes.add("noinline")
    corner, line, places = f.arguments
    down, across = ((each.output @ each.butterfly).T for each in (ROWS, COLUMNS))
    lines = [f.times(line, y) for y in range(ROWS.tile)]

    def tile(t, _):
        here = f.at(corner, f.times(t, COLUMNS.tile * PIXEL))
        columns = [
            _linear(
                f, down[rows], [f.load_unaligned(VECTOR, here, line, x * PIXEL) for line in lines]
            )
            for x in range(COLUMNS.tile)
        ]
        for i, row in enumerate(zip(*columns, strict=True)):
            for j, value in enumerate(_linear(f, across, list(row))):
                f.store(value, places, f.times(t, PIXEL), (COLUMNS.patch * i + j) * size.place)

    f.loop(0, size.block, tile)
    f.b.ret_void()
    return f.function


def outer(module: Module, size: Tiling, inputs: int, outputs: int) -> Code:
    """outer(transformed, spread, sums): of each place, products of 16 inputs with 16 outputs, added
    to sums (places, inputs, outputs)."""
    f = Function(module, "outer", [POINTER] * 3)
    f.function.attributes.add("noinline")
    transformed, gradients, sums = f.arguments
    together = LANES if vectors() == 32 else 4  # sums that stay in registers

    def place(i, _):
        maps, changes = (f.at(each, f.times(i, size.place)) for each in (transformed, gradients))

        def some(k, _):
            here = f.at(sums, f.times(i, 4 * inputs * outputs))
            here = f.at(here, f.times(k, 4 * together * outputs))
            numbers = f.at(maps, f.times(k, 4 * together))

            def tile(t, values):
                t = f.times(t, PIXEL)
                change = f.load(VECTOR, changes, t)
                return [
                    f.fma(f.splat(f.load(FLOAT, numbers, t, 4 * c)), change, value)
                    for c, value in enumerate(values)
                ]

            values = [f.load_unaligned(VECTOR, here, 4 * c * outputs) for c in range(together)]
            for c, value in enumerate(f.loop(0, size.block, tile, values)):
                f.store_unaligned(value, here, 4 * c * outputs)

        f.loop(0, LANES // together, some)

    f.loop(0, PLACES, place)
    f.b.ret_void()
    return f.function


def restore(module: Module, size: Tiling, rows: slice) -> Code:
    """restore(sums, pixels): A^T sums A, added to the pixels of the block; the first rows begin."""
    f = Function(module, f"restore{rows.start}", [POINTER, POINTER])
    f.function.attributes.add("noinline")
    sums, pixels = f.arguments

    def tile(t, _):
        here = f.at(sums, f.times(t, PIXEL))
        places = [f.load(VECTOR, here, i * size.place) for i in range(PLACES)]
        across = []
        for row in (places[: COLUMNS.patch], places[COLUMNS.patch :]):
            across.append(_linear(f, COLUMNS.output, _linear(f, COLUMNS.butterfly, row)))
        for x, pair in enumerate(zip(*across, strict=True)):
            pair = _linear(f, ROWS.butterfly[rows, rows], list(pair))
            for y, value in enumerate(_linear(f, ROWS.output[:, rows], pair)):
                place = f.at(pixels, f.times(t, COLUMNS.tile * PIXEL))
                place = f.at(place, y * COLUMNS.tile * size.place + x * PIXEL)
                if value is not None:
                    before = f.load(VECTOR, place) if rows.start else None
                    f.store(f.b.fadd(before, value) if before else value, place)

    f.loop(0, size.block, tile)
    f.b.ret_void()
    return f.function


class Block:
    """Writes, into a function, the convolutions of blocks of tiles with several kernels."""

    def __init__(self, module: Module, size: Tiling):
        self.size = size
        self.transform = [transform(module, size, rows) for rows in GROUPS]
        self.multiply = multiply(module, size)
        self.restore = [restore(module, size, rows) for rows in GROUPS]

    def memory(self, f: Function, maps: int, results: int) -> tuple:
        """What is needed between the calls: of all blocks of a function, one after the other."""
        size = self.size
        transformed = f.alloca(maps * PLACES * size.place)
        sums = f.alloca(PLACES * size.place)
        return transformed, sums, [f.alloca(ROWS.tile * self.line) for _ in range(results)]

    @property
    def line(self) -> int:
        """Bytes of a row of a block's results."""
        return COLUMNS.tile * self.size.place

    def write(
        self, f: Function, memory: tuple, corners: list, inputs: int, kernel: Callable, rows: int
    ):
        """The sums of a block, one row of pixels after the other, into memory[2].

        corners: of each map the upper left neighbour of the block and the bytes of a row.
        inputs: of all maps. kernel(group, result): where the kernels of a group of places begin.
        rows: of 16 outputs each, from a place of a kernel to its next.
        """
        transformed, sums, results = memory
        maps = len(corners)
        for group, (forth, back) in enumerate(zip(self.transform, self.restore, strict=True)):
            for s, (corner, line) in enumerate(corners):
                there = f.at(transformed, s * PLACES * self.size.place)
                f.b.call(forth, [corner, line, there])
            for i, result in enumerate(results):
                numbers = [integer(n) for n in (rows, maps, inputs // maps)]
                here = [transformed, kernel(group, i), numbers[0], sums, *numbers[1:]]
                f.b.call(self.multiply, here)
                f.b.call(back, [sums, result])
