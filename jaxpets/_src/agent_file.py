"""What an agent has learned and seen, as one file."""

import os
from collections.abc import Mapping
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxpets._src import file_facts, tensor_file
from jaxpets._src.learner import LearnerState

_FORMAT = {"format": "jaxpets agent", "version": "1"}


class Counts(NamedTuple):
    """How far an agent has come; Python's integers.

    Attributes:
      acts: calls of `act`.
      fits: calls of `learn`.
      steps: transitions that were observed.
      trained: 1 once the model knows anything, before that 0.
    """

    acts: int
    fits: int
    steps: int
    trained: int


def write(path: str | os.PathLike[str], state: LearnerState, counts: Counts) -> None:
    """Writes an agent at once.

    Raises:
      ValueError: for data of a reward whose dtype such a file does not have.
    """
    arrays = {name: np.asarray(leaf) for name, leaf in tensor_file.named(state).items()}
    texts = {name: str(count) for name, count in counts._asdict().items()}
    tensor_file.write(path, arrays, _FORMAT | texts)


def read(
    path: str | os.PathLike[str], template: LearnerState
) -> tuple[LearnerState, Counts]:
    """Reads an agent that has the shapes of `template`.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: naming what is not there, does not fit, or is no number of a model or
        of its data.
    """
    file = tensor_file.read(path)
    counts = _counts(file)
    wanted = tensor_file.named(template)
    for name in sorted(wanted.keys() | file.shapes.keys()):
        leaf = wanted.get(name)
        want = None if leaf is None else (tuple(leaf.shape), str(leaf.dtype))
        got = (file.shapes[name], file.dtypes[name]) if name in file.shapes else None
        if want != got:
            raise ValueError(
                f"{file.path} does not fit this agent: {name} must be {want}, got "
                f"{got}."
            )
    arrays = file.arrays()
    _check_numbers(file, arrays)
    leaves = [jnp.asarray(arrays[name]) for name in wanted]
    structure = cast(Any, jax.tree.structure(template))
    return cast(LearnerState, jax.tree.unflatten(structure, leaves)), counts


def _check_numbers(
    file: tensor_file.TensorFile, arrays: Mapping[str, np.ndarray]
) -> None:
    """Raises for a model that computes nothing, or data that are not where it says."""
    model = {
        name.removeprefix("params."): array
        for name, array in arrays.items()
        if name.startswith("params.")
    }
    file_facts.check_numbers(f"params in {file.path}", model)
    capacity = len(arrays["dataset.data.obs"])
    for name, most in (("size", capacity), ("cursor", capacity - 1)):
        got = int(arrays[f"dataset.{name}"])
        if not 0 <= got <= most:
            raise ValueError(
                f"dataset.{name} in {file.path} must be 0 to {most}, got {got}."
            )


def _counts(file: tensor_file.TensorFile) -> Counts:
    for name, want in _FORMAT.items():
        got = file.metadata.get(name)
        if got != want:
            raise ValueError(
                f"{file.path} is no agent that can be read: its {name} must be "
                f"{want!r}, got {got!r}."
            )
    texts = [file.metadata.get(name, "") for name in Counts._fields]
    if not all(text.isascii() and text.isdigit() and len(text) < 19 for text in texts):
        raise ValueError(f"{file.path} is no agent that can be read: it counts wrong.")
    return Counts(*map(int, texts))
