"""Pressing and carrying: torques are followed slowly, kept while the arm moves, and end in time."""

import numpy as np
import pytest

import hqp_grasp as hg
from hqp_grasp.touch.driver import TOUCHING, require_press
from hqp_grasp.world.imperfections import Fault

PRESS_RATE = 2.0

# Where the geometric probe felt balance, at the end of a trial of fmk.
BALANCED = np.array([-0.089, 0.954, 0.153, 1.345, -0.114, 0.87, -0.405, 0.859, 1.206, 1.206, 0.915])
FINGERS = slice(8, 11)
LEVER = 0.105  # [m] of a finger's flexion at its tip
FOLLOWED = 0.07  # share of a torque asked that is missing at most, once it is followed
WEIGHED = 0.1  # share of the weight that felt forces miss it by


@pytest.fixture(scope="module")
def scene():
    return hg.Scene(object=hg.Cylinder(0.05))


def held(scene, **physics):
    """A hand that has touched, and its probe."""
    hand = hg.SimulatedHand(scene, hg.Physics(**physics))
    hand.place(BALANCED)
    probe = hg.PhysicalProbe(hand, scene.articulated)
    assert isinstance(probe.touch(BALANCED), hg.Grasp)
    return hand, probe


def equal(hand, force):
    """The same torque at every flexion (n,), which presses with about that force [N]."""
    torque = np.zeros(hand.robot.n)
    torque[FINGERS] = LEVER * force
    return torque


def waited(hand, duration):
    """Readings of that time, in slices that the watchdog allows."""
    slices = [hand.wait(0.1) for _ in range(round(duration / 0.1))]
    return {
        name: np.concatenate([getattr(s, name) for s in slices])
        for name in ("time", "q", "velocity", "wrench", "torque")
    } | {"fault": slices[-1].fault}


def carried(hand, way):
    """The posture (n,) with the palm moved by `way` (3,) [m], turned as it is."""
    robot, q = hand.robot, hand.wait(0.0).q[-1].copy()
    p, R = robot.palm(q)
    arm = list(robot.arm)
    for _ in range(50):
        here, turned = robot.palm(q)
        E = R @ turned.T
        turn = 0.5 * np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]])
        J = robot.palm_jacobian(q)[:, arm]
        away = np.concatenate([p + way - here, turn])
        q[arm] += J.T @ np.linalg.solve(J @ J.T + 1e-6 * np.eye(6), away)
    return q


def within_limits(hand):
    worst = hand.worst
    return (
        worst["range [rad]"] == 0.0
        and worst["speed share"] <= 1.0
        and worst["torque share"] <= 1.0
        and worst["force [N]"] <= hand.limits.grip
    )


# ---------------------------------------------------------------- a pick, from touch to set down


@pytest.mark.parametrize(("mass", "force"), [(0.1, 3.0), (0.5, 8.0)])
@pytest.mark.parametrize("preset", [None, "loadcell"])
def test_what_is_pressed_is_lifted_felt_and_set_down_where_it_stood(scene, mass, force, preset):
    hand, probe = held(
        scene, support="pedestal", mass=mass, imperfections=hg.Imperfections.preset(preset)
    )
    before = sum(contact.wrench[:3] for contact in probe.feel().contacts)
    hand.press(equal(hand, force))
    waited(hand, 1.0)
    began = hand.truth().moved
    for way in (0.1, -0.1):
        left = hand.carry(carried(hand, [0.0, 0.0, way]), 1.5)
        moving = waited(hand, left / 2)
        assert isinstance(probe.feel(), hg.Grasp), "it feels while it is carried"
        assert waited(hand, left / 2 + 0.5)["fault"] == "" == moving["fault"]
        if way > 0.0:
            assert 0.095 < hand.truth().moved - began < 0.105
            felt = probe.feel()
            on_tips = sum(contact.wrench[:3] for contact in felt.contacts) - before
            np.testing.assert_allclose(on_tips[2], -9.81 * mass, rtol=WEIGHED, atol=0.1)
    hand.stop()
    hand.wait(hand.move(hand.robot.opened(hand.wait(0.2).q[-1]), 0.5) + 0.2)
    assert hand.truth().moved < 0.01
    assert within_limits(hand)


def test_what_hangs_from_the_fingers_does_not_creep(scene):
    hand, _ = held(scene, support="pedestal", mass=0.5)
    hand.press(equal(hand, 6.0))
    waited(hand, 1.0)
    waited(hand, hand.carry(carried(hand, [0.0, 0.0, 0.05]), 1.0) + 0.5)
    height = hand.truth().moved
    waited(hand, 2.0)
    assert hand.truth().moved == pytest.approx(height, abs=1e-4)


# ---------------------------------------------------------------- what is followed


def test_torque_is_followed_at_a_bounded_rate_and_then_kept(scene):
    hand, _ = held(scene)
    holding = hand.wait(0.1).torque[-1][FINGERS]
    hand.press(equal(hand, 2.0))
    began = waited(hand, 1.0)["torque"][:, FINGERS]
    assert (began > 0.8 * holding).all(), "what was held is not let go first"
    asked = equal(hand, 8.0)
    hand.press(asked)
    rising = waited(hand, 0.6)
    steps = np.diff(rising["torque"][:, FINGERS], axis=0) / np.diff(rising["time"])[:, None]
    assert 0.5 * PRESS_RATE < steps.max() <= 1.1 * PRESS_RATE
    kept = waited(hand, 1.0)["torque"][:, FINGERS]
    np.testing.assert_allclose(kept, asked[FINGERS] + 0 * kept, rtol=FOLLOWED)


def test_a_large_torque_takes_its_time_and_is_no_fault(scene):
    hand, _ = held(scene)
    hand.press(equal(hand, 14.0))
    told = waited(hand, 1.5)
    assert told["fault"] == ""
    np.testing.assert_allclose(told["torque"][-1, FINGERS], equal(hand, 14.0)[FINGERS], rtol=0.07)


def test_a_sensor_that_freezes_while_it_carries_does_not_stop_the_hand_but_is_told(scene):
    fault = Fault("freeze", finger=1, begin=4.0)
    imperfect = hg.Imperfections(faults=(fault,))
    hand, probe = held(scene, support="pedestal", imperfections=imperfect)
    hand.press(equal(hand, 5.0))
    waited(hand, 1.0)
    hand.carry(carried(hand, [0.0, 0.0, 0.1]), 3.0)
    told = waited(hand, 2.0)
    assert told["time"][-1] > 4.2 and told["fault"] == ""
    assert probe.feel() == hg.Missed(hg.Miss.SENSOR, "finger_2")


def test_readings_of_torque_are_what_the_tips_press_with(scene):
    hand, probe = held(scene)
    hand.press(equal(hand, 6.0))
    waited(hand, 1.0)
    felt = probe.feel()
    due = np.zeros(hand.robot.n)
    for i, (contact, centre) in enumerate(
        zip(felt.contacts, hand.robot.centers(felt.q), strict=True)
    ):
        J = hand.robot.link_jacobian(felt.q, i, centre)
        J_turn = np.zeros_like(J)
        for e in np.eye(3):
            moved = hand.robot.link_jacobian(felt.q, i, centre + e) - J
            J_turn += 0.5 * np.cross(e[:, None], moved, axis=0)
        due -= J.T @ contact.wrench[:3] + J_turn.T @ contact.wrench[3:]
    np.testing.assert_allclose(hand.wait(0.1).torque[-1][7:], due[7:], atol=2e-3)


def test_the_spread_presses_too(scene):
    hand, _ = held(scene)
    torque = equal(hand, 5.0)
    for spread in (0.06, -0.06):
        torque[7] = spread
        hand.press(torque)
        told = waited(hand, 1.5)
        assert told["fault"] == ""
        np.testing.assert_allclose(told["torque"][-1][7], spread, atol=FOLLOWED * LEVER * 5.0)


def test_joints_that_carry_the_palm_stand_while_it_presses(scene):
    hand, _ = held(scene)
    before = hand.wait(0.1).q[-1]
    hand.press(equal(hand, 8.0))
    np.testing.assert_allclose(waited(hand, 1.0)["q"][-1][:7], before[:7], atol=3e-3)


def test_pressing_goes_on_while_the_arm_is_carried_whatever_q_says_of_the_fingers(scene):
    hand, _ = held(scene, support="pedestal", mass=0.2)
    hand.press(equal(hand, 5.0))
    waited(hand, 1.0)
    q = carried(hand, [0.0, 0.0, 0.05])
    q[FINGERS] -= 0.5
    left = hand.carry(q, 1.0)
    hand.press(equal(hand, 6.0))  # more, on the way
    torque = waited(hand, left)["torque"][:, FINGERS]
    assert torque.min() > 0.8 * LEVER * 5.0 and torque[-1].min() > 0.9 * LEVER * 6.0
    np.testing.assert_allclose(hand.wait(0.3).q[-1][:7], q[:7], atol=5e-3)


# ---------------------------------------------------------------- what ends it


@pytest.mark.parametrize("end", ["stop", "move", "close", "watchdog"])
def test_pressing_ends(scene, end):
    hand, _ = held(scene)
    hand.press(equal(hand, 5.0))
    pressed = waited(hand, 1.0)["torque"][-1, FINGERS]
    if end == "stop":
        hand.stop()
    elif end == "move":
        hand.move(hand.robot.opened(hand.wait(0.0).q[-1]), 0.5)
    elif end == "close":
        hand.close(0, 0.3, 0.2)
    else:
        assert "watchdog" in hand.wait(1.5).fault
    hand.wait(0.2)
    ended = hand.wait(0.1)
    assert (np.abs(ended.torque[-1][FINGERS]) < 0.3 * pressed).all()
    assert within_limits(hand)
    if end == "watchdog":
        assert hand.carry(BALANCED, 1.0) == 0.0


def test_a_hand_that_is_placed_anew_touches_as_if_it_never_pressed(scene):
    hand, probe = held(scene)
    first = hand.wait(0.3).q[-1]
    hand.press(equal(hand, 5.0))
    waited(hand, 0.5)
    hand.place(BALANCED)
    probe.touch(BALANCED)
    np.testing.assert_array_equal(hand.wait(0.3).q[-1], first)


def test_a_finger_that_lost_what_it_pressed_does_not_run_away(scene):
    hand, probe = held(scene, support="pedestal")
    hand.press(equal(hand, 12.0))
    waited(hand, 1.0)
    before = hand.wait(0.1).q[-1]
    at = 1 + hand.model.joint("object").qposadr[0]
    hand._state[at] += 5.0  # as if it were torn away
    told = waited(hand, 1.0)
    assert "meets nothing that resists" in told["fault"]
    assert within_limits(hand)
    assert np.abs(told["q"][-1][FINGERS] - before[FINGERS]).max() < 0.5
    assert np.abs(told["velocity"][-1]).max() < 0.01
    missed = probe.feel()
    assert isinstance(missed, hg.Missed) and missed.reason is hg.Miss.BLOCKED


def test_a_press_stays_below_the_grip_limit_and_says_where_it_stopped(scene):
    hand = hg.SimulatedHand(scene, grip_limit=7.0)
    hand.place(BALANCED)
    hg.PhysicalProbe(hand, scene.articulated).touch(BALANCED)
    hand.press(equal(hand, 10.0))
    fault = waited(hand, 1.0)["fault"]
    assert "above 6.3 N at finger" in fault
    assert 6.0 < hand.worst["force [N]"] <= 7.0


def test_fingers_that_press_nothing_stop_at_the_end_of_their_range_at_last(scene):
    hand = hg.SimulatedHand(scene)
    q = BALANCED.copy()
    q[1] -= 0.6
    q[FINGERS] = hand.limits.lower[FINGERS] + 0.05
    hand.place(q)
    hand.press(-equal(hand, 5.0))
    told = waited(hand, 1.5)
    assert "meets nothing" in told["fault"]
    slowly = PRESS_RATE / 10.0  # [rad/s] of a servo of 10 N·m/rad
    assert np.abs(told["velocity"][:, FINGERS]).max() < 1.1 * slowly
    assert within_limits(hand)


# ---------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda t: t * np.nan, "must be finite"),
        (lambda t: t[1:], "must have shape"),
        (lambda t: t + np.eye(11)[2], "which carries the palm"),
        (lambda t: 100.0 * t, "whose limit is 1.85 N·m"),
    ],
)
def test_a_torque_that_cannot_be_is_refused_and_changes_nothing(scene, spoil, says):
    hand, _ = held(scene)
    hand.press(equal(hand, 3.0))
    before = waited(hand, 1.0)["torque"][-1, FINGERS]
    with pytest.raises(hg.InputError, match=says):
        hand.press(spoil(equal(hand, 3.0)))
    np.testing.assert_allclose(waited(hand, 0.3)["torque"][-1, FINGERS], before, atol=0.01)


def test_a_hand_that_presses_nothing_carries_nothing(scene):
    hand, _ = held(scene)
    with pytest.raises(hg.InputError, match="call press first"):
        hand.carry(BALANCED, 1.0)


def test_a_hand_without_grip_says_that_it_cannot_press(scene):
    hand = hg.SimulatedHand(scene, grip_limit=0.0)
    with pytest.raises(hg.InputError, match=r"cannot press: its DriverLimits\.grip is 0 N"):
        hand.press(equal(hand, 1.0))


@pytest.mark.parametrize("force", [5.0, 6.0])
def test_what_a_hand_may_hold_it_holds(scene, force):
    hand, _ = held(scene)
    hand.hold(force)
    told = waited(hand, 4.0)
    assert told["fault"] == ""
    forces = np.linalg.norm(hand.truth().forces, axis=1)
    np.testing.assert_allclose(forces, force, rtol=0.1)


def test_what_a_hand_cannot_hold_it_refuses_by_number_before_it_moves(scene):
    hand, _ = held(scene)
    for call in (lambda: hand.hold(7.0), lambda: hand.close(0, 0.3, 7.0)):
        with pytest.raises(hg.InputError, match="is 7 N; this hand holds 6 N at most"):
            call()
    with pytest.raises(hg.InputError, match="this hand holds 6 N at most"):
        hg.PhysicalProbe(hand, scene.articulated, force=8.0)


# ---------------------------------------------------------------- feeling without moving


def test_feeling_moves_nothing_and_tells_what_is(scene):
    hand, probe = held(scene)
    hand.press(equal(hand, 6.0))
    q = waited(hand, 1.0)["q"][-1]
    felt, truth = probe.feel(), hand.truth()
    np.testing.assert_allclose(felt.q, q, atol=1e-3)
    np.testing.assert_allclose(felt.positions, truth.grasp.positions, atol=1e-3)
    forces = np.array([contact.wrench[:3] for contact in felt.contacts])
    np.testing.assert_allclose(forces, truth.forces, atol=0.1)


def test_feeling_needs_a_touch_that_weighs_the_tips(scene):
    probe = hg.PhysicalProbe(hg.SimulatedHand(scene), scene.articulated)
    with pytest.raises(hg.InputError, match="nothing was touched yet"):
        probe.feel()


def test_feeling_a_finger_that_was_opened_tells_which(scene):
    hand, probe = held(scene)
    q = hand.wait(0.0).q[-1].copy()
    q[9] -= 0.3
    hand.wait(hand.move(q, 0.5) + 0.2)
    felt = probe.feel()
    assert isinstance(felt, hg.Missed) and felt.reason is hg.Miss.LOST


def test_a_driver_that_cannot_press_may_touch_and_is_told_apart(scene):
    class Touches:
        def __init__(self, hand, *calls):
            for call in calls:
                setattr(self, call, getattr(hand, call))

    hand = hg.SimulatedHand(scene)
    hand.place(BALANCED)
    only = Touches(hand, *TOUCHING)
    assert isinstance(hg.PhysicalProbe(only, scene.articulated).touch(BALANCED), hg.Grasp)
    with pytest.raises(hg.InputError, match=r"my hand cannot press: .* lacks press, carry"):
        require_press("my hand", only)
    with pytest.raises(hg.InputError, match=r"cannot press: its DriverLimits\.grip is 0 N"):
        require_press("my hand", hg.SimulatedHand(scene, grip_limit=0.0))
    with pytest.raises(hg.InputError, match="lacks hold, stop, wait"):
        hg.PhysicalProbe(Touches(hand, *TOUCHING[:4]), scene.articulated)
    require_press("my hand", hand)


@pytest.mark.parametrize("robot", ["bhand", "umass_torso"])
def test_hands_without_an_arm_and_with_another_one_press_too(robot):
    began = hg.Start().draw(
        hg.Scene(robot=robot, object=hg.Cylinder(0.05)),
        lambda scene: hg.GeometricProbe(scene, "pass"),
        np.random.default_rng(3),
    )
    hand = hg.SimulatedHand(began.scene, links="pass")
    hand.place(began.grasp.q)
    probe = hg.PhysicalProbe(hand, hand.robot)
    felt = probe.touch(began.grasp.q)
    torque = felt.jacobian.T @ (-3.0 * felt.normals).ravel()
    torque[list(hand.robot.arm)] = 0.0
    hand.press(torque)
    told = waited(hand, 1.0)
    assert told["fault"] == ""
    fingers = torque != 0.0
    followed = FOLLOWED * np.abs(torque).max()
    np.testing.assert_allclose(told["torque"][-1][fingers], torque[fingers], atol=followed)
    assert isinstance(probe.feel(), hg.Grasp)
    q = hand.wait(0.0).q[-1]
    assert hand.carry(q, 0.5) >= (0.5 if hand.robot.arm else 0.0)
    assert waited(hand, 0.6)["fault"] == ""
    np.testing.assert_allclose(hand.wait(0.1).torque[-1][hand.robot.idle], 0.0)
    assert within_limits(hand)
