"""Checkpoints when files rot, disks fail and processes are killed."""

import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from states import as_bytes, make_state, restore, save_two

from experiments.errors import CheckpointError, InterruptedRun, StorageError
from experiments.storage import checkpoint, disk
from experiments.storage.step_folders import SEAL, seal

ROOT = Path(__file__).parents[2]


@pytest.fixture
def directory(tmp_path) -> Path:
    return save_two(tmp_path / "checkpoints")


def assert_falls_back(directory: Path, because: str = "") -> None:
    found, warnings = restore(directory)
    assert found is not None
    assert found[0] == 1
    assert as_bytes(found[1]) == as_bytes(make_state(1))
    assert found[2] == {"log": 1}
    assert len(warnings) == 1
    assert warnings[0].startswith("checkpoint 2 is damaged (")
    assert because in warnings[0]
    assert "\n" not in warnings[0]
    assert checkpoint.steps(directory) == [1]
    assert (directory / ".damaged-2").exists()


# Damage.


def files_of(step: Path) -> list[Path]:
    return sorted(path for path in step.rglob("*") if path.is_file())


@pytest.mark.parametrize("damage", ["empty", "half", "gone", "flip"])
def test_each_file_in_turn(directory, tmp_path, capfd, damage):
    names = [path.relative_to(directory) for path in files_of(directory / "2")]
    assert len(names) >= 8
    for i, name in enumerate(names):
        copy = tmp_path / str(i) / "checkpoints"
        shutil.copytree(directory, copy)
        path = copy / name
        data = bytearray(path.read_bytes())
        if damage == "gone":
            path.unlink()
        elif damage == "flip":
            data[len(data) // 2] ^= 16
            path.write_bytes(data)
        else:
            path.write_bytes(data[: len(data) // 2] if damage == "half" else b"")
        assert_falls_back(copy)
    assert capfd.readouterr() == ("", "")


def test_bit_flips_in_the_array_data(directory, tmp_path):
    random_ = random.Random(0)
    step = directory / "2"
    largest = max(files_of(step), key=lambda path: path.stat().st_size)
    name = largest.relative_to(step)
    for i in range(20):
        copy = tmp_path / str(i) / "checkpoints"
        shutil.copytree(directory, copy)
        path = copy / "2" / name
        data = bytearray(path.read_bytes())
        data[random_.randrange(len(data))] ^= 1 << random_.randrange(8)
        path.write_bytes(data)
        assert_falls_back(copy, f"checksum of {name}")


def test_arrays_that_are_not_those_saved(directory, monkeypatch):
    """Files can be sound and the arrays wrong: another version of orbax, say."""
    real = checkpoint.ocp.args.StandardSave

    def other(arrays):
        return real({**arrays, "params/w1": arrays["params/w1"] + 1})

    monkeypatch.setattr(checkpoint.ocp.args, "StandardSave", other)
    words = r"checkpoint 3 in .* did not read back \(params/w1 is not what was saved\)"
    with pytest.raises(StorageError, match=words):
        checkpoint.save(directory, 3, make_state(3), {})
    assert sorted(os.listdir(directory)) == ["1", "2"]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_orbax_cannot_read_it(directory):
    (directory / "2" / "state" / "manifest.ocdbt").unlink()
    seal(directory / "2")
    assert_falls_back(directory, "unreadable: ")


def test_husks_of_every_kind(directory, tmp_path):
    def empty(step: Path) -> None:
        shutil.rmtree(step)
        step.mkdir()

    def empty_seal(step: Path) -> None:
        (step / SEAL).write_text("")

    def half(step: Path) -> None:
        for path in files_of(step)[::2]:
            path.unlink()

    def file(step: Path) -> None:
        shutil.rmtree(step)
        step.write_text("not a folder")

    def link(step: Path) -> None:
        step.rename(step.with_name("elsewhere"))
        step.symlink_to("elsewhere")

    def link_inside(step: Path) -> None:
        data = step / "state" / "manifest.ocdbt"
        data.rename(tmp_path / "manifest.ocdbt")
        data.symlink_to(tmp_path / "manifest.ocdbt")

    def linked_folder(step: Path) -> None:
        (step / "state").rename(tmp_path / "state")
        (step / "state").symlink_to(tmp_path / "state")

    def pipe(step: Path) -> None:
        (step / "meta" / "metadata").unlink()
        os.mkfifo(step / "meta" / "metadata")

    def stranger(step: Path) -> None:
        (step / "state" / "more").write_text("")

    def renamed(step: Path) -> None:
        shutil.rmtree(step)
        shutil.copytree(step.with_name("1"), step)

    links = [link, link_inside, linked_folder]
    why = {empty_seal: "SHA256SUMS is empty", stranger: "state/more does not belong"}
    for kind in [empty, empty_seal, half, file, pipe, stranger, renamed, *links]:
        copy = tmp_path / kind.__name__ / "checkpoints"
        shutil.copytree(directory, copy)
        kind(copy / "2")
        assert_falls_back(copy, why.get(kind, ""))


def test_what_did_not_finish_is_swept_and_no_link_followed(directory, tmp_path):
    """Orbax moves old steps to `.deleted`."""
    outside = tmp_path / "outside"
    outside.mkdir()
    (directory / ".deleted").symlink_to(outside)
    (directory / "3.orbax-checkpoint-tmp").symlink_to(outside)
    checkpoint.save(directory, 3, make_state(3), {})
    assert sorted(os.listdir(directory)) == ["2", "3"]
    assert list(outside.iterdir()) == []


def test_a_step_of_another_run_is_not_used(directory):
    def foreign(meta: dict) -> str | None:
        return "of run 'b', not 'a'" if meta["log"] == 2 else None

    found, warnings = restore(directory, foreign=foreign)
    assert found is not None and found[0] == 1
    assert warnings == [
        "checkpoint 2 is foreign (of run 'b', not 'a'); moved to .foreign-2, using 1."
    ]
    words = r"no checkpoint in .* can be used \(1 is foreign: mine\)"
    with pytest.raises(CheckpointError, match=words):
        restore(directory, foreign=lambda meta: "mine")
    with pytest.raises(CheckpointError, match=r"1 in .* is foreign \(mine\)\. Choose"):
        restore(directory, step=1, foreign=lambda meta: "mine")


def test_every_step_damaged_moves_nothing(directory):
    for step in ("1", "2"):
        (directory / step / "meta" / "metadata").write_text("{}")
    with pytest.raises(CheckpointError) as error:
        restore(directory)
    words = "2 is damaged: checksum of meta/metadata; 1 is damaged: checksum of"
    assert f"no checkpoint in {directory} can be used ({words}" in str(error.value)
    assert sorted(os.listdir(directory)) == ["1", "2"]


# Failing disks.


@pytest.mark.parametrize(
    ("number", "words"), [(28, "no space for"), (5, "Input/output error writing")]
)
def test_a_failing_disk_keeps_the_last_step(directory, monkeypatch, number, words):
    real, calls = os.fsync, []

    def failing(file: int) -> None:
        calls.append(file)
        if len(calls) == 3:
            raise OSError(number, os.strerror(number))
        real(file)

    with monkeypatch.context() as patch, pytest.raises(StorageError) as error:
        patch.setattr(os, "fsync", failing)
        checkpoint.save(directory, 3, make_state(3), {"log": 3})
    assert str(error.value).startswith(f"{words} checkpoint 3 in {directory} (needs ")
    assert "Checkpoint 2 is intact" in str(error.value)
    assert sorted(os.listdir(directory)) == ["1", "2"]
    assert as_bytes(restore(directory)[0][1]) == as_bytes(make_state(2))
    checkpoint.save(directory, 3, make_state(3), {"log": 3})
    assert checkpoint.steps(directory) == [2, 3]


def test_writes_that_the_system_refuses(directory):
    """TensorStore's own writes fail here: no file may grow beyond 4 kB."""
    script = f"""
        import resource, signal, sys
        from pathlib import Path
        import jax, jax.numpy as jnp
        from experiments.storage import checkpoint
        from experiments.errors import StorageError
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        state = {{"w": jax.random.normal(jax.random.key(0), (100, 100))}}
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, {resource.RLIM_INFINITY}))
        try:
            checkpoint.save(Path({str(directory)!r}), 3, state, {{}})
        except StorageError as error:
            sys.exit(f"StorageError {{error}}")
    """
    done = run_python(script)
    assert done.returncode == 1
    assert "StorageError no space for checkpoint 3" in done.stderr
    assert sorted(os.listdir(directory)) == ["1", "2"]


def test_a_full_disk(tmp_path):
    mount = ["mount", "-t", "tmpfs", "-o", "size=1200k", "tmpfs", str(tmp_path)]
    if (
        os.geteuid()
        or subprocess.run(mount, capture_output=True, check=False).returncode
    ):
        pytest.skip("needs root to mount a small disk")
    try:
        state = {"w": jax.random.normal(jax.random.key(0), (200, 200))}
        directory = tmp_path / "checkpoints"
        with pytest.raises(StorageError, match=r"no space for checkpoint") as error:
            for step in range(1, 9):
                checkpoint.save(directory, step, state, {}, keep=9)
        last = checkpoint.steps(directory)[-1]
        assert f"Checkpoint {last} is intact" in str(error.value)
        shutil.rmtree(directory / "1")
        checkpoint.save(directory, last + 1, state, {}, keep=9)
        assert restore(directory, state)[0][0] == last + 1
    finally:
        subprocess.run(["umount", str(tmp_path)], check=True)


def test_a_save_that_does_not_read_back(directory, monkeypatch):
    def seal_then_rot(folder: Path) -> None:
        seal(folder)
        path = folder / "meta" / "metadata"
        path.write_bytes(path.read_bytes()[:-1])

    monkeypatch.setattr(checkpoint, "seal", seal_then_rot)
    with pytest.raises(StorageError, match=r"did not read back .*Checkpoint 2 is"):
        checkpoint.save(directory, 3, make_state(3), {})
    assert sorted(os.listdir(directory)) == ["1", "2"]


def test_the_number_behind_an_error():
    text = "RESOURCE_EXHAUSTED: write [os_error_code='28']"
    try:
        try:
            raise ValueError(text)
        except ValueError as inner:
            raise KeyError("outer") from inner
    except KeyError as error:
        assert disk.disk_error(error) == 28
    assert disk.disk_error(RuntimeError("RESOURCE_EXHAUSTED: out of memory")) is None


# Kills.


def run_python(script: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-c", textwrap.dedent(script)]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        command, env=env, capture_output=True, text=True, timeout=60, check=False
    )


KILLED = """
    import sys
    from pathlib import Path
    import jax, jax.numpy as jnp
    from experiments.storage import checkpoint
    directory, step = Path(sys.argv[1]), int(sys.argv[2])
    while True:
        step += 1
        state = {"w": jnp.full((300, 1000), step, jnp.float32)}
        checkpoint.save(directory, step, state, {"log": step})
        print(step, flush=True)
"""


def test_kill_during_a_save(tmp_path):
    random_ = random.Random(1)
    template = {"w": jnp.zeros((300, 1000))}
    command = [sys.executable, "-c", textwrap.dedent(KILLED), str(tmp_path)]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    step = 0
    for _ in range(3):
        child = subprocess.Popen(
            [*command, str(step)], env=env, stdout=subprocess.PIPE, text=True
        )
        assert child.stdout is not None
        done = int(child.stdout.readline())
        with pytest.raises(subprocess.TimeoutExpired):
            child.wait(random_.uniform(0, 0.15))
        child.send_signal(signal.SIGKILL)
        rest, _ = child.communicate()
        done = max([done, *map(int, rest.split())])
        (step, state, meta), warnings = restore(tmp_path, template)
        assert warnings == []
        assert step in (done, done + 1)  # Whole before its line was printed.
        assert meta == {"log": step}
        assert (np.asarray(state["w"]) == step).all()


@pytest.mark.parametrize("in_c", [False, True])
def test_a_signal_while_reading_damages_nothing(directory, monkeypatch, in_c):
    def stopped(folder):
        error = InterruptedRun("SIGTERM")
        if in_c:  # which raises an error of its own
            raise SystemError from error
        raise error

    monkeypatch.setattr(checkpoint, "broken", stopped)
    with pytest.raises(InterruptedRun):
        restore(directory)
    assert sorted(os.listdir(directory)) == ["1", "2"]
