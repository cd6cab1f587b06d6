"""The core's tests, in one virtual environment for each of these versions of what it stands on.

    python tests/environments.py                       all
    python tests/environments.py lowest                one: all tests, with the lowest versions
    python3.14 tests/environments.py "newest jax"      with the newest that another Python can have

An environment holds the package as pip installs it from here, and pytest; then what it is about is
installed over that, whatever bounds the package has. "lowest" holds all extras too, and each
library that pyproject.toml names in the lowest version that it allows; the newest that are allowed
are those of `.ci/run`. What needs PyTorch is skipped. Where there is no newer Python, a folder of
Debian's next release is one, as root:

    debootstrap --include=python3-venv,ca-certificates sid FOLDER && cp -r . FOLDER/opt/firenet
    chroot FOLDER python3 /opt/firenet/tests/environments.py "newest jax"
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
LOWEST = "lowest"
ENVIRONMENTS = {  # name: (what pip does besides, environment)
    LOWEST: ([], {}),
    "without llvmlite": (["uninstall", "-y", "llvmlite"], {}),
    "switched off": ([], {"FIRENET_NATIVE": "0"}),
    "jax 0.10.0": (["install", "jax==0.10.0", "jaxlib==0.10.0"], {}),
    "jax 0.10.1": (["install", "jax==0.10.1", "jaxlib==0.10.1"], {}),
    "newest jax": (["install", "--upgrade", "jax", "flax"], {}),
}
CORE = """
    events windows tensors network convolution blocks reconstruction pictures checkpoint
    choice machine_code foreign_call native convolve3x3 trial
""".split()
TOOLS = ["pytest>=8.3"]
ALL = ["-n", "2", "-W", "default::DeprecationWarning"]  # the lowest versions warn of each other


def lowest() -> list[str]:
    """All libraries that the package needs, extras included, in the lowest versions it allows."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    needed = [*project["dependencies"]]
    needed += [each for name in ("train", "evaluate", "formats", "export") for each in extras[name]]
    bounds = [re.match(r"([\w-]+)>=([\d.]+)", each) for each in needed]
    return sorted({f"{bound[1]}=={bound[2]}" for bound in bounds if bound})


def tried(name: str, folder: Path) -> bool:
    pip, environment = ENVIRONMENTS[name]
    subprocess.run([sys.executable, "-m", "venv", folder / "venv"], check=True)
    python = folder / "venv" / "bin" / "python"

    def run_pip(*arguments):
        subprocess.run([python, "-m", "pip", *arguments, "-q"], check=True)

    # A copy: what pip builds in a checkout stays there, and the installed package is what is tried.
    # With the lowest versions all tests run, some of which look at what lies beside the package.
    copy = folder / "source"
    everything = name == LOWEST
    left_out = [".git", ".venv"] + ([] if everything else ["results"])
    shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(*left_out))
    if everything:
        run_pip("install", f"{copy}[all]", *TOOLS, "pytest-xdist>=3.6", *lowest())
    else:
        run_pip("install", copy, *TOOLS)
    if pip:
        run_pip(*pip)
    if not everything:
        shutil.rmtree(copy / "firenet_jax")
    about = (
        "import sys, importlib.metadata as m\n"
        "has = {d.name.lower(): d.version for d in m.distributions()}\n"
        "print(sys.version.split()[0], *(f'{n} {has.get(n)}' for n in "
        "('jax', 'jaxlib', 'flax', 'llvmlite', 'numpy')), sep=', ', flush=True)"
    )
    subprocess.run([python, "-c", about], check=True)
    # By XLA alone and in all sizes too, which is what differs between environments.
    tests = ALL if everything else ["--slow", *(f"tests/test_{each}.py" for each in CORE)]
    command = [python, "-m", "pytest", "-p", "no:cacheprovider", *tests]
    outside = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    return subprocess.run(command, cwd=copy, env=outside | environment).returncode == 0


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(ENVIRONMENTS))
    names = parser.parse_args().names or list(ENVIRONMENTS)
    if unknown := set(names) - set(ENVIRONMENTS):
        parser.error(f"no such environment: {', '.join(sorted(unknown))}")
    passed = []
    for name in names:
        print(f"\n{name}", flush=True)
        with tempfile.TemporaryDirectory(prefix="firenet_environment_") as folder:
            passed.append(tried(name, Path(folder)))
    for name, well in zip(names, passed, strict=True):
        print(f"{name:20} {'passed' if well else 'FAILED'}")
    sys.exit(not all(passed))


if __name__ == "__main__":
    main()
