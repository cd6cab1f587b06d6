"""A disk that becomes full, in every command that writes: one sentence, and nothing half-written.

A limit on the size of a file stands for the disk, in a process of its own: it needs no rights, and
the libraries in C meet it where they write.
"""

import os
import subprocess
import sys

import h5py
import numpy as np
import pytest
from test_pipeline import write_recording

from firenet_jax.storage.video import write_video

SCRIPT = """
import resource, sys
import h5py, jax, orbax.checkpoint  # before the limit: they write files of their own
from firenet_jax import cli
limit, *arguments = sys.argv[1:]
resource.setrlimit(resource.RLIMIT_FSIZE, (int(limit), int(limit)))
sys.exit(cli.main(arguments))
"""


def sequence(path, size=32, images=40):
    """HDF5 with events and images, large enough to be evaluated and trained on."""
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        columns = {"xs": rng.integers(0, size, 4000), "ys": rng.integers(0, size, 4000)}
        columns |= {"ts": np.linspace(0, 1, 4000), "ps": rng.random(4000) < 0.5}
        for name, column in columns.items():
            file[f"events/{name}"] = column
        for k in range(images):
            file[f"images/image{k:09d}"] = rng.integers(0, 256, (size, size), np.uint8)
            file[f"images/image{k:09d}"].attrs["timestamp"] = k / (images - 1)
        file.attrs["sensor_resolution"] = (size, size)


def make_inputs(folder):
    write_recording(folder / "a.txt", 20_000, width=100, height=80)
    sequence(folder / "a.h5")
    pictures = np.random.default_rng(0).integers(0, 256, (8, 48, 64), np.uint8)
    write_video(folder / "clip.mp4", pictures)


TRAIN = "train -o out --steps 4 --warmup 1 --batch 1 --crop 32 --windows 11 --textures 4"
TRIALS = [
    ("demo -o out.mp4 --seconds 0.4 --sensor-size 64x48", 2_000, "out.mp4"),
    ("demo -o out.gif --seconds 0.4 --sensor-size 64x48", 2_000, "out.gif"),
    ("demo -o out --seconds 0.4 --sensor-size 64x48", 2_000, "out"),
    ("reconstruct a.txt -o out -N 2000 --preview", 2_000, "out"),
    ("reconstruct a.txt -o out.mp4 -N 2000 --preview", 2_000, "out.mp4"),
    ("simulate -o set --sequences 1 --validation 0 --seconds 0.2 --sensor-size 64x48", 3_000,
     "set/train/000000.h5"),
    ("simulate -o set --sequences 1 --validation 0 --seconds 0.2 --sensor-size 64x48", 30_000,
     "set/train/000000.h5"),
    ("simulate -o out.h5 --video clip.mp4", 5_000, "out.h5"),
    (TRAIN, 100, "out/settings.json"),
    (TRAIN, 40_000, "out/weights.npz"),
    ("evaluate a.h5 -o out --methods firenet", 3_000, "out/index.html"),
    ("convert {reference}/firenet_published.pth -o out.npz", 40_000, "out.npz"),
]  # fmt: skip


@pytest.mark.skipif(sys.platform == "win32", reason="no limits of this kind")
@pytest.mark.slow
@pytest.mark.parametrize("line, limit, output", TRIALS)
def test_one_sentence_and_nothing_half_written(tmp_path, request, line, limit, output):
    make_inputs(tmp_path)
    if "{reference}" in line:
        line = line.format(reference=request.getfixturevalue("reference"))
    ran = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(limit), *line.split()],
        cwd=tmp_path, capture_output=True, text=True, timeout=300,
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
    )  # fmt: skip
    said = ran.stderr.strip().splitlines()
    assert ran.returncode == 1, (ran.returncode, ran.stderr[-2000:])
    errors = [line for line in said if line.startswith("firenet: error: ")]
    assert len(errors) == 1 and said[-1] == errors[0], ran.stderr[-2000:]
    assert "Traceback" not in ran.stderr and "Exception" not in ran.stderr, ran.stderr[-2000:]
    assert "File too large" in errors[0], errors
    assert not (tmp_path / output).exists()
