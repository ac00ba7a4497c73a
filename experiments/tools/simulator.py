"""`python -m experiments.tools.simulator`: tasks with the simulator as the model.

What it returns is what a search can reach where the model makes no error. A learned
model that comes as far with the same search is limited by the search; one that does not
is limited by the model.
"""

import dataclasses
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
import tyro

import jaxpets
from experiments import acting
from experiments.build import ENGINES, optimizer
from experiments.config import EngineName, PlannerConfig
from experiments.presets import PRETRAINED_PLANNER
from experiments.storage import metrics, rundir
from experiments.storage.environment import environment
from jaxpets.envs import env_rollout, half_cheetah


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Performs every task with the simulator as the model of the search."""

    seed: int = 0
    """Of all keys."""
    num_trials: int = 1
    """Per task."""
    trial_length: int = 1000
    """Environment steps per trial."""
    engine: EngineName = "mujoco"
    """What steps the physics, imagined and real."""
    json: Path | None = None
    """Appends a row per trial to this file."""
    task_planner: PlannerConfig = PRETRAINED_PLANNER
    """By default the search of the models that come with the code."""


def perform(args: Arguments) -> np.ndarray:
    """Returns the returns `[K, R]` of R trials of each of the K tasks."""
    env, search = ENGINES[args.engine](), args.task_planner
    planner = jaxpets.plan(
        env_rollout(env), half_cheetah.task_reward, optimizer(search, env)
    )

    def trial(weights: half_cheetah.TaskWeights, key: jax.Array) -> jax.Array:
        reset_key, act_key = jax.random.split(key)
        _, transitions, _ = jaxpets.unroll(
            env,
            planner,
            jaxpets.PlanParams((), weights),
            act_key,
            jaxpets.start_trial(env, planner, reset_key),
            length=args.trial_length,
            observe_fn=lambda state: state,
        )
        return acting.score(transitions)[0]

    trials = jax.jit(jax.vmap(jax.vmap(trial, (None, 0)), (0, None)))
    keys = jax.random.split(jax.random.key(args.seed), args.num_trials)
    returns = trials(half_cheetah.tasks(), keys)  # [K, R, K]
    own = range(returns.shape[0])
    return np.asarray(returns)[own, :, own]


def main(argv: Sequence[str] | None = None) -> None:
    """Performs, and prints a line per task."""
    args = tyro.cli(Arguments, args=argv, prog="experiments.tools.simulator")
    begin = time.monotonic()
    where = {"date": rundir.now(), "env": environment()}
    returns = perform(args)
    for name, own in zip(half_cheetah.TASK_NAMES, returns, strict=True):
        each = " ".join(f"{value:.0f}" for value in own)
        print(f"{name:<11}{own.mean():8.0f}   trials: {each}")
        rows = [
            {
                "task": name,
                "seed": args.seed,
                "trial": i + 1,
                "return": value,
                "steps": args.trial_length,
                "engine": args.engine,
                "task_planner": dataclasses.asdict(args.task_planner),
                **where,
            }
            for i, value in enumerate(own.tolist())
        ]
        if args.json:
            metrics.append_rows(args.json, rows)
    print(f"{time.monotonic() - begin:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    main()
