"""The forms of a step: what they share, and what they report of it."""

import dataclasses

import numpy as np
import pytest

from hqp_grasp.control.forms import MemorylessForm, cap_ratio, clip_to_limits, form_of
from hqp_grasp.control.limits import StepLimit
from hqp_grasp.grasp import Contact, Grasp
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.tasks import stack_of

SEEDS = range(5)
EXACT = 1e-12
WIDE = StepLimit(1e3, 1e3)


def hand(seed, normals, n=11):
    """Contacts anywhere with these normals (k, 3), a hand that moves them anyhow."""
    rng = np.random.default_rng(seed)
    k = len(normals)
    contacts = [
        Contact(
            0.05 * rng.standard_normal(3), normal / np.linalg.norm(normal), flexion=(n - k + i,)
        )
        for i, normal in enumerate(normals)
    ]
    H = 0.1 * rng.standard_normal((3 * k, n, n))
    J = 0.3 * rng.standard_normal((3 * k, n))
    return Grasp(np.zeros(n), contacts, J, hessian=H + H.transpose(0, 2, 1))


@pytest.mark.parametrize("seed", SEEDS)
def test_a_step_that_is_too_long_is_scaled_to_its_caps_and_keeps_its_direction(seed):
    grasp = hand(seed, np.random.default_rng(seed).standard_normal((3, 3)))
    stack = stack_of("fmk").within(StepLimit(0.35, 0.03))
    x = np.random.default_rng(seed).standard_normal(grasp.n)
    ratio = cap_ratio(x, stack, grasp)
    assert ratio > 2.0
    clipped = clip_to_limits(x, stack, grasp)
    np.testing.assert_allclose(clipped, x / ratio, rtol=EXACT)
    assert cap_ratio(clipped, stack, grasp) == pytest.approx(1.0, rel=EXACT)
    short = 0.5 * clipped
    np.testing.assert_array_equal(clip_to_limits(short, stack, grasp), short)


@dataclasses.dataclass(frozen=True)
class Beside(HQP):
    """A solver whose answer is off in one joint."""

    off: float = 0.01

    def solve(self, levels, warm=None):
        solution = super().solve(levels, warm)
        beside = solution.x.copy()
        beside[4] += self.off
        return dataclasses.replace(solution, x=beside)


def test_the_gap_is_the_largest_difference_from_the_projection():
    grasp = hand(0, np.random.default_rng(0).standard_normal((3, 3)))
    plan = MemorylessForm(Beside(rank_tolerance=1e-6)).plan(stack_of("fmk").within(WIDE), grasp)
    assert not plan.limit_active
    assert plan.gap == pytest.approx(0.01, rel=1e-6)


@pytest.mark.parametrize("name", ["hierarchy", "clipped"])
@pytest.mark.parametrize("seed", SEEDS)
def test_what_touch_cannot_tell_from_rounding_does_not_steer_a_step(name, seed):
    """Faces of a box, felt to 1e-7: the force along them is asked of no direction."""
    faces = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    noise = 1e-7 * np.random.default_rng(seed).standard_normal((3, 3))
    stack = stack_of("fm").within(WIDE)
    exact, felt = (
        form_of(name).plan(stack, hand(seed, normals)).x for normals in (faces, faces + noise)
    )
    assert np.abs(felt - exact).max() < 1e-4 * (1.0 + np.abs(exact).max())


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("above", ["", "f", "m"])
def test_what_stands_below_the_kinematic_law_is_never_felt(above, seed):
    grasp = hand(seed, np.random.default_rng(seed).standard_normal((3, 3)))
    alone, more = (
        stack_of(f"{above}k{v}").within(WIDE) for v in ("", "m" if above != "m" else "f")
    )
    form = MemorylessForm()
    np.testing.assert_allclose(form.plan(more, grasp).x, form.plan(alone, grasp).x, atol=EXACT)
