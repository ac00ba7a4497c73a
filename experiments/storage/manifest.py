"""The record beside the arrays of a checkpoint: their types, checksums, and origin.

Orbax restores an array with a flipped bit, casts a dtype and pads a shape without a
word about which leaf it was, so a checkpoint is compared by this record first.
"""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

import jaxpets
from experiments.storage.pytrees import Leaf

SCHEMA = 1


def digest(array: np.ndarray) -> str:
    """Returns the SHA-256 of an array's bytes."""
    flat = np.ascontiguousarray(array).reshape(-1)
    return hashlib.sha256(flat.view(np.uint8).data).hexdigest()


def manifest(
    step: int,
    leaves: Mapping[str, Leaf],
    arrays: Mapping[str, np.ndarray],
    meta: Mapping[str, Any],
) -> dict[str, Any]:
    """Returns the record of a step: JSON values only, no NaN."""
    body = {
        "schema": SCHEMA,
        "jaxpets": jaxpets.__version__,
        "step": step,
        "leaves": {
            name: {**leaf._asdict(), "sha256": digest(arrays[name])}
            for name, leaf in leaves.items()
        },
        "meta": dict(meta),
    }
    return json.loads(json.dumps(body, allow_nan=False))


def stored_leaves(body: Mapping[str, Any]) -> dict[str, Leaf]:
    """Returns the types of the leaves in a record."""
    return {
        name: Leaf(tuple(entry["shape"]), entry["dtype"], entry["key"])
        for name, entry in body["leaves"].items()
    }


def misfit(
    body: Mapping[str, Any], wanted: Mapping[str, Leaf], *, part: bool = False
) -> str | None:
    """Says in one line why a record does not fit the wanted leaves, or returns None.

    Args:
      body: the record.
      wanted: leaves by path.
      part: whether the record may have leaves beside the wanted ones.
    """
    writer = f"written by jaxpets {body['jaxpets']}, schema {body['schema']}"
    if body["schema"] != SCHEMA:
        return (
            f"cannot be read ({writer}; this is jaxpets {jaxpets.__version__}, schema "
            f"{SCHEMA}). Use the version that wrote it."
        )
    stored = stored_leaves(body)
    if part:
        stored = {name: leaf for name, leaf in stored.items() if name in wanted}
    lines = _differences(stored, wanted)
    if not lines:
        return None
    more = f"; and {len(lines) - 3} more" if len(lines) > 3 else ""
    return (
        f"does not fit this run ({writer}): {'; '.join(lines[:3])}{more}. Use the same "
        "config or another run directory."
    )


def _differences(stored: Mapping[str, Leaf], wanted: Mapping[str, Leaf]) -> list[str]:
    lines = [f"it lacks {name}" for name in wanted if name not in stored]
    lines += [f"{name} is not in this run" for name in stored if name not in wanted]
    for name, now in wanted.items():
        was = stored.get(name, now)
        if was.key != now.key:
            lines.append(_differs(name, "key", was.key or "raw", now.key or "raw"))
        elif was.shape != now.shape:
            lines.append(_differs(name, "shape", was.shape, now.shape))
        elif was.dtype != now.dtype:
            lines.append(_differs(name, "dtype", was.dtype, now.dtype))
    return lines


def _differs(name: str, what: str, was: Any, now: Any) -> str:
    return f"{name} has {what} {was} (checkpoint) vs {now} (now)"
