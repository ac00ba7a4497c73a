"""Model-based reinforcement learning that explores without a reward, in JAX.

Functions named by a noun build: they take functions, sizes and options, and return a
record of pure functions, such as a Planner with `init` and `step`. Functions named by a
verb act. (`plan` and `distill` build too: a rollout, a reward and a search become a
planner, and a planner becomes a policy.)
Nothing is jitted, keeps state or draws from a global key. All arrays are float32, and
all keys typed (`jax.random.key`).

The shapes in the docstrings have these letters::

  N  candidate action sequences (num_samples)
  H  planning horizon
  E  ensemble members
  P  particles per member (num_particles = E * P)
  B  rows of a batch of one member; N * P inside a rollout
  D  observation size
  F  size of what the network reads of an observation
  A  action size
  T  environment steps
  C  dataset capacity
  S  seeds

Members come first, then rows: `[E, B, ...]`. A reward sees the particles of one
candidate at one step, `[E, P, D]`, and returns `[E, P]` or `[]`.
"""

from jaxpets import coordinates as coordinates
from jaxpets import datasets, optimizers, rewards, typing
from jaxpets import formulas as formulas
from jaxpets import models as models
from jaxpets import policies as policies
from jaxpets._src.agent import agent
from jaxpets._src.check_space import check_space
from jaxpets._src.distill import distill
from jaxpets._src.ensemble import Ensemble, delta_space, ensemble
from jaxpets._src.ensemble_config import EnsembleConfig
from jaxpets._src.ensemble_params import EnsembleParams
from jaxpets._src.fit_records import FitConfig
from jaxpets._src.fitter import fitter
from jaxpets._src.fused_fitter import fused_fitter
from jaxpets._src.fused_rollout import fused_rollout
from jaxpets._src.learner import RewardData, learner
from jaxpets._src.model_file import load_model, save_model
from jaxpets._src.network import Precision
from jaxpets._src.over_seeds import SEED_AXES, over_seeds
from jaxpets._src.per_state import per_state
from jaxpets._src.plan import plan
from jaxpets._src.pretrained import pretrained
from jaxpets._src.random_planner import random_planner
from jaxpets._src.rollout import particle_rollout
from jaxpets._src.types import (
    Env,
    EnvState,
    ModelSpace,
    Planner,
    PlanParams,
    Transition,
)
from jaxpets._src.unroll import start_trial, unroll

__version__ = "0.1.0"

__all__ = [
    "SEED_AXES",
    "Ensemble",
    "EnsembleConfig",
    "EnsembleParams",
    "Env",
    "EnvState",
    "FitConfig",
    "ModelSpace",
    "PlanParams",
    "Planner",
    "Precision",
    "RewardData",
    "Transition",
    "agent",
    "check_space",
    "datasets",
    "delta_space",
    "distill",
    "ensemble",
    "fitter",
    "fused_fitter",
    "fused_rollout",
    "learner",
    "load_model",
    "optimizers",
    "over_seeds",
    "particle_rollout",
    "per_state",
    "plan",
    "pretrained",
    "random_planner",
    "rewards",
    "save_model",
    "start_trial",
    "typing",
    "unroll",
]
