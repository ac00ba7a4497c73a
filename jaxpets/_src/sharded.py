"""One plan over several devices: each of them imagines a part of the candidates."""

from typing import Any, cast

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import check_key, check_record
from jaxpets._src.types import ObjectiveFn, Solution, TrajectoryOptimizer


def sharded(optimizer: TrajectoryOptimizer, axis_name: str) -> TrajectoryOptimizer:
    """Builds the same search with its candidates shared out over a named axis.

    For one plan too large for one device; many plans, of seeds or environments, are
    better placed whole. Inside `jax.shard_map` every device draws all N candidates,
    from the same key and state, evaluates N / devices of them, and learns the values
    of the others by one all-gather of `[N]` floats an iteration. What is left of an
    iteration is small, and done by each.

    Each device evaluates with `fold_in(key, axis index)`. The particles of a plan over
    several devices are therefore other draws than on one: equally good, not equal.
    Where the objective draws nothing, only rounding differs.

    Args:
      optimizer: the search. Where its candidates cannot be divided equally, as those
        of `icem`, the last one is imagined again on the last devices.
      axis_name: of the mesh; key, state and params must be equal along it. The
        `check_vma` of `jax.shard_map` cannot see that they stay so: turn it off.

    Returns:
      A TrajectoryOptimizer with the state of `optimizer`.

    Raises:
      TypeError: if optimizer is no TrajectoryOptimizer.
      NameError: from `step`, when traced, if no axis has that name.

    >>> import jax.numpy as jnp
    >>> from jax.sharding import Mesh, PartitionSpec
    >>> from jaxpets.optimizers import cem
    >>> one, mesh = jnp.ones(1), Mesh(jax.devices(), "device")
    >>> search = sharded(cem(horizon=3, action_low=-one, action_high=one), "device")
    >>> objective = lambda key, actions: -jnp.sum((actions - 0.5) ** 2, (1, 2))
    >>> step = lambda key, state: search.step(objective, key, state)
    >>> every = dict(in_specs=PartitionSpec(), out_specs=PartitionSpec())
    >>> step = jax.shard_map(step, mesh=mesh, **every, check_vma=False)
    >>> solution, _ = jax.jit(step)(jax.random.key(0), search.init())
    >>> bool(jnp.all(jnp.abs(solution.actions - 0.5) < 0.05))
    True
    """
    check_record("optimizer", optimizer, TrajectoryOptimizer)

    def step(objective_fn: ObjectiveFn, key: Array, state: Any) -> tuple[Solution, Any]:
        check_key("key", key)
        num_devices = jax.lax.axis_size(axis_name)
        index = jax.lax.axis_index(axis_name)

        def objective(key: Array, actions: Array) -> Array:
            num_samples = actions.shape[0]
            size = -(-num_samples // num_devices)
            if surplus := size * num_devices - num_samples:
                last = jnp.broadcast_to(actions[-1:], (surplus, *actions.shape[1:]))
                actions = jnp.concatenate([actions, last])
            own = jax.lax.dynamic_slice_in_dim(actions, index * size, size)
            values = objective_fn(jax.random.fold_in(key, index), own)
            values = cast(Array, jax.lax.all_gather(values, axis_name, tiled=True))
            return values[:num_samples] if surplus else values

        return optimizer.step(objective, key, state)

    return TrajectoryOptimizer(optimizer.init, step)
