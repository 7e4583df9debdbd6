"""One program on several devices, of one process or many: environments, or seeds, split over a mesh.

The program is written for one device. With a mesh, XLA partitions it by the few hints that `split` and `gather` give,
and sums gradients and statistics over devices: the numbers are those of one device, up to rounding. Without a mesh the
hints do nothing. Of several processes each runs the same host code, and only the first one writes.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from fmpjax.errors import UserError

AXIS = "devices"


def mesh(count: int | None = None) -> Mesh:
    """A mesh of the first ``count`` devices, of all processes; by default of every one.

    Raises:
      UserError: there are fewer.
    """
    devices = jax.devices()
    count = len(devices) if count is None else count
    if not 1 <= count <= len(devices):
        raise UserError(f"--devices is {count}: expected 1 to {len(devices)}, the devices that JAX sees")
    return Mesh(np.array(devices[:count]), (AXIS,), axis_types=(AxisType.Auto,))


def check_divides(environments: int, seeds: int, devices: int) -> None:
    """What devices share: the seeds where a run has several, else the environments.

    Raises:
      UserError: they do not divide.
    """
    what, count = ("the number of seeds", seeds) if seeds > 1 else ("setting env.count", environments)
    if count % devices:
        raise UserError(f"{what} is {count}: expected a multiple of {devices}, the devices that share them")


def connect(coordinator: str | None, processes: int | None, process: int | None) -> None:
    """Join the other processes of a run; to be called before any other use of JAX.

    Args:
      coordinator: address "host:port" of the first process; None where a cluster's scheduler tells all three.
      processes: their number.
      process: number of this one, from 0.

    Raises:
      UserError: the scheduler tells nothing, or the others cannot be reached.
    """
    try:
        jax.distributed.initialize(coordinator, processes, process)
    except (ValueError, RuntimeError) as error:
        raise UserError(
            f"cannot join a distributed run ({str(error).splitlines()[0]}): expected a start by SLURM or "
            "another scheduler that JAX knows, or --coordinator HOST:PORT, --processes and --process"
        ) from None
    # Processes that read kept programs were seen to wait for each other for good: each compiles for itself.
    jax.config.update("jax_enable_compilation_cache", False)


def primary() -> bool:
    """Whether this process is the one that writes."""
    return jax.process_index() == 0


def agree(flag: bool) -> bool:
    """The first process's flag, on every process."""
    return bool(multihost_utils.broadcast_one_to_all(np.array(flag))) if jax.process_count() > 1 else flag


def first(tree: Any) -> Any:
    """The first process's arrays, on every process, whose own have the same shapes."""
    return multihost_utils.broadcast_one_to_all(tree) if jax.process_count() > 1 else tree


def wait(what: str) -> None:
    """Until every process is here."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(what)


def on_host(tree: Any) -> Any:
    """Whole arrays in the memory of this process, wherever their parts are."""
    return jax.tree.map(
        lambda x: (
            jax.device_get(x)
            if x.is_fully_addressable or x.is_fully_replicated
            else multihost_utils.process_allgather(x, tiled=True)
        ),
        tree,
    )


def of(array: jax.Array) -> Mesh | None:
    """The mesh that an array is on; None if it is on one device."""
    # An array that is no tracer has a mesh of devices, not an abstract one.
    return array.sharding.mesh if isinstance(array.sharding, NamedSharding) else None  # ty: ignore[invalid-explicit-return]


def rows(over: Mesh) -> NamedSharding:
    """Leading axis over the devices."""
    return NamedSharding(over, PartitionSpec(AXIS))


def everywhere(over: Mesh) -> NamedSharding:
    """A copy on each device."""
    return NamedSharding(over, PartitionSpec())


def split(tree: Any, axis: int = 0) -> Any:
    """Hint: split the arrays' ``axis`` over the devices, if its length is a multiple of their number."""
    devices = _in_force()
    if not devices:
        return tree
    spec = PartitionSpec(*[None] * axis, AXIS)

    def hint(x):
        return x if x.shape[axis] % devices else jax.lax.with_sharding_constraint(x, spec)

    return jax.tree.map(hint, tree)


def gather(tree: Any) -> Any:
    """Hint: each device has the whole arrays."""
    return jax.lax.with_sharding_constraint(tree, PartitionSpec()) if _in_force() else tree


def per_device(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of arrays with a leading axis, called on each device with only its own rows.

    Host callbacks need it: XLA cannot partition what it cannot see.
    """
    return _mapped(function, PartitionSpec(AXIS))


def alone(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that each device computes for itself on whole arrays, without an exchange."""
    return _mapped(function, PartitionSpec())


def spread(function: Callable[..., Any], batch: int) -> Callable[..., Any]:
    """A function of rows, called on each row of arrays with a leading axis; devices share the calls.

    Args:
      batch: calls made side by side on a device.
    """

    def turns(*arguments):
        count = len(jax.tree.leaves(arguments)[0])
        if batch >= count:
            return jax.vmap(function)(*arguments)
        return jax.lax.map(lambda row: function(*row), arguments, batch_size=batch if batch > 1 else None)

    def call(*arguments):
        count, devices = len(jax.tree.leaves(arguments)[0]), _in_force()
        if not devices:
            return turns(*arguments)
        # Calls that do not divide over the devices: the first are made twice.
        every = np.arange(-(-count // devices) * devices) % count
        results = per_device(turns)(*jax.tree.map(lambda x: x[every], arguments))
        return jax.tree.map(lambda x: gather(x)[:count], results)

    return call


def _mapped(function: Callable[..., Any], spec: PartitionSpec) -> Callable[..., Any]:
    def call(*arguments):
        if not _in_force():
            return function(*arguments)
        return jax.shard_map(function, in_specs=spec, out_specs=spec, check_vma=False)(*arguments)

    return call


def _in_force() -> int:
    """Devices of the mesh that XLA partitions over, 0 without one or inside a function that is split already."""
    over = jax.sharding.get_abstract_mesh()
    return 0 if over.empty or AXIS in over.manual_axes else over.shape[AXIS]
