"""(maps, gradients of a convolution's sums) -> gradients of its kernel and bias, as machine code.

Those of the network's own convolutions go the way of `winograd`, too: with D = B^T d B and
Y = A^T [(G g G^T) * D] A,

    dg = G^T [sum over tiles of D * (A dY A^T)] G

with an outer product of inputs and outputs at each place. Those of other numbers of channels are
direct. Each part of an image has sums of its own; the second stage adds those of all parts, always
in the same order, so that results do not depend on how many threads came.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from firenet_jax.native.choice import Unavailable, made
from firenet_jax.native.convolve3x3 import check
from firenet_jax.native.foreign_call import register
from firenet_jax.native.llvm import (
    FLOAT,
    INT,
    LANES,
    POINTER,
    VECTOR,
    VECTOR_BYTES,
    Code,
    Function,
    Module,
    integer,
    vector,
    vectors,
)
from firenet_jax.native.winograd import (
    COLUMNS,
    GROUPS,
    PIXEL,
    PLACES,
    ROWS,
    Tiling,
    kernel_gradients,
    outer,
    spread,
    transform,
)

PART = 8  # rows of an image, what a thread takes at a time
GROUP = 8  # inputs whose gradients are summed at a time, for the three columns of the kernel


def _parts(height: int) -> int:
    return -(-height // PART)


def _is_winograd(maps: tuple, gradients: tuple) -> bool:
    return set(maps + gradients) == {LANES}


def _numbers(maps: tuple, gradients: tuple) -> int:
    """Of a part: the kernel's places and the bias."""
    places = len(GROUPS) * PLACES if _is_winograd(maps, gradients) else 9
    return (places * sum(maps) + 1) * sum(gradients)


def _products(
    module: Module,
    width: int,
    inputs: int,
    outputs: int,
    of_map: int,
    group: int,
    of_gradient: int,
) -> Code:
    """products(row of the image, row of the gradient, sums): added to three columns of the kernel.

    A pixel of the image meets the gradients of its three neighbours in the row; the sums of `group`
    inputs with 16 outputs stay in registers on the way through it.
    """
    f = Function(module, f"products{of_map}_{group}_{of_gradient}", [POINTER] * 3)
    f.function.attributes.add("noinline")
    pixels, gradients, sums = f.arguments

    places = [4 * (j * inputs + c) * outputs for j in range(3) for c in range(group)]
    values = [f.load_unaligned(VECTOR, sums, place) for place in places]

    def add(x, three, values):
        """three: the gradients to the right of this pixel, here, and to the left."""
        here = f.at(pixels, f.times(x, 4 * of_map))
        for c in range(group):
            number = f.splat(f.load(FLOAT, here, 4 * c))
            for j in range(3):
                values[j * group + c] = f.fma(number, three[j], values[j * group + c])
        return values

    def pixel(x, carried):
        here, left, *values = carried
        right = f.load_unaligned(VECTOR, gradients, f.times(x, 4 * of_gradient), 4 * of_gradient)
        return [right, here, *add(x, (right, here, left), values)]

    carried = [f.load_unaligned(VECTOR, gradients), vector(0), *values]
    if width > 1:
        carried = f.loop(0, width - 1, pixel, carried)
    here, left, *values = carried
    values = add(integer(width - 1), (vector(0), here, left), values)
    for place, value in zip(places, values, strict=True):
        f.store_unaligned(value, sums, place)
    f.b.ret_void()
    return f.function


def _begin(module: Module, height: int, width: int, maps: tuple, gradients: tuple) -> tuple:
    """A function of some rows of an image: its maps, its gradients, and its own sums, all zero."""
    f = Function(module, "sums", [POINTER, INT, INT])
    pointers, image, part = f.arguments
    *arrays, _, partial = f.pointers(pointers, len(maps) + len(gradients) + 2)
    arrays = [
        f.at(array, f.times(image, 4 * height * width * channels))
        for array, channels in zip(arrays, maps + gradients, strict=True)
    ]
    whole = 4 * _numbers(maps, gradients)
    index = f.b.add(f.times(image, _parts(height)), part)
    partial = f.at(partial, f.times(index, whole))
    f.memset(partial, whole)
    return f, arrays[: len(maps)], arrays[len(maps) :], partial


def _biases(f: Function, there: list, gradients: tuple, rows: tuple, width: int, target) -> None:
    """Sums of each channel of the gradients over some rows, from the first to before the last."""
    first, last = rows
    column = 0
    for gradient, channels in zip(there, gradients, strict=True):
        for lane in range(0, 4 * channels, VECTOR_BYTES):

            def of_row(y, total, gradient=gradient, channels=channels, lane=lane):
                row = f.at(gradient, f.times(y, 4 * width * channels), lane)

                def add(x, total):
                    here = f.load_unaligned(VECTOR, row, f.times(x, 4 * channels))
                    return [f.b.fadd(total[0], here)]

                return f.loop(0, width, add, total)

            f.store_unaligned(f.loop(first, last, of_row, [vector(0)])[0], target, column + lane)
        column += 4 * channels


def _by_winograd(module: Module, height: int, width: int, maps: tuple, gradients: tuple) -> Code:
    """Of some rows of an image: its own sums, of 24 places instead of 9, and the bias's."""
    f, sources, there, partial = _begin(module, height, width, maps, gradients)
    size, inputs, outputs = Tiling(height, width), sum(maps), sum(gradients)
    _, _, part = f.arguments
    of_maps = [transform(module, size, rows) for rows in GROUPS]
    of_gradients = [spread(module, size, rows) for rows in GROUPS]
    products = outer(module, size, inputs, outputs)
    tiles = ROWS.tile, COLUMNS.tile * size.block
    patches = [size.patch] * len(maps) + [tiles] * len(gradients)
    rooms = [f.alloca(rows * columns * PIXEL) for rows, columns in patches]
    each = PLACES * size.place
    transformed, changes = (f.alloca(each * len(arrays)) for arrays in (maps, gradients))

    def block(top, i):
        # The last block may go beyond the row: there are zeros.
        left = f.times(i, COLUMNS.tile * size.block)
        before = f.b.sub(top, integer(1)), f.b.sub(left, integer(1))
        corners = [before] * len(maps) + [(top, left)] * len(gradients)
        places = [
            f.patch(array, (height, width), PIXEL, corner, patch, room)
            for array, corner, patch, room in zip(
                sources + there, corners, patches, rooms, strict=True
            )
        ]
        for group, (of_map, of_gradient) in enumerate(zip(of_maps, of_gradients, strict=True)):
            for k, (begin, line) in enumerate(places[: len(maps)]):
                f.b.call(of_map, [begin, line, f.at(transformed, k * each)])
            for k, (begin, line) in enumerate(places[len(maps) :]):
                f.b.call(of_gradient, [begin, line, f.at(changes, k * each)])
            for m in range(len(maps)):
                for g in range(len(gradients)):
                    row = group * PLACES * inputs + m * LANES
                    sums = f.at(partial, 4 * (row * outputs + g * LANES))
                    f.b.call(products, [f.at(transformed, m * each), f.at(changes, g * each), sums])

    first, last = f.rows(part, PART, height)
    end = f.b.sdiv(f.b.add(last, integer(ROWS.tile - 1)), integer(ROWS.tile))

    def row_of_tiles(y, _):
        top = f.times(y, ROWS.tile)
        f.loop(0, -(-size.across // size.block), lambda i, _: block(top, i))

    f.loop(f.b.sdiv(first, integer(ROWS.tile)), end, row_of_tiles)
    biases = f.at(partial, 4 * len(GROUPS) * PLACES * inputs * outputs)
    _biases(f, there, gradients, (first, last), width, biases)
    f.b.ret_void()
    return f.function


def _directly(module: Module, height: int, width: int, maps: tuple, gradients: tuple) -> Code:
    """Of some rows of an image: its own sums, all of the kernel's gradient and the bias's."""
    f, sources, there, partial = _begin(module, height, width, maps, gradients)
    _, _, part = f.arguments
    inputs, outputs = sum(maps), sum(gradients)
    most = GROUP if vectors() == 32 else 2
    code = {}
    first, last = f.rows(part, PART, height)

    def products(pixels, c, of_map, gradient, lane, of_gradient, sums):
        """Of some channels of a map and a vector of a gradient, for all rows of the kernel."""
        group = min(most, of_map - c)
        key = of_map, group, of_gradient
        if key not in code:
            code[key] = _products(module, width, inputs, outputs, *key)

        def of_kernel_row(i, _):
            def of_row(y, _):
                above = f.b.add(y, f.b.sub(i, integer(1)))
                with f.b.if_then(f.b.and_(f.less(-1, above), f.less(above, height))):
                    here = f.at(pixels, f.times(above, 4 * width * of_map), 4 * c)
                    beside = f.at(gradient, f.times(y, 4 * width * of_gradient), lane)
                    rows = f.at(sums, f.times(i, 4 * 3 * inputs * outputs))
                    f.b.call(code[key], [here, beside, rows])

            f.loop(first, last, of_row)

        f.loop(0, 3, of_kernel_row)

    _biases(f, there, gradients, (first, last), width, f.at(partial, 4 * 9 * inputs * outputs))
    before = 0
    for pixels, of_map in zip(sources, maps, strict=True):
        for c in range(0, of_map, most):
            column = 0
            for gradient, of_gradient in zip(there, gradients, strict=True):
                for lane in range(0, 4 * of_gradient, VECTOR_BYTES):
                    sums = f.at(partial, 4 * (before + c) * outputs + 4 * column + lane)
                    products(pixels, c, of_map, gradient, lane, of_gradient, sums)
                column += of_gradient
        before += of_map
    f.b.ret_void()
    return f.function


def _total(module: Module, batch: int, height: int, arrays: int, numbers: int) -> Code:
    """Some of these gradients, of so many numbers: the sums of all parts of all images.

    arrays: how many come before the result.
    """
    f = Function(module, "total", [POINTER, INT, INT])
    pointers, image, part = f.arguments
    result, partial = f.pointers(pointers, arrays + 2)[arrays:]
    count, whole = batch * _parts(height), numbers // LANES
    each = -(-whole // count)
    index = f.b.add(f.times(image, _parts(height)), part)
    first = f.times(index, each)
    last = f.min(f.b.add(first, integer(each)), whole)

    def one(i, _):
        here = f.times(i, VECTOR_BYTES)

        def add(k, total):
            value = f.load_unaligned(VECTOR, partial, f.times(k, whole * VECTOR_BYTES), here)
            return [f.b.fadd(total[0], value)]

        f.store_unaligned(f.loop(0, count, add, [vector(0)])[0], result, here)

    with f.b.if_then(f.less(first, last)):
        f.loop(first, last, one)
    f.b.ret_void()
    return f.function


def _stages(
    module: Module, batch: int, height: int, width: int, maps: tuple, gradients: tuple
) -> list[Code]:
    write = _by_winograd if _is_winograd(maps, gradients) else _directly
    sums = write(module, height, width, maps, gradients)
    arrays, numbers = len(maps) + len(gradients), _numbers(maps, gradients)
    return [sums, _total(module, batch, height, arrays, numbers)]


def _make_gradient(batch: int, height: int, width: int, maps: tuple, gradients: tuple) -> str:
    module = Module()
    stages = _stages(module, batch, height, width, maps, gradients)
    sizes = "_".join(map(str, (batch, height, width, *maps, "by", *gradients)))
    name = f"firenet_kernel_gradient_{sizes}"
    arrays, parts = len(maps) + len(gradients), _parts(height)
    scratch = 4 * parts * _numbers(maps, gradients)
    register(name, module, stages, parts, arrays, results=1, scratch=scratch)
    return name


def _gradients(both: jax.Array, kernel: jax.Array, is_winograd: bool):
    """What the stages wrote -> the gradients of kernel and bias."""
    inputs, outputs = kernel.shape[2:]
    by_kernel, by_bias = jnp.split(both, [len(both) - outputs])
    if is_winograd:
        by_kernel = kernel_gradients(by_kernel.reshape(-1, inputs * outputs))
    return by_kernel.reshape(kernel.shape), by_bias


def gradients(
    maps: Sequence[jax.Array], kernel: jax.Array, changes: Sequence[jax.Array]
) -> tuple[jax.Array, jax.Array]:
    """Maps (B, H, W, .), (3, 3, I, O), the sums' gradients -> those of kernel and bias (O,)."""
    check(kernel, maps, changes)
    batch, height, width, _ = maps[0].shape
    channels = [tuple(x.shape[3] for x in arrays) for arrays in (maps, changes)]
    if any(outputs % LANES for outputs in channels[1]) or sum(channels[1]) != kernel.shape[3]:
        raise Unavailable
    call = jax.ffi.ffi_call(
        made(_make_gradient, batch, height, width, *channels),
        jax.ShapeDtypeStruct((_numbers(*channels),), jnp.float32),
        vmap_method="sequential",
    )
    return _gradients(call(*maps, *changes), kernel, _is_winograd(*channels))
