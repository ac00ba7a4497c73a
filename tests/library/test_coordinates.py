"""Coordinates as data: the space they mean, their names, their text."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxpets
from jaxpets import coordinates
from jaxpets._src.kernel.jaxpr_to_cpp import cpp_function
from jaxpets.coordinates import Coordinate
from jaxpets.envs import half_cheetah as hc

TURN = tuple(
    Coordinate(f"ball.q{x}", "quaternion", is_bounded=False) for x in "wxyz"
)  # fmt: skip
ROWS = (
    Coordinate("speed", "absolute", is_input=False),
    Coordinate("height"),
    *TURN,
    Coordinate("pole", "angle", is_bounded=False),
    Coordinate("place", is_input=False, is_bounded=False),
    Coordinate("rate"),
)
QUATERNION, ANGLE = slice(2, 6), 6
SPACE = coordinates.space(ROWS)


def matrix(quaternion):
    """The rotation matrix of a unit quaternion, from its action on the axes."""
    w, v = quaternion[0], quaternion[1:]
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return (w**2 - v @ v) * np.eye(3) + 2 * np.outer(v, v) + 2 * w * cross


def rows_of(count, seed=0):
    """Observations whose quaternions are unit, `[count, 9]`."""
    obs = np.random.default_rng(seed).normal(size=(count, len(ROWS)))
    obs[:, QUATERNION] /= np.linalg.norm(obs[:, QUATERNION], axis=-1, keepdims=True)
    return obs.astype(np.float32)


def test_the_law_holds_with_every_kind():
    jaxpets.check_space(SPACE, rows_of(50), rows_of(50, seed=1))
    assert SPACE.coordinates == ROWS


def test_the_space_of_the_cheetah_follows_from_its_joints():
    """The arithmetic that its coordinates had when they were written by hand."""
    space = hc.model_space()
    relative = jnp.ones(18).at[hc.FORWARD_VELOCITY].set(0.0)

    def features(obs):
        pitch = obs[..., hc.PITCH, None]
        rest = obs[..., hc.PITCH + 1 :]
        parts = [obs[..., hc.HEIGHT, None], jnp.sin(pitch), jnp.cos(pitch), rest]
        return jnp.concatenate(parts, axis=-1)

    def arithmetic(function, *arguments):
        return cpp_function("f", function, [(name, 18) for name in arguments])

    assert arithmetic(space.features, "o") == arithmetic(features, "o")
    want = arithmetic(lambda o, x: x - relative * o, "o", "x")
    assert arithmetic(space.target, "o", "x") == want
    want = arithmetic(lambda o, x: relative * o + x, "o", "x")
    assert arithmetic(space.next_obs, "o", "x") == want
    names = [row.name for row in space.coordinates]
    assert names[hc.FORWARD_VELOCITY] == "mean_qvel/rootx"
    assert names[hc.PITCH] == "qpos/rooty" and names[hc.PITCH_RATE] == "qvel/rooty"
    (free,) = [i for i, row in enumerate(space.coordinates) if not row.is_bounded]
    assert free == hc.PITCH


def test_features_show_angles_and_turns_as_they_look():
    obs = rows_of(1)[0]
    features = jax.jit(SPACE.features)
    got = np.asarray(features(obs))
    turn = matrix(np.float64(obs[QUATERNION]))
    pole = float(obs[ANGLE])
    want = [obs[1], *turn[:, 0], *turn[:, 1], math.sin(pole), math.cos(pole), obs[8]]
    np.testing.assert_allclose(got, want, atol=1e-6)
    same = obs.copy()
    same[QUATERNION] *= -1
    same[ANGLE] += 2 * math.pi
    np.testing.assert_allclose(features(same), got, atol=1e-5)


def test_a_turn_is_in_the_frame_of_the_body():
    """Half the rotation vector, whichever way the body looked before."""
    spin = np.array([0.02, -0.03, 0.01])
    angle = np.linalg.norm(spin)
    turn = np.array([math.cos(angle / 2), *(math.sin(angle / 2) * spin / angle)])
    space = coordinates.space(TURN)
    target_of, next_of = jax.jit(space.target), jax.jit(space.next_obs)
    for before in rows_of(5)[:, QUATERNION]:
        w, x, y, z = np.float64(before)
        left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
        after = np.float32(left @ turn)
        target = target_of(before, after)
        np.testing.assert_allclose(np.asarray(target)[1:], spin / 2, atol=1e-5)
        back = next_of(before, target)
        np.testing.assert_allclose(back, after, atol=1e-6)


def test_predicted_quaternions_are_unit():
    obs = rows_of(20)
    target = 2 * np.random.default_rng(1).normal(size=obs.shape).astype(np.float32)
    next_of = jax.jit(SPACE.next_obs)
    got = np.asarray(next_of(obs, target))[:, QUATERNION]
    np.testing.assert_allclose(np.linalg.norm(got, axis=-1), 1.0, atol=1e-6)
    undone = np.zeros(9, np.float32)
    undone[QUATERNION.start] = -1.0
    assert np.isfinite(next_of(obs[0], undone)).all()


def test_bound_leaves_free_what_the_table_says():
    one = np.ones(9, np.float32)
    got = jax.jit(SPACE.bound)(np.float32([50 * one, 50 * one]), -one, one)
    want = [1.0 if row.is_bounded else 50.0 for row in ROWS]
    np.testing.assert_array_equal(got, [want, want])


def test_entries_have_places_and_unknown_names_near_ones():
    assert coordinates.index(ROWS, "pole") == ANGLE
    with pytest.raises(ValueError, match=r"name must be an entry, as pole.*got 'poel'"):
        coordinates.index(ROWS, "poel")
    with pytest.raises(ValueError, match="as speed, height, ball"):
        coordinates.index(ROWS, "!!")


@pytest.mark.parametrize(
    "function",
    [
        coordinates.space,
        coordinates.table,
        coordinates.to_json,
        lambda rows: coordinates.index(rows, "speed"),
    ],
)
def test_what_is_no_table_is_refused(function):
    """As an environment in place of its coordinates."""
    env = jaxpets.Env(SPACE.target, SPACE.target, np.ones(1), np.ones(1), ROWS)
    with pytest.raises(TypeError, match=r"coordinates\[0\] must be a Coor.* got func"):
        function(env)
    with pytest.raises(TypeError, match="must be a tuple of Coordinate, got int"):
        function(3)


def test_no_entry_is_found_where_there_is_none():
    with pytest.raises(ValueError, match="must have the entry 'speed', but have none"):
        coordinates.index((), "speed")


def test_a_table_goes_to_text_and_back():
    assert coordinates.from_json(coordinates.to_json(ROWS)) == ROWS
    lines = coordinates.table(ROWS).splitlines()
    assert lines[6] == "  6  pole     angle       input"
    assert lines[0] == "  0  speed    absolute           bounded"
    assert coordinates.table(()) == ""


def test_a_flag_of_numpy_goes_to_text():
    row = coordinates.Coordinate("x", is_input=np.bool_(True))
    assert coordinates.from_json(coordinates.to_json([row])) == (row,)


@pytest.mark.parametrize("text", ['{"a": 1}', '[{"name": "x"}]', "[1]"])
def test_other_text_is_refused(text):
    with pytest.raises(ValueError, match="text must be a list of objects with name, k"):
        coordinates.from_json(text)
    with pytest.raises(ValueError, match="kind of entry 'x' must be one of relative"):
        coordinates.from_json(coordinates.to_json([Coordinate("x", "round")]))
    three = [Coordinate(x, "quaternion", is_bounded=False) for x in "xyz"]
    with pytest.raises(ValueError, match="a quaternion must be 4 like rows"):
        coordinates.from_json(coordinates.to_json(three))
    with pytest.raises(ValueError, match="text must be a list of objects, got a deep"):
        coordinates.from_json("[" * 100_000)


BAD = {
    r"coordinates\[1\] must be a Coordinate, got str": (Coordinate("x"), "y"),
    "is_input of entry 'x' must be True or False": (Coordinate("x", is_input=1),),
    "is_bounded of entry 'x' must be False of kind 'angle'": (
        Coordinate("x", "angle"),
    ),
    "names of coordinates must differ, got 'x' twice": (Coordinate("x"),) * 2,
    "coordinates must have an entry that is an input": (),
    "a quaternion must be 4 like rows, but they end after 'ball.qw'": TURN[:3],
}


@pytest.mark.parametrize("message", BAD)
def test_a_table_that_cannot_be_is_refused(message):
    with pytest.raises((TypeError, ValueError), match=message):
        coordinates.space(BAD[message])


def test_the_rows_of_a_quaternion_are_alike():
    odd = TURN[3]._replace(is_input=False)
    with pytest.raises(ValueError, match="a quaternion must be 4 like rows"):
        coordinates.space([*TURN[:3], odd, Coordinate("x")])
