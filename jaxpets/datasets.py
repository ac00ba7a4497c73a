"""Datasets of transitions of fixed capacity, which grow without a retrace."""

from jaxpets._src.dataset import AXES, append, grow, init, num_stable, obs_variance
from jaxpets._src.types import Dataset

__all__ = ["AXES", "Dataset", "append", "grow", "init", "num_stable", "obs_variance"]
