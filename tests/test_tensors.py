import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import references

from firenet_jax import tensors
from firenet_jax.errors import SettingsError
from firenet_jax.events import Events, Recording
from firenet_jax.tensors import (
    BLOCK,
    CAPACITIES,
    capacity,
    event_tensors,
    normalise,
    pack,
    pack_for_devices,
    tensor_chunks,
    voxelise,
)
from firenet_jax.windows import Windows, cut


def random_events(rng, count, height=12, width=17, start=10**15, span=50_000):
    return Events.of(
        np.sort(start + rng.integers(0, span, count)),
        rng.integers(0, width, count),
        rng.integers(0, height, count),
        rng.random(count) < 0.5,
    )


def tensor_of(events, height=12, width=17, **kwargs):
    return np.asarray(voxelise(pack([[events]], **kwargs), height=height, width=width))[0, 0]


@pytest.mark.parametrize("count", [1, 2, 3, 50, 3000])
def test_equals_the_double_loop(count):
    events = random_events(np.random.default_rng(count), count)
    expected = references.event_tensor(events, 12, 17)
    np.testing.assert_allclose(tensor_of(events), expected, atol=1e-5)


def test_ragged_windows_of_several_recordings_in_one_call():
    rng = np.random.default_rng(1)
    rows = [[random_events(rng, n) for n in counts] for counts in [(5, 0), (700, 31), (1, 2000)]]
    tensors = np.asarray(voxelise(pack(rows), height=12, width=17))
    assert tensors.shape == (3, 2, 12, 17, 5)
    for t, row in enumerate(rows):
        for b, events in enumerate(row):
            expected = references.event_tensor(events, 12, 17)
            np.testing.assert_allclose(tensors[t, b], expected, atol=1e-5)


def test_events_outside_the_sensor_vote_nowhere():
    events = Events.of([0, 1, 2, 3, 4], [-1, 17, 3, 3, 2], [5, 5, -1, 12, 2], [1, 1, 1, 1, 1])
    tensor = tensor_of(events)
    np.testing.assert_allclose(tensor, references.event_tensor(events, 12, 17), atol=1e-6)
    assert tensor[2, 2, 4] == 1 and np.abs(tensor).sum() == 1


def test_with_bounds_the_order_of_events_does_not_matter():
    rng = np.random.default_rng(2)
    events = random_events(rng, 400)
    bounds = np.array([[[events.t[0], events.t[-1]]]])
    shuffled = tensor_of(events.select(rng.permutation(400)), bounds=bounds)
    np.testing.assert_allclose(shuffled, tensor_of(events), atol=1e-5)


def test_equal_times_all_vote_in_the_first_bin():
    events = Events.of([7] * 10, [1] * 10, [2] * 10, [1] * 7 + [0] * 3)
    tensor = tensor_of(events)
    assert tensor[2, 1].tolist() == [4, 0, 0, 0, 0] and np.count_nonzero(tensor) == 1


def test_empty_window_gives_zeros():
    assert not tensor_of(Events.empty()).any()


@pytest.mark.parametrize("bounds", [(0, 1000), (-500, 700), (200, 600)])
def test_explicit_bounds(bounds):
    """Events before and after the bounds vote by the triangle of Eq. 1, one bin away at most."""
    events = random_events(np.random.default_rng(3), 300, start=0, span=1000)
    expected = references.event_tensor(events, 12, 17, bounds)
    actual = tensor_of(events, bounds=np.array([[bounds]]))
    np.testing.assert_allclose(actual, expected, atol=1e-5)


def test_a_window_longer_than_int32_microseconds():
    """Two hours between two events; and a short window in the same chunk stays exact."""
    start, hours = 1_600_000_000_000_000, 7_200_000_000
    t = start + np.array([0, hours // 4, hours // 3, hours])
    long = Events.of(t, [1, 2, 3, 4], [1, 2, 3, 4], [1, 0, 1, 1])
    short = random_events(np.random.default_rng(4), 50, start=start, span=11)
    tensors = np.asarray(voxelise(pack([[long], [short]]), height=12, width=17))[:, 0]
    np.testing.assert_allclose(tensors[0], references.event_tensor(long, 12, 17), atol=1e-5)
    np.testing.assert_allclose(tensors[1], references.event_tensor(short, 12, 17), atol=1e-5)


@pytest.mark.parametrize("span", [2**31 - 1, 2**31, 2**31 + 1, 2**32 - 1, 2**32, 3 * 2**40 + 1])
def test_windows_about_as_long_as_int32_counts(span):
    t = 10**15 + np.array([0, span // 5, span // 2, span - span // 3, span])
    events = Events.of(t, range(5), range(5), [1, 0, 1, 1, 0])
    np.testing.assert_allclose(
        tensor_of(events), references.event_tensor(events, 12, 17), atol=1e-5
    )


def test_times_beyond_int32_lose_no_microsecond():
    """As float32 seconds all these times would be one."""
    start = 1_700_000_000_000_000
    events = Events.of(start + np.arange(5), np.arange(5), [0] * 5, [1] * 5)
    np.testing.assert_array_equal(tensor_of(events)[0, :5], np.eye(5))


def test_normalise_equals_numpy_and_ignores_scale():
    rng = np.random.default_rng(5)
    raw = [tensor_of(random_events(rng, n)) for n in (1, 2, 40, 4000)]
    tensors = jnp.asarray(np.stack(raw))
    expected = np.stack([references.normalised(np.asarray(t, np.float64)) for t in raw])
    actual = np.asarray(normalise(tensors))
    np.testing.assert_allclose(actual, expected, atol=1e-5)
    np.testing.assert_allclose(normalise(7.3 * tensors), actual, atol=1e-5)
    np.testing.assert_allclose(normalise(-tensors), -actual, atol=1e-5)
    for tensor in actual[2:]:
        np.testing.assert_allclose(tensor[tensor != 0].std(), 1, atol=1e-4)


@pytest.mark.parametrize("kind", [jnp.float16, jnp.bfloat16])
def test_normalise_of_half_precision_does_not_overflow(kind):
    """Beyond 65,504 a sum of float16 is infinite, and so is a count."""
    raw = np.random.default_rng(3).integers(-3, 4, (1, 120, 160, 5)) + 0.5
    actual = normalise(jnp.asarray(raw, kind))
    assert actual.dtype == jnp.float32
    np.testing.assert_allclose(actual[0], references.normalised(raw[0]), atol=1e-5)


def test_normalise_of_constant_and_empty_windows_is_zero():
    constant = jnp.zeros((2, 12, 17, 5)).at[0, 3, 3:9, 0].set(2.0)
    assert not np.asarray(normalise(constant)).any()


@pytest.mark.parametrize("deviation, zero", [(0.9e-6, True), (1.1e-6, False), (1e-3, False)])
def test_normalise_takes_a_deviation_below_a_millionth_for_none(deviation, zero):
    signs = np.sign(np.random.default_rng(0).normal(size=(6, 7, 5)))
    signs[0] = 0
    found = np.asarray(normalise(jnp.float32(deviation / signs[1:].std() * signs)))
    assert not found[0].any()
    expected = 0 if zero else (signs[1:] - signs[1:].mean()) / signs[1:].std()
    np.testing.assert_allclose(found[1:], np.broadcast_to(expected, found[1:].shape), atol=1e-3)


def test_normalise_at_sensor_size_in_float32():
    rng = np.random.default_rng(6)
    raw = tensor_of(random_events(rng, 200_000, 480, 640), 480, 640)
    expected = references.normalised(raw.astype(np.float64))
    np.testing.assert_allclose(normalise(jnp.asarray(raw)), expected, atol=1e-4)


def test_gradients_are_finite_through_an_empty_window():
    gradient = jax.grad(lambda x: (normalise(x) ** 2).sum())(jnp.zeros((4, 5, 5)))
    assert np.isfinite(gradient).all()


@pytest.mark.parametrize("width, many", [(20_724, False), (20_725, True)])
def test_places_that_32_bits_do_not_count_are_refused(width, many):
    packed = pack([[random_events(np.random.default_rng(0), 10)]])
    function = partial(voxelise, height=20_724, width=width)
    if many:
        with pytest.raises(SettingsError, match="too many for one chunk"):
            jax.eval_shape(function, packed)
    else:
        assert jax.eval_shape(function, packed).shape == (1, 1, 20_724, width, 5)


def test_float32_where_a_program_has_long_floats():
    events = random_events(np.random.default_rng(3), 200)
    expected = tensor_of(events)
    with jax.enable_x64(True):
        found = tensor_of(events)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, expected)


def test_without_programs():
    events = random_events(np.random.default_rng(3), 200)
    expected = tensor_of(events)
    with jax.disable_jit():
        np.testing.assert_allclose(tensor_of(events), expected, atol=1e-6)


def test_capacities_only_grow_and_are_few():
    assert capacity(1) == CAPACITIES[0]
    assert capacity(CAPACITIES[1] + 1) == CAPACITIES[2]
    assert capacity(1, at_least=CAPACITIES[3]) == CAPACITIES[3]
    assert capacity(CAPACITIES[-1] + 1) == 2 * CAPACITIES[-1]
    assert capacity(2**23 + 1) == 2**24  # memory counts there, so not 8 times as many
    with pytest.raises(ValueError, match="do not fit"):
        pack([[random_events(np.random.default_rng(0), 10)]], size=9)
    # up to 8 times as many as needed at first, from a million on at most twice
    assert [capacity(n) for n in (0, 2**14, 2**14 + 1, 2**17 + 1)] == [2**14, 2**14, 2**17, 2**20]
    assert [capacity(2**k) for k in range(20, 31)] == [2**k for k in range(20, 31)]
    assert capacity(2**30 + 1) == 3 * 2**29


def test_there_may_be_fewer_than_32768_windows_at_once():
    """Their numbers are int16, and one more is that of what is not used."""
    most = pack([[Events.empty()] * 7] * 4681)
    assert most.t_min.shape == (4681, 7) and (most.window == 2**15 - 1).all()
    with pytest.raises(SettingsError, match="fewer than 32768 windows at once"):
        pack([[Events.empty()] * 8] * 4096)


@pytest.mark.parametrize("rows", [[], [[]], [[Events.empty()], [Events.empty()] * 2]])
def test_what_is_no_table_of_windows_is_refused(rows):
    with pytest.raises(ValueError, match="T rows of B windows each"):
        pack(rows)


def test_events_in_seconds_are_refused():
    events = random_events(np.random.default_rng(0), 10)
    with pytest.raises(ValueError, match="whole microseconds"):
        pack([[Events(events.t / 1e6, events.x, events.y, events.p)]])


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no forks")
def test_packs_in_a_forked_process_too():
    """As workers of a data loader do: threads of the parent are not in them."""
    script = (
        "import os; import numpy as np; from firenet_jax.events import Events; "
        "from firenet_jax.tensors import pack; zeros = np.zeros(200_000, int); "
        "rows = [[Events.of(zeros, zeros, zeros, zeros)]]; pack(rows); child = os.fork(); "
        "child or (pack(rows), os._exit(0)); os._exit(os.waitpid(child, 0)[1])"
    )
    subprocess.run([sys.executable, "-W", "ignore", "-c", script], check=True, timeout=60)


def test_other_counts_do_not_recompile():
    rng = np.random.default_rng(7)
    voxelise.clear_cache()
    for count in (10, 100, 1000, 9999):
        tensor_of(random_events(rng, count))
    assert voxelise._cache_size() == 1


def test_a_list_of_several_blocks_is_the_sum_of_its_parts():
    """Each part fits into one block; of the whole, every block has events."""
    events = random_events(np.random.default_rng(8), 3 * BLOCK)
    bounds = np.array([[[events.t[0], events.t[-1]]]])
    parts = [events.select(slice(k * BLOCK, (k + 1) * BLOCK)) for k in range(3)]
    expected = sum(tensor_of(part, bounds=bounds) for part in parts)
    np.testing.assert_allclose(tensor_of(events), expected, atol=0.05)
    assert np.abs(expected).max() > 20


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="elsewhere a list is one block")
def test_a_list_is_summed_block_by_block():
    """For speed alone: the sums are the same."""
    events = random_events(np.random.default_rng(11), 10)
    for size, blocks in ((4 * BLOCK, 4), (BLOCK, 1), (CAPACITIES[0], 1)):
        program = jax.make_jaxpr(partial(voxelise, height=12, width=17))(pack([[events]], size))
        assert f" length={blocks} " in str(program).replace("\n", " "), (size, blocks)


@pytest.mark.parametrize("size", [10, 31, 33, None])
def test_lists_are_aligned(size):
    """XLA copies what is not."""
    events = random_events(np.random.default_rng(12), 10)
    packed = pack([[events]], size)
    assert [column.ctypes.data % 64 for column in packed[:5]] == [0] * 5
    assert {len(column) for column in packed[:5]} == {size or CAPACITIES[0]}
    for name in "xyp":
        np.testing.assert_array_equal(getattr(packed, name)[:10], getattr(events, name))
    assert (packed.window[:10] == 0).all() and (packed.window[10:] == 1).all()


def test_a_long_list_is_not_given_away_before_its_times_are_there(monkeypatch):
    """Another thread copies them, here a slow one."""
    pool, events = ThreadPoolExecutor(1), random_events(np.random.default_rng(9), 1000)

    def submit(task):
        return pool.submit(lambda: (time.sleep(0.2), task()))

    monkeypatch.setattr(tensors, "_helper", lambda process: SimpleNamespace(submit=submit))
    found = pack([[events]], BLOCK).t[:1000].copy()
    np.testing.assert_array_equal(found, events.t.astype(np.int32))


@pytest.mark.parametrize("devices", [1, 2, 3, 6])
def test_lists_for_devices_hold_their_recordings(devices):
    """Six recordings on some devices; t_min and duration stay (T, B)."""
    rng, size, share = np.random.default_rng(10), CAPACITIES[1], 6 // devices
    counts = (5, 70, 3, 40, 8, 0), (1, 20, 30, 2, 60, 9)
    rows = [[random_events(rng, n) for n in each] for each in counts]
    all_ = pack_for_devices(rows, devices, at_least=size)
    assert len(all_.t) == devices * size and all_.t_min.shape == all_.duration.shape == (2, 6)
    for k in range(devices):
        alone = pack([row[share * k :][:share] for row in rows], size)
        used = alone.window < 2 * share
        for ours, theirs in zip(all_[:5], alone[:5], strict=True):
            np.testing.assert_array_equal(ours[k * size :][:size][used], theirs[used])
        for ours, theirs in zip(all_[5:], alone[5:], strict=True):
            np.testing.assert_array_equal(ours[:, share * k :][:, :share], theirs)


def recording_of(windows, size=7):
    """Of these numbers of events, a millisecond each window, in chunks of any size."""
    t = np.concatenate([1000 * k + np.linspace(0, 999, n) for k, n in enumerate(windows)])
    rng = np.random.default_rng(0)
    events = Events.of(
        t.astype(np.int64), *rng.integers(0, [[17], [12]], (2, len(t))), rng.random(len(t)) < 0.5
    )
    chunks = [events.select(slice(k, k + size)) for k in range(0, len(t), size)]
    return Recording("memory", "memory", 12, 17, lambda: iter(chunks)), events


@pytest.mark.parametrize("chunk, lengths", [(1, [1] * 10), (4, [4, 4, 2]), (None, [8, 2])])
def test_a_recording_becomes_chunks_of_tensors_with_the_times_of_their_ends(chunk, lengths):
    counts = [30, 20, 0, 10, 25, 5, 40, 3, 2, 8]
    recording, events = recording_of(counts)
    chosen = {} if chunk is None else {"chunk": chunk}
    found = list(event_tensors(recording, duration=1, **chosen))
    assert [tensors.shape for tensors, _ in found] == [(n, 1, 12, 17, 5) for n in lengths]
    ends = np.cumsum(counts)
    times = np.concatenate([times for _, times in found])
    assert times.dtype == np.int64
    assert times.tolist() == [events.t[e - 1] if n else 3000 for e, n in zip(ends, counts)]  # noqa: B905
    tensors = np.concatenate([tensors for tensors, _ in found])[:, 0]
    for tensor, end, count in zip(tensors, ends, counts, strict=True):
        window = events.select(slice(end - count, end))
        np.testing.assert_allclose(tensor, references.event_tensor(window, 12, 17), atol=1e-5)


def test_a_shorter_last_chunk_is_filled_up_to_the_length_of_the_others():
    recording, _ = recording_of([30, 20, 0, 10, 25])
    chunks = list(tensor_chunks(recording, cut(recording, Windows(duration=1)), 2))
    assert [len(group) for group, _ in chunks] == [2, 2, 1]
    assert {tensors.shape for _, tensors in chunks} == {(2, 1, 12, 17, 5)}
    assert not np.asarray(chunks[-1][1][1]).any()


def test_a_chunk_holds_a_window_at_least():
    for chunk in (0, 2.5):
        with pytest.raises(ValueError, match=f"chunk is {chunk}, but must be 1 or more"):
            next(event_tensors(recording_of([5])[0], chunk=chunk))


def test_after_a_chunk_of_many_events_one_of_few_does_not_recompile():
    recording, _ = recording_of([CAPACITIES[0] + 1, 10, 20], size=1000)
    voxelise.clear_cache()
    assert len(list(event_tensors(recording, duration=1, chunk=1))) == 3
    assert voxelise._cache_size() == 1


def test_events_in_any_order_have_the_same_tensor():
    """Times of a window are its least and greatest."""
    events = random_events(np.random.default_rng(9), 300)
    mixed = events.select(np.random.default_rng(10).permutation(300))
    np.testing.assert_allclose(tensor_of(mixed), tensor_of(events), atol=1e-4)


@pytest.mark.parametrize(
    "name, column",
    [("p", np.array([-1, 1])), ("x", np.array([1.0, 2.0])), ("y", np.array([1.0, 2.0])),
     ("t", np.array([0.1, 0.2])), ("x", np.array([1, 2**16], np.int32))],
)  # fmt: skip
def test_columns_of_another_kind_are_refused(name, column):
    """-1 would become brighter, seconds one time, and column 2^16 column 0."""
    events = replace(Events.of([0, 5], [1, 2], [3, 4], [0, 1]), **{name: column})
    with pytest.raises(ValueError, match=rf"make them by Events.of \({name} is of another kind"):
        pack([[events]])


@pytest.mark.parametrize(
    "bounds, message",
    [([[[9, 0]]], "ends before it begins"), ([[[0.0, 0.05]]], "whole microseconds of shape"),
     ([[[0], [9]]], r"of shape \(1, 1, 2\)")],
)  # fmt: skip
def test_bounds_that_cannot_be_are_refused(bounds, message):
    with pytest.raises(ValueError, match=message):
        pack([[Events.of([0, 5], [1, 2], [3, 4], [0, 1])]], bounds=np.array(bounds))
