"""What a limit is: inequality rows above every law; mink's limits are taken as they are."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import mink
import mujoco
import numpy as np

from hqp_grasp.errors import InputError, positive
from hqp_grasp.grasp import Grasp
from hqp_grasp.hierarchy.level import Level
from hqp_grasp.tasks.mink_rows import configuration_of


class Priority(IntEnum):
    """Which limits come first: a cap always leaves x = 0, so it can always be kept."""

    CAP = 0
    RANGE = 1
    CLEARANCE = 2


class Limit(ABC):
    """Inequality rows over x = Δq, placed above every control law."""

    priority: Priority

    @abstractmethod
    def level(self, grasp: Grasp) -> Level:
        """lower ≤ A x ≤ upper at this grasp."""


@dataclass(frozen=True, eq=False)
class MinkLimit(Limit):
    """A limit of mink, G Δq_full ≤ h, carried over to the independent joints: G C x ≤ h."""

    limit: mink.Limit
    model: mujoco.MjModel | None = None  # that the limit speaks of; None: the one it keeps itself
    dt: float = 1.0  # [s] a probe may take; only velocity limits read it

    def __post_init__(self) -> None:
        if not isinstance(self.limit, mink.Limit):
            raise InputError(f"MinkLimit.limit must be a limit of mink; got {self.limit!r}")
        object.__setattr__(self, "dt", positive("MinkLimit.dt", self.dt))
        if self.model is None and not isinstance(self.limit, mink.VelocityLimit):
            model = getattr(self.limit, "model", None)
            if model is None:
                raise InputError(
                    f"{type(self.limit).__name__} keeps no model: pass MinkLimit(limit, model)"
                )
            object.__setattr__(self, "model", model)

    @property
    def priority(self) -> Priority:  # type: ignore[override]
        if isinstance(self.limit, mink.VelocityLimit | mink.FreeJointVelocityLimit):
            return Priority.CAP
        if isinstance(self.limit, mink.ConfigurationLimit):
            return Priority.RANGE
        return Priority.CLEARANCE

    def level(self, grasp: Grasp) -> Level:
        # mink's VelocityLimit reads no configuration, and keeps no model to make one from.
        name = type(self.limit).__name__
        configuration: Any = self.model and configuration_of(self.model, grasp.q_full, name)
        G, h = self.limit.compute_qp_inequalities(configuration, self.dt)
        if G is None or h is None:
            return Level(np.zeros((0, grasp.n)), np.zeros(0), np.zeros(0), name)
        A = G @ grasp.coupling
        kept = np.isfinite(h)
        return Level(A[kept], np.full(kept.sum(), -np.inf), h[kept], name)
