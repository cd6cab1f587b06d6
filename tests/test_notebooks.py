"""Each notebook of the site runs from top to bottom, and holds no results."""

import ast
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

NOTEBOOKS = sorted((Path(__file__).parents[1] / "docs").glob("*.ipynb"))


def code(path):
    cells = json.loads(path.read_text())["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def test_there_are_two():
    assert [path.stem for path in NOTEBOOKS] == ["functions", "small_training"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_results_are_not_kept(path):
    """They would be out of date as soon as they are there, and a diff that nobody reads."""
    for cell in json.loads(path.read_text())["cells"]:
        assert not cell.get("outputs") and cell.get("execution_count") is None
    assert path.stat().st_size < 50_000


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_runs(path, monkeypatch):
    """Cell by cell in one namespace, as a kernel does; the asserts in them hold. An expression at
    the end of a cell is what a reader sees."""
    monkeypatch.setenv("STEPS", "3")
    names = {"__name__": "__main__"}
    for number, text in enumerate(code(path)):
        cell = ast.parse(text)
        last = cell.body.pop() if isinstance(cell.body[-1], ast.Expr) else None
        exec(compile(cell, f"{path.name}, cell {number}", "exec"), names)
        if last is not None:
            shown = eval(compile(ast.Expression(last.value), path.name, "eval"), names)
            if isinstance(shown, Image.Image):
                assert len(np.unique(np.asarray(shown))) > 10, "nothing to see"
