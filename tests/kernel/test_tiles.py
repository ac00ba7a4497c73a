"""A CPU's kernel reads float32 weights in tiles; they lie as tiles.h says."""

import itertools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpets._src.kernel import tiles
from jaxpets._src.kernel.tiles import TileShape

TILE = 6
SHAPES = {
    "less than a tile": TileShape(1, 1, 1, (5,)),
    "whole tiles": TileShape(3, 2, 4, (6, 12)),
    "tiles and a rest": TileShape(5, 2, 7, (13, 1, 7)),
    "wide": TileShape(2, 1, 2, (300,)),
}


def widths(shape):
    inputs = shape.feature_size + shape.action_size
    return [inputs, *shape.hidden_sizes, 2 * shape.obs_size]


def layers_of(shape, members=2):
    """Parameters `[E, in, out]` and `[E, out]` of each layer."""
    rng = np.random.default_rng(0)
    return [
        {
            "kernel": rng.normal(size=(members, a, b)).astype(np.float32),
            "bias": rng.normal(size=(members, b)).astype(np.float32),
        }
        for a, b in itertools.pairwise(widths(shape))
    ]


def in_order(layers, member):
    """Numbers of one member, one after the other, as the kernel walks through them."""
    numbers = []
    for layer in layers:
        kernel, bias = layer["kernel"][member], layer["bias"][member]
        for first in range(0, len(bias), TILE):
            numbers += [*bias[first : first + TILE]]
            for row in kernel:
                numbers += [*row[first : first + TILE]]
    return np.array(numbers)


@pytest.mark.parametrize("name", SHAPES)
def test_parameters_lie_as_documented(name):
    shape = SHAPES[name]
    layers = layers_of(shape)
    packed = jax.jit(shape.pack)(layers)
    assert packed.dtype == jnp.float32
    want = np.stack([in_order(layers, member) for member in range(2)])
    np.testing.assert_array_equal(packed, want)


def test_numbers_that_are_none_are_kept():
    shape = SHAPES["less than a tile"]
    layers = layers_of(shape)
    for number, kept in zip((np.nan, np.inf, -np.inf, 1e38), range(4), strict=True):
        layers[0]["kernel"][0, 0, kept] = number
    packed = jax.jit(shape.pack)(layers)
    np.testing.assert_array_equal(packed[0], in_order(layers, 0))


def test_the_header_has_the_sizes():
    text = SHAPES["tiles and a rest"].header()
    found = dict(re.findall(r"constexpr int (\w+) = (\d+);", text))
    assert found == {"OBS": "5", "ACTION": "2", "FEATURES": "7", "TILE": "6"}
    assert "constexpr int WIDTHS[] = {9, 13, 1, 7, 10};" in text
    assert tiles._TILE == TILE
