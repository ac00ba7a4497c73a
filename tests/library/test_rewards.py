import jax.numpy as jnp
import numpy as np
import pytest
import reference

import jaxpets
from jaxpets.rewards import (
    MixtureData,
    ensemble_std,
    epistemic,
    information_gain,
    mixture,
    pessimistic,
)

E, P, D = 5, 4, 6


def particles(seed=0):
    rng = np.random.default_rng(seed)
    scale = np.array([0.01, 0.1, 1.0, 3.0, 10.0, 50.0])
    states = scale * (rng.normal(size=(E, 1, D)) + 0.3 * rng.normal(size=(E, P, D)))
    return states.astype(np.float32), (scale**2).astype(np.float32)


def reward(states, base):
    obs = jnp.zeros((E, P, D))
    return epistemic(jnp.asarray(base), obs, jnp.zeros(2), jnp.asarray(states))


@pytest.mark.parametrize("seed", range(5))
def test_epistemic_equals_the_reference(seed):
    states, base = particles(seed)
    got = reward(states, base)
    assert got.shape == ()
    np.testing.assert_allclose(got, reference.epistemic(states, base), rtol=1e-5)


def test_epistemic_is_zero_for_members_that_agree():
    states, base = particles()
    agreed = np.broadcast_to(states[:1], states.shape)
    # float32 keeps 1e-7 of the states' size.
    np.testing.assert_allclose(reward(agreed, base), 0.0, atol=1e-6)
    # The particles may differ, as long as their mean does not.
    turned = np.stack([np.roll(states[0], e, axis=0) for e in range(E)])
    np.testing.assert_allclose(reward(turned, base), 0.0, atol=1e-5)


def test_epistemic_falls_with_the_root_of_the_baseline():
    states, base = particles()
    np.testing.assert_allclose(
        reward(states, 4 * base), reward(states, base) / 2, rtol=1e-6
    )


def test_epistemic_has_no_unit():
    states, base = particles()
    unit = np.float32([1, 10, 1e3, 1e-3, 7, 0.1])
    np.testing.assert_allclose(
        reward(states * unit, base * unit**2), reward(states, base), rtol=1e-5
    )


def test_epistemic_forgets_the_order_of_members_and_particles():
    states, base = particles()
    want = reward(states, base)
    np.testing.assert_allclose(reward(states[[3, 1, 4, 0, 2]], base), want, rtol=1e-5)
    mixed = states.copy()
    mixed[1] = states[1, [2, 0, 3, 1]]
    np.testing.assert_allclose(reward(mixed, base), want, rtol=1e-5)
    # But a particle that changes its member changes the reward.
    mixed[0, 0], mixed[1, 0] = states[1, 0], states[0, 0]
    assert abs(reward(mixed, base) - want) > 1e-3


def test_epistemic_looks_only_at_the_state_reached():
    states, base = particles()
    got = epistemic(jnp.asarray(base), jnp.asarray(9 * states), jnp.ones(2), states)
    np.testing.assert_array_equal(got, reward(states, base))


def test_epistemic_passes_on_what_diverged():
    states, base = particles()
    states[2, 1, 3] = np.inf
    assert not np.isfinite(reward(states, base))


def test_epistemic_refuses_what_does_not_fit():
    states, base = particles()
    with pytest.raises(
        ValueError, match=r"baseline_variance must be float32\[6\], got"
    ):
        reward(states, base[:3])
    with pytest.raises(ValueError, match=r"next_obs must be float32\[E, P, D\], got"):
        reward(states[0], base)
    with pytest.raises(ValueError, match="at least 2 members, got 1"):
        reward(states[:1], base)


# -- information gain ----------------------------------------------------------------


def test_information_gain_equals_the_reference():
    states, base = particles()
    got = information_gain(jnp.asarray(base), states, jnp.zeros(2), states)
    variance = states.astype(np.float64).mean(1).var(0)
    want = np.mean(np.log(1 + variance / base.astype(np.float64))) / 2
    assert got.shape == ()
    np.testing.assert_allclose(got, want, rtol=1e-5)


def test_information_gain_of_small_disagreement_is_half_its_square():
    """And in one dimension it orders states as `epistemic` does."""
    spread = np.linspace(1e-3, 5.0, 50, dtype=np.float32)
    states = spread[:, None, None, None] * np.array([-1, 1], np.float32)[:, None, None]
    zeros = jnp.zeros((2, 1, 1))
    gains, roots = (
        jnp.stack([fn(jnp.ones(1), zeros, jnp.zeros(2), x) for x in states])
        for fn in (information_gain, epistemic)
    )
    np.testing.assert_allclose(gains[0], roots[0] ** 2 / 2, rtol=1e-4)
    assert (np.diff(gains) > 0).all() and (np.diff(roots) > 0).all()


def test_no_dimension_of_information_gain_outweighs_the_others():
    """An angle that the members see turn without bound adds its logarithm."""
    states, base = particles()
    states[..., 2] *= 1e4
    far = information_gain(jnp.asarray(base), states, jnp.zeros(2), states)
    states[..., 2] *= 10
    farther = information_gain(jnp.asarray(base), states, jnp.zeros(2), states)
    np.testing.assert_allclose(farther - far, np.log(10) / D, rtol=1e-4)


def test_information_gain_refuses_what_does_not_fit():
    states, base = particles()
    with pytest.raises(ValueError, match="at least 2 members, got 1"):
        information_gain(jnp.asarray(base), states[:1], jnp.zeros(2), states[:1])
    with pytest.raises(ValueError, match="baseline_variance must be"):
        information_gain(jnp.asarray(base[:3]), states, jnp.zeros(2), states)


# -- standard deviation ----------------------------------------------------------------


def test_ensemble_std_equals_the_reference():
    states, _ = particles()
    got = ensemble_std((), jnp.asarray(states), jnp.zeros(2), jnp.asarray(states))
    assert got.shape == ()
    want = np.float64(states).mean(1).std(0).sum()
    np.testing.assert_allclose(got, want, rtol=1e-5)
    ones = np.ones(D, np.float32)
    np.testing.assert_allclose(got, D * reward(states, ones), rtol=1e-5)


def test_ensemble_std_refuses_what_does_not_fit():
    states, _ = particles()
    with pytest.raises(ValueError, match="at least 2 members, got 1"):
        ensemble_std((), states[:1], jnp.zeros(2), states[:1])


# -- pessimism -------------------------------------------------------------------------


def first(scale, obs, action, next_obs):
    return scale * next_obs[..., 0] - jnp.sum(action**2)


@pytest.mark.parametrize("caution", [0.0, 0.7])
def test_pessimistic_equals_the_reference(caution):
    states, _ = particles()
    step = (jnp.zeros((E, P, D)), jnp.ones(2), jnp.asarray(states))
    got = pessimistic(first, caution)(jnp.float32(3), *step)
    by_member = (3 * np.float64(states)[..., 0] - 2).mean(1)
    assert got.shape == ()
    np.testing.assert_allclose(
        got, by_member.mean() - caution * by_member.std(), rtol=1e-5
    )


def test_a_pessimist_prefers_what_the_members_agree_on():
    """Of two rewards the larger wins, unless its members disagree."""
    sure, unsure = np.zeros((2, E, P, D), np.float32)
    sure[..., 0], unsure[..., 0] = 1.0, 1.5 + np.arange(-2, 3)[:, None]
    values = [
        [pessimistic(first, c)(1.0, s, jnp.zeros(2), s) for s in (sure, unsure)]
        for c in (0.0, 1.0)
    ]
    assert values[0][0] < values[0][1] and values[1][0] > values[1][1]


def test_pessimistic_refuses_what_does_not_fit():
    states, base = particles()
    for caution in (-0.1, np.inf, np.nan):
        with pytest.raises(ValueError, match="caution must be finite and at least 0"):
            pessimistic(first, caution)
    step = (jnp.asarray(states), jnp.zeros(2), jnp.asarray(states))
    with pytest.raises(ValueError, match=r"reward must be float32\[5, 4\], got"):
        pessimistic(epistemic, 1.0)(base, *step)
    with pytest.raises(ValueError, match="at least 2 members, got 1"):
        pessimistic(first, 1.0)(1.0, states[:1], jnp.zeros(2), states[:1])


# -- mixture ---------------------------------------------------------------------------


def whole(scale, obs, action, next_obs):
    """The reward `first` of the whole set."""
    return jnp.mean(first(scale, obs, action, next_obs))


@pytest.mark.parametrize("task", [first, whole])
@pytest.mark.parametrize("novelty", [epistemic, first])
def test_a_mixture_is_the_weighted_sum(task, novelty):
    """As a plan sees it, whichever of the two has reduced the particles."""
    states, base = particles()
    step = (jnp.zeros((E, P, D)), jnp.ones(2), jnp.asarray(states))
    data = jnp.asarray(base) if novelty is epistemic else jnp.float32(2)
    params = MixtureData(jnp.float32(3), data, jnp.float32(0.25))
    got = mixture(task, novelty)(params, *step)
    assert got.shape == (() if (task, novelty) == (whole, epistemic) else (E, P))
    want = np.mean(task(3, *step)) + 0.25 * np.mean(novelty(data, *step))
    np.testing.assert_allclose(np.mean(got), want, rtol=1e-5)


def test_a_mixture_refuses_what_does_not_fit():
    with pytest.raises(TypeError, match="intrinsic_fn must be a function, got"):
        mixture(first, 0.1)
    states, base = particles()
    step = (jnp.asarray(states), jnp.zeros(2), jnp.asarray(states))
    with pytest.raises(TypeError, match="params must be a MixtureData, got tuple"):
        mixture(first, epistemic)((1.0, base), *step)
    with pytest.raises(ValueError, match=r"params.weight must be float32\[\], got"):
        mixture(first, epistemic)(MixtureData(1.0, base, jnp.ones(2)), *step)
    data = MixtureData(1.0, base, jnp.float32(1))
    with pytest.raises(ValueError, match=r"intrinsic_fn must return shape \(\) or"):
        mixture(first, lambda *_: jnp.ones(P))(data, *step)
    with pytest.raises(TypeError, match="extrinsic_fn must return float32, got bool"):
        mixture(lambda *_: jnp.array(True), epistemic)(data, *step)
    assert mixture(lambda *_: 0.0, epistemic)(data, *step).shape == ()


def test_namespace_lists_what_it_has():
    for name in jaxpets.rewards.__all__:
        assert callable(getattr(jaxpets.rewards, name))
