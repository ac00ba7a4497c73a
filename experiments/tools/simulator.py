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
from typing import Any

import jax
import numpy as np
import tyro

import jaxpets
from jaxpets.envs import Robot, Tasks, env_rollout, with_constants

from .. import acting, flags, robots
from ..build import imagined_end, optimizer
from ..config import EngineName, PlannerConfig, Steps, TaskTrials
from ..entries import read, to_json
from ..errors import RunError
from ..presets import PRESETS, quick_search
from ..storage import metrics, rundir
from ..storage.environment import environment
from ..validate import check_planner

_PAPER = PRESETS["paper"]
_SEARCH = quick_search(_PAPER)


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Performs every task with the simulator as the model of the search."""

    env: str = rundir.HALF_CHEETAH
    """The robot, as `experiments.run` takes it."""
    tasks: str | None = None
    """FILE.py of your own: its tasks in place of the robot's."""
    task: str = "all"
    """What is performed, as `walk,run`."""
    seed: int = 0
    """Of all keys."""
    num_trials: TaskTrials = 1
    """Per task."""
    trial_length: Steps = 1000
    """Environment steps per trial."""
    engine: EngineName = "mujoco"
    """What steps the physics, imagined and real."""
    json: Path | None = None
    """Appends a row per trial to this file."""
    task_planner: PlannerConfig = _SEARCH
    """By default the search of the models that come with the code."""


def perform(args: Arguments, robot: Robot) -> np.ndarray:
    """Returns the returns `[K, R]` of R trials of each of the K tasks."""
    tasks, scorer = _chosen(args, robot), acting.scorer(robot)
    search = optimizer(args.task_planner, robot.env)
    planner = jaxpets.plan(
        env_rollout(robot.env),
        tasks.reward_fn,
        search,
        terminal_fn=imagined_end(robot.env),
    )

    def trial(task: Any, key: jax.Array) -> jax.Array:
        env = acting.at_start(robot, task)
        reset_key, act_key = jax.random.split(key)
        start = jaxpets.start_trial(env, planner, reset_key)
        constants = start.env.constants
        _, transitions, _ = jaxpets.unroll(
            env,
            planner,
            jaxpets.PlanParams((), with_constants(task, constants)),
            act_key,
            start,
            length=args.trial_length,
            observe_fn=lambda state: state,
        )
        return scorer.score(transitions, constants).returns

    trials = jax.jit(jax.vmap(jax.vmap(trial, (None, 0)), (0, None)))
    keys = jax.random.split(jax.random.key(args.seed), args.num_trials)
    returns = np.asarray(trials(tasks.params, keys))  # [K, R, all of the robot's]
    each = zip(returns, robots.places(robot, tasks), strict=True)
    return np.stack([of_task[:, place] for of_task, place in each])


def _chosen(args: Arguments, robot: Robot) -> Tasks:
    return robots.chosen(dataclasses.replace(_PAPER, task=args.task), robot)


def main(argv: Sequence[str] | None = None) -> int:
    """Performs, and prints a line per task; returns the exit code."""
    args = tyro.cli(Arguments, args=argv, prog=f"{__package__}.simulator")
    try:
        read(Arguments, to_json(args), args, flags.refuse)
        check_planner("--task-planner", args.task_planner, 1)
        if args.json is not None:
            metrics.append_rows(args.json, [])  # before anything is computed
        robot = robots.named(args.env, args.engine, args.tasks)
        robots.check_tasks(dataclasses.replace(_PAPER, task=args.task), robot)
    except RunError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    begin = time.monotonic()
    where = {"date": rundir.now(), "env": environment()}
    returns = perform(args, robot)
    names = _chosen(args, robot).names
    width = max(11, *map(len, names))
    for name, own in zip(names, returns, strict=True):
        each = " ".join(f"{value:.0f}" for value in own)
        print(f"{name:<{width}}{own.mean():8.0f}   trials: {each}")
        rows = [
            {
                "robot": args.env,
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
        if args.json is not None:
            metrics.append_rows(args.json, rows)
    print(f"{time.monotonic() - begin:.0f} s", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
