"""The time left of a study: right within a quarter after the first tenth of it."""

import itertools
import json
from pathlib import Path

import pytest

from experiments.forecast import Forecast, Sizes

SIZES = Sizes(
    num_trials=48, num_random=1, trial_length=250, num_branches=12, task_length=500,
    num_videos=4,
)  # fmt: skip
CHUNK = 10
REPORT = 10.0
LOG = Path(__file__).parents[2] / "results/laptop/laptop-epistemic/metrics.jsonl"


def told(trials, step, video, compiling=25.0):
    """Plays a study: what the forecast says, and by when it says it.

    Args:
      trials: seconds of acting, without compiling, and of the fit, for each.
      step: seconds of performing a step.
      video: seconds of each.
      compiling: seconds of exploring's planner.

    Returns:
      `(seconds since the start, seconds left as told)`, and how long all took.
    """
    forecast, now, said = Forecast(SIZES), 0.0, []

    def did(kind, units, seconds, first=False):
        nonlocal now
        now += seconds
        forecast.did(kind, units, seconds, first=first)
        said.append((now, forecast.left()))

    def steps(kind, count, each, compiled):
        for i in range(count // CHUNK):
            first = compiled > 0 and i == 0
            did(kind, CHUNK, CHUNK * each + compiled * first, first)

    for i, (act, fit) in enumerate(trials):
        compiled = (compiling / 3, compiling, 0.0)[min(i, 2)]
        steps("explore", SIZES.trial_length, act / SIZES.trial_length, compiled)
        did("fit", i + 1, fit, first=i == 0)
    forecast.begin("zero-shot")
    steps("zero-shot", SIZES.task_length, step, 1.2 * compiling)
    for _ in range(SIZES.num_videos):
        forecast.begin("video")
        patient, impatient = forecast.left(), forecast.left(1000.0)
        assert patient and impatient and patient - impatient <= max(video, 25.0)
        did("video", 1, video)
    forecast.begin("report")
    assert [forecast.left(x) for x in (0.0, 9.0, 99.0)] == [REPORT, 1.0, 0.0]
    return said, now + REPORT


def worst(said, total, first=0.1, last=0.6):
    """Returns the largest error of the time left, as a share of it.

    Late in a study little is left, of which any error is a large share.
    """
    asked = [(now, left) for now, left in said if first * total <= now < last * total]
    assert len(asked) > 10 and all(left is not None for _, left in asked)
    return max(abs(left - (total - now)) / (total - now) for now, left in asked)


def test_nothing_is_told_before_a_plan_is_known():
    said, _ = told([(3.0, 1.0)] * 48, 0.15, 25.0)
    known = [left is not None for _, left in said]
    chunks = SIZES.trial_length // CHUNK
    assert known.index(True) == chunks + 2 and all(known[chunks + 2 :])


@pytest.mark.skipif(not LOG.exists(), reason="not in this copy of the code")
def test_a_study_that_was_logged_is_foretold():
    """Two cores and nothing beside it; logs have no times of steps performed."""
    rows = [json.loads(line)["seconds"] for line in LOG.read_text().splitlines()]
    trials = [(row["act"], row["fit"]) for row in rows]
    usual = sorted(act for act, _ in trials)[len(trials) // 2]
    trials[:2] = [(usual, trials[2][1])] * 2  # without what was compiled there
    assert worst(*told(trials, 12 * usual / SIZES.trial_length, 25.0)) < 0.25


@pytest.mark.parametrize(
    ("speed", "fit", "batch", "video"),
    [*itertools.product((0.7, 2.0), (0.07, 0.2), (0.95, 1.25), (20, 35))],
)
def test_it_holds_on_other_machines(speed, fit, batch, video):
    """Slower or faster, where what is foretold of the kinds is right within a third."""
    act = 3.0 * speed
    trials = [(act, fit * speed * trial) for trial in range(1, 49)]
    trials[0] = (speed, 3.0)
    step = 12 * batch * act / SIZES.trial_length
    assert worst(*told(trials, step, video, 25.0 * speed)) < 0.25


def test_a_study_that_goes_on_foretells_what_is_left():
    whole, rest, length = Forecast(SIZES), Forecast(SIZES), SIZES.trial_length
    whole.did("explore", length, 1.0, first=False)  # at random
    rest.begin("explore", 40 * length)
    left = []
    for forecast in (whole, rest):
        assert forecast.left() is None
        forecast.did("explore", CHUNK, 30.0, first=True)
        forecast.did("explore", CHUNK, 0.01 * CHUNK, first=False)
        left.append(forecast.left())
    fits = 11 * 0.01 * sum(range(1, 41))
    assert left[0] - left[1] == pytest.approx(39 * length * 0.01 + fits)
