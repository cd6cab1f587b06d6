"""The core's tests, in one virtual environment for each of these versions of what it stands on.

    python tests/environments.py                       all
    python tests/environments.py "without llvmlite"    one
    python3.14 tests/environments.py "newest jax"      with the newest that another Python can have

An environment holds the package as pip installs it from here, and pytest; then what it is about is
installed over that, whatever bounds the package has. What needs PyTorch is skipped. Where there is
no newer Python, a folder of Debian's next release is one, as root:

    debootstrap --include=python3-venv,ca-certificates sid FOLDER && cp -r . FOLDER/opt/firenet
    chroot FOLDER python3 /opt/firenet/tests/environments.py "newest jax"
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
ENVIRONMENTS = {  # name: (what pip does besides, environment)
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


def tried(name: str, folder: Path) -> bool:
    pip, environment = ENVIRONMENTS[name]
    subprocess.run([sys.executable, "-m", "venv", folder / "venv"], check=True)
    python = folder / "venv" / "bin" / "python"

    def run_pip(*arguments):
        subprocess.run([python, "-m", "pip", *arguments, "-q"], check=True)

    # A copy: what pip builds in a checkout stays there, and the installed package is what is tried.
    copy = folder / "source"
    shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".git", ".venv", "results"))
    run_pip("install", copy, *TOOLS)
    if pip:
        run_pip(*pip)
    shutil.rmtree(copy / "firenet_jax")
    about = (
        "import sys, importlib.metadata as m\n"
        "has = {d.name.lower(): d.version for d in m.distributions()}\n"
        "print(sys.version.split()[0], *(f'{n} {has.get(n)}' for n in "
        "('jax', 'jaxlib', 'flax', 'llvmlite', 'numpy')), sep=', ', flush=True)"
    )
    subprocess.run([python, "-c", about], check=True)
    tests = [f"tests/test_{each}.py" for each in CORE]
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
