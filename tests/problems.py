"""Seeded random hierarchies: lists of (A, lower, upper), most important level first."""

from typing import NamedTuple

import numpy as np


class Rows(NamedTuple):
    """One level: lower ≤ A x ≤ upper. A plain tuple that also answers to .A, .lower, .upper."""

    A: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


def equal(A, b):
    """Rows that ask for A x = b."""
    b = np.array(b, dtype=float)
    return Rows(np.array(A, dtype=float), b, b.copy())


def box(n, bound):
    """Rows that keep every component of x within ±bound."""
    return Rows(np.eye(n), np.full(n, -bound), np.full(n, bound))


# Standard deviation of the targets. The share of 1000 problems whose first task cannot be met
# within the box is 0.0 % (easy), 15.2 % (mid), 52.7 % (hard), by running, in this folder,
#   python -c "
#   from numpy.random import default_rng as r; from oracle import *; from problems import *
#   for d in AMPLITUDE: print(d, sum(
#       lexicographic_optimum(three_level(r(i), d)[:2])[1][1].any() for i in range(1000)))"
# A Gaussian row of 11 entries reaches about ±2.2 within the box.
AMPLITUDE = {"easy": 0.1, "mid": 0.75, "hard": 1.25}


def three_level(rng, difficulty):
    """n = 11: a box, then three Gaussian tasks of 3, 3 and 11 equality rows."""
    n, amplitude = 11, AMPLITUDE[difficulty]
    tasks = [
        equal(rng.standard_normal((m, n)), amplitude * rng.standard_normal(m)) for m in (3, 3, n)
    ]
    return [box(n, 0.25), *tasks]


def near_singular(rng, angle, limits=True, agree=False):
    """n = 11: level 2 spans the rows of level 1 turned by `angle` [rad] in three planes.

    A box of ±0.25 comes first (without it x grows like 1/angle), a posture of 11 rows last. Where
    both levels `agree`, a point of the box meets them.
    """
    n, m = 11, 3
    Q = np.linalg.qr(rng.standard_normal((n, n)))[0].T
    mix = np.linalg.qr(rng.standard_normal((m, m)))[0]
    turned = np.cos(angle) * Q[:m] + np.sin(angle) * Q[m : 2 * m]
    levels = [
        equal(rng.standard_normal((m, m)) @ Q[:m], 0.1 * rng.standard_normal(m)),
        equal(mix @ turned, 0.1 * rng.standard_normal(m)),
        equal(np.eye(n), 0.1 * rng.standard_normal(n)),
    ]
    if agree:
        point = rng.uniform(-0.1, 0.1, n)
        levels[:2] = [equal(level.A, level.A @ point) for level in levels[:2]]
    return [box(n, 0.25), *levels] if limits else levels


def near_singular_at_any_angle(rng):
    """Angles from 1e-1 to 1e-16, with limits or not, with levels that agree or not."""
    angle = 10.0 ** -rng.uniform(1.0, 16.0)
    return near_singular(rng, angle, *(rng.random(2) < 0.5))


def scaling(rng, n, levels):
    """A box, levels − 2 Gaussian tasks that together take three quarters of n, and a posture."""
    tasks = max(levels - 2, 0)
    rows = np.diff(np.linspace(0, max(3 * n / 4, tasks), tasks + 1).round().astype(int))
    amplitude = 0.07 * np.sqrt(n)
    middle = [equal(rng.standard_normal((m, n)), amplitude * rng.standard_normal(m)) for m in rows]
    return [box(n, 0.25), *middle, equal(np.eye(n), 0.2 * rng.standard_normal(n))]


def general(rng, *, max_n=40, max_levels=8, max_rows=12, scales=True):
    """Anything that a hierarchy may contain, most of it awkward.

    Rows: Gaussian, sparse, single unknowns, zero; repeated, negated, or combined from earlier rows
    of the same or another level; equalities, one-sided, two-sided, unbounded; bounds that share a
    feasible point, are tight in it, or contradict one another; integer data with degenerate
    vertices; scales of the targets, of levels and of rows between 1e-6 and 1e6 (`scales`).

    All numbers are short binary fractions and all scales powers of two, so that rows meant to be
    dependent, and vertices meant to be degenerate, are so exactly: the optimum is well defined.
    """
    n = int(rng.integers(1, 1 + min(max_n, int(rng.choice([3, 6, 11, 20, 40])))))
    ternary = rng.random() < 0.2
    feasible = rng.random()  # the share of bounds that admit the common point
    tight = rng.random() * 0.5  # the share of those that touch it
    still = rng.random() < 0.1  # all targets zero
    common = _fraction(rng.standard_normal(n), 6) if rng.random() < 0.7 else np.zeros(n)
    if ternary:
        common = np.round(common)
    graded = scales and rng.random() < 0.15  # every row its own scale
    spread = scales and rng.random() < 0.3  # every level its own scale
    target = 2.0 ** rng.integers(-20, 21) if scales and rng.random() < 0.3 else 1.0

    seen, levels = [], []
    for _ in range(rng.integers(1, max_levels + 1)):
        m = int(rng.integers(1, max_rows + 1))
        empty = rng.random() < 0.04  # a level of zero rows
        size = 2.0 ** rng.integers(-20, 21) if spread else 1.0
        A, lower, upper = np.empty((m, n)), np.empty(m), np.empty(m)
        for i in range(m):
            row = np.zeros(n) if empty else _general_row(rng, n, seen, ternary)
            if row.any():
                seen.append(row)
            low, high = _general_bounds(rng, row @ common, feasible, tight, ternary, still)
            scale = size * (2.0 ** rng.integers(-20, 21) if graded else 1.0)
            A[i], lower[i], upper[i] = row * scale, low * scale * target, high * scale * target
        levels.append(Rows(A, lower, upper))
    return levels


def anything(rng):
    """A `general` problem, every third with rows of rounding dust, and a rank tolerance for it.

    Returns levels, and None for the default tolerance or 1e-12 … 1e-3.
    """
    levels = general(rng)
    if rng.random() < 1 / 3:
        levels = [_dusty(rng, level) if rng.random() < 0.5 else level for level in levels]
    return levels, None if rng.random() < 0.4 else 10.0 ** rng.uniform(-12.0, -3.0)


def _dusty(rng, level):
    """One to three rows more, 1e-12 … 1e-17 of the level, that ask for what the others ask for."""
    count, n = int(rng.integers(1, 4)), level.A.shape[1]
    dust = 10.0 ** rng.uniform(-17.0, -12.0, (count, 1)) * rng.standard_normal((count, n))
    asked = rng.integers(-1, 2, count) * np.abs(np.clip(0.0, level.lower, level.upper)).max()
    order = rng.permutation(len(level.A) + count)
    return Rows(
        np.concatenate([level.A, np.linalg.norm(level.A, 2) * dust])[order],
        np.append(level.lower, asked)[order],
        np.append(level.upper, asked)[order],
    )


def _fraction(values, bits):
    """Round to multiples of 2^−bits."""
    return np.round(np.asarray(values) * 2.0**bits) / 2.0**bits


def _general_row(rng, n, seen, ternary):
    kind = rng.random()
    if kind < 0.04:
        return np.zeros(n)
    if seen and kind < 0.2:  # again, or reversed
        return seen[rng.integers(len(seen))] * rng.choice([1.0, 1.0, -1.0, 2.0])
    if seen and kind < 0.32:  # in the span of up to three
        chosen = [seen[i] for i in rng.integers(len(seen), size=3)]
        row = np.array(rng.choice([-1.0, 0.0, 0.5, 1.0], size=3) @ chosen)
        return _fraction(row, 16) if np.array_equal(row, _fraction(row, 16)) else chosen[0]
    if kind < 0.45:  # one unknown
        return np.eye(n)[rng.integers(n)]
    if ternary:
        return rng.integers(-1, 2, size=n).astype(float)
    row = _fraction(rng.standard_normal(n), 12)
    return row * (rng.random(n) < 0.4) if kind < 0.55 else row


def _general_bounds(rng, value, feasible, tight, ternary, still):
    """lower ≤ upper of one row, whose value at the common point is given."""
    noise = np.abs(
        rng.integers(1, 4, size=2) if ternary else _fraction(rng.exponential(size=2), 12)
    )
    if still:
        value, noise = 0.0, noise * 0.0
    elif rng.random() > feasible:
        value = value + (rng.integers(-2, 3) if ternary else _fraction(rng.standard_normal(), 12))
    if rng.random() < tight:
        noise[rng.integers(2)] = 0.0
    form = rng.random()
    if form < 0.35:
        return value, value
    if form < 0.55:
        return value - noise[0], np.inf
    if form < 0.75:
        return -np.inf, value + noise[1]
    if form < 0.95:
        return value - noise[0], value + noise[1]
    return -np.inf, np.inf


# ---------------------------------------------------------------- forces, and many joints

CONTACTS = (3, 5, 6, 8)
EDGES = (4, 6, 8, 12, 16)  # of a friction pyramid
FLOOR, CAP = 0.2, 15.0  # of a normal force: share of the mean, and [N]


def forces(rng, k=None, edges=None):
    """Contact forces of a grip, x = (f₁ … f_k [N], s₁ … s_k [N]): m ≫ n, and many rows tied.

    Joint torques within their limits ▷ friction pyramids with margins s, each normal force between
    a floor and a cap ▷ net force = felt ▷ Σ normal forces = k F ▷ each margin that of a pure
    squeeze ▷ no net moment ▷ least force. Half of the contacts lie evenly about a drum or on two
    faces of a box, the others anywhere on a ball.
    """
    k = int(rng.choice(CONTACTS)) if k is None else k
    edges = int(rng.choice(EDGES)) if edges is None else edges
    friction, mean = rng.uniform(0.2, 1.0), rng.uniform(1.0, 10.0)
    p, frames = _contacts(rng, k)
    normal = np.zeros((k, 4 * k))
    cones, margins = np.zeros((k * edges, 4 * k)), np.eye(4 * k)[3 * k :]
    for i, frame in enumerate(frames):
        own = slice(3 * i, 3 * i + 3)
        normal[i, own] = frame[0]
        for j, angle in enumerate(2.0 * np.pi * np.arange(edges) / edges):
            edge = np.cos(angle) * frame[1] + np.sin(angle) * frame[2]
            cones[i * edges + j, own] = friction * frame[0] - edge
        cones[i * edges : (i + 1) * edges, 3 * k + i] = -1.0
    torques = _torques(rng, p)
    limit = rng.uniform(0.5, 3.0)  # [N·m]
    net = np.hstack([np.eye(3)] * k + [np.zeros((3, k))])
    felt = rng.choice([0.0, 1.0, 5.0]) * (np.eye(3)[2] if rng.random() < 0.5 else _unit(rng))
    lever = np.linalg.norm(p - p.mean(axis=0), axis=1).mean()
    moment = np.hstack([_cross(each) / lever for each in p - p.mean(axis=0)] + [np.zeros((3, k))])
    low = np.concatenate([np.zeros(k * edges + k), np.full(k, FLOOR * mean)])
    high = np.concatenate([np.full(k * edges + k, np.inf), np.full(k, CAP)])
    return [
        Rows(torques, np.full(len(torques), -limit), np.full(len(torques), limit)),
        Rows(np.concatenate([cones, margins, normal]), low, high),
        equal(net, felt),
        equal(normal.sum(axis=0)[None], [k * mean]),
        equal(margins, np.full(k, friction * mean)),
        equal(moment, np.zeros(3)),
        equal(np.eye(4 * k)[: 3 * k], np.zeros(3 * k)),
    ]


def _unit(rng):
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)


def _cross(v):
    """v × as a matrix (3, 3)."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _contacts(rng, k):
    """Places (k, 3) [m], and at each a frame of rows: inward normal and two tangents."""
    size, shape = rng.uniform(0.03, 0.2), rng.random()
    turns = 2.0 * np.pi * np.arange(k) / k
    if shape < 0.25:  # about a drum
        inward = -np.column_stack([np.cos(turns), np.sin(turns), np.zeros(k)])
        p = -size * inward + rng.choice([0.0, 0.02]) * np.outer(np.arange(k) % 2, np.eye(3)[2])
    elif shape < 0.5:  # on two faces of a box
        side = 2.0 * (np.arange(k) % 2) - 1.0
        inward = -np.outer(side, np.eye(3)[0])
        p = -size * inward + np.outer(np.arange(k) // 2 * 0.025, np.eye(3)[1])
    else:
        inward = np.array([_unit(rng) for _ in range(k)])
        p = -size * inward + 0.01 * rng.standard_normal((k, 3))
    frames = []
    for n in inward:
        first = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
        first /= np.linalg.norm(first)
        frames.append(np.array([n, first, np.cross(n, first)]))
    return p, frames


def _torques(rng, p):
    """Jᵀ (joints, 4k) [m]: two to four joints of each finger, and none to seven of an arm."""
    k = len(p)
    rows = []
    for i in range(k):
        for _ in range(int(rng.integers(2, 5))):
            rows.append(np.zeros(4 * k))
            rows[-1][3 * i : 3 * i + 3] = rng.uniform(0.02, 0.12) * _unit(rng)
    for _ in range(int(rng.integers(0, 8))):
        axis, place = _unit(rng), 0.5 * rng.standard_normal(3)
        rows.append(np.append(np.cross(axis, p - place).ravel(), np.zeros(k)))
    return np.array(rows)


def joints(rng, n=43):
    """A step of a robot of many joints: most limits touch x = 0, some joints are locked by them.

    Caps on joints and on tips ▷ ranges, some as narrow as rounding ▷ couplings, half of the time ▷
    clearances ▷ where the tips go, and a damping.
    """
    tips = int(rng.integers(2, 6))
    moving = rng.random(n) < rng.uniform(0.3, 1.0)
    if not moving.any():
        moving[0] = True
    J = np.concatenate([_sparse(rng, n, moving, 3) for _ in range(tips)])
    cap = np.concatenate([np.eye(n) / 0.35, J / 0.05])
    before = _at_a_bound(rng, len(cap))
    lower, upper = rng.uniform(-3.0, 0.0, n), rng.uniform(0.0, 3.0, n)
    lower[rng.random(n) < 0.3] = 0.0
    upper[(rng.random(n) < 0.3) & (lower < 0.0)] = 0.0
    locked = np.flatnonzero(~moving)
    dust = np.where(rng.random(len(locked)) < 0.25, rng.uniform(-1e-16, 1e-16, len(locked)), 0.0)
    levels = [
        Rows(cap, -1.0 - before, 1.0 - before),
        Rows(
            np.concatenate([np.eye(n), np.eye(n)[locked]]),
            np.concatenate([lower, np.minimum(dust, 0.0)]),
            np.concatenate([upper, np.maximum(dust, 0.0)]),
        ),
    ]
    if rng.random() < 0.5:
        count = int(rng.integers(1, 6))
        pairs = rng.choice(np.flatnonzero(moving), (count, 2))
        ratios = rng.uniform(0.3, 1.5, (count, 1))
        couplings = np.eye(n)[pairs[:, 0]] - ratios * np.eye(n)[pairs[:, 1]]
        levels.append(equal(couplings, np.zeros(count)))
    clear = np.concatenate([_sparse(rng, n, moving, 1) for _ in range(int(rng.integers(5, 46)))])
    room = -rng.exponential(0.02, len(clear)) * (rng.random(len(clear)) < 0.8)
    levels.append(Rows(0.1 * clear, room, np.full(len(clear), np.inf)))
    goal = 0.02 * rng.standard_normal(len(J))
    asked = equal(np.concatenate([J, 1e-2 * np.eye(n)]), np.append(goal, np.zeros(n)))
    return [*levels, asked]


def _sparse(rng, n, moving, m):
    """Rows (m, n) [m/rad] of up to 13 joints of those that move."""
    chain = rng.permutation(np.flatnonzero(moving))[:13]
    rows = np.zeros((m, n))
    rows[:, chain] = 0.2 * rng.standard_normal((m, len(chain)))
    return rows


def _at_a_bound(rng, m):
    """What was used up of caps of ±1 (m,) [–]: nothing, some, or all of them to rounding."""
    used = np.where(rng.random(m) < 0.5, 0.0, rng.uniform(-1.0, 1.0, m))
    full = rng.random(m) < 0.2
    return np.where(
        full, rng.choice([-1.0, 1.0], m) * (1.0 - rng.integers(0, 9, m) * 2.0**-53), used
    )
