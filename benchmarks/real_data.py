"""Real HalfCheetah transitions, from gymnasium's simulator and random actions."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

Arrays = dict[str, np.ndarray]
TRIAL_LENGTH = 1000
_RESET_STD = 0.001


class Split(NamedTuple):
    """Transitions of different trials; each has obs, action and next_obs."""

    train: Arrays
    test: Arrays


def collect(num_train: int, num_test: int, seed: int = 0) -> Split:
    """Runs trials of 1000 steps, half with uniform and half with smooth actions.

    Observations are those of PETS: the forward velocity over the last environment
    step, then the positions but for x, then the velocities.

    Args:
      num_train: transitions to train on, from whole trials.
      num_test: transitions to test on, drawn from four further trials.
      seed: of resets and actions.

    Returns:
      A Split in float32.
    """
    import gymnasium

    env: Any = gymnasium.make("HalfCheetah-v5").unwrapped
    rng = np.random.default_rng(seed)
    num_trials = -(-num_train // TRIAL_LENGTH)
    train = [_trial(env, rng, smooth=i % 2 == 1) for i in range(num_trials)]
    test = [_trial(env, rng, smooth=i % 2 == 1) for i in range(4)]
    kept = rng.choice(len(test) * TRIAL_LENGTH, num_test, replace=False)
    return Split(
        {name: _join(train, name)[:num_train] for name in train[0]},
        {name: _join(test, name)[kept] for name in test[0]},
    )


def load(path: Path) -> Split:
    """Reads what `save` wrote."""
    with np.load(path) as file:
        parts = [
            {name: file[f"{part}_{name}"] for name in ("obs", "action", "next_obs")}
            for part in Split._fields
        ]
    return Split(*parts)


def save(split: Split, path: Path) -> None:
    """Writes a Split as an npz file."""
    arrays = {
        f"{part}_{name}": array
        for part, arrays in split._asdict().items()
        for name, array in arrays.items()
    }
    with path.open("wb") as file:
        np.savez_compressed(file, **arrays)


def features(obs: np.ndarray) -> np.ndarray:
    """Returns what PETS shows its network: no velocity, pitch as sine and cosine."""
    pitch = obs[..., 2:3]
    parts = [obs[..., 1:2], np.sin(pitch), np.cos(pitch), obs[..., 3:]]
    return np.concatenate(parts, axis=-1)


def targets(arrays: Arrays) -> np.ndarray:
    """Returns what PETS predicts: the next velocity, and changes of all else."""
    change = arrays["next_obs"] - arrays["obs"]
    change[..., 0] = arrays["next_obs"][..., 0]
    return change


def _join(trials: list[Arrays], name: str) -> np.ndarray:
    return np.concatenate([trial[name] for trial in trials])


def _trial(env: Any, rng: np.random.Generator, *, smooth: bool) -> Arrays:
    """Runs one trial in C MuJoCo; its float64 state is kept as float32."""
    env.reset(seed=int(rng.integers(2**31)))
    env.set_state(
        env.init_qpos + _RESET_STD * rng.standard_normal(9),
        env.init_qvel + _RESET_STD * rng.standard_normal(9),
    )
    action = _smooth_actions(rng) if smooth else rng.uniform(-1, 1, (TRIAL_LENGTH, 6))
    action = action.astype(np.float32)
    obs = np.zeros((TRIAL_LENGTH + 1, 18), np.float32)
    obs[0, 1:] = np.concatenate([env.data.qpos[1:], env.data.qvel])
    for t in range(TRIAL_LENGTH):
        before = env.data.qpos[0]
        env.do_simulation(action[t], env.frame_skip)
        obs[t + 1, 0] = (env.data.qpos[0] - before) / env.dt
        obs[t + 1, 1:] = np.concatenate([env.data.qpos[1:], env.data.qvel])
    return {"obs": obs[:-1], "action": action, "next_obs": obs[1:]}


def _smooth_actions(rng: np.random.Generator) -> np.ndarray:
    """Draws actions that are correlated over about ten steps, half a second."""
    state = np.zeros(6)
    actions = np.empty((TRIAL_LENGTH, 6))
    for t in range(TRIAL_LENGTH):
        state = 0.9 * state + np.sqrt(1 - 0.9**2) * rng.standard_normal(6)
        actions[t] = np.clip(state, -1, 1)
    return actions
