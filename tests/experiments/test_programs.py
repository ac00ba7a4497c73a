"""Compiled programs that are kept: `experiments.programs`."""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from jax.experimental.compilation_cache import compilation_cache

from experiments import programs


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where programs are to be kept, in a process that keeps none yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    names = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"
    before = {name: getattr(jax.config, name) for name in names}
    jax.config.update("jax_compilation_cache_dir", None)
    compilation_cache.reset_cache()
    yield tmp_path / "jaxpets" / "programs"
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


def compiled(number):
    """Compiles a program of this number."""
    return jax.jit(lambda x: x + number)(jnp.zeros(3)).block_until_ready()


def test_programs_are_kept_once_something_was_compiled(folder):
    compiled(1)
    programs.keep()
    assert jax.config.jax_compilation_cache_dir == str(folder)
    assert folder.stat().st_mode & 0o777 == 0o700
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    compiled(2)
    assert any(folder.iterdir())


def test_nothing_is_kept_where_others_write(folder):
    folder.mkdir(parents=True)
    folder.chmod(0o777)
    programs.keep()
    assert jax.config.jax_compilation_cache_dir is None
    folder.chmod(0o700)
    programs.keep()
    assert jax.config.jax_compilation_cache_dir == str(folder)


def test_nothing_is_kept_where_others_could_put_a_folder_in_its_place(folder):
    folder.mkdir(parents=True)
    folder.parent.chmod(0o777)
    programs.keep()
    assert jax.config.jax_compilation_cache_dir is None
    folder.parent.chmod(0o700)
    folder.rename(folder.parent / "elsewhere")
    folder.symlink_to(folder.parent / "elsewhere")
    programs.keep()
    assert jax.config.jax_compilation_cache_dir is None


def test_folders_are_private_whatever_the_umask_is(folder):
    """Kernels are kept in the one above, if nobody else may write there."""
    before = os.umask(0o002)
    try:
        programs.keep()
    finally:
        os.umask(before)
    assert {x.stat().st_mode & 0o777 for x in (folder, folder.parent)} == {0o700}
    assert jax.config.jax_compilation_cache_dir == str(folder)


def test_without_a_home_nothing_is_kept(folder, monkeypatch):
    def homeless():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", homeless)
    programs.keep()
    assert jax.config.jax_compilation_cache_dir is None


def test_a_home_that_cannot_be_written_is_no_error(folder):
    folder.parent.write_text("a file")
    programs.keep()
    assert jax.config.jax_compilation_cache_dir is None


def test_who_says_where_is_heard(folder, tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "mine"))
    programs.keep()
    assert jax.config.jax_compilation_cache_dir == str(tmp_path / "mine")
    assert not folder.exists()


@pytest.mark.parametrize("backend", ["cpu", pytest.param("gpu", id="card")])
def test_runs_keep_what_is_for_a_gpu(folder, monkeypatch, backend):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    programs.keep_on_gpu()
    assert folder.exists() == (backend == "gpu")
