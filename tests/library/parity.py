"""Random trials of a robot, laid beside the environment that it was made after.

A judge has `put(physics)`, `step(action)`, `reward(task, constants, action)`, `data`,
and `repeat`, for how many of its steps ours holds an action.
"""

import operator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxpets import envs
from jaxpets.envs import with_constants


class Rolled(NamedTuple):
    """Steps of random trials, `[trials, steps, ...]`: states, actions, rewards."""

    before: object
    actions: np.ndarray
    after: object
    rewards: np.ndarray


class Differences(NamedTuple):
    """The largest differences over all steps, and how many steps there were.

    Those of qpos, qvel and act are relative to the largest number in the array, or 1.
    `reward` is that of a control step; `flipped` counts the steps at which one of all
    or nothing differs. `positive` is how often each task earned something.
    """

    steps: int
    qpos: float
    qvel: float
    act: float
    reward: float
    flipped: int
    positive: dict


def start_keys(num_trials):
    """Returns the key of each trial's start."""
    keys = jax.random.split(jax.random.key(0), num_trials)
    return [jax.random.split(key, 4)[0] for key in keys]


def rolled(robot, num_trials, num_steps, near_fn=None):
    """Random trials; `near_fn` moves the start of the second half of them."""
    env, tasks = robot.env, robot.tasks

    def trial(key, is_near):
        start_key, strength_key, near_key, key = jax.random.split(key, 4)
        strength = jax.random.uniform(strength_key, (), jnp.float32)
        start = env.reset(start_key)
        if near_fn is not None:
            near = near_fn(robot.model, near_key, start.physics)
            physics = jax.tree.map(
                lambda a, b: jnp.where(is_near, a, b), near, start.physics
            )
            start = start._replace(physics=physics)

        def step(state, key):
            noise = jax.random.uniform(key, env.action_low.shape, jnp.float32)
            action = env.action_low + noise * (env.action_high - env.action_low)
            after = env.step(state, strength * action)

            def reward(row):
                params = envs.with_constants(row, state.constants)
                return tasks.reward_fn(params, state.obs, strength * action, after.obs)

            rewards = jax.vmap(reward)(tasks.params)
            return after, Rolled(state, strength * action, after, rewards)

        return jax.lax.scan(step, start, jax.random.split(key, num_steps))[1]

    keys = jax.random.split(jax.random.key(0), num_trials)
    is_near = 2 * jnp.arange(num_trials) >= num_trials
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(trial))(keys, is_near))


def at(tree, place):
    """Returns one step of one trial."""
    return jax.tree.map(lambda x: x[place], tree)


def differences(robot, judge, trials):
    """Steps the judge from each state of trials, with the same action."""
    names = robot.tasks.names
    worst = {"qpos": 0.0, "qvel": 0.0, "act": 0.0, "reward": 0.0}
    flipped = 0
    num_trials, num_steps = trials.rewards.shape[:2]
    for place in np.ndindex(num_trials, num_steps):
        before, action, after, rewards = at(trials, place)
        judge.put(before.physics)
        judge.step(np.asarray(action, np.float64))
        for field in ("qpos", "qvel", "act"):
            want = np.array(getattr(judge.data, field))
            if want.size:
                error = np.abs(getattr(after.physics, field) - want).max()
                error = float(error / max(1.0, np.abs(want).max()))
                worst[field] = max(worst[field], error)
        for got, task in zip(rewards, names, strict=True):
            want = judge.reward(task, before.constants, action)
            if want is None:  # a task of ours
                continue
            error = abs(float(got) / judge.repeat - float(want))
            if error > 0.5 and want in (0.0, 1.0):
                flipped += 1
            else:
                worst["reward"] = max(worst["reward"], error)
    counts = (trials.rewards > 0).sum(axis=(0, 1)).tolist()
    positive = dict(zip(names, counts, strict=True))
    return Differences(num_trials * num_steps, *worst.values(), flipped, positive)


def assert_nothing_is_earned_by_nan(robot):
    """So that `plan` rejects what has diverged in imagination, in every task."""
    env, tasks = robot.env, robot.tasks
    constants = env.reset(jax.random.key(0)).constants
    obs = env.reset(jax.random.key(0)).obs
    for i, name in enumerate(tasks.names):
        task = jax.tree.map(operator.itemgetter(i), tasks.params)
        task = with_constants(task, constants)
        action = jnp.zeros(env.action_low.shape)
        assert np.isfinite(tasks.reward_fn(task, obs, action, obs)), name
        nothing = jnp.full_like(obs, jnp.nan)
        assert not np.isfinite(tasks.reward_fn(task, obs, action, nothing)), name
