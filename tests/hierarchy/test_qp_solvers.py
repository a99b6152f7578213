"""What a QP solver is asked for: which rows hold the optimum."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from problems import forces, three_level

from hqp_grasp import HQP, Level
from hqp_grasp.hierarchy.level import stack
from hqp_grasp.hierarchy.qp_solvers import BACKENDS, QPSolverError, _kept, active_rows


@pytest.mark.parametrize("solver", ["proxqp", "daqp"])
@pytest.mark.parametrize("difficulty", ["easy", "mid", "hard"])
def test_the_rows_that_a_solver_names_are_those_that_hold_the_optimum(difficulty, solver):
    """On every problem: so that the search after it has nothing left to find."""
    for seed in range(40):
        levels = [Level(*rows) for rows in three_level(np.random.default_rng(seed), difficulty)]
        named = active_rows(stack(levels), BACKENDS[solver])
        np.testing.assert_array_equal(named, HQP("active-set").solve(levels).active)


# ---------------------------------------------------------------- one QP, worked out by hand


@pytest.mark.parametrize("name", sorted(BACKENDS))
def test_a_solver_tells_the_answer_and_which_side_holds_it(name):
    """min ½|y − (3, −3, 1)|², rows of which the first holds from above, the second from below."""
    y, z = BACKENDS[name](
        np.eye(3),
        np.array([-3.0, 3.0, -1.0]),
        np.eye(3),
        np.array([-1.0, -2.0, -5.0]),
        np.array([2.0, 1.0, np.inf]),
    )
    np.testing.assert_allclose(y, [2.0, -2.0, 1.0], atol=1e-4)
    np.testing.assert_allclose(z, [1.0, -1.0, 0.0], atol=1e-4)


@pytest.mark.parametrize("name", sorted(BACKENDS))
def test_rows_that_slant_hold_by_their_own_multiplier(name):
    """min ½|y|² − 2 y₀ where 0.6 y₀ + 0.8 y₁ ≤ 0.2, the other side free."""
    row = np.array([[0.6, 0.8]])
    y, z = BACKENDS[name](
        np.eye(2), np.array([-2.0, 0.0]), row, np.array([-np.inf]), np.array([0.2])
    )
    np.testing.assert_allclose(y, [2.0 - 0.6, -0.8], atol=1e-4)
    np.testing.assert_allclose(z, [1.0], atol=1e-4)
    y, z = BACKENDS[name](
        np.eye(2), np.array([2.0, 0.0]), -row, np.array([-0.2]), np.array([np.inf])
    )
    np.testing.assert_allclose(y, [-2.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(z, [0.0], atol=1e-4)


@pytest.mark.parametrize("name", ["proxqp", "daqp"])
def test_what_no_y_meets_is_no_answer(name):
    both = np.array([[1.0], [1.0]])
    with pytest.raises(QPSolverError, match=r"status|exit flag"):
        BACKENDS[name](np.eye(1), np.zeros(1), both, np.array([-9.0, 2.0]), np.array([1.0, 9.0]))


@pytest.mark.parametrize("index", [12, 89, 194, 309, 310, 338, 350])
def test_rows_that_hold_little_are_told_from_those_that_only_rounding_holds(index):
    """Contact forces on which one such row was missing, or too many; drawn as by the fuzz."""
    rng = np.random.default_rng(np.random.SeedSequence([12, index]))
    answer = HQP("daqp").solve([Level(*rows) for rows in forces(rng)])
    assert answer.certified and answer.failed == ()


def test_objects_of_proxsuite_are_kept_for_32_shapes_and_each_thread_has_its_own():
    """Or hierarchies of ever new shapes fill the memory: 1 GB after 10,000 of them."""
    _kept.by_shape.clear()
    for n in range(1, 41):
        BACKENDS["proxqp"](np.eye(n), np.ones(n), np.eye(n), -np.ones(n), np.ones(n))
    assert sorted(_kept.by_shape) == [(n, n) for n in range(9, 41)]
    before = dict(_kept.by_shape)
    BACKENDS["proxqp"](np.eye(40), np.zeros(40), np.eye(40), -np.ones(40), np.ones(40))
    assert all(_kept.by_shape[shape] is qp for shape, qp in before.items())
    with ThreadPoolExecutor(1) as other:
        assert other.submit(lambda: dict(_kept.by_shape)).result() == {}


# ---------------------------------------------------------------- which rows hold an optimum

HALF = np.array([[0.5, 0.5]])


def rows_of(*levels):
    return stack([Level(*level) for level in levels])


@pytest.mark.parametrize("name", ["proxqp", "daqp"])
@pytest.mark.parametrize(
    ("levels", "active"),
    [
        # Limits that x = 0 keeps ask for nothing; what is below pushes one of them up, one down.
        ([(np.eye(2), [-1, -1], [1, 1]), (np.eye(2), [3, -3], [3, -3])], [1, -1, 2, 2]),
        # What is above may hold from the start: x = 0 is outside.
        ([(np.eye(2), [2, -1], [4, 1]), (np.eye(2), [0, 0], [0, 0])], [-1, 0, 2, 2]),
        # A row that cannot be met is left at the side that it misses.
        ([(HALF, [1], [1]), (HALF, [-9], [0.5]), (np.eye(2), [0, 0], [0, 0])], [2, 1, 2, 2]),
        # An inequality that is met holds nothing, and one without bounds says nothing.
        ([(np.eye(2), [-9, -np.inf], [9, np.inf]), (np.eye(2), [1, 1], [1, 1])], [0, 0, 2, 2]),
        # No asking below: the last question is to be short.
        ([(np.eye(2), [1, -np.inf], [9, -2])], [-1, 1]),
    ],
)
def test_the_rows_that_hold_an_optimum_are_found(name, levels, active):
    rows = rows_of(*levels)
    assert active_rows(rows, BACKENDS[name]).tolist() == active


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_rows_are_found_whatever_their_units_and_sizes(unit):
    """Solvers' tolerances are absolute: what is asked is posed with a size of 1."""
    rows = rows_of(
        (unit * np.eye(2), [-unit, -unit], [unit, unit]), (np.eye(2), [3, 0.5], [3, 0.5])
    )
    assert active_rows(rows, BACKENDS["proxqp"]).tolist() == [1, 0, 2, 2]
    small = rows_of(
        (np.eye(2), [-unit, -unit], [unit, unit]),
        (np.eye(2), [3 * unit, 0.5 * unit], [3 * unit, 0.5 * unit]),
    )
    assert active_rows(small, BACKENDS["proxqp"]).tolist() == [1, 0, 2, 2]


def test_whatever_a_solver_does_it_is_told_by_the_level():
    rows = rows_of((np.eye(2), [2, -1], [4, 1]), (np.eye(2), [0, 0], [0, 0]))

    def raises(*_):
        raise ZeroDivisionError("inside")

    def infinite(P, q, G, low, high):
        return np.full(len(q), np.nan), np.zeros(len(G))

    def refuses(*_):
        raise QPSolverError("status NONE")

    for backend, said in (
        (raises, r"level 0: ZeroDivisionError\('inside'\)"),
        (infinite, "level 0: the answer is not finite"),
        (refuses, "level 0: status NONE"),
    ):
        with pytest.raises(QPSolverError, match=said):
            active_rows(rows, backend)
