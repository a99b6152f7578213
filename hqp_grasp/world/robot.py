"""A robot as data: an MJCF, its independent joints, and the points it touches with."""

from __future__ import annotations

import difflib
import threading
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from hqp_grasp.errors import InputError, ModelError, number, one_of
from hqp_grasp.grasp import Contact, Grasp

HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)

# What a robot.toml may say, and what of each contact point. A description is for people; force and
# torque name sensors, which nothing here reads yet.
ENTRIES = ("model", "description", "home", "palm", "arm", "adduction", "velocity", "contact_points")
POINT_ENTRIES = ("name", "site", "geom", "flexion", "force", "torque")
CENTRED = 1e-9  # [m] a contact point's site and its geom's centre agree to this


@dataclass(frozen=True)
class ContactPoint:
    """A place on the hand that may touch: a round tip, its site at the centre."""

    name: str
    site: str
    geom: str
    flexion: tuple[str, ...]  # joints that press it


@dataclass(frozen=True)
class RobotDescription:
    """What a robot folder says in its robot.toml, beside its MJCF."""

    name: str
    xml: Path
    home: str  # keyframe
    palm: str  # site: z is the approach axis, x the opposition axis
    arm: tuple[str, ...]  # joints that carry the hand
    adduction: str | None  # joint that spreads the fingers
    velocity: Mapping[str, float]  # [rad/s] of each independent joint
    contact_points: tuple[ContactPoint, ...]

    @classmethod
    def load(cls, robot: str | Path) -> RobotDescription:
        """Read a robot of this package by name, or any folder with a robot.toml by its path."""
        if isinstance(robot, Path) or "/" in str(robot):
            folder = Path(robot)
            if not (folder / "robot.toml").is_file():
                raise ModelError(f"{folder} is no robot folder: it has no robot.toml")
        else:
            root = Path(str(resources.files("hqp_grasp.robots")))
            folder = root / one_of(
                "robot", robot, sorted(p.parent.name for p in root.glob("*/*.toml"))
            )
        file = folder / "robot.toml"
        try:
            data = _entries(file, tomllib.loads(file.read_text()), ENTRIES)
            points = tuple(
                ContactPoint(
                    _text(p["name"]), _text(p["site"]), _text(p["geom"]), _texts(p["flexion"])
                )
                for p in (_entries(file, p, POINT_ENTRIES) for p in data["contact_points"])
            )
            return cls(
                name=folder.name,
                xml=folder / data["model"],
                home=_text(data["home"]),
                palm=_text(data["palm"]),
                arm=_texts(data["arm"]),
                adduction=_text(data["adduction"]) if "adduction" in data else None,
                velocity={j: number(f"velocity of {j}", v) for j, v in data["velocity"].items()},
                contact_points=points,
            )
        except tomllib.TOMLDecodeError as error:
            raise ModelError(f"{file} is not valid TOML: {error}") from error
        except KeyError as error:
            raise ModelError(f"{file} lacks the entry {error}") from error
        except (TypeError, AttributeError, InputError) as error:
            raise ModelError(f"{file}: an entry is of the wrong kind: {error}") from error

    def spec(self) -> mujoco.MjSpec:
        """The authored model, ready to be composed with others."""
        try:
            spec = mujoco.MjSpec.from_file(str(self.xml))
        except ValueError as error:
            raise ModelError(f"{self.xml} is not a valid MJCF: {error}") from error
        # MuJoCo fills a keyframe that is too short with zeros, without a word.
        for key in spec.keys:
            if 0 < len(key.qpos) < len(spec.joints):
                raise ModelError(
                    f"keyframe {key.name!r} of {self.xml.name} has {len(key.qpos)} angles; "
                    f"the model has {len(spec.joints)} joints"
                )
        return spec


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
    tip_radius: np.ndarray = field(init=False)  # (k,) [m]
    _sites: np.ndarray = field(init=False, repr=False)  # (k,)
    _hinge: np.ndarray = field(init=False, repr=False)  # (N,) bool
    _ancestor: np.ndarray = field(init=False, repr=False)  # (k, N) bool: joint j moves point i
    _nearer_base: np.ndarray = field(init=False, repr=False)  # (N, N) bool: j at or above l
    _local: threading.local = field(init=False, repr=False)  # each thread's own MjData

    def __post_init__(self) -> None:
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731
        model, about = self.model, self.description
        for j in range(model.njnt):
            if model.jnt_type[j] not in (HINGE, SLIDE):
                raise ModelError(
                    f"joint {model.joint(j).name!r} of {about.name} is neither hinge nor slide; "
                    "a robot here has a fixed base and one-dimensional joints"
                )
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
        for joint in (*about.arm, *about.velocity):
            self.index(joint)
        missing = [j for j in self.joints if j not in about.velocity]
        if missing:
            raise ModelError(f"robot.toml of {about.name} gives no velocity for {missing}")
        velocity = np.array([about.velocity[j] for j in self.joints], dtype=float)
        if not ((velocity > 0.0) & np.isfinite(velocity)).all():
            raise ModelError(
                f"robot.toml of {about.name}: every velocity must be finite and above 0"
            )
        put("velocity", velocity)
        key = _id(model, mujoco.mjtObj.mjOBJ_KEY, about.home, "keyframe", about)
        put("home", model.key_qpos[key][independent].copy())
        _id(model, mujoco.mjtObj.mjOBJ_SITE, about.palm, "site", about)
        if about.adduction is not None:
            self.index(about.adduction)
        points = about.contact_points
        put("flexion", tuple(tuple(self.index(j) for j in p.flexion) for p in points))
        sites = [_id(model, mujoco.mjtObj.mjOBJ_SITE, p.site, "site", about) for p in points]
        geoms = [_id(model, mujoco.mjtObj.mjOBJ_GEOM, p.geom, "geom", about) for p in points]
        for p, s, g in zip(points, sites, geoms, strict=True):
            same = model.site_bodyid[s] == model.geom_bodyid[g]
            if not same or np.abs(model.site_pos[s] - model.geom_pos[g]).max() > CENTRED:
                raise ModelError(
                    f"site {p.site!r} of {about.name} must be at the centre of its geom {p.geom!r}"
                )
            if model.geom_type[g] != int(mujoco.mjtGeom.mjGEOM_SPHERE):
                raise ModelError(f"geom {p.geom!r} of {about.name} must be a sphere: a round tip")
        put("_sites", np.array(sites))
        put("tip_radius", model.geom_size[geoms, 0].copy())
        put("_hinge", model.jnt_type == HINGE)
        chains = [_chain(model, int(model.site_bodyid[s])) for s in sites]
        put("_ancestor", np.array([np.isin(np.arange(model.njnt), c) for c in chains]))
        # Joints are numbered from the base outwards, so the smaller number is nearer the base.
        put("_nearer_base", np.triu(np.ones((model.njnt, model.njnt), dtype=bool)))
        put("_local", threading.local())

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
        if self._local.q is None or not np.array_equal(self._local.q, q):
            self.place(data, q)
            self._local.q = np.array(q)
        return data

    def bodies(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where all bodies of the model are: (b, 3) [m], and quaternions w x y z (b, 4), world."""
        data = self._at(q)
        return data.xpos.copy(), data.xquat.copy()

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """∂x/∂q (3k, n) [m/rad] of the contact points' centres."""
        J = self._point_jacobian(self._at(q))
        return J.transpose(0, 2, 1).reshape(-1, self.model.njnt) @ self.coupling

    def hessian(self, q: np.ndarray) -> np.ndarray:
        """∂²x/∂q² (3k, n, n) [m/rad²] of the contact points' centres.

        ∂²x/∂q_j∂q_l = ω_j × ∂x/∂q_l with j the joint nearer the base, ω = 0 for slides.
        """
        data = self._at(q)
        J = self._point_jacobian(data)  # (k, N, 3)
        omega = data.xaxis * self._hinge[:, None]
        both = self._nearer_base[None, :, :, None] * _cross(omega[None, :, None], J[:, None, :])
        both *= self._ancestor[:, :, None, None]
        H = both.transpose(0, 3, 1, 2)
        diagonal = np.einsum("kajj->kaj", H).copy()
        H = H + H.transpose(0, 1, 3, 2)
        np.einsum("kajj->kaj", H)[...] = diagonal
        k, N = len(J), self.model.njnt
        return self.coupling.T @ H.reshape(3 * k, N, N) @ self.coupling

    def _point_jacobian(self, data: mujoco.MjData) -> np.ndarray:
        lever = data.site_xpos[self._sites][:, None, :] - data.xanchor[None]
        J = np.where(self._hinge[:, None], _cross(data.xaxis[None], lever), data.xaxis)
        return J * self._ancestor[:, :, None]

    def centers(self, q: np.ndarray) -> np.ndarray:
        """Centres of the contact points (k, 3) [m], world."""
        return self._at(q).site_xpos[self._sites]

    def palm(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the palm is, p_palm (3,) [m] and R_world_palm (3, 3), world.

        Its z axis is the approach axis, its x axis the opposition axis.
        """
        site = self._at(q).site(self.description.palm)
        return site.xpos.copy(), site.xmat.reshape(3, 3).copy()

    def palm_jacobian(self, q: np.ndarray) -> np.ndarray:
        """The palm's velocity and angular velocity for each joint (6, n) [m/rad, –], world."""
        data = self._at(q)
        mujoco.mj_comPos(self.model, data)
        J = np.zeros((6, self.model.nv))
        site = self.model.site(self.description.palm).id
        mujoco.mj_jacSite(self.model, data, J[:3], J[3:], site)
        return J @ self.coupling

    def grasp(
        self, q: np.ndarray, contacts: Sequence[Contact], other_links: tuple[str, ...] = ()
    ) -> Grasp:
        """A complete grasp from joint angles and what was felt there.

        `contacts` has one Contact for each contact point, in the description's order: position and
        outward normal (world), perhaps wrench and confidence. Name, link, point and flexion are
        the robot's, and so are the grasp's Jacobian, Hessian and coupling.
        """
        q = self.require_q("Robot.grasp: q", q)
        points = self.description.contact_points
        if len(contacts) != len(points):
            raise InputError(
                f"{self.description.name} touches with {len(points)} points "
                f"({', '.join(p.name for p in points)}); got {len(contacts)} contacts"
            )
        model = self.model
        complete = [
            replace(
                contact,
                name=point.name,
                body=model.body(int(model.site_bodyid[site])).name,
                point=model.site_pos[site],
                flexion=flexion,
                tip_radius=float(radius),
            )
            for contact, point, site, flexion, radius in zip(
                contacts, points, self._sites, self.flexion, self.tip_radius, strict=True
            )
        ]
        return Grasp(
            q=q,
            contacts=tuple(complete),
            jacobian=self.jacobian(q),
            hessian=self.hessian(q),
            coupling=self.coupling,
            offset=self.offset,
            other_links=other_links,
        )

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


def _entries(file: Path, table: object, known: tuple[str, ...]) -> dict[str, Any]:
    """Return `table`; raise for an entry that is not known, which would be ignored otherwise."""
    if not isinstance(table, dict):
        raise InputError(f"{table!r} is no table")
    for entry in table:
        if entry not in known:
            near = difflib.get_close_matches(entry, known, n=1)
            hint = f"did you mean {near[0]!r}? Entries" if near else "entries"
            raise ModelError(f"{file}: unknown entry {entry!r}; {hint} are: {', '.join(known)}")
    return table


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise InputError(f"{value!r} is no name")
    return value


def _texts(value: object) -> tuple[str, ...]:
    if not isinstance(value, list):
        raise InputError(f"{value!r} is no list of names")
    return tuple(_text(v) for v in value)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a × b along the last axis; np.cross costs several times as much on small arrays."""
    out = np.empty((*np.broadcast(a[..., 0], b[..., 0]).shape, 3))
    out[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    out[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    out[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return out


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
        side: Callable[[mujoco.MjModel, int], tuple[np.ndarray, float]]
        if kind == int(mujoco.mjtEq.mjEQ_JOINT):
            side = _joint_row
        elif kind == int(mujoco.mjtEq.mjEQ_TENDON):
            side = _tendon_row
        else:
            continue
        if np.any(coefficients[2:5] != 0.0):
            raise ModelError(f"equality {model.eq(e).name or e} is not linear; couplings must be")
        row, at_zero = side(model, int(model.eq_obj1id[e]))
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
            raise ModelError("the model's couplings contradict or repeat one another") from error
        C[dependent] = -inverse @ E[:, independent]
        c0[dependent] = inverse @ e0
    return C, c0, independent


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
