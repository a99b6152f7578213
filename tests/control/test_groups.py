"""Two hands of one robot: each group moves, closes and withdraws by itself."""

from dataclasses import replace

import numpy as np
import pytest

import hqp_grasp as hg
from hqp_grasp.control.controller import Controller
from hqp_grasp.control.reach import carried
from hqp_grasp.grasp import Grasp, Miss, Missed, Touch
from hqp_grasp.touch.geometric import WITHDRAWAL, GeometricProbe

DRUM = hg.Cylinder(0.2, 0.4)
SEEDS = range(3)
STRAIGHT = 1e-3  # [m] and [rad], of a palm that an arm moves by 3 cm


@pytest.fixture(scope="module")
def tips():
    return hg.Scene("umass_torso", DRUM, hand="both")


@pytest.fixture(scope="module")
def pads():
    return hg.Scene("umass_torso", DRUM, hand="palms")


def first_touch(scene, seed=0):
    rng = np.random.default_rng(seed)
    return hg.Start().draw(scene, GeometricProbe, rng).grasp


@pytest.mark.parametrize("seed", SEEDS)
def test_six_tips_and_two_palms_balance_a_drum(tips, pads, seed):
    for scene, k in ((tips, 6), (pads, 2)):
        record = hg.Trial(scene, hg.stack_of("fm"), probes=12).run(seed=(7, seed))
        assert record.verdict == "good" and record.grasps[-1].k == k
        goal = record.column("goal_f")
        assert np.nanmax(np.abs(goal - 1e-3 * (k / 3) ** 2)) < 1e-15


def test_contacts_tell_their_group_and_frames_their_palm(tips):
    grasp, robot = first_touch(tips), tips.articulated
    assert [c.group for c in grasp.contacts] == ["right"] * 3 + ["left"] * 3
    assert [frame.name for frame in grasp.frames] == ["right", "left"]
    for g, frame in enumerate(grasp.frames):
        np.testing.assert_array_equal(frame.position, robot.palm(grasp.q, g)[0])
        own = np.abs(frame.jacobian).sum(axis=0) > 0.0
        assert np.flatnonzero(own).tolist() == list(robot.groups[g].arm)


@pytest.mark.parametrize(("where", "group"), [("right_finger_2", 0), ("left_f1_distal", 1)])
def test_the_group_that_something_was_in_the_way_of_withdraws_and_the_other_need_not(
    tips, where, group
):
    grasp, robot = first_touch(tips), tips.articulated
    controller = Controller(robot, hg.stack_of("fm"))
    missed = Touch(grasp.q, Missed(Miss.OTHER_LINK, where))
    step = controller.step([Touch(grasp.q, grasp), missed, missed])
    side = robot.groups[group].name
    assert f"palm {side} back by 20 mm" in step.reason and step.reason.count("palm") == 1
    back = [
        (robot.palm(grasp.q, g)[0] - robot.palm(step.q_target, g)[0])
        @ robot.palm(grasp.q, g)[1][:, 2]
        for g in range(2)
    ]
    assert back[group] > 0.02 - 2e-3 and back[1 - group] < 0.015


def test_a_first_touch_that_missed_is_sent_beside_by_the_arm_that_missed_alone(tips):
    grasp, robot = first_touch(tips), tips.articulated
    controller = Controller(robot, hg.stack_of("fm"))
    history = [Touch(grasp.q, Missed(Miss.NO_TOUCH, "left_finger_1"))]
    moved = np.abs(controller.step(history).q_target - grasp.q) > 1e-9
    assert moved.any() and not moved[np.setdiff1d(range(robot.n), robot.groups[1].arm)].any()


def test_a_palm_that_its_arm_closes_goes_straight_and_does_not_turn(pads):
    robot, q = pads.articulated, first_touch(pads).q
    (finger, _) = GeometricProbe(pads)._fingers(q, robot.closing)
    p, R = robot.palm(q, 0)
    for s in (-finger.retreat, -0.011, 0.004, 0.03):
        there = q.copy()
        finger.put(there, s)
        at, turned = robot.palm(there, 0)
        np.testing.assert_allclose(at, p + s * R[:, 2], atol=STRAIGHT)
        np.testing.assert_allclose(turned, R, atol=STRAIGHT)
        assert (np.flatnonzero(there != q) < 7).all()  # the right arm's joints
    assert finger.retreat == WITHDRAWAL


def test_a_palm_closes_from_where_it_was_sent_and_misses_what_is_too_far(pads):
    grasp, probe = first_touch(pads), GeometricProbe(pads)
    again = probe.touch(grasp.q)
    np.testing.assert_allclose(again.positions, grasp.positions, atol=1e-6)
    far = replace(pads, object=hg.Cylinder(0.08, 0.4))
    assert GeometricProbe(far).touch(grasp.q) == Missed(Miss.NO_TOUCH, "right_pad")
    large = replace(pads, object=hg.Cylinder(0.24, 0.4))
    assert GeometricProbe(large).touch(grasp.q).reason is Miss.INSIDE


def test_a_palm_pushes_along_its_normal_the_better_the_straighter_it_faces(pads):
    """The kinematic law takes an arm's closing as one direction, however many joints it has."""
    grasp = first_touch(pads)
    angles = hg.KinematicTask().error(grasp)
    for frame, contact, angle in zip(grasp.frames, grasp.contacts, angles, strict=True):
        facing = -frame.rotation[:, 2] @ contact.normal
        assert angle == pytest.approx(np.arccos(facing), abs=1e-6)


def test_aligned_palms_face_what_they_touch(pads):
    record = hg.Trial(pads, hg.stack_of("fma"), probes=12).run(seed=(7, 1))
    assert record.verdict == "good"
    end = record.grasps[-1]
    assert isinstance(end, Grasp) and np.abs(hg.AlignTask().error(end)).max() < np.radians(3.0)


def test_an_object_out_of_reach_of_one_hand_is_told_with_the_hand():
    scene = hg.Scene("umass_torso", DRUM, position=(0.55, 0.6, 0.8), hand="both")
    with pytest.raises(
        hg.ReachError, match=r"the arm cannot reach the drawn posture \((left|right)\)"
    ):
        first_touch(scene)


def test_all_palms_are_carried_together_or_those_that_are_named(tips):
    robot, q, by = tips.articulated, first_touch(tips).q, np.array([0.0, 0.0, 0.05])
    for groups, rises in ((None, (0.05, 0.05)), ([1], (0.0, 0.05))):
        end = carried(robot, q, by, groups)[-1]
        for g, rise in enumerate(rises):
            moved = robot.palm(end, g)[0] - robot.palm(q, g)[0]
            np.testing.assert_allclose(moved, [0.0, 0.0, rise], atol=2e-4)
