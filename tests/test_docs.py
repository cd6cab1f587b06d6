"""The site: its links lead somewhere, its code knows the package, its pages are complete.

The commands are those of test_snippets.py."""

import importlib
import json
import re
from pathlib import Path

import pytest

import firenet_jax as fj

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.glob("*.md"))


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_and_pictures_lead_to_files(page):
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text()):
        assert (DOCS / target).exists(), f"{page.name}: {target}"


def test_code_compiles_and_knows_the_package():
    for page in PAGES:
        for block in blocks(page, "python"):
            compile(block, page.name, "exec")
            for name in re.findall(r"\bfj\.(\w+)", block):
                assert hasattr(fj, name), f"{page.name}: fj.{name}"


def test_the_site_documents_every_public_name():
    named = re.findall(r"^::: firenet_jax\.([\w.]+)$", (DOCS / "api.md").read_text(), re.MULTILINE)
    for name in named:
        module, _, last = name.rpartition(".")
        assert hasattr(importlib.import_module(f"firenet_jax.{module}"), last), name
    assert {name.rpartition(".")[2] for name in named} >= set(fj.__all__)


def test_the_site_has_every_page():
    config = (ROOT / "mkdocs.yml").read_text()
    assert all(f": {page.name}\n" in config for page in PAGES)


def test_messages_that_are_explained_are_those_of_the_program():
    explained = (DOCS / "troubleshooting.md").read_text().replace("\n", " ")
    source = "".join(path.read_text() for path in Path(fj.__file__).parent.rglob("*.py"))
    messages = re.findall(r"\*\*\"([^\"]+)\"\*\*", explained)
    assert len(messages) > 5
    for message in messages:
        assert message in source, message


def test_what_is_said_of_fine_tuning_is_what_was_measured():
    found = json.loads((ROOT / "experiments/results/fine_tune.json").read_text())
    page = " ".join((DOCS / "train.md").read_text().split())
    for scores in found["recordings"].values():
        for name in ("ssim", "equalised"):
            assert f"{scores['before'][name]:.3f} to {scores['after'][name]:.3f}" in page
    assert f"{found['steps']} steps took {found['processor_seconds']:.0f} s" in page
