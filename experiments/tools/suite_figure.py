"""The figure of the suite's twenty tasks: our arms' seeds, and others' numbers."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.lines import Line2D

from ..report import style, tables

# Of which system, after the fewest (0) or the most (-1) of its steps, and how drawn.
_OTHERS: tuple[tuple[str, int, dict[str, Any]], ...] = (
    ("Plan2Explore, zero-shot", 0, {"color": style.VERMILLION, "fillstyle": "none"}),
    ("Plan2Explore, zero-shot", -1, {"color": style.VERMILLION}),
    ("TD-MPC2", 0, {"color": style.GREEN}),
)

_MARK = {"Plan2Explore, zero-shot": "s", "TD-MPC2": "D"}


def draw(
    target: Path,
    found: Mapping[str, Mapping[str, Mapping[str, Any]]],
    others: Mapping[str, Mapping[str, Sequence[float]]],
    labels: Mapping[tuple[str, int], str],
    groups: Mapping[str, Sequence[str]],
) -> None:
    """Draws a panel per group of tasks, a row per task: means, and seeds small.

    Args:
      target: file to write.
      found: our numbers by arm and task.
      others: returns by system and task, one for each of the system's steps.
      labels: of a system after its fewest (0) or most (-1) steps.
      groups: the tasks of each panel, by its title.
    """
    arms = tables.in_order(found)
    shown = [other for other in _OTHERS if other[0] in others]
    with mpl.rc_context(style.STYLE):
        figure: Any = style.new_figure(10.0, 4.6)
        panels = figure.subplots(1, len(groups), squeeze=False, sharex=True)[0]
        for axes, (title, tasks) in zip(panels, groups.items(), strict=True):
            axes.set_title(title)
            axes.set_yticks(range(len(tasks)), tasks)
            axes.set_ylim(len(tasks) - 0.5, -0.5)
            axes.set_xlim(-20, 1020)
            axes.grid(axis="x")
            axes.set_axisbelow(True)
            for place, task in enumerate(tasks):
                if place % 2:
                    axes.axhspan(place - 0.5, place + 0.5, color="#F6F6F6", zorder=0)
                _seeds(axes, place, {arm: found[arm].get(task) for arm in arms})
                for name, i, look in shown:
                    axes.plot(others[name][task][i], place, _MARK[name], **look)
            axes.set_xlabel("return of a trial")
        ours = [
            Line2D([], [], marker="o", linestyle="", label=arm,
                   color=style.arm_color(arm, arms))
            for arm in arms
        ]  # fmt: skip
        theirs = [
            Line2D([], [], marker=_MARK[name], linestyle="", label=labels[name, i],
                   **look)
            for name, i, look in shown
        ]  # fmt: skip
        for handles, where in ((ours, "upper left"), (theirs, "lower right")):
            columns = len(handles)
            figure.legend(handles=handles, loc=f"outside {where}", ncols=columns)
        style.save(figure, target)


def _seeds(
    axes: Any, place: int, found: Mapping[str, Mapping[str, Any] | None]
) -> None:
    """Draws each arm at a height of its own within a task's row."""
    heights = place + np.linspace(-0.3, 0.3, len(found) + 2)[1:-1]
    for height, (arm, numbers) in zip(heights, found.items(), strict=True):
        if numbers is None or numbers["mean"] is None:
            continue
        paint = style.arm_color(arm, list(found))
        seeds = [x for x in numbers["seeds"].values() if x is not None]
        axes.plot(seeds, [height] * len(seeds), "|", color=paint, alpha=0.5)
        axes.plot([numbers["mean"]], [height], "o", color=paint, markersize=5)
