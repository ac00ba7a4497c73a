"""How a model lies in the memory of a Hopper GPU, and its instructions."""

import dataclasses
from collections.abc import Mapping

from jaxpets._src.kernel.gpu_layout import DEPTH, GpuLayout, chunks, round_up

# Of a block on an H100 or H200, without what CUDA keeps.
SHARED_MEMORY = 232_448
_TILE = 64  # rows of one instruction
_SLICE = 16  # and of one by which older GPUs multiply


@dataclasses.dataclass(frozen=True)
class Streaming:
    """Chunks of each half of a hidden layer that stream, its first ones."""

    left: int
    right: int


@dataclasses.dataclass(frozen=True)
class WgmmaLayout(GpuLayout):
    """Two halves of a hidden layer, one after the other: one is squashed meanwhile."""

    @property
    def left(self) -> int:
        """Columns of the left half, the larger one; both have some."""
        return round_up(round_up(self.width, 16) // 2, 16)

    @property
    def fragments(self) -> bool:
        """No: the tensor cores read weights in shared memory."""
        return False

    def misfit(self) -> str | None:
        """Returns whether too much of the model would have to stream."""
        if self.streaming() is None:
            return "the model does not fit into the GPU's shared memory"
        return None

    def block(self) -> Mapping[str, int]:
        """Returns what streams of the halves of a layer."""
        streaming = self.streaming()
        assert streaming is not None
        return {"LEFT_STREAMED": streaming.left, "RIGHT_STREAMED": streaming.right}

    def streaming(self) -> "Streaming | None":
        """Returns how to split the weights between shared memory and what streams.

        As much as fits stays in shared memory. The left half of hidden layers streams
        first: the products of the right half then never wait.
        """
        count = chunks(self.width)
        for streamed in range(2 * count + 1):
            left = min(streamed, count)
            streaming = Streaming(left, streamed - left)
            if self._shared_bytes(streaming) <= SHARED_MEMORY:
                return streaming
        return None

    def _shared_bytes(self, streaming: "Streaming") -> int:
        inputs, hidden = chunks(self.input_size), chunks(self.width)
        right = self.width - self.left
        streamed = streaming.left * self.left + streaming.right * right
        columns = inputs * self.width + hidden * 2 * self.head + streamed
        hidden_layers = len(self.hidden_sizes) - 1
        columns += hidden_layers * (hidden * self.width - streamed)
        obs_words = round_up(self.obs_size, 4) // 4
        numbers = 2 * round_up(self.input_size, 4) + 16 * obs_words
        row = 4 * 2 * 4 * (obs_words | 1)  # state and target
        row += 2 * (DEPTH * inputs + 8) + 8  # inputs and offsets
        activations = 2 * (DEPTH * hidden + 8)
        tile, of_slice = _TILE * row, _SLICE * (row + activations)
        return 2 * DEPTH * columns + 4 * numbers + tile + max(tile, of_slice) + 256

    def products(self) -> str:
        """Returns the tensor core instructions of the two widths as C++."""
        widths = sorted({self.left, self.width - self.left, 2 * self.head})
        return "\n".join(["template <int COLUMNS> struct Wgmma;", *map(_wgmma, widths)])


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
