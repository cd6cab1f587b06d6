"""Weights -> a file for other programs: .onnx, .stablehlo, .pth, .safetensors; or a web page."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from firenet_jax.checkpoint import BUILT_IN, load_weights
from firenet_jax.export.onnx_model import onnx_model
from firenet_jax.export.stablehlo import stablehlo
from firenet_jax.export.tensors_file import pth, safetensors
from firenet_jax.storage.files import OutputError, partial_name, writing

KINDS = ".onnx", ".stablehlo", ".pth", ".safetensors"


@dataclass(frozen=True)
class Export:
    """Write weights as a file that other programs run or load.

    .onnx is the network for onnxruntime, TensorRT, OpenVINO and browsers; .stablehlo for a process
    with jax alone; .pth for rpg_e2vid, EVREAL and other programs in PyTorch; .safetensors the same
    tensors, which many libraries read. onnx, safetensors and flatbuffers are the extra `export`.

    Examples:
      firenet export -o firenet.onnx --picture
      firenet export run -o model.pth
    """

    weights: tyro.conf.Positional[Path] = Path(BUILT_IN)
    """A training run, .npz or published checkpoint; the built-in weights if not given."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """A name that ends in .onnx, .stablehlo, .pth or .safetensors."""
    normalise: bool = True
    """.onnx and .stablehlo: normalise event tensors inside, if the weights ask for it."""
    picture: bool = False
    """.onnx and .stablehlo: give the sharpened 8-bit picture too."""
    overwrite: bool = False
    """Replace an output that exists."""


def run(settings: Export) -> None:
    path = settings.output
    if path is None:
        raise OutputError("nothing to write: pass -o and a name such as model.onnx")
    if path.suffix not in KINDS:
        raise OutputError(f"{path}: cannot write {path.suffix or 'such'} files; try {KINDS}")
    runs = path.suffix in (".onnx", ".stablehlo")
    if not runs and (settings.picture or not settings.normalise):
        raise OutputError(
            f"{path} holds weights alone: --picture and --no-normalise are for .onnx and .stablehlo"
        )
    if path.exists() and not settings.overwrite:
        raise OutputError(f"{path} exists; choose another name or pass --overwrite")
    weights = load_weights(settings.weights)
    inside = {"normalise": settings.normalise, "picture": settings.picture}
    content = {
        ".onnx": lambda: onnx_model(weights, **inside).SerializeToString(),
        ".stablehlo": lambda: stablehlo(weights, **inside),
        ".pth": lambda: pth(weights),
        ".safetensors": lambda: safetensors(weights),
    }[path.suffix]()
    beside = partial_name(path)
    with writing(path):
        beside.write_bytes(content)
        beside.replace(path)
    normalised = weights.normalise and not (runs and settings.normalise)
    tensors = "normalised" if normalised else "raw"
    print(f"{path}: {len(content) / 1000:.0f} kB, for {tensors} event tensors")
