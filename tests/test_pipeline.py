import dataclasses
import gzip
import json
import os
import re
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import av
import h5py
import jax
import numpy as np
import pytest
from PIL import Image
from processes import finish, start

import firenet_jax as fj
from firenet_jax.checkpoint import load_weights, save_weights
from firenet_jax.commands import jobs, reconstruct
from firenet_jax.commands.reconstruct import Reconstruct, describe, plan, run
from firenet_jax.commands.times import Times
from firenet_jax.errors import RecordingError, SettingsError
from firenet_jax.network import Weights, initial_params
from firenet_jax.pictures import Display
from firenet_jax.readers import open_recording, text
from firenet_jax.reconstruction import Network
from firenet_jax.storage.arrays import ArraysWriter
from firenet_jax.storage.files import OutputError, locked, read_arrays
from firenet_jax.storage.video import FolderWriter, VideoWriter
from firenet_jax.windows import Windows

HEIGHT, WIDTH = 20, 24
EACH_WAY = pytest.mark.usefixtures("each_way")


def write_recording(path, count=3000, seed=0, width=WIDTH, height=HEIGHT):
    """A text recording with a header; returns its path."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, 10**6, count))
    rows = zip(t, rng.integers(0, width, count), rng.integers(0, height, count),
               rng.integers(0, 2, count), strict=True)  # fmt: skip
    path.write_text(
        f"{width} {height}\n" + "".join(f"{t / 1e6:.6f} {x} {y} {p}\n" for t, x, y, p in rows)
    )
    return path


@pytest.fixture
def weights(tmp_path):
    path = tmp_path / "weights.npz"
    save_weights(path, Weights(initial_params(jax.random.key(0)), True))
    return path


def settings(weights, recordings, output, **kwargs):
    kwargs = {"windows": Windows(events=100), "chunk": 4} | kwargs
    return Reconstruct(recordings, output, weights, **kwargs)


def pictures_of(folder):
    pictures = []
    for path in sorted(folder.glob("frame_*.png")):
        with Image.open(path) as image:
            pictures.append(np.asarray(image))
    return np.stack(pictures), (folder / "timestamps.txt").read_text()


def test_a_recording_becomes_a_folder_of_pictures(tmp_path, weights, capsys):
    recording = write_recording(tmp_path / "a.txt", 3050)
    run(settings(weights, (recording,), tmp_path / "out"))
    pictures, stamps = pictures_of(tmp_path / "out")
    assert pictures.shape == (31, HEIGHT, WIDTH)  # the last window holds 50 events
    times = [line.split()[0] for line in recording.read_text().splitlines()[1:]]
    assert stamps.split() == times[99::100] + times[-1:]
    assert "31 pictures of 3,050 events" in capsys.readouterr().out
    assert not list(tmp_path.glob("*.partial*"))


def test_the_first_pictures_are_of_a_network_that_has_seen_the_beginning(tmp_path, weights, capsys):
    """As by hand: ten windows forwards, then backwards in time, then all of them. (Normalised
    tensors are not the same: of a vote of 0, rounding can make one that counts.)"""
    plain = Weights(initial_params(jax.random.key(0)), False)
    save_weights(weights, plain)
    path = write_recording(tmp_path / "a.txt", 1550)
    choices = {"windows": Windows(events=100), "warm_up": 10, "batch": 1}
    run(settings(weights, (path,), tmp_path / "a.h5", **choices))
    assert "16 pictures of 1,550 events" in capsys.readouterr().out
    chunks = fj.event_tensors(open_recording(path), events=100, chunk=1)
    tensors = np.concatenate([tensors for tensors, _ in chunks])
    shown = np.concatenate([tensors[:10], -tensors[:10][::-1, ..., ::-1], tensors])
    state = fj.initial_state(1, HEIGHT, WIDTH)
    wanted = fj.reconstruct(plain, state, shown)[1][20:, 0]
    with h5py.File(tmp_path / "a.h5") as file:
        np.testing.assert_allclose(file["images"], wanted, atol=1e-5)
    run(settings(weights, (path,), tmp_path / "cold.h5", **(choices | {"warm_up": 0})))
    with h5py.File(tmp_path / "cold.h5") as file:
        cold = fj.reconstruct(plain, state, tensors)[1][:, 0]
        np.testing.assert_allclose(file["images"], cold, atol=1e-5)
    with pytest.raises(SettingsError, match="warm-up is -1"):
        settings(weights, (path,), tmp_path / "out", warm_up=-1)


def test_a_dense_window_is_taken_in_steps_and_shown_at_its_end(tmp_path, weights, capsys):
    """Three windows of 2.1 events per pixel: four steps each, in the warm-up too; a last one of
    .52. As by hand, with windows of a fourth."""
    plain = Weights(initial_params(jax.random.key(0)), False)
    save_weights(weights, plain)
    path = write_recording(tmp_path / "a.txt", 3250)
    choices = {"windows": Windows(events=1000), "warm_up": 1, "batch": 1}
    run(settings(weights, (path,), tmp_path / "a.h5", **choices))
    assert "windows of 1,000 events, in 3.25 steps each" in capsys.readouterr().out
    chunks = fj.event_tensors(open_recording(path), events=250, chunk=1)
    tensors = np.concatenate([tensors for tensors, _ in chunks])
    seen = np.concatenate([tensors[:4], -tensors[:4][::-1, ..., ::-1], tensors])
    state = fj.initial_state(1, HEIGHT, WIDTH)
    made = fj.reconstruct(plain, state, seen)[1][8:, 0]
    with h5py.File(tmp_path / "a.h5") as file:
        assert file["events"][:].tolist() == [1000, 1000, 1000, 250]
        np.testing.assert_allclose(file["images"], made[np.array([3, 7, 11, 12])], atol=1e-5)
        whole_times = file["times"][:]

    # In one step: where it is asked for, where nothing is remembered, and where windows overlap.
    chunks = fj.event_tensors(open_recording(path), events=1000, chunk=1)
    tensors = np.concatenate([tensors for tensors, _ in chunks])
    choices["warm_up"] = 0
    for name, choice, recurrent in (
        ("whole", {"network": Network(whole_windows=True)}, True),
        ("forgetful", {"network": Network(recurrent=False)}, False),
        ("overlapping", {"windows": Windows(events=1000, step=1000)}, True),
    ):
        run(settings(weights, (path,), tmp_path / f"{name}.h5", **(choices | choice)))
        assert "steps each" not in capsys.readouterr().out
        made = fj.reconstruct(plain, state, tensors, recurrent=recurrent)[1][:, 0]
        with h5py.File(tmp_path / f"{name}.h5") as file:
            np.testing.assert_array_equal(file["times"], whole_times)
            np.testing.assert_allclose(file["images"], made, atol=1e-5)


def test_the_steps_of_a_dense_window_are_not_in_the_range_of_pictures(tmp_path, weights):
    """What is black and white in a picture comes of the pictures before it, and of no others."""
    path = write_recording(tmp_path / "a.txt", 8000)
    choices = {"windows": Windows(events=1000), "warm_up": 0}
    run(settings(weights, (path,), tmp_path / "a.h5", **choices))
    run(settings(weights, (path,), tmp_path / "a", **choices))
    with h5py.File(tmp_path / "a.h5") as file:
        images = file["images"][:]
    greys = fj.display(fj.initial_display_state(1), images[:, None])[1][:, 0]
    difference = np.abs(pictures_of(tmp_path / "a")[0].astype(int) - np.asarray(greys))
    assert difference.max() <= 1


@pytest.mark.parametrize(
    "choice, others",
    [
        ({"windows": Windows(events=9, step=3)}, {}), ({"times": Times(rate=3.0)}, {}),
        ({}, {"recurrent": False}),
    ],
)  # fmt: skip
def test_where_windows_are_whole_nobody_asks_for_it(weights, choice, others):
    network = Network(whole_windows=True, **others)
    with pytest.raises(SettingsError, match="--whole-windows has no effect beside"):
        settings(weights, (Path("a.txt"),), Path("out"), network=network, **choice)


def test_a_dense_window_is_not_warned_of_unless_it_is_one_step(tmp_path, weights, caplog):
    path = write_recording(tmp_path / "a.txt", 2000)
    run(settings(weights, (path,), tmp_path / "parts", windows=Windows(events=1000)))
    assert not caplog.messages
    whole = {"windows": Windows(events=1000), "network": Network(whole_windows=True)}
    run(settings(weights, (path,), tmp_path / "whole", **whole))
    assert "more than 1.5 smeared ones" in caplog.text


@pytest.mark.parametrize("batch", [1, 2, 3])
@EACH_WAY
def test_a_batch_gives_what_each_recording_gives_alone(tmp_path, weights, batch):
    """Five recordings of different lengths and two sizes; slots are used again."""
    lengths = (700, 2050, 400, 1200, 900)
    paths = [write_recording(tmp_path / f"r{n}.txt", n, seed=n) for n in lengths]
    paths.append(write_recording(tmp_path / "small.txt", 500, seed=1, width=9, height=8))
    run(settings(weights, tuple(paths), tmp_path / "all", batch=batch))
    for path in paths:
        run(settings(weights, (path,), tmp_path / "alone" / path.stem))
        together, stamps = pictures_of(tmp_path / "all" / path.stem)
        alone, expected = pictures_of(tmp_path / "alone" / path.stem)
        assert stamps == expected
        assert np.abs(together.astype(int) - alone).max() <= 1


SHARED = """
import sys
from pathlib import Path
from firenet_jax.commands.reconstruct import Reconstruct, run
from firenet_jax.windows import Windows

weights, folder, output, *where = sys.argv[1:]
processes, process = map(int, where) if where else [None] * 2
recordings = tuple(sorted(Path(folder).glob("*.txt")))
run(Reconstruct(recordings, Path(output), Path(weights), Windows(events=100), chunk=4,
    processes=processes, process=process))
"""


@pytest.mark.slow
def test_devices_and_processes_share_recordings_and_give_the_same(tmp_path, weights):
    """Five recordings on four devices, where slots are used again, and in two processes."""
    (tmp_path / "in").mkdir()
    lengths = (700, 2050, 400, 1200, 900)
    for n in lengths:
        write_recording(tmp_path / "in" / f"r{n}.txt", n, seed=n)
    arguments = SHARED, weights, tmp_path / "in"
    finish(start(*arguments, tmp_path / "one"))
    finish(start(*arguments, tmp_path / "four", devices=4))
    finish(*(start(*arguments, tmp_path / "two", 2, process) for process in range(2)))

    for n in lengths:
        expected, stamps = pictures_of(tmp_path / "one" / f"r{n}")
        assert len(expected) == -(-n // 100)
        for shared in ("four", "two"):
            found, times = pictures_of(tmp_path / shared / f"r{n}")
            assert times == stamps
            assert np.abs(found.astype(int) - expected).max() <= 1


class Interrupted(Exception):
    pass


def interrupt_after(monkeypatch, pictures):
    """The program dies while it writes a picture: half of the file is there."""
    original = FolderWriter.write

    def write(self, picture, *of):
        if self.count == pictures:
            (self.partial / f"frame_{self.count:010d}.png").write_bytes(b"half")
            raise Interrupted
        original(self, picture, *of)

    monkeypatch.setattr(FolderWriter, "write", write)


def unfinished(weights, recording, output, monkeypatch):
    """A run that was interrupted after nine pictures."""
    with monkeypatch.context() as patch:
        patch.setattr(jobs, "RESUME_EVERY", 0)
        interrupt_after(patch, 9)
        with pytest.raises(Interrupted):
            run(settings(weights, (recording,), output))


def test_a_run_that_is_interrupted_within_a_dense_window_goes_on(tmp_path, weights, monkeypatch):
    """Five steps a window, four in a chunk."""
    recording = write_recording(tmp_path / "a.txt", 12000)
    choices = {"windows": Windows(events=1200)}
    run(settings(weights, (recording,), tmp_path / "whole", **choices))
    with monkeypatch.context() as patch:
        patch.setattr(jobs, "RESUME_EVERY", 0)
        interrupt_after(patch, 5)
        with pytest.raises(Interrupted):
            run(settings(weights, (recording,), tmp_path / "out", **choices))
    run(settings(weights, (recording,), tmp_path / "out", **choices))
    expected, actual = pictures_of(tmp_path / "whole"), pictures_of(tmp_path / "out")
    np.testing.assert_array_equal(actual[0], expected[0])
    assert actual[1] == expected[1] and len(actual[0]) == 10
    with pytest.raises(ValueError, match="network.whole_windows was"):
        with monkeypatch.context() as patch:
            patch.setattr(jobs, "RESUME_EVERY", 0)
            interrupt_after(patch, 5)
            with pytest.raises(Interrupted):
                run(settings(weights, (recording,), tmp_path / "other", **choices))
        choices["network"] = Network(whole_windows=True)
        run(settings(weights, (recording,), tmp_path / "other", **choices))


@pytest.mark.parametrize("at, color", [(2, False), (9, False), (9, True), (30, False)])
@EACH_WAY
def test_an_interrupted_run_goes_on_and_gives_the_same(tmp_path, weights, monkeypatch, at, color):
    recording = write_recording(tmp_path / "a.txt", 3050)
    choices = {"display": Display(range="extremes"), "network": Network(color=color)}
    run(settings(weights, (recording,), tmp_path / "whole", **choices))
    with monkeypatch.context() as patch:
        patch.setattr(jobs, "RESUME_EVERY", 0)
        interrupt_after(patch, at)
        with pytest.raises(Interrupted):
            run(settings(weights, (recording,), tmp_path / "out", **choices))
    assert not (tmp_path / "out").exists()
    done, write = [], FolderWriter.write

    def counted(self, *args):
        done.append(self.count)
        write(self, *args)

    monkeypatch.setattr(FolderWriter, "write", counted)
    run(settings(weights, (recording,), tmp_path / "out", **choices))
    assert done[0] == at // 4 * 4  # everything before the last finished chunk is kept
    expected, actual = pictures_of(tmp_path / "whole"), pictures_of(tmp_path / "out")
    np.testing.assert_array_equal(actual[0], expected[0])
    assert actual[1] == expected[1]
    assert len(list((tmp_path / "out").iterdir())) == 32


def test_other_settings_do_not_continue_an_unfinished_run(tmp_path, weights, monkeypatch):
    recording = write_recording(tmp_path / "a.txt")
    unfinished(weights, recording, tmp_path / "out", monkeypatch)
    other = {"windows": Windows(events=200)}
    with pytest.raises(ValueError, match="windows.events was 100, now 200"):
        run(settings(weights, (recording,), tmp_path / "out", **other))
    run(settings(weights, (recording,), tmp_path / "out", overwrite=True, **other))
    assert len(pictures_of(tmp_path / "out")[0]) == 15


def test_an_unfinished_run_is_not_continued_with_pictures_of_others(tmp_path, weights, monkeypatch):
    recording = write_recording(tmp_path / "a.txt")
    unfinished(weights, recording, tmp_path / "out", monkeypatch)

    def broken():
        yield np.zeros((HEIGHT, WIDTH), np.uint8)
        raise Interrupted

    with pytest.raises(Interrupted):
        fj.write_video(tmp_path / "out", broken())
    for name in ("out", "whole"):
        run(settings(weights, (recording,), tmp_path / name))
    expected, actual = pictures_of(tmp_path / "whole"), pictures_of(tmp_path / "out")
    np.testing.assert_array_equal(actual[0], expected[0])
    assert actual[1] == expected[1]


def test_what_an_interrupted_run_left_is_named_where_it_is_damaged(tmp_path, weights, monkeypatch):
    recording = write_recording(tmp_path / "a.txt")
    unfinished(weights, recording, tmp_path / "out", monkeypatch)
    kept = tmp_path / "out.partial" / "resume.npz"
    whole = read_arrays(kept)
    kept.write_bytes(kept.read_bytes()[:-100])
    with pytest.raises(OutputError, match="resume.npz is damaged .*: remove it"):
        run(settings(weights, (recording,), tmp_path / "out"))
    for name in ("pictures", "state0"):
        np.savez(kept, **{key: value for key, value in whole.items() if key != name})
        with pytest.raises(OutputError, match=f"resume.npz lacks '{name}': remove it"):
            run(settings(weights, (recording,), tmp_path / "out"))
    kept.unlink()
    run(settings(weights, (recording,), tmp_path / "out"))
    assert len(pictures_of(tmp_path / "out")[0]) == 30


@pytest.mark.parametrize("block", [text.BLOCK, 1000])
def test_a_run_that_goes_on_counts_the_events_of_its_own_pictures(
    tmp_path, weights, monkeypatch, capsys, block
):
    """The warm-up reads ahead of them: the recording as a whole, or its first part."""
    monkeypatch.setattr(text, "BLOCK", block)
    recording = write_recording(tmp_path / "a.txt")
    unfinished(weights, recording, tmp_path / "out", monkeypatch)
    capsys.readouterr()
    run(settings(weights, (recording,), tmp_path / "out"))
    said = re.search(r"out: (\d+) pictures of ([\d,]+) events", capsys.readouterr().out)
    assert 0 < int(said[1]) < 30 and int(said[2].replace(",", "")) == 100 * int(said[1])


@pytest.mark.slow
def test_killed_and_run_again_gives_the_same(tmp_path, weights):
    """SIGKILL, in a process of its own."""
    recording = write_recording(tmp_path / "a.txt", 20_000)
    script = textwrap.dedent(f"""
        import os, signal, sys
        from firenet_jax import cli
        from firenet_jax.commands import jobs
        jobs.RESUME_EVERY = 0
        if sys.argv[1] == "kill":
            write = jobs.FolderWriter.write
            def killed(self, *args):
                if self.count == 90:
                    os.kill(os.getpid(), signal.SIGKILL)
                write(self, *args)
            jobs.FolderWriter.write = killed
        out = sys.argv[2]
        sys.exit(cli.main(["reconstruct", {str(recording)!r}, "-o", out,
                           "--weights", {str(weights)!r}, "-N", "100"]))
    """)
    for how, name, code in [("run", "whole", 0), ("kill", "out", -9), ("run", "out", 0)]:
        command = [sys.executable, "-c", script, how, str(tmp_path / name)]
        assert subprocess.run(command, capture_output=True).returncode == code
    expected, actual = pictures_of(tmp_path / "whole"), pictures_of(tmp_path / "out")
    np.testing.assert_array_equal(actual[0], expected[0])
    assert actual[1] == expected[1]


def test_filters_and_time_span(tmp_path, weights):
    recording = write_recording(tmp_path / "a.txt", 4000)
    (tmp_path / "hot.txt").write_text("3,4\n")
    choices = {"start": 0.25, "stop": 0.75, "flip": True, "hot_pixels": str(tmp_path / "hot.txt")}
    run(settings(weights, (recording,), tmp_path / "out", **choices))
    stamps = [float(line) for line in pictures_of(tmp_path / "out")[1].split()]
    assert 0.25 < stamps[0] and stamps[-1] < 0.7501 and 19 <= len(stamps) <= 21
    turned = run_flipped(tmp_path, weights, recording, choices)
    assert np.abs(turned.astype(int) - pictures_of(tmp_path / "out")[0]).max() <= 1


def run_flipped(tmp_path, weights, recording, choices):
    """The same with the recording itself turned, and the network run upright on it."""
    lines = recording.read_text().splitlines()
    kept = [line.split() for line in lines[1:] if line.split()[1:3] != ["3", "4"]]
    turned = [f"{t} {WIDTH - 1 - int(x)} {HEIGHT - 1 - int(y)} {p}" for t, x, y, p in kept]
    path = tmp_path / "turned.txt"
    path.write_text("\n".join([lines[0], *turned]) + "\n")
    choices = choices | {"flip": False, "hot_pixels": None}
    first = float(lines[1].split()[0]) - float(kept[0][0])
    assert first == 0  # or the time span would begin elsewhere
    run(settings(weights, (path,), tmp_path / "turned", **choices))
    return pictures_of(tmp_path / "turned")[0]


def test_a_recording_that_cannot_be_opened_does_not_keep_others_from_being_done(tmp_path, weights):
    good = write_recording(tmp_path / "good.txt", 300)
    (tmp_path / "half.npz").write_bytes(b"PK" + bytes(300))
    with pytest.raises(RecordingError, match=r"half\.npz.*the other recordings are done"):
        run(settings(weights, (tmp_path / "half.npz", good), tmp_path / "out"))
    assert len(pictures_of(tmp_path / "out/good")[0]) == 3
    with pytest.raises(RecordingError, match=r"none\.npz"):  # a wrong name stops at once
        run(settings(weights, (good, tmp_path / "none.npz"), tmp_path / "other"))
    assert not (tmp_path / "other").exists() or not list((tmp_path / "other").iterdir())


@pytest.mark.parametrize(
    "choice, said",
    [
        ({"windows": Windows(step=100)}, "odd.txt: step of 100 events is longer than the window"),
        ({"network": Network(color=True)}, "odd.txt: 9x7 cannot be a colour sensor"),
    ],
)
def test_settings_that_do_not_suit_one_sensor_name_the_recording(tmp_path, weights, choice, said):
    """And do not keep others from being done."""
    paths = tuple(tmp_path / f"{name}.txt" for name in ("fine", "odd", "other"))
    for path, (width, height) in zip(paths, ((24, 20), (9, 7), (26, 20)), strict=True):
        write_recording(path, 400, width=width, height=height)
    with pytest.raises(RecordingError, match=f"{said}.*the other recordings are done"):
        run(settings(weights, paths, tmp_path / "all", **choice))
    assert {path.name for path in (tmp_path / "all").iterdir() if path.is_dir()} == {
        "fine", "other"
    }  # fmt: skip


@pytest.mark.parametrize("batch", [1, 2])
def test_a_damaged_recording_does_not_keep_others_from_being_done(
    tmp_path, weights, batch, monkeypatch
):
    """One is damaged at its beginning, one after five windows."""
    names = "early", "good", "late", "fine"
    paths = [write_recording(tmp_path / f"{name}.txt", 900, seed=3) for name in names]
    (tmp_path / "early.txt").write_text(f"{WIDTH} {HEIGHT}\n0.5 1 1 1 1\n")
    whole = jobs.cut

    def cut(recording, *args, **kwargs):
        for number, window in enumerate(whole(recording, *args, **kwargs)):
            if recording.path.stem == "late" and number == 5:
                raise RecordingError(f"{recording.path}: damaged")
            yield window

    monkeypatch.setattr(jobs, "cut", cut)
    with pytest.raises(RecordingError) as raised:
        run(settings(weights, tuple(paths), tmp_path / "all", batch=batch))
    said = str(raised.value)
    assert "early.txt" in said and "late.txt" in said and "the other recordings are done" in said
    run(settings(weights, (tmp_path / "good.txt",), tmp_path / "alone"))
    expected, _ = pictures_of(tmp_path / "alone")
    for name in ("good", "fine"):
        np.testing.assert_array_equal(pictures_of(tmp_path / "all" / name)[0], expected)
    left = {path.name for path in (tmp_path / "all").iterdir()}
    assert left == {"good", "fine", "late.partial", "good.done.json", "fine.done.json"}
    # mended, they are done by the same command, the others are not done again
    monkeypatch.setattr(jobs, "cut", whole)
    write_recording(tmp_path / "early.txt", 900, seed=3)
    run(settings(weights, tuple(paths), tmp_path / "all", batch=batch))
    assert {path.name for path in (tmp_path / "all").iterdir()} == set(names)


@EACH_WAY
def test_an_interrupted_run_of_several_goes_on(tmp_path, weights, monkeypatch, caplog):
    paths = tuple(write_recording(tmp_path / f"{name}.txt", 1500, seed=3) for name in "abc")
    run(settings(weights, paths[:1], tmp_path / "alone"))
    expected, _ = pictures_of(tmp_path / "alone")
    written, write = [], FolderWriter.write

    def counted(self, *args):
        written.append(self.path.name)
        if len(written) == 20:
            raise Interrupted
        write(self, *args)

    monkeypatch.setattr(FolderWriter, "write", counted)
    monkeypatch.setattr(jobs, "RESUME_EVERY", 0)
    with pytest.raises(Interrupted):
        run(settings(weights, paths, tmp_path / "out", batch=1))
    written += ["-"] * 100
    # other settings are refused before anything is computed
    with pytest.raises(OutputError, match="a exists"):
        run(settings(weights, paths, tmp_path / "out", batch=1, windows=Windows(events=90)))
    with pytest.raises(OutputError, match="unfinished run of other settings"):
        run(settings(weights, paths[1:], tmp_path / "out", batch=1, windows=Windows(events=90)))
    assert written[-1] == "-"
    run(settings(weights, paths, tmp_path / "out", batch=1))
    assert "a: done by the run that this one continues" in caplog.text
    assert written.count("a") == 15 and written.count("b") < 30 and written.count("c") == 15
    for name in "abc":
        np.testing.assert_array_equal(pictures_of(tmp_path / "out" / name)[0], expected)
    assert {path.name for path in (tmp_path / "out").iterdir()} == set("abc")


@pytest.mark.parametrize("name", ["out", "out.mp4", "out.h5"])
@pytest.mark.parametrize("moment", ["noted", "named"])
def test_a_run_that_ends_as_an_output_gets_its_name_goes_on(
    tmp_path, weights, monkeypatch, name, moment
):
    paths = tuple(write_recording(tmp_path / f"{n}.txt", 900, seed=3) for n in "ab")
    kind = {"out": FolderWriter, "out.mp4": VideoWriter, "out.h5": ArraysWriter}[name]
    finished = kind.finish

    def killed(self, noted):
        def and_no_more(made):
            noted(made)
            raise Interrupted

        finished(self, and_no_more if moment == "noted" else noted)
        raise Interrupted

    monkeypatch.setattr(kind, "finish", killed)
    with pytest.raises(Interrupted):
        run(settings(weights, paths, tmp_path / name, batch=1))
    monkeypatch.undo()
    run(settings(weights, paths, tmp_path / name, batch=1))
    ends = Path(name).suffix
    assert {path.name for path in (tmp_path / "out").iterdir()} == {f"a{ends}", f"b{ends}"}


def test_what_is_no_longer_what_an_interrupted_run_left_is_not_taken_for_done(tmp_path, weights):
    paths = [write_recording(tmp_path / f"{name}.txt", 900, seed=3) for name in "ab"]
    good = paths[1].read_text()
    paths[1].write_text(good + "0.0 1 1 1\n")
    both, out = tuple(paths), tmp_path / "out"
    with pytest.raises(RecordingError, match="backwards"):
        run(settings(weights, both, out))
    next((out / "a").glob("*.png")).unlink()
    with pytest.raises(OutputError, match="a exists"):
        run(settings(weights, both, out))
    with pytest.raises(RecordingError, match="backwards"):
        run(settings(weights, both, out, overwrite=True))
    assert len(pictures_of(out / "a")[0]) == 9
    paths[1].write_text(good)
    run(settings(weights, both, out))
    assert {path.name for path in out.iterdir()} == {"a", "b"}


def test_processes_that_share_recordings_know_what_others_have_done(tmp_path, weights):
    paths = tuple(write_recording(tmp_path / f"{name}.txt", 900, seed=3) for name in "abc")
    shares = [{"processes": 2, "process": n} for n in (0, 1)]
    run(settings(weights, paths, tmp_path / "out", **shares[0]))
    assert (tmp_path / "out" / "a.done.json").exists()  # the other has not come yet
    for share in shares:
        run(settings(weights, paths, tmp_path / "out", **share))
    assert {path.name for path in (tmp_path / "out").iterdir()} == set("abc")


def test_the_share_of_a_process_is_what_its_launcher_says(tmp_path, weights, monkeypatch):
    paths = tuple(write_recording(tmp_path / f"{name}.txt", 300, seed=3) for name in "abc")
    monkeypatch.setenv("SLURM_STEP_NUM_TASKS", "2")
    for rank, names in (("1", ["b"]), ("0", ["a", "c"])):
        monkeypatch.setenv("SLURM_PROCID", rank)
        made = run(settings(weights, paths, tmp_path / "out"))
        assert [path.name for path in made] == names
    assert {path.name for path in (tmp_path / "out").iterdir()} == set("abc")


def test_what_a_killed_run_left_of_a_video_is_replaced(tmp_path, weights):
    recording = write_recording(tmp_path / "a.txt")
    (tmp_path / "a.partial.mp4").write_bytes(b"half")
    run(settings(weights, (recording,), tmp_path / "a.mp4"))
    assert (tmp_path / "a.mp4").exists() and not (tmp_path / "a.partial.mp4").exists()


def test_the_part_before_damage_can_be_had(tmp_path, weights):
    recording = write_recording(tmp_path / "a.txt")
    recording.write_text(recording.read_text().split("\n", 1)[1] + "0.0 1 1 1\n")  # no size
    for hot in (None, "auto"):
        run(settings(weights, (recording,), tmp_path / f"{hot}", stop=0.5, hot_pixels=hot))
        assert len(pictures_of(tmp_path / f"{hot}")[0]) > 3


def test_the_hot_pixels_of_a_file_not_its_name_are_what_a_run_goes_on_with(
    tmp_path, weights, monkeypatch
):
    recording, hot = write_recording(tmp_path / "a.txt"), tmp_path / "hot.txt"
    hot.write_text("1,1\n")
    with monkeypatch.context() as patch:
        patch.setattr(jobs, "RESUME_EVERY", 0)
        interrupt_after(patch, 9)
        with pytest.raises(Interrupted):
            run(settings(weights, (recording,), tmp_path / "out", hot_pixels=str(hot)))
    hot.write_text("1,1\n3,4\n")
    with pytest.raises(OutputError, match="unfinished run of other settings"):
        run(settings(weights, (recording,), tmp_path / "out", hot_pixels=str(hot)))


def test_columns_in_another_order_do_not_continue_an_unfinished_run(tmp_path, weights, monkeypatch):
    recording = write_recording(tmp_path / "a.txt", width=HEIGHT)  # x and y may change places
    unfinished(weights, recording, tmp_path / "out", monkeypatch)
    with pytest.raises(OutputError, match="columns was None, now t,y,x,p"):
        run(settings(weights, (recording,), tmp_path / "out", columns="t,y,x,p"))


def test_names_with_dots(tmp_path, weights):
    paths = [write_recording(tmp_path / f"run.{n}.txt", 300, seed=n) for n in (1, 2)]
    packed = tmp_path / "b.txt.gz"
    packed.write_bytes(gzip.compress(paths[0].read_bytes()))
    run(settings(weights, (*paths, packed), tmp_path / "out"))
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"run.1", "run.2", "b"}


def test_what_lies_behind_a_dot_makes_no_file_of_a_recordings_folder(tmp_path, weights):
    paths = [write_recording(tmp_path / f"cam.{side}.txt", 300) for side in ("left", "right")]
    run(settings(weights, tuple(paths), tmp_path / "out"))
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"cam_left", "cam_right"}
    bag = tmp_path / "b.bag"  # the folder of a recording
    assert plan((bag, paths[0]), tmp_path / "out")[0] == tmp_path / "out" / "b"


@pytest.mark.parametrize("how", ["itself", "linked", "around", "of several"])
def test_a_recording_is_never_replaced(tmp_path, weights, how):
    """Its output may have its name, as events and images both are .h5 and .bag."""
    folder = tmp_path / "hqf"
    folder.mkdir()
    paths = [folder / name for name in ("a.h5", "b.h5")]
    for path in paths:
        with h5py.File(path, "w") as file:
            for name, kind in (("ts", "i8"), ("xs", "i2"), ("ys", "i2"), ("ps", "?")):
                file[f"events/{name}"] = np.arange(500).astype(kind) % 20
            file["events/ts"][:] = np.arange(500)
            file.attrs["sensor_resolution"] = np.array([HEIGHT, WIDTH])
    before = [path.read_bytes() for path in paths]
    inputs, output = (paths[0],), paths[0]
    if how == "linked":
        inputs = (tmp_path / "link.h5",)
        inputs[0].symlink_to(paths[0])
    elif how == "around":
        output = folder.rename(tmp_path / "hqf.ros2")
        paths = [output / path.name for path in paths]
        inputs = (paths[0],)
    elif how == "of several":
        inputs, output = tuple(paths), tmp_path / "hqf.h5"
    with pytest.raises(OutputError, match="a recording that is read .*: choose another output"):
        run(settings(weights, inputs, output, overwrite=True))
    assert [path.read_bytes() for path in paths] == before


def test_nothing_runs_on_after_an_error_that_is_kept(tmp_path, weights, monkeypatch):
    """As a notebook keeps the last one, and with it all that was going on."""
    recording = write_recording(tmp_path / "a.txt", 30_000)

    def full(self, *args):
        raise OSError("no room")

    monkeypatch.setattr(FolderWriter, "write", full)
    before = set(threading.enumerate())
    with pytest.raises(OSError, match="no room") as kept:
        run(settings(weights, (recording,), tmp_path / "out"))
    assert kept.tb and not {t for t in set(threading.enumerate()) - before if t.name != "pack_0"}


@pytest.mark.skipif(os.name == "nt", reason="no signal reaches a thread there")
def test_an_interrupted_run_does_not_wait_for_what_is_read(
    tmp_path, weights, monkeypatch, interrupts
):
    """Such as before --start: nothing comes to the device, and nothing looks whether it is to."""
    recording = open_recording(write_recording(tmp_path / "a.txt"))
    begun = time.monotonic()

    def endless():
        events = next(recording.events())
        while time.monotonic() - begun < 60:
            yield events
            time.sleep(0.01)

    opened = dataclasses.replace(recording, events=endless)
    monkeypatch.setattr(reconstruct, "open_recording", lambda *_: opened)
    main = threading.main_thread().ident
    timer = threading.Timer(3, lambda: signal.pthread_kill(main, signal.SIGINT))
    timer.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            run(settings(weights, (recording.path,), tmp_path / "a.mp4", speed=1.0, start=1e3))
    finally:
        timer.cancel()  # else it would come to whatever follows
    assert time.monotonic() - begun < 30 and not list(tmp_path.glob("*.mp4"))


def test_no_events_is_an_error(tmp_path, weights):
    recording = write_recording(tmp_path / "a.txt", 50)
    with pytest.raises(ValueError, match="a.txt: no events"):
        run(settings(weights, (recording,), tmp_path / "out", start=5.0))
    assert not list(tmp_path.glob("out*"))


def test_the_same_name_twice_is_an_error(tmp_path, weights):
    paths = []
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        paths.append(write_recording(tmp_path / folder / "a.txt", 50))
    with pytest.raises(ValueError, match="two recordings are named a"):
        run(settings(weights, tuple(paths), tmp_path / "out"))


@pytest.mark.parametrize(
    "choice, message",
    [
        ({"chunk": 0}, "chunk"), ({"fps": -1.0}, "fps"), ({"stop": -1.0}, "stop"),
        ({"stop": 1e14}, "stop is"), ({"start": -1e14}, "start is"),
        ({"stop": float("inf")}, "leave it out"), ({"start": float("nan")}, "start is nan"),
        ({"process": 1}, "both of --processes"), ({"process": 2, "processes": 2}, "from 0"),
        ({"sensor_size": "240"}, "WIDTHxHEIGHT"), ({"sensor_size": "0x5"}, "WIDTHxHEIGHT"),
    ],
)  # fmt: skip
def test_impossible_settings(tmp_path, weights, choice, message):
    with pytest.raises(ValueError, match=message):
        recording = write_recording(tmp_path / "a.txt", 50)
        run(settings(weights, (recording,), tmp_path / "out", **choice))


COUNT_COMPILATIONS = """
import collections, json, sys
import jax
import numpy as np

counts = collections.Counter()
def listen(event, seconds, **info):
    if event == "/jax/core/compile/backend_compile_duration":
        counts[info["fun_name"]] += 1
jax.monitoring.register_event_duration_secs_listener(listen)

import firenet_jax as fj
from firenet_jax import cli

recording, weights, out = sys.argv[1:]
assert cli.main(["reconstruct", recording, "-o", out, "--weights", weights, "-T", "5"]) == 0
rec, w = fj.open_recording(recording), fj.load_weights(weights)
state, shown = fj.initial_state(1, rec.height, rec.width), fj.initial_display_state(1)
sizes = set()
for tensors, times in fj.event_tensors(rec, duration=5):
    state, images = fj.reconstruct(w, state, tensors)
    shown, pictures = fj.display(shown, images)
print(json.dumps(counts))
"""


@EACH_WAY
@pytest.mark.slow
def test_nothing_recompiles_while_200_windows_of_200_sizes_stream(tmp_path, weights):
    """In a fresh process; a grid of 5 ms windows that hold 1, 4, 9, ... 40,000 events."""
    sizes = np.arange(1, 201) * np.arange(1, 201)
    rng = np.random.default_rng(0)
    steps = [np.sort(np.append(rng.integers(0, 5000, size - 1), 0)) for size in sizes]
    t = np.concatenate([5000 * k + step for k, step in enumerate(steps)])
    x, y = rng.integers(0, WIDTH, t.size), rng.integers(0, HEIGHT, t.size)
    recording = tmp_path / "sizes.npy"
    np.save(recording, np.stack([t, x, y, np.ones_like(t)], 1))
    command = [sys.executable, "-c", COUNT_COMPILATIONS, recording, weights, tmp_path / "out"]
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert len(pictures_of(tmp_path / "out")[0]) == 200
    counts = json.loads(done.stdout.splitlines()[-1])
    ours = ("events_to_pictures", "reconstruct", "voxelise", "display", "_set_slot", "_get_slot")
    counted = {name: n for name, n in counts.items() if any(our in name for our in ours)}
    assert len(counted) >= 4, counts  # the listener sees our functions by name
    assert max(counted.values()) <= 3, counts


def test_all_that_pictures_depend_on_is_what_a_run_goes_on_with(tmp_path, weights):
    path = write_recording(tmp_path / "a.txt", 50)

    def record(name="out", normalise=True, **choices):
        network = Weights(load_weights(weights).params, normalise)
        ours = settings(weights, (path,), tmp_path / name, **choices)
        return describe(ours, open_recording(path), network)

    for choice in (
        {"windows": Windows(events=90)}, {"network": Network(recurrent=False)},
        {"display": Display(range="extremes")}, {"preview": True}, {"hot_pixels": "auto"},
        {"flip": True}, {"start": 0.1}, {"stop": 0.5}, {"sensor_size": "30x30"},
        {"normalise": False},
    ):  # fmt: skip
        assert record(**choice) != record(), choice
    for choice in ({"chunk": 2}, {"batch": 3}, {"overwrite": True}):
        assert record(**choice) == record(), choice
    assert record("a.mp4", fps=5.0) != record("a.mp4")


def test_folders_keep_the_dots_in_their_names(tmp_path):
    folders = tmp_path / "run.1", tmp_path / "run.2"
    for folder in folders:
        folder.mkdir()
    assert plan(folders, tmp_path / "out") == [tmp_path / "out/run.1", tmp_path / "out/run.2"]


def test_what_a_run_keeps_for_another_is_true_and_does_not_stay(tmp_path, weights, monkeypatch):
    """Pictures and times that it says are done are on disk by then."""
    monkeypatch.setattr(jobs, "RESUME_EVERY", 0)
    replace, published = os.replace, []

    def seen(source, target):
        if Path(target).name == "resume.npz":
            lines = (Path(target).parent / "timestamps.txt").read_text().splitlines()
            published.append((int(read_arrays(Path(source))["pictures"]), len(lines)))
        replace(source, target)

    monkeypatch.setattr(os, "replace", seen)
    run(settings(weights, (write_recording(tmp_path / "a.txt", 1000),), tmp_path / "out"))
    assert published == [(4, 4), (8, 8)]
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"timestamps.txt", *(f"frame_{n:010d}.png" for n in range(10))}


@EACH_WAY
def test_colours_of_a_recording_that_ends_beside_one_that_goes_on(tmp_path, weights):
    """Windows that do not exist are those of its own channels."""
    paths = [write_recording(tmp_path / f"r{n}.txt", n, seed=n) for n in (800, 600)]
    choices = {"network": Network(color=True)}
    run(settings(weights, tuple(paths), tmp_path / "all", batch=2, **choices))
    for path in paths:
        run(settings(weights, (path,), tmp_path / "alone" / path.stem, **choices))
        together, alone = (pictures_of(tmp_path / n / path.stem)[0] for n in ("all", "alone"))
        assert np.abs(together.astype(int) - alone).max() <= 3


@pytest.mark.skipif(sys.platform == "win32", reason="no locks of this kind")
@pytest.mark.parametrize("seen", [True, False], ids=["already writing", "begins meanwhile"])
@pytest.mark.parametrize("choice", [{}, {"overwrite": True, "windows": Windows(events=90)}])
def test_a_second_run_into_a_folder_touches_nothing(tmp_path, weights, monkeypatch, seen, choice):
    recording, out = write_recording(tmp_path / "a.txt"), tmp_path / "out"
    unfinished(weights, recording, out, monkeypatch)
    partial = tmp_path / "out.partial"
    (partial / "resume.12.npz").write_bytes(b"of the first run, not published yet")
    before = {path.name: path.read_bytes() for path in partial.iterdir()}
    if not seen:  # the second asks for the lock later, in another place
        monkeypatch.setattr(reconstruct.video, "check_free", lambda path: None)
    for output in (out, tmp_path / "out.mp4"):
        if output.suffix:
            (tmp_path / "out.partial.mp4").write_bytes(b"half")
            partial = tmp_path / "out.partial.mp4"
        with locked(partial), pytest.raises(OutputError, match=f"{output}: another run is writing"):
            run(settings(weights, (recording,), output, **choice))
    partial = tmp_path / "out.partial"
    assert before == {path.name: path.read_bytes() for path in partial.iterdir()}
    assert (tmp_path / "out.partial.mp4").read_bytes() == b"half"
    run(settings(weights, (recording,), out))
    assert len(list(out.glob("*.png"))) == 30 and not partial.exists()
    assert {path.suffix for path in out.iterdir()} == {".png", ".txt"}


def test_a_short_recording_is_a_video_and_the_closing_line_says_how(tmp_path, weights, capsys):
    """0.1 s and 90 events, fewer than a window of 0.35 per pixel: 168."""
    text = write_recording(tmp_path / "a.txt", 90).read_text().splitlines()
    rows = [f"{float(line.split()[0]) / 10:.6f} {line.split(maxsplit=1)[1]}" for line in text[1:]]
    (tmp_path / "a.txt").write_text("\n".join([text[0], *rows]) + "\n")
    run(settings(weights, (tmp_path / "a.txt",), tmp_path / "a.mp4", windows=Windows()))
    said = capsys.readouterr().out
    longest = int(1e6 * (float(rows[-1].split()[0]) - float(rows[0].split()[0]))) // 20 / 1000
    assert "of 90 events in" in said
    assert f"windows of 0.35 events per pixel (168), at most {longest:g} ms" in said
    factor = round(40 / longest, 1)
    assert f"; plays {factor:g}" in said and "times slower" in said
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert 15 <= len(list(container.decode(video=0))) <= 21


@pytest.mark.parametrize("names", ["number", "nanoseconds"])
def test_times_that_an_output_cannot_express_end_that_one_alone(tmp_path, weights, names):
    """Before 0: neither ROS nor names of pictures have them."""
    if names == "number":
        pytest.importorskip("rosbags")
    early, usual = (write_recording(tmp_path / name) for name in ("early.txt", "usual.txt"))
    head, *rows = early.read_text().splitlines()
    shifted = (f"{float(t) - 0.5:.6f} {rest}" for t, rest in (row.split(" ", 1) for row in rows))
    early.write_text("\n".join([head, *shifted]) + "\n")
    output = tmp_path / ("out.bag" if names == "number" else "out")
    choice = settings(
        weights, (early, usual), output, names=names, batch=2,
        times=Times(rate=None if names == "number" else 20.0),
    )  # fmt: skip
    with pytest.raises(RecordingError, match=r"early.*; the other recordings are done"):
        run(choice)
    ending = ".bag" if names == "number" else ""
    assert (tmp_path / "out" / f"usual{ending}").exists()
    assert not (tmp_path / "out" / f"early{ending}").exists()


def test_real_time_is_the_default_and_each_event_is_counted_once(tmp_path, weights, capsys):
    recording = write_recording(tmp_path / "a.txt")
    for choice, said in (
        ({}, "; windows of 50 ms, one every 25 ms; plays in real time"),
        ({"speed": 0.5}, "plays 2 times slower"),
        ({"speed": 4.0}, "plays 4 times faster"),
        ({"fps": 10.0}, "plays 4 times slower"),
    ):
        windows = Windows(duration=50, step=25)
        run(settings(weights, (recording,), tmp_path / "a.mp4", windows=windows, overwrite=True,
                     **choice))  # fmt: skip
        line = capsys.readouterr().out
        assert said in line and "of 3,000 events" in line and "Mev/s" not in line
    # Gone in 0.4 s: slower, however it is cut.
    for windows in (Windows(), Windows(duration=5), Windows(events=50)):
        run(settings(weights, (recording,), tmp_path / "a.mp4", windows=windows, overwrite=True,
                     stop=0.1))  # fmt: skip
        assert "plays 8" in capsys.readouterr().out
    with pytest.raises(ValueError, match="fps and speed"):
        settings(weights, (recording,), tmp_path / "a.mp4", fps=5.0, speed=1.0)
    for name, choice, said in (
        ("out", {"speed": 0.5}, "speed: no effect with a folder of pictures"),
        ("a.h5", {"fps": 5.0, "topic": "/a"}, "fps, topic: no effect with a .h5"),
        ("a.bag", {"speed": 1.0}, "speed: no effect with a .bag"),
        ("a.mp4", {"frame_id": "a"}, "frame-id: no effect with a .mp4"),
    ):
        with pytest.raises(SettingsError, match=said):
            settings(weights, (recording,), tmp_path / name, **choice)
    for paths in ((recording,), (recording, recording)):
        for name in ("a.avi", "a.MP4"):
            with pytest.raises(OutputError, match=f"cannot write {Path(name).suffix} files"):
                run(settings(weights, paths, tmp_path / name, fps=25.0))
    assert not (tmp_path / "a.avi").exists()
    with pytest.raises(SettingsError, match="--warm-up has no effect beside --no-recurrent"):
        settings(weights, (recording,), tmp_path / "a", warm_up=9, network=Network(recurrent=False))
    run(settings(weights, (recording,), tmp_path / "one", windows=Windows(events=3000)))
    assert "1 picture of 3,000 events" in capsys.readouterr().out
