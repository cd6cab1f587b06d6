import importlib.resources
import os
import zipfile
from pathlib import Path

import jax
import numpy as np
import pytest

from firenet_jax import checkpoint
from firenet_jax.checkpoint import (
    SHAPES,
    CheckpointError,
    convert,
    load_weights,
    original_names,
    save_weights,
)
from firenet_jax.commands.convert import Convert, run
from firenet_jax.errors import OutputError
from firenet_jax.export.weights_file import pth
from firenet_jax.network import Weights, initial_params, initial_state, step

# name in PyTorch -> shape there, as the two published families list them
FIRENET = {
    "net.head.conv.conv2d": (16, 5, 3, 3),
    "net.head.recurrent_block.reset_gate": (16, 32, 3, 3),
    "net.head.recurrent_block.update_gate": (16, 32, 3, 3),
    "net.head.recurrent_block.out_gate": (16, 32, 3, 3),
    "net.resblocks.0.conv.conv1": (16, 16, 3, 3),
    "net.resblocks.0.conv.conv2": (16, 16, 3, 3),
    "net.resblocks.0.recurrent_block.reset_gate": (16, 32, 3, 3),
    "net.resblocks.0.recurrent_block.update_gate": (16, 32, 3, 3),
    "net.resblocks.0.recurrent_block.out_gate": (16, 32, 3, 3),
    "net.resblocks.1.conv1": (16, 16, 3, 3),
    "net.resblocks.1.conv2": (16, 16, 3, 3),
    "net.pred.conv2d": (1, 16, 1, 1),
}
FIRENET_PLUS = {
    "head.conv2d": (16, 5, 3, 3),
    "G1.reset_gate": (16, 32, 3, 3),
    "G1.update_gate": (16, 32, 3, 3),
    "G1.out_gate": (16, 32, 3, 3),
    "R1.conv1": (16, 16, 3, 3),
    "R1.conv2": (16, 16, 3, 3),
    "G2.reset_gate": (16, 32, 3, 3),
    "G2.update_gate": (16, 32, 3, 3),
    "G2.out_gate": (16, 32, 3, 3),
    "R2.conv1": (16, 16, 3, 3),
    "R2.conv2": (16, 16, 3, 3),
    "pred.conv2d": (1, 16, 1, 1),
}
FAMILIES = {"FireNet": FIRENET, "FireNet+": FIRENET_PLUS}


def state_dict(layers: dict, prefix: str = "") -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    tensors = {}
    for name, shape in layers.items():
        tensors[f"{prefix}{name}.weight"] = rng.normal(size=shape).astype(np.float32)
        tensors[f"{prefix}{name}.bias"] = rng.normal(size=shape[0]).astype(np.float32)
    return tensors


@pytest.fixture
def converted(monkeypatch):
    """Converts a state dict, wherever it comes from."""

    def from_tensors(tensors):
        monkeypatch.setattr(checkpoint, "read_state_dict", lambda path: dict(tensors))
        return convert("model.pth")

    return from_tensors


@pytest.fixture
def weights() -> Weights:
    params = jax.tree.map(np.asarray, initial_params(jax.random.key(0)))
    return Weights(params=params, normalise=True)


def assert_equal(found: Weights, expected: Weights):
    assert found.normalise is expected.normalise
    assert jax.tree.structure(found.params) == jax.tree.structure(dict(expected.params))
    jax.tree.map(np.testing.assert_array_equal, found.params, dict(expected.params))


def test_shapes_are_those_of_the_network(weights):
    flat = checkpoint._flatten(weights.params)
    assert {name: value.shape for name, value in flat.items()} == SHAPES
    assert sum(value.size for value in flat.values()) == 37_777


# ---- npz


@pytest.mark.parametrize("normalise", [True, False])
def test_round_trip(tmp_path, weights, normalise):
    weights = Weights(params=weights.params, normalise=normalise)
    save_weights(tmp_path / "weights.npz", weights)
    for path in (tmp_path / "weights.npz", str(tmp_path / "weights.npz"), tmp_path):
        assert_equal(load_weights(path), weights)
    assert os.listdir(tmp_path) == ["weights.npz"]
    assert (tmp_path / "weights.npz").stat().st_size < 160_000


def test_saves_jax_arrays_and_the_same_bytes_every_time(tmp_path, weights):
    save_weights(tmp_path / "a.npz", weights)
    on_device = Weights(params=jax.device_put(weights.params), normalise=True)
    save_weights(tmp_path / "b.npz", on_device)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_saving_where_it_cannot(tmp_path, weights):
    with pytest.raises(CheckpointError, match="none/w.npz cannot be written .No such file"):
        save_weights(tmp_path / "none" / "w.npz", weights)
    with pytest.raises(CheckpointError, match="w.pth: weights are written as .npz"):
        save_weights(tmp_path / "w.pth", weights)
    (tmp_path / "w.npz").mkdir()
    with pytest.raises(CheckpointError, match="w.npz cannot be written"):
        save_weights(tmp_path / "w.npz", weights)
    assert os.listdir(tmp_path) == ["w.npz"]


def test_failed_save_leaves_the_old_file(tmp_path, weights, monkeypatch):
    path = tmp_path / "w.npz"
    save_weights(path, weights)
    before = path.read_bytes()

    def full(file, **arrays):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(CheckpointError, match="No space left"):
        save_weights(path, weights)
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["w.npz"]


def test_diverged_weights_are_not_saved(tmp_path, weights):
    params = weights.params | {"head": {"kernel": np.full((3, 3, 5, 16), np.nan, np.float32)}}
    with pytest.raises(CheckpointError, match="head/kernel has values that are not finite"):
        save_weights(tmp_path / "w.npz", Weights(params=params, normalise=True))
    assert not os.listdir(tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"head/bias": None}, "head/bias is missing"),
        ({"gru1/gates/kernel": np.zeros((3, 3, 32, 16), np.float32)}, r"\(3, 3, 32, 32\) and is"),
        ({"head/bias": np.zeros(16)}, r"should be float32 \(16,\) and is float64"),
        ({"head/bias": np.full(16, np.inf, np.float32)}, "not finite"),
        ({"head/bias": np.array([None] * 16)}, "not a whole .npz.*allow_pickle=False"),
        ({"encoder/bias": np.zeros(1, np.float32)}, "no place for 'encoder/bias'"),
        ({"more": np.zeros(2**20)}, "holds .* bytes and is not a FireNet"),
        ({"format": None}, "has no format number"),
        ({"format": np.array("1")}, "has no format number"),
        ({"format": np.int64(2)}, "is of format 2, this program reads format 1"),
        ({"normalise": None}, "does not say whether tensors are normalised"),
        ({"normalise": np.float32(1)}, "does not say whether tensors are normalised"),
    ],
)
def test_wrong_npz(tmp_path, weights, changes, message):
    path = tmp_path / "w.npz"
    save_weights(path, weights)
    arrays = dict(np.load(path)) | changes
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    with pytest.raises(CheckpointError, match=f"w.npz .*{message}"):
        load_weights(path)


def test_an_archive_of_very_many_members_is_not_read(tmp_path, monkeypatch):
    with zipfile.ZipFile(tmp_path / "w.npz", "w") as archive:
        for number in range(30_000):
            archive.writestr(f"{number}.npy", b"")
    monkeypatch.setattr(zipfile, "ZipFile", None)
    with pytest.raises(CheckpointError, match="holds .* bytes and is not a FireNet"):
        load_weights(tmp_path / "w.npz")


@pytest.mark.parametrize("beyond, message", [(0, "no place for 'more'"), (1, "holds 1048577 byt")])
def test_a_mebibyte_is_read_and_no_more(tmp_path, weights, beyond, message):
    path = tmp_path / "w.npz"
    save_weights(path, weights)
    with zipfile.ZipFile(path) as archive:
        size = sum(info.file_size for info in archive.infolist())
    more = np.zeros(2**20 - size - 128 + beyond, np.uint8)  # an array's own header is 128 bytes
    np.savez(path, **np.load(path), more=more)
    with pytest.raises(CheckpointError, match=message):
        load_weights(path)


def test_a_reason_is_one_short_line(tmp_path, monkeypatch):
    """numpy's messages span lines."""

    def damaged(*_, **__):
        raise ValueError("\n".join(["a long story"] * 100))

    np.savez(tmp_path / "w.npz", a=1)
    monkeypatch.setattr(np, "load", damaged)
    with pytest.raises(CheckpointError) as error:
        load_weights(tmp_path / "w.npz")
    reason = str(error.value).partition("ValueError: ")[2].partition("); pass")[0]
    assert reason == " ".join(["a long story"] * 8)[:100] and len(reason) == 100


def test_damaged_npz(tmp_path, weights):
    path = tmp_path / "w.npz"
    save_weights(path, weights)
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    flipped = [
        content[:at] + b"\xff" + content[at + 1 :] for at in rng.integers(len(content), size=40)
    ]
    cut = [content[:size] for size in (0, 1, 100, len(content) // 2, len(content) - 1)]
    for damaged in [*flipped, *cut, b"\x93NUMPY\x01\x00", b"hello"]:
        path.write_bytes(damaged)
        try:
            load_weights(path)  # a flipped bit in an archive's time stamps harms nothing
        except CheckpointError as error:
            assert "w.npz" in str(error) and "\n" not in str(error)
        else:
            assert damaged in flipped


def test_npz_member_that_is_no_array(tmp_path, weights):
    path = tmp_path / "w.npz"
    save_weights(path, weights)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("readme.txt", "hello")
    with pytest.raises(CheckpointError, match="a member is not an array"):
        load_weights(path)


@pytest.mark.parametrize("name", ["none.npz", "none.pth", "none"])
def test_missing(tmp_path, name):
    with pytest.raises(CheckpointError, match=f"{name} does not exist.*pass a .npz"):
        load_weights(tmp_path / name)


def test_folder_without_weights(tmp_path):
    with pytest.raises(CheckpointError, match="is a folder, but not of a training run; pass"):
        load_weights(tmp_path)
    (tmp_path / "settings.json").write_text("{}")  # as simulated sequences have
    with pytest.raises(CheckpointError, match="is a folder, but not of a training run; pass"):
        load_weights(tmp_path)
    (tmp_path / "log.jsonl").write_text("")
    with pytest.raises(CheckpointError, match="has no weights yet: .*--validate-every"):
        load_weights(tmp_path)


def test_unknown_ending(tmp_path):
    (tmp_path / "w.onnx").write_bytes(b"x")
    with pytest.raises(CheckpointError, match="w.onnx has an unknown ending '.onnx'; pass a .npz"):
        load_weights(tmp_path / "w.onnx")


@pytest.mark.parametrize("name", ["w.pth", "w.pt", "w.ckpt", "w.pth.tar"])
def test_pytorch_endings(tmp_path, name):
    (tmp_path / name).write_bytes(b"x")
    with pytest.raises(CheckpointError, match=f"{name} is not a PyTorch checkpoint"):
        load_weights(tmp_path / name)


def test_weights_that_come_with_the_package():
    weights = load_weights()
    assert weights.normalise
    assert sum(leaf.size for leaf in jax.tree.leaves(weights.params)) == 37_777
    file = importlib.resources.files("firenet_jax") / "weights" / "firenet.npz"
    assert len(file.read_bytes()) < 1_000_000
    jax.tree.map(np.testing.assert_array_equal, load_weights("built-in").params, weights.params)


# ---- PyTorch


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("prefix", ["", "module.", "firenetrecurrent."])
def test_names_and_axes(converted, family, prefix):
    tensors = state_dict(FAMILIES[family], prefix)
    weights = converted(tensors)
    assert weights.normalise is (family == "FireNet")
    flat = checkpoint._flatten(weights.params)
    assert {name: value.shape for name, value in flat.items()} == SHAPES
    assert all(value.dtype == np.float32 for value in flat.values())

    names = list(FAMILIES[family])  # in the order of the network
    order = ["head", "reset", "update", "out", "conv1", "conv2"]
    torch = dict(zip(order, names, strict=False))

    def weight(layer, out, into, row, column):
        return tensors[f"{prefix}{torch[layer]}.weight"][out, into, row, column]

    gru, res = weights.params["gru1"], weights.params["res1"]
    assert weights.params["head"]["kernel"][0, 2, 4, 7] == weight("head", 7, 4, 0, 2)
    assert gru["gates"]["kernel"][1, 0, 31, 5] == weight("reset", 5, 31, 1, 0)
    assert gru["gates"]["kernel"][1, 0, 31, 16 + 5] == weight("update", 5, 31, 1, 0)
    assert gru["candidate"]["kernel"][2, 1, 20, 15] == weight("out", 15, 20, 2, 1)
    assert res["conv2"]["kernel"][2, 1, 3, 15] == weight("conv2", 15, 3, 2, 1)
    assert gru["gates"]["bias"][16 + 3] == tensors[f"{prefix}{torch['update']}.bias"][3]


def test_both_families_name_the_same_network(converted):
    firenet = converted(state_dict(FIRENET))
    plus = converted(state_dict(FIRENET_PLUS))
    jax.tree.map(np.testing.assert_array_equal, firenet.params, plus.params)


@pytest.mark.parametrize("family", FAMILIES)
def test_original_names_are_read_as_the_same_weights(converted, weights, family):
    weights = Weights(params=weights.params, normalise=family == "FireNet")
    found, tensors = original_names(weights)
    assert found == family
    expected = {f"{name}.weight": shape for name, shape in FAMILIES[family].items()}
    expected |= {f"{name}.bias": shape[:1] for name, shape in FAMILIES[family].items()}
    assert {name: value.shape for name, value in tensors.items()} == expected
    assert all(value.flags.c_contiguous for value in tensors.values())
    assert_equal(converted(tensors), weights)
    broken = weights.params | {"head": {"bias": np.zeros(16, np.float32)}}
    with pytest.raises(CheckpointError, match="cannot be written: head/kernel is missing"):
        original_names(Weights(params=broken, normalise=True))


@pytest.mark.parametrize("dtype", [np.float16, np.float64])
def test_other_floats(converted, dtype):
    tensors = {name: value.astype(dtype) for name, value in state_dict(FIRENET).items()}
    assert converted(tensors).params["head"]["kernel"].dtype == np.float32


E2VID = {
    "unetrecurrent.head.conv2d": (32, 5, 5, 5),
    "unetrecurrent.encoders.0.conv.conv2d": (64, 32, 5, 5),
    "unetrecurrent.encoders.0.recurrent_block.Gates": (256, 128, 3, 3),
}


@pytest.mark.parametrize(
    ("tensors", "message"),
    [
        (
            state_dict(E2VID),
            r"'unetrecurrent.head.conv2d.weight' should be floats \(16, 5, 3, 3\) and is "
            r"float32 \(32, 5, 5, 5\)",
        ),
        ({"layer1.weight": np.zeros(3, np.float32)}, "expected head.conv.conv2d.weight .FireNet."),
        (state_dict({"head.conv2d": (16, 5, 3, 3)}), "'G1.reset_gate.weight' is missing"),
        (state_dict(FIRENET | {"net.resblocks.2.conv1": (16, 16, 3, 3)}), "no place for 'net.res"),
        (state_dict(FIRENET) | state_dict(FIRENET_PLUS, "old."), "several networks"),
        (
            state_dict(FIRENET) | {"net.pred.conv2d.bias": np.zeros(1, np.int64)},
            r"'net.pred.conv2d.bias' should be floats \(1,\) and is int64 \(1,\)",
        ),
        (
            state_dict(FIRENET) | {"net.pred.conv2d.bias": np.full(1, 1e300)},
            "'net.pred.conv2d.bias' has values that are not finite",
        ),
    ],
)
def test_other_networks(converted, tensors, message):
    with pytest.raises(CheckpointError, match=f"model.pth holds .*{message}"):
        converted(tensors)


def test_what_stands_beside_the_network_is_left_out(converted):
    tensors = state_dict(FIRENET) | {"loss.vgg.weight": np.zeros(3, np.float32)}
    assert converted(tensors).normalise


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_weights_that_python_would_unpack_whole_are_refused(tmp_path, method):
    with zipfile.ZipFile(tmp_path / "w.npz", "w", method) as archive:
        archive.writestr("format.npy", b"0" * 100)
    with pytest.raises(CheckpointError, match="compressed by another method than deflate"):
        load_weights(tmp_path / "w.npz")


@pytest.mark.reference
@pytest.mark.parametrize("new", [False, True], ids=["old", "new"])
@pytest.mark.parametrize("family", FAMILIES)
def test_files_of_pytorch(tmp_path, family, new):
    torch = pytest.importorskip("torch", reason="needs PyTorch")
    tensors = state_dict(FAMILIES[family])
    value = {"state_dict": {name: torch.tensor(value) for name, value in tensors.items()}}
    torch.save(value, tmp_path / "model.pth.tar", _use_new_zipfile_serialization=new)
    weights = load_weights(tmp_path / "model.pth.tar")
    name = "net.head.conv.conv2d" if family == "FireNet" else "head.conv2d"
    expected = tensors[f"{name}.weight"].transpose(2, 3, 1, 0)
    np.testing.assert_array_equal(weights.params["head"]["kernel"], expected)


def test_convert_command(tmp_path, converted, capsys):
    tensors = state_dict(FIRENET_PLUS)
    expected = converted(tensors)  # and from here on every checkpoint holds these tensors
    settings = Convert(tmp_path / "model.pth", tmp_path / "w.npz")
    run(settings)
    assert "37,777 parameters, for raw event tensors" in capsys.readouterr().out
    assert_equal(load_weights(tmp_path / "w.npz"), expected)
    with pytest.raises(OutputError, match="w.npz exists: choose another output"):
        run(settings)


@pytest.mark.reference
def test_published_network_computes_what_its_authors_code_computes(reference, tmp_path):
    weights = load_weights(reference / "firenet_published.pth")
    assert weights.normalise
    assert sum(value.size for value in jax.tree.leaves(weights.params)) == 37_777
    assert weights.params["prediction"]["bias"][0] == pytest.approx(0.74, abs=5e-3)
    save_weights(tmp_path / "w.npz", weights)
    assert_equal(load_weights(tmp_path / "w.npz"), weights)

    io = np.load(reference / "firenet_published_io.npz")
    state = initial_state(1, 45, 60)
    for tensor, expected in zip(io["event_tensors"], io["images"], strict=True):
        state, image = step(weights.params, state, tensor.transpose(1, 2, 0)[None])
        np.testing.assert_allclose(image, expected, atol=2e-5)


@pytest.mark.parametrize("given", ["built-in", "a run", "weights.npz"])
def test_what_is_already_converted_is_said(tmp_path, monkeypatch, given):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a run").mkdir()
    with pytest.raises(CheckpointError, match="are used as they are, and `firenet export` makes"):
        run(Convert(Path(given), tmp_path / "out.npz"))
    assert not (tmp_path / "out.npz").exists()


def test_parameters_alone_are_not_saved(tmp_path):
    with pytest.raises(TypeError, match="takes Weights"):
        save_weights(tmp_path / "a.npz", initial_params(jax.random.key(0)))


@pytest.mark.parametrize("params", [None, {1: {"bias": np.zeros(3)}}, []])
def test_what_is_no_dict_of_names_is_not_saved(tmp_path, params):
    with pytest.raises(CheckpointError, match="no dict under names"):
        save_weights(tmp_path / "a.npz", Weights(params, True))
    with pytest.raises(CheckpointError, match="normalise is 'no', not True or False"):
        save_weights(tmp_path / "a.npz", Weights(initial_params(jax.random.key(0)), "no"))
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names")
def test_convert_reads_files_and_follows_links(tmp_path):
    os.mkfifo(tmp_path / "pipe.pth")
    with pytest.raises(CheckpointError, match="is a pipe or device"):
        run(Convert(tmp_path / "pipe.pth", tmp_path / "a.npz"))
    weights = Weights(initial_params(jax.random.key(0)), True)
    (tmp_path / "a.pth").write_bytes(pth(weights))
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "w.npz").write_bytes(b"old")
    (tmp_path / "w.npz").symlink_to("there/w.npz")
    run(Convert(tmp_path / "a.pth", tmp_path / "w.npz", overwrite=True))
    assert (tmp_path / "w.npz").is_symlink()
    assert load_weights(tmp_path / "there" / "w.npz").normalise
