"""The sizes of one rollout kernel, and its parameters laid out as it reads them."""

import dataclasses
import math

import jax
import jax.numpy as jnp
from jax import Array

# Of a block on an H100 or H200, without what CUDA keeps.
SHARED_MEMORY = 232_448
_DEPTH = 16  # of one tensor core instruction
_TILE = 64  # rows of one
_MAX_COLUMNS = 256  # of one
_UNIT = 4  # chunks that stream together
_HALF_MAX = 65504.0


@dataclasses.dataclass(frozen=True)
class KernelShape:
    """What is fixed when a kernel is compiled. Widths are those of the model.

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
        first: the right halves' products then never wait.
        """
        chunks = _chunks(self.width)
        unit = min(_UNIT, chunks)
        most = chunks // unit * unit
        for slots in (3, 2):
            for streamed in range(0, 2 * most + 1, unit):
                left = min(streamed, most)
                streaming = Streaming(left, streamed - left, unit, slots)
                if self._shared_bytes(streaming) <= SHARED_MEMORY:
                    return streaming
        return None

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

    def pack(self, layers: list[dict[str, Array]]) -> Array:
        """Returns weights and biases `[E, *]` of all layers, float16.

        Args:
          layers: `kernel` `[E, in, out]` and `bias` `[E, out]` of each, in order.
        """
        *hidden, output = layers
        # The kernel computes swish(2 h) = h + h tanh(h).
        hidden = [jax.tree.map(lambda x: x / 2, layer) for layer in hidden]
        rows = [self.input_size] + [self.width] * len(hidden)
        blocks = []
        for layer, size in zip(hidden, rows[:-1], strict=True):
            kernel, bias = (
                _pad(layer[name], self.width) for name in ("kernel", "bias")
            )
            for half in (slice(None, self.left), slice(self.left, None)):
                blocks.append(_blocks(kernel[..., half], bias[..., half], size))
        means, raws = (
            {name: _pad(part[..., half], self.head) for name, part in output.items()}
            for half in (slice(None, self.obs_size), slice(self.obs_size, None))
        )
        kernel, bias = (
            jnp.concatenate([means[name], raws[name]], axis=-1)
            for name in ("kernel", "bias")
        )
        blocks.append(_blocks(kernel, bias, rows[-1]))
        return jnp.concatenate(blocks, axis=-1)


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


def _pad(array: Array, size: int) -> Array:
    """Pads the last axis with zeros."""
    widths = [(0, 0)] * (array.ndim - 1) + [(0, size - array.shape[-1])]
    return jnp.pad(array, widths)


def _blocks(kernel: Array, bias: Array, rows: int) -> Array:
    """Lays a layer, or half of one, out as chunks of 16 rows, each as blocks of 8 x 8.

    The bias stands below the `rows` rows, as float16 and, in the row after, what that
    left. Order within a chunk: 8 columns, two halves of the rows, column, row.
    """
    kernel = _half(jnp.pad(kernel, ((0, 0), (0, rows - kernel.shape[1]), (0, 0))))
    rounded = _half(bias)
    rest = _half(bias - rounded.astype(jnp.float32))
    whole = jnp.concatenate([kernel, rounded[:, None], rest[:, None]], axis=1)
    members, _, columns = whole.shape
    height = _DEPTH * _chunks(rows)
    whole = jnp.pad(whole, ((0, 0), (0, height - rows - 2), (0, 0)))
    whole = whole.reshape(members, height // _DEPTH, 2, 8, columns // 8, 8)
    return whole.transpose(0, 1, 4, 2, 5, 3).reshape(members, -1)


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
