"""A planner and its model in a world that is not JAX; all else here has no state."""

import os
from collections.abc import Mapping
from typing import Any, cast

import jax
import numpy as np
from jax import Array

from jaxpets._src import agent_file
from jaxpets._src import agent_steps as computed
from jaxpets._src import agent_world as told
from jaxpets._src.agent_call import Direct, Mailbox, compiled, first_state, places
from jaxpets._src.agent_steps import AgentSteps, Given, act_fn, agent_steps
from jaxpets._src.agent_world import World, autoreset_of
from jaxpets._src.checks import check_count, check_functions, check_record
from jaxpets._src.ensemble import Ensemble, params_check
from jaxpets._src.ensemble_params import EnsembleParams
from jaxpets._src.fit_records import FitMetrics, Fitter
from jaxpets._src.learner import LearnerState, RewardData
from jaxpets._src.types import Planner, PlanParams

_NO_DATA = RewardData()
_BLOCK = 256  # rows that are moved to the device at a time
_CALLS = 2**31  # after so many, draws begin anew


def agent(
    planner: Planner,
    model: Ensemble,
    fitter: Fitter,
    *,
    random_planner: Planner,
    capacity: int,
    reward_data: RewardData = _NO_DATA,
    params: EnsembleParams | None = None,
    num_envs: int | None = None,
    autoreset: Any = None,
    seed: int = 0,
) -> "Agent":
    """Builds an agent for any world: a Gymnasium environment, a loop, a machine.

    Phase 1 of the paper (section 4), in a loop of the user's own::

      agent = jaxpets.agent(explorer, model, fitter, capacity=10_000,
          random_planner=jaxpets.random_planner(space.low, space.high))
      for trial in range(20):
          obs, done = env.reset()[0], False
          agent.reset()
          while not done:
              action = agent.act(obs)
              obs, _, terminated, truncated, info = env.step(action)
              agent.observe(obs, terminated, truncated, info)
              done = terminated or truncated
          agent.learn()

    and phase 2: `agent.perform(reward, planner)`, then act as before.

    Args:
      planner: explores, once the model has learned; from `jaxpets.plan`, whose rollout
        reads the parameters of `model` and whose reward the data of `reward_data`.
      model: what it imagines with.
      fitter: trains it.
      random_planner: acts before the model has learned anything.
      capacity: C, transitions kept; the oldest are replaced.
      reward_data: keeps the data of the exploration reward in step with the model.
      params: what the model learned before, as from `load_model`; it plans at once.
      num_envs: N worlds that are stepped together, as a vectorised environment of
        Gymnasium; None for one, without a leading axis.
      autoreset: who begins the next trial of a world, in the words of Gymnasium's
        AutoresetMode. "Disabled": you, before the next `act`. "NextStep": the world, at
        its next step, whatever the action. "SameStep": the world, in the step that ends
        the trial, whose last observation is in `info["final_obs"]`. By default
        "NextStep" where num_envs is given, as Gymnasium has it, and else "Disabled".
      seed: of all that is drawn, below 2**32.

    Returns:
      An Agent.

    Raises:
      TypeError, ValueError: if an argument is not what it should be.
    """
    check_record("planner", planner, Planner)
    check_record("model", model, Ensemble)
    check_record("fitter", fitter, Fitter)
    check_record("random_planner", random_planner, Planner)
    check_functions("reward_data", reward_data, RewardData)
    capacity = check_count("capacity", capacity)
    seed = check_count("seed", seed, 0, 2**32 - 1)  # JAX cuts off what is above
    if num_envs is not None:
        num_envs = check_count("num_envs", num_envs)
    if params is not None:
        params_check(model.init)(params)
    world = World(model.obs_size, num_envs, autoreset_of(autoreset, num_envs))
    steps = agent_steps(model, fitter, reward_data, capacity)
    key = jax.random.key(seed)
    return Agent(planner, random_planner, steps, world, key, params)


class Agent:
    """An agent in a world that is not JAX; `jaxpets.agent` makes one.

    What it has learned is a LearnerState, and all that it computes is pure functions;
    this class holds the state, compiles each function once, and speaks NumPy. The first
    `act` with a planner compiles, for seconds: call it, and `reset`, before it matters.
    """

    def __init__(
        self,
        planner: Planner,
        random_planner: Planner,
        steps: AgentSteps,
        world: World,
        key: Array,
        params: EnsembleParams | None,
    ) -> None:
        self._planner, self._random, self._world = planner, random_planner, world
        self._steps = steps
        self._append: computed.AppendFn = jax.jit(steps.append)
        self._learn: computed.LearnFn = jax.jit(steps.learn)
        init_key, self._act_key, self._learn_key = jax.random.split(key, 3)
        self._state: LearnerState = jax.jit(steps.init)(init_key, params)
        self._places = places(self.params)
        self._counts = agent_file.Counts(0, 0, 0, trained=int(params is not None))
        self._task: tuple[Planner, Any] | None = None
        self._acting: Planner | None = None  # whose state is `_plan`
        self._plan: Any = ()
        self._acts: dict[Planner, Direct | Mailbox] = {}
        self._seen = told.memory(cast(LearnerState, self._state).dataset)
        self.reset()

    @property
    def params(self) -> EnsembleParams:
        """What the model has learned, as `save_model` takes it."""
        return self._state.params

    @property
    def num_steps(self) -> int:
        """Transitions that were observed, of all worlds together."""
        return self._counts.steps

    def reset(self) -> None:
        """Begins a new trial in every world: nothing planned before is kept.

        After a trial that ended by itself this happens anyway; call it when you break
        one off. An action whose outcome was not observed is forgotten.
        """
        self._is_new = np.ones(self._world.lead, bool)
        self._is_resetting = np.zeros(self._world.lead, bool)
        self._awaited: tuple[np.ndarray, np.ndarray] | None = None

    def explore(self) -> None:
        """Explores from the next step on; with random actions until it has learned."""
        self._task = None

    def perform(self, reward: Any = (), planner: Planner | None = None) -> None:
        """Performs a task from the next step on.

        With another reward of the same structure nothing is compiled again.

        Args:
          reward: `PlanParams.reward`, any pytree of numbers; floats become float32.
          planner: plans for the task; None for the one that explores.

        Raises:
          TypeError: if planner is none, or reward holds what is no number.
        """
        chosen = self._planner if planner is None else planner
        check_record("planner", chosen, Planner)
        self._task = (chosen, computed.strongly_typed(reward))

    def act(self, obs: Any) -> np.ndarray:
        """Returns the next action, `[A]` or `[N, A]` float32.

        Args:
          obs: `[D]` or `[N, D]`, what is seen now; any floats.

        Raises:
          TypeError, ValueError: if it is not of this shape, or one world's not finite.
        """
        seen = told.numbers(self._world, "obs", obs)
        planner, reward = self._task or (self._planner, self._state.reward)
        if not (self._task or self._counts.trained):
            planner = self._random
        if planner is not self._acting:
            self._is_new = np.ones(self._world.lead, bool)
            self._plan = first_state(planner, self._world.lead, self._places)
        given = Given(np.int32(self._counts.acts % _CALLS), self._is_new, seen)
        params = PlanParams(self._state.params, reward)
        self._acting = None  # if it fails its state may have failed too
        step = self._compiled(planner)
        action, self._plan = step(params, self._act_key, self._plan, given)
        self._acting = planner
        self._is_new = np.zeros(self._world.lead, bool)
        self._awaited = seen, action
        self._counts = self._counts._replace(acts=self._counts.acts + 1)
        return action.copy()

    def observe(
        self,
        next_obs: Any,
        terminated: Any = False,
        truncated: Any = False,
        info: Mapping[str, Any] | None = None,
    ) -> None:
        """Remembers what the last action led to.

        A transition goes from the `obs` that `act` saw to `next_obs`, and never from
        the end of a trial to the start of the next. Where a world has diverged, with a
        number beyond 1e10 or of N worlds one not finite, its transition is left out.

        Args:
          next_obs: `[D]` or `[N, D]`.
          terminated: bool or `[N]`, whether the trial ended there.
          truncated: bool or `[N]`, whether it was cut off there; means the same here.
          info: of the step; read for `final_obs` alone, by autoreset "SameStep".

        Raises:
          RuntimeError: if no action waits for its outcome.
          TypeError, ValueError: if an argument is not of this shape, or of a single
            world and not finite; nothing of this step is kept then.
        """
        if self._awaited is None:
            raise RuntimeError(
                "observe must follow act: there is no action whose outcome this is."
            )
        world = self._world
        done = told.flags(world, "terminated", terminated)
        done = done | told.flags(world, "truncated", truncated)
        reached = told.last_obs(world, next_obs, done, info)
        obs, action = self._awaited
        is_stable = told.are_stable(obs, reached)
        kept = ~self._is_resetting & is_stable
        if kept.any():
            self._seen.append((obs[kept], action[kept], reached[kept]))
        self._counts = self._counts._replace(steps=self.num_steps + int(kept.sum()))
        self._awaited = None
        if world.autoreset == "NextStep":
            # The next step of these worlds leads from an end to a start.
            self._is_new |= self._is_resetting
            self._is_resetting = done & ~self._is_resetting
        else:
            self._is_new |= done
        self._is_new |= ~is_stable

    def learn(self) -> FitMetrics:
        """Trains the model on all that was observed; best called after a trial.

        Returns:
          How it went, as numbers of NumPy.

        Raises:
          RuntimeError: if nothing was observed yet.
        """
        if not self._counts.steps:
            raise RuntimeError("learn needs what was observed, but nothing was yet.")
        self._remember()
        key = jax.random.fold_in(self._learn_key, self._counts.fits % _CALLS)
        learned = self._learn(key, self._state)
        jax.block_until_ready(learned)  # or it failed, and nothing is lost
        self._state, metrics = learned
        self._counts = self._counts._replace(fits=self._counts.fits + 1, trained=1)
        return jax.device_get(metrics)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes all that it has learned and seen to one file, without pickle.

        Not the trial that is going on, nor the functions that it is made of.
        """
        self._remember()
        agent_file.write(path, self._state, self._counts)

    def load(self, path: str | os.PathLike[str]) -> None:
        """Goes on from what `save` wrote, with a new trial.

        An agent that is built as the other was, with its seed, then does what that one
        would have done. A stranger's file is read or refused.

        Raises:
          FileNotFoundError: if there is no such file.
          ValueError: naming what does not fit this agent.
        """
        self._state, self._counts = agent_file.read(path, self._state)
        self._seen.clear()
        self.reset()

    def _compiled(self, planner: Planner) -> Direct | Mailbox:
        if planner not in self._acts:
            step = act_fn(planner, self._steps.action_size, self._world.num_envs)
            self._acts[planner] = compiled(step, self._places)
        return self._acts[planner]

    def _remember(self) -> None:
        """Moves what was seen to the dataset, in blocks of one size for one program."""
        state = self._state
        for rows, count in told.blocks(self._seen, _BLOCK):
            state = self._append(state, rows, count)
        self._state = jax.block_until_ready(state)  # all or, if it fails, nothing
        self._seen.clear()
