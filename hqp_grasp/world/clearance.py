"""How near a robot's own links are to one another, and how that changes with the joints."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from itertools import combinations

import mujoco
import numpy as np

from hqp_grasp.kernels import njit
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
    _names: tuple[tuple[str, str], ...] = field(init=False, repr=False)  # p of them
    _balls: np.ndarray = field(init=False, repr=False)  # (p,) [m] both geoms' bounding radii
    _turns: np.ndarray = field(init=False, repr=False)  # (p, N) ±1: the joint moves one of the two
    at_home: tuple[tuple[str, str], ...] = field(init=False)  # pairs that touch there

    def __post_init__(self) -> None:
        robot, model = self.robot, self.robot.model
        pairs = _pairs(robot)
        data = mujoco.MjData(model)
        robot.place(data, robot.home)
        far = 2.0 * self.least
        home = np.full(len(pairs), far)
        balls = np.where(model.geom_rbound > 0.0, model.geom_rbound, np.inf)  # 0: a plane
        balls = balls[pairs].sum(axis=1)
        for i in _close(data.geom_xpos, pairs, balls, far):
            home[i] = mujoco.mj_geomDistance(model, data, *map(int, pairs[i]), far, None)
        apart = home > TOUCHES
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731
        put("pairs", pairs[apart])
        put("_least", np.minimum(self.least, 0.5 * home[apart]))
        put("_names", _names(model, pairs[apart]))
        put("_balls", balls[apart])
        one, other = _movers(model)[model.geom_bodyid[pairs[apart].T]]
        put("_turns", 1.0 * one - other)
        put("at_home", _names(model, pairs[~apart]))

    def near(self, q: np.ndarray, within: float) -> Clearances:
        """The pairs nearer than `within` [m] at q (n,)."""
        robot, model = self.robot, self.robot.model
        data = robot._at(q)
        close = _close(data.geom_xpos, self.pairs, self._balls, within)
        ends = np.zeros((len(close), 6))
        distance = np.array(
            [
                mujoco.mj_geomDistance(model, data, one, other, within, both)
                for (one, other), both in zip(self.pairs[close].tolist(), ends, strict=True)
            ]
        )
        away = ends[:, :3] - ends[:, 3:]
        length = np.sqrt((away * away).sum(axis=1))
        seen = (distance < within) & (length >= TOUCHES)
        close, distance = close[seen], distance[seen]
        u = away[seen] * (np.sign(distance) / length[seen])[:, None]
        # Both ends are on the line along u, where a joint moves one as fast as the other.
        rate = _along(model, data, ends[seen, :3], u) * self._turns[close]
        return Clearances(
            tuple([self._names[i] for i in close.tolist()]),
            distance,
            self._least[close],
            rate @ robot.coupling,
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
        put("bodies", np.array(bodies, dtype=int))
        put("centers", np.reshape(centers, (-1, 3)))
        put("radii", np.array(radii, dtype=float))

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
        if (a << 16) + b in excluded:  # MuJoCo has the lesser body first, whatever was written
            continue
        pairs.append((one, other))
    return np.reshape(pairs, (-1, 2)).astype(int)


@njit(cache=True, error_model="numpy")
def _close(centre, pairs, balls, within):  # type: ignore[no-untyped-def]
    """The pairs whose bounding balls are nearer than `within` [m]: others cannot be.

    `centre` (g, 3) [m] of the geoms' balls, `balls` (p,) [m] the radii of each pair, added up.
    """
    found = np.empty(len(pairs), np.int64)
    count = 0
    for i in range(len(pairs)):
        one, other = pairs[i, 0], pairs[i, 1]
        reach = within + balls[i]
        square = 0.0
        for a in range(3):
            square += (centre[one, a] - centre[other, a]) ** 2
        if square < reach * reach:
            found[count] = i
            count += 1
    return found[:count]


def _along(model: mujoco.MjModel, data: mujoco.MjData, p: np.ndarray, u: np.ndarray) -> np.ndarray:
    """How fast each joint moves what it carries at p (m, 3) [m] along u (m, 3): (m, N) [m/rad].

    a for a slide, and for a hinge u·(a × (p − c)) = a·(p × u) + u·(c × a).
    """
    a, c = data.xaxis, data.xanchor
    hinge = (model.jnt_type == int(mujoco.mjtJoint.mjJNT_HINGE))[:, None]
    straight = np.where(hinge, _cross(c, a), a)
    return u @ straight.T + _cross(p, u) @ (a * hinge).T


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a × b of rows (m, 3)."""
    return a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]


def _movers(model: mujoco.MjModel) -> np.ndarray:
    """(b, N) bool: which joints move each body."""
    moves = np.zeros((model.nbody, model.njnt), dtype=bool)
    for body in range(1, model.nbody):  # what carries a body comes before it
        moves[body] = moves[model.body_parentid[body]]
        moves[body] |= model.jnt_bodyid == body
    return moves


def _names(model: mujoco.MjModel, pairs: np.ndarray) -> tuple[tuple[str, str], ...]:
    return tuple((model.geom(one).name, model.geom(other).name) for one, other in pairs.tolist())
