"""Random scene -> events -> reconstruction -> video with the truth: a demo without a recording.

Everything between the photographs and the pictures runs on the device, a few windows at a time, so
memory does not grow with the demo's length. The printed metrics compare the network's images,
clipped to [0, 1], with the truth at each window's end, after the state has warmed up.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from PIL import Image, ImageDraw, ImageFont

from firenet_jax.checkpoint import load_weights
from firenet_jax.errors import OutputError, SettingsError
from firenet_jax.evaluation.metrics import mse, ssim, temporal_error
from firenet_jax.network import Weights, initial_state
from firenet_jax.pictures import (
    DisplayState,
    display,
    event_pictures,
    initial_display_state,
    to_8_bit,
)
from firenet_jax.reconstruction import reconstruct
from firenet_jax.settings import check_seed, parse_size
from firenet_jax.simulation.scenes import Scene, SceneSettings, random_scene
from firenet_jax.simulation.sensor import FAULTY, Sensor, SensorSettings, random_sensor
from firenet_jax.simulation.sequences import simulate
from firenet_jax.simulation.textures import HELD_OUT, load_textures, photographs
from firenet_jax.storage.overlap import prefetch
from firenet_jax.storage.progress import bar
from firenet_jax.storage.resume import position_file
from firenet_jax.storage.video import check_output, followed, open_writer

WINDOWS_AT_ONCE = 10  # simulated and reconstructed at once
RENDERINGS = 5  # in a window, with at most half a pixel of motion between two
UNSCORED = 10  # windows from a zero state that the numbers leave out
CAPTION = 16  # pixels above the pictures


@dataclass(frozen=True)
class Demo:
    """Simulate a moving scene: its events, their reconstruction and the truth side by side.

    Examples:
      firenet demo -o demo.mp4
      firenet demo -o demo.gif --seconds 5 --seed 3 --faults
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """A name that ends in .mp4 or .gif, or a folder for png files: events (blue: brighter, red:
    darker), reconstruction and truth, in real time."""
    weights: Annotated[Path | None, tyro.conf.arg(aliases=["-c"])] = None
    """Weights: .npz, a published PyTorch checkpoint, or the folder of a training run. Default: the
    built-in weights."""
    seconds: float = 3.0
    """Duration of the scene."""
    fps: float = 30.0
    """Pictures per second; each is reconstructed from the events since the last."""
    seed: int = 0
    """Random seed of the scene."""
    sensor_size: str = "240x180"
    """WIDTHxHEIGHT of the simulated sensor."""
    faults: bool = False
    """Simulate the faults of real sensors: mismatch, noise, leak, hot pixels, finite bandwidth."""
    overwrite: bool = False
    """Replace an existing output."""

    def __post_init__(self):
        if not 0 < self.seconds <= 60:
            raise SettingsError(f"seconds is {self.seconds}, but must be more than 0 and up to 60")
        if not 1 <= self.fps <= 1000:
            raise SettingsError(f"fps is {self.fps}, but must be between 1 and 1000")
        if self.seconds * self.fps < 1:
            raise SettingsError(
                f"{self.seconds} s at {self.fps} pictures per second hold no picture"
            )
        check_seed(self.seed)
        height, width = parse_size(self.sensor_size)
        if min(height, width) < 16:
            raise SettingsError(f"a sensor of {width}x{height}: expected 16x16 or more")


class Shown(NamedTuple):
    """T windows of one sequence."""

    events: jax.Array  # (T, H, W, 3) uint8
    images: jax.Array  # (T, H, W) uint8, reconstructed
    truth: jax.Array  # (T, H, W) uint8
    errors: jax.Array  # (T, 3) float32: MSE, SSIM, temporal error


def run(settings: Demo) -> dict[str, float]:
    """Does what the settings say; returns the numbers it prints. Raises CheckpointError,
    OutputError or SettingsError with a message of one sentence."""
    weights = load_weights(settings.weights)
    output = followed(settings.output)
    check_output(output, settings.overwrite)
    if position_file(output).exists() and not settings.overwrite:
        raise OutputError(
            f"{position_file(output).parent} holds an unfinished reconstruction: remove it or pass "
            "--overwrite"
        )
    height, width = parse_size(settings.sensor_size)
    count = max(round(settings.seconds * settings.fps), 1)
    period = 1e6 / settings.fps
    sensor, scene = make_scene(settings, height, width)
    writer = open_writer(output, settings.fps)
    errors = np.zeros(3)
    warm_up = min(UNSCORED, count - 1)
    shown = prefetch(pictures(weights, sensor, scene, count, period, height, width), depth=1)
    try:
        caption = captions(["events", "reconstruction", "truth"], width)
        with bar(count, "pictures") as progress:
            for number, (picture, numbers) in enumerate(shown):
                writer.write(np.concatenate([caption, picture]), round((number + 1) * period))
                errors += numbers if number >= warm_up else 0
                progress.update()
        writer.finish()
    except BaseException:
        writer.abandon()
        raise
    finally:
        shown.close()
    values = (errors / (count - warm_up)).tolist()
    result: dict[str, float] = dict(zip(("mse", "ssim", "temporal_error"), values, strict=True))
    if count == 1:  # a first picture has no predecessor
        del result["temporal_error"]
    temporal = f", temporal error {result['temporal_error']:.4f}" if count > 1 else ""
    print(
        f"{settings.output}: {count} pictures of {width}x{height} pixels\n"
        f"  MSE {result['mse']:.4f}, SSIM {result['ssim']:.3f}{temporal}: "
        f"means over {count - warm_up} pictures, after {warm_up} of warm-up\n"
        "  (intensities 0 to 1, not equalised; SSIM: Gaussian window of sigma 1.5, data range 1)"
    )
    return result


def make_scene(settings: Demo, height: int, width: int) -> tuple[Sensor, Scene]:
    """One sensor and one scene, each with a leading axis of 1. The fastest point moves as fast as
    the renderings of a window allow, which suits the network too."""
    scene_key, sensor_key = jax.random.split(jax.random.key(settings.seed))
    # Photographs that no network here was trained on. Of the held-out ones only those that every
    # installation has, so that a seed gives the same scene on all machines.
    pictures = photographs({"skimage/data": HELD_OUT["skimage/data"]})
    textures = load_textures(pictures, count=16, size=320, seed=settings.seed)
    size = {"height": height, "width": width}
    scene = random_scene(
        scene_key,
        jnp.asarray(textures),
        duration=settings.seconds,
        speed=0.5 * RENDERINGS * settings.fps,
        settings=SceneSettings(pause=0.0),
        **size,
    )
    faults = FAULTY if settings.faults else SensorSettings()
    sensor = random_sensor(sensor_key, settings=faults, **size)
    return jax.tree.map(lambda leaf: leaf[None], (sensor, scene))


def pictures(
    weights: Weights, sensor: Sensor, scene: Scene, count: int, period: float, height, width
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields (H, 3 W, 3) uint8, events | reconstruction | truth, with (MSE, SSIM, temporal error),
    for `count` windows of `period` microseconds."""
    state = initial_state(1, height, width)
    sensor_state, last, ranges = None, None, initial_display_state(1)
    for start in range(0, count, WINDOWS_AT_ONCE):
        bounds = np.round(np.arange(start, start + WINDOWS_AT_ONCE + 1) * period).astype(np.int32)
        sensor_state, simulated = simulate(
            sensor, scene, bounds[:, None], sensor_state,
            height=height, width=width, renderings=RENDERINGS,
        )  # fmt: skip
        state, images = reconstruct(weights, state, simulated.tensors)
        images = images[:, 0]
        if last is None:  # the first picture has no predecessor, so its temporal error is none
            last = images[0], simulated.images[0, 0]
        last, ranges, shown = _show(simulated, images, last, ranges)
        shown = jax.device_get(shown)
        for t in range(min(WINDOWS_AT_ONCE, count - start)):
            greys = [np.stack([grey[t]] * 3, -1) for grey in (shown.images, shown.truth)]
            yield np.concatenate([shown.events[t], *greys], 1), shown.errors[t]


@jax.jit
def _show(simulated, images, last, ranges: DisplayState):
    """Windows of one sequence, images (T, H, W), and what came before them: the last (image, truth)
    and the ranges that were shown."""
    tensors, truth, displacement, visible = (leaf[:, 0] for leaf in simulated)
    ranges, greys = display(ranges, images[:, None])
    clipped = jnp.clip(images, 0.0, 1.0)
    previous, previous_truth = (
        jnp.concatenate([one[None], all[:-1]])
        for one, all in zip(last, (clipped, truth), strict=True)
    )
    errors = [mse(clipped, truth), ssim(clipped, truth)]
    errors.append(temporal_error(clipped, previous, displacement, truth, previous_truth, visible))
    numbers = jnp.stack(errors, -1)
    eight_bit = to_8_bit(truth)
    shown = Shown(event_pictures(tensors), greys[:, 0], eight_bit, numbers)
    return (clipped[-1], truth[-1]), ranges, shown


def captions(words: list[str], width: int) -> np.ndarray:
    """A strip (CAPTION, len(words) width, 3) uint8 with each word centred above its picture."""
    strip = Image.new("RGB", (len(words) * width, CAPTION), "white")
    draw, font = ImageDraw.Draw(strip), ImageFont.load_default(11)
    for k, word in enumerate(words):
        draw.text(((k + 0.5) * width, CAPTION / 2), word, "black", font, anchor="mm")
    return np.asarray(strip)
