"""Trees of arrays -> the same arrays sharded over devices along the batch axis.

Sequences are independent, so data parallelism is all that is needed: the batch axis of every array
is sharded, the parameters are replicated.

The index and number of processes come from the settings, otherwise from environment variables that
a launcher sets.
"""

import os
from collections.abc import Sequence

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from firenet_jax.errors import SettingsError

REPLICATED = P()
BATCH = P("devices")  # the first axis of a state
TIME_BATCH = P(None, "devices")  # the second one of what comes in windows


# The environment variables in which launchers state the index and the number of processes. Open MPI
# comes first: under mpirun in a Slurm job, Slurm's variables describe the nodes' daemons.
# Kubernetes does not state the number of pods of an indexed job.
LAUNCHERS = (
    ("OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE"),  # Open MPI
    ("SLURM_PROCID", "SLURM_STEP_NUM_TASKS"),  # srun; a batch script itself is no task of a step
    ("JOB_COMPLETION_INDEX", None),
)


def process_of(process: int | None, processes: int | None) -> tuple[int, int]:
    """(index of this process, from 0, number of processes): as given, else from a launcher, else
    (0, 1). The number alone may be given if a launcher states the index.

    Raises SettingsError if they contradict each other."""
    asked = processes
    if process is None:
        process, processes = _launched(processes)
    if process is None or processes is None:
        if asked is not None or process is not None:
            raise SettingsError(
                "several processes need both of --processes and --process, unless a launcher sets "
                "them (Slurm's srun, Open MPI, an indexed Kubernetes job)"
            )
        return 0, 1
    if asked not in (None, processes):
        raise SettingsError(f"--processes is {asked}, but the launcher has started {processes}")
    if not 0 <= process < processes:
        raise SettingsError(f"process is {process}, but counts from 0 to processes - 1")
    return process, processes


def _launched(processes: int | None) -> tuple[int | None, int | None]:
    """(index, number) from the environment. Where the launcher does not state the number, the given
    one; without that, (None, None)."""
    for which, number in LAUNCHERS:
        if which in os.environ and (number is None or number in os.environ):
            texts = [os.environ[name] for name in (which, number) if name is not None]
            if not all(text.isdecimal() for text in texts):
                raise SettingsError(
                    f"{which} is {texts[0]!r} in the environment, expected a number"
                )
            if number is not None:
                return int(texts[0]), int(texts[1])
            if processes is not None:
                return int(texts[0]), processes
    return None, processes


def join(coordinator: str | None, processes: int | None, process: int | None) -> None:
    """Joins the processes given by the settings, else those that srun or Open MPI has started, else
    does nothing. Raises SettingsError if JAX does not find the other processes."""
    if coordinator is not None:
        process, processes = process_of(process, processes)
    elif process_of(None, None)[1] == 1:
        return
    # JAX's preemption service would catch SIGTERM, so that the process would not end.
    jax.config.update("jax_enable_preemption_service", False)
    try:
        jax.distributed.initialize(coordinator, processes, process)
    except ValueError as error:  # of launchers that JAX does not know, such as Open MPI 5
        raise SettingsError(
            f"JAX does not find the other processes ({error}): pass --coordinator HOST:PORT of "
            "process 0"
        ) from error


def is_first() -> bool:
    """Whether this is the process that writes files and messages."""
    return jax.process_index() == 0


def check_processes(coordinator: str | None, processes: int | None, process: int | None) -> None:
    """Raises SettingsError unless all three are given, or none, or a coordinator alone and a
    launcher states the rest."""
    if coordinator is not None:
        process_of(process, processes)
    elif (processes, process) != (None, None):
        raise SettingsError("several processes need all of coordinator, processes and process")


def device_mesh(devices: Sequence | None = None) -> Mesh:
    """A mesh of these devices; by default all devices of all processes."""
    devices = jax.devices() if devices is None else devices
    return jax.make_mesh((len(devices),), ("devices",), (AxisType.Auto,), devices=devices)


def sharding(spec: P = REPLICATED, mesh: Mesh | None = None) -> NamedSharding:
    """The sharding of an array: replicated, or split along its batch axis."""
    return NamedSharding(device_mesh() if mesh is None else mesh, spec)


def replicated(tree):
    """Arrays on the host -> replicated on all devices of all processes."""
    return jax.device_put(jax.tree.map(np.asarray, tree), sharding())


def on_each_device(function, in_specs, out_specs, mesh: Mesh | None = None):
    """A function of one device's shard of the batch -> a function of the whole batch."""
    mesh = device_mesh() if mesh is None else mesh
    return jax.shard_map(
        function, mesh=mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False
    )
