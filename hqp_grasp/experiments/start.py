"""Random starting postures as in the paper: the palm faces the object from a drawn side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from hqp_grasp.errors import InputError, ReachError
from hqp_grasp.grasp import Grasp, Miss
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.hierarchy.level import Level
from hqp_grasp.touch.probe import Probe
from hqp_grasp.world.robot import Robot
from hqp_grasp.world.scene import Scene

UPRIGHT = 0.05  # [–] vertical part of the normal of an upright side, at most
MAX_IK_STEPS = 60
IK_STEP = 0.3  # [rad]
IK_TOLERANCE = 1e-4  # [m, rad]


@dataclass(frozen=True, eq=False)
class FirstTouch:
    """Where a trial begins, and what it took to find it."""

    scene: Scene  # the scene asked for; a hand without an arm has been placed in it
    grasp: Grasp
    rejected: int  # draws from which the hand could not touch


@dataclass(frozen=True)
class Start:
    """Draws postures until the hand touches with every finger.

    Adduction, elevation and horizontal offset of the palm are uniform over the ranges; the
    defaults are the paper's (section 4). What it leaves open: the approach axis meets the object's
    axis at its middle, from the robot's side (a draw beyond the object is mirrored), the
    opposition axis is horizontal, and the palm advances along the approach axis, by `advance` at a
    time, until all fingers reach. A draw is rejected where the arm cannot go, a fingertip meets an
    edge or the top instead of the upright side, or another link touches too. A hand without an arm
    is placed where the draw says.
    """

    adduction: tuple[float, float] = (np.radians(10.0), np.radians(90.0))  # [rad]
    elevation: tuple[float, float] = (np.radians(30.0), np.radians(50.0))  # [rad] below horizontal
    offset: tuple[float, float] = (-0.18, 0.18)  # [m] of the palm from the object, in x and in y
    advance: float = 0.01  # [m] the palm comes nearer by, while the fingers do not reach
    max_draws: int = 500  # before the object counts as out of reach

    def __post_init__(self) -> None:
        for name in ("adduction", "elevation", "offset"):
            low, high = getattr(self, name)
            if not -np.inf < low <= high < np.inf:
                raise InputError(f"Start.{name} must be a range (low, high); got {(low, high)}")
        if not self.advance > 0.0 or self.max_draws < 1:
            raise InputError("Start needs an advance above 0 and at least 1 draw")

    def draw(
        self, scene: Scene, probe_in: Callable[[Scene], Probe], rng: np.random.Generator
    ) -> FirstTouch:
        """Return the first touch that a draw finds; raise ReachError after `max_draws` without.

        `probe_in` gives the probe that touches in a scene.
        """
        robot = scene.articulated
        last = "none"
        for rejected in range(self.max_draws):
            adduction = rng.uniform(*self.adduction)
            elevation = rng.uniform(*self.elevation)
            offset = np.array([-abs(rng.uniform(*self.offset)), rng.uniform(*self.offset)])
            distance = float(np.linalg.norm(offset))
            while distance > 0.0:
                p_palm, z = _palm_goal(scene, elevation, distance, offset)
                found = _reach(scene, adduction, p_palm, z)
                if found is None:
                    last = "the arm cannot reach the drawn posture"
                    break
                placed, q = found
                touched = probe_in(placed).touch(q)
                if isinstance(touched, Grasp):
                    last = _flaw(touched)
                    if not last:
                        return FirstTouch(placed, touched, rejected)
                    break
                last = f"{touched.reason.value} ({touched.where})"
                if touched.reason is not Miss.NO_TOUCH:
                    break
                distance -= self.advance * np.cos(elevation)
        raise ReachError(
            f"{robot.description.name} touches the object at {scene.position} from none of "
            f"{self.max_draws} drawn postures (the last: {last}); move the object, or take another"
        )


def _flaw(grasp: Grasp) -> str:
    """Why a touch is no start, empty where it is one."""
    if grasp.other_links:
        return f"{grasp.other_links[0]} touches the object"
    for contact in grasp.contacts:
        if abs(contact.normal[2]) > UPRIGHT:
            return f"{contact.name} meets an edge or the top of the object"
    return ""


def _palm_goal(
    scene: Scene, elevation: float, distance: float, offset: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where the palm goes (3,) [m] and its approach axis (3,), world, on the side of `offset`."""
    heading = -offset / np.linalg.norm(offset)
    z = np.array([*(np.cos(elevation) * heading), -np.sin(elevation)])
    return np.array(scene.position) - distance / np.cos(elevation) * z, z


def _reach(
    scene: Scene, adduction: float, p_palm: np.ndarray, z: np.ndarray
) -> tuple[Scene, np.ndarray] | None:
    """Joints that bring the palm to p_palm, fingers open; None where the arm cannot."""
    robot = scene.articulated
    q = np.clip(robot.home, robot.q_lower, robot.q_upper)
    fixed = [j for joints in robot.flexion for j in joints]
    q[fixed] = robot.q_lower[fixed]
    if robot.description.adduction is not None:
        spread = robot.index(robot.description.adduction)
        if not robot.q_lower[spread] <= adduction <= robot.q_upper[spread]:
            return None
        q[spread] = adduction
        fixed.append(spread)
    p_now, R_now = robot.palm(q)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    x *= np.sign(R_now[:, 0] @ x) or 1.0
    R_palm = np.column_stack([x, np.cross(z, x), z])
    if not robot.description.arm:
        turn = R_palm @ R_now.T
        return scene.rebased(p_palm - turn @ p_now, turn), q
    return _inverse_kinematics(scene, q, fixed, p_palm, R_palm)


def _inverse_kinematics(
    scene: Scene, q: np.ndarray, fixed: list[int], p_palm: np.ndarray, R_palm: np.ndarray
) -> tuple[Scene, np.ndarray] | None:
    robot = scene.articulated
    hqp = HQP()
    free = np.array([j for j in range(robot.n) if j not in fixed], dtype=int)
    keep = np.eye(robot.n)[fixed]
    for _ in range(MAX_IK_STEPS):
        p_now, R_now = robot.palm(q)
        error = np.concatenate([p_palm - p_now, _turn(R_now, R_palm)])
        if np.abs(error).max() < IK_TOLERANCE:
            return scene, q
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
