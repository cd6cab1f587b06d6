"""Recordings or simulated scenes -> labelled pictures: what the scripts of the figures share.

A simulated scene shows the pictures that no network here was trained on (`textures.HELD_OUT`), so
that it judges built-in weights fairly. What cannot be shown is a named gap: a grey cell that says
why, and a sentence under the figure.
"""

import argparse
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

from firenet_jax.evaluation import metrics
from firenet_jax.evaluation.equalise import equalise
from firenet_jax.evaluation.methods import Method, Missing, load
from firenet_jax.evaluation.protocol import CUTS
from firenet_jax.events import Frames, Recording, concatenate
from firenet_jax.filters import between
from firenet_jax.pictures import event_pictures, to_8_bit
from firenet_jax.readers import open_recording
from firenet_jax.simulation.scenes import (
    SceneSettings,
    random_scene,
    render,
    rendering_times,
    video,
)
from firenet_jax.simulation.sensor import FAULTY, SensorSettings, event_list, random_sensor
from firenet_jax.simulation.textures import HELD_OUT, load_textures, photographs
from firenet_jax.tensors import pack, voxelise
from firenet_jax.windows import Window, Windows, cut

DOCS = Path(__file__).parents[1] / "docs"
HEIGHT, WIDTH = 180, 240  # of simulated sensors, as in the Event Camera Dataset
TITLES = {"hf": "HF", "mr": "MR", "e2vid": "E2VID", "firenet": "FireNet"}  # the paper's order
CONDITIONS = {  # simulated sequences: pixels per second of the fastest point, faults
    "slow": (50.0, False),
    "fast": (250.0, False),
    "slow, faulty sensor": (50.0, True),
    "fast, faulty sensor": (250.0, True),
}
NEAR = 50_000  # microseconds: a camera's frame farther away is not the truth of a picture
LARGEST = 300_000  # bytes of a file in docs/
GAP, LINE = 6, 18  # pixels between cells, and of a line of text


# ---- Arguments and methods


def arguments(doc: str, seconds: float) -> argparse.ArgumentParser:
    """What all figures are told; `seconds` is this figure's default.

    The default seed was chosen because 3, 4, 5 and 6 show four different pictures; for figure 4,
    seeds 0 and 10 were seen too, a mirrored texture and a flat one.
    """
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    parser.add_argument("--weights", type=Path, help="FireNet's, instead of the built-in ones")
    parser.add_argument("--e2vid-weights", type=Path, help="E2VID's published checkpoint")
    parser.add_argument(
        "--seconds", type=float, default=seconds, help=f"of each sequence (default {seconds:g})"
    )
    parser.add_argument("--seed", type=int, default=3, help="of the first simulated scene")
    parser.add_argument("--out", type=Path, default=DOCS, help="folder of the figure")
    return parser


def with_recordings(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    parser.add_argument("recordings", type=Path, nargs="*", help="none: simulated scenes")
    parser.add_argument(
        "--start", type=float, help="seconds after a recording's first event (default: the "
        "beginning of the interval that EVREAL judges, where the name is known)"
    )  # fmt: skip
    return parser


def load_methods(names: list[str], options) -> dict[str, Method | Missing]:
    """Title -> method, in this order."""
    weights = () if options.weights is None else (options.weights,)
    found = load(names, weights, options.e2vid_weights)
    return {TITLES[name]: method for name, method in zip(names, found, strict=True)}


def about_weights(options) -> str:
    return "built-in weights" if options.weights is None else f"weights {options.weights.name}"


def gaps(methods: dict[str, Method | Missing]) -> list[str]:
    """A sentence for each method that cannot run."""
    return [f"{t}: {m.reason}." for t, m in methods.items() if isinstance(m, Missing)]


# ---- Sequences


class Sequence(NamedTuple):
    """Events, and what the camera really saw."""

    name: str
    recording: Recording
    truth: Callable[[int], np.ndarray | None]  # microseconds -> (H, W) in [0, 1]; None: no frame


def recorded(path: Path, start: float | None, seconds: float) -> Sequence:
    """So many seconds of a recording. Its truth is the nearest frame."""
    recording = open_recording(path)
    name = path.resolve().stem
    begin = CUTS.get(name, (0.0, 0.0))[0] if start is None else start
    frames = recording.frames

    def truth(time: int) -> np.ndarray | None:
        if frames is None:
            return None
        distance = np.abs(frames.times - time)
        nearest = int(distance.argmin())
        return None if distance[nearest] > NEAR else frames.read(nearest) / np.float32(255)

    part = replace(recording, events=lambda: between(recording.events(), begin, begin + seconds))
    return Sequence(name, part, truth)


def simulated(
    name: str,
    seed: int,
    *,
    speed: float,
    seconds: float,
    faulty: bool = False,
    height: int = HEIGHT,
    width: int = WIDTH,
    fps: float = 25.0,
    zoom: tuple[float, float] = SceneSettings().zoom,
) -> Sequence:
    """A scene whose fastest point moves by `speed` pixels per second, with frames at `fps`."""
    scene_key, sensor_key = jax.random.split(jax.random.key(seed))
    size = {"height": height, "width": width}
    # larger textures would enlarge the smallest of the pictures
    textures = load_textures(photographs(HELD_OUT), 16, min(4 * width // 3, 512), seed)
    scene = random_scene(
        scene_key,
        jnp.asarray(textures),
        duration=seconds,
        speed=speed,
        settings=SceneSettings(pause=0.0, zoom=zoom),
        **size,
    )
    sensor = random_sensor(sensor_key, settings=FAULTY if faulty else SensorSettings(), **size)
    times = np.round(np.arange(0, seconds, 1 / fps) * 1e6).astype(np.int64)
    bounds = np.append(times, round(1e6 * seconds))
    renderings = video(scene, rendering_times(scene, bounds, **size), **size)
    events = concatenate(list(event_list(sensor, renderings)))

    def truth(time: int) -> np.ndarray:
        return np.asarray(render(scene, 1e-6 * time, **size).image)

    frames = Frames(times, lambda i: np.asarray(to_8_bit(truth(int(times[i])))))
    recording = Recording(
        Path(name), "simulated", height, width, lambda: iter([events]), len(events), frames
    )
    return Sequence(name, recording, truth)


def conditions(options) -> Iterator[Sequence]:
    """The recordings that are named; without any, a simulated sequence of each condition."""
    for path in options.recordings:
        yield recorded(path, options.start, options.seconds)
    if not options.recordings:
        for k, (name, (speed, faulty)) in enumerate(CONDITIONS.items()):
            seed = options.seed + k
            yield simulated(name, seed, speed=speed, seconds=options.seconds, faulty=faulty)


def about_data(recordings: list[Path]) -> str:
    if recordings:
        names = ", ".join(path.resolve().stem for path in recordings)
        return f"Recordings, not simulated here: {names}."
    return "SIMULATED scenes (held-out photographs, ESIM's sensor), no real recording."


def windows_of(sequence: Sequence, windows: Windows, most: int | None = None) -> list[Window]:
    """All, or the first so many, without the last one, which may be partial."""
    stop = None if most is None else most + 1
    found = list(islice(cut(sequence.recording, windows), stop))[:-1]
    if not found:
        raise SystemExit(f"{sequence.name}: too few events for two windows: raise --seconds")
    return found


# ---- Images


def images(method: Method, windows: list[Window], recording: Recording, recurrent: bool = True):
    """Yields the image (H, W) of each window; not recurrent: every window from the first state."""
    state = first = method.initial(recording.height, recording.width)
    for window in windows:
        state, image = method.step(state if recurrent else first, window)
        yield image


def last_image(method: Method | Missing, windows: list[Window], recording: Recording, **settings):
    """The image of the last window, or the gap's reason."""
    if isinstance(method, Missing):
        return method.reason
    *_, image = images(method, windows, recording, **settings)
    return image


def event_picture(window: Window, recording: Recording) -> np.ndarray:
    """(H, W, 3) uint8: blue brighter, red darker."""
    size = {"height": recording.height, "width": recording.width}
    return np.asarray(event_pictures(voxelise(pack([[window.events]]), **size)))[0, 0]


def picture(image, kind: str) -> np.ndarray | str:
    """An image (H, W) -> (H, W) uint8, equalised; the words of a gap go through."""
    if image is None:
        return "no frame"
    return image if isinstance(image, str) else np.asarray(to_8_bit(equalise(image, kind)))


def errors(image, truth, kind: str = "local") -> dict[str, float]:
    """MSE and SSIM of one image, after equalisation."""
    pair = equalise(image, kind), equalise(truth, kind)
    return {name: float(getattr(metrics, name)(*pair)) for name in ("mse", "ssim")}


# ---- Figures


def grid(titles: list[str], rows: list[tuple[str, list]], cell: int = 240) -> Image.Image:
    """Rows of (label, cells) under their titles; a cell is a picture or the words of a gap."""
    heights = []
    for _, cells in rows:
        shape = next(c.shape for c in cells if not isinstance(c, str))
        heights.append(round(cell * shape[0] / shape[1]))
    width = len(titles) * (cell + GAP) + GAP
    sheet = Image.new("RGB", (width, LINE + sum(heights) + len(rows) * (LINE + GAP)), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(12)
    for k, title in enumerate(titles):
        draw.text((GAP + k * (cell + GAP) + cell / 2, LINE / 2), title, "black", font, anchor="mm")
    top = LINE
    for (label, cells), height in zip(rows, heights, strict=True):
        draw.text((GAP, top + LINE / 2), label, "#555555", font, anchor="lm")
        top += LINE
        for k, content in enumerate(cells):
            left = GAP + k * (cell + GAP)
            if isinstance(content, str):
                draw.rectangle([left, top, left + cell, top + height], "#e4e4e4")
                middle = left + cell / 2, top + height / 2
                draw.text(middle, content, "#555555", font, anchor="mm")
            else:
                part = Image.fromarray(content).convert("RGB")
                sheet.paste(part.resize((cell, height), Image.Resampling.LANCZOS), (left, top))
        top += height + GAP
    return sheet


def plotted(figure: Figure) -> Image.Image:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")


def save_figure(path: Path, parts: list[Image.Image], caption: str) -> None:
    """The parts, one under the other, and the caption; JPEG of at most 300 kB."""
    width = max(part.width for part in parts)
    lines = textwrap.wrap(caption, width // 6)  # a letter of this font is about 6 pixels wide
    height = sum(part.height for part in parts)
    sheet = Image.new("RGB", (width, height + LINE * len(lines) + GAP), "white")
    top = 0
    for part in parts:
        sheet.paste(part, ((width - part.width) // 2, top))
        top += part.height
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(12)
    for line in lines:
        draw.text((GAP, top + LINE / 2), line, "black", font, anchor="lm")
        top += LINE
    path.parent.mkdir(exist_ok=True)
    for quality in (90, 80, 70, 55, 40):
        sheet.save(path, quality=quality)
        if path.stat().st_size <= LARGEST:
            break
    print(f"{caption}\n{path.name}: {sheet.width}x{sheet.height}, "
          f"{path.stat().st_size / 1e3:.0f} kB")  # fmt: skip
