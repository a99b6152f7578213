"""A described robot, compiled: its independent joints, and how the points it touches with move."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path

import mujoco
import numpy as np

from hqp_grasp.errors import InputError, ModelError, instance
from hqp_grasp.grasp import Contact, Frame, Grasp
from hqp_grasp.mechanics import cross
from hqp_grasp.world.compiling import compiled_spec
from hqp_grasp.world.description import (
    SLIDE_SPEED,
    SPEED,
    ContactPoint,
    Group,
    Palm,
    RobotDescription,
    ball_name,
    nearest,
    palm_site,
)

SPHERE, CAPSULE = int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_CAPSULE)
CYLINDER = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
CONVEX = [SPHERE, CAPSULE, CYLINDER] + [
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")) for kind in ("ELLIPSOID", "BOX", "MESH")
]
LINKS = {  # equalities of two links, and what they do
    int(mujoco.mjtEq.mjEQ_CONNECT): "closes a loop of links",
    int(mujoco.mjtEq.mjEQ_WELD): "welds two links",
}
HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)

PARALLEL = 0.7  # [–] cosine of two joint axes that bend a finger alike
SLIDE_UNIT = 0.06  # [m] a slide closes by while a hinge closes by 1 rad
STRAIGHT = 0.5  # [–] cosine above which a point goes for the others rather than across
LEAN = 0.5  # [rad] a range that goes no further on one side than this bends to the other
STEPS = 10  # places along 1 rad of closing in which the nearest is looked for
UNLIMITED = 1.0  # [rad, m] a joint without range opens and closes by from where it is
HELD = 1e-9  # [rad] rounding, of a joint that is held at the end of its range
SINGULAR = 1e-3  # [–] of a palm's Jacobian, below which its arm cannot go there
CENTRED = 1e-9  # [m] a contact point's site and its geom's centre agree to this


_BALL_JOINT = "three hinges turn as a ball does"
MEASURES = {  # of a compiled model, which MuJoCo takes as they are, numbers or not
    "body": ("pos", "quat", "mass", "inertia"),
    "jnt": ("pos", "axis", "range"),
    "geom": ("pos", "quat", "size"),
    "site": ("pos", "quat"),
}


@dataclass(frozen=True, eq=False)
class RobotGroup:
    """A palm, what carries it, and the contact points on it."""

    name: str
    points: tuple[int, ...]  # of the robot's contact points
    arm: tuple[int, ...]  # joints that carry the palm, into q
    adduction: int | None  # joint that spreads the fingers, into q
    palm_body: int
    p_palm: np.ndarray  # (3,) [m] in that body's frame
    R_palm: np.ndarray  # (3, 3) z approach axis, x opposition axis, in that body's frame


@dataclass(frozen=True, eq=False, repr=False)
class Robot:
    """A described robot inside a compiled MuJoCo model.

    Control works on the n independent joints q; all N joints of the model follow as C q + c₀,
    where C and c₀ come from the model's joint and fixed-tendon equalities. Raises ModelError
    where the model lacks a name of the description.
    """

    description: RobotDescription
    model: mujoco.MjModel
    joints: tuple[str, ...] = field(init=False)  # n independent ones, in the model's order
    coupling: np.ndarray = field(init=False)  # C (N, n)
    offset: np.ndarray = field(init=False)  # c₀ (N,) [rad]
    lower: np.ndarray = field(init=False)  # (N,) ranges of all joints [rad], −inf where none
    upper: np.ndarray = field(init=False)  # (N,)
    q_lower: np.ndarray = field(init=False)  # (n,) ranges of q that keep every joint in its own
    q_upper: np.ndarray = field(init=False)  # (n,)
    velocity: np.ndarray = field(init=False)  # (n,) [rad/s]
    home: np.ndarray = field(init=False)  # (n,) [rad]
    flexion: tuple[tuple[int, ...], ...] = field(init=False)  # for each contact point, into q
    closing: np.ndarray = field(init=False)  # (k, n) [rad] how q moves as a point closes, signed
    groups: tuple[RobotGroup, ...] = field(init=False)  # whose contact points touch, in turn
    arm: tuple[int, ...] = field(init=False)  # joints that carry a palm, into q
    idle: np.ndarray = field(init=False)  # (n,) bool: moves no contact point, as the other arm's
    geoms: tuple[tuple[int, ...], ...] = field(init=False)  # that touch, for each contact point
    tip_radius: np.ndarray = field(init=False)  # (k,) [m] of a round tip, 0 for other shapes
    reach: np.ndarray = field(init=False)  # (k, n) [m/rad] no point of a link moves faster
    _points: np.ndarray = field(init=False, repr=False)  # (k, 3) [m] centres, link frames
    _bodies: np.ndarray = field(init=False, repr=False)  # (k,) links
    _balls: np.ndarray | None = field(init=False, repr=False)  # (k,) geoms where all are balls
    _hinge: np.ndarray = field(init=False, repr=False)  # (N,) bool
    _ancestor: np.ndarray = field(init=False, repr=False)  # (k, N) bool: joint j moves point i
    _nearer_base: np.ndarray = field(init=False, repr=False)  # (N, N) bool: j at or above l
    _local: threading.local = field(init=False, repr=False)  # each thread's own MjData

    def __post_init__(self) -> None:
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731
        model, about = self.model, self.description
        instance("Robot.description", about, RobotDescription)
        instance("Robot.model", model, mujoco.MjModel)
        for j in range(model.njnt):
            if model.jnt_type[j] not in (HINGE, SLIDE):
                name = model.joint(j).name
                free = model.jnt_type[j] == int(mujoco.mjtJoint.mjJNT_FREE)
                raise ModelError(
                    f"joint {name!r} of {about.name} is neither hinge nor slide; "
                    "a robot here has a fixed base and one-dimensional joints: "
                    + (f'lock = ["{name}"] fixes a free base' if free else _BALL_JOINT)
                )
        _refuse_no_numbers(model, about)
        put("_local", threading.local())
        put("_hinge", model.jnt_type == HINGE)
        # Joints are numbered from the base outwards, so the smaller number is nearer the base.
        put("_nearer_base", np.triu(np.ones((model.njnt, model.njnt), dtype=bool)))
        names = [model.joint(j).name for j in range(model.njnt)]
        C, c0, independent = _couplings(model)
        put("coupling", C)
        put("offset", c0)
        put("joints", tuple(names[j] for j in independent))
        limited = model.jnt_limited.astype(bool)
        lower = np.where(limited, model.jnt_range[:, 0], -np.inf)
        upper = np.where(limited, model.jnt_range[:, 1], np.inf)
        put("lower", lower)
        put("upper", upper)
        q_lower, q_upper = _ranges_of_independent(C, c0, lower, upper)
        put("q_lower", q_lower)
        put("q_upper", q_upper)
        self._refuse_stuck(names)
        put("velocity", self._velocity(independent))
        put("home", self._home(independent))
        links = [_link(model, point, about) for point in about.contact_points]
        put("_bodies", np.array([link.body for link in links]))
        put("geoms", tuple(link.geoms for link in links))
        put("_points", np.array([link.centre for link in links]))
        balls = all(link.radius > 0.0 for link in links)
        put("_balls", np.array([link.geoms[0] for link in links]) if balls else None)
        put("tip_radius", np.array([link.radius for link in links]))
        chains = [_chain(model, link.body) for link in links]
        put("_ancestor", np.array([np.isin(np.arange(model.njnt), c) for c in chains]))
        moves = self._ancestor @ (C != 0.0)  # (k, n)
        put("idle", ~moves.any(axis=0))
        put("reach", np.array([_reach(model, v) for v in links]) @ np.abs(C))
        self._refuse_coupled(chains)
        put("closing", self._closing(independent, moves))
        put("flexion", tuple(tuple(np.flatnonzero(w).tolist()) for w in self.closing))
        put("groups", tuple(self._groups()))
        put("arm", tuple(sorted({j for group in self.groups for j in group.arm})))
        self._refuse_sidelong()

    def _refuse_sidelong(self) -> None:
        """Raise where an arm that is to close a contact point does not bring it on, at home."""
        ways = self.closing_at(self.home)
        J = self.jacobian(self.home).reshape(-1, 3, self.n)
        for g, group in enumerate(self.groups):
            axis = self.palm(self.home, g)[1][:, 2]
            for i in group.points:
                point = self.description.contact_points[i]
                if point.by_arm and axis @ J[i] @ ways[i] < SINGULAR:
                    arm = ", ".join(self.joints[j] for j in group.arm)
                    raise ModelError(
                        f"the arm of group {group.name!r} of {self.description.name}, {arm}, does "
                        f"not bring {point.name!r} on along the palm's approach axis "
                        f"{np.round(axis, 3)} at home: another home, palm or arm"
                    )

    def _refuse_stuck(self, names: Sequence[str]) -> None:
        """Raise where couplings leave a joint no range, or a single angle."""
        for j in np.flatnonzero(~(self.q_lower < self.q_upper)).tolist():
            joint, low, high = self.joints[j], self.q_lower[j], self.q_upper[j]
            driven = [
                f"{names[i]} = {self.coupling[i, j]:g}·{joint} + {self.offset[i]:g} must stay in "
                f"[{self.lower[i]:g}, {self.upper[i]:g}]"
                for i in np.flatnonzero(self.coupling[:, j]).tolist()
                if names[i] != joint
            ]
            left = f"only the angle {low:g}" if low == high else "no angle at all"
            raise ModelError(
                f"couplings and ranges leave joint {joint!r} of {self.description.name} {left}"
                + "".join(f"; {what}" for what in driven)
                + f'; drop_couplings = ["{names[int(np.flatnonzero(self.coupling[:, j])[-1])]}"] '
                "frees it, ranges or lock say otherwise"
            )

    def _velocity(self, independent: list[int]) -> np.ndarray:
        about = self.description
        for joint in about.velocity:
            self.index(joint)
        slides = self.model.jnt_type[independent] == SLIDE
        default = np.where(slides, SLIDE_SPEED, SPEED) if about.speed is None else about.speed
        velocity = np.full(self.n, default)
        for joint, speed in about.velocity.items():
            velocity[self.index(joint)] = speed
        return velocity

    def _home(self, independent: list[int]) -> np.ndarray:
        model, about = self.model, self.description
        home = np.clip(model.qpos0[independent], self.q_lower, self.q_upper)
        for joint, angle in about.home.items():
            if joint in self.joints:  # the others follow
                home[self.index(joint)] = angle
        outside = (home < self.q_lower) | (home > self.q_upper)
        if outside.any():
            j = int(outside.argmax())
            raise ModelError(
                f"home of {about.name} puts {self.joints[j]!r} at {home[j]:g}, outside its range "
                f"[{self.q_lower[j]:g}, {self.q_upper[j]:g}]"
            )
        held = ~self.coupling.any(axis=1) & (
            (self.offset < self.lower - HELD) | (self.offset > self.upper + HELD)
        )
        if held.any():
            j = int(held.argmax())
            raise ModelError(
                f"joint {model.joint(j).name!r} of {about.name} is held at {self.offset[j]:g}, "
                f"outside its range [{self.lower[j]:g}, {self.upper[j]:g}]; lock and home, or the "
                "file's equality, hold it there"
            )
        return home

    def _closing(self, independent: list[int], moves: np.ndarray) -> np.ndarray:
        """How q moves as each contact point closes (k, n), its fastest joint by 1 rad."""
        points = self.description.contact_points
        unit = np.where(self._hinge[independent], 1.0, SLIDE_UNIT)
        closing = np.zeros((len(points), self.n))
        for i, point in enumerate(points):
            if point.closing is None:
                closing[i] = self._guessed_closing(i, independent, moves)
            else:
                for joint, weight in point.closing.items():
                    closing[i, self.index(joint)] = weight
            if closing[i].any():
                closing[i] /= np.abs(closing[i] / unit).max()
        for i, point in enumerate(points):
            for j in np.flatnonzero(closing[i]):
                others = [p.name for a, p in enumerate(points) if a != i and moves[a, j]]
                if others:
                    raise ModelError(
                        f"joint {self.joints[j]!r} of {self.description.name} closes "
                        f"{point.name!r} and moves {', '.join(map(repr, others))} too: each "
                        "contact point needs joints of its own to close with"
                    )
        return closing

    def _guessed_closing(self, i: int, independent: list[int], moves: np.ndarray) -> np.ndarray:
        """The joints that bend a finger: the last one, and those parallel to it."""
        point = self.description.contact_points[i]
        spreading = [group.adduction for group in self.description.grasping]
        own = [
            j
            for j in range(self.n)
            if moves[i, j] and moves[:, j].sum() == 1 and self.joints[j] not in spreading
        ]
        if not own:
            raise ModelError(
                f"no joint of {self.description.name} moves {point.name!r} alone, so nothing can "
                "close it; each contact point needs joints of its own"
            )
        weights = np.zeros(self.n)
        axes = self._at(self.home).xaxis[independent]
        last = own[-1]
        slides = not self._hinge[independent[last]]
        if slides:
            weights[last] = SLIDE_UNIT
        for j in own if not slides else ():
            cosine = float(axes[j] @ axes[last])
            if self._hinge[independent[j]] and abs(cosine) > PARALLEL:
                weights[j] = np.sign(cosine)
        return self._towards_others(i, weights, last, slides) * weights

    def _towards_others(self, i: int, weights: np.ndarray, last: int, slides: bool) -> float:
        """1 where moving q by `weights` (n,) [rad, m] from home closes point i, −1 where it opens.

        It closes as it goes straight for the other points. Where it goes across, as a straight
        finger does, it closes to the side on which it comes nearer within the ranges, but a hinge
        not to one on which it can only lean. Where it comes nearer on neither side, a slide is
        closed already, and a hinge turns to its wider side.
        """
        x = self.centers(self.home)
        to = np.delete(x, i, axis=0) - x[i]
        apart = np.linalg.norm(to, axis=1)
        v = self.jacobian(self.home)[3 * i : 3 * i + 3] @ weights
        approach = float((to @ v / np.maximum(apart, CENTRED)).sum())
        if abs(approach) > STRAIGHT * len(to) * np.linalg.norm(v):
            return float(np.sign(approach))

        closed = bool((apart < CENTRED).any())
        low, high = self.q_lower[last], self.q_upper[last]
        wider = 1.0 if high >= -low else -1.0
        if not slides and not closed and min(-low, high) < LEAN:
            return wider

        def gap(share: float) -> float:
            q = np.clip(self.home + share * weights, self.q_lower, self.q_upper)
            return float(np.linalg.norm(self.centers(q) - self.centers(q)[i], axis=1).sum())

        shares = np.linspace(0.0, 1.0, STEPS + 1)
        there, back = [gap(share) for share in shares], [gap(-share) for share in shares]
        less = min(back) - min(there)
        if abs(less) < CENTRED and (slides or closed):
            less = back[-1] - there[-1]
        return float(np.sign(less)) if abs(less) >= CENTRED else wider

    def _groups(self) -> Iterator[RobotGroup]:
        """The groups that grasp, in numbers; arms and palms are found where none are given."""
        about, first = self.description, 0
        fingers = {j for joints in self.flexion for j in joints}
        carrying: dict[int, str] = {}
        for group in about.grasping:
            points = tuple(range(first, first + len(group.contact_points)))
            first = points[-1] + 1
            carried = [i for i in points if about.contact_points[i].by_arm]
            if carried and group.palm is None:
                raise ModelError(
                    f"group {group.name!r} of {about.name} closes by its arm, along its palm's "
                    "approach axis: it needs palm = { body = BODY, pos, approach, opposition }"
                )
            body, p, R = self._palm_of(group, points)
            if group.arm is None:
                carries = np.abs(self.coupling[_chain(self.model, body)]).sum(axis=0) > 0.0
                arm = tuple(j for j in range(self.n) if carries[j] and j not in fingers)
            else:
                arm = tuple(self.index(joint) for joint in group.arm)
            for j in arm:
                other = carrying.setdefault(j, group.name)
                if other != group.name:
                    raise ModelError(
                        f"groups {other!r} and {group.name!r} of {about.name} share the arm joint "
                        f"{self.joints[j]!r}: groups that grasp together have an arm each, "
                        "arm = [...] says which joints"
                    )
            if carried and not arm:
                raise ModelError(f"group {group.name!r} of {about.name} has no arm to close with")
            if len(carried) > 1:
                one, other = (about.contact_points[i].name for i in carried[:2])
                raise ModelError(
                    f"the arm of group {group.name!r} of {about.name} closes {one!r} and {other!r}:"
                    " it can close one contact point"
                )
            adduction = None if group.adduction is None else self.index(group.adduction)
            yield RobotGroup(group.name, points, arm, adduction, body, p, R)

    def _palm_of(self, group: Group, points: tuple[int, ...]) -> tuple[int, np.ndarray, np.ndarray]:
        """Body of the palm, and where on it p (3,), R (3, 3): z approach axis, x opposition."""
        model, own = self.model, list(points)
        if group.palm is not None:
            site = _id(model, mujoco.mjtObj.mjOBJ_SITE, palm_site(group), "site", self.description)
            R = np.zeros(9)
            mujoco.mju_quat2Mat(R, model.site_quat[site])
            return int(model.site_bodyid[site]), model.site_pos[site].copy(), R.reshape(3, 3)
        above = [_ancestors(model, body) for body in self._bodies[own]]
        body = next(b for b in above[0] if all(b in others for others in above))
        closing = self.closing[own]
        room = np.clip(closing.sum(axis=0), self.q_lower - self.home, self.q_upper - self.home)
        half = self.home + 0.5 * room
        v = np.einsum("kaj,kj->ka", self.jacobian(half).reshape(-1, 3, self.n)[own], closing)
        data = self._at(half)
        z = self.centers(half)[own].mean(axis=0) - data.xpos[body]
        if np.linalg.norm(z) < CENTRED:
            z = np.linalg.eigh(v.T @ v)[1][:, 0]
        z = z / np.linalg.norm(z)
        across = v - np.outer(v @ z, z)
        x = np.linalg.eigh(across.T @ across - np.outer(z, z))[1][:, -1]
        x = x - (x @ z) * z
        x /= np.linalg.norm(x)
        R = data.xmat[body].reshape(3, 3).T @ np.column_stack([x, np.cross(z, x), z])
        return body, np.zeros(3), R

    def _refuse_coupled(self, chains: Sequence[Sequence[int]]) -> None:
        """Raise where one independent joint moves joints of two groups that share no link."""
        about, first, moved = self.description, 0, list[set[int]]()
        for group in about.grasping:
            last = first + len(group.contact_points)
            moved.append({j for chain in chains[first:last] for j in chain})
            first = last
        for (one, a), (other, b) in combinations(zip(about.grasping, moved, strict=True), 2):
            for j in range(self.n):
                driven = set(np.flatnonzero(self.coupling[:, j]).tolist())
                if driven & (a - b) and driven & (b - a):
                    raise ModelError(
                        f"joint {self.joints[j]!r} of {about.name} moves groups {one.name!r} and "
                        f"{other.name!r} by a coupling: groups move by themselves; drop_couplings "
                        "frees them"
                    )

    def __repr__(self) -> str:
        return f"Robot({self.description.name!r})"

    def __reduce__(self) -> tuple[object, ...]:
        return Robot, (self.description, self.model)

    @property
    def n(self) -> int:
        """Number of independent joints."""
        return len(self.joints)

    def index(self, joint: str) -> int:
        """Position of an independent joint in q."""
        try:
            return self.joints.index(joint)
        except ValueError:
            raise ModelError(
                f"no independent joint {joint!r} in {self.description.name}; "
                f"those are: {', '.join(self.joints)}"
            ) from None

    def place(self, data: mujoco.MjData, q: np.ndarray) -> None:
        """Put the robot at q (n,) and compute where its bodies, geoms and sites are."""
        data.qpos[:] = self.coupling @ q + self.offset
        mujoco.mj_kinematics(self.model, data)

    def _at(self, q: np.ndarray) -> mujoco.MjData:
        """This thread's data, the robot placed at q."""
        data: mujoco.MjData | None = getattr(self._local, "data", None)
        if data is None:
            data = self._local.data = mujoco.MjData(self.model)
            self._local.q = None
        if not np.array_equal(self._local.q, q):
            self.place(data, q)
            self._local.q = np.array(q)
        return data

    def bodies(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where all bodies of the model are: (b, 3) [m], and quaternions w x y z (b, 4), world."""
        data = self._at(q)
        return data.xpos.copy(), data.xquat.copy()

    def jacobian(self, q: np.ndarray, points: np.ndarray | None = None) -> np.ndarray:
        """∂x/∂q (3k, n) [m/rad] of the contact points' centres, or of `points`.

        `points` (k, 3) [m] stand in the links' frames, one on each contact point's link.
        """
        J = self._point_jacobian(self._at(q), points)
        return J.transpose(0, 2, 1).reshape(-1, self.model.njnt) @ self.coupling

    def hessian(self, q: np.ndarray, points: np.ndarray | None = None) -> np.ndarray:
        """∂²x/∂q² (3k, n, n) [m/rad²] of the contact points' centres, or of `points`.

        ∂²x/∂q_j∂q_l = ω_j × ∂x/∂q_l with j the joint nearer the base, ω = 0 for slides.
        """
        data = self._at(q)
        J = self._point_jacobian(data, points)  # (k, N, 3)
        omega = data.xaxis * self._hinge[:, None]
        both = self._nearer_base[None, :, :, None] * cross(omega[None, :, None], J[:, None, :])
        both *= self._ancestor[:, :, None, None]
        H = both.transpose(0, 3, 1, 2)
        diagonal = np.einsum("kajj->kaj", H).copy()
        H = H + H.transpose(0, 1, 3, 2)
        np.einsum("kajj->kaj", H)[...] = diagonal
        k, N = len(J), self.model.njnt
        return self.coupling.T @ H.reshape(3 * k, N, N) @ self.coupling

    def _point_jacobian(self, data: mujoco.MjData, points: np.ndarray | None) -> np.ndarray:
        lever = self._world(data, points)[:, None, :] - data.xanchor[None]
        J = np.where(self._hinge[:, None], cross(data.xaxis[None], lever), data.xaxis)
        return J * self._ancestor[:, :, None]

    def _world(self, data: mujoco.MjData, points: np.ndarray | None) -> np.ndarray:
        if points is None:
            if self._balls is not None:
                return data.geom_xpos[self._balls]
            points = self._points
        R = data.xmat[self._bodies].reshape(-1, 3, 3)
        return data.xpos[self._bodies] + (R @ points[:, :, None])[:, :, 0]

    def centers(self, q: np.ndarray, points: np.ndarray | None = None) -> np.ndarray:
        """Centres of the contact points, or `points` of their links (k, 3) [m], world."""
        return self._world(self._at(q), points)

    def carried(self, grasp: Grasp, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where joints q (n,) carry the grasp's contacts: x (3k,) [m], world, and ∂x/∂q (3k, n).

        x_i are the contacts' points, moved on by what links turn along their stretches. At the
        grasp's own q, ∂x/∂q is its Jacobian.
        """
        points = self._points
        if all(contact.point is not None for contact in grasp.contacts):
            points = np.array([contact.point for contact in grasp.contacts])
        x, J = self.centers(q, points), self.jacobian(q, points)
        if grasp.rolling is not None:
            stretch, deeper = self._stretched(grasp.q, grasp.contacts, points)
            turned = self.centers(q, deeper) - x - grasp.normals
            x = x + (stretch @ turned[:, :, None])[:, :, 0]
            J = J + _times(stretch, self.jacobian(q, deeper) - J)
        return x.ravel(), J

    def _stretched(
        self, q: np.ndarray, contacts: Sequence[Contact], points: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The contacts' stretches (k, 3, 3) [m/rad], and what tells ω × n of their links.

        That are places (k, 3) in the links' frames, deeper than the points by the unit normal: as
        links turn they move on from the points by ω × n.
        """
        none = np.zeros((3, 3))
        stretch = np.array([none if c.stretch is None else c.stretch for c in contacts])
        deeper = self.centers(q, points) + [c.normal for c in contacts]
        return stretch, np.array([self.on_link(q, i, x) for i, x in enumerate(deeper)])

    def on_link(self, q: np.ndarray, i: int, x: np.ndarray) -> np.ndarray:
        """A place x (3,) [m], world, in the frame of contact point i's link."""
        data, body = self._at(q), self._bodies[i]
        return data.xmat[body].reshape(3, 3).T @ (x - data.xpos[body])

    def link_jacobian(self, q: np.ndarray, i: int, x: np.ndarray) -> np.ndarray:
        """∂x/∂q (3, n) [m/rad] of a point of link i that is at x (3,) [m], world."""
        data = self._at(q)
        axes = data.xaxis
        J = np.where(self._hinge[:, None], cross(axes, x - data.xanchor), axes)
        return (J * self._ancestor[i][:, None]).T @ self.coupling

    def tip_frames(self, q: np.ndarray) -> np.ndarray:
        """R_world_tip of the contact points' sites (k, 3, 3), in which their sensors read."""
        sites = [self.model.site(point.site).id for point in self.description.contact_points]
        return self._at(q).site_xmat[sites].reshape(-1, 3, 3)

    def palm(self, q: np.ndarray, group: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Where a group's palm is, p_palm (3,) [m] and R_world_palm (3, 3), world.

        Its z axis is the approach axis, its x axis the opposition axis.
        """
        data, palm = self._at(q), self.groups[group]
        R_world_body = data.xmat[palm.palm_body].reshape(3, 3)
        return data.xpos[palm.palm_body] + R_world_body @ palm.p_palm, R_world_body @ palm.R_palm

    def palm_jacobian(self, q: np.ndarray, group: int = 0) -> np.ndarray:
        """A palm's velocity and angular velocity for each joint (6, n) [m/rad, –], world."""
        data = self._at(q)
        mujoco.mj_comPos(self.model, data)
        J = np.zeros((6, self.model.nv))
        p_palm, body = self.palm(q, group)[0], self.groups[group].palm_body
        mujoco.mj_jac(self.model, data, J[:3], J[3:], p_palm, body)
        return J @ self.coupling

    def closing_at(self, q: np.ndarray) -> np.ndarray:
        """How q moves as each contact point closes (k, n), from q (n,) on.

        Flexion joints in their proportion, the fastest by 1 rad; an arm so that its palm moves by
        1 m along its approach axis and does not turn.
        """
        closing = self.closing
        for g, group in enumerate(self.groups):
            for i in group.points:
                if self.description.contact_points[i].by_arm:
                    closing = closing.copy()
                    closing[i] = self._straight(q, g)
        return closing

    def withdrawn(self, q: np.ndarray, far: np.ndarray) -> np.ndarray:
        """q (n,) with each group's palm back by `far` (groups,) [m] along its approach axis.

        To first order, within the joints' ranges; fingers keep their joints.
        """
        back = sum(far[g] * self._straight(q, g) for g in range(len(self.groups)))
        return np.clip(q - back, self.q_lower, self.q_upper)

    def _straight(self, q: np.ndarray, g: int) -> np.ndarray:
        """How q (n,) moves as an arm brings its palm on by 1 m along its axis, without a turn."""
        arm, way = list(self.groups[g].arm), np.zeros(self.n)
        straight = np.append(self.palm(q, g)[1][:, 2], np.zeros(3))
        way[arm] = np.linalg.pinv(self.palm_jacobian(q, g)[:, arm], rcond=SINGULAR) @ straight
        return way

    def group_of(self, where: str) -> int:
        """The group of a contact point, or of a link or geom that one of the arms carries.

        0 where it is none of these.
        """
        names = [point.name for point in self.description.contact_points]
        if where in names:
            i = names.index(where)
            return next(g for g, group in enumerate(self.groups) if i in group.points)
        model = self.model
        geom = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, where)
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, where)
        body = int(model.geom_bodyid[geom]) if geom >= 0 else body
        moving = np.abs(self.coupling[_chain(model, max(body, 0))]).sum(axis=0) > 0.0
        share = [int(moving[list(group.arm)].sum()) for group in self.groups]
        return int(np.argmax(share))

    def opened(self, q: np.ndarray, share: float = 0.0) -> np.ndarray:
        """q (n,) with every finger open, or closed by a share of all it can.

        A finger opens until the first of its joints is at the end of its range, and closes until
        the last one is.
        """
        q = q.copy()
        for w in self.closing:
            moving = w != 0.0
            way = np.abs(w[moving])
            behind = np.where(w > 0.0, q - self.q_lower, self.q_upper - q)[moving] / way
            ahead = np.where(w > 0.0, self.q_upper - q, q - self.q_lower)[moving] / way
            behind, ahead = (np.where(np.isfinite(s), s, UNLIMITED) for s in (behind, ahead))
            if moving.any():
                s = (1.0 - share) * -behind.min() + share * (ahead.max() if share else 0.0)
                q[moving] = np.clip(q + s * w, self.q_lower, self.q_upper)[moving]
        return q

    def grasp(
        self, q: np.ndarray, contacts: Sequence[Contact], other_links: tuple[str, ...] = ()
    ) -> Grasp:
        """A complete grasp from joint angles and what was felt there.

        `contacts` has one Contact for each contact point, in the description's order: position and
        outward normal (world), perhaps wrench and noise; on a link that is no ball,
        perhaps the `tip_radius` it is rounded by there, and its `stretch`. Name, link, point,
        group, flexion and closing are the robot's, and so are the grasp's Jacobian, Hessian,
        coupling and frames; and the position too on a ball felt with noise, for joint angles tell
        its centre.
        """
        q = self.require_q("Robot.grasp: q", q)
        points = self.description.contact_points
        if len(contacts) != len(points):
            raise InputError(
                f"{self.description.name} touches with {len(points)} points "
                f"({', '.join(p.name for p in points)}); got {len(contacts)} contacts"
            )
        places, centers = self._points.copy(), self.centers(q)
        groups = {i: group.name for group in self.groups for i in group.points}
        closing, complete = self.closing_at(q), []
        for i, (contact, point) in enumerate(zip(contacts, points, strict=True)):
            radius = float(self.tip_radius[i])
            if radius == 0.0:  # no ball: the touching point, or the centre of curvature there
                radius = contact.tip_radius
                places[i] = self.on_link(q, i, contact.position + radius * contact.normal)
            elif contact.noise > 0.0:  # where a ball is touched, its normal tells best
                contact = replace(contact, position=centers[i] - radius * contact.normal)
            complete.append(
                replace(
                    contact,
                    name=point.name,
                    body=self.model.body(int(self._bodies[i])).name,
                    point=places[i],
                    group=groups[i],
                    flexion=self.flexion[i],
                    closing=closing[i],
                    tip_radius=radius,
                )
            )
        J, rolling = self.jacobian(q, places), None
        if any(c.stretch is not None for c in complete):
            stretch, deeper = self._stretched(q, complete, places)
            rolling = _times(stretch, self.jacobian(q, deeper) - J)
            J = J + rolling
        return Grasp(
            q=q,
            contacts=tuple(complete),
            jacobian=J,
            hessian=self.hessian(q, places),
            rolling=rolling,
            coupling=self.coupling,
            offset=self.offset,
            other_links=other_links,
            frames=tuple(
                Frame(group.name, *self.palm(q, g), self.palm_jacobian(q, g))
                for g, group in enumerate(self.groups)
            ),
            model=self.model,
        )

    @property
    def workspace(self) -> tuple[float, float, float]:
        """Where an object stands (3,) [m], world: as described, or amid the tips at home."""
        about = self.description
        where = self.centers(self.home).mean(axis=0) if about.workspace is None else about.workspace
        x, y, z = (float(v) for v in where)
        return x, y, z

    def violation(self, q: np.ndarray) -> float:
        """How far the worst joint, independent or coupled, is outside its range [rad]."""
        full = self.coupling @ q + self.offset
        return max(0.0, float((self.lower - full).max()), float((full - self.upper).max()))

    def require_q(self, name: str, q: object) -> np.ndarray:
        """Return q as a finite (n,) array, else raise InputError."""
        try:
            array = np.asarray(q, dtype=float)
        except (TypeError, ValueError):
            array = np.zeros(0)
        if array.shape != (self.n,) or not np.isfinite(array).all():
            raise InputError(
                f"{name} must be {self.n} finite angles, for {', '.join(self.joints)}; got {q!r}"
            )
        return array


def _times(blocks: np.ndarray, J: np.ndarray) -> np.ndarray:
    """Blocks (k, 3, 3), one a contact, times its three rows of J (3k, n)."""
    return np.asarray((blocks @ J.reshape(len(blocks), 3, -1)).reshape(J.shape))


def _id(
    model: mujoco.MjModel, kind: mujoco.mjtObj, name: str, word: str, about: RobotDescription
) -> int:
    i = mujoco.mj_name2id(model, kind, name)
    if i < 0:
        count = {"site": model.nsite, "geom": model.ngeom, "keyframe": model.nkey}[word]
        names = (mujoco.mj_id2name(model, kind, j) for j in range(count))
        raise ModelError(
            f"no {word} {name!r} in {about.xml.name} of {about.name}; "
            f"{word}s are: {', '.join(n for n in names if n) or 'none'}"
        )
    return i


def _refuse_no_numbers(model: mujoco.MjModel, about: RobotDescription) -> None:
    """Raise where the file says NaN, which compares false and so passes every check, or ∞."""
    for kind, names in MEASURES.items():
        for name in names:
            values = getattr(model, f"{kind}_{name}")
            wrong = np.isnan(values) if name == "range" else ~np.isfinite(values)
            for i in np.argwhere(wrong)[:1, 0].tolist():
                word = "joint" if kind == "jnt" else kind
                raise ModelError(
                    f"{word} {getattr(model, word)(i).name!r} of {about.name} has {name} "
                    f"{values[i]}: its file must say numbers"
                )


def described(robot: str | Path, hand: str | None = None) -> RobotDescription:
    """A robot's description; where a carriage has no palm to hold it by, with the one found."""
    return with_palm(RobotDescription.load(robot, hand))


def with_palm(about: RobotDescription) -> RobotDescription:
    """The same; where a carriage has no palm to hold it by, with the one found."""
    if about.carriage and about.grasping[0].palm is None:
        alone = replace(about, carriage=False)
        found = Robot(alone, compiled(alone))
        first = found.groups[0]
        p, R = first.p_palm, first.R_palm
        name = found.model.body(first.palm_body).name
        palm = Palm("", name, tuple(p.tolist()), tuple(R[:, 2].tolist()), tuple(R[:, 0].tolist()))
        groups = [replace(g, palm=palm) if g.name == first.name else g for g in about.groups]
        about = replace(about, groups=tuple(groups))
    return about


def compiled(description: RobotDescription) -> mujoco.MjModel:
    """The described robot alone, as MuJoCo compiles it."""
    return compiled_spec(description.spec(), f"{description.xml.name} does not compile")


@dataclass(frozen=True, eq=False)
class _Link:
    """What touches: some geoms of one body."""

    body: int
    geoms: tuple[int, ...]
    centre: np.ndarray  # (3,) [m] of the ball, or of the geoms, in the body's frame
    radius: float  # [m] of the ball, 0 for other shapes


def _link(model: mujoco.MjModel, point: ContactPoint, about: RobotDescription) -> _Link:
    if point.ball is not None:
        geoms = [model.geom(ball_name(point)).id]
    elif point.geoms:
        geoms = [_id(model, mujoco.mjtObj.mjOBJ_GEOM, g, "geom", about) for g in point.geoms]
    body = int(model.geom_bodyid[geoms[0]]) if not point.link else _body(model, point, about)
    if point.ball is None and not point.geoms:
        collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        welded = [b for b in range(model.nbody) if _rigid(model, b, body)]
        geoms = np.flatnonzero(collides & np.isin(model.geom_bodyid, welded)).tolist()
        if not geoms:
            raise ModelError(
                f"link {point.link!r} of {about.name} has no geom that collides; give the contact "
                f"point {point.name!r} a ball = {{pos = [x, y, z], radius = r}}, or geoms"
            )
    apart = [g for g in geoms if not _rigid(model, int(model.geom_bodyid[g]), body)]
    if apart:
        raise ModelError(
            f"geom {model.geom(apart[0]).name!r} of {about.name} is not on the link of the contact "
            f"point {point.name!r}"
        )
    kinds = model.geom_type[geoms]
    unfit = [g for g in geoms if model.geom_type[g] not in CONVEX]
    if unfit:
        raise ModelError(f"geom {model.geom(unfit[0]).name!r} of {about.name} cannot touch")
    places = [_in_body(model, g, body) for g in geoms]
    centre = np.mean(places, axis=0)
    round_tip = len(geoms) == 1 and kinds[0] == SPHERE
    if point.site:
        site = _id(model, mujoco.mjtObj.mjOBJ_SITE, point.site, "site", about)
        same = model.site_bodyid[site] == body
        if round_tip and (not same or np.abs(model.site_pos[site] - centre).max() > CENTRED):
            raise ModelError(
                f"site {point.site!r} of {about.name} must be at the centre of its geom "
                f"{model.geom(geoms[0]).name!r}"
            )
    radius = float(model.geom_size[geoms[0], 0]) if round_tip else 0.0
    return _Link(body, tuple(geoms), centre, radius)


def _body(model: mujoco.MjModel, point: ContactPoint, about: RobotDescription) -> int:
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, point.link)
    if body < 0:
        names = [model.body(b).name for b in range(1, model.nbody)]
        raise ModelError(
            f"contact point {point.name!r} of {about.name}: no link {point.link!r}; "
            f"{nearest(point.link, names)}"
        )
    return body


def _rigid(model: mujoco.MjModel, body: int, link: int) -> bool:
    """True where `body` is the link, or hangs on it without a joint."""
    while body > link and model.body_jntnum[body] == 0:
        body = int(model.body_parentid[body])
    return body == link


def _in_body(model: mujoco.MjModel, geom: int, link: int) -> np.ndarray:
    """A geom's place (3,) [m] in the frame of the link it is rigid with."""
    p, body = model.geom_pos[geom].copy(), int(model.geom_bodyid[geom])
    while body != link:
        turned = np.zeros(3)
        mujoco.mju_rotVecQuat(turned, p, model.body_quat[body])
        p, body = model.body_pos[body] + turned, int(model.body_parentid[body])
    return p


def _reach(model: mujoco.MjModel, link: _Link) -> np.ndarray:
    """(N,) [m/rad] that no point of the link's geoms moves faster than, joint by joint."""
    bound = np.zeros(model.njnt)
    places = [np.linalg.norm(_in_body(model, g, link.body)) for g in link.geoms]
    far = float(np.max(np.array(places) + model.geom_rbound[list(link.geoms)]))
    far -= link.radius  # a ball's surface moves as its centre does
    body = link.body
    while body > 0:
        first = model.body_jntadr[body]
        for j in range(first, first + model.body_jntnum[body]) if first >= 0 else ():
            if model.jnt_type[j] == HINGE:
                bound[j] = far + np.linalg.norm(model.jnt_pos[j])
            else:
                bound[j] = 1.0
        for j in range(first, first + model.body_jntnum[body]) if first >= 0 else ():
            if model.jnt_type[j] == SLIDE:
                travel = float(np.abs(model.jnt_range[j]).max()) if model.jnt_limited[j] else np.inf
                far += travel if np.isfinite(travel) else UNLIMITED
        far += float(np.linalg.norm(model.body_pos[body]))
        body = int(model.body_parentid[body])
    return bound


def _ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    """`body` and what carries it, the world last."""
    above = [body]
    while above[-1] > 0:
        above.append(int(model.body_parentid[above[-1]]))
    return above


def _chain(model: mujoco.MjModel, body: int) -> list[int]:
    """Joints that move `body`."""
    joints: list[int] = []
    while body > 0:
        first = model.body_jntadr[body]
        joints.extend(range(first, first + model.body_jntnum[body]) if first >= 0 else ())
        body = model.body_parentid[body]
    return joints


def _couplings(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """C (N, n), c₀ (N,) and the independent joints, from the model's active linear equalities."""
    N = model.njnt
    rows, rest, dependent = [], [], []
    for e in range(model.neq):
        if not model.eq_active0[e]:
            continue
        kind, coefficients = model.eq_type[e], model.eq_data[e]
        name = model.eq(e).name or f"{e}"
        side: Callable[[mujoco.MjModel, int], tuple[np.ndarray, float]]
        if kind == int(mujoco.mjtEq.mjEQ_JOINT):
            side = _joint_row
        elif kind == int(mujoco.mjtEq.mjEQ_TENDON):
            side = _tendon_row
        elif kind in LINKS:
            bound = _between(model, e)
            if bound:
                raise ModelError(
                    f"equality {name} {LINKS[kind]}, whose joints no law here knows to be bound: "
                    "drop_couplings = true leaves it out, and "
                    "couplings = [{ joint, to, ratio }] says how they move together"
                )
            continue
        else:
            raise ModelError(
                f"equality {name} binds neither joints nor links, and no law here knows what "
                "it does: drop_couplings = true leaves it out"
            )
        if not np.isfinite(coefficients[:5]).all():
            raise ModelError(f"equality {name} has polycoef {coefficients[:5]}, not all finite")
        if np.any(coefficients[2:5] != 0.0):
            raise ModelError(f"equality {name} is not linear; couplings must be")
        row, at_zero = side(model, int(model.eq_obj1id[e]))
        if not row.any():
            raise ModelError(f"equality {name} is of a tendon that no joint moves")
        dependent.append(int(np.flatnonzero(row)[-1]))
        value = at_zero + coefficients[0]
        if model.eq_obj2id[e] >= 0:
            driver, driver_at_zero = side(model, int(model.eq_obj2id[e]))
            row = row - coefficients[1] * driver
            value -= coefficients[1] * driver_at_zero
        rows.append(row)
        rest.append(value)
    independent = [j for j in range(N) if j not in dependent]
    C = np.zeros((N, len(independent)))
    C[independent, np.arange(len(independent))] = 1.0
    c0 = np.zeros(N)
    if rows:
        E, e0 = np.array(rows), np.array(rest)
        try:
            inverse = np.linalg.inv(E[:, dependent])
        except np.linalg.LinAlgError as error:
            names = [repr(model.joint(j).name) for j in sorted(set(dependent))]
            raise ModelError(
                "the model's couplings contradict or repeat one another; they bind "
                f"{', '.join(names)}: couplings, drop_couplings or lock say otherwise"
            ) from error
        C[dependent] = -inverse @ E[:, independent]
        c0[dependent] = inverse @ e0
    return C, c0, independent


def _between(model: mujoco.MjModel, e: int) -> set[int]:
    """The joints between the two links that an equality binds."""
    ends = [int(model.eq_obj1id[e]), int(model.eq_obj2id[e])]
    if model.eq_objtype[e] == int(mujoco.mjtObj.mjOBJ_SITE):
        ends = [int(model.site_bodyid[site]) for site in ends]
    one, other = (set(_chain(model, body)) for body in ends)
    return one ^ other


def _joint_row(model: mujoco.MjModel, j: int) -> tuple[np.ndarray, float]:
    row = np.zeros(model.njnt)
    row[j] = 1.0
    return row, float(model.qpos0[j])


def _tendon_row(model: mujoco.MjModel, t: int) -> tuple[np.ndarray, float]:
    row = np.zeros(model.njnt)
    for a in range(model.tendon_adr[t], model.tendon_adr[t] + model.tendon_num[t]):
        if model.wrap_type[a] != int(mujoco.mjtWrap.mjWRAP_JOINT):
            raise ModelError(f"tendon {model.tendon(t).name!r} couples joints but is not fixed")
        row[model.wrap_objid[a]] = model.wrap_prm[a]
    return row, float(model.tendon_length0[t])


def _ranges_of_independent(
    C: np.ndarray, c0: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The box of q in which every joint driven by one independent joint stays in its range."""
    n = C.shape[1]
    low, high = np.full(n, -np.inf), np.full(n, np.inf)
    for row, c, least, most in zip(C, c0, lower, upper, strict=True):
        drivers = np.flatnonzero(row)
        if len(drivers) != 1:
            continue
        j, ratio = int(drivers[0]), row[drivers[0]]
        ends = sorted(((least - c) / ratio, (most - c) / ratio))
        # Rounding may carry ratio · end past the range by an ulp: step back inside.
        while ratio * ends[1] + c > most or ratio * ends[1] + c < least:
            ends[1] = np.nextafter(ends[1], -np.inf)
        while ratio * ends[0] + c > most or ratio * ends[0] + c < least:
            ends[0] = np.nextafter(ends[0], np.inf)
        low[j], high[j] = max(low[j], ends[0]), min(high[j], ends[1])
    return low, high
