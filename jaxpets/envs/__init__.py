"""Environments; these modules need the extra `jaxpets[envs]`."""

from jaxpets.envs.adapters import env_rollout, from_brax

__all__ = ["env_rollout", "from_brax"]
