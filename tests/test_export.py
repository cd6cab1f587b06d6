"""What is exported computes, in programs of others, what it computes here."""

import subprocess
import sys

import jax
import numpy as np
import pytest
from test_cli import firenet

import firenet_jax as fj
from firenet_jax.checkpoint import convert, load_weights, save_weights
from firenet_jax.export.onnx_model import onnx_model
from firenet_jax.export.stablehlo import stablehlo
from firenet_jax.export.weights_file import pth, safetensors
from firenet_jax.network import Weights, initial_state
from firenet_jax.pictures import Display
from firenet_jax.storage.pytorch_save import pytorch_file

SIZES = [(1, 45, 60), (3, 31, 23), (2, 7, 100)]  # batch, height, width; none is in any file


def sparse_tensors(steps, batch, height, width):
    """Like event tensors: most entries are zero; of one window all are."""
    numbers = np.random.default_rng(batch).normal(size=(steps, batch, height, width, 5))
    numbers[np.random.default_rng(1).random(numbers.shape) < 0.8] = 0
    numbers[steps // 2] = 0
    return numbers.astype(np.float32)


def random_params(seed=0):
    """Parameters with biases, drawn by numpy: nothing is compiled for it."""
    numbers = np.random.default_rng(seed)
    tree = load_weights().params
    return jax.tree.map(
        lambda leaf: (leaf + 0.05 * numbers.normal(size=leaf.shape)).astype(np.float32), tree
    )


def ours(weights, tensors):
    """(State, images), by XLA alone: what is compared is the file, not two ways of ours."""
    state = initial_state(*tensors.shape[1:4])
    return fj.reconstruct(weights, state, tensors, machine_code=False)


def first(array):
    """Channels last -> channels first."""
    return np.moveaxis(np.asarray(array), -1, -3)


# ---- ONNX


def run_onnx(model, tensors):
    """Model, (T, B, H, W, 5) -> outputs of each step by name, the last state."""
    runtime = pytest.importorskip("onnxruntime", reason="runs what was written")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1
    session = runtime.InferenceSession(
        model.SerializeToString(), options, providers=["CPUExecutionProvider"]
    )
    names = [output.name for output in session.get_outputs()]
    _, batch, height, width, _ = tensors.shape
    state = {name: np.zeros((batch, 16, height, width), np.float32) for name in ("g1", "g2")}
    steps = []
    for tensor in tensors:
        found = session.run(None, {"events": np.ascontiguousarray(first(tensor)), **state})
        steps.append(dict(zip(names, found, strict=True)))
        state = {name: steps[-1][f"{name}_next"] for name in state}
    return {name: np.stack([step[name] for step in steps]) for name in names}, state


@pytest.mark.parametrize("size", SIZES)
def test_onnx_equals_jax_over_50_steps(size):
    pytest.importorskip("onnx")
    weights, tensors = load_weights(), sparse_tensors(50, *size)
    model = onnx_model(weights, picture=True)
    found, last = run_onnx(model, tensors)
    state, images = ours(weights, tensors)
    np.testing.assert_allclose(found["image"][:, :, 0], images, atol=1e-5, rtol=0)
    for name, expected in state._asdict().items():
        np.testing.assert_allclose(last[name], first(expected), atol=1e-5, rtol=0)
    fixed = Display(range="fixed")
    _, pictures = fj.display(fj.initial_display_state(size[0]), images, settings=fixed)
    levels = found["picture"][:, :, 0].astype(int) - np.asarray(pictures, int)
    assert np.abs(levels).max() <= 1 and (levels != 0).mean() < 1e-3
    assert np.ptp(np.asarray(pictures)) > 80


def test_onnx_without_normalisation_takes_any_weights():
    pytest.importorskip("onnx")
    params, tensors = random_params(), sparse_tensors(5, 2, 9, 12)
    _, images = ours(Weights(params, False), tensors)
    for normalise in (False, True):
        model = onnx_model(Weights(params, normalise), normalise=False)
        assert len(model.graph.node) == 35 and model.graph.input[0].name == "events"
        found, _ = run_onnx(model, tensors)
        np.testing.assert_allclose(found["image"][:, :, 0], images, atol=1e-5, rtol=0)
        properties = {item.key: item.value for item in model.metadata_props}
        assert properties["events"] == ("normalised" if normalise else "raw")


# ---- StableHLO

WITHOUT_PACKAGE = """
import sys
import jax, numpy as np
step = jax.jit(jax.export.deserialize(open(sys.argv[1], "rb").read()).call)
data = np.load(sys.argv[2])
results = {}
for name in data.files:
    tensors = data[name]
    g1 = g2 = np.zeros((*tensors.shape[1:4], 16), np.float32)
    images = []
    for tensor in tensors:
        image, g1, g2, picture = step(tensor, g1, g2)
        images.append(image)
    results |= {name: np.stack(images), name + "g1": g1, name + "g2": g2, name + "picture": picture}
np.savez(sys.argv[3], **results)
assert not [name for name in sys.modules if name.startswith(("firenet_jax", "flax"))]
"""


@pytest.mark.slow
@pytest.mark.optimised
def test_stablehlo_runs_where_the_package_is_not_imported(tmp_path):
    pytest.importorskip("flatbuffers")
    weights = load_weights()
    tensors = {str(n): sparse_tensors(20, *size) for n, size in enumerate(SIZES[1:])}
    (tmp_path / "model.stablehlo").write_bytes(stablehlo(weights, picture=True))
    np.savez(tmp_path / "in.npz", **tensors)
    names = [str(tmp_path / name) for name in ("model.stablehlo", "in.npz", "out.npz")]
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_PACKAGE, *names], capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stderr[-2000:]
    found = np.load(tmp_path / "out.npz")
    for name, these in tensors.items():
        state, images = ours(weights, these)
        np.testing.assert_allclose(found[name], images, atol=1e-6, rtol=0)
        np.testing.assert_allclose(found[f"{name}g1"], state.g1, atol=1e-6, rtol=0)
        np.testing.assert_allclose(found[f"{name}g2"], state.g2, atol=1e-6, rtol=0)
        _, pictures = fj.display(None, images, settings=Display(range="fixed"))
        assert np.abs(found[f"{name}picture"].astype(int) - pictures[-1]).max() <= 1


# ---- PyTorch


def twin(torch, legacy):
    """The network under the original names: FireNet's (legacy) or FireNet+'s."""
    nn = torch.nn

    class Layer(nn.Module):
        def __init__(self, inputs, outputs, size=3):
            super().__init__()
            self.conv2d = nn.Conv2d(inputs, outputs, size, padding=size // 2)

        def forward(self, x):
            return self.conv2d(x)

    class GRU(nn.Module):
        def __init__(self):
            super().__init__()
            for name in ("reset_gate", "update_gate", "out_gate"):
                setattr(self, name, nn.Conv2d(32, 16, 3, padding=1))

        def forward(self, x, h):
            both = torch.cat([x, h], 1)
            z, r = torch.sigmoid(self.update_gate(both)), torch.sigmoid(self.reset_gate(both))
            return h * (1 - z) + torch.tanh(self.out_gate(torch.cat([x, h * r], 1))) * z

    class Residual(nn.Module):
        def __init__(self):
            super().__init__()
            self.conv1, self.conv2 = (nn.Conv2d(16, 16, 3, padding=1) for _ in range(2))

        def forward(self, x):
            return torch.relu(x + self.conv2(torch.relu(self.conv1(x))))

    class Recurrent(nn.Module):
        def __init__(self, conv):
            super().__init__()
            self.conv, self.recurrent_block = conv, GRU()

    class Legacy(nn.Module):
        def __init__(self):
            super().__init__()
            self.net = nn.Module()
            self.net.head = Recurrent(Layer(5, 16))
            self.net.resblocks = nn.ModuleList([Recurrent(Residual()), Residual()])
            self.net.pred = Layer(16, 1, 1)

        def forward(self, x, g1, g2):
            net, (r1, r2) = self.net, self.net.resblocks
            g1 = net.head.recurrent_block(torch.relu(net.head.conv(x)), g1)
            g2 = r1.recurrent_block(r1.conv(g1), g2)
            return net.pred(r2(g2)), g1, g2

    class Plus(nn.Module):
        def __init__(self):
            super().__init__()
            self.head, self.pred = Layer(5, 16), Layer(16, 1, 1)
            self.G1, self.G2, self.R1, self.R2 = GRU(), GRU(), Residual(), Residual()

        def forward(self, x, g1, g2):
            g1 = self.G1(torch.relu(self.head(x)), g1)
            g2 = self.G2(self.R1(g1), g2)
            return self.pred(self.R2(g2)), g1, g2

    return Legacy() if legacy else Plus()


@pytest.mark.reference
@pytest.mark.parametrize("kind", ["pth", "safetensors"])
@pytest.mark.parametrize("normalise", [True, False])
def test_a_pytorch_twin_of_the_original_names_loads_it(tmp_path, normalise, kind):
    torch = pytest.importorskip("torch", reason="compares with PyTorch, which is not installed")
    params, tensors = random_params(), sparse_tensors(20, 2, 17, 22)
    weights, path = Weights(params, normalise), tmp_path / f"model.{kind}"
    if kind == "pth":
        path.write_bytes(pth(weights))
        checkpoint = torch.load(path, weights_only=True)
        assert checkpoint["arch"] == "FireNet"
        state_dict = checkpoint["state_dict"]
    else:
        path.write_bytes(safetensors(weights))
        state_dict = pytest.importorskip("safetensors.torch").load_file(path)
    network = twin(torch, legacy=normalise)
    network.load_state_dict(state_dict, strict=True)
    _, expected = ours(Weights(params, False), tensors)
    g1 = g2 = torch.zeros(2, 16, 17, 22)
    with torch.no_grad():
        for tensor, image in zip(tensors, expected, strict=True):
            found, g1, g2 = network(torch.tensor(first(tensor).copy()), g1, g2)
            np.testing.assert_allclose(found[:, 0], image, atol=1e-5, rtol=0)


@pytest.mark.parametrize("normalise", [True, False])
def test_convert_reads_back_what_was_exported(tmp_path, normalise):
    params = random_params(5)
    (tmp_path / "model.pth").write_bytes(pth(Weights(params, normalise)))
    back = convert(tmp_path / "model.pth")
    assert back.normalise == normalise
    jax.tree.map(np.testing.assert_array_equal, back.params, params)


def test_a_published_checkpoint_keeps_its_tensors(tmp_path, reference):
    torch = pytest.importorskip("torch", reason="reads with PyTorch, which is not installed")
    options = {"map_location": "cpu", "weights_only": False}
    published = torch.load(reference / "firenet_published.pth", **options)
    (tmp_path / "model.pth").write_bytes(pth(convert(reference / "firenet_published.pth")))
    ours = torch.load(tmp_path / "model.pth", weights_only=True)
    assert ours["state_dict"].keys() == published["state_dict"].keys()
    assert all(torch.equal(ours["state_dict"][k], v) for k, v in published["state_dict"].items())
    assert ours["config"]["model"] == published["config"]["model"]
    assert ours["arch"] == published["arch"]


def test_pytorch_reads_all_that_a_file_of_ours_may_hold(tmp_path):
    torch = pytest.importorskip("torch", reason="reads with PyTorch, which is not installed")
    content = {
        "none": None, "yes": True, "no": False, "n": -7, "x": 0.1, "text": "grün",
        "ends": [2**31 - 1, -(2**31)], "long": [2**31, -(2**31) - 1, 2**63, -(2**70)],
        "list": [1, "b", []], "tuple": (1, (2,)), "dict": {"a": {}},
        "scalar": np.float32(3) + np.zeros((), np.float32), "empty": np.zeros((0, 3), np.float32),
        "turned": np.arange(6, dtype=np.float32).reshape(2, 3).T,
    }  # fmt: skip
    content["scalar"] = np.asarray(content["scalar"])
    (tmp_path / "a.pth").write_bytes(pytorch_file(content))
    found = torch.load(tmp_path / "a.pth", weights_only=True)
    assert list(found) == list(content)
    for name, value in content.items():
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(found[name].numpy(), value)
        else:
            assert found[name] == value
    with pytest.raises(TypeError, match="no place for ndarray"):
        pytorch_file({"a": np.zeros(3)})


# ---- the command


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_weights("weights.npz", Weights(random_params(), True))
    return tmp_path


@pytest.mark.parametrize("kind", ["onnx", "stablehlo", "pth", "safetensors"])
def test_export_writes_each_kind(here, capsys, kind):
    code, said, error = firenet(capsys, f"export weights.npz -o model.{kind}")
    assert code == 0, error
    assert 100_000 < (here / f"model.{kind}").stat().st_size < 200_000
    assert f"model.{kind}: 1" in said and not list(here.glob("*partial*"))
    assert ("raw" in said) == (kind in ("onnx", "stablehlo"))
    written = (here / f"model.{kind}").read_bytes()
    code, _, error = firenet(capsys, f"export weights.npz -o model.{kind}")
    assert code == 1 and "exists" in error
    assert firenet(capsys, f"export weights.npz -o model.{kind} --overwrite")[0] == 0
    if kind in ("onnx", "pth"):  # the others' libraries order what they write as it comes
        assert (here / f"model.{kind}").read_bytes() == written


def test_what_a_link_points_to_is_replaced(here, capsys):
    (here / "real.pth").write_text("former")
    (here / "link.pth").symlink_to("real.pth")
    assert firenet(capsys, "export weights.npz -o link.pth --overwrite")[0] == 0
    assert (here / "link.pth").is_symlink() and (here / "real.pth").stat().st_size > 100_000


def test_a_folder_is_not_replaced(here, capsys):
    (here / "model.pth").mkdir()
    code, _, error = firenet(capsys, "export weights.npz -o model.pth --overwrite")
    assert code == 1 and "model.pth is a folder: choose another name" in error
    assert {path.name for path in here.iterdir()} == {"weights.npz", "model.pth"}


@pytest.mark.parametrize(
    "line, said",
    [
        ("export", "nothing to write"),
        ("export -o model.tflite", "cannot write .tflite files"),
        ("export -o model", "cannot write such files"),
        ("export -o model.pth --picture", "weights alone"),
        ("export -o model.safetensors --no-normalise", "weights alone"),
        ("export missing.npz -o model.onnx", "missing.npz"),
        ("export -o nowhere/model.onnx", "cannot write"),
        ("export -o model.partial.onnx", ".partial names what is not finished"),
    ],
)
def test_what_cannot_be_is_one_sentence(here, capsys, line, said):
    code, _, error = firenet(capsys, line)
    assert code == 1 and said in error and error.count("\n") == 1
    assert [path.name for path in here.iterdir()] == ["weights.npz"]


@pytest.mark.parametrize(
    "kind, library",
    [("onnx", "onnx"), ("safetensors", "safetensors.numpy"), ("stablehlo", "flatbuffers")],
)
def test_a_library_that_is_missing_is_named(here, capsys, monkeypatch, kind, library):
    monkeypatch.setitem(sys.modules, library, None)
    code, _, error = firenet(capsys, f"export -o model.{kind}")
    assert code == 1 and error.count("\n") == 1
    assert (
        f"the library {library.partition('.')[0]}, " in error and 'pip install ".[export]"' in error
    )
