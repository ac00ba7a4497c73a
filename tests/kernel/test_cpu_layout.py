"""A CPU's kernel reads float32 weights in tiles; they lie as cpu_layout.h says."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from layers import layers_of

from jaxpets._src.kernel.cpu_layout import CpuLayout

TILE = 6
LAYOUTS = {
    "less than a tile": CpuLayout(1, 1, 1, (5,)),
    "whole tiles": CpuLayout(3, 2, 4, (6, 12)),
    "tiles and a rest": CpuLayout(5, 2, 7, (13, 1, 7)),
    "wide": CpuLayout(2, 1, 2, (300,)),
}


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


@pytest.mark.parametrize("name", LAYOUTS)
def test_parameters_lie_as_documented(name):
    layout = LAYOUTS[name]
    layers = layers_of(layout)
    packed = jax.jit(layout.pack)(layers)
    assert packed.dtype == jnp.float32
    want = np.stack([in_order(layers, member) for member in range(2)])
    np.testing.assert_array_equal(packed, want)


def test_numbers_that_are_none_are_kept():
    layout = LAYOUTS["less than a tile"]
    layers = layers_of(layout)
    for number, kept in zip((np.nan, np.inf, -np.inf, 1e38), range(4), strict=True):
        layers[0]["kernel"][0, 0, kept] = number
    packed = jax.jit(layout.pack)(layers)
    np.testing.assert_array_equal(packed[0], in_order(layers, 0))


def test_the_header_has_the_sizes():
    text = LAYOUTS["tiles and a rest"].header()
    found = dict(re.findall(r"constexpr int (\w+) = (\d+);", text))
    assert found == {"OBS": "5", "ACTION": "2", "FEATURES": "7", "TILE": "6"}
    assert "constexpr int WIDTHS[] = {9, 13, 1, 7, 10};" in text


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_sources_have_the_same_sizes(assert_constants, name):
    layout = LAYOUTS[name]
    packed = jax.eval_shape(layout.pack, layers_of(layout))
    sizes = {"TILE": TILE, "MEMBER_WEIGHTS": packed.shape[1]}
    assert_constants("cpu_layout.h", layout.header(), sizes)
