"""Coloured photographs, seen by a simulated sensor with a colour mosaic: are the colours right?

A camera moves over a photograph. Each pixel sees one of its colours, as on a Color-DAVIS346 (red,
green; green, blue), and the events become pictures by `firenet reconstruct --color`. Judged by the
last picture: how a* and b* of CIELAB, the colours, correlate with those of the photograph, and the
mean chroma of both. Colours of large smooth areas cannot come back: events tell edges.

    python experiments/colour_mosaic.py [--windows 40]          a minute

Writes results/colour_mosaic.json and docs/colour_mosaic.jpg (photograph, grey, colour).
"""

import argparse
from pathlib import Path

import jax
import numpy as np
from harness import save
from PIL import Image
from scipy.ndimage import shift
from skimage import data

from firenet_jax.checkpoint import load_weights
from firenet_jax.colour import CORNERS, to_lab
from firenet_jax.events import concatenate
from firenet_jax.reconstruction import Network, events_to_pictures, initial_session
from firenet_jax.simulation.sensor import event_list, random_sensor
from firenet_jax.tensors import pack

DOCS = Path(__file__).parents[1] / "docs"
PHOTOGRAPHS = ("astronaut", "coffee", "chelsea")
HEIGHT, WIDTH = 180, 240
STEP, STEPS = 1000, 5  # microseconds from a rendering to the next; renderings in a window
CHUNK = 4


def views(photograph: np.ndarray, count: int):
    """(H', W', 3) -> so many views (H, W, 3) in [0, 1] on a wavy way, half a pixel apart."""
    room = np.array(photograph.shape[:2]) - (HEIGHT, WIDTH) - 2
    middle = room / 2
    for number in range(count):
        phase = 0.5 * number / 24
        offset = middle + 24 * np.array([np.sin(phase), np.sin(0.7 * phase + 1)])
        whole = np.floor(offset).astype(int)
        part = photograph[whole[0] : whole[0] + HEIGHT + 1, whole[1] : whole[1] + WIDTH + 1]
        moved = shift(part, (*(whole - offset), 0), order=1, mode="nearest")
        yield moved[:HEIGHT, :WIDTH]


def mosaic(view: np.ndarray) -> np.ndarray:
    """(H, W, 3) -> (H, W): what each pixel sees through its filter."""
    seen = view[..., 1].copy()
    for channel, (row, column) in enumerate(CORNERS):
        seen[row::2, column::2] = view[row::2, column::2, channel]
    return seen


def reconstructed(photograph: np.ndarray, windows: int) -> tuple[np.ndarray, dict]:
    """Windows of STEPS renderings -> the last view, the last picture without and with colour."""
    seen = list(views(photograph, windows * STEPS + 1))
    sensor = random_sensor(jax.random.key(0), height=HEIGHT, width=WIDTH)
    renderings = [(number * STEP, mosaic(view)) for number, view in enumerate(seen)]
    events = concatenate(list(event_list(sensor, renderings)))
    cuts = np.searchsorted(events.t, np.arange(windows + 1) * STEP * STEPS)
    rows = [[events.select(slice(*pair))] for pair in zip(cuts, cuts[1:], strict=False)]
    last = {}
    for color in (False, True):
        network = Network(color=color)
        session = initial_session(1, HEIGHT, WIDTH, network)
        for start in range(0, windows, CHUNK):
            session, pictures = events_to_pictures(
                load_weights(), session, pack(rows[start : start + CHUNK]),
                np.ones((CHUNK, 1), bool), height=HEIGHT, width=WIDTH, network=network,
            )  # fmt: skip
        last[color] = np.asarray(pictures)[-1, 0]
    return np.uint8(np.round(255 * seen[-1])), last


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--windows", type=int, default=40, help=f"a multiple of {CHUNK}")
    options = parser.parse_args()
    rows, sheet = [], []
    for name in PHOTOGRAPHS:
        photograph = getattr(data, name)() / np.float32(255)
        view, last = reconstructed(photograph, options.windows)
        truth, found = (np.asarray(to_lab(p / np.float32(255))) for p in (view, last[True]))
        row = {"photograph": name}
        for number, axis in ((1, "a"), (2, "b")):
            row[f"correlation_{axis}"] = float(
                np.corrcoef(truth[..., number].ravel(), found[..., number].ravel())[0, 1]
            )
        row["chroma"] = float(np.hypot(found[..., 1], found[..., 2]).mean())
        row["chroma_of_photograph"] = float(np.hypot(truth[..., 1], truth[..., 2]).mean())
        rows.append(row)
        print(*(f"{v:.2f}" if isinstance(v, float) else f"{v:12}" for v in row.values()))
        sheet.append(np.concatenate([view, np.stack([last[False]] * 3, -1), last[True]], 1))
    DOCS.mkdir(exist_ok=True)
    Image.fromarray(np.concatenate(sheet)).save(DOCS / "colour_mosaic.jpg", quality=85)
    save("colour_mosaic", {"windows": options.windows, "rows": rows})


if __name__ == "__main__":
    main()
