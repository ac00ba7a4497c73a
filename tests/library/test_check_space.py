"""A space that no model can be learned in is refused, with the entry that is wrong."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import toys

import jaxpets
from jaxpets import coordinates, policies
from jaxpets.envs import half_cheetah as hc

SPACE = jaxpets.delta_space()
DATA = toys.transitions(30)


def check(space, data=DATA, **options):
    jaxpets.check_space(space, data.obs, data.next_obs, **options)


def test_without_rows_there_is_nothing_to_try():
    message = "the number of rows of obs must be at least 1, got 0"
    with pytest.raises(ValueError, match=message):
        check(SPACE, jax.tree.map(lambda x: x[:0], DATA))


def test_a_space_that_keeps_the_law_passes():
    check(SPACE)


@pytest.mark.parametrize("space", [hc.model_space(), jaxpets.delta_space()])
def test_the_spaces_of_the_library_pass_on_data_of_the_robot(space):
    env = hc.half_cheetah_native(num_threads=1)

    def step(state, action):
        after = env.step(state, action)
        return after, (state.obs, after.obs)

    @jax.jit
    def trial(key):
        actions = jax.random.uniform(key, (20, 6), jnp.float32, -1.0, 1.0)
        return jax.lax.scan(step, env.reset(key), actions)[1]

    obs, next_obs = trial(jax.random.key(0))
    jaxpets.check_space(space, obs, next_obs)


def test_a_wrong_sign_is_refused_and_its_entry_named():
    """Such a space trains as well as a right one, and predicts nonsense."""
    sign = jnp.array([1.0, -1.0])
    wrong = SPACE._replace(target=lambda obs, next_obs: sign * (next_obs - obs))
    with pytest.raises(ValueError, match=r"must be next_obs, but entry 1 is off by"):
        check(wrong)


def test_an_error_as_small_as_the_tolerance_passes():
    near = SPACE._replace(next_obs=lambda obs, target: obs + target + 1e-3)
    check(near, tolerance=2e-3)
    with pytest.raises(ValueError, match=r"off by up to 0\.001"):
        check(near)


def test_a_space_that_forgets_is_refused_even_if_it_makes_nan():
    lost = SPACE._replace(next_obs=lambda obs, target: jnp.log(-jnp.abs(target)))
    with pytest.raises(ValueError, match="entry 0 is off by up to nan"):
        check(lost)


@pytest.mark.parametrize("bad", [jnp.nan, jnp.inf])
@pytest.mark.parametrize("name", ["features", "target"])
def test_numbers_that_are_not_finite_are_refused_and_their_entry_named(name, bad):
    spoilt = SPACE._replace(**{name: lambda *rows: rows[0].at[3, 1].set(bad)})
    with pytest.raises(ValueError, match=rf"space\.{name} .* finite .* entry 1"):
        check(spoilt)


WRONG_SHAPES = {
    "features": lambda obs: obs[0],
    "target": lambda obs, next_obs: next_obs[:, :1],
    "next_obs": lambda obs, target: jnp.concatenate([obs, target], axis=1),
    "bound": lambda obs, low, high: low,
}


@pytest.mark.parametrize("name", WRONG_SHAPES)
def test_a_wrong_shape_is_refused_and_its_function_named(name):
    wrong = SPACE._replace(**{name: WRONG_SHAPES[name]})
    with pytest.raises(ValueError, match=rf"space\.{name}'s result must be float32"):
        check(wrong)


def test_what_is_no_space_or_no_data_is_refused():
    with pytest.raises(TypeError, match="space must be a ModelSpace, got NoneType"):
        check(None)
    with pytest.raises(ValueError, match=r"obs must be float32\[T, D\], got"):
        jaxpets.check_space(SPACE, DATA.obs[0], DATA.next_obs[0])
    with pytest.raises(ValueError, match=r"next_obs must be float32\[30, 2\], got"):
        jaxpets.check_space(SPACE, DATA.obs, DATA.next_obs[:3])
    with pytest.raises(ValueError, match="tolerance must be finite and at least 0"):
        jaxpets.check_space(SPACE, *DATA[::2], tolerance=float("nan"))
    with pytest.raises(ValueError, match=r"obs must be float32\[T, D\], got int32"):
        rows = np.zeros((3, 2), np.int32)
        jaxpets.check_space(SPACE, rows, rows)


# -- its size ------------------------------------------------------------------------

ONE = np.ones(1, np.float32)
BOX = dict(action_low=-ONE, action_high=ONE)
CHANCE = jaxpets.random_planner(-ONE, ONE)
LEARNED = (toys.cart, toys.reach, optax.adam(1e-3))
PARAMS = policies.ActorCriticParams(*[()] * 6)
BUILD = {
    "ensemble": lambda space, **sizes: jaxpets.ensemble(
        jaxpets.EnsembleConfig(), space, action_size=1, **sizes
    ),
    "actor_critic": lambda space, **sizes: policies.actor_critic(
        *LEARNED, policies.ActorCriticConfig(), space, **sizes, **BOX
    ),
    "distill": lambda space, **sizes: jaxpets.distill(
        CHANCE, *LEARNED, policies.DistillConfig(), space, **sizes, **BOX
    ),
    "save_policy": lambda space, **sizes: policies.save_policy(
        "none.safetensors", PARAMS, space, **sizes, **BOX
    ),
    "to_onnx": lambda space, **sizes: policies.to_onnx(PARAMS, space, **sizes, **BOX),
}


@pytest.mark.parametrize("name", BUILD)
def test_a_space_is_of_the_observations(name):
    """One of a single row would be taken for all entries, without a word."""
    space = coordinates.space([coordinates.Coordinate("q")])
    with pytest.raises(ValueError, match="obs_size must be 1 as of space, got 2"):
        BUILD[name](space, obs_size=2)
