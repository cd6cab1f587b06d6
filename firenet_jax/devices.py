"""Trees of arrays -> the same arrays dealt out to devices: some of a batch's sequences to each.

Sequences have nothing to do with each other, so this is all there is to many devices: the batch
axis of everything is split, the parameters are on all of them.
"""

from collections.abc import Sequence

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from firenet_jax.errors import SettingsError

REPLICATED = P()
BATCH = P("devices")  # the first axis of a state
TIME_BATCH = P(None, "devices")  # the second one of what comes in windows


def join(coordinator: str | None, processes: int | None, process: int | None) -> None:
    """Becomes one of several processes, on this machine or on many; nothing where all are None."""
    if coordinator is not None:
        # Else SIGTERM would only be noted down, for programs that ask for it, and ended by nothing.
        jax.config.update("jax_enable_preemption_service", False)
        try:
            jax.distributed.initialize(coordinator, processes, process)
        except ValueError as error:
            raise SettingsError(f"coordinator {coordinator!r}: {error}") from error


def is_first() -> bool:
    """Whether this is the process that writes and talks."""
    return jax.process_index() == 0


def check_processes(coordinator: str | None, processes: int | None, process: int | None) -> None:
    """Raises SettingsError unless all of the three are given, or none."""
    together = [coordinator, processes, process]
    if None in together and together != [None] * 3:
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


# What `reconstruct` and `reconstruction` still call them.
EVERYWHERE, in_a_row, shared = REPLICATED, device_mesh, sharding
