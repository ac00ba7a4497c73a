"""A compiled library is kept whole and to ourselves, and what is not is not loaded."""

import errno
import os
import re
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np
import pytest
from rollouts import CPU, SMALL, needs_cpu

from jaxpets._src.kernel.cache import library

NAME = "jaxpets_rollout"
SUITE = Path(os.environ["XDG_CACHE_HOME"], "jaxpets")  # of all other tests
BYTES = b"a library"


class Maker:
    """Makes a library of these bytes; `calls` are the folders where it was done."""

    def __init__(self, data=BYTES):
        self.data, self.calls = data, []

    def __call__(self, folder):
        assert folder.stat().st_mode & 0o777 == 0o700
        self.calls.append(folder)
        file = folder / "built"
        file.write_bytes(self.data)
        file.chmod(0o777)
        return file


@pytest.fixture
def make():
    return Maker()


def loaded(make):
    """The file that is given to be loaded, when its bytes are the maker's."""
    with library(NAME, make) as path:
        assert path.read_bytes() == make.data
        return path


def assert_is_kept(cache, path):
    assert path.parent == cache and list(cache.iterdir()) == [path]


# The folder.


@pytest.mark.parametrize("umask", [0o000, 0o022, 0o077])
def test_nobody_else_can_write(cache, make, umask):
    before = os.umask(umask)
    try:
        path = loaded(make)
    finally:
        os.umask(before)
    for made in (path, cache, cache.parent):
        assert made.stat().st_mode & 0o777 == 0o700
    assert loaded(make) == path and len(make.calls) == 1


@pytest.mark.parametrize("value", [None, ""])
def test_without_xdg_it_is_in_the_home_folder(monkeypatch, tmp_path, make, value):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_CACHE_HOME")
    if value is not None:
        monkeypatch.setenv("XDG_CACHE_HOME", value)
    assert_is_kept(tmp_path / ".cache" / "jaxpets", loaded(make))


def assert_is_not_kept(make, words):
    """The library is made for one use, and one line says why."""
    match = f"^cannot keep a compiled kernel: {words}"
    with pytest.warns(UserWarning, match=match) as caught:
        path = loaded(make)
    (line,) = [str(warning.message) for warning in caught]
    assert "set XDG_CACHE_HOME" in line and "\n" not in line
    assert not path.parent.exists() and path.parent == make.calls[-1].parent


@pytest.fixture
def planted(cache):
    """The cache folder with a library that somebody else has put there."""
    cache.parent.mkdir()
    evil = Maker(b"evil")
    path = loaded(evil)
    assert path.parent == cache
    return cache


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o702, 0o1777])
def test_a_folder_that_others_write_to_is_not_used(planted, make, mode):
    planted.chmod(mode)
    assert_is_not_kept(make, f"others may write to {planted}")


def test_a_folder_of_somebody_else_is_not_used(monkeypatch, planted, make):
    user = os.geteuid()
    answers = iter([user + 1])
    monkeypatch.setattr(os, "geteuid", lambda: next(answers, user))
    assert_is_not_kept(make, rf"{planted} belongs to another user \({user}\)")


def test_a_link_to_a_folder_is_not_followed(planted, make):
    planted.rename(planted.with_name("elsewhere"))
    planted.symlink_to(planted.with_name("elsewhere"))
    assert_is_not_kept(make, f"{planted} is a link and not a folder")


def test_a_folder_that_others_may_replace_is_not_used(planted, make):
    planted.parent.chmod(0o777)
    assert_is_not_kept(make, f"anybody may write to {planted.parent}")
    planted.parent.chmod(0o1777)  # they may not: it is sticky, as /tmp is
    assert loaded(Maker(b"evil")).parent == planted


def test_links_above_the_folder_may_be_the_users_own(monkeypatch, tmp_path, make):
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "there")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "link"))
    assert_is_kept(tmp_path / "there" / "jaxpets", loaded(make))


def test_a_file_in_the_place_of_the_folder(cache, make):
    cache.parent.mkdir()
    cache.write_text("")
    assert_is_not_kept(make, f".*File exists: '{cache}'")


def test_without_a_home_folder(monkeypatch, make):
    def nobody():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", nobody)
    assert_is_not_kept(make, "there is no home folder")


def test_a_full_disk(monkeypatch, cache, make):
    """Where the temporary folder is on another one."""
    sync, failures = os.fsync, [OSError(errno.ENOSPC, "No space left on device")]

    def full(file):
        if failures:
            raise failures.pop()
        sync(file)

    monkeypatch.setattr(os, "fsync", full)
    assert_is_not_kept(make, ".*No space left on device")
    assert not any(cache.iterdir())


# The file.


def change(path, how):
    """Does to a library what a disk or a stranger may do."""
    if how == "emptied":
        path.write_bytes(b"")
    if how == "cut":
        path.write_bytes(BYTES[:4])
    if how == "changed":
        path.write_bytes(BYTES[:-1] + b"?")
    if how == "open to others":
        path.chmod(0o702)
    if how == "a link":
        path.rename(path.parents[1] / "elsewhere")
        path.symlink_to(path.parents[1] / "elsewhere")


CHANGES = ["emptied", "cut", "changed", "open to others", "a link"]


@pytest.mark.parametrize("how", CHANGES)
@pytest.mark.parametrize("again", [BYTES, b"what another compiler makes"])
def test_a_file_that_is_not_as_it_was_is_built_again(cache, make, how, again):
    change(loaded(make), how)
    anew = Maker(again)
    with pytest.warns(UserWarning, match="^/.*so is damaged; it is built again.$") as w:
        path = loaded(anew)
    assert len(w) == 1 and len(anew.calls) == 1 and not path.is_symlink()
    assert_is_kept(cache, path)
    assert loaded(anew) == path and len(anew.calls) == 1


@pytest.mark.filterwarnings("error")
def test_a_damaged_file_beside_a_good_one_does_no_harm(cache, make):
    path = loaded(make)
    for digit in "0f":
        (cache / f"{NAME}-{digit * 64}.so").touch()
    assert loaded(make) == path and len(make.calls) == 1


def test_it_is_on_the_disk_before_it_has_its_name(monkeypatch, cache, make):
    """After a power cut there is the whole file, or none."""
    done, sync, replace = [], os.fsync, os.replace

    def synced(file):
        done.append(Path(os.readlink(f"/proc/self/fd/{file}")).name)
        sync(file)

    def replaced(old, new):
        done.append("replace")
        replace(old, new)

    if not Path("/proc/self/fd").exists():
        pytest.skip("only Linux names the file of a descriptor")
    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", replaced)
    loaded(make)
    assert done == ["built", "replace", "jaxpets"]


def test_what_killed_builds_have_left_is_swept(cache, make):
    path = loaded(make)
    for name, age in (("tmpold", 25), ("tmpnew", 23), ("kept", 25)):
        (cache / name).mkdir()
        (cache / name / "model.h").touch()
        then = (cache / name).stat().st_mtime - age * 3600
        os.utime(cache / name, (then, then))
    assert loaded(make) == path
    assert {x.name for x in cache.iterdir()} == {path.name, "tmpnew", "kept"}


@pytest.mark.parametrize("damaged", [False, True])
@pytest.mark.filterwarnings("ignore:.*is damaged")
def test_many_may_build_at_once(cache, damaged):
    """Each in a folder of its own; whoever is last replaces a whole by a whole."""
    if damaged:
        loaded(Maker()).write_bytes(b"")
    barrier, makers = threading.Barrier(8), [Maker() for _ in range(8)]

    def start(make):
        barrier.wait()
        return loaded(make)

    with ThreadPoolExecutor(8) as pool:
        paths = set(pool.map(start, makers))
    folders = [folder for make in makers for folder in make.calls]
    assert len(set(folders)) == len(folders) > 0
    assert_is_kept(cache, *paths)


# A process that imagines what SMALL does, and keeps the path it gets.
CHILD = """
import sys
import numpy as np
from rollouts import CPU, SMALL
np.save(sys.argv[1], CPU.run(SMALL)(*SMALL.args()))
"""


@needs_cpu
def test_a_kernel_that_was_cut_short_is_built_again(tmp_path):
    """To load it would end a process without a word."""
    want = CPU.run(SMALL)(*SMALL.args())
    jaxpr = str(jax.make_jaxpr(CPU.fused(SMALL))(*SMALL.args()))
    (target,) = re.findall("jaxpets_rollout_cpu_[0-9a-f]+", jaxpr)
    (good,) = SUITE.glob(f"{target}-*.so")
    (tmp_path / "jaxpets").mkdir()
    (tmp_path / "jaxpets" / good.name).write_bytes(good.read_bytes()[:20_000])
    got = tmp_path / "got.npy"
    path = os.pathsep.join(sys.path)
    done = subprocess.run(
        [sys.executable, "-c", CHILD, got],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        env=os.environ | {"PYTHONPATH": path, "XDG_CACHE_HOME": str(tmp_path)},
    )
    assert done.returncode == 0, done.stderr
    assert f"{good.name} is damaged; it is built again." in done.stderr
    np.testing.assert_array_equal(np.load(got), want)
