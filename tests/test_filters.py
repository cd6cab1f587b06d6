import numpy as np
import pytest
from test_tensors import random_events
from test_windows import recording_of

from firenet_jax import filters
from firenet_jax.errors import RecordingError
from firenet_jax.events import Events, Recording, concatenate


def test_between_counts_seconds_from_the_first_event():
    t = 5_000_000 + np.arange(0, 1_000_000, 1000)
    chunks = recording_of(t).events
    for start, stop in [(None, None), (0.1, None), (None, 0.25), (0.1005, 0.3), (2, 3)]:
        kept = [events.t for events in filters.between(chunks(), start, stop)]
        low, high = 5e6 + 1e6 * (start or 0), 5e6 + 1e6 * (stop or 1e9)
        expected = t[(t >= low) & (t < high)]
        assert np.concatenate([*kept, []]).tolist() == expected.tolist()


def test_between_stops_reading_at_the_end():
    def chunks():
        yield Events.of([0, 10], [0, 0], [0, 0], [1, 1])
        yield Events.of([2_000_000], [0], [0], [1])
        raise AssertionError("read beyond the end")

    assert [len(events) for events in filters.between(chunks(), None, 1.0)] == [2]


def test_without_drops_hot_pixels():
    hot = np.zeros((2, 3), bool)
    hot[1, 2] = True
    events = concatenate(list(filters.without_hot_pixels(recording_of(range(60)).events(), hot)))
    assert len(events) == 50 and not ((events.x == 2) & (events.y == 1)).any()


def test_turned_is_a_turn_by_180_degrees():
    events = next(filters.rotated(iter([Events.of([0, 1], [0, 16], [0, 3], [1, 0])]), 12, 17))
    assert events.x.tolist() == [16, 0] and events.y.tolist() == [11, 8]
    assert events.x.dtype == np.int16


def test_hot_pixels_are_found_and_edges_are_not():
    """A bar sweeps over half of the sensor; two pixels fire on their own, one beside the bar."""
    rng = np.random.default_rng(0)
    events = random_events(rng, 500, 60, 80)
    sweep_y, sweep_x = np.divmod(np.repeat(np.arange(60 * 40), 20), 40)
    x = np.concatenate([events.x, sweep_x, [70] * 400, [20] * 900])
    y = np.concatenate([events.y, sweep_y, [30] * 400, [10] * 900])
    every = Events.of(np.zeros(len(x)), x, y, np.ones(len(x)))
    recording = Recording("memory", "memory", 60, 80, lambda: iter([every]))
    hot = filters.find_hot_pixels(recording)
    assert np.argwhere(hot).tolist() == [[10, 20], [30, 70]]


def test_hot_pixels_of_a_quiet_recording_are_none():
    recording = Recording("memory", "memory", 6, 8, lambda: iter([]))
    assert not filters.find_hot_pixels(recording).any()


def test_read_hot_pixels(tmp_path):
    path = tmp_path / "hot.txt"
    path.write_text("3,1\n\n0, 2\n")
    hot = filters.read_hot_pixels(path, 4, 5)
    assert np.argwhere(hot).tolist() == [[1, 3], [2, 0]]
    path.write_text("3,1\n0,2\n", "utf-8-sig")  # as Windows writes it
    np.testing.assert_array_equal(filters.read_hot_pixels(path, 4, 5), hot)
    path.write_text("x, y\n3,1\n0,2\n")
    np.testing.assert_array_equal(filters.read_hot_pixels(path, 4, 5), hot)


@pytest.mark.parametrize("line", ["5,0", "-1,2", "1 2", "1,2,3", "a,b"])
def test_read_hot_pixels_names_the_bad_line(tmp_path, line):
    path = tmp_path / "hot.txt"
    path.write_text(f"1,1\n{line}\n")
    with pytest.raises(RecordingError, match="hot.txt, line 2"):
        filters.read_hot_pixels(path, 4, 5)
    with pytest.raises(RecordingError, match="missing.txt"):
        filters.read_hot_pixels(tmp_path / "missing.txt", 4, 5)


def test_hot_pixels_are_looked_for_in_the_first_events():
    def chunks():
        yield random_events(np.random.default_rng(0), 500, 6, 8)
        raise AssertionError("read beyond what was asked for")

    filters.find_hot_pixels(Recording("memory", "memory", 6, 8, chunks), most=500)


def test_a_hot_pixel_is_ten_times_as_busy_as_its_neighbours_and_far_from_the_mean():
    def is_hot(counts, count):
        counts[10, 20] = count
        return filters.hot_pixels_of(counts)[10, 20]

    even = np.full((60, 80), 50)
    assert is_hot(even, 500) and not is_hot(even, 499)
    busy = np.where(np.arange(80) < 40, 1, 100) * np.ones((60, 1), int)  # 50 and 50 around it
    assert is_hot(busy, 400) and not is_hot(busy, 300)  # six deviations: 350
    quiet = np.zeros((60, 80), int)
    quiet[30, :] = 1
    assert is_hot(quiet, 10) and not is_hot(quiet, 9)


@pytest.mark.parametrize("distance, alone", [(2, False), (3, True)])
def test_a_hot_pixels_neighbours_are_those_up_to_two_away(distance, alone):
    """A square around it, of which the pixels next to it are no part, is as busy."""
    counts, (y, x) = np.ones((60, 80), int), np.mgrid[:60, :80]
    away = np.maximum(abs(y - 10), abs(x - 20))
    counts[(away == 0) | (away == distance)] = 1000
    assert filters.hot_pixels_of(counts)[10, 20] == alone


def test_hot_pixels_are_found_where_few_others_are_active():
    """What is usual is not taken from the hot ones, however many of the active pixels these are."""
    counts = np.zeros((60, 80), int)
    counts[::5, ::5][:, :15] = 1
    hot = np.zeros(counts.shape, bool)
    hot[2::12, 2::9] = True
    for many in (1000, 10):
        np.testing.assert_array_equal(filters.hot_pixels_of(np.where(hot, many, counts)), hot)
    counts[:, 40:] = np.arange(40) * 10  # and some that are alone, but not beyond the usual
    counts[20, 20] = 300
    hot[:, 36:] = False
    np.testing.assert_array_equal(filters.hot_pixels_of(np.where(hot, 2000, counts)), hot)
    assert not filters.hot_pixels_of(np.where(hot, 1000, 0)).any()  # nothing tells what is usual
    lonely = np.zeros((60, 80), int)
    lonely[::5, ::6] = 20
    lonely[30, 30] = 100_000
    np.testing.assert_array_equal(filters.hot_pixels_of(lonely), lonely > 20)
