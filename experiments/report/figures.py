"""Figures of the report: colour-blind-safe; of curves, seeds thin and the mean bold."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from . import stats, style
from .coverage import Scale

_LOG_RATIO = 1000.0  # a range that a linear axis would hide


class Curve(NamedTuple):
    """One arm over trials; NaN where a seed has no finite number."""

    trials: np.ndarray  # [N]
    values: np.ndarray  # [S, N]


Curves = Mapping[str, Curve]  # by arm


class TaskPanels(NamedTuple):
    """Figure 4's two panels of one task."""

    exploring: Curves  # the task's return while nobody sought it
    tuning: Curves  # zero-shot score at `explored` trials, then fine-tuning
    jump_start: Mapping[str, np.ndarray]  # [S], the zero-shot scores of all seeds


def figure_4(target: Path, panels: Mapping[str, TaskPanels], explored: int) -> None:
    """Draws exploration (left) and the task's reward (right), a row per task."""
    sides = [side for panel in panels.values() for side in panel]
    arms = list(dict.fromkeys(arm for side in sides for arm in side))
    with mpl.rc_context(style.STYLE):
        figure = style.new_figure(9.0, 2.3 * len(panels) + 0.9)
        grid = figure.subplots(
            len(panels), 2, squeeze=False, sharex="col", sharey="row",
            width_ratios=[1.6, 1.0],
        )  # fmt: skip
        for row, (task, panel) in zip(grid, panels.items(), strict=True):
            _draw(row[0], panel.exploring, arms)
            _draw(row[1], panel.tuning, arms)
            for arm, scores in panel.jump_start.items():
                _mark_start(row[1], explored, scores, style.arm_color(arm, arms))
            row[0].set_ylabel(f"{task}\nreturn of a trial")
        grid[0, 0].set_title("exploring")
        grid[0, 1].set_title(f"the task's reward given after {explored} trials")
        for axes in grid[-1]:
            axes.set_xlabel("trial")
        _legend(figure, arms)
        style.save(figure, target)


def zero_shot(
    target: Path,
    scores: Mapping[str, Mapping[str, np.ndarray]],
    reference: Mapping[str, float],
) -> None:
    """Draws every seed's score, the mean and its interval: a panel per task.

    Args:
      target: file to write.
      scores: `[S]` by what is compared, from top to bottom, and task.
      reference: a return by task to compare with, such as the paper's; may be empty.
    """
    tasks = list(dict.fromkeys(task for by_task in scores.values() for task in by_task))
    names = [name.split(",")[0] for name in scores]
    with mpl.rc_context(style.STYLE):
        figure = style.new_figure(9.0, 0.26 * len(scores) + 0.7)
        grid = figure.subplots(1, len(tasks), squeeze=False, sharey=True)[0]
        for axes, task in zip(grid, tasks, strict=True):
            axes.grid(axis="x")
            axes.set_axisbelow(True)
            axes.set_title(task)
            axes.xaxis.set_major_locator(MaxNLocator(4, integer=True))
            if task in reference:
                axes.axvline(reference[task], color=style.VERMILLION, linestyle="--",
                             linewidth=1.0)  # fmt: skip
            for place, (name, by_task) in enumerate(
                zip(names, scores.values(), strict=True)
            ):
                paint = style.arm_color(name, names)
                _spread(axes, place, by_task.get(task, np.array([])), paint)
            axes.set_xlim(left=0)
        grid[0].set_yticks(range(len(scores)), _with_seeds(scores))
        for place in range(1, len(scores), 2):
            for axes in grid:
                axes.axhspan(place - 0.5, place + 0.5, color="#F6F6F6", zorder=0)
        grid[0].invert_yaxis()
        style.save(figure, target)


def _with_seeds(scores: Mapping[str, Mapping[str, np.ndarray]]) -> list[str]:
    """Returns the names with the largest number of seeds that a task has."""
    counts = [max(map(len, by_task.values())) for by_task in scores.values()]
    return [f"{name}  n={n}" for name, n in zip(scores, counts, strict=True)]


def _spread(axes: Any, place: int, scores: np.ndarray, paint: str) -> None:
    """Draws the scores of seeds `[S]` in one row: each small, the mean large."""
    finite = scores[np.isfinite(scores)]
    summary = stats.summarize(finite)
    if summary is None:
        return
    axes.plot(finite, np.full(len(finite), place - 0.22), "o", color=paint,
              markersize=2.5, markeredgewidth=0, alpha=0.5)  # fmt: skip
    if summary.ci95 is not None:
        axes.plot(summary.ci95, [place + 0.12] * 2, color=paint, linewidth=1.8)
    axes.plot(summary.mean, place + 0.12, "o", color=paint, markersize=4.5)


def exploration(target: Path, value: Curves, turns: Curves) -> None:
    """Draws what each arm's plans were worth to it and how often the robot turned.

    Arms value different things, so each has its own axis; turns are shared. What no arm
    has gets no row.
    """
    arms = list(dict.fromkeys([*turns, *value]))
    named = {
        "exploration value\nper imagined step": value,
        "net turns\nin a trial": turns,
    }
    named = {label: curves for label, curves in named.items() if curves}
    with mpl.rc_context(style.STYLE):
        figure = style.new_figure(max(2.6 * len(arms), 5.0), 2.3 * len(named))
        grid = figure.subplots(len(named), len(arms), squeeze=False, sharex=True)
        for row, (label, curves) in zip(grid, named.items(), strict=True):
            row[0].set_ylabel(label)
            for axes, arm in zip(row, arms, strict=True):
                if arm in curves:
                    _draw(axes, {arm: curves[arm]}, arms, running_max=False)
                else:
                    axes.set_yticks([])
                    axes.text(0.5, 0.5, "none", color=style.GREY,
                              transform=axes.transAxes, ha="center")  # fmt: skip
                if curves is value:
                    _log_if_wide(axes, value.get(arm))
                elif axes is not row[0]:
                    axes.sharey(row[0])
        for above, below, arm in zip(grid[0], grid[-1], arms, strict=True):
            above.set_title(arm)
            below.set_xlabel("trial")
        style.save(figure, target)


def coverage(
    target: Path, mean_counts: Mapping[str, np.ndarray],
    first: Scale, second: Scale,
) -> None:  # fmt: skip
    """Draws mean counts `[V, W]`, a panel per arm, all in one scale of colours."""
    seen = np.concatenate([x[x > 0] for x in mean_counts.values()])
    low = float(seen.min())
    # A scale needs two ends, even where all cells were seen equally often.
    norm = LogNorm(low, max(float(seen.max()), 10 * low))
    columns = min(len(mean_counts), 3)
    rows = -(-len(mean_counts) // columns)
    with mpl.rc_context(style.STYLE):
        figure = style.new_figure(2.8 * columns + 1.2, 2.5 * rows + 0.5)
        grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
        for axes in grid.flat[len(mean_counts) :]:
            axes.set_visible(False)
        for axes, (arm, counts) in zip(grid.flat, mean_counts.items(), strict=False):
            axes.set_title(arm)
            mesh = axes.pcolormesh(
                first.edges, second.edges,
                np.where(counts > 0, counts, np.nan).T, norm=norm, cmap="cividis",
            )  # fmt: skip
            axes.tick_params(labelbottom=True)  # also above a place without a panel
        for scale, write in ((first, figure.supxlabel), (second, figure.supylabel)):
            write(f"{scale.name.replace('_', ' ')}, {scale.unit}", fontsize=9)
        figure.colorbar(mesh, ax=grid, label="transitions of a seed, mean")
        style.save(figure, target)


def _draw(
    axes: Any, curves: Curves, arms: Sequence[str], *, running_max: bool = True
) -> None:  # fmt: skip
    axes.grid(axis="y")
    axes.set_axisbelow(True)
    axes.xaxis.set_major_locator(MaxNLocator("auto", integer=True))
    axes.axhline(0.0, color="#BFBFBF", linewidth=0.8, zorder=1)
    for arm, (trials, values) in curves.items():
        paint = style.arm_color(arm, arms)
        # A mean over fewer seeds would jump where one of them ends.
        mean = values.mean(axis=0)
        if len(values) > 1:
            axes.plot(trials, values.T, color=paint, linewidth=0.6, alpha=0.45)
        single = len(trials) < 3 or _isolated(mean)
        axes.plot(
            trials, mean, color=paint, linewidth=2.0, zorder=3,
            marker="o" if single else None, markersize=3.5,
        )  # fmt: skip
        if running_max:
            best = np.fmax.accumulate(values, axis=1).mean(axis=0)
            axes.plot(trials, best, color=paint, linewidth=1.0, linestyle=":")


def _isolated(mean: np.ndarray) -> bool:
    """Says whether a number has no finite neighbour to draw a line to."""
    finite = np.isfinite(mean)
    near = np.r_[False, finite[:-1]] | np.r_[finite[1:], False]
    return bool((finite & ~near).any())


def _mark_start(axes: Any, trial: int, scores: np.ndarray, paint: str) -> None:
    """Marks the jump-start: each seed small, the mean large."""
    finite = scores[np.isfinite(scores)]
    if len(finite) > 1:
        axes.plot(
            np.full(len(finite), trial), finite, "o", color=paint, markersize=3,
            alpha=0.5, linewidth=0,
        )  # fmt: skip
    if len(finite):
        axes.plot(
            trial, finite.mean(), "o", color=paint, markeredgecolor="white",
            markersize=7, zorder=4,
        )  # fmt: skip


def _log_if_wide(axes: Any, curve: Curve | None) -> None:
    if curve is None:
        return
    finite = curve.values[np.isfinite(curve.values) & (curve.values != 0)]
    if len(finite) and finite.min() > 0 and finite.max() / finite.min() > _LOG_RATIO:
        axes.set_yscale("log")


def _legend(figure: Figure, arms: Sequence[str]) -> None:
    lines = [
        Line2D([], [], color=style.arm_color(arm, arms), linewidth=2.0) for arm in arms
    ]
    lines.append(Line2D([], [], color="#404040", linewidth=0.6, alpha=0.6))
    lines.append(Line2D([], [], color="#404040", linewidth=1.0, linestyle=":"))
    labels = [*arms, "one seed", "best so far"]
    figure.legend(lines, labels, loc="outside upper center", ncols=min(len(lines), 8))
