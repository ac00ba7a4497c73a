"""Exploration rewards, plain functions for `jaxpets.plan`, and their data."""

from jaxpets._src.ensemble_params import max_variance
from jaxpets._src.pseudo_counts import (
    PseudoCounts,
    count_states,
    lookup,
    pseudo_count,
    simhash,
)
from jaxpets._src.rewards import (
    epistemic,
    information_gain,
    one_step_disagreement,
    pessimistic,
)
from jaxpets._src.score import score

__all__ = [
    "PseudoCounts",
    "count_states",
    "epistemic",
    "information_gain",
    "lookup",
    "max_variance",
    "one_step_disagreement",
    "pessimistic",
    "pseudo_count",
    "score",
    "simhash",
]
