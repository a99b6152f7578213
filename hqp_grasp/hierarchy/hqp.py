"""The strict hierarchy of least-squares problems with inequalities, solved exactly."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hqp_grasp.errors import InputError, SolverError, number, one_of
from hqp_grasp.hierarchy import active_set
from hqp_grasp.hierarchy.level import (
    Level,
    LevelReport,
    Solution,
    Stacked,
    optimality,
    stack,
    tolerance_of,
)
from hqp_grasp.hierarchy.qp_solvers import BACKENDS, QPSolverError, active_rows

COARSE = 1e-13  # [–] rank tolerance where the answer by the default's is not certified
OTHERS = ("daqp", "proxqp")  # asked where neither the chosen solver nor the search is certified
MOST = 10**15  # [multiply-adds, steps] days: no budget, and near to what an integer holds
ROUNDS = 10  # in which many rows may change at once, before the search moves one row at a time

# Its name, the levels as it sees them, the active set to start from, and how many levels it takes
# in at first, rounds and steps it makes.
Way = tuple[str, Stacked, np.ndarray, int, int, int]


def solvers() -> tuple[str, ...]:
    """Names that HQP accepts: proxqp, the compiled search, daqp, and what qpsolvers finds."""
    first, *others = BACKENDS
    return (first, "active-set", *others)


@dataclass(frozen=True)
class HQP:
    """Strict lexicographic least squares: each level as nearly as those above allow.

    A QP solver ("proxqp", "daqp", …) solves level after level in the freedom left, and so names
    the inequality rows that hold x; these are settled exactly, as equalities. "active-set" finds
    them by itself, starting from the equalities alone.

    The answer is certified: optimality is checked from x and the levels. Where that fails, the
    search from the equalities is tried, then the other QP solvers, then the search that moves one
    row at a time. If none is certified within the budget, the best of them is returned, and says so
    (`Solution.certified`).
    Where several x are optimal the shortest is returned; where it is not shown to be that,
    `Solution.failed` says so.
    """

    solver: str = "proxqp"  # one of solvers()
    rank_tolerance: float | None = None  # [–] σ counts above this × ‖A_k‖₂; None: max(m, n)·eps
    budget: int = 60_000_000  # [multiply-adds] for one solve: some 50 ms at the very most

    def __post_init__(self) -> None:
        one_of("solver", self.solver, solvers())
        object.__setattr__(self, "rank_tolerance", tolerance_of(self.rank_tolerance))
        budget = number("budget", self.budget)
        if not 0 < budget < MOST:
            raise InputError(
                f"budget must be above 0 and below {MOST:.0e} multiply-adds; got {self.budget}"
            )
        object.__setattr__(self, "budget", int(np.ceil(budget)))

    def solve(self, levels: Level | Sequence[Level], warm: Solution | None = None) -> Solution:
        """Return the optimum of `levels`, first level first.

        `warm`: the solution of a similar hierarchy, whose active set is tried first, whatever the
        solver. Where it does not fit that costs a little time.
        Raises InputError for levels that disagree on the number of unknowns and for a `warm` that
        is no Solution, and SolverError where no way leads to a finite x: numbers beyond the range
        of doubles.
        """
        if not (warm is None or isinstance(warm, Solution)):
            raise InputError(
                "warm must be the Solution of a similar hierarchy, or None; "
                f"got {type(warm).__name__}"
            )
        levels = [levels] if isinstance(levels, Level) else levels
        rows = stack(levels, self.rank_tolerance)
        failed: list[str] = []
        found: list[tuple[tuple[int, float], Solution]] = []
        left = self.budget
        for method, seen, act, first, rounds, steps in self._ways(rows, warm, failed):
            # A guess that needs many steps is dropped: from the equalities the search is surer.
            guess = rounds > 0 and first > 1
            most = left // 4 if guess else left - left // 3
            x, multipliers, rank, made, spent = active_set.search(
                seen, act, first, rounds, steps, most
            )
            left -= min(spent, left)
            if made == steps:
                failed.append(f"{method}: not settled from the warm start in {steps} steps")
                continue
            judged = optimality(rows, x, multipliers, shortest=True)
            off = rows.offsets.tolist()
            reports = [
                LevelReport(level.name, judged.residual[begin:end], r, "nearest" if miss else "met")
                for level, begin, end, r, miss in zip(
                    levels, off, off[1:], rank.tolist(), judged.missed.tolist(), strict=False
                )
            ]
            worst = min(judged.faults, default=len(levels) + 1)
            answer = Solution(
                x,
                tuple(reports),
                act,
                multipliers,
                method,
                tuple(failed),
                worst >= len(levels),
                self.rank_tolerance,
            )
            if not judged.faults:
                return answer
            imbalance, words = judged.faults[worst]
            failed.append(f"{method}: {words}")
            if np.isfinite(x).all():
                found.append(((worst, -imbalance), answer))
        if not found:
            raise SolverError("no way led to a finite x: " + "; ".join(failed))
        _, best = max(found, key=lambda each: each[0])
        return replace(best, failed=tuple(failed))

    def _ways(self, rows: Stacked, warm: Solution | None, failed: list[str]) -> Iterator[Way]:
        """What to try in turn."""
        p = len(rows.frobenius)
        equalities = 2 * (rows.lower == rows.upper).view(np.int8)
        if warm is not None and warm.active.shape == equalities.shape:
            act = equalities.copy()
            upper = (warm.active == 1) & (act == 0) & np.isfinite(rows.upper)
            lower = (warm.active == -1) & (act == 0) & np.isfinite(rows.lower)
            act[upper], act[lower] = 1, -1
            yield "active-set", rows, act, p, ROUNDS, ROUNDS
        if self.solver != "active-set":
            yield from _asked(self.solver, rows, failed)
        yield "active-set", rows, equalities.copy(), 1, ROUNDS, MOST
        for other in OTHERS:
            if other != self.solver:
                yield from _asked(other, rows, failed)
        coarse = 2.0 * self.rank_tolerance if self.rank_tolerance else COARSE
        yield "coarser rank", rows.with_rank(coarse), equalities.copy(), 1, ROUNDS, MOST
        yield "one row at a time", rows, equalities.copy(), p, 0, MOST

    def damped(
        self,
        levels: Sequence[Level],
        damping: float | Sequence[float],
        reference: np.ndarray | None = None,
        motion: np.ndarray | None = None,
    ) -> list[Level]:
        """Return levels that ask only for what is reached with x held back; then `solve` those.

        In their order each level with equalities is solved, under those above, beside the rows
        √λ x = √λ reference, and asks from then on for the A x that was found. So the levels stay
        strict, limits hold, and near a loss of rank x stays short. On equalities alone the answer
        is Projection(damping=λ)'s; its q_c is the `reference` (n,), here 0 unless given. With
        `motion` M (N, n) it is M x that is held back, such as all joints by the independent ones.

        `damping`: λ ≥ 0 in the squared units of A, one for all or one for each level; levels of
        inequalities only, and levels with λ = 0, stay as they are. Raises SolverError where the
        answer of a damped level is not certified: those below would build on it.
        """
        levels = [levels] if isinstance(levels, Level) else levels
        n = stack(levels).A.shape[1]
        each = _numbers(damping)
        if each.shape not in ((), (len(levels),)) or not (np.isfinite(each) & (each >= 0.0)).all():
            raise InputError(
                f"damping must be ≥ 0, one number or one for each level; got {damping!r}"
            )
        toward = np.zeros(n) if reference is None else _numbers(reference)
        if toward.shape != (n,) or not np.isfinite(toward).all():
            raise InputError(f"reference must be {n} finite numbers; got {reference!r}")
        hold = np.eye(n) if motion is None else _numbers(motion)
        if hold.ndim != 2 or hold.shape[1] != n or not np.isfinite(hold).all():
            raise InputError(f"motion must be finite rows over {n} unknowns; got {motion!r}")
        held: list[Level] = []
        for level, square in zip(levels, np.broadcast_to(each, len(levels)), strict=True):
            if square == 0.0 or level.is_inequality:
                held.append(level)
                continue
            root = np.sqrt(square)
            A = np.concatenate([level.A, root * hold])
            lower, upper = (np.append(b, root * hold @ toward) for b in (level.lower, level.upper))
            value = level.A @ self.solve([*held, Level(A, lower, upper)]).certified_x
            equal = level.lower == level.upper
            lower = np.where(equal, value, np.minimum(level.lower, value))
            upper = np.where(equal, value, np.maximum(level.upper, value))
            name = f"{level.name}, damped" if level.name else "damped"
            held.append(Level(level.A, lower, upper, name))
        return held


def _asked(solver: str, rows: Stacked, failed: list[str]) -> Iterator[Way]:
    """The way that a QP solver names; none, and a line in `failed`, where it names none."""
    try:
        act = active_rows(rows, BACKENDS[solver])
    except QPSolverError as failure:
        failed.append(f"{solver}: {failure}")
    else:
        yield solver, rows, act, len(rows.frobenius), ROUNDS, MOST


def _numbers(value: object) -> np.ndarray:
    """`value` as an array; NaN where it is none."""
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        return np.array(np.nan)
