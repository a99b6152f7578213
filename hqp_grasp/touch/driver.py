"""The door for real hardware: what a hand's controller must offer to be touched with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from hqp_grasp.errors import InputError, not_negative, positive
from hqp_grasp.grasp import as_array

HELD = 0.4  # share of the force limit that is held, at most: the rest is for bumps
PRESS_RATE = 2.0  # [N·m/s] by which pressed joints follow what is asked, at most


@dataclass(frozen=True, eq=False)
class DriverLimits:
    """What a driver keeps at every step of its own loop, whatever is asked."""

    lower: np.ndarray  # (n,) [rad] ranges of the independent joints
    upper: np.ndarray  # (n,)
    speed: np.ndarray  # (n,) [rad/s]
    torque: np.ndarray  # (n,) [N·m]
    force: float  # [N] at a fingertip while the hand touches
    watchdog: float  # [s] without a call after which the hand stands still
    grip: float = 0.0  # [N] at a fingertip while the hand presses; 0: it cannot press

    def __post_init__(self) -> None:
        n = len(as_array("DriverLimits.lower", self.lower, (None,)))
        for name in ("lower", "upper", "speed", "torque"):
            array = as_array(f"DriverLimits.{name}", getattr(self, name), (n,))
            object.__setattr__(self, name, array)
            if name in ("speed", "torque") and not (array > 0.0).all():
                raise InputError(f"DriverLimits.{name} must be above 0; got {array}")
        if not (self.lower < self.upper).all():
            raise InputError("DriverLimits: every lower end must be below its upper one")
        for name in ("force", "watchdog"):
            value = positive(f"DriverLimits.{name}", getattr(self, name))
            object.__setattr__(self, name, value)
        object.__setattr__(self, "grip", not_negative("DriverLimits.grip", self.grip))

    @property
    def hold(self) -> float:
        """What `Driver.close` and `Driver.hold` press with, at most [N]."""
        return HELD * self.force

    def require_hold(self, call: str, force: float) -> float:
        """Return `force` [N] if a finger may hold it, else raise InputError."""
        positive(call, force)
        if force > self.hold:
            raise InputError(
                f"{call} is {force:g} N; this hand holds {self.hold:g} N at most, {HELD:g} of its "
                f"limit of {self.force:g} N while it touches"
            )
        return force

    def require_torque(self, call: str, torque: object, carrying: Sequence[int]) -> np.ndarray:
        """Return `torque` (n,) [N·m] if the hand may press with it, else raise InputError.

        `carrying` are the joints that carry a palm, into q: they press nothing.
        """
        asked = as_array(call, torque, (len(self.torque),))
        if self.grip == 0.0:
            raise InputError(f"{call}: this hand cannot press: its DriverLimits.grip is 0 N")
        arm = [j for j in carrying if asked[j] != 0.0]
        if arm:
            raise InputError(
                f"{call} is {asked[arm[0]]:g} N·m at joint {arm[0]}, which carries the palm; "
                "it must be 0 there: only fingers press"
            )
        j = int(np.argmax(np.abs(asked) / self.torque))
        if abs(asked[j]) > self.torque[j]:
            raise InputError(
                f"{call} is {asked[j]:g} N·m at joint {j}, whose limit is {self.torque[j]:g} N·m"
            )
        return asked


@dataclass(frozen=True, eq=False)
class Readings:
    """What a hand knew over some time: one row a sample, at the driver's rate, oldest first.

    What a sensor did not tell is NaN.
    """

    time: np.ndarray  # (t,) [s] when each sample was taken, on the driver's clock
    q: np.ndarray  # (t, n) [rad] independent joints, as encoders have them
    velocity: np.ndarray  # (t, n) [rad/s]
    wrench: np.ndarray  # (t, k, 6) [N, N·m] on each tip, about its centre, in the tip's frame
    touched: np.ndarray  # (k,) bool, at the end: closing was ended by force
    stalled: np.ndarray  # (k,) bool, at the end: closing was ended by a joint that did not follow
    fault: str = ""  # why the driver stopped by itself since it was last moved; empty: it did not
    # (t, n) [N·m] of the motors on their joints, beside what carries the robot's own weight; NaN
    # from a hand that cannot press
    torque: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))

    def __post_init__(self) -> None:
        put = object.__setattr__
        put(self, "time", _samples("Readings.time", self.time, (None,)))
        t = len(self.time)
        if t == 0:
            raise InputError("Readings need at least one sample")
        put(self, "q", _samples("Readings.q", self.q, (t, None)))
        n = self.q.shape[1]
        put(self, "velocity", _samples("Readings.velocity", self.velocity, (t, n)))
        put(self, "wrench", _samples("Readings.wrench", self.wrench, (t, None, 6)))
        torque = self.torque if np.size(self.torque) else np.full((t, n), np.nan)
        put(self, "torque", _samples("Readings.torque", torque, (t, n)))
        for name in ("touched", "stalled"):
            flags = np.array(getattr(self, name), dtype=bool)
            if flags.shape != (self.wrench.shape[1],):
                raise InputError(
                    f"Readings.{name} needs one flag for each of {self.wrench.shape[1]} tips; "
                    f"got shape {flags.shape}"
                )
            flags.setflags(write=False)
            object.__setattr__(self, name, flags)


def _samples(name: str, value: object, shape: tuple[int | None, ...]) -> np.ndarray:
    """Samples of that shape as floats, NaN where there is no finite number."""
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        return as_array(name, value, shape)  # which says what is wrong
    as_array(name, np.where(np.isfinite(array), array, 0.0), shape)
    array[~np.isfinite(array)] = np.nan
    array.setflags(write=False)
    return array


class Driver(Protocol):
    """A hand as its controller offers it; docs/real-hand.md shows one being written.

    Joints come in the order of `robot.joints`, fingers are numbered as the robot's contact points.
    Calls that move return at once; the motion goes on while the caller is in `wait`, at the pace
    of the driver's own fast loop. That loop keeps `limits` at every step, and stands still by
    itself after `limits.watchdog` seconds without a call, `wait` included.

    Wrenches are what the world applies *to* the tip, its own weight included.
    `hqp_grasp.touch.driver_contract.check_driver` tests all of this on a driver of yours.
    """

    @property
    def limits(self) -> DriverLimits:
        """What it keeps."""
        ...

    @property
    def rate(self) -> float:
        """Samples of `wait` [Hz]."""
        ...

    def move(self, q: np.ndarray, duration: float) -> float:
        """Start towards q (n,) [rad], to arrive at rest; return how long that takes [s].

        `duration` where the limits allow it, longer where they do not; q is clipped to its ranges.
        Ends all closing, holding and pressing.
        """
        ...

    def close(self, finger: int, speed: float, force: float) -> None:
        """Start closing a finger along `robot.closing`, until |f| > `force` [N].

        `speed` [rad/s] is the fastest joint's, and that of a slide in the same proportion.
        f is the change of the tip's force since this call: weight and bias are none of it. A
        finger that touched goes on holding `force`.
        """
        ...

    def hold(self, force: float) -> None:
        """Press with `force` [N] at every finger that has touched, the change of force as above.

        As in `close`, more than `limits.hold` raises InputError.
        """
        ...

    def press(self, torque: np.ndarray) -> None:
        """Press with the motors' `torque` (n,) [N·m], whatever the joints that carry a palm do.

        `torque` is 0 at those; they stand, or go on being carried. The others follow it from what
        they press with now, by PRESS_RATE at most, those with 0 too: they yield. So the tips push
        the object with wrenches w_i, of which torque = Σ J_iᵀ w_i. Goes on until `move`, `close` or
        `stop`, or until the hand stops by itself: for the watchdog, a tip's force near
        `limits.grip`, or a joint that meets nothing which resists. Then no torque is followed: what
        is held may fall.
        Raises InputError, and changes nothing, for a torque beyond `limits.torque`.
        """
        ...

    def carry(self, q: np.ndarray, duration: float) -> float:
        """Start the joints that carry a palm towards q (n,) [rad], as `move` does; return how long.

        Pressing goes on: the fingers are where it takes them, whatever q has for them. A hand that
        stopped by itself meanwhile stays there, and returns 0. Raises InputError for one that was
        never told to press.
        """
        ...

    def stop(self) -> None:
        """Stand still, at once, where the joints are, and press no more."""
        ...

    def wait(self, duration: float) -> Readings:
        """Let `duration` [s] pass, and return what was read meanwhile: one sample at least."""
        ...


TOUCHING = ("limits", "rate", "move", "close", "hold", "stop", "wait")
PRESSING = ("press", "carry")


def require_touch(name: str, driver: object) -> None:
    """Raise InputError for a driver that lacks what touching needs."""
    lacks = [call for call in TOUCHING if not hasattr(driver, call)]
    if lacks:
        raise InputError(
            f"{name} must have all that a Driver has to touch with; {driver!r} lacks "
            f"{', '.join(lacks)}"
        )


def require_press(name: str, driver: object) -> None:
    """Raise InputError for a driver that touches, but cannot press and carry."""
    require_touch(name, driver)
    lacks = [call for call in PRESSING if not hasattr(driver, call)]
    if lacks:
        raise InputError(f"{name} cannot press: {driver!r} lacks {', '.join(lacks)} of a Driver")
    if driver.limits.grip == 0.0:  # type: ignore[attr-defined]
        raise InputError(f"{name} cannot press: its DriverLimits.grip is 0 N")
