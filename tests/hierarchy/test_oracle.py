"""The reference itself: answers known by hand, first-order optimality, and random attempts."""

from itertools import product

import numpy as np
import pytest
from oracle import lexicographic_optimum
from problems import Rows, box, equal, general, near_singular, scaling, three_level
from scipy.optimize import nnls

INF = np.inf


def rows(*triples):
    """Rows from (row, lower, upper) triples."""
    A, lower, upper = zip(*triples, strict=True)
    return Rows(np.array(A, dtype=float), np.array(lower, float), np.array(upper, float))


def posture(n):
    return equal(np.eye(n), np.zeros(n))


HAND = {
    "two targets at one level meet in the middle": (
        [equal([[1], [1]], [0, 1])],
        [0.5],
        [[0.5, -0.5]],
    ),
    "a target beyond a bound stops at it": (
        [rows(([1], -INF, 1)), equal([[1]], [3])],
        [1],
        [[0], [-2]],
    ),
    "a row that is satisfied stays inside, not where it was": (
        [rows(([1], -INF, 1)), equal([[1]], [0.2])],
        [0.2],
        [[0], [0]],
    ),
    "inequalities that exclude each other share the miss and leave no freedom": (
        [rows(([1], 1, INF), ([1], -INF, -1)), equal([[1]], [5])],
        [0],
        [[-1, 1], [-5]],
    ),
    "three that exclude each other": (
        [rows(([1], 1, INF), ([1], 2, INF), ([1], -INF, -3))],
        [0],
        [[-1, -2, 3]],
    ),
    "weights are squared row lengths": (
        [equal([[1], [3]], [0, 3])],
        [0.9],
        [[0.9, -0.3]],
    ),
    "the nearest point of a box": (
        [box(2, 1.0), equal(np.eye(2), [2, 0.5])],
        [1, 0.5],
        [[0, 0], [-1, 0]],
    ),
    "the nearest point of a box to a slanted line": (
        [box(2, 1.0), equal([[1, 1]], [4]), equal([[1, -1]], [1])],
        [1, 1],
        [[0, 0], [-2], [-1]],
    ),
    "what a higher level fixed, a lower one cannot move": (
        [equal([[1, 1]], [1]), equal([[1, 1]], [3]), equal([[1, -1]], [1])],
        [1, 0],
        [[0], [-2], [0]],
    ),
    "order decides": (
        [equal([[1, 1]], [3]), equal([[1, 1]], [1]), equal([[1, -1]], [1])],
        [2, 1],
        [[0], [2], [0]],
    ),
    "the shortest of many": (
        [equal([[1, 1]], [2])],
        [1, 1],
        [[0]],
    ),
    "the shortest of many, behind a plane": (
        [rows(([1, 1], 2, INF))],
        [1, 1],
        [[0]],
    ),
    "the shortest is zero where zero is allowed": (
        [rows(([1, 2], -1, 1), ([1, -1], -INF, 0))],
        [0, 0],
        [[0, 0]],
    ),
    "a broken inequality keeps its distance": (
        [box(2, 1.0), rows(([1, 0], 2, INF)), equal([[1, 1]], [-1])],
        [1, -1],
        [[0, 0], [-1], [1]],
    ),
    "free rows and zero rows ask for nothing": (
        [
            rows(([1, 0], -INF, INF), ([0, 0], -1, 1)),
            rows(([0, 0], 0, 0)),
            equal([[1, 0]], [4]),
        ],
        [4, 0],
        [[0, 0], [0], [0]],
    ),
    "a zero row may be missed": (
        [rows(([0, 0], 2, 3)), equal([[0, 1]], [4])],
        [0, 4],
        [[-2], [0]],
    ),
    "a level without rows": (
        [Rows(np.zeros((0, 1)), np.zeros(0), np.zeros(0)), equal([[2]], [4])],
        [2],
        [[], [0]],
    ),
    "a degenerate corner, reached through many tight rows": (
        [
            rows(([1, 0], -INF, 1), ([0, 1], -INF, 1), ([1, 1], -INF, 2), ([2, 1], -INF, 3)),
            equal(np.eye(2), [3, 3]),
        ],
        [1, 1],
        [[0, 0, 0, 0], [-2, -2]],
    ),
    "a corner that a later level may leave along an edge only": (
        [rows(([1, 0], -INF, 1), ([0, 1], -INF, 1)), equal([[1, 0]], [2]), equal([[1, 1]], [0])],
        [1, -1],
        [[0, 0], [-1], [0]],
    ),
}


@pytest.mark.parametrize("name", HAND)
def test_known_by_hand(name):
    levels, x, misses = HAND[name]
    found, w = lexicographic_optimum(levels)
    np.testing.assert_allclose(found, x, rtol=0, atol=1e-15)
    assert len(w) == len(misses)
    for ours, known in zip(w, misses, strict=True):
        np.testing.assert_allclose(ours, known, rtol=0, atol=1e-15)


@pytest.mark.parametrize("seed", range(5))
def test_equalities_follow_the_pseudoinverse_recursion(seed):
    rng = np.random.default_rng(seed)
    n = 11
    levels = [equal(rng.standard_normal((m, n)), rng.standard_normal(m)) for m in (3, 2, 4, 6)]
    levels.insert(2, equal(levels[0].A[:2], [1.0, -1.0]))  # which cannot be met any more
    x, N = np.zeros(n), np.eye(n)
    for A, b, _ in levels:
        free = A @ N
        inverse = np.linalg.pinv(np.where(np.abs(free) > 1e-10, free, 0), rcond=1e-10)
        x = x + inverse @ (b - A @ x)
        N = N - inverse @ free
    found, _ = lexicographic_optimum(levels)
    np.testing.assert_allclose(found, x, rtol=0, atol=1e-11)


def test_scaled_levels_and_scaled_targets_scale_the_answer():
    levels = three_level(np.random.default_rng(3), "hard")
    x, w = lexicographic_optimum(levels)
    weights = [2.0**20, 2.0**-20, 1.0, 2.0**13]
    rescaled = [
        Rows(*(s * part for part in level)) for s, level in zip(weights, levels, strict=True)
    ]
    y, v = lexicographic_optimum(rescaled)
    np.testing.assert_array_equal(x, y)
    for s, ours, scaled in zip(weights, w, v, strict=True):
        np.testing.assert_array_equal(s * ours, scaled)

    far = [Rows(A, 2.0**20 * lower, 2.0**20 * upper) for A, lower, upper in levels]
    np.testing.assert_array_equal(2.0**20 * x, lexicographic_optimum(far)[0])


def test_rows_parallel_up_to_rounding_are_parallel():
    rng = np.random.default_rng(0)
    row, other = rng.standard_normal((2, 5))
    exact = [
        rows((row, -INF, 1), (row, 3, INF)),
        equal([other, row + other], [1, 2]),
        equal([row], [9]),
    ]
    rounded = [
        rows((row / 3, -INF, 1 / 3), (row / 7 * 7 / 3, 1, INF)),
        equal([other / 0.7, (row + other) / 0.7], [1 / 0.7, 2 / 0.7]),
        equal([row * 1.1 - 0.3 * row], [9]),
    ]
    x, _ = lexicographic_optimum(exact)
    y, w = lexicographic_optimum(rounded)
    np.testing.assert_allclose(y, x, rtol=0, atol=1e-14)
    assert not lexicographic_optimum([equal([row], [1]), equal([row / 3], [1 / 3])])[1][1].any()
    assert w[2][0] != 0


@pytest.mark.parametrize("towards", [-1.0, 1.0])
def test_bounds_that_meet_up_to_rounding_leave_the_plane_between_them_free(towards):
    rng = np.random.default_rng(0)
    row = rng.standard_normal(4)
    across = nullspace([row], 4).T
    levels = [
        rows((row, -INF, 1)),
        rows((row / 3, 1 / 3, INF)),
        equal(across, 100 * towards * rng.standard_normal(3)),
    ]
    _, w = lexicographic_optimum(levels)
    assert not any(part.any() for part in w)


def test_rows_weighted_a_million_to_one_still_divide_exactly():
    a = np.array([2.0**20, 1.0, 2.0**-20])
    b = np.array([1.0, 3.0, -2.0])
    x, w = lexicographic_optimum([equal(a[:, None], a * b)])
    expected = np.sum(a**2 * b) / np.sum(a**2)
    np.testing.assert_allclose(x, expected, rtol=1e-15)
    np.testing.assert_allclose(w[0][1:], (a * (expected - b))[1:], rtol=1e-15)


@pytest.mark.parametrize("angle", [1e-3, 1e-6, 1e-9])
def test_nearly_parallel_levels_are_told_apart(angle):
    levels = near_singular(np.random.default_rng(1), angle, limits=False)
    x, w = lexicographic_optimum(levels)
    assert not w[0].any() and not w[1].any()
    assert 0.01 / angle < np.max(np.abs(x)) < 100 / angle


PROBLEMS = (
    [(three_level, (d,), s) for d in ("easy", "mid", "hard") for s in range(5)]
    + [(near_singular, (angle,), 1) for angle in (1e-2, 1e-5, 1e-8)]
    + [(scaling, (n, p), 0) for n, p in ((6, 2), (6, 8), (12, 5), (20, 3))]
)


def made(maker, arguments, seed):
    return maker(np.random.default_rng(seed), *arguments)


def small(seed):
    return general(np.random.default_rng(seed), max_n=12, scales=False)


def kept(level, w, x):
    """Directions that later levels must not move, and (signed) those they must not increase."""
    norm = np.linalg.norm(level.A, axis=1)
    value = level.A @ x
    still, sided = [], []
    for i in np.flatnonzero(norm):
        a = level.A[i] / norm[i]
        if w[i] != 0 or level.lower[i] == level.upper[i]:
            still.append(a)
            continue
        if value[i] - level.lower[i] < 1e-9 * norm[i]:
            sided.append(-a)
        if level.upper[i] - value[i] < 1e-9 * norm[i]:
            sided.append(a)
    return still, sided


def stationarity(levels, x, misses):
    """The largest part of any level's gradient that multipliers of the right sign leave over."""
    still, sided, worst = [], [], 0.0
    n = len(x)
    for level, w in zip([*levels, posture(n)], [*misses, x], strict=True):
        size = np.abs(w) @ np.linalg.norm(level.A, axis=1)
        gradient = level.A.T @ w / size if size > 0 else np.zeros(n)
        sides = np.array([*still, *(-a for a in still), *sided]).reshape(-1, n)
        if np.any(gradient):
            left = nnls(sides.T, -gradient)[1] if len(sides) else np.linalg.norm(gradient)
            worst = max(worst, left)
        more = kept(level, w, x)
        still += more[0]
        sided += more[1]
    return worst


@pytest.mark.parametrize(("maker", "arguments", "seed"), PROBLEMS)
def test_multipliers_of_the_right_sign_exist(maker, arguments, seed):
    levels = made(maker, arguments, seed)
    assert stationarity(levels, *lexicographic_optimum(levels)) < 1e-12


@pytest.mark.parametrize("seed", range(40))
def test_multipliers_of_the_right_sign_exist_for_anything(seed):
    levels = small(seed)
    assert stationarity(levels, *lexicographic_optimum(levels)) < 1e-12


@pytest.mark.parametrize("seed", range(30))
def test_misses_are_those_of_x(seed):
    levels = general(np.random.default_rng(1000 + seed), max_n=11)
    x, misses = lexicographic_optimum(levels)
    for (A, lower, upper), w in zip(levels, misses, strict=True):
        value = A @ x
        terms = np.abs(A) @ np.abs(x) + np.linalg.norm(A, axis=1) * np.max(np.abs(x))
        for bound in (lower, upper):
            terms += np.abs(np.where(np.isfinite(bound), bound, 0))
        assert np.all(np.abs(value - np.clip(value, lower, upper) - w) <= 1e-12 * terms)
        assert not np.any(w[(lower <= 0) & (upper >= 0) & ~A.any(axis=1)])


def nullspace(vectors, n):
    _, s, V = np.linalg.svd(np.array(vectors).reshape(-1, n))
    return V[np.sum(s > 1e-9) :].T


def attempt(rng, level, still, sided, inside, x, w):
    """One random admissible step; whether one was found. It must not improve the level."""
    n = len(x)
    held = [a for a in sided if rng.random() < 0.5]
    N = nullspace(still + held, n)
    d = N @ rng.standard_normal(N.shape[1])
    if rng.random() < 0.5:  # as steep as it gets
        d = -N @ (N.T @ (level.A.T @ w))
    if np.linalg.norm(d) < 1e-9:
        return False
    d /= np.linalg.norm(d)
    rises = np.array([a @ d for a in sided])
    if np.any(rises > 1e-9):
        d, rises = -d, -rises
    if np.any(rises > 1e-9):
        return False
    t = 10.0 ** rng.uniform(-3, 0)
    for A, lower, upper in inside:
        slope, value = A @ d, A @ x
        for s, room in ((slope, upper - value), (-slope, value - lower)):
            towards = (s > 1e-9) & (room > 1e-9)
            t = min(t, np.min(room[towards] / s[towards], initial=t))
    value = level.A @ (x + t * d)
    moved = np.linalg.norm(value - np.clip(value, level.lower, level.upper))
    assert moved > np.linalg.norm(w) - 1e-12 * (1 + np.linalg.norm(w))
    return True


def test_no_admissible_step_improves_any_level():
    rng = np.random.default_rng(0)
    found = 0
    problems = [made(*p) for p in PROBLEMS[5:15]] + [small(seed) for seed in range(40, 60)]
    for levels in problems:
        x, misses = lexicographic_optimum(levels)
        still, sided, inside = [], [], []
        for level, w in zip([*levels, posture(len(x))], [*misses, x], strict=True):
            for _ in range(15):
                found += attempt(rng, level, still, sided, inside, x, w)
            more = kept(level, w, x)
            still, sided = still + more[0], sided + more[1]
            satisfied = (w == 0) & (level.lower < level.upper)
            inside.append(Rows(*(part[satisfied] for part in level)))
    assert found > 500


def least_miss(A, lower, upper, held):
    """Least ‖w‖ by trying every combination of ignored, tight and penalised rows."""
    n = A.shape[1]
    choices = []
    for lo, up in zip(lower, upper, strict=True):
        bounds = {b for b in (lo, up) if np.isfinite(b)}
        choices.append([None, *((b, kind) for b in bounds for kind in ("tight", "penalised"))])
    for _, lo, up in held:
        choices.append([lo] if lo == up else [None, *(b for b in (lo, up) if np.isfinite(b))])
    best, best_w = np.inf, None
    for choice in product(*choices):
        mine, upper_levels = choice[: len(A)], choice[len(A) :]
        E = [(h[0], b) for h, b in zip(held, upper_levels, strict=True) if b is not None]
        E += [(a, c[0]) for a, c in zip(A, mine, strict=True) if c and c[1] == "tight"]
        S = [(a, c[0]) for a, c in zip(A, mine, strict=True) if c and c[1] == "penalised"]
        G = np.array([e[0] for e in E]).reshape(-1, n)
        H = np.array([s[0] for s in S]).reshape(-1, n)
        x = np.linalg.lstsq(G, [e[1] for e in E], rcond=1e-10)[0] if E else np.zeros(n)
        N = nullspace(G, n)
        if S and N.size:
            x = x + N @ np.linalg.lstsq(H @ N, [s[1] for s in S] - H @ x, rcond=1e-10)[0]
        if any(not lo - 1e-9 <= a @ x <= up + 1e-9 for a, lo, up in held):
            continue
        w = A @ x - np.clip(A @ x, lower, upper)
        if np.linalg.norm(w) < best - 1e-12:
            best, best_w = np.linalg.norm(w), w
    return best_w


@pytest.mark.parametrize("seed", range(40))
def test_trying_every_active_set_finds_nothing_better(seed):
    rng = np.random.default_rng(seed)
    levels = general(rng, max_n=3, max_levels=3, max_rows=2, scales=False)
    _, misses = lexicographic_optimum(levels)
    held = []
    for (A, lower, upper), w in zip(levels, misses, strict=True):
        best = least_miss(A, lower, upper, held)
        np.testing.assert_allclose(w, best, rtol=0, atol=1e-10)
        for i, a in enumerate(A):
            bound = lower[i] if w[i] < 0 else upper[i]
            fixed = w[i] != 0
            held.append((a, bound + w[i], bound + w[i]) if fixed else (a, lower[i], upper[i]))


def test_generators_repeat_themselves_and_contain_what_they_promise():
    seen = dict.fromkeys(("free", "one-sided", "two-sided", "equal", "zero", "repeated"), 0)
    for seed in range(100):
        levels = general(np.random.default_rng(seed))
        for level, again in zip(levels, general(np.random.default_rng(seed)), strict=True):
            for part, same in zip(level, again, strict=True):
                np.testing.assert_array_equal(part, same)
            A, lower, upper = level
            assert len(A) > 0 and np.isfinite(A).all() and np.all(lower <= upper)
            assert np.all(lower < INF) and np.all(upper > -INF)
            infinite = np.isinf(lower).astype(int) + np.isinf(upper)
            seen["free"] += np.sum(infinite == 2)
            seen["one-sided"] += np.sum(infinite == 1)
            seen["two-sided"] += np.sum((infinite == 0) & (lower < upper))
            seen["equal"] += np.sum(lower == upper)
            seen["zero"] += np.sum(~A.any(axis=1))
            seen["repeated"] += len(A) - len(np.unique(A, axis=0))
    assert min(seen.values()) > 50
