"""The strict hierarchy of least-squares problems with inequalities, solved exactly."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import daqp
import numpy as np
import proxsuite
import qpsolvers
from scipy.sparse import csc_matrix

from hqp_grasp.errors import InputError, SolverError, one_of
from hqp_grasp.hierarchy import active_set, many_digits
from hqp_grasp.hierarchy.certificate import measure, optimality_faults
from hqp_grasp.hierarchy.level import (
    CERTIFICATE_TOLERANCE,
    Level,
    LevelReport,
    Solution,
    Stacked,
    stack,
)

QUICK_ROUNDS = 10  # rounds at most of the active-set search before it moves one row at a time,
POLISH_ROUNDS = 20  # the same, to settle an active set that something else has named
PIVOTS = 6  # steps of one row, for each row and unknown, before another way is tried
BACKEND_EPS = 1e-9  # absolute accuracy asked of a QP solver; polishing does the rest
STRONG = 1e-6  # [–] scaled slack or dual above which a backend's row counts as active
ABSURD = 1e100  # a backend's answer beyond this is none
RIDGE = 1e-9  # [–] added to a backend's Hessian; its answer only names the active set


class _BackendError(Exception):
    """A QP solver did not solve one level; the message says how it reported that."""


Backend = Callable[
    [np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]
]


def solvers() -> tuple[str, ...]:
    """Names that HQP accepts: proxqp and daqp through their own interfaces, the rest qpsolvers'."""
    return ("proxqp", "daqp", *(s for s in qpsolvers.available_solvers if s not in OWN_INTERFACE))


@dataclass(frozen=True)
class _Tried:
    """What became of the ways that led to no answer."""

    failed: list[str]
    spare: list[Solution]  # optimal at every level, and not shown to be the shortest such


@dataclass(frozen=True)
class HQP:
    """Strict lexicographic least squares: each level as nearly as those above allow.

    An answer is found by the first of these ways that passes the optimality certificate:

    - "shortcut": exact active-set steps from the equalities alone, level by level, or from the warm
      start's active set, all levels at once (left out where `shortcuts` is False);
    - the QP solver, level by level in the freedom left, its active set settled likewise;
    - "one row at a time": the exact primal method;
    - "many digits": level by level in decimal arithmetic, for levels whose rows differ in size by
      1e10 or more. It takes up to a second or two; a few in 100,000 problems of
      benchmarks/fuzz.py need it. Rows dependent to 1e-13 (then to 1e-11) are taken as dependent,
      whatever `rank_tolerance` says.

    Solution.method names the way, Solution.failed the ways before it. Where several x are optimal
    the shortest is returned. Where it cannot be shown which that is, because rows depend on one
    another up to the last digits, it is the shortest found, and `failed` says so.
    """

    solver: str = "proxqp"  # one of solvers()
    rank_tolerance: float | None = None  # [–] σ counts above this × ‖A_k‖₂; None: max(m, n)·eps
    shortcuts: bool = True  # False: every call goes through the QP solver

    def __post_init__(self) -> None:
        one_of("solver", self.solver, solvers())
        if self.rank_tolerance is not None and not 0.0 <= self.rank_tolerance < 1.0:
            raise InputError(f"rank_tolerance must lie in [0, 1); got {self.rank_tolerance}")

    def solve(self, levels: Sequence[Level], warm: Solution | None = None) -> Solution:
        """Return the optimum of `levels`, first level first.

        `warm`: the solution of a similar hierarchy, whose active set is tried first.
        Raises InputError for levels that disagree on the number of unknowns, and SolverError
        where no way leads to an answer that passes its certificate.
        """
        rows = stack(levels)
        norms = measure(
            rows.A,
            rows.lower,
            rows.upper,
            rows.offsets,
            -1.0 if self.rank_tolerance is None else self.rank_tolerance,
        )
        equalities = active_set.equalities(rows.lower, rows.upper)
        tried = _Tried([], [])
        if self.shortcuts:
            act = equalities.copy()
            first = 1
            if warm is not None and len(warm.active) == len(act):
                first = len(levels)
                held = np.abs(warm.active) == 1
                act[held & (act == 0)] = warm.active[held & (act == 0)]
                _possible(act, rows)
            found = self._settle(levels, rows, norms, act, "shortcut", tried, first, QUICK_ROUNDS)
            if found is not None:
                return found
        try:
            backend = OWN_INTERFACE.get(self.solver) or _through_qpsolvers(self.solver)
            act = _cascade(rows, norms, backend)
        except _BackendError as failure:
            tried.failed.append(f"{self.solver}: {failure}")
        else:
            found = self._settle(
                levels, rows, norms, act, self.solver, tried, len(levels), POLISH_ROUNDS
            )
            if found is not None:
                return found
        act = equalities.copy()
        found = self._settle(levels, rows, norms, act, "one row at a time", tried, len(levels), 0)
        if found is not None:
            return found
        proof = np.zeros((len(rows.A), len(levels) + 1))  # the certificate finds its own
        for known in many_digits.KNOWN:
            act = equalities.copy()
            try:
                x, rank = many_digits.search(
                    rows.A, rows.lower, rows.upper, rows.offsets, act, known
                )
            except ArithmeticError as error:
                tried.failed.append(f"many digits: {error!r}")
                continue
            found = self._certified(levels, rows, act, x, proof, rank, "many digits", tried)
            if found is not None:
                return found
        if tried.spare:
            shortest = min(tried.spare, key=lambda spare: float(np.linalg.norm(spare.x)))
            return replace(shortest, failed=tuple(tried.failed))
        raise SolverError("no way led to a certified optimum: " + "; ".join(tried.failed))

    def damped(
        self,
        levels: Sequence[Level],
        damping: float | Sequence[float],
        reference: np.ndarray | None = None,
    ) -> list[Level]:
        """Return levels that ask only for what is reached with x held back; then `solve` those.

        In their order each level with equalities is solved, under those above, beside the rows
        √λ x = √λ reference, and asks from then on for the A x that was found. So the levels stay
        strict, limits hold, and near a loss of rank x stays short. On equalities alone the answer
        is Projection(damping=λ)'s; its q_c is the `reference` (n,), here 0 unless given.

        `damping`: λ ≥ 0 in the squared units of A, one for all or one for each level; levels of
        inequalities only, and levels with λ = 0, stay as they are.
        """
        n = stack(levels).A.shape[1]
        each = _numbers(damping)
        if each.shape not in ((), (len(levels),)) or not (np.isfinite(each) & (each >= 0.0)).all():
            raise InputError(
                f"damping must be ≥ 0, one number or one for each level; got {damping!r}"
            )
        toward = np.zeros(n) if reference is None else _numbers(reference)
        if toward.shape != (n,) or not np.isfinite(toward).all():
            raise InputError(f"reference must be {n} finite numbers; got {reference!r}")
        held: list[Level] = []
        for level, square in zip(levels, np.broadcast_to(each, len(levels)), strict=True):
            if square == 0.0 or level.is_inequality:
                held.append(level)
                continue
            root = np.sqrt(square)
            A = np.concatenate([level.A, root * np.eye(n)])
            lower, upper = (np.append(b, root * toward) for b in (level.lower, level.upper))
            value = level.A @ self.solve([*held, Level(A, lower, upper)]).x
            equal = level.lower == level.upper
            lower = np.where(equal, value, np.minimum(level.lower, value))
            upper = np.where(equal, value, np.maximum(level.upper, value))
            name = f"{level.name}, damped" if level.name else "damped"
            held.append(Level(level.A, lower, upper, name))
        return held

    def _settle(
        self,
        levels: Sequence[Level],
        rows: Stacked,
        norms: tuple[np.ndarray, np.ndarray, np.ndarray],
        act: np.ndarray,
        method: str,
        tried: _Tried,
        first: int,
        rounds: int,
    ) -> Solution | None:
        """Settle the active set and certify; None, with the reason in `tried`, where it fails."""
        row_norm, frobenius, floor = norms
        x, multipliers, rank = active_set.search(
            rows.A,
            rows.lower,
            rows.upper,
            rows.offsets,
            act,
            frobenius,
            row_norm,
            floor,
            first,
            rounds,
            PIVOTS * sum(rows.A.shape),
        )
        return self._certified(levels, rows, act, x, multipliers, rank, method, tried)

    def _certified(
        self,
        levels: Sequence[Level],
        rows: Stacked,
        act: np.ndarray,
        x: np.ndarray,
        multipliers: np.ndarray,
        rank: np.ndarray,
        method: str,
        tried: _Tried,
    ) -> Solution | None:
        """The answer, where it passes its certificate; None, with the reason in `tried`."""
        left = -1.0 if self.rank_tolerance is None else self.rank_tolerance
        residual, missed, faults = optimality_faults(
            rows.A,
            rows.lower,
            rows.upper,
            rows.offsets,
            x,
            multipliers,
            CERTIFICATE_TOLERANCE,
            left,
            True,
        )
        if faults:
            tried.failed.append(f"{method}: {next(iter(faults.values()))}")
            if list(faults) != [len(levels)]:
                return None
        off = rows.offsets.tolist()
        reports = [
            LevelReport(level.name, residual[begin:end], r, "nearest" if miss else "met")
            for level, begin, end, r, miss in zip(
                levels, off, off[1:], rank.tolist(), missed.tolist(), strict=False
            )
        ]
        answer = Solution(x, tuple(reports), act, multipliers, method, tuple(tried.failed), left)
        if faults:
            tried.spare.append(answer)
            return None
        return answer


def _numbers(value: object) -> np.ndarray:
    """`value` as an array; NaN where it is none."""
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        return np.array(np.nan)


def _possible(act: np.ndarray, rows: Stacked) -> None:
    """Let go of rows held at a bound that is infinite."""
    infinite = ((act == 1) & np.isinf(rows.upper)) | ((act == -1) & np.isinf(rows.lower))
    act[infinite] = 0


def _cascade(
    rows: Stacked, norms: tuple[np.ndarray, np.ndarray, np.ndarray], backend: Backend
) -> np.ndarray:
    """Let a QP solver name the active rows, level by level in the freedom that is left.

    Equalities, rows that cannot be met and rows held by a strong dual are frozen for the levels
    below; the others stay inequalities. Returns act (M,), to be settled exactly.
    """
    A, n = rows.A, rows.A.shape[1]
    act = np.zeros(len(A), dtype=np.int8)
    row_norm, frobenius, floor = norms
    is_equal = rows.lower == rows.upper
    unit = np.where(row_norm > 0.0, row_norm, 1.0)
    x = np.zeros(n)
    Z = np.eye(n)
    standing = np.zeros(0, dtype=int)  # inequality rows above that are met and not frozen
    p = len(frobenius)
    for k in range(p + 1):
        own = np.arange(rows.offsets[k], rows.offsets[k + 1]) if k < p else np.zeros(0, dtype=int)
        own = own[~(np.isinf(rows.lower[own]) & np.isinf(rows.upper[own]))]
        equal, soft = own[is_equal[own]], own[~is_equal[own]]
        act[equal] = 2
        d, slacks = Z.shape[1], len(soft)
        duals = np.zeros(len(standing))
        if d:
            scale = frobenius[k] if k < p and frobenius[k] > 0.0 else 1.0
            M = (A[equal] @ Z if k < p else Z) / scale
            r = (A[equal] @ x - rows.upper[equal] if k < p else x) / scale
            P = np.zeros((d + slacks, d + slacks))
            P[:d, :d] = M.T @ M
            P[d:, d:] = np.diag((unit[soft] / scale) ** 2)
            P[np.arange(d), np.arange(d)] += RIDGE
            q = np.concatenate([M.T @ r, np.zeros(slacks)])
            both = np.concatenate([standing, soft])
            G = np.zeros((len(both), d + slacks))
            G[:, :d] = A[both] @ Z / unit[both, None]
            G[len(standing) :, d:] = -np.eye(slacks)
            base = A[both] @ x
            lower, upper = (
                (rows.lower[both] - base) / unit[both],
                (rows.upper[both] - base) / unit[both],
            )
            try:
                y, z = backend(P, q, G, lower, upper)
            # Each solver raises what it likes, and qpsolvers passes it on; `backend` is all that is
            # tried here, and what it raised is told in Solution.failed or in the SolverError.
            except Exception as error:
                reason = str(error) if isinstance(error, _BackendError) else repr(error)
                raise _BackendError(f"level {k}: {reason}") from error
            # NaN compares false
            if not max(np.abs(y).max(initial=0.0), np.abs(z).max(initial=0.0)) < ABSURD:
                raise _BackendError(f"level {k}: answer is not finite, or beyond {ABSURD:g}")
            x = x + Z @ y[:d]
            duals = z[: len(standing)]
        value = A[soft] @ x
        over = (value - np.clip(value, rows.lower[soft], rows.upper[soft])) / unit[soft]
        size = 1.0 + float(np.linalg.norm(x))
        broken = np.abs(over) > STRONG * size
        act[soft[broken]] = np.sign(over[broken])
        held = np.abs(duals) > STRONG * (1.0 + np.abs(duals).max(initial=0.0))
        act[standing[held]] = np.sign(duals[held])
        frozen = np.concatenate([equal, soft[broken], standing[held]])
        standing = np.concatenate([standing[~held], soft[~broken]])
        if d and len(frozen):
            rest = A[frozen] @ Z / unit[frozen, None]
            _, sigma, Vt = np.linalg.svd(rest)
            Z = Z @ Vt[int((sigma > 1e-9).sum()) :].T
    _possible(act, rows)
    return act


def _proxqp(
    P: np.ndarray, q: np.ndarray, G: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    qp = proxsuite.proxqp.dense.QP(len(q), 0, len(G))
    qp.settings.eps_abs = BACKEND_EPS
    qp.settings.eps_rel = 0.0
    qp.settings.eps_primal_inf = 1e-12  # the default calls feasible cascades infeasible
    qp.settings.eps_dual_inf = 1e-12
    qp.settings.max_iter = 1000
    qp.init(P, q, None, None, G, np.maximum(lower, -1e20), np.minimum(upper, 1e20))
    qp.solve()
    status = qp.results.info.status
    if status != proxsuite.proxqp.PROXQP_SOLVED:
        raise _BackendError(f"status {status.name}")
    return np.array(qp.results.x), np.array(qp.results.z)


def _daqp(
    P: np.ndarray, q: np.ndarray, G: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    sense = np.zeros(len(G), dtype=np.int32)
    x, _, flag, info = daqp.solve(
        P, q, G, np.minimum(upper, 1e30), np.maximum(lower, -1e30), sense, primal_tol=BACKEND_EPS
    )
    if flag < 1:
        raise _BackendError(f"exit flag {flag}")
    return np.array(x), np.array(info["lam"])


def _through_qpsolvers(name: str) -> Backend:
    def solve(
        P: np.ndarray, q: np.ndarray, G: np.ndarray, lower: np.ndarray, upper: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        has_upper, has_lower = np.isfinite(upper), np.isfinite(lower)
        sides = np.concatenate([G[has_upper], -G[has_lower]])
        bounds = np.concatenate([upper[has_upper], -lower[has_lower]])
        if name not in qpsolvers.dense_solvers:
            P, sides = csc_matrix(P), csc_matrix(sides)
        problem = qpsolvers.Problem(P, q, sides, bounds) if len(bounds) else qpsolvers.Problem(P, q)
        answer = qpsolvers.solve_problem(problem, name)
        if not answer.found or answer.x is None:
            raise _BackendError("no solution found")
        z = np.zeros(len(G))
        if len(bounds) and answer.z is not None:
            z[has_upper] += answer.z[: has_upper.sum()]
            z[has_lower] -= answer.z[has_upper.sum() :]
        return np.asarray(answer.x), z

    return solve


OWN_INTERFACE: dict[str, Backend] = {"proxqp": _proxqp, "daqp": _daqp}
