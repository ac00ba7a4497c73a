from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

import jaxpets
from jaxpets import PlanParams, envs
from jaxpets.envs import env_rollout, from_brax


@pytest.fixture(scope="module")
def made():
    """A real environment of Brax, and the robot that it is here."""
    import brax.envs

    load, loaded = brax.envs.get_environment, []

    def noted(name):
        loaded.append(load(name))
        return loaded[0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(brax.envs, "get_environment", noted)
        return envs.make("brax/inverted_pendulum"), *loaded


@pytest.fixture
def pendulum(made):
    robot, brax_env = made
    return brax_env, robot.env


def test_from_brax_steps_as_brax_does(pendulum, key):
    """And earns and ends as there: the pole falls on the way."""
    brax_env, env = pendulum

    def seen(state):
        own = [state.reward, state.done]
        return [*state.obs.tolist(), *map(float, own)]

    # Brax itself does not trace under strict promotion.
    with jax.numpy_dtype_promotion("standard"):
        state = jax.jit(env.reset)(key)
        want = jax.jit(brax_env.reset)(jax.random.key_data(key))
        np.testing.assert_allclose(state.obs, seen(want), rtol=1e-6)
        brax_step = jax.jit(brax_env.step)
        env_step = jax.jit(env.step)
        for _ in range(20):
            action = jnp.full((1,), 0.3)
            state, want = env_step(state, action), brax_step(want, action)
            np.testing.assert_allclose(state.obs, seen(want), rtol=1e-5, atol=1e-6)
            assert env.terminal_fn(state.obs) == want.done
            if want.done:
                break
    assert want.done and state.obs.dtype == jnp.float32 and state.obs.shape == (6,)
    np.testing.assert_array_equal(env.action_high, np.ones(1))
    np.testing.assert_array_equal(env.action_low, -np.ones(1))


def test_a_robot_of_brax_seeks_the_reward_of_its_own(made):
    robot, _ = made
    assert robot.name == "brax/inverted_pendulum" and robot.model.nq == 2
    assert robot.tasks.names == ("own",)
    obs = jnp.arange(12.0).reshape(2, 6)
    earned = robot.tasks.reward_fn(robot.tasks.params[0], obs, jnp.zeros((2, 1)), obs)
    np.testing.assert_array_equal(earned, obs[:, 4])
    np.testing.assert_array_equal(jax.jit(robot.qpos_fn)(obs), obs[:, :2])
    last = robot.space.coordinates[3:]
    assert [(row.name, row.kind, row.is_input) for row in last] == [
        ("obs/3", "relative", True),
        ("reward", "absolute", False),
        ("done", "absolute", False),
    ]


def test_from_brax_keeps_its_avals(pendulum, key):
    """Under strict promotion, as every other environment here."""
    _, env = pendulum
    state = jax.eval_shape(env.reset, key)
    after = jax.eval_shape(env.step, state, env.action_low)
    assert jax.tree.structure(after) == jax.tree.structure(state)
    for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(state), strict=True):
        assert (a.shape, a.dtype, a.weak_type) == (b.shape, b.dtype, b.weak_type)


def test_from_brax_runs_in_our_planner(pendulum, key):
    """The pendulum's own dynamics as the model keep it upright."""
    _, env = pendulum

    def upright(params, obs, action, next_obs):
        del params, obs
        return -(next_obs[..., 1] ** 2) - 0.01 * next_obs[..., 0] ** 2

    search = jaxpets.optimizers.cem(
        horizon=8,
        action_low=env.action_low,
        action_high=env.action_high,
        num_samples=24,
        num_elites=4,
        num_iterations=2,
    )
    planner = jaxpets.plan(env_rollout(env), upright, search)

    def episode(key):
        def tick(carry, key):
            state, warm = carry
            out, warm = planner.step(PlanParams(()), key, warm, state)
            state = env.step(state, out.action)
            return (state, warm), state.obs

        start = (env.reset(key), planner.init())
        return jax.lax.scan(tick, start, jax.random.split(key, 30))[1]

    with jax.numpy_dtype_promotion("standard"):
        angle = jax.jit(episode)(key)[:, 1]
    assert jnp.abs(angle).max() < 0.2  # rad; Brax calls more a fall


@pytest.mark.parametrize("keep", ["done", ("reward", "cost"), 3, [[]]])
def test_from_brax_keeps_no_more_than_there_is(keep):
    fake = SimpleNamespace(action_size=1)
    with pytest.raises(ValueError, match=r'keep must be among .*"done".*, got '):
        from_brax(fake, keep=keep)
    with pytest.raises(TypeError, match=r"env must be of Brax, .* got str"):
        from_brax("ant")


def test_from_brax_refuses_observations_that_are_no_vector(key):
    for obs in ({"state": jnp.zeros(3)}, jnp.zeros((2, 2))):
        fake = SimpleNamespace(action_size=1, reset=lambda rng, obs=obs: obs_state(obs))
        with pytest.raises(ValueError, match="env must observe one vector, got"):
            from_brax(fake).reset(key)


def obs_state(obs):
    return SimpleNamespace(obs=obs)


# -- the simulator as a model --------------------------------------------------------


def test_env_rollout_equals_stepping():
    env = toys.cart_env()
    rng = np.random.default_rng(0)
    actions = jnp.asarray(rng.uniform(-1, 1, (6, 9, 1)), jnp.float32)
    start = env.reset(jax.random.key(3))
    path = jax.jit(env_rollout(env))((), jax.random.key(0), start, actions)
    assert path.shape == (6, 10, 1, 1, 2)
    step = jax.jit(env.step)
    for n in range(6):
        state = start
        np.testing.assert_array_equal(path[n, 0, 0, 0], state.obs)
        for t in range(9):
            state = step(state, actions[n, t])
            np.testing.assert_allclose(path[n, t + 1, 0, 0], state.obs, atol=1e-6)


def test_mpc_on_the_true_system_beats_chance(key):
    """A cart with twice the gain: the simulator knows, nobody told the planner."""
    env = toys.cart_env(gain=2.0)
    planner = jaxpets.plan(
        env_rollout(env), toys.reach, toys.optimizer("icem", horizon=12)
    )

    def episode(key):
        def tick(carry, key):
            state, warm = carry
            params = PlanParams((), jnp.float32(1.0))
            out, warm = planner.step(params, key, warm, state)
            return (env.step(state, out.action), warm), state.obs

        start = (env.reset(key), planner.init())
        return jax.lax.scan(tick, start, jax.random.split(key, 50))[1]

    path = jax.jit(episode)(key)
    # Within the jitter of a search with 90 samples.
    np.testing.assert_allclose(path[-10:, 0], 1.0, atol=0.1)
