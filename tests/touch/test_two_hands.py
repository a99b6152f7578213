"""Two hands on an object that is too wide for one, by force."""

import numpy as np
import pytest

import hqp_grasp as hg
from hqp_grasp.experiments.start import Start
from hqp_grasp.tasks import KinematicTask


class Noting(hg.SimulatedHand):
    """A hand that notes where it was sent, and what stopped it."""

    def __init__(self, *args, **kwargs):
        self.sent, self.faults = [], []
        super().__init__(*args, **kwargs)

    def move(self, q, duration):
        self.sent.append(q.copy())
        return super().move(q, duration)

    def wait(self, duration):
        read = super().wait(duration)
        self.faults += [read.fault] if read.fault else []
        return read


@pytest.fixture(scope="module")
def scene():
    return hg.Scene("umass_torso", hg.Cylinder(radius=0.2, height=0.4), hand="both")


def drawn(scene, trial, lean):
    """The first touch of that trial, by geometry."""
    rng = np.random.default_rng(np.random.SeedSequence([0, trial]))
    start = Start(elevation=np.radians([-10.0, 20.0]), lean=np.radians(lean))
    return start.draw(scene, hg.GeometricProbe, rng).grasp


def at(scene, first):
    hand = Noting(scene)
    hand.place(first.q)
    return hand, hg.PhysicalProbe(hand, scene.articulated)


def test_palms_begin_nearer_to_what_their_fingers_close_along(scene):
    robot, law = scene.articulated, KinematicTask()
    far, near = drawn(scene, 2, lean=90.0), drawn(scene, 2, lean=45.0)
    assert law.error(far).max() > np.radians(60.0)
    assert law.error(near).max() < np.radians(45.0)
    for g in range(2):
        (p_far, R_far), (p_near, R_near) = robot.palm(far.q, g), robot.palm(near.q, g)
        way = R_far.T @ (p_near - p_far)
        steps = way[2] / 0.01
        assert steps > 1.0 and steps == pytest.approx(round(steps), abs=0.03)
        np.testing.assert_allclose(way[:2], 0.0, atol=3e-4)
        np.testing.assert_allclose(R_near, R_far, atol=3e-4)
    same = hg.Scene("umass_torso", scene.object, hand="both").articulated.description
    assert same.hand.start["lean"] == pytest.approx(np.radians(45.0))


def test_fingers_wedged_on_a_wide_object_are_freed_by_their_palms(scene):
    first = drawn(scene, 9, lean=90.0)
    hand, probe = at(scene, first)
    felt = probe.touch(first.q)
    assert KinematicTask().error(felt).max() > np.radians(75.0) and not hand.faults
    hand.sent.clear()
    again = probe.touch(felt.q)
    assert hand.faults and hand.faults[0].startswith("contact force above")
    assert isinstance(again, hg.Grasp)
    robot, back = scene.articulated, hand.sent[1]
    for g in range(2):
        p, R = robot.palm(felt.q, g)
        np.testing.assert_allclose(robot.palm(back, g)[0], p - 0.01 * R[:, 2], atol=2e-3)
    fingers = robot.closing.any(axis=0)  # which stay as they are meanwhile
    np.testing.assert_allclose(back[fingers], felt.q[fingers], atol=0.05)


def test_palms_draw_back_on_the_way_by_what_their_fingers_cannot_open(scene):
    robot, first = scene.articulated, drawn(scene, 0, lean=45.0)
    hand, probe = at(scene, first)
    probe.touch(first.q)
    f1 = robot.joints.index("right_bhand_f1_proximal")
    assert first.q[f1] < 0.2  # of the 0.35 rad that it would open by
    assert len(hand.sent) == 4
    _opened, _back, there, away = hand.sent
    np.testing.assert_allclose(away, there, atol=0.2)
    assert away[f1] == pytest.approx(robot.q_lower[f1] + 0.03)
    p, R = robot.palm(away, 0)
    lacks = 0.35 - (first.q[f1] - robot.q_lower[f1] - 0.03)
    withdrawn = R.T @ (robot.palm(there, 0)[0] - p)
    assert withdrawn[2] == pytest.approx(-0.13 * lacks, rel=0.15)  # [m] its tip, by its lever
    np.testing.assert_allclose(withdrawn[:2], 0.0, atol=5e-3)


def test_an_open_finger_that_meets_the_object_is_told_with_its_name(scene):
    """And no joint leaves its range: it is bent by what it bumps into."""
    robot, first = scene.articulated, drawn(scene, 0, lean=45.0)
    hand, probe = at(scene, first)
    felt = probe.touch(first.q)
    inwards = robot.withdrawn(felt.q, np.array([-0.02, 0.0]))
    assert probe.touch(inwards) == hg.Missed(hg.Miss.INSIDE, "right_finger_1")
    assert hand.worst["range [rad]"] == 0.0
    assert isinstance(probe.touch(felt.q), hg.Grasp)
