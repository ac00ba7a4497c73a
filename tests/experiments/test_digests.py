"""The digests of a checkout: which runs they are of, and what they leave out."""

import json

import jax.numpy as jnp
import numpy as np

from experiments import cli
from experiments.storage import checkpoint
from experiments.tools import digests


def test_every_command_line_is_a_run():
    for steps in digests.cases().values():
        cli.parse(steps[0])  # the later ones need the run that it makes


def test_digests_leave_out_the_time_and_old_names(tmp_path):
    run = tmp_path / "run"
    state = {"a": jnp.arange(3.0), "b": np.ones((2, 2), np.int32)}
    checkpoint.save(run / "checkpoints", 1, state, {})
    found = []
    for name, seconds in (("loss", 1.0), ("nll", 2.0)):
        row = {"trial": 1, "fit": {name: 0.5}, "seconds": {"act": seconds}}
        row["check"] = f"{seconds}"
        (run / "metrics.jsonl").write_text(json.dumps(row) + "\n")
        found.append(dict(digests.found_in(tmp_path)))
    assert found[0] == found[1]
    assert {"run/checkpoints/1:a", "run/checkpoints/1:b", "run/metrics.jsonl"} == set(
        found[0]
    )


def test_digests_see_a_bit(tmp_path):
    found = []
    for step, value in enumerate((1.0, np.nextafter(np.float32(1.0), 2.0)), start=1):
        folder = tmp_path / str(step) / "checkpoints"
        checkpoint.save(folder, 7, {"a": jnp.float32(value)}, {})
        found += dict(digests.found_in(tmp_path / str(step))).values()
    assert len(set(found)) == 2


def test_a_run_that_fails_is_said(tmp_path, capsys):
    (tmp_path / "experiments").mkdir()
    (tmp_path / "experiments" / "__init__.py").touch()  # and no command
    failed = digests.main([str(tmp_path), "--only", "smoke-random-mujoco"])
    assert failed == 1
    assert "failed" in json.loads(capsys.readouterr().out)["smoke-random-mujoco"]
