"""Searches over action sequences: what `jaxpets.plan` maximises with.

Numbers of a search that shape no array, as a temperature or a momentum, may be traced
float32 scalars. Settings are then swept with one compilation, by building the search
within the function that is mapped::

    def value(temperature, key):
        search = mppi(temperature=temperature, ...)
        planner = jaxpets.plan(rollout, reward, search)
        return planner.step(params, key, planner.init(), obs)[0].value

    jax.jit(jax.vmap(value, (0, None)))(temperatures, key)

A number of Python is a constant of the program, which XLA may round otherwise.
"""

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
