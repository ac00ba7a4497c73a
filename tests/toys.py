"""Small systems with known answers, shared by the tests."""

import functools
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

import jaxpets

LIMIT = np.ones(1, np.float32)
DT = 0.1


def cart(params, key, obs, action):
    """DynamicsFn: position and velocity `[E, B, 2]` under a force `[B, 1]`."""
    del key
    velocity = obs[..., 1] + DT * params * action[..., 0]
    return jnp.stack([obs[..., 0] + DT * velocity, velocity], axis=-1)


def noisy_cart(params, key, obs, action):
    """The cart with noise on both coordinates."""
    noise = 0.01 * jax.random.normal(key, obs.shape, jnp.float32)
    return cart(params, None, obs, action) + noise


def reach(target, obs, action, next_obs):
    """RewardFn: be at `target`; cheap force."""
    del obs
    return -((next_obs[..., 0] - target) ** 2) - 1e-3 * jnp.sum(action**2, axis=-1)


def cart_env(gain=1.0):
    """The cart as an Env; it starts near 0 and counts its steps."""
    one = jnp.asarray(LIMIT)

    def reset(key):
        obs = 0.1 * jax.random.normal(key, (2,), jnp.float32)
        return jaxpets.EnvState(obs, jnp.zeros((), jnp.int32))

    def step(state, action):
        obs = cart(jnp.float32(gain), None, state.obs, action)
        return jaxpets.EnvState(obs, state.physics + 1)

    return jaxpets.Env(reset, step, -one, one)


OPTIMIZERS = {
    "cem": lambda **box: jaxpets.optimizers.cem(
        num_samples=64, num_elites=8, num_iterations=3, **box
    ),
    "cem-unrolled": lambda **box: jaxpets.optimizers.cem(
        num_samples=64, num_elites=8, num_iterations=3, unroll=True, **box
    ),
    "icem": lambda **box: jaxpets.optimizers.icem(
        num_samples=48, num_elites=6, num_iterations=2, **box
    ),
    "icem-loop": lambda **box: jaxpets.optimizers.icem(
        num_samples=48, num_elites=6, num_iterations=2, unroll=False, **box
    ),
    "mppi": lambda **box: jaxpets.optimizers.mppi(
        num_samples=64, num_iterations=4, temperature=0.1, **box
    ),
}


def optimizer(name, horizon=5, size=1):
    """A small optimizer on the box [-1, 1]."""
    high = jnp.ones((size,), jnp.float32)
    return OPTIMIZERS[name](horizon=horizon, action_low=-high, action_high=high)


def probe(actions):
    """A TrajectoryOptimizer that scores given sequences and returns all values.

    Its Solution carries `actions[0]`; its state is the values `[N]`.
    """

    def step(objective_fn, key, state):
        del state
        values = objective_fn(key, actions)
        return jaxpets.optimizers.Solution(actions[0], values[0]), values

    def init():
        return jnp.zeros((actions.shape[0],), jnp.float32)

    return jaxpets.optimizers.TrajectoryOptimizer(init, step)


class Record(NamedTuple):
    """One search: what it asked, what it was answered, what it found."""

    actions: list  # per iteration `[N, H, A]`
    values: list  # per iteration `[N]`
    solution: jaxpets.optimizers.Solution
    state: Any


def bumpy(actions):
    """Values `[N]` of sequences `[N, H, A]` with many optima."""
    return jnp.sin(5 * actions).sum((1, 2)) - jnp.sum(actions**2, (1, 2))


def record(search, value_fn, state=None, seed=0, args=()):
    """Runs one search on `value_fn(actions [N, H, A], *args)`, keeping every sample."""
    step, kept = _recording(search, value_fn)
    kept.clear()
    start = search.init() if state is None else state
    solution, after = step(jax.random.key(seed), start, args)
    jax.effects_barrier()
    actions, values = ([pair[i] for pair in kept] for i in range(2))
    return Record(actions, values, solution, after)


@functools.cache
def _recording(search, value_fn):
    kept = []

    def step(key, state, args):
        def objective(key, asked):
            del key
            answered = value_fn(asked, *args)
            jax.debug.callback(keep, asked, answered, ordered=True)
            return answered

        return search.step(objective, key, state)

    def keep(asked, answered):
        kept.append((np.asarray(asked), np.asarray(answered)))

    return jax.jit(step), kept


def small_ensemble(*, obs_size=2, action_size=1, space=None, **changes):
    """An ensemble that trains in a second."""
    settings = dict(
        num_members=3,
        hidden_sizes=(16, 16),
        weight_decays=(1e-4, 2e-4, 3e-4),
        precision=jaxpets.Precision.F32,
    )
    config = jaxpets.EnsembleConfig(**(settings | changes))
    space = space or jaxpets.delta_space()
    return jaxpets.ensemble(config, space, obs_size=obs_size, action_size=action_size)


def transitions(length, obs_size=2, action_size=1, seed=0):
    """Random transitions of a noisy linear system, as NumPy rows."""
    rng = np.random.default_rng(seed)
    obs = rng.normal(size=(length, obs_size))
    action = rng.uniform(-1, 1, size=(length, action_size))
    drift = 0.9 * obs + 0.3 * action.sum(-1, keepdims=True)
    next_obs = drift + 0.05 * rng.normal(size=obs.shape)
    rows = (obs, action, next_obs)
    return jaxpets.Transition(*(jnp.asarray(np.float32(x)) for x in rows))


@functools.partial(jax.jit, static_argnames="capacity")
def dataset_of(data, capacity=40):
    """A dataset that holds `data`; one program, not one for each of its operations."""
    obs_size, action_size = data.obs.shape[1], data.action.shape[1]
    return jaxpets.datasets.append(
        jaxpets.datasets.init(capacity, obs_size, action_size), data
    )


def assert_trees_close(got, want, **tolerance):
    """Equal structure, shapes, dtypes and (nearly) values."""
    chex.assert_trees_all_equal_shapes_and_dtypes(got, want)
    chex.assert_trees_all_close(got, want, **{"rtol": 1e-7, "atol": 0.0} | tolerance)


def avals(tree):
    """Shape, dtype and weak type of every leaf."""
    return [
        (leaf.shape, leaf.dtype, leaf.weak_type)
        for leaf in jax.tree.leaves(jax.eval_shape(lambda: tree))
    ]
