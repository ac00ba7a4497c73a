"""What a visitor asks for, as data: a change of it acts on the next plan.

One compiled program plans for all of it: the robot's own tasks, typed formulas, and the
disagreement that exploration seeks.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxpets
from jaxpets import formulas, rewards
from jaxpets.envs import Robot, with_constants

TASK, FORMULA, EXPLORE = 0, 1, 2

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


class Wish(NamedTuple):
    """The data of `reward`.

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


class Slider(NamedTuple):
    """A quantity that is wanted; `weight` is that of a deviation from it by one."""

    word: str
    unit: str
    low: float
    high: float
    step: float
    weight: float


class Language(NamedTuple):
    """What can be said of a robot.

    Attributes:
      words: as `formulas.parse` takes them.
      tasks: the text of each task, empty where none says it.
      sliders: quantities.
      action_size: A.
    """

    words: Mapping[str, int]
    tasks: Mapping[str, str]
    sliders: tuple[Slider, ...]
    action_size: int


def reward_of(robot: Robot) -> jaxpets.typing.RewardFn:
    """Returns the reward that plans are made for; its params are a Wish."""

    def reward(wish: Wish, obs: Array, action: Array, next_obs: Array) -> Array:
        step, shape = (obs, action, next_obs), next_obs.shape[:-1]

        def task() -> Array:
            return jnp.broadcast_to(robot.tasks.reward_fn(wish.task, *step), shape)

        def formula() -> Array:
            return formulas.reward(wish.formula, *step)

        def explore() -> Array:
            return jnp.broadcast_to(rewards.epistemic(wish.base, *step), shape)

        return jax.lax.switch(wish.kind, (task, formula, explore))

    return reward


def earned_of(robot: Robot) -> jaxpets.typing.RewardFn:
    """Returns what a real step `[D]` earns; NaN where disagreement is sought."""

    def earned(wish: Wish, obs: Array, action: Array, next_obs: Array) -> Array:
        step = (obs, action, next_obs)
        branches = (
            lambda: jnp.asarray(robot.tasks.reward_fn(wish.task, *step)),
            lambda: formulas.reward(wish.formula, *step),
            lambda: jnp.full((), jnp.nan, jnp.float32),
        )
        return jax.lax.switch(wish.kind, branches)

    return earned


def bound(wish: Wish, constants: Any) -> Wish:
    """Returns a wish for one trial, whose constants a task may read."""
    return wish._replace(task=with_constants(wish.task, constants))


def first(robot: Robot, params: jaxpets.EnsembleParams) -> Wish:
    """Returns the wish for the first task of a robot."""
    nothing = formulas.parse("0", {})
    base = rewards.max_variance(params)
    nobody = Wish(jnp.int32(TASK), (), nothing, base)
    return for_task(nobody, robot, robot.tasks.names[0])


def for_task(wish: Wish, robot: Robot, name: str) -> Wish:
    """Returns the wish for a task of the robot."""
    place = robot.tasks.names.index(name)
    task = jax.tree.map(lambda x: x[place], robot.tasks.params)
    return wish._replace(kind=jnp.int32(TASK), task=task)


def for_text(wish: Wish, language: Language, text: str) -> Wish:
    """Returns the wish for a typed reward.

    Raises:
      formulas.FormulaError: if it is none; it says why and where.
    """
    formula = formulas.parse(text, language.words, language.action_size)
    return wish._replace(kind=jnp.int32(FORMULA), formula=formula)


def to_explore(wish: Wish) -> Wish:
    """Returns the wish for what the ensemble disagrees about."""
    return wish._replace(kind=jnp.int32(EXPLORE))


def language_of(robot: Robot, params: jaxpets.EnsembleParams) -> Language:
    """Returns the words for a robot, and sliders over what its model has seen."""
    rows = robot.env.coordinates
    aliases = {axis.name: axis.entry for axis in robot.axes}
    places = {row.name: place for place, row in enumerate(rows)}
    heights = [places[name] for name in _HEIGHTS if name in places]
    if heights and "height" not in aliases:
        aliases["height"] = heights[0]
    words = formulas.names(rows, aliases)
    units = {axis.name: axis.unit for axis in robot.axes}
    low, high = np.asarray(params.scaler.low), np.asarray(params.scaler.high)
    sliders: list[Slider] = []
    for name, place in aliases.items():
        ends = (float(low[place]), float(high[place]))
        own = [axis.edges for axis in robot.axes if axis.name == name]
        if own:  # what is worth showing; a model may have seen more in a fall
            ends = (max(ends[0], own[0][0]), min(ends[1], own[0][-1]))
        found = _slider(_word(words, name, place), units.get(name, "m"), *ends)
        sliders += [found] if found else []
    heaviest = sliders[0].weight if sliders else 1.0
    sliders = [x._replace(weight=_rounded(x.weight / heaviest)) for x in sliders]
    texts = _TEXTS.get(robot.name, {})
    tasks = {name: texts.get(name, "") for name in robot.tasks.names}
    return Language(words, tasks, tuple(sliders), len(robot.env.action_low))


def said_by_sliders(
    sliders: tuple[Slider, ...], values: tuple[float, ...], effort: float
) -> str:
    """Returns the formula of what sliders ask for: to be as near to it as can be."""
    terms: list[str] = []
    for slider, value in zip(sliders, values, strict=True):
        weight = "" if slider.weight == 1 else f"{slider.weight:g} * "
        sign = "-" if value >= 0 else "+"
        gap = f"{slider.word} {sign} {abs(value):g}" if value else slider.word
        terms.append(f"{weight}abs({gap})")
    if effort or not terms:
        terms.append(f"{effort:g} * effort")
    return "-" + " - ".join(terms)


def _slider(word: str, unit: str, low: float, high: float) -> Slider | None:
    """Returns a slider between numbers with few digits; None if there is no room."""
    width = high - low
    if not np.isfinite(width) or width <= 0:
        return None
    step = _rounded(width / _STEPS)
    ends = (step * np.floor(low / step), step * np.ceil(high / step))
    low, high = (round(float(end), 6) for end in ends)
    return Slider(word, unit, low, high, step, weight=1 / width)


def _word(words: Mapping[str, int], name: str, place: int) -> str:
    """Returns the word that `formulas.names` gave to an alias."""
    own = [word for word, at in words.items() if at == place and word.startswith(name)]
    return own[-1]


def _rounded(value: float) -> float:
    """Returns the nearest of ..., 0.1, 0.2, 0.5, 1, 2, 5, ..."""
    scale = 10.0 ** np.floor(np.log10(value))
    nearest = min((1, 2, 5, 10), key=lambda digit: abs(np.log(digit * scale / value)))
    return float(f"{nearest * scale:.0e}")
