"""When the hand goes no further, by any laws and with any number of contacts."""

from dataclasses import replace

import numpy as np
import pytest
from hqp_grasp.scenarios import cylinder
from own_law import HeightTask

from hqp_grasp.control.episode import Episode
from hqp_grasp.control.forms import HierarchyForm
from hqp_grasp.control.limits import StepLimit
from hqp_grasp.control.progress import Progress
from hqp_grasp.experiments.trial import Trial
from hqp_grasp.grasp import Contact, Grasp, Miss, Missed, Touch
from hqp_grasp.tasks import ForceTask, KinematicTask, MomentTask, Stack, stack_of

BETTER = 0.002
HOPE = 20
PATIENCE = 3
SECURE = 0.2

MISSED = Missed(Miss.NO_TOUCH, "finger_1")
JOINTS = 12
ARM = 0.2  # [m/rad] by which a flexion moves its contact
WAYS = ((np.cos, np.sin), (lambda t: -np.sin(t), np.cos))  # the normals, and across them


def last_of(progress):
    return [t.felt for t in progress.touches if isinstance(t.felt, Grasp)][-1]


def back(progress, left, grasp=None):
    """Where the way back leads from a grasp, or from the last one felt."""
    return progress.way_back(left, grasp or last_of(progress))


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
    plan = HierarchyForm().plan(stack, Episode.of(history))
    assert plan.planner == "return to the best grasp" and plan.exact
    early = HierarchyForm().plan(stack, Episode.of(history[:1]))
    assert early.planner != "return to the best grasp"


@pytest.mark.parametrize("k", [3, 4])
def test_what_does_not_balance_by_the_goals_does_not_settle(k):
    """Twice the goal; and a law that is not in the stack has no goal."""
    lean = 1.5 * np.sqrt(ForceTask.goal)
    off = [ring(k, lean, turn=0.1 * i) for i in range(PATIENCE + 3)]
    assert ForceTask().potential(off[0]) > ForceTask.goal
    assert Progress.of(stack_of("fmk"), touched(*off)).best == -1
    assert back(Progress.of(stack_of("f"), touched(*off)), None) is None
    high = [ring(k, rise=0.05, turn=0.1 * i) for i in range(PATIENCE + 1)]  # pushes past the others
    assert Progress.of(stack_of("fm"), touched(*high)).best == -1
    assert Progress.of(stack_of("f"), touched(*high)).best == 0


def test_laws_that_balance_nothing_settle_once_they_improve_no_more():
    stack = stack_of("k")
    falling = touched(*(ring(3, aside=0.5 - 0.01 * i, turn=0.1 * i) for i in range(10)))
    assert back(Progress.of(stack, falling), None) is None
    still = touched(*balanced(3))
    assert Progress.of(stack, [*falling, *still[1:]]).over is False
    better = touched(*(ring(3, aside=0.1, turn=0.1 * i) for i in range(PATIENCE + 1)))
    np.testing.assert_array_equal(back(Progress.of(stack, [*falling, *better]), None), 0.0)
    # A step that finds nothing loses nothing: there was no balance.
    assert back(Progress.of(stack, [*falling, *touched(MISSED, MISSED)]), None) is None


@pytest.mark.parametrize("above", [stack_of("fm"), None], ids=["below force", "alone"])
def test_errors_of_another_unit_count_by_the_joint_motion_they_take(above):
    """A law in metres goes on while a joint's turn brings it nearer, as one in radians does."""
    stack = above >> HeightTask() if above else Stack.of(HeightTask())
    tell = BETTER * np.linalg.norm(HeightTask().jacobian(ring(3)), 2)
    assert tell < 0.5 * BETTER  # [m] of all contacts' errors
    for fall, over in ((0.25, True), (1.1, False)):
        rises = 0.75 * tell * (10.0 - fall * np.arange(PATIENCE + 2))  # errors' sum is 4/3 of it
        grasps = [ring(3, rise=rise, turn=0.1 * i) for i, rise in enumerate(rises)]
        assert Progress.of(stack, touched(*grasps)).over is over


def test_laws_below_are_compared_in_their_order_and_never_added_up():
    """The height gets worse by more than the angles get better."""
    first, second = ring(3, aside=0.21), ring(3, aside=0.2, rise=0.0015, turn=0.1)
    fm, k, height = stack_of("fm"), KinematicTask(), HeightTask()
    assert Progress.of(fm >> k >> height, touched(first, second)).best == 1
    assert Progress.of(fm >> height >> k, touched(first, second)).best == 0
    assert Progress.of(fm >> k >> height, touched(first, second)).worse == 0
    assert Progress.of(fm >> height >> k, touched(first, second)).worse == 1


# ---------------------------------------------------------------- laws above force


def test_a_balanced_grasp_is_not_kept_where_a_law_above_was_nearer_before():
    stack = HeightTask() >> ForceTask() >> MomentTask()
    low, high = ring(3, lean=0.2), ring(3, rise=0.0015, turn=0.1)
    history = touched(low, high)
    assert Progress.of(stack, history).best == -1  # balanced, but its height was better before
    assert Progress.of(ForceTask() >> MomentTask() >> HeightTask(), history).best == 1
    # Nor is it returned to at the end.
    assert Progress.of(stack, history).nearest == 0
    assert Progress.of(stack_of("fm"), history).nearest == 1


def test_a_balanced_grasp_is_lost_only_once_the_laws_above_are_met():
    stack = HeightTask() >> ForceTask() >> MomentTask()
    met, off = (touched(ring(3, rise=rise), MISSED) for rise in (0.0, 0.0015))
    assert Progress.of(stack, met).over and not Progress.of(stack, off).over
    assert Progress.of(
        stack, [*off, *off[1:] * PATIENCE]
    ).over  # where it gets no nearer, it is kept


def test_in_the_default_form_the_first_law_ends_met_and_above_force():
    """It ended up to 9 mm off: nobody scaled it, and 2 mm more or less counted as none."""
    stack = HeightTask() >> ForceTask() >> MomentTask()
    trial = Trial(cylinder.scene, stack, probes=30)
    for i in range(6):
        record = trial.run((0, i))
        assert record.verdict == "good"
        met = BETTER * np.linalg.norm(HeightTask().jacobian(record.grasps[-1]), 2)
        assert record.column("error_height")[-1] < met < 1e-3


# ---------------------------------------------------------------- held by friction


def cone(k, lean, turn=0.0, noise=0.0, scale=1.0):
    """k contacts around walls that lean by `lean` [rad]; all joints at `turn` [rad]."""
    flat = ring(k, turn=turn)
    n = np.cos(lean) * flat.normals - np.sin(lean) * np.array([0.0, 0.0, 1.0])
    contacts = [
        replace(contact, normal=normal, noise=noise)
        for contact, normal in zip(flat.contacts, n, strict=True)
    ]
    return replace(flat, contacts=tuple(contacts), jacobian=scale * flat.jacobian)


def leaning(k, *leans, **settings):
    return [cone(k, lean, 0.1 * i, **settings) for i, lean in enumerate(leans)]


@pytest.mark.parametrize("k", [2, 3, 5])
@pytest.mark.parametrize("laws", ["fm", "fmk", "mfk"])
def test_where_nothing_balances_a_secure_grasp_is_kept_once_no_better_one_comes(k, laws):
    stack = stack_of(laws)
    least = np.arctan(SECURE) - 0.05
    worse = [least + 0.1 * np.random.default_rng(i).random() + 0.01 for i in range(HOPE)]
    grasps = leaning(k, 0.5, least, *worse)
    assert back(Progress.of(stack, touched(*grasps[:-1])), None) is None
    progress = Progress.of(stack, touched(*grasps))
    assert progress.best == -1 and progress.nearest == 1
    assert back(progress, None) is not None
    np.testing.assert_array_equal(progress._way(last_of(progress))[-1], grasps[1].q)
    # A miss brings no better one either; a better one is gone on from.
    assert Progress.of(stack, touched(*grasps[:2], *[MISSED] * HOPE)).over
    better = cone(k, least - 2.0 * BETTER, 5.0)
    assert not Progress.of(stack, touched(*grasps, better)).over


def test_a_grasp_that_is_not_secure_is_kept_only_as_the_budget_ends():
    stack = stack_of("fm").within(StepLimit())
    lean = np.arctan(SECURE) + 0.01
    grasps = leaning(3, 0.5, lean, *[0.6] * 3 * HOPE)
    progress = Progress.of(stack, touched(*grasps))
    assert progress.nearest == 1 and back(progress, None) is None
    assert (
        back(progress, 100) is None
        and back(progress, len(progress._way(last_of(progress)))) is not None
    )


def test_a_balanced_grasp_is_kept_before_one_that_friction_holds():
    """Patience for balance is another: a grasp that balances is no matter of friction."""
    grasps = [*leaning(3, *[0.1] * HOPE), *balanced(3, 1)]
    progress = Progress.of(stack_of("fm"), touched(*grasps))
    assert progress.best == len(grasps) - 1 == progress.nearest and not progress.over


def test_friction_is_no_matter_of_a_stack_that_balances_part_of_the_wrench():
    """By the force alone the second is nearer to balance; friction has its moment to hold."""
    one, two = cone(3, 0.15), ring(3, lean=0.05, rise=0.05, turn=0.1)
    assert Progress.of(stack_of("f"), touched(one, two)).nearest == 1
    assert Progress.of(stack_of("fm"), touched(one, two)).nearest == 0
    assert not Progress.of(stack_of("f"), touched(*leaning(3, *[0.15] * 2 * HOPE))).over


def test_laws_above_are_not_given_up_for_a_grasp_that_friction_holds():
    stack = HeightTask() >> ForceTask() >> MomentTask()
    low, high = cone(3, 0.15), cone(3, 0.05, 0.1)
    first = replace(high.contacts[0], position=high.contacts[0].position + np.array([0, 0, 5e-3]))
    high = replace(high, contacts=(first, *high.contacts[1:]))
    assert Progress.of(stack, touched(low, high)).nearest == 0
    assert Progress.of(stack_of("fm"), touched(low, high)).nearest == 1


def test_noise_of_normals_counts_as_friction_that_a_grasp_needs():
    lean = np.arctan(SECURE) - 0.02
    for noise, over in ((0.0, True), (0.005, True), (0.02, False)):
        grasps = leaning(3, lean, *[0.5] * HOPE, noise=noise)
        assert Progress.of(stack_of("fm"), touched(*grasps)).over is over
    sure, unsure = cone(3, 0.10, noise=1e-3), cone(3, 0.09, 0.1, noise=0.02)
    assert Progress.of(stack_of("fm"), touched(sure, unsure)).nearest == 0


def test_a_secure_grasp_that_is_not_there_any_more_is_forgotten():
    grasps = leaning(3, 0.1, *[0.5] * HOPE)
    back = Touch(grasps[0].q, cone(3, 0.4))
    progress = Progress.of(stack_of("fm"), [*touched(*grasps), back])
    assert progress.nearest == len(grasps) and not progress.over


def test_contacts_that_no_friction_balances_are_kept_by_the_laws():
    """One contact, or all on one side: whatever is nearer to balance."""
    one = [cone(1, lean, 0.1 * i) for i, lean in enumerate((0.3, 0.0))]
    assert back(Progress.of(stack_of("fm"), touched(*one)), None) is None
    assert Progress.of(stack_of("fm"), touched(*one)).nearest == 0  # none is nearer: |f| is 1 N


def test_the_way_back_leads_over_grasps_felt_before():
    """Straight on, fingers closed beside the object, again and again, until the hand gave up."""
    stack = stack_of("fm").within(StepLimit(joint=0.25, contact=np.inf))
    turns = [0.0, 0.2, 0.4, 0.6, 0.8]
    grasps = [cone(3, 0.1 if turn == 0.0 else 0.5, turn) for turn in turns]
    history = touched(*grasps, *[MISSED] * HOPE)
    progress = Progress.of(stack, history)
    assert [way[0] for way in progress._way(last_of(progress))] == [0.6, 0.4, 0.2, 0.0]
    np.testing.assert_array_equal(back(progress, None), grasps[3].q)
    # Begun again elsewhere, it leads from there; where the hand is already, it stays.
    np.testing.assert_array_equal(back(progress, None, grasps[1]), grasps[0].q)
    np.testing.assert_array_equal(back(progress, None, grasps[0]), grasps[0].q)
    # What was felt twice is passed once.
    twice = touched(grasps[0], *[grasps[2]] * 2, cone(3, 0.5, 0.4), *[MISSED] * HOPE)
    assert [
        way[0] for way in Progress.of(stack, twice)._way(last_of(Progress.of(stack, twice)))
    ] == [0.0, 0.0]
    # A step the hand took once it can take again, in as many touches as caps ask for.
    far = Progress.of(stack, touched(grasps[0], grasps[2], *[MISSED] * HOPE))
    assert [way[0] for way in far._way(last_of(far))] == [0.0, 0.0]
    assert back(far, 4) is not None
