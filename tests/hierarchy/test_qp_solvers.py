"""What a QP solver is asked for: which rows hold the optimum."""

import numpy as np
import pytest
from problems import three_level

from hqp_grasp import HQP, Level
from hqp_grasp.hierarchy.level import stack
from hqp_grasp.hierarchy.qp_solvers import BACKENDS, active_rows


@pytest.mark.parametrize("solver", ["proxqp", "daqp"])
@pytest.mark.parametrize("difficulty", ["easy", "mid", "hard"])
def test_the_rows_that_a_solver_names_are_those_that_hold_the_optimum(difficulty, solver):
    """On every problem: so that the search after it has nothing left to find."""
    for seed in range(40):
        levels = [Level(*rows) for rows in three_level(np.random.default_rng(seed), difficulty)]
        named = active_rows(stack(levels), BACKENDS[solver])
        np.testing.assert_array_equal(named, HQP("active-set").solve(levels).active)
