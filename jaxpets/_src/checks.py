"""Checks at the public boundary: what is wrong is said when a thing is built or traced.

Every message names the argument, what was wanted and what came.
"""

import difflib
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeGuard, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

T = TypeVar("T")
_LARGEST = float(np.finfo(np.float32).max)


def check_count(
    name: str, value: Any, minimum: int = 1, maximum: float = math.inf
) -> int:
    """Returns `value`, an integer in `[minimum, maximum]`, as Python's, or raises.

    One of NumPy would overflow where it is small, and promote what it meets.
    """
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        kind = type(value).__name__
        raise TypeError(f"{name} must be a Python int, got {value!r} ({kind}).")
    if value < minimum:
        raise ValueError(f"{name} must be at least {minimum}, got {value}.")
    if value > maximum:
        raise ValueError(f"{name} must be at most {maximum}, got {value}.")
    return int(cast(Any, value))


def is_sequence(values: Any) -> TypeGuard[Sequence[Any]]:
    """Tells whether `values` is a tuple or a list."""
    return isinstance(values, (tuple, list))


def check_counts(name: str, values: Any) -> tuple[int, ...]:
    """Returns a tuple or list of positive Python integers as a tuple, or raises."""
    if not is_sequence(values):
        raise TypeError(f"{name} must be a tuple of ints, got {values!r}.")
    return tuple(check_count(name, value) for value in values)


def check_flag(name: str, value: Any) -> None:
    """Raises unless `value` is True or False; a traced one cannot choose a program."""
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(f"{name} must be True or False, got {value!r}.")


def check_real(
    name: str, value: Any, low: float, high: float = math.inf, *, above: bool = False
) -> float:
    """Returns `value`, a finite number in `[low, high]`, as a Python number, or raises.

    What float32 does not hold is not finite. A Python number takes the type of what it
    meets; NumPy's of 64 bits would give its own to it under x64. With `above` it must
    be more than low, and has no high.
    """
    if isinstance(value, bool) or not _is_number(value):
        kind = type(value).__name__
        raise TypeError(f"{name} must be a Python float, got {value!r} ({kind}).")
    is_low = value <= low if above else value < low
    if is_low or not (abs(value) <= _LARGEST and value <= high):
        valid = f"in [{low:g}, {high:g}]"
        if high == math.inf:
            valid = f"finite and {'more than' if above else 'at least'} {low:g}"
        raise ValueError(f"{name} must be {valid}, got {value!r}.")
    return value.item() if isinstance(value, (np.float64, np.integer)) else value


def check_scalar(
    name: str, value: Any, low: float, high: float = math.inf
) -> float | Array:
    """Returns `value`, a number in `[low, high]` as `check_real` does, or raises.

    It may be a float32 scalar, which is returned as it is. A traced one is not checked
    for its range: it is what a sweep maps over.
    """
    if not isinstance(value, Array):
        return check_real(name, value, low, high)
    check_array(name, value, [])
    if not isinstance(value, Tracer):
        check_real(name, float(value), low, high)
    return cast(Array, value)


def keep_checked(
    config: Any, name: str, check: Callable[..., Any], *limits: float
) -> None:
    """Has a frozen config keep what a check of one of its fields returns."""
    object.__setattr__(config, name, check(name, getattr(config, name), *limits))


def plain_number(value: Any) -> Any:
    """Returns a number of NumPy, which the checks let in, as JSON can hold it."""
    if isinstance(value, np.generic):
        return cast(Any, value).item()
    raise TypeError(f"{type(value).__name__} is nothing that JSON holds")


def nearest(name: Any, names: Sequence[str]) -> list[str]:
    """Returns the up to three names that are most like what was given, if any is."""
    return difflib.get_close_matches(str(name), names, n=3, cutoff=0.4)


def check_reals(name: str, values: Any, low: float) -> tuple[float, ...]:
    """Returns a tuple or list of finite numbers of at least `low`, or raises."""
    if not is_sequence(values):
        raise TypeError(f"{name} must be a tuple of floats, got {values!r}.")
    return tuple(check_real(name, value, low) for value in values)


def check_record(name: str, value: Any, record: type) -> None:
    """Raises unless `value` is an instance of `record`."""
    if not isinstance(value, record):
        kind = type(value).__name__
        article = "an" if record.__name__[0] in "AEIOU" else "a"
        raise TypeError(f"{name} must be {article} {record.__name__}, got {kind}.")


def check_records(name: str, values: Any, record: type[T]) -> tuple[T, ...]:
    """Returns instances of `record` as a tuple, or raises."""
    if not isinstance(values, Iterable):
        kind = type(values).__name__
        raise TypeError(f"{name} must be a tuple of {record.__name__}, got {kind}.")
    found = tuple(cast(Iterable[T], values))
    for i, value in enumerate(found):
        check_record(f"{name}[{i}]", value, record)
    return found


def check_callable(name: str, value: Any) -> None:
    """Raises unless `value` can be called."""
    if callable(value):
        return
    kind = type(value).__name__
    if hasattr(value, "_fields"):  # of an Ensemble, say: its functions fill a page
        own = ", ".join(x for x in value._fields if callable(getattr(value, x)))
        has = f", whose functions are {own}" if own else ""
        raise TypeError(f"{name} must be a function, got {kind}{has}.")
    raise TypeError(f"{name} must be a function, got {value!r} ({kind}).")


def check_functions(name: str, value: Any, kind: type) -> None:
    """Raises unless `value` is a record of this kind, of functions alone."""
    check_record(name, value, kind)
    for field, function in value._asdict().items():
        check_callable(f"{name}.{field}", function)


def check_text(name: str, value: Any) -> None:
    """Raises unless `value` is a text that says something."""
    if not isinstance(value, str):
        kind = type(value).__name__
        raise TypeError(f"{name} must be a text, got {value!r} ({kind}).")
    if not value:
        raise ValueError(f"{name} must not be empty, got ''.")


def check_like(name: str, value: Any, template: Any) -> None:
    """Raises unless two pytrees agree in structure, shapes and dtypes.

    Args:
      name: of the value.
      value: a pytree of arrays, concrete or traced.
      template: a pytree of arrays or of `jax.ShapeDtypeStruct`s.
    """
    structure = cast(Any, jax.tree.structure(value))
    wanted = cast(Any, jax.tree.structure(template))
    if structure != wanted:
        raise ValueError(f"{name} must have the structure {wanted}, got {structure}.")
    leaves = cast(list[Any], jax.tree_util.tree_leaves_with_path(template))
    for (path, want), got in zip(leaves, jax.tree.leaves(value), strict=True):
        if _aval(got) != _aval(want):
            leaf = f"{name}{jax.tree_util.keystr(path)}"
            raise ValueError(f"{leaf} must be {_aval(want)}, got {_aval(got)}.")


def _is_number(x: Any) -> bool:
    return isinstance(x, (int, float, np.integer, np.floating))


def _is_array(x: Any) -> bool:
    return isinstance(x, (Array, np.ndarray, np.generic, int, float))


def _aval(x: Any) -> str:
    return f"{jnp.result_type(x)}{list(jnp.shape(x))}"


def check_array(name: str, value: Any, shape: Sequence[int | str | None]) -> None:
    """Raises unless `value` is a float32 array of `shape`.

    Entries of `shape` that are None or a letter match any size; a leading "..."
    matches any number of axes.
    """
    text = ", ".join("?" if want is None else str(want) for want in shape)
    if not _is_array(value):
        kind = type(value).__name__
        raise TypeError(f"{name} must be float32[{text}], got {value!r} ({kind}).")
    got = jnp.shape(value)
    wanted = tuple(shape)
    tail = wanted
    if wanted and wanted[0] == "...":
        tail = wanted[1:]
        got_tail = got[len(got) - len(tail) :] if len(got) >= len(tail) else None
    else:
        got_tail = got if len(got) == len(tail) else None
    fits = got_tail is not None and all(
        want == size for want, size in zip(tail, got_tail, strict=True)
        if isinstance(want, int)
    )  # fmt: skip
    dtype = jnp.result_type(value)
    if not fits or dtype != jnp.float32:
        raise ValueError(f"{name} must be float32[{text}], got {dtype}{list(got)}.")


def check_key(name: str, key: Any) -> None:
    """Raises unless `key` is one typed key, as `jax.random.key` makes it."""
    _check_typed(name, key, "a typed key")
    if key.shape != ():
        raise ValueError(
            f"{name} must be a single key, got a batch of shape {key.shape}; "
            "use jax.vmap to map over keys."
        )


def check_keys(name: str, keys: Any, count: int) -> None:
    """Raises unless `keys` are typed keys whose leading axis is `count`."""
    _check_typed(name, keys, "typed keys")
    if keys.shape[:1] != (count,):
        raise ValueError(f"{name} must be {count} keys, got shape {keys.shape}.")


def _check_typed(name: str, key: Any, wanted: str) -> None:
    dtype = getattr(key, "dtype", None)
    if dtype is None or not jnp.issubdtype(dtype, jax.dtypes.prng_key):
        got = repr(key) if dtype is None else str(dtype)
        raise TypeError(f"{name} must be {wanted} from jax.random.key, got {got}.")
