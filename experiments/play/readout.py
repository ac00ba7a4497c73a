"""What the page says in words and curves: how fast, how far, what was promised."""

import html
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxpets.envs import Robot

from .command import TO_EXPLORE, Command
from .session import Frame

_ON_TIME = 0.97  # of real time; less is said


class Curves(NamedTuple):
    """What was promised and what came of it, over the last seconds, `[T]` each.

    Attributes:
      seconds: before the last frame, negative.
      promised: the return per step that was foreseen H steps before.
      earned: the return per step since then; NaN where nothing says it, or where
        something else was asked for on the way.
    """

    seconds: np.ndarray
    promised: np.ndarray
    earned: np.ndarray


def curves(frames: Sequence[Frame], horizon: int, step_time: float) -> Curves:
    """Returns the curves over frames, oldest first."""
    seconds = step_time * np.arange(1 - len(frames), 1)
    foreseen = np.array([frame.promised for frame in frames], float)
    rewards = np.array([frame.earned for frame in frames], float)
    promised, earned = np.full((2, len(frames)), np.nan)
    ends = [i for i in range(1, len(frames)) if not _follows(frames[i - 1], frames[i])]
    begins = np.zeros(len(frames), int)  # of the stretch without a change
    for end in ends:
        begins[end:] = end
    for i in range(horizon, len(frames)):
        if begins[i] <= i - horizon:
            promised[i] = foreseen[i - horizon + 1]
            earned[i] = rewards[i - horizon + 1 : i + 1].mean()
    return Curves(seconds, promised, earned)


def _follows(before: Frame, after: Frame) -> bool:
    is_planned = np.isnan(before.promised) == np.isnan(after.promised)
    is_next = after.number == before.number + 1
    return bool(is_next and after.wanted == before.wanted and is_planned)


def status(
    rate: float, pace: float, speed: float, is_paused: bool, back: float, notice: str
) -> str:
    """Returns how fast time goes, as HTML."""
    if back > 0:
        text = f"{back:.1f} s ago"
    elif is_paused:
        text = "paused"
    elif rate and pace < _ON_TIME * speed:
        text = (
            f"This machine plans {rate:.1f} steps a second, so time runs at "
            f"{pace:.2f} of its speed"
        )
    else:
        kind = "real time" if speed == 1 else f"{speed:g} of real time"
        text = f"{rate:.1f} steps a second, {kind}"
    return small(html.escape(". ".join(filter(None, (text, notice)))))


def readings(robot: Robot, frame: Frame) -> str:
    """Returns what the robot does now, as HTML."""
    parts = [
        f"{axis.name.replace('_', ' ')} <b>{frame.obs[axis.entry]:.1f}</b> {axis.unit}"
        for axis in robot.axes
    ]
    if robot.angle is not None:
        parts.append(f"turns <b>{frame.obs[robot.angle] / (2 * np.pi):.1f}</b>")
    return small(" &nbsp; ".join(parts))


def under_line(command: Command) -> str:
    """Returns what stands under the line of text, as HTML: all of it is escaped."""
    if command.problem:
        where = command.line[: command.column] + "▸" + command.line[command.column :]
        text = (
            f"{html.escape(command.problem)}<br><code>{html.escape(where[:200])}</code>"
        )
        return small(text, "#c92a2a")
    if command.is_for_policy:
        text = f"It performs {html.escape(command.name)} by its policy, without a plan."
    elif command.name == TO_EXPLORE:
        text = "It seeks what its networks disagree about."
    elif command.name and not command.line:
        text = f"It performs {html.escape(command.name)}, a reward of the robot's own."
    elif command.name:
        text = f"It performs {html.escape(command.name)}."
    else:
        text = "It does what the line says."
    return small(text)


def disagreement(frame: Frame) -> str:
    """Returns how much the members disagree, as HTML."""
    if np.isnan(frame.disagreement):
        return small("no plan, and so no disagreement about one")
    text = f"disagreement <b>{frame.disagreement:.2f}</b> of the model's own noise"
    return small(text)


def returns(found: Curves) -> str:
    """Returns what was promised for the last steps, and what came, as HTML."""
    promised, earned = (
        "..." if np.isnan(x[-1]) else f"{x[-1]:.2f}"
        for x in (found.promised, found.earned)
    )
    return small(f"promised <b>{promised}</b>, earned <b>{earned}</b>")


def small(text: str, color: str = "inherit") -> str:
    """Returns a paragraph of HTML, of text that is HTML already."""
    style = f"font-size:0.85em;line-height:1.4;padding:0 0.75em 0.5em;color:{color}"
    return f'<div style="{style};overflow-wrap:anywhere">{text}</div>'
