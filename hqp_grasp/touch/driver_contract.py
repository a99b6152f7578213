"""What every driver must do, as tests that its author runs on the hand itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from hqp_grasp.errors import HqpGraspError, InputError
from hqp_grasp.grasp import as_array
from hqp_grasp.touch.driver import Driver, Readings
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
    held = rig.wait(0.3)
    q = held.q.mean(axis=0)
    load, R_world_tip = payload(rig.robot), rig.robot.tip_frames(q).copy()
    pushed = held.wrench.mean(axis=0) - before.wrench.mean(axis=0)
    pushed -= weight(load, R_world_tip)
    pushed += weight(load, rig.robot.tip_frames(before.q.mean(axis=0)))
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
