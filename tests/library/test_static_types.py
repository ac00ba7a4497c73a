"""What a type checker tells a user who builds a loop, and what it catches."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

import jaxpets

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("pyright") is None, reason="pyright is not installed"
)

SCRIPT = """
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

import jaxpets
from jaxpets.optimizers import cem, mppi

space = jaxpets.delta_space()
model = jaxpets.ensemble(jaxpets.EnsembleConfig(), space, obs_size=2, action_size=1)
reveal_type(model)
fitter = jaxpets.fitter(model, optax.adam(1e-3), jaxpets.FitConfig())
rollout = jaxpets.fused_rollout(model, num_particles=20)
reveal_type(rollout.uses_kernel)
one = np.ones(1, np.float32)
search = cem(horizon=5, action_low=-one, action_high=one)
reveal_type(search)


def reach(target: Array, obs: Array, action: Array, next_obs: Array) -> Array:
    return -jnp.abs(next_obs[..., 0] - target)


planner = jaxpets.plan(rollout, reach, search)
reveal_type(planner)
key = jax.random.key(0)
params = jaxpets.PlanParams(model.init(key), jnp.ones(()))
output, state = planner.step(params, key, planner.init(), jnp.zeros(2))
reveal_type(output.action)


def reset(key: Array) -> jaxpets.EnvState:
    return jaxpets.EnvState(jnp.zeros(2), ())


def step(state: jaxpets.EnvState, action: Array) -> jaxpets.EnvState:
    return state._replace(obs=state.obs + action)


env = jaxpets.Env(reset, step, jnp.asarray(-one), jnp.asarray(one))
learner = jaxpets.learner(env, model, fitter, trial_length=10, capacity=20)
reveal_type(learner)
trial = learner.step(planner, key, learner.init(key))
reveal_type(trial)
reveal_type(trial[1].fit.nll)
reveal_type(jaxpets.over_seeds(learner, 3))
reveal_type(jaxpets.rewards.max_variance(trial[0].params))
"""

REVEALED = [
    "Ensemble",
    "bool",
    "TrajectoryOptimizer",
    "Planner",
    "Array",
    "Learner",
    "tuple[LearnerState, TrialOutput]",
    "Array",
    "Learner",
    "Array",
]

MISTAKES = """

def short(target: Array, obs: Array, action: Array) -> Array:
    return target


jaxpets.plan(rollout, short, search)  # a reward without the next observation
jaxpets.fitter(model, 1e-3, jaxpets.FitConfig())
planner.step(model.init(key), key, state, jnp.zeros(2))
mppi(horizon=5, action_low=-one, action_high=one, num_elites=3)
learner.step(search, key, learner.init(key))
jaxpets.over_seeds(learner, 3.0)
"""
NUM_MISTAKES = 6


@pytest.fixture(scope="module")
def checked(tmp_path_factory):
    """What pyright says of the script and the mistakes behind it, by line."""
    folder = tmp_path_factory.mktemp("user")
    (folder / "loop.py").write_text(SCRIPT + MISTAKES)
    settings = {
        "typeCheckingMode": "strict",
        "reportUnknownMemberType": False,
        "reportMissingTypeStubs": False,
        "reportUnusedExpression": False,
        "extraPaths": [str(Path(jaxpets.__file__).parents[1])],
    }
    (folder / "pyrightconfig.json").write_text(json.dumps(settings))
    command = [sys.executable, "-m", "pyright", "--outputjson"]
    command += ["--pythonpath", sys.executable, "--project", str(folder)]
    # It exits with 1 because it finds the mistakes.
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=folder, check=False
    )
    return json.loads(done.stdout)["generalDiagnostics"]


def said(checked, severity):
    """`(line, message)` of what has this severity."""
    return [
        (item["range"]["start"]["line"], item["message"])
        for item in checked
        if item["severity"] == severity
    ]


def test_a_users_loop_has_types(checked):
    end = len(SCRIPT.splitlines())
    assert [entry for entry in said(checked, "error") if entry[0] < end] == []
    revealed = [message.split('"')[3] for _, message in said(checked, "information")]
    assert revealed == REVEALED


def test_each_mistake_is_caught(checked):
    lines = (SCRIPT + MISTAKES).splitlines()
    wrong = {line for line, _ in said(checked, "error")}
    calls = {
        i for i, text in enumerate(lines) if i >= len(lines) - NUM_MISTAKES and text
    }
    assert wrong == calls
