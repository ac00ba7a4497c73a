"""Plan with your own model and your own reward: three goals in one `vmap`.

python examples/own_model.py
"""

import jax
import jax.numpy as jnp

import jaxpets


def cart(dt, key, obs, action):  # obs [..., 2] in m and m/s, action [..., 1] in N
    """Moves carts of 1 kg by one step of dt seconds; a model may also use the key."""
    velocity = obs[..., 1] + dt * action[..., 0]
    return jnp.stack([obs[..., 0] + dt * velocity, velocity], axis=-1)


def reach(goal, obs, action, next_obs):
    """Rewards being at the goal, and a little not to push."""
    return -((next_obs[..., 0] - goal) ** 2) - 1e-3 * jnp.sum(action**2)


force = jnp.ones(1)
search = jaxpets.optimizers.cem(horizon=20, action_low=-force, action_high=force)
planner = jaxpets.plan(jaxpets.particle_rollout(cart), reach, search)


def drive(goal, key):
    """Drives one cart for 80 steps of 0.1 s; returns where it is and how fast."""
    params = jaxpets.PlanParams(dynamics=0.1, reward=goal)

    def step(carry, key):
        obs, state = carry
        plan, state = planner.step(params, key, state, obs)
        return (cart(0.1, key, obs, plan.action), state), None

    start = jnp.zeros(2), planner.init()
    (obs, _), _ = jax.lax.scan(step, start, jax.random.split(key, 80))
    return obs


goals = jnp.array([-1.0, 0.5, 2.0])
reached = jax.jit(jax.vmap(drive, (0, None)))(goals, jax.random.key(0))
for goal, (position, velocity) in zip(goals, reached, strict=True):
    print(f"goal {goal:5.2f} m: at {position:5.2f} m, {velocity:5.2f} m/s")
