"""Exploration rewards, plain functions for `jaxpets.plan`, and their data."""

from jaxpets._src.ensemble_params import max_variance
from jaxpets._src.one_step import jensen_renyi, one_step_disagreement, opax
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

__all__ = [
    "MixtureData",
    "PseudoCounts",
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
    "pessimistic",
    "pseudo_count",
    "simhash",
]
