"""What touch told us: contacts on an object as plain arrays, or why there are none."""

from __future__ import annotations

import operator
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property

import numpy as np

from hqp_grasp.errors import InputError, instance, not_negative

BEYOND = 4.0  # times the floor of noise, within which a felt error says nothing
UNIT_NORMAL_TOLERANCE = 1e-6  # | ‖n‖ − 1 | accepted in a sensed normal


def as_array(name: str, value: object, shape: tuple[int | None, ...]) -> np.ndarray:
    """Return `value` as a finite float array of `shape` (None: any length) or raise InputError."""
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be an array of numbers; got {value!r}") from error
    if array.shape != shape and not _fits(array.shape, shape):
        wanted = "(" + ", ".join("any" if s is None else str(s) for s in shape) + ")"
        raise InputError(f"{name} must have shape {wanted}; got {array.shape}")
    if 0 in np.isfinite(array).tobytes():  # as .all() would tell, in a third of its time
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise InputError(f"{name} must be finite; entry {where} is {array[where]}")
    array.setflags(write=False)
    return array


def _fits(got: tuple[int, ...], wanted: tuple[int | None, ...]) -> bool:
    return len(got) == len(wanted) and all(w in (None, g) for g, w in zip(got, wanted, strict=True))


@dataclass(frozen=True, eq=False)
class Contact:
    """One place where the hand touches the object.

    Everything after `normal` is optional: a law that needs it says so. A contact belongs to a
    body, not to a finger: any link of any robot can hold one.

    A link that is no ball may lie along the object. As it turns by ω [rad] its touch then runs
    along it, by `stretch` (ω × n) beyond what a ball of `tip_radius` rolls.
    """

    position: np.ndarray  # (3,) [m], world
    normal: np.ndarray  # (3,) unit, outward from the object, world
    name: str = ""  # the robot's contact point that touches
    body: str = ""  # the link it belongs to
    point: np.ndarray | None = None  # (3,) [m], body frame: the point whose motion `jacobian` gives
    group: str = ""  # the robot's group of contact points that it belongs to, such as a hand
    flexion: tuple[int, ...] = ()  # γ_i: indices into q of the joints that press this contact
    closing: np.ndarray | None = None  # (n,) [rad] how q moves as they press it, signed
    tip_radius: float = 0.0  # [m] from `point` to the touching surface; 0 for a material point
    stretch: np.ndarray | None = None  # (3, 3) [m/rad], world; None on a ball
    wrench: np.ndarray | None = None  # (6,) force [N], torque [N·m] on the tip, when sensed
    noise: float = 0.0  # [rad] standard error of `normal` about each axis across it, when sensed

    def __post_init__(self) -> None:
        set_field = object.__setattr__
        set_field(self, "position", as_array("Contact.position", self.position, (3,)))
        normal = as_array("Contact.normal", self.normal, (3,))
        length = float(np.linalg.norm(normal))
        if abs(length - 1.0) > UNIT_NORMAL_TOLERANCE:
            raise InputError(f"Contact.normal must be a unit vector; its length is {length:.9g}")
        set_field(self, "normal", normal)
        if self.point is not None:
            set_field(self, "point", as_array("Contact.point", self.point, (3,)))
        if self.stretch is not None:
            set_field(self, "stretch", as_array("Contact.stretch", self.stretch, (3, 3)))
        if self.wrench is not None:
            set_field(self, "wrench", as_array("Contact.wrench", self.wrench, (6,)))
        if self.closing is not None:
            set_field(self, "closing", as_array("Contact.closing", self.closing, (None,)))
        try:
            set_field(self, "flexion", tuple(operator.index(i) for i in self.flexion))
        except TypeError as error:
            raise InputError(
                f"Contact.flexion must list indices into q; got {self.flexion!r}"
            ) from error
        for name in ("tip_radius", "noise"):
            set_field(self, name, not_negative(f"Contact.{name}", getattr(self, name)))


@dataclass(frozen=True, eq=False)
class Frame:
    """Where the palm of a group of contact points is, and how it moves."""

    name: str  # the group's
    position: np.ndarray  # (3,) [m], world
    rotation: np.ndarray  # R_world_palm (3, 3): z approach axis, x opposition axis
    jacobian: np.ndarray  # (6, n) velocity [m/rad] and angular velocity [–] for each joint, world

    def __post_init__(self) -> None:
        shapes = {"position": (3,), "rotation": (3, 3), "jacobian": (6, None)}
        for name, shape in shapes.items():
            value = as_array(f"Frame.{name}", getattr(self, name), shape)
            object.__setattr__(self, name, value)


@dataclass(frozen=True, eq=False)
class Grasp:
    """A hand posture and the k contacts felt there.

    `jacobian` stacks ∂x_i/∂q over the contacts (paper, eq. 12). x_i is the point whose motion
    carries contact i: for a round fingertip the centre of the sphere, `tip_radius` away from the
    touching surface. Where contacts have a `stretch`, `rolling` is what of `jacobian` comes of it,
    and the rest is the motion of x_i as a point of its link; `hessian[a, j, l]` is ∂²x_a/∂q_j∂q_l
    of these points' 3k coordinates.
    """

    q: np.ndarray  # (n,) independent joints [rad]
    contacts: tuple[Contact, ...]  # k of them
    jacobian: np.ndarray  # (3k, n) [m/rad], world
    hessian: np.ndarray | None = None  # (3k, n, n) [m/rad²], world
    rolling: np.ndarray | None = None  # (3k, n) [m/rad], world; None where no contact has a stretch
    coupling: np.ndarray | None = None  # C (N, n): q_full = C q + c₀; identity when None
    offset: np.ndarray | None = None  # c₀ (N,); zero when None
    other_links: tuple[str, ...] = ()  # geoms beside the contact points that touch the object
    frames: tuple[Frame, ...] = ()  # one for each group of contact points
    model: object = field(
        default=None, repr=False
    )  # compiled robot, read by mink's tasks; not stored
    _J3: np.ndarray = field(init=False, repr=False)  # (k, 3, n) view of jacobian
    _of_links: np.ndarray = field(init=False, repr=False)  # (k, 3, n) the same without rolling

    def __post_init__(self) -> None:
        set_field = object.__setattr__
        q = as_array("Grasp.q", self.q, (None,))
        n = len(q)
        try:
            contacts = tuple(self.contacts)
        except TypeError as error:
            raise InputError(
                f"Grasp.contacts must list Contact values; got {self.contacts!r}"
            ) from error
        if not contacts:
            raise InputError("Grasp.contacts is empty: a grasp has at least one contact")
        for contact in contacts:
            if not isinstance(contact, Contact):
                raise InputError(f"Grasp.contacts holds {contact!r}; it must hold Contact values")
            for i in contact.flexion:
                if not 0 <= i < n:
                    raise InputError(f"Contact.flexion index {i} is outside 0 … {n - 1}")
            if contact.closing is not None and len(contact.closing) != n:
                raise InputError(
                    f"Contact.closing must have shape ({n},), one entry for each joint of "
                    f"Grasp.q; got {contact.closing.shape}"
                )
        set_field(self, "frames", _frames(self.frames, n))
        k = len(contacts)
        jacobian = as_array("Grasp.jacobian", self.jacobian, (3 * k, n))
        if self.hessian is not None:
            set_field(self, "hessian", as_array("Grasp.hessian", self.hessian, (3 * k, n, n)))
        coupling = np.eye(n) if self.coupling is None else self.coupling
        coupling = as_array("Grasp.coupling", coupling, (None, n))
        offset = np.zeros(len(coupling)) if self.offset is None else self.offset
        set_field(self, "offset", as_array("Grasp.offset", offset, (len(coupling),)))
        set_field(self, "coupling", coupling)
        set_field(self, "q", q)
        set_field(self, "contacts", contacts)
        set_field(self, "jacobian", jacobian)
        set_field(self, "_J3", jacobian.reshape(k, 3, n))
        set_field(self, "_of_links", self._J3)
        if self.rolling is not None:
            set_field(self, "rolling", as_array("Grasp.rolling", self.rolling, (3 * k, n)))
            set_field(self, "_of_links", self._J3 - self.rolling.reshape(k, 3, n))

    def __getstate__(self) -> dict[str, object]:
        """What pickling keeps: not the model, which is large and the robot's own."""
        return self.__dict__ | {"model": None}

    @property
    def k(self) -> int:
        """Number of contacts."""
        return len(self.contacts)

    @property
    def n(self) -> int:
        """Number of independent joints."""
        return len(self.q)

    @cached_property
    def positions(self) -> np.ndarray:
        """Contact positions (k, 3) [m], world."""
        return as_array("Grasp.positions", [c.position for c in self.contacts], (self.k, 3))

    @cached_property
    def normals(self) -> np.ndarray:
        """Outward unit normals (k, 3), world."""
        return as_array("Grasp.normals", [c.normal for c in self.contacts], (self.k, 3))

    @cached_property
    def centers(self) -> np.ndarray:
        """c_i = x_i + ρ_i n_i (k, 3) [m], world: the round tips' centres."""
        rho = np.array([[contact.tip_radius] for contact in self.contacts])
        return as_array("Grasp.centers", self.positions + rho * self.normals, (self.k, 3))

    @cached_property
    def floor(self) -> tuple[float, float]:
        """ε_f [N²] and ε_m [(N·m)²] that noise makes of these contacts in balance, on average.

        With the noise σ_i of the normals, about two axes each, ε_f = 2 Σ σ_i² and
        ε_m = 2 Σ σ_i² |x_i − x̄|².
        """
        square = 2.0 * np.array([c.noise for c in self.contacts]) ** 2
        away = self.positions - self.positions.mean(axis=0)
        return float(square.sum()), float(square @ (away * away).sum(axis=1))

    @property
    def q_full(self) -> np.ndarray:
        """All joints of the model, C q + c₀ (N,) [rad]."""
        return self.coupling @ self.q + self.offset

    def contact_jacobian(self, i: int) -> np.ndarray:
        """∂x_i/∂q (3, n) [m/rad] of contact i."""
        return self._J3[i]

    def normal_jacobian(self) -> np.ndarray:
        """n_iᵀ ∂x_i/∂q, one row per contact (k, n) [m/rad]: motion off the surface."""
        return (self.normals[:, None, :] @ self._J3)[:, 0]


def _frames(value: object, n: int) -> tuple[Frame, ...]:
    try:
        frames: tuple[Frame, ...] = tuple(value)  # type: ignore[arg-type]
    except TypeError as error:
        raise InputError(f"Grasp.frames must list Frame values; got {value!r}") from error
    for frame in frames:
        if not isinstance(frame, Frame):
            raise InputError(f"Grasp.frames holds {frame!r}; it must hold Frame values")
        if frame.jacobian.shape != (6, n):
            raise InputError(
                f"Frame.jacobian of {frame.name!r} must have shape (6, {n}), a column for each "
                f"joint of Grasp.q; got {frame.jacobian.shape}"
            )
    names = [frame.name for frame in frames]
    if len(set(names)) < len(names):
        raise InputError(f"Grasp.frames has one frame for each group; their names are {names}")
    return frames


class Miss(Enum):
    """Why a probe ended without a grasp."""

    NO_TOUCH = "a finger closed without touching"
    INSIDE = "a fingertip began inside the object"
    OTHER_LINK = "another link touches the object"
    BLOCKED = "the hand stopped itself on the way"
    STUCK = "the hand does not open"
    OWN_LINK = "a finger closed onto the hand itself"
    TABLE = "a fingertip met what the object stands on"
    LOST = "a contact was lost while the hand held"
    UNCLEAR = "what a fingertip feels is no push on it"
    SENSOR = "a fingertip's sensor does not answer"


@dataclass(frozen=True)
class Missed:
    """A probe that brought no grasp."""

    reason: Miss
    where: str  # the contact point or link

    def __post_init__(self) -> None:
        instance("Missed.reason", self.reason, Miss)


@dataclass(frozen=True, eq=False)
class Touch:
    """One probe: where the hand was sent, and what it felt there."""

    q_target: np.ndarray  # (n,) independent joints [rad]
    felt: Grasp | Missed

    def __post_init__(self) -> None:
        object.__setattr__(self, "q_target", as_array("Touch.q_target", self.q_target, (None,)))
        if not isinstance(self.felt, Grasp | Missed):
            raise InputError(f"Touch.felt must be a Grasp or a Missed; got {self.felt!r}")
        if isinstance(self.felt, Grasp) and self.felt.n != len(self.q_target):
            raise InputError(
                f"Touch.q_target has {len(self.q_target)} joints, its grasp {self.felt.n}"
            )
