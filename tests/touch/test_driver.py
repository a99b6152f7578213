"""The driver's contract: the simulated hand keeps it, and every broken driver is found out."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import hqp_grasp as hg
from hqp_grasp.touch import driver_contract as contract
from hqp_grasp.touch.driver_contract import CHECKS, DriverError, Rig, check_driver

# A posture from which every finger touches the cylinder, found by GeometricProbe.
POSTURE = np.array([0.62, 1.12, -0.73, 1.96, 0.63, -0.41, 0.49, 0.21, 1.01, 0.99, 0.98])

COARSE = hg.Physics(timestep=0.005)  # faults show all the same, and sooner; a good hand keeps to it


@pytest.fixture(scope="module")
def scene():
    return hg.Scene(object=hg.Cylinder(0.05))


@pytest.fixture(scope="module")
def grasp(scene):
    return hg.GeometricProbe(scene, "pass").touch(POSTURE)


@pytest.fixture(scope="module")
def toy():
    """What docs/real-hand.md writes out: the toy hand, and the postures of its rig."""
    page = (Path(__file__).parents[2] / "docs" / "real-hand.md").read_text(encoding="utf-8")
    hand, rig, *_ = re.findall(r"^```python\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    names = {}
    exec(hand + rig.split("check_driver(Rig(")[0], names)
    return names


@pytest.fixture(params=["toy", "simulated"])
def rig(request, toy, scene, grasp):
    """Returns the rig of a driver that is made of a good hand."""

    def make(broken):
        if request.param == "simulated":
            return rig_of(broken(hg.SimulatedHand(scene, COARSE)), scene, grasp)
        hand = toy["ToyHand"]()
        hand.robot = toy["robot"]
        return Rig(broken(hand), toy["robot"], toy["free"], toy["q_open"], toy["normals"])

    return make


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


class PressedByTheNeighbourToo(Broken):
    """Each finger presses as hard as the one before it, at least."""

    def press(self, torque):
        torque = torque.copy()
        torque[8:] = np.maximum(torque[8:], torque[[10, 8, 9]])
        self.hand.press(torque)


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
    physics = replace(COARSE, imperfections=hg.Imperfections.preset("loadcell"))
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
        (PressedByTheNeighbourToo, "press turns the wrong joint"),
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
        check(rig_of(broken(hg.SimulatedHand(scene, COARSE)), scene, grasp))


class Sold(Broken):
    """Reads, or does, what `changes` say instead of what a good hand does."""

    def __init__(self, hand, **changes):
        super().__init__(hand)
        for name, change in changes.items():
            setattr(self, name, change.__get__(self))


def says(channel, change):
    """Readings of that channel are changed."""
    return {"spoil": lambda self, r: replace(r, **{channel: change(getattr(r, channel).copy())})}


def exchanged(x, axis, one=-3, other=-2):
    order = np.arange(x.shape[axis])
    order[[one, other]] = order[[other, one]]
    return np.take(x, order, axis)


def late(channel, seconds):
    def spoil(self, readings):
        x, n = getattr(readings, channel), round(seconds * self.rate)
        kept = self.__dict__.get("kept", np.repeat(x[:1], n, axis=0))
        all_of_it = np.concatenate([kept, x])
        self.kept = all_of_it[-n:]
        return replace(readings, **{channel: all_of_it[: len(x)]})

    return {"spoil": spoil}


def axis_turned(degrees, axis):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    R = np.roll(np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]), (axis, axis), (0, 1))
    return says("wrench", lambda x: turned(x, R))


def moved_by(offset):
    return says(
        "wrench", lambda x: np.dstack([x[..., :3], x[..., 3:] + np.cross(offset, x[..., :3])])
    )


def busy(hand):
    """What the hand is at, of either kind."""
    if isinstance(hand, hg.SimulatedHand):
        return {"closing": 1 in hand._mode, "holding": 2 in hand._mode}
    return {"closing": bool(hand.closing), "holding": bool(hand.holding)}


def asleep(what):
    """A watchdog that sleeps meanwhile."""

    def wait(self, duration):
        parts = []
        while busy(self.hand)[what] and duration > 0.5:
            parts.append(self.hand.wait(0.5))
            duration -= 0.5
        return contract._joined([*parts, self.hand.wait(duration)])

    return {"wait": wait}


def closes(finger=lambda i: (i,), speed=1.0, force=1.0):
    def close(self, i, v, f):
        self.limits.require_hold("close", f)
        for j in finger(i):
            self.hand.close(j, speed * v, min(force * f, self.limits.hold))

    return {"close": close}


def move_hurries(self, q, duration):
    self.hand.move(q, 0.3)
    return duration


def newest(self, r):
    return replace(
        r, time=r.time[-1:], q=r.q[-1:], velocity=r.velocity[-1:], wrench=r.wrench[-1:],
        torque=r.torque[-1:],
    )  # fmt: skip


def stop_but(what):
    return {"stop": lambda self: None if busy(self.hand)[what] else self.hand.stop()}


def raises(self, force):
    raise ZeroDivisionError("of its own")


def claims(**changes):
    return lambda hand: Limitless(hand, **{k: v(hand.limits) for k, v in changes.items()})


R1, JOINTS, CLOSE = (
    contract.samples_come_at_the_stated_rate,
    contract.joints_go_where_they_are_sent,
    contract.fingers_close_one_by_one,
)
WEIGH, END, MOVE = (
    contract.tips_weigh_what_they_weigh,
    contract.closing_and_holding_end,
    contract.moves_take_the_time_they_say,
)
TORQUE, MUCH = (
    contract.torques_are_those_that_fingers_hold_with,
    contract.what_is_too_much_is_refused,
)

# Faults of both hands: the check that finds it, its name, and what it does.
FAULTS = [
    (R1, r"readings are missing: .* returns 1 samples", {"spoil": newest}),
    (R1, "readings are missing", {"wait": lambda self, d: self.hand.wait(0.5 * d)}),
    (R1, "a sensor does not answer: readings of wrench", says("wrench", lambda x: np.nan * x)),
    (R1, "Readings.fault says: hm", {"spoil": lambda self, r: replace(r, fault="hm")}),
    (R1, "move returns None", {"move": lambda self, q, d: self.hand.move(q, d) and None}),
    (JOINTS, "joints are exchanged", says("q", lambda x: exchanged(x, 1))),
    (JOINTS, "joints are exchanged", {"move": lambda self, q, d: self.hand.move(exchanged(q, 0), d)}),  # noqa: E501
    (JOINTS, r"and reads .* its angle is in rad", says("q", np.degrees)),
    (JOINTS, "a joint does not arrive", says("q", lambda x: x + 0.05)),
    (JOINTS, "velocity are wrong.* says [+-]0.000", says("velocity", lambda x: 0.0 * x)),
    (JOINTS, "velocity are wrong.* says -0.100", says("velocity", lambda x: -x)),
    (JOINTS, "velocity are wrong.* says [+]0.200", says("velocity", lambda x: 2.0 * x)),
    (JOINTS, "velocity are wrong", says("velocity", lambda x: exchanged(x, 1))),
    (JOINTS, "stale: .* velocity is .0.05. s behind", late("velocity", 0.05)),
    (JOINTS, "stale: .* velocity is -0.0", late("q", 0.05)),
    (MOVE, "move ignores its duration: it returns 0.3", {"move": lambda self, q, d: self.hand.move(q, 0.3)}),  # noqa: E501
    (MOVE, "ignores its duration|takes longer than it says", {"move": move_hurries}),
    (MOVE, "no limit is in the way", {"move": lambda self, q, d: 2.0 * self.hand.move(q, d)}),
    (contract.ranges_are_kept, "beyond its range", claims(upper=lambda m: m.upper - 0.05)),
    (contract.ranges_are_kept, "beyond its range", claims(upper=lambda m: m.upper - 0.5)),
    (contract.speeds_are_kept, "limits not held: .* rad/s", claims(speed=lambda m: 0.5 * m.speed)),
    (WEIGH, "wrong size: .* weighs 2.00", says("wrench", lambda x: 2.0 * x)),
    (WEIGH, "a dead sensor: .* weighs 0.00", says("wrench", lambda x: 0.0 * x)),
    (WEIGH, "wrong size: finger_1 weighs 0.50", says("wrench", lambda x: 0.5 * x)),
    (WEIGH, "wrong frame: .* is 15° off", axis_turned(15, 0)),
    (WEIGH, "wrong frame: .* is 15° off", axis_turned(15, 1)),
    (WEIGH, "wrong frame: .* is 15° off", axis_turned(15, 2)),
    (WEIGH, "size, or sign, of an axis", says("wrench", lambda x: x * [0, 1, 1, 1, 1, 1])),
    (WEIGH, "wrong point: .* 2.0 mm off", moved_by([2e-3, 0.0, 0.0])),
    (WEIGH, "wrong point: .* 2.0 mm off", moved_by([0.0, 0.0, 2e-3])),
    (MUCH, "hold: .* is not refused", {"hold": lambda self, f: self.hand.hold(min(f, self.limits.hold))}),  # noqa: E501
    (MUCH, "hold raises ZeroDivisionError: of its own", {"hold": raises}),
    (CLOSE, "wrenches are exchanged", says("wrench", lambda x: exchanged(x, 1))),
    (CLOSE, "flags are exchanged", says("touched", lambda x: exchanged(x, 0))),
    (CLOSE, "is said to have stalled", says("stalled", lambda x: ~x)),
    (CLOSE, "said to have touched before it moved", says("touched", lambda x: x | True)),
    (CLOSE, "finger_2 moved in its place", closes(lambda i: ((i + 1) % 3,))),
    (CLOSE, "finger_2, finger_3 moved with it", closes(lambda i: range(3))),
    (CLOSE, "close ignores its speed: .* closed at 0.6", closes(speed=2.0)),
    (CLOSE, "close ignores its speed: .* closed at 0.9", closes(speed=3.0)),
    (CLOSE, "was asked for 1 N and reads (2|1.99)", closes(force=2.0)),
    (CLOSE, "asked for 1 N and reads|to end at 1 N, did not", closes(force=5.0)),
    (CLOSE, "asked for 1 N and reads|to end at 1 N, did not", closes(force=8.0)),
    (CLOSE, "hold: .* was asked for 2 N", {"hold": lambda self, f: None}),
    (CLOSE, "wrench are stale: .* 0.04 s later", late("wrench", 0.05)),
    (CLOSE, "wrench are stale: .* 0.29 s later", late("wrench", 0.3)),
    (TORQUE, "readings of torque are wrong", says("torque", lambda x: 0.5 * x)),
    (TORQUE, "readings of torque are wrong", says("torque", lambda x: exchanged(x, 1, -4, -1))),
    (TORQUE, "the motors' torque is 0.05 s behind", late("torque", 0.05)),
    (END, "watchdog of 1 s does not end closing", asleep("closing")),
    (END, "watchdog of 1 s does not end holding", asleep("holding")),
    (END, "stop does not end closing", stop_but("closing")),
    (END, "stop does not end holding", stop_but("holding")),
]  # fmt: skip


@pytest.mark.parametrize(("check", "name", "fault"), FAULTS)
def test_a_fault_of_either_hand_is_refused_by_its_name(rig, check, name, fault):
    broken = fault if callable(fault) else lambda hand: Sold(hand, **fault)
    with pytest.raises(DriverError, match=name):
        check(rig(broken))


@pytest.mark.parametrize(
    ("name", "scale"), [("is 0", 0.0), ("torque is halved", 0.5), ("torque is doubled", 2.0)]
)
def test_a_wrong_torque_of_the_wrench_shows_as_tips_are_dragged(scene, grasp, name, scale):
    fault = says("wrench", lambda x: x * np.repeat([1.0, scale], 3))
    with pytest.raises(DriverError, match=f"wrong torque of the wrench: .*{name}"):
        contract.wrenches_agree_with_all_else(
            rig_of(Sold(hg.SimulatedHand(scene, COARSE), **fault), scene, grasp)
        )


def test_a_watchdog_that_sleeps_while_the_arm_carries_is_found(scene, grasp):
    class Carrier(Broken):
        def wait(self, duration):
            while self.hand._ramp and self.hand._asked is not None and duration > 0.5:
                self.hand.wait(0.5)
                duration -= 0.5
            return self.hand.wait(duration)

    with pytest.raises(DriverError, match="does not end carrying"):
        contract.carrying_keeps_what_is_pressed(
            rig_of(Carrier(hg.SimulatedHand(scene, COARSE)), scene, grasp)
        )


def test_what_a_move_only_hides_is_found(toy):
    """The toy's move sets its path, and forgets that fingers close."""

    def move(self, q, duration):
        closing = dict(self.hand.closing)
        duration = self.hand.move(q, duration)
        self.hand.closing = closing
        return duration

    rig = Rig(
        Sold(toy["ToyHand"](), move=move), toy["robot"], toy["free"], toy["q_open"], toy["normals"]
    )
    with pytest.raises(DriverError, match="move does not end closing"):
        END(rig)


def test_a_finger_that_closed_on_nothing_is_waited_for_until_it_stands_and_no_longer(scene, grasp):
    """By 0.9 rad/s to the end of its range, as the hand's own clock tells; not for 8 s."""
    lasted = []

    class Timed(Broken):
        began = None

        def close(self, finger, speed, force):
            super().close(finger, speed, force)
            self.began = self.hand._state[0]

        def stop(self):
            super().stop()
            if self.began is not None:
                lasted.append(self.hand._state[0] - self.began)
                self.began = None

    rig = rig_of(Timed(hg.SimulatedHand(scene, COARSE)), scene, grasp)
    contract.ranges_are_kept(rig)
    flexion = [j for (j,) in scene.articulated.flexion]
    ways = (scene.articulated.q_upper - rig.free[0])[flexion]
    assert len(lasted) == 3 and (np.array(lasted) < ways / 0.9 + 0.6).all()
    assert max(lasted) > 1.0


def test_normals_that_are_known_to_ten_degrees_are_enough(scene, grasp):
    physics = hg.Physics(imperfections=hg.Imperfections.preset("loadcell"))
    good = rig_of(hg.SimulatedHand(scene, physics), scene, grasp)
    across = np.cross(good.normals, [0.3, -0.5, 0.8])
    across /= np.linalg.norm(across, axis=1)[:, None]
    off = np.cos(np.radians(9.0)) * good.normals + np.sin(np.radians(9.0)) * across
    rig = Rig(good.driver, good.robot, good.free, good.open, off)
    contract.closing_ends_at_a_touch(rig)
    contract.wrenches_agree_with_all_else(rig)


def test_a_channel_spoilt_at_random_is_refused(scene, grasp):
    for seed in range(2):
        rng = np.random.default_rng(seed)
        channel = str(rng.choice(["q", "velocity", "wrench", "torque"]))
        how = rng.choice(["scaled", "late", "exchanged"])
        one, other = rng.choice(3, 2, replace=False) - 3  # fingers, or their joints
        if how == "late":
            fault = late(channel, float(rng.uniform(0.05, 0.3)))
        elif how == "scaled":
            by = np.ones(3 if channel == "wrench" else 11)
            by[one] = rng.choice([-1.0, 0.0, 0.5, 2.0])
            by = by[:, None] if channel == "wrench" else by
            fault = says(channel, lambda x, by=by: x * by)
        else:
            fault = says(channel, lambda x, one=one, other=other: exchanged(x, 1, one, other))
        rig = rig_of(Sold(hg.SimulatedHand(scene, COARSE), **fault), scene, grasp)
        with pytest.raises(DriverError):
            until_refused(rig)


def until_refused(rig):
    for check in CHECKS:
        check(rig)


def test_every_check_refuses_something():
    found = set(BROKEN) | {check for check, *_ in FAULTS}
    assert found | {contract.wrenches_agree_with_all_else} == set(CHECKS)


def test_all_that_is_broken_is_told_at_once_and_a_refusal_is_no_way_out(scene, grasp):
    class RefusesToPress(FrozenClock):
        def press(self, torque):
            raise hg.InputError("not today")

    with pytest.raises(DriverError) as told:
        check_driver(rig_of(RefusesToPress(hg.SimulatedHand(scene, COARSE)), scene, grasp))
    assert "time stamps do not advance" in str(told.value)
    assert "refused is what may be asked for (pressing ends): not today" in str(told.value)


def test_every_check_says_in_a_sentence_what_it_is_about():
    assert len(CHECKS) == len({check.__name__ for check in CHECKS})
    assert all(check.__doc__ for check in CHECKS)
