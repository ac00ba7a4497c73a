"""The numbers of an ensemble: sizes of its networks and coefficients of its loss."""

import dataclasses
from typing import Any

from jaxpets._src.checks import (
    check_count,
    check_counts,
    check_real,
    check_reals,
    check_record,
    is_sequence,
    keep_checked,
)
from jaxpets._src.network import ACTIVATIONS, Precision


@dataclasses.dataclass(frozen=True)
class EnsembleConfig:
    """The network and loss of PETS on HalfCheetah.

    Attributes:
      num_members: E.
      hidden_sizes: widths of the hidden layers.
      weight_decays: one per layer, the output layer last; each times `sum(w^2) / 2`.
        One number is that of every layer. None is PETS's: 2.5e-5 for the first layer,
        5e-5 for the second, 1e-4 for the output and 7.5e-5 for all between.
      bound_decay: pull of the loss on the log-variance bounds.
      precision: of the matrix products. It changes no parameter, so an ensemble may be
        trained in one precision and planned with in another.
      state_margin: imagined states may leave the range of the data by this share of
        its width; None leaves them free. Not in PETS: without it a learned model can
        blow up while every number stays finite, and a planner that looks for
        disagreement finds that.
      activation: of the hidden layers: "swish" as in PETS, "tanh", "relu" or "gelu" (by
        way of tanh).
    """

    num_members: int = 5
    hidden_sizes: tuple[int, ...] = (200, 200, 200, 200)
    weight_decays: float | tuple[float, ...] | None = None
    bound_decay: float = 0.01
    precision: Precision = Precision.TF32
    state_margin: float | None = 0.5
    activation: str = "swish"

    def __post_init__(self) -> None:
        keep_checked(self, "num_members", check_count)
        keep_checked(self, "hidden_sizes", check_counts)
        num_layers = len(self.hidden_sizes) + 1
        keep_checked(self, "weight_decays", _check_decays, num_layers)
        keep_checked(self, "bound_decay", check_real, 0.0)
        check_record("precision", self.precision, Precision)
        if self.state_margin is not None:
            keep_checked(self, "state_margin", check_real, 0.0)
        if self.activation not in ACTIVATIONS:
            valid = ", ".join(ACTIVATIONS)
            raise ValueError(
                f"activation must be one of {valid}, got {self.activation!r}."
            )


def _check_decays(name: str, decays: Any, num_layers: int) -> Any:
    if decays is None:
        return None
    if not is_sequence(decays):
        return check_real(name, decays, 0.0)
    if len(decays) == num_layers:
        return check_reals(name, decays, 0.0)
    raise ValueError(
        f"{name} must be a number or one per layer ({num_layers}), got {len(decays)}."
    )


def layer_decays(config: EnsembleConfig) -> tuple[float, ...]:
    """Returns the weight decay of every layer, the output layer last."""
    decays, num_hidden = config.weight_decays, len(config.hidden_sizes)
    if isinstance(decays, (tuple, list)):
        return tuple(decays)
    if decays is not None:
        return (decays,) * (num_hidden + 1)
    inner = (2.5e-5, 5e-5, *(7.5e-5,) * num_hidden)[:num_hidden]
    return (*inner, 1e-4)
