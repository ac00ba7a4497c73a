"""Exploration rewards, all of them plain functions for `jaxpets.plan`."""

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

__all__ = [
    "PseudoCounts",
    "count_states",
    "epistemic",
    "information_gain",
    "lookup",
    "one_step_disagreement",
    "pessimistic",
    "pseudo_count",
    "simhash",
]
