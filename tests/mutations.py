"""One-line changes to the core -> how many of them the tests of the changed module find.

    python tests/mutations.py --count 50 --seed 0          a quarter of an hour
    python tests/mutations.py --only events windows        these modules' part of the same 50

Change number n is a function of the seed, n and the code: another comparison, sign, number, truth
value or connective. A copy of the package gets it, and the tests of that module run until the
first that fails; a change that makes them take too long counts as found. Those that survive are
printed as a diff: each needs a test, or a line in `EQUIVALENT` that says why it changes nothing.
"""

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
LIMIT = 1200.0  # seconds of one module's tests, at the least
MODULES = {  # what is changed: the tests that must find it
    "events.py": ["events"],
    "windows.py": ["windows"],
    "tensors.py": ["tensors"],
    "network.py": ["network", "arrays"],
    "convolution.py": ["convolution"],
    "reconstruction.py": ["reconstruction", "colour", "instants"],
    "pictures.py": ["pictures"],
    "checkpoint.py": ["checkpoint"],
    "training/losses.py": ["losses"],
    "evaluation/metrics.py": ["metrics"],
    "simulation/sensor.py": ["sensor"],
    "simulation/curricula.py": ["curricula"],
}
EQUIVALENT = {  # (module, line after the change): why nothing changes
    (
        "tensors.py",
        "windows: Sequence[Sequence[Events]], devices: int, at_least: int = 1",
    ): "the smallest size is larger",
    (
        "simulation/curricula.py",
        "sensors = _uneven(sensors, numbers[2], is_slow, slow)",
    ): "JAX takes the last row for one beyond it",
    (
        "simulation/sensor.py",
        "spacing = jnp.where(count >= 1, stride, 0.0).astype(jnp.int32) * run.spacing",
    ): "a run of one event has no second one",
    (
        "windows.py",
        "def _window(events: Events, start: int, stop: int, end: int = 1) -> Window:",
    ): "who leaves `end` out has events, whose last time is taken",
    ("reconstruction.py", "chunk: int = 9,"): "how many windows at a time is speed alone",
    (
        "windows.py",
        'f"{density:,.0f}" if density > 100 else f"{density:.3g}", round(0.35 * pixels),',
    ): "100 reads the same in both ways",
}
COMPARISONS = {
    ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="), ast.Is: ("is", "is not"),
    ast.IsNot: ("is not", "is"), ast.In: ("in", "not in"), ast.NotIn: ("not in", "in"),
}  # fmt: skip
SIGNS = {
    ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "+"), ast.Div: ("/", "*"),
    ast.FloorDiv: ("//", "-"), ast.Mod: ("%", "+"), ast.Pow: ("**", "*"),
}  # fmt: skip
CONNECTIVES = {ast.And: ("and", "or"), ast.Or: ("or", "and")}


class Change(NamedTuple):
    """In one line of a module: these columns hold another text."""

    module: str
    line: int  # from 1
    begin: int
    end: int
    text: str

    def of(self, source: str) -> str:
        lines = source.splitlines(keepends=True)
        row = lines[self.line - 1].encode()  # ast counts bytes
        lines[self.line - 1] = (row[: self.begin] + self.text.encode() + row[self.end :]).decode()
        return "".join(lines)


def changes(module: str, source: str) -> list[Change]:
    """All that can be made of a module, in its order; not in types and texts, nor in errors."""
    lines, found = source.splitlines(), []

    def between(left: ast.AST, right: ast.AST, texts: tuple[str, str]) -> None:
        if left.end_lineno != right.lineno:
            return
        place = lines[left.end_lineno - 1].encode().find(texts[0].encode(), left.end_col_offset)
        if 0 <= place < right.col_offset:
            found.append(Change(module, left.end_lineno, place, place + len(texts[0]), texts[1]))

    def visit(node: ast.AST) -> None:
        if isinstance(node, ast.Raise | ast.JoinedStr | ast.Assert):
            return
        inner = list(ast.iter_child_nodes(node))
        if isinstance(node, ast.AnnAssign):
            inner = [node.value] if node.value else []
        elif isinstance(node, ast.FunctionDef):
            defaults = [one for one in node.args.kw_defaults if one is not None]
            inner = [*node.args.defaults, *defaults, *node.body]
        if isinstance(node, ast.Compare) and len(node.ops) == 1:
            between(node.left, node.comparators[0], COMPARISONS[type(node.ops[0])])
        elif isinstance(node, ast.BinOp) and type(node.op) in SIGNS:
            between(node.left, node.right, SIGNS[type(node.op)])
        elif isinstance(node, ast.BoolOp):
            between(node.values[0], node.values[1], CONNECTIVES[type(node.op)])
        elif isinstance(node, ast.Constant) and type(node.value) in (bool, int, float):
            said = {bool: not node.value, int: node.value + 1, float: 1.5 * node.value + 0.1}
            text = repr(said[type(node.value)])
            found.append(Change(module, node.lineno, node.col_offset, node.end_col_offset, text))
        for one in inner:
            visit(one)

    visit(ast.parse(source))
    return found


def chosen(seed: int, count: int) -> list[Change]:
    """So many, each module's turn after the other's."""
    rng = random.Random(seed)
    waiting = []
    for module in MODULES:
        every = changes(module, (ROOT / "firenet_jax" / module).read_text(encoding="utf-8"))
        waiting.append(rng.sample(every, min(len(every), count)))
    taken = [change for turn in zip(*waiting, strict=False) for change in turn]
    return taken[:count]


def tested(folder: Path, module: str, limit: float) -> tuple[bool, float, str]:
    """(whether the module's tests pass in this copy, seconds, what they print)"""
    tests = [f"tests/test_{name}.py" for name in MODULES[module]]
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-x",
        "-q",
        "--slow",
        "-p",
        "no:cacheprovider",
        *tests,
    ]
    begun = time.monotonic()
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, timeout=limit
        )
    except subprocess.TimeoutExpired:
        return False, limit, ""
    return done.returncode == 0, time.monotonic() - begun, done.stdout + done.stderr


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", help="modules, such as events or metrics")
    options = parser.parse_args()
    wanted = chosen(options.seed, options.count)
    if options.only:
        wanted = [change for change in wanted if Path(change.module).stem in options.only]
    found, equivalent, survived = 0, 0, []
    limits: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in ("firenet_jax", "tests", "experiments", "docs"):
            shutil.copytree(ROOT / part, folder / part)
        for part in ("pyproject.toml", "README.md"):
            shutil.copy(ROOT / part, folder)
        for change in wanted:
            path = folder / "firenet_jax" / change.module
            source = path.read_text(encoding="utf-8")
            if change.module not in limits:  # they must pass as they are, or nothing is shown
                passed, seconds, said = tested(folder, change.module, 10 * LIMIT)
                if not passed:
                    print(f"{said}\n{change.module}: its tests fail without a change")
                    return 2
                limits[change.module] = max(LIMIT, 3 * seconds)
            before = source.splitlines()[change.line - 1].strip()
            after = change.of(source).splitlines()[change.line - 1].strip()
            place = f"{change.module}:{change.line}"
            if (change.module, after) in EQUIVALENT:
                equivalent += 1
                continue
            path.write_text(change.of(source), encoding="utf-8")
            passed, seconds, _ = tested(folder, change.module, limits[change.module])
            path.write_text(source, encoding="utf-8")
            found += not passed
            if passed:
                survived.append(f"{place}\n  - {before}\n  + {after}")
            print(f"{'SURVIVED' if passed else 'found':9}{seconds:6.0f} s  {place}  {after}",
                  flush=True)  # fmt: skip
    print("\n".join(survived))
    print(f"{found} of {found + len(survived)} found; {equivalent} change nothing")
    return 0


if __name__ == "__main__":
    sys.exit(main())
