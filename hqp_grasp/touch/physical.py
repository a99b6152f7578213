"""Touching by force: the probe that knows what a real hand knows, through its driver alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np

from hqp_grasp.errors import InputError, finite, instance, positive
from hqp_grasp.grasp import Contact, Grasp, Miss, Missed
from hqp_grasp.mechanics import cross
from hqp_grasp.touch.driver import Driver, Readings, require_touch
from hqp_grasp.touch.geometric import RETREAT
from hqp_grasp.touch.sensing import sense
from hqp_grasp.world.robot import Robot

GRAVITY = np.array([0.0, 0.0, -9.81])  # [m/s²] world
OPENING = 0.3  # [s] at least, each ramp
MOVING = 0.4
BACKING = 0.01  # [m] a palm goes back by, to free fingers that do not open
RESTING = 0.1  # [s] before the tips are weighed
LISTENING = 0.05  # [s] to the sensors, before each move
DEAF = 2.0  # [s] that a silent sensor is waited for
PAUSE = 1.0  # [s] before a hand that did not open tries again
WEIGHING = 0.2  # [s]
SWIFT = 1.0  # [rad/s] of closing, far from the touch that is expected
CAREFUL = 0.2  # [rad/s] near it
SLOW = 0.3  # [rad/s] where nothing is known
EXPECTED = 0.08  # [rad] before and after the expected touch closing is careful
NOTICED = 0.1  # [N] that counts as touch, at least
BEYOND_NOISE = 4.0  # times the length of one sample's noise, that does
POLL = 0.1  # [s] between looks at the fingers while they close
PATIENCE = 3.0  # [s] that closing may take beyond what its range and speed need
SETTLING, PRESSING = 0.3, 0.3  # [s], [s/N] that the held force may take: a finger may slide
PRESSED = 0.1  # [s] of readings that tell whether it is settled
SETTLED = 0.04  # share of it that may be missing
SENSING = 0.2  # [s] of readings that are averaged
FEELING = 0.1  # [s] the same, while the hand is at something else
LOST = 0.5  # share of the held force below which a contact is none
SPIKE = 0.5  # share of the held force by which a sample lies beside the others, to count as none
STEEP = 1.5  # [–] tangential by normal force that no fingertip holds
NEAR = 2e-3  # [m] from a link of the robot, or from the table, a tip touches that
UPWARDS = 0.7  # [–] vertical part of a table's normal, at least, as it is felt
BENT = 0.03  # [rad] from the end of its range a finger opens no further: what it bumps bends it
CLOSED = 0.02  # [rad] from the end of its range a finger is closed


@dataclass(frozen=True, eq=False)
class PhysicalProbe:
    """Touch with a driven hand: open, move, close until felt, hold, and sense the wrenches.

    It sees joint angles and fingertip wrenches, and the robot's kinematics, nothing else. Each
    touch weighs the open tips in the air first: what is felt there, turned as the tips turn, is
    not of the object. Contacts come from `sense`, with their wrenches; a touch of something that a
    push on the tip cannot explain is a Missed.
    """

    driver: Driver
    robot: Robot
    force: float = 1.0  # [N] held while the contact is sensed
    table: float | None = None  # [m] height of what the object stands on, where it is known
    _weighed: Readings | None = field(init=False, repr=False)  # open tips, at the last touch
    _clock: float = field(init=False, repr=False)  # [s] of the newest sample
    _payload: tuple[np.ndarray, np.ndarray] = field(init=False, repr=False)  # kg (k,), m (k, 3)
    _data: mujoco.MjData = field(init=False, repr=False)
    _own: tuple[tuple[int, list[int]], ...] = field(init=False, repr=False)  # tips, what they meet

    def __post_init__(self) -> None:
        instance("PhysicalProbe.robot", self.robot, Robot)
        require_touch("PhysicalProbe.driver", self.driver)
        object.__setattr__(self, "force", positive("PhysicalProbe.force", self.force))
        if self.table is not None:
            object.__setattr__(self, "table", finite("PhysicalProbe.table", self.table))
        self.driver.limits.require_hold("PhysicalProbe.force", self.force)
        if len(self.driver.limits.lower) != self.robot.n:
            raise InputError(
                f"the driver moves {len(self.driver.limits.lower)} joints, {self.robot} has "
                f"{self.robot.n}: is it of another robot?"
            )
        object.__setattr__(self, "_weighed", None)
        object.__setattr__(self, "_clock", -np.inf)
        object.__setattr__(self, "_payload", payload(self.robot))
        object.__setattr__(self, "_data", mujoco.MjData(self.robot.model))
        object.__setattr__(self, "_own", _own_links(self.robot))

    def touch(self, q_target: np.ndarray, via: Sequence[np.ndarray] = ()) -> Grasp | Missed:
        """Move to q_target (n,) [rad], close every finger, and return the grasp felt there.

        The postures `via` (n,) [rad], such as a `Step` has, are passed first with open fingers. A
        palm whose fingers cannot open as far as others draws back by what they lack, until it is
        there. A
        touch that misses ends where it began, or at the last of those that were passed, its
        fingers open: the next one approaches from where the last grasp was felt.
        """
        target = self.robot.require_q("q_target", q_target)
        via = [self.robot.require_q("via", q) for q in via]
        *passed, away = (self._away(q) for q in (*via, target))
        object.__setattr__(self, "_clock", -np.inf)
        try:
            heard = self._listen()
            if isinstance(heard, Missed):
                return heard
            way = [self._opened(heard, (passed or [away])[0]), *passed, away]
            short = np.max([self._short(q) for q in (heard.q[-1], *via, target)], axis=0)
            drew_back = self._beside and bool(short.any())
            if drew_back:
                free = [self.robot.withdrawn(q, short) for q in way]
                way = [way[0], *free, away]
            felt = self._touch(way, target, drew_back)
            if isinstance(felt, Missed):
                self._retreat(felt, way)
        except _SilentError as what:
            self.driver.stop()
            return Missed(Miss.SENSOR, str(what))
        return felt

    def feel(self) -> Grasp | Missed:
        """The contacts now, without motion, whatever the hand does meanwhile: hold, press, carry.

        The tips are as heavy as they were weighed at the last touch, turned as they turn. Each
        contact has its wrench, the mean over FEELING. Raises InputError before the first touch.
        """
        if self._weighed is None:
            raise InputError("PhysicalProbe.feel: nothing was touched yet; touch weighs the tips")
        try:
            return self._sense(self._weighed, self._wait(FEELING))
        except _SilentError as what:
            return Missed(Miss.SENSOR, str(what))

    def _retreat(self, missed: Missed, way: Sequence[np.ndarray]) -> None:
        """Go back to where the touch began, or to the last posture that was passed."""
        if missed.reason is Miss.STUCK:
            self._watch(PAUSE)
        here = self._wait(0.0)
        back = self._opened(here, way[-1])
        # Nobody knows what a finger is at: it may be behind the object.
        self._go(back, 2.0 * float(np.abs(back - here.q[-1]).max()) / SWIFT)
        self._go(way[-2], MOVING)

    def _wait(self, duration: float) -> Readings:
        """Readings that tell something. Raises _SilentError."""
        readings = self.driver.wait(duration)
        mute = np.isnan(readings.wrench).any(axis=(0, 2))
        if mute.any():
            raise _SilentError(self._names[int(mute.argmax())])
        return self._in_time(readings)

    def _in_time(self, readings: Readings) -> Readings:
        """The readings, if they are new and joints are known. Raises _SilentError."""
        if not (np.diff(readings.time, prepend=self._clock) > 0.0).all():
            raise _SilentError("all of the hand: its readings have time stamps that do not advance")
        object.__setattr__(self, "_clock", float(readings.time[-1]))
        mute = np.isnan(readings.q).any(axis=0)
        if mute.any():
            raise _SilentError(self.robot.joints[int(mute.argmax())])
        return readings

    @property
    def time(self) -> float:
        """Of the newest sample [s], on the driver's clock; −inf before the first."""
        return self._clock

    @property
    def _beside(self) -> bool:
        """Whether each palm has a side of the object, off which it draws its fingers as it goes.

        Fingers of a single hand are about the object: they cannot be drawn off it.
        """
        return len(self.robot.groups) > 1

    @property
    def _names(self) -> list[str]:
        return [point.name for point in self.robot.description.contact_points]

    def _listen(self) -> Readings | Missed:
        """The newest readings, once no sensor is silent: a hand that feels nothing stays."""
        left = DEAF
        while True:
            heard = self._in_time(self.driver.wait(LISTENING))
            silent = _silent(heard)
            left -= LISTENING
            if not silent.any() or (silent.all() and not np.isnan(heard.wrench).any()):
                return heard
            if left <= 0.0:
                return Missed(Miss.SENSOR, self._names[int(silent.argmax())])

    def _away(self, q: np.ndarray) -> np.ndarray:
        """The posture q (n,) [rad], each finger opened by RETREAT."""
        limits, closing = self.driver.limits, self.robot.closing.sum(axis=0)
        bent = BENT if self._beside else 0.0
        opened = np.clip(q - RETREAT * closing, limits.lower + bent, limits.upper - bent)
        return np.where(closing != 0.0, opened, q)

    def _opened(self, readings: Readings, away: np.ndarray) -> np.ndarray:
        """Where the hand is, each finger opened by RETREAT, and at least as far as in `away`."""
        limits, closing = self.driver.limits, self.robot.closing.sum(axis=0)
        q = np.clip(readings.q[-1], limits.lower, limits.upper)
        opened = np.clip(q - RETREAT * closing, limits.lower, limits.upper)
        opened = np.where(closing > 0.0, np.minimum(opened, away), np.maximum(opened, away))
        return np.where(closing != 0.0, opened, q)

    def _short(self, q: np.ndarray) -> np.ndarray:
        """What fingers at q (n,) lack, of each group (groups,) [m], to open by RETREAT."""
        robot = self.robot
        beyond = robot.centers(q - RETREAT * robot.closing.sum(axis=0))
        lacks = np.linalg.norm(beyond - robot.centers(self._away(q)), axis=1)
        return np.array([lacks[list(group.points)].max() for group in robot.groups])

    def _touch(
        self, way: Sequence[np.ndarray], target: np.ndarray, drew_back: bool
    ) -> Grasp | Missed:
        """Open to way[0], go along the others, and close.

        Where palms drew back, what stops the hand on the last leg is an open finger that meets the
        object.
        """
        for i, q in enumerate(way):
            before = self._wait(0.0) if drew_back and i == len(way) - 1 else None
            fault = self._go(q, MOVING if i else OPENING)
            if fault and not i:
                fault = self._backed_off(q, fault)
            if fault:
                heard = self._listen()
                if isinstance(heard, Missed):
                    return heard
                if before is not None:
                    change = np.linalg.norm((heard.wrench - before.wrench[-1])[-1, :, :3], axis=1)
                    return Missed(Miss.INSIDE, self._names[int(change.argmax())])
                return Missed(Miss.BLOCKED if i else Miss.STUCK, fault)
        self._wait(RESTING)
        free = self._wait(WEIGHING)
        object.__setattr__(self, "_weighed", free)
        noise = np.sqrt(self._variance(free)[:, :3].sum(axis=1))
        noticed = np.maximum(NOTICED, BEYOND_NOISE * noise)
        noticed = np.minimum(noticed, self.driver.limits.hold).tolist()
        missed = self._close(self._approach(free, target, noticed), noticed)
        if missed is not None:
            return missed
        self.driver.hold(self.force)
        return self._sense(free, self._settle(free))

    def _backed_off(self, opened: np.ndarray, fault: str) -> str:
        """Open once more, the palms first drawn back; return what stopped the hand, as `_go` does.

        A finger that closes nearly along a surface is wedged on it: as it opens, friction pulls it
        into the surface. Drawn off along its palm's axis it is free.
        """
        if not self._beside:
            return fault
        robot = self.robot
        back = robot.withdrawn(self._wait(0.0).q[-1], np.full(len(robot.groups), BACKING))
        there = np.where(robot.closing.any(axis=0), opened, back)
        return self._go(back, MOVING) or self._go(there, OPENING)

    def _settle(self, free: Readings) -> Readings:
        """Readings under the held force, once it is what was asked for.

        A finger that slides never is: then those of when the least pressed one pressed most.
        """
        left, weighed = SETTLING + PRESSING * self.force, self._steady(free)[:, :3]
        best, most = None, -1.0
        while best is None or left > 0.0:
            held = self._wait(PRESSED)
            left -= PRESSED
            pressed = np.linalg.norm(self._steady(held)[:, :3] - weighed, axis=1)
            if held.fault:
                return held
            if (np.abs(pressed - self.force) <= SETTLED * self.force).all():
                return self._wait(SENSING)
            if pressed.min() > most:
                best, most = held, float(pressed.min())
        return best

    def _go(self, q: np.ndarray, duration: float) -> str:
        """Move there; return what stopped the hand on its way, empty if nothing did."""
        left, still = self.driver.move(q, duration), True
        far = 0.0
        while left > 0.0:
            slice_ = min(left, 0.5 * self.driver.limits.watchdog)
            readings = self._wait(slice_)
            if readings.fault:
                return readings.fault
            still = still and not np.ptp(readings.q, axis=0).any()
            far = max(far, float(np.abs(q - readings.q[0]).max()))
            left -= slice_
        if still and far > CLOSED:
            raise _SilentError("all of the hand: it was sent elsewhere and reads the same angles")
        return ""

    def _approach(
        self, readings: Readings, target: np.ndarray, noticed: Sequence[float]
    ) -> Readings:
        """Close all fingers swiftly, to a little before the touch that is expected."""
        closing = self.robot.closing
        away = closing @ (target - readings.q[-1]) / (closing**2).sum(axis=1)
        way = np.maximum(away - EXPECTED, 0.0)
        swift = float(way.max()) / SWIFT
        if swift > 0.0:
            for i, length in enumerate(way):
                if length > 0.0:
                    self.driver.close(i, length / swift, noticed[i])
            readings = self._watch(swift)
        return readings

    def _close(self, readings: Readings, noticed: Sequence[float]) -> Missed | None:
        """Close what has not touched until `noticed` (k,) [N] is felt; None once all have."""
        driver, names = self.driver, self._names
        careful = 2.0 * EXPECTED / CAREFUL
        speed = CAREFUL
        for i in np.flatnonzero(~readings.touched).tolist():
            driver.close(i, speed, noticed[i])
        left = PATIENCE + float(self._open_by(readings).max()) / SLOW
        while not readings.fault and not readings.touched.all():
            if readings.stalled.any():
                driver.stop()
                i = int(np.argmax(readings.stalled))
                silent = _silent(readings)[i]
                return Missed(Miss.SENSOR if silent else Miss.OTHER_LINK, names[i])
            closed = self._open_by(readings) <= CLOSED
            closed |= left <= 0.0  # a finger that takes longer than its range does not close
            if (closed & ~readings.touched).any():
                driver.stop()
                return Missed(Miss.NO_TOUCH, names[int(np.argmax(closed & ~readings.touched))])
            if careful <= 0.0 and speed == CAREFUL:
                speed = SLOW
                for i in np.flatnonzero(~readings.touched).tolist():
                    driver.close(i, speed, noticed[i])
            readings = self._wait(POLL)
            careful, left = careful - POLL, left - POLL
        return Missed(Miss.BLOCKED, readings.fault) if readings.fault else None

    def _open_by(self, readings: Readings) -> np.ndarray:
        """How far (k,) [rad] each finger can still close, until its last joint is at its end."""
        closing, limits = self.robot.closing, self.driver.limits
        end = np.where(closing > 0.0, limits.upper, limits.lower)
        with np.errstate(divide="ignore", invalid="ignore"):
            left = (end - readings.q[-1]) / closing
        return np.asarray(np.where(closing != 0.0, left, -np.inf).max(axis=1))

    def _watch(self, duration: float) -> Readings:
        """Wait, in slices that the watchdog allows, while nothing stops the hand."""
        while True:
            slice_ = min(duration, 0.5 * self.driver.limits.watchdog)
            readings = self._wait(slice_)
            duration -= slice_
            if duration <= 0.0 or readings.fault or readings.stalled.any():
                return readings

    def _sense(self, free: Readings, held: Readings) -> Grasp | Missed:
        robot = self.robot
        names = self._names
        if held.fault:
            return Missed(Miss.BLOCKED, held.fault)
        # At rest a sensor without any noise may repeat itself.
        silent = _silent(held) & self._variance(free).any(axis=1)
        if silent.any():
            return Missed(Miss.SENSOR, names[int(silent.argmax())])
        q = np.clip(held.q.mean(axis=0), robot.q_lower, robot.q_upper)
        robot.place(self._data, q)
        for (tip, links), name in zip(self._own, names, strict=True):
            for link in links:
                gap = mujoco.mj_geomDistance(robot.model, self._data, tip, link, NEAR, None)
                if gap < NEAR:
                    return Missed(Miss.OWN_LINK, name)
        R_world_tip = robot.tip_frames(q)
        wrench = self._steady(held) - self._steady(free)
        unsure = self._unsure(held) + self._unsure(free)
        wrench -= weight(self._payload, R_world_tip)
        wrench += weight(self._payload, robot.tip_frames(free.q.mean(axis=0)))
        contacts = []
        for i, (R, center, radius) in enumerate(
            zip(R_world_tip, robot.centers(q), robot.tip_radius, strict=True)
        ):
            pressed = float(np.linalg.norm(wrench[i, :3]))
            if pressed < LOST * self.force:
                return Missed(Miss.LOST, names[i])
            position, normal = sense(wrench[i], float(radius))
            upright = min(1.0, float(wrench[i, :3] @ normal) / pressed)
            if np.hypot(1.0, STEEP) * upright < 1.0:
                return Missed(Miss.UNCLEAR, names[i])
            n, place = R @ normal, center + R @ position
            if self.table is not None and place[2] < self.table + NEAR and n[2] > UPWARDS:
                return Missed(Miss.TABLE, names[i])
            world = np.concatenate([R @ wrench[i, :3], R @ wrench[i, 3:]])
            noise = (
                float(np.sqrt(unsure[i, :3].mean() + unsure[i, 3:].mean() / radius**2)) / pressed
            )
            contacts.append(Contact(place, n, wrench=world, noise=noise))
        return robot.grasp(q, contacts)

    def _steady(self, readings: Readings) -> np.ndarray:
        """The wrenches (k, 6), averaged over all samples but spikes."""
        kept = self._kept(readings)
        return (readings.wrench * kept[..., None]).sum(axis=0) / kept.sum(axis=0)[:, None]

    def _unsure(self, readings: Readings) -> np.ndarray:
        """Variance (k, 6) of these averages by noise."""
        kept = self._kept(readings).sum(axis=0)
        return np.asarray(self._variance(readings) / np.maximum(kept, 1)[:, None])

    def _variance(self, readings: Readings) -> np.ndarray:
        """Variance (k, 6) of one sample by noise: samples beside the middle of their two
        neighbours, whose variance is 3/2 of one sample's, whatever drifts.
        """
        kept = self._kept(readings)
        threes = kept[2:] & kept[1:-1] & kept[:-2]
        beside = 0.5 * np.diff(readings.wrench, n=2, axis=0) * threes[..., None]
        count = np.maximum(threes.sum(axis=0), 1)[:, None]
        return np.asarray((beside**2).sum(axis=0) / (1.5 * count))

    def _kept(self, readings: Readings) -> np.ndarray:
        """Samples (t, k) that are no spikes."""
        force = readings.wrench[..., :3]
        beside = np.linalg.norm(force - np.median(force, axis=0), axis=-1)
        return np.asarray(beside <= np.maximum(SPIKE * self.force, np.median(beside, axis=0)))


class _SilentError(Exception):
    """Readings say nothing; of what, its message tells."""


def _silent(readings: Readings) -> np.ndarray:
    """Tips (k,) that say nothing, or the same to the last bit in three samples running.

    No sensor in use does.
    """
    same = (np.diff(readings.wrench, axis=0) == 0.0).all(axis=2)
    return np.asarray((same[1:] & same[:-1]).any(axis=0) | np.isnan(readings.wrench).any((0, 2)))


def _own_links(robot: Robot) -> tuple[tuple[int, list[int]], ...]:
    """Each tip's geom, and those of the robot that it can meet: all but its own finger's links."""
    model = robot.model
    tips = [geoms[0] for geoms in robot.geoms]
    palms = {i: group.palm_body for group in robot.groups for i in group.points}
    moving = [g for g in range(model.ngeom) if model.body_weldid[model.geom_bodyid[g]] != 0]
    touching = [g for g in moving if model.geom_contype[g] or model.geom_conaffinity[g]]
    found = []
    for i, tip in enumerate(tips):
        finger, body = set(), int(model.geom_bodyid[tip])
        while body not in (0, palms[i]):
            finger.add(body)
            body = int(model.body_parentid[body])
        found.append((tip, [g for g in touching if model.geom_bodyid[g] not in finger]))
    return tuple(found)


def payload(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """What hangs on each tip's sensor: mass (k,) [kg], and its middle from the tip's centre (k, 3).

    The middle is in the tip's frame [m].
    """
    model = robot.model
    masses, middles = [], []
    for point in robot.description.contact_points:
        site = model.site(point.site)
        body = int(site.bodyid[0])
        masses.append(float(model.body_mass[body]))
        R = np.zeros(9)
        mujoco.mju_quat2Mat(R, site.quat)
        middles.append(R.reshape(3, 3).T @ (model.body_ipos[body] - site.pos))
    return np.array(masses), np.array(middles)


def weight(load: tuple[np.ndarray, np.ndarray], R_world_tip: np.ndarray) -> np.ndarray:
    """Gravity's wrench (k, 6) on each tip about its centre, in its frame."""
    masses, middles = load
    force = masses[:, None] * (GRAVITY @ R_world_tip)
    return np.concatenate([force, cross(middles, force)], axis=1)
