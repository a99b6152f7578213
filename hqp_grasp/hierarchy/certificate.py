"""Whether x is the lexicographic optimum of a hierarchy, judged from x and the levels.

The search's multipliers are evidence that is checked and not believed; what the search and this
check share is `measure`, the sizes of rows and the rank floors of levels.

Level k is optimal, given those above, when A_kᵀ w_k + Σ_{j<k} A_jᵀ λ_jk = 0 for multipliers that
only push the way a row can: either way for equalities and for rows that cannot be met, inwards
for rows at a bound, not at all for the others. Where the evidence does not show that, the best
multipliers there are decide, found by non-negative least squares.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

from hqp_grasp.kernels import njit

EPS = float(np.finfo(float).eps)
ROUNDING = 1e-13  # [–] of the terms that make up a sum: smaller is rounding
LEAN = 1e8  # times at most that a level's proof is added to another's: more would be rounding
# Rows that are nearly parallel balance a pull with huge forces. A is known to EPS only, so a part
# of these forces may be left over, as long as it is a small part of the pull:
EVALUATED = 8.0 * EPS  # [–] of the largest sum of forces,
LOST = 1e-2  # [–] and of the pull
# Without the second any x at all would pass beside forces that are large enough.


@njit(cache=True, error_model="numpy")
def measure(A, lower, upper, off, rank_tolerance):
    """Row norms (M,), the levels' Frobenius norms (p,), and their rank floors (p,).

    Rows of rounding dust, shorter than the floor, have norm 0 like rows of zeros: they ask for
    nothing and hold nothing.
    What a level asks for by less than its floor, rank tolerance × ‖A_k‖_F, nobody asks for. The
    user's tolerance (< 0: none) holds for levels with equalities; limits keep the default.
    """
    M, n = A.shape
    row_norm = np.empty(M)
    frobenius = np.empty(len(off) - 1)
    floor = np.empty(len(off) - 1)
    for k in range(len(off) - 1):
        total = 0.0
        asks = False
        for i in range(off[k], off[k + 1]):
            asks |= lower[i] == upper[i]
            s = 0.0
            for j in range(n):
                s += A[i, j] * A[i, j]
            row_norm[i] = np.sqrt(s)
            total += s
        frobenius[k] = np.sqrt(total)
        share = max(n, off[k + 1] - off[k]) * EPS
        if asks and rank_tolerance >= 0.0:
            share = rank_tolerance
        floor[k] = share * frobenius[k]
        # ‖A_k‖₂ ≥ ‖A_k‖_F / √min(m, n): a row this short lies below the level's rank for certain
        dust = floor[k] / np.sqrt(max(1.0, min(n, off[k + 1] - off[k])))
        for i in range(off[k], off[k + 1]):
            if row_norm[i] <= dust:
                row_norm[i] = 0.0
    return row_norm, frobenius, floor


@njit(cache=True, error_model="numpy")
def _rows(A, lower, upper, off, x, tol, row_norm, floor):
    """What x leaves of each row, and what each row can hold.

    Returns w (M,), the residuals, 0 where they are rounding; pull (M,), the same as they are, since
    a small residual of a large row may balance the others; missed (p,), the levels with a residual
    that is not rounding; size (p,), ‖pull‖ of each level; push (M,), 0 where a row may not push,
    1 upwards, −1 downwards, 2 both; and room (M,), how far a row may be off.
    """
    M, n = A.shape
    p = len(off) - 1
    length = 0.0
    for j in range(n):
        length += x[j] * x[j]
    length = np.sqrt(length)
    w, pull, room = np.zeros(M), np.zeros(M), np.empty(M)
    push = np.zeros(M, np.int8)
    missed = np.zeros(p, np.bool_)
    size = np.zeros(p)
    for k in range(p):
        for i in range(off[k], off[k + 1]):
            value = 0.0
            for j in range(n):
                value += A[i, j] * x[j]
            nearest = min(max(value, lower[i]), upper[i])
            room[i] = tol * (abs(nearest) + row_norm[i] * length)
            if abs(value - nearest) > room[i]:
                w[i] = value - nearest
                missed[k] = True
            room[i] += floor[k] * length
            if row_norm[i] == 0.0:
                continue  # it asks for nothing and holds nothing
            pull[i] = value - nearest
            size[k] += pull[i] * pull[i]
            up = value >= upper[i] - room[i]
            down = value <= lower[i] + room[i]
            if w[i] != 0.0 or lower[i] == upper[i] or (up and down):
                push[i] = 2
            elif up:
                push[i] = 1
            elif down:
                push[i] = -1
        size[k] = np.sqrt(size[k])
    return w, pull, missed, size, push, room


@njit(cache=True, error_model="numpy")
def _mend_signs(k, off, own, push, forces, unasked):
    """Make the forces (M, columns) of column k push only the way rows can.

    A row that holds a level between for good must not give way to level k: that level's proof is
    added, as often as it takes. Other forces of the wrong sign are dropped; what is then missing
    shows. What the added proof left out as below its rank stays out.
    """
    for _ in range(2):  # a mended sign may spoil another
        mended = False
        for i in range(off[min(k, len(off) - 1)]):
            if push[i] == 2 or forces[i, k] * push[i] > 0.0 or forces[i, k] == 0.0:
                continue
            t = 0.0
            for between in range(own[i] + 1, k):
                if push[i] == 0 or not forces[i, between] * push[i] > 0.0:
                    continue
                t = -forces[i, k] / forces[i, between]
                if t <= LEAN:
                    break
                t = 0.0
            if t == 0.0:
                forces[i, k] = 0.0
                continue
            for r in range(off[between + 1]):
                forces[r, k] += t * forces[r, between]
            for j in range(len(unasked)):
                unasked[j, k] += t * unasked[j, between]
            mended = True
        if not mended:
            break


@njit(cache=True, error_model="numpy")
def check(A, lower, upper, off, x, lam, tol, row_norm, floor, least_norm):
    """Which columns of `lam` (M, p or p + 1) prove their level optimal.

    With least_norm, column p must prove that x is the shortest optimum. A level may leave what is
    below its rank floor. Returns proven (columns,); scale (n, columns), how much of a level's pull
    may be left on each unknown, which is what its own rows' rooms would make up for; and w, pull,
    missed, push as `_rows` says.
    """
    M, n = A.shape
    p = len(off) - 1
    columns = p + 1 if least_norm else p
    w, pull, missed, size, push, room = _rows(A, lower, upper, off, x, tol, row_norm, floor)
    own = np.empty(M, np.int64)
    forces = np.zeros((M, columns))
    scale = np.zeros((n, columns))
    for k in range(p):
        for i in range(off[k], off[k + 1]):
            own[i] = k
            forces[i, k] = pull[i]
            for later in range(k + 1, columns):
                forces[i, later] = lam[i, later]
            if push[i] != 0:
                for j in range(n):
                    scale[j, k] += abs(A[i, j]) * room[i]
        for j in range(n):
            scale[j, k] += floor[k] * size[k]
    if least_norm:
        scale[:, p] = tol * np.sqrt((x * x).sum())
    proven = np.empty(columns, np.bool_)
    imbalance = np.empty(n)
    unasked = np.zeros((n, columns))  # of the imbalance, what is below the level's rank
    terms = np.empty(n)  # sums of the sizes of what makes it up
    for k in range(columns):
        _mend_signs(k, off, own, push, forces, unasked)
        pulls = 0.0  # the level's own, to be balanced
        for j in range(n):
            imbalance[j] = x[j] if k == p else 0.0
            terms[j] = 0.0
            for i in range(off[min(k, p)], off[min(k + 1, p)]):
                imbalance[j] += A[i, j] * forces[i, k]
                terms[j] += abs(A[i, j] * forces[i, k])
            pulls = max(pulls, abs(imbalance[j]))
        widest = 0.0  # a force's error reaches other unknowns too
        for j in range(n):
            for i in range(off[min(k, p)]):
                imbalance[j] += A[i, j] * forces[i, k]
                terms[j] += abs(A[i, j] * forces[i, k])
            imbalance[j] -= unasked[j, k]
            if k < p:
                most = n * floor[k] * size[k]
                unasked[j, k] += max(-most, min(most, imbalance[j]))
            widest = max(widest, terms[j])
        huge = min(EVALUATED * widest, LOST * pulls)
        proven[k] = True
        for j in range(n):
            scale[j, k] += min(scale[j, k], ROUNDING * terms[j])
            proven[k] &= abs(imbalance[j]) <= max(scale[j, k], huge)  # NaN compares false
    return proven, scale, w, pull, missed, push


def optimality_faults(
    A: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    off: np.ndarray,
    x: np.ndarray,
    multipliers: np.ndarray,
    tol: float,
    row_norm: np.ndarray,
    floor: np.ndarray,
    least_norm: bool,
) -> tuple[np.ndarray, np.ndarray, dict[int, tuple[float, str]]]:
    """Residuals w (M,), levels that have some (p,), and what keeps x from being certified.

    That is said for each level at fault, and for p where x is not shown to be the shortest: how
    many times the imbalance is what may be left, and in words.
    """
    proven, scale, w, pull, missed, push = check(
        A, lower, upper, off, x, multipliers, tol, row_norm, floor, least_norm
    )
    faults: dict[int, tuple[float, str]] = {}
    if proven.all() and np.isfinite(x).all():
        return w, missed, faults
    if not np.isfinite(x).all():
        return w, missed, {0: (np.inf, "x is not finite")}
    for k in np.flatnonzero(~proven).tolist():
        last = k == len(off) - 1
        above = slice(0, off[k])
        own = slice(off[k], off[k + 1]) if not last else slice(0, 0)
        force = x if last else A[own].T @ pull[own]
        rest = _least_imbalance(force, A[above], push[above], scale[:, k])
        if not rest <= 1.0:
            name = "least norm of x" if last else f"level {k}"
            faults[k] = rest, f"{name}: imbalance is {rest:.1e} of what counts as none"
    return w, missed, faults


def _least_imbalance(pull: np.ndarray, A: np.ndarray, push: np.ndarray, scale: np.ndarray) -> float:
    """Largest entry of (pull + Aᵀ λ) / scale for the best λ in the least-squares sense.

    λ is free where push is 2, of push's sign where ±1, and 0 where push is 0. What the free rows
    can balance is taken out first.
    """
    if not pull.any():
        return 0.0
    size = np.maximum(scale, ROUNDING * np.abs(pull).max())
    rest = pull / size
    rows = _directions(np.concatenate([A[push == 1], -A[push == -1]]) / size)
    free = _directions(A[push == 2] / size)
    if len(free):
        _, sigma, Vt = np.linalg.svd(free, full_matrices=False)
        basis = Vt[sigma > EPS * max(free.shape) * sigma[0]]
        for _ in range(2):
            rest = rest - basis.T @ (basis @ rest)
            rows = rows - (rows @ basis.T) @ basis
    length = float(np.linalg.norm(rest))
    if length > 0.0 and len(rows):
        try:
            best, _ = nnls(rows.T, -rest / length)
        except RuntimeError:  # it did not converge: these rows are not shown to balance
            best = np.zeros(len(rows))
        rest = rest + length * (rows.T @ best)
    return float(np.abs(rest).max())


def _directions(rows: np.ndarray) -> np.ndarray:
    norm = np.linalg.norm(rows, axis=1)
    return rows[norm > 0.0] / norm[norm > 0.0, None]
