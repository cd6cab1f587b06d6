from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import references_metrics as references
from scipy.ndimage import gaussian_filter

from firenet_jax.training import losses
from firenet_jax.training.losses import Loss, sequence_loss

B, H, W = 2, 32, 35
NOTHING = Loss(l1=0, nlpd=0, haarpsi=0, lambda_tc=0)
SHORT = Loss(l0=2, L=4)


def texture(seed, *shape):
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((*shape, H, W))
    image = sum(s * gaussian_filter(noise, (*[0] * len(shape), s, s)) for s in (1, 2, 5))
    return ((image - image.min()) / np.ptp(image)).astype(np.float32)


def sequence(steps=5):
    """Images, truths, displacements, visible: nothing has anything to do with anything."""
    rng = np.random.default_rng(1)
    displacements = rng.normal(0, 1, (steps, B, H, W, 2)).astype(np.float32)
    visible = rng.random((steps, B, H, W)) < 0.9
    return texture(2, steps, B), texture(3, steps, B), displacements, visible


def moving(steps=21):
    """A smooth picture that moves by a third and two thirds of a pixel, everything visible."""
    y, x = np.mgrid[:H, :W]
    k = np.arange(steps)[:, None, None, None]
    x, y = x - k / 3, y - 2 * k / 3 - np.arange(B)[:, None, None]
    truths = np.float32(0.5 + 0.2 * np.sin(0.2 * x + 0.1 * y) + 0.2 * np.sin(0.15 * y - 0.1 * x))
    displacements = np.broadcast_to(np.float32([1 / 3, 2 / 3]), (steps, B, H, W, 2))
    return truths, displacements, np.ones((steps, B, H, W), bool)


@cache
def jitted(settings, gradient=False):
    """The loss of four arrays, or its value and gradient; compiled once for all tests."""

    def loss(*arguments):
        return sequence_loss(*arguments, settings)

    return jax.jit(jax.value_and_grad(loss, has_aux=True) if gradient else loss)


def test_is_equation_2():
    """Summed over the steps one by one, with the obvious versions of the metrics."""
    sequences = [array.astype(np.float64) for array in sequence()]
    images, truths, displacements, visible = sequences
    settings = replace(NOTHING, l1=0.7, ssim=0.2, gmsd=0.3, lambda_tc=3.0, l0=2, L=4)
    expected = 0.0
    for b in range(B):
        for k in range(5):
            pair = images[k, b], truths[k, b]
            expected += 0.7 * np.abs(pair[0] - pair[1]).mean() / B
            expected += 0.2 * (1 - references.ssim(*pair)) / B + 0.3 * references.gmsd(*pair) / B
            if k >= 2:
                error = references.temporal_error(
                    images[k, b], images[k - 1, b], displacements[k, b],
                    truths[k, b], truths[k - 1, b], visible[k, b],
                )  # fmt: skip
                expected += 3.0 * error / B
    loss, _ = sequence_loss(*sequence(), settings)
    np.testing.assert_allclose(loss, expected, rtol=1e-5)


@pytest.mark.parametrize("l0, counted", [(0, 4), (1, 4), (3, 2), (4, 1), (5, 0)])
def test_terms_are_unweighted_means_that_add_up(l0, counted):
    settings = replace(NOTHING, l1=0.3, lambda_tc=1.5, l0=l0, L=20)
    images, truths, *flow = sequence()
    loss, terms = sequence_loss(images, truths, *flow, settings)
    names = {"reconstruction", "l1"} | ({"temporal"} if counted else set())
    assert set(terms) == names and loss.shape == () and loss.dtype == jnp.float32
    np.testing.assert_allclose(terms["l1"], np.abs(images - truths).mean(), rtol=1e-5)
    np.testing.assert_allclose(terms["reconstruction"], 0.3 * terms["l1"], rtol=1e-5)
    total = 5 * terms["reconstruction"] + 1.5 * counted * terms.get("temporal", 0)
    np.testing.assert_allclose(loss, total, rtol=1e-5)


def test_defaults_are_those_of_the_paper():
    assert (Loss().lambda_tc, Loss().l0, Loss().L) == (2.0, 10, 20)
    truths, *flow = moving(22)
    with pytest.raises(ValueError, match="22 images"):
        sequence_loss(truths, truths, *flow)


@pytest.mark.parametrize(
    "choice", [{"l1": -1.0}, {"ssim": np.nan}, {"lambda_tc": -2.0}, {"nlpd": np.inf}, {"l0": -3}]
)
def test_weights_that_cannot_be(choice):
    with pytest.raises(ValueError, match=f"{next(iter(choice))} is .* must be 0 or more"):
        Loss(**choice)


def test_what_is_summed_by_default():
    """L1, half of NLPD, half of HaarPSI and twice the temporal error, from image 10 on."""
    truths, *flow = moving(13)
    images = 0.9 * truths + 0.05 * (-1.0) ** np.arange(13, dtype=np.float32)[:, None, None, None]
    loss, terms = sequence_loss(images, truths, *flow)
    assert set(terms) == {"reconstruction", "l1", "nlpd", "haarpsi", "temporal"}
    each = terms["l1"] + 0.5 * terms["nlpd"] + 0.5 * terms["haarpsi"]
    np.testing.assert_allclose(terms["reconstruction"], each, rtol=1e-5)
    np.testing.assert_allclose(loss, 13 * each + 2 * 3 * terms["temporal"], rtol=1e-5)
    assert len({Loss(), Loss(), Loss(l1=0.5)}) == 2  # arguments of compiled functions
    _, terms = sequence_loss(images, truths, *flow, replace(NOTHING, l1=1.0))
    assert set(terms) == {"reconstruction", "l1"}  # without its weight, no temporal error


@pytest.mark.parametrize("moved, counts", [(0.29, True), (0.31, False), (-0.31, False)])
def test_detail_counts_up_to_three_tenths_of_a_pixel(moved, counts):
    images, truths, displacements, visible = sequence(2)
    displacements[:], visible[:] = moved, True
    _, terms = sequence_loss(images, truths, displacements, visible, replace(NOTHING, detail=1.0))
    assert bool(terms["detail"] > 0) is counts


def test_detail_does_not_count_where_motion_is_not_known():
    """As with recordings, which have no flow: there it counted in fast motion, too."""
    images, truths, displacements, visible = sequence(2)
    displacements[:], visible[:] = np.nan, False
    displacements[0, 0], visible[0, 0] = 0.0, True
    _, terms = sequence_loss(images, truths, displacements, visible, replace(NOTHING, detail=1.0))
    expected = references.detail(images[0, 0], truths[0, 0]) / images[:, :, 0, 0].size
    np.testing.assert_allclose(terms["detail"], expected, rtol=1e-3)


def test_the_first_flow_is_not_used():
    images, truths, displacements, visible = sequence()
    expected, _ = sequence_loss(images, truths, displacements, visible, replace(SHORT, l0=0))
    displacements[0], visible[0] = np.nan, ~visible[0]
    actual, _ = sequence_loss(images, truths, displacements, visible, replace(SHORT, l0=0))
    np.testing.assert_array_equal(actual, expected)


def test_a_perfect_reconstruction_of_a_moving_picture_costs_nothing():
    truths, *flow = moving()
    loss, terms = jitted(Loss())(truths, truths, *flow)
    assert terms["temporal"] <= 1e-3
    np.testing.assert_allclose(terms["reconstruction"], 0, atol=1e-5)
    flicker = truths + 0.05 * (-1.0) ** np.arange(21, dtype=np.float32)[:, None, None, None]
    # twice 0.05 between two images, but for what moves in
    np.testing.assert_allclose(
        jitted(Loss())(flicker, truths, *flow)[1]["temporal"], 0.1, rtol=0.06
    )


SIGHTED = (
    "l1",
    "centred",
    "nlpd",
    "ssim",
    "ms_ssim",
    "equalised",
    "equalised_mse",
    "random_features",
)


@pytest.mark.parametrize("names", [("l1", "nlpd", "haarpsi"), *((name,) for name in SIGHTED)])
def test_a_negative_costs_more_than_a_bad_image(names):
    """Per image, for the default and for each term that is not blind."""
    truths = texture(4, 3)
    bad = gaussian_filter(truths, (0, 2, 2)) + 0.05 * texture(5, 3)
    settings = Loss() if len(names) > 1 else replace(NOTHING, **{names[0]: 1.0})
    worst, _ = losses.reconstruction_loss(1 - truths, truths, settings)
    poor, terms = losses.reconstruction_loss(bad, truths, settings)
    assert set(terms) == set(names)
    assert (worst > 1.5 * poor).all() and (poor > 0).all()


def test_every_weight_has_its_term():
    every = {name: 1.0 for name in losses.DISTANCES}
    truths = texture(6, 2)
    _, terms = jax.eval_shape(
        lambda x: losses.reconstruction_loss(x, x, replace(NOTHING, **every)), truths
    )
    assert {name: term.shape for name, term in terms.items()} == dict.fromkeys(every, (2,))
    blank, terms = losses.reconstruction_loss(truths, truths, NOTHING)
    assert blank.shape == (2,) and not terms


def test_detail_counts_where_next_to_nothing_moved_and_what_cannot_be_seen_does_not_move():
    images, truths, displacements, visible = sequence(3)
    displacements *= 0.01
    displacements[0, 0, 5, 5] = 0.0, -0.4
    displacements[1, 1, 7, 7] = np.nan
    displacements[2, :, 3, 3] = 2.0
    visible[:] = True
    visible[1, 1, 7, 7] = visible[2, 1, 3, 3] = False
    settings = replace(NOTHING, l1=1.0, detail=10.0)
    loss, terms = jitted(settings)(images, truths, displacements, visible)
    each = np.array([[references.detail(*pair) for pair in zip(*rows, strict=True)]
                     for rows in zip(images, truths, strict=True)])  # fmt: skip
    each[0, 0] = each[2, 0] = 0
    np.testing.assert_allclose(terms["detail"], each.mean(), rtol=1e-3)
    without, _ = jitted(replace(settings, detail=0.0))(images, truths, displacements, visible)
    np.testing.assert_allclose(loss - without, 10 * each.sum(0).mean(), rtol=1e-3)
    np.testing.assert_allclose(3 * terms["reconstruction"], loss, rtol=1e-5)


def test_gradients_are_finite_for_flat_equal_and_saturated_sequences():
    _, truths, displacements, visible = sequence()
    displacements[~visible] = np.nan
    flat = np.full_like(truths, 0.5)
    saturated = (truths > 0.5).astype(np.float32)
    for images in (truths, 0 * flat, flat, 2 * flat, saturated, -3 * saturated):
        for truth in (truths, flat, 0 * flat, images):
            (loss, _), gradient = jitted(SHORT, True)(images, truth, displacements, visible)
            assert np.isfinite(loss) and np.isfinite(gradient).all()


def test_a_descent_along_the_gradient_finds_the_truth():
    """From grey: the terms pull in one direction, and past a negative too."""
    truths, *flow = moving(5)
    for images in (np.full_like(truths, 0.5), 1 - truths):
        (before, _), _ = jitted(SHORT, True)(images, truths, *flow)
        for rate in np.linspace(0.05, 0.002, 200):
            (after, _), gradient = jitted(SHORT, True)(images, truths, *flow)
            images = images - rate * jnp.sign(gradient)
        assert after < 0.2 * before
        assert np.abs(images - truths).mean() < 0.03


def test_jitted_equals_eager_and_does_not_recompile():
    """Eager but for the metrics, which are compiled one by one (and have a test of their own)."""
    arguments = sequence()
    expected, expected_terms = sequence_loss(*arguments, SHORT)
    compiled = jitted(SHORT, True)
    (loss, terms), _ = compiled(*arguments)
    np.testing.assert_allclose(loss, expected, rtol=1e-5)
    for name, term in terms.items():
        np.testing.assert_allclose(term, expected_terms[name], rtol=1e-4)
    programs = compiled._cache_size()
    compiled(arguments[0] + 1, *arguments[1:])
    assert compiled._cache_size() == programs


def test_whether_the_state_is_warm_may_be_known_only_as_the_program_runs():
    arguments, settings = sequence(), replace(NOTHING, l1=0.3, lambda_tc=1.5, l0=2, L=4)
    compiled = jax.jit(lambda warm: sequence_loss(*arguments, settings, warm))
    for warm, l0 in ((False, 2), (True, 0)):
        expected, terms = sequence_loss(*arguments, replace(settings, l0=l0))
        for loss, found in (compiled(warm), sequence_loss(*arguments, settings, warm)):
            np.testing.assert_allclose(loss, expected, rtol=1e-5)
            np.testing.assert_allclose(found["temporal"], terms["temporal"], rtol=1e-5)


def test_where_no_image_counts_yet_nothing_is_divided_by_their_number():
    arguments, settings = sequence(3), replace(NOTHING, l1=0.3, lambda_tc=1.5, l0=7, L=9)
    loss, terms = sequence_loss(*arguments, settings, jnp.asarray(False))
    assert terms["temporal"] == 0
    np.testing.assert_allclose(loss, 3 * terms["reconstruction"], rtol=1e-6)


def test_some_sequences_may_be_warm_and_others_not():
    """Each counts as if it were alone; the loss is the mean over the batch."""
    arguments, settings = sequence(), replace(NOTHING, l1=0.3, lambda_tc=1.5, l0=2, L=4)
    batch = arguments[0].shape[1]
    warm = np.arange(batch) % 2 == 0
    loss, _ = sequence_loss(*arguments, settings, jnp.asarray(warm))
    alone = [
        sequence_loss(*(a[:, b : b + 1] for a in arguments), settings, bool(warm[b]))[0]
        for b in range(batch)
    ]
    assert batch > 1 and not np.isclose(alone[0], alone[1])
    np.testing.assert_allclose(loss, np.mean(alone), rtol=1e-5)


def test_the_temporal_term_is_a_mean_over_the_images_that_count_though_few_do():
    """Of two images of each of two sequences, one of them warm, half an image counts."""
    arguments, settings = sequence(2), replace(NOTHING, lambda_tc=1.5, l0=2, L=4)
    warm = np.arange(arguments[0].shape[1]) == 0
    _, found = sequence_loss(*arguments, settings, jnp.asarray(warm))
    _, alone = sequence_loss(*(each[:, :1] for each in arguments), settings, True)
    np.testing.assert_allclose(found["temporal"], alone["temporal"], rtol=1e-5)
