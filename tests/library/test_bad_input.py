"""Bad input is refused by a sentence that names the argument."""

import functools

import jax
import jax.numpy as jnp
import optax
import pytest
import toys
from jax.sharding import Mesh, PartitionSpec

import jaxpets
from jaxpets import EnsembleParams, FitConfig, PlanParams, rewards
from jaxpets.datasets import append, grow, init, obs_variance
from jaxpets.envs import env_rollout, from_brax
from jaxpets.envs import half_cheetah as hc
from jaxpets.models import by_means, without_noise
from jaxpets.optimizers import sharded
from jaxpets.policies import guided_reward

ENV = toys.cart_env()
MODEL = toys.small_ensemble(num_members=2, hidden_sizes=(4,), weight_decays=1e-4)
PARAMS = jax.jit(MODEL.init)(jax.random.key(0))
FITTER = jaxpets.fitter(MODEL, optax.sgd(1e-2), FitConfig(num_epochs=1))
FIT = FITTER.init(PARAMS)
DATASET = init(8, 2, 1)
ROWS = toys.transitions(4)
KEY, OBS, ACTIONS = jax.random.key(0), jnp.zeros(2), jnp.zeros((3, 4, 1))
NOTHING = PlanParams(())
CHANCE = jaxpets.random_planner(ENV.action_low, ENV.action_high)
CART = jaxpets.particle_rollout(toys.cart)
LEARNED = jaxpets.particle_rollout(MODEL.sample, num_members=2, num_particles=4)
SEARCH = {name: toys.optimizer(name, horizon=3) for name in ("cem", "icem", "mppi")}
PARTICLES = jnp.zeros((2, 3, 2))
STEP = (PARTICLES, jnp.zeros(1), PARTICLES)


def learner(env=ENV, model=MODEL):
    return jaxpets.learner(env, model, FITTER, trial_length=4, capacity=8)


LEARNER = learner()
SEEDS = jaxpets.over_seeds(LEARNER, 2)


def plan(rollout=CART, reward=toys.reach, search=SEARCH["cem"]):
    return jaxpets.plan(rollout, reward, search)


def decide(planner, params, key=KEY, state=None):
    state = planner.init() if state is None else state
    return planner.step(params, key, state, OBS)


def fused():
    """A fused rollout that is a scan: no kernel sorts."""
    space = jaxpets.delta_space()._replace(features=jnp.sort)
    model = toys.small_ensemble(space=space)
    with pytest.warns(UserWarning, match="runs as a scan"):
        return jaxpets.fused_rollout(model, num_particles=3), model


def search(name, key, state=None):
    found = SEARCH[name]
    state = found.init() if state is None else state
    return found.step(lambda key, actions: -jnp.sum(actions**2, (1, 2)), key, state)


def search_on_devices(key):
    found = sharded(SEARCH["cem"], "device")
    mesh = Mesh(jax.devices()[:1], "device")

    def step(state):
        return found.step(lambda key, x: -jnp.sum(x**2, (1, 2)), key, state)

    every = dict(in_specs=PartitionSpec(), out_specs=PartitionSpec())
    return jax.shard_map(step, mesh=mesh, **every, check_vma=False)(found.init())


def fused_call(key):
    rollout, model = fused()
    return rollout(model.init(KEY), key, OBS, ACTIONS)


class Brax:
    action_size = 1


def unroll(key=KEY, env=ENV, planner=CHANCE, params=NOTHING, **options):
    state = jaxpets.start_trial(ENV, CHANCE, KEY)
    options = dict(length=3) | options
    return jaxpets.unroll(env, planner, params, key, state, **options)


# -- keys ----------------------------------------------------------------------------

KEYED = {
    "cem": functools.partial(search, "cem"),
    "icem": functools.partial(search, "icem"),
    "mppi": functools.partial(search, "mppi"),
    "sharded": search_on_devices,
    "plan": lambda key: decide(plan(), PlanParams(jnp.float32(1), 0.0), key),
    "random_planner": lambda key: decide(CHANCE, PlanParams(()), key, ()),
    "particle_rollout": lambda key: CART(jnp.float32(1), key, OBS, ACTIONS),
    "per_state": lambda key: jaxpets.per_state(lambda params, key, obs, action: obs)(
        (), key, PARTICLES, jnp.zeros((3, 1))
    ),
    "env_rollout": lambda key: env_rollout(ENV)((), key, ENV.reset(KEY), ACTIONS),
    "fused_rollout": fused_call,
    "ensemble.init": MODEL.init,
    "ensemble.sample": lambda key: MODEL.sample(
        PARAMS, key, PARTICLES, jnp.zeros((3, 1))
    ),
    "fitter.step": lambda key: FITTER.step(PARAMS, key, FIT, DATASET),
    "learner.init": LEARNER.init,
    "learner.learn": lambda key: LEARNER.learn(key, LEARNER.init(KEY), ROWS),
    "learner.step": lambda key: LEARNER.step(CHANCE, key, LEARNER.init(KEY)),
    "over_seeds.init": SEEDS.init,
    "over_seeds.learn": lambda keys: SEEDS.learn(keys, None, None),
    "over_seeds.step": lambda keys: SEEDS.step(CHANCE, keys, None),
    "start_trial": lambda key: jaxpets.start_trial(ENV, CHANCE, key),
    "unroll": unroll,
    "simhash": lambda key: rewards.simhash(key, 4, 2),
    "from_brax": lambda key: from_brax(Brax()).reset(key),
    "half_cheetah": lambda key: hc.half_cheetah_native(num_threads=1).reset(key),
}


@pytest.mark.parametrize("name", KEYED)
def test_an_old_style_key_is_refused(name):
    sentence = (
        r"keys? must be (a )?typed keys? from jax\.random\.key, got uint32\.(\n|$)"
    )
    with pytest.raises(TypeError, match=sentence):
        KEYED[name](jax.random.PRNGKey(0))


# -- everything else -----------------------------------------------------------------


def no_obs(key):
    return jnp.zeros(2)


def rounding_step(state, action):
    return state._replace(obs=state.obs.astype(jnp.float16))


def another_size():
    return toys.small_ensemble(num_members=2, hidden_sizes=(5,), weight_decays=0.0)


def bad_reward(value):
    planner = plan(reward=lambda params, obs, action, next_obs: value)
    return decide(planner, PlanParams(jnp.float32(1)))


def bad_optimizer(value):
    return jaxpets.fitter(MODEL, value, FitConfig())


def bad_horizon(name):
    return toys.optimizer(name, horizon=0)


WRONG = {
    # Parameters.
    "params () in plan": (
        lambda: decide(plan(), ()), "params must be a PlanParams, got tuple"),
    "params None in plan": (
        lambda: decide(plan(), None), "params must be a PlanParams, got NoneType"),
    "a model as params in plan": (
        lambda: decide(plan(), PARAMS), "params must be a PlanParams, got EnsembleP"),
    "dynamics None": (
        lambda: decide(plan(LEARNED), PlanParams(None)),
        "params must be an EnsembleParams, got NoneType"),
    "dynamics of another structure": (
        lambda: decide(plan(LEARNED), PlanParams(EnsembleParams(None, None))),
        "params must have the structure"),
    "dynamics of another size": (
        lambda: decide(plan(LEARNED), PlanParams(another_size().init(KEY))),
        r"params\.network\.members.* must be float32\[2, 4\], got float32\[2, 5\]"),
    "params None in fit": (
        lambda: FITTER.init(None), "params must be an EnsembleParams, got NoneType"),
    "params of another structure in fit": (
        lambda: FITTER.step(EnsembleParams({}, {}), KEY, FIT, DATASET),
        "params must have the structure"),
    "a state of another optimizer in fit": (
        lambda: bad_optimizer(optax.adam(1e-3)).step(PARAMS, KEY, FIT, DATASET),
        "state must have the structure"),
    "dataset None in fit": (
        lambda: FITTER.step(PARAMS, KEY, FIT, None), "dataset must be a Dataset"),
    "guided_reward of no function": (
        lambda: guided_reward(3), "reward_fn must be a function, got 3"),
    "by_means of no planner": (
        lambda: by_means(None), "planner must be a Planner"),
    "params of no planner in by_means": (
        lambda: by_means(plan()).step((), KEY, (), OBS),
        "params must be a PlanParams"),
    "without_noise of no model": (
        lambda: without_noise(None), "params must be an EnsembleParams"),
    "without_noise of a model of another kind": (
        lambda: without_noise(EnsembleParams((), ())),
        "params.network must be a NetworkParams"),
    "max_variance": (
        lambda: rewards.max_variance(None), "params must be an EnsembleParams"),
    "max_variance of a model of another kind": (
        lambda: rewards.max_variance(EnsembleParams((), ())),
        "params.network must be a NetworkParams"),
    "epistemic": (
        lambda: rewards.epistemic(None, *STEP), r"baseline_variance must be float32\["),
    "information_gain": (
        lambda: rewards.information_gain(jnp.ones(3), *STEP),
        r"baseline_variance must be float32\[2\], got float32\[3\]"),
    "pseudo_count": (
        lambda: rewards.pseudo_count(None, *STEP), "counts must be a PseudoCounts"),
    "count_states": (
        lambda: rewards.count_states(jnp.ones((4, 2)), None),
        "dataset must be a Dataset, got NoneType"),
    "one_step_disagreement": (
        lambda: rewards.one_step_disagreement(None), "predict_fn must be a function"),
    "pessimistic": (
        lambda: rewards.pessimistic(None, 1.0), "reward_fn must be a function"),
    "task_reward": (
        lambda: hc.task_reward(None, *STEP), "weights must be a TaskWeights"),
    # States.
    "an MPPI state in CEM": (
        lambda: search("cem", KEY, SEARCH["mppi"].init()),
        "state must be a CEMState, got MPPIState"),
    "an iCEM state in MPPI": (
        lambda: search("mppi", KEY, SEARCH["icem"].init()),
        "state must be a MPPIState, got ICEMState"),
    "a CEM state in iCEM": (
        lambda: decide(plan(search=SEARCH["icem"]), PlanParams(()), KEY,
                       SEARCH["cem"].init()),
        "state must be an ICEMState, got CEMState"),
    "a planner's state in unroll": (
        lambda: jaxpets.unroll(ENV, CHANCE, PlanParams(()), KEY, (), length=3),
        "state must be an UnrollState, got tuple"),
    "an observation in env_rollout": (
        lambda: env_rollout(ENV)((), KEY, OBS, ACTIONS), "obs must be an EnvState"),
    # Rewards.
    "reward None": (
        lambda: bad_reward(None), "reward_fn must return an array, got NoneType"),
    "reward of integers": (
        lambda: bad_reward(jnp.int32(1)), "reward_fn must return float32, got int32"),
    "reward of another shape": (
        lambda: bad_reward(jnp.zeros(2)), r"reward_fn must return shape \(\) or"),
    # Sizes.
    **{f"horizon 0 in {name}": (
        functools.partial(bad_horizon, name), "horizon must be at least 1, got 0")
       for name in SEARCH},
    "horizon 0 in a rollout": (
        lambda: CART(jnp.float32(1), KEY, OBS, ACTIONS[:, :0]),
        "the horizon of actions must be at least 1, got 0"),
    "no candidates in a rollout": (
        lambda: CART(jnp.float32(1), KEY, OBS, ACTIONS[:0]),
        "the number of candidates in actions must be at least 1, got 0"),
    "no steps": (lambda: unroll(length=0), "length must be at least 1, got 0"),
    "another model than the env's": (
        lambda: learner(model=toys.small_ensemble(obs_size=3)),
        "ensemble must have the sizes of env, obs_size 2 and action_size 1, got 3"),
    "another action than the env's": (
        lambda: learner(model=toys.small_ensemble(action_size=2)),
        "ensemble must have the sizes of env, .* got 2 and 2"),
    # What is built from what.
    **{f"optimizer {value!r}": (
        functools.partial(bad_optimizer, value), "optimizer must be of optax, as")
       for value in (1e-3, None, "adam")},
    "a search that is none": (
        lambda: plan(search=optax.adam(1e-3)),
        "optimizer must be a TrajectoryOptimizer, got"),
    "sharded": (
        lambda: sharded(None, "device"), "optimizer must be a TrajectoryOptimizer"),
    "over_seeds": (
        lambda: jaxpets.over_seeds(None, 2), "learner must be a Learner, got NoneT"),
    "learner": (lambda: learner(env=None), "env must be an Env, got NoneType"),
    "start_trial": (
        lambda: jaxpets.start_trial(ENV, SEARCH["cem"], KEY),
        "planner must be a Planner, got TrajectoryOptimizer"),
    "unroll without a planner": (
        lambda: unroll(planner=None), "planner must be a Planner, got NoneType"),
    "unroll without an env": (lambda: unroll(env=None), "env must be an Env"),
    "unroll without params": (
        lambda: unroll(params=None), "params must be a PlanParams, got NoneType"),
    "unroll without eyes": (
        lambda: unroll(observe_fn=None), "observe_fn must be a function"),
    "env_rollout": (lambda: env_rollout(None), "env must be an Env, got NoneType"),
    "append": (lambda: append(None, ROWS), "dataset must be a Dataset"),
    "append nothing": (
        lambda: append(DATASET, None), "transitions must be a Transition"),
    "grow": (lambda: grow(None, 8), "dataset must be a Dataset, got NoneType"),
    "obs_variance": (lambda: obs_variance(None), "dataset must be a Dataset"),
    # Environments.
    "a bare observation in learner": (
        lambda: learner(env=ENV._replace(reset=no_obs)),
        "env.reset's result must be an EnvState, got"),
    "a bare observation in start_trial": (
        lambda: jaxpets.start_trial(ENV._replace(reset=no_obs), CHANCE, KEY),
        "env.reset's result must be an EnvState, got"),
    "bounds of actions": (
        lambda: learner(env=ENV._replace(action_low=None)),
        r"action_low must be an array of numbers \[A\], got None"),
    "a step that rounds": (
        lambda: unroll(env=ENV._replace(step=rounding_step)),
        r"env.step's result\.obs must be float32\[2\], got float16\[2\]"),
    "a step that drops the physics": (
        lambda: unroll(env=ENV._replace(step=lambda state, action: state.obs)),
        "env.step's result must have the structure"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_named(name):
    call, sentence = WRONG[name]
    with pytest.raises((TypeError, ValueError), match=sentence):
        call()
