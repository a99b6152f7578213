"""Any QP solver, asked level by level which rows of a hierarchy hold its optimum.

A hierarchy of least-squares problems is a cascade of QPs: level k minimises ‖w_k‖² in the freedom
that the levels above leave, subject to the inequalities that they have met. A solver's answer is
accurate to some digits only, so it is used for what it tells reliably: which inequality rows are
at a bound. `hqp` settles these exactly.

With y (d,) the freedom left, x = x₀ + Z y, and slacks s for the level's own inequality rows:

    min ½ ‖A_k (x₀ + Z y) − b_k‖² + ½ ‖s‖²   s.t.  lower ≤ a_i (x₀ + Z y) ≤ upper   met above
                                                   lower ≤ a_i (x₀ + Z y) − s_i ≤ upper   its own
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable

import daqp
import numpy as np
import proxsuite
import qpsolvers
from scipy.sparse import csc_matrix

from hqp_grasp.hierarchy.certificate import ROUNDING
from hqp_grasp.hierarchy.level import Stacked
from hqp_grasp.kernels import njit

ACCURACY = 1e-6  # [–] asked of a solver; what it names is settled exactly afterwards
AT_BOUND = 1e-5  # [–] scaled slack or dual above which a row holds x; well above ACCURACY
SLIGHT = 1e-9  # [–] of a row: no direction of its own; of a Hessian's trace: added to its diagonal
KEPT = 32  # shapes of QPs whose solver objects are kept: those of a few hierarchies
ITERATIONS = 25  # of proxqp, outer and in each: ten times what it takes where it converges

MET, HOLDS = 1, 2  # states of a row: an inequality that is met, a row that takes freedom away

Backend = Callable[
    [np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    tuple[np.ndarray, np.ndarray],
]


class QPSolverError(Exception):
    """A QP solver did not solve one level; the message says how it reported that."""


def active_rows(rows: Stacked, backend: Backend) -> np.ndarray:
    """The active set (M,) int8 that a QP solver finds: 2 equality, ±1 at a bound, 0 free.

    The first level and every level with inequalities above it, or of its own, goes to the solver;
    limits that x = 0 keeps come first in most hierarchies and need none.
    Raises QPSolverError, whatever the solver raised.
    """
    A, lower, upper, off = rows.A, rows.lower, rows.upper, rows.offsets
    n, p = A.shape[1], len(off) - 1
    act, state = np.zeros((2, len(A)), dtype=np.int8)
    x, Z = np.zeros(n), np.eye(n)
    for k in range(p + 1):
        P, q, G, low, high, index, size = _pose(A, lower, upper, off, rows.row_norm, state, x, Z, k)
        if size == 0.0:
            y, z = np.zeros(len(q)), np.zeros(len(index))
        elif len(index) == 0 and k > 0:
            y, z = np.linalg.solve(P, -q), np.zeros(0)
        else:
            try:
                y, z = backend(P, q, G, low, high)
            # Solvers raise what they like, and qpsolvers passes it on; it is told in
            # Solution.failed.
            except Exception as error:
                reason = str(error) if isinstance(error, QPSolverError) else repr(error)
                raise QPSolverError(f"level {k}: {reason}") from error
            if not (np.isfinite(y).all() and np.isfinite(z).all()):
                raise QPSolverError(f"level {k}: the answer is not finite")
        dust = 10.0 * SLIGHT * float(np.abs(y).max(initial=1.0))  # duals that SLIGHT alone makes
        y = size * y
        if k < p:
            sizes = (rows.row_norm, rows.floor, size, dust)
            x, Z = _take_in(A, lower, upper, off, sizes, state, act, x, Z, k, y, z, index)
        else:
            _hold(lower, upper, act, state, z, index, dust)
        if Z.shape[1] == 0:
            break
    act[(lower == upper)] = 2
    return act


@njit(cache=True, error_model="numpy")
def _pose(A, lower, upper, off, unit, state, x, Z, k):  # type: ignore[no-untyped-def]
    """Level k, or for k = p "x is short", as ½ vᵀP v + qᵀv, low ≤ G v ≤ high, v = (y, s).

    Also the rows of G in the stack, and the size of what is asked, in which v and the bounds are
    counted: solvers' tolerances are absolute. 0 where v = 0 does it: limits that are kept already.
    """
    M, n = A.shape
    d = Z.shape[1]
    p = len(off) - 1
    begin, end = (off[k], off[k + 1]) if k < p else (0, 0)
    soft = 0
    index = np.empty(M, np.int64)
    count = 0
    for i in range(M):
        if state[i] == MET:
            index[count] = i
            count += 1
    asks = k == p
    for i in range(begin, end):
        if lower[i] == upper[i]:
            asks = True
        elif unit[i] > 0.0 and (lower[i] > -np.inf or upper[i] < np.inf):
            index[count] = i
            count += 1
            soft += 1
    index = index[:count]
    P = np.zeros((d + soft, d + soft))
    q = np.zeros(d + soft)
    length = 0.0  # of what is asked and of x, whose rounding is not asked for
    for j in range(n):
        length = max(length, abs(x[j]))
    if k == p:
        for a in range(d):
            P[a, a] = 1.0
            for j in range(n):
                q[a] += Z[j, a] * x[j]
    row = np.empty(d)
    for i in range(begin, end):
        if lower[i] != upper[i] or unit[i] == 0.0:
            continue
        r = -upper[i]
        length = max(length, abs(upper[i]) / unit[i])
        for j in range(n):
            r += A[i, j] * x[j]
        for a in range(d):
            row[a] = 0.0
        for j in range(n):
            for a in range(d):
                row[a] += A[i, j] * Z[j, a]
        for a in range(d):
            q[a] += row[a] * r
            for b in range(d):
                P[a, b] += row[a] * row[b]
    trace = 0.0
    for a in range(d):
        trace += P[a, a]
    for i in index[count - soft :]:
        trace = max(trace, unit[i] * unit[i])
    if trace == 0.0:
        trace = 1.0
    for a in range(d):
        q[a] /= trace
        for b in range(d):
            P[a, b] /= trace
        P[a, a] += SLIGHT
    G = np.zeros((count, d + soft))
    low = np.empty(count)
    high = np.empty(count)
    size = 0.0
    for a in range(d):
        size = max(size, abs(q[a]))
    for c in range(count):
        i = index[c]
        value = 0.0
        for j in range(n):
            value += A[i, j] * x[j]
            for a in range(d):
                G[c, a] += A[i, j] * Z[j, a] / unit[i]
        low[c] = (lower[i] - value) / unit[i]
        high[c] = (upper[i] - value) / unit[i]
        own = c - (count - soft)
        if own >= 0:
            G[c, d + own] = -1.0
            P[d + own, d + own] = unit[i] * unit[i] / trace
            size = max(size, low[c], -high[c])
        else:  # met above, up to the solver's accuracy: y = 0 is allowed
            low[c] = min(low[c], 0.0)
            high[c] = max(high[c], 0.0)
    if size <= ROUNDING * length:
        size = 1.0 if asks else 0.0
    if size > 0.0:
        for a in range(d):
            q[a] /= size
        for c in range(count):
            low[c] /= size
            high[c] /= size
    return P, q, G, low, high, index, size


@njit(cache=True, error_model="numpy")
def _hold(lower, upper, act, state, z, index, dust):  # type: ignore[no-untyped-def]
    """Rows met above that a level pushes against hold x from now on, at the bound it pushes to."""
    for c in range(len(index)):
        i = index[c]
        bound = upper[i] if z[c] > 0.0 else lower[i]
        if state[i] == MET and abs(z[c]) > dust and np.isfinite(bound):
            act[i] = 1 if z[c] > 0.0 else -1
            state[i] = HOLDS


@njit(cache=True, error_model="numpy")
def _take_in(A, lower, upper, off, sizes, state, act, x, Z, k, y, z, index):  # type: ignore[no-untyped-def]
    """Step to the level's optimum; return x and the freedom that its rows leave, (n,) and (n, d).

    Its equalities, its rows that cannot be met, and rows above that hold x take freedom away.
    """
    unit, floor, size, dust = sizes
    n, d = Z.shape
    x = x.copy()
    for j in range(n):
        for a in range(d):
            x[j] += Z[j, a] * y[a]
    length = 0.0
    for j in range(n):
        length += abs(x[j])
    slack = max(AT_BOUND * size, ROUNDING * length)  # of a row of length 1, that is none
    before = state.copy()
    over = np.zeros(len(A))
    missed = False
    for i in range(off[k], off[k + 1]):
        value = 0.0
        for j in range(n):
            value += A[i, j] * x[j]
        over[i] = max(value - upper[i], 0.0) + min(value - lower[i], 0.0)
        missed |= unit[i] > 0.0 and abs(over[i]) > slack * unit[i]
    if missed:  # else nothing keeps x from what is asked: duals are what SLIGHT makes
        _hold(lower, upper, act, state, z, index, dust)
    for i in range(off[k], off[k + 1]):
        state[i] = MET
        if lower[i] == upper[i]:
            state[i] = HOLDS
        elif unit[i] == 0.0 or (lower[i] == -np.inf and upper[i] == np.inf):
            state[i] = 0  # it asks for nothing
        elif abs(over[i]) > slack * unit[i]:
            act[i] = 1 if over[i] > 0.0 else -1
            state[i] = HOLDS
    # Householder reflections turn Z so that its first columns are the directions taken.
    Z = Z.copy()
    taken = 0
    fresh = np.empty((len(A), d))
    reach = np.empty(len(A))
    m = 0
    for i in range(len(A)):
        if state[i] == HOLDS and before[i] != HOLDS and unit[i] > 0.0:
            reach[m] = SLIGHT
            if off[k] <= i < off[k + 1]:
                reach[m] = max(SLIGHT, floor[k] / unit[i])
            for a in range(d):
                fresh[m, a] = 0.0
            for j in range(n):
                for a in range(d):
                    fresh[m, a] += A[i, j] * Z[j, a] / unit[i]
            m += 1
    while taken < d:
        best = 0.0
        pick = -1
        for i in range(m):
            s = 0.0
            for a in range(taken, d):
                s += fresh[i, a] * fresh[i, a]
            if s > reach[i] * reach[i] and s > best:
                best, pick = s, i
        if pick < 0:
            break
        v = fresh[pick, taken:].copy()
        v[0] += np.sqrt(best) if v[0] >= 0.0 else -np.sqrt(best)
        square = 0.0
        for a in range(len(v)):
            square += v[a] * v[a]
        for block in (fresh[:m], Z):
            for i in range(len(block)):
                s = 0.0
                for a in range(len(v)):
                    s += block[i, taken + a] * v[a]
                s *= 2.0 / square
                for a in range(len(v)):
                    block[i, taken + a] -= s * v[a]
        taken += 1
    return x, Z[:, taken:].copy()


# ---------------------------------------------------------------- the solvers


class _Kept(threading.local):
    """proxsuite's objects by shape, each thread its own: with a new one a solve takes half longer.

    Every call sets one up anew and starts from y = 0, so nothing of the call before is left; what
    a solver tells is which rows are active, and the answer is computed from that.
    """

    def __init__(self) -> None:
        self.by_shape: dict[tuple[int, ...], proxsuite.proxqp.dense.QP] = {}


_kept = _Kept()


def _proxqp(
    P: np.ndarray, q: np.ndarray, G: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    shape = G.shape
    qp = _kept.by_shape.get(shape)
    if qp is None:
        if len(_kept.by_shape) == KEPT:  # the oldest goes: each holds megabytes where rows are many
            del _kept.by_shape[next(iter(_kept.by_shape))]
        qp = _kept.by_shape[shape] = proxsuite.proxqp.dense.QP(shape[1], 0, shape[0])
        settings = qp.settings
        settings.initial_guess = proxsuite.proxqp.NO_INITIAL_GUESS  # y = 0: where the levels stand
        settings.eps_abs = ACCURACY
        settings.max_iter = settings.max_iter_in = ITERATIONS
        settings.eps_rel = 0.0
        settings.eps_primal_inf = settings.eps_dual_inf = 1e-12  # defaults call some infeasible
    qp.init(
        P,
        q,
        None,
        None,
        G,
        lower,
        upper,
        False,  # rows have length 1: nothing to scale
        rho=SLIGHT / 10.0,  # the default, 1e-6, is a long way in small steps where P is near 0
        mu_in=1e-3,  # a third of the iterations that the default takes
    )
    qp.solve()
    status = qp.results.info.status
    if status != proxsuite.proxqp.PROXQP_SOLVED:
        raise QPSolverError(f"status {status.name}")
    return np.array(qp.results.x), _settled(np.array(qp.results.z))


def _settled(z: np.ndarray) -> np.ndarray:
    """Duals without those that may be a solver's inaccuracy; an active-set method's need none."""
    return np.where(np.abs(z) > AT_BOUND * max(1.0, np.abs(z).max(initial=0.0)), z, 0.0)


def _daqp(
    P: np.ndarray, q: np.ndarray, G: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    sense = np.zeros(len(G), dtype=np.int32)
    x, _, flag, info = daqp.solve(
        P,
        q,
        G,
        upper,
        lower,
        sense,
        primal_tol=ACCURACY,
    )
    if flag < 1:
        raise QPSolverError(f"exit flag {flag}")
    return np.array(x), np.array(info["lam"])


def _through_qpsolvers(name: str) -> Backend:
    def solve(
        P: np.ndarray,
        q: np.ndarray,
        G: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        has_upper, has_lower = np.isfinite(upper), np.isfinite(lower)
        sides = np.concatenate([G[has_upper], -G[has_lower]])
        bounds = np.concatenate([upper[has_upper], -lower[has_lower]])
        if name not in qpsolvers.dense_solvers:
            P, sides = csc_matrix(P), csc_matrix(sides)
        problem = qpsolvers.Problem(P, q, sides, bounds) if len(bounds) else qpsolvers.Problem(P, q)
        with warnings.catch_warnings():  # of how qpsolvers calls others nobody here can do anything
            warnings.simplefilter("ignore", PendingDeprecationWarning)
            answer = qpsolvers.solve_problem(problem, name)
        if not answer.found or answer.x is None:
            raise QPSolverError("no solution found")
        z = np.zeros(len(G))
        if len(bounds) and answer.z is not None:
            z[has_upper] += answer.z[: has_upper.sum()]
            z[has_lower] -= answer.z[has_upper.sum() :]
        return np.asarray(answer.x), _settled(z)

    return solve


BACKENDS: dict[str, Backend] = {"proxqp": _proxqp, "daqp": _daqp}
BACKENDS |= {
    name: _through_qpsolvers(name) for name in qpsolvers.available_solvers if name not in BACKENDS
}
