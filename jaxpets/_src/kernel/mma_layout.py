"""How a model lies in the memory of a GPU of compute capability 8.0 and later."""

import dataclasses
from collections.abc import Mapping

from jaxpets._src.kernel.gpu_layout import DEPTH, GpuLayout, chunks, round_up

# Of a block where there is least, on compute capability 8.6, 8.9 and 12.0; and as much
# as leaves room for another block on the same multiprocessor.
SHARED_MEMORY = 101_376
_HALF = 50_176
_TILE = 64  # particles of a block
# Of the ring. Chunks come from L2 in the time of about two products.
_SLOTS = range(6, 2, -1)


@dataclasses.dataclass(frozen=True)
class MmaLayout(GpuLayout):
    """All weights stream, in the order in which they are used."""

    @property
    def left(self) -> int:
        """All columns: a layer is not cut."""
        return self.width

    def misfit(self) -> str | None:
        """Returns whether particles and inputs leave too little room for the ring."""
        if self.shared_bytes(_SLOTS[-1]) > SHARED_MEMORY:
            return "the model does not fit into the GPU's shared memory"
        return None

    def ring(self) -> Mapping[str, int]:
        """Returns the slots of the ring: as many as leave room for a second block."""
        fitting = [n for n in _SLOTS if self.shared_bytes(n) <= _HALF]
        return {"SLOTS": (*fitting, _SLOTS[-1])[0], "SHARED_MEMORY": SHARED_MEMORY}

    def shared_bytes(self, slots: int) -> int:
        """Returns the shared memory of a block, as mma_rollout.cu declares it."""
        obs_words = round_up(self.obs_size, 4) // 4
        ring = slots * 2 * DEPTH * max(self.width, 2 * self.head)
        numbers = 2 * round_up(self.input_size, 4) + 16 * obs_words
        state = 4 * (obs_words | 1)
        inputs = DEPTH * chunks(self.input_size) + 8
        return ring + 4 * numbers + _TILE * (4 * 2 * state + 2 * inputs + 4 * 2)
