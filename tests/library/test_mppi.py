import jax.numpy as jnp
import numpy as np
import pytest
import reference
from toys import bumpy, record

import jaxpets

ONE = jnp.ones(2)


def search(**changes):
    settings = dict(horizon=4, action_low=-ONE, action_high=ONE, num_samples=60)
    return jaxpets.optimizers.mppi(**(settings | changes))


SEARCH = search()


def scaled(actions, scale, offset):
    return scale * bumpy(actions) + offset


def test_search_equals_the_reference_on_its_samples():
    found = record(search(num_iterations=3, temperature=0.7), bumpy)
    for samples, values in zip(found.actions, found.values, strict=True):
        low, high = np.quantile(np.float64(values), [0.25, 0.75])
        mean = reference.mppi_update(samples, values, 0.7 * (high - low))
        value = reference.mppi_update(values, values, 0.7 * (high - low))
    # float32 softmax and sums.
    np.testing.assert_allclose(found.solution.actions, mean, atol=1e-5)
    np.testing.assert_allclose(found.solution.value, value, rtol=1e-4)
    want = reference.shift(mean, 0.0)
    np.testing.assert_allclose(found.state.mean, want, atol=1e-5)


def test_samples_follow_the_mean_of_the_last_iteration():
    found = record(search(num_iterations=2, std=0.05, num_samples=400), bumpy)
    low, high = np.quantile(np.float64(found.values[0]), [0.25, 0.75])
    mean = reference.mppi_update(found.actions[0], found.values[0], high - low)
    # 400 draws with deviation 0.05.
    np.testing.assert_allclose(found.actions[1].mean(0), mean, atol=0.01)
    np.testing.assert_allclose(found.actions[1].std(0), 0.05, rtol=0.2)


def test_deviation_is_relative_to_the_box():
    optimizer = search(action_low=-10 * ONE, action_high=10 * ONE, std=0.1)
    samples = record(optimizer, bumpy).actions[0]
    np.testing.assert_allclose(samples.std(), 1.0, rtol=0.15)  # 480 draws


def test_temperature_has_no_unit():
    plain, other = (
        record(SEARCH, scaled, args=(jnp.float32(scale), jnp.float32(offset)))
        for scale, offset in ((1.0, 0.0), (1000.0, -5.0))
    )
    np.testing.assert_allclose(
        plain.solution.actions, other.solution.actions, atol=1e-4
    )


def test_cold_follows_the_best_and_hot_averages():
    cold = record(search(temperature=1e-3), bumpy)
    best = cold.actions[0][np.argmax(cold.values[0])]
    np.testing.assert_allclose(cold.solution.actions, best, atol=1e-3)
    hot = record(search(temperature=1e4), bumpy)
    np.testing.assert_allclose(hot.solution.actions, hot.actions[0].mean(0), atol=1e-3)


def censored(actions, limit):
    return jnp.where(
        actions[:, 0, 0] > limit, jaxpets.optimizers.WORST_VALUE, bumpy(actions)
    )


@pytest.mark.parametrize("share", [0.1, 0.3, 0.6, 0.95])
def test_rejected_candidates_have_no_weight(share):
    """However many candidates are rejected, the plan is that of the others."""
    first = record(SEARCH, censored, args=(jnp.float32(2.0),)).actions[0][:, 0, 0]
    limit = jnp.float32(np.quantile(first, 1 - share))
    found = record(SEARCH, censored, args=(limit,))
    good = found.values[0] > -1e29
    assert 1 < good.sum() < 60
    assert found.values[0][good].min() <= found.solution.value
    assert found.solution.value <= found.values[0].max()
    assert found.solution.actions[0, 0] <= limit


def test_all_rejected_gives_a_finite_plan():
    found = record(SEARCH, censored, args=(jnp.float32(-2.0),))
    assert np.all(found.values[0] < -1e29)
    assert np.all(np.isfinite(found.solution.actions))
    assert np.isfinite(found.solution.value)


def pull(actions, sign):
    return sign * actions.sum((1, 2))


LOW, HIGH = jnp.array([-1.0, 0.5]), jnp.array([3.0, 0.75])
BOXED = search(action_low=LOW, action_high=HIGH, std=2.0, num_iterations=3)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_samples_never_leave_the_box(sign):
    found = record(BOXED, pull, args=(jnp.float32(sign),))
    for samples in [*found.actions, np.asarray(found.solution.actions)[None]]:
        assert np.all(samples >= np.asarray(LOW)) and np.all(samples <= HIGH)


def test_finds_the_optimum_of_a_quadratic(key):
    optimum = jnp.linspace(-0.6, 0.6, 8).reshape(4, 2)

    def objective(key, actions):
        return -jnp.sum((actions - optimum) ** 2, (1, 2))

    optimizer = search(num_samples=500, num_iterations=20, std=0.3, temperature=0.05)
    solution, _ = optimizer.step(objective, key, optimizer.init())
    # The noise does not shrink, so the optimum is found up to its jitter.
    np.testing.assert_allclose(solution.actions, optimum, atol=0.2)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (dict(horizon=0), "horizon must be at least 1, got 0"),
        (dict(num_samples=1), "num_samples must be at least 2, got 1"),
        (dict(num_iterations=0), "num_iterations must be at least 1, got 0"),
        (dict(std=0.0), "std must be finite and .* got 0.0"),
        (dict(temperature=0.0), "temperature must be finite and .* got 0.0"),
        (dict(action_low=ONE), "action_low and action_high .* low < high"),
    ],
)
def test_bad_settings_fail_when_built(changes, text):
    with pytest.raises(ValueError, match=text):
        search(**changes)
