"""Fingers of several joints close, hold and press, as those of one joint do."""

import numpy as np
import pytest

import hqp_grasp as hg

# Three fingers hang from a palm that slides up and down; each has two motors, and one bends the
# other way round.
FINGER = """
<body name="base{i}" euler="0 0 {turn}">
  <body name="near{i}" pos="0.09 0 -0.02">
    <joint name="near{i}" axis="0 {near} 0" range="{low} {high}"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.08" size="0.008"/>
    <body name="far{i}" pos="0 0 -0.08">
      <joint name="far{i}" axis="0 1 0" range="-0.3 1.2"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.05" size="0.006"/>
      <body name="tip{i}" pos="0 0 -0.06">
        <geom name="ball{i}" type="sphere" size="0.009" mass="0.002"/>
        <site name="tip{i}"/>
      </body>
    </body>
  </body>
</body>"""
HAND = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <default><joint armature="0.001"/></default>
  <worldbody>
    <body name="palm" pos="0 0 0.33">
      <joint name="lift" type="slide" axis="0 0 1" range="-0.2 0.3"/>
      <geom type="cylinder" size="0.09 0.01" mass="0.5"/>
      <site name="palm" euler="3.14159265 0 0"/>
      {fingers}
    </body>
  </worldbody>
  <actuator>
    <position joint="lift" kp="4000" kv="300" forcerange="-100 100"/>
    {servos}
  </actuator>
</mujoco>"""
POINT = """
[[contact_points]]
name = "finger_{i}"
site = "tip{i}"
geom = "ball{i}"
flexion = {{ near{i} = {near}, far{i} = 0.6 }}
"""
AT = np.array([0.0, 0.1, 0.25, 0.1, 0.25, -0.1, 0.25])  # nearly closed; the third turns backwards


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("claw")
    fingers, servos, points = "", "", ""
    for i, near in ((1, 1), (2, 1), (3, -1)):
        low, high = sorted((-0.7 * near, 1.2 * near))
        turn = 2.0 * np.pi * i / 3
        fingers += FINGER.format(i=i, turn=turn, near=near, low=low, high=high)
        points += POINT.format(i=i, near=float(near))
        for joint in ("near", "far"):
            servos += f"<position joint='{joint}{i}' kp='10' kv='0.3' forcerange='-2 2'/>"
    (folder / "claw.xml").write_text(HAND.format(fingers=fingers, servos=servos))
    (folder / "claw.toml").write_text(
        "model = 'claw.xml'\npalm = 'palm'\narm = ['lift']\nspeed = 2.0\n"
        f"velocity = {{ lift = 0.3 }}\nworkspace = [0.0, 0.0, 0.18]\n{points}"
    )
    return hg.Scene(robot=folder / "claw.toml", object=hg.Cylinder(0.04, height=0.1))


def test_fingers_of_two_joints_touch_press_and_lift(scene):
    robot = scene.articulated
    assert [len(flexion) for flexion in robot.flexion] == [2, 2, 2]
    hand = hg.SimulatedHand(scene, hg.Physics(support="pedestal", mass=0.2))
    hand.place(AT)
    probe = hg.PhysicalProbe(hand, robot)
    felt = probe.touch(AT)
    assert isinstance(felt, hg.Grasp)
    truth = hand.truth()
    np.testing.assert_allclose(felt.positions, truth.grasp.positions, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(truth.forces, axis=1), 1.0, atol=0.15)
    torque = felt.jacobian.T @ (-4.0 * felt.normals).ravel()
    torque[0] = 0.0
    hand.press(torque)
    for _ in range(10):
        assert hand.wait(0.1).fault == ""
    forces = hand.truth().forces
    np.testing.assert_allclose((forces * felt.normals).sum(axis=1), 4.0, rtol=0.15)
    up = hand.wait(0.0).q[-1].copy()
    up[0] += 0.1
    before = hand.truth().moved
    left = hand.carry(up, 1.0)
    while left > -0.5:
        assert hand.wait(0.2).fault == ""
        left -= 0.2
    assert hand.truth().moved - before == pytest.approx(0.1, abs=0.005)
    worst = hand.worst
    assert worst["range [rad]"] == 0.0
    assert worst["speed share"] <= 1.0 and worst["torque share"] <= 1.0
    assert worst["force [N]"] <= hand.limits.grip


def test_closing_goes_along_the_hands_own_direction_at_the_speed_asked(scene):
    hand = hg.SimulatedHand(scene)
    q = AT.copy()
    q[0] = 0.2  # above the object
    hand.place(q)
    hand.wait(hand.move(hand.robot.opened(q), 0.5) + 0.2)
    before = hand.wait(0.05).q[-1]
    for i in range(3):
        hand.close(i, 0.5, 0.5)
    after = hand.wait(0.6)
    way = after.q[-1] - before
    for w in hand.robot.closing:
        np.testing.assert_allclose(way[w != 0.0] / w[w != 0.0], 0.3, atol=0.03)
    assert after.fault == ""


def test_what_closes_on_nothing_closes_to_the_end_of_all_its_joints(scene):
    hand = hg.SimulatedHand(scene)
    q = AT.copy()
    q[0] = 0.28
    hand.place(q)
    missed = hg.PhysicalProbe(hand, scene.articulated).touch(q)
    assert isinstance(missed, hg.Missed)
    assert missed.reason in (hg.Miss.NO_TOUCH, hg.Miss.OWN_LINK, hg.Miss.OTHER_LINK)
    assert hand.worst["range [rad]"] == 0.0
