"""HalfCheetah as PETS has it: the model of gymnasium, stepped by MJX or C MuJoCo.

Differences to other HalfCheetahs: the observation has 18 entries and begins with the
forward velocity over the whole environment step; every trial starts within 0.001 of
the same state; nothing ends a trial; all geoms hit the floor (not so in Brax).
"""

import importlib.resources
from typing import Any, NamedTuple
from xml.etree import ElementTree

import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import check_array, check_count, check_record
from jaxpets._src.coordinates import space
from jaxpets._src.types import Env, ModelSpace
from jaxpets.envs.extra import needs_extra
from jaxpets.envs.mujoco_env import mujoco_env
from jaxpets.envs.observations import DEFAULT, readings

with needs_extra():
    import mujoco

OBS_SIZE = 18
ACTION_SIZE = 6
TIMESTEP = 0.05  # s per environment step

# Entries of the observation.
FORWARD_VELOCITY = 0  # m/s, (x' - x) / TIMESTEP over the last environment step
HEIGHT = 1  # m, of the torso relative to its start
PITCH = 2  # rad, unwrapped, positive is nose down
JOINT_ANGLES = slice(3, 9)  # rad: thigh, shin, foot of the back and the front leg
X_VELOCITY = 9  # m/s, at this instant
Z_VELOCITY = 10  # m/s
PITCH_RATE = 11  # rad/s, positive rolls forward
JOINT_VELOCITIES = slice(12, 18)  # rad/s

# 1000 kg/m^3 (MuJoCo's default) scaled to the total mass of 14 kg that the file asks
# for by `settotalmass`, an attribute MuJoCo is about to drop.
_DENSITY = "660.8849500774735"


class TaskWeights(NamedTuple):
    """A task as data: `velocity * v + pitch_rate * omega - control * ||a||^2`.

    Attributes:
      velocity: `[]`, weight of the forward velocity.
      pitch_rate: `[]`, weight of the pitch rate.
      control: `[]`, weight of the action's cost.
    """

    velocity: Array
    pitch_rate: Array
    control: Array


TASK_NAMES = ("forward", "backward", "front-flip", "back-flip")


def tasks() -> TaskWeights:
    """Returns the four tasks of the paper, stacked `[4]` in the order of TASK_NAMES.

    Figure 3 of the paper, named by physics: a positive pitch rate is nose down, so it
    turns front flips. The figure has the two flips the other way round.
    """
    return TaskWeights(
        velocity=jnp.array([1.0, -1.0, 0.0, 0.0], jnp.float32),
        pitch_rate=jnp.array([0.0, 0.0, 1.0, -1.0], jnp.float32),
        control=jnp.full((4,), 0.1, jnp.float32),
    )


def task(name: str) -> TaskWeights:
    """Returns one task, scalar weights.

    Raises:
      ValueError: if the name is not in TASK_NAMES.
    """
    if name not in TASK_NAMES:
        raise ValueError(f"task must be one of {', '.join(TASK_NAMES)}, got {name!r}.")
    index = TASK_NAMES.index(name)
    return TaskWeights(*(weight[index] for weight in tasks()))


def task_reward(
    weights: TaskWeights, obs: Array, action: Array, next_obs: Array
) -> Array:
    """Rewards one step of a task; also scores recorded trials, `[T, D]` and `[T, A]`.

    Args:
      weights: scalars, from `task`, or one row of `tasks`.
      obs: unused; PETS rewards the state that was reached.
      action: `[A]`, or `[..., A]` with the leading shape of next_obs.
      next_obs: `[..., D]`.

    Returns:
      `[...]`, in m/s or rad/s.
    """
    del obs
    check_record("weights", weights, TaskWeights)
    check_array("next_obs", next_obs, ["...", OBS_SIZE])
    motion = (
        weights.velocity * next_obs[..., FORWARD_VELOCITY]
        + weights.pitch_rate * next_obs[..., PITCH_RATE]
    )
    return motion - weights.control * jnp.sum(action**2, axis=-1)


def model_space() -> ModelSpace:
    """Returns the coordinates of PETS for this observation.

    They follow from the joints, as those of any robot. Features drop the
    finite-difference velocity and show the pitch as sine and cosine: `[F] = 18`.
    Targets are changes, but for that velocity, which is predicted itself. Imagined
    states are bounded except for the pitch, which grows by a turn a second in a flip.
    """
    found = readings(load_model(), DEFAULT)
    return space([reading.coordinate for reading in found])


def load_model() -> Any:
    """Returns gymnasium's HalfCheetah as a compiled MuJoCo model."""
    # By way of the package: its module of MuJoCo environments imports a renderer.
    with needs_extra():
        assets = importlib.resources.files("gymnasium") / "envs/mujoco/assets"
    root = ElementTree.fromstring((assets / "half_cheetah.xml").read_text())
    compiler, geom = root.find("compiler"), root.find("default/geom")
    assert compiler is not None and geom is not None
    # Deprecated and inert in today's MuJoCo; equal masses come from the density.
    for name in ("settotalmass", "coordinate"):
        compiler.attrib.pop(name, None)
    geom.set("density", _DENSITY)
    xml = ElementTree.tostring(root, "unicode")
    c: Any = mujoco  # its names are made at import, where pyright does not see them
    return c.MjModel.from_xml_string(xml)


def half_cheetah(*, iterations: int = 8, ls_iterations: int = 8) -> Env:
    """Builds HalfCheetah on MJX.

    Args:
      iterations: of the contact solver. Fewer than 5 are wrong once the robot lies on
        its back; MuJoCo needs at most 5 there.
      ls_iterations: of its line search; MJX always runs all of them.

    Returns:
      An Env with observations `[18]` and actions `[6]` in [-1, 1].

    Raises:
      TypeError, ValueError: unless the two are positive Python integers.
    """
    iterations = check_count("iterations", iterations)
    ls_iterations = check_count("ls_iterations", ls_iterations)
    model = load_model()
    model.opt.iterations = iterations
    model.opt.ls_iterations = ls_iterations
    return mujoco_env(model, control_step=TIMESTEP, backend="mjx")


def half_cheetah_native(*, num_threads: int | None = None) -> Env:
    """Builds HalfCheetah on C MuJoCo, with the solver settings of gymnasium.

    For batches too small to fill a GPU: every step is computed on the host, in double
    precision, while the device waits. A state that has blown up is NaN from there on,
    as with MJX. Without a C++ compiler JAX needs its CPU backend for this, so that a
    JAX_PLATFORMS that is set must list cpu.

    Args:
      num_threads: over which a batch is spread; by default all cores.

    Returns:
      An Env as that of `half_cheetah`, with the same states, and the same start for the
      same key.

    Raises:
      TypeError, ValueError: unless num_threads is None or a positive Python integer.
    """
    return mujoco_env(load_model(), control_step=TIMESTEP, num_threads=num_threads)


def qpos_from_obs(obs: Array) -> Array:
    """Returns the joint positions `[T, 9]` of a recorded trial `[T, 18]`.

    The observation leaves out where the robot is; its velocity over each step says it.
    """
    x = jnp.cumsum(obs[:, FORWARD_VELOCITY] * TIMESTEP)
    return jnp.concatenate([x[:, None], obs[:, HEIGHT:X_VELOCITY]], axis=-1)
