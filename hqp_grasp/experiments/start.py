"""The paper's random starting postures: the palm faces the object from a drawn side and height."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from hqp_grasp.errors import ReachError
from hqp_grasp.grasp import Grasp, Miss
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.hierarchy.level import Level
from hqp_grasp.touch.probe import Probe
from hqp_grasp.world.robot import Robot
from hqp_grasp.world.scene import Scene

ADDUCTION = (np.radians(10.0), np.radians(90.0))  # [rad] (paper, section 4)
ELEVATION = (np.radians(30.0), np.radians(50.0))  # [rad] of the approach axis below horizontal
OFFSET = (-0.18, 0.18)  # [m] of the palm from the object's axis, in x and in y
ADVANCE = 0.01  # [m] the palm comes nearer by, while the fingers do not reach
UPRIGHT = 0.05  # [–] vertical part of the normal of an upright side, at most
MAX_DRAWS = 500  # draws before the object counts as out of reach
MAX_IK_STEPS = 60
IK_STEP = 0.3  # [rad]
IK_TOLERANCE = 1e-4  # [m, rad]


@dataclass(frozen=True, eq=False)
class Start:
    """A first touch, and what it took to find it."""

    grasp: Grasp
    rejected: int  # draws from which the hand could not touch


def first_touch(scene: Scene, probe: Probe, rng: np.random.Generator) -> Start:
    """Draw postures until the hand touches with every finger.

    Adduction, elevation and horizontal offset of the palm are uniform over the paper's ranges.
    What the paper leaves open: the approach axis meets the object's axis at its middle, from the
    robot's side (a draw beyond the object is mirrored), the opposition axis is horizontal, and
    the palm advances along the approach axis, by ADVANCE at a time, until all fingers reach. A
    draw is rejected where the arm cannot go, a fingertip meets an edge or the top instead of the
    upright side, or another link touches too.
    Raises ReachError after MAX_DRAWS draws without a touch.
    """
    robot = scene.articulated
    last = "none"
    for rejected in range(MAX_DRAWS):
        adduction = rng.uniform(*ADDUCTION)
        elevation = rng.uniform(*ELEVATION)
        offset = np.array([-abs(rng.uniform(*OFFSET)), rng.uniform(*OFFSET)])
        distance = float(np.linalg.norm(offset))
        while distance > 0.0:
            q = _reach(scene, adduction, elevation, distance, offset)
            if q is None:
                last = "the arm cannot reach the drawn posture"
                break
            touched = probe.touch(q)
            if isinstance(touched, Grasp):
                last = _flaw(touched)
                if not last:
                    return Start(touched, rejected)
                break
            last = f"{touched.reason.value} ({touched.where})"
            if touched.reason is not Miss.NO_TOUCH:
                break
            distance -= ADVANCE * np.cos(elevation)
    raise ReachError(
        f"{robot.description.name} touches the object at {scene.position} from none of {MAX_DRAWS} "
        f"drawn postures (the last: {last}); move the object, or take another"
    )


def _flaw(grasp: Grasp) -> str:
    """Why a touch is no start, empty where it is one."""
    if grasp.other_links:
        return f"{grasp.other_links[0]} touches the object"
    for contact in grasp.contacts:
        if abs(contact.normal[2]) > UPRIGHT:
            return f"{contact.name} meets an edge or the top of the object"
    return ""


def _reach(
    scene: Scene, adduction: float, elevation: float, distance: float, offset: np.ndarray
) -> np.ndarray | None:
    """Joints that bring the palm to `distance` on the side of `offset`, fingers open, or None."""
    robot = scene.articulated
    heading = -offset / np.linalg.norm(offset)
    z = np.array([*(np.cos(elevation) * heading), -np.sin(elevation)])
    p_palm = np.array(scene.position) - distance / np.cos(elevation) * z
    q = np.clip(robot.home, robot.q_lower, robot.q_upper)
    fixed = [j for (j,) in robot.flexion]
    q[fixed] = robot.q_lower[fixed]
    if robot.description.adduction is not None:
        spread = robot.index(robot.description.adduction)
        if not robot.q_lower[spread] <= adduction <= robot.q_upper[spread]:
            return None
        q[spread] = adduction
        fixed.append(spread)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    x *= np.sign(robot.palm(q)[1][:, 0] @ x) or 1.0
    R_palm = np.column_stack([x, np.cross(z, x), z])
    hqp = HQP()
    free = np.array([j for j in range(robot.n) if j not in fixed], dtype=int)
    keep = np.eye(robot.n)[fixed]
    for _ in range(MAX_IK_STEPS):
        p_now, R_now = robot.palm(q)
        error = np.concatenate([p_palm - p_now, _turn(R_now, R_palm)])
        if np.abs(error).max() < IK_TOLERANCE:
            return q
        levels = [
            Level(np.eye(robot.n), *_box(robot, q)),
            Level.equal(keep, np.zeros(len(fixed))),
            Level.equal(robot.palm_jacobian(q), error),
            Level.equal(np.eye(robot.n)[free], 0.1 * (robot.home - q)[free]),
        ]
        q = np.clip(q + hqp.solve(levels).x, robot.q_lower, robot.q_upper)
    return None


def _box(robot: Robot, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.maximum(-IK_STEP, robot.q_lower - q), np.minimum(IK_STEP, robot.q_upper - q)


def _turn(R: np.ndarray, R_goal: np.ndarray) -> np.ndarray:
    """Rotation vector (3,) [rad], world, from R to R_goal."""
    quaternion, turn = np.zeros(4), np.zeros(3)
    mujoco.mju_mat2Quat(quaternion, (R_goal @ R.T).ravel())
    mujoco.mju_quat2Vel(turn, quaternion, 1.0)
    return turn
