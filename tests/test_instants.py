"""Steps against a slow list of what each must hold; images against single steps of the network."""

import itertools
from functools import partial

import jax
import numpy as np
import pytest
from test_tensors import random_events

from firenet_jax import native
from firenet_jax.errors import RecordingError
from firenet_jax.events import Events, Recording
from firenet_jax.instants import Counts, Grid, Step, grid, in_parts, steps, warming
from firenet_jax.network import Weights, initial_params, initial_state, step
from firenet_jax.pictures import display, initial_display_state
from firenet_jax.reconstruction import (
    Committed,
    Looks,
    Network,
    events_to_pictures,
    images_at,
    initial_session,
    reconstruct,
    reconstruct_at,
)
from firenet_jax.tensors import normalise, pack, voxelise
from firenet_jax.windows import Window, Windows, cut

HEIGHT, WIDTH = 12, 17
FIRST = 10**15


def recording_of(events, chunk=50):
    parts = [events.select(slice(i, i + chunk)) for i in range(0, len(events), chunk)]
    return Recording("memory", "memory", HEIGHT, WIDTH, lambda: iter(parts), len(events))


@pytest.fixture
def recording():
    """700 events in 50 ms, more and more of them, and some at the same time."""
    rng = np.random.default_rng(0)
    events = random_events(rng, 700, HEIGHT, WIDTH)
    t = FIRST + (events.t - FIRST) ** 2 // 50_000
    return recording_of(Events(t // 10 * 10, events.x, events.y, events.p))


@pytest.mark.parametrize("count, parts", [(0, 1), (1, 1), (149, 1), (151, 2), (249, 2), (1001, 10)])
def test_a_dense_window_is_cut_into_equal_parts_of_half_an_event_per_pixel(count, parts):
    """Of 200 pixels. All events, in order; the last part has the image."""
    events = random_events(np.random.default_rng(count), count, 10, 20)
    made = in_parts(Step(events, 77, 1.0), 200)
    sizes = [len(step.events) for step in made]
    assert len(made) == parts and max(sizes) - min(sizes) <= 1
    for name in "txyp":
        columns = [getattr(step.events, name) for step in made]
        np.testing.assert_array_equal(np.concatenate(columns), getattr(events, name))
    assert [step.time for step in made] == [None] * (parts - 1) + [77]
    assert [step.earlier for step in made] == [0, *np.cumsum(sizes)[:-1]]
    assert all(s.earlier + len(s.events) + s.later == count for s in made)


WAYS = [{"events": 90}, {"events": 90, "longest": 4.0}, {"duration": 7.3}]


def whole(recording):
    parts = list(recording.events())
    return Events(*(np.concatenate([getattr(part, name) for part in parts]) for name in "txyp"))


def expected(recording, windows, time):
    """(times of the events, share) at a time, with all windows at hand."""
    events = whole(recording)
    kept = [window.events.t for window in cut(recording, windows)]
    if windows.duration is None:
        begins = [t[0] for t in kept]
    else:
        begins = [events.t[0] + round(k * windows.duration * 1000) for k in range(len(kept))]
    number = max(k for k, begin in enumerate(begins) if begin <= time)
    passed = [t for t in kept[number] if t <= time]
    if number == 0:
        return passed, 1.0
    shares = [len(passed) / windows.events] if windows.events else []
    if windows.longest or windows.duration:
        shares.append((time - begins[number]) / 1000 / (windows.longest or windows.duration))
    share = min(max(shares), 1.0)
    before = kept[number - 1]
    return before[int(share * len(before)) :].tolist() + passed, share


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("chunk", [13, 1000])
def test_steps_hold_what_they_say(recording, way, chunk):
    windows, events = Windows(**way), whole(recording)
    recording = recording_of(events, chunk)
    times = np.arange(events.t[0] - 500, events.t[-1] + 700, 333)
    counts = Counts()
    found = list(steps(recording, windows, times, counts=counts))
    kept = [s.events.t.tolist() for s in found if s.time is None]
    assert kept == [window.events.t.tolist() for window in cut(recording, windows)]
    looks = [s for s in found if s.time is not None]
    inside = times[(times >= events.t[0]) & (times <= events.t[-1])]
    assert [s.time for s in looks] == inside.tolist()
    assert (counts.seen, counts.early, counts.late) == (
        len(inside),
        2,
        (times > events.t[-1]).sum(),
    )
    for look in looks:
        held, share = expected(recording, windows, look.time)
        assert look.events.t.tolist() == held and look.share == pytest.approx(share)
        assert look.events.t.max() <= look.time  # never the future
    if windows.events and windows.longest is None:  # a look is as long as a window
        assert {len(s.events) for s in looks if s.time > kept[1][0]} <= set(range(89, 92))


@pytest.mark.parametrize("way", WAYS[:2])
def test_just_before_a_step_is_kept_and_just_after_the_look_is_that_step(recording, way):
    windows = Windows(**way)
    kept = [window.events for window in cut(recording, windows)]
    ends = [events.t[-1] for events in kept]
    begins = [events.t[0] for events in kept]
    found = {s.time: s for s in steps(recording, windows, sorted({*ends, *begins})) if s.time}
    for number in range(1, len(kept) - 1):
        if ends[number] < begins[number + 1] and len(kept[number]) == windows.events:
            assert found[ends[number]].share == 1.0
            assert found[ends[number]].events.t.tolist() == kept[number].t.tolist()
        look = found[begins[number]]
        assert look.share < 0.1 and abs(len(look.events) - len(kept[number - 1])) < 9


def test_a_grid_is_rounded_alone_and_coarser_ones_lie_in_it():
    take = lambda g, n: [next(g) for _ in range(n)]  # noqa: E731
    assert take(grid(7, 30), 4) == [7, 33340, 66674, 100007]
    coarse, fine = take(grid(FIRST, 30), 50), take(grid(FIRST, 3000), 5000)
    assert coarse == fine[::100]
    assert take(grid(50_000, 30, from_zero=True), 2) == [66667, 100000]
    assert take(grid(-50_000, 30, from_zero=True), 3) == [-33333, 0, 33333]
    assert take(grid(0, 0.1), 2) == [0, 10**7]
    for first in (0.5, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=f"first is {first}, but must be whole microseconds"):
            grid(first, 30)
    for rate in (0, -1, float("nan"), 2e6):
        with pytest.raises(ValueError, match="rate is"):
            grid(0, rate)


def test_damage_is_told_after_what_came_before_it(recording):
    def damaged():
        yield from recording.events()
        raise RecordingError("here")

    found = []
    with pytest.raises(RecordingError, match="here"):
        windows = cut(recording, Windows(events=90), damaged())
        for entry in steps(recording, Windows(events=90), Grid(FIRST, 1000), windows):
            found.append(entry)
    kept = [s for s in found if s.time is None]
    assert len(kept) == 7 and len([s for s in found if s.time]) > 7


@pytest.mark.parametrize("way", [{"frame_to_frame": True}, {"events": 9, "step": 3}])
def test_windows_that_are_of_no_use_for_it(recording, way):
    with pytest.raises(ValueError, match="images at given times"):
        next(steps(recording, Windows(**way), [1]))


def test_what_follows_the_last_time_is_not_looked_at(recording):
    found = list(steps(recording, Windows(events=90), [FIRST + 30_000]))
    wanted = next(k for k, step in enumerate(found) if step.time is not None)
    assert 0 < wanted < 6 and len(found) == wanted + 2  # and the window in which it lies


def test_no_events_and_windows_without_any():
    assert list(steps(recording_of(Events.empty()), Windows(events=5), [1])) == []
    t = np.array([0, 1, 9_000], np.int64) + FIRST
    events = Events.of(t, t * 0, t * 0, t % 2)
    found = list(steps(recording_of(events), Windows(duration=2), FIRST + np.arange(0, 9001, 1000)))
    assert len([s for s in found if s.time is None]) == 5
    assert [len(s.events) for s in found if s.time] == [1, 2, 2, 1, 0, 0, 0, 0, 0, 1]


def test_the_beginning_is_shown_forwards_and_backwards(recording):
    windows = list(cut(recording, Windows(events=90)))
    first, again = warming(iter(windows), 10**6, 3)
    assert list(again) == windows
    assert [(step.time, step.share) for step in first] == [(None, 1.0)] * 6
    shown = [voxelise(pack([[s.events]]), height=HEIGHT, width=WIDTH)[0, 0] for s in first]
    for k in range(3):
        assert first[k].events is windows[k].events
        events, back = windows[k].events, first[5 - k].events
        assert (
            back.t[0] == events.t[0] and back.t[-1] == events.t[-1] and (np.diff(back.t) >= 0).all()
        )
        np.testing.assert_allclose(shown[5 - k], -shown[k][..., ::-1], atol=1e-4)


@pytest.mark.parametrize(
    "pixels, count, expected",
    [(10**6, 0, 0), (10**6, 99, 8), (33, 5, 3), (33, 20, 3), (33, 40, 6), (1, 99, 1)],
)
def test_no_more_of_the_beginning_is_kept_than_memory_should_hold(
    recording, pixels, count, expected
):
    """8 windows of 90 events; 0.4 per pixel in 20 windows are 264 for 33 pixels, in 40 528.
    Where fewer than 20 are asked for they may hold as much as 20."""
    assert len(warming(cut(recording, Windows(events=90)), pixels, count)[0]) == 2 * expected


def test_damage_of_the_beginning_is_told_after_what_came_before_it():
    def damaged():
        yield 1
        yield 2
        raise RecordingError("here")

    def windows():
        for number in damaged():
            yield Window(Events.of([number], [0], [0], [1]), number)

    first, again = warming(windows(), 10**6, 20)
    assert [int(step.events.t[0]) for step in first] == [1, 2, 2, 1]
    assert [next(again).time, next(again).time] == [1, 2]
    with pytest.raises(RecordingError, match="here"):
        next(again)


def test_there_may_be_no_beginning():
    first, again = warming(cut(recording_of(Events.empty()), Windows(events=9)), 100, 20)
    assert first == [] and list(again) == []
    assert len(Events.empty().backwards()) == 0


# ---- Images


@pytest.fixture(scope="module")
def weights():
    return Weights(initial_params(jax.random.key(0)), True)


def slowly(weights, recording, windows, times):
    """Step by step, outside of any scan, by XLA alone."""
    zero = initial_state(1, HEIGHT, WIDTH)
    before, last, images = zero, zero, []
    one = jax.jit(lambda state, tensor: step(weights.params, state, normalise(tensor)))

    def run(state, events):
        # Of as many windows: a vote of 0 may be rounded to 1e-8 elsewhere, and counts where
        # tensors are normalised.
        packed = pack([[events]] + [[Events.empty()]] * 4)
        return one(state, voxelise(packed, height=HEIGHT, width=WIDTH)[0])

    for entry in steps(recording, windows, times):
        if entry.time is None:
            before, (last, _) = last, run(last, entry.events)
        else:
            between = [(1 - entry.share) * a + entry.share * b for a, b in zip(before, last)]  # noqa: B905
            images.append(run(type(last)(*between), entry.events)[1][0])
    return np.stack(images)


@pytest.mark.parametrize("machine_code", [True, False])
def test_images_are_those_of_single_steps(weights, recording, machine_code, monkeypatch):
    if not machine_code:
        monkeypatch.setenv("FIRENET_NATIVE", "0")
        jax.clear_caches()
    times = np.arange(FIRST + 3000, FIRST + 45_000, 3501)
    found = list(images_at(weights, recording, times, chunk=5, warm_up=0, events=90))
    if not machine_code:
        jax.clear_caches()
    assert np.concatenate([t for t, _ in found]).tolist() == times.tolist()
    with native.by_xla_alone():
        wanted = slowly(weights, recording, Windows(events=90), times)
    # machine code multiplies by Winograd's way, as in test_native.py
    atol = 2e-5 if machine_code else 2e-6
    np.testing.assert_allclose(np.concatenate([i for _, i in found]), wanted, atol=atol)


def test_an_image_does_not_depend_on_the_others_that_are_asked_for(weights, recording):
    found = {}
    for rate, chunk in ((200, 8), (2000, 8), (650, 8)):
        series = images_at(weights, recording, grid(FIRST, rate), chunk=chunk, events=90)
        found[rate, chunk] = {t: i for times, images in series for t, i in zip(times, images)}  # noqa: B905
    for other in ((2000, 8), (650, 8)):
        common = found[200, 8].keys() & found[other].keys()
        assert len(common) >= 3
        for time in common:
            np.testing.assert_allclose(found[200, 8][time], found[other][time], atol=1e-6)


def test_images_after_the_warm_up_are_those_of_a_state_that_has_seen_the_beginning(
    weights, recording
):
    """In tensors: the bins the other way round, the votes negated."""
    tensors = [
        voxelise(pack([[window.events]]), height=HEIGHT, width=WIDTH)
        for window in cut(recording, Windows(events=90))
    ]
    state = initial_state(1, HEIGHT, WIDTH)
    for tensor in [*tensors[:4], *(-tensor[..., ::-1] for tensor in reversed(tensors[:4]))]:
        state, _ = reconstruct(weights, state, tensor)
    wanted = []
    for tensor in tensors:
        state, image = reconstruct(weights, state, tensor)
        wanted.append(image[0, 0])
    # at the ends of windows a look is the step that keeps them
    ends = [int(window.events.t[-1]) for window in cut(recording, Windows(events=90))]
    keeping = np.flatnonzero(np.diff([*ends, ends[-1] + 1]) > 0)
    starts = [int(window.events.t[0]) for window in cut(recording, Windows(events=90))]
    clear = [k for k in keeping if k + 1 == len(ends) or starts[k + 1] > ends[k]]
    found = images_at(weights, recording, [ends[k] for k in clear], chunk=3, warm_up=4, events=90)
    images = np.concatenate([images for _, images in found])
    assert len(clear) >= 4
    np.testing.assert_allclose(images[:-1], np.stack(wanted)[clear][:-1], atol=2e-5)


@pytest.mark.parametrize(
    "per_pixel, asked, used",
    [(0.35, 20, 20), (0.35, 40, 40), (1.0, 20, 9), (1.0, 40, 17), (9, 4, 1)],
)
def test_a_warm_up_keeps_as_many_windows_as_are_asked_for_unless_they_are_dense(
    per_pixel, asked, used
):
    events = Events.of(*np.zeros((4, int(100 * per_pixel)), int))
    first, again = warming((Window(events, k) for k in range(50)), 100, asked)
    assert len(first) == 2 * used
    assert [window.time for window in again] == list(range(50))


def test_recordings_side_by_side_and_steps_that_are_not_there(weights):
    """Three recordings of 6, 4 and 0 steps, of which some look, against each alone."""
    rng = np.random.default_rng(1)
    tensors = rng.normal(size=(6, 3, HEIGHT, WIDTH, 5)).astype(np.float32)
    looks, share = rng.random((6, 3)) < 0.5, rng.random((6, 3)).astype(np.float32)
    lengths = np.array([6, 4, 0])
    valid = np.arange(6)[:, None] < lengths[None]
    zero = initial_state(3, HEIGHT, WIDTH)
    after, images = reconstruct_at(
        weights, Committed(zero, zero), tensors, Looks(looks, share), valid
    )
    for b, length in enumerate(lengths):
        alone = initial_state(1, HEIGHT, WIDTH)
        state = Committed(alone, alone)
        for t in range(length):
            part = Looks(looks[t : t + 1, b : b + 1], share[t : t + 1, b : b + 1])
            state, image = reconstruct_at(weights, state, tensors[t : t + 1, b : b + 1], part)
            np.testing.assert_allclose(images[t, b], image[0, 0], atol=1e-6)
        for ours, theirs in zip(jax.tree.leaves(after), jax.tree.leaves(state), strict=True):
            np.testing.assert_allclose(ours[b], theirs[0], atol=1e-6)


def test_steps_that_are_all_kept_are_those_of_reconstruct(weights):
    tensors = np.random.default_rng(2).normal(size=(4, 1, HEIGHT, WIDTH, 5)).astype(np.float32)
    zero = initial_state(1, HEIGHT, WIDTH)
    other = reconstruct(weights, zero, tensors)[0]
    for recurrent, begun in ((True, zero), (False, other)):
        state, wanted = reconstruct(weights, begun, tensors, recurrent=recurrent)
        kept = Looks(np.zeros((4, 1), bool), np.ones((4, 1), np.float32))
        after, images = reconstruct_at(
            weights, Committed(begun, begun), tensors, kept, recurrent=recurrent
        )
        np.testing.assert_allclose(images, wanted, atol=1e-6)
        np.testing.assert_allclose(after.last.g2, state.g2, atol=1e-6)


LOOKS = (True, 2, True), pytest.param(False, 1, False, marks=pytest.mark.slow)


@pytest.mark.parametrize("recurrent, pad, wanted", LOOKS)
def test_pictures_of_looks_are_those_of_their_images(recurrent, pad, wanted):
    """Tensors are normalised, then padded; the display forgets the images of what is kept."""
    rng = np.random.default_rng(5)
    height, width = 11, 17
    rows = [[random_events(rng, n, height, width) for n in (80, 150)] for _ in range(5)]
    looks, share = rng.random((5, 2)) < 0.6, rng.random((5, 2)).astype(np.float32)
    valid = np.arange(5)[:, None] < [5, 4]
    weights = Weights(initial_params(jax.random.key(1)), normalise=wanted)
    network = Network(recurrent=recurrent, pad=pad)
    session = initial_session(2, height, width, network, at_times=True)
    call = partial(
        events_to_pictures, weights, session, pack(rows), valid, Looks(looks, share),
        height=height, width=width, network=network,
    )  # fmt: skip
    tensors = voxelise(pack(rows), height=height, width=width)
    tensors = normalise(tensors) if wanted else tensors
    padded = np.pad(tensors, ((0, 0), (0, 0), *[(pad - 1, 0)] * 2, (0, 0)), "reflect")
    zero = initial_state(2, *padded.shape[2:4])
    plain = Weights(weights.params, normalise=False)
    after, images = reconstruct_at(
        plain, Committed(zero, zero), padded, Looks(looks, share), valid, recurrent=recurrent
    )
    shown = display(initial_display_state(2), images, valid & looks)[1]
    seen = valid & looks
    assert seen.sum() >= 4
    for raw, expected, atol in ((False, shown, 1), (True, images, 2e-5)):
        found_session, found = call(raw=raw)
        expected = np.asarray(expected, float)[:, :, pad - 1 :, pad - 1 :]
        np.testing.assert_allclose(np.float64(found)[seen], expected[seen], atol=atol)
        for ours, theirs in zip(found_session.network.last, after.last, strict=True):
            np.testing.assert_allclose(ours, theirs, atol=2e-5)


def test_bfloat16_is_close_at_given_times_too(weights):
    tensors = np.random.default_rng(6).normal(size=(2, 1, HEIGHT, WIDTH, 5)).astype(np.float32)
    zero = initial_state(1, HEIGHT, WIDTH)
    looks = Looks(np.array([[False], [True]]), np.ones((2, 1), np.float32))
    exact, rough = (
        reconstruct_at(weights, Committed(zero, zero), tensors, looks, dtype=dtype)[1]
        for dtype in (np.float32, jax.numpy.bfloat16)
    )
    assert 1e-4 < np.abs(exact - rough).max() < 0.05


def test_nothing_recompiles_as_data_flows(weights, recording):
    reconstruct_at.clear_cache()
    voxelise.clear_cache()
    for rate in (40, 333, 1000):
        list(images_at(weights, recording, grid(FIRST, rate), chunk=4, events=90, longest=9))
    assert reconstruct_at._cache_size() == 1 and voxelise._cache_size() <= 2


def test_seconds_are_no_times(weights, recording, caplog):
    for times in ([0.5], np.array([1e5, 5e5 + 0.7]), [float("nan")]):
        with pytest.raises(ValueError, match="whole microseconds"):
            list(images_at(weights, recording, times))
    assert len(list(images_at(weights, recording, np.array([float(FIRST)])))) == 1
    assert len(list(images_at(weights, recording, [0, FIRST, 2**60]))) == 1
    assert not caplog.text  # where some are outside and some are not
    assert not list(images_at(weights, recording, [0, 2**60]))
    assert "1 before the first event, 1 after the last" in caplog.text


def test_a_grid_can_be_used_again_and_one_that_begins_too_late_is_told(weights, recording, caplog):
    times = grid(FIRST, 1000)
    found = [list(images_at(weights, recording, times, chunk=n, events=90)) for n in (4, 1)]
    np.testing.assert_array_equal(*(np.concatenate([t for t, _ in each]) for each in found))
    assert found[0] and not caplog.text
    assert not list(images_at(weights, recording, grid(2 * FIRST, 1000), chunk=4, events=90))
    assert "0 before the first event, 1 after the last" in caplog.text


def at_times(t):
    return Events.of(t, t * 0, t * 0, t % 2)


def test_a_rate_does_not_fill_a_pause_of_more_than_an_hour():
    early, late = np.arange(1000) * 100, 10**13 + np.arange(1000) * 100
    recording = recording_of(at_times(np.concatenate([early, late])), 100)
    found, counts = [], Counts()
    with pytest.raises(RecordingError, match="no event from 0.099900 to .* more than an hour"):
        for entry in steps(recording, Windows(events=100), grid(0, 1000), counts=counts):
            found.append(entry)
    assert [s.time for s in found if s.time is not None] == list(range(0, 100_000, 1000))
    with pytest.raises(RecordingError, match="no event from 0.099900 to 10000000.000000 s"):
        for entry in steps(recording, Windows(events=90), grid(0, 1000)):  # it is within a window
            assert entry.time is None or entry.time < 100_000
    asked = [500, 10**12, 10**13 + 50_000]
    looks = [s.time for s in steps(recording, Windows(events=100), asked) if s.time is not None]
    assert looks == asked


def test_times_before_the_first_event_are_skipped_at_once():
    recording = recording_of(at_times(10**15 + np.arange(1000) * 100))
    counts = Counts()
    times = [s.time for s in steps(recording, Windows(events=90), grid(3, 1000), counts=counts)]
    found = [time for time in times if time is not None]
    assert counts.early == 10**12 and counts.seen == len(found) == 100
    assert found[0] == 10**15 + 3


def test_an_endless_iterator_of_times_ends_with_the_recording(recording):
    events = whole(recording)
    counts = Counts()
    times = itertools.count(int(events.t[0]), 1000)
    found = [s.time for s in steps(recording, Windows(events=90), times, counts=counts) if s.time]
    assert found == list(range(int(events.t[0]), int(events.t[-1]) + 1, 1000))
    assert counts.late == 1


def test_impossible_choices(weights, recording):
    for chunk in (0, 2.5):
        with pytest.raises(ValueError, match=f"chunk is {chunk}"):
            next(images_at(weights, recording, [1], chunk=chunk))
    with pytest.raises(ValueError, match="warm_up is 1.5"):
        next(images_at(weights, recording, [1], warm_up=1.5))
    with pytest.raises(ValueError, match="warm_up is -1"):
        next(images_at(weights, recording, [1], warm_up=-1))
    with pytest.raises(ValueError, match="given times"):
        next(images_at(weights, recording, [1], frame_to_frame=True))
