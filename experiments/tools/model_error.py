"""`python -m experiments.tools.model_error RUN [RUN ...] --out FILE`.

Whose model knows what. The models of all runs predict one step of what all runs saw. A
model is never asked about data it was trained on: not about that of its own run and
seed, nor about the random trials at the start, which are the same for a seed of every
arm. Means over pairs of a model and a data set are written by the arms of both; null is
no pair.

error: of the members' mean prediction of the next observation, root mean square over
  transitions and dimensions, each by its target's std in all that was drawn.
nll: negative log-likelihood in nats per dimension of the equal mixture of the members,
  over dimensions jointly, by their number.
Targets are what the model of the robot predicts: changes, of most entries.
"""

import argparse
import functools
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxpets
from jaxpets.envs import Robot

from .. import exploration, robots
from ..build import State, build
from ..config import Config
from ..entries import to_json
from ..errors import RunError, UsageError
from ..report import tables
from ..storage import metrics, rundir
from ..storage.folder import RunFolder

# `Ensemble.predict`.
Predict = Callable[[jaxpets.EnsembleParams, Array, Array], tuple[Array, Array]]


class Explored(NamedTuple):
    """The models of a run after one of its trials, and a draw of what they saw."""

    predict: Predict
    params: jaxpets.EnsembleParams  # [S]
    data: jaxpets.Transition  # [S, B, *]
    trial: int


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
    if num_rows < 1:
        raise UsageError(f"--rows {num_rows} is not valid; it must be 1 or more.")
    configs = [exploration.config_of(RunFolder(run)) for run in runs]
    labels = [_label(config) for config in configs]
    _check_comparable(runs, configs, labels)
    configs = [
        exploration.without_files(config, env, run)
        for config, run in zip(configs, runs, strict=True)
    ]
    # The random trials of a seed are the same in all arms: all models know them.
    shared = max(config.random_trials for config in configs)
    found = [
        _read(run, config, at_trial, shared * config.trial_length, num_rows)
        for run, config in zip(runs, configs, strict=True)
    ]
    error, nll = _score_all(robots.of(configs[0]), found, configs)
    arms = [
        arm for arm, config in zip(labels, configs, strict=True) for _ in config.seeds
    ]
    trials: dict[str, dict[int, int]] = {}
    for arm, config, run in zip(labels, configs, found, strict=True):
        trials.setdefault(arm, {}).update(dict.fromkeys(config.seeds, run.trial))
    return {
        "preset": rundir.study(to_json(configs[0])),
        "rows": num_rows,
        "trials": trials,
        "error": by_arm(error, arms),
        "nll": by_arm(nll, arms),
    }


def _label(config: Config) -> str:
    return metrics.arm_label(config.arm, to_json(config))


def _check_comparable(
    runs: Sequence[Path], configs: Sequence[Config], labels: Sequence[str]
) -> None:
    """Refuses runs of several presets, and a seed of an arm that is there twice."""
    presets = sorted({rundir.study(to_json(config)) for config in configs})
    if len(presets) > 1:
        raise UsageError(f"the runs are of presets {', '.join(presets)}; give one.")
    seen: dict[tuple[str, int], Path] = {}
    for run, config, arm in zip(runs, configs, labels, strict=True):
        for seed in config.seeds:
            if (arm, seed) in seen:
                raise UsageError(
                    f"{seen[arm, seed]} and {run} both hold seed {seed} of arm {arm}; "
                    "leave one of them out."
                )
            seen[arm, seed] = run


def _read(
    run: Path, config: Config, at_trial: int | None, first: int, num_rows: int
) -> Explored:
    """Restores the models of a run and draws transitions from row `first` on."""
    parts = build(config)
    saved = exploration.as_saved(config, parts)

    def template(leaves: Mapping[str, Any]) -> State:
        whole = saved(leaves)
        return exploration.model_of(whole)._replace(dataset=whole.dataset)

    folder = RunFolder(run)
    if at_trial is None:
        found = folder.restore(template, part=True)
    else:
        found = at_trial, folder.restore_trial(at_trial, template, part=True)
    if found is None:
        raise UsageError(f"there is no checkpoint in {run}.")
    trial, state = found
    size = int(state.dataset.size)
    if size - first < num_rows:
        raise UsageError(
            f"--rows {num_rows} is not valid; {run} has {max(size - first, 0)} "
            f"transitions a seed after the random trials, at trial {trial}."
        )
    data = draw(state.dataset.data, config.seeds, first, size, num_rows)
    return Explored(parts.model.predict, state.params, data, trial)


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


def _score_all(
    robot: Robot, found: Sequence[Explored], configs: Sequence[Config]
) -> tuple[np.ndarray, np.ndarray]:
    """Returns error and nll `[M, M]` of all models on the data of all."""
    data = jax.tree.map(lambda *x: jnp.concatenate(x), *(run.data for run in found))
    target = robot.space.target(data.obs, data.next_obs)
    scale = jnp.std(target, axis=(0, 1))
    programs: dict[Any, Any] = {}  # runs with networks of one size share one
    scores = []
    for run, config in zip(found, configs, strict=True):
        program = functools.partial(score, run.predict, config.model.num_members)
        program = programs.setdefault(config.model, jax.jit(program))
        scores.append(jax.device_get(program(run.params, data, scale)))
    error, nll = (np.concatenate(x) for x in zip(*scores, strict=True))
    return error, nll


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
    parser = argparse.ArgumentParser(
        prog=f"{__package__}.model_error",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "runs", type=Path, nargs="+", metavar="RUN", help="folder of an exploration run"
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="FILE",
        help="JSON; the report shows OUT/model_error.json",
    )  # fmt: skip
    parser.add_argument(
        "--at-trial", type=int, help="as all runs were after this trial; else the last"
    )
    parser.add_argument(
        "--rows", type=int, default=2000, help="transitions of every seed (2000)"
    )
    parser.add_argument("--env", help="the robot of the runs, if it is of a file")
    args = parser.parse_args(argv)
    try:
        if not args.out.parent.is_dir():
            raise UsageError(f"--out {args.out} is not valid; there is no such folder.")
        found = measure(args.runs, args.rows, args.at_trial, args.env)
        rundir.write_json(args.out, found)
    except RunError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    print(f"wrote {args.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
