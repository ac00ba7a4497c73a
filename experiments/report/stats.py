"""Statistics over seeds: intervals that hold for few of them, and a robust mean.

The unit is a seed, and its score the mean over its evaluation trials. Intervals are
Student's t: resampling seeds (the percentile bootstrap) covers the mean of five normal
scores in 83 % of cases where it says 95 %, the t interval in 95 %.
`tests/experiments/test_stats.py` measures both. The interquartile mean is that of
Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the Statistical
Precipice".
"""

from typing import NamedTuple

import numpy as np
import scipy.stats

_LEVEL = 0.95
Interval = tuple[float, float]


class Summary(NamedTuple):
    """One arm on one task, over the seeds whose score is finite."""

    num_seeds: int
    mean: float
    std: float | None  # sample standard deviation; None for one seed
    iqm: float
    ci95: Interval | None  # of the mean; None for one seed


class Difference(NamedTuple):
    """The mean of one arm minus that of another, whose seeds are independent."""

    mean: float
    ci95: Interval | None  # Welch's; None if an arm has one seed


def iqm(scores: np.ndarray) -> np.ndarray:
    """Returns the interquartile mean over the last axis, `[..., S]` to `[...]`.

    A quarter of the scores is cut off at each end, rounded down: with fewer than four
    seeds it is the mean.
    """
    cut = scores.shape[-1] // 4
    return np.sort(scores, axis=-1)[..., cut : scores.shape[-1] - cut].mean(axis=-1)


def stratified_interval(scores: np.ndarray, num_draws: int = 2000) -> Interval:
    """Returns the bootstrap's 95 % interval of the IQM of all scores `[K, S]`.

    Seeds are drawn anew for each of the K tasks, as rliable does it. With few seeds the
    interval is too narrow, as said above; tasks make up for some of that.
    """
    rng = np.random.default_rng(0)
    drawn = rng.integers(scores.shape[1], size=(num_draws, *scores.shape))
    resampled = np.take_along_axis(scores[None], drawn, axis=2)
    ends = [(1 - _LEVEL) / 2, (1 + _LEVEL) / 2]
    low, high = np.quantile(iqm(resampled.reshape(num_draws, -1)), ends)
    return float(low), float(high)


def t_interval(scores: np.ndarray) -> Interval | None:
    """Returns Student's 95 % interval of the mean of scores `[S]`.

    Returns:
      (low, high), or None with fewer than two scores: their spread is not known.
    """
    if len(scores) < 2:
        return None
    mean, error = float(scores.mean()), float(scores.std(ddof=1)) / len(scores) ** 0.5
    half = error * float(scipy.stats.t.ppf((1 + _LEVEL) / 2, len(scores) - 1))
    return mean - half, mean + half


def difference(ours: np.ndarray, theirs: np.ndarray) -> Difference:
    """Returns mean `ours` `[S]` minus mean `theirs` `[T]`, with Welch's 95 % interval.

    The two may have other spreads and other numbers of seeds. A seed that is in both
    makes the interval too wide where its two scores go up and down together.
    """
    mean = float(ours.mean() - theirs.mean())
    if min(len(ours), len(theirs)) < 2:
        return Difference(mean, None)
    if not (ours.std() or theirs.std()):
        return Difference(mean, (mean, mean))
    # By hand: scipy's ttest_ind warns of an arm whose seeds are all alike.
    parts = [float(x.var(ddof=1)) / len(x) for x in (ours, theirs)]
    squares = parts[0] ** 2 / (len(ours) - 1) + parts[1] ** 2 / (len(theirs) - 1)
    freedom = sum(parts) ** 2 / squares
    half = sum(parts) ** 0.5 * float(scipy.stats.t.ppf((1 + _LEVEL) / 2, freedom))
    return Difference(mean, (mean - half, mean + half))


def probability_of_improvement(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Returns the share of seed pairs in which ours is better; a tie counts half."""
    difference = ours[:, None] - theirs[None, :]
    return float(np.mean((difference > 0) + 0.5 * (difference == 0)))


def summarize(scores: np.ndarray) -> Summary | None:
    """Summarizes scores `[S]`; scores that are not finite are left out.

    Returns:
      None if no score is left.
    """
    finite = scores[np.isfinite(scores)]
    if not len(finite):
        return None
    return Summary(
        num_seeds=len(finite),
        mean=float(finite.mean()),
        std=float(finite.std(ddof=1)) if len(finite) > 1 else None,
        iqm=float(iqm(finite)),
        ci95=t_interval(finite),
    )
