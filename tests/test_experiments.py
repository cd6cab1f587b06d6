"""Every script of `experiments/` runs to its end, on next to nothing; its figures mean nothing."""

import importlib
import importlib.util
import json
import re
import shlex
import shutil
from pathlib import Path

import pytest
from processes import FEW_OPTIMISATIONS, run_forked
from test_pipeline import write_recording
from test_snippets import write_with_frames

import firenet_jax as fj

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
WEIGHTS = Path(fj.__file__).parent / "weights" / "firenet.npz"

# Arguments that leave next to nothing to do. {recording} is a small one, {folder} where it lies,
# {frames} one of a camera that takes pictures too.
SMALL = {
    "bfloat16": f"{WEIGHTS} {{recording}} --windows 12",
    "calibration": "--seconds 0.3",
    "colour_mosaic": "--windows 4",
    "compare_losses": "{folder}/runs --steps 1 --only l1",
    "compare_optimisers": "{folder}/runs --steps 1 --only 'muon, rate 3e-3'",
    "dormant": str(WEIGHTS),
    "endurance": f"{WEIGHTS} --recordings {{folder}} --only palindrome contrast clip",
    "exactness": "--cases 1",
    "figure3_qualitative": "--seconds 0.2",
    "figure4_high_speed": "--seconds 0.1 --windows 4",
    "figure5_recurrence": "--seconds 0.2",
    "figure6_limitations": "--seconds 0.2 --sequences 1",
    "file_to_pictures": "--events 60000 --runs 1",
    "fine_tune": "{frames} --steps 1 --chain 1 --crop 24",
    "instants": "{recording}",
    "live": "{recording} --seconds 3",
    "memory": "--hdf5 20000 --text 20000 --runs 1",
    "onnxruntime_step": "--sizes 48x32 --windows 2 --runs 1",
    "readme_video": f"{WEIGHTS} {{recording}}",
    "scaling": "--quick",
    "shipped_weights": f"{WEIGHTS} {{recording}} --skip-simulated",
    "simulator_speed": "--runs 1 --lists 1",
    "simulator_statistics": "{folder} --sequences 1",
    "table1_model_size": "",
    "table2_computational_cost": "--quick",
    "table3_accuracy": "--seconds 0.4",
    "train_default": "none --report-only",
    "voxelisation": "--events 10000 --runs 1 --repeats 1",
    "xla_vs_pytorch": "--quick --parts pipeline",
}
SHARED = {
    "at_rest",
    "figures",
    "harness",
    "holding",
    "pytorch_firenet",
}  # no scripts: what others import
# "browser" needs one: test_web_page.py uses its parts where there is one.
ELSEWHERE = {"browser", "model_card"}

# What no argument makes small: line or part of it -> what stands there instead.
SMALLER = {
    "colour_mosaic": {
        '("astronaut", "coffee", "chelsea")': '("astronaut",)',
        "HEIGHT, WIDTH = 180, 240": "HEIGHT, WIDTH = 60, 80",
    },
    "compare_losses": {
        "BATCH, BATCHES = 160, 32, 16, 2, 8": "BATCH, BATCHES = 160, 4, 2, 2, 1",
        "textures=256,": "textures=4,",
        "crop=64,": "crop=32,\n        windows=11,",
    },
    "compare_optimisers": {
        "textures=512,": "textures=4,",
        "crop=64,": "crop=32,",
        "windows=16,": "windows=11,",
    },
    "dormant": {"batch=4, windows=30": "batch=1, windows=10"},
    "endurance": {
        "ROUNDS = 40": "ROUNDS = 2",
        "CLIP_PICTURES = 100.0, 400": "CLIP_PICTURES = 100.0, 8",
    },
    "figure4_high_speed": {
        '"height": 480, "width": 640': '"height": 120, "width": 160',
        "EVENTS, SPEED, MOMENTS = 50_000": "EVENTS, SPEED, MOMENTS = 2_000",
    },
    "figure6_limitations": {"SPEEDS = (50.0, 600.0, 1500.0)": "SPEEDS = (50.0, 1500.0)"},
    "figures": {
        "HEIGHT, WIDTH = 180, 240": "HEIGHT, WIDTH = 90, 120",
        '    "slow": (50.0, False),\n': "",
        '    "fast, faulty sensor": (250.0, True),\n': "",
    },
    "memory": {"HEIGHT, WIDTH = 480, 640": "HEIGHT, WIDTH = 48, 64"},
    "scaling": {
        'POINT = {"width": 240, "height": 180,': 'POINT = {"width": 80, "height": 60,',
        "RESOLUTIONS = [(240, 180),": "RESOLUTIONS = [(80, 60),",
        "((1, 1), (2, 1), (4, 1), (1, 2))": "((2, 1), (1, 2))",
    },
    "simulator_speed": {
        "BATCH, WINDOWS, SIZE, RENDERINGS = 4, 20, 128, 5": "BATCH, WINDOWS, SIZE, RENDERINGS = "
        "2, 4, 32, 5",
        '    "objects, no faults": (SceneSettings(), SensorSettings()),\n': "",
        '    "planar, all faults": (SceneSettings(objects=0), FAULTY),\n': "",
        "load_textures(None, 64, 256)": "load_textures(None, 4, 256)",
        '{"height": 180, "width": 240}': '{"height": 60, "width": 80}',
    },
    "simulator_statistics": {
        "HEIGHT, WIDTH = 180, 240": "HEIGHT, WIDTH = 60, 80",
        "SECONDS = 1.0": "SECONDS = 0.3",
        "count=64, size=320": "count=4, size=96",
    },
    "train_default": {"SceneSettings(objects=2, pause=0.2)": "SceneSettings(objects=0)"},
    "voxelisation": {"HEIGHT, WIDTH, BINS = 480, 640": "HEIGHT, WIDTH, BINS = 48, 64"},
    "xla_vs_pytorch": {  # captures the graph; a C++ compiler would take a minute for it
        "torch.compile(eager(NHWC), dynamic=False)": "torch.compile(eager(NHWC), backend='eager')"
    },
}


def test_no_script_is_forgotten():
    assert {path.stem for path in EXPERIMENTS.glob("*.py")} == SMALL.keys() | SHARED | ELSEWHERE


def test_tables_of_the_model_card_hold_what_was_measured(monkeypatch):
    monkeypatch.syspath_prepend(EXPERIMENTS)
    card = importlib.import_module("model_card")
    results = [
        json.loads((EXPERIMENTS / "results" / f"{name}.json").read_text())
        for name in ("shipped_weights", "endurance")
    ]
    text = card.CARD.read_text()
    assert card.filled(text, *results) == text
    results[1]["rest"][0]["correlation 50"] += 0.02
    assert card.filled(text, *results) != text


def test_the_model_card_is_told_where_others_are_ahead(monkeypatch):
    monkeypatch.syspath_prepend(EXPERIMENTS)
    card = importlib.import_module("model_card")
    rows = [
        {"kind": kind, "weights": name, "ssim": ssim, "mse": mse}
        for kind, name, ssim, mse in (
            ("a", "published", 0.5, 0.04), ("a", "cista", 0.8, 0.05), ("a", "ours", 0.6, 0.03),
            ("b", "published", 0.5, 0.02), ("b", "another", 0.9, 0.01), ("b", "ours", 0.5, 0.03),
        )
    ]  # fmt: skip
    assert list(card.behind("some", rows, ("kind",))) == [
        "some, a: ssim 0.6000, cista 0.8000 (-25.0 %)",
        "some, b: mse 0.0300, published 0.0200 (+50.0 %)",
    ]


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
def test_runs(name, tmp_path):
    script = (EXPERIMENTS / f"{name}.py").read_text()
    for library in re.findall(r"^import (torch|pandas|cv2)$", script, re.MULTILINE):
        if importlib.util.find_spec(library) is None:
            pytest.skip(f"needs {library}")
    # A copy, because scripts write beside themselves.
    shutil.copytree(EXPERIMENTS, tmp_path / "experiments", ignore=shutil.ignore_patterns("*.png"))
    for changed, parts in SMALLER.items():
        path = tmp_path / "experiments" / f"{changed}.py"
        text = path.read_text()
        for old, new in parts.items():
            assert text.count(old) == 1, f"{changed}.py: {old} is there {text.count(old)} times"
            text = text.replace(old, new)
        path.write_text(text)
    (tmp_path / "docs").mkdir()
    recording = tmp_path / "recordings" / "random.txt"
    recording.parent.mkdir()
    write_recording(recording, 20_000, width=64, height=48)
    frames = tmp_path / "frames.zip"
    write_with_frames(frames)
    named = {"recording": recording, "folder": recording.parent, "frames": frames}
    arguments = shlex.split(SMALL[name].format(**named))
    script = f"experiments/{name}.py"
    code, written = run_forked(script, arguments, tmp_path, **FEW_OPTIMISATIONS)
    assert code == 0, written[-2000:]
