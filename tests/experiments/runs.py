"""Whole runs of the preset smoke, for the tests of devices and hosts.

Physics in C: it compiles in a third of the time, and where a seed is computed has
nothing to do with how its physics is.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from experiments import cli, exploration
from experiments.build import build
from experiments.run import main
from experiments.storage import checkpoint

NAME = "smoke-epistemic"
EXPLORED = ("--phase", "explore", "--preset", "smoke", "--engine", "mujoco")
LAST, STEPS = 3, 20
REFIT = ("--refit.num-epochs", "1", "--refit.batch-size", "16")


def start(*command, devices=1, variables=()):
    """Starts Python in a process of its own; all share what they compile."""
    flags = f"--xla_force_host_platform_device_count={devices}"
    env = {
        "PYTHONPATH": str(Path(cli.__file__).resolve().parents[1]),
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1",
        "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flags}",
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


def unfinished(folder, out, last=LAST):
    """Returns a copy of a run whose last trial is not saved."""
    shutil.copytree(folder, out / folder.name)
    shutil.rmtree(out / folder.name / "checkpoints" / str(last))
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
