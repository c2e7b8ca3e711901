"""Training on several devices, and in several processes: data parallelism by `jax.sharding`.

Weights and windows lie on every device, a batch is spread over them, and XLA adds up the
gradients. Every random number belongs to a step and a sample, not to a device, so that the weights
are those of one device up to the order of sums. Processes on several machines work as more devices
of one mesh, once each has called `join_processes`.
"""

from __future__ import annotations

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

AXIS = "batch"
"""Name of the mesh axis that a batch is spread over."""

SPREAD, EVERYWHERE = PartitionSpec(AXIS), PartitionSpec()
"""How arrays lie: over the devices along their first axis, or as a whole on each of them."""


def join_processes(coordinator: str | None = None, count: int | None = None, number: int | None = None) -> None:
    """Make this process one of several that train together; before anything else touches JAX.

    Args:
      coordinator: "host:port" of process 0. On clusters that JAX knows (Slurm, Open MPI,
        Kubernetes, TPU) leave all three out.
      count: number of processes.
      number: of this one, from 0.

    Raises:
      ValueError: if only some of the three are given, the number is out of range, or the processes
        do not find each other.
    """
    given = (coordinator, count, number)
    if any(value is None for value in given) and any(value is not None for value in given):
        raise ValueError(
            "coordinator, count and number of processes come together or not at all, got "
            f"{coordinator!r}, {count!r}, {number!r}"
        )
    if count is not None and not 0 <= number < count:
        raise ValueError(f"process {number} of {count}: numbers run from 0 to {count - 1}")
    try:
        jax.distributed.initialize(coordinator, count, number)
    except RuntimeError as error:
        where = coordinator or "the coordinator that JAX found"
        raise ValueError(
            f"this process could not join the others at {where} ({error}): start all of them, and "
            "before anything else uses JAX"
        ) from error


def all_devices() -> Mesh:
    """Return a mesh of every device of every process, one axis long."""
    return Mesh(np.array(jax.devices()), (AXIS,))


def check_batch(batch_size: int, mesh: Mesh | None) -> None:
    """Raise ValueError unless the devices can share a batch equally."""
    if mesh is not None and batch_size % mesh.size:
        raise ValueError(
            f"a batch of {batch_size} windows cannot be shared equally by {mesh.size} devices: "
            f"take {max(1, batch_size // mesh.size) * mesh.size}"
        )


def replicate(tree, mesh: Mesh | None):
    """Return arrays that lie on every device of a mesh (as they are without one).

    Args:
      tree: of arrays that every process has with the same values.
      mesh: from `all_devices`, or None.
    """
    if mesh is None:
        return tree
    whole = NamedSharding(mesh, EVERYWHERE)

    def place(leaf):
        if getattr(leaf, "sharding", None) == whole:
            return leaf
        # `device_put` would send every value between processes to compare them, and might share the caller's memory.
        values = np.asarray(leaf)
        return jax.make_array_from_callback(values.shape, whole, lambda part: values[part])

    return jax.tree.map(place, tree)


def laid(tree, mesh: Mesh | None, places: PartitionSpec):
    """Ask, inside jit, that arrays lie on the devices of a mesh as `SPREAD` or `EVERYWHERE` says."""
    return tree if mesh is None else jax.lax.with_sharding_constraint(tree, NamedSharding(mesh, places))


def is_first_process() -> bool:
    """Say whether this process writes the files; the others only compute."""
    return jax.process_index() == 0


def first_says(answer: bool) -> bool:
    """Return process 0's answer in every process, so that none goes on where another stops."""
    return bool(multihost_utils.broadcast_one_to_all(np.array(answer)))


def same_everywhere(number: int) -> bool:
    """Say whether a whole number is the same in every process."""
    return len(np.unique(multihost_utils.process_allgather(np.array(number)))) == 1


def wait_for_all(what: str) -> None:
    """Wait until every process has come here; alone, go on.

    Args:
      what: name of the place, the same in every process.
    """
    multihost_utils.sync_global_devices(what)
