"""Model-based reinforcement learning that explores without a reward, in JAX."""

from jaxpets import rewards
from jaxpets._src.cem import CEMState, cem
from jaxpets._src.dataset import (
    DATASET_AXES,
    append,
    grow,
    init_dataset,
    obs_variance,
)
from jaxpets._src.ensemble import (
    Ensemble,
    EnsembleConfig,
    EnsembleParams,
    Precision,
    delta_space,
    ensemble,
    max_variance,
)
from jaxpets._src.fit import FitConfig, FitMetrics, FitState, Fitter, fit
from jaxpets._src.fused_rollout import fused_rollout
from jaxpets._src.icem import ICEMState, colored_noise, icem
from jaxpets._src.learner import Learner, LearnerState, RewardData, TrialOutput, learner
from jaxpets._src.mppi import MPPIState, mppi
from jaxpets._src.plan import plan, random_planner
from jaxpets._src.rollout import particle_rollout
from jaxpets._src.sharded import sharded
from jaxpets._src.types import (
    WORST_VALUE,
    Dataset,
    DynamicsFn,
    Env,
    EnvState,
    ModelSpace,
    ObjectiveFn,
    Planner,
    PlanOutput,
    PlanParams,
    RewardFn,
    RolloutFn,
    Solution,
    TrajectoryOptimizer,
    Transition,
)
from jaxpets._src.unroll import UnrollState, start, unroll

__version__ = "0.1.0"

__all__ = [
    "DATASET_AXES",
    "WORST_VALUE",
    "CEMState",
    "Dataset",
    "DynamicsFn",
    "Ensemble",
    "EnsembleConfig",
    "EnsembleParams",
    "Env",
    "EnvState",
    "FitConfig",
    "FitMetrics",
    "FitState",
    "Fitter",
    "ICEMState",
    "Learner",
    "LearnerState",
    "MPPIState",
    "ModelSpace",
    "ObjectiveFn",
    "PlanOutput",
    "PlanParams",
    "Planner",
    "Precision",
    "RewardData",
    "RewardFn",
    "RolloutFn",
    "Solution",
    "TrajectoryOptimizer",
    "Transition",
    "TrialOutput",
    "UnrollState",
    "append",
    "cem",
    "colored_noise",
    "delta_space",
    "ensemble",
    "fit",
    "fused_rollout",
    "grow",
    "icem",
    "init_dataset",
    "learner",
    "max_variance",
    "mppi",
    "obs_variance",
    "particle_rollout",
    "plan",
    "random_planner",
    "rewards",
    "sharded",
    "start",
    "unroll",
]
