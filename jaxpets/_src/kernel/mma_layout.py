"""How a model lies in the memory of a GPU of compute capability 8.0 and later."""

import dataclasses
from collections.abc import Mapping

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

    @property
    def width(self) -> int:
        """Columns of a hidden layer: of 64 at most 32 are for no warp alone."""
        width = super().width
        return width if width % 64 <= 32 else round_up(width, 64)

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

    def ring(self) -> Mapping[str, int]:
        """Returns of how many tiles a block is: of as many as have room."""
        fitting = (n for n in range(_MOST_TILES, 1, -1) if self._fits(n))
        return {"TILES": next(fitting, 1), "SHARED_MEMORY": SHARED_MEMORY}

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
