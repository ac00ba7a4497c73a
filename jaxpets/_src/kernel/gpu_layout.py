"""How a model lies in a GPU's memory: sizes and weights, for every kernel there."""

import abc
import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

DEPTH = 16  # of one tensor core instruction
_HALF_MAX = 65504.0

IntArray: TypeAlias = npt.NDArray[np.integer[Any]]


@dataclasses.dataclass(frozen=True)
class GpuLayout(abc.ABC):
    """What is fixed when a GPU's kernel is compiled. Widths are those of the model.

    Attributes:
      obs_size: D.
      action_size: A.
      feature_size: F.
      hidden_sizes: of the model; the kernel pads all to the widest.
    """

    obs_size: int
    action_size: int
    feature_size: int
    hidden_sizes: tuple[int, ...]

    most_units: ClassVar[int] = 256  # of a hidden layer
    most_entries: ClassVar[int] = 128  # of an observation
    most_inputs: ClassVar[int] = 256  # features and action

    @property
    def input_size(self) -> int:
        """F + A."""
        return self.feature_size + self.action_size

    @property
    def width(self) -> int:
        """Columns of a hidden layer; if it is cut in halves, both need some."""
        return max(24, round_up(max(self.hidden_sizes), 8))

    @property
    @abc.abstractmethod
    def left(self) -> int:
        """Columns of a hidden layer whose chunks come first, before all others."""

    @property
    @abc.abstractmethod
    def fragments(self) -> bool:
        """Whether weights lie as a warp's lanes hold them, or in blocks of 8 x 8."""

    @property
    def head(self) -> int:
        """Columns of the means, and again of the log-variances."""
        return round_up(self.obs_size, 8)

    def problem(self) -> str | None:
        """Returns why no kernel has this shape, or None."""
        if not self.hidden_sizes:
            return "there is no hidden layer"
        if max(self.hidden_sizes) > self.most_units:
            return f"hidden layers are wider than {self.most_units}"
        if self.obs_size > self.most_entries:
            return f"observations have more than {self.most_entries} entries"
        if self.input_size > self.most_inputs:
            return f"features and action have more than {self.most_inputs} entries"
        return self.misfit()

    @abc.abstractmethod
    def misfit(self) -> str | None:
        """Returns why a model of allowed sizes has no room, or None."""

    @abc.abstractmethod
    def block(self) -> Mapping[str, int]:
        """Returns how a block of threads works, as constants of the C++ sources."""

    def products(self) -> str:
        """Returns what of the kernel's C++ has to be written for each model."""
        return ""

    def header(self) -> str:
        """Returns the constants of the C++ sources."""
        constants = {
            "OBS": self.obs_size,
            "ACTION": self.action_size,
            "FEATURES": self.feature_size,
            "WIDTH": self.width,
            "LAYERS": len(self.hidden_sizes),
            "LEFT": self.left,
            "FRAGMENTS": int(self.fragments),
            **self.block(),
        }
        lines = [f"constexpr int {name} = {n};" for name, n in constants.items()]
        return "\n".join(lines)

    def pack(
        self, layers: Sequence[Mapping[str, Array]], activation: str = "swish"
    ) -> Array:
        """Returns weights and biases `[E, *]` of all layers, float16.

        Args:
          layers: `kernel` `[E, in, out]` and `bias` `[E, out]` of each, in order.
          activation: of the hidden ones.
        """
        *hidden, head = layers
        # The kernel computes swish(2 h) = h + h tanh(h), and gelu much alike.
        share = 0.5 if activation in ("swish", "gelu") else 1.0
        halved = [{name: share * x for name, x in layer.items()} for layer in hidden]
        members = head["bias"].shape[0]
        numbers = [jnp.zeros((members, 1), jnp.float16)]
        numbers += [_numbers(layer).reshape(members, -1) for layer in (*halved, head)]
        flat = jnp.concatenate(numbers, axis=1)
        return flat.at[:, self._places()].get(mode="promise_in_bounds")

    def _places(self) -> IntArray:
        """Returns, for every number that the kernel reads, its place in the model.

        Places are counted through the layers, from 1 on, each as `_numbers` has it. At
        place 0 is a zero, which fills the kernel's matrices up to their larger sizes.
        """
        sizes = (self.input_size, *self.hidden_sizes, 2 * self.obs_size)
        last = len(self.hidden_sizes)
        matrices: list[IntArray] = []
        first = 1
        for i, (inputs, outputs) in enumerate(itertools.pairwise(sizes)):
            end = first + (inputs + 2) * outputs
            layer = np.arange(first, end, dtype=np.int32).reshape(inputs + 2, outputs)
            first = end
            rows = self.width if i else self.input_size
            if i == last:
                entries = np.arange(self.obs_size)
                means, variances = entries, self.head + entries
                if self.fragments:  # of 8 entries the means, then the log-variances
                    means = entries // 8 * 16 + entries % 8
                    variances = means + 8
                columns = np.concatenate([means, variances])
                matrices.append(_placed(layer, rows, columns, 2 * self.head))
            else:
                matrix = _placed(layer, rows, np.arange(outputs), self.width)
                matrices += [matrix[:, : self.left], matrix[:, self.left :]]
        lay_out = _fragments if self.fragments else _blocks
        return np.concatenate([lay_out(matrix) for matrix in matrices])


def round_up(x: int, multiple: int) -> int:
    """Returns the least multiple that is not below x."""
    return math.ceil(x / multiple) * multiple


def chunks(rows: int) -> int:
    """Returns how many chunks hold so many rows of weights, and the biases."""
    return math.ceil((rows + 2) / DEPTH)


def _numbers(layer: Mapping[str, Array]) -> Array:
    """Returns a layer's numbers `[E, in + 2, out]` as float16.

    The rows are those of the weights, then the biases rounded, and what that left.
    """
    bias = layer["bias"][:, None]
    # Not converted there and back: XLA for GPUs leaves that out, and no rest is left.
    rounded = jax.lax.reduce_precision(_within_half(bias), 5, 10)
    rows = [layer["kernel"], rounded, bias - rounded]
    return jnp.concatenate([_half(row) for row in rows], axis=1)


def _placed(layer: IntArray, rows: int, columns: IntArray, width: int) -> IntArray:
    """Returns the kernel's matrix of a layer: of whole chunks, 0 where nothing lies.

    Args:
      layer: the layer's matrix; its last two rows hold the biases.
      rows: how many the kernel has for weights; the biases follow.
      columns: where each of the layer's is in the kernel's matrix.
      width: columns of the kernel's matrix.
    """
    matrix = np.zeros((DEPTH * chunks(rows), width), np.int32)
    matrix[: len(layer) - 2, columns] = layer[:-2]
    matrix[rows : rows + 2, columns] = layer[-2:]
    return matrix


def _blocks(matrix: IntArray) -> IntArray:
    """Lays a matrix out as chunks of 16 rows, each as blocks of 8 x 8.

    Order within a chunk: 8 columns, two halves of the rows, column, row.
    """
    height, columns = matrix.shape
    matrix = matrix.reshape(height // DEPTH, 2, 8, columns // 8, 8)
    return matrix.transpose(0, 3, 1, 4, 2).ravel()


def _fragments(matrix: IntArray) -> IntArray:
    """Lays a matrix out as chunks of 16 rows, each as a warp's lanes hold it.

    Order within a chunk: 16 columns, lane, two halves of them, two halves of the rows,
    two rows. Eight columns that are left over are as 16, but for the halves.
    """
    height, columns = matrix.shape
    count, pairs = height // DEPTH, columns // 16
    # A lane has a column and every fourth pair of rows.
    eights = matrix.reshape(count, 2, 4, 2, columns // 8, 8)
    eights = eights.transpose(0, 4, 5, 2, 1, 3)
    paired = eights[:, : 2 * pairs].reshape(count, pairs, 2, 32, 4).swapaxes(2, 3)
    parts = [paired.reshape(count, -1), eights[:, 2 * pairs :].reshape(count, -1)]
    return np.concatenate(parts, axis=1).ravel()


def _half(array: Array) -> Array:
    return _within_half(array).astype(jnp.float16)


def _within_half(array: Array) -> Array:
    return jnp.clip(array, -_HALF_MAX, _HALF_MAX)
