"""TD-MPC2 and hydrax beside jaxpets: whole rows, and a line where one is missing."""

import json
import subprocess
import sys

import jax
import numpy as np
import pytest

from benchmarks import peers, timing

TINY = ["--tiny", "--repeats", "3"]


@pytest.fixture(autouse=True)
def path(monkeypatch):
    """What a program adds to the path is gone after each test."""
    monkeypatch.setattr("sys.path", list(sys.path))


@pytest.mark.parametrize("name", ["tdmpc2", "hydrax"])
def test_a_folder_without_the_peer_says_how_to_get_it(name, tmp_path):
    with pytest.raises(SystemExit) as caught:
        peers.main([*TINY, f"--{name}", str(tmp_path)])
    (line,) = str(caught.value).splitlines()
    assert line.startswith(f"--{name} needs ")
    assert "git clone https://github.com/" in line and "pip install " in line
    assert "No module named" in line


def test_one_peer_must_be_asked_for(capsys):
    with pytest.raises(SystemExit) as caught:
        peers.main(TINY)
    assert caught.value.code == 2
    assert "ask for --tdmpc2, --hydrax or both" in capsys.readouterr().err


def test_rows_of_a_peer_and_of_ours(tmp_path, monkeypatch):
    def build(checkout):
        assert checkout == tmp_path
        sizes = {"program": "other", "num_samples": 2, "horizon": 3}
        return peers.Program(sizes, 6, 0.5, lambda: np.zeros(6), {"lib": "1.0"})

    monkeypatch.setattr(peers, "hydrax", build)
    path = tmp_path / "rows.jsonl"
    found = peers.main([*TINY, "--hydrax", str(tmp_path), "--json", str(path)])
    written = [json.loads(line) for line in path.read_text().splitlines()]
    assert json.loads(json.dumps(found)) == written
    for row in found:
        assert row["benchmark"] == "peers"
        assert row["device"] == jax.devices()[0].device_kind
        assert row["versions"]["jax"] == jax.__version__
        assert 0 < row["min_ms"] <= row["median_ms"] <= row["p99_ms"]
        assert row["repeats"] == 3 and row["compile_s"] > 0
        # Neither the figure nor `all` takes these for the paper's plan by others.
        assert "source" not in row and "name" not in row
    ours, other = found
    assert ours["sizes"]["program"] == "jaxpets tiny" and ours["peer"] is None
    # 16 candidates, 2 iterations, horizon 3, 5 particles.
    assert ours["steps"] == 16 * 2 * 3 * 5
    assert other["sizes"]["program"] == "other" and other["steps"] == 6
    assert other["peer"] == {"commit": None, "lib": "1.0"}  # no git checkout


def test_programs_run_in_turn_after_the_same_warm_up():
    order = []
    plans = [lambda: order.append("first"), lambda: order.append("second")]
    turns = timing.in_turn(*plans, repeats=4, warm_ups=peers.WARM_UPS)
    warm_up = ["first"] * peers.WARM_UPS + ["second"] * peers.WARM_UPS
    assert order == warm_up + ["first", "second"] * 4
    assert [len(of_one) for of_one in zip(*turns, strict=True)] == [4, 4]


def test_our_plan_is_that_of_the_program_plan():
    program = peers.ours("tiny", "scan", "f32")
    action = program.plan()
    assert isinstance(action, np.ndarray) and action.shape == (6,)
    np.testing.assert_array_equal(action, program.plan())
    assert timing.seconds(program.plan) > 0


def test_the_commit_is_that_of_the_checkout_itself(tmp_path):
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    subprocess.run([*git, "init", "--quiet"], check=True)
    subprocess.run([*git, "commit", "--quiet", "--allow-empty", "-m", "a"], check=True)
    assert len(peers.commit(tmp_path)) == 40
    inside = tmp_path / "inside"
    inside.mkdir()
    assert peers.commit(inside) is None
