"""Where the joints must be so that the palm is at a pose, and along straight ways."""

import numpy as np
import pytest

from hqp_grasp.control.reach import _turn, carried, reach
from hqp_grasp.world.scene import Scene


@pytest.fixture(scope="module")
def robot():
    return Scene().articulated


@pytest.fixture(scope="module")
def q(robot):
    """A posture at which the arm has room all around."""
    return np.array([-0.089, 0.954, 0.153, 1.345, -0.114, 0.87, -0.405, 0.859, 1.206, 1.206, 0.915])


def rotation(axis, angle):
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K


@pytest.mark.parametrize("angle", [0.0, 0.3, 2.5, -1.0])
def test_a_turn_is_told_as_axis_times_angle_in_the_world(angle):
    axis = np.array([0.6, 0.0, 0.8])
    R = rotation([0.2, 0.5, -0.3], 0.7)
    np.testing.assert_allclose(_turn(R, rotation(axis, angle) @ R), angle * axis, atol=1e-9)


def test_the_palm_is_brought_to_its_pose_and_joints_that_are_kept_stay(robot, q):
    p, R = robot.palm(q)
    goal, turned = p + np.array([0.02, -0.03, 0.04]), rotation([0.3, 1.0, -0.2], 0.2) @ R
    hand = [j for j in range(robot.n) if j not in robot.arm]
    for keep in (hand, [0, *hand]):
        found = reach(robot, q, goal, turned, keep)
        at, Rat = robot.palm(found)
        np.testing.assert_allclose(at, goal, atol=1e-4)
        np.testing.assert_allclose(Rat, turned, atol=2e-4)
        np.testing.assert_allclose(found[keep], q[keep], atol=1e-9)
        assert robot.violation(found) == 0.0
    np.testing.assert_array_equal(reach(robot, q, p, R, hand), q)  # it is there already


def test_joints_to_spare_go_home_as_far_as_the_palm_leaves_them_free(robot, q):
    """Seven joints for six of a pose: without homing they stay about where they were."""
    p, R = robot.palm(q)
    goal = p + np.array([0.0, 0.0, 0.03])
    hand = [j for j in range(robot.n) if j not in robot.arm]
    off = {
        homing: np.linalg.norm(reach(robot, q, goal, R, hand, homing) - robot.home)
        for homing in (0.0, 0.1, 0.5)
    }
    assert off[0.5] < off[0.1] < off[0.0]
    assert np.array_equal(reach(robot, q, goal, R, hand), reach(robot, q, goal, R, hand, 0.1))


def test_a_pose_out_of_reach_is_none(robot, q):
    p, R = robot.palm(q)
    hand = [j for j in range(robot.n) if j not in robot.arm]
    assert reach(robot, q, p + 2.0, R, hand) is None
    assert reach(robot, q, p + 0.05, R, list(range(robot.n))) is None  # all kept


@pytest.mark.parametrize(
    ("by", "count"),
    [([0.0, 0.0, 0.1], 5), ([0.0, 0.0, 0.11], 6), ([0.0, -0.012, 0.016], 1), ([0.0, 0.0, 0.0], 1)],
)
def test_a_straight_way_has_a_posture_every_two_centimetres(robot, q, by, count):
    way = carried(robot, q, np.array(by))
    assert len(way) == count
    p, R = robot.palm(q)
    fingers = [j for j in range(robot.n) if j not in robot.arm]
    for i, posture in enumerate(way, 1):
        at, turned = robot.palm(posture)
        np.testing.assert_allclose(at, p + np.array(by) * i / count, atol=1e-4)
        np.testing.assert_allclose(turned, R, atol=2e-4)
        np.testing.assert_allclose(posture[fingers], q[fingers], atol=1e-9)
    steps = np.diff([q, *way], axis=0)
    assert np.abs(steps).max() < 0.15  # no joint to spare is moved about


def test_a_way_that_the_arm_cannot_go_to_its_end_is_none(robot, q):
    assert carried(robot, q, np.array([0.0, 0.0, 2.0])) is None
