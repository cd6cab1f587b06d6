import math

import jax
import numpy as np
import pytest

from firenet_jax.evaluation.baselines.high_pass import HighPass, advance, initial_state, pack, step
from firenet_jax.events import Events
from firenet_jax.pictures import bilateral
from firenet_jax.windows import Window

HEIGHT, WIDTH = 9, 11
RAW = HighPass(adaptive_range=False, bilateral=0.0)
HOUR = 3_600_000_000


def random_window(rng, count, start=10**15, span=50_000, height=HEIGHT, width=WIDTH):
    events = Events.of(
        np.sort(start + rng.integers(0, span, count)),
        rng.integers(0, width, count),
        rng.integers(0, height, count),
        rng.random(count) < 0.5,
    )
    return Window(events, start + span)


def event_by_event(windows, settings, height=HEIGHT, width=WIDTH):
    """L after each window: one event after the other, as the authors' program goes."""
    alpha = 2 * math.pi * settings.cutoff
    state, last = np.zeros((height, width)), np.full((height, width), windows[0].time)
    for events, time in windows:
        for t, x, y, p in zip(events.t, events.x, events.y, events.p, strict=True):
            if 0 <= x < width and 0 <= y < height:
                forget = math.exp(-alpha * 1e-6 * int(t - last[y, x]) - settings.kappa)
                contrast = settings.contrast_on if p else settings.contrast_off
                state[y, x] = forget * state[y, x] + contrast
                last[y, x] = t
        yield np.exp(-alpha * 1e-6 * (time - last)) * state


def check(windows, settings, tolerance=1e-4):
    state = initial_state(HEIGHT, WIDTH)
    for window, expected in zip(windows, event_by_event(windows, settings), strict=True):
        state, image = step(state, window, settings)
        np.testing.assert_allclose(state.log_intensity, expected, atol=tolerance)
        assert image.shape == (HEIGHT, WIDTH) and image.dtype == np.float32
        assert 0 <= image.min() and image.max() <= 1
    return state


@pytest.mark.parametrize("kappa", [0.0, 0.06])
@pytest.mark.parametrize("cutoff", [0.06, 5.0])
def test_windows_equal_the_loop_over_events(kappa, cutoff):
    """99 pixels, so that nearly every one has several events in a window, or very many."""
    rng = np.random.default_rng(1)
    counts = [300, 1, 0, 2000, 50, 0, 7]
    windows = [random_window(rng, n, 10**15 + 50_000 * k) for k, n in enumerate(counts)]
    check(windows, HighPass(cutoff=cutoff, kappa=kappa, contrast_off=-0.13))


@pytest.mark.parametrize("kappa", [0.0, 0.06])
def test_simultaneous_events_of_one_pixel_count_in_their_order(kappa):
    events = Events.of([5] * 6, [3, 2, 3, 3, 2, 3], [4] * 6, [1, 1, 0, 1, 0, 1])
    check([Window(events, 5), Window(Events.empty(), 90_000)], HighPass(kappa=kappa), 1e-6)


def test_hours_lose_no_precision():
    """In the middle of the third hour a window lasts 1 ms, and 5 Hz forget a part of it."""
    rng = np.random.default_rng(2)
    starts = [0, HOUR // 2, 3 * HOUR, 3 * HOUR + 1000, 300 * HOUR]
    windows = [random_window(rng, 400, 10**15 + start, 1000) for start in starts]
    windows.append(random_window(rng, 400, 10**15 + 301 * HOUR, 2 * HOUR))  # longer than int32
    check(windows, HighPass(cutoff=5.0))
    check(windows, HighPass(cutoff=1e-5))


@pytest.mark.parametrize("start", [-300 * 10**6, -301 * HOUR])
def test_clocks_may_begin_far_below_zero(start):
    """The state before the first window is of no time."""
    rng = np.random.default_rng(9)
    windows = [random_window(rng, 400, start + 50_000 * k) for k in range(3)]
    check(windows, HighPass(cutoff=5.0))


def test_events_outside_the_sensor_change_nothing():
    x, y = [-1, WIDTH, 3, 3, 2], [5, 5, -1, HEIGHT, 2]
    state = check([Window(Events.of(range(5), x, y, [1] * 5), 4)], HighPass())
    assert np.flatnonzero(state.log_intensity).tolist() == [2 * WIDTH + 2]


def test_no_events_are_grey():
    window = Window(Events.empty(), 10**15)
    for settings in (HighPass(), RAW):
        _, image = step(initial_state(HEIGHT, WIDTH), window, settings)
        np.testing.assert_allclose(image, 0.5, atol=1e-6)


def test_fixed_range():
    window = random_window(np.random.default_rng(3), 2000)
    state, image = step(initial_state(HEIGHT, WIDTH), window, RAW)
    intensity = 1.5 * np.exp(np.asarray(state.log_intensity, np.float64)) - 1
    np.testing.assert_allclose(image, np.clip((intensity + 0.5) / 2, 0, 1), atol=1e-6)


def test_adaptive_range_follows_all_but_half_a_percent_of_the_pixels():
    height, width = 40, 50
    rng = np.random.default_rng(4)
    settings = HighPass(bilateral=0.0, contrast_on=0.2)
    state, low, high, last = initial_state(height, width), None, None, 0
    for count, start in [(9000, 0), (9000, 100_000), (0, 3_000_000), (200, 3_100_000)]:
        window = random_window(rng, count, 10**15 + start, 50_000, height, width)
        state, image = step(state, window, settings)
        intensity = 1.5 * np.exp(np.asarray(state.log_intensity, np.float64)) - 1
        ordered = np.sort(intensity.ravel())
        least, greatest = ordered[5] - 0.05, ordered[1995] + 0.05  # of 2000
        beta = 0 if low is None else 0.05 ** ((window.time - last) * 1e-6 / 2)
        low = min(beta * (low or 0) + (1 - beta) * least, 0.3)
        high = max(beta * (high or 0) + (1 - beta) * greatest, 0.7)
        last = window.time
        expected = np.clip((intensity - low) / (high - low), 0, 1)
        np.testing.assert_allclose(image, expected, atol=1e-5)
    assert low < 0.3 and high > 0.7  # else only the limits were tested


@pytest.mark.parametrize("sigma", [5.0, 25.0])
def test_bilateral_equals_the_loop_over_pixels(sigma):
    image = np.random.default_rng(5).random((12, 9))
    expected = np.zeros_like(image)
    for y in range(12):
        for x in range(9):
            total = weights = 0.0
            for i in range(-2, 3):
                for j in range(-2, 3):
                    if math.hypot(i, j) > 2:
                        continue
                    row, column = abs(y + i), abs(x + j)  # mirrored, the border only once
                    row, column = min(row, 22 - row), min(column, 16 - column)
                    levels = 255 * (image[row, column] - image[y, x])
                    weight = math.exp(-(i * i + j * j) / (2 * sigma**2))
                    weight *= math.exp(-(levels**2) / (2 * sigma**2))
                    total += weight * image[row, column]
                    weights += weight
            expected[y, x] = total / weights
    np.testing.assert_allclose(bilateral(image.astype(np.float32), sigma), expected, atol=1e-5)


def test_images_are_filtered_but_the_state_is_not():
    window = random_window(np.random.default_rng(6), 500)
    state, image = step(initial_state(HEIGHT, WIDTH), window, HighPass(bilateral=0.0))
    filtered_state, filtered = step(initial_state(HEIGHT, WIDTH), window, HighPass())
    np.testing.assert_allclose(filtered, bilateral(image), atol=1e-5)
    np.testing.assert_array_equal(state.log_intensity, filtered_state.log_intensity)


def test_other_counts_and_times_do_not_recompile():
    rng = np.random.default_rng(7)
    advance.clear_cache()
    state = initial_state(HEIGHT, WIDTH)
    for k, count in enumerate([0, 1, 100, 9999]):
        state, _ = step(state, random_window(rng, count, 10**15 + k * HOUR))
    assert advance._cache_size() == 1


def test_is_the_body_of_a_scan():
    rng = np.random.default_rng(8)
    windows = [random_window(rng, n, 50_000 * k) for k, n in enumerate([300, 20, 0])]
    packed = [pack(window, HEIGHT, WIDTH) for window in windows]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *packed)
    _, images = jax.lax.scan(advance, initial_state(HEIGHT, WIDTH), stacked)
    state = initial_state(HEIGHT, WIDTH)
    for window, image in zip(windows, images, strict=True):
        state, expected = step(state, window)
        np.testing.assert_allclose(image, expected, atol=1e-5)
