"""A sample of the bench of faults: one of each kind, in exploration."""

import contextlib
import errno
import os
import signal

import pytest
from faults import bench, configs, lab, log

KINDS = ("kill", "no space", "error", "signal", "flip")


@pytest.fixture(scope="module")
def explored(tmp_path_factory):
    jobs = 2 if os.cpu_count() else 1
    folder = tmp_path_factory.mktemp("faults").resolve()
    with contextlib.closing(lab.Bench(folder, jobs, ("explore", "resume"))) as found:
        yield found


@pytest.fixture(scope="module")
def outcomes(explored):
    """Faults while the second checkpoint is written, all met at once."""
    writes, every = explored.operations["explore"]
    phase, half = "explore", explored.seconds["explore"] / 2
    faults = [
        lab.Fault("kill", phase, lab.KILL, writes // 2, errno.ENOSPC),
        lab.Fault("no space", phase, lab.FROM_THEN_ON, writes // 2, errno.ENOSPC),
        lab.Fault("error", phase, lab.ONCE, every // 2, errno.EIO),
        lab.Fault("signal", phase, signal=signal.SIGTERM, after=half),
        lab.Fault("flip", "resume", damage=flip_largest),
    ]
    return {outcome.fault.kind: outcome for outcome in explored.meet_all(faults)}


def flip_largest(out):
    files = (path for path in out.rglob("checkpoints/2/**/*") if path.is_file())
    largest = max(files, key=lambda path: path.stat().st_size)
    lab.flip(out, str(largest.relative_to(out)), seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_run_goes_on_as_if_it_had_met_nothing(outcomes, kind):
    outcome = outcomes[kind]
    assert outcome.wrong == "", outcome
    assert outcome.met or kind == "signal"  # which may come too late
    if kind == "flip":
        assert "warning: checkpoint 2 is damaged" in outcome.said


def test_a_log_keeps_what_was_tried_but_for_a_line_that_is_torn(tmp_path):
    file = tmp_path / "log"
    assert log.read(file) == []
    tried = [
        lab.Outcome(lab.Fault("signal", "explore", at=3), True, "", 75, "stopped\n"),
        lab.Outcome(lab.Fault("EIO, once", "resume", at=3), False, "hang", None, "é\n"),
    ]
    for outcome in tried:
        log.add(file, outcome)
    file.write_text(file.read_text() + '\n{"kind": "sig')
    log.add(file, tried[0])
    assert log.read(file) == [tried[0]._replace(said=""), tried[1], log.read(file)[0]]
    assert log.tried(log.read(file)) == {
        ("signal", "explore", 3),
        ("EIO, once", "resume", 3),
    }
    assert bench.table(log.read(file)).endswith(
        "| signal | explore | 2 | 2 | 0 | 0 | 0 | 0 |"
    )


def test_a_bench_that_is_over_begins_with_nothing_more(explored):
    faults = [lab.Fault("none", "explore")] * 3
    assert list(explored.meet_all(faults, lambda: True)) == []


def test_damaged_configs_are_refused_or_read_as_they_are(tmp_path):
    found = configs.damaged(200, tmp_path)
    assert found.total() >= 200
    assert set(found) == set(configs.GOOD_ENDS), found
