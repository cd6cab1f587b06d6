"""Who may import whom, what is public, and what `firenet --help` loads."""

import ast
import graphlib
import subprocess
import sys
from pathlib import Path

import pytest
from test_pipeline import write_recording

import firenet_jax as fj

PACKAGE = Path(fj.__file__).parent

# The rooms are folders, the heart's modules lie flat. Left never imports right; what stands on one
# line does not import each other; within a room, nothing runs in a circle.
LAYERS = [
    ["native", "errors"],
    ["settings"],
    ["events", "colour", "convolution", "pictures", "warp", "devices"],
    ["blocks"],
    ["storage", "windows", "network"],
    ["readers", "tensors", "checkpoint", "filters", "instants"],
    ["reconstruction", "simulation"],
    ["evaluation", "export", "live"],
    ["training"],
    ["commands"],
    ["cli"],
    ["__main__"],
]
# Each outside library enters by one door.
DOORS = {
    "flax": {"network", "checkpoint", "evaluation.baselines"}, "optax": {"training.step"},
    "orbax": {"training.run"}, "torch": set(), "av": {"storage.video", "simulation.clip"},
    "h5py": {"readers", "training.batches", "storage"},
    "pyarrow": {"readers"}, "grain": {"training.batches"}, "faery": {"readers"},
    "rosbags": {"readers", "storage.bag"}, "hdf5plugin": {"readers"},
    "skimage": {"evaluation.equalise"}, "llvmlite": {"native"}, "onnx": {"export"},
    "safetensors": {"export"}, "flatbuffers": {"export"},
}  # fmt: skip


def modules():
    """(room or heart's module, full name without the package, path)"""
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        if parts != ("__init__",):
            name = ".".join(part for part in parts if part != "__init__")
            yield parts[0], name, path


def imports(path):
    """Full names of all that a file imports, at its top or inside a function."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            if (PACKAGE.parent / node.module.replace(".", "/")).is_dir():
                # of a room, a module or what its __init__ holds
                yield from (f"{node.module}.{alias.name}" for alias in node.names)
            else:
                yield node.module


def layer(name):
    return next((i for i, names in enumerate(LAYERS) if name in names), None)


def test_every_module_has_its_place():
    assert {room for room, _, _ in modules()} == {name for names in LAYERS for name in names}


@pytest.mark.parametrize("room, name, path", [pytest.param(*m, id=m[1]) for m in modules()])
def test_imports_go_from_right_to_left(room, name, path):
    for imported in imports(path):
        parts = imported.split(".")
        assert parts[0] not in ("experiments", "tests"), f"{name} imports {imported}"
        if parts[0] == "firenet_jax" and len(parts) > 1 and parts[1] != room:
            assert layer(parts[1]) < layer(room), f"{name} imports {imported}"
        if parts[0] in DOORS:
            through = DOORS[parts[0]]
            inside = any(f"{name}.".startswith(f"{door}.") for door in through)
            assert inside, f"{imported} enters by {through}, not by {name}"


def test_computing_never_imports_presenting():
    for _, name, path in modules():
        if name not in ("evaluation.report", "commands.evaluate"):
            assert "firenet_jax.evaluation.report" not in " ".join(imports(path)), name


LINES, PARAMETERS = 60, 7
LARGER = {  # function: why
    "readers.arrays.recording": "one option a fact that no file says",
    "reconstruction.reconstruct_at": "what `reconstruct` takes, and the instants",
    "reconstruction.events_to_pictures": "one compiled program: what it is made for are options",
    "simulation.scenes.random_scene": "random numbers are handed out in one order, read as a list",
    "simulation.curricula.random_setups": "one option a choice, all with defaults",
    "storage.pytorch_file._unpickle": "one case for each of the format's instructions",
    "tensors.pack": "one pass that fills arrays in place",
    "training.batches._example": "what a random example depends on",
    "training.batches.batches": "what a batch depends on, each with a default",
}


def test_functions_are_short_and_take_little():
    large = set()
    for room, name, path in modules():
        if room == "native":  # it writes machine code, line by line
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                given = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
                lines = node.end_lineno - node.lineno + 1
                if lines > LINES or len(given) > PARAMETERS:
                    large.add(f"{name}.{node.name}")
    assert large <= LARGER.keys(), sorted(large - LARGER.keys())


def test_nothing_runs_in_a_circle():
    names = {name for _, name, _ in modules()}
    needs = {}
    for _, name, path in modules():
        found = set()
        for imported in imports(path):
            inner = imported.removeprefix("firenet_jax.")
            while inner and inner not in names:
                inner = inner.rpartition(".")[0]
            found |= {inner} - {"", name}
        needs[name] = found
    # A format's module and the list of formats know each other; the list asks late.
    needs["readers"] = {n for n in needs["readers"] if not n.startswith("readers.")}
    tuple(graphlib.TopologicalSorter(needs).static_order())


def test_every_module_opens_with_what_flows_through_it():
    for _, name, path in modules():
        first = ast.get_docstring(ast.parse(path.read_text())).splitlines()[0]
        assert "->" in first or name == "commands", f"{path.name}: {first}"


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
