"""Priority levels, solutions, and the optimality certificate: algebra only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from hqp_grasp.errors import InputError

EPS = float(np.finfo(float).eps)
VANISHED = 1e-3  # [–] of the x that the levels ask for; shorter ones are judged as if this long
CERTIFICATE_TOLERANCE = 1e-8  # [–] row-scaled; what `is_optimal` asks unless told otherwise


def _floats(name: str, value: object, ndim: int) -> np.ndarray:
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"Level.{name} must be an array of numbers; got {value!r}") from error
    if array.ndim != ndim:
        raise InputError(f"Level.{name} must have {ndim} dimension(s); got shape {array.shape}")
    return array


@dataclass(frozen=True, eq=False)
class Level:
    """Rows lower ≤ A x ≤ upper of one priority level, met in the least-squares sense.

    Rows that contradict one another are no error: the level is resolved to its nearest point.
    Raises InputError, naming the row, where A is not finite, a bound is NaN, lower > upper,
    lower = +inf or upper = −inf.
    """

    A: np.ndarray  # (m, n)
    lower: np.ndarray  # (m,), −inf where one-sided
    upper: np.ndarray  # (m,), +inf where one-sided
    name: str = ""  # what the rows stand for, in reports

    def __post_init__(self) -> None:
        A = _floats("A", self.A, 2)
        lower, upper = _floats("lower", self.lower, 1), _floats("upper", self.upper, 1)
        m = len(A)
        if lower.shape != (m,) or upper.shape != (m,):
            raise InputError(
                f"Level bounds must have one entry for each of the {m} rows of A; "
                f"lower has {lower.shape}, upper has {upper.shape}"
            )
        # One reduction finds every fault: NaN compares false, inf − inf is NaN.
        if not (np.isfinite(A).all() and (lower <= upper).all()):
            self._explain(A, lower, upper)
        if m and (lower.max() == np.inf or upper.min() == -np.inf):
            self._explain(A, lower, upper)
        object.__setattr__(self, "A", A)
        object.__setattr__(self, "lower", lower)
        object.__setattr__(self, "upper", upper)

    def _explain(self, A: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> None:
        label = f"Level {self.name!r}" if self.name else "Level"
        for row in range(len(A)):
            low, high = lower[row], upper[row]
            if not np.isfinite(A[row]).all():
                raise InputError(f"{label}: row {row} of A is not finite: {A[row]}")
            if np.isnan(low) or np.isnan(high):
                raise InputError(f"{label}: row {row} has a NaN bound: [{low}, {high}]")
            if low > high:
                raise InputError(f"{label}: row {row} has lower > upper: [{low}, {high}]")
            if low == np.inf or high == -np.inf:
                raise InputError(
                    f"{label}: row {row} asks for an infinite value: [{low}, {high}]; "
                    "use lower = −inf or upper = +inf for a side without bound"
                )

    @classmethod
    def equal(cls, A: np.ndarray, b: np.ndarray, name: str = "") -> Level:
        """Rows A x = b."""
        b = _floats("b", b, 1)
        return cls(A, b, b, name)

    @property
    def is_inequality(self) -> bool:
        """True where no row is an equality: such a level only limits."""
        return not bool((self.lower == self.upper).any())

    def residual(self, x: np.ndarray) -> np.ndarray:
        """w = A x − clip(A x, lower, upper), (m,): zero where the row is met."""
        value = self.A @ x
        return value - np.clip(value, self.lower, self.upper)


@dataclass(frozen=True, eq=False)
class LevelReport:
    """How one level came out."""

    name: str
    residual: np.ndarray  # (m,) A x − nearest admissible value
    rank: int  # of its active rows in the freedom left by the levels above
    status: str  # "met", or "nearest" where the levels above left less than it asks


@dataclass(frozen=True, eq=False)
class Solution:
    """The answer to a hierarchy, with the evidence for its optimality."""

    x: np.ndarray  # (n,)
    levels: tuple[LevelReport, ...]
    active: np.ndarray  # (M,) int8 per stacked row: −1 at lower, +1 at upper, 2 equality, 0 free
    multipliers: np.ndarray  # (M, p): column k holds those of the rows above level k
    method: str  # the way that found x
    failed: tuple[str, ...] = ()  # ways tried before whose answers failed the certificate
    rank_tolerance: float = 0.0  # [–] the user's, 0 for the default rule

    @property
    def limit_active(self) -> bool:
        """True where some inequality row holds x at a bound."""
        return bool((np.abs(self.active) == 1).any())

    def is_optimal(self, levels: Sequence[Level], tol: float = CERTIFICATE_TOLERANCE) -> bool:
        """True where x is the lexicographic least-squares optimum of `levels`, to `tol`.

        Level k is optimal, given those above, when −A_kᵀ w_k is a combination of the rows above
        that hold x: of either sign for equalities and rows that cannot be met, pushing inwards
        for rows at a bound. Where the multipliers at hand do not show it, others are searched by
        non-negative least squares (degenerate active sets have many); no QP solver takes part.
        With a rank tolerance of the user's, a level may leave what lies in directions weaker than
        that.
        """
        rows = stack(levels)
        return not optimality_faults(rows, self.x, self.multipliers, tol, self.rank_tolerance)


@dataclass(frozen=True, eq=False)
class Stacked:
    """All levels one above the other: the form in which solvers and certificate read them."""

    A: np.ndarray  # (M, n)
    lower: np.ndarray  # (M,)
    upper: np.ndarray  # (M,)
    offsets: np.ndarray  # (p + 1,) level k owns rows offsets[k]:offsets[k+1]
    equal: np.ndarray  # (M,) bool
    row_norm: np.ndarray  # (M,) ‖a_i‖
    frobenius: np.ndarray  # (p,) ‖A_k‖_F


def stack(levels: Sequence[Level]) -> Stacked:
    """Stack levels; raise InputError where they disagree on the number of unknowns."""
    if not levels:
        raise InputError("a hierarchy needs at least one level")
    try:
        A = np.concatenate([level.A for level in levels])
    except ValueError as error:
        widths = [level.A.shape[1] for level in levels]
        raise InputError(f"levels disagree on the number of unknowns: {widths}") from error
    lower = np.concatenate([level.lower for level in levels])
    upper = np.concatenate([level.upper for level in levels])
    offsets = np.array([0, *(len(level.A) for level in levels)]).cumsum()
    squares = np.einsum("ij,ij->i", A, A)
    frobenius = np.sqrt(_level_sums(squares, offsets))
    return Stacked(A, lower, upper, offsets, lower == upper, np.sqrt(squares), frobenius)


def _level_sums(values: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Sum of the values (M,) of each level (p,); a level without rows sums to 0."""
    sums = np.add.reduceat(np.append(values, 0.0), offsets[:-1])
    sums[offsets[1:] == offsets[:-1]] = 0.0
    return sums


def optimality_faults(
    rows: Stacked,
    x: np.ndarray,
    multipliers: np.ndarray,
    tol: float,
    rank_tolerance: float = 0.0,
    least_norm: bool = False,
) -> list[str]:
    """What keeps x from being certified as the optimum of the hierarchy; empty where nothing does.

    `multipliers` (M, p) or, with least_norm, (M, p + 1): the last column then shows that x is the
    shortest of all optima.
    """
    if not np.isfinite(x).all():
        return ["x is not finite"]
    A, p = rows.A, len(rows.offsets) - 1
    level = np.repeat(np.arange(p), np.diff(rows.offsets))
    value = A @ x
    nearest = np.clip(value, rows.lower, rows.upper)
    length = _length(rows, x, nearest)
    unit = np.abs(nearest) + rows.row_norm * length  # what a row's rounding is measured by
    room = tol * unit
    w = value - nearest
    w[np.abs(w) <= room] = 0.0
    may_push_up = may_push_down = rows.equal | (w != 0.0)
    may_push_up = may_push_up | (value >= rows.upper - room)
    may_push_down = may_push_down | (value <= rows.lower + room)
    columns = p + 1 if least_norm else p
    above = level[:, None] < np.arange(columns)
    forces = np.where(above, multipliers[:, :columns], 0.0)
    forces[np.arange(len(w)), level] = w
    gradient = A.T @ forces  # (n, columns)
    if least_norm:
        gradient[:, p] += x
    units = np.sqrt(_level_sums(unit**2, rows.offsets))
    left = rank_tolerance * np.sqrt(_level_sums(w**2, rows.offsets))
    scale = np.append(rows.frobenius * (tol * units + left), tol * length)[:columns]
    push = forces * rows.row_norm[:, None]
    wrong = above & (
        ((push > scale) & ~may_push_up[:, None]) | ((push < -scale) & ~may_push_down[:, None])
    )
    unbalanced = np.abs(gradient).max(axis=0, initial=0.0) > scale
    faults = []
    for k in np.flatnonzero(unbalanced | wrong.any(axis=0)):
        pull = x if k == p else A[level == k].T @ w[level == k]
        over = level < k
        rest = _least_imbalance(
            pull, A[over], may_push_up[over], may_push_down[over], rows.row_norm[over]
        )
        if rest > scale[k]:
            name = "least norm of x" if k == p else f"level {k}"
            faults.append(f"{name}: imbalance {rest:.1e} exceeds {scale[k]:.1e}")
    return faults


def _length(rows: Stacked, x: np.ndarray, nearest: np.ndarray) -> float:
    """‖x‖, or where x vanishes by cancellation a small part of what the levels ask of it."""
    asked = np.sqrt(_level_sums(nearest**2, rows.offsets))
    some = rows.frobenius > 0.0
    natural = (asked[some] / rows.frobenius[some]).max(initial=0.0)
    return max(float(np.linalg.norm(x)), VANISHED * float(natural))


def _least_imbalance(
    pull: np.ndarray, A: np.ndarray, up: np.ndarray, down: np.ndarray, norm: np.ndarray
) -> float:
    """min ‖pull + Aᵀ λ‖ over λ ≥ 0 where only `up`, ≤ 0 where only `down`, free where both."""
    real = norm > 0.0
    unit = A[real] / norm[real, None]
    up, down = up[real], down[real]
    free = unit[up & down]
    signed = np.concatenate([unit[up & ~down], -unit[down & ~up]])
    if len(free):
        _, sigma, Vt = np.linalg.svd(free, full_matrices=False)
        basis = Vt[sigma > EPS * max(free.shape) * sigma[0]]
        for _ in range(2):
            pull = pull - basis.T @ (basis @ pull)
            signed = signed - (signed @ basis.T) @ basis
    size = float(np.linalg.norm(pull))
    if size == 0.0 or not len(signed):
        return size
    _, rest = nnls(signed.T, -pull / size, maxiter=30 * (1 + len(signed)))
    return float(rest) * size
