"""What is installed without extras runs, and a command that lacks one says which."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from firenet_jax.cli import EXTRAS

HIDDEN = [*EXTRAS, "faery", "rosbags", "hdf5plugin"]
WITHOUT = f"""
import sys
from importlib.machinery import PathFinder

class Without(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        hidden = name.partition(".")[0] in {HIDDEN!r}
        return None if hidden else super().find_spec(name, path, target)

sys.meta_path[sys.meta_path.index(PathFinder)] = Without
from firenet_jax import cli
"""


def without(lines: str) -> subprocess.CompletedProcess:
    code = WITHOUT + lines
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)


def test_reconstruction_and_simulation_need_no_extras():
    ended = without(
        "from firenet_jax import readers\n"
        "from firenet_jax.commands import convert, demo, info, reconstruct, simulate\n"
        "from firenet_jax.simulation.textures import load_textures\n"
        "assert load_textures(None, 2, 32).shape == (2, 32, 32)\n"
        "import importlib\n"
        "for name in readers.FORMATS: importlib.import_module(f'firenet_jax.readers.{name}')"
    )
    assert ended.returncode == 0, ended.stderr


@pytest.mark.parametrize(
    "line, extra", [("train -o run", "train"), ("evaluate a -o b", "evaluate")]
)
def test_a_command_that_lacks_an_extra_says_which(line, extra):
    ended = without(f"sys.exit(cli.main({line.split()!r}))")
    said = ended.stderr.splitlines()
    assert ended.returncode == 1 and len(said) == 1, ended.stderr
    assert said[0].startswith(f"firenet: error: firenet {line.split()[0]} needs ")
    assert said[0].endswith(f'not installed: in the source folder, pip install ".[{extra}]"')


def test_each_library_is_in_the_extra_that_the_sentence_names():
    project = Path(__file__).parent.parent / "pyproject.toml"
    extras = tomllib.loads(project.read_text())["project"]["optional-dependencies"]
    named = {"orbax": "orbax-checkpoint", "skimage": "scikit-image"}
    for library, extra in EXTRAS.items():
        assert any(entry.startswith(named.get(library, library)) for entry in extras[extra])
    brought = extras["all"][0].removeprefix("firenet-jax[").rstrip("]").split(",")
    assert {"train", "evaluate", "formats"} <= set(brought)
