"""The policy that is distilled from a planner, as a config has it, and its files."""

import functools
import operator
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

import jaxpets
from jaxpets import models, policies
from jaxpets.envs import Robot, Tasks, with_constants
from jaxpets.policies import (
    ActorCriticParams,
    DistillConfig,
    Distiller,
    Goals,
    Guided,
    load_policy,
    save_policy,
    to_onnx,
)

from . import critic, model_file
from .build import Parts, imagined_end
from .config import Config
from .entries import to_json
from .errors import CheckpointError, UsageError
from .storage.folder import RunFolder


def make_distiller(config: Config, parts: Parts, tasks: Tasks) -> Distiller:
    """Returns what learns from the planner of a config."""
    settings, robot = config.distill, parts.robot
    rounds = max(settings.num_rounds, 1)
    rate = optax.cosine_decay_schedule(
        settings.learning_rate, rounds * settings.num_updates, alpha=0.05
    )
    plans = rounds * settings.num_trials * settings.horizon
    return jaxpets.distill(
        parts.with_policy,
        parts.model.sample,
        robot.tasks.reward_fn,
        optax.adam(rate),
        DistillConfig(
            hidden_size=settings.hidden_size,
            num_trials=settings.num_trials,
            horizon=settings.horizon,
            num_updates=settings.num_updates,
            capacity=min(plans, DistillConfig.capacity),
        ),
        robot.space,
        obs_size=parts.model.obs_size,
        action_low=robot.env.action_low,
        action_high=robot.env.action_high,
        num_members=parts.model.num_members,
        goals=family(robot, len(tasks.names)),
        terminal_fn=imagined_end(robot.env),
    )


def family(robot: Robot, count: int) -> Goals:
    """Returns what is drawn for a trial of any of `count` tasks, and seen of it.

    A task that is a number among several is seen as which of them it is.
    """
    own, every = critic.goals_of(robot), len(robot.tasks.names)
    form = jax.tree.structure(robot.tasks.params)

    def draw(tasks: Any, key: Array) -> Any:
        which, rest = jax.random.split(key)
        i = jax.random.randint(which, (), 0, count)
        return own.draw(jax.tree.map(lambda x: x[i], tasks), rest)

    def shown(x: Array) -> Array:
        if jnp.issubdtype(x.dtype, jnp.integer):
            return jax.nn.one_hot(x, every, dtype=jnp.float32).ravel()
        return jnp.ravel(x).astype(jnp.float32)

    def features(data: Any) -> Array:
        task = data if jax.tree.structure(data) == form else data.task
        leaves = [shown(jnp.asarray(x)) for x in jax.tree.leaves(task)]
        return jnp.concatenate([*leaves, own.features(data)])

    return Goals(draw, features)


class Policy(NamedTuple):
    """What acts without a plan; its reward data are Guided."""

    planner: jaxpets.Planner
    networks: ActorCriticParams


def of_file(path: Path, robot: Robot, env: str, names: Sequence[str]) -> Policy:
    """Returns the policy in a file.

    A file that says nothing of itself, as any of `save_policy` may, need only fit.

    Args:
      path: of the file, or `pretrained/NAME`.
      robot: that acts by it.
      env: what the command line calls it.
      names: of its tasks that are performed.

    Raises:
      UsageError: if there is no such file.
      CheckpointError: if it is no policy, or one of another robot or of other tasks.
    """
    path = model_file.named(path, "--policy", policies.path, plain="best")
    goals = family(robot, len(robot.tasks.names))
    try:
        _check_about(path, models.about(path), env, names)
        planner, networks = load_policy(path, goals=goals, space=robot.space)
    except FileNotFoundError as error:
        valid = "there is no such file"
        raise UsageError(f"--policy {path} is not valid; {valid}.") from error
    except (OSError, TypeError, ValueError) as error:
        raise _refused(str(error)) from error
    found = Policy(planner, networks)
    task = jax.tree.map(lambda x: x[0], robot.tasks.params)
    try:
        output = jax.eval_shape(_acts(found, robot), task, jax.random.key(0))
        fits = output.action.shape == robot.env.action_low.shape
    except (TypeError, ValueError):  # of shapes that do not fit
        fits = False
    if not fits:
        raise _refused(f"{path} is a policy of another robot, or other tasks.")
    return found


def _check_about(
    path: Path, about: Mapping[str, Any], env: str, names: Sequence[str]
) -> None:
    """Refuses a policy that says it is of another robot, or of other tasks.

    Robots of equal sizes have networks of equal shapes.
    """
    own, wanted = about.get("environment"), model_file.called(env)
    if own not in (None, wanted):
        raise _refused(f"{path} is a policy of {own}, not of {wanted}.")
    learned = about.get("tasks")
    if isinstance(learned, list) and not {*names} <= {*map(str, learned)}:
        said, performed = ", ".join(map(str, learned)), ", ".join(names)
        raise _refused(
            f"{path} is a policy of other tasks: it was learned on {said}, and "
            f"{performed} are performed."
        )


def _refused(why: str) -> CheckpointError:
    return CheckpointError(f"--policy: {why}")


def begun(parts: Parts, found: Policy) -> jaxpets.Planner:
    """Returns the planner of phase 2, whose plans begin with what a policy would do.

    Its reward data are Guided.
    """
    reward = policies.guided_reward(parts.robot.tasks.reward_fn)
    return parts.with_policy(found.planner, reward)


def _acts(found: Policy, robot: Robot) -> Callable[..., jaxpets.typing.PlanOutput]:
    """Returns what a policy does at the start of a trial."""

    def act(task: Any, key: Array) -> jaxpets.typing.PlanOutput:
        state = robot.env.reset(key)
        data = Guided(with_constants(task, state.constants), found.networks)
        params = jaxpets.PlanParams((), data)
        return found.planner.step(params, key, (), state.obs)[0]

    return act


def policy_file(seed: int) -> str:
    """Returns the name of the file of the policy of a seed."""
    return f"policy-{seed}.safetensors"


def export(
    run: RunFolder, config: Config, parts: Parts, tasks: Tasks,
    networks: ActorCriticParams, source: model_file.Source, step: int,
) -> None:  # fmt: skip
    """Writes the policies `[S]` for others, and for programs without JAX if it can.

    Args:
      run: that gets the files.
      config: of distill.
      parts: made with it.
      tasks: that the policies were learned on.
      networks: `[S]`.
      source: what explored.
      step: trials behind the model.
    """
    env, space = parts.robot.env, parts.robot.space
    about = {"environment": model_file.called(config.env), "tasks": tasks.names}
    origin = {**model_file.origin(source), "distill": to_json(config.distill)}
    built: Any = {
        "obs_size": parts.model.obs_size,
        "action_low": env.action_low,
        "action_high": env.action_high,
    }
    for i, seed in enumerate(config.seeds):
        file, onnx = policy_file(seed), f"policy-{seed}.onnx"
        params = jax.tree.map(operator.itemgetter(i), networks)
        training = model_file.training(run, config, seed, step) | origin
        save = functools.partial(
            save_policy, params=params, space=space, **built,
            about={**about, "training": training},
        )  # fmt: skip
        run.export(file, save)
        try:
            content = to_onnx(params, space, **built)
        except (ImportError, ValueError) as error:
            run.say(f"no {onnx}: {error}")
            continue
        run.export(onnx, functools.partial(_write, content))


def _write(content: bytes, target: Path) -> None:
    target.write_bytes(content)
