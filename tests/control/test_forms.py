"""The forms of a step: what they share, and what they report of it."""

import dataclasses

import numpy as np
import pytest

from hqp_grasp.control.episode import Episode, MissPolicy
from hqp_grasp.control.forms import (
    FORMS,
    HierarchyForm,
    MemorylessForm,
    PaperHierarchyForm,
    cap_ratio,
    clip_to_limits,
    form_of,
)
from hqp_grasp.control.limits import ConfigurationLimit, RetreatLimit, StepLimit
from hqp_grasp.control.targets import Target
from hqp_grasp.grasp import Contact, Grasp, Miss, Missed, Touch
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.hierarchy.projection import Projection
from hqp_grasp.surface.believed import believed
from hqp_grasp.surface.felt import Felt
from hqp_grasp.tasks import ForceTask, Stack, stack_of
from hqp_grasp.world.scene import Scene

SEEDS = range(5)
EXACT = 1e-12
WIDE = StepLimit(1e3, 1e3)
AROUND = np.array([[1.0, 0.1, 0.0], [-0.4, 0.9, 0.0], [-0.5, -0.8, 0.0]])


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


def walls(*grasps):
    return believed(Felt.of([Touch(g.q, g) for g in grasps]), grasps[-1], 1e-3)


def alone(grasp):
    """The episode of a grasp and nothing before."""
    return Episode.of([Touch(grasp.q, grasp)])


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
    plan = MemorylessForm(Beside(rank_tolerance=1e-6)).plan(
        stack_of("fmk").within(WIDE), alone(grasp)
    )
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
        form_of(name).plan(stack, alone(hand(seed, normals))).x
        for normals in (faces, faces + noise)
    )
    assert np.abs(felt - exact).max() < 1e-4 * (1.0 + np.abs(exact).max())


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("above", ["", "f", "m"])
def test_what_stands_below_the_kinematic_law_is_never_felt(above, seed):
    grasp = hand(seed, np.random.default_rng(seed).standard_normal((3, 3)))
    above_it, more = (
        stack_of(f"{above}k{v}").within(WIDE) for v in ("", "m" if above != "m" else "f")
    )
    form = MemorylessForm()
    np.testing.assert_allclose(
        form.plan(more, alone(grasp)).x, form.plan(above_it, alone(grasp)).x, atol=EXACT
    )


# ---------------------------------------------------------------- answers that are not certified


@dataclasses.dataclass(frozen=True)
class Unsure(HQP):
    """A solver that certifies hierarchies of so many levels, and returns rubbish beyond."""

    levels: int = 0

    def solve(self, levels, warm=None):
        solution = super().solve(levels, warm)
        if len(levels) <= self.levels:
            return solution
        return dataclasses.replace(solution, x=solution.x + 0.3, certified=False)


FORMS_THAT_SOLVE = [MemorylessForm, PaperHierarchyForm, HierarchyForm]


@pytest.mark.parametrize("form", FORMS_THAT_SOLVE)
def test_where_no_answer_is_certified_the_hand_stays(form):
    stack, grasp = stack_of("fmk").within(WIDE), hand(0, AROUND)
    plan = form(Unsure(rank_tolerance=1e-6)).plan(stack, alone(grasp))
    np.testing.assert_array_equal(plan.x, np.zeros(grasp.n))
    assert plan.reason == "the hand stays: no answer is certified" and plan.gap is None


def test_the_last_laws_are_left_out_until_the_answer_of_the_first_is_certified():
    grasp, limits = hand(0, AROUND), StepLimit(0.35, 0.03)
    whole = form_of("memoryless").plan(stack_of("fmk").within(limits), alone(grasp))
    certified = MemorylessForm(Unsure(rank_tolerance=1e-6, levels=3))  # caps, contact, force
    plan = certified.plan(stack_of("fmk").within(limits), alone(grasp))
    assert plan.solution.certified and plan.gap is None
    assert plan.reason == "without moment and kinematic: their answer is not certified"
    force = ForceTask().jacobian(grasp)
    np.testing.assert_allclose(force @ plan.x, force @ whole.x, atol=1e-9)
    assert cap_ratio(plan.x, stack_of("f").within(limits), grasp) <= 1.0 + 1e-9


def test_a_way_back_that_is_not_certified_is_not_taken():
    stack, good = stack_of("fmk").within(WIDE), hand(0, AROUND)
    there = Touch(good.q + 0.1, dataclasses.replace(good, q=good.q + 0.1))
    history = [Touch(good.q, good), there]
    plan = HierarchyForm().plan(stack, Episode.of(history, budget=3))
    assert plan.planner == "return to the best grasp" and np.abs(plan.x).max() > 0.05
    stays = HierarchyForm(Unsure(rank_tolerance=1e-6)).plan(stack, Episode.of(history, budget=3))
    np.testing.assert_array_equal(stays.x, np.zeros(good.n))
    assert "no answer is certified" in stays.reason


# ---------------------------------------------------------------- which rule planned


@pytest.mark.parametrize("name", FORMS)
def test_a_plan_says_which_rule_planned_it(name):
    grasp = hand(0, AROUND)
    planner = form_of(name).plan(stack_of("fm").within(WIDE), alone(grasp)).planner
    assert planner == ("surface felt" if name == "hierarchy" else name)


@pytest.mark.parametrize(("laws", "k"), [("k", 3), ("k", 2), ("fmk", 1)])
def test_the_default_form_says_where_it_is_the_memoryless_one(laws, k):
    stack, grasp = (
        stack_of(laws).within(WIDE),
        hand(1, np.random.default_rng(0).normal(size=(k, 3))),
    )
    plan, plain = (form_of(name).plan(stack, alone(grasp)) for name in ("hierarchy", "memoryless"))
    assert plan.planner == plain.planner == "memoryless"
    np.testing.assert_array_equal(plan.x, plain.x)


def pushing(degrees, n=11):
    """A hand whose flexions push at that angle to the normals, to the side."""
    grasp = hand(0, AROUND, n)
    J = np.array(grasp.jacobian).reshape(3, 3, n)
    for i, normal in enumerate(grasp.normals):
        aside = np.cross(normal, [0.0, 0.0, 1.0])
        aside /= np.linalg.norm(aside)
        t = np.radians(degrees)
        J[i, :, n - 3 + i] = 0.1 * (-np.cos(t) * normal + np.sin(t) * aside)
    return dataclasses.replace(grasp, jacobian=J.reshape(9, n))


@pytest.mark.parametrize(
    ("degrees", "before", "misses", "planner"),
    [
        (50, 9, 0, "paper-hierarchy"),
        (40, 9, 0, "surface felt"),
        (50, 10, 0, "surface felt"),  # that is the eleventh touch
        (50, 3, 1, "surface felt"),
    ],
)
def test_in_the_first_ten_touches_fingers_that_push_aside_are_turned_first(
    degrees, before, misses, planner
):
    aside = pushing(degrees)
    off = [dataclasses.replace(aside, q=aside.q + 0.01 * i) for i in range(before)]
    missed = [Touch(aside.q, Missed(Miss.NO_TOUCH, "finger_1"))] * misses
    history = [*(Touch(g.q, g) for g in off), Touch(aside.q, aside), *missed]
    stack = stack_of("fmk").within(WIDE)
    assert HierarchyForm().plan(stack, Episode.of(history)).planner == planner
    # By the kinematic law's angle alone: without it nobody asks.
    for other in (stack_of("fm"), stack_of("fmk", "eq7")):
        assert HierarchyForm().plan(other.within(WIDE), alone(aside)).planner == "surface felt"


def test_the_default_form_tries_eight_shares_and_begins_again_and_others_do_not():
    assert HierarchyForm().misses.shares == (1.0, 0.5, 0.25, 0.1, 1.0, 0.5, 0.25, 0.1)
    assert HierarchyForm().misses.restart
    for name in FORMS[1:]:
        assert form_of(name).misses == MissPolicy()


def test_a_form_has_the_solver_that_is_named_and_the_papers_damping():
    for name in FORMS[:3]:
        assert form_of(name, "daqp").hqp == HQP("daqp", rank_tolerance=1e-6)
        assert form_of(name).hqp.solver == "proxqp"
    assert form_of("clipped").projection == Projection(rank_tolerance=1e-6)
    assert form_of("paper").projection == Projection(damping=1e-5)


def test_the_way_is_led_by_the_smallest_gain_of_its_laws_and_never_beyond_it():
    """Half of the force's error is asked for, by a law that asks for half."""
    grasp = hand(0, AROUND)
    error = ForceTask().error(grasp)
    left = {}
    for gain in (0.5, 1.0, 2.0):
        stack = Stack.of(ForceTask(gain=gain)).within(WIDE)
        plan = HierarchyForm().plan(stack, alone(grasp))
        assert plan.planner == "surface felt"
        left[gain] = error + ForceTask().jacobian(grasp) @ plan.x
    surface = walls(grasp)
    for gain in (0.5, 1.0):
        way = Target.each(surface, stack_of("f"), grasp)[0].way.at(gain)
        np.testing.assert_allclose(
            HierarchyForm().plan(Stack.of(ForceTask(gain=gain)).within(WIDE), alone(grasp)).x
            @ np.array(grasp.jacobian).T,
            (way[0] - grasp.centers).ravel(),
            atol=2e-6,  # the solver's, of 4 cm
        )
    np.testing.assert_allclose(left[2.0], left[1.0], atol=1e-4)


@pytest.mark.parametrize("name", FORMS)
def test_the_time_of_a_step_is_told_in_microseconds(name, monkeypatch):
    ticks = iter(np.arange(0.0, 100.0, 0.25))
    monkeypatch.setattr("time.perf_counter", lambda: next(ticks))
    plan = form_of(name).plan(stack_of("fm").within(WIDE), alone(hand(0, AROUND)))
    assert plan.solve_us == (7.5e5 if name == "hierarchy" else 2.5e5)


def test_a_clipped_step_keeps_clear_by_the_least_way_and_then_to_the_ranges():
    robot = Scene().articulated
    grasp = robot.grasp(robot.home, [Contact(x, n) for x, n in zip(AROUND, np.eye(3), strict=True)])
    away = RetreatLimit(robot, 0.01)
    stack = stack_of("f").within(StepLimit(0.35, 1.0), ConfigurationLimit(robot), away)
    x = clip_to_limits(np.zeros(robot.n), stack, grasp)
    level = away.level(grasp)
    np.testing.assert_allclose(level.A @ x, -0.01, atol=1e-9)
    np.testing.assert_allclose(x, np.linalg.pinv(level.A) @ [-0.01], atol=1e-9)
    far = clip_to_limits(
        np.full(robot.n, 9.0), stack_of("f").within(ConfigurationLimit(robot)), grasp
    )
    np.testing.assert_allclose(grasp.q + far, robot.q_upper)
    low = clip_to_limits(
        np.full(robot.n, -9.0), stack_of("f").within(ConfigurationLimit(robot)), grasp
    )
    np.testing.assert_allclose(grasp.q + low, robot.q_lower)
