"""What is said of a trial, and what the log keeps of it."""

import pytest

from experiments.errors import UsageError
from experiments.records import describe
from experiments.storage import metrics
from jaxpets.envs.half_cheetah import TASK_NAMES


def row(returns, **labels):
    return {
        "value": 2.0,
        "returns": dict(zip(TASK_NAMES, returns, strict=True)),
    } | labels


def test_exploration_counts_for_every_task():
    rows = [row([1, 2, 3, 4]), row([3, 4, 5, 6])]
    text = "value 2  returns:  forward 2  backward 3  front-flip 4  back-flip 5"
    assert describe(rows) == text


def test_a_task_counts_where_it_was_sought():
    rows = [
        row([10, -10, 0, 0], task="forward"),
        row([20, -20, 0, 0], task="forward"),
        row([-7, 7, 0, 0], task="backward"),
    ]
    assert describe(rows) == "value 2  returns:  forward 15  backward 7"


def test_a_log_of_an_older_version_has_todays_names(tmp_path):
    """The negative log-likelihood of the fit was called its loss."""
    label = {"phase": "explore", "arm": "count", "seed": 1, "trial": 2}
    fit = {"nll": 1.5, "mse": 0.5}
    new = metrics.row(label, 2.0, 0.25, {"forward": 3.0}, fit)
    assert new == {
        **label, "value": 2.0, "turns": 0.25, "returns": {"forward": 3.0}, "fit": fit,
    }  # fmt: skip
    old = {**new, "fit": {"loss": 1.5, "mse": 0.5}}
    log = tmp_path / "metrics.jsonl"
    metrics.append_rows(log, [new, old])
    with log.open("a") as file:
        file.write('{"phase": "expl')  # the run was killed here
    first, second = metrics.read(log, {"preset": "smoke", "num_bits": 32})
    assert first == second
    assert (first.arm, first.seed, first.trial, first.data) == ("count-32", 1, 2, new)


def test_a_task_has_a_return_of_its_own():
    label = {"phase": "zero-shot", "task": "backward"}
    row_ = metrics.row(label, 2.0, 0.0, {"forward": 3.0, "backward": -3.0})
    assert row_["return"] == -3.0 and "fit" not in row_


def test_a_line_that_is_no_row(tmp_path):
    log = tmp_path / "metrics.jsonl"
    log.write_text('{"phase": "explore"}\n')
    with pytest.raises(UsageError, match=r"metrics.jsonl:1 is no row of a run"):
        list(metrics.read(log, {}))
