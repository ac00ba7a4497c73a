"""Robots of other packages: what their registries say, and what is missing there."""

import sys
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpets import envs

MODULE = "mujoco_playground"
WHERE = f"{MODULE}.registry"


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

    action_size, dt, mj_model = 1, 0.5, "model"

    def __init__(self, observe):
        self.observe = observe

    def reset(self, rng):
        del rng
        place = jnp.array([0.25, 0.5, 1.5, 2.5])
        return self.state(Data(place, 4.0 * place))

    def step(self, state, action):
        return self.state(state.data._replace(qpos=state.data.qpos + action))

    def state(self, data):
        return State(self.observe(data), data.qpos[0], False, data)


@pytest.fixture
def playground(monkeypatch):
    """A registry that stands for MuJoCo Playground's, which need not be installed."""
    observed = {
        "SlideHidden": lambda data: jnp.concatenate([data.qpos[1:], data.qvel]),
        "SlideHigh": lambda data: data.qpos[1:] + jnp.array([1.0, 0.0, 0.0]),
        "SlideShort": lambda data: data.qpos[3:],
        "SlideSquared": lambda data: data.qpos**2,
        "SlideTwice": lambda data: {"state": data.qpos, "other": data.qpos},
    }

    def load(name, *, config_overrides):
        assert config_overrides == {"impl": "jax"}
        if name == "SlideBroken":
            raise OSError("no\nnetwork")
        return Slider(observed[name])

    registry = SimpleNamespace(ALL_ENVS=(*observed, "SlideBroken"), load=load)
    monkeypatch.setitem(sys.modules, MODULE, SimpleNamespace(registry=registry))


@pytest.mark.parametrize(
    ("name", "track"),
    [  # x, where the velocity has brought it, and a height, from where MuJoCo has it
        ("SlideHidden", [[0.25 + 0.5, 4.0], [0.25 + 1.5, 5.0]]),
        ("SlideHigh", [[0.25, 3.0], [0.25, 4.0]]),
    ],
)
def test_a_robot_earns_its_own_reward_and_is_drawn(playground, key, name, track):
    robot = envs.make(f"playground/{name}")
    assert (robot.name, robot.model) == (f"playground/{name}", "model")
    assert robot.tasks.names == ("own",) and robot.env.terminal_fn is None
    state = robot.env.step(robot.env.reset(key), jnp.ones(1))
    task = robot.tasks.params[0]
    assert robot.tasks.reward_fn(task, state.obs, jnp.ones(1), state.obs) == 1.25
    path = np.zeros((2, len(state.obs)), np.float32)
    path[:, 0], path[:, 1], path[:, 3] = [4.0, 5.0], 7.0, [1.0, 2.0]
    got = jax.jit(robot.qpos_fn)(path)
    np.testing.assert_array_equal(got[:, :2], track)
    np.testing.assert_array_equal(got[:, 2:], path[:, 1:3])


@pytest.mark.parametrize("name", ["SlideSquared", "SlideShort"])
def test_a_robot_that_hides_its_positions_is_not_drawn(playground, name):
    robot = envs.make(f"playground/{name}")
    assert np.isnan(robot.qpos_fn(jnp.zeros((1, len(robot.space.coordinates))))).all()


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        (
            "SlideHiden",
            f"a robot of {WHERE}, as playground/SlideHidden, .*SlideHiden'",
        ),
        ("SlideBroken", f"{WHERE} cannot make SlideBroken: OSError: no network"),
        ("SlideTwice", "env must observe one vector, got .*state"),
    ],
)
def test_what_a_registry_does_not_give_is_one_line(playground, name, reason):
    with pytest.raises(ValueError, match=reason):
        envs.make(f"playground/{name}")


def test_a_registry_is_named_without_being_there(monkeypatch):
    assert envs.registries()["playground"] == WHERE
    monkeypatch.setitem(sys.modules, MODULE, None)
    with pytest.raises(ImportError, match=r"pip install 'jaxpets\[playground\]'"):
        envs.make("playground/CheetahRun")
