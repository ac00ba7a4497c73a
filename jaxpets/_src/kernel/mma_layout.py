"""How a model lies in the memory of a GPU of compute capability 8.0 and later."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

from jaxpets._src.kernel.gpu_layout import DEPTH, GpuLayout, chunks, round_up

# Of a block where there is least, on compute capability 8.6, 8.9 and 12.0.
SHARED_MEMORY = 101_376
_TILE = 16  # particles of one instruction
# Of a block: weights come from L2 once for all its particles, which so are many; with
# more, their sums would not fit into registers.
_MOST_TILES = 5


@dataclasses.dataclass(frozen=True)
class MmaLayout(GpuLayout):
    """All weights stream, in the order in which they are used."""

    most_units: ClassVar[int] = 512
    most_entries: ClassVar[int] = 256
    most_inputs: ClassVar[int] = 512

    @property
    def warps(self) -> int:
        """Warps of a block: with twice as many a wide layer is as much for each."""
        return 4 if super().width <= 256 else 8

    @property
    def width(self) -> int:
        """Columns of a hidden layer: of 64 at most 32 are for no warp alone."""
        width, shared = super().width, 16 * self.warps
        return width if width % shared <= 32 else round_up(width, shared)

    @property
    def left(self) -> int:
        """All columns: a layer is not cut."""
        return self.width

    @property
    def fragments(self) -> bool:
        """Yes: they go straight to registers."""
        return True

    def misfit(self) -> str | None:
        """Returns None: there is room for a few particles of the largest model."""
        return None

    def block(self) -> Mapping[str, int]:
        """Returns of how many warps and tiles a block is: of as many as have room."""
        fitting = (n for n in range(_MOST_TILES, 1, -1) if self._fits(n))
        return {
            "WARPS": self.warps,
            "TILES": next(fitting, 1),
            "SHARED_MEMORY": SHARED_MEMORY,
        }

    def _fits(self, tiles: int) -> bool:
        return self.shared_bytes(tiles) <= SHARED_MEMORY

    def shared_bytes(self, tiles: int) -> int:
        """Returns the shared memory of a block, as mma_rollout.cu declares it."""
        obs_words = round_up(self.obs_size, 4) // 4
        numbers = 2 * round_up(self.input_size, 4) + 16 * obs_words
        state = 4 * (obs_words | 1)
        operand = DEPTH * max(chunks(self.input_size), chunks(self.width)) + 8
        rollout = 6 * 8 + 4 * 4 + 8 + 4 * 6 * 8 + 8 + 4 * 4  # its part, and a key
        row = 4 * 2 * state + 2 * operand + 4 * 2
        return 4 * numbers + _TILE * tiles * row + rollout
