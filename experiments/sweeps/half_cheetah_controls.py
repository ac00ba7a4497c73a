"""An arm of the study that says how much of the paper's objective is the pitch.

The pitch has no bounds: a robot that turns over goes on adding to it, and so members
may come to differ in it by many turns.
"""

from typing import Any

import jax.numpy as jnp

import jaxpets
from jaxpets import rewards
from jaxpets.envs import half_cheetah


def without_pitch(model: jaxpets.Ensemble) -> tuple[Any, jaxpets.RewardData]:
    """`epistemic`, but for the pitch, which has no weight.

    Its gradient is not finite there; a search asks for none.
    """
    weights = jnp.ones((model.obs_size,), jnp.float32)
    no_pitch = weights.at[half_cheetah.PITCH].set(jnp.inf)
    data = jaxpets.RewardData(
        init=lambda key: no_pitch,
        refresh=lambda _, params, dataset: rewards.max_variance(params) * no_pitch,
    )
    return rewards.epistemic, data
