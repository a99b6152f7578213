"""When the hand goes no further, by any laws and with any number of contacts."""

import numpy as np
import pytest
from hqp_grasp.scenarios import cylinder
from own_law import HeightTask

from hqp_grasp.control.forms import HierarchyForm
from hqp_grasp.control.limits import StepLimit
from hqp_grasp.control.settling import BETTER, FORCE_GOAL, PATIENCE, Course
from hqp_grasp.experiments.trial import Trial
from hqp_grasp.grasp import Contact, Grasp, Miss, Missed, Touch
from hqp_grasp.tasks import ForceTask, KinematicTask, MomentTask, Stack, stack_of

MISSED = Missed(Miss.NO_TOUCH, "finger_1")
JOINTS = 12
ARM = 0.2  # [m/rad] by which a flexion moves its contact
WAYS = ((np.cos, np.sin), (lambda t: -np.sin(t), np.cos))  # the normals, and across them


def ring(k, lean=0.0, rise=0.0, turn=0.0, aside=0.2):
    """k contacts around a circle, in balance, or one leaning [–], or one higher [m].

    All joints are at `turn` [rad]; flexions push `aside` [rad] of the normals.
    """
    angles = 2.0 * np.pi * np.arange(k) / k
    n, t = (np.column_stack([f(angles), g(angles), 0.0 * angles]) for f, g in WAYS)
    x = 0.05 * n
    J = 0.1 * ARM * np.random.default_rng(0).standard_normal((k, 3, JOINTS))
    J[np.arange(k), :, np.arange(k)] = ARM * (np.cos(aside) * n + np.sin(aside) * t)
    n[0, 2] = lean
    n[0] /= np.linalg.norm(n[0])
    x[0, 2] = rise
    contacts = [Contact(*v, flexion=(i,)) for i, v in enumerate(zip(x, n, strict=True))]
    H = 0.01 * np.random.default_rng(0).standard_normal((3 * k, JOINTS, JOINTS))
    H = H + H.transpose(0, 2, 1)
    return Grasp(np.full(JOINTS, turn), contacts, J.reshape(3 * k, JOINTS), hessian=H)


def touched(*felt):
    """A history: each went to a posture of its own."""
    return [
        Touch(grasp.q if isinstance(grasp, Grasp) else np.full(JOINTS, 9.0), grasp)
        for grasp in felt
    ]


def balanced(k, count=PATIENCE + 1, **pose):
    return [ring(k, turn=0.1 * i, **pose) for i in range(count)]


@pytest.mark.parametrize("k", [2, 3, 4, 5, 6, 8])
@pytest.mark.parametrize("laws", ["fmk", "fm", "mfk", "f", "m"])
def test_any_number_of_contacts_settles_in_the_default_form(laws, k):
    stack = stack_of(laws).within(StepLimit())
    history = touched(*balanced(k))
    plan = HierarchyForm().plan(stack, history[-1].felt, history)
    assert plan.planner == "return to the best grasp" and plan.exact
    early = HierarchyForm().plan(stack, history[0].felt, history[:1])
    assert early.planner != "return to the best grasp"


@pytest.mark.parametrize("k", [3, 4])
def test_what_does_not_balance_by_the_goals_does_not_settle(k):
    """Twice the goal; and a law that is not in the stack has no goal."""
    lean = 1.5 * np.sqrt(FORCE_GOAL)
    off = [ring(k, lean, turn=0.1 * i) for i in range(PATIENCE + 3)]
    assert ForceTask().potential(off[0]) > FORCE_GOAL
    assert Course.of(stack_of("fmk"), touched(*off)).best == -1
    assert Course.of(stack_of("f"), touched(*off)).way_back(None) is None
    high = [ring(k, rise=0.05, turn=0.1 * i) for i in range(PATIENCE + 1)]  # pushes past the others
    assert Course.of(stack_of("fm"), touched(*high)).best == -1
    assert Course.of(stack_of("f"), touched(*high)).best == 0


def test_laws_that_balance_nothing_settle_once_they_improve_no_more():
    stack = stack_of("k")
    falling = touched(*(ring(3, aside=0.5 - 0.01 * i, turn=0.1 * i) for i in range(10)))
    assert Course.of(stack, falling).way_back(None) is None
    still = touched(*balanced(3))
    assert Course.of(stack, [*falling, *still[1:]]).over is False
    better = touched(*(ring(3, aside=0.1, turn=0.1 * i) for i in range(PATIENCE + 1)))
    np.testing.assert_array_equal(Course.of(stack, [*falling, *better]).way_back(None), 0.0)
    # A step that finds nothing loses nothing: there was no balance.
    assert Course.of(stack, [*falling, *touched(MISSED, MISSED)]).way_back(None) is None


@pytest.mark.parametrize("above", [stack_of("fm"), None], ids=["below force", "alone"])
def test_errors_of_another_unit_count_by_the_joint_motion_they_take(above):
    """A law in metres goes on while a joint's turn brings it nearer, as one in radians does."""
    stack = above >> HeightTask() if above else Stack.of(HeightTask())
    tell = BETTER * np.linalg.norm(HeightTask().jacobian(ring(3)), 2)
    assert tell < 0.5 * BETTER  # [m] of all contacts' errors
    for fall, over in ((0.25, True), (1.1, False)):
        rises = 0.75 * tell * (10.0 - fall * np.arange(PATIENCE + 2))  # errors' sum is 4/3 of it
        grasps = [ring(3, rise=rise, turn=0.1 * i) for i, rise in enumerate(rises)]
        assert Course.of(stack, touched(*grasps)).over is over


def test_laws_below_are_compared_in_their_order_and_never_added_up():
    """The height gets worse by more than the angles get better."""
    first, second = ring(3, aside=0.21), ring(3, aside=0.2, rise=0.0015, turn=0.1)
    fm, k, height = stack_of("fm"), KinematicTask(), HeightTask()
    assert Course.of(fm >> k >> height, touched(first, second)).best == 1
    assert Course.of(fm >> height >> k, touched(first, second)).best == 0
    assert Course.of(fm >> k >> height, touched(first, second)).worse == 0
    assert Course.of(fm >> height >> k, touched(first, second)).worse == 1


# ---------------------------------------------------------------- laws above force


def test_a_balanced_grasp_is_not_kept_where_a_law_above_was_nearer_before():
    stack = HeightTask() >> ForceTask() >> MomentTask()
    low, high = ring(3, lean=0.2), ring(3, rise=0.0015, turn=0.1)
    history = touched(low, high)
    assert Course.of(stack, history).best == -1  # balanced, but its height was better before
    assert Course.of(ForceTask() >> MomentTask() >> HeightTask(), history).best == 1
    # Nor is it returned to at the end.
    assert Course.of(stack, history).nearest == 0
    assert Course.of(stack_of("fm"), history).nearest == 1


def test_a_balanced_grasp_is_lost_only_once_the_laws_above_are_met():
    stack = HeightTask() >> ForceTask() >> MomentTask()
    met, off = (touched(ring(3, rise=rise), MISSED) for rise in (0.0, 0.0015))
    assert Course.of(stack, met).over and not Course.of(stack, off).over
    assert Course.of(stack, [*off, *off[1:] * PATIENCE]).over  # where it gets no nearer, it is kept


def test_in_the_default_form_the_first_law_ends_met_and_above_force():
    """It ended up to 9 mm off: nobody scaled it, and 2 mm more or less counted as none."""
    stack = HeightTask() >> ForceTask() >> MomentTask()
    trial = Trial(cylinder.scene, stack, probes=30)
    for i in range(6):
        record = trial.run((0, i))
        assert record.verdict == "good"
        assert record.column("error_height")[-1] < 1e-4
