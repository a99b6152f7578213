"""The alignment law: each palm faces what its contacts touch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hqp_grasp.errors import InputError, SingularTaskError
from hqp_grasp.grasp import Frame, Grasp
from hqp_grasp.tasks.contact_space import cross_matrices
from hqp_grasp.tasks.stack import Task

STRAIGHT = 1e-9  # [–] a sine below this tells no direction
CANCEL = 1e-9  # [–] shorter mean normals have no direction


@dataclass(frozen=True)
class AlignTask(Task):
    """Each palm's approach axis goes along −n̄, the mean normal of its group's contacts turned over.

    With R_world_palm of a frame of the grasp, whose z axis is the approach axis, t = −Rᵀ n̄/|n̄| is
    where that axis should point, in the palm's frame, θ its angle to it and a the axis of the
    rotation there, a ⟂ z. The error is the rotation vector's two entries, −θ (a_x, a_y) [rad], for
    each group: the turn about the approach axis stays free. Normals are held fixed.

    Where the axis points the opposite way, every direction leads back, and it turns about the
    palm's opposition axis. Where the normals of a group cancel, as those of fingers around a thing
    do, it has no side to face: SingularTaskError.
    """

    @property
    def unit(self) -> str:
        return "rad"

    def error(self, grasp: Grasp) -> np.ndarray:
        """−θ (a_x, a_y) of each palm (2g,) [rad], in the palm's frame."""
        turns = (_turn(_wanted(frame, grasp)) for frame in _frames(grasp))
        return np.concatenate([-theta * a for theta, a in turns])

    def jacobian(self, grasp: Grasp) -> np.ndarray:
        """∂error/∂q (2g, n) [–].

        Where the axis points the opposite way the error jumps; there it is the slope of the way
        back alone.
        """
        blocks = []
        for frame in _frames(grasp):
            t = _wanted(frame, grasp)
            theta, a = _turn(t)
            sine = float(np.hypot(t[0], t[1]))
            # t = (sin θ a_y, −sin θ a_x, cos θ), so that dθ and da, which is across a, are:
            dtheta = np.array([t[2] * a[1], -t[2] * a[0], -sine])
            da = np.outer([-a[1], a[0]], [a[0], a[1], 0.0])  # times sin θ
            per_sine = theta / sine if sine > STRAIGHT else float(t[2] > 0.0)
            # As the palm turns by ω in its own frame, t changes by t × ω.
            slope = -(np.outer(a, dtheta) + per_sine * da) @ cross_matrices(t)
            blocks.append(slope @ _turning(frame))
        return np.concatenate(blocks)

    def rows(self, grasp: Grasp) -> tuple[np.ndarray, np.ndarray]:
        """Rows that ask each palm to turn by θ about a: ω_x, ω_y = gain θ (a_x, a_y).

        That is the Newton step: the two differ by a factor that leaves a turn about a as it is,
        and which grows without bound towards the opposite way.
        """
        A = np.concatenate([_turning(frame)[:2] for frame in _frames(grasp)])
        return self.weight * A, (-self.weight * self.gain) * self.error(grasp)


def _frames(grasp: Grasp) -> tuple[Frame, ...]:
    if not grasp.frames:
        raise InputError(
            "AlignTask needs palms: give the Grasp frames, one for each group of contacts, as "
            "robot.grasp does"
        )
    return grasp.frames


def _wanted(frame: Frame, grasp: Grasp) -> np.ndarray:
    """t (3,), where the approach axis should point, in the palm's frame."""
    own = [contact.normal for contact in grasp.contacts if contact.group == frame.name]
    if not own:
        raise InputError(
            f"AlignTask: no contact belongs to the group {frame.name!r}; groups of the contacts "
            f"are: {', '.join(sorted({repr(c.group) for c in grasp.contacts}))}"
        )
    mean = np.mean(own, axis=0)
    length = float(np.linalg.norm(mean))
    if length < CANCEL:
        raise SingularTaskError(
            f"AlignTask: the normals of the group {frame.name!r} cancel, so its palm has no side "
            "to face"
        )
    return np.asarray(frame.rotation.T @ (mean / -length))


def _turn(t: np.ndarray) -> tuple[float, np.ndarray]:
    """Angle θ from z to t (3,), and (a_x, a_y) of the unit axis z × t; the x axis where all do."""
    sine = float(np.hypot(t[0], t[1]))
    axis = np.array([-t[1], t[0]]) / sine if sine > STRAIGHT else np.array([1.0, 0.0])
    return float(np.arctan2(sine, t[2])), axis


def _turning(frame: Frame) -> np.ndarray:
    """The palm's angular velocity by the joints (3, n), in its own frame."""
    return np.asarray(frame.rotation.T @ frame.jacobian[3:])
