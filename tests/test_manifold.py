from functools import partial

import jax
import numpy as np
import pytest

from firenet_jax.evaluation.baselines import manifold
from firenet_jax.evaluation.baselines.manifold import Manifold, advance, initial_state, pack, step
from firenet_jax.events import Events
from firenet_jax.windows import Window

HEIGHT, WIDTH = 8, 11
SMALL = Manifold(packet=100)
HOUR = 3_600_000_000


def random_window(rng, count, start=10**15, span=50_000):
    events = Events.of(
        np.sort(start + rng.integers(0, span, count)),
        rng.integers(0, WIDTH, count),
        rng.integers(0, HEIGHT, count),
        rng.random(count) < 0.5,
    )
    return Window(events, start + span)


def difference_matrices():
    """(N, N) each: what takes an image of N pixels to its differences along x and along y."""

    def along(size):
        matrix = np.eye(size, k=1) - np.eye(size)
        matrix[-1] = 0
        return matrix

    return np.kron(np.eye(HEIGHT), along(WIDTH)), np.kron(along(HEIGHT), np.eye(WIDTH))


class Reference:
    """The same method in float64, its linear operators written out as matrices."""

    def __init__(self, settings):
        self.settings = settings
        n = HEIGHT * WIDTH
        self.u, self.p = np.full(n, 1.5), np.zeros((3, n))
        self.t, self.q, self.first = np.zeros(n), np.zeros((2, n)), None
        self.dx, self.dy = difference_matrices()

    def window(self, events):
        for start in range(0, len(events), self.settings.packet):
            self.packet(events.select(slice(start, start + self.settings.packet)))
        return (self.u - 1).reshape(HEIGHT, WIDTH)

    def packet(self, events):
        s, f = self.settings, self.u.copy()
        for t, x, y, p in zip(events.t, events.x, events.y, events.p, strict=True):
            if self.first is None:
                self.first = t
            if 0 <= x < WIDTH and 0 <= y < HEIGHT:
                pixel = y * WIDTH + x
                f[pixel] = f[pixel] * s.contrast_on if p else f[pixel] / s.contrast_off
                self.t[pixel] = (t - self.first) * 1e-6

        rough, ahead, rate = self.t.copy(), self.t, 8**-0.5
        for _ in range(s.iterations):
            self.q = self.q + rate * np.stack([self.dx @ ahead, self.dy @ ahead])
            self.q /= np.maximum(1, 2 * np.linalg.norm(self.q, axis=0))
            v = self.t - rate * (self.dx.T @ self.q[0] + self.dy.T @ self.q[1])
            new = rough + np.sign(v - rough) * np.maximum(0, np.abs(v - rough) - rate)
            self.t, ahead = new, 2 * new - self.t

        k, g = operator(self.t, s.time_weight)
        tau, ahead = 0.01, self.u
        sigma, tb = 1 / (tau * (8 + 2 * np.sqrt(2))), tau * np.sqrt(g)
        for _ in range(s.iterations):
            self.p = (self.p + sigma * (k @ ahead).reshape(3, -1)) / (1 + 0.3 * sigma)
            length = np.linalg.norm(self.p, axis=0)
            self.p /= np.maximum(1, s.fidelity * length / np.sqrt(g))
            v = self.u - tau * (k.T @ self.p.ravel()) - tb
            new = np.clip((v + np.sqrt(v**2 + 4 * tb * f)) / 2, 1, 2)
            self.u, ahead = new, 2 * new - self.u


def operator(surface, weight):
    """(N,) s -> the (3N, N) matrix J g^-1 grad, built from g and J as they are, and det g."""
    dx, dy = difference_matrices()
    tx, ty = (weight * np.clip(d @ surface, -0.5, 0.5) for d in (dx, dy))
    k, determinant = np.zeros((3, len(surface), len(surface))), np.zeros(len(surface))
    for i in range(len(surface)):
        g = np.array([[1 + tx[i] ** 2, tx[i] * ty[i]], [tx[i] * ty[i], 1 + ty[i] ** 2]])
        jacobian = np.array([[1, 0], [0, 1], [tx[i], ty[i]]])
        k[:, i] = jacobian @ np.linalg.inv(g) @ np.stack([dx[i], dy[i]])
        determinant[i] = np.linalg.det(g)
    return k.reshape(-1, len(surface)), determinant


def energy(u, f, surface, settings):
    """What `denoise` minimises: |.|_eps is quadratic below eps times the radius sqrt(G)/lambda."""
    k, g = operator(surface, settings.time_weight)
    slope = np.linalg.norm((k @ u).reshape(3, -1), axis=0)
    radius, eps = np.sqrt(g) / settings.fidelity, 0.3
    huber = np.where(
        slope <= eps * radius, slope**2 / (2 * eps), radius * slope - eps * radius**2 / 2
    )
    return (huber + np.sqrt(g) * (u - f * np.log(u))).sum()


@pytest.mark.parametrize(
    "settings", [SMALL, Manifold(packet=37, fidelity=20.0, contrast_off=1.25, time_weight=40.0)]
)
def test_windows_equal_float64(settings):
    """Ragged windows, an empty one among them, the last packet of each partly filled."""
    rng = np.random.default_rng(1)
    state, reference = initial_state(HEIGHT, WIDTH, settings), Reference(settings)
    for k, count in enumerate([450, 3, 0, 200, 321]):
        window = random_window(rng, count, 10**15 + 50_000 * k)
        state, image = step(state, window, settings)
        expected = reference.window(window.events)
        np.testing.assert_allclose(image, expected, atol=1e-3)
        surface = np.asarray(state.surface).ravel() + 1e-6 * (window.time - reference.first)
        np.testing.assert_allclose(surface, reference.t, atol=1e-5)
    assert np.std(expected) > 0.03


def test_hours_lose_no_precision():
    rng = np.random.default_rng(2)
    state, reference = initial_state(HEIGHT, WIDTH, SMALL), Reference(SMALL)
    for start in [0, 2 * HOUR, 2 * HOUR + 2000]:
        window = random_window(rng, 300, 10**15 + start, 2000)
        state, image = step(state, window, SMALL)
        np.testing.assert_allclose(image, reference.window(window.events), atol=1e-3)


def test_events_outside_the_sensor_change_nothing():
    window = random_window(np.random.default_rng(3), 80)
    outside = Events.of([window.events.t[0]] * 4, [-1, WIDTH, 3, 3], [5, 5, -1, HEIGHT], [1] * 4)
    columns = (np.append(getattr(outside, c), getattr(window.events, c)) for c in "txyp")
    both = Window(Events(*columns), window.time)
    images = [step(initial_state(HEIGHT, WIDTH), w, SMALL)[1] for w in (window, both)]
    np.testing.assert_array_equal(*images)


def test_no_events_leave_the_image():
    state, image = step(initial_state(HEIGHT, WIDTH), Window(Events.empty(), 10**15), SMALL)
    np.testing.assert_allclose(image, 0.5)
    state, image = step(state, random_window(np.random.default_rng(4), 500), SMALL)
    state, later = step(state, Window(Events.empty(), 10**15 + HOUR), SMALL)
    np.testing.assert_array_equal(image, later)


def test_the_surface_begins_with_the_first_event():
    state = initial_state(HEIGHT, WIDTH)
    empty, _ = step(state, Window(Events.empty(), 10**15 - 7_000_000), SMALL)
    window = random_window(np.random.default_rng(4), 50)
    found, expected = (step(s, window, SMALL)[0].surface for s in (empty, state))
    np.testing.assert_array_equal(found, expected)


def test_gradient_and_adjoint_equal_the_matrix():
    rng = np.random.default_rng(5)
    surface, u = rng.normal(size=(2, HEIGHT, WIDTH))
    p = rng.normal(size=(3, HEIGHT, WIDTH))
    k, g = operator(surface.ravel(), 2.0)
    geometry = manifold.metric(surface.astype(np.float32), 2.0)
    np.testing.assert_allclose(geometry.area.ravel(), np.sqrt(g), rtol=1e-5)
    slopes = np.stack(manifold.gradient(geometry, u.astype(np.float32)))
    np.testing.assert_allclose(slopes.ravel(), k @ u.ravel(), atol=1e-5)
    back = manifold.gradient_adjoint(geometry, *p.astype(np.float32))
    np.testing.assert_allclose(back.ravel(), k.T @ p.ravel(), atol=1e-5)
    assert np.linalg.norm(k, 2) ** 2 < 8  # what the step sizes count on


def test_energy_falls_to_its_minimum():
    rng = np.random.default_rng(6)
    surface = 0.1 * rng.random((HEIGHT, WIDTH))
    f = 1.2 + 0.6 * rng.random((HEIGHT, WIDTH))
    geometry = manifold.metric(surface.astype(np.float32), 2.0)
    state = initial_state(HEIGHT, WIDTH)

    def minimised(iterations):
        settings = Manifold(fidelity=20.0, iterations=iterations)
        run = jax.jit(partial(manifold.denoise, settings=settings))
        u, _ = run(state.image, state.dual, f.astype(np.float32), geometry)
        return np.asarray(u, np.float64).ravel()

    def energy_of(u):
        return energy(u, f.ravel(), surface.ravel(), Manifold(fidelity=20.0))

    energies = [energy_of(minimised(n)) for n in (0, 10, 20, 49)]
    best = minimised(3000)
    least = energy_of(best)
    assert (np.diff([*energies, least]) < 0).all(), energies
    assert energies[0] - energies[-1] > 0.5 * (energies[0] - least)
    for _ in range(20):  # the energy is convex: a minimum nearby is the minimum
        assert energy_of(best + 0.01 * rng.normal(size=best.shape)) > least


def test_unused_packets_change_nothing():
    window = random_window(np.random.default_rng(7), 250)
    packed = pack(window, HEIGHT, WIDTH, 100)
    assert len(packed.pixel) > packed.count == 3
    exact = packed._replace(pixel=packed.pixel[:3], age=packed.age[:3], p=packed.p[:3])
    results = [advance(initial_state(HEIGHT, WIDTH), p, SMALL) for p in (packed, exact)]
    jax.tree.map(np.testing.assert_array_equal, *results)


def test_other_counts_and_times_do_not_recompile():
    rng = np.random.default_rng(8)
    advance.clear_cache()
    state = initial_state(HEIGHT, WIDTH)
    for k, count in enumerate([0, 1, 100, 4000]):
        state, _ = step(state, random_window(rng, count, 10**15 + k * HOUR), SMALL)
    assert advance._cache_size() == 1
