"""The simulated hand and the probe behind it, on a gripper small enough to be worked out by hand.

A palm slides up and down, tilted; two fingers of one joint hang from it, with heavy round tips.
"""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

import hqp_grasp as hg
from hqp_grasp.touch.driver import Readings
from hqp_grasp.touch.physical import payload, weight

LENGTH, APART, TIP, HEAVY = 0.12, 0.06, 0.008, 0.006  # [m], [m], [m], [kg]
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
      <joint name="lift" type="slide" axis="0 0 1" range="-0.3 0.3"/>
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
    slice_ = 0.4 * hand.limits.watchdog
    while left > 0.0:
        read, left = hand.wait(slice_), left - slice_
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
        np.testing.assert_allclose(pushed, truth.forces, atol=0.008)
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


def test_a_joint_that_something_holds_is_named_once_it_is_five_centimetres_behind(scene):
    """The palm comes down on the object, which no tip feels."""
    hand = hg.SimulatedHand(scene)
    hand.place(np.array([0.0, 0.0, 0.0]))
    begun, takes = hand._state[0], hand.move(np.array([-0.25, -0.3, -0.3]), 0.5)
    while not (read := hand.wait(0.02)).fault:
        assert read.time[-1] - begun < takes
    assert read.fault == "something holds lift: it does not follow"
    met = 0.23 - 0.31  # palm on top of the object
    assert read.q[-1, 0] == pytest.approx(met, abs=3e-3)
    s = np.linspace(0.0, 1.0, 1001)
    asked = -0.25 * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    due = takes * s[np.argmax(asked < met - 0.05)]
    assert read.time[-1] - begun == pytest.approx(due, abs=0.04)
    np.testing.assert_allclose(hand.wait(0.3).q[-1, 0], met, atol=3e-3)


# ---------------------------------------------------------------- how a probe touches


class Noting(hg.SimulatedHand):
    """Notes what it is asked, and when."""

    def __init__(self, *given, **about):
        self.calls = []
        super().__init__(*given, **about)

    def move(self, q, duration):
        begun, takes = self.time, super().move(q, duration)
        self.calls.append(("move", begun, q.copy(), duration, takes))
        return takes

    def close(self, finger, speed, force):
        self.calls.append(("close", self.time, finger, speed, force))
        super().close(finger, speed, force)

    def hold(self, force):
        self.calls.append(("hold", self.time, force))
        super().hold(force)

    @property
    def time(self):
        return float(self._state[0])


def touched(scene, target, at, **about):
    """What was felt, and the calls."""
    hand = Noting(scene)
    hand.place(at)
    return hg.PhysicalProbe(hand, scene.articulated, **about).touch(target), hand.calls


def test_a_touch_opens_moves_weighs_and_closes_carefully_where_the_touch_is_expected(scene):
    met = float(np.arcsin((APART - 0.03 - TIP) / LENGTH))
    for beyond, slow in ((0.0, False), (-0.14, True)):  # where the touch is expected, and sooner
        target = np.array([0.0, met, met + beyond])
        felt, calls = touched(scene, target, np.array([0.02, 0.1, 0.15]))
        assert isinstance(felt, hg.Grasp)
        moves = [call for call in calls if call[0] == "move"]
        assert [call[3] for call in moves] == [0.3, 0.4]
        np.testing.assert_allclose(moves[0][2], [0.02, 0.1 - 0.7, 0.15 - 0.7], atol=3e-3)
        np.testing.assert_allclose(moves[1][2], target - [0, 0.35, 0.35], atol=1e-9)
        closing = [call for call in calls if call[0] == "close"]
        assert {call[2] for call in closing} == {0, 1}
        assert {round(call[4], 6) for call in closing} == {0.1}
        # rested, then weighed
        assert closing[0][1] - moves[1][1] == pytest.approx(moves[1][4] + 0.1 + 0.2, abs=0.03)
        swift, careful = closing[:2], closing[2:4]
        np.testing.assert_allclose([call[3] for call in swift], 1.0, atol=0.02)
        assert careful[0][1] - swift[0][1] == pytest.approx(0.35 - 0.08, abs=0.015)
        assert {call[3] for call in careful} == {0.2}
        late = closing[4:]
        assert [call[2] for call in late] == ([1] if slow else [])
        for call in late:
            assert call[3] == 0.3
            assert call[1] - careful[0][1] == pytest.approx(2.0 * 0.08 / 0.2, abs=0.11)  # it polls
        assert calls[-1][0] == "hold" and calls[-1][2] == 1.0


def test_a_touch_that_misses_opens_slowly_and_goes_back(scene):
    scene = narrowed(scene, "{ left = [-0.8, 0.35], right = [-0.8, 0.35] }")
    hand = Noting(scene)
    at = np.array([0.28, 0.1, 0.1])
    hand.place(at)
    before = hand.wait(0.3).q[-1]
    felt = hg.PhysicalProbe(hand, scene.articulated).touch(np.array([0.25, 0.1, 0.1]))
    assert isinstance(felt, hg.Missed) and felt.reason is hg.Miss.NO_TOUCH
    *_, opening, back = [call for call in hand.calls if call[0] == "move"]
    closed = np.array([0.25, 0.35, 0.35])
    np.testing.assert_allclose(opening[2], [0.25, -0.25, -0.25], atol=3e-3)
    assert opening[3] == pytest.approx(2.0 * np.abs(closed - opening[2]).max(), rel=0.02)
    np.testing.assert_allclose(back[2], before - [0.0, 0.35, 0.35], atol=3e-3)
    assert back[3] == 0.4


def test_a_touch_that_misses_on_a_way_ends_at_the_last_posture_that_was_passed(scene):
    """The next one approaches from there; its fingers are open."""
    scene = narrowed(scene, "{ left = [-0.8, 0.35], right = [-0.8, 0.35] }")
    hand = Noting(scene)
    hand.place(np.array([0.28, 0.1, 0.1]))
    way = [np.array([0.2, 0.1, 0.1]), np.array([0.24, 0.05, 0.1])]
    target = np.array([0.26, 0.1, 0.1])
    felt = hg.PhysicalProbe(hand, scene.articulated).touch(target, via=way)
    assert isinstance(felt, hg.Missed) and felt.reason is hg.Miss.NO_TOUCH
    opening, *passed, _, back = [call for call in hand.calls if call[0] == "move"]
    assert opening[3] == 0.3 and {call[3] for call in (*passed, back)} == {0.4}
    open_ = np.array([0.0, 0.35, 0.35])
    for call, q in zip(passed, (*way, target), strict=True):
        np.testing.assert_allclose(call[2], q - open_, atol=1e-9)
    np.testing.assert_allclose(back[2], way[-1] - open_, atol=1e-9)
    assert opening[2][0] == pytest.approx(0.28, abs=3e-3)  # fingers open before the palm moves


def test_a_hand_that_does_not_open_waits_before_it_goes_back(scene):
    class Stuck(Noting):
        waits = ()

        def wait(self, duration):
            self.waits += ((len(self.calls), duration),)
            read = super().wait(duration)
            return replace(read, fault="stuck") if len(self.calls) == 1 else read

    hand = Stuck(scene)
    hand.place(np.array([0.28, 0.1, 0.1]))
    felt = hg.PhysicalProbe(hand, scene.articulated).touch(np.array([0.25, 0.1, 0.1]))
    assert felt == hg.Missed(hg.Miss.STUCK, "stuck")
    assert len(hand.calls) == 3  # opening, opening once more, and back
    slices = [duration for calls, duration in hand.waits if calls == 1]
    assert 0.5 in slices  # no longer than half of the watchdog's time at once


def narrowed(scene, ranges):
    """The scene with other ranges, written beside it."""
    path = scene.robot.with_name("narrow.toml")
    path.write_text(f"ranges = {ranges}\n" + scene.robot.read_text())
    return hg.Scene(path, hg.Cylinder(0.03, height=0.1))


@pytest.mark.parametrize("name", ["left", "right"])
def test_the_finger_that_closes_on_nothing_is_named(scene, name):
    short = narrowed(scene, f"{{ {name} = [-0.8, 0.12] }}")
    felt, _ = touched(short, np.array([0.0, 0.05, 0.05]), np.array([0.0, 0.05, 0.05]))
    assert felt == hg.Missed(hg.Miss.NO_TOUCH, f"{name} finger")


class Still(hg.SimulatedHand):
    """Its encoders say the same for ever, from a moment on."""

    since = np.inf

    def wait(self, duration):
        read = super().wait(duration)
        if read.time[0] < self.since:
            self.kept = read.q[-1]
            return read
        q = np.tile(self.kept, (len(read.time), 1))
        return Readings(read.time, q, read.velocity, read.wrench, read.touched, read.stalled)


def test_angles_that_stand_while_the_hand_is_sent_elsewhere_are_no_angles(scene):
    hand = Still(scene)
    hand.place(CLOSED)
    hand.wait(0.1)
    hand.since = 0.2
    felt = hg.PhysicalProbe(hand, scene.articulated).touch(np.array([0.05, 0.1, 0.15]))
    assert isinstance(felt, hg.Missed) and felt.reason is hg.Miss.SENSOR
    assert felt.where.startswith("all of the hand: it was sent elsewhere")


def test_angles_may_stand_where_the_hand_is_already(scene):
    """Coarse encoders read the same all along a move that leads nowhere."""
    about = hg.Imperfections(encoder_step=0.01)
    hand = hg.SimulatedHand(scene, hg.Physics(imperfections=about))
    hand.place(CLOSED)
    assert isinstance(hg.PhysicalProbe(hand, scene.articulated).touch(CLOSED), hg.Grasp)


def test_a_finger_that_presses_less_than_half_of_what_it_holds_is_lost(scene):
    hand = hg.SimulatedHand(scene)
    hand.place(CLOSED)
    probe = hg.PhysicalProbe(hand, scene.articulated)
    assert isinstance(probe.touch(CLOSED), hg.Grasp)
    for force, lost in ((0.6, False), (0.4, True)):
        hand.hold(force)
        for _ in range(2):
            hand.wait(0.4)
        felt = probe.feel()
        assert isinstance(felt, hg.Missed) is lost
        if lost:
            assert felt.reason is hg.Miss.LOST


# ---------------------------------------------------------------- limits and faults


def test_a_hand_stops_at_six_tenths_of_its_limit_and_at_nine_while_it_presses(scene):
    hand = hg.SimulatedHand(scene, force_limit=10.0, grip_limit=30.0)
    hand.place(CLOSED)
    np.testing.assert_allclose(hand._guard, 6.0)
    hand.move(CLOSED, 0.3)  # in free air: by a newton more than at its beginning
    np.testing.assert_allclose(hand._guard, 1.0 + 9.81 * HEAVY, atol=2e-3)
    hand.close(0, 0.5, 0.5)
    np.testing.assert_allclose(hand._guard, 6.0)
    hand.press(np.zeros(3))
    np.testing.assert_allclose(hand._guard, 27.0)
    hand.stop()
    np.testing.assert_allclose(hand._guard, 6.0)
    assert hand.limits.hold == pytest.approx(4.0)


def test_a_move_ends_where_the_servos_miss_and_encoders_are_off_by_their_offset(scene):
    hand = high(scene)
    hand._errors.miss = lambda n: np.array([0.004, -0.02, 0.03])
    np.testing.assert_allclose(go(hand, [0.25, 0.2, 0.1]).q[-1], [0.254, 0.18, 0.13], atol=1e-3)
    hand._errors.encoder_offset = np.array([0.005, 0.02, -0.03])
    read = go(hand, [0.25, 0.2, 0.1]).q[-1]
    np.testing.assert_allclose(read, [0.254, 0.18, 0.13], atol=1e-3)
    really = hand._state[hand._q]
    np.testing.assert_allclose(really, read - [0.005, 0.02, -0.03], atol=1e-9)


@pytest.mark.parametrize(
    ("bump", "told", "stands"),
    [
        (None, "the sensor of right finger does not answer", 45),
        (42, "contact force above 1.1 N at left finger", 44),  # it comes first
        (60, "the sensor of right finger does not answer", 45),
    ],
)
def test_what_happens_first_in_a_move_is_what_stops_it(scene, bump, told, stands):
    """A sensor that repeats itself is dead at the fifth sample; a force counts at its second."""
    hand = high(scene)
    hand.move(np.array([0.2, 0.3, 0.3]), 0.5)
    T = 100
    state, _ = hand._run(hand._plan(T))
    wrench = np.random.default_rng(0).normal(scale=1e-3, size=(T, 2, 6))
    wrench[40:45, 1] = wrench[40, 1]
    wrench[70:74, 0] = wrench[70, 0]  # four are not enough
    if bump is not None:
        wrench[bump : bump + 2, 0, 2] = 2.0
        wrench[20, 0, 2] = 50.0  # a spike is nothing
    spared = wrench.copy()
    spared[44, 1] += 1e-3
    assert hand._react(state, wrench, np.zeros((T, 3))) == stands
    assert hand._fault == told
    np.testing.assert_array_equal(hand._state, state[stands - 1])
    hand = high(scene)
    hand.move(np.array([0.2, 0.3, 0.3]), 0.5)
    hand._plan(T)
    done = hand._react(state, spared, np.zeros((T, 3)))
    assert (done, hand._fault == "") == ((100, True) if bump is None else (bump + 2, False))


def test_two_sensors_dead_at_once_are_a_hand_that_feels_nothing_and_no_fault_of_one(scene):
    hand = high(scene)
    hand.move(np.array([0.2, 0.3, 0.3]), 0.5)
    state, _ = hand._run(hand._plan(100))
    assert hand._react(state, np.zeros((100, 2, 6)), np.zeros((100, 3))) == 100
    assert hand._fault == ""


class Lazy(Noting):
    """Closes nothing, and says nothing of it."""

    def close(self, finger, speed, force):
        self.calls.append(("close", self.time, finger, speed, force))


def test_a_finger_that_takes_far_longer_than_its_range_does_not_close(scene):
    hand = Lazy(scene)
    hand.place(CLOSED)
    felt = hg.PhysicalProbe(hand, scene.articulated).touch(np.array([0.0, -0.1, 0.15]))
    assert felt == hg.Missed(hg.Miss.NO_TOUCH, "left finger")
    closing = [call for call in hand.calls if call[0] == "close"]
    back = [call for call in hand.calls if call[0] == "move"][2]
    # 3 s beyond what the wider finger needs from −0.45 rad on, at 0.3 rad/s
    assert back[1] - closing[2][1] == pytest.approx(3.0 + (1.2 + 0.45) / 0.3, abs=0.15)


def test_a_silent_sensor_is_waited_for_by_two_seconds(scene):
    fault = hg.world.imperfections.Fault("freeze", 1, 0.0)
    about = hg.Imperfections(force_noise=1e-3, faults=(fault,))
    hand = Noting(scene, hg.Physics(imperfections=about))
    hand.place(CLOSED)
    felt = hg.PhysicalProbe(hand, scene.articulated).touch(CLOSED)
    assert felt == hg.Missed(hg.Miss.SENSOR, "right finger")
    assert hand.time == pytest.approx(2.0, abs=0.06) and hand.calls == []


def held_with(scene, forces, steps=20):
    """Readings of two tips that press with these forces [N]."""
    wrench = np.zeros((steps, 2, 6))
    wrench[:, :, 2] = forces
    time, q = 0.01 * np.arange(steps), np.zeros((steps, 3))
    return Readings(time, q, q, wrench, np.ones(2, bool), np.zeros(2, bool))


@pytest.mark.parametrize(
    ("seen", "last"),
    [
        ([(0.2, 0.2), (1.03, 0.97), (5.0, 5.0)], (5.0, 5.0)),  # settled: what comes then
        ([(0.2, 1.0), (0.5, 0.4), (0.9, 0.3)] * 3, (0.5, 0.4)),  # it slides: the best there was
        ([(1.05, 1.0)] * 9, (1.05, 1.0)),
    ],
)
def test_contacts_are_sensed_once_the_held_force_is_there_or_at_its_best(scene, seen, last):
    """It is there within 4 %; a finger that slides is given 0.3 s, and 0.3 s by newton."""
    probe = hg.PhysicalProbe(hg.SimulatedHand(scene), scene.articulated, force=1.0)
    waited = []

    def wait(duration):
        waited.append(duration)
        return held_with(scene, np.add(seen[len(waited) - 1], 0.5))

    object.__setattr__(probe, "_wait", wait)
    free = held_with(scene, (0.5, 0.5))
    found = probe._settle(free)
    np.testing.assert_allclose(found.wrench[0, :, 2] - 0.5, last)
    assert waited[-1] == (0.2 if last[0] > 4.0 else 0.1) and set(waited[:-1]) == {0.1}
    assert sum(waited) == pytest.approx(0.4 if last[0] > 4.0 else 0.6, abs=0.11)


def test_averages_leave_out_spikes_and_their_noise_is_that_of_the_samples(scene):
    probe = hg.PhysicalProbe(hg.SimulatedHand(scene), scene.articulated, force=1.0)
    rng = np.random.default_rng(0)
    sigma = np.array([0.02, 0.03, 0.04, 1e-4, 2e-4, 3e-4])
    plain = held_with(scene, (1.0, 2.0), steps=4000)
    drift = np.linspace(0.0, 0.3, 4000)[:, None, None]
    noisy = plain.wrench + sigma * rng.normal(size=plain.wrench.shape) + drift * (sigma > 1e-3)
    spiky = noisy.copy()
    spiky[::100, 0, 0] += 30.0
    for wrench in (noisy, spiky):
        read = Readings(plain.time, plain.q, plain.q, wrench, plain.touched, plain.stalled)
        np.testing.assert_allclose(
            probe._steady(read) - plain.wrench[0], [0.15 * (sigma > 1e-3)] * 2, atol=3e-3
        )
        np.testing.assert_allclose(probe._variance(read), [sigma**2] * 2, rtol=0.1)
        samples = 4000 - 40 * (wrench is spiky)
        np.testing.assert_allclose(
            probe._unsure(read)[0], probe._variance(read)[0] / samples, rtol=1e-9
        )


def sensed(scene, q, ways, force=1.0, table=None):
    """What a probe says of tips that meet pushes: each a normal and its force, world."""
    robot = scene.articulated
    probe = hg.PhysicalProbe(hg.SimulatedHand(scene), robot, force, table)
    R, load = robot.tip_frames(q).copy(), payload(robot)
    wrench = np.empty((2, 6))
    for i, (normal, f) in enumerate(ways):
        wrench[i] = [*(R[i].T @ f), *(R[i].T @ np.cross(-TIP * np.asarray(normal), f))]
    free = held_with(scene, (0.0, 0.0))
    open_q = np.array([0.0, -0.4, -0.3])
    readings = []
    for at, felt in ((open_q, np.zeros((2, 6))), (np.asarray(q), wrench)):
        frames = robot.tip_frames(at)
        told = np.tile(felt + weight(load, frames), (20, 1, 1))
        qs = np.tile(at, (20, 1))
        readings.append(Readings(free.time, qs, qs, told, free.touched, free.stalled))
    return probe._sense(*readings)


AT = np.array([0.0, 0.18, 0.19])
LEFT, RIGHT = np.array([-1.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])


def test_pushes_are_told_in_the_world_with_their_place_and_torque(scene):
    rng = np.random.default_rng(1)
    ways = []
    for normal in (LEFT, RIGHT):
        n = normal + rng.normal(scale=0.2, size=3)
        n /= np.linalg.norm(n)
        ways.append((n, 1.2 * n + 0.3 * np.cross(n, [0.0, 0.6, 0.8])))
    felt = sensed(scene, AT, ways)
    assert isinstance(felt, hg.Grasp)
    np.testing.assert_allclose(felt.q, AT, atol=1e-12)
    for contact, center, (n, f) in zip(
        felt.contacts, scene.articulated.centers(AT), ways, strict=True
    ):
        np.testing.assert_allclose(contact.normal, n, atol=1e-9)
        np.testing.assert_allclose(contact.position, center - TIP * n, atol=1e-9)
        np.testing.assert_allclose(contact.wrench[:3], f, atol=1e-9)
        np.testing.assert_allclose(contact.wrench[3:], np.cross(-TIP * n, f), atol=1e-9)
        assert contact.noise == 0.0


@pytest.mark.parametrize(("slope", "clear"), [(1.45, True), (1.55, False)])
def test_what_pushes_flatter_than_friction_holds_is_unclear(scene, slope, clear):
    ways = [(LEFT, LEFT), (RIGHT, np.array([1.0, slope, 0.0]))]
    felt = sensed(scene, AT, ways)
    assert felt == hg.Missed(hg.Miss.UNCLEAR, "right finger") or clear
    assert isinstance(felt, hg.Grasp) is clear


@pytest.mark.parametrize(
    ("up", "above", "met"), [(0.75, 1.5e-3, True), (0.65, 1.5e-3, False), (0.75, 2.5e-3, False)]
)
def test_what_faces_up_within_two_millimetres_of_the_table_is_the_table(scene, up, above, met):
    n = np.array([-np.sqrt(1.0 - up**2), 0.0, up])
    height = scene.articulated.centers(AT)[0, 2] - TIP * up - above
    felt = sensed(scene, AT, [(n, n), (RIGHT, RIGHT)], table=height)
    assert felt == hg.Missed(hg.Miss.TABLE, "left finger") if met else isinstance(felt, hg.Grasp)


@pytest.mark.parametrize(("gap", "met"), [(1.9e-3, True), (2.1e-3, False)])
def test_a_tip_within_two_millimetres_of_another_finger_touches_that(scene, gap, met):
    angle = np.arcsin((APART - TIP - gap / 2.0) / LENGTH)
    felt = sensed(scene, [0.2, angle, angle], [(LEFT, LEFT), (RIGHT, RIGHT)])
    assert felt == hg.Missed(hg.Miss.OWN_LINK, "left finger") if met else isinstance(felt, hg.Grasp)


@pytest.mark.parametrize(("sigma", "noticed"), [(0.005, 0.1), (0.05, 0.346), (8.0, 6.0)])
def test_a_touch_is_four_times_the_noise_within_what_counts_and_what_may_be_held(
    scene, sigma, noticed
):
    """Of one sample's length, that is √3 σ; a tenth of a newton at least, the hold at most."""
    hand = Noting(scene, hg.Physics(imperfections=hg.Imperfections(force_noise=sigma)))
    hand.place(CLOSED)
    probe = hg.PhysicalProbe(hand, scene.articulated)
    object.__setattr__(probe, "_close", lambda readings, noticed: hg.Missed(hg.Miss.NO_TOUCH, ""))
    object.__setattr__(probe, "_retreat", lambda *_: None)
    object.__setattr__(probe, "_go", lambda *_: "")
    hand._errors._perfect = False
    probe.touch(CLOSED)
    forces = [call[4] for call in hand.calls if call[0] == "close"]
    assert len(forces) > 0
    np.testing.assert_allclose(forces, noticed, rtol=0.25)


# ---------------------------------------------------------------- how fast, and how long


def pressing(scene, torque):
    """A hand that has touched, and is told to press."""
    hand = hg.SimulatedHand(scene)
    hand.place(CLOSED)
    assert isinstance(hg.PhysicalProbe(hand, scene.articulated).touch(CLOSED), hg.Grasp)
    hand.press(np.array([0.0, torque, torque]))
    return hand


def test_pressed_joints_gain_two_newton_metres_a_second(scene):
    hand = pressing(scene, 1.2)
    read = hand.wait(0.4)
    assert read.fault == ""
    for j in (1, 2):
        slope = np.polyfit(read.time[10:], read.torque[10:, j], 1)[0]
        assert slope == pytest.approx(2.0, rel=0.1)
    np.testing.assert_allclose(hand.wait(0.4).torque[-1, 1:], 1.2, atol=0.1)
    np.testing.assert_allclose(np.abs(hand.truth().forces[:, 0]), 1.2 / LENGTH, rtol=0.1)


def test_a_joint_that_meets_nothing_stops_the_hand_after_three_tenths_of_a_second(scene):
    """And the time that half of its torque takes to be there."""
    hand = high(scene)
    hand.press(np.array([0.0, 0.4, 0.0]))
    begun = hand._state[0]
    while not (read := hand.wait(0.01)).fault:
        assert read.time[-1] - begun < 1.0
    assert read.fault == "left meets nothing that resists what it presses with"
    assert hand._asked is None
    assert read.time[-1] - begun == pytest.approx(0.3 + 0.2 / 2.0, abs=0.06)


def test_closing_gains_twenty_radians_a_second_squared(scene):
    hand = hg.SimulatedHand(scene)
    hand.place(CLOSED)
    hand.close(1, 0.5, 0.8)
    hand._plan(40)
    goal, speed, _ = hand._planned
    expected = np.minimum(0.5, 20.0 * 0.002 * np.arange(1, 41))
    np.testing.assert_allclose(speed, np.outer(expected, [0.0, 0.0, 1.0]), atol=1e-12)
    np.testing.assert_allclose(goal[:, 2] - hand._goal[2], 0.002 * expected.cumsum(), atol=1e-12)
    np.testing.assert_array_equal(goal[:, :2], np.tile(hand._goal[:2], (40, 1)))


@pytest.mark.parametrize(("after", "stalled"), [(0.04, False), (0.06, True)])
def test_a_closing_joint_is_stalled_once_it_is_a_hundredth_of_a_radian_behind(
    scene, after, stalled
):
    """0.015 rad at 0.4 rad/s, which are there after 0.02 s."""
    about = hg.Imperfections(faults=(hg.world.imperfections.Fault("stall", 0, 0.1),))
    hand = hg.SimulatedHand(scene, hg.Physics(imperfections=about))
    hand.place(CLOSED)
    hand.wait(0.3)
    hand.close(0, 0.4, 0.8)
    assert hand.wait(after).stalled[0] == stalled


def test_a_finger_closes_against_the_middle_of_what_its_tip_felt_lately(scene):
    hand = high(scene)
    lately = np.zeros((25, 2, 6))
    lately[:, 1, :3] = np.linspace(0.0, 1.0, 25)[:, None] ** 2
    lately[3, 1, :3] = 90.0  # a spike
    hand._last = lately
    hand.close(1, 0.5, 0.5)
    np.testing.assert_allclose(hand._zero[1], (13 / 24) ** 2)
    assert (hand._zero[0] == 0.0).all()
    hand.wait(0.2)
    assert len(hand._last) == 25  # 0.05 s


def test_a_silent_caller_stops_a_hand_that_moves_closes_or_presses_after_the_watchdogs_time(scene):
    for begin in ("move", "close"):
        hand = high(scene, watchdog=0.3)
        begun = hand._state[0]
        if begin == "move":
            hand.move(np.array([0.2, 0.5, 0.5]), 1.0)
        else:
            hand.close(0, 0.5, 0.5)
        read = hand.wait(0.7)
        assert read.fault == "watchdog: no call for 0.3 s"
        still = read.time[np.abs(read.velocity[:, 1]) > 0.05]
        assert 0.25 < still.max() - begun < 0.45
    assert hand.wait(0.5).fault == read.fault  # until it is moved again
    hand = high(scene, watchdog=0.3)
    assert hand.wait(0.7).fault == ""  # it stood


def test_holding_takes_half_of_the_forces_error_away_within_its_speed_and_lead(scene):
    hand = hg.SimulatedHand(scene)
    hand.place(CLOSED)
    q, way, i = hand._goal.copy(), hand._closing[1], 1
    hand._give[i], hand._force[i], hand._aim[i] = 1e-3, 1.0, 1.0
    lasts = 25 * 0.002
    np.testing.assert_allclose(hand._correction(i, 0.8, q, 25), way * 1e-3 * 0.5 * 0.2)
    np.testing.assert_allclose(hand._correction(i, 1.6, q, 25), way * 1e-3 * 0.5 * -0.6)
    # The aim follows by 5 N/s; half of what it gains in a cycle is expected to be felt at its end.
    hand._force[i] = 2.0
    np.testing.assert_allclose(hand._correction(i, 1.0, q, 25), way * 1e-3 * (0.125 + 0.125))
    assert hand._aim[i] == pytest.approx(1.0 + 5.0 * lasts)
    hand._give[i], hand._aim[i] = 1.0, 2.0
    np.testing.assert_allclose(hand._correction(i, 0.0, q, 25), way * 0.3 * lasts)
    np.testing.assert_allclose(hand._correction(i, 9.0, q, 25), way * -0.3 * lasts)
    # A target leads its joint by twice the give at the held force, and what counts as stalled.
    hand._give[i] = 1e-3
    behind = q - 0.018 * way
    np.testing.assert_allclose(hand._correction(i, 0.0, behind, 25), way * (0.004 + 0.015 - 0.018))
    still = hand._correction(i, 0.0, q, 25) * (way == 0.0)
    assert not still.any()


def test_edges_do_not_creep_while_a_hand_presses_and_objects_do_not_shake_before(scene):
    """MuJoCo's ten iterations without slip are on for as long as something is held."""
    hand = hg.SimulatedHand(scene)
    hand.place(CLOSED)
    on = [hand.model.opt.noslip_iterations]
    hand.press(np.zeros(3))
    on.append(hand.model.opt.noslip_iterations)
    hand.stop()
    on.append(hand.model.opt.noslip_iterations)
    assert on == [0, 10, 0]


@pytest.mark.parametrize("first", [0, 1])
def test_the_finger_that_touches_or_stalls_first_is_the_one_that_is_told(scene, first):
    def closing():
        hand = hg.SimulatedHand(scene)
        hand.place(CLOSED)
        for i in range(2):
            hand.close(i, 0.5, 0.8)
        state, _ = hand._run(hand._plan(25))
        wrench = np.random.default_rng(0).normal(scale=1e-4, size=(25, 2, 6))
        return hand, state, wrench

    hand, state, wrench = closing()
    wrench[10:, first, :3] += hand._zero[first] + [0.0, 0.9, 0.0]
    wrench[15:, 1 - first, :3] += hand._zero[1 - first] + [0.0, 0.9, 0.0]
    wrench[5, 1 - first, :3] += 50.0  # a spike is nothing
    assert hand._react(state, wrench, np.zeros((25, 3))) == 12
    assert hand._touched.tolist() == [first == 0, first == 1] and not hand._stalled.any()
    hand, state, wrench = closing()
    goal = hand._planned[0]
    for finger, begin in ((first, 10), (1 - first, 15)):
        at = hand._q[1 + finger]
        state[begin:, at] = goal[begin:, 1 + finger] - 0.1
    assert hand._react(state, wrench, np.zeros((25, 3))) == 11
    assert hand._stalled.tolist() == [first == 0, first == 1] and not hand._touched.any()


@pytest.mark.parametrize("joint", [0, 1, 2])
def test_of_joints_that_do_not_follow_the_one_farthest_behind_is_named(scene, joint):
    hand = high(scene)
    hand.move(np.array([0.2, 0.3, 0.3]), 0.5)
    state, _ = hand._run(hand._plan(50))
    for j in range(3):
        state[20:, hand._q[j]] += 0.2 if j == joint else -0.06
    wrench = np.random.default_rng(0).normal(scale=1e-4, size=(50, 2, 6))
    assert hand._react(state, wrench, np.zeros((50, 3))) == 21
    name = ("lift", "left", "right")[joint]
    assert hand._fault == f"something holds {name}: it does not follow"


@pytest.mark.parametrize("finger", [0, 1])
def test_the_tip_that_meets_something_is_named_and_so_is_the_joint_that_runs_away(scene, finger):
    hand = high(scene)
    hand.move(np.array([0.2, 0.3, 0.3]), 0.5)
    state, _ = hand._run(hand._plan(50))
    wrench = np.random.default_rng(0).normal(scale=1e-4, size=(50, 2, 6))
    wrench[20:, finger, 0] = 5.0
    assert hand._react(state, wrench, np.zeros((50, 3))) == 22
    name = ("left", "right")[finger]
    assert hand._fault.endswith(f"at {name} finger")
    hand = high(scene)
    hand.press(np.array([0.0, 0.4, 0.4]))
    state, _ = hand._run(hand._plan(25))
    motors = np.full((25, 3), 0.4)
    motors[:, 1 + finger] = 0.0
    for _ in range(20):
        hand._react(state, np.zeros((25, 2, 6)), motors)
        if hand._fault:
            break
    assert hand._fault == f"{name} meets nothing that resists what it presses with"
