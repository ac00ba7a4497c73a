"""What a candidate is worth, against sums over imagined paths by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

import jaxpets

E, P, N, H = 2, 3, 6, 5
ROLLOUT = jaxpets.particle_rollout(toys.noisy_cart, num_members=E, num_particles=E * P)
PARAMS = jaxpets.PlanParams(jnp.float32(4.0), (jnp.float32(0.5), jnp.float32(0.06)))
START = jnp.zeros(2)
ACTIONS = jnp.sin(jnp.arange(float(N * H))).reshape(N, H, 1)
KEY = 3
# Sums of five float32 numbers in another order.
CLOSE = dict(rtol=1e-5, atol=1e-6)


def reach(params, obs, action, next_obs):
    return toys.reach(params[0], obs, action, next_obs)


def spread(params, obs, action, next_obs):
    """A reward of the whole set."""
    return 1.0 + jnp.std(next_obs[..., 0]) + 0.1 * action[0]


def far(params, obs):
    """Ends a particle that is further than params[1] from the origin."""
    return jnp.abs(obs[..., 0]) > params[1]


def values_of(reward_fn, rollout=ROLLOUT, start=START, **settings):
    planner = jaxpets.plan(rollout, reward_fn, toys.probe(ACTIONS), **settings)
    step = jax.jit(planner.step)
    return np.asarray(step(PARAMS, jax.random.key(KEY), planner.init(), start)[1])


def rewards_by_hand(reward_fn, start=START):
    """Rewards `[N, H, E, P]` and the path `[N, H+1, E, P, D]`."""
    path = ROLLOUT(PARAMS.dynamics, jax.random.key(KEY), start, ACTIONS)
    rewards = np.zeros((N, H, E, P))
    for n in range(N):
        for h in range(H):
            step = (path[n, h], ACTIONS[n, h], path[n, h + 1])
            rewards[n, h] = reward_fn(PARAMS.reward, *step)
    return rewards, np.asarray(path)


def returns_by_hand(reward_fn, start=START, limit=np.inf, discount=1.0):
    """Returns `[N, E, P]`, particle by particle, and steps that each one earned."""
    rewards, path = rewards_by_hand(reward_fn, start)
    total, lived = np.zeros((N, E, P)), np.zeros((N, E, P), int)
    for n, e, p in np.ndindex(N, E, P):
        for h in range(H):
            total[n, e, p] += discount**h * rewards[n, h, e, p]
            lived[n, e, p] += 1
            if abs(path[n, h + 1, e, p, 0]) > limit:
                break
    return total, lived


@pytest.mark.parametrize("reward_fn", [reach, spread])
@pytest.mark.parametrize("discount", [0.0, 0.9])
def test_later_rewards_count_less(reward_fn, discount):
    want, _ = returns_by_hand(reward_fn, discount=discount)
    got = values_of(reward_fn, discount=discount)
    np.testing.assert_allclose(got, want.mean((1, 2)), **CLOSE)


@pytest.mark.parametrize("reward_fn", [reach, spread])
def test_nothing_is_earned_behind_the_end(reward_fn):
    want, lived = returns_by_hand(reward_fn, limit=0.06)
    assert set(lived.ravel()) >= {2, 3, H}  # some end early, some not at all
    got = values_of(reward_fn, terminal_fn=far)
    np.testing.assert_allclose(got, want.mean((1, 2)), **CLOSE)


def test_the_start_is_not_asked_whether_it_ends():
    start = jnp.array([1.0, 0.0])
    want, lived = returns_by_hand(reach, start=start, limit=0.06)
    assert (lived == 1).all()
    got = values_of(reach, start=start, terminal_fn=far)
    np.testing.assert_allclose(got, want.mean((1, 2)), **CLOSE)


def test_an_end_of_all_particles_may_be_one_answer():
    def somewhere(params, obs):
        return jnp.any(far(params, obs))

    rewards, path = rewards_by_hand(reach)
    ends = (np.abs(path[:, 1:, ..., 0]) > 0.06).any((2, 3))
    first = np.where(ends.any(1), ends.argmax(1), H)
    want = [rewards[n, : first[n] + 1].sum(0).mean() for n in range(N)]
    got = values_of(reach, terminal_fn=somewhere)
    np.testing.assert_allclose(got, want, **CLOSE)


def test_what_follows_the_end_need_not_be_finite():
    def broken(params, obs, action, next_obs):
        return jnp.where(
            far(params, obs), jnp.nan, reach(params, obs, action, next_obs)
        )

    assert values_of(broken).min() == np.float32(jaxpets.optimizers.WORST_VALUE)
    got = values_of(broken, terminal_fn=far)
    np.testing.assert_array_equal(got, values_of(reach, terminal_fn=far))


def test_a_candidate_may_be_worth_its_worst_particle():
    want, _ = returns_by_hand(reach)
    got = values_of(reach, risk_fn=jnp.min)
    np.testing.assert_allclose(got, want.min((1, 2)), **CLOSE)


def test_a_risk_sees_members_and_their_particles():
    def worst_member(returns):
        assert returns.shape == (E, P)
        return jnp.min(jnp.mean(returns, axis=1))

    want, _ = returns_by_hand(reach, limit=0.06, discount=0.9)
    settings = dict(terminal_fn=far, discount=0.9, risk_fn=worst_member)
    got = values_of(reach, **settings)
    np.testing.assert_allclose(got, want.mean(2).min(1), **CLOSE)
    np.testing.assert_allclose(values_of(reach, chunk_size=4, **settings), got, **CLOSE)


def ahead(params, obs):
    """What is to come: more the further a particle is from params[0]."""
    return (obs[..., 0] - params[0]) ** 2


@pytest.mark.parametrize("reward_fn", [reach, spread])
@pytest.mark.parametrize("discount", [1.0, 0.9])
def test_what_is_to_come_counts_where_the_horizon_ends(reward_fn, discount):
    want, _ = returns_by_hand(reward_fn, discount=discount)
    _, path = rewards_by_hand(reward_fn)
    want += discount**H * np.asarray(ahead(PARAMS.reward, path[:, -1]))
    got = values_of(reward_fn, discount=discount, value_fn=ahead)
    np.testing.assert_allclose(got, want.mean((1, 2)), **CLOSE)


def test_nothing_is_to_come_behind_the_end():
    _, path = rewards_by_hand(reach)
    reached = np.abs(path[:, 1:, ..., 0]).max(1)
    limit = float(np.median(reached))
    want, _ = returns_by_hand(reach, limit=limit)
    want += np.where(reached <= limit, ahead(PARAMS.reward, path[:, -1]), 0.0)
    got = values_of(
        reach,
        terminal_fn=lambda params, obs: jnp.abs(obs[..., 0]) > limit,
        value_fn=ahead,
    )
    np.testing.assert_allclose(got, want.mean((1, 2)), **CLOSE)


def test_what_is_to_come_may_be_one_number_of_all_particles():
    def at_worst(params, obs):
        return jnp.min(ahead(params, obs))

    _, path = rewards_by_hand(reach)
    least = np.asarray(ahead(PARAMS.reward, path[:, -1])).min((1, 2))
    got = values_of(reach, value_fn=at_worst)
    np.testing.assert_allclose(got, values_of(reach) + least, **CLOSE)


def test_a_discount_may_be_mapped():
    discounts = jnp.array([0.3, 1.0])
    got = jax.vmap(values_of_traced)(discounts)
    for discount, values in zip((0.3, 1.0), got, strict=True):
        np.testing.assert_allclose(values, values_of(reach, discount=discount), **CLOSE)


def values_of_traced(discount):
    planner = jaxpets.plan(ROLLOUT, reach, toys.probe(ACTIONS), discount=discount)
    return planner.step(PARAMS, jax.random.key(KEY), planner.init(), START)[1]


@pytest.mark.parametrize("name", toys.OPTIMIZERS)
def test_every_search_avoids_the_end(name):
    """Beyond 0.05 the trial ends, and each step before is worth one."""

    def alive(params, obs, action, next_obs):
        return jnp.ones(obs.shape[:-1]) + action[0]

    planner = jaxpets.plan(
        jaxpets.particle_rollout(toys.cart),
        alive,
        toys.optimizer(name, horizon=6),
        terminal_fn=lambda params, obs: obs[..., 0] > 0.05,
    )
    step = jax.jit(planner.step)
    out, _ = step(PARAMS, jax.random.key(0), planner.init(), START)
    # Full force would end it after two steps, worth 4; none is worth 6.
    assert out.value > 5.5


@pytest.mark.parametrize(
    ("settings", "error", "text"),
    [
        (dict(discount=1.1), ValueError, r"discount must be in \[0, 1\], got 1.1"),
        (dict(discount="1"), TypeError, "discount must be a Python float, got '1'"),
        (dict(terminal_fn=1.0), TypeError, "terminal_fn must be a function, got 1.0"),
        (dict(risk_fn="cvar"), TypeError, "risk_fn must be a function, got 'cvar'"),
        (dict(value_fn=0.0), TypeError, "value_fn must be a function, got 0.0"),
    ],
)
def test_bad_settings_fail_when_built(settings, error, text):
    with pytest.raises(error, match=text):
        values_of(reach, **settings)


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        (
            dict(terminal_fn=lambda params, obs: obs[..., 0]),
            r"terminal_fn must return bool of shape \(\) or \(2, 3\), got float32\[2",
        ),
        (
            dict(terminal_fn=lambda params, obs: obs > 0),
            r"terminal_fn must return bool of shape .* got bool\[2, 3, 2\]",
        ),
        (
            dict(risk_fn=lambda returns: returns[0]),
            r"risk_fn's result must be float32\[\], got float32\[3\]",
        ),
        (
            dict(value_fn=lambda params, obs: obs),
            r"value_fn must return float32 of shape \(\) or \(2, 3\), got float32\[2",
        ),
    ],
)
def test_wrong_results_fail_when_traced(settings, text):
    with pytest.raises(ValueError, match=text):
        values_of(reach, **settings)
