"""What is asked of the robot, by buttons, sliders or a line of text; and as data.

One compiled program plans for the robot's own tasks, for typed formulas, and for the
disagreement that exploration seeks: a change acts on the next plan.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxpets
from jaxpets import formulas, rewards
from jaxpets.envs import Robot, with_constants

TASK, FORMULA, EXPLORE = 0, 1, 2
TO_EXPLORE = "explore"
PLAN, POLICY = "plan", "policy"

# What the tasks of a robot say in words, where they can be said so.
_TEXTS: Mapping[str, Mapping[str, str]] = {
    "pets/half_cheetah": {
        "forward": "velocity - 0.1 * effort",
        "backward": "-velocity - 0.1 * effort",
        "front-flip": "pitch_rate - 0.1 * effort",
        "back-flip": "-pitch_rate - 0.1 * effort",
    }
}
# Entries that people know as the height of a robot, the best first.
_HEIGHTS = ("xipos/torso.z", "qpos/rootz", "qpos/root.z", "qpos/torso.z")
_STEPS = 40  # of a slider


class RewardChoice(NamedTuple):
    """The params of `reward_of`.

    Attributes:
      kind: `[]` int32, TASK, FORMULA or EXPLORE.
      task: a row of the robot's `Tasks.params`; with the constants of the trial, where
        it has any.
      formula: a `jaxpets.formulas.Formula`.
      base: `[D]`, the variance that disagreement is measured in.
    """

    kind: Array
    task: Any
    formula: formulas.Formula
    base: Array


def reward_of(
    robot: Robot, explore: jaxpets.typing.RewardFn = rewards.epistemic
) -> jaxpets.typing.RewardFn:
    """Returns the reward that plans are made for; its params are a RewardChoice.

    Args:
      robot: whose tasks may be chosen.
      explore: what exploration seeks; its params are `RewardChoice.base`.
    """

    def reward(
        choice: RewardChoice, obs: Array, action: Array, next_obs: Array
    ) -> Array:
        step, shape = (obs, action, next_obs), next_obs.shape[:-1]
        branches = (
            lambda: robot.tasks.reward_fn(choice.task, *step),
            lambda: formulas.reward(choice.formula, *step),
            lambda: explore(choice.base, *step),
        )
        spread = [lambda f=f: jnp.broadcast_to(f(), shape) for f in branches]
        return jax.lax.switch(choice.kind, spread)

    return reward


def earned_of(robot: Robot) -> jaxpets.typing.RewardFn:
    """Returns what a real step `[D]` earns; NaN where disagreement is sought."""
    return reward_of(robot, lambda *_: jnp.float32(jnp.nan))


def bound(choice: RewardChoice, constants: Any) -> RewardChoice:
    """Returns a choice for one trial, whose constants a task may read."""
    return choice._replace(task=with_constants(choice.task, constants))


class Slider(NamedTuple):
    """A quantity that is wanted; `weight` is that of a deviation from it by one."""

    word: str
    unit: str
    low: float
    high: float
    step: float
    weight: float


class Command(NamedTuple):
    """A reward, and what the page says of it.

    Attributes:
      reward: a RewardChoice, in force; None where nothing may be asked for.
      name: of the task, "explore", or "" of what was typed.
      line: of text, as it stands on the page.
      problem: why the line is no reward; the one in force is then an older one. "" if
        it is.
      column: where in the line, from 0.
      acts: who does, PLAN or POLICY.
    """

    reward: Any
    name: str
    line: str
    problem: str = ""
    column: int = 0
    acts: str = PLAN

    @property
    def label(self) -> str:
        """What is wanted, in words."""
        return self.name or self.line

    @property
    def is_for_policy(self) -> bool:
        """Whether a policy shall act, and is asked for what it can know: a task."""
        return self.acts == POLICY and self.name not in ("", TO_EXPLORE)

    def asks(self, reward: RewardChoice, name: str, line: str) -> "Command":
        """Returns the command with something else that is wanted."""
        return Command(reward, name, line, acts=self.acts)


NOTHING = Command(None, "", "")
"""Where nothing may be asked for."""


class Commands:
    """What can be asked of a robot.

    Attributes:
      words: that a formula may have, as `formulas.parse` takes them.
      tasks: the text of each task, empty where none says it.
      sliders: over what the model has seen.
      action_size: A.
      first: the command before anybody has said anything, the first task.
    """

    def __init__(self, robot: Robot, params: jaxpets.EnsembleParams) -> None:
        aliases = _aliases(robot)
        self._robot = robot
        self.words = formulas.names(robot.env.coordinates, aliases)
        texts = _TEXTS.get(robot.name, {})
        self.tasks = {name: texts.get(name, "") for name in robot.tasks.names}
        self.sliders = _sliders(robot, params, aliases, self.words)
        self.action_size = len(robot.env.action_low)
        base = rewards.max_variance(params)
        nothing = RewardChoice(jnp.int32(TASK), (), formulas.parse("0", {}), base)
        first = robot.tasks.names[0]
        self.first = self.by_name(Command(nothing, "", ""), first)

    def by_name(self, command: Command, name: str) -> Command:
        """Returns what a button asks for: a task, or to explore; else what was."""
        if name == TO_EXPLORE:
            choice = command.reward._replace(kind=jnp.int32(EXPLORE))
            return command.asks(choice, name, "")
        if name not in self.tasks:
            return command
        place = self._robot.tasks.names.index(name)
        task = jax.tree.map(lambda x: x[place], self._robot.tasks.params)
        choice = command.reward._replace(kind=jnp.int32(TASK), task=task)
        return command.asks(choice, name, self.tasks[name])

    def by_text(self, command: Command, text: str) -> Command:
        """Returns what a line asks for; if it is no reward, what was, and why."""
        try:
            formula = formulas.parse(text, self.words, self.action_size)
        except formulas.FormulaError as error:
            problem = {"problem": error.message, "column": error.column}
            return command._replace(line=text, **problem)
        choice = command.reward._replace(kind=jnp.int32(FORMULA), formula=formula)
        return command.asks(choice, "", text)

    def by_sliders(
        self, command: Command, values: Sequence[float], effort: float
    ) -> Command:
        """Returns what sliders ask for, which then stands in the line.

        Args:
          command: before it.
          values: one for each slider; as near to them as can be is wanted.
          effort: what a unit of it costs.
        """
        terms: list[str] = []
        for slider, value in zip(self.sliders, values, strict=True):
            target = min(max(value, slider.low), slider.high)
            weight = "" if slider.weight == 1 else f"{slider.weight:g} * "
            sign = "-" if target >= 0 else "+"
            gap = f"{slider.word} {sign} {abs(target):g}" if target else slider.word
            terms.append(f"{weight}abs({gap})")
        if effort or not terms:
            terms.append(f"{effort:g} * effort")
        return self.by_text(command, "-" + " - ".join(terms))


def _aliases(robot: Robot) -> dict[str, int]:
    """Returns the words that people use for entries."""
    found = {axis.name: axis.entry for axis in robot.axes}
    places = {row.name: i for i, row in enumerate(robot.env.coordinates)}
    heights = [places[name] for name in _HEIGHTS if name in places]
    if heights:
        found.setdefault("height", heights[0])
    return found


def _sliders(
    robot: Robot,
    params: jaxpets.EnsembleParams,
    aliases: Mapping[str, int],
    words: Mapping[str, int],
) -> tuple[Slider, ...]:
    axes = {axis.name: axis for axis in robot.axes}
    low, high = np.asarray(params.scaler.low), np.asarray(params.scaler.high)
    found: list[Slider] = []
    for name, place in aliases.items():
        ends, unit = (float(low[place]), float(high[place])), "m"
        if name in axes:  # what is worth showing; a model may have seen more in a fall
            edges, unit = axes[name].edges, axes[name].unit
            ends = (max(ends[0], edges[0]), min(ends[1], edges[-1]))
        word = [word for word, at in words.items() if at == place][-1]  # aliases last
        slider = _slider(word, unit, *ends)
        found += [slider] if slider else []
    heaviest = found[0].weight if found else 1.0
    return tuple(x._replace(weight=_rounded(x.weight / heaviest)) for x in found)


def _slider(word: str, unit: str, low: float, high: float) -> Slider | None:
    """Returns a slider between numbers with few digits; None if there is no room."""
    width = high - low
    if not np.isfinite(width) or width <= 0:
        return None
    step = _rounded(width / _STEPS)
    ends = (step * np.floor(low / step), step * np.ceil(high / step))
    low, high = (round(float(end), 6) for end in ends)
    return Slider(word, unit, low, high, step, weight=1 / width)


def _rounded(value: float) -> float:
    """Returns the nearest of ..., 0.1, 0.2, 0.5, 1, 2, 5, ..."""
    scale = 10.0 ** np.floor(np.log10(value))
    nearest = min((1, 2, 5, 10), key=lambda digit: abs(np.log(digit * scale / value)))
    return float(f"{nearest * scale:.0e}")
