"""What a user meets: exit codes, and one sentence for everything that is wrong."""

import ast
import errno
import importlib
import inspect
import itertools
import json
import os
import pickle
import re
import subprocess
import sys
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import h5py
import jax
import numpy as np
import pytest
from processes import with_little_room
from test_pipeline import write_recording

from firenet_jax import cli
from firenet_jax.checkpoint import save_weights
from firenet_jax.commands import info, options, reconstruct
from firenet_jax.events import rate_in_words
from firenet_jax.network import Weights, initial_params
from firenet_jax.readers import open_recording
from firenet_jax.reconstruction import Network
from firenet_jax.windows import Windows


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A working folder with weights.npz and a recording a.txt."""
    monkeypatch.chdir(tmp_path)
    save_weights("weights.npz", Weights(initial_params(jax.random.key(0)), True))
    write_recording(tmp_path / "a.txt", 500)
    return tmp_path


def firenet(capsys, line):
    """Runs one command line; returns (exit code, stdout, stderr)."""
    code = cli.main(line.split())
    return code, *capsys.readouterr()


RUN = "reconstruct a.txt -o out --weights weights.npz"


def test_help_and_version(capsys):
    assert firenet(capsys, "--help")[0] == 0
    assert firenet(capsys, "--version")[1].strip()
    code, _, error = firenet(capsys, "nonsense")
    assert code == 2 and "no command 'nonsense'\n" in error
    assert "no command 'reconstuct', did you mean reconstruct?" in firenet(capsys, "reconstuct")[2]
    for command in cli.COMMANDS:
        with pytest.raises(SystemExit) as stop:
            cli.main([command, "--help"])
        assert stop.value.code == 0
        _, _, examples = capsys.readouterr().out.partition("Examples:")
        assert f"firenet {command} " in examples


def help_of(capsys, monkeypatch, command, width):
    monkeypatch.setenv("COLUMNS", str(width))
    with pytest.raises(SystemExit):
        cli.main([command, "--help"])
    return capsys.readouterr().out


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_help_breaks_no_line_and_speaks_no_python(capsys, monkeypatch, command):
    narrow, wide = (help_of(capsys, monkeypatch, command, width) for width in (80, 3000))
    _, _, options = narrow.partition("--help")
    # An empty line is one between paragraphs of what stands above a box's rule.
    assert not re.search(r"^[│| ]+\n[│| ]+-", options, re.M)
    for word in ("None", "Raises", "True", "False", "__", "`threshold", "{", "Error"):
        allowed = word == "{" and re.findall(r"{[a-z0-9_,]+}", options)
        assert word not in options or allowed, word
    # Where there is room, each text is one line.
    kind = command.capitalize()
    module = importlib.import_module(f"firenet_jax.commands.{command}")
    source = inspect.getsourcefile(getattr(module, kind))
    settings = ast.parse(Path(source).read_text()).body
    body = next(node for node in settings if getattr(node, "name", "") == kind).body
    pairs = [(a, b) for a, b in itertools.pairwise(body) if isinstance(a, ast.AnnAssign)]
    texts = [" ".join(b.value.value.split()) for _, b in pairs if isinstance(b, ast.Expr)]
    assert len(texts) > 1 and all(text in wide for text in texts)


def test_help_follows_the_order_of_the_settings(capsys, monkeypatch):
    _, _, text = help_of(capsys, monkeypatch, "reconstruct", 100).partition("RECORDING... ")
    places = [text.index(f" {option} ") for option in ("--weights", "--events", "--duration",
              "--unsharp", "--preview", "--speed", "--chunk", "--process")]  # fmt: skip
    assert places == sorted(places)
    settings = options.parse(
        reconstruct.Reconstruct, "a b -o out -T 5 --pad 4 --no-recurrent --batch 2".split(), "", ""
    )
    assert settings == reconstruct.Reconstruct(
        (Path("a"), Path("b")), Path("out"), windows=Windows(duration=5),
        network=Network(recurrent=False, pad=4), batch=2,
    )  # fmt: skip


def test_recordings_on_both_sides_of_an_option_are_told_to_stand_together(capsys):
    assert cli.main("reconstruct a.aedat4 -o out b.aedat4".split()) == 1
    error = capsys.readouterr().err
    assert "b.aedat4 stands apart" in error and "side by side" in error
    for line in ("reconstruct a -o out --no-such b", "train word -o out"):
        with pytest.raises(SystemExit) as stop:  # what else tyro cannot read, it says itself
            cli.main(line.split())
        assert stop.value.code == 2 and "stands apart" not in capsys.readouterr().err


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device that is always full")
@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("line", ["--help", "convert --help"])
def test_what_cannot_be_printed_is_one_sentence(line, unbuffered):
    command = [sys.executable, "-m", "firenet_jax", *line.split()]
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    run = partial(subprocess.run, env=environment, stderr=subprocess.PIPE, text=True)
    with open("/dev/full", "w") as full:
        ran = run(command, stdout=full)
    assert ran.returncode == 1
    to = "print or write" if unbuffered else "print"
    assert ran.stderr == f"firenet: error: cannot {to} (No space left on device)\n"
    reading, writing = os.pipe()
    os.close(reading)  # as `| head` does when it has seen enough
    with open(writing, "w") as pipe:
        ran = run(command, stdout=pipe)
    assert (ran.returncode, ran.stderr) == (1, "")
    reading, writing = os.pipe()
    os.close(reading)
    with open(writing, "w") as pipe:  # as in many containers
        ran = run(command, stdout=pipe, env=environment | {"PYTHONUNBUFFERED": "1"})
    assert (ran.returncode, ran.stderr) == (1, "")
    closed = ["sh", "-c", 'exec "$0" "$@" <&- >&- 2>&-', *command]
    assert run(closed).returncode == 0


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="only glibc has this setting")
@pytest.mark.parametrize("chosen", [None, "glibc.malloc.check=0"])
def test_the_program_runs_in_huge_pages_unless_told_otherwise(here, chosen):
    """It starts itself again, with the arguments and the exit code that it had."""
    script = (
        "import os, sys; from firenet_jax import cli\n"
        "cli.main = lambda: print(os.environ['GLIBC_TUNABLES'], sys.argv[1:]) or 3\n"
        "sys.exit(cli.program())"
    )
    environment = {k: v for k, v in os.environ.items() if k != "GLIBC_TUNABLES"}
    environment |= {"GLIBC_TUNABLES": chosen} if chosen else {}
    command = [sys.executable, "-c", script, "info", "a b.txt"]
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert ran.returncode == 3, ran.stderr
    assert ran.stdout.strip() == f"{chosen or cli.HUGE_PAGES} ['info', 'a b.txt']"


@pytest.mark.skipif(sys.platform != "linux", reason="names there are text")
def test_names_that_are_no_text_can_be_said(here):
    name = os.fsencode(here / "caf") + b"\xe9.txt"
    os.rename(here / "a.txt", name)
    command = [sys.executable, "-m", "firenet_jax", "info", name]
    environment = os.environ | {"PYTHONIOENCODING": "utf-8:strict"}
    ran = subprocess.run(command, env=environment, capture_output=True, timeout=60)
    assert ran.returncode == 0 and b"Traceback" not in ran.stderr, ran.stderr
    os.truncate(name, 0)
    ran = subprocess.run(command, env=environment, capture_output=True, timeout=60)
    assert ran.returncode == 1 and b"caf\\udce9.txt" in ran.stderr, ran.stderr


@pytest.mark.parametrize("output", ["out", "out.mp4", "out.gif"])
def test_reconstruct_writes_each_kind_of_output(here, capsys, output):
    line = f"reconstruct a.txt -o {output} -c weights.npz -N 100 --preview"
    assert firenet(capsys, line)[0] == 0
    assert (here / output).exists() and not list(here.glob("*partial*"))


def test_every_option_is_accepted(here, capsys):
    (here / "hot.txt").write_text("1,1\n")
    line = f"{RUN} -T 50 --step 25 --no-recurrent --bfloat16 --pad 16 --range extremes --unsharp 0 "
    line += "--hot-pixels hot.txt --flip --start 0.1 --stop 0.9 --sensor-size 30x40 "
    line += "--chunk 3 --batch 2 --overwrite"
    code, _, error = firenet(capsys, line)
    assert code == 0, error
    assert len(list((here / "out").glob("*.png"))) == 31  # starts 0, 25, ... 750 ms
    code, _, error = firenet(capsys, f"{RUN} --fps 10 -o out.mp4")
    assert code == 0 and (here / "out.mp4").exists(), error


def test_info_as_lines_and_as_json(here, capsys):
    code, out, _ = firenet(capsys, "info a.txt")
    assert code == 0 and "24x20 pixels" in out and "500" in out
    facts = json.loads(firenet(capsys, "info a.txt --json")[1])
    rows = np.loadtxt(here / "a.txt", skiprows=1)
    assert facts["events"] == 500 and (facts["width"], facts["height"]) == (24, 20)
    assert facts["duration_s"] == pytest.approx(np.ptp(rows[:, 0]))
    assert facts["on_share"] == pytest.approx(rows[:, 3].mean())
    assert facts["events_per_window"] == 168 and not facts["sensor_size_inferred"]
    begin, count, windows = rows[0, 0], 0, 1  # at most 40 ms and 168 events
    for t in rows[:, 0]:
        if round(1e6 * (t - begin)) >= 40_000 or count == 168:
            begin, count, windows = t, 0, windows + 1
        count += 1
    assert facts["windows"] == windows and facts["longest_window_ms"] == 40
    (here / "none.txt").write_text("0.1 3 4 1\n0.2 20 11 0\n")
    facts = json.loads(firenet(capsys, "info none.txt --json")[1])
    assert (facts["width"], facts["height"], facts["sensor_size_inferred"]) == (21, 12, True)
    assert "21x12 pixels (inferred from the events)" in firenet(capsys, "info none.txt")[1]


def test_convert_needs_no_pytorch_and_says_what_it_did(here, capsys, reference):
    line = f"convert {reference}/firenet_published.pth -o new.npz"
    assert firenet(capsys, line)[0] == 0
    assert firenet(capsys, "reconstruct a.txt -o out -c new.npz")[0] == 0


def text_with(path, lines):
    path.write_text("24 20\n" + "\n".join(lines) + "\n")


def truncated(path, data):
    path.write_bytes(data[: len(data) // 2])


def make_bad_inputs(folder):
    """name -> what the message must contain."""
    good = ["0.1 3 4 1", "0.2 3 4 0"]
    (folder / "empty.txt").write_text("")
    text_with(folder / "five.txt", [*good, "0.3 1 2 1 7"])
    text_with(folder / "nan.txt", [*good, "nan 1 2 1"])
    text_with(folder / "backwards.txt", [*good, "0.15 1 2 1"])
    text_with(folder / "negative.txt", [*good, "0.3 -1 2 1"])
    text_with(folder / "large.txt", [*good, "0.3 24 2 1"])
    (folder / "unknown.xyz").write_text("0.1 3 4 1")
    (folder / "cut.zip").write_bytes(b"PK\x03\x04" + b"junk" * 100)
    with h5py.File(folder / "whole.h5", "w") as file:
        for name, dtype in [("xs", "i2"), ("ys", "i2"), ("ts", "f8"), ("ps", "?")]:
            file[f"events/{name}"] = np.arange(5000).astype(dtype) % 20
        file.attrs["sensor_resolution"] = [20, 24]
    truncated(folder / "cut.h5", (folder / "whole.h5").read_bytes())
    (folder / "cut.bin").write_bytes(b"1234")  # not even one event
    return {
        "missing.txt": "no such file", "empty.txt": "empty", "five.txt": "line 4",
        "nan.txt": "line 4", "backwards.txt": "line 4", "negative.txt": "line 4",
        "large.txt": "line 4", "unknown.xyz": "known format", "cut.zip": "cut.zip",
        "cut.h5": "cut.h5", "cut.bin": "cut.bin", "whole.h5": "event 21",
    }  # fmt: skip


@pytest.mark.parametrize("command", ["info", "reconstruct"])
def test_bad_recordings_give_one_sentence_and_no_output(here, capsys, command):
    for name, place in make_bad_inputs(here).items():
        line = f"reconstruct {name} -o out -c weights.npz" if command != "info" else f"info {name}"
        code, _, error = firenet(capsys, line)
        assert code == 1, name
        said = error.strip().splitlines()
        assert len(said) == 1 and said[0].startswith("firenet: error: "), (name, error)
        assert name in said[0] and place in said[0], (name, error)
        assert not (here / "out").exists()


@pytest.mark.parametrize("kind", [MemoryError, RuntimeError])
def test_too_little_memory_is_one_sentence(here, capsys, monkeypatch, kind):
    def run(settings):
        raise kind("RESOURCE_EXHAUSTED: out of memory")

    monkeypatch.setattr(info, "run", run)
    code, _, error = firenet(capsys, "info a.txt")
    assert code == 1 and error.startswith("firenet: error: not enough memory: ")
    with pytest.raises(RuntimeError, match="a fault of ours"):  # is not hidden
        monkeypatch.setattr(info, "run", Mock(side_effect=RuntimeError("a fault of ours")))
        firenet(capsys, "info a.txt")


def test_a_sensor_size_that_is_too_small(here, capsys):
    code, _, error = firenet(capsys, f"{RUN} --sensor-size 20x20")
    assert code == 1 and re.search(r"a.txt, line \d+: x is 2\d, outside the sensor of 20x20", error)
    assert not (here / "out").exists()


def test_bad_weights_give_one_sentence_and_run_nothing(here, capsys):
    class Malicious:
        def __reduce__(self):
            return open, (str(here / "executed"), "w")

    (here / "evil.pth").write_bytes(pickle.dumps({"state_dict": Malicious()}))
    (here / "empty.pth").write_bytes(b"")
    np.savez(here / "other.npz", kernel=np.zeros(3))
    whole = (here / "weights.npz").read_bytes()
    truncated(here / "cut.npz", whole)
    for name in ("evil.pth", "empty.pth", "other.npz", "cut.npz", "missing.npz", "a.txt"):
        code, _, error = firenet(capsys, f"reconstruct a.txt -o out -c {name}")
        assert code == 1 and name in error and len(error.strip().splitlines()) == 1, error
    assert not (here / "executed").exists() and not (here / "out").exists()


def test_no_weights_need_to_be_named(here, capsys):
    code, _, error = firenet(capsys, "reconstruct a.txt -o out")
    assert code == 0, error
    assert list((here / "out").glob("frame_*.png"))


def test_outputs_that_cannot_be_written(here, capsys):
    (here / "file").write_text("mine")
    for output, said in [("file/out", "cannot make"), ("file", "is a file"), ("a.avi", ".avi")]:
        code, _, error = firenet(capsys, f"reconstruct a.txt -o {output} -c weights.npz")
        assert code == 1 and said in error and len(error.strip().splitlines()) == 1, error
    assert (here / "file").read_text() == "mine"


def test_other_systems_have_no_glibc(monkeypatch):
    def windows(name):
        raise TypeError("argument of type 'NoneType' is not iterable")

    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(cli.ctypes, "CDLL", windows)
    cli._set_malloc(cli.RETURN_FREED_MEMORY)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no limits of this kind")
def test_no_room_while_writing(here):
    write_recording(here / "wide.txt", 40_000, width=200, height=150)
    outputs = "out", "out.mp4", "out.gif"
    line = "reconstruct wide.txt -c weights.npz --preview -o"
    ran = with_little_room(here, *((4000, f"{line} {output}") for output in outputs))
    for (code, said, left), output in zip(ran, outputs, strict=True):
        assert code == 1, said
        errors = [each for each in said if "error" in each]
        assert len(errors) == 1 and output in errors[0], said
        assert not any("Traceback" in each for each in said), said
        assert output not in left


def test_info_names_hot_pixels_by_column_and_row(here, capsys):
    rows = [f"{k / 1e4:.4f} {k % 24} {k // 24 % 20} 1" for k in range(480)]
    text_with(here / "hot.txt", [*rows, *["0.5 17 4 1"] * 400])
    assert json.loads(firenet(capsys, "info hot.txt --json")[1])["hot_pixels"] == [[17, 4]]
    out = firenet(capsys, "info hot.txt")[1]
    assert "1, (x,y): (17,4)" in out and re.search(r"rate +1.76 kev/s", out)


def test_rates_in_words_are_never_nothing():
    rates = {2.306e6: "2.31 Mev/s", 46_200: "46.2 kev/s", 20: "20 ev/s", 0.155: "0.155 ev/s"}
    assert [rate_in_words(rate) for rate in rates] == list(rates.values())


def test_options_of_the_original_program_are_explained(here, capsys):
    for line, said in (
        ("-i a.txt -o out", "-i is"),
        (f"{RUN} --auto_hdr", "--range extremes here"),
    ):
        line = line if line.startswith("reconstruct") else f"reconstruct {line}"
        code, _, error = firenet(capsys, line)
        assert code == 2 and said in error and len(error.splitlines()) == 1
    code, _, error = firenet(capsys, f"{RUN} --start 5")
    assert code == 1 and re.search(r"a.txt: no events, .*: it lasts 0\.9\d+ s", error)
    code, _, error = firenet(capsys, "reconstruct a.txt -o x.txt2 -c weights.npz")
    assert code == 1 and "cannot write .txt2 files" in error


@pytest.mark.parametrize(
    "line, said",
    [
        (f"{RUN} -T 0", "duration is 0.0"), (f"{RUN} -N 5 -T 5", "windows are cut in one way"),
        (f"{RUN} -N 5 --step 1.5", "pass a whole number"), (f"{RUN} --longest 0", "longest is 0.0"),
        (f"{RUN} -T 5 --step 9", "longer than the window"), (f"{RUN} --start -1", "start is -1.0"),
        (f"{RUN} --frame-to-frame --step 3", "not those between frames"),
        (f"{RUN} --chunk 9000 --batch 4", "fewer than 32768 windows fit at once"),
        (f"{RUN} --rate 0", "rate is 0"), (f"{RUN} --rate 5 --triggers", "choose one of --rate"),
        ("evaluate a.txt -o out -N 0", "events is 0"),
        ("evaluate a.txt -o out --start -2", "start is -2.0"),
        ("live a.txt --replay --events-per-pixel 0", "events_per_pixel is 0.0"),
        ("demo -o a.h5", "a.h5: pictures"), ("demo -o a.bag", "a.bag: pictures"),
        ("export -o a.foo", "try .onnx, .stablehlo, .pth or .safetensors"),
    ],
)  # fmt: skip
def test_settings_that_cannot_be_are_one_sentence(here, capsys, line, said):
    code, _, error = firenet(capsys, line)
    assert code == 1 and said in error and len(error.splitlines()) == 1, error
    assert error.startswith("firenet: error: ") and {p.name for p in here.iterdir()} == {
        "a.txt", "weights.npz"
    }  # fmt: skip


@pytest.mark.parametrize(
    "line, said",
    [
        (f"{RUN} -N five", "-N/--events: expected a whole number, not 'five'"),
        (f"{RUN} --pad 1.5", "--pad: expected a whole number, not '1.5'"),
        (f"{RUN} -T fast", "--duration: expected a number, not 'fast'"),
        (f"{RUN} --unit x", "--unit: expected s or ms or us or ns, not 'x'"),
        (f"{RUN} --names x", "--names: expected number or nanoseconds, not 'x'"),
        ("simulate -o set --noise 1 much", "--noise: expected 2 numbers, not '1 much'"),
        ("train -o run --optimiser sgd", "--optimiser: expected muon or centred or adam"),
    ],
)  # fmt: skip
def test_words_that_cannot_be_read_are_said_without_pythons(here, capsys, monkeypatch, line, said):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as stop:
        cli.main(line.split())
    error = capsys.readouterr().err
    assert stop.value.code == 2 and said in error
    assert not re.search(r"NoneType|class|Traceback|int\b|float|Literal", error), error


def test_colours_of_a_sensor_that_says_it_is_grey(here, capsys):
    words = np.array([[10, 1 | 2 << 14], [20, 3 | 4 << 14]], "<u4").tobytes()
    (here / "grey.dat").write_bytes(b"% Version 2\n% Width 24\n% Height 20\n\x00\x08" + words)
    code, _, error = firenet(capsys, "reconstruct grey.dat -o out -c weights.npz --color")
    assert code == 1 and "sees no colours" in error and not list(here.glob("out*"))
    (here / "a.bin").write_bytes(bytes([1, 2, 0x80, 0, 10]))
    assert open_recording(here / "a.bin").grey and not open_recording(here / "a.txt").grey
    # ... and does not keep others from being done.
    code, _, error = firenet(capsys, "reconstruct grey.dat a.txt -o out -c weights.npz --color")
    assert code == 1 and "sees no colours" in error and "the other recordings are done" in error
    assert list(here.glob("out/*/frame*"))


def test_which_recordings_say_that_their_sensor_is_grey(recordings):
    """Of cameras' own files all but the DAVIS with a mosaic would; a text never does."""
    for name, grey in (
        ("dvxplorer_face.aedat4", True), ("davis346_frames.aedat4", True), ("ncars.dat", True),
        ("evt2_sparklers.raw", True), ("ncaltech101_faces_easy_0001.bin", True),
        ("ros1_event_camera_msgs.bag", True), ("ros2_event_camera_msgs", True),
        ("ecd_slider_depth", False),
    ):  # fmt: skip
        assert open_recording(recordings / name).grey == grey, name


def test_what_may_not_be_read_is_named(here, capsys, monkeypatch):
    """Whatever library reads it. Tests may run as root, whom no file refuses, so opening does."""
    for name in ("hot.txt", "model.pth", "clip.mp4"):
        (here / name).write_bytes(b"1,1\n")
    make_bad_inputs(here)  # whole.h5 among them
    (here / "ecd").mkdir()
    (here / "ecd" / "events.txt").write_text("0.1 3 4 1\n")
    (here / "set").mkdir()
    for name in ("other.h5", "whole.h5"):
        (here / "set" / name).write_bytes((here / "whole.h5").read_bytes())
    really = open

    def refusing(path, *others, **more):
        if not isinstance(path, int) and os.path.basename(path) == closed:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return really(path, *others, **more)

    monkeypatch.setattr("builtins.open", refusing)
    for closed, line in (
        ("a.txt", "info a.txt"), ("whole.h5", "info whole.h5"), ("events.txt", "info ecd"),
        ("hot.txt", f"{RUN} --hot-pixels hot.txt"), ("weights.npz", RUN),
        ("model.pth", "convert model.pth -o new.npz"), ("other.h5", "train -o run --data set"),
        ("clip.mp4", "simulate -o new.h5 --video clip.mp4"),
    ):  # fmt: skip
        code, _, error = firenet(capsys, line)
        assert code == 1 and len(error.splitlines()) == 1, (line, error)
        assert f"{closed}: permission denied: give yourself the right" in error, (line, error)
    monkeypatch.setattr(
        info, "run", Mock(side_effect=PermissionError(13, "Permission denied", "x"))
    )
    assert "error: x: permission denied: give" in firenet(capsys, "info a.txt")[2]


KEEPS = """
import resource, threading
from firenet_jax import cli
cli._set_malloc(cli.KEEP_FREED_MEMORY)

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    b"1" * 100_000_000
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

found = []
thread = threading.Thread(target=lambda: found.extend(faults() for _ in range(3)))
thread.start()
thread.join()
assert found[0] > 1000 > found[2], found
"""


@pytest.mark.skipif(sys.platform != "linux", reason="of glibc")
def test_training_keeps_its_memory():
    """In a thread, as XLA's."""
    environment = {k: v for k, v in os.environ.items() if k != "GLIBC_TUNABLES"}
    subprocess.run([sys.executable, "-c", KEEPS], env=environment, check=True)


LONG_FLOATS = """
import contextlib
from firenet_jax import cli
with contextlib.suppress(SystemExit):
    cli.main(["reconstruct", "--help"])
import jax
assert jax.numpy.ones(1).dtype == "float32"
"""


def test_long_floats_that_jax_has_for_other_programs_are_not_used():
    """They would end in a traceback: a step's state is float32."""
    environment = os.environ | {"JAX_ENABLE_X64": "1"}
    command = [sys.executable, "-c", LONG_FLOATS]
    subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL)
