"""The members of every protocol, each with three sets of arguments.

Arguments are arrays of NumPy: to make them, nothing is compiled.
"""

import functools
import re
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import toys

import jaxpets
from jaxpets import PlanParams, policies
from jaxpets.envs import env_rollout
from jaxpets.envs import half_cheetah as hc

MODEL = toys.small_ensemble()
MODELS = jax.jit(jax.vmap(MODEL.init))(jax.random.split(jax.random.key(0), 3))
ENV = toys.cart_env()
reset = jax.jit(ENV.reset)
RND = jaxpets.rewards.random_network_distillation(
    optax.adam(1e-3), obs_size=2, hidden_size=8, num_features=4
)
TASK = policies.actor_critic(
    toys.cart,
    toys.reach,
    optax.adam(1e-3),
    policies.ActorCriticConfig(hidden_size=8),
    jaxpets.delta_space(),
    obs_size=2,
    action_low=ENV.action_low,
    action_high=ENV.action_high,
)
# Of the networks of TASK, which are of one size.
DISTILLED = jaxpets.distill(
    jaxpets.random_planner(ENV.action_low, ENV.action_high),
    toys.cart,
    toys.reach,
    optax.adam(1e-3),
    policies.DistillConfig(
        hidden_size=8, num_trials=2, horizon=2, capacity=4, num_updates=1
    ),
    jaxpets.delta_space(),
    obs_size=2,
    action_low=ENV.action_low,
    action_high=ENV.action_high,
)
new_network = jax.jit(RND.init)
new_task, new_distilled = jax.jit(TASK.init), jax.jit(DISTILLED.init)
NOISY = jaxpets.particle_rollout(toys.noisy_cart, num_members=2, num_particles=4)
LEARNED = jaxpets.particle_rollout(MODEL.sample, num_members=3, num_particles=6)


class Case(NamedTuple):
    """One function and three sets of arguments with equal avals."""

    fn: Callable
    variant: Callable[[int], tuple]
    # Positions of the state among the arguments and the results, if there is one.
    state: tuple[int, int] | None = None


def key_of(i):
    """A fresh key: the checker of keys takes slices of one array for its reuse."""
    return jax.random.key(100 + i)


def keys_of(*shape):
    return jax.random.split(jax.random.key(1), shape)


def model(i):
    return row_of(MODELS, i)


def row_of(tree, i):
    return jax.tree.map(lambda x: np.asarray(np.asarray(x)[i]), tree)


def cart_obs(i):
    return np.float32([0.1 * i - 0.1, 0.2 - 0.3 * i])


def warm(init, i):
    """A state as an earlier call may have left it."""
    return jax.tree.map(lambda x: np.asarray(x) + np.float32(0.1 * i), init())


def planner_case(name):
    random = jaxpets.random_planner(ENV.action_low, ENV.action_high)
    if name == "random":
        planner = random
    elif name == "prior":
        begins = policies.prior(random, toys.noisy_cart, horizon=3, num_members=2)
        search = toys.optimizer("icem", horizon=3)
        planner = jaxpets.plan(NOISY, toys.reach, search, propose_fn=begins)
    else:
        planner = jaxpets.plan(NOISY, toys.reach, toys.optimizer(name, horizon=3))

    def variant(i):
        params = PlanParams(jnp.float32(1 + 0.2 * i), jnp.float32(0.5 * i))
        return params, key_of(i), warm(planner.init, i), cart_obs(i)

    return Case(planner.step, variant, (2, 1))


def optimizer_case(name):
    search = toys.optimizer(name, horizon=3, size=2)

    def step(optimum, key, state):
        def objective(key, actions):
            jitter = 1e-3 * jax.random.normal(key, actions.shape[:1], jnp.float32)
            return jitter - jnp.sum((actions - optimum) ** 2, (1, 2))

        return search.step(objective, key, state)

    def variant(i):
        return jnp.float32(0.3 * i), key_of(i), warm(search.init, i)

    return Case(step, variant, (2, 1))


def actions(i):
    return np.sin(np.arange(20, dtype=np.float32) + np.float32(i)).reshape(5, 4, 1)


def particles(i, size=2):
    count = 3 * 4 * size
    angles = np.arange(count, dtype=np.float32) * np.float32(i + 1)
    return np.cos(angles).reshape(3, 4, size)


def step_of(i, size=2, action_size=1):
    action = np.full((action_size,), 0.1 * i, np.float32)
    return particles(i, size), action, particles(i + 3, size)


def mixed(i):
    weight = jnp.float32(0.1 * i)
    return jaxpets.rewards.MixtureData(jnp.float32(i), np.ones(2, np.float32), weight)


def dataset(i):
    rows = particles(i).reshape(12, 2)
    return toys.dataset_of(jaxpets.Transition(rows, rows[:, :1], rows), capacity=16)


@jax.jit
def counted(dataset):
    projection = jaxpets.rewards.simhash(jax.random.key(5), 8, 2)
    return jaxpets.rewards.count_states(projection, dataset)


@jax.jit
def visited(dataset):
    return jaxpets.rewards.visited_states(dataset, 8)


def coloured_case():
    high = jnp.ones(1)
    planner = jaxpets.random_planner(-high, high, noise_beta=1.0, period=5)

    def variant(i):
        return PlanParams(()), key_of(i), planner.init(), cart_obs(i)

    return Case(planner.step, variant, (2, 1))


def jittered(gain, key, obs, action):
    noise = jax.random.normal(key, obs.shape, jnp.float32)
    return toys.cart(gain, None, obs, action) + 0.01 * noise


def guided(i):
    params = PlanParams(jnp.float32(1.0), jnp.float32(i))
    networks = new_task(params, key_of(i), dataset(i)).params
    return policies.Guided(params.reward, networks)


def policy_case(policy):
    def variant(i):
        return PlanParams((), guided(i)), key_of(i), (), cart_obs(i)

    return Case(policy.step, variant, (2, 1))


def distill_case():
    def variant(i):
        params = PlanParams(jnp.float32(1.0), jnp.float32(i))
        state = new_distilled(params, key_of(i), dataset(i))
        return params, key_of(i), state, dataset(i)

    return Case(DISTILLED.step, variant, (2, 0))


CASES = {
    **{f"plan-{n}": functools.partial(planner_case, n) for n in toys.OPTIMIZERS},
    "plan-prior": lambda: planner_case("prior"),
    "random_planner": lambda: planner_case("random"),
    "random_planner-coloured": coloured_case,
    **{n: functools.partial(optimizer_case, n) for n in toys.OPTIMIZERS},
    "particle_rollout": lambda: Case(
        NOISY, lambda i: (jnp.float32(1 + i), key_of(i), cart_obs(i), actions(i))
    ),
    "particle_rollout-ensemble": lambda: Case(
        LEARNED, lambda i: (model(i), key_of(i), cart_obs(i), actions(i))
    ),
    "per_state": lambda: Case(
        jaxpets.per_state(jittered),
        lambda i: (jnp.float32(1 + i), key_of(i), particles(i), actions(i)[0]),
    ),
    "env_rollout": lambda: Case(
        env_rollout(ENV), lambda i: ((), key_of(i), reset(key_of(i)), actions(i))
    ),
    "epistemic": lambda: Case(
        jaxpets.rewards.epistemic,
        lambda i: (np.full(2, i + 0.5, np.float32), *step_of(i)),
    ),
    "information_gain": lambda: Case(
        jaxpets.rewards.information_gain,
        lambda i: (np.full(2, i + 0.5, np.float32), *step_of(i)),
    ),
    "pseudo_count": lambda: Case(
        jaxpets.rewards.pseudo_count, lambda i: (counted(dataset(i)), *step_of(i))
    ),
    "one_step_disagreement": lambda: Case(
        jaxpets.rewards.one_step_disagreement(MODEL.predict),
        lambda i: (model(i), *step_of(i)),
    ),
    "pessimistic": lambda: Case(
        jaxpets.rewards.pessimistic(toys.reach, 0.5),
        lambda i: (jnp.float32(i), *step_of(i)),
    ),
    "task_reward": lambda: Case(
        hc.task_reward,
        lambda i: (row_of(hc.tasks(), i), *step_of(i, 18, 6)),
    ),
    "policy": lambda: policy_case(TASK.policy),
    "distilled-policy": lambda: policy_case(DISTILLED.policy),
    "distill-plan": distill_case,
    "guided-reward": lambda: Case(TASK.reward_fn, lambda i: (guided(i), *step_of(i))),
    "user-reward": lambda: Case(toys.reach, lambda i: (jnp.float32(i), *step_of(i))),
    "ensemble_std": lambda: Case(
        jaxpets.rewards.ensemble_std, lambda i: ((), *step_of(i))
    ),
    "opax": lambda: Case(
        jaxpets.rewards.opax(MODEL.predict), lambda i: (model(i), *step_of(i))
    ),
    "plan2explore": lambda: Case(
        jaxpets.rewards.plan2explore(MODEL.predict),
        lambda i: (
            jaxpets.rewards.Plan2ExploreData(model(i), jnp.full(2, 1.0 + i)),
            *step_of(i),
        ),
    ),
    "jensen_renyi": lambda: Case(
        jaxpets.rewards.jensen_renyi(MODEL.predict), lambda i: (model(i), *step_of(i))
    ),
    "particle_entropy": lambda: Case(
        jaxpets.rewards.particle_entropy(3),
        lambda i: (visited(dataset(i)), *step_of(i)),
    ),
    "random_network_distillation": lambda: Case(
        RND.reward, lambda i: (new_network(key_of(i)), *step_of(i))
    ),
    "mixture": lambda: Case(
        jaxpets.rewards.mixture(toys.reach, jaxpets.rewards.epistemic),
        lambda i: (mixed(i), *step_of(i)),
    ),
}
STATEFUL = [
    name
    for name in CASES
    if {"plan", "planner"} & set(re.split("[-_]", name)) or name in toys.OPTIMIZERS
]
KEYED = [*STATEFUL, "particle_rollout", "particle_rollout-ensemble", "per_state"]
