"""Images of a method, frames of a camera -> metrics and pictures, batch by batch.

An image (H, W) float32 is compared with the frame closest to it in time. Both are clipped to 0 to 1
and equalised before; the temporal error uses images that are not equalised.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple, TypeVar, cast

import jax
import numpy as np

from firenet_jax.evaluation import lpips, metrics
from firenet_jax.evaluation.equalise import Kind, equalise
from firenet_jax.evaluation.results import METRICS, Measured
from firenet_jax.events import Frames, Recording
from firenet_jax.instants import Grid
from firenet_jax.pictures import to_8_bit
from firenet_jax.windows import Windows

IMAGES_AT_ONCE = 8  # that are compared in one call
STILLS = (0.2, 0.55, 0.9)  # positions of the stills, relative to the part that counts
CLIP_LENGTH = 60  # pictures of the report's video

COMPARED = [name for name in METRICS if name not in ("lpips", "temporal_error")]


class Gap(Exception):
    """Why a metric is missing, in a few words for a table."""


def velocity(frames: Frames, number: int) -> np.ndarray | None:
    """(2, H, W) optical flow up to a frame, pixels per second; None where the recording has none,
    or it is nowhere known: an error over no pixels would be none at all."""
    found = None if frames.flow is None else frames.flow(number)
    return found if found is not None and np.isfinite(found).any() else None


class Plan(NamedTuple):
    """Which part of a recording is reconstructed, and which frames count."""

    name: str
    recording: Recording
    numbers: np.ndarray  # (F,) of the frames that are used, in the recording
    times: np.ndarray  # (F,) int64, microseconds
    first: int  # of these, the frames first <= i < last count
    last: int
    origin: int  # microseconds: the sequence's beginning
    begin: int  # microseconds: reconstruction begins here
    windows: Windows  # as set, or the defaults for the recording
    wanted: np.ndarray | Grid | None = None  # times of images; None: one per window

    @property
    def up_to_frames(self) -> bool:
        """Whether an image is of the events up to a frame."""
        return self.windows.frame_to_frame and self.wanted is None

    @property
    def frames(self) -> Frames:
        """The recording's frames; without any there is no plan."""
        return cast(Frames, self.recording.frames)


class Comparison(NamedTuple):
    """An image and the frame that it is compared with."""

    place: int  # of the frame, in Plan.times
    image: jax.Array  # (H, W), raw
    truth: np.ndarray  # (H, W) uint8
    flow: np.ndarray | None  # (H, W, 2) pixels since the frame before


Prediction = TypeVar("Prediction")


def matched(
    predictions: Iterator[tuple[int, Prediction]],
    times: np.ndarray,
    tolerance: int,
    up_to_frames: bool = False,
) -> Iterator[tuple[int, Prediction]]:
    """(time, image or other prediction) in time order -> (index of a frame, prediction): for each
    frame the closest one, if it is at most `tolerance` microseconds away.

    up_to_frames: predictions are of windows that last until a frame; it is the only one that each
    may have, even where the last event is closer to the frame at the window's beginning.
    """
    best: tuple[int, int, Prediction] | None = None
    for moment, image in predictions:
        after = int(np.searchsorted(times, moment))
        around = (after,) if up_to_frames else (after - 1, after)
        near = [place for place in around if 0 <= place < len(times)]
        if not near:
            continue
        place = min(near, key=lambda place: abs(int(times[place]) - moment))
        distance = abs(int(times[place]) - moment)
        if distance > tolerance:
            continue
        if best is not None and best[0] != place:
            yield best[0], best[2]
            best = None
        # Of windows up to a frame, a second one is of events at its very time, and begins there.
        if best is None or distance < best[1] and not up_to_frames:
            best = place, distance, image
    if best is not None:
        yield best[0], best[2]


class Measurements:
    """The metrics of one method on one sequence, computed in batches."""

    def __init__(self, plan: Plan, kind: Kind, learned: lpips.Lpips | None):
        self.plan = plan
        self.kind: Kind = kind
        small = min(plan.recording.height, plan.recording.width) < lpips.MIN_SIDE
        self.learned = None if small else learned
        self.no_lpips = "no weights" if learned is None else "pictures too small"
        self.places: list[int] = []
        self.values = {name: [] for name in METRICS if name != "lpips" or self.learned}
        self.last: tuple[int, np.ndarray, np.ndarray] | None = None  # place, image, truth

    def add(self, batch: list[Comparison]) -> tuple[np.ndarray, np.ndarray]:
        """Computes the metrics; returns the compared images and truths, (n, H, W) float32."""
        places = [entry.place for entry in batch]
        images = np.stack(jax.device_get([entry.image for entry in batch]))
        if not np.isfinite(images).all():
            bad = places[int(np.argmin(np.isfinite(images).all((1, 2))))]
            raise Gap(f"image of frame {self.plan.numbers[bad] + 1} is not finite")
        images = np.clip(images, 0, 1)
        truths = np.stack([entry.truth for entry in batch]).astype(np.float32) / 255
        compared = equalise(images, self.kind), equalise(truths, self.kind)
        count = len(batch)
        for name, values in _compare(*map(_whole, compared)).items():
            self.values[name] += values[:count].tolist()
        if self.learned:
            distances = lpips.lpips(self.learned, *map(_whole, compared))
            self.values["lpips"] += distances[:count].tolist()
        self.values["temporal_error"] += self._temporal(batch, images, truths)
        self.places += places
        return compared

    def _temporal(self, batch, images, truths) -> list[float | None]:
        """Of images that are not equalised, because it measures flicker, not contrast."""
        last = self.last or (-1, images[0], truths[0])
        befores = [last[0], *(entry.place for entry in batch[:-1])]
        self.last = batch[-1].place, images[-1], truths[-1]
        known = [
            entry.flow is not None and entry.place == before + 1
            for entry, before in zip(batch, befores, strict=True)
        ]
        if not any(known):
            return [None] * len(batch)
        still = np.zeros((*images.shape[1:], 2), np.float32)
        flows = np.stack([e.flow if k else still for e, k in zip(batch, known, strict=True)])
        previous = np.concatenate([last[1][None], images[:-1]])
        previous_truths = np.concatenate([last[2][None], truths[:-1]])
        visible = np.asarray(np.isfinite(flows).all(-1))  # files hold nan where flow is unknown
        errors = metrics.temporal_error(
            *map(_whole, (images, previous, flows, truths, previous_truths, visible))
        ).tolist()
        return [error if k else None for error, k in zip(errors, known, strict=False)]

    def result(self, empty: int, seconds: float) -> Measured:
        """The results. A value that is not finite becomes null, and its metric a gap."""
        gaps = {}
        values = {}
        for name, series in self.values.items():
            good = [value is None or math.isfinite(value) for value in series]
            if not all(good):
                place = self.places[good.index(False)]
                gaps[name] = f"infinite at frame {self.plan.numbers[place] + 1}"
            elif all(value is None for value in series):
                flows = (velocity(self.plan.frames, int(n)) for n in self.plan.numbers)
                known = any(flow is not None for flow in flows)
                gaps[name] = "no two frames in a row" if known else "no flow"
            values[name] = [v if ok else None for v, ok in zip(series, good, strict=True)]
        if not self.learned:
            gaps["lpips"] = self.no_lpips
        return Measured(
            frames=len(self.places),
            of=self.plan.last - self.plan.first,
            windows_without_events=empty,
            seconds=round(seconds, 3),
            gaps=gaps,
            frame_numbers=[int(self.plan.numbers[place]) for place in self.places],
            times=[
                round((int(t) - self.plan.origin) / 1e6, 6) for t in self.plan.times[self.places]
            ],
            values=values,
        )


def _whole(batch: np.ndarray) -> np.ndarray:
    """(n, ...) -> (IMAGES_AT_ONCE, ...), the last entry repeated: one size compiles once."""
    return np.concatenate([batch, np.repeat(batch[-1:], IMAGES_AT_ONCE - len(batch), 0)])


@jax.jit
def _compare(images: jax.Array, truths: jax.Array) -> dict[str, jax.Array]:
    return {name: getattr(metrics, name)(images, truths) for name in COMPARED}


class Pictures:
    """The pictures for the report: stills and a clip."""

    def __init__(self, plan: Plan):
        count = plan.last - plan.first
        self.numbers = plan.numbers
        self.wanted = [plan.first + int(share * count) for share in STILLS]
        self.begin = plan.first + max(0, (count - CLIP_LENGTH) // 2)
        self.kept: dict[str, list] = {"stills": [], "clip": []}

    def add(self, batch: list[Comparison], compared: tuple[np.ndarray, np.ndarray]) -> None:
        for entry, image in zip(batch, compared[0], strict=True):
            picture = int(self.numbers[entry.place]), np.asarray(to_8_bit(image))
            if self.wanted and entry.place >= self.wanted[0]:
                self.wanted = [place for place in self.wanted if place > entry.place]
                self.kept["stills"].append(picture)
            if entry.place >= self.begin and len(self.kept["clip"]) < CLIP_LENGTH:
                self.kept["clip"].append(picture)

    def arrays(self) -> dict[str, np.ndarray]:
        arrays = {}
        for name, kept in self.kept.items():
            arrays[f"{name}_frames"] = np.array([number for number, _ in kept], np.int64)
            arrays[name] = np.array([picture for _, picture in kept], np.uint8)
        return arrays
