"""(maps, kernel, bias) -> maps: a layer of training as machine code; gradients of kernel and bias.

3x3, zero padding, float32, results of a multiple of 16 channels. Several maps are convolved as if
they were one, and results are several maps too, because to join and to split them takes XLA as
long as a convolution.

What takes the time are multiply-adds of a number of one array, in all lanes, with 16 outputs in a
register, added to sums that stay in registers: as many as a processor has, for it begins a
multiply-add long before the last one has ended.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

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


# --- The convolution ---------------------------------------------------------------------------

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


class Layer(NamedTuple):
    """What is known of a convolution before it runs."""

    height: int
    width: int
    inputs: tuple[int, ...]  # of each map
    activations: tuple[str, ...]  # of each result
    outputs: int  # of each result
    has_bias: bool
    ending: str = ""  # after the activations, with results of its own

    @property
    def all_inputs(self) -> int:
        return sum(self.inputs)

    @property
    def all_outputs(self) -> int:
        return len(self.activations) * self.outputs

    @property
    def operands(self) -> int:
        return ENDINGS[self.ending].operands if self.ending else 0

    @property
    def results(self) -> int:
        return ENDINGS[self.ending].results if self.ending else len(self.activations)

    @property
    def together(self) -> int:
        """Vectors of outputs that are worked on together: two share what they are products of."""
        return 2 if self.all_outputs % (2 * LANES) == 0 else 1

    @property
    def pixels(self) -> int:
        """Of a row, worked on together: a number that leaves little over."""
        room = 28 if vectors() == 32 else 6  # sums in registers, beside what is added to them
        most = max(1, min(self.width, room // self.together))
        return min(range(1, most + 1), key=lambda n: (-(-self.width // n) * (n + 1), -n))


def _block(module: Module, layer: Layer, activations: tuple[str, ...]) -> Code:
    """block(record): pixels side by side, one vector of outputs or two of these activations.

    The record is of pointers: for each map the upper left neighbour of the block and, as a number,
    the bytes of a row of it; the kernel's first column of outputs, the bias's; of each operand, and
    for each vector of outputs or each result of the ending, where its pixels are.
    """
    name = "_".join(("block", *activations))
    f = Function(module, name, [POINTER])
    f.function.attributes.add("noinline")
    (record,) = f.arguments
    together, across = len(activations), 4 * layer.all_outputs
    fields = 2 * len(layer.inputs)
    pixels = layer.operands + (layer.results if layer.ending else together)
    kernel, bias, *pixels = (f.load(POINTER, record, 8 * (fields + i)) for i in range(2 + pixels))
    operands, targets = pixels[: layer.operands], pixels[layer.operands :]
    sums, before = [vector(0)] * (layer.pixels * together), 0
    if layer.has_bias:
        sums = [f.load_unaligned(VECTOR, bias, v * VECTOR_BYTES) for v in range(together)]
        sums = sums * layer.pixels
    for i, inputs in enumerate(layer.inputs):
        corner, line = f.load(POINTER, record, 16 * i), f.load(INT, record, 16 * i + 8)
        steps = max(n for n in range(1, 9) if inputs % n == 0)

        def tap(k, sums, corner=corner, line=line, inputs=inputs, steps=steps, before=before):
            row, column = f.b.sdiv(k, integer(3)), f.b.srem(k, integer(3))
            numbers = f.at(corner, f.b.mul(row, line), f.times(column, 4 * inputs))
            weights = f.at(kernel, f.times(k, across * layer.all_inputs), across * before)

            def some(m, sums):
                here = f.at(numbers, f.times(m, 4 * steps))
                there = f.at(weights, f.times(m, steps * across))
                for step in range(steps):
                    by = [
                        f.load_unaligned(VECTOR, there, step * across + v * VECTOR_BYTES)
                        for v in range(together)
                    ]
                    for n in range(layer.pixels):
                        number = f.splat(f.load(FLOAT, here, 4 * (n * inputs + step)))
                        for v in range(together):
                            place = n * together + v
                            sums[place] = f.fma(number, by[v], sums[place])
                return sums

            return f.loop(0, inputs // steps, some, sums)

        sums = f.loop(0, 9, tap, sums)
        before += inputs
    for n in range(layer.pixels):
        place, values = 4 * n * layer.outputs, sums[n * together : (n + 1) * together]
        values = [ACTIVATIONS[a](f, value) for a, value in zip(activations, values, strict=True)]
        if layer.ending:
            others = [f.load_unaligned(VECTOR, operand, place) for operand in operands]
            values = ENDINGS[layer.ending].write(f, values, others)
        for value, target in zip(values, targets, strict=True):
            f.store_unaligned(value, target, place)
    f.b.ret_void()
    return f.function


def _convolution(module: Module, layer: Layer) -> Code:
    """Some rows of the result. Where a block ends with the image, zeros are put around it first."""
    f = Function(module, "convolution", [POINTER, INT, INT])
    pointers, image, part = f.arguments
    height, width, pixels = layer.height, layer.width, layer.pixels
    maps, results = len(layer.inputs), len(layer.activations)
    others = layer.operands + layer.results
    arrays = _pointers(f, pointers, maps + 1 + layer.has_bias + others)
    sources = [
        f.at(array, f.times(image, 4 * height * width * inputs))
        for array, inputs in zip(arrays[:maps], layer.inputs, strict=True)
    ]
    kernel, bias = arrays[maps], arrays[maps + layer.has_bias]
    pixels_of = [
        f.at(array, f.times(image, 4 * height * width * layer.outputs))
        for array in arrays[-others:]
    ]
    enclosed = [f.alloca(3 * 4 * (pixels + 2) * inputs) for inputs in layer.inputs]
    record = f.alloca(8 * (2 * maps + 2 + max(others, layer.together)))
    # Which result, and how many bytes into its pixels, for each vector of outputs.
    lanes = [
        (result, lane * VECTOR_BYTES)
        for result in range(results)
        for lane in range(layer.outputs // LANES)
    ]
    groups = [lanes[i : i + layer.together] for i in range(0, len(lanes), layer.together)]
    code = {}
    for group in groups:
        key = tuple(layer.activations[result] for result, _ in group)
        if key not in code:
            code[key] = _block(module, layer, key)

    def of_row(y, _):
        def of_block(i, _):
            # The last block begins early enough to end with the row.
            left = f.min(f.times(i, pixels), width - pixels)
            corner, area = (f.b.sub(y, integer(1)), f.b.sub(left, integer(1))), (height, width)
            for i, inputs in enumerate(layer.inputs):
                begin, line = f.patch(
                    sources[i], area, 4 * inputs, corner, (3, pixels + 2), enclosed[i]
                )
                f.store(begin, record, 16 * i)
                f.store(line, record, 16 * i + 8)
            there = f.times(f.b.add(f.times(y, width), left), 4 * layer.outputs)
            for i, group in enumerate(groups):
                first = i * layer.together * VECTOR_BYTES
                fields = [f.at(kernel, first), f.at(bias, first)]
                if layer.ending:
                    fields += [f.at(array, there) for array in pixels_of]
                else:
                    fields += [f.at(pixels_of[result], there, lane) for result, lane in group]
                for k, field in enumerate(fields):
                    f.store(field, record, 8 * (2 * maps + k))
                key = tuple(layer.activations[result] for result, _ in group)
                f.b.call(code[key], [record])

        f.loop(0, -(-width // pixels), of_block)

    f.loop(*_rows(f, part, height), of_row)
    f.b.ret_void()
    return f.function


def _make_convolution(*layer) -> str:
    layer = Layer(*layer)
    module = Module()
    stage = _convolution(module, layer)
    inputs = "_".join(map(str, layer.inputs))
    results = "_".join(layer.activations) + f"_{layer.outputs}" + "_bias" * layer.has_bias
    results += "_".join(["", *layer.ending.split()])
    name = f"firenet_convolution_{layer.height}_{layer.width}_{inputs}_{results}"
    arguments = len(layer.inputs) + 1 + layer.has_bias + layer.operands
    register(name, module, [stage], _parts(layer.height), arguments, layer.results)
    return name


# --- The gradients of kernel and bias ----------------------------------------------------------


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


def _sums(module: Module, height: int, width: int, maps: tuple, gradients: tuple) -> Code:
    """Of some rows of an image: its own sums, all of the kernel's gradient and the bias's."""
    f = Function(module, "sums", [POINTER, INT, INT])
    pointers, image, part = f.arguments
    arrays = _pointers(f, pointers, len(maps) + len(gradients) + 2)
    arrays, partial = arrays[:-2], arrays[-1]
    arrays = [
        f.at(array, f.times(image, 4 * height * width * channels))
        for array, channels in zip(arrays, maps + gradients, strict=True)
    ]
    sources, there = arrays[: len(maps)], arrays[len(maps) :]
    inputs, outputs = sum(maps), sum(gradients)
    kernel = 4 * 9 * inputs * outputs
    whole = kernel + 4 * outputs
    index = f.b.add(f.times(image, _parts(height)), part)
    partial = f.at(partial, f.times(index, whole))
    f.memset(partial, whole)
    most = GROUP if vectors() == 32 else 2
    code = {}
    first, last = _rows(f, part, height)

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

    def of_bias(gradient, lane, of_gradient, target):
        def of_row(y, total):
            row = f.at(gradient, f.times(y, 4 * width * of_gradient), lane)

            def add(x, total):
                here = f.load_unaligned(VECTOR, row, f.times(x, 4 * of_gradient))
                return [f.b.fadd(total[0], here)]

            return f.loop(0, width, add, total)

        f.store_unaligned(f.loop(first, last, of_row, [vector(0)])[0], target)

    column = kernel
    for gradient, of_gradient in zip(there, gradients, strict=True):
        for lane in range(0, 4 * of_gradient, VECTOR_BYTES):
            of_bias(gradient, lane, of_gradient, f.at(partial, column + lane))
        column += 4 * of_gradient
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
    result, partial = _pointers(f, pointers, arrays + 2)[arrays:]
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


def _make_gradient(batch: int, height: int, width: int, maps: tuple, gradients: tuple) -> str:
    module = Module()
    arrays, numbers = len(maps) + len(gradients), (9 * sum(maps) + 1) * sum(gradients)
    stages = [
        _sums(module, height, width, maps, gradients),
        _total(module, batch, height, arrays, numbers),
    ]
    sizes = "_".join(map(str, (batch, height, width, *maps, "by", *gradients)))
    name = f"firenet_kernel_gradient_{sizes}"
    parts = _parts(height)
    register(name, module, stages, parts, arrays, results=1, scratch=4 * parts * numbers)
    return name


# --- To JAX ------------------------------------------------------------------------------------


def convolve(
    maps: Sequence[jax.Array],
    kernel: jax.Array,
    bias: jax.Array | None = None,
    activations: tuple[str, ...] = ("none",),
    ending: str = "",
    operands: Sequence[jax.Array] = (),
) -> list[jax.Array]:
    """Maps (B, H, W, .), seen as one of I channels, (3, 3, I, O), (O,) -> as many maps as names.

    activations: none, relu, sigmoid, tanh: one for each of the equal parts of the outputs.
    ending: one of `ENDINGS`, of one or two parts of 16 outputs and of operands (B, H, W, 16): then
    the results are its own.
    Raises Unavailable for what it does not compute, where XLA must.
    """
    _check(kernel, *maps, *operands, *(() if bias is None else (bias,)))
    batch, height, width, _ = maps[0].shape
    outputs, odd = divmod(kernel.shape[3], len(activations))
    if odd or outputs % LANES or (ending and (outputs != LANES or len(activations) > 2)):
        raise Unavailable
    inputs = tuple(x.shape[3] for x in maps)
    layer = Layer(height, width, inputs, activations, outputs, bias is not None, ending)
    shape = jax.ShapeDtypeStruct((batch, height, width, outputs), jnp.float32)
    call = jax.ffi.ffi_call(
        made(_make_convolution, *layer), [shape] * layer.results, vmap_method="sequential"
    )
    return list(call(*maps, kernel, *(() if bias is None else (bias,)), *operands))


def gradients(
    maps: Sequence[jax.Array], kernel: jax.Array, changes: Sequence[jax.Array]
) -> tuple[jax.Array, jax.Array]:
    """Maps (B, H, W, .), (3, 3, I, O), the sums' gradients -> those of kernel and bias (O,)."""
    _check(kernel, *maps, *changes)
    batch, height, width, _ = maps[0].shape
    channels = [tuple(x.shape[3] for x in arrays) for arrays in (maps, changes)]
    if any(outputs % LANES for outputs in channels[1]):
        raise Unavailable
    numbers = kernel.size + kernel.shape[3]
    call = jax.ffi.ffi_call(
        made(_make_gradient, batch, height, width, *channels),
        jax.ShapeDtypeStruct((numbers,), jnp.float32),
        vmap_method="sequential",
    )
    both = call(*maps, *changes)
    return both[: kernel.size].reshape(kernel.shape), both[kernel.size :]


def _check(kernel: jax.Array, *arrays: jax.Array) -> None:
    is_ours = all(x.size and x.dtype == jnp.float32 for x in (kernel, *arrays))
    if vectors() == 0 or kernel.shape[:2] != (3, 3) or not is_ours:
        raise Unavailable
