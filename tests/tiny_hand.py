"""A one-finger robot in a folder of its own: small enough to be worked out by hand.

A lift carries a finger that swings in a horizontal plane; its distal joint follows the proximal
one. Straight, the tip's centre is LENGTH from the proximal axis, which is the world's z axis.
"""

from pathlib import Path

LENGTH, TIP = 0.1, 0.01  # [m]

XML = """
<mujoco model="tiny">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body name="palm">
      <inertial mass="1" pos="0 0 0" diaginertia="1e-3 1e-3 1e-3"/>
      <joint name="lift" type="slide" axis="0 0 1" range="-0.5 0.5"/>
      <site name="palm"/>
      <body name="proximal">
        <inertial mass="1" pos="0 0 0" diaginertia="1e-3 1e-3 1e-3"/>
        <joint name="proximal" axis="0 0 1" range="0 3"/>
        <body name="distal" pos="0.06 0 0">
          <inertial mass="1" pos="0 0 0" diaginertia="1e-3 1e-3 1e-3"/>
          <joint name="distal" axis="0 0 1" range="-0.1 0.8"/>
          <geom name="tip" type="sphere" size="0.01" pos="0.04 0 0" mass="0"/>
          <site name="tip_center" pos="0.04 0 0"/>
        </body>
      </body>
    </body>
  </worldbody>
  <equality>
    <joint name="follow" joint1="distal" joint2="proximal" polycoef="0 0.5 0 0 0"/>
  </equality>
  <keyframe>
    <key name="home" qpos="0 0.2 0.1"/>
  </keyframe>
</mujoco>
"""
STIFF = XML.replace("0 0.5 0 0 0", "0 0 0 0 0")  # the distal joint stays at zero

TOML = """
model = "tiny.xml"
home = "home"
palm = "palm"
arm = ["lift"]

[velocity]
lift = 0.1
proximal = 2.0

[[contact_points]]
name = "finger"
site = "tip_center"
geom = "tip"
flexion = ["proximal"]
"""


def write(folder: Path, xml: str = XML, toml: str = TOML) -> Path:
    """Put the robot into `folder`."""
    (folder / "tiny.xml").write_text(xml)
    (folder / "robot.toml").write_text(toml)
    return folder


def change(text: str, old: str, new: str) -> str:
    """`text` with its one `old` replaced."""
    assert text.count(old) == 1, (text.count(old), old)
    return text.replace(old, new)
