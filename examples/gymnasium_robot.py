"""Explore a Gymnasium environment without its reward, then do two things with it.

A pendulum too weak to be lifted at once stands up, and spins: a minute on two cores.
"""

import sys

import gymnasium
import numpy as np
import optax

import jaxpets
from jaxpets.rewards import epistemic, max_variance

num_trials, trial_length = (2, 12) if "--tiny" in sys.argv else (10, 100)

env = gymnasium.make("Pendulum-v1", max_episode_steps=trial_length)
torque = np.full(1, 2.0)  # N m; seen are cosine and sine of the angle, and its speed
config = jaxpets.EnsembleConfig(hidden_sizes=(64, 64))
model = jaxpets.ensemble(config, jaxpets.delta_space(), obs_size=3, action_size=1)
rollout = jaxpets.particle_rollout(model.sample, num_members=5, num_particles=5)
search = jaxpets.optimizers.icem(horizon=20, action_low=-torque, action_high=torque)


def task(wanted, obs, action, next_obs):
    """Rewards height in m and speed in rad/s, as much as each is wanted."""
    return wanted[0] * next_obs[..., 0] + wanted[1] * next_obs[..., 2]


agent = jaxpets.agent(
    jaxpets.plan(rollout, epistemic, search),
    model,
    jaxpets.fitter(model, optax.adam(1e-3), jaxpets.FitConfig(num_epochs=20)),
    random_planner=jaxpets.random_planner(-torque, torque),
    reward_data=jaxpets.RewardData(refresh=lambda _, params, __: max_variance(params)),
    capacity=num_trials * trial_length,
)


def trial(seed):
    """Acts until the time is up; returns what was seen, `[T, 3]`."""
    seen, ended = [env.reset(seed=seed)[0]], False
    while not ended:
        obs, _, _, ended, _ = env.step(agent.act(seen[-1]))
        agent.observe(obs, truncated=ended)
        seen.append(obs)
    return np.stack(seen)


for number in range(num_trials):
    trial(number)
    print(f"trial {number + 1:2}: model's error {agent.learn().mse:.4f}")

actor = jaxpets.plan(rollout, task, search)
for name, wanted in {"stand": (1.0, 0.0), "spin": (0.0, 1.0)}.items():
    agent.perform(np.array(wanted), actor)
    height, _, speed = trial(1000)[trial_length // 2 :].mean(axis=0)
    print(f"{name:5} height {height:5.2f} m, {speed:5.2f} rad/s")
