"""Whether x is the lexicographic optimum of a hierarchy: a check that shares nothing with solvers.

Level k is optimal, given those above, when A_kᵀ w_k + Σ_{j<k} A_jᵀ λ_jk = 0 for multipliers that
only push the way a row can: either way for equalities and for rows that cannot be met, inwards
for rows at a bound, not at all for the others. A pull that is found wanting is judged anew with
the best multipliers there are, by non-negative least squares.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.optimize import nnls

EPS = float(np.finfo(float).eps)
VANISHED = 1e-3  # [–] of the x that the levels ask for; shorter ones are judged as if this long
SIGN_PASSES = 8  # rounds of mending signs before the least-squares search is asked
SMALL = 1e-11  # [–] of the largest pull: what is left of it on another unknown by rounding
NNLS_ROUNDS = 3  # for each row, before the search for multipliers is given up
LEAN = 1e8  # [–] a level's proof is not added to another's more often than this
ROUNDING = 1e-13  # [–] of the terms that make up an imbalance; below it, it counts as none,
# unless they are huge: next to them any pull is small, and by such terms it could be balanced
# however wrong x is. Rows that are nearly parallel need them, and then A itself, known to EPS,
# tells no more:
EVALUATED = 8.0 * EPS  # [–] of the terms, however huge,
LOST = 1e-2  # [–] and of the pull: what may be left


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
def check(A, lower, upper, off, x, lam, tol, row_norm, frobenius, floor, least_norm):
    """Residuals, and which columns of `lam` (M, p or p + 1) fail to prove their level optimal.

    A level may leave what is below its rank floor. With least_norm, column
    p must prove that x is the shortest optimum. Returns whether none fails; w (M,) with residuals
    of the size of rounding set to 0, and missed (p,), the levels with others; pull (M,) the
    residuals as they are, since a small one of a large row may balance the others; push (M,) 0
    where a row may not push, 1 upwards, −1 downwards, 2 both; proven (columns,), which do not fail;
    and scale (n, columns): how much of a level's pull may be left on each unknown: what its own
    rows' rooms would make up for.
    """
    M, n = A.shape
    p = len(off) - 1
    columns = p + 1 if least_norm else p
    w = np.empty(M)
    pull = np.empty(M)  # w as it is: what counts as met may still balance the others
    nearest = np.empty(M)
    natural = 0.0
    length = 0.0
    for j in range(n):
        length += x[j] * x[j]
    length = np.sqrt(length)
    finite = np.isfinite(length)
    for k in range(p):
        asked = 0.0
        for i in range(off[k], off[k + 1]):
            s = 0.0
            for j in range(n):
                s += A[i, j] * x[j]
            nearest[i] = min(max(s, lower[i]), upper[i])
            w[i] = s - nearest[i]
            pull[i] = w[i]
            asked += nearest[i] * nearest[i]
        if frobenius[k] > 0.0:
            natural = max(natural, np.sqrt(asked) / frobenius[k])
    length = max(length, VANISHED * natural)
    scale = np.zeros((n, columns))
    push = np.zeros(M, np.int8)
    own = np.empty(M, np.int64)
    missed = np.empty(p, np.bool_)
    size = np.empty(p)
    for k in range(p):
        rest = 0.0
        total = 0.0
        for i in range(off[k], off[k + 1]):
            own[i] = k
            unit = abs(nearest[i]) + row_norm[i] * length
            room = tol * unit
            value = nearest[i] + w[i]
            if abs(w[i]) <= room:
                w[i] = 0.0
            room += floor[k] * length
            rest += w[i] * w[i]
            if row_norm[i] == 0.0:
                pull[i] = 0.0
            total += pull[i] * pull[i]
            up = value >= upper[i] - room
            down = value <= lower[i] + room
            if row_norm[i] == 0.0:
                pass  # it holds nothing
            elif w[i] != 0.0 or lower[i] == upper[i] or (up and down):
                push[i] = 2
            elif up:
                push[i] = 1
            elif down:
                push[i] = -1
            if push[i] != 0:
                for j in range(n):
                    scale[j, k] += abs(A[i, j]) * room
        missed[k] = rest > 0.0
        size[k] = np.sqrt(total)
        for j in range(n):
            scale[j, k] += floor[k] * size[k]
    if least_norm:
        scale[:, p] = tol * length
    forces = np.zeros((M, columns))
    for i in range(M):
        forces[i, own[i]] = pull[i]
        for k in range(own[i] + 1, columns):
            forces[i, k] = lam[i, k]
    proven = np.empty(columns, np.bool_)
    every = True
    imbalance = np.empty((n, columns))
    unasked = np.zeros((n, columns))  # of it, what is below the level's rank floor
    terms = np.empty(n)  # sums of the sizes of what makes it up
    for k in range(columns):
        for _ in range(SIGN_PASSES):
            mended = False
            for i in range(off[min(k, p)]):
                if push[i] == 2 or forces[i, k] * push[i] > 0.0 or forces[i, k] == 0.0:
                    continue
                # A row that holds a level between must not give way: lean on that level's proof.
                t = 0.0
                for between in range(own[i] + 1, k):
                    if push[i] != 0 and forces[i, between] * push[i] > 0.0:
                        t = -forces[i, k] / forces[i, between]
                        if t > LEAN:
                            t = 0.0
                            continue
                        for r in range(off[between + 1]):
                            forces[r, k] += t * forces[r, between]
                        for j in range(n):
                            unasked[j, k] += t * unasked[j, between]
                        mended = True
                        break
                if t == 0.0:
                    forces[i, k] = 0.0  # it may not push like that; what is then missing, shows
            if not mended:
                break
        pulls = 0.0  # the level's own, to be balanced
        for j in range(n):
            s = x[j] if k == p else 0.0
            terms[j] = 0.0
            for i in range(off[min(k, p)], off[min(k + 1, p)]):
                s += A[i, j] * forces[i, k]
                terms[j] += abs(A[i, j] * forces[i, k])
            imbalance[j, k] = s
            pulls = max(pulls, abs(s))
        for j in range(n):
            for i in range(off[min(k, p)]):
                imbalance[j, k] += A[i, j] * forces[i, k]
                terms[j] += abs(A[i, j] * forces[i, k])
            imbalance[j, k] -= unasked[j, k]
            if k < p:
                most = n * floor[k] * size[k]
                unasked[j, k] += max(-most, min(most, imbalance[j, k]))
        widest = 0.0  # a force's error reaches other unknowns too
        for j in range(n):
            widest = max(widest, terms[j])
        huge = min(EVALUATED * widest, LOST * pulls)
        proven[k] = finite
        for j in range(n):
            scale[j, k] += min(scale[j, k], ROUNDING * terms[j])
            proven[k] &= abs(imbalance[j, k]) <= max(scale[j, k], huge)
        every &= proven[k]
    return every, w, missed, pull, push, proven, scale


def optimality_faults(
    A: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    off: np.ndarray,
    x: np.ndarray,
    multipliers: np.ndarray,
    tol: float,
    row_norm: np.ndarray,
    frobenius: np.ndarray,
    floor: np.ndarray,
    least_norm: bool,
) -> tuple[np.ndarray, np.ndarray, dict[int, tuple[float, str]]]:
    """Residuals w (M,), levels that have some (p,), and what keeps x from being certified.

    That is said for each level at fault, and for p where x is not shown to be the shortest: how
    many times the imbalance is what may be left, and in words.
    """
    every, w, missed, pull, push, proven, scale = check(
        A, lower, upper, off, x, multipliers, tol, row_norm, frobenius, floor, least_norm
    )
    faults: dict[int, tuple[float, str]] = {}
    if every:
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
    size = np.maximum(scale, SMALL * np.abs(pull).max())
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
            best, _ = nnls(rows.T, -rest / length, maxiter=NNLS_ROUNDS * len(rows))
        except RuntimeError:  # it did not converge: these rows are not shown to balance
            best = np.zeros(len(rows))
        rest = rest + length * (rows.T @ best)
    return float(np.abs(rest).max())


def _directions(rows: np.ndarray) -> np.ndarray:
    norm = np.linalg.norm(rows, axis=1)
    return rows[norm > 0.0] / norm[norm > 0.0, None]
