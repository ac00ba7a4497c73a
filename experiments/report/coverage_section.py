"""Sections of the report on the data of the arms: what it covers, who predicts it."""

from pathlib import Path

import numpy as np

from ..errors import UsageError
from ..storage import rundir
from . import coverage, figures, tables
from .coverage import Scale, Seen

_COVERAGE = (
    "Where the transitions of exploration ended: {bins}, the "
    "outermost ones open; white is a cell that no seed saw. Cells of the table: mean ± "
    "standard deviation over seeds; % is of a seed's transitions. Arms with other "
    "numbers of transitions cannot be compared by cells."
)
_MODEL_ERROR = (
    "One step, on {rows} transitions of every seed, drawn once; without the random "
    "trials at the start, which seeds of all arms share. No model is asked about the "
    "data of its own run and seed. Cells: mean ± standard deviation over pairs of a "
    "model and a data set, which are not independent. Models are of trial {trials}."
)
_ERROR = (
    "Error of the members' mean prediction: root mean square over dimensions, each by "
    "the standard deviation of its target in all that was drawn."
)
_NLL = (
    "Negative log-likelihood in nats per dimension of the equal mixture of the members."
)


def covered(seen: Seen | None, picture: Path) -> list[str]:
    """Draws what each arm saw, and returns the section on it.

    Args:
      seen: of all arms; None gives no section and no picture.
      picture: file to write.
    """
    if seen is None:
        return []
    by_arm = {arm: seen.by_arm[arm] for arm in tables.in_order(seen.by_arm)}
    means = {arm: np.mean([*seeds.values()], axis=0) for arm, seeds in by_arm.items()}
    figures.coverage(picture, means, *seen.scales)
    measured = {
        arm: {s: coverage.measures(seen.scales, x) for s, x in seeds.items()}
        for arm, seeds in by_arm.items()
    }
    lines = ["## State coverage", "", f"![what each arm saw]({picture.name})", ""]
    text = _COVERAGE.format(bins=" by ".join(map(_bins, seen.scales)))
    return [*lines, text, "", *tables.measures(measured)]


def _bins(scale: Scale) -> str:
    width = (scale.edges[-1] - scale.edges[0]) / (len(scale.edges) - 1)
    return f"{len(scale.edges) - 1} bins of {width:.3g} {scale.unit} ({scale.name})"


def model_error(path: Path, preset: str) -> list[str]:
    """Returns the section on a file that `experiments.tools.model_error` wrote.

    Args:
      path: without a file there is no section.
      preset: of this report; the file may be of another one, and then there is none.

    Raises:
      UsageError: if it is another file.
    """
    if not path.exists():
        return []
    found = rundir.find_json(path)
    try:
        if found["preset"] != preset:
            return []
        trials = sorted(
            {t for seeds in found["trials"].values() for t in seeds.values()}
        )
        after = ", ".join(map(str, trials))
        error, nll = tables.pairs(found["error"]), tables.pairs(found["nll"])
        about = _MODEL_ERROR.format(rows=found["rows"], trials=after)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise UsageError(
            f"{path} is not of experiments.tools.model_error ({error!r}); move it "
            "elsewhere."
        ) from error
    lines = ["## Model error: whose model knows whose data", "", about, ""]
    return [*lines, _ERROR, "", *error, _NLL, "", *nll]
