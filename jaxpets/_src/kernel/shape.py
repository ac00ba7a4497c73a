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
_MOST_SLOTS = 6
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
        """Columns of a hidden layer."""
        return _round_up(max(self.hidden_sizes), 8)

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

        As much as fits stays in shared memory; hidden layers stream first.
        """
        chunks = [_chunks(self.input_size), _chunks(self.width)]
        for slots in range(_MOST_SLOTS, 1, -1):
            for hidden in range(chunks[1] + 1):
                streaming = Streaming(0, hidden, 0, slots)
                if self._shared_bytes(streaming) <= SHARED_MEMORY:
                    return streaming
        streaming = Streaming(chunks[0], chunks[1], chunks[1], 2)
        return streaming if self._shared_bytes(streaming) <= SHARED_MEMORY else None

    def _shared_bytes(self, streaming: "Streaming") -> int:
        hidden_chunk = 2 * _DEPTH * self.width
        output_chunk = 2 * _DEPTH * 2 * self.head
        inputs, hidden = _chunks(self.input_size), _chunks(self.width)
        resident = hidden_chunk * (inputs - streaming.input)
        resident += (
            hidden_chunk * (len(self.hidden_sizes) - 1) * (hidden - streaming.hidden)
        )
        resident += output_chunk * (hidden - streaming.output)
        ring = streaming.slots * max(hidden_chunk, output_chunk)
        numbers = 4 * (2 * self.input_size + 4 * self.obs_size)
        tile = 4 * _TILE * (self.obs_size | 1) + 2 * _TILE * (_DEPTH * inputs + 8)
        return resident + ring + numbers + 2 * tile + 512  # barriers, alignment

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
            "INPUT_STREAMED": streaming.input,
            "HIDDEN_STREAMED": streaming.hidden,
            "OUTPUT_STREAMED": streaming.output,
            "SLOTS": streaming.slots,
        }
        lines = [f"constexpr int {name} = {n};" for name, n in constants.items()]
        return "\n".join(lines)

    def products(self) -> str:
        """Returns the tensor core instructions of the two widths as C++."""
        widths = sorted({self.width, 2 * self.head})
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
        blocks = [
            _blocks(layer["kernel"], layer["bias"], size, self.width)
            for layer, size in zip(hidden, rows[:-1], strict=True)
        ]
        means, raws = (
            {name: _pad(part[..., half], self.head) for name, part in output.items()}
            for half in (slice(None, self.obs_size), slice(self.obs_size, None))
        )
        kernel, bias = (
            jnp.concatenate([means[name], raws[name]], axis=-1)
            for name in ("kernel", "bias")
        )
        blocks.append(_blocks(kernel, bias, rows[-1], 2 * self.head))
        return jnp.concatenate(blocks, axis=-1)


@dataclasses.dataclass(frozen=True)
class Streaming:
    """Chunks per layer that stream, and the slots of the ring they stream through."""

    input: int
    hidden: int
    output: int
    slots: int


def _round_up(x: int, multiple: int) -> int:
    return math.ceil(x / multiple) * multiple


def _chunks(rows: int) -> int:
    return math.ceil((rows + 2) / _DEPTH)  # two more for the bias


def _pad(array: Array, size: int) -> Array:
    """Pads the last axis with zeros."""
    widths = [(0, 0)] * (array.ndim - 1) + [(0, size - array.shape[-1])]
    return jnp.pad(array, widths)


def _blocks(kernel: Array, bias: Array, rows: int, columns: int) -> Array:
    """Lays one layer out as chunks of 16 rows, each as blocks of 8 x 8.

    The bias stands below the `rows` rows, as float16 and, in the row after, what that
    left. Order within a chunk: 8 columns, two halves of the rows, column, row.
    """
    kernel = _half(jnp.pad(kernel, ((0, 0), (0, rows - kernel.shape[1]), (0, 0))))
    rounded = _half(bias)
    rest = _half(bias - rounded.astype(jnp.float32))
    whole = jnp.concatenate([kernel, rounded[:, None], rest[:, None]], axis=1)
    members, _, width = whole.shape
    height = _DEPTH * _chunks(rows)
    whole = jnp.pad(whole, ((0, 0), (0, height - rows - 2), (0, columns - width)))
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
