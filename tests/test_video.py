import os
import sys
from pathlib import Path

import av
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from firenet_jax.storage.files import OutputError
from firenet_jax.storage.video import (
    FolderWriter,
    VideoWriter,
    check_output,
    open_writer,
    write_video,
)


def ramp(count=6, height=30, width=41):
    base = np.add.outer(np.arange(height), np.arange(width))
    return [(base * 2 + 10 * k).astype(np.uint8) for k in range(count)]


def decoded(path):
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def test_folder_holds_exact_pngs_and_times(tmp_path):
    writer = FolderWriter(tmp_path / "out")
    for k, picture in enumerate(ramp()):
        writer.write(picture, 1_700_000_000_000_001 + k)
        assert not (tmp_path / "out").exists()
    writer.finish()
    for k, picture in enumerate(ramp()):
        with Image.open(tmp_path / "out" / f"frame_{k:010d}.png") as image:
            np.testing.assert_array_equal(np.asarray(image), picture)
    stamps = (tmp_path / "out" / "timestamps.txt").read_text().splitlines()
    assert stamps[0] == "1700000000.000001" and len(stamps) == 6
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]


def test_folder_goes_on_where_it_stopped(tmp_path):
    pictures = ramp()
    writer = FolderWriter(tmp_path / "out")
    for k in range(5):  # two more than will be kept
        writer.write(pictures[k], k)
    writer.abandon()
    writer = FolderWriter(tmp_path / "out")
    writer.keep(3)
    writer.write(pictures[3], 3)
    for name in ("resume.npz", "resume.4.npz"):
        (writer.partial / name).write_bytes(b"a position, and one that was not published")
    writer.finish()
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"timestamps.txt", *(f"frame_{k:010d}.png" for k in range(4))}
    stamps = (tmp_path / "out" / "timestamps.txt").read_text().split()
    assert stamps == [f"0.00000{k}" for k in range(4)]


@pytest.mark.skipif(sys.platform == "win32", reason="no locks of this kind")
@pytest.mark.parametrize("name", ["out", "out.mp4"])
def test_two_runs_do_not_write_the_same_output(tmp_path, name):
    first = open_writer(tmp_path / name, 30)
    first.write(ramp()[0], 0)
    with pytest.raises(OutputError, match=f"{name}: another run is writing it"):
        open_writer(tmp_path / name, 30)
    first.write(ramp()[1], 1)
    first.finish()
    if name == "out":
        assert (tmp_path / name / "timestamps.txt").read_text() == "0.000000\n0.000001\n"
    else:
        assert len(decoded(tmp_path / name)) == 2
    open_writer(tmp_path / name, 30).abandon()  # nobody holds it now


@pytest.mark.parametrize("name", ["out", "out.mp4", "out.gif"])
@pytest.mark.parametrize(
    "pictures, said",
    [
        ([], "no pictures"),
        ([np.zeros((8, 8), np.float32)], "picture 1 is float32"),
        ([np.zeros((8, 8), bool)], "picture 1 is bool"),
        ([np.zeros((0, 8), np.uint8)], "picture 1 is uint8 of the shape .0, 8"),
        ([np.zeros((8, 8, 4), np.uint8)], "picture 1 is uint8 of the shape .8, 8, 4"),
        ([np.zeros((8, 8), np.uint8), np.zeros((8, 9), np.uint8)], "picture 2 is"),
    ],
)
def test_pictures_that_cannot_be_written(tmp_path, name, pictures, said):
    with pytest.raises(ValueError, match=said):
        write_video(tmp_path / name, pictures)
    assert not (tmp_path / name).exists()


def test_a_finished_folder_is_replaced_whole(tmp_path):
    for count in (6, 2):
        write_video(tmp_path / "out", ramp(count))
        assert len(list((tmp_path / "out").iterdir())) == count + 1
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
@pytest.mark.parametrize("colour, lost", [(False, 0.9), (True, 2.2)])
def test_videos_decode_to_what_was_written(tmp_path, suffix, colour, lost):
    """lost: levels of an mp4, on average 0.6 and in colour 1.7; at half the quality 1.3 and 2.7."""
    pictures = ramp()
    if colour:  # a few flat colours, as in the event pictures
        pictures = [np.stack([p // 64 * 64, p * 0, p * 0 + 200], -1) for p in pictures]
    path = tmp_path / f"video{suffix}"
    write_video(path, pictures, fps=25)
    written = np.stack([p if colour else np.stack([p] * 3, -1) for p in pictures])
    if suffix == ".mp4":  # its sides are even: the last column is there twice
        written = np.pad(written, ((0, 0), (0, 0), (0, 1), (0, 0)), mode="edge")
    frames = np.stack(decoded(path))
    assert frames.shape == written.shape
    difference = np.abs(frames.astype(int) - written)
    assert difference.mean() < lost if suffix == ".mp4" else difference.max() <= 1
    with av.open(str(path)) as container:
        assert float(container.streams.video[0].average_rate) == pytest.approx(25, rel=0.01)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_what_has_one_colour_has_one_in_a_gif_of_too_many(tmp_path):
    """It is not dithered: noise would move over what stands still."""
    colours = np.random.default_rng(0).integers(0, 256, (20, 30, 3), np.uint8)
    write_video(tmp_path / "a.gif", [colours.repeat(4, 0).repeat(4, 1)])
    blocks = decoded(tmp_path / "a.gif")[0].reshape(20, 4, 30, 4, 3).astype(int)
    assert np.ptp(blocks, (1, 3)).max() == 0
    assert np.abs(blocks[:, 0, :, 0] - colours).mean() < 20


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_the_same_pictures_give_the_same_bytes(tmp_path, suffix):
    rng = np.random.default_rng(0)
    blocks = np.kron(rng.integers(0, 128, (40, 40)), np.ones((8, 8), int))
    moving = [np.roll(blocks, (k, 2 * k), (0, 1))[:180, :240] for k in range(12)]
    pictures = [(still + rng.integers(0, 60, still.shape)).astype(np.uint8) for still in moving]
    files = [tmp_path / f"{number}{suffix}" for number in range(16)]
    for path in files:
        write_video(path, pictures)
    assert len({path.read_bytes() for path in files}) == 1


def test_a_video_may_be_named_by_a_time_of_day(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # FFmpeg takes what precedes a colon for a protocol
    write_video(Path("12:00.mp4"), ramp(), fps=30)
    assert len(decoded(tmp_path / "12:00.mp4")) == 6


def test_an_abandoned_video_leaves_nothing(tmp_path):
    writer = VideoWriter(tmp_path / "video.mp4", 30)
    writer.write(ramp()[0])
    writer.abandon()
    assert list(tmp_path.iterdir()) == []


def test_an_error_on_the_way_leaves_nothing_under_the_final_name(tmp_path):
    def pictures():
        yield ramp()[0]
        raise ZeroDivisionError

    for name in ("video.mp4", "folder"):
        with pytest.raises(ZeroDivisionError):
            write_video(tmp_path / name, pictures())
        assert not (tmp_path / name).exists()


def test_outputs_that_cannot_be(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "movie.mp4").write_text("")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("")
    (tmp_path / "stills").mkdir()
    (tmp_path / "stills" / "frame_0000000000.png").write_text("")
    write_video(tmp_path / "mixed", ramp(1))
    (tmp_path / "mixed" / "events.txt").write_text("")  # a recording, which must not be lost
    for name, overwrite, message in [
        ("video.avi", False, "cannot write .avi"),
        ("file", True, "is a file"),
        ("movie.mp4", False, "pass --overwrite"),
        ("mine", False, "pass --overwrite"),
        ("mine", True, "holds thesis.tex, which this program did not write"),
        ("mixed", True, "holds events.txt, which this program did not write"),
        ("VIDEO.MP4", False, "cannot write .MP4"),
        ("stills", True, "holds frame_0000000000.png, which"),
    ]:
        with pytest.raises(OutputError, match=message):
            check_output(tmp_path / name, overwrite)
    check_output(tmp_path / "movie.mp4", overwrite=True)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes")
@pytest.mark.parametrize("name", ["out", "out.mp4"])
def test_a_pipe_is_no_output(tmp_path, name):
    os.mkfifo(tmp_path / name)
    with pytest.raises(OutputError, match="is a pipe or device"):
        check_output(tmp_path / name, overwrite=True)


def test_a_dot_makes_no_file_of_a_folder(tmp_path):
    for name in ("out_0.35", "run.1"):
        check_output(tmp_path / name, overwrite=False)
        write_video(tmp_path / name, ramp(2))
        assert len(list((tmp_path / name).iterdir())) == 3


def test_a_mounted_disk_is_no_output(tmp_path, monkeypatch):
    (tmp_path / "disk").mkdir()
    monkeypatch.setattr(os.path, "ismount", lambda path: Path(path).name == "disk")
    with pytest.raises(OutputError, match="choose a folder in it"):
        check_output(tmp_path / "disk", overwrite=False)


@pytest.mark.parametrize("suffix", ["", ".gif"])
def test_a_link_stays_and_what_it_points_to_is_written(tmp_path, suffix):
    target, link = tmp_path / f"target{suffix}", tmp_path / f"link{suffix}"
    if not suffix:
        target.mkdir()
    link.symlink_to(target)
    for count in (3, 2):
        write_video(link, ramp(count))
        assert link.is_symlink() and target.exists()
    assert {path.name for path in tmp_path.iterdir()} == {link.name, target.name}


def test_a_video_is_not_a_link_to_a_folder(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "link.mp4").symlink_to(tmp_path / "folder")
    with pytest.raises(OutputError, match="is a folder: choose another name for the video"):
        write_video(tmp_path / "link.mp4", ramp(2))


@pytest.mark.parametrize("name", [".", ".."])
def test_the_folder_one_is_in_is_no_output(tmp_path, monkeypatch, name):
    """It would be replaced, and who is in it would see nothing."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    with pytest.raises(OutputError, match="is the folder that you are in"):
        write_video(name, ramp(2))


def test_what_is_not_ours_beside_an_output_stays(tmp_path):
    (tmp_path / "out.partial").mkdir()
    for name in ("notes.txt", "frame_old.png"):
        (tmp_path / "out.partial" / name).write_text("mine")
        with pytest.raises(OutputError, match=f"out.partial holds {name}, which is not of an"):
            write_video(tmp_path / "out", ramp(2))
        assert (tmp_path / "out.partial" / name).read_text() == "mine"
        (tmp_path / "out.partial" / name).unlink()
    (tmp_path / "out.partial" / "frame_0000000009.png").write_text("of an earlier run")
    write_video(tmp_path / "out", ramp(2))
    assert len(list((tmp_path / "out").iterdir())) == 3


@pytest.mark.parametrize("killed_at", [1, 2])
def test_a_folder_is_not_lost_to_a_run_that_is_killed_while_it_replaces_it(
    tmp_path, monkeypatch, killed_at
):
    write_video(tmp_path / "out", ramp(4))
    rename, calls = Path.rename, []

    def killed(self, target):
        calls.append(target)
        if len(calls) == killed_at:
            raise KeyboardInterrupt
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", killed)
    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "out", ramp(2))
    monkeypatch.undo()
    writer = open_writer(tmp_path / "out")
    assert len(list((tmp_path / "out").glob("*.png"))) == 4  # whole, and back where it was
    writer.abandon()
    write_video(tmp_path / "out", ramp(3))
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert len(list((tmp_path / "out").glob("*.png"))) == 3


def test_replacing_a_folder_minds_what_lies_beside_it(tmp_path):
    (tmp_path / "out.old").mkdir()
    (tmp_path / "out.old" / "mine.txt").write_text("")
    for _ in range(2):
        write_video(tmp_path / "out", ramp(2))
    assert {path.name for path in tmp_path.iterdir()} == {"out", "out.old"}


def test_times_before_zero(tmp_path):
    writer = FolderWriter(tmp_path / "out")
    for time in (-1_000_001, -1, 0, 1_500_000):
        writer.write(ramp(1)[0], time)
    writer.finish()
    stamps = (tmp_path / "out" / "timestamps.txt").read_text().split()
    assert stamps == ["-1.000001", "-0.000001", "0.000000", "1.500000"]


@pytest.mark.parametrize("fps", [0.0, 1e-4, 1e300, float("inf"), float("nan")])
def test_rates_that_cannot_be(tmp_path, fps):
    with pytest.raises(OutputError, match="must be between 0.01 and 10000"):
        write_video(tmp_path / "a.mp4", ramp(), fps=fps)
    assert not list(tmp_path.iterdir())


def test_colours_are_those_that_an_mp4_says(tmp_path):
    """PyAV's own conversion takes the matrix that the file names; 720 lines without one are read
    by many as of HD, where red has a green of 23."""
    color = np.broadcast_to(np.array([255, 0, 0], np.uint8), (720, 64, 3))
    write_video(tmp_path / "a.mp4", [color])
    with av.open(str(tmp_path / "a.mp4")) as container:
        codec = container.streams.video[0].codec_context
        assert (codec.colorspace, codec.color_range) == (6, 1)
        assert (codec.color_primaries, codec.color_trc) == (1, 13)
    assert np.abs(decoded(tmp_path / "a.mp4")[0] - color.astype(int)).max() <= 3


@pytest.mark.parametrize("kind", ["mp4", "gif"])
@pytest.mark.parametrize("step", [0.1, 2.5])
def test_the_last_picture_stays_as_long_as_the_one_before(tmp_path, kind, step):
    writer = VideoWriter(tmp_path / f"a.{kind}", None)
    for number, picture in enumerate(ramp(7)):
        writer.write(picture, round(1e6 * step * number))
    writer.finish()
    with av.open(str(tmp_path / f"a.{kind}")) as container:
        frames = list(container.decode(video=0))
        shown = [float(frame.duration * frame.time_base) for frame in frames]
        assert container.duration == pytest.approx(7e6 * step, abs=1e3)
    assert shown == pytest.approx([step] * 7)


@pytest.mark.parametrize("fps, count", [(3000, 101), (5000, 7), (10_000, 3)])
def test_a_video_of_any_rate_shows_all_of_its_pictures(tmp_path, fps, count):
    pictures = np.random.default_rng(0).integers(0, 256, (count, 24, 32)).astype(np.uint8)
    write_video(tmp_path / "a.mp4", pictures, fps)
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert len(list(container.decode(video=0))) == count


@pytest.mark.parametrize("name", ["a.partial.mp4", "a.partial"])
def test_an_output_is_not_what_another_is_made_in(tmp_path, name):
    with pytest.raises(OutputError, match=f"{name}: .partial names what is not finished"):
        check_output(tmp_path / name, overwrite=True)


def test_a_gif_has_a_greatest_rate(tmp_path):
    write_video(tmp_path / "quick.gif", ramp(), fps=50)
    with pytest.raises(OutputError, match="at most 50 pictures per second"):
        write_video(tmp_path / "quicker.gif", ramp(), fps=60)


@pytest.mark.parametrize("fps", [29.97, 0.5])
def test_a_rate_need_not_be_whole(tmp_path, fps):
    write_video(tmp_path / "a.mp4", ramp(), fps=fps)
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert float(container.streams.video[0].average_rate) == pytest.approx(fps, rel=1e-4)


def test_a_rate_may_be_a_number_of_numpy_or_jax(tmp_path):
    """As where it is computed from times; in float32 times would lose microseconds."""
    pictures = np.zeros((60, 2, 2), np.uint8)
    write_video(tmp_path / "expected", pictures, fps=3)
    for rate in (np.float32(3), jnp.float32(3)):
        write_video(tmp_path / "a.gif", pictures[:2], fps=rate)
        write_video(tmp_path / "found", pictures, fps=rate)
        times = [(tmp_path / name / "timestamps.txt").read_text() for name in ("found", "expected")]
        assert times[0] == times[1]


def test_pictures_without_events_have_the_times_of_their_rate(tmp_path):
    write_video(tmp_path / "out", ramp(3), fps=25)
    stamps = (tmp_path / "out" / "timestamps.txt").read_text().split()
    assert stamps == ["0.000000", "0.040000", "0.080000"]


def test_a_folder_that_may_not_be_written_to_is_said_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)  # root may always
    with pytest.raises(OutputError, match="is not writable: choose another output"):
        check_output(tmp_path / "out", overwrite=False)


def test_a_link_to_itself_is_no_output(tmp_path):
    (tmp_path / "out").symlink_to(tmp_path / "out")
    with pytest.raises(OutputError, match="out: points to itself: choose another output"):
        write_video(tmp_path / "out", ramp(1))
    assert (tmp_path / "out").is_symlink()


@pytest.mark.parametrize("name, speed", [("a.mp4", 1.0), ("a.mp4", 0.25), ("a.gif", 1.0)])
def test_pictures_are_shown_at_their_times(tmp_path, name, speed):
    times = np.cumsum([0, 40_000, 40_000, 30_000, 100_000, 20_000]) + 1_700_000_000_000_000
    writer = open_writer(tmp_path / name, speed=speed)
    for picture, time in zip(ramp(6), times, strict=True):
        writer.write(picture, int(time))
    writer.finish()
    assert writer.slower == pytest.approx(1 / speed)
    with av.open(str(tmp_path / name)) as container:
        shown = [float(frame.pts * frame.time_base) for frame in container.decode(video=0)]
    np.testing.assert_allclose(shown, (times - times[0]) / 1e6 / speed, atol=1e-4)


def test_pictures_closer_than_a_gif_can_tell_play_slower(tmp_path):
    writer = open_writer(tmp_path / "a.gif")
    for number, picture in enumerate(ramp(5)):
        writer.write(picture, 10_000 * number)  # a gif's players show 50 per second at most
    writer.finish()
    assert writer.slower == pytest.approx(2)


@pytest.mark.parametrize("name, most", [("a.mp4", 2**28 / 90_000), ("a.gif", 655.35)])
def test_pauses_longer_than_a_video_can_hold_are_cut(tmp_path, name, most, caplog):
    """As of a clock that was set to today's time while it recorded, and once more."""
    today = 1_700_000_000_000_000
    times = [0, 40_000, today, today + 40_000, 2 * today + 50_000, 2 * today + 110_000]
    writer = open_writer(tmp_path / name)
    for picture, time in zip(ramp(6), times, strict=True):
        writer.write(picture, int(time))
    writer.finish()
    with av.open(str(tmp_path / name)) as container:
        shown = [float(frame.pts * frame.time_base) for frame in container.decode(video=0)]
    pauses = np.array([0, 0, 1, 1, 2, 2])
    np.testing.assert_allclose(shown, [0, 0.04, 0.04, 0.08, 0.08, 0.14] + most * pauses, atol=1e-3)
    assert caplog.text.count("pauses are cut to") == 1


def test_pictures_that_are_too_wide_for_an_mp4_are_said_to_be(tmp_path):
    wide = np.zeros((2, 16_400), np.uint8)
    with pytest.raises(OutputError, match="a.mp4: pictures of 16400x2 are too large .*: choose"):
        write_video(tmp_path / "a.mp4", [wide])
    write_video(tmp_path / "a.gif", [wide])
    write_video(tmp_path / "b.mp4", [wide[:, :16_384]])


def test_what_the_encoder_refuses_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr("firenet_jax.storage.video.LONGEST_STEP", {".mp4": 2**40})
    writer = open_writer(tmp_path / "a.mp4")
    with pytest.raises(OutputError, match="a.mp4: cannot be encoded"):
        for number, picture in enumerate(ramp(100)):
            writer.write(picture, 36_000_000_000 * number)
        writer.finish()
    writer.abandon()
