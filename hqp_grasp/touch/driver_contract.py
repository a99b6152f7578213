"""What every driver must do, as tests that its author runs on the hand itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from hqp_grasp.errors import HqpGraspError, InputError
from hqp_grasp.grasp import as_array
from hqp_grasp.touch.driver import PRESS_RATE, Driver, Readings
from hqp_grasp.touch.physical import payload, weight
from hqp_grasp.touch.sensing import sense
from hqp_grasp.world.robot import Robot

TRAVEL = 0.1  # [rad] that joints are moved by
NEAR = 0.01  # [rad] a joint is where it was sent
STANDS = 5e-3  # [rad] a joint that stands still moves by less
BRAKING = 0.2  # [s]
RATE_TOLERANCE = 0.2  # share of the time between samples
SPEED_TOLERANCE = 1.02
TOUCH = 0.2  # [N]
PRESS = 1.0  # [N]
PRESS_TOLERANCE = 0.15
CLOSING = 0.3  # [rad/s]
PLAIN, TORQUE_NEGATED = np.ones(6), np.repeat([1.0, -1.0], 3)
TELLING = np.radians(5.0)  # by which normals fit better, on average
TORQUE_TOLERANCE = 0.3  # share of the largest torque
FIRM, LIGHT = 0.3, 0.3  # shares: of the grip limit, and of a firm press
HALF = 0.5  # share of a torque limit that a firm press needs, at most
FOLLOWS = 0.6  # [s] in which what is pressed is followed
FOLLOWED = 0.5  # share of what was asked for, at least
IGNORED = 0.2  # share of it that says nothing
ENDED = 0.5  # share of what was pressed that is left, at most
WINDOW = 0.05  # [s]
WINDOW_TOLERANCE = 0.15  # share of the torque
CARRIED = 2e-3  # [m] of the tips
NOTHING = 3.0  # [s] for a finger to notice that it presses on nothing
PATIENCE = 8.0  # [s] for fingers to touch
NORMAL_TOLERANCE = np.radians(20.0)  # measured normals are given to 10°
WEIGHT_TOLERANCE = 0.5  # share of the tip's weight
SURE = 4.0  # standard deviations of the mean by which noise may look like an error


class DriverError(HqpGraspError, AssertionError):
    """A driver does not do what its protocol says."""


@dataclass(frozen=True, eq=False)
class Rig:
    """A driver, ready to be tested.

    `free` are postures in free air, in which the tips point clearly different ways; around each,
    every joint may move by TRAVEL and fingers may open. From `open` every finger can close onto
    something that stands still, whose outward `normals` where they meet it are known to 10°.
    """

    driver: Driver
    robot: Robot
    free: np.ndarray  # (p, n) [rad], p ≥ 2
    open: np.ndarray  # (n,) [rad]
    normals: np.ndarray  # (k, 3) world
    _names: tuple[str, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        n, k = self.robot.n, len(self.robot.flexion)
        for name, shape in (("free", (None, n)), ("open", (n,)), ("normals", (k, 3))):
            array = as_array(f"Rig.{name}", getattr(self, name), shape)
            object.__setattr__(self, name, array)
        if len(self.free) < 2:
            raise InputError("Rig.free needs two postures at least")
        names = tuple(point.name for point in self.robot.description.contact_points)
        object.__setattr__(self, "_names", names)

    def go(self, q: np.ndarray, duration: float = 1.0) -> Readings:
        """Move there, calling the driver as often as its watchdog wants."""
        return self.wait(self.driver.move(q, duration))

    def wait(self, duration: float) -> Readings:
        """Wait in slices; all readings in one."""
        slices: list[Readings] = []
        left = duration
        while left > 0.0 or not slices:
            slices.append(self.driver.wait(min(left, 0.5 * self.driver.limits.watchdog)))
            left -= 0.5 * self.driver.limits.watchdog
        return _joined(slices)

    def joint(self, j: int) -> str:
        """Name of an independent joint."""
        return self.robot.joints[j]


def check_driver(rig: Rig) -> None:
    """Run every check of CHECKS; raise DriverError with all that was found."""
    faults = []
    for check in CHECKS:
        try:
            check(rig)
        except DriverError as fault:
            faults.append(str(fault))
        except InputError as refusal:
            about = check.__name__.replace("_", " ")
            faults.append(f"refused is what may be asked for ({about}): {refusal}")
        finally:
            rig.driver.stop()
    if faults:
        raise DriverError("; ".join(faults))


def samples_come_at_the_stated_rate(rig: Rig) -> None:
    """Every sample has a time of its own, 1/rate after the one before."""
    rig.go(rig.free[0])
    one, other = rig.wait(0.5), rig.wait(0.5)
    n, k = rig.robot.n, len(rig.normals)
    if one.q.shape[1] != n or one.velocity.shape[1] != n or one.wrench.shape[1] != k:
        raise DriverError(
            f"readings are of {one.q.shape[1]} joints and {one.wrench.shape[1]} tips; "
            f"the robot has {n} and {k}"
        )
    gaps = np.diff(np.concatenate([one.time, other.time])) * rig.driver.rate
    if gaps.min() <= 0.0:
        raise DriverError("readings are stale: time stamps do not advance from sample to sample")
    if np.abs(gaps - 1.0).max() > RATE_TOLERANCE:
        raise DriverError(
            f"readings do not come at the stated {rig.driver.rate:g} Hz: samples are "
            f"{gaps.min() / rig.driver.rate:g} to {gaps.max() / rig.driver.rate:g} s apart"
        )


def joints_go_where_they_are_sent(rig: Rig) -> None:
    """After a move the readings are of its end, at once."""
    flexion = [j for joints in rig.robot.flexion for j in joints]
    for joints in (flexion, range(rig.robot.n)):  # fingers alone are quick
        rig.go(rig.free[0])
        target = rig.free[0].copy()
        target[joints] = _around(rig, target, TRAVEL)[joints]
        before = rig.wait(0.2).q[-1]
        arrived = rig.go(target, 0.3).q[-1]
        _must_arrive(rig, before, target, arrived, rig.wait(0.5).q[-1])


def _must_arrive(
    rig: Rig, before: np.ndarray, target: np.ndarray, arrived: np.ndarray, later: np.ndarray
) -> None:
    for j in range(rig.robot.n):
        asked = target[j] - before[j]
        if abs(asked) < 2.0 * NEAR or abs(arrived[j] - target[j]) < NEAR:
            continue
        did = f"{rig.joint(j)} was sent by {asked:+.3f} rad and reads {arrived[j] - before[j]:+.3f}"
        if abs(later[j] - before[j]) < 1e-9:
            raise DriverError(f"readings are stale: {did}, unchanged to the last bit")
        if abs(later[j] - target[j]) < NEAR:
            raise DriverError(f"readings are stale: {did}, and arrives only later")
        if (later[j] - before[j]) * asked < 0.0:
            raise DriverError(f"wrong sign of a joint: {did}")
        raise DriverError(f"a joint does not arrive: {did}")


def stop_stops(rig: Rig) -> None:
    """After a stop in full motion every joint stands."""
    rig.go(rig.free[0])
    target = _around(rig, rig.free[0], TRAVEL)
    rig.driver.move(target, 2.0)
    rig.wait(0.8)
    rig.driver.stop()
    rig.wait(BRAKING)
    _must_stand(rig, rig.wait(1.5).q, "stop is ignored")


def the_watchdog_stops_the_hand(rig: Rig) -> None:
    """A caller that falls silent for longer than the watchdog finds the hand standing."""
    rig.go(rig.free[0])
    watchdog = rig.driver.limits.watchdog
    rig.driver.move(_around(rig, rig.free[0], TRAVEL), 3.0 * watchdog + 1.0)
    silent = rig.driver.wait(3.0 * watchdog + 0.5)  # one call: no slices here
    standing = silent.time > silent.time[-1] - (2.0 * watchdog + 0.5 - BRAKING)
    about = f"limits not held: the watchdog of {watchdog:g} s does not stop the hand"
    _must_stand(rig, silent.q[standing], about)
    if not silent.fault:
        raise DriverError("the watchdog stopped the hand, and Readings.fault does not say so")


def ranges_are_kept(rig: Rig) -> None:
    """Fingers that are sent beyond their open end stay in their range."""
    limits, q = rig.driver.limits, rig.free[0].copy()
    rig.go(q)
    flexion = [j for joints in rig.robot.flexion for j in joints]
    q[flexion] = limits.lower[flexion] - 3.0 * TRAVEL
    seen = np.concatenate([rig.go(q).q, rig.wait(0.5).q])
    outside = np.maximum(limits.lower - seen, seen - limits.upper).max(axis=0)
    if outside.max() > NEAR:
        j = int(outside.argmax())
        raise DriverError(
            f"limits not held: {rig.joint(j)} went {outside[j]:.3f} rad beyond its range"
        )


def speeds_are_kept(rig: Rig) -> None:
    """However soon a posture is asked for, no joint moves faster than its limit."""
    rig.go(rig.free[0])
    target = _around(rig, rig.free[0], TRAVEL)
    seen = [rig.wait(rig.driver.move(q, 1e-3) + 0.2) for q in (target, rig.free[0])]
    rig.go(rig.open)
    for i in range(len(rig.normals)):
        rig.driver.close(i, 1e3, TOUCH)
    seen.append(_until_touched(rig))
    rig.go(rig.open)
    for readings in seen:
        between = np.diff(readings.q, axis=0) * rig.driver.rate
        fastest = np.maximum(np.abs(readings.velocity).max(axis=0), np.abs(between).max(axis=0))
        share = fastest / rig.driver.limits.speed
        if share.max() > SPEED_TOLERANCE:
            j = int(share.argmax())
            raise DriverError(
                f"limits not held: {rig.joint(j)} moved at {fastest[j]:.3g} rad/s, "
                f"its limit is {rig.driver.limits.speed[j]:.3g}"
            )


def tips_weigh_what_they_weigh(rig: Rig) -> None:
    """As a tip turns, the wrench changes by its weight: right sign, right frame."""
    load = payload(rig.robot)
    felt, due, unsure = [], [], 0.0
    for q in rig.free:
        rig.go(q)
        rig.wait(0.3)
        readings = rig.wait(1.0)
        force = readings.wrench[..., :3]
        felt.append(force.mean(axis=0))
        due.append(weight(load, rig.robot.tip_frames(readings.q.mean(axis=0)))[:, :3])
        spread = float(np.linalg.norm(force.std(axis=0), axis=-1).max())
        unsure = max(unsure, SURE * spread / np.sqrt(len(force)))
    felt_change, due_change = np.array(felt) - felt[0], np.array(due) - due[0]
    for i, name in enumerate(rig._names):
        change, wanted = felt_change[1:, i], due_change[1:, i]
        size = float(np.linalg.norm(wanted))
        if size < 2.0 * unsure:
            continue  # lost in noise: what touches tells signs and frames
        share = float((change * wanted).sum()) / size**2
        rest = float(np.linalg.norm(change - wanted)) / size
        if rest <= WEIGHT_TOLERANCE + unsure / size:
            continue
        if share < -WEIGHT_TOLERANCE:
            raise DriverError(
                f"wrong sign: {name} weighs {share:.2f} of its weight; the wrench is the one "
                "that the world applies to the tip"
            )
        raise DriverError(
            f"wrong frame: as {name} turns, its weight does not turn with it ({share:.2f} of it "
            f"does, {rest:.2f} are off); the wrench is in the tip's own frame"
        )


def closing_ends_at_a_touch(rig: Rig) -> None:
    """Every finger finds the thing, and feels it push the way it lies."""
    before, held = _held(rig)
    R_world_tip = rig.robot.tip_frames(held.q.mean(axis=0)).copy()
    pushed = _pushed(rig, before, held)
    better = []
    for i, (name, R) in enumerate(zip(rig._names, R_world_tip, strict=True)):
        f = R @ pushed[i, :3]
        size = float(np.linalg.norm(f))
        if abs(size - PRESS) > PRESS_TOLERANCE * PRESS:
            raise DriverError(f"hold: {name} was asked for {PRESS:g} N and reads {size:.3g} N")
        if float(f @ rig.normals[i]) < -0.5 * size:
            raise DriverError(
                f"wrong sign: the thing seems to pull at {name}; the wrench is the one that the "
                "world applies to the tip"
            )
        off = [_off(rig, i, R, pushed[i] * sign) for sign in (PLAIN, TORQUE_NEGATED)]
        if off[0] > NORMAL_TOLERANCE:
            raise DriverError(
                f"wrong frame: {name} feels a normal {np.degrees(off[0]):.0f}° off the thing's; "
                "force and torque are about the tip's centre, in the tip's frame"
            )
        better.append(off[0] - off[1])
    if np.mean(better) > TELLING:
        raise DriverError(
            "wrong sign of the torque: negated, the normals felt fit the thing's better, by "
            f"{np.degrees(np.mean(better)):.0f}°"
        )


def _off(rig: Rig, i: int, R: np.ndarray, pushed: np.ndarray) -> float:
    """Angle [rad] between the normal that tip i feels and the thing's."""
    try:
        normal = R @ sense(pushed, float(rig.robot.tip_radius[i]))[1]
    except InputError:  # no push on the tip explains the wrench
        return np.pi
    return float(np.arccos(np.clip(normal @ rig.normals[i], -1.0, 1.0)))


def _held(rig: Rig) -> tuple[Readings, Readings]:
    """Readings of open fingers, and of when all of them hold PRESS."""
    rig.go(rig.open)
    rig.wait(0.3)
    before = rig.wait(0.3)
    for i in range(len(rig.normals)):
        rig.driver.close(i, CLOSING, TOUCH)
    closed = _until_touched(rig)
    if not closed.touched.all():
        names = [n for n, t in zip(rig._names, closed.touched, strict=True) if not t]
        raise DriverError(f"close does not end at a touch: {', '.join(names)} did not")
    rig.driver.hold(PRESS)
    rig.wait(1.0)
    return before, rig.wait(0.3)


def _pushed(rig: Rig, before: Readings, now: Readings) -> np.ndarray:
    """The mean wrench (k, 6) beside the tips' own weight, each in its tip's frame."""
    load, robot = payload(rig.robot), rig.robot
    pushed = now.wrench.mean(axis=0) - before.wrench.mean(axis=0)
    pushed -= weight(load, robot.tip_frames(now.q.mean(axis=0)))
    return np.asarray(pushed + weight(load, robot.tip_frames(before.q.mean(axis=0))))


def contact_forces_are_kept(rig: Rig) -> None:
    """What may be held is held; whatever more is asked for, the force stays below its limit."""
    limits = rig.driver.limits
    rig.go(rig.open)
    rig.wait(0.3)
    before = rig.wait(0.3).wrench[..., :3].mean(axis=0)
    for i in range(len(rig.normals)):
        rig.driver.close(i, CLOSING, TOUCH)
    seen = [_until_touched(rig)]
    rig.driver.hold(limits.hold)
    seen += [rig.wait(0.5 + 0.5 * limits.hold), rig.wait(0.3)]
    held = np.linalg.norm(seen[-1].wrench[..., :3].mean(axis=0) - before, axis=-1)
    with suppress(InputError):  # a driver may refuse
        rig.driver.hold(1e3 * limits.force)
    seen.append(rig.wait(2.0))
    rig.go(rig.open)
    _must_stay_below("a fingertip felt", seen, limits.force)
    if seen[-2].fault:
        raise DriverError(
            f"hold: {limits.hold:g} N may be asked for, and stops the hand: {seen[-2].fault}"
        )
    if held.min() < (1.0 - PRESS_TOLERANCE) * limits.hold:
        raise DriverError(
            f"hold: {rig._names[int(held.argmin())]} was asked for {limits.hold:g} N, which may be "
            f"asked for, and reads {held.min():.3g} N"
        )


def _must_stay_below(what: str, seen: Sequence[Readings], limit: float) -> None:
    largest = max(float(np.linalg.norm(r.wrench[..., :3], axis=-1).max()) for r in seen)
    if largest > limit:
        raise DriverError(f"limits not held: {what} {largest:.3g} N, the limit is {limit:.3g} N")


def torques_are_those_that_fingers_hold_with(rig: Rig) -> None:
    """The motors' torques are in balance with what the tips feel."""
    before, held = _held(rig)
    q = held.q.mean(axis=0)
    felt = _pushed(rig, before, held)
    frames, places = rig.robot.tip_frames(q).copy(), _places(rig, q)
    due = np.zeros(rig.robot.n)
    for i, R in enumerate(frames):
        due -= rig.robot.link_jacobian(q, i, places[i]).T @ (R @ felt[i, :3])
    _must_read(rig, "holding", due, held.torque.mean(axis=0))


def _must_read(rig: Rig, what: str, due: np.ndarray, read: np.ndarray) -> None:
    """Raise where fingers' joints do not read the torque (n,) [N·m] that is due."""
    fingers = _fingers(rig)
    size = np.abs(due[fingers]).max()
    off = np.where(np.isnan(read), np.inf, np.abs(read - due))[fingers]
    if off.max() > TORQUE_TOLERANCE * size:
        j = fingers[int(off.argmax())]
        raise DriverError(
            f"readings of torque are wrong: {what}, {rig.joint(j)} presses with {due[j]:.3g} N·m "
            f"and reads {read[j]:.3g}"
        )


def _fingers(rig: Rig) -> list[int]:
    """Joints that carry no palm, into q."""
    robot = rig.robot
    return [j for j in range(robot.n) if j not in robot.arm and not robot.idle[j]]


def _places(rig: Rig, q: np.ndarray) -> np.ndarray:
    """Where the tips meet the thing (k, 3) [m], world."""
    return np.asarray(rig.robot.centers(q) - rig.robot.tip_radius[:, None] * rig.normals)


def _torque(rig: Rig, q: np.ndarray, forces: np.ndarray) -> np.ndarray:
    """Joint torques (n,) [N·m] by which tips push the thing with `forces` (k,) [N], inwards."""
    torque, fingers = np.zeros(rig.robot.n), _fingers(rig)
    for i, place in enumerate(_places(rig, q)):
        J = rig.robot.link_jacobian(q, i, place)
        torque[fingers] -= forces[i] * (rig.normals[i] @ J)[fingers]
    return torque


def _pressed(rig: Rig, firmly: bool) -> tuple[Readings, tuple[float, float], Readings]:
    """Readings of open fingers, what is a light and a firm press [N], and readings under one."""
    limits = rig.driver.limits
    if limits.grip == 0.0:
        raise DriverError("the driver cannot press: its DriverLimits.grip is 0 N")
    before, held = _held(rig)
    q, k = held.q.mean(axis=0), len(rig.normals)
    alone = np.array([_torque(rig, q, one) for one in np.eye(k)])  # by 1 N
    firm = min(FIRM * limits.grip, HALF / float((np.abs(alone) / limits.torque).max()))
    force = firm if firmly else LIGHT * firm
    rig.driver.press(force * alone.sum(axis=0))
    rig.wait(FOLLOWS)
    pressed = rig.wait(0.3)
    got = _inwards(rig, before, pressed)
    said = f"each tip held {PRESS:g} N, was told to press with {force:.2g} N, and presses with"
    if (got < FOLLOWED * min(PRESS, force)).any():
        raise DriverError(f"press has the wrong sign: {said} {np.round(got, 2)} N")
    if pressed.fault:
        raise DriverError(f"press: {force:.2g} N at each tip stopped the hand: {pressed.fault}")
    return before, (LIGHT * firm, firm), pressed


def _inwards(rig: Rig, before: Readings, now: Readings) -> np.ndarray:
    """Force (k,) [N] of each tip on the thing, along its normal."""
    frames = rig.robot.tip_frames(now.q.mean(axis=0)).copy()
    pushed = _pushed(rig, before, now)[:, :3]
    return np.asarray(np.einsum("kab,kb,ka->k", frames, pushed, rig.normals))


def pressing_is_followed_slowly(rig: Rig) -> None:
    """Each finger presses as its torque says, alone, from what it was to what is asked."""
    before, (light, firm), now = _pressed(rig, firmly=False)
    q, k = now.q.mean(axis=0), len(rig.normals)
    was, arm = _inwards(rig, before, now), now.q[-1]
    more = firm - light
    for i, name in enumerate(rig._names):
        torque = _torque(rig, q, np.where(np.arange(k) == i, firm, light))
        rig.driver.press(torque)
        rising = rig.wait(FOLLOWS)
        pressed = rig.wait(0.3)
        if pressed.fault:
            raise DriverError(f"press: {firm:.3g} N at {name} stopped the hand: {pressed.fault}")
        got = _inwards(rig, before, pressed) - was
        said = f"{name} was asked for {more:+.2g} N, and the tips feel {np.round(got, 2)} N more"
        if np.abs(got).max() < IGNORED * more:
            raise DriverError(f"press is ignored: {said}")
        if got[i] < -IGNORED * more:
            raise DriverError(f"press has the wrong sign: {said}")
        if got[i] < FOLLOWED * more or np.delete(got, i).max(initial=0.0) > FOLLOWED * more:
            raise DriverError(f"press turns the wrong joint: {said}")
        _must_read(rig, f"when {name} presses", torque, pressed.torque.mean(axis=0))
        _must_rise_slowly(rig, rising, i, torque)
        rig.driver.press(_torque(rig, q, np.full(k, light)))
        rig.wait(FOLLOWS)
    if rig.robot.arm:
        stood = np.abs(rig.wait(0.1).q[-1] - arm)[list(rig.robot.arm)]
        if stood.max() > NEAR:
            j = rig.robot.arm[int(stood.argmax())]
            raise DriverError(f"press: {rig.joint(j)} carries the palm, and moved")


def _must_rise_slowly(rig: Rig, rising: Readings, i: int, torque: np.ndarray) -> None:
    window = max(1, round(WINDOW * rig.driver.rate))
    fingers = list(rig.robot.flexion[i])
    steps = np.abs(rising.torque[window:] - rising.torque[:-window])[:, fingers].max()
    most = PRESS_RATE * (window + 1) / rig.driver.rate
    if steps > most + WINDOW_TOLERANCE * float(np.abs(torque).max()):
        raise DriverError(
            f"press is not slow: the torque of {rig._names[i]} changed by {steps:.2g} N·m within "
            f"{window / rig.driver.rate:.2g} s; {PRESS_RATE:g} N·m/s is the most"
        )


def pressing_ends(rig: Rig) -> None:
    """A stop, a move, and a caller that falls silent end what is pressed."""
    before, (light, firm), pressed = _pressed(rig, firmly=False)
    q, k = pressed.q.mean(axis=0), len(rig.normals)
    more = _torque(rig, q, np.full(k, firm))
    rig.driver.press(more)
    rig.driver.wait(0.25 * (1.0 - LIGHT) * float(np.abs(more).max()) / PRESS_RATE)
    rig.driver.stop()  # on the way: a stiff hand that stands may be as tight as it was
    rig.wait(FOLLOWS)
    left = _inwards(rig, before, rig.wait(0.3))
    if (left > light + FOLLOWED * (firm - light)).any():
        raise DriverError(
            f"press does not end at a stop: on its way from {light:.2g} to {firm:.2g} N, it went "
            f"on to {np.round(left, 2)} N"
        )
    before, _, pressed = _pressed(rig, firmly=True)
    was = _inwards(rig, before, pressed)
    rig.go(rig.open, 0.5)
    left = _inwards(rig, before, rig.wait(0.3))
    if (left > ENDED * was).any():
        raise DriverError(
            f"press does not end at a move: the tips pressed with {np.round(was, 2)} N, and do "
            f"with {np.round(left, 2)} N"
        )
    _pressed(rig, firmly=True)
    if not rig.driver.wait(rig.driver.limits.watchdog + 0.5).fault:
        raise DriverError(
            "press does not end at the watchdog: nobody called for longer than that, and "
            "Readings.fault says nothing"
        )


def pressing_on_nothing_stops(rig: Rig) -> None:
    """Fingers that are pressed open in free air stop the hand, and were not too fast."""
    rig.go(rig.free[0])
    closing = rig.robot.closing.sum(axis=0)
    share = np.where(closing != 0.0, np.abs(closing) / rig.driver.limits.torque, 0.0).max()
    rig.driver.press(-0.3 * closing / share)
    seen = rig.wait(NOTHING)
    fastest = np.abs(seen.velocity).max(axis=0) / rig.driver.limits.speed
    if fastest.max() > SPEED_TOLERANCE:
        j = int(fastest.argmax())
        raise DriverError(
            f"limits not held: {rig.joint(j)} pressed on nothing, and ran at {fastest[j]:.3g} of "
            "its speed limit"
        )
    if not seen.fault:
        raise DriverError("press: fingers pressed on nothing, and the hand did not stop itself")
    _must_stand(rig, rig.wait(0.5).q, "press: fingers pressed on nothing")


def carrying_keeps_what_is_pressed(rig: Rig) -> None:
    """The arm goes where it is carried, and the fingers press on, whatever is asked of them."""
    rig.go(rig.open)
    with suppress(InputError):
        rig.driver.carry(rig.open, 0.5)
        raise DriverError("carry: a hand that presses nothing was carried; it raises InputError")
    before, _, pressed = _pressed(rig, firmly=True)
    was, q = _inwards(rig, before, pressed), pressed.q.mean(axis=0)
    target, j = q.copy(), None
    target[_fingers(rig)] = rig.open[_fingers(rig)]
    if rig.robot.arm:  # the joint that moves the tips least, for the thing stands still
        J = rig.robot.jacobian(q).reshape(len(was), 3, -1)
        way = np.linalg.norm(J, axis=1).max(axis=0)
        j = min(rig.robot.arm, key=lambda joint: float(way[joint]))
        by = min(CARRIED / max(float(way[j]), 1e-3), TRAVEL)
        target[j] += by if target[j] + by <= rig.driver.limits.upper[j] else -by
    moved = rig.wait(rig.driver.carry(target, 0.5) + 0.3)
    rest = rig.wait(0.3)
    if rest.fault:
        raise DriverError(f"carry: the hand stopped itself: {rest.fault}")
    if (_inwards(rig, before, rest) < FOLLOWED * was).any():
        raise DriverError("carry drops what is pressed")
    if j is not None:
        asked, did = target[j] - q[j], float(moved.q[-1, j] - q[j])
        if did * asked < IGNORED * asked**2:  # what it holds stands still, and holds it back
            raise DriverError(
                f"carry does not move: {rig.joint(j)} was sent by {asked:+.3f} rad and reads "
                f"{did:+.3f}"
            )


def grip_forces_are_kept(rig: Rig) -> None:
    """However hard the fingers are told to press, the force stays below its limit."""
    limits = rig.driver.limits
    *_, pressed = _pressed(rig, firmly=True)
    torque = _torque(rig, pressed.q.mean(axis=0), np.ones(len(rig.normals)))
    room = np.abs(torque) / limits.torque
    seen = [pressed]
    for share in (1.0, 2.0):
        with suppress(InputError):  # a driver may refuse what is beyond its torque limit
            rig.driver.press(share * torque / room.max())
        seen.append(rig.wait(2.0))
    rig.driver.stop()
    rig.go(rig.open)
    _must_stay_below("pressing, a fingertip felt", seen, limits.grip)


# In the order in which they are safe to run: what holds the hand back comes before what needs it.
CHECKS: tuple[Callable[[Rig], None], ...] = (
    samples_come_at_the_stated_rate,
    joints_go_where_they_are_sent,
    stop_stops,
    the_watchdog_stops_the_hand,
    ranges_are_kept,
    speeds_are_kept,
    tips_weigh_what_they_weigh,
    closing_ends_at_a_touch,
    contact_forces_are_kept,
    torques_are_those_that_fingers_hold_with,
    pressing_is_followed_slowly,
    pressing_ends,
    pressing_on_nothing_stops,
    carrying_keeps_what_is_pressed,
    grip_forces_are_kept,
)


def _around(rig: Rig, q: np.ndarray, by: float) -> np.ndarray:
    """q with every joint moved by `by`, or by as much the other way where its range ends."""
    up = q + by <= rig.driver.limits.upper
    return q + np.where(up, by, -by)


def _must_stand(rig: Rig, q: np.ndarray, about: str) -> None:
    moved = q.max(axis=0) - q.min(axis=0)
    if moved.max() > STANDS:
        j = int(moved.argmax())
        raise DriverError(f"{about}: {rig.joint(j)} moved on by {moved[j]:.3f} rad")


def _until_touched(rig: Rig) -> Readings:
    """All readings until every finger has touched, or PATIENCE ends."""
    slices, left = [rig.wait(0.1)], PATIENCE
    while not slices[-1].touched.all() and not slices[-1].fault and left > 0.0:
        slices.append(rig.wait(0.1))
        left -= 0.1
    return _joined(slices)


def _joined(slices: list[Readings]) -> Readings:
    """One after the other, in one; flags are those of the end."""

    def series(name: str) -> np.ndarray:
        return np.concatenate([getattr(part, name) for part in slices])

    return replace(
        slices[-1],
        time=series("time"),
        q=series("q"),
        velocity=series("velocity"),
        torque=series("torque"),
        wrench=series("wrench"),
    )
