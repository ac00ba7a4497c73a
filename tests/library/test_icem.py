import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from toys import assert_trees_close, bumpy, record

import jaxpets
from jaxpets._src import icem

ONE = jnp.ones(2)
colored_noise = jax.jit(icem.colored_noise, static_argnums=2)


def search(**changes):
    settings = dict(
        horizon=6,
        action_low=-ONE,
        action_high=ONE,
        num_samples=60,
        num_elites=8,
        num_iterations=3,
        kept_fraction=0.5,
    )
    return jaxpets.optimizers.icem(**(settings | changes))


SEARCH = search()


def rows(sequences):
    """Sequences as a set of hashable rows."""
    return {sequence.tobytes() for sequence in np.asarray(sequences)}


@pytest.mark.parametrize("execute_best", [True, False])
def test_few_left_of_many_rejected_make_the_plan(execute_best):
    def value(actions):
        return jnp.where(actions[:, 0, 0] < 0.9, jaxpets.optimizers.WORST_VALUE, 1.0)

    optimizer = search(num_iterations=1, momentum=0.0, execute_best=execute_best)
    found = record(optimizer, value)
    assert 0 < (found.values[0] > 0).sum() < 8
    assert found.solution.value == 1.0
    assert found.solution.actions[0, 0] >= 0.9


# -- noise ---------------------------------------------------------------------------


@pytest.mark.parametrize("beta", [0.0, 1.0, 2.0, 3.0])
def test_noise_has_its_colour(beta):
    noise = colored_noise(jax.random.key(1), beta, (2000, 64, 2))
    slope = reference.spectrum_slope(np.asarray(noise).swapaxes(1, 2))
    # 4000 series: the mean power of a frequency is known to 2 %.
    np.testing.assert_allclose(slope, -beta, atol=0.05)


@pytest.mark.parametrize("horizon", [1, 2, 15, 30])
@pytest.mark.parametrize("beta", [0.0, 2.0])
def test_noise_has_unit_variance_at_every_step(horizon, beta):
    noise = colored_noise(jax.random.key(2), beta, (20_000, horizon, 1))
    assert noise.shape == (20_000, horizon, 1) and noise.dtype == jnp.float32
    noise = np.asarray(noise)
    # The variance of 20,000 draws has a deviation of 1 %.
    np.testing.assert_allclose(np.var(noise, axis=0), 1.0, atol=0.05)
    np.testing.assert_allclose(np.mean(noise, axis=0), 0.0, atol=0.04)


def test_steep_noise_keeps_its_variance():
    noise = colored_noise(jax.random.key(3), 30.0, (4000, 30, 1))
    np.testing.assert_allclose(np.var(np.asarray(noise)), 1.0, atol=0.1)


def test_noise_is_independent_across_actions_and_samples():
    noise = np.asarray(colored_noise(jax.random.key(4), 2.0, (8000, 10, 3)))
    for step in (0, 5):
        correlation = np.corrcoef(noise[:, step].T)
        # The deviation of a correlation of 8000 pairs is 0.011.
        np.testing.assert_allclose(correlation, np.eye(3), atol=0.05)
    halves = np.corrcoef(noise[:4000, 0, 0], noise[4000:, 0, 0])
    np.testing.assert_allclose(halves, np.eye(2), atol=0.08)


def test_red_noise_is_smoother_than_white():
    def roughness(beta):
        noise = np.asarray(colored_noise(jax.random.key(5), beta, (500, 30, 1)))
        return float(np.mean(np.diff(noise, axis=1) ** 2))

    assert roughness(2.0) < 0.3 * roughness(0.0)


# -- search --------------------------------------------------------------------------


def test_search_equals_the_reference_on_its_samples():
    found = record(search(momentum=0.2, kept_fraction=0.0), bumpy)
    mean, std = np.zeros((6, 2)), np.full((6, 2), 0.5)
    for samples, values in zip(found.actions, found.values, strict=True):
        # iCEM smooths the deviation where CEM smooths the variance.
        order = np.argsort(-np.float64(values))[:8]
        elites = np.float64(samples[order])
        mean = 0.2 * mean + 0.8 * elites.mean(0)
        std = 0.2 * std + 0.8 * elites.std(0)
    np.testing.assert_allclose(found.solution.actions, mean, atol=1e-5)
    last = np.sort(found.values[-1])[-8:]
    np.testing.assert_allclose(found.solution.value, last.mean(), rtol=1e-5)
    want = reference.shift(mean, 0.0)
    np.testing.assert_allclose(found.state.mean, want, atol=1e-5)


def test_population_shrinks_to_twice_the_elites():
    optimizer = search(num_iterations=5, decay=1.6, num_samples=60, num_elites=8)
    sizes = [len(actions) for actions in record(optimizer, bumpy).actions]
    fresh = [max(int(60 / 1.6**i), 16) for i in range(5)]
    kept = 4
    want = [size + kept for size in fresh]
    want[-1] += 1  # the mean itself
    assert sizes == want


def test_of_a_steep_decay_twice_the_elites_are_left():
    optimizer = search(num_iterations=12, decay=1e30, num_samples=60, num_elites=8)
    sizes = [len(actions) for actions in record(optimizer, bumpy).actions]
    assert sizes == [64, *[20] * 10, 21]


@pytest.mark.parametrize("num_iterations", [1, 5])
@pytest.mark.parametrize("execute_best", [True, False])
def test_a_loop_is_the_same_search(num_iterations, execute_best):
    settings = dict(decay=1.6, num_iterations=num_iterations, execute_best=execute_best)
    want = record(search(**settings), bumpy)
    got = record(search(unroll=False, **settings), bumpy)
    assert [len(actions) for actions in got.actions] == num_iterations * [60 + 4 + 1]
    pairs = zip(want.actions, got.actions, strict=True)
    for i, (few, many) in enumerate(pairs, start=1):
        num_fresh = len(few) - 4 - (i == num_iterations)
        np.testing.assert_allclose(many[:num_fresh], few[:num_fresh], atol=1e-5)
    # A loop rounds otherwise; elites are the same.
    assert_trees_close(got.solution, want.solution, rtol=1e-4, atol=1e-5)
    assert_trees_close(got.state, want.state, rtol=1e-4, atol=1e-5)


def test_elites_are_kept_within_a_call():
    found = record(SEARCH, bumpy)
    for i in range(2):
        best = np.argsort(-found.values[i])[:4]
        kept = rows(found.actions[i][best])
        assert kept <= rows(found.actions[i + 1])
    best = [values.max() for values in found.values]
    assert best == sorted(best)  # the best is never lost


def test_elites_enter_the_next_call_shifted():
    first = record(SEARCH, bumpy)
    best = first.actions[-1][np.argsort(-first.values[-1])[:4]]
    want = np.concatenate([best[:, 1:], np.zeros((4, 1, 2), np.float32)], axis=1)
    np.testing.assert_array_equal(first.state.elites, want)
    second = record(SEARCH, bumpy, first.state, seed=1)
    assert rows(want) <= rows(second.actions[0])


def test_last_iteration_tries_the_mean():
    found = record(search(num_iterations=2, momentum=0.0, kept_fraction=0.0), bumpy)
    elites = found.actions[0][np.argsort(-found.values[0])[:8]]
    distance = np.abs(found.actions[1] - elites.mean(0)).max((1, 2))
    assert distance.min() < 1e-6  # one rounding


def test_execute_best_returns_the_best_of_the_last_iteration():
    found = record(search(execute_best=True), bumpy)
    best = found.actions[-1][np.argmax(found.values[-1])]
    np.testing.assert_array_equal(found.solution.actions, best)


def pull(actions, sign):
    return sign * actions.sum((1, 2))


LOW, HIGH = jnp.array([-1.0, 0.5]), jnp.array([3.0, 0.75])
BOXED = search(action_low=LOW, action_high=HIGH, init_std=2.0)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_samples_never_leave_the_box(sign):
    found = record(BOXED, pull, args=(jnp.float32(sign),))
    for samples in [*found.actions, np.asarray(found.solution.actions)[None]]:
        assert np.all(samples >= np.asarray(LOW)) and np.all(samples <= HIGH)


def test_initial_deviation_is_relative_to_the_box():
    optimizer = search(
        action_low=-10 * ONE,
        action_high=10 * ONE,
        num_samples=4000,
        num_iterations=1,
        init_std=0.2,
        kept_fraction=0.0,
    )
    samples = record(optimizer, bumpy).actions[0]
    # 0.2 of the half width; at five deviations nothing is clipped.
    np.testing.assert_allclose(samples.std(), 2.0, rtol=0.05)


def test_finds_the_optimum_of_a_quadratic(key):
    optimum = jnp.linspace(-0.8, 0.8, 12).reshape(6, 2)

    def objective(key, actions):
        return -jnp.sum((actions - optimum) ** 2, (1, 2))

    optimizer = search(num_samples=400, num_elites=20, num_iterations=5, noise_beta=1.0)
    solution, _ = jax.jit(lambda k: optimizer.step(objective, k, optimizer.init()))(key)
    np.testing.assert_allclose(solution.actions, optimum, atol=0.15)


def test_first_state_holds_the_middle_of_the_box():
    optimizer = search(action_low=jnp.zeros(2), action_high=2 * ONE)
    state = optimizer.init()
    assert state.elites.shape == (4, 6, 2)
    for leaf in state:
        np.testing.assert_array_equal(leaf, 1.0)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (dict(horizon=0), "horizon must be at least 1, got 0"),
        (dict(num_elites=1), "num_elites must be at least 2, got 1"),
        (dict(num_samples=7), "num_samples must be at least num_elites, 8, got 7"),
        (dict(num_iterations=0), "num_iterations must be at least 1, got 0"),
        (dict(momentum=-0.1), r"momentum must be in \[0, 1\], got -0.1"),
        (dict(noise_beta=-1.0), "noise_beta must be finite and .* got -1.0"),
        (dict(init_std=0.0), "init_std must be finite and .* got 0.0"),
        (dict(kept_fraction=1.1), r"kept_fraction must be in \[0, 1\], got 1.1"),
        (dict(decay=0.5), "decay must be finite and .* got 0.5"),
        (dict(action_low=ONE), "action_low and action_high .* low < high"),
    ],
)
def test_bad_settings_fail_when_built(changes, text):
    with pytest.raises(ValueError, match=text):
        search(**changes)
