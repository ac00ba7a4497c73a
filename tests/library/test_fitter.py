import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import reference
import toys
from toys import dataset_of

import jaxpets
from jaxpets import FitConfig

CAPACITY = 40


# -- which rows are shown ------------------------------------------------------------


@pytest.fixture(scope="module")
def shown_rows(model, params):
    """Which rows each member sees in two epochs: `[2, batches, E, 8]`, and weights.

    The targets carry the row's number; the loss reports what it was given.
    """
    seen = []

    def report(targets, weight):
        seen.append((np.asarray(targets[..., 0], int), np.asarray(weight)))

    def loss(network, inputs, targets, weight):
        jax.debug.callback(report, targets, weight, ordered=True)
        return model.loss(network, inputs, targets, weight)

    def build(bootstrap):
        config = FitConfig(num_epochs=2, batch_size=8, bootstrap=bootstrap)
        fitter = jaxpets.fitter(model._replace(loss=loss), optax.sgd(0.0), config)
        return fitter.init(params), jax.jit(fitter.step)

    built = {bootstrap: build(bootstrap) for bootstrap in (True, False)}

    def run(size, seed=0, bootstrap=True):
        state, step = built[bootstrap]
        number = np.arange(size, dtype=np.float32)[:, None] + np.zeros(
            (1, 2), np.float32
        )
        data = jaxpets.Transition(0 * number, 0 * number[:, :1], number)
        seen.clear()
        step(params, jax.random.key(seed), state, dataset_of(data))
        jax.effects_barrier()
        full = [batch for batch in seen if batch[1].any()]  # some have no rows
        return tuple(
            np.stack(x).reshape(2, -1, *x[0].shape) for x in zip(*full, strict=True)
        )

    return run


@pytest.mark.parametrize("size", [1, 8, 19, 40])
def test_an_epoch_shows_each_member_its_bootstrap_once(shown_rows, size):
    rows, weights = shown_rows(size)
    epochs, batches, members, _ = rows.shape
    assert (epochs, batches, members) == (2, -(-size // 8), 3)
    used = weights > 0
    assert used.sum((1, 2)).tolist() == [size, size]
    bootstraps = []
    for e in range(members):
        epoch_rows = [rows[i, :, e][used[i]] for i in range(epochs)]
        assert all(0 <= r < size for r in np.concatenate(epoch_rows))
        # The same bootstrap in every epoch, in another order.
        assert sorted(epoch_rows[0]) == sorted(epoch_rows[1])
        if size > 8:
            assert epoch_rows[0].tolist() != epoch_rows[1].tolist()
        bootstraps.append(sorted(epoch_rows[0]))
    if size > 8:
        assert bootstraps[0] != bootstraps[1] != bootstraps[2]


@pytest.mark.parametrize("size", [1, 19, 40])
def test_without_a_bootstrap_every_member_sees_every_row_in_an_order_of_its_own(
    shown_rows, size
):
    rows, weights = shown_rows(size, bootstrap=False)
    used = weights > 0
    orders = {tuple(rows[i, :, e][used[i]]) for i in range(2) for e in range(3)}
    assert all(sorted(order) == list(range(size)) for order in orders)
    if size > 8:
        assert len(orders) == 6


def test_the_last_batch_is_weighted_by_what_is_left(shown_rows):
    _, weights = shown_rows(19)
    want = [np.full(8, 1 / 8), np.full(8, 1 / 8), [1 / 3] * 3 + [0.0] * 5]
    np.testing.assert_allclose(weights[0], want, rtol=1e-6)


def test_bootstraps_are_drawn_with_replacement(shown_rows):
    missed = []
    for seed in range(5):
        rows, _ = shown_rows(CAPACITY, seed)
        for e in range(3):
            missed.append(1 - len(np.unique(rows[0, :, e])) / CAPACITY)
    # (1 - 1/40)^40 = 0.363 of the rows are never drawn; 15 bootstraps of 40.
    assert abs(np.mean(missed) - 0.363) < 0.06


# -- updates -------------------------------------------------------------------------


def train_once(model, params, data, rate):
    """One epoch of plain gradient descent, and what it was shown."""
    seen = []

    def keep(targets, weight):
        seen.append((np.asarray(targets), np.asarray(weight)))

    def loss(network, inputs, targets, weight):
        jax.debug.callback(keep, targets, weight, ordered=True)
        return model.loss(network, inputs, targets, weight)

    config = FitConfig(num_epochs=1, batch_size=8)
    fitter = jaxpets.fitter(model._replace(loss=loss), optax.sgd(rate), config)
    new, _, metrics = jax.jit(fitter.step)(
        params, jax.random.key(0), fitter.init(params), dataset_of(data)
    )
    jax.effects_barrier()
    return new, metrics, [batch for batch in seen if batch[1].any()]


def test_partial_batch_equals_the_reference_on_its_rows(model, params):
    """Five rows in a batch of eight: loss and update of these five, with repeats."""
    data = toys.transitions(5)
    new, metrics, [(shown, weight)] = train_once(model, params, data, 0.1)
    changes = np.asarray(data.next_obs - data.obs)
    distance = np.abs(shown[:, weight > 0, None] - changes).max(-1)
    picks = distance.argmin(-1)
    assert picks.shape == (3, 5) and distance.min(-1).max() < 1e-6
    raw = np.concatenate([data.obs, data.action], axis=-1)
    mean, std = reference.input_scaler(np.float64(raw))
    layers = [params.network.members["params"][f"layer_{i}"] for i in range(3)]
    _, want = reference.pets_loss(
        [layer["kernel"] for layer in layers],
        [layer["bias"] for layer in layers],
        params.network.min_logvar,
        params.network.max_logvar,
        (mean, std),
        raw[picks],
        changes[picks],
        decays=(1e-4, 2e-4, 3e-4),
    )
    np.testing.assert_allclose(metrics.nll, want, rtol=1e-5)
    assert metrics.num_updates == 1 and metrics.num_skipped == 0
    # And the step is the gradient over exactly these rows.
    inputs = jnp.asarray((raw[picks] - mean) / std, jnp.float32)
    fifth = jnp.full((5,), 0.2, jnp.float32)
    gradient = jax.jit(jax.grad(model.loss, has_aux=True))
    grads, _ = gradient(params.network, inputs, jnp.asarray(changes[picks]), fifth)
    stepped = jax.tree.map(lambda p, g: p - 0.1 * g, params.network, grads)
    toys.assert_trees_close(new.network, stepped, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("size", [1, 8, 9, 40])
def test_counts_its_updates(step, fitter, params, size):
    dataset = dataset_of(toys.transitions(size))
    state = fitter.init(params)
    _, state, metrics = step(params, jax.random.key(0), state, dataset)
    assert metrics.num_updates == 3 * -(-size // 8)
    assert int(state.opt_state[0].count) == metrics.num_updates


@pytest.mark.parametrize("final", [1.0, 0.5, 0.0])
def test_the_rate_falls_along_a_cosine_in_every_call(model, params, final):
    """A loss of slope 1 and steps of size 1 add up the rates of all updates."""
    sloped = model._replace(
        loss=lambda network, *_: (jnp.sum(network.min_logvar), (jnp.zeros(()),) * 2)
    )
    config = FitConfig(num_epochs=3, batch_size=8, final_rate=final)
    fitter = jaxpets.fitter(sloped, optax.sgd(1.0), config)
    step, dataset = jax.jit(fitter.step), dataset_of(toys.transitions(29))
    count = 3 * 4
    # The cosines of k pi / n, k = 0 to n - 1, sum to 1.
    want = count * final + (1 - final) * (count + 1) / 2
    first, state, _ = step(params, jax.random.key(0), fitter.init(params), dataset)
    second, _, _ = step(first, jax.random.key(1), state, dataset)
    for before, after in ((params, first), (first, second)):
        fell = before.network.min_logvar - after.network.min_logvar
        np.testing.assert_allclose(fell, want, rtol=1e-5)


def test_growing_data_do_not_retrace(model, params):
    fitter = jaxpets.fitter(
        model, optax.adam(1e-3), FitConfig(num_epochs=1, batch_size=8)
    )
    step, append = jax.jit(fitter.step), jax.jit(jaxpets.datasets.append)
    state, dataset = fitter.init(params), jaxpets.datasets.init(CAPACITY, 2, 1)
    for trial in range(4):
        dataset = append(dataset, toys.transitions(12, seed=trial))
        key = jax.random.key(trial)
        params, state, _ = step(params, key, state, dataset)
    assert step._cache_size() == 1


def test_training_goes_on_where_it_stopped(step, fitter, params):
    dataset = dataset_of(toys.transitions(40))
    first, state, before = step(params, jax.random.key(0), fitter.init(params), dataset)
    _, state, after = step(first, jax.random.key(1), state, dataset)
    assert after.nll < before.nll
    assert int(state.opt_state[0].count) == 30  # Adam's moments are kept, too


def test_no_data_change_nothing(step, fitter, params):
    empty = jaxpets.datasets.init(CAPACITY, 2, 1)
    after, _, metrics = step(params, jax.random.key(0), fitter.init(params), empty)
    toys.assert_trees_close(after, params, rtol=0)
    assert metrics.num_updates == 0 and jnp.isnan(metrics.nll)


@pytest.mark.slow
def test_fits_a_linear_gaussian_system():
    """The mean is the true one and the variance the noise's, on data not seen."""
    rng = np.random.default_rng(0)
    noise = np.array([0.05, 0.2])

    def system(size):
        obs = rng.normal(size=(size, 2))
        action = rng.uniform(-1, 1, size=(size, 1))
        mean = obs @ np.array([[0.9, -0.2], [0.1, 0.8]]) + action * [0.5, -0.3]
        rows = (obs, action, mean + noise * rng.normal(size=obs.shape))
        return [np.float32(x) for x in rows], mean

    rows, _ = system(1000)
    model = toys.small_ensemble(
        hidden_sizes=(32, 32), weight_decays=(0.0, 0.0, 0.0), bound_decay=0.01
    )
    config = FitConfig(num_epochs=60, batch_size=32)
    fitter = jaxpets.fitter(model, optax.adam(3e-3), config)
    params = jax.jit(model.init)(jax.random.key(0))
    dataset = dataset_of(jaxpets.Transition(*rows), 1000)
    params, _, metrics = jax.jit(fitter.step)(
        params, jax.random.key(1), fitter.init(params), dataset
    )
    (obs, action, _), mean = system(500)
    shared = jnp.broadcast_to(obs, (3, 500, 2))
    got, variance = jax.jit(model.predict)(params, shared, action)
    error = np.asarray(got) - mean
    # A tenth of the signal's deviation; a network of 32 on 1000 noisy rows.
    assert np.sqrt((error**2).mean()) < 0.06
    np.testing.assert_allclose(np.sqrt(np.median(variance, (0, 1))), noise, rtol=0.25)
    assert metrics.num_skipped == 0
    # w_base has come down from exp(0.5) to the scale of the noise.
    assert jnp.all(jaxpets.rewards.max_variance(params) < 1.0)


def test_bootstraps_make_members_differ(model, params, step, fitter):
    """Members that start equal end unequal."""
    same = jax.tree.map(
        lambda x: jnp.broadcast_to(x[:1], x.shape), params.network.members
    )
    network = params.network._replace(members=same)
    start = params._replace(network=network)
    dataset = dataset_of(toys.transitions(40))
    after, _, _ = step(start, jax.random.key(0), fitter.init(start), dataset)
    for leaf in jax.tree.leaves(after.network.members):
        first, second, third = np.asarray(leaf)
        assert np.any(first != second) and np.any(second != third)


def test_vmapped_seeds_equal_single_runs(model, fitter, step):
    keys = jax.random.split(jax.random.key(7), 3)
    all_params = jax.jit(jax.vmap(model.init))(keys)
    sizes = (40, 13, 24)
    sets = [dataset_of(toys.transitions(n, seed=n)) for n in sizes]
    stacked = jax.tree.map(lambda *x: np.stack(x), *sets)
    states = jax.jit(jax.vmap(fitter.init))(all_params)
    got = jax.jit(jax.vmap(fitter.step))(all_params, keys, states, stacked)
    for i in range(3):
        pick = lambda x, i=i: np.asarray(np.asarray(x)[i])  # noqa: E731
        one = jax.tree.map(pick, all_params)
        want = step(one, keys[i], fitter.init(one), sets[i])
        # Batched products round otherwise; fifteen updates.
        toys.assert_trees_close(jax.tree.map(pick, got), want, rtol=1e-3, atol=1e-4)
