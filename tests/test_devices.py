"""Which of several processes this is: by the environments that launchers make."""

import os
import socket
import subprocess
import sys

import pytest
from processes import finish, start

from firenet_jax import devices

# Of each launcher, as its documentation has it (srun, OUTPUT ENVIRONMENT VARIABLES; Open MPI,
# environment variables for each process; Kubernetes, indexed jobs).
SLURM = {"SLURM_JOB_ID": "7", "SLURM_NTASKS": "4", "SLURM_PROCID": "2", "SLURM_LOCALID": "0"}
SLURM |= {"SLURM_STEP_NUM_TASKS": "4", "SLURM_STEP_NODELIST": "localhost"}
BATCH_SCRIPT = {"SLURM_JOB_ID": "7", "SLURM_NTASKS": "4", "SLURM_PROCID": "0"}  # beside srun
OPEN_MPI = {"OMPI_COMM_WORLD_RANK": "1", "OMPI_COMM_WORLD_SIZE": "3"}
KUBERNETES = {"JOB_COMPLETION_INDEX": "4"}


@pytest.fixture(autouse=True)
def no_launcher(monkeypatch):
    for name in [*os.environ]:
        if name.startswith(("SLURM_", "OMPI_", "JOB_COMPLETION")):
            monkeypatch.delenv(name)


@pytest.mark.parametrize(
    "environment, given, expected",
    [
        ({}, (None, None), (0, 1)),
        ({}, (1, 2), (1, 2)),
        (SLURM, (None, None), (2, 4)),
        (SLURM, (0, 1), (0, 1)),
        (SLURM, (None, 4), (2, 4)),
        (BATCH_SCRIPT, (None, None), (0, 1)),
        (OPEN_MPI, (None, None), (1, 3)),
        (SLURM | OPEN_MPI, (None, None), (1, 3)),
        (KUBERNETES, (None, 6), (4, 6)),
        (KUBERNETES, (None, None), (0, 1)),
    ],
)
def test_share(monkeypatch, environment, given, expected):
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert devices.process_of(*given) == expected


@pytest.mark.parametrize(
    "environment, given, said",
    [
        ({}, (None, 2), "both of --processes and --process"),
        ({}, (1, None), "both of --processes and --process"),
        ({}, (2, 2), "process is 2, but counts from 0"),
        ({}, (0, 0), "process is 0, but counts from 0"),
        (KUBERNETES, (None, 4), "process is 4, but counts from 0"),
        (OPEN_MPI, (None, 2), "--processes is 2, but the launcher has started 3"),
        (OPEN_MPI | {"OMPI_COMM_WORLD_RANK": "-1"}, (None, None), "is '-1' in the environment"),
        (OPEN_MPI | {"OMPI_COMM_WORLD_SIZE": "x"}, (None, None), "expected a number"),
    ],
)
def test_shares_that_cannot_be(monkeypatch, environment, given, said):
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(ValueError, match=said):
        devices.process_of(*given)


def test_a_coordinator_may_stand_alone_where_a_launcher_says_the_rest(monkeypatch):
    devices.check_processes(None, None, None)
    devices.check_processes("localhost:1", 2, 0)
    with pytest.raises(ValueError, match="both of --processes"):
        devices.check_processes("localhost:1", 2, None)
    monkeypatch.setenv("JOB_COMPLETION_INDEX", "1")
    devices.check_processes("localhost:1", 2, None)
    with pytest.raises(ValueError, match="all of coordinator, processes and process"):
        devices.check_processes(None, 2, 0)


JOINED = """
import os, sys
os.environ.update(word.split("=", 1) for word in sys.argv[1:])
import jax
from firenet_jax.devices import join
join(None, None, None)
assert (jax.process_count(), len(jax.devices())) == (2, 2), jax.devices()
assert str(jax.process_index()) == os.environ["RANK"]
"""


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["srun", "mpirun"])
def test_processes_of_a_launcher_find_each_other(launcher):
    """JAX takes the port from the number of the job."""
    with socket.socket() as free:
        for port in range(61_500, 65_535):
            try:
                free.bind(("localhost", port))
                break
            except OSError:
                continue
    job = port - (2**16 - 2**12)
    started = []
    for rank in "01":
        environment = {"RANK": rank, "JAX_PLATFORMS": "cpu"}
        if launcher == "srun":
            environment |= SLURM | {"SLURM_JOB_ID": str(job), "SLURM_PROCID": rank}
            environment |= {"SLURM_NTASKS": "2", "SLURM_STEP_NUM_TASKS": "2"}
        else:
            environment |= {"OMPI_COMM_WORLD_RANK": rank, "OMPI_COMM_WORLD_SIZE": "2"}
            environment |= {"OMPI_COMM_WORLD_LOCAL_RANK": "0"}
            environment["OMPI_MCA_orte_hnp_uri"] = f"{job << 12}.0;tcp://127.0.0.1:40000"
        started.append(start(JOINED, *(f"{name}={value}" for name, value in environment.items())))
    finish(*started)


def test_a_launcher_that_jax_does_not_know_is_said():
    """Open MPI 5 has another name for its own address. In a process without JAX's devices yet."""
    joining = "from firenet_jax import devices; devices.join(None, None, None)"
    done = subprocess.run(
        [sys.executable, "-c", joining], env=os.environ | OPEN_MPI, capture_output=True, text=True
    )
    assert "SettingsError" in done.stderr and "pass --coordinator HOST:PORT" in done.stderr
