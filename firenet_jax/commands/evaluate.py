"""Methods x sequences -> table, JSON, CSV and a report: how close images come to camera frames.

Which frames count, and how they are compared, is evaluation/protocol.py's; options change it.

    OUTPUT/results/SEQUENCE/METHOD.json     written when one method has finished one sequence
    OUTPUT/results/SEQUENCE/METHOD.npz      some of its pictures
    OUTPUT/table.csv, results.json, index.html, videos/SEQUENCE.mp4       made from all of those

Results appear under their names when they are complete, so an interrupted run resumes with the
others. A metric that cannot be computed is null, with a reason, never NaN.
"""

import functools
import hashlib
import importlib
import importlib.metadata
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import tyro

from firenet_jax.checkpoint import digest
from firenet_jax.commands import options
from firenet_jax.commands.times import Times, read_times, times_of
from firenet_jax.errors import OutputError, RecordingError, SettingsError, logger
from firenet_jax.evaluation import lpips, report
from firenet_jax.evaluation.comparison import Gap, Plan, matched
from firenet_jax.evaluation.equalise import Kind, equalise
from firenet_jax.evaluation.methods import METHODS, Method, Missing, load
from firenet_jax.evaluation.protocol import Protocol, evaluate, plan, steps_of, until
from firenet_jax.evaluation.results import METRICS, Measured, mean, summary
from firenet_jax.events import Recording
from firenet_jax.pictures import to_8_bit
from firenet_jax.readers import aedat, is_recording, open_recording
from firenet_jax.settings import check_none_idle, parse_size
from firenet_jax.storage.files import identity, named, read_arrays, write_arrays, write_text
from firenet_jax.storage.progress import bar
from firenet_jax.storage.runs import alone_in, check_same, differences, make_folder, read_record
from firenet_jax.storage.video import write_video
from firenet_jax.windows import Windows

# Formats that can hold frames.
SUFFIXES = (".h5", ".hdf5", ".hdf", ".zip", ".bag", ".mcap", ".db3", *aedat.SUFFIXES)
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
    """Weights of FireNet or FireNet+; each file or run's folder is a method named after it.
    Default: the built-in weights."""
    e2vid_weights: Path | None = None
    """E2VID's published checkpoint, or E2VID+'s."""
    e2vid_sigmoid: bool = True
    """--no-e2vid-sigmoid is for E2VID+, which does not end in a sigmoid as E2VID does."""
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
        if "e2vid" not in self.method_names:
            names = "e2vid_weights", "e2vid_random", "e2vid_sigmoid"
            check_none_idle(self, names, "an evaluation without e2vid")
        elif self.e2vid_random:
            names = "e2vid_weights", "e2vid_sigmoid"
            check_none_idle(self, names, "an evaluation with random weights of e2vid")
        parse_size(self.sensor_size)
        _ = self.protocol  # refuses what cannot be
        if self.keep_ratio == 1:
            check_none_idle(self, ["seed"], "an evaluation of all frames")

    @property
    def method_names(self) -> list[str]:
        if self.methods is None:
            e2vid = ["e2vid"] if self.e2vid_weights or self.e2vid_random else []
            return ["firenet", *e2vid, "hf", "mr"]
        return [name.strip() for name in self.methods.split(",") if name.strip()]

    @property
    def protocol(self) -> Protocol:
        """Raises SettingsError for invalid values."""
        wanted = self.times.wanted
        if self.events is not None and self.duration is not None:
            raise SettingsError("windows are cut in one way: choose one of --events and --duration")
        frame_to_frame = self.events is None and self.duration is None and not wanted
        windows = Windows(self.events, None, self.duration, frame_to_frame)
        images_at = self.times.in_words() if wanted else None
        same = "keep_ratio", "seed", "start", "stop", "warm_up", "tolerance", "equalise"
        return Protocol(windows, images_at, **{name: getattr(self, name) for name in same})


def run(settings: Evaluate) -> dict:
    """Does what the settings say; returns what results.json holds. Raises RecordingError,
    CheckpointError, OutputError or SettingsError with a message of one sentence."""
    paths = find_sequences(settings.data)
    methods = load(
        settings.method_names,
        settings.weights,
        settings.e2vid_weights,
        e2vid_random=settings.e2vid_random,
        e2vid_sigmoid=settings.e2vid_sigmoid,
    )
    _check_names([*paths, *(method.name for method in methods)])
    learned = None if settings.lpips is None else lpips.load(*settings.lpips)
    if settings.output.is_file():
        raise OutputError(f"{settings.output} is a file: choose another name for the folder")
    sequences = {name: opened(path, settings) for name, path in paths.items()}
    recordings = {name: one for name, one in sequences.items() if isinstance(one, Recording)}
    shared = describe(settings, learned)
    records = {
        (name, method.name): shared | {"recording": identity(recording.path), **method.record}
        for name, recording in recordings.items()
        for method in methods
        if isinstance(method, Method)
    }
    with alone_in(settings.output):
        done = open_folder(settings, shared, records)

        plans: dict[str, Plan] = {}
        gaps = {
            (name, method.name): one.reason
            for name, sequence in sequences.items()
            for method in methods
            for one in (method, sequence)  # of both, the file's
            if isinstance(one, (Unopened, Missing))
        }
        for name, recording in recordings.items():
            try:
                found = plan(name, recording, settings.protocol)
                wanted = times_of(settings.times, recording, recording.events())
                plans[name] = found._replace(wanted=wanted)
            except (Gap, RecordingError) as error:
                said = str(error).removeprefix(f"{recording.path}: ")
                logger.warning("%s: %s", recording.path, said)
                gaps = {(name, method.name): str(error) for method in methods} | gaps
        compute(settings, records, plans, methods, learned, done, gaps)
        if not any(key in done for key in records):
            reason = next(iter(gaps.items()), (("", ""), "no method can run"))
            raise RecordingError(f"nothing can be evaluated: {' / '.join(reason[0])}: {reason[1]}")

        results = summarise(settings, shared, plans, sequences, methods, done, gaps)
        write_all(settings, results, plans, [key for key in records if key in done])
        return results


def _check_names(names: list[str]) -> None:
    """Refuses those of which no result could be written, before any is computed."""
    for name in names:
        if name.endswith(".partial"):
            raise SettingsError(
                f"{name}: .partial names what is not finished: rename that recording or file of "
                "weights"
            )


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
                    plans[name], by_name[method], settings.protocol, learned, progress
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
    for two of one name, and for one that is named twice."""
    found: dict[str, Path] = {}
    places: dict[Path, Path] = {}
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
            if (first := places.setdefault(recording.resolve(), recording)) is not recording:
                raise RecordingError(
                    f"{first} and {recording} are the same recording: name it once"
                )
            if name in found:
                raise RecordingError(
                    f"{found[name]} and {recording} are both named {name}: rename one of them"
                )
            found[name] = recording
    return found


def recordings_in(folder: Path, above: frozenset[Path] = frozenset()) -> list[Path]:
    """above: the folders that lead here, as links may lead back to one."""
    found, above = [], above | {folder.resolve()}
    for path in sorted(folder.iterdir()):
        if path.is_dir() and path.resolve() in above:
            continue
        if path.is_dir():
            found += [path] if is_recording(path) else recordings_in(path, above)
        elif path.suffix.lower() in SUFFIXES and ".partial" not in path.name:
            found.append(path)
    return found


class Unopened(NamedTuple):
    """What lies in a folder of recordings, but cannot be opened."""

    path: Path
    reason: str


def opened(path: Path, settings: Evaluate) -> Recording | Unopened:
    """Raises RecordingError for what cannot be opened, but was named itself."""
    try:
        return open_recording(path, parse_size(settings.sensor_size), True)
    except RecordingError as error:
        if path in settings.data:
            raise
        logger.warning("%s", error)
        return Unopened(path, str(error))


# ---- Results on disk


def describe(settings: Evaluate, learned: lpips.Lpips | None) -> dict:
    """All that numbers depend on but recording and method, ready for JSON."""
    names = ("events", "duration", "keep_ratio", "seed", "start", "stop", "warm_up", "tolerance",
             "equalise", "sensor_size")  # fmt: skip
    record = {name: getattr(settings, name) for name in names}
    if size := parse_size(settings.sensor_size):  # as it may be written in several ways
        record["sensor_size"] = f"{size[1]}x{size[0]}"
    record["lpips"] = None if learned is None else digest(learned)
    if settings.times.wanted:
        record["images_at"] = asked(settings.times)
    return record | {"version": importlib.metadata.version("firenet-jax")}


def asked(times: Times) -> dict:
    """What is not at its default; of a file of times what it holds, not its name."""
    found = {name: value for name, value in vars(times).items() if value != getattr(Times, name)}
    if times.at is not None:
        found["at"] = hashlib.sha256(repr(read_times(times.at)).encode()).hexdigest()[:16]
    return found


def result_file(settings: Evaluate, sequence: str, method: str) -> Path:
    return settings.output / "results" / sequence / f"{method}.json"


def open_folder(
    settings: Evaluate, shared: dict, records: dict[tuple[str, str], dict]
) -> dict[tuple[str, str], Measured]:
    """Makes the output folder; returns the results of an earlier run that belong to this one.

    shared: what all records have (`describe`). Raises OutputError where the report or a result was
    made by other settings, which `overwrite` replaces.
    """
    folder = settings.output
    report = read_record(folder / "results.json", "choose another output")
    mine = report is None or {"protocol", "sequences"} <= report.keys()
    if report is None:  # it is written before all others, but for the results of each
        mine = all(path.name.startswith("results") for path in folder.iterdir())
        mine = mine and all(path.is_dir() for path in folder.glob("results/*"))
    if any(folder.iterdir()) and not ((folder / "results").is_dir() and mine):
        raise OutputError(f"{folder} is a folder of something else: choose another output")
    other = "choose another output, or pass --overwrite to compute it again"
    if report is not None and not settings.overwrite:
        was = report.get("settings", {})
        check_same(was, shared, f"{folder} holds a report with other settings", other, ["version"])
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
            summary(result)
        except (KeyError, TypeError, ValueError, AttributeError, ZeroDivisionError) as error:
            raise OutputError(f"{path} is damaged ({error}): remove it") from error
        if not settings.overwrite:
            check_same(was, record, f"{path} was made with other settings", other)
        if not differences(was, record):
            done[key] = result
        else:  # what takes its place may be a gap
            path.unlink()
            path.with_suffix(".npz").unlink()
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


def summarise(settings, shared, plans, found, methods, done, gaps) -> dict:
    """What results.json holds: settings, numbers of each sequence and method, means."""
    sequences = {}
    for name, sequence in found.items():
        recording = sequence if isinstance(sequence, Recording) else None
        entries = {}
        for method in methods:
            key = name, method.name
            entries[method.name] = summary(done[key]) if key in done else {"gap": gaps[key]}
        start, stop = settings.protocol.interval(sequence.path)
        sequences[name] = {
            "path": str(sequence.path),
            "format": recording and recording.format,
            "sensor": recording and [recording.width, recording.height],
            "counted_seconds": [start, None if math.isinf(stop) else stop],
            "images": None if name not in plans else settings.protocol.images_in_words(plans[name]),
            "methods": entries,
        }
    names = [method.name for method in methods]
    return {
        "settings": shared,
        "protocol": settings.protocol.in_words(),
        "metrics": {name: metric._asdict() for name, metric in METRICS.items()},
        "methods": {m.name: getattr(m, "record", None) for m in methods},
        "sequences": sequences,
        "means": {
            "over sequences": {name: mean(sequences, name, weigh=False) for name in names},
            "over frames": {name: mean(sequences, name, weigh=True) for name in names},
        },
    }


def write_all(settings: Evaluate, results: dict, plans: dict[str, Plan], done: list) -> None:
    """Prints the table; writes results.json, table.csv, the videos and index.html."""
    folder = settings.output
    results["command"] = options.command_line("evaluate", settings)
    write_text(folder / "results.json", json.dumps(results, indent=1, allow_nan=False))
    write_text(folder / "table.csv", report.spreadsheet(results))
    for name in results["sequences"]:  # a video may be of other settings
        (folder / "videos" / f"{name}.mp4").unlink(missing_ok=True)
    shown = {name: show(settings, plan, done) for name, plan in plans.items()}
    write_text(folder / "index.html", report.page(results, shown))
    print(report.table(results))
    print(f"\n{folder / 'index.html'}: the report; table.csv and results.json beside it")


def show(settings: Evaluate, plan: Plan, done: list) -> report.Shown:
    """The pictures of a sequence side by side, events and frames first, and its video on disk.

    Only of what is done: what became a gap may have pictures of other settings on disk.
    """
    names = [f"{kind}_frames" for kind in ("stills", "clip")]
    kept = {}
    for name, method in done:
        if name == plan.name:
            path = result_file(settings, name, method).with_suffix(".npz")
            kept[method] = read_arrays(path)
            if not {"stills", "clip", *names} <= kept[method].keys():
                raise OutputError(f"{path} is damaged (no pictures): remove it and run again")
    events = events_before(
        plan, settings, {number for f in kept.values() for n in names for number in f[n].tolist()}
    )

    @functools.cache
    def truth(number: int) -> np.ndarray:
        frame = plan.frames.read(number).astype(np.float32) / 255
        return np.asarray(to_8_bit(equalise(frame, settings.equalise)))

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
    if not left:  # where no method had an image, reading may raise why
        return found
    latest = int(plan.times[plan.last - 1]) + settings.protocol.tolerated
    windows = ((e.time, e.events) for e in until(latest, steps_of(plan)) if e.time is not None)
    tolerated = settings.protocol.tolerated
    for place, events in matched(windows, plan.times, tolerated, plan.up_to_frames):
        if not left:
            break
        if (number := int(plan.numbers[place])) in left:
            found[number] = report.event_picture(events, recording.height, recording.width)
            left.remove(number)
    return found
