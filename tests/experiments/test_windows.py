"""Where the windows of consecutive transitions are, and a draw of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxpets
from experiments.tools import windows

K = 10  # transitions of a window


def recorded(num_trials=5, length=20, seeds=2):
    """Trials whose observations count on, with a step of 100 between trials."""
    row = np.arange(num_trials * length)
    obs = jnp.asarray(row + 100.0 * (row // length), jnp.float32)
    obs = jnp.broadcast_to(obs[:, None], (seeds, len(row), 1))
    return jaxpets.Transition(obs, obs + 0.5, obs + 1)


def by_loop(data, first, size, length, num_steps):
    """The same as starts_of, of one seed, as one would say it."""
    starts = np.zeros(len(data.obs), bool)
    for i in range(first, size - num_steps + 1):
        rows = np.arange(i, i + num_steps)
        is_one_trial = len(set(rows // length)) == 1
        follows = np.all(data.next_obs[rows[:-1]] == data.obs[rows[1:]])
        starts[i] = is_one_trial and follows
    return starts


@pytest.mark.parametrize("num_steps", [1, 2, 7, 20, 21])
def test_a_window_is_of_one_trial_and_one_run_of_rows(num_steps):
    """Although nothing but the place tells the second trial from the third."""
    data = recorded()
    shift = jnp.where(jnp.arange(100) >= 40, 100.0, 0.0)[:, None]
    data = data._replace(obs=data.obs - shift, next_obs=data.next_obs - shift)
    # A trial of the first seed that began anew, and one row that is not finite.
    obs = data.obs.at[0, 47:60].add(500.0).at[0, 70].set(jnp.nan)
    data = data._replace(obs=obs, next_obs=data.next_obs.at[0, 47:60].add(500.0))
    found = np.asarray(windows.starts_of(data, 20, 96, 20, num_steps))
    for i in range(2):
        own = jax.tree.map(lambda x, i=i: np.asarray(x[i]), data)
        want = by_loop(own, 20, 96, 20, num_steps)
        np.testing.assert_array_equal(found[i], want)
    assert found.any() == (num_steps <= 20)


def test_a_draw_is_of_different_windows_and_always_the_same():
    data = recorded(seeds=3)
    starts = windows.starts_of(data, 20, 80, 20, K)
    drawn = windows.draw(data, (0, 5, 2**32 - 1), starts, K, 30)
    again = windows.draw(data, (0, 5, 2**32 - 1), starts, K, 30)
    jax.tree.map(np.testing.assert_array_equal, drawn, again)
    assert drawn.obs.shape == (3, 30, K, 1)
    np.testing.assert_array_equal(drawn.next_obs[:, :, :-1], drawn.obs[:, :, 1:])
    np.testing.assert_array_equal(drawn.action, drawn.obs + 0.5)
    for own in drawn.obs:
        assert len(np.unique(own[:, 0])) == 30
    assert (drawn.obs[0] != drawn.obs[1]).any()
    # A seed's draw does not depend on the seeds beside it.
    one = jax.tree.map(lambda x: x[1:2], data)
    alone = windows.draw(one, (5,), starts[1:2], K, 30)
    np.testing.assert_array_equal(alone.obs[0], drawn.obs[1])
