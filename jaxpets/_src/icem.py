"""iCEM: a cross-entropy method for small budgets."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
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
    the elites or, if that is less, `num_samples`; the last iteration also tries the
    mean itself.

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
    horizon = check_count("horizon", horizon)
    box = action_box(action_low, action_high)
    num_samples, num_elites = check_elites(num_samples, num_elites)
    num_iterations = check_count("num_iterations", num_iterations)
    momentum, noise_beta, init_std = _numbers(
        momentum, noise_beta, init_std, kept_fraction, decay
    )
    _check_flags(execute_best, unroll, keep_candidates)
    shape = (horizon, box.center.shape[0])
    num_kept = round(kept_fraction * num_elites)
    smallest = min(num_samples, 2 * num_elites)
    populations = _populations(num_samples, smallest, decay, num_iterations)

    def init() -> ICEMState:
        mean = box.start(horizon)
        # No sequence was found yet: the middle of the box stands in.
        return ICEMState(mean, jnp.broadcast_to(mean, (num_kept, *shape)))

    def evaluate(
        objective_fn: ObjectiveFn,
        value_key: Array,
        found: _Found,
        noise: Array,
        with_mean: bool,
    ) -> Candidates:
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
        objective_fn: ObjectiveFn, keys: Array, noises: Sequence[Array], found: _Found
    ) -> tuple[_Found, Any]:
        row = jnp.arange(num_samples + num_kept + 1, dtype=jnp.int32)

        def iterate(found: _Found, inputs: tuple[Array, ...]) -> tuple[_Found, Any]:
            key, noise, population, is_last = inputs
            tried = evaluate(objective_fn, key, found, noise, True)
            is_spare = (row >= population) & (row < num_samples)
            is_spare |= (row == row[-1]) & ~is_last
            # Below the worst value: there are always enough others to be elites.
            values = jnp.where(is_spare, -jnp.inf, tried.values)
            better = improve(found, tried.actions, values)
            return better, (tried if keep_candidates else ())

        is_last = jnp.arange(num_iterations) == num_iterations - 1
        # Of one size: what fills up the smaller ones is the surplus that is left out.
        noise = [jnp.resize(x, (num_samples, *shape)) for x in noises]
        inputs = (keys, jnp.stack(noise), jnp.array(populations, jnp.int32), is_last)
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
        noise_key, key = jax.random.split(key)
        keys = jax.random.split(key, num_iterations)
        # Of all iterations at once, which are fewer programs for a GPU to start.
        noises = jnp.split(
            colored_noise(noise_key, noise_beta, (sum(populations), *shape)),
            np.cumsum(populations)[:-1],
        )
        if unroll:
            every: list[Any] = []
            for i in range(num_iterations):
                is_last = i == num_iterations - 1
                tried = evaluate(objective_fn, keys[i], found, noises[i], is_last)
                found = improve(found, *tried)
                every.append(tried if keep_candidates else ())
            tried = jax.tree.map(lambda *parts: jnp.concatenate(parts), *every)
        else:
            found, tried = loop(objective_fn, keys, noises, found)
        best = found.best if execute_best else found.mean
        state = ICEMState(box.shift(found.mean), box.shift(found.kept))
        return Solution(best, found.value, tried), state

    return TrajectoryOptimizer(init, step)


def _populations(
    num_samples: int, smallest: int, decay: float, num_iterations: int
) -> list[int]:
    """Returns how many samples each iteration draws."""
    # Beyond e^700 there is no float, and none of any number of samples is left.
    last = num_iterations if decay == 1 else math.ceil(700 / math.log(decay))
    return [
        max(int(num_samples / decay**i), smallest) if i < last else smallest
        for i in range(num_iterations)
    ]


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
    frequency = np.fft.rfftfreq(horizon, 1 / horizon)
    angle = 2 * np.pi * np.outer(frequency, np.arange(horizon)) / horizon
    # H waves: a cosine of each frequency, and a sine where there is one.
    waves = np.concatenate([np.cos(angle), np.sin(angle)[1:]])[:horizon]
    frequency = np.concatenate([frequency, frequency[1:]])[:horizon]
    has_sine = (frequency > 0) & (2 * frequency < horizon)
    waves *= np.where(has_sine, np.sqrt(2), 1.0)[:, None]  # the same power for all
    # The mean has the power of the lowest frequency, as it would of one still lower.
    # In units of the lowest, so that no power of it overflows.
    scale = jnp.maximum(frequency.astype(np.float32), 1.0) ** (-beta / 2)
    scale /= jnp.sqrt(jnp.sum(scale**2))
    waves = scale[:, None] * waves.astype(np.float32)
    # A product and no inverse FFT: on a GPU that is one program in place of several.
    white = jax.random.normal(key, (*shape[:-2], shape[-1], horizon), jnp.float32)
    noise = jnp.matmul(white, waves, precision=jax.lax.Precision.HIGHEST)
    return noise.swapaxes(-1, -2)
