"""Networks that a stopped run has saved come back, those of an older version too."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from experiments.kept_networks import restored
from experiments.storage import checkpoint
from experiments.storage.folder import RunFolder
from jaxpets.policies import ActorCriticParams
from jaxpets.typing import LearnerState

SCALE = np.array([0.5, 2.0], np.float32)
NETWORKS = ActorCriticParams(
    {"w": np.ones((2, 3), np.float32)}, {"w": np.ones((2, 2), np.float32)},
    np.zeros((2, 4), np.float32), np.ones((2, 4), np.float32), SCALE, 10.0 * SCALE,
)  # fmt: skip
STATE = LearnerState({"m": np.arange(3.0, dtype=np.float32)}, None, None, NETWORKS)
FORM = jax.eval_shape(lambda: jax.tree.map(jnp.asarray, STATE))


def test_a_run_that_saved_nothing_has_none(tmp_path):
    assert restored(RunFolder(tmp_path), FORM) is None


@pytest.mark.parametrize("squash", [NETWORKS.squash, None])
def test_networks_come_back(tmp_path, squash):
    saved = STATE._replace(reward=NETWORKS._replace(squash=squash))
    checkpoint.save(tmp_path / "checkpoints", 3, saved, {})
    found = restored(RunFolder(tmp_path), FORM)
    wanted = np.zeros_like(SCALE) if squash is None else squash
    toys.assert_trees_close(
        found, saved._replace(reward=NETWORKS._replace(squash=wanted)), rtol=0
    )


def test_a_model_alone_comes_back(tmp_path):
    saved = STATE._replace(reward=None)
    checkpoint.save(tmp_path / "checkpoints", 3, saved, {})
    found = restored(RunFolder(tmp_path), FORM._replace(reward=None))
    toys.assert_trees_close(found, saved, rtol=0)
