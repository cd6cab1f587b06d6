"""Recordings with frames: what is learnt from them, what is held out, how the end is judged."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_train import begun, entries, tiny

import firenet_jax as fj
from firenet_jax import cli
from firenet_jax.checkpoint import save_weights
from firenet_jax.commands.train import run
from firenet_jax.errors import FirenetError, OutputError, RecordingError, SettingsError
from firenet_jax.evaluation import metrics
from firenet_jax.events import Events, concatenate
from firenet_jax.network import Weights, initial_params
from firenet_jax.readers import open_recording
from firenet_jax.simulation.sequences import Simulation
from firenet_jax.storage.files import locked
from firenet_jax.storage.sequence_file import Picture, write_sequence
from firenet_jax.training import recordings
from firenet_jax.training.batches import Augment
from firenet_jax.training.settings import Train
from firenet_jax.training.step import initial_train_state, loss_of, near_events, train_step

SIZE, FRAMES, EVERY = 40, 20, 10_000
ZERO = 1_600_000_000_000_000  # microseconds since 1970, as DAVIS cameras count


def write_folder(path, frames=FRAMES, seed=0):
    """An ECD folder of noise: events before the first frame and after the last one too."""
    from PIL import Image

    rng = np.random.default_rng(seed)
    (path / "images").mkdir(parents=True)
    times = ZERO + 5_000 + EVERY * np.arange(frames)
    lines = []
    for number, time in enumerate(times):
        name = f"images/frame_{number:08d}.png"
        Image.fromarray(rng.integers(0, 256, (SIZE, SIZE), np.uint8)).save(path / name)
        lines.append(f"{time // 10**6}.{time % 10**6:06d} {name}\n")
    (path / "images.txt").write_text("".join(lines))
    t = np.sort(ZERO + rng.integers(0, frames * EVERY, 4000))
    t[100:103] = times[3]  # at the time of a frame: of the window that begins there
    t.sort()
    x, y, p = rng.integers(0, (SIZE, SIZE, 2), (4000, 3)).T
    x[0], y[0] = SIZE - 1, SIZE - 1
    (path / "events.txt").write_text(
        "".join(
            f"{t // 10**6}.{t % 10**6:06d} {x} {y} {p}\n"
            for t, x, y, p in zip(t, x, y, p, strict=True)
        )
    )
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_folder(tmp_path_factory.mktemp("recordings") / "noise")


def all_events(path):
    return concatenate(list(open_recording(path).events()))


def test_the_parts_hold_what_the_recording_holds_between_its_frames(tmp_path, folder):
    settings = tiny(tmp_path / "run", data=(folder,))
    recordings.write_sequences([recordings.cut_off(folder, settings.windows)], settings)
    parts = settings.sequences / "000_noise.h5", settings.sequences / "validation/000_noise.h5"
    whole = open_recording(folder)
    events, times = all_events(folder), whole.frames.times
    # 19 windows: 3 are held out, a fifth, which is as many as a step has
    for path, first, last in zip(parts, (0, 16), (16, 19), strict=True):
        part, found = open_recording(path), all_events(path)
        inside = events.select((times[first] <= events.t) & (events.t < times[last]))
        assert part.frames.times.tolist() == (times[first : last + 1] - times[first]).tolist()
        for name in "xyp":
            np.testing.assert_array_equal(getattr(found, name), getattr(inside, name))
        np.testing.assert_array_equal(found.t, inside.t - times[first])
        for n in range(last - first + 1):
            np.testing.assert_array_equal(part.frames.read(n), whole.frames.read(first + n))


@pytest.mark.parametrize("frames, windows, end", [(50, 3, 40), (50, 21, 28), (8, 3, 4)])
def test_a_fifth_is_held_out_and_no_fewer_windows_than_a_step_has(tmp_path, frames, windows, end):
    assert recordings.cut_off(write_folder(tmp_path / "a", frames), windows).end == end


def test_recordings_that_cannot_be_learnt_from_are_said(tmp_path, folder):
    (tmp_path / "events.txt").write_text("40 40\n0.1 3 3 1\n0.2 3 3 0\n")
    with pytest.raises(RecordingError, match="holds no frames to learn from"):
        recordings.cut_off(tmp_path / "events.txt", 3)
    with pytest.raises(RecordingError, match="has 20 frames, but 22 are needed.*fewer --windows"):
        recordings.cut_off(folder, 10)
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "readme.md").touch()
    with pytest.raises(RecordingError, match="notes: holds no HDF5 sequences"):
        recordings.cut_off(tmp_path / "notes", 3)
    (tmp_path / "set").mkdir()
    write_sequence(tmp_path / "set" / "a.h5", [Events.of([5], [1], [1], [1])],
                   [Picture(t, np.zeros((8, 8), np.uint8), None) for t in (0, 10_000)],
                   height=8, width=8)  # fmt: skip
    with pytest.raises(RecordingError, match="set: is a folder of HDF5 sequences, of which .* one"):
        recordings.cut_off(tmp_path / "set", 3)
    write_folder(tmp_path / "both", 20)  # with what somebody made of it
    write_sequence(tmp_path / "both" / "a.h5", [Events.of([5], [1], [1], [1])],
                   [Picture(t, np.zeros((8, 8), np.uint8), None) for t in (0, 10_000)],
                   height=8, width=8)  # fmt: skip
    assert recordings.cut_off(tmp_path / "both", 3).end > 0
    with pytest.raises(SettingsError, match="--near-events has no effect beside --voxel-noise"):
        tiny(tmp_path, data=(folder,), near_events=True, augment=Augment(voxel_noise=0.1))
    assert recordings.cut_off(folder, 9).end == 10
    backwards = tmp_path / "backwards.h5"
    pictures = [Picture(t, np.zeros((8, 8), np.uint8), None) for t in (0, 20_000, 10_000)]
    write_sequence(backwards, [Events.of([5], [1], [1], [1])], pictures, height=8, width=8)
    with pytest.raises(RecordingError, match="frame 3: its time is 10000 us, not after 20000 us"):
        recordings.cut_off(backwards, 1)
    with pytest.raises(SettingsError, match="by one process"):
        run(tiny(tmp_path / "run", data=(folder,), processes=2, process=0,
                       coordinator="127.0.0.1:1"))  # fmt: skip


def test_processes_of_a_launcher_do_not_write_the_same_files(tmp_path, folder, monkeypatch):
    monkeypatch.setenv("OMPI_COMM_WORLD_RANK", "1")
    monkeypatch.setenv("OMPI_COMM_WORLD_SIZE", "2")
    with pytest.raises(SettingsError, match="by one process"):
        run(tiny(tmp_path / "run", data=(folder,)))
    assert not (tmp_path / "run").exists()


def write_pictures(path, times, events, size=24):
    """An HDF5 sequence of grey pictures at these times, in microseconds."""
    pictures = [Picture(t, np.full((size, size), k, np.uint8), None) for k, t in enumerate(times)]
    nothing = [0] * len(events)
    write_sequence(
        path, [Events.of(events, nothing, nothing, nothing)], pictures, height=size, width=size
    )
    return path


@pytest.mark.parametrize(
    "events, said",
    [
        ([900_000, 990_000], "no overlap in time: frames 0.000000 to 0.190000 s, events from 0.9"),
        ([], "no events: "),
        # of 20 frames, those from number 17 on, at 160 ms, are held out
        ([165_000, 170_000], "no events from 0.000000 to 0.160000 s, between the frames to learn"),
        ([5_000, 70_000], "no events from 0.160000 to 0.190000 s, between the frames held out"),
    ],
)
def test_events_that_share_no_time_with_the_frames_are_said(tmp_path, events, said):
    times = range(0, 200_000, 10_000)
    path = write_pictures(tmp_path / "a.h5", times, events)
    with pytest.raises(RecordingError, match=f"{path}: {said}"):
        run(tiny(tmp_path / "run", data=(path,), crop=16))
    assert not list((tmp_path / "run").rglob("*.h5"))


@pytest.mark.parametrize("number", [0, 7, 19])
def test_a_frame_of_another_size_is_said(tmp_path, number):
    from PIL import Image

    path = write_folder(tmp_path / "a")
    image = path / f"images/frame_{number:08d}.png"
    with Image.open(image) as picture:
        smaller = picture.resize((SIZE - 1, SIZE - 2))
    smaller.save(image)
    (path / "events.txt").write_text(f"{SIZE} {SIZE}\n" + (path / "events.txt").read_text())
    said = f"{path}, frame {number + 1}: has 39x38 pixels, the sensor 40x40, expected the same"
    with pytest.raises(RecordingError, match=said):
        run(tiny(tmp_path / "run", data=(path,)))
    assert not list((tmp_path / "run").rglob("*.h5"))
    if number:  # the first is not judged, as no window ends there
        recording = open_recording(path)
        one = recordings.Cut(recording, recording.frames, number - 1)
        with pytest.raises(RecordingError, match=said):
            recordings.judged(Weights(initial_params(jax.random.key(0)), True), one, near=False)


def test_a_run_keeps_to_its_recordings(tmp_path, folder):
    other = write_folder(tmp_path / "other", seed=1)
    settings = tiny(tmp_path / "run", data=(folder,))
    recordings.write_sequences([recordings.cut_off(folder, 3)], settings)
    written = {path: path.stat().st_mtime_ns for path in settings.sequences.rglob("*.h5")}
    recordings.write_sequences([recordings.cut_off(folder, 3)], settings)
    assert {p: p.stat().st_mtime_ns for p in settings.sequences.rglob("*.h5")} == written
    path = settings.sequences / "settings.json"
    record = json.loads(path.read_text())
    record["recordings"][0].append(123)  # as runs of before wrote: a time, which copies have not
    path.write_text(json.dumps(record))
    recordings.write_sequences([recordings.cut_off(folder, 3)], settings)
    assert {p: p.stat().st_mtime_ns for p in settings.sequences.rglob("*.h5")} == written
    for data, windows in (((other,), 3), ((folder,), 5)):
        changed = dataclasses.replace(settings, data=data)
        with pytest.raises(OutputError, match="holds sequences of others"):
            cuts = [recordings.cut_off(path, windows) for path in data]
            recordings.write_sequences(cuts, changed)


@pytest.mark.parametrize(
    "choices, said",
    [
        ({"crop": SIZE + 1}, "noise: its frames have 40x40 pixels, fewer than the crop of 41x41"),
        ({"chain": 6}, "noise: has 17 frames to learn from, .* 18 windows in a row need 19"),
        ({"weights": "plus.npz"}, "plus.npz expects tensors that are not normalised"),
        ({"weights": "missing.npz"}, "missing.npz"),
        ({"batch": 3}, "shared by 2 devices"),
    ],
)
def test_a_start_that_is_refused_writes_no_sequences(tmp_path, folder, monkeypatch, choices, said):
    monkeypatch.chdir(tmp_path)
    if "batch" in choices:
        monkeypatch.setattr(jax, "device_count", lambda: 2)
    save_weights("plus.npz", Weights(initial_params(jax.random.key(0)), normalise=False))
    settings = tiny(tmp_path / "run", data=(folder,), **choices)
    with pytest.raises(FirenetError, match=said):
        run(settings)
    assert not settings.sequences.exists()


def test_no_sequences_are_written_into_the_folder_of_another_run(tmp_path, folder):
    begun(tmp_path / "run", tiny(tmp_path / "run"))
    settings = tiny(tmp_path / "run", data=(folder,))
    with pytest.raises(OutputError, match="holds a run with other settings"):
        run(settings)
    with locked(tmp_path / "run"), pytest.raises(OutputError, match="another run is writing it"):
        (tmp_path / "run/settings.json").unlink()
        run(settings)
    assert not settings.sequences.exists()


def test_a_folder_of_sequences_is_no_recording(tmp_path, folder):
    (tmp_path / "set/validation").mkdir(parents=True)
    (tmp_path / "set/validation/a.h5").touch()
    sets = Train(tmp_path / "run", data=(tmp_path / "set",))
    assert not sets.on_recordings and sets.sequences == tmp_path / "set"
    one = Train(tmp_path / "run", data=(folder,))
    assert one.on_recordings and one.sequences == tmp_path / "run/sequences"
    assert not Train(tmp_path / "run").on_recordings


def test_near_events_are_those_within_four_pixels_in_this_window_or_before():
    rng = np.random.default_rng(0)
    tensors = np.where(rng.random((4, 2, 24, 30, 5)) < 2e-4, -0.5, 0).astype(np.float32)
    expected = np.zeros(tensors.shape[:-1], bool)
    for t, b, y, x in np.argwhere((tensors != 0).any(-1)):
        expected[t:, b, max(0, y - 4) : y + 5, max(0, x - 4) : x + 5] = True
    assert 0 < expected.mean() < 0.9
    np.testing.assert_array_equal(near_events(jnp.asarray(tensors)), expected)


@pytest.mark.slow
def test_what_no_event_tells_of_teaches_brightness_alone(tmp_path):
    """Other details of frames where nothing happens: the same gradients; where events are: others.
    And the image is held where nothing happens: a brighter frame has another gradient."""
    settings = tiny(tmp_path, near_events=True).step_settings
    rng = np.random.default_rng(0)
    tensors = np.zeros((3, 1, 32, 32, 5), np.float32)
    tensors[:, :, :8, :8] = rng.normal(size=(3, 1, 8, 8, 5))
    images = rng.random((3, 1, 32, 32)).astype(np.float32)
    params = initial_params(jax.random.key(0))

    @jax.jit
    def of_images(images):
        still = jnp.zeros((3, 1, 32, 32, 2)), jnp.zeros((3, 1, 32, 32), bool)
        data = Simulation(jnp.asarray(tensors), images, *still)
        return jax.grad(lambda p: loss_of(p, data, None, False, settings)[0])(params)

    def gradient(images):
        leaves = jax.tree.leaves(of_images(images.astype(np.float32)))
        return np.concatenate([np.ravel(leaf) for leaf in leaves])

    far, close = images.copy(), images.copy()
    far[..., 12:, :] = far[..., 12:, ::-1]
    close[..., :8, :8] = 1 - close[..., :8, :8]
    first = gradient(images)
    np.testing.assert_allclose(gradient(far), first, atol=1e-5)
    brighter = np.where(np.arange(32)[:, None] < 12, images, images + 0.2)
    assert np.abs(gradient(brighter) - first).max() > 1e-4
    assert np.abs(gradient(close) - first).max() > 1e-4


@pytest.mark.slow
def test_what_is_near_events_stays_so_through_a_chain(tmp_path):
    """Two steps of a sequence, events in the first one's corner alone: there the frames of the
    second count as they are, and those of a new sequence after it do not."""
    settings = tiny(tmp_path, near_events=True, chain=2, batch=1, warmup=0).step_settings
    rng = np.random.default_rng(0)
    images = rng.random((3, 1, 32, 32)).astype(np.float32)
    close, still = images.copy(), (jnp.zeros((3, 1, 32, 32, 2)), jnp.zeros((3, 1, 32, 32), bool))
    close[..., :8, :8] = close[..., :8, 7::-1]  # of the same mean
    silent = np.zeros((3, 1, 32, 32, 5), np.float32)
    corner = silent.copy()
    corner[:, :, :8, :8] = rng.normal(size=(3, 1, 8, 8, 5))

    def loss_after(tensors, pictures):
        """Of the last of these steps."""
        state, terms = initial_train_state(initial_params(jax.random.key(0)), settings, False), {}
        for one, shown in zip(tensors, pictures, strict=True):
            state, terms = train_step(state, Simulation(one, shown, *still), settings)
        return float(terms["loss"])

    first, second = loss_after([corner, silent], [images] * 2), [images, close]
    assert abs(loss_after([corner, silent], second) - first) > 1e-4
    third = loss_after([corner, silent, silent], [images] * 3)
    assert abs(loss_after([corner, silent, silent], [images, images, close]) - third) < 1e-5


@pytest.mark.parametrize("warm", [10_000_000, 55_000])
def test_the_end_is_judged_as_reconstruct_shows_it(folder, monkeypatch, warm):
    """Against the public functions, from the first window or from a later one on."""
    monkeypatch.setattr(recordings, "JUDGED_BEFORE", warm)
    weights = Weights(initial_params(jax.random.key(1)), True)
    one = recordings.cut_off(folder, 5)  # frames 15 to 19 are judged
    begin = max(0, one.end - -(-warm // EVERY) + (warm % EVERY > 0))
    recording, times = one.recording, one.frames.times
    events = all_events(folder)
    state = fj.initial_state(1, SIZE, SIZE)
    expected = []
    for n in range(begin + 1, FRAMES):
        inside = events.select((times[n - 1] <= events.t) & (events.t < times[n]))
        tensor = fj.voxelise(fj.pack([[inside]]), height=SIZE, width=SIZE)
        state, image = fj.reconstruct(weights, state, tensor)
        if n > one.end:
            truth = recording.frames.read(n) / np.float32(255)
            expected.append(float(metrics.ssim(np.clip(image[0, 0], 0, 1), truth)))
    score = recordings.judged(weights, one, near=False)
    assert score.frames == len(expected) == 5
    assert abs(score.ssim - np.mean(expected)) < 1e-5


def test_an_end_without_events_is_judged_by_nothing(tmp_path):
    pictures = [Picture(10_000 * k, np.full((24, 24), k, np.uint8), None) for k in range(8)]
    path, events = tmp_path / "a.h5", Events.of([5, 79_000], [0, 0], [0, 0], [1, 1])
    write_sequence(path, [events], pictures, height=24, width=24)
    weights = Weights(initial_params(jax.random.key(1)), True)
    one = recordings.cut_off(path, 3)
    assert recordings.judged(weights, one, near=False).frames == 3
    whole = recordings.judged(weights, one._replace(end=0), near=True)
    assert whole.frames == 0 and np.isnan(whole.ssim)  # the corner: no window of SSIM is there
    assert recordings.judged(weights, one._replace(end=7), near=False).frames == 0


def test_weights_that_are_gone_are_not_judged(tmp_path, folder, capsys, caplog):
    settings = tiny(tmp_path / "run", data=(folder,), weights=tmp_path / "gone.npz")
    (tmp_path / "run").mkdir()
    params = initial_params(jax.random.key(1))
    save_weights(tmp_path / "run/weights.npz", Weights(params, True))
    recordings.print_scores([recordings.cut_off(folder, 3)], settings)
    said = capsys.readouterr().out
    assert "of the 3 frames held out" in said and " before" not in said
    assert "gone.npz does not exist" in caplog.text


@pytest.mark.slow
def test_training_on_a_recording_tells_before_and_after(tmp_path, folder, capsys):
    line = ["train", "-o", str(tmp_path / "run"), "--data", str(folder), str(folder / "../noise")]
    line += ["--weights", "built-in", "--steps", "4", "--crop", "32", "--windows", "3"]
    line += ["--l0", "1", "--near-events", "--log-every", "1", "--validate-every", "2"]
    assert cli.main(line) == 0
    said = capsys.readouterr().out.splitlines()[-2:]
    for sentence in said:
        assert "SSIM where events were of the 3 frames held out" in sentence
        assert " before, " in sentence and " after" in sentence
    kinds = [entry["kind"] for entry in entries(tmp_path / "run")]
    assert kinds.count("train") == 4 and kinds.count("validation") == 2
    record = json.loads((tmp_path / "run/settings.json").read_text())
    assert len(record["data"]) == 2
    assert cli.main(line) == 0  # it is done: judged again
    assert capsys.readouterr().out.splitlines()[-2:] == said
