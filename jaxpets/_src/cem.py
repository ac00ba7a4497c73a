"""The cross-entropy method over action sequences, as PETS uses it."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from jaxpets._src.action_box import action_box
from jaxpets._src.checks import (
    check_array,
    check_count,
    check_flag,
    check_key,
    check_record,
    check_scalar,
)
from jaxpets._src.elites import check_elites, join_iterations, select_elites
from jaxpets._src.types import (
    Candidates,
    ObjectiveFn,
    Solution,
    TrajectoryOptimizer,
)

# Mean and variance, both `[H, A]`, and the value `[]` of the elites.
_Carry = tuple[Array, Array, Array]


class CEMState(NamedTuple):
    """The warm start of `cem`.

    Attributes:
      mean: `[H, A]`, of the next search.
    """

    mean: Array


def cem(
    *,
    horizon: int,
    action_low: ArrayLike,
    action_high: ArrayLike,
    num_samples: int = 500,
    num_elites: int = 50,
    num_iterations: int = 5,
    momentum: float | Array = 0.1,
    min_variance: float | Array = 1e-3,
    legacy_variance: bool = False,
    unroll: bool = False,
    keep_candidates: bool = False,
) -> TrajectoryOptimizer:
    """Builds the cross-entropy method with the settings of PETS.

    Each iteration samples from a normal distribution cut off at two standard
    deviations, which are narrowed so that no sample leaves the box, and moves mean and
    variance towards those of the elites:
    `new = momentum * old + (1 - momentum) * elite statistic`. The search returns the
    final mean. The variance starts at `(high - low)^2 / 16` at every call; the mean is
    the last solution shifted by one step and padded with the middle of the box.

    Args:
      horizon: H.
      action_low: `[A]`.
      action_high: `[A]`.
      num_samples: N.
      num_elites: how many of the best samples shape the next iteration.
      num_iterations: iterations per call.
      momentum: share of the old mean and variance that is kept; may be traced.
      min_variance: the search freezes once no variance exceeds this, in units of a
        box scaled to `[-1, 1]`; may be traced. It starts at 0.25, so that more than
        that allows no search.
      legacy_variance: take the elites' variance without momentum, as the first
        public PETS code did by mistake until November 2018.
      unroll: compile the iterations one after the other and not as a loop. The search
        is the same, its code num_iterations times as long; on a CPU it may need more
        memory. For rollouts as short as those of `fused_rollout` on a GPU, beside
        which the programs that a loop adds count.
      keep_candidates: return all sequences that were tried, with their values, in
        `Solution.candidates`; for drawing them.

    Returns:
      A TrajectoryOptimizer.

    Raises:
      TypeError, ValueError: for a size, number or bound that cannot be searched with.

    >>> import jax, jax.numpy as jnp
    >>> one = jnp.ones(1)
    >>> search = cem(horizon=3, action_low=-one, action_high=one)
    >>> objective = lambda key, actions: -jnp.sum((actions - 0.5) ** 2, (1, 2))
    >>> solution, _ = search.step(objective, jax.random.key(0), search.init())
    >>> bool(jnp.all(jnp.abs(solution.actions - 0.5) < 0.05))
    True
    """
    horizon = check_count("horizon", horizon)
    box = action_box(action_low, action_high)
    num_samples, num_elites = check_elites(num_samples, num_elites)
    num_iterations = check_count("num_iterations", num_iterations)
    momentum = check_scalar("momentum", momentum, 0.0, 1.0)
    min_variance = check_scalar("min_variance", min_variance, 0.0)
    check_flag("legacy_variance", legacy_variance)
    check_flag("unroll", unroll)
    check_flag("keep_candidates", keep_candidates)
    shape = (horizon, box.center.shape[0])

    def sample(key: Array, mean: Array, variance: Array) -> Array:
        margin = jnp.minimum(mean - box.low, box.high - mean)
        std = jnp.minimum(jnp.sqrt(variance), margin / 2)
        noise = jax.random.truncated_normal(
            key, -2.0, 2.0, (num_samples, *shape), jnp.float32
        )
        # The clip only removes rounding: mean + 2 * std can pass the bound by one ulp.
        return box.clip(mean + std * noise)

    def init() -> CEMState:
        return CEMState(mean=box.start(horizon))

    def step(
        objective_fn: ObjectiveFn, key: Array, state: CEMState
    ) -> tuple[Solution, CEMState]:
        check_key("key", key)
        check_record("state", state, CEMState)
        check_array("state.mean", state.mean, shape)

        def iterate(carry: _Carry, keys: Array) -> tuple[_Carry, Any]:
            mean, variance, _value = carry
            sample_key, value_key = keys
            actions = sample(sample_key, mean, variance)
            values = objective_fn(value_key, actions)
            check_array("objective_fn's result", values, [num_samples])
            elites = select_elites(values, actions, num_elites)
            kept = 0.0 if legacy_variance else momentum
            new = (
                box.clip(momentum * mean + (1 - momentum) * elites.mean),
                kept * variance + (1 - kept) * elites.variance,
                elites.value,
            )
            searching = jnp.max(variance / box.half_width**2) > min_variance
            keep = functools.partial(jnp.where, searching)
            tried = Candidates(actions, values) if keep_candidates else ()
            return jax.tree.map(keep, new, carry), tried

        variance = jnp.broadcast_to(box.half_width**2 / 4, shape)
        start = (state.mean, variance, jnp.zeros((), jnp.float32))
        keys = jax.random.split(key, (num_iterations, 2))
        (mean, _, value), tried = jax.lax.scan(
            iterate, start, keys, unroll=bool(unroll)
        )
        solution = Solution(mean, value, join_iterations(tried))
        return solution, CEMState(mean=box.shift(mean))

    return TrajectoryOptimizer(init, step)
