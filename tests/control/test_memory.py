"""The surface memory on outlines of known shape, and the form that goes by it."""

import dataclasses
import itertools

import numpy as np
import pytest
from hqp_grasp.scenarios import irregular

from hqp_grasp.control.aim import PURSUED, Aim
from hqp_grasp.control.controller import Controller
from hqp_grasp.control.forms import REACHED, form_of
from hqp_grasp.control.limits import cap_ratio
from hqp_grasp.control.memory import (
    KNOWN,
    SAME_PLACE,
    SLACK,
    UNDECIDED,
    SurfaceMemory,
    narrowed,
    steadied,
)
from hqp_grasp.control.outline import Outline, directions, wrapped
from hqp_grasp.control.settling import BEYOND, FORCE_GOAL, MOMENT_GOAL, PATIENCE, Course
from hqp_grasp.errors import InputError
from hqp_grasp.experiments.trial import Trial
from hqp_grasp.grasp import Contact, Grasp, Miss, Missed, Touch
from hqp_grasp.hierarchy.level import Level
from hqp_grasp.history import load_history, save_history
from hqp_grasp.tasks import ForceTask, MomentTask, stack_of
from hqp_grasp.tasks.limit import Limit, Priority
from hqp_grasp.touch.geometric import GeometricProbe
from hqp_grasp.world.scene import Cylinder, Prism, Scene

UP = np.array([0.0, 0.0, 1.0])
TIP = 0.008  # [m]
EXACT = 50 * SLACK  # [m] radii bear SLACK over 1 − n·n', 1/50 at least here
TURNED = SLACK / 5e-3  # [rad] by which a piece between balls leans, 5 mm long at least here
HEXAGON = Prism.regular(6, 0.06)


def touched(points, normals, tip_radius=TIP):
    """A history of one grasp, with these contacts (k, 2) at height 0."""
    contacts = [
        Contact([*x, 0.0], [*n, 0.0], tip_radius=tip_radius)
        for x, n in zip(points, normals, strict=True)
    ]
    grasp = Grasp(np.zeros(2), tuple(contacts), np.zeros((3 * len(contacts), 2)))
    return Touch(grasp.q, grasp)


def on_circle(radius, *degrees, center=(0.0, 0.0)):
    n = directions(np.radians(degrees))
    return touched(np.array(center) + radius * n, n)


def on_square(half, rounding, *places):
    """Contacts on a square with rounded corners: (side, along) on a face, (corner, degrees) off."""
    x, n = [], []
    for kind, where, value in places:
        turn = np.radians(90.0 * where)
        R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        if kind == "side":
            x.append(R @ [half, value])
            n.append(R @ [1.0, 0.0])
        else:
            d = directions(np.radians(value))
            x.append(R @ (half - rounding + rounding * d))
            n.append(R @ d)
    return touched(x, n)


def outline_of(*history, radius=0.05):
    memory = SurfaceMemory.of(history, radius)
    return memory.outline(UP, TIP)


def normal_at(outline, *centers):
    """Angles [deg] that the outline predicts where tips have these centres, as seen from above."""
    s = outline.locate(np.array(centers) @ outline.frame[:, :2].T)
    theta, _ = outline.at(s)
    n = directions(theta) @ outline.frame
    return np.degrees(np.arctan2(n[:, 1], n[:, 0]))


@pytest.mark.parametrize("radius", [0.02, 0.05, 0.065])
def test_a_circle_is_known_from_three_touches(radius):
    outline = outline_of(on_circle(radius, -6.0, -77.0, -163.0, center=(0.01, -0.02)))
    s = np.linspace(0.0, outline.length, 50)
    theta, x = outline.at(s)
    true = outline.frame[:, :2] @ [0.01, -0.02] + radius * directions(theta)
    np.testing.assert_allclose(x, true, atol=EXACT)
    assert outline.length == pytest.approx(2.0 * np.pi * (radius + TIP), rel=1e-3)


def test_points_felt_lie_on_the_outline_with_the_normals_felt():
    history = on_square(0.04, 0.01, ("side", 0, 0.01), ("corner", 0, 30.0), ("side", 2, -0.02))
    outline = outline_of(history)
    grasp = history.felt
    centers = grasp.positions + TIP * grasp.normals
    n = grasp.normals
    felt = np.degrees(np.arctan2(n[:, 1], n[:, 0]))
    off = wrapped(np.radians(normal_at(outline, *centers[:, :2]) - felt))
    np.testing.assert_allclose(off, 0.0, atol=TURNED)


def test_between_two_points_of_a_face_the_outline_is_straight():
    history = on_square(0.04, 0.0, ("side", 0, -0.02), ("side", 0, 0.025), ("side", 2, 0.0))
    outline = outline_of(history)
    for y in np.linspace(-0.02, 0.025, 7):
        assert normal_at(outline, (0.04 + TIP, y))[0] == pytest.approx(0.0, abs=np.degrees(TURNED))


def test_a_rounded_corner_is_exact_between_the_points_felt_on_it():
    """Both ends of the arc and its middle: the arc between is the arc of the corner."""
    history = on_square(
        0.04, 0.01, ("side", 0, 0.03), ("corner", 0, 45.0), ("side", 1, -0.03), ("side", 2, 0.0)
    )
    outline = outline_of(history)
    for degrees in (10.0, 30.0, 45.0, 70.0):
        center = 0.03 + (0.01 + TIP) * directions(np.radians(degrees))
        assert normal_at(outline, center)[0] == pytest.approx(degrees, abs=0.5)


def test_an_edge_felt_beside_its_face_is_sharp():
    history = on_square(
        0.04, 0.0, ("side", 0, 0.01), ("corner", 0, 40.0), ("side", 1, 0.0), ("side", 2, 0.0)
    )
    memory = SurfaceMemory.of([history])
    assert memory.radii[1] < EXACT
    for degrees in (5.0, 40.0, 85.0):
        center = 0.04 + TIP * directions(np.radians(degrees))
        assert normal_at(memory.outline(UP, TIP), center)[0] == pytest.approx(degrees, abs=1.0)


def test_an_edge_is_taken_to_turn_on_beyond_what_was_felt():
    """No ball beside it may lie against the edge's plane, as if the edge went on as a face."""
    places = ("side", 0, 0.0), ("corner", 0, 30.0), ("side", 2, 0.0)
    outline = outline_of(on_square(0.04, 0.0, *places))
    center = 0.04 + TIP * directions(np.radians(33.0))
    assert normal_at(outline, center)[0] == pytest.approx(33.0, abs=0.5)


def test_corners_sharpen_with_every_touch_of_a_flat_face():
    beside = ("side", 1, 0.0), ("side", 2, 0.0), ("side", 3, 0.0)
    felt, turned = [], []
    for y in (0.0, 0.005, 0.01, 0.015):
        felt.append(on_square(0.04, 0.0, ("side", 0, y), *beside[: 2 + (y > 0.0)]))
        turned.append(normal_at(outline_of(*felt), (0.04 + TIP, 0.025))[0])
    assert all(later < earlier for earlier, later in itertools.pairwise(turned))


def test_a_face_is_taken_to_go_on_beside_an_edge_too():
    """Of the face two points are felt, then more; beside it the corner at 45°, never its face."""
    edge = ("corner", 0, 45.0), ("side", 2, 0.0), ("side", 3, 0.0)
    felt, turned = [], []
    for y in (-0.03, -0.02, -0.015, -0.01):
        felt.append(on_square(0.04, 0.0, ("side", 0, y), *edge))
        turned.append(normal_at(outline_of(*felt), (0.04 + TIP, 0.02))[0])
    assert all(later < 0.8 * earlier for earlier, later in itertools.pairwise(turned[1:]))


def test_a_point_at_the_end_of_a_face_leaves_it_a_face():
    """The corner beyond the other end sharpens all the same."""
    beside = ("corner", 3, 90.0), ("corner", 3, 30.0), ("side", 1, 0.0)
    felt, turned = [], []
    for y in (-0.035, -0.02, -0.01):
        felt.append(on_square(0.04, 0.0, ("side", 0, y), *beside))
        turned.append(normal_at(outline_of(*felt), (0.04 + TIP, 0.036))[0])
    assert turned[0] > 30.0 > 20.0 > turned[1] > 10.0 > 0.1 > turned[2]


def test_the_outline_holds_what_was_felt_of_end_faces():
    side = on_circle(0.05, -20.0, 0.0, 20.0)
    contacts = [Contact([-0.03, -0.06, 0.06], UP, tip_radius=TIP), *side.felt.contacts[1:]]
    end = Touch(side.felt.q, dataclasses.replace(side.felt, contacts=tuple(contacts)))
    outline = outline_of(side, end)
    theta, x = outline.at(np.linspace(0.0, outline.length, 200))
    outside = (directions(theta) * (outline.frame[:, :2] @ [-0.03, -0.06] - x)).sum(axis=1)
    assert outside.max() < EXACT


def test_normals_alike_leave_the_radius_to_the_prior():
    memory = SurfaceMemory.of([on_square(0.04, 0.0, *[("side", 0, y) for y in (-0.01, 0.0, 0.01)])])
    assert (memory.radii > 0.05).all()


def test_the_sign_and_way_around_do_not_matter():
    outline = outline_of(on_circle(0.05, 0.0, 120.0, 240.0))
    s = np.array([0.01, 0.02])
    np.testing.assert_allclose(outline.way(s, s + 3.0 * outline.length), 0.0, atol=1e-12)
    np.testing.assert_allclose(outline.way(s, s - 0.004), -0.004, atol=1e-12)


@pytest.mark.parametrize("degrees", [(-6.0, -77.0, -163.0), (-163.0, -77.0, -6.0)])
def test_balanced_places_have_no_net_force_and_moment_whatever_the_order(degrees):
    outline = outline_of(on_circle(0.05, *degrees))
    s = outline.locate((0.05 + TIP) * directions(np.radians(degrees)) @ outline.frame[:, :2].T)
    cost, places = outline.balanced(s)
    theta, x = outline.at(places[cost.argmin()])
    n = directions(theta)
    assert np.abs(n.sum(axis=0)).max() < 1e-9
    assert abs((n[:, 0] * x[:, 1] - n[:, 1] * x[:, 0]).sum()) < 1e-4
    order = np.argsort(places[cost.argmin()])
    np.testing.assert_array_equal(order, np.argsort(s))


def test_balance_on_a_face_is_found_along_the_face():
    """Two edges and a face of a hexagon-like outline: the moment is balanced on the face."""
    flat = on_square(0.05, 0.0, ("side", 0, -0.04), ("side", 0, 0.04))
    round_side = on_circle(0.05, 110.0, 130.0, 230.0, 250.0)
    outline = outline_of(flat, round_side)
    s = outline.locate(
        np.array([[0.05 + TIP, 0.03], [-0.03, 0.05], [-0.03, -0.05]]) @ outline.frame[:, :2].T
    )
    cost, places = outline.balanced(s)
    theta, x = outline.at(places[cost.argmin()])
    n = directions(theta)
    assert abs((n[:, 0] * x[:, 1] - n[:, 1] * x[:, 0]).sum()) < 5e-4


def test_one_ball_is_a_circle_around():
    c, R = np.array([[0.01, 0.02]]), np.array([0.03])
    outline = Outline.around(c, R, np.eye(3)[:2], TIP, np.zeros(1))
    theta, x = outline.at(np.array([0.0, 0.1]))
    np.testing.assert_allclose(x, c + R * directions(theta), atol=1e-12)


def test_points_that_a_fresh_touch_contradicts_are_forgotten():
    """The object moves by 2 mm: old points on the sides touched anew go, the others stay."""
    old = on_circle(0.05, 0.0, 120.0, 180.0)
    new = on_circle(0.05, 0.0, 180.0, center=(0.002, 0.0))
    memory = SurfaceMemory.of([old, new])
    assert memory.probes.tolist() == [0, 1, 1]
    np.testing.assert_allclose(memory.normals[0], [-0.5, np.sqrt(0.75), 0.0])


def test_misses_leave_no_trace():
    first = on_circle(0.04, 0.0, 120.0, 240.0)
    missed = Touch(first.q_target, Missed(Miss.NO_TOUCH, "finger_1"))
    with_miss, without = SurfaceMemory.of([first, missed]), SurfaceMemory.of([first])
    np.testing.assert_array_equal(with_miss.positions, without.positions)


def test_a_memory_needs_a_touch():
    with pytest.raises(InputError, match="nothing has been felt yet"):
        SurfaceMemory.of([Touch(np.zeros(2), Missed(Miss.NO_TOUCH, "finger_1"))])


def test_the_axis_is_that_of_the_sides_though_ends_were_felt_often():
    side = on_circle(0.05, 0.0, 130.0, 200.0)
    contacts = [Contact([0.0, 0.0, 0.06], UP), *side.felt.contacts[1:]]
    end = Touch(side.felt.q, dataclasses.replace(side.felt, contacts=tuple(contacts)))
    memory = SurfaceMemory.of([side] + 5 * [end])
    np.testing.assert_allclose(memory.axis(end.felt), UP, atol=10 * UNDECIDED)


def test_the_axis_is_that_of_the_sides_though_a_rim_was_felt():
    """Five contacts that lean by 0.25 beside three on the sides turn it by no more than 2e-3."""
    side = on_circle(0.05, 0.0, 130.0, 200.0)
    n = np.array([np.sqrt(1.0 - 0.25**2), 0.0, 0.25])
    rim = Contact([0.05, 0.0, 0.06], n, tip_radius=TIP)
    leaning = dataclasses.replace(side.felt, contacts=(rim, *side.felt.contacts[1:]))
    memory = SurfaceMemory.of([side] + 5 * [Touch(side.felt.q, leaning)])
    np.testing.assert_allclose(memory.axis(side.felt), UP, atol=2e-3)


# --- the form -------------------------------------------------------------------------------


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


# ---------------------------------------------------------------- noise


def noisy(history, noise, rng):
    """The same contacts as a round tip feels them: the point lies where the normal says."""
    contacts = []
    for c in history.felt.contacts:
        n = c.normal + noise * rng.normal(size=3)
        n /= np.linalg.norm(n)
        x = c.position + c.tip_radius * (c.normal - n)
        contacts.append(dataclasses.replace(c, position=x, normal=n, noise=noise))
    return Touch(history.q_target, dataclasses.replace(history.felt, contacts=tuple(contacts)))


def test_touches_of_one_place_are_averaged_by_the_inverse_of_their_variance():
    rng, true = np.random.default_rng(1), on_circle(0.05, 0.0, 120.0, 240.0)
    off, told = [], []
    for _ in range(40):
        steady = steadied([noisy(true, noise, rng) for noise in (0.01, 0.01, 0.02, 0.02)])
        felt = steady[0].felt
        for c in felt.contacts:
            told.append(c.noise)
            center = c.position + TIP * c.normal
            assert np.linalg.norm(center) == pytest.approx(0.05 + TIP, abs=1e-12)
        off.append(felt.normals - true.felt.normals)
    across = np.sqrt((np.array(off) ** 2).sum(axis=-1).mean() / 2.0)
    assert across == pytest.approx(0.01 / np.sqrt(2.5), rel=0.2)
    assert np.median(told) == pytest.approx(0.01 / np.sqrt(2.5))  # some are too far off to count


def test_places_and_faces_that_differ_are_not_averaged():
    rng = np.random.default_rng(2)
    apart = np.degrees(1.5 * SAME_PLACE / (0.05 + TIP))
    one, other = (noisy(on_circle(0.05, a, 120.0 + a), 1e-3, rng) for a in (0.0, apart))
    edge = noisy(on_square(0.04, 0.0, ("corner", 0, 0.0), ("corner", 0, 5.0)), 1e-3, rng)
    for history in ([one, other], [edge]):
        for before, after in zip(history, steadied(history), strict=True):
            np.testing.assert_allclose(after.felt.normals, before.felt.normals, atol=1e-12)


def test_what_has_no_noise_stays_as_it_is():
    history = [on_circle(0.05, 0.0, 120.0, 240.0), on_circle(0.05, 0.1, 120.0, 240.0)]
    assert all(a is b for a, b in zip(history, steadied(history), strict=True))


def test_noise_neither_sharpens_a_circle_nor_has_it_forgotten():
    rng, true = np.random.default_rng(3), on_circle(0.05, 0.0, 120.0, 240.0)
    turned = on_circle(0.05, 4.0, 124.0, 244.0)
    history = [noisy(touch, 0.01, rng) for touch in (true, turned, true, turned)]
    memory = SurfaceMemory.of(history)
    assert len(memory.radii) == 12
    assert memory.radii.min() > 0.03


def test_under_noise_balance_is_judged_by_its_floor_and_patience_grows(cylinder, first):
    """What an exact sensor takes for worse, and for too late to go on, noise explains."""
    stack = stack_of("fmk")
    good = probed(cylinder, first, 6).grasps[-1]
    noise = 0.02
    felt = [dataclasses.replace(c, noise=noise) for c in good.contacts]
    unsure = dataclasses.replace(good, contacts=tuple(felt))
    history = [Touch(good.q, good)] * (PATIENCE + 1)
    np.testing.assert_array_equal(Course.of(stack, history).way_back(None), good.q)
    assert Course.of(stack, [Touch(good.q, unsure)] * (PATIENCE + 1)).way_back(None) is None
    # A push aside that is within the floor, but beyond the goals of an exact sensor.
    n = felt[0].normal + np.array([0.0, 0.0, 1.5 * np.sqrt(FORCE_GOAL)])
    for contact, lost in ((dataclasses.replace(felt[0], noise=0.0), True), (felt[0], False)):
        aside = dataclasses.replace(contact, normal=n / np.linalg.norm(n))
        others = [dataclasses.replace(c, noise=aside.noise) for c in felt[1:]]
        grasp = dataclasses.replace(good, contacts=(aside, *others))
        assert ForceTask().potential(grasp) > FORCE_GOAL
        assert (ForceTask().potential(grasp) > BEYOND * grasp.floor[0]) == lost
        history = [Touch(good.q, unsure), Touch(good.q + 0.1, grasp)]
        assert (Course.of(stack, history).way_back(None) is not None) == lost


def test_a_step_that_overshot_is_followed_by_shorter_ones(cylinder, first):
    """The kinematic law's step halves with each balanced grasp that it made worse."""
    stack = stack_of("fmk")
    good = probed(cylinder, first, 12).grasps[-1]
    worse = dataclasses.replace(good, jacobian=_turned(good.jacobian, 0.1))
    history = [Touch(good.q, good)]
    assert Course.of(stack, history).ease == 1.0
    assert Course.of(stack, [*history, Touch(good.q, worse)]).ease == 0.5
    assert Course.of(stack, [*history, Touch(good.q, worse), Touch(good.q, worse)]).ease == 0.25


def test_normals_that_all_lean_give_no_aim():
    """As at the corner of a box: along no direction does the surface felt keep its shape."""
    contacts = [Contact(0.05 * n, n, tip_radius=TIP) for n in np.eye(3)]
    grasp = Grasp(np.zeros(2), tuple(contacts), np.zeros((9, 2)))
    assert Aim.each(SurfaceMemory.of([Touch(grasp.q, grasp)]), grasp) == []


def test_convexity_bounds_normals_felt_with_noise():
    """Along a face they become exact between its ends; on a circle they stay what noise allows."""
    rng, sigma, rho = np.random.default_rng(0), 0.05, 0.008
    along = np.linspace(-0.02, 0.02, 9)
    face = np.column_stack([along, np.full(9, 0.03 + rho)])
    t = 0.5 * np.pi + sigma * rng.standard_normal(9)
    angle, error = narrowed(face, t, np.full(9, sigma))
    assert np.abs(angle - 0.5 * np.pi)[1:-1].max() < KNOWN / 0.005 < np.abs(t - 0.5 * np.pi).max()
    assert error[1:-1].max() < 0.2 * sigma
    true = np.linspace(-np.pi, np.pi, 40, endpoint=False)
    circle = (0.05 + rho) * np.column_stack([np.cos(true), np.sin(true)])
    t = true + sigma * rng.standard_normal(40)
    angle, error = narrowed(circle, t, np.full(40, sigma))
    off = np.abs((angle - true + np.pi) % (2.0 * np.pi) - np.pi)
    between = np.pi / 40 + KNOWN / 0.009  # half the way to the next
    assert off.max() < between + 1e-3
    assert error.max() <= sigma


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
    course = Course.of(stack, history)
    assert course.way_back(4) is None
    np.testing.assert_array_equal(course.way_back(3), better.q)


def test_noise_counts_against_a_grasp_that_is_to_be_returned_to(cylinder, first):
    """One felt once by a lucky touch is not better than one that is nearly as good for sure."""
    stack = stack_of("fmk")
    felt = probed(cylinder, first, 3).grasps[1]
    lucky = [dataclasses.replace(c, noise=0.2) for c in felt.contacts]
    n = felt.contacts[0].normal + 1e-3
    sure = (dataclasses.replace(felt.contacts[0], normal=n / np.linalg.norm(n)), *felt.contacts[1:])
    grasps = [dataclasses.replace(felt, contacts=tuple(v)) for v in (lucky, sure)]
    course = Course.of(stack, [Touch(g.q, g) for g in grasps])
    assert course.scores[0] < course.scores[1] and course.nearest == 1


def test_tips_that_are_no_balls_take_shorter_steps_until_they_balance(cylinder, first):
    """Half for each grasp that was not balanced; balls, whose radii stay, take whole steps."""
    stack = stack_of("fmk")
    start = probed(cylinder, first, 1).grasps[0]
    other = tuple(dataclasses.replace(c, tip_radius=2.0 * c.tip_radius) for c in start.contacts)
    changed = dataclasses.replace(start, contacts=other)
    round_tips, flat_tips = ([Touch(g.q, g) for g in v] for v in ([start] * 3, [start, changed]))
    assert ForceTask().potential(start) > FORCE_GOAL
    assert Course.of(stack, round_tips).ease == 1.0
    longer = [[*flat_tips, *round_tips[:i]] for i in range(3)]
    assert [Course.of(stack, v).ease for v in longer] == [0.5, 0.25, 0.125]


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


def test_secant_levels_ask_exactly_for_the_predicted_motion(cylinder, first):
    """A step that moves the contacts as predicted meets contact, force, moment and way."""
    aim = Aim.each(SurfaceMemory.of([Touch(first.q, first)]), first)[0]
    aimed, below = aim.levels(stack_of("fmk"), 0.3)
    motion, _ = aim.predicted(0.3)
    x = np.linalg.lstsq(first.jacobian, motion.ravel(), rcond=None)[0]
    assert [level.name for level in below] == ["kinematic"]
    for level in aimed:
        np.testing.assert_allclose(level.A @ x, level.upper, atol=1e-9)


def test_the_whole_way_leads_to_balance(cylinder, first):
    aim = Aim.each(SurfaceMemory.of([Touch(first.q, first)]), first)[0]
    motion, normals = aim.predicted(1.0)
    centers = cylinder.articulated.centers(first.q) + motion
    np.testing.assert_allclose(normals.sum(axis=0), 0.0, atol=3 * TURNED)
    x = centers - TIP * normals
    moment = np.cross(normals, x - x.mean(axis=0)).sum(axis=0)
    np.testing.assert_allclose(moment, 0.0, atol=1e-3)


def test_an_aim_that_many_grasps_went_for_in_vain_seems_farther(cylinder, first):
    memory = SurfaceMemory.of([Touch(first.q, first)])
    best = Aim.each(memory, first)
    i = int(np.argmin([((aim.places - aim.s) ** 2).sum() for aim in best]))  # the nearest
    few, many = (Aim.each(memory, first, n * [first]) for n in (PURSUED, PURSUED + 100))
    assert [aim.cost for aim in few] == [aim.cost for aim in best]
    assert many[-1].cost == best[i].cost and i < len(best) - 1


def test_an_aim_out_of_reach_is_passed_over_though_its_first_step_fits(cylinder, first):
    """Ranges a little wider than the first step, which fits: the rest of the way does not."""
    form, history = form_of("hierarchy"), [Touch(first.q, first)]
    stack = Controller(cylinder.articulated, stack_of("fm")).stack
    memory = SurfaceMemory.of(history)
    best = Aim.each(memory, first)[0]
    free = form.plan(stack, first, history)
    assert free.limit_active  # by its caps
    tight = stack.within(Around(first.q, 1.05 * np.abs(free.x)))
    assert form._missing(best, 1.0, stack) < REACHED < form._missing(best, 1.0, tight)


def test_a_careful_step_that_misses_is_followed_by_other_ways(cylinder, first):
    stack = Controller(cylinder.articulated, stack_of("fmk")).stack
    form, history = form_of("hierarchy"), [Touch(first.q, first)]
    miss = Touch(first.q, Missed(Miss.NO_TOUCH, "finger_1"))
    steps = [form.plan(stack, first, history + n * [miss], careful=True).x for n in (0, 2, 4, 6)]
    paper, memoryless = (
        form_of(name).plan(stack, first).x for name in ("paper-hierarchy", "memoryless")
    )
    np.testing.assert_array_equal(steps[0], paper)
    assert np.abs(steps[1] - paper).max() > 0.01 < np.abs(steps[1] - memoryless).max()
    np.testing.assert_array_equal(steps[2], memoryless)
    np.testing.assert_array_equal(steps[3], paper)


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
    plain = Controller(hexagon.articulated, stack_of("f"), "hierarchy", landing=False)
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
        assert ForceTask().potential(grasp) <= FORCE_GOAL
        assert MomentTask().potential(grasp) <= MOMENT_GOAL
    # Where the object was held when it moved, it was touched anew: nothing old is left there.
    left = set(SurfaceMemory.of(history).probes.tolist())
    assert not left & set(range(6, 11)) and set(range(15, 26)) <= left


def test_a_balanced_grasp_is_kept_once_a_step_from_it_missed(cylinder, first):
    stack = stack_of("fmk")
    record = probed(cylinder, first, 6)
    good = record.grasps[-1]
    history = [Touch(first.q, first), Touch(good.q, good)]
    assert Course.of(stack, history).way_back(None) is None
    history.append(Touch(good.q + 0.1, Missed(Miss.NO_TOUCH, "finger_1")))
    np.testing.assert_array_equal(Course.of(stack, history).way_back(None), good.q)
    history.append(Touch(good.q, first))  # it is not there any more
    assert Course.of(stack, history).way_back(None) is None


def test_the_best_grasp_is_returned_to_as_the_budget_runs_out(cylinder, first):
    stack = Controller(cylinder.articulated, stack_of("fmk"), "hierarchy").stack
    record = probed(cylinder, first, 3)
    better, worse = record.grasps[1], record.grasps[0]
    history = [Touch(better.q, better), Touch(worse.q, worse)]
    assert Course.of(stack, history).way_back(30) is None
    np.testing.assert_array_equal(Course.of(stack, history).way_back(1), better.q)


def test_stacks_without_force_and_moment_are_the_plain_hierarchy(cylinder, first):
    history = [Touch(first.q, first)]
    steps = [
        Controller(cylinder.articulated, stack_of("k"), form).step(history).q_target
        for form in ("hierarchy", "memoryless")
    ]
    assert steps[0].tobytes() == steps[1].tobytes()


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
