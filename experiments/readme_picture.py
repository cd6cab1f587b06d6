"""Recordings -> the README's picture: events beside what the network makes of them.

    python experiments/readme_picture.py WEIGHTS RECORDING...          seconds

Of what `firenet reconstruct RECORDING -o FOLDER --preview` gives, one of the last pictures of each
recording, cropped to 4:3 and scaled to one height. Writes docs/events_to_video.png.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from firenet_jax.commands.reconstruct import Reconstruct, run

OUT = Path(__file__).parents[1] / "docs" / "events_to_video.png"
HEIGHT = 180


def last_picture(recording: Path, weights: Path) -> Image.Image:
    """Events above, reconstruction below."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        run(Reconstruct((recording,), out, weights, preview=True))
        with Image.open(sorted(out.glob("frame_*.png"))[-2]) as picture:
            pixels = np.asarray(picture)
    events, image = np.split(pixels, 2, axis=1)
    width = min(image.shape[1], round(image.shape[0] * 4 / 3))
    left = (image.shape[1] - width) // 2
    both = np.concatenate([side[:, left : left + width] for side in (events, image)])
    size = (round(HEIGHT * width / image.shape[0]), 2 * HEIGHT)
    return Image.fromarray(both).resize(size, Image.Resampling.LANCZOS)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("weights", type=Path)
    parser.add_argument("recordings", type=Path, nargs="+")
    options = parser.parse_args()
    pictures = [last_picture(path, options.weights) for path in options.recordings]
    gap = 4
    width = sum(picture.width for picture in pictures) + gap * (len(pictures) - 1)
    sheet = Image.new("RGB", (width, 2 * HEIGHT), "white")
    left = 0
    for picture in pictures:
        sheet.paste(picture, (left, 0))
        left += picture.width + gap
    OUT.parent.mkdir(exist_ok=True)
    sheet.save(OUT, optimize=True)
    print(f"{OUT.name}: {sheet.width}x{sheet.height}, {OUT.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
