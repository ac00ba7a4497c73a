"""A policy in ONNX acts as it does in JAX."""

import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import toys

import jaxpets
from jaxpets import PlanParams, coordinates, policies
from jaxpets.envs import half_cheetah as hc
from jaxpets.typing import Coordinate

TURNING = (
    Coordinate("x", is_input=False),
    Coordinate("z"),
    *(Coordinate(f"q{i}", "quaternion", is_bounded=False) for i in "wxyz"),
    Coordinate("hip", "angle", is_bounded=False),
    Coordinate("speed", "absolute"),
    *(Coordinate(f"p{i}", "quaternion", is_bounded=False) for i in "wxyz"),
)
SPACES = {
    "delta": (jaxpets.delta_space(), 3),
    "cheetah": (hc.model_space(), hc.OBS_SIZE),
    "turning": (coordinates.space(TURNING), len(TURNING)),
}
LOW, HIGH = np.float32([-1.0, -0.5]), np.float32([1.0, 2.0])
BOX = dict(action_low=LOW, action_high=HIGH)


def policy_of(space, obs_size, goals):
    """A policy, its parameters with numbers everywhere, and states it may see."""
    made = policies.actor_critic(
        toys.cart,
        toys.reach,
        optax.adam(1e-3),
        policies.ActorCriticConfig(hidden_size=16),
        space,
        obs_size=obs_size,
        goals=goals,
        **BOX,
    )
    rng = np.random.default_rng(0)
    rows = jnp.asarray(rng.normal(size=(50, obs_size)), jnp.float32)
    actions = jnp.zeros((50, 2), jnp.float32)
    dataset = toys.dataset_of(jaxpets.Transition(rows, actions, rows), capacity=50)
    params = PlanParams((), jnp.float32(0.5))
    params = jax.jit(made.init)(params, jax.random.key(0), dataset).params
    actor = jax.tree.map(
        lambda x: jnp.asarray(rng.normal(0, 0.3, x.shape), jnp.float32), params.actor
    )
    wide = jnp.asarray(rng.normal(0, 3, (64, obs_size)), jnp.float32)
    return made.policy, params._replace(actor=actor), wide


@pytest.mark.parametrize("sees", [True, False])
@pytest.mark.parametrize("name", SPACES)
def test_onnxruntime_acts_as_jax_does(name, sees):
    onnxruntime = pytest.importorskip("onnxruntime")
    space, obs_size = SPACES[name]
    goals = policies.Goals()
    if sees:
        goals = goals._replace(features=lambda target: jnp.stack([target, -target]))
    policy, params, obs = policy_of(space, obs_size, goals)

    def act(target, obs):
        known = PlanParams((), policies.Guided(target, params))
        return policy.step(known, jax.random.key(0), (), obs)[0].action

    targets = jnp.linspace(-2.0, 2.0, 64, dtype=jnp.float32)
    wanted = jax.jit(jax.vmap(act))(targets, obs)
    content = policies.to_onnx(params, space, obs_size=obs_size, **BOX)
    session = onnxruntime.InferenceSession(content)
    given = {"obs": np.asarray(obs)}
    if sees:
        given["task"] = np.stack([targets, -targets], axis=1)
    assert [x.name for x in session.get_inputs()] == list(given)
    (found,) = session.run(["action"], given)
    # Sums in another order, of numbers up to ten.
    np.testing.assert_allclose(found, wanted, atol=1e-4)
    assert np.ptp(found, axis=0).min() > 0.05
    one = {x: given[x][:1] for x in given}
    np.testing.assert_allclose(session.run(None, one)[0], wanted[:1], atol=1e-4)


def test_onnxruntime_reads_what_jax_reads_and_no_more():
    """Entries that are no inputs may be anything, and others far from 0."""
    onnxruntime = pytest.importorskip("onnxruntime")
    space, obs_size = SPACES["turning"]
    policy, params, obs = policy_of(space, obs_size, policies.Goals())
    # z is 100 m, give or take a millimetre.
    params = params._replace(
        mean=params.mean.at[0].set(100.0), std=params.std.at[0].set(1e-3)
    )
    obs = obs.at[:, 0].set(jnp.nan).at[:, 1].set(100.0 + 1e-3 * obs[:, 1])

    def act(obs):
        known = PlanParams((), policies.Guided(jnp.float32(0.0), params))
        return policy.step(known, jax.random.key(0), (), obs)[0].action

    content = policies.to_onnx(params, space, obs_size=obs_size, **BOX)
    (found,) = onnxruntime.InferenceSession(content).run(None, {"obs": np.asarray(obs)})
    np.testing.assert_allclose(found, jax.jit(jax.vmap(act))(obs), atol=1e-5)


@pytest.mark.parametrize(
    ("low", "high", "last"),
    [(-1.0, 1.0, ["Tanh"]), (-2.0, 2.0, ["Tanh", "Mul"]), (0.0, 2.0, ["Tanh", "Add"])],
)
def test_a_box_has_no_more_nodes_than_it_needs(low, high, last):
    """The order of features needs none: each takes as long as a small layer."""
    onnx, onnxruntime = (pytest.importorskip(name) for name in ("onnx", "onnxruntime"))
    space, obs_size = SPACES["cheetah"]
    one = np.ones(2, np.float32)
    box: Any = {"action_low": low * one, "action_high": high * one}
    _, params, obs = policy_of(space, obs_size, policies.Goals())
    content = policies.to_onnx(params, space, obs_size=obs_size, **box)
    kinds = [node.op_type for node in onnx.load_from_string(content).graph.node]
    assert kinds[-len(last) - 1 :] == ["Gemm", *last] and kinds.count("Gemm") == 3
    whole = policies.to_onnx(params, space, obs_size=obs_size, **BOX)
    given = {"obs": np.asarray(obs)}
    (found,), (other,) = (
        onnxruntime.InferenceSession(model).run(None, given)
        for model in (content, whole)
    )
    # Both are the same numbers within their boxes.
    inside = (other - (HIGH + LOW) / 2) / ((HIGH - LOW) / 2)
    scaled = inside * (high - low) / 2 + (high + low) / 2
    np.testing.assert_allclose(found, scaled, atol=1e-5)


def test_what_onnx_cannot_hold_is_refused():
    pytest.importorskip("onnx")
    space, size = SPACES["cheetah"]
    _, params, _ = policy_of(space, size, policies.Goals())
    own = space._replace(coordinates=(), features=lambda obs: obs**2)
    with pytest.raises(ValueError, match="functions of your own, which ONNX cannot"):
        policies.to_onnx(params, own, obs_size=size, **BOX)
    with pytest.raises(ValueError, match="obs_size must be 18 as of space, got 3"):
        policies.to_onnx(params, space, obs_size=3, **BOX)
    with pytest.raises(ValueError, match=r"at most the 18 features .* got 30"):
        policies.to_onnx(params, jaxpets.delta_space(), obs_size=30, **BOX)


def test_a_missing_package_names_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    space, size = SPACES["delta"]
    _, params, _ = policy_of(space, size, policies.Goals())
    with pytest.raises(ImportError, match=r"needs the extra jaxpets\[onnx\]"):
        policies.to_onnx(params, space, obs_size=size, **BOX)
