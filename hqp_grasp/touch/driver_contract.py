"""What every driver must do, as tests that its author runs on the hand itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from hqp_grasp.errors import HqpGraspError, InputError, instance
from hqp_grasp.grasp import as_array
from hqp_grasp.touch.driver import PRESS_RATE, TOUCHING, Driver, Readings
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
CLOSING, SWIFT = 0.3, 0.9  # [rad/s]
CLOSING_TOLERANCE = 0.2  # share of the speed asked
MOVING, SLOWLY, END = 0.4, 2.0, 4.0  # [s] of a move of TRAVEL, and to the end of a range
BEYOND = 1.0  # [rad]
FEW = 0.1  # share of the samples due below which nothing else can be told
HEARD = 10  # samples in which a sensor says something
FRESH = 0.03  # [s] by which readings may be apart that are of one time
STARTS = 0.08  # [s] in which what was called for is begun, and read
SPEED_FITS = 0.15  # share of the way by which velocity may be off
TURNED = np.radians(9.0)  # a sensor in its frame
ACROSS = 0.05  # share of the weight's change in a second direction, that tells turns about it
POINT = 1.5e-3  # [m] from where a tip's weight hangs, as its model has it
PLAIN, TORQUE_NEGATED = np.ones(6), np.repeat([1.0, -1.0], 3)
TELLING = np.radians(5.0)  # by which normals fit better, on average
TORQUE_TOLERANCE = 0.2  # share of the largest torque
FIRM, LIGHT = 0.3, 0.3  # shares: of the grip limit, and of a firm press
HALF = 0.5  # share of a torque limit that a firm press needs, at most
FOLLOWS = 0.6  # [s] in which what is pressed is followed
FOLLOWED = 0.5  # share of what was asked for, at least
IGNORED = 0.2  # share of it that says nothing
ENDED = 0.5  # share of what was pressed that is left, at most
WINDOW = 0.05  # [s]
WINDOW_TOLERANCE = 0.15  # share of the torque
DRAGGED = 1e-3  # [m] of the tips
BALANCE = 0.3  # share of torques that are out of balance, at most
CARRIED = 2e-3  # [m] of the tips
NOTHING = 3.0  # [s] for a finger to notice that it presses on nothing
PATIENCE = 8.0  # [s] for fingers to touch
NORMAL_TOLERANCE = np.radians(13.0)  # measured normals are given to 10°
WEIGHT_TOLERANCE = 0.3  # share of the tip's weight
SURE = 4.0  # standard deviations of the mean by which noise may look like an error


class DriverError(HqpGraspError, AssertionError):
    """A driver does not do what its protocol says."""


@dataclass(frozen=True, eq=False)
class Rig:
    """A driver, ready to be tested.

    `free` are postures in free air, in which the tips point clearly different ways; around each,
    every joint may move by TRAVEL and fingers may open, and close one by one until they touch. From
    `open` every finger can close onto something that stands still, whose outward `normals` where
    they meet it are known to 10°.
    """

    driver: Driver
    robot: Robot
    free: np.ndarray  # (p, n) [rad], p ≥ 2
    open: np.ndarray  # (n,) [rad]
    normals: np.ndarray  # (k, 3) world
    _names: tuple[str, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        instance("Rig.robot", self.robot, Robot)
        if not any(hasattr(self.driver, call) for call in TOUCHING):
            raise InputError(f"Rig.driver must have the calls of a Driver; got {self.driver!r}")
        n, k = self.robot.n, len(self.robot.flexion)
        for name, shape in (("free", (None, n)), ("open", (n,)), ("normals", (k, 3))):
            array = as_array(f"Rig.{name}", getattr(self, name), shape)
            object.__setattr__(self, name, array)
        if len(self.free) < 2:
            raise InputError("Rig.free needs two postures at least")
        names = tuple(point.name for point in self.robot.description.contact_points)
        object.__setattr__(self, "_names", names)

    def call(self, name: str, *arguments: object) -> object:
        """What the driver's call returns; what it raises, but a refusal, is a fault of its own."""
        if not hasattr(self.driver, name):
            raise DriverError(f"a call is missing: the driver has no {name}")
        try:
            return getattr(self.driver, name)(*arguments)
        except HqpGraspError:
            raise
        except Exception as error:
            raise DriverError(f"{name} raises {type(error).__name__}: {error}") from error

    def move(self, q: np.ndarray, duration: float) -> float:
        """Start a move; return how long it takes [s]."""
        return self._takes("move", self.call("move", q, duration))

    def carry(self, q: np.ndarray, duration: float) -> float:
        """Start to carry; return how long it takes [s]."""
        return self._takes("carry", self.call("carry", q, duration))

    def close(self, force: float, speed: float = CLOSING) -> None:
        """Start closing every finger."""
        for i in range(len(self.normals)):
            self.call("close", i, speed, force)

    def _takes(self, name: str, said: object) -> float:
        try:
            seconds = float(said)  # type: ignore[arg-type]
        except (TypeError, ValueError):
            seconds = np.nan
        if not 0.0 <= seconds < np.inf:
            raise DriverError(f"{name} returns {said!r}; it returns how long it takes [s]")
        return seconds

    def go(self, q: np.ndarray, duration: float = 1.0) -> Readings:
        """Move there, calling the driver as often as its watchdog wants."""
        return self.wait(self.move(q, duration))

    def wait(self, duration: float) -> Readings:
        """Wait in slices; all readings in one."""
        slices: list[Readings] = []
        left = duration
        while left > 0.0 or not slices:
            slices.append(self.silent(min(left, 0.5 * self.driver.limits.watchdog)))
            left -= 0.5 * self.driver.limits.watchdog
        return _joined(slices)

    def silent(self, duration: float) -> Readings:
        """Wait in one call, and return its readings if they are all there."""
        n, k, rate = self.robot.n, len(self.normals), self.driver.rate
        read = self.call("wait", duration)
        if not isinstance(read, Readings):
            raise DriverError(f"wait returns {type(read).__name__}; it returns Readings")
        if read.q.shape[1] != n or read.wrench.shape[1] != k:
            raise DriverError(
                f"readings are of {read.q.shape[1]} joints and {read.wrench.shape[1]} tips; "
                f"the robot has {n} and {k}"
            )
        due, got = duration * rate, len(read.time)
        if got < FEW * due - 1.0:
            raise DriverError(_missing(duration, got, rate))
        for name in ("q", "velocity", "wrench"):
            told = np.isfinite(getattr(read, name)).any(axis=0)
            if got >= HEARD and not told.all():
                at = tuple(int(i) for i in np.argwhere(~told)[0])
                of = self._names[at[0]] if name == "wrench" else self.joint(at[0])
                raise DriverError(f"a sensor does not answer: readings of {name} of {of} are NaN")
        return read

    def joint(self, j: int) -> str:
        """Name of an independent joint."""
        return self.robot.joints[j]


def _missing(duration: float, got: int, rate: float) -> str:
    return (
        f"readings are missing: wait({duration:g}) returns {got} samples; at the stated {rate:g} "
        f"Hz, {duration * rate:.0f} were taken meanwhile"
    )


def check_driver(rig: Rig) -> None:
    """Run every check of CHECKS; raise DriverError with all that was found, first things first."""
    instance("rig", rig, Rig)
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
        raise DriverError("; ".join(dict.fromkeys(faults)))


def samples_come_at_the_stated_rate(rig: Rig) -> None:
    """`wait` returns all samples taken meanwhile, each 1/rate after the one before."""
    rig.go(rig.free[0])
    rate = rig.driver.rate
    waits = (0.4, 0.0, 0.1, 0.4)
    parts = [rig.silent(t) for t in waits]
    gaps = np.diff(np.concatenate([part.time for part in parts])) * rate
    if not gaps.min() > 0.0:
        raise DriverError("readings are stale: time stamps do not advance from sample to sample")
    if np.abs(gaps - 1.0).max() > RATE_TOLERANCE:
        raise DriverError(
            f"readings do not come at the stated {rate:g} Hz: samples are "
            f"{gaps.min() / rate:g} to {gaps.max() / rate:g} s apart"
        )
    for duration, part in zip(waits, parts, strict=True):
        if abs(len(part.time) - duration * rate) > RATE_TOLERANCE * duration * rate + 1.0:
            raise DriverError(_missing(duration, len(part.time), rate))
    _must_be_well(parts[-1], "stood in free air")


def _must_be_well(readings: Readings, after: str) -> None:
    if readings.fault:
        raise DriverError(f"the hand {after}, and Readings.fault says: {readings.fault}")


def joints_go_where_they_are_sent(rig: Rig) -> None:
    """Each joint moves when it is sent, alone; readings of angle and speed are of that time."""
    first = rig.wait(0.1).q[-1]
    seen = rig.go(rig.free[0])
    later = rig.wait(0.5)
    _must_have_arrived(rig, int(np.abs(seen.q[-1] - later.q[-1]).argmax()), seen, later)
    off = np.abs(later.q[-1] - rig.free[0])
    if off.max() > 2.0 * NEAR:
        j = int(off.argmax())
        stale = "readings are stale, or " if (later.q == first).all() else ""
        raise DriverError(
            f"{stale}a joint does not arrive: {rig.joint(j)} was sent to {rig.free[0][j]:.3f} rad, "
            f"and reads {later.q[-1, j]:.3f}; its angle is in rad, from the model's zero, with its "
            "sign"
        )
    for j in map(int, np.flatnonzero(~rig.robot.idle)):
        target = rig.free[0].copy()
        target[j] = _around(rig, target, TRAVEL)[j]
        before = rig.wait(0.1)
        seen = rig.go(target, MOVING)
        later = rig.wait(0.5)
        _must_arrive(rig, before.q[-1], target, seen, later)
        _must_fit(rig, int(j), _joined([before, seen, later]))
        rig.go(rig.free[0], MOVING)


def _must_arrive(
    rig: Rig, before: np.ndarray, target: np.ndarray, seen: Readings, later: Readings
) -> None:
    """Raise where a joint is not at its target, or one that was not sent has moved."""
    arrived, end = seen.q[-1], later.q[-1]
    sent = np.abs(target - before) > 0.4 * TRAVEL
    off = np.abs(arrived - np.where(sent, target, before))
    if not off.max() >= NEAR:
        return
    stays = np.flatnonzero(~sent & (off > 0.5 * TRAVEL))
    missing = np.flatnonzero(sent & (np.abs(end - target) >= NEAR))
    if len(stays) and len(missing):
        j = int(missing[0])
        raise DriverError(
            f"joints are exchanged: {rig.joint(j)} was sent by {target[j] - before[j]:+.3f} rad, "
            f"and {rig.joint(int(stays[0]))} moved"
        )
    j = int(np.where(sent, off, 0.0).argmax())
    if off[j] < NEAR:
        j = int(off.argmax())
        raise DriverError(
            f"a joint moves unasked: {rig.joint(j)} moved by {arrived[j] - before[j]:+.3f} rad "
            f"when {rig.joint(int(np.flatnonzero(sent)[0]))} was sent"
        )
    asked = target[j] - before[j]
    did = f"{rig.joint(j)} was sent by {asked:+.3f} rad and reads {arrived[j] - before[j]:+.3f}"
    if abs(end[j] - before[j]) < 1e-9:
        raise DriverError(f"readings are stale: {did}, unchanged to the last bit")
    _must_have_arrived(rig, j, seen, later)
    if (end[j] - before[j]) * asked < 0.0:
        raise DriverError(f"wrong sign of a joint: {did}")
    raise DriverError(f"a joint does not arrive: {did}")


def _must_have_arrived(rig: Rig, j: int, seen: Readings, later: Readings) -> None:
    """Raise where joint j goes on after the time that a move was said to take."""
    on = float(later.q[-1, j] - seen.q[-1, j])
    if abs(on) < NEAR:
        return
    said = f"after the {len(seen.time) / rig.driver.rate:.2g} s that move returned, "
    if np.abs(np.nansum(later.velocity[:, j])) / rig.driver.rate > 0.5 * abs(on):
        raise DriverError(
            f"move takes longer than it says, or all readings are stale: {said}{rig.joint(j)} goes "
            f"on by {on:+.3f} rad"
        )
    raise DriverError(f"readings are stale: {said}{rig.joint(j)} reads {on:+.3f} rad more later")


def _must_fit(rig: Rig, j: int, seen: Readings) -> None:
    """Raise where joint j's speed is not how its angle changes."""
    dt = 1.0 / rig.driver.rate
    change = np.diff(seen.q[:, j])
    speed = 0.5 * (seen.velocity[1:, j] + seen.velocity[:-1, j]) * dt
    went, told = float(seen.q[-1, j] - seen.q[0, j]), float(np.nansum(speed))
    if not abs(told - went) < SPEED_FITS * abs(went):
        raise DriverError(
            f"readings of velocity are wrong: {rig.joint(j)} turned by {went:+.3f} rad, and its "
            f"velocity says {told:+.3f}"
        )
    late = _centroid(np.cumsum(speed), dt) - _centroid(np.cumsum(change), dt)
    if abs(late) > FRESH:
        raise DriverError(
            f"readings are stale: {rig.joint(j)}'s velocity is {late:+.3f} s behind its angle"
        )
    other = np.abs(np.nansum(seen.velocity, axis=0) * dt)
    other[j] = 0.0
    if other.max() > 0.5 * abs(went):
        raise DriverError(
            f"readings of velocity are wrong: {rig.joint(j)} moved, and "
            f"{rig.joint(int(other.argmax()))}'s velocity says that it did"
        )


def _centroid(x: np.ndarray, dt: float) -> float:
    """When (t,) `x` went from its first value to its last, on average [s]."""
    return float(np.nanmean((x[-1] - x) / (x[-1] - x[0])) * len(x) * dt)


def moves_take_the_time_they_say(rig: Rig) -> None:
    """A move takes what was asked, or longer by a limit; it says so, starts at once, and rests."""
    for joints in (_fingers(rig), list(np.flatnonzero(~rig.robot.idle))):
        rig.go(rig.free[0])
        before = rig.wait(0.2).q[-1]
        target = rig.free[0].copy()
        target[joints] = _around(rig, target, TRAVEL)[joints]
        said = rig.move(target, SLOWLY)
        if said < (1.0 - RATE_TOLERANCE) * SLOWLY:
            raise DriverError(
                f"move ignores its duration: it returns {said:g} s where {SLOWLY:g} s were asked"
            )
        fast = rig.driver.limits.speed[joints].min() < 2.0 * TRAVEL / SLOWLY
        if joints == _fingers(rig) and not fast and said > (1.0 + RATE_TOLERANCE) * SLOWLY:
            raise DriverError(
                f"move ignores its duration: it returns {said:g} s where {SLOWLY:g} s were asked, "
                "and no limit is in the way"
            )
        moved, rest = rig.wait(said), rig.wait(0.5)
        _must_be_well(rest, "moved in free air")
        _must_arrive(rig, before, target, moved, rest)
        share = (moved.q[:, joints] - before[joints]) / (target - before)[joints]
        middle = share.mean(axis=1)
        half = float(np.argmax(middle > 0.5)) / len(middle)
        if not 0.2 < half < 0.8:
            raise DriverError(
                f"move ignores its duration: half of the way is done after {half * said:.2g} s of "
                f"the {said:.2g} s that it returned"
            )
        _must_stand(rig, rest.q, "a move does not end at rest")


def stop_stops(rig: Rig) -> None:
    """After a stop in full motion every joint stands where it was."""
    rig.go(rig.free[0])
    target = _around(rig, rig.free[0], TRAVEL)
    rig.move(target, SLOWLY)
    moving = rig.wait(0.4 * SLOWLY)
    rig.call("stop")
    rig.wait(BRAKING)
    standing = rig.wait(1.5)
    _must_stand(rig, standing.q, "stop is ignored")
    jumped = np.abs(standing.q[-1] - moving.q[-1])
    if jumped.max() > 0.5 * TRAVEL:
        j = int(jumped.argmax())
        raise DriverError(
            f"stop is not where the joints are: {rig.joint(j)} went on by {jumped[j]:.3f} rad"
        )


def the_watchdog_stops_the_hand(rig: Rig) -> None:
    """A caller that falls silent for longer than the watchdog, and only then, ends a move."""
    rig.go(rig.free[0])
    watchdog = rig.driver.limits.watchdog
    rig.move(_around(rig, rig.free[0], TRAVEL), 3.0 * watchdog + 1.0)
    _must_be_well(
        rig.silent(0.8 * watchdog), f"was left alone for 0.8 of its watchdog of {watchdog:g} s"
    )
    silent = rig.silent(3.0 * watchdog + 0.5)  # one call: no slices here
    _must_end(rig, silent, "stop the hand")
    _must_be_well(rig.go(rig.free[0]), "was moved again after its watchdog")


def _must_end(rig: Rig, silent: Readings, what: str) -> None:
    """Raise unless the watchdog ended what went on at the beginning of `silent`."""
    watchdog = rig.driver.limits.watchdog
    standing = round((2.0 * watchdog + 0.5 - BRAKING) * rig.driver.rate)
    about = f"limits not held: the watchdog of {watchdog:g} s does not {what}"
    _must_stand(rig, silent.q[-standing:], about)
    if not silent.fault:
        raise DriverError(
            f"the watchdog of {watchdog:g} s does not {what}, or Readings.fault does not say so"
        )


def ranges_are_kept(rig: Rig) -> None:
    """Joints that are sent beyond either end of their range go as if they were sent to it."""
    limits = rig.driver.limits
    driven = ~rig.robot.idle
    for upper in (False, True):
        end, way = (limits.upper, 1.0) if upper else (limits.lower, -1.0)
        for j in map(int, np.flatnonzero(driven)):
            rig.go(rig.free[0])
            far = abs(end[j] - rig.free[0][j])
            takes = []
            for beyond in (0.0, BEYOND):
                target = rig.free[0].copy()
                target[j] = end[j] + way * beyond
                takes.append(rig.move(target, 1e-3))
                rig.call("stop")
            if far > NEAR and (takes[1] / takes[0] - 1.0) * far > 2.0 * NEAR:
                raise DriverError(
                    f"limits not held: {rig.joint(j)} sent {BEYOND:g} rad beyond its range "
                    f"takes {takes[1]:.3g} s, and {takes[0]:.3g} s to its end"
                )
        _must_be_clipped(rig, np.where(driven, end, rig.free[0]), way * driven)
    q = rig.free[0].copy()
    rig.go(q)
    flexion = [j for joints in rig.robot.flexion for j in joints]
    opening = rig.robot.opened(q, 1.0)
    q[flexion] = (opening - BEYOND * np.sign(rig.robot.closing.sum(axis=0)))[flexion]
    _must_be_inside(rig, [rig.go(q), rig.wait(0.5)])
    for i in range(len(rig.normals)):
        rig.go(rig.free[0])
        rig.call("close", i, SWIFT, TOUCH)
        seen = [rig.wait(0.1)]
        for _ in range(int(10.0 * PATIENCE)):
            seen.append(rig.wait(0.1))
            way = np.abs(seen[-1].q[-1] - seen[-2].q[-1])
            if seen[-1].touched.any() or seen[-1].stalled.any() or way.max() < STANDS:
                break
        rig.call("stop")
        _must_be_inside(rig, seen)
    rig.go(rig.free[0])


def _must_be_clipped(rig: Rig, end: np.ndarray, way: np.ndarray) -> None:
    """Raise where joints sent beyond `end` start faster than joints sent to it."""
    began = []
    for beyond in (0.0, 3.0 * BEYOND):
        rig.go(rig.free[0])
        start = rig.wait(0.1).q[-1]
        rig.move(end + way * beyond, END)
        parts = [start]
        while len(parts) < END * rig.driver.rate:
            parts.append(rig.wait(1.0 / rig.driver.rate).q[-1])
            if np.abs(parts[-1] - start).max() > 0.5 * TRAVEL:
                break
        rig.call("stop")
        began.append(np.abs(np.array(parts) - start))
    at = min(len(began[0]), len(began[1])) - 1
    more = began[1][at] - began[0][at]
    if more.max() > STANDS + 0.25 * began[0][at].max():
        j = int(more.argmax())
        raise DriverError(
            f"limits not held: {rig.joint(j)} sent beyond its range goes faster than to its end"
        )


def _must_be_inside(rig: Rig, seen: Sequence[Readings]) -> None:
    limits, q = rig.driver.limits, np.concatenate([part.q for part in seen])
    outside = np.maximum(limits.lower - q, q - limits.upper).max(axis=0)
    if outside.max() > NEAR:
        j = int(outside.argmax())
        raise DriverError(
            f"limits not held: {rig.joint(j)} went {outside[j]:.3f} rad beyond its range"
        )


def speeds_are_kept(rig: Rig) -> None:
    """However soon a posture is asked for, no joint moves faster than its limit."""
    rig.go(rig.free[0])
    target = _around(rig, rig.free[0], TRAVEL)
    seen = [rig.wait(rig.move(q, 1e-3) + 0.2) for q in (target, rig.free[0])]
    rig.go(rig.open)
    rig.close(TOUCH, 1e3)
    seen.append(_until_touched(rig))
    rig.go(rig.open)
    for readings in seen:
        between = np.abs(np.diff(readings.q, axis=0)).max(axis=0) * rig.driver.rate
        fastest = np.maximum(np.abs(readings.velocity).max(axis=0), between)
        share = fastest / rig.driver.limits.speed
        if share.max() > SPEED_TOLERANCE:
            j = int(share.argmax())
            raise DriverError(
                f"limits not held: {rig.joint(j)} moved at {fastest[j]:.3g} rad/s, "
                f"its limit is {rig.driver.limits.speed[j]:.3g}"
            )


def tips_weigh_what_they_weigh(rig: Rig) -> None:
    """As a tip turns, the wrench changes by its weight: size, sign, frame, point, finger."""
    load = payload(rig.robot)
    felt, due, unsure = [], [], np.zeros(6)
    for q in (*rig.free, rig.open):
        rig.go(q)
        rig.wait(0.3)
        readings = rig.wait(1.0)
        felt.append(_mean(readings.wrench))
        due.append(weight(load, rig.robot.tip_frames(_mean(readings.q))))
        spread = np.nanstd(readings.wrench, axis=0).max(axis=0)
        unsure = np.maximum(unsure, SURE * spread / np.sqrt(len(readings.time)))
    noise, turning = float(np.linalg.norm(unsure[:3])), float(np.linalg.norm(unsure[3:]))
    change, wanted = np.array(felt) - np.mean(felt, axis=0), np.array(due) - np.mean(due, axis=0)
    k = len(rig._names)
    fits = np.array(
        [[np.linalg.norm(change[:, i, :3] - wanted[:, j, :3]) for j in range(k)] for i in range(k)]
    )
    for i, name in enumerate(rig._names):
        f, w, m = change[:, i, :3], wanted[:, i, :3], change[:, i, 3:]
        size = float(np.linalg.norm(w))
        if size < 2.0 * noise:
            continue  # lost in noise: what touches tells signs and frames
        allowed = noise / size
        for j in range(k):
            both = max(fits[i, j], fits[j, i])
            if j != i and both < 0.1 * size + noise and fits[i, i] > 3.0 * both + noise:
                raise DriverError(
                    f"wrenches are exchanged: {name} weighs what {rig._names[j]} does, as they turn"
                )
        across = float(np.linalg.svd(w, compute_uv=False)[1])  # what tells turns about the rest
        U, _, Vt = np.linalg.svd(w.T @ f)
        R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
        angle = float(np.arccos(np.clip((np.trace(R) - 1.0) / 2.0, -1.0, 1.0)))
        share, scale = float((f * w).sum()) / size**2, float(np.linalg.norm(f)) / size
        rest = float(np.linalg.norm(f - w)) / size
        if share < 0.0 and np.linalg.norm(f + w) < (WEIGHT_TOLERANCE + allowed) * size:
            raise DriverError(
                f"wrong sign: {name} weighs {share:.2f} of its weight; the wrench is the one "
                "that the world applies to the tip"
            )
        if scale < 0.2:
            raise DriverError(
                f"wrong frame, or a dead sensor: as {name} turns, it weighs {scale:.2f} of its "
                "weight in the tip's own frame"
            )
        if abs(scale - 1.0) > WEIGHT_TOLERANCE + allowed:
            raise DriverError(
                f"wrong size: {name} weighs {scale:.2f} of its weight as it turns; forces are in N"
            )
        axes = (f * w).sum(axis=0) / np.maximum((w * w).sum(axis=0), 1e-12)
        by_axis, by_turn = np.linalg.norm(f - axes * w), np.linalg.norm(f - w @ R)
        turns = by_turn < by_axis and angle < 0.5 * np.pi
        if rest > TURNED + allowed and not turns and by_axis < 0.2 * rest * size:
            raise DriverError(
                f"wrong size, or sign, of an axis: as {name} turns, its x, y and z weigh "
                f"{np.round(axes, 2)} of what they should"
            )
        told = angle if across > ACROSS * size else min(angle, rest)
        if told > TURNED + (noise / across if across > ACROSS * size else allowed):
            raise DriverError(
                f"wrong frame: as {name} turns, its weight is {np.degrees(angle):.0f}° off where "
                f"it points ({share:.2f} of it turns as it should); the wrench is in the tip's own "
                "frame"
            )
        if rest > WEIGHT_TOLERANCE + allowed:
            raise DriverError(
                f"wrong frame: as {name} turns, {rest:.2f} of its weight is felt where it is not"
            )
        m = m - np.cross(load[1][i], f)
        A = np.concatenate([-_cross_matrix(row) for row in f])
        off = np.linalg.lstsq(A, m.ravel(), rcond=1e-3)[0]
        if np.linalg.norm(off) > POINT + turning / size:
            raise DriverError(
                f"wrong point: the weight of {name} acts {1e3 * np.linalg.norm(off):.1f} mm off "
                "where it hangs; the torque is about the tip's centre"
            )


def _cross_matrix(v: np.ndarray) -> np.ndarray:
    """[v]×, for which [v]× x = v × x."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _mean(samples: np.ndarray) -> np.ndarray:
    """Mean over time, of what sensors told."""
    return np.asarray(np.nanmean(samples, axis=0))


def fingers_close_one_by_one(rig: Rig) -> None:
    """`close` closes its finger alone, at its speed, to its force; it feels and says so."""
    k, rate = len(rig.normals), rig.driver.rate
    for i, name in enumerate(rig._names):
        rig.go(rig.open)
        rig.wait(0.3)
        before = rig.wait(0.3)
        force = min((1.0 + 0.5 * (i % 2)) * PRESS, rig.driver.limits.hold)
        speed = CLOSING / (1.0 + 0.5 * (i % 2))
        rig.call("close", i, speed, force)
        parts: list[Readings] = []
        while len(parts) < PATIENCE * rate and not (parts and parts[-1].touched.any()):
            parts.append(rig.silent(1.0 / rate))
            if parts[-1].fault:
                break
        seen = _joined(parts)
        _must_close_alone(rig, i, force, before, seen)
        _must_close_at(rig, i, speed, seen)
        later = rig.wait(1.0)
        _must_feel_alone(rig, i, force, before, seen, later)
        held = rig.wait(0.3)
        _must_be_well(held, f"closed {name} onto a thing")
        _must_hold(rig, "close", i, force, before, held)
        more = min(2.0 * force, rig.driver.limits.hold)
        rig.call("hold", more)
        rig.wait(1.0)
        again = rig.wait(0.3)
        _must_hold(rig, "hold", i, more, before, again)
        others = [j for w in np.delete(rig.robot.closing, i, axis=0) for j in np.flatnonzero(w)]
        moved = np.abs(again.q[-1] - held.q[-1])
        if moved[others].max(initial=0.0) > NEAR or again.touched.sum() != 1:
            raise DriverError(f"hold moves fingers that have not touched: only {name} had")
        if again.stalled[i] or k != len(again.touched):
            raise DriverError(f"flags are wrong: {name} touched, and is said to have stalled")


def _must_close_alone(rig: Rig, i: int, force: float, before: Readings, seen: Readings) -> None:
    closing, name = rig.robot.closing, rig._names[i]
    went = np.array([(seen.q - before.q[-1]) @ w / (w @ w) for w in closing]).T
    far = np.abs(went).max(axis=0)
    others = np.flatnonzero((far > 2.0 * NEAR) & (np.arange(len(far)) != i))
    if len(others):
        which = ", ".join(rig._names[j] for j in others)
        alone = "with it" if far[i] > 2.0 * NEAR else "in its place"
        raise DriverError(f"close closes the wrong finger: {name} was told, {which} moved {alone}")
    touched = seen.touched
    if seen.fault:
        raise DriverError(f"close: {name} was closed, and the hand stopped itself: {seen.fault}")
    if far[i] < 2.0 * NEAR and touched.any() and len(seen.time) < 0.1 * rig.driver.rate:
        raise DriverError(f"flags are wrong: {name} is said to have touched before it moved")
    if went[-1, i] < -2.0 * NEAR:
        raise DriverError(f"close opens: {name} went by {went[-1, i]:+.3f} of its closing")
    for j, other in enumerate(rig._names):
        if j != i and touched[j]:
            raise DriverError(
                f"flags are exchanged: {name} was closed, and {other} is said to have touched"
            )
    if not touched[i]:
        felt = np.linalg.norm(seen.wrench[..., :3] - _mean(before.wrench)[:, :3], axis=2).max(
            axis=0
        )
        raise DriverError(
            f"close does not end at a touch: {name} was to end at {force:g} N, did not, and felt "
            f"{felt[i]:.2g} N"
        )


def _must_close_at(rig: Rig, i: int, speed: float, seen: Readings) -> None:
    """Raise unless finger i started at once, and closed at that speed [rad/s]."""
    rate, joints = rig.driver.rate, np.flatnonzero(rig.robot.closing[i])
    way = np.abs(seen.q[:, joints] - seen.q[0, joints])
    j = int(np.argmax(way[-1]))
    way = way[:, j]
    last = len(way) - max(2, round(0.05 * rate))  # the touch itself brakes
    first = int(np.argmax(way > NEAR))
    if last - first < 0.1 * rate:
        return
    started = (first + 1) / rate - NEAR / speed
    took = (last - first) / rate
    fast = float(way[last] - way[first]) / took
    if abs(fast / speed - 1.0) > CLOSING_TOLERANCE:
        raise DriverError(
            f"close ignores its speed: {speed:g} rad/s was asked for, and {rig._names[i]} closed "
            f"at {fast:.2g}"
        )
    if started > STARTS:
        raise DriverError(
            f"readings are stale: {rig._names[i]} was told to close, and reads so {started:.2f} s "
            "later"
        )


def _must_feel_alone(
    rig: Rig, i: int, force: float, before: Readings, seen: Readings, later: Readings
) -> None:
    """Raise unless finger i, and no other, feels when it is said to have touched."""
    rate, base, name = rig.driver.rate, _mean(before.wrench)[:, :3], rig._names[i]
    upto = _joined([seen, later])
    felt = np.linalg.norm(upto.wrench[..., :3] - base, axis=-1)
    at = len(seen.time) - 1
    settled = np.median(felt[at + round(0.5 * rate) :], axis=0)
    for j, other in enumerate(rig._names):
        if j != i and settled[j] > 0.5 * force:
            also = "exchanged" if settled[i] < 0.5 * settled[j] else "mixed"
            raise DriverError(f"wrenches are {also}: {name} touches alone, and {other} feels it")
    first = int(np.argmax(felt[:, i] > 0.5 * min(force, settled[i])))
    late = (first - at) / rate
    if late > FRESH:
        raise DriverError(
            f"readings of the wrench are stale: {name} is said to have touched, and feels it "
            f"{late:.2f} s later"
        )


def _must_hold(rig: Rig, call: str, i: int, force: float, before: Readings, held: Readings) -> None:
    """Raise unless finger i reads `force` [N], as its motors do."""
    f = _pushed(rig, before, held)[i, :3]
    size, name, q = float(np.linalg.norm(f)), rig._names[i], _mean(held.q)
    off = abs(size - force)
    if off <= PRESS_TOLERANCE * force:
        return
    R = rig.robot.tip_frames(q)[i]
    J = rig.robot.link_jacobian(q, i, _places(rig, q)[i])
    joints = np.flatnonzero(rig.robot.closing[i])
    due = -(J.T @ (R @ f))[joints] / size  # by 1 N
    motors = held.torque.mean(axis=0)[joints] @ due / (due @ due)
    said = f"{call}: {name} was asked for {force:g} N and reads {size:.3g} N"
    if abs(motors - force) < PRESS_TOLERANCE * force:
        raise DriverError(f"wrong size of the wrench: {said}; its motors hold {motors:.2g} N")
    raise DriverError(f"{said}; its motors hold {motors:.2g} N")


def closing_ends_at_a_touch(rig: Rig) -> None:
    """Every finger finds the thing, and feels it push the way it lies."""
    before, held = _held(rig)
    R_world_tip = rig.robot.tip_frames(_mean(held.q)).copy()
    pushed = _pushed(rig, before, held)
    off: list[float] = []
    better: list[float] = []
    for i, (name, R) in enumerate(zip(rig._names, R_world_tip, strict=True)):
        _must_hold(rig, "hold", i, PRESS, before, held)
        f = R @ pushed[i, :3]
        size = float(np.linalg.norm(f))
        if float(f @ rig.normals[i]) < -0.5 * size:
            raise DriverError(
                f"wrong sign: the thing seems to pull at {name}; the wrench is the one that the "
                "world applies to the tip"
            )
        plain, negated = [_off(rig, i, R, pushed[i] * s) for s in (PLAIN, TORQUE_NEGATED)]
        off.append(plain)
        better.append(plain - negated)
    if np.mean(better) > TELLING:
        raise DriverError(
            "wrong sign of the torque: negated, the normals felt fit the thing's better, by "
            f"{np.degrees(np.mean(better)):.0f}°"
        )
    if max(off) > NORMAL_TOLERANCE:
        raise DriverError(
            f"wrong frame, or torque: {rig._names[int(np.argmax(off))]} feels a normal "
            f"{np.degrees(max(off)):.0f}° off the thing's; force and torque are about the tip's "
            "centre, in the tip's frame"
        )


def _off(rig: Rig, i: int, R: np.ndarray, pushed: np.ndarray) -> float:
    """Angle [rad] between the normal that tip i feels and the thing's."""
    try:
        normal = R @ sense(pushed, float(rig.robot.tip_radius[i]))[1]
    except InputError:  # no push on the tip explains the wrench
        return np.pi
    return float(np.arccos(np.clip(normal @ rig.normals[i], -1.0, 1.0)))


def _held(rig: Rig, force: float = PRESS) -> tuple[Readings, Readings]:
    """Readings of open fingers, and of when all of them hold `force` [N]."""
    rig.go(rig.open)
    rig.wait(0.3)
    before = rig.wait(0.3)
    rig.close(TOUCH)
    closed = _until_touched(rig)
    if not closed.touched.all():
        names = [n for n, t in zip(rig._names, closed.touched, strict=True) if not t]
        raise DriverError(f"close does not end at a touch: {', '.join(names)} did not")
    rig.call("hold", force)
    rig.wait(1.0)
    return before, rig.wait(0.3)


def _pushed(rig: Rig, before: Readings, now: Readings) -> np.ndarray:
    """The mean wrench (k, 6) beside the tips' own weight, each in its tip's frame."""
    load, robot = payload(rig.robot), rig.robot
    pushed = _mean(now.wrench) - _mean(before.wrench)
    pushed -= weight(load, robot.tip_frames(_mean(now.q)))
    return np.asarray(pushed + weight(load, robot.tip_frames(_mean(before.q))))


def closing_and_holding_end(rig: Rig) -> None:
    """A stop, a move, and a caller that falls silent end closing and holding, of every finger."""
    watchdog = rig.driver.limits.watchdog
    rig.go(rig.open)  # what was touched is left first
    rig.go(rig.free[0])
    rig.close(TOUCH, TRAVEL / (3.0 * watchdog + 0.5))
    _must_end(rig, rig.silent(3.0 * watchdog + 0.5), "end closing")
    rig.go(rig.free[0])
    rig.close(TOUCH, 0.5 * CLOSING)
    rig.wait(0.3)
    rig.call("stop")
    rig.wait(BRAKING)
    _must_stand(rig, rig.wait(0.5).q, "stop does not end closing")
    rig.close(TOUCH, 0.5 * CLOSING)
    rig.wait(0.1)
    rig.go(rig.free[0])
    _must_rest(rig, rig.free[0], "move does not end closing")
    for i in range(len(rig.normals)):  # what a move only hid goes on with the next call
        start = rig.wait(0.1).q[-1]
        rig.call("close", i, 0.5 * CLOSING, TOUCH)
        went = np.abs(rig.wait(0.3).q[-1] - start)
        went[rig.robot.closing[i] != 0.0] = 0.0
        if went.max() > NEAR:
            raise DriverError(
                f"move does not end closing: {rig.joint(int(went.argmax()))} went on when "
                f"{rig._names[i]} was closed after it"
            )
        rig.go(rig.free[0])
    for ends in ("stop", "move", "the watchdog"):
        before, held = _held(rig)
        was = np.linalg.norm(_pushed(rig, before, held)[:, :3], axis=1)
        if ends == "stop":
            rig.call("stop")
        elif ends == "move":
            rig.go(np.clip(held.q[-1], rig.driver.limits.lower, rig.driver.limits.upper), 0.1)
        else:
            silent = rig.silent(watchdog + 0.5)
            if not silent.fault:
                raise DriverError(
                    f"the watchdog of {watchdog:g} s does not end holding, or Readings.fault does "
                    "not say so"
                )
        with suppress(InputError):  # nothing is held: a driver may refuse
            rig.call("hold", min(3.0 * PRESS, rig.driver.limits.hold))
        rig.wait(1.0)
        now = rig.wait(0.3)
        left = np.linalg.norm(_pushed(rig, before, now)[:, :3], axis=1)
        more = left - np.maximum(was, PRESS)
        if more.max() > 0.5 * PRESS:
            raise DriverError(
                f"{ends} does not end holding: {rig._names[int(more.argmax())]} goes on, and was "
                f"told to hold more after it"
            )
        rig.go(rig.open)
        _must_rest(rig, rig.open, "move does not end holding")


def _must_rest(rig: Rig, q: np.ndarray, about: str) -> None:
    """Raise unless the hand is well, at q, where it stands."""
    rest = rig.wait(0.5)
    _must_be_well(rest, "was moved away")
    off = np.abs(rest.q - q).max(axis=0)
    if off.max() > 2.0 * NEAR:
        j = int(off.argmax())
        raise DriverError(f"{about}: {rig.joint(j)} is {off[j]:.3f} rad beside where it was sent")
    _must_stand(rig, rest.q, about)
    if rest.touched.any():
        name = rig._names[int(rest.touched.argmax())]
        raise DriverError(f"{about}: {name} is still said to have touched")


def what_is_too_much_is_refused(rig: Rig) -> None:
    """What may not be asked raises InputError, and nothing moves."""
    rig.go(rig.open)  # what was touched is left first
    rig.go(rig.free[0])
    rig.wait(0.3)
    limits, zeros = rig.driver.limits, np.zeros(rig.robot.n)
    asked: list[tuple[str, str, tuple[object, ...]]] = [
        ("hold", f"holding more than {limits.hold:g} N", (1.1 * limits.hold,)),
        ("close", f"closing with more than {limits.hold:g} N", (0, CLOSING, 1.1 * limits.hold)),
    ]
    if limits.grip > 0.0:
        asked.append(("carry", "carrying while nothing is pressed", (rig.free[0], 0.5)))
        for j in _fingers(rig):
            torque = zeros.copy()
            torque[j] = 1.1 * limits.torque[j]
            what = f"pressing with {torque[j]:.3g} N·m of {limits.torque[j]:.3g} at {rig.joint(j)}"
            asked.append(("press", what, (torque,)))
        for j in rig.robot.arm:
            torque = zeros.copy()
            torque[j] = 0.1 * limits.torque[j]
            asked.append(("press", f"pressing with {rig.joint(j)}, which carries", (torque,)))
    for call, what, arguments in asked:
        try:
            rig.call(call, *arguments)
        except InputError:
            continue
        rig.call("stop")
        raise DriverError(f"{call}: {what} is not refused by InputError")
    stood = rig.wait(0.5)
    _must_stand(rig, stood.q, "what was refused moves the hand")
    _must_be_well(stood, "refused what was too much")


def contact_forces_are_kept(rig: Rig) -> None:
    """What may be held is held; whatever more is asked for, the force stays below its limit."""
    limits = rig.driver.limits
    rig.go(rig.open)
    rig.wait(0.3)
    before = rig.wait(0.3).wrench[..., :3].mean(axis=0)
    rig.close(TOUCH)
    seen = [_until_touched(rig)]
    rig.call("hold", limits.hold)
    seen += [rig.wait(0.5 + 0.5 * limits.hold), rig.wait(0.3)]
    held = np.linalg.norm(seen[-1].wrench[..., :3].mean(axis=0) - before, axis=-1)
    with suppress(InputError):  # a driver may refuse
        rig.call("hold", 1e3 * limits.force)
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
    """The motors' torques are in balance with what the tips feel, finger by finger, in time."""
    before, held = _held(rig)
    _must_balance(rig, "holding", before, held)
    rig.call("hold", rig.driver.limits.hold)
    rising = rig.wait(0.5 + 0.3 * rig.driver.limits.hold)
    after = rig.wait(0.5)
    _must_balance(rig, "holding", before, after)
    whole, dt, q = _joined([held, rising, after]), 1.0 / rig.driver.rate, _mean(after.q)
    frames, places = rig.robot.tip_frames(q).copy(), _places(rig, q)
    for i, name in enumerate(rig._names):
        way = rig.robot.closing[i] @ rig.robot.link_jacobian(q, i, places[i]).T @ frames[i]
        due = -whole.wrench[:, i, :3] @ way
        read = whole.torque @ rig.robot.closing[i]
        late = round((_rise(due, dt) - _rise(read, dt)) / dt)
        shifted = np.roll(read, late)[abs(late) : len(read) - abs(late)]
        fits = due[abs(late) : len(due) - abs(late)] - shifted
        apart = float(np.std(fits)) < 0.5 * float(np.std(due - read))
        if apart and abs(late) * dt > FRESH:
            which = "the wrench is" if late > 0 else "the motors' torque is"
            raise DriverError(
                f"readings are stale: of {name}, {which} {abs(late) * dt:.2f} s behind the other"
            )


def _rise(x: np.ndarray, dt: float) -> float:
    """When (t,) `x` went from how it begins to how it ends, on average [s]."""
    n = max(1, round(0.2 / dt))
    first, last = np.nanmean(x[:n]), np.nanmean(x[-n:])
    return float(np.nansum((last - x) / (last - first)) * dt)


def _must_balance(rig: Rig, what: str, before: Readings, now: Readings) -> None:
    q = _mean(now.q)
    felt = _pushed(rig, before, now)
    frames, places = rig.robot.tip_frames(q).copy(), _places(rig, q)
    due = np.zeros(rig.robot.n)
    for i, R in enumerate(frames):
        due -= rig.robot.link_jacobian(q, i, places[i]).T @ (R @ felt[i, :3])
    read = now.torque.mean(axis=0) - before.torque.mean(axis=0)
    _must_read(rig, what, due, read)


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
    rig.call("press", force * alone.sum(axis=0))
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
        rig.call("press", torque)
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
        rig.call("press", _torque(rig, q, np.full(k, light)))
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
    rig.call("press", more)
    rig.silent(0.25 * (1.0 - LIGHT) * float(np.abs(more).max()) / PRESS_RATE)
    rig.call("stop")  # on the way: a stiff hand that stands may be as tight as it was
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
    if not rig.silent(rig.driver.limits.watchdog + 0.5).fault:
        raise DriverError(
            "press does not end at the watchdog: nobody called for longer than that, and "
            "Readings.fault says nothing"
        )


def pressing_on_nothing_stops(rig: Rig) -> None:
    """Fingers that are pressed open in free air stop the hand, and were not too fast."""
    rig.go(rig.open)  # what was touched is left first
    rig.go(rig.free[0])
    closing = rig.robot.closing.sum(axis=0)
    share = np.where(closing != 0.0, np.abs(closing) / rig.driver.limits.torque, 0.0).max()
    rig.call("press", -0.3 * closing / share)
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
        rig.carry(rig.open, 0.5)
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
    moved = rig.wait(rig.carry(target, 0.5) + 0.3)
    rest = rig.wait(0.3)
    if rest.fault:
        raise DriverError(f"carry: the hand stopped itself: {rest.fault}")
    if (_inwards(rig, before, rest) < FOLLOWED * was).any():
        raise DriverError("carry drops what is pressed")
    if rig.robot.arm:
        watchdog = rig.driver.limits.watchdog
        rig.carry(q, 2.0 * watchdog + 1.0)
        if not rig.silent(watchdog + 0.5).fault:
            raise DriverError(
                f"the watchdog of {watchdog:g} s does not end carrying, or Readings.fault does not "
                "say so"
            )
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
            rig.call("press", share * torque / room.max())
        seen.append(rig.wait(2.0))
    rig.call("stop")
    rig.go(rig.open)
    _must_stay_below("pressing, a fingertip felt", seen, limits.grip)


def wrenches_agree_with_all_else(rig: Rig) -> None:
    """However a touch is pressed and dragged, its wrench tells the same contact, and balances."""
    before, (light, firm), now = _pressed(rig, firmly=False)
    q, k = _mean(now.q), len(rig.normals)
    seen = [now]
    for i in range(k):
        rig.call("press", _torque(rig, q, np.where(np.arange(k) == i, 0.5 * (light + firm), light)))
        rig.wait(FOLLOWS)
        seen.append(rig.wait(0.3))
    across = [j for j in _fingers(rig) if not rig.robot.closing[:, j].any()]
    even = _torque(rig, q, np.full(k, light))
    for j in across:  # sideways, by half of what friction of 0.5 bears
        arm = np.linalg.norm(rig.robot.jacobian(q).reshape(k, 3, -1)[..., j], axis=1).max()
        for way in (1.0, -1.0):
            torque = even.copy()
            torque[j] += way * min(0.25 * light * arm, HALF * rig.driver.limits.torque[j])
            rig.call("press", torque)
            rig.wait(FOLLOWS)
            seen.append(rig.wait(0.3))
    rig.call("press", even)
    rig.wait(FOLLOWS)
    for j in rig.robot.arm:
        arm = np.linalg.norm(rig.robot.jacobian(q).reshape(k, 3, -1)[..., j], axis=1).max()
        for way in (1.0, -1.0, 0.0):
            target = q.copy()
            target[j] += way * min(DRAGGED / max(arm, 1e-3), TRAVEL)
            rig.wait(rig.carry(target, 0.3) + 0.2)
            seen.append(rig.wait(0.2))
    rig.call("stop")
    rig.go(rig.open)
    fault = next((part.fault for part in seen if part.fault), "")
    if fault:
        raise DriverError(f"press: {light:.2g} N at each tip stopped the hand: {fault}")
    for i in range(k):
        _must_tell_one_contact(rig, i, before, seen)
    _must_balance_always(rig, before, seen)


def _must_tell_one_contact(rig: Rig, i: int, before: Readings, seen: Sequence[Readings]) -> None:
    """Raise unless finger i's wrenches, all at one contact, tell one normal near the thing's."""
    name, radius = rig._names[i], float(rig.robot.tip_radius[i])
    frames = [rig.robot.tip_frames(_mean(part.q))[i].copy() for part in seen]
    felt = np.array([_pushed(rig, before, part)[i] for part in seen])

    def spread(scale: float, about: np.ndarray) -> float:
        """How far [rad] the worst normal is from the thing's, with torques so corrected."""
        off = 0.0
        for R, w in zip(frames, felt, strict=True):
            torque = scale * w[3:] - np.cross(about, w[:3])
            off = max(off, _off(rig, i, R, np.concatenate([w[:3], torque])))
        return off

    plain = spread(1.0, np.zeros(3))
    if plain < NORMAL_TOLERANCE:
        return
    said = f"as {name} is pressed and dragged, it feels normals up to {np.degrees(plain):.0f}° off"
    for scale, what in ((-1.0, "is negated"), (2.0, "is halved"), (0.5, "is doubled")):
        if spread(scale, np.zeros(3)) < 0.5 * NORMAL_TOLERANCE:
            raise DriverError(f"wrong torque of the wrench: {said}, as if its torque {what}")
    forces, torques = felt[:, :3], felt[:, 3:]
    size = np.linalg.norm(forces, axis=1).max() * radius
    if np.linalg.norm(torques, axis=1).max() < 0.05 * size:
        raise DriverError(f"wrong torque of the wrench: {said}; its torque is 0")
    places = -radius * np.einsum("tab,a->tb", np.array(frames), rig.normals[i])
    left = torques - np.cross(places, forces)
    A = np.concatenate([-_cross_matrix(f) for f in forces])
    about = np.linalg.lstsq(A, left.ravel(), rcond=1e-3)[0]
    if spread(1.0, about) < 0.5 * plain:
        raise DriverError(
            f"wrong point: {said}, as if the torque were about a point "
            f"{1e3 * np.linalg.norm(about):.1f} mm from the tip's centre"
        )
    raise DriverError(f"wrong frame, or torque, of the wrench: {said}")


def _must_balance_always(rig: Rig, before: Readings, seen: Sequence[Readings]) -> None:
    """Raise where torques are no balance of the wrenches; name the joint or the finger."""
    k, n, joints = len(rig.normals), rig.robot.n, np.flatnonzero(~rig.robot.idle)
    read, parts = [], []
    base = before.torque.mean(axis=0)
    for part in seen:
        q = _mean(part.q)
        frames, places, felt = (
            rig.robot.tip_frames(q).copy(),
            _places(rig, q),
            _pushed(rig, before, part),
        )
        J = np.array([rig.robot.link_jacobian(q, i, places[i]).T @ frames[i] for i in range(k)])
        parts.append(-np.einsum("knb,kc->kncb", J, felt[:, :3]).reshape(k, n, 9))
        read.append(part.torque.mean(axis=0) - base)
    tau, X = np.array(read), np.array(parts)  # (t, n), (t, k, n, 9): τ = Σ X_i vec(A_i), A_i = 1
    due = (X @ np.eye(3).ravel()).sum(axis=1)
    size = np.sqrt((due**2).mean(axis=0))
    off = np.sqrt(((tau - due) ** 2).mean(axis=0))
    group = np.where(np.isin(np.arange(n), rig.robot.arm), 0, 1)
    least = np.array([size[(group == g) & ~rig.robot.idle].max() for g in group])
    share = off / (size + 0.2 * least)
    if not share[joints].max() > BALANCE:
        return
    scale = float((tau * due)[:, joints].sum() / (due * due)[:, joints].sum())
    rest = np.sqrt(((tau - scale * due) ** 2).mean(axis=0)) / (size + 0.2 * least)
    if rest[joints].max() < 0.5 * share[joints].max():
        raise DriverError(
            f"readings of torque are wrong: they are {scale:.2f} of what balances the wrenches, "
            "as tips are pressed and dragged"
        )
    # Which finger's force, turned or stretched, or which joint's torque alone explains it?
    weigh = 1.0 / (size + 0.2 * least)
    wrong = []
    for i in range(k):
        rest = tau - due + X[:, i] @ np.eye(3).ravel()
        A = (X[:, i] * weigh[:, None])[:, joints].reshape(-1, 9)
        y = (rest * weigh)[:, joints].ravel()
        eye = np.eye(3).ravel()
        lam = 0.05 * np.sqrt((A**2).sum(axis=0).max())
        fit = np.linalg.lstsq(
            np.concatenate([A, lam * np.eye(9)]), np.concatenate([y, lam * eye]), rcond=None
        )[0]
        wrong.append((float(np.sqrt(np.mean((A @ fit - y) ** 2))), fit.reshape(3, 3)))
    j = int(joints[share[joints].argmax()])
    others = [share[o] for o in joints if o != j]
    i = int(np.argmin([w[0] for w in wrong]))
    if max(others, default=0.0) < 0.5 * BALANCE or rig.robot.n == 1:
        raise DriverError(
            f"readings of torque are wrong: as tips are pressed and dragged, {rig.joint(j)} is off "
            f"by {off[j]:.2g} N·m of {size[j]:.2g}"
        )
    U, stretch, Vt = np.linalg.svd(wrong[i][1])
    turned = float(np.arccos(np.clip((np.trace(U @ Vt) - 1.0) / 2.0, -1.0, 1.0)))
    raise DriverError(
        f"wrong frame or size of the wrench: {rig._names[i]}'s forces are not in balance with the "
        f"motors' torques, as if turned by {np.degrees(turned):.0f}° and "
        f"{1.0 / stretch.mean():.2f} of their size"
    )


# In the order in which they are safe to run: what holds the hand back comes before what needs it.
CHECKS: tuple[Callable[[Rig], None], ...] = (
    samples_come_at_the_stated_rate,
    joints_go_where_they_are_sent,
    moves_take_the_time_they_say,
    stop_stops,
    the_watchdog_stops_the_hand,
    ranges_are_kept,
    speeds_are_kept,
    tips_weigh_what_they_weigh,
    what_is_too_much_is_refused,
    fingers_close_one_by_one,
    closing_ends_at_a_touch,
    closing_and_holding_end,
    contact_forces_are_kept,
    torques_are_those_that_fingers_hold_with,
    pressing_is_followed_slowly,
    pressing_ends,
    pressing_on_nothing_stops,
    carrying_keeps_what_is_pressed,
    wrenches_agree_with_all_else,
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
