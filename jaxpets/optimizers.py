"""Searches over action sequences: what `jaxpets.plan` maximises with."""

from jaxpets._src.cem import CEMState, cem
from jaxpets._src.elites import WORST_VALUE
from jaxpets._src.icem import ICEMState, icem
from jaxpets._src.mppi import MPPIState, mppi
from jaxpets._src.sharded import sharded
from jaxpets._src.types import ObjectiveFn, Solution, TrajectoryOptimizer

__all__ = [
    "WORST_VALUE",
    "CEMState",
    "ICEMState",
    "MPPIState",
    "ObjectiveFn",
    "Solution",
    "TrajectoryOptimizer",
    "cem",
    "icem",
    "mppi",
    "sharded",
]
