"""Random actions, independent or correlated over time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

import jaxpets
from jaxpets import PlanParams

LOW, HIGH = jnp.array([-1.0, 0.0]), jnp.array([1.0, 5.0])


def test_random_planner_is_uniform_in_the_box():
    planner = jaxpets.random_planner(LOW, HIGH)
    assert planner.init() == ()
    keys = jax.random.split(jax.random.key(0), 4000)
    out, state = jax.vmap(planner.step, (None, 0, None, None))(
        PlanParams(()), keys, (), None
    )
    assert state == ()
    assert out.actions.shape == (4000, 1, 2) and not out.value.any()
    np.testing.assert_array_equal(out.action, out.actions[:, 0])
    unit = np.asarray((out.action - LOW) / (HIGH - LOW))
    assert unit.min() >= 0 and unit.max() <= 1
    # Deciles of a uniform law; the deviation of a share of 4000 draws is 0.005.
    for column in unit.T:
        share = np.histogram(column, bins=10, range=(0, 1))[0] / 4000
        np.testing.assert_allclose(share, 0.1, atol=0.025)


def test_random_planner_refuses_an_empty_box():
    with pytest.raises(ValueError, match="low < high"):
        jaxpets.random_planner(jnp.ones(1), -jnp.ones(1))


def actions_of(planner, steps, seeds=1):
    """Returns what it does in some trials, `[S, T, A]`, and its last state."""

    def trial(key):
        def body(state, key):
            out, state = planner.step(PlanParams(()), key, state, None)
            return state, out.action

        return jax.lax.scan(body, planner.init(), jax.random.split(key, steps))

    keys = jax.random.split(jax.random.key(0), seeds)
    state, actions = jax.jit(jax.vmap(trial))(keys)
    return np.asarray(actions), state


def test_coloured_actions_have_their_spectrum_and_are_uniform():
    beta, steps = 1.0, 128
    planner = jaxpets.random_planner(LOW, HIGH, noise_beta=beta, period=steps)
    actions, state = actions_of(planner, steps, seeds=300)
    assert (state.step == steps).all()
    unit = (actions - np.asarray(LOW)) / np.asarray(HIGH - LOW)
    assert unit.min() >= 0 and unit.max() <= 1
    # A uniform law bends the spectrum of a Gaussian one a little.
    slope = reference.spectrum_slope(unit.swapaxes(1, 2) - 0.5)
    assert slope == pytest.approx(-beta, abs=0.15)
    # Steps of one trial are alike: the 300 trials count, with a deviation of 0.02.
    share = np.histogram(unit[..., 0], bins=10, range=(0, 1))[0] / unit[..., 0].size
    np.testing.assert_allclose(share, 0.1, atol=0.05)
    # One entry of the action says nothing about the other, up to 0.06 in 300 trials.
    both = np.corrcoef(unit.mean(1).T)[0, 1]
    assert abs(both) < 0.2


def test_coloured_noise_is_drawn_anew_after_its_period():
    planner = jaxpets.random_planner(LOW, HIGH, noise_beta=2.0, period=4)
    actions, state = actions_of(planner, 10)
    assert state.step[0] == 2  # of the third sequence
    once, _ = actions_of(planner, 4)
    np.testing.assert_allclose(actions[0, :2], once[0, :2], rtol=1e-6)
    assert len(np.unique(actions[0, :, 0])) == 10


def test_coloured_noise_refuses_what_does_not_fit():
    with pytest.raises(ValueError, match="noise_beta must be finite and at least 0"):
        jaxpets.random_planner(LOW, HIGH, noise_beta=-1.0)
    with pytest.raises(ValueError, match="period must be at least 2, got 1"):
        jaxpets.random_planner(LOW, HIGH, noise_beta=1.0, period=1)
    planner, other = (
        jaxpets.random_planner(LOW, HIGH, noise_beta=1.0, period=n) for n in (4, 5)
    )
    key = jax.random.key(0)
    with pytest.raises(ValueError, match=r"state.noise must be float32\[4, 2\], got"):
        planner.step(PlanParams(()), key, other.init(), None)
    with pytest.raises(TypeError, match="state must be a ColoredNoise, got tuple"):
        planner.step(PlanParams(()), key, (), None)
