"""Policies and values of tasks, learned from a model alone; a policy comes along."""

from jaxpets._src.actor_critic import actor_critic
from jaxpets._src.actor_critic_networks import guided_reward
from jaxpets._src.actor_critic_records import (
    ActorCritic,
    ActorCriticConfig,
    ActorCriticMetrics,
    ActorCriticParams,
    ActorCriticState,
    Goals,
    Guided,
)
from jaxpets._src.distill_records import (
    DistillConfig,
    Distiller,
    DistillMetrics,
    DistillState,
)
from jaxpets._src.policy_file import load_policy, save_policy
from jaxpets._src.policy_onnx import to_onnx
from jaxpets._src.pretrained import policy_path as path
from jaxpets._src.prior import prior

__all__ = [
    "ActorCritic",
    "ActorCriticConfig",
    "ActorCriticMetrics",
    "ActorCriticParams",
    "ActorCriticState",
    "DistillConfig",
    "DistillMetrics",
    "DistillState",
    "Distiller",
    "Goals",
    "Guided",
    "actor_critic",
    "guided_reward",
    "load_policy",
    "path",
    "prior",
    "save_policy",
    "to_onnx",
]
