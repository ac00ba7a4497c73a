"""What the study's tasks of the quadruped are worth, in states made by hand."""

import functools
import runpy
from pathlib import Path

import jax.numpy as jnp
import pytest

import experiments
from jaxpets import envs

FILE = Path(experiments.__file__).parent / "sweeps" / "quadruped_tasks.py"
MOVES = {
    "jog": ("sensordata/velocimeter.x", 2.0),
    "walk-backwards": ("sensordata/velocimeter.x", -0.5),
    "walk-left": ("sensordata/velocimeter.y", 0.5),
    "turn-left": ("qvel/root.wz", 1.0),
}


@functools.cache
def robot():
    return envs.make("dmc/quadruped")


@pytest.fixture(scope="module")
def tasks():
    return runpy.run_path(str(FILE))["tasks"]()


def earned(task, **entries):
    """Returns the reward of a step to a state, on the feet unless said otherwise."""
    state = {"qpos/root.z": 0.8, "qpos/root.qw": 1.0, **entries}
    obs = jnp.array(
        [state.get(entry.name, 0.0) for entry in robot().env.coordinates], jnp.float32
    )
    return float(task((), obs, jnp.zeros(12), obs))


@pytest.mark.parametrize("name", MOVES)
def test_who_moves_as_wanted_earns_all_and_who_rests_nothing(tasks, name):
    entry, rate = MOVES[name]
    assert earned(tasks[name], **{entry: rate}) == 1.0
    assert earned(tasks[name]) == earned(tasks[name], **{entry: -rate}) == 0.0
    assert 0.0 < earned(tasks[name], **{entry: rate / 2}) < 1.0
    over = {"qpos/root.qw": 0.0, "qpos/root.qx": 1.0}
    assert earned(tasks[name], **over, **{entry: rate}) == 0.0


def test_its_own_tasks_are_those_of_the_robot(tasks):
    """Counted for each of two control steps; half of it for standing still."""
    assert tuple(tasks)[:2] == robot().tasks.names
    speed = "sensordata/velocimeter.x"
    assert earned(tasks["walk"], **{speed: 0.5}) == 2.0
    assert earned(tasks["run"], **{speed: 5.0}) == 2.0
    assert earned(tasks["run"]) == 1.0


def test_who_stands_is_tall_and_still(tasks):
    assert earned(tasks["stand"]) == 1.0
    assert earned(tasks["stand"], **{"qpos/root.z": 0.2}) == 0.0
    for entry in ("sensordata/velocimeter.z", "qvel/root.wx"):
        assert earned(tasks["stand"], **{entry: 0.5}) == pytest.approx(0.1)


def test_who_lies_on_the_back_has_turned_over(tasks):
    assert earned(tasks["on-back"]) == 0.0
    for axis in "xy":
        over = {"qpos/root.qw": 0.0, f"qpos/root.q{axis}": 1.0}
        assert earned(tasks["on-back"], **over) == 1.0
