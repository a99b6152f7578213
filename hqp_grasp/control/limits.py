"""What a step may not do: be too long, leave the joints' ranges, come too near."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hqp_grasp.errors import InputError, instance, not_negative, number, positive
from hqp_grasp.grasp import Grasp, as_array
from hqp_grasp.hierarchy.level import Level
from hqp_grasp.tasks import Stack
from hqp_grasp.tasks.limit import Limit, Priority
from hqp_grasp.world.clearance import SelfClearance
from hqp_grasp.world.robot import Robot


@dataclass(frozen=True)
class StepLimit(Limit):
    """Caps on one step: |x_j| ≤ joint and |(J x)_a| ≤ contact, along each world axis a.

    Rows are shares of the cap [–], so that radians and metres stand side by side.
    """

    joint: float = 0.35  # [rad]
    contact: float = 0.03  # [m]
    priority = Priority.CAP

    def __post_init__(self) -> None:
        for name in ("joint", "contact"):
            value = number(f"StepLimit.{name}", getattr(self, name))
            if not value > 0.0:
                raise InputError(f"StepLimit.{name} must be above 0; got {value}")
            object.__setattr__(self, name, value)

    def level(self, grasp: Grasp) -> Level:
        rows = [np.eye(grasp.n) / self.joint] if np.isfinite(self.joint) else []
        if np.isfinite(self.contact):
            rows.append(grasp.jacobian / self.contact)
        A = np.concatenate(rows) if rows else np.zeros((0, grasp.n))
        one = np.ones(len(A))
        return Level(A, -one, one, "step")


@dataclass(frozen=True, eq=False)
class VelocityLimit(Limit):
    """|x_j| ≤ v_j dt; rows are shares of it [–]."""

    velocity: np.ndarray  # v (n,) [rad/s]
    dt: float  # [s] a probe may take
    priority = Priority.CAP

    def __post_init__(self) -> None:
        velocity = as_array("VelocityLimit.velocity", self.velocity, (None,))
        object.__setattr__(self, "velocity", velocity)
        object.__setattr__(self, "dt", positive("VelocityLimit.dt", self.dt))
        if not (velocity > 0.0).all():
            raise InputError(f"VelocityLimit.velocity must be above 0; got {velocity}")

    def level(self, grasp: Grasp) -> Level:
        if len(self.velocity) != grasp.n:
            raise InputError(
                f"VelocityLimit has {len(self.velocity)} velocities; the grasp has {grasp.n} joints"
            )
        one = np.ones(grasp.n)
        return Level(np.diag(1.0 / (self.velocity * self.dt)), -one, one, "velocity")


@dataclass(frozen=True, eq=False)
class ConfigurationLimit(Limit):
    """Every joint, independent or coupled, stays in its range [rad].

    From outside a range x walks back as fast as the caps allow.
    """

    robot: Robot
    priority = Priority.RANGE

    def __post_init__(self) -> None:
        instance("ConfigurationLimit.robot", self.robot, Robot)

    def level(self, grasp: Grasp) -> Level:
        lower, upper = self.robot.lower, self.robot.upper
        limited = np.isfinite(lower) | np.isfinite(upper)
        q = grasp.q_full
        if len(q) != len(lower):
            raise InputError(
                f"the grasp has {len(q)} joints, {self.robot.description.name} {len(lower)}"
            )
        A = np.asarray(grasp.coupling)[limited]
        return Level(A, (lower - q)[limited], (upper - q)[limited], "range")


@dataclass(frozen=True, eq=False)
class HoldLimit(Limit):
    """Joints that move no contact point, as those of the other arm, stay where they are."""

    robot: Robot
    priority = Priority.RANGE

    def level(self, grasp: Grasp) -> Level:
        A = np.eye(grasp.n)[self.robot.idle]
        return Level.equal(A, np.zeros(len(A)), "hold")


@dataclass(frozen=True, eq=False)
class ClearanceLimit(Limit):
    """The robot's own links keep apart, as its description says; those too near move apart."""

    robot: Robot
    within: float = 0.04  # [m] pairs farther apart than this are let be
    priority = Priority.CLEARANCE
    _links: SelfClearance = field(init=False, repr=False)

    def __post_init__(self) -> None:
        instance("ClearanceLimit.robot", self.robot, Robot)
        object.__setattr__(self, "within", not_negative("ClearanceLimit.within", self.within))
        links = SelfClearance(self.robot, self.robot.description.clearance)
        object.__setattr__(self, "_links", links)

    def level(self, grasp: Grasp) -> Level:
        near = self._links.near(grasp.q, self.within)
        room = near.least - near.distance
        return Level(near.jacobian, room, np.full(len(room), np.inf), "clearance")


@dataclass(frozen=True, eq=False)
class RetreatLimit(Limit):
    """A group's palm moves back along its approach axis by at least `distance` [m]."""

    robot: Robot
    distance: float  # [m]
    group: int = 0
    priority = Priority.CLEARANCE

    def level(self, grasp: Grasp) -> Level:
        approach = self.robot.palm(grasp.q, self.group)[1][:, 2]
        A = approach @ self.robot.palm_jacobian(grasp.q, self.group)[:3]
        return Level(A[None], np.array([-np.inf]), np.array([-self.distance]), "retreat")


def cap_ratio(x: np.ndarray, stack: Stack, grasp: Grasp) -> float:
    """How many times too long x is for the caps of its stack; 1 or less: it fits."""
    return float(cap_ratios(x[None], stack, grasp)[0])


def cap_ratios(steps: np.ndarray, stack: Stack, grasp: Grasp) -> np.ndarray:
    """The same of several steps (m, n) from one grasp."""
    ratios = np.zeros(len(steps))
    for level in _caps(stack, grasp):
        value = steps @ level.A.T
        bound = np.where(value > 0.0, level.upper, -level.lower)
        ratios = np.maximum(ratios, (np.abs(value) / bound).max(axis=1, initial=0.0))
    return ratios


def room_left(x: np.ndarray, more: np.ndarray, stack: Stack, grasp: Grasp) -> float:
    """The largest share t in [0, 1] with x + t·more (n,) within the caps, where x is."""
    room = 1.0
    for level in _caps(stack, grasp):
        value, change = level.A @ x, level.A @ more
        left = np.where(change > 0.0, level.upper - value, value - level.lower)
        far = np.abs(change) > 0.0
        room = min(room, float((left[far] / np.abs(change[far])).min(initial=1.0)))
    return max(room, 0.0)


def _caps(stack: Stack, grasp: Grasp) -> list[Level]:
    return [limit.level(grasp) for limit in stack.limits if limit.priority is Priority.CAP]
