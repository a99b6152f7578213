"""The door for real hardware: what a hand's controller must offer to be touched with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from hqp_grasp.errors import InputError, positive
from hqp_grasp.grasp import as_array


@dataclass(frozen=True, eq=False)
class DriverLimits:
    """What a driver keeps at every step of its own loop, whatever is asked."""

    lower: np.ndarray  # (n,) [rad] ranges of the independent joints
    upper: np.ndarray  # (n,)
    speed: np.ndarray  # (n,) [rad/s]
    torque: np.ndarray  # (n,) [N·m]
    force: float  # [N] at a fingertip
    watchdog: float  # [s] without a call after which the hand stands still

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


@dataclass(frozen=True, eq=False)
class Readings:
    """What a hand knew over some time: one row a sample, at the driver's rate, oldest first."""

    time: np.ndarray  # (t,) [s] when each sample was taken, on the driver's clock
    q: np.ndarray  # (t, n) [rad] independent joints, as encoders have them
    velocity: np.ndarray  # (t, n) [rad/s]
    wrench: np.ndarray  # (t, k, 6) [N, N·m] on each tip, about its centre, in the tip's frame
    touched: np.ndarray  # (k,) bool, at the end: closing was ended by force
    stalled: np.ndarray  # (k,) bool, at the end: closing was ended by a joint that did not follow
    fault: str = ""  # why the driver stopped by itself since it was last moved; empty: it did not

    def __post_init__(self) -> None:
        t = len(as_array("Readings.time", self.time, (None,)))
        if t == 0:
            raise InputError("Readings need at least one sample")
        for name, shape in (
            ("time", (t,)),
            ("q", (t, None)),
            ("velocity", (t, None)),
            ("wrench", (t, None, 6)),
        ):
            object.__setattr__(self, name, as_array(f"Readings.{name}", getattr(self, name), shape))
        for name in ("touched", "stalled"):
            flags = np.array(getattr(self, name), dtype=bool)
            if flags.shape != (self.wrench.shape[1],):
                raise InputError(
                    f"Readings.{name} needs one flag for each of {self.wrench.shape[1]} tips; "
                    f"got shape {flags.shape}"
                )
            flags.setflags(write=False)
            object.__setattr__(self, name, flags)


@runtime_checkable
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
        Ends all closing and holding.
        """
        ...

    def close(self, finger: int, speed: float, force: float) -> None:
        """Start closing a finger along its flexion at `speed` [rad/s], until |f| > `force` [N].

        f is the change of the tip's force since this call: weight and bias are none of it. A
        finger that touched goes on holding `force`.
        """
        ...

    def hold(self, force: float) -> None:
        """Press with `force` [N] at every finger that has touched, the change of force as above."""
        ...

    def stop(self) -> None:
        """Stand still, at once, where the joints are."""
        ...

    def wait(self, duration: float) -> Readings:
        """Let `duration` [s] pass, and return what was read meanwhile: one sample at least."""
        ...
