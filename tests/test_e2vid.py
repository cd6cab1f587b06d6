from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.traverse_util import flatten_dict
from jax.extend.core import jaxprs_in_params

from firenet_jax.evaluation.baselines import e2vid
from firenet_jax.evaluation.baselines.e2vid import (
    Settings,
    initial_params,
    initial_state,
    load,
    multiply_adds,
    step,
)
from firenet_jax.native import by_xla_alone
from firenet_jax.reconstruction import padding
from firenet_jax.storage.pytorch_file import CheckpointError

SMALL = 4  # channels: the same network, 64 times as quick
DECODERS = pytest.mark.parametrize("transposed", [True, False], ids=["transposed", "upsampled"])
NORMS = pytest.mark.parametrize("norm", [True, False], ids=["norm", "no_norm"])


def random_params(settings):
    return initial_params(jax.random.key(0), settings)


def count(tree) -> int:
    return sum(leaf.size for leaf in jax.tree.leaves(tree))


# ---- the twin


def import_torch():
    return pytest.importorskip("torch", reason="compares with PyTorch, which is not installed")


def twin(channels: int, transposed: bool, norm: bool, sigmoid: bool = True):
    """E2VID in PyTorch (NCHW), its modules named as in published checkpoints.

    A module (list of three (h, c), tensor) -> (list, image), random as PyTorch makes it; batch
    normalisations hold what they could have learnt.
    """
    torch = import_torch()
    nn, F = torch.nn, torch.nn.functional

    class ConvLayer(nn.Module):
        def __init__(self, inputs, outputs, size, stride=1, norm=False, kind="conv2d"):
            super().__init__()
            bias = not norm
            if kind == "conv2d":
                conv = nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=bias)
            else:
                conv = nn.ConvTranspose2d(
                    inputs, outputs, size, stride=2, padding=2, output_padding=1, bias=bias
                )
            self.kind = kind
            setattr(self, kind, conv)
            if norm:
                self.norm_layer = nn.BatchNorm2d(outputs)

        def forward(self, x):
            x = getattr(self, self.kind)(x)
            return self.norm_layer(x) if hasattr(self, "norm_layer") else x

    class ConvLSTM(nn.Module):
        def __init__(self, features):
            super().__init__()
            self.Gates = nn.Conv2d(2 * features, 4 * features, 3, padding=1)

        def forward(self, x, state):
            h, c = state
            i, f, o, g = self.Gates(torch.cat([x, h], 1)).chunk(4, 1)
            c = torch.sigmoid(f) * c + torch.sigmoid(i) * torch.tanh(g)
            return torch.sigmoid(o) * torch.tanh(c), c

    class Encoder(nn.Module):
        def __init__(self, inputs, outputs):
            super().__init__()
            self.conv = ConvLayer(inputs, outputs, 5, 2, norm)
            self.recurrent_block = ConvLSTM(outputs)

        def forward(self, x, state):
            return self.recurrent_block(F.relu(self.conv(x)), state)

    class ResidualBlock(nn.Module):
        def __init__(self, features):
            super().__init__()
            self.conv1 = nn.Conv2d(features, features, 3, padding=1, bias=not norm)
            self.conv2 = nn.Conv2d(features, features, 3, padding=1, bias=not norm)
            if norm:
                self.bn1 = nn.BatchNorm2d(features)
                self.bn2 = nn.BatchNorm2d(features)

        def forward(self, x):
            y = self.conv1(x)
            y = self.conv2(F.relu(self.bn1(y) if norm else y))
            return F.relu((self.bn2(y) if norm else y) + x)

    class UNetRecurrent(nn.Module):
        def __init__(self):
            super().__init__()
            sizes = [channels * n for n in (1, 2, 4, 8)]
            kind = "transposed_conv2d" if transposed else "conv2d"
            self.head = ConvLayer(5, channels, 5)
            self.encoders = nn.ModuleList(
                [Encoder(a, b) for a, b in zip(sizes, sizes[1:], strict=False)]
            )
            self.resblocks = nn.ModuleList([ResidualBlock(sizes[3]) for _ in range(2)])
            self.decoders = nn.ModuleList(
                [ConvLayer(2 * n, n, 5, norm=norm, kind=kind) for n in reversed(sizes[:3])]
            )
            self.pred = ConvLayer(channels, 1, 1, norm=norm)

        def forward(self, states, tensor):
            head = x = F.relu(self.head(tensor))
            new = []
            for encoder, state in zip(self.encoders, states, strict=True):
                new.append(encoder(x, state))
                x = new[-1][0]
            for block in self.resblocks:
                x = block(x)
            for decoder, (skip, _) in zip(self.decoders, reversed(new), strict=True):
                x = x + skip
                if not transposed:
                    x = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
                x = F.relu(decoder(x))
            image = self.pred(x + head)
            return new, torch.sigmoid(image) if sigmoid else image

    class E2VIDRecurrent(nn.Module):
        def __init__(self):
            super().__init__()
            self.unetrecurrent = UNetRecurrent()

        def forward(self, states, tensor):
            return self.unetrecurrent(states, tensor)

    torch.manual_seed(0)
    network = E2VIDRecurrent().eval()
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            nn.init.normal_(module.running_mean, 0, 0.1)
            nn.init.uniform_(module.running_var, 0.01, 0.3)
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.normal_(module.bias, 0, 0.1)
        if isinstance(module, ConvLSTM):  # so that cells saturate and remember
            module.Gates.weight.data *= 3
    return network


def twin_run(network, channels, tensors):
    """(T, B, H, W, 5) -> states, images (T, B, H, W): padded by PyTorch's reflection."""
    torch = import_torch()
    steps, batch, height, width, _ = tensors.shape
    tensors = torch.tensor(np.asarray(tensors)).permute(0, 1, 4, 2, 3)
    (top, bottom), (left, right) = padding(height, width, 8)
    pad = torch.nn.ReflectionPad2d((left, right, top, bottom))
    height_8, width_8 = top + height + bottom, left + width + right
    zeros = [torch.zeros(batch, channels * n, height_8 // n, width_8 // n) for n in (2, 4, 8)]
    states, images = [(zero, zero) for zero in zeros], []
    with torch.no_grad():
        for tensor in tensors:
            states, image = network(states, pad(tensor))
            images.append(image[:, 0, top : top + height, left : left + width])
    return states, torch.stack(images).numpy()


def our_run(params, settings, tensors):
    state = initial_state(*tensors.shape[1:4], settings)
    return jax.lax.scan(partial(step, params, settings=settings), state, tensors)


@pytest.mark.reference
@DECODERS
@NORMS
def test_equals_a_pytorch_twin_whose_checkpoint_it_reads(tmp_path, transposed, norm):
    torch = import_torch()
    network = twin(SMALL, transposed, norm, sigmoid=transposed)
    # As the authors save it: in the layout before PyTorch 1.6, the configuration beside it.
    content = {"arch": "E2VIDRecurrent", "model": {"num_bins": 5, "norm": "BN"}}
    content["state_dict"] = network.state_dict()
    path = tmp_path / "e2vid.pth.tar"
    torch.save(content, path, _use_new_zipfile_serialization=not norm)

    params, settings = load(path, sigmoid=transposed)
    assert settings == Settings(transposed=transposed, sigmoid=transposed, channels=SMALL)
    tensors = jax.random.normal(jax.random.key(1), (5, 2, 27, 38, 5))
    state, images = our_run(params, settings, tensors)
    states, expected = twin_run(network, SMALL, tensors)

    assert images.shape == (5, 2, 27, 38) and images.dtype == jnp.float32
    assert expected.std() > 0.01  # the pictures are not flat
    assert np.abs(expected[4] - expected[0]).max() > 0.01
    np.testing.assert_allclose(images, expected, atol=1e-5)
    for h, c, (their_h, their_c) in zip(state.hidden, state.cell, states, strict=True):
        assert np.abs(their_c.numpy()).max() > 0.1
        np.testing.assert_allclose(h, their_h.permute(0, 2, 3, 1), atol=1e-5)
        np.testing.assert_allclose(c, their_c.permute(0, 2, 3, 1), atol=1e-5)


@pytest.mark.reference
def test_upsampling_equals_pytorchs():
    torch = import_torch()
    x = np.random.default_rng(0).normal(size=(2, 3, 5, 4)).astype(np.float32)
    expected = torch.nn.functional.interpolate(
        torch.tensor(x).permute(0, 3, 1, 2), scale_factor=2, mode="bilinear", align_corners=False
    )
    np.testing.assert_allclose(e2vid._twice(x), expected.permute(0, 2, 3, 1), atol=1e-6)


# ---- parameters and state


@DECODERS
def test_has_the_papers_number_of_parameters(transposed):
    params = jax.eval_shape(
        partial(initial_params, settings=Settings(transposed)), jax.random.key(0)
    )
    assert count(params) == 10_710_401


@pytest.mark.reference
@DECODERS
def test_the_twin_has_them_too(transposed):
    for norm, expected in [(False, 10_710_401), (True, 10_712_098)]:
        network = twin(32, transposed, norm)
        assert sum(p.numel() for p in network.parameters()) == expected
    assert sum(buffer.numel() for buffer in network.buffers()) == 3_405


@DECODERS
def test_parameters_are_those_that_the_network_asks_for(transposed):
    settings = Settings(transposed, channels=SMALL)
    network = e2vid.E2VID(settings)
    key, tensor = jax.random.key(0), jnp.zeros((1, 8, 8, 5))
    asked = jax.eval_shape(network.init, key, initial_state(1, 8, 8, settings), tensor)["params"]
    params = jax.eval_shape(partial(initial_params, settings=settings), key)
    shapes = {name: leaf.shape for name, leaf in flatten_dict(params, sep="/").items()}
    assert shapes == {name: leaf.shape for name, leaf in flatten_dict(asked, sep="/").items()}


@pytest.mark.reference
@DECODERS
def test_initial_parameters_are_distributed_as_pytorchs(tmp_path, transposed):
    torch = import_torch()
    network = twin(8, transposed, norm=False)
    for encoder in network.unetrecurrent.encoders:
        encoder.recurrent_block.Gates.weight.data /= 3
    torch.save(network.state_dict(), tmp_path / "e2vid.pth")
    theirs, settings = load(tmp_path / "e2vid.pth")
    ours = random_params(settings)
    for our, their in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        if our.size >= 64:
            assert np.abs(our).max() == pytest.approx(np.abs(their).max(), rel=0.1)
            assert abs(our.mean()) < 0.3 * np.abs(our).max()


@pytest.mark.parametrize("size, padded", [((180, 240), (184, 240)), ((16, 8), (16, 8))])
def test_state_is_of_the_padded_size(size, padded):
    state = jax.eval_shape(lambda: initial_state(3, *size))
    shapes = [(3, padded[0] // n, padded[1] // n, 32 * n) for n in (2, 4, 8)]
    assert [leaf.shape for leaf in state.hidden] == [leaf.shape for leaf in state.cell] == shapes


def test_a_recording_in_pieces_gives_the_same_images():
    settings = Settings(channels=SMALL)
    params = random_params(settings)
    tensors = jax.random.normal(jax.random.key(1), (4, 1, 13, 18, 5))
    _, expected = our_run(params, settings, tensors)
    state, images = initial_state(1, 13, 18, settings), []
    once = jax.jit(partial(step, settings=settings))
    for tensor in tensors:
        state, image = once(params, state, tensor)
        images.append(image)
    assert once._cache_size() == 1
    np.testing.assert_allclose(np.stack(images), expected, atol=1e-6)


def test_whoever_pads_before_gets_the_same_image():
    settings = Settings(channels=SMALL)
    params = random_params(settings)
    tensor = jax.random.normal(jax.random.key(1), (1, 13, 18, 5))
    state = initial_state(1, 13, 18, settings)
    once = jax.jit(partial(step, settings=settings))
    _, image = once(params, state, tensor)
    wide = jnp.pad(tensor, ((0, 0), (2, 1), (3, 3), (0, 0)), mode="reflect")
    _, expected = once(params, state, wide)
    np.testing.assert_allclose(image, expected[:, 2:15, 3:21], atol=1e-6)


# ---- multiply-adds


def traced_multiply_adds(jaxpr, dilated: bool) -> int:
    """All convolutions of a traced program; dilated: multiplications by inserted zeros count."""
    total = 0
    for equation in jaxpr.eqns:
        for inner in jaxprs_in_params(equation.params):
            total += traced_multiply_adds(inner, dilated)
        if equation.primitive.name == "conv_general_dilated":
            image, kernel = (variable.aval.shape for variable in equation.invars)
            out = equation.outvars[0].aval.shape
            spec = equation.params["dimension_numbers"]
            assert spec.lhs_spec == spec.out_spec == (0, 3, 1, 2) and out[0] == 1
            assert spec.rhs_spec == (3, 2, 0, 1) and image[3] == kernel[2]
            macs = out[1] * out[2] * int(np.prod(kernel))
            zeros = int(np.prod(equation.params["lhs_dilation"]))
            total += macs if dilated else macs // zeros
        assert equation.primitive.name != "dot_general"
    return total


@DECODERS
@pytest.mark.parametrize("size", [(32, 40), (27, 38)], ids=str)
def test_multiply_adds_are_those_of_the_traced_program(transposed, size):
    settings = Settings(transposed)
    params = jax.eval_shape(partial(initial_params, settings=settings), jax.random.key(0))
    state = jax.eval_shape(partial(initial_state, 1, *size, settings))
    tensor = jax.ShapeDtypeStruct((1, *size, 5), jnp.float32)
    with by_xla_alone():  # machine code's products are not in the program
        program = jax.make_jaxpr(partial(step, settings=settings))(params, state, tensor)
    traced = traced_multiply_adds(program.jaxpr, dilated=False)
    assert (
        multiply_adds(*size, settings) == traced == 32 * 40 * (338_880 if transposed else 454_080)
    )
    # Charged on what leaves it, a transposed convolution costs what an upsampling one does.
    assert traced_multiply_adds(program.jaxpr, dilated=True) == 32 * 40 * 454_080


@pytest.mark.parametrize(
    ("width", "height", "paper"),
    [(240, 180, 21.2), (346, 260, 44.5), (640, 480, 147.2), (1280, 720, 441.7)],
)
def test_multiply_adds_against_table_2(width, height, paper):
    """The paper's table stays a constant 5.2 to 5.8 % above the count on the output."""
    ratio = paper * 1e9 / multiply_adds(height, width, Settings(transposed=False))
    assert 1.052 < ratio < 1.058


# ---- other files


def state_dict(transposed=True, norm=True, prefix="unetrecurrent.") -> dict[str, np.ndarray]:
    """Names and shapes as published, of the smallest network; all weights are ones."""
    shapes = {"head.conv2d.weight": (1, 5, 5, 5), "head.conv2d.bias": (1,)}

    def layer(name, shape, normed, outputs):
        shapes[f"{name}.weight"] = shape
        if not norm:
            shapes[f"{name}.bias"] = (outputs,)
            return
        for part in ("weight", "bias", "running_mean", "running_var"):
            shapes[f"{normed}.{part}"] = (outputs,)
        shapes[f"{normed}.num_batches_tracked"] = ()

    for i, n in enumerate((2, 4, 8)):
        encoder, decoder = f"encoders.{i}", f"decoders.{2 - i}"
        layer(f"{encoder}.conv.conv2d", (n, n // 2, 5, 5), f"{encoder}.conv.norm_layer", n)
        shapes[f"{encoder}.recurrent_block.Gates.weight"] = (4 * n, 2 * n, 3, 3)
        shapes[f"{encoder}.recurrent_block.Gates.bias"] = (4 * n,)
        conv = f"{decoder}.transposed_conv2d" if transposed else f"{decoder}.conv2d"
        shape = (n, n // 2, 5, 5) if transposed else (n // 2, n, 5, 5)
        layer(conv, shape, f"{decoder}.norm_layer", n // 2)
    for name in ("0.{}1", "0.{}2", "1.{}1", "1.{}2"):
        conv, normed = (f"resblocks.{name.format(part)}" for part in ("conv", "bn"))
        layer(conv, (8, 8, 3, 3), normed, 8)
    layer("pred.conv2d", (1, 1, 1, 1), "pred.norm_layer", 1)
    return {prefix + name: np.ones(shape, np.float32) for name, shape in shapes.items()}


@pytest.fixture
def loaded(monkeypatch):
    """Loads a state dict, wherever it comes from."""

    def from_tensors(tensors):
        monkeypatch.setattr(e2vid, "read_state_dict", lambda path: dict(tensors))
        return load("model.pth")

    return from_tensors


@DECODERS
@NORMS
@pytest.mark.parametrize("prefix", ["unetrecurrent.", "module.unetrecurrent.", ""])
def test_names(loaded, transposed, norm, prefix):
    params, settings = loaded(state_dict(transposed, norm, prefix))
    assert settings == Settings(transposed, channels=1)
    expected = jax.eval_shape(partial(initial_params, settings=settings), jax.random.key(0))
    shapes = jax.tree.map(lambda leaf: (leaf.shape, np.dtype(np.float32)), expected)
    assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), params) == shapes


def test_normalisation_is_folded(loaded):
    tensors = state_dict()
    tensors["unetrecurrent.pred.norm_layer.running_var"][:] = 4 - 1e-5
    tensors["unetrecurrent.pred.norm_layer.running_mean"][:] = 10
    prediction = loaded(tensors)[0]["prediction"]
    assert prediction["kernel"][0, 0, 0, 0] == pytest.approx(0.5)
    assert prediction["bias"][0] == pytest.approx(1 - 10 * 0.5)


def changed(name, value, **kinds):
    tensors = state_dict(**kinds)
    tensors["unetrecurrent." + name] = value
    return tensors


def without(name, **kinds):
    tensors = state_dict(**kinds)
    del tensors["unetrecurrent." + name]
    return tensors


@pytest.mark.parametrize(
    ("tensors", "message"),
    [
        ({"head.conv2d.weight": np.ones(3, np.float32)}, "expected encoders.0.conv.conv2d.weight"),
        (state_dict() | state_dict(prefix="ema."), "several networks .'unetrecurrent.', 'ema.'"),
        (
            changed("encoders.0.conv.conv2d.weight", np.ones(3, np.float32)),
            r"head.conv2d.weight' should be floats \(32, 5, 5, 5\) and is float32 \(1, 5, 5, 5\)",
        ),
        (
            changed("pred.conv2d.weight", np.ones((1, 2, 1, 1), np.float32)),  # a skip by concat
            r"'unetrecurrent.pred.conv2d.weight' should be floats \(1, 1, 1, 1\) and is float32 "
            r"\(1, 2, 1, 1\)",
        ),
        (
            changed("head.conv2d.bias", np.ones(1, np.int64)),
            r"head.conv2d.bias' should be floats \(1,\) and is int64 \(1,\)",
        ),
        (
            without("encoders.1.recurrent_block.Gates.weight"),  # a ConvGRU
            "'unetrecurrent.encoders.1.recurrent_block.Gates.weight' is missing",
        ),
        (
            without("decoders.0.transposed_conv2d.weight"),
            "'unetrecurrent.decoders.0.conv2d.weight' is missing",
        ),
        (without("pred.norm_layer.weight"), "'unetrecurrent.pred.norm_layer.weight' is missing"),
        (without("pred.conv2d.bias", norm=False), "'unetrecurrent.pred.conv2d.bias' is missing"),
        (
            changed("encoders.3.conv.conv2d.weight", np.ones((16, 8, 5, 5), np.float32)),
            "E2VID has no place for 'unetrecurrent.encoders.3.conv.conv2d.weight'",
        ),
        (
            changed("head.conv2d.bias", np.full(1, np.nan, np.float32)),
            "'unetrecurrent.head.conv2d.bias' has values that are not finite",
        ),
        (changed("head.conv2d.bias", np.full(1, 1e300)), "head.conv2d.bias' has .* not finite"),
        (
            changed("pred.norm_layer.running_var", np.full(1, -1, np.float32)),
            "'unetrecurrent.pred.conv2d' or .* not finite",
        ),
    ],
)
def test_other_networks(loaded, tensors, message):
    with pytest.raises(CheckpointError, match=f"model.pth holds .*{message}") as caught:
        loaded(tensors)
    assert "; " in str(caught.value) and "\n" not in str(caught.value)


def test_what_stands_beside_the_network_is_left_out(loaded):
    loaded(state_dict() | {"loss.vgg.weight": np.zeros(3, np.float32)})


def test_missing_and_damaged_files(tmp_path):
    with pytest.raises(CheckpointError, match="none.pth cannot be read"):
        load(tmp_path / "none.pth")
    (tmp_path / "model.pth").write_bytes(b"hello")
    with pytest.raises(CheckpointError, match="model.pth is not a PyTorch checkpoint"):
        load(tmp_path / "model.pth")
