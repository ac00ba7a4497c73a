"""Statistics over seeds: against scipy, by hand, and by how often intervals hold."""

import warnings

import numpy as np
import pytest
from scipy import stats as scipy_stats

from experiments.report import stats

ROUNDS = 2000


def test_iqm_against_scipy_and_by_hand():
    rng = np.random.default_rng(0)
    for n in range(1, 14):
        scores = rng.normal(size=n)
        assert stats.iqm(scores) == pytest.approx(scipy_stats.trim_mean(scores, 0.25))
    eight = np.array([8.0, 1.0, 100.0, 3.0, 4.0, 5.0, 6.0, -50.0])
    assert stats.iqm(eight) == pytest.approx(4.5)  # of 3, 4, 5, 6


def test_t_interval_by_hand_and_against_scipy():
    # Mean 2, standard deviation 1, so an error of 1 / sqrt(3); t of 2 is 4.3027.
    low, high = stats.t_interval(np.array([1.0, 2.0, 3.0]))
    assert (low, high) == pytest.approx(
        (2 - 4.3027 / 3**0.5, 2 + 4.3027 / 3**0.5), 1e-4
    )
    scores = np.random.default_rng(1).normal(100.0, 10.0, size=12)
    theirs = scipy_stats.ttest_1samp(scores, 0.0).confidence_interval()
    assert stats.t_interval(scores) == pytest.approx(tuple(theirs))
    assert stats.t_interval(np.full(4, 7.0)) == (7.0, 7.0)
    assert stats.t_interval(np.array([7.0])) is None


@pytest.mark.parametrize("num_seeds", [3, 5, 13])
@pytest.mark.parametrize("draw", ["normal", "logistic", "uniform"])
def test_t_interval_covers_the_mean_as_often_as_it_says(draw, num_seeds):
    drawn = getattr(np.random.default_rng(2), draw)(size=(ROUNDS, num_seeds))
    intervals = np.array([stats.t_interval(scores) for scores in drawn])
    mean = 0.5 if draw == "uniform" else 0.0
    held = np.mean((intervals[:, 0] <= mean) & (mean <= intervals[:, 1]))
    # The share's standard error is 0.0049. Normal scores give 0.95 at any number;
    # other shapes come near it, the uniform one from below at three seeds.
    assert held == pytest.approx(0.95, abs=0.015 if draw == "normal" else 0.03)


def test_resampling_five_seeds_would_cover_too_little():
    """Why the interval is Student's: the percentile bootstrap holds in 83 %."""
    rng = np.random.default_rng(3)
    held = []
    for scores in rng.normal(size=(1000, 5)):
        means = scores[rng.integers(5, size=(1000, 5))].mean(axis=1)
        low, high = np.quantile(means, [0.025, 0.975])
        held.append(low <= 0.0 <= high)
    assert np.mean(held) == pytest.approx(0.83, abs=0.04)  # three standard errors


def test_difference_by_hand_and_how_often_it_holds():
    ours, theirs = np.array([3.0, 5.0]), np.array([1.0, 2.0, 3.0])
    mean, (low, high) = stats.difference(ours, theirs)
    assert mean == pytest.approx(2.0) and (low + high) / 2 == pytest.approx(2.0)
    # Errors 1 and 1 / sqrt(3); Welch and Satterthwaite's degrees of freedom.
    error = (1 + 1 / 3) ** 0.5
    freedom = (1 + 1 / 3) ** 2 / (1 + (1 / 3) ** 2 / 2)
    half = scipy_stats.t.ppf(0.975, freedom) * error
    assert (high - low) / 2 == pytest.approx(half)
    assert stats.difference(ours, theirs[:1]) == (3.0, None)
    assert stats.difference(np.ones(2), np.zeros(3)) == (1.0, (1.0, 1.0))
    with warnings.catch_warnings():  # of one arm without a spread there are none
        warnings.simplefilter("error")
        alike = stats.difference(np.ones(3), theirs).ci95
    # As if the mean of one arm were known.
    assert alike == pytest.approx(np.subtract(1.0, stats.t_interval(theirs))[::-1])
    rng = np.random.default_rng(4)
    held = [
        low <= 100.0 <= high
        for _ in range(1000)
        for low, high in [
            stats.difference(rng.normal(100, 5, 13), rng.normal(0, 20, 5)).ci95
        ]
    ]
    assert np.mean(held) == pytest.approx(0.95, abs=0.025)


def test_probability_of_improvement_by_hand_and_scipy():
    ours, theirs = np.array([1.0, 2.0, 3.0]), np.array([2.0, 0.0])
    # 1 > 0, 2 = 2, 2 > 0, 3 > 2, 3 > 0: 4.5 of 6 pairs.
    assert stats.probability_of_improvement(ours, theirs) == pytest.approx(0.75)
    u = scipy_stats.mannwhitneyu(ours, theirs).statistic
    assert stats.probability_of_improvement(ours, theirs) == pytest.approx(u / 6)


def test_summary_of_no_finite_score_is_none():
    assert stats.summarize(np.array([np.nan])) is None
    one = stats.summarize(np.array([np.nan, 4.0]))
    assert one == stats.Summary(1, 4.0, None, 4.0, None)
