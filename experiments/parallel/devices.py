"""Where the branches of a phase are computed: on which host, on which of its devices.

A branch is a seed, a task of a seed, or a trial of a task. Branches never talk to each
other, so every device gets a block of them and runs the program that it would run
alone. `jax.shard_map` keeps the compiler out of it: there is nothing to partition, and
so no communication, even around a custom call that the compiler cannot see into.
"""

import itertools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from . import distributed

_CHOSEN = "jax_default_device"
SEED, TASK, TRIAL = AXES = ("seed", "task", "trial")


class Placement(NamedTuple):
    """Branches `[S, K, R]` in blocks, one per host, and those in blocks per device."""

    counts: tuple[int, ...]  # S, K, R of the whole run
    hosts: tuple[int, ...]  # parts along each axis
    host: tuple[int, ...]  # which of these parts is computed here
    mesh: Mesh  # of devices of this host


def spread(num_seeds: int, num_tasks: int = 1, num_trials: int = 1) -> Placement:
    """Spreads branches over as many hosts and devices as divide them.

    A host that cannot have a block of its own repeats another's, for nothing.
    """
    counts = (num_seeds, num_tasks, num_trials)
    parts = grid(counts, jax.process_count())
    host = np.unravel_index(jax.process_index() % math.prod(parts), parts)
    here = tuple(c // p for c, p in zip(counts, parts, strict=True))
    devices = _devices()
    shape = grid(here, len(devices))
    mesh = Mesh(np.array(devices[: math.prod(shape)]).reshape(shape), AXES)
    return Placement(counts, parts, tuple(int(i) for i in host), mesh)


def grid(counts: tuple[int, ...], limit: int) -> tuple[int, ...]:
    """Returns the most equal parts up to `limit`, per axis; the first axes go first.

    >>> grid((4, 4, 5), 4), grid((1, 4, 5), 4), grid((3, 4, 1), 8), grid((3, 1, 1), 2)
    ((4, 1, 1), (1, 4, 1), (3, 2, 1), (1, 1, 1))
    """
    divisors = [[d for d in range(1, min(c, limit) + 1) if c % d == 0] for c in counts]
    fitting = (g for g in itertools.product(*divisors) if math.prod(g) <= limit)
    return max(fitting, key=lambda g: (math.prod(g), g))


def idle(placement: Placement) -> str | None:
    """Says in one line which devices have nothing of their own to do."""
    there = jax.process_count() * len(_devices())
    used = math.prod(placement.hosts) * placement.mesh.size
    if used == there:
        return None
    names = ("seeds", "tasks", "trials")
    what = [f"{c} {n}" for c, n in zip(placement.counts, names, strict=True) if c > 1]
    return (
        f"using {used} of {there} devices; {' x '.join(what) or '1 seed'} cannot be "
        "spread over more in equal parts."
    )


def each(placement: Placement, axis: str) -> int:
    """Returns how many seeds, tasks or trials a single device has."""
    i = AXES.index(axis)
    return placement.counts[i] // placement.hosts[i] // placement.mesh.shape[axis]


def split(
    placement: Placement, function: Callable[..., Any], takes: Any, gives: Any
) -> Callable[..., Any]:
    """Returns `function`, called on every device with its own block.

    Args:
      placement: one device of this host leaves the function as it is.
      function: not jitted.
      takes: a prefix of the arguments' pytree: PartitionSpecs over the axes.
      gives: the same of the results.
    """
    if placement.mesh.size == 1:
        return function
    # Unchecked: what is not sharded, as the size of the datasets, is equal on all.
    return jax.shard_map(
        function, mesh=placement.mesh, in_specs=takes, out_specs=gives, check_vma=False
    )


def place(placement: Placement, tree: Any, *axes: str) -> Any:
    """Puts this host's part of the whole on its devices.

    Args:
      placement: one host with one device leaves the arrays where they are.
      tree: arrays whose leading axes are `axes`, or without any axis.
      axes: of AXES.
    """

    def one(x: jax.Array) -> jax.Array:
        spec = P(*axes) if x.ndim else P()
        if placement.mesh.size > 1:
            return jax.device_put(x, NamedSharding(placement.mesh, spec))
        return x

    if math.prod(placement.hosts) > 1:
        tree = block(placement, tree, *axes)
    return jax.tree.map(one, tree)


def block(placement: Placement, tree: Any, *axes: str) -> Any:
    """Returns this host's part of the whole."""
    ours = []
    for axis in axes:
        i = AXES.index(axis)
        size = placement.counts[i] // placement.hosts[i]
        ours.append(slice(placement.host[i] * size, (placement.host[i] + 1) * size))
    return jax.tree.map(lambda x: x[tuple(ours)] if x.ndim else x, tree)


def collect(placement: Placement, tree: Any, *axes: str) -> Any:
    """Returns the whole, on every host: what `place` has taken apart.

    NumPy arrays, unless one host with one device has everything anyway.
    """
    if jax.process_count() == 1 == placement.mesh.size:
        return tree
    # In one layout: NumPy's sums depend on it.
    tree = jax.tree.map(lambda x: np.array(x, order="C"), jax.device_get(tree))
    if jax.process_count() == 1:
        return tree
    whole = join(placement, distributed.gather(tree), *axes)
    return jax.tree.map(lambda x: np.array(x, order="C"), whole)


def join(placement: Placement, tree: Any, *axes: str) -> Any:
    """Puts the blocks of all hosts, `[hosts, ...]`, together again."""
    parts = [placement.hosts[AXES.index(axis)] for axis in axes]

    def one(x: np.ndarray) -> np.ndarray:
        if x.ndim == 1:
            return x[:1].reshape(())
        x = x[: math.prod(parts)].reshape(*parts, *x.shape[1:])
        n = len(parts)  # now parts, then blocks; wanted is part, block, part, block
        order = [i + n * inner for i in range(n) for inner in (0, 1)]
        x = x.transpose(*order, *range(2 * n, x.ndim))
        sizes = [placement.counts[AXES.index(axis)] for axis in axes]
        return x.reshape(*sizes, *x.shape[2 * n :])

    return jax.tree.map(one, tree)


def bytes_in_use() -> int | None:
    """Returns the most that the arrays take of a device of this host, if they tell."""
    stats = [device.memory_stats() or {} for device in _devices()]
    return max((x["bytes_in_use"] for x in stats if "bytes_in_use" in x), default=None)


def _devices() -> list[Any]:
    """Returns the devices of this host; one if the user of jax has chosen one."""
    found = jax.local_devices()
    return found if getattr(jax.config, _CHOSEN) is None else found[:1]
