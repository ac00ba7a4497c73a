"""Write your own exploration objective: the Jensen-Renyi divergence of MAX.

A pendulum too weak to be lifted at once is explored without a reward: with random
torques, by `epistemic` disagreement, and by an objective written here. It prints the
share of all angles and speeds that each of them saw.

    python examples/exploration_bonus.py  # a minute on two cores
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np
import optax

import jaxpets

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--tiny", action="store_true", help="for a test of this file")
tiny = parser.parse_args().tiny
num_trials, trial_length, num_seeds = (2, 10, 1) if tiny else (8, 50, 2)

TORQUE, MAX_SPEED, TIMESTEP = jnp.full(1, 2.0), 8.0, 0.1  # N m, rad/s, s


def observe(angle, speed):
    """Returns the observation of a pendulum that hangs at angle 0."""
    obs = jnp.stack([jnp.cos(angle), jnp.sin(angle), speed])
    return jaxpets.EnvState(obs, physics=(angle, speed))


def reset(key):
    """Starts at rest, within a hundredth of a radian of hanging."""
    return observe(0.01 * jax.random.normal(key), jnp.zeros(()))


def swing(state, torque):
    """Turns a pendulum of 1 kg and 1 m by one step."""
    angle, speed = state.physics
    speed = speed + TIMESTEP * (torque[0] - 9.81 * jnp.sin(angle))
    speed = jnp.clip(speed, -MAX_SPEED, MAX_SPEED)
    return observe(angle + TIMESTEP * speed, speed)


env = jaxpets.Env(reset, swing, action_low=-TORQUE, action_high=TORQUE)
config = jaxpets.EnsembleConfig(hidden_sizes=(32, 32))
model = jaxpets.ensemble(config, jaxpets.delta_space(), obs_size=3, action_size=1)


def jensen_renyi(params, obs, action, next_obs):
    """Rewards what the members predict differently (Shyam et al., 2019, MAX).

    The divergence of order 2 of the members' Gaussians, `H(mixture) - mean_e H(e)` with
    `H(p) = -log integral p^2`, in closed form. Their means and variances come from the
    model, not from the particles of `next_obs`, which are too few to estimate them: as
    in MAX, all members predict from the same state, here that of each particle.
    """
    rows = obs.reshape(-1, obs.shape[-1])
    shown = jnp.stack([rows] * len(obs))  # every particle to every member
    actions = jnp.tile(action, (len(rows), 1))
    mean, variance = model.predict(params, shown, actions)  # [E, E * P, D]
    both = variance[:, None] + variance  # of each pair of members
    apart = (mean[:, None] - mean) ** 2 / both
    overlap = jnp.mean(jnp.exp(-jnp.sum(apart + jnp.log(both), -1) / 2), (0, 1))
    alone = jnp.mean(jnp.sum(jnp.log(2 * variance), -1) / 2, 0)
    return (-jnp.log(overlap) - alone).reshape(obs.shape[:2])


def epistemic(params, obs, action, next_obs):
    """The objective of SU-PETS, given the whole model as the other one."""
    w_base = jaxpets.rewards.max_variance(params)
    return jaxpets.rewards.epistemic(w_base, obs, action, next_obs)


rollout = jaxpets.particle_rollout(model.sample, num_members=5, num_particles=10)
search = jaxpets.optimizers.cem(
    horizon=20,
    action_low=env.action_low,
    action_high=env.action_high,
    num_samples=40,
    num_elites=5,
    num_iterations=3,
)
planners = {
    "random": jaxpets.random_planner(env.action_low, env.action_high),
    "epistemic": jaxpets.plan(rollout, epistemic, search),
    "jensen-renyi": jaxpets.plan(rollout, jensen_renyi, search),
}
learner = jaxpets.learner(
    env,
    model,
    jaxpets.fitter(model, optax.adam(1e-3), jaxpets.FitConfig(num_epochs=20)),
    jaxpets.RewardData(refresh=lambda data, params, dataset: params),
    trial_length=trial_length,
    capacity=num_trials * trial_length,
)
trial = jax.jit(learner.step, static_argnums=0)


def explore(planner, key):
    """Returns the share of 12 x 12 cells of angle and speed that were visited."""
    state = learner.init(key)
    for number in range(num_trials):
        now = planner if number else planners["random"]
        state, _ = trial(now, jax.random.fold_in(key, number), state)
    cos, sin, speed = np.asarray(state.dataset.data.next_obs).T
    box = [(-np.pi, np.pi), (-MAX_SPEED, MAX_SPEED)]
    visits, _, _ = np.histogram2d(np.arctan2(sin, cos), speed, bins=12, range=box)
    return np.mean(visits > 0)


for name, planner in planners.items():
    shares = [explore(planner, jax.random.key(seed)) for seed in range(num_seeds)]
    print(f"{name:12} saw {np.mean(shares):4.0%} of all states")
