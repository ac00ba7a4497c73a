"""Small robots in MJCF: one of each kind of joint, and worlds to put them in."""

import mujoco

FLOOR = '<geom name="floor" type="plane" size="1 1 1"/>'
# A body that may be anywhere, with a hinged leg, a ball for an arm, and sensors.
FREE = """
<body name="torso" pos="0 0 1">
  <freejoint name="root"/>
  <geom name="trunk" size="0.1"/>
  <site name="eye" pos="0.1 0 0"/>
  <body name="leg" pos="0 0 -0.2">
    <joint name="hip" axis="0 1 0" range="-1 1"/>
    <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3"/>
    <site name="foot" pos="0 0 -0.3" size="0.06"/>
  </body>
  <body name="arm" pos="0 0.2 0">
    <joint name="shoulder" type="ball"/>
    <geom type="capsule" size="0.03" fromto="0 0 0 0 0.3 0"/>
  </body>
</body>
"""
SENSORS = """
<sensor>
  <touch name="sole" site="foot"/>
  <framequat name="gaze" objtype="body" objname="torso"/>
  <velocimeter name="drift" site="eye"/>
  <jointpos name="bend" joint="hip"/>
</sensor>
"""
HIP = '<actuator><motor name="hip" joint="hip" ctrlrange="-2 1"/></actuator>'


def mjcf(bodies, rest=""):
    """Returns the XML of a world."""
    return f"<mujoco><worldbody>{bodies}</worldbody>{rest}</mujoco>"


def compiled(bodies, rest=""):
    """Returns the model of a world."""
    return mujoco.MjModel.from_xml_string(mjcf(bodies, rest))


FREE_XML = mjcf(FLOOR + FREE, SENSORS + HIP)
# A cart that is driven along a rail without end, and a pole that may go round.
CART_XML = mjcf(
    """
    <body name="cart">
      <joint name="slider" type="slide" axis="1 0 0"/>
      <geom size="0.1" mass="1"/>
      <body name="pole">
        <joint name="hinge" axis="0 1 0"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.5" mass="0.1"/>
        <site name="tip" pos="0 0 0.5"/>
      </body>
    </body>
    """,
    '<actuator><motor name="push" joint="slider" ctrlrange="-1 1"/></actuator>',
)
