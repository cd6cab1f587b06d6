"""Weights <-> disk: one small .npz; published PyTorch checkpoints -> weights, and back.

A .npz holds the parameters under flat names ("gru1/gates/kernel", float32, kernels
(rows, columns, in, out)), `normalise` (bool: the network expects normalised tensors) and
`format` (int). It is read without pickle, and every name, shape, dtype and value is checked, so
whatever loads also runs. Anything else raises CheckpointError, which names the file.
"""

import contextlib
import hashlib
import importlib.resources
import os
import zipfile
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from firenet_jax.errors import CheckpointError
from firenet_jax.events import BINS
from firenet_jax.network import CHANNELS, Weights
from firenet_jax.storage.files import check_readable, check_unpacking
from firenet_jax.storage.pytorch_file import identify, read_state_dict, refuse_unused, take

FORMAT = 1
MAX_BYTES = 2**20  # six times a FireNet's: a larger file is something else and is not read
PYTORCH = (".pth", ".pt", ".tar", ".ckpt")
BUILT_IN = "built-in"
TRY = "pass a .npz written by this program or a FireNet or FireNet+ checkpoint of PyTorch (.pth)"

# layer -> (kernel size, inputs, outputs), in the order of the network
LAYERS = {
    "head": (3, BINS, CHANNELS),
    "gru1/gates": (3, 2 * CHANNELS, 2 * CHANNELS),  # inputs [x, h], outputs [reset, update]
    "gru1/candidate": (3, 2 * CHANNELS, CHANNELS),
    "res1/conv1": (3, CHANNELS, CHANNELS),
    "res1/conv2": (3, CHANNELS, CHANNELS),
    "gru2/gates": (3, 2 * CHANNELS, 2 * CHANNELS),
    "gru2/candidate": (3, 2 * CHANNELS, CHANNELS),
    "res2/conv1": (3, CHANNELS, CHANNELS),
    "res2/conv2": (3, CHANNELS, CHANNELS),
    "prediction": (1, CHANNELS, 1),
}
SHAPES: dict[str, tuple[int, ...]] = {}
for _layer, (_size, _inputs, _outputs) in LAYERS.items():
    SHAPES[f"{_layer}/kernel"] = (_size, _size, _inputs, _outputs)
    SHAPES[f"{_layer}/bias"] = (_outputs,)


# ---- npz


def digest(tree) -> str:
    """Arrays under names -> a short text that differs where any of them does."""
    found = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        found.update(jax.tree_util.keystr(path).encode() + np.asarray(leaf).tobytes())
    return found.hexdigest()[:16]


def save_weights(path: str | Path, weights: Weights) -> None:
    """Writes a temporary file and renames it, so the file is always complete.

    Raises CheckpointError if the name does not end in .npz, if the arrays are not FireNet's or not
    finite, or if the file cannot be written.
    """
    if not isinstance(weights, Weights):
        raise TypeError("save_weights takes Weights(params, normalise), not the parameters alone")
    path = Path(path)
    if path.suffix != ".npz":
        raise CheckpointError(f"{path}: weights are written as .npz; give it that ending")
    if not isinstance(weights.normalise, bool | np.bool_):
        raise CheckpointError(
            f"{path} cannot be written: normalise is {weights.normalise!r}, not True or False"
        )
    try:
        flat: dict[str, Any] = _flatten(weights.params)
    except (AssertionError, TypeError, AttributeError) as error:
        raise CheckpointError(
            f"{path} cannot be written: the parameters are no dict under names; pass those that "
            "initial_params or load_weights gives"
        ) from error
    _check(path, flat, "cannot be written")
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with open(part, "wb") as file:
            np.savez(file, format=np.int64(FORMAT), normalise=np.bool_(weights.normalise), **flat)
        part.replace(path)
    except OSError as error:
        raise CheckpointError(
            f"{path} cannot be written ({error.strerror or error}); "
            "check that its folder exists, is writable and has space"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink()  # exists only if writing failed


def _of_a_run(folder: Path) -> Path:
    """Its best weights, or, if it was interrupted before its first validation, the last ones."""
    for name in ("weights.npz", "last.npz"):
        if (folder / name).is_file():
            return folder / name
    if (folder / "log.jsonl").is_file():
        raise CheckpointError(
            f"{folder} has no weights yet: the run writes them at its first validation "
            "(--validate-every) or when it is stopped by Ctrl-C; let it go on"
        )
    raise CheckpointError(f"{folder} is a folder, but not of a training run; {TRY}")


def load_weights(path: str | Path | None = None) -> Weights:
    """Weights from a .npz, a PyTorch checkpoint or the folder of a training run.

    None or "built-in": the weights in the package.
    Raises CheckpointError for a file that is missing, damaged or of another network.
    """
    if path is None or str(path) == BUILT_IN:  # docs/model_card.md says how they were trained
        file = importlib.resources.files("firenet_jax") / "weights" / "firenet.npz"
        with importlib.resources.as_file(file) as built_in:
            return _load_npz(built_in)
    path = Path(path)
    if path.is_dir():
        path = _of_a_run(path)
    if not path.is_file():
        raise CheckpointError(f"{path} does not exist or is not a file; {TRY}")
    check_readable(path, CheckpointError)
    if path.suffix in PYTORCH:
        return convert(path)
    if path.suffix == ".npz":
        return _load_npz(path)
    raise CheckpointError(f"{path} has an unknown ending {path.suffix!r}; {TRY}")


def _load_npz(path: Path) -> Weights:
    try:
        # A damaged or hostile file may claim any size: check the archive before reading it.
        size = path.stat().st_size
        if size <= 2 * MAX_BYTES:  # with its directory, which is read whole
            with zipfile.ZipFile(path) as archive:
                check_unpacking(path, archive, CheckpointError)
                size = sum(info.file_size for info in archive.infolist())
        if size > MAX_BYTES:
            raise CheckpointError(f"{path} holds {size} bytes and is not a FireNet (157 kB); {TRY}")
        with np.load(path, allow_pickle=False) as file:
            flat = {name: file[name] for name in file.files}
        if not all(isinstance(value, np.ndarray) for value in flat.values()):
            raise ValueError("a member is not an array")
    except CheckpointError:
        raise
    except Exception as error:  # damage raises many kinds: Value, Key, BadZip, zlib, Memory
        reason = " ".join(str(error).split())[:100]  # numpy's messages span lines
        raise CheckpointError(
            f"{path} is not a whole .npz of weights ({type(error).__name__}: {reason}); {TRY}"
        ) from error
    version = flat.pop("format", None)
    normalise = flat.pop("normalise", None)
    if version is None or version.shape != () or version.dtype.kind != "i":
        raise CheckpointError(f"{path} has no format number, so it holds no weights; {TRY}")
    if version != FORMAT:
        raise CheckpointError(
            f"{path} is of format {version}, this program reads format {FORMAT}; "
            "install the version that wrote it"
        )
    if normalise is None or normalise.shape != () or normalise.dtype != bool:
        raise CheckpointError(f"{path} does not say whether tensors are normalised; {TRY}")
    _check(path, flat, "holds no FireNet")
    return Weights(params=unflatten_dict(flat, sep="/"), normalise=bool(normalise))


def _check(path: Path, flat: dict[str, np.ndarray], problem: str) -> None:
    """Raises CheckpointError unless every name, shape, dtype and value is right."""
    for name, shape in SHAPES.items():
        if name not in flat:
            raise CheckpointError(f"{path} {problem}: {name} is missing; {TRY}")
        found = flat[name]
        if found.shape != shape or found.dtype != np.float32:
            raise CheckpointError(
                f"{path} {problem}: {name} should be float32 {shape} and is "
                f"{found.dtype} {found.shape}; {TRY}"
            )
        if not np.isfinite(found).all():
            raise CheckpointError(
                f"{path} {problem}: {name} has values that are not finite; "
                "go back to weights from before training diverged"
            )
    for name in flat:
        if name not in SHAPES:
            raise CheckpointError(f"{path} {problem}: it has no place for {name!a}; {TRY}")


def _flatten(tree) -> dict[str, np.ndarray]:
    """{"gru1": {"gates": {"bias": b}}} -> {"gru1/gates/bias": b}"""
    return {name: np.asarray(value) for name, value in flatten_dict(tree, sep="/").items()}


# ---- PyTorch


# How each family of PyTorch checkpoints names the blocks of the network. FireNet's alone expects
# normalised tensors.
FAMILIES = {
    "FireNet": {
        "head": "head.conv.conv2d",
        "gru1": "head.recurrent_block",
        "res1": "resblocks.0.conv",
        "gru2": "resblocks.0.recurrent_block",  # its GRU comes after its convolutions
        "res2": "resblocks.1",
        "prediction": "pred.conv2d",
    },
    "FireNet+": {
        "head": "head.conv2d",
        "gru1": "G1",
        "res1": "R1",
        "gru2": "G2",
        "res2": "R2",
        "prediction": "pred.conv2d",
    },
}
PARTS = {
    "gates": [".reset_gate", ".update_gate"],
    "candidate": [".out_gate"],
    "conv1": [".conv1"],
    "conv2": [".conv2"],
    "": [""],
}


def convert(path: str | Path) -> Weights:
    """PyTorch checkpoint of FireNet or FireNet+ -> Weights: OIHW -> HWIO, two gates -> one."""
    path = Path(path)
    tensors = read_state_dict(path)
    firsts = {family: f"{blocks['head']}.weight" for family, blocks in FAMILIES.items()}
    family, prefix = identify(tensors, firsts, path, "FireNet", TRY)
    ours = partial(take, tensors, prefix, path, "FireNet", TRY)

    flat = {}
    for layer, (size, inputs, outputs) in LAYERS.items():
        block, _, part = layer.partition("/")
        sources = [FAMILIES[family][block] + ending for ending in PARTS[part]]
        each = outputs // len(sources)
        kernels = [ours(f"{source}.weight", (each, inputs, size, size)) for source in sources]
        biases = [ours(f"{source}.bias", (each,)) for source in sources]
        flat[f"{layer}/kernel"] = np.concatenate(kernels).transpose(2, 3, 1, 0).copy()
        flat[f"{layer}/bias"] = np.concatenate(biases)

    refuse_unused(tensors, prefix, path, "FireNet", TRY)
    return Weights(params=unflatten_dict(flat, sep="/"), normalise=family == "FireNet")


def original_names(weights: Weights) -> tuple[str, dict[str, np.ndarray]]:
    """Weights -> (FireNet or FireNet+, the state dict that `convert` reads): HWIO -> OIHW.

    Raises CheckpointError if the arrays are not FireNet's or not finite.
    """
    flat = _flatten(weights.params)
    _check(Path("these weights"), flat, "cannot be written")
    family, prefix = ("FireNet", "net.") if weights.normalise else ("FireNet+", "")
    tensors = {}
    for layer in LAYERS:
        block, _, part = layer.partition("/")
        sources = [FAMILIES[family][block] + ending for ending in PARTS[part]]
        kernels = np.split(flat[f"{layer}/kernel"].transpose(3, 2, 0, 1), len(sources))
        biases = np.split(flat[f"{layer}/bias"], len(sources))
        for source, kernel, bias in zip(sources, kernels, biases, strict=True):
            tensors[f"{prefix}{source}.weight"] = np.ascontiguousarray(kernel)
            tensors[f"{prefix}{source}.bias"] = np.ascontiguousarray(bias)
    return family, tensors
