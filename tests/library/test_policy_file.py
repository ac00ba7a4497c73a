"""A policy as a file: what was saved comes back, and what was not is refused."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys
from safetensors import safe_open
from safetensors.numpy import load_file, save_file
from test_policy_onnx import BOX, SPACES, policy_of

from jaxpets import PlanParams, coordinates, envs, models, policies

GOALS = policies.Goals(features=lambda target: jnp.stack([target, -target]))
SPACE, SIZE = SPACES["turning"]


@pytest.fixture(scope="module")
def policy():
    return policy_of(SPACE, SIZE, GOALS)


@pytest.fixture(scope="module")
def saved(policy, tmp_path_factory):
    path = tmp_path_factory.mktemp("policies") / "p.safetensors"
    policies.save_policy(path, policy[1], SPACE, obs_size=SIZE, about={"a": 1}, **BOX)
    return path


def act(planner, params, obs):
    known = PlanParams((), policies.Guided(jnp.float32(0.3), params))
    plan, _ = jax.jit(planner.step)(known, jax.random.key(0), (), obs)
    return plan.action, plan.value


def test_what_was_saved_acts_the_same(policy, saved):
    planner, params, obs = policy
    again, found = policies.load_policy(saved, goals=GOALS)
    for got, want in zip(
        act(again, found, obs[0]), act(planner, params, obs[0]), strict=True
    ):
        np.testing.assert_array_equal(got, want)


def test_a_policy_needs_nothing_to_be_said_about_it(saved, tmp_path):
    path = tmp_path / "p"
    assert models.about(saved) == {"a": 1}
    with safe_open(saved, "np") as file:
        texts = {k: v for k, v in file.metadata().items() if k != "about"}
    save_file(load_file(saved), path, texts)
    assert policies.load_policy(path, goals=GOALS)
    with pytest.raises(ValueError, match="its metadata lacks 'about'"):
        models.about(path)


def test_a_policy_that_was_rounded_is_one_of_float32(policy, saved, tmp_path):
    """As a model is, in a file in half the room."""
    with safe_open(saved, "np") as file:
        texts = dict(file.metadata())
    half = {name: x.astype(np.float16) for name, x in load_file(saved).items()}
    save_file(half, tmp_path / "half", texts)
    _, found = policies.load_policy(tmp_path / "half", goals=GOALS)
    toys.assert_trees_close(found, policy[1], rtol=1e-3, atol=1e-6)


def test_a_file_that_does_not_know_of_squashed_values_has_none(policy, tmp_path):
    params = policy[1]._replace(squash=jnp.float32(10.0))
    path = tmp_path / "p"
    policies.save_policy(path, params, SPACE, obs_size=SIZE, **BOX)
    assert policies.load_policy(path, goals=GOALS)[1].squash == 10.0
    with safe_open(path, "np") as file:
        texts = dict(file.metadata())
    arrays = load_file(path)
    assert arrays.pop("squash") == 10.0
    save_file(arrays, path, texts)
    assert policies.load_policy(path, goals=GOALS)[1].squash == 0.0


def test_own_functions_are_not_saved(policy, tmp_path):
    planner, params, obs = policy
    own = SPACE._replace(coordinates=())
    policies.save_policy(tmp_path / "p", params, own, obs_size=SIZE, **BOX)
    with pytest.raises(ValueError, match="author's own functions, which a file cannot"):
        policies.load_policy(tmp_path / "p", goals=GOALS)
    again, found = policies.load_policy(tmp_path / "p", goals=GOALS, space=own)
    got, want = act(again, found, obs[0]), act(planner, params, obs[0])
    np.testing.assert_array_equal(got[0], want[0])


def test_numbers_that_are_none_are_not_saved(policy, tmp_path):
    bad = policy[1]._replace(mean=policy[1].mean * jnp.nan)
    with pytest.raises(ValueError, match="mean of params must have no NaN"):
        policies.save_policy(tmp_path / "p", bad, SPACE, obs_size=SIZE, **BOX)
    assert not (tmp_path / "p").exists()


@pytest.mark.parametrize("actor", [None, {"params": {"Dense_0": {}}}])
def test_what_is_no_actor_is_neither_saved_nor_written(policy, tmp_path, actor):
    bad, how = policy[1]._replace(actor=actor), {"obs_size": SIZE, **BOX}
    with pytest.raises(TypeError, match="actor must be parameters of an actor, got"):
        policies.save_policy(tmp_path / "p", bad, SPACE, **how)
    with pytest.raises(TypeError, match="actor must be parameters of an actor, got"):
        policies.to_onnx(bad, SPACE, **how)


def changed(saved, path, drop=(), **changes):
    """Writes a file that is like the saved one but for some of its parts."""
    with safe_open(saved, "np") as file:
        texts = dict(file.metadata())
    texts["policy"] = json.dumps(json.loads(texts["policy"]) | changes)
    arrays = {k: v for k, v in load_file(saved).items() if k not in drop}
    save_file(arrays, path, texts)
    return path


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (dict(x=1), "its policy must have space, obs_size"),
        (dict(obs_size=-1), "obs_size must be at least 1, got -1"),
        (dict(space="delta", obs_size=10**15), "must be of shape"),
        (dict(obs_size=3), "its space must have 3 entries, got 12"),
        (dict(action_low=["no", "number"]), "is no file that can be read"),
        (dict(action_low=[3.0, 3.0]), "finite with low < high"),
        (dict(action_low=[-1.0], action_high=[1.0]), "must be of shape"),
        (dict(drop="mean"), "mean must be of shape"),
        (dict(drop="actor.params.Dense_0.kernel"), "first layer must be of two axes"),
    ],
)
def test_a_strangers_file_is_refused(saved, tmp_path, changes, words):
    path = changed(saved, tmp_path / "p", **changes)
    with pytest.raises(ValueError, match=words) as caught:
        policies.load_policy(path, goals=GOALS)
    assert str(path) in str(caught.value)


def test_a_space_of_ones_own_has_the_size_of_the_file(saved):
    space = coordinates.space([coordinates.Coordinate("q")])
    with pytest.raises(ValueError, match="obs_size must be 1 as of space, got 12"):
        policies.load_policy(saved, goals=GOALS, space=space)


def test_a_model_is_no_policy():
    with pytest.raises(ValueError, match="no format 'jaxpets policy'"):
        policies.load_policy(models.path("best"))


def test_what_comes_with_the_library_is_read():
    robot = envs.make("pets/half_cheetah", backend="mujoco")
    goals = policies.Goals(features=jnp.stack)
    planner, params = policies.load_policy(policies.path("best"), goals=goals)
    task = jax.tree.map(lambda x: x[0], robot.tasks.params)
    obs = robot.env.reset(jax.random.key(0)).obs
    known = PlanParams((), policies.Guided(task, params))
    plan, _ = planner.step(known, jax.random.key(0), (), obs)
    assert plan.action.shape == (6,) and jnp.abs(plan.action).max() <= 1.0
    alone, _ = policies.load_policy(policies.path("best"))
    message = r"goals.features must return \[3\], as .* got \[0\]; .* needs its goals"
    with pytest.raises(ValueError, match=message):
        alone.step(known, jax.random.key(0), (), obs)
    found = models.about(policies.path("best"))
    assert (found["environment"], tuple(found["tasks"])) == (
        robot.name, robot.tasks.names,
    )  # fmt: skip
    own = models.about(models.path("best"))["training"]
    same = ("arm", "seed", "num_trials", "trial_length", "refit")
    assert {x: found["training"][x] for x in same} == {x: own[x] for x in same}
    assert found["training"]["model"] == "pretrained/best"
    with pytest.raises(ValueError, match="name must be a policy, as best, got 'bst'"):
        policies.path("bst")
