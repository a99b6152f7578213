"""The exact strict hierarchy on a given active set, and the search for the right one.

Everything here is compiled by numba at first use and cached; arrays in, arrays out. The rows of
all levels are stacked; `act` says how each takes part: 2 equality, +1 held at its upper bound,
−1 held at its lower, 0 free.

Each level is reduced in the freedom left by those above: rows are picked by the largest remaining
norm and turned by Householder reflections from the right (Golub & Van Loan, ch. 5), so that
A_k Q = [… L_k 0] with L_k (m, r). A row with one entry left, such as a bound of one unknown, needs
no reflection: its column changes place; first levels that hold nothing but such rows, as box
limits do, are not turned at all. Where a pivot comes close to the rank tolerance, a one-sided
Jacobi SVD of L_k decides the rank on singular values, as the convention asks.

`search` allocates one Work and fills it anew in every step: `_reduce` finds x, `_weigh` the
residuals, and `_column` the multipliers of one level, which only points worth judging need.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from hqp_grasp.certificate import EPS, VANISHED

CLEAR = 1e4  # a pivot this many times away from the rank tolerance needs no SVD
JACOBI_SWEEPS = 40
DUST = EPS  # [–] of a row, for each turn: what is left of it when it has nothing new to say
SMEAR = 4.0 * EPS  # [–] of a row: rounding of its entries after the turns
LOOSE = 16.0 * EPS  # [–] of the terms that make up a residual: its rounding
ROUNDING = 1e-13  # [–] of the terms that make up a residual; below it, it counts as none
STILL = 1e-9  # [–] of the way to a level's optimum: a shorter step is no progress
FEASIBLE = 1e-11  # [–] violation of a bound, in units of |bound| + ‖a‖ ‖x‖, that counts as none
SIGNED = 1e-15  # [–] wrong sign of a multiplier, in units of its level's scale, that counts as none
SURE = 1e-1  # [–] of what is doubtful about a multiplier; below it, it counts as none in any case


@njit(cache=True, error_model="numpy", fastmath={"reassoc"})
def _dot(a, b):
    s = 0.0
    for j in range(len(a)):
        s += a[j] * b[j]
    return s


@njit(cache=True, error_model="numpy")
def _subtract(a, s, b):
    """a −= s b"""
    for j in range(len(a)):
        a[j] -= s * b[j]


@njit(cache=True, error_model="numpy")
def _jacobi(L, r, tiny):
    """Rotate the first r columns of L to be orthogonal; return the rotation (r, r)."""
    V = np.eye(r)
    m = L.shape[0]
    for _ in range(JACOBI_SWEEPS):
        rotated = False
        for i in range(r - 1):
            for j in range(i + 1, r):
                aa = 0.0
                bb = 0.0
                ab = 0.0
                for t in range(m):
                    aa += L[t, i] * L[t, i]
                    bb += L[t, j] * L[t, j]
                    ab += L[t, i] * L[t, j]
                if abs(ab) <= EPS * np.sqrt(aa * bb) or abs(ab) <= tiny * tiny:
                    continue
                rotated = True
                zeta = (bb - aa) / (2.0 * ab)
                if abs(zeta) > 1e150:
                    tan = 0.5 / zeta
                else:
                    tan = 1.0 / (abs(zeta) + np.sqrt(1.0 + zeta * zeta))
                    if zeta < 0.0:
                        tan = -tan
                cos = 1.0 / np.sqrt(1.0 + tan * tan)
                sin = cos * tan
                for t in range(m):
                    x, y = L[t, i], L[t, j]
                    L[t, i] = cos * x - sin * y
                    L[t, j] = sin * x + cos * y
                for t in range(r):
                    x, y = V[t, i], V[t, j]
                    V[t, i] = cos * x - sin * y
                    V[t, j] = sin * x + cos * y
        if not rotated:
            break
    return V


@njit(cache=True, error_model="numpy")
def spectral_norm(A):
    """‖A‖₂ by one-sided Jacobi."""
    m, n = A.shape
    L = A.copy() if n <= m else A.T.copy()
    r = L.shape[1]
    _jacobi(L, r, 0.0)
    best = 0.0
    for j in range(r):
        s = 0.0
        for t in range(L.shape[0]):
            s += L[t, j] * L[t, j]
        best = max(best, s)
    return np.sqrt(best)


@njit(cache=True, error_model="numpy")
def _rotate(W, lo, hi, ma, c, r, tol, V):
    """Turn the block L = W[lo:hi, c:c+r] into U Σ, largest first, and the rows below with it.

    Fills V (r, r), the rotation, and returns the number of singular values above tol. Where all
    are, nothing is turned: triangles keep apart rows of very different size.
    """
    L = W[lo:hi, c : c + r].copy()
    turned = _jacobi(L, r, 1e-3 * tol)
    sigma = np.empty(r)
    for j in range(r):
        s = 0.0
        for i in range(hi - lo):
            s += L[i, j] * L[i, j]
        sigma[j] = np.sqrt(s)
    kept = 0
    order = np.empty(r, np.int64)
    for j in range(r):
        best = 0
        for l in range(r):
            if sigma[l] > sigma[best]:
                best = l
        if sigma[best] > tol:
            kept += 1
        sigma[best] = -1.0
        for i in range(r):
            V[i, j] = turned[i, best]
        order[j] = best
    if kept == r:
        return kept
    for j in range(r):
        for i in range(hi - lo):
            W[lo + i, c + j] = L[i, order[j]]
    row = np.empty(r)
    for i in range(hi, ma):
        for j in range(r):
            row[j] = W[i, c + j]
        for j in range(r):
            s = 0.0
            for l in range(r):
                s += row[l] * V[l, j]
            W[i, c + j] = s
    return kept


class Work(NamedTuple):
    """The active rows, level by level, and their factors; refilled for each active set.

    The rows in use stand first, ma of them; n unknowns, p levels.
    """

    rows: np.ndarray  # (M,) which rows are active, in the order they were picked,
    start: np.ndarray  # (p + 1,) and where each level's begin
    first: np.ndarray  # (p + 1,) level k owns coordinates first[k]:first[k+1] of xq
    made: np.ndarray  # (p,) pivots of each level; more than it owns where its rank was cut
    triangular: np.ndarray  # (p,) whether L_k is square, and so needs no orthogonal factor
    turned: np.ndarray  # (p,) whether a rotation cut its rank
    turn: np.ndarray  # (p, n, n) which
    W: np.ndarray  # (M, n) the rows, turned: A Q
    length: np.ndarray  # (M,) their norms
    left: np.ndarray  # (M,) the squared norms of what is left of the rows of the level at hand
    H: np.ndarray  # (M, n) the reflector made from each picked row,
    beta: np.ndarray  # (M,) its factor, 0 where the row only moved a column
    column: np.ndarray  # (M,) from here
    order: np.ndarray  # (n,) the unknowns, as the columns of W have them before any turn,
    place: np.ndarray  # (n,) and where each stands
    T: np.ndarray  # (M, n) thin orthogonal factors of the L_k that are not triangular
    R: np.ndarray  # (n, n) and their triangular ones
    xq: np.ndarray  # (n,) Qᵀ x
    rhs: np.ndarray  # (M,)
    target: np.ndarray  # (M,) the bound at which each active row is held
    slack: np.ndarray  # (M,) how far a row may miss its bound by rounding
    wa: np.ndarray  # (M,) residuals,
    dim: np.ndarray  # (M,) and how much of that may be rounding
    w: np.ndarray  # (M,) the residuals row by row, without what is rounding
    missed: np.ndarray  # (p,) levels with a residual that is not
    lam: np.ndarray  # (M, p + 1) multipliers, see `_column`,
    doubt: np.ndarray  # (M, p + 1) and how much of them may be rounding
    side: np.ndarray  # (M,) of the bound that x breaks: 1 upper, −1 lower, 0 none
    wrong: np.ndarray  # (M,) 1 where an active row holds x back
    g: np.ndarray  # (n,) a level's pull on the coordinates above it
    h: np.ndarray  # (n,) and what is doubtful of that
    y: np.ndarray  # (n,)
    z: np.ndarray  # (n,)


@njit(cache=True, error_model="numpy")
def _work(M, n, p):
    return Work(
        rows=np.empty(M, np.int64),
        start=np.empty(p + 1, np.int64),
        first=np.zeros(p + 1, np.int64),
        made=np.empty(p, np.int64),
        triangular=np.empty(p, np.bool_),
        turned=np.empty(p, np.bool_),
        turn=np.empty((p, n, n)),
        W=np.empty((M, n)),
        length=np.empty(M),
        left=np.empty(M),
        H=np.empty((M, n)),
        beta=np.empty(M),
        column=np.empty(M, np.int64),
        order=np.empty(n, np.int64),
        place=np.empty(n, np.int64),
        T=np.empty((M, n)),
        R=np.empty((n, n)),
        xq=np.empty(n),
        rhs=np.empty(M),
        target=np.zeros(M),
        slack=np.empty(M),
        wa=np.empty(M),
        dim=np.empty(M),
        w=np.empty(M),
        missed=np.empty(p, np.bool_),
        lam=np.empty((M, p + 1)),
        doubt=np.empty((M, p + 1)),
        side=np.zeros(M, np.int8),
        wrong=np.zeros(M, np.int8),
        g=np.empty(n),
        h=np.empty(n),
        y=np.empty(n),
        z=np.empty(n),
    )


@njit(cache=True, error_model="numpy")
def _only_entries(A):
    """The one unknown that each row is about, (M,); −1 where there are several, or none."""
    M, n = A.shape
    only = np.full(M, -1)
    for i in range(M):
        for j in range(n):
            if A[i, j] != 0.0:
                if only[i] >= 0:
                    only[i] = -1
                    break
                only[i] = j
    return only


@njit(cache=True, error_model="numpy")
def _line_up(A, only, rough, work):
    """Let the unknowns stand first that the first levels hold by rows of one entry, in their order.

    Such rows need no pick and no turn. Returns how many levels have no others.
    """
    rows, order, place = work.rows, work.order, work.place
    for j in range(len(order)):
        order[j] = j
        place[j] = j
    c = 0
    for k in range(len(rough)):
        for i in range(work.start[k], work.start[k + 1]):
            j = only[rows[i]]
            if j < 0 or place[j] < c or abs(A[rows[i], j]) <= rough[k] * CLEAR:
                return k
            there, other = place[j], order[c]
            order[c], order[there] = j, other
            place[j], place[other] = c, there
            c += 1
    return len(rough)


@njit(cache=True, error_model="numpy")
def _pick(work, lo, hi, ma, c, steps, rough):
    """Pick rows lo:hi by the largest rest, and turn all rows so that coordinate c + r is theirs.

    Returns how many were picked, and whether some came close to the rank tolerance `rough`.
    """
    W, H, left, length = work.W, work.H, work.left, work.length
    n = W.shape[1]
    for i in range(lo, hi):
        left[i] = _dot(W[i, c:], W[i, c:])
    ambiguous = False
    r = 0
    while r < steps:
        d = c + r
        row = lo + r
        best = 0.0
        pick = row
        for i in range(row, hi):
            tiny = DUST * d * length[i]
            if left[i] <= tiny * tiny:
                if left[i] > 0.0:
                    for j in range(d, n):
                        W[i, j] = 0.0
                    left[i] = 0.0
            elif left[i] > best:
                best = left[i]
                pick = i
        norm = np.sqrt(best)
        if best == 0.0 or norm <= rough / (CLEAR * 10.0):
            break
        if norm <= rough * CLEAR:
            ambiguous = True
        if pick != row:
            work.rows[pick], work.rows[row] = work.rows[row], work.rows[pick]
            for j in range(n):
                W[pick, j], W[row, j] = W[row, j], W[pick, j]
            length[pick], length[row] = length[row], length[pick]
            left[pick] = left[row]
        entries = 0
        only = d
        for j in range(d, n):
            if W[row, j] != 0.0:
                entries += 1
                only = j
                if entries > 1:
                    break
        if entries == 1:
            work.beta[row] = 0.0
            work.column[row] = only
            for i in range(row, ma):
                moved = W[i, only]
                W[i, only] = W[i, d]
                W[i, d] = moved
                if i < hi and moved != 0.0:
                    left[i] = _dot(W[i, d + 1 :], W[i, d + 1 :])
        else:
            alpha = -norm if W[row, d] > 0.0 else norm
            for j in range(d, n):
                H[row, j] = W[row, j]
            H[row, d] -= alpha
            beta = 1.0 / (norm * abs(H[row, d]))
            work.beta[row] = beta
            W[row, d] = alpha
            for j in range(d + 1, n):
                W[row, j] = 0.0
            for i in range(row + 1, ma):
                s = _dot(W[i, d:], H[row, d:])
                if s != 0.0:
                    _subtract(W[i, d:], s * beta, H[row, d:])
                if i < hi:
                    left[i] = _dot(W[i, d + 1 :], W[i, d + 1 :])
        r += 1
    return r, ambiguous


@njit(cache=True, error_model="numpy")
def _least_squares(work, lo, hi, c, r):
    """Solve L y = rhs for coordinates c:c+r, in the least-squares sense; the rest stays in rhs."""
    W, T, R, rhs, y = work.W, work.T, work.R, work.rhs, work.y
    for j in range(r):  # Gram–Schmidt, twice is enough
        for i in range(lo, hi):
            T[i, c + j] = W[i, c + j]
        for l in range(j):
            R[c + l, c + j] = 0.0
        for _ in range(2):
            for l in range(j):
                s = 0.0
                for i in range(lo, hi):
                    s += T[i, c + l] * T[i, c + j]
                R[c + l, c + j] += s
                for i in range(lo, hi):
                    T[i, c + j] -= s * T[i, c + l]
        s = 0.0
        for i in range(lo, hi):
            s += T[i, c + j] * T[i, c + j]
        s = np.sqrt(s)
        R[c + j, c + j] = s
        for i in range(lo, hi):
            T[i, c + j] /= s
        work.xq[c + j] = 0.0
    for _ in range(2):  # the second pass removes what rounding left
        for j in range(r):
            s = 0.0
            for i in range(lo, hi):
                s += T[i, c + j] * rhs[i]
            y[j] = s
            for i in range(lo, hi):
                rhs[i] -= s * T[i, c + j]
        for j in range(r - 1, -1, -1):
            s = y[j]
            for l in range(j + 1, r):
                s -= R[c + j, c + l] * y[l]
            y[j] = s / R[c + j, c + j]
            work.xq[c + j] += y[j]


@njit(cache=True, error_model="numpy")
def _reduce(A, off, act, only, row_norm, frobenius, rough, work, x):
    """Lexicographic least squares of the rows with act ≠ 0, as equalities at their target: x.

    What is left of a row, after it is reduced by c others, counts as nothing below DUST × c of
    its length; singular values, below `rough` (p,) × ‖A_k‖₂ / ‖A_k‖_F.
    """
    n = A.shape[1]
    p = len(off) - 1
    W, xq, rows, rhs, order = work.W, work.xq, work.rows, work.rhs, work.order
    ma = 0
    for k in range(p):
        work.start[k] = ma
        for i in range(off[k], off[k + 1]):
            if act[i] != 0:
                rows[ma] = i
                work.length[ma] = row_norm[i]
                ma += 1
    work.start[p] = ma
    lined_up = _line_up(A, only, rough, work)
    for i in range(ma):
        for j in range(n):
            W[i, j] = A[rows[i], order[j]]
    c = 0
    for k in range(p):
        work.first[k] = c
        lo, hi = work.start[k], work.start[k + 1]
        m = hi - lo
        r = 0
        work.made[k] = 0
        work.turned[k] = False
        if k < lined_up:
            r = work.made[k] = m
        elif m > 0 and c < n and frobenius[k] > 0.0:
            r, ambiguous = _pick(work, lo, hi, ma, c, min(m, n - c), rough[k])
            work.made[k] = r
            if ambiguous:
                tol = rough[k] * spectral_norm(A[off[k] : off[k + 1]]) / frobenius[k]
                V = np.zeros((r, r))
                r = _rotate(W, lo, hi, ma, c, r, tol, V)
                work.turned[k] = r < work.made[k]
                for i in range(work.made[k]):
                    for j in range(work.made[k]):
                        work.turn[k, i, j] = V[i, j]
                if work.turned[k]:
                    for i in range(lo, hi):
                        for j in range(c + r, n):
                            W[i, j] = 0.0
        for i in range(lo, hi):
            rhs[i] = work.target[rows[i]] - _dot(W[i, :c], xq)
        work.triangular[k] = r == m and not work.turned[k]
        if work.triangular[k]:
            for i in range(m):
                s = rhs[lo + i] - _dot(W[lo + i, c : c + i], xq[c:])
                xq[c + i] = s / W[lo + i, c + i]
                rhs[lo + i] = 0.0
        else:
            _least_squares(work, lo, hi, c, r)
        for i in range(lo, hi):
            work.wa[i] = -rhs[i]
        c += r
    work.first[p] = c
    for j in range(n):
        x[j] = xq[j] if j < c else 0.0
    for k in range(p - 1, lined_up - 1, -1):  # x = Q xq, the factors of Q, the last first
        a, r = work.first[k], work.made[k]
        if work.turned[k]:
            for i in range(r):
                s = 0.0
                for j in range(r):
                    s += work.turn[k, i, j] * x[a + j]
                work.y[i] = s
            for i in range(r):
                x[a + i] = work.y[i]
        for l in range(r - 1, -1, -1):
            row = work.start[k] + l
            d = a + l
            if work.beta[row] == 0.0:
                only = work.column[row]
                x[d], x[only] = x[only], x[d]
                continue
            s = work.beta[row] * _dot(work.H[row, d:], x[d:])
            _subtract(x[d:], s, work.H[row, d:])
    for j in range(n):
        work.y[order[j]] = x[j]
    x[:] = work.y


@njit(cache=True, error_model="numpy")
def _weigh(work):
    """The residuals of the active rows: those of the size of rounding are none."""
    p = len(work.made)
    work.w[:] = 0.0
    for k in range(p):
        work.missed[k] = False
        for i in range(work.start[k], work.start[k + 1]):
            size = abs(work.target[work.rows[i]])
            for j in range(work.first[k + 1]):
                size += abs(work.W[i, j] * work.xq[j])
            work.dim[i] = LOOSE * size
            if abs(work.wa[i]) > ROUNDING * size:
                work.missed[k] = True
                work.w[work.rows[i]] = work.wa[i]


@njit(cache=True, error_model="numpy")
def _column(k, work):
    """Column k of lam (M, p + 1), the multipliers of the rows above for level k's optimality.

    A_kᵀ w_k + Σ_{j<k} A_jᵀ lam_jk = 0; column p has those of the minimum norm of x. Rows of level
    k hold w_k there, with more digits than w has. `doubt`, of the same shape, is how much of lam
    may be rounding.
    """
    W, T, R, rows, start, first = work.W, work.T, work.R, work.rows, work.start, work.first
    g, h, y, z = work.g, work.h, work.y, work.z
    length, lam, doubt = work.length, work.lam, work.doubt
    p = len(work.made)
    for i in range(len(lam)):
        lam[i, k] = 0.0
        doubt[i, k] = 0.0
    top = first[k]
    if k == p:
        for j in range(top):
            g[j] = work.xq[j]
            h[j] = SIGNED * abs(work.xq[j])
    elif not work.missed[k]:
        return
    else:
        lo, hi = start[k], start[k + 1]
        for j in range(top):
            g[j] = 0.0
            h[j] = 0.0
        # The residuals of the rows that span the level follow from the others', to more digits
        # than the rows' values have: they balance them.
        r = 0 if work.turned[k] else first[k + 1] - top
        for i in range(hi - 1, lo - 1, -1):
            push = work.wa[i]
            size = SIGNED * abs(push) + work.dim[i]
            if i < lo + r:
                push = 0.0
                size = 0.0
                d = top + i - lo
                for l in range(i + 1, hi):
                    if W[l, d] != 0.0:
                        push -= W[l, d] * lam[rows[l], k]
                        size += abs(W[l, d]) * doubt[rows[l], k]
                        size += SMEAR * length[l] * abs(lam[rows[l], k])
                push /= W[i, d]
                size /= abs(W[i, d])
            lam[rows[i], k] = push
            doubt[rows[i], k] = size
            rounding = SMEAR * length[i] * abs(push)
            for j in range(top):
                if W[i, j] != 0.0:
                    g[j] += W[i, j] * push
                    h[j] += abs(W[i, j]) * size + rounding
    for l in range(min(k, p) - 1, -1, -1):
        lo, hi = start[l], start[l + 1]
        a, r = first[l], first[l + 1] - first[l]
        if r == 0:
            continue
        if work.triangular[l]:  # Lᵀ λ = −g
            for i in range(r - 1, -1, -1):
                s = -g[a + i]
                size = h[a + i]
                for j in range(i + 1, r):
                    s -= W[lo + j, a + i] * lam[rows[lo + j], k]
                    size += abs(W[lo + j, a + i]) * doubt[rows[lo + j], k]
                lam[rows[lo + i], k] = s / W[lo + i, a + i]
                doubt[rows[lo + i], k] = size / abs(W[lo + i, a + i])
        else:  # λ = −T R⁻ᵀ g, the least-norm one
            for i in range(r):
                s = -g[a + i]
                size = h[a + i]
                for j in range(i):
                    s -= R[a + j, a + i] * z[j]
                    size += abs(R[a + j, a + i]) * y[j]
                z[i] = s / R[a + i, a + i]
                y[i] = size / R[a + i, a + i]
            for i in range(lo, hi):
                s = 0.0
                size = 0.0
                for j in range(r):
                    s += T[i, a + j] * z[j]
                    size += abs(T[i, a + j]) * y[j]
                lam[rows[i], k] = s
                doubt[rows[i], k] = size
        for i in range(lo, hi):
            s = lam[rows[i], k]
            if s != 0.0:
                size = doubt[rows[i], k]
                rounding = SMEAR * length[i] * abs(s)
                for j in range(a):
                    if W[i, j] != 0.0:
                        g[j] += W[i, j] * s
                        h[j] += abs(W[i, j]) * size + rounding


@njit(cache=True, error_model="numpy")
def equalities(lower, upper):
    """The active set of the equalities alone, (M,) int8."""
    act = np.zeros(len(lower), np.int8)
    for i in range(len(lower)):
        if lower[i] == upper[i]:
            act[i] = 2
    return act


@njit(cache=True, error_model="numpy")
def _judge(own, side, w, room, push, doubt, scale):
    """Whether a column shows that an active row holds x back: 1 yes, −1 it pushes well, 0 neither.

    A row that holds x from the wrong side would, let go, be met and let a level gain. `own`:
    whether the column is of the row's own level; if not, push and doubt are in units of the row.
    """
    if own and abs(w) > room:
        return 1 if w * side < 0.0 else -1  # that it cannot be met decides
    none = doubt if own else max(min(SIGNED * scale, doubt), SURE * doubt)
    if push * side > none:
        return -1
    return 1 if push * side < -none else 0


@njit(cache=True, error_model="numpy")
def _broken(A, lower, upper, act, x, start, work):
    """Mark the side on which x breaks each free row; count them, and find the first on the way.

    Returns the count, that row (−1: none), and how far from `start` to x it lets one go, 0 to 1.
    """
    slack, side = work.slack, work.side
    count = 0
    first = -1
    way = 1.0
    for i in range(len(A)):
        side[i] = 0
        if act[i] != 0:
            continue
        goal = _dot(A[i], x)
        if goal > upper[i] + slack[i] + FEASIBLE * abs(upper[i]):
            bound, side[i] = upper[i], 1
        elif goal < lower[i] - slack[i] - FEASIBLE * abs(lower[i]):
            bound, side[i] = lower[i], -1
        else:
            continue
        count += 1
        here = _dot(A[i], start)
        ratio = max(0.0, (bound - here) / (goal - here)) if goal != here else 0.0
        if ratio < way or first < 0:
            way, first = ratio, i
    return count, first, way


@njit(cache=True, error_model="numpy")
def _unwilling(off, act, frobenius, row_norm, length, kept, single, late, work):
    """Mark the active rows that hold x back although a level would gain by letting go.

    Returns how many, and the worst of those that the first such level names (−1: none), or where it
    is `late` just the first. Where rows move `single`, the levels below are left out.
    """
    p = len(off) - 1
    count = 0
    worst = -1
    w, lam, doubt, wrong = work.w, work.lam, work.doubt, work.wrong
    _weigh(work)
    for i in range(len(act)):  # 2: no column has decided on it yet
        wrong[i] = 2 if (act[i] == 1 or act[i] == -1) and not kept[i] else 0
    for k in range(p + 1):
        _column(k, work)
        scale = length
        if k < p:
            scale = frobenius[k] * np.sqrt(_dot(w[off[k] : off[k + 1]], w[off[k] : off[k + 1]]))
        named = worst >= 0
        most = 0.0
        for level in range(min(k + 1, p)):
            for i in range(off[level], off[level + 1]):
                if wrong[i] != 2:
                    continue
                room = work.slack[i] + FEASIBLE * abs(work.target[i])
                unit = row_norm[i] if k > level else 1.0
                says = _judge(
                    k == level, act[i], w[i], room, lam[i, k] * unit, doubt[i, k] * unit, scale
                )
                if says == 0:
                    continue
                wrong[i] = 1 if says > 0 else 0
                if says < 0:
                    continue
                count += 1
                size = abs(lam[i, k]) * unit
                if not named and (worst < 0 or (size > most and not late)):
                    worst, most = i, size
        if single and worst >= 0:
            break
    return count, worst


@njit(cache=True, error_model="numpy")
def search(A, lower, upper, off, act, frobenius, row_norm, rank_tolerance, blocks, pivots):
    """Find the active set of the lexicographic optimum, starting from `act` (changed in place).

    First up to `blocks` rounds that take in every row x breaks and let go every row of wrong sign
    at once, for as long as there are ever fewer of them. Then steps that move one row each, as
    the primal method does that improves the levels in their order at every step (LexLSI, Dimitrov,
    Sherikov & Wieber 2015); with blocks = 0 it is that method, from x = 0. Ends after
    blocks + pivots steps at the latest; whether it found the optimum is for the certificate to
    say. rank_tolerance < 0 asks for the default.

    Returns x (n,), the multipliers (M, p + 1) explained at `_column`, and rank (p,).
    """
    M, n = A.shape
    p = len(off) - 1
    work = _work(M, n, p)
    rough = np.empty(p)
    for k in range(p):
        demanding = False  # a limit's rank is never cut
        for i in range(off[k], off[k + 1]):
            demanding |= act[i] == 2
        if rank_tolerance < 0.0 or not demanding:
            rough[k] = max(off[k + 1] - off[k], n) * EPS * frobenius[k]
        else:
            rough[k] = rank_tolerance * frobenius[k]
    only = _only_entries(A)
    target, side, wrong = work.target, work.side, work.wrong
    x = np.zeros(n)
    start = np.zeros(n)  # the point that the steps of one row have reached
    kept = np.zeros(M, np.bool_)  # rows that hold x although their multipliers seem to say no
    last = -1  # row and side let go in the step before
    last_side = 0
    fewest = M + 1
    single = blocks == 0
    if single:
        for i in range(M):
            if act[i] != 2:
                act[i] = 1 if upper[i] < 0.0 else (-1 if lower[i] > 0.0 else 0)
    begun = 0  # the step at which one row at a time began
    for step in range(blocks + pivots):
        for i in range(M):
            if act[i] != 0:
                target[i] = upper[i] if act[i] > 0 else lower[i]
        _reduce(A, off, act, only, row_norm, frobenius, rough, work, x)
        length = np.sqrt(_dot(x, x))
        for k in range(p):  # where x vanishes by cancellation, what the levels ask of it counts
            s = 0.0
            for i in range(off[k], off[k + 1]):
                if act[i] != 0:
                    s += target[i] * target[i]
            if frobenius[k] > 0.0:
                length = max(length, VANISHED * np.sqrt(s) / frobenius[k])
        for i in range(M):
            work.slack[i] = FEASIBLE * row_norm[i] * length
        broken, block, alpha = _broken(A, lower, upper, act, x, start, work)
        unwilling = 0
        drop = -1
        if not single or block < 0:
            late = 2 * (step - begun) > pivots  # Bland: the first one, so that it ends
            unwilling, drop = _unwilling(
                off, act, frobenius, row_norm, length, kept, single, late, work
            )
        count = broken + unwilling
        if count == 0:
            break
        if not single:
            if count < fewest and step + 1 < blocks:
                fewest = count
                for i in range(M):
                    if wrong[i] == 1:
                        act[i] = 0
                    elif side[i] != 0:
                        act[i] = side[i]
                continue
            single = True
            begun = step
        if block >= 0:
            for j in range(n):
                start[j] += alpha * (x[j] - start[j])
            act[block] = side[block]
            # A row let go for good reason cannot be the next one met: its sign was rounding.
            if block == last and side[block] == last_side:
                kept[block] = True
            elif alpha > STILL:
                kept[:] = False
            last = -1
        else:
            start[:] = x
            last, last_side = drop, act[drop]
            act[drop] = 0
    else:
        _weigh(work)
        for k in range(p + 1):
            _column(k, work)
    return x, work.lam, work.first[1:] - work.first[:-1]
