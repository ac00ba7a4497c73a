"""Policies and values of a task, learned from a model alone."""

from jaxpets._src.actor_critic import actor_critic
from jaxpets._src.actor_critic_records import (
    ActorCritic,
    ActorCriticConfig,
    ActorCriticMetrics,
    ActorCriticParams,
    ActorCriticState,
    Goals,
    Guided,
)

__all__ = [
    "ActorCritic",
    "ActorCriticConfig",
    "ActorCriticMetrics",
    "ActorCriticParams",
    "ActorCriticState",
    "Goals",
    "Guided",
    "actor_critic",
]
