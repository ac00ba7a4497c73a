"""Without the extra `envs` the library works, and its robot says what is missing."""

import importlib
import sys

import pytest

import jaxpets.envs
from jaxpets.envs import half_cheetah as hc

MESSAGE = r"needs the extra jaxpets\[envs\] .*pip install 'jaxpets\[envs\]'"


@pytest.fixture
def without(monkeypatch):
    """Makes packages look as if they were not installed."""

    def hide(*packages):
        for package in packages:
            monkeypatch.setitem(sys.modules, package, None)

    return hide


@pytest.mark.parametrize("module", ["half_cheetah", "native"])
def test_a_missing_simulator_names_the_extra(without, monkeypatch, module):
    without("mujoco")
    for name in ("half_cheetah", "native"):
        monkeypatch.delitem(sys.modules, f"jaxpets.envs.{name}", raising=False)
    with pytest.raises(ImportError, match=MESSAGE) as caught:
        importlib.import_module(f"jaxpets.envs.{module}")
    assert "mujoco" in str(caught.value)


def test_missing_mjx_names_the_extra(without, monkeypatch):
    without("mujoco.mjx")
    monkeypatch.delattr("mujoco.mjx", raising=False)  # as long as it was not imported
    with pytest.raises(ImportError, match=MESSAGE):
        hc.half_cheetah()


def test_a_missing_robot_names_the_extra(without):
    without("gymnasium")
    with pytest.raises(ImportError, match=MESSAGE):
        hc.load_model()


def test_a_missing_suite_names_its_own_extra(without):
    without("dm_control")
    with pytest.raises(
        ImportError, match=r"needs the extra jaxpets\[dmc\] .*dm_control"
    ):
        jaxpets.envs.make("dmc/walker")


def test_the_bridges_need_nothing(without, monkeypatch):
    without("mujoco", "gymnasium", "brax")
    monkeypatch.delitem(sys.modules, "jaxpets.envs.adapters")
    module = importlib.import_module("jaxpets.envs.adapters")
    assert module.env_rollout.__doc__ == jaxpets.envs.env_rollout.__doc__
