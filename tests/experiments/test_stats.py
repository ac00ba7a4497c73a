"""Statistics over seeds, against scipy and by hand."""

import numpy as np
import pytest
from scipy import stats as scipy_stats

from experiments.report import stats


def test_iqm_and_mean_against_scipy_and_by_hand():
    rng = np.random.default_rng(0)
    for n in range(1, 14):
        scores = rng.normal(size=n)
        assert stats.iqm(scores) == pytest.approx(scipy_stats.trim_mean(scores, 0.25))
    eight = np.array([8.0, 1.0, 100.0, 3.0, 4.0, 5.0, 6.0, -50.0])
    assert stats.iqm(eight) == pytest.approx(4.5)  # of 3, 4, 5, 6
    assert stats.mean(eight) == pytest.approx(77.0 / 8)


def test_bootstrap_interval_against_scipy():
    scores = np.random.default_rng(1).normal(100.0, 10.0, size=12)
    ours = stats.bootstrap_interval([scores], num_resamples=20_000)
    theirs = scipy_stats.bootstrap(
        (scores,), np.mean, n_resamples=20_000, method="percentile", rng=2
    ).confidence_interval
    # Both are Monte Carlo: 1 % of the spread of the scores.
    np.testing.assert_allclose(ours, theirs, atol=0.15)
    assert ours == stats.bootstrap_interval([scores], num_resamples=20_000)
    assert ours != stats.bootstrap_interval([scores], num_resamples=20_000, seed=1)


def test_bootstrap_stays_within_strata():
    # Within a stratum nothing varies, so no resample can differ.
    strata = [np.full(3, 1.0), np.full(3, 5.0)]
    assert stats.bootstrap_interval(strata) == (3.0, 3.0)
    assert stats.bootstrap_interval([*strata, np.ones(1)]) is None
    low, high = stats.bootstrap_interval([np.array([0.0, 1.0])])
    assert (low, high) == (0.0, 1.0)  # each end has a chance of a quarter


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
