import jax
import jax.numpy as jnp
import pytest

import jaxpets
from experiments import cli
from experiments.build import build
from jaxpets.envs import half_cheetah


def value(*flags):
    """What the first plan of a task is worth to a smoke run's untrained ensemble."""
    config = cli.parse(["--phase", "explore", "--preset", "smoke", *flags])
    parts = build(config)
    keys = jax.random.split(jax.random.key(0))
    params = jax.jit(parts.model.init)(keys[0])
    weights = half_cheetah.task("forward")
    actor = parts.actor
    step = jax.jit(lambda p: actor.step(p, keys[1], actor.init(), jnp.zeros(18)))
    return step(jaxpets.PlanParams(params, weights))[0].value


def test_pessimism_lowers_what_a_plan_is_worth():
    plain, doubtful = value(), value("--pessimism", "2")
    assert doubtful < plain
    assert value("--pessimism", "0") == pytest.approx(plain)
