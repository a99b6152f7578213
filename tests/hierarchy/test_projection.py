"""The nullspace recursion and the SR-inverse, against their closed forms."""

import numpy as np
import pytest
from problems import box, equal, near_singular

from hqp_grasp import InputError, Level, Projection

# Products and inverses of a few matrices with singular values around one, in another order:
# rounding is about 1e-16 times a condition number below 1e4.
TOL = 1e-12
DAMPINGS = [10.0**k for k in range(-12, 1)]


def built(problem):
    return [Level(*rows) for rows in problem]


def solve(problem, **options):
    return Projection(**options).solve(built(problem))


def assert_close(x, known):
    np.testing.assert_allclose(x, known, rtol=0, atol=TOL * (1.0 + np.linalg.norm(known)))


def conditioned(rng, m, n):
    """A random (m, n) matrix with singular values between 0.5 and 2."""
    r = min(m, n)
    U = np.linalg.qr(rng.standard_normal((m, m)))[0][:, :r]
    V = np.linalg.qr(rng.standard_normal((n, n)))[0][:, :r]
    return (U * rng.uniform(0.5, 2.0, size=r)) @ V.T


def recursion(problem, n, rcond=1e-9):
    """Siciliano & Slotine: x ← x + (A N)⁺ (b − A x), N ← N − (A N)⁺ A N."""
    x, N = np.zeros(n), np.eye(n)
    for A, b, _ in problem:
        inverse = np.linalg.pinv(A @ N, rcond=rcond)
        if np.linalg.norm(A @ N) < rcond * np.linalg.norm(A):
            continue  # nothing left for this level
        x = x + inverse @ (b - A @ x)
        N = N - inverse @ A @ N
    return x


def sr_inverse(J, damping):
    return J.T @ np.linalg.inv(J @ J.T + damping * np.eye(len(J)))


# ---------------------------------------------------------------- strict


@pytest.mark.parametrize("rows", [(3,), (3, 3), (3, 2, 4), (5, 6), (11, 2), (3, 3, 11), (1,) * 9])
def test_the_strict_answer_is_the_pseudoinverse_recursion(rows):
    for seed in range(10):
        rng = np.random.default_rng(seed)
        problem = [equal(conditioned(rng, m, 11), rng.standard_normal(m)) for m in rows]
        x = solve(problem).x
        assert_close(x, recursion(problem, 11))


def test_levels_that_repeat_or_contradict_those_above_are_left_as_they_are():
    rng = np.random.default_rng(0)
    A = conditioned(rng, 3, 7)
    problem = [equal(A, [1, 2, 3]), equal(A[:2], [5, 5]), equal(np.eye(7), np.ones(7))]
    answer = solve(problem)
    assert_close(answer.x, recursion(problem, 7))
    assert [level.rank for level in answer.levels] == [3, 0, 4]
    assert [level.status for level in answer.levels] == ["met", "nearest", "nearest"]
    assert_close(A @ answer.x, [1, 2, 3])


@pytest.mark.parametrize(
    ("miss", "status"), [(1e-15, "met"), (1e-12, "met"), (1e-7, "nearest"), (1e-4, "nearest")]
)
def test_a_level_is_met_to_rounding_and_no_further(miss, status):
    answer = solve([equal([[1.0, 0.0]], [1.0]), equal([[1.0, 0.0]], [1.0 + miss])])
    assert [level.status for level in answer.levels] == ["met", status]


def test_rows_of_one_level_that_contradict_one_another_meet_in_the_middle():
    answer = solve([equal([[1, 0], [1, 0]], [0, 1])])
    assert_close(answer.x, [0.5, 0])
    assert answer.levels[0].rank == 1 and answer.levels[0].status == "nearest"
    assert_close(answer.levels[0].residual, [0.5, -0.5])


def test_a_strict_answer_keeps_every_level_above_as_it_was():
    for seed in range(10):
        rng = np.random.default_rng(seed)
        problem = [equal(conditioned(rng, m, 9), rng.standard_normal(m)) for m in (2, 3, 3, 6)]
        whole = solve(problem).x
        for k in range(1, 4):
            prefix = solve(problem[:k]).x
            for A, _, _ in problem[:k]:
                assert_close(A @ whole, A @ prefix)


def test_levels_without_rows_and_zero_rows_ask_for_nothing():
    empty = Level(np.zeros((0, 3)), [], [])
    zero = Level.equal(np.zeros((2, 3)), [0, 0])
    task = Level.equal([[1.0, 1.0, 0.0]], [2.0])
    answer = Projection().solve([empty, zero, task, empty])
    assert_close(answer.x, [1, 1, 0])
    assert [level.rank for level in answer.levels] == [0, 0, 1, 0]


def test_reports_carry_names():
    levels = [Level.equal([[1.0]], [1.0], name="reach"), Level.equal([[2.0]], [0.0], name="rest")]
    answer = Projection().solve(levels)
    assert [level.name for level in answer.levels] == ["reach", "rest"]
    assert answer.method == "projection" and not answer.limit_active


# ---------------------------------------------------------------- rank


@pytest.mark.parametrize("exponent", range(1, 15))
def test_what_counts_as_independent_follows_the_tolerance(exponent):
    angle = 10.0**-exponent
    problem = near_singular(np.random.default_rng(exponent), angle, limits=False)
    problem[0] = equal(np.linalg.qr(problem[0].A.T)[0].T, problem[0].lower)  # never truncated
    for tolerance in (None, 1e-9, 1e-5, 1e-2):
        threshold = 11 * np.finfo(float).eps if tolerance is None else tolerance
        if abs(np.log10(angle / threshold)) < 0.5:
            continue  # on the edge rounding decides
        answer = solve(problem, rank_tolerance=tolerance)
        assert answer.levels[1].rank == (3 if angle > threshold else 0)
        assert np.isfinite(answer.x).all()


def test_rank_is_judged_against_the_level_before_it_was_projected():
    first = equal(np.eye(3)[:1], [1.0])
    leaning = equal([[1.0, 1e-6, 0.0]], [2.0])  # in the freedom left: 1e-6 long, the level: 1 long
    assert solve([first, leaning], rank_tolerance=1e-3).levels[1].rank == 0
    assert solve([first, leaning], rank_tolerance=1e-9).levels[1].rank == 1
    small = equal([[1e-6, 0.0, 1e-6]], [1e-6])  # small in itself, and yet at 45°
    assert solve([first, small], rank_tolerance=1e-3).levels[1].rank == 1


# ---------------------------------------------------------------- damped


@pytest.mark.parametrize("damping", DAMPINGS)
@pytest.mark.parametrize(("m", "n"), [(3, 7), (7, 7), (1, 1), (6, 11)])
def test_one_damped_level_is_the_sr_inverse(m, n, damping):
    rng = np.random.default_rng(m)
    J, b = conditioned(rng, m, n), rng.standard_normal(m)
    assert_close(solve([equal(J, b)], damping=damping).x, sr_inverse(J, damping) @ b)


@pytest.mark.parametrize("damping", DAMPINGS)
@pytest.mark.parametrize(("m", "n"), [(3, 7), (7, 7), (9, 11)])
def test_two_damped_levels_are_equation_13(m, n, damping):
    rng = np.random.default_rng(n)
    for _ in range(5):
        J, rate, rest = conditioned(rng, m, n), rng.standard_normal(m), rng.standard_normal(n)
        star = sr_inverse(J, damping)
        printed = star @ rate + (np.eye(n) - star @ J) @ rest
        answer = solve([equal(J, rate), equal(np.eye(n), rest)], damping=damping)
        assert_close(answer.x, printed)
        assert answer.method == "SR-inverse"


@pytest.mark.parametrize("damping", [1e-4, 1e-2, 1.0])
def test_a_damped_answer_at_a_singularity_is_the_closed_form_and_bounded(damping):
    rng = np.random.default_rng(0)
    J = conditioned(rng, 3, 7)
    J[2] = J[0] + J[1]
    rate, rest = np.array([1.0, -1.0, 5.0]), rng.standard_normal(7)
    star = sr_inverse(J, damping)
    printed = star @ rate + (np.eye(7) - star @ J) @ rest
    x = solve([equal(J, rate), equal(np.eye(7), rest)], damping=damping).x
    assert_close(x, printed)
    bound = np.linalg.norm(rate) / (2 * np.sqrt(damping)) + np.linalg.norm(rest)  # σ/(σ²+λ) ≤ 1/2√λ
    assert np.linalg.norm(x) <= bound


def test_the_damped_answer_approaches_the_strict_one_linearly():
    """x_λ − x_0 = −λ Jᵀ(JJᵀ)⁻¹(JJᵀ + λI)⁻¹(ẋ − J q_c), so the slope in log-log tends to one.

    Over dampings up to λ the slope differs from one by less than λ/σ², σ the smallest singular
    value.
    """
    dampings = np.array([10.0**k for k in range(-8, -2)])
    for seed in range(10):
        rng = np.random.default_rng(seed)
        J, rate, rest = conditioned(rng, 3, 7), rng.standard_normal(3), rng.standard_normal(7)
        problem = [equal(J, rate), equal(np.eye(7), rest)]
        strict = solve(problem).x
        gaps = [np.linalg.norm(solve(problem, damping=d).x - strict) for d in dampings]
        slope = np.polyfit(np.log(dampings), np.log(gaps), 1)[0]
        assert abs(slope - 1.0) < dampings[-1] / np.linalg.svd(J)[1][-1] ** 2
        for damping in dampings:
            gram = J @ J.T
            miss = np.linalg.solve(gram + damping * np.eye(3), rate - J @ rest)
            expected = -damping * J.T @ np.linalg.solve(gram, miss)
            assert_close(solve(problem, damping=damping).x - strict, expected)


def test_heavy_damping_leaves_the_reference():
    rng = np.random.default_rng(0)
    J, rest = conditioned(rng, 3, 7), rng.standard_normal(7)
    x = solve([equal(J, [1, 2, 3]), equal(np.eye(7), rest)], damping=1e15).x
    assert_close(x, rest)


# ---------------------------------------------------------------- bad input


@pytest.mark.parametrize("where", [0, 1, 2])
def test_inequality_rows_are_refused_and_the_level_named(where):
    problem = [equal(np.eye(2), [0, 0]), equal([[1, 1]], [1])]
    problem.insert(where, box(2, 1.0))
    with pytest.raises(InputError, match=f"level {where} has inequalities"):
        solve(problem)


def test_one_inequality_among_equalities_is_refused_too():
    mixed = Level(np.eye(2), [0, 0], [0, 1])
    with pytest.raises(InputError, match="level 1 has inequalities"):
        Projection().solve([Level.equal([[1.0, 1.0]], [1.0]), mixed])


@pytest.mark.parametrize("damping", [-1e-12, np.nan, np.inf])
def test_damping_that_is_no_damping_is_refused(damping):
    with pytest.raises(InputError, match="damping must be"):
        Projection(damping=damping)


@pytest.mark.parametrize("tolerance", [-1e-9, 1.0, np.nan])
def test_a_rank_tolerance_out_of_range_is_refused(tolerance):
    with pytest.raises(InputError, match="rank_tolerance must lie in"):
        Projection(rank_tolerance=tolerance)


def test_levels_of_different_width_are_refused():
    with pytest.raises(InputError, match=r"number of unknowns: \[2, 3\]"):
        solve([equal(np.eye(2), [0, 0]), equal(np.eye(3), [0, 0, 0])])


def test_a_hierarchy_without_levels_is_refused():
    with pytest.raises(InputError, match="at least one level"):
        Projection().solve([])
