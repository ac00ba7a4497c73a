"""Coordinates as data: a table of an observation's entries, and the space it means."""

import json
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import check_flag, check_records, nearest, plain_number
from jaxpets._src.types import Coordinate, ModelSpace

KINDS = ("relative", "absolute", "angle", "quaternion")
_FREE = ("angle", "quaternion")
_QUATERNION_SIZE = 4


class _Block(NamedTuple):
    """Neighbours that are treated alike: one angle, one quaternion, a run of others."""

    kind: str
    is_input: bool
    start: int
    stop: int

    def of(self, row: Array) -> Array:
        return row[..., self.start : self.stop]


def space(coordinates: Sequence[Coordinate]) -> ModelSpace:
    """Builds the functions that a table of entries means.

    Features are the inputs in their order: an angle as its sine and cosine, a
    quaternion as the body's x and y axes in the world, six numbers that are equal for
    q and -q, everything else as it is. Targets are changes, but for absolute entries.

    A quaternion's target is `conj(q) * next_q - 1`: the rotation in the body's own
    frame, whose last three numbers are half the rotation vector, to second order. The
    fourth is kept because a target that is always zero has no most likely variance. A
    prediction is `q * (1 + target)`, made unit; so far this stretches nothing, and a
    predicted variance is that of the next observation.

    Args:
      coordinates: the D entries, in the order of the observation.

    Returns:
      A ModelSpace that carries the table along.

    Raises:
      TypeError, ValueError: naming the entry that cannot be, and why.
    """
    rows = check_records("coordinates", coordinates, Coordinate)
    _check(rows)
    blocks = _blocks(rows)
    inputs = [block for block in blocks if block.is_input]
    turning = [block for block in blocks if block.kind == "quaternion"]
    relative = jnp.asarray([row.kind != "absolute" for row in rows], jnp.float32)
    bounded = jnp.asarray([row.is_bounded for row in rows])

    def features(obs: Array) -> Array:
        return jnp.concatenate([x for b in inputs for x in _read(b, obs)], axis=-1)

    def bound(obs: Array, low: Array, high: Array) -> Array:
        low = jnp.where(bounded, low, -jnp.inf)
        return jnp.clip(obs, low, jnp.where(bounded, high, jnp.inf))

    def target(obs: Array, next_obs: Array) -> Array:
        plain = next_obs - relative * obs
        return _put(plain, turning, [_turn(b.of(obs), b.of(next_obs)) for b in turning])

    def next_obs(obs: Array, target: Array) -> Array:
        plain = relative * obs + target
        return _put(plain, turning, [_turned(b.of(obs), b.of(target)) for b in turning])

    return ModelSpace(features, target, next_obs, bound, rows)


def index(coordinates: Sequence[Coordinate], name: str) -> int:
    """Returns where an entry stands in the observation.

    Rewards and plots use it in place of a number: `obs[..., index(rows, "qpos/z")]`.

    Raises:
      TypeError, ValueError: if there is no such entry; the nearest names are said. Or
        if these are no entries, or none.
    """
    rows = check_records("coordinates", coordinates, Coordinate)
    names = [row.name for row in rows]
    if name in names:
        return names.index(name)
    if not names:
        raise ValueError(f"coordinates must have the entry {name!r}, but have none.")
    near = ", ".join(nearest(name, names) or names)
    raise ValueError(f"name must be an entry, as {near}, got {name!r}.")


def table(coordinates: Sequence[Coordinate]) -> str:
    """Returns the entries as text to print, one a line."""
    rows = check_records("coordinates", coordinates, Coordinate)
    width = max((len(row.name) for row in rows), default=0)
    lines = [
        f"{i:3}  {row.name:{width}}  {row.kind:10}"
        f"  {'input' if row.is_input else '':5}  {'bounded' if row.is_bounded else ''}"
        for i, row in enumerate(rows)
    ]
    return "\n".join(line.rstrip() for line in lines)


def to_json(coordinates: Sequence[Coordinate]) -> str:
    """Returns the entries as JSON, a list of objects with the fields of Coordinate."""
    rows = check_records("coordinates", coordinates, Coordinate)
    return json.dumps([row._asdict() for row in rows], default=plain_number)


def from_json(text: str) -> tuple[Coordinate, ...]:
    """Returns the entries that `to_json` wrote.

    Raises:
      TypeError, ValueError: if the text is no such list, or `space` would refuse it.
    """
    try:
        found = json.loads(text)
    except RecursionError as error:
        raise ValueError("text must be a list of objects, got a deeper one.") from error
    fields = set(Coordinate._fields)
    if not isinstance(found, list) or not all(_has(row, fields) for row in found):  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
        wanted = ", ".join(Coordinate._fields)
        raise ValueError(f"text must be a list of objects with {wanted}, got {text!r}.")
    rows = tuple(Coordinate(**row) for row in found)  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
    _check(rows)
    _blocks(rows)
    return rows


def _has(row: Any, fields: set[str]) -> bool:
    return isinstance(row, dict) and set(row) == fields  # pyright: ignore[reportUnknownArgumentType]


def _check(rows: tuple[Coordinate, ...]) -> None:
    seen: set[str] = set()
    for row in rows:
        if not isinstance(row.name, str):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise TypeError(f"names of coordinates must be texts, got {row.name!r}.")
        where = f"of entry {row.name!r}"
        check_flag(f"is_input {where}", row.is_input)
        check_flag(f"is_bounded {where}", row.is_bounded)
        if row.kind not in KINDS:
            wanted = ", ".join(KINDS)
            raise ValueError(f"kind {where} must be one of {wanted}, got {row.kind!r}.")
        if row.kind in _FREE and row.is_bounded:
            raise ValueError(f"is_bounded {where} must be False of kind {row.kind!r}.")
        if row.name in seen:
            raise ValueError(
                f"names of coordinates must differ, got {row.name!r} twice."
            )
        seen.add(row.name)
    if not any(row.is_input for row in rows):
        raise ValueError("coordinates must have an entry that is an input, got none.")


def _blocks(rows: tuple[Coordinate, ...]) -> list[_Block]:
    """Returns the rows in blocks, of which only those of plain numbers are merged."""
    blocks: list[_Block] = []
    start = 0
    while start < len(rows):
        row = rows[start]
        size = _QUATERNION_SIZE if row.kind == "quaternion" else 1
        run = rows[start : start + size]
        if len(run) < size or any(r[1:] != row[1:] for r in run):
            raise ValueError(
                f"a quaternion must be {size} like rows, but they end after "
                f"{row.name!r}."
            )
        kind = row.kind if row.kind in _FREE else "plain"
        last = blocks[-1] if blocks else None
        if last and kind == "plain" and last[:2] == (kind, row.is_input):
            blocks[-1] = last._replace(stop=start + 1)
        else:
            blocks.append(_Block(kind, row.is_input, start, start + size))
        start += size
    return blocks


def _read(block: _Block, obs: Array) -> list[Array]:
    """Returns what the network reads of a block."""
    entry = block.of(obs)
    if block.kind == "angle":
        return [jnp.sin(entry), jnp.cos(entry)]
    if block.kind == "plain":
        return [entry]
    w, x, y, z = jnp.split(entry, _QUATERNION_SIZE, axis=-1)
    forward = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
    left = [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)]
    return forward + left


def _put(row: Array, blocks: list[_Block], values: list[Array]) -> Array:
    """Returns the row with some blocks in place of what stood there."""
    parts: list[Array] = []
    start = 0
    for block, value in zip(blocks, values, strict=True):
        parts += [row[..., start : block.start], value]
        start = block.stop
    return jnp.concatenate([*parts, row[..., start:]], axis=-1) if blocks else row


def _turn(before: Array, after: Array) -> Array:
    """Returns `conj(before) * after - 1`, `[..., 4]`."""
    conjugate = before * jnp.asarray([1.0, -1.0, -1.0, -1.0], jnp.float32)
    return _product(conjugate, after) - _one()


def _turned(before: Array, turn: Array) -> Array:
    """Returns `before * (1 + turn)`, made unit, `[..., 4]`."""
    after = _product(before, _one() + turn)
    # Half a turn against itself would be zero, which has no direction.
    square = jnp.maximum(jnp.sum(after * after, axis=-1, keepdims=True), 1e-12)
    return after / jnp.sqrt(square)


def _one() -> Array:
    return jnp.asarray([1.0, 0.0, 0.0, 0.0], jnp.float32)


def _product(p: Array, q: Array) -> Array:
    """Returns the product of two quaternions, `[..., 4]`."""
    pw, px, py, pz = jnp.split(p, _QUATERNION_SIZE, axis=-1)
    qw, qx, qy, qz = jnp.split(q, _QUATERNION_SIZE, axis=-1)
    parts = [
        pw * qw - px * qx - py * qy - pz * qz,
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
    ]
    return jnp.concatenate(parts, axis=-1)
