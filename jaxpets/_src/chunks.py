"""Candidates in chunks: less memory, and the values of all candidates at once."""

import math
from collections.abc import Callable
from typing import cast

import jax
import jax.numpy as jnp
from jax import Array
from jax.extend.random import define_prng_impl, threefry2x32_p

_THREEFRY = "threefry2x32"
WINDOW = "fry_window"  # the implementation of keys that draw for some candidates


def chunked(
    objective_fn: Callable[[Array, Array], Array], chunk_size: int
) -> Callable[[Array, Array], Array]:
    """Makes an objective look at no more than `chunk_size` candidates at a time.

    Args:
      objective_fn: an ObjectiveFn that draws noise as `window` allows.
      chunk_size: the most candidates in a chunk.

    Returns:
      The same ObjectiveFn, with the same values; its chunks follow one another.
    """

    def objective(key: Array, actions: Array) -> Array:
        total = actions.shape[0]
        num_chunks = -(-total // chunk_size)
        if num_chunks <= 1:
            return objective_fn(key, actions)
        count = -(-total // num_chunks)

        def chunk(i: Array, values: Array) -> Array:
            # All are equally long; the last one repeats the end of the one before.
            first = jnp.minimum(i * count, total - count)
            part = jax.lax.dynamic_slice_in_dim(actions, first, count)
            value = objective_fn(window(key, first, count, total), part)
            return jax.lax.dynamic_update_slice_in_dim(values, value, first, 0)

        values = jnp.zeros((total,), jnp.float32)
        return cast(Array, jax.lax.fori_loop(0, num_chunks, chunk, values))

    return objective


def window(key: Array, first: Array, count: int, total: int) -> Array:
    """Returns a key that draws the noise of `count` of `total` candidates.

    With P rows per candidate, a draw of `[E, count * P, ...]` from the window equals
    rows `first * P` to `(first + count) * P` of the draw of `[E, total * P, ...]` from
    `key`, and the rest is not drawn. The same holds for keys split or folded from it.
    Partitionable threefry makes element i of a draw from the key and i alone, so all
    that a window changes is how it counts.

    Args:
      key: a single typed key of JAX's default kind.
      first: `[]` int32, the first candidate.
      count: candidates in the window.
      total: candidates in all.

    Returns:
      A key whose data are `[4]` uint32: those of `key`, `first` and `total`.

    Raises:
      ValueError: if `key` is not partitionable threefry; and from a draw, when it is
        compiled, that is not of rows or would have over 2^32 elements as a whole.
    """
    name = str(jax.random.key_impl(key))
    partitionable = bool(jax.config.jax_threefry_partitionable)  # pyright: ignore
    if name != _THREEFRY or not partitionable:
        raise ValueError(
            "candidates in chunks need keys of partitionable threefry2x32, got "
            f"{name}, jax_threefry_partitionable={partitionable}."
        )

    def random_bits(data: Array, bit_width: int, shape: tuple[int, ...]) -> Array:
        if bit_width > 32 or len(shape) < 2 or shape[1] % count:
            raise ValueError(
                f"noise for {count} of {total} candidates must have at most 32 bits "
                f"and shape [E, B, ...] with B a multiple of {count}, got "
                f"{bit_width} bits and {list(shape)}."
            )
        size = shape[1] // count * math.prod(shape[2:])  # of one candidate and member
        if shape[0] * total * size > 2**32:
            raise ValueError(
                f"noise for {total} candidates must have at most 2^32 elements, got "
                f"{shape[0] * total * size}."
            )
        here = jax.lax.iota(jnp.uint32, math.prod(shape)).reshape(shape)
        member = jax.lax.broadcasted_iota(jnp.uint32, shape, 0)
        index = here + (member * jnp.uint32(total - count) + data[2]) * jnp.uint32(size)
        zeros = jnp.zeros(shape, jnp.uint32)
        high, low = cast(
            list[Array], threefry2x32_p.bind(data[0], data[1], zeros, index)
        )
        return (high ^ low).astype(f"uint{bit_width}")

    window_of_threefry = define_prng_impl(
        key_shape=(4,),
        seed=lambda seed: jnp.zeros((4,), jnp.uint32),  # never: they are cut from keys
        split=_split,
        random_bits=random_bits,
        fold_in=_fold_in,
        name="threefry2x32_window",
        tag=WINDOW,
    )
    place = jnp.stack([jnp.asarray(first, jnp.uint32), jnp.uint32(total)])
    data = jnp.concatenate([jax.random.key_data(key), place])
    return jax.random.wrap_key_data(data, impl=window_of_threefry)  # pyright: ignore


def _split(data: Array, shape: tuple[int, ...]) -> Array:
    keys = jax.random.key_data(jax.random.split(_whole(data), shape))
    return jnp.concatenate([keys, jnp.broadcast_to(data[2:], (*shape, 2))], axis=-1)


def _fold_in(data: Array, number: Array | int) -> Array:
    folded = jax.random.key_data(jax.random.fold_in(_whole(data), number))
    return jnp.concatenate([folded, data[2:]])


def _whole(data: Array) -> Array:
    return cast(Array, jax.random.wrap_key_data(data[:2], impl=_THREEFRY))
