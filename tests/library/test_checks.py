import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxpets
from jaxpets import policies
from jaxpets._src import checks
from jaxpets._src.action_box import action_box


@pytest.mark.parametrize("value", [1, 7, np.int32(3), np.uint8(200)])
def test_count_takes_integers(value):
    """And returns those of Python, which do not overflow."""
    found = checks.check_count("num", value)
    assert type(found) is int and found == value
    (found,) = checks.check_counts("nums", [value])
    assert type(found) is int and found == value


@pytest.mark.parametrize("value", [True, 2.0, "3", None, jnp.int32(3)])
def test_count_refuses_what_is_no_python_integer(value):
    with pytest.raises(TypeError, match="num_samples must be a Python int, got"):
        checks.check_count("num_samples", value)


def test_count_names_argument_minimum_and_value():
    with pytest.raises(ValueError, match="num_elites must be at least 2, got 1"):
        checks.check_count("num_elites", 1, minimum=2)


@pytest.mark.parametrize("value", [0.0, 1, 0.5, np.float32(0.25), np.int64(0)])
def test_real_takes_numbers_in_range(value):
    checks.check_real("momentum", value, 0.0, 1.0)


@pytest.mark.parametrize("value", [-0.1, 1.1, float("nan"), float("inf")])
def test_real_refuses_what_is_out_of_range(value):
    with pytest.raises(ValueError, match=r"momentum must be in \[0, 1\], got"):
        checks.check_real("momentum", value, 0.0, 1.0)


def test_real_without_a_greatest_value_says_so():
    for value in (-1.0, float("inf"), 1e39, 10**400):  # float32 holds neither
        with pytest.raises(ValueError, match="decay must be finite and at least 0"):
            checks.check_real("decay", value, 0.0)


@pytest.mark.parametrize("value", [np.float64(0.1), np.int64(1), np.int32(1)])
def test_a_number_of_numpy_becomes_one_of_python(value):
    found = checks.check_scalar("std", value, 0.0, 1.0)
    assert type(found) in (int, float) and found == value


@pytest.mark.parametrize(
    ("config", "name", "number"),
    [
        (jaxpets.EnsembleConfig, "bound_decay", np.float64(0.5)),
        (jaxpets.EnsembleConfig, "state_margin", np.float64(0.5)),
        (jaxpets.EnsembleConfig, "weight_decays", np.float64(0.5)),
        (jaxpets.FitConfig, "final_rate", np.float64(0.5)),
        (policies.ActorCriticConfig, "trace", np.float64(0.5)),
        (policies.ActorCriticConfig, "noise", np.float64(0.5)),
        (policies.DistillConfig, "planned", np.float64(0.5)),
        (policies.DistillConfig, "noise", np.float64(0.5)),
        (policies.DistillConfig, "restart", np.float64(0.5)),
        (jaxpets.EnsembleConfig, "num_members", np.uint8(8)),
        (jaxpets.FitConfig, "num_epochs", np.uint8(8)),
        (jaxpets.FitConfig, "batch_size", np.uint8(8)),
        (policies.ActorCriticConfig, "batch_size", np.uint8(8)),
        (policies.DistillConfig, "num_trials", np.uint8(8)),
    ],
)
def test_a_config_keeps_numbers_of_python(config, name, number):
    """Those of NumPy make float64 of what they meet under x64, and overflow."""
    kind = int if isinstance(number, np.integer) else float
    assert type(getattr(config(**{name: number}), name)) is kind


def test_a_search_of_small_integers_of_numpy_does_not_overflow():
    search = jaxpets.optimizers.icem(
        horizon=np.uint8(3), action_low=-np.ones(1), action_high=np.ones(1),
        num_samples=np.uint8(100), num_elites=np.uint8(70),
        num_iterations=np.uint8(2), keep_candidates=True,
    )  # fmt: skip
    solution, _ = search.step(
        lambda key, actions: jnp.sum(actions, (1, 2)), jax.random.key(0), search.init()
    )
    # Twice: samples, and 0.3 of the elites of before; the mean at last.
    assert solution.candidates.values.shape == (2 * (100 + 21) + 1,)


@pytest.mark.parametrize("value", [0.1, 1, np.float32(0.1), jnp.float32(0.1)])
def test_any_other_number_is_as_it_came(value):
    assert checks.check_scalar("std", value, 0.0, 1.0) is value


@pytest.mark.parametrize("value", [0.5, np.float32(0.5), jnp.float32(0.5)])
def test_scalar_takes_numbers_and_arrays(value):
    checks.check_scalar("std", value, 0.0, 1.0)


@pytest.mark.parametrize("value", [1.5, jnp.float32(1.5), jnp.float32(jnp.nan)])
def test_scalar_refuses_what_is_out_of_range(value):
    with pytest.raises(ValueError, match=r"std must be in \[0, 1\], got"):
        checks.check_scalar("std", value, 0.0, 1.0)


def test_scalar_takes_what_is_traced_if_it_is_one_float32():
    def check(value):
        checks.check_scalar("std", value, 0.0, 1.0)
        return value

    assert jax.vmap(check)(jnp.array([0.5, 2.0])).shape == (2,)
    with pytest.raises(ValueError, match=r"std must be float32\[\], got float32\[2\]"):
        jax.jit(check)(jnp.ones(2))
    with pytest.raises(ValueError, match=r"std must be float32\[\], got int32\[\]"):
        checks.check_scalar("std", jnp.int32(1), 0.0, 1.0)


@pytest.mark.parametrize("value", [True, np.True_, False])
def test_flag_takes_booleans(value):
    checks.check_flag("legacy", value)


@pytest.mark.parametrize("value", [1, "no", None, jnp.bool_(True)])
def test_flag_refuses_what_is_true_by_chance(value):
    with pytest.raises(TypeError, match="legacy must be True or False, got"):
        checks.check_flag("legacy", value)


@pytest.mark.parametrize("value", [True, "0.5", None])
def test_real_refuses_other_types(value):
    with pytest.raises(TypeError, match="momentum must be a Python float, got"):
        checks.check_real("momentum", value, 0.0, 1.0)


@pytest.mark.parametrize(
    ("shape", "wanted"),
    [
        ((3,), ["D"]),
        ((3,), [3]),
        ((2, 3), [None, 3]),
        ((3,), ["...", 3]),
        ((4, 5, 3), ["...", 3]),
        ((), []),
    ],
)
def test_array_takes_fitting_shapes(shape, wanted):
    checks.check_array("obs", jnp.zeros(shape, jnp.float32), wanted)


@pytest.mark.parametrize(
    ("shape", "wanted", "text"),
    [
        ((3,), [2], r"obs must be float32\[2\], got float32\[3\]"),
        ((3,), ["B", 3], r"obs must be float32\[B, 3\], got float32\[3\]"),
        ((2, 4), ["...", 3], r"obs must be float32\[\.\.\., 3\], got float32\[2, 4\]"),
        ((), ["...", 3], r"obs must be float32\[\.\.\., 3\], got float32\[\]"),
        ((1,), [None, 1], r"obs must be float32\[\?, 1\], got float32\[1\]"),
    ],
)
def test_array_says_what_was_wanted_and_what_came(shape, wanted, text):
    with pytest.raises(ValueError, match=text):
        checks.check_array("obs", jnp.zeros(shape, jnp.float32), wanted)


@pytest.mark.parametrize("dtype", [jnp.int32, jnp.bfloat16, jnp.bool_])
def test_array_refuses_other_dtypes(dtype):
    name = jnp.dtype(dtype).name
    with pytest.raises(ValueError, match=rf"obs must be float32\[D\], got {name}\[3\]"):
        checks.check_array("obs", jnp.zeros(3, dtype), ["D"])


@pytest.mark.parametrize("value", [[1.0], None, "box"])
def test_array_names_the_argument_when_no_array_came(value):
    with pytest.raises((TypeError, ValueError), match="action_low must be float32"):
        checks.check_array("action_low", value, ["A"])


BAD_BOXES = {
    "crossed": ([1.0], [-1.0]),
    "flat": ([1.0], [1.0]),
    "infinite": ([-np.inf], [1.0]),
    "nan": ([np.nan], [1.0]),
    "widths": ([-1.0, -1.0], [1.0]),
    "scalar": (-1.0, 1.0),
    "empty": ([], []),
}


@pytest.mark.parametrize("name", BAD_BOXES)
def test_action_box_refuses_what_cannot_be_searched(name):
    low, high = (jnp.asarray(bound, jnp.float32) for bound in BAD_BOXES[name])
    with pytest.raises(ValueError, match=r"action_(low|high)"):
        action_box(low, high)


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ([-3.4e38], [3.4e38]),  # the width is infinite
        ([-1e300], [1e300]),
        ([-1e20], [1e20]),  # its square is
        ([-1.0, 1.0], [1.0, 1.0 + 1e-9]),  # one number
        ([-1e-25], [1e-25]),
    ],
)
def test_action_box_refuses_what_is_no_box_of_float32(low, high):
    message = r"action_low and action_high .* in float32 .*, got .* and "
    with pytest.raises(ValueError, match=message):
        action_box(np.array(low), np.array(high))


@pytest.mark.parametrize("dtype", [np.float64, np.int32])
def test_an_action_box_is_float32_whatever_its_bounds_are(dtype):
    box = action_box(-np.ones(2, dtype), np.full(2, 3, dtype))
    assert all(part.dtype == jnp.float32 for part in box)
    np.testing.assert_array_equal(box.center, [1.0, 1.0])
    np.testing.assert_array_equal(box.half_width, [2.0, 2.0])


@pytest.mark.parametrize("bound", [None, "box", [-1.0], np.array(["a"])])
def test_an_action_box_is_of_numbers(bound):
    wanted = r"action_low must be an array of numbers \[A\], got"
    with pytest.raises(TypeError, match=wanted):
        action_box(bound, np.ones(1))


def test_action_box_looks_at_no_traced_value():
    def build(low):
        action_box(low, -low)
        return low

    jax.jit(build)(jnp.ones(2))  # crossed, but that is not known while tracing


def test_key_takes_one_typed_key():
    checks.check_key("key", jax.random.key(0))
    jax.jit(lambda key: checks.check_key("key", key))(jax.random.key(0))


@pytest.mark.parametrize("key", [jax.random.PRNGKey(0), 0, None])
def test_key_refuses_raw_keys(key):
    with pytest.raises(TypeError, match=r"plan_key must be a typed key .* got"):
        checks.check_key("plan_key", key)


def test_key_refuses_a_batch():
    keys = jax.random.split(jax.random.key(0), 3)
    with pytest.raises(ValueError, match=r"key must be a single key.*\(3,\).*vmap"):
        checks.check_key("key", keys)


@pytest.mark.parametrize("values", [0.5, "much", None])
def test_reals_take_a_sequence(values):
    with pytest.raises(TypeError, match=r"rates must be a tuple of floats, got"):
        checks.check_reals("rates", values, 0.0)


def test_a_record_in_place_of_a_function_is_named_with_its_functions():
    """And not printed, which would be a page of them."""
    model = jaxpets.ensemble(
        jaxpets.EnsembleConfig(), jaxpets.delta_space(), obs_size=4, action_size=2
    )
    words = "dynamics_fn must be a function, got Ensemble, whose functions are init, "
    with pytest.raises(TypeError, match=words + r".* sample, .*sentinels\.$"):
        jaxpets.particle_rollout(model)  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match=r"a function, got PlanParams\.$"):
        checks.check_callable("dynamics_fn", jaxpets.PlanParams((), ()))


def test_an_action_box_is_not_the_callers_memory():
    memory = np.zeros(32, np.float32)
    start = (-memory.ctypes.data % 64) // 4  # an array that JAX could take as it lies
    high = memory[start : start + 1]
    high[:] = 1.0
    box = action_box(-np.ones(1, np.float32), high)
    high[:] = 5.0
    assert float(box.high[0]) == 1.0
