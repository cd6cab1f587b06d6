"""Every script of `experiments/` runs to its end, on next to nothing; its figures mean nothing."""

import importlib
import importlib.util
import json
import re
import shlex
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
from processes import FEW_OPTIMISATIONS, run_forked
from test_pipeline import write_recording
from test_snippets import write_with_frames

import firenet_jax as fj
from firenet_jax.evaluation import metrics
from firenet_jax.simulation.scenes import SceneSettings
from firenet_jax.training.losses import Loss
from firenet_jax.training.settings import Train

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


def test_noise_of_rests_is_balanced_and_as_much_as_it_says(monkeypatch):
    monkeypatch.syspath_prepend(EXPERIMENTS)
    at_rest = importlib.import_module("at_rest")
    noise = np.asarray(at_rest.balanced(jax.random.key(0), (10, 8, 60, 60, 5)))
    events = np.abs(noise).sum(-1).mean((0, 2, 3))
    np.testing.assert_allclose(events, at_rest.NOISES, rtol=0.1)
    assert np.abs(noise.sum(-1).mean((0, 2, 3))).max() < 0.01


@pytest.mark.slow
def test_a_stage_at_rest_trains_what_has_a_memory_and_nothing_else(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(EXPERIMENTS)
    at_rest = importlib.import_module("at_rest")
    settings = Train(
        tmp_path, textures=2, crop=16, batch=8, windows=11, scene=SceneSettings(objects=0)
    )
    made = at_rest.keep_at_rest(WEIGHTS, settings, tmp_path / "made.npz", steps=2, rate=1e-3)
    before, after = fj.load_weights(WEIGHTS).params, fj.load_weights(made).params
    for name in before:
        pairs = zip(*map(jax.tree.leaves, (before[name], after[name])), strict=True)
        apart = max(float(np.abs(a - b).max()) for a, b in pairs)
        assert (0 < apart < 0.01) if name in at_rest.FREE else apart == 0


@pytest.mark.slow
def test_a_stage_that_holds_trains_all_parts(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(EXPERIMENTS)
    holding = importlib.import_module("holding")
    monkeypatch.setattr(holding, "CUT", 16)
    settings = Train(
        tmp_path, textures=4, batch=2, crop=20, windows=2, chain=2, warmup=0,
        loss=Loss(nlpd=0, haarpsi=0, lambda_tc=0, l0=1),
        scene=SceneSettings(objects=0), optimiser="centred",
    )  # fmt: skip
    made = holding.train_and_hold(WEIGHTS, settings, tmp_path / "made.npz", steps=3)
    before, after = fj.load_weights(WEIGHTS).params, fj.load_weights(made).params
    for name in before:
        pairs = zip(*map(jax.tree.leaves, (before[name], after[name])), strict=True)
        assert 0 < max(float(np.abs(a - b).max()) for a, b in pairs) < 0.01


def test_what_goes_to_and_fro_is_held_to_its_first_round(monkeypatch):
    """Backward first, as it begins where forward has ended; in two places at two ages."""
    monkeypatch.syspath_prepend(EXPERIMENTS)
    holding = importlib.import_module("holding")
    rng = np.random.default_rng(0)
    tensors = rng.normal(size=(3, 2, 4, 4, 5)).astype(np.float32)
    back, forth = rng.random((2, 3, 2, 4, 4)).astype(np.float32)
    held = holding.nothing_held(3)._replace(
        tensors=tensors, first=(back, forth), passes=np.array([4, 7])
    )
    given, wanted = holding.next_pass(held)
    np.testing.assert_array_equal(given[:, 1], tensors[:, 1])
    np.testing.assert_array_equal(wanted[:, 1], forth[:, 1])
    for t in range(3):
        for n in range(5):
            np.testing.assert_array_equal(given[t, 0, ..., n], -tensors[2 - t, 0, ..., 4 - n])
    np.testing.assert_array_equal(wanted[:, 0], back[:, 0])
    # a shift of brightness counts four times, a difference that it lacks once; some not at all
    images = np.zeros((1, 2, 4, 4), np.float32)
    even, odd = images + 0.1, images + 0.1 * (-1) ** np.arange(4)
    assert holding.moved(even, images, np.ones(2)) == pytest.approx(0.4)
    assert holding.moved(odd, images, np.ones(2)) == pytest.approx(0.1)
    assert holding.moved(even, images, np.array([1, 0])) == pytest.approx(0.2)


def test_what_is_alike_is_so_at_any_contrast(monkeypatch):
    monkeypatch.syspath_prepend(EXPERIMENTS)
    holding = importlib.import_module("holding")
    images = np.random.default_rng(0).random((3, 2, 8, 8)).astype(np.float32)
    flat = 0.5 * images + 0.5 * images.mean((-2, -1), keepdims=True)
    assert float(holding.unlike(flat, images, np.ones(2))) == pytest.approx(0, abs=1e-3)
    assert float(holding.unlike(images + 0.1, images, np.ones(2))) == pytest.approx(0.3, abs=1e-3)
    for k in range(2):
        other = images[::-1]
        pairs = [(a[k].ravel(), b[k].ravel()) for a, b in zip(other, images, strict=True)]
        expected = [1 - np.corrcoef(*p)[0, 1] + 3 * abs(np.subtract(*p).mean()) for p in pairs]
        found = float(holding.unlike(other, images, np.arange(2) == k))
        assert found == pytest.approx(np.mean(expected) / 2, abs=1e-3)


def test_equalised_losses_tell_apart_what_a_stage_wants(monkeypatch):
    """A texture of 0.003: 0.12 of the one, and 0.3 of the other."""
    monkeypatch.syspath_prepend(EXPERIMENTS)
    holding = importlib.import_module("holding")
    image = np.full((36, 36), 0.5, np.float32)
    texture = image + 0.003 * (-1) ** np.add.outer(*[np.arange(36) // 3] * 2)
    usual = float(metrics.equalised_mse(image, texture))
    with holding.telling_apart(0.05):
        assert float(metrics.equalised_mse(image, texture)) == pytest.approx(usual, rel=1e-5)
    with holding.telling_apart(0.02):
        finer = float(metrics.equalised_mse(image, texture))
    assert finer == pytest.approx((0.3 / 0.12) ** 2 * usual, rel=0.02)
    assert metrics.equalised_mse(image, texture) == usual


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
