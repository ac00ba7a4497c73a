"""iCEM: a cross-entropy method for small budgets."""

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
    check_real,
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


class ICEMState(NamedTuple):
    """The warm start of `icem`.

    Attributes:
      mean: `[H, A]`, of the next search.
      elites: `[K, H, A]`, the best sequences of the last search.
    """

    mean: Array
    elites: Array


class _Found(NamedTuple):
    """What an iteration leaves to the next one; `kept` `[K, H, A]`, `value` `[]`."""

    mean: Array
    std: Array
    kept: Array
    best: Array
    value: Array


def icem(
    *,
    horizon: int,
    action_low: ArrayLike,
    action_high: ArrayLike,
    num_samples: int = 64,
    num_elites: int = 10,
    num_iterations: int = 3,
    momentum: float | Array = 0.1,
    noise_beta: float | Array = 2.0,
    init_std: float | Array = 0.5,
    kept_fraction: float = 0.3,
    decay: float = 1.25,
    execute_best: bool = False,
    unroll: bool = True,
    keep_candidates: bool = False,
) -> TrajectoryOptimizer:
    """Builds iCEM (Pinneri et al., 2020).

    Against `cem`: noise is correlated over time, with power `1 / f^noise_beta`; a share
    of the elites enters the next iteration and, shifted by one step, the next call;
    iteration i draws `num_samples / decay^i` samples, never fewer than two times
    the elites; the last iteration also tries the mean itself.

    Args:
      horizon: H.
      action_low: `[A]`.
      action_high: `[A]`.
      num_samples: N of the first iteration.
      num_elites: how many of the best samples shape the next iteration.
      num_iterations: iterations per call.
      momentum: share of the old mean and standard deviation that is kept; may
        be traced.
      noise_beta: 0 is white noise, 2 a random walk; may be traced.
      init_std: standard deviation at the start of a call, in units of a box scaled to
        `[-1, 1]`; may be traced.
      kept_fraction: share of the elites that is kept.
      decay: shrinking factor of the population.
      execute_best: return the best sequence seen in the last iteration, as in the
        paper of iCEM, and not the mean, which is less prone to a model's errors.
      unroll: compile the iterations one after the other, each with its population.
        False compiles them as one loop, in about the time of one iteration. The same
        sequences are tried, but all iterations imagine as many as the first and the
        mean, and leave the surplus out: it takes longer to run, the more the steeper
        the decay, and a model's noise is another draw.
      keep_candidates: return all sequences that were tried, with their values, in
        `Solution.candidates`; for drawing them. In a loop those are among them that
        `unroll` leaves out.

    Returns:
      A TrajectoryOptimizer.

    Raises:
      TypeError, ValueError: for a size, number or bound that cannot be searched with.
    """
    check_count("horizon", horizon)
    box = action_box(action_low, action_high)
    check_elites(num_samples, num_elites)
    check_count("num_iterations", num_iterations)
    momentum, noise_beta, init_std = _numbers(
        momentum, noise_beta, init_std, kept_fraction, decay
    )
    _check_flags(execute_best, unroll, keep_candidates)
    shape = (horizon, box.center.shape[0])
    num_kept = round(kept_fraction * num_elites)
    smallest = min(num_samples, 2 * num_elites)
    populations = [
        max(int(num_samples / decay**i), smallest) for i in range(num_iterations)
    ]

    def init() -> ICEMState:
        mean = box.start(horizon)
        # No sequence was found yet: the middle of the box stands in.
        return ICEMState(mean, jnp.broadcast_to(mean, (num_kept, *shape)))

    def evaluate(
        objective_fn: ObjectiveFn,
        keys: Array,
        found: _Found,
        population: int,
        with_mean: bool,
    ) -> Candidates:
        sample_key, value_key = keys
        noise = colored_noise(sample_key, noise_beta, (population, *shape))
        actions = box.clip(found.mean + found.std * noise)
        candidates = [actions, found.kept]
        if with_mean:
            candidates.append(found.mean[None])
        actions = jnp.concatenate(candidates)
        values = objective_fn(value_key, actions)
        check_array("objective_fn's result", values, [actions.shape[0]])
        return Candidates(actions, values)

    def improve(found: _Found, actions: Array, values: Array) -> _Found:
        elites = select_elites(values, actions, num_elites)
        mean = box.clip(momentum * found.mean + (1 - momentum) * elites.mean)
        std = momentum * found.std + (1 - momentum) * jnp.sqrt(elites.variance)
        return _Found(
            mean, std, elites.actions[:num_kept], elites.actions[0], elites.value
        )

    def loop(
        objective_fn: ObjectiveFn, keys: Array, found: _Found
    ) -> tuple[_Found, Any]:
        row = jnp.arange(num_samples + num_kept + 1)

        def iterate(found: _Found, inputs: tuple[Array, ...]) -> tuple[_Found, Any]:
            keys, population, is_last = inputs
            tried = evaluate(objective_fn, keys, found, num_samples, True)
            is_spare = (row >= population) & (row < num_samples)
            is_spare |= (row == row[-1]) & ~is_last
            # Below the worst value: there are always enough others to be elites.
            values = jnp.where(is_spare, -jnp.inf, tried.values)
            better = improve(found, tried.actions, values)
            return better, (tried if keep_candidates else ())

        is_last = jnp.arange(num_iterations) == num_iterations - 1
        inputs = (keys, jnp.array(populations, jnp.int32), is_last)
        found, tried = jax.lax.scan(iterate, found, inputs)
        return found, join_iterations(tried)

    def step(
        objective_fn: ObjectiveFn, key: Array, state: ICEMState
    ) -> tuple[Solution, ICEMState]:
        check_key("key", key)
        check_record("state", state, ICEMState)
        mean, kept = state
        check_array("state.mean", mean, shape)
        check_array("state.elites", kept, [num_kept, *shape])
        std = jnp.broadcast_to(init_std * box.half_width, shape)
        found = _Found(mean, std, kept, mean, jnp.zeros((), jnp.float32))
        keys = jax.random.split(key, (num_iterations, 2))
        if unroll:
            every: list[Any] = []
            for i, population in enumerate(populations):
                is_last = i == num_iterations - 1
                tried = evaluate(objective_fn, keys[i], found, population, is_last)
                found = improve(found, *tried)
                every.append(tried if keep_candidates else ())
            tried = jax.tree.map(lambda *parts: jnp.concatenate(parts), *every)
        else:
            found, tried = loop(objective_fn, keys, found)
        best = found.best if execute_best else found.mean
        state = ICEMState(box.shift(found.mean), box.shift(found.kept))
        return Solution(best, found.value, tried), state

    return TrajectoryOptimizer(init, step)


def _numbers(
    momentum: float | Array,
    noise_beta: float | Array,
    init_std: float | Array,
    kept_fraction: float,
    decay: float,
) -> tuple[float | Array, float | Array, float | Array]:
    """Checks all of them and returns those that may be traced."""
    check_real("kept_fraction", kept_fraction, 0.0, 1.0)
    check_real("decay", decay, 1.0)
    return (
        check_scalar("momentum", momentum, 0.0, 1.0),
        check_scalar("noise_beta", noise_beta, 0.0),
        check_scalar("init_std", init_std, 1e-6),
    )


def _check_flags(execute_best: bool, unroll: bool, keep_candidates: bool) -> None:
    check_flag("execute_best", execute_best)
    check_flag("unroll", unroll)
    check_flag("keep_candidates", keep_candidates)


def colored_noise(key: Array, beta: float | Array, shape: tuple[int, ...]) -> Array:
    """Draws Gaussian noise of unit variance, correlated along axis -2 (time).

    The power of frequency f is proportional to `1 / f^beta`; entries of the last axis
    and of the leading axes are independent (Timmer and Koenig, 1995).

    Args:
      key: consumed.
      beta: the exponent.
      shape: `(..., H, A)`.

    Returns:
      An array of `shape`.
    """
    horizon = shape[-2]
    if horizon == 1:
        return jax.random.normal(key, shape, jnp.float32)
    frequency = jnp.fft.rfftfreq(horizon).astype(jnp.float32)
    # The mean has the power of the lowest frequency, as it would of one still lower.
    # In units of the lowest, so that no power of it overflows.
    frequency = jnp.maximum(frequency * horizon, 1.0)
    scale = frequency ** (-beta / 2)
    real_key, imaginary_key = jax.random.split(key)
    half = (*shape[:-2], shape[-1], frequency.shape[0])
    real = jax.random.normal(real_key, half, jnp.float32)
    imaginary = jax.random.normal(imaginary_key, half, jnp.float32)
    # Frequency 0, and for even H the highest, are real; sqrt(2) keeps their power.
    is_real = jnp.zeros(frequency.shape, bool).at[0].set(True)
    is_real = is_real.at[-1].set(is_real[-1] | (horizon % 2 == 0))
    real = jnp.where(is_real, jnp.sqrt(2.0).astype(jnp.float32) * real, real)
    imaginary = jnp.where(is_real, 0.0, imaginary)
    weight = jnp.where(is_real, 2.0, 4.0).astype(jnp.float32) * scale**2
    std = jnp.sqrt(jnp.sum(weight)) / horizon
    noise = jnp.fft.irfft(jax.lax.complex(scale * real, scale * imaginary), horizon)
    return (noise / std).swapaxes(-1, -2).astype(jnp.float32)
