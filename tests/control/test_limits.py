"""Limits: what they allow, in which unit, and how a start outside a range walks back."""

import itertools

import mink
import mujoco
import numpy as np
import pytest
import tiny_hand

from hqp_grasp.control.limits import ConfigurationLimit, StepLimit, VelocityLimit
from hqp_grasp.errors import InputError
from hqp_grasp.grasp import Contact, Grasp
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.tasks import MinkLimit, PostureTask, Priority
from hqp_grasp.tasks.stack import Stack
from hqp_grasp.world.scene import Cylinder, Scene

EXACT = 1e-12
STEP_TOL = 1e-10  # [–], [rad] rounding of a solve
JOINT, CONTACT = 0.25, 0.02  # caps [rad], [m]


@pytest.fixture(scope="module")
def scene():
    return Scene()


@pytest.fixture(scope="module")
def robot(scene):
    return scene.articulated


@pytest.fixture(scope="module")
def data(scene):
    return mujoco.MjData(scene.model)


def grasp_at(robot, q):
    """A grasp at q wherever the tips are, the object's shape being no matter to a limit."""
    contacts = [Contact(x, [0.0, 0.0, 1.0]) for x in robot.centers(q)]
    return Grasp(
        q,
        contacts,
        robot.jacobian(q),
        hessian=robot.hessian(q),
        coupling=robot.coupling,
        offset=robot.offset,
    )


def walk(stack, robot, q, steps):
    """q after each of `steps` solved steps, the start first."""
    path = [np.array(q)]
    for _ in range(steps):
        levels = stack.levels(grasp_at(robot, path[-1]))
        path.append(path[-1] + HQP().solve(levels).x)
    return path


# ---------------------------------------------------------------- caps


def test_a_step_limits_rows_are_shares_of_its_caps(robot):
    grasp = grasp_at(robot, robot.home)
    level = StepLimit(JOINT, CONTACT).level(grasp)
    np.testing.assert_array_equal(level.lower, -1.0)
    np.testing.assert_array_equal(level.upper, 1.0)
    x = np.random.default_rng(0).standard_normal(robot.n)
    shares = np.concatenate([x / JOINT, grasp.jacobian @ x / CONTACT])
    np.testing.assert_allclose(level.A @ x, shares, atol=EXACT)
    assert level.is_inequality


def test_a_cap_of_infinity_caps_nothing(robot):
    grasp = grasp_at(robot, robot.home)
    assert StepLimit(np.inf, CONTACT).level(grasp).A.shape == (9, robot.n)
    assert StepLimit(JOINT, np.inf).level(grasp).A.shape == (robot.n, robot.n)
    assert StepLimit(np.inf, np.inf).level(grasp).A.shape == (0, robot.n)


def test_a_hierarchy_with_an_empty_cap_is_solved(robot):
    stack = Stack.of(PostureTask(robot.home + 0.1)).within(StepLimit(np.inf, np.inf))
    levels = Stack(stack.priorities, stack.limits, hold_contacts=False).levels(
        grasp_at(robot, robot.home)
    )
    np.testing.assert_allclose(HQP().solve(levels).x, 0.1, atol=STEP_TOL)


def test_a_velocity_limits_rows_are_shares_of_what_a_probes_time_allows(robot):
    grasp = grasp_at(robot, robot.home)
    level = VelocityLimit(robot.velocity, 0.2).level(grasp)
    x = 0.2 * robot.velocity
    np.testing.assert_allclose(level.A @ x, 1.0, atol=EXACT)
    np.testing.assert_array_equal(level.lower, -1.0)
    np.testing.assert_array_equal(level.upper, 1.0)


def test_caps_always_leave_the_robot_where_it_is(robot):
    """Also far outside its ranges, where x = 0 breaks a range."""
    rng = np.random.default_rng(1)
    caps = (
        StepLimit(),
        StepLimit(1e-6, 1e-9),
        VelocityLimit(robot.velocity, 1e-3),
        MinkLimit(mink.VelocityLimit(robot.model, {"wam_j1": 0.5, "bhand_f1_distal": 0.5})),
    )
    for limit, _ in itertools.product(caps, range(5)):
        level = limit.level(grasp_at(robot, rng.normal(0.0, 3.0, robot.n)))
        assert limit.priority is Priority.CAP
        assert (level.lower <= 0.0).all() and (level.upper >= 0.0).all()
        np.testing.assert_array_equal(level.residual(np.zeros(robot.n)), 0.0)


@pytest.mark.parametrize("bad", [0.0, -0.1, np.nan, -np.inf, None, "short"])
@pytest.mark.parametrize("cap", ["joint", "contact"])
def test_a_cap_is_above_zero(cap, bad):
    with pytest.raises(InputError, match=rf"StepLimit\.{cap} must be (a number|above 0); got"):
        StepLimit(**{cap: bad})


@pytest.mark.parametrize(
    ("velocity", "dt", "message"),
    [
        ([1.0, 0.0], 1.0, "above 0"),
        ([1.0, -1.0], 1.0, "above 0"),
        ([1.0, 1.0], 0.0, "above 0"),
        ([1.0, 1.0], np.nan, "above 0"),
        ([1.0, 1.0], np.inf, "above 0"),
        ([1.0, np.nan], 1.0, r"VelocityLimit\.velocity must be finite"),
        ([[1.0, 1.0]], 1.0, r"VelocityLimit\.velocity must have shape"),
        (["fast"], 1.0, r"VelocityLimit\.velocity must be an array of numbers"),
    ],
)
def test_a_velocity_limit_has_velocities_and_a_time_above_zero(velocity, dt, message):
    with pytest.raises(InputError, match=message):
        VelocityLimit(velocity, dt)


def test_limits_of_another_robot_are_refused(robot):
    grasp = grasp_at(robot, robot.home)
    with pytest.raises(InputError, match="the grasp has 15 joints, bhand 8"):
        ConfigurationLimit(Scene("bhand").articulated).level(grasp)


def test_velocities_of_another_robot_are_refused(robot):
    grasp = grasp_at(robot, robot.home)
    with pytest.raises(InputError, match=r"[Vv]elocit.*2.*11|11.*2 velocit"):
        VelocityLimit([1.0, 1.0], 1.0).level(grasp)


# ---------------------------------------------------------------- ranges


def test_a_range_covers_every_joint_independent_or_coupled(robot):
    rng = np.random.default_rng(2)
    for q in rng.uniform(robot.q_lower, robot.q_upper, size=(10, robot.n)):
        level = ConfigurationLimit(robot).level(grasp_at(robot, q))
        assert level.A.shape == (robot.model.njnt, robot.n)
        for x in rng.normal(0.0, 1.0, size=(10, robot.n)):
            full = robot.coupling @ (q + x) + robot.offset
            outside = np.maximum(robot.lower - full, 0) + np.maximum(full - robot.upper, 0)
            np.testing.assert_allclose(np.abs(level.residual(x)), outside, atol=EXACT * 10)


def test_joints_without_a_range_have_no_row(tmp_path):
    xml = tiny_hand.change(tiny_hand.XML, ' range="-0.1 0.8"', "")
    scene = Scene(tiny_hand.write(tmp_path, xml), Cylinder(0.02), (0.1, 0.1, 0.0))
    robot = scene.articulated
    level = ConfigurationLimit(robot).level(grasp_at(robot, robot.home))
    np.testing.assert_array_equal(level.A, np.eye(2))


def free(task, *limits):
    """One law within limits, contacts free to leave."""
    return Stack(((task,),), hold_contacts=False).within(*limits)


def test_a_law_that_pulls_out_of_a_range_is_stopped_at_its_end(robot):
    rng = np.random.default_rng(3)
    for q in rng.uniform(robot.q_lower, robot.q_upper, size=(5, robot.n)):
        target = q + rng.normal(0.0, 10.0, robot.n)
        stack = free(PostureTask(target), StepLimit(JOINT, np.inf), ConfigurationLimit(robot))
        for here in walk(stack, robot, q, 20):
            assert robot.violation(here) <= EXACT * 10


def test_the_distal_joints_range_binds_while_the_proximal_joint_has_room(robot):
    """The distal range of 45° ends the closing at 135°, five degrees before the proximal's."""
    proximal = robot.index("bhand_f1_proximal")
    names = [robot.model.joint(j).name for j in range(robot.model.njnt)]
    own, distal = names.index("bhand_f1_proximal"), names.index("bhand_f1_distal")
    q, target = robot.home.copy(), robot.home.copy()
    q[proximal], target[proximal] = np.radians(130.0), np.radians(139.0)
    assert target[proximal] < robot.upper[own]
    stack = free(PostureTask(target), StepLimit(JOINT, np.inf), ConfigurationLimit(robot))
    grasp = grasp_at(robot, q)
    levels = stack.levels(grasp)
    solution = HQP().solve(levels)
    full = robot.coupling @ (q + solution.x) + robot.offset
    assert full[distal] == pytest.approx(robot.upper[distal], abs=STEP_TOL)
    assert full[own] == pytest.approx(np.radians(135.0), abs=STEP_TOL)
    assert full[own] < robot.upper[own] - 0.08
    assert solution.limit_active
    assert solution.is_optimal(levels)


def test_a_start_outside_its_ranges_walks_back_within_the_caps(robot):
    rng = np.random.default_rng(4)
    limits = (StepLimit(JOINT, np.inf), ConfigurationLimit(robot))
    for _ in range(5):
        q = rng.uniform(robot.q_lower, robot.q_upper)
        for j in rng.choice(robot.n, size=3, replace=False):
            away = rng.uniform(0.3, 1.2)
            q[j] = robot.q_upper[j] + away if rng.uniform() < 0.5 else robot.q_lower[j] - away
        assert robot.violation(q) > 0.09
        # The law wants to go the other way, further out.
        path = walk(free(PostureTask(q + (q - robot.home)), *limits), robot, q, 8)
        violations = [robot.violation(here) for here in path]
        assert all(
            after < before or after <= STEP_TOL for before, after in itertools.pairwise(violations)
        )
        assert violations[-1] <= STEP_TOL
        for here, there in itertools.pairwise(path):
            assert np.abs(there - here).max() <= JOINT * (1 + STEP_TOL)


def test_the_walk_back_takes_the_caps_in_full(robot):
    """One radian outside at a quarter a step: four steps, no more."""
    q = robot.home.copy()
    q[0] = robot.q_upper[0] + 1.0
    limits = (StepLimit(JOINT, np.inf), ConfigurationLimit(robot))
    path = walk(free(PostureTask(), *limits), robot, q, 5)
    violations = [robot.violation(here) for here in path]
    np.testing.assert_allclose(violations, [1.0, 0.75, 0.5, 0.25, 0.0, 0.0], atol=STEP_TOL)


def test_the_walk_back_keeps_the_contact_caps_too(robot):
    q = robot.home.copy()
    q[robot.index("bhand_f2_proximal")] = robot.q_upper[robot.index("bhand_f2_proximal")] + 0.5
    q[1] = robot.q_upper[1] + 0.05
    path = walk(
        free(PostureTask(), StepLimit(JOINT, CONTACT), ConfigurationLimit(robot)),
        robot, q, 25,
    )  # fmt: skip
    violations = [robot.violation(here) for here in path]
    assert all(b < a or b <= STEP_TOL for a, b in itertools.pairwise(violations))
    assert violations[-1] <= STEP_TOL
    for here, there in itertools.pairwise(path):
        motion = robot.jacobian(here) @ (there - here)
        assert np.abs(motion).max() <= CONTACT * (1 + STEP_TOL)
        assert np.abs(there - here).max() <= JOINT * (1 + STEP_TOL)


# ---------------------------------------------------------------- mink's limits


def test_minks_ranges_are_ours_where_its_gain_is_one(scene, robot):
    theirs = MinkLimit(mink.ConfigurationLimit(scene.model, gain=1.0))
    assert theirs.priority is Priority.RANGE
    ours = ConfigurationLimit(robot)
    rng = np.random.default_rng(5)
    for q in rng.uniform(robot.q_lower, robot.q_upper, size=(5, robot.n)):
        grasp = grasp_at(robot, q)
        for x in rng.normal(0.0, 1.0, size=(10, robot.n)):
            one, two = theirs.level(grasp).residual(x), ours.level(grasp).residual(x)
            m = len(two)  # mink states upper ends, then lower ends negated
            np.testing.assert_allclose(one[:m] - one[m:], two, atol=EXACT * 10)


def test_minks_velocities_bound_coupled_joints_through_their_drivers(scene, robot):
    limit = mink.VelocityLimit(scene.model, {"wam_j2": 0.5, "bhand_f3_distal": 0.3})
    taken = MinkLimit(limit, dt=0.1)
    assert taken.priority is Priority.CAP
    level = taken.level(grasp_at(robot, robot.home))
    x = np.zeros(robot.n)
    x[1], x[robot.index("bhand_f3_proximal")] = 0.05, 0.09  # a third of which is 0.3 · 0.1
    np.testing.assert_allclose(level.A @ x, [0.05, 0.03, -0.05, -0.03], atol=EXACT)
    np.testing.assert_allclose(level.upper, [0.05, 0.03, 0.05, 0.03], atol=EXACT)
    np.testing.assert_array_equal(level.lower, -np.inf)


def test_minks_clearance_tells_how_near_a_step_brings_two_shapes(scene, robot, data):
    """To first order: G C x is the loss of distance."""
    limit = mink.CollisionAvoidanceLimit(
        scene.model,
        [(["f3_distal"], ["object"])],
        gain=1.0,
        minimum_distance_from_collisions=0.0,
        collision_detection_distance=1.0,
    )
    taken = MinkLimit(limit)
    assert taken.priority is Priority.CLEARANCE
    link, other = scene.model.geom("f3_distal").id, scene.model.geom("object").id

    def distance(q):
        robot.place(data, q)
        return mujoco.mj_geomDistance(scene.model, data, link, other, 1.0, None)

    level = taken.level(grasp_at(robot, robot.home))
    assert level.A.shape == (1, robot.n)
    assert level.upper[0] == pytest.approx(distance(robot.home), abs=1e-9)
    rng = np.random.default_rng(6)
    for x in rng.normal(0.0, 1.0, size=(5, robot.n)):
        ahead, behind = distance(robot.home + 1e-4 * x), distance(robot.home - 1e-4 * x)
        assert (level.A @ x)[0] == pytest.approx((behind - ahead) / 2e-4, abs=1e-4)


def test_shapes_beyond_minks_detection_distance_have_no_row(scene, robot):
    limit = mink.CollisionAvoidanceLimit(
        scene.model, [(["wam_base"], ["object"])], collision_detection_distance=1e-3
    )
    level = MinkLimit(limit).level(grasp_at(robot, robot.home))
    assert level.A.shape == (0, robot.n) and level.upper.shape == (0,)


def test_a_mink_limit_without_content_has_no_row(scene, robot):
    level = MinkLimit(mink.VelocityLimit(scene.model)).level(grasp_at(robot, robot.home))
    assert level.A.shape == (0, robot.n)


def test_a_mink_limit_that_keeps_no_model_is_asked_for_one(scene, robot):
    class Still(mink.Limit):
        def compute_qp_inequalities(self, configuration, dt):
            nv = configuration.model.nv
            return mink.Constraint(G=np.eye(nv), h=np.full(nv, dt))

    with pytest.raises(InputError, match=r"Still keeps no model: pass MinkLimit\(limit, model\)"):
        MinkLimit(Still())
    level = MinkLimit(Still(), scene.model, dt=0.5).level(grasp_at(robot, robot.home))
    np.testing.assert_array_equal(level.A, robot.coupling)
    np.testing.assert_array_equal(level.upper, 0.5)


def test_a_model_that_is_given_is_taken_before_the_limits_own(scene, robot):
    own, given = mink.ConfigurationLimit(scene.model), Scene().model
    assert MinkLimit(own, given).model is given and MinkLimit(own).model is scene.model
    assert MinkLimit(mink.VelocityLimit(scene.model)).model is None  # and it needs none
    assert MinkLimit(own).dt == 1.0


def test_a_hierarchy_keeps_minks_limits(scene, robot):
    """Towards a posture far beyond a mink cap: the step is the cap, and certified."""
    limit = mink.VelocityLimit(scene.model, {"wam_j1": 0.1})
    levels = free(PostureTask(robot.home + 1.0), limit).levels(grasp_at(robot, robot.home))
    solution = HQP().solve(levels)
    np.testing.assert_allclose(solution.x, [0.1] + [1.0] * 10, atol=STEP_TOL)
    assert solution.is_optimal(levels)
