"""Draws the method: explore where the members disagree, then perform any task.

    python -m experiments.report.method_figure results/method.svg

The robot is the half cheetah of gymnasium's XML as lines; the paths are drawn by hand.
"""

import argparse
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from . import style

_INK = "#333333"
_PAPER = "#F7F7F7"
_MEMBERS = (style.BLUE, style.SKY, style.GREEN, style.ORANGE, style.PURPLE)

# Metres from the middle of the torso: where a limb starts, and its parts in turn.
_TORSO = np.array([[-0.5, 0.0], [0.5, 0.0], [0.72, 0.2]])
_BACK = np.array([[-0.5, 0.0], [0.16, -0.25], [-0.28, -0.14], [0.1, -0.17]])
_FRONT = np.array([[0.5, 0.0], [-0.14, -0.24], [0.13, -0.18], [0.1, -0.12]])


def draw() -> Figure:
    """Returns the figure."""
    with mpl.rc_context(style.STYLE):
        figure = style.new_figure(9.0, 4.3)
        figure.set_layout_engine("none")
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_xlim(0, 18)
        axes.set_ylim(0, 8.6)
        axes.axis("off")
        _explore(axes)
        _perform(axes)
    return figure


def _explore(axes: Axes) -> None:
    """Draws the loop of phase 1."""
    _box(axes, 0.2, 0.2, 10.4, 8.2)
    _heading(axes, 0.5, 7.85, "1  Explore", "no reward is given")

    _cheetah(axes, 2.3, 2.33, 1.5, pitch=0.2, back=(0.5, -0.3), front=(-0.5, 0.5))
    axes.plot([0.8, 3.9], [1.42, 1.42], color=_INK, linewidth=1.0)
    _caption(axes, 2.3, 0.95, "Act", "one trial of the robot")

    for i, paint in enumerate(reversed(_MEMBERS)):
        x, y = 8.2 - 0.17 * i, 2.75 - 0.17 * i
        _card(axes, x, y, paint, network=i + 1 == len(_MEMBERS))
    _caption(axes, 7.85, 0.95, "Learn", "an ensemble, from all trials")

    _fan(axes, 3.2, 5.55, 3.3)
    _caption(axes, 5.3, 4.45, "Plan", "to where its members disagree")

    _arrow(axes, (4.2, 2.2), (6.2, 2.2), "transitions", (5.2, 2.35))
    _arrow(axes, (8.6, 3.95), (7.6, 4.95), "model", (8.9, 4.4), bend=0.3)
    _arrow(axes, (3.0, 4.95), (2.0, 3.6), "actions", (1.75, 4.4), bend=0.3)


def _perform(axes: Axes) -> None:
    """Draws phase 2: the model that was learned, with a reward per task."""
    _box(axes, 11.4, 0.2, 6.4, 8.2)
    _heading(axes, 11.7, 7.85, "2  Perform", "nothing is learned")
    _arrow(axes, (10.05, 2.45), (11.35, 2.45), "", (0, 0), width=2.4)
    axes.text(
        10.68, 2.75, "one\nmodel", ha="center", va="bottom", color=_INK, fontsize=8,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 1},
    )  # fmt: skip
    tasks = [
        ("run forward", r"$v - 0.1\,|a|^2$", 0.12, "right"),
        ("run backward", r"$-v - 0.1\,|a|^2$", -0.12, "left"),
        ("front flip", r"$\omega - 0.1\,|a|^2$", -0.8, "front"),
        ("back flip", r"$-\omega - 0.1\,|a|^2$", 0.65, "back"),
    ]
    for i, (name, reward, pitch, way) in enumerate(tasks):
        y = 6.55 - 1.42 * i
        _cheetah(axes, 12.95, y, 0.95, pitch=pitch, back=(0.5, -0.4), front=(-0.6, 0.3))
        _motion(axes, 12.95, y, way)
        axes.text(14.6, y + 0.12, name, color=_INK, fontsize=9, fontweight="bold",
                  va="bottom")  # fmt: skip
        axes.text(14.6, y, f"reward {reward}", color=_INK, fontsize=8, va="top")
    _caption(axes, 14.6, 0.95, "Plan", "for any reward, at the first attempt")


def _box(axes: Axes, x: float, y: float, width: float, height: float) -> None:
    axes.add_patch(
        FancyBboxPatch(
            (x, y), width, height, boxstyle="round,pad=0,rounding_size=0.25",
            facecolor=_PAPER, edgecolor="#D0D0D0", linewidth=0.8, zorder=0,
        )
    )  # fmt: skip


def _heading(axes: Axes, x: float, y: float, title: str, rest: str) -> None:
    text = axes.text(
        x, y, title, color=_INK, fontsize=12, fontweight="bold", va="center"
    )
    axes.annotate(f"   {rest}", (1, 0.5), xycoords=text, color=_INK, fontsize=10,
                  va="center")  # fmt: skip


def _caption(axes: Axes, x: float, y: float, title: str, rest: str) -> None:
    axes.text(x, y, title, color=_INK, fontsize=10, fontweight="bold", ha="center",
              va="center")  # fmt: skip
    axes.text(x, y - 0.4, rest, color=_INK, fontsize=8.5, ha="center", va="center")


def _arrow(
    axes: Axes, start: tuple[float, float], end: tuple[float, float], label: str,
    at: tuple[float, float], *, bend: float = 0.0, width: float = 1.6,
) -> None:  # fmt: skip
    axes.add_patch(
        FancyArrowPatch(
            start, end, connectionstyle=f"arc3,rad={bend}", color=_INK, linewidth=width,
            arrowstyle="-|>", mutation_scale=12, shrinkA=0, shrinkB=0,
        )
    )  # fmt: skip
    axes.text(*at, label, color=_INK, fontsize=8.5, ha="center", va="bottom")


def _cheetah(
    axes: Axes, x: float, y: float, size: float, *, pitch: float,
    back: tuple[float, float], front: tuple[float, float],
) -> None:  # fmt: skip
    """Draws the robot around its torso; limbs turn at hip and knee, in radians."""
    for parts, angles in ((_BACK, back), (_FRONT, front)):
        path = _turned(_limb(parts, angles), pitch) * size + [x, y]
        axes.plot(*path.T, color="#8A8A8A", linewidth=3.2 * size, zorder=3,
                  solid_capstyle="round", solid_joinstyle="round")  # fmt: skip
    torso = _turned(_TORSO, pitch) * size + [x, y]
    axes.plot(*torso.T, color=_INK, linewidth=5.0 * size, zorder=3,
              solid_capstyle="round", solid_joinstyle="round")  # fmt: skip


def _limb(parts: np.ndarray, angles: tuple[float, float]) -> np.ndarray:
    """Returns the joints of a limb, `[4, 2]`."""
    hip, knee = angles
    steps = [parts[0], *(_turned(part[None], hip)[0] for part in parts[1:2])]
    steps += [_turned(part[None], hip + knee)[0] for part in parts[2:]]
    return np.cumsum(steps, axis=0)


def _turned(points: np.ndarray, angle: float) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    return points @ np.array([[cos, sin], [-sin, cos]])


def _card(axes: Axes, x: float, y: float, paint: str, *, network: bool) -> None:
    """Draws a member of the ensemble as a card; the front one shows its layers."""
    axes.add_patch(
        FancyBboxPatch(
            (x - 1.0, y - 0.75), 2.0, 1.5, boxstyle="round,pad=0,rounding_size=0.15",
            facecolor="white", edgecolor=paint, linewidth=1.6, zorder=2,
        )
    )  # fmt: skip
    if not network:
        return
    layers = [
        [(x + 0.6 * column, y + 0.38 * (row - (rows - 1) / 2)) for row in range(rows)]
        for column, rows in ((-1, 3), (0, 4), (1, 3))
    ]
    for left, right in itertools.pairwise(layers):
        for ends in itertools.product(left, right):
            axes.plot(*np.array(ends).T, color=paint, linewidth=0.5, alpha=0.6)
    for layer in layers:
        axes.plot(*np.array(layer).T, "o", color=paint, markersize=4, zorder=3)


def _fan(axes: Axes, x: float, y: float, width: float) -> None:
    """Draws what the members imagine of two plans: they agree on one only."""
    time = np.linspace(0.0, 1.0, 40)
    for i, paint in enumerate(_MEMBERS):
        wave = 0.06 * (np.sin(9 * time + i) - np.sin(i))
        known = 0.55 * np.sin(1.6 * time) - 0.75 * time + 0.05 * (i - 2) * time
        new = 1.25 * time**1.3 + 0.38 * (i - 2) * time**2 + wave
        for path in (known, new):
            axes.plot(x + width * time, y + path, color=paint, linewidth=1.4)
    axes.plot(x, y, "o", color=_INK, markersize=5, zorder=4)
    for rise, text, weight in (
        (1.25, "unknown: chosen", "bold"),
        (-0.2, "known", "normal"),
    ):
        axes.text(x + width + 0.15, y + rise, text, color=_INK, fontsize=8.5,
                  va="center", fontweight=weight)  # fmt: skip


def _motion(axes: Axes, x: float, y: float, way: str) -> None:
    """Draws which way the robot moves."""
    look: Any = {"arrowstyle": "-|>", "mutation_scale": 10, "color": style.VERMILLION,
                 "linewidth": 1.6, "shrinkA": 0, "shrinkB": 0}  # fmt: skip
    if way in ("right", "left"):
        sign = 1 if way == "right" else -1
        start, end, bend = (x - 0.35 * sign, y + 0.6), (x + 0.45 * sign, y + 0.6), 0.0
    else:
        # Seen from the side it faces right: nose down is clockwise.
        sign = 1 if way == "front" else -1
        start, end, bend = (
            (x - 0.5 * sign, y + 0.5),
            (x + 0.65 * sign, y + 0.35),
            -0.5 * sign,
        )
    axes.add_patch(
        FancyArrowPatch(
            start, end, connectionstyle=f"arc3,rad={bend}", zorder=5, **look
        )
    )


def main(argv: Sequence[str] | None = None) -> None:
    """Parses the flag, draws and saves."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="an SVG or a PNG")
    style.save(draw(), parser.parse_args(argv).out)


if __name__ == "__main__":
    main()
