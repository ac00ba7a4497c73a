"""Pytrees of arrays as flat dictionaries of NumPy arrays, and back.

On disk neither a state's devices nor its pytree classes matter: a leaf has a path,
such as `params/w1`, a shape, a dtype and, if it is a typed key, an implementation.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class Leaf(NamedTuple):
    """The type of one leaf; `key` is the PRNG implementation of a typed key."""

    shape: tuple[int, ...]
    dtype: str
    key: str | None


def _named_leaves(tree: Any) -> dict[str, Any]:
    """Returns the leaves by path, such as `params/w1`, in the tree's order."""
    named = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        name = jax.tree_util.keystr(path, simple=True, separator="/") or "state"
        if name in named:
            raise ValueError(f"two leaves of the state are called {name!r}")
        if not isinstance(leaf, jax.Array | np.ndarray | jax.ShapeDtypeStruct):
            raise TypeError(f"{name} is a {type(leaf).__name__}, want a jax array")
        named[name] = leaf
    return named


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _key_impl(leaf: Any) -> str:
    """Returns the implementation of a key that may be abstract."""
    found = []
    jax.eval_shape(lambda key: found.append(str(jax.random.key_impl(key))), leaf)
    return found[0]


def _describe(leaf: Any) -> Leaf:
    if not _is_key(leaf):
        return Leaf(tuple(leaf.shape), str(leaf.dtype), None)
    data = jax.eval_shape(jax.random.key_data, leaf)
    return Leaf(tuple(data.shape), str(data.dtype), _key_impl(leaf))


def describe(tree: Any) -> dict[str, Leaf]:
    """Returns the type of every leaf by path; keys are described by their data."""
    return {name: _describe(leaf) for name, leaf in _named_leaves(tree).items()}


def to_host(tree: Any) -> dict[str, np.ndarray]:
    """Copies every leaf to the host, keys as their data."""
    raw = {
        name: jax.random.key_data(leaf) if _is_key(leaf) else leaf
        for name, leaf in _named_leaves(tree).items()
    }
    return {name: np.asarray(leaf) for name, leaf in jax.device_get(raw).items()}


def _place(array: np.ndarray, like: Any) -> jax.Array:
    """Puts one leaf where `like` lives; a copy, because jax may alias NumPy memory."""
    leaf = jnp.array(array, copy=True)
    if _is_key(like):
        leaf = jax.random.wrap_key_data(leaf, impl=_key_impl(like))
    pinned = getattr(like, "committed", True) and like.sharding is not None
    leaf = jax.device_put(leaf, like.sharding) if pinned else leaf
    if leaf.dtype != like.dtype:
        raise TypeError(f"jax made {leaf.dtype} of {like.dtype}; is x64 on?")
    return leaf


def from_host(arrays: Mapping[str, np.ndarray], template: Any) -> Any:
    """Rebuilds a pytree like `template`, on its devices, from `to_host` arrays."""
    leaves = [_place(arrays[n], like) for n, like in _named_leaves(template).items()]
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


def non_finite(tree: Any) -> str | None:
    """Names the first float leaf of `tree` that is not finite, or returns None."""
    for name, array in to_host(tree).items():
        if jnp.issubdtype(array.dtype, jnp.inexact):
            bad = array.size - int(np.isfinite(array).sum())
            if bad:
                return f"{name}: {bad} of {array.size} values are not finite"
    return None
