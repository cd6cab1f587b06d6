"""Recording, frames, method -> numbers for each frame: which frames count, and against what.

The protocol is EVREAL's for the paper's data. Window i holds the events between frames i-1 and i.
Reconstruction begins 10 s before the part that counts. A prediction has the time of its window's
last event (of its end, if the window is empty) and counts if that is within 1 ms of the frame.
Images at given times are steps whose new state is discarded; the state advances by windows of fixed
size (instants.py). Frames and predictions are compared as (H, W) float32, clipped to 0 to 1,
optionally after histogram equalisation. `Protocol` changes each of these.
"""

import copy
import dataclasses
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
from tqdm import tqdm

from firenet_jax.errors import SettingsError
from firenet_jax.evaluation import lpips
from firenet_jax.evaluation.comparison import (
    IMAGES_AT_ONCE,
    Comparison,
    Gap,
    Measurements,
    Pictures,
    Plan,
    matched,
    velocity,
)
from firenet_jax.evaluation.equalise import Kind
from firenet_jax.evaluation.methods import Method, look
from firenet_jax.evaluation.metrics import CW_SSIM_SIDE
from firenet_jax.evaluation.results import Measured
from firenet_jax.events import Frames, Recording
from firenet_jax.filters import check_span
from firenet_jax.instants import Step, steps
from firenet_jax.settings import check_seed, check_sizes
from firenet_jax.storage.files import named
from firenet_jax.storage.overlap import prefetch
from firenet_jax.windows import (
    DEFAULT_LONGEST,
    USUAL_DENSITY,
    Window,
    Windows,
    cut,
    in_words,
    usual,
)

# Seconds from the beginning of the Event Camera Dataset's sequences (EVREAL's; one of E2VID's
# authors gave the same in rpg_e2vid's issue 17).
CUTS = {
    "boxes_6dof": (5.0, 20.0),
    "calibration": (5.0, 20.0),
    "dynamic_6dof": (5.0, 20.0),
    "office_zigzag": (5.0, 12.0),
    "poster_6dof": (5.0, 20.0),
    "shapes_6dof": (5.0, 20.0),
    "slider_depth": (1.0, 2.5),
}


@dataclass(frozen=True)
class Protocol:
    """Which frames count, and what they are compared with."""

    windows: Windows  # none chosen: of a usual size for the recording, if images are at given times
    images_at: str | None = None  # in words, "images at ..."; None: one image a window
    keep_ratio: float = 1.0  # share of the frames that are used, drawn at random by the seed
    seed: int = 0
    start: float | None = None  # seconds from the beginning; both None: `CUTS` by name, or all
    stop: float | None = None
    warm_up: float = 10.0  # seconds before the first frame that counts
    tolerance: float = 1.0  # milliseconds between an image and its frame
    equalise: Kind = "none"

    def __post_init__(self):
        """Raises SettingsError for invalid values."""
        if not 0 < self.keep_ratio <= 1:
            raise SettingsError(f"keep ratio is {self.keep_ratio}, but is a share, 0 to 1")
        if self.keep_ratio < 1 and not self.windows.frame_to_frame:
            raise SettingsError(
                "keep ratio thins out frames: it varies windows between frames only"
            )
        check_sizes(self, "warm_up", "tolerance", zero=True)
        check_seed(self.seed)
        check_span(self.start, self.stop)

    @property
    def tolerated(self) -> int:
        """Microseconds between an image and its frame."""
        return round(1000 * self.tolerance)

    def interval(self, path: Path) -> tuple[float, float]:
        """Seconds from the beginning of a recording: what counts."""
        if self.start is None and self.stop is None:
            name = named(path).name if path.is_dir() else path.stem
            return CUTS.get(name, (0.0, math.inf))
        return self.start or 0.0, math.inf if self.stop is None else self.stop

    def images_in_words(self, plan: Plan) -> str:
        """ "images at the times of its frames, the state by windows of 15,120 events" """
        windows = in_words(plan.windows, plan.recording.pixels)
        return windows if self.images_at is None else f"{self.images_at}, the state by {windows}"

    def in_words(self) -> list[str]:
        """What is done, in sentences, for people who read a table."""
        if self.windows == Windows():
            windows = (
                f"windows of {USUAL_DENSITY} events per pixel, at most {DEFAULT_LONGEST:g} ms or "
                "a twentieth of a recording"
            )
        else:  # none of a protocol's depends on the sensor
            windows = in_words(self.windows, pixels=0)
        if self.images_at is not None:
            windows = (
                f"{self.images_at}, each from an extra step whose state is discarded; the state by "
                f"{windows} (hf and mr process the events since their last update)"
            )
        if self.keep_ratio < 1:
            windows += f", {self.keep_ratio:g} of the frames kept (seed {self.seed})"
        return [
            f"{windows}; warm-up of up to {self.warm_up:g} s; predictions within "
            f"{self.tolerance:g} ms of a frame count",
            f"histogram equalisation before metrics: {self.equalise} (temporal error: none); "
            "images clipped to 0 to 1, E2VID's stretched before (1st to 99th percentile)",
            "SSIM: Gaussian window of 11x11 pixels, sigma 1.5, population covariance, data range "
            "1, without the border; PSNR in dB for a range of 1",
            "temporal error: mean M |I_k - W(I_k-1)|, warped by the data's optical flow; Features: "
            "distance between features of a random network",
        ]


def plan(name: str, recording: Recording, protocol: Protocol) -> Plan:
    """Which frames count and where reconstruction begins; `wanted` is left to the caller.

    Raises Gap where nothing can count.
    """
    frames = recording.frames
    if frames is None or len(frames.times) < 2:
        raise Gap("no frames" if frames is None else "fewer than two frames")
    if frames.damage is not None:  # those after it would be left out of the means
        raise Gap(f"its frames end where it is damaged: {frames.damage}")
    height, width = frames.read(0).shape
    if (height, width) != (recording.height, recording.width):
        raise Gap(
            f"frames are {width}x{height}, the sensor is {recording.width}x{recording.height}"
        )
    if min(height, width) < CW_SSIM_SIDE:
        raise Gap(f"{width}x{height} pixels are too small to be compared")
    times = np.asarray(frames.times, np.int64)
    if (np.diff(times) < 0).any():
        raise Gap("times of frames run backwards")
    begin = first_event(recording, times)
    origin = min(begin, int(times[0]))
    numbers = np.arange(len(times))
    if protocol.keep_ratio < 1:
        count = max(2, int(protocol.keep_ratio * len(times)))
        draw = np.random.default_rng(protocol.seed)
        numbers = np.sort(draw.choice(len(times), count, replace=False))
        times = times[numbers]
    start, stop = protocol.interval(recording.path)
    seconds = (times - origin) / 1e6
    counting = np.flatnonzero((seconds >= start) & (seconds <= stop))
    counting = counting[counting > 0]  # no window ends at the first frame
    if not counting.size:
        if protocol.start is None and protocol.stop is None and stop < math.inf:
            raise Gap(
                f"no frames from {start:g} to {stop:g} s, which count in the paper's recording of "
                "this name: all do with --start 0"
            )
        end = "s on" if math.isinf(stop) else f"to {stop:g} s"
        raise Gap(f"no frames from {start:g} {end}")
    first, last = int(counting[0]), int(counting[-1]) + 1
    # Reconstruction begins at a frame, if there is one, so that windows between frames are whole.
    warm = int(times[first]) - round(1e6 * protocol.warm_up)
    before = np.searchsorted(times, warm, "right") - 1
    begin = max(begin, warm if before < 0 else int(times[min(before, first - 1)]))
    windows = protocol.windows
    if windows == Windows():
        windows = usual(recording.events())
    return Plan(name, recording, numbers, times, first, last, origin, begin, windows)


def first_event(recording: Recording, times: np.ndarray) -> int:
    """Its time. Raises Gap where the events do not reach from before the last frame to after the
    first."""
    first, last = None, 0
    for events in recording.events():
        first = int(events.t[0]) if first is None else first
        last = int(events.t[-1])
        if last >= times[0]:
            break
    if first is None:
        raise Gap("no events")
    if first > times[-1] or last < times[0]:
        raise Gap(
            f"no overlap in time: frames {times[0] / 1e6:.6f} to {times[-1] / 1e6:.6f} s, events "
            + (f"from {first / 1e6:.6f} s" if first > times[-1] else f"up to {last / 1e6:.6f} s")
        )
    return first


def steps_of(plan: Plan) -> Iterator[Window | Step]:
    """Windows, which have an image each; or, of images at given times, the steps for those."""
    recording = plan.recording
    later = (e.select(slice(np.searchsorted(e.t, plan.begin), None)) for e in recording.events())
    if plan.wanted is not None:  # a grid counts on
        windows = cut(recording, plan.windows, filter(len, later))
        return steps(recording, plan.windows, copy.copy(plan.wanted), windows)
    recording = dataclasses.replace(recording, frames=Frames(plan.times, plan.frames.read))
    return cut(recording, plan.windows, filter(len, later), plan.begin)


def predicted(
    plan: Plan, method: Method, entries: Iterator[Window | Step]
) -> Iterator[tuple[int, int, jax.Array]]:
    """Yields (time, events, image) of each window, or of each step that looks."""
    before = last = method.initial(plan.recording.height, plan.recording.width)
    time = plan.begin
    for entry in entries:
        if isinstance(entry, Step) and entry.time is not None:
            yield entry.time, len(entry.events), look(method, before, last, entry)
            continue
        if isinstance(entry, Window):
            time = entry.time
        elif len(entry.events):  # a step that is kept
            time = int(entry.events.t[-1])
        before = last
        last, image = method.step(last, Window(entry.events, time))
        if isinstance(entry, Window):
            yield time, len(entry.events), image


def until(latest: int, entries: Iterator[Window | Step]) -> Iterator[Window | Step]:
    """Those that images up to this time need."""
    for entry in entries:
        time = entry.time
        if time is None:  # kept, for images from its end on
            time = int(entry.events.t[0]) if len(entry.events) else latest
        if time > latest:
            return
        yield entry


def displacement(plan: Plan, place: int) -> np.ndarray | None:
    """(H, W, 2) pixels since the frame before, where flow is known and the frame before is used
    too."""
    number = int(plan.numbers[place])
    if place == 0 or number != plan.numbers[place - 1] + 1:
        return None
    flow = velocity(plan.frames, number)
    if flow is None:
        return None
    seconds = np.float32(1e-6 * (plan.times[place] - plan.times[place - 1]))
    return seconds * np.moveaxis(flow.astype(np.float32), 0, -1)


def evaluate(
    plan: Plan, method: Method, protocol: Protocol, learned: lpips.Lpips | None, progress: tqdm
) -> tuple[Measured, dict[str, np.ndarray]]:
    """-> (numbers for each frame; pictures (n, H, W) uint8 and their frames).

    Raises Gap where no prediction counts or an image is not finite.
    """
    began, before = time.monotonic(), progress.n
    entries = prefetch(iter(steps_of(plan)), depth=4)
    tolerance = protocol.tolerated
    latest = int(plan.times[plan.last - 1]) + tolerance
    empty = 0

    def predictions():
        nonlocal empty
        for time_of, events, image in predicted(plan, method, until(latest, entries)):
            empty += events == 0
            passed = np.searchsorted(plan.times, time_of, "right")
            progress.update(int(min(passed, plan.last)) - (progress.n - before))
            yield time_of, image

    found, pictures = Measurements(plan, protocol.equalise, learned), Pictures(plan)
    waiting: list[Comparison] = []
    try:
        for place, image in matched(predictions(), plan.times, tolerance, plan.up_to_frames):
            if plan.first <= place < plan.last:
                truth = plan.frames.read(int(plan.numbers[place]))
                if truth.shape != image.shape:
                    size, sensor = (f"{w}x{h}" for h, w in (truth.shape, image.shape))
                    raise Gap(f"frame {plan.numbers[place] + 1} is {size}, the sensor is {sensor}")
                waiting.append(Comparison(place, image, truth, displacement(plan, place)))
            if len(waiting) == IMAGES_AT_ONCE:
                pictures.add(waiting, found.add(waiting))
                waiting = []
        if waiting:
            pictures.add(waiting, found.add(waiting))
    finally:
        entries.close()
        progress.update(plan.last - (progress.n - before))
    if not found.places:
        raise Gap(f"no prediction within {protocol.tolerance:g} ms of a frame")
    return found.result(empty, time.monotonic() - began), pictures.arrays()
