"""(maps, kernel, bias) -> maps: a layer of training, as machine code.

3x3, zero padding, float32, results of a multiple of 16 channels. Several maps are convolved as if
they were one, and results are several maps too, because to join and to split them takes XLA as
long as a convolution.

The network's own convolutions are Winograd's (`winograd`), those of other numbers of channels are
direct. There, what takes the time are multiply-adds of a number of one array, in all lanes, with 16
outputs in a register, added to sums that stay in registers: as many as a processor has, for it
begins a multiply-add long before the last one has ended.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from firenet_jax.native.choice import Unavailable, made
from firenet_jax.native.endings import ACTIVATIONS, ENDINGS
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
from firenet_jax.native.winograd import COLUMNS, PIXEL, PLACES, Block, Tiling, kernels

ROWS = 4  # of the result: what a thread takes at a time
MOST_INPUTS = 4096  # what is around a block's pixels is copied to a thread's stack


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


# --- Direct --------------------------------------------------------------------------------------


def _block(module: Module, layer: Layer, activations: tuple[str, ...]) -> Code:
    """block(record): pixels side by side, one vector of outputs or two of these activations.

    The record is of pointers: for each map the upper left neighbour of the block and, as a number,
    the bytes of a row of it; the kernel's first column of outputs, the bias's; for each vector of
    outputs, where its pixels are.
    """
    name = "_".join(("block", *activations))
    f = Function(module, name, [POINTER])
    f.function.attributes.add("noinline")
    (record,) = f.arguments
    together, across = len(activations), 4 * layer.all_outputs
    fields = 2 * len(layer.inputs)
    kernel, bias, *targets = f.pointers(f.at(record, 8 * fields), 2 + together)
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
        for a, value, target in zip(activations, values, targets, strict=True):
            f.store_unaligned(ACTIVATIONS[a](f, value), target, place)
    f.b.ret_void()
    return f.function


def _direct(module: Module, layer: Layer) -> Code:
    """Some rows of the result. Where a block ends with the image, zeros are put around it first."""
    f = Function(module, "convolution", [POINTER, INT, INT])
    pointers, image, part = f.arguments
    height, width, pixels = layer.height, layer.width, layer.pixels
    maps, results = len(layer.inputs), len(layer.activations)
    arrays = f.pointers(pointers, maps + 1 + layer.has_bias + results)
    sources = [
        f.at(array, f.times(image, 4 * height * width * inputs))
        for array, inputs in zip(arrays[:maps], layer.inputs, strict=True)
    ]
    kernel, bias = arrays[maps], arrays[maps + layer.has_bias]
    pixels_of = [
        f.at(array, f.times(image, 4 * height * width * layer.outputs))
        for array in arrays[-results:]
    ]
    enclosed = [f.alloca(3 * 4 * (pixels + 2) * inputs) for inputs in layer.inputs]
    record = f.alloca(8 * (2 * maps + 2 + layer.together))
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
                fields += [f.at(pixels_of[result], there, lane) for result, lane in group]
                for k, field in enumerate(fields):
                    f.store(field, record, 8 * (2 * maps + k))
                key = tuple(layer.activations[result] for result, _ in group)
                f.b.call(code[key], [record])

        f.loop(0, -(-width // pixels), of_block)

    f.loop(*f.rows(part, ROWS, height), of_row)
    f.b.ret_void()
    return f.function


# --- Winograd's ----------------------------------------------------------------------------------


def _is_winograd(layer: Layer) -> bool:
    """The network's own convolutions, but for the event tensor's."""
    return layer.outputs == LANES and set(layer.inputs) == {LANES}


def _finish(f: Function, layer: Layer, values: list, operands: list, targets: list) -> None:
    """The sums of a pixel, and pointers to it in other maps: what the layer makes of them there."""
    values = [ACTIVATIONS[a](f, x) for a, x in zip(layer.activations, values, strict=True)]
    if layer.ending:
        others = [f.load_unaligned(VECTOR, operand) for operand in operands]
        values = ENDINGS[layer.ending].write(f, values, others)
    for value, target in zip(values, targets, strict=True):
        f.store_unaligned(value, target)


def _by_winograd(module: Module, layer: Layer) -> Code:
    """Four rows of the result, of kernels (24 places, results, inputs, 16 outputs)."""
    f = Function(module, "convolution", [POINTER, INT, INT])
    pointers, image, part = f.arguments
    size = Tiling(layer.height, layer.width)
    block = Block(module, size)
    maps, results, inputs = len(layer.inputs), len(layer.activations), layer.all_inputs
    arrays = f.pointers(pointers, maps + 1 + layer.has_bias + layer.operands + layer.results)
    step = f.times(image, layer.height * layer.width * PIXEL)
    sources = [f.at(array, step) for array in arrays[:maps]]
    others = [f.at(array, step) for array in arrays[maps + 1 + layer.has_bias :]]
    biases = [vector(0)] * results
    if layer.has_bias:
        biases = [f.load_unaligned(VECTOR, arrays[maps + 1], i * PIXEL) for i in range(results)]
    memory = block.memory(f, maps, results)
    enclosed = [f.alloca(size.patch[0] * size.patch[1] * PIXEL) for _ in sources]
    top, bottom = f.rows(part, ROWS, layer.height)

    def finish(left, fresh):
        """Of the pixels of the block that are in the image, from the fresh ones on."""
        right = f.min(f.b.sub(integer(layer.width), left), COLUMNS.tile * size.block)

        def row(y, _):
            line = f.times(f.b.add(f.times(y, layer.width), left), PIXEL)
            line_of_sums = f.times(f.b.sub(y, top), block.line)

            def pixel(x, _):
                x = f.times(x, PIXEL)
                sums = [f.load(VECTOR, result, line_of_sums, x) for result in memory[2]]
                sums = [f.b.fadd(value, bias) for value, bias in zip(sums, biases, strict=True)]
                here = [f.at(array, line, x) for array in others]
                _finish(f, layer, sums, here[: layer.operands], here[layer.operands :])

            f.loop(fresh, right, pixel)

        f.loop(top, bottom, row)

    def kernel(group, result):
        return f.at(arrays[maps], (group * PLACES * results + result) * inputs * PIXEL)

    def of_block(i, _):
        # The last block begins early enough to end with the row.
        wanted = f.times(i, size.block)
        first = f.min(wanted, size.across - size.block)
        left, fresh = f.times(first, COLUMNS.tile), f.times(f.b.sub(wanted, first), COLUMNS.tile)
        corner = f.b.sub(top, integer(1)), f.b.sub(left, integer(1))
        corners = [
            f.patch(source, (layer.height, layer.width), PIXEL, corner, size.patch, room)
            for source, room in zip(sources, enclosed, strict=True)
        ]
        block.write(f, memory, corners, inputs, kernel, rows=results * inputs)
        finish(left, fresh)

    f.loop(0, -(-size.across // size.block), of_block)
    f.b.ret_void()
    return f.function


# --- To JAX ------------------------------------------------------------------------------------


def _stages(module: Module, layer: Layer) -> list[Code]:
    return [(_by_winograd if _is_winograd(layer) else _direct)(module, layer)]


def _kernel(layer: Layer, kernel: jax.Array) -> jax.Array:
    """As the stage reads it."""
    if not _is_winograd(layer):
        return kernel
    results = len(layer.activations)
    kernel = kernel.reshape(9, layer.all_inputs, results, LANES).swapaxes(1, 2)
    return kernels(kernel.reshape(9, -1))


def _make_convolution(*layer) -> str:
    layer = Layer(*layer)
    module = Module()
    stages = _stages(module, layer)
    inputs = "_".join(map(str, layer.inputs))
    results = "_".join(layer.activations) + f"_{layer.outputs}" + "_bias" * layer.has_bias
    results += "_".join(["", *layer.ending.split()])
    name = f"firenet_convolution_{layer.height}_{layer.width}_{inputs}_{results}"
    arguments = len(layer.inputs) + 1 + layer.has_bias + layer.operands
    register(name, module, stages, -(-layer.height // ROWS), arguments, layer.results)
    return name


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
    ending: one of `ENDINGS`, of operands (B, H, W, 16), where all maps and results have 16
    channels: then the results are its own.
    Raises Unavailable for what it does not compute, where XLA must.
    """
    check(kernel, maps, operands)
    if bias is not None and (bias.shape != kernel.shape[3:] or bias.dtype != jnp.float32):
        raise Unavailable
    batch, height, width, _ = maps[0].shape
    outputs, odd = divmod(kernel.shape[3], len(activations))
    inputs = tuple(x.shape[3] for x in maps)
    layer = Layer(height, width, inputs, activations, outputs, bias is not None, ending)
    is_odd_ending = ending and (
        not _is_winograd(layer)
        or len(operands) != layer.operands
        or any(x.shape[3] != LANES for x in operands)
    )
    if odd or outputs % LANES or is_odd_ending:
        raise Unavailable
    kernel = _kernel(layer, kernel)
    shape = jax.ShapeDtypeStruct((batch, height, width, outputs), jnp.float32)
    call = jax.ffi.ffi_call(
        made(_make_convolution, *layer), [shape] * layer.results, vmap_method="sequential"
    )
    return list(call(*maps, kernel, *(() if bias is None else (bias,)), *operands))


def check(kernel: jax.Array, maps: Sequence[jax.Array], others: Sequence[jax.Array]) -> None:
    """Raises Unavailable for what is not computed here: XLA computes it, or refuses what does not
    fit together, of which machine code would read beyond the end."""
    arrays = (*maps, *others)
    is_ours = all(x.size and x.dtype == jnp.float32 for x in (kernel, *arrays))
    fits = len({x.shape[:3] for x in arrays}) == 1
    inputs = sum(x.shape[3] for x in maps)
    fits = fits and kernel.shape[:3] == (3, 3, inputs) and inputs <= MOST_INPUTS
    if vectors() == 0 or not is_ours or not fits:
        raise Unavailable
