"""The demo from end to end, with random weights and at a small size."""

import av
import jax
import numpy as np
import pytest
from PIL import Image

from firenet_jax import cli
from firenet_jax.checkpoint import save_weights
from firenet_jax.commands import demo
from firenet_jax.commands.demo import Demo, run
from firenet_jax.network import Weights, initial_params


@pytest.fixture
def weights(tmp_path):
    path = tmp_path / "weights.npz"
    save_weights(path, Weights(initial_params(jax.random.key(0)), True))
    return path


SMALL = {"seconds": 0.5, "sensor_size": "48x32"}


@pytest.mark.slow
def test_writes_events_reconstruction_and_truth_side_by_side(tmp_path, weights, capsys):
    out = tmp_path / "demo.mp4"
    result = run(Demo(out, weights, **SMALL))
    with av.open(str(out)) as container:
        assert container.streams.video[0].average_rate == 30
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == 15 and frames[0].shape == (32 + demo.CAPTION, 3 * 48, 3)
    events, _, truth = np.split(frames[-1][demo.CAPTION :], 3, axis=1)
    assert events.mean() > 100 and np.ptp(truth.astype(int)) > 50
    # events are coloured, the truth is grey (but for the video's compression)
    assert np.ptp(events.astype(int), -1).max() > 100 > 3 * np.ptp(truth.astype(int), -1).mean()
    assert 0 < result["mse"] < 1 and -1 < result["ssim"] < 1 and result["temporal_error"] >= 0
    printed = capsys.readouterr().out
    assert "15 pictures of 48x32" in printed and f"MSE {result['mse']:.4f}" in printed
    assert "after 10 of warm-up" in printed and "data range 1" in printed
    assert not list(tmp_path.glob("*partial*"))


def test_a_single_picture_has_no_temporal_error(tmp_path, weights, capsys):
    result = run(Demo(tmp_path / "demo.mp4", weights, **SMALL | {"seconds": 0.04}))
    assert set(result) == {"mse", "ssim"} and "temporal" not in capsys.readouterr().out


def test_a_link_stays_and_what_it_points_to_is_written(tmp_path, weights):
    target, link = tmp_path / "target", tmp_path / "link"
    target.mkdir()
    link.symlink_to(target)
    run(Demo(link, weights, **SMALL))
    assert link.is_symlink() and len(list(target.glob("frame_*.png"))) == 15


@pytest.mark.slow
def test_brightness_does_not_jump_where_the_next_windows_are_simulated(
    tmp_path, weights, monkeypatch
):
    found = []
    for at_once in (15, 4):
        monkeypatch.setattr(demo, "WINDOWS_AT_ONCE", at_once)
        out = tmp_path / str(at_once)
        run(Demo(out, weights, **SMALL))
        paths = sorted(out.glob("*.png"))
        found.append([np.asarray(Image.open(path), int)[:, 48:96] for path in paths])
    np.testing.assert_allclose(*found, atol=1)


def test_the_same_seed_gives_the_same(tmp_path, weights):
    results = [run(Demo(tmp_path / f"{n}.mp4", weights, seed=n // 2, **SMALL)) for n in range(3)]
    assert results[0] == results[1] != results[2]


def test_writes_a_folder_of_pictures_and_their_times(tmp_path, weights):
    out = tmp_path / "pictures"
    run(Demo(out, weights, **SMALL))
    assert len(list(out.glob("frame_*.png"))) == 15
    stamps = (out / "timestamps.txt").read_text().split()
    assert stamps[0] == "0.033333" and stamps[-1] == "0.500000"


@pytest.mark.slow
def test_faults_add_events(tmp_path, weights):
    """In the first pictures, those of a scene without faults show fewer coloured pixels."""

    def coloured(path, **changes):
        run(Demo(path, weights, **SMALL, **changes))
        with av.open(str(path)) as container:
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        events = np.stack(frames).astype(int)[:, demo.CAPTION :, :48]
        return (np.ptp(events, -1) > 60).mean()

    assert coloured(tmp_path / "b.mp4", faults=True) > coloured(tmp_path / "a.mp4")


@pytest.mark.parametrize(
    "line, expected",
    [
        ("-o demo.mp4 -c missing.npz", "missing.npz"),
        ("-o demo.avi -c weights.npz", "cannot write .avi"),
        ("-o weights.npz/demo.mp4 -c weights.npz", "cannot make this folder"),
    ],
)
def test_everything_wrong_is_one_sentence(tmp_path, weights, monkeypatch, capsys, line, expected):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["demo", *line.split()]) == 1
    error = capsys.readouterr().err
    assert expected in error and error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["weights.npz"]


@pytest.mark.parametrize(
    "line, expected",
    [
        ("-o demo.mp4 --seconds 0", "seconds is 0.0"),
        ("-o demo.mp4 --fps 0", "fps is 0.0"),
        ("-o demo.mp4 --seconds 0.01", "hold no picture"),
        ("-o demo.mp4 --sensor-size 8x8", "expected 16x16"),
        ("-o demo.mp4 --sensor-size big", "sensor size 'big'"),
        ("-o demo.mp4 --sensor-size 40000x16", "at most 32768"),
        ("-o demo.mp4 --seed -1", "seed is -1"),
    ],
)
def test_settings_that_cannot_be_are_said(capsys, line, expected):
    assert cli.main(["demo", *line.split()]) == 1
    assert expected in " ".join(capsys.readouterr().err.split())


def test_nothing_is_left_of_a_demo_that_is_interrupted(tmp_path, weights, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(demo, "_show", stop)
    line = f"demo -o {tmp_path}/demo.mp4 -c {weights} --seconds 0.5 --sensor-size 48x32"
    assert cli.main(line.split()) == 130
    assert [path.name for path in tmp_path.iterdir()] == ["weights.npz"]


def test_an_interrupted_reconstruction_is_not_lost_to_a_demo(tmp_path, weights, capsys):
    (tmp_path / "out.partial").mkdir()
    (tmp_path / "out.partial" / "resume.npz").write_bytes(b"hours")
    line = f"demo -o {tmp_path}/out -c {weights} --seconds 0.1 --sensor-size 48x32"
    assert cli.main(line.split()) == 1
    assert "holds an unfinished reconstruction" in capsys.readouterr().err
    assert (tmp_path / "out.partial" / "resume.npz").read_bytes() == b"hours"
