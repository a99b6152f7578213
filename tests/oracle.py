"""The lexicographic least-squares optimum, computed slowly and in many digits.

A reference for the solvers under test, which shares neither code nor method with them. Level k
minimises ‖w_k‖², w_k = A_k x − clip(A_k x, lower, upper), while every level above keeps its
optimal w_j; at the end x is the shortest of the points that remain.

Method
    One level is a least-squares problem with linear inequalities. It is turned into Lawson and
    Hanson's *least distance programming*: the shortest vector z = (ϱ y, v) with

        lower ≤ A (x + Z y) + v ≤ upper        the rows of this level, missed by v = −w
        lower ≤ G (x + Z y) ≤ upper            the rows that levels above have satisfied

    where Z spans the directions that the levels above leave free, and that is a non-negative
    least-squares problem, solved by Lawson and Hanson's finite algorithm. Everything runs in
    decimal arithmetic of `DIGITS` digits with ϱ = 10^−27: ϱ² = 10^−54 stands for "zero, but
    strictly convex", and badly scaled rows, degenerate vertices and nearly parallel levels are as
    harmless as they are on paper. The shortest x is one more level, x = 0.

Tolerance
    The arithmetic needs none, but data may be rounded: rows meant to be dependent are dependent
    to 1e-16 only. `tol` says how much of a row, relative to the row, is such dust: rows this close
    to parallel are parallel, a row this close to the span of fixed rows is fixed, a miss this small
    is none. Dependent triples of *inequality* rows, all tight at once, are not recognised through
    rounding; they have to be dependent exactly, as in `problems.general`.
"""

from decimal import Decimal, localcontext
from operator import mul

import numpy as np

DIGITS = 180
RHO = Decimal(10) ** -27
FLOOR = Decimal(10) ** -10  # of the farthest bound broken by x = 0: where all terms of a row vanish
SLACK = RHO * Decimal(10) ** -30  # a constraint is violated by more than this over ϱ, or not at all


class OracleError(RuntimeError):
    """The computation contradicted itself; its answer must not be used."""


def lexicographic_optimum(levels, tol=1e-13):
    """Return x and the misses [w_1, …, w_p] of levels that have .A, .lower and .upper.

    Rows are missed by w = A x − clip(A x, lower, upper): negative below, positive above.
    """
    with localcontext() as context:
        context.prec = DIGITS
        return _cascade(levels, Decimal(tol))


def _cascade(levels, tol):
    n = np.shape(levels[0].A)[1]
    exact = [_Rows(_decimal(level.A), level.lower, level.upper) for level in levels]
    reach = max((_reach(rows) for rows in exact), default=Decimal(0))
    for rows in exact:
        rows.floor = reach * FLOOR
    snapped = _snap_parallel_rows(exact, tol)
    shortest = _Rows(_decimal(np.eye(n)), np.zeros(n), np.zeros(n))

    x = _decimal(np.zeros(n))
    free = _decimal(np.eye(n))  # columns: directions that no level above has fixed
    inside = []  # (unit row, lower, upper) that levels above have satisfied
    for rows in [*snapped, shortest]:
        if free.shape[1] == 0:
            break
        x, free, inside = _descend(rows, x, free, inside, tol)
    x = np.where(abs(x) > tol * FLOOR * reach, x, Decimal(0))
    misses = [_missed(rows, x, tol).astype(float) for rows in exact]
    return x.astype(float), misses


class _Rows:
    """lower ≤ A x ≤ upper with decimal A; bounds are decimals too, or None where infinite."""

    def __init__(self, A, lower, upper):
        self.A = A
        self.lower = [Decimal(float(b)) if np.isfinite(b) else None for b in lower]
        self.upper = [Decimal(float(b)) if np.isfinite(b) else None for b in upper]
        self.norm = [_norm(a) for a in A]
        self.floor = Decimal(0)  # lengths of x that are zero, relative to `tol`


def _reach(rows):
    """The largest distance from the origin to a bound that the origin breaks."""
    below = [b for b in zip(rows.lower, rows.norm, strict=True) if b[0] is not None and b[0] > 0]
    above = [b for b in zip(rows.upper, rows.norm, strict=True) if b[0] is not None and b[0] < 0]
    return max((abs(b) / norm for b, norm in below + above if norm), default=Decimal(0))


def _decimal(values):
    values = np.asarray(values, dtype=float)
    out = np.empty(values.shape, dtype=object)
    out.flat = [Decimal(float(v)) for v in values.flat]
    return out


def _norm(vector):
    return sum((v * v for v in vector), Decimal(0)).sqrt()


def _snap_parallel_rows(levels, tol):
    """Give all rows that are parallel up to rounding exactly the same direction."""
    directions, snapped = [], []
    for level in levels:
        A = level.A.copy()
        for i, norm in enumerate(level.norm):
            if norm == 0:
                continue
            unit = A[i] / norm
            unit = unit * (1 if unit[np.argmax(abs(unit))] > 0 else -1)
            flat = unit.astype(float)
            for known, exact in directions:
                if np.max(np.abs(flat - known)) < float(tol):
                    A[i] = exact * (A[i] @ exact)
                    break
            else:
                directions.append((flat, unit))
        rows = _Rows(A, [], [])
        rows.lower, rows.upper, rows.floor = level.lower, level.upper, level.floor
        snapped.append(rows)
    return snapped


def _missed(rows, x, tol):
    """w = A x − clip(A x), with what may be rounding of the data set to zero."""
    w = np.full(len(rows.A), Decimal(0), dtype=object)
    for i, value in enumerate(rows.A @ x if len(rows.A) else []):
        for bound, side in ((rows.lower[i], -1), (rows.upper[i], 1)):
            if bound is not None and (value - bound) * side > tol * _dust(rows, i, x):
                w[i] = value - bound
    return w


def _dust(rows, i, x):
    """The size of the terms that make up row i: rounding is measured against it."""
    bounds = [abs(b) for b in (rows.lower[i], rows.upper[i]) if b is not None]
    terms = sum(abs(rows.A[i] * x), Decimal(0)) + max(bounds, default=Decimal(0))
    return terms + rows.norm[i] * rows.floor


def _descend(rows, x, free, inside, tol):
    """Optimise one level; return the new x, the directions left, the rows to keep inside."""
    soft = _without_rounding(rows.A @ free, rows.norm, tol) if len(rows.A) else rows.A @ free
    hard = [(g, lo, up, g @ free) for g, lo, up in inside]
    hard = [(g, lo, up, h) for g, lo, up, h in hard if _norm(h) > tol]

    y, pull = _least_distance(rows, rows.A @ x, soft, hard, x)
    scale = sum((_norm(b) * _dust(rows, i, x) for i, b in enumerate(soft)), Decimal(0))
    x = x + free @ y
    scale += sum((_norm(b) * _dust(rows, i, x) for i, b in enumerate(soft)), Decimal(0))
    w = _missed(rows, x, tol)

    # A kept row that is paid for (positive multiplier) stays tight in every optimum.
    fixed = [g for (g, _, _, h), p in zip(hard, pull, strict=True) if p * _norm(h) > tol * scale]
    inside = [(g, lo, up) for (g, lo, up, _) in hard]
    for i, norm in enumerate(rows.norm):
        lo, up = rows.lower[i], rows.upper[i]
        if norm == 0 or (lo is None and up is None):
            continue
        unit = rows.A[i] / norm
        if w[i] != 0 or lo == up:
            fixed.append(unit)
        else:
            lo, up = (None if b is None else b / norm for b in (lo, up))
            inside.append((unit, lo, up))
    for unit in fixed:
        free = _fix(unit, free, tol)
    return x, free, inside


def _without_rounding(B, norms, tol):
    """Project the rows of B onto the span of those that stand out from rounding.

    Pivoted Gram–Schmidt on rows of unit length (before they were restricted to free directions).
    """
    unit = np.array([b / s if s else b for b, s in zip(B, norms, strict=True)], dtype=object)
    rest, basis = unit.copy(), []
    while len(basis) < B.shape[1]:
        sizes = [_norm(r) for r in rest]
        pivot = max(range(len(rest)), key=sizes.__getitem__)
        if sizes[pivot] <= tol:
            break
        q = rest[pivot] / sizes[pivot]
        basis.append(q)
        rest = rest - np.outer(rest @ q, q)
    if len(basis) == B.shape[1]:
        for i, r in enumerate(unit):
            if _norm(r) <= tol:
                B[i] = B[i] * 0
        return B
    if not basis:
        return B * 0
    Q = np.array(basis, dtype=object)
    return (B @ Q.T) @ Q


def _fix(unit, free, tol):
    """Remove from the free directions the one that moves along a unit row (Householder)."""
    t = unit @ free if free.shape[1] else free[0]
    length = _norm(t)
    if length <= tol:
        return free
    u = t.copy()
    u[0] += length if t[0] >= 0 else -length
    reflected = free - np.outer(free @ u, u) * (2 / (u @ u))
    return reflected[:, 1:]


def _least_distance(rows, value, soft, hard, x):
    """Step y of the shortest z = (ϱ y, v), and the multiplier of every kept row.

    Constraint j reads K[j, :-1] · z ≥ K[j, -1], both sides multiplied by ϱ.
    """
    m, k = soft.shape
    # The scale of a level has no influence on its optimum: make its longest row one.
    size = max((_norm(b) for b in soft), default=Decimal(0)) or Decimal(1)
    zero = _decimal(np.zeros(m))
    K, owner = [], []
    for j, (g, lo, up, h) in enumerate(hard):
        at = g @ x
        for bound, side in ((lo, 1), (up, -1)):
            if bound is not None:
                room = min((bound - at) * side, Decimal(0))
                K.append(np.concatenate([h * side, zero, [RHO * room]]))
                owner.append(j)
    for i in range(m):
        if not any(soft[i]):
            continue
        miss = zero.copy()
        miss[i] = RHO
        for bound, side in ((rows.lower[i], 1), (rows.upper[i], -1)):
            if bound is not None:
                gap = (bound - value[i]) / size
                K.append(np.concatenate([soft[i] / size, miss, [RHO * gap]]) * side)
                owner.append(None)
    pull = [Decimal(0)] * len(hard)
    if not K:
        return _decimal(np.zeros(k)), pull
    K = np.array(K, dtype=object)
    u = _nonnegative_least_squares(K)
    r = u @ K
    left = 1 - r[-1]
    if left <= 0:
        raise OracleError("the rows kept from the levels above contradict one another")
    z = r[:-1] / left
    if min(K[:, :-1] @ z - K[:, -1]) < -10 * SLACK / left:
        raise OracleError("the least-distance step leaves the rows it has to keep")
    for j, uj in zip(owner, u, strict=True):
        if j is not None:
            pull[j] += uj * RHO / left * size * size
    return z[:k] / RHO, pull


def _nonnegative_least_squares(K):
    """u ≥ 0 that minimises ‖Kᵀ u − e_last‖, by Lawson and Hanson's algorithm."""
    count = len(K)
    norms = [_norm(row) for row in K]
    u = _decimal(np.zeros(count))
    gram, passive = {}, _Passive()
    for _ in range(20 * count + 20):
        gradient = K[:, -1].copy()
        for j in passive.members:
            gradient -= gram[j] * u[j]
        best = max(range(count), key=lambda j: -1 if j in gram else gradient[j] / norms[j])
        if best in gram or gradient[best] <= SLACK * norms[best]:
            return u
        gram[best] = K @ K[best]
        passive.add(best, gram[best], K[best, -1])
        while min(s := passive.solve()) <= 0:
            steps = [
                u[j] / (u[j] - sj) if sj <= 0 else Decimal(2)
                for j, sj in zip(passive.members, s, strict=True)
            ]
            for j, sj in zip(passive.members, s, strict=True):
                u[j] += min(steps) * (sj - u[j])
            gone = [j for j, t in zip(passive.members, steps, strict=True) if t == min(steps)]
            kept = [j for j in passive.members if j not in gone]
            passive = _Passive()
            for j in kept:
                passive.add(j, gram[j], K[j, -1])
            for j in gone:
                u[j] = Decimal(0)
                del gram[j]
        u[passive.members] = s
    raise OracleError("non-negative least squares did not end")


class _Passive:
    """The positive unknowns, with a growing factor L D Lᵀ of their Gram matrix."""

    def __init__(self):
        self.members, self.rows, self.pivots, self.half = [], [], [], []

    def add(self, j, gram, target):
        """Take in unknown j, given column j of the Gram matrix and its right-hand side."""
        scaled = []  # D l, from L (D l) = g
        for row, i in zip(self.rows, self.members, strict=True):
            scaled.append(gram[i] - sum(map(mul, row, scaled), Decimal(0)))
        row = [v / d for v, d in zip(scaled, self.pivots, strict=True)]
        pivot = gram[j] - sum(map(mul, row, scaled), Decimal(0))
        if pivot <= 0:
            raise OracleError("too few digits for these rows")
        self.half.append(target - sum(map(mul, row, self.half), Decimal(0)))
        self.rows.append(row)
        self.pivots.append(pivot)
        self.members.append(j)

    def solve(self):
        """The unconstrained minimum over the members."""
        s = np.array([h / d for h, d in zip(self.half, self.pivots, strict=True)], dtype=object)
        for i in range(len(s) - 1, 0, -1):
            s[:i] -= np.array(self.rows[i], dtype=object) * s[i]
        return s
