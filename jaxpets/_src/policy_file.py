"""A policy as one file, which whoever reads it need not trust."""

import os
from collections.abc import Mapping
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxpets._src import dataset, file_facts, tensor_file
from jaxpets._src.action_box import ActionBox, action_box
from jaxpets._src.actor_critic_networks import Networks, build_networks, layers_of
from jaxpets._src.actor_critic_records import ActorCriticParams, Goals
from jaxpets._src.check_space import check_space_size
from jaxpets._src.checks import check_count, check_like, check_record
from jaxpets._src.types import ModelSpace, Planner

_KIND = "policy"
_NO_GOALS = Goals()


def save_policy(
    path: str | os.PathLike[str],
    params: ActorCriticParams,
    space: ModelSpace,
    *,
    obs_size: int,
    action_low: ArrayLike,
    action_high: ArrayLike,
    about: Mapping[str, Any] | None = None,
) -> None:
    """Writes a policy of `distill` or `policies.actor_critic` to one file.

    It holds arrays and JSON in the format of safetensors, nothing that is run.

    Args:
      path: of the file, by custom `*.safetensors`; one that is there is replaced.
      params: of the policy.
      space: that it was built with; functions of your own are not saved.
      obs_size: D, likewise.
      action_low: `[A]`, likewise.
      action_high: `[A]`.
      about: anything else that JSON can hold, for `models.about`; by custom as of a
        model, and "tasks".

    Raises:
      TypeError, ValueError: if an argument is not what it should be, or has NaN, or
        space has another size than obs_size.
    """
    check_space_size(space, obs_size)
    box = action_box(action_low, action_high)
    kernel = layers_of(params)["Dense_0"]["kernel"]  # [F + G, hidden]
    networks = build_networks(kernel.shape[-1], space, _NO_GOALS, box)
    template = _template(networks, space, obs_size, box, kernel.shape[0])
    check_like("params", params, template)
    arrays = {name: np.asarray(x) for name, x in tensor_file.named(params).items()}
    file_facts.check_numbers("params", arrays)
    facts = {
        "space": file_facts.space_to_json(space),
        "obs_size": obs_size,
        "action_low": np.asarray(box.low).tolist(),
        "action_high": np.asarray(box.high).tolist(),
    }
    texts = {_KIND: facts, "about": file_facts.about_of(about)}
    tensor_file.write(path, arrays, file_facts.metadata(_KIND, texts))


def load_policy(
    path: str | os.PathLike[str],
    *,
    goals: Goals = _NO_GOALS,
    space: ModelSpace | None = None,
) -> tuple[Planner, ActorCriticParams]:
    """Reads a policy that `save_policy` wrote; a stranger's file is read or refused.

    Args:
      path: of the file.
      goals: that it was built with; a file cannot hold its functions. Without them a
        policy of a family of tasks raises a ValueError when it acts.
      space: likewise, of one whose features are functions of your own.

    Returns:
      A Planner that acts by the policy, whose `PlanParams.reward` is Guided, and its
      params.

    Raises:
      FileNotFoundError: if there is no such file.
      TypeError: if goals or space are something else.
      ValueError: naming what is wrong with the file, or if space has another size.
    """
    check_record("goals", goals, Goals)
    if space is not None:
        check_record("space", space, ModelSpace)
    file = tensor_file.read(path)
    file_facts.check_format(file, _KIND)
    facts = file_facts.object_of(file, _KIND)
    names = ("space", "obs_size", "action_low", "action_high")
    file_facts.check_keys(file, _KIND, facts, names)
    try:
        check_count("obs_size", facts["obs_size"])
        bounds = (np.asarray(facts[name], np.float32) for name in names[2:])
        box = action_box(*bounds)
    except (TypeError, ValueError, OverflowError) as error:
        file_facts.refuse(file, str(error), error)
    space = space or file_facts.space_from_json(file, facts["space"], facts["obs_size"])
    try:
        check_space_size(space, facts["obs_size"])
    except ValueError as error:
        file_facts.refuse(file, str(error), error)
    first = file.shapes.get("actor.params.Dense_0.kernel", ())
    if len(first) != 2 or 0 in first:
        file_facts.refuse(file, f"its first layer must be of two axes, got {first}")
    networks = build_networks(first[1], space, goals, box)
    template = _template(networks, space, facts["obs_size"], box, first[0])
    names = tensor_file.named(template)
    # Files from before values were squashed do not say that theirs are not.
    added = {"squash": np.zeros(())} if "squash" not in file.shapes else {}
    file_facts.check_arrays(file, {n: names[n].shape for n in names if n not in added})
    arrays = {**file.arrays(), **added}
    file_facts.check_numbers(str(file.path), arrays)
    leaves = [jnp.asarray(arrays[name], jnp.float32) for name in names]
    structure = cast(Any, jax.tree.structure(template))
    return networks.policy, cast(
        ActorCriticParams, jax.tree.unflatten(structure, leaves)
    )


def _template(
    networks: Networks, space: ModelSpace, obs_size: int, box: ActionBox, seen: int
) -> ActorCriticParams:
    """Returns the params of a policy that sees so many numbers, as shapes."""

    def params() -> ActorCriticParams:
        nothing = dataset.init(1, obs_size, box.center.shape[0])
        features = space.features(nothing.data.obs).shape[1]
        goal = jnp.zeros((1, max(seen - features, 0)), jnp.float32)
        return networks.init(jax.random.key(0), goal, nothing)

    return jax.eval_shape(params)
