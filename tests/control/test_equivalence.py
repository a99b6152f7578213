"""The hierarchy is the paper's composition: theorems, on random problems.

Notation: J, J_f, J_m are (augmented, force, moment) Jacobians, ẋ a step of the contacts, q̇ one of
the joints, q̇_c the secondary step, ⁺ the pseudo-inverse, * the SR-inverse.
"""

import numpy as np
import pytest
from hqp_grasp.scenarios import cylinder
from problems import Rows, box, equal

import hqp_grasp as hg
from hqp_grasp import HQP, Level, Projection
from hqp_grasp.control.forms import clip_to_limits

SR_DAMPING = 1e-05
TOUCH_RANK = 1e-06

# Two routes to one answer in double precision: 1e-16 times a condition number, which the problems
# here keep below 1e4, squared at worst (an SR-inverse forms JJᵀ). Asked for is 1e-8.
TOL = 1e-8
SOLVERS = ("proxqp", "active-set", "daqp")
DAMPINGS = [10.0**k for k in range(-10, 3)]


def built(problem):
    return [Level(*rows) for rows in problem]


def hierarchy(problem, solver="proxqp", **options):
    """The certified answer of the hierarchy."""
    levels = built(problem)
    answer = HQP(solver=solver, **options).solve(levels)
    assert answer.is_optimal(levels)
    return answer


def projection(problem, damping=0.0):
    return Projection(damping=damping).solve(built(problem)).x


def gap(x, y):
    return np.max(np.abs(x - y)) / (1.0 + np.max(np.abs(y)))


def conditioned(rng, m, n):
    """A random (m, n) matrix with singular values between 0.5 and 2."""
    r = min(m, n)
    U = np.linalg.qr(rng.standard_normal((m, m)))[0][:, :r]
    V = np.linalg.qr(rng.standard_normal((n, n)))[0][:, :r]
    return (U * rng.uniform(0.5, 2.0, size=r)) @ V.T


def sr_inverse(J, damping):
    return J.T @ np.linalg.inv(J @ J.T + damping * np.eye(len(J)))


# ---------------------------------------------------------------- strict QP = projection


@pytest.mark.parametrize("solver", SOLVERS)
def test_the_strict_hierarchy_is_the_projection(solver, record_property):
    largest, ranks = 0.0, set()
    for seed in range(100):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(2, 15))
        problem = []
        for _ in range(rng.integers(1, 6)):
            m = int(rng.integers(1, 7))
            A = conditioned(rng, m, n)
            if problem and rng.random() < 0.3:  # partly decided by a level above already
                above = problem[rng.integers(len(problem))].A
                A[0] = above[0]
            problem.append(equal(A, rng.standard_normal(m)))
        answer = hierarchy(problem, solver)
        largest = max(largest, gap(answer.x, projection(problem)))
        reports = Projection().solve(built(problem)).levels
        assert [r.rank for r in answer.levels] == [r.rank for r in reports]
        ranks.add(sum(r.rank for r in reports) < n)
    record_property("largest_gap", float(largest))
    assert ranks == {True, False}  # with freedom left over, and without
    assert largest <= TOL


@pytest.mark.parametrize("solver", SOLVERS)
def test_limits_that_are_not_reached_change_nothing(solver, record_property):
    largest = 0.0
    for seed in range(50):
        rng = np.random.default_rng(seed)
        tasks = [equal(conditioned(rng, m, 11), rng.standard_normal(m)) for m in (3, 3, 11)]
        x = projection(tasks)
        limits = Rows(np.eye(11), x - rng.exponential(size=11), x + rng.exponential(size=11))
        answer = hierarchy([limits, *tasks], solver)
        assert not answer.limit_active
        largest = max(largest, gap(answer.x, x))
    record_property("largest_gap", float(largest))
    assert largest <= TOL


# ---------------------------------------------------------------- damped QP = SR-inverse form


def damped(J, rate, rest, damping):
    """argmin ‖J q̇ − ẋ‖² + λ‖q̇ − q̇_c‖², as one level of stacked rows."""
    root = np.sqrt(damping)
    return equal(np.vstack([J, root * np.eye(J.shape[1])]), np.concatenate([rate, root * rest]))


@pytest.mark.parametrize("damping", DAMPINGS)
@pytest.mark.parametrize("shape", [(9, 11), (9, 7), (3, 11), (1, 1)])
def test_one_damped_level_is_the_sr_inverse_form(shape, damping):
    """q̇ = J*ẋ + (I − J*J) q̇_c (eq. 13), because I − J*J = λ(JᵀJ + λI)⁻¹."""
    m, n = shape
    for seed in range(3):
        rng = np.random.default_rng(seed)
        J, rate, rest = conditioned(rng, m, n), rng.standard_normal(m), rng.standard_normal(n)
        x = hierarchy([damped(J, rate, rest, damping)], SOLVERS[seed % 2]).x
        # (JᵀJ + λI)⁻¹Jᵀ = Jᵀ(JJᵀ + λI)⁻¹; the smaller of both is the better conditioned.
        if m <= n:
            star = sr_inverse(J, damping)
        else:
            star = np.linalg.solve(J.T @ J + damping * np.eye(n), J.T)
        assert gap(x, star @ rate + (np.eye(n) - star @ J) @ rest) <= TOL
        two = [equal(J, rate), equal(np.eye(n), rest)]
        assert gap(x, projection(two, damping)) <= TOL


def test_the_damped_form_holds_at_a_singularity_too():
    rng = np.random.default_rng(0)
    J = conditioned(rng, 6, 9)
    J[5] = J[0] - 2 * J[1]
    rate, rest = rng.standard_normal(6), rng.standard_normal(9)
    for damping in (1e-4, 1e-2, 1.0, 1e2):
        star = sr_inverse(J, damping)
        x = hierarchy([damped(J, rate, rest, damping)]).x
        assert gap(x, star @ rate + (np.eye(9) - star @ J) @ rest) <= TOL


# ---------------------------------------------------------------- strict − damped = O(λ)


@pytest.mark.parametrize("damping", [1e-6, 1e-2, 10.0])
def test_levels_damped_one_after_the_other_are_the_damped_projection(damping):
    for seed in range(30):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(3, 12))
        sizes = rng.integers(1, 4, size=rng.integers(1, 4))
        problem = [equal(conditioned(rng, m, n), rng.standard_normal(m)) for m in sizes]
        reference = np.zeros(n)
        if len(sizes) > 1 and rng.random() < 0.5:
            reference = rng.standard_normal(n)
            problem.append(equal(np.eye(n), reference))
        elif len(sizes) > 1 and sizes[-1] >= n:
            continue  # Projection would take the last level's answer as the reference
        hqp = HQP()
        levels = hqp.damped(built(problem), damping, reference)
        answer = hqp.solve(levels)
        assert answer.is_optimal(levels)
        assert gap(answer.x, projection(problem, damping)) < TOL


def test_damped_and_strict_differ_by_a_constant_times_the_damping():
    """q̇_λ − q̇_0 = −λ Jᵀ(JJᵀ)⁻¹(JJᵀ + λI)⁻¹(ẋ − J q̇_c): the slope in log-log is one.

    Over dampings up to λ it differs from one by less than λ/σ², σ the smallest singular value.
    """
    dampings = np.array([10.0**k for k in range(-8, -2)])
    for seed in range(5):
        rng = np.random.default_rng(seed)
        J, rate, rest = conditioned(rng, 9, 11), rng.standard_normal(9), rng.standard_normal(11)
        strict = hierarchy([equal(J, rate), equal(np.eye(11), rest)]).x
        answers = [hierarchy([damped(J, rate, rest, d)]).x for d in dampings]
        gaps = [np.linalg.norm(x - strict) for x in answers]
        slope = np.polyfit(np.log(dampings), np.log(gaps), 1)[0]
        assert abs(slope - 1.0) < dampings[-1] / np.linalg.svd(J)[1][-1] ** 2
        gram = J @ J.T
        for damping, x in zip(dampings, answers, strict=True):
            miss = np.linalg.solve(gram + damping * np.eye(9), rate - J @ rest)
            assert gap(x - strict, -damping * J.T @ np.linalg.solve(gram, miss)) <= TOL


# ---------------------------------------------------------------- eq. 11


class Contacts:
    """k contacts of a sphere of radius r, or of planes: eq. 1–6 about the contact centroid."""

    def __init__(self, rng, k=3, radius=0.05):
        n = rng.standard_normal((k, 3))
        n /= np.linalg.norm(n, axis=1)[:, None]
        x = radius * n + 0.01 * rng.standard_normal((k, 3))
        c = x.mean(axis=0)
        tangent = [np.eye(3) - np.outer(v, v) for v in n]
        self.f = -n.sum(axis=0)
        self.m = np.cross(x - c, -n).sum(axis=0)
        self.J_f = np.hstack([-t / radius for t in tangent])
        self.J_m = np.hstack(
            [(cross(v) + cross(self.f) / k) @ t for v, t in zip(n, tangent, strict=True)]
        )

    @property
    def equation_11(self):
        """ẋ = −J_fᵀ(2f) + (I − J_f⁺J_f)(−2J_mᵀm), the projector on the nullspace of J_f."""
        N = np.eye(self.J_f.shape[1]) - np.linalg.pinv(self.J_f) @ self.J_f
        return -self.J_f.T @ (2 * self.f) + N @ (-2 * self.J_m.T @ self.m)

    @property
    def force_rate(self):
        return -2 * self.J_f @ self.J_f.T @ self.f


def cross(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("k", [2, 3, 4])
def test_equation_11_is_a_hierarchy_of_two_levels(k, solver):
    """J_f ẋ = −2J_fJ_fᵀf  ▷  ẋ = −2J_mᵀm."""
    for seed in range(20):
        c = Contacts(np.random.default_rng(seed), k)
        problem = [
            equal(c.J_f, c.force_rate),
            equal(np.eye(3 * k), -2 * c.J_m.T @ c.m),
        ]
        assert gap(hierarchy(problem, solver).x, c.equation_11) <= TOL
        assert gap(projection(problem), c.equation_11) <= TOL


@pytest.mark.parametrize("n", [9, 11, 15])
def test_composed_in_joint_space_it_is_equation_11_mapped_by_the_pseudoinverse(n):
    """J_fJ q̇ = −2J_fJ_fᵀf  ▷  J q̇ = −2J_mᵀm, where J has full row rank and no limit is active."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        c, J = Contacts(rng), conditioned(rng, 9, n)
        problem = [equal(c.J_f @ J, c.force_rate), equal(J, -2 * c.J_m.T @ c.m)]
        assert gap(hierarchy(problem).x, np.linalg.pinv(J) @ c.equation_11) <= TOL


def test_with_fewer_joints_than_contact_coordinates_only_joint_space_keeps_the_order():
    for seed in range(10):
        rng = np.random.default_rng(seed)
        c, J = Contacts(rng), conditioned(rng, 9, 6)
        problem = [equal(c.J_f @ J, c.force_rate), equal(J, -2 * c.J_m.T @ c.m)]
        mapped = np.linalg.pinv(J) @ c.equation_11
        answer = hierarchy(problem)
        size = np.linalg.norm(c.force_rate)
        assert np.linalg.norm(answer.levels[0].residual) <= TOL * size
        assert np.linalg.norm(c.J_f @ J @ mapped - c.force_rate) > 0.01 * size


def test_the_resolved_form_is_another_answer_by_design():
    """J_mJ q̇ = −2J_mJ_mᵀm as level 2 agrees with eq. 11 on force alone."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        c, J = Contacts(rng), conditioned(rng, 9, 11)
        moment = -2 * c.J_m @ c.J_m.T @ c.m
        resolved = hierarchy([equal(c.J_f @ J, c.force_rate), equal(c.J_m @ J, moment)]).x
        mapped = np.linalg.pinv(J) @ c.equation_11
        assert gap(c.J_f @ J @ resolved, c.J_f @ J @ mapped) <= TOL
        moments = [np.linalg.norm(c.J_m @ J @ q - moment) for q in (resolved, mapped)]
        assert moments[0] < moments[1]
        assert np.linalg.norm(resolved - mapped) > 0.01 * np.linalg.norm(mapped)


# ---------------------------------------------------------------- with a limit active


def test_at_a_limit_the_hierarchy_keeps_the_first_level_and_clipping_does_not():
    """x₁ + x₂ = 1.6 ▷ x = (1.6, 0) within |x| ≤ 1: the projection leaves the box along x₁."""
    tasks = [equal([[1, 1]], [1.6]), equal(np.eye(2), [1.6, 0])]
    clipped = np.clip(projection(tasks), -1, 1)
    answer = hierarchy([box(2, 1.0), *tasks])
    assert answer.limit_active
    np.testing.assert_allclose(answer.x, [1.0, 0.6], rtol=0, atol=TOL)
    np.testing.assert_allclose(clipped, [1.0, 0.0], rtol=0, atol=TOL)
    np.testing.assert_allclose(answer.levels[1].residual, [0.0], rtol=0, atol=TOL)
    np.testing.assert_allclose(clipped.sum() - 1.6, -0.6, rtol=0, atol=TOL)


@pytest.mark.parametrize("solver", SOLVERS)
def test_no_clipped_projection_meets_the_first_level_better_than_the_hierarchy(solver):
    better = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        first, rest = conditioned(rng, 3, 11), rng.standard_normal(11)
        tasks = [equal(first, 0.3 * rng.standard_normal(3)), equal(np.eye(11), 0.3 * rest)]
        answer = hierarchy([box(11, 0.25), *tasks], solver)
        ours = np.linalg.norm(answer.levels[1].residual)
        for damping in (0.0, 1e-3, 1e-1):
            clipped = np.clip(projection(tasks, damping), -0.25, 0.25)
            theirs = np.linalg.norm(first @ clipped - tasks[0].lower)
            assert ours <= theirs + TOL
            better += ours < theirs - 0.01
        assert np.abs(answer.x).max() <= 0.25 + TOL
    assert better > 60


# ---------------------------------------------------------------- on grasps felt


@pytest.fixture(scope="module")
def probe():
    return hg.GeometricProbe(cylinder.scene)


def serves_at_least_as_well(levels, x, other):
    """True where x misses the first level that tells them apart by less than `other` does."""
    for level in levels:
        ours, theirs = (np.linalg.norm(level.residual(step)) for step in (x, other))
        if abs(ours - theirs) > TOL:
            return ours < theirs
    return True


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(
    ("cap", "tight"),
    [(hg.StepLimit(1.5, 0.3), False), (hg.StepLimit(0.1, 0.01), True)],
    ids=["wide", "tight"],
)
def test_on_grasps_felt_the_forms_agree_unless_a_limit_holds_and_then_none_is_better(
    cap, tight, solver, probe
):
    hqp = HQP(solver, rank_tolerance=TOUCH_RANK)
    ranges = hg.ConfigurationLimit(cylinder.scene.articulated)
    stack = hg.stack_of("fmk").within(cap, ranges)
    agreed = held = 0
    for seed in range(2):
        for grasp in hg.Trial(cylinder.scene, stack, probes=8).run(seed, probe).grasps:
            levels, laws = stack.levels(grasp), stack.law_levels(grasp)
            solution = hqp.solve(levels)
            assert solution.is_optimal(levels)
            strict = Projection(rank_tolerance=TOUCH_RANK).solve(laws).x
            if solution.limit_active:
                held += 1
                for x in (strict, Projection(damping=SR_DAMPING).solve(laws).x):
                    clipped = clip_to_limits(x, stack, grasp)
                    assert serves_at_least_as_well(levels, solution.x, clipped)
            else:
                agreed += 1
                away = solution.x - strict
                assert np.abs(away).max() < TOL
                assert max(np.abs(level.A @ away).max() for level in laws) < TOL
    assert held > agreed if tight else agreed > held
