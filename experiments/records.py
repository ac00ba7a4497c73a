"""From arrays of trials to rows of the log, and to what a video is made of."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import jaxpets

from .acting import Scorer, Trials
from .errors import DivergedError
from .storage import metrics, pytrees

# No plan is worth as little but one whose candidates all have the worst value, which is
# shared by at most 1000 steps.
_NO_VALUE = jaxpets.optimizers.WORST_VALUE / 1e4


def check_begun(rows: Sequence[dict[str, Any]], num_steps: int) -> None:
    """Raises DivergedError if a first trial has nothing that can be learned from."""
    if any(row.get("lost_steps") == num_steps for row in rows):
        raise DivergedError(
            "physics diverged in the first step of the first trial, so that there is "
            "nothing to learn from. Look at the robot's start, and halve its timestep."
        )


def rows(
    scorer: Scorer,
    labels: Sequence[dict[str, Any]],
    trials: Trials,
    fit: jaxpets.typing.FitMetrics | None = None,
    params: jaxpets.EnsembleParams | None = None,
) -> list[dict[str, Any]]:
    """Returns one row per trial, its labels first.

    Args:
      scorer: of the robot.
      labels: what the trials are, in the order of their leading axes.
      trials: any leading axes.
      fit: with the same leading axes.
      params: the model after fitting, with the same leading axes.
    """
    scored = scorer.score(trials.transitions, trials.constants)
    drawn = pytrees.to_host({"constants": trials.constants})
    values, num_steps = np.asarray(trials.values), np.asarray(scored.num_steps)
    table = []
    for i, label in enumerate(labels):
        where = np.unravel_index(i, num_steps.shape)
        returns = np.asarray(scored.returns)[where].tolist()
        named: dict[str, float] = dict(zip(scorer.names, returns, strict=True))
        own = None if fit is None or params is None else _fit(fit, params, i)
        net = None if scored.turns is None else np.asarray(scored.turns)[where].item()
        # Where physics diverged, the last plan was still of a state that was finite.
        plans = values[where][: num_steps[where] + 1]
        row = metrics.row(label, plans.mean().item(), net, named, own)
        row |= {name: x[where].tolist() for name, x in drawn.items()}
        counts = {
            "bad_plans": (plans < _NO_VALUE).sum().item(),
            "lost_steps": values.shape[-1] - num_steps[where].item(),
        }
        table.append(row | {name: count for name, count in counts.items() if count})
    return table


def _fit(
    fit: jaxpets.typing.FitMetrics, params: jaxpets.EnsembleParams, i: int
) -> dict[str, float]:
    row = {name: np.asarray(x).flat[i].item() for name, x in fit._asdict().items()}
    for name in ("max_logvar", "min_logvar"):
        bound = np.asarray(getattr(params.network, name))
        bound = bound.reshape(-1, bound.shape[-1])[i]
        row |= {f"{name}_low": bound.min().item(), f"{name}_high": bound.max().item()}
    return row


def trajectories(
    scorer: Scorer, trials: Trials, seeds: Sequence[int], tasks: Sequence[str]
) -> dict[str, np.ndarray]:
    """Returns the observations of trials `[S, K, R, T, *]` and what they belong to.

    Their constants, where they have any, are `constants/NAME`, `[S, K, R, *]`. The
    observations are NaN from where physics diverged on.
    """
    transitions = trials.transitions
    drawn = pytrees.to_host({"constants": trials.constants})
    scored = scorer.score(transitions, trials.constants)
    columns = [scorer.names.index(task) for task in tasks]
    own = [np.asarray(scored.returns)[:, k, :, c] for k, c in enumerate(columns)]
    return {
        "obs": _nan_from(np.asarray(scored.num_steps), transitions.next_obs),
        "action": np.asarray(transitions.action),
        "seeds": np.asarray(seeds),
        "tasks": np.asarray(tasks),
        "returns": np.stack(own, 1),
        **drawn,
    }


def until_diverged(seen: jaxpets.Transition, lost: Sequence[int]) -> jaxpets.Transition:
    """Returns trials of a dataset as they were: NaN where other rows took a place.

    Args:
      seen: `[..., T, *]`.
      lost: steps of every trial, as the log has them; of none if it has lost them.
    """
    *trials, length, _ = seen.next_obs.shape
    if len(lost) != math.prod(trials):
        return seen
    ends = length - np.reshape(lost, trials)
    return seen._replace(next_obs=_nan_from(ends, seen.next_obs))


def _nan_from(ends: np.ndarray, path: Any) -> np.ndarray:
    """Returns observations `[..., T, D]`, NaN from a step `[...]` on."""
    path = np.array(path)
    path[np.arange(path.shape[-2]) >= ends[..., None]] = np.nan
    return path


def describe(rows: Sequence[dict[str, Any]]) -> str:
    """Returns one line: mean value and returns, of a task over the rows that sought it.

    Rows without a task, those of exploration, count for all.
    """
    parts = []
    for name in rows[0]["returns"]:
        own = [row["returns"][name] for row in rows if row.get("task", name) == name]
        if own:
            parts.append(f"{name} {np.mean(own):.0f}")
    value = np.mean([row["value"] for row in rows])
    text = "  ".join([f"value {value:.3g}", "returns:", *parts, *diverged(rows)])
    bad = sum(row.get("bad_plans", 0) for row in rows)
    skipped = sum(row.get("fit", {}).get("num_skipped", 0) for row in rows)
    counts = {"bad plans": bad, "updates refused": skipped}
    return text + "".join(f"  {what}: {n}" for what, n in counts.items() if n)


def summary(
    rows: Sequence[dict[str, Any]], tasks: Sequence[str], seconds: float
) -> str:
    """Returns the lines that end a zero-shot: the returns of every task."""
    lines = [f"zero-shot returns ({seconds:.0f} s):"]
    width = max(11, *map(len, tasks))
    for task in tasks:
        own = [row["return"] for row in rows if row["task"] == task]
        each = " ".join(f"{value:.0f}" for value in own)
        lines.append(f"  {task:<{width}}{sum(own) / len(own):8.0f}   trials: {each}")
    also = [*diverged(rows), *not_finite(rows, tasks)]
    return "\n".join([*lines, *(f"  {line}" for line in also)])


def not_finite(rows: Sequence[Mapping[str, Any]], tasks: Sequence[str]) -> list[str]:
    """Returns what is to be said of tasks whose returns are no numbers, if any."""
    lines = list[str]()
    for task in tasks:
        own = [row["return"] for row in rows if row["task"] == task]
        lost = sum(not math.isfinite(value) for value in own)
        if lost:
            share = f"{lost} of {len(own)} trials"
            lines.append(
                f"the reward of {task} is not finite in {share}: a plan that expects "
                "that is rejected"
            )
    return lines


def diverged(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Returns what is to be said of trials in which physics diverged, if any."""
    lost = [row["lost_steps"] for row in rows if "lost_steps" in row]
    if not lost:
        return []
    share = f"{len(lost)} of {len(rows)} trials"
    return [f"physics diverged in {share}: {sum(lost)} steps lost"]
