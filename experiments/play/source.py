"""What a page is about: a robot, a model of it, and the search that plans with it."""

import contextlib
from pathlib import Path
from typing import NamedTuple

import jaxpets
from jaxpets import policies
from jaxpets.envs import Robot

from .. import build, exploration, model_file, robots
from ..config import Config, PlannerConfig
from ..errors import UsageError
from ..presets import preset_config, quick_search


class Source(NamedTuple):
    """A robot and what is known of it."""

    robot: Robot  # with geometry
    size: jaxpets.EnsembleConfig
    params: jaxpets.EnsembleParams
    search: PlannerConfig
    title: str
    policy: Path | None = None  # that came along with the model


def found(source: str, *, env: str | None = None, seed: int | None = None) -> Source:
    """Returns what `--from` names.

    Args:
      source: `pretrained/NAME`, a file of `jaxpets.save_model`, or the folder of a run.
      env: the robot that the command line names, if it does.
      seed: of a run; None for its first.

    Raises:
      UsageError: if there is no such model, or it is of another robot, or that robot
        cannot be drawn.
      CheckpointError: if a run's folder cannot be read.
    """
    path = model_file.named(Path(source))
    if path.is_dir():
        return _of_run(path, env, seed)
    return _of_file(path, source, env)


def robot_named(env: str) -> Robot:
    """Returns a robot on C MuJoCo, or on an engine of its own.

    Raises:
      UsageError: if there is none of that name, or it cannot be drawn.
    """
    robot = robots.named(env, "mujoco")
    if robot.model is None or robot.qpos_fn is None:
        raise UsageError(f"--env {env} has no model that can be drawn.")
    return robot


def _of_file(path: Path, said: str, env: str | None) -> Source:
    model = model_file.read(path, said)
    name = model_file.robot_of(model, said, env)
    robot = robot_named(name)
    model_file.check_fits(model, robot, said)
    config = model.ensemble.config
    assert config is not None
    default = preset_config("laptop", Config().arm, name).task_planner
    search = model_file.search_of(model, said, default)
    own = None
    # A robot of the user's own may have other tasks than the model's.
    if path != Path(said) and name == model.about.get("environment"):
        with contextlib.suppress(UsageError):  # most models came without one
            own = model_file.named(Path(said), "--policy", policies.path)
    return Source(robot, config, model.params, search, said, own)


def _of_run(run: Path, env: str | None, seed: int | None) -> Source:
    known = exploration.explored(run, seed=seed, env=env)
    config = known.config
    robot = robot_named(env or config.env)
    title = f"{run.name}, trial {known.trial}"
    size = build.ensemble_config(config.model)
    return Source(robot, size, known.params, quick_search(config), title)
