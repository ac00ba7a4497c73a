import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import toys

import jaxpets
from jaxpets import PlanParams

ROLLOUT = jaxpets.particle_rollout(toys.noisy_cart, num_members=2, num_particles=6)
CART = jaxpets.particle_rollout(toys.cart)
PARAMS = PlanParams(jnp.float32(1.0), jnp.float32(0.5))
BAD = [np.inf, -np.inf, np.nan]


def values_of(rollout, reward, params, actions, key=None):
    """What an optimizer sees for `actions` `[N, H, A]`."""
    key = jax.random.key(0) if key is None else key
    return np.asarray(program(rollout, reward)(params, key, actions))


@functools.cache
def program(rollout, reward):
    """Of `values_of`, compiled once for one rollout and reward."""

    def values(params, key, actions):
        planner = jaxpets.plan(rollout, reward, toys.probe(actions))
        return planner.step(params, key, planner.init(), jnp.zeros(2))[1]

    return jax.jit(values)


def random_actions(num_samples=7, horizon=4, seed=0):
    rng = np.random.default_rng(seed)
    return np.float32(rng.uniform(-1, 1, (num_samples, horizon, 1)))


def acting_once(action, step):
    """Three sequences `[3, 4, 1]`; the second acts once."""
    actions = np.zeros((3, 4, 1), np.float32)
    actions[1, step] = action
    return actions


def test_value_is_mean_over_particles_and_sum_over_time(key):
    actions = random_actions()
    path = jax.jit(ROLLOUT)(PARAMS.dynamics, key, jnp.zeros(2), actions)
    path = np.asarray(path)
    got = values_of(ROLLOUT, toys.reach, PARAMS, actions, key)
    for n in range(len(actions)):
        total = 0.0
        for h in range(actions.shape[1]):
            distance = np.float64(path[n, h + 1, :, :, 0]) - 0.5
            cost = 1e-3 * float(actions[n, h, 0]) ** 2
            total += (-(distance**2) - cost).mean()
        np.testing.assert_allclose(got[n], total, rtol=1e-5)  # float32 sums


def test_reward_sees_each_step_as_it_happens(key):
    # Position, its successor and the action fit together only if nothing is shifted.
    def mismatch(params, obs, action, next_obs):
        want = toys.cart(params, None, obs, action)
        return jnp.abs(next_obs - want).max()

    params = PlanParams(jnp.float32(1.0), jnp.float32(1.0))
    got = values_of(CART, mismatch, params, random_actions(), key)
    np.testing.assert_allclose(got, 0.0, atol=1e-6)  # one rounding


@pytest.mark.parametrize("name", toys.OPTIMIZERS)
def test_warm_start_is_the_shifted_plan(name, key):
    planner = jaxpets.plan(CART, toys.reach, toys.optimizer(name))
    out, state = jax.jit(planner.step)(PARAMS, key, planner.init(), jnp.zeros(2))
    np.testing.assert_array_equal(out.action, out.actions[0])
    want = reference.shift(np.asarray(out.actions), 0.0)
    np.testing.assert_array_equal(state.mean, want)
    assert np.abs(want[0]).max() > 0.01  # not just zeros


@pytest.fixture(scope="module", params=list(toys.OPTIMIZERS))
def half_bad_step(request):
    """A jitted planner whose reward is `params.reward` wherever the action is > 0."""

    def reward(bad, obs, action, next_obs):
        limit, bad = bad
        return jnp.where(action[0] > limit, bad, -((action[0] + 0.4) ** 2))

    planner = jaxpets.plan(CART, reward, toys.optimizer(request.param, horizon=2))
    return lambda limit, bad: jax.jit(planner.step)(
        PlanParams(jnp.float32(1.0), (jnp.float32(limit), jnp.float32(bad))),
        jax.random.key(0),
        planner.init(),
        jnp.zeros(2),
    )


def bad_for_one_particle(bad, obs, action, next_obs):
    good = toys.reach(0.5, obs, action, next_obs)
    return good.at[0, 0].set(jnp.where(action[0] > 0.5, bad, good[0, 0]))


@pytest.mark.parametrize("bad", BAD)
def test_one_bad_particle_makes_the_worst_candidate(bad):
    params = PARAMS._replace(reward=jnp.float32(bad))
    values = values_of(ROLLOUT, bad_for_one_particle, params, acting_once(0.9, step=2))
    assert values[1] == np.float32(jaxpets.optimizers.WORST_VALUE)
    assert np.all(values[[0, 2]] > -100)


def diverging(bad, key, obs, action):
    next_obs = toys.cart(1.0, key, obs, action)
    return jnp.where(action[:, :1] > 0.5, bad, next_obs)


DIVERGING = jaxpets.particle_rollout(diverging)


def position(params, obs, action, next_obs):
    return next_obs[..., 0]


@pytest.mark.parametrize("bad", BAD)
def test_a_model_that_diverges_makes_the_worst_candidate(bad):
    params = PlanParams(jnp.float32(bad))
    values = values_of(DIVERGING, position, params, acting_once(0.9, step=0))
    assert values[1] == np.float32(jaxpets.optimizers.WORST_VALUE)


@pytest.mark.parametrize("bad", BAD)
def test_non_finite_never_wins(half_bad_step, bad):
    """Half of the box diverges, the best finite action is in the other half."""
    out, _ = half_bad_step(0.0, bad)
    # What a search of 100 to 250 samples finds.
    np.testing.assert_allclose(out.actions, -0.4, atol=0.25)
    assert -1.0 < out.value <= 0.0


@pytest.mark.parametrize("bad", BAD)
def test_all_non_finite_stays_finite(half_bad_step, bad):
    out, state = half_bad_step(-2.0, bad)
    for leaf in jax.tree.leaves((out, state)):
        assert np.all(np.isfinite(leaf))
    assert np.all(np.abs(out.actions) <= 1.0)


def test_huge_finite_values_stay_within_the_worst():
    def reward(params, obs, action, next_obs):
        return 1e35 * jnp.sign(action[0])

    actions = np.float32([-np.ones((2, 1)), np.ones((2, 1))])
    values = values_of(CART, reward, PARAMS, actions)
    np.testing.assert_array_equal(values, np.float32([-1e30, 1e30]))


def test_scalar_and_per_particle_rewards_agree(key):
    def scalar(params, obs, action, next_obs):
        return jnp.sum(action)

    def per_particle(params, obs, action, next_obs):
        return jnp.broadcast_to(jnp.sum(action), obs.shape[:-1])

    planners = [
        jaxpets.plan(ROLLOUT, fn, toys.optimizer("cem"))
        for fn in (scalar, per_particle)
    ]
    outs = [jax.jit(p.step)(PARAMS, key, p.init(), jnp.zeros(2))[0] for p in planners]
    # The mean of equal numbers may differ from them by rounding.
    toys.assert_trees_close(outs[0], outs[1], rtol=1e-5, atol=1e-6)


def test_rewards_add_and_mix(key):
    def mixture(params, obs, action, next_obs):
        step = (obs, action, next_obs)
        novelty = jaxpets.rewards.epistemic(params[1], *step)
        return toys.reach(params[0], *step) + 0.1 * novelty

    def risk(params, obs, action, next_obs):
        return toys.reach(params[0], obs, action, next_obs).min()

    base = jnp.ones(2)
    reward_params = (jnp.float32(0.5), base)
    actions = random_actions()

    def value(reward, params):
        return values_of(ROLLOUT, reward, PlanParams(PARAMS.dynamics, params), actions)

    task = value(toys.reach, reward_params[0])
    novelty = value(jaxpets.rewards.epistemic, base)
    assert np.all(novelty > 0)
    mixed = value(mixture, reward_params)
    want = task + np.float32(0.1) * novelty
    np.testing.assert_allclose(mixed, want, rtol=1e-5, atol=1e-6)
    assert np.all(value(risk, reward_params) < task)


def test_start_reaches_the_rollout_untouched(key):
    def rollout(params, key, obs, actions):
        start = obs["cart"] + obs["tick"].astype(jnp.float32)
        return CART(params, key, start, actions)

    planner = jaxpets.plan(rollout, toys.reach, toys.optimizer("cem"))
    obs = {"cart": jnp.zeros(2), "tick": jnp.int32(0)}
    got, _ = planner.step(PARAMS, key, planner.init(), obs)
    plain = jaxpets.plan(CART, toys.reach, toys.optimizer("cem"))
    want, _ = plain.step(PARAMS, key, plain.init(), jnp.zeros(2))
    toys.assert_trees_close(got, want, rtol=0)


@pytest.mark.parametrize("name", toys.OPTIMIZERS)
def test_a_rollout_that_binds_is_bound_once_and_plans_the_same(name, key):
    bound = []

    class Binding:
        def __call__(self, params, key, obs, actions):
            raise AssertionError("it has a bind")

        def bind(self, params):
            bound.append(params)
            return functools.partial(ROLLOUT, params)

    def planned(rollout):
        planner = jaxpets.plan(rollout, toys.reach, toys.optimizer(name))
        return jax.jit(planner.step)(PARAMS, key, planner.init(), jnp.zeros(2))

    toys.assert_trees_close(planned(Binding()), planned(ROLLOUT), rtol=0)
    assert len(bound) == 1


def test_controls_a_cart(key):
    """Reaches three goals with one program; the optimum is to stand there."""
    planner = jaxpets.plan(CART, toys.reach, toys.optimizer("cem", horizon=15))

    def episode(target, key):
        def tick(carry, key):
            obs, state = carry
            params = PlanParams(jnp.float32(1.0), target)
            out, state = planner.step(params, key, state, obs)
            return (toys.cart(1.0, None, obs, out.action), state), obs

        start = (jnp.zeros(2), planner.init())
        return jax.lax.scan(tick, start, jax.random.split(key, 60))[1]

    targets = jnp.array([-1.0, 0.5, 2.0])
    paths = jax.jit(jax.vmap(episode))(targets, jax.random.split(key, 3))
    # Within the jitter that 64 samples a search leave.
    np.testing.assert_allclose(paths[:, -10:, 0].mean(1), targets, atol=0.05)


@pytest.mark.parametrize("shape", [(2, 3, 2), (3,), (1,), (6,)])
def test_wrong_reward_shape_fails_when_traced(shape, key):
    planner = jaxpets.plan(
        ROLLOUT, lambda p, o, a, n: jnp.zeros(shape), toys.optimizer("cem")
    )
    with pytest.raises(ValueError, match=r"reward_fn must return shape \(\) or \(2, 3"):
        jax.eval_shape(planner.step, PARAMS, key, planner.init(), jnp.zeros(2))


def test_wrong_reward_dtype_fails_when_traced(key):
    def reward(params, obs, action, next_obs):
        return next_obs[..., 0].astype(jnp.bfloat16)

    planner = jaxpets.plan(CART, reward, toys.optimizer("cem"))
    with pytest.raises((TypeError, ValueError), match=r"reward_fn.*float32.*bfloat16"):
        jax.eval_shape(planner.step, PARAMS, key, planner.init(), jnp.zeros(2))


@pytest.mark.parametrize("shape", [(64, 5, 1, 1, 2), (64, 6, 2), (63, 6, 1, 1, 2)])
def test_wrong_rollout_shape_fails_when_traced(shape, key):
    planner = jaxpets.plan(
        lambda *_: jnp.zeros(shape), toys.reach, toys.optimizer("cem")
    )
    with pytest.raises(ValueError, match=r"rollout_fn must return shape \(64, 6, E, P"):
        jax.eval_shape(planner.step, PARAMS, key, planner.init(), jnp.zeros(2))


@pytest.mark.parametrize("name", toys.OPTIMIZERS)
@pytest.mark.parametrize("horizon", [1, 6])
def test_a_warm_start_of_another_horizon_fails_when_traced(name, horizon, key):
    planner = jaxpets.plan(CART, toys.reach, toys.optimizer(name))
    state = toys.optimizer(name, horizon=horizon).init()
    text = rf"state.mean must be float32\[5, 1\], got float32\[{horizon}, 1\]"
    with pytest.raises(ValueError, match=text):
        jax.eval_shape(planner.step, PARAMS, key, state, jnp.zeros(2))


@pytest.mark.parametrize("name", toys.OPTIMIZERS)
def test_a_wrong_objective_fails_when_traced(name, key):
    search = toys.optimizer(name)
    for values in (jnp.zeros((200, 1)), jnp.zeros(3), jnp.zeros(())):
        step = functools.partial(search.step, lambda *_, v=values: v)
        with pytest.raises(ValueError, match=r"objective_fn's result must be float32"):
            jax.eval_shape(step, key, search.init())


def test_wrong_keys_fail_when_traced():
    planner = jaxpets.plan(CART, toys.reach, toys.optimizer("cem"))
    chance = jaxpets.random_planner(-jnp.ones(1), jnp.ones(1))
    for each in (planner, chance):
        with pytest.raises(TypeError, match="key must be a typed key"):
            each.step(PARAMS, jax.random.PRNGKey(0), each.init(), jnp.zeros(2))
        keys = jax.random.split(jax.random.key(0), 2)
        with pytest.raises(ValueError, match="key must be a single key"):
            each.step(PARAMS, keys, each.init(), jnp.zeros(2))
