"""Which robot a run is about, and what it may perform."""

import contextlib
import functools
import hashlib
import os
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxpets

from . import user_files
from .config import Config
from .errors import UsageError
from .storage import rundir

if TYPE_CHECKING:  # it brings mujoco, which wrong flags need not wait for
    from jaxpets.envs import Robot, Tasks


_MJCF = " An MJCF goes into a file of Python: --env FILE.py, with a robot(backend)."


def of(config: Config) -> "Robot":
    """Returns the robot of a config, with the tasks of the user's if there are any.

    Raises:
      UsageError: if there is none of that name, or a file of the user's is at fault.
    """
    return named(config.env, config.engine, config.tasks)


@functools.lru_cache(maxsize=4)
def named(env: str, engine: str, tasks: str | None = None) -> "Robot":
    """Returns a robot, always the same for the same flags; see `of`."""
    from jaxpets import envs

    if user_files.is_file(env):
        robot = user_files.made("--env", env, "robot", _checked, engine)
    else:
        try:
            robot = envs.make(env, backend=engine)
        except (ImportError, ValueError) as error:
            hint = _MJCF if env.endswith(".xml") else ""
            raise UsageError(f"--env {env} is not valid; {error}{hint}") from error
    if tasks is None:
        return robot

    def with_tasks(rewards: Any) -> "Robot":
        if not isinstance(rewards, Mapping):
            kind = type(rewards).__name__
            raise TypeError(f"it must return rewards by name, got {kind}")
        return _checked(robot._replace(tasks=envs.tasks_of(rewards)))

    return user_files.made("--tasks", tasks, "tasks", with_tasks)


@contextlib.contextmanager
def without_gl() -> Iterator[None]:
    """Lets mujoco be imported without OpenGL, which only a video's process needs.

    A MUJOCO_GL that does not work here would end the run on that import.
    """
    chosen = os.environ.get("MUJOCO_GL")
    os.environ["MUJOCO_GL"] = "disable"
    try:
        yield
    finally:
        del os.environ["MUJOCO_GL"]
        if chosen is not None:
            os.environ["MUJOCO_GL"] = chosen


def listing(engine: str) -> str:
    """Returns a line per robot, with sizes and tasks, and one per package of more."""
    from jaxpets import envs

    lines = [("name", "observation", "action", "tasks")]
    for name in envs.names():
        try:
            robot = envs.make(name, backend=engine)
        except ImportError:
            extra = name.partition("/")[0]
            lines.append((name, "", "", f"needs the extra jaxpets[{extra}]"))
            continue
        seen, acted = map(str, sizes(robot))
        lines.append((name, seen, acted, ", ".join(robot.tasks.names)))
    for package, module in envs.registries().items():
        lines.append((f"{package}/NAME", "", "", f"own, of any NAME in {module}"))
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)][:-1]
    return "\n".join(
        "  ".join([*(x.ljust(w) for x, w in zip(line, widths, strict=False)), line[-1]])
        for line in lines
    )


def sizes(robot: "Robot") -> tuple[int, int]:
    """Returns D and A."""
    start = jax.eval_shape(robot.env.reset, jax.random.key(0))
    return start.obs.shape[0], robot.env.action_low.shape[0]


def entries(config: Config) -> list[str]:
    """Returns the names of what the robot observes, in order; none if it has none."""
    return [x.name for x in of(config).env.coordinates]


def digests(config: Config) -> dict[str, str]:
    """Returns a digest of what a user's robot is compiled to; nothing of another one.

    An MJCF, and the meshes that it names, may be edited while the file of the robot
    stays as it is, and that file while the robot does, as for a new task. Of a robot
    without a `model` only its step and its actions are known.
    """
    if not user_files.is_file(config.env):
        return {}
    robot = of(config)
    bounds = (robot.env.action_low, robot.env.action_high)
    data = repr((robot.step_time, *(np.asarray(x).tolist() for x in bounds))).encode()
    if robot.model is not None:
        import mujoco

        c: Any = mujoco
        if isinstance(robot.model, c.MjModel):
            model = np.zeros((c.mj_sizeModel(robot.model),), np.uint8)
            c.mj_saveModel(robot.model, None, model)
            data += model.tobytes()
    return {"the compiled robot": hashlib.sha256(data).hexdigest()[:8]}


def chosen(config: Config, robot: "Robot") -> "Tasks":
    """Returns the tasks that phase 2 is about, K of the robot's."""
    tasks = robot.tasks._replace(names=names(config, robot))
    ids = jnp.asarray(places(robot, tasks))
    return tasks._replace(params=jax.tree.map(lambda x: x[ids], tasks.params))


def names(config: Config, robot: "Robot") -> tuple[str, ...]:
    """Returns the tasks that a config names; `all` are those of the robot."""
    return robot.tasks.names if config.task == "all" else tuple(config.task.split(","))


def places(robot: "Robot", tasks: "Tasks") -> list[int]:
    """Returns where tasks stand among all of the robot."""
    return [robot.tasks.names.index(name) for name in tasks.names]


def check_tasks(config: Config, robot: "Robot") -> None:
    """Refuses a task that the robot does not have, and a tag that is one of its tasks.

    Raises:
      UsageError: naming the flag.
    """
    own, wanted = robot.tasks.names, names(config, robot)
    if not set(wanted) <= set(own) or len(set(wanted)) < len(wanted):
        valid = f"it must be all, or of {', '.join(own)} each at most once"
        raise UsageError(f"--task {config.task} is not valid; {valid}.")
    if config.tag in ("all", *own):
        valid = "it must be something else; it is a task"
        raise UsageError(f"--tag {config.tag} is not valid; {valid}.")


def _checked(robot: Any) -> "Robot":
    """Returns what is a robot: one that can be reset, stepped, modelled and scored."""
    from jaxpets import envs

    if not isinstance(robot, envs.Robot):
        kind = type(robot).__name__
        raise TypeError(f"it must return a jaxpets.envs.Robot, got {kind}")
    names = robot.tasks.names
    for name in names:
        try:
            rundir.check_name(name)
        except UsageError as error:
            raise ValueError(str(error).replace("run", "task", 1)) from None
    if "all" in names or len(set(names)) < len(names):
        raise ValueError(f"tasks must have names of their own, not all, got {names}")
    jax.eval_shape(functools.partial(_trial, robot), jax.random.key(0))
    return robot


def _trial(robot: "Robot", key: jax.Array) -> Any:
    """Does one step of everything that a run does with a robot."""
    from jaxpets import envs

    env, space = robot.env, robot.space
    planner = jaxpets.random_planner(env.action_low, env.action_high)
    state = jaxpets.start_trial(env, planner, key)
    nothing = jaxpets.PlanParams(())
    state, seen, _ = jaxpets.unroll(env, planner, nothing, key, state, length=1)
    _check_end(env, seen.obs.shape[-1])
    features, target = space.features(seen.obs), space.target(seen.obs, seen.next_obs)
    known = (
        space.next_obs(seen.obs, target),
        space.bound(seen.obs, seen.obs[0], seen.obs[0]),
    )

    def reward(task: Any) -> jax.Array:
        params = envs.with_constants(task, state.env.constants)
        _check_indices(robot.tasks.reward_fn, params, seen)
        planned = jaxpets.rewards.score(robot.tasks.reward_fn, params, seen)
        return planned + robot.tasks.reward_fn(params, *seen)

    rewards = jax.vmap(reward)(robot.tasks.params)
    if rewards.shape != (len(robot.tasks.names), 1):
        raise ValueError(
            "the reward of tasks must be [...] for observations [..., D], with a row "
            f"of params for each name, got {rewards.shape} for {len(robot.tasks.names)}"
            " tasks of one step"
        )
    shown = [seen.obs[:, axis.entry] for axis in robot.axes]
    return features, known, rewards, jnp.asarray(shown)


def _check_end(env: jaxpets.Env, size: int) -> None:
    """Refuses an end that knows one observation, where plans and scores have many."""
    if env.terminal_fn is None:
        return
    # No two axes are of one size, so that none passes for another.
    batch = (size + 1, size + 2)
    ended = env.terminal_fn(jnp.zeros((*batch, size), jnp.float32))
    found, kind = jnp.shape(ended), jnp.result_type(ended)
    if found != batch or kind != jnp.bool_:
        raise ValueError(
            f"terminal_fn must be bool [...] for observations [..., D], got {kind} "
            f"{found} for {(*batch, size)}"
        )


def _check_indices(reward_fn: Any, params: Any, seen: jaxpets.Transition) -> None:
    """Refuses a reward that reads past the end, where JAX would read the last entry.

    NumPy does not. A reward that cannot take its arrays is none the worse for it.
    """
    obs, action, next_obs = (np.zeros(x.shape[1:], np.float32) for x in seen)
    with np.errstate(all="ignore"):
        try:
            reward_fn(params, obs, action, next_obs)
        except IndexError as error:
            if "out of bounds" in str(error):
                raise
        except Exception:  # what JAX can do and NumPy cannot
            pass
