"""The surface felt as points and as walls, on outlines of known shape."""

import dataclasses
import itertools

import numpy as np
import pytest

from hqp_grasp.errors import InputError
from hqp_grasp.grasp import Contact, Grasp, Miss, Missed, Touch
from hqp_grasp.surface.believed import believed
from hqp_grasp.surface.felt import Felt
from hqp_grasp.surface.outline import SAME_ANGLE, Outline, _zero_sum, directions, wrapped
from hqp_grasp.surface.rounded import Rounded
from hqp_grasp.surface.walls import Walls

SLACK = 2e-06
UNDECIDED = 1e-05

UP = np.array([0.0, 0.0, 1.0])
TIP = 0.008  # [m]
EXACT = 50 * SLACK  # [m] radii bear SLACK over 1 − n·n', 1/50 at least here
TURNED = SLACK / 5e-3  # [rad] by which a piece between balls leans, 5 mm long at least here


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
    return Walls.of(Felt.of(history, 2.0 * radius), UP, TIP).outline


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
    memory = Felt.of([history])
    assert memory.radii[1] < EXACT
    outline = Walls.of(memory, UP, TIP).outline
    for degrees in (5.0, 40.0, 85.0):
        center = 0.04 + TIP * directions(np.radians(degrees))
        assert normal_at(outline, center)[0] == pytest.approx(degrees, abs=1.0)


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
    memory = Felt.of([on_square(0.04, 0.0, *[("side", 0, y) for y in (-0.01, 0.0, 0.01)])])
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
    outline = Outline.around(c, R, np.eye(3)[:2], TIP)
    theta, x = outline.at(np.array([0.0, 0.1]))
    np.testing.assert_allclose(x, c + R * directions(theta), atol=1e-12)


def test_points_that_a_fresh_touch_contradicts_are_forgotten():
    """The object moves by 2 mm: old points on the sides touched anew go, the others stay."""
    old = on_circle(0.05, 0.0, 120.0, 180.0)
    new = on_circle(0.05, 0.0, 180.0, center=(0.002, 0.0))
    memory = Felt.of([old, new])
    assert memory.probes.tolist() == [0, 1, 1]
    np.testing.assert_allclose(memory.normals[0], [-0.5, np.sqrt(0.75), 0.0])


@pytest.mark.parametrize(("beyond", "stays"), [(1.9e-4, True), (2.2e-4, False), (-2.2e-4, False)])
def test_a_fifth_of_a_millimetre_beyond_a_tangent_plane_contradicts_it(beyond, stays):
    """Either way: of two points that cannot both be of a convex object the older one goes."""
    old = touched([[0.05, 0.0], [-0.05, 0.0]], [[1.0, 0.0], [-1.0, 0.0]])
    new = touched([[0.05 + beyond, 0.01]], [[1.0, 0.0]])
    assert Felt.of([old, new]).probes.tolist() == ([0, 0, 1] if stays else [0, 1])


def test_misses_leave_no_trace():
    first = on_circle(0.04, 0.0, 120.0, 240.0)
    missed = Touch(first.q_target, Missed(Miss.NO_TOUCH, "finger_1"))
    with_miss, without = Felt.of([first, missed]), Felt.of([first])
    np.testing.assert_array_equal(with_miss.positions, without.positions)


def test_a_memory_needs_a_touch():
    with pytest.raises(InputError, match="nothing has been felt yet"):
        Felt.of([Touch(np.zeros(2), Missed(Miss.NO_TOUCH, "finger_1"))])


def test_the_axis_is_that_of_the_sides_though_ends_were_felt_often():
    side = on_circle(0.05, 0.0, 130.0, 200.0)
    contacts = [Contact([0.0, 0.0, 0.06], UP), *side.felt.contacts[1:]]
    end = Touch(side.felt.q, dataclasses.replace(side.felt, contacts=tuple(contacts)))
    memory = Felt.of([side] + 5 * [end])
    np.testing.assert_allclose(memory.axis(end.felt), UP, atol=10 * UNDECIDED)


def test_the_axis_is_that_of_the_sides_though_a_rim_was_felt():
    """Five contacts that lean by 0.25 beside three on the sides turn it by no more than 2e-3."""
    side = on_circle(0.05, 0.0, 130.0, 200.0)
    n = np.array([np.sqrt(1.0 - 0.25**2), 0.0, 0.25])
    rim = Contact([0.05, 0.0, 0.06], n, tip_radius=TIP)
    leaning = dataclasses.replace(side.felt, contacts=(rim, *side.felt.contacts[1:]))
    memory = Felt.of([side] + 5 * [Touch(side.felt.q, leaning)])
    np.testing.assert_allclose(memory.axis(side.felt), UP, atol=2e-3)


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


def test_noise_neither_sharpens_a_circle_nor_has_it_forgotten():
    rng, true = np.random.default_rng(3), on_circle(0.05, 0.0, 120.0, 240.0)
    turned = on_circle(0.05, 4.0, 124.0, 244.0)
    history = [noisy(touch, 0.01, rng) for touch in (true, turned, true, turned)]
    memory = Felt.of(history)
    assert len(memory.radii) == 12
    assert memory.radii.min() > 0.03


# ---------------------------------------------------------------- any number of contacts


@pytest.mark.parametrize("k", range(2, 9))
def test_angles_near_those_given_sum_to_zero_in_their_order(k):
    rng = np.random.default_rng(k)
    theta = 2.0 * np.pi * np.arange(k) / k + 0.2 * rng.standard_normal(k)
    t = _zero_sum(theta)
    np.testing.assert_allclose(directions(t).sum(axis=0), 0.0, atol=SAME_ANGLE)
    assert (np.diff(t, append=t[0]) % (2.0 * np.pi)).sum() == pytest.approx(2.0 * np.pi)
    equal = 2.0 * np.pi / k * np.arange(k)
    # But for a turn of all together they are nearer than equal angles.
    assert abs(np.exp(1j * (t - theta)).sum()) > abs(np.exp(1j * (equal - theta)).sum()) - 1e-3


def test_parallel_normals_are_spread_evenly():
    np.testing.assert_allclose(_zero_sum(np.zeros(5)), 2.0 * np.pi / 5 * np.arange(5))


@pytest.mark.parametrize("k", range(2, 9))
def test_any_number_of_contacts_finds_balance_on_a_cylinder_and_a_hexagon(k):
    angles = 360.0 / k * np.arange(k) + 7.0 * np.cos(3.0 * np.arange(k))
    circle = on_circle(0.05, *angles)
    faces = np.radians(30.0 + 60.0 * np.arange(6))
    sides = [(0.05 * directions(t), directions(t)) for t in faces]
    hexagon = [touched([x for x, _ in sides], [n for _, n in sides])]
    grasp = hexagon[0].felt
    on_faces = [grasp.contacts[i % 6] for i in range(k)]
    spread = [
        dataclasses.replace(
            c, position=c.position + 2e-3 * i * np.array([-c.normal[1], c.normal[0], 0])
        )
        for i, c in enumerate(on_faces)
    ]
    on_hexagon = Grasp(np.zeros(2), tuple(spread), np.zeros((3 * k, 2)))
    for history, felt in (
        ([circle], circle.felt),
        ([*hexagon, Touch(np.zeros(2), on_hexagon)], on_hexagon),
    ):
        ways = Walls.of(Felt.of(history), UP, TIP).ways(felt)
        centers, normals = ways[0].at(1.0)
        np.testing.assert_allclose(normals.sum(axis=0), 0.0, atol=k * TURNED)
        np.testing.assert_allclose(np.cross(normals, centers).sum(axis=0), 0.0, atol=2e-3)
        np.testing.assert_allclose(ways[0].at(0.0)[0], felt.centers, atol=1e-12)


def raised(touch, heights):
    """The same contacts at these heights (k,) [m]."""
    felt = touch.felt
    contacts = tuple(
        dataclasses.replace(c, position=c.position + z * UP)
        for c, z in zip(felt.contacts, heights, strict=True)
    )
    return Touch(touch.q_target, dataclasses.replace(felt, contacts=contacts))


@pytest.mark.parametrize("k", range(2, 9))
def test_contacts_change_height_by_the_least_that_balances_their_moments(k):
    rng = np.random.default_rng(k)
    heights = rng.uniform(-0.05, 0.05, k)
    touch = raised(on_circle(0.2, *360.0 / k * np.arange(k)), heights)
    centers, normals = Walls.of(Felt.of([touch], 0.4), UP, TIP).ways(touch.felt)[0].at(1.0)
    np.testing.assert_allclose(np.cross(normals, centers).sum(axis=0), 0.0, atol=1e-5)
    change, n = centers[:, 2] - heights, normals[:, :2]
    # The least change is along what turns the moment, and two or three contacts end level.
    along = n @ np.linalg.lstsq(n, change, rcond=None)[0]
    np.testing.assert_allclose(change, along, atol=1e-5)
    if k <= 3:
        np.testing.assert_allclose(centers[:, 2], heights.mean(), atol=1e-5)


def test_six_contacts_around_a_corner_go_back_to_the_two_faces_they_came_from():
    half, sides = 0.2, [("side", 1, -0.1), ("side", 1, 0.0), ("side", 1, 0.1)]
    felt = on_square(half, 0.01, *sides, ("side", 3, 0.12), ("side", 3, -0.05), ("side", 0, -0.19))
    ways = Walls.of(Felt.of([felt], 0.4), UP, TIP).ways(felt.felt)
    centers, normals = ways[0].at(1.0)
    np.testing.assert_allclose(np.abs(normals[:, 1]), 1.0, atol=TURNED)
    np.testing.assert_allclose(normals.sum(axis=0), 0.0, atol=6 * TURNED)
    np.testing.assert_allclose(np.cross(normals, centers).sum(axis=0), 0.0, atol=2e-3)
    assert normals[-1, 1] < 0.0  # to the face beside its own, and there it is the third


def test_walls_reach_as_far_as_was_felt():
    walls = Walls.of(Felt.of([on_circle(0.05, 0.0, 120.0, 240.0)]), UP, TIP)
    np.testing.assert_allclose(
        walls.reach(np.array([[1.0, 0.0, 0.0], UP])), [0.05, 0.0], atol=1e-12
    )


@pytest.mark.parametrize("lean", [0.0, 0.01, 0.011, 0.2])
def test_where_normals_lean_by_more_than_noise_explains_all_is_rounded(lean):
    def leaning(lean, noise=0.0, rims=3):
        grasp = on_circle(0.05, 0.0, 120.0, 240.0).felt
        contacts = []
        for i, c in enumerate(grasp.contacts):
            n = c.normal + np.array([0.0, 0.0, lean if i < rims else 0.0])
            contacts.append(
                dataclasses.replace(
                    c, normal=n / np.linalg.norm(n), noise=noise, position=c.position
                )
            )
        grasp = dataclasses.replace(grasp, contacts=tuple(contacts))
        # Walls below and above tell the axis.
        flat = [on_circle(0.05, *(40.0 * i + np.array([0.0, 120.0, 240.0]))) for i in range(2)]
        return believed(Felt.of([*flat, Touch(grasp.q, grasp)]), grasp, 1e-3)

    assert isinstance(leaning(lean), Rounded if (3.0 * lean) ** 2 > 1e-3 else Walls)
    assert isinstance(leaning(lean, rims=1), Walls)
    assert isinstance(leaning(lean, noise=0.03), Rounded if lean > 0.1 else Walls)


def test_walls_turn_normals_around_their_axis_and_not_along_it():
    grasp = on_circle(0.05, 10.0, 130.0, 250.0).felt
    turn = Walls.of(Felt.of([Touch(grasp.q, grasp)]), UP, TIP).turn(grasp)
    h = 1e-6
    for i, (c, n) in enumerate(zip(grasp.centers, grasp.normals, strict=True)):
        around = np.cross(UP, n)
        ahead, behind = ((c + s * around) / np.linalg.norm(c + s * around) for s in (h, -h))
        np.testing.assert_allclose(turn[i] @ around, (ahead - behind) / (2.0 * h), atol=0.01)
        np.testing.assert_allclose(turn[i] @ UP, 0.0, atol=1e-12)
        np.testing.assert_allclose(turn[i] @ n, 0.0, atol=1e-12)


def test_two_rims_beside_the_sides_do_not_turn_the_axis_at_all():
    """What leans by more than an end face's rim does has no say once the axis is about known."""
    sides = on_circle(0.05, *range(0, 360, 30)).felt.contacts
    n = np.array([0.8, 0.0, 0.6])
    rims = [Contact([0.05, 0.01 * i, 0.06], n, tip_radius=TIP) for i in range(2)]
    grasp = Grasp(np.zeros(2), (*sides, *rims), np.zeros((42, 2)))
    axis = Felt.of([Touch(grasp.q, grasp)]).axis(grasp)
    np.testing.assert_allclose(axis, UP, atol=1e-5)
