"""A model as one file: its numbers, its coordinates, and what is said about it."""

import itertools
import os
from collections.abc import Mapping
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxpets._src import file_facts, tensor_file
from jaxpets._src.checks import check_record
from jaxpets._src.ensemble import Ensemble, ensemble, params_check
from jaxpets._src.ensemble_config import EnsembleConfig
from jaxpets._src.ensemble_params import EnsembleParams
from jaxpets._src.network import Precision
from jaxpets._src.types import ModelSpace

_KIND = "model"
_CONFIG = tuple(EnsembleConfig.__dataclass_fields__)


def save_model(
    path: str | os.PathLike[str],
    model: Ensemble,
    params: EnsembleParams,
    *,
    about: Mapping[str, Any] | None = None,
    half: bool = False,
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
      half: whether to round the weights of the networks to float16, in half the room.
        They are read as float32 again.

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
    if half:
        members = jax.tree.map(_halved, params.network.members)
        network = params.network._replace(members=members)
        params = params._replace(network=network)
    arrays = {
        name: np.asarray(array) for name, array in tensor_file.named(params).items()
    }
    file_facts.check_numbers("params", arrays)
    facts = {
        "config": _config_to_json(config),
        "obs_size": model.obs_size,
        "action_size": model.action_size,
        "space": file_facts.space_to_json(space),
    }
    texts = {"model": facts, "about": file_facts.about_of(about)}
    metadata = file_facts.metadata(_KIND, texts)
    tensor_file.write(path, arrays, metadata)


def _halved(weights: Any) -> np.ndarray:
    with np.errstate(over="ignore"):
        rounded = np.asarray(weights).astype(np.float16)
    if np.isinf(rounded).any():
        limit = np.finfo(np.float16).max
        raise ValueError(f"params have weights beyond {limit:g}: not for half.")
    return rounded


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
    space = space or file_facts.space_from_json(file, facts["space"], facts["obs_size"])
    sizes = {name: facts[name] for name in ("obs_size", "action_size")}
    model = ensemble(config, space, **sizes)
    template = jax.eval_shape(model.init, jax.eval_shape(lambda: jax.random.key(0)))
    num_inputs, found = template.scaler.mean.shape[0], file.shapes["scaler.mean"][0]
    if found != num_inputs:  # the one size that only the space knows
        file_facts.refuse(
            file, f"its networks read {found} numbers, but get {num_inputs}"
        )
    arrays = file.arrays()
    file_facts.check_numbers(str(file.path), arrays)
    leaves = [
        jnp.asarray(arrays[name], jnp.float32) for name in tensor_file.named(template)
    ]
    structure = cast(Any, jax.tree.structure(template))
    params = cast(EnsembleParams, jax.tree.unflatten(structure, leaves))
    return model, params


def about(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Returns what `save_model`, or `policies.save_policy`, got as `about`.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it is no model or policy of jaxpets.
    """
    file = tensor_file.read(path)
    file_facts.check_format(file, _KIND, "policy")
    return file_facts.object_of(file, "about")


def _facts(file: tensor_file.TensorFile) -> dict[str, Any]:
    """Returns what a file says about its model, with every key that it must have."""
    file_facts.check_format(file, _KIND)
    facts = file_facts.object_of(file, "model")
    file_facts.check_keys(
        file, "model", facts, ("config", "obs_size", "action_size", "space")
    )
    file_facts.check_sizes(file, facts)
    return facts


def _config_to_json(config: EnsembleConfig) -> dict[str, Any]:
    """Returns a config as JSON; the usual activation is not said, as of old."""
    found = {name: getattr(config, name) for name in _CONFIG}
    if found["activation"] == EnsembleConfig.activation:
        del found["activation"]
    return found | {"precision": config.precision.value}


def _config_from_json(file: tensor_file.TensorFile, found: Any) -> EnsembleConfig:
    if isinstance(found, dict):
        found = {"activation": EnsembleConfig.activation} | cast(Any, found)
    file_facts.check_keys(file, "config", found, _CONFIG)
    values = {name: _tuple(value) for name, value in found.items()}
    try:
        values["precision"] = Precision(values["precision"])
        return EnsembleConfig(**values)
    except (TypeError, ValueError) as error:
        file_facts.refuse(file, f"its config cannot be: {error}", error)


def _tuple(value: Any) -> Any:
    return tuple(cast(list[Any], value)) if isinstance(value, list) else value


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
        file_facts.refuse(file, f"scaler.mean must be of one axis, got {inputs}")
    if facts["action_size"] > inputs[0]:
        file_facts.refuse(
            file, f"action_size must be at most {inputs[0]}, what it reads"
        )
    wanted = {f"scaler.{name}": inputs for name in ("mean", "std")}
    wanted |= {f"scaler.{name}": obs for name in ("low", "high")}
    wanted |= {f"network.{name}": obs for name in ("min_logvar", "max_logvar")}
    widths = (*inputs, *config.hidden_sizes, 2 * facts["obs_size"])
    for i, (before, after) in enumerate(itertools.pairwise(widths)):
        layer = f"network.members.params.layer_{i}"
        wanted[f"{layer}.kernel"] = (*members, before, after)
        wanted[f"{layer}.bias"] = (*members, after)
    file_facts.check_arrays(file, wanted)
