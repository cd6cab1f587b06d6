"""Weights -> a file for other programs: .onnx, .stablehlo, .pth, .safetensors; or a web page."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import tyro

from firenet_jax.checkpoint import BUILT_IN, load_weights
from firenet_jax.commands.demo import Demo, make_scene
from firenet_jax.errors import OutputError, RecordingError
from firenet_jax.events import Events, concatenate
from firenet_jax.export.onnx_model import onnx_model
from firenet_jax.export.stablehlo import stablehlo
from firenet_jax.export.web_page import RUNTIME, runtime_version, write_page
from firenet_jax.export.weights_file import pth, safetensors
from firenet_jax.readers import open_recording
from firenet_jax.settings import check_none_idle, parse_size
from firenet_jax.simulation.scenes import rendering_times, video
from firenet_jax.simulation.sensor import event_list
from firenet_jax.storage.files import partial_name, write_bytes
from firenet_jax.storage.video import followed

SIMULATED = 120, 160  # height, width
KINDS = ".onnx", ".stablehlo", ".pth", ".safetensors"


@dataclass(frozen=True)
class Export:
    """Write the network, or its weights, in a format that other programs read.

    A file in .onnx is the network for onnxruntime, TensorRT, OpenVINO and browsers; in .stablehlo,
    the network for jax without this package; in .pth, the weights for rpg_e2vid, EVREAL and other
    PyTorch programs; in .safetensors, the same weights for other libraries. All but .pth need the
    extra called export.

    Examples:
      firenet export -o firenet.onnx --picture
      firenet export run -o model.pth
      firenet export --web page --sample recording.zip
    """

    weights: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="[WEIGHTS]")] = Path(
        BUILT_IN
    )
    """A training run, .npz or published checkpoint; the built-in weights if not given."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """A name that ends in .onnx, .stablehlo, .pth or .safetensors."""
    normalise: bool = True
    """With --no-normalise, .onnx and .stablehlo expect event tensors that your program has
    normalised. By default they normalise them, if the weights expect it."""
    picture: bool = False
    """.onnx and .stablehlo: also output the sharpened 8-bit picture."""
    web: Path | None = None
    """Write a web page into this folder that reconstructs recordings dropped onto it."""
    runtime: Path = Path("node_modules") / RUNTIME
    """--web: folder of onnxruntime-web, as installed by `npm install onnxruntime-web`."""
    sample: Path | None = None
    """--web: recording that the page starts with (its first seconds). Default: a simulated one."""
    sensor_size: str | None = None
    """--sample: WIDTHxHEIGHT of its sensor, such as 240x180, if the recording does not state it."""
    overwrite: bool = False
    """Replace an existing output."""

    def __post_init__(self):
        if self.web is None:
            check_none_idle(self, ["runtime", "sample"], "an export without --web")
        if self.output is None:
            check_none_idle(self, ["normalise", "picture"], "an export without --output")
        if self.sample is None:
            check_none_idle(self, ["sensor_size"], "an export without --sample")
        parse_size(self.sensor_size)


SAMPLE = 500_000  # events: some seconds, one or two megabytes


def run(settings: Export) -> None:
    if settings.web is None and settings.output is None:
        raise OutputError("nothing to write: pass -o and a name such as model.onnx, or --web")
    if settings.output is not None:
        check_file(settings.output, settings)  # before the page: it is not written in vain
    if settings.web is not None:
        write_web(settings.web, settings)
    if settings.output is not None:
        write_file(settings.output, settings)


def write_web(folder: Path, settings: Export) -> None:
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder} is a file: choose another name for the folder")
    if folder.exists() and not settings.overwrite and any(folder.iterdir()):
        raise OutputError(f"{folder} exists: choose another output or pass --overwrite")
    version = runtime_version(settings.runtime)
    weights = load_weights(settings.weights)
    if settings.sample is None:
        (height, width), events = SIMULATED, simulated(*SIMULATED, seconds=2.0)
    else:
        recording = open_recording(settings.sample, parse_size(settings.sensor_size))
        (height, width), events = (recording.height, recording.width), recording.events()
    held, size = [], 0
    for chunk in events:
        held.append(chunk.select(slice(SAMPLE - size)))
        size += len(held[-1])
        if size >= SAMPLE:
            break
    if not size:
        raise RecordingError(
            f"{settings.sample}: holds no events: choose another --sample, or leave it out"
        )
    write_page(folder, weights, concatenate(held), height, width, settings.runtime)
    print(
        f"{folder}: a page with onnxruntime-web {version} and a sample of {size:,} events; "
        f"python -m http.server -d {folder} shows it at localhost:8000"
    )


def simulated(height: int, width: int, seconds: float) -> Iterator[Events]:
    """The scene of `firenet demo`, as a clean sensor's events."""
    demo = Demo(Path("demo.mp4"), seconds=seconds, sensor_size=f"{width}x{height}")
    sensor, scene = (
        jax.tree.map(lambda leaf: leaf[0], one) for one in make_scene(demo, height, width)
    )
    bounds = np.array([0, round(1e6 * seconds)])
    times = rendering_times(scene, bounds, height=height, width=width)
    return event_list(sensor, video(scene, times, height=height, width=width))


def check_file(path: Path, settings: Export) -> None:
    """Raises OutputError for what cannot be written."""
    if path.suffix not in KINDS:
        names = f"{', '.join(KINDS[:-1])} or {KINDS[-1]}"
        raise OutputError(f"{path}: cannot write {path.suffix or 'such'} files; try {names}")
    if not runs_of(path) and (settings.picture or not settings.normalise):
        raise OutputError(
            f"{path} holds weights alone: --picture and --no-normalise are for .onnx and .stablehlo"
        )
    if path.is_dir():
        raise OutputError(f"{path} is a folder: choose another name for the file")
    if path.exists() and not settings.overwrite:
        raise OutputError(f"{path} exists: choose another output or pass --overwrite")
    partial_name(followed(path))  # refuses some names


def runs_of(path: Path) -> bool:
    """Whether such a file is the network, not its weights alone."""
    return path.suffix in (".onnx", ".stablehlo")


def write_file(path: Path, settings: Export) -> None:
    weights = load_weights(settings.weights)
    inside = {"normalise": settings.normalise, "picture": settings.picture}
    content = {
        ".onnx": lambda: onnx_model(weights, **inside).SerializeToString(),
        ".stablehlo": lambda: stablehlo(weights, **inside),
        ".pth": lambda: pth(weights),
        ".safetensors": lambda: safetensors(weights),
    }[path.suffix]()
    write_bytes(followed(path), content)
    normalised = weights.normalise and not (runs_of(path) and settings.normalise)
    tensors = "normalised" if normalised else "raw"
    print(f"{path}: {len(content) / 1000:.0f} kB, for {tensors} event tensors")
