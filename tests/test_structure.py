"""Who may import whom, what is public, and what `firenet --help` loads."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest
from test_pipeline import write_recording

import firenet_jax as fj

PACKAGE = Path(fj.__file__).parent

# Left never imports right. Modules on one line do not import each other.
LAYERS = [
    ["native"],
    [
        "events",
        "colour",
        "convolution",
        "pictures",
        "files",
        "overlap",
        "progress",
        "pytorch_file",
        "warp",
        "equalise",
        "devices",
    ],
    [
        "video",
        "readers",
        "windows",
        "network",
        "metrics",
        "scenes",
        "textures",
        "lpips",
    ],
    ["arrays", "filters", "tensors", "checkpoint", "losses"],
    ["reconstruction", "sensor"],
    ["baselines"],
    ["info", "pipeline", "dataset", "batches", "methods", "report"],
    ["comparison"],
    ["train", "evaluate"],
    ["demo"],
    ["cli"],
]
# Each outside library enters by one door.
DOORS = {
    "flax": {"network", "baselines"}, "optax": {"train"}, "orbax": {"train"}, "torch": set(),
    "av": {"video", "dataset"}, "h5py": {"readers", "dataset", "batches", "evaluate"},
    "pyarrow": {"readers"},
    "grain": {"batches"}, "faery": {"readers"}, "rosbags": {"readers"}, "hdf5plugin": {"readers"},
    "skimage": {"equalise"}, "llvmlite": {"native"},
}  # fmt: skip


def modules():
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).with_suffix("").parts[0]
        if name != "__init__":
            yield name, path


def imports(path):
    """Full names of all that a file imports, at its top or inside a function."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module
            if node.module == "firenet_jax":
                yield from (f"firenet_jax.{alias.name}" for alias in node.names)


def layer(name):
    return next((i for i, names in enumerate(LAYERS) if name in names), None)


def test_every_module_has_its_place():
    assert {name for name, _ in modules()} <= {name for names in LAYERS for name in names}


@pytest.mark.parametrize("name, path", list(modules()), ids=lambda value: str(value)[-30:])
def test_imports_go_from_right_to_left(name, path):
    for imported in imports(path):
        parts = imported.split(".")
        if parts[0] == "experiments" or parts[0] == "tests":
            raise AssertionError(f"{name} imports {imported}")
        if parts[0] == "firenet_jax" and len(parts) > 1 and parts[1] != name:
            assert layer(parts[1]) < layer(name), f"{name} imports {imported}"
        if parts[0] in DOORS:
            assert name in DOORS[parts[0]], f"{imported} enters by {DOORS[parts[0]]}, not {name}"


def test_every_module_opens_with_what_flows_through_it():
    for _, path in modules():
        first = ast.get_docstring(ast.parse(path.read_text())).splitlines()[0]
        assert "->" in first, f"{path.name}: {first}"


def test_public_names_exist_have_docstrings_and_are_no_modules():
    for name in fj.__all__:
        doc = getattr(fj, name).__doc__
        assert doc and not doc.startswith(f"{name}("), name  # that is what a dataclass makes
        assert not (PACKAGE / f"{name}.py").exists(), f"importing fj.{name} would hide it"
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        fj.nonsense  # noqa: B018


def test_the_example_of_the_package_runs(tmp_path, monkeypatch):
    example = [line[4:] for line in fj.__doc__.splitlines() if line.startswith("    ")]
    monkeypatch.chdir(tmp_path)
    write_recording(tmp_path / "dynamic_6dof.txt", 2000, width=24, height=18)
    names = {}
    code = "\n".join(example[example.index("import firenet_jax as fj") :])
    exec(code.replace(".zip", ".txt"), names)
    assert names["images"].shape == (len(names["times"]), 1, 18, 24)


@pytest.mark.parametrize("command", ["import firenet_jax", "cli.main(['--help'])"])
def test_loads_no_jax_before_it_is_needed(command):
    script = (
        f"import sys; from firenet_jax import cli; {command}; "
        "assert not {'jax', 'flax', 'av', 'h5py', 'pyarrow', 'torch'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", script], check=True, capture_output=True)
