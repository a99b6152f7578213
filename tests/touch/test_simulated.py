"""The simulated hand and the probe behind it, on a gripper small enough to be worked out by hand.

A palm slides up and down, tilted; two fingers of one joint hang from it, with heavy round tips.
"""

import mujoco
import numpy as np
import pytest

import hqp_grasp as hg
from hqp_grasp.touch.driver import Readings
from hqp_grasp.touch.physical import payload, weight

LENGTH, APART, TIP, HEAVY = 0.12, 0.06, 0.008, 0.015  # [m], [m], [m], [kg]
FINGER = """
<body name="{name}" pos="{x} 0 0">
  <joint name="{name}" axis="0 {axis} 0" range="-0.8 1.2"/>
  <geom name="{name}_bone" type="capsule" fromto="0 0 0 0 0 -0.1" size="0.004" mass="0.05"/>
  <geom type="sphere" size="0.3" contype="0" conaffinity="0" mass="0"/>
  <body name="{name}_tip" pos="0 0 -{length}">
    <inertial pos="0 0.002 0.004" mass="{heavy}" diaginertia="1e-5 1e-5 1e-5"/>
    <geom name="{name}_ball" type="sphere" size="{tip}"/>
    <site name="{name}_tip" euler="0.3 -0.5 0.9"/>
  </body>
</body>"""
HAND = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <default><joint armature="0.002"/></default>
  <worldbody>
    <body name="palm" pos="0 0 0.3">
      <joint name="lift" type="slide" axis="0 0 1" range="-0.1 0.3"/>
      <geom name="palm" type="box" size="0.07 0.02 0.01" pos="0 0 0.02" mass="0.3"/>
      <site name="palm" euler="3.14159265358979 0 0"/>
      {fingers}
    </body>
  </worldbody>
  <actuator>
    <position joint="lift" kp="6000" kv="400" forcerange="-80 80"/>
    <position joint="left" kp="30" kv="1" forcerange="-3 3"/>
    <position joint="right" kp="30" kv="1" forcerange="-3 3"/>
  </actuator>
</mujoco>"""
TOML = """
model = "gripper.xml"
palm = "palm"
arm = ["lift"]
velocity = { lift = 0.5, left = 2.0, right = 3.0 }
workspace = [0.0, 0.0, 0.18]
"""
POINT = """
[[contact_points]]
name = "{name} finger"
site = "{name}_tip"
geom = "{name}_ball"
flexion = ["{name}"]
"""
CLOSED = np.array([0.0, 0.1, 0.15])  # nearly


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gripper")
    fingers = "".join(
        FINGER.format(name=name, x=x, axis=axis, length=LENGTH, heavy=HEAVY, tip=TIP)
        for name, x, axis in (("left", -APART, -1), ("right", APART, 1))
    )
    (folder / "gripper.xml").write_text(HAND.format(fingers=fingers))
    points = "".join(POINT.format(name=name) for name in ("left", "right"))
    (folder / "gripper.toml").write_text(TOML + points)
    return hg.Scene(folder / "gripper.toml", hg.Cylinder(0.03, height=0.1))


def high(scene, **about):
    """A hand above the object, at rest, its fingers straight."""
    hand = hg.SimulatedHand(scene, **about)
    q = np.array([0.28, 0.0, 0.0])
    hand.place(q)
    go(hand, q, 0.5)
    return hand


def go(hand, q, duration=0.3):
    """Move there, and a little on; what was read at last."""
    left = hand.move(np.asarray(q, dtype=float), duration) + 0.3
    while left > 0.0:
        read, left = hand.wait(0.4), left - 0.4
    return read


# ---------------------------------------------------------------- what sensors say


def test_a_tip_that_touches_nothing_feels_its_own_weight_turned_into_its_frame(scene):
    robot, hand = scene.articulated, high(scene)
    for q in ([0.28, 0.0, 0.0], [0.2, 0.7, -0.5]):
        go(hand, q)
        read = hand.wait(0.5)
        R = robot.tip_frames(read.q[-1])
        force = np.array([0.0, 0.0, -9.81 * HEAVY])
        for i, (site, wrench) in enumerate(zip(R, read.wrench[-1], strict=True)):
            np.testing.assert_allclose(site @ wrench[:3], force, atol=2e-3)
            body = robot.model.body(f"{('left', 'right')[i]}_tip").id
            middle = robot._at(read.q[-1]).xmat[body].reshape(3, 3) @ [0.0, 0.002, 0.004]
            np.testing.assert_allclose(site @ wrench[3:], np.cross(middle, force), atol=2e-5)
        np.testing.assert_allclose(weight(payload(robot), R), read.wrench[-1], atol=2e-3)


def test_before_anything_was_asked_a_hand_knows_what_its_tips_feel(scene):
    hand = hg.SimulatedHand(scene)
    hand.place(CLOSED)
    expected = weight(payload(scene.articulated), scene.articulated.tip_frames(hand._goal))
    np.testing.assert_allclose(hand._last[0], expected, atol=1e-3)
    late = hg.SimulatedHand(scene, hg.Physics(imperfections=hg.Imperfections(latency=0.01)))
    late.place(CLOSED)
    np.testing.assert_allclose(late.wait(0.0).wrench[0], expected, atol=1e-3)


def test_what_is_felt_of_a_contact_has_no_weight_in_it_however_the_tips_turned(scene):
    """The tips are weighed open, 0.4 rad away from where they touch."""
    hand = hg.SimulatedHand(scene)
    hand.place(CLOSED)
    probe = hg.PhysicalProbe(hand, scene.articulated)
    for felt in (probe.touch(CLOSED), probe.feel()):
        truth = hand.truth()
        assert isinstance(felt, hg.Grasp) and truth.other_links == ()
        pushed = np.array([contact.wrench[:3] for contact in felt.contacts])
        np.testing.assert_allclose(pushed, truth.forces, atol=0.01)
        np.testing.assert_allclose(pushed[:, 0], [-1.0, 1.0], atol=0.1)
        np.testing.assert_allclose(felt.normals, truth.grasp.normals, atol=0.02)
        np.testing.assert_allclose(felt.positions, truth.grasp.positions, atol=5e-4)
        np.testing.assert_allclose(felt.normals, [[-1, 0, 0], [1, 0, 0]], atol=0.02)
        for contact, R in zip(felt.contacts, truth.R_world_tip, strict=True):
            lever = np.cross(contact.position - felt_centre(felt, contact), contact.wrench[:3])
            np.testing.assert_allclose(contact.wrench[3:], lever, atol=1e-4)
            np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def felt_centre(felt, contact):
    return contact.position + contact.tip_radius * contact.normal


# ---------------------------------------------------------------- moving


def test_a_move_is_a_minimum_jerk_ramp_of_the_duration_asked(scene):
    hand = high(scene)
    start, end = hand._goal.copy(), np.array([0.27, 0.3, -0.2])
    duration = hand.move(end, 0.9)
    assert duration == pytest.approx(0.9)
    begun = hand.wait(0.0).time[0] - 0.01
    read = hand.wait(0.89)
    s = (read.time - begun) / 0.9
    way = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    np.testing.assert_allclose(read.q, start + way[:, None] * (end - start), atol=2e-3)
    speed = 30.0 * s**2 * (1.0 - s) ** 2 / 0.9
    np.testing.assert_allclose(read.velocity, speed[:, None] * (end - start), atol=2e-2)
    np.testing.assert_allclose(hand.wait(0.3).velocity[-1], 0.0, atol=1e-3)


@pytest.mark.parametrize(
    ("q", "j", "share"), [([0.28, 0.6, 0.0], 1, 0.8), ([0.28, 0, 0.6], 2, 0.8)]
)
def test_a_move_in_haste_takes_the_time_that_four_fifths_of_the_speed_limit_take(
    scene, q, j, share
):
    hand = high(scene)
    took = hand.move(np.array(q), 0.01)
    assert took == pytest.approx(1.875 * 0.6 / (share * hand.limits.speed[j]), abs=0.003)
    read = hand.wait(took)
    assert np.abs(read.velocity[:, j]).max() == pytest.approx(
        share * hand.limits.speed[j], rel=0.05
    )


def test_the_arm_carries_the_tips_at_twelve_centimetres_a_second_at_most(scene):
    hand = high(scene)
    took = hand.move(np.array([0.13, 0.0, 0.0]), 0.01)
    assert took == pytest.approx(1.875 * 0.15 / 0.12, abs=0.003)
    assert np.abs(hand.wait(took).velocity[:, 0]).max() == pytest.approx(0.12, rel=0.05)


def test_a_stop_amid_a_move_brakes_evenly_within_a_few_hundredths_of_a_second(scene):
    hand = high(scene)
    hand.move(np.array([0.28, 0.6, 0.6]), 0.7)
    before = hand.wait(0.35)
    v, q = before.velocity[-1, 1], before.q[-1, 1]
    assert v > 1.0
    hand.stop()
    after = hand.wait(0.2)
    # v t/2 more, over the 0.06 s that it takes; the servos lag by another few milliseconds
    assert after.q[-1, 1] - q == pytest.approx(0.5 * v * 0.06, abs=0.02)
    assert (np.diff(after.q[:, 1]) > -2e-3).all()
    assert np.abs(after.velocity[9:, 1]).max() < 0.05 * v
    assert np.abs(after.velocity[2, 1]) > 0.3 * v
    assert after.fault == ""


def test_a_hand_that_opens_into_nothing_keeps_off_the_ends_of_its_ranges(scene):
    hand = high(scene)
    for q in ([0.3, 1.2, -0.8], [0.25, -0.8, 1.2]):
        np.testing.assert_allclose(go(hand, q).q[-1], q, atol=8e-3)
    assert hand.worst["range [rad]"] == 0.0


# ---------------------------------------------------------------- closing and holding


def test_closing_speeds_up_to_what_is_asked_and_ends_where_the_tip_meets_the_object(scene):
    hand = hg.SimulatedHand(scene)
    hand.place(CLOSED)
    free = hand.wait(0.3)
    hand.close(1, 0.5, 0.8)
    read = hand.wait(0.3)
    # 20 rad/s² up to 0.5 rad/s, then on at that
    assert read.q[-1, 2] - free.q[-1, 2] == pytest.approx(0.5 * 0.3 - 0.5**2 / 40.0, abs=0.01)
    np.testing.assert_allclose(read.velocity[-10:, 2], 0.5, atol=0.02)
    np.testing.assert_allclose(read.q[:, :2], free.q[-1, :2] * np.ones((30, 1)), atol=2e-3)
    assert not read.touched.any() and not read.stalled.any()
    read = hand.wait(0.9)
    assert read.touched.tolist() == [False, True] and not read.stalled.any()
    met = np.arcsin((APART - 0.03 - TIP) / LENGTH)
    assert read.q[-1, 2] == pytest.approx(met, abs=4e-3)
    force = hand.truth().forces
    np.testing.assert_allclose(np.linalg.norm(force, axis=1), [0.0, 0.8], atol=0.08)
    assert force[1, 0] > 0.5


def test_a_finger_that_something_else_holds_is_stalled_and_stands(scene):
    about = hg.Imperfections(faults=(hg.world.imperfections.Fault("stall", 0, 0.1),))
    hand = hg.SimulatedHand(scene, hg.Physics(imperfections=about))
    hand.place(CLOSED)
    free = hand.wait(0.3)
    hand.close(0, 0.4, 0.8)
    read = hand.wait(0.6)
    assert read.stalled.tolist() == [True, False] and not read.touched.any()
    np.testing.assert_allclose(read.q[-1], free.q[-1], atol=2e-3)


def test_the_held_force_follows_what_is_asked_at_five_newtons_a_second(scene):
    hand = hg.SimulatedHand(scene)
    hand.place(CLOSED)
    for i in range(2):
        hand.close(i, 0.5, 0.5)
    for _ in range(4):
        hand.wait(0.5)
    hand.hold(3.0)
    pressed = []
    for _ in range(10):
        hand.wait(0.1)
        pressed.append(np.abs(hand.truth().forces[:, 0]).mean())
    assert pressed[0] == pytest.approx(0.85, abs=0.2)  # behind 0.5 + 5 t by a cycle or two
    assert pressed[2] == pytest.approx(1.85, abs=0.25)
    np.testing.assert_allclose(pressed[6:], 3.0, atol=0.15)
    np.testing.assert_allclose(hand.truth().forces[:, 0].sum(), 0.0, atol=0.1)


# ---------------------------------------------------------------- what only a simulation knows


@pytest.mark.parametrize("support", ["fixed", "table"])
def test_the_truth_tells_how_far_the_object_moved_and_turned_and_where_it_is(scene, support):
    hand = hg.SimulatedHand(scene, hg.Physics(support=support))
    hand.place(np.array([0.25, 0.0, 0.0]))
    truth = hand.truth()
    np.testing.assert_allclose(truth.place, [0, 0, 0.18, 1, 0, 0, 0], atol=1e-9)
    assert (truth.moved, truth.turned) == (0.0, 0.0) and truth.grasp is None
    assert np.isnan(truth.in_palm).all() == (support == "fixed")
    if support == "fixed":
        return
    at = 1 + hand.model.joint("object").qposadr[0]
    turn = [np.cos(0.2), 0.0, 0.0, -np.sin(0.2)]
    hand._state[at : at + 7] = [0.03, 0.04, 0.2, *turn]
    truth = hand.truth()
    assert truth.moved == pytest.approx(np.sqrt(0.05**2 + 0.02**2))
    assert truth.turned == pytest.approx(0.4)
    np.testing.assert_allclose(truth.place, [0.03, 0.04, 0.2, *turn], atol=1e-9)
    palm = hand._data.body("palm")
    np.testing.assert_allclose(truth.in_palm[:3], truth.place[:3] - palm.xpos, atol=1e-9)
    np.testing.assert_allclose(truth.in_palm[3:], turn, atol=1e-9)


@pytest.mark.parametrize("links", ["block", "pass"])
def test_links_beside_the_tips_are_named_where_they_meet_the_object(scene, links):
    """Lowered, the fingers close on the object with their bones; drawn geoms meet nothing."""
    hand = hg.SimulatedHand(scene, links=links)
    hand.place(np.array([0.0, 0.1, 0.1]))
    assert hand.truth().other_links == ()
    hand.place(np.array([-0.07, 0.1, 0.1]))
    if links == "pass":
        q = np.array([-0.07, 0.45, 0.2])
        hand._put(q)
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        mujoco.mj_getState(hand.model, hand._data, hand._state[: hand._size], kind)
        assert hand.truth().other_links == ("left_bone",)
    else:
        hand.close(0, 0.5, 1.0)
        while not hand.wait(0.1).stalled[0]:
            assert hand.wait(0.0).time[-1] < 3.0
        truth = hand.truth()
        assert truth.other_links == ("left_bone",) and truth.table_tips == ()
        assert (truth.forces == 0.0).all() and truth.grasp is None


def test_tips_on_the_table_are_named(scene):
    hand = hg.SimulatedHand(scene, hg.Physics(support="table"))
    hand.place(np.array([-0.02, 0.0, 0.0]))
    assert hand.truth().table_tips == ()
    hand.move(np.array([-0.05, 0.0, -0.3]), 0.5)
    read = hand.wait(1.0)
    assert read.fault != ""
    assert hand.truth().table_tips == ("left_ball",)


def test_the_worst_of_everything_is_kept_at_either_end_and_sign(scene):
    hand = hg.SimulatedHand(scene)
    limits = hand.limits
    for sign, end in ((1.0, limits.upper), (-1.0, limits.lower)):
        hand.worst = dict.fromkeys(hand.worst, 0.0)
        states = np.tile(hand._state, (hand._every, 1))
        states[2, hand._q[1]] = end[1] + 0.1 * sign
        states[1, hand._v[2]] = 1.5 * sign * limits.speed[2]
        torques = np.zeros((hand._every, 3))
        torques[1, 2] = 0.7 * sign * limits.torque[2]
        true = np.zeros((hand._every, 2, 6))
        true[3, 1] = [3.0 * sign, 0.0, 4.0, 9.0, 9.0, 9.0]
        read = hand._readings(states, true, torques, true)
        expected = {"range [rad]": 0.1, "speed share": 1.5, "torque share": 0.7, "force [N]": 5.0}
        assert hand.worst == pytest.approx(expected)
        assert isinstance(read, Readings) and len(read.time) == 1


@pytest.mark.parametrize("height", [0.0, 0.1])
def test_a_hand_begins_with_its_fingers_opened_and_no_wider_than_it_must(scene, height):
    hand = hg.SimulatedHand(scene)
    hand.place(np.array([height, 0.1, 0.15]))
    np.testing.assert_allclose(hand.wait(0.3).q[-1], [height, -0.25, -0.2], atol=3e-3)
