"""What holds for any numbers, those that are not finite among them."""

import functools

import hypothesis.extra.numpy as hnp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxpets
from jaxpets import PlanParams
from jaxpets._src.elites import WORST_VALUE, select_elites

# The same examples every time, and time to compile.
settings.register_profile(
    "jaxpets", deadline=None, derandomize=True, database=None, max_examples=50
)
settings.load_profile("jaxpets")

HORIZON = 4
ANY = st.floats(width=32)
FINITE = st.floats(width=32, allow_nan=False, allow_infinity=False)
TABLE = hnp.arrays(np.float32, 16, elements=ANY)
OBS = hnp.arrays(np.float32, 3, elements=ANY)
LOW, HIGH = np.float32([-2.0, 0.5]), np.float32([-1.0, 3.0])


def table_rollout(table, key, obs, actions):
    """Imagines the start and then whatever is in a table, which keys shuffle."""
    shape = (actions.shape[0], HORIZON + 1, 2, 3, 3)
    path = jax.random.choice(key, table, shape)
    return path.at[:, 0].set(obs)


def any_reward(scale, obs, action, next_obs):
    """Rewards each particle for what it met; may over- and underflow."""
    return scale * obs[..., 0] + next_obs[..., 1] * next_obs[..., 2] - jnp.sum(action)


@functools.cache
def planner(name):
    search = toys.OPTIMIZERS[name](horizon=HORIZON, action_low=LOW, action_high=HIGH)
    built = jaxpets.plan(table_rollout, any_reward, search)
    return built, jax.jit(built.step)


def inside(actions):
    # Not below the box by more than the rounding of `low + share * (high - low)`.
    assert np.isfinite(actions).all()
    assert (actions >= LOW - 1e-6).all() and (actions <= HIGH + 1e-6).all()


@pytest.mark.parametrize("name", toys.OPTIMIZERS)
@given(table=TABLE, obs=OBS, scale=ANY, seed=st.integers(0, 2**32 - 1))
def test_a_plan_is_finite_and_in_the_box_whatever_is_imagined(
    name, table, obs, scale, seed
):
    built, step = planner(name)
    state = built.init()
    params = PlanParams(jnp.asarray(table), jnp.float32(scale))
    for key in jax.random.split(jax.random.key(seed), 2):  # the second starts warm
        plan, after = step(params, key, state, obs)
        inside(plan.action)
        inside(plan.actions)
        assert np.isfinite(plan.value)
        for leaf, old in zip(
            jax.tree.leaves(after), jax.tree.leaves(state), strict=True
        ):
            assert np.isfinite(leaf).all() and leaf.shape == old.shape
        state = after


@given(
    values=hnp.arrays(
        np.float32, 12, elements=st.one_of(FINITE, st.just(WORST_VALUE))
    ).map(lambda x: np.clip(x, WORST_VALUE, -WORST_VALUE))
)
def test_elites_are_the_best_and_what_was_rejected_moves_nothing(values):
    actions = np.arange(12, dtype=np.float32).reshape(12, 1, 1)
    elites = jax.jit(select_elites, static_argnums=2)(values, actions, 5)
    chosen = values[np.asarray(elites.actions).ravel().astype(int)]
    np.testing.assert_array_equal(chosen, np.sort(values)[::-1][:5])
    assert len(set(np.asarray(elites.actions).ravel())) == 5
    good = chosen > WORST_VALUE
    mean = np.mean(elites.actions[good] if good.any() else elites.actions, axis=0)
    np.testing.assert_allclose(elites.mean, mean, rtol=1e-5)
    assert np.isfinite(elites.variance).all() and (elites.variance >= 0).all()
    assert np.isfinite(elites.value)


@given(
    capacity=st.sampled_from([1, 3, 8]),
    lengths=st.lists(st.integers(1, 8), max_size=5),
    grown=st.sampled_from([8, 11]),
    value=ANY,
)
def test_a_dataset_holds_the_newest_rows_whatever_was_appended(
    capacity, lengths, grown, value
):
    dataset, rows = jaxpets.datasets.init(capacity, 1, 1), np.zeros((0, 1), np.float32)
    for length in lengths:
        new = np.arange(len(rows), len(rows) + min(length, capacity))
        new = np.float32(new)[:, None]
        new[-1] = value
        dataset = jaxpets.datasets.append(dataset, jaxpets.Transition(new, new, -new))
        rows = np.concatenate([rows, new])
    for data in (dataset, jaxpets.datasets.grow(dataset, grown)):
        kept = rows[-capacity:]
        size = int(data.size)
        assert size == len(kept)
        begin = int(data.cursor) - size
        order = np.arange(begin, begin + size) % data.data.obs.shape[0]
        np.testing.assert_array_equal(np.asarray(data.data.obs)[order], kept)
        np.testing.assert_array_equal(np.asarray(data.data.action)[order], kept)
        np.testing.assert_array_equal(np.asarray(data.data.next_obs)[order], -kept)
