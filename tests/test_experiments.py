"""Every script of `experiments/` runs to its end, on next to nothing; its figures mean nothing."""

import importlib.util
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from test_pipeline import write_recording

import firenet_jax as fj

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
WEIGHTS = Path(fj.__file__).parent / "weights" / "firenet.npz"

# Arguments that leave next to nothing to do. {recording} is a small one, {folder} where it lies.
SMALL = {
    "bfloat16": f"{WEIGHTS} {{recording}} --windows 12",
    "calibration": "--seconds 0.3",
    "colour_mosaic": "--windows 4",
    "compare_losses": "{folder}/runs --steps 1 --only l1",
    "compare_optimisers": "{folder}/runs --steps 1 --only 'muon, rate 3e-3'",
    "endurance": f"{WEIGHTS} --recordings {{folder}} --only palindrome contrast",
    "figure3_qualitative": "--seconds 0.2",
    "figure4_high_speed": "--seconds 0.1 --windows 4",
    "figure5_recurrence": "--seconds 0.2",
    "figure6_limitations": "--seconds 0.2 --sequences 1",
    "file_to_pictures": "--events 60000 --runs 1",
    "instants": "{recording}",
    "memory": "--hdf5 200000 --text 200000 --runs 1",
    "readme_picture": f"{WEIGHTS} {{recording}}",
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
SHARED = {"figures", "harness", "pytorch_firenet"}  # no scripts: what several import


def test_no_script_is_forgotten():
    assert {path.stem for path in EXPERIMENTS.glob("*.py")} == SMALL.keys() | SHARED


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
def test_runs(name, tmp_path):
    script = (EXPERIMENTS / f"{name}.py").read_text()
    for library in re.findall(r"^import (torch|pandas|cv2)$", script, re.MULTILINE):
        if importlib.util.find_spec(library) is None:
            pytest.skip(f"needs {library}")
    # A copy, because scripts write beside themselves.
    shutil.copytree(EXPERIMENTS, tmp_path / "experiments")
    (tmp_path / "docs").mkdir()
    recording = tmp_path / "recordings" / "random.txt"
    recording.parent.mkdir()
    write_recording(recording, 20_000, width=64, height=48)
    arguments = shlex.split(SMALL[name].format(recording=recording, folder=recording.parent))
    done = subprocess.run(
        [sys.executable, f"experiments/{name}.py", *arguments],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
