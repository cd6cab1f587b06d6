"""firenet_jax: event camera recordings -> video, by FireNet as pure JAX functions.

    reconstruct   readers -> events -> windows -> tensors -> network (scan) -> pictures -> video
    train         textures -> scenes -> sensor -> (dataset) -> train (losses) -> weights

    import firenet_jax as fj

    recording = fj.open_recording("dynamic_6dof.zip")
    weights = fj.load_weights()
    state = fj.initial_state(batch=1, height=recording.height, width=recording.width)
    for tensors, times in fj.event_tensors(recording, events_per_pixel=0.35):
        state, images = fj.reconstruct(weights, state, tensors)

`fj.recording(t, x, y, p, width=240, height=180)` makes a recording from arrays.
`fj.images_at(weights, recording, times)` yields images at times of your choice, in microseconds.

Names are loaded on first use (PEP 562), so importing this package does not load jax. No module
shares its name with a public function: importing the module would hide the function.
"""

import importlib
import importlib.metadata
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # what editors and type checkers see of the names in _HOME
    from firenet_jax.checkpoint import load_weights, save_weights
    from firenet_jax.errors import FirenetError, RecordingError
    from firenet_jax.events import Events, Recording
    from firenet_jax.instants import grid
    from firenet_jax.network import State, Weights, initial_state, step
    from firenet_jax.pictures import Display, DisplayState, display, initial_display_state
    from firenet_jax.readers import open_recording
    from firenet_jax.readers.arrays import recording
    from firenet_jax.reconstruction import images_at, reconstruct
    from firenet_jax.storage.video import write_video
    from firenet_jax.tensors import event_tensors, normalise, pack, voxelise

    __version__: str

_HOME = {
    "Display": "pictures",
    "DisplayState": "pictures",
    "Events": "events",
    "FirenetError": "errors",
    "Recording": "events",
    "RecordingError": "errors",
    "State": "network",
    "Weights": "network",
    "display": "pictures",
    "event_tensors": "tensors",
    "grid": "instants",
    "images_at": "reconstruction",
    "initial_display_state": "pictures",
    "initial_state": "network",
    "load_weights": "checkpoint",
    "normalise": "tensors",
    "open_recording": "readers",
    "pack": "tensors",
    "recording": "readers.arrays",
    "reconstruct": "reconstruction",
    "save_weights": "checkpoint",
    "step": "network",
    "voxelise": "tensors",
    "write_video": "storage.video",
}

__all__ = [  # written out, for type checkers
    "Display", "DisplayState", "Events", "FirenetError", "Recording", "RecordingError", "State",
    "Weights", "display", "event_tensors", "grid", "images_at", "initial_display_state",
    "initial_state", "load_weights", "normalise", "open_recording", "pack", "recording",
    "reconstruct", "save_weights", "step", "voxelise", "write_video",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return importlib.metadata.version("firenet-jax")
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
