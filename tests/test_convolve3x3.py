"""The machine code of a convolution and of its gradients against XLA's and float64."""

import ctypes
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("llvmlite")

from firenet_jax import convolution, native
from firenet_jax.native import Unavailable, convolve3x3, kernel_gradient, llvm

pytestmark = pytest.mark.skipif(
    jax.default_backend() != "cpu" or llvm.vectors() == 0,
    reason="no machine code for this processor",
)


@pytest.fixture(autouse=True)
def _switched_on(monkeypatch):
    monkeypatch.delenv("FIRENET_NATIVE", raising=False)


def convolve(image, kernel):
    return convolution.layer([image], kernel)[0]


# B, H, W, inputs, outputs: less than a tile and a register, one more than that, training's.
SHAPES = [
    (1, 1, 1, 1, 16),
    (2, 7, 9, 5, 16),
    (1, 3, 2, 16, 32),
    (3, 13, 31, 32, 16),
    (2, 30, 50, 32, 32),
    (1, 4, 3, 20, 48),
    (5, 9, 29, 16, 16),
    (1, 6, 200, 7, 64),
    (1, 200, 1, 16, 16),
    (2, 96, 96, 16, 32),
]


def random_case(batch, height, width, inputs, outputs, kind=np.float32):
    rng = np.random.default_rng(height + width)
    shapes = (batch, height, width, inputs), (3, 3, inputs, outputs)
    arrays = [rng.normal(size=shape) for shape in (*shapes, (batch, height, width, outputs))]
    return [array.astype(kind) for array in arrays]


def exact(image, kernel, gradient):
    """In float64: the convolution, and the kernel's gradient."""
    image, kernel, gradient = (np.asarray(x, np.float64) for x in (image, kernel, gradient))
    height, width = image.shape[1:3]
    padded = np.pad(image, ((0, 0), (1, 1), (1, 1), (0, 0)))
    windows = np.stack(
        [padded[:, i : i + height, j : j + width] for i in range(3) for j in range(3)]
    )
    result = np.einsum("kbyxi,kio->byxo", windows, kernel.reshape(9, *kernel.shape[2:]))
    by_kernel = np.einsum("kbyxi,byxo->kio", windows, gradient, optimize=True)
    return result, by_kernel.reshape(kernel.shape)


def ours(image, kernel, gradient):
    image, kernel, gradient = map(jnp.asarray, (image, kernel, gradient))
    (result,) = native.convolve([image], kernel)
    by_kernel, by_bias = native.gradients([image], kernel, [gradient])
    assert_same(by_bias, np.asarray(gradient, np.float64).sum((0, 1, 2)))
    return result, by_kernel


def assert_same(found, expected):
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_equals_float64_and_xla(shape):
    image, kernel, gradient = random_case(*shape)
    result, by_kernel = exact(image, kernel, gradient)
    found, found_gradient = ours(image, kernel, gradient)
    assert_same(found, result)
    assert_same(found, np.asarray(convolution._plain(image, kernel)))
    assert_same(found_gradient, by_kernel)
    assert_same(
        found_gradient, np.asarray(convolution._xla_kernel_gradient(image, kernel, gradient))
    )


def test_on_processors_without_avx512(monkeypatch):
    """The instructions of one run on all that have more."""
    monkeypatch.setenv("FIRENET_NATIVE", "avx2")
    for shape in [(2, 10, 33, 5, 16), (1, 9, 21, 32, 32), (2, 9, 37, 16, 16)]:
        assert shape[1:] not in (other[1:] for other in SHAPES)  # whose code would be used again
        image, kernel, gradient = random_case(*shape)
        result, by_kernel = exact(image, kernel, gradient)
        jax.tree.map(assert_same, ours(image, kernel, gradient), (result, by_kernel))


def layers(convolve, kernels, image):
    """A scan over two layers, as the network has them, with what is kept computed again."""

    def body(h, x):
        def once(h, x):
            for kernel in kernels:
                h = jnp.tanh(convolve(h + x, kernel))
            return h

        h = jax.checkpoint(once)(h, x)
        return h, h.sum()

    return (jax.lax.scan(body, jnp.zeros_like(image[0]), image)[1] ** 2).sum()


@pytest.mark.slow
def test_in_scans_maps_and_computed_again():
    rng = np.random.default_rng(0)
    kernels = jnp.asarray(0.1 * rng.normal(size=(2, 3, 3, 16, 16)), jnp.float32)
    images = jnp.asarray(rng.normal(size=(3, 4, 2, 11, 13, 16)), jnp.float32)
    machine = jax.value_and_grad(partial(layers, convolve), (0, 1))
    theirs = jax.value_and_grad(partial(layers, convolution._plain), (0, 1))
    for transform in (
        lambda f: lambda kernels, images: f(kernels, images[0]),
        lambda f: jax.vmap(f, (None, 0)),
        lambda f: lambda kernels, images: jax.lax.map(partial(f, kernels), images),
        lambda f: lambda kernels, images: jax.vmap(f)(jnp.stack([kernels] * 3), images),
    ):
        program = jax.jit(transform(machine))
        found, expected = program(kernels, images), jax.jit(transform(theirs))(kernels, images)
        jax.tree.map(assert_same, *map(lambda t: jax.tree.map(np.asarray, t), (found, expected)))
    assert "custom_call" in program.lower(kernels, images).as_text()


@pytest.mark.parametrize("kind", [jnp.bfloat16, jnp.float16])
def test_other_types_are_xlas(kind):
    image, kernel, gradient = (jnp.asarray(x, kind) for x in random_case(1, 5, 7, 16, 16))
    found, back = jax.vjp(convolve, image, kernel)
    assert found.dtype == kind
    assert_same(np.asarray(found, np.float32), np.asarray(convolution._plain(image, kernel), "f4"))
    assert [x.dtype for x in back(gradient)] == [kind, kind]


@pytest.mark.parametrize(
    "image, kernel",
    [((1, 5, 7, 4), (3, 3, 4, 5)), ((1, 5, 7, 4), (3, 5, 4, 16)), ((0, 5, 7, 4), (3, 3, 4, 16))],
)
def test_what_it_does_not_compute(image, kernel):
    with pytest.raises(Unavailable):
        native.convolve([jnp.zeros(image)], jnp.zeros(kernel))
    assert convolve(jnp.zeros(image), jnp.zeros(kernel)).shape == (*image[:3], kernel[3])


@pytest.mark.parametrize("where", ["image", "kernel"])
@pytest.mark.parametrize("what", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_goes_where_it_goes_in_xla(where, what):
    """Where the convolution is direct; Winograd's tiles carry it a little farther."""
    image, kernel, _ = random_case(1, 6, 30, 32, 16)
    if where == "image":
        image[0, 2, 29, 3] = what
    else:
        kernel[0, 1, 3, 4] = what
    (found,) = native.convolve([jnp.asarray(image)], jnp.asarray(kernel))
    np.testing.assert_array_equal(np.isnan(found), np.isnan(convolution._plain(image, kernel)))


def test_what_is_not_finite_stays_so_and_near():
    image, kernel, gradient = random_case(1, 30, 30, 16, 16)
    image[0, 12, 15, 3] = np.nan
    (found,) = native.convolve([jnp.asarray(image)], jnp.asarray(kernel))
    lost = np.isnan(found).all((0, 3))
    assert lost[11:14, 14:17].all() and not lost[:8].any() and not lost[20:].any()
    assert not lost[:, :12].any() and not lost[:, 19:].any()
    by_kernel, by_bias = native.gradients([image], kernel, [gradient])
    assert np.isnan(by_kernel[:, :, 3]).all() and np.isfinite(by_kernel[:, :, 4]).all()
    assert np.isfinite(by_bias).all()


CANARY, SIDE = np.nan, 64


def surrounded(array):
    """The same array with numbers that nobody may change, or would use unseen, on both sides."""
    memory = np.full(array.size + 2 * SIDE, CANARY, np.float32)
    memory[SIDE:-SIDE] = array.ravel()
    return memory


@pytest.mark.parametrize("shape", SHAPES[:8], ids=str)
def test_nothing_is_read_or_written_beside_the_arrays(shape):
    batch, height, width, inputs, outputs = shape
    image, kernel, gradient = random_case(*shape)
    result, by_kernel = exact(image, kernel, gradient)
    channels = (inputs,), (outputs,)

    def run(write, arrays, parts):
        module = llvm.Module()
        stages = write(module)
        for stage in stages:
            stage.linkage = ""
        memory = [surrounded(array) for array in arrays]
        before = [each.copy() for each in memory]
        pointers = np.array([each[SIDE:].ctypes.data for each in memory], np.uint64)
        address = llvm.compiled(module)
        signature = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64)
        for stage in [signature(address(stage.name)) for stage in stages]:
            for part in np.random.default_rng(0).permutation(batch * parts):
                stage(pointers.ctypes.data, *divmod(int(part), parts))
        for each, old in zip(memory, before, strict=True):
            np.testing.assert_array_equal(each[:SIDE], old[:SIDE])
            np.testing.assert_array_equal(each[-SIDE:], old[-SIDE:])
        return [each[SIDE:-SIDE] for each in memory]

    layer = convolve3x3.Layer(height, width, (inputs,), ("none",), outputs, False)
    *_, found = run(
        lambda module: convolve3x3._stages(module, layer),
        [image, np.asarray(convolve3x3._kernel(layer, kernel)), np.zeros_like(gradient)],
        -(-height // convolve3x3.ROWS),
    )
    assert_same(found.reshape(result.shape), result)
    numbers, parts = kernel_gradient._numbers(*channels), kernel_gradient._parts(height)
    *_, found, _ = run(
        lambda module: kernel_gradient._stages(module, batch, height, width, *channels),
        [image, gradient, np.zeros(numbers), np.zeros(batch * parts * numbers)],
        parts,
    )
    is_winograd = kernel_gradient._is_winograd(*channels)
    found, by_bias = kernel_gradient._gradients(jnp.asarray(found), kernel, is_winograd)
    assert_same(found, by_kernel)
    assert_same(by_bias, gradient.astype(np.float64).sum((0, 1, 2)))


@pytest.mark.parametrize(
    "maps, activations",
    [
        ([16], ["relu"]),
        ([5], ["relu"]),
        pytest.param([16, 16], ["sigmoid", "sigmoid"], marks=pytest.mark.slow),
        pytest.param([16, 16], ["tanh"], marks=pytest.mark.slow),
        pytest.param([16, 16, 16], ["none", "tanh", "sigmoid"], marks=pytest.mark.slow),
    ],
)
def test_several_maps_as_one_with_bias_and_activation(maps, activations):
    """And all gradients, those of what XLA computes of it."""
    rng = np.random.default_rng(0)

    def random(*shape):
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    outputs = 16 * len(activations)
    images = [random(2, 9, 35, size) for size in maps]
    kernel, bias = 0.1 * random(3, 3, sum(maps), outputs), random(outputs)
    weights = [random(2, 9, 35, 16) for _ in activations]

    def run(alone, images, kernel, bias):
        with native.by_xla_alone(alone):
            results = convolution.layer(images, kernel, bias, tuple(activations))
        return sum((a * b).sum() for a, b in zip(results, weights, strict=True)), results

    def plain(images, kernel, bias):
        sums = convolution._plain(jnp.concatenate(images, -1), kernel) + bias.reshape(1, 1, 1, -1)
        functions = {"none": lambda x: x, "relu": jax.nn.relu, "sigmoid": jax.nn.sigmoid}
        functions["tanh"] = jnp.tanh
        parts = jnp.split(sums, len(activations), -1)
        results = [functions[name](x) for name, x in zip(activations, parts, strict=True)]
        return sum((a * b).sum() for a, b in zip(results, weights, strict=True)), tuple(results)

    arguments = images, kernel, bias
    expected = jax.value_and_grad(plain, (0, 1, 2), has_aux=True)(*arguments)
    for alone in (False, True):
        function = jax.jit(jax.value_and_grad(partial(run, alone), (0, 1, 2), has_aux=True))
        assert ("custom_call" in function.lower(*arguments).as_text()) != alone
        jax.tree.map(
            lambda a, b: assert_same(np.asarray(a), np.asarray(b)), function(*arguments), expected
        )


@pytest.mark.parametrize(
    "change",
    [
        {"bias": (1,)},
        {"bias": (16,)},
        {"kernel": (3, 3, 16, 32)},
        {"kernel": (3, 3, 48, 32)},
        {"maps": [(2, 5, 6, 16), (2, 5, 7, 16)]},
        {"maps": [(2, 5, 6, 16), (1, 5, 6, 16)]},
        {"operand": (2, 5, 5, 16)},
        {"operand": (2, 5, 6, 15)},
        {"operand": None},
    ],
    ids=str,
)
def test_what_does_not_fit_together_is_not_read(change):
    """Whatever XLA does with it: machine code would read beyond the end."""
    shapes = {
        "maps": [(2, 5, 6, 16), (2, 5, 6, 16)],
        "kernel": (3, 3, 32, 32),
        "bias": (32,),
        "operand": (2, 5, 6, 16),
    } | change
    maps = [jnp.zeros(shape) for shape in shapes["maps"]]
    operands = [jnp.zeros(shapes["operand"])] if shapes["operand"] else []
    kernel, bias = jnp.zeros(shapes["kernel"]), jnp.zeros(shapes["bias"])
    with pytest.raises(Unavailable):
        native.convolve(maps, kernel, bias, ("none", "none"), "gates", operands)


def test_gradients_that_do_not_fit_together_are_not_read():
    image, gradient = jnp.zeros((2, 5, 6, 16)), jnp.zeros((2, 5, 6, 16))
    for other in ((2, 5, 6, 32), (2, 4, 6, 16), (1, 5, 6, 16)):
        with pytest.raises(Unavailable):
            native.gradients([image], jnp.zeros((3, 3, 16, 16)), [jnp.zeros(other)])
        with pytest.raises(Unavailable):
            native.gradients([jnp.zeros(other)], jnp.zeros((3, 3, 16, 16)), [gradient])


def test_more_arrays_than_a_call_has_room_for_are_xlas():
    """Their addresses would lie where threads count what is done."""
    maps = [jnp.full((1, 5, 6, 16), 0.1 * k) for k in range(12)]
    kernel, bias = jnp.full((3, 3, 192, 16), 0.01), jnp.zeros(16)
    with pytest.raises(Unavailable):
        native.convolve(maps, kernel, bias)
    (found,) = convolution.layer(maps, kernel, bias)
    assert_same(found, convolution._plain(jnp.concatenate(maps, -1), kernel))
