"""How every figure of the project looks, and how it is made and saved."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ..storage import disk

# Okabe and Ito's palette, which the colour-blind can tell apart.
BLUE = "#0072B2"
ORANGE = "#E69F00"
VERMILLION = "#D55E00"
GREEN = "#009E73"
PURPLE = "#CC79A7"
SKY = "#56B4E9"
BLACK = "#000000"
GREY = "#7F7F7F"

# An arm has the same colour in every figure.
_ARMS = {
    "epistemic": BLUE,
    "best": BLACK,
    "count": ORANGE,
    "count-16": VERMILLION,
    "count-32": ORANGE,
    "random": GREY,
    "oracle": GREEN,
    "one-step": PURPLE,
}
_OTHER_ARMS = (SKY, "#8C564B", "#882255", "#999933", "#332288", "#44AA99", "#DDCC77")

STYLE: Any = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "font.size": 9,
    "grid.color": "#E5E5E5",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "savefig.dpi": 150,
    "svg.hashsalt": "jaxpets",  # equal data give equal files
}


def arm_color(arm: str, arms: Sequence[str]) -> str:
    """Returns an arm's colour; arms without their own take others in turn."""
    unknown = [name for name in arms if name not in _ARMS]
    if arm in _ARMS:
        return _ARMS[arm]
    return _OTHER_ARMS[unknown.index(arm) % len(_OTHER_ARMS)]


def new_figure(width: float, height: float) -> Figure:
    """Returns an empty figure of a size in inches, which needs no display."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, target: Path) -> None:
    """Writes a PNG or SVG; without date and version, equal data give equal files."""
    svg = target.suffix == ".svg"
    with mpl.rc_context(STYLE), disk.replaced(target) as draft:
        figure.savefig(
            draft,
            metadata={"Date": None, "Creator": None} if svg else {"Software": None},
        )
