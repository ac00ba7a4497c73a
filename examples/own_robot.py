"""Bring a robot of your own: explored without a reward, then told to do two things.

`docs/own_robot.md` walks through this file, which takes two minutes on two cores.
"""

import functools
import sys

import jax
import optax

import jaxpets
from jaxpets import coordinates, datasets, envs
from jaxpets.rewards import epistemic

num_trials, num_steps = (2, 10) if "--tiny" in sys.argv else (12, 100)

HOPPER = """<mujoco> <option timestep="0.01"/> <default> <geom type="capsule" size=".05"
    density="300"/> </default> <worldbody> <geom type="plane" size="9 9 1"/>
  <body pos="0 0 .85"> <geom fromto="0 0 0 0 0 .2"/>
    <joint name="x" type="slide" axis="1 0 0"/> <joint name="z" type="slide"/>
    <body> <geom fromto="0 0 0 0 0 -.4"/>
      <joint name="hip" axis="0 1 0" range="-40 40" damping="2" armature=".2"/>
      <body pos="0 0 -.4"> <geom fromto="0 0 0 0 0 -.4"/>
        <joint name="leg" type="slide" range="-.2 .2" damping="5" stiffness="300"/>
      </body> </body> </body> </worldbody> <actuator>
    <motor joint="hip" gear="30" ctrlrange="-1 1"/>
    <motor joint="leg" gear="100" ctrlrange="-1 1"/> </actuator> </mujoco>"""
env = envs.mujoco_env(HOPPER, control_step=0.05)
rows, low, high = env.coordinates, env.action_low, env.action_high
speed, height = (coordinates.index(rows, name) for name in ("mean_qvel/x", "qpos/z"))
tasks = envs.tasks_of({
    "forward": lambda constants, obs, action, next_obs: next_obs[..., speed],
    "high": lambda constants, obs, action, next_obs: next_obs[..., height],
})  # fmt: skip

config, space = jaxpets.EnsembleConfig(hidden_sizes=(100, 100)), coordinates.space(rows)
model = jaxpets.ensemble(config, space, obs_size=len(rows), action_size=len(low))
fitter = jaxpets.fitter(model, optax.adam(1e-3), jaxpets.FitConfig(20, final_rate=0.05))
rollout = jaxpets.fused_rollout(model, num_particles=5)
search = jaxpets.optimizers.icem(horizon=15, action_low=low, action_high=high)
explorer = jaxpets.plan(rollout, epistemic, search)
actor = jaxpets.plan(rollout, tasks.reward_fn, search)
w_base = jaxpets.RewardData(refresh=lambda _, __, data: datasets.obs_variance(data))
size = {"trial_length": num_steps, "capacity": num_trials * num_steps}
learner = jaxpets.learner(env, model, fitter, w_base, **size)
trial, state = jax.jit(learner.step, static_argnums=0), learner.init(jax.random.key(0))
for number in range(num_trials):
    planner = explorer if number else jaxpets.random_planner(low, high)
    state, out = trial(planner, jax.random.key(number), state)
    print(f"trial {number + 1:2}: model's error {out.fit.mse:6.3f}")

key = jax.random.key(num_trials)
perform = jax.jit(functools.partial(jaxpets.unroll, env, actor, length=num_steps))
for name, task in zip(tasks.names, tasks.params, strict=True):
    start = jaxpets.start_trial(env, actor, key)
    _, seen, _ = perform(jaxpets.PlanParams(state.params, task), key, start)
    print(f"{name:8} {tasks.reward_fn(task, *seen).mean():6.2f}")
