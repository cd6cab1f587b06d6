"""Textures: photographs and drawings, folders that hold them, pictures that cannot be used."""

import numpy as np
import pytest
from PIL import Image

from firenet_jax.simulation import textures as module
from firenet_jax.simulation.textures import HELD_OUT, PROCEDURAL, load_textures, photographs


def test_wheel_photographs_are_there():
    assert len(photographs()) >= 10


def test_textures_without_a_folder():
    textures = load_textures(count=12, size=64, seed=3)
    assert textures.shape == (12, 64, 64) and textures.dtype == np.float32
    assert textures.min() >= 0 and textures.max() <= 1 and textures.std((1, 2)).min() > 0.01
    np.testing.assert_array_equal(textures, load_textures(count=12, size=64, seed=3))
    assert np.abs(textures - load_textures(count=12, size=64, seed=4)).mean() > 0.05


@pytest.mark.parametrize("kind", PROCEDURAL)
def test_procedural_textures(kind):
    made = [PROCEDURAL[kind](np.random.default_rng(seed), 80) for seed in (0, 0, 1)]
    for texture in made:
        assert texture.shape == (80, 80) and texture.min() >= 0 and texture.max() <= 1
        assert texture.std() > 0.03
    np.testing.assert_array_equal(made[0], made[1])
    assert np.abs(made[0] - made[2]).mean() > 0.03


def picture(path, height=90, width=120, mode="RGB"):
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(len(str(path)))
    shape = (height, width) if mode == "L" else (height, width, 3)
    Image.fromarray(rng.integers(0, 256, shape, np.uint8)).save(path)


def test_a_folder_of_pictures_with_subfolders(tmp_path):
    picture(tmp_path / "a.png")
    picture(tmp_path / "deep" / "b.JPG", mode="L")
    (tmp_path / "notes.txt").write_text("no picture")
    textures = load_textures(tmp_path, count=5, size=64)
    assert textures.shape == (5, 64, 64)


def test_every_picture_comes_before_any_comes_again(tmp_path):
    for grey in range(6):
        Image.new("L", (100, 100), 40 * grey).save(tmp_path / f"{grey}.png")
    for seed in range(3):
        textures = load_textures(tmp_path, count=6, size=64, seed=seed)
        assert len({float(texture.mean()) for texture in textures}) == 6


def test_only_as_many_pictures_are_opened_as_are_asked_for(tmp_path, monkeypatch):
    for k in range(30):
        picture(tmp_path / f"{k}.png")
    opened = []
    monkeypatch.setattr(
        module, "_cutting", lambda rng, path, size: opened.append(path) or np.zeros((size, size))
    )
    load_textures(tmp_path, count=4, size=64)
    assert len(opened) == 4 == len(set(opened))


def test_bad_pictures_are_named_and_left_out(tmp_path, caplog):
    picture(tmp_path / "good.png")
    picture(tmp_path / "small.png", 20, 200)
    (tmp_path / "broken.jpg").write_bytes(b"\xff\xd8\xff no picture")
    whole = (tmp_path / "good.png").read_bytes()
    (tmp_path / "cut.png").write_bytes(whole[: len(whole) // 2])
    assert load_textures(tmp_path, count=8, size=64).shape == (8, 64, 64)
    for name in ("small.png", "broken.jpg", "cut.png"):
        assert name in caplog.text


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_sixteen_bits_are_as_bright_as_eight(tmp_path, suffix):
    ramp = np.linspace(0, 255, 100 * 100).reshape(100, 100).astype(np.uint8)
    Image.fromarray(ramp).save(tmp_path / "a.png")
    (tmp_path / "deep").mkdir()
    deep = 257 * ramp.astype(np.uint16)
    Image.fromarray(deep).save(tmp_path / "deep" / f"a{suffix}")
    expected = load_textures([tmp_path / "a.png"], 3, 64)
    np.testing.assert_array_equal(load_textures(tmp_path / "deep", 3, 64), expected)


def test_ten_bits_in_sixteen_keep_their_greys(tmp_path):
    ramp = np.linspace(0, 1023, 100 * 100).reshape(100, 100).astype(np.uint16)
    Image.fromarray(ramp).save(tmp_path / "a.png")
    assert len(np.unique(np.round(255 * load_textures(tmp_path, 1, 64)))) > 30


def test_fractions_are_refused_by_name(tmp_path, caplog):
    picture(tmp_path / "good.png")
    Image.fromarray(np.random.default_rng(0).random((100, 100), np.float32)).save(
        tmp_path / "fractions.tif"
    )
    load_textures(tmp_path, 4, 64)
    assert "fractions.tif: it holds fractions" in caplog.text


def test_folders_that_cannot_be_used(tmp_path):
    with pytest.raises(ValueError, match="no such folder"):
        load_textures(tmp_path / "nowhere")
    (tmp_path / "notes.txt").write_text("")
    with pytest.raises(ValueError, match="notes.txt: is a file: name a folder"):
        load_textures(tmp_path / "notes.txt")
    with pytest.raises(ValueError, match="holds no pictures"):
        load_textures(tmp_path)
    picture(tmp_path / "small.png", 20, 30)
    with pytest.raises(ValueError, match="30x20 is too small"):
        load_textures(tmp_path, size=64)


def test_pictures_to_judge_by_are_in_no_pool(tmp_path):
    held_out = {name for names in HELD_OUT.values() for name in names}
    assert not held_out & {path.name for path in photographs()}
    for name in held_out:  # black, so that any cutting of them would show
        Image.new("L", (100, 100)).save(tmp_path / name.upper())
    Image.new("L", (100, 100), 255).save(tmp_path / "mine.png")
    assert load_textures(tmp_path, count=20, size=64).min() == 1
    (tmp_path / "mine.png").unlink()
    with pytest.raises(ValueError, match="holds no pictures .* but .*, which is held out"):
        load_textures(tmp_path, count=1, size=64)


def test_a_damaged_tiff_is_not_used(tmp_path, caplog):
    """Pillow meets bytes where it expects a number, and raises a TypeError."""
    rng = np.random.default_rng(1)
    for name in ("bad.tif", "good.png"):
        Image.fromarray(rng.integers(0, 256, (80, 80), dtype=np.uint8)).save(tmp_path / name)
    data = bytearray((tmp_path / "bad.tif").read_bytes())
    start = int.from_bytes(data[4:8], "little")
    for entry in range(start + 2, start + 2 + 12 * data[start], 12):
        if int.from_bytes(data[entry : entry + 2], "little") == 273:  # where its strips begin
            data[entry + 2] = 7  # bytes of any kind
    (tmp_path / "bad.tif").write_bytes(data)
    assert load_textures(tmp_path, count=3, size=64).shape == (3, 64, 64)
    assert f"not used: {tmp_path / 'bad.tif'}" in caplog.text


def test_small_textures_hold_every_kind_of_drawing():
    for size in (16, 23):
        assert load_textures(None, 12, size, procedural=1.0).shape == (12, size, size)
