"""One gradient step of a policy and two critics towards a planner, and its plans."""

from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.actor_critic_networks import Networks
from jaxpets._src.actor_critic_records import ActorCriticParams
from jaxpets._src.distill_records import DistillState, Plans
from jaxpets._src.guards import guarded_step
from jaxpets._src.optimizer import Optimizer
from jaxpets._src.symlog import symlog


def keep(state: DistillState, plans: Plans) -> DistillState:
    """Returns the state with plans `[E, B, ...]` in the places of the oldest."""
    capacity, count = state.plans.counts.shape[0], plans.counts.size

    def put(old: Array, new: Array) -> Array:
        rows = new.reshape(count, *old.shape[1:])
        return jax.lax.dynamic_update_slice_in_dim(old, rows, state.cursor, 0)

    return state._replace(
        plans=jax.tree.map(put, state.plans, plans),
        size=jnp.minimum(state.size + count, capacity),
        cursor=(state.cursor + count) % capacity,
    )


def build_update(
    networks: Networks, optimizer: Optimizer, batch_size: int
) -> Callable[[DistillState, Array], tuple[DistillState, Array]]:
    """Builds the step, `(state, key) -> (state, skipped [])`; see `distill`."""

    def loss(
        trained: tuple[Any, Any], params: ActorCriticParams, plans: Plans
    ) -> Array:
        actor, critics = trained
        own = jnp.tanh(networks.propose(actor, plans.seen))
        off = jnp.sum((own - plans.action) ** 2, axis=-1)
        value = networks.judge(critics, plans.seen, plans.action)
        wanted = symlog(params.scale * plans.value, params.squash)
        off += jnp.sum((value - wanted) ** 2, axis=0)
        weight = plans.counts / jnp.maximum(jnp.sum(plans.counts), 1.0)
        return jnp.sum(weight * off)

    def update(state: DistillState, key: Array) -> tuple[DistillState, Array]:
        chosen = jax.random.randint(key, (batch_size,), 0, jnp.maximum(state.size, 1))
        batch = Plans(*(x[chosen] for x in state.plans))
        params = state.params
        old = (params.actor, params.critics)
        grads = cast(Any, jax.grad(loss)(old, params, batch))
        (actor, critics), opt_state, good = guarded_step(
            optimizer.update, grads, old, state.opt_state
        )
        params = params._replace(actor=actor, critics=critics)
        return state._replace(params=params, opt_state=opt_state), ~good

    return update
