"""How a model lies in a GPU's memory: sizes, weights, instructions."""

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

# Of a block on an H100 or H200, without what CUDA keeps.
SHARED_MEMORY = 232_448
_DEPTH = 16  # of one tensor core instruction
_TILE = 64  # rows of one
_MAX_COLUMNS = 256  # of one
# Chunks that stream together, and slots for them. Few large ones: each is waited for.
_RINGS = ((6, 2), (4, 3), (4, 2))
_HALF_MAX = 65504.0

IntArray: TypeAlias = npt.NDArray[np.integer[Any]]


@dataclasses.dataclass(frozen=True)
class GpuLayout:
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

    @property
    def input_size(self) -> int:
        """F + A."""
        return self.feature_size + self.action_size

    @property
    def width(self) -> int:
        """Columns of a hidden layer; both halves need some."""
        return max(24, _round_up(max(self.hidden_sizes), 8))

    @property
    def left(self) -> int:
        """Columns of the left half, the larger one."""
        return _round_up(_round_up(self.width, 16) // 2, 16)

    @property
    def head(self) -> int:
        """Columns of the means, and again of the log-variances."""
        return _round_up(self.obs_size, 8)

    def problem(self) -> str | None:
        """Returns why no kernel has this shape, or None."""
        if not self.hidden_sizes:
            return "there is no hidden layer"
        if self.width > _MAX_COLUMNS:
            return f"hidden layers are wider than {_MAX_COLUMNS}"
        if 2 * self.head > _MAX_COLUMNS:
            return f"observations have more than {_MAX_COLUMNS // 2} entries"
        if self.input_size > _MAX_COLUMNS:
            return f"features and action have more than {_MAX_COLUMNS} entries"
        if self.streaming() is None:
            return "the model does not fit into the GPU's shared memory"
        return None

    def streaming(self) -> "Streaming | None":
        """Returns how to split the weights between shared memory and the ring.

        As much as fits stays in shared memory. The left halves of hidden layers stream
        first: the right halves' products then never wait. A ring that takes all that
        streams of a layer is preferred.
        """
        chunks = _chunks(self.width)
        found: list[Streaming] = []
        for most, slots in _RINGS:
            unit = min(most, chunks)
            half = chunks // unit * unit
            for streamed in range(0, 2 * half + 1, unit):
                left = min(streamed, half)
                streaming = Streaming(left, streamed - left, unit, slots)
                if self._shared_bytes(streaming) <= SHARED_MEMORY:
                    found.append(streaming)
                    break
        whole = [s for s in found if s.left + s.right <= s.unit * s.slots]
        return (*whole, *found, None)[0]

    def _shared_bytes(self, streaming: "Streaming") -> int:
        inputs, hidden = _chunks(self.input_size), _chunks(self.width)
        right = self.width - self.left
        columns = inputs * self.width + hidden * 2 * self.head
        columns += (len(self.hidden_sizes) - 1) * (
            (hidden - streaming.left) * self.left + (hidden - streaming.right) * right
        )
        columns += streaming.slots * streaming.unit * self.left
        obs_words = _round_up(self.obs_size, 4) // 4
        numbers = 2 * _round_up(self.input_size, 4) + 16 * obs_words
        tile = 4 * 2 * _TILE * 4 * (obs_words | 1)  # state and target
        tile += 2 * _TILE * (_DEPTH * inputs + 8) + 8 * _TILE  # inputs and offsets
        return 2 * _DEPTH * columns + 4 * numbers + 2 * tile + 512  # and barriers

    def header(self) -> str:
        """Returns the constants of the C++ sources."""
        streaming = self.streaming()
        assert streaming is not None
        constants = {
            "OBS": self.obs_size,
            "ACTION": self.action_size,
            "FEATURES": self.feature_size,
            "WIDTH": self.width,
            "LAYERS": len(self.hidden_sizes),
            "LEFT_STREAMED": streaming.left,
            "RIGHT_STREAMED": streaming.right,
            "UNIT": streaming.unit,
            "SLOTS": streaming.slots,
        }
        lines = [f"constexpr int {name} = {n};" for name, n in constants.items()]
        return "\n".join(lines)

    def products(self) -> str:
        """Returns the tensor core instructions of the two widths as C++."""
        widths = sorted({self.left, self.width - self.left, 2 * self.head})
        return "\n".join(["template <int COLUMNS> struct Wgmma;", *map(_wgmma, widths)])

    def pack(self, layers: Sequence[Mapping[str, Array]]) -> Array:
        """Returns weights and biases `[E, *]` of all layers, float16.

        Args:
          layers: `kernel` `[E, in, out]` and `bias` `[E, out]` of each, in order.
        """
        *hidden, head = layers
        # The kernel computes swish(2 h) = h + h tanh(h).
        halved = [{name: x / 2 for name, x in layer.items()} for layer in hidden]
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
                columns = np.concatenate([entries, self.head + entries])
                matrices.append(_placed(layer, rows, columns, 2 * self.head))
            else:
                matrix = _placed(layer, rows, np.arange(outputs), self.width)
                matrices += [matrix[:, : self.left], matrix[:, self.left :]]
        return np.concatenate([_blocks(matrix) for matrix in matrices])


@dataclasses.dataclass(frozen=True)
class Streaming:
    """Chunks that stream of each half layer, how many at once, and the ring's slots."""

    left: int
    right: int
    unit: int
    slots: int


def _round_up(x: int, multiple: int) -> int:
    return math.ceil(x / multiple) * multiple


def _chunks(rows: int) -> int:
    return math.ceil((rows + 2) / _DEPTH)  # two more for the bias


def _numbers(layer: Mapping[str, Array]) -> Array:
    """Returns a layer's numbers `[E, in + 2, out]` as float16.

    The rows are those of the weights, then the biases rounded, and what that left.
    """
    bias = layer["bias"][:, None]
    rounded = _half(bias)
    rest = _half(bias - rounded.astype(jnp.float32))
    return jnp.concatenate([_half(layer["kernel"]), rounded, rest], axis=1)


def _placed(layer: IntArray, rows: int, columns: IntArray, width: int) -> IntArray:
    """Returns the kernel's matrix of a layer: of whole chunks, 0 where nothing lies.

    Args:
      layer: the layer's matrix; its last two rows hold the biases.
      rows: how many the kernel has for weights; the biases follow.
      columns: where each of the layer's is in the kernel's matrix.
      width: columns of the kernel's matrix.
    """
    matrix = np.zeros((_DEPTH * _chunks(rows), width), np.int32)
    matrix[: len(layer) - 2, columns] = layer[:-2]
    matrix[rows : rows + 2, columns] = layer[-2:]
    return matrix


def _blocks(matrix: IntArray) -> IntArray:
    """Lays a matrix out as chunks of 16 rows, each as blocks of 8 x 8.

    Order within a chunk: 8 columns, two halves of the rows, column, row.
    """
    height, columns = matrix.shape
    matrix = matrix.reshape(height // _DEPTH, 2, 8, columns // 8, 8)
    return matrix.transpose(0, 3, 1, 4, 2).ravel()


def _half(array: Array) -> Array:
    return jnp.clip(array, -_HALF_MAX, _HALF_MAX).astype(jnp.float16)


def _wgmma(columns: int) -> str:
    count = columns // 2
    sums = ", ".join(f"%{i}" for i in range(count))
    a0, a1, a2, a3, weights, add = (f"%{count + i}" for i in range(6))
    outputs = ", ".join(f'"+f"(sums[{i}])' for i in range(count))
    return f"""template <> struct Wgmma<{columns}> {{
  static __device__ __forceinline__ void multiply(
      float (&sums)[{count}], uint32_t a0, uint32_t a1, uint32_t a2, uint32_t a3,
      uint64_t weights, int add) {{
    asm volatile(
        "{{\\n.reg .pred add;\\nsetp.ne.b32 add, {add}, 0;\\n"
        "wgmma.mma_async.sync.aligned.m64n{columns}k16.f32.f16.f16 "
        "{{{sums}}}, {{{a0}, {a1}, {a2}, {a3}}}, {weights}, add, 1, 1, 0;\\n}}"
        : {outputs}
        : "r"(a0), "r"(a1), "r"(a2), "r"(a3), "l"(weights), "r"(add));
  }}
}};"""
