"""(packed parameters, State, event tensor) -> (State, image): the step of a CPU, as machine code.

The function of `network.step`, float32, equal to rounding, without a gradient. On a CPU, XLA's time
goes into 3x3 convolutions of 16 channels, one after the other. Here the whole step is one function
that XLA's programs call, compiled for the processor at hand when an image size is first seen;
`supports` says where there is one.

Convolutions are Winograd's F(2x2, 3x3) (Lavin and Gray, "Fast Algorithms for Convolutional Neural
Networks", CVPR 2016, Eqs. 5 to 8): 16 products instead of 36 for 2x2 pixels,

    Y = A^T [sum over inputs of (G g G^T) * (B^T d B)] A

with * element by element: d 4x4 pixels of an input, g its kernel. A map is (H + 2, W + 2) pixels of
16 channels, H and W rounded up to even numbers, zero wherever there is no pixel of the image.
"""

import warnings
from collections.abc import Callable
from functools import cache
from threading import Lock
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from firenet_jax.foreign_call import register
from firenet_jax.machine_code import (
    FLOAT,
    INT,
    LANES,
    POINTER,
    VECTOR,
    Code,
    Function,
    Module,
    integer,
    integer32,
    vector,
    vectors,
)
from firenet_jax.network import BINS, CHANNELS, State

assert CHANNELS == LANES
PIXEL = 4 * CHANNELS  # bytes
PLACES = 16  # of a transformed tile
STEP = 8  # inputs of a convolution between two jumps; the event tensor's 5 become so many

# --- The network -------------------------------------------------------------------------------


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
    """Both gates; then the candidate, after which the state changes in place."""

    def reset(f, sums, at):
        return f.b.fmul(f.sigmoid(sums), at(state))

    def update(f, sums, at):
        return f.b.fmul(f.sigmoid(sums), f.exists)

    def candidate(f, sums, at):
        return f.fma(at("update"), f.b.fsub(f.tanh(sums), at(state)), at(state))

    return [
        Stage((source, state), (Layer("reset", reset), Layer("update", update))),
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
    return f.total(f.b.fmul(pixel, f.prediction), f.offset)


STAGES = [
    Stage(("tensor",), (Layer("map", _relu),)),
    *_gru("map", "g1"),
    *_residual("g1", "map", _same),
    *_gru("map", "g2"),
    *_residual("g2", "image", _prediction),
]
INNER = ("tensor", "map", "reset", "update", "between")  # maps that nobody sees from outside


def _inputs(stage: Stage) -> int:
    return STEP if stage.sources == ("tensor",) else CHANNELS * len(stage.sources)


def pack(params) -> jax.Array:
    """All parameters in the order in which they are used, float32.

    Of each convolution its bias and G g G^T, (16 places, inputs, outputs); then the prediction's
    kernel and, 16 times, its bias.
    """
    convolutions = [params["head"]]
    for gru, block in (("gru1", "res1"), ("gru2", "res2")):
        gates, block = params[gru]["gates"], params[block]
        halves = [jax.tree.map(lambda x, i=i: jnp.split(x, 2, -1)[i], gates) for i in (0, 1)]
        convolutions += [*halves, params[gru]["candidate"], block["conv1"], block["conv2"]]
    g = np.array([[1, 0, 0], [0.5, 0.5, 0.5], [0.5, -0.5, 0.5], [0, 0, 1]], np.float32)
    parts = []
    for convolution in convolutions:
        kernel = jnp.einsum("yi,xj,ijco->yxco", g, g, convolution["kernel"], precision="highest")
        kernel = jnp.pad(kernel, ((0, 0), (0, 0), (0, -kernel.shape[2] % STEP), (0, 0)))
        parts += [convolution["bias"], kernel]
    last = params["prediction"]
    parts += [last["kernel"], jnp.repeat(last["bias"], CHANNELS)]
    return jnp.concatenate([jnp.ravel(part) for part in parts]).astype(jnp.float32)


# --- Its stages, a pair of rows at a time ------------------------------------------------------


class Size(NamedTuple):
    """Of images, and of the tiles of 2x2 pixels that are worked on together."""

    height: int
    width: int
    block: int  # tiles of a row whose sums stay in registers

    @property
    def down(self) -> int:
        return -(-self.height // 2)

    @property
    def across(self) -> int:
        return -(-self.width // 2)

    @property
    def line(self) -> int:
        return (2 * self.across + 2) * PIXEL

    @property
    def map(self) -> int:
        return (2 * self.down + 2) * self.line

    @property
    def tiles(self) -> int:
        return self.block * PIXEL


def _transform(module: Module, size: Size) -> Code:
    """transform(upper left neighbour of a block, transformed): B^T d B, (16 places, tiles)."""
    f = Function(module, "transform", [POINTER, POINTER])
    f.function.attributes.add("noinline")
    corner, transformed = f.arguments
    add, subtract = f.b.fadd, f.b.fsub

    def half(d):
        return subtract(d[0], d[2]), add(d[1], d[2]), subtract(d[2], d[1]), subtract(d[1], d[3])

    def column(pixel):
        return half([f.load(VECTOR, pixel, y * size.line) for y in range(4)])

    def tile(t, left):
        """Two of its four columns are those of the tile to the left."""
        here = f.at(corner, f.times(t, 2 * PIXEL))
        right = *column(f.at(here, 2 * PIXEL)), *column(f.at(here, 3 * PIXEL))
        rows = zip(left[:4], left[4:], right[:4], right[4:], strict=True)
        values = [value for row in rows for value in half(row)]
        for place, value in enumerate(values):
            f.store(value, transformed, f.times(t, PIXEL), place * size.tiles)
        return list(right)

    first = [*column(corner), *column(f.at(corner, PIXEL))]
    f.loop(0, size.block, tile, first)
    f.b.ret_void()
    return f.function


def _multiply(module: Module, size: Size) -> Code:
    """multiply(transformed, kernels, sums, maps, channels of each): sums, (16 places, tiles)."""
    f = Function(module, "multiply", [POINTER, POINTER, POINTER, INT, INT])
    f.function.attributes.add("noinline")
    transformed, kernels, sums, maps, channels = f.arguments
    inputs = f.b.mul(maps, channels)

    def place(i, _):
        def source(s, values):
            tiles = f.at(transformed, f.times(s, PLACES * size.tiles), f.times(i, size.tiles))
            row = f.b.add(f.b.mul(i, inputs), f.b.mul(s, channels))
            kernel = f.at(kernels, f.times(row, PIXEL))

            def steps(i, values):
                for c in range(STEP):
                    outputs = f.load(VECTOR, kernel, f.times(i, STEP * PIXEL), c * PIXEL)
                    numbers = f.at(tiles, f.times(i, 4 * STEP), 4 * c)
                    values = [
                        f.fma(f.everywhere(f.load(FLOAT, numbers, t * PIXEL)), outputs, value)
                        for t, value in enumerate(values)
                    ]
                return values

            return f.loop(0, f.b.sdiv(channels, integer(STEP)), steps, values)

        values = f.loop(0, maps, source, [vector(0)] * size.block)
        for t, value in enumerate(values):
            f.store(value, sums, f.times(i, size.tiles), t * PIXEL)

    f.loop(0, PLACES, place)
    f.b.ret_void()
    return f.function


def _arrays(f: Function, size: Size, pointers, image) -> dict:
    """What lies where for this image of the batch: arguments and results of `step`, and maps."""
    bytes_of_an_image = {
        "events": 4 * BINS * size.height * size.width,
        "weights": 0,
        "exists": 4,
        "g1": size.map,
        "g2": size.map,
        "image": 4 * 4 * size.down * size.across,
        "inner": len(INNER) * size.map,
    }
    arrays = {
        name: f.at(f.load(POINTER, pointers, 8 * i), f.times(image, step))
        for i, (name, step) in enumerate(bytes_of_an_image.items())
    }
    return arrays | {name: f.at(arrays["inner"], i * size.map) for i, name in enumerate(INNER)}


def _border(f: Function, size: Size, map, part) -> None:
    """Zeros around a pair of rows."""
    zero = vector(0)
    rows = f.at(map, f.times(part, 2 * size.line))
    for y in (1, 2):
        f.store(zero, rows, y * size.line)
        f.store(zero, rows, (y + 1) * size.line - PIXEL)
    for here, line in ((0, 0), (size.down - 1, size.map - size.line)):
        with f.b.if_then(f.b.icmp_signed("==", part, integer(here))):
            f.loop(
                0,
                size.line // PIXEL,
                lambda x, _, line=line: f.store(zero, map, f.times(x, PIXEL), line),
            )


def _events(module: Module, size: Size) -> Code:
    """The event tensor as a map: 16 channels instead of 5, zeros around."""
    f = Function(module, "events", [POINTER, INT, INT])
    pointers, image, part = f.arguments
    arrays = _arrays(f, size, pointers, image)
    for row in range(2):
        y = f.b.add(f.times(part, 2), integer(row))
        line = f.at(arrays["tensor"], f.times(y, size.line), size.line + PIXEL)
        y_inside = f.smaller(y, size.height - 1)
        numbers = f.at(arrays["events"], f.times(y_inside, 4 * BINS * size.width))

        def pixel(x, _, y=y, line=line, numbers=numbers):
            x_inside = f.smaller(x, size.width - 1)
            value = vector(0)
            for c in range(BINS):
                number = f.load(FLOAT, numbers, f.times(x_inside, 4 * BINS), 4 * c)
                value = f.b.insert_element(value, number, integer32(c))
            inside = f.b.and_(f.less(y, size.height), f.less(x, size.width))
            f.store(f.b.select(inside, value, vector(0)), line, f.times(x, PIXEL))

        f.loop(0, 2 * size.across, pixel)
    _border(f, size, arrays["tensor"], part)
    f.b.ret_void()
    return f.function


def _stage(
    module: Module,
    size: Size,
    name: str,
    stage: Stage,
    weights: int,
    transform: Code,
    multiply: Code,
) -> Code:
    """A pair of rows of a stage whose weights begin at this byte."""
    f = Function(module, name, [POINTER, INT, INT])
    pointers, image, part = f.arguments
    arrays = _arrays(f, size, pointers, image)
    transformed = f.local(len(stage.sources) * PLACES * size.tiles)
    sums = f.local(PLACES * size.tiles)
    f.exists = f.everywhere(f.load(FLOAT, arrays["exists"]))
    f.prediction = f.load(VECTOR, arrays["weights"], _weights(len(STAGES)))
    f.offset = f.load(FLOAT, arrays["weights"], _weights(len(STAGES)) + PIXEL)

    def half(m):
        first = f.b.fadd(f.b.fadd(m[0], m[1]), m[2])
        return first, f.b.fsub(f.b.fsub(m[1], m[2]), m[3])

    def finish(layer, bias, x, t):
        """A^T m A, and what the layer makes of the 2x2 pixels."""
        tile = f.b.add(x, t)
        m = [f.load(VECTOR, sums, f.times(t, PIXEL), i * size.tiles) for i in range(PLACES)]
        columns = [half(m[i::4]) for i in range(4)]
        rows = [half(row) for row in zip(*columns, strict=True)]
        for dy, row in enumerate(rows):
            for dx, value in enumerate(row):
                y = f.b.add(f.times(part, 2), integer(dy))
                x_pixel = f.b.add(f.times(tile, 2), integer(dx))
                here = f.b.add(f.times(y, size.line), f.times(x_pixel, PIXEL))
                here = f.b.add(here, integer(size.line + PIXEL))
                value = layer.finish(
                    f,
                    f.b.fadd(value, bias),
                    lambda name, here=here: f.load(VECTOR, arrays[name], here),
                )
                if layer.target == "image":
                    place = f.b.add(f.times(y, 2 * size.across), x_pixel)
                    f.store(value, arrays["image"], f.times(place, 4))
                    continue
                for outside, odd in (
                    (f.less(y, size.height), size.height % 2 and dy),
                    (f.less(x_pixel, size.width), size.width % 2 and dx),
                ):
                    if odd:
                        value = f.b.select(outside, value, vector(0))
                f.store(value, arrays[layer.target], here)

    def block(i, _):
        # The last block begins early enough to end with the row; what the one before it has
        # finished is left alone, because a state changes in place.
        wanted = f.times(i, size.block)
        x = f.smaller(wanted, size.across - size.block)
        corner = f.b.add(f.times(part, 2 * size.line), f.times(x, 2 * PIXEL))
        for s, source in enumerate(stage.sources):
            there = f.at(transformed, s * PLACES * size.tiles)
            f.b.call(transform, [f.at(arrays[source], corner), there])
        maps = len(stage.sources)
        each = integer(_inputs(stage) // maps)
        offset = weights
        for layer in stage.layers:
            kernels = f.at(arrays["weights"], offset + PIXEL)
            f.b.call(multiply, [transformed, kernels, sums, integer(maps), each])
            bias = f.load(VECTOR, arrays["weights"], offset)
            f.loop(
                f.b.sub(wanted, x),
                size.block,
                lambda t, _, layer=layer, bias=bias: finish(layer, bias, x, t),
            )
            offset += PIXEL + PLACES * _inputs(stage) * PIXEL

    f.loop(0, -(-size.across // size.block), block)
    for layer in stage.layers:
        if layer.target in INNER:
            _border(f, size, arrays[layer.target], part)
    f.b.ret_void()
    return f.function


def _weights(stage: int) -> int:
    """Where the weights of a stage begin, in bytes; after the last stage the prediction's."""
    return sum(len(each.layers) * (1 + PLACES * _inputs(each)) * PIXEL for each in STAGES[:stage])


def _block(tiles: int, most: int) -> int:
    """A number of tiles that leaves little over; a block of n costs about as much as n + 1."""
    return min(range(1, min(most, tiles) + 1), key=lambda n: -(-tiles // n) * (n + 1))


@cache
def _target(height: int, width: int) -> str:
    """The name by which XLA knows the step for images of this size, compiled when first asked.

    Raises RuntimeError where XLA's interface is no longer the one of `foreign_call`.
    """
    size = Size(height, width, _block(-(-width // 2), 12 if vectors() == 32 else 6))
    module = Module()
    parts = _transform(module, size), _multiply(module, size)
    stages = [
        _stage(module, size, f"stage{i}", stage, _weights(i), *parts)
        for i, stage in enumerate(STAGES)
    ]
    name = f"firenet_step_{height}_{width}"
    register(name, module, [_events(module, size), *stages], size.down, 5, [2, 3])
    return name


# --- To JAX ------------------------------------------------------------------------------------


def supports(height: int, width: int) -> bool:
    """Whether `step` runs for images of this size, here; compiles it."""
    if vectors() == 0 or jax.default_backend() != "cpu":
        return False
    with _compiling:  # threads that ask together: a name is registered once
        try:
            _target(height, width)
        except RuntimeError as error:
            warnings.warn(f"reconstruction is slower than it could be here: {error}", stacklevel=2)
            return False
    return True


_compiling = Lock()


def enclose(state: State) -> State:
    """States as `step` keeps them: maps, (B, H + 2, W + 2, 16), H and W even."""
    _, height, width, _ = state.g1.shape
    sides = (0, 0), (1, 1 + height % 2), (1, 1 + width % 2), (0, 0)
    return State(*(jnp.pad(h, sides) for h in state))


def interior(state: State, height: int, width: int) -> State:
    return State(*(h[:, 1 : 1 + height, 1 : 1 + width] for h in state))


def step(
    packed: jax.Array, state: State, tensor: jax.Array, exists: jax.Array | None = None
) -> tuple[State, jax.Array]:
    """One window, as `network.step`: packed parameters, an enclosed state."""
    batch, height, width, _ = tensor.shape
    exists = jnp.ones(batch) if exists is None else exists
    size = Size(height, width, 0)
    shapes = [h.shape for h in state]
    shapes += [(batch, 2 * size.down, 2 * size.across), (batch * len(INNER) * size.map // 4,)]
    call = jax.ffi.ffi_call(
        _target(height, width),
        [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes],
        input_output_aliases={3: 0, 4: 1},
    )
    g1, g2, image, _ = call(tensor, packed, exists.astype(jnp.float32), *state)
    return State(g1, g2), image[:, :height, :width]
