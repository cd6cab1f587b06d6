"""Event tensors -> images: FireNet's step under `jax.lax.scan`, and the whole program to pictures.

Event tensors are (T, B, H, W, 5), images (T, B, H, W). State is passed in and returned, so a
recording can be streamed in chunks of any T. B recordings of different lengths run in parallel:
`valid` (T, B) says which windows exist; the others leave the state unchanged. Images at given times
are steps whose new state is discarded (instants.py).
"""

import copy
import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from firenet_jax import colour, native
from firenet_jax.devices import BATCH, REPLICATED, TIME_BATCH, on_each_device
from firenet_jax.errors import logger
from firenet_jax.events import BINS, Recording, check_recording, until_damage
from firenet_jax.instants import WARM_UP, Counts, Grid, Step, check, steps, warming
from firenet_jax.network import (
    CHANNELS,
    State,
    Weights,
    check_dtype,
    check_state,
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
from firenet_jax.settings import check_arrays
from firenet_jax.tensors import PACKED_SPECS, Packed, normalise, tensor_chunks, voxelise
from firenet_jax.windows import Windows, cut, usual


@dataclass(frozen=True)
class Network:
    """How the network runs."""

    recurrent: bool = True
    """With --no-recurrent each window starts from a zero state (the ablation in Fig. 5 of the
    paper). By default the state is carried from window to window."""
    whole_windows: bool = False
    """Take every window in one step, as the original program does. By default a window of 0.75 or
    more events per pixel is taken in several steps, of about half an event per pixel each, and its
    image is that of the last: in one step, dense windows wash out. Windows that overlap, and those
    of images at given times, are taken whole."""
    bfloat16: bool = False
    """Compute convolutions in bfloat16, slightly less accurate. For accelerators; slower on a
    CPU."""
    pad: int = 1
    """Pad tensors by reflection to a multiple of this many pixels. The original program uses 16."""
    color: bool = False
    """Reconstruct colour, for a sensor with a colour filter array (RGBG or RGBW): each channel
    separately, three quarters more work."""


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

    tensors: as `event_tensors` gives them; normalised here if the weights expect it.
    valid: (T, B) or (T, 1) bool; where False the state is unchanged and the image is undefined
    (tensors must be finite there too).
    recurrent: False starts every window from a zero state (the state returned is zero).
    machine_code: False uses XLA alone. True uses `native.step` where it exists: on a CPU, in
    float32, unless FIRENET_NATIVE=0 is set or the function is exported.
    dtype: as of `network.step`; of jnp.bfloat16 there is no machine code.
    Gradients, first ones in reverse mode only, are those of `network.step`.
    Tensors, state and parameters are converted to float32 if their type converts exactly; numpy's
    float64 is rounded by JAX before that, but in programs with jax_enable_x64.
    Raises ValueError for other types and for shapes that do not match.
    """
    check_dtype(dtype)
    weights, state, tensors, valid = _checked(weights, state, tensors, valid)
    if not recurrent:
        state = jax.tree.map(jnp.zeros_like, state)
    if dtype == jnp.float32 and machine_code:
        return _quickest(recurrent, weights, state, tensors, valid)
    with native.by_xla_alone(not machine_code):
        return _by_xla(_scan, recurrent, dtype, weights, state, tensors, valid)


def _by_xla(scan, recurrent: bool, dtype, weights: Weights, *inputs):
    """scan: `_scan` or `_scan_at`; inputs: what they take after the weights."""
    return scan(partial(step, weights.params, dtype=dtype), recurrent, weights, *inputs)


def _by_machine_code(scan, recurrent: bool, weights: Weights, state, tensors, *inputs):
    packed, normalised = native.pack(weights.params), replace(weights, normalise=False)
    native_step = partial(native.step, packed, normalise=weights.normalise)
    if len(tensors) == 1 or scan is _scan_at:
        # Not in place: that would overwrite the caller's state, or the one a look starts from.
        native_step = partial(native_step, in_place=False)
    kept = jax.tree.map(tuple, state, is_leaf=lambda part: isinstance(part, State))
    kept, images = scan(native_step, recurrent, normalised, kept, tensors, *inputs)
    return jax.tree.unflatten(jax.tree.structure(state), jax.tree.leaves(kept)), images


def _scan(step, recurrent: bool, weights: Weights, state, tensors, valid):
    def body(state, inputs):
        tensor, exists = inputs
        # Here, not for all windows at once: the rounding of sums would depend on T.
        tensor = normalise(tensor) if weights.normalise else tensor
        new, image = step(state, tensor, exists)
        return new if recurrent else state, image

    return jax.lax.scan(body, state, (tensors, valid))


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _quickest(recurrent, *inputs):
    xla = partial(_by_xla, _scan, recurrent, jnp.float32)
    return native.choose(partial(_by_machine_code, _scan, recurrent), xla, *inputs)


def _forward(recurrent, *inputs):
    """By XLA: machine code does not keep the values that a gradient needs."""
    return jax.vjp(partial(_by_xla, _scan, recurrent, jnp.float32), *inputs)


def _backward(recurrent, gradient_of, cotangents):
    return gradient_of(cotangents)


_quickest.defvjp(_forward, _backward)


# --- Argument checks, the same for XLA and machine code


def _checked(weights: Weights, state: State, tensors, valid):
    """`reconstruct`'s arrays in float32. Raises ValueError if they do not match, TypeError for
    other objects in place of weights or state."""
    _check_weights(weights)
    check_arrays(tensors=tensors, valid=valid)
    if jnp.ndim(tensors) != 5 or jnp.shape(tensors)[-1] != BINS:
        raise ValueError(f"event tensors are (T, B, H, W, {BINS}), not {jnp.shape(tensors)}")
    shape = jnp.shape(tensors)[:4]
    state = _checked_state(state, shape)
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
    return replace(weights, params=params), state, _as_float32(tensors, "event tensors"), valid


def _checked_state(state: State, shape: tuple[int, ...]) -> State:
    """A state in float32, if it suits event tensors of this shape (T, B, H, W)."""
    check_state(state)
    for name, h in state._asdict().items():
        if jnp.shape(h) != (*shape[1:], CHANNELS):
            raise ValueError(
                f"the state's {name} is {jnp.shape(h)}, but event tensors {(*shape, BINS)} need "
                f"{(*shape[1:], CHANNELS)}: make it with initial_state(batch, height, width)"
            )
    return _as_float32(state, "state")


def _check_weights(weights) -> None:
    if not isinstance(weights, Weights):
        raise TypeError(
            f"weights are a {type(weights).__name__}: pass Weights, as load_weights gives, whole "
            "and not their params"
        )


def _as_float32(tree, name: str):
    """Raises ValueError for types that float32 would round."""

    def one(x):
        kind = jnp.result_type(x)
        if jnp.issubdtype(kind, jnp.floating):
            exact = jnp.finfo(kind).bits <= 32
        else:  # float32 holds integers of 24 bits exactly
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


# --- Images at given times: kept steps, and looks


class Committed(NamedTuple):
    """The last two kept states: a look starts from a mean of them."""

    before: State
    last: State


class Looks(NamedTuple):
    """Which of T steps of B recordings are looks (see `instants`)."""

    looks: np.ndarray  # (T, B) bool: True: an image whose new state is discarded; False: kept
    share: np.ndarray  # (T, B) float32: a look starts from (1 - share) before + share last


@partial(jax.jit, static_argnames=("recurrent", "dtype"))
def reconstruct_at(
    weights: Weights,
    committed: Committed,
    tensors: jax.Array,
    steps: Looks,
    valid: jax.Array | None = None,
    *,
    recurrent: bool = True,
    dtype=jnp.float32,
) -> tuple[Committed, jax.Array]:
    """(Committed, (T, B, H, W, 5), Looks) -> (Committed, images (T, B, H, W) float32).

    As `reconstruct`, but some of the steps are looks. Not differentiable.
    """
    check_dtype(dtype)
    weights, last, tensors, valid = _checked(weights, committed.last, tensors, valid)
    before = _checked_state(committed.before, tensors.shape[:4])
    if valid is None:
        valid = jnp.ones(tensors.shape[:2], bool)
    committed = Committed(before, last)
    if not recurrent:
        committed = jax.tree.map(jnp.zeros_like, committed)
    inputs = weights, committed, tensors, steps, valid
    xla = partial(_by_xla, _scan_at, recurrent, dtype)
    if dtype == jnp.float32:
        return native.choose(partial(_by_machine_code, _scan_at, recurrent), xla, *inputs)
    return xla(*inputs)


def _scan_at(step, recurrent: bool, weights: Weights, committed: Committed, tensors, steps, valid):
    def chosen(choice, a, b):
        """a for the recordings where `choice` is True, else b."""
        return jax.tree.map(lambda a, b: jnp.where(choice[:, None, None, None], a, b), a, b)

    def between(share, a, b):
        share = share[:, None, None, None]
        return jax.tree.map(lambda a, b: (1 - share) * a + share * b, a, b)

    def body(committed, inputs):
        tensor, steps, exists = inputs
        tensor = normalise(tensor) if weights.normalise else tensor
        # A kept step starts from exactly the last state: 0 a + 1 b.
        share = jnp.where(steps.looks, steps.share, 1.0)
        new, image = step(between(share, *committed), tensor, exists)
        if recurrent:
            kept = exists & ~steps.looks
            committed = Committed(
                chosen(kept, committed.last, committed.before), chosen(kept, new, committed.last)
            )
        return committed, image

    return jax.lax.scan(body, committed, (tensors, steps, valid))


def images_at(
    weights: Weights,
    recording: Recording,
    times: Iterable[int],
    *,
    chunk: int = 8,
    warm_up: int = WARM_UP,
    **windows,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Recording, times -> chunks of (times (n,) int64, images (n, H, W) float32).

    times: microseconds on the recording's clock, in order; may be endless, such as `fj.grid`. Times
    before the first event or after the last one get no image.
    windows: those that update the state, as `windows.Windows` takes them; default: 0.35 events per
    pixel, at most 40 ms, or a twentieth of a recording shorter than 0.8 s, as in
    `firenet reconstruct`. An image depends on these and on the events
    up to its time and those of the warm-up, not on which other times are requested.
    chunk: steps per call of the device. Memory holds one chunk, whatever the recording's length.
    warm_up: windows of the beginning that the network sees beforehand, see `instants.warming`.
    Raises ValueError for invalid windows and for times that are not whole or not in order,
    RecordingError if the file is damaged before the last of them, TypeError for weights or a
    recording of another type.
    """
    if chunk < 1 or chunk % 1:
        raise ValueError(f"chunk is {chunk}, but must be 1 or more steps")
    if warm_up < 0 or warm_up % 1:
        raise ValueError(f"warm_up is {warm_up}, but must be 0 or more windows")
    _check_weights(weights)
    check_recording(recording)
    chosen = Windows(**windows) if windows else usual(until_damage(recording.events()))
    check(chosen)
    state = initial_state(1, recording.height, recording.width)
    committed = Committed(state, state)
    first, cutter = warming(cut(recording, chosen), recording.pixels, warm_up)
    counts = Counts()
    times = copy.copy(times) if isinstance(times, Grid) else times  # a grid counts on
    entries = itertools.chain(first, steps(recording, chosen, times, cutter, counts))
    for group, tensors in tensor_chunks(recording, entries, chunk):
        looks, valid = looks_of([group], chunk), np.arange(chunk)[:, None] < len(group)
        committed, images = reconstruct_at(weights, committed, tensors, looks, valid)
        seen = np.flatnonzero(looks.looks[:, 0])
        if seen.size:
            found = np.array([group[i].time for i in seen], np.int64)
            yield found, np.asarray(images)[seen, 0]
    if not counts.seen and counts.early + counts.late:
        logger.warning(
            "%s: none of the requested times lies within it (%s): times are microseconds on its "
            "clock",
            recording.path, counts.outside,
        )  # fmt: skip


def looks_of(groups: Sequence[Sequence[Step]], length: int) -> Looks:
    """The steps of B recordings, at most T = `length` each -> (T, B) arrays on the host; missing
    steps count as kept."""
    looks = np.zeros((length, len(groups)), bool)
    share = np.ones((length, len(groups)), np.float32)
    for b, group in enumerate(groups):
        looks[: len(group), b] = [step.time is not None for step in group]
        share[: len(group), b] = [step.share for step in group]
    return Looks(looks, share)


# --- From events to pictures


class Session(NamedTuple):
    """The state of B recordings between two chunks."""

    network: State | Committed
    display: DisplayState
    channels: "Session | None" = None
    """The same for red, green and blue, leading axes (B, 3); None without colours."""


def initial_session(
    batch: int, height: int, width: int, network: Network, at_times: bool = False
) -> Session:
    """at_times: for images at given times, see `reconstruct_at`.
    Raises SettingsError for colours from a sensor with an odd side."""
    (top, bottom), (left, right) = padding(height, width, network.pad)
    state = initial_state(batch, top + height + bottom, left + width + right)
    state = Committed(state, state) if at_times else state
    channels = None
    if network.color:
        colour.check_sides(height, width)
        grey = replace(network, color=False)
        channels = initial_session(3 * batch, height // 2, width // 2, grey, at_times)
        channels = _unfold(channels)
    return Session(state, initial_display_state(batch), channels)


def _fold(channels):
    """Arrays (B, 3, ...) -> (3 B, ...): three channels are three recordings side by side."""
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), channels)


def _unfold(channels):
    """Arrays (3 B, ...) -> (B, 3, ...)."""
    return jax.tree.map(lambda leaf: leaf.reshape(-1, 3, *leaf.shape[1:]), channels)


def padding(height: int, width: int, multiple: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """((top, bottom), (left, right)) up to the next multiple; the larger half first (rpg_e2vid)."""
    rows, columns = -height % multiple, -width % multiple
    return (-(-rows // 2), rows // 2), (-(-columns // 2), columns // 2)


@partial(
    jax.jit,
    static_argnames=("height", "width", "network", "settings", "preview", "rotated", "raw", "mesh"),
)
def events_to_pictures(
    weights: Weights,
    session: Session,
    events: Packed,
    valid: jax.Array,
    steps: Looks | None = None,
    seen: jax.Array | None = None,
    *,
    height: int,
    width: int,
    network: Network = Network(),
    settings: Display = Display(),
    preview: bool = False,
    rotated: bool = False,
    raw: bool = False,
    mesh: Mesh | None = None,
) -> tuple[Session, jax.Array]:
    """(Session, the events of T x B windows) -> (Session, pictures), as one compiled program.

    Voxels, normalisation, padding, network, unsharp mask, intensity range, 8 bits. Pictures are
    (T, B, H, W) uint8, with colours (T, B, H, W, 3); with preview (T, B, H, 2 W, 3): the events
    beside the reconstruction.
    valid: (T, B) bool, as in `reconstruct`.
    steps: which steps are looks, for a session `at_times`; pictures of kept steps are undefined.
    seen: (T, B) bool: which images the intensity range is drawn from; None: all.
    rotated: the events are rotated by 180 degrees, and with them a sensor's colour filter array.
    raw: the network's images, (T, B, H, W) float32, in place of pictures.
    mesh: devices that share the B recordings equally, for events from `pack_for_devices`.
    """
    # Tensors are normalised before they are padded or split into colour channels.
    early = weights.normalise and (network.pad > 1 or network.color)
    dtype = jnp.bfloat16 if network.bfloat16 else jnp.float32
    run = partial(reconstruct, recurrent=network.recurrent, dtype=dtype)

    def all_at_once(weights, state, inputs, valid):
        return run(replace(weights, normalise=False), state, normalise(inputs), valid)

    def shown(weights, session, inputs, valid, steps, seen):
        height, width = inputs.shape[2:4]
        (top, bottom), (left, right) = sides = padding(height, width, network.pad)
        inputs = jnp.pad(inputs, ((0, 0), (0, 0), *sides, (0, 0)), mode="reflect")
        if steps is not None:
            ready = replace(weights, normalise=weights.normalise and not early)
            state, images = reconstruct_at(
                ready, session.network, inputs, steps, valid,
                recurrent=network.recurrent, dtype=dtype,
            )  # fmt: skip
            valid = valid & steps.looks
        elif early or not weights.normalise:
            plain = replace(weights, normalise=False)
            state, images = run(plain, session.network, inputs, valid)
        else:  # an accelerator normalises all windows at once, a CPU as part of each step
            arguments = weights, session.network, inputs, valid
            state, images = jax.lax.platform_dependent(*arguments, cpu=run, default=all_at_once)
        if raw:
            images = images[:, :, top : top + height, left : left + width]
            return Session(state, session.display), images
        valid = valid if seen is None else valid & seen
        # As in the original program, the mask and the intensity range see the padded image.
        ranges, greys = display(session.display, images, valid, settings=settings)
        greys = greys[:, :, top : top + height, left : left + width]
        return Session(state, ranges), greys

    def one_device(weights, session, events, valid, steps, seen):
        tensors = voxelise(events, height=height, width=width)
        inputs = normalise(tensors) if early else tensors
        after, pictures = shown(weights, session, inputs, valid, steps, seen)
        if network.color:
            planes = colour.channels(inputs, rotated)  # (T, B, 3, H/2, W/2, 5)
            planes = planes.reshape(len(planes), -1, *planes.shape[3:])
            each = partial(jnp.repeat, repeats=3, axis=1)
            channels, shades = shown(
                weights, _fold(session.channels), planes, *jax.tree.map(each, (valid, steps, seen))
            )
            shades = shades.reshape(len(planes), -1, 3, *shades.shape[2:])
            pictures = colour.coloured(pictures, shades, rotated)
            after = after._replace(channels=_unfold(channels))
        if preview:
            if not network.color:
                pictures = jnp.broadcast_to(pictures[..., None], (*pictures.shape, 3))
            pictures = jnp.concatenate([event_pictures(tensors), pictures], axis=-2)
        return after, pictures

    if mesh is not None:
        specs = REPLICATED, BATCH, PACKED_SPECS, TIME_BATCH, TIME_BATCH, TIME_BATCH
        one_device = on_each_device(one_device, specs, (BATCH, TIME_BATCH), mesh)
    return one_device(weights, session, events, valid, steps, seen)
