"""The model and the networks beside it that a stopped run has saved."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxpets.policies import ActorCriticParams

from .build import State
from .storage.folder import RunFolder


def restored(run: RunFolder, form: State) -> State | None:
    """Returns what the run has saved, or None.

    Networks from before values could be squashed are read: theirs are not.

    Args:
      run: that was stopped.
      form: of what it saves, as shapes; its reward data may be ActorCriticParams.
    """
    if not isinstance(form.reward, ActorCriticParams):
        found = run.restore(form)
        return found and found[1]

    def saved(leaves: Mapping[str, Any]) -> State:
        if "reward/squash" in leaves:
            return form
        return form._replace(reward=form.reward._replace(squash=None))

    if (found := run.restore(saved)) is None:
        return None
    networks = found[1].reward
    if networks.squash is None:
        networks = networks._replace(squash=np.zeros_like(networks.scale))
    return found[1]._replace(reward=networks)
