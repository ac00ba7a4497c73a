"""Networks: a member of the ensemble, how its products are rounded, and a head."""

import enum
import functools
from collections.abc import Callable
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

# Added to the variance of a layer that is normalised.
NORM_EPSILON = 1e-6


class Precision(enum.Enum):
    """How the matrix products of the network are computed; they add up in float32."""

    F32 = "f32"
    TF32 = "tf32"  # float32 where the hardware has no TF32
    BF16 = "bf16"


class Network(nn.Module):
    """One member: hidden layers and a linear output of means and raw log-variances."""

    hidden_sizes: tuple[int, ...]
    output_size: int
    precision: Precision
    activation: str = "swish"

    @nn.compact
    def __call__(self, x: Array) -> Array:
        activate = _FUNCTIONS[self.activation]
        for i, size in enumerate(self.hidden_sizes):
            x = activate(self._dense(i, size, x))
        return self._dense(len(self.hidden_sizes), self.output_size, x)

    def _dense(self, index: int, size: int, x: Array) -> Array:
        # PETS: normal cut at two deviations, std = 1 / (2 sqrt(fan_in)); zero biases.
        init = nn.initializers.truncated_normal(1.0 / (2.0 * x.shape[-1] ** 0.5))
        is_output = index == len(self.hidden_sizes)
        product = functools.partial(_dot_general, self.precision, is_output)
        layer = nn.Dense(
            size, kernel_init=init, dot_general=product, name=f"layer_{index}"
        )
        return layer(x)


class Head(nn.Module):
    """An actor or a critic: two layers, normalised, and a linear output near zero.

    Layer normalisation bounds what a critic says of actions that it has not seen (Ball
    et al., 2023).
    """

    hidden_size: int
    output_size: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        for _ in range(2):
            x = nn.elu(
                nn.LayerNorm(epsilon=NORM_EPSILON)(nn.Dense(self.hidden_size)(x))
            )
        small = nn.initializers.variance_scaling(0.01, "fan_in", "normal")
        return nn.Dense(self.output_size, kernel_init=small)(x)


def _swish(x: Array) -> Array:
    """`x * sigmoid(x)`."""

    def by_tanh(x: Array) -> Array:
        return 0.5 * x * jnp.tanh(0.5 * x) + 0.5 * x

    # The same function; XLA has a faster tanh than sigmoid for CPUs.
    return cast(Array, jax.lax.platform_dependent(x, cpu=by_tanh, default=nn.swish))


_FUNCTIONS: dict[str, Callable[[Array], Array]] = {
    "swish": _swish,
    "tanh": jnp.tanh,
    "relu": nn.relu,
    "gelu": functools.partial(nn.gelu, approximate=True),
}
ACTIVATIONS = tuple(_FUNCTIONS)  # the kernels know them by their places


def _dot_general(
    wanted: Precision,
    is_output: bool,
    lhs: Array,
    rhs: Array,
    dimension_numbers: Any,
    **_: Any,
) -> Array:
    """`lax.dot_general` in the wanted precision, as float32."""
    exact = jax.lax.Precision.HIGHEST if wanted is Precision.F32 else None

    def product(dtype: Any, lhs: Array, rhs: Array) -> Array:
        return jax.lax.dot_general(
            lhs, rhs, dimension_numbers, precision=exact, preferred_element_type=dtype
        ).astype(jnp.float32)

    full = functools.partial(product, jnp.float32)
    if wanted is not Precision.BF16:
        return full(lhs, rhs)
    lhs, rhs = lhs.astype(jnp.bfloat16), rhs.astype(jnp.bfloat16)
    if is_output:
        return full(lhs, rhs)
    # Hidden products are rounded anyway when the next layer reads them; written as
    # bfloat16 they are half the traffic, a fifth of a plan's time on an H200. XLA for
    # CPUs, however, multiplies in float32 what is to be written as bfloat16.
    half = functools.partial(product, jnp.bfloat16)
    return cast(Array, jax.lax.platform_dependent(lhs, rhs, cpu=full, default=half))
