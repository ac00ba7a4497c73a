"""What training is told, what it keeps, and what it tells."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

from jax import Array

from jaxpets._src.checks import check_count, check_flag, check_real, keep_checked
from jaxpets._src.ensemble_params import EnsembleParams
from jaxpets._src.types import Dataset


@dataclasses.dataclass(frozen=True)
class FitConfig:
    """How often and in what portions the data are shown; the defaults are PETS's.

    Attributes:
      num_epochs: passes over the data per call.
      batch_size: rows per member and gradient step.
      final_rate: the step size at the end of a call as a share of the optimizer's; it
        falls along a cosine and starts anew with every call (SGDR, Loshchilov and
        Hutter, 2017). 1 is PETS's constant rate, whose last steps leave noise in the
        weights that looks like disagreement.
      bootstrap: whether a member sees its own draw of rows, which leaves out a third
        of them, or every row, and differs by its first weights and order alone (deep
        ensembles, Lakshminarayanan et al., 2017).
    """

    num_epochs: int = 5
    batch_size: int = 32
    final_rate: float = 1.0
    bootstrap: bool = True

    def __post_init__(self) -> None:
        keep_checked(self, "num_epochs", check_count)
        keep_checked(self, "batch_size", check_count)
        keep_checked(self, "final_rate", check_real, 0.0, 1.0)
        check_flag("bootstrap", self.bootstrap)


class FitState(NamedTuple):
    """The warm start of training.

    Attributes:
      opt_state: what the optimizer keeps between calls.
    """

    opt_state: Any


class FitMetrics(NamedTuple):
    """How the last call went.

    Means leave out dropped updates; without any update that counts they are NaN.

    Attributes:
      nll: `[]`, mean over the last epoch of the negative log-likelihood that the
        ensemble minimises, without the penalties of its loss.
      mse: `[]`, mean squared error of the predicted mean, over members and dimensions,
        in units of the targets squared.
      num_updates: `[]` int32.
      num_skipped: `[]` int32, updates dropped because they were not finite.
    """

    nll: Array
    mse: Array
    num_updates: Array
    num_skipped: Array


class Fitter(NamedTuple):
    """Training as a pure function.

    Attributes:
      init: `(EnsembleParams) -> FitState`.
      step: `(params, key, state, dataset) -> (params, state, FitMetrics)`.
      compiler: name and version of the compiler of the kernel that trains, see
        `fused_fitter`; empty if none does.
      reason: why none does, if one was asked for.
    """

    init: Callable[[EnsembleParams], FitState]
    step: Callable[
        [EnsembleParams, Array, FitState, Dataset],
        tuple[EnsembleParams, FitState, FitMetrics],
    ]
    compiler: str = ""
    reason: str = ""

    @property
    def uses_kernel(self) -> bool:
        """Whether a kernel trains."""
        return bool(self.compiler)
