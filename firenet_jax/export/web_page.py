"""Weights, a sample -> a folder that is a web page: a recording dropped onto it becomes video.

    index.html, *.js   copies of `page/`: readers, windows and voxels in browsers
    firenet.onnx       the network, with normalisation and 8-bit pictures
    sample.npz         what plays first: t, x, y, p, width, height
    ort/               onnxruntime-web, copied from its folder

Any server of static files shows it; nothing leaves the machine that looks at it.
"""

import contextlib
import importlib.resources
import json
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from firenet_jax.errors import OutputError
from firenet_jax.events import Events
from firenet_jax.export.onnx_model import onnx_model
from firenet_jax.network import Weights
from firenet_jax.storage.files import writing

RUNTIME = "onnxruntime-web"
# Both ways to run: on a GPU, and where there is none.
FILES = [
    "ort.webgpu.min.mjs",
    "ort-wasm-simd-threaded.asyncify.mjs",
    "ort-wasm-simd-threaded.asyncify.wasm",
    "ort.wasm.min.mjs",
    "ort-wasm-simd-threaded.mjs",
    "ort-wasm-simd-threaded.wasm",
]


def runtime_version(runtime: Path) -> str:
    """What onnxruntime-web it is. Raises OutputError where the folder does not hold one of ours."""
    try:
        version = json.loads((runtime / "package.json").read_text())["version"]
    except (OSError, ValueError, KeyError, TypeError):
        raise OutputError(
            f"{runtime} does not hold {RUNTIME}, which runs the network in browsers: get it with "
            f"npm install {RUNTIME}, and name its folder with --runtime"
        ) from None
    for name in FILES:
        if not (runtime / "dist" / name).is_file():
            raise OutputError(
                f"{runtime} is {RUNTIME} {version}, which lacks {name}: install version 1.30"
            )
    return version


def write_page(folder: Path, weights: Weights, sample: Events, height: int, width: int, runtime):
    """Writes the folder. Raises OutputError where onnx or the runtime is missing, or no room."""
    runtime_version(runtime)
    model = onnx_model(weights, picture=True).SerializeToString()
    try:
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
            # Made within it, as it may be on a disk of its own.
            with TemporaryDirectory(prefix=".partial.", dir=folder) as made:
                _write_files(Path(made), model, sample, height, width, runtime)
                for path in [path for path in Path(made).rglob("*") if path.is_file()]:
                    place = folder / path.relative_to(made)  # what else lies in the folder stays
                    place.parent.mkdir(parents=True, exist_ok=True)
                    path.replace(place)
    except BaseException:
        with contextlib.suppress(OSError):  # something lies in it
            folder.rmdir()
        raise


def _write_files(folder: Path, model: bytes, sample: Events, height: int, width: int, runtime):
    (folder / "ort").mkdir()
    for page in importlib.resources.files("firenet_jax.export").joinpath("page").iterdir():
        (folder / page.name).write_bytes(page.read_bytes())
    (folder / "firenet.onnx").write_bytes(model)
    columns: dict[str, Any] = {"t": sample.t, "x": sample.x, "y": sample.y, "p": sample.p}
    np.savez_compressed(folder / "sample.npz", **columns, width=width, height=height)
    for name in FILES:
        shutil.copyfile(runtime / "dist" / name, folder / "ort" / name)
