"""(packed parameters, states, event tensor) -> (states, image): the step of a CPU, as machine code.

The function of `network.step`, float32, equal to rounding, without a gradient. On a CPU, XLA's time
goes into 3x3 convolutions of 16 channels. Here the whole step is one function that XLA's programs
call, compiled for the processor at hand when an image size is first seen.

Convolutions are Winograd's (`winograd`). States are (H, W) pixels of 16 channels, as everywhere. A
map within the step is (H + 2, W + 2) of them, H and W rounded up to whole tiles, zero wherever
there is no pixel of the image.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

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
    Code,
    Function,
    Module,
    integer,
    number,
    vector,
    vectors,
)
from firenet_jax.native.winograd import (
    COLUMNS,
    GROUPS,
    PIXEL,
    PLACES,
    ROWS,
    STEP,
    Block,
    Tiling,
    kernels,
)

CHANNELS, BINS = LANES, 5  # the network's; in steps the 5 become 8


# --- The network -------------------------------------------------------------------------------


BEFORE = {"g1": "g1 before", "g2": "g2 before"}  # states


class _Finishing(Function):
    """With values that what becomes of a convolution's sums may need."""

    exists: Any  # a vector of ones, or of zeros where the window does not exist
    prediction: Any  # the last layer's weights
    offset: Any  # and its bias


class Layer(NamedTuple):
    """What becomes of a convolution's sums."""

    target: str
    finish: Callable  # (function, sums, what reads a map at this pixel) -> vector, or a number


class Stage(NamedTuple):
    """3x3 convolutions of the same maps, seen as one map."""

    sources: tuple[str, ...]
    layers: tuple[Layer, ...]


def _relu(f, sums, _):
    return f.relu(sums)


def _gru(source: str, state: str) -> list[Stage]:
    """Both gates; then the candidate, and the new state, which may take the old one's place."""
    before = BEFORE[state]

    def reset(f, sums, at):
        return f.b.fmul(f.sigmoid(sums), at(before))

    def update(f, sums, at):
        return f.b.fmul(f.sigmoid(sums), f.exists)

    def candidate(f, sums, at):
        return f.fma(at("update"), f.b.fsub(f.tanh(sums), at(before)), at(before))

    return [
        Stage((source, before), (Layer("reset", reset), Layer("update", update))),
        Stage((source, "reset"), (Layer(state, candidate),)),
    ]


def _residual(source: str, target: str, finish: Callable) -> list[Stage]:
    def add(f, sums, at):
        return finish(f, f.relu(f.b.fadd(sums, at(source))))

    return [
        Stage((source,), (Layer("between", _relu),)),
        Stage(("between",), (Layer(target, add),)),
    ]


def _same(f, pixel):
    return pixel


def _prediction(f, pixel):
    return f.reduce_add(f.b.fmul(pixel, f.prediction), f.offset)


STAGES = [
    Stage(("tensor",), (Layer("map", _relu),)),
    *_gru("map", "g1"),
    *_residual("g1", "map", _same),
    *_gru("map", "g2"),
    *_residual("g2", "image", _prediction),
]
INNER = ("tensor", "map", "reset", "update", "between")  # maps that nobody sees from outside
MOMENTS = ("count", "sum", "squares")  # of the numbers that are not zero; squares of deviations


def _inputs(stage: Stage) -> int:
    return STEP if stage.sources == ("tensor",) else CHANNELS * len(stage.sources)


def pack(params) -> jax.Array:
    """All parameters in the order in which they are used, float32.

    Of each convolution its bias and G g G^T, (6, 4, inputs, outputs); then the prediction's kernel
    and, 16 times, its bias.
    """
    convolutions = [params["head"]]
    for gru, block in (("gru1", "res1"), ("gru2", "res2")):
        gates, block = params[gru]["gates"], params[block]
        halves = [jax.tree.map(lambda x, i=i: jnp.split(x, 2, -1)[i], gates) for i in (0, 1)]
        convolutions += [*halves, params[gru]["candidate"], block["conv1"], block["conv2"]]
    # All kernels in one product: one by one they take twice as long.
    flat = [convolution["kernel"].reshape(9, -1) for convolution in convolutions]
    flat = kernels(jnp.concatenate(flat, 1))
    parts, start = [], 0
    for convolution in convolutions:
        _, _, inputs, outputs = convolution["kernel"].shape
        kernel = flat[:, start : start + inputs * outputs].reshape(-1, inputs, outputs)
        kernel = jnp.pad(kernel, ((0, 0), (0, -inputs % STEP), (0, 0)))
        parts += [convolution["bias"], kernel]
        start += inputs * outputs
    last = params["prediction"]
    parts += [last["kernel"], jnp.repeat(last["bias"], CHANNELS)]
    return jnp.concatenate([jnp.ravel(part) for part in parts]).astype(jnp.float32)


# --- Its stages, four rows at a time -----------------------------------------------------------


class Size(Tiling):
    """Of images, their tiles, and of maps within the step."""

    @property
    def line(self) -> int:
        return (COLUMNS.tile * self.across + 2) * PIXEL

    @property
    def map(self) -> int:
        return (ROWS.tile * self.down + 2) * self.line

    @property
    def state(self) -> int:
        return self.height * self.width * PIXEL

    @property
    def moments(self) -> int:
        """Bytes of what is known of the numbers of each four rows of an event tensor."""
        return -(-len(MOMENTS) * 4 * self.down // PIXEL) * PIXEL

    @property
    def inner(self) -> int:
        return len(INNER) * self.map + self.moments


def _arrays(f: Function, size: Size, pointers, image) -> dict:
    """What lies where for this image of the batch: arguments and results of `step`, and maps."""
    bytes_of_an_image = {
        "events": 4 * BINS * size.height * size.width,
        "weights": 0,
        "exists": 4,
        **dict.fromkeys([*BEFORE.values(), *BEFORE], size.state),
        "image": 4 * size.height * size.width,
        "inner": size.inner,
    }
    arrays = {
        name: f.at(f.load(POINTER, pointers, 8 * i), f.times(image, step))
        for i, (name, step) in enumerate(bytes_of_an_image.items())
    }
    arrays |= {name: f.at(arrays["inner"], i * size.map) for i, name in enumerate(INNER)}
    moments = f.at(arrays["inner"], len(INNER) * size.map)
    return arrays | {name: f.at(moments, i * 4 * size.down) for i, name in enumerate(MOMENTS)}


def _border(f: Function, size: Size, map, part) -> None:
    """Zeros around the rows of this part."""

    def clear(line, first, last):
        f.loop(first, last, lambda x, _: f.store(vector(0), line, f.times(x, PIXEL)))

    columns = size.line // PIXEL

    def sides(y, _):
        line = f.at(map, f.times(y, size.line), size.line)
        clear(line, 0, 1)
        clear(line, size.width + 1, columns)

    first, last = f.rows(part, ROWS.tile, size.height)
    f.loop(first, last, sides)
    for here, start, stop in (
        (0, 0, 1),
        (size.down - 1, size.height + 1, ROWS.tile * size.down + 2),
    ):
        with f.b.if_then(f.b.icmp_signed("==", part, integer(here))):
            clear(map, start * columns, stop * columns)


# What becomes of the event tensor's numbers: (function, size, arrays) -> (vector -> vector).


def _itself(f, size, arrays):
    return lambda numbers: numbers


def _voted(f, size, arrays):
    return lambda numbers: f.b.select(f.is_not_zero(numbers), vector(1), vector(0))


def _deviation(f, size, arrays):
    mean = f.b.fdiv(_total(f, size, arrays, "sum"), _count(f, size, arrays))
    return lambda x: f.b.select(f.is_not_zero(x), f.b.fsub(x, mean), vector(0))


def _square(f, size, arrays):
    deviation = _deviation(f, size, arrays)

    def square(numbers):
        deviations = deviation(numbers)
        return f.b.fmul(deviations, deviations)

    return square


def _normalised(f, size, arrays):
    """As `tensors.normalise`."""
    deviation = _deviation(f, size, arrays)
    variance = f.b.fdiv(_total(f, size, arrays, "squares"), _count(f, size, arrays))
    inverse = f.b.fdiv(vector(1), f.intrinsic("sqrt", variance))
    scale = f.b.select(f.b.fcmp_ordered(">=", variance, vector(1e-12)), inverse, vector(0))
    return lambda numbers: f.b.fmul(deviation(numbers), scale)


def _total(f: Function, size: Size, arrays: dict, moment: str):
    """Of all parts, in each lane."""

    def add(i, total):
        return [f.b.fadd(total[0], f.load(FLOAT, arrays[moment], f.times(i, 4)))]

    return f.splat(f.loop(0, size.down, add, [number(0)])[0])


def _count(f: Function, size: Size, arrays: dict):
    return f.max(_total(f, size, arrays, "count"), vector(1))


def _moments(module: Module, size: Size, terms: dict[str, Callable]) -> Code:
    """Of four rows of the event tensor: sums of these terms over all numbers."""
    f = Function(module, "moments_" + "_".join(terms), [POINTER, INT, INT])
    pointers, image, part = f.arguments
    arrays = _arrays(f, size, pointers, image)
    top, bottom = f.rows(part, ROWS.tile, size.height)
    events = f.at(arrays["events"], f.times(top, 4 * BINS * size.width))
    count = f.times(f.b.sub(bottom, top), BINS * size.width)
    term_of = [term(f, size, arrays) for term in terms.values()]

    def add(i, sums):
        numbers = f.masked_load(f.at(events, f.times(i, PIXEL)), f.b.sub(count, f.times(i, LANES)))
        return [f.b.fadd(sum_, term(numbers)) for sum_, term in zip(sums, term_of, strict=True)]

    vectors = f.b.sdiv(f.b.add(count, integer(LANES - 1)), integer(LANES))
    sums = f.loop(0, vectors, add, [vector(0)] * len(terms))
    for name, sum_ in zip(terms, sums, strict=True):
        f.store(f.reduce_add(sum_, number(0)), arrays[name], f.times(part, 4))
    f.b.ret_void()
    return f.function


def _events(module: Module, size: Size, becomes: Callable) -> Code:
    """The event tensor as a map: 16 channels instead of 5, zeros around."""
    f = Function(module, "events", [POINTER, INT, INT])
    pointers, image, part = f.arguments
    arrays = _arrays(f, size, pointers, image)
    becomes = becomes(f, size, arrays)

    def row(y, _):
        numbers = f.at(arrays["events"], f.times(y, 4 * BINS * size.width))
        line = f.at(arrays["tensor"], f.times(y, size.line), size.line + PIXEL)

        def pixel(x, _):
            here = f.at(numbers, f.times(x, 4 * BINS))
            f.store(becomes(f.masked_load(here, integer(BINS))), line, f.times(x, PIXEL))

        f.loop(0, size.width, pixel)

    f.loop(*f.rows(part, ROWS.tile, size.height), row)
    _border(f, size, arrays["tensor"], part)
    f.b.ret_void()
    return f.function


def _stage(
    module: Module,
    size: Size,
    name: str,
    stage: Stage,
    weights: int,
    convolutions: Block,
) -> Code:
    """Four rows of a stage whose weights begin at this byte."""
    f = _Finishing(module, name, [POINTER, INT, INT])
    pointers, image, part = f.arguments
    arrays = _arrays(f, size, pointers, image)
    memory = convolutions.memory(f, len(stage.sources), len(stage.layers))
    enclosed = f.alloca(size.patch[0] * size.patch[1] * PIXEL)
    inputs = _inputs(stage)
    starts = [weights + i * _weights_of_layer(stage) for i in range(len(stage.layers))]
    f.exists = f.splat(f.load(FLOAT, arrays["exists"]))
    f.prediction = f.load(VECTOR, arrays["weights"], _weights(len(STAGES)))
    f.offset = f.load(FLOAT, arrays["weights"], _weights(len(STAGES)) + PIXEL)
    top, bottom = f.rows(part, ROWS.tile, size.height)

    def finish(layer, bias, pixels, left, fresh):
        """What the layer makes of the pixels of the block that are in the image."""
        right = f.min(f.b.sub(integer(size.width), left), COLUMNS.tile * size.block)

        def row(y, _):
            line = f.b.add(f.times(y, size.line), f.times(left, PIXEL))
            line = f.b.add(line, integer(size.line + PIXEL))
            places = f.b.add(f.times(y, size.width), left)
            sums_of_row = f.at(pixels, f.times(f.b.sub(y, top), convolutions.line))

            def pixel(x, _):
                place = f.b.add(places, x)

                def here(name):
                    if name in INNER:
                        return f.at(arrays[name], f.b.add(line, f.times(x, PIXEL)))
                    return f.at(arrays[name], f.times(place, 4 if name == "image" else PIXEL))

                total = f.b.fadd(f.load(VECTOR, sums_of_row, f.times(x, PIXEL)), bias)
                value = layer.finish(f, total, lambda name: f.load(VECTOR, here(name)))
                f.store(value, here(layer.target))

            f.loop(fresh, right, pixel)

        f.loop(top, bottom, row)

    def corner(source, left):
        """The upper left neighbour of a block in this map, and the bytes of a row of it."""
        if source in INNER:
            here = f.b.add(f.times(top, size.line), f.times(left, PIXEL))
            return f.at(arrays[source], here), integer(size.line)
        upper_left = f.b.sub(top, integer(1)), f.b.sub(left, integer(1))
        area = size.height, size.width
        return f.patch(arrays[source], area, PIXEL, upper_left, size.patch, enclosed)

    def kernel(group, layer):
        before = PIXEL + group * PLACES * inputs * PIXEL
        return f.at(arrays["weights"], starts[layer] + before)

    def block(i, _):
        # The last block begins early enough to end with the row; what the one before it has
        # finished is left alone, because a state changes in place.
        wanted = f.times(i, size.block)
        first = f.min(wanted, size.across - size.block)
        left, fresh = f.times(first, COLUMNS.tile), f.times(f.b.sub(wanted, first), COLUMNS.tile)
        corners = [corner(source, left) for source in stage.sources]
        convolutions.write(f, memory, corners, inputs, kernel, rows=inputs)
        for layer, start, of_layer in zip(stage.layers, starts, memory[2], strict=True):
            finish(layer, f.load(VECTOR, arrays["weights"], start), of_layer, left, fresh)

    f.loop(0, -(-size.across // size.block), block)
    for layer in stage.layers:
        if layer.target in INNER:
            _border(f, size, arrays[layer.target], part)
    f.b.ret_void()
    return f.function


def _weights_of_layer(stage: Stage) -> int:
    """Bytes of a bias and of all kernels."""
    return (1 + len(GROUPS) * PLACES * _inputs(stage)) * PIXEL


def _weights(stage: int) -> int:
    """Where the weights of a stage begin, in bytes; after the last stage the prediction's."""
    return sum(len(each.layers) * _weights_of_layer(each) for each in STAGES[:stage])


def _stages(module: Module, size: Size, normalise: bool) -> list[Code]:
    """All stages of a step, in order."""
    if normalise:
        moments = [{"count": _voted, "sum": _itself}, {"squares": _square}]
        first = [_moments(module, size, terms) for terms in moments]
        first.append(_events(module, size, _normalised))
    else:
        first = [_events(module, size, _itself)]
    convolutions = Block(module, size)
    return first + [
        _stage(module, size, f"stage{i}", stage, _weights(i), convolutions)
        for i, stage in enumerate(STAGES)
    ]


def _make(height: int, width: int, normalise: bool) -> str:
    """Compiles the step for images of this size -> the name by which XLA knows it."""
    size, module = Size(height, width), Module()
    name = f"firenet_step_{height}_{width}" + ("_normalised" if normalise else "")
    stages = _stages(module, size, normalise)
    register(name, module, stages, size.down, arguments=5, results=3, scratch=size.inner)
    return name


# --- To JAX ------------------------------------------------------------------------------------


def step(
    packed: jax.Array,
    state: tuple[jax.Array, jax.Array],
    tensor: jax.Array,
    exists: jax.Array | None = None,
    normalise: bool = False,
    in_place: bool = True,
) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
    """One window, as `network.step`, of packed parameters; no gradient.

    All arrays are float32, of at least one pixel, but exists (B,) bool.
    normalise: the tensor first, as `tensors.normalise` does.
    in_place: in a scan the new state takes the old one's memory; else it needs none of its own, so
    that a state that comes from outside is not copied.
    Raises Unavailable where there is no machine code for it.
    """
    batch, height, width, bins = tensor.shape
    exists = jnp.ones(batch) if exists is None else exists
    # Of arrays that do not fit together machine code would read beyond the end.
    fit = bins == BINS and 4 * packed.size == _weights(len(STAGES)) + 2 * PIXEL
    fit = fit and exists.shape == (batch,)
    fit = fit and all(h.shape == (batch, height, width, CHANNELS) for h in state)
    float32 = all(x.dtype == jnp.float32 for x in (packed, tensor, *state))
    if vectors() == 0 or not tensor.size or not fit or not float32:
        raise Unavailable
    shapes = [h.shape for h in state] + [(batch, height, width)]
    call = jax.ffi.ffi_call(
        made(_make, height, width, normalise),
        [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes],
        input_output_aliases={3: 0, 4: 1} if in_place else {},
        vmap_method="sequential",
    )
    g1, g2, image = call(tensor, packed, exists.astype(jnp.float32), *state)
    return (g1, g2), image
