"""The README's Python runs as it is printed."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

README = Path(__file__).parents[2] / "README.md"


def blocks():
    """Returns the README's Python blocks."""
    return re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)


def test_a_reader_can_plan_with_their_own_model_and_reward():
    names = {}
    exec(blocks()[0], names)
    # 80 steps of 0.1 s with at most 1 N on 1 kg reach and hold each target.
    np.testing.assert_allclose(names["obs"][:, 0], names["targets"], atol=0.02)
    assert names["step"]._cache_size() == 1
    body = [line for line in blocks()[0].splitlines() if line.strip()]
    assert len(body) <= 25


@pytest.mark.slow
def test_the_parts_of_su_pets_fit_together():
    names = {}
    exec(blocks()[1], names)
    planner, params = names["explorer"], names["explore"]
    obs = names["env"].reset(jax.random.key(1)).obs
    key = jax.random.key(2)
    state = planner.init()
    explored, _ = jax.eval_shape(planner.step, params, key, state, obs)
    assert explored.action.shape == (6,)
    axes = (type(params)(None, 0), None, None, None)
    performed, _ = jax.eval_shape(
        jax.vmap(names["actor"].step, axes), names["perform"], key, state, obs
    )
    assert performed.actions.shape == (4, 30, 6)
    assert performed.value.dtype == jnp.float32
