"""How hard each contact pushes: laws of force in strict order, from what is felt alone.

Forces are those that the contacts apply to the object, world frame, as in `hqp_grasp.mechanics`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from hqp_grasp.errors import InputError, SolverError, instance, number, positive
from hqp_grasp.grasp import Grasp, as_array
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.hierarchy.level import Level, Solution
from hqp_grasp.mechanics import FLOOR, arm, grasp_map, margin, net_wrench, pyramid_rows
from hqp_grasp.world.robot import Robot
from hqp_grasp.world.statics import contact_jacobian, torque_limits, weight_torque

QUICKEST = HQP("daqp")  # for the many inequalities of forces
EDGES = 8  # of the pyramids, which keep 0.92 of the cones' friction in the worst direction
ROUNDING = 1e-6  # [–] of a joint's torques, by which an answer may be beyond their limit


@dataclass(frozen=True, eq=False)
class Felt:
    """All that a law of force reads. Unknowns are x = (f (3k), s (k)): forces, and margins."""

    grasp: Grasp
    force: float  # F [N], the mean normal force that is asked for
    most: float  # [N] of normal force at one contact
    friction: float  # µ [–] that is believed
    wrench: np.ndarray  # (6,) [N, N·m] that the contacts give to the object, about their centroid
    torque: np.ndarray  # Jᵀ (n, 3k) [m]: torque·f is what the joints must give to the forces f
    torque_lower: np.ndarray  # (n,) [N·m] what the motors have left, beside the robot's own weight
    torque_upper: np.ndarray  # (n,)

    @cached_property
    def grasp_map(self) -> np.ndarray:
        """G (6, 3k): G f is the forces' net wrench about the contacts' centroid."""
        x = self.grasp.positions
        return grasp_map(x, x.mean(axis=0))

    @cached_property
    def pushes(self) -> np.ndarray:
        """(k, 3k): pushes·f are the normal forces a_i = −n_i·f_i [N]."""
        return _blocks(-self.grasp.normals[:, None, :])


@dataclass(frozen=True)
class ForceLaw(ABC):
    """Rows over the contact forces, of one priority. A new law is a subclass with `level`.

    Any law may stand among the laws (`>>`, `+`) or above them (`within`), where it limits.
    """

    unit = "N"  # of what its rows are short by

    @property
    def name(self) -> str:
        """What reports call it: "net force" for NetForce."""
        letters = "".join(f" {c.lower()}" if c.isupper() else c for c in type(self).__name__)
        return letters.strip()

    @abstractmethod
    def level(self, felt: Felt) -> Level:
        """lower ≤ A x ≤ upper, A (r, 3k) over the forces, or (r, 4k) over forces and margins."""

    def __rshift__(self, other: ForceLaw | Forces) -> Forces:
        """`a >> b`: b subject to a."""
        return Forces.of(self) >> other

    def __add__(self, other: ForceLaw | Forces) -> Forces:
        """`a + b`: both at the same priority."""
        return Forces.of(self) + other


@dataclass(frozen=True)
class Forces:
    """Laws of force by priority, and limits above them: left first, as laws of motion are."""

    priorities: tuple[tuple[ForceLaw, ...], ...]
    limits: tuple[ForceLaw, ...] = ()  # each a level of its own, the first above the others

    def __post_init__(self) -> None:
        groups = self.priorities if isinstance(self.priorities, tuple) else ()
        full = groups and all(isinstance(laws, tuple) and laws for laws in groups)
        if not full or not all(isinstance(law, ForceLaw) for laws in groups for law in laws):
            raise InputError(
                "Forces.priorities must be tuples of laws of force, none of them empty; "
                f"got {self.priorities!r}"
            )
        limits = self.limits if isinstance(self.limits, tuple) else (None,)
        if not all(isinstance(law, ForceLaw) for law in limits):
            raise InputError(f"Forces.limits must be a tuple of ForceLaw; got {self.limits!r}")

    @classmethod
    def of(cls, laws: ForceLaw | Forces) -> Forces:
        """Forces of one law, or the forces themselves."""
        if isinstance(laws, Forces):
            return laws
        if not isinstance(laws, ForceLaw):
            raise InputError(f"laws must be a ForceLaw, or Forces of some; got {laws!r}")
        return cls(((laws,),))

    def __rshift__(self, other: ForceLaw | Forces) -> Forces:
        """`a >> b`: b subject to a."""
        below = Forces.of(other)
        return Forces(self.priorities + below.priorities, self.limits + below.limits)

    def __add__(self, other: ForceLaw | Forces) -> Forces:
        """`a + b`: b at the priority of the last laws of a."""
        beside = Forces.of(other)
        if len(beside.priorities) != 1:
            raise InputError("`+` puts laws at one priority: add a law, or forces of one priority")
        last = self.priorities[-1] + beside.priorities[0]
        return Forces((*self.priorities[:-1], last), self.limits + beside.limits)

    def within(self, *limits: ForceLaw) -> Forces:
        """The same laws below these limits too, which come after those that are there."""
        return replace(self, limits=(*self.limits, *limits))

    @property
    def levels(self) -> tuple[tuple[ForceLaw, ...], ...]:
        """The laws of each level, limits first."""
        return (*((limit,) for limit in self.limits), *self.priorities)


@dataclass(frozen=True)
class JointTorques(ForceLaw):
    """Jᵀ f stays within what the motors have left beside the robot's own weight."""

    unit = "N·m"

    def level(self, felt: Felt) -> Level:
        moved = felt.torque.any(axis=1)
        rows = felt.torque[moved], felt.torque_lower[moved], felt.torque_upper[moved]
        return Level(*rows)


@dataclass(frozen=True)
class FrictionPyramids(ForceLaw):
    """Each force keeps its margin s_i ≥ 0 [N] to every face of the pyramid inside its cone."""

    def level(self, felt: Felt) -> Level:
        k = felt.grasp.k
        faces = _blocks(pyramid_rows(felt.grasp.normals, felt.friction, EDGES))
        A = np.zeros((len(faces) + k, 4 * k))
        A[: len(faces), : 3 * k] = faces
        A[: len(faces), 3 * k :] = np.repeat(np.eye(k), EDGES, axis=0)
        A[len(faces) :, 3 * k :] = -np.eye(k)
        return Level(A, np.full(len(A), -np.inf), np.zeros(len(A)))


@dataclass(frozen=True)
class NormalForces(ForceLaw):
    """Every contact pushes with a share of the mean at least, and no more than it may."""

    least: float = FLOOR  # [–] of F

    def __post_init__(self) -> None:
        if not 0.0 <= number("NormalForces.least", self.least) <= 1.0:
            raise InputError(f"NormalForces.least is a share of the mean; got {self.least}")

    def level(self, felt: Felt) -> Level:
        k = felt.grasp.k
        return Level(felt.pushes, np.full(k, self.least * felt.force), np.full(k, felt.most))


@dataclass(frozen=True)
class NetForce(ForceLaw):
    """Σ f_i stays what is felt: it carries what the object weighs now, whatever that is."""

    def level(self, felt: Felt) -> Level:
        return Level.equal(felt.grasp_map[:3], felt.wrench[:3])


@dataclass(frozen=True)
class GripStrength(ForceLaw):
    """Normal forces add up to k F."""

    def level(self, felt: Felt) -> Level:
        return Level.equal(felt.pushes.sum(axis=0)[None], np.array([felt.grasp.k * felt.force]))


@dataclass(frozen=True)
class Margins(ForceLaw):
    """Every force as far inside its pyramid as a pure squeeze by F is, or as nearly as can be."""

    def level(self, felt: Felt) -> Level:
        k, slope = felt.grasp.k, felt.friction * np.cos(np.pi / EDGES)
        A = np.concatenate([np.zeros((k, 3 * k)), np.eye(k)], axis=1)
        return Level(A, np.full(k, felt.force * slope / np.hypot(1.0, slope)), np.full(k, np.inf))


@dataclass(frozen=True)
class NetMoment(ForceLaw):
    """Σ (x_i − x̄) × f_i stays what is felt."""

    unit = "N·m"

    def level(self, felt: Felt) -> Level:
        return Level.equal(felt.grasp_map[3:], felt.wrench[3:])


@dataclass(frozen=True)
class LeastForce(ForceLaw):
    """f = 0: of all forces that do as well, the smallest ones."""

    def level(self, felt: Felt) -> Level:
        return Level.equal(np.eye(3 * felt.grasp.k), np.zeros(3 * felt.grasp.k))


GRIP_LAWS = (NetForce() >> GripStrength() >> Margins() >> NetMoment() >> LeastForce()).within(
    JointTorques(), FrictionPyramids(), NormalForces()
)


@dataclass(frozen=True)
class LawReport:
    """How one law of force came out."""

    law: str
    short: float  # length of what is missing, over the law's rows; 0 where it is met
    unit: str

    def __str__(self) -> str:
        return f"{self.law}: " + (f"short by {self.short:.3g} {self.unit}" if self.short else "met")


@dataclass(frozen=True, eq=False)
class Squeeze:
    """The forces to press with, or why there are none."""

    forces: np.ndarray | None  # (k, 3) [N] that the contacts apply to the object, world
    torque: np.ndarray | None  # (n,) [N·m] Jᵀ f, for `Driver.press`: 0 at joints that carry a palm
    margin: np.ndarray | None  # (k,) [N] each force's distance to the surface of its cone
    reports: tuple[LawReport, ...] = ()  # limits first
    reason: str = ""  # why there are no forces; empty where there are
    solution: Solution | None = None  # with the evidence for its optimality

    @property
    def certified(self) -> bool:
        """True where the forces are shown to be the best that the laws allow."""
        return self.forces is not None

    @property
    def short(self) -> tuple[LawReport, ...]:
        """What gave way; least force, the last of all, always does."""
        return tuple(report for report in self.reports if report.short)


@dataclass(frozen=True, eq=False)
class Grip:
    """How hard each contact pushes, by laws in strict order, from a felt grasp alone.

    The laws are values, as those of motion are: `GRIP_LAWS` unless told otherwise, which are joint
    torques ▷ friction pyramids ▷ normal forces ▷ net force ▷ grip strength ▷ margins ▷ net moment
    ▷ least force. The wrench to balance is the one that is felt; no mass is asked for.

    Raises InputError for a strength or friction that is not above 0, and ModelError for a robot
    without limits on its motors' torques.
    """

    robot: Robot
    force: float = 5.0  # F [N] mean normal force of the contacts
    friction: float = 0.5  # µ [–] that is believed
    most: float = 15.0  # [N] of normal force at one contact
    laws: Forces = GRIP_LAWS
    hqp: HQP = QUICKEST
    _limits: tuple[np.ndarray, np.ndarray] = field(init=False, repr=False)  # (n,) each [N·m]

    def __post_init__(self) -> None:
        instance("Grip.robot", self.robot, Robot)
        instance("Grip.hqp", self.hqp, HQP)
        for name in ("force", "friction", "most"):
            object.__setattr__(self, name, positive(f"Grip.{name}", getattr(self, name)))
        if self.force > self.most:
            raise InputError(
                f"Grip.force, {self.force:g} N in the mean, is above the {self.most:g} N that one "
                "contact may push with: ask for less, or allow more by `most`"
            )
        object.__setattr__(self, "laws", Forces.of(self.laws))
        object.__setattr__(self, "_limits", torque_limits(self.robot))

    def felt(self, grasp: Grasp, wrench: np.ndarray | None = None) -> Felt:
        """What the laws read; `wrench` as `solve` says."""
        instance("the grasp to press on", grasp, Grasp)
        balance = felt_wrench(grasp) if wrench is None else as_array("wrench", wrench, (6,))
        weight = weight_torque(self.robot, grasp.q)
        low, high = self._limits
        return Felt(
            grasp,
            self.force,
            self.most,
            self.friction,
            balance,
            contact_jacobian(self.robot, grasp).T,
            # Where weight takes all that a motor has, contacts cannot count on it, nor hold it up.
            # Nor can they count on more than a motor has where weight helps it.
            np.clip(low - weight, low, 0.0),
            np.clip(high - weight, 0.0, high),
        )

    def levels(self, felt: Felt) -> list[Level]:
        """The whole hierarchy over x = (f, s), limits first."""
        return [
            _joined([_padded(law, felt) for law in laws], [law.name for law in laws])
            for laws in self.laws.levels
        ]

    def solve(
        self, grasp: Grasp, wrench: np.ndarray | None = None, warm: Squeeze | None = None
    ) -> Squeeze:
        """The forces for this grasp, certified; without them, the reason.

        `wrench` (6,) [N, N·m] is what the contacts shall give to the object, about their centroid:
        what they are felt to give unless told otherwise, none where nothing is felt. `warm` is the
        answer for a similar grasp with as many contacts, whose active rows are tried first.
        """
        felt = self.felt(grasp, wrench)
        levels = self.levels(felt)
        start = warm.solution if warm is not None else None
        try:
            solution = self.hqp.solve(levels, start)
        except SolverError as error:
            return Squeeze(None, None, None, reason=f"no forces found: {error}")
        if not solution.certified:
            why = "; ".join(solution.failed)
            return Squeeze(
                None, None, None, reason=f"forces not certified: {why}", solution=solution
            )
        forces = solution.x[: 3 * grasp.k].reshape(-1, 3)
        torque = felt.torque @ forces.ravel()
        limited = np.clip(torque, felt.torque_lower, felt.torque_upper)
        rounding = np.abs(limited - torque) < ROUNDING * (felt.torque_upper - felt.torque_lower)
        return Squeeze(
            forces,
            _of_fingers(self.robot, np.where(rounding, limited, torque)),
            margin(forces, grasp.normals, self.friction),
            tuple(self._reports(felt, solution)),
            solution=solution,
        )

    def _reports(self, felt: Felt, solution: Solution) -> Iterator[LawReport]:
        for laws, level in zip(self.laws.levels, solution.levels, strict=True):
            begin = 0
            for law in laws:
                end = begin + len(law.level(felt).lower) if len(laws) > 1 else len(level.residual)
                short = float(np.linalg.norm(level.residual[begin:end]))
                yield LawReport(law.name, short, law.unit)
                begin = end


def felt_wrench(grasp: Grasp) -> np.ndarray:
    """The wrench (6,) [N, N·m] that the contacts give to the object, about their centroid.

    From the wrenches on the tips, about their centres, of opposite sign. Zero where none is felt.
    """
    wrenches = [contact.wrench for contact in grasp.contacts]
    silent = [i for i, wrench in enumerate(wrenches) if wrench is None]
    if len(silent) == grasp.k:
        return np.zeros(6)
    if silent:
        raise InputError(
            f"contacts {silent} of the grasp have no wrench and the others have: what the contacts "
            "carry is not known; leave them out, or give `wrench`"
        )
    on_tips = np.array(wrenches)
    reach = np.array([contact.tip_radius for contact in grasp.contacts])
    centres = grasp.positions + reach[:, None] * grasp.normals
    net = net_wrench(-on_tips[:, :3], centres, grasp.positions.mean(axis=0))
    net[3:] -= on_tips[:, 3:].sum(axis=0)
    return net


def _of_fingers(robot: Robot, torque: np.ndarray) -> np.ndarray:
    """Torques (n,) of the joints that carry no palm: the arm stands, and is not pressed with."""
    torque = torque.copy()
    torque[list(robot.arm)] = 0.0
    return torque


def _blocks(rows: np.ndarray) -> np.ndarray:
    """Rows (k, r, 3), each over its own contact's force, as one matrix (k r, 3k)."""
    k, r, _ = rows.shape
    A = np.zeros((k, r, k, 3))
    A[np.arange(k), :, np.arange(k)] = rows
    return A.reshape(k * r, 3 * k)


def _padded(law: ForceLaw, felt: Felt) -> Level:
    """The law's level over all unknowns."""
    level, k = law.level(felt), felt.grasp.k
    width = level.A.shape[1]
    if width not in (3 * k, 4 * k):
        raise InputError(
            f"the law of force {law.name!r} has rows of {width}; {k} contacts have {3 * k} forces, "
            f"and margins after them, {4 * k} in all"
        )
    A = np.zeros((len(level.A), 4 * k))
    A[:, :width] = level.A
    return Level(A, level.lower, level.upper, law.name)


def _joined(levels: list[Level], names: list[str]) -> Level:
    if len(levels) == 1:
        return levels[0]
    return Level(
        np.concatenate([level.A for level in levels]),
        np.concatenate([level.lower for level in levels]),
        np.concatenate([level.upper for level in levels]),
        " + ".join(names),
    )


# ---------------------------------------------------------------- simpler ways, to compare with


def equal_normal(robot: Robot, grasp: Grasp, total: float) -> np.ndarray:
    """Torques (n,) [N·m] of forces along the normals, all alike, `total` [N] in all."""
    return _press(robot, grasp, np.full(grasp.k, total / grasp.k))


def normal_null_space(robot: Robot, grasp: Grasp, total: float) -> np.ndarray:
    """Torques (n,) [N·m] of the forces along the normals that leave the least net wrench.

    They are `total` [N] in all. Moments are about the contacts' centroid and over their mean
    distance from it, and so weigh as forces do. Where the normals balance, these forces are the
    null space of their grasp map.
    """
    x, k = grasp.positions, grasp.k
    G = grasp_map(x, x.mean(axis=0)) @ _blocks(-grasp.normals[:, None, :]).T  # (6, k)
    G[3:] /= arm(x)
    answer = QUICKEST.solve(
        [
            Level(np.eye(k), np.zeros(k), np.full(k, np.inf), "push"),
            Level.equal(np.ones((1, k)), np.array([total]), "strength"),
            Level.equal(G, np.zeros(6), "balance"),
        ]
    )
    if not answer.certified:
        raise SolverError(f"normal_null_space: {'; '.join(answer.failed)}")
    return _press(robot, grasp, answer.x)


def _press(robot: Robot, grasp: Grasp, normal: np.ndarray) -> np.ndarray:
    """Torques (n,) for normal forces (k,) [N] without friction, none at the palm's joints."""
    forces = -grasp.normals * normal[:, None]
    return _of_fingers(robot, contact_jacobian(robot, grasp).T @ forces.ravel())


def equal_torque(robot: Robot, grasp: Grasp, total: float) -> np.ndarray:
    """Torques (n,) [N·m], alike for all fingers as they close, for normal forces of `total` [N].

    A finger closes along its row w of `robot.closing`, and torque T w pushes along the normal with
    T |w|²/(−n·J w), as a lever does: a contact on no closing finger is pushed by none.
    """
    names = [point.name for point in robot.description.contact_points]
    J = contact_jacobian(robot, grasp).reshape(grasp.k, 3, robot.n)
    torque, push = np.zeros(robot.n), 0.0
    for contact, Ji in zip(grasp.contacts, J, strict=True):
        if contact.name not in names:
            continue
        w = robot.closing[names.index(contact.name)]
        lever = float(-contact.normal @ Ji @ w)
        if not lever > 0.0:
            raise InputError(f"closing {contact.name!r} does not push on the object here")
        torque += w
        push += float(w @ w) / lever
    if push == 0.0:
        raise InputError("equal_torque: no contact of the grasp is on a finger that closes")
    return torque * (total / push)
