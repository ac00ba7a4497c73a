"""From arrays of trials to the rows of metrics.jsonl and to trajectories.npz."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxpets
from experiments.acting import Trials, score
from experiments.errors import DivergedError
from jaxpets.envs import half_cheetah


def check_finite(trials: Trials, trial: int) -> None:
    """Raises DivergedError if the simulator left the finite numbers."""
    if not all(np.isfinite(x).all() for x in jax.tree.leaves(trials)):
        raise DivergedError(
            f"trial {trial} has observations or plan values that are not finite; "
            "it was not learned from. The last checkpoint is intact."
        )


def rows(
    labels: Sequence[dict[str, Any]],
    trials: Trials,
    fit: jaxpets.FitMetrics | None = None,
    params: jaxpets.EnsembleParams | None = None,
) -> list[dict[str, Any]]:
    """Returns one row per trial, its labels first.

    Args:
      labels: what the trials are, in the order of their leading axes.
      trials: any leading axes.
      fit: with the same leading axes.
      params: the model after fitting, with the same leading axes.
    """
    returns, turns = score(trials.transitions)
    value = np.asarray(trials.values).mean(axis=-1)
    flat_returns = np.asarray(returns).reshape(-1, len(half_cheetah.TASK_NAMES))
    table = []
    for i, label in enumerate(labels):
        named = dict(
            zip(half_cheetah.TASK_NAMES, flat_returns[i].tolist(), strict=True)
        )
        row = {**label, "value": value.flat[i].item()}
        row |= {"turns": np.asarray(turns).flat[i].item(), "returns": named}
        if label.get("task"):
            row["return"] = named[label["task"]]
        if fit is not None and params is not None:
            row["fit"] = _fit_row(fit, params, i)
        table.append(row)
    return table


def _fit_row(
    fit: jaxpets.FitMetrics, params: jaxpets.EnsembleParams, i: int
) -> dict[str, float]:
    row = {name: np.asarray(x).flat[i].item() for name, x in fit._asdict().items()}
    for name in ("max_logvar", "min_logvar"):
        bound = np.asarray(getattr(params.network, name))
        bound = bound.reshape(-1, bound.shape[-1])[i]
        row |= {f"{name}_low": bound.min().item(), f"{name}_high": bound.max().item()}
    return row


def save_paths(
    path: Path, trials: Trials, seeds: Sequence[int], tasks: Sequence[str]
) -> None:
    """Writes the observations of trials `[S, K, R, T, *]` for videos."""
    returns, _ = score(trials.transitions)
    columns = [half_cheetah.TASK_NAMES.index(task) for task in tasks]
    own = np.stack([np.asarray(returns)[:, k, :, c] for k, c in enumerate(columns)], 1)
    np.savez_compressed(
        path,
        obs=np.asarray(trials.transitions.next_obs),
        action=np.asarray(trials.transitions.action),
        seeds=np.asarray(seeds),
        tasks=np.asarray(tasks),
        returns=own,
    )


def describe(rows: Sequence[dict[str, Any]]) -> str:
    """Returns one line: mean value and returns, of a task over the rows that sought it.

    Rows without a task, those of exploration, count for all.
    """
    parts = []
    for name in half_cheetah.TASK_NAMES:
        own = [row["returns"][name] for row in rows if row.get("task", name) == name]
        if own:
            parts.append(f"{name} {np.mean(own):.0f}")
    value = np.mean([row["value"] for row in rows])
    return "  ".join([f"value {value:.3g}", "returns:", *parts])
