import itertools
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from firenet_jax.errors import RecordingError
from firenet_jax.events import Events, Frames, Recording
from firenet_jax.windows import Windows, _grid_spans, cut, in_words, usual


def recording_of(t, frames=None, chunk=7, height=2, width=3):
    """A recording in memory whose events are numbered by x + 3 y, read in small chunks."""
    t = np.asarray(t, np.int64)
    events = Events.of(t, np.arange(len(t)) % 3, np.arange(len(t)) % 2, np.arange(len(t)) % 2)
    parts = [events.select(slice(i, i + chunk)) for i in range(0, len(t), chunk)]
    if frames is not None:
        frames = Frames(np.asarray(frames, np.int64), lambda i: None)
    return Recording("memory", "memory", height, width, lambda: iter(parts), len(t), frames)


def times_of(recording, **windows):
    return [window.events.t.tolist() for window in cut(recording, Windows(**windows))]


@pytest.mark.parametrize("chunk", [1, 4, 7, 100])
@pytest.mark.parametrize("count", [1, 3, 7, 50, 64, 200])
def test_by_count_takes_every_event_once(count, chunk):
    t = np.arange(64) * 10
    windows = list(cut(recording_of(t, chunk=chunk, height=40, width=3), Windows(events=count)))
    assert np.concatenate([w.events.t for w in windows]).tolist() == t.tolist()
    assert all(len(w.events) == count for w in windows[:-1])
    assert [w.time for w in windows] == [w.events.t[-1] for w in windows]


@pytest.mark.parametrize("chunk", [1, 4, 7, 100])
def test_by_count_with_overlap(chunk):
    recording = recording_of(range(10), chunk=chunk)
    assert times_of(recording, events=4, step=3) == [
        [0, 1, 2, 3], [3, 4, 5, 6], [6, 7, 8, 9],
    ]  # fmt: skip
    assert times_of(recording, events=4, step=2)[-1] == [6, 7, 8, 9]
    assert times_of(recording, events=4, step=4)[-1] == [8, 9]
    assert times_of(recording_of(range(11), chunk=chunk), events=4, step=3)[-1] == [9, 10]


def test_events_per_pixel_is_the_default():
    recording = recording_of(range(20))
    assert [len(w) for w in times_of(recording)] == [2] * 10  # 0.35 of 6 pixels
    assert [len(w) for w in times_of(recording, events_per_pixel=1.0)] == [6, 6, 6, 2]


@pytest.mark.parametrize("chunk", [1, 4, 7, 1000])
def test_by_duration_lies_on_a_grid_that_does_not_drift(chunk):
    rng = np.random.default_rng(0)
    t = 123 + np.sort(rng.integers(0, 100_000, 500))
    duration = 1.0003  # ms: a third of a microsecond off the grid each time
    windows = list(cut(recording_of(t, chunk=chunk), Windows(duration=duration)))
    assert np.concatenate([w.events.t for w in windows]).tolist() == t.tolist()
    edges = t[0] + np.rint(np.arange(len(windows) + 1) * duration * 1000).astype(int)
    for window, start, stop in zip(windows, edges[:-1], edges[1:], strict=True):
        assert window.events.t.tolist() == t[(t >= start) & (t < stop)].tolist()
    assert edges[-2] <= t[-1] < edges[-1]


def test_by_duration_keeps_empty_windows_and_the_last_partial_one():
    recording = recording_of([0, 1, 5_000, 5_400])
    assert times_of(recording, duration=2) == [[0, 1], [], [5_000, 5_400]]
    windows = list(cut(recording, Windows(duration=2)))
    assert [w.time for w in windows] == [1, 4_000, 5_400]


def test_by_duration_with_overlap():
    recording = recording_of(range(0, 10_000, 1_000), chunk=3)
    assert times_of(recording, duration=4, step=3) == [
        [0, 1000, 2000, 3000], [3000, 4000, 5000, 6000], [6000, 7000, 8000, 9000],
    ]  # fmt: skip


@pytest.mark.parametrize("chunk", [1, 4, 100])
def test_between_frames(chunk):
    recording = recording_of(range(0, 100, 5), frames=[20, 30, 40, 60], chunk=chunk)
    assert times_of(recording, frame_to_frame=True) == [
        [0, 5], [10, 15],  # the clock runs back to the first event
        [20, 25], [30, 35], [40, 45, 50, 55],
        [60, 65], [70, 75], [80, 85], [90, 95],  # and on after the last frame
    ]  # fmt: skip


def test_between_frames_starts_with_the_first_event():
    recording = recording_of(range(31, 60), frames=[0, 10, 20, 30, 40, 50])
    assert [w[0] for w in times_of(recording, frame_to_frame=True)] == [31, 40, 50]


@pytest.mark.parametrize("duration", [33.3333, 16.6667, 8.3335])
def test_by_duration_leaves_no_gap_and_no_overlap(duration):
    """Of floats, k + 1 steps and k steps and a duration would round differently."""
    spans = itertools.islice(_grid_spans(duration, duration, 7), 20_000)
    assert all(stop == start for (_, stop), (start, _) in itertools.pairwise(spans))


def test_windows_in_time_from_where_one_says():
    recording = recording_of([25, 41], frames=[0, 10, 20, 30, 40])
    windows = list(cut(recording, Windows(frame_to_frame=True), begin=10))
    assert [(w.time, len(w.events)) for w in windows] == [(20, 0), (25, 1), (40, 0), (41, 1)]
    windows = list(cut(recording, Windows(duration=0.01), begin=20))
    assert [(w.time, len(w.events)) for w in windows] == [(25, 1), (40, 0), (41, 1)]


@pytest.mark.parametrize("windows", [{"duration": 10}, {"frame_to_frame": True}])
def test_events_before_the_first_window_are_not_held(windows):
    """A thousand chunks of 13 kB lie before it, one after it."""

    def chunks():
        for t in range(0, 1_001_000, 1000):
            yield Events.of(np.arange(t, t + 1000), *np.zeros((3, 1000), np.int16))

    recording = replace(recording_of([], frames=range(0, 1_001_000, 10_000)), events=chunks)
    tracemalloc.start()
    try:
        found = list(cut(recording, Windows(**windows), begin=1_000_000))
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert [(window.time, len(window.events)) for window in found] == [(1_000_999, 1000)]
    assert most < 1e6
    assert not list(cut(recording, Windows(**windows), begin=1_001_000))


@pytest.mark.parametrize("windows", [{"duration": 10}, {"frame_to_frame": True}])
def test_a_time_far_from_the_others_is_named_not_reached_window_by_window(windows):
    recording = recording_of([0, 100, 4 * 10**9], frames=[0, 100])
    found = cut(recording, Windows(**windows))
    assert next(found).events.t.tolist()[0] == 0
    with pytest.raises(RecordingError, match="memory: no event from .* to 4000.000000 s"):
        list(found)


@pytest.mark.parametrize("gap, refused", [(3_600_000_000, False), (3_600_000_001, True)])
def test_an_hour_without_events_is_no_broken_time(gap, refused):
    found = cut(recording_of([0, 10_000 + gap]), Windows(duration=10))
    assert len(next(found).events) == 1
    if refused:
        with pytest.raises(RecordingError, match="more than an hour"):
            next(found)
    else:
        assert len(next(found).events) == 0


@pytest.mark.parametrize("frames, events", [((0, 100), 10**16), ((10**16, 10**16 + 100), 0)])
def test_frames_on_another_clock_are_refused(frames, events):
    recording = recording_of(events + np.arange(20), frames=frames)
    with pytest.raises(RecordingError, match="memory: .*not on one clock"):
        list(cut(recording, Windows(frame_to_frame=True)))


def test_frames_that_last_for_hours_are_on_the_clock_of_events_after_them():
    recording = recording_of([5_000_000_005, 5_000_000_009], frames=[0, 5_000_000_000])
    assert sum(len(window.events) for window in cut(recording, Windows(frame_to_frame=True))) == 2


def test_windows_and_steps_may_be_as_short_as_a_clock_tick():
    assert Windows(duration=0.005, step=0.001).step == 0.001
    recording = recording_of(range(3))
    assert times_of(recording, duration=0.001) == [[0], [1], [2]]
    assert times_of(recording, events=2, longest=0.001) == [[0], [1], [2]]
    assert times_of(recording_of(range(4), frames=[0, 1]), frame_to_frame=True) == [
        [0], [1], [2], [3],
    ]  # fmt: skip


def test_windows_are_cut_in_one_way_which_may_be_any():
    """The greatest number that can be said; a step as long as the window; a number at least."""
    recording = recording_of([0, 1, 2, 999, 1000, 1001])
    assert Windows(events=2**31 - 1).count(6) == 2**31 - 1
    assert times_of(recording, duration=1, step=1) == times_of(recording, duration=1)
    assert times_of(recording, duration=1) == [[0, 1, 2, 999], [1000, 1001]]
    assert [Windows().count(pixels) for pixels in (1, 3, 4, 5, 100)] == [1, 1, 1, 2, 35]
    assert Windows(events_per_pixel=0.5).count(100) == 50
    assert Windows(frame_to_frame=False).longest is None
    for one in ({"events": 5}, {"events_per_pixel": 1.0}, {"duration": 5.0}):
        with pytest.raises(ValueError, match="choose one"):
            Windows(frame_to_frame=True, **one)


@pytest.mark.parametrize(
    "choice, said",
    [
        ({}, "windows of 0.35 events per pixel (35)"),
        ({"events_per_pixel": 12.5}, "windows of 12.5 events per pixel (1,250)"),
        ({"events": 1}, "windows of 1 event"),
        ({"events": 2000, "step": 500}, "windows of 2,000 events, one every 500 events"),
        ({"duration": 7.5}, "windows of 7.5 ms"),
        ({"duration": 20, "step": 2.5}, "windows of 20 ms, one every 2.5 ms"),
        ({"frame_to_frame": True}, "windows between frames"),
        ({"events": 9, "longest": 40}, "windows of 9 events, at most 40 ms"),
    ],
)
def test_windows_in_words(choice, said):
    assert in_words(Windows(**choice), 100) == said


def test_equal_choices_are_one_choice():
    """So that they can be arguments of a compiled function."""
    assert len({Windows(events=5), Windows(events=5), Windows(events=6)}) == 2


@pytest.mark.parametrize("after, refused", [(3_600_000_000, False), (3_600_000_001, True)])
def test_an_hour_is_not_another_clock(after, refused):
    found = cut(recording_of([0, 5], frames=[after, 2 * after]), Windows(frame_to_frame=True))
    if refused:
        with pytest.raises(RecordingError, match="not on one clock"):
            list(found)
    else:
        assert [window.time for window in found] == [5]


def test_frames_all_at_one_time_are_too_few():
    with pytest.raises(RecordingError, match="each at a time of its own"):
        cut(recording_of(range(20), frames=[5, 5, 5]), Windows(frame_to_frame=True))


def test_between_frames_needs_frames():
    with pytest.raises(RecordingError, match="two frames or more"):
        cut(recording_of(range(9)), Windows(frame_to_frame=True))


@pytest.mark.parametrize(
    "choice",
    [{"events": 4}, {"events": 4, "step": 2}, {"events": 4, "longest": 9}, {"duration": 1}],
)
def test_one_event_is_one_window(choice):
    assert times_of(recording_of([5]), **choice) == [[5]]


@pytest.mark.parametrize("choice", [{"events": 4}, {"events": 4, "longest": 9}])
def test_a_window_that_is_full_does_not_wait_for_what_follows(choice):
    """As a camera's events come it is shown at once."""

    def chunks():
        yield Events.of(range(4), *np.zeros((3, 4), int))
        raise AssertionError("asked for more")

    found = cut(replace(recording_of([]), events=chunks), Windows(**choice))
    assert next(found).events.t.tolist() == [0, 1, 2, 3]


def test_no_events_no_windows():
    for windows in (Windows(), Windows(duration=1)):
        assert list(cut(recording_of([]), windows)) == []


@pytest.mark.parametrize(
    "fields, message",
    [
        ({"events": 5, "duration": 3}, "choose one"),
        ({"events": 0}, "more than 0"),
        ({"events": 10**400}, "at most 2147483647"),
        ({"events": 2.5}, "whole number"),
        ({"events_per_pixel": 1e308}, "at most 2147483647"),
        ({"duration": -1}, "more than 0"),
        ({"duration": float("nan")}, "more than 0"),
        ({"duration": 0.0001}, "duration is 0.0001 ms"),
        ({"events": 5, "longest": 0.0001}, "longest is 0.0001 ms"),
        ({"duration": 5, "step": 0.0001}, "step is 0.0001 ms"),
        ({"events": 5, "step": 2.5}, "whole number"),
        ({"frame_to_frame": True, "step": 2}, "fixed size"),
    ],
)
def test_impossible_settings(fields, message):
    with pytest.raises(ValueError, match=message):
        Windows(**fields)


def test_a_number_of_events_may_be_written_as_a_float():
    recording = recording_of(range(9))
    assert times_of(recording, events=4.0) == times_of(recording, events=4)


@pytest.mark.parametrize("fields", [{"events": 5, "step": 6}, {"duration": 5, "step": 6}])
def test_a_step_beyond_the_window_would_lose_events(fields):
    with pytest.raises(ValueError, match="longer than the window"):
        cut(recording_of(range(9)), Windows(**fields))


@pytest.mark.parametrize(
    "count, said", [(9, "9 events per window are 0.09 per pixel"), (10, ""), (35, ""), (150, ""),
                    (151, "are 1.51 per pixel"), (12_345, "12,345 events per window are 123 per"),
                    (1, "1 event per window is 0.01 per pixel")],
)  # fmt: skip
def test_unusual_windows_are_said(caplog, count, said):
    cut(recording_of([], height=10, width=10), Windows(events=count))
    assert said in caplog.text and bool(said) == bool(caplog.text)
    assert not said or "0.35 (35 events) is usual" in caplog.text


def test_windows_far_larger_than_chunks_cost_linear_time():
    """100,000 chunks into one window: joining at every chunk would copy 20 billion events."""
    parts = [Events.of([i], [0], [0], [1]) for i in range(100_000)]
    recording = Recording("memory", "memory", 1000, 1000, lambda: iter(parts))
    for windows in (Windows(events=100_000), Windows(duration=1000)):
        assert [len(w.events) for w in cut(recording, windows)] == [100_000]


def test_after_the_last_frame_the_clock_goes_on_as_it_mostly_did():
    """One interval that is unlike the others, here the first, does not set the pace."""
    recording = recording_of(range(0, 60, 5), frames=[0, 3, 13, 23, 33])
    assert times_of(recording, frame_to_frame=True) == [
        [0], [5, 10], [15, 20], [25, 30], [35, 40], [45, 50], [55],
    ]  # fmt: skip


def test_windows_of_at_most_so_many_events_and_so_long():
    """Against a loop over events; chunks of any size give the same."""
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, 10**6, 3000)) // 7 * 7 + np.repeat([0, 5 * 10**6], [2000, 1000])
    zeros = np.zeros(3000, np.int16)
    events = Events.of(t, zeros, zeros, zeros)
    expected, begin = [0], 0
    for i in range(3000):
        if t[i] - t[begin] >= 20_000 or i - begin == 50:
            begin = i
            expected.append(i)
    for size in (1, 7, 500, 3000):
        chunks = [events.select(slice(k, k + size)) for k in range(0, 3000, size)]
        recording = Recording(Path("a"), "test", 10, 10, lambda chunks=chunks: iter(chunks))
        found = list(cut(recording, Windows(events=50, longest=20)))
        assert [len(window.events) for window in found] == np.diff([*expected, 3000]).tolist()
        assert [window.time for window in found] == [t[i - 1] for i in (*expected[1:], 3000)]


@pytest.mark.parametrize("start", [0, 7_000_000])
@pytest.mark.parametrize(
    "seconds, longest", [(0.0, 0.001), (0.1, 5.0), (0.8, 40.0), (0.8005, 40.0), (60.0, 40.0)]
)
def test_what_is_usual_depends_on_how_long_a_recording_is(start, seconds, longest):
    t = start + np.linspace(0, seconds * 1e6, 50).astype(np.int64)
    zeros = np.zeros(50, np.int16)
    windows = usual(iter([Events.of(t, zeros, zeros, zeros)]))
    assert windows == Windows(longest=longest)
    assert (
        in_words(windows, 100) == f"windows of 0.35 events per pixel (35), at most {longest:g} ms"
    )


@pytest.mark.parametrize("other", [{"duration": 5.0}, {"frame_to_frame": True}, {"step": 3}])
def test_a_longest_window_is_one_of_events(other):
    with pytest.raises(ValueError, match="longest limits windows of events"):
        Windows(longest=40.0, **other)


def test_no_more_of_a_recording_is_read_than_says_what_is_usual():
    def chunks():
        yield at(0, 400_000)
        yield at(500_000, 800_000)
        raise AssertionError("read beyond 0.8 s")

    def at(*t):
        return Events.of(t, *np.zeros((3, len(t)), int))

    assert usual(chunks()) == Windows(longest=40.0)
    assert usual(iter([])) == Windows(longest=0.001)
