"""How much of a model a block of mma_rollout.cu has."""

import pytest
from layers import SIZES

from jaxpets._src.kernel.mma_layout import SHARED_MEMORY, MmaLayout


def test_two_blocks_share_a_multiprocessor_of_any_gpu_if_they_can():
    """Of 100 KiB, of which CUDA takes one for each block. Large models are alone."""
    tiles = {}
    larger = {"quadruped": (60, 12, 63, (256,) * 4), "largest": (128, 128, 128, (256,))}
    for name, sizes in (SIZES | larger).items():
        layout = MmaLayout(*sizes)
        tiles[name] = layout.block()["TILES"]
        assert layout.shared_bytes(tiles[name]) <= SHARED_MEMORY
        assert name in larger or layout.shared_bytes(tiles[name]) <= 49 * 1024
    assert tiles == dict.fromkeys(SIZES, 5) | {"quadruped": 5, "largest": 3}


@pytest.mark.parametrize(
    ("sizes", "warps", "tiles"),
    [
        ((18, 6, 18, (256,) * 4), 4, 5),
        ((18, 6, 18, (272,) * 4), 8, 5),
        ((18, 6, 18, (512,) * 8), 8, 5),
        ((110, 21, 110, (400, 512)), 8, 3),  # of a humanoid
        ((256, 256, 256, (512,)), 8, 1),
    ],
)
def test_wide_layers_are_for_more_warps(sizes, warps, tiles):
    """Each has as many columns; one block is a multiprocessor's."""
    layout = MmaLayout(*sizes)
    assert layout.problem() is None
    assert (layout.block()["WARPS"], layout.block()["TILES"]) == (warps, tiles)
    assert layout.shared_bytes(tiles) <= SHARED_MEMORY


WIDTHS = {1: 24, 33: 64, 64: 64, 96: 96, 97: 128, 200: 200, 225: 256, 257: 264}
WIDTHS |= {272: 272, 289: 384, 400: 400, 416: 416, 417: 512}


@pytest.mark.parametrize(("widest", "width"), WIDTHS.items())
def test_few_columns_are_shared_by_all_warps(widest, width):
    """Of 64, or above 256 of 128, at most 32: else each warp gets some alone."""
    assert MmaLayout(18, 6, 18, (widest,)).width == width
