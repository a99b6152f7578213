"""What a step may not do: caps on its length, joint ranges, and mink's limits as they are."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import mink
import mujoco
import numpy as np

from hqp_grasp.errors import InputError, number
from hqp_grasp.grasp import Grasp, as_array
from hqp_grasp.level import Level
from hqp_grasp.robot import Robot


class Rank(IntEnum):
    """Which limits come first: a cap always leaves x = 0, so it can always be kept."""

    CAP = 0
    RANGE = 1
    CLEARANCE = 2


class Limit(ABC):
    """Inequality rows over x = Δq, placed above every control law."""

    rank: Rank

    @abstractmethod
    def level(self, grasp: Grasp) -> Level:
        """lower ≤ A x ≤ upper at this grasp."""


@dataclass(frozen=True)
class StepLimit(Limit):
    """Caps on one step: |x_j| ≤ joint and |(J x)_a| ≤ contact, along each world axis a.

    Rows are shares of the cap [–], so that radians and metres stand side by side.
    """

    joint: float = 0.35  # [rad]
    contact: float = 0.03  # [m]
    rank = Rank.CAP

    def __post_init__(self) -> None:
        for name in ("joint", "contact"):
            if not number(f"StepLimit.{name} must be above 0: it", getattr(self, name)) > 0.0:
                raise InputError(f"StepLimit.{name} must be above 0; got {getattr(self, name)}")

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
    rank = Rank.CAP

    def __post_init__(self) -> None:
        velocity = as_array("VelocityLimit.velocity", self.velocity, (None,))
        object.__setattr__(self, "velocity", velocity)
        if not (velocity > 0.0).all() or not (np.isfinite(self.dt) and self.dt > 0.0):
            raise InputError("VelocityLimit needs velocities and dt above 0")

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
    rank = Rank.RANGE

    def level(self, grasp: Grasp) -> Level:
        lower, upper = self.robot.lower, self.robot.upper
        limited = np.isfinite(lower) | np.isfinite(upper)
        q = grasp.q_full
        if len(q) != len(lower):
            raise InputError(
                f"the grasp has {len(q)} joints, {self.robot.description.name} {len(lower)}"
            )
        A = grasp.coupling[limited]  # type: ignore[index]
        return Level(A, (lower - q)[limited], (upper - q)[limited], "range")


@dataclass(frozen=True, eq=False, repr=False)
class MinkLimit(Limit):
    """A limit of mink, G Δq_full ≤ h, carried over to the independent joints: G C x ≤ h."""

    limit: mink.Limit
    model: mujoco.MjModel | None = None  # that the limit speaks of; None: the one it keeps itself
    dt: float = 1.0  # [s] a probe may take; only velocity limits read it

    def __post_init__(self) -> None:
        if self.model is None and not isinstance(self.limit, mink.VelocityLimit):
            model = getattr(self.limit, "model", None)
            if model is None:
                raise InputError(
                    f"{type(self.limit).__name__} keeps no model: pass MinkLimit(limit, model)"
                )
            object.__setattr__(self, "model", model)

    def __repr__(self) -> str:
        # Says all that mink's limit holds, and no address: results folders are told apart by it.
        kept = {k: v for k, v in vars(self.limit).items() if not k.startswith("_")}
        text = ", ".join(
            f"{k}={np.array2string(np.asarray(v), threshold=10**6)}"
            for k, v in sorted(kept.items())
            if isinstance(v, (int, float, str, np.ndarray))
        )
        return f"MinkLimit({type(self.limit).__name__}({text}), dt={self.dt})"

    @property
    def rank(self) -> Rank:  # type: ignore[override]
        if isinstance(self.limit, mink.VelocityLimit | mink.FreeJointVelocityLimit):
            return Rank.CAP
        if isinstance(self.limit, mink.ConfigurationLimit):
            return Rank.RANGE
        return Rank.CLEARANCE

    def level(self, grasp: Grasp) -> Level:
        # mink's VelocityLimit reads no configuration, and keeps no model to make one from.
        configuration: Any = self.model and mink.Configuration(self.model, q=grasp.q_full)
        G, h = self.limit.compute_qp_inequalities(configuration, self.dt)
        name = type(self.limit).__name__
        if G is None or h is None:
            return Level(np.zeros((0, grasp.n)), np.zeros(0), np.zeros(0), name)
        A = G @ grasp.coupling
        kept = np.isfinite(h)
        return Level(A[kept], np.full(kept.sum(), -np.inf), h[kept], name)
