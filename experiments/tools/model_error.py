"""`python -m experiments.tools.model_error RUN [RUN ...] --out FILE`.

Whose model knows what. The models of all runs predict one step of what all runs saw. A
model is never asked about data it was trained on: not about that of its own run and
seed, nor about the random trials at the start, which are the same for a seed of every
arm. Means over pairs of a model and a data set are written by the arms of both; null is
no pair.

error: of the members' mean prediction of the next observation, root mean square over
  transitions and dimensions, each by its target's std in all that was drawn; by 1 where
  that never changed.
nll: negative log-likelihood in nats per dimension of the equal mixture of the members,
  over dimensions jointly, by their number.
Targets are what the model of the robot predicts: changes, of most entries.
"""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxpets

from .. import robots
from ..report import tables
from . import compared

# `Ensemble.predict`.
Predict = Callable[[jaxpets.EnsembleParams, Array, Array], tuple[Array, Array]]


def measure(
    runs: Sequence[Path], num_rows: int, at_trial: int | None, env: str | None = None
) -> dict:
    """Returns error and nll by the arm of the model and the arm of the data.

    Args:
      runs: folders of exploration runs of one preset, no seed of an arm twice.
      num_rows: B, transitions drawn of every seed.
      at_trial: whose checkpoints to read; None for the last of each run.
      env: the robot, which must be said if it is of a file.

    Returns:
      `preset`, `rows`, `trials` by arm and seed, and `error` and `nll` as
      `by_arm` has them.

    Raises:
      RunError: if the runs cannot be compared or read, or have too few transitions.
    """
    compared.check_positive("--rows", num_rows)

    def transitions(saved: compared.Saved) -> jaxpets.Transition:
        size = int(saved.dataset.size)
        compared.check_enough(saved, num_rows, size - saved.first, "transitions")
        seeds = saved.config.seeds
        return draw(saved.dataset.data, seeds, saved.first, size, num_rows)

    found = compared.read(runs, at_trial, env, transitions)
    data, space = compared.joined(found), robots.of(found[0].config).space
    scale = compared.scale_of(space.target(data.obs, data.next_obs))
    error, nll = compared.score_all(found, _score_of, data, scale)
    arms = compared.arms_of(found)
    return {
        **compared.heading(found, num_rows),
        "error": by_arm(error, arms),
        "nll": by_arm(nll, arms),
    }


def draw(
    data: jaxpets.Transition, seeds: Sequence[int], first: int, size: int, num_rows: int
) -> jaxpets.Transition:
    """Draws `[S, B, *]` transitions without replacement, always the same.

    Args:
      data: `[S, C, *]`.
      seeds: S.
      first: row to draw from on.
      size: rows that are filled.
      num_rows: B, at most size - first.
    """

    def one(seed: Array, data: jaxpets.Transition) -> jaxpets.Transition:
        key = jax.random.fold_in(jax.random.key(0), seed)
        rows = jax.random.choice(key, size - first, (num_rows,), replace=False)
        return jax.tree.map(lambda x: x[first + rows], data)

    return jax.vmap(one)(jnp.array(seeds, jnp.uint32), data)


def _score_of(model: jaxpets.Ensemble, *inputs: Any) -> tuple[Array, Array]:
    return score(model.predict, model.num_members, *inputs)


def score(
    predict: Predict, num_members: int, params: Any, data: jaxpets.Transition,
    scale: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Returns error and nll `[M, N]` of M models on N data sets.

    Args:
      predict: of an Ensemble.
      num_members: E.
      params: of M models.
      data: `[N, B, *]`.
      scale: `[D]`, in which errors are measured, in units of obs.
    """

    def pair(params: Any, data: jaxpets.Transition) -> tuple[Array, Array]:
        obs = jnp.broadcast_to(data.obs, (num_members, *data.obs.shape))
        mean, variance = predict(params, obs, data.action)
        miss = mean - data.next_obs
        error = jnp.sqrt(jnp.mean((jnp.mean(miss, axis=0) / scale) ** 2))
        log_prob = -0.5 * (miss**2 / variance + jnp.log(2 * jnp.pi * variance))
        weight = 1 / num_members
        mixture = jax.nn.logsumexp(jnp.sum(log_prob, axis=-1), axis=0, b=weight)
        return error, -jnp.mean(mixture) / data.obs.shape[-1]

    # All data sets at once, but one model after the other: it is memory that is short.
    over_data = jax.vmap(pair, (None, 0))
    return jax.lax.map(lambda params: over_data(params, data), params)


def by_arm(values: np.ndarray, arms: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Summarizes pairs by the arm of the model, then by the arm of the data.

    Args:
      values: `[M, M]`, of model m on the data of model n; m = n is left out.
      arms: M, of each model.

    Returns:
      mean, std (None for one pair) and number of pairs; None for arms without a pair.
    """
    others = ~np.eye(len(arms), dtype=bool)
    table: dict[str, dict[str, Any]] = {}
    for model in tables.in_order(set(arms)):
        table[model] = {}
        for data in tables.in_order(set(arms)):
            of_both = np.outer([a == model for a in arms], [a == data for a in arms])
            chosen = values[of_both & others].astype(float)
            table[model][data] = _summary(chosen) if len(chosen) else None
    return table


def _summary(values: np.ndarray) -> dict[str, Any]:
    std = values.std(ddof=1) if len(values) > 1 else None
    return {"mean": values.mean(), "std": std, "pairs": len(values)}


def main(argv: Sequence[str] | None = None) -> int:
    """Measures and writes a JSON file; returns the exit code, as `experiments.run`."""
    parser = compared.parser("model_error", __doc__)
    parser.add_argument(
        "--out", type=Path, required=True, metavar="FILE",
        help="JSON; the report shows OUT/model_error.json",
    )  # fmt: skip
    parser.add_argument(
        "--rows", type=int, default=2000, help="transitions of every seed (2000)"
    )
    args = parser.parse_args(argv)
    return compared.write(
        args.out, lambda: measure(args.runs, args.rows, args.at_trial, args.env)
    )


if __name__ == "__main__":
    sys.exit(main())
