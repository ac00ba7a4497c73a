"""A policy for all tasks that the model alone teaches, before a planner is asked.

A search finds other actions each time that do as well, of which a network would learn
the mean. An actor that climbs a critic settles for one of them.
"""

from jax import Array
from jax.sharding import PartitionSpec as P

import jaxpets
from jaxpets.envs import Tasks
from jaxpets.policies import ActorCriticParams

from . import critic
from .build import Parts, imagined_end
from .config import Config, CriticConfig
from .parallel.devices import SEED, Placement
from .policy import family
from .storage.folder import RunFolder

_POLICIES = critic.Several(
    "an imagined policy of all tasks",
    (SEED,),
    jaxpets.PlanParams(P(SEED), P()),  # tasks are shared
    P(SEED),
)


def learned(
    config: Config,
    parts: Parts,
    tasks: Tasks,
    placement: Placement,
    params: jaxpets.PlanParams,
    keys: Array,
    dataset: jaxpets.typing.Dataset,
    run: RunFolder,
) -> ActorCriticParams:
    """Returns an actor and critics `[S]` that see the task, as the distiller's do.

    Args:
      config: with the numbers of distill, which also has the width of the networks.
      parts: made with it.
      tasks: the family.
      placement: of seeds.
      params: models `[S]`, and the params of tasks `[K]`.
      keys: `[S]`.
      dataset: `[S]`, where imagined trials begin.
      run: that is told.
    """
    own = config.distill
    settings = CriticConfig(**vars(own.critic), hidden_size=own.hidden_size)
    robot = parts.robot
    actor = critic.make_critic(
        settings, robot, parts.model, imagined_end(robot.env),
        family(robot, len(tasks.names)),
    )  # fmt: skip

    return critic.learned(
        settings, actor, _POLICIES, placement, params, keys, dataset, run
    )
