"""Problems on which the search once failed, as `benchmarks/fuzz.py` draws them."""

import numpy as np
import pytest
from oracle import lexicographic_optimum
from problems import general, near_singular_at_any_angle

from hqp_grasp import HQP, Level

# (seed, index) of `general` problems. Most have rows of very different size within one level.
UNSOLVED = [
    *((0, i) for i in (299, 375, 692, 706, 801, 1120, 1263, 1329)),
    *((1, i) for i in (150, 365, 776, 885, 929, 1272, 1544)),
    *(
        (2, i)
        for i in (1020, 1400, 1563, 1749, 2607, 3212, 3683, 4552, 4562, 5829, 6372, 11487, 11594)
    ),
    *((11, i) for i in (3622, 3696, 4846, 6550, 7566, 8085, 8320, 9585, 10529, 11206)),
    *((12, i) for i in (406, 735, 4459)),
    *((32, i) for i in (414, 11992)),
    (33, 28774),
]
# The same, with an answer that was certified and longer than need be, or missed a level by more.
NOT_LEAST = [(5, i) for i in (15, 135, 194, 233, 341, 386, 2358)]


# Of `near_singular` problems: multipliers of 1e15, which no double can balance to 1e-8.
BEYOND_DOUBLES = [(1, 3496), (1, 4073), (2, 2534), (3, 4143), (3, 4807)]


def problem(seed, index, draw=general):
    return draw(np.random.default_rng(np.random.SeedSequence([seed, index])))


@pytest.mark.parametrize(("seed", "index"), UNSOLVED)
def test_a_problem_that_was_not_solved_is_answered_and_certified(seed, index):
    levels = [Level(*rows) for rows in problem(seed, index)]
    assert HQP(solver="daqp" if seed == 12 else "proxqp").solve(levels).is_optimal(levels)


@pytest.mark.parametrize(("seed", "index"), [*NOT_LEAST, (0, 375), (1, 885), (2, 2607), (12, 406)])
def test_a_problem_that_was_solved_wrongly_has_the_reference_optimum(seed, index):
    rows = problem(seed, index)
    x = HQP("active-set").solve([Level(*level) for level in rows]).x
    known, misses = lexicographic_optimum(rows)
    assert np.linalg.norm(x) == pytest.approx(np.linalg.norm(known), rel=1e-6)
    for level, miss in zip(rows, misses, strict=True):
        found = level.A @ x - np.clip(level.A @ x, level.lower, level.upper)
        unit = np.abs(level.A) @ np.abs(x) + np.abs(np.clip(0.0, level.lower, level.upper))
        assert np.linalg.norm(found) == pytest.approx(
            np.linalg.norm(miss), abs=1e-6 * np.linalg.norm(unit)
        )


@pytest.mark.parametrize(("seed", "index"), BEYOND_DOUBLES)
def test_levels_parallel_to_the_last_digits_say_so_and_a_rank_tolerance_decides(seed, index):
    levels = [Level(*rows) for rows in problem(seed, index, near_singular_at_any_angle)]
    answer = HQP().solve(levels)
    assert np.isfinite(answer.x).all()
    assert answer.certified == answer.is_optimal(levels)
    assert HQP(rank_tolerance=1e-6).solve(levels).certified
