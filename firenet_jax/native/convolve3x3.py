"""(image, kernel) -> image: the 3x3 convolution of training as machine code; its kernel's gradient.

Direct, zero padding, float32: images (B, H, W, inputs), kernels (3, 3, inputs, outputs), outputs a
multiple of 16. Winograd's products would be fewer, but a training step keeps and reads so much
more than it computes that there is little left to win.

What takes the time are multiply-adds of a number of one array, in all lanes, with 16 outputs in a
register, added to sums that stay in registers: as many as a processor has, for it begins a
multiply-add long before the last one has ended.
"""

import jax
import jax.numpy as jnp

from firenet_jax.native.choice import Unavailable, made
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

ROWS = 4  # of the result: what a thread takes at a time
GROUP = 8  # inputs whose gradients are summed at a time, for the three columns of the kernel


def _parts(height: int) -> int:
    return -(-height // ROWS)


def _rows(f: Function, part, height: int):
    """Of this part: the first row, and the one after the last."""
    first = f.times(part, ROWS)
    return first, f.min(f.b.add(first, integer(ROWS)), height)


def _pointers(f: Function, pointers, count: int) -> list:
    return [f.load(POINTER, pointers, 8 * i) for i in range(count)]


def _between(f: Function, value, least: int, most: int):
    value = f.b.select(f.less(value, least), integer(least), value)
    return f.min(value, most)


# --- The convolution ---------------------------------------------------------------------------


def _width_of_block(width: int, sums: int) -> int:
    """Pixels of a row that are worked on together; a number that leaves little over."""
    most = max(1, min(width, sums))
    return min(range(1, most + 1), key=lambda n: (-(-width // n) * (n + 1), -n))


def _block(module: Module, pixels: int, inputs: int, outputs: int, lanes: int) -> Code:
    """block(upper left neighbour, bytes of a row of it, kernel, target): so many pixels of a row.

    Of `lanes` vectors of outputs, in arrays of `outputs`.
    """
    name = f"block{pixels}_{lanes}"
    f = Function(module, name, [POINTER, INT, POINTER, POINTER])
    f.function.attributes.add("noinline")
    corner, line, kernel, target = f.arguments
    across = 3 * inputs  # numbers of a row of the kernel, and of an image that it meets
    steps = max(n for n in range(1, 9) if across % n == 0)

    def row(i, sums):
        numbers, weights = f.at(corner, f.b.mul(i, line)), f.times(i, 4 * across * outputs)

        def some(m, sums):
            here = f.at(numbers, f.times(m, 4 * steps))
            there = f.at(kernel, weights, f.times(m, 4 * steps * outputs))
            for step in range(steps):
                by = [
                    f.load_unaligned(VECTOR, there, 4 * step * outputs + v * VECTOR_BYTES)
                    for v in range(lanes)
                ]
                for n in range(pixels):
                    number = f.splat(f.load(FLOAT, here, 4 * (n * inputs + step)))
                    for v in range(lanes):
                        sums[n * lanes + v] = f.fma(number, by[v], sums[n * lanes + v])
            return sums

        return f.loop(0, across // steps, some, sums)

    sums = f.loop(0, 3, row, [vector(0)] * (pixels * lanes))
    for i, value in enumerate(sums):
        n, v = divmod(i, lanes)
        f.store_unaligned(value, target, 4 * n * outputs + v * VECTOR_BYTES)
    f.b.ret_void()
    return f.function


def _convolution(module: Module, height: int, width: int, inputs: int, outputs: int) -> Code:
    """Some rows of the result. Where a block ends with the image, zeros are put around it first."""
    f = Function(module, "convolution", [POINTER, INT, INT])
    pointers, image, part = f.arguments
    source, kernel, target = _pointers(f, pointers, 3)
    room = 28 if vectors() == 32 else 6  # sums in registers, beside what is added to them
    lanes = 2 if outputs % (2 * LANES) == 0 else 1
    pixels = _width_of_block(width, room // lanes)
    block = _block(module, pixels, inputs, outputs, lanes)
    pixel, line = 4 * inputs, 4 * inputs * width
    enclosed_line = (pixels + 2) * pixel
    enclosed = f.alloca(3 * enclosed_line)
    source = f.at(source, f.times(image, height * line))
    target = f.at(target, f.times(image, 4 * height * width * outputs))

    def enclose(y, left):
        f.memset(enclosed, 3 * enclosed_line)
        start = _between(f, f.b.sub(left, integer(1)), 0, width)
        stop = _between(f, f.b.add(left, integer(pixels + 1)), 0, width)
        skipped = f.b.add(f.b.sub(start, left), integer(1))

        def row(i, _):
            here = f.b.add(y, f.b.sub(i, integer(1)))
            inside = f.b.and_(f.less(-1, here), f.less(here, height))
            with f.b.if_then(inside):
                f.memcpy(
                    f.at(enclosed, f.times(i, enclosed_line), f.times(skipped, pixel)),
                    f.at(source, f.times(here, line), f.times(start, pixel)),
                    f.times(f.b.sub(stop, start), pixel),
                )

        f.loop(0, 3, row)

    def of_row(y, _):
        is_inside = f.b.and_(f.less(0, y), f.less(y, height - 1))

        def of_block(i, _):
            # The last block begins early enough to end with the row.
            left = f.min(f.times(i, pixels), width - pixels)
            inside = f.b.and_(f.less(0, left), f.less(left, width - pixels))
            inside = f.b.and_(inside, is_inside)
            with f.b.if_then(f.b.not_(inside)):
                enclose(y, left)
            corner = f.at(source, f.times(y, line), f.times(left, pixel), -line - pixel)
            corner = f.b.select(inside, corner, enclosed)
            stride = f.b.select(inside, integer(line), integer(enclosed_line))
            there = f.at(target, f.times(f.b.add(f.times(y, width), left), 4 * outputs))

            def of_lanes(v, _):
                first = f.times(v, lanes * VECTOR_BYTES)
                f.b.call(block, [corner, stride, f.at(kernel, first), f.at(there, first)])

            f.loop(0, outputs // (lanes * LANES), of_lanes)

        f.loop(0, -(-width // pixels), of_block)

    f.loop(*_rows(f, part, height), of_row)
    f.b.ret_void()
    return f.function


def _make_convolution(height: int, width: int, inputs: int, outputs: int) -> str:
    module = Module()
    stage = _convolution(module, height, width, inputs, outputs)
    name = f"firenet_convolution_{height}_{width}_{inputs}_{outputs}"
    register(name, module, [stage], _parts(height), 2, [0])
    return name


# --- The gradient with respect to the kernel ---------------------------------------------------


def _products(module: Module, width: int, inputs: int, outputs: int, group: int) -> Code:
    """products(row of the image, row of the gradient, sums): added to three columns of the kernel.

    A pixel of the image meets the gradients of its three neighbours in the row; the sums of `group`
    inputs with 16 outputs stay in registers on the way through it.
    """
    f = Function(module, f"products{group}", [POINTER, POINTER, POINTER])
    f.function.attributes.add("noinline")
    pixels, gradients, sums = f.arguments

    def place(j, c):
        return 4 * (j * inputs + c) * outputs

    places = [place(j, c) for j in range(3) for c in range(group)]
    values = [f.load_unaligned(VECTOR, sums, place) for place in places]

    def add(x, three, values):
        """three: the gradients to the right of this pixel, here, and to the left."""
        here = f.at(pixels, f.times(x, 4 * inputs))
        for c in range(group):
            number = f.splat(f.load(FLOAT, here, 4 * c))
            for j in range(3):
                values[j * group + c] = f.fma(number, three[j], values[j * group + c])
        return values

    def pixel(x, carried):
        here, left, *values = carried
        right = f.load_unaligned(VECTOR, gradients, f.times(x, 4 * outputs), 4 * outputs)
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


def _sums(module: Module, height: int, width: int, inputs: int, outputs: int) -> Code:
    """Of some rows of an image: its own sums, all of the kernel's gradient."""
    f = Function(module, "sums", [POINTER, INT, INT])
    pointers, image, part = f.arguments
    source, gradient, partial = _pointers(f, pointers, 3)
    whole = 4 * 9 * inputs * outputs
    index = f.b.add(f.times(image, _parts(height)), part)
    partial = f.at(partial, f.times(index, whole))
    source = f.at(source, f.times(image, 4 * height * width * inputs))
    gradient = f.at(gradient, f.times(image, 4 * height * width * outputs))
    f.memset(partial, whole)
    most = GROUP if vectors() == 32 else 2
    groups = [(c, min(most, inputs - c)) for c in range(0, inputs, most)]
    sizes = sorted({group for _, group in groups})
    code = {group: _products(module, width, inputs, outputs, group) for group in sizes}
    first, last = _rows(f, part, height)

    def of_kernel_row(i, _):
        shift = f.b.sub(i, integer(1))

        def of_lanes(v, _):
            lanes = f.times(v, VECTOR_BYTES)
            for c, group in groups:
                there = f.at(partial, f.times(i, 4 * 3 * inputs * outputs), lanes, 4 * c * outputs)

                def of_row(y, _, c=c, group=group, there=there):
                    above = f.b.add(y, shift)
                    with f.b.if_then(f.b.and_(f.less(-1, above), f.less(above, height))):
                        pixels = f.at(source, f.times(above, 4 * width * inputs), 4 * c)
                        gradients = f.at(gradient, f.times(y, 4 * width * outputs), lanes)
                        f.b.call(code[group], [pixels, gradients, there])

                f.loop(first, last, of_row)

        f.loop(0, outputs // LANES, of_lanes)

    f.loop(0, 3, of_kernel_row)
    f.b.ret_void()
    return f.function


def _total(module: Module, batch: int, height: int, inputs: int, outputs: int) -> Code:
    """Some of the kernel's gradient: the sums of all parts of all images."""
    f = Function(module, "total", [POINTER, INT, INT])
    pointers, image, part = f.arguments
    _, _, partial, result = _pointers(f, pointers, 4)
    count, whole = batch * _parts(height), 9 * inputs * outputs // LANES
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


def _make_gradient(batch: int, height: int, width: int, inputs: int, outputs: int) -> str:
    module = Module()
    stages = [
        _sums(module, height, width, inputs, outputs),
        _total(module, batch, height, inputs, outputs),
    ]
    name = f"firenet_kernel_gradient_{batch}_{height}_{width}_{inputs}_{outputs}"
    register(name, module, stages, _parts(height), 2, [0, 1])
    return name


# --- To JAX ------------------------------------------------------------------------------------


def convolve(image: jax.Array, kernel: jax.Array) -> jax.Array:
    """(B, H, W, I), (3, 3, I, O) -> (B, H, W, O); raises Unavailable where there is none of it."""
    _check(image, kernel)
    batch, height, width, inputs = image.shape
    outputs = kernel.shape[3]
    call = jax.ffi.ffi_call(
        made(_make_convolution, height, width, inputs, outputs),
        jax.ShapeDtypeStruct((batch, height, width, outputs), jnp.float32),
        vmap_method="sequential",
    )
    return call(image, kernel)


def kernel_gradient(image: jax.Array, kernel: jax.Array, gradient: jax.Array) -> jax.Array:
    """(B, H, W, I), (3, 3, I, O), (B, H, W, O) -> (3, 3, I, O)."""
    _check(image, kernel, gradient)
    batch, height, width, inputs = image.shape
    outputs = kernel.shape[3]
    partial = batch * _parts(height), 9 * inputs * outputs
    call = jax.ffi.ffi_call(
        made(_make_gradient, batch, height, width, inputs, outputs),
        [
            jax.ShapeDtypeStruct(partial, jnp.float32),
            jax.ShapeDtypeStruct(kernel.shape, jnp.float32),
        ],
        vmap_method="sequential",
    )
    return call(image, gradient)[1]


def _check(image: jax.Array, kernel: jax.Array, *others: jax.Array) -> None:
    rows, columns, inputs, outputs = kernel.shape
    is_ours = (rows, columns) == (3, 3) and inputs == image.shape[-1] and outputs % LANES == 0
    arrays = image, kernel, *others
    if vectors() == 0 or not is_ours or any(x.size == 0 or x.dtype != jnp.float32 for x in arrays):
        raise Unavailable
