"""Touching by geometry: open, move, close each finger until its link meets the object."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import mujoco
import numpy as np

from hqp_grasp.errors import InputError, instance, one_of
from hqp_grasp.grasp import Contact, Grasp, Miss, Missed
from hqp_grasp.world.objects import OBJECT
from hqp_grasp.world.robot import CAPSULE, CYLINDER, SPHERE, Robot
from hqp_grasp.world.scene import Scene

RETREAT = 0.35  # [rad] each finger opens by this much before the hand moves,
WITHDRAWAL = 0.03  # [m] and each palm that its arm closes goes back by this
ADVANCE = 0.1  # [m] such a palm comes on by, at most, along postures that are apart by
STRIDE = 5e-3  # [m]
STRAIGHT = (
    1.05  # [–] no point of it moves faster than the palm is to, the way being nearly straight
)
TOUCH = 1e-9  # [m] gap at which a ball touches
# Two meshes at gap 0 have no direction between them: there a touch ends within these gaps.
CLOSE = (1e-9, 1e-8)  # [m]
OVERLAP = 1e-7  # [m] a link this deep in the object touches it
NEAR = 5e-3  # [m] gap below which Newton's method finds the touch
MAX_CLOSING_STEPS = 2000  # tens, but for tips that graze
# [rad] over which the place of a touch is averaged on a link that is no ball; a flat on a cylinder
# of 50 mm then touches within 5 mm of where it is tangent, and no end farther off counts; and
# where a capsule of 40 mm lies along the object its touch moves by 3.5 mm a degree.
TILT = 0.1
ON_SIDE = 0.7  # [–] cosine of the normal to a cylinder's axis, below which its side touches
FAR = 2e-2  # [m] beyond this from the object a finger does not aim at it
CLEAR = 2e-3  # [m] a link is lifted by to be tilted free of the object
POSTURES = 10  # of a move, at each of which links may meet the object
REACH = 0.5  # [m] gaps beyond this are not measured
ANYWHERE = 100.0  # [m]
ALL_THE_WAY = 100.0  # [rad] more than any range


class _Near(NamedTuple):
    """Where a link and the object are nearest to one another."""

    gap: float  # [m] negative inside
    link: np.ndarray  # (3,) [m] of the link's surface, world
    normal: np.ndarray  # (3,) outward from the object
    radius: float  # [m] that the link is rounded by there


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
    _links: tuple[int, ...] = field(init=False, repr=False)  # geom ids of all else that can touch
    _objects: tuple[int, ...] = field(init=False, repr=False)  # geom ids of what is felt
    _round: tuple[bool, ...] = field(init=False, repr=False)  # each contact point is one ball
    _may_aim: bool = field(init=False, repr=False)  # some finger closes with several joints

    def __post_init__(self) -> None:
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731
        instance("GeometricProbe.scene", self.scene, Scene)
        one_of("links", self.links, ("pass", "block"))
        robot, model = self.scene.articulated, self.scene.model
        for point, way in zip(robot.description.contact_points, robot.closing, strict=True):
            if not way.any() and not point.by_arm:
                raise InputError(f"{point.name} has no flexion joint, and so cannot close")
        put("_local", threading.local())
        put("_round", tuple(bool(radius > 0.0) for radius in robot.tip_radius))
        put("_may_aim", any(len(gamma) > 1 for gamma in robot.flexion))
        touching = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        tips = {g for geoms in robot.geoms for g in geoms}
        objects = touching & (model.geom_bodyid == model.body(OBJECT).id)
        put("_objects", tuple(int(g) for g in np.flatnonzero(objects)))
        links = np.flatnonzero(touching & ~objects).tolist()
        put("_links", tuple(g for g in links if g not in tips))

    @property
    def _data(self) -> mujoco.MjData:
        try:
            data: mujoco.MjData = self._local.data
        except AttributeError:
            data = self._local.data = mujoco.MjData(self.scene.model)
        return data

    def touch(self, q_target: np.ndarray) -> Grasp | Missed:
        """Move to q_target (n,) [rad], close every finger, and return the grasp felt there."""
        robot = self.scene.articulated
        q_target = robot.require_q("q_target", q_target).copy()
        ways = robot.closing
        found = self._close(q_target, ways)
        if isinstance(found, Missed):
            # A finger may pass the object by: then each closes towards what is nearest to it.
            if found.reason is not Miss.NO_TOUCH or not self._may_aim:
                return found
            robot.place(self._data, q_target)
            ways = self._aimed(q_target, ways, range(len(ways)))
            found = self._close(q_target, ways)
            if isinstance(found, Missed):
                return found
        if self._may_aim:
            q, closed = found
            near = [i for i, s in enumerate(closed) if ways[i].any() and abs(s) <= RETREAT]
            aimed = self._aimed(q, ways, near)
            pressed = self._close(q_target, aimed)
            found = found if isinstance(pressed, Missed) else pressed
        q = found[0]
        robot.place(self._data, q)
        others = self._others()
        if others and self.links == "block":
            return Missed(Miss.OTHER_LINK, others[0])
        return self._grasp(q, others)

    def in_transit(self, way: Sequence[np.ndarray]) -> tuple[str, ...]:
        """Links beside the contact points that meet the object along postures (n,) [rad], by name.

        Fingers are opened by RETREAT, as `touch` opens them before the hand moves. Between two
        postures of the `way` joints move together, and POSTURES are looked at.
        """
        robot = self.scene.articulated
        met: dict[str, None] = {}
        for start, end in pairwise(way):
            for q in np.linspace(start, end, POSTURES):
                opened = q.copy()
                for finger in self._fingers(q, robot.closing):
                    finger.put(opened, -finger.retreat)
                robot.place(self._data, opened)
                met |= dict.fromkeys(self._others())
        return tuple(met)

    def _others(self) -> tuple[str, ...]:
        """Links beside the contact points that are in the object, as the hand stands."""
        model, data = self.scene.model, self._data
        return tuple(
            model.geom(link).name
            for link in self._links
            if any(
                mujoco.mj_geomDistance(model, data, link, o, 0.0, None) < -OVERLAP
                for o in self._objects
            )
        )

    def _close(
        self, q_target: np.ndarray, ways: np.ndarray
    ) -> tuple[np.ndarray, list[float]] | Missed:
        """Open by RETREAT, then close every finger its way, q(s) = clip(q_target + s·way).

        `ways` (k, n) are signed; a finger's fastest joint moves by 1 rad while its s grows by 1.
        A palm that an arm closes has none: it comes first, fingers still open, straight along its
        approach axis, by 1 m while its s grows by 1.
        Returns the posture that touches, q (n,) [rad], and s (k) [rad, m] there.
        """
        robot = self.scene.articulated
        k, q, fingers = len(ways), q_target.copy(), self._fingers(q_target, ways)

        def place(s: list[float], which: Iterable[int]) -> None:
            for i in which:
                fingers[i].put(q, s[i])
            robot.place(self._data, q)

        s = [-finger.retreat for finger in fingers]
        place(s, range(k))
        gaps = [self._gap(i) for i in range(k)]
        if min(gaps) < 0.0:
            s = [finger.end(-1.0) for finger in fingers]
            place(s, range(k))
            gaps = [self._gap(i) for i in range(k)]
            if min(gaps) < 0.0:
                return self._missed(Miss.INSIDE, int(np.argmin(gaps)))
        for by_arm in (True, False):
            which = [i for i in range(k) if isinstance(fingers[i], _Palm) == by_arm]
            if by_arm and not which:
                continue
            missed = self._close_some(which, fingers, q, s, place)
            if missed is not None:
                return missed
        return q, s

    def _close_some(
        self,
        which: list[int],
        fingers: Sequence[_Finger | _Palm],
        q: np.ndarray,
        s: list[float],
        place: Callable[[list[float], Iterable[int]], None],
    ) -> Missed | None:
        """Close these fingers from s on, each to its first touch; the others stay."""
        robot = self.scene.articulated
        gaps = {i: self._gap(i) for i in which}
        if min(gaps.values(), default=0.0) < 0.0:  # the palm took it there
            return self._missed(Miss.INSIDE, min(gaps, key=lambda i: gaps[i]))
        ends = {i: fingers[i].end(1.0) for i in which}
        free, inside = dict(enumerate(s)), dict.fromkeys(which, np.inf)  # known to be so
        for _ in range(MAX_CLOSING_STEPS):
            moving = [i for i in which if not self._touches(i, gaps[i])]
            if not moving:
                return None
            J = None  # of balls' centres: along the normal they move as the touching points do
            for i in moving:
                if s[i] >= ends[i] and gaps[i] > 0.0:
                    return self._missed(Miss.NO_TOUCH, i)
                goal, fastest = gaps[i], fingers[i].fastest
                goal -= 0.0 if self._round[i] else sum(CLOSE) / 2.0
                step = goal / fastest  # cannot pass the first touch
                if gaps[i] < NEAR and (gaps[i] > 0.0 or self._round[i]):
                    near, way = self._nearest(i), fingers[i].direction(q)
                    if not self._round[i]:
                        speed = near.normal @ robot.link_jacobian(q, i, near.link) @ way
                    else:
                        J = robot.jacobian(q) if J is None else J
                        speed = near.normal @ (J[3 * i : 3 * i + 3] @ way)
                    closing_speed = -float(speed)
                    if closing_speed > 0.05 * fastest:
                        step = goal / closing_speed
                ahead = s[i] + step
                if not free[i] < ahead < inside[i]:
                    ahead = (free[i] + inside[i]) / 2.0
                s[i] = min(ahead, ends[i])
            place(s, moving)
            for i in moving:
                gaps[i] = self._gap(i)
                if gaps[i] < (0.0 if self._round[i] else CLOSE[0]):  # past the touch
                    inside[i] = min(inside[i], s[i])
                else:
                    free[i] = max(free[i], s[i])
        return self._missed(Miss.NO_TOUCH, moving[0])

    def _fingers(self, q: np.ndarray, ways: np.ndarray) -> list[_Finger | _Palm]:
        """How each contact point closes from q (n,) on, with these ways (k, n) of flexions."""
        robot = self.scene.articulated
        lower, upper, start = robot.q_lower.tolist(), robot.q_upper.tolist(), q.tolist()
        fastest = np.einsum("kn,kn->k", np.abs(ways), robot.reach).tolist()
        fingers: list[_Finger | _Palm] = []
        for i, (way, point) in enumerate(
            zip(ways.tolist(), robot.description.contact_points, strict=True)
        ):
            if point.by_arm:
                fingers.append(_Palm(robot, i, q))
                continue
            joints = [(j, start[j], lower[j], upper[j], v) for j, v in enumerate(way) if v]
            fingers.append(_Finger(joints, ways[i], fastest[i]))
        return fingers

    def _aimed(self, q: np.ndarray, ways: np.ndarray, which: Iterable[int]) -> np.ndarray:
        """The ways that change these fingers least, w = −(nᵀJ_γ)⁺; those of the others."""
        robot = self.scene.articulated
        aimed = ways.copy()
        for i in which:
            gamma = list(robot.flexion[i])
            near = self._nearest(i)
            if len(gamma) == 1 or near.gap >= FAR:
                continue
            way = -(near.normal @ robot.link_jacobian(q, i, near.link)[:, gamma])
            if np.abs(way).max() > 0.0:
                aimed[i, gamma] = way / np.abs(way).max()
        return aimed

    def _touches(self, i: int, gap: float) -> bool:
        return abs(gap) <= TOUCH if self._round[i] else CLOSE[0] <= gap <= CLOSE[1]

    def _gap(self, i: int) -> float:
        geoms = self.scene.articulated.geoms[i]
        if len(geoms) == 1:
            return self._distance(geoms[0], REACH)
        return min(self._distance(g, REACH) for g in geoms)

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
        gap, geom, link, thing = np.inf, -1, np.zeros(3), np.zeros(3)
        for one in self.scene.articulated.geoms[i]:
            ends = np.zeros(6)
            distance = self._distance(one, ANYWHERE, ends)
            if distance < gap:
                gap, geom, link, thing = distance, one, ends[:3], ends[3:]
        kind = model.geom_type[geom]
        if kind in (SPHERE, CAPSULE):
            # At zero gap the nearest points coincide and give no direction; the centre does.
            centre, radius = data.geom_xpos[geom], float(model.geom_size[geom, 0])
            if kind == CAPSULE:
                axis, half = data.geom_xmat[geom].reshape(3, 3)[:, 2], model.geom_size[geom, 1]
                centre = centre + np.clip((thing - centre) @ axis, -half, half) * axis
            away = centre - thing
            normal = away / math.sqrt(away @ away)
            return _Near(gap, centre - radius * normal, normal, radius)
        away = (link - thing) * (1.0 if gap > 0.0 else -1.0)
        normal = away / np.linalg.norm(away)
        on_side = kind == CYLINDER and abs(normal @ data.geom_xmat[geom][2::3]) < ON_SIDE
        return _Near(gap, link, normal, float(model.geom_size[geom, 0]) if on_side else 0.0)

    def _patch(self, i: int, near: _Near) -> Contact:
        """The contact of a link that is no ball: at the middle of its touching patch.

        A flat touches at the end that its least tilt chooses: the nearest point jumps by the
        flat's length as that tilt changes sign. Its mean over tilts of ±TILT about each tangent
        moves steadily. Since the gap's derivative with the tilt is the nearest point's place, that
        mean is (gap(+TILT) − gap(−TILT))/2 TILT.

        As the link turns by ω the middle runs along it by M (ω × n), with M (2, 2) in the tangents
        and its columns (place(−TILT) − place(+TILT))/2 TILT. A ball's M is its radius. A capsule's
        is that across, where the object's own edges may make it seem less, and up to its
        length/2 TILT more along its axis. Of what is not round half the trace is the radius.
        """
        data = self._data
        geoms = list(self.scene.articulated.geoms[i])
        pose = data.geom_xpos[geoms].copy(), data.geom_xmat[geoms].copy()
        middle, M = near.link.copy(), np.zeros((2, 2))
        one = np.cross(near.normal, np.eye(3)[np.abs(near.normal).argmin()])
        one /= np.linalg.norm(one)
        tangents = np.array([one, np.cross(near.normal, one)])
        lifted = near.link + CLEAR * near.normal
        for column, tangent in zip(M.T, tangents, strict=True):
            gaps, places = [], []
            for angle in (TILT, -TILT):
                R = _rotation(np.cross(tangent, near.normal), angle)
                data.geom_xpos[geoms] = (pose[0] - near.link) @ R.T + lifted
                data.geom_xmat[geoms] = (R @ pose[1].reshape(-1, 3, 3)).reshape(-1, 9)
                there = self._nearest(i)
                gaps.append(there.gap)
                places.append(tangents @ R.T @ (there.link - lifted))
            middle += (gaps[0] - gaps[1]) / (2.0 * np.sin(TILT)) * tangent
            column += (places[1] - places[0]) / (2.0 * np.sin(TILT))
        data.geom_xpos[geoms], data.geom_xmat[geoms] = pose
        runs, axes = np.linalg.eigh(0.5 * (M + M.T))
        radius = near.radius if near.radius > 0.0 else max(0.0, 0.5 * float(runs.sum()))
        beyond = np.maximum(runs, near.radius) - radius
        across = axes.T @ tangents
        stretch = (across.T * beyond) @ across
        return Contact(middle, near.normal, tip_radius=radius, stretch=stretch)

    def _grasp(self, q: np.ndarray, others: tuple[str, ...]) -> Grasp:
        robot = self.scene.articulated
        contacts = []
        for i, ball in enumerate(self._round):
            near = self._nearest(i)
            felt = Contact(near.link, near.normal, tip_radius=near.radius)
            contacts.append(felt if ball else self._patch(i, near))
        return robot.grasp(q, contacts, others)


class _Finger(NamedTuple):
    """Flexion joints that close a contact point, in proportion: q_j = at + s·v within its range."""

    joints: list[tuple[int, float, float, float, float]]  # j, at, lower, upper, v
    way: np.ndarray  # (n,)
    fastest: float  # [m/rad] no point of its link moves faster with s

    @property
    def retreat(self) -> float:
        return RETREAT

    def put(self, q: np.ndarray, s: float) -> None:
        """Set its joints in q (n,) as they are at s [rad]."""
        for j, at, low, high, speed in self.joints:
            q[j] = min(max(at + s * speed, low), high)

    def direction(self, q: np.ndarray) -> np.ndarray:
        """dq/ds (n,)."""
        return self.way

    def end(self, sign: float) -> float:
        """s [rad] at which the last of its joints reaches its range, as s grows or falls."""
        far = (
            ((high if sign * speed > 0.0 else low) - at) / speed
            for _, at, low, high, speed in self.joints
        )
        return sign * min(ALL_THE_WAY, max(sign * s for s in far))


class _Palm:
    """A palm that its arm closes, straight along the approach axis, s [m] ahead of where it was."""

    retreat = WITHDRAWAL
    fastest = STRAIGHT  # [–]

    def __init__(self, robot: Robot, point: int, q: np.ndarray) -> None:
        self._robot, self._point = robot, point
        group = robot.groups[robot.group_of(robot.description.contact_points[point].name)]
        self._arm = list(group.arm)
        self._ways = {sign: [q] for sign in (1.0, -1.0)}  # postures every STRIDE, ahead and behind

    def put(self, q: np.ndarray, s: float) -> None:
        """Set the arm's joints in q (n,) as they are at s."""
        way, at = self._ways[float(np.copysign(1.0, s))], abs(s) / STRIDE
        while len(way) < at + 1.0:
            way.append(self._next(way[-1], float(np.copysign(STRIDE, s))))
        one, share = int(at), at - int(at)
        two = min(one + 1, len(way) - 1)
        q[self._arm] = ((1.0 - share) * way[one] + share * way[two])[self._arm]

    def _next(self, q: np.ndarray, s: float) -> np.ndarray:
        half = q + 0.5 * s * self.direction(q)
        ahead = q + s * self.direction(half)
        return np.clip(ahead, self._robot.q_lower, self._robot.q_upper)

    def direction(self, q: np.ndarray) -> np.ndarray:
        """dq/ds (n,) [rad/m]."""
        return self._robot.closing_at(q)[self._point]

    def end(self, sign: float) -> float:
        """s [m] it may go to."""
        return sign * (ADVANCE if sign > 0.0 else WITHDRAWAL)


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation matrix (3, 3) about a unit axis (3,)."""
    quat, R = np.zeros(4), np.zeros(9)
    mujoco.mju_axisAngle2Quat(quat, axis, angle)
    mujoco.mju_quat2Mat(R, quat)
    return R.reshape(3, 3)
