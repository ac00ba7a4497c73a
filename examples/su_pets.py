"""SU-PETS in one file: explore HalfCheetah without a reward, then perform four tasks.

The method of "Unsupervised Exploration with Deep Model-Based RL", section by section.

    python examples/su_pets.py          # small numbers, three minutes on two cores
    python examples/su_pets.py --paper  # the paper's numbers, three minutes on an H100
"""

import argparse
import dataclasses
from types import SimpleNamespace

import jax
import optax

import jaxpets
from jaxpets.envs import half_cheetah
from jaxpets.rewards import epistemic, max_variance

PAPER = SimpleNamespace(
    trials=60, steps=1000, hidden_sizes=(200,) * 4, epochs=5, particles=20, horizon=30,
    samples=500, elites=50, iterations=5, precision=jaxpets.Precision.BF16,
)  # fmt: skip
SMALL = SimpleNamespace(
    trials=24, steps=250, hidden_sizes=(100,) * 2, epochs=10, particles=5, horizon=15,
    samples=64, elites=8, iterations=3, precision=jaxpets.Precision.F32,
)  # fmt: skip
TINY = SimpleNamespace(**vars(SMALL) | {"trials": 2, "steps": 10})

parser = argparse.ArgumentParser()
parser.add_argument("--paper", action="store_const", const=PAPER, dest="numbers")
parser.add_argument("--tiny", action="store_const", const=TINY, dest="numbers")
n = parser.parse_args().numbers or SMALL

# Section 3.1. The world moves by s' ~ f(s, a), and gives no reward.
env = half_cheetah.half_cheetah_native()

# Section 3.2, PETS. An ensemble learns f: each network maximises the likelihood of its
# own bootstrap of all transitions, in batches of 32.
config = jaxpets.EnsembleConfig(num_members=5, hidden_sizes=n.hidden_sizes)
space = half_cheetah.model_space()
model = jaxpets.ensemble(config, space, obs_size=18, action_size=6)
fitter = jaxpets.fitter(model, optax.adam(1e-3), jaxpets.FitConfig(n.epochs, 32))

# Particles imagine where actions lead, each with one network, on a GPU in half
# precision. CEM finds the best actions. The first is taken, then all are planned anew.
faster = dataclasses.replace(config, precision=n.precision)
imagined = jaxpets.ensemble(faster, space, obs_size=18, action_size=6)
rollout = jaxpets.fused_rollout(imagined, num_particles=n.particles)
search = jaxpets.optimizers.cem(
    horizon=n.horizon, action_low=env.action_low, action_high=env.action_high,
    num_samples=n.samples, num_elites=n.elites, num_iterations=n.iterations,
)  # fmt: skip

# Section 3.3. The reward is disagreement, the mean over dimensions of sqrt(v / w_base):
# v is the variance of the networks' mean particles, w_base the model's largest noise.
explorer = jaxpets.plan(rollout, epistemic, search)
w_base = jaxpets.RewardData(refresh=lambda _, params, __: max_variance(params))
learner = jaxpets.learner(
    env, model, fitter, w_base, trial_length=n.steps, capacity=n.trials * n.steps
)

# Section 4, phase 1: explore. A trial acts, adds what it saw to the data and trains.
trial = jax.jit(learner.step, static_argnums=0, donate_argnums=2)
planner = jaxpets.random_planner(env.action_low, env.action_high)  # at first
first_key, *keys, last_key = jax.random.split(jax.random.key(0), n.trials + 2)
state = learner.init(first_key)
for number, key in enumerate(keys, start=1):
    state, out = trial(planner, key, state)
    value, error = out.plans.value.mean(), out.fit.mse
    print(f"trial {number:2}: disagreement {value:6.2f}, model's error {error:6.2f}")
    planner = explorer

# Section 4, phase 2: perform. The same model plans for tasks it was never trained for.
actor = jaxpets.plan(rollout, half_cheetah.task_reward, search)


def perform(params, task, key):
    """Returns what the first attempt at a task earns: Table 1."""
    start_key, act_key = jax.random.split(key)
    start = jaxpets.start_trial(env, actor, start_key)
    given = jaxpets.PlanParams(params, task)
    _, seen, _ = jaxpets.unroll(env, actor, given, act_key, start, length=n.steps)
    return half_cheetah.task_reward(task, *seen).sum()


four_tasks = jax.jit(jax.vmap(perform, (None, 0, None)))
returns = four_tasks(state.params, half_cheetah.tasks(), last_key)
for name, value in zip(half_cheetah.TASK_NAMES, returns, strict=True):
    print(f"{name:>10} {value:8.1f}")
