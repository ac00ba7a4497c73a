"""Rewards that show every particle to all members."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from jaxpets.rewards import (
    Plan2ExploreData,
    jensen_renyi,
    one_step_disagreement,
    opax,
    plan2explore,
)

E, P, D = 5, 4, 6
EVERY = pytest.mark.parametrize("build", [one_step_disagreement, opax, jensen_renyi])


def some_members(seed=0):
    """Returns parameters of `affine`."""
    rng = np.random.default_rng(seed)
    weight = rng.normal(size=(E, D)).astype(np.float32)
    return weight, rng.uniform(0.5, 2, size=(E, D)).astype(np.float32)


def some_particles(seed=1):
    return np.random.default_rng(seed).normal(size=(E, P, D)).astype(np.float32)


def affine(params, obs, action):
    """Member e predicts w_e * obs + sum(action), with variance s_e."""
    weight, variance = params
    mean = weight[:, None, :] * obs + jnp.sum(action, axis=-1)[:, None]
    return mean, jnp.broadcast_to(variance[:, None, :], mean.shape)


def test_one_step_disagreement_equals_the_reference():
    weight, variance = some_members()
    obs = some_particles()
    fn = jax.jit(one_step_disagreement(affine))
    got = fn((weight, variance), jnp.asarray(obs), jnp.ones(2), jnp.zeros((E, P, D)))
    assert got.shape == (E, P)
    means = np.float64(weight)[:, None, None] * np.float64(obs)[None] + 2.0
    ratio = means.var(0) / np.float64(variance).mean(0)
    want = np.sqrt(ratio).mean(-1)
    np.testing.assert_allclose(got, want, rtol=1e-5)


def test_plan2explore_is_in_units_of_the_data():
    """The same in float64; what the members say of their noise does not count."""
    weight, variance = some_members()
    obs = some_particles()
    data = np.random.default_rng(2).uniform(0.5, 2, size=D).astype(np.float32)
    fn = jax.jit(plan2explore(affine))
    step = (jnp.asarray(obs), jnp.ones(2), jnp.zeros((E, P, D)))
    got = fn(Plan2ExploreData((weight, variance), data), *step)
    assert got.shape == (E, P)
    means = np.float64(weight)[:, None, None] * np.float64(obs)[None] + 2.0
    want = np.sqrt(means.var(0) / np.float64(data)).mean(-1)
    np.testing.assert_allclose(got, want, rtol=1e-5)
    np.testing.assert_array_equal(
        fn(Plan2ExploreData((weight, 3 * variance), data), *step), got
    )


def test_what_does_not_fit_plan2explore_is_refused():
    fn, obs = plan2explore(affine), jnp.zeros((E, P, D))
    with pytest.raises(TypeError, match="predict_fn must be a function, got None"):
        plan2explore(None)
    with pytest.raises(TypeError, match="params must be a Plan2ExploreData"):
        fn(some_members(), obs, jnp.ones(2), obs)
    for size, given, words in (
        (D + 1, obs, r"baseline_variance must be float32\[6\], got"),
        (D, obs[0], r"obs must be float32\[E, P, D\], got"),
    ):
        params = Plan2ExploreData(some_members(), jnp.ones(size))
        with pytest.raises(ValueError, match=words):
            fn(params, given, jnp.ones(2), given)


@EVERY
def test_members_that_agree_disagree_by_nothing(build):
    obs = some_particles()
    same = (jnp.ones((E, D)), jnp.ones((E, D)))
    got = jax.jit(build(affine))(same, jnp.asarray(obs), jnp.ones(2), obs)
    np.testing.assert_allclose(got, 0.0, atol=1e-5)


def test_one_step_disagreement_with_the_ensemble(key):
    model = toys.small_ensemble()
    params = jax.jit(model.init)(key)
    fn = jax.jit(one_step_disagreement(model.predict))
    obs = jax.random.normal(key, (3, 2, 2))
    got = fn(params, obs, jnp.ones(1), obs)
    # All six particles as the rows of every member.
    rows = jnp.broadcast_to(obs.reshape(6, 2), (3, 6, 2))
    mean, variance = (
        np.float64(x) for x in jax.jit(model.predict)(params, rows, jnp.ones((6, 1)))
    )
    want = np.sqrt(mean.var(0) / variance.mean(0)).mean(-1)
    np.testing.assert_allclose(got, want.reshape(3, 2), rtol=1e-4)


@EVERY
def test_what_does_not_fit_is_refused(build):
    with pytest.raises(TypeError, match="predict_fn must be a function, got None"):
        build(None)
    fn = build(affine)
    params = (jnp.ones((1, D)), jnp.ones((1, D)))
    with pytest.raises(ValueError, match="at least 2 members, got 1"):
        fn(params, jnp.zeros((1, P, D)), jnp.ones(2), jnp.zeros((1, P, D)))
    with pytest.raises(ValueError, match=r"obs must be float32\[E, P, D\], got"):
        fn(params, jnp.zeros((P, D)), jnp.ones(2), jnp.zeros((P, D)))


def test_opax_equals_the_reference():
    """The sum of log(1 + epistemic / aleatoric), in float64."""
    weight, variance = some_members()
    obs = some_particles()
    got = jax.jit(opax(affine))((weight, variance), jnp.asarray(obs), jnp.ones(2), obs)
    assert got.shape == (E, P)
    means = np.float64(weight)[:, None, None] * np.float64(obs)[None] + 2.0
    ratio = means.var(0) / np.float64(variance).mean(0)
    np.testing.assert_allclose(got, np.log(1 + ratio).sum(-1), rtol=1e-5)


def test_jensen_renyi_equals_the_reference():
    """The mean over all pairs of the integral of a product of two Gaussians."""
    weight, variance = (np.float64(x) for x in some_members())
    obs = some_particles()
    params = tuple(jnp.float32(x) for x in (weight, variance))
    got = jax.jit(jensen_renyi(affine))(params, jnp.asarray(obs), jnp.ones(2), obs)
    assert got.shape == (E, P)
    means = weight[:, None, None] * np.float64(obs)[None] + 2.0

    def log_density(i, j):
        both = variance[i] + variance[j]
        terms = (means[i] - means[j]) ** 2 / both + np.log(2 * np.pi * both)
        return -terms.sum(-1) / 2

    pairs = np.stack([[log_density(i, j) for j in range(E)] for i in range(E)])
    alone = np.mean([pairs[i, i] for i in range(E)], axis=0)
    want = alone - np.log(np.exp(pairs).mean((0, 1)))
    np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-5)


def test_jensen_renyi_of_members_that_share_nothing_is_log_of_their_number():
    """Also where their densities leave the range of float32."""
    size = 30
    weight = np.float32(100 * np.arange(E)[:, None] * np.ones(size))
    obs = jnp.ones((E, 1, size))
    variance = jnp.full((E, size), 1e-6)
    got = jax.jit(jensen_renyi(affine))((weight, variance), obs, jnp.ones(2), obs)
    # The sum of 30 logarithms of 1e-6 has a rounding of some 1e-5.
    np.testing.assert_allclose(got, np.log(E), rtol=1e-4)


def test_jensen_renyi_is_that_of_the_example():
    """Which shows how one writes it by hand, without its guard against overflow."""
    example = Path(__file__).parents[2] / "examples" / "exploration_bonus.py"
    text = example.read_text()
    start, end = text.index("def jensen_renyi("), text.index("def epistemic(")
    model = toys.small_ensemble()._replace(predict=affine)
    names = {"jnp": jnp, "model": model}
    exec(compile(text[start:end], str(example), "exec"), names)
    step = (jnp.asarray(some_particles()), jnp.ones(2), jnp.zeros((E, P, D)))
    params = tuple(map(jnp.asarray, some_members()))
    got = jax.jit(jensen_renyi(affine))(params, *step)
    want = names["jensen_renyi"](params, *step)
    np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-5)
