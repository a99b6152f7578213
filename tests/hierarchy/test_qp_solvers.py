"""What a QP solver is asked for: which rows hold the optimum."""

import numpy as np
import pytest
from problems import three_level

from hqp_grasp import HQP, Level
from hqp_grasp.hierarchy.level import stack
from hqp_grasp.hierarchy.qp_solvers import BACKENDS, KEPT, _kept, active_rows


@pytest.mark.parametrize("solver", ["proxqp", "daqp"])
@pytest.mark.parametrize("difficulty", ["easy", "mid", "hard"])
def test_the_rows_that_a_solver_names_are_those_that_hold_the_optimum(difficulty, solver):
    """On every problem: so that the search after it has nothing left to find."""
    for seed in range(40):
        levels = [Level(*rows) for rows in three_level(np.random.default_rng(seed), difficulty)]
        named = active_rows(stack(levels), BACKENDS[solver])
        np.testing.assert_array_equal(named, HQP("active-set").solve(levels).active)


def test_solver_objects_are_kept_for_a_few_shapes_only():
    """Or hierarchies of ever new shapes fill the memory: 1 GB after 10,000 of them."""
    for n in range(2, KEPT + 20):
        box = Level(np.eye(n), np.full(n, -1.0), np.ones(n))
        assert HQP("proxqp").solve([box, Level.equal(np.eye(n), np.full(n, 2.0))]).certified
    assert len(_kept.by_shape) == KEPT
