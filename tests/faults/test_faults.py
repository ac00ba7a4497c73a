"""A sample of the bench of faults: one of each kind, in exploration."""

import contextlib
import errno
import os
import signal

import pytest
from faults import configs, lab

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
    middle = lab.Fault("", "explore")._replace
    faults = [
        middle(what=lab.KILL, at=writes // 2, number=errno.ENOSPC),
        middle(what=lab.FROM_THEN_ON, at=writes // 2, number=errno.ENOSPC),
        middle(what=lab.ONCE, at=every // 2, number=errno.EIO),
        middle(signal=signal.SIGTERM, after=explored.seconds["explore"] / 2),
        middle(phase="resume", damage=flip_largest),
    ]
    return dict(zip(KINDS, explored.meet_all(faults, float("inf")), strict=True))


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


def test_damaged_configs_are_refused_or_read_as_they_are(tmp_path):
    found = configs.damaged(200, tmp_path)
    assert found.total() >= 200
    assert set(found) == set(configs.GOOD_ENDS), found
