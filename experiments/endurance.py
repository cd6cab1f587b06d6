"""How do weights behave over length, density, rest and contrast, beside those of others?

    python experiments/endurance.py WEIGHTS... [--recordings FOLDER] [--only NAMES]      65 minutes

WEIGHTS: "built-in", and files of others (the published checkpoint, FireNet+, ...); a name may be
given, ours=PATH. The questions, each a function, an entry of results/endurance.json and a table:

    long        simulated sequences of 1,000 windows, clean and faulty: SSIM, MSE and brightness
                while young and old. A network that remembers well looks the same at every age.
    rest        ten windows, then a thousand with nothing, or with noise: does what was seen stay,
                and where does the image drift?
    palindrome  a recording forward and backward, 40 times: all that was seen comes back, so the
                image should be the same each time.
    density     the same scenes cut into windows of .03 to 3 events per pixel; dense ones are
                also taken in several steps, as `firenet reconstruct` does.
    light       cameras that move or stand still, in steady light and in that of a lamp that
                flickers, at .35 events per pixel and at most 40 ms a window, as in `firenet
                reconstruct`.
    contrast    what `firenet reconstruct RECORDING` shows: grey levels' standard deviation, and
                how much the mean brightness moves from one picture to the next.
    clip        the same of videos of held-out photographs before a moving camera, made into events
                by `firenet simulate --video`; beside the video's own, and what `firenet evaluate`
                says of each.
    frames      recordings with camera frames: SSIM and MSE, with and without local equalisation.

What other weights gave before stays in the file, so that only new ones must be measured.
Simulated pictures are textures from `textures.HELD_OUT`, which no weights of ours were trained on.
"""

import argparse
import itertools
import json
import math
import tempfile
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from harness import RESULTS, save
from PIL import Image, ImageOps
from skimage.metrics import structural_similarity
from skimage.transform import AffineTransform, warp

import firenet_jax as fj
from firenet_jax.commands.evaluate import Evaluate
from firenet_jax.commands.evaluate import run as evaluate
from firenet_jax.commands.reconstruct import Reconstruct, run
from firenet_jax.commands.simulate import Simulate
from firenet_jax.commands.simulate import run as make_events
from firenet_jax.evaluation import metrics
from firenet_jax.evaluation.equalise import equalise
from firenet_jax.instants import PART, WARM_UP
from firenet_jax.network import State, Weights, initial_state
from firenet_jax.reconstruction import reconstruct
from firenet_jax.simulation.curricula import random_setups, window_bounds
from firenet_jax.simulation.scenes import Scene, SceneSettings, render
from firenet_jax.simulation.sensor import FAULTY, Sensor, SensorSettings, first_state
from firenet_jax.simulation.sensor import step as sensor_step
from firenet_jax.simulation.sequences import simulate
from firenet_jax.simulation.textures import HELD_OUT, load_textures, photographs

SIZE = {"height": 120, "width": 160}
SENSORS = {"clean": SensorSettings(), "faulty": replace(FAULTY, threshold_range=(0.1, 0.6))}
BATCH = 4
LENGTH, CHUNK = 1000, 50
AGES = {"20-40": (20, 40), "100-150": (100, 150), "450-500": (450, 500), "950-1000": (950, 1000)}
NOISES = (0.0, 0.02, 0.35)  # events per pixel in a window of rest
RESTED = (5, 20, 50, 100, 400, 1000)
ROUNDS = 40
MOST = 40  # windows of a palindrome
DENSITIES = (0.03, 0.1, 0.35, 1.0, 3.0)
SPEEDS = {"slow": (5.0, 50.0), "fast": (200.0, 1000.0)}
WARM, JUDGED = 30, 10  # windows of a sequence of one density
TOGETHER = 20  # of them at a time
FLICKER = (0.1, 0.9)
USUAL, LONGEST = 0.35, 40_000.0  # events per pixel, microseconds: windows of `firenet reconstruct`
PIXELS = 40.0  # by which a window of a density moves, at most: one for each rendering
CLIP_RATE, CLIP_PICTURES = 100.0, 400
WITH_FRAMES = ("davis346_59_frames.aedat4", "ecd_slider_depth", "davis346_frames.aedat4")

Methods = dict[str, Weights]


@cache
def textures() -> jax.Array:
    return jnp.asarray(load_textures(photographs(HELD_OUT), 40, 320, seed=0))


def means(rows: list[dict]) -> dict[str, float]:
    """Means and, as "key +-", standard errors."""
    found = {}
    for key in rows[0]:
        values = np.array([row[key] for row in rows])
        found[key] = float(values.mean())
        found[f"{key} +-"] = float(values.std(ddof=1) / len(values) ** 0.5) if len(rows) > 1 else 0
    return found


def scores(images: np.ndarray, truths: np.ndarray, equalised: bool = False) -> list[dict]:
    """(T, B, H, W) each -> of each of the B sequences the means over time."""
    shown = np.clip(images, 0, 1)
    values = {
        "ssim": metrics.ssim(shown, truths),
        "mse": metrics.mse(shown, truths),
        "brightness": shown.mean((-2, -1)),
        "truth": truths.mean((-2, -1)),
        "contrast": shown.std((-2, -1)) / truths.std((-2, -1)),
    }
    if equalised:
        pair = equalise(shown, "local"), equalise(truths, "local")
        values["ssim_equalised"] = metrics.ssim(*pair)
        values["mse_equalised"] = metrics.mse(*pair)
    return [
        {key: float(np.asarray(value)[:, b].mean()) for key, value in values.items()}
        for b in range(images.shape[1])
    ]


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(np.ravel(a), np.ravel(b))[0, 1])


# ---- Simulated


def long(methods: Methods, sequences: int) -> list[dict]:
    found = {}
    pictures, scene = textures(), SceneSettings(speed=(20.0, 200.0))
    for sensor in SENSORS:
        for n in range(sequences // BATCH):
            sensors, scenes, durations = random_setups(
                jax.random.key(n), pictures, batch=BATCH, windows=LENGTH, scene=scene,
                sensor=SENSORS[sensor], **SIZE,
            )  # fmt: skip
            seen = None
            states = {name: initial_state(BATCH, *SIZE.values()) for name in methods}
            images = {name: [] for name in methods}
            truths = []
            for first in range(0, LENGTH, CHUNK):
                bounds = window_bounds(durations, CHUNK, first)
                seen, data = simulate(sensors, scenes, bounds, seen, **SIZE)
                for name, weights in methods.items():
                    states[name], made = reconstruct(weights, states[name], data.tensors)
                    images[name].append(np.asarray(made))
                truths.append(np.asarray(data.images))
            truths = np.concatenate(truths)
            for name in methods:
                made = np.concatenate(images[name])
                for age, (start, stop) in AGES.items():
                    rows = scores(made[start:stop], truths[start:stop])
                    found.setdefault((sensor, age, name), []).extend(rows)
    return [
        {"sensor": sensor, "windows": age, "weights": name} | means(rows)
        for (sensor, age, name), rows in found.items()
    ]


def rest(methods: Methods, sequences: int) -> list[dict]:
    """Noise is balanced, ON and OFF as probable, uniform in time and place."""
    pictures, rows = textures(), []
    setup = random_setups(
        jax.random.key(5),
        pictures,
        batch=sequences,
        windows=10,
        scene=SceneSettings(pause=0.0),
        **SIZE,
    )
    data = simulate(*setup[:2], window_bounds(setup[2], 10), **SIZE)[1]

    shape = CHUNK, sequences, *SIZE.values(), 5

    @partial(jax.jit, static_argnames="noise")
    def resting(key, noise: float):
        bits = jax.random.bits(key, shape, jnp.uint16)
        fired = bits >> 1 < round(2**15 * noise / 5)
        return jnp.where(fired, jnp.where(bits & 1, 1.0, -1.0), 0.0)

    for noise in NOISES:
        states, found = {}, {}
        for name, weights in methods.items():
            states[name], images = reconstruct(
                weights, initial_state(sequences, *SIZE.values()), data.tensors
            )
            found[name] = {0: np.asarray(images[-1])}
        for first in range(0, RESTED[-1], CHUNK):
            tensors = resting(jax.random.key(first), noise)
            for name, weights in methods.items():
                states[name], images = reconstruct(weights, states[name], tensors)
                for age in RESTED:
                    if first < age <= first + CHUNK:
                        found[name][age] = np.asarray(images[age - first - 1])
        for name, images in found.items():
            row = {"noise": noise, "weights": name}
            row |= {f"brightness {age}": float(image.mean()) for age, image in images.items()}
            for age in RESTED:
                pairs = zip(images[age], images[0], strict=True)
                row[f"correlation {age}"] = float(np.mean([correlation(*pair) for pair in pairs]))
            rows.append(row)
    return rows


@partial(jax.jit, static_argnames=("height", "width", "renderings"))
def _rates(sensors, scenes, durations, windows, *, height, width, renderings=64):
    """Events per pixel in a window of each sequence, counted over the middle of it."""
    start = durations * windows // 2
    draw = jax.vmap(lambda scene, t: render(scene, 1e-6 * t, height=height, width=width).image)
    step = jnp.maximum(durations // 8, 1)

    def rendering(carry, k):
        state, count = carry
        state, runs = jax.vmap(sensor_step)(
            sensors, state, draw(scenes, start + (k + 1) * step), step
        )
        return (state, count + sum(run.count.sum((-2, -1)) for run in runs)), None

    state = jax.vmap(first_state)(sensors, draw(scenes, start))
    (_, count), _ = jax.lax.scan(
        rendering, (state, jnp.zeros(len(durations), jnp.int32)), jnp.arange(renderings)
    )
    return count / (height * width) / (renderings / 8)


def _scored(
    methods: Methods,
    sequences: int,
    scene: SceneSettings,
    sensor: SensorSettings,
    wanted: float,
    longest: float = math.inf,
    steps: int = 1,
) -> dict[str, list[dict]]:
    """Scores of the last windows of sequences in which `wanted` events per pixel make a window, and
    by how many pixels the fastest point moves in one.

    longest: microseconds of a window at most. steps: in which a window is taken, in equal times;
    scored is the image of the last.
    """
    pictures = textures()
    windows = WARM + JUDGED
    found = {name: [] for name in methods}
    for n in range(sequences // BATCH):
        make = partial(
            random_setups, jax.random.key(n), pictures, batch=BATCH, scene=scene, sensor=sensor,
            **SIZE,
        )  # fmt: skip
        sensors, scenes, durations = make(windows=400)
        rate = _rates(sensors, scenes, durations, 400, **SIZE)
        most = jnp.minimum(1e6 * PIXELS / scenes.speed, longest)
        durations = jnp.clip(durations * wanted / jnp.maximum(rate, 1e-6), 200, most)
        moved = np.asarray(1e-6 * durations * scenes.speed)
        bounds = window_bounds(durations.astype(jnp.int32), windows)
        made, truths = _in_steps(methods, sensors, scenes, bounds, steps)
        for name, images in made.items():
            rows = scores(images[WARM:], truths[WARM:], equalised=True)
            found[name] += [row | {"pixels": float(p)} for row, p in zip(rows, moved, strict=True)]
    return found


def _in_steps(
    methods: Methods, sensors: Sensor, scenes: Scene, bounds: jax.Array, steps: int
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """(T + 1, B) bounds of windows -> (images by method, truths), (T, B, H, W), at their ends; each
    window is taken in so many steps."""
    share = jnp.arange(steps, dtype=jnp.int32)[None, :, None]
    starts = bounds[:-1, None] + (bounds[1:] - bounds[:-1])[:, None] * share // steps
    edges = jnp.concatenate([starts.reshape(-1, bounds.shape[1]), bounds[-1:]])
    made, truths = {name: [] for name in methods}, []
    states = {name: initial_state(BATCH, *SIZE.values()) for name in methods}
    seen, chunk = None, TOGETHER * steps
    for first in range(0, len(edges) - 1, chunk):
        part = edges[first : first + chunk + 1]
        seen, data = simulate(
            sensors, scenes, part, seen, renderings=math.ceil(PIXELS / steps), **SIZE
        )
        truths.append(np.asarray(data.images[steps - 1 :: steps]))
        for name, weights in methods.items():
            states[name], images = reconstruct(weights, states[name], data.tensors)
            made[name].append(np.asarray(images[steps - 1 :: steps]))
    return {name: np.concatenate(images) for name, images in made.items()}, np.concatenate(truths)


def density(methods: Methods, sequences: int) -> list[dict]:
    """Dense windows in one step, and in several, as `firenet reconstruct` takes them."""
    rows = []
    for sensor, speed in itertools.product(SENSORS, SPEEDS):
        scene = SceneSettings(speed=SPEEDS[speed], pause=0.0)
        for wanted in DENSITIES:
            for steps in sorted({1, max(1, round(wanted / PART))}):
                found = _scored(methods, sequences, scene, SENSORS[sensor], wanted, steps=steps)
                labels = {"sensor": sensor, "speed": speed, "density": wanted, "steps": steps}
                rows += [labels | {"weights": name} | means(found[name]) for name in methods]
    return rows


def light(methods: Methods, sequences: int) -> list[dict]:
    rows = []
    lights = {"steady": None, "flickering": FLICKER}
    for camera, kind in itertools.product(("moving", "still"), lights):
        scene = SceneSettings(speed=(20.0, 500.0), pause=0.0, still=float(camera == "still"))
        sensor = replace(SENSORS["faulty"], flicker=lights[kind])
        found = _scored(methods, sequences, scene, sensor, USUAL, LONGEST)
        for name in methods:
            labels = {"camera": camera, "light": kind, "weights": name}
            rows.append(labels | means(found[name]))
    return rows


# ---- Recordings


def palindrome(methods: Methods, recordings: list[Path]) -> list[dict]:
    """Time reversed, polarity inverted: bins the other way round, votes negated."""
    rows = []
    for path in recordings:
        recording = fj.open_recording(path)
        windows = []
        for tensors, _ in fj.event_tensors(recording, chunk=1):
            windows.append(tensors[0])
            if len(windows) == MOST:
                break
        if len(windows) <= 3:
            continue
        forth = jnp.stack(windows)
        back = -forth[::-1, ..., ::-1]
        for name, weights in methods.items():
            state = initial_state(1, recording.height, recording.width)
            ends = []
            for _ in range(ROUNDS):
                state, images = reconstruct(weights, state, forth)
                ends.append(np.asarray(images[-1, 0]))
                state, _ = reconstruct(weights, state, back)
            rows.append(
                {
                    "recording": path.name,
                    "weights": name,
                    "correlation": correlation(ends[-1], ends[1]),
                    "brightness 2": float(ends[1].mean()),
                    "brightness 40": float(ends[-1].mean()),
                }
            )
    return rows


def contrast(files: dict[str, Path | None], recordings: list[Path]) -> list[dict]:
    """Over all pictures but the first five."""
    rows = []
    for path in recordings:
        for name, weights in files.items():
            with tempfile.TemporaryDirectory() as folder:
                out = Path(folder) / "out"
                run(Reconstruct((path,), out, weights))
                greys = np.stack(
                    [
                        np.asarray(Image.open(picture), np.float32)
                        for picture in sorted(out.glob("frame_*.png"))
                    ]
                )
            greys = greys[min(5, len(greys) - 1) :]
            brightness = greys.mean((-2, -1))
            moved = np.abs(np.diff(brightness))
            rows.append(
                {
                    "recording": path.name,
                    "weights": name,
                    "pictures": len(greys),
                    "deviation": float(greys.std((-2, -1)).mean()),
                    "brightness": float(brightness.mean()),
                    "moves": float(moved.mean()) if len(moved) else 0.0,
                    "99 %": float(np.percentile(greys, 99)),
                    "1 %": float(np.percentile(greys, 1)),
                }
            )
    return rows


def clip(files: dict[str, Path | None]) -> list[dict]:
    """Means over all pictures; those that are judged are of windows between the video's."""
    rows = []
    for photograph in photographs(HELD_OUT):
        pictures = moving(photograph)
        truth = {"deviation of truth": float(np.std(pictures, (-2, -1)).mean())}
        with tempfile.TemporaryDirectory() as folder:
            video, events = Path(folder) / "clip.mp4", Path(folder) / f"{photograph.stem}.h5"
            fj.write_video(video, pictures, CLIP_RATE)
            make_events(Simulate(events, video=video))
            shown = contrast(files, [events])
            for row, (name, weights) in zip(shown, files.items(), strict=True):
                of = (weights or Path("built-in"),)
                judged = Evaluate((events,), Path(folder) / name, methods="firenet", weights=of)
                (sequence,) = evaluate(judged)["sequences"].values()
                (found,) = sequence["methods"].values()
                means = {key: found["means"][key] for key in ("ssim", "mse")}
                rows.append(row | {"recording": photograph.stem} | truth | means)
    return rows


def moving(photograph: Path) -> list[np.ndarray]:
    """What a camera sees that moves, turns and nears before a photograph: (180, 240) uint8."""
    with Image.open(photograph) as file:
        picture = np.asarray(ImageOps.fit(file.convert("L"), (480, 360)), np.float32)
    found = []
    for phase in np.arange(CLIP_PICTURES) / CLIP_RATE:
        zoom, angle = 1.0 + 0.15 * np.sin(1.3 * phase), 0.15 * np.sin(1.9 * phase)
        place = 240 + 60 * np.sin(1.7 * phase), 180 + 40 * np.sin(2.3 * phase)
        to_middle = AffineTransform(translation=(-120, -90))
        there = AffineTransform(scale=zoom, rotation=angle, translation=place)
        seen = warp(picture, to_middle + there, output_shape=(180, 240), preserve_range=True)
        found.append(np.uint8(np.rint(seen)))
    return found


def warmed(weights: Weights, state: State, first: list[jax.Array]) -> State:
    """The state after the warm-up of `firenet reconstruct`, from tensors (1, B, H, W, 5)."""
    for tensors in [*first, *(-tensors[..., ::-1] for tensors in reversed(first))]:
        state, _ = reconstruct(weights, state, tensors)
    return state


def similarity(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """SSIM of each pixel."""
    return structural_similarity(
        a,
        b,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )[1]


def frames(methods: Methods, recordings: list[Path]) -> list[dict]:
    """Windows between frames; what follows a frame by a window counts from the second on. Of a
    camera at rest only where events are (within 3 pixels of one in the last five windows). From a
    zero state, and after the warm-up of `firenet reconstruct`."""
    rows = []
    for path in recordings:
        if path.name not in WITH_FRAMES:
            continue
        recording = fj.open_recording(path)
        stamps = recording.frames.times
        truths = [np.float32(recording.frames.read(k)) / 255 for k in range(len(stamps))]
        windows = partial(fj.event_tensors, recording, chunk=1, frame_to_frame=True)
        first = [tensors for tensors, _ in itertools.islice(windows(), WARM_UP)]
        states = {}
        for name, weights in methods.items():
            zero = initial_state(1, recording.height, recording.width)
            states |= {(name, 0): zero, (name, WARM_UP): warmed(weights, zero, first)}
        found = {way: [] for way in states}
        seen = []
        for tensors, times in windows():
            seen = [*seen[-4:], np.asarray(jnp.abs(tensors[0, 0]).sum(-1) > 0)]
            near = np.asarray(
                jax.lax.reduce_window(
                    np.any(seen, 0).astype(np.float32), 0.0, jax.lax.max, (7, 7), (1, 1), "SAME"
                )
            )
            place = int(np.argmin(np.abs(stamps - times[0])))
            close = abs(int(stamps[place]) - int(times[0])) <= 5000 and place > 0
            for way in states:
                states[way], images = reconstruct(methods[way[0]], states[way], tensors)
                if not close or not near.any():
                    continue
                image, truth = np.clip(np.asarray(images[0, 0]), 0, 1), truths[place]
                row = {}
                for kind in ("none", "local"):
                    a, b = equalise(image[None], kind)[0], equalise(truth[None], kind)[0]
                    label = "" if kind == "none" else "_equalised"
                    row[f"mse{label}"] = float((near * (a - b) ** 2).sum() / near.sum())
                    row[f"ssim{label}"] = float((near * similarity(a, b)).sum() / near.sum())
                found[way].append(row)
        for (name, warm_up), each in found.items():
            labels = {"recording": path.name, "weights": name, "warm_up": warm_up}
            rows.append(labels | means(each))
    return rows


# ---- All of it

SIMULATED = {"long": long, "rest": rest, "density": density, "light": light}
RECORDED = {"palindrome": palindrome, "frames": frames, "contrast": contrast}
FILMED = {"clip": clip}


def _readable(path: Path) -> bool:
    try:
        fj.open_recording(path)
    except fj.RecordingError as error:
        print(f"not read: {error}")
        return False
    return True


def table(rows: list[dict]) -> None:
    columns = [key for key in rows[0] if not key.endswith(" +-")]
    print(*(f"{key[:14]:>14}" for key in columns))
    for row in rows:
        cells = (
            f"{row[k]:14.4f}" if isinstance(row[k], float) else f"{row[k]:>14}" for k in columns
        )
        print(*(cell[:22] for cell in cells))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("weights", nargs="+", help="built-in, FILE or NAME=FILE")
    parser.add_argument("--recordings", type=Path, help="a folder of them")
    parser.add_argument("--only", nargs="*", default=[*SIMULATED, *RECORDED, *FILMED])
    parser.add_argument("--sequences", type=int, default=16, help="simulated, of each condition")
    options = parser.parse_args()
    files = {}
    for each in options.weights:
        name, _, path = each.rpartition("=")
        files[name or Path(path).stem] = None if path == "built-in" else Path(path)
    methods = {name: fj.load_weights(path) for name, path in files.items()}
    recordings = sorted(options.recordings.iterdir()) if options.recordings else []
    recordings = [path for path in recordings if _readable(path)]
    last = RESULTS / "endurance.json"
    results = json.loads(last.read_text()) if last.exists() else {}
    results.pop("machine", None)
    given = dict.fromkeys(SIMULATED, (methods, options.sequences))
    given |= dict.fromkeys(RECORDED, (methods, recordings))
    given |= {"contrast": (files, recordings), "clip": (files,)}  # by commands, which take files
    for name, function in (SIMULATED | RECORDED | FILMED).items():
        if name not in options.only or (name in RECORDED and not recordings):
            continue
        rows = function(*given[name])
        if name in SIMULATED:
            rows = [{**row, "sequences": options.sequences} for row in rows]
        print(f"\n{name}")
        table(rows)
        others = [row for row in results.get(name, []) if row["weights"] not in methods]
        results[name] = others + rows
        save("endurance", results)


if __name__ == "__main__":
    main()
