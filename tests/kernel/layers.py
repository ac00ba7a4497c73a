"""Parameters of networks, to be laid out."""

import itertools

import numpy as np


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
