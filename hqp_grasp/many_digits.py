"""The one-row-at-a-time method in decimal arithmetic: for hierarchies beyond double precision.

Rows of one level whose sizes differ by ten orders of magnitude or more leave residuals whose
rounding hides the forces of the small rows; no tolerance tells their signs. The same method as in
`active_set`, with enough digits, needs none. It is slow, a second for larger problems, and
asked last: some ten in 100,000 problems of `benchmarks/fuzz.py` get here.
"""

from __future__ import annotations

from decimal import Decimal, localcontext

import numpy as np

from hqp_grasp.certificate import DIGITS, EPS, decimals

DUST = Decimal(EPS)  # [–] of a row, for each it is reduced by: A is not known to more
NONE = Decimal(10) ** -40  # [–] of the terms of a sum: what is left of them, where they cancel


def _solve(G: np.ndarray, b: np.ndarray) -> np.ndarray:
    """G⁻¹ b for a symmetric positive definite G, by elimination."""
    G, b = G.copy(), b.copy()
    r = len(b)
    for j in range(r):
        for i in range(j + 1, r):
            t = G[i, j] / G[j, j]
            G[i, j:] = G[i, j:] - t * G[j, j:]
            b[i] -= t * b[j]
    for j in range(r - 1, -1, -1):
        b[j] = (b[j] - (G[j, j + 1 :] @ b[j + 1 :] if j + 1 < r else 0)) / G[j, j]
    return b


class _Levels:
    """Lexicographic least squares of the active rows; lam and doubt as in `active_set._column`."""

    def __init__(self, A: np.ndarray, target: np.ndarray, off: np.ndarray, act: np.ndarray) -> None:
        M, n = A.shape
        p = len(off) - 1
        groups = [off[k] + np.flatnonzero(act[off[k] : off[k + 1]]) for k in range(p)]
        rest = A.copy()
        size = np.array([(a @ a).sqrt() for a in A], dtype=object)
        basis = np.empty((n, n), dtype=object)  # orthonormal rows
        first = [0]
        asked = [abs(target[i]) / size[i] for i in np.concatenate(groups) if size[i]]
        self.reach = sum(asked, Decimal(0))  # no sum of terms counts that is tiny next to this
        self.w = np.full(M, Decimal(0), dtype=object)
        xq = np.empty(0, dtype=object)
        lower = []  # L_k, all coordinates so far
        for rows in groups:
            c = first[-1]
            r = c
            while len(rows) and r < n:
                left = np.array([rest[i] @ rest[i] for i in rows], dtype=object)
                fresh = [
                    s if s > (DUST * r * size[i]) ** 2 else Decimal(0)
                    for s, i in zip(left, rows, strict=True)
                ]
                pick = max(range(len(rows)), key=fresh.__getitem__)
                if not fresh[pick]:
                    break
                q = rest[rows[pick]]
                for _ in range(2):
                    if r:
                        q = q - (basis[:r] @ q) @ basis[:r]
                    q = q / (q @ q).sqrt()
                basis[r] = q
                behind = np.concatenate([rows, *groups[len(first) :]])
                rest[behind] = rest[behind] - np.outer(rest[behind] @ q, q)
                r += 1
            L = A[rows] @ basis[:r].T if len(rows) and r else np.empty((len(rows), r), dtype=object)
            miss = target[rows] - (L[:, :c] @ xq if c and len(rows) else 0)
            if r > c:
                own = L[:, c:]
                y = _solve(own.T @ own, own.T @ miss)
                miss = miss - own @ y
                xq = np.concatenate([xq, y])
            for i, m in zip(rows, miss, strict=True):
                self.w[i] = -m if abs(m) > NONE * size[i] * self.reach else Decimal(0)
            lower.append(L)
            first.append(r)
        c = first[-1]
        self.x = xq @ basis[:c] if c else np.full(n, Decimal(0), dtype=object)
        self.rank = np.diff(first)
        self.lam = np.full((M, p + 1), Decimal(0), dtype=object)
        self.doubt = np.full((M, p + 1), Decimal(0), dtype=object)
        for k in range(1, p + 1):
            top = first[k]
            if not top:
                continue
            if k < p:
                if not self.w[groups[k]].any():
                    continue
                g = self.w[groups[k]] @ lower[k][:, :top]
                noise = NONE * (abs(self.w[groups[k]]) @ size[groups[k]])
            else:
                g, noise = xq.copy(), NONE * self.reach
            h = np.full(top, noise, dtype=object)
            for j in range(k - 1, -1, -1):
                a, b = first[j], first[j + 1]
                if a == b:
                    continue
                own = lower[j][:, a:b]
                gram = own.T @ own
                push = own @ _solve(gram, -g[a:b])
                inverse = np.array([_solve(gram, e) for e in decimals(np.eye(b - a))])
                doubt = abs(own @ inverse) @ h[a:b]
                self.lam[groups[j], k], self.doubt[groups[j], k] = push, doubt
                if a:
                    g[:a] = g[:a] + push @ lower[j][:, :a]
                    h[:a] = h[:a] + (doubt + NONE * abs(push)) @ size[groups[j]]


def search(
    A: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    off: np.ndarray,
    act: np.ndarray,
    pivots: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the active set (`act`, changed in place) in at most `pivots` steps; x, lam, rank."""
    with localcontext() as context:
        context.prec = DIGITS
        M = len(A)
        own = np.repeat(np.arange(len(off) - 1), np.diff(off))
        exact = decimals(A)
        size = np.array([(a @ a).sqrt() for a in exact], dtype=object)
        low = [Decimal(float(b)) for b in lower]  # decimals know infinity
        high = [Decimal(float(b)) for b in upper]
        free = act != 2
        act[free & (upper < 0.0)] = 1
        act[free & (lower > 0.0)] = -1
        here = np.full(M, Decimal(0), dtype=object)  # A x at the point that is reached
        for step in range(pivots):
            target = np.array([high[i] if act[i] > 0 else low[i] for i in range(M)], dtype=object)
            found = _Levels(exact, target, off, act)
            goal = exact @ found.x
            block, side, alpha = -1, 0, Decimal(1)
            for i in np.flatnonzero(act == 0).tolist():
                for bound, direction in ((high[i], 1), (low[i], -1)):
                    if bound.is_infinite():
                        continue
                    if (goal[i] - bound) * direction > NONE * size[i] * found.reach:
                        way = goal[i] - here[i]
                        t = max(Decimal(0), (bound - here[i]) / way) if way else Decimal(0)
                        if block < 0 or t < alpha:
                            block, side, alpha = i, direction, t
            if block >= 0:
                here = here + alpha * (goal - here)
                act[block] = side
                continue
            here = goal
            drop, worst = -1, (len(off), Decimal(0))
            for i in np.flatnonzero(np.abs(act) == 1).tolist():
                pushes = [(own[i], found.w[i] * int(act[i]), Decimal(0))]
                for k in range(own[i] + 1, len(off)):
                    pushes.append((k, found.lam[i, k] * int(act[i]), found.doubt[i, k]))
                for k, push, doubt in pushes:
                    if abs(push) > doubt:
                        if push < 0 and (drop < 0 or (k, push * size[i]) < worst):
                            drop, worst = i, (k, push * size[i])
                        break
                if drop >= 0 and 2 * step > pivots:  # Bland: the first one, so that it ends
                    break
            if drop < 0:
                break
            act[drop] = 0
        return found.x.astype(float), found.lam.astype(float), found.rank
