"""What a run remembers of its environment, and what a resume makes of changes."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from experiments.errors import CheckpointError
from experiments.storage import rundir
from experiments.storage.environment import (
    compare_environment,
    environment,
    remember,
)

ROOT = Path(__file__).parents[2]


def test_environment_is_json_and_complete(tmp_path):
    now = environment()
    rundir.write_json(tmp_path / "env.json", now)
    assert rundir.read_json(tmp_path / "env.json") == now
    assert now["jax"] == jax.__version__
    assert now["numpy"] == np.__version__
    assert now["backend"] == jax.default_backend()
    assert now["device_count"] == len(jax.devices())
    assert now["x64"] is jax.config.jax_enable_x64  # pyright: ignore
    assert now["prng_impl"] == "threefry2x32"
    names = {"jaxpets", "python", "jaxlib", "flax", "optax", "orbax-checkpoint", "git"}
    assert now["processor"]
    flags = {"threefry_partitionable", "matmul_precision", "xla_flags", "device_kind"}
    assert names | flags | {"mujoco", "mujoco-mjx"} <= now.keys()


def test_differences_between_environments():
    now = environment()
    assert compare_environment(now, now) == []
    old = {**now, "jax": "0.10.0", "xla_flags": "--xla_x", "gone": 1}
    del old["numpy"]
    lines = compare_environment(old, now)
    assert lines == [
        f"jax was 0.10.0 and is now {now['jax']}",
        f"xla_flags was --xla_x and is now {now['xla_flags']}",
    ]
    for changed in ({"x64": not now["x64"]}, {"prng_impl": "rbg"}):
        with pytest.raises(CheckpointError, match=f"{next(iter(changed))} was"):
            compare_environment({**now, **changed}, now)


def test_the_environment_of_the_start_is_kept(tmp_path):
    path = tmp_path / "env.json"
    assert remember(path, {"jax": "1"}) == []
    assert remember(path, {"rollout": "kernel of g++ 12"}) == []
    lines = remember(path, {"rollout": "scan (no compiler)"})
    assert lines == ["rollout was kernel of g++ 12 and is now scan (no compiler)"]
    began = {"jax": "1", "rollout": "kernel of g++ 12"}
    assert rundir.read_json(path) == began
    path.write_text("[]")
    with pytest.raises(CheckpointError, match=r"env\.json is not an object"):
        remember(path, {"jax": "1"})


def test_flags_of_another_process_are_seen():
    script = "import json; from experiments.storage.environment import environment; "
    script += "print(json.dumps(environment()))"
    flags = {"JAX_ENABLE_X64": "1", "JAX_THREEFRY_PARTITIONABLE": "0"}
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "PYTHONPATH": str(ROOT), **flags},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    other = json.loads(done.stdout)
    assert (other["x64"], other["threefry_partitionable"]) == (True, False)
    with pytest.raises(CheckpointError, match="x64 was False and is now True"):
        compare_environment(environment(), other)
