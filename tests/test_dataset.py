import json
import math
import os
import sys
from fractions import Fraction
from pathlib import Path

import av
import h5py
import jax
import numpy as np
import pytest
from PIL import Image

from firenet_jax import cli
from firenet_jax.commands import simulate as dataset
from firenet_jax.commands.simulate import Simulate, rounded_flow, run
from firenet_jax.errors import OutputError, PictureError, SettingsError
from firenet_jax.events import Events, concatenate
from firenet_jax.readers import open_recording
from firenet_jax.simulation.clip import read_clip
from firenet_jax.simulation.scenes import SceneSettings
from firenet_jax.simulation.sensor import EPS, SensorSettings, random_sensor
from firenet_jax.simulation.textures import load_textures
from firenet_jax.storage import files, sequence_file
from firenet_jax.storage.arrays import ArraysWriter
from firenet_jax.storage.files import locked, open_alone
from firenet_jax.storage.runs import alone_in
from firenet_jax.storage.sequence_file import Picture, write_sequence
from firenet_jax.storage.video import VideoWriter, write_video
from firenet_jax.warp import warp

HEIGHT, WIDTH = 24, 32


@pytest.fixture(scope="module")
def textures():
    return load_textures(count=4, size=64, procedural=1.0)


@pytest.fixture(autouse=True)
def few_textures(monkeypatch, textures):
    """Textures take longer to draw than the sequences of a test."""
    monkeypatch.setattr(dataset, "load_textures", lambda *_: textures)
    dataset._textures.cache_clear()
    yield
    dataset._textures.cache_clear()


def settings(output, **changes):
    standard = {"sequences": 3, "validation": 1, "seconds": 0.2, "sensor_size": f"{WIDTH}x{HEIGHT}",
                "scene": SceneSettings(speed=(20.0, 100.0))}  # fmt: skip
    return Simulate(output, **(standard | changes))


def random_events(count, seed=0, last=1_000_000):
    rng = np.random.default_rng(seed)
    return Events.of(
        np.sort(rng.integers(0, last, count)),
        rng.integers(0, WIDTH, count),
        rng.integers(0, HEIGHT, count),
        rng.integers(0, 2, count),
    )


def random_pictures(times, seed=0):
    rng = np.random.default_rng(seed)
    return [
        Picture(
            time,
            rng.integers(0, 256, (HEIGHT, WIDTH), np.uint8),
            rng.normal(size=(2, HEIGHT, WIDTH)).astype(np.float32),
        )
        for time in times
    ]


def in_pieces(events, size):
    for start in range(0, len(events), size):
        yield events.select(slice(start, start + size))


def contents(path):
    """Everything in a file: {name: array}, {name: attributes}."""
    arrays, attributes = {}, {}
    with h5py.File(path) as file:
        attributes["/"] = dict(file.attrs)

        def visit(name, item):
            attributes[name] = dict(item.attrs)
            if isinstance(item, h5py.Dataset):
                arrays[name] = item[:]

        file.visititems(visit)
    return arrays, attributes


def same(path, other):
    """Whether two files hold the same arrays and attributes, bit for bit."""
    (arrays, attributes), (others, other_attributes) = contents(path), contents(other)
    return (
        arrays.keys() == others.keys()
        and all(np.array_equal(arrays[name], others[name]) for name in arrays)
        and repr(attributes) == repr(other_attributes)
    )


# ---- Files


@pytest.mark.parametrize("pieces", [7, 1000, 100_000])
def test_what_is_written_is_read_back(tmp_path, monkeypatch, pieces):
    monkeypatch.setattr(sequence_file, "ROWS", 1024)
    events, pictures = random_events(5000), random_pictures([0, 20_000, 500_000, 2_000_000])
    path = tmp_path / "a.h5"
    write_sequence(path, in_pieces(events, pieces), iter(pictures), height=HEIGHT, width=WIDTH)
    recording = open_recording(path)
    assert (recording.height, recording.width, recording.count) == (HEIGHT, WIDTH, 5000)
    read = concatenate(list(recording.events()))
    for name in "txyp":
        np.testing.assert_array_equal(getattr(read, name), getattr(events, name))
    np.testing.assert_array_equal(recording.frames.times, [p.time for p in pictures])
    for i, picture in enumerate(pictures):
        np.testing.assert_array_equal(recording.frames.read(i), picture.image)


def test_the_layout_is_that_of_event_cnn_minimal(tmp_path):
    """Read as a program would that knows only the layout (SEMANTICS 7)."""
    events, pictures = random_events(500), random_pictures([0, 300_000, 600_000])
    events.t[events.t.searchsorted(300_000) :][:3] = 300_000  # at the time of a picture
    path = tmp_path / "a.h5"
    write_sequence(path, [events], pictures, height=HEIGHT, width=WIDTH, source="esim")
    with h5py.File(path) as file:
        columns = {name: file[f"events/{name}"] for name in ("xs", "ys", "ts", "ps")}
        dtypes = [column.dtype for column in columns.values()]
        assert dtypes == [np.int16, np.int16, np.float64, bool]
        assert all(c.compression == "gzip" and c.shuffle for c in columns.values())
        np.testing.assert_allclose(columns["ts"][:], events.t * 1e-6, rtol=1e-12)
        assert list(file["images"]) == [f"image{i:09d}" for i in range(3)]
        assert list(file["flow"]) == [f"flow{i:09d}" for i in range(3)]
        for i, picture in enumerate(pictures):
            image, flow = file[f"images/image{i:09d}"], file[f"flow/flow{i:09d}"]
            assert image.dtype == np.uint8 and tuple(image.attrs["size"]) == (HEIGHT, WIDTH)
            assert image.attrs["timestamp"] == flow.attrs["timestamp"] == 1e-6 * picture.time
            # the first event that is not before the picture
            assert image.attrs["event_idx"] == (events.t < picture.time).sum()
            assert flow.shape == (2, HEIGHT, WIDTH) and flow.dtype == np.float32
            np.testing.assert_array_equal(flow[:], picture.flow)
        facts = file.attrs
        assert tuple(facts["sensor_resolution"]) == (HEIGHT, WIDTH)
        assert facts["num_events"] == 500 and facts["num_pos"] == events.p.sum()
        assert facts["num_neg"] == 500 - events.p.sum()
        assert facts["num_imgs"] == facts["num_flow"] == 3 and facts["source"] == "esim"
        assert facts["t0"] == pytest.approx(1e-6 * events.t[0], abs=1e-9)
        assert facts["tk"] == pytest.approx(1e-6 * events.t[-1], abs=1e-9)
        assert facts["duration"] == pytest.approx(facts["tk"] - facts["t0"])


def test_an_event_has_the_time_of_a_picture_in_the_same_microsecond(tmp_path):
    """Programs look for the first event that is not earlier: 1e-6 * 3 is less than 3 / 1e6."""
    times = np.unique(np.random.default_rng(0).integers(0, 2**40, 300))
    zeros = np.zeros(len(times))
    pictures = [Picture(int(t), np.zeros((HEIGHT, WIDTH), np.uint8), None) for t in times]
    events = Events.of(times, zeros, zeros, zeros)
    write_sequence(tmp_path / "a.h5", [events], pictures, height=HEIGHT, width=WIDTH)
    with h5py.File(tmp_path / "a.h5") as file:
        stamps = [image.attrs["timestamp"] for image in file["images"].values()]
        assert np.array_equal(stamps, file["events/ts"][:])
        assert (file.attrs["t0"], file.attrs["tk"]) == (stamps[0], stamps[-1])


def test_nothing_is_left_of_a_file_that_fails(tmp_path):
    def events():
        yield random_events(100)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_sequence(tmp_path / "a.h5", events(), [], height=HEIGHT, width=WIDTH)
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_one_sentence(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(h5py.Dataset, "resize", full)
    with pytest.raises(OutputError, match="a.h5: cannot write .No space left.*make room"):
        write_sequence(tmp_path / "a.h5", [random_events(9)], [], height=HEIGHT, width=WIDTH)
    assert not list(tmp_path.iterdir())


def test_rounded_flow_is_near_and_compresses():
    rng = np.random.default_rng(0)
    for size in (1e-3, 1.0, 700.0):
        flow = (size * rng.normal(size=(2, 30, 40))).astype(np.float32)
        rounded = rounded_flow(flow)
        assert rounded.dtype == np.float32
        assert np.abs(rounded - flow).max() <= np.abs(flow).max() / 2048
        assert not (rounded.view(np.int32) & 0xFFF).any()  # the low bits are 0
    for flow in (np.zeros((2, 3, 4), np.float32), np.full((2, 3, 4), np.inf, np.float32)):
        np.testing.assert_array_equal(rounded_flow(flow), flow)


# ---- Sequences


def test_a_folder_of_sequences_and_what_they_hold(tmp_path, capsys):
    files = run(settings(tmp_path / "set"))
    assert "2 sequences for training and 1 for validation" in capsys.readouterr().out
    names = ["train/000000.h5", "train/000001.h5", "validation/000000.h5"]
    assert [str(path.relative_to(tmp_path / "set")) for path in files] == names
    found = sorted(str(p.relative_to(tmp_path / "set")) for p in tmp_path.rglob("*.h5"))
    assert found == names
    for path in files:
        recording = open_recording(path)
        assert (recording.height, recording.width) == (HEIGHT, WIDTH)
        np.testing.assert_array_equal(recording.frames.times, np.arange(11) * 20_000)
        events = concatenate(list(recording.events()))
        assert len(events) > 100 and 0 <= events.t[0] and events.t[-1] <= 200_000
        made = json.loads(contents(path)[1]["/"]["settings"])
        assert made["seed"] == 0 and made["number"] == int(path.stem)
        assert made["part"] == path.parent.name and made["scene"]["speed"] == [20.0, 100.0]
    assert not same(files[0], files[1]) and not same(files[0], files[2])


def test_flow_times_the_period_warps_each_picture_onto_the_next(tmp_path):
    waves = np.stack([0.5 + 0.4 * np.sin(np.arange(64) / k) for k in (7.0, 8.0, 9.0, 10.0)])
    smooth = (waves[:, :, None] * waves[:, None, :]).astype(np.float32)
    chosen = settings(tmp_path)
    for seed in range(3):
        _, pictures = dataset.sequence(
            jax.random.key(seed), smooth, chosen, chosen.sensor, HEIGHT, WIDTH
        )
        pictures, moved = list(pictures), 0
        for last, now in zip(pictures, pictures[1:], strict=False):
            displacement = np.moveaxis(now.flow / 50, 0, -1)
            moved = max(moved, np.abs(displacement).max())
            warped, inside = warp(last.image.astype(np.float32) / 255, displacement)
            errors = np.abs(np.asarray(warped) - now.image / 255)[np.asarray(inside)]
            assert np.median(errors) < 0.006  # edges of objects apart
        assert moved > 0.3


def test_the_same_seed_gives_the_same_and_each_sequence_stands_alone(tmp_path):
    run(settings(tmp_path / "a"))
    run(settings(tmp_path / "b", sequences=2))  # fewer: the others are the same
    run(settings(tmp_path / "c", seed=1, sequences=1, validation=0))
    for name in ("train/000000.h5", "validation/000000.h5"):
        assert same(tmp_path / "a" / name, tmp_path / "b" / name)
    assert not same(tmp_path / "a/train/000000.h5", tmp_path / "c/train/000000.h5")


class Interrupted(BaseException):
    pass


def test_an_interrupted_run_goes_on_and_gives_the_same(tmp_path, monkeypatch):
    run(settings(tmp_path / "whole"))
    real, calls = sequence_file._gathered, []

    def gathered(events):
        calls.append(1)
        for part in real(events):
            if len(calls) == 2:
                raise Interrupted
            yield part

    folder = tmp_path / "part"
    monkeypatch.setattr(sequence_file, "_gathered", gathered)
    with pytest.raises(Interrupted):
        run(settings(folder))
    monkeypatch.setattr(sequence_file, "_gathered", real)
    assert [p.name for p in folder.rglob("*.h5")] == ["000000.h5"]
    first = (folder / "train/000000.h5").stat()
    (folder / "train/000001.partial.h5").write_bytes(b"of a run that was killed")
    run(settings(folder))
    assert (folder / "train/000000.h5").stat().st_mtime_ns == first.st_mtime_ns
    assert not list(folder.rglob("*.partial*"))
    for name in ("train/000000.h5", "train/000001.h5", "validation/000000.h5"):
        assert same(folder / name, tmp_path / "whole" / name)


def test_processes_deal_sequences_out_among_them(tmp_path, monkeypatch):
    """Each is made once, whoever makes it; what another one is writing stays; a launcher may say
    which process this is. What a sequence is depends on its number alone, so none is made here."""
    monkeypatch.setattr(dataset, "sequence", lambda *_: (None, None))
    monkeypatch.setattr(dataset, "write_sequence", lambda path, *_, **__: path.write_bytes(b"x"))
    run(settings(tmp_path / "one"))
    folder = tmp_path / "two"
    monkeypatch.setattr(dataset, "PATIENCE", 0)
    with pytest.raises(OutputError, match="settings.json is not there after 0 s: start process 0"):
        run(settings(folder, processes=2, process=1))
    first = run(settings(folder, processes=2, process=0))
    others = folder / "train/000001.partial.h5"
    others.write_bytes(b"half of it")
    run(settings(folder, processes=2, process=0))
    assert others.read_bytes() == b"half of it"
    monkeypatch.setenv("OMPI_COMM_WORLD_RANK", "1")
    monkeypatch.setenv("OMPI_COMM_WORLD_SIZE", "2")
    second = run(settings(folder))
    made = ["train/000000.h5", "validation/000000.h5"], ["train/000001.h5"]
    assert made == tuple([str(p.relative_to(folder)) for p in share] for share in (first, second))
    one, two = ({p.relative_to(f) for p in f.rglob("*")} for f in (tmp_path / "one", folder))
    assert one == two
    with alone_in(folder / "running/1 of 2"), pytest.raises(OutputError, match="another run"):
        run(settings(folder))


@pytest.mark.skipif(sys.platform == "win32", reason="no locks of this kind")
def test_what_another_run_is_writing_is_left_alone(tmp_path):
    run(settings(tmp_path, sequences=1, validation=0))
    partial = tmp_path / "train" / "000001.partial.h5"
    partial.write_bytes(b"half of it")
    with locked(tmp_path), pytest.raises(OutputError, match="another run is writing it"):
        run(settings(tmp_path, sequences=2, validation=0))
    assert partial.read_bytes() == b"half of it"


@pytest.mark.skipif(sys.platform == "win32", reason="no locks of this kind")
def test_runs_of_other_numbers_of_processes_do_not_take_each_others_files(tmp_path):
    """One of two and one alone; one of two and one of three, which want the same sequence."""
    run(settings(tmp_path, sequences=1, validation=0))
    shared = settings(tmp_path, sequences=2, validation=0, processes=2, process=1)
    partial = tmp_path / "train" / "000001.partial.h5"
    with open_alone(partial, tmp_path / "train" / "000001.h5") as opened:
        opened.write(b"half of it")
        with locked(tmp_path, shared=True):
            with pytest.raises(OutputError, match="another run is writing it"):
                run(settings(tmp_path, sequences=2, validation=0))
            with pytest.raises(OutputError, match="000001.h5: another run is writing it"):
                run(shared)
        assert partial.read_bytes() == b"half of it"
        with locked(tmp_path), pytest.raises(OutputError, match="another run is writing it"):
            run(shared)
    run(shared)
    assert not partial.exists() and (tmp_path / "train" / "000001.h5").exists()


def test_a_run_that_could_not_begin_is_begun_again(tmp_path, monkeypatch):
    """Settings are written before any folder, which alone could be anyone's."""

    def full(path, text):
        raise OutputError("no room")

    with monkeypatch.context() as patch, pytest.raises(OutputError, match="no room"):
        patch.setattr("firenet_jax.commands.simulate.write_text", full)
        run(settings(tmp_path / "set", sequences=1, validation=0))
    assert len(run(settings(tmp_path / "set", sequences=1, validation=0))) == 1


@pytest.mark.parametrize("held", [{}, {"seed": 7, "fps": 30}])
def test_settings_of_something_else_stay(tmp_path, held):
    (tmp_path / "settings.json").write_text(json.dumps(held))
    with pytest.raises(OutputError, match="is of something else"):
        run(settings(tmp_path, sequences=1, validation=0))
    assert json.loads((tmp_path / "settings.json").read_text()) == held


def test_a_size_may_be_written_in_several_ways():
    sizes = ("48x40", "48X40", "048x40")
    records = [dataset.describe(Simulate(Path("a"), sensor_size=size)) for size in sizes]
    assert records[0] == records[1] == records[2] and records[0]["sensor_size"] == "48x40"


def test_overwrite_is_of_a_video():
    with pytest.raises(SettingsError, match="overwrite: no effect with simulating scenes"):
        Simulate(Path("set"), overwrite=True)


def test_partial_files_elsewhere_in_a_folder_are_left_alone(tmp_path):
    run(settings(tmp_path, sequences=1, validation=0))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/other.partial.h5").write_bytes(b"mine")
    (tmp_path / "train/000001.partial.h5").write_bytes(b"of a run that was killed")
    run(settings(tmp_path, sequences=2, validation=0))
    assert [path.parent.name for path in tmp_path.rglob("*.partial.h5")] == ["mine"]


@pytest.mark.skipif(sys.platform == "win32", reason="no locks of this kind")
def test_two_runs_cannot_write_one_file(tmp_path):
    path, events = tmp_path / "a.h5", random_events(500)

    def meanwhile():
        yield random_pictures([0])[0]
        with pytest.raises(OutputError, match="a.h5: another run is writing it"):
            write_sequence(
                path, iter([]), iter(random_pictures([0, 9])), height=HEIGHT, width=WIDTH
            )
        yield random_pictures([0, 10])[1]

    write_sequence(path, iter([events]), meanwhile(), height=HEIGHT, width=WIDTH)
    assert concatenate(list(open_recording(path).events())).t.tolist() == events.t.tolist()


@pytest.mark.parametrize("name", ["sequence.h5", "images.h5", "video.mp4"])
def test_a_file_that_another_run_has_just_written_is_not_emptied(tmp_path, monkeypatch, name):
    path = tmp_path / name
    original = files.lock

    def late(handle, given):  # the other run renames it between our opening it and our lock
        files.partial_name(path).replace(path)
        path.write_bytes(b"done")
        original(handle, given)

    monkeypatch.setattr(files, "lock", late)
    with pytest.raises(OutputError, match=f"{name}: another run has just written it"):
        if name == "sequence.h5":
            pictures = iter(random_pictures([0, 9]))
            write_sequence(path, iter([]), pictures, height=HEIGHT, width=WIDTH)
        else:
            ArraysWriter(path) if name == "images.h5" else VideoWriter(path, None)
    assert path.read_bytes() == b"done"


def test_a_run_with_more_sequences_adds_the_others(tmp_path, capsys):
    run(settings(tmp_path, sequences=1, validation=0))
    run(settings(tmp_path, sequences=3, validation=1))
    assert "new: 2, " in capsys.readouterr().out.splitlines()[-1]
    with pytest.raises(OutputError, match="validation holds 1 sequences already, .* want 0"):
        run(settings(tmp_path, sequences=3, validation=0))


def test_one_in_twenty_is_for_validation(tmp_path, monkeypatch):
    """950 and 50 as in the paper; more sequences take none from one part to the other."""
    monkeypatch.setattr(dataset, "write_sequence", lambda path, *_, **__: path.touch() or 0)
    monkeypatch.setattr(dataset, "sequence", lambda *_: ((), ()))
    first = run(settings(tmp_path, sequences=100, validation=None))
    more = run(settings(tmp_path, sequences=1000, validation=None))
    parts = [path.parent.name for path in more]
    assert (parts.count("train"), parts.count("validation")) == (950, 50)
    assert set(first) < set(more) and len(first) == 100


def test_a_disk_without_room_is_said_before_it_is_full(tmp_path, monkeypatch):
    usage = dataset.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(dataset.shutil, "disk_usage", lambda _: usage._replace(free=1000))
    with pytest.raises(OutputError, match="needs about .* MB .*make room or ask for fewer"):
        run(settings(tmp_path / "set"))


# ---- Video files


def ramp(path, count=20, fps=50):
    """Columns whose intensity grows at different speeds, exponentially; lossless."""
    rates = np.linspace(0, 3, WIDTH)  # log intensity per second
    times = np.arange(count) / fps
    logs = np.log(0.2) + times[:, None] * rates
    pictures = np.round(255 * np.exp(logs)).astype(np.uint8)
    pictures = np.repeat(pictures[:, None], HEIGHT, 1)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=fps)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "gray"
        for number, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(picture, format="gray")
            frame.pts = number
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return pictures


def test_a_clip_becomes_the_events_of_its_log_intensity(tmp_path, capsys):
    clip = tmp_path / "ramp.mkv"
    pictures = ramp(clip)
    out = tmp_path / "out.h5"
    line = f"simulate -o {out} --video {clip} --threshold 0.2 --threshold-spread 0 --refractory 0"
    assert cli.main(line.split()) == 0
    recording = open_recording(out)
    assert (recording.height, recording.width) == (HEIGHT, WIDTH)
    np.testing.assert_allclose(recording.frames.times, np.arange(20) * 20_000, atol=500)
    for i in (0, 7, 19):
        np.testing.assert_array_equal(recording.frames.read(i), pictures[i])
    events = concatenate(list(recording.events()))
    assert events.p.all()
    log = np.log(EPS + pictures[:, 0] / 255)
    expected = np.floor((log[-1] - log[0]) / 0.2)
    counts = np.zeros((HEIGHT, WIDTH), int)
    np.add.at(counts, (events.y, events.x), 1)
    np.testing.assert_array_equal(counts, np.tile(expected.astype(int), (HEIGHT, 1)))
    assert expected.max() >= 5
    # The first event of the fastest column lies where the log intensity, linear between the
    # pictures, has grown by one threshold.
    x = WIDTH - 1
    first = events.t[events.x == x].min()
    assert first == pytest.approx(np.interp(log[0, x] + 0.2, log[:, x], recording.frames.times),
                                  abs=20)  # fmt: skip
    with h5py.File(out) as file:
        assert "flow" not in file and file.attrs["num_flow"] == 0
        made_from = json.loads(file.attrs["settings"])
    assert made_from["sensor"]["threshold"] == 0.2 and made_from["video"] == clip.name
    assert not {"seconds", "fps", "images", "scene"} & set(made_from)
    assert "events of 32x24 pixels" in capsys.readouterr().out
    assert cli.main(line.split()) == 1  # exists
    assert cli.main([*line.split(), "--overwrite", "--sensor-size", "16x12"]) == 0
    assert open_recording(out).width == 16


@pytest.mark.parametrize("suffix", ["mp4", "gif"])
def test_clips_of_common_formats_reach_from_black_to_white(tmp_path, suffix):
    levels = [0, 30, 128, 200, 255]
    pictures = [np.full((HEIGHT, WIDTH), level, np.uint8) for level in levels]
    clip = tmp_path / f"levels.{suffix}"
    write_video(clip, pictures, fps=10)
    read = list(read_clip(clip))
    np.testing.assert_allclose([p.image.mean() for p in read], levels, atol=3)
    assert np.diff([p.time for p in read]) == pytest.approx(1e5)


@pytest.mark.parametrize("codec, options", [("libx264", {}), ("mpeg4", {"bf": "2"})])
def test_pictures_of_an_avi_come_in_the_order_in_which_they_are_shown(tmp_path, codec, options):
    """They are stored in another one, and it says no other times."""
    clip, levels = tmp_path / "a.avi", 10 * np.arange(20) + 20
    with av.open(str(clip), "w") as container:
        stream = container.add_stream(codec, rate=50, options=options)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.bit_rate = 4_000_000
        for level in levels:
            picture = np.full((48, 64), level, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="gray")))
        container.mux(stream.encode(None))
    read = list(read_clip(clip))
    assert [picture.time for picture in read] == list(range(0, 400_000, 20_000))
    np.testing.assert_allclose([picture.image.mean() for picture in read], levels, atol=6)


@pytest.mark.parametrize(
    "matrix, shown",
    [
        ((0, 1, -1, 0), lambda stored: np.rot90(stored, -1)),
        ((-1, 0, 0, -1), lambda stored: np.rot90(stored, 2)),
        ((0, -1, 1, 0), np.rot90),
        ((-1, 0, 0, 1), np.fliplr),  # of its front camera
        ((1, 0, 0, -1), np.flipud),
        ((0, 1, 1, 0), np.transpose),
        ((0, -1, -1, 0), lambda stored: np.rot90(stored.T, 2)),
    ],
)
def test_clips_of_a_telephone_are_upright(tmp_path, matrix, shown):
    """It writes what its sensor sees, and how a player should rotate it (ISO 14496-12, tkhd)."""
    clip = tmp_path / "a.mp4"
    ramp = np.add.outer(5 * np.arange(32), np.arange(64)).astype(np.uint8)
    write_video(clip, [ramp, ramp], fps=10)
    data = bytearray(clip.read_bytes())
    a, b, c, d = (65536 * entry for entry in matrix)
    rows = np.array([a, b, 0, c, d, 0, 0, 0, 1 << 30], ">i4").tobytes()
    start = data.index(b"tkhd") + 44
    assert len(rows) == 36 and data[start : start + 4] == b"\0\1\0\0"
    data[start : start + 36] = rows
    clip.write_bytes(data)
    first, _ = (picture.image for picture in read_clip(clip))
    expected = shown(ramp)
    assert first.shape == expected.shape
    assert np.abs(first.astype(int) - expected).max() <= 6
    small, _ = (picture.image for picture in read_clip(clip, (20, 12)))
    assert small.shape == (20, 12)
    assert np.sign(np.diff(small.mean(0).astype(int)[[1, -2]])) == np.sign(
        np.diff(expected.mean(0)[[1, -2]])
    )


# ---- What is wrong


def bad_lines(folder):
    """(command line, what the message must contain)"""
    (folder / "empty").mkdir()
    (folder / "taken").mkdir()
    (folder / "taken/letter.txt").write_text("mine")
    (folder / "file").write_text("mine")
    (folder / "clip.mp4").write_bytes(b"no video at all" * 50)
    (folder / "events.txt").write_text("0.1 3 2 1\n" * 500)
    Image.fromarray(np.zeros((16, 16), np.uint8)).save(folder / "one.png")
    (folder / "damaged").mkdir()
    (folder / "damaged/settings.json").write_text("{")
    (folder / "run/data").mkdir(parents=True)
    (folder / "run/settings.json").write_text('{"crop": 96, "seed": 3}')
    (folder / "run/data/other.partial.h5").write_text("another program's")
    run(settings(folder / "other", sequences=1, validation=0))
    with av.open(str(folder / "sound.wav"), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), "s16", "mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
    return [
        ("-o taken", "is not empty"),
        ("-o file", "choose another name"),
        ("-o a.h5", "go into a folder"),
        ("-o file/set", "cannot make this folder"),
        ("-o damaged", "is damaged"),
        ("-o run", "settings.json is of something else (it says crop): choose another output"),
        ("-o other", "scene.speed was [20.0, 100.0], now [3.0, 1000.0], seconds was 0.2, now 2.0"),
        ("-o out --video clip.mp4", "out.h5"),
        ("-o out.h5 --video clip.mp4", "cannot be read as a video"),
        ("-o out.h5 --video missing.mp4", "cannot be read as a video"),
        ("-o out.h5 --video empty", "cannot be read as a video"),
        ("-o out.h5 --video sound.wav", "holds no video"),
        ("-o out.h5 --video events.txt", "holds no video"),
        ("-o out.h5 --video one.png", "fewer than two pictures"),
    ]


def test_everything_wrong_is_one_sentence(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    lines = bad_lines(tmp_path)
    capsys.readouterr()
    for line, expected in lines:
        code = cli.main(["simulate", *line.split()])
        error = capsys.readouterr().err
        assert code == 1 and expected in error and error.count("\n") == 1, (line, error)
    assert list(tmp_path.rglob("*partial*")) == [tmp_path / "run/data/other.partial.h5"]
    assert (tmp_path / "run/settings.json").read_text() == '{"crop": 96, "seed": 3}'
    assert not (tmp_path / "out.h5").exists()
    assert (tmp_path / "taken/letter.txt").read_text() == "mine"


@pytest.mark.parametrize(
    "line, expected",
    [
        ("-o new --seconds 0", "seconds is 0.0"),
        ("-o new --seconds 3600", "make more sequences"),
        ("-o new --fps 0", "fps is 0.0"),
        ("-o new --seconds 0.1 --fps 3", "is a single image"),
        ("-o new --sequences 0", "sequences is 0"),
        ("-o new --validation 2000", "validation is 2000"),
        ("-o new --sensor-size big", "sensor size 'big'"),
        ("-o new --sensor-size 40000x16", "at most 32768"),
        ("-o new --seed -1", "seed is -1"),
        ("-o new --refractory 2.5", "a refractory period of 2.5 s, but at most 2.1 s"),
        ("-o new --refractory-range .001 5", "a refractory period of 5 s"),
        ("-o new --asymmetry .3 --faults", "--asymmetry has no effect without --threshold-range"),
        ("-o new --noise-in-light .1 .5", "--noise-in-light has no effect without --noise"),
        (
            "-o new --cutoff-dark .5 --faults --cutoff 0 0",
            "--cutoff-dark has no effect without --cutoff",
        ),
        (
            "-o new.h5 --video clip.mp4 --fps 5 --objects 7",
            "fps, objects: no effect with turning",
        ),
        ("-o new.h5 --video clip.mp4 --flicker .1 .9", "too far apart to show it"),
        (
            "-o new.h5 --video clip.mp4 --process 1 --processes 2",
            "process, processes: no effect with turning",
        ),
    ],
)
def test_settings_that_cannot_be_are_said(capsys, line, expected):
    assert cli.main(["simulate", *line.split()]) == 1
    assert expected in " ".join(capsys.readouterr().err.split())


def test_a_folder_without_pictures_is_one_sentence(tmp_path, monkeypatch, capsys):
    (tmp_path / "pictures").mkdir()
    with monkeypatch.context() as patch:
        patch.setattr(dataset, "load_textures", load_textures)
        for name in ("pictures", "missing"):
            line = ["simulate", "-o", str(tmp_path / "set"), "--images", str(tmp_path / name)]
            assert cli.main(line) == 1
            assert name in capsys.readouterr().err
            assert not (tmp_path / "set").exists()
    run(settings(tmp_path / "set", sequences=1, validation=0))  # nothing stands in the way


def test_a_lamp_flickers_at_its_own_rate(tmp_path):
    """Not at a beat with renderings that are too far apart: the strongest rate in the events."""
    sensor = SensorSettings(flicker=(0.8, 0.8))
    chosen = settings(tmp_path, seconds=0.5, scene=SceneSettings(speed=(1.0, 1.0), pause=0.0))
    textures, key = dataset._textures(None, 0, 0, 0), jax.random.key(0)
    events, _ = dataset.sequence(key, textures, chosen, sensor, HEIGHT, WIDTH)
    events = concatenate(list(events))
    lamp = random_sensor(jax.random.split(key)[1], height=2, width=2, settings=sensor).lamp
    signs = np.where(events.p, 1.0, -1.0)
    added = np.histogram(events.t, 500, (0, 500_000), weights=signs)[0]
    rates, strength = np.fft.rfftfreq(500, 1e-3), np.abs(np.fft.rfft(added))
    assert abs(rates[strength.argmax()] - float(lamp.hertz)) < 2.1


def test_number_of_pictures_follows_the_duration(tmp_path):
    chosen = settings(tmp_path, seconds=0.25, fps=30.0)
    textures = dataset._textures(None, 0, 0, 0)
    _, pictures = dataset.sequence(
        jax.random.key(0), textures, chosen, chosen.sensor, HEIGHT, WIDTH
    )
    times = [picture.time for picture in pictures]
    assert len(times) == math.floor(0.25 * 30) + 1 and times[:2] == [0, 33_333]


def test_a_clip_that_is_cut_short_is_said(tmp_path, caplog):
    clip, out = tmp_path / "a.mkv", tmp_path / "a.h5"
    ramp(clip, count=40)
    line = f"simulate --video {clip} -o {out} --overwrite".split()
    assert cli.main(line) == 0 and not caplog.text
    clip.write_bytes(clip.read_bytes()[: clip.stat().st_size // 2])
    assert cli.main(line) == 0
    assert "but it says that it lasts" in caplog.text and str(clip) in caplog.text


def test_a_gif_whose_last_picture_is_held_is_whole(tmp_path, caplog):
    pictures = [Image.new("L", (WIDTH, HEIGHT), 20 * n) for n in range(10)]
    held = [50] * 9 + [3000]  # milliseconds
    pictures[0].save(tmp_path / "a.gif", save_all=True, append_images=pictures[1:], duration=held)
    run(Simulate(tmp_path / "a.h5", video=tmp_path / "a.gif"))
    assert "is it whole" not in caplog.text


def test_clips_with_what_pyav_does_not_know(tmp_path):
    """Camera settings in each picture of a motion JPEG: some side data more."""
    exif = Image.Exif()
    exif[271] = "maker"
    clip = tmp_path / "a.mjpeg"
    for level in (30, 200):
        part = tmp_path / "part.jpg"
        Image.new("L", (WIDTH, HEIGHT), level).save(part, exif=exif)
        with clip.open("ab") as file:
            file.write(part.read_bytes())
    np.testing.assert_allclose([p.image.mean() for p in read_clip(clip)], [30, 200], atol=3)


@pytest.mark.skipif(sys.platform == "win32", reason="no named pipes")
def test_a_clip_from_a_pipe_or_in_place_of_the_output_is_refused(tmp_path):
    os.mkfifo(tmp_path / "a.mkv")
    with pytest.raises(PictureError, match="is a pipe or device"):
        run(Simulate(tmp_path / "a.h5", video=tmp_path / "a.mkv"))
    clip = tmp_path / "b.mkv"
    ramp(clip, count=3)
    clip.rename(tmp_path / "b.h5")
    with pytest.raises(OutputError, match="is a recording that is read"):
        run(Simulate(tmp_path / "b.h5", video=tmp_path / "b.h5", overwrite=True))


def test_noise_does_not_depend_on_the_rate_of_a_clip(tmp_path):
    """Ten events a second of each pixel in the dark: of five pictures, and of 50."""
    counts = []
    for fps in (5, 50):
        clip, out = tmp_path / f"{fps}.mp4", tmp_path / f"{fps}.h5"
        write_video(clip, [np.zeros((HEIGHT, WIDTH), np.uint8)] * (2 * fps + 1), fps=fps)
        sensor = SensorSettings(noise=(10.0, 10.0))
        run(Simulate(out, video=clip, sensor=sensor))
        counts.append(sum(map(len, open_recording(out).events())))
    expected = 2 * 10 * HEIGHT * WIDTH
    assert np.abs(np.array(counts) - expected).max() < 4 * np.sqrt(expected)


def test_training_and_validation_choose_from_other_textures(tmp_path, monkeypatch):
    """And after as many sequences as share them, from others again."""
    chosen, made = set(), load_textures(count=2, size=16, procedural=1.0)

    def drawn(*args):
        chosen.add(args[-1])  # the seed
        return made

    monkeypatch.setattr(dataset, "SEQUENCES_PER_POOL", 2)
    monkeypatch.setattr(dataset, "load_textures", drawn)
    monkeypatch.setattr(dataset, "write_sequence", lambda path, *_, **__: path.touch() or 0)
    monkeypatch.setattr(dataset, "sequence", lambda key, textures, *_: ((), ()))
    run(settings(tmp_path / "set", sequences=6, validation=2))
    assert len(chosen) == 3  # two of training, one of validation


def test_a_clip_may_have_a_colon_in_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ramp(tmp_path / "clip.mkv", count=3)
    (tmp_path / "clip.mkv").rename("12:00.mkv")
    assert len(list(read_clip(Path("12:00.mkv")))) == 3


def test_a_clip_whose_size_changes_is_one_sentence(tmp_path):
    path = tmp_path / "change.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mjpeg", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuvj420p"
        smaller = av.CodecContext.create("mjpeg", "w")
        smaller.width, smaller.height, smaller.pix_fmt = 32, 24, "yuvj420p"
        smaller.time_base = stream.time_base = Fraction(1, 25)
        for number in range(6):
            encoder, size = (stream, (48, 64, 3)) if number < 4 else (smaller, (24, 32, 3))
            frame = av.VideoFrame.from_ndarray(np.full(size, 90, np.uint8), format="rgb24")
            frame.pts, frame.time_base = number, Fraction(1, 25)
            for packet in encoder.encode(frame.reformat(format="yuvj420p")):
                packet.stream = stream
                container.mux(packet)
    with pytest.raises(PictureError, match="picture 5 has 32x24 pixels, those before 64x48"):
        list(read_clip(path))
    assert {picture.image.shape for picture in read_clip(path, (24, 32))} == {(24, 32)}


def test_times_of_a_clip_count_from_its_first_picture(tmp_path):
    clip = tmp_path / "cut.mkv"
    with av.open(str(clip), "w") as container:
        stream = container.add_stream("ffv1", rate=50)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "gray"
        for number in (10, 11, 13):
            picture = np.full((HEIGHT, WIDTH), 100, np.uint8)
            frame = av.VideoFrame.from_ndarray(picture, format="gray")
            frame.pts = number
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    assert [picture.time for picture in read_clip(clip)] == [0, 20_000, 60_000]
