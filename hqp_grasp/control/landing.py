"""Landing: correct a step by the hand's own kinematics, so that the tips arrive where it says."""

from __future__ import annotations

import numpy as np

from hqp_grasp.grasp import Grasp
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.hierarchy.level import Level
from hqp_grasp.tasks import Stack
from hqp_grasp.world.robot import Robot

LANDING_DAMPING = 1e-2  # [m/rad] tips that move less than this with the joints are let be


def land(
    robot: Robot,
    stack: Stack,
    grasp: Grasp,
    x: np.ndarray,
    corrections: int = 3,
    landed: float = 1e-6,
) -> np.ndarray:
    """Correct x (n,) [rad] until the tips are within `landed` [m] of where J x puts them.

    A correction that is not certified is not made: the x before it keeps the limits.
    """
    limits = stack.limit_levels(grasp)
    goal = robot.carried(grasp, grasp.q)[0] + grasp.jacobian @ x
    damping = LANDING_DAMPING * np.eye(grasp.n)
    hqp = HQP("active-set")
    for _ in range(corrections):
        there, J = robot.carried(grasp, grasp.q + x)
        rest = goal - there
        if np.abs(rest).max() < landed:
            break
        levels = [
            Level(v.A, np.minimum(v.lower - v.A @ x, 0.0), np.maximum(v.upper - v.A @ x, 0.0))
            for v in limits
        ]
        A = np.concatenate([J, damping])
        b = np.concatenate([rest, np.zeros(grasp.n)])
        correction = hqp.solve([*levels, Level.equal(A, b, "landing")])
        if not correction.certified:
            break
        x = x + correction.x
    return x
