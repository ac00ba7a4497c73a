"""The rollout kernel, on CPUs and as the GPU's reference: it equals the scan."""

import dataclasses
import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rollouts import (
    CASES,
    CHEETAH,
    REFERENCE,
    SMALL,
    put,
    relative_error,
    scan,
    unbounded,
)

import jaxpets
from jaxpets import Precision
from jaxpets._src.chunks import window
from jaxpets._src.kernel.build import Kind
from jaxpets.envs import half_cheetah as hc
from jaxpets.models import without_noise


@pytest.mark.parametrize("name", CASES)
def test_equals_the_scan(engine, name):
    case = CASES[name]
    args = case.args()
    got, want = engine.run(case)(*args), scan(case)(*args)
    assert np.isfinite(want).all()
    assert relative_error(got, want) <= engine.rounding
    np.testing.assert_array_equal(got[:, 0], want[:, 0])


def test_wide_layers_equal_the_scan():
    """As the kernel of other GPUs than Hopper reads them."""
    case = dataclasses.replace(SMALL, hidden_sizes=(272, 512), horizon=2)
    fused = case.of_kind(Kind.MMA_REFERENCE)
    assert fused.uses_kernel
    got, want = jax.jit(fused)(*case.args()), scan(case)(*case.args())
    assert relative_error(got, want) <= 2e-4


def test_is_closer_than_the_scan_in_bfloat16(engine):
    args = CHEETAH.args()
    want = scan(CHEETAH)(*args)
    got = jax.jit(CHEETAH.scan(Precision.BF16))(*args)
    error = relative_error(engine.run(CHEETAH)(*args), want)
    assert error < relative_error(got, want) / 2


def test_without_data_nothing_is_bounded(engine):
    """A fresh scaler's range is infinite."""
    params, *rest = SMALL.args()
    params = unbounded(params)
    got, want = engine.run(SMALL)(params, *rest), scan(SMALL)(params, *rest)
    assert relative_error(got, want) <= engine.rounding


def test_a_bound_that_is_not_asked_for_is_not_applied():
    """The program is that of a space with another bound."""
    case = CASES["free joint"]
    squash = lambda obs, low, high: low + (high - low) * jax.nn.sigmoid(obs)  # noqa: E731
    other = dataclasses.replace(case, space=case.space._replace(bound=squash))
    programs = {
        str(jax.make_jaxpr(REFERENCE.fused(x))(*case.avals())) for x in (case, other)
    }
    assert len(programs) == 1 and "jaxpets_rollout_wgmma_reference_" in programs.pop()


# Noise.

LOUD = dataclasses.replace(SMALL, num_samples=100, particles=9, horizon=3)


def test_noise_is_that_of_jax_random_number_by_number(engine):
    """Without weights, a move is noise times one deviation. 8100 numbers have tails."""
    params, key, obs, actions = LOUD.args()
    members = jax.tree.map(np.zeros_like, params.network.members)
    network = params.network._replace(members=members)
    params = unbounded(params._replace(network=network))
    moves = np.diff(np.asarray(engine.run(LOUD)(params, key, obs, actions)), axis=1)
    low, high = (
        np.float64(params.network.min_logvar),
        np.float64(params.network.max_logvar),
    )
    std = np.sqrt(np.exp(low) + 1 / (np.exp(-high) + 1))
    shape = (LOUD.num_members, LOUD.num_samples * LOUD.particles, LOUD.obs_size)
    normal = jax.jit(jax.random.normal, static_argnums=(1, 2))
    for h, step in enumerate(jax.random.split(key, LOUD.horizon)):
        noise = np.asarray(normal(step, shape, jnp.float32))
        noise = noise.reshape(LOUD.num_members, LOUD.num_samples, LOUD.particles, -1)
        assert abs(noise).max() > 3.5
        # The logarithm behind a tail loses digits, otherwise here and there; so does
        # a place by which a particle has moved on.
        np.testing.assert_allclose(
            moves[:, h], noise.swapaxes(0, 1) * std, rtol=1e-5, atol=2e-6
        )


def test_without_noise_all_particles_of_a_member_are_one(engine):
    """Also in the kernel: what it multiplies its draws with is next to nothing."""
    params, key, *rest = SMALL.args()
    quiet = without_noise(params)
    path = engine.run(SMALL)(quiet, key, *rest)
    other = engine.run(SMALL)(quiet, jax.random.fold_in(key, 1), *rest)
    np.testing.assert_array_equal(path, other)
    first = path[..., :1, :]  # [N, H + 1, E, P, D]
    np.testing.assert_array_equal(path, np.broadcast_to(first, path.shape))
    assert relative_error(path, scan(SMALL)(quiet, key, *rest)) <= engine.rounding


def test_keys_decide(engine):
    params, key, obs, actions = SMALL.args()
    path = engine.run(SMALL)(params, key, obs, actions)
    again = engine.run(SMALL)(params, jax.random.clone(key), obs, actions)
    np.testing.assert_array_equal(path, again)
    other = engine.run(SMALL)(params, jax.random.fold_in(key, 1), obs, actions)
    assert np.mean(path[:, 1:] != other[:, 1:]) > 0.9  # the rest is at its bound


def test_a_key_of_the_old_kind_is_refused(engine):
    params, key, obs, actions = SMALL.args()
    old = jax.random.key_data(key)
    with pytest.raises(TypeError, match=r"key must be a typed key from jax.random.key"):
        engine.run(SMALL)(params, old, obs, actions)


def test_a_window_draws_its_share(engine):
    params, key, obs, actions = SMALL.args()
    part = window(key, jnp.int32(1), 2, SMALL.num_samples)
    got = engine.run(SMALL)(params, part, obs, actions[1:3])
    want = engine.run(SMALL)(params, key, obs, actions)
    np.testing.assert_array_equal(got, want[1:3])


def test_no_key_is_used_twice():
    params, key, *rest = SMALL.args()
    fresh = jax.random.clone(key)
    fused = functools.partial(REFERENCE.fused(SMALL))
    with jax.debug_key_reuse(True):  # which checks what is traced
        jax.jit(fused).trace(params, fresh, *rest)


# Numbers that are none.


def test_nan_actions_stay_with_their_candidate(engine):
    params, key, obs, actions = SMALL.args()
    path = engine.run(SMALL)(params, key, obs, actions)
    broken = engine.run(SMALL)(params, key, obs, put(actions, (2, 3, 1), np.nan))
    assert np.isnan(broken[2, 4:]).all()
    np.testing.assert_array_equal(broken[2, :4], path[2, :4])
    np.testing.assert_array_equal(np.delete(broken, 2, 0), np.delete(path, 2, 0))


def test_a_nan_start_stays_with_its_start(engine):
    params, key, obs, actions = SMALL.args()
    starts = np.stack([obs, put(obs, 1, np.nan), 2 * obs])
    mapped = jax.vmap(engine.run(SMALL), (None, None, 0, None))(
        params, key, starts, actions
    )
    assert np.isnan(mapped[1, :, 1:]).all()
    for i in (0, 2):
        want = engine.run(SMALL)(params, key, starts[i], actions)
        np.testing.assert_array_equal(mapped[i], want)


@pytest.mark.parametrize("entry", [hc.FORWARD_VELOCITY, hc.PITCH, hc.X_VELOCITY])
@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_goes_where_it_goes_in_the_scan(engine, entry, number):
    params, key, obs, actions = CHEETAH.args()
    obs = put(obs, entry, number)
    got, want = (f(CHEETAH)(params, key, obs, actions) for f in (engine.run, scan))
    np.testing.assert_array_equal(np.isnan(got), np.isnan(want))


def test_a_broken_member_breaks_its_particles_only(engine):
    params, key, obs, actions = SMALL.args()
    path = engine.run(SMALL)(params, key, obs, actions)
    members = jax.tree.map(lambda x: put(x, 1, np.nan), params.network.members)
    params = params._replace(network=params.network._replace(members=members))
    broken = engine.run(SMALL)(params, key, obs, actions)
    assert np.isnan(broken[:, 1:, 1]).all()
    np.testing.assert_array_equal(broken[:, :, ::2], path[:, :, ::2])


# What is wrong is said as the scan says it.


@pytest.mark.parametrize(
    "change", [dict(num_members=2), dict(num_members=4), dict(hidden_sizes=(16, 16))]
)
def test_params_of_another_ensemble_are_refused(engine, change):
    """Also where the kernel could not tell: of fewer members, of narrower layers."""
    params = dataclasses.replace(SMALL, **change).args()[0]
    rest = SMALL.args()[1:]
    said = []
    for fn in (SMALL.scan(), engine.fused(SMALL)):
        with pytest.raises(Exception, match=r"^params\..* must be float32") as error:
            jax.eval_shape(fn, params, *rest)
        said.append((error.type, str(error.value)))
    assert said[0] == said[1]


@pytest.mark.parametrize("params", [None, {}, jnp.zeros(3)])
def test_params_that_are_none_of_an_ensemble_are_refused(engine, params):
    with pytest.raises(TypeError, match="params must be an EnsembleParams, got"):
        engine.fused(SMALL)(params, *SMALL.args()[1:])


def test_wrong_shapes_are_refused(engine):
    params, key, obs, actions = SMALL.args()
    with pytest.raises(ValueError, match=r"obs must be float32\[3\], got float32\[2\]"):
        jax.eval_shape(engine.fused(SMALL), params, key, obs[:2], actions)
    text = r"actions must be float32\[N, H, 2\], got float32\[4, 5, 1\]"
    with pytest.raises(ValueError, match=text):
        jax.eval_shape(engine.fused(SMALL), params, key, obs, actions[..., :1])
    with pytest.raises(ValueError, match="num_particles must be a multiple"):
        jaxpets.fused_rollout(SMALL.model(), num_particles=4)


def test_a_model_that_is_not_of_jaxpets_is_refused():
    """A kernel is made from config and space, which functions alone do not tell."""
    own = SMALL.model()._replace(config=None, space=None)
    with pytest.raises(ValueError, match="model must be built by jaxpets"):
        jaxpets.fused_rollout(own, num_particles=6)
    text = "model must be an Ensemble, got EnsembleConfig"
    with pytest.raises(TypeError, match=text):
        jaxpets.fused_rollout(SMALL.config(), num_particles=6)


def test_operands_of_another_model_are_refused():
    """What Python has checked is checked again where memory is read."""
    program = str(jax.make_jaxpr(REFERENCE.fused(SMALL))(*SMALL.avals()))
    (target,) = re.findall("jaxpets_rollout_wgmma_reference_[0-9a-f]+", program)
    path = jax.eval_shape(SMALL.scan(), *SMALL.avals())
    operands = [jnp.zeros((3, 1))] * 5
    for count, words in (
        (5, "those of another model"),
        (4, "there are other operands"),
    ):
        call = jax.ffi.ffi_call(target, path)
        with pytest.raises(jax.errors.JaxRuntimeError, match=words):
            jax.block_until_ready(call(*operands[:count]))


def test_it_has_no_gradient():
    params, key, obs, actions = SMALL.args()

    def total(actions):
        return jnp.sum(REFERENCE.fused(SMALL)(params, key, obs, actions))

    with pytest.raises(ValueError, match="cannot be differentiated"):
        jax.eval_shape(jax.grad(total), actions)
