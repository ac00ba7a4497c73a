"""HalfCheetah in C MuJoCo: where it gets to, and one step in double precision."""

import math

import mujoco
import numpy as np


def visited_states(model, count, seed=0):
    """Half upright, half tumbled: qpos, qvel, qacc_warmstart, each `[count, 9]`.

    A tumbled cheetah was dropped in a random posture and has come down on whatever
    came first; both halves act at random all the while, some weakly, so that they lie.
    """
    rng = np.random.default_rng(seed)
    data = mujoco.MjData(model)
    rows = []
    for i in range(count):
        mujoco.mj_resetData(model, data)
        tumbled = i >= count // 2
        if tumbled:
            data.qpos[1] = rng.uniform(0.2, 0.8)
            data.qpos[2] = rng.uniform(-math.pi, math.pi)
            low, high = model.jnt_range[3:].T
            data.qpos[3:] = rng.uniform(low, high)
            data.qvel[:] = rng.normal(size=9)
        else:
            data.qpos[:] += 0.001 * rng.normal(size=9)
            data.qvel[:] = 0.001 * rng.normal(size=9)
        strength = rng.uniform(0, 1)
        for _ in range(rng.integers(20, 60)):
            data.ctrl[:] = strength * rng.uniform(-1, 1, 6)
            mujoco.mj_step(model, data, 5)
        rows.append(np.stack([data.qpos, data.qvel, data.qacc_warmstart]))
    return np.stack(rows, axis=1).astype(np.float32)


def c_step(model, qpos, qvel, warmstart, actions):
    """One environment step in double precision from each state, and its contacts."""
    data = mujoco.MjData(model)
    after, contacts = [], []
    for i in range(len(qpos)):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
        data.qacc_warmstart[:] = warmstart[i]
        data.ctrl[:] = actions[i]
        seen = 0
        for _ in range(5):
            mujoco.mj_step(model, data)
            seen = max(seen, data.ncon)
        contacts.append(seen)
        after.append(np.stack([data.qpos, data.qvel]))
    return np.stack(after, axis=1), np.array(contacts)
