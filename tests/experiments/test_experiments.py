"""Whole runs of the preset smoke: real physics, real planning, real processes.

Physics in C, which compiles in a third of the time; CI explores and performs on MJX.
"""

import json
import os
import shutil
import signal
import time
from typing import get_args

import jax
import numpy as np
import pytest
import runs
from runs import learner, rows

from experiments.config import UNPLANNED, ArmName
from experiments.run import main
from experiments.storage import checkpoint, rundir
from jaxpets.envs import half_cheetah

SMOKE = ("--phase", "explore", "--preset", "smoke", "--engine", "mujoco")
NAME = "smoke-epistemic"
TRIAL, STEPS = 3, 20
FIT = {
    "nll", "mse", "num_updates", "num_skipped", "max_logvar_low", "max_logvar_high",
    "min_logvar_low", "min_logvar_high",
}  # fmt: skip


def start(*flags, **variables):
    """Starts a run in a process of its own, where only a video may mind the GL."""
    run = ("-m", "experiments.run", *flags)
    return runs.start(*run, variables={"MUJOCO_GL": "crayons", **variables})


def finish(process):
    said, errors = process.communicate(timeout=300)
    assert said == ""
    return process.returncode, errors


@pytest.fixture(scope="module")
def straight(explored_once):
    """A run without a stop."""
    return explored_once(0)


@pytest.fixture
def again(straight, tmp_path):
    """A copy of that run."""
    return runs.copied(straight.folder, tmp_path)


def untimed(folder):
    return [{k: v for k, v in row.items() if k != "seconds"} for row in rows(folder)]


def assert_same_run(one, other):
    """Bitwise: weights, Adam, scaler, data, reward data, and the log but for time."""
    assert untimed(one) == untimed(other)
    jax.tree.map(
        lambda a, b: np.testing.assert_array_equal(a.view("u1"), b.view("u1")),
        *[
            jax.tree.map(lambda x: np.atleast_1d(np.asarray(x)), learner(folder))
            for folder in (one, other)
        ],
    )


def contents(folder):
    return {
        path.relative_to(folder): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.name not in (".lock", "status.json")
    }


def status(folder):
    return json.loads((folder / "status.json").read_text())["state"]


@pytest.mark.slow
def test_a_run_says_a_line_per_trial_and_nothing_else(straight):
    folder, output, errors = straight
    assert output == ""
    lines = errors.splitlines()
    assert len(lines) == TRIAL + 1, errors
    for trial, line in enumerate(lines[:-1], 1):
        assert line.startswith(f"explore {trial}/{TRIAL}  value ")
        assert all(name in line for name in half_cheetah.TASK_NAMES)
        assert "steps/s" in line and "min left" in line
    assert lines[-1].endswith(f"experiments.run zero-shot --from {folder}")
    assert status(folder) == "complete"
    assert json.loads((folder / "env.json").read_text())["backend"] == "cpu"


@pytest.mark.slow
def test_the_log_has_every_field(straight):
    log = rows(straight.folder)
    assert [row["trial"] for row in log] == [1, 2, 3]
    assert [row["planner"] for row in log] == ["random", "plan", "plan"]
    for row in log:
        assert (row["phase"], row["arm"], row["seed"]) == ("explore", "epistemic", 0)
        assert row["steps"] == STEPS * row["trial"]
        assert set(row["returns"]) == set(half_cheetah.TASK_NAMES)
        assert set(row["fit"]) == FIT
        assert row["fit"]["num_skipped"] == 0
        assert set(row["seconds"]) == {"act", "fit"}
        assert np.isfinite([row["value"], row["turns"], *row["fit"].values()]).all()
    # Bootstraps hold as many rows as the data: 20, 40, 60 in batches of 16.
    assert [row["fit"]["num_updates"] for row in log] == [2, 3, 4]
    assert log[0]["value"] == 0.0 and log[1]["value"] > 0.0


@pytest.mark.slow
def test_interrupted_and_resumed_equals_uninterrupted(straight, tmp_path, capsys):
    flags = (*SMOKE, "--out", tmp_path)
    # It compiles for itself, so that its second trial is not over before it hears.
    process = start(*flags, JAX_COMPILATION_CACHE_DIR=str(tmp_path / "programs"))
    assert process.stderr.readline().startswith("explore 1/3")
    process.send_signal(signal.SIGTERM)
    code, errors = finish(process)
    assert code == 75
    assert errors.startswith("stopped: SIGTERM") and "same command" in errors
    assert errors.count("\n") == 1
    folder = tmp_path / NAME
    assert status(folder) == "interrupted"
    assert checkpoint.steps(folder / "checkpoints") == [1]
    assert main([*map(str, flags)]) == 0
    assert capsys.readouterr().err.startswith("explore 2/3")
    assert_same_run(folder, straight.folder)


@pytest.mark.slow
def test_a_refit_that_would_take_minutes_stops_in_time(again):
    refit = ("--refit.num-epochs", "10000", "--refit.batch-size", "1")
    process = start("--phase", "zero-shot", "--from", again, *refit)
    path = again / "zero-shot-003" / "status.json"
    while not path.exists() and process.poll() is None:
        time.sleep(0.05)
    time.sleep(2)  # it compiles, or runs
    process.send_signal(signal.SIGHUP)
    begin = time.monotonic()
    code, errors = finish(process)
    assert code == 75, errors
    assert time.monotonic() - begin < 8.0  # five, and what a busy machine adds
    assert errors.startswith("stopped: SIGHUP; ") and errors.count("\n") == 1
    assert status(path.parent) == "interrupted"


@pytest.mark.slow
def test_a_finished_run_is_left_alone(again, capsys):
    before = contents(again)
    assert main([*SMOKE, "--out", str(again.parent)]) == 0
    assert "already complete: 3 of 3 trials" in capsys.readouterr().err
    assert contents(again) == before


@pytest.mark.slow
def test_a_run_may_be_given_more_trials(straight, again, capsys):
    longer = [*SMOKE, "--out", str(again.parent), "--num-trials", "4"]
    assert main(longer) == 0
    assert [row["trial"] for row in rows(again)] == [1, 2, 3, 4]
    assert untimed(again)[:3] == untimed(straight.folder)
    assert json.loads((again / "config.json").read_text())["num_trials"] == 4
    old, new = learner(straight.folder).dataset, learner(again).dataset
    assert int(new.size) == new.data.obs.shape[1] == 4 * STEPS
    np.testing.assert_array_equal(new.data.obs[:, : 3 * STEPS], old.data.obs)

    # The last one again, from a checkpoint that has less room; then fewer than all.
    once = again.parent / "once"
    shutil.copytree(again, once)
    shutil.rmtree(again / "checkpoints" / "4")
    assert main(longer) == 0
    assert_same_run(again, once)
    capsys.readouterr()
    assert main([*longer[:-1], "2"]) == 0
    assert "already complete: 2 of 2 trials" in capsys.readouterr().err
    assert json.loads((again / "config.json").read_text())["num_trials"] == 4


@pytest.mark.slow
def test_one_folder_takes_one_process(again, capsys):
    before = contents(again)
    with rundir.lock(again):  # which is an open file's, not a process's
        assert main([*SMOKE, "--out", str(again.parent)]) == 3
    errors = capsys.readouterr().err
    assert f"{again} is in use by pid {os.getpid()}" in errors
    assert errors.count("\n") == 1
    assert contents(again) == before


@pytest.mark.slow
def test_one_folder_takes_one_set_of_numbers(again, capsys):
    before = contents(again)
    flags = (*SMOKE, "--out", str(again.parent), "--planner.horizon", "4")
    assert main(flags) == 3
    line = capsys.readouterr().err
    assert "planner.horizon: 3 (there) vs 4 (now)" in line
    assert line.count("\n") == 1
    assert contents(again) == before


@pytest.mark.slow
def test_a_trial_without_checkpoint_is_refused(again, capsys):
    flags = ["--phase", "zero-shot", "--from", str(again), "--at-trial", "1"]
    assert main(flags) == 2
    line = capsys.readouterr().err
    assert "--at-trial 1 is not valid; it must be one of 2, 3." in line


@pytest.mark.slow
def test_two_seeds_through_all_phases(
    straight, explored_once, tmp_path, capsys, monkeypatch
):
    folder = runs.copied(explored_once(0, 7).folder, tmp_path)
    _check_side_by_side(folder, straight.folder)

    monkeypatch.setenv("MUJOCO_GL", "crayons")
    task = ("--from", str(folder), "--task", "back-flip")
    video = ("--video", str(tmp_path / "a.mp4"))
    zero_shot = ["--phase", "zero-shot", *task, "--eval-trials", "2", *video]
    # A signal stops a run at its video too, where the same command goes on.
    with monkeypatch.context() as patched:
        patched.setattr(
            "experiments.tools.video.render",
            lambda *_, **__: os.kill(os.getpid(), signal.SIGTERM),
        )
        assert main(zero_shot) == 75
    assert "\nstopped: SIGTERM; " in capsys.readouterr().err
    assert status(folder / "zero-shot-003-back-flip") == "interrupted"
    shown = json.loads((folder / "zero-shot-003-back-flip/status.json").read_text())
    assert shown["steps_per_second"] > 0
    # A video that cannot be made does not fail the run that it shows.
    assert main(zero_shot) == 0
    errors = capsys.readouterr().err
    assert "warning: no video; the run is complete: cannot render" in errors
    assert os.environ["MUJOCO_GL"] == "crayons"
    _check_task(folder / "zero-shot-003-back-flip", [(0, 1), (0, 2), (7, 1), (7, 2)])

    assert main(["--phase", "finetune", *task]) == 0
    tuned = folder / "finetune-003-back-flip"
    _check_task(tuned, [(0, 4), (7, 4), (0, 5), (7, 5)], trials=1)
    assert all(set(row["fit"]) == FIT for row in rows(tuned))
    assert [row["fit"]["num_updates"] for row in rows(tuned)] == [5, 5, 7, 7]
    _check_recovery(tuned, ["--phase", "finetune", *task], capsys)

    assert main(["--phase", "report", "--out", str(tmp_path)]) == 0
    table = json.loads((tmp_path / "report" / "table1.json").read_text())
    assert "back-flip" in json.dumps(table)
    assert capsys.readouterr().out == ""


def _check_recovery(tuned, command, capsys):
    """What a stop after the last checkpoint loses is made again from that."""
    path, log = tuned / "trajectories.npz", (tuned / "metrics.jsonl").read_bytes()
    before = dict(np.load(path))
    os.truncate(path, path.stat().st_size - 50)
    assert main(command) == 0
    assert f"{path} is not whole: made again." in capsys.readouterr().err
    after = dict(np.load(path))
    assert after.keys() == before.keys()
    for name, array in before.items():
        np.testing.assert_array_equal(after[name], array)
    assert (tuned / "metrics.jsonl").read_bytes() == log


def _check_side_by_side(folder, alone):
    """A seed among others is the same seed alone, up to rounding.

    XLA sums in another order where an axis is added, and physics amplifies that, so
    only the random first trial is compared; its actions are equal bit for bit.
    """
    log = rows(folder)
    assert [(row["seed"], row["trial"]) for row in log] == [
        (seed, trial) for trial in (1, 2, 3) for seed in (0, 7)
    ]
    first, other, single = log[0], log[1], rows(alone)[0]
    assert first["returns"] == pytest.approx(single["returns"], rel=1e-3, abs=1e-2)
    assert first["fit"] == pytest.approx(single["fit"], rel=1e-2)
    assert first["returns"] != other["returns"]
    many, one = learner(folder).dataset, learner(alone).dataset
    np.testing.assert_array_equal(
        np.asarray(many.data.action)[0, :STEPS], np.asarray(one.data.action)[0, :STEPS]
    )
    np.testing.assert_allclose(
        np.asarray(many.data.obs)[0, :STEPS],
        np.asarray(one.data.obs)[0, :STEPS],
        rtol=1e-3,
        atol=1e-3,
    )


def _check_task(folder, labels, trials=2):
    log = rows(folder)
    assert [(row["seed"], row["trial"]) for row in log] == labels
    for row in log:
        assert (row["task"], row["explored_trials"]) == ("back-flip", TRIAL)
        assert row["return"] == row["returns"]["back-flip"]
    paths = np.load(folder / "trajectories.npz")
    assert paths["obs"].shape == (2, 1, trials, STEPS, half_cheetah.OBS_SIZE)
    assert paths["action"].shape == (2, 1, trials, STEPS, half_cheetah.ACTION_SIZE)
    assert paths["seeds"].tolist() == [0, 7]
    assert paths["tasks"].tolist() == ["back-flip"]
    last = [row["return"] for row in log[-2 * trials :]]
    np.testing.assert_allclose(paths["returns"].ravel(), last)


# Each is made of the parts of another one; test_build.py has them fit.
LIKE_ANOTHER = (
    "epistemic", "best", "info-gain", "ensemble-std", "one-step", "jensen-renyi",
    "opax", "particle-entropy", "oracle",
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    "arm", [arm for arm in get_args(ArmName) if arm not in LIKE_ANOTHER]
)
def test_every_arm_explores(arm, tmp_path, capsys):
    flags = ("--arm", arm, "--num-trials", "2", "--out", str(tmp_path))
    assert main([*SMOKE, *flags]) == 0
    log = rows(tmp_path / f"smoke-{arm}")
    assert [(row["arm"], row["trial"]) for row in log] == [(arm, 1), (arm, 2)]
    assert np.isfinite([row["value"] for row in log]).all()
    assert (log[1]["value"] == 0.0) == (arm in UNPLANNED)
    assert log[1]["planner"] == UNPLANNED.get(arm, "plan")
    assert capsys.readouterr().out == ""
