"""Everything that one annotates with: the contracts of functions, and the records."""

from jaxpets._src.agent import Agent
from jaxpets._src.ensemble import Ensemble
from jaxpets._src.ensemble_params import EnsembleParams, NetworkParams, Scaler
from jaxpets._src.fit_records import FitMetrics, FitState, Fitter
from jaxpets._src.fused_rollout import FusedRollout
from jaxpets._src.learner import Learner, LearnerState, RewardData, TrialOutput
from jaxpets._src.types import (
    Candidates,
    Coordinate,
    Dataset,
    DynamicsFn,
    Env,
    EnvState,
    ModelRolloutFn,
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
from jaxpets._src.unroll import UnrollState

__all__ = [
    "Agent",
    "Candidates",
    "Coordinate",
    "Dataset",
    "DynamicsFn",
    "Ensemble",
    "EnsembleParams",
    "Env",
    "EnvState",
    "FitMetrics",
    "FitState",
    "Fitter",
    "FusedRollout",
    "Learner",
    "LearnerState",
    "ModelRolloutFn",
    "ModelSpace",
    "NetworkParams",
    "ObjectiveFn",
    "PlanOutput",
    "PlanParams",
    "Planner",
    "RewardData",
    "RewardFn",
    "RolloutFn",
    "Scaler",
    "Solution",
    "TrajectoryOptimizer",
    "Transition",
    "TrialOutput",
    "UnrollState",
]
