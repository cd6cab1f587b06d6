"""What all tests share: strict JAX flags, the slow switch, data outside the repository."""

import os
from pathlib import Path

import jax
import pytest

jax.config.update("jax_numpy_rank_promotion", "raise")


def pytest_addoption(parser):
    parser.addoption("--slow", action="store_true", help="run the slow tests too")


def pytest_collection_modifyitems(config, items):
    for item in items:
        if "slow" in item.keywords and not config.getoption("--slow"):
            item.add_marker(pytest.mark.skip(reason="slow: run with --slow"))


def _folder(variable: str) -> Path:
    if not os.environ.get(variable):
        pytest.skip(f"needs data outside the repository: set {variable} to its folder")
    return Path(os.environ[variable])


@pytest.fixture
def reference() -> Path:
    """Folder with the published weights and their inputs and outputs."""
    return _folder("FIRENET_REFERENCE")


@pytest.fixture
def recordings() -> Path:
    """Folder with real recordings, one for each format."""
    return _folder("FIRENET_RECORDINGS")


@pytest.fixture(scope="module", params=["machine code", "XLA"])
def each_way(request):
    """All tests of a module as they are on this processor, and then all by XLA alone.

    For a whole module at a time: what is compiled knows of no switch and must be forgotten.
    """
    if request.param == "machine code":
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FIRENET_NATIVE", "0")
        jax.clear_caches()
        yield
    jax.clear_caches()
