"""Scripts in processes of their own: with virtual devices, alone or together, with little room."""

import json
import multiprocessing
import os
import runpy
import socket
import subprocess
import sys
from importlib.metadata import version

import pytest

# The emitters that XLA has by default since 2025 compile a loop in twice the time of those before.
# Only versions that are known to have the flag get it: XLA ends a process that asks for another.
OLD_EMITTERS = "--xla_cpu_use_fusion_emitters=false" if version("jax").startswith("0.10.") else ""

# For what does not depend on how well XLA optimises: it compiles in a fifth of the time.
FEW_OPTIMISATIONS = {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1", "XLA_FLAGS": OLD_EMITTERS}


# What scripts import, which takes seconds: imported once, in a process from which each is forked.
IMPORTED = (
    "firenet_jax.commands.evaluate", "firenet_jax.commands.reconstruct",
    "firenet_jax.commands.train", "matplotlib.figure", "skimage.metrics", "torch",
)  # fmt: skip


def run_forked(script, arguments, folder, **more):
    """(exit code, what it has written) of a Python file that runs in `folder`, as a program."""
    written = folder / "written.txt"
    forks = multiprocessing.get_context("forkserver")
    forks.set_forkserver_preload(list(IMPORTED))
    with pytest.MonkeyPatch.context() as patch:  # jax reads its settings when it is imported
        for name, value in more.items():
            patch.setenv(name, value)
        process = forks.Process(target=_program, args=(script, arguments, folder, written))
        process.start()
    process.join(timeout=900)
    code = process.exitcode
    process.kill()
    return code, written.read_text()


def _program(script, arguments, folder, written):
    with open(written, "w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    os.chdir(folder)
    sys.argv, sys.path[0] = [script, *arguments], os.path.dirname(os.path.abspath(script))
    runpy.run_path(script, run_name="__main__")


def start(script, *arguments, devices=1, **more):
    count = f"--xla_force_host_platform_device_count={devices}"
    more["XLA_FLAGS"] = f"{more.get('XLA_FLAGS', '')} {count}"
    environment = os.environ | more | {"JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", script, *map(str, arguments)]
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)


def finish(*processes):
    """Waits for them; fails with what one that failed has said."""
    try:
        for process in processes:
            _, errors = process.communicate(timeout=900)
            assert process.returncode == 0, f"exit {process.returncode}: {errors[-2000:]}"
    finally:  # one that failed leaves the others waiting
        for process in processes:
            process.kill()
            process.communicate()


def together(script, *arguments, processes=2, **more):
    """The same script in several processes, told coordinator, how many and which one it is."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    where = address, processes
    finish(*(start(script, *arguments, *where, n, **more) for n in range(processes)))


# The libraries are imported before the limit is set: they write files of their own.
RUN = """
import json, os, resource, shutil, sys
import h5py, jax, orbax.checkpoint
from firenet_jax import cli
def run(line):
    code = cli.main(line.split())
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    left = [
        os.path.relpath(path, ".")
        for folder, folders, files in os.walk(".")
        for path in (os.path.join(folder, name) for name in folders + files)
        if not os.path.islink(path)
    ]
    print(f"exit code {code} {json.dumps(left)}", file=sys.stderr, flush=True)
"""
LIMITED = f"""{RUN}
for limit, line in json.loads(sys.argv[1]):
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
    run(line)
"""
# A disk of 1 MB, filled up but for so many bytes, whole pages; what the commands read lies outside.
ON_A_DISK = f"""{RUN}
inputs, disk = os.getcwd(), sys.argv[2]
os.chdir(disk)
for room, line in json.loads(sys.argv[1]):
    for name in os.listdir(disk):
        shutil.rmtree(name) if os.path.isdir(name) and not os.path.islink(name) else os.remove(name)
    for name in os.listdir(inputs):
        os.symlink(os.path.join(inputs, name), name)
    state = os.statvfs(disk)
    with open("filler", "wb") as file:
        file.write(bytes((state.f_bavail - room // state.f_frsize) * state.f_frsize))
    run(line)
"""
MOUNTED = 'mount -t tmpfs -o size=1m none "$2" && exec "$0" -c "$3" "$1" "$2"'


def with_little_room(folder, *lines, disk=None):
    """(bytes there are room for, command line), ... -> [(exit code, lines said, paths left), ...].

    One process runs them all, which compiles their programs once. A limit of a file's size stands
    for a full disk: it needs no rights, and the libraries in C meet it where they write. disk: a
    folder where a real one of 1 MB is mounted instead, for the commands alone. Paths left are
    those in the folder or on the disk after a command, but for links.
    """
    command = [sys.executable, "-c", LIMITED, json.dumps(lines)]
    environment = os.environ | FEW_OPTIMISATIONS | {"JAX_PLATFORMS": "cpu"}
    if disk is None:  # the limit would hold for the files of compiled programs that tests share
        environment["JAX_ENABLE_COMPILATION_CACHE"] = "false"
    else:
        shell = ["unshare", "-rm", "sh", "-c", MOUNTED]
        command = [*shell, sys.executable, json.dumps(lines), str(disk), ON_A_DISK]
    ran = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=900, env=environment
    )
    assert ran.returncode == 0, ran.stderr[-2000:]
    results, said = [], []
    for line in ran.stderr.strip().splitlines():
        if line.startswith("exit code "):
            code, _, left = line.removeprefix("exit code ").partition(" ")
            results.append((int(code), said, json.loads(left)))
            said = []
        else:
            said.append(line)
    assert not said and len(results) == len(lines), ran.stderr[-2000:]
    return results
