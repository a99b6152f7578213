"""The exact strict hierarchy on a given active set, and the search for the right one.

Everything here is compiled by numba at first use and cached; arrays in, arrays out. The rows of
all levels are stacked; `act` says how each takes part: 2 equality, +1 held at its upper bound,
−1 held at its lower, 0 free.

Each level is reduced in the freedom left by those above: rows are picked by the largest remaining
norm and turned by Householder reflections from the right (Golub & Van Loan, ch. 5), so that
A_k Q = [… L_k 0] with L_k (m, r). Where a pivot comes close to the rank tolerance, a one-sided
Jacobi SVD of L_k decides the rank on singular values, as the convention asks.
"""

from __future__ import annotations

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
SURE = 1e-2  # [–] of what is doubtful about a multiplier; below it, it counts as none in any case


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


@njit(cache=True, error_model="numpy")
def solve_active(A, target, off, act, frobenius, rank_tolerance, dust):
    """Lexicographic least squares of the rows with act ≠ 0, as equalities at `target`.

    Returns x (n,), w (M,) the residuals of the active rows, lam and doubt (M, p + 1), rank (p,).
    Column k of lam holds the multipliers of the rows above for level k's optimality,
    A_kᵀ w_k + Σ_{j<k} A_jᵀ lam_{jk} = 0, and column p those of the minimum norm of x; rows of
    level k hold w_k there, with more digits than w has. `doubt`, of the same shape, is how much
    of lam may be rounding. What is left of a row, after it is reduced by c others, counts as
    nothing below `dust` × c of its length.
    `frobenius` (p,) holds ‖A_k‖_F of the whole levels; rank_tolerance < 0 asks for the default.
    """
    M, n = A.shape
    p = len(off) - 1
    rows = np.empty(M, np.int64)
    start = np.empty(p + 1, np.int64)
    demanding = np.zeros(p, np.bool_)  # levels with equalities
    ma = 0
    for k in range(p):
        start[k] = ma
        for i in range(off[k], off[k + 1]):
            demanding[k] |= act[i] == 2
            if act[i] != 0:
                rows[ma] = i
                ma += 1
    start[p] = ma
    W = np.empty((ma, n))
    length = np.empty(ma)
    for i in range(ma):
        s = 0.0
        for j in range(n):
            W[i, j] = A[rows[i], j]
            s += W[i, j] * W[i, j]
        length[i] = np.sqrt(s)
    H = np.empty((ma, n))  # the reflector made from each picked row,
    beta = np.empty(ma)
    made = np.zeros(p, np.int64)  # and how many each level made
    xq = np.zeros(n)
    wa = np.zeros(ma)
    clean = np.zeros(ma)  # the same, without what is rounding
    dim = np.zeros(ma)  # how much of wa may be rounding
    missed = np.zeros(p, np.bool_)  # levels with a residual that is not
    first = np.zeros(p + 1, np.int64)  # level k owns coordinates first[k]:first[k+1]
    triangular = np.ones(p, np.bool_)
    T = np.zeros((ma, n))  # thin orthogonal factors of the L_k that are not triangular
    R = np.zeros((n, n))  # and their triangular ones
    turn = np.empty((p, n, n))  # the rotations of levels close to losing rank
    turned = np.zeros(p, np.bool_)
    c = 0
    for k in range(p):
        first[k] = c
        lo, hi = start[k], start[k + 1]
        m = hi - lo
        steps = min(m, n - c)
        if steps > 0 and frobenius[k] > 0.0:
            size = max(off[k + 1] - off[k], n)
            if rank_tolerance < 0.0 or not demanding[k]:  # a limit is never truncated
                rough = size * EPS * frobenius[k]
            else:
                rough = rank_tolerance * frobenius[k]
            r = 0
            ambiguous = False
            while r < steps:
                best = 0.0
                pick = lo + r
                for i in range(lo + r, hi):
                    s = 0.0
                    for j in range(c + r, n):
                        s += W[i, j] * W[i, j]
                    gone = dust * (c + r) * length[i]
                    if s <= gone * gone:
                        for j in range(c + r, n):
                            W[i, j] = 0.0
                        continue
                    if s > best:
                        best = s
                        pick = i
                norm = np.sqrt(best)
                if best == 0.0 or norm <= rough / (CLEAR * 10.0):
                    break
                if norm <= rough * CLEAR:
                    ambiguous = True
                if pick != lo + r:
                    rows[pick], rows[lo + r] = rows[lo + r], rows[pick]
                    for j in range(n):
                        W[pick, j], W[lo + r, j] = W[lo + r, j], W[pick, j]
                    length[pick], length[lo + r] = length[lo + r], length[pick]
                d = c + r
                row = lo + r
                alpha = -norm if W[row, d] > 0.0 else norm
                for j in range(d, n):
                    H[row, j] = W[row, j]
                H[row, d] -= alpha
                beta[row] = 1.0 / (norm * abs(H[row, d]))
                for i in range(row + 1, ma):
                    s = 0.0
                    for j in range(d, n):
                        s += W[i, j] * H[row, j]
                    s *= beta[row]
                    for j in range(d, n):
                        W[i, j] -= s * H[row, j]
                W[row, d] = alpha
                for j in range(d + 1, n):
                    W[row, j] = 0.0
                r += 1
            made[k] = r
            if ambiguous:
                tol = rough * spectral_norm(A[off[k] : off[k + 1]]) / frobenius[k]
                V = np.zeros((r, r))
                r = _rotate(W, lo, hi, ma, c, r, tol, V)
                turned[k] = r < made[k]
                for i in range(made[k]):
                    for j in range(made[k]):
                        turn[k, i, j] = V[i, j]
                if turned[k]:
                    for i in range(lo, hi):
                        for j in range(c + r, n):
                            W[i, j] = 0.0
            # Solve L y = rhs in the least-squares sense.
            rhs = np.empty(m)
            for i in range(m):
                s = target[rows[lo + i]]
                for j in range(c):
                    s -= W[lo + i, j] * xq[j]
                rhs[i] = s
            if r == m and not turned[k]:
                for i in range(m):
                    s = rhs[i]
                    for j in range(i):
                        s -= W[lo + i, c + j] * xq[c + j]
                    xq[c + i] = s / W[lo + i, c + i]
            else:
                triangular[k] = False
                for j in range(r):  # Gram–Schmidt, twice is enough
                    for i in range(m):
                        T[lo + i, c + j] = W[lo + i, c + j]
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
                y = np.empty(r)
                for _ in range(2):  # the second pass removes what rounding left
                    for j in range(r):
                        s = 0.0
                        for i in range(m):
                            s += T[lo + i, c + j] * rhs[i]
                        y[j] = s
                        for i in range(m):
                            rhs[i] -= s * T[lo + i, c + j]
                    for j in range(r - 1, -1, -1):
                        s = y[j]
                        for l in range(j + 1, r):
                            s -= R[c + j, c + l] * y[l]
                        y[j] = s / R[c + j, c + j]
                        xq[c + j] += y[j]
                for i in range(m):
                    wa[lo + i] = -rhs[i]
            c += r
        else:
            for i in range(lo, hi):
                s = target[rows[i]]
                for j in range(c):
                    s -= W[i, j] * xq[j]
                wa[i] = -s
            triangular[k] = m == 0
        first[k + 1] = c
        for i in range(lo, hi):  # a residual of the size of rounding is none
            size = abs(target[rows[i]])
            for j in range(c):
                size += abs(W[i, j] * xq[j])
            dim[i] = LOOSE * size
            missed[k] |= abs(wa[i]) > ROUNDING * size
            clean[i] = wa[i] if abs(wa[i]) > ROUNDING * size else 0.0
    x = xq.copy()
    for k in range(p - 1, -1, -1):  # x = Q xq, the factors of Q from the last to the first
        a, r = first[k], made[k]
        if turned[k]:
            part = x[a : a + r].copy()
            for i in range(r):
                s = 0.0
                for j in range(r):
                    s += turn[k, i, j] * part[j]
                x[a + i] = s
        for l in range(r - 1, -1, -1):
            row = start[k] + l
            s = 0.0
            for j in range(a + l, n):
                s += H[row, j] * x[j]
            s *= beta[row]
            for j in range(a + l, n):
                x[j] -= s * H[row, j]
    w = np.zeros(M)
    for i in range(ma):
        w[rows[i]] = clean[i]
    rank = first[1:] - first[:-1]
    lam = np.zeros((M, p + 1))
    doubt = np.zeros((M, p + 1))
    g = np.empty(n)
    h = np.empty(n)  # what is doubtful of g
    for k in range(p + 1):
        if k < p:
            lo, hi = start[k], start[k + 1]
            top = first[k]
            if not missed[k]:
                continue
            for j in range(top):
                g[j] = 0.0
                h[j] = 0.0
            # The residuals of the rows that span the level follow from the others', to more
            # digits than the rows' values have: they balance them.
            r = 0 if turned[k] else first[k + 1] - top
            for i in range(hi - 1, lo - 1, -1):
                push = wa[i]
                size = SIGNED * abs(push) + dim[i]
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
                rough = SMEAR * length[i] * abs(push)
                for j in range(top):
                    if W[i, j] != 0.0:
                        g[j] += W[i, j] * push
                        h[j] += abs(W[i, j]) * size + rough
        else:
            top = c
            for j in range(c):
                g[j] = xq[j]
                h[j] = SIGNED * abs(xq[j])
        for l in range(min(k, p) - 1, -1, -1):
            lo, hi = start[l], start[l + 1]
            a, r = first[l], first[l + 1] - first[l]
            if r == 0:
                continue
            if triangular[l]:  # Lᵀ λ = −g
                for i in range(r - 1, -1, -1):
                    s = -g[a + i]
                    size = h[a + i]
                    for j in range(i + 1, r):
                        s -= W[lo + j, a + i] * lam[rows[lo + j], k]
                        size += abs(W[lo + j, a + i]) * doubt[rows[lo + j], k]
                    lam[rows[lo + i], k] = s / W[lo + i, a + i]
                    doubt[rows[lo + i], k] = size / abs(W[lo + i, a + i])
            else:  # λ = −T R⁻ᵀ g, the least-norm one
                z = np.empty(r)
                y = np.empty(r)
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
                    rough = SMEAR * length[i] * abs(s)
                    for j in range(a):
                        if W[i, j] != 0.0:
                            g[j] += W[i, j] * s
                            h[j] += abs(W[i, j]) * size + rough
    return x, w, lam, doubt, rank


@njit(cache=True, error_model="numpy")
def equalities(lower, upper):
    """The active set of the equalities alone, (M,) int8."""
    act = np.zeros(len(lower), np.int8)
    for i in range(len(lower)):
        if lower[i] == upper[i]:
            act[i] = 2
    return act


@njit(cache=True, error_model="numpy")
def _wrong_sign(i, k_own, side, w, lam, doubt, room, row_norm, scale):
    """Level at which active row i holds x from the wrong side (−1: none), and by how much."""
    if abs(w) > room:
        if w * side > 0.0:
            return -1, 0.0  # the row cannot be met: it is held whatever its sign below
        return k_own, abs(w)
    push = lam[i, k_own] * side
    if abs(push) > doubt[i, k_own]:
        return (-1, 0.0) if push > 0.0 else (k_own, -push)
    for k in range(k_own + 1, lam.shape[1]):
        push = lam[i, k] * side * row_norm
        none = doubt[i, k] * row_norm
        none = max(min(scale[k], none), SURE * none)
        if push > none:
            return -1, 0.0
        if push < -none:
            return k, -push
    return -1, 0.0


@njit(cache=True, error_model="numpy")
def search(A, lower, upper, off, act, frobenius, row_norm, rank_tolerance, dust, blocks, pivots):
    """Find the active set of the lexicographic optimum, starting from `act` (changed in place).

    First up to `blocks` rounds that take in every violated row and let go every row of wrong sign
    at once; they are fast and need not end. Then up to `pivots` steps of the primal method that
    moves one row at a time and improves the levels in their order at every step (as LexLSI,
    Dimitrov, Sherikov & Wieber 2015). Returns x, lam and rank as `solve_active` does; whether the
    search ended or ran out of steps is for the certificate to find out.
    """
    M, n = A.shape
    p = len(off) - 1
    target = np.zeros(M)
    slack = np.empty(M)
    scale = np.empty(p + 1)
    own = np.empty(M, np.int64)
    for k in range(p):
        for i in range(off[k], off[k + 1]):
            own[i] = k
    start = np.zeros(n)  # the point the one-row-at-a-time method has reached
    kept = np.zeros(M, np.bool_)  # rows that hold x although their multipliers seem to say no
    last = -1  # row and side let go in the step before
    last_side = 0
    for step in range(blocks + pivots):
        single = step >= blocks
        if step == blocks:  # begin again, from x = 0
            for i in range(M):
                if act[i] != 2:
                    act[i] = 1 if upper[i] < 0.0 else (-1 if lower[i] > 0.0 else 0)
        for i in range(M):
            if act[i] != 0:
                target[i] = upper[i] if act[i] > 0 else lower[i]
        x, w, lam, doubt, rank = solve_active(A, target, off, act, frobenius, rank_tolerance, dust)
        length = 0.0
        for j in range(n):
            length += x[j] * x[j]
        length = np.sqrt(length)
        for k in range(p):  # where x vanishes by cancellation, what the levels ask of it counts
            s = 0.0
            for i in range(off[k], off[k + 1]):
                if act[i] != 0:
                    s += target[i] * target[i]
            if frobenius[k] > 0.0:
                length = max(length, VANISHED * np.sqrt(s) / frobenius[k])
        for i in range(M):
            slack[i] = FEASIBLE * row_norm[i] * length
        # Rows that x breaks.
        changed = False
        alpha = 1.0
        block = -1
        side = 0
        for i in range(M):
            if act[i] != 0:
                continue
            goal = 0.0
            for j in range(n):
                goal += A[i, j] * x[j]
            if goal > upper[i] + slack[i] + FEASIBLE * abs(upper[i]):
                bound, direction = upper[i], 1
            elif goal < lower[i] - slack[i] - FEASIBLE * abs(lower[i]):
                bound, direction = lower[i], -1
            else:
                continue
            changed = True
            if not single:
                act[i] = 3 * direction  # marked, so that its sign is not judged in this round
                continue
            here = 0.0
            for j in range(n):
                here += A[i, j] * start[j]
            ratio = max(0.0, (bound - here) / (goal - here)) if goal != here else 0.0
            if ratio < alpha or block < 0:
                alpha, block, side = ratio, i, direction
        if single and block >= 0:
            for j in range(n):
                start[j] += alpha * (x[j] - start[j])
            act[block] = side
            # A row let go for good reason cannot be the next one met: its sign was rounding.
            if block == last and side == last_side:
                kept[block] = True
            elif alpha > STILL:
                kept[:] = False
            last = -1
            continue
        last = -1
        start[:] = x
        # Rows that hold x back although a level would gain by letting go.
        for k in range(p):
            s = 0.0
            for i in range(off[k], off[k + 1]):
                s += w[i] * w[i]
            scale[k] = SIGNED * frobenius[k] * np.sqrt(s)
        scale[p] = SIGNED * length
        drop = -1
        level = p + 1
        worst = 0.0
        for i in range(M):
            if act[i] == 3 or act[i] == -3:
                act[i] //= 3
                continue
            if act[i] == 0 or act[i] == 2 or kept[i]:
                continue
            room = slack[i] + FEASIBLE * abs(target[i])
            k, push = _wrong_sign(i, own[i], act[i], w[i], lam, doubt, room, row_norm[i], scale)
            if k < 0:
                continue
            changed = True
            if not single:
                act[i] = 0
            elif 2 * (step - blocks) > pivots:  # Bland: the first one, so that it ends
                drop = i
                break
            elif k < level or (k == level and push > worst):
                drop, level, worst = i, k, push
        if drop >= 0:
            last, last_side = drop, act[drop]
            act[drop] = 0
        if not changed:
            break
    return x, lam, rank
