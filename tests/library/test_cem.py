import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from toys import bumpy, record

import jaxpets

ONE = jnp.ones(2)
# A box that is neither symmetric nor square.
LOW, HIGH = jnp.array([-1.0, 0.5]), jnp.array([3.0, 0.75])


def search(**changes):
    settings = dict(
        horizon=4,
        action_low=-ONE,
        action_high=ONE,
        num_samples=40,
        num_elites=6,
        num_iterations=4,
    )
    return jaxpets.optimizers.cem(**(settings | changes))


def quadratic(optimum):
    def objective(key, actions):
        del key
        return -jnp.sum((actions - optimum) ** 2, (1, 2))

    return objective


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("box", [(-ONE, ONE), (LOW, HIGH)])
def test_search_equals_the_reference_on_its_samples(box, legacy):
    low, high = (np.asarray(bound, np.float64) for bound in box)
    optimizer = search(
        action_low=box[0], action_high=box[1], momentum=0.3, legacy_variance=legacy
    )
    found = record(optimizer, bumpy)
    mean = np.broadcast_to((low + high) / 2, (4, 2))
    variance = np.broadcast_to(reference.initial_variance(low, high), (4, 2))
    for samples, values in zip(found.actions, found.values, strict=True):
        # Samples are the mean plus unit noise times the narrowed deviation.
        std = np.sqrt(reference.constrained_variance(mean, variance, low, high))
        unit = (samples - mean) / std
        assert np.abs(unit).max() <= 2.0 + 1e-3  # float32 rounding over a small std
        # Cut at two deviations the normal has variance 0.774; 320 draws, 4 sigma.
        assert abs(unit.std() - 0.880) < 0.12 and abs(unit.mean()) < 0.2
        mean, variance = reference.cem_update(
            mean, variance, samples, values, 6, 0.3, legacy=legacy
        )
    # float32 against float64, four updates deep.
    np.testing.assert_allclose(found.solution.actions, mean, atol=1e-5)
    last = np.sort(found.values[-1])[-6:]
    np.testing.assert_allclose(found.solution.value, last.mean(), rtol=1e-5)
    fill = (low + high) / 2
    np.testing.assert_allclose(found.state.mean, reference.shift(mean, fill), atol=1e-5)


@pytest.mark.parametrize("num_iterations", [1, 4])
def test_unrolled_search_is_the_loop(num_iterations):
    """The same samples, elites and plan, to the rounding of other programs."""
    loop = record(search(num_iterations=num_iterations), bumpy)
    written_out = record(search(num_iterations=num_iterations, unroll=True), bumpy)
    assert len(written_out.actions) == num_iterations
    for name in ("actions", "values"):
        pair = getattr(written_out, name), getattr(loop, name)
        np.testing.assert_allclose(*pair, atol=1e-6)
    pair = written_out.solution.actions, loop.solution.actions
    np.testing.assert_allclose(*pair, atol=1e-6)


def test_unroll_compiles_every_iteration():
    def num_selections(unroll):
        optimizer = search(num_iterations=3, unroll=unroll)

        @jax.jit
        def step(key):
            return optimizer.step(quadratic(ONE), key, optimizer.init())

        text = step.lower(jax.random.key(0)).compile().as_text()
        return len(re.findall(r"top_k\b|sort\(|TopK", text))

    assert num_selections(unroll=True) == 3 * num_selections(unroll=False) > 0
    assert num_selections(unroll=np.True_) == num_selections(unroll=True)
    assert num_selections(unroll=np.False_) == num_selections(unroll=False)


def test_legacy_variance_narrows_faster():
    def last_spread(legacy):
        optimizer = search(momentum=0.6, legacy_variance=legacy, num_iterations=6)
        return record(optimizer, bumpy).actions[-1].std(0).mean()

    assert last_spread(True) < 0.7 * last_spread(False)


def test_samples_of_an_iteration_use_fresh_noise():
    samples = record(search(momentum=1.0, min_variance=0.0), bumpy).actions
    assert not np.allclose(samples[0], samples[1])


def test_search_starts_from_the_state():
    mean = jnp.full((4, 2), 0.9)
    samples = record(search(), bumpy, jaxpets.optimizers.CEMState(mean)).actions[0]
    # The margin to the bound is 0.1, so two deviations reach from 0.8 to 1.
    assert samples.min() >= 0.8 - 1e-6
    np.testing.assert_allclose(samples.mean(0), mean, atol=0.03)


def test_min_variance_freezes_as_the_early_stop_did():
    """The plan is that of the reference, which stops searching."""
    optimizer = search(min_variance=0.02, num_iterations=8, num_samples=60)
    found = record(optimizer, lambda a: -jnp.sum(a**2, (1, 2)))
    mean, variance = np.zeros((4, 2)), np.full((4, 2), 0.25)
    updates = 0
    for samples, values in zip(found.actions, found.values, strict=True):
        if variance.max() <= 0.02:
            break
        mean, variance = reference.cem_update(mean, variance, samples, values, 6, 0.1)
        updates += 1
    assert 1 < updates < 8  # the case is the one meant
    np.testing.assert_allclose(found.solution.actions, mean, atol=1e-5)


def test_min_variance_is_relative_to_the_box():
    wide = record(
        search(action_low=-10 * ONE, action_high=10 * ONE, min_variance=0.02),
        lambda a: -jnp.sum(a**2, (1, 2)) / 100,
    ).solution.actions
    unit = record(search(min_variance=0.02), lambda a: -jnp.sum(a**2, (1, 2)))
    np.testing.assert_allclose(wide, 10 * unit.solution.actions, rtol=1e-4, atol=1e-5)


def pull(actions, sign):
    return sign * actions.sum((1, 2))


BOXED = search(action_low=LOW, action_high=HIGH, num_samples=500, num_elites=50)


@pytest.mark.parametrize("start", [-1.0, 1.0])
def test_samples_never_leave_the_box(start):
    mean = jnp.broadcast_to(jnp.where(start > 0, HIGH, LOW), (4, 2))
    # Rewards pull outwards, and one search starts on the bound itself.
    for state in (BOXED.init(), jaxpets.optimizers.CEMState(mean)):
        found = record(BOXED, pull, state, args=(jnp.float32(start),))
        for samples in [*found.actions, np.asarray(found.solution.actions)[None]]:
            assert np.all(samples >= np.asarray(LOW))
            assert np.all(samples <= np.asarray(HIGH))


def test_finds_the_optimum_of_a_quadratic(key):
    optimum = jnp.linspace(-0.8, 0.8, 8).reshape(4, 2)
    optimizer = search(num_samples=500, num_elites=50, num_iterations=10)
    solution, _ = optimizer.step(quadratic(optimum), key, optimizer.init())
    np.testing.assert_allclose(solution.actions, optimum, atol=0.05)
    assert -0.05 < solution.value <= 0


def test_an_optimum_outside_lands_on_the_bound(key):
    optimizer = search(num_samples=500, num_elites=50, num_iterations=15)
    solution, _ = optimizer.step(quadratic(5.0), key, optimizer.init())
    # The narrowed deviation halves with the margin, so the bound is approached slowly.
    np.testing.assert_allclose(solution.actions, 1.0, atol=0.1)
    assert jnp.all(solution.actions <= 1.0)


def test_rejected_candidates_are_no_elites():
    """Nine tenths of the candidates are rejected; more than num_elites are left."""

    def value(actions):
        bad = actions[:, 0, 0] > -0.4
        return jnp.where(
            bad, jaxpets.optimizers.WORST_VALUE, -jnp.abs(actions[:, 0, 0] + 0.7)
        )

    found = record(search(num_samples=200, num_iterations=1), value)
    solution = found.solution
    assert (found.values[0] < -1e29).mean() > 0.7
    assert solution.value > -1.0
    # 0.9 of the elites' mean, which lies around -0.7, plus 0.1 of the old mean, 0.
    assert -0.9 < solution.actions[0, 0] < -0.4


NUMBERS = {
    "cem": ("momentum", "min_variance"),
    "icem": ("momentum", "noise_beta", "init_std"),
    "mppi": ("std", "temperature"),
}


@pytest.mark.parametrize("name", NUMBERS)
def test_draws_in_float32_where_64_bits_are_enabled(name):
    """Also where its numbers are of 64 bits, as NumPy's are."""
    numbers = {x: np.float64(0.1) for x in NUMBERS[name]}
    build = getattr(jaxpets.optimizers, name)
    with jax.enable_x64(True):
        optimizer = build(horizon=5, action_low=-ONE, action_high=ONE, **numbers)
        solution, _ = optimizer.step(
            lambda key, actions: -jnp.sum(actions**2, (1, 2)),
            jax.random.key(0),
            optimizer.init(),
        )
    assert solution.actions.dtype == solution.value.dtype == jnp.float32


def test_few_left_of_many_rejected_make_the_plan():
    """Fewer than num_elites are left: the plan is their mean, not that of the rest."""

    def value(actions):
        return jnp.where(actions[:, 0, 0] < 0.75, jaxpets.optimizers.WORST_VALUE, 1.0)

    found = record(search(num_samples=60, num_iterations=1, momentum=0.0), value)
    assert 0 < (found.values[0] > 0).sum() < 6
    assert found.solution.value == 1.0
    assert found.solution.actions[0, 0] >= 0.75


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (dict(horizon=0), "horizon must be at least 1, got 0"),
        (dict(num_elites=1), "num_elites must be at least 2, got 1"),
        (dict(num_samples=5), "num_samples must be at least num_elites, 6, got 5"),
        (dict(num_iterations=0), "num_iterations must be at least 1, got 0"),
        (dict(momentum=1.5), r"momentum must be in \[0, 1\], got 1.5"),
        (dict(min_variance=-1.0), "min_variance must be finite and .* got -1.0"),
        (dict(action_low=ONE), "action_low and action_high .* low < high"),
        (dict(action_high=jnp.ones(3)), r"action_high must be \[2\] as"),
    ],
)
def test_bad_settings_fail_when_built(changes, text):
    with pytest.raises(ValueError, match=text):
        search(**changes)


def test_bad_types_fail_when_built():
    with pytest.raises(TypeError, match="num_samples must be a Python int"):
        search(num_samples=40.0)
    with pytest.raises(TypeError, match="unroll must be True or False, got"):
        search(unroll=2)
