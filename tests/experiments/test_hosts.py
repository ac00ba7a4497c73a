"""Several processes, each a host of its own: the same run, and one end for all of them.

Two processes on this machine. Each is told another folder: only the one of process 0
is there in the end.
"""

import json
import signal
import socket
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pytest
import runs

from experiments import cli
from experiments.parallel.distributed import ProcessSpec
from experiments.report import coverage
from experiments.run import main
from experiments.storage import checkpoint, status

RUN = ("-m", "experiments.run")
SEEDS = ("--seeds", "1", "0")
TASKS = "zero-shot-003"
# By what jax finds out that it is on a cluster.
CLUSTERS = ("SLURM_JOB_ID", "OMPI_MCA_orte_hnp_uri", "KUBERNETES_SERVICE_HOST")


def free_port(low=0):
    for port in range(low, low + 4000) if low else [0]:
        with socket.socket() as taken:
            try:
                taken.bind(("", port))
            except OSError:
                continue
            return taken.getsockname()[1]
    return pytest.fail("no free port")


def start(outs, *flags):
    """Starts a process per folder."""
    where = ("--coordinator-address", f"localhost:{free_port()}")
    count = ("--num-processes", len(outs))
    return [
        runs.start(*RUN, *flags, "--out", out, *where, *count, "--process-id", i)
        for i, out in enumerate(outs)
    ]


def finish(processes):
    """Returns exit codes and what was said on stderr; a process that hangs fails."""
    try:
        said = [process.communicate(timeout=1500)[1] for process in processes]
    finally:
        for process in processes:
            process.kill()
    return [process.returncode for process in processes], said


def errors(said):
    """Returns why each process ended, without what gloo and XLA say."""
    ends = ("error: ", "stopped: ")
    return [[x for x in text.splitlines() if x.startswith(ends)] for text in said]


def until_first_trial(process):
    """Waits until a trial is saved; the next one has a planner to compile first."""
    for line in process.stderr:
        if line.startswith("explore 1/3"):
            return
    pytest.fail("it has ended")


class Runs(NamedTuple):
    """Seeds 1 and 0 on two hosts, stopped after the first trial and continued."""

    folder: Path
    other: Path  # what process 1 was told
    alone: Path  # seed 0, one process
    codes: list  # of the stop
    said: list
    state: dict  # of the stopped run
    saved: list


@pytest.fixture(scope="module")
def found(explored_once, tmp_path_factory):
    out = tmp_path_factory.mktemp("hosts")
    outs = (out / "first", out / "second")
    folder = outs[0] / runs.NAME
    processes = start(outs, *runs.EXPLORED, *SEEDS)
    until_first_trial(processes[0])
    processes[1].send_signal(signal.SIGTERM)
    stopped = finish(processes)
    state = json.loads((folder / "status.json").read_text())
    saved = checkpoint.steps(folder / "checkpoints")
    codes, said = finish(start(outs, *runs.EXPLORED, *SEEDS))
    assert codes == [0, 0], said
    return Runs(folder, outs[1], explored_once(0).folder, *stopped, state, saved)


@pytest.mark.slow
def test_a_signal_to_one_stops_all(found):
    assert found.codes == [75, 75], found.said
    (first,), (second,) = errors(found.said)
    # A signal that a compilation keeps from its tick for too long ends its process.
    reasons = ("SIGTERM", "process 1 is gone")
    reason = found.state["reason"]
    assert found.state["state"] == "interrupted" and reason in reasons
    assert first.startswith(f"stopped: {reason}; ") and "same command" in first
    assert second.startswith("stopped: SIGTERM; ")
    assert found.saved == [1]


@pytest.mark.slow
def test_a_seed_on_its_host_is_the_seed_alone(found):
    """The same program, so bit for bit, although it was stopped on the way.

    But for the log: there NumPy sums over both seeds.
    """
    many = [row for row in runs.rows(found.folder) if row["seed"] == 0]
    assert len(many) == runs.LAST
    for row, alone in zip(many, runs.rows(found.alone), strict=True):
        labels = ("seed", "trial", "steps", "phase", "arm", "planner")
        assert [row[name] for name in labels] == [alone[name] for name in labels]
        close = pytest.approx(runs.numbers(alone), rel=1e-5, abs=1e-5)
        assert runs.numbers(row) == close
    here, alone = runs.learner(found.folder), runs.learner(found.alone)
    assert int(here.dataset.size) == int(alone.dataset.size) == runs.LAST * runs.STEPS
    for name in ("params", "fit"):
        jax.tree.map(same_last, getattr(here, name), getattr(alone, name))
    jax.tree.map(same_last, here.dataset.data, alone.dataset.data)


def same_last(many, one):
    np.testing.assert_array_equal(np.asarray(many)[-1:], np.asarray(one))


@pytest.mark.slow
def test_the_log_of_two_hosts_is_in_order(found):
    labels = [(row["seed"], row["trial"]) for row in runs.rows(found.folder)]
    assert labels == [(seed, trial) for trial in (1, 2, 3) for seed in (1, 0)]


@pytest.mark.slow
def test_only_the_first_host_has_a_folder(found):
    assert found.folder.is_dir() and not found.other.exists()
    status = json.loads((found.folder / "status.json").read_text())
    assert status["state"] == "complete"
    seen = coverage.load(found.folder)["smoke"]
    assert list(seen.by_arm["epistemic"]) == [1, 0]


@pytest.mark.slow
def test_tasks_of_one_seed_are_spread_over_hosts(found, performed_once, tmp_path):
    """The model comes from process 0 and is refit; one process has the same returns."""
    outs = tmp_path / "first", tmp_path / "second"
    runs.copied(found.alone, outs[0])
    command = ("--phase", "zero-shot", "--preset", "smoke", *runs.REFIT)
    codes, said = finish(start(outs, *command))
    assert codes == [0, 0], said
    spread, whole = outs[0] / runs.NAME / TASKS, performed_once / TASKS
    for row, other in zip(runs.rows(spread), runs.rows(whole), strict=True):
        assert row["task"] == other["task"]
        # Two tasks in a batch or four: rounding, which physics amplifies.
        close = pytest.approx(runs.numbers(other), rel=1e-2, abs=1e-2)
        assert runs.numbers(row) == close
    paths = np.load(spread / "trajectories.npz")
    assert paths["obs"].shape == (1, 4, 1, runs.STEPS, 18)
    assert not outs[1].exists()


@pytest.mark.slow
def test_a_host_that_is_gone_ends_the_other(tmp_path):
    """No one waits; what was saved is still there."""
    processes = start((tmp_path / "a", tmp_path / "b"), *runs.EXPLORED, *SEEDS)
    until_first_trial(processes[0])
    processes[1].kill()
    (first, second), said = finish(processes)
    assert second == -signal.SIGKILL
    assert first == 75, said
    assert said[0] == (
        "stopped: process 1 is gone; at most the trial under way is lost. Continue "
        "with the same command.\n"
    )
    folder = tmp_path / "a" / runs.NAME
    assert checkpoint.steps(folder / "checkpoints") == [1]
    found = status.read(folder)
    assert (found.state, found.reason) == ("interrupted", "process 1 is gone")
    assert (found.trial, found.num_trials) == (1, runs.LAST)


@pytest.mark.parametrize(
    ("flags", "code", "words"),
    [
        (("--phase", "explore", "--preset", "smoke", "--num-trials", "0"), 2, "1 to"),
        (("--phase", "explore", "--preset", "smoke", "--name", "file"), 5, "file"),
    ],
    ids=["usage", "storage"],
)
def test_what_only_the_first_host_sees_ends_all(tmp_path, flags, code, words):
    """As a missing run does; see test_a_cluster_says_who_is_who."""
    outs = tmp_path / "first", tmp_path / "second"
    outs[0].mkdir()
    (outs[0] / "file").touch()
    codes, said = finish(start(outs, *flags))
    assert codes == [code, code], said
    (first,), (second,) = errors(said)
    assert first == second
    assert first.startswith("error: ") and words in first
    assert [path.name for path in outs[0].iterdir()] == ["file"]
    assert not outs[1].exists()


def test_wrong_flags_do_not_wait_for_the_others(tmp_path, capsys):
    """All have the same: none of them joins, be it the one that the others wait for."""
    place = ("--coordinator-address", f"localhost:{free_port()}", "--num-processes=2")
    for process in "01":
        flags = ("--phase", "fly", "--out", str(tmp_path), *place)
        assert main([*flags, "--process-id", process]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("error: --phase fly is not valid")


def test_a_cluster_says_who_is_who(tmp_path):
    """As SLURM does, whose port is made from the job's number."""
    low = 65536 - 2**12
    job = {
        "SLURM_JOB_ID": str(free_port(low) - low),
        "SLURM_STEP_NODELIST": "localhost",
        "SLURM_NTASKS": "2",
        "SLURM_STEP_NUM_NODES": "1",
    }
    flags = ("--phase", "zero-shot", "--preset", "smoke", "--out", tmp_path / "none")
    processes = [
        runs.start(*RUN, *flags, "--coordinator-address", "auto", variables=job | own)
        for own in (
            {"SLURM_PROCID": "0", "SLURM_LOCALID": "0"},
            {"SLURM_PROCID": "1", "SLURM_LOCALID": "1"},
        )
    ]
    codes, said = finish(processes)
    assert codes == [3, 3], said
    (first,), (second,) = errors(said)
    assert first == second and "there is no exploration run" in first
    assert all(text.startswith("waiting for the other processes") for text in said)
    assert not list(tmp_path.iterdir())


def test_auto_needs_a_cluster(monkeypatch):
    for name in CLUSTERS:
        monkeypatch.delenv(name, raising=False)
    flags = ("--phase", "explore", "--preset", "smoke", "--coordinator-address", "auto")
    codes, said = finish([runs.start(*RUN, *flags)])
    assert codes == [2], said
    ((line,),) = errors(said)
    assert "cannot join the other processes" in line and "--process-id" in line


@pytest.mark.parametrize(
    ("flags", "wanted"),
    [
        ((), None),
        (("--coordinator-address", "auto"), ProcessSpec(None, None, None)),
        (
            ("--coordinator-address=h:1", "--num_processes", "3", "--process-id", "2"),
            ProcessSpec("h:1", 3, 2),
        ),
    ],
    ids=["alone", "auto", "named"],
)
def test_the_place_of_a_process(flags, wanted):
    assert (
        cli.process_spec(["--phase", "explore", "--preset", "smoke", *flags]) == wanted
    )
