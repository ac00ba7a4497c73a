"""How a model lies in a CPU's memory: sizes and weights."""

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence

import jax.numpy as jnp
from jax import Array

_TILE = 6  # outputs of a layer whose sums fit into a core's registers


@dataclasses.dataclass(frozen=True)
class CpuLayout:
    """What is fixed when the rollout is compiled for a CPU.

    Attributes:
      obs_size: D.
      action_size: A.
      feature_size: F.
      hidden_sizes: of the model.
    """

    obs_size: int
    action_size: int
    feature_size: int
    hidden_sizes: tuple[int, ...]

    def header(self) -> str:
        """Returns the constants of the C++ sources."""
        inputs, outputs = self.feature_size + self.action_size, 2 * self.obs_size
        widths = ", ".join(map(str, (inputs, *self.hidden_sizes, outputs)))
        constants = {
            "OBS": self.obs_size,
            "ACTION": self.action_size,
            "FEATURES": self.feature_size,
            "TILE": _TILE,
        }
        lines = [f"constexpr int {name} = {n};" for name, n in constants.items()]
        return "\n".join([*lines, f"constexpr int WIDTHS[] = {{{widths}}};"])

    def pack(
        self, layers: Sequence[Mapping[str, Array]], activation: str = "swish"
    ) -> Array:
        """Returns weights and biases `[E, *]` of all layers, float32.

        Args:
          layers: `kernel` `[E, in, out]` and `bias` `[E, out]` of each, in order.
          activation: of the hidden ones; their weights are as they are.
        """
        del activation
        parts = itertools.chain.from_iterable(map(_tiles, layers))
        return jnp.concatenate(list(parts), axis=1)


def _tiles(layer: Mapping[str, Array]) -> Iterator[Array]:
    """Yields the whole tiles of a layer, then what is left of it, `[E, *]`.

    A tile has a row for the biases and one for every input.
    """
    rows = jnp.concatenate([layer["bias"][:, None], layer["kernel"]], axis=1)
    members, inputs, outputs = rows.shape
    whole = outputs // _TILE * _TILE
    tiles = rows[..., :whole].reshape(members, inputs, -1, _TILE)
    yield tiles.swapaxes(1, 2).reshape(members, -1)
    yield rows[..., whole:].reshape(members, -1)
