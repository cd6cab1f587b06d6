"""Methods x sequences -> table, JSON, CSV and a report: how close images come to camera frames.

The protocol is EVREAL's for the paper's data. Window i holds the events between frames i-1 and i.
Reconstruction begins 10 s before the part that counts. A prediction has the time of its window's
last event (of its end, if the window is empty) and counts if that is within 1 ms of a frame. With
--between-frames, --rate, --at or --triggers images are looks at these times, while the state
advances by windows of fixed size (instants.py). Frames and predictions are compared as (H, W)
float32, clipped to 0 to 1, optionally after histogram equalisation. Options change each of these.

    OUTPUT/results/SEQUENCE/METHOD.json     written when one method has finished one sequence
    OUTPUT/results/SEQUENCE/METHOD.npz      some of its pictures
    OUTPUT/table.csv, results.json, index.html, videos/SEQUENCE.mp4       made from all of those

Results appear under their names when they are complete, so an interrupted run resumes with the
others. A metric that cannot be computed is null, with a reason, never NaN.
"""

import copy
import dataclasses
import hashlib
import importlib
import importlib.metadata
import json
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import tyro
from tqdm import tqdm

from firenet_jax.commands import options
from firenet_jax.commands.times import Times, read_times, times_of
from firenet_jax.errors import OutputError, RecordingError, SettingsError, logger
from firenet_jax.evaluation import lpips, report
from firenet_jax.evaluation.comparison import (
    IMAGES_AT_ONCE,
    Comparison,
    Gap,
    Measurements,
    Pictures,
    Plan,
    matched,
    to_8_bit,
)
from firenet_jax.evaluation.equalise import Kind, equalise
from firenet_jax.evaluation.methods import METHODS, Method, Missing, digest, load, look
from firenet_jax.evaluation.results import METRICS, Measured, mean, summary
from firenet_jax.events import Frames, Recording
from firenet_jax.filters import check_span
from firenet_jax.instants import Step, steps
from firenet_jax.readers import FORMATS, open_recording
from firenet_jax.settings import check_seed, parse_size
from firenet_jax.storage.files import identity, named, read_arrays, write_arrays, write_text
from firenet_jax.storage.overlap import ahead
from firenet_jax.storage.progress import bar
from firenet_jax.storage.runs import alone_in, check_same, differences, make_folder, read_record
from firenet_jax.storage.video import write_video
from firenet_jax.windows import Window, Windows, cut, in_words, usual

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
# Formats that can hold frames.
SUFFIXES = (".h5", ".hdf5", ".hdf", ".zip", ".bag", ".mcap", ".aedat", ".aedat4")
MIN_SIDE = 17  # pixels of a side: what CW-SSIM's filters need
MAX_VIDEO_WIDTH = 2000  # pixels


@dataclass(frozen=True)
class Evaluate:
    """Compare reconstructions with the frames of recordings: a table, JSON, CSV and an HTML report.

    Examples:
      firenet evaluate dynamic_6dof.zip boxes_6dof.zip -o report/
      firenet evaluate simulated/ -o report/ --methods firenet,hf,mr
      firenet evaluate hqf/*.h5 -o report/ --weights built-in firenet_plus.pth --equalise local
    """

    data: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="DATA...", help_behavior_hint=""),
    ]
    """Recordings with frames: ECD folders, zips and bags, HDF5 (HQF, MVSEC, our own), EVREAL
    folders; or folders of such recordings."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """A folder for index.html, table.csv and results.json. An interrupted evaluation is resumed,
    and one with more data or methods reuses earlier results."""
    methods: str | None = None
    """Comma-separated: firenet, e2vid, hf (high-pass filter), mr (manifold regularisation).
    Default: all, e2vid only if its weights are given."""
    weights: Annotated[tuple[Path, ...], tyro.conf.arg(aliases=["-c"])] = ()
    """Weights of FireNet or FireNet+; each file is a method named after it. Default: the built-in
    weights."""
    e2vid_weights: Path | None = None
    """E2VID's published checkpoint, or E2VID+'s."""
    e2vid_sigmoid: bool = True
    """--no-e2vid-sigmoid for E2VID+, which has no sigmoid at its end."""
    e2vid_random: bool = False
    """Run E2VID with random weights, to measure its time."""
    events: Annotated[int | None, tyro.conf.arg(aliases=["-N"])] = None
    """Windows of this many events instead of windows between frames. With images at given times:
    the windows that update the state."""
    duration: Annotated[float | None, tyro.conf.arg(aliases=["-T"])] = None
    """Windows of this many milliseconds, likewise. Default with images at given times: 0.35 events
    per pixel, at most 40 ms."""
    times: Times = Times()
    keep_ratio: float = 1.0
    """Use only this share of the frames, drawn at random, so that windows between them become
    longer and uneven."""
    seed: int = 0
    """Random seed of the choice of frames."""
    start: float | None = None
    """Count frames from this many seconds after the beginning (the first event or frame). Default
    for recordings named like those of the Event Camera Dataset: the paper's interval."""
    stop: float | None = None
    """Count frames up to this many seconds after the beginning."""
    warm_up: float = 10.0
    """Begin to reconstruct this many seconds before the first frame that counts."""
    tolerance: float = 1.0
    """A prediction counts if it is within this many milliseconds of a frame."""
    equalise: Kind = "none"
    """Histogram equalisation of images and frames before comparison."""
    lpips: tuple[Path, Path] | None = None
    """Compute LPIPS from two files: torchvision's AlexNet or SqueezeNet, and LPIPS's linear
    layers."""
    sensor_size: str | None = None
    """WIDTHxHEIGHT of the sensor, such as 240x180, if the recordings do not state it."""
    overwrite: bool = False
    """Recompute results that an evaluation with other settings left in the output folder."""

    def __post_init__(self):
        if not self.data:
            raise SettingsError(
                "no data: name one or more recordings, or folders of them, before the options"
            )
        if not self.method_names:
            raise SettingsError(f"no methods: choose from {', '.join(METHODS)}")
        Windows(events=self.events, duration=self.duration)  # refuses numbers that cannot be
        if not 0 < self.keep_ratio <= 1:
            raise SettingsError(f"keep ratio is {self.keep_ratio}, but is a share, 0 to 1")
        if self.keep_ratio < 1 and not self.frame_to_frame:
            raise SettingsError(
                "keep ratio thins out frames: it varies windows between frames only"
            )
        for name in ("warm_up", "tolerance"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise SettingsError(f"{name} is {value}, but must be 0 or more")
        check_seed(self.seed)
        check_span(self.start, self.stop)
        parse_size(self.sensor_size)

    @property
    def method_names(self) -> list[str]:
        if self.methods is None:
            e2vid = ["e2vid"] if self.e2vid_weights or self.e2vid_random else []
            return ["firenet", *e2vid, "hf", "mr"]
        return [name.strip() for name in self.methods.split(",") if name.strip()]

    @property
    def frame_to_frame(self) -> bool:
        return self.events is None and self.duration is None and not self.times.wanted

    @property
    def windows(self) -> Windows:
        return Windows(self.events, None, self.duration, self.frame_to_frame)


def run(settings: Evaluate) -> dict:
    """Does what the settings say; returns what results.json holds. Raises RecordingError,
    CheckpointError, OutputError or SettingsError with a message of one sentence."""
    sequences = find_sequences(settings.data)
    methods = load(
        settings.method_names,
        settings.weights,
        settings.e2vid_weights,
        e2vid_random=settings.e2vid_random,
        e2vid_sigmoid=settings.e2vid_sigmoid,
    )
    learned = None if settings.lpips is None else lpips.load(*settings.lpips)
    size = parse_size(settings.sensor_size)
    if settings.output.is_file():
        raise OutputError(f"{settings.output} is a file: choose another name for the folder")
    recordings = {name: open_recording(path, size, True) for name, path in sequences.items()}
    shared = describe(settings, learned)
    records = {
        (name, method.name): describe_one(shared, recording, method)
        for name, recording in recordings.items()
        for method in methods
        if isinstance(method, Method)
    }
    with alone_in(settings.output):
        done = open_folder(settings, records)

        plans: dict[str, Plan] = {}
        gaps = {
            (name, method.name): method.reason
            for name in recordings
            for method in methods
            if isinstance(method, Missing)
        }
        for name, recording in recordings.items():
            try:
                plans[name] = plan(name, recording, settings)
            except (Gap, RecordingError) as error:
                logger.warning("%s: %s", recording.path, error)
                gaps = {(name, method.name): str(error) for method in methods} | gaps
        compute(settings, records, plans, methods, learned, done, gaps)
        if not any(key in done for key in records):
            reason = next(iter(gaps.items()), (("", ""), "no method can run"))
            raise RecordingError(f"nothing can be evaluated: {' / '.join(reason[0])}: {reason[1]}")

        results = summarise(settings, shared, plans, recordings, methods, done, gaps)
        write_all(settings, results, plans, [key for key in records if key in done])
        return results


def compute(
    settings: Evaluate,
    records: dict[tuple[str, str], dict],
    plans: dict[str, Plan],
    methods: list[Method | Missing],
    learned: lpips.Lpips | None,
    done: dict[tuple[str, str], Measured],
    gaps: dict[tuple[str, str], str],
) -> None:
    """What is neither done nor a gap is computed, written, and added to one of them."""
    work = [key for key in records if key not in done and key not in gaps]
    by_name = {method.name: method for method in methods if isinstance(method, Method)}
    total = sum(plans[name].last for name, _ in work)
    with bar(total, "frames", smoothing=0.1) as progress:
        for name, method in work:
            progress.set_postfix_str(f"{name}, {method}")
            try:
                found, pictures = evaluate(
                    plans[name], by_name[method], settings, learned, progress
                )
            except (Gap, RecordingError) as error:
                logger.warning("%s, %s: %s", name, method, error)
                gaps[name, method] = str(error)
                continue
            save(result_file(settings, name, method), records[name, method], found, pictures)
            done[name, method] = found


# ---- Data


def find_sequences(paths: tuple[Path, ...]) -> dict[str, Path]:
    """Recordings and folders of them -> name: path. Raises RecordingError for an empty folder and
    for two of one name."""
    found: dict[str, Path] = {}
    for path in paths:
        inside = [path]
        if path.is_dir() and not is_recording(path):
            inside = recordings_in(path)
            if not inside:
                raise RecordingError(f"{path}: holds no recordings: name files or other folders")
        for recording in inside:
            parts = [named(path).name, *recording.relative_to(path).parts]
            if recording.is_file():
                parts[-1] = Path(parts[-1]).stem
            name = "-".join(parts)
            if name in found:
                raise RecordingError(
                    f"{found[name]} and {recording} are both named {name}: rename one of them"
                )
            found[name] = recording
    return found


def is_recording(path: Path) -> bool:
    modules = (importlib.import_module(f"firenet_jax.readers.{name}") for name in FORMATS)
    return any(module.matches(path) for module in modules)


def recordings_in(folder: Path) -> list[Path]:
    found = []
    for path in sorted(folder.iterdir()):
        if path.is_dir():
            found += [path] if is_recording(path) else recordings_in(path)
        elif path.suffix.lower() in SUFFIXES and ".partial" not in path.name:
            found.append(path)
    return found


def plan(name: str, recording: Recording, settings: Evaluate) -> Plan:
    """Which frames count and where reconstruction begins. Raises Gap where nothing can count."""
    frames = recording.frames
    if frames is None or len(frames.times) < 2:
        raise Gap("no frames")
    height, width = frames.read(0).shape
    if (height, width) != (recording.height, recording.width):
        raise Gap(
            f"frames are {width}x{height}, the sensor is {recording.width}x{recording.height}"
        )
    if min(height, width) < MIN_SIDE:
        raise Gap(f"{width}x{height} pixels are too small to be compared")
    times = np.asarray(frames.times, np.int64)
    if (np.diff(times) < 0).any():
        raise Gap("times of frames run backwards")
    begin = first_event(recording, times)
    origin = min(begin, int(times[0]))
    numbers = np.arange(len(times))
    if settings.keep_ratio < 1:
        count = max(2, int(settings.keep_ratio * len(times)))
        draw = np.random.default_rng(settings.seed)
        numbers = np.sort(draw.choice(len(times), count, replace=False))
        times = times[numbers]
    start, stop = interval(recording.path, settings)
    seconds = (times - origin) / 1e6
    counting = np.flatnonzero((seconds >= start) & (seconds <= stop))
    counting = counting[counting > 0]  # no window ends at the first frame
    if not counting.size:
        raise Gap(f"no frames from {start:g} to {stop:g} s")
    first, last = int(counting[0]), int(counting[-1]) + 1
    # Reconstruction begins at a frame, so that windows between frames are whole.
    warm = np.searchsorted(times, origin + round(1e6 * (start - settings.warm_up)), "right") - 1
    if warm >= 0:
        begin = max(begin, int(times[min(warm, first - 1)]))
    windows, wanted = settings.windows, times_of(settings.times, recording, recording.events())
    if windows == Windows():
        windows = usual(recording.events())
    return Plan(
        name, recording, numbers, times, first, last, origin, begin, windows=windows, wanted=wanted
    )


def interval(path: Path, settings: Evaluate) -> tuple[float, float]:
    """Seconds from the sequence's beginning: what counts."""
    if settings.start is None and settings.stop is None:
        name = named(path).name if path.is_dir() else path.stem
        return CUTS.get(name, (0.0, math.inf))
    return settings.start or 0.0, math.inf if settings.stop is None else settings.stop


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
        return steps(recording, plan.windows, copy.copy(plan.wanted), filter(len, later))
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
    """(H, W, 2) pixels since the frame before, where the recording has flow and the frame before
    is used too."""
    flow, number = plan.frames.flow, int(plan.numbers[place])
    if flow is None or place == 0 or number != plan.numbers[place - 1] + 1:
        return None
    velocity = flow(number)
    if velocity is None:
        return None
    seconds = np.float32(1e-6 * (plan.times[place] - plan.times[place - 1]))
    return seconds * np.moveaxis(velocity.astype(np.float32), 0, -1)


# ---- One method and one sequence


def evaluate(
    plan: Plan, method: Method, settings: Evaluate, learned: lpips.Lpips | None, progress: tqdm
) -> tuple[Measured, dict[str, np.ndarray]]:
    """-> (numbers for each frame; pictures (n, H, W) uint8 and their frames).

    Raises Gap where no prediction counts or an image is not finite.
    """
    began, before = time.monotonic(), progress.n
    entries = ahead(iter(steps_of(plan)), depth=4)
    tolerance = round(1000 * settings.tolerance)
    latest = int(plan.times[plan.last - 1]) + tolerance
    empty = 0

    def predictions():
        nonlocal empty
        for time_of, events, image in predicted(plan, method, until(latest, entries)):
            empty += events == 0
            passed = np.searchsorted(plan.times, time_of, "right")
            progress.update(int(min(passed, plan.last)) - (progress.n - before))
            yield time_of, image

    found, pictures = Measurements(plan, settings.equalise, learned), Pictures(plan)
    waiting: list[Comparison] = []
    try:
        for place, image in matched(predictions(), plan.times, tolerance):
            if plan.first <= place < plan.last:
                truth = plan.frames.read(int(plan.numbers[place]))
                if truth.shape != image.shape:
                    raise Gap(f"frame {plan.numbers[place] + 1} is of another size: {truth.shape}")
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
        raise Gap(f"no prediction within {settings.tolerance:g} ms of a frame")
    return found.result(empty, time.monotonic() - began), pictures.arrays()


# ---- Results on disk


def describe(settings: Evaluate, learned: lpips.Lpips | None) -> dict:
    """All that numbers depend on but recording and method, ready for JSON."""
    names = ("events", "duration", "keep_ratio", "seed", "start", "stop", "warm_up", "tolerance",
             "equalise", "sensor_size")  # fmt: skip
    record = {name: getattr(settings, name) for name in names}
    record["lpips"] = None if learned is None else digest(learned)
    if settings.times.wanted:
        record["images_at"] = asked(settings.times)
    return record | {"version": importlib.metadata.version("firenet-jax")}


def asked(times: Times) -> dict:
    """What is not at its default; of a file of times what it holds, not its name."""
    found = {
        field.name: getattr(times, field.name)
        for field in dataclasses.fields(times)
        if getattr(times, field.name) != field.default
    }
    if times.at is not None:
        found["at"] = hashlib.sha256(repr(read_times(times.at)).encode()).hexdigest()[:16]
    return found


def describe_one(shared: dict, recording: Recording, method: Method) -> dict:
    return shared | {"recording": identity(recording.path), **method.record}


def result_file(settings: Evaluate, sequence: str, method: str) -> Path:
    return settings.output / "results" / sequence / f"{method}.json"


def open_folder(
    settings: Evaluate, records: dict[tuple[str, str], dict]
) -> dict[tuple[str, str], Measured]:
    """Makes the output folder; returns the results of an earlier run that belong to this one.

    Raises OutputError where a result was made by other settings, which `overwrite` replaces.
    """
    folder = settings.output
    if any(folder.iterdir()) and not (folder / "results").is_dir():
        raise OutputError(f"{folder} is a folder of something else: choose another output")
    done = {}
    for key, record in records.items():
        path = result_file(settings, *key)
        if not (path.is_file() and path.with_suffix(".npz").is_file()):
            continue
        saved = read_record(path, "remove it")
        if saved is None:
            continue
        try:
            was, result = {**saved["record"]}, Measured(**saved["result"])
        except (KeyError, TypeError) as error:
            raise OutputError(f"{path} is damaged ({error}): remove it") from error
        if not settings.overwrite:
            check_same(
                was, record, f"{path} was made with other settings",
                "choose another output, or pass --overwrite to compute it again",
            )  # fmt: skip
        if not differences(was, record):
            done[key] = result
    for key in records:
        make_folder(result_file(settings, *key).parent)
    if done:
        logger.warning("%s: going on, %d of %d results are there", folder, len(done), len(records))
    return done


def save(path: Path, record: dict, result: Measured, pictures: dict[str, np.ndarray]) -> None:
    """The pictures first: numbers that are there mean that all is."""
    write_arrays(path.with_suffix(".npz"), **pictures)
    write_text(path, json.dumps({"record": record, "result": result._asdict()}, allow_nan=False))


# ---- Tables


def summarise(settings, shared, plans, recordings, methods, done, gaps) -> dict:
    """What results.json holds: settings, numbers of each sequence and method, means."""
    sequences = {}
    for name, recording in recordings.items():
        entries = {}
        for method in methods:
            key = name, method.name
            found = done.get(key)
            entries[method.name] = {"gap": gaps[key]} if found is None else summary(found)
        start, stop = interval(recording.path, settings)
        sequences[name] = {
            "path": str(recording.path),
            "format": recording.format,
            "sensor": [recording.width, recording.height],
            "counted_seconds": [start, None if math.isinf(stop) else stop],
            "images": None if name not in plans else images_in_words(plans[name], settings),
            "methods": entries,
        }
    names = [method.name for method in methods]
    return {
        "settings": shared,
        "protocol": protocol(settings),
        "metrics": {name: metric._asdict() for name, metric in METRICS.items()},
        "methods": {m.name: getattr(m, "record", None) for m in methods},
        "sequences": sequences,
        "means": {
            "over sequences": {name: mean(sequences, name, weigh=False) for name in names},
            "over frames": {name: mean(sequences, name, weigh=True) for name in names},
        },
    }


def images_in_words(plan: Plan, settings: Evaluate) -> str:
    """ "images at the times of its frames, the state by windows of 15,120 events" """
    windows = in_words(plan.windows, plan.recording.pixels)
    if not settings.times.wanted:
        return windows
    return f"{settings.times.in_words()}, the state by {windows}"


def protocol(settings: Evaluate) -> list[str]:
    """What was done, in sentences, for people who read a table."""
    if settings.frame_to_frame:
        windows = "windows between frames"
    elif settings.events is not None:
        windows = f"windows of {settings.events} events"
    elif settings.duration is not None:
        windows = f"windows of {settings.duration:g} ms"
    else:
        windows = "windows of 0.35 events per pixel, at most 40 ms or a twentieth of a recording"
    if settings.times.wanted:
        windows = (
            f"{settings.times.in_words()}, each a look whose state is thrown away; the state by "
            f"{windows} (hf and mr look at the events since)"
        )
    if settings.keep_ratio < 1:
        windows += f", {settings.keep_ratio:g} of the frames kept (seed {settings.seed})"
    return [
        f"{windows}; warm-up of up to {settings.warm_up:g} s; predictions within "
        f"{settings.tolerance:g} ms of a frame count",
        f"histogram equalisation before metrics: {settings.equalise} (temporal error: none); "
        "images clipped to 0 to 1, E2VID's stretched before (1st to 99th percentile)",
        "SSIM: Gaussian window of 11x11 pixels, sigma 1.5, population covariance, data range 1, "
        "without the border; PSNR in dB for a range of 1",
        "temporal error: mean M |I_k - W(I_k-1)|, warped by the data's optical flow; Features: "
        "distance between features of a random network",
    ]


def write_all(settings: Evaluate, results: dict, plans: dict[str, Plan], done: list) -> None:
    """Prints the table; writes results.json, table.csv, the videos and index.html."""
    folder = settings.output
    results["command"] = options.command_line("evaluate", settings)
    write_text(folder / "results.json", json.dumps(results, indent=1, allow_nan=False))
    write_text(folder / "table.csv", report.spreadsheet(results))
    shown = {name: show(settings, plan, done) for name, plan in plans.items()}
    write_text(folder / "index.html", report.page(results, shown))
    print(report.table(results))
    print(f"\n{folder / 'index.html'}: the report; table.csv and results.json beside it")


def show(settings: Evaluate, plan: Plan, done: list) -> report.Shown:
    """The pictures of a sequence side by side, events and frames first, and its video on disk.

    Only of what is done: what became a gap may have pictures of other settings on disk.
    """
    kept = {
        method: read_arrays(result_file(settings, name, method).with_suffix(".npz"))
        for name, method in done
        if name == plan.name
    }
    names = [f"{kind}_frames" for kind in ("stills", "clip")]
    events = events_before(
        plan, settings, {number for f in kept.values() for n in names for number in f[n].tolist()}
    )
    truths: dict[int, np.ndarray] = {}

    def truth(number: int) -> np.ndarray:
        if number not in truths:
            frame = plan.frames.read(number).astype(np.float32) / 255
            truths[number] = to_8_bit(equalise(frame, settings.equalise))
        return truths[number]

    def side_by_side(kind: str) -> Iterator[tuple[int, list[np.ndarray]]]:
        """Frames that every method has: (number, [events, frame, method, method ...])."""
        sets = [set(found[f"{kind}_frames"].tolist()) for found in kept.values()]
        for number in sorted(set.intersection(*sets)) if sets else []:
            places = [found[f"{kind}_frames"].tolist().index(number) for found in kept.values()]
            images = [f[kind][p] for f, p in zip(kept.values(), places, strict=True)]
            yield number, [events[number], truth(number), *images]

    times = plan.frames.times
    stills = [
        (f"{(int(times[number]) - plan.origin) / 1e6:.3f} s", images)
        for number, images in side_by_side("stills")
    ]
    clip = list(side_by_side("clip"))
    video = None
    if len(clip) > 1:
        path = settings.output / "videos" / f"{plan.name}.mp4"
        path.parent.mkdir(exist_ok=True)
        step = np.median(np.diff([int(times[number]) for number, _ in clip])) / 1e6
        coarser = -(-len(clip[0][1]) * plan.recording.width // MAX_VIDEO_WIDTH)
        rows = (
            np.concatenate([report.in_colours(image) for image in images], 1)[::coarser, ::coarser]
            for _, images in clip
        )
        write_video(path, rows, float(np.clip(1 / max(step, 1e-3), 1, 60)))
        video = path.read_bytes()
    return report.Shown(["events", "frame", *kept], stills, video)


def events_before(plan: Plan, settings: Evaluate, numbers: set[int]) -> dict[int, np.ndarray]:
    """(H, W, 3) uint8 for each of these frames: the events of the window or look that ends there.

    Drawn anew from the recording, and not kept with each method: it is as long as one of them."""
    recording, found, left = plan.recording, {}, set(numbers)
    windows = ((e.time, e.events) for e in steps_of(plan) if e.time is not None)
    for place, events in matched(windows, plan.times, round(1000 * settings.tolerance)):
        if not left:
            break
        if (number := int(plan.numbers[place])) in left:
            found[number] = report.event_picture(events, recording.height, recording.width)
            left.remove(number)
    return found
