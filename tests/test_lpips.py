from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from firenet_jax.evaluation import lpips as module
from firenet_jax.evaluation.lpips import Lpips, load, lpips
from firenet_jax.storage.pytorch_file import CheckpointError

H, W = 70, 93  # SqueezeNet's first pool reaches outside in its columns, its second in its rows

# number of the convolution in torchvision's `features` -> shape there, and taps of LPIPS
ALEXNET = {
    "0": (64, 3, 11, 11),
    "3": (192, 64, 5, 5),
    "6": (384, 192, 3, 3),
    "8": (256, 384, 3, 3),
    "10": (256, 256, 3, 3),
}
SQUEEZENET = {"0": (64, 3, 3, 3)}
for index, (inputs, squeezed, expanded) in {
    3: (64, 16, 64), 4: (128, 16, 64), 6: (128, 32, 128), 7: (256, 32, 128),
    9: (256, 48, 192), 10: (384, 48, 192), 11: (384, 64, 256), 12: (512, 64, 256),
}.items():  # fmt: skip
    SQUEEZENET[f"{index}.squeeze"] = (squeezed, inputs, 1, 1)
    SQUEEZENET[f"{index}.expand1x1"] = (expanded, squeezed, 1, 1)
    SQUEEZENET[f"{index}.expand3x3"] = (expanded, squeezed, 3, 3)
CHANNELS = {
    "alex": (64, 192, 384, 256, 256),
    "squeeze": (64, 128, 256, 384, 384, 512, 512),
}
SHAPES = {"alex": ALEXNET, "squeeze": SQUEEZENET}
COUNTS = {"alex": 2_469_696, "squeeze": 722_496}  # parameters without the classifier


def backbone(network):
    """Random weights as torchvision names them: He's, so that all layers are alike in size."""
    rng = np.random.default_rng(0)
    tensors = {"classifier.1.weight": rng.normal(size=(10, 4, 1, 1)), "classifier.1.bias": [0.0]}
    for name, shape in SHAPES[network].items():
        scale = np.sqrt(2 / np.prod(shape[1:]))
        tensors[f"features.{name}.weight"] = scale * rng.normal(size=shape)
        tensors[f"features.{name}.bias"] = 0.1 * rng.normal(size=shape[0])
    return {name: np.float32(value) for name, value in tensors.items()}


def linear(network):
    """Weights that are not negative and as large as the published ones, a dozen together."""
    rng = np.random.default_rng(1)
    return {
        f"lin{k}.model.1.weight": np.float32(rng.exponential(12 / c, (1, c, 1, 1)))
        for k, c in enumerate(CHANNELS[network])
    }


def pairs():
    """Four pairs, (2, 2, H, W) each: other textures, noise, a constant, a negative."""
    rng = np.random.default_rng(2)
    truth = gaussian_filter(rng.standard_normal((2, 2, H, W)), (0, 0, 2, 2))
    truth = (truth - truth.min()) / np.ptp(truth)
    image = truth[::-1, ::-1].copy()
    image[0, 1] = truth[0, 1] + 0.05 * rng.standard_normal((H, W))
    image[1, 0] = 0.4
    image[1, 1] = 1 - truth[1, 1]
    return np.float32(image), np.float32(truth)


# with respect to the image; jitted here, so that the tests below compile it once
distance_and_gradient = jax.jit(jax.value_and_grad(lpips, 1))


@pytest.fixture
def loaded(monkeypatch):
    """The weights out of two state dicts, wherever they come from."""

    def from_tensors(ours, lins):
        files = {"net.pth": ours, "lin.pth": lins}
        monkeypatch.setattr(module, "read_state_dict", files.__getitem__)
        return load("net.pth", "lin.pth")

    return from_tensors


@pytest.fixture(scope="module", params=["alex", "squeeze"])
def network(request):
    return request.param


@pytest.fixture
def weights(loaded, network) -> Lpips:
    return loaded(backbone(network), linear(network))


# ---- a twin in PyTorch


def twin(network):
    """Modules of PyTorch with torchvision's names and our weights, and LPIPS by its formula."""
    torch = pytest.importorskip("torch", reason="compares with PyTorch, which is not installed")
    from torch import nn

    class Fire(nn.Module):
        def __init__(self, inputs, squeezed, expanded):
            super().__init__()
            self.squeeze = nn.Conv2d(inputs, squeezed, 1)
            self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
            self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

        def forward(self, x):
            x = torch.relu(self.squeeze(x))
            return torch.cat([torch.relu(self.expand1x1(x)), torch.relu(self.expand3x3(x))], 1)

    def pool():
        return nn.MaxPool2d(3, 2, ceil_mode=network == "squeeze")

    class Net(nn.Module):
        def __init__(self):
            super().__init__()
            if network == "alex":
                self.taps = 1, 4, 7, 9, 11
                self.features = nn.Sequential(
                    nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), pool(),
                    nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), pool(),
                    nn.Conv2d(192, 384, 3, padding=1), nn.ReLU(),
                    nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(),
                    nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(),
                )  # fmt: skip
            else:
                self.taps = 1, 4, 7, 9, 10, 11, 12
                self.features = nn.Sequential(
                    nn.Conv2d(3, 64, 3, 2), nn.ReLU(), pool(),
                    Fire(64, 16, 64), Fire(128, 16, 64), pool(),
                    Fire(128, 32, 128), Fire(256, 32, 128), pool(),
                    Fire(256, 48, 192), Fire(384, 48, 192), Fire(384, 64, 256), Fire(512, 64, 256),
                )  # fmt: skip
            self.classifier = nn.Sequential(nn.Dropout(), nn.Conv2d(4, 10, 1))

        def forward(self, x):
            taps = []
            for index, layer in enumerate(self.features):
                x = layer(x)
                if index in self.taps:
                    taps.append(x)
            return taps

    net = Net()
    ours = {name: torch.tensor(value) for name, value in backbone(network).items()}
    ours["classifier.1.bias"] = net.classifier[1].bias.detach()
    net.load_state_dict(ours)
    lins = {name: torch.tensor(value) for name, value in linear(network).items()}

    def unit(features):
        return features / (torch.sqrt((features**2).sum(1, keepdim=True)) + 1e-10)

    def distance(image, truth):
        """(N, H, W) twice -> (N,)"""
        shift = torch.tensor([-0.030, -0.088, -0.188])[None, :, None, None]
        scale = torch.tensor([0.458, 0.448, 0.450])[None, :, None, None]
        image, truth = (
            net((2 * torch.stack([x, x, x], 1) - 1 - shift) / scale) for x in (image, truth)
        )
        return sum(
            ((unit(a) - unit(b)) ** 2 * lin).sum(1).mean((1, 2))
            for a, b, lin in zip(image, truth, lins.values(), strict=True)
        )

    return SimpleNamespace(torch=torch, net=net, linear=lins, distance=distance)


@pytest.mark.reference
@pytest.mark.parametrize("new", [False, True], ids=["old", "new"])
def test_files_of_pytorch_and_a_twin_in_pytorch(tmp_path, network, new):
    ours = twin(network)
    net, lin = tmp_path / "net.pth", tmp_path / "lin.pth"
    ours.torch.save(ours.net.state_dict(), net, _use_new_zipfile_serialization=new)
    ours.torch.save(ours.linear, lin, _use_new_zipfile_serialization=new)
    weights = load(net, str(lin))
    image, truth = pairs()
    with ours.torch.no_grad():
        expected = ours.distance(*(ours.torch.tensor(x).reshape(4, H, W) for x in (image, truth)))
    assert expected.min() > 0.01
    actual = lpips(weights, image, truth)
    assert actual.shape == (2, 2) and actual.dtype == jnp.float32
    np.testing.assert_allclose(actual.reshape(4), expected.numpy(), atol=1e-5, rtol=1e-5)


@pytest.mark.reference
def test_gradients_equal_those_of_a_twin_in_pytorch(weights, network):
    ours = twin(network)
    image, truth = (x[0, 1] for x in pairs())
    theirs = ours.torch.tensor(image[None], requires_grad=True)
    ours.distance(theirs, ours.torch.tensor(truth[None])).sum().backward()
    _, actual = distance_and_gradient(weights, image, truth)
    expected = theirs.grad[0].numpy()
    error = np.linalg.norm(actual - expected) / np.linalg.norm(expected)
    assert error < 1e-4


@pytest.mark.reference
@pytest.mark.parametrize("size", [(31, 31), (36, 64)])
def test_pools_of_all_sizes(weights, network, size):
    ours = twin(network)
    image, truth = (x[0, 0, : size[0], : size[1]] for x in pairs())
    with ours.torch.no_grad():
        expected = ours.distance(*(ours.torch.tensor(x[None]) for x in (image, truth)))
    np.testing.assert_allclose(lpips(weights, image, truth), expected[0], atol=1e-5, rtol=1e-5)


# ---- without PyTorch


def test_equal_images_have_no_distance(weights):
    _, truth = pairs()
    np.testing.assert_allclose(lpips(weights, truth, truth), 0, atol=1e-12)


def test_a_batch_is_its_images_one_by_one_and_symmetric(weights):
    image, truth = pairs()
    together = lpips(weights, image, truth)
    np.testing.assert_allclose(lpips(weights, truth, image), together, rtol=1e-5)
    alone = lpips(weights, image[0, 1], truth[0, 1])
    assert alone.shape == ()
    np.testing.assert_allclose(alone, together[0, 1], rtol=1e-5)


def test_gradients_are_finite_where_all_features_are_zero(weights):
    zero = jax.tree.map(jnp.zeros_like, weights.convolutions)
    image, truth = (x[0, 0] for x in pairs())
    for convolutions in (weights.convolutions, zero):
        for pair in ((image, truth), (truth, truth), (0 * truth, truth), (truth, 0 * truth)):
            distance, gradient = distance_and_gradient(Lpips(convolutions, weights.linear), *pair)
            assert np.isfinite(distance) and np.isfinite(gradient).all()
    assert distance == 0 and not gradient.any()


def test_other_images_and_weights_do_not_recompile(weights):
    image, truth = pairs()
    lpips(weights, image, truth)
    before = lpips._cache_size()
    lpips(jax.tree.map(lambda leaf: 2 * leaf, weights), truth, image)
    assert lpips._cache_size() == before


def test_the_classifier_is_left_out(weights, network):
    count = sum(leaf.size for leaf in jax.tree.leaves(weights.convolutions))
    assert count == COUNTS[network]
    assert [len(leaf) for leaf in weights.linear] == list(CHANNELS[network])


@pytest.mark.parametrize("dtype", [np.float16, np.float64])
def test_other_floats(loaded, dtype):
    tensors = {name: value.astype(dtype) for name, value in backbone("squeeze").items()}
    weights = loaded(tensors, linear("squeeze"))
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(weights))


def test_a_prefix_of_all_names(loaded):
    tensors = {f"module.{name}": value for name, value in backbone("alex").items()}
    kernel, _ = loaded(tensors, linear("alex")).convolutions["features.3"]
    assert kernel.shape == (5, 5, 64, 192)


VGG = {
    "features.0.weight": np.zeros((64, 3, 3, 3), np.float32),
    "features.2.weight": np.zeros((64, 64, 3, 3), np.float32),
}


def changed(network, name, value):
    return backbone(network) | {name: value}


@pytest.mark.parametrize(
    ("tensors", "lins", "message"),
    [
        (
            VGG,
            linear("alex"),
            r"net.pth holds no network of LPIPS: expected features.3.weight \(AlexNet\) or .* "
            "found 2 other names, the first 'features.0.weight'; pass torchvision's AlexNet",
        ),
        (
            changed("squeeze", "features.0.weight", np.zeros((96, 3, 7, 7), np.float32)),
            linear("squeeze"),
            r"net.pth holds no SqueezeNet 1.1: 'features.0.weight' should be floats "
            r"\(64, 3, 3, 3\) and is float32 \(96, 3, 7, 7\); pass torchvision's",
        ),
        (
            {k: v for k, v in backbone("alex").items() if k != "features.8.bias"},
            linear("alex"),
            "net.pth holds no AlexNet: 'features.8.bias' is missing; pass torchvision's",
        ),
        (
            changed("alex", "features.8.bias", np.zeros(256, np.int64)),
            linear("alex"),
            r"'features.8.bias' should be floats \(256,\) and is int64 \(256,\)",
        ),
        (
            changed("alex", "features.8.bias", np.full(256, 1e300)),
            linear("alex"),
            "'features.8.bias' has values that are not finite",
        ),
        (
            backbone("alex"),
            linear("squeeze"),
            r"lin.pth holds no linear layers of LPIPS for AlexNet: 'lin1.model.1.weight' should be "
            r"floats \(1, 192, 1, 1\) and is float32 \(1, 128, 1, 1\); pass "
            "lpips/weights/v0.1/alex.pth of the lpips package",
        ),
        (
            backbone("squeeze"),
            backbone("squeeze"),
            "lin.pth .* for SqueezeNet 1.1: 'lin0.model.1.weight' is missing; .*squeeze.pth",
        ),
    ],
)
def test_files_that_do_not_fit(loaded, tensors, lins, message):
    with pytest.raises(CheckpointError, match=message) as caught:
        loaded(tensors, lins)
    assert "\n" not in str(caught.value)


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(ValueError, match="none.pth cannot be read"):
        load(tmp_path / "none.pth", tmp_path / "none.pth")


def test_wrong_sizes_are_refused(weights):
    with pytest.raises(ValueError, match="cannot be compared"):
        lpips(weights, np.zeros((40, 50)), np.zeros((2, 40, 50)))
    with pytest.raises(ValueError, match=r"LPIPS needs 31x31 pixels at least, not \(30, 50\)"):
        lpips(weights, np.zeros((30, 50)), np.zeros((30, 50)))
