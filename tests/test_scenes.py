import math
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, minimum_filter

from firenet_jax.simulation import scenes as module
from firenet_jax.simulation.scenes import (
    SceneSettings,
    flow,
    random_scene,
    render,
    rendering_times,
    speeds,
    video,
)
from firenet_jax.warp import warp

H, W = 48, 64
SIZE = {"height": H, "width": W}
SPEEDS, DURATION, MANY = (50.0, 200.0), 1.0, 12
SETTINGS = SceneSettings(objects=2, speed=SPEEDS, pause=0.5, hdr=0.3)


def smooth_textures(count=6, size=96):
    """Noise without anything finer than five pixels."""
    rng = np.random.default_rng(0)
    noise = gaussian_filter(rng.normal(size=(count, size, size)), (0, 3, 3), mode="mirror")
    low, high = noise.min((1, 2), keepdims=True), noise.max((1, 2), keepdims=True)
    return jnp.asarray((noise - low) / (high - low), jnp.float32)


@pytest.fixture(scope="module")
def scenes():
    """MANY scenes of two objects, as one batch."""
    random_scene.clear_cache()
    made = [
        random_scene(key, smooth_textures(), duration=DURATION, settings=SETTINGS, **SIZE)
        for key in jax.random.split(jax.random.key(0), MANY)
    ]
    assert random_scene._cache_size() == 1  # another key does not retrace
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *made)


@pytest.fixture(scope="module")
def still(scenes):
    """The first scene without tilt, turn, objects and any motion."""
    scene = of(scenes, 0)
    places = scene.places.at[:, 3:].set(0.0)
    camera = scene.camera._replace(amplitude=jnp.zeros((6, module.WAVES)))
    motions = scene.motions._replace(amplitude=jnp.zeros_like(scene.motions.amplitude))
    return scene._replace(
        places=places,
        camera=camera,
        motions=motions,
        outlines=jnp.full_like(scene.outlines, -9.0),
        pauses=jnp.zeros_like(scene.pauses).at[:, 2].set(0.01),
    )


def of(scenes, k):
    return jax.tree.map(lambda leaf: leaf[k], scenes)


def moving(still, coordinate, amplitude):
    """The still scene under a camera of which one coordinate is amplitude sin(t)."""
    zeros = jnp.zeros((6, module.WAVES))
    camera = module.Motion(
        amplitude=zeros.at[coordinate, 0].set(amplitude),
        frequency=jnp.ones_like(zeros),
        phase=zeros,
        pace=jnp.ones(()),
    )
    return still._replace(camera=camera)


draw = jax.jit(jax.vmap(lambda scene, t: render(scene, t, **SIZE)))
move = jax.jit(jax.vmap(lambda scene, t0, t1: flow(scene, t0, t1, **SIZE)))
pace = jax.jit(jax.vmap(lambda scene, t: speeds(scene, t, **SIZE)))


def at(scenes, t):
    return jax.tree.map(np.asarray, draw(scenes, np.full(MANY, t, np.float32)))


# ---- Pictures


def test_pictures_are_finite_and_in_range(scenes):
    for t in (0.0, 0.4, 1.0):
        rendering = at(scenes, t)
        assert rendering.image.shape == rendering.plane.shape == (MANY, H, W)
        assert rendering.image.dtype == np.float32
        assert rendering.image.min() >= 0 and rendering.image.max() <= 1
        assert set(np.unique(rendering.plane)) == {0, 1, 2}
    shown = {tuple(np.unique(plane)) for plane in rendering.plane}
    assert (0,) in shown and len(shown) >= 3  # some scenes have no object, some all
    assert rendering.image.std((1, 2)).min() > 0.005


def test_the_same_key_gives_the_same_scene_another_key_another(scenes):
    first, second = at(scenes, 0.3).image[:2]
    again = np.asarray(draw(scenes, np.full(MANY, 0.3, np.float32)).image[0])
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - second).mean() > 0.02


def test_objects_end_inside_their_outline():
    """Beyond its field an outline goes on as at the border: a positive value there is a streak."""
    keys = jax.random.split(jax.random.key(2), 300)
    outlines = np.asarray(jax.jit(jax.vmap(module._outline))(keys))
    border = np.ones(outlines.shape[1:], bool)
    border[1:-1, 1:-1] = False
    assert outlines[:, border].max() < -0.02
    area = (outlines > 0).mean((1, 2))
    assert area.min() > 0.03 and area.max() < 0.7 and area.std() > 0.06


def test_hdr_scenes_span_more_than_others():
    """Light and shadow: the darkest tenth is a hundredth as bright, or a tenth at least."""
    textures = 0.2 + 0.8 * smooth_textures()[:2]
    lit = jax.jit(module._lit, static_argnums=2)
    plain, hdr = (
        np.asarray(lit(jax.random.key(1), textures, SceneSettings(hdr=hdr, black=(0.0, 0.0))))
        for hdr in (0.0, 1.0)
    )
    ranges = [np.divide(*np.percentile(lit, [95, 5])) for lit in (plain, hdr)]
    assert ranges[1] > 5 * ranges[0] and hdr.max() > 0.7 * plain.max()


def test_textures_are_blurred_for_the_scale_at_which_they_are_seen():
    """White noise: next to nothing may be left of what would alias, much of what would not."""
    noise = np.random.default_rng(1).random((64, 64)).astype(np.float32)
    density = 2.0  # texture pixels for one of the image, which then holds up to 0.25 cycles each
    blurred = np.asarray(jax.jit(partial(module._blurred, reach=4))(noise, 0.6 * density))
    spectrum, before = (np.abs(np.fft.fft2(image - 0.5)) ** 2 for image in (blurred, noise))
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(64), np.fft.fftfreq(64)))
    aliasing, kept = frequency > 0.35, frequency < 0.1
    assert spectrum[aliasing].sum() < 0.01 * before[aliasing].sum()
    assert spectrum[kept].sum() > 0.6 * before[kept].sum()


@pytest.mark.parametrize("choice", [{"blur": (2.0, 2.0)}, {"zoom": (0.1, 0.1)}])
def test_wide_blurs_are_as_wide_as_said(choice):
    """What a point of the background becomes: its standard deviation, where it is seen at rest."""
    settings = SceneSettings(objects=0, tilt=0.0, **choice)
    point = np.zeros((1, 129, 129), np.float32)
    point[0, 64, 64] = 1.0
    scene = module.random_scene(jax.random.key(4), point, settings=settings, **SIZE)
    spread = np.asarray(scene.textures[0] - scene.textures[0].min()).sum(0)
    place = np.arange(129) - 64
    texture_pixels = np.sqrt((spread * place**2).sum() / spread.sum())
    zoom = 1 / float(scene.density[0])  # at a distance of 1
    wanted = np.sqrt((settings.blur[0] * 1.2 / zoom) ** 2 - 0.16)
    assert abs(texture_pixels / wanted - 1) < 0.05


@pytest.mark.slow
def test_less_blur_leaves_finer_detail():
    """The same scene but for the blur: so much more of what is finer than four pixels."""
    textures = np.random.default_rng(2).random((2, 128, 128)).astype(np.float32)

    def fine(blur):
        settings = SceneSettings(objects=0, zoom=(0.5, 0.5), blur=(blur, blur))
        size = {"height": 48, "width": 64}
        scene = module.random_scene(jax.random.key(4), textures, settings=settings, **size)
        image = np.asarray(module.render(scene, 0.0, **size).image)
        frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(64), np.fft.fftfreq(48)))
        return (np.abs(np.fft.fft2(image))[frequency > 0.25] ** 2).sum()

    strengths = [fine(blur) for blur in (0.3, 0.5, 0.8)]
    assert strengths[0] > 1.5 * strengths[1] > 3 * strengths[2]


def test_a_magnified_texture_is_looked_up_as_numpy_would(still):
    """A plane that faces the camera, its texture a ramp, one texture pixel in two of the image."""
    size = still.textures[0].shape[-1]
    ramp = jnp.broadcast_to(jnp.arange(size) / size, (size, size)).astype(jnp.float32)
    scene = still._replace(
        textures=(ramp,) * 3, density=jnp.full(3, 0.5), origin=jnp.full((3, 2), (size - 1) / 2)
    )
    x = np.arange(W) - (W - 1) / 2
    expected = ((size - 1) / 2 + 0.5 * x) / size
    image = render(scene, 0.0, **SIZE).image
    np.testing.assert_allclose(image, np.broadcast_to(expected, (H, W)), atol=1e-5)


def test_textures_go_on_mirrored(still):
    size = still.textures[0].shape[-1]
    ramp = jnp.broadcast_to(jnp.arange(size) / size, (size, size)).astype(jnp.float32)
    scene = still._replace(
        textures=(ramp,) * 3,
        density=jnp.full(3, 1.0),
        origin=jnp.zeros((3, 2)) + (W - 1) / 2 - 20.0,
    )
    row = np.asarray(render(scene, 0.0, **SIZE).image)[0]
    expected = np.abs(np.arange(W) - 20.0) / size  # texture 0 lies at column 20
    np.testing.assert_allclose(row, expected, atol=1e-5)


# ---- Motion and flow


def test_the_past_warped_by_the_flow_is_the_present(scenes):
    """The exact flow, so only interpolation differs; occlusions and their rims do not count."""
    for t0, t1 in [(0.1, 0.12), (0.5, 0.53), (0.9, 0.91)]:
        before, after = at(scenes, t0), at(scenes, t1)
        displacement, visible = move(
            scenes, np.full(MANY, t0, np.float32), np.full(MANY, t1, np.float32)
        )
        warped, inside = warp(jnp.asarray(before.image), displacement)
        visible = np.asarray(visible)
        assert not (visible & ~np.asarray(inside)).any()
        error = np.abs(warped - after.image)
        assert error[visible].mean() <= 0.004 and error[visible].max() <= 0.1
        assert visible.mean() > 0.8
        # What is invisible inside the picture is worse by far: the mask marks what it must.
        assert error[~visible].mean() > 3 * error[visible].mean()


def test_where_it_is_visible_the_same_plane_was_in_front(scenes):
    before, after = at(scenes, 0.2), at(scenes, 0.23)
    displacement, visible = move(
        scenes, np.full(MANY, 0.2, np.float32), np.full(MANY, 0.23, np.float32)
    )
    x = np.arange(W)[None, None] - displacement[..., 0]
    y = np.arange(H)[None, :, None] - displacement[..., 1]
    visible = np.asarray(visible)
    column = np.clip(np.round(x), 0, W - 1).astype(int)
    row = np.clip(np.round(y), 0, H - 1).astype(int)
    then = np.take_along_axis(
        before.plane.reshape(MANY, -1), (row * W + column).reshape(MANY, -1), 1
    )
    same = then.reshape(MANY, H, W) == after.plane
    assert same[visible].all()
    hidden = ~same & (x >= 0) & (x <= W - 1) & (y >= 0) & (y <= H - 1)
    assert hidden.sum() > 100 and not visible[hidden].any()


def test_between_equal_times_nothing_moves(scenes):
    displacement, visible = move(
        scenes, np.full(MANY, 0.4, np.float32), np.full(MANY, 0.4, np.float32)
    )
    np.testing.assert_allclose(displacement, 0, atol=2e-3)
    without = np.asarray(at(scenes, 0.4).plane.max((1, 2)) == 0)
    assert without.any() and np.asarray(visible)[without, 1:-1, 1:-1].all()


@pytest.mark.parametrize("coordinate, direction", [(0, [-1, 0]), (1, [0, -1])])
def test_a_camera_that_moves_sideways_moves_the_picture_against_it(still, coordinate, direction):
    """Lengths are pixels of the background at rest: 5 sin(t) to the right shifts it to the left."""
    scene = moving(still, coordinate, 5.0)
    displacement, visible = flow(scene, 0.1, 0.3, **SIZE)
    expected = 5.0 * (math.sin(0.3) - math.sin(0.1)) * np.array(direction)
    np.testing.assert_allclose(displacement, np.broadcast_to(expected, (H, W, 2)), atol=1e-4)
    assert np.asarray(visible).mean() > 0.9


def test_a_camera_that_moves_forward_spreads_the_picture(still):
    focal = float(still.focal)
    scene = moving(still, 2, 0.2 * focal)
    displacement, _ = flow(scene, 0.0, 0.5, **SIZE)
    closer = 1 - 0.2 * math.sin(0.5)  # so many parts of the distance are left
    x = np.arange(W) - (W - 1) / 2
    expected = np.broadcast_to(x * (1 - closer), (H, W))
    np.testing.assert_allclose(displacement[..., 0], expected, atol=1e-4)


def test_a_camera_that_rolls_turns_the_picture(still):
    scene = moving(still, 5, 0.3)
    displacement, _ = flow(scene, 0.0, 0.8, **SIZE)
    angle = 0.3 * math.sin(0.8)  # about the axis that points into the scene, x towards y
    x, y = np.meshgrid(np.arange(W) - (W - 1) / 2, np.arange(H) - (H - 1) / 2)
    x0 = math.cos(angle) * x + math.sin(angle) * y
    y0 = -math.sin(angle) * x + math.cos(angle) * y
    np.testing.assert_allclose(displacement, np.stack([x - x0, y - y0], -1), atol=2e-4)


def test_no_point_is_faster_than_said(scenes):
    step = 2e-3
    starts = np.linspace(0, DURATION, 30, dtype=np.float32)
    times = np.stack([starts, starts + np.float32(step)], -1).ravel()  # (60,)
    measured = np.asarray(pace(scenes, np.broadcast_to(times, (MANY, 60))))
    said = np.asarray(scenes.speed)
    assert said.max() <= SPEEDS[1] * 1.001 and said.min() >= 0.7 * SPEEDS[0]
    assert np.log(said).std() > 0.25  # of a log-uniform one: 0.4
    assert (measured[:, :-1].max(1) <= said).all()
    for k in range(0, 30, 5):
        ends = (np.full(MANY, times[2 * k]), np.full(MANY, times[2 * k + 1]))
        displacement, visible = (np.asarray(x) for x in move(scenes, *ends))
        seen = np.where(visible, np.linalg.norm(displacement, axis=-1), 0.0).max((1, 2)) / step
        assert (seen <= 1.05 * measured[:, 2 * k : 2 * k + 2].max(1) + 1.0).all()


def test_motion_is_smooth_and_pauses_stand_still(scenes):
    times = np.linspace(0.0, DURATION, 401, dtype=np.float32)
    clock = jax.jit(jax.vmap(jax.vmap(module._clock, (None, 0)), (0, None)))(scenes.pauses, times)
    rate = np.diff(clock, axis=1) / np.diff(times)
    assert rate.min() > -1e-3 and rate.max() < 1 + 1e-3
    assert np.abs(np.diff(rate, axis=1)).max() < 0.25  # no jump of speed
    stopped = (np.abs(rate) < 1e-3).any(1)
    assert 0 < stopped.sum() < MANY  # half of the halves pause
    k = int(np.argmax(stopped))
    start, end, ramp = np.asarray(scenes.pauses[k][np.argmax(np.ptp(scenes.pauses[k, :, :2], 1))])
    a, b = np.full(MANY, start + ramp), np.full(MANY, end)
    np.testing.assert_allclose(move(scenes, a, b)[0][k], 0, atol=2e-3)
    inside = np.linspace(start + ramp, end, 60, dtype=np.float32)
    assert pace(scenes, np.broadcast_to(inside, (MANY, 60)))[k].max() < 1


@pytest.mark.slow
def test_everything_may_stop_for_good():
    """Also where a second pause was drawn; before it stops and at its speed nothing changes."""
    textures = smooth_textures()
    for key in jax.random.split(jax.random.key(2), 4):
        make = partial(random_scene, key, textures, duration=DURATION, **SIZE)
        settings = SceneSettings(objects=2, speed=SPEEDS, pause=1.0)
        usual, halted = make(settings=settings), make(settings=replace(settings, halt=1.0))
        start, _, ramp = np.asarray(halted.pauses[0])
        assert 0 < start < 0.31 * DURATION
        assert start == pytest.approx(float(usual.pauses[0, 0]), rel=1e-6)  # two programs
        images = [
            np.asarray(render(halted, t, **SIZE).image)
            for t in (0.0, start + ramp, 0.7 * DURATION, 9 * DURATION)
        ]
        assert not np.allclose(images[0], images[1], atol=0.05)
        for later in images[2:]:
            np.testing.assert_allclose(later, images[1], atol=5e-3)


def test_before_a_still_camera_only_objects_move():
    settings = SceneSettings(objects=2, speed=SPEEDS, still=1.0)
    textures, stood = smooth_textures(), 0
    for key in jax.random.split(jax.random.key(1), MANY):
        scene = random_scene(key, textures, duration=DURATION, settings=settings, **SIZE)
        objects = (np.asarray(scene.outlines).max((1, 2)) > 0).any()
        assert (float(scene.camera.pace) == 0) == objects  # without any, the camera moves
        if objects:
            moved, _ = flow(scene, 0.3, 0.4, **SIZE)
            plane = np.asarray(render(scene, 0.4, **SIZE).plane)
            assert np.abs(np.asarray(moved)[plane == 0]).max() < 1e-4  # px, rounding
            stood += 1
    assert 0 < stood < MANY


@pytest.mark.slow
def test_a_shaking_camera_comes_back_again_and_again():
    """By less than it is allowed to, and no faster than said; one without a shake goes away."""
    settings = SceneSettings(objects=2, speed=SPEEDS, pause=0.0, still=1.0)
    shaking = replace(settings, shake=1.0, shake_pixels=(2.0, 2.0))
    make = partial(random_scene, textures=smooth_textures(), duration=DURATION, **SIZE)
    times = np.linspace(0.0, DURATION, 400, dtype=np.float32)

    @jax.jit
    def middle(scene):  # of the background, in the picture
        def at(t):
            matrix = module._to_image(scene, t, H, W)[0]
            return jnp.stack(module._project(matrix, *jnp.zeros((2, 1))))[:, 0]

        return jax.vmap(at)(times)

    stood = 0
    for key in jax.random.split(jax.random.key(1), 6):
        scene = make(key, settings=shaking)
        rest = np.asarray(middle(scene._replace(shake=None)))
        away = np.asarray(middle(scene)) - rest
        assert 0.3 < np.abs(away).max() < 2 * 1.3  # nearer than at rest it looks larger
        turns = (np.diff(np.sign(np.diff(away[:, 0]))) != 0).sum()
        assert turns >= 4 * DURATION
        often = np.linspace(0.0, DURATION, 6000, dtype=np.float32)
        assert float(speeds(scene, often, **SIZE).max()) <= float(scene.speed) <= SPEEDS[1] * 1.001
        if float(scene.camera.pace) == 0:
            assert np.ptp(rest, 0).max() < 1e-4
            stood += 1
    assert 0 < stood < 6
    assert make(key, settings=settings).shake is None


def test_a_plain_background_shows_nothing_but_objects():
    settings = SceneSettings(objects=2, speed=SPEEDS, plain=1.0)
    textures, plain = smooth_textures(), 0
    for key in jax.random.split(jax.random.key(1), MANY):
        scene = random_scene(key, textures, duration=DURATION, settings=settings, **SIZE)
        image, plane = map(np.asarray, render(scene, 0.4, **SIZE))
        objects = (np.asarray(scene.outlines).max((1, 2)) > 0).any()
        ground = minimum_filter(plane == 0, 9)  # without soft edges
        assert (np.ptp(image[ground]) < 1e-6) == objects  # without any, it keeps its texture
        plain += objects
    assert 0 < plain < MANY


def test_other_times_do_not_retrace(scenes):
    for function, times in [(render, (0.1,)), (flow, (0.1, 0.2))]:
        compiled = []
        for k, shift in enumerate((0.0, 0.3)):
            function(of(scenes, k), *(t + shift for t in times), **SIZE)
            compiled.append(function._cache_size())
        assert compiled[0] == compiled[1]


def test_rendering_times_are_dense_enough_and_hold_the_bounds(scenes):
    bounds = np.array([100_000, 133_333, 250_000, 250_001])
    for k in (0, 1):
        scene = of(scenes, k)
        times = rendering_times(scene, bounds, longest=8000, **SIZE)
        assert times.dtype == np.int64 and np.isin(bounds, times).all()
        gaps = np.diff(times)
        assert gaps.min() >= 1 and gaps.max() <= 8001
        assert len(times) <= 0.15 * SPEEDS[1] / 0.5 * 1.3 + 0.15 / 8e-3 + 8
        for t0, t1 in zip(times[:-1:3], times[1::3], strict=False):
            displacement, visible = flow(scene, 1e-6 * t0, 1e-6 * t1, **SIZE)
            assert np.linalg.norm(displacement, axis=-1)[visible].max() <= 0.5


def test_video_gives_each_time_its_picture(scenes):
    times = np.array([0, 10, 20_000, 30_000, 1_000_000])
    frames = list(video(of(scenes, 3), times, chunk=2, **SIZE))
    assert [t for t, _ in frames] == times.tolist()
    for t, image in frames:
        expected = render(of(scenes, 3), 1e-6 * t, **SIZE).image
        np.testing.assert_allclose(image, expected, atol=1e-4)


@pytest.mark.parametrize(
    "choice, message",
    [
        ({"speed": (0.0, 100.0)}, "speed is 0 100, but is drawn log-uniformly"),
        ({"zoom": (1.0, 0.5)}, "the least first"), ({"pause": 1.5}, "a share of the scenes"),
        ({"shake": -0.1}, "a share of the scenes"),
        ({"shake_pixels": (0.0, 1.0)}, "shake_pixels is 0 1"),
        ({"blur": (0.0, 0.5)}, "more than 0"),
        ({"shake_pixels": (1.0, 2.0)}, "--shake-pixels has no effect without --shake"),
        ({"blur": (5.0, 5.0)}, "one of 13.3 texture pixels, but at most 8"),
        ({"objects": 0, "plain": 0.5, "still": 0.1}, "still, plain: no effect with scenes without"),
        ({"objects": -1}, "objects is -1"), ({"tilt": -0.1}, "tilt"),
        ({"white": (0.9, 2.0)}, "white is 0.9 2"),
    ],
)  # fmt: skip
def test_impossible_scenes(choice, message):
    with pytest.raises(ValueError, match=message):
        SceneSettings(**choice)


def test_no_more_renderings_are_planned_than_there_are_microseconds(monkeypatch):
    monkeypatch.setattr(module, "speeds", lambda scene, t, **_: np.full(len(t), 1e12))
    times = rendering_times(None, np.array([0, 700, 5000]), height=8, width=8)
    np.testing.assert_array_equal(times, np.arange(5001))
