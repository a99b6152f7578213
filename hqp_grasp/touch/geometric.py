"""Touching by geometry: open, move, close each finger until its tip meets the object."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from itertools import count

import mujoco
import numpy as np

from hqp_grasp.errors import InputError, one_of
from hqp_grasp.grasp import Contact, Grasp, Miss, Missed
from hqp_grasp.world.objects import OBJECT
from hqp_grasp.world.scene import Scene

RETREAT = 0.35  # [rad] each finger opens by this much before the hand moves
TOUCH = 1e-9  # [m] gap at which a tip touches
OVERLAP = 1e-7  # [m] a link this deep in the object touches it
NEAR = 5e-3  # [m] gap below which Newton's method finds the touch
MAX_CLOSING_STEPS = 2000  # tens, but for tips that graze
REACH = 0.5  # [m] gaps beyond this are not measured


@dataclass(frozen=True, eq=False)
class GeometricProbe:
    """Touch without dynamics: exact distances between the tips and the object, from MuJoCo.

    The hand moves to q_target with its flexions opened by RETREAT; then each finger closes along
    its flexion to the first touch, to TOUCH or better. Closing overwrites the flexions.

    Other links feel the object too: a touch with one of them in it is a Missed. In the paper's
    simulation the object is felt with the fingertips only; with `links="pass"` the others pass
    through it likewise, and the grasp names them in `other_links`.

    Threads may share a probe: each works on data of its own.
    """

    scene: Scene
    links: str = "block"  # or "pass"
    _local: threading.local = field(init=False, repr=False)  # each thread's own MjData
    _tips: np.ndarray = field(init=False, repr=False)  # geom ids (k,)
    _links: np.ndarray = field(init=False, repr=False)  # geom ids of all else that can touch
    _objects: tuple[int, ...] = field(init=False, repr=False)  # geom ids of what is felt
    _speed: np.ndarray = field(init=False, repr=False)  # (k,) [m/rad] no tip closes faster

    def __post_init__(self) -> None:
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731
        one_of("links", self.links, ("pass", "block"))
        robot, model = self.scene.articulated, self.scene.model
        for point, joints in zip(robot.description.contact_points, robot.flexion, strict=True):
            if len(joints) != 1:
                raise InputError(
                    f"{point.name} has {len(joints)} flexion joints; "
                    "the geometric probe closes one joint a finger"
                )
        put("_local", threading.local())
        tips = [model.geom(p.geom).id for p in robot.description.contact_points]
        put("_tips", np.array(tips))
        touching = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        objects = touching & (model.geom_bodyid == model.body(OBJECT).id)
        put("_objects", tuple(int(g) for g in np.flatnonzero(objects)))
        links = [g for g in np.flatnonzero(touching & ~objects) if g not in tips]
        put("_links", np.array(links, dtype=int))
        put("_speed", self._speed_bound())

    @property
    def _data(self) -> mujoco.MjData:
        if not hasattr(self._local, "data"):
            self._local.data = mujoco.MjData(self.scene.model)
        return self._local.data

    def _speed_bound(self) -> np.ndarray:
        # A tip turns about each joint that its flexion drives, at most at that joint's distance
        # with the finger stretched: sum ratio × distance over the range's sampled postures.
        robot = self.scene.articulated
        fastest = np.zeros(len(self._tips))
        for share in np.linspace(0.0, 1.0, 25):
            q = robot.home.copy()
            for (j,) in robot.flexion:
                q[j] = robot.q_lower[j] + share * (robot.q_upper[j] - robot.q_lower[j])
            J = robot.jacobian(q).reshape(len(self._tips), 3, -1)
            for i, (j,) in enumerate(robot.flexion):
                fastest[i] = max(fastest[i], np.linalg.norm(J[i, :, j]))
        return 1.1 * fastest

    def touch(self, q_target: np.ndarray) -> Grasp | Missed:
        """Move to q_target (n,) [rad], close every finger, and return the grasp felt there."""
        robot, data = self.scene.articulated, self._data
        q = robot.require_q("q_target", q_target).copy()
        flexion = [j for (j,) in robot.flexion]
        q[flexion] = np.maximum(robot.q_lower[flexion], q[flexion] - RETREAT)
        robot.place(data, q)
        gaps = [self._gap(i) for i in range(len(flexion))]
        if min(gaps) < 0.0:
            q[flexion] = robot.q_lower[flexion]
            robot.place(data, q)
            gaps = [self._gap(i) for i in range(len(flexion))]
            if min(gaps) < 0.0:
                return self._missed(Miss.INSIDE, int(np.argmin(gaps)))
        for _ in range(MAX_CLOSING_STEPS):
            moving = [i for i, gap in enumerate(gaps) if abs(gap) > TOUCH]
            if not moving:
                break
            J = None
            for i in moving:
                j = flexion[i]
                if q[j] >= robot.q_upper[j] and gaps[i] > 0.0:
                    return self._missed(Miss.NO_TOUCH, i)
                step = gaps[i] / self._speed[i]  # cannot pass the first touch
                if gaps[i] < NEAR:
                    if J is None:
                        J = robot.jacobian(q).reshape(len(flexion), 3, -1)
                    closing = -float(self._normal(i) @ J[i, :, j])
                    if closing > 0.05 * self._speed[i]:
                        step = gaps[i] / closing
                q[j] = min(q[j] + step, robot.q_upper[j])
            robot.place(data, q)
            for i in moving:
                gaps[i] = self._gap(i)
        else:
            return self._missed(Miss.NO_TOUCH, moving[0])
        others = tuple(
            self.scene.model.geom(int(link)).name
            for link in self._links
            if self._distance(int(link), 0.0) < -OVERLAP
        )
        if others and self.links == "block":
            return Missed(Miss.OTHER_LINK, others[0])
        return self._grasp(q, others)

    def _missed(self, reason: Miss, i: int) -> Missed:
        return Missed(reason, self.scene.articulated.description.contact_points[i].name)

    def _distance(self, geom: int, limit: float, ends: np.ndarray | None = None) -> float:
        """Distance to the nearest geom of the object, `limit` where all are farther.

        `ends` (6,) takes the nearest points, on `geom` and on the object.
        """
        model, data = self.scene.model, self._data
        nearest = limit
        for i, other in enumerate(self._objects):
            found = np.zeros(6) if ends is not None and i else ends
            distance = mujoco.mj_geomDistance(model, data, geom, other, limit, found)
            if distance < nearest:
                nearest = distance
                if ends is not None and i:
                    ends[:] = found
        return nearest

    def _gap(self, i: int) -> float:
        return self._distance(int(self._tips[i]), REACH)

    def _normal(self, i: int) -> np.ndarray:
        """Outward normal of the object where tip i is nearest, (3,).

        At zero gap the two nearest points coincide and give no direction, the tip's centre does.
        """
        ends = np.zeros(6)
        self._distance(int(self._tips[i]), REACH, ends)
        away = self._data.geom_xpos[self._tips[i]] - ends[3:]
        return away / np.linalg.norm(away)

    def _grasp(self, q: np.ndarray, others: tuple[str, ...]) -> Grasp:
        robot = self.scene.articulated
        contacts = []
        for center, radius, i in zip(robot.centers(q), robot.tip_radius, count(), strict=False):
            normal = self._normal(i)
            contacts.append(Contact(center - radius * normal, normal))
        return robot.grasp(q, contacts, others)
