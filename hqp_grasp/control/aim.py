"""Where contacts should go, by all that was felt, and the levels that take them there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hqp_grasp.control.memory import LEANING, SurfaceMemory
from hqp_grasp.control.outline import Outline, directions
from hqp_grasp.grasp import Grasp
from hqp_grasp.hierarchy.level import Level
from hqp_grasp.tasks import ForceTask, MomentTask, Stack

DISTINCT = 10  # aims, at most
APART = 0.01  # [m] a contact's place differs by, between two aims
PURSUED = 8  # unbalanced grasps from which an aim is the nearest, before it seems farther
FARTHER = 0.01  # [m] of way that it seems farther, for each grasp more
ROOM = 0.01  # [m] kept from end faces that were felt
STILL = 1e-6  # [m] a contact that moves less has no direction


@dataclass(frozen=True, eq=False)
class Aim:
    """A place on the surface for every contact of a grasp, where their forces balance."""

    grasp: Grasp
    axis: np.ndarray  # a (3,), across which the outline lies
    outline: Outline
    s: np.ndarray  # (k,) [m] where on the outline contacts are
    places: np.ndarray  # (k,) [m] where they should be
    height: float  # [m] along the axis, of all of them
    end: np.ndarray  # (k,) which contacts are on an end face or its rim, off the outline
    cost: float  # [m²]

    @classmethod
    def each(cls, memory: SurfaceMemory, grasp: Grasp, vain: Sequence[Grasp] = ()) -> list[Aim]:
        """Aims that differ, the best first; none where every normal leans along the axis.

        `vain` are grasps that did not balance. The aim nearest to each of them is taken to have
        been pursued, and seems the farther, the more of them there are: another has its turn.
        """
        rho = _tip_radii(grasp)
        a = memory.axis(grasp)
        if not (np.abs(memory.normals @ a) < LEANING).any():
            return []
        outline = memory.outline(a, float(rho.mean()))
        s = outline.locate((grasp.positions + rho[:, None] * grasp.normals) @ outline.frame.T)
        cost, places = outline.balanced(s)
        end = np.abs(grasp.normals @ a) > LEANING
        height = _height(memory, grasp, a, end)
        aims: list[Aim] = []
        left = np.ones(len(cost), dtype=bool)
        while left.any() and len(aims) < DISTINCT:
            i = int(np.argmin(np.where(left, cost, np.inf)))
            left &= np.abs(places - places[i]).max(axis=1) > APART
            aims.append(cls(grasp, a, outline, s, places[i], height, end, float(cost[i])))
        if vain:
            x = np.concatenate([v.positions + rho[:, None] * v.normals for v in vain])
            there = outline.locate(x @ outline.frame.T).reshape(len(vain), -1)
            to = np.array([aim.places for aim in aims])
            nearest = (outline.way(there, to[:, None]) ** 2).sum(axis=-1).argmin(axis=0)
            pursued = np.bincount(nearest, minlength=len(aims))
            farther = FARTHER * np.maximum(pursued - PURSUED, 0.0)
            order = np.argsort([aim.cost for aim in aims] + farther * farther, kind="stable")
            aims = [aims[i] for i in order]
        return aims

    def predicted(self, share: float) -> tuple[np.ndarray, np.ndarray]:
        """Motion of the tips' centres (k, 3) [m] and normals (k, 3) after a share of the way.

        Along the outline the normal turns as the outline does. From an end face the way leads out
        beside the object, then along the axis.
        """
        grasp, E, a = self.grasp, self.outline.frame, self.axis
        n, rho = grasp.normals, _tip_radii(grasp)[:, None]
        rise = share * (self.height - (grasp.positions + rho * n) @ a)
        t0, x0 = self.outline.at(self.s)
        t1, x1 = self.outline.at(self.s + share * (self.places - self.s))
        across, turned = n @ E.T, np.empty((grasp.k, 2))
        c, s = np.cos(t1 - t0), np.sin(t1 - t0)
        turned[:, 0] = c * across[:, 0] - s * across[:, 1]
        turned[:, 1] = s * across[:, 0] + c * across[:, 1]
        after = _unit(turned @ E + (1.0 - share) * np.outer(n @ a, a))
        motion = (
            (x1 - x0) @ E + rho * (after - n) + np.outer(rise - rho[:, 0] * ((after - n) @ a), a)
        )
        if self.end.any():
            t, x = self.outline.at(self.places)
            side = directions(t) @ E
            goal = x @ E + rho * side + self.height * a
            straight = goal - grasp.positions - rho * n
            sink = np.outer(straight @ a, a)
            beside = straight - sink
            out = np.linalg.norm(beside, axis=1)[:, None]
            down = np.linalg.norm(sink, axis=1)[:, None]
            done = share * (out + down)
            straight = beside * np.minimum(done / np.maximum(out, STILL), 1.0)
            straight += sink * np.clip((done - out) / np.maximum(down, STILL), 0.0, 1.0)
            end = self.end[:, None]
            after = np.where(end, _unit((1.0 - share) * n + share * side), after)
            motion = np.where(end, straight, motion)
        return motion, after

    def levels(
        self, stack: Stack, share: float, asked: float = 1.0
    ) -> tuple[list[Level], list[Level]]:
        """The laws' levels for a share of the way: down to force and moment, and those below.

        The other laws ask for `asked` of their own steps, above force and moment as well as below.

        Force and moment have secant Jacobians, whose steps are exact for the predicted motion: with
        Δe_i what contact i adds to the error by its motion d_i, ∂e/∂x_i becomes
        ∂e/∂x_i (I − d_i d_iᵀ/|d_i|²) + Δe_i d_iᵀ/|d_i|². The motion itself is the level below them.
        """
        grasp = self.grasp
        motion, after = self.predicted(share)
        normals = grasp.normals
        far = np.linalg.norm(motion, axis=1)[:, None]
        d = np.where(far > STILL, motion / np.where(far > STILL, far, 1.0), 0.0)
        per_way = d / np.where(far > STILL, far, 1.0)
        aside = np.eye(3) - d[:, :, None] * d[:, None, :]
        moved = motion - _tip_radii(grasp)[:, None] * (after - normals)
        aimed: list[Level] = []
        below: list[Level] = []
        if stack.hold_contacts:
            rest = (normals * motion).sum(axis=1)
            aimed.append(Level.equal(grasp.normal_jacobian(), rest, "contact"))
        balance = [any(isinstance(t, ForceTask | MomentTask) for t in p) for p in stack.priorities]
        last = len(balance) - 1 - balance[::-1].index(True)
        for i, tasks in enumerate(stack.priorities):
            rows = []
            for task in tasks:
                if isinstance(task, ForceTask):
                    change = normals - after
                    J = _blocks(task, grasp) @ (np.eye(3) - np.outer(self.axis, self.axis))
                elif isinstance(task, MomentTask):
                    c = task.reference
                    c = grasp.positions.mean(axis=0) if isinstance(c, str) else np.array(c)
                    x = grasp.positions - c
                    change = np.cross(after, x + moved) - np.cross(normals, x)
                    J = _blocks(task, grasp)
                else:
                    A, b = task.rows(grasp)
                    rows.append((A, asked * b))
                    continue
                J = J @ aside + change[:, :, None] * per_way[:, None, :]
                J = J.transpose(1, 0, 2).reshape(3, -1) @ grasp.jacobian
                rows.append((task.weight * J, task.weight * change.sum(axis=0)))
            A, b = (np.concatenate(v) for v in zip(*rows, strict=True))
            name = " + ".join(task.name for task in tasks)
            (aimed if i <= last else below).append(Level.equal(A, b, name))
            if i == last:
                aimed.append(self._way(motion))
        return aimed, below

    def _way(self, motion: np.ndarray) -> Level:
        """Rows that ask for the motion itself: along the outline, and along the axis."""
        t, _ = self.outline.at(self.s)
        tangents = directions(t + 0.5 * np.pi) @ self.outline.frame
        J = self.grasp.jacobian.reshape(self.grasp.k, 3, -1)
        A = np.concatenate([np.einsum("ka,kan->kn", tangents, J), self.axis @ J])
        b = np.concatenate([(tangents * motion).sum(axis=1), motion @ self.axis])
        return Level.equal(A, b, "way")


def _height(memory: SurfaceMemory, grasp: Grasp, a: np.ndarray, end: np.ndarray) -> float:
    """Where along the axis all contacts should be [m]: three forces balance in one plane only.

    It is their mean; a contact whose normal leans would first move to the height of its ball's
    middle. End faces that were felt keep their distance.
    """
    x, lean = memory.positions @ a, memory.normals @ a
    middle = x - memory.radii * lean
    side = np.abs(lean) < LEANING
    if not end.all():
        z = float(middle[-grasp.k :][~end].mean())  # the newest points are this grasp's
    else:
        z = float(middle[side].mean() if side.any() else x.mean())
    top = x[lean > LEANING].min(initial=np.inf) - ROOM
    bottom = x[lean < -LEANING].max(initial=-np.inf) + ROOM
    return min(max(z, bottom), top) if bottom < top else 0.5 * (bottom + top)


def _blocks(task: ForceTask | MomentTask, grasp: Grasp) -> np.ndarray:
    """∂e/∂x_i of each contact (k, 3, 3)."""
    return task.contact_jacobian(grasp).reshape(3, -1, 3).transpose(1, 0, 2)


def _tip_radii(grasp: Grasp) -> np.ndarray:
    return np.array([c.tip_radius for c in grasp.contacts])


def _unit(v: np.ndarray) -> np.ndarray:
    return np.asarray(v / np.linalg.norm(v, axis=1)[:, None])
