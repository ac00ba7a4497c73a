"""How far a rollout that rounds more is from the scan in float32, on an explored model.

The candidates of CEM's first iteration are imagined from states of trials that the
model performed, with the same noise. `error` is the norm of the difference over that of
the paths; `overlap` is the share of a reward's best candidates that are also its best
in float32. Of both, the mean and the worst over states. `moved` is the scan in float32
itself, from a start 1e-5 standard deviations of the states away: a cheetah is chaotic,
and no rounding can be expected to stay nearer than that.

    python -m experiments.run --phase zero-shot --from pretrained
    python -m benchmarks.accuracy runs/pretrained-epistemic/zero-shot-060
"""

import argparse
import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxpets
from benchmarks import rows, workloads
from experiments import exploration
from experiments.build import build
from experiments.errors import RunError
from experiments.storage.folder import RunFolder
from experiments.storage.rundir import HALF_CHEETAH
from jaxpets.envs import half_cheetah

COLUMNS = (
    "rollout", "reward", "error", "most_error", "overlap", "least_overlap",
)  # fmt: skip
ROLLOUTS = ("moved", "tf32", "bf16", "kernel")
_DISTANCE = 1e-5

# (key, obs [D], actions [N, H, A]) -> path [N, H + 1, E, P, D] and values by reward.
Imagine = Callable[[Array, Array, Array], tuple[Array, dict[str, Array]]]


def run(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yields a row for every rollout and reward."""
    params, size = explored(args.run, workloads.chosen_size(args))
    starts, scale = states(RunFolder(args.run).trajectories, args.states)
    workloads.optimizer(size, "cem")  # refuses more elites than candidates
    exact = imagine(params, size, "f32")
    for name in args.rollout:
        other = exact if name == "moved" else imagine(params, size, name)
        distance = _DISTANCE * scale if name == "moved" else jnp.zeros_like(scale)
        error, overlap = compare(exact, other, starts, distance, size)
        for reward, shares in overlap.items():
            yield rows.make_row(
                "accuracy",
                {**dataclasses.asdict(size), "run": str(args.run)},
                rollout=name,
                reward=reward,
                states=len(starts),
                error=_number(np.mean(error)),
                most_error=_number(np.max(error)),
                overlap=float(np.mean(shares)),
                least_overlap=min(shares),
            )


def compare(
    exact: Imagine, other: Imagine, starts: Array, distance: Array, size: workloads.Size
) -> tuple[list[float], dict[str, list[float]]]:
    """Returns the error, and the overlap by reward, at every one of starts `[B, D]`.

    There `other` starts about distance `[D]` from where `exact` does.
    """
    error: list[float] = []
    overlap: dict[str, list[float]] = {}
    shape = (size.num_samples, size.horizon, half_cheetah.ACTION_SIZE)
    for i, obs in enumerate(starts):
        keys = jax.random.split(jax.random.fold_in(jax.random.key(0), i), 3)
        # CEM starts with half the box's half width as deviation, cut off at two.
        actions = jax.random.truncated_normal(keys[0], -2.0, 2.0, shape) / 2
        path, values = exact(keys[1], obs, actions)
        away = distance * jax.random.normal(keys[2], obs.shape)
        near, found = other(keys[1], obs + away, actions)
        error.append(float(jnp.linalg.norm(near - path) / jnp.linalg.norm(path)))
        for reward in values:
            best, same = (
                jax.lax.top_k(x[reward], size.num_elites)[1] for x in (values, found)
            )
            share = np.intersect1d(best, same).size / size.num_elites
            overlap.setdefault(reward, []).append(share)
    return error, overlap


def explored(
    folder: Path, search: workloads.Size
) -> tuple[jaxpets.EnsembleParams, workloads.Size]:
    """Returns the first model of a folder of zero-shots, and the search with it.

    Raises:
      SystemExit: if there is none that can be compared.
    """
    try:
        return _explored(folder, search)
    except RunError as error:
        raise SystemExit(f"cannot read {folder}: {error}") from error


def _explored(
    folder: Path, search: workloads.Size
) -> tuple[jaxpets.EnsembleParams, workloads.Size]:
    run = RunFolder(folder)
    config = exploration.config_of(run)
    if config.env != HALF_CHEETAH:
        known = f"its robot is {config.env}, and only {HALF_CHEETAH} is compared"
        raise RunError(known)  # whose text is printable, if a stranger's is not
    num_members = config.model.num_members
    if num_members < 2 or search.num_particles % num_members:
        raise SystemExit(
            f"{folder} has {num_members} members; they must be 2 or more and divide "
            f"the {search.num_particles} particles of the search"
        )
    if config.model.state_margin != jaxpets.EnsembleConfig().state_margin:
        raise SystemExit(f"{folder} has its own --model.state-margin")
    # A file of tasks or of an objective has no part in what the model predicts.
    parts = build(exploration.without_files(config, None, folder))
    template = exploration.model_of(exploration.template(config, parts))
    found = run.restore(template)
    if found is None:
        raise SystemExit(f"there is no checkpoint in {folder}")
    params = jax.tree.map(lambda x: x[0], found[1].params)
    return params, workloads.with_network(search, config.model)


def states(npz: Path, count: int) -> tuple[Array, Array]:
    """Returns states of the first seed's first trials `[B, D]`, of all tasks in turn.

    Also the standard deviation `[D]` of all states of that seed.

    Raises:
      SystemExit: if there is no such file or its trials are too short.
    """
    if not npz.exists():
        raise SystemExit(f"there is no {npz}")
    with np.load(npz, allow_pickle=False) as file:
        obs = file["obs"][0]  # [K, R, T, D]
    num_tasks, _, length, _ = obs.shape
    if length <= count:
        raise SystemExit(f"--states {count}: the trials have {length} steps")
    times = np.arange(1, count + 1) * length // (count + 1)
    starts = obs[np.arange(count) % num_tasks, 0, times]
    return jnp.asarray(starts), jnp.asarray(obs.std((0, 1, 2)))


def imagine(params: jaxpets.EnsembleParams, size: workloads.Size, name: str) -> Imagine:
    """Returns the compiled rollout, with the values of what it imagines."""
    on_cpu = jax.default_backend() == "cpu"
    own = "f32" if on_cpu else "bf16"  # of the kernel
    engine, precision = ("kernel", own) if name == "kernel" else ("scan", name)
    rollout = workloads.rollout_fn(size, precision, engine)
    rewards: dict[str, tuple[Any, Any]] = {
        "epistemic": (jaxpets.rewards.epistemic, jaxpets.rewards.max_variance(params)),
    } | {
        task: (half_cheetah.task_reward, half_cheetah.task(task))
        for task in half_cheetah.TASK_NAMES
    }

    def imagined(
        params: jaxpets.EnsembleParams, key: Array, obs: Array, actions: Array
    ) -> tuple[Array, dict[str, Array]]:
        path = rollout(params, key, obs, actions)

        def score(
            objective_fn: jaxpets.optimizers.ObjectiveFn, key: Array, state: tuple
        ) -> Any:
            values = objective_fn(key, actions)
            return jaxpets.optimizers.Solution(actions[0], values[0]), values

        def values(reward_fn: jaxpets.typing.RewardFn, weights: Any) -> Array:
            """What a planner that has imagined the path sees of the candidates."""
            search = jaxpets.optimizers.TrajectoryOptimizer(tuple, score)
            planner = jaxpets.plan(lambda *_: path, reward_fn, search)
            return planner.step(jaxpets.PlanParams(None, weights), key, (), obs)[1]

        return path, {reward: values(*parts) for reward, parts in rewards.items()}

    return functools.partial(jax.jit(imagined), params)


def main(argv: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Parses the arguments, measures and reports."""
    parser = rows.parser(__doc__)
    parser.add_argument("run", type=Path, help="folder of a run's zero-shots")
    workloads.add_size_flag(parser)
    parser.add_argument("--rollout", nargs="+", choices=ROLLOUTS,
                        default=["moved", "bf16"], help="what to compare")  # fmt: skip
    parser.add_argument("--states", type=rows.positive, default=8, help="to start from")
    args = rows.parse(parser, argv, size="tiny")
    return rows.report(run(args), COLUMNS, args.json)


def _number(x: np.floating) -> float | None:
    return float(x) if np.isfinite(x) else None  # JSON has no NaN


if __name__ == "__main__":
    main()
