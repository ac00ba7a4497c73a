"""The rollout kernel, computed by its CPU reference: it equals the scan."""

import dataclasses
import functools
import warnings
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

import jaxpets
from jaxpets import Precision
from jaxpets._src import fused_rollout as module
from jaxpets._src.chunks import window
from jaxpets.envs import half_cheetah as hc

# The kernel multiplies float16 numbers, the scan float32 ones: every layer rounds its
# inputs and weights by up to 2^-12 of themselves. Errors of many terms cancel; those of
# H steps add up, but so do the moves they are compared with.
ROUNDING = 2e-4


@pytest.fixture(scope="module", autouse=True)
def _cache(tmp_path_factory):
    """Kernels are built for this run and kept nowhere else."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def _features(obs):
    angle, rate = obs[..., :1], obs[..., 1]
    parts = [
        jnp.sin(angle),
        jnp.cos(angle),
        jnp.tanh(obs[..., jnp.array([2, 0])]),
        jnp.exp(-(obs[..., -1:] ** 2)),
        jnp.where(rate > 0.0, rate, 0.1 * rate)[..., None] / 2.0,
        jnp.mean(obs, axis=-1, keepdims=True),
        jnp.max(obs, axis=-1, keepdims=True) - jnp.min(obs, axis=-1, keepdims=True),
        jnp.clip(obs[..., ::-1], -1.0, 1.0),
        jnp.linalg.norm(obs, axis=-1, keepdims=True),
        jax.nn.softplus(obs[..., 1:3]),
    ]
    return jnp.concatenate(parts, axis=-1)


WEIGHT = np.array([1.0, 0.5, 1.0, 2.0], np.float32)
# Everything a kernel's coordinates may do; features are 15.
RICH = jaxpets.ModelSpace(
    features=_features,
    target=lambda obs, next_obs: (next_obs - WEIGHT * obs) / 0.5,
    next_obs=lambda obs, target: WEIGHT * obs + target * 0.5,
    bound=lambda obs, low, high: jnp.where(WEIGHT > 0.7, jnp.clip(obs, low, high), obs),
)
# The noise alone: nothing is kept from step to step.
FORGETFUL = jaxpets.delta_space()._replace(next_obs=lambda obs, target: target)


@dataclasses.dataclass(frozen=True)
class Case:
    """A model, and how much of it to imagine."""

    obs_size: int = 3
    action_size: int = 2
    hidden_sizes: tuple = (16, 24)
    num_members: int = 3
    particles: int = 2  # of one member
    num_samples: int = 4
    horizon: int = 5
    state_margin: float | None = 0.5
    space: jaxpets.ModelSpace = dataclasses.field(default_factory=jaxpets.delta_space)

    def config(self, precision=Precision.BF16):
        return jaxpets.EnsembleConfig(
            num_members=self.num_members,
            hidden_sizes=self.hidden_sizes,
            weight_decays=(1e-4,) * (len(self.hidden_sizes) + 1),
            precision=precision,
            state_margin=self.state_margin,
        )

    def sizes(self):
        return dict(obs_size=self.obs_size, action_size=self.action_size)

    def model(self, precision=Precision.F32):
        return jaxpets.ensemble(self.config(precision), self.space, **self.sizes())

    def scan(self, precision=Precision.F32):
        return jaxpets.particle_rollout(
            self.model(precision).sample,
            num_members=self.num_members,
            num_particles=self.num_members * self.particles,
        )

    def fused(self, precision=Precision.BF16, *, interpret=True):
        return jaxpets.fused_rollout(
            self.config(precision),
            self.space,
            num_particles=self.num_members * self.particles,
            interpret=interpret,
            **self.sizes(),
        )

    @functools.cache  # noqa: B019
    def args(self):
        """Params, a key, a start and actions; from NumPy, for nothing to compile."""
        rng = np.random.default_rng(0)

        def drawn(shape):
            # As wide as `init` has it; but biases too, since zeros hide where they go.
            std = 0.5 * shape[-2] ** -0.5
            return rng.normal(size=shape, scale=std).astype(np.float32)

        params = jax.eval_shape(self.model().init, jax.random.key(0))
        members = jax.tree.map(lambda x: drawn(x.shape), params.network.members)
        lowest, highest = drawn((1, self.obs_size))[0] - 6, drawn((1, self.obs_size))[0]
        mean = drawn((1, params.scaler.mean.size))[0]
        low, high = (sign + drawn((4, self.obs_size))[0] for sign in (-3, 3))
        scaler = type(params.scaler)(mean, 1 + abs(mean), low, high)
        params = type(params)(type(params.network)(members, lowest, highest), scaler)
        shape = (self.num_samples, self.horizon, self.action_size)
        actions = rng.uniform(-1, 1, shape).astype(np.float32)
        args = params, drawn((1, self.obs_size))[0], actions
        params, obs, actions = jax.tree.map(jnp.asarray, args)
        return params, jax.random.key(1), obs, actions


SMALL = Case()
CHEETAH = Case(18, 6, (40, 36, 64), num_members=5, particles=4, space=hc.model_space())
CASES = {
    "small": SMALL,
    "one hidden layer": Case(obs_size=1, action_size=1, hidden_sizes=(20,)),
    "without a margin": Case(obs_size=5, hidden_sizes=(33, 16), state_margin=None),
    "one member": dataclasses.replace(SMALL, num_members=1, particles=7),
    "one particle of each": dataclasses.replace(SMALL, particles=1, horizon=1),
    "one candidate": dataclasses.replace(SMALL, num_samples=1),
    "obs 7": Case(obs_size=7, action_size=1, hidden_sizes=(16, 16, 16)),
    "obs 8": Case(obs_size=8),
    "obs 16": Case(obs_size=16, action_size=3, hidden_sizes=(64,)),
    "half_cheetah": CHEETAH,
    "rich": Case(obs_size=4, space=RICH),
}


def relative_error(got, want):
    """Of all moves, relative to all moves: the start is the same."""
    assert got.shape == want.shape and got.dtype == want.dtype == jnp.float32
    got, want = np.float64(got), np.float64(want)
    return np.linalg.norm(got - want) / np.linalg.norm(want - want[..., :1, :, :, :])


@functools.cache
def fused_of(case):
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # it is the kernel
        return case.fused()


@functools.cache
def run(case):
    return jax.jit(fused_of(case))


@functools.cache
def scan(case):
    return jax.jit(case.scan())


@pytest.mark.parametrize("name", CASES)
def test_equals_the_scan(name):
    case = CASES[name]
    args = case.args()
    got, want = run(case)(*args), scan(case)(*args)
    assert np.isfinite(want).all()
    assert relative_error(got, want) <= ROUNDING
    np.testing.assert_array_equal(got[:, 0], want[:, 0])


def test_is_closer_than_the_scan_in_bfloat16():
    args = CHEETAH.args()
    want = scan(CHEETAH)(*args)
    got = jax.jit(CHEETAH.scan(Precision.BF16))(*args)
    assert relative_error(run(CHEETAH)(*args), want) < relative_error(got, want) / 2


def test_without_data_nothing_is_bounded():
    """A fresh scaler's range is infinite."""
    params, *rest = SMALL.args()
    scaler = params.scaler
    free = scaler._replace(low=scaler.low - jnp.inf, high=scaler.high + jnp.inf)
    params = params._replace(scaler=free)
    got, want = run(SMALL)(params, *rest), scan(SMALL)(params, *rest)
    assert relative_error(got, want) <= ROUNDING


def test_a_bound_that_is_not_asked_for_is_not_applied():
    squash = lambda obs, low, high: low + (high - low) * jax.nn.sigmoid(obs)  # noqa: E731
    space = jaxpets.delta_space()._replace(bound=squash)
    case = dataclasses.replace(SMALL, state_margin=None, space=space)
    assert relative_error(run(case)(*case.args()), scan(case)(*case.args())) <= ROUNDING


# Noise.

LOUD = dataclasses.replace(
    SMALL, num_samples=100, particles=9, horizon=3, state_margin=None, space=FORGETFUL
)


def test_noise_is_that_of_jax_random_number_by_number():
    """Without weights, a path is noise times one deviation. 8100 numbers have tails."""
    params, key, obs, actions = LOUD.args()
    members = jax.tree.map(jnp.zeros_like, params.network.members)
    params = params._replace(network=params.network._replace(members=members))
    path = run(LOUD)(params, key, obs, actions)
    low, high = (
        np.float64(params.network.min_logvar),
        np.float64(params.network.max_logvar),
    )
    std = np.sqrt(np.exp(low) + 1 / (np.exp(-high) + 1))
    shape = (LOUD.num_members, LOUD.num_samples * LOUD.particles, LOUD.obs_size)
    for h, step in enumerate(jax.random.split(key, LOUD.horizon)):
        noise = jax.random.normal(step, shape, jnp.float32)
        noise = noise.reshape(LOUD.num_members, LOUD.num_samples, LOUD.particles, -1)
        assert abs(noise).max() > 3.5
        # The logarithm behind a tail loses digits, otherwise here and there.
        np.testing.assert_allclose(
            path[:, h + 1], noise.swapaxes(0, 1) * std, rtol=1e-5, atol=1e-6
        )


def test_keys_decide():
    params, key, obs, actions = SMALL.args()
    path = run(SMALL)(params, key, obs, actions)
    again = run(SMALL)(params, jax.random.clone(key), obs, actions)
    np.testing.assert_array_equal(path, again)
    other = run(SMALL)(params, jax.random.fold_in(key, 1), obs, actions)
    assert np.mean(path[:, 1:] != other[:, 1:]) > 0.9  # the rest is at its bound


def test_a_key_of_the_old_kind_is_the_same_key():
    params, key, obs, actions = SMALL.args()
    old = run(SMALL)(params, jax.random.key_data(key), obs, actions)
    np.testing.assert_array_equal(old, run(SMALL)(params, key, obs, actions))


@pytest.mark.parametrize(("first", "count"), [(0, 4), (1, 2), (3, 1)])
def test_a_window_draws_its_share(first, count):
    params, key, obs, actions = SMALL.args()
    part = window(key, jnp.int32(first), count, SMALL.num_samples)
    pick = slice(first, first + count)
    got = run(SMALL)(params, part, obs, actions[pick])
    np.testing.assert_array_equal(got, run(SMALL)(params, key, obs, actions)[pick])


def test_no_key_is_used_twice():
    with jax.debug_key_reuse(True):
        jax.jit(functools.partial(fused_of(SMALL)))(*SMALL.args())


# Mapped: p is for params, k for the key, o for obs, a for actions.

LETTERS = "pkoa"
SIZES = (2, 3, 2, 3)  # of the mapped axes, from outside


def stacked(case, levels):
    """Arguments with an axis in front for every level that maps them, and `in_axes`."""
    args = []
    for letter, arg in zip(LETTERS, case.args(), strict=True):
        shape = tuple(
            size for size, level in zip(SIZES, levels, strict=False) if letter in level
        )
        if letter == "k":
            args.append(jax.random.split(arg, shape) if shape else arg)
            continue
        factors = 1 - 0.1 * np.arange(np.prod(shape), dtype=np.float32).reshape(shape)
        args.append(jax.tree.map(functools.partial(jnp.multiply.outer, factors), arg))
    axes = [
        tuple(0 if letter in level else None for letter in LETTERS) for level in levels
    ]
    return args, axes


@pytest.mark.parametrize(
    "levels",
    ["p", "k", "o", "a", "pkoa", "p,k,o,a", "a,o,k,p", "po,ka,p", "a,a,ao,o", "k,pkoa"],
)
def test_vmap_equals_the_loop(levels):
    levels = levels.split(",")
    args, axes = stacked(SMALL, levels)
    mapped = fused_of(SMALL)
    for in_axes in reversed(axes):
        mapped = jax.vmap(mapped, in_axes)
    got = jax.jit(mapped)(*args)
    shape = SIZES[: len(levels)]
    assert got.shape[: len(shape)] == shape
    for index in np.ndindex(shape):
        one = []
        for letter, arg in zip(LETTERS, args, strict=True):
            own = tuple(
                i for i, level in zip(index, levels, strict=True) if letter in level
            )
            one.append(jax.tree.map(lambda x, own=own: x[own], arg))
        np.testing.assert_array_equal(got[index], run(SMALL)(*one), strict=True)


def test_vmap_equals_the_scan():
    args, (in_axes,) = stacked(CHEETAH, ["pkoa"])
    got, want = (
        jax.jit(jax.vmap(f, in_axes))(*args)
        for f in (fused_of(CHEETAH), CHEETAH.scan())
    )
    assert relative_error(got, want) <= ROUNDING


def test_vmap_over_parts_of_params_and_other_axes():
    params, key, obs, actions = SMALL.args()
    networks = jax.tree.map(lambda x: jnp.stack([x, 0.5 * x], -1), params.network)
    stack = jnp.stack([actions, -actions], 1)
    in_axes = (type(params)(-1, None), None, None, 1)
    mapped = jax.vmap(fused_of(SMALL), in_axes, out_axes=2)
    got = jax.jit(mapped)(params._replace(network=networks), key, obs, stack)
    for i in range(2):
        network = jax.tree.map(lambda x, i=i: x[..., i], networks)
        want = run(SMALL)(params._replace(network=network), key, obs, stack[:, i])
        np.testing.assert_array_equal(got[:, :, i], want)


def test_a_fifth_vmap_is_refused():
    params, key, obs, actions = SMALL.args()
    mapped = fused_of(SMALL)
    for _ in range(5):
        mapped = jax.vmap(mapped, (None, None, 0, None))
    many = jnp.broadcast_to(obs, (1, 2, 1, 2, 1, *obs.shape))
    with pytest.raises(jax.errors.JaxRuntimeError, match="vmap is nested too deeply"):
        jax.block_until_ready(jax.jit(mapped)(params, key, many, actions))


# Inside other programs.


def test_scan_equals_the_loop():
    params, key, obs, actions = SMALL.args()

    def body(obs, key):
        path = fused_of(SMALL)(params, key, obs, actions)
        return path[0, -1, 0, 0], path

    keys = jax.random.split(key, 3)
    _, got = jax.jit(lambda: jax.lax.scan(body, obs, keys))()
    for path, step in zip(got, keys, strict=True):
        # Params that are known when it is compiled are packed by another program.
        np.testing.assert_allclose(
            path, run(SMALL)(params, step, obs, actions), rtol=1e-4, atol=1e-4
        )
        obs = path[0, -1, 0, 0]


def test_one_trace_for_all_values():
    traces = []

    def counted(*args):
        traces.append(args)
        return fused_of(SMALL)(*args)

    fn = jax.jit(counted)
    params, key, obs, actions = SMALL.args()
    fn(params, key, obs, actions)
    fn(jax.tree.map(lambda x: 0.5 * x, params), key, -obs, 0.5 * actions)
    assert len(traces) == 1


def step_of(rollout, chunk_size=None, name="cem"):
    search = toys.optimizer(name, horizon=3, size=SMALL.action_size)
    planner = jaxpets.plan(rollout, toys.reach, search, chunk_size=chunk_size)
    return lambda params, key, obs: planner.step(params, key, planner.init(), obs)


@functools.cache
def planned(chunk_size=None, name="cem"):
    return jax.jit(step_of(fused_of(SMALL), chunk_size, name))


def start():
    params, key, obs, _ = SMALL.args()
    return jaxpets.PlanParams(params, jnp.float32(0.5)), key, obs


def test_a_plan_is_that_of_the_scan():
    want = jax.jit(step_of(SMALL.scan()))(*start())
    # Three rounds of a search; elites are the same unless values tie to 1e-4.
    toys.assert_trees_close(planned()(*start()), want, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(("name", "chunk_size"), [("cem", 25), ("icem", 20)])
def test_a_plan_in_chunks_is_the_plan(name, chunk_size):
    got, want = (planned(size, name)(*start()) for size in (chunk_size, None))
    # The values are the same; their means may be added up in another order.
    toys.assert_trees_close(got, want, rtol=1e-5, atol=1e-5)


def test_plans_of_many_seeds_in_chunks():
    params, key, obs = start()
    keys = jax.random.split(key, 3)
    starts = jnp.stack([obs, -obs, 0.5 * obs])
    got = jax.jit(jax.vmap(planned(25), (None, 0, 0)))(params, keys, starts)
    for i in range(3):
        one = jax.tree.map(lambda x, i=i: x[i], got)
        want = planned()(params, keys[i], starts[i])
        toys.assert_trees_close(one, want, rtol=1e-5, atol=1e-5)


# Numbers that are none.


def test_nan_actions_stay_with_their_candidate():
    params, key, obs, actions = SMALL.args()
    path = run(SMALL)(params, key, obs, actions)
    broken = run(SMALL)(params, key, obs, actions.at[2, 3, 1].set(jnp.nan))
    assert np.isnan(broken[2, 4:]).all()
    np.testing.assert_array_equal(broken[2, :4], path[2, :4])
    np.testing.assert_array_equal(np.delete(broken, 2, 0), np.delete(path, 2, 0))


def test_a_nan_start_stays_with_its_start():
    params, key, obs, actions = SMALL.args()
    starts = jnp.stack([obs, obs.at[1].set(jnp.nan), 2 * obs])
    mapped = jax.vmap(run(SMALL), (None, None, 0, None))(params, key, starts, actions)
    assert np.isnan(mapped[1, :, 1:]).all()
    for i in (0, 2):
        want = run(SMALL)(params, key, starts[i], actions)
        np.testing.assert_array_equal(mapped[i], want)


@pytest.mark.parametrize("entry", [hc.FORWARD_VELOCITY, hc.PITCH, hc.X_VELOCITY])
@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_goes_where_it_goes_in_the_scan(entry, number):
    params, key, obs, actions = CHEETAH.args()
    obs = obs.at[entry].set(number)
    got, want = (f(CHEETAH)(params, key, obs, actions) for f in (run, scan))
    np.testing.assert_array_equal(np.isnan(got), np.isnan(want))


def test_a_broken_member_breaks_its_particles_only():
    params, key, obs, actions = SMALL.args()
    path = run(SMALL)(params, key, obs, actions)
    members = jax.tree.map(lambda x: x.at[1].set(jnp.nan), params.network.members)
    params = params._replace(network=params.network._replace(members=members))
    broken = run(SMALL)(params, key, obs, actions)
    assert np.isnan(broken[:, 1:, 1]).all()
    np.testing.assert_array_equal(broken[:, :, ::2], path[:, :, ::2])


# What is wrong is said as the scan says it.


@pytest.mark.parametrize(
    "change", [dict(num_members=2), dict(num_members=4), dict(hidden_sizes=(16, 16))]
)
def test_params_of_another_ensemble_are_refused(change):
    """Also where the kernel could not tell: of fewer members, of narrower layers."""
    params = dataclasses.replace(SMALL, **change).args()[0]
    rest = SMALL.args()[1:]
    said = []
    for fn in (SMALL.scan(), fused_of(SMALL)):
        with pytest.raises(Exception, match=r"axes|shape") as error:
            jax.eval_shape(fn, params, *rest)
        said.append((error.type, str(error.value)))
    assert said[0] == said[1]


def test_wrong_shapes_are_refused():
    params, key, obs, actions = SMALL.args()
    with pytest.raises(ValueError, match=r"obs must be float32\[3\], got float32\[2\]"):
        jax.eval_shape(fused_of(SMALL), params, key, obs[:2], actions)
    text = r"actions must be float32\[N, H, 2\], got float32\[4, 5, 1\]"
    with pytest.raises(ValueError, match=text):
        jax.eval_shape(fused_of(SMALL), params, key, obs, actions[..., :1])
    with pytest.raises(ValueError, match="num_particles must be a multiple"):
        jaxpets.fused_rollout(
            SMALL.config(), SMALL.space, num_particles=4, **SMALL.sizes()
        )


def test_it_has_no_gradient():
    params, key, obs, actions = SMALL.args()

    def total(actions):
        return jnp.sum(fused_of(SMALL)(params, key, obs, actions))

    with pytest.raises(ValueError, match="cannot be differentiated"):
        jax.grad(total)(actions)


# Where there is no kernel, the scan runs.


def recorded(call):
    """What is returned, and the warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        return call(), caught


def assert_is_the_scan(case, words, precision=Precision.BF16, *, interpret=True):
    fused, caught = recorded(lambda: case.fused(precision, interpret=interpret))
    (warning,) = caught
    assert str(warning.message) == f"fused_rollout runs as a scan: {words}."
    assert warning.filename == __file__
    args = jax.eval_shape(case.args)
    got, want = (str(jax.make_jaxpr(f)(*args)) for f in (fused, case.scan(precision)))
    assert got == want


def test_on_a_cpu_it_is_the_scan():
    assert_is_the_scan(SMALL, "the device is a cpu, not a GPU", interpret=False)
    args = SMALL.args()
    fused, _ = recorded(lambda: SMALL.fused(interpret=False))
    want = jax.jit(SMALL.scan(Precision.BF16))(*args)
    np.testing.assert_array_equal(jax.jit(fused)(*args), want)


@pytest.mark.parametrize("precision", [Precision.F32, Precision.TF32])
def test_other_precisions_are_the_scan(precision):
    words = f"the precision is {precision.value}, not bf16"
    assert_is_the_scan(SMALL, words, precision)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (dict(hidden_sizes=(16, 257)), "hidden layers are wider than 256"),
        (dict(obs_size=129), "observations have more than 128 entries"),
        (dict(action_size=254), "features and action have more than 256 entries"),
        (
            dict(obs_size=128, action_size=128, hidden_sizes=(256, 256)),
            "the model does not fit into the GPU's shared memory",
        ),
    ],
)
def test_what_is_too_large_is_the_scan(change, words):
    assert_is_the_scan(dataclasses.replace(SMALL, **change), words)


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (jnp.sort, "the primitive 'sort' has no C++ form"),
        (jnp.cumsum, "the primitive 'cumsum' has no C++ form"),
        (
            lambda obs: obs + obs[..., jnp.int32(0)] * jnp.floor(obs).astype(jnp.int32),
            "values of type int32 have no C++ form",
        ),
        (
            lambda obs: (
                jnp.take(obs, (obs[..., 0] > 0).astype(jnp.int32), axis=-1) + obs
            ),
            "values of type int32 have no C++ form",
        ),
    ],
)
def test_what_cannot_be_written_as_rows_is_the_scan(function, words):
    def features(obs):
        return function(obs).astype(jnp.float32)

    with jax.numpy_dtype_promotion("standard"):
        space = jaxpets.delta_space()._replace(features=features)
        fused, (warning,) = recorded(dataclasses.replace(SMALL, space=space).fused)
    assert str(warning.message) == f"fused_rollout runs as a scan: {words}."
    assert callable(fused)


NEVER = dataclasses.replace(SMALL, hidden_sizes=(40,))  # never built


def compiler(folder, script):
    path = folder / "c++"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)


def test_without_a_compiler_it_is_the_scan(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    words = "no C++ compiler found (c++, g++ or clang++)"
    assert_is_the_scan(NEVER, words)


def test_with_a_compiler_that_fails_it_is_the_scan(monkeypatch, tmp_path):
    compiler(tmp_path, "echo In file included >&2; echo 'a.h:1: error: no' >&2; exit 1")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert_is_the_scan(NEVER, "c++ failed: a.h:1: error: no")


def test_with_a_library_that_does_not_load_it_is_the_scan(monkeypatch, tmp_path):
    # The last argument but one is where the library goes.
    compiler(tmp_path, 'while [ "$1" != -o ]; do shift; done; echo no > "$2"')
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    _, (warning,) = recorded(NEVER.fused)
    text = str(warning.message)
    assert text.startswith("fused_rollout runs as a scan: cannot load the compiled")
    assert "\n" not in text


def test_with_a_cache_that_cannot_be_written_it_is_the_scan(monkeypatch, tmp_path):
    (tmp_path / "jaxpets").write_text("a file, where a folder should be")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    _, (warning,) = recorded(NEVER.fused)
    text = str(warning.message)
    assert text.startswith("fused_rollout runs as a scan: cannot write to the cache")
    assert "\n" not in text


def test_coordinates_that_do_not_fit_are_refused_by_the_scan():
    """Its C++ is refused by the compiler, and then the scan says what is wrong."""
    space = jaxpets.delta_space()._replace(next_obs=lambda obs, target: obs[..., :2])
    case = dataclasses.replace(SMALL, space=space, state_margin=None)
    fused, (warning,) = recorded(case.fused)
    assert "failed: " in str(warning.message)
    with pytest.raises(ValueError, match=r"must be float32\[.*3\], got"):
        jax.eval_shape(fused, *SMALL.args())


def test_other_kinds_of_keys_run_the_scan():
    params, _, obs, actions = SMALL.args()
    scan = SMALL.scan(Precision.BF16)
    text = "fused_rollout runs as a scan: keys are not partitionable threefry."
    args = params, jax.random.key(0, impl="rbg"), obs, actions
    got, (warning,) = recorded(lambda: jax.jit(fused_of(SMALL))(*args))
    assert str(warning.message) == text
    np.testing.assert_array_equal(got, jax.jit(scan)(*args))
    with jax.threefry_partitionable(False):
        args = params, jax.random.key(0), obs, actions
        _, (warning,) = recorded(lambda: jax.eval_shape(fused_of(SMALL), *args))
        assert str(warning.message) == text


# GPUs.


def pretend(monkeypatch, **attributes):
    device = SimpleNamespace(platform="gpu", **attributes)
    monkeypatch.setattr(jax, "devices", lambda: [device])


@pytest.mark.parametrize(
    ("attributes", "capability"),
    [
        (dict(compute_capability="8.0"), "8.0"),
        (dict(compute_capability="10.0"), "10.0"),
        (dict(), "unknown"),
    ],
)
def test_on_other_gpus_it_is_the_scan(monkeypatch, attributes, capability):
    pretend(monkeypatch, **attributes)
    fused, (warning,) = recorded(lambda: SMALL.fused(interpret=False))
    words = f"the GPU's compute capability is {capability}, not 9.0"
    assert str(warning.message) == f"fused_rollout runs as a scan: {words}."
    assert callable(fused)


def test_on_a_hopper_gpu_the_kernel_is_built(monkeypatch):
    pretend(monkeypatch, compute_capability="9.0")
    asked = []

    def load_kernel(model, *, cuda):
        asked.append((model, cuda))
        return "target"

    monkeypatch.setattr(module, "load_kernel", load_kernel)
    _, caught = recorded(lambda: SMALL.fused(interpret=False))
    _, more = recorded(SMALL.fused)
    assert not caught and not more
    (kernel, cuda), (reference, not_cuda) = asked
    assert cuda and not not_cuda
    # The same model, with the instructions it needs.
    assert kernel.startswith(reference)
    assert "wgmma.mma_async" in kernel and "wgmma" not in reference


@pytest.mark.gpu
@pytest.mark.parametrize("name", ["half_cheetah", "obs 7", "rich"])
def test_the_kernel_equals_the_scan(name):
    case = dataclasses.replace(CASES[name], num_samples=70)  # blocks that are not full
    with jax.default_device(jax.devices("gpu")[0]):
        fused, caught = recorded(lambda: case.fused(interpret=False))
        assert not caught
        args = case.args()
        got, want = jax.jit(fused)(*args), jax.jit(case.scan())(*args)
        # Its tanh and its exponential have 11 and 22 bits.
        assert relative_error(got, want) <= 1e-3
        many, axes = stacked(case, ["p", "k", "o", "a"])
        mapped = fused
        for in_axes in reversed(axes):
            mapped = jax.vmap(mapped, in_axes)
        one = jax.jit(mapped)(*many)[1, 2, 1, 2]
        last = [jax.tree.map(lambda x: x[-1], arg) for arg in many]
        np.testing.assert_array_equal(one, jax.jit(fused)(*last))


# Weights that stay in shared memory; that stream through a ring which holds a layer, or
# does not; candidates for blocks of one tile, and for blocks of both kinds.
@pytest.mark.gpu
@pytest.mark.parametrize("num_samples", [70, 1000])
@pytest.mark.parametrize(
    "hidden_sizes", [(64,), (200,) * 4, (208,) * 4, (256,) * 4, (128,) * 8]
)
def test_the_kernel_equals_the_scan_at_every_width(hidden_sizes, num_samples):
    case = dataclasses.replace(
        CHEETAH, hidden_sizes=hidden_sizes, num_samples=num_samples
    )
    with jax.default_device(jax.devices("gpu")[0]):
        fused, caught = recorded(lambda: case.fused(interpret=False))
        assert not caught
        got, want = jax.jit(fused)(*case.args()), jax.jit(case.scan())(*case.args())
        assert relative_error(got, want) <= 1e-3
