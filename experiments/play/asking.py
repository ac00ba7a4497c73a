"""What is asked of the robot, by buttons, sliders or a line of text."""

from typing import Any, NamedTuple

from jaxpets import formulas
from jaxpets.envs import Robot

from . import wishes
from .wishes import Language, Wish

EXPLORE = "explore"


class Asked(NamedTuple):
    """A wish, and what the page says of it.

    Attributes:
      wish: in force; None where nothing may be asked for.
      name: of the task, "explore", or "" of what was typed.
      line: of text, as it stands on the page.
      problem: why the line is no reward; the wish is then an older one. "" if it is.
      column: where in the line, from 0.
    """

    wish: Any
    name: str
    line: str
    problem: str = ""
    column: int = 0

    @property
    def words(self) -> str:
        """What is wanted, in words."""
        return self.name or self.line


NOTHING = Asked(None, "", "")
"""Where nothing may be asked for."""


def at_first(robot: Robot, language: Language, wish: Wish) -> Asked:
    """Returns what is asked for before anybody has said anything: the first task."""
    return by_name(Asked(wish, "", ""), robot, language, robot.tasks.names[0])


def by_name(asked: Asked, robot: Robot, language: Language, name: str) -> Asked:
    """Returns what a button asks for: a task, or to explore; else what was asked."""
    if name == EXPLORE:
        return Asked(wishes.to_explore(asked.wish), name, "")
    if name not in robot.tasks.names:
        return asked
    return Asked(wishes.for_task(asked.wish, robot, name), name, language.tasks[name])


def by_text(asked: Asked, language: Language, text: str) -> Asked:
    """Returns what a typed line asks for; if it is no reward, what was, and why."""
    try:
        wish = wishes.for_text(asked.wish, language, text)
    except formulas.FormulaError as error:
        return asked._replace(line=text, problem=error.message, column=error.column)
    return Asked(wish, "", text)


def by_sliders(
    asked: Asked, language: Language, values: tuple[float, ...], effort: float
) -> Asked:
    """Returns what the sliders ask for, which then stands in the line."""
    text = wishes.said_by_sliders(language.sliders, values, effort)
    return by_text(asked, language, text)
