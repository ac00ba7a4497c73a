"""A policy for all tasks that the model alone teaches, before a planner is asked.

A search finds other actions each time that do as well, of which a network would learn
the mean. An actor that climbs a critic settles for one of them.
"""

import dataclasses
import time
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.sharding import PartitionSpec as P

import jaxpets
from jaxpets.envs import Tasks
from jaxpets.policies import ActorCriticParams

from . import acting, critic
from .build import Parts, imagined_end
from .config import Config
from .parallel import devices
from .parallel.devices import SEED, Placement
from .policy import family
from .storage.folder import RunFolder

_KNOWN = jaxpets.PlanParams(P(SEED), P())  # tasks are shared
_SEEDS = P(SEED)


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
      config: with the numbers of a critic, of which the width is the distiller's.
      parts: made with it.
      tasks: the family.
      placement: of seeds.
      params: models `[S]`, and the params of tasks `[K]`.
      keys: `[S]`.
      dataset: `[S]`, where imagined trials begin.
      run: that is told.
    """
    width = config.distill.hidden_size
    config = dataclasses.replace(
        config, critic=dataclasses.replace(config.critic, hidden_size=width)
    )
    robot = parts.robot
    actor = critic.make_critic(
        config, robot, parts.model, imagined_end(robot.env),
        family(robot, len(tasks.names)),
    )  # fmt: skip

    def program(function: Any, takes: Any, gives: Any, **options: Any) -> Any:
        over_seeds = acting.over(function, takes, SEED)
        return jax.jit(devices.split(placement, over_seeds, takes, gives), **options)

    init = program(actor.init, (_KNOWN, _SEEDS, _SEEDS), _SEEDS)
    learn = program(
        actor.step, (_KNOWN, _SEEDS, _SEEDS, _SEEDS), (_SEEDS, _SEEDS),
        donate_argnums=2,
    )  # fmt: skip
    begin = time.monotonic()
    keys, now = acting.split_keys(keys)
    state = init(params, now, dataset)
    count, updates = critic.calls(config)
    skipped: Any = 0
    for _ in range(count):
        keys, now = acting.split_keys(keys)
        state, metrics = learn(params, now, state, dataset)
        jax.block_until_ready(state)
        skipped += metrics.num_skipped
    value, skipped, networks = devices.collect(
        placement, (metrics.value, skipped, state.params), SEED
    )
    earned = float(jnp.mean(value)) * (1 - config.critic.discount)
    run.say(
        f"imagined policy: {count * updates:,} gradient steps for all tasks; it "
        f"expects {earned:.3f} a step  {time.monotonic() - begin:.1f} s"
    )
    if lost := int(jnp.sum(skipped)):
        run.say(
            f"warning: {lost:,} gradient steps of the imagined policy were not finite: "
            "left out"
        )
    return networks
