"""Targets on the surface felt, and the form that goes by them."""

import dataclasses

import numpy as np
import pytest
from hqp_grasp.scenarios import irregular
from own_law import HeightTask

from hqp_grasp.control.controller import Controller
from hqp_grasp.control.episode import Episode, MissPolicy
from hqp_grasp.control.forms import form_of
from hqp_grasp.control.limits import StepLimit, cap_ratio, room_left
from hqp_grasp.control.progress import Progress
from hqp_grasp.control.step import fitting, scaled
from hqp_grasp.control.targets import Target, nearest_free
from hqp_grasp.experiments.trial import Trial
from hqp_grasp.grasp import Contact, Grasp, Miss, Missed, Touch
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.hierarchy.level import Level
from hqp_grasp.history import load_history, save_history
from hqp_grasp.surface.believed import believed
from hqp_grasp.surface.felt import Felt
from hqp_grasp.surface.outline import wrapped
from hqp_grasp.tasks import ForceTask, MomentTask, stack_of
from hqp_grasp.tasks.limit import Limit, Priority
from hqp_grasp.touch.geometric import GeometricProbe
from hqp_grasp.world.scene import Cylinder, Prism, Scene

PATIENCE = 3
AWAY = 0.002
INTO = 0.2
BEYOND = 4.0
CONTRADICTION = 0.0002

TIP = 0.008  # [m]
HEXAGON = Prism.regular(6, 0.06)


@dataclasses.dataclass(frozen=True, eq=False)
class Around(Limit):
    """A range of its own about a posture."""

    q: np.ndarray
    room: np.ndarray
    priority = Priority.RANGE

    def level(self, grasp):
        x = self.q - grasp.q
        return Level(np.eye(len(x)), x - self.room, x + self.room, "around")


def probed(scene, first, probes, stack=None):
    """A trial of the form from a grasp."""
    trial = Trial(scene, stack or stack_of("fmk"), form="hierarchy", probes=probes, start=first)
    return trial.run((616, 0))


def back(progress, left, grasp=None):
    """Where the way back leads from a grasp, or from the last one felt."""
    felt = [t.felt for t in progress.touches if isinstance(t.felt, Grasp)]
    return progress.way_back(left, grasp or felt[-1])


def targets_of(*grasps, laws="fmk", stack=None):
    """Targets from the last of these grasps, and the surface they are on."""
    surface = believed(Felt.of([Touch(g.q, g) for g in grasps]), grasps[-1], 1e-3)
    return Target.each(surface, stack or stack_of(laws), grasps[-1]), surface


def test_under_noise_balance_is_judged_by_its_floor_and_patience_grows(cylinder, first):
    """What an exact sensor takes for worse, and for too late to go on, noise explains."""
    stack = stack_of("fmk")
    good = probed(cylinder, first, 6).grasps[-1]
    noise = 0.02
    felt = [dataclasses.replace(c, noise=noise) for c in good.contacts]
    unsure = dataclasses.replace(good, contacts=tuple(felt))
    history = [Touch(good.q, good)] * (PATIENCE + 1)
    np.testing.assert_array_equal(back(Progress.of(stack, history), None), good.q)
    assert back(Progress.of(stack, [Touch(good.q, unsure)] * (PATIENCE + 1)), None) is None
    # A push aside that is within the floor, but beyond the goals of an exact sensor.
    n = felt[0].normal + np.array([0.0, 0.0, 1.5 * np.sqrt(ForceTask.goal)])
    for contact, lost in ((dataclasses.replace(felt[0], noise=0.0), True), (felt[0], False)):
        aside = dataclasses.replace(contact, normal=n / np.linalg.norm(n))
        others = [dataclasses.replace(c, noise=aside.noise) for c in felt[1:]]
        grasp = dataclasses.replace(good, contacts=(aside, *others))
        assert ForceTask().potential(grasp) > ForceTask.goal
        assert (ForceTask().potential(grasp) > BEYOND * grasp.floor[0]) == lost
        history = [Touch(good.q, unsure), Touch(good.q + 0.1, grasp)]
        assert (back(Progress.of(stack, history), None) is not None) == lost


def test_a_step_that_overshot_is_followed_by_shorter_ones(cylinder, first):
    """The kinematic law's step halves with each balanced grasp that it made worse."""
    stack = stack_of("fmk")
    good = probed(cylinder, first, 12).grasps[-1]
    worse = dataclasses.replace(good, jacobian=_turned(good.jacobian, 0.1))
    history = [Touch(good.q, good)]
    assert Progress.of(stack, history).damping == 1.0
    assert Progress.of(stack, [*history, Touch(good.q, worse)]).damping == 0.5
    assert (
        Progress.of(stack, [*history, Touch(good.q, worse), Touch(good.q, worse)]).damping == 0.25
    )


def test_the_hand_is_back_in_time_from_where_a_step_more_would_cost_one_more(cylinder, first):
    stack = Controller(cylinder.articulated, stack_of("fmk"), "hierarchy").stack
    record = probed(cylinder, first, 3)
    better, worse = record.grasps[1], record.grasps[0]
    x = worse.q - better.q
    x *= 1.5 / cap_ratio(x, stack, better)
    away = dataclasses.replace(worse, q=better.q + x)
    history = [Touch(better.q, better), Touch(away.q, away)]
    ratio = cap_ratio(better.q - away.q, stack, away)
    assert 1.0 < ratio < 2.0
    progress = Progress.of(stack, history)
    assert back(progress, 4) is None
    np.testing.assert_array_equal(back(progress, 3), better.q)


def test_noise_counts_against_a_grasp_that_is_to_be_returned_to(cylinder, first):
    """One felt once by a lucky touch is not better than one that is nearly as good for sure."""
    stack = stack_of("fmk")
    felt = probed(cylinder, first, 3).grasps[1]
    lucky = [dataclasses.replace(c, noise=0.2) for c in felt.contacts]
    n = felt.contacts[0].normal + 1e-3
    sure = (dataclasses.replace(felt.contacts[0], normal=n / np.linalg.norm(n)), *felt.contacts[1:])
    grasps = [dataclasses.replace(felt, contacts=tuple(v)) for v in (lucky, sure)]
    progress = Progress.of(stack, [Touch(g.q, g) for g in grasps])
    assert progress.scores[0] < progress.scores[1] and progress.nearest == 1


def test_tips_that_are_no_balls_take_shorter_steps_until_they_balance(cylinder, first):
    """Half for each grasp that was not balanced; balls, whose radii stay, take whole steps."""
    stack = stack_of("fmk")
    start = probed(cylinder, first, 1).grasps[0]
    other = tuple(dataclasses.replace(c, tip_radius=2.0 * c.tip_radius) for c in start.contacts)
    changed = dataclasses.replace(start, contacts=other)
    round_tips, flat_tips = ([Touch(g.q, g) for g in v] for v in ([start] * 3, [start, changed]))
    assert ForceTask().potential(start) > ForceTask.goal
    assert Progress.of(stack, round_tips).damping == 1.0
    longer = [[*flat_tips, *round_tips[:i]] for i in range(3)]
    assert [Progress.of(stack, v).damping for v in longer] == [0.5, 0.25, 0.125]


def _turned(jacobian, angle):
    """Flexions that move the contacts another way: about the vertical."""
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return (R @ jacobian.reshape(-1, 3, jacobian.shape[1])).reshape(jacobian.shape)


# ---------------------------------------------------------------- the form


@pytest.fixture(scope="module")
def cylinder():
    return Scene()


@pytest.fixture(scope="module")
def hexagon():
    return Scene(object=HEXAGON)


@pytest.fixture(scope="module")
def first(cylinder):
    return Trial(cylinder, stack_of("fmk"), form="hierarchy", probes=1).run((616, 0)).grasps[0]


@pytest.fixture(scope="module")
def first_on_hexagon(hexagon):
    return Trial(hexagon, stack_of("fmk"), form="hierarchy", probes=1).run((777, 1)).grasps[0]


def test_steps_are_certified_within_limits_and_the_same_each_time(cylinder, first):
    controller = Controller(cylinder.articulated, stack_of("fmk"), "hierarchy")
    history = [Touch(first.q, first)]
    step, again = controller.step(history), controller.step(history)
    assert step.q_target.tobytes() == again.q_target.tobytes()
    assert [level.name for level in step.solution.levels] == [
        "step",
        "range",
        "contact",
        "force",
        "moment",
        "way",
        "kinematic",
    ]
    assert cylinder.articulated.violation(step.q_target) == 0.0


def test_a_stored_history_is_continued_bit_for_bit(hexagon, first_on_hexagon, tmp_path):
    robot, probe = hexagon.articulated, GeometricProbe(hexagon)
    controller = Controller(robot, stack_of("fmk"), "hierarchy", budget=9)

    def walked(history):
        while (step := controller.step(history)).q_target is not None:
            history = [*history, Touch(step.q_target, probe.touch(step.q_target))]
        return history

    whole = walked([Touch(first_on_hexagon.q, first_on_hexagon)])
    for stop in (1, 4, 8):
        save_history(tmp_path / "h.json", whole[:stop])
        resumed = walked(load_history(tmp_path / "h.json"))
        assert [t.q_target.tobytes() for t in resumed] == [t.q_target.tobytes() for t in whole]


def test_three_contacts_on_one_face_find_their_way_around(hexagon, first_on_hexagon):
    """All normals parallel, f ≠ 0: a stationary point of the force law, and no grasp."""
    side = HEXAGON.polygon
    middle = 0.5 * (np.array(side[2]) + np.array(side[3]))
    outward = middle / np.linalg.norm(middle)
    tangent = np.array([-outward[1], outward[0]])
    places = middle + np.outer([-0.015, 0.015, 0.0], tangent)
    contacts = [
        Contact([*(np.array(hexagon.position[:2]) + p), hexagon.position[2]], [*outward, 0.0])
        for p in places
    ]
    grasp = hexagon.articulated.grasp(first_on_hexagon.q, contacts)
    plain = Controller(hexagon.articulated, stack_of("f"), "memoryless", landing=False)
    history = [Touch(grasp.q, grasp)]
    still = plain.step(history).plan.x
    moving = (
        Controller(hexagon.articulated, stack_of("fm"), "hierarchy", landing=False)
        .step(history)
        .plan.x
    )
    assert np.abs(grasp.jacobian @ still).max() < 1e-9
    assert np.abs(grasp.jacobian @ moving).max() > 5e-3


def test_a_finger_on_an_edge_is_settled_there():
    """A pentagon's faces do not balance: it takes edges, and they are found and kept."""
    scene = Scene(object=Prism.regular(5, 0.06))
    record = Trial(scene, stack_of("fmk"), form="hierarchy", probes=25).run((777, 0))
    assert record.converged_at is not None and record.converged_at <= 20
    n = record.grasps[-1].normals
    corners = np.array(scene.object.polygon)
    edges = np.roll(corners, -1, axis=0) - corners
    faces = np.arctan2(-edges[:, 0], edges[:, 1])
    off = np.abs(wrapped(np.arctan2(n[:, 1], n[:, 0])[:, None] - faces)).min(axis=1)
    assert (off > 0.02).any()


def test_an_object_that_moves_by_two_millimetres_is_grasped_again(cylinder, first):
    robot = cylinder.articulated
    moved = Scene(position=(0.722, 0.0, 0.2))
    controller = Controller(robot, stack_of("fmk"), "hierarchy")
    history = [Touch(first.q, first)]
    for scene, touches in ((cylinder, 10), (moved, 15)):
        probe = GeometricProbe(scene)
        for _ in range(touches):
            q = controller.step(history).q_target
            history.append(Touch(q, probe.touch(q)))
        grasp = history[-1].felt
        assert ForceTask().potential(grasp) <= ForceTask.goal
        assert MomentTask().potential(grasp) <= MomentTask.goal
    # What is left of the time before does not contradict what was felt since.
    felt = Felt.of(history)
    beyond = felt.normals @ felt.positions.T - (felt.normals * felt.positions).sum(axis=1)[:, None]
    assert beyond.max() <= CONTRADICTION and len(felt.probes) < 3 * len(history)


def test_a_balanced_grasp_is_kept_once_a_step_from_it_missed(cylinder, first):
    stack = stack_of("fmk")
    record = probed(cylinder, first, 6)
    good = record.grasps[-1]
    history = [Touch(first.q, first), Touch(good.q, good)]
    assert back(Progress.of(stack, history), None) is None
    history.append(Touch(good.q + 0.1, Missed(Miss.NO_TOUCH, "finger_1")))
    np.testing.assert_array_equal(back(Progress.of(stack, history), None), good.q)
    history.append(Touch(good.q, first))  # it is not there any more
    assert back(Progress.of(stack, history), None) is None


def test_the_best_grasp_is_returned_to_as_the_budget_runs_out(cylinder, first):
    stack = Controller(cylinder.articulated, stack_of("fmk"), "hierarchy").stack
    record = probed(cylinder, first, 3)
    better, worse = record.grasps[1], record.grasps[0]
    history = [Touch(better.q, better), Touch(worse.q, worse)]
    assert back(Progress.of(stack, history), 30) is None
    np.testing.assert_array_equal(back(Progress.of(stack, history), 1), better.q)


def test_other_cylinders_need_no_radius_of_their_own():
    scene = Scene(object=Cylinder(radius=0.065))
    record = Trial(scene, stack_of("fmk"), form="hierarchy", probes=12).run((777, 0))
    assert record.converged_at is not None and record.converged_at <= 8


def test_on_an_irregular_prism_only_the_memory_finds_balance():
    trial = Trial(irregular.scene, stack_of("fmk"), probes=30, form="hierarchy")
    seeds = [(90210, i) for i in range(5)]
    with_memory = [trial.run(seed).verdict for seed in seeds]
    without = [dataclasses.replace(trial, form="memoryless").run(seed).verdict for seed in seeds]
    assert with_memory.count("good") >= 4
    assert without.count("good") <= 1


# ---------------------------------------------------------------- targets and their levels


@pytest.mark.parametrize("laws", ["fm", "mf", "f", "fmk"])
def test_levels_ask_exactly_for_the_predicted_motion(first, laws):
    """A step that moves the contacts as predicted meets contact, laws and way."""
    target = targets_of(first, laws=laws)[0][0]
    for share in (0.1, 0.3, 1.0):
        motion = target.way.at(share)[0] - first.centers
        x = np.linalg.lstsq(first.jacobian, motion.ravel(), rcond=None)[0]
        for level in target.levels(share):
            np.testing.assert_allclose(level.A @ x, level.upper, atol=1e-9)


def test_rows_of_force_and_moment_are_their_closed_secants(first):
    target = targets_of(first)[0][0]
    c, n = target.way.at(0.4)
    motion, x = c - first.centers, first.positions
    after = c - TIP * n
    force = (first.normals - n).sum(axis=0)
    moment = np.cross(n, after - after.mean(axis=0)).sum(axis=0)
    moment -= np.cross(first.normals, x - x.mean(axis=0)).sum(axis=0)
    for task, change in zip((ForceTask(), MomentTask()), (force, moment), strict=True):
        A, b = target._secant(task, motion, 0.4, 1.0)
        np.testing.assert_allclose(b, change, atol=1e-12)
        step = np.linalg.lstsq(first.jacobian, motion.ravel(), rcond=None)[0]
        np.testing.assert_allclose(A @ step, change, atol=1e-9)


def test_across_the_way_a_law_changes_as_the_surface_turns(cylinder, first):
    """Beside the way, along a cylinder's axis: by differences of error on the cylinder itself."""
    target = targets_of(first)[0][0]
    motion = target.way.at(0.4)[0] - first.centers
    middle, h = np.array(cylinder.position), 1e-6
    across = np.cross(first.normals, motion)
    across /= np.linalg.norm(across, axis=1)[:, None]
    x = np.linalg.lstsq(first.jacobian, across.ravel(), rcond=None)[0]
    for task in (ForceTask(), MomentTask(reference=[0.7, 0.0, 0.2]), MomentTask()):
        errors = []
        for step in (h, -h):
            contacts = []
            for c, d in zip(first.contacts, across, strict=True):
                center = c.position + TIP * c.normal + step * d
                n = (center - middle) * [1.0, 1.0, 0.0]
                n /= np.linalg.norm(n)
                center += (0.05 + TIP) * n - (center - middle) * [1.0, 1.0, 0.0]
                contacts.append(dataclasses.replace(c, position=center - TIP * n, normal=n))
            errors.append(task.error(dataclasses.replace(first, contacts=tuple(contacts))))
        A, _ = target._secant(task, motion, 0.4, 1.0)
        np.testing.assert_allclose(A @ x, (errors[0] - errors[1]) / (2.0 * h), atol=2e-3)


def test_a_law_of_ones_own_asks_for_what_the_target_leaves_of_its_error(first):
    """The way changes the heights by what it does; the rest of the error is asked for beside."""
    law = HeightTask(weight=3.0)
    stack = ForceTask() >> MomentTask() >> law
    target = targets_of(first, stack=stack)[0][0]
    motion = target.way.at(0.5)[0] - first.centers
    A, b = target._secant(law, motion, 0.5, 1.0)
    whole = law.error(target.imagined(0.5)) - law.error(first)
    np.testing.assert_allclose(b, 3.0 * (whole - 0.5 * law.error(target.imagined(1.0))), atol=1e-12)
    x = np.linalg.lstsq(first.jacobian, motion.ravel(), rcond=None)[0]
    np.testing.assert_allclose(A @ x, 3.0 * whole, atol=1e-9)


def test_the_whole_way_leads_to_balance(first):
    for target in targets_of(first)[0][:1]:
        grasp = target.imagined(1.0)
        np.testing.assert_allclose(grasp.normals.sum(axis=0), 0.0, atol=2e-3)
        np.testing.assert_allclose(MomentTask().error(grasp), 0.0, atol=1e-3)


def test_contacts_that_do_not_move_are_no_trouble(cylinder, first):
    """In balance the nearest target is where the hand is."""
    good = probed(cylinder, first, 8).grasps[-1]
    target = targets_of(first, good)[0][0]
    for level in target.levels(1.0):
        assert np.isfinite(level.A).all() and np.isfinite(level.upper).all()


# ---------------------------------------------------------------- what keeps the hand from a target


def test_nothing_keeps_the_hand_from_where_it_is(cylinder, first):
    good = probed(cylinder, first, 8).grasps[-1]
    stack = Controller(cylinder.articulated, stack_of("fmk")).stack
    targets, _ = targets_of(first, good, stack=stack)
    assert targets[0].obstacle(cylinder.articulated, 1.0) == 0.0
    assert nearest_free(targets, cylinder.articulated, 1.0) is targets[0]


def test_a_target_out_of_reach_is_passed_over_though_its_first_step_fits(cylinder, first):
    robot = cylinder.articulated
    stack = Controller(robot, stack_of("fm")).stack
    free = form_of("hierarchy").plan(stack, Episode.of([Touch(first.q, first)]))
    tight = stack.within(Around(first.q, 1.05 * np.abs(free.x)))
    away = {}
    for name, limits in (("free", stack), ("tight", tight)):
        targets, _ = targets_of(first, stack=limits)
        away[name] = max(missing for _, missing in targets[0]._postures(robot, 1.0))
    assert away["free"] < AWAY < 0.01 < away["tight"]


def test_postures_on_the_way_are_where_the_way_says(cylinder, first):
    robot = cylinder.articulated
    stack = Controller(robot, stack_of("fm")).stack
    target = targets_of(first, stack=stack)[0][0]
    steps = list(target._postures(robot, 1.0))
    assert len(steps) == 5
    for i, (q, _) in enumerate(steps):
        np.testing.assert_allclose(robot.centers(q), target.way.at(0.2 * (i + 1))[0], atol=AWAY)
        assert robot.violation(q) <= 1e-9


def test_an_answer_that_is_not_certified_leads_nowhere(cylinder, first, monkeypatch):
    solve = HQP.solve

    def unsure(self, levels, warm=None):
        return dataclasses.replace(solve(self, levels, warm), certified=False)

    stack = Controller(cylinder.articulated, stack_of("fm")).stack
    targets, _ = targets_of(first, stack=stack)
    monkeypatch.setattr(HQP, "solve", unsure)
    assert targets[0].obstacle(cylinder.articulated, 1.0) == np.inf


def test_links_in_the_object_and_fingers_that_close_along_it_count(cylinder, first):
    """A surface that swallows the hand; flexions that go the other way."""
    robot = cylinder.articulated
    good = probed(cylinder, first, 8).grasps[-1]
    stack = Controller(robot, stack_of("fmk")).stack
    targets, surface = targets_of(first, good, stack=stack)

    @dataclasses.dataclass
    class Swollen:
        by: float

        def reach(self, u):
            return surface.reach(u) + self.by

    deep = [
        dataclasses.replace(targets[0], surface=Swollen(by)).obstacle(robot, 1.0)
        for by in (0.10, 0.105)
    ]
    assert deep[1] - deep[0] == pytest.approx(1.0) and deep[0] > 0.0  # 5 mm count as one

    class Backwards:
        def __getattr__(self, name):
            return getattr(robot, name)

        def closing_at(self, q):
            return -robot.closing_at(q)

    aside = targets[0].obstacle(robot, 1.0)
    assert aside == 0.0
    assert 1.0 - (-1.0) / INTO > targets[0].obstacle(Backwards(), 1.0) > 1.0


# ---------------------------------------------------------------- what fits the caps


@pytest.mark.parametrize("seed", range(5))
def test_levels_below_take_just_the_room_that_the_others_leave(seed):
    rng = np.random.default_rng(seed)
    n, hqp = 6, HQP(rank_tolerance=1e-6)
    contacts = [Contact(rng.normal(size=3), v / np.linalg.norm(v)) for v in rng.normal(size=(2, 3))]
    grasp = Grasp(np.zeros(n), contacts, 0.1 * rng.normal(size=(6, n)))
    stack = stack_of("f").within(StepLimit(0.35, 0.03))
    top = [Level.equal(rng.normal(size=(2, n)), 0.1 * rng.normal(size=2), "top")]
    below = [Level.equal(np.eye(n), rng.normal(size=n), "below")]
    levels, x, less = fitting(scaled(top), below, stack, grasp, hqp)
    assert less and cap_ratio(x, stack, grasp) == pytest.approx(1.0, abs=1e-8)
    assert [level.name for level in levels] == ["top", "below"]
    alone, first, _ = fitting(scaled(top), [], stack, grasp, hqp)
    np.testing.assert_allclose(alone[0].A @ x, alone[0].upper, atol=1e-9)  # the first is kept
    more = x - first
    room = room_left(first, more, stack, grasp)
    assert room == pytest.approx(1.0, abs=1e-6)  # a little farther, and a cap is broken
    assert room_left(first, 2.0 * more, stack, grasp) == pytest.approx(0.5, abs=1e-6)
    short = room_left(np.zeros(n), 1e-3 * more, stack, grasp)
    assert short == 1.0


def test_a_step_that_fits_is_asked_for_whole():
    grasp = Grasp(np.zeros(2), [Contact(np.zeros(3), [0.0, 0.0, 1.0])], np.zeros((3, 2)))
    stack, hqp = stack_of("f").within(StepLimit(0.35, 0.03)), HQP()
    asked = [Level.equal(np.eye(2), np.array([0.1, -0.2]), "a")]
    _, x, less = fitting(scaled(asked), [], stack, grasp, hqp)
    assert not less
    np.testing.assert_allclose(x, [0.1, -0.2])
    _, x, less = fitting(
        scaled([Level.equal(np.eye(2), np.array([0.7, -0.1]))]), [], stack, grasp, hqp
    )
    assert less
    np.testing.assert_allclose(x, [0.35, -0.05])


# ---------------------------------------------------------------- episodes and misses


def _miss(reason=Miss.NO_TOUCH, n=11):
    return Touch(np.zeros(n), Missed(reason, "finger_1"))


def test_an_episode_is_read_from_the_first_touch_to_the_last(first):
    other = dataclasses.replace(first, q=first.q + 0.01)
    history = [Touch(first.q, first), _miss(), Touch(other.q, other), _miss(), _miss(Miss.STUCK)]
    episode = Episode.of(history, budget=9)
    assert episode.stand is other and episode.missed == 2 and episode.left == 4
    assert [missed.reason for missed in episode.misses] == [Miss.NO_TOUCH, Miss.STUCK]
    assert not episode.again and episode.way == ()
    assert Episode.of(history[:1]).left is None
    nothing = Episode.of([_miss()])
    assert nothing.grasp is None and len(nothing.misses) == 1


def test_a_hand_that_lost_its_grasp_begins_again_from_the_first_once(first):
    policy = MissPolicy(shares=(1.0, 0.5), restart=True)
    second = dataclasses.replace(first, q=first.q + 0.01)
    third = dataclasses.replace(first, q=first.q + 0.02)
    history = [Touch(g.q, g) for g in (first, second, third)] + [_miss(), _miss()]
    again = Episode.of(history, policy)
    assert again.again and again.stand is first and again.misses == ()
    assert [q[0] for q in again.way] == [second.q[0], first.q[0]]
    lost = Episode.of([*history, _miss(), _miss()], policy)
    assert lost.stand is first and not lost.again and policy.spent(lost.misses)
    stays = Episode.of(history, MissPolicy(shares=(1.0, 0.5)))
    assert stays.stand is third and not stays.again
    found = Episode.of([*history, Touch(second.q, second), _miss(), _miss()], policy)
    assert found.again  # what was felt since is another chance


def test_a_broken_sensor_is_no_reason_to_begin_again(first):
    policy = MissPolicy(repeats=2, restart=True)
    history = [Touch(first.q, first), _miss(Miss.SENSOR), _miss(Miss.SENSOR)]
    episode = Episode.of(history, policy)
    assert policy.spent(episode.misses) and not episode.again


def test_a_miss_policy_says_what_follows_which_miss():
    policy = MissPolicy(shares=(1.0, 0.5, 0.2), retreat=0.02, retreats=2, repeats=3, beside=0.05)
    link, nothing, sensor = (Missed(r, "x") for r in (Miss.OTHER_LINK, Miss.NO_TOUCH, Miss.SENSOR))
    assert policy.shorter([link, nothing, sensor, nothing]) == 2
    assert policy.withdrawal([nothing, link]) == pytest.approx(0.02)
    assert policy.withdrawal([link, link]) == pytest.approx(0.04)
    assert policy.withdrawal([link, nothing]) == 0.0 == policy.withdrawal([])
    assert not policy.spent([nothing, nothing]) and policy.spent([nothing] * 3)
    assert not policy.spent([link]) and policy.spent([link, link])
    assert not policy.spent([sensor] * 2) and policy.spent([sensor] * 3)
    np.testing.assert_array_equal(policy.direction([sensor]), 0.0)
    np.testing.assert_allclose(policy.direction([nothing]), [0.05, 0.0, 0.0])
    np.testing.assert_allclose(policy.direction([nothing] * 2), [-0.05, 0.0, 0.0], atol=1e-17)
    assert policy.direction([nothing] * 9) is None and policy.direction([sensor] * 3) is None


def test_stacks_without_a_law_that_has_a_goal_are_the_plain_hierarchy(cylinder, first):
    history = [Touch(first.q, first)]
    steps = [
        Controller(cylinder.articulated, stack_of("k"), form).step(history).q_target
        for form in ("hierarchy", "memoryless")
    ]
    assert steps[0].tobytes() == steps[1].tobytes()


# ---------------------------------------------------------------- what the planner is made of


def test_about_a_fixed_point_moments_change_along_the_way_by_their_closed_secant(first):
    """The reference stays where it is while the contacts move."""
    target = targets_of(first)[0][0]
    reference = np.array([0.6, 0.1, 0.3])
    c, n = target.way.at(0.4)
    motion, x = c - first.centers, first.positions
    change = np.cross(n, c - TIP * n - reference).sum(axis=0)
    change -= np.cross(first.normals, x - reference).sum(axis=0)
    A, b = target._secant(MomentTask(reference=reference), motion, 0.4, 1.0)
    step = np.linalg.lstsq(first.jacobian, motion.ravel(), rcond=None)[0]
    np.testing.assert_allclose(A @ step, change, atol=1e-9)
    left = np.cross(target.way.at(1.0)[1], target.imagined(1.0).positions - reference).sum(axis=0)
    goal = MomentTask.goal
    due = change if left @ left <= goal else change - 0.4 * left
    np.testing.assert_allclose(b, due, atol=1e-9)


@pytest.mark.parametrize("laws", [ForceTask(), MomentTask(), MomentTask(reference=[0.7, 0.0, 0.2])])
def test_each_contact_adds_by_its_own_motion_and_a_share_of_what_all_add_together(first, laws):
    target = targets_of(first)[0][0]
    motion = target.way.at(0.4)[0] - first.centers
    e = laws.error(first)
    alone = np.array([laws.error(target.imagined(0.4, i)) - e for i in range(3)])
    together = laws.error(target.imagined(0.4)) - e - alone.sum(axis=0)
    A, _ = target._secant(laws, motion, 0.4, 1.0)
    for i in range(3):
        one = np.zeros((3, 3))
        one[i] = motion[i]
        step = np.linalg.lstsq(first.jacobian, one.ravel(), rcond=None)[0]
        np.testing.assert_allclose(A @ step, alone[i] + together / 3.0, atol=1e-9)


def test_what_a_grasp_would_be_on_the_way_is_felt_where_the_surface_says(first):
    target = targets_of(first)[0][0]
    c, n = target.way.at(0.3)
    whole, one = target.imagined(0.3), target.imagined(0.3, 1)
    np.testing.assert_allclose(whole.positions, c - TIP * n)
    np.testing.assert_array_equal(whole.normals, n)
    np.testing.assert_array_equal(one.normals[[0, 2]], first.normals[[0, 2]])
    np.testing.assert_array_equal(one.normals[1], n[1])
    np.testing.assert_array_equal(whole.q, first.q)
    np.testing.assert_allclose(target.imagined(0.0).positions, first.positions, atol=1e-6)


def test_a_hand_that_found_nothing_is_sent_around_opposite_sides_first():
    policy, nothing = MissPolicy(), Missed(Miss.NO_TOUCH, "x")
    ways = [policy.direction([nothing] * n) for n in range(1, 9)]
    t = np.radians([0.0, 180.0, 90.0, 270.0, 45.0, 225.0, 135.0, 315.0])
    level = 0.02 * np.column_stack([np.cos(t), np.sin(t), np.zeros(8)])  # [m]
    np.testing.assert_allclose(ways, level, atol=1e-12)
    assert policy.direction([nothing] * 9) is None
    # A passing trouble among them is tried again there, and costs no side.
    stuck = Missed(Miss.BLOCKED, "x")
    np.testing.assert_array_equal(policy.direction([nothing, stuck]), np.zeros(3))
    np.testing.assert_allclose(policy.direction([nothing, stuck, nothing]), ways[1], atol=1e-12)
    assert policy.direction([stuck] * 4) is None


def test_by_default_a_hand_tries_three_shares_six_centimetres_back_and_four_times_again():
    policy = MissPolicy()
    assert policy.shares == (1.0, 0.5, 0.25) and not policy.restart
    assert (policy.retreat, policy.retreats, policy.repeats) == (0.01, 6, 4)


def test_of_targets_the_first_that_nothing_keeps_the_hand_from_is_taken():
    class Asked:
        def __init__(self, obstacle):
            self.is_in_the_way, self.asked = obstacle, 0

        def obstacle(self, robot, gain):
            self.asked += 1
            return self.is_in_the_way

    for obstacles, taken, asked in (
        ((0.5, 0.0, 0.0), 1, [1, 1, 0]),
        ((0.5, 0.2, np.inf), 1, [1, 1, 1]),
        ((0.3, 0.3), 0, [1, 1]),
    ):
        targets = [Asked(obstacle) for obstacle in obstacles]
        assert nearest_free(targets, None, 1.0) is targets[taken]
        assert [target.asked for target in targets] == asked
