"""The exact strict hierarchy on a given active set, and the search for the right one.

Everything here is compiled by numba at first use and cached; arrays in, arrays out. The rows of
all levels are stacked; `act` says how each takes part: 2 equality, +1 held at its upper bound,
−1 held at its lower, 0 free.

Each level is reduced in the freedom left by those above: its rows are seen along the directions
that are left, picked by the largest remaining norm, and the directions turned by Householder
reflections (Golub & Van Loan, ch. 5) so that A_k Zᵀ = [… L_k 0] with L_k (m, r). So a level costs
only what the freedom left is large, and levels below need not be there yet. A row with one entry
left, such as a bound of one unknown, needs no reflection: two directions change place; first levels
that hold nothing but such rows, as box limits do, are not turned at all. Where a pivot comes close
to the rank tolerance, a one-sided Jacobi SVD of L_k decides the rank on singular values, as the
convention asks.

`search` allocates one Work and fills it anew for every active set: `_begin` and `_reduce` find x,
`_weigh` the residuals, and `_column` the multipliers of one level, which only points worth judging
need. All are inlined (`forceinline`): a call with Work as argument counts a reference for each of
its arrays, up and down, which takes longer than the arithmetic of a dozen unknowns.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hqp_grasp.errors import InputError
from hqp_grasp.hierarchy.certificate import EPS, ROUNDING
from hqp_grasp.hierarchy.level import Stacked
from hqp_grasp.kernels import njit

CLEAR = 1e4  # a pivot this many times away from the rank tolerance needs no SVD
JACOBI_SWEEPS = 12  # at most; it converges in six or seven
OVERHEAD = 10_000  # [multiply-adds] for a step of any size
SMEAR = 4.0 * EPS  # [–] rounding of a row's entries after the turns, and of what is made up of them
FEASIBLE = 1e-11  # [–] violation of a bound that is rounding, in units of |bound| + ‖a‖ ‖x‖
SURE = 1e-1  # [–] share of a multiplier's uncertainty that it must exceed for its sign to decide


# Rows are passed as a flat array, where they begin and their length. Slices would be counted
# references, and indices that might be negative keep loops from becoming vector instructions; both
# cost more than the arithmetic of a short row.
@njit(cache=True, error_model="numpy", fastmath={"reassoc"}, forceinline=True)
def _dot(a, i, b, j, m):
    """a[i : i + m] · b[j : j + m]"""
    s = 0.0
    for l in range(np.uint64(m)):
        s += a[np.uint64(i) + l] * b[np.uint64(j) + l]
    return s


@njit(cache=True, error_model="numpy", forceinline=True)
def _subtract(a, i, s, b, j, m):
    """a[i : i + m] −= s b[j : j + m]"""
    for l in range(np.uint64(m)):
        a[np.uint64(i) + l] -= s * b[np.uint64(j) + l]


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
def _rotate(lo, hi, c, o, r, tol, work):
    """Turn the block L = W[lo:hi, c:c+r] into U Σ, largest first, and its directions with it.

    Returns the number of singular values above tol. Where all are, nothing is turned: triangles
    keep apart rows of very different size.
    """
    W, Z = work.W, work.Z
    L = W[lo:hi, c : c + r].copy()
    V = _jacobi(L, r, 1e-3 * tol)
    sigma = np.empty(r)
    for j in range(r):
        s = 0.0
        for i in range(hi - lo):
            s += L[i, j] * L[i, j]
        sigma[j] = np.sqrt(s)
    kept = 0
    for j in range(r):
        kept += sigma[j] > tol
    if kept == r:
        return kept
    n = Z.shape[1]
    before = Z[c : c + r].copy().ravel()
    for j in range(r):
        best = np.argmax(sigma)
        sigma[best] = -1.0
        for i in range(hi - lo):
            W[lo + i, c + j] = L[i, best]
        Z[c + j, o:] = 0.0
        for l in range(r):
            _subtract(work.flat_z, (c + j) * n + o, -V[l, best], before, l * n + o, n - o)
    return kept


class Work(NamedTuple):
    """The active rows, level by level, and their factors; refilled for each active set.

    The rows in use stand first, ma of them; n unknowns, p levels.
    """

    rows: np.ndarray  # (M,) which rows are active, in the order they were picked,
    start: np.ndarray  # (p + 1,) and where each level's begin
    first: np.ndarray  # (p + 1,) level k owns directions first[k]:first[k+1]
    triangular: np.ndarray  # (p,) whether L_k is square, and so needs no orthogonal factor
    turned: np.ndarray  # (p,) whether a rotation cut its rank
    V: np.ndarray  # (M, n) the rows, the unknowns in the order below,
    W: np.ndarray  # (M, n) and along the directions; those of levels above by `_complete`
    Z: np.ndarray  # (n, n) the directions, one a row, orthonormal; those lined up are not filled in
    T: np.ndarray  # (n, M) thin orthogonal factors of the L_k that are not triangular, transposed
    flat_v: np.ndarray  # V, W, Z and T, row behind row
    flat_w: np.ndarray
    flat_z: np.ndarray
    flat_t: np.ndarray
    length: np.ndarray  # (M,) the norms of the rows
    left: np.ndarray  # (M,) the squared norms of what is left of the rows of the level at hand
    order: np.ndarray  # (n,) the unknowns: first those that rows of one entry hold, in their order,
    place: np.ndarray  # (n,) and where each stands
    R: np.ndarray  # (n, n) the triangular factors that belong to T
    xq: np.ndarray  # (n,) x along the directions
    xv: np.ndarray  # (n,) and in the order above
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
    V, W, Z, T = np.empty((M, n)), np.empty((M, n)), np.empty((n, n)), np.empty((n, M))
    return Work(
        rows=np.empty(M, np.int64),
        start=np.empty(p + 1, np.int64),
        first=np.zeros(p + 1, np.int64),
        triangular=np.empty(p, np.bool_),
        turned=np.empty(p, np.bool_),
        V=V,
        W=W,
        Z=Z,
        T=T,
        flat_v=V.ravel(),
        flat_w=W.ravel(),
        flat_z=Z.ravel(),
        flat_t=T.ravel(),
        length=np.empty(M),
        left=np.empty(M),
        order=np.empty(n, np.int64),
        place=np.empty(n, np.int64),
        R=np.empty((n, n)),
        xq=np.empty(n),
        xv=np.empty(n),
        rhs=np.empty(M),
        target=np.zeros(M),
        slack=np.empty(M),
        wa=np.empty(M),
        dim=np.empty(M),
        w=np.empty(M),
        missed=np.empty(p, np.bool_),
        lam=np.zeros((M, p + 1)),
        doubt=np.zeros((M, p + 1)),
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


@njit(cache=True, error_model="numpy", forceinline=True)
def _line_up(A, only, floor, rows, start, order, place):
    """Let the unknowns stand first that the first levels hold by rows of one entry, in their order.

    Such rows need no pick and no turn. Returns how many levels have no others.
    """
    for j in range(len(order)):
        order[j] = j
        place[j] = j
    c = 0
    for k in range(len(floor)):
        for i in range(start[k], start[k + 1]):
            j = only[rows[i]]
            if j < 0 or place[j] < c or abs(A[rows[i], j]) <= floor[k] * CLEAR:
                return k
            there, other = place[j], order[c]
            order[c], order[there] = j, other
            place[j], place[other] = c, there
            c += 1
    return len(floor)


@njit(cache=True, error_model="numpy", forceinline=True)
def _pick(rows, V, W, Z, flat_w, flat_z, left, length, v, s, lo, hi, c, o, floor):
    """Pick rows lo:hi by the largest rest, and turn the directions so that c + r is the r-th's.

    Directions before o are unknowns and no part of it. Returns how many were picked, and whether
    some came close to the rank tolerance `floor`.
    """
    n = W.shape[1]
    for i in range(lo, hi):
        left[i] = _dot(flat_w, i * n + c, flat_w, i * n + c, n - c)
    ambiguous = False
    r = 0
    while r < min(hi - lo, n - c):
        d = c + r
        row = lo + r
        best = 0.0
        pick = row
        for i in range(row, hi):
            tiny = EPS * d * length[i]
            if left[i] <= tiny * tiny:
                if left[i] > 0.0:
                    for j in range(d, n):
                        W[i, j] = 0.0
                    left[i] = 0.0
            elif left[i] > best:
                best = left[i]
                pick = i
        norm = np.sqrt(best)
        if best == 0.0 or norm <= floor / (CLEAR * 10.0):
            break
        if norm <= floor * CLEAR:
            ambiguous = True
        if pick != row:
            rows[pick], rows[row] = rows[row], rows[pick]
            for j in range(n):
                V[pick, j], V[row, j] = V[row, j], V[pick, j]
            for j in range(c, n):
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
            for i in range(row, hi):
                moved = W[i, only]
                W[i, only] = W[i, d]
                W[i, d] = moved
                if moved != 0.0:
                    rest = i * n + d + 1
                    left[i] = _dot(flat_w, rest, flat_w, rest, n - d - 1)
            for j in range(o, n):
                Z[only, j], Z[d, j] = Z[d, j], Z[only, j]
        else:
            alpha = -norm if W[row, d] > 0.0 else norm
            for j in range(d, n):
                v[j] = W[row, j]
            v[d] -= alpha
            beta = 1.0 / (norm * abs(v[d]))
            W[row, d] = alpha
            for j in range(d + 1, n):
                W[row, j] = 0.0
            for i in range(row + 1, hi):
                rest = i * n + d
                push = _dot(flat_w, rest, v, d, n - d)
                if push != 0.0:
                    _subtract(flat_w, rest, push * beta, v, d, n - d)
                left[i] = _dot(flat_w, rest + 1, flat_w, rest + 1, n - d - 1)
            for j in range(o, n):
                s[j] = 0.0
            for j in range(d, n):
                _subtract(s, o, -v[j], flat_z, j * n + o, n - o)
            for j in range(d, n):
                _subtract(flat_z, j * n + o, beta * v[j], s, o, n - o)
        r += 1
    return r, ambiguous


@njit(cache=True, error_model="numpy", forceinline=True)
def _least_squares(work, lo, hi, c, r):
    """Solve L y = rhs for coordinates c:c+r, in the least-squares sense; the rest stays in rhs."""
    W, R, rhs, y = work.W, work.R, work.rhs, work.y
    M, m = len(rhs), hi - lo
    T = work.flat_t
    for j in range(r):  # Gram–Schmidt, twice is enough
        own = (c + j) * M + lo
        for i in range(m):
            T[own + i] = W[lo + i, c + j]
        for l in range(j):
            R[c + l, c + j] = 0.0
        for _ in range(2):
            for l in range(j):
                s = _dot(T, (c + l) * M + lo, T, own, m)
                R[c + l, c + j] += s
                _subtract(T, own, s, T, (c + l) * M + lo, m)
        s = np.sqrt(_dot(T, own, T, own, m))
        R[c + j, c + j] = s
        for i in range(m):
            T[own + i] /= s
        work.xq[c + j] = 0.0
    for _ in range(2):  # the second pass removes what rounding left
        for j in range(r):
            y[j] = _dot(T, (c + j) * M + lo, rhs, lo, m)
            _subtract(rhs, lo, y[j], T, (c + j) * M + lo, m)
        for j in range(r - 1, -1, -1):
            s = y[j]
            for l in range(j + 1, r):
                s -= R[c + j, c + l] * y[l]
            y[j] = s / R[c + j, c + j]
            work.xq[c + j] += y[j]


@njit(cache=True, error_model="numpy", forceinline=True)
def _begin(A, lower, upper, off, act, only, row_norm, floor, work):
    """Line up the active rows, levels and unknowns for `_reduce`; the first levels may be done."""
    V, Z, order = work.V, work.Z, work.order
    n = len(order)
    ma = 0
    for k in range(len(floor)):
        work.start[k] = ma
        for i in range(off[k], off[k + 1]):
            if act[i] != 0:
                work.rows[ma] = i
                work.target[i] = upper[i] if act[i] > 0 else lower[i]
                work.length[ma] = row_norm[i]
                ma += 1
    work.start[len(floor)] = ma
    lined_up = _line_up(A, only, floor, work.rows, work.start, order, work.place)
    for i in range(ma):
        for j in range(n):
            V[i, j] = A[work.rows[i], order[j]] if work.length[i] > 0.0 else 0.0
    work.first[0] = 0
    for k in range(lined_up):
        c, lo = work.first[k], work.start[k]
        m = work.start[k + 1] - lo
        work.first[k + 1] = c + m
        work.triangular[k] = True
        work.turned[k] = False
        for i in range(m):
            work.xq[c + i] = work.xv[c + i] = work.target[work.rows[lo + i]] / V[lo + i, c + i]
            work.wa[lo + i] = 0.0
    c = work.first[lined_up]
    for j in range(c, n):
        work.xv[j] = 0.0
        for l in range(c, n):
            Z[j, l] = 1.0 if j == l else 0.0
    return lined_up


@njit(cache=True, error_model="numpy", forceinline=True)
def _reduce(A, off, begin, end, o, frobenius, floor, work, x):
    """Lexicographic least squares of the active rows, as equalities at their target: x.

    Takes in levels begin … end − 1; those above are reduced. Directions before o are unknowns.

    What is left of a row, after it is reduced by c others, counts as nothing below ε c of
    its length; singular values, below `floor` (p,) × ‖A_k‖₂ / ‖A_k‖_F. Returns the multiply-adds
    that it took, about.
    """
    V, W, Z, xq, xv, rhs = work.V, work.W, work.Z, work.xq, work.xv, work.rhs
    n = len(x)
    flat_v, flat_w, flat_z = work.flat_v, work.flat_w, work.flat_z
    spent = 0
    for k in range(begin, end):
        c, lo, hi = work.first[k], work.start[k], work.start[k + 1]
        m = hi - lo
        spent += 2 * m * n * (n - c)
        r = 0
        work.turned[k] = False
        if m > 0 and c < n and frobenius[k] > 0.0:
            for i in range(lo, hi):
                for j in range(c, n):
                    W[i, j] = (
                        V[i, j] if c == o else _dot(flat_v, i * n + o, flat_z, j * n + o, n - o)
                    )
            r, ambiguous = _pick(
                work.rows,
                V,
                W,
                Z,
                flat_w,
                flat_z,
                work.left,
                work.length,
                work.y,
                work.z,
                lo,
                hi,
                c,
                o,
                floor[k],
            )
            if ambiguous:
                tol = floor[k] * spectral_norm(A[off[k] : off[k + 1]]) / frobenius[k]
                made = r
                most, least = max(off[k + 1] - off[k], n), min(off[k + 1] - off[k], n)
                spent += JACOBI_SWEEPS * (3 * most * least * least + 6 * r * r * (m + r))
                r = _rotate(lo, hi, c, o, r, tol, work)
                work.turned[k] = r < made
        for i in range(lo, hi):
            rhs[i] = work.target[work.rows[i]] - _dot(flat_v, i * n, xv, 0, n)
        work.triangular[k] = r == m and not work.turned[k]
        if work.triangular[k]:
            for i in range(m):
                s = rhs[lo + i] - _dot(flat_w, (lo + i) * n + c, xq, c, i)
                xq[c + i] = s / W[lo + i, c + i]
                rhs[lo + i] = 0.0
        else:
            _least_squares(work, lo, hi, c, r)
        for i in range(lo, hi):
            work.wa[i] = -rhs[i]
        for j in range(c, c + r):
            _subtract(xv, o, -xq[j], flat_z, j * n + o, n - o)
        work.first[k + 1] = c + r
    for j in range(n):
        x[work.order[j]] = xv[j]
    return spent


@njit(cache=True, error_model="numpy", forceinline=True)
def _complete(levels, o, work):
    """Fill in W along the directions of the levels above."""
    n = len(work.xv)
    flat_v, flat_z = work.flat_v, work.flat_z
    for k in range(levels):
        for i in range(work.start[k], work.start[k + 1]):
            for j in range(min(o, work.first[k + 1])):
                work.W[i, j] = work.V[i, j]
            for j in range(o, work.first[k]):
                work.W[i, j] = _dot(flat_v, i * n + o, flat_z, j * n + o, n - o)


@njit(cache=True, error_model="numpy", forceinline=True)
def _weigh(levels, work):
    """The residuals of the active rows: those of the size of rounding are none."""
    work.w[:] = 0.0
    for k in range(levels):
        work.missed[k] = False
        for i in range(work.start[k], work.start[k + 1]):
            size = abs(work.target[work.rows[i]])
            for j in range(work.first[k + 1]):
                size += abs(work.W[i, j] * work.xq[j])
            work.dim[i] = SMEAR * size
            if abs(work.wa[i]) > ROUNDING * size and work.length[i] > 0.0:
                work.missed[k] = True
                work.w[work.rows[i]] = work.wa[i]


@njit(cache=True, error_model="numpy", forceinline=True)
def _column(k, levels, floor, work):
    """Column k of lam (M, p + 1), the multipliers of the rows above for level k's optimality.

    A_kᵀ w_k + Σ_{j<k} A_jᵀ lam_jk = 0; the one behind the last of the `levels` taken in, p in the
    end, has those of the minimum norm of x. Rows of level k hold w_k there, with more digits than
    w has. `doubt`, of the same shape, is how much of lam may be rounding.
    """
    W, T, R, rows, start, first = work.W, work.T, work.R, work.rows, work.start, work.first
    g, h, y, z = work.g, work.h, work.y, work.z
    length, lam, doubt = work.length, work.lam, work.doubt
    for i in range(len(lam)):
        lam[i, k] = 0.0
        doubt[i, k] = 0.0
    top = first[k]
    if k == levels:
        for j in range(top):
            g[j] = work.xq[j]
            h[j] = SMEAR * abs(work.xq[j])
    elif not work.missed[k]:
        return
    else:
        lo, hi = start[k], start[k + 1]
        unasked = 0.0  # of the level's pull, for it is below the rank floor
        for i in range(lo, hi):
            if length[i] > 0.0:
                unasked += work.wa[i] * work.wa[i]
        unasked = floor[k] * np.sqrt(unasked)
        for j in range(top):
            g[j] = 0.0
            h[j] = unasked
        # The residuals of the rows that span the level follow from the others', to more digits
        # than the rows' values have: they balance them.
        r = 0 if work.turned[k] else first[k + 1] - top
        for i in range(hi - 1, lo - 1, -1):
            push = work.wa[i]
            size = SMEAR * abs(push) + work.dim[i]
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
            if length[i] > 0.0:
                doubt[rows[i], k] += unasked / length[i]
            rounding = SMEAR * length[i] * abs(push)
            for j in range(top):
                if W[i, j] != 0.0:
                    g[j] += W[i, j] * push
                    h[j] += abs(W[i, j]) * size + rounding
    for l in range(k - 1, -1, -1):
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
                    s += T[a + j, i] * z[j]
                    size += abs(T[a + j, i]) * y[j]
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


@njit(cache=True, error_model="numpy", forceinline=True)
def _judge(own, side, w, room, push, doubt, scale):
    """Whether a column shows that an active row holds x back: 1 yes, −1 it pushes well, 0 neither.

    A row that holds x from the wrong side would, let go, be met and let a level gain. `own`:
    whether the column is of the row's own level; if not, push and doubt are in units of the row.
    """
    if own and abs(w) > room:
        return 1 if w * side < 0.0 else -1  # that it cannot be met decides
    none = doubt if own else max(min(SMEAR * scale, doubt), SURE * doubt)
    if push * side > none:
        return -1
    return 1 if push * side < -none else 0


@njit(cache=True, error_model="numpy", forceinline=True)
def _broken(flat, lower, upper, act, row_norm, x, start, end, work):
    """Mark the side on which x breaks each free row before `end`; count, find the first on the way.

    Returns the count, that row (−1: none), and how far from `start` to x it lets one go, 0 to 1.
    """
    slack, side = work.slack, work.side
    n = len(x)
    count = 0
    first = -1
    way = 1.0
    for i in range(end):
        side[i] = 0
        if act[i] != 0 or row_norm[i] == 0.0:
            continue
        goal = _dot(flat, i * n, x, 0, n)
        if goal > upper[i] + slack[i] + FEASIBLE * abs(upper[i]):
            bound, side[i] = upper[i], 1
        elif goal < lower[i] - slack[i] - FEASIBLE * abs(lower[i]):
            bound, side[i] = lower[i], -1
        else:
            continue
        count += 1
        here = _dot(flat, i * n, start, 0, n)
        ratio = max(0.0, (bound - here) / (goal - here)) if goal != here else 0.0
        if ratio < way or first < 0:
            way, first = ratio, i
    return count, first, way


@njit(cache=True, error_model="numpy", forceinline=True)
def _unwilling(off, levels, act, frobenius, row_norm, length, kept, single, late, floor, work):
    """Mark the active rows that hold x back although a level would gain by letting go.

    Returns how many, and the worst of those that the first such level names (−1: none), or where it
    is `late` just the first. Where rows move `single`, the levels below are left out.
    """
    count = 0
    worst = -1
    w, lam, doubt, wrong = work.w, work.lam, work.doubt, work.wrong
    _weigh(levels, work)
    for i in range(off[levels]):  # 2: no column has decided on it yet
        wrong[i] = 2 if (act[i] == 1 or act[i] == -1) and not kept[i] else 0
    k = 0
    while k <= levels and not (single and worst >= 0):
        _column(k, levels, floor, work)
        scale = length
        if k < levels:
            scale = frobenius[k] * np.sqrt(_dot(w, off[k], w, off[k], off[k + 1] - off[k]))
        named = worst >= 0
        most = 0.0
        for level in range(min(k + 1, levels)):
            for i in range(off[level], off[level + 1]):
                if wrong[i] != 2:
                    continue
                room = work.slack[i] + FEASIBLE * abs(work.target[i])
                unit = row_norm[i]
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
        k += 1
    return count, worst


@njit(cache=True, error_model="numpy")
def _search(A, lower, upper, off, act, frobenius, row_norm, floor, first, blocks, most, budget):
    """Find the active set of the lexicographic optimum, starting from `act` (changed in place).

    See `search`. Returns x (n,), the multipliers (M, p + 1) explained at `_column`, rank (p,), the
    number of steps and the multiply-adds that they took.
    """
    M, n = A.shape
    p = len(off) - 1
    work = _work(M, n, p)
    only = _only_entries(A)
    flat = A.ravel()
    side, wrong = work.side, work.wrong
    x = np.zeros(n)
    start = np.zeros(n)  # the point that the steps of one row have reached
    settled_act = act.copy()  # where the levels before were settled
    settled_x = x.copy()
    kept = np.zeros(M, np.bool_)  # rows that hold x although their multipliers seem to say no
    last = -1  # row and side let go in the step before
    last_side = 0
    if blocks == 0:
        for i in range(M):
            if act[i] != 2:
                act[i] = 1 if upper[i] < 0.0 else (-1 if lower[i] > 0.0 else 0)
    levels = first  # taken in
    reduced = -1  # of them; −1: none, and the active set is new
    o = 0
    single = blocks == 0
    fewest = M + 1
    returns = -1  # the step that goes back to where the levels before were settled,
    begun = 0  # and the one at which these levels began
    spent = 0  # multiply-adds,
    alone = 0  # and those before rows moved one at a time
    step = -1
    while True:
        step += 1
        last_step = spent >= budget or step >= most  # what is found there is returned as it is
        if last_step:
            levels = p
        if reduced < 0:
            reduced = _begin(A, lower, upper, off, act, only, row_norm, floor, work)
            o = work.first[reduced]
        levels = max(levels, reduced)
        end = off[levels]
        spent += OVERHEAD + end * n
        spent += _reduce(A, off, reduced, levels, o, frobenius, floor, work, x)
        reduced = levels
        length = np.sqrt(_dot(x, 0, x, 0, n))
        for k in range(levels):
            for i in range(off[k], off[k + 1]):
                work.slack[i] = (FEASIBLE * row_norm[i] + floor[k]) * length
        broken, block, alpha = _broken(flat, lower, upper, act, row_norm, x, start, end, work)
        unwilling = 0
        drop = -1
        if not single or block < 0 or last_step:
            late = 2 * (spent - alone) > budget  # Bland: the first one, so that it ends
            _complete(levels, o, work)
            spent += work.start[levels] * n * (levels + 1)
            unwilling, drop = _unwilling(
                off,
                levels,
                act,
                frobenius,
                row_norm,
                length,
                kept,
                single and not last_step,
                late,
                floor,
                work,
            )
        if last_step:
            break
        count = broken + unwilling
        if count == 0:
            if levels == p:
                break
            levels += 1
            start[:] = x
            settled_act[:] = act
            settled_x[:] = x
            returns = -1
            single = blocks == 0
            fewest = M + 1
            begun = step + 1
            kept[:] = False
            last = -1
            continue
        reduced = -1
        if not single:
            if count < fewest and step + 1 < begun + blocks:
                fewest = count
                for i in range(end):
                    if wrong[i] == 1:
                        act[i] = 0
                    elif side[i] != 0:
                        act[i] = side[i]
                continue
            single = True
            alone = spent
            returns = step + n if begun > 0 else -1
        if step == returns:
            act[:] = settled_act
            start[:] = settled_x
            kept[:] = False
            last = -1
            continue
        if block >= 0:
            for j in range(n):
                start[j] += alpha * (x[j] - start[j])
            act[block] = side[block]
            # A row let go for good reason cannot be the next one met: its sign was rounding.
            if block == last and side[block] == last_side:
                kept[block] = True
            elif alpha > 0.0:
                kept[:] = False
            last = -1
        else:
            start[:] = x
            last, last_side = drop, act[drop]
            act[drop] = 0
    return x, work.lam, work.first[1:] - work.first[:-1], step, spent


def search(
    rows: Stacked, act: np.ndarray, first: int, blocks: int, most: int, budget: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int, int]:
    """Find the active set of the lexicographic optimum, starting from `act` (changed in place).

    Begins with the first `first` levels and takes in the next where these are settled. At each:
    up to `blocks` rounds that take in every row x breaks and let go every row of wrong sign at
    once, for as long as there are ever fewer of them. Then steps that move one row each, as the
    primal method does that improves the levels in their order at every step (LexLSI, Dimitrov,
    Sherikov & Wieber 2015): from there, where few rows are wrong, and when that has taken n steps
    from where the levels before were settled, which is surer. With blocks = 0 it is that method
    from x = 0. Ends after `most` steps, or when `budget` multiply-adds, about, are spent; whether
    it found the optimum is for the certificate to say.

    Returns x (n,), the multipliers (M, p + 1) that should prove it, rank (p,), the steps made, and
    the multiply-adds spent.
    """
    if act.shape != rows.lower.shape or act.dtype != np.int8:
        raise InputError(
            f"an active set must be {rows.lower.shape} int8; got {act.shape} {act.dtype}"
        )
    return _search(
        rows.A,
        rows.lower,
        rows.upper,
        rows.offsets,
        act,
        rows.frobenius,
        rows.row_norm,
        rows.floor,
        first,
        blocks,
        most,
        budget,
    )
