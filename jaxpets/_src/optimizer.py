"""What optax brings: the check of an optimizer, and the numbers of an Adam."""

from typing import Any, NamedTuple, TypeAlias, cast

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
import optax
from jax import Array

FloatArray: TypeAlias = npt.NDArray[np.float32]
Optimizer = optax.GradientTransformation
# Gradients that tell one Adam from another: two, of three updates.
_PROBES = ((1.0, 1e-8), (-0.3, 2.0), (1e-3, -1e-7))


class Adam(NamedTuple):
    """The numbers of `optax.adam`."""

    rate: float
    b1: float
    b2: float
    eps: float


def check_optimizer(optimizer: Any) -> None:
    """Raises unless `optimizer` is one of optax."""
    if not isinstance(optimizer, optax.GradientTransformation):
        kind = type(optimizer).__name__
        raise TypeError(
            f"optimizer must be of optax, as optax.adam(1e-3), got {optimizer!r} "
            f"({kind})."
        )


def adam_of(optimizer: Optimizer) -> Adam | None:
    """Returns the numbers of an optimizer that is `optax.adam` with a constant rate.

    They are inside its functions. So it is tried out, and what an Adam with the numbers
    found does is compared with what it does.

    Returns:
      An Adam, or None if the optimizer is anything else, or has an eps of 0.
    """
    # Optimizers of optax do not trace under strict promotion, if a caller set it.
    with jax.ensure_compile_time_eval(), jax.numpy_dtype_promotion("standard"):
        try:
            seen, state = _tried(optimizer)
        except Exception:
            # It has a rate that is traced, or is for the parameters of a network alone,
            # as with a mask: whatever its functions raise of these two numbers.
            return None
        plain: Any = optax.adam(1.0).init(jnp.zeros(2, jnp.float32))
        if jax.tree.structure(state) != jax.tree.structure(plain) or not np.all(seen):
            return None
        b1, b2 = (_rounded(1 - moment[0], 6) for moment in (state[0].mu, state[0].nu))
        share = float(seen[0, 1] / seen[0, 0])  # of a whole step
        # It is g (1 + eps) / (g + eps) for a gradient g.
        is_less = 1e-8 < share < 1.0
        eps = _rounded(1e-8 * (1.0 - share) / (share - 1e-8), 4) if is_less else 0.0
        if eps <= 0.0:  # what has no gradient would become 0 / 0 in a kernel
            return None
        unit, _ = _tried(optax.adam(1.0, b1, b2, eps))
        rate = float(seen[0, 0]) / float(unit[0, 0])
        if np.isclose(_rounded(rate, 6), rate, rtol=5e-7, atol=0.0):
            rate = _rounded(rate, 6)
        mine, _ = _tried(optax.adam(rate, b1, b2, eps))
    same = np.allclose(seen, mine, rtol=1e-6, atol=0.0)
    return Adam(rate, b1, b2, eps) if same else None


def _tried(optimizer: Optimizer) -> tuple[FloatArray, Any]:
    """Returns an Adam's updates for the probes, and its state after the first."""
    params = jnp.asarray((1.0, -2.0), jnp.float32)  # an Adam does not look at them
    state: Any = optimizer.init(params)
    updates: list[Any] = []
    states: list[Any] = []
    for row in _PROBES:
        update, state = optimizer.update(jnp.asarray(row, jnp.float32), state, params)
        updates.append(np.asarray(cast(Array, update)))
        states.append(state)
    return np.stack(updates), states[0]


def _rounded(number: Any, digits: int) -> float:
    """Returns the number that was written where float32 has come close to it."""
    return float(f"{float(number):.{digits}g}")
