"""Robots of the registries of Brax and MuJoCo Playground, under their names there.

Their one task, `own`, is the reward that they come with: it is observed, as the entry
`reward`, and a model learns to predict it like any other. Besides:

- An observation is theirs. Nobody says what its entries are, so all of them are
  predicted by their change; angles are not treated as such.
- They are stepped by the package's own engine, in JAX on the device.
- Where Brax ends a trial it ends (`Env.terminal_fn`), and the entry `done` lets a
  planner foresee that. Playground's robots go on: those of its control suite end only
  where physics fails, and their long way to a start would be gone with every step.
- They are drawn if their observation begins with positions, as most do.
"""

import contextlib
import importlib
import io
import warnings
from collections.abc import Callable, Generator, Mapping
from operator import attrgetter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import nearest
from jaxpets._src.coordinates import index, space
from jaxpets._src.types import RewardFn
from jaxpets.envs.adapters import from_brax
from jaxpets.envs.extra import needs_extra
from jaxpets.envs.robot import Robot, tasks_of

_MOST_MISSING = 2  # the root's x and y
_FEW = 2  # positions, of which one that is seen may be a chance


class Registry(NamedTuple):
    """Where a package has its environments, as names of attributes.

    Attributes:
      extra: which brings the package.
      module: to import.
      where: what has the names, for people.
      names: of the module, an iterable.
      load: of the module, `(name, **options) -> environment`.
      options: of `load`.
      model: of an environment, an MjModel.
      positions: of a state, and velocities.
      keep: as `from_brax` takes it.
    """

    extra: str
    module: str
    where: str
    names: str
    load: str
    options: Mapping[str, Any]
    model: str
    positions: tuple[str, str]
    keep: tuple[str, ...]


REGISTRIES: Mapping[str, Registry] = {
    "brax": Registry(
        extra="envs",
        module="brax.envs",
        where="brax.envs",
        names="_envs",
        load="get_environment",
        options={},
        model="sys.mj_model",
        positions=("pipeline_state.q", "pipeline_state.qd"),
        keep=("reward", "done"),
    ),
    "playground": Registry(
        extra="playground",
        module="mujoco_playground",
        where="mujoco_playground.registry",
        names="registry.ALL_ENVS",
        load="registry.load",
        # Its default is Warp, which is for GPUs of one maker.
        options={"config_overrides": {"impl": "jax"}},
        model="mj_model",
        positions=("data.qpos", "data.qvel"),
        keep=("reward",),
    ),
}
"""By the word before the slash."""


def registered(package: str, name: str) -> Robot:
    """Builds one robot.

    Args:
      package: of REGISTRIES.
      name: as the package has it.

    Raises:
      ImportError: without the package; it names the extra.
      ValueError: if it has no such name, the nearest are said; or cannot make what it
        names, or that does not observe a vector.
    """
    registry = REGISTRIES[package]
    with needs_extra(registry.extra), _quiet():
        module = importlib.import_module(registry.module)
    names: tuple[str, ...] = tuple(attrgetter(registry.names)(module))
    if name not in names:
        near = ", ".join(f"{package}/{x}" for x in nearest(name, names) or names)
        raise ValueError(
            f"name must be a robot of {registry.where}, as {near}, got "
            f"{f'{package}/{name}'!r}."
        )
    load: Callable[..., Any] = attrgetter(registry.load)(module)
    try:
        with _quiet(), jax.numpy_dtype_promotion("standard"):
            world = load(name, **registry.options)
            env = from_brax(world, keep=registry.keep)
            model, step_time = attrgetter(registry.model, "dt")(world)
    except Exception as error:  # of the package's, of any kind
        reason = " ".join(f"{type(error).__name__}: {error}".split()).rstrip(".")
        raise ValueError(f"{registry.where} cannot make {name}: {reason}.") from error

    def qpos_fn(obs: Array) -> Array:
        state = env.reset(jax.random.key(0))
        positions = attrgetter(*registry.positions)(state.physics)
        return _track(_Start(state.obs, *positions), obs, float(step_time))

    return Robot(
        name=f"{package}/{name}",
        env=env,
        space=space(env.coordinates),
        tasks=tasks_of({"own": _own(index(env.coordinates, "reward"))}),
        model=model,
        qpos_fn=qpos_fn,
        step_time=float(step_time),
    )


def _own(place: int) -> RewardFn:
    """Returns the task that is an entry of the observation."""

    def own(constants: Any, obs: Array, action: Array, next_obs: Array) -> Array:
        del constants, obs, action
        return next_obs[..., place]

    return own


class _Start(NamedTuple):
    """What tells where positions are in an observation: both, as a trial starts."""

    obs: Array  # [D]
    qpos: Array  # [Q]
    qvel: Array  # [V]


def _track(start: _Start, obs: Array, step_time: float) -> Array:
    """Returns positions `[T, Q]` of a trial, NaN if its observation has none.

    Where the root stands, which many leave out, is where its velocity has brought it.
    The first that is observed, as a height, may be measured from elsewhere.
    """
    num, num_speeds = len(start.qpos), len(start.qvel)
    track = jnp.full((len(obs), num), jnp.nan)
    for missing in reversed(range(min(num, _MOST_MISSING + 1))):
        size = num - missing
        seen, there = start.obs[:size], start.qpos[missing:]
        if len(seen) < size:
            continue
        same = seen == there
        fits = jnp.all(same[1:]) & (same[0] | (size > _FEW))
        root = jnp.broadcast_to(start.qpos[:missing], (len(obs), missing))
        speeds = start.obs[size : size + num_speeds]
        if len(speeds) == num_speeds:
            way = step_time * jnp.cumsum(obs[:, size : size + missing], axis=0)
            root += jnp.where(jnp.all(speeds == start.qvel), way, 0.0)
        path = jnp.concatenate([root, obs[:, :size] + (there - seen)], axis=-1)
        track = jnp.where(fits, path, track)
    return track


@contextlib.contextmanager
def _quiet() -> Generator[None]:
    """Keeps to itself what packages say of others that they could do with."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        yield
