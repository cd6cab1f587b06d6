"""Every command of README and the site is understood; with --slow, each of them and all code run.

They run on stand-ins of the files that they name, made small: a line of `SMALLER` says how. What
cannot run in a test is in `NOT_RUN`, with the reason.
"""

import importlib
import re
import shlex
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import tyro
from formats import aedat4, events4
from PIL import Image

from firenet_jax import cli
from firenet_jax.storage.video import write_video

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
HEIGHT, WIDTH = 24, 32

# What is added to a command so that it takes seconds; the last of two options counts.
SMALLER = {
    "demo": "--seconds 0.3 --sensor-size 32x24",
    "simulate": "--sequences 3 --validation 1 --seconds 0.3 --sensor-size 32x24",
    "train": "--steps 1 --batch 1 --crop 24 --windows 3 --l0 1 --textures 4 --haarpsi 0 --nlpd 0",
    "evaluate": "--warm-up 0.2",
    "reconstruct a.zip -o part.mp4": "--start 0.1 --stop 0.3",
}
NOT_RUN = {
    "firenet live": "serves a page until it is told to stop: test_live.py",
    "firenet reconstruct RECORDING -o video.mp4 --show": "needs a screen: test_screen.py",
    "firenet export --web": "needs onnxruntime-web of npm: test_web_page.py",
    "firenet train --help": "says what there is",
}
PLACEHOLDER = re.compile(r"^(\.\.\.|[A-Z_]+)$")


def blocks(page):
    """(language, text) of the blocks of code"""
    return re.findall(r"^```(\w*)\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)


def understood(command):
    """`firenet ...` as a shell reads it -> words after firenet, with stand-ins for placeholders."""
    words = shlex.split(command, comments=True)[1:]
    return ["recording.zip" if PLACEHOLDER.match(word) else word for word in words]


def commands(page):
    """Those of blocks, wherever they stand in a line, up to what ends them."""
    found = []
    for language, text in blocks(page):
        if language != "python":
            found += re.findall(rf"\bfirenet (?:{'|'.join(cli.COMMANDS)}) [^'\"\n]*", text)
    return [command.strip() for command in found]


def inline(page):
    """Those in code inside of a line, but for those with gaps that a person fills in."""
    found = re.findall(r"`(firenet [a-z]+ [^`]*)`", page.read_text())
    return [one for one in found if not re.search(r"\.\.\.|\b[A-Z]{2,}\b", one)]


EVERY = [(page, command) for page in PAGES for command in commands(page)]


def as_settings(command):
    name, *rest = understood(command)
    module = importlib.import_module(f"firenet_jax.commands.{name}")
    kind = getattr(module, name.capitalize())
    return tyro.cli(kind, args=rest, config=(tyro.conf.OmitArgPrefixes,))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_have_these_options(page, monkeypatch):
    monkeypatch.setenv("JOB_COMPLETION_INDEX", "0")  # of Kubernetes, for its --processes
    for command in [*commands(page), *inline(page)]:
        if "--help" in command:
            continue
        try:
            as_settings(command)
        except SystemExit:
            pytest.fail(f"{page.name}: {command}")


def test_no_option_is_given_twice():
    """Of two the last counts, and the first is lost without a word."""
    for page in PAGES:
        for command in [*commands(page), *inline(page)]:
            options = [word for word in understood(command) if re.match("--?[a-zA-Z]", word)]
            assert len(options) == len(set(options)), f"{page.name}: {command}"


# ---- Stand-ins


def write_events(path, seconds=0.4, count=3000):
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, round(seconds * 1e6), count))
    columns = (rng.integers(0, side, count) for side in (WIDTH, HEIGHT, 2))
    rows = list(zip(t.tolist(), *(column.tolist() for column in columns), strict=True))
    lines = "".join(f"{t / 1e6:.6f} {x} {y} {p}\n" for t, x, y, p in rows)
    if path.suffix == ".aedat4":
        path.write_bytes(aedat4({0: ("EVTS", WIDTH, HEIGHT)}, [(0, events4(rows))]))
    else:
        with zipfile.ZipFile(path, "w") as file:
            file.writestr("events.txt", f"{WIDTH} {HEIGHT}\n{lines}")
    return lines


def write_with_frames(path, seconds=6.0, fps=5):
    """As the Event Camera Dataset's, of which the paper counts what comes after five seconds."""
    lines = write_events(path, seconds)
    picture = Image.fromarray(np.arange(HEIGHT * WIDTH, dtype=np.uint8).reshape(HEIGHT, WIDTH))
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("events.txt", lines)
        names = [f"images/frame_{n:08d}.png" for n in range(round(seconds * fps))]
        stamps = [f"{n / fps:.6f} {name}\n" for n, name in enumerate(names)]
        file.writestr("images.txt", "".join(stamps))
        for name in names:
            with file.open(name, "w") as entry:
                picture.save(entry, "png")


def call(*words):
    assert cli.main(list(map(str, words))) == 0, " ".join(map(str, words))


@pytest.fixture(scope="module")
def stand_ins(tmp_path_factory):
    """A folder with all that the commands name."""
    folder = tmp_path_factory.mktemp("stand_ins")
    for name in ("recording.zip", "a.zip", "recording.aedat4", "a.aedat4", "b.aedat4", "c.aedat4"):
        write_events(folder / name)
    for name in ("dynamic_6dof.zip", "boxes_6dof.zip", "davis.zip"):
        write_with_frames(folder / name)
    rng = np.random.default_rng(0)
    for name in ("photographs", "coco/train2017"):
        (folder / name).mkdir(parents=True)
        for n in range(2):
            picture = Image.fromarray(rng.integers(0, 256, (300, 300), np.uint8))
            picture.save(folder / name / f"{n}.png")
    write_video(folder / "clip.mp4", rng.integers(0, 256, (5, HEIGHT, WIDTH), np.uint8), fps=30)
    (folder / "times.txt").write_text("0.1\n0.2\n0.3\n")
    (folder / "near_frames.txt").write_text("5.2\n5.4\n5.6\n")
    call("export", "-o", folder / "published.pth")
    call("export", "-o", folder / "model.stablehlo")
    call("export", "-o", folder / "firenet.onnx", "--picture")
    call("simulate", "-o", folder / "set", *shlex.split(SMALLER["simulate"]))
    call("train", "-o", folder / "run", *shlex.split(SMALLER["train"]))
    return folder


@pytest.fixture
def beside_stand_ins(stand_ins, tmp_path, monkeypatch):
    shutil.copytree(stand_ins, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)


def runnable():
    """Each command once; what cannot run is named, and is still there."""
    here = [command for page, command in EVERY if page.name != "launchers.md"]  # of clusters
    every = sorted({command.partition("  #")[0].strip() for command in here})
    left = {command for command in every for start in NOT_RUN if command.startswith(start)}
    assert all(any(one.startswith(start) for one in left) for start in NOT_RUN)
    return [one for one in every if one not in left]


@pytest.mark.slow
@pytest.mark.parametrize("command", runnable())
def test_commands_run(command, beside_stand_ins):
    name, *rest = understood(command)
    output = Path(rest[rest.index("-o") + 1]) if "-o" in rest else None
    if output is not None:
        shutil.rmtree(output, ignore_errors=True) if output.is_dir() else output.unlink(True)
    smaller = [more for start, more in SMALLER.items() if command.startswith(f"firenet {start}")]
    if "--video" in rest:  # which sets the size and the length
        smaller = []
    if "--data" in rest:  # which needs no textures
        smaller = [options.replace("--textures 4 ", "") for options in smaller]
    words = []
    for word in rest:
        words += sorted(map(str, Path().glob(word))) if "*" in word else [word]
    assert cli.main([name, *words, *shlex.split(" ".join(smaller))]) == 0
    assert output is None or output.exists() or output.with_suffix("").exists()


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in PAGES if "```python" in p.read_text()])
def test_code_runs(page, beside_stand_ins):
    for language, text in blocks(page):
        if language == "python":
            exec(compile(text, page.name, "exec"), {})
