"""Robots of other packages: what their registries say, and what is missing there."""

import sys
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from jaxpets import envs

MODULE = "mujoco_playground.registry"


class Data(NamedTuple):
    qpos: Any
    qvel: Any


class State(NamedTuple):
    obs: Any
    reward: Any
    done: Any
    data: Data


class Slider:
    """Slides by its action along x, of which it observes what it is told to."""

    action_size, dt = 1, 0.5

    def __init__(self, observe, model):
        self.observe = observe
        if model:
            self.mj_model = model

    def reset(self, rng):
        del rng
        return self.state(Data(jnp.array([0.25, 0.5]), jnp.array([2.0, 3.0])))

    def step(self, state, action):
        return self.state(state.data._replace(qpos=state.data.qpos + action))

    def state(self, data):
        return State(self.observe(data), data.qpos[0], False, data)


@pytest.fixture
def playground(monkeypatch):
    """A registry that stands for MuJoCo Playground's, which need not be installed."""
    observed = {
        "SlideHidden": lambda data: jnp.concatenate([data.qpos[1:], data.qvel]),
        "SlideStill": lambda data: data.qpos[1:],
        "SlideSquared": lambda data: data.qpos**2,
        "SlideTwice": lambda data: {"state": data.qpos, "other": data.qpos},
    }

    def load(name, *, config_overrides):
        assert config_overrides == {"impl": "jax"}
        if name == "SlideBroken":
            raise OSError("no\nnetwork")
        return Slider(observed[name], "model" if name == "SlideHidden" else None)

    names = (*observed, "SlideBroken")
    monkeypatch.setitem(sys.modules, MODULE, SimpleNamespace(ALL_ENVS=names, load=load))


@pytest.mark.parametrize(
    ("name", "model", "track"),
    [
        ("SlideHidden", "model", [[0.25 + 0.5, 4.0], [0.25 + 1.5, 5.0]]),
        ("SlideStill", None, [[0.25, 4.0], [0.25, 5.0]]),
    ],
)
def test_a_robot_earns_its_own_reward_and_is_drawn(playground, key, name, model, track):
    robot = envs.make(f"playground/{name}")
    assert (robot.name, robot.model) == (f"playground/{name}", model)
    assert robot.tasks.names == ("own",) and robot.env.terminal_fn is None
    state = robot.env.step(robot.env.reset(key), jnp.ones(1))
    task = robot.tasks.params[0]
    assert robot.tasks.reward_fn(task, state.obs, jnp.ones(1), state.obs) == 1.25
    path = jnp.stack([jnp.zeros_like(state.obs)] * 2).at[:, 0].set(jnp.array([4.0, 5]))
    path = path.at[:, 1].set(jnp.array([1.0, 2.0]))  # a velocity where there is one
    np.testing.assert_array_equal(robot.qpos_fn(path), track)


def test_a_robot_that_hides_its_positions_is_not_drawn(playground):
    robot = envs.make("playground/SlideSquared")
    with pytest.raises(ValueError, match="observation does not begin with positions"):
        robot.qpos_fn(jnp.zeros((1, 3)))


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        (
            "SlideHiden",
            f"a robot of {MODULE}, as playground/SlideHidden, .*SlideHiden'",
        ),
        ("SlideBroken", f"{MODULE} cannot make SlideBroken: OSError: no network"),
        ("SlideTwice", "env must observe one vector, got .*state"),
    ],
)
def test_what_a_registry_does_not_give_is_one_line(playground, name, reason):
    with pytest.raises(ValueError, match=reason):
        envs.make(f"playground/{name}")


def test_a_registry_is_named_without_being_there(monkeypatch):
    assert envs.registries()["playground"] == MODULE
    monkeypatch.setitem(sys.modules, MODULE, None)
    with pytest.raises(ImportError, match=r"pip install 'jaxpets\[playground\]'"):
        envs.make("playground/CheetahRun")
