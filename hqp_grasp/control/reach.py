"""Where the joints must be so that the palm is at a pose: inverse kinematics within the ranges."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.hierarchy.level import Level
from hqp_grasp.world.robot import Robot

MAX_STEPS = 60
STEP = 0.3  # [rad]
TOLERANCE = 1e-4  # [m, rad]
APART = 0.02  # [m] of the palm, at most, between two postures of a straight way


def reach(
    robot: Robot,
    q: np.ndarray,
    p_palm: np.ndarray,
    R_palm: np.ndarray,
    keep: Sequence[int],
    homing: float = 0.1,
    group: int = 0,
) -> np.ndarray | None:
    """Joints (n,) [rad], from q (n,) on, that bring a palm to p (3,) [m], R (3, 3), world.

    The joints `keep` stay; of the others those that the palm leaves free go home by the share
    `homing` of the way at a step. None where the arm cannot go there.
    """
    hqp = HQP("active-set")
    free = np.array([j for j in range(robot.n) if j not in keep], dtype=int)
    one = np.eye(robot.n)
    for _ in range(MAX_STEPS):
        p_now, R_now = robot.palm(q, group)
        error = np.concatenate([p_palm - p_now, _turn(R_now, R_palm)])
        if np.abs(error).max() < TOLERANCE:
            return q
        lower = np.maximum(-STEP, robot.q_lower - q)
        upper = np.minimum(STEP, robot.q_upper - q)
        levels = [
            Level(one, lower, upper),
            Level.equal(one[list(keep)], np.zeros(len(keep))),
            Level.equal(robot.palm_jacobian(q, group), error),
            Level.equal(one[free], homing * (robot.home - q)[free]),
        ]
        found = hqp.solve(levels)
        if not found.certified:
            return None
        q = np.clip(q + found.x, robot.q_lower, robot.q_upper)
    return None


def carried(
    robot: Robot, q: np.ndarray, by: np.ndarray, groups: Sequence[int] | None = None
) -> list[np.ndarray] | None:
    """Postures (n,) [rad] along which arms move palms straight by `by` (3,) [m], world.

    Those of `groups`, or all. Hands keep their joints, palms their orientation; an arm with joints
    to spare moves them as little as it can. None where one cannot go all the way.
    """
    chosen = range(len(robot.groups)) if groups is None else groups
    palms = {g: robot.palm(q, g) for g in chosen}
    count = max(1, int(np.ceil(np.linalg.norm(by) / APART)))
    way: list[np.ndarray] = []
    for share in np.arange(1, count + 1) / count:
        there = way[-1] if way else q
        for g, (p_palm, R_palm) in palms.items():
            keep = [j for j in range(robot.n) if j not in robot.groups[g].arm]
            found = reach(robot, there, p_palm + share * by, R_palm, keep, 0.0, g)
            if found is None:
                return None
            there = found
        way.append(there)
    return way


def _turn(R: np.ndarray, R_goal: np.ndarray) -> np.ndarray:
    """Rotation vector (3,) [rad], world, from R to R_goal."""
    quaternion, turn = np.zeros(4), np.zeros(3)
    mujoco.mju_mat2Quat(quaternion, (R_goal @ R.T).ravel())
    mujoco.mju_quat2Vel(turn, quaternion, 1.0)
    return turn
