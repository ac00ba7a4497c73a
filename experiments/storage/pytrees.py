"""Pytrees of arrays as flat dictionaries of NumPy arrays, and back.

On disk neither a state's devices nor its pytree classes matter: a leaf has a path,
such as `params/w1`, a shape, a dtype and, if it is a typed key, an implementation.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..parallel import distributed


def describe(tree: Any) -> dict[str, dict[str, Any]]:
    """Returns `shape`, `dtype` and `key` of every leaf by path, as JSON values.

    A typed key is described by its data; `key` is its implementation, else None.
    """
    found = {}
    for name, leaf in _named_leaves(tree).items():
        raw = jax.eval_shape(jax.random.key_data, leaf) if _is_key(leaf) else leaf
        key = _key_impl(leaf) if _is_key(leaf) else None
        found[name] = {"shape": list(raw.shape), "dtype": str(raw.dtype), "key": key}
    return found


def differences(
    stored: Mapping[str, Any], wanted: Mapping[str, Any], *, part: bool
) -> list[str]:
    """Returns a line per leaf that differs; with `part` more may be stored."""
    lines = [f"it lacks {name}" for name in wanted if name not in stored]
    if not part:
        lines += [f"{name} is not in this run" for name in stored if name not in wanted]
    for name in (name for name in wanted if name in stored):
        for what in ("key", "shape", "dtype"):
            was, now = stored[name][what], wanted[name][what]
            if was != now:
                shown = tuple if what == "shape" else lambda x: x or "raw"
                was, now = shown(was), shown(now)
                lines.append(f"{name} has {what} {was} (checkpoint) vs {now} (now)")
                break
    return lines


def to_host(tree: Any) -> dict[str, np.ndarray]:
    """Copies every leaf to the host, keys as their data."""
    leaves = _named_leaves(tree)
    raw = {n: jax.random.key_data(x) if _is_key(x) else x for n, x in leaves.items()}
    return {name: np.asarray(leaf) for name, leaf in jax.device_get(raw).items()}


def from_host(arrays: Mapping[str, np.ndarray], template: Any) -> Any:
    """Rebuilds a pytree like `template`, on its devices, from `to_host` arrays."""
    leaves = [_placed(arrays[n], like) for n, like in _named_leaves(template).items()]
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


def non_finite(tree: Any) -> str | None:
    """Names the first float leaf of `tree` that is not finite, or returns None."""
    for name, array in to_host(tree).items():
        if jnp.issubdtype(array.dtype, jnp.inexact) and not np.isfinite(array).all():
            bad = array.size - int(np.isfinite(array).sum())
            return f"{name}: {bad} of {array.size} values are not finite"
    return None


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


def _placed(array: np.ndarray, like: Any) -> jax.Array:
    """Puts one leaf where `like` lives; a copy, because jax may alias NumPy memory."""
    leaf = jnp.array(array, copy=True)
    if _is_key(like):
        leaf = jax.random.wrap_key_data(leaf, impl=_key_impl(like))
    if getattr(like, "committed", True) and like.sharding is not None:
        leaf = jax.device_put(leaf, like.sharding)
    if leaf.dtype != like.dtype:
        raise TypeError(f"jax made {leaf.dtype} of {like.dtype}; is x64 on?")
    return leaf


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _key_impl(leaf: Any) -> str:
    """Returns the implementation of a key that may be abstract."""
    found = []
    jax.eval_shape(lambda key: found.append(str(jax.random.key_impl(key))), leaf)
    return found[0]


def shared(state: Any, template: Any) -> Any:
    """Gives every process the state that process 0 has read."""
    if distributed.is_alone():
        return state
    arrays = {
        name: np.zeros(leaf["shape"], jnp.dtype(leaf["dtype"]))
        for name, leaf in describe(template).items()
    }
    if state is not None:
        arrays = to_host(state)
    return from_host(distributed.share(arrays), template)
