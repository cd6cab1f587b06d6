"""What goes out: a small wheel that holds all that it needs, with its facts."""

import io
import re
import tomllib
import zipfile
from pathlib import Path

import firenet_jax as fj

PACKAGE = Path(fj.__file__).parent
FACTS = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())
PROJECT, TOOLS = FACTS["project"], FACTS["tool"]
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
    for name in ("description", "readme", "license", "keywords", "classifiers", "authors", "urls"):
        assert PROJECT.get(name), name
    assert (PACKAGE.parent / PROJECT["readme"]).exists()
    assert all((PACKAGE.parent / name).exists() for name in PROJECT["license-files"])


def test_the_version_is_a_tag_and_the_same_everywhere():
    """Tags make it; what is written down beside them names the same release."""
    assert PROJECT["dynamic"] == ["version"] and "version" not in PROJECT
    root = PACKAGE.parent
    newest = re.search(r"^## (\S+)", (root / "CHANGELOG.md").read_text(), re.MULTILINE)
    cited = re.search(r"^version: (\S+)$", (root / "CITATION.cff").read_text(), re.MULTILINE)
    fallback = TOOLS["hatch"]["version"]["fallback-version"]
    assert newest and cited and newest[1] == cited[1] == fallback.removesuffix(".dev0")
