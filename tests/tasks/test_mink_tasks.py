"""mink's tasks as laws of a stack, on a hand with couplings: its own rows, strict, told apart."""

from __future__ import annotations

import dataclasses
import pickle
from collections.abc import Callable

import mink
import mujoco
import numpy as np
import pytest
from mink.tasks import BaseTask, Objective

from hqp_grasp.control.controller import Controller
from hqp_grasp.control.limits import ConfigurationLimit, StepLimit
from hqp_grasp.errors import InputError
from hqp_grasp.experiments.fingerprint import Fingerprint
from hqp_grasp.experiments.trial import Trial
from hqp_grasp.grasp import Grasp, Touch
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.history import load_history, save_history
from hqp_grasp.tasks import ForceTask, MinkTask, MomentTask, PostureTask
from hqp_grasp.tasks.stack import Stack
from hqp_grasp.touch.geometric import GeometricProbe
from hqp_grasp.world.objects import Cylinder
from hqp_grasp.world.scene import Scene

POSTURE = (0.62, 1.12, -0.73, 1.96, 0.63, -0.41, 0.49, 0.21, 1.01, 0.99, 0.98)
STEP = 6e-6  # [rad] of central differences, ε^(1/3)
FD_TOL = 1e-7
AGREE = 1e-6  # [rad] mink damps with 1e-12, and its solver stops early
EXACT = 1e-9
RIGHT = 1e-6  # of the certificate

scene = Scene(object=Cylinder(0.05, height=0.4))
robot = scene.articulated
model = robot.model


def configuration_at(q: np.ndarray) -> mink.Configuration:
    return mink.Configuration(model, robot.coupling @ q + robot.offset)


@pytest.fixture(scope="module")
def grasp() -> Grasp:
    felt = GeometricProbe(scene).touch(np.array(POSTURE))
    assert isinstance(felt, Grasp)
    return felt


def targeted(task: mink.Task, **settings: float) -> mink.Task:
    """The task with a target some way from POSTURE."""
    at = configuration_at(np.array(POSTURE) + 0.1 * np.cos(np.arange(11)))
    task.set_target_from_configuration(at)
    for name, value in settings.items():
        setattr(task, name, value)
    return task


def kinetic(cost: float = 1e-3) -> BaseTask:
    task = mink.KineticEnergyRegularizationTask(cost)
    task.set_dt(1.0)
    return task


MAKE: dict[type, Callable[..., BaseTask]] = {
    mink.AxisAlignTask: lambda **s: targeted(mink.AxisAlignTask("palm", "site", cost=0.7), **s),
    mink.ComTask: lambda **s: targeted(mink.ComTask([1.0, 0.5, 2.0]), **s),
    mink.DampingTask: lambda: mink.DampingTask(model, cost=0.3),
    mink.DofFreezingTask: lambda: mink.DofFreezingTask(model, [0, 9]),
    mink.EqualityConstraintTask: lambda: mink.EqualityConstraintTask(model, cost=1.0),
    mink.FrameTask: lambda **s: targeted(mink.FrameTask("palm", "site", 1.0, 0.3), **s),
    mink.KineticEnergyRegularizationTask: kinetic,
    mink.LookAtTask: lambda **s: targeted(mink.LookAtTask("palm", "site", cost=0.5), **s),
    mink.PostureTask: lambda **s: targeted(mink.PostureTask(model, cost=0.2), **s),
    mink.RelativeFrameTask: lambda **s: targeted(
        mink.RelativeFrameTask("f1_tip", "geom", "palm", "site", [1.0, 0.0, 2.0], 0.4), **s
    ),
}
MOVING = [  # those with an error that changes with the joints
    *(mink.AxisAlignTask, mink.ComTask, mink.FrameTask, mink.LookAtTask),
    *(mink.PostureTask, mink.RelativeFrameTask),
]
every = pytest.mark.parametrize("kind", MAKE, ids=lambda kind: kind.__name__)
moving = pytest.mark.parametrize("kind", MOVING, ids=lambda kind: kind.__name__)


def at(grasp: Grasp, q: np.ndarray) -> Grasp:
    return dataclasses.replace(grasp, q=q)


def test_all_tasks_of_mink_are_tried_here():
    found = {v for v in vars(mink).values() if isinstance(v, type) and issubclass(v, BaseTask)}
    assert found - {mink.Task} == set(MAKE)


# ---------------------------------------------------------------- rows


@moving
def test_every_jacobian_is_the_derivative_of_its_error_by_the_independent_joints(kind, grasp):
    law = MinkTask(MAKE[kind]())
    J = law.jacobian(grasp)
    assert J.shape == (len(law.error(grasp)), 11)
    assert np.linalg.norm(law.error(grasp)) > 1e-3
    for j, step in enumerate(STEP * np.eye(11)):
        up, down = (law.error(at(grasp, grasp.q + s * step)) for s in (1, -1))
        np.testing.assert_allclose(J[:, j], (up - down) / (2 * STEP), atol=FD_TOL)


@every
def test_the_rows_are_minks_own_carried_over_to_the_independent_joints(kind, grasp):
    task = MAKE[kind]()
    A, b = MinkTask(task).rows(grasp)
    H, c = task.compute_qp_objective(configuration_at(grasp.q))
    C = robot.coupling
    np.testing.assert_allclose(A.T @ A, C.T @ H @ C, atol=EXACT)
    np.testing.assert_allclose(A.T @ b, -C.T @ c, atol=EXACT)
    twice = MinkTask(task, weight=2.0, gain=0.5).rows(grasp)
    np.testing.assert_allclose(twice[0], 2.0 * A, atol=EXACT)
    np.testing.assert_allclose(twice[1], b, atol=EXACT)


def test_couplings_are_kept_by_themselves_so_that_a_task_to_keep_them_has_nothing_to_do(grasp):
    A, b = MinkTask(MAKE[mink.EqualityConstraintTask]()).rows(grasp)
    assert np.abs(A).max() < EXACT and np.abs(b).max() < EXACT


def test_rows_without_a_cost_are_no_part_of_the_error(grasp):
    place = targeted(mink.FrameTask("palm", "site", position_cost=2.0, orientation_cost=0.0))
    whole = place.compute_error(configuration_at(grasp.q))
    np.testing.assert_allclose(MinkTask(place).error(grasp), whole[:3], atol=EXACT)


def test_a_target_set_anew_is_followed(grasp):
    com = targeted(mink.ComTask(1.0))
    law = MinkTask(com)
    before = law.rows(grasp)[1]
    com.set_target(com.target_com + np.array([0.0, 0.0, 0.1]))
    np.testing.assert_allclose(law.rows(grasp)[1] - before, [0.0, 0.0, 0.1], atol=EXACT)


# ---------------------------------------------------------------- against mink


def weighed(tasks: list[BaseTask]) -> Stack:
    """All tasks at one priority, and nothing above them: mink's own problem."""
    stack = Stack.of(tasks[0])
    for task in tasks[1:]:
        stack = stack + task
    return dataclasses.replace(stack, hold_contacts=False)


@pytest.mark.parametrize("lm_damping", [0.0, 0.5])
def test_tasks_at_one_priority_give_the_answer_of_mink(grasp, lm_damping):
    """With the couplings as mink's constraints; by its tasks with and without their damping."""
    tasks = [MAKE[kind](lm_damping=lm_damping) for kind in MOVING]
    tasks += [MAKE[mink.DampingTask](), kinetic()]
    x = HQP().solve(weighed(tasks).levels(grasp)).x
    theirs = mink.solve_ik(
        *(configuration_at(grasp.q), tasks, 1.0, "daqp"),
        limits=[],
        constraints=[mink.EqualityConstraintTask(model, cost=1.0)],
    )
    assert np.abs(x).max() > 0.05
    np.testing.assert_allclose(robot.coupling @ x, theirs, atol=AGREE)


def test_so_they_do_within_limits_that_cut_what_is_damped(grasp):
    place = targeted(mink.FrameTask("palm", "site", 1.0, 0.3, lm_damping=2.0))
    limits = [mink.VelocityLimit(model, {model.joint(j).name: 0.02 for j in range(model.njnt)})]
    stack = weighed([place]).within(*limits)
    solution = HQP().solve(stack.levels(grasp))
    assert solution.limit_active
    theirs = mink.solve_ik(
        *(configuration_at(grasp.q), [place], 1.0, "daqp"),
        limits=limits,
        constraints=[mink.EqualityConstraintTask(model, cost=1.0)],
    )
    np.testing.assert_allclose(robot.coupling @ solution.x, theirs, atol=AGREE)


def test_a_damping_leaves_the_freedom_that_its_task_does_not_see_to_laws_below(grasp):
    place = targeted(mink.FrameTask("palm", "site", 1.0, 0.0, lm_damping=2.0))
    alone, above = weighed([place]), weighed([place]) >> PostureTask(robot.home)
    A, b = MinkTask(place).rows(grasp)
    x, y = (HQP().solve(stack.levels(grasp)).x for stack in (alone, above))
    np.testing.assert_allclose(A @ x, A @ y, atol=EXACT)
    assert np.linalg.norm(A @ x - b) > 1e-3 and np.abs(x - y).max() > 1e-2


# ---------------------------------------------------------------- strictness


@every
def test_every_task_below_force_and_moment_is_certified_and_disturbs_neither(kind, grasp):
    limits = (StepLimit(), ConfigurationLimit(robot))
    above = (ForceTask() >> MomentTask()).within(*limits)
    stack = above >> MAKE[kind]() >> PostureTask(robot.home)
    levels = stack.levels(grasp)
    solution = HQP().solve(levels)
    assert solution.certified and solution.is_optimal(levels, RIGHT)
    alone = HQP().solve(above.levels(grasp))
    for one, other in zip(alone.levels, solution.levels, strict=False):
        np.testing.assert_allclose(
            np.linalg.norm(one.residual), np.linalg.norm(other.residual), atol=EXACT
        )


def test_weights_let_a_task_disturb_what_priorities_protect(grasp):
    """The same two tasks, which exclude each other: in order, and weighed as mink does."""
    here, there = (mink.FrameTask("palm", "site", cost, 0.0) for cost in (1.0, 0.1))
    palm = configuration_at(grasp.q).get_transform_frame_to_world("palm", "site").translation()
    for task, way in ((here, 0.02), (there, -0.02)):
        task.set_target(mink.SE3.from_translation(palm + np.array([way, 0.0, 0.0])))
    strict = HQP().solve((weighed([here]) >> MinkTask(there, name="there")).levels(grasp)).x
    mixed = mink.solve_ik(
        *(configuration_at(grasp.q), [here, there], 1.0, "daqp"),
        limits=[],
        constraints=[mink.EqualityConstraintTask(model, cost=1.0)],
    )
    W, e, _ = here.compute_qp_residual(configuration_at(grasp.q))
    assert np.linalg.norm(W @ robot.coupling @ strict - e) < EXACT
    assert np.linalg.norm(W @ mixed - e) > 1e-4


# ---------------------------------------------------------------- composition and names


def test_tasks_of_mink_compose_from_both_sides():
    com, place = MAKE[mink.ComTask](), MAKE[mink.FrameTask]()
    stack = com >> ForceTask() >> MomentTask() + place
    assert stack.name == "mink_com ▷ force ▷ moment + mink_frame_palm"
    assert (com + ForceTask()).name == "mink_com + force"
    assert (com >> (ForceTask() >> place)).name == "mink_com ▷ force ▷ mink_frame_palm"
    assert (com + Stack.of(place)).name == "mink_com + mink_frame_palm"
    assert all(isinstance(task, MinkTask) for task in Stack.of(com).tasks)
    assert Stack(((com,), (place, ForceTask()))).name == "mink_com ▷ mink_frame_palm + force"


def test_each_task_has_a_name_that_says_what_it_is_of():
    names = {kind.__name__: Stack.of(MAKE[kind]()).name for kind in MAKE}
    assert names == {
        "AxisAlignTask": "mink_axis_align_palm",
        "ComTask": "mink_com",
        "DampingTask": "mink_damping",
        "DofFreezingTask": "mink_dof_freezing",
        "EqualityConstraintTask": "mink_equality_constraint",
        "FrameTask": "mink_frame_palm",
        "KineticEnergyRegularizationTask": "mink_kinetic_energy_regularization",
        "LookAtTask": "mink_look_at_palm",
        "PostureTask": "mink_posture",
        "RelativeFrameTask": "mink_relative_frame_f1_tip_palm",
    }


def test_two_tasks_of_one_frame_are_told_apart_by_what_they_ask_or_by_a_name_given():
    place = mink.FrameTask("palm", "site", position_cost=1.0, orientation_cost=0.0)
    turn = mink.FrameTask("palm", "site", position_cost=0.0, orientation_cost=1.0)
    stack = ForceTask() >> place >> turn
    assert stack.name == "force ▷ mink_frame_palm_position ▷ mink_frame_palm_orientation"
    with pytest.raises(
        InputError, match=r"named 'mink_frame_palm_position'.*MinkTask\(task, name="
    ):
        stack >> place
    assert (stack >> MinkTask(place, name="again")).tasks[-1].name == "again"


# ---------------------------------------------------------------- the model


def test_the_robot_of_a_grasp_is_known_and_where_it_is_not_that_is_said(grasp):
    stack = Stack.of(MAKE[mink.ComTask]())
    copy = pickle.loads(pickle.dumps(grasp))
    assert copy.model is None
    np.testing.assert_array_equal(copy.jacobian, grasp.jacobian)
    with pytest.raises(InputError, match=r"'mink_com' needs the robot's model.*MinkTask\(task, "):
        stack.levels(copy)
    for one, other in zip(stack.on(model).levels(copy), stack.levels(grasp), strict=True):
        np.testing.assert_array_equal(one.A, other.A)
        np.testing.assert_array_equal(one.lower, other.lower)


def test_a_controller_knows_its_robot_so_that_a_stored_history_goes_on(grasp, tmp_path):
    laws = (
        ForceTask() >> MomentTask() >> MAKE[mink.ComTask](lm_damping=1.0) >> MAKE[mink.FrameTask]()
    )
    controller = Controller(robot, laws)
    history = [Touch(grasp.q, grasp)]
    save_history(tmp_path / "h.json", history)
    loaded = load_history(tmp_path / "h.json")
    there, here = controller.step(loaded), controller.step(history)
    assert there.q_target.tobytes() == here.q_target.tobytes()
    without = Controller(robot, ForceTask() >> MomentTask()).step(history)
    assert np.abs(here.q_target - without.q_target).max() > 1e-3


@pytest.mark.parametrize("form", ["hierarchy", "memoryless", "clipped"])
def test_every_form_that_takes_any_law_holds_a_damped_one_back(form, grasp):
    """The more it is damped, the nearer to what least motion of all joints makes of it."""
    A, _ = MinkTask(MAKE[mink.ComTask]()).rows(grasp)

    def motion(law: mink.Task) -> np.ndarray:
        controller = Controller(robot, ForceTask() >> MomentTask() >> law, form, landing=False)
        return A @ controller.step([Touch(grasp.q, grasp)]).plan.x

    least = motion(mink.DampingTask(model, cost=1.0))
    away = [
        np.linalg.norm(motion(MAKE[mink.ComTask](lm_damping=lm)) - least) for lm in (0, 10, 1e6)
    ]
    assert away[0] > 2 * away[1] > 1e-4
    assert away[2] < 0.1 * away[1]  # steps are shortened to the caps in different shares


def other_model() -> mujoco.MjModel:
    return Scene("bhand").model


def elsewhere() -> mink.FrameTask:
    """A task of a frame that the robot does not have."""
    task = mink.FrameTask("hand", "site", 1.0, 1.0)
    task.set_target(mink.SE3.identity())
    return task


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (elsewhere(), r"the law 'mink_frame_hand'.*'hand'.*palm"),
        (mink.ComTask(1.0), r"'mink_com'.*[Tt]arget"),
        (mink.KineticEnergyRegularizationTask(1.0), r"'mink_kinetic_energy.*timestep"),
    ],
    ids=["frame", "target", "dt"],
)
def test_what_a_task_lacks_is_said_before_the_hand_moves(task, message):
    with pytest.raises(InputError, match=message):
        Trial(scene, ForceTask() >> task)
    with pytest.raises(InputError, match=message):
        Controller(robot, ForceTask() >> task)


def test_a_task_of_another_robot_is_refused_by_name(grasp):
    posture = mink.PostureTask(other_model(), cost=1.0)
    posture.set_target(np.zeros(other_model().nq))
    with pytest.raises(InputError, match=r"PostureTask is of a model with 8 .*robot has 15"):
        Controller(robot, ForceTask() >> posture)
    law = MinkTask(MAKE[mink.ComTask](), other_model())
    with pytest.raises(InputError, match=r"'mink_com' speaks of a model with 8 .*grasp has 15"):
        law.rows(grasp)


def test_tasks_of_two_models_do_not_meet(grasp):
    """Though configurations are used again."""
    law = MinkTask(MAKE[mink.ComTask]())
    before = law.error(grasp)
    small = Scene("bhand")
    MinkTask(mink.ComTask(1.0), small.model)
    far = at(grasp, grasp.q + 0.1)
    moved = law.error(far)
    assert np.abs(moved - before).max() > 1e-3
    np.testing.assert_array_equal(law.error(grasp), before)
    np.testing.assert_array_equal(law.error(far), moved)


# ---------------------------------------------------------------- an objective of one's own


class Pull(BaseTask):
    """½ xᵀ H x + cᵀ x."""

    def __init__(self, H: np.ndarray, c: np.ndarray) -> None:
        self.H, self.c = H, c

    def compute_qp_objective(self, configuration: mink.Configuration) -> Objective:
        return Objective(self.H, self.c)


def test_an_objective_of_ones_own_counts_by_its_rows(grasp):
    rng = np.random.default_rng(3)
    root, wish = rng.normal(size=(4, 15)), rng.normal(size=4)
    law = MinkTask(Pull(root.T @ root, -root.T @ wish))
    A, b = law.rows(grasp)
    np.testing.assert_allclose(
        A.T @ A, robot.coupling.T @ root.T @ root @ robot.coupling, atol=EXACT
    )
    np.testing.assert_allclose(A.T @ b, robot.coupling.T @ root.T @ wish, atol=EXACT)
    np.testing.assert_allclose(law.error(grasp), -b, atol=EXACT)
    np.testing.assert_allclose(law.jacobian(grasp), A, atol=EXACT)
    with pytest.raises(InputError, match="negative eigenvalue"):
        MinkTask(Pull(-np.eye(15), np.zeros(15))).rows(grasp)


# ---------------------------------------------------------------- trials


def test_a_trial_records_each_law_of_mink_and_balances_above_them():
    short = Scene(object=Cylinder(0.05))
    home = mink.Configuration(short.model, robot.coupling @ robot.home + robot.offset)
    com = mink.ComTask(1.0, lm_damping=1.0)
    posture = mink.PostureTask(short.model, cost=1.0)
    for task in (com, posture):
        task.set_target_from_configuration(home)
    stack = ForceTask() >> MomentTask() >> com >> posture
    record = Trial(short, stack, probes=8).run((24, 1))
    assert record.verdict == "good"
    for name in ("mink_com", "mink_posture"):
        errors = record.column(f"error_{name}")
        assert (np.isfinite(errors) == record.column("in_contact")).all()
        assert np.nanmax(errors) > np.nanmin(errors)
    grasp = record.grasps[0]
    first = np.linalg.norm(com.compute_error(configuration_at(grasp.q)))
    assert record.column("error_mink_com")[0] == pytest.approx(first, abs=EXACT)
    assert record.column("status_mink_com")[1] == "met"  # what its damping left of it
    assert np.isfinite(record.column("rank_mink_posture")[1])


def test_the_same_tasks_have_the_same_fingerprint_and_other_targets_another():
    def fingerprint(height: float) -> Fingerprint:
        task = targeted(mink.FrameTask("palm", "site", 1.0, 1.0))
        com = mink.ComTask(1.0)
        com.set_target([0.0, 0.0, height])
        return Fingerprint(Trial(scene, ForceTask() >> task >> com, probes=2))

    one, same, other = fingerprint(1.0), fingerprint(1.0), fingerprint(1.1)
    assert one.unknown == []
    assert one.parts == same.parts and one.parts != other.parts


def test_a_trial_with_tasks_of_mink_goes_to_other_processes():
    stack = ForceTask() >> MomentTask() >> MAKE[mink.FrameTask]()
    trial = Trial(scene, stack, probes=1)
    there = pickle.loads(pickle.dumps(trial)).run((24, 2))
    np.testing.assert_array_equal(
        there.column("error_mink_frame_palm"), trial.run((24, 2)).column("error_mink_frame_palm")
    )
