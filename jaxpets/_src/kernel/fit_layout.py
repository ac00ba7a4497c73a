"""How training lies in the memory of a cluster of blocks: sizes, and parameters."""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from jaxpets._src.kernel.gpu_layout import round_up
from jaxpets._src.network import ACTIVATIONS

# Of a block, on Hopper.
SHARED_MEMORY = 232_448
# A thread's registers for gradients and moments; more would spill.
_MOST_NUMBERS = 168
_UNIT, _TILE = 16, 8  # inputs and columns of a tensor core instruction
# What an epoch is told besides its data, in this order; the decays of all layers last.
_HYPER = (
    "RATE", "B1", "B2", "EPS", "ONE_B1", "ONE_B2",  # of Adam: ONE_B1 is 1 - B1
    "FINAL", "EPOCHS", "EPOCH", "BATCH", "BOUND_DECAY",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class FitLayout:
    """What is fixed when the kernel that trains is compiled.

    Attributes:
      num_members: E.
      obs_size: D.
      action_size: A.
      feature_size: F.
      hidden_sizes: of the model.
      activation: of the hidden layers.
      ctas: blocks of the cluster that trains a member.
      threads: of a block.
    """

    num_members: int
    obs_size: int
    action_size: int
    feature_size: int
    hidden_sizes: tuple[int, ...]
    activation: str
    ctas: int = 16
    threads: int = 256

    @property
    def sizes(self) -> tuple[int, ...]:
        """Of the inputs, the hidden layers and the outputs."""
        inputs = self.feature_size + self.action_size
        return (inputs, *self.hidden_sizes, 2 * self.obs_size)

    @property
    def num_params(self) -> int:
        """Weights and biases of a member."""
        return sum((a + 1) * b for a, b in itertools.pairwise(self.sizes))

    @property
    def rows(self) -> int:
        """Rows of a batch that are in shared memory at once."""
        return 32 if self.shared_bytes(32) <= SHARED_MEMORY else 16

    @property
    def scratch_words(self) -> int:
        """Words through which members meet, as fit_operands.h has them."""
        return 64 + 2 * self.num_members * 2 * self.obs_size

    def problem(self) -> str | None:
        """Returns why there is no kernel for it, or None."""
        if not self.hidden_sizes:
            return "there is no hidden layer"
        # A block without columns does not wait; with four layers it may come too early.
        used = {-(-size // -(-size // self.ctas)) for size in self.hidden_sizes}
        if len(self.hidden_sizes) > 3 and len(used) > 1:
            return "some blocks have columns in some hidden layers and not in others"
        if self.shared_bytes(self.rows) > SHARED_MEMORY:
            return "the weights do not fit into the shared memory of 16 blocks"
        warps = self.threads // 32
        units = sum(-(-size // _UNIT) for size in self.sizes[:-2])
        numbers = 3 * -(-units // warps) * 4 * (self._columns // _TILE)
        if numbers > _MOST_NUMBERS:
            return "Adam's moments do not fit into the registers of 16 blocks"
        return None

    def header(self) -> str:
        """Returns the constants of the CUDA sources."""
        constants = {
            "OBS": self.obs_size,
            "ACTION": self.action_size,
            "FEATURES": self.feature_size,
            "MEMBERS": self.num_members,
            "LAYERS": len(self.hidden_sizes),
            "ACTIVATION": ACTIVATIONS.index(self.activation),
            "CTAS": self.ctas,
            "THREADS": self.threads,
            "ROWS": self.rows,
            "SHARED_BYTES": self.shared_bytes(self.rows),
        }
        lines = [f"constexpr int {name} = {n};" for name, n in constants.items()]
        widths = ", ".join(map(str, self.hidden_sizes))
        lines.append(f"enum Hyper {{ {', '.join(_HYPER)}, DECAYS }};")
        return "\n".join(["#pragma once", *lines, f"#define WIDTHS {widths}"])

    def hyper(self, decays: Sequence[float], **numbers: ArrayLike) -> Array:
        """Returns what an epoch is told, `[N]`: numbers by the names of _HYPER."""
        if set(numbers) != set(map(str.lower, _HYPER)):
            raise ValueError(f"{sorted(numbers)} are not the numbers of an epoch")
        told = [numbers[name.lower()] for name in _HYPER] + list(decays)
        return jnp.stack([jnp.asarray(number, jnp.float32) for number in told])

    @property
    def _columns(self) -> int:
        """Columns of a block in the widest layer, in whole tiles."""
        return round_up(self._own, _TILE)

    @property
    def _own(self) -> int:
        """Columns of a block in the widest layer."""
        return -(-max(self.hidden_sizes) // self.ctas)

    def shared_bytes(self, rows: int) -> int:
        """Returns the shared memory of a block, as fit_block.h declares it."""
        layers, outs = len(self.hidden_sizes), 2 * self.obs_size
        columns, warps = self._columns, self.threads // 32
        dims = -(-self.obs_size // self.ctas)
        fan_in = self.sizes[:-2]
        words = sum(fan_in) * (columns + 4)  # w
        words += 2 * fan_in[0] * rows + (sum(fan_in[1:]) * rows or 32)  # x
        words += (1 + layers) * columns * rows  # h, dy
        words += max(2 * self.ctas * self._own, warps * columns) * rows  # part
        words += (2 * self.ctas * dims + outs + 2 * dims) * rows  # z, dyo, target
        words += 4 * columns * (outs + 1) + 4 * layers * columns  # of outputs, biases
        words += 5 * 4 * dims + layers + 1  # biases and bounds of outputs, sums, decays
        words += 8 + 1 + 3 * rows  # adam, good, index
        size = round_up(4 * words, 8) + 8 * (2 * layers + 2)  # barriers
        return round_up(size, 128)

    def pack(self, layers: Mapping[str, Any]) -> Array:
        """Returns kernels and biases of all layers, `[E, num_params]`.

        Args:
          layers: `kernel` `[E, in, out]` and `bias` `[E, out]` of each, by name.
        """
        parts = [layers[f"layer_{i}"][name] for i, name in self._names()]
        rows = [part.reshape(self.num_members, -1) for part in parts]
        return jnp.concatenate(rows, axis=1)

    def unpack(self, packed: Array) -> dict[str, dict[str, Array]]:
        """Returns what `pack` was given."""
        layers: dict[str, dict[str, Array]] = {}
        place = 0
        for (i, name), shape in zip(self._names(), self._shapes(), strict=True):
            part = packed[:, place : place + int(np.prod(shape))]
            part = part.reshape(self.num_members, *shape)
            layers.setdefault(f"layer_{i}", {})[name] = part
            place += int(np.prod(shape))
        return layers

    def _names(self) -> Sequence[tuple[int, str]]:
        layers = range(len(self.sizes) - 1)
        return [(i, name) for i in layers for name in ("kernel", "bias")]

    def _shapes(self) -> Sequence[tuple[int, ...]]:
        pairs = itertools.pairwise(self.sizes)
        return [shape for a, b in pairs for shape in ((a, b), (b,))]
