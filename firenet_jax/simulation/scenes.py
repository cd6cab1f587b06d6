"""Textures and camera motion -> intensity video and its optical flow, as pure functions of time.

A scene is a textured plane before a camera that moves with six degrees of freedom, as in the
paper, and several textured objects in front of it, each a plane with its own motion and outline;
nearer objects hide farther ones. Nothing is simulated step by step: `render` and `flow` give the
picture and the exact displacement at any time, so frames can be as dense as a sensor needs.

Times are seconds since the scene's start, float32: its clock ticks in at most 1 us for 16 s, in 4
us at a minute. Images are (H, W) float32 in [0, 1], grey values as they stand in picture files (the
published network was trained on these). Lengths in the world are pixels as seen at the rest
distance of the background. All functions of JAX here are written for one scene; `jax.vmap` makes
them functions of many. Textures are (N, S, S) float32: `textures.load_textures`.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from firenet_jax.errors import SettingsError
from firenet_jax.settings import check_none_idle, check_range, check_refined, check_share
from firenet_jax.warp import sample

WAVES = 3  # sinusoids in each of the six coordinates of a motion
PAUSES = 2  # greatest number of stops in a scene
OUTLINE = 96  # cells on a side of an object's outline
MARGIN = 1.3  # the outline's field reaches so many radii from the centre
MOST_BLUR = 8.0  # texture pixels, standard deviation: wider kernels take long to compile
OF_OBJECTS = "still", "plain", "size", "softness"  # settings that say more of them


def _variance(blur, zoom):
    """Of the blur of textures, in texture pixels, squared, for one of so many image pixels.

    Half an image pixel keeps the picture free of aliasing; planes are seen up to a fifth farther
    away than at rest, and looking up bilinearly already blurs by 0.4 texture pixels.
    """
    seen = blur * 1.2 / zoom
    return seen * seen - 0.4**2


@dataclass(frozen=True)
class SceneSettings:
    """What random scenes look like. Pairs are (least, greatest)."""

    objects: int = 3
    """Greatest number of objects in front of the background; a scene shows 0 to all of them."""
    speed: tuple[float, float] = (3.0, 1000.0)
    """Pixels per second of the fastest point at its fastest time, drawn log-uniformly."""
    pause: float = 0.3
    """Probability that everything stands still for a while, in each half of the scene."""
    halt: float = 0.0
    """Probability that everything stops permanently in the first third of the scene, to teach the
    network to remember."""
    shake: float = 0.0
    """Probability that the camera trembles, as in a hand or on a machine: edges come and go by less
    than a pixel, or a few, while it moves or stands still."""
    shake_pixels: tuple[float, float] = (0.2, 4.0)
    """By how many pixels, drawn log-uniformly."""
    still: float = 0.0
    """Probability that the camera stands still all the time, if the scene has objects."""
    plain: float = 0.0
    """Probability that the background is plain grey, if the scene has objects, to teach the network
    that objects leave no trail."""
    zoom: tuple[float, float] = (0.45, 1.1)
    """Image pixels per texture pixel, drawn log-uniformly for each plane. Textures are blurred for
    that scale, so small ones do not flicker; above 1 they look blurred."""
    blur: tuple[float, float] = (0.5, 0.5)
    """Standard deviation of the optics' blur in image pixels, drawn log-uniformly for each scene;
    below 0.5 the finest texture flickers."""
    tilt: float = 0.3
    """Greatest tilt of a plane in radians."""
    size: tuple[float, float] = (0.08, 0.3)
    """Radius of the objects, relative to the picture's larger side."""
    softness: tuple[float, float] = (1.0, 3.0)
    """Pixels over which an object's edge fades, drawn log-uniformly; 1 is a sharp edge."""
    black: tuple[float, float] = (0.0, 0.08)
    """Intensity of black in a texture."""
    white: tuple[float, float] = (0.85, 1.0)
    """Intensity of white in a texture."""
    gamma: tuple[float, float] = (0.8, 1.25)
    """Gamma of a texture's values, drawn log-uniformly."""
    hdr: float = 0.0
    """Probability that part of a scene lies in deep shadow, 10 to 100 times darker."""

    def __post_init__(self):
        """Raises SettingsError for invalid values."""
        for name in ("speed", "shake_pixels", "zoom", "blur", "size", "softness", "gamma"):
            check_range(name, getattr(self, name))
        for name in ("pause", "halt", "shake", "still", "plain", "hdr"):
            check_share(name, getattr(self, name), of="scenes")
        if (widest := self.widest_blur) > MOST_BLUR:
            raise SettingsError(
                f"a blur of {self.blur[1]:g} image pixels at a zoom of {self.zoom[0]:g} is one of "
                f"{widest:.1f} texture pixels, but at most {MOST_BLUR:g}: ask for less --blur or a "
                "greater --zoom"
            )
        check_refined(self, {"shake_pixels": "shake"})
        if self.objects < 0:
            raise SettingsError(f"objects is {self.objects}, but must be 0 or more")
        if not self.objects:
            check_none_idle(self, OF_OBJECTS, "scenes without --objects")
        if not 0 <= self.tilt <= 1:
            raise SettingsError(f"tilt is {self.tilt} radians, but must be between 0 and 1")
        for name in ("black", "white"):
            least, greatest = getattr(self, name)
            if not 0 <= least <= greatest <= 1:
                raise SettingsError(
                    f"{name} is {least:g} {greatest:g}, but both are intensities, 0 to 1, "
                    "the least first"
                )

    @property
    def widest_blur(self) -> float:
        """The greatest standard deviation of a texture's blur, in its pixels."""
        return math.sqrt(max(_variance(self.blur[1], self.zoom[0]), 0.01))


class Motion(NamedTuple):
    """A smooth path through poses: each coordinate a sum of sinusoids of the way gone."""

    amplitude: jax.Array  # (6, WAVES): x, y, z in pixels, rotation about x, y, z in radians
    frequency: jax.Array  # (6, WAVES) radians for each unit of the way
    phase: jax.Array  # (6, WAVES) radians
    pace: jax.Array  # () units of the way per second, pauses apart


class Scene(NamedTuple):
    """K objects before a background; planes are numbered from the back, the background is 0."""

    focal: jax.Array  # () pixels, also the distance of the background at rest
    camera: Motion
    shake: Motion | None  # added to the camera's
    places: jax.Array  # (K + 1, 6) each plane's pose at rest: centre and rotation
    motions: Motion  # leading axis K + 1
    # One array for each plane: looked up in a stack of them, each would be copied every time.
    textures: tuple[jax.Array, ...]  # K + 1 of (S, S) intensities, blurred for their scale
    density: jax.Array  # (K + 1,) texture pixels for each pixel in the world
    origin: jax.Array  # (K + 1, 2) texture coordinates of the plane's centre
    outlines: jax.Array  # (K, OUTLINE, OUTLINE) distance from the edge in radii, inside > 0
    radius: jax.Array  # (K, 2) in pixels in the world, and as seen at rest
    softness: jax.Array  # (K,) pixels over which the edge fades
    pauses: jax.Array  # (PAUSES, 3) seconds: start, end, and how long stopping takes
    speed: jax.Array  # () pixels per second; no point of the picture moves faster
    # at the times of `_at_speed`; between them, in scenes of a minute, by up to an eighth


class Rendering(NamedTuple):
    """What the camera sees at one time."""

    image: jax.Array  # (H, W) float32 in [0, 1]
    plane: jax.Array  # (H, W) int32, the plane that covers most of the pixel


# ---- Scenes


@partial(jax.jit, static_argnames=("height", "width", "settings"))
def random_scene(
    key: jax.Array,
    textures: jax.Array,
    *,
    height: int,
    width: int,
    duration: jax.Array | float = 2.0,
    speed: jax.Array | float | None = None,
    settings: SceneSettings = SceneSettings(),
) -> Scene:
    """key, textures (N, S, S) in [0, 1] -> a scene for pictures of this size and duration.

    duration: seconds, over which pauses are placed and the speed is measured.
    speed: pixels per second of the fastest point; None draws it from `settings.speed`.
    """
    planes, side = settings.objects + 1, float(max(height, width))
    key, camera_key, object_keys, outline_keys, light_key = jax.random.split(key, 5)
    uniform, log_uniform = _dice(key, 16 + 16 * planes)
    if speed is None:
        speed = log_uniform(settings.speed)
    # An object's distance from the camera, in parts of the background's; the nearest comes last.
    depth = jnp.sort(uniform((0.5, 0.95), (settings.objects,)))[::-1]
    depth = jnp.concatenate([jnp.ones(1), depth])
    focal = side * uniform((0.8, 1.6))
    # Handheld: sideways by up to half a picture, nearer and farther by up to a fifth, turning.
    camera = _wander(camera_key, side, (0.1, 0.5), focal, (0.0, 0.2), (0.12, 0.12, 0.4))
    shake = _shake(jax.random.fold_in(camera_key, 1), side, settings)

    def tumble(key, depth):  # across up to half of the picture
        reach = side * depth
        return _wander(key, reach, (0.05, 0.5), reach, (0.0, 0.1), (0.15, 0.15, 0.8))

    objects = jax.vmap(tumble)(jax.random.split(object_keys, planes), depth)
    ground = jnp.arange(planes) == 0
    objects = objects._replace(amplitude=jnp.where(ground[:, None, None], 0.0, objects.amplitude))

    centres = uniform((-0.4, 0.4), (planes, 2)) * depth[:, None] * jnp.array([[width, height]])
    centres = jnp.where(ground[:, None], 0.0, centres)
    leaning = uniform((-settings.tilt, settings.tilt), (planes, 2))
    turned = uniform((-0.3, 0.3), (planes, 1)) * jnp.where(ground, 1.0, 5.0)[:, None]
    places = jnp.concatenate([centres, focal * depth[:, None], leaning, turned], -1)

    zoom = log_uniform(settings.zoom, (planes,))
    size = textures.shape[-1]
    chosen = textures[_whole(uniform((0.0, textures.shape[0]), (planes,)), textures.shape[0])]
    lit = _lit(light_key, chosen, settings)
    blur = _dice(jax.random.fold_in(key, 1), 1)[1](settings.blur)
    sigma = jnp.sqrt(jnp.maximum(_variance(blur, zoom), 1e-4))
    reach = min(math.ceil(3 * settings.widest_blur), size - 1)
    blurred = jax.vmap(partial(_blurred, reach=reach))(lit, sigma)
    canvases = jnp.clip(blurred, 0.0, 1.0)  # rounding may exceed 1
    origin = (size - 1) / 2 + uniform((-0.15, 0.15), (planes, 2)) * size

    outlines = jax.vmap(_outline)(jax.random.split(outline_keys, settings.objects))
    shown = _whole(uniform((0.0, settings.objects + 1)), settings.objects + 1)
    absent = jnp.arange(settings.objects) >= shown
    outlines = jnp.where(absent[:, None, None], -jnp.float32(side), outlines)
    seen_radius = side * log_uniform(settings.size, (settings.objects,))

    pauses = _pauses(uniform, duration, settings)
    if settings.plain:
        plain = (uniform((0.0, 1.0)) < settings.plain) & (shown > 0)
        canvases = canvases.at[0].set(jnp.where(plain, uniform((0.2, 0.8)), canvases[0]))

    scene = Scene(
        focal=focal,
        camera=camera,
        shake=shake,
        places=places,
        motions=objects,
        textures=tuple(canvases),
        density=1 / (zoom * depth),
        origin=origin,
        outlines=outlines,
        radius=jnp.stack([seen_radius * depth[1:], seen_radius], -1),
        softness=log_uniform(settings.softness, (settings.objects,)),
        pauses=pauses,
        speed=jnp.asarray(speed, jnp.float32),
    )
    # The camera leads; objects move by themselves between a tenth and once as fast.
    scene = _paced(scene, 1.0 / side, log_uniform((0.1, 1.0), (planes,)))
    still = (uniform((0.0, 1.0)) < settings.still) & (shown > 0)
    pace = jnp.where(still, 0.0, scene.camera.pace)
    scene = scene._replace(camera=scene.camera._replace(pace=pace))
    return _at_speed(scene, speed, duration, height, width)


def _pauses(uniform, duration, settings: SceneSettings) -> jax.Array:
    """(PAUSES, 3): starts, ends and ramps of a scene's pauses, seconds."""
    # One pause at most in each half, so that two never overlap.
    ramp = 0.02 * duration
    start = duration * (uniform((0.02, 0.3), (PAUSES,)) + jnp.arange(PAUSES) / PAUSES)
    length = duration * uniform((0.02, 0.5 - 0.3 - 0.02), (PAUSES,))
    length = jnp.where(uniform((0.0, 1.0), (PAUSES,)) < settings.pause, length, 0.0)
    pauses = jnp.stack([start, start + length, jnp.broadcast_to(ramp, (PAUSES,))], -1)

    if settings.halt:
        halted = uniform((0.0, 1.0)) < settings.halt
        for_good = jnp.stack([start, start + 100 * duration * jnp.array([1.0, 0.0])], -1)
        # The second pause, of no length then, must not count twice.
        pauses = jnp.where(halted, jnp.concatenate([for_good, pauses[:, 2:]], -1), pauses)
    return pauses


def log_uniform(bounds: tuple[float, float], numbers: jax.Array) -> jax.Array:
    """Uniform numbers in [0, 1) -> log-uniform ones between the bounds."""
    low, high = (math.log(bound) for bound in bounds)
    return jnp.exp(low + (high - low) * numbers)


def _dice(key: jax.Array, count: int):
    """key -> two functions (bounds, shape) -> random numbers, uniform and log-uniform.

    All are drawn at once and handed out in turn: dozens of separate draws take XLA's CPU compiler
    ten seconds.
    """
    numbers, place = jax.random.uniform(key, (count,)), 0

    def uniform(bounds, shape=()):
        nonlocal place
        first, place = place, place + math.prod(shape)
        if place > count:
            raise ValueError(f"more than {count} random numbers are needed")
        low, high = bounds
        return low + (high - low) * numbers[first:place].reshape(shape)

    def log_uniformly(bounds, shape=()):
        return log_uniform(bounds, uniform((0.0, 1.0), shape))

    return uniform, log_uniformly


def _whole(numbers: jax.Array, count: int) -> jax.Array:
    """Uniform in [0, count] -> 0 .. count - 1."""
    return jnp.clip(numbers.astype(jnp.int32), 0, count - 1)


def _waves(uniform, log_uniform, amplitude: jax.Array) -> Motion:
    """Amplitudes (6,) -> a random motion whose coordinates reach about so far."""
    share = uniform((0.2, 1.0), (6, WAVES))
    return Motion(
        amplitude=amplitude[:, None] * share / share.sum(-1, keepdims=True),
        frequency=log_uniform((0.4, 2.5), (6, WAVES)),
        phase=uniform((0.0, 2 * math.pi), (6, WAVES)),
        pace=jnp.ones(()),
    )


def _wander(key: jax.Array, side, across, distance, along, turn) -> Motion:
    """Sideways and nearer by shares (least, greatest) of these pixels, turning by these radians."""
    uniform, log_uniform = _dice(key, 6 + 18 * WAVES)
    sideways = side * uniform(across, (2,))
    nearer = distance * uniform(along, (1,))
    turned = jnp.array(turn) * uniform((0.0, 1.0), (3,))
    return _waves(uniform, log_uniform, jnp.concatenate([sideways, nearer, turned]))


def _shake(key: jax.Array, side: float, settings: SceneSettings) -> Motion | None:
    """Sideways by few pixels, and so often that it is about as fast as the other motion."""
    if not settings.shake:
        return None
    uniform, log_uniform = _dice(key, 5 + 18 * WAVES)
    shakes = uniform((0.0, 1.0)) < settings.shake
    across, speed = log_uniform(settings.shake_pixels), side * log_uniform((0.1, 2.0))
    shares = jnp.append(uniform((0.3, 1.0), (2,)), jnp.zeros(4))
    motion = _waves(uniform, log_uniform, jnp.where(shakes, across * shares, 0.0))
    return motion._replace(frequency=motion.frequency * speed / across)


def _lit(key: jax.Array, textures: jax.Array, settings: SceneSettings) -> jax.Array:
    """Texture values (planes, S, S) -> intensities: one gamma, black and white for the scene."""
    planes, size = textures.shape[:2]
    uniform, log_uniform = _dice(key, 5 + 3 * planes)
    gamma = log_uniform(settings.gamma)
    black, white = uniform(settings.black), uniform(settings.white)
    lit = black + (white - black) * jnp.maximum(textures, 1e-4) ** gamma
    if settings.hdr == 0:
        return lit
    # Bands of light and shadow across each plane, their edges soft.
    depth = jnp.where(uniform((0.0, 1.0)) < settings.hdr, jnp.log(log_uniform((10, 100))), 0.0)
    slope, phase = uniform((-1.5, 1.5), (planes, 2)), uniform((0.0, 2 * math.pi), (planes,))
    ramp = 2 * jnp.pi * jnp.arange(size, dtype=jnp.float32) / size
    waves = slope[:, :1, None] * ramp[None, None] + slope[:, 1:, None] * ramp[None, :, None]
    shade = 0.5 + 0.5 * jnp.tanh(3 * jnp.sin(waves + phase[:, None, None]))
    return lit * jnp.exp(-depth * shade)


def _blurred(image: jax.Array, sigma: jax.Array, reach: int) -> jax.Array:
    """(S, S) -> the same under a Gaussian of this many pixels, cut off `reach` pixels from its
    middle, mirrored at the border."""
    distance = jnp.arange(-reach, reach + 1, dtype=jnp.float32)
    weights = jnp.exp(-0.5 * (distance / sigma) ** 2)
    weights = weights / weights.sum()
    for axis in (0, 1):
        padded = jnp.pad(image, [(reach * (a == axis),) * 2 for a in (0, 1)], mode="reflect")
        size = image.shape[axis]
        shifted = (
            weights[k] * jax.lax.slice_in_dim(padded, k, k + size, axis=axis)
            for k in range(2 * reach + 1)
        )
        image = sum(shifted, jnp.zeros_like(image))
    return image


def _outline(key: jax.Array) -> jax.Array:
    """An object's form: distance from its edge in radii, positive inside, (OUTLINE, OUTLINE).

    Blobs, regular polygons, stars and rings: the edge is a function of the angle.
    """
    uniform, log_uniform = _dice(key, 16)
    place = jnp.linspace(-MARGIN, MARGIN, OUTLINE)
    y, x = jnp.meshgrid(place, place, indexing="ij")
    border = MARGIN - 0.05 - jnp.maximum(jnp.abs(x), jnp.abs(y))
    stretch = log_uniform((0.67, 1.5))
    x, y = x * jnp.maximum(stretch**2, 1.0), y * jnp.maximum(stretch**-2, 1.0)  # only slimmer
    r, angle = jnp.hypot(x, y), jnp.arctan2(y, x)

    waves = jnp.arange(2, 6, dtype=jnp.float32)
    phases, sizes = uniform((0.0, 2 * math.pi), (4,)), uniform((0.0, 0.35), (4,)) / waves
    bumps = [sizes[k] * jnp.sin(waves[k] * angle + phases[k]) for k in range(4)]
    blob = 0.8 + sum(bumps)
    corners = 3.0 + _whole(uniform((0.0, 5.0)), 5)
    half = jnp.pi / corners
    polygon = jnp.cos(half) / jnp.cos(jnp.mod(angle, 2 * half) - half)
    star = 0.75 + 0.25 * jnp.cos(corners * angle)
    kind = _whole(uniform((0.0, 4.0)), 4)
    edge = jnp.choose(kind, [blob, polygon, star, jnp.ones_like(r)], mode="clip")
    # A quarter of all are hollow, polygons and stars too.
    hole = jnp.where(uniform((0.0, 1.0)) < 0.25, 0.35, -1.0)
    # Nothing reaches the border, whose values stand for all beyond it.
    return jnp.minimum(jnp.minimum(edge - r, r - hole), border)


def _paced(scene: Scene, factor, objects: jax.Array | float = 1.0) -> Scene:
    """The scene, its paces times this factor, those of its objects times another one, too."""
    return scene._replace(
        camera=scene.camera._replace(pace=scene.camera.pace * factor),
        shake=scene.shake and scene.shake._replace(pace=scene.shake.pace * factor),
        motions=scene.motions._replace(pace=scene.motions.pace * factor * objects),
    )


def _at_speed(scene: Scene, speed, duration, height: int, width: int) -> Scene:
    """The scene, its paces scaled until the fastest point reaches this speed but never more.

    A faster pace sees more of the path, and so perhaps a faster part of it: hence the rounds.
    The speed is measured at 128 times, or at 1,024 of a camera that trembles; 5 % cover what
    happens between them in a few seconds. (Renderings are as dense as motion wants in any scene:
    `rendering_times` measures for itself.)
    """
    times = duration * jnp.linspace(0.0, 1.0, 128 if scene.shake is None else 1024)

    def improve(round, carry):
        scene, _ = carry
        peak = 1.05 * speeds(scene, times, height=height, width=width).max()
        factor = speed / jnp.maximum(peak, 1e-6)
        # The later rounds only slow down, so that the bound holds; the last only measures.
        most = jnp.array([jnp.inf, jnp.inf, jnp.inf, 1.0, 1.0, 1.0])[round]
        factor = jnp.where(round == 6, 1.0, jnp.minimum(factor, most))
        return _paced(scene, factor), peak

    scene, peak = jax.lax.fori_loop(0, 7, improve, (scene, jnp.zeros(())))
    return scene._replace(speed=peak)


# ---- Poses


def _clock(pauses: jax.Array, t: jax.Array) -> jax.Array:
    """Seconds -> seconds without the pauses, differentiable: stopping and starting are smooth."""

    def run(x):  # the integral of the smooth step 3 x^2 - 2 x^3, which goes from 0 to 1
        inside = jnp.clip(x, 0.0, 1.0)
        return inside**3 - 0.5 * inside**4 + jnp.maximum(x - 1, 0.0)

    start, end, ramp = pauses[:, 0], pauses[:, 1], pauses[:, 2]
    return t - (ramp * (run((t - start) / ramp) - run((t - end) / ramp))).sum()


def _pose(motion: Motion, clock: jax.Array) -> jax.Array:
    """(6,): x, y, z in pixels and rotations in radians."""
    way = motion.pace * clock
    return (motion.amplitude * jnp.sin(motion.frequency * way + motion.phase)).sum(-1)


def _product(a: jax.Array, b: jax.Array) -> jax.Array:
    """3x3 matrices, entry by entry: so small a product is slower, and not safe, as a dot on CPUs
    (jax-ml/jax#39103)."""
    return (a[:, :, None] * b[None, :, :]).sum(1)


def _rotation(angles: jax.Array) -> jax.Array:
    """Angles about x, y, z (3,) -> rotation (3, 3), about x first."""
    (cx, cy, cz), (sx, sy, sz) = jnp.cos(angles), jnp.sin(angles)
    rows = (
        [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
        [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
        [-sy, cy * sx, cy * cx],
    )
    return jnp.stack([jnp.stack(row) for row in rows])


def _to_image(scene: Scene, t: jax.Array, height: int, width: int) -> jax.Array:
    """Homographies (K + 1, 3, 3) at time t: coordinates on each plane -> the image's (x, y)."""
    clock = _clock(scene.pauses, jnp.asarray(t, jnp.float32))
    camera = _pose(scene.camera, clock)
    if scene.shake is not None:
        camera += _pose(scene.shake, clock)
    turn = _rotation(camera[3:])
    # Distances in parts of the focal length, so that all entries are of the order of 1.
    rows = [1.0, 0.0, (width - 1) / 2], [0.0, 1.0, (height - 1) / 2], [0.0, 0.0, 1.0]
    lens = jnp.stack([jnp.array(row) for row in rows])
    scale = jnp.stack([jnp.ones(()), jnp.ones(()), 1 / scene.focal])[:, None]

    def one(place, motion):
        pose = place + _pose(motion, clock)
        axes = _rotation(pose[3:])
        plane = jnp.concatenate([axes[:, :2], (pose - camera)[:3, None]], 1)
        return _product(lens, scale * _product(turn, plane))

    return jax.vmap(one)(scene.places, scene.motions)


def _inverse(matrices: jax.Array) -> jax.Array:
    """(K, 3, 3) -> their inverses, by cross products."""
    a, b, c = matrices[:, 0], matrices[:, 1], matrices[:, 2]
    adjugate = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], -1)
    determinant = (a * jnp.cross(b, c)).sum(-1)
    return adjugate / determinant[:, None, None]


def _project(matrix: jax.Array, x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Homography (3, 3), coordinates of one shape -> coordinates of that shape."""
    m = matrix
    # What lies behind the camera is pushed far away instead of coming back upside down.
    nearness = 1 / jnp.maximum(m[2, 0] * x + m[2, 1] * y + m[2, 2], 0.01)
    return (
        (m[0, 0] * x + m[0, 1] * y + m[0, 2]) * nearness,
        (m[1, 0] * x + m[1, 1] * y + m[1, 2]) * nearness,
    )


@partial(jax.jit, static_argnames=("height", "width"))
def speeds(scene: Scene, t: jax.Array, *, height: int, width: int) -> jax.Array:
    """Times (n,) -> pixels per second of the fastest point of the picture at each, (n,).

    Measured, from the motions' derivatives, at nine points of the picture for the background and
    at nine of its bounding box for each object.
    """
    corners = jnp.array([-1.0, 0.0, 1.0])
    box_y, box_x = (grid.ravel() for grid in jnp.meshgrid(corners, corners, indexing="ij"))
    last_x, last_y = width - 1.0, height - 1.0
    exists = jnp.append(True, scene.outlines.max((1, 2), initial=-1.0) > 0)

    def at(t):
        to_image = _to_image(scene, t, height, width)
        to_plane = _inverse(to_image)
        x = (0.5 + 0.5 * box_x) * last_x
        y = (0.5 + 0.5 * box_y) * last_y
        reach = MARGIN * scene.radius[:, :1]
        boxes = jax.vmap(_project)(to_image[1:], reach * box_x[None], reach * box_y[None])
        # Only what is in the picture counts.
        x = jnp.concatenate([x[None], jnp.clip(boxes[0], 0.0, last_x)])
        y = jnp.concatenate([y[None], jnp.clip(boxes[1], 0.0, last_y)])
        points = jax.vmap(_project)(to_plane, x, y)

        def positions(t):
            return jax.vmap(_project)(_to_image(scene, t, height, width), *points)

        _, (dx, dy) = jax.jvp(positions, (t,), (jnp.ones_like(t),))
        fastest = jnp.hypot(dx, dy).max(-1)  # (K + 1,)
        return jnp.where(exists, fastest, 0.0).max()

    return jax.vmap(at)(jnp.asarray(t, jnp.float32))


# ---- Pictures and flow


def _grid(height: int, width: int) -> tuple[jax.Array, jax.Array]:
    row, column = jnp.arange(height, dtype=jnp.float32), jnp.arange(width, dtype=jnp.float32)
    y, x = jnp.meshgrid(row, column, indexing="ij")
    return x, y


def _colour(scene: Scene, k: int, u: jax.Array, v: jax.Array) -> jax.Array:
    """Intensity of plane k at its coordinates; textures go on, mirrored, for ever."""
    size = scene.textures[k].shape[-1]

    def mirrored(x):
        period = 2.0 * (size - 1)
        return jnp.abs(x - period * jnp.round(x * (1 / period)))

    u = mirrored(scene.origin[k, 0] + scene.density[k] * u)
    v = mirrored(scene.origin[k, 1] + scene.density[k] * v)
    return sample(scene.textures[k], u, v)


def _inside(outline: jax.Array, radii: jax.Array, u: jax.Array, v: jax.Array) -> jax.Array:
    """Pixels from the edge of an object at its coordinates, positive inside."""
    radius, seen = radii
    centre = (OUTLINE - 1) / 2
    cells = centre / (MARGIN * radius)
    return seen * sample(outline, centre + cells * u, centre + cells * v)


@partial(jax.jit, static_argnames=("height", "width"))
def render(scene: Scene, t: jax.Array, *, height: int, width: int) -> Rendering:
    """The picture at time t, and which plane is in front."""
    x, y = _grid(height, width)
    to_plane = _inverse(_to_image(scene, t, height, width))
    image = _colour(scene, 0, *_project(to_plane[0], x, y))
    plane = jnp.zeros((height, width), jnp.int32)
    for k in range(1, len(scene.textures)):  # from back to front
        u, v = _project(to_plane[k], x, y)
        inside = _inside(scene.outlines[k - 1], scene.radius[k - 1], u, v)
        cover = jnp.clip(0.5 + inside / scene.softness[k - 1], 0.0, 1.0)
        image = image + cover * (_colour(scene, k, u, v) - image)
        plane = jnp.where(inside >= 0, k, plane)
    return Rendering(image, plane)


@partial(jax.jit, static_argnames=("height", "width"))
def flow(
    scene: Scene, t0: jax.Array, t1: jax.Array, *, height: int, width: int
) -> tuple[jax.Array, jax.Array]:
    """How the picture moved from t0 to t1: displacement (H, W, 2) float32, visible (H, W) bool.

    On the grid of the picture at t1, in pixels, x then y: what is at x now was at x - d(x) then,
    so `warp(image at t0, displacement)` shows the picture at t1 where it is visible. Exact, from
    the homographies. Not visible is what was outside the picture at t0 or behind an object, and
    what lies within a pixel of an edge, where a pixel mixes two motions.
    """
    x, y = _grid(height, width)
    now, then = (_to_image(scene, t, height, width) for t in (t1, t0))
    now_to_plane, then_to_plane = _inverse(now), _inverse(then)
    objects = range(1, len(scene.textures))

    # Inside a loop of its own each distance is made once; elsewhere XLA looks the outlines up for
    # each use, in a way that is ten times slower on a CPU.
    def distances(to_plane, x, y):
        def one(inputs):
            outline, radii, matrix = inputs
            return _inside(outline, radii, *_project(matrix, x, y))

        return jax.lax.map(one, (scene.outlines, scene.radius, to_plane[1:]))

    # Where an edge has faded to a tenth, and the pixel more that bilinear interpolation reaches.
    edge = 1.0 + 0.4 * scene.softness
    front = jnp.zeros((height, width), jnp.int32)
    x0, y0 = _project(then[0], *_project(now_to_plane[0], x, y))
    clear = jnp.full((height, width), jnp.inf)  # pixels from the nearest edge in sight
    inside = distances(now_to_plane, x, y)
    for k in objects:
        owned = inside[k - 1] >= 0
        x0_k, y0_k = _project(then[k], *_project(now_to_plane[k], x, y))
        x0, y0 = jnp.where(owned, x0_k, x0), jnp.where(owned, y0_k, y0)
        front = jnp.where(owned, k, front)
        # An object that covers a pixel wholly also covers the edges behind it.
        rim = jnp.abs(inside[k - 1]) - edge[k - 1]
        clear = jnp.where(owned, rim, jnp.minimum(rim, clear))
    inside = distances(then_to_plane, x0, y0)
    for k in objects:
        clear = jnp.where(front < k, jnp.minimum(-inside[k - 1] - edge[k - 1], clear), clear)
    visible = (x0 >= 0) & (x0 <= width - 1) & (y0 >= 0) & (y0 <= height - 1) & (clear >= 0)
    return jnp.stack([x - x0, y - y0], -1), visible


def rendering_times(
    scene: Scene,
    bounds: np.ndarray,
    *,
    height: int,
    width: int,
    pixels: float = 0.5,
    longest: int = 10_000,
) -> np.ndarray:
    """When to render so that nothing moves more than half a pixel between two renderings.

    bounds: (n,) int64 microseconds since the scene's start, all of which are rendered (ends of
    windows, frames). Returns int64 microseconds from the first to the last of them, dense where
    the scene is fast and never farther apart than `longest`.
    """
    bounds = np.unique(np.asarray(bounds, np.int64))
    grid = np.union1d(np.arange(bounds[0], bounds[-1], 1000), bounds)
    padded = np.pad(grid, (0, -len(grid) % 1024), mode="edge")  # few sizes, few compilations
    speed = np.asarray(speeds(scene, padded * 1e-6, height=height, width=width))[: len(grid)]
    speed = 1.1 * np.maximum(speed[1:], speed[:-1])  # whichever end of a millisecond is faster
    rate = np.clip(speed * 1e-6 / pixels, 1 / longest, 1.0)  # renderings for each microsecond
    done = np.concatenate([[0.0], np.cumsum(rate * np.diff(grid))])
    at = done[np.searchsorted(grid, bounds)]
    counts = np.maximum(np.ceil(np.diff(at)), 1).astype(int)
    steps = [
        np.linspace(begin, end, count, endpoint=False)
        for begin, end, count in zip(at[:-1], at[1:], counts, strict=True)
    ]
    times = np.round(np.interp(np.concatenate([*steps, at[-1:]]), done, grid)).astype(np.int64)
    return np.union1d(times, bounds)


@partial(jax.jit, static_argnames=("height", "width"))
def _images(scene: Scene, times: jax.Array, *, height: int, width: int) -> jax.Array:
    return jax.lax.map(lambda t: render(scene, 1e-6 * t, height=height, width=width).image, times)


def video(
    scene: Scene, times: np.ndarray, *, height: int, width: int, chunk: int = 16
) -> Iterator[tuple[int, jax.Array]]:
    """Microseconds since the scene's start (n,) -> each of them with its image (H, W)."""
    times = np.asarray(times, np.int32)
    for start in range(0, len(times), chunk):
        part = times[start : start + chunk]
        padded = np.pad(part, (0, chunk - len(part)), mode="edge")  # one size, one compilation
        images = _images(scene, padded, height=height, width=width)
        yield from zip(part.tolist(), images[: len(part)], strict=True)
