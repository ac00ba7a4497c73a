"""Parameters of networks, to be laid out, and where they lie then."""

import itertools

import numpy as np

from jaxpets._src.kernel.mma_layout import MmaLayout
from jaxpets._src.kernel.wgmma_layout import WgmmaLayout

SIZES = {
    "small": (5, 2, 7, (20, 33)),
    "one layer": (1, 1, 1, (1,)),
    "paper": (18, 6, 18, (200, 200, 200, 200)),
    "narrow first": (3, 2, 4, (8, 64, 24)),
    "full chunks": (8, 6, 8, (30, 30)),  # 14 inputs and two biases
}


def layers_of(layout, members=2):
    """Parameters `[E, in, out]` and `[E, out]` of each layer of a layout's network."""
    rng = np.random.default_rng(0)
    inputs = layout.feature_size + layout.action_size
    sizes = [inputs, *layout.hidden_sizes, 2 * layout.obs_size]
    return [
        {
            "kernel": rng.normal(size=(members, a, b)).astype(np.float32),
            "bias": rng.normal(size=(members, b)).astype(np.float32),
        }
        for a, b in itertools.pairwise(sizes)
    ]


def block_place(row, column, columns):
    """Blocks of 8 x 8, 8 columns after 8 columns, for each the upper rows first.

    In a block, column after column.
    """
    return ((column // 8) * 2 + row // 8) * 64 + column % 8 * 8 + row % 8


def fragment_place(row, column, columns):
    """What a lane of `mma.m16n8k16` holds as the right operand, of 16 columns or 8.

    That is for each 8 columns, of which a lane has one, two rows of the upper half and
    two of the lower (PTX ISA, matrix fragments for mma.m16n8k16).
    """
    lane = column % 8 * 4 + row % 8 // 2
    register, half = row // 8, row % 2
    eights = np.where(column // 16 * 16 + 8 == columns, 1, 2)  # columns of a lane
    eight = column // 8 % 2
    return column // 16 * 256 + ((lane * eights + eight) * 2 + register) * 2 + half


PLACES = {WgmmaLayout: block_place, MmaLayout: fragment_place}


def unpacked(numbers, rows, columns, place=block_place):
    """Reads a matrix `[E, chunks * 16, columns]` from the front; returns the rest.

    Chunks of 16 rows follow one another.
    """
    chunks = -(-(rows + 2) // 16)
    row, column = np.indices((chunks * 16, columns))
    at = row // 16 * 16 * columns + place(row % 16, column, columns)
    return numbers[:, at], numbers[:, chunks * 16 * columns :]
