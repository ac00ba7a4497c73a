"""Sections of the report on the data of the arms: what it covers."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from experiments import coverage, figures, tables
from experiments.coverage import Counts

_COVERAGE = (
    "Where the transitions of exploration ended: bins of 0.5 m/s by 1 rad/s, the "
    "outermost ones open; white is a cell that no seed saw. Cells of the table: mean ± "
    "standard deviation over seeds; % is of a seed's transitions. Arms with other "
    "numbers of transitions cannot be compared by cells."
)


def covered(by_arm: Mapping[str, Counts], picture: Path) -> list[str]:
    """Draws what each arm saw, and returns the section on it.

    Args:
      by_arm: counts `[V, W]` by arm and seed; none gives no section and no picture.
      picture: file to write.
    """
    if not by_arm:
        return []
    by_arm = {arm: by_arm[arm] for arm in tables.in_order(by_arm)}
    means = {arm: np.mean([*seeds.values()], axis=0) for arm, seeds in by_arm.items()}
    edges = coverage.VELOCITY_EDGES, coverage.PITCH_RATE_EDGES
    figures.coverage(picture, means, *edges)
    measured = {
        arm: {seed: coverage.measures(counts) for seed, counts in seeds.items()}
        for arm, seeds in by_arm.items()
    }
    lines = ["## State coverage", "", f"![what each arm saw]({picture.name})", ""]
    return [*lines, _COVERAGE, "", *tables.measures(measured)]
