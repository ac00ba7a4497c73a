"""How a model lies in the memory of a Hopper GPU, and its instructions."""

import dataclasses
from collections.abc import Mapping

from jaxpets._src.kernel.gpu_layout import DEPTH, GpuLayout, chunks, round_up

# Of a block on an H100 or H200, without what CUDA keeps.
SHARED_MEMORY = 232_448
_TILE = 64  # rows of one instruction
_SLICE = 16  # and of one by which older GPUs multiply
# Chunks that stream together, and slots for them. Few large ones: each is waited for.
_RINGS = ((6, 2), (4, 3), (4, 2))


@dataclasses.dataclass(frozen=True)
class Streaming:
    """Chunks that stream of each half layer, how many at once, and the ring's slots."""

    left: int
    right: int
    unit: int
    slots: int


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
        """Returns what streams of the halves of a layer, and through which ring."""
        streaming = self.streaming()
        assert streaming is not None
        return {
            "LEFT_STREAMED": streaming.left,
            "RIGHT_STREAMED": streaming.right,
            "UNIT": streaming.unit,
            "SLOTS": streaming.slots,
        }

    def streaming(self) -> "Streaming | None":
        """Returns how to split the weights between shared memory and the ring.

        As much as fits stays in shared memory. The left halves of hidden layers stream
        first: the right halves' products then never wait. A ring that takes all that
        streams of a layer is preferred.
        """
        count = chunks(self.width)
        found: list[Streaming] = []
        for most, slots in _RINGS:
            unit = min(most, count)
            half = count // unit * unit
            for streamed in range(0, 2 * half + 1, unit):
                left = min(streamed, half)
                streaming = Streaming(left, streamed - left, unit, slots)
                if self._shared_bytes(streaming) <= SHARED_MEMORY:
                    found.append(streaming)
                    break
        whole = [s for s in found if s.left + s.right <= s.unit * s.slots]
        return (*whole, *found, None)[0]

    def _shared_bytes(self, streaming: "Streaming") -> int:
        inputs, hidden = chunks(self.input_size), chunks(self.width)
        right = self.width - self.left
        columns = inputs * self.width + hidden * 2 * self.head
        columns += (len(self.hidden_sizes) - 1) * (
            (hidden - streaming.left) * self.left + (hidden - streaming.right) * right
        )
        columns += streaming.slots * streaming.unit * self.left
        obs_words = round_up(self.obs_size, 4) // 4
        numbers = 2 * round_up(self.input_size, 4) + 16 * obs_words
        row = 4 * 2 * 4 * (obs_words | 1)  # state and target
        row += 2 * (DEPTH * inputs + 8) + 8  # inputs and offsets
        other = max(_TILE * row, _SLICE * (row + 2 * (DEPTH * hidden + 8)))
        # And barriers.
        return 2 * DEPTH * columns + 4 * numbers + _TILE * row + other + 512

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
