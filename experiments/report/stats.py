"""Statistics over seeds: few runs, so intervals and robust means, not only a mean.

Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the Statistical
Precipice". The unit is a seed, and its score the mean over its evaluation trials.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

Statistic = Callable[[np.ndarray], np.ndarray]  # [..., S] -> [...]


class Summary(NamedTuple):
    """One arm on one task, over the seeds whose score is finite."""

    num_seeds: int
    mean: float
    std: float | None  # sample standard deviation; None for one seed
    iqm: float
    ci95: tuple[float, float] | None  # of the mean; None for one seed


def mean(scores: np.ndarray) -> np.ndarray:
    """Returns the mean over the last axis, `[..., S]` to `[...]`."""
    return scores.mean(axis=-1)


def iqm(scores: np.ndarray) -> np.ndarray:
    """Returns the interquartile mean over the last axis, `[..., S]` to `[...]`.

    A quarter of the scores is cut off at each end, rounded down: with fewer than four
    seeds it is the mean.
    """
    cut = scores.shape[-1] // 4
    return np.sort(scores, axis=-1)[..., cut : scores.shape[-1] - cut].mean(axis=-1)


def bootstrap_interval(
    strata: Sequence[np.ndarray],
    statistic: Statistic = mean,
    *,
    seed: int = 0,
    num_resamples: int = 10_000,
    level: float = 0.95,
) -> tuple[float, float] | None:
    """Returns the stratified percentile bootstrap interval of a statistic.

    Seeds are drawn with replacement within each stratum, and the statistic is taken
    over all that were drawn.

    Args:
      strata: `[S_i]` scores each, such as one array per task, or one array.
      statistic: over the last axis.
      seed: of the resampling; equal scores give an equal interval.
      num_resamples: more make the ends of the interval less noisy.
      level: the share of resamples inside.

    Returns:
      (low, high), or None if any stratum has fewer than two seeds: their spread is
      not known.
    """
    if not strata or min(len(scores) for scores in strata) < 2:
        return None
    generator = np.random.default_rng(seed)
    drawn = [
        scores[generator.integers(len(scores), size=(num_resamples, len(scores)))]
        for scores in strata
    ]
    values = statistic(np.concatenate(drawn, axis=-1))
    low, high = np.quantile(values, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def probability_of_improvement(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Returns the share of seed pairs in which ours is better; a tie counts half."""
    difference = ours[:, None] - theirs[None, :]
    return float(np.mean((difference > 0) + 0.5 * (difference == 0)))


def summarize(scores: np.ndarray, *, seed: int = 0) -> Summary | None:
    """Summarizes scores `[S]`; scores that are not finite are left out.

    Returns:
      None if no score is left.
    """
    finite = scores[np.isfinite(scores)]
    if not len(finite):
        return None
    std = float(finite.std(ddof=1)) if len(finite) > 1 else None
    return Summary(
        num_seeds=len(finite),
        mean=float(mean(finite)),
        std=std,
        iqm=float(iqm(finite)),
        ci95=bootstrap_interval([finite], seed=seed),
    )
