"""What exploration saves: the room for transitions that a learner has."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from experiments import exploration
from experiments.build import build
from experiments.presets import PRESETS
from experiments.storage.folder import RunFolder


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


def test_tasks_need_not_be_those_that_exploration_sought(tmp_path):
    config = dataclasses.replace(PRESETS["smoke"], arm="oracle", engine="mujoco")
    sought = exploration.template(config, build(config))
    whole = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), sought)
    RunFolder(tmp_path).save(3, whole._replace(reward={"of": jnp.ones(2)}))
    form = exploration.learned(config, build(config))
    found = RunFolder(tmp_path).restore_trial(3, form, part=True)
    assert describe(found) == describe(sought._replace(reward=()))
