"""A model as one file: its numbers, its coordinates, and what is said about it."""

import itertools
import json
import os
from collections.abc import Mapping
from typing import Any, NoReturn, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxpets._src import coordinates, tensor_file
from jaxpets._src.checks import check_count, check_record
from jaxpets._src.ensemble import Ensemble, delta_space, ensemble, params_check
from jaxpets._src.ensemble_config import EnsembleConfig
from jaxpets._src.ensemble_params import EnsembleParams
from jaxpets._src.network import Precision
from jaxpets._src.types import ModelSpace

_FORMAT = "jaxpets model"
_VERSION = 1
_CONFIG = tuple(EnsembleConfig.__dataclass_fields__)
_DELTA, _OWN = "delta", "own"


def save_model(
    path: str | os.PathLike[str],
    model: Ensemble,
    params: EnsembleParams,
    *,
    about: Mapping[str, Any] | None = None,
) -> None:
    """Writes a model to one file, which whoever reads it need not trust.

    It holds arrays and JSON in the format of safetensors, nothing that is run. Written
    at once, so that whoever reads meanwhile finds the old file or the new one.

    Args:
      path: of the file, by custom `*.safetensors`; one that is there is replaced.
      model: from `jaxpets.ensemble`. If its space is not from `coordinates.space` or
        `delta_space` but functions of your own, these are not saved, and `load_model`
        must get them again.
      params: what it has learned.
      about: anything else that JSON can hold, for `models.about`; by custom
        "environment", "licence", "training" (how it came to be) and "search" (the
        numbers to plan with).

    Raises:
      TypeError, ValueError: if model is no ensemble of `jaxpets.ensemble`, params are
        not its own or have NaN, or `about` is no JSON.
    """
    check_record("model", model, Ensemble)
    config, space = model.config, model.space
    if config is None or space is None:
        raise ValueError(
            "model must be from jaxpets.ensemble; a file cannot hold the functions of "
            "an ensemble of your own."
        )
    params_check(model.init)(params)
    arrays = {
        name: np.asarray(array) for name, array in tensor_file.named(params).items()
    }
    _check_no_nan("params", arrays)
    facts = {
        "config": {name: getattr(config, name) for name in _CONFIG}
        | {"precision": config.precision.value},
        "obs_size": model.obs_size,
        "action_size": model.action_size,
        "space": _space_to_json(space),
    }
    texts = {"model": facts, "about": dict(about or {})}
    metadata = {"format": _FORMAT, "version": str(_VERSION)}
    for name, value in texts.items():
        try:
            metadata[name] = json.dumps(value, allow_nan=False)
        except (TypeError, ValueError, RecursionError) as error:
            raise ValueError(f"{name} must be JSON, but is not: {error}.") from error
    tensor_file.write(path, arrays, metadata)


def load_model(
    path: str | os.PathLike[str], *, space: ModelSpace | None = None
) -> tuple[Ensemble, EnsembleParams]:
    """Reads a model that `save_model` wrote; a stranger's file is read or refused.

    Args:
      path: of the file.
      space: of a model whose coordinates are functions of your own; None for what the
        file has.

    Returns:
      The ensemble and what it has learned.

    Raises:
      FileNotFoundError: if there is no such file.
      TypeError, ValueError: naming what is wrong with it: no safetensors, no model of
        jaxpets, one of a later version, a part that is missing or does not fit.
    """
    file = tensor_file.read(path)
    facts = _facts(file)
    config = _config_from_json(file, facts["config"])
    _check_sizes(file, config, facts)
    space = space or _space_from_json(file, facts["space"], facts["obs_size"])
    sizes = {name: facts[name] for name in ("obs_size", "action_size")}
    model = ensemble(config, space, **sizes)
    template = jax.eval_shape(model.init, jax.eval_shape(lambda: jax.random.key(0)))
    num_inputs, found = template.scaler.mean.shape[0], file.shapes["scaler.mean"][0]
    if found != num_inputs:  # the one size that only the space knows
        _refuse(file, f"its networks read {found} numbers, but get {num_inputs}")
    arrays = file.arrays()
    _check_no_nan(str(file.path), arrays)
    leaves = [jnp.asarray(arrays[name]) for name in tensor_file.named(template)]
    structure = cast(Any, jax.tree.structure(template))
    params = cast(EnsembleParams, jax.tree.unflatten(structure, leaves))
    return model, params


def about(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Returns what `save_model` got as `about`.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it is no model of jaxpets.
    """
    file = tensor_file.read(path)
    _check_format(file)
    return _object(file, "about")


def _space_to_json(space: ModelSpace) -> Any:
    if space.coordinates:
        return json.loads(coordinates.to_json(space.coordinates))
    return _DELTA if space == delta_space() else _OWN


def _space_from_json(
    file: tensor_file.TensorFile, found: Any, obs_size: int
) -> ModelSpace:
    if found == _DELTA:
        return delta_space()
    if found == _OWN:
        raise ValueError(
            f"the space of {file.path} is its author's own functions, which a file "
            "cannot hold; give the same to load_model(path, space=...)."
        )
    try:
        rows = coordinates.from_json(json.dumps(found))
        space = coordinates.space(rows)
    except (TypeError, ValueError) as error:
        _refuse(file, f"its space cannot be: {error}", error)
    if len(rows) != obs_size:
        _refuse(file, f"its space must have {obs_size} entries, got {len(rows)}")
    return space


def _check_format(file: tensor_file.TensorFile) -> None:
    if file.metadata.get("format") != _FORMAT:
        _refuse(file, f"its metadata has no format {_FORMAT!r}")
    version = file.metadata.get("version", "")
    if not (version.isascii() and version.isdigit() and len(version) < 10):
        _refuse(file, f"its version must be a number, got {version!r}")
    if int(version) > _VERSION:
        _refuse(
            file,
            f"it is of version {version} of this format, and this jaxpets reads those "
            f"up to {_VERSION}; install a newer jaxpets",
        )


def _facts(file: tensor_file.TensorFile) -> dict[str, Any]:
    """Returns what a file says about its model, with every key that it must have."""
    _check_format(file)
    facts = _object(file, "model")
    _check_keys(file, "model", facts, ("config", "obs_size", "action_size", "space"))
    for name in ("obs_size", "action_size"):
        try:
            check_count(name, facts[name])
        except (TypeError, ValueError) as error:
            _refuse(file, str(error), error)
    return facts


def _config_from_json(file: tensor_file.TensorFile, found: Any) -> EnsembleConfig:
    _check_keys(file, "config", found, _CONFIG)
    values = {name: _tuple(value) for name, value in found.items()}
    try:
        values["precision"] = Precision(values["precision"])
        return EnsembleConfig(**values)
    except (TypeError, ValueError) as error:
        _refuse(file, f"its config cannot be: {error}", error)


def _tuple(value: Any) -> Any:
    return tuple(cast(list[Any], value)) if isinstance(value, list) else value


def _check_keys(
    file: tensor_file.TensorFile, name: str, found: Any, wanted: tuple[str, ...]
) -> None:
    if not isinstance(found, dict) or set(found) != set(wanted):  # pyright: ignore[reportUnknownArgumentType]
        got = ", ".join(map(str, found)) if isinstance(found, dict) else repr(found)  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]
        _refuse(file, f"its {name} must have {', '.join(wanted)}, got {got}")


def _object(file: tensor_file.TensorFile, name: str) -> dict[str, Any]:
    if name not in file.metadata:
        _refuse(file, f"its metadata lacks {name!r}")
    try:
        found = json.loads(file.metadata[name], parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        _refuse(file, f"{name!r} of its metadata is no JSON: {error}", error)
    if not isinstance(found, dict):
        _refuse(file, f"{name!r} of its metadata must be an object, got {found!r}")
    return cast(dict[str, Any], found)


def _no_constant(text: str) -> NoReturn:
    raise ValueError(f"{text} is none of its numbers")


def _check_sizes(
    file: tensor_file.TensorFile, config: EnsembleConfig, facts: dict[str, Any]
) -> None:
    """Raises unless the arrays are those that the numbers ask for.

    Before anything is built: a number that no array bears out could ask for any memory.
    """
    obs, members = (facts["obs_size"],), (config.num_members,)
    inputs = file.shapes.get("scaler.mean", ())
    wanted: dict[str, tuple[int, ...]]
    if len(inputs) != 1:
        _refuse(file, f"scaler.mean must be of one axis, got {inputs}")
    wanted = {f"scaler.{name}": inputs for name in ("mean", "std")}
    wanted |= {f"scaler.{name}": obs for name in ("low", "high")}
    wanted |= {f"network.{name}": obs for name in ("min_logvar", "max_logvar")}
    widths = (*inputs, *config.hidden_sizes, 2 * facts["obs_size"])
    for i, (before, after) in enumerate(itertools.pairwise(widths)):
        layer = f"network.members.params.layer_{i}"
        wanted[f"{layer}.kernel"] = (*members, before, after)
        wanted[f"{layer}.bias"] = (*members, after)
    for name in sorted(wanted.keys() | file.shapes.keys()):
        got, want = file.shapes.get(name), wanted.get(name)
        if got != want:
            _refuse(file, f"{name} must be of shape {want}, got {got}")
        if file.dtypes[name] != "float32":
            _refuse(file, f"{name} must be float32, got {file.dtypes[name]}")


def _check_no_nan(where: str, arrays: Mapping[str, np.ndarray]) -> None:
    for name, array in arrays.items():
        if np.isnan(array).any():
            raise ValueError(f"{name} of {where} must have no NaN.")


def _refuse(
    file: tensor_file.TensorFile, reason: str, cause: Exception | None = None
) -> NoReturn:
    raise ValueError(f"{file.path} is no model that can be read: {reason}.") from cause
