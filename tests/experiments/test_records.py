"""What is said of a trial, and what the log keeps of it."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

import jaxpets
from experiments import acting, records, robots
from experiments.acting import Trials
from experiments.records import describe
from experiments.storage import metrics
from jaxpets import envs
from jaxpets.envs.half_cheetah import OBS_SIZE, TASK_NAMES


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


def test_a_task_whose_reward_is_no_number_is_named():
    rows = [
        {"task": task, "return": value}
        for task, value in (("log", np.nan), ("log", 2.0), ("run", 1.0), ("run", 3.0))
    ]
    *_, run, said = records.summary(rows, ["log", "run"], 1.0).splitlines()
    assert run.split()[:2] == ["run", "2"]
    assert said.startswith("  the reward of log is not finite in 1 of 2 trials")
    assert "not finite" not in records.summary(rows[2:], ["run"], 1.0)


def test_plans_without_a_finite_candidate_are_counted():
    """Every candidate of two steps of the second trial, at a horizon of 30."""
    values = np.ones((2, 3), np.float32)
    values[1, :2] = jaxpets.optimizers.WORST_VALUE / 30
    obs = jnp.zeros((2, 3, OBS_SIZE))
    trials = Trials(jaxpets.Transition(obs, jnp.zeros((2, 3, 6)), obs), values)
    scorer = acting.scorer(robots.named("pets/half_cheetah", "mujoco"))
    good, bad = records.rows(scorer, [{"phase": "explore"}] * 2, trials)
    assert "bad_plans" not in good and bad["bad_plans"] == 2
    assert describe([good, bad]).endswith("  bad plans: 2")


def test_what_comes_after_the_end_of_a_trial_does_not_count():
    """The second trial ends in its second step, and turns anew in another start."""
    robot = robots.named("pets/half_cheetah", "mujoco")
    place = robot.angle
    robot = robot._replace(
        env=robot.env._replace(terminal_fn=lambda obs: obs[..., 0] > 0),
        tasks=envs.tasks_of({"one": lambda c, o, a, x: jnp.ones_like(x[..., 0])}),
    )
    angle = 2 * jnp.pi * jnp.array([[0.0, 1.0, 2.0, 3.0], [0.0, 1.0, 7.0, 9.0]])
    obs = jnp.zeros((2, 4, OBS_SIZE)).at[1, 1:3, 0].set(1.0).at[..., place].set(angle)
    seen = jaxpets.Transition(obs, jnp.zeros((2, 4, 6)), obs)
    score = acting.scorer(robot).score(seen, ())
    np.testing.assert_array_equal(score.returns, [[4.0], [2.0]])
    np.testing.assert_allclose(score.turns, [3.0, 1.0], rtol=1e-6)
    np.testing.assert_array_equal(score.num_steps, [4, 4])  # physics is well


def test_updates_that_were_refused_are_counted():
    rows = [row([1, 2, 3, 4]) | {"fit": {"num_skipped": n}} for n in (0, 15)]
    assert describe(rows).endswith("back-flip 4  updates refused: 15")


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


def test_no_bit_of_a_log_changes_unnoticed(tmp_path, capsys):
    """A row with one flipped bit is left out, or says what it said."""
    log, label = tmp_path / "metrics.jsonl", {"arm": "best", "seed": 1, "trial": 2}
    row_ = metrics.row({"phase": "explore"} | label, 2.5, 0.25, {"forward": -3.0})
    metrics.append_rows(log, [row_])
    whole, kept = log.read_bytes(), 0
    for i in range(8 * len(whole)):
        data = bytearray(whole)
        data[i // 8] ^= 1 << i % 8
        log.write_bytes(data)
        found = [x.data for x in metrics.read(log, {"preset": "smoke"})]
        assert found == [] or row_.items() <= found[0].items()
        assert metrics.rows_by_trial(log) == ({2: 1} if found else {})
        kept += len(found)
    spaces = whole.count(b" ") + 1
    assert kept < 8 * len("check") + spaces  # harmless: of that name, or a tab
    assert "it has changed: its check is of another one" in capsys.readouterr().err


def test_a_row_may_be_written_again_by_another_program(tmp_path):
    log = tmp_path / "metrics.jsonl"
    row_ = {"phase": "explore", "arm": "best", "seed": 1, "trial": 2, "value": 1e-5}
    metrics.append_rows(log, [row_ | {"returns": {"b": 1e22, "a": -0.1}}])
    data = json.loads(log.read_text())
    log.write_text(json.dumps(data, sort_keys=True, separators=(",", ":")) + "\n")
    (found,) = metrics.read(log, {"preset": "smoke"})
    assert "check" in data and found.data.items() >= row_.items()
    del data["check"]  # by whoever means to change a row
    log.write_text(json.dumps(data | {"value": 2.0}) + "\n")
    (found,) = metrics.read(log, {"preset": "smoke"})
    assert found.data["value"] == 2.0


def test_a_task_has_a_return_of_its_own():
    label = {"phase": "zero-shot", "task": "backward"}
    row_ = metrics.row(label, 2.0, 0.0, {"forward": 3.0, "backward": -3.0})
    assert row_["return"] == -3.0 and "fit" not in row_


GOOD = {"phase": "zero-shot", "arm": "best", "seed": 1, "task": "forward", "trial": 2}
GOOD |= {"explored_trials": 3, "return": None}


@pytest.mark.parametrize(
    ("line", "why"),
    [
        (b'{"phase": "explore"}', "missing required field `arm`"),
        (b'{"phase": "\\u001b[2J"}', r"Invalid value '\x1b[2J' - at `$.phase`"),
        (b'{"phase": "expl\xe1re"}', "can't decode byte 0xe1 in position 15"),
        (b"[" * 100_000, "recursion"),
        (b"", "Expecting value"),
        (b"7", "Expected `object`, got `int`"),
        *[
            (json.dumps(GOOD | {name: value}).encode(), f"at `$.{name}")
            for name, value in {
                "arm": "a/../b", "seed": "1", "trial": None, "task": 3, "return": "x",
                "fit": 3, "seconds": [], "returns": {"forward": "x"},
                "explored_trials": 1.5,
            }.items()
        ],
    ],
)  # fmt: skip
def test_a_line_that_is_no_row_is_left_out_and_named(tmp_path, capsys, line, why):
    log = tmp_path / "metrics.jsonl"
    good = json.dumps(GOOD).encode()
    log.write_bytes(b"\n".join([good, line, good, b""]))
    assert len(list(metrics.read(log, {"preset": "smoke"}))) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"warning: {log}:2 is no row of a run (")
    assert why in said and said.endswith("); left out.\n") and said.count("\n") == 1
