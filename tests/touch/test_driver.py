"""The driver's contract: the simulated hand keeps it, and every broken driver is found out."""

from dataclasses import replace

import numpy as np
import pytest

import hqp_grasp as hg
from hqp_grasp.touch import driver_contract as contract
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

    def press(self, torque):
        self.hand.press(torque)

    def carry(self, q, duration):
        return self.hand.carry(q, duration)

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


class CannotPress(Broken):
    def __init__(self, hand):
        super().__init__(hand)
        self.limits = replace(hand.limits, grip=0.0)


class IgnoredPress(Broken):
    def press(self, torque):
        if self.hand._asked is None:
            self.hand.press(np.where(np.arange(11) < 7, 0.0, self.hand._motors))


class PressedBackwards(Broken):
    def press(self, torque):
        self.hand.press(-torque)


class LessIsMore(Broken):
    """The sign of what is added to a press is wrong."""

    first = None

    def press(self, torque):
        self.first = torque if self.first is None else self.first
        self.hand.press(self.first + 0.4 * (self.first - torque))


class PressedByTheNeighbour(Broken):
    def press(self, torque):
        self.hand.press(torque[[*range(8), 9, 10, 8]])


class PressedAtOnce(Broken):
    def __init__(self, hand):
        super().__init__(hand)

        def at_once(T):
            j = hand._fingers
            hand._followed = hand._asked
            goal = hand._measured()[j] + hand._asked / hand._kp[j]
            return np.clip(goal, hand._lower[j], hand._upper[j]) - hand._goal[j]

        hand._pressing = at_once


class PressesOn(Broken):
    """Presses again after what should have ended it."""

    torque = None

    def press(self, torque):
        self.hand.press(torque)
        self.torque = torque

    def close(self, finger, speed, force):
        self.torque = None
        self.hand.close(finger, speed, force)

    def again(self):
        if self.torque is not None:
            self.hand.press(self.torque)


class PressesOnAfterAStop(PressesOn):
    def stop(self):
        self.hand.stop()
        self.again()


class PressesOnAfterAMove(PressesOn):
    def move(self, q, duration):
        if self.hand._asked is None or self.torque is None:
            return self.hand.move(q, duration)
        self.torque = None
        return self.hand.carry(q, duration)


class PressesOnInSilence(PressesOn):
    """A watchdog that sleeps while fingers press."""

    def wait(self, duration):
        while self.hand._asked is not None and duration > 0.5:
            self.hand.wait(0.5)
            duration -= 0.5
        return self.hand.wait(duration)


class PressesOnNothing(Broken):
    """Says nothing of a stop of its own."""

    def spoil(self, readings):
        return replace(readings, fault="")


class CarriesWithOpenFingers(Broken):
    def carry(self, q, duration):
        self.hand.carry(q, duration)  # refused where it must be
        return self.hand.move(q, duration)


class CarriesNothing(Broken):
    def carry(self, q, duration):
        return self.hand.carry(self.hand._goal, duration)


class CarriesUnasked(Broken):
    def carry(self, q, duration):
        if self.hand._asked is None:
            return self.hand.move(q, duration)
        return self.hand.carry(q, duration)


class TellsNoTorque(Broken):
    def spoil(self, readings):
        return replace(readings, torque=np.full_like(readings.torque, np.nan))


class TellsZeroTorque(Broken):
    def spoil(self, readings):
        return replace(readings, torque=np.zeros_like(readings.torque))


class TorqueOfTheWorld(Broken):
    def spoil(self, readings):
        return replace(readings, torque=-readings.torque)


class TorqueInMilli(Broken):
    def spoil(self, readings):
        return replace(readings, torque=1e3 * readings.torque)


class TorqueOfTheNeighbour(Broken):
    """Right while all fingers press alike."""

    def spoil(self, readings):
        return replace(readings, torque=readings.torque[:, [*range(8), 9, 10, 8]])


def test_the_simulated_hand_keeps_the_contract(scene, grasp):
    check_driver(rig_of(hg.SimulatedHand(scene), scene, grasp))


def test_a_hand_with_the_imperfections_of_a_real_one_keeps_it_too(scene, grasp):
    physics = hg.Physics(imperfections=hg.Imperfections.preset("loadcell"))
    check_driver(rig_of(hg.SimulatedHand(scene, physics), scene, grasp))


# What each check refuses, by the name of the fault.
BROKEN = {
    contract.samples_come_at_the_stated_rate: [
        (FrozenClock, "stale"),
        (TwiceTheRate, "do not come at the stated 200 Hz"),
    ],
    contract.joints_go_where_they_are_sent: [
        (FrozenReadings, "stale"),
        (LateReadings, "stale"),
        (JointBackwards, "wrong sign of a joint: wam_j4"),
    ],
    contract.stop_stops: [
        (IgnoredStop, "stop is ignored"),
    ],
    contract.the_watchdog_stops_the_hand: [
        (lambda hand: Limitless(hand, watchdog=0.2), "the watchdog of 0.2 s does not stop"),
        (SilentWatchdog, "Readings.fault does not say so"),
    ],
    contract.ranges_are_kept: [
        (lambda hand: Limitless(hand, lower=hand.limits.lower + 0.05), "beyond its range"),
    ],
    contract.speeds_are_kept: [
        (lambda hand: Limitless(hand, speed=0.2 * hand.limits.speed), "limits not held: .* rad/s"),
    ],
    contract.tips_weigh_what_they_weigh: [
        (PulledInsteadOfPushed, "wrong sign"),
        (SensorTurnedInItsMount, "wrong frame"),
        (WorldFrame, "wrong frame"),
    ],
    contract.closing_ends_at_a_touch: [
        (TorqueBackwards, "wrong sign of the torque"),
        (SensorBehindTheTip, "wrong frame"),
        (NeverTouches, "does not end at a touch"),
        (HoldsTooHard, "was asked for 1 N"),
    ],
    contract.contact_forces_are_kept: [
        (GripsInsteadOfHolding, "limits not held: a fingertip felt"),
        (HoldsNoMoreThanLittle, "was asked for 6 N, which may be asked for, and reads"),
    ],
    contract.torques_are_those_that_fingers_hold_with: [
        (TellsNoTorque, "readings of torque are wrong"),
        (TellsZeroTorque, "readings of torque are wrong"),
        (TorqueOfTheWorld, "readings of torque are wrong"),
        (TorqueInMilli, "readings of torque are wrong"),
    ],
    contract.pressing_is_followed_slowly: [
        (IgnoredPress, "press is ignored"),
        (PressedByTheNeighbour, "press turns the wrong joint"),
        (PressedAtOnce, "press is not slow"),
        (TorqueOfTheNeighbour, "readings of torque are wrong: when finger_1 presses"),
        (LessIsMore, "press has the wrong sign: finger_1 was asked for"),
    ],
    contract.pressing_ends: [
        (CannotPress, r"cannot press: its DriverLimits\.grip is 0 N"),
        (PressedBackwards, "press has the wrong sign"),
        (PressesOnAfterAStop, "press does not end at a stop"),
        (PressesOnAfterAMove, "press does not end at a move"),
        (PressesOnInSilence, "press does not end at the watchdog"),
    ],
    contract.pressing_on_nothing_stops: [
        (PressesOnNothing, "pressed on nothing, and the hand did not stop itself"),
        (lambda hand: Limitless(hand, speed=0.02 * hand.limits.speed), "ran at"),
    ],
    contract.carrying_keeps_what_is_pressed: [
        (CarriesWithOpenFingers, "carry drops what is pressed"),
        (CarriesNothing, "carry does not move: wam_j7"),
        (CarriesUnasked, "a hand that presses nothing was carried"),
    ],
    contract.grip_forces_are_kept: [
        (lambda hand: Limitless(hand, grip=7.0), "limits not held: pressing, a fingertip felt"),
    ],
}


@pytest.mark.parametrize(
    ("check", "broken", "says"),
    [(check, *fault) for check, faults in BROKEN.items() for fault in faults],
)
def test_a_broken_driver_is_refused_by_the_name_of_its_fault(scene, grasp, check, broken, says):
    with pytest.raises(DriverError, match=says):
        check(rig_of(broken(hg.SimulatedHand(scene)), scene, grasp))


def test_every_check_refuses_something(scene, grasp):
    assert set(BROKEN) == set(CHECKS)


def test_all_that_is_broken_is_told_at_once_and_a_refusal_is_no_way_out(scene, grasp):
    class RefusesToPress(FrozenClock):
        def press(self, torque):
            raise hg.InputError("not today")

    with pytest.raises(DriverError) as told:
        check_driver(rig_of(RefusesToPress(hg.SimulatedHand(scene)), scene, grasp))
    assert "time stamps do not advance" in str(told.value)
    assert "refused is what may be asked for (pressing ends): not today" in str(told.value)


def test_every_check_says_in_a_sentence_what_it_is_about():
    assert len(CHECKS) == len({check.__name__ for check in CHECKS})
    assert all(check.__doc__ for check in CHECKS)
