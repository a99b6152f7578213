"""Levels as they are built, and the certificate of optimality, which must trust nobody."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
from oracle import lexicographic_optimum
from problems import Rows, box, equal, general, near_singular, three_level
from test_oracle import HAND

from hqp_grasp import HQP, InputError, Level, Solution, SolverError
from hqp_grasp.hierarchy.active_set import search
from hqp_grasp.hierarchy.level import stack

INF = np.inf
STEP = 1e-3  # of the attempts to find something better, in units of 1 + ‖x‖
# The optimum's misses w are unique. A step d that changes those of a level by c · ‖A‖_F‖x‖, and of
# no level above, leaves an imbalance of c²‖A‖_F²‖x‖²/‖d‖ at least, which is c²/STEP in the units of
# the certificate's tolerance, 1e-8. So c = 1e-5 must be noticed.
CLEARLY = 1e-5
ORACLE_ROUNDING = 1e-12  # of x, once its digits are cut to those of a float


def built(problem):
    return [Level(*rows) for rows in problem]


def claim(levels, x, multipliers=None):
    """A solution that somebody claims, without evidence unless it is given."""
    shape = (sum(len(level.A) for level in levels), len(levels))
    if multipliers is None:
        multipliers = np.zeros(shape)
    active = np.zeros(shape[0], dtype=np.int8)
    return Solution(np.asarray(x, dtype=float), (), active, multipliers, "claimed")


def small(seed):
    return built(general(np.random.default_rng(seed), max_n=8, max_levels=4, max_rows=6))


def is_worse(levels, x, best):
    """True where the first level that x treats differently from the optimum is clearly missed."""
    size = 1.0 + np.linalg.norm(best)
    for level in levels:
        reach = np.linalg.norm(level.A) * size
        change = np.linalg.norm(level.residual(x) - level.residual(best))
        if change > ORACLE_ROUNDING * reach:
            return change > CLEARLY * reach
    return False


# ---------------------------------------------------------------- construction


@pytest.mark.parametrize(
    ("A", "lower", "upper", "message"),
    [
        ([[1, 0], [np.nan, 1]], [0, 0], [1, 1], "row 1 of A is not finite"),
        ([[1, 0], [0, 1], [INF, 0]], [0, 0, 0], [1, 1, 1], "row 2 of A is not finite"),
        ([[1, 0], [0, 1]], [0, np.nan], [1, 1], "row 1 has a NaN bound"),
        ([[1, 0], [0, 1]], [0, 0], [np.nan, 1], "row 0 has a NaN bound"),
        ([[1, 0], [0, 1]], [0, 2], [1, 1], r"row 1 has lower > upper: \[2.0, 1.0\]"),
        ([[1, 0], [0, 1]], [INF, 0], [INF, 1], "row 0 asks for an infinite value"),
        ([[1, 0], [0, 1]], [0, -INF], [1, -INF], "row 1 asks for an infinite value"),
        ([[1, 0], [0, 1]], [0, INF], [1, -INF], "row 1 has lower > upper"),
        ([[1, 0], [0, 1]], [0], [1, 1], "one entry for each of the 2 rows"),
        ([[1, 0], [0, 1]], [0, 0], [1, 1, 1], "one entry for each of the 2 rows"),
        ([1, 0], [0], [1], "Level.A must have 2 dimension"),
        ([[1, 0]], 0.0, [1], "Level.lower must have 1 dimension"),
        ([[1, 0]], [0], [[1]], "Level.upper must have 1 dimension"),
        ([["a", 0]], [0], [1], "Level.A must be an array of numbers"),
        ([[1, 0], [1]], [0, 0], [1, 1], "Level.A must be an array of numbers"),
        ([[1, 0]], [None], ["x"], "Level.upper must be an array of numbers"),
    ],
)
def test_a_malformed_level_is_refused_and_the_row_named(A, lower, upper, message):
    with pytest.raises(InputError, match=message):
        Level(A, lower, upper)


def test_the_first_faulty_row_is_named_with_the_name_of_its_level():
    with pytest.raises(InputError, match="Level 'reach': row 2 has lower > upper"):
        Level(np.eye(4), [0, 0, 1, 1], [0, 0, 0, 0], name="reach")


def test_input_errors_are_value_errors():
    with pytest.raises(ValueError, match="row 0"):
        Level([[1.0]], [2.0], [1.0])


def test_infinite_bounds_open_a_side():
    level = Level(np.eye(3), [-INF, 0, -INF], [1, INF, INF])
    np.testing.assert_array_equal(level.residual(np.array([3.0, -2.0, 9.0])), [2, -2, 0])


def test_equal_rows_ask_for_one_value():
    level = Level.equal([[1, 2], [0, 1]], [3, 4], name="task")
    np.testing.assert_array_equal(level.lower, [3, 4])
    np.testing.assert_array_equal(level.upper, [3, 4])
    assert level.name == "task" and not level.is_inequality
    np.testing.assert_array_equal(level.residual(np.array([1.0, 1.0])), [0, -3])


@pytest.mark.parametrize("b", [[np.nan], [INF], [-INF], [1, 2], 1.0, "one"])
def test_equal_refuses_what_is_no_value(b):
    with pytest.raises(InputError, match="Level"):
        Level.equal([[1.0, 0.0]], b)


def test_a_level_without_rows_is_a_level():
    level = Level(np.zeros((0, 3)), [], [])
    assert level.residual(np.ones(3)).shape == (0,)
    assert level.is_inequality


@pytest.mark.parametrize(
    ("lower", "upper", "limits"), [([0, -INF], [1, 1], True), ([0, 1], [1, 1], False)]
)
def test_a_level_with_an_equality_does_more_than_limit(lower, upper, limits):
    assert Level(np.eye(2), lower, upper).is_inequality is limits


def test_integers_and_lists_become_floats():
    level = Level([[1, 2]], [0], [1])
    assert {part.dtype for part in (level.A, level.lower, level.upper)} == {np.dtype(float)}


def test_a_level_cannot_be_changed():
    level = Level(np.eye(2), [0, 0], [1, 1])
    with pytest.raises(AttributeError):
        level.A = np.zeros((2, 2))


def test_levels_built_one_after_another_from_one_buffer_keep_what_they_were_given():
    buffer, b = np.zeros((1, 3)), np.zeros(1)
    levels = []
    for j in range(3):
        buffer[:] = np.eye(3)[j]
        b[:] = j + 1.0
        levels.append(Level.equal(buffer, b))
    np.testing.assert_allclose(HQP().solve(levels).x, [1.0, 2.0, 3.0])


@pytest.mark.parametrize("field", ["A", "lower", "upper"])
def test_the_arrays_of_a_level_are_locked(field):
    level = Level(np.eye(2), [0, 0], [1, 1])
    with pytest.raises(ValueError, match="read-only"):
        getattr(level, field)[...] = 0.5


@pytest.mark.parametrize(
    "again",
    [lambda v: pickle.loads(pickle.dumps(v)), copy.copy, copy.deepcopy, replace],
    ids=["pickled", "copied", "copied deeply", "replaced"],
)
def test_a_level_that_was_pickled_or_copied_is_the_same_and_locked(again):
    level = Level(np.eye(2), [0, -INF], [1, 1], "limits")
    other = again(level)
    assert other.name == "limits"
    for field in ("A", "lower", "upper"):
        array = getattr(other, field)
        np.testing.assert_array_equal(array, getattr(level, field))
        assert not array.flags.writeable


def test_only_a_certified_answer_gives_its_x_to_those_who_act_on_it():
    levels = [Level(np.eye(2), [0, 0], [1, 1]), Level.equal(np.eye(2), [2, 0.5])]
    sound = HQP().solve(levels)
    assert sound.certified_x is sound.x
    doubtful = replace(sound, certified=False, failed=("proxqp: level 1: why",))
    with pytest.raises(SolverError, match="not certified, and so not used: proxqp: level 1: why"):
        _ = doubtful.certified_x


@pytest.mark.parametrize("n", [1, 3, 4, 50, 2000])
def test_levels_of_another_width_are_refused_by_the_certificate(n):
    answer = HQP().solve([Level.equal(np.eye(2), [1.0, 2.0])])
    with pytest.raises(InputError, match=f"levels have {n} unknowns; the solution's x has shape"):
        answer.is_optimal([Level.equal(np.ones((2, n)), [1.0, 2.0])])


@pytest.mark.parametrize("m", [1, 3, 5000])
def test_levels_of_another_height_are_refused_by_the_certificate(m):
    answer = HQP().solve([Level.equal(np.eye(2), [1.0, 2.0])])
    with pytest.raises(InputError, match=f"levels of {m} rows need multipliers"):
        answer.is_optimal([Level.equal(np.ones((m, 2)), np.ones(m))])


def test_more_levels_than_the_solution_has_are_refused_by_the_certificate():
    levels = [Level.equal([[1.0, 0.0]], [1.0]), Level.equal([[0.0, 1.0]], [2.0])]
    answer = HQP().solve([Level.equal(np.eye(2), [1.0, 2.0])])
    with pytest.raises(InputError, match=r"need multipliers \(3, 3\)"):
        answer.is_optimal([*levels, Level(np.zeros((1, 2)), [0.0], [0.0])])


def test_the_search_refuses_an_active_set_of_another_size():
    rows = stack([Level.equal(np.eye(2), [1.0, 2.0])])
    with pytest.raises(InputError, match="an active set must be"):
        search(rows, np.zeros(5, np.int8), 1, 10, 10, 10)


def test_residual_is_the_distance_to_the_nearest_admissible_value():
    rng = np.random.default_rng(0)
    A, x = rng.standard_normal((7, 4)), rng.standard_normal(4)
    middle = rng.standard_normal(7)
    level = Level(A, middle - 0.2, middle + 0.3)
    for value, w in zip(A @ x - middle, level.residual(x), strict=True):
        expected = value - 0.3 if value > 0.3 else value + 0.2 if value < -0.2 else 0.0
        assert w == pytest.approx(expected, abs=1e-14)


# ---------------------------------------------------------------- the certificate accepts


@pytest.mark.parametrize("name", HAND)
def test_answers_known_by_hand_are_certified_without_evidence(name):
    problem, x, _ = HAND[name]
    assert claim(built(problem), x).is_optimal(built(problem))


@pytest.mark.parametrize("difficulty", ["easy", "mid", "hard"])
def test_the_reference_optimum_is_certified_without_evidence(difficulty):
    for seed in range(5):
        problem = three_level(np.random.default_rng(seed), difficulty)
        x, _ = lexicographic_optimum(problem)
        assert claim(problem, x).is_optimal(built(problem)), seed


@pytest.mark.parametrize("seed", range(60))
def test_the_reference_optimum_of_anything_is_certified_without_evidence(seed):
    levels = small(seed)
    x, _ = lexicographic_optimum(levels)
    assert claim(levels, x).is_optimal(levels)


@pytest.mark.parametrize("exponent", range(1, 10))
def test_the_reference_optimum_of_nearly_parallel_levels_is_certified(exponent):
    problem = near_singular(np.random.default_rng(exponent), 10.0**-exponent)
    x, _ = lexicographic_optimum(problem)
    assert claim(problem, x).is_optimal(built(problem))


def corner(rng, n, extra):
    """A vertex at `top` held by n + extra rows, and a task that pulls beyond it."""
    top = rng.integers(-3, 4, size=n).astype(float)
    slanted = rng.integers(0, 3, size=(extra, n)) + np.eye(n)[rng.integers(n, size=extra)]
    A = np.vstack([np.eye(n), slanted])
    limits = Rows(A, np.full(len(A), -INF), A @ top)
    beyond = top + rng.integers(1, 4, size=n)
    return [limits, equal(np.eye(n), beyond)], top


@pytest.mark.parametrize("extra", [0, 1, 5, 20])
def test_a_vertex_held_by_more_rows_than_unknowns_is_certified(extra):
    rng = np.random.default_rng(extra)
    for n in (2, 3, 6):
        problem, top = corner(rng, n, extra)
        np.testing.assert_allclose(lexicographic_optimum(problem)[0], top, atol=1e-13)
        assert claim(problem, top).is_optimal(built(problem))


def test_wrong_evidence_does_not_spoil_a_right_answer():
    rng = np.random.default_rng(0)
    for seed in range(10):
        problem = three_level(rng, "hard")
        x, _ = lexicographic_optimum(problem)
        shape = claim(problem, x).multipliers.shape
        wrong = 10.0 ** rng.uniform(-6, 6) * rng.standard_normal(shape)
        assert claim(problem, x, wrong).is_optimal(built(problem)), seed


def test_any_of_several_optima_is_certified():
    levels = [Level.equal([[1.0, 1.0, 0.0]], [2.0])]
    for x in ([1, 1, 0], [2, 0, 5], [-7, 9, 1e3]):
        assert claim(levels, x).is_optimal(levels)


def test_tolerance_decides_how_near_is_near_enough():
    problem = [box(3, 1.0), equal(np.eye(3), [0.2, 0.5, 2.0])]
    levels = built(problem)
    near = claim(levels, [0.2 + 1e-5, 0.5, 1.0])
    assert near.is_optimal(levels, 1e-3)
    assert not near.is_optimal(levels, 1e-7)
    assert not near.is_optimal(levels)


# ---------------------------------------------------------------- the certificate rejects


@pytest.mark.parametrize("bad", [np.nan, INF, -INF])
def test_an_answer_that_is_not_finite_is_rejected(bad):
    levels = built([box(2, 1.0), equal([[1, 1]], [1])])
    assert claim(levels, [0.5, 0.5]).is_optimal(levels)
    assert not claim(levels, [0.5, bad]).is_optimal(levels)


def attempts(rng, levels, x):
    """Points near x: any way, along and against every level's rows, within a level's nullspace."""
    n, length = len(x), STEP * (1.0 + np.linalg.norm(x))
    directions = [*rng.standard_normal((6, n)), *np.eye(n)[:3]]
    if np.any(x):
        directions.append(x)
    for level in levels:
        if np.any(level.A):
            directions.append(level.A.T @ rng.standard_normal(len(level.A)))
            _, sigma, Vt = np.linalg.svd(level.A)
            rank = int((sigma > 1e-9 * sigma[0]).sum())
            if rank < n:
                directions.append(Vt[rank:].T @ rng.standard_normal(n - rank))
    for d in directions:
        if np.any(d):
            for side in (1.0, -1.0):
                yield x + side * length * d / np.linalg.norm(d)


@pytest.mark.parametrize("seed", range(30))
def test_a_step_away_from_the_optimum_is_rejected(seed):
    rng = np.random.default_rng(seed)
    if seed % 2:
        levels = built(three_level(rng, ("easy", "mid", "hard")[seed % 3]))
    else:
        levels = built(general(rng, max_n=8, max_levels=4, max_rows=6, scales=False))
    best, _ = lexicographic_optimum(levels)
    for x in attempts(rng, levels, best):
        if is_worse(levels, x, best):
            assert not claim(levels, x).is_optimal(levels)


def test_steps_that_make_nothing_worse_are_rare_among_those_tried():
    rng = np.random.default_rng(0)
    levels = built(three_level(rng, "hard"))
    best, _ = lexicographic_optimum(levels)
    worse = [is_worse(levels, x, best) for x in attempts(rng, levels, best)]
    assert np.mean(worse) > 0.9


def test_the_optimum_of_another_order_is_rejected():
    told_apart = 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        levels = built(three_level(rng, "hard"))
        best, _ = lexicographic_optimum(levels)
        for order in ([0, 2, 1, 3], [0, 3, 2, 1], [1, 0, 2, 3], [1, 2, 3, 0]):
            other, _ = lexicographic_optimum([levels[k] for k in order])
            if is_worse(levels, other, best):
                told_apart += 1
                assert not claim(levels, other).is_optimal(levels)
                assert claim(levels, other).is_optimal([levels[k] for k in order])
    assert told_apart > 8


def test_a_point_outside_its_limits_is_rejected_however_well_it_does_below():
    problem = [box(3, 1.0), equal(np.eye(3), [0.5, 2.0, 0.0])]
    levels = built(problem)
    assert claim(levels, [0.5, 1.0, 0.0]).is_optimal(levels)
    assert not claim(levels, [0.5, 2.0, 0.0]).is_optimal(levels)
    assert not claim(levels, [0.5, 1.0 + 1e-6, 0.0]).is_optimal(levels)


def test_a_point_that_holds_back_at_no_bound_is_rejected():
    levels = built([box(2, 1.0), equal(np.eye(2), [3.0, 0.0])])
    assert not claim(levels, [1.0 - 1e-6, 0.0]).is_optimal(levels)


@pytest.mark.parametrize("unit", [1e-3, 1e-6, 1e-9])
def test_a_limit_in_small_units_beside_one_in_large_units_is_kept(unit):
    limits = Rows(np.diag([1.0, unit]), np.full(2, -INF), np.array([1.0, unit]))
    levels = built([limits, equal(np.eye(2), [5.0, 5.0])])
    assert claim(levels, [1.0, 1.0]).is_optimal(levels)
    assert not claim(levels, [1.0, 5.0]).is_optimal(levels)


@pytest.mark.parametrize("unit", [1e-3, 1e-9, 1e-15])
def test_a_level_in_small_units_below_one_in_large_units_is_judged_in_its_own(unit):
    problem = [equal([[1, 1, 0], [1, 1, 0]], [1, 2]), equal([[unit, 0, unit]], [unit])]
    levels = built(problem)
    best, _ = lexicographic_optimum(problem)
    assert claim(levels, best).is_optimal(levels)
    assert not claim(levels, best + np.array([STEP, -STEP, 0.0])).is_optimal(levels)


def test_a_bound_may_push_inwards_only():
    levels = built([Rows(np.array([[1.0]]), np.array([-INF]), np.array([1.0])), equal([[1]], [0])])
    pulling = np.zeros((2, 2))
    pulling[0, 1] = -1.0  # balances level 1 at x = 1, by pulling x to the bound
    assert not claim(levels, [1.0], pulling).is_optimal(levels)
    assert claim(levels, [0.0], pulling).is_optimal(levels)


def forged(rng, levels, x, kind):
    """Multipliers meant to deceive."""
    A = np.vstack([level.A for level in levels])
    own = np.repeat(np.arange(len(levels)), [len(level.A) for level in levels])
    made = np.zeros((len(A), len(levels)))
    if kind == "balancing":  # every level in balance; signs and activity be damned
        for k, level in enumerate(levels):
            pull = level.A.T @ level.residual(x)
            made[own < k, k] = np.linalg.lstsq(A[own < k].T, -pull, rcond=None)[0]
    elif kind == "random":
        made = 10.0 ** rng.uniform(-9, 9, size=made.shape) * rng.standard_normal(made.shape)
    else:
        made[:] = kind
    return made


@pytest.mark.parametrize("kind", ["balancing", "random", 1e300, INF, -INF, np.nan])
def test_no_evidence_makes_a_wrong_answer_right(kind):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        levels = built(three_level(rng, "hard"))
        best, _ = lexicographic_optimum(levels)
        for x in attempts(rng, levels, best):
            if is_worse(levels, x, best):
                evidence = forged(rng, levels, x, kind)
                with np.errstate(all="ignore"):
                    assert not claim(levels, x, evidence).is_optimal(levels), seed


def test_one_forged_entry_is_enough_to_try():
    levels = built([box(2, 1.0), equal(np.eye(2), [0.5, 0.5])])
    for value in (np.nan, INF, -INF, 1e300):
        for row in range(4):
            evidence = np.zeros((4, 2))
            evidence[row, 1] = value
            with np.errstate(all="ignore"):
                assert not claim(levels, [0.4, 0.5], evidence).is_optimal(levels)


def test_rounding_of_the_reference_is_no_reason_to_reject_it():
    rng = np.random.default_rng(4)
    for _ in range(4):
        levels = built(three_level(rng, "mid"))
        x, _ = lexicographic_optimum(levels)
        x = x * (1.0 + ORACLE_ROUNDING * rng.standard_normal(len(x)))
        assert claim(levels, x).is_optimal(levels)
