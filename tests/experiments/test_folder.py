"""A run's folder: what is recorded comes back, and what becomes of a run is written."""

import json
import os
import shutil

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.errors import CheckpointError, InterruptedRun, StorageError
from experiments.storage import checkpoint, folder, identity, metrics, rundir
from experiments.storage.folder import RunFolder

FLIPPED = b'{"trial": 1}\n{"tri\xe1l": 2}\n{"trial": 3}\n'
CONFIG = {"phase": "explore", "milestones": [1], "seeds": [0]}


def state(trial):
    return {"w": jnp.full((3,), trial, jnp.float32)}


def record(run, trial):
    run.record(trial, [{"trial": trial}], state(trial), finite=state(trial))


def trials(run):
    lines = (run.path / rundir.METRICS).read_text().splitlines()
    return [json.loads(line)["trial"] for line in lines]


def differences(old, new, where):
    del where
    return [f"seeds: {old['seeds']}"] if old["seeds"] != new["seeds"] else []


def opened(path, config=CONFIG):
    return folder.open_run(path, config, differences, 1000)


def status(path):
    return json.loads((path / rundir.STATUS).read_text())


def test_a_run_goes_on_from_what_it_recorded(tmp_path):
    run = RunFolder(tmp_path, milestones=(1,))
    assert run.resume(state(0)) is None and run.restore(state(0)) is None
    assert run.steps() == []
    for trial in (1, 2, 3, 4):
        record(run, trial)
    # It was stopped before its checkpoint.
    metrics.append_rows(tmp_path / rundir.METRICS, [{"trial": 5}])
    found = run.resume(state(0))
    assert found is not None and found[0] == 4
    assert found[1]["w"].tolist() == [4.0] * 3
    assert trials(run) == [1, 2, 3, 4]
    assert run.steps() == [1, 3, 4]  # a milestone and the last two
    assert run.restore_trial(1, state(0))["w"].tolist() == [1.0] * 3
    with pytest.raises(CheckpointError, match=r"no checkpoint 2 in .*there: 1, 3, 4"):
        run.restore_trial(2, state(0))


def test_a_part_of_a_state_can_be_read(tmp_path):
    run = RunFolder(tmp_path)
    run.save(7, {**state(7), "more": jnp.zeros(2)})
    assert run.restore_trial(7, state(0), part=True)["w"].tolist() == [7.0] * 3
    with pytest.raises(CheckpointError, match="more is not in this run"):
        run.restore(state(0))


def test_trajectories_are_replaced_at_once(tmp_path, monkeypatch):
    run = RunFolder(tmp_path)
    run.save_trajectories({"obs": np.arange(3)})

    def full(_file):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(rundir.os, "fsync", full)
        with pytest.raises(StorageError, match="No space left"):
            run.save_trajectories({"obs": np.arange(4)})
    assert np.load(run.trajectories)["obs"].tolist() == [0, 1, 2]
    assert [path.name for path in tmp_path.iterdir()] == [rundir.TRAJECTORIES]


def test_trajectories_are_whole_or_made_again(tmp_path):
    run = RunFolder(tmp_path)
    assert not run.has_trajectories()
    run.save_trajectories({"obs": np.arange(300)})
    assert run.has_trajectories()
    whole = run.trajectories.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 3] ^= 1
    for data in (b"", whole[:-30], bytes(flipped)):
        run.trajectories.write_bytes(data)
        assert not run.has_trajectories()
    run.trajectories.unlink()
    os.mkfifo(run.trajectories)
    assert not run.has_trajectories()


@pytest.mark.parametrize(
    ("damage", "left", "lost"),
    [
        (lambda log: log.unlink(), [], "trials 1 to 3"),
        (lambda log: log.write_bytes(b""), [], "trials 1 to 3"),
        (lambda log: os.truncate(log, 40), [1], "trials 2 to 3"),
        (lambda log: log.write_bytes(FLIPPED), [1, 3], "trial 2"),
        (
            lambda log: log.write_bytes(log.read_bytes().replace(b"1", b"2", 1)),
            [2, 3],
            "trial 1",
        ),
    ],
)
def test_a_damaged_log_costs_rows_and_not_the_run(tmp_path, capsys, damage, left, lost):
    run = RunFolder(tmp_path)
    for trial in (1, 2, 3):
        record(run, trial)
    log = tmp_path / rundir.METRICS
    damage(log)
    found = run.resume(state(0))
    assert found is not None and found[0] == 3
    assert trials(run) == left if left else not log.exists() or not log.read_bytes()
    assert capsys.readouterr().err == (
        f"warning: {log} has lost rows of {lost}; the run goes on from checkpoint 3 "
        "without them.\n"
    )
    record(run, 4)
    assert run.resume(state(0)) and trials(run) == [*left, 4]


def test_the_rows_of_a_trial_are_there_together(tmp_path, capsys):
    """The checkpoint knows how many there are: here two seeds."""
    run = RunFolder(tmp_path)
    run.record(1, [{"trial": 1}, {"trial": 1}], state(1), finite=())
    log = tmp_path / rundir.METRICS
    os.truncate(log, log.stat().st_size // 2)
    run.resume(state(0))
    assert "has lost rows of trial 1;" in capsys.readouterr().err
    # One of an older version does not, and remembers the size of the log.
    for path in (tmp_path / rundir.CHECKPOINTS).iterdir():
        shutil.rmtree(path)
    checkpoint.save(tmp_path / rundir.CHECKPOINTS, 2, state(2), {"log": 26})
    metrics.append_rows(log, [{"trial": 2}])
    assert run.resume(state(0)) and capsys.readouterr().err == ""


def test_checkpoints_that_are_gone_are_missed(tmp_path, capsys):
    run = RunFolder(tmp_path)
    for trial in (1, 2, 3):
        record(run, trial)
    shutil.rmtree(tmp_path / rundir.CHECKPOINTS)
    assert run.resume(state(0)) is None
    log = tmp_path / rundir.METRICS
    assert capsys.readouterr().err == (
        "warning: there is a log of trials 1 to 3, but no checkpoint; the run starts "
        f"again at trial 1, and these rows are in {log}.orphan now.\n"
    )
    assert trials(run) == []
    assert run.resume(state(0)) is None and capsys.readouterr().err == ""


def test_what_has_performed_is_whole_or_performs_again(tmp_path, capsys):
    run, log = RunFolder(tmp_path), tmp_path / rundir.METRICS
    assert not run.performed(2) and capsys.readouterr().err == ""
    for lost in (log, run.trajectories):
        run.save_trajectories({"obs": np.arange(3)})
        run.log([{"trial": 1}, {"trial": 2}])
        assert run.performed(2) and capsys.readouterr().err == ""
        lost.write_bytes(lost.read_bytes()[:15])
        assert not run.performed(2)
        words = f"warning: {lost} is not whole: performing again.\n"
        assert capsys.readouterr().err == words
        assert trials(run) == []


def test_what_has_lost_a_file_performs_again(tmp_path, capsys):
    run, policy = RunFolder(tmp_path), tmp_path / "policy-0.safetensors"
    run.save_trajectories({"obs": np.arange(3)})
    run.log([{"trial": 1}])
    policy.touch()
    assert run.performed(1, policy.name) and capsys.readouterr().err == ""
    policy.unlink()
    assert not run.performed(1, policy.name)
    words = f"warning: {policy} is not whole: performing again.\n"
    assert capsys.readouterr().err == words


def test_what_becomes_of_a_run_is_written(tmp_path):
    with opened(tmp_path) as run:
        assert run.path == tmp_path and run.milestones == (1,)
        assert run.config() == CONFIG
        assert status(tmp_path)["state"] == "running"
        run.update(trial=2, num_trials=3)
        run.say("a line\nand the last")
        with pytest.raises(CheckpointError, match="in use by pid"), opened(tmp_path):
            raise AssertionError("two hold it")
    done = status(tmp_path)
    assert (done["state"], done["trial"], done["num_trials"]) == ("complete", 2, 3)
    assert (done["phase"], done["line"]) == ("explore", "and the last")
    assert (done["pid"], done["reason"]) == (os.getpid(), "")


@pytest.mark.parametrize(
    ("error", "state", "reason"),
    [
        (InterruptedRun("SIGTERM"), "interrupted", "SIGTERM"),
        (KeyboardInterrupt(), "interrupted", "KeyboardInterrupt"),
        (StorageError("the disk is full"), "failed", "the disk is full"),
        (MemoryError(), "failed", "MemoryError"),
        (OSError(28, "No space"), "failed", "OSError: [Errno 28] No space"),
        (RuntimeError("a bug\nof ours"), "failed", "RuntimeError: a bug"),
        (SystemExit(3), "failed", "SystemExit: 3"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else "",
)
def test_no_end_leaves_a_run_running(tmp_path, error, state, reason):
    with pytest.raises(type(error)), opened(tmp_path) as run:
        run.update(trial=1)
        raise error
    found = status(tmp_path)
    assert (found["state"], found["reason"], found["trial"]) == (state, reason, 1)


def test_a_full_disk_does_not_keep_the_end_a_secret(tmp_path, monkeypatch):
    def full(_file):
        raise OSError(28, "No space left on device")

    with pytest.raises(RuntimeError), opened(tmp_path) as run:
        run.update(line="x" * 1000)
        monkeypatch.setattr(rundir.os, "fsync", full)
        run.update(line="short")
        raise RuntimeError("a bug")
    found = status(tmp_path)
    assert (found["state"], found["line"]) == ("failed", "short")


def test_what_comes_after_the_end_is_not_written(tmp_path):
    with opened(tmp_path) as run:
        run.interrupted("SIGTERM")  # from another thread
        run.update(trial=7)
    found = status(tmp_path)
    assert (found["state"], found["trial"]) == ("interrupted", None)


@pytest.mark.parametrize(
    ("phase", "flag"), [("explore", "--name"), ("zero-shot", "--tag")]
)
def test_a_folder_belongs_to_one_config(tmp_path, phase, flag):
    with opened(tmp_path, CONFIG | {"seeds": [1]}):
        pass
    config = CONFIG | {"phase": phase}
    with pytest.raises(CheckpointError) as error, opened(tmp_path, config):
        raise AssertionError("it is another's")
    assert str(error.value) == (
        f"{tmp_path} was started with other numbers: seeds: [1]. Use the same flags, "
        f"or another {flag}."
    )
    assert RunFolder(tmp_path).config()["seeds"] == [1]


def test_a_run_is_given_more_trials_and_never_fewer(tmp_path):
    for count, kept in ((3, 3), (5, 5), (4, 5)):
        with opened(tmp_path, CONFIG | {"num_trials": count}) as run:
            assert run.config() == CONFIG | {"num_trials": kept}


def test_a_template_may_be_made_of_what_was_saved(tmp_path):
    run = RunFolder(tmp_path)
    run.save(1, {"rows": jnp.ones((5, 2))})
    trial, found = run.restore(
        lambda leaves: {"rows": jnp.zeros(leaves["rows"]["shape"])}
    )
    assert trial == 1 and found["rows"].tolist() == [[1.0, 1.0]] * 5


def test_another_environment_is_said(tmp_path, capsys):
    with opened(tmp_path):
        pass
    path = tmp_path / rundir.ENVIRONMENT
    rundir.write_json(path, rundir.read_json(path) | {"numpy": "0.1"})
    with opened(tmp_path):
        pass
    err = capsys.readouterr().err
    assert err.startswith("warning: numpy was 0.1 and is now ")
    assert err.count("\n") == 1


# A checkpoint knows its run.


def recorded(path, config=CONFIG):
    """Returns the folder of a run with two checkpoints."""
    with opened(path, config) as run:
        record(run, 1)
        record(run, 2)
    return path


def moved(source, target, step):
    """Puts a step of one run into another."""
    there = target / rundir.CHECKPOINTS / str(step)
    shutil.rmtree(there, ignore_errors=True)
    shutil.copytree(source / rundir.CHECKPOINTS / str(step), there)


def resumed(path, config=CONFIG):
    with opened(path, config) as run:
        found = run.resume(state(0))
        return found and found[0]


def test_a_checkpoint_of_another_run_is_not_used(tmp_path, capsys):
    own, other = recorded(tmp_path / "a"), recorded(tmp_path / "b")
    log = (own / rundir.METRICS).read_bytes()
    moved(other, own, 2)
    assert resumed(own) == 1
    a, b = (identity.read_id(run) for run in (own, other))
    assert capsys.readouterr().err == (
        f"warning: checkpoint 2 is foreign (of run {b!r}; run.json says {a!r}); "
        "moved to .foreign-2, using 1.\n"
    )
    assert (own / rundir.METRICS).read_bytes() == log.splitlines(keepends=True)[0]
    moved(other, own, 1)
    with pytest.raises(CheckpointError, match=r"no checkpoint in .*\(1 is foreign: of"):
        resumed(own)
    # Whoever only reads is told too.
    with pytest.raises(CheckpointError, match=r"checkpoint 1 in .* is foreign"):
        RunFolder(own).restore_trial(1, state(0))


def test_a_checkpoint_of_other_numbers_is_not_used(tmp_path, capsys):
    """As when a config is lost, and the flags are others then."""
    config = CONFIG | {"num_trials": 2}
    path = recorded(tmp_path / "a", config)
    assert resumed(path, config | {"num_trials": 3}) == 2  # it may have more
    (path / rundir.CONFIG).unlink()
    with pytest.raises(CheckpointError, match=r"2 is foreign: of other numbers: seeds"):
        resumed(path, config | {"seeds": [1]})
    (path / rundir.CONFIG).unlink()
    assert resumed(path, config) == 2 and capsys.readouterr().err == ""


def test_a_run_of_an_older_version_goes_on(tmp_path, capsys):
    """Neither its folder nor its checkpoints have an id."""
    path = recorded(tmp_path / "a")
    (path / rundir.IDENTITY).unlink()
    (path / rundir.CONFIG).unlink()
    with opened(path) as run:
        assert not (path / rundir.IDENTITY).exists()
        record(run, 3)
    assert resumed(path) == 3
    rundir.write_json(path / rundir.IDENTITY, {"id": "mine"})
    assert resumed(path) == 3 and capsys.readouterr().err == ""
    (path / rundir.IDENTITY).write_text("[]")
    with pytest.raises(CheckpointError, match=r"run\.json holds no id of a run\. Rest"):
        resumed(path)


def test_a_folder_of_an_older_version_does_not_say_of_which_model_it_is(tmp_path):
    path = recorded(tmp_path / "a")
    with pytest.raises(CheckpointError, match="with another model than that of"):
        identity.settle(path, CONFIG, differences, "digest")
    rundir.write_json(path / rundir.IDENTITY, {"id": identity.read_id(path)})
    identity.settle(path, CONFIG, differences, "digest")


# Nothing is written elsewhere.


@pytest.mark.parametrize(
    "name", ["a", rundir.CHECKPOINTS, rundir.METRICS, rundir.ORPHANS]
)
@pytest.mark.parametrize("kind", ["link", "other"])
def test_a_folder_that_leads_elsewhere_is_refused(tmp_path, name, kind):
    outside, path = tmp_path / "outside", tmp_path / "a"
    outside.mkdir()
    (outside / "precious").write_text("data")
    place = path if name == "a" else path / name
    place.parent.mkdir(exist_ok=True)
    folder_ = name in ("a", rundir.CHECKPOINTS)
    if kind == "link":
        place.symlink_to(outside if folder_ else outside / "precious")
    elif folder_:
        place.write_text("a file")
    else:
        place.hardlink_to(outside / "precious")
    before = place.lstat()
    words = f"{place} is a link, or no {'folder' if folder_ else 'file'}; a run writes"
    with pytest.raises(StorageError, match=words), opened(path):
        raise AssertionError("it leads elsewhere")
    assert place.lstat() == before
    assert [x.name for x in outside.iterdir()] == ["precious"]
    assert (outside / "precious").read_text() == "data"


@pytest.mark.parametrize(
    "name", [rundir.STATUS, rundir.ENVIRONMENT, rundir.TRAJECTORIES]
)
def test_a_link_in_a_files_place_is_replaced(tmp_path, name):
    path, precious = tmp_path / "a", tmp_path / "precious"
    path.mkdir()
    precious.write_text("{}")
    (path / name).symlink_to(precious)
    with opened(path) as run:
        if not run.has_trajectories():
            run.save_trajectories({"obs": np.arange(3)})
    assert precious.read_text() == "{}"
    assert not (path / name).is_symlink()
