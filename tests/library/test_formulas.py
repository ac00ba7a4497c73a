"""Rewards as text: what they mean, what is refused, and that nothing is compiled."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxpets
from jaxpets import PlanParams, formulas
from jaxpets.typing import Coordinate

settings.register_profile(
    "formulas", deadline=None, derandomize=True, database=None, max_examples=100
)
NAMES = {"velocity": 0, "height": 2, "pitch": 1}
ROWS = 7


def steps():
    draw = np.random.default_rng(0)
    obs, next_obs = draw.normal(size=(2, ROWS, 3)).astype(np.float32)
    next_obs[0] = 0.0
    return obs, draw.normal(size=(ROWS, 2)).astype(np.float32), next_obs


OBS, ACTION, NEXT_OBS = steps()
VARIABLES = {
    **{word: NEXT_OBS[:, place] for word, place in NAMES.items()},
    "effort": np.sum(ACTION**2, -1),
    "action_0": ACTION[:, 0],
    "action_1": ACTION[:, 1],
    "pi": np.float32(np.pi),
}


def parse(text):
    return formulas.parse(text, NAMES, 2)


@pytest.fixture(scope="module")
def run():
    """One program for every formula of the file."""
    step = jax.jit(formulas.reward)
    yield lambda formula: np.asarray(step(formula, OBS, ACTION, NEXT_OBS))
    assert step._cache_size() == 1


def tolerance(x, low, high, margin):
    outside = np.maximum(np.maximum(low - x, x - high), 0)
    soft = 0.1 ** (outside / np.where(margin > 0, margin, 1)) ** 2
    return np.where(margin > 0, soft, outside == 0)


# The same in NumPy, by what Python itself makes of the text.
FUNCTIONS = {
    "abs": np.abs, "sqrt": np.sqrt, "exp": np.exp, "log": np.log, "sin": np.sin,
    "cos": np.cos, "tanh": np.tanh, "square": np.square, "sign": np.sign,
    "min": lambda *x: np.min(np.broadcast_arrays(*x), axis=0),
    "max": lambda *x: np.max(np.broadcast_arrays(*x), axis=0),
    "where": lambda c, a, b: np.where(np.asarray(c) != 0, a, b),
    "clip": lambda x, low, high: np.minimum(np.maximum(x, low), high),
    "tolerance": tolerance,
}  # fmt: skip


def by_numpy(text):
    with np.errstate(all="ignore"):
        value = eval(text, {}, {**FUNCTIONS, **VARIABLES})  # of this file's own texts
    return np.broadcast_to(np.asarray(value, np.float32), ROWS)


TEXTS = (
    "velocity",
    "+height",
    "-2",
    "pi",
    "-(velocity - 2)**2 - 0.1 * effort + height",
    "-velocity ** 2 / 3 ** height",
    "2 ** -1 ** 2",
    "action_0 * action_1 - effort",
    "velocity > 0",
    "(height <= pitch) + 2 * (height == 0) + 4 * (height != 0) + 8 * (pitch >= 0)",
    "min(velocity, height, 0.5) + max(pitch, -0.5)",
    "where(velocity > 0, height, where(pitch < 0, sqrt(abs(pitch)), 3))",
    "clip(velocity * 3, -1, 1) * sign(height) + square(tanh(pitch))",
    "exp(sin(pitch)) - cos(pitch) + log(effort)",
    "tolerance(velocity, -0.2, 0.3, 0.5)",
    "tolerance(velocity, -0.2, 0.3, 0)",
    "tolerance(velocity, 1, 2, 1) * tolerance(height, 1, 2 + pitch, 1)",
    "1 / velocity + log(height)",  # not finite in a row
)


@pytest.mark.parametrize("text", TEXTS)
def test_a_formula_means_what_it_says(run, text):
    # A few roundings of float32, and the functions of two libraries.
    np.testing.assert_allclose(run(parse(text)), by_numpy(text), rtol=2e-5, atol=2e-6)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("-1 < velocity < 1", lambda v: (v["velocity"] > -1) & (v["velocity"] < 1)),
        ("velocity and height", lambda v: (v["velocity"] != 0) & (v["height"] != 0)),
        ("not height or pitch > 0", lambda v: (v["height"] == 0) | (v["pitch"] > 0)),
    ],
)  # fmt: skip
def test_what_is_true_is_one(run, text, expected):
    np.testing.assert_array_equal(run(parse(text)), np.float32(expected(VARIABLES)))


LEAVES = st.one_of(
    st.sampled_from(sorted(VARIABLES)), st.sampled_from(["0.5", "2", "1e-3", "3"])
)


def grown(inner):
    return st.one_of(
        st.tuples(inner, st.sampled_from("+-*/"), inner).map(
            lambda x: f"({x[0]} {x[1]} {x[2]})"
        ),
        inner.map(lambda x: f"-{x}"),
        st.tuples(st.sampled_from(["sin", "tanh", "abs"]), inner).map(
            lambda x: f"{x[0]}({x[1]})"
        ),
        st.tuples(inner, inner, inner).map(lambda x: f"where({x[0]}, {x[1]}, {x[2]})"),
        st.tuples(inner, inner).map(lambda x: f"min({x[0]}, {x[1]})"),
    )


@settings.get_profile("formulas")
@given(st.recursive(LEAVES, grown, max_leaves=12))
def test_random_formulas_equal_numpy(run, text):
    value, wanted = run(parse(text)), by_numpy(text)
    # Where numbers cancel, of large ones only their rounding is left.
    close = np.isclose(value, wanted, rtol=1e-3, atol=1e-3, equal_nan=True)
    tame = np.isfinite(wanted) & (np.abs(wanted) < 100)
    assert (close | ~tame).mean() > 0.5 and (close | ~tame)[1:].sum() >= ROWS - 2


@pytest.mark.parametrize(
    ("text", "message", "column"),
    [
        ("", "A formula is wanted", 0),
        ("  \n", "A formula is wanted", 0),
        ("1 + velocty", "There is no 'velocty', but velocity", 4),
        ("  zzz", "but velocity, height, pitch, action_0", 2),
        ("sinn(1)", "There is no 'sinn', but sin", 0),
        ("2 * sin", "sin is a function", 4),
        ("action_2", "There is no 'action_2', but action_1, action_0", 0),
        ("(velocity", "'(' was never closed", 0),
        ("1 +", "cannot be read", 3),
        ("velocity @ 2", "'@' has no meaning here", 9),
        ("velocity + '\x00'", "has no meaning", 11),
        ("é", "'é' has no meaning here", 0),
        ("1e999", "too large", 0),
        ("1 + 1e39", "too large", 4),
        ("9" * 400, "too large", 0),
        ("1j", "1j is no number", 0),
        ("True", "True is no number", 0),
        ("qvel.rootx", "underscore", 0),
        ("1 if velocity else 2", "and not this", 0),
        ("7 // 2", "and not this", 0),
        ("velocity is 2", "Comparisons are", 0),
        ("max(1)", "max takes 2 or more, not 1, arguments", 0),
        ("clip(1, 2)", "clip takes 3, not 2, arguments", 0),
        ("abs(x=1)", "without names", 0),
        ("abs(*velocity)", "and not this", 4),
        ("1" + " + 1" * 40, "longer than 64 operations", 0),
        # Written out, each of these comparisons is twice as long as the one in it.
        ("1<(" * 60 + "velocity" + ")<1" * 60, "longer than 64 operations", 0),
        ("x" * 1001, "at most 1000 characters, not 1001", 1000),
        ("-" * 999 + "1", "", None),
        ("(" * 400 + "1" + ")" * 400, "", None),
    ],
)
def test_what_is_wrong_is_said_where_it_is(text, message, column):
    with pytest.raises(formulas.FormulaError) as caught:
        parse(text)
    assert message in caught.value.message
    assert column is None or caught.value.column == column
    assert str(caught.value).endswith(f"(character {caught.value.column + 1})")


def test_a_formula_is_no_wider_than_the_machine():
    inner = "tolerance(0, 0, 0, 0)"
    middle = f"tolerance({inner}, {inner}, {inner}, {inner})"
    assert int(parse(f"{middle} + {middle}").size) == 43
    with pytest.raises(formulas.FormulaError, match="nested too deeply"):
        parse(f"where({middle}, {middle}, {middle})")
    words = {f"x{i}": i for i in range(17)}
    formulas.parse("+".join([*words][:16]), words)
    with pytest.raises(formulas.FormulaError, match="name after 16 others"):
        formulas.parse("+".join(words), words)


def test_a_stack_that_is_used_up_is_an_error_as_any_other(monkeypatch):
    def deep(*_, **__):
        raise RecursionError

    monkeypatch.setattr("jaxpets._src.formula_program._need", deep)
    with pytest.raises(formulas.FormulaError, match="nested too deeply"):
        parse("velocity + 1")
    monkeypatch.setattr("ast.parse", deep)
    with pytest.raises(formulas.FormulaError, match="nested too deeply"):
        parse("velocity + 1")


TOKENS = st.sampled_from(
    [*NAMES, *formulas.FUNCTIONS, *"()+-*/<>=!,. \t\n\x00\\'\"#:[]{}é", "**", "1",
     "9e9", "0x", "_", "if", "else", "and", "or", "not", "lambda", "None",
     "await", "yield", "9" * 300, "((((((((((", "--------"]
)  # fmt: skip


@settings.get_profile("formulas")
@given(st.one_of(st.text(max_size=60), st.lists(TOKENS, max_size=25).map("".join)))
def test_any_text_is_a_formula_or_an_error_with_a_place(text):
    try:
        formula = parse(text)
    except formulas.FormulaError as error:
        assert 0 <= error.column <= len(text) and error.message.endswith(".")
    else:
        assert 0 < int(formula.size) <= 64


@pytest.mark.filterwarnings("error")
def test_pythons_own_warnings_are_not_shown():
    with pytest.raises(formulas.FormulaError, match="cannot be read"):
        formulas.parse("1if height", {"height": 0})


def test_entries_have_words():
    rows = [
        Coordinate(name)
        for name in ("qvel/rootx", "a.b", "a/b", "obs/0", "9", "min", "effort", "if",
                     "action_3", "")
    ]  # fmt: skip
    found = formulas.names(rows, {"velocity": 0, "a_b": 0, "qvel/rootx": 0})
    assert found == {
        "qvel_rootx": 0, "a_b": 1, "a_b_": 2, "obs_0": 3, "_9": 4, "min_": 5,
        "effort_": 6, "if_": 7, "action_3_": 8, "_": 9, "velocity": 0, "a_b__": 0,
    }  # fmt: skip
    for word in found:
        formulas.parse(word, found)


def test_other_arguments_are_checked():
    with pytest.raises(TypeError, match="text must be a str, got 3"):
        formulas.parse(3, {})
    for size in (-1, 0):
        with pytest.raises(
            ValueError, match=f"action_size must be at least 1, got {size}"
        ):
            formulas.parse("1", {}, size)
    with pytest.raises(ValueError, match="'x'"):
        formulas.parse("x", {"x": -1})
    rows = [Coordinate("a"), Coordinate("b")]
    with pytest.raises(ValueError, match=r"aliases\['x'\] must be one of 2 .* got 2"):
        formulas.names(rows, {"x": 2})
    with pytest.raises(
        TypeError, match=r"aliases\['x'\] must be a Python int, got 'a'"
    ):
        formulas.names(rows, {"x": "a"})
    with pytest.raises(TypeError, match=r"coordinates\[0\] must be a Coord.*, got str"):
        formulas.names(["a", "b"])
    with pytest.raises(TypeError, match=r"aliases must be places .*, got list"):
        formulas.names(rows, ["a"])
    with pytest.raises(TypeError, match=r"names must be places .*, got list"):
        formulas.parse("a", rows)  # what formulas.names makes words of
    with pytest.raises(TypeError, match="a word of names must be a text, got 1"):
        formulas.parse("a", {1: 0})
    with pytest.raises(TypeError, match="formula must be a Formula, got str"):
        formulas.reward("velocity", OBS, ACTION, NEXT_OBS)


def test_formulas_map_and_serve_particles(run):
    """Of many formulas at once, and of particles that share an action."""
    parsed = [parse(text) for text in TEXTS[:5]]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *parsed)
    particles = NEXT_OBS[:6].reshape(2, 3, 3)
    mapped = jax.vmap(formulas.reward, (0, None, None, None))
    values = jax.jit(mapped)(stacked, particles, ACTION[0], particles)
    assert values.shape == (5, 2, 3)
    # The first four do not read the action; the fifth, all steps that of the first.
    expected = np.stack([run(formula)[:6] for formula in parsed]).reshape(5, 2, 3)
    effort = VARIABLES["effort"]
    expected[4] += 0.1 * (effort[:6] - effort[0]).reshape(2, 3)
    np.testing.assert_allclose(values, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    "text", ["not velocity < 1", "velocity ** 0", "-(velocity < 1)"]
)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_where_an_entry_has_no_value_neither_has_a_formula_of_it(run, text, bad):
    """A comparison alone would say 0 or 1, which might be the best there is."""
    reward = jax.jit(functools.partial(formulas.reward))  # a cache of its own
    rows = jnp.asarray(NEXT_OBS).at[::2, NAMES["velocity"]].set(bad)
    value = reward(parse(text), rows, ACTION, rows)
    assert np.isnan(value[::2]).all()
    np.testing.assert_array_equal(value[1::2], run(parse(text))[1::2])
    other = parse("height + action_1")  # which does not read it
    value = reward(other, rows, ACTION, rows)
    np.testing.assert_array_equal(value, run(other))


def test_a_planner_takes_any_formula_without_compiling_again():
    force = np.ones(1, np.float32)
    search = jaxpets.optimizers.cem(
        horizon=4, num_samples=32, num_elites=4, num_iterations=2,
        action_low=-force, action_high=force,
    )  # fmt: skip
    rollout = jaxpets.particle_rollout(toys.cart)
    planner = jaxpets.plan(rollout, formulas.reward, search)
    step = jax.jit(planner.step)
    words = {"position": 0, "velocity": 1}
    actions = []
    for text in ("velocity", "-velocity - 0.1 * effort", "action_0 / 0"):
        formula = formulas.parse(text, words, 1)
        params = PlanParams(jnp.float32(1.0), formula)
        out, _ = step(params, jax.random.key(0), planner.init(), jnp.zeros(2))
        actions.append(float(out.action[0]))
    assert actions[0] > 0.3 and actions[1] < -0.3 and np.isfinite(actions[2])
    assert step._cache_size() == 1
