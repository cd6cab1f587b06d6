"""What all tests share: strict JAX flags, compiled programs, the slow switch,
data outside the repository, and which tests run in one process (`-n 2`).
"""

import os
import shutil
import signal
import tempfile
from pathlib import Path

# Set before JAX is imported, which reads it. XLA compiles for most of the time, so what it has
# compiled is kept for the session: for the other process of pytest-xdist and for programs that
# tests start, which inherit the environment. Our machine code is not in there: a program names it,
# and each process makes its own.
_PROGRAMS = None
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    _PROGRAMS = os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="firenet_xla_")
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    # JAX traces with millions of objects: a seventh of the time of a short training is spent on
    # looking for garbage among them. Each process that tests start runs this first; 700 before.
    Path(_PROGRAMS, "sitecustomize.py").write_text("import gc; gc.set_threshold(20_000)\n")
    paths = _PROGRAMS, os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
    # XLA says of each program that it was compiled for "+prefer-no-gather", which is no feature of
    # a processor but a hint to LLVM.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

# PyTorch's and BLAS's threads spin while they wait: with a process on each core they take the time
# that the others need.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import jax  # noqa: E402
import pytest  # noqa: E402
from processes import OLD_EMITTERS  # noqa: E402

# XLA reads its flags once, at the first device. What tests start has XLA's own emitters, as users
# have, but for programs that say otherwise (`processes.FEW_OPTIMISATIONS`).
with pytest.MonkeyPatch.context() as _patch:
    _patch.setenv("XLA_FLAGS", f"{os.environ.get('XLA_FLAGS', '')} {OLD_EMITTERS}")
    jax.devices()

jax.config.update("jax_numpy_rank_promotion", "raise")

# XLA compiles for most of the time that these take, for programs that run once on little data.
# Here it does so with few optimisations, but for tests that are marked `optimised`. Processes that
# tests start are compiled as a user's are, but for those with `processes.FEW_OPTIMISATIONS`.
COMPILED_QUICKLY = (
    "test_batches.py", "test_blocks.py", "test_checkpoint.py", "test_choice.py", "test_colour.py",
    "test_dataset.py", "test_demo.py", "test_e2vid.py", "test_export.py", "test_losses.py",
    "test_lpips.py", "test_metrics.py", "test_native.py", "test_network.py", "test_notebooks.py",
    "test_pipeline.py", "test_reconstruct_at.py", "test_reconstruction.py", "test_scenes.py",
    "test_sensor.py", "test_simulated_images.py", "test_snippets.py", "test_stages.py",
    "test_train.py", "test_trial.py",
)  # fmt: skip

# With `-n 2` a file's tests share data and programs in one process, but each of these may run in
# another; pytest-xdist begins with the files of many tests, so they fill what is left.
APART = ("test_experiments.py", "test_no_room.py")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    from xdist.scheduler import LoadScopeScheduling

    class ByFile(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            file = nodeid.partition("::")[0]
            return nodeid if file.endswith(APART) else file

    return ByFile(config, log)


@pytest.hookimpl(tryfirst=True)  # before fixtures, which compile too
def pytest_runtest_setup(item):
    quickly = item.path.name in COMPILED_QUICKLY and "optimised" not in item.keywords
    if quickly != jax.config.read("jax_disable_most_optimizations"):
        jax.config.update("jax_disable_most_optimizations", quickly)
        jax.clear_caches()  # programs that are compiled already do not know of the setting


def pytest_unconfigure():
    if _PROGRAMS:
        shutil.rmtree(_PROGRAMS, ignore_errors=True)


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


XLA = pytest.param("XLA", marks=pytest.mark.slow)


@pytest.fixture(scope="module", params=["machine code", XLA])
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


@pytest.fixture
def interrupts():
    """Ctrl-C interrupts: a shell starts what runs in the background so that it is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
