"""What an agent is told by a world that is not JAX: checked, and as arrays of NumPy."""

from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxpets._src.dataset import MAX_SIZE
from jaxpets._src.types import Dataset, Transition

# What was observed and is not yet in the dataset: obs, action, next_obs of each step.
Seen = deque[tuple[np.ndarray, ...]]

AUTORESETS = ("Disabled", "NextStep", "SameStep")

_NO_REALS = "USc"  # kinds of dtypes that NumPy would make floats of: text and complex


class World(NamedTuple):
    """Shapes of one world, or of N that are stepped together.

    Attributes:
      obs_size: D.
      num_envs: N, or None for one without a leading axis.
      autoreset: who begins the next trial, one of AUTORESETS.
    """

    obs_size: int
    num_envs: int | None
    autoreset: str

    @property
    def lead(self) -> tuple[int, ...]:
        """`()` or `(N,)`."""
        return () if self.num_envs is None else (self.num_envs,)


def autoreset_of(value: Any, num_envs: int | None) -> str:
    """Returns the mode that was asked for, by name or as an enum of Gymnasium.

    Raises:
      ValueError: if there is no such mode.
    """
    if value is None:
        return "Disabled" if num_envs is None else "NextStep"
    name = getattr(value, "value", value)
    if name not in AUTORESETS:
        wanted = ", ".join(AUTORESETS)
        raise ValueError(f"autoreset must be one of {wanted}, got {value!r}.")
    return name


def numbers(world: World, name: str, value: Any) -> np.ndarray:
    """Returns a copy of observations as float32, `[D]` or `[N, D]`.

    Of N worlds one may have diverged, which the others cannot help; see `are_stable`.

    Raises:
      TypeError, ValueError: if they are not of this shape, or of a single world and
        not finite.
    """
    shape = (*world.lead, world.obs_size)
    try:
        given = np.asarray(value)
        if value is None or given.dtype.kind in _NO_REALS:  # None would be NaN
            raise TypeError
        with np.errstate(over="ignore"):  # what is too large is refused below
            array = np.array(given, np.float32)
    except (TypeError, ValueError) as error:
        kind = type(value).__name__
        raise TypeError(
            f"{name} must be numbers of shape {shape}, got {kind}."
        ) from error
    if array.shape != shape:
        raise ValueError(f"{name} must be of shape {shape}, got {array.shape}.")
    if world.num_envs is None and not np.isfinite(array).all():
        entry = np.argwhere(~np.isfinite(array))[0].tolist()
        got = array[tuple(entry)]
        raise ValueError(f"{name} must be finite, got {got} in entry {entry}.")
    return array


def are_stable(*arrays: np.ndarray) -> np.ndarray:
    """Tells `[]` or `[N]` which worlds have not diverged, in all of `[..., *]`."""
    good = [(np.abs(x) <= MAX_SIZE).all(axis=-1) for x in arrays]  # nor is NaN
    return np.logical_and.reduce(good)


def flags(world: World, name: str, value: Any) -> np.ndarray:
    """Returns bools as an array, `[]` or `[N]`.

    Raises:
      TypeError, ValueError: if they are none, or of another shape.
    """
    array = np.asarray(value)
    if array.dtype != bool:
        raise TypeError(f"{name} must be True or False, got {value!r}.")
    if array.shape not in {(), world.lead}:
        raise ValueError(f"{name} must be of shape {world.lead}, got {array.shape}.")
    return np.broadcast_to(array, world.lead)


def last_obs(
    world: World, next_obs: Any, done: np.ndarray, info: Mapping[str, Any] | None
) -> np.ndarray:
    """Returns where a step led, also where the world has begun a new trial in it.

    Args:
      world: its shapes.
      next_obs: `[D]` or `[N, D]`, of the step.
      done: `[]` or `[N]`, where a trial has ended.
      info: of the step.

    Raises:
      TypeError, ValueError: if an observation is not what it should be, or the last one
        of a trial is not there.
    """
    reached = numbers(world, "next_obs", next_obs)
    if world.autoreset != "SameStep" or not done.any():
        return reached
    if not isinstance(info, (Mapping, type(None))):  # pyright: ignore[reportUnnecessaryIsInstance]
        kind = type(info).__name__
        raise TypeError(f"info must be a dict that has final_obs, got {kind}.")
    found = (info or {}).get("final_obs")
    if found is None:
        raise ValueError(
            "info must have final_obs, where a trial has ended and autoreset is "
            "SameStep, got none."
        )
    if world.num_envs is None:
        return numbers(world, "info['final_obs']", found)
    count = len(found) if hasattr(found, "__len__") else None
    if count != world.num_envs:
        raise ValueError(
            f"info['final_obs'] must have {world.num_envs} rows, got "
            f"{type(found).__name__ if count is None else count}."
        )
    rows = [found[i] if ended else reached[i] for i, ended in enumerate(done)]
    return numbers(world, "info['final_obs']", rows)


def memory(dataset: Dataset) -> Seen:
    """Returns where steps wait for a dataset, each with a row at least.

    It would replace all but the last of them, and may not be asked for long: a robot
    that performs learns nothing.
    """
    capacity: int = dataset.data.obs.shape[0]
    return deque(maxlen=capacity)


def blocks(seen: Seen, size: int) -> Iterator[tuple[Transition, np.int32]]:
    """Yields rows in blocks of one size, the last filled up, and how many are meant.

    Args:
      seen: steps `[n, D]`, `[n, A]`, `[n, D]` each, with any n.
      size: of a block; the capacity if that is less.
    """
    if not seen:
        return
    size = min(size, seen.maxlen or size)
    rows = [np.concatenate(column) for column in zip(*seen, strict=True)]
    for start in range(0, len(rows[0]), size):
        part = [column[start : start + size] for column in rows]
        count = len(part[0])
        filled = [np.pad(x, ((0, size - count), (0, 0))) for x in part]
        yield Transition(*[jnp.asarray(x) for x in filled]), np.int32(count)
