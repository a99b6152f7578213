"""The hierarchy level by level in decimal arithmetic: for what is beyond double precision.

Rows of one level whose sizes differ by ten orders of magnitude or more leave residuals whose
rounding hides the forces of the small rows; no tolerance tells their signs. With enough digits none
is needed: each level is a least-distance problem in the freedom that those above leave, solved by
the dual active-set method (Goldfarb & Idnani 1983), which cannot go in circles. Asked last: a few
in 100,000 problems of `benchmarks/fuzz.py` get here, and take up to a second or two.
"""

from __future__ import annotations

from decimal import Decimal, localcontext

import numpy as np

from hqp_grasp.hierarchy.certificate import decimals

DIGITS = 150
RHO = Decimal(10) ** -30  # [–] weight of the way x goes, next to the rows of a level
NONE = Decimal(10) ** -40  # [–] violation of a bound, in units of |bound| + ‖a‖ ‖x‖, that is none
KNOWN = 1e-13, 1e-11  # [–] worth a try, see `search`
INFINITY = Decimal("inf")
VANISHED = Decimal(10) ** -100  # [–] of a squared length: what is left where nothing should be


def _size(v: np.ndarray) -> Decimal:
    return (v @ v).sqrt() if len(v) else Decimal(0)


def _snapped(A: np.ndarray, dust: float) -> np.ndarray:
    """A in decimals, rows that are parallel up to rounding exactly parallel."""
    exact = decimals(A)
    norm = np.linalg.norm(A, axis=1)
    unit = A / np.where(norm > 0.0, norm, 1.0)[:, None]
    for i in np.flatnonzero(norm):
        for sign in (1.0, -1.0):
            near = np.abs(unit[:i] - sign * unit[i]).max(axis=1, initial=0.0) < dust
            near &= norm[:i] > 0.0
            if near.any():
                along = exact[int(np.argmax(near))]
                exact[i] = along * ((exact[i] @ along) / (along @ along))
                break
    return exact


def _turn(rows: np.ndarray, Z: np.ndarray, dust: np.ndarray) -> int:
    """Turn the columns of `rows` (m, d) and Z (n, d) alike so that the first span the rows.

    What is left of a row beside others counts as nothing below its `dust`. Returns the rank.
    """
    d = rows.shape[1]
    for r in range(d):
        left = [row[r:] @ row[r:] / (s * s) for row, s in zip(rows, dust, strict=True)]
        for i, square in enumerate(left):
            if square <= 1:
                rows[i, r:] = left[i] = Decimal(0)
        if not any(left):
            return r
        pick = max(range(len(left)), key=left.__getitem__)
        v = rows[pick, r:].copy()
        v[0] += _size(v).copy_sign(v[0])
        v = v / _size(v)
        for block in (rows, Z):
            block[:, r:] = block[:, r:] - np.outer(2 * (block[:, r:] @ v), v)
        rows[pick, r + 1 :] = Decimal(0)
    return d


def _beside(rows: np.ndarray, Z: np.ndarray, dust: np.ndarray) -> np.ndarray:
    """What `rows` leave of the directions Z (n, d)."""
    Z = Z.copy()
    return Z[:, _turn(rows @ Z, Z, dust) :]


def _shortest(
    N: np.ndarray, least: np.ndarray, slack: np.ndarray, equal: int
) -> tuple[np.ndarray, np.ndarray]:
    """The shortest z with N z ≥ least, equal in the first `equal` rows; and the rows' forces.

    z = Nᵀ force, force ≥ 0 in the others, which may be missed by `slack`.
    """
    m, n = N.shape
    z = np.full(n, Decimal(0), dtype=object)
    force = np.full(m, Decimal(0), dtype=object)
    active: list[int] = []
    Q = np.empty((min(m, n), n), dtype=object)  # N[active] = Rᵀ Q
    R = np.full((min(m, n), min(m, n)), Decimal(0), dtype=object)

    def beside(i: int) -> tuple[np.ndarray, np.ndarray]:
        along, rest = np.full(len(active), Decimal(0), dtype=object), N[i].copy()
        for _ in range(2 if active else 0):  # twice, for what rounding leaves
            more = Q[: len(active)] @ rest
            along, rest = along + more, rest - more @ Q[: len(active)]
        return along, rest

    def hold(i: int, along: np.ndarray, rest: np.ndarray) -> None:
        c = len(active)
        length = _size(rest)
        R[:c, c], R[c, c], Q[c] = along, length, rest / length
        active.append(i)

    while True:
        if len(active) < equal:
            pick = len(active)
        else:
            short = least - N @ z - slack
            short[active] = Decimal(-1)
            pick = max(range(m), key=short.__getitem__, default=-1)
            if pick < 0 or short[pick] <= 0:
                return z, force
        while True:
            c = len(active)
            along, rest = beside(pick)
            gain = rest @ rest
            free = gain > VANISHED * (N[pick] @ N[pick])  # of those that are active
            rates = along.copy()  # of the active forces, R⁻¹ along
            for j in range(c - 1, -1, -1):
                rates[j] /= R[j, j]
                rates[:j] -= rates[j] * R[:j, j]
            step, drop = INFINITY, -1
            if free:
                step = (least[pick] - N[pick] @ z) / gain
            if pick >= equal:
                for j in range(equal, c):
                    if rates[j] > 0 and force[active[j]] / rates[j] < step:
                        step, drop = force[active[j]] / rates[j], j
            if step.is_infinite():
                raise ArithmeticError("rows that a level has met exclude one another")
            if free:
                z = z + step * rest
            if c:
                force[active] = force[active] - step * rates
            force[pick] += step
            if drop < 0:
                hold(pick, along, rest)
                break
            force[active[drop]] = Decimal(0)
            behind = active[drop + 1 :]
            del active[drop:]
            for i in behind:
                hold(i, *beside(i))


def _level(
    B: np.ndarray,
    least: np.ndarray,
    most: np.ndarray,
    held: np.ndarray,
    floor: np.ndarray,
    roof: np.ndarray,
    slack: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The y (d,) that brings least ≤ B y ≤ most nearest, within floor ≤ held y ≤ roof.

    Returns y, by how much the rows fall short of that, and how hard the held rows push y up.
    """
    (m, d), h = B.shape, len(held)
    soft = np.concatenate([B / RHO, decimals(np.eye(m))], axis=1)
    hard = np.concatenate([held / RHO, decimals(np.zeros((h, m)))], axis=1)
    sides = []  # (row, sign, bound): sign · row · z ≥ sign · bound, equalities first
    for i in range(m):
        if least[i] == most[i]:
            sides.append((i, 1, least[i]))
    equal = len(sides)
    for i, (lower, upper) in enumerate(zip([*least, *floor], [*most, *roof], strict=True)):
        if i >= m or lower != upper:
            sides += [(i, sign, b) for sign, b in ((1, lower), (-1, upper)) if b.is_finite()]
    N = np.concatenate([soft, hard])
    rows = [i for i, _, _ in sides]
    signs = np.array([sign for _, sign, _ in sides], dtype=object)
    bounds = np.array([b for _, _, b in sides], dtype=object)
    z, force = _shortest(signs[:, None] * N[rows], signs * bounds, slack[rows], equal)
    push = np.full(m + h, Decimal(0), dtype=object)
    for i, f in zip(rows, signs * force, strict=True):
        push[i] += f
    return z[:d] / RHO, z[d:], push[m:]


def search(
    A: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    off: np.ndarray,
    act: np.ndarray,
    known: float,
) -> tuple[np.ndarray, np.ndarray]:
    """The lexicographic optimum x (n,) and the levels' ranks (p,); marks the rows that hold x.

    A, residuals and forces are taken to be `known` to that part of them, and what is smaller to be
    rounding. `act` (M,), changed in place, comes with the equalities marked. Raises
    ArithmeticError where rows contradict what is known of them.
    """
    M, n = A.shape
    p = len(off) - 1
    with localcontext() as context:
        context.prec = DIGITS
        rows = np.concatenate(
            [_snapped(A, known), decimals(np.eye(n))]
        )  # the last level: x is short
        low = decimals(np.append(lower, np.zeros(n)))  # decimals know infinity
        high = decimals(np.append(upper, np.zeros(n)))
        size = np.array([_size(a) for a in rows], dtype=object)
        dust = Decimal(known) * size
        asked = np.array([min(abs(a), abs(b)) for a, b in zip(low, high, strict=True)])
        x = np.full(n, Decimal(0), dtype=object)
        Z = decimals(np.eye(n))  # (n, d) the freedom that is left
        inside = np.empty(0, dtype=np.int64)  # inequality rows of levels above that do not hold x
        for k in range(p + 1):
            own = np.arange(off[k], off[k + 1]) if k < p else np.arange(M, M + n)
            own = own[(size[own] > 0) & ((low[own] > -INFINITY) | (high[own] < INFINITY))]
            B = rows[own] @ Z
            _turn(B, Z, dust[own])
            held = rows[inside] @ Z / size[inside, None]
            felt = np.array([_size(g) > known for g in held], dtype=bool)
            inside, held = inside[felt], held[felt]
            value = rows @ x
            unit = max(size[own], default=Decimal(1))
            here = value[inside] / size[inside]
            both = np.concatenate([own, inside])
            reach = asked[both] + size[both] * _size(x)
            y, miss, push = _level(
                B / unit,
                (low[own] - value[own]) / unit,
                (high[own] - value[own]) / unit,
                held,
                np.minimum(low[inside] / size[inside], here) - here,
                np.maximum(high[inside] / size[inside], here) - here,
                NONE * reach / np.append(np.full(len(own), unit), size[inside]),
            )
            x = x + Z @ y
            room = Decimal(known) * (asked[own] + size[own] * _size(x)) / unit
            side = np.where(abs(miss) > room, np.where(miss > 0, -1, 1), 0)
            strong = abs(push) > room @ size[own] / unit
            if k < p:
                free = act[own] != 2
                act[own[free]] = side[free]
            act[inside[strong]] = np.where(push[strong] > 0, -1, 1)
            fixed = (side != 0) | (low[own] == high[own])
            hold = np.concatenate([own[fixed], inside[strong]])
            inside = np.concatenate([inside[~strong], own[~fixed]])
            Z = _beside(rows[hold], Z, dust[hold])
        Z = decimals(np.eye(n))
        rank = np.zeros(p, dtype=np.int64)
        for k in range(p):
            active = off[k] + np.flatnonzero(act[off[k] : off[k + 1]])
            active = active[size[active] > 0]
            free = _beside(rows[active], Z, dust[active])
            rank[k] = Z.shape[1] - free.shape[1]
            Z = free
        return x.astype(float), rank
