"""Landing: correct a step by the hand's own kinematics, so that the tips arrive where it says."""

from __future__ import annotations

import numpy as np

from hqp_grasp.grasp import Grasp
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.hierarchy.level import Level
from hqp_grasp.tasks import Stack
from hqp_grasp.world.robot import Robot

LANDING_STEPS = 3
LANDED = 1e-6  # [m]
LANDING_DAMPING = 1e-2  # [m/rad] tips that move less than this with the joints are let be


def land(robot: Robot, stack: Stack, grasp: Grasp, x: np.ndarray) -> np.ndarray:
    """Correct x (n,) [rad] until the fingertips arrive where J x puts them, within the limits.

    A correction that is not certified is not made: the x before it keeps the limits.
    """
    limits = stack.limit_levels(grasp)
    goal = robot.carried(grasp, grasp.q)[0] + grasp.jacobian @ x
    damping = LANDING_DAMPING * np.eye(grasp.n)
    hqp = HQP("active-set")
    for _ in range(LANDING_STEPS):
        there, J = robot.carried(grasp, grasp.q + x)
        rest = goal - there
        if np.abs(rest).max() < LANDED:
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
