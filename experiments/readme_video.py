"""A recording -> the README's moving picture: events, the published weights' video, ours.

    python experiments/readme_video.py PUBLISHED RECORDING          a minute

What `firenet reconstruct RECORDING -o FOLDER` gives with each weights, nothing else chosen, side by
side at natural speed. Writes docs/events_to_video.gif, with as many greys as keep it below 1 MB.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from firenet_jax.commands.reconstruct import Reconstruct, run

OUT = Path(__file__).parents[1] / "docs" / "events_to_video.gif"
HEIGHT, GAP, MOST = 160, 4, 1_000_000
GREYS = (128, 96, 80, 64, 48, 40, 32, 24, 16)


def video(recording: Path, weights: Path | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(T,) seconds, (T, H, W, 3) uint8 events, (T, H, W, 3) uint8 images."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        run(Reconstruct((recording,), out, weights, preview=True))
        times = np.loadtxt(out / "timestamps.txt", ndmin=1)
        pictures = []
        for path in sorted(out.glob("frame_*.png")):
            with Image.open(path) as picture:
                pictures.append(np.asarray(picture.convert("RGB")))
    events, images = np.split(np.stack(pictures), 2, axis=2)
    return times, events, images


def scaled(picture: np.ndarray) -> np.ndarray:
    """To the height of the moving picture."""
    height, width = picture.shape[:2]
    size = round(HEIGHT * width / height), HEIGHT
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.LANCZOS))


def palette(greys: int) -> Image.Image:
    """So many greys, and the colours between white and an event's red or blue."""
    shades = np.linspace(0, 255, greys).round().astype(np.uint8)
    fading = np.linspace(0, 255, 8).round().astype(np.uint8)[:-1]
    full = np.full(len(fading), 255, np.uint8)
    colours = [
        np.stack([shades] * 3, 1),
        np.stack([full, fading, fading], 1),
        np.stack([fading, fading, full], 1),
    ]
    image = Image.new("P", (1, 1))
    image.putpalette(np.concatenate(colours).tobytes())
    return image


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("published", type=Path)
    parser.add_argument("recording", type=Path)
    options = parser.parse_args()
    _, _, published = video(options.recording, options.published)
    times, events, ours = video(options.recording, None)
    rows = []
    for pictures in zip(events, published, ours, strict=True):
        sides = [scaled(picture) for picture in pictures]
        gap = np.full((HEIGHT, GAP, 3), 255, np.uint8)
        rows.append(np.concatenate([sides[0], gap, sides[1], gap, sides[2]], 1))
    lasts = np.diff(times, append=2 * times[-1] - times[-2])  # seconds
    hundredths = np.diff(np.round(100 * (times - times[0] + lasts)), prepend=0)
    for greys in GREYS:
        frames = [
            Image.fromarray(row).quantize(palette=palette(greys), dither=Image.Dither.NONE)
            for row in rows
        ]
        durations = [int(10 * max(2, each)) for each in hundredths]
        frames[0].save(
            OUT, save_all=True, append_images=frames[1:], duration=durations, loop=0, optimize=False
        )
        if OUT.stat().st_size < MOST:
            break
    print(
        f"{OUT.name}: {rows[0].shape[1]}x{HEIGHT}, {len(rows)} pictures in "
        f"{sum(durations) / 1e3:.2f} s, {greys} greys, {OUT.stat().st_size / 1e3:.0f} kB"
    )


if __name__ == "__main__":
    main()
