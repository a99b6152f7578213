"""The driver's contract: the simulated hand keeps it, and every broken driver is found out."""

from dataclasses import replace

import numpy as np
import pytest

import hqp_grasp as hg
from hqp_grasp.touch.driver_contract import CHECKS, DriverError, Rig, check_driver

# A posture from which every finger touches the cylinder, found by GeometricProbe.
POSTURE = np.array([0.62, 1.12, -0.73, 1.96, 0.63, -0.41, 0.49, 0.21, 1.01, 0.99, 0.98])


@pytest.fixture(scope="module")
def scene():
    return hg.Scene(object=hg.Cylinder(0.05))


@pytest.fixture(scope="module")
def grasp(scene):
    return hg.GeometricProbe(scene, "pass").touch(POSTURE)


def rig_of(driver, scene, grasp):
    """The driver beside the cylinder, and far from it."""
    robot = scene.articulated
    flexion = [j for (j,) in robot.flexion]
    opened = grasp.q.copy()
    opened[flexion] -= 0.3
    away = opened.copy()
    away[1] -= 0.6  # the arm lifts the hand off
    turned = away.copy()
    turned[[5, 6]] += 0.8, 1.2
    turned[flexion] += 0.8
    return Rig(driver, robot, np.array([away, turned]), opened, grasp.normals)


class Broken:
    """A driver that passes everything on to a good one; each kind below spoils one thing."""

    def __init__(self, hand):
        self.hand = hand
        self.limits, self.rate = hand.limits, hand.rate

    def move(self, q, duration):
        return self.hand.move(q, duration)

    def close(self, finger, speed, force):
        self.hand.close(finger, speed, force)

    def hold(self, force):
        self.hand.hold(force)

    def stop(self):
        self.hand.stop()

    def wait(self, duration):
        return self.spoil(self.hand.wait(duration))

    def spoil(self, readings):
        return readings


class PulledInsteadOfPushed(Broken):
    def spoil(self, readings):
        return replace(readings, wrench=-readings.wrench)


class TorqueBackwards(Broken):
    def spoil(self, readings):
        return replace(readings, wrench=readings.wrench * np.repeat([1.0, -1.0], 3))


def turned(wrench, R):
    return np.concatenate([wrench[..., :3] @ R, wrench[..., 3:] @ R], axis=-1)


class SensorTurnedInItsMount(Broken):
    def spoil(self, readings):
        R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        return replace(readings, wrench=turned(readings.wrench, R))


class WorldFrame(Broken):
    def spoil(self, readings):
        wrench = readings.wrench.copy()
        for t, q in enumerate(readings.q):
            for i, R in enumerate(self.hand.robot.tip_frames(q)):
                wrench[t, i] = turned(wrench[t, i], R.T)
        return replace(readings, wrench=wrench)


class SensorBehindTheTip(Broken):
    def spoil(self, readings):
        wrench = readings.wrench.copy()
        wrench[..., 3:] += np.cross([0.0, 0.0, 0.02], wrench[..., :3])
        return replace(readings, wrench=wrench)


class FrozenReadings(Broken):
    first = None

    def spoil(self, readings):
        self.first = self.first or readings
        shape = (len(readings.time), 1)
        return replace(
            readings,
            q=np.tile(self.first.q[0], shape),
            velocity=np.tile(self.first.velocity[0], shape),
            wrench=np.tile(self.first.wrench[0], (*shape, 1)),
        )


class LateReadings(Broken):
    LATE = 25  # samples

    def __init__(self, hand):
        super().__init__(hand)
        self.kept = np.tile(hand.wait(0.0).q[0], (self.LATE, 1))

    def spoil(self, readings):
        q = np.concatenate([self.kept, readings.q])
        self.kept = q[-self.LATE :]
        return replace(readings, q=q[: len(readings.q)])


class FrozenClock(Broken):
    def spoil(self, readings):
        return replace(readings, time=np.zeros_like(readings.time))


class TwiceTheRate(Broken):
    def __init__(self, hand):
        super().__init__(hand)
        self.rate = 2.0 * hand.rate


class JointBackwards(Broken):
    def move(self, q, duration):
        q = q.copy()
        q[3] = 2.0 * POSTURE[3] - q[3]
        return self.hand.move(q, duration)


class IgnoredStop(Broken):
    def stop(self):
        pass


class Limitless(Broken):
    """Claims limits that it does not keep."""

    def __init__(self, hand, **changes):
        super().__init__(hand)
        self.limits = replace(hand.limits, **changes)


class SilentWatchdog(Broken):
    def spoil(self, readings):
        return replace(readings, fault="")


class NeverTouches(Broken):
    def spoil(self, readings):
        return replace(readings, touched=np.zeros(3, bool))


class HoldsTooHard(Broken):
    def hold(self, force):
        self.hand.hold(min(1.5 * force, 6.0))


class HoldsNoMoreThanLittle(Broken):
    def hold(self, force):
        self.hand.hold(min(force, 2.0))


class GripsInsteadOfHolding(Broken):
    """Claims a limit of 5 N, and cuts what is asked for at 6."""

    def __init__(self, hand):
        super().__init__(hand)
        self.limits = replace(hand.limits, force=5.0)

    def hold(self, force):
        self.hand.hold(min(force, 6.0))


def test_the_simulated_hand_keeps_the_contract(scene, grasp):
    check_driver(rig_of(hg.SimulatedHand(scene), scene, grasp))


def test_a_hand_with_the_imperfections_of_a_real_one_keeps_it_too(scene, grasp):
    physics = hg.Physics(imperfections=hg.Imperfections.preset("loadcell"))
    check_driver(rig_of(hg.SimulatedHand(scene, physics), scene, grasp))


@pytest.mark.parametrize(
    ("broken", "says"),
    [
        (PulledInsteadOfPushed, "wrong sign"),
        (TorqueBackwards, "wrong sign of the torque"),
        (SensorTurnedInItsMount, "wrong frame"),
        (WorldFrame, "wrong frame"),
        (SensorBehindTheTip, "wrong frame"),
        (FrozenReadings, "stale"),
        (LateReadings, "stale"),
        (FrozenClock, "stale"),
        (TwiceTheRate, "do not come at the stated 200 Hz"),
        (JointBackwards, "wrong sign of a joint: wam_j4"),
        (IgnoredStop, "stop is ignored"),
        (lambda hand: Limitless(hand, watchdog=0.2), "the watchdog of 0.2 s does not stop"),
        (lambda hand: Limitless(hand, speed=0.2 * hand.limits.speed), "limits not held: .* rad/s"),
        (lambda hand: Limitless(hand, lower=hand.limits.lower + 0.05), "beyond its range"),
        (GripsInsteadOfHolding, "limits not held: a fingertip felt"),
        (HoldsNoMoreThanLittle, "was asked for 6 N, which may be asked for, and reads"),
        (SilentWatchdog, "Readings.fault does not say so"),
        (NeverTouches, "does not end at a touch"),
        (HoldsTooHard, "was asked for 1 N"),
    ],
)
def test_a_broken_driver_is_refused_by_the_name_of_its_fault(scene, grasp, broken, says):
    with pytest.raises(DriverError, match=says):
        check_driver(rig_of(broken(hg.SimulatedHand(scene)), scene, grasp))


def test_every_check_says_in_a_sentence_what_it_is_about():
    assert len(CHECKS) == len({check.__name__ for check in CHECKS})
    assert all(check.__doc__ for check in CHECKS)
