"""What a page is about: a robot, a model of it, and the search that plans with it."""

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
from jax import Array

import jaxpets
from jaxpets import policies
from jaxpets.envs import Robot, with_constants
from jaxpets.policies import Guided, load_policy

from .. import build, exploration, model_file, policy, robots
from ..config import PlannerConfig
from ..errors import CheckpointError, UsageError
from ..presets import quick_search
from .live import Policy


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


def policy_of(path: Path, robot: Robot) -> Policy:
    """Returns the policy in a file, for all tasks of a robot.

    Args:
      path: of the file, or `pretrained/NAME`.
      robot: that acts by it.

    Raises:
      UsageError: if there is no such file.
      CheckpointError: if it is no policy, or one of another robot or of other tasks.
    """
    path = model_file.named(path, "--policy", policies.path, plain="best")
    goals = policy.family(robot, len(robot.tasks.names))
    try:
        planner, networks = load_policy(path, goals=goals, space=robot.space)
    except FileNotFoundError as error:
        valid = "there is no such file"
        raise UsageError(f"--policy {path} is not valid; {valid}.") from error
    except (TypeError, ValueError) as error:
        raise CheckpointError(str(error)) from error
    found = Policy(planner, networks)
    task = jax.tree.map(lambda x: x[0], robot.tasks.params)
    try:
        output = jax.eval_shape(_acts(found, robot), task, jax.random.key(0))
        fits = output.action.shape == robot.env.action_low.shape
    except (TypeError, ValueError):  # of shapes that do not fit
        fits = False
    if not fits:
        raise CheckpointError(f"{path} is a policy of another robot, or other tasks.")
    return found


def _acts(found: Policy, robot: Robot) -> Callable[..., jaxpets.typing.PlanOutput]:
    """Returns what a policy does at the start of a trial."""

    def act(task: Any, key: Array) -> jaxpets.typing.PlanOutput:
        state = robot.env.reset(key)
        data = Guided(with_constants(task, state.constants), found.networks)
        params = jaxpets.PlanParams((), data)
        return found.planner.step(params, key, (), state.obs)[0]

    return act


def _of_file(path: Path, said: str, env: str | None) -> Source:
    model = model_file.read(path, said)
    name = model_file.robot_of(model, said, env)
    robot = robot_named(name)
    model_file.check_fits(model, robot, said)
    config = model.ensemble.config
    assert config is not None
    search = model_file.search_of(model, said)
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
