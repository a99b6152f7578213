"""The kinematic law: closing a finger should push along the normal of its contact."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeGuard

import numpy as np

from hqp_grasp.errors import InputError, SingularTaskError, one_of
from hqp_grasp.grasp import Contact, Grasp
from hqp_grasp.tasks.stack import Task

SETTLES = {"gradient": 0.6, "rows": 0.25}  # gain of each form, unless another is given
ALIGNED = 1e-9  # [rad] nearer to its minimum than this, an error has no direction of descent
STILL = 1e-9  # [m/rad] flexion joints that move their contact slower than this do not move it
EQUAL_SPEEDS = 1e-6  # [–] relative difference of two singular values below which they are equal


@dataclass(frozen=True, init=False)
class KinematicTask(Task):
    """How far closing is from moving its contact along the normal (paper, section 2.3).

    With J_i = ∂x_i/∂q (3, n), w_i the contact's `closing` (n,), and J_γ = ∂x_i/∂γ_i (3, g) the
    columns of its flexion joints γ_i:

    - error="angle": ε_i = arccos(|n·J_i w_i|/|J_i w_i|) [rad], the angle between the normal and
      the way the contact moves as it closes, whichever joints of finger or arm close it. For one
      flexion joint that is arccos(|n·J_γ|/|J_γ|), as in Figure 3. For contacts that tell several
      flexion joints and no closing, it is what section 2.3 asks for: the angle between n and the
      leading left singular vector of J_γ, the major axis of the velocity ellipsoid and so the
      minor axis of the force ellipsoid.
    - error="eq7": ε_i = (nᵀ J_γ J_γᵀ n)^½ [m/rad] (paper, eq. 7–8). Descending it does the
      opposite: the flexion turns tangent to the surface.

    `potential` is their sum ε_c and `gradient` its slope (paper, eq. 8–9). As in eq. 9 the contact
    is a point of the hand, and its normal is held fixed: a touch that runs along its link as the
    link turns (`Grasp.rolling`) presses no harder for it.

    - form="gradient", the default: the paper's dq_c ∝ −∂ε_c/∂q as a level of n rows,
      x = −gain·∂ε_c/∂q. It fixes every joint, so nothing below it is felt. Here gain
      has the unit rad²/(unit of ε): rad for "angle", rad³/m for "eq7".
    - form="rows": one Newton row per contact, J_i x = −gain·ε_i, with gain [–], which leaves the
      other joints to laws below. Full steps aim at a zero that most hands cannot reach, and chatter
      about the minimum; a quarter settles.
    """

    kind: str  # "angle" or "eq7"
    form: str  # "rows" or "gradient"

    # Written by hand because the keyword is called error, and so is the method: the choice is
    # stored as `kind`, which dataclasses.replace hands back.
    def __init__(
        self,
        error: str | None = None,
        form: str = "gradient",
        *,
        gain: float | None = None,
        weight: float = 1.0,
        kind: str = "angle",
    ) -> None:
        set_field = object.__setattr__
        chosen = kind if error is None else error
        set_field(self, "kind", one_of("KinematicTask error", chosen, ["angle", "eq7"]))
        set_field(self, "form", one_of("KinematicTask form", form, ["rows", "gradient"]))
        set_field(self, "gain", SETTLES[form] if gain is None else gain)
        set_field(self, "weight", weight)
        self.__post_init__()

    @property
    def unit(self) -> str:
        """[rad] for "angle", [m/rad] for "eq7"."""
        return "rad" if self.kind == "angle" else "m/rad"

    def __repr__(self) -> str:
        return (
            f"KinematicTask(error={self.kind!r}, form={self.form!r}, "
            f"gain={self.gain!r}, weight={self.weight!r})"
        )

    def error(self, grasp: Grasp) -> np.ndarray:
        """ε_i of each contact (k,), [rad] for "angle", [m/rad] for "eq7"."""
        return self._error_and_slope(grasp, self._ways(grasp))[0]

    def jacobian(self, grasp: Grasp) -> np.ndarray:
        """∂ε_i/∂q (k, n): the terms of eq. 9, for γ_i of any dimension; w_i is held fixed.

        For one flexion joint and "eq7" this is eq. 10 with the sign(n·J_γ) that it lacks. A row
        is zero where its error is at its minimum, 0 (there ε_i has a kink and zero is one of its
        subgradients); elsewhere it stays bounded. At |n·J_γ| = 0 the angle has its maximum, also
        a kink, and the row is one of the two one-sided slopes, so that descent leaves it.
        """
        return self._error_and_jacobian(grasp)[1]

    def potential(self, grasp: Grasp) -> float:
        """ε_c = Σ ε_i (paper, eq. 8)."""
        return float(self.error(grasp).sum())

    def gradient(self, grasp: Grasp) -> np.ndarray:
        """∂ε_c/∂q (n,) (paper, eq. 9)."""
        return self.jacobian(grasp).sum(axis=0)

    def step(self, grasp: Grasp) -> np.ndarray:
        """x = −gain·∂ε_c/∂q (n,) [rad], as the paper's form takes it (q̇_c of eq. 13).

        An angle has a kink at zero, where its slope does not fade. One joint hardly ever brings it
        there; a contact that several joints close does, and would go to and fro about it: it
        asks for no more than its own Newton step.
        """
        several = np.array([_joints(contact) > 1 for contact in grasp.contacts])
        if self.kind != "angle" or not several.any():
            return -self.gain * self.gradient(grasp)
        e, J = self._error_and_jacobian(grasp)
        square = (J * J).sum(axis=1)
        newton = e / np.where(square > 0.0, square, 1.0)
        return -np.where(several, np.minimum(self.gain, newton), self.gain) @ J

    def rows(self, grasp: Grasp) -> tuple[np.ndarray, np.ndarray]:
        """The equality rows (A, b) asked of x = Δq: see `form` in the class's description."""
        if self.form == "gradient":
            b = (-self.weight * self.gain) * self.gradient(grasp)
            return self.weight * np.eye(grasp.n), b
        e, J = self._error_and_jacobian(grasp)
        return self.weight * J, (-self.weight * self.gain) * e

    def _error_and_jacobian(self, grasp: Grasp) -> tuple[np.ndarray, np.ndarray]:
        """ε (k,) and ∂ε/∂q (k, n), over the entries of J_i W_i: Σ ∂ε/∂(J_i W_i) · ∂J_i/∂q W_i."""
        if grasp.hessian is None:
            raise InputError(
                "KinematicTask.jacobian needs second derivatives: build the Grasp with "
                f"hessian = ∂²x/∂q² of shape {(3 * grasp.k, grasp.n, grasp.n)}"
            )
        k, n = grasp.k, grasp.n
        ways = self._ways(grasp)
        e, slope = self._error_and_slope(grasp, ways)
        dJW = (ways[:, None] @ grasp.hessian.reshape(k, 3, n, n)).swapaxes(1, 2)  # (k, g, 3, n)
        J = slope.reshape(k, 1, -1) @ dJW.reshape(k, -1, n)
        return e, J[:, 0]

    def _error_and_slope(self, grasp: Grasp, ways: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """ε (k,) and ∂ε/∂(J_i W_i)ᵀ (k, g, 3)."""
        WTJT = ways @ grasp._of_links.swapaxes(1, 2)  # (k, g, 3)
        if self.kind == "eq7":
            return _eq7(grasp.normals, WTJT)
        return _angle(grasp, WTJT)

    def _ways(self, grasp: Grasp) -> np.ndarray:
        """Ways W_iᵀ (k, g, n) for q to go as each contact closes; what is left of g is zero.

        One along `closing` for an angle where a contact tells it, else one for each flexion joint.
        """
        sets: list[list[np.ndarray]] = []
        one = np.eye(grasp.n)
        for i, contact in enumerate(grasp.contacts):
            w = contact.closing if self.kind == "angle" else None
            if w is not None and w.any():
                sets.append([w / np.abs(w).max()])
            elif w is None and contact.flexion:
                sets.append([one[j] for j in sorted(set(contact.flexion))])
            else:
                raise InputError(
                    f"KinematicTask: {_label(grasp, i)} has no flexion joint; give "
                    "Contact.flexion the indices into q of the joints that press it"
                )
        ways = np.zeros((grasp.k, max(map(len, sets)), grasp.n))
        for way, rows in zip(ways, sets, strict=True):
            way[: len(rows)] = rows
        return ways


def _joints(contact: Contact) -> int:
    """How many joints close a contact that tells it."""
    return 0 if contact.closing is None else int(np.count_nonzero(contact.closing))


def is_kinematic(task: Task) -> TypeGuard[KinematicTask]:
    """Whether the paper's form has this law last, in joint space."""
    return isinstance(task, KinematicTask)


def _eq7(normals: np.ndarray, JT: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """ε = |J_γᵀ n| and its slope ∂ε/∂J_γᵀ = (J_γᵀ n/ε) nᵀ (paper, eq. 7 and 9)."""
    w = (JT @ normals[:, :, None])[:, :, 0]  # (k, g): speed along the normal, joint by joint
    e = np.sqrt((w * w).sum(axis=1))
    speed = np.sqrt((JT * JT).sum(axis=(1, 2)))
    moves = e > ALIGNED * speed
    unit = w * (moves / np.where(moves, e, 1.0))[:, None]
    return e, unit[:, :, None] * normals[:, None, :]


def _angle(grasp: Grasp, JT: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angle ε between n and u, the leading left singular vector of J_γ, and ∂ε/∂J_γᵀ.

    t = (n − (n·u)u)/sin ε turns u towards n: dε = −sign(n·u) t·du. With λ_j the squares of the
    singular values, du = P (dJ_γ J_γᵀ + J_γ dJ_γᵀ) u, P = Σ_{j≥2} u_j u_jᵀ/(λ_1 − λ_j).
    """
    normals = grasp.normals
    if JT.shape[1] == 1:  # one joint: λ_2 = λ_3 = 0
        sigma = np.sqrt((JT * JT).sum(axis=2))  # (k, 1)
        _refuse_still(grasp, sigma[:, 0])
        u = JT[:, 0] / sigma
        t, e, sign = _turn(normals, u)
        return e, (t * (-sign[:, None] / sigma))[:, None, :]
    _, sigma, axes = np.linalg.svd(JT)  # rows of axes (k, 3, 3): u_1, u_2, u_3
    _refuse_still(grasp, sigma[:, 0])
    _refuse_equal_speeds(grasp, sigma)
    lam = np.zeros((len(JT), 3))
    lam[:, : sigma.shape[1]] = sigma**2
    u = axes[:, 0]
    t, e, sign = _turn(normals, u)
    minor = axes[:, 1:]
    y = (minor @ t[:, :, None])[:, :, 0] / (lam[:, :1] - lam[:, 1:])
    Pt = (y[:, None, :] @ minor)[:, 0]  # (k, 3)
    JTu, JTPt = JT @ u[:, :, None], JT @ Pt[:, :, None]  # (k, g, 1)
    return e, -sign[:, None, None] * (JTu * Pt[:, None, :] + JTPt * u[:, None, :])


def _turn(n: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit t ⟂ u towards n, or zero where n ∥ u; the angle in [0, π/2]; sign(n·u), never 0."""
    cosine = (n * u).sum(axis=1)
    t = n - cosine[:, None] * u
    sine = np.sqrt((t * t).sum(axis=1))
    turned = sine > ALIGNED
    t *= (turned / np.where(turned, sine, 1.0))[:, None]
    return t, np.arctan2(sine, np.abs(cosine)), np.copysign(1.0, cosine)


def _refuse_still(grasp: Grasp, speed: np.ndarray) -> None:
    """Raise where the flexion joints do not move their contact: no angle is defined."""
    if speed.min() <= STILL:
        i = int(speed.argmin())
        raise SingularTaskError(
            f"{_label(grasp, i)}: its flexion joints {grasp.contacts[i].flexion} do not move it "
            f"({speed[i]:.1e} m/rad), so its angle to the normal is undefined; check "
            "Contact.flexion, or use KinematicTask(error='eq7')"
        )


def _refuse_equal_speeds(grasp: Grasp, sigma: np.ndarray) -> None:
    """Raise where two singular values lead: the flexion then has no one direction."""
    equal = sigma[:, 0] - sigma[:, 1] <= EQUAL_SPEEDS * sigma[:, 0]
    if equal.any():
        i = int(equal.argmax())
        raise SingularTaskError(
            f"{_label(grasp, i)}: its flexion joints {grasp.contacts[i].flexion} move it equally "
            f"fast in two directions ({sigma[i, 0]:.6g} m/rad), so its angle to the normal is "
            "undefined; leave fewer joints in Contact.flexion, or use KinematicTask(error='eq7')"
        )


def _label(grasp: Grasp, i: int) -> str:
    """Contact i, as an error message calls it."""
    name = grasp.contacts[i].name
    return f"contact {i} ({name!r})" if name else f"contact {i}"
