"""A window on the screen; Tk is played by a stand-in, as tests have no display."""

import io
import os
import sys
import types

import h5py
import numpy as np
import pytest
from PIL import Image
from test_pipeline import write_recording

from firenet_jax import cli
from firenet_jax.storage.files import OutputError
from firenet_jax.storage.screen import MIN_INTERVAL, MIN_WIDTH, Screen


class TclError(Exception):
    pass


class Window:
    """Keeps what is done to it; after `destroy` Tk refuses everything."""

    def __init__(self):
        self.titles, self.updates, self.there = [], 0, True

    def pack(self):
        pass

    def protocol(self, name, function):
        self.closed_by_user = function

    def title(self, text):
        self.titles.append(text)

    def update(self):
        if not self.there:
            raise TclError("application has been destroyed")
        self.updates += 1

    def destroy(self):
        self.there = False


class Label(types.SimpleNamespace):
    def pack(self):
        pass

    def configure(self, image):
        shown.append(image)


class PhotoImage:
    def __init__(self, master, data):
        with Image.open(io.BytesIO(data)) as picture:
            self.pixels, self.factor = np.asarray(picture), 1

    def zoom(self, factor):
        self.factor = factor
        return self


shown = []


@pytest.fixture
def display(monkeypatch):
    """The clock goes on by `clock.step` with each look at it."""
    clock = types.SimpleNamespace(now=0.0, step=2 * MIN_INTERVAL)

    def monotonic():
        clock.now += clock.step
        return clock.now

    shown.clear()
    names = dict(Tk=Window, TclError=TclError, Label=lambda window: Label(), PhotoImage=PhotoImage)
    monkeypatch.setitem(sys.modules, "tkinter", types.SimpleNamespace(**names))
    monkeypatch.setattr("firenet_jax.storage.screen.time.monotonic", monotonic)
    return clock


def test_shows_greys_and_colours_as_they_are(display):
    rng = np.random.default_rng(0)
    screen = Screen()
    for shape in ((18, 24), (18, 24, 3), (400, 640)):
        picture = rng.integers(0, 256, shape, np.uint8)
        screen.show(picture, "a.mp4")
        np.testing.assert_array_equal(shown[-1].pixels, picture)
        assert shown[-1].factor * shape[1] >= MIN_WIDTH
    assert screen.window.titles == ["a.mp4"] * 3 and screen.window.updates == 3
    display.step = 0  # no time passes: the next one comes too early
    screen.show(picture, "a.mp4")
    assert len(shown) == 3


def test_the_work_goes_on_when_the_window_is_closed(display):
    screen, picture = Screen(), np.zeros((18, 24), np.uint8)
    window = screen.window
    window.there = False  # while a picture is drawn
    screen.show(picture, "")
    window.closed_by_user()
    screen.show(picture, "")
    screen.close()
    assert len(shown) == 1


def test_reconstruct_shows_what_it_writes(display, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_recording(tmp_path / "a.txt", 500)
    assert cli.main("reconstruct a.txt -o out -N 100 --show".split()) == 0
    written = [np.asarray(Image.open(path)) for path in sorted((tmp_path / "out").glob("*.png"))]
    np.testing.assert_array_equal([image.pixels for image in shown], written)


def test_reconstruct_shows_images_of_arrays_as_greys(display, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_recording(tmp_path / "a.txt", 500)
    assert cli.main("reconstruct a.txt -o out.h5 -N 100 --show".split()) == 0
    with h5py.File("out.h5") as file:
        expected = np.rint(255 * np.clip(file["images"][:], 0, 1))
    np.testing.assert_array_equal([image.pixels for image in shown], expected)


@pytest.mark.skipif(os.name == "nt", reason="has a display without saying so")
def test_no_display_is_one_sentence_and_nothing_is_written(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.chdir(tmp_path)
    write_recording(tmp_path / "a.txt", 500)
    assert cli.main("reconstruct a.txt -o out --show".split()) == 1
    error = capsys.readouterr().err
    assert error.startswith("firenet: error: --show: ") and len(error.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    monkeypatch.setitem(sys.modules, "tkinter", None)
    with pytest.raises(OutputError, match="has no Tk"):
        Screen()


@pytest.mark.skipif("DISPLAY" not in os.environ, reason="needs a display")
def test_a_real_window():
    screen = Screen()
    screen.show(np.full((180, 240), 200, np.uint8), "a window")
    assert screen.window.title() == "a window" and screen.image.get(10, 10) == (200, 200, 200)
    screen.close()
