"""Model-predictive path integral control: a softmax over sampled sequences."""

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
from jaxpets._src.elites import is_valid, join_iterations
from jaxpets._src.types import (
    Candidates,
    ObjectiveFn,
    Solution,
    TrajectoryOptimizer,
)


class MPPIState(NamedTuple):
    """The warm start of `mppi`.

    Attributes:
      mean: `[H, A]`, of the next search.
    """

    mean: Array


def mppi(
    *,
    horizon: int,
    action_low: ArrayLike,
    action_high: ArrayLike,
    num_samples: int = 500,
    num_iterations: int = 1,
    std: float | Array = 0.5,
    temperature: float | Array = 1.0,
    keep_candidates: bool = False,
) -> TrajectoryOptimizer:
    """Builds MPPI (Williams et al., 2017).

    `mean = sum_n softmax(value_n / temperature) * a_n` over noisy copies a_n of the
    last mean. Values are divided by their interquartile range, so that the temperature
    has no unit.

    Args:
      horizon: H.
      action_low: `[A]`.
      action_high: `[A]`.
      num_samples: N.
      num_iterations: iterations per call.
      std: of the noise, in units of a box scaled to `[-1, 1]`; may be traced.
      temperature: 0.1 follows the best few samples, 10 averages over all; may be
        traced.
      keep_candidates: return all sequences that were tried, with their values, in
        `Solution.candidates`; for drawing them.

    Returns:
      A TrajectoryOptimizer; its Solution's value is the weighted mean of the last
      values.

    Raises:
      TypeError, ValueError: for a size, number or bound that cannot be searched with.
    """
    horizon = check_count("horizon", horizon)
    box = action_box(action_low, action_high)
    num_samples = check_count("num_samples", num_samples, minimum=2)
    num_iterations = check_count("num_iterations", num_iterations)
    std = check_scalar("std", std, 1e-6)
    temperature = check_scalar("temperature", temperature, 1e-6)
    check_flag("keep_candidates", keep_candidates)
    scale = std * box.half_width
    shape = (horizon, box.center.shape[0])

    def init() -> MPPIState:
        return MPPIState(mean=box.start(horizon))

    def step(
        objective_fn: ObjectiveFn, key: Array, state: MPPIState
    ) -> tuple[Solution, MPPIState]:
        check_key("key", key)
        check_record("state", state, MPPIState)
        check_array("state.mean", state.mean, shape)

        def iterate(mean: Array, keys: Array) -> tuple[Array, tuple[Array, Any]]:
            sample_key, value_key = keys
            noise = jax.random.normal(sample_key, (num_samples, *shape), jnp.float32)
            actions = box.clip(mean + scale * noise)
            values = objective_fn(value_key, actions)
            check_array("objective_fn's result", values, [num_samples])
            # Ranks, not values, set the scale where one candidate has blown up.
            # The rejected neither set the scale nor have a weight, unless all are.
            kept = is_valid(values)
            quartiles = jnp.array([0.25, 0.75], jnp.float32)
            low, high = jnp.nanquantile(jnp.where(kept, values, jnp.nan), quartiles)
            spread = jnp.maximum(high - low, 1e-6)
            weights = jax.nn.softmax(
                (values - jnp.max(values)) / (temperature * spread), where=kept
            )
            mean = jnp.einsum("n,nha->ha", weights, actions)
            tried = Candidates(actions, values) if keep_candidates else ()
            return box.clip(mean), (jnp.sum(weights * values), tried)

        keys = jax.random.split(key, (num_iterations, 2))
        mean, (values, tried) = jax.lax.scan(iterate, state.mean, keys)
        state = MPPIState(mean=box.shift(mean))
        return Solution(mean, values[-1], join_iterations(tried)), state

    return TrajectoryOptimizer(init, step)
