"""Priority levels, and solutions that certify themselves: algebra only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from hqp_grasp.errors import InputError, SolverError, number
from hqp_grasp.hierarchy.certificate import measure, optimality_faults
from hqp_grasp.kernels import njit

CERTIFICATE_TOLERANCE = 1e-8  # [–] row-scaled; what `is_optimal` asks unless told otherwise


def _floats(name: str, value: object, ndim: int) -> np.ndarray:
    """A copy of `value`: what the caller does to it later, as mj_jacSite does, changes no level."""
    try:
        array = np.array(value, dtype=float, order="C")
    except (TypeError, ValueError) as error:
        raise InputError(f"Level.{name} must be an array of numbers; got {value!r}") from error
    if array.ndim != ndim:
        raise InputError(f"Level.{name} must have {ndim} dimension(s); got shape {array.shape}")
    return array


@njit(cache=True, error_model="numpy")
def _constructs(A, lower, upper):  # type: ignore[no-untyped-def]
    """Whether all is as `Level` asks; NaN compares false."""
    m, n = A.shape
    for i in range(m):
        if not lower[i] <= upper[i] or lower[i] == np.inf or upper[i] == -np.inf:
            return False
        for j in range(n):
            if not np.isfinite(A[i, j]):
                return False
    return True


@dataclass(frozen=True, eq=False)
class Level:
    """Rows lower ≤ A x ≤ upper of one priority level, met in the least-squares sense.

    Rows that contradict one another are no error: the level is resolved to its nearest point.
    The arrays are copied and locked, so that a level is a value whatever becomes of the buffers it
    was built from. Copies and checks take some 2 µs (`benchmarks/where_time_goes.py`).
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
        if not _constructs(A, lower, upper):
            raise self._fault(A, lower, upper)
        for field, array in (("A", A), ("lower", lower), ("upper", upper)):
            array.setflags(write=False)
            object.__setattr__(self, field, array)

    def __reduce__(self) -> tuple[type[Level], tuple[object, ...]]:
        """What is unpickled, or copied deeply, is built anew: checked, and locked again."""
        return type(self), (self.A, self.lower, self.upper, self.name)

    def _fault(self, A: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> InputError:
        """What keeps the first faulty row from being one."""
        label = f"Level {self.name!r}" if self.name else "Level"
        sound = np.isfinite(A).all(axis=1) & (lower <= upper) & (lower < np.inf) & (upper > -np.inf)
        row = int(np.argmin(sound))
        low, high = lower[row], upper[row]
        if not np.isfinite(A[row]).all():
            return InputError(f"{label}: row {row} of A is not finite: {A[row]}")
        if np.isnan(low) or np.isnan(high):
            return InputError(f"{label}: row {row} has a NaN bound: [{low}, {high}]")
        if low > high:
            return InputError(f"{label}: row {row} has lower > upper: [{low}, {high}]")
        return InputError(
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
    multipliers: np.ndarray  # (M, p + 1): column k proves level k, the last that x is the shortest
    method: str  # what found x: a name of `solvers()`, "one row at a time", "projection", …
    failed: tuple[str, ...] = ()  # what was tried before, or fell short, and why
    certified: bool = False  # shown to be optimal; else the best effort within the budget
    rank_tolerance: float | None = None  # [–] the solver's; None: the default rule

    @property
    def limit_active(self) -> bool:
        """True where some inequality row holds x at a bound."""
        return bool((np.abs(self.active) == 1).any())

    @property
    def certified_x(self) -> np.ndarray:
        """x (n,), for those who act on it; raises SolverError where it is not certified."""
        if not self.certified:
            tried = "; ".join(self.failed)
            raise SolverError(f"the best x found is not certified, and so not used: {tried}")
        return self.x

    def is_optimal(
        self, levels: Level | Sequence[Level], tol: float = CERTIFICATE_TOLERANCE
    ) -> bool:
        """True where x is the lexicographic least-squares optimum of `levels`, to `tol`.

        Level k is optimal, given those above, when −A_kᵀ w_k is a combination of the rows above
        that hold x: of either sign for equalities and rows that cannot be met, pushing inwards
        for rows at a bound. Where the multipliers at hand do not show it, others are searched by
        non-negative least squares (degenerate active sets have many). No solver takes part.
        What lies below the rank tolerance is asked for by no level.

        Raises InputError where `levels` are not of the size of this solution.
        """
        return not optimality(
            stack(levels, self.rank_tolerance), self.x, self.multipliers, number("tol", tol)
        ).faults


def tolerance_of(rank_tolerance: object) -> float | None:
    """A solver's rank tolerance [–] as a float in [0, 1), or None; else raise InputError."""
    if rank_tolerance is None:
        return None
    found = number("rank_tolerance", rank_tolerance)
    if not 0.0 <= found < 1.0:
        raise InputError(f"rank_tolerance must lie in [0, 1); got {rank_tolerance}")
    return found


class Stacked(NamedTuple):
    """All levels one above the other: the form in which solvers and certificate read them."""

    A: np.ndarray  # (M, n)
    lower: np.ndarray  # (M,)
    upper: np.ndarray  # (M,)
    offsets: np.ndarray  # (p + 1,) level k owns rows offsets[k]:offsets[k+1]
    row_norm: np.ndarray  # (M,)
    frobenius: np.ndarray  # (p,) ‖A_k‖_F
    floor: np.ndarray  # (p,) rank tolerance × ‖A_k‖_F: what a level asks for by less is not asked

    def with_rank(self, tolerance: float) -> Stacked:
        """The same levels seen with another rank tolerance."""
        A, lower, upper, offsets = self.A, self.lower, self.upper, self.offsets
        return Stacked(A, lower, upper, offsets, *measure(A, lower, upper, offsets, tolerance))


def stack(levels: Level | Sequence[Level], rank_tolerance: float | None = None) -> Stacked:
    """Stack levels; raise InputError for what is none, or where the numbers of unknowns differ."""
    if isinstance(levels, Level):
        levels = [levels]
    try:
        if not levels:
            raise InputError("a hierarchy needs at least one level")
        A = np.concatenate([level.A for level in levels])
        lower = np.concatenate([level.lower for level in levels])
        upper = np.concatenate([level.upper for level in levels])
    except (TypeError, AttributeError) as error:
        raise InputError(f"levels must be hg.Level objects, first level first; {error}") from error
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        widths = [level.A.shape[1] for level in levels]
        raise InputError(f"levels disagree on the number of unknowns: {widths}") from error
    offsets = np.array([0, *accumulate(len(level.lower) for level in levels)])
    tolerance = -1.0 if rank_tolerance is None else rank_tolerance
    return Stacked(A, lower, upper, offsets, *measure(A, lower, upper, offsets, tolerance))


class Optimality(NamedTuple):
    """What the certificate says about an x."""

    residual: np.ndarray  # (M,) 0 where it is rounding
    missed: np.ndarray  # (p,) levels with a residual
    faults: dict[int, tuple[float, str]]  # by level, p: shortness; imbalance [–] above 1, and words


def optimality(
    rows: Stacked,
    x: np.ndarray,
    multipliers: np.ndarray,
    tol: float = CERTIFICATE_TOLERANCE,
    shortest: bool = False,
) -> Optimality:
    """Judge x: the checked door to the compiled certificate.

    `shortest` asks whether x is also the shortest optimum; multipliers then need p + 1 columns.
    Raises InputError where x or multipliers are not of the size of the levels.
    """
    M, n = rows.A.shape
    columns = len(rows.frobenius) + shortest
    if x.shape != (n,):
        raise InputError(f"levels have {n} unknowns; the solution's x has shape {x.shape}")
    if multipliers.ndim != 2 or len(multipliers) != M or multipliers.shape[1] < columns:
        raise InputError(
            f"levels of {M} rows need multipliers ({M}, {columns}); "
            f"the solution's have shape {multipliers.shape}"
        )
    return Optimality(
        *optimality_faults(
            rows.A,
            rows.lower,
            rows.upper,
            rows.offsets,
            x,
            multipliers,
            tol,
            rows.row_norm,
            rows.floor,
            shortest,
        )
    )
