"""Exploration rewards, plain functions for `jaxpets.plan`, and their data."""

from jaxpets._src.distillation import (
    Distillation,
    DistillationState,
    random_network_distillation,
)
from jaxpets._src.ensemble_params import max_variance
from jaxpets._src.one_step import (
    Plan2ExploreData,
    jensen_renyi,
    one_step_disagreement,
    opax,
    plan2explore,
)
from jaxpets._src.particle_entropy import (
    VisitedStates,
    particle_entropy,
    visited_states,
)
from jaxpets._src.pseudo_counts import (
    PseudoCounts,
    count_states,
    lookup,
    pseudo_count,
    simhash,
)
from jaxpets._src.rewards import (
    MixtureData,
    ensemble_std,
    epistemic,
    information_gain,
    mixture,
    pessimistic,
)
from jaxpets._src.score import score

__all__ = [
    "Distillation",
    "DistillationState",
    "MixtureData",
    "Plan2ExploreData",
    "PseudoCounts",
    "VisitedStates",
    "count_states",
    "ensemble_std",
    "epistemic",
    "information_gain",
    "jensen_renyi",
    "lookup",
    "max_variance",
    "mixture",
    "one_step_disagreement",
    "opax",
    "particle_entropy",
    "pessimistic",
    "plan2explore",
    "pseudo_count",
    "random_network_distillation",
    "score",
    "simhash",
    "visited_states",
]
