"""From arrays of trials to rows of the log, and to what a video is made of."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

import jaxpets
from experiments.acting import Scorer, Trials
from experiments.errors import DivergedError
from experiments.storage import metrics, pytrees

# No plan is worth as little but one whose candidates all have the worst value, which is
# shared by at most 1000 steps.
_NO_VALUE = jaxpets.optimizers.WORST_VALUE / 1e4


def check_finite(trials: Trials, trial: int) -> None:
    """Raises DivergedError if the simulator left the finite numbers."""
    if not all(np.isfinite(x).all() for x in jax.tree.leaves(trials)):
        raise DivergedError(
            f"trial {trial} has observations or plan values that are not finite; "
            "it was not learned from. The last checkpoint is intact."
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
    returns, turns = scorer.score(trials.transitions, trials.constants)
    names = scorer.names
    drawn = pytrees.to_host({"constants": trials.constants})
    values = np.asarray(trials.values)
    value, bad = values.mean(axis=-1), (values < _NO_VALUE).sum(axis=-1)
    flat_returns = np.asarray(returns).reshape(-1, len(names))
    table = []
    for i, label in enumerate(labels):
        named: dict[str, float] = dict(
            zip(names, flat_returns[i].tolist(), strict=True)
        )
        own = None if fit is None or params is None else _fit(fit, params, i)
        net = None if turns is None else np.asarray(turns).flat[i].item()
        row = metrics.row(label, value.flat[i].item(), net, named, own)
        where = np.unravel_index(i, value.shape)
        row |= {name: x[where].tolist() for name, x in drawn.items()}
        count = bad.flat[i].item()
        table.append(row | {"bad_plans": count} if count else row)
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

    Their constants, where they have any, are `constants/NAME`, `[S, K, R, *]`.
    """
    transitions = trials.transitions
    drawn = pytrees.to_host({"constants": trials.constants})
    returns, _ = scorer.score(transitions, trials.constants)
    columns = [scorer.names.index(task) for task in tasks]
    own = [np.asarray(returns)[:, k, :, c] for k, c in enumerate(columns)]
    return {
        "obs": np.asarray(transitions.next_obs),
        "action": np.asarray(transitions.action),
        "seeds": np.asarray(seeds),
        "tasks": np.asarray(tasks),
        "returns": np.stack(own, 1),
        **drawn,
    }


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
    text = "  ".join([f"value {value:.3g}", "returns:", *parts])
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
    return "\n".join(lines)
