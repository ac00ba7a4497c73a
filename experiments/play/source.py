"""What a page is about: a robot, a model of it, and the search that plans with it."""

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

import jaxpets
from jaxpets import models
from jaxpets.envs import Robot

from .. import build, exploration, robots, user_files
from ..config import Config, PlannerConfig
from ..errors import CheckpointError, UsageError
from ..presets import preset_config
from ..storage import rundir

_PRETRAINED = "pretrained"


class Source(NamedTuple):
    """A robot and what is known of it."""

    robot: Robot  # with geometry
    size: jaxpets.EnsembleConfig
    params: jaxpets.EnsembleParams
    search: PlannerConfig
    title: str


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
    path, name = Path(source), source.removeprefix(f"{_PRETRAINED}/")
    if path.is_dir():
        return _of_run(path, env, seed)
    if name != source and not path.exists():
        try:
            path = models.path(name)
        except ValueError as error:
            raise UsageError(f"--from {source} is not valid; {error}") from error
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
    try:
        about = models.about(path)
        model, params = jaxpets.load_model(path)
    except FileNotFoundError as error:
        valid = "there is no such run or model"
        raise UsageError(f"--from {said} is not valid; {valid}.") from error
    except (TypeError, ValueError) as error:
        raise CheckpointError(str(error)) from error
    name = env or about.get("environment")
    if not isinstance(name, str):
        raise UsageError(f"--env is missing; {said} does not say of which robot it is.")
    user_files.check_named("--env", env, name, path)
    robot = robot_named(name)
    config = model.config
    assert config is not None
    sizes = (model.obs_size, model.action_size)
    own = model.space.coordinates if model.space else ()
    if sizes != robots.sizes(robot) or (own and own != robot.space.coordinates):
        raise UsageError(f"--env {name} is not valid; {said} is of another robot.")
    return Source(robot, config, params, _search(about.get("search"), said), said)


def _search(said: Any, where: str) -> PlannerConfig:
    """Returns the search that a file says is good for its model.

    Raises:
      CheckpointError: if it is none, or one with numbers beyond reason.
    """
    try:
        if not isinstance(said, dict):
            raise TypeError("it says no search")
        own = dict(said.get("settings", {}))
        own |= {x: said[x] for x in ("optimizer", "num_particles")}
        return msgspec.convert(own | {"precision": "f32"}, PlannerConfig)
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{where} cannot be planned with ({error}).") from error


def _of_run(run: Path, env: str | None, seed: int | None) -> Source:
    known = exploration.explored(run, seed=seed, env=env)
    config = known.config
    robot = robot_named(env or config.env)
    title = f"{run.name}, trial {known.trial}"
    size = build.ensemble_config(config.model)
    return Source(robot, size, known.params, _quick(config), title)


def _quick(config: Config) -> PlannerConfig:
    """Returns a search that two cores are quick enough for."""
    if config.preset != "paper":
        return config.task_planner
    laptop = preset_config("laptop", rundir.label(config.arm), config.env)
    members = config.model.num_members
    return dataclasses.replace(laptop.task_planner, num_particles=members)
