"""Where there can be no kernel the fitter trains, and the result says why."""

import importlib.util
import subprocess

import fits
import jax
import optax
import pytest
from fits import SMALL, module, recorded, start
from rollouts import kernels_of, pretend

import jaxpets
from jaxpets import FitConfig, Precision
from jaxpets._src.kernel import build
from jaxpets._src.kernel.build import Kind

# In a script: $2 is then where the library goes.
OUTPUT = 'while [ "$1" != -o ]; do shift; done'
NO_GPU = "the device is no GPU of compute capability 9.0"
NO_ADAM = (
    "the optimizer is not optax.adam with a constant rate, or its numbers were "
    "not found"
)
NO_ROOM = "the weights do not fit into the shared memory of 16 blocks"
NO_REGISTERS = "Adam's moments do not fit into the registers of 16 blocks"


@pytest.fixture
def hopper(monkeypatch):
    pretend(monkeypatch, compute_capability="9.0")


@pytest.fixture
def asked(monkeypatch):
    return kernels_of(monkeypatch, module)


def assert_is_the_fitter(arguments, words, args):
    """Its program is the fitter's, and a warning of one line says why."""
    fused, (warning,) = recorded(lambda: jaxpets.fused_fitter(*arguments))
    assert str(warning.message) == f"fused_fitter trains as fitter: {words}."
    assert warning.filename == __file__ and "\n" not in words
    assert fused.reason == words and not fused.uses_kernel and not fused.compiler
    plain = jaxpets.fitter(*arguments)
    for function, given in (("init", args[:1]), ("step", args)):
        got, want = (jax.make_jaxpr(getattr(x, function)) for x in (fused, plain))
        assert str(got(*given)) == str(want(*given))


def args_of(case, optimizer=None):
    """Shapes and types of what `step` is given."""

    def args():
        params = case.ensemble().init(jax.random.key(0))
        state = jaxpets.fitter(
            case.ensemble(), optimizer or optax.adam(case.rate), FitConfig()
        ).init(params)
        sizes = case.obs_size, case.action_size
        dataset = jaxpets.datasets.init(fits.CAPACITY, *sizes)
        return params, jax.random.key(0), state, dataset

    return jax.eval_shape(args)


# -- where there is one --------------------------------------------------------------


@pytest.mark.usefixtures("hopper")
def test_a_hopper_gpu_has_a_kernel_of_the_models_sizes(asked):
    fused, caught = recorded(SMALL.fused)
    assert not caught and fused.uses_kernel and fused.compiler == "nvcc 13.0"
    assert not fused.reason
    ((header, *built),) = asked
    assert built == [Kind.FIT, "sm_90a"]
    assert "#define WIDTHS 12, 10" in header.splitlines()
    assert "constexpr int CTAS = 16;" in header.splitlines()


@pytest.mark.usefixtures("hopper")
def test_what_comes_out_is_what_comes_out_of_the_fitter(asked):
    """Shapes, types and weak types, of one and of many."""
    fused, plain, args = SMALL.fused(), SMALL.plain(), args_of(SMALL)

    def avals(fitter):
        one = jax.eval_shape(fitter.step, *args)
        many = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct((3, *x.shape), x.dtype), args
        )
        mapped = jax.eval_shape(jax.vmap(fitter.step), *many)
        return jax.tree.map(lambda x: (x.shape, x.dtype, x.weak_type), (one, mapped))

    assert avals(fused) == avals(plain) and asked


def test_what_is_not_in_the_kernel_is_not_built_again():
    """Rates, decays, epochs and batches are numbers that it is given."""
    one, other = SMALL, SMALL.but(
        rate=0.1, weight_decays=0.5, bound_decay=1.0, num_epochs=7, batch_size=99,
        final_rate=0.0, bootstrap=False,
    )  # fmt: skip
    assert one.layout().header() == other.layout().header()
    for change in (dict(hidden_sizes=(12, 11)), dict(activation="tanh")):
        assert one.but(**change).layout().header() != one.layout().header()


# -- where there is none -------------------------------------------------------------


@pytest.mark.parametrize(
    "device",
    [
        dict(platform="cpu"),
        dict(platform="tpu"),
        dict(compute_capability="8.0"),
        dict(compute_capability="10.0"),
        dict(compute_capability="12.0"),
        dict(compute_capability="gfx942"),
    ],
)
def test_on_other_devices_it_is_the_fitter(monkeypatch, asked, device):
    args = args_of(SMALL)
    pretend(monkeypatch, **device)
    assert_is_the_fitter(SMALL.arguments(), NO_GPU, args)
    assert not asked


@pytest.mark.usefixtures("hopper")
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (dict(precision=Precision.F32), "the precision is f32, not tf32"),
        (dict(precision=Precision.BF16), "the precision is bf16, not tf32"),
        (dict(hidden_sizes=()), "there is no hidden layer"),
        (dict(hidden_sizes=(400,) * 3, obs_size=18), NO_ROOM),
        (dict(hidden_sizes=(16,), obs_size=2000), NO_ROOM),
        (dict(hidden_sizes=(256,) * 5, obs_size=18), NO_REGISTERS),
        (dict(hidden_sizes=(300,) * 3, obs_size=18), NO_REGISTERS),
    ],
)
def test_models_that_it_is_not_for_are_the_fitters(asked, change, words):
    case = SMALL.but(**change)
    assert_is_the_fitter(case.arguments(), words, args_of(case))
    assert not asked


def all_but_a_bound(network):
    """A mask for the parameters of a network, and nothing else."""
    return jax.tree.map(lambda _: True, network)._replace(min_logvar=False)


# More of them are in test_optimizer.py.
OTHERS = {
    "adamw": optax.adamw(1e-3),
    "sgd": optax.sgd(1e-3),
    "a schedule": optax.adam(optax.cosine_decay_schedule(1e-3, 100)),
    "a chain": optax.chain(optax.clip_by_global_norm(1.0), optax.adam(1e-3)),
    "for some parameters": optax.masked(optax.adam(1e-3), all_but_a_bound),
}


@pytest.mark.usefixtures("hopper")
@pytest.mark.parametrize("name", OTHERS)
def test_other_optimizers_are_the_fitters(asked, name):
    ensemble, _, config = SMALL.arguments()
    args = args_of(SMALL, OTHERS[name])
    assert_is_the_fitter((ensemble, OTHERS[name], config), NO_ADAM, args)
    assert not asked


@pytest.mark.usefixtures("hopper")
def test_with_a_rate_that_is_traced_it_is_the_fitter(asked):
    """As in a sweep over rates."""
    ensemble, _, config = SMALL.arguments()
    args = args_of(SMALL)

    def step(rate, *args):
        fused = jaxpets.fused_fitter(ensemble, optax.adam(rate), config)
        assert fused.reason == NO_ADAM and not fused.uses_kernel
        return fused.step(*args)

    with pytest.warns(UserWarning, match=f"^fused_fitter trains as fitter: {NO_ADAM}"):
        after = jax.eval_shape(step, 1e-3, *args)
    assert after == jax.eval_shape(SMALL.plain().step, *args) and not asked


@pytest.mark.usefixtures("hopper")
@pytest.mark.parametrize("field", ["config", "space"])
def test_an_ensemble_of_ones_own_is_the_fitters(asked, field):
    ensemble, optimizer, config = SMALL.arguments()
    own = ensemble._replace(**{field: None})
    words = "the ensemble is none of jaxpets.ensemble"
    assert_is_the_fitter((own, optimizer, config), words, args_of(SMALL))
    assert not asked


# -- where it cannot be built --------------------------------------------------------


@pytest.fixture
def unbuilt(cache, registered, monkeypatch):
    """Nothing is in a cache, nothing is registered. Returns what was."""
    monkeypatch.setattr(module, "load_kernel", build.build_kernel)
    return registered


@pytest.mark.usefixtures("hopper")
def test_without_nvcc_it_is_the_fitter(monkeypatch, tmp_path, unbuilt):
    args = args_of(SMALL)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CUDA_HOME", raising=False)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    words = "no nvcc found; pip install 'jaxpets[cuda13]' brings one"
    assert_is_the_fitter(SMALL.arguments(), words, args)
    assert not unbuilt


@pytest.mark.usefixtures("hopper")
def test_with_an_nvcc_that_fails_it_is_the_fitter(compiler, unbuilt):
    args = args_of(SMALL)
    compiler("echo 'a.h:1: error: no' >&2; exit 1", name="nvcc")
    assert_is_the_fitter(SMALL.arguments(), "nvcc failed: a.h:1: error: no", args)
    assert not unbuilt


@pytest.fixture
def library(tmp_path):
    """Makes a library that says so of the GPU it is loaded on."""

    def make(name, problem):
        source, made = tmp_path / f"{name}.c", tmp_path / f"{name}.so"
        source.write_text(
            "int jaxpets_fit(void) { return 0; }\n"
            f"const char* jaxpets_problem(void) {{ return {problem}; }}\n"
        )
        subprocess.run(["cc", "-shared", "-fPIC", "-o", made, source], check=True)
        return f'{OUTPUT}; cp {made} "$2"'

    return make


@pytest.mark.usefixtures("hopper")
def test_on_a_gpu_without_room_it_is_the_fitter(library, compiler, unbuilt):
    """The library is asked; one that has no objection is registered."""
    args, words = args_of(SMALL), "the GPU has no room for all members at once"
    objects, is_fine = library("objects", f'"{words}"'), library("is_fine", "0")
    compiler(objects, name="nvcc")
    assert_is_the_fitter(SMALL.arguments(), words, args)
    assert not unbuilt
    compiler(is_fine, name="nvcc", version="nvcc 13.1")  # not in the cache
    fused, caught = recorded(SMALL.fused)
    assert not caught and fused.uses_kernel
    ((target, platform),) = unbuilt
    assert target.startswith("jaxpets_fit_fit_") and platform == "CUDA"


# -- bad arguments -------------------------------------------------------------------


@pytest.mark.parametrize("place", range(3))
@pytest.mark.parametrize("bad", [None, 1e-3, "adam", optax.adam, {}])
def test_bad_arguments_raise_as_for_the_fitter(place, bad):
    arguments = list(SMALL.arguments())
    arguments[place] = bad
    with pytest.raises(TypeError) as want:
        jaxpets.fitter(*arguments)
    with pytest.raises(TypeError) as got:
        jaxpets.fused_fitter(*arguments)
    assert str(got.value) == str(want.value)


def test_bad_calls_raise_as_for_the_fitter():
    """Of a kernel that was built."""
    params, key, state = start(SMALL)
    dataset = SMALL.dataset(70)
    narrow = SMALL.but(obs_size=2).dataset(70)
    calls = [
        (None, key, state, dataset),
        (params, jax.random.PRNGKey(0), state, dataset),
        (params, key, None, dataset),
        (params, key, state._replace(opt_state=()), dataset),
        (params, key, state, narrow),
    ]
    for call in calls:
        with pytest.raises((TypeError, ValueError)) as want:
            SMALL.plain().step(*call)
        with pytest.raises(type(want.value)) as got:
            SMALL.reference().step(*call)
        assert str(got.value) == str(want.value)
