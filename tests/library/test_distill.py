"""What a policy learns of a planner whose decisions are known."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import toys

import jaxpets
from jaxpets import PlanParams, policies
from jaxpets._src.distill_records import Plans
from jaxpets._src.distill_update import keep
from jaxpets.policies import DistillConfig, Goals, Guided

pytestmark = pytest.mark.slow

GAIN, HORIZON = jnp.float32(3.0), 4
TARGETS = jnp.array([-0.6, 0.6], jnp.float32)
SEARCH = toys.optimizer("icem", horizon=HORIZON)
PLANNER = jaxpets.plan(jaxpets.particle_rollout(toys.cart), toys.reach, SEARCH)


def draw(targets, key):
    return targets[jax.random.randint(key, (), 0, targets.shape[0])]


NUMBERS = DistillConfig.__dataclass_fields__


def build(**changes):
    numbers = dict(hidden_size=32, num_trials=8, horizon=25, num_updates=300)
    numbers |= dict(capacity=1000, batch_size=64, restart=0.05)
    numbers |= {k: changes.pop(k) for k in list(changes) if k in NUMBERS}
    settings = dict(
        planner=PLANNER,
        dynamics_fn=toys.cart,
        reward_fn=toys.reach,
        optimizer=optax.adam(3e-3),
        config=DistillConfig(**numbers),
        space=jaxpets.delta_space(),
        obs_size=2,
        action_low=-toys.LIMIT,
        action_high=toys.LIMIT,
        goals=Goals(draw, lambda target: target[None]),
    )
    return jaxpets.distill(**(settings | changes))


def states(count=200, reach=1.0):
    rng = np.random.default_rng(0)
    rows = jnp.asarray(rng.uniform(-reach, reach, (count, 2)), jnp.float32)
    return toys.dataset_of(jaxpets.Transition(rows, rows[:, :1], rows), capacity=220)


@functools.cache
def compiled():
    distiller = build()
    return distiller, jax.jit(distiller.init), jax.jit(distiller.step)


@functools.cache
def learned(squash=0.0):
    """The distiller, its states before and after, and what is said of every call."""
    distiller, init, step = compiled()
    known = PlanParams(GAIN, TARGETS)
    before = init(known, jax.random.key(0), states())
    params = before.params._replace(squash=jnp.float32(squash))
    before = before._replace(params=params)
    state, said = before, []
    for i in range(5):
        state, metrics = step(known, jax.random.key(i), state, states())
        said.append(metrics)
    return distiller, before, state, said


@functools.partial(jax.jit, static_argnames=("planner", "steps"))
def driven(planner, data, start, steps=40):
    """Positions of the cart under a planner."""

    def step(carry, key):
        obs, state = carry
        plan, state = planner.step(PlanParams(GAIN, data), key, state, obs)
        obs = toys.cart(GAIN, None, obs[None, None], plan.action[None])[0, 0]
        return (obs, state), obs[0]

    keys = jax.random.split(jax.random.key(0), steps)
    return jax.lax.scan(step, (start, planner.init()), keys)[1]


def test_one_policy_goes_where_the_planner_goes_for_every_task():
    distiller, _, state, _ = learned()
    for target in TARGETS:
        data = Guided(target, state.params)
        for start in (jnp.zeros(2), jnp.array([0.9, -0.5]), jnp.array([-0.9, 0.5])):
            own = driven(distiller.policy, data, start)
            planned = driven(PLANNER, target, start)
            assert np.abs(planned[-10:] - target).max() < 0.2
            assert np.abs(own[-10:] - target).max() < 0.3


def test_a_state_made_outside_of_jit_can_be_donated():
    distiller, known = build(num_updates=1, horizon=1), PlanParams(GAIN, TARGETS)
    state = distiller.init(known, jax.random.key(0), states())
    step = jax.jit(distiller.step, donate_argnums=2)
    _, metrics = step(known, jax.random.key(1), state, states())
    assert metrics.num_skipped == 0


def test_it_gets_closer_to_the_planner():
    *_, said = learned()
    errors = [metrics.error for metrics in said]
    assert errors[-1] < 0.5 * errors[0]
    assert all(metrics.num_skipped == 0 for metrics in said)


@pytest.mark.parametrize("squash", [0.0, 10.0])
def test_a_value_is_what_the_planner_expects(squash):
    distiller, _, state, _ = learned(squash)
    target, rows = TARGETS[1], states().data.obs[:20]

    def expected(key, obs):
        return PLANNER.step(PlanParams(GAIN, target), key, PLANNER.init(), obs)[0].value

    keys = jax.random.split(jax.random.key(0), 20)
    wanted = jax.jit(jax.vmap(expected))(keys, rows)
    found = distiller.value_fn(Guided(target, state.params), rows)
    assert np.corrcoef(found, wanted)[0, 1] > 0.95
    assert np.abs(found - wanted).mean() < 0.2 * np.abs(wanted).mean()


def test_the_oldest_plans_are_replaced():
    before = learned()[1]
    rows = before.obs.shape[:2]

    def new(i):
        fill = functools.partial(jnp.full_like, fill_value=float(i))
        some = jax.tree.map(lambda x: x[: rows[1]][None], before.plans)
        return Plans(*map(fill, some))

    state, capacity = before, before.plans.counts.shape[0]
    calls = capacity // rows[1] + 1
    for i in range(1, calls + 1):
        state = keep(state, new(i))
    assert int(state.size) == capacity and int(state.cursor) == rows[1]
    kept = np.unique(state.plans.value)
    np.testing.assert_array_equal(kept, np.arange(2, calls + 1))


def one_call(known=None, **changes):
    """The state after a call that only asks, as it hardly learns."""
    distiller = build(num_updates=1, **changes)
    known = known or PlanParams(GAIN, TARGETS)
    before = jax.jit(distiller.init)(known, jax.random.key(0), states())
    return before, *jax.jit(distiller.step)(known, jax.random.key(1), before, states())


def test_all_that_is_asked_is_kept():
    _, after, _ = one_call()
    assert int(after.size) == 8 * 25 == int(after.plans.counts.sum())
    assert np.abs(after.plans.action).max() <= 1.0


@pytest.mark.parametrize("planned", [0.0, 1.0])
def test_who_acts_in_imagined_trials(planned):
    """With no noise and no start anew, a state follows from what was said before it."""
    before, after, _ = one_call(planned=planned, noise=0.0, restart=0.0, horizon=2)
    first, second = (np.asarray(x) for x in after.plans.seen[:16].reshape(2, 8, -1))
    asked = np.asarray(after.plans.action[:8])
    std, mean = np.asarray(before.params.std), np.asarray(before.params.mean)
    speed = (second - first)[:, 1] * std[1] / (toys.DT * float(GAIN))
    assert mean.shape == (3,)
    if planned:
        np.testing.assert_allclose(speed, asked[:, 0], atol=1e-4)
    else:  # as it was before it learned, near nothing
        assert np.abs(speed).max() < 0.2 < np.abs(asked).max()


def test_a_trial_begins_anew_in_the_data():
    _, after, _ = one_call(restart=1.0)
    rows = {tuple(row) for row in np.asarray(states().data.obs)}
    assert all(tuple(x) in rows for x in np.asarray(after.obs).reshape(-1, 2))
    start = jax.tree.map(np.asarray, PLANNER.init())
    for got, want in zip(*map(jax.tree.leaves, (after.planning, start)), strict=True):
        np.testing.assert_array_equal(got, np.broadcast_to(want, got.shape))


def test_a_search_without_a_finite_plan_teaches_nothing():
    known = PlanParams(jnp.float32(jnp.nan), TARGETS)
    before, after, metrics = one_call(known)
    assert not after.plans.counts.any() and not after.plans.value.any()
    assert metrics.error == 0.0 == metrics.value
    same = jax.tree.map(np.array_equal, before.params.critics, after.params.critics)
    assert all(jax.tree.leaves(same))


def test_a_plan_without_an_action_costs_no_step():
    """As a planner of one's own may have it, where `plan` keeps one that is finite."""

    def step(params, key, state, obs):
        output, state = PLANNER.step(params, key, state, obs)
        is_lost = obs[0] > 0
        lost = jax.tree.map(lambda x: jnp.where(is_lost, jnp.nan, x), output)
        return lost, state

    distiller = build(planner=jaxpets.Planner(PLANNER.init, step), num_updates=3)
    known, data = PlanParams(GAIN, TARGETS), states()
    before = jax.jit(distiller.init)(known, jax.random.key(0), data)
    after, metrics = jax.jit(distiller.step)(known, jax.random.key(1), before, data)
    assert metrics.num_skipped == 0 and jnp.isfinite(metrics.error)
    assert 0 < float(after.plans.counts.sum()) < int(after.size)


def test_a_state_that_is_not_finite_costs_no_step():
    """It was kept with a weight of 0, of which NaN is not masked."""
    data = states()
    obs = data.data.obs.at[::2].set(jnp.nan)
    data = data._replace(data=data.data._replace(obs=obs))
    distiller, known = build(restart=1.0, num_updates=3), PlanParams(GAIN, TARGETS)
    before = jax.jit(distiller.init)(known, jax.random.key(0), data)
    after, metrics = jax.jit(distiller.step)(known, jax.random.key(1), before, data)
    assert metrics.num_skipped == 0 and jnp.isfinite(metrics.error)
    assert 0 < float(after.plans.counts.sum()) < int(after.size)


def test_trials_end_where_they_are_said_to_end():
    _, after, _ = one_call(
        terminal_fn=lambda target, obs: jnp.abs(obs[..., 0]) > 0.5, restart=0.0
    )
    rows = {tuple(row) for row in np.asarray(states().data.obs)}
    for x in np.asarray(after.obs).reshape(-1, 2):
        assert tuple(x) in rows or abs(x[0]) <= 0.5


def test_state_and_members_keep_their_shapes():
    distiller = build(num_members=3, num_updates=1, horizon=1)
    known, key = PlanParams(GAIN, TARGETS), jax.random.key(0)
    state = jax.eval_shape(distiller.init, known, key, states())
    assert state.obs.shape == (3, 3, 2) and state.rewards.shape == (3, 3)
    assert state.plans.counts.shape == (1008,)  # whole steps of nine trials
    after, _ = jax.eval_shape(distiller.step, known, key, state, states())
    assert toys.avals(after) == toys.avals(state)


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        (dict(planned=1.5), ValueError, r"planned must be in \[0, 1\], got 1.5"),
        (dict(horizon=0), ValueError, "horizon must be at least 1, got 0"),
        (dict(goals=3), TypeError, "goals must be a Goals, got"),
        (dict(planner=3), TypeError, "planner must be a function, got 3"),
        (dict(planner=lambda *_: 3), TypeError, "planner must be a Planner, got"),
        (dict(dynamics_fn=None), TypeError, "dynamics_fn must be a function, got None"),
        (dict(terminal_fn=1), TypeError, "terminal_fn must be a function, got 1"),
    ],
)
def test_bad_settings_fail_when_built(changes, error, text):
    with pytest.raises(error, match=text):
        build(**changes)


def test_wrong_arguments_fail_when_traced():
    distiller, params = build(), PlanParams(GAIN, TARGETS)
    with pytest.raises(ValueError, match=r"dataset.data.obs must be float32\[C, 2\]"):
        distiller.init(params, jax.random.key(0), jaxpets.datasets.init(5, 3, 1))
    with pytest.raises(TypeError, match="state must be a DistillState"):
        distiller.step(params, jax.random.key(0), (), states())


def test_a_planner_that_begins_with_the_policy_is_learned_as_well():
    """It is built from the policy, and reads it as it is now."""

    def planner_of(policy, reward_fn):
        begins = policies.prior(policy, toys.cart, horizon=HORIZON)
        rollout = jaxpets.particle_rollout(toys.cart)
        return jaxpets.plan(rollout, reward_fn, SEARCH, propose_fn=begins)

    distiller, known = build(planner=planner_of), PlanParams(GAIN, TARGETS)
    state = jax.jit(distiller.init)(known, jax.random.key(0), states())
    step = jax.jit(distiller.step)
    for i in range(4):
        state, metrics = step(known, jax.random.key(i), state, states())
    assert metrics.num_skipped == 0
    data = Guided(TARGETS[1], state.params)
    for planner in (distiller.policy, distiller.planner):
        path = driven(planner, data, jnp.array([-0.9, 0.5]))
        assert np.abs(path[-10:] - TARGETS[1]).max() < 0.3
