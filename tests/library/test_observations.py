"""Entries by name, and what of a robot's place nothing depends on."""

import mujoco
import numpy as np
import pytest
import robots

from jaxpets.coordinates import Coordinate
from jaxpets.envs import half_cheetah as hc
from jaxpets.envs.observations import DEFAULT, readings
from jaxpets.envs.symmetry import free_shifts

FREE = mujoco.MjModel.from_xml_string(robots.FREE_XML)


def rows(model, *observe):
    return {r.coordinate.name: r for r in readings(model, observe or DEFAULT)}


def test_by_default_a_robot_is_everything_but_its_place():
    found = rows(FREE)
    kinds = {name: reading.coordinate.kind for name, reading in found.items()}
    root = {f"qpos/root.{part}": "quaternion" for part in ("qw", "qx", "qy", "qz")}
    arm = {f"qpos/shoulder.{part}": "quaternion" for part in ("qw", "qx", "qy", "qz")}
    speeds = [f"root.{part}" for part in ("x", "y", "z", "wx", "wy", "wz")]
    speeds += ["hip", "shoulder.wx", "shoulder.wy", "shoulder.wz"]
    want = {
        "mean_qvel/root.x": "absolute",
        "mean_qvel/root.y": "absolute",
        "qpos/root.z": "relative",
        **root,
        "qpos/hip": "relative",
        **arm,
        **{f"qvel/{name}": "relative" for name in speeds},
    }
    assert list(kinds.items()) == list(want.items())
    places = [r.place for r in found.values() if r.source == "qpos"]
    assert places == list(range(2, FREE.nq))
    assert [r.place for r in found.values() if r.source == "qvel"] == list(range(10))


def test_what_follows_from_where_the_robot_stands_is_not_read():
    found = rows(FREE, "qpos/root.x", "qpos/root.z", "xpos/leg", "site_xpos/eye.y")
    seen = {
        n: (r.coordinate.is_input, r.coordinate.is_bounded) for n, r in found.items()
    }
    yes, no = (True, True), (False, False)
    assert seen == {
        "qpos/root.x": no,
        "qpos/root.z": yes,
        "xpos/leg.x": no,
        "xpos/leg.y": no,
        "xpos/leg.z": yes,
        "site_xpos/eye.y": no,
    }
    held = mujoco.MjModel.from_xml_string(robots.CART_XML)
    assert rows(held, "site_xpos/tip.x")["site_xpos/tip.x"].coordinate.is_input


def test_a_sensor_is_seen_as_what_it_is_of():
    sensors = """
      <framepos name="at" objtype="site" objname="eye"/>
      <framepos name="from" objtype="site" objname="foot" reftype="body" refname="leg"/>
      <subtreecom name="middle" body="torso"/>
      <jointpos name="turn" joint="wheel"/>
    """
    wheel = '<body><joint name="wheel" axis="0 1 0"/><geom size="0.02"/></body></body>'
    bodies = robots.FLOOR + robots.FREE.rstrip().removesuffix("</body>") + wheel
    model = robots.compiled(bodies, f"<sensor>{sensors}</sensor>" + robots.HIP)
    found = {name: r.coordinate for name, r in rows(model, "sensordata").items()}
    for name in ("at", "middle"):
        seen = [found[f"sensordata/{name}.{axis}"][1:] for axis in "xyz"]
        unread, read = ("relative", False, False), ("relative", True, True)
        assert seen == [unread, unread, read]
    assert found["sensordata/from.x"][1:] == ("relative", True, True)
    assert found["sensordata/turn"][1:] == ("angle", True, False)
    rail = robots.CART_XML.replace(
        "</mujoco>", '<sensor><jointpos name="s" joint="slider"/></sensor></mujoco>'
    )
    for push, free in (("slider", False), ("hinge", True)):
        driven = rail.replace('name="push" joint="slider"', f'joint="{push}"')
        model = mujoco.MjModel.from_xml_string(driven)
        row = rows(model, "sensordata/s")["sensordata/s"].coordinate
        assert row[1:] == ("relative", not free, not free)


def test_places_are_those_of_mujoco():
    data = mujoco.MjData(FREE)
    data.qpos[:] += np.random.default_rng(0).normal(size=FREE.nq)
    mujoco.mj_forward(FREE, data)
    eye, arm = data.site("eye").xpos, data.body("arm")
    sole, gaze = data.sensor("sole").data, data.sensor("gaze").data
    want = {
        "site_xpos/eye": eye,
        "xpos/arm": arm.xpos,
        "xmat/arm": arm.xmat,
        "subtree_linvel/arm.z": data.subtree_linvel[FREE.body("arm").id][2:],
        "sensordata/sole": sole,
        "sensordata/gaze": gaze,
        "sensordata/drift": data.sensor("drift").data,
    }
    for name, values in want.items():
        found = readings(FREE, [name])
        got = [getattr(data, r.source).reshape(-1)[r.place] for r in found]
        np.testing.assert_array_equal(got, values)
    names = list(rows(FREE, "xmat/arm"))
    assert names[0] == "xmat/arm.xx" and names[5] == "xmat/arm.yz" and len(names) == 9


def test_sensors_are_predicted_as_what_they_are():
    found = [r.coordinate for r in readings(FREE, ["sensordata"])]
    assert found[0] == Coordinate("sensordata/sole", "absolute", is_input=False)
    assert {row.kind for row in found[1:5]} == {"quaternion"}
    names = [row.name.partition("/")[2] for row in found[5:]]
    assert names == ["drift.x", "drift.y", "drift.z", "bend"]
    assert {row.kind for row in found[5:]} == {"relative"}


def test_a_hinge_without_limits_is_an_angle():
    cart = mujoco.MjModel.from_xml_string(robots.CART_XML)
    found = rows(cart)
    assert found["qpos/hinge"].coordinate == Coordinate(
        "qpos/hinge", "angle", is_bounded=False
    )
    nameless = robots.compiled('<body><joint/><geom size="1"/></body>')
    assert list(rows(nameless)) == ["qpos/joint0", "qvel/joint0"]


BAD = {
    "qpos/hipp": r"as qpos/hip.*, got 'qpos/hipp'",
    "qvle": r"as qvel.*, got 'qvle'",
    "qpos/root.w": r"as qpos/root.*, got 'qpos/root.w'",
    3: "got 3",
}


@pytest.mark.parametrize("name", BAD)
def test_unknown_names_are_answered_with_near_ones(name):
    with pytest.raises(ValueError, match=f"observe must have names.*{BAD[name]}"):
        readings(FREE, [name])


def test_nothing_to_observe_is_refused():
    with pytest.raises(TypeError, match="observe must be a sequence of names, got 'q'"):
        readings(FREE, "q")
    with pytest.raises(TypeError, match="observe must be a sequence of names, got 3"):
        readings(FREE, 3)
    with pytest.raises(ValueError, match="observe must name an entry of the model"):
        readings(FREE, [])


def test_a_clock_is_not_read():
    """Steps keep no time, so that it would say the same in every state."""
    sensors = '<sensor><jointpos joint="hip"/><clock name="now"/></sensor>'
    model = robots.compiled(robots.FREE, sensors)
    for observe in ("sensordata/now", "sensordata"):
        with pytest.raises(ValueError, match="no time, but sensordata/now is a cl"):
            readings(model, ["qpos", observe])
    (bend,) = readings(model, ["sensordata/sensor0"])
    assert bend.place == 0


# -- symmetry ------------------------------------------------------------------------

SHAPE = '<geom size="0.1"/>'
SLIDES = (
    '<joint name="x" type="slide" axis="1 0 0"/>'
    '<joint name="z" type="slide" axis="0 0 1"/>'
    '<joint name="pitch" axis="0 1 0"/>'
)
PLANAR = f'<body name="a">{SLIDES}{SHAPE}</body>'
BALL = f'<body name="b"><freejoint name="free"/>{SHAPE}</body>'
SITE = '<site name="hook"/>'
TIED = '<body name="a"><freejoint/><geom size="0.1"/><site name="end"/></body>'
HELD = {
    "a limit": PLANAR.replace('axis="1 0 0"', 'axis="1 0 0" range="-1 1"'),
    "a spring": PLANAR.replace('axis="1 0 0"', 'axis="1 0 0" stiffness="2"'),
    "a hill": PLANAR + '<geom type="plane" size="1 1 1" euler="0 10 0"/>',
    "a box": PLANAR + '<geom type="box" pos="3 0 0" size="1 1 1"/>',
    "another body": PLANAR + BALL,
    "a slope to slide": PLANAR.replace('axis="1 0 0"', 'axis="1 0 0.1"'),
    "a hinge before": PLANAR.replace("<joint", "<joint name='yaw'/><joint", 1),
    "a mocap body": PLANAR + '<body mocap="true"><geom size="0.1"/></body>',
    "no joint": SHAPE,
}
TIES = {
    "an actuator": '<actuator><motor joint="x"/></actuator>',
    "an equality of joints": '<equality><joint joint1="pitch" joint2="x"/></equality>',
    "a coupling of joints": (
        '<tendon><fixed><joint joint="x" coef="1"/><joint joint="z" coef="1"/></fixed>'
        "</tendon>"
    ),
    "a weld": '<equality><weld body1="a"/></equality>',
    "a pair": '<contact><pair geom1="wall" geom2="it"/></contact>',
}


def test_shifts_over_a_floor_are_free():
    assert free_shifts(hc.load_model()) == [0]
    assert free_shifts(FREE) == [0, 1]
    floor = '<body euler="0 0 30"><geom type="plane" size="1 1 1"/></body>'
    ghost = '<geom type="box" size="1 1 1" contype="0" conaffinity="0"/>'
    assert free_shifts(robots.compiled(PLANAR + floor + ghost)) == [0]
    weightless = '<option gravity="0 0 0"/>'
    assert free_shifts(robots.compiled(PLANAR, weightless)) == [0]


def test_a_wall_leaves_the_shift_along_it():
    wall = '<geom type="plane" size="1 1 1" zaxis="0 1 0"/>'
    assert free_shifts(robots.compiled(BALL + wall)) == [0]


@pytest.mark.parametrize("name", HELD)
def test_what_the_world_depends_on_is_kept(name):
    assert free_shifts(robots.compiled(HELD[name])) == []


@pytest.mark.parametrize("name", TIES)
def test_what_something_pulls_at_is_kept(name):
    bodies = PLANAR.replace('size="0.1"', 'name="it" size="0.1"')
    bodies += '<geom name="wall" size="1" contype="0" conaffinity="0"/>'
    assert free_shifts(robots.compiled(bodies, TIES[name])) == []


HOOKED = {
    "a tendon": (
        "<tendon><spatial><site site='hook'/><site site='end'/></spatial></tendon>"
    ),
    "a tendon around a post": (
        "<tendon><spatial><site site='end'/><geom geom='post'/><site site='far'/>"
        "</spatial></tendon>"
    ),
    "an actuator": (
        "<actuator><position site='end' refsite='hook' gear='1 0 0 0 0 0'/></actuator>"
    ),
    "a crank": (
        "<actuator><motor cranksite='end' slidersite='hook' cranklength='2'/>"
        "</actuator>"
    ),
}


@pytest.mark.parametrize("name", HOOKED)
def test_what_leads_to_the_world_holds(name):
    post = '<geom name="post" size="0.1" contype="0" conaffinity="0"/>'
    far = '<site name="far" pos="1 0 0"/></body>'
    bodies = SITE + post + TIED.replace("</body>", far)
    assert free_shifts(robots.compiled(bodies, HOOKED[name])) == []
    # Between two sites of the robot itself it holds nothing.
    own = HOOKED[name].replace("hook", "far")
    if "post" not in own:
        assert free_shifts(robots.compiled(bodies, own)) == [0, 1]


def test_nothing_changes_when_a_robot_is_shifted():
    """What the rule says, tried: the same accelerations somewhere else."""
    for model in (hc.load_model(), FREE):
        data, rng = mujoco.MjData(model), np.random.default_rng(0)
        data.qpos[:] += 0.1 * rng.normal(size=model.nq)
        data.qvel[:] = rng.normal(size=model.nv)
        mujoco.mj_forward(model, data)
        before = data.qacc.copy()
        data.qpos[free_shifts(model)] += 7.0
        mujoco.mj_forward(model, data)
        # The same contacts, a few roundings of seven metres apart.
        np.testing.assert_allclose(data.qacc, before, rtol=1e-6, atol=1e-6)
