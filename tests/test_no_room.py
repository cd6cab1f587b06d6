"""A disk that becomes full, in all commands that write: one sentence, and nothing half-written."""

import subprocess
import sys

import h5py
import numpy as np
import pytest
from processes import with_little_room
from test_pipeline import write_recording

from firenet_jax.export.web_page import FILES
from firenet_jax.storage.video import write_video


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
    for name in ("a.txt", "b.txt"):
        write_recording(folder / name, 20_000, width=100, height=80)
    sequence(folder / "a.h5")
    pictures = np.random.default_rng(0).integers(0, 256, (8, 48, 64), np.uint8)
    write_video(folder / "clip.mp4", pictures)
    (folder / "runtime/dist").mkdir(parents=True)
    (folder / "runtime/package.json").write_text('{"version": "1.30.0"}')
    for name in FILES:
        (folder / "runtime/dist" / name).write_bytes(bytes(60_000))


SIMULATE = "--sequences 1 --validation 0 --seconds 0.2 --sensor-size 64x48"
TRAIN = "--steps 4 --warmup 1 --batch 1 --crop 32 --windows 11 --textures 4 --haarpsi 0 --nlpd 0"
TRIALS = {
    "demo": [
        ("-o out.mp4 --seconds 0.4 --sensor-size 64x48", 2_000, "out.mp4"),
        ("-o out.gif --seconds 0.4 --sensor-size 64x48", 2_000, "out.gif"),
        ("-o out --seconds 0.4 --sensor-size 64x48", 2_000, "out"),
    ],
    "reconstruct": [
        ("a.txt -o out -N 2000 --preview", 2_000, "out"),
        ("a.txt -o out.mp4 -N 2000 --preview", 2_000, "out.mp4"),
        ("a.txt -o out.gif -N 2000 --preview", 2_000, "out.gif"),
        ("a.txt -o out.h5 -N 2000", 20_000, "out.h5"),
        ("a.txt -o out.bag -N 2000", 20_000, "out.bag"),
        ("a.txt -o out.ros2 -N 2000", 20_000, "out.ros2"),
        ("a.txt b.txt -o several -N 2000", 2_000, "several/a"),
    ],
    "export": [
        (f"-o model{suffix}", 20_000, f"model{suffix}")
        for suffix in (".onnx", ".stablehlo", ".pth", ".safetensors")
    ]
    + [("--web page --runtime runtime --sample a.txt", 50_000, "page")],
    "simulate": [
        (SIMULATE + " -o one", 3_000, "one/train/000000.h5"),
        (SIMULATE + " -o two", 30_000, "two/train/000000.h5"),
        ("-o out.h5 --video clip.mp4", 5_000, "out.h5"),
    ],
    "train": [
        (TRAIN + " -o one", 100, "one/settings.json"),
        (TRAIN + " -o two", 40_000, "two/weights.npz"),
    ],
    "evaluate": [("a.h5 -o out --methods firenet", 3_000, "out/index.html")],
    "convert": [("{reference}/firenet_published.pth -o out.npz", 40_000, "out.npz")],
}


def may_mount() -> bool:
    """Whether this user may mount a disk in memory, for a process alone."""
    if sys.platform != "linux":
        return False
    return subprocess.run(["unshare", "-rm", "true"], capture_output=True).returncode == 0


@pytest.mark.skipif(sys.platform == "win32", reason="no limits of this kind")
@pytest.mark.slow
@pytest.mark.parametrize("command", TRIALS)
def test_one_sentence_and_nothing_half_written(tmp_path, request, command):
    """On a disk of a megabyte that is really full; where none can be mounted, with a limit of a
    file's size in its stead."""
    inputs, disk = tmp_path / "inputs", tmp_path / "disk"
    inputs.mkdir()
    disk.mkdir()
    make_inputs(inputs)
    reference = request.getfixturevalue("reference") if command == "convert" else None
    lines = [
        (limit, f"{command} {line.format(reference=reference)}")
        for line, limit, _ in TRIALS[command]
    ]
    mounted = may_mount()
    ran = with_little_room(inputs, *lines, disk=disk if mounted else None)
    for (code, said, left), (line, _, output) in zip(ran, TRIALS[command], strict=True):
        assert code == 1, (line, said)
        errors = [each for each in said if each.startswith("firenet: error: ")]
        assert len(errors) == 1 and said[-1] == errors[0], (line, said)
        assert not any("Traceback" in each or "Exception" in each for each in said), said
        # A database does not say what its file met.
        limit = "disk I/O error" if output.endswith(".ros2") else "File too large"
        full = ("No space left", "disk is full") if mounted else (limit,)
        assert any(why in errors[0] for why in full), errors
        assert output not in left, (line, left)
