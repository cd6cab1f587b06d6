"""Stages of the built-in weights' training: at rest, and while memory is held."""

from pathlib import Path

import at_rest
import holding
import jax
import numpy as np
import pytest

import firenet_jax as fj
from firenet_jax.evaluation import metrics
from firenet_jax.simulation.scenes import SceneSettings
from firenet_jax.training.losses import Loss
from firenet_jax.training.settings import Train

WEIGHTS = Path(fj.__file__).parent / "weights" / "firenet.npz"


def test_noise_of_rests_is_balanced_and_as_much_as_it_says():
    noise = np.asarray(at_rest.balanced(jax.random.key(0), (10, 8, 60, 60, 5)))
    events = np.abs(noise).sum(-1).mean((0, 2, 3))
    np.testing.assert_allclose(events, at_rest.NOISES, rtol=0.1)
    assert np.abs(noise.sum(-1).mean((0, 2, 3))).max() < 0.01


@pytest.mark.slow
def test_a_stage_at_rest_trains_what_has_a_memory_and_nothing_else(tmp_path):
    settings = Train(
        tmp_path, textures=2, crop=16, batch=8, windows=11, scene=SceneSettings(objects=0)
    )
    made = at_rest.keep_at_rest(WEIGHTS, settings, tmp_path / "made.npz", steps=2, rate=1e-3)
    before, after = fj.load_weights(WEIGHTS).params, fj.load_weights(made).params
    for name in before:
        pairs = zip(*map(jax.tree.leaves, (before[name], after[name])), strict=True)
        apart = max(float(np.abs(a - b).max()) for a, b in pairs)
        assert (0 < apart < 0.01) if name in at_rest.FREE else apart == 0


@pytest.mark.slow
def test_a_stage_that_holds_trains_all_parts(tmp_path):
    how = holding.Holding(cut=16)
    settings = Train(
        tmp_path, textures=4, batch=2, crop=20, windows=2, chain=2, warmup=0,
        loss=Loss(nlpd=0, haarpsi=0, lambda_tc=0, l0=1),
        scene=SceneSettings(objects=0), optimiser="centred",
    )  # fmt: skip
    made = holding.train_and_hold(WEIGHTS, settings, tmp_path / "made.npz", steps=3, how=how)
    before, after = fj.load_weights(WEIGHTS).params, fj.load_weights(made).params
    for name in before:
        pairs = zip(*map(jax.tree.leaves, (before[name], after[name])), strict=True)
        assert 0 < max(float(np.abs(a - b).max()) for a, b in pairs) < 0.01


def test_what_goes_to_and_fro_is_held_to_its_first_round():
    """Backward first, as it begins where forward has ended; in two places at two ages."""
    rng = np.random.default_rng(0)
    tensors = rng.normal(size=(3, 2, 4, 4, 5)).astype(np.float32)
    back, forth = rng.random((2, 3, 2, 4, 4)).astype(np.float32)
    held = holding.nothing_held(3)._replace(
        tensors=tensors, first=(back, forth), passes=np.array([4, 7])
    )
    given, wanted = holding.next_pass(held)
    np.testing.assert_array_equal(given[:, 1], tensors[:, 1])
    np.testing.assert_array_equal(wanted[:, 1], forth[:, 1])
    for t in range(3):
        for n in range(5):
            np.testing.assert_array_equal(given[t, 0, ..., n], -tensors[2 - t, 0, ..., 4 - n])
    np.testing.assert_array_equal(wanted[:, 0], back[:, 0])
    # a shift of brightness counts four times, a difference that it lacks once; some not at all
    images = np.zeros((1, 2, 4, 4), np.float32)
    even, odd = images + 0.1, images + 0.1 * (-1) ** np.arange(4)
    assert holding.moved(even, images, np.ones(2)) == pytest.approx(0.4)
    assert holding.moved(odd, images, np.ones(2)) == pytest.approx(0.1)
    assert holding.moved(even, images, np.array([1, 0])) == pytest.approx(0.2)


def test_what_is_alike_is_so_at_any_contrast():
    images = np.random.default_rng(0).random((3, 2, 8, 8)).astype(np.float32)
    flat = 0.5 * images + 0.5 * images.mean((-2, -1), keepdims=True)
    assert float(holding.unlike(flat, images, np.ones(2))) == pytest.approx(0, abs=1e-3)
    assert float(holding.unlike(images + 0.1, images, np.ones(2))) == pytest.approx(0.3, abs=1e-3)
    for k in range(2):
        other = images[::-1]
        pairs = [(a[k].ravel(), b[k].ravel()) for a, b in zip(other, images, strict=True)]
        expected = [1 - np.corrcoef(*p)[0, 1] + 3 * abs(np.subtract(*p).mean()) for p in pairs]
        found = float(holding.unlike(other, images, np.arange(2) == k))
        assert found == pytest.approx(np.mean(expected) / 2, abs=1e-3)


def test_equalised_losses_tell_apart_what_a_stage_wants():
    """A texture of 0.003: 0.12 of the one, and 0.3 of the other."""
    image = np.full((36, 36), 0.5, np.float32)
    texture = image + 0.003 * (-1) ** np.add.outer(*[np.arange(36) // 3] * 2)
    usual = float(metrics.equalised_mse(image, texture))
    with holding.telling_apart(0.05):
        assert float(metrics.equalised_mse(image, texture)) == pytest.approx(usual, rel=1e-5)
    with holding.telling_apart(0.02):
        finer = float(metrics.equalised_mse(image, texture))
    assert finer == pytest.approx((0.3 / 0.12) ** 2 * usual, rel=0.02)
    assert metrics.equalised_mse(image, texture) == usual
