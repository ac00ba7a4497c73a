"""What `doctor` says of this machine, and of ones that lack something."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from packaging.requirements import Requirement

from experiments import doctor, requirements
from experiments.requirements import Finding, Mark

ROOT = Path(doctor.__file__).resolve().parents[1]


def diagnosed(folder, **variables):
    """Runs the command in a folder; returns its exit code and lines."""
    done = subprocess.run(
        [sys.executable, "-m", "experiments.doctor"],
        env=os.environ | {"PYTHONPATH": str(ROOT)} | variables,
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.stderr == ""
    return done.returncode, done.stdout.splitlines()


def advice(lines, start):
    """Returns what is said below the only line that starts so."""
    (place,) = [i for i, line in enumerate(lines) if line.startswith(start)]
    return lines[place + 1].strip()


def test_a_machine_that_runs_tests_runs_experiments(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert doctor.main([]) == 0
    text = capsys.readouterr().out
    assert (
        f"jax {jax.__version__}" in text and f"device: {jax.default_backend()}" in text
    )
    assert "planning: " in text and "Runs can start; " in text
    assert f"free in {tmp_path}" in text
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(doctor._driver() is not None, reason="there is a GPU")
def test_a_device_that_is_not_there_ends_it(tmp_path):
    code, lines = diagnosed(tmp_path, JAX_PLATFORMS="cuda", PYTHONIOENCODING="ascii")
    assert code == 1
    assert "or unset JAX_PLATFORMS, which is cuda" in advice(lines, "[x] device: ")
    assert not any("planning" in line for line in lines)  # what follows from it
    assert lines[-1] == "No run can start here: see [x]."


@pytest.mark.skipif(doctor._driver() is not None, reason="kernels are of nvcc there")
def test_what_is_slow_or_lacking_is_said_with_what_helps(tmp_path):
    (tmp_path / "bin").mkdir()
    code, lines = diagnosed(tmp_path, PATH=str(tmp_path / "bin"), MUJOCO_GL="none-such")
    assert code == 0
    assert "apt-get install g++" in advice(lines, "[!] planning: scan")
    assert advice(lines, "[!] C++ compiler: none") == "apt-get install g++"
    assert advice(lines, "[!] OpenGL: cannot render").startswith(
        "for videos, on Debian"
    )
    assert lines[-1] == "Runs can start; 3 to improve."


def test_versions_are_compared_with_what_is_asked_for():
    asked = [
        Requirement(f"jax=={jax.__version__}"),
        Requirement("jax<0.1"),
        Requirement("jaxpets-none-such>=2"),
    ]
    assert list(requirements.problems(asked)) == [
        Finding(
            Mark.POOR,
            f"jax {jax.__version__}: tested with <0.1",
            'pip install "jax<0.1"',
        ),
        Finding(
            Mark.BAD,
            "jaxpets-none-such is not installed",
            'pip install "jaxpets-none-such>=2"',
        ),
    ]


def test_extras_of_extras_count():
    names = {asked.name for asked in requirements.requirements_of("experiments")}
    assert {"jax", "mujoco", "tyro"} <= names and "dm_control" not in names


def test_a_check_that_breaks_is_a_finding():
    def broken():
        raise RuntimeError("no such\nthing")

    shown = []
    found = doctor.findings((broken, broken), shown.append)
    assert found == shown == [Finding(Mark.BAD, "broken: no such")]
