import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from firenet_jax.warp import sample, warp

H, W = 13, 19


def random_image(seed, *shape):
    return np.random.default_rng(seed).random((*shape, H, W)).astype(np.float32)


def scipy_warp(image, displacement):
    """The definition, by scipy in float64: image(x - d(x)), the border repeated."""
    rows, columns = np.mgrid[:H, :W]
    place = [rows - displacement[..., 1], columns - displacement[..., 0]]
    return map_coordinates(image.astype(np.float64), place, order=1, mode="nearest")


@pytest.mark.parametrize("size", [0.3, 2.0, 30.0])
def test_equals_map_coordinates(size):
    image = random_image(0)
    rng = np.random.default_rng(1)
    displacement = rng.normal(0, size, (H, W, 2)).astype(np.float32)
    warped, _ = warp(jnp.asarray(image), jnp.asarray(displacement))
    np.testing.assert_allclose(warped, scipy_warp(image, displacement), atol=2e-6 * (1 + size))


def test_leading_axes_are_warped_each_by_its_own_displacement():
    image = random_image(2, 2, 3)
    displacement = np.random.default_rng(3).normal(0, 2, (2, 3, H, W, 2)).astype(np.float32)
    warped, visible = warp(jnp.asarray(image), jnp.asarray(displacement))
    assert warped.shape == visible.shape == (2, 3, H, W)
    for i in np.ndindex(2, 3):
        np.testing.assert_allclose(warped[i], scipy_warp(image[i], displacement[i]), atol=1e-5)


def test_a_ramp_moves_by_the_displacement_x_then_y():
    """Backward: the result at x is the image at x - d, so a ramp loses its slope times d."""
    rows, columns = np.mgrid[:H, :W].astype(np.float32)
    ramp = 0.5 * columns - 0.25 * rows
    displacement = np.broadcast_to(np.float32([1.75, -2.5]), (H, W, 2))
    warped, visible = warp(jnp.asarray(ramp), jnp.asarray(displacement))
    expected = ramp - (0.5 * 1.75 - 0.25 * -2.5)
    np.testing.assert_allclose(warped[visible], expected[np.asarray(visible)], atol=1e-5)
    np.testing.assert_array_equal(visible, (columns >= 2) & (rows <= H - 4))


def test_half_a_pixel_averages_two_neighbours():
    image = random_image(4)
    displacement = jnp.broadcast_to(jnp.array([0.5, 0.0]), (H, W, 2))
    warped, _ = warp(jnp.asarray(image), displacement)
    np.testing.assert_allclose(warped[:, 1:], (image[:, 1:] + image[:, :-1]) / 2, atol=1e-6)


def test_no_displacement_changes_nothing_and_all_is_visible():
    image = random_image(5)
    warped, visible = warp(jnp.asarray(image), jnp.zeros((H, W, 2)))
    np.testing.assert_array_equal(warped, image)
    assert np.asarray(visible).all()


def test_the_border_is_visible_and_a_little_beyond_is_not():
    displacement = jnp.zeros((H, W, 2)).at[0, 0, 0].set(0.01).at[H - 1, W - 1, 1].set(-0.01)
    _, visible = warp(jnp.asarray(random_image(6)), displacement)
    assert np.argwhere(~np.asarray(visible)).tolist() == [[0, 0], [H - 1, W - 1]]


def test_gradients_are_finite_everywhere():
    def loss(image, displacement):
        warped, visible = warp(image, displacement)
        return jnp.where(visible, warped**2, 0.0).sum() + warped.sum()

    gradients = jax.jit(jax.grad(loss, (0, 1)))
    for size in (0.0, 0.5, 1.0, 1e6, -1e6):
        for gradient in gradients(random_image(7), np.full((H, W, 2), size, np.float32)):
            assert np.isfinite(gradient).all()


def test_gradient_with_respect_to_the_displacement_is_the_slope():
    rows, columns = np.mgrid[:H, :W].astype(np.float32)
    ramp = jnp.asarray(0.5 * columns - 0.25 * rows)
    displacement = jnp.full((H, W, 2), 0.3)
    gradient = jax.grad(lambda d: warp(ramp, d)[0].sum())(displacement)
    # where the look-up stays inside; beyond the border the value is constant
    np.testing.assert_allclose(gradient[1:, 1:, 0], -0.5, atol=1e-5)
    np.testing.assert_allclose(gradient[1:, 1:, 1], 0.25, atol=1e-5)


def test_nothing_is_read_outside_the_image_whatever_comes():
    image = jnp.asarray(random_image(8))
    displacement = jnp.zeros((H, W, 2)).at[3, 4].set(jnp.nan).at[5, 6].set(jnp.inf)
    warped, visible = warp(image, displacement)
    assert not visible[3, 4] and not visible[5, 6]
    kept = np.ones((H, W), bool)
    kept[3, 4] = False  # nan in, nan out
    assert np.isfinite(warped[kept]).all()


def test_an_image_of_one_row_or_column():
    line = jnp.arange(5.0)
    np.testing.assert_allclose(sample(line[None], jnp.array([1.5]), jnp.array([0.0])), [1.5])
    np.testing.assert_allclose(sample(line[:, None], jnp.array([0.0]), jnp.array([3.25])), [3.25])


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="displacement"):
        warp(jnp.zeros((H, W)), jnp.zeros((2, H, W)))
