"""Whole runs of the preset smoke, for the tests of devices and hosts.

Physics in C: it compiles in a third of the time, and where a seed is computed has
nothing to do with how its physics is.
"""

import fcntl
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import jax
import pytest

from experiments import cli, exploration
from experiments.build import build
from experiments.run import main
from experiments.storage import checkpoint

NAME = "smoke-epistemic"
EXPLORED = ("--phase", "explore", "--preset", "smoke", "--engine", "mujoco")
LAST, STEPS = 3, 20
FOUR = (3, 2, 1, 0)  # seeds; alone, the last of them is a run that files share
REFIT = ("--refit.num-epochs", "1", "--refit.batch-size", "16")
ACTOR = (
    *REFIT, "--tag", "actor", "--critic.acts",
    "--critic.num-updates", "20", "--critic.hidden-size", "16",
    "--critic.batch-size", "8",
)  # fmt: skip


def start(*command, devices=1, variables=()):
    """Starts Python in a process of its own; all share what they compile."""
    flags = os.environ.get("XLA_FLAGS", "")
    if devices > 1:
        flags += f" --xla_force_host_platform_device_count={devices}"
    env = {
        "PYTHONPATH": str(Path(cli.__file__).resolve().parents[1]),
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1",
        "XLA_FLAGS": flags,
    }
    return subprocess.Popen(
        [sys.executable, *map(str, command)],
        env=os.environ | env | dict(variables),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def explore(out, *seeds):
    """Explores here, on one device; returns the run's folder."""
    assert main([*EXPLORED, "--seeds", *map(str, seeds), "--out", str(out)]) == 0
    return out / NAME


class Explored(NamedTuple):
    """A run in a process of its own, where only a video may mind the GL."""

    folder: Path
    output: str
    errors: str


def explored_once(root, *seeds):
    """Returns the run of some seeds, which the first caller makes."""

    def explored(out):
        command = ("-m", "experiments.run", *EXPLORED, "--seeds", *seeds, "--out", out)
        process = start(*command, variables={"MUJOCO_GL": "crayons"})
        output, errors = process.communicate(timeout=300)
        assert process.returncode == 0, errors
        return output, errors

    out = root / "-".join(map(str, seeds))
    return Explored(out / NAME, *_once(out, explored))


def performed_once(root):
    """Returns the run of seed 0 after a zero-shot with a refit, on one device."""

    def performed(out):
        folder = copied(explored_once(root, 0).folder, out)
        assert main(["--phase", "zero-shot", "--from", str(folder), *REFIT]) == 0

    out = root / "performed"
    _once(out, performed)
    return out / NAME


def _once(out, make):
    """Has one process make a folder, and returns what that got from `make`."""
    out.mkdir(parents=True, exist_ok=True)
    done = out / "done.json"
    with (out / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            done.write_text(json.dumps(make(out)))
    return json.loads(done.read_text())


def copied(folder, out):
    """Returns a copy of a run in another folder."""
    return shutil.copytree(folder, out / folder.name)


def unfinished(folder, out, last=LAST):
    """Returns a copy of a run whose last trial is not saved."""
    shutil.rmtree(copied(folder, out) / "checkpoints" / str(last))
    return out / folder.name


def rows(folder):
    """Reads a log, but for the checks of its lines."""
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    found = [json.loads(line) for line in lines]
    assert all(row.pop("check") for row in found)
    return found


def numbers(row):
    """What was measured in a trial."""
    own = {"value": row["value"], "turns": row["turns"]}
    return own | row["returns"] | row.get("fit", {})


def learner(folder, step=None):
    """Restores the learner of an exploration run, by default the newest."""
    config = cli.parse(["--phase", "zero-shot", "--from", str(folder)])
    template = exploration.as_saved(config, build(config))
    found = checkpoint.restore(
        folder / "checkpoints", template, step=step, warn=pytest.fail
    )
    assert found is not None
    return found[1]
