"""A planner that imagines without noise."""

from typing import Any

from jaxpets._src.checks import check_record
from jaxpets._src.ensemble_params import without_noise
from jaxpets._src.types import Planner, PlanParams


def by_means(planner: Planner) -> Planner:
    """Returns a planner of the same search that imagines the means of the members.

    Its `step` plans with `without_noise(params.dynamics)`, which says what that does.

    Args:
      planner: imagines by an ensemble of `jaxpets.ensemble`.

    Raises:
      TypeError: unless planner is a Planner; in `step`, what `without_noise` raises.
    """
    check_record("planner", planner, Planner)

    def step(params: PlanParams, *now: Any) -> Any:
        check_record("params", params, PlanParams)
        quiet = without_noise(params.dynamics)
        return planner.step(params._replace(dynamics=quiet), *now)

    return planner._replace(step=step)
