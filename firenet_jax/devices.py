"""Trees of arrays -> the same arrays dealt out to devices: some of a batch's sequences to each.

Sequences have nothing to do with each other, so this is all there is to many devices: the batch
axis of everything is split, the parameters are on all of them.

Which of several processes this is, and of how many, is what the settings say, else what a launcher
says in the environment of each process that it starts.
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


# Launchers: the names under which they say which process this is, and how many there are. mpirun
# within a Slurm job leaves Slurm's names too, which are those of the nodes' daemons. Kubernetes
# tells the pods of an indexed job no number of them.
LAUNCHERS = (
    ("OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE"),  # Open MPI
    ("SLURM_PROCID", "SLURM_STEP_NUM_TASKS"),  # srun; a batch script itself is no task of a step
    ("JOB_COMPLETION_INDEX", None),
)


def share(process: int | None, processes: int | None) -> tuple[int, int]:
    """(which process this is, from 0, of how many): as given, else as a launcher has it, else the
    only one. The number alone may be given where a launcher says which one this is.

    Raises SettingsError where these do not fit together."""
    asked = processes
    if process is None:
        process, processes = _launched(processes)
    if process is None or processes is None:
        if asked is not None or process is not None:
            raise SettingsError(
                "several processes need both of --processes and --process, where no launcher says "
                "them (Slurm's srun, Open MPI, an indexed Kubernetes job)"
            )
        return 0, 1
    if asked not in (None, processes):
        raise SettingsError(f"--processes is {asked}, but the launcher has started {processes}")
    if not 0 <= process < processes:
        raise SettingsError(f"process is {process}, but counts from 0 to processes - 1")
    return process, processes


def _launched(processes: int | None) -> tuple[int | None, int | None]:
    """(which, of how many), as the environment says; of a launcher that tells no number, with the
    one given, and nothing where none is."""
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
    """Becomes one of several processes, on this machine or on many: of those given, else of those
    that srun or Open MPI has started; else nothing happens. Raises SettingsError where JAX does not
    find the others."""
    if coordinator is not None:
        process, processes = share(process, processes)
    elif share(None, None)[1] == 1:
        return
    # Else SIGTERM would only be noted down, for programs that ask for it, and ended by nothing.
    jax.config.update("jax_enable_preemption_service", False)
    try:
        jax.distributed.initialize(coordinator, processes, process)
    except ValueError as error:  # of launchers that JAX does not know, such as Open MPI 5
        raise SettingsError(
            f"JAX does not find the other processes ({error}): pass --coordinator HOST:PORT of "
            "process 0"
        ) from error


def is_first() -> bool:
    """Whether this is the process that writes and talks."""
    return jax.process_index() == 0


def check_processes(coordinator: str | None, processes: int | None, process: int | None) -> None:
    """Raises SettingsError unless all of the three are given, or none, or a coordinator alone where
    a launcher says the rest."""
    if coordinator is not None:
        share(process, processes)
    elif (processes, process) != (None, None):
        raise SettingsError("several processes need all of coordinator, processes and process")


def device_mesh(devices: Sequence | None = None) -> Mesh:
    """These devices, by default all of all processes."""
    devices = jax.devices() if devices is None else devices
    return jax.make_mesh((len(devices),), ("devices",), (AxisType.Auto,), devices=devices)


def sharding(spec: P = REPLICATED, mesh: Mesh | None = None) -> NamedSharding:
    """How an array lies on the devices: whole on each of them, or split along its batch."""
    return NamedSharding(device_mesh() if mesh is None else mesh, spec)


def replicated(tree):
    """Arrays of the host -> the same on all devices of all processes."""
    return jax.device_put(jax.tree.map(np.asarray, tree), sharding())


def on_each_device(function, in_specs, out_specs, mesh: Mesh | None = None):
    """A function of each device's part of the batch -> one of the whole batch."""
    mesh = device_mesh() if mesh is None else mesh
    return jax.shard_map(
        function, mesh=mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False
    )
