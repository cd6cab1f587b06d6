"""Methods beside frames: numbers against a direct computation, gaps, resuming, the report."""

import csv
import dataclasses
import datetime
import html
import importlib
import json
import re
import shlex
import sys
import zipfile
from functools import partial
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import h5py
import jax
import numpy as np
import pytest
from PIL import Image
from skimage.metrics import structural_similarity

import firenet_jax
from firenet_jax import cli
from firenet_jax.checkpoint import digest, load_weights, save_weights
from firenet_jax.commands import evaluate, options
from firenet_jax.commands.evaluate import Evaluate, run
from firenet_jax.commands.times import Times
from firenet_jax.errors import RecordingError, SettingsError
from firenet_jax.evaluation import comparison, methods, metrics, protocol
from firenet_jax.evaluation.baselines import e2vid
from firenet_jax.evaluation.baselines.high_pass import HighPass
from firenet_jax.evaluation.comparison import COMPARED, Gap, matched
from firenet_jax.evaluation.methods import Missing, filtered, load, recurrent_unet
from firenet_jax.evaluation.protocol import CUTS, displacement, plan
from firenet_jax.evaluation.report import METRICS, _best, about, notes
from firenet_jax.evaluation.report import steps as ticks_of
from firenet_jax.events import Events, concatenate
from firenet_jax.instants import steps
from firenet_jax.network import Weights, initial_params
from firenet_jax.readers import open_recording
from firenet_jax.reconstruction import images_at
from firenet_jax.storage.files import OutputError
from firenet_jax.storage.pytorch_file import CheckpointError
from firenet_jax.storage.sequence_file import Picture, write_sequence
from firenet_jax.tensors import normalise, pack, voxelise
from firenet_jax.windows import Window, Windows

HEIGHT, WIDTH = 20, 28
PERIOD = 40_000  # microseconds
NAMES = ("ours", "e2vid-random", "hf", "mr")


def moving_pattern(number):
    """(H, W) uint8, moving by a pixel a frame to the right."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return np.rint(127 + 90 * np.sin((x - number) / 3) * np.cos(y / 4)).astype(np.uint8)


def events_of(count, last, seed=0):
    rng = np.random.default_rng(seed)
    columns = rng.integers(0, WIDTH, count), rng.integers(0, HEIGHT, count), rng.random(count) < 0.5
    return Events.of(np.sort(rng.integers(0, last, count)), *columns)


def write(path, frames=6, events=None, flow=True, period=PERIOD, begin=0):
    """A sequence with pictures at begin, begin + period ..., 100 events a millisecond; its path."""
    size = {"height": HEIGHT, "width": WIDTH}
    velocity = np.stack([np.full((HEIGHT, WIDTH), v, np.float32) for v in (1e6 / period, 0)])
    pictures = [
        Picture(begin + n * period, moving_pattern(n), velocity if flow else None)
        for n in range(frames)
    ]
    if events is None:
        events = events_of(100 * frames * period // 1000, frames * period)
    path.parent.mkdir(exist_ok=True, parents=True)
    write_sequence(path, [events], pictures, **size)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two sequences of 5 and 8 windows, and weights of a FireNet."""
    here = tmp_path_factory.mktemp("evaluate")
    write(here / "data" / "a.h5", 6)
    write(here / "data" / "b.h5", 9, flow=False)
    save_weights(here / "ours.npz", Weights(initial_params(jax.random.key(0)), True))
    return here


def settings(folder, output, **changes):
    standard = {"data": (folder / "data",)}
    if "e2vid" in changes.get("methods", "e2vid"):
        standard["e2vid_random"] = True
    if "firenet" in changes.get("methods", "firenet"):
        standard["weights"] = (folder / "ours.npz",)
    return Evaluate(output=output, **(standard | changes))


@pytest.fixture(scope="module", params=[pytest.param("all methods", marks=pytest.mark.slow)])
def evaluated(folder):
    """(output folder, results) of all methods on both sequences."""
    return folder / "out", run(settings(folder, folder / "out"))


def direct(folder, name, sequence):
    """[(number, image, frame)] of one method, windows cut by a mask."""
    recording = open_recording(folder / "data" / f"{sequence}.h5")
    found = load(["firenet", "e2vid", "hf", "mr"], [folder / "ours.npz"], e2vid_random=True)
    method = next(method for method in found if method.name == name)
    events = concatenate([*recording.events()])
    state, images = method.initial(HEIGHT, WIDTH), []
    times = recording.frames.times
    for number in range(1, len(times)):
        inside = (events.t >= times[number - 1]) & (events.t < times[number])
        window = events.select(inside)
        state, image = method.step(state, Window(window, int(window.t[-1])))
        assert image.shape == (HEIGHT, WIDTH) and image.dtype == np.float32
        frame = recording.frames.read(number).astype(np.float32) / 255
        images.append((number, np.clip(np.asarray(image), 0, 1), frame))
    return images


@pytest.mark.parametrize("name", NAMES)
def test_numbers_are_those_of_a_direct_computation(folder, evaluated, name):
    entry = evaluated[1]["sequences"]["data-a"]["methods"][name]
    images = direct(folder, name, "a")
    assert entry["frames"] == entry["of"] == 5 and entry["frame_numbers"] == [1, 2, 3, 4, 5]
    assert entry["times"] == pytest.approx([0.04, 0.08, 0.12, 0.16, 0.2])
    mse = [np.mean((image - frame) ** 2) for _, image, frame in images]
    ssim = [
        structural_similarity(image, frame, gaussian_weights=True, sigma=1.5, data_range=1.0,
                              use_sample_covariance=False)
        for _, image, frame in images
    ]  # fmt: skip
    assert entry["values"]["mse"] == pytest.approx(mse, abs=1e-5)
    assert entry["values"]["psnr"] == pytest.approx(-10 * np.log10(mse), abs=1e-3)
    assert entry["values"]["ssim"] == pytest.approx(ssim, abs=1e-4)
    assert entry["means"]["mse"] == pytest.approx(np.mean(mse), abs=1e-5)
    for metric in ("ms_ssim", "haarpsi", "cw_ssim", "nlpd", "gmsd", "random_features"):
        expected = [float(getattr(metrics, metric)(i, f)) for _, i, f in images]
        assert entry["values"][metric] == pytest.approx(expected, abs=1e-4)
    one = np.zeros((HEIGHT, WIDTH, 2), np.float32) + np.array([1, 0], np.float32).reshape(1, 1, 2)
    pairs = zip(images[:-1], images[1:], strict=True)
    flicker = [float(metrics.temporal_error(i, j, one, f, g)) for (_, j, g), (_, i, f) in pairs]
    assert entry["values"]["temporal_error"][0] is None  # nothing came before
    assert entry["values"]["temporal_error"][1:] == pytest.approx(flicker, abs=1e-5)


def test_means_over_sequences_and_over_frames(evaluated):
    results = evaluated[1]
    for name in NAMES:
        a, b = (results["sequences"][s]["methods"][name] for s in ("data-a", "data-b"))
        over = {kind: means[name] for kind, means in results["means"].items()}
        assert over["over frames"]["frames"] == 13
        pair = a["means"]["ssim"], b["means"]["ssim"]
        assert over["over sequences"]["means"]["ssim"] == pytest.approx(np.mean(pair))
        weighed = np.average(pair, weights=[5, 8])
        assert over["over frames"]["means"]["ssim"] == pytest.approx(weighed)
        # one sequence has no flow: its gap has a name, the mean is that of the other
        assert b["means"]["temporal_error"] is None and b["gaps"]["temporal_error"] == "no flow"
        mean = over["over sequences"]["means"]["temporal_error"]
        assert mean == pytest.approx(a["means"]["temporal_error"])
        fewer = over["over sequences"]["gaps"]["temporal_error"]
        assert fewer == "no flow in 1 of 2 sequences"
        assert sum(name in line and fewer in line for line in notes(results)) == 1


def no_constant(name):
    raise AssertionError(f"{name} in JSON")


def test_json_and_csv_say_the_same(evaluated):
    output, results = evaluated
    text = (output / "results.json").read_text()
    assert json.loads(text, parse_constant=no_constant) == json.loads(json.dumps(results))
    with open(output / "table.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4 * (2 + 2)
    means = results["sequences"]["data-b"]["methods"]["hf"]["means"]
    row = next(row for row in rows if (row["sequence"], row["method"]) == ("data-b", "hf"))
    assert float(row["ssim"]) == means["ssim"] and row["temporal_error"] == ""
    assert "temporal_error: no flow" in row["gaps"] and "lpips: no weights" in row["gaps"]


class Page(HTMLParser):
    VOID = ("meta", "img")

    def __init__(self):
        super().__init__()
        self.open, self.seen, self.links = [], [], []

    def handle_starttag(self, tag, attributes):
        self.seen.append(tag)
        self.links += [v for k, v in attributes if k in ("src", "href", "data", "action", "poster")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):  # <line/> opens and closes
        assert self.open.pop() == tag


def test_the_page_is_well_formed_and_needs_nothing_else(evaluated):
    text = (evaluated[0] / "index.html").read_text()
    page = Page()
    page.feed(text)
    page.close()
    assert page.open == []
    assert all(link.startswith(("data:", "#")) for link in page.links)
    assert "script" not in page.seen and "link" not in page.seen and "url(" not in text
    assert page.seen.count("video") == 2 and page.seen.count("svg") == 4 + 3
    assert page.seen.count("img") == 2 * 3 * 6  # sequences, times, events, a frame, four methods
    command = re.search("<code>(.*?)</code>", text)[1]
    assert command == evaluated[1]["command"] and command.startswith("firenet evaluate ")
    assert "histogram equalisation before metrics: none" in text and "data range 1" in text


def test_the_page_says_when_by_what_and_what_each_method_is(evaluated):
    text = html.unescape((evaluated[0] / "index.html").read_text())
    for said in (
        f"{datetime.date.today().isoformat()}, firenet_jax {firenet_jax.__version__}; settings: ",
        "equalise none",
        "ours: FireNet (Scheerlinck et al. 2020), with the weights of this name",
        "e2vid-random: E2VID with random weights: its images mean nothing",
        "hf: high-pass filter (Scheerlinck et al. 2018), not learned",
        "mr: manifold regularisation (Reinbacher et al. 2016), not learned",
    ):
        assert said in text
    assert text.count("<table>") == 2 + 2  # means over sequences, over frames, each sequence


def test_a_single_recording_has_a_single_table(folder, tmp_path, capsys):
    run(settings(folder, tmp_path / "out", data=(folder / "data" / "a.h5",), methods="hf"))
    text = (tmp_path / "out" / "index.html").read_text()
    assert text.count("<table>") == 1
    assert "mean over" not in capsys.readouterr().out


def test_methods_without_weights_only_where_asked_for(folder, tmp_path):
    assert Evaluate((folder,), tmp_path).method_names == ["firenet", "hf", "mr"]
    random = Evaluate((folder,), tmp_path, e2vid_random=True)
    assert random.method_names == ["firenet", "e2vid", "hf", "mr"]


def test_the_pages_events_are_those_before_its_frames(folder, evaluated):
    chosen = settings(folder, evaluated[0])
    recording = open_recording(folder / "data" / "a.h5")
    shown = evaluate.show(
        chosen, plan("data-a", recording, chosen.protocol), [("data-a", name) for name in NAMES]
    )
    assert shown.titles == ["events", "frame", *NAMES] and len(shown.stills) == 3
    events = concatenate([*recording.events()])
    for time, images in shown.stills:
        end = round(1e6 * float(time.removesuffix(" s")))
        votes = np.zeros((HEIGHT, WIDTH), int)
        for t, x, y, p in zip(events.t, events.x, events.y, events.p, strict=True):
            if end - PERIOD <= t < end:
                votes[y, x] += 1 if p else -1
        colours = {1: (0, 0, 255), 0: (255, 255, 255), -1: (255, 0, 0)}
        expected = [[colours[int(np.sign(vote))] for vote in row] for row in votes]
        np.testing.assert_array_equal(images[0], expected)


def test_the_command_line_gives_the_settings_again():
    for chosen in (
        Evaluate((Path("a b"), Path("c")), Path("out")),
        Evaluate((Path("a"),), Path("out"), "e2vid,mr", (Path("x"), Path("y")), duration=20.5,
                 e2vid_sigmoid=False, equalise="local", overwrite=True),
    ):  # fmt: skip
        words = shlex.split(options.command_line("evaluate", chosen))
        assert words[:2] == ["firenet", "evaluate"]
        assert options.parse(Evaluate, words[2:], "", "") == chosen


def test_the_command_prints_the_table_and_goes_on(folder, evaluated, capsys):
    line = f"evaluate {folder / 'data'} -o {evaluated[0]} -c {folder / 'ours.npz'} --e2vid-random"
    before = result_times(evaluated[0])
    assert cli.main(line.split()) == 0
    out = capsys.readouterr().out
    for word in ("data-a", "mean over sequences", "mean over frames", "e2vid-random", "no flow",
                 "data range 1", "equalisation before metrics: none", "index.html"):  # fmt: skip
        assert word in out
    assert result_times(evaluated[0]) == before  # nothing was computed again


def result_times(output):
    return {path: path.stat().st_mtime_ns for path in output.glob("results/*/*")}


def test_an_interrupted_evaluation_goes_on(folder, tmp_path, monkeypatch):
    ours = settings(folder, tmp_path / "out", methods="hf,mr")
    whole = run(settings(folder, tmp_path / "whole", methods="hf,mr"))
    original, calls = evaluate.evaluate, []

    def killed(plan, method, *rest):
        calls.append((plan.name, method.name))
        if len(calls) == 3:
            raise KeyboardInterrupt
        return original(plan, method, *rest)

    monkeypatch.setattr(evaluate, "evaluate", killed)
    with pytest.raises(KeyboardInterrupt):
        run(ours)
    assert not (tmp_path / "out" / "index.html").exists()
    again = run(ours)
    assert calls[3:] == calls[2:3] + [("data-b", "mr")]
    for kind in again["means"]:
        for name in ("hf", "mr"):
            assert again["means"][kind][name]["means"] == whole["means"][kind][name]["means"]


def test_flow_of_frames_that_are_not_in_a_row_is_no_flow_that_is_missing(folder, tmp_path):
    ours = settings(
        folder, tmp_path / "out", data=(folder / "data" / "a.h5",), methods="hf", keep_ratio=0.4
    )
    for ratio in (0.4, 0.2):  # of one frame, there is no flow to be seen
        chosen = dataclasses.replace(ours, output=tmp_path / f"{ratio}", keep_ratio=ratio)
        (sequence,) = run(chosen)["sequences"].values()
        assert sequence["methods"]["hf"]["gaps"]["temporal_error"] == "no two frames in a row"


def test_numbers_of_an_earlier_run_that_are_not_whole_are_named(folder, tmp_path):
    ours = settings(folder, tmp_path / "out", data=(folder / "data" / "a.h5",), methods="hf")
    run(ours)
    path = tmp_path / "out" / "results" / "a" / "hf.json"
    whole = path.read_text()
    for part in ("values", "gaps"):
        saved = json.loads(whole)
        saved["result"] |= {"values": {}, "gaps": {}} if part == "gaps" else {part: None}
        path.write_text(json.dumps(saved))
        with pytest.raises(OutputError, match="hf.json is damaged .*: remove it"):
            run(ours)
    path.write_text(whole)
    np.savez(path.with_suffix(".npz"), a=1)
    with pytest.raises(OutputError, match="hf.npz is damaged .*: remove it"):
        run(ours)


def test_a_report_of_other_settings_is_not_replaced(folder, tmp_path):
    ours = partial(settings, folder, tmp_path / "out", data=(folder / "data" / "a.h5",))
    run(ours(methods="mr", keep_ratio=0.5))
    page = (tmp_path / "out" / "index.html").read_bytes()
    with pytest.raises(OutputError, match=r"holds a report with other settings \(keep_ratio was"):
        run(ours(methods="hf"))
    assert (tmp_path / "out" / "index.html").read_bytes() == page
    run(ours(methods="hf", overwrite=True))
    assert (tmp_path / "out" / "index.html").read_bytes() != page


def test_damaged_pictures_of_an_earlier_run_are_named(folder, tmp_path):
    ours = settings(folder, tmp_path / "out", data=(folder / "data" / "a.h5",), methods="hf")
    run(ours)
    path = tmp_path / "out" / "results" / "a" / "hf.npz"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(OutputError, match="hf.npz is damaged .*: remove it"):
        run(ours)
    path.unlink()
    run(ours)
    assert path.is_file()  # computed again


def test_options_of_e2vid_without_it_are_refused(folder, tmp_path):
    for name in ("e2vid_random", "e2vid_sigmoid"):
        choice = {name: not getattr(Evaluate, name), "methods": "hf"}
        with pytest.raises(
            SettingsError, match=f"{name.replace('_', '-')}: no effect with an eval"
        ):
            settings(folder, tmp_path / "out", **choice)


def test_options_that_would_do_nothing_are_refused(folder, tmp_path):
    ours = partial(settings, folder, tmp_path / "out", methods="firenet,e2vid")
    with pytest.raises(SettingsError, match="seed: no effect with an evaluation of all frames"):
        ours(seed=5)
    ours(seed=5, keep_ratio=0.5)
    for choice in ({"e2vid_sigmoid": False}, {"e2vid_weights": tmp_path / "e2vid.pth"}):
        with pytest.raises(SettingsError, match="no effect with an evaluation with random weights"):
            ours(e2vid_random=True, **choice)


def test_damage_after_the_last_frame_does_not_keep_the_report_from_being_written(tmp_path):
    """Nothing that is measured or shown lies there."""
    folder = tmp_path / "data" / "cut"
    (folder / "images").mkdir(parents=True)
    rows, lines = events_of(4000, 8 * PERIOD), []
    rows = zip(rows.t, rows.x, rows.y, rows.p, strict=True)
    text = "".join(f"{t / 1e6:.6f} {x} {y} {int(p)}\n" for t, x, y, p in rows)
    (folder / "events.txt").write_text(text + f"{8 * PERIOD / 1e6} 3")
    for n in range(6):
        Image.fromarray(moving_pattern(n)).save(folder / "images" / f"{n}.png")
        lines.append(f"{n * PERIOD / 1e6:.6f} images/{n}.png\n")
    (folder / "images.txt").write_text("".join(lines))
    run(Evaluate(output=tmp_path / "out", data=(tmp_path / "data",), methods="hf"))
    assert "cut" in (tmp_path / "out" / "index.html").read_text()


def test_other_settings_are_refused_by_name_and_replaced_when_told(folder, tmp_path):
    data = (folder / "data" / "a.h5",)
    run(settings(folder, tmp_path / "out", data=data, methods="hf"))
    other = {"data": data, "methods": "hf", "equalise": "global"}
    with pytest.raises(OutputError, match="equalise was none, now global"):
        run(settings(folder, tmp_path / "out", **other))
    found = run(settings(folder, tmp_path / "out", overwrite=True, **other))
    assert "metrics: global" in " ".join(found["protocol"])
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").write_text("mine")
    with pytest.raises(OutputError, match="something else"):
        run(settings(folder, tmp_path / "mine", **other))
    (tmp_path / "mine" / "results").mkdir()
    for name, text in (
        ("index.html", "mine"), ("results.json", '{"mine": 1}'), ("main.py", "mine"),
        ("results/notes.txt", "mine"),
    ):  # fmt: skip
        (tmp_path / "mine" / name).write_text(text)
        with pytest.raises(OutputError, match="something else"):
            run(settings(folder, tmp_path / "mine", **other))
        assert (tmp_path / "mine" / name).read_text() == text
        (tmp_path / "mine" / name).unlink()


def test_pictures_of_other_settings_are_not_shown_beside_a_gap(folder, tmp_path, monkeypatch):
    shared = {"data": (folder / "data" / "a.h5",), "methods": "hf,mr"}
    run(settings(folder, tmp_path / "out", **shared))
    real, shown = evaluate.evaluate, []

    def without_mr(plan, method, *rest):
        if method.name == "mr":
            raise Gap("no time")
        return real(plan, method, *rest)

    def page(results, sequences):
        shown.extend(sequences.values())
        return ""

    monkeypatch.setattr(evaluate, "evaluate", without_mr)
    monkeypatch.setattr(evaluate.report, "page", page)
    run(settings(folder, tmp_path / "out", overwrite=True, equalise="global", **shared))
    assert [sequence.titles for sequence in shown] == [["events", "frame", "hf"]]


# ---- Images at given times


def at_times(folder, output, times, **changes):
    choices = {"data": (folder / "data" / "a.h5",), "times": times, "methods": "firenet"}
    return run(settings(folder, output, **(choices | changes)))


def test_images_at_frame_times_are_those_of_images_at(folder, tmp_path):
    recording = open_recording(folder / "data" / "a.h5")
    times = recording.frames.times
    for name, choice in (("usual", {}), ("events", {"events": 500}), ("ms", {"duration": 7.0})):
        results = at_times(folder, tmp_path / name, Times(between_frames=True), **choice)
        entry = results["sequences"]["a"]["methods"]["ours"]
        # One step at a time, as here: where votes cancel, a sum in another order is not zero.
        weights = load_weights(folder / "ours.npz")
        found = list(images_at(weights, recording, times, chunk=1, warm_up=0, **choice))
        taken, images = (np.concatenate(column) for column in zip(*found, strict=True))
        numbers = np.searchsorted(times, taken)
        counting = numbers > 0  # as of windows between frames, which the first has none of
        assert entry["frame_numbers"] == numbers[counting].tolist() == [1, 2, 3, 4, 5]
        mse = [
            np.mean((np.clip(image, 0, 1) - recording.frames.read(n) / 255) ** 2)
            for n, image in zip(numbers[counting], images[counting], strict=True)
        ]
        assert entry["values"]["mse"] == pytest.approx(mse, abs=1e-6)


def test_what_was_done_is_said_and_kept_apart(folder, tmp_path, capsys):
    between = at_times(folder, tmp_path / "out", Times())
    with pytest.raises(OutputError, match="images_at was None, now {'between_frames': True}"):
        at_times(folder, tmp_path / "out", Times(between_frames=True))
    looks = at_times(folder, tmp_path / "out", Times(between_frames=True), overwrite=True)
    out, page = capsys.readouterr().out, (tmp_path / "out" / "index.html").read_text()
    said = "images at the times of its frames"
    assert said in out and said in page and said in looks["protocol"][0]
    assert "--between-frames" in looks["command"]
    assert looks["sequences"]["a"]["images"].startswith(f"{said}, the state by windows of 0.35 ")
    assert between["sequences"]["a"]["images"] == "windows between frames"
    assert between["means"]["over frames"] != looks["means"]["over frames"]


@pytest.mark.slow
def test_every_method_has_images_at_a_rate(folder, tmp_path):
    """12.5 of them a second meet every second frame; a file of the same times gives the same."""
    methods = {"methods": "firenet,e2vid,hf,mr", "stop": 0.16}
    frames = Times(rate=12.5), Times(at=tmp_path / "times.txt", since="start")
    (tmp_path / "times.txt").write_text("0 s\n0.08 s\n0.16 s\n")
    by_rate, by_file = (
        at_times(folder, tmp_path / f"{k}", times, **methods)["sequences"]["a"]["methods"]
        for k, times in enumerate(frames)
    )
    for name in NAMES:
        assert by_rate[name]["frame_numbers"] == [2, 4] and by_rate[name]["of"] == 4
        assert by_rate[name]["values"] == by_file[name]["values"]


def test_a_filter_of_single_events_looks_at_those_since_its_last_window(folder):
    """So its images are of all events up to the time, whatever the windows that it took in."""
    hf = filtered("hf", HighPass(adaptive_range=False))
    recording = open_recording(folder / "data" / "a.h5")
    events = concatenate([*recording.events()])
    wanted = np.array([30_000, 31_000, 90_000])
    for count in (300, 4000):
        before = last = hf.initial(HEIGHT, WIDTH)
        images = []
        for step in steps(recording, Windows(events=count), wanted):
            if step.time is None:
                window = Window(step.events, int(step.events.t[-1]))
                before, last = last, hf.step(last, window)[0]
            else:
                images.append(methods.look(hf, before, last, step))
        for time, image in zip(wanted.tolist(), images, strict=True):
            seen = events.select(events.t <= time)
            expected = hf.step(hf.initial(HEIGHT, WIDTH), Window(seen, time))[1]
            np.testing.assert_allclose(image, expected, atol=1e-4)


def test_times_that_a_recording_does_not_have_are_a_gap(folder, tmp_path):
    with pytest.raises(RecordingError, match="holds no triggers"):
        at_times(folder, tmp_path / "out", Times(triggers=True))
    with pytest.raises(RecordingError, match="cannot read this list of times"):
        at_times(folder, tmp_path / "none", Times(at=tmp_path / "none.txt"))
    assert not (tmp_path / "none").exists()


# ---- What counts


def test_a_prediction_counts_once_and_within_the_tolerance():
    times = np.array([0, 1000, 2000, 3000])
    moments = [0, 900, 1040, 1100, 1500, 2101, 2900, 3100]
    found = list(matched(((t, f"at {t}") for t in moments), times, 100))
    assert found == [(0, "at 0"), (1, "at 1040"), (3, "at 2900")]


def test_a_window_up_to_a_frame_is_compared_with_none_before():
    """Events that end right after a frame, as where a scene stops then, speak of the next one."""
    times = np.array([0, 1000, 2000, 3000])
    moments = [60, 950, 1060, 2000, 2950, 3000]  # 2000: a window without events, 3000: at it alone
    found = list(matched(((t, f"at {t}") for t in moments), times, 100, True))
    assert found == [(1, "at 950"), (2, "at 2000"), (3, "at 2950")]
    moments = [60, 1060, 2060, 3060]
    assert not list(matched(((t, "") for t in moments), times, 100, True))
    assert len(list(matched(((t, "") for t in moments), times, 100))) == 4


def test_intervals_of_the_event_camera_dataset(tmp_path):
    assert CUTS == {
        **dict.fromkeys(("boxes_6dof", "calibration", "dynamic_6dof"), (5, 20)),
        **dict.fromkeys(("poster_6dof", "shapes_6dof"), (5, 20)),
        "office_zigzag": (5, 12),
        "slider_depth": (1, 2.5),
    }
    events = events_of(3000, 3_000_000)
    path = write(tmp_path / "slider_depth.h5", 31, events, period=100_000)
    recording = open_recording(path)
    (tmp_path / "mvsec_depth.zip").touch()
    whole = Evaluate((path,), tmp_path).protocol
    assert whole.interval(tmp_path / "mvsec_depth.zip") == (0, np.inf)

    def counted(**changes):
        found = plan("a", recording, Evaluate((path,), tmp_path / "out", **changes).protocol)
        times = found.times[found.first], found.times[found.last - 1], found.begin
        return tuple(time / 1e6 for time in times)

    assert counted() == pytest.approx((1.0, 2.5, events.t[0] / 1e6))
    assert counted(start=0.0) == pytest.approx((0.1, 3.0, events.t[0] / 1e6))
    # a window before the first frame that counts is always there, else the warm-up's share
    assert counted(warm_up=0.0) == pytest.approx((1.0, 2.5, 0.9))
    assert counted(warm_up=0.35) == pytest.approx((1.0, 2.5, 0.6))
    assert counted(warm_up=0.5) == pytest.approx((1.0, 2.5, 0.5))  # at a frame
    assert counted(start=1.0, stop=1.05, warm_up=0.2)[:2] == pytest.approx((1.0, 1.0))
    with pytest.raises(Gap, match="no frames from 7 to 8 s"):
        counted(start=7.0, stop=8.0)
    with pytest.raises(Gap, match="no frames from 7 s on"):
        counted(start=7.0)


def test_a_warm_up_begins_between_frames_where_none_lies_before_it(folder, tmp_path):
    path = write(tmp_path / "late.h5", 6, events_of(30_000, 3_000_000), begin=2_000_000)
    recording = open_recording(path)

    def begin(**changes):
        protocol = settings(folder, tmp_path / "out", data=(path,), **changes).protocol
        found = plan("late", recording, protocol)
        return found.times[found.first] - found.begin

    first = int(next(iter(recording.events())).t[0])
    assert begin() == 2_000_000 + PERIOD - first
    assert begin(warm_up=1.0) == 1_000_000
    assert begin(warm_up=0.0) == begin(warm_up=1e-6 * PERIOD) == PERIOD


def test_frames_that_end_at_damage_are_a_gap(folder, tmp_path):
    """A mean over those before it would look like that of the recording."""
    recording = open_recording(folder / "data" / "a.h5")
    damage = RecordingError("a.h5: cut off")
    recording = dataclasses.replace(recording, frames=recording.frames._replace(damage=damage))
    protocol = settings(folder, tmp_path / "out").protocol
    with pytest.raises(Gap, match="its frames end where it is damaged: a.h5: cut off"):
        plan("a", recording, protocol)


def test_frames_that_cannot_be_compared_are_a_gap(folder, tmp_path):
    whole = open_recording(folder / "data" / "a.h5")
    protocol = settings(folder, tmp_path / "out").protocol

    def planned(height=HEIGHT, times=whole.frames.times):
        frames = whole.frames._replace(times=times, read=lambda n: moving_pattern(n)[:height])
        return plan("a", dataclasses.replace(whole, height=height, frames=frames), protocol)

    assert planned(17).last == 6
    with pytest.raises(Gap, match="28x16 pixels are too small to be compared"):
        planned(16)
    times = whole.frames.times.copy()
    times[3] = times[2] - 1
    with pytest.raises(Gap, match="times of frames run backwards"):
        planned(times=times)


def test_a_silent_camera_leaves_the_frames_that_count_as_they_are(folder, tmp_path):
    """The windows without events at the ends of what is asked for are windows too."""
    events = events_of(24_000, 6 * PERIOD)
    loud = (events.t < 1.5 * PERIOD) | (events.t >= 4.5 * PERIOD)
    path = write(tmp_path / "quiet.h5", 6, events.select(loud))

    def numbers(**changes):
        choices = {"data": (path,), "methods": "hf", **changes}
        found = run(settings(folder, tmp_path / f"{changes}", **choices))
        return found["sequences"]["quiet"]["methods"]["hf"]["frame_numbers"]

    frames = numbers()
    assert {3, 4} < set(frames)
    period = PERIOD / 1e6
    assert numbers(stop=4.1 * period) == [n for n in frames if n <= 4]
    late = [n for n in frames if n >= 3]
    assert numbers(start=2.9 * period) == numbers(start=2.9 * period, warm_up=0.0) == late


def test_keep_ratio_thins_out_frames_alike_for_every_method(folder, tmp_path):
    data = (folder / "data" / "b.h5",)
    choices = {"data": data, "methods": "hf,mr", "keep_ratio": 0.5}
    results = run(settings(folder, tmp_path / "out", **choices))
    hf, mr = (results["sequences"]["b"]["methods"][name] for name in ("hf", "mr"))
    assert hf["frame_numbers"] == mr["frame_numbers"] and hf["of"] == 3  # windows of 4 frames of 9
    chosen = Evaluate(data, tmp_path, keep_ratio=0.5, seed=1)
    other = plan("b", open_recording(data[0]), chosen.protocol)
    assert other.numbers.tolist() != hf["frame_numbers"]
    with pytest.raises(ValueError, match="between frames only"):
        Evaluate(data, tmp_path, keep_ratio=0.5, duration=10.0)


def test_lpips_where_files_are_named_and_pictures_large_enough(folder, tmp_path, monkeypatch):
    """Its numbers are tested where it is; here that they get to the table."""
    fake = evaluate.lpips.Lpips({}, (np.ones(3, np.float32),))
    monkeypatch.setattr(evaluate.lpips, "load", lambda *files: fake)
    monkeypatch.setattr(evaluate.lpips, "lpips", lambda _, image, truth: metrics.mse(image, truth))
    choices = {"data": (folder / "data" / "a.h5",), "methods": "hf", "lpips": (tmp_path, tmp_path)}
    found = run(settings(folder, tmp_path / "small", **choices))
    entry = found["sequences"]["a"]["methods"]["hf"]
    assert entry["means"]["lpips"] is None and entry["gaps"]["lpips"] == "pictures too small"
    monkeypatch.setattr(evaluate.lpips, "MIN_SIDE", HEIGHT)
    entry = run(settings(folder, tmp_path / "out", **choices))["sequences"]["a"]["methods"]["hf"]
    assert entry["values"]["lpips"] == entry["values"]["mse"] and "lpips" not in entry["gaps"]


@pytest.mark.parametrize("kind", ["local", "clahe"])
def test_images_and_frames_are_equalised_before_metrics(folder, tmp_path, kind):
    choices = {"data": (folder / "data" / "a.h5",), "methods": "hf", "equalise": kind}
    entry = run(settings(folder, tmp_path / "out", **choices))["sequences"]["a"]["methods"]["hf"]
    equalise = evaluate.equalise
    mse = [
        np.mean((equalise(image, kind) - equalise(frame, kind)) ** 2)
        for _, image, frame in direct(folder, "hf", "a")
    ]
    assert entry["values"]["mse"] == pytest.approx(mse, abs=1e-5)
    choices["equalise"] = "none"
    plain = run(settings(folder, tmp_path / "plain", **choices))["sequences"]["a"]["methods"]["hf"]
    equalised, as_they_are = (found["values"]["temporal_error"] for found in (entry, plain))
    assert equalised[1:] == pytest.approx(as_they_are[1:], abs=1e-6)  # flicker, not contrast
    assert equalised[0] is None and min(equalised[1:]) > 0


def test_windows_of_events_and_of_time(folder, tmp_path):
    data = (folder / "data" / "b.h5",)
    # 100 events a ms: 50 events take half a millisecond, so that each frame has a prediction
    for choice, count in [({"events": 50}, 8), ({"duration": 40.0}, 8), ({"duration": 33.0}, 0)]:
        choice = choice | {"data": data, "methods": "hf", "tolerance": 0.6}
        if count:
            found = run(settings(folder, tmp_path / f"{choice}", **choice))
            assert found["sequences"]["b"]["methods"]["hf"]["frames"] == count
        else:
            with pytest.raises(ValueError, match="no prediction within 0.6 ms"):
                run(settings(folder, tmp_path / f"{choice}", **choice))


# ---- What is wrong


def test_gaps_have_names_and_the_rest_is_measured(folder, tmp_path, capsys):
    data = tmp_path / "data"
    whole = events_of(24_000, 6 * PERIOD)
    pause = (whole.t < 2 * PERIOD) | (whole.t >= 4 * PERIOD)
    write(data / "pause.h5", 6, whole.select(pause))
    write(data / "later.h5", 6, whole, begin=10**9)
    write(data / "earlier.h5", 6, Events(whole.t + 10**9, whole.x, whole.y, whole.p))
    write(data / "noframes.h5", 0)
    write(data / "oneframe.h5", 1)
    write(data / "silent.h5", 6, Events.empty())
    write(data / "good.h5", 6)
    results = run(settings(folder, tmp_path / "out", data=(data,), weights=(), methods="hf,e2vid",
                           e2vid_random=False))  # fmt: skip
    found = {k: v["methods"] for k, v in results["sequences"].items()}
    assert all(entry["e2vid"]["gap"] for entry in found.values())
    assert found["data-good"]["e2vid"]["gap"] == "no weights"
    assert found["data-noframes"]["hf"]["gap"] == "no frames"
    assert found["data-oneframe"]["hf"]["gap"] == "fewer than two frames"
    assert found["data-silent"]["hf"]["gap"] == "no events"
    for name in ("later", "earlier"):
        assert found[f"data-{name}"]["hf"]["gap"].startswith("no overlap in time: frames")
    paused = found["data-pause"]["hf"]
    assert paused["frames"] == 5 and paused["windows_without_events"] == 2
    assert np.isfinite(paused["values"]["ssim"]).all()
    out = capsys.readouterr().out
    assert "data-pause: 2 windows without events" in out and "nan" not in out.lower()
    assert results["means"]["over sequences"]["hf"]["sequences"] == 2
    assert results["means"]["over sequences"]["e2vid"] == {"gap": "no weights"}


def test_a_file_in_a_folder_that_cannot_be_opened_is_a_gap(folder, tmp_path, capsys, caplog):
    data = tmp_path / "data"
    write(data / "good.h5", 6)
    with zipfile.ZipFile(data / "photographs.zip", "w") as archive:
        archive.writestr("a.jpg", b"")
    (data / "half.h5").write_bytes((data / "good.h5").read_bytes()[:3000])
    for _ in range(2):  # anew, and going on
        results = run(settings(folder, tmp_path / "out", data=(data,), methods="hf"))
        found = {name: entry["methods"]["hf"] for name, entry in results["sequences"].items()}
        assert found["data-good"]["frames"] == 5
        assert found["data-photographs"]["gap"].startswith(f"{data / 'photographs.zip'}: ")
        assert "cannot be read" in found["data-half"]["gap"]
        assert f"{data / 'half.h5'}: cannot be read" in caplog.text
        assert "data-photographs" in capsys.readouterr().out
        assert "<p>not opened</p>" in (tmp_path / "out/index.html").read_text()
    with pytest.raises(RecordingError, match=r"half\.h5: cannot be read"):
        run(settings(folder, tmp_path / "named", data=(data / "half.h5",), methods="hf"))
    (data / "good.h5").unlink()
    with pytest.raises(RecordingError, match="nothing can be evaluated: data-half / hf: "):
        run(settings(folder, tmp_path / "none", data=(data,), methods="hf"))


def test_a_recording_that_cannot_be_cut_is_a_gap_beside_the_others(folder, tmp_path):
    data = tmp_path / "data"
    write(data / "good.h5", 6)
    late = events_of(3000, 400_000)
    late = Events.of(late.t + 4 * 10**9, late.x, late.y, late.p)
    early = Events.of([0], [1], [1], [1])
    write(data / "pause.h5", 6, concatenate([early, late]), begin=4 * 10**9)
    for _ in range(2):
        choice = {"data": (data,), "methods": "hf", "warm_up": 5000.0}  # with the pause
        results = run(settings(folder, tmp_path / "out", **choice))
        assert results["sequences"]["data-good"]["methods"]["hf"]["frames"] == 5
        assert "gap" in results["sequences"]["data-pause"]["methods"]["hf"]
        assert (tmp_path / "out/index.html").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_links_back_to_a_folder_are_not_followed_for_ever(tmp_path):
    (tmp_path / "set/inner").mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    for name in ("set/a.h5", "set/inner/b.h5", "elsewhere/c.h5"):
        (tmp_path / name).touch()
    (tmp_path / "set/inner/back").symlink_to(tmp_path / "set")
    (tmp_path / "set/link").symlink_to(tmp_path / "elsewhere")
    names = [str(path.relative_to(tmp_path)) for path in evaluate.recordings_in(tmp_path / "set")]
    assert names == ["set/a.h5", "set/inner/b.h5", "set/link/c.h5"]


def test_folders_are_searched_for_all_formats_that_can_hold_frames(tmp_path):
    """The readers say what they take; formats of events alone would only make gaps."""
    modules = [
        importlib.import_module(f"firenet_jax.readers.{name}")
        for name in ("rosbag", "hdf5", "aedat4", "aedat3", "aedat2")
    ]
    text = (Path(firenet_jax.__file__).parents[1] / "docs/formats.md").read_text()
    suffixes = {*re.findall(r"`(\.[a-z0-9]+)`", text), ".aedat2", ".aedat3", ".hdf5", ".hdf"}
    for suffix in sorted(suffixes):
        (tmp_path / f"a{suffix}").touch()
        (tmp_path / f"b{suffix.upper()}").touch()
    expected = [
        path
        for path in sorted(tmp_path.iterdir())
        if path.suffix.lower() == ".zip" or any(module.matches(path) for module in modules)
    ]
    assert len(expected) == 2 * len({path.suffix.lower() for path in expected}) >= 22
    assert evaluate.recordings_in(tmp_path) == expected


def test_pixels_whose_flow_is_not_known_do_not_count(folder, tmp_path):
    """They may be anything, nan too; the others keep their weight in a mean over all pixels."""
    for name in ("whole", "part"):
        write(tmp_path / name / "a.h5", 6)
    with h5py.File(tmp_path / "part" / "a.h5", "r+") as file:
        file["flow/flow000000003"][:, 8:10] = np.nan
    found = {
        name: run(settings(folder, tmp_path / f"{name}-out", data=(tmp_path / name,), methods="hf"))
        for name in ("whole", "part")
    }
    whole, part = (found[n]["sequences"][f"{n}-a"]["methods"]["hf"] for n in ("whole", "part"))
    assert part["gaps"] == whole["gaps"]
    a, b = (np.array(found["values"]["temporal_error"][1:]) for found in (part, whole))
    numbers = np.array(part["frame_numbers"][1:])
    np.testing.assert_array_equal(a < b, numbers == 3)
    np.testing.assert_array_equal(a == b, numbers != 3)


def test_an_error_over_no_pixels_is_none_at_all(folder, tmp_path):
    """And not 0, which would be perfect."""
    write(tmp_path / "some" / "a.h5", 6)
    with h5py.File(tmp_path / "some" / "a.h5", "r+") as file:
        file["flow/flow000000003"][:] = np.nan
    (found,) = run(settings(folder, tmp_path / "out", data=(tmp_path / "some",), methods="hf"))[
        "sequences"
    ].values()
    found = found["methods"]["hf"]
    missing = [value is None for value in found["values"]["temporal_error"]]
    assert missing == [
        number in (found["frame_numbers"][0], 3) for number in found["frame_numbers"]
    ]
    with h5py.File(tmp_path / "some" / "a.h5", "r+") as file:
        for flow in file["flow"].values():
            flow[:] = np.nan
    (found,) = run(settings(folder, tmp_path / "none", data=(tmp_path / "some",), methods="hf"))[
        "sequences"
    ].values()
    assert found["methods"]["hf"]["gaps"]["temporal_error"] == "no flow"


def test_frames_of_another_size_and_nothing_at_all(folder, tmp_path):
    ours = settings(folder, tmp_path / "out", methods="hf", sensor_size="30x20")
    with pytest.raises(ValueError, match="frames are 28x20, the sensor is 30x20"):
        run(ours)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="holds no recordings"):
        run(settings(folder, tmp_path / "out", data=(tmp_path / "empty",)))
    twice = (folder / "data" / "a.h5", folder / "data" / "a.h5")
    with pytest.raises(ValueError, match="are the same recording: name it once"):
        run(settings(folder, tmp_path / "out", data=twice))
    (tmp_path / "a.h5").write_bytes(twice[0].read_bytes())
    with pytest.raises(ValueError, match="both named a: rename one of them"):
        run(settings(folder, tmp_path / "out", data=(twice[0], tmp_path / "a.h5")))


def test_runs_are_named_by_all_of_their_folders_names(tmp_path):
    """A learning rate is no suffix."""
    weights = Weights(initial_params(jax.random.key(0)), True)
    for name in ("lr0.001", "lr0.01"):
        (tmp_path / name).mkdir()
        save_weights(tmp_path / name / "weights.npz", weights)
    save_weights(tmp_path / "lr0.1.npz", weights)
    paths = [tmp_path / name for name in ("lr0.001", "lr0.01", "lr0.1.npz")]
    assert [method.name for method in load(["firenet"], paths)] == ["lr0.001", "lr0.01", "lr0.1"]


def test_weights_that_are_not_there_or_not_finite(folder, tmp_path):
    with pytest.raises(CheckpointError, match="nowhere.npz"):
        run(settings(folder, tmp_path / "out", weights=(tmp_path / "nowhere.npz",)))
    with pytest.raises(ValueError, match="no method 'nonsense'"):
        run(settings(folder, tmp_path / "out", methods="hf,nonsense"))
    with pytest.raises(ValueError, match="two methods are named hf"):
        load(["hf", "hf"])
    assert load(["e2vid"]) == [Missing("e2vid", "no weights")]
    for name, files in (("firenet", {"weights": ["a.npz"]}), ("e2vid", {"e2vid_weights": "a.pth"})):
        with pytest.raises(ValueError, match=f"{name} is not among the methods"):
            load(["hf"], **files)

    params = initial_params(jax.random.key(0))
    params["prediction"]["bias"] = params["prediction"]["bias"] + 3e38
    params["prediction"]["kernel"] = params["prediction"]["kernel"] + 3e38
    save_weights(tmp_path / "huge.npz", Weights(params, True))
    ours = settings(
        folder, tmp_path / "out", methods="firenet,hf", weights=(tmp_path / "huge.npz",)
    )
    found = run(ours)["sequences"]["data-a"]["methods"]
    assert "is not finite" in found["huge"]["gap"] and "gap" not in found["hf"]


@pytest.mark.parametrize(
    "choice, message",
    [
        ({"data": ()}, "no data"), ({"methods": " ,"}, "no methods: choose from firenet"),
        ({"keep_ratio": 0.0}, "keep ratio"), ({"seed": -1}, "seed is -1"),
        ({"warm_up": -1.0}, "warm_up"), ({"warm_up": float("inf")}, "0 or more and finite"),
        ({"tolerance": float("nan")}, "tolerance"),
        ({"start": 3.0, "stop": 2.0}, "stop"), ({"stop": float("inf")}, "leave it out"),
        ({"start": float("nan")}, "start is nan"), ({"events": 0}, "events"),
        ({"events": 5, "duration": 5.0}, "one of --events and --duration$"),
        ({"sensor_size": "240"}, "WIDTHxHEIGHT"),
        ({"keep_ratio": 0.5, "times": Times(between_frames=True)}, "between frames only"),
    ],
)  # fmt: skip
def test_impossible_settings(folder, tmp_path, choice, message):
    with pytest.raises(ValueError, match=message):
        settings(folder, tmp_path / "out", **choice)


@pytest.mark.parametrize("sigmoid", [True, False], ids=["E2VID", "E2VID+"])
def test_e2vid_runs_as_in_evreal(sigmoid):
    """E2VID: normalised tensors, 1st and 99th percentile to 0 and 1; E2VID+: neither."""
    small = e2vid.Settings(sigmoid=sigmoid, channels=4)
    params = e2vid.initial_params(jax.random.key(0), small)
    window = Window(events_of(500, 1000), 1000)
    method = recurrent_unet("e2vid", params, small)
    image = method.step(method.initial(HEIGHT, WIDTH), window)[1]

    tensor = voxelise(pack([[window.events]]), height=HEIGHT, width=WIDTH)
    tensor = normalise(tensor) if sigmoid else tensor
    state = e2vid.initial_state(1, HEIGHT, WIDTH, small)
    expected = np.asarray(e2vid.step(params, state, tensor[0], small)[1])[0]
    if sigmoid:
        low, high = np.percentile(expected, [1, 99])
        expected = (expected - low) / (high - low)
    np.testing.assert_allclose(image, expected, atol=1e-5)


def test_nothing_recompiles_as_windows_vary(folder):
    found = load(["firenet"], [folder / "ours.npz"])[0]
    state = found.initial(HEIGHT, WIDTH)
    state, _ = found.step(state, Window(events_of(10, 1000), 1000))
    compiled = methods.reconstruct._cache_size(), methods.voxelise._cache_size()
    for count in (0, 1, 77, 3000, 16_000):
        state, _ = found.step(state, Window(events_of(count, 1000), 1000))
    assert (methods.reconstruct._cache_size(), methods.voxelise._cache_size()) == compiled


@pytest.mark.parametrize(
    "low, high, expected",
    [(0.1, 0.9, [0, 0.2, 0.4, 0.6, 0.8, 1.0]), (3, 3, None), (0, 0, None), (-5, 9, None)],
)
def test_ticks_are_few_round_and_enclose(low, high, expected):
    ticks = ticks_of(low, high)
    assert 2 <= len(ticks) <= 7 and ticks[0] <= low and ticks[-1] >= high
    assert expected is None or ticks == pytest.approx(expected)


def test_metrics_are_known_by_name():
    assert set(COMPARED) | {"lpips", "temporal_error"} == set(METRICS)
    assert all(callable(getattr(metrics, name)) for name in COMPARED)


def test_predictions_a_little_late_count_and_flow_needs_the_frame_before(folder, tmp_path):
    """Windows of one event, half a millisecond after frames 1, 2, 4 and the last, 5."""
    t = PERIOD * np.array([1, 2, 4, 5]) + 500
    path = write(tmp_path / "a.h5", 6, Events.of(t, [3, 4, 5, 6], [3] * 4, [1] * 4))
    choices = {"data": (path,), "methods": "hf", "events": 1}
    entry = run(settings(folder, tmp_path / "out", **choices))["sequences"]["a"]["methods"]["hf"]
    assert entry["frame_numbers"] == [1, 2, 4, 5] and entry["of"] == 5
    known = [value is not None for value in entry["values"]["temporal_error"]]
    assert known == [False, True, False, True]


def test_flow_is_not_known_where_frames_were_left_out(tmp_path):
    path = write(tmp_path / "a.h5", 9)
    chosen = Evaluate((path,), tmp_path, keep_ratio=0.7, seed=1)
    found = plan("a", open_recording(path), chosen.protocol)
    gaps = np.diff(found.numbers)
    assert {1, 2} <= set(gaps.tolist())
    for place, gap in enumerate(gaps, 1):
        assert (displacement(found, place) is None) == (gap > 1)


def test_temporal_errors_do_not_depend_on_where_batches_end(folder, tmp_path, monkeypatch):
    path, values = write(tmp_path / "a.h5", 8), []
    for batch in (8, 3):
        for module in (protocol, comparison):
            monkeypatch.setattr(module, "IMAGES_AT_ONCE", batch)
        choices = {"data": (path,), "methods": "hf"}
        results = run(settings(folder, tmp_path / f"{batch}", **choices))
        values.append(results["sequences"]["a"]["methods"]["hf"]["values"]["temporal_error"])
    assert values[0][0] is values[1][0] is None and len(values[0]) == 7
    assert values[1][1:] == pytest.approx(values[0][1:], abs=1e-6)


def test_the_best_is_the_least_distance_and_the_greatest_similarity():
    entries = {
        "a": {"means": {"mse": 0.02, "ssim": 0.9}, "gaps": {}},
        "b": {"means": {"mse": 0.01, "ssim": 0.8}, "gaps": {}},
        "c": {"gap": "no weights"},
    }
    assert _best(entries, "mse") == "0.0100" and _best(entries, "ssim") == "0.900"
    assert _best({"a": entries["a"], "c": entries["c"]}, "mse") is None


def test_stills_and_clip_are_of_the_frames_that_count():
    """Of 100 to 299 at 20, 55 and 90 %, and the 60 in the middle."""
    numbers = 3 * np.arange(400)
    kept = comparison.Pictures(SimpleNamespace(first=100, last=300, numbers=numbers))
    for place in range(100, 300):
        if place != 210:  # has no image: the next one
            image = np.full((1, 2, 2), (place - 100) / 255)
            kept.add([comparison.Comparison(place, None, None, None)], (image, image))
    found = kept.arrays()
    assert found["stills_frames"].tolist() == [3 * 140, 3 * 211, 3 * 280]
    assert found["clip_frames"].tolist() == [3 * n for n in range(170, 231) if n != 210]
    assert found["stills"][:, 0, 0].tolist() == [40, 111, 180] and len(found["clip"]) == 60


def test_what_became_a_gap_leaves_nothing_of_other_settings(folder, tmp_path):
    choices = {"data": (folder / "data",), "methods": "hf", "output": tmp_path / "out"}
    run(Evaluate(**choices))
    assert (tmp_path / "out" / "videos" / "data-a.mp4").is_file()
    last = open_recording(folder / "data" / "a.h5").frames.times[-1]
    later = choices | {"start": 1e-6 * last + 0.001}
    results = run(Evaluate(**later, overwrite=True))
    assert "gap" in results["sequences"]["data-a"]["methods"]["hf"]
    assert not (tmp_path / "out" / "videos" / "data-a.mp4").exists()
    run(Evaluate(**later))  # nothing of before is in its way


def test_a_recording_that_is_named_twice_is_refused(folder, tmp_path):
    data = (folder / "data", folder / "data" / "a.h5")
    with pytest.raises(RecordingError, match="are the same recording: name it once"):
        run(Evaluate(output=tmp_path / "out", data=data, methods="hf"))


def test_names_of_which_no_result_could_be_written_are_refused_first(folder, tmp_path):
    recording, weights = tmp_path / "a.partial.h5", tmp_path / "b.partial.npz"
    recording.write_bytes((folder / "data" / "a.h5").read_bytes())
    save_weights(weights, Weights(initial_params(jax.random.key(0)), True))
    choices = {"data": (recording,), "methods": "hf"}, {"weights": (weights,), "methods": "firenet"}
    for choice, name in zip(choices, "ab", strict=True):
        with pytest.raises(SettingsError, match=f"^{name}.partial: .partial names what is not"):
            run(settings(folder, tmp_path / "out", **choice))
    assert not (tmp_path / "out").exists()


def test_the_page_knows_weights_by_what_they_are():
    ours = {"method": "firenet", "normalise": True, "weights": digest(load_weights())}
    assert about("mine", ours).endswith("the weights of this package")
    for name in ("firenet", "mr", "hf"):
        said = about(name, ours | {"weights": "other"})
        assert said == "FireNet (Scheerlinck et al. 2020), with the weights of this name"
    assert about("e2vid", None).startswith("E2VID")
    assert about("e2vid-random", {"method": "e2vid"}).startswith("E2VID with random weights")
