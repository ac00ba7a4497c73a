"""What exploration saves: the room for transitions that a learner has."""

import dataclasses

import jax
import pytest

from experiments import exploration
from experiments.build import build
from experiments.presets import PRESETS


def describe(tree):
    return jax.tree.map(lambda x: (x.shape, x.dtype), tree)


@pytest.mark.parametrize("arm", ["epistemic", "count", "opax", "rnd", "mixture"])
def test_a_learner_gets_room_for_more_trials(arm):
    """Whatever its reward keeps, it has the form of one that had the room at once."""
    config = dataclasses.replace(
        PRESETS["smoke"], arm=arm, engine="mujoco", seeds=(0, 7)
    )
    longer = dataclasses.replace(config, num_trials=config.num_trials + 2)
    parts = build(config)
    small = exploration.template(config, parts)
    large = exploration.template(longer, build(longer))
    capacity = large.dataset.data.obs.shape[1]
    assert capacity == longer.num_trials * config.trial_length

    def grow(state):
        return exploration.with_room(state, capacity, parts.reward_data)

    assert describe(jax.eval_shape(grow, small)) == describe(large)
    assert grow(large) is large
    # Read with the config of either run, each has the room that it was saved with.
    leaves = {"dataset/data/obs": {"shape": list(large.dataset.data.obs.shape)}}
    found = exploration.as_saved(config, parts)(leaves)
    assert describe(found) == describe(large)
    assert describe(exploration.as_saved(config, parts)({})) == describe(small)
