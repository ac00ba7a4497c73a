"""The contracts of the library: data records and Protocols.

The letters of their shapes are explained in the docstring of `jaxpets`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

from jax import Array


class Transition(NamedTuple):
    """One step of an environment, or a batch of them with equal leading axes.

    Attributes:
      obs: `[..., D]`.
      action: `[..., A]`.
      next_obs: `[..., D]`.
    """

    obs: Array
    action: Array
    next_obs: Array


class Dataset(NamedTuple):
    """Transitions in arrays of fixed size; when full, the oldest rows are replaced.

    Attributes:
      data: a Transition `[C, ...]`; rows from `size` on hold zeros.
      size: `[]` int32, how many rows are valid.
      cursor: `[]` int32, the next row to write.
    """

    data: Transition
    size: Array
    cursor: Array


class PlanParams(NamedTuple):
    """Everything about planning that may change between calls without a retrace.

    Attributes:
      dynamics: the model's parameters, forwarded to rollout_fn; any pytree.
      reward: the reward's data, forwarded to reward_fn; any pytree.
    """

    dynamics: Any
    reward: Any = ()


class Candidates(NamedTuple):
    """The M sequences that a search tried in one call, iteration after iteration.

    Attributes:
      actions: `[M, H, A]`.
      values: `[M]`, what the objective answered.
    """

    actions: Array
    values: Array


class Solution(NamedTuple):
    """What a trajectory optimizer found.

    Attributes:
      actions: `[H, A]`.
      value: `[]`, the mean value of the last elites.
      candidates: all that was tried, if the search keeps it; else ().
    """

    actions: Array
    value: Array
    candidates: Candidates | tuple[()] = ()


class PlanOutput(NamedTuple):
    """What a planner decided.

    Attributes:
      action: `[A]`, to execute now.
      actions: `[H, A]`, the whole plan.
      value: `[]`, the return under the model, summed over the horizon: the mean over
        the last elites, in the reward's unit.
      candidates: all that was tried, if the search keeps it; else (). Their paths are
        one call of the rollout.
    """

    action: Array
    actions: Array
    value: Array
    candidates: Candidates | tuple[()] = ()


class EnvState(NamedTuple):
    """State of an environment. It has no reward: phase 1 of the paper has none.

    Attributes:
      obs: `[D]` float32.
      physics: whatever the simulator needs to go on; any pytree.
      constants: what was drawn for this trial and stays, as the place of a target, for
        rewards to read; any pytree, () where there is nothing.
    """

    obs: Array
    physics: Any
    constants: Any = ()


class DynamicsFn(Protocol):
    """A model that moves particles by one step."""

    def __call__(self, params: Any, key: Array, obs: Array, action: Array, /) -> Array:
        """Samples the next observation of every particle, each with its own member.

        Args:
          params: anything the model needs.
          key: consumed.
          obs: `[E, B, D]`; row block e belongs to member e.
          action: `[B, A]`, shared by the members, as a search has them; from a policy,
            which sees where each member has led, `[E, B, A]`.

        Returns:
          `[E, B, D]`, the next observations.
        """
        ...


class RolloutFn(Protocol):
    """An imagination: action sequences in, observation paths out."""

    def __call__(self, params: Any, key: Array, obs: Any, actions: Array, /) -> Array:
        """Rolls N action sequences out from one start.

        Args:
          params: anything the model needs.
          key: consumed.
          obs: `[D]`, or whatever start state this rollout understands.
          actions: `[N, H, A]`.

        Returns:
          `[N, H+1, E, P, D]` observations; index 0 along time is the start.
        """
        ...


@runtime_checkable
class ModelRolloutFn(RolloutFn, Protocol):
    """A RolloutFn that prepares the model's parameters once for many calls.

    A planner that gets one binds it before its search, so that what depends on nothing
    but the parameters stays out of the loop. `rollout_fn(params, key, obs, actions)`
    must equal `rollout_fn.bind(params)(key, obs, actions)`.
    """

    def bind(self, params: Any, /) -> Callable[[Array, Any, Array], Array]:
        """Returns `(key, obs, actions) -> path`, as `__call__` has them.

        Args:
          params: anything the model needs.
        """
        ...


class RewardFn(Protocol):
    """A reward of one imagined step of one candidate, given its whole particle set."""

    def __call__(
        self, params: Any, obs: Array, action: Array, next_obs: Array, /
    ) -> Array:
        """Rewards one step.

        Args:
          params: reward data: task weights, a baseline variance, a count table, ().
          obs: `[E, P, D]`.
          action: `[A]`.
          next_obs: `[E, P, D]`.

        Returns:
          `[E, P]`, averaged by the planner, or `[]` if the set is already reduced.
        """
        ...


class ObjectiveFn(Protocol):
    """The function a trajectory optimizer maximises."""

    def __call__(self, key: Array, actions: Array, /) -> Array:
        """Values `[N]` of sequences `[N, H, A]`: higher is better, always finite."""
        ...


class TrajectoryOptimizer(NamedTuple):
    """A search over action sequences; its state is the warm start.

    Attributes:
      init: `() -> state`.
      step: `(objective_fn, key, state) -> (Solution, state)`; the state that comes out
        is already shifted by one step.
    """

    init: Callable[[], Any]
    step: Callable[[ObjectiveFn, Array, Any], tuple[Solution, Any]]


class Planner(NamedTuple):
    """A policy that plans.

    Attributes:
      init: `() -> state`; call it at the start of every trial.
      step: `(PlanParams, key, state, obs [D]) -> (PlanOutput, state)`.
    """

    init: Callable[[], Any]
    step: Callable[[PlanParams, Array, Any, Any], tuple[PlanOutput, Any]]


class Coordinate(NamedTuple):
    """One entry of an observation, and how a model sees it.

    Attributes:
      name: unique among the entries.
      kind: what the model predicts. "relative": the change. "absolute": the value.
        "angle": the change of an unwrapped angle in rad, which the network reads as
        sine and cosine. "quaternion": one of four rows in a run, w, x, y and z of a
        unit quaternion; the model turns them together and keeps them unit.
      is_input: whether the network reads it.
      is_bounded: whether imagination keeps it near the data. Never true of an angle,
        which grows without limit, and of a quaternion, which is bounded as it is.
    """

    name: str
    kind: str = "relative"
    is_input: bool = True
    is_bounded: bool = True


class Env(NamedTuple):
    """A simulator of one environment; batch it with `jax.vmap`.

    Attributes:
      reset: `(key) -> EnvState`.
      step: `(EnvState, action [A]) -> EnvState`.
      action_low: `[A]`, finite.
      action_high: `[A]`, finite.
      coordinates: D entries of the observation; none where nobody has named them.
      terminal_fn: `(obs [..., D]) -> bool [...]`, whether a trial has ended there, as a
        robot that fell; the next step is from a new start. None: a trial ends by its
        length alone. Imagination ends there if `plan` is told so, by
        `terminal_fn=lambda params, obs: env.terminal_fn(obs)`.
    """

    reset: Callable[[Array], EnvState]
    step: Callable[[EnvState, Array], EnvState]
    action_low: Array
    action_high: Array
    coordinates: tuple[Coordinate, ...] = ()
    terminal_fn: Callable[[Array], Array] | None = None


class ModelSpace(NamedTuple):
    """The coordinates in which a model sees observations.

    The law `next_obs(o, target(o, x)) == x` must hold; `jaxpets.check_space` tries it
    on data. A predicted variance is taken to be the variance of the next observation,
    so `next_obs` should add the target to something that it does not stretch.

    Attributes:
      features: `(obs [..., D]) -> [..., F]`, what the network reads.
      target: `(obs, next_obs) -> [..., D]`, what it predicts.
      next_obs: `(obs, target) -> [..., D]`, the inverse of `target`.
      bound: `(obs, low [D], high [D]) -> [..., D]`, keeps imagined observations in a
        box. Leave free what grows without limit in the world, as an unwrapped angle.
      coordinates: the D entries that it was built from; none in a space of your own.
    """

    features: Callable[[Array], Array]
    target: Callable[[Array, Array], Array]
    next_obs: Callable[[Array, Array], Array]
    bound: Callable[[Array, Array, Array], Array]
    coordinates: tuple[Coordinate, ...] = ()
