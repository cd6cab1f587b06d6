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

__all__ = sorted(_HOME)


def __getattr__(name: str):
    if name == "__version__":
        return importlib.metadata.version("firenet-jax")
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__():
    return __all__
