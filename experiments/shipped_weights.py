"""Are the built-in weights better than others, on pictures and recordings they never saw?

    python experiments/shipped_weights.py PUBLISHED [RECORDING...] [--weights OURS]      10 minutes

Simulated: textures from the five pictures that are frozen by name and in no training pool
(`textures.HELD_OUT`), slow and fast, with the faults of real sensors and without; means over the
last 20 of 40 windows of 16 sequences of 240x180, and the standard error of their distance to the
published weights', over pairs of sequences. Losses, stages and the mean of weights were chosen by
these pictures: they validate, an untouched test they are not. Local equalisation is that of
`equalise`.
Recordings: three windows of each after warming up, the same windows for both networks, as
`firenet reconstruct RECORDING -N EVENTS` shows them; event pictures, theirs, ours. And over their
last twelve windows, how well an image tells where the next window's events fall
(`metrics.event_correlation`), with the same events turned by 180 degrees for what chance gives.
Writes results/shipped_weights.json, docs/shipped_simulated.jpg and
docs/shipped_recordings.jpg.
"""

import argparse
import itertools
import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from endurance import warmed
from harness import RESULTS, save
from PIL import Image

import firenet_jax as fj
from firenet_jax.commands.info import describe
from firenet_jax.evaluation import metrics
from firenet_jax.evaluation.equalise import equalise
from firenet_jax.instants import WARM_UP
from firenet_jax.network import initial_state
from firenet_jax.pictures import display, event_pictures, initial_display_state
from firenet_jax.reconstruction import reconstruct
from firenet_jax.simulation.curricula import sequences
from firenet_jax.simulation.scenes import SceneSettings
from firenet_jax.simulation.sensor import FAULTY, SensorSettings
from firenet_jax.simulation.textures import HELD_OUT, load_textures, photographs

DOCS = Path(__file__).parents[1] / "docs"
HEIGHT, WIDTH, WINDOWS, JUDGED, BATCH, BATCHES = 180, 240, 40, 20, 2, 8
SPEEDS = {"slow": (5.0, 50.0), "fast": (200.0, 1000.0)}
SENSORS = {"clean": SensorSettings(), "faulty": replace(FAULTY, threshold_range=(0.1, 0.6))}
SHOWN = 24  # windows into which a recording is cut, at least
FOLLOWED = 12  # of them, after which events are compared with images


def scores(images: np.ndarray, data) -> dict[str, float]:
    """Means over the judged windows: (T, B, H, W), clipped where the metrics ask for it."""
    judged = slice(WINDOWS - JUDGED, None)
    before = slice(WINDOWS - JUDGED - 1, -1)
    truths = np.asarray(data.images[judged])
    shown = np.clip(images[judged], 0, 1)
    equalised, equalised_truths = equalise(shown, "local"), equalise(truths, "local")
    return {
        "ssim": float(jnp.mean(metrics.ssim(shown, truths))),
        "mse": float(jnp.mean(metrics.mse(shown, truths))),
        "ssim_equalised": float(jnp.mean(metrics.ssim(equalised, equalised_truths))),
        "mse_equalised": float(jnp.mean(metrics.mse(equalised, equalised_truths))),
        "temporal": float(
            jnp.mean(
                metrics.temporal_error(
                    images[judged],
                    images[before],
                    data.displacement[judged],
                    truths,
                    data.images[before],
                    data.visible[judged],
                )
            )
        ),
    }


def simulated(methods: dict) -> tuple[list[dict], np.ndarray]:
    """Rows of the table, and a sheet of pictures: truth and each method, one row a condition."""
    textures = jnp.asarray(load_textures(photographs(HELD_OUT), 40, 320, seed=0))
    simulate = jax.jit(
        partial(sequences, batch=BATCH, windows=WINDOWS, height=HEIGHT, width=WIDTH),
        static_argnames=("scene", "sensor"),
    )
    rows, sheet = [], []
    for sensor in SENSORS:
        for speed in SPEEDS:
            scene = SceneSettings(speed=SPEEDS[speed])
            found = {name: [] for name in methods}
            for n in range(BATCHES):
                data = simulate(jax.random.key(n), textures, scene=scene, sensor=SENSORS[sensor])
                pictures = [np.asarray(data.images[-1])]
                for name, weights in methods.items():
                    state = initial_state(BATCH, HEIGHT, WIDTH)
                    images = np.asarray(reconstruct(weights, state, data.tensors)[1])
                    found[name].append(scores(images, data))
                    pictures.append(images[-1])
                if n == 0:
                    sheet.append(np.concatenate([np.concatenate(list(p), 1) for p in pictures], 1))
            for name, each in found.items():
                means = {key: float(np.mean([row[key] for row in each])) for key in each[0]}
                leads = {
                    key: [
                        row[key] - other[key]
                        for row, other in zip(each, found["published"], strict=True)
                    ]
                    for key in means
                }
                errors = {
                    key: float(np.std(lead, ddof=1)) / BATCHES**0.5 for key, lead in leads.items()
                }
                labels = {"sensor": sensor, "speed": speed, "weights": name}
                rows.append(labels | means | {"standard errors": errors})
                print(*(f"{label:12}" for label in labels.values()), end=" ")
                print(*(f"{means[key]:.4f} (lead's {errors[key]:.4f})" for key in means))
    return rows, np.concatenate(sheet)


def recording_sheet(path: Path, methods: dict) -> tuple[Image.Image, dict]:
    """Three windows of a recording: a row of event pictures, and one for each method; and how well
    each method's images tell where the next window's events fall."""
    about = describe(path)
    recording = fj.open_recording(path)
    count = min(about["events"] // SHOWN, round(0.35 * recording.height * recording.width))
    windows = partial(fj.event_tensors, recording, chunk=1, events=count)
    first = [tensors for tensors, _ in itertools.islice(windows(), WARM_UP)]
    zero = initial_state(1, recording.height, recording.width)
    states = {
        name: (warmed(weights, zero, first), initial_display_state(1))
        for name, weights in methods.items()
    }
    total = about["events"] // count
    wanted = {total // 2, total * 3 // 4, total - 1}
    rows = {name: [] for name in ("events", *methods)}
    found = {name: [] for name in methods}
    before, seen = {}, 0
    for tensors, _ in windows():
        for name, weights in methods.items():
            state, shown = states[name]
            state, images = reconstruct(weights, state, tensors)
            shown, pictures = display(shown, images)
            states[name] = state, shown
            if seen in wanted:
                rows[name].append(np.repeat(np.asarray(pictures)[0, 0, ..., None], 3, -1))
            if total - FOLLOWED <= seen < total:
                votes = jnp.clip(tensors[0, 0].sum(-1), -3, 3)  # else hot pixels decide
                both = jnp.stack([votes, votes[::-1, ::-1]])
                found[name].append(metrics.event_correlation(jnp.stack([before[name]] * 2), both))
            before[name] = images[0, 0]
        if seen in wanted:
            rows["events"].append(np.asarray(event_pictures(tensors))[0, 0])
        seen += 1
        if seen > max(wanted):
            break
    sheet = np.concatenate([np.concatenate(row, 1) for row in rows.values()])
    picture = Image.fromarray(sheet)
    picture = picture.resize((540, round(540 * picture.height / picture.width)), Image.LANCZOS)
    means = {}
    for name, each in found.items():
        after, turned = np.mean(each, 0).tolist()
        means[name] = {"next": after, "turned": turned}
    return picture, means


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("published", type=Path)
    parser.add_argument("recordings", type=Path, nargs="*")
    parser.add_argument("--weights", type=Path, help="instead of the built-in ones")
    parser.add_argument("--skip-simulated", action="store_true")
    options = parser.parse_args()
    methods = {
        "published": fj.load_weights(options.published),
        "ours": fj.load_weights(options.weights) if options.weights else fj.load_weights(),
    }
    DOCS.mkdir(exist_ok=True)
    last = RESULTS / "shipped_weights.json"
    results = json.loads(last.read_text()) if last.exists() else {}
    if options.recordings:
        sheets, results["recordings"] = [], []
        for path in options.recordings:
            sheet, found = recording_sheet(path, methods)
            sheets.append(sheet)
            results["recordings"].append({"recording": path.name, **found})
            print(f"{path.name:30}", *(f"{name} {each}" for name, each in found.items()))
        columns = 3
        rows = [sheets[k : k + columns] for k in range(0, len(sheets), columns)]
        heights = [max(sheet.height for sheet in row) for row in rows]
        whole = Image.new("RGB", (columns * 548, sum(heights) + 8 * len(rows)), "white")
        for top, row in enumerate(rows):
            for left, sheet in enumerate(row):
                whole.paste(sheet, (548 * left, sum(heights[:top]) + 8 * top))
        whole.save(DOCS / "shipped_recordings.jpg", quality=80)
    if not options.skip_simulated:
        rows, sheet = simulated(methods)
        picture = Image.fromarray(np.uint8(np.round(255 * np.clip(sheet, 0, 1))))
        picture.resize((picture.width // 2, picture.height // 2)).save(
            DOCS / "shipped_simulated.jpg", quality=80
        )
        results["pictures"] = [path.name for path in photographs(HELD_OUT)]
        results["rows"] = rows
    results.pop("machine", None)
    save("shipped_weights", results)


if __name__ == "__main__":
    main()
