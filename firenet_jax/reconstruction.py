"""Event tensors -> images: FireNet's step under `jax.lax.scan`, and the whole program to pictures.

Event tensors are (T, B, H, W, 5), images (T, B, H, W). State goes in and comes out, so a recording
may be streamed in chunks of any T, and B recordings of different lengths may run side by side:
`valid` (T, B) says which windows exist, and the others leave the state as it was.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from firenet_jax import colour, native
from firenet_jax.devices import BATCH, EVERYWHERE, TIME_BATCH, on_each_device
from firenet_jax.network import BINS, State, Weights, initial_state, step
from firenet_jax.pictures import (
    Display,
    DisplayState,
    display,
    event_pictures,
    initial_display_state,
)
from firenet_jax.tensors import IN_LISTS, Packed, normalise, voxelise


@dataclass(frozen=True)
class Network:
    """How the network runs."""

    recurrent: bool = True
    """--no-recurrent forgets everything between windows (ablation, Fig. 5 of the paper)."""
    bfloat16: bool = False
    """Convolutions in bfloat16, a little less accurate: for accelerators; on a CPU it is slower."""
    pad: int = 1
    """Pad tensors by reflection to a multiple of this; 16 is what the original program does."""
    color: bool = False
    """Colours, of a sensor with a mosaic (rows of red and green, and of white or green and blue):
    each is reconstructed by itself, three quarters more work."""


@partial(jax.jit, static_argnames=("recurrent", "dtype"))
def reconstruct(
    weights: Weights,
    state: State,
    tensors: jax.Array,
    valid: jax.Array | None = None,
    *,
    recurrent: bool = True,
    dtype=jnp.float32,
) -> tuple[State, jax.Array]:
    """(State, (T, B, H, W, 5)) -> (State, images (T, B, H, W) float32).

    tensors: as `event_tensors` gives them; normalised here if the weights ask for it.
    valid: (T, B) bool; where False the state stays as it was and the image means nothing (tensors
    must be finite there too).
    recurrent: False starts every window from a zero state (the state returned is zero).
    On a CPU, in float32, the scan's body is `native.step`, where there is one; gradients, in
    reverse mode only, are those of `network.step`.
    Raises ValueError where the shapes of state and tensors do not belong together.
    """
    _check_shapes(state, tensors)
    if not recurrent:
        state = jax.tree.map(jnp.zeros_like, state)
    if dtype == jnp.float32 and native.supports(*tensors.shape[2:4], weights.normalise):
        return _native(recurrent, weights, state, tensors, valid)
    return _scan(
        partial(step, weights.params, dtype=dtype), recurrent, weights, state, tensors, valid
    )


def _scan(step, recurrent: bool, weights: Weights, state: State, tensors, valid):
    def body(state, inputs):
        tensor, exists = inputs
        # Here, not for all windows at once: sums would be rounded otherwise for each T.
        tensor = normalise(tensor) if weights.normalise else tensor
        new, image = step(state, tensor, exists)
        return new if recurrent else state, image

    return jax.lax.scan(body, state, (tensors, valid))


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _native(recurrent, weights, state, tensors, valid):
    """The same by the step that has no gradient; for one, everything is computed again by XLA."""
    packed, normalised = native.pack(weights.params), replace(weights, normalise=False)
    native_step = partial(native.step, packed, normalise=weights.normalise)
    state = native.enclose(state)
    state, images = _scan(native_step, recurrent, normalised, state, tensors, valid)
    return native.interior(state, *tensors.shape[2:4]), images


def _native_forward(recurrent, *inputs):
    return _native(recurrent, *inputs), inputs


def _native_backward(recurrent, inputs, cotangents):
    def plain(weights, *rest):
        return _scan(partial(step, weights.params), recurrent, weights, *rest)

    return jax.vjp(plain, *inputs)[1](cotangents)


_native.defvjp(_native_forward, _native_backward)


def _check_shapes(state: State, tensors: jax.Array) -> None:
    if tensors.ndim != 5 or tensors.shape[-1] != BINS:
        raise ValueError(f"event tensors are (T, B, H, W, {BINS}), not {tensors.shape}")
    if state.g1.shape[:3] != tensors.shape[1:4]:
        raise ValueError(
            f"the state is for (B, H, W) = {state.g1.shape[:3]}, the event tensors are "
            f"{tensors.shape[1:4]}: make it with initial_state(batch, height, width)"
        )


class Session(NamedTuple):
    """All that must be kept between two chunks of B recordings."""

    network: State
    display: DisplayState
    channels: "Session | None" = None
    """The same of red, green and blue, leading axes (B, 3); None without colours."""


def initial_session(batch: int, height: int, width: int, network: Network) -> Session:
    """Raises ValueError for colours of a sensor with an odd side."""
    (top, bottom), (left, right) = padding(height, width, network.pad)
    state = initial_state(batch, top + height + bottom, left + width + right)
    channels = None
    if network.color:
        colour.check_sides(height, width)
        grey = replace(network, color=False)
        channels = _unfold(initial_session(3 * batch, height // 2, width // 2, grey))
    return Session(state, initial_display_state(batch), channels)


def _fold(channels):
    """Arrays (B, 3, ...) -> (3 B, ...): three channels are three recordings side by side."""
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), channels)


def _unfold(channels):
    """Arrays (3 B, ...) -> (B, 3, ...)."""
    return jax.tree.map(lambda leaf: leaf.reshape(-1, 3, *leaf.shape[1:]), channels)


def padding(height: int, width: int, multiple: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """((top, bottom), (left, right)) up to the next multiple; the larger half first (rpg_e2vid)."""
    missing = (-height % multiple, -width % multiple)
    return tuple((-(-n // 2), n // 2) for n in missing)


@partial(
    jax.jit,
    static_argnames=("height", "width", "network", "settings", "preview", "mesh"),
)
def events_to_pictures(
    weights: Weights,
    session: Session,
    events: Packed,
    valid: jax.Array,
    *,
    height: int,
    width: int,
    network: Network = Network(),
    settings: Display = Display(),
    preview: bool = False,
    mesh: Mesh | None = None,
) -> tuple[Session, jax.Array]:
    """(Session, the events of T x B windows) -> (Session, pictures), as one compiled program.

    Voxels, normalisation, padding, network, unsharp mask, intensity range, 8 bits. Pictures are
    (T, B, H, W) uint8, with colours (T, B, H, W, 3); with preview (T, B, H, 2 W, 3): the events
    beside the reconstruction.
    valid: (T, B) bool, as in `reconstruct`.
    mesh: devices that share the B recordings equally, for events from `pack_for_devices`.
    """

    # Numbers are normalised before they are padded or dealt out to colours; an accelerator does it
    # for all windows at once, a CPU as part of each step.
    all_at_once = jax.default_backend() != "cpu"
    early = weights.normalise and (all_at_once or network.pad > 1 or network.color)

    def shown(weights, session, inputs, valid):
        height, width = inputs.shape[2:4]
        (top, bottom), (left, right) = sides = padding(height, width, network.pad)
        inputs = jnp.pad(inputs, ((0, 0), (0, 0), *sides, (0, 0)), mode="reflect")
        state, images = reconstruct(
            replace(weights, normalise=weights.normalise and not early),
            session.network,
            inputs,
            valid,
            recurrent=network.recurrent,
            dtype=jnp.bfloat16 if network.bfloat16 else jnp.float32,
        )
        # The original program crops last: its mask and its range see the padded image.
        ranges, greys = display(session.display, images, valid, settings)
        greys = greys[:, :, top : top + height, left : left + width]
        return Session(state, ranges), greys

    def one_device(weights, session, events, valid):
        tensors = voxelise(events, height=height, width=width)
        inputs = normalise(tensors) if early else tensors
        after, pictures = shown(weights, session, inputs, valid)
        if network.color:
            planes = colour.channels(inputs)  # (T, B, 3, H/2, W/2, 5)
            planes = planes.reshape(len(planes), -1, *planes.shape[3:])
            channels, shades = shown(
                weights, _fold(session.channels), planes, jnp.repeat(valid, 3, 1)
            )
            shades = shades.reshape(len(planes), -1, 3, *shades.shape[2:])
            pictures = colour.coloured(pictures, shades)
            after = after._replace(channels=_unfold(channels))
        if preview:
            if not network.color:
                pictures = jnp.broadcast_to(pictures[..., None], (*pictures.shape, 3))
            pictures = jnp.concatenate([event_pictures(tensors), pictures], axis=-2)
        return after, pictures

    if mesh is not None:
        specs = EVERYWHERE, BATCH, IN_LISTS, TIME_BATCH
        one_device = on_each_device(one_device, specs, (BATCH, TIME_BATCH), mesh)
    return one_device(weights, session, events, valid)
