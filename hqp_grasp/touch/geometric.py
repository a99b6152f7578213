"""Touching by geometry: open, move, close each finger until its link meets the object."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from dataclasses import dataclass, field

import mujoco
import numpy as np

from hqp_grasp.errors import InputError, one_of
from hqp_grasp.grasp import Contact, Grasp, Miss, Missed
from hqp_grasp.world.objects import OBJECT
from hqp_grasp.world.robot import CAPSULE, SPHERE
from hqp_grasp.world.scene import Scene

RETREAT = 0.35  # [rad] each finger opens by this much before the hand moves
TOUCH = 1e-9  # [m] gap at which a ball touches
# Two meshes at gap 0 have no direction between them: there a touch ends within these gaps.
CLOSE = (1e-9, 1e-8)  # [m]
OVERLAP = 1e-7  # [m] a link this deep in the object touches it
NEAR = 5e-3  # [m] gap below which Newton's method finds the touch
MAX_CLOSING_STEPS = 2000  # tens, but for tips that graze
TILT = 0.3  # [rad] over which the place of a touch is averaged on a link that is no ball
FAR = 2e-2  # [m] beyond this from the object a finger does not aim at it
CLEAR = 2e-3  # [m] a link is lifted by to be tilted free of the object
REACH = 0.5  # [m] gaps beyond this are not measured
ANYWHERE = 100.0  # [m]
ALL_THE_WAY = 100.0  # [rad] more than any range


@dataclass(frozen=True, eq=False)
class _Near:
    """Where a link and the object are nearest to one another."""

    gap: float  # [m] negative inside
    link: np.ndarray  # (3,) [m] of the link's surface, world
    normal: np.ndarray  # (3,) outward from the object
    radius: float  # [m] that the link is rounded by there


@dataclass
class _Finger:
    """One finger on its way: q(s) = clip(q_target + s·way)."""

    way: np.ndarray  # (n,) signed; its fastest joint moves by 1 rad while s grows by 1
    s: float = 0.0  # [rad]
    gap: float = np.inf
    free: float = -np.inf  # the largest s known to touch nothing
    inside: float = np.inf  # the smallest s known to be inside


@dataclass(frozen=True, eq=False)
class GeometricProbe:
    """Touch without dynamics: exact distances between links and object, from MuJoCo.

    The hand moves to q_target with its fingers opened by RETREAT; then each closes, its joints in
    the proportion that the robot's description gives, to the first touch. A finger of several
    joints then feels the normal, opens again and closes along w = −(nᵀJ_γ)⁺, which changes its
    shape least. Closing overwrites the flexions.

    Other links feel the object too: a touch with one of them in it is a Missed. In the paper's
    simulation the object is felt with the fingertips only; with `links="pass"` the others pass
    through it likewise, and the grasp names them in `other_links`.

    Threads may share a probe: each works on data of its own.
    """

    scene: Scene
    links: str = "block"  # or "pass"
    _local: threading.local = field(init=False, repr=False)  # each thread's own MjData
    _links: np.ndarray = field(init=False, repr=False)  # geom ids of all else that can touch
    _objects: tuple[int, ...] = field(init=False, repr=False)  # geom ids of what is felt
    _round: tuple[bool, ...] = field(init=False, repr=False)  # each contact point is one ball

    def __post_init__(self) -> None:
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731
        one_of("links", self.links, ("pass", "block"))
        robot, model = self.scene.articulated, self.scene.model
        for point, way in zip(robot.description.contact_points, robot.closing, strict=True):
            if not way.any():
                raise InputError(f"{point.name} has no flexion joint, and so cannot close")
        put("_local", threading.local())
        put("_round", tuple(bool(radius > 0.0) for radius in robot.tip_radius))
        touching = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        tips = {g for geoms in robot.geoms for g in geoms}
        objects = touching & (model.geom_bodyid == model.body(OBJECT).id)
        put("_objects", tuple(int(g) for g in np.flatnonzero(objects)))
        links = [g for g in np.flatnonzero(touching & ~objects) if g not in tips]
        put("_links", np.array(links, dtype=int))

    @property
    def _data(self) -> mujoco.MjData:
        if not hasattr(self._local, "data"):
            self._local.data = mujoco.MjData(self.scene.model)
        return self._local.data

    def touch(self, q_target: np.ndarray) -> Grasp | Missed:
        """Move to q_target (n,) [rad], close every finger, and return the grasp felt there."""
        robot = self.scene.articulated
        q_target = robot.require_q("q_target", q_target).copy()
        ways = list(robot.closing)
        found = self._close(q_target, ways)
        if isinstance(found, Missed):
            # A finger may pass the object by: then each closes towards what is nearest to it.
            robot.place(self._data, q_target)
            aimed = self._aimed(q_target, ways, range(len(ways)))
            if found.reason is not Miss.NO_TOUCH or aimed is None:
                return found
            found = self._close(q_target, aimed)
            if isinstance(found, Missed):
                return found
        q, fingers = found
        ways = [f.way for f in fingers]
        near = [i for i, f in enumerate(fingers) if abs(f.s) <= RETREAT]
        aimed = self._aimed(q, ways, near)
        if aimed is not None:
            pressed = self._close(q_target, aimed)
            found = found if isinstance(pressed, Missed) else pressed
        q = found[0]
        robot.place(self._data, q)
        others = tuple(
            self.scene.model.geom(int(link)).name
            for link in self._links
            if self._distance(int(link), 0.0) < -OVERLAP
        )
        if others and self.links == "block":
            return Missed(Miss.OTHER_LINK, others[0])
        return self._grasp(q, others)

    def _close(
        self, q_target: np.ndarray, ways: list[np.ndarray]
    ) -> tuple[np.ndarray, list[_Finger]] | Missed:
        """Open by RETREAT, then close every finger its way: the posture that touches."""
        robot = self.scene.articulated
        fingers = [_Finger(way, -RETREAT) for way in ways]
        q = self._posture(q_target, fingers)
        self._measure(q, fingers, range(len(fingers)))
        if min(f.gap for f in fingers) < 0.0:
            for f in fingers:
                f.s, f.free, f.inside = self._end(q_target, -f.way), -np.inf, np.inf
            q = self._posture(q_target, fingers)
            self._measure(q, fingers, range(len(fingers)))
            if min(f.gap for f in fingers) < 0.0:
                return self._missed(Miss.INSIDE, int(np.argmin([f.gap for f in fingers])))
        speed = [
            float(np.abs(f.way) @ reach) for f, reach in zip(fingers, robot.reach, strict=True)
        ]
        ends = [-self._end(q_target, f.way) for f in fingers]
        for _ in range(MAX_CLOSING_STEPS):
            moving = [i for i, f in enumerate(fingers) if not self._touches(i, f.gap)]
            if not moving:
                return q, fingers
            for i in moving:
                f = fingers[i]
                if f.s >= ends[i] and f.gap > 0.0:
                    return self._missed(Miss.NO_TOUCH, i)
                goal = f.gap - (0.0 if self._round[i] else sum(CLOSE) / 2.0)
                step = goal / speed[i]  # cannot pass the first touch
                if f.gap < NEAR and (f.gap > 0.0 or self._round[i]):
                    closing = self._closing_speed(q, i, f.way)
                    if closing > 0.05 * speed[i]:
                        step = goal / closing
                s = f.s + step
                if not f.free < s < f.inside:
                    s = (f.free + f.inside) / 2.0
                f.s = min(s, ends[i])
            q = self._posture(q_target, fingers)
            self._measure(q, fingers, moving)
        return self._missed(Miss.NO_TOUCH, moving[0])

    def _aimed(
        self, q: np.ndarray, ways: list[np.ndarray], which: Iterable[int]
    ) -> list[np.ndarray] | None:
        """The ways that change these fingers least, w = −(nᵀJ_γ)⁺, or None where `ways` are."""
        robot = self.scene.articulated
        aimed = list(ways)
        for i in which:
            gamma = list(robot.flexion[i])
            near = self._nearest(i)
            if len(gamma) == 1 or near.gap >= FAR:
                continue
            way = -(near.normal @ self._jacobian(q, i, near.link)[:, gamma])
            if np.abs(way).max() > 0.0:
                aimed[i] = np.zeros_like(ways[i])
                aimed[i][gamma] = way / np.abs(way).max()
        same = all(np.array_equal(way, other) for way, other in zip(ways, aimed, strict=True))
        return None if same else aimed

    def _touches(self, i: int, gap: float) -> bool:
        return abs(gap) <= TOUCH if self._round[i] else CLOSE[0] <= gap <= CLOSE[1]

    def _posture(self, q_target: np.ndarray, fingers: list[_Finger]) -> np.ndarray:
        robot = self.scene.articulated
        q = q_target.copy()
        for f in fingers:
            moving = f.way != 0.0
            moved = q_target[moving] + f.s * f.way[moving]
            q[moving] = np.clip(moved, robot.q_lower[moving], robot.q_upper[moving])
        robot.place(self._data, q)
        return q

    def _end(self, q_target: np.ndarray, way: np.ndarray) -> float:
        """−s at which the last joint of a finger reaches its range, going `way`."""
        robot = self.scene.articulated
        moving = way != 0.0
        room = np.where(way > 0.0, robot.q_upper - q_target, robot.q_lower - q_target)[moving]
        return -min(ALL_THE_WAY, float((room / way[moving]).max()))

    def _measure(self, q: np.ndarray, fingers: list[_Finger], which: Iterable[int]) -> None:
        for i in which:
            f = fingers[i]
            f.gap = min(self._distance(g, REACH) for g in self.scene.articulated.geoms[i])
            if f.gap < 0.0:
                f.inside = min(f.inside, f.s)
            else:
                f.free = max(f.free, f.s)

    def _closing_speed(self, q: np.ndarray, i: int, way: np.ndarray) -> float:
        """[m/rad] at which the gap of contact point i shrinks."""
        near = self._nearest(i)
        return -float(near.normal @ self._jacobian(q, i, near.link) @ way)

    def _jacobian(self, q: np.ndarray, i: int, x: np.ndarray) -> np.ndarray:
        """∂x/∂q (3, n) [m/rad] of a point of link i that is at x (3,) [m], world."""
        robot = self.scene.articulated
        points = np.zeros((len(robot.geoms), 3))
        points[i] = robot.on_link(q, i, x)
        return robot.jacobian(q, points)[3 * i : 3 * i + 3]

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

    def _nearest(self, i: int) -> _Near:
        """Where contact point i is nearest to the object."""
        model, data = self.scene.model, self._data
        found = []
        for geom in self.scene.articulated.geoms[i]:
            ends = np.zeros(6)
            found.append((self._distance(geom, ANYWHERE, ends), geom, ends[:3], ends[3:]))
        gap, geom, link, thing = min(found, key=lambda near: near[0])
        kind, radius = model.geom_type[geom], 0.0
        if kind in (SPHERE, CAPSULE):
            # At zero gap the nearest points coincide and give no direction; the centre does.
            centre, radius = data.geom_xpos[geom], float(model.geom_size[geom, 0])
            if kind == CAPSULE:
                axis, half = data.geom_xmat[geom].reshape(3, 3)[:, 2], model.geom_size[geom, 1]
                centre = centre + np.clip((thing - centre) @ axis, -half, half) * axis
            away = centre - thing
            normal = away / np.linalg.norm(away)
            return _Near(gap, centre - radius * normal, normal, radius)
        away = (link - thing) * (1.0 if gap > 0.0 else -1.0)
        return _Near(gap, link, away / np.linalg.norm(away), 0.0)

    def _patch(self, i: int, near: _Near) -> tuple[np.ndarray, float]:
        """Middle of the touching patch (3,) [m], world, and the radius it is rounded by [m].

        A flat touches at the end that its least tilt chooses: the nearest point jumps by the
        flat's length as that tilt changes sign. Its mean over tilts of ±TILT about each tangent
        moves steadily. Since the gap's derivative with the tilt is the nearest point's place, that
        mean is (gap(+TILT) − gap(−TILT))/2 TILT; the radius is minus the second derivative.
        """
        data = self._data
        geoms = list(self.scene.articulated.geoms[i])
        pose = data.geom_xpos[geoms].copy(), data.geom_xmat[geoms].copy()
        middle, radius = near.link.copy(), 0.0
        one = np.cross(near.normal, np.eye(3)[np.abs(near.normal).argmin()])
        one /= np.linalg.norm(one)
        for tangent in (one, np.cross(near.normal, one)):
            gaps = []
            for angle in (TILT, -TILT):
                R = _rotation(np.cross(tangent, near.normal), angle)
                lifted = near.link + CLEAR * near.normal
                data.geom_xpos[geoms] = (pose[0] - near.link) @ R.T + lifted
                data.geom_xmat[geoms] = (R @ pose[1].reshape(-1, 3, 3)).reshape(-1, 9)
                gaps.append(min(self._distance(g, REACH) for g in geoms))
            middle += (gaps[0] - gaps[1]) / (2.0 * np.sin(TILT)) * tangent
            radius += max(0.0, near.gap + CLEAR - sum(gaps) / 2.0) / TILT**2  # mean of two
        data.geom_xpos[geoms], data.geom_xmat[geoms] = pose
        return middle, near.radius if near.radius > 0.0 else radius

    def _grasp(self, q: np.ndarray, others: tuple[str, ...]) -> Grasp:
        robot = self.scene.articulated
        contacts = []
        for i, ball in enumerate(self._round):
            near = self._nearest(i)
            place, radius = (near.link, near.radius) if ball else self._patch(i, near)
            contacts.append(Contact(place, near.normal, tip_radius=radius))
        return robot.grasp(q, contacts, others)


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation matrix (3, 3) about a unit axis (3,)."""
    quat, R = np.zeros(4), np.zeros(9)
    mujoco.mju_axisAngle2Quat(quat, axis, angle)
    mujoco.mju_quat2Mat(R, quat)
    return R.reshape(3, 3)
