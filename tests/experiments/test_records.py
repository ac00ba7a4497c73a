"""What is said of a trial."""

from experiments.records import describe
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
