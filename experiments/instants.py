"""Images at a camera's frame times: better than one window of each gap? And do they flicker?

For each recording with frames: SSIM and MSE of images against the frames, of one window from frame
to frame and of images at given times, on the same frames; also where events are (all that counts
where a camera stands still), and there after local equalisation. A recording with many frames is
measured again with every third of them, as from a slower camera: where frames come as far apart as
windows last at most, both ways give the network nearly the same windows. Flicker: the mean second
difference in time, of as many images per second as there are windows, against the images of these
windows; and the change between images 0.5 ms apart where a window is kept between them, against
where none is.

    python experiments/instants.py RECORDING...            1 to 2 minutes each
"""

import argparse
import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from harness import save
from scipy.ndimage import gaussian_filter
from skimage.metrics import structural_similarity

import firenet_jax as fj
from firenet_jax.evaluation import metrics
from firenet_jax.evaluation.equalise import equalise
from firenet_jax.events import Frames, concatenate
from firenet_jax.reconstruction import images_at
from firenet_jax.windows import Windows, cut, in_words, usual

NEAR = 40_000  # microseconds: events that say where something moves
FINE = 500  # microseconds between neighbours
MANY = 30  # frames
NAMES = ("ssim", "mse", "ssim_moving", "mse_moving", "ssim_moving_equalised",
         "mse_moving_equalised")  # fmt: skip


def of_windows(weights, recording, windows: Windows) -> dict[int, np.ndarray]:
    """Time of each window's end -> its image (H, W)."""
    state, found = fj.initial_state(1, recording.height, recording.width), {}
    choices = {"frame_to_frame": True} if windows.frame_to_frame else {
        "events_per_pixel": 0.35, "longest": windows.longest
    }  # fmt: skip
    for tensors, times in fj.event_tensors(recording, chunk=4, **choices):
        if len(tensors) < 4:  # one length compiles once
            tensors = jnp.pad(tensors, [(0, 4 - len(tensors))] + [(0, 0)] * 4)
        state, images = fj.reconstruct(weights, state, tensors)
        found |= dict(zip(times.tolist(), np.asarray(images)[:, 0], strict=False))
    return found


def at(weights, recording, windows: Windows, times) -> dict[int, np.ndarray]:
    series = images_at(weights, recording, times, warm_up=0, longest=windows.longest)
    return {t: image for some, images in series for t, image in zip(some.tolist(), images)}  # noqa: B905


def moving(events, time: int, shape) -> np.ndarray:
    """(H, W) bool: where events are, within NEAR."""
    a, b = np.searchsorted(events.t, [time - NEAR, time + NEAR])
    counts = np.zeros(shape)
    np.add.at(counts, (events.y[a:b], events.x[a:b]), 1)
    return gaussian_filter(np.minimum(counts, 4.0), 3) > 0.15


def score(image, frame, mask) -> list[float]:
    image = np.clip(image, 0, 1)
    similar = structural_similarity(
        image, frame, data_range=1, gaussian_weights=True, use_sample_covariance=False, full=True
    )[1]
    squares = (image - frame) ** 2
    whole = float(metrics.ssim(jnp.asarray(image), jnp.asarray(frame)))
    alike, same = equalise(np.stack([image, frame]), "local")
    similar_alike = structural_similarity(
        alike, same, data_range=1, gaussian_weights=True, use_sample_covariance=False, full=True
    )[1]
    return [whole, squares.mean(), similar[mask].mean(), squares[mask].mean(),
            similar_alike[mask].mean(), ((alike - same) ** 2)[mask].mean()]  # fmt: skip


def flicker(images: list[np.ndarray]) -> float:
    """Mean second difference in time."""
    threes = zip(images[:-2], images[1:-1], images[2:], strict=True)
    return float(np.mean([np.abs(a - 2 * b + c).mean() for a, b, c in threes]))


def of_frames(weights, recording, events, kept: dict) -> dict:
    """Both ways on the recording's frames; kept: the images at their times, which may be more."""
    times, shape = recording.frames.times, (recording.height, recording.width)
    gaps = of_windows(weights, recording, Windows(frame_to_frame=True))
    ends = np.array(sorted(gaps))  # of the last event before a frame
    rows = {"frame to frame": [], "at its time": []}
    for number, time in enumerate(times.tolist()):
        if time not in kept or time < ends[0]:
            continue
        frame = recording.frames.read(number).astype(np.float32) / 255
        mask = moving(events, time, shape)
        last = ends[ends <= time].max()
        rows["frame to frame"].append(score(gaps[int(last)], frame, mask))
        rows["at its time"].append(score(kept[time], frame, mask))
    apart = float(np.median(np.diff(times))) / 1000
    found = {"frames": len(rows["at its time"]), "milliseconds_apart": apart}
    for name, values in rows.items():
        found[name] = dict(zip(NAMES, np.mean(values, 0).round(4).tolist(), strict=True))
    return found


def measure(weights, path: Path) -> dict:
    recording = fj.open_recording(path)
    events = concatenate(list(recording.events()))
    windows, frames = usual(iter([events])), recording.frames
    inside = frames.times[(frames.times >= events.t[0]) & (frames.times <= events.t[-1])]
    kept = at(weights, recording, windows, inside)
    found = {"windows": in_words(windows, recording.pixels)}
    found |= of_frames(weights, recording, events, kept)
    if len(inside) > MANY:
        thinned = Frames(frames.times[::3], lambda number: frames.read(3 * number))
        third = dataclasses.replace(recording, frames=thinned)
        found["every_third_frame"] = of_frames(weights, third, events, kept)

    full = of_windows(weights, recording, windows)
    ends = sorted(full)[3:25]
    even = np.linspace(ends[0], ends[-1], len(ends)).round().astype(np.int64)
    found["flicker"] = {
        "windows": flicker([full[t] for t in ends]),
        "at times": flicker(list(at(weights, recording, windows, even).values())),
    }
    begins = np.array([w.events.t[0] for w in cut(recording, windows)])
    fine = at(weights, recording, windows, np.arange(ends[0], ends[min(6, len(ends) - 1)], FINE))
    change = {True: [], False: []}
    for (a, image), (b, following) in zip(list(fine.items()), list(fine.items())[1:], strict=False):
        change[bool(((begins > a) & (begins <= b)).any())].append(np.abs(following - image).mean())
    found["change_in_half_a_ms"] = {
        "a window is kept between": float(np.mean(change[True])),
        "none is": float(np.mean(change[False])),
    }
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", type=Path, nargs="+", help="with frames")
    parser.add_argument("--weights", type=Path, help="FireNet's, instead of the built-in ones")
    options = parser.parse_args()
    weights, results = fj.load_weights(options.weights), {}
    for path in options.recordings:
        if fj.open_recording(path).frames is None:
            print(f"{path.name}: no frames")
            continue
        results[path.name] = measure(weights, path)
        lines = (f"{name}: {value}" for name, value in results[path.name].items())
        print(path.name, *lines, sep="\n  ", flush=True)
    save("instants", results)


if __name__ == "__main__":
    main()
