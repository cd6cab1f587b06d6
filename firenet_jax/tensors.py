"""Windows of events -> event tensors: Eq. 1 of the paper for a whole chunk of windows at once.

Event tensors are (T, B, H, W, bins) float32: T windows in time order, B recordings side by side,
5 bins. Scheerlinck et al., "Fast Image Reconstruction with an Event Camera", WACV 2020, Eq. 1:

    E(x, y, t_n) = sum_i p_i max(0, 1 - |t_n - t*_i|)
    t*_i = (bins - 1) (t_i - t_min) / (t_max - t_min)

Windows are ragged, so they are passed as one flat, padded list of events; segment sums over that
list build all tensors. Only its length is padded, to a few fixed sizes, so new data does not
trigger recompilation.
"""

import itertools
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from firenet_jax.devices import BATCH, TIME_BATCH
from firenet_jax.errors import SettingsError
from firenet_jax.events import BINS, Events, Recording, check_recording
from firenet_jax.settings import check_arrays
from firenet_jax.windows import Windows, cut

# A flat list of events is padded to one of these sizes. Padding costs a few ns per event, a new
# size costs seconds of compilation, so small lists may be padded up to 8 times; from a million
# events on memory matters more, so at most twice.
CAPACITIES = 2**14, 2**17, *(2**k for k in range(20, 30))

Item = TypeVar("Item", bound=Any)  # has `events`
BLOCK, BLOCKS = 2**17, 8  # on a CPU: events per step of the scan, and how far it is unrolled


@cache
def _helper(process: int) -> ThreadPoolExecutor:
    """A thread that copies alongside `pack`; one per process, as a fork inherits no threads."""
    return ThreadPoolExecutor(1, "pack")


class Packed(NamedTuple):
    """The events of T x B windows as one flat list of E entries, some unused at the end."""

    t: np.ndarray  # (E,) int32, microseconds modulo 2^32
    x: np.ndarray  # (E,) int16
    y: np.ndarray  # (E,) int16
    p: np.ndarray  # (E,) bool
    window: np.ndarray  # (E,) int16, t B + b; T B for unused entries
    t_min: np.ndarray  # (T, B) int32, microseconds modulo 2^32
    duration: np.ndarray  # (T, B) float32, microseconds, at least 1


def capacity(events: int, at_least: int = 0) -> int:
    """The padded size for this many events. at_least: the last size, so that sizes only grow."""
    for size in CAPACITIES:
        if size >= max(events, at_least):
            return size
    return -(-events // CAPACITIES[-1]) * CAPACITIES[-1]


def pack(
    windows: Sequence[Sequence[Events]], size: int | None = None, bounds: np.ndarray | None = None
) -> Packed:
    """T rows of B windows -> one flat list for the device.

    size: padded length, at least the number of events; None: `capacity` of that number.
    bounds: (T, B, 2) int64 microseconds, t_min and t_max of each window; None: its least and
    greatest time.
    Raises TypeError for windows that are no Events.
    Raises ValueError if rows are missing or of unequal length, if columns are of another kind than
    those of `Events`, if bounds are of another shape, not whole or end before they begin, if the
    events do not fit into `size`, or if there are 2^15 windows or more.
    """
    if isinstance(windows, Events) or windows and isinstance(windows[0], Events):
        raise TypeError("windows are T rows of B Events each: of one window, pass [[events]]")
    if not windows or not windows[0] or {len(row) for row in windows} != {len(windows[0])}:
        raise ValueError("windows are T rows of B windows each, T and B at least 1")
    shape = len(windows), len(windows[0])
    flat = [window for row in windows for window in row]
    if others := [window for window in flat if not isinstance(window, Events)]:
        raise TypeError(f"windows are T rows of B Events each, not of a {type(others[0]).__name__}")
    for name, kind in (("t", np.integer), ("x", np.int16), ("y", np.int16), ("p", np.bool_)):
        # Seconds would become one time, column 2^16 would become 0, and -1 true as 1 is.
        if not all(np.issubdtype(getattr(window, name).dtype, kind) for window in flat):
            raise ValueError(
                "events are t int64 whole microseconds, x and y int16, p bool: make them by "
                f"Events.of ({name} is of another kind)"
            )
    counts = np.array([len(window) for window in flat])
    size = capacity(counts.sum()) if size is None else size
    if counts.sum() > size:
        raise ValueError(f"{counts.sum()} events do not fit into a list of {size}")
    if len(flat) >= 2**15:
        raise SettingsError(
            f"a chunk of {shape[0]} x {shape[1]} windows is too large: ask for a smaller chunk or "
            f"batch, fewer than {2**15} windows at once"
        )
    if bounds is None:
        bounds = np.array([(w.t.min(), w.t.max()) if len(w) else (0, 0) for w in flat], np.int64)
    elif np.shape(bounds) != (*shape, 2) or np.asarray(bounds).dtype.kind not in "iu":
        raise ValueError(f"bounds are whole microseconds of shape {(*shape, 2)}")
    t_min, t_max = np.asarray(bounds, np.int64).reshape(-1, 2).T
    if (t_min > t_max).any():
        raise ValueError("bounds are t_min and t_max: a window ends before it begins")

    packed = Packed(
        *_columns(size, (np.int32, np.int16, np.int16, bool, np.int16)),
        t_min=t_min.astype(np.int32).reshape(shape),
        duration=np.maximum(t_max - t_min, 1).astype(np.float32).reshape(shape),
    )
    stops = np.cumsum(counts)
    starts = stops - counts

    def copy_times():
        for number, window in enumerate(flat):
            times, span = window.t, int(t_max[number] - t_min[number])
            if span >= 2**31:
                # The device subtracts modulo 2^32, which is exact below 36 minutes. A longer
                # window uses coarser units; float32 could not tell the difference.
                coarser = span.bit_length() - 31
                times = (times - t_min[number]) >> coarser
                packed.t_min.flat[number] = 0
                packed.duration.flat[number] = span >> coarser
            place = slice(starts[number], stops[number])
            np.copyto(packed.t[place], times, casting="unsafe")  # modulo 2^32

    # Half of the bytes are times. In a long list another thread copies them at the same time.
    times_copied = _helper(os.getpid()).submit(copy_times) if size >= BLOCK else copy_times()
    for number, window in enumerate(flat):
        place = slice(starts[number], stops[number])
        packed.x[place] = window.x
        packed.y[place] = window.y
        packed.p[place] = window.p
        packed.window[place] = number
    packed.window[counts.sum() :] = len(flat)
    if times_copied is not None:
        times_copied.result()
    return packed


# How the arrays of `pack_for_devices` are sharded.
PACKED_SPECS = Packed._make([BATCH] * 5 + [TIME_BATCH] * 2)


def pack_for_devices(
    windows: Sequence[Sequence[Events]], devices: int, at_least: int = 0
) -> Packed:
    """T rows of B windows -> one list per device, of B / devices recordings, concatenated.

    at_least: entries of a list, as in `capacity`.
    """
    share = len(windows[0]) // devices
    parts = [[row[k * share :][:share] for row in windows] for k in range(devices)]
    events = max(sum(len(window) for row in part for window in row) for part in parts)
    lists = [pack(part, capacity(events, at_least)) for part in parts]
    if devices == 1:
        return lists[0]
    along = {"t_min": 1, "duration": 1}
    columns = zip(Packed._fields, zip(*lists, strict=True), strict=True)
    return Packed(*(np.concatenate(column, along.get(name, 0)) for name, column in columns))


def _columns(size: int, kinds: Sequence[type]) -> list[np.ndarray]:
    """Empty arrays of one length that share a block of memory, each aligned to 64 bytes.

    XLA's CPU backend uses aligned arrays in place and copies others (1 to 2 ms for a million
    events). numpy requests huge pages for one large block, but not for several smaller ones.
    """
    starts = [0]
    for kind in kinds:
        starts.append(starts[-1] + -(-size * np.dtype(kind).itemsize // 64) * 64)
    block = np.empty(starts[-1] + 64, np.uint8)
    block = block[-block.ctypes.data % 64 :]
    return [
        block[start : start + size * np.dtype(kind).itemsize].view(kind)
        for start, kind in zip(starts, kinds, strict=False)
    ]


@partial(jax.jit, static_argnames=("height", "width"))
def voxelise(packed: Packed, *, height: int, width: int) -> jax.Array:
    """Packed events -> event tensors (T, B, H, W, 5) float32, not normalised (Eq. 1).

    Every event votes in the two bins around its time. Events outside the sensor are ignored. If all
    events of a window have the same time, they vote in bin 0. An empty window gives zeros.
    Raises SettingsError if the tensors would have 2^31 numbers or more.
    """
    steps, batch = packed.t_min.shape
    windows, plane = steps * batch, height * width
    even, odd = (BINS + 1) // 2, BINS // 2  # how many bins have even numbers and odd ones
    one = jnp.float32(1)  # 1.0 would be float64 where a program has jax_enable_x64
    if BINS * windows * plane >= 2**31:
        raise SettingsError(
            f"{windows} windows of {width}x{height} are too many for one chunk: use a smaller one"
        )

    def vote(planes, columns):
        t, x, y, p, window = columns
        # Unused entries index past the end of t_min: JAX clamps the index, and below the vote is
        # dropped.
        # As unsigned integers, negative coordinates lie outside too.
        window, x, y = (column.astype(jnp.uint32) for column in (window, x, y))
        since = t - jnp.ravel(packed.t_min)[window]  # int32: exact, modulo 2^32
        t_star = (BINS - 1) * since.astype(jnp.float32) / jnp.ravel(packed.duration)[window]
        seen = (x < width) & (y < height) & (window < windows)
        pixel = jnp.where(seen, (window * height + y) * width + x, jnp.uint32(2**31))

        # The triangle is non-zero only in the two bins around t*, one even and one odd: two
        # independent sums, which a CPU runs in parallel. One plane per bin, so that consecutive
        # events, close in time, vote close in memory.
        sums = []
        for first, (bins, planes_of) in enumerate(zip((even, odd), planes, strict=True)):
            k = jnp.floor((t_star + 1 - first) / 2)  # of bins first, first + 2, ... the one near t*
            votes = jnp.where(p, one, -one) * (1 - jnp.abs(2 * k + first - t_star))
            k = jnp.clip(k, -1, bins).astype(jnp.int32).astype(jnp.uint32)
            place = k * (windows * plane) + pixel  # indices past the end are dropped
            sums.append(planes_of.at[place].add(votes, mode="drop"))
        return tuple(sums), None

    # A segment sum, block by block, so that a block's votes stay in a CPU's cache. XLA's CPU
    # backend runs operations in parallel only if more than eight are ready, so the loop is
    # unrolled. Accelerators take the list as one block.
    size = packed.t.shape[0]
    block = BLOCK if jax.default_backend() == "cpu" and size % BLOCK == 0 else size
    columns = jax.tree.map(lambda column: column.reshape(-1, block), packed[:5])
    nothing = tuple(jnp.zeros(bins * windows * plane, jnp.float32) for bins in (even, odd))
    planes, _ = jax.lax.scan(vote, nothing, columns, unroll=BLOCKS)
    planes = [sums.reshape(-1, 1, steps, batch, height, width) for sums in planes]
    in_order = [planes[number % 2][number // 2] for number in range(BINS)]
    # Concatenated, then transposed: twice as fast as jnp.stack.
    return jnp.concatenate(in_order).transpose(1, 2, 3, 4, 0)


def normalise(tensors: jax.Array) -> jax.Array:
    """(..., H, W, bins) float -> the same, non-zero entries scaled to mean 0 and standard deviation
    1.

    Each window by itself, over all bins, with the population standard deviation, as in the original
    program (the paper says "unit norm"). If the deviation is below 1e-6 the result is zero, so that
    empty windows and windows with a single value stay finite.
    Floats of fewer than 32 bits, of which the sums would overflow, become float32.
    Raises ValueError for fewer than three axes.
    """
    check_arrays(tensors=tensors)
    if jnp.ndim(tensors) < 3:
        raise ValueError(f"event tensors are (..., H, W, bins), not {jnp.shape(tensors)}")
    axes = (-3, -2, -1)
    tensors = jnp.asarray(tensors, jnp.promote_types(jnp.result_type(tensors), jnp.float32))
    voted = tensors != 0
    count = jnp.maximum(voted.sum(axes, keepdims=True), 1).astype(tensors.dtype)
    mean = tensors.sum(axes, keepdims=True) / count
    centred = jnp.where(voted, tensors - mean, 0.0)
    variance = (centred**2).sum(axes, keepdims=True) / count
    usable = ~(variance < 1e-12)  # what is not finite stays so, and is not taken for nothing
    return jnp.where(usable, centred / jnp.sqrt(jnp.where(usable, variance, 1.0)), 0.0)


def event_tensors(
    recording: Recording, *, chunk: int = 8, **windows
) -> Iterator[tuple[jax.Array, np.ndarray]]:
    """Recording -> chunks of (tensors (T, 1, H, W, 5) float32, not normalised, times (T,) int64).

    times: microseconds, that of each window's last event; for an empty window, its end.
    chunk: T. The last chunk may be shorter, which compiles your functions for that length too.
    windows: one of events_per_pixel=0.35 (the default), events (a number), duration (milliseconds)
    or frame_to_frame=True; see `windows.Windows` for more.
    Raises ValueError for invalid windows, RecordingError if the file is damaged.
    """
    if chunk < 1 or chunk % 1:
        raise ValueError(f"chunk is {chunk}, but must be 1 or more windows")
    check_recording(recording)
    for group, tensors in tensor_chunks(recording, cut(recording, Windows(**windows)), chunk):
        yield tensors[: len(group)], np.array([window.time for window in group], np.int64)


def tensor_chunks(
    recording: Recording, items: Iterator[Item], chunk: int
) -> Iterator[tuple[list[Item], jax.Array]]:
    """Windows or steps of a recording -> lists of `chunk` of them, the last one shorter, with
    tensors (chunk, 1, H, W, 5), not normalised; those of missing ones are zeros."""
    size = 0
    while group := list(itertools.islice(items, chunk)):
        rows = [[item.events] for item in group] + [[Events.empty()]] * (chunk - len(group))
        size = capacity(sum(len(row[0]) for row in rows), size)
        yield group, voxelise(pack(rows, size), height=recording.height, width=recording.width)
