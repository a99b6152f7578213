"""The decimal way by itself: its least-distance step, and whole hierarchies."""

from decimal import Decimal, localcontext

import numpy as np
import pytest
from oracle import lexicographic_optimum
from problems import general, three_level

from hqp_grasp import Level
from hqp_grasp.hierarchy import many_digits
from hqp_grasp.hierarchy.active_set import equalities
from hqp_grasp.hierarchy.certificate import decimals
from hqp_grasp.hierarchy.level import stack

TINY = Decimal(10) ** -60  # far below what doubles can tell, far above the rounding of 150 digits


def shortest(N, least, equal):
    """The shortest z in decimals, with N and least as they came in."""
    N, least = decimals(np.array(N, float)), decimals(np.array(least, float))
    z, force = many_digits._shortest(N, least, decimals(np.zeros(len(N))), equal)
    return N, least, z, force


@pytest.mark.parametrize("equal", [0, 2])
@pytest.mark.parametrize("seed", range(10))
def test_the_shortest_point_meets_its_rows_and_is_held_by_them_alone(seed, equal):
    rng = np.random.default_rng(seed)
    m, n = int(rng.integers(4, 9)), int(rng.integers(3, 7))
    N = rng.standard_normal((m, n))
    least = N @ rng.standard_normal(n) - rng.exponential(size=m) * (np.arange(m) >= equal)
    with localcontext() as context:
        context.prec = many_digits.DIGITS
        N, least, z, force = shortest(N, least, equal)
        room = N @ z - least
        assert max(abs(room[:equal]), default=0) < TINY
        assert min(room[equal:]) > -TINY
        assert max(abs(z - N.T @ force)) < TINY
        assert min(force[equal:]) >= 0
        assert max(abs(force * room)) < TINY


def test_rows_that_exclude_one_another_are_refused():
    with localcontext() as context:
        context.prec = many_digits.DIGITS
        with pytest.raises(ArithmeticError, match="exclude one another"):
            shortest([[1.0, 1.0], [-1.0, -1.0]], [1.0, 1.0], 0)


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("draw", [general, lambda rng: three_level(rng, "hard")[:3]])
def test_it_finds_the_reference_optimum_by_itself(draw, seed):
    rng = np.random.default_rng(seed)
    problem = draw(rng)
    while np.shape(problem[0].A)[1] > 15:  # larger ones take the reference too long
        problem = draw(rng)
    rows = stack([Level(*level) for level in problem])
    act = equalities(rows.lower, rows.upper)
    known = many_digits.KNOWN[0]
    x, rank = many_digits.search(rows.A, rows.lower, rows.upper, rows.offsets, act, known)
    reference, _ = lexicographic_optimum(problem)
    assert x == pytest.approx(reference, abs=1e-9 * (1.0 + np.linalg.norm(reference)))
    assert (rank <= np.diff(rows.offsets)).all() and rank.sum() <= len(x)
