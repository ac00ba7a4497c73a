"""A state with every kind of leaf, for the tests of checkpoints."""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments.storage import checkpoint


class Params(NamedTuple):
    w1: jax.Array
    low: jax.Array
    empty: jax.Array


class State(NamedTuple):
    params: Params
    optimizer: Any
    key: jax.Array
    other_key: jax.Array
    raw_key: jax.Array
    counts: dict[str, jax.Array]


def make_state(seed: int) -> State:
    key = jax.random.key(seed)
    params = Params(
        jax.random.normal(key, (40, 50)),
        jax.random.normal(key, (7,), jnp.bfloat16),
        jnp.zeros((0, 3)),
    )
    return State(
        params,
        optax.adam(1e-3).init(params),
        jax.random.split(key, 3),
        jax.random.key(seed, impl="rbg"),
        jax.random.PRNGKey(seed),
        {"steps": jnp.int32(seed), "full": jnp.array([True, False])},
    )


def as_bytes(state: Any) -> list[tuple]:
    leaves = []
    for leaf in jax.tree.leaves(state):
        kind = str(leaf.dtype)
        data = jax.random.key_data(leaf) if kind.startswith("key") else leaf
        leaves.append((kind, leaf.shape, np.asarray(data).tobytes()))
    return leaves


def fail(message: str) -> None:
    raise AssertionError(f"unexpected warning: {message}")


def restore(directory: Path, template: Any = None, **options):
    """Restores and returns the warnings too."""
    warnings: list[str] = []
    template = make_state(0) if template is None else template
    found = checkpoint.restore(directory, template, warn=warnings.append, **options)
    return found, warnings


def save_two(directory: Path) -> Path:
    """Saves the steps 1 and 2."""
    for step in (1, 2):
        checkpoint.save(directory, step, make_state(step), {"log": step})
    return directory
