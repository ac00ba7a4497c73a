"""The examples run as printed, and show what they say they show."""

import re

import jax.numpy as jnp
import numpy as np
import pages
import pytest
from pages import run


def numbers(line):
    """Returns the numbers of a printed line."""
    return [float(number) for number in re.findall(r"-?\b\d+(?:\.\d+)?", line)]


def test_own_model_reaches_every_goal():
    _, lines = run("own_model.py")
    assert len(lines) == 3
    for line, goal in zip(lines, [-1.0, 0.5, 2.0], strict=True):
        # At most 1 N on 1 kg for 8 s reach and hold each goal.
        np.testing.assert_allclose(numbers(line), [goal, goal, 0.0], atol=0.02)


@pytest.mark.slow
def test_su_pets_explores_and_performs_four_tasks():
    names, lines = run("su_pets.py", "--tiny")
    n = names["n"]
    assert n is names["TINY"]
    assert len(lines) == n.trials + 4
    assert all(numbers(line) and np.isfinite(numbers(line)).all() for line in lines)
    assert names["state"].dataset.size == n.trials * n.steps
    assert names["out"].fit.num_skipped == 0
    # The last trial was planned, for a disagreement that the model expects to find.
    assert names["out"].plans.value.min() > 0.0
    assert names["returns"].shape == (4,)


@pytest.fixture(scope="module")
def bonus():
    return run("exploration_bonus.py", "--tiny")


@pytest.mark.slow
def test_exploration_bonus_compares_three_explorations(bonus):
    _, lines = bonus
    names = [line.split()[0] for line in lines]
    assert names == ["random", "epistemic", "jensen-renyi"]
    shares = [numbers(line.split(maxsplit=1)[1])[0] for line in lines]
    assert all(0.0 < share <= 100.0 for share in shares)


@pytest.mark.slow
def test_the_bonus_is_the_divergence_of_the_members(bonus, monkeypatch):
    mean = jnp.array([-1.0, 0.0, 2.5], jnp.float32)
    variance = jnp.array([0.3, 1.0, 2.0], jnp.float32)

    def predict(params, obs, action):
        rows = (*obs.shape[:2], 1)
        return tuple(jnp.broadcast_to(x[:, None, None], rows) for x in params)

    objective = bonus[0]["jensen_renyi"]
    names = objective.__globals__
    monkeypatch.setitem(names, "model", names["model"]._replace(predict=predict))
    obs = jnp.zeros((3, 2, 1), jnp.float32)
    action = jnp.zeros((1,), jnp.float32)
    found = objective((mean, variance), obs, action, obs)

    x = np.linspace(-20.0, 20.0, 4001)[:, None]
    members = np.exp(-((x - mean) ** 2) / 2 / variance) / np.sqrt(2 * np.pi * variance)
    entropy = lambda p: -np.log(np.trapezoid(p**2, x[:, 0], axis=0))  # noqa: E731
    wanted = entropy(members.mean(1)) - entropy(members).mean()
    # float32 against an integral that is exact to 1e-9.
    np.testing.assert_allclose(found, np.full((3, 2), wanted), rtol=1e-5)
    agreed = objective((jnp.zeros_like(mean), jnp.ones_like(mean)), obs, action, obs)
    np.testing.assert_allclose(agreed, 0.0, atol=1e-6)


@pytest.mark.slow
def test_a_robot_of_ones_own_is_explored_and_told_to_do_two_things(
    tmp_path, monkeypatch, capsys
):
    names, lines = run("own_robot.py", "--tiny")
    assert len(lines) == 2 + 2
    assert all(np.isfinite(numbers(line)).all() for line in lines)
    assert [line.split()[0] for line in lines[2:]] == ["forward", "high"]
    assert names["state"].dataset.size == 2 * 10
    # It fell by no more than it is high, and no faster than it may.
    assert names["rows"][names["height"]].name == "qpos/z"
    assert -1.0 < numbers(lines[-1])[0] < 1.0
    # What its guide has beside it: the table as printed, a task and a file.
    monkeypatch.chdir(tmp_path)
    pages.execute("docs/own_robot.md", names)
    (shown,) = pages.blocks("docs/own_robot.md", "text")
    assert capsys.readouterr().out.startswith(shown.removesuffix("  ...\n"))


@pytest.mark.slow
def test_a_gymnasium_robot_goes_from_exploration_to_two_tasks():
    names, lines = run("gymnasium_robot.py", "--tiny")
    assert [line.split()[0] for line in lines] == ["trial", "trial", "stand", "spin"]
    agent = names["agent"]
    assert agent.num_steps == 4 * 12  # it goes on observing while it performs
    heights = [numbers(line)[0] for line in lines[2:]]
    assert all(-1.0 <= height <= 1.0 for height in heights)
    # Two tasks, one program.
    assert agent._acts[names["actor"]].program._cache_size() == 1
