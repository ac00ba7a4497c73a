"""The run directory: names, lock, JSON files and metrics log."""

import json
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.errors import CheckpointError, StorageError, UsageError
from experiments.storage import metrics, rundir

ROOT = Path(__file__).parents[2]


def start_python(script: str, *args: str, **env: str) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(script), *args],
        env={**os.environ, "PYTHONPATH": str(ROOT), **env},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


# Names.


@pytest.mark.parametrize("name", ["a", "0", "laptop-count", "A.b_c-9", "x" * 64])
def test_good_names(name):
    rundir.check_name(name)


@pytest.mark.parametrize(
    "name",
    [
        *("", ".", "..", "...", "../x", "/etc/x", "a/b", "a\\b", "a\0b", "a\n", "\n"),
        *(
            "-a",
            "_a",
            ".a",
            "a ",
            " a",
            "~",
            "x" * 65,
            "x" * 300,
            "a:b",
            "\u0430",  # Cyrillic a
            "é",
            "a*",
        ),
    ],
)
def test_bad_names(name):
    with pytest.raises(UsageError, match="is not a valid name") as error:
        rundir.check_name(name)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 250


# The lock.

HOLDER = """
    import sys
    from pathlib import Path
    from experiments.storage import rundir
    with rundir.lock(Path(sys.argv[1])):
        print("held", flush=True)
        sys.stdin.readline()
"""


def test_two_processes_and_one_directory(tmp_path):
    run_dir = tmp_path / "runs" / "a"
    child = start_python(HOLDER, str(run_dir))
    assert child.stdout is not None
    assert child.stdout.readline() == "held\n"
    with (
        pytest.raises(
            CheckpointError, match=f"in use by pid {child.pid} on host .* since"
        ),
        rundir.lock(run_dir),
    ):
        raise AssertionError("both hold it")
    child.send_signal(signal.SIGKILL)
    child.communicate()
    with rundir.lock(run_dir):
        owner = json.loads((run_dir / ".lock").read_text())
        assert owner["pid"] == os.getpid()
        assert set(owner) == {"pid", "host", "start"}
    with rundir.lock(run_dir):  # It can be taken again.
        pass


def test_a_lock_with_unreadable_owner(tmp_path):
    with rundir.lock(tmp_path):
        (tmp_path / ".lock").write_bytes(b"\xff")
        with (
            pytest.raises(CheckpointError, match="in use by another process"),
            rundir.lock(tmp_path),
        ):
            raise AssertionError("both hold it")


def test_a_lock_is_never_followed_elsewhere(tmp_path):
    (tmp_path / "precious").write_text("data")
    (tmp_path / ".lock").symlink_to("precious")
    words = r"\.lock is a link, or no file; a run writes to its own only"
    with pytest.raises(StorageError, match=words), rundir.lock(tmp_path):
        raise AssertionError("took a link for a lock")
    (tmp_path / ".lock").unlink()
    (tmp_path / ".lock").hardlink_to(tmp_path / "precious")
    with pytest.raises(StorageError, match=words), rundir.lock(tmp_path):
        raise AssertionError("took a link for a lock")
    assert (tmp_path / "precious").read_text() == "data"


def test_a_lock_on_a_failing_disk(tmp_path, monkeypatch):
    def fail(_file, _size):
        raise OSError(5, os.strerror(5))

    monkeypatch.setattr(os, "ftruncate", fail)
    words = "cannot lock .* \\(Input/output error\\)"
    with pytest.raises(StorageError, match=words), rundir.lock(tmp_path):
        raise AssertionError("it is not locked")


# The disk.


def test_probe(tmp_path):
    rundir.probe(tmp_path / "runs" / "a", 1000)
    assert list((tmp_path / "runs" / "a").iterdir()) == []
    with pytest.raises(StorageError, match=r"no space in .*needs 1e\+06 GB, .* free"):
        rundir.probe(tmp_path, 10**15)
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match=r"cannot write in .*file"):
        rundir.probe(tmp_path / "file", 0)


def test_probe_of_a_folder_that_refuses_files():
    with pytest.raises(StorageError, match="cannot write in /proc"):
        rundir.probe(Path("/proc"), 0)


# JSON files.


def test_json_round_trip(tmp_path):
    path = tmp_path / "status.json"
    data = {"loss": float("nan"), "n": np.float32(0.5), "x": jnp.arange(2), "é": (1,)}
    rundir.write_json(path, data)
    expected = {"loss": None, "n": 0.5, "x": [0, 1], "é": [1]}
    assert rundir.read_json(path) == expected
    assert [item.name for item in tmp_path.iterdir()] == ["status.json"]


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "status.json"
    rundir.write_json(path, {"trial": 1})

    def full(_file):
        raise OSError(28, os.strerror(28))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(StorageError, match=r"cannot write .*No space left"):
            rundir.write_json(path, {"trial": 2})
    assert rundir.read_json(path) == {"trial": 1}
    assert [item.name for item in tmp_path.iterdir()] == ["status.json"]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "Expecting value, line 1, column 1"),
        (b'{"a": 1,\n "b" 2}', "line 2, column 6"),
        (b'{"a": NaN}', "NaN is not JSON"),
        (b'{"a": 1, "b": {"c": 1, "d": 2, "c": 3}}', "'c' is there twice"),
        (b'{"\\u001b[2J": 1, "\\u001b[2J": 3}', r"'\\x1b\[2J' is there twice"),
        (b"\xff\xfe\x00", "utf-8"),
        (b"[" * 100_000, "recursion"),
        (b'"' + b"x" * 2_000_000 + b'"', "larger than 1 MB"),
    ],
)
def test_json_that_cannot_be_read(tmp_path, data, message):
    path = tmp_path / "config.json"
    path.write_bytes(data)
    with pytest.raises(CheckpointError, match=message) as error:
        rundir.read_json(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_json_that_is_not_there(tmp_path):
    with pytest.raises(CheckpointError, match="does not exist or is not a file"):
        rundir.read_json(tmp_path / "config.json")
    os.mkfifo(tmp_path / "pipe.json")
    with pytest.raises(CheckpointError, match="does not exist or is not a file"):
        rundir.read_json(tmp_path / "pipe.json")


# The metrics log.


def rows_of(path: Path) -> list:
    def refuse(name):
        raise AssertionError(f"{name} is not JSON")

    lines = path.read_text().splitlines()
    rows = [json.loads(line, parse_constant=refuse) for line in lines]
    assert all(row.pop("check") for row in rows)
    return rows


def test_rows_are_valid_json(tmp_path):
    path = tmp_path / "metrics.jsonl"
    row = {
        "trial": np.int64(3),
        "loss": jnp.float32(jnp.nan),
        "bound": -np.inf,
        "returns": {"forward": [np.float32(0.5), float("inf")]},
        "grid": np.array([[1.0, np.nan]]),
        "done": np.bool_(True),
        "note": None,
    }
    metrics.append_rows(path, [row, {"trial": 4}])
    assert rows_of(path) == [
        {
            "trial": 3,
            "loss": None,
            "bound": None,
            "returns": {"forward": [0.5, None]},
            "grid": [[1.0, None]],
            "done": True,
            "note": None,
        },
        {"trial": 4},
    ]
    metrics.append_rows(path, [])
    assert len(rows_of(path)) == 2


def test_a_torn_log_has_each_trial_once_after_a_resume(tmp_path):
    path = tmp_path / "metrics.jsonl"
    metrics.cut_log(path, 0)
    assert not path.exists() and not metrics.rows_by_trial(path)
    metrics.append_rows(path, [{"trial": 1}, {"trial": 2}])
    metrics.append_rows(path, [{"trial": 3}, {"trial": 4}])
    with path.open("a") as file:
        file.write('{"trial": 5, "ret')
    metrics.cut_log(path, 2)
    metrics.cut_log(path, 2)
    metrics.append_rows(path, [{"trial": 3}])
    assert rows_of(path) == [{"trial": 1}, {"trial": 2}, {"trial": 3}]
    metrics.cut_log(path, 2)
    orphans = (tmp_path / "metrics.jsonl.orphan").read_text().splitlines()
    starts = ['{"trial": 3, ', '{"trial": 4, ', '{"trial": 5, "ret', '{"trial": 3, ']
    for line, start in zip(orphans, starts, strict=True):
        assert line.startswith(start)


def test_lines_that_are_no_rows_are_not_counted(tmp_path):
    path = tmp_path / "metrics.jsonl"
    lines = [b"[1]", b"{}", b'{"trial": true}', b'{"trial": "1"}', b"\xff", b"", b"7"]
    path.write_bytes(b"\n".join([*lines, b'{"trial": 1}', b'{"trial": 1}', b""]))
    assert metrics.rows_by_trial(path) == {1: 2}


def test_a_full_disk_leaves_no_half_row(tmp_path, monkeypatch):
    path = tmp_path / "metrics.jsonl"
    metrics.append_rows(path, [{"trial": 1}])
    real, calls = os.write, []

    def half(file: int, data: bytes) -> int:
        calls.append(file)
        if len(calls) > 1:
            raise OSError(28, os.strerror(28))
        return real(file, data[: len(data) // 2])

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", half)
        with pytest.raises(StorageError, match="No space left"):
            metrics.append_rows(path, [{"trial": 2}])
    assert len(calls) == 2
    metrics.append_rows(path, [{"trial": 3}])
    assert rows_of(path) == [{"trial": 1}, {"trial": 3}]
