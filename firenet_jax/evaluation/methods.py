"""Names and weights -> methods that turn events into images, behind one interface.

    state = method.initial(height, width)
    state, image = method.step(state, window)        image: (H, W) float32 on the device

Windows are consecutive, in time order, of any size; images are nominally 0 to 1 and not clipped.
An image at a given time is a step whose new state is discarded (`look`).
A method is a function below and a line in `load`. Networks compile once per sensor size; packing
compiles for each of a few window sizes (`tensors.CAPACITIES`).
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from firenet_jax.checkpoint import digest, load_weights
from firenet_jax.errors import SettingsError, logger
from firenet_jax.evaluation.baselines import e2vid, high_pass, manifold
from firenet_jax.instants import Step
from firenet_jax.network import Weights, initial_state
from firenet_jax.reconstruction import reconstruct
from firenet_jax.storage.files import named
from firenet_jax.tensors import normalise, pack, voxelise
from firenet_jax.windows import Window

METHODS = ("firenet", "e2vid", "hf", "mr")


class Method(NamedTuple):
    """One way to turn windows of events into images."""

    name: str
    initial: Callable[[int, int], Any]  # height, width -> the state before the first window
    step: Callable[[Any, Window], tuple[Any, jax.Array]]  # (state, window) -> (state, image)
    record: dict  # everything that its images depend on, ready for JSON
    between: Callable[[float, Any, Any], Any] | None = None
    """(share, state, next state) -> the state from which a look starts, between the two. None, for
    methods that process single events: it starts from the last state and takes the events since."""


class Missing(NamedTuple):
    """A requested method that cannot run."""

    name: str
    reason: str


class PaddedState(NamedTuple):
    """The state of a network that pads its input: it alone does not tell the sensor's size."""

    network: Any
    height: int
    width: int


def load(
    names: Sequence[str],
    weights: Sequence[Path] = (),
    e2vid_weights: Path | None = None,
    *,
    e2vid_random: bool = False,
    e2vid_sigmoid: bool = True,
) -> list[Method | Missing]:
    """The methods of these names, in their order.

    weights: files of FireNet or FireNet+, or folders of runs, each a method of its name; without
    any, those of the package. e2vid_random: where no file is named, random weights: for measuring
    time. e2vid_sigmoid: False for E2VID+. A method without weights is `Missing`.
    Raises SettingsError for unknown and repeated names and for weights of methods that are not
    named, CheckpointError for files that cannot be read.
    """
    for name, given in (("firenet", weights), ("e2vid", e2vid_weights)):
        if given and name not in names:
            raise SettingsError(f"weights are given, but {name} is not among the methods: add it")
    found: list[Method | Missing] = []
    for name in names:
        if name not in METHODS:
            raise SettingsError(f"no method {name!r}: choose from {', '.join(METHODS)}")
        if name == "firenet" and weights:
            found += [firenet(_title(path), load_weights(path)) for path in weights]
        elif name == "firenet":
            found.append(firenet(name, load_weights()))
        elif name == "e2vid" and e2vid_weights is not None:
            found.append(recurrent_unet(name, *e2vid.load(e2vid_weights, sigmoid=e2vid_sigmoid)))
        elif name == "e2vid" and e2vid_random:
            params = e2vid.initial_params(jax.random.key(0))
            found.append(recurrent_unet("e2vid-random", params))
        elif name == "e2vid":
            logger.warning("e2vid has no weights and is left out: pass --e2vid-weights FILE")
            found.append(Missing(name, "no weights"))
        elif name == "hf":
            found.append(filtered(name))
        else:
            found.append(regularised(name))
    found_names = [method.name for method in found]
    twice = next((name for name in found_names if found_names.count(name) > 1), None)
    if twice:
        raise SettingsError(
            f"two methods are named {twice}: rename a file of weights, or name it once"
        )
    return found


def _title(path: Path) -> str:
    """A file's name without its suffix; all of a folder's, for `lr0.001` has none."""
    return named(path).name if path.is_dir() else path.stem


def firenet(name: str, weights: Weights) -> Method:
    """FireNet and FireNet+: Eq. 1's tensor of a window through the network."""
    weights = jax.device_put(weights)

    def step(state, window):
        tensor = _tensor(window, *state.g1.shape[1:3])
        state, images = reconstruct(weights, state, tensor)
        return state, images[0, 0]

    record = {"method": "firenet", "normalise": weights.normalise, "weights": digest(weights)}
    return Method(name, partial(initial_state, 1), step, record, _between)


def recurrent_unet(name: str, params, settings: e2vid.Settings = e2vid.Settings()) -> Method:
    """E2VID and E2VID+ (no sigmoid), each as EVREAL runs it.

    E2VID takes normalised tensors, and its images are stretched, so that their 1st percentile
    becomes 0 and their 99th 1; E2VID+ takes tensors as they are and its images stay so.
    """
    params = jax.device_put(params)

    def initial(height, width):
        return PaddedState(e2vid.initial_state(1, height, width, settings), height, width)

    def step(state, window):
        tensor = _tensor(window, state.height, state.width)
        network, image = _unet_step(params, state.network, tensor, settings)
        return state._replace(network=network), image

    as_published = {"normalise": settings.sigmoid, "stretched": settings.sigmoid}
    record = {"method": "e2vid", **as_published, **dataclasses.asdict(settings)}

    def between(share, before, last):
        return last._replace(network=_between(share, before.network, last.network))

    return Method(name, initial, step, record | {"weights": digest(params)}, between)


@partial(jax.jit, static_argnames="settings")
def _unet_step(params, state, tensor, settings):
    if not settings.sigmoid:
        state, images = e2vid.step(params, state, tensor[0], settings)
        return state, images[0]
    state, images = e2vid.step(params, state, normalise(tensor[0]), settings)
    low, high = jnp.percentile(images[0], jnp.array([1.0, 99.0]))
    return state, (images[0] - low) / jnp.where(high > low, high - low, 1.0)


def filtered(name: str, settings: high_pass.HighPass = high_pass.HighPass()) -> Method:
    """HF, the high-pass filter, with a bilateral filter after it as in the FireNet paper."""
    step = partial(high_pass.step, settings=settings)
    record = {"method": "hf", **dataclasses.asdict(settings)}
    return Method(name, high_pass.initial_state, step, record)


def regularised(name: str) -> Method:
    """MR, manifold regularisation."""
    record = {"method": "mr", **dataclasses.asdict(manifold.Manifold())}
    return Method(name, manifold.initial_state, manifold.step, record)


@jax.jit
def _between(share, before, last):
    return jax.tree.map(lambda a, b: (1 - share) * a + share * b, before, last)


def look(method: Method, before: Any, last: Any, step: Step) -> jax.Array:
    """The two states that were kept last, a step of `instants.steps` that looks -> its image."""
    assert step.time is not None
    if method.between is None:
        events = step.events.select(slice(len(step.events) - step.new, None))
        return method.step(last, Window(events, step.time))[1]
    state = method.between(step.share, before, last)
    return method.step(state, Window(step.events, step.time))[1]


def _tensor(window: Window, height: int, width: int) -> jax.Array:
    """A window -> (1, 1, H, W, 5), not normalised."""
    return voxelise(pack([[window.events]]), height=height, width=width)
