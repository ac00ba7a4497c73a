"""What a plan asks of a machine: candidates, and operations."""

import jax
import jax.numpy as jnp
from jax import Array

from benchmarks import workloads
from experiments.cost import model_flops
from jaxpets.envs import half_cheetah


def candidates_per_action(size: workloads.Size, search: str) -> int:
    """Returns how many action sequences are rolled out for one action."""
    if search != "icem":
        return size.num_samples * size.num_iterations
    counts = []  # iCEM's population shrinks; ask it, without running it

    def objective(key: Array, actions: Array) -> Array:
        del key
        counts.append(actions.shape[0])
        return jnp.zeros(actions.shape[:1], jnp.float32)

    built = workloads.optimizer(size, search)
    jax.eval_shape(lambda key: built.step(objective, key, built.init()),
                   jax.random.key(0))  # fmt: skip
    return sum(counts)


def rollout_flops(size: workloads.Size, num_candidates: int) -> float:
    """Returns the operations in the network's matrix products, two per multiply-add."""
    steps = num_candidates * size.num_particles * size.horizon
    # Pitch is read as sine and cosine, and no finite-difference velocity.
    read = half_cheetah.OBS_SIZE + half_cheetah.ACTION_SIZE
    widths = (read, *size.hidden_sizes, 2 * half_cheetah.OBS_SIZE)
    return model_flops(widths) * steps
