"""What a file of ours says about itself, in JSON, and refusing one that cannot be."""

import json
from collections.abc import Mapping
from typing import Any, NoReturn, cast

import numpy as np

from jaxpets._src import coordinates, tensor_file
from jaxpets._src.checks import check_count, plain_number
from jaxpets._src.ensemble import delta_space
from jaxpets._src.types import ModelSpace

_VERSION = 1
_DELTA, _OWN = "delta", "own"


def metadata(kind: str, texts: Mapping[str, Any]) -> dict[str, str]:
    """Returns the metadata of a file of a kind, `model` or `policy`.

    Raises:
      ValueError: if a text is no JSON.
    """
    found = {"format": f"jaxpets {kind}", "version": str(_VERSION)}
    for name, value in texts.items():
        try:
            found[name] = json.dumps(value, allow_nan=False, default=plain_number)
        except (TypeError, ValueError, RecursionError) as error:
            raise ValueError(f"{name} must be JSON, but is not: {error}.") from error
    return found


def about_of(about: Any) -> dict[str, Any]:
    """Returns what a user says of a file, by name.

    Raises:
      TypeError: if it is no mapping.
    """
    if not isinstance(about, Mapping | None):
        kind = type(about).__name__
        raise TypeError(f"about must be a mapping, got {about!r} ({kind}).")
    return dict(cast(Mapping[str, Any], about or {}))


def check_format(file: tensor_file.TensorFile, *kinds: str) -> None:
    """Refuses a file of none of these kinds, or of a later version."""
    wanted = [f"jaxpets {kind}" for kind in kinds]
    if file.metadata.get("format") not in wanted:
        refuse(file, f"its metadata has no format {' or '.join(map(repr, wanted))}")
    version = file.metadata.get("version", "")
    if not (version.isascii() and version.isdigit() and len(version) < 10):
        refuse(file, f"its version must be a number, got {version!r}")
    if int(version) > _VERSION:
        refuse(
            file,
            f"it is of version {version} of this format, and this jaxpets reads those "
            f"up to {_VERSION}; install a newer jaxpets",
        )


def object_of(file: tensor_file.TensorFile, name: str) -> dict[str, Any]:
    """Returns an object of the metadata."""
    if name not in file.metadata:
        refuse(file, f"its metadata lacks {name!r}")
    try:
        found = json.loads(file.metadata[name], parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        refuse(file, f"{name!r} of its metadata is no JSON: {error}", error)
    if not isinstance(found, dict):
        refuse(file, f"{name!r} of its metadata must be an object, got {found!r}")
    return cast(dict[str, Any], found)


def check_keys(
    file: tensor_file.TensorFile, name: str, found: Any, wanted: tuple[str, ...]
) -> None:
    """Refuses a file with other keys in a place than it must have there."""
    if not isinstance(found, dict) or set(found) != set(wanted):  # pyright: ignore[reportUnknownArgumentType]
        got = ", ".join(map(str, found)) if isinstance(found, dict) else repr(found)  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]
        refuse(file, f"its {name} must have {', '.join(wanted)}, got {got}")


def check_sizes(file: tensor_file.TensorFile, facts: Mapping[str, Any]) -> None:
    """Refuses a file whose sizes are no counts."""
    for name in ("obs_size", "action_size"):
        try:
            check_count(name, facts[name])
        except (TypeError, ValueError) as error:
            refuse(file, str(error), error)


def check_arrays(
    file: tensor_file.TensorFile, wanted: Mapping[str, tuple[int, ...]]
) -> None:
    """Refuses a file unless its arrays are these, of float32 or rounded to float16."""
    for name in sorted(wanted.keys() | file.shapes.keys()):
        got, want = file.shapes.get(name), wanted.get(name)
        if got != want:
            refuse(file, f"{name} must be of shape {want}, got {got}")
        if file.dtypes[name] not in ("float32", "float16"):
            refuse(file, f"{name} must be float32 or float16, got {file.dtypes[name]}")


def space_to_json(space: ModelSpace) -> Any:
    """Returns a space as JSON; functions of a user's own are only named so."""
    if space.coordinates:
        return json.loads(coordinates.to_json(space.coordinates))
    return _DELTA if space == delta_space() else _OWN


def space_from_json(
    file: tensor_file.TensorFile, found: Any, obs_size: int
) -> ModelSpace:
    """Returns the space of a file.

    Raises:
      ValueError: if its functions are its author's own, or it cannot be.
    """
    if found == _DELTA:
        return delta_space()
    if found == _OWN:
        raise ValueError(
            f"the space of {file.path} is its author's own functions, which a file "
            "cannot hold; give the same as space=."
        )
    try:
        rows = coordinates.from_json(json.dumps(found))
        space = coordinates.space(rows)
    except (TypeError, ValueError) as error:
        refuse(file, f"its space cannot be: {error}", error)
    if len(rows) != obs_size:
        refuse(file, f"its space must have {obs_size} entries, got {len(rows)}")
    return space


def check_numbers(where: str, arrays: Mapping[str, np.ndarray]) -> None:
    """Raises for numbers with which a network computes none.

    A range of which nothing was seen has infinite bounds.
    """
    for name, array in arrays.items():
        if np.isnan(array).any():
            raise ValueError(f"{name} of {where} must have no NaN.")
        if name not in ("scaler.low", "scaler.high") and np.isinf(array).any():
            raise ValueError(f"{name} of {where} must be finite.")
        if name.split(".")[-1] == "std" and (array <= 0).any():
            raise ValueError(f"{name} of {where} must be positive.")


def _no_constant(text: str) -> NoReturn:
    raise ValueError(f"{text} is none of its numbers")


def refuse(
    file: tensor_file.TensorFile, reason: str, cause: Exception | None = None
) -> NoReturn:
    """Raises what says why a file cannot be read."""
    raise ValueError(f"{file.path} is no file that can be read: {reason}.") from cause
