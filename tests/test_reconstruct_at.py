"""`firenet reconstruct` at given times: against `images_at`, alone, together and interrupted."""

import av
import h5py
import numpy as np
import pytest
from PIL import Image
from test_pipeline import (
    HEIGHT,
    WIDTH,
    Interrupted,
    interrupt_after,
    pictures_of,
    settings,
    weights,  # noqa: F401
    write_recording,
)

from firenet_jax.checkpoint import load_weights
from firenet_jax.commands import jobs
from firenet_jax.commands.reconstruct import Reconstruct, run
from firenet_jax.commands.times import Times
from firenet_jax.errors import RecordingError
from firenet_jax.instants import grid
from firenet_jax.network import Weights
from firenet_jax.pictures import Display, display, initial_display_state
from firenet_jax.readers import open_recording
from firenet_jax.reconstruction import images_at
from firenet_jax.storage.video import FolderWriter
from firenet_jax.windows import Windows


def stamps_of(folder):
    lines = (folder / "timestamps.txt").read_text().splitlines()
    assert lines[0] == "# index time_us events"
    return np.array([[int(word) for word in line.split()] for line in lines[1:]])


def series(weights, path, rate, count=100):  # noqa: F811
    """(times, images) of a grid from the first event on"""
    recording = open_recording(path)
    first = int(next(recording.events()).t[0])
    found = list(images_at(load_weights(weights), recording, grid(first, rate), events=count))
    return [np.concatenate(column) for column in zip(*found, strict=True)]


def test_folder_and_arrays_hold_the_images_and_their_times(tmp_path, weights, capsys):  # noqa: F811
    recording = write_recording(tmp_path / "a.txt", 1500)
    for name in ("out", "images.h5"):
        run(settings(weights, (recording,), tmp_path / name, times=Times(rate=37.0)))
    said = capsys.readouterr().out
    assert "37 pictures of 1,500 events" in said
    assert "images at 37 per second, the state by windows of 100 events" in said
    times, images = series(weights, recording, 37.0)
    with h5py.File(tmp_path / "images.h5") as file:
        np.testing.assert_allclose(file["images"], images, atol=1e-6)
        assert file["times"][:].tolist() == times.tolist()
        events = file["events"][:].tolist()
    stamps = stamps_of(tmp_path / "out")
    assert stamps[:, 0].tolist() == list(range(37)) and stamps[:, 1].tolist() == times.tolist()
    assert stamps[:, 2].tolist() == events and set(events[5:]) <= {99, 100, 101}
    shown = display(initial_display_state(1), images[:, None])[1][:, 0]
    assert np.abs(pictures_of(tmp_path / "out")[0].astype(int) - shown).max() <= 1


def test_a_batch_gives_what_each_recording_gives_alone(tmp_path, weights):  # noqa: F811
    paths = [write_recording(tmp_path / f"r{n}.txt", n, seed=n) for n in (700, 1050, 400)]
    choices = {"times": Times(rate=11.0), "preview": True}
    run(settings(weights, tuple(paths), tmp_path / "all", batch=2, **choices))
    for path in paths:
        run(settings(weights, (path,), tmp_path / "alone" / path.stem, **choices))
        together, stamps = pictures_of(tmp_path / "all" / path.stem)
        alone, expected = pictures_of(tmp_path / "alone" / path.stem)
        assert stamps == expected and together.shape == (11, HEIGHT, 2 * WIDTH, 3)
        assert np.abs(together.astype(int) - alone).max() <= 1


@pytest.mark.parametrize("names", ["number", "nanoseconds"])
def test_an_interrupted_run_goes_on_and_gives_the_same(tmp_path, weights, monkeypatch, names):  # noqa: F811
    recording = write_recording(tmp_path / "a.txt", 1500)
    choices = {"times": Times(rate=29.0), "display": Display(range="extremes"), "names": names}
    run(settings(weights, (recording,), tmp_path / "whole", **choices))
    with monkeypatch.context() as patch:
        patch.setattr(jobs, "RESUME_EVERY", 0)
        interrupt_after(patch, 13)
        with pytest.raises(Interrupted):
            run(settings(weights, (recording,), tmp_path / "out", **choices))
    written, write = [], FolderWriter.write

    def counted(self, *args):
        written.append(self.count)
        write(self, *args)

    monkeypatch.setattr(FolderWriter, "write", counted)
    other = choices | {"times": Times(rate=30.0)}
    with pytest.raises(ValueError, match="unfinished run of other settings"):
        run(settings(weights, (recording,), tmp_path / "out", **other))
    run(settings(weights, (recording,), tmp_path / "out", **choices))
    assert 8 <= written[0] <= 13 and written[-1] == 28
    expected, actual = (sorted((tmp_path / name).iterdir()) for name in ("whole", "out"))
    assert [path.name for path in actual] == [path.name for path in expected]
    for ours, theirs in zip(actual, expected, strict=True):
        if ours.suffix == ".png":
            with Image.open(ours) as a, Image.open(theirs) as b:
                np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
        else:
            assert ours.read_text() == theirs.read_text()


def test_a_rate_counts_from_the_first_event_that_is_no_hot_pixels(tmp_path, weights):  # noqa: F811
    rows = write_recording(tmp_path / "a.txt", 2000).read_text().splitlines()
    early = f"{float(rows[1].split()[0]) - 0.01:.6f} 3 4 1"
    (tmp_path / "a.txt").write_text("\n".join([rows[0], early, *rows[1:]]) + "\n")
    (tmp_path / "hot.txt").write_text("3,4\n")
    choice = {"times": Times(rate=50), "hot_pixels": str(tmp_path / "hot.txt")}
    run(settings(weights, (tmp_path / "a.txt",), tmp_path / "out", **choice))
    first = next(row for row in rows[1:] if row.split()[1:3] != ["3", "4"])
    assert stamps_of(tmp_path / "out")[0][1] == round(1e6 * float(first.split()[0]))


def test_a_video_keeps_the_times(tmp_path, weights):  # noqa: F811
    """A tenth as fast, at times that are not even."""
    recording = write_recording(tmp_path / "a.txt", 800)
    wanted = [0.1, 0.101, 0.35, 0.5004, 0.9]
    (tmp_path / "times.txt").write_text("".join(f"{time}s\n" for time in wanted))
    at = Times(at=tmp_path / "times.txt", since="zero")
    run(settings(weights, (recording,), tmp_path / "a.mp4", times=at, speed=0.1))
    with av.open(str(tmp_path / "a.mp4")) as container:
        found = [frame.time for frame in container.decode(video=0)]
    np.testing.assert_allclose(found, 10 * (np.array(wanted) - wanted[0]), atol=2e-5)


def test_a_mistyped_list_leaves_no_folder(tmp_path, weights):  # noqa: F811
    recording, nothing = write_recording(tmp_path / "a.txt", 50), tmp_path / "none"
    for wrong in ({"times": Times(at=nothing)}, {"hot_pixels": str(nothing)}):
        with pytest.raises(RecordingError, match="none: there is no such file or folder"):
            run(settings(weights, (recording,), tmp_path / "new/a.mp4", **wrong))
    assert not (tmp_path / "new").exists()


def test_times_outside_of_a_recording(tmp_path, weights, caplog):  # noqa: F811
    recording = write_recording(tmp_path / "a.txt", 500)
    for text, name in (("-5s\n0.5s\n7s\n8s\n", "some"), ("7s\n", "none")):
        (tmp_path / name).write_text(text)
    some, none = (Times(at=tmp_path / n, since="zero") for n in ("some", "none"))
    run(settings(weights, (recording,), tmp_path / "out", times=some))
    assert "times without an image: 1 before the first event, 2 after the last" in caplog.text
    assert stamps_of(tmp_path / "out")[:, 1].tolist() == [500_000]
    with pytest.raises(RecordingError, match="none of the requested times lies within it"):
        run(settings(weights, (recording,), tmp_path / "other", times=none))
    assert not (tmp_path / "other").exists()
    with pytest.raises(RecordingError, match="a.txt: has no frames"):
        run(settings(weights, (recording,), tmp_path / "other", times=Times(between_frames=True)))


@pytest.mark.parametrize(
    "choice, said",
    [
        ({"windows": Windows(frame_to_frame=True)}, "not between frames"),
        ({"windows": Windows(events=9, step=3)}, "do not overlap"),
        ({"times": Times(), "names": "nanoseconds"}, "where it is chosen"),
        ({"topic": "a b"}, "topic is"),
        ({"preview": True, "output": "a.h5"}, "as the network gives them"),
        ({"display": Display(bilateral=25), "output": "a.h5"}, "as the network gives them"),
        ({"display": Display(range="fixed"), "output": "a.h5"}, "as the network gives them"),
        ({"names": "nanoseconds", "output": "a.mp4"}, "holds no png files"),
    ],
)
def test_impossible_settings(tmp_path, weights, choice, said):  # noqa: F811
    choice = {"times": Times(rate=5.0), "output": "out"} | choice
    output = tmp_path / choice.pop("output")
    with pytest.raises(ValueError, match=said):
        settings(weights, (tmp_path / "a.txt",), output, **choice)


def test_real_frames_have_images_at_their_times(tmp_path, recordings):
    """Those of the Event Camera Dataset, of which the first comes before the events."""
    run(Reconstruct((recordings / "ecd_slider_depth",), tmp_path / "out",
        times=Times(between_frames=True), stop=0.08))  # fmt: skip
    times = open_recording(recordings / "ecd_slider_depth").frames.times
    assert stamps_of(tmp_path / "out")[:, 1].tolist() == times[1:3].tolist()


def test_weights_that_take_tensors_as_they_are(weights, tmp_path):  # noqa: F811
    recording = open_recording(write_recording(tmp_path / "a.txt", 300))
    plain = Weights(load_weights(weights).params, False)
    ((times, images),) = images_at(plain, recording, [500_000], events=100)
    assert times.tolist() == [500_000] and np.isfinite(images).all()
