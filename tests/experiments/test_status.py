"""The table of runs: true while they run, and however they ended."""

import json
import os
import subprocess
import sys

import pytest

from experiments import status as command
from experiments.errors import CheckpointError, StorageError
from experiments.storage import rundir, status


def begun(folder, **changes):
    """Makes a run that this process says it runs, but for what is changed."""
    folder.mkdir(parents=True, exist_ok=True)
    writer = status.Writer(folder, "explore")
    writer.begin()
    path = folder / rundir.STATUS
    rundir.write_json(path, rundir.read_json(path) | changes)
    return folder


def table(capsys, *arguments):
    """Returns the rows by the last part of the folder, and the exit code."""
    code = command.main([*map(str, arguments)])
    lines = capsys.readouterr().out.splitlines()
    return {line.split()[0].rpartition("/")[2]: line for line in lines}, code


def test_a_run_that_runs_is_running(tmp_path):
    found = status.read(begun(tmp_path))
    assert (found.state, found.phase, found.pid) == ("running", "explore", os.getpid())
    assert (found.host_bytes or 1e8) > 1e7  # not every system tells


def test_a_process_that_is_gone_was_killed(tmp_path):
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    start = status._started(child.pid)
    folder = begun(tmp_path, pid=child.pid, process_start=start, trial=4)
    assert status.read(folder).state == "running"
    child.kill()
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)  # a parent may not ask
    found = status.read(folder)
    assert (found.state, found.trial) == ("killed", 4)
    child.communicate()
    assert status.read(folder).reason == f"process {child.pid} is gone"
    # Another one has its number now.
    another = begun(tmp_path, process_start=status._started(os.getpid()) - 1)
    assert status.read(another).state == "killed"


def test_a_process_of_another_host_may_run(tmp_path):
    assert status.read(begun(tmp_path, host="h1", pid=2**22)).state == "running"


def test_a_run_keeps_how_far_it_got(tmp_path):
    done = {"trial": 4, "num_trials": 6, "steps_per_second": 9.0}
    folder = begun(tmp_path, **done, state="interrupted", reason="x")
    found = status.read(begun(folder))
    assert (found.state, found.reason) == ("running", "")
    assert (found.trial, found.num_trials) == (4, 6)
    assert found.steps_per_second is None  # of this process


def test_a_disk_that_refuses_everything_stops_nothing(tmp_path, monkeypatch):
    writer = status.Writer(tmp_path, "explore")
    writer.begin()

    def refused(*args):
        raise StorageError("no draft")

    def full(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(rundir, "write_json", refused)
    monkeypatch.setattr(status.os, "pwrite", full)
    writer.update(trial=5)
    with pytest.raises(StorageError, match="No space left"):
        writer.end(status.COMPLETE)
    assert status.read(tmp_path).trial is None


@pytest.mark.parametrize("text", ["", "[1]", '{"state": 1}', '{"trial": 2}', "{", "\0"])
def test_what_is_no_status_is_named_and_replaced(tmp_path, text):
    path = tmp_path / rundir.STATUS
    path.write_text(text)
    with pytest.raises(CheckpointError, match=r"status\.json"):
        status.read(tmp_path)
    assert status.read(begun(tmp_path)).state == "running"


def test_the_table_shows_every_run(tmp_path, capsys):
    begun(tmp_path / "on", trial=4, num_trials=9, steps_per_second=3.25,
          seconds_left=90.0, line="explore 4/9 \x1b[31mred",
          host_bytes=520_000_000, device_bytes=3_400_000_000)  # fmt: skip
    begun(tmp_path / "away", host="h1", line="explore 1/9")
    begun(tmp_path / "broke", state="failed", reason="the disk is full", line="4/9")
    begun(tmp_path / "gone", pid=2**22, process_start=1)
    begun(tmp_path / "on" / "zero-shot-004", state="complete", line="returns")
    begun(tmp_path / ".hidden")
    old = {"state": "complete", "reason": "", "time": "2026-01-01T00:00:00+00:00"}
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / rundir.STATUS).write_text(json.dumps(old))
    (tmp_path / "torn").mkdir()
    (tmp_path / "torn" / rundir.STATUS).write_text('{"state": "run')
    rows, code = table(capsys, tmp_path)
    assert code == 0 and set(rows) == {
        *("run", "on", "away", "broke", "gone", "zero-shot-004", "old", "torn")
    }  # fmt: skip
    words = "running 4/9 3.2 1.5 min 0.5 + 3.4 GB explore 4/9 \\x1b[31mred"
    assert rows["on"].split()[1:] == words.split()
    assert "running" in rows["away"] and "on h1, " in rows["away"]
    assert "failed" in rows["broke"] and rows["broke"].endswith("the disk is full")
    assert "killed" in rows["gone"] and rows["gone"].endswith("is gone")
    assert rows["zero-shot-004"].split()[1:] == ["complete", "returns"]
    assert rows["old"].split()[1:] == ["complete"]
    assert "unreadable" in rows["torn"] and "torn/status.json cannot" in rows["torn"]


def test_no_runs_and_no_folder(tmp_path, capsys):
    assert command.main([str(tmp_path)]) == 0
    assert capsys.readouterr().out == f"no runs in {tmp_path}\n"
    assert command.main([str(tmp_path / "x")]) == 2
    assert capsys.readouterr().err == f"error: {tmp_path / 'x'} is no folder.\n"


def test_the_help_fits_a_screen(capsys):
    with pytest.raises(SystemExit) as end:
        command.main(["--help"])
    assert end.value.code == 0
    assert len(capsys.readouterr().out.splitlines()) <= 24
