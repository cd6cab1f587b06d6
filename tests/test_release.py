"""What goes out: a small wheel that holds all that it needs, with its facts."""

import io
import tomllib
import zipfile
from pathlib import Path

import firenet_jax as fj

PACKAGE = Path(fj.__file__).parent
PROJECT = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
MOST = 1_000_000  # bytes of a wheel, with weights


def test_the_wheel_stays_below_a_megabyte():
    """The same files, deflated as in a wheel."""
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", zipfile.ZIP_DEFLATED) as wheel:
        for path in sorted(PACKAGE.rglob("*")):
            if path.is_file() and "__pycache__" not in path.parts:
                wheel.write(path, path.relative_to(PACKAGE.parent))
        names = wheel.namelist()
    assert {"firenet_jax/weights/firenet.npz", "firenet_jax/py.typed"} <= set(names)
    assert 200_000 < len(held.getvalue()) < MOST


def test_the_facts_that_a_registry_shows():
    for name in ("description", "readme", "license", "keywords", "classifiers"):
        assert PROJECT.get(name), name
    assert (PACKAGE.parent / PROJECT["readme"]).exists()
    assert all((PACKAGE.parent / name).exists() for name in PROJECT["license-files"])
