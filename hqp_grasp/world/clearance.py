"""How near a robot's own links are to one another, and how that changes with the joints."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from itertools import combinations

import mujoco
import numpy as np

from hqp_grasp.world.robot import Robot

TOUCHES = 1e-6  # [m] links nearer than this touch


@dataclass(frozen=True, eq=False)
class Clearances:
    """Pairs of links that come near, the nearest pair of their geoms each."""

    names: tuple[tuple[str, str], ...]  # m pairs of geoms
    distance: np.ndarray  # (m,) [m] negative where they overlap
    least: np.ndarray  # (m,) [m] that they are to keep
    jacobian: np.ndarray  # (m, n) [m/rad] ∂distance/∂q


@dataclass(frozen=True, eq=False)
class SelfClearance:
    """The pairs of a robot's geoms that are to stay apart by `least` [m].

    Left out are pairs that cannot move against one another or share a joint, that the model
    excludes, and that touch at home by design. A pair that is nearer than twice `least` at home
    keeps half of what it has there.
    """

    robot: Robot
    least: float  # [m]
    pairs: np.ndarray = field(init=False)  # (p, 2) geom ids
    _least: np.ndarray = field(init=False, repr=False)  # (p,) [m]
    at_home: tuple[tuple[str, str], ...] = field(init=False)  # pairs that touch there

    def __post_init__(self) -> None:
        robot, model = self.robot, self.robot.model
        pairs = _pairs(robot)
        data = mujoco.MjData(model)
        robot.place(data, robot.home)
        far = 2.0 * self.least
        home = np.full(len(pairs), far)
        for i in np.flatnonzero(_bound(model, data, pairs) < far):
            home[i] = mujoco.mj_geomDistance(model, data, *map(int, pairs[i]), far, None)
        apart = home > TOUCHES
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731
        put("pairs", pairs[apart])
        put("_least", np.minimum(self.least, 0.5 * home[apart]))
        put("at_home", tuple(_names(model, pair) for pair in pairs[~apart]))

    def near(self, q: np.ndarray, within: float) -> Clearances:
        """The pairs nearer than `within` [m] at q (n,)."""
        robot, model = self.robot, self.robot.model
        data = robot._at(q)
        mujoco.mj_comPos(model, data)
        names, distances, least, rows = [], [], [], []
        for i in np.flatnonzero(_bound(model, data, self.pairs) < within):
            one, other = map(int, self.pairs[i])
            ends = np.zeros(6)
            distance = mujoco.mj_geomDistance(model, data, one, other, within, ends)
            away = ends[:3] - ends[3:]
            length = float(np.linalg.norm(away))
            if distance >= within or length < TOUCHES:
                continue
            J = np.zeros((2, 3, model.nv))
            for J_end, end, geom in zip(J, (ends[:3], ends[3:]), (one, other), strict=True):
                body = int(model.geom_bodyid[geom])
                mujoco.mj_jac(model, data, J_end, None, end, body)
            names.append(_names(model, self.pairs[i]))
            distances.append(distance)
            least.append(self._least[i])
            rows.append(np.sign(distance) * away / length @ (J[0] - J[1]) @ robot.coupling)
        return Clearances(
            tuple(names), np.array(distances), np.array(least), np.reshape(rows, (-1, robot.n))
        )

    def collisions(self, q: np.ndarray) -> tuple[tuple[str, str], ...]:
        """The pairs that overlap at q (n,)."""
        return self.near(q, 0.0).names


@dataclass(frozen=True, eq=False)
class LinkBalls:
    """The links that are to keep out of the object, each geom as balls along its longest side.

    Left out is what touches. A capsule is these balls; what is wider one way than the other counts
    by the mean of the two.
    """

    robot: Robot
    bodies: np.ndarray = field(init=False)  # (B,) ids
    centers: np.ndarray = field(init=False)  # (B, 3) [m], bodies' frames
    radii: np.ndarray = field(init=False)  # (B,) [m]

    def __post_init__(self) -> None:
        model = self.robot.model
        touching = {geom for geoms in self.robot.geoms for geom in geoms}
        bodies, centers, radii = [], [], []
        for g in set(_pairs(self.robot).ravel().tolist()) - touching:
            half = np.sort(model.geom_aabb[g, 3:])
            radius = float(half[:2].mean())
            R = np.zeros(9)
            mujoco.mju_quat2Mat(R, model.geom_quat[g])
            axis = R.reshape(3, 3)[:, int(model.geom_aabb[g, 3:].argmax())]
            middle = model.geom_pos[g] + R.reshape(3, 3) @ model.geom_aabb[g, :3]
            room = max(half[2] - radius, 0.0)
            for s in np.linspace(-room, room, 1 + 2 * int(np.ceil(room / radius))):
                bodies.append(int(model.geom_bodyid[g]))
                centers.append(middle + s * axis)
                radii.append(radius)
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731
        put("bodies", np.array(bodies))
        put("centers", np.array(centers))
        put("radii", np.array(radii))

    def depth(self, q: np.ndarray, u: np.ndarray, h: np.ndarray) -> float:
        """How deep [m] the deepest ball is in {x: u·x ≤ h}, u (m, 3) and h (m,) [m]; < 0: clear."""
        data = self.robot._at(q)
        R = data.xmat[self.bodies].reshape(-1, 3, 3)
        c = data.xpos[self.bodies] + (R @ self.centers[:, :, None])[:, :, 0]
        return float((self.radii - (c @ u.T - h).max(axis=1)).max(initial=-np.inf))


@lru_cache(maxsize=8)
def link_balls(robot: Robot) -> LinkBalls:
    """The links of a robot as balls, made once."""
    return LinkBalls(robot)


def _pairs(robot: Robot) -> np.ndarray:
    """Geoms (p, 2) that collide and move against one another."""
    model = robot.model
    weld = model.body_weldid
    above = weld[model.body_parentid[weld]]  # the next link towards the base
    excluded = set(model.exclude_signature.tolist())
    roots = set(model.body_rootid[[model.jnt_bodyid[j] for j in range(model.njnt)]].tolist())
    touching = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    own = [
        int(g)
        for g in np.flatnonzero(touching)
        if model.geom_bodyid[g] and model.body_rootid[model.geom_bodyid[g]] in roots
    ]
    pairs = []
    for one, other in combinations(own, 2):
        a, b = int(model.geom_bodyid[one]), int(model.geom_bodyid[other])
        u, v = int(weld[a]), int(weld[b])
        if u == v or above[a] == v or above[b] == u:
            continue
        if (a << 16) + b in excluded or (b << 16) + a in excluded:
            continue
        pairs.append((one, other))
    return np.reshape(pairs, (-1, 2)).astype(int)


def _bound(model: mujoco.MjModel, data: mujoco.MjData, pairs: np.ndarray) -> np.ndarray:
    """Distances (p,) [m] that the pairs are at least apart by."""
    one, other = pairs.T
    centres = np.linalg.norm(data.geom_xpos[one] - data.geom_xpos[other], axis=1)
    return centres - model.geom_rbound[one] - model.geom_rbound[other]


def _names(model: mujoco.MjModel, pair: np.ndarray) -> tuple[str, str]:
    one, other = (model.geom(int(g)).name for g in pair)
    return one, other
