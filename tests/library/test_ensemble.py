import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import toys

import jaxpets
from jaxpets import EnsembleConfig, Precision
from jaxpets._src.ensemble_config import layer_decays
from jaxpets.models import by_means, without_noise

E, B, D, A = 3, 7, 2, 1


@pytest.fixture(scope="module")
def model():
    return toys.small_ensemble()


@pytest.fixture(scope="module")
def params(model):
    """Parameters of which none is at a special value."""
    params = jax.jit(model.init)(jax.random.key(0))
    leaves, tree = jax.tree.flatten(params.network)
    rng = np.random.default_rng(0)
    moved = [
        x + np.float32(0.3 * rng.normal(size=x.shape)) for x in map(np.asarray, leaves)
    ]
    moved = list(map(jnp.asarray, moved))
    network = jax.tree.unflatten(tree, moved)
    data = toys.transitions(50)
    return params._replace(
        network=network, scaler=jax.jit(model.fit_scaler)(data, jnp.int32(50))
    )


def layers(network):
    """Kernels and biases, one entry a layer."""
    stack = network.members["params"]
    named = [stack[f"layer_{i}"] for i in range(len(stack))]
    return [x["kernel"] for x in named], [x["bias"] for x in named]


def batch(seed=0):
    rng = np.random.default_rng(seed)
    obs = jnp.asarray(rng.normal(size=(E, B, D)), jnp.float32)
    return obs, jnp.asarray(rng.uniform(-1, 1, size=(B, A)), jnp.float32)


# -- network and loss ----------------------------------------------------------------


def test_predict_equals_the_reference(model, params):
    obs, action = batch()
    mean, variance = jax.jit(model.predict)(params, obs, action)
    kernels, biases = layers(params.network)
    scaler = params.scaler
    for e in range(E):
        inputs = np.concatenate([obs[e], action], axis=-1)
        want, raw = reference.forward(
            [k[e] for k in kernels],
            [b[e] for b in biases],
            (np.float64(inputs) - scaler.mean) / scaler.std,
        )
        low, high = params.network.min_logvar, params.network.max_logvar
        logvar = reference.bound_logvar(raw, np.float64(low), np.float64(high))
        # float32 through three layers of 16.
        np.testing.assert_allclose(mean[e], obs[e] + want, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(variance[e], np.exp(logvar), rtol=1e-4)


@pytest.mark.parametrize(
    ("name", "activate"),
    [
        ("tanh", np.tanh),
        ("relu", lambda x: np.maximum(x, 0.0)),
        # Hendrycks and Gimpel, 2016.
        ("gelu", lambda x: x / 2 * (1 + np.tanh((2 / np.pi) ** 0.5
                                                * (x + 0.044715 * x**3)))),
    ],
)  # fmt: skip
def test_units_of_other_kinds_equal_the_reference(name, activate):
    model = toys.small_ensemble(activation=name)
    params = jax.jit(model.init)(jax.random.key(3))
    obs, action = np.ones((3, 1, 2), np.float32), np.full((1, 1), -0.5, np.float32)
    mean, _ = jax.jit(model.predict)(params, obs, action)
    kernels, biases = layers(params.network)
    for e in range(3):
        inputs = np.concatenate([obs[e], action], axis=-1)
        member = [k[e] for k in kernels], [b[e] for b in biases]
        want, _ = reference.forward(*member, inputs, activate)
        np.testing.assert_allclose(mean[e], obs[e] + want, rtol=1e-4, atol=1e-5)


def test_a_member_may_have_actions_of_its_own(model, params):
    obs, action = batch()
    own = jnp.stack([action, -action, 2.0 * action])
    mean, variance = model.predict(params, obs, own)
    for i in range(3):
        want = model.predict(params, obs, own[i])
        np.testing.assert_allclose(mean[i], want[0][i], rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(variance[i], want[1][i], rtol=1e-6)


def test_loss_equals_the_reference(model, params):
    rng = np.random.default_rng(3)
    inputs = rng.normal(size=(E, B, D + A)).astype(np.float32)
    targets = rng.normal(size=(E, B, D)).astype(np.float32)
    weight = jnp.full((B,), 1.0 / B, jnp.float32)
    network = params.network
    got, (nll, mse) = jax.jit(model.loss)(network, inputs, targets, weight)
    kernels, biases = layers(network)
    identity = (np.zeros(D + A), np.ones(D + A))
    want, want_nll = reference.pets_loss(
        kernels,
        biases,
        network.min_logvar,
        network.max_logvar,
        identity,
        inputs,
        targets,
        decays=(1e-4, 2e-4, 3e-4),
    )
    np.testing.assert_allclose(got, want, rtol=1e-5)
    np.testing.assert_allclose(nll, want_nll, rtol=1e-5)
    square = [
        (reference.forward([k[e] for k in kernels], [b[e] for b in biases], x)[0] - y)
        ** 2
        for e, (x, y) in enumerate(zip(inputs, targets, strict=True))
    ]
    np.testing.assert_allclose(mse, np.mean(square), rtol=1e-4)


def test_masked_rows_do_not_count(model, params):
    """The loss of seven rows, four of them masked, is that of the other three."""
    rng = np.random.default_rng(4)
    inputs = rng.normal(size=(E, B, D + A)).astype(np.float32)
    targets = rng.normal(size=(E, B, D)).astype(np.float32)
    weight = jnp.where(jnp.arange(B) < 3, jnp.float32(1 / 3), 0.0)
    loss = jax.jit(jax.value_and_grad(model.loss, has_aux=True))
    got = loss(params.network, inputs, targets, weight)
    want = loss(
        params.network, inputs[:, :3], targets[:, :3], jnp.full(3, 1 / 3, jnp.float32)
    )
    toys.assert_trees_close(got, want, rtol=1e-4, atol=1e-6)


def test_weight_decay_leaves_biases_alone(params):
    decays = (1e-4, 2e-4, 3e-4)
    weight = jnp.full((B,), 1.0 / B, jnp.float32)
    inputs, targets = jnp.ones((E, B, D + A)), jnp.zeros((E, B, D))
    with_decay = toys.small_ensemble(weight_decays=decays)
    without = toys.small_ensemble(weight_decays=(0.0, 0.0, 0.0))
    grads = [
        jax.jit(jax.grad(m.loss, has_aux=True))(
            params.network, inputs, targets, weight
        )[0]
        for m in (with_decay, without)
    ]
    kernels, _ = layers(params.network)
    (got_kernels, got_biases), (plain_kernels, plain_biases) = map(layers, grads)
    for i, decay in enumerate(decays):
        # d/dw of decay * sum(w^2) / 2.
        difference = got_kernels[i] - plain_kernels[i]
        np.testing.assert_allclose(difference, decay * kernels[i], atol=1e-6)
        np.testing.assert_allclose(got_biases[i], plain_biases[i], atol=1e-7)


def test_variance_stays_between_its_bounds(model, params):
    stack = params.network.members["params"]
    for raw in (-100.0, 100.0):
        last = dict(stack["layer_2"], bias=jnp.full((E, 2 * D), raw))
        members = {"params": dict(stack, layer_2=last)}
        network = params.network._replace(members=members)
        bent = params._replace(network=network)
        _, variance = jax.jit(model.predict)(bent, *batch())
        low, high = params.network.min_logvar, params.network.max_logvar
        want = reference.bound_logvar(np.float64(raw), np.float64(low), high)
        want = np.broadcast_to(np.exp(want), variance.shape)
        np.testing.assert_allclose(variance, want, rtol=1e-3)


def test_starts_as_pets_does():
    """Sizes, initial law and count of parameters of the configuration of the paper."""
    space = jaxpets.delta_space()
    model = jaxpets.ensemble(EnsembleConfig(), space, obs_size=18, action_size=6)
    params = jax.jit(model.init)(jax.random.key(1))
    network = params.network
    kernels, biases = layers(network)
    want = [(5, 24, 200)] + [(5, 200, 200)] * 3 + [(5, 200, 36)]
    assert [k.shape for k in kernels] == want
    for kernel, bias in zip(kernels, biases, strict=True):
        std = 1.0 / (2.0 * np.sqrt(kernel.shape[1]))
        assert np.abs(kernel).max() <= 2 * std * (1 + 1e-6)
        # The normal cut at two deviations has 0.880 of its deviation.
        np.testing.assert_allclose(np.std(kernel), 0.880 * std, rtol=0.02)
        assert not np.any(bias)
        assert len(np.unique(kernel[:, 0, 0])) == 5  # members differ
    np.testing.assert_array_equal(network.max_logvar, np.full(18, 0.5))
    np.testing.assert_array_equal(network.min_logvar, np.full(18, -10.0))
    assert sum(x.size for x in jax.tree.leaves(network)) == 664_180 + 36
    np.testing.assert_allclose(
        jaxpets.rewards.max_variance(params), np.exp(0.5), rtol=1e-6
    )


def test_without_noise_a_model_imagines_the_means_of_its_members(params):
    model = toys.small_ensemble()
    obs, action = batch()
    quiet = without_noise(params)
    mean, _ = jax.jit(model.predict)(params, obs, action)
    sample = jax.jit(model.sample)
    drawn = [sample(quiet, jax.random.key(i), obs, action) for i in range(2)]
    np.testing.assert_array_equal(*drawn)
    np.testing.assert_array_equal(drawn[0], mean)
    assert np.abs(sample(params, jax.random.key(0), obs, action) - mean).max() > 0
    # What it predicts is the same, with a spread that is next to nothing and no NaN.
    quiet_mean, quiet_variance = jax.jit(model.predict)(quiet, obs, action)
    np.testing.assert_array_equal(quiet_mean, mean)
    assert 0 <= quiet_variance.min() <= quiet_variance.max() < 1e-30


def test_a_planner_by_means_draws_no_noise(params):
    rollout = jaxpets.particle_rollout(
        toys.small_ensemble().sample, num_members=3, num_particles=3
    )
    planner = jaxpets.plan(rollout, toys.reach, toys.optimizer("icem"))
    given = jaxpets.PlanParams(params, 0.5)
    quiet = given._replace(dynamics=without_noise(params))

    def action(planner, given):
        step = jax.jit(planner.step)
        return step(given, jax.random.key(0), planner.init(), jnp.zeros(2))[0].action

    found = action(by_means(planner), given)
    np.testing.assert_array_equal(found, action(planner, quiet))
    assert (found != action(planner, given)).any()


@pytest.mark.parametrize("precision", [Precision.TF32, Precision.BF16])
def test_precision_changes_results_little_and_parameters_not(precision, params):
    exact = toys.small_ensemble(precision=Precision.F32)
    other = toys.small_ensemble(precision=precision)
    inits = [jax.jit(m.init)(jax.random.key(0)) for m in (exact, other)]
    toys.assert_trees_close(inits[0], inits[1], rtol=0)
    mean, variance = jax.jit(exact.predict)(params, *batch())
    got_mean, got_variance = jax.jit(other.predict)(params, *batch())
    assert got_mean.dtype == got_variance.dtype == jnp.float32
    # bfloat16 keeps 8 bits; three layers.
    np.testing.assert_allclose(got_mean, mean, atol=0.1)
    np.testing.assert_allclose(got_variance, variance, rtol=0.2)
    if precision is Precision.BF16:
        assert np.abs(got_mean - mean).max() > 0  # it does something


def test_project_keeps_the_bounds_in_order(model, params):
    network = params.network._replace(
        min_logvar=jnp.array([-1.0, 2.0]), max_logvar=jnp.array([0.5, -3.0])
    )
    after = model.project(network)
    assert jnp.all(after.max_logvar > after.min_logvar)
    assert after.max_logvar[0] == 0.5  # what is in order stays
    np.testing.assert_array_equal(after.min_logvar, network.min_logvar)


# -- scaler and targets --------------------------------------------------------------


def test_scaler_equals_the_reference_on_the_rows_in_use(model):
    data = jax.tree.map(np.array, toys.transitions(60))
    for array in data:
        array[40:] = np.nan
    scaler = jax.jit(model.fit_scaler)(data, jnp.int32(40))
    inputs = np.concatenate([data.obs[:40], data.action[:40]], axis=-1)
    mean, std = reference.input_scaler(np.float64(inputs))
    np.testing.assert_allclose(scaler.mean, mean, atol=1e-6)
    np.testing.assert_allclose(scaler.std, std, rtol=1e-5)
    both = np.concatenate([data.obs[:40], data.next_obs[:40]])
    np.testing.assert_array_equal(scaler.low, both.min(0))
    np.testing.assert_array_equal(scaler.high, both.max(0))


def test_scaler_of_nothing_is_the_identity(model):
    empty = jaxpets.datasets.init(8, D, A)
    scaler = jax.jit(model.fit_scaler)(empty.data, empty.size)
    untrained = jax.jit(model.init)(jax.random.key(0))
    toys.assert_trees_close(scaler, untrained.scaler, rtol=0)


def test_encode_equals_the_reference(model, params):
    data = toys.transitions(9, seed=5)
    inputs, targets = model.encode(params.scaler, data)
    raw = np.concatenate([data.obs, data.action], axis=-1)
    want = (np.float64(raw) - params.scaler.mean) / params.scaler.std
    np.testing.assert_allclose(inputs, want, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(targets, data.next_obs - data.obs, atol=1e-7)


def test_delta_space_obeys_its_law():
    space = jaxpets.delta_space()
    rng = np.random.default_rng(0)
    obs, next_obs = jnp.asarray(rng.normal(size=(2, 4, 3)), jnp.float32)
    back = space.next_obs(obs, space.target(obs, next_obs))
    np.testing.assert_allclose(back, next_obs, atol=1e-6)  # o + (x - o), rounded
    np.testing.assert_array_equal(space.features(obs), obs)


# -- what cannot be built ------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        (dict(num_members=0), ValueError, "num_members must be at least 1, got 0"),
        (dict(num_members=5.0), TypeError, "num_members must be a Python int"),
        (dict(hidden_sizes=(200, 0, 1, 1)), ValueError, "hidden_sizes must be at leas"),
        (dict(hidden_sizes=200), TypeError, "hidden_sizes must be .*200"),
        (dict(weight_decays=(1.0,)), ValueError, r"weight_decays must be .*\(5\).* 1"),
        (
            dict(weight_decays="much"),
            TypeError,
            "weight_decays must be a Python float",
        ),
        (
            dict(weight_decays=(1.0, 1.0, 1.0, 1.0, -1.0)),
            ValueError,
            "weight_decays mu",
        ),
        (dict(bound_decay=-0.1), ValueError, "bound_decay must be finite"),
        (
            dict(precision="bf16"),
            TypeError,
            "precision must be a Precision, got str",
        ),
        (dict(state_margin=-1.0), ValueError, "state_margin must be finite"),
        (dict(activation="elu"), ValueError, "activation must be one of swish, tanh"),
        (dict(activation=None), ValueError, "activation must be one of .* got None"),
    ],
)
def test_bad_settings_fail_when_built(changes, error, text):
    with pytest.raises(error, match=text):
        dataclasses.replace(EnsembleConfig(), **changes)


def test_bad_sizes_fail_when_built():
    for sizes in (dict(obs_size=0, action_size=1), dict(obs_size=1, action_size=0)):
        with pytest.raises(ValueError, match="_size must be at least 1, got 0"):
            jaxpets.ensemble(EnsembleConfig(), jaxpets.delta_space(), **sizes)


def test_wrong_arguments_fail_when_traced(model, params):
    obs, action = batch()
    with pytest.raises(ValueError, match=r"obs must be float32\[3, B, 2\], got"):
        model.predict(params, obs[:2], action)
    with pytest.raises(ValueError, match=r"action must be float32\[7, 1\], got"):
        model.sample(params, jax.random.key(0), obs, action[:5])
    with pytest.raises(ValueError, match=r"action must be float32\[3, 7, 1\], got"):
        model.predict(params, obs, jnp.stack([action] * 2))


@pytest.mark.parametrize(
    ("hidden_sizes", "decays", "wanted"),
    [
        ((8,) * 4, None, (2.5e-5, 5e-5, 7.5e-5, 7.5e-5, 1e-4)),  # PETS on HalfCheetah
        ((8,) * 2, None, (2.5e-5, 5e-5, 1e-4)),
        ((8,) * 2, 0.5, (0.5, 0.5, 0.5)),
        ((8,) * 2, (1.0, 2.0, 3.0), (1.0, 2.0, 3.0)),
        ((), None, (1e-4,)),
    ],
)
def test_weight_decays_fit_any_number_of_layers(hidden_sizes, decays, wanted):
    config = EnsembleConfig(hidden_sizes=hidden_sizes, weight_decays=decays)
    assert layer_decays(config) == wanted
