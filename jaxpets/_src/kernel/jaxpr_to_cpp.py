"""A function of one particle's numbers, written as JAX, written out as C++.

A rollout kernel steps particles one by one: on a GPU one per thread, on a CPU one per
lane of a vector. The coordinates of a model, its ModelSpace, are JAX functions; this
turns their jaxprs into straight-line code over named scalars. What moves numbers around
(slice, concatenate, reshape, indexing) costs nothing: it only says which name stands
where.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core, source_info_util

from jaxpets._src.kernel.primitives import CALLS, ELEMENTWISE, MOVES, REDUCTIONS

_NAME = re.compile(r"\bv\d+\b|\w+\[\d+\]")  # of a variable, of an argument's entry
_MOST_SAID = 3  # entries in a message


class UnsupportedError(Exception):
    """No kernel: a model does what has no C++ here. The message is one line."""


def cpp_function(
    name: str,
    function: Callable[..., Any],
    sizes: Sequence[tuple[str, int]],
    called: Mapping[str, str] | None = None,
) -> str:
    """Returns C++ for a function of float32 vectors that returns one vector.

    Args:
      name: of the C++ function; its arguments are those of `function`, then `out`,
        which must be none of them: it is written before all of them are read.
      function: JAX code, traceable.
      sizes: name and length of each argument.
      called: what a message is to call entries of the arguments: `{"obs[0]": "speed"}`.

    Raises:
      UnsupportedError: if the function does what has no C++ here: anything but
        arithmetic on elements, moving them, and sums over them. It names what, the
        entries that it is done to, and the line of the code that does it.
    """
    shapes = [jax.ShapeDtypeStruct((size,), jnp.float32) for _, size in sizes]
    closed = jax.make_jaxpr(function)(*shapes)
    writer = _Writer()
    names = [
        np.array([f"{argument}[{i}]" for i in range(size)], dtype=object)
        for argument, size in sizes
    ]
    try:
        (result,) = writer.run(closed.jaxpr, closed.consts, names)
    except UnsupportedError as error:
        outer, inputs = writer.calls[0][0], writer.calls[-1][1]
        entries = [(called or {}).get(x, x) for x in writer.entries(inputs, names)]
        where = f"in {name}{_listed(entries)}{_place(outer)}"
        raise UnsupportedError(f"{error}, {where}") from None
    stores = [
        f"out[{i}] = {_text(value)};" for i, value in enumerate(result.reshape(-1))
    ]
    types = [f"class In{i}" for i in range(len(sizes))]
    arguments = [f"const In{i}& {name}" for i, (name, _) in enumerate(sizes)]
    body = "\n  ".join([*writer.lines, *stores])
    return (
        f"template <{', '.join(types)}, class Out>\n"
        f"PARTICLE_FUNCTION void {name}({', '.join(arguments)}, Out&& out) {{\n"
        f"  {body}\n}}\n"
    )


class _Writer:
    """Walks a jaxpr; arrays hold numbers where known, C++ names where not."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        # Equations that are being written, with their inputs, from outside.
        self.calls: list[tuple[Any, list[np.ndarray]]] = []

    def run(
        self, jaxpr: Any, consts: Sequence[Any], args: Sequence[np.ndarray]
    ) -> list[np.ndarray]:
        known: dict[Any, np.ndarray] = {}

        def read(atom: Any) -> np.ndarray:
            is_number = isinstance(atom, core.Literal)
            return np.asarray(atom.val) if is_number else known[atom]

        known |= dict(zip(jaxpr.constvars, map(np.asarray, consts), strict=True))
        known |= dict(zip(jaxpr.invars, args, strict=True))
        for eqn in jaxpr.eqns:
            inputs = [read(atom) for atom in eqn.invars]
            self.calls.append((eqn, inputs))
            results = self._equation(eqn, inputs)
            self.calls.pop()
            known |= dict(zip(eqn.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def entries(
        self, values: Sequence[np.ndarray], args: Sequence[np.ndarray]
    ) -> list[str]:
        """Returns the names among `args` of what values were computed from."""
        found = {x for array in values for x in array.reshape(-1).tolist()}
        for line in reversed(self.lines):
            name, *read = _NAME.findall(line)
            if name in found:
                found.update(read)
        return [name for names in args for name in names if name in found]

    def _equation(self, eqn: Any, inputs: list[np.ndarray]) -> list[np.ndarray]:
        name = eqn.primitive.name
        if name in CALLS:
            inner = eqn.params.get("jaxpr") or eqn.params.get("call_jaxpr")
            return self.run(inner.jaxpr, inner.consts, inputs)
        if all(array.dtype != object for array in inputs):
            return _bind(eqn, inputs)
        if name in MOVES:
            return _move(eqn, inputs)
        return [self._compute(eqn, inputs)]

    def _compute(self, eqn: Any, inputs: list[np.ndarray]) -> np.ndarray:
        name = eqn.primitive.name
        if name == "convert_element_type":
            return self._convert(eqn, inputs[0])
        if name == "integer_pow":
            return self._power(inputs[0], eqn.params["y"])
        if name in REDUCTIONS:
            return self._reduce(eqn, inputs[0])
        if name == "select_n" and len(inputs) > 3:
            raise UnsupportedError("a choice among more than two has no C++ form")
        if name in ELEMENTWISE:
            return self._elementwise(name, eqn.outvars[0].aval, inputs)
        raise UnsupportedError(f"the primitive {name!r} has no C++ form")

    def _assign(self, kind: str, expression: str) -> str:
        name = f"v{len(self.lines)}"
        self.lines.append(f"const {kind} {name} = {expression};")
        return name

    def _elementwise(
        self, name: str, aval: Any, inputs: list[np.ndarray]
    ) -> np.ndarray:
        kind = _kind(aval.dtype)
        result = np.empty(aval.shape, dtype=object)
        operands = [np.broadcast_to(array, aval.shape) for array in inputs]
        for index in np.ndindex(aval.shape):
            texts = [_text(operand[index]) for operand in operands]
            result[index] = self._assign(kind, ELEMENTWISE[name].format(*texts))
        return result

    def _convert(self, eqn: Any, array: np.ndarray) -> np.ndarray:
        kind = _kind(eqn.params["new_dtype"])
        if kind == _kind(eqn.invars[0].aval.dtype):
            return array
        result = np.empty(array.shape, dtype=object)
        for index in np.ndindex(array.shape):
            result[index] = self._assign(kind, f"({kind})({_text(array[index])})")
        return result

    def _power(self, array: np.ndarray, exponent: int) -> np.ndarray:
        result = np.empty(array.shape, dtype=object)
        for index in np.ndindex(array.shape):
            product = " * ".join([_text(array[index])] * abs(exponent)) or "1.0f"
            text = f"(1.0f / ({product}))" if exponent < 0 else product
            result[index] = self._assign("float", text)
        return result

    def _reduce(self, eqn: Any, array: np.ndarray) -> np.ndarray:
        axes = tuple(eqn.params["axes"])
        kept = [axis for axis in range(array.ndim) if axis not in axes]
        count = math.prod(array.shape[axis] for axis in axes)
        result = np.empty(eqn.outvars[0].aval.shape, dtype=object)
        moved = array.transpose(*kept, *axes).reshape(*result.shape, count)
        name, of_nothing = REDUCTIONS[eqn.primitive.name]
        expression = ELEMENTWISE[name]
        for index in np.ndindex(result.shape):
            total, *rest = map(_text, moved[index] if count else [of_nothing])
            for text in rest:
                total = self._assign("float", expression.format(total, text))
            result[index] = total
        return result


def _bind(eqn: Any, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Runs a primitive on numbers, now."""
    with jax.ensure_compile_time_eval():
        results = eqn.primitive.bind(*[jnp.asarray(x) for x in inputs], **eqn.params)
    results = results if eqn.primitive.multiple_results else [results]
    return [np.asarray(result) for result in results]


def _move(eqn: Any, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Runs a primitive on the positions of elements and looks the elements up."""
    pool: list[Any] = []
    places: list[np.ndarray] = []
    for array, atom in zip(inputs, eqn.invars, strict=True):
        if jnp.issubdtype(atom.aval.dtype, jnp.integer):
            places.append(array)  # where to read, not what
            continue
        first = len(pool)
        pool.extend(array.reshape(-1))
        places.append(np.arange(first, len(pool), dtype=np.int32).reshape(array.shape))
    params = dict(eqn.params)
    if eqn.primitive.name == "gather":
        fill = params["fill_value"]  # of what is read past the end
        params["fill_value"] = len(pool)
        pool.append(math.nan if fill is None else fill)
    with jax.ensure_compile_time_eval():
        results = eqn.primitive.bind(*[jnp.asarray(x) for x in places], **params)
    results = results if eqn.primitive.multiple_results else [results]
    values = np.empty(len(pool), dtype=object)
    values[:] = pool
    return [
        values[np.asarray(result).reshape(-1)].reshape(result.shape)
        for result in results
    ]


def _place(eqn: Any) -> str:
    """Returns where an equation stands in the code, unless that is here."""
    found = re.match(r"(.+?):(\d+)", source_info_util.summarize(eqn.source_info))
    if not found or found[1] == __file__:
        return ""
    return f" ({Path(found[1]).name}:{found[2]})"


def _listed(entries: Sequence[str]) -> str:
    """Returns the first of a message's entries, and how many more there are."""
    if not entries:
        return ""
    names = list(dict.fromkeys(entries))
    if len(names) > _MOST_SAID:
        names[_MOST_SAID:] = [f"{len(names) - _MOST_SAID} more"]
    *first, last = names
    return f" of {', '.join(first)}{' and ' if first else ''}{last}"


def _kind(dtype: Any) -> str:
    if dtype == jnp.bool_:
        return "bool"
    if dtype == jnp.float32:
        return "float"
    raise UnsupportedError(f"values of type {dtype} have no C++ form")


def _text(value: Any) -> str:
    """Returns a C++ name or literal."""
    if isinstance(value, str):
        return value
    if isinstance(value, (bool, np.bool_)):
        return "true" if value else "false"
    number = float(value)
    if math.isnan(number):
        return "NAN"
    if math.isinf(number):
        return "INFINITY" if number > 0 else "(-INFINITY)"
    text = float(np.float32(number)).hex()
    return f"({text}f)" if number < 0 else f"{text}f"
