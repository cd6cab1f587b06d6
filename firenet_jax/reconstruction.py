"""Event tensors -> images: FireNet's step under `jax.lax.scan`, and the whole program to pictures.

Event tensors are (T, B, H, W, 5), images (T, B, H, W). State goes in and comes out, so a recording
may be streamed in chunks of any T, and B recordings of different lengths may run side by side:
`valid` (T, B) says which windows exist, and the others leave the state as it was.
"""

from dataclasses import dataclass, replace
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from firenet_jax import colour, native
from firenet_jax.devices import BATCH, EVERYWHERE, TIME_BATCH, on_each_device
from firenet_jax.network import (
    BINS,
    CHANNELS,
    State,
    Weights,
    initial_params,
    initial_state,
    step,
)
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


@partial(jax.jit, static_argnames=("recurrent", "dtype", "machine_code"))
def reconstruct(
    weights: Weights,
    state: State,
    tensors: jax.Array,
    valid: jax.Array | None = None,
    *,
    recurrent: bool = True,
    dtype=jnp.float32,
    machine_code: bool = True,
) -> tuple[State, jax.Array]:
    """(State, (T, B, H, W, 5)) -> (State, images (T, B, H, W) float32).

    tensors: as `event_tensors` gives them; normalised here if the weights ask for it.
    valid: (T, B) or (T, 1) bool; where False the state stays as it was and the image means nothing
    (tensors must be finite there too).
    recurrent: False starts every window from a zero state (the state returned is zero).
    machine_code: False leaves all to XLA. Else, on a CPU and in float32, the step is `native.step`,
    where there is one; not with FIRENET_NATIVE=0 in the environment, nor in what is exported.
    Gradients, in reverse mode only, are those of `network.step`.
    Tensors, state and parameters of types that float32 holds exactly become float32.
    Raises ValueError for other types, and where shapes do not belong together.
    """
    weights, state, tensors, valid = _checked(weights, state, tensors, valid)
    if not recurrent:
        state = jax.tree.map(jnp.zeros_like, state)
    if dtype == jnp.float32 and machine_code:
        return _quickest(recurrent, weights, state, tensors, valid)
    with native.by_xla_alone(not machine_code):
        return _by_xla(recurrent, dtype, weights, state, tensors, valid)


def _by_xla(recurrent: bool, dtype, weights: Weights, state: State, tensors, valid):
    network_step = partial(step, weights.params, dtype=dtype)
    return _scan(network_step, recurrent, weights, state, tensors, valid)


def _by_machine_code(recurrent: bool, weights: Weights, state: State, tensors, valid):
    packed, normalised = native.pack(weights.params), replace(weights, normalise=False)
    native_step = partial(native.step, packed, normalise=weights.normalise)
    if len(tensors) == 1:  # not in place: the caller's state stays
        native_step = partial(native_step, in_place=False)
    state, images = _scan(native_step, recurrent, normalised, tuple(state), tensors, valid)
    return State(*state), images


def _scan(step, recurrent: bool, weights: Weights, state, tensors, valid):
    def body(state, inputs):
        tensor, exists = inputs
        # Here, not for all windows at once: sums would be rounded otherwise for each T.
        tensor = normalise(tensor) if weights.normalise else tensor
        new, image = step(state, tensor, exists)
        return new if recurrent else state, image

    return jax.lax.scan(body, state, (tensors, valid))


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _quickest(recurrent, *inputs):
    xla = partial(_by_xla, recurrent, jnp.float32)
    return native.choose(partial(_by_machine_code, recurrent), xla, *inputs)


def _forward(recurrent, *inputs):
    """Machine code keeps nothing of what a gradient needs."""
    return jax.vjp(partial(_by_xla, recurrent, jnp.float32), *inputs)


def _backward(recurrent, gradient_of, cotangents):
    return gradient_of(cotangents)


_quickest.defvjp(_forward, _backward)


# --- The door: the same for both ways


def _checked(weights: Weights, state: State, tensors, valid):
    """All of `reconstruct`'s arrays in float32; raises ValueError where they do not fit."""
    if jnp.ndim(tensors) != 5 or jnp.shape(tensors)[-1] != BINS:
        raise ValueError(f"event tensors are (T, B, H, W, {BINS}), not {jnp.shape(tensors)}")
    shape = jnp.shape(tensors)[:4]
    for name, h in state._asdict().items():
        if jnp.shape(h) != (*shape[1:], CHANNELS):
            raise ValueError(
                f"the state's {name} is {jnp.shape(h)}, but event tensors {(*shape, BINS)} need "
                f"{(*shape[1:], CHANNELS)}: make it with initial_state(batch, height, width)"
            )
    if valid is not None:
        if jnp.shape(valid) not in (shape[:2], (shape[0], 1)):
            raise ValueError(
                f"valid is {jnp.shape(valid)}, but for event tensors {(*shape, BINS)} (T, B) is "
                f"{shape[:2]}"
            )
        if jnp.result_type(valid) != jnp.bool_:
            raise ValueError(f"valid is {jnp.result_type(valid)}, but must be bool")
        valid = jnp.broadcast_to(valid, shape[:2])
    _check_params(weights.params)
    params = _as_float32(weights.params, "parameters")
    state, tensors = _as_float32(state, "state"), _as_float32(tensors, "event tensors")
    return replace(weights, params=params), state, tensors, valid


def _as_float32(tree, name: str):
    """Raises ValueError for types with numbers that float32 rounds."""

    def one(x):
        kind = jnp.result_type(x)
        if jnp.issubdtype(kind, jnp.floating):
            exact = jnp.finfo(kind).bits <= 32
        else:  # all whole numbers of 24 bits are float32
            whole = jnp.issubdtype(kind, jnp.integer)
            exact = kind == jnp.bool_ or (whole and jnp.iinfo(kind).max <= 2**24)
        if not exact:
            raise ValueError(
                f"{name} are of type {kind}, which float32 does not hold exactly: pass them as "
                "float32"
            )
        return jnp.asarray(x, jnp.float32)

    return jax.tree.map(one, tree)


def _check_params(params) -> None:
    expected = _shapes_of_params()
    found = {jax.tree_util.keystr(path): jnp.shape(leaf) for path, leaf in _leaves(params)}
    for name in sorted(expected.keys() | found.keys()):
        if found.get(name) != expected.get(name):
            raise ValueError(
                f"the weights' parameter {name} is {found.get(name, 'missing')}, but FireNet's is "
                f"{expected.get(name, 'not there')}"
            )


_leaves = jax.tree_util.tree_leaves_with_path


@cache
def _shapes_of_params() -> dict[str, tuple[int, ...]]:
    shapes = jax.eval_shape(initial_params, jax.random.key(0))
    return {jax.tree_util.keystr(path): leaf.shape for path, leaf in _leaves(shapes)}


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
    # Numbers are normalised before they are padded or dealt out to colours.
    early = weights.normalise and (network.pad > 1 or network.color)
    dtype = jnp.bfloat16 if network.bfloat16 else jnp.float32
    run = partial(reconstruct, recurrent=network.recurrent, dtype=dtype)

    def all_at_once(weights, state, inputs, valid):
        return run(replace(weights, normalise=False), state, normalise(inputs), valid)

    def shown(weights, session, inputs, valid):
        height, width = inputs.shape[2:4]
        (top, bottom), (left, right) = sides = padding(height, width, network.pad)
        inputs = jnp.pad(inputs, ((0, 0), (0, 0), *sides, (0, 0)), mode="reflect")
        arguments = weights, session.network, inputs, valid
        if early or not weights.normalise:
            state, images = run(replace(weights, normalise=False), *arguments[1:])
        else:  # an accelerator normalises all windows at once, a CPU as part of each step
            state, images = jax.lax.platform_dependent(*arguments, cpu=run, default=all_at_once)
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
