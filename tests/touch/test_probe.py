"""Touching: where the tips end up, that nothing was touched before, and every way to miss."""

import pickle
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import tiny_hand
from surfaces import nearest_on_circle, nearest_on_polygon
from tiny_hand import LENGTH, STIFF, TIP, TOML, change

from hqp_grasp.control.limits import StepLimit
from hqp_grasp.errors import InputError
from hqp_grasp.experiments.trial import Trial
from hqp_grasp.grasp import Grasp, Miss, Missed
from hqp_grasp.tasks import KinematicTask, stack_of
from hqp_grasp.touch.geometric import GeometricProbe
from hqp_grasp.world.scene import Cylinder, Prism, Scene

RETREAT = 0.35

SURFACE_TOL = 1e-7  # [m]
NORMAL_TOL = 1e-6
AGAIN_TOL = 1e-7  # [rad]
EXACT = 1e-12
HANDS = Path(__file__).parents[2] / "benchmarks" / "robots"
TALL = 0.4  # [m] so that only the sides are met
OBJECTS = {"cylinder": Cylinder(0.05, TALL), "hexagon": Prism.regular(6, 0.05, TALL)}
POSTURES = (  # [rad] from which every finger touches either object
    (0.62, 1.12, -0.73, 1.96, 0.63, -0.41, 0.49, 0.21, 1.01, 0.99, 0.98),
    (-0.78, 1.21, 1.02, 1.86, -0.71, 0.02, -0.62, 0.54, 0.9, 1.25, 1.03),
    (0.32, 0.94, -0.35, 2.21, 0.17, -0.86, 0.33, 0.29, 0.96, 1.17, 1.02),
    (-0.75, 1.33, 1.16, 1.48, -0.28, 0.71, -1.38, 0.25, 0.96, 1.22, 1.03),
)
# and one where links of finger 1 are in the cylinder
CROWDED = (-0.72, 1.14, 0.88, 1.93, -0.63, -0.18, -0.59, 1.06, 0.66, 1.2, 1.02)


class World:
    """A scene, its probe, and grasps felt around the postures."""

    def __init__(self, thing, around=6):
        self.scene = Scene(object=thing)
        self.robot = self.scene.articulated
        self.probe = GeometricProbe(self.scene, links="pass")
        self.data = mujoco.MjData(self.scene.model)
        self.flexion = [j for (j,) in self.robot.flexion]
        self.grasps, self.targets, self.missed = [], [], []
        rng = np.random.default_rng(0)
        for posture in POSTURES:
            for _ in range(around):
                q = posture + rng.normal(0.0, 0.05, self.robot.n)
                q = np.clip(q, self.robot.q_lower, self.robot.q_upper)
                touched = self.probe.touch(q)
                if isinstance(touched, Grasp):
                    self.grasps.append(touched)
                    self.targets.append(q)
                else:
                    self.missed.append((q, touched))
        assert len(self.grasps) >= 10

    def nearest(self, p):
        """Signed distance of p (3,) from the object, and the outward normal there (3,)."""
        above = p[:2] - self.scene.position[:2]
        thing = self.scene.object
        if isinstance(thing, Cylinder):
            distance, normal = nearest_on_circle(thing.radius, above)
        else:
            distance, normal = nearest_on_polygon(thing.polygon, above)
        return distance, np.array([*normal, 0.0])


@pytest.fixture(scope="module", params=OBJECTS)
def world(request):
    return World(OBJECTS[request.param])


def same(a, b):
    """Bitwise the same outcome."""
    if isinstance(a, Missed) or isinstance(b, Missed):
        return a == b
    fields = ("q", "jacobian", "hessian", "positions", "normals")
    return a.other_links == b.other_links and all(
        np.array_equal(getattr(a, f), getattr(b, f)) for f in fields
    )


# ---------------------------------------------------------------- what a grasp says


def test_contacts_lie_on_the_surface(world):
    for grasp in world.grasps:
        for x in grasp.positions:
            assert abs(world.nearest(x)[0]) < SURFACE_TOL


def test_normals_are_the_surfaces(world):
    for grasp in world.grasps:
        for contact, center in zip(grasp.contacts, world.robot.centers(grasp.q), strict=True):
            # At the tip's centre, off the surface, the normal is defined at a corner too.
            _, normal = world.nearest(center)
            np.testing.assert_allclose(contact.normal, normal, atol=NORMAL_TOL)
            np.testing.assert_allclose(
                contact.position + contact.tip_radius * contact.normal, center, atol=EXACT
            )


def test_arm_and_spread_are_the_targets_and_every_joint_is_in_its_range(world):
    kept = [j for j in range(world.robot.n) if j not in world.flexion]
    for grasp, target in zip(world.grasps, world.targets, strict=True):
        np.testing.assert_array_equal(grasp.q[kept], target[kept])
        assert world.robot.violation(grasp.q) == 0.0


def test_touching_again_from_the_grasp_gives_the_same_grasp(world):
    for grasp in world.grasps:
        again = world.probe.touch(grasp.q)
        assert isinstance(again, Grasp)
        np.testing.assert_allclose(again.q, grasp.q, rtol=0, atol=AGAIN_TOL)
        np.testing.assert_allclose(again.positions, grasp.positions, rtol=0, atol=SURFACE_TOL)
        assert again.other_links == grasp.other_links


def test_no_tip_met_the_object_earlier_on_its_way(world):
    for grasp, target in zip(world.grasps, world.targets, strict=True):
        q = grasp.q.copy()
        opened = np.maximum(world.robot.q_lower, target - RETREAT)[world.flexion]
        for share in np.linspace(0.0, 1.0, 150, endpoint=False):
            q[world.flexion] = opened + share * (grasp.q[world.flexion] - opened)
            gaps = [world.nearest(x)[0] for x in world.robot.centers(q)]
            gaps = np.array(gaps) - world.robot.tip_radius
            if share == 0.0 and gaps.min() < 0.0:  # then it opened all the way
                opened = world.robot.q_lower[world.flexion]
                continue
            assert gaps.min() > -SURFACE_TOL


def test_jacobian_hessian_and_coupling_are_the_robots_where_it_stands(world):
    for grasp in world.grasps:
        world.robot.place(world.data, grasp.q)
        np.testing.assert_array_equal(grasp.jacobian, world.robot.jacobian(grasp.q))
        np.testing.assert_array_equal(grasp.hessian, world.robot.hessian(grasp.q))
        np.testing.assert_array_equal(grasp.coupling, world.robot.coupling)
        np.testing.assert_array_equal(grasp.offset, world.robot.offset)
        np.testing.assert_array_equal(grasp.q_full, world.data.qpos)


def test_each_contact_names_its_tip_its_link_and_the_point_on_it(world):
    for grasp in world.grasps[:3]:
        world.robot.place(world.data, grasp.q)
        centers = world.robot.centers(grasp.q)
        for i, contact in enumerate(grasp.contacts):
            assert contact.name == f"finger_{i + 1}"
            assert contact.body == f"f{i + 1}_tip"
            assert contact.tip_radius == 0.008
            assert contact.flexion == (world.robot.index(f"bhand_f{i + 1}_proximal"),)
            body = world.data.body(contact.body)
            point = body.xpos + body.xmat.reshape(3, 3) @ contact.point
            np.testing.assert_allclose(point, centers[i], atol=EXACT)


def test_a_grasp_outlives_the_next_touch(world):
    grasp = world.probe.touch(world.targets[0])
    before = pickle.dumps([grasp.q, grasp.jacobian, grasp.hessian, grasp.positions])
    points = [c.point.copy() for c in grasp.contacts]
    world.probe.touch(world.targets[-1])
    assert pickle.dumps([grasp.q, grasp.jacobian, grasp.hessian, grasp.positions]) == before
    for contact, point in zip(grasp.contacts, points, strict=True):
        np.testing.assert_array_equal(contact.point, point)


def test_the_same_target_gives_bitwise_the_same_grasp_whatever_came_before(world):
    fresh = GeometricProbe(pickle.loads(pickle.dumps(world.scene)), links="pass")
    for grasp, target in reversed(list(zip(world.grasps, world.targets, strict=True))):
        assert same(world.probe.touch(target), grasp)
        assert same(fresh.touch(target), grasp)
    for target, missed in world.missed:
        assert same(world.probe.touch(target), missed)


def test_the_target_is_left_as_it_was(world):
    target = world.targets[0].copy()
    world.probe.touch(target)
    np.testing.assert_array_equal(target, world.targets[0])
    target.setflags(write=False)
    assert isinstance(world.probe.touch(target), Grasp)


# ---------------------------------------------------------------- one finger, solved by hand


def single(folder, radius, distance, bearing, upper=3.0):
    """The stiff finger and an upright cylinder `distance` from its axis, at angle `bearing`."""
    tiny_hand.write(folder, change(STIFF, 'range="0 3"', f'range="0 {upper:.17g}"'))
    where = (distance * np.cos(bearing), distance * np.sin(bearing), 0.0)
    return GeometricProbe(Scene(folder, Cylinder(radius, TALL), where))


def touch_angle(radius, distance, bearing):
    """Where the tip, on its circle of radius LENGTH, first meets the cylinder."""
    reach = radius + TIP
    return bearing - np.arccos((LENGTH**2 + distance**2 - reach**2) / (2 * LENGTH * distance))


def distance_of_share(radius, share, side=1):
    """Distance at which the tip closes at `share` of its speed when it touches.

    The cylinder's axis lies beyond the tip (side 1), or nearer to the finger's axis (side −1).
    """
    reach = radius + TIP
    # The normal is `share` along the tip's motion and the rest along the finger.
    return np.hypot(LENGTH + side * reach * np.sqrt(1 - share**2), reach * share)


def test_the_first_touch_of_a_swinging_finger_is_where_trigonometry_puts_it(tmp_path):
    rng = np.random.default_rng(1)
    for _ in range(60):
        radius = rng.choice([0.005, 0.02, 0.05])
        share = rng.uniform(0.15, 0.95)
        distance = distance_of_share(radius, share, rng.choice([-1, 1]))
        bearing = rng.uniform(1.3, 2.5)
        expected = touch_angle(radius, distance, bearing)
        grasp = single(tmp_path, radius, distance, bearing).touch(np.array([0.1, expected / 2]))
        assert isinstance(grasp, Grasp)
        # The gap is met to TOUCH, the angle to that over the closing speed.
        assert grasp.q[1] == pytest.approx(expected, abs=1e-8 / (share * LENGTH))
        assert grasp.q[0] == 0.1
        (contact,) = grasp.contacts
        center = LENGTH * np.array([np.cos(expected), np.sin(expected)])
        axis = distance * np.array([np.cos(bearing), np.sin(bearing)])
        normal = (center - axis) / (radius + TIP)
        np.testing.assert_allclose(contact.normal, [*normal, 0.0], atol=NORMAL_TOL)
        np.testing.assert_allclose(
            contact.position, [*(center - TIP * normal), 0.1], atol=SURFACE_TOL
        )


def test_a_flat_touches_a_round_object_where_it_is_tangent(tmp_path):
    """The end of the flat, 8 mm away, does not draw the place of the touch away."""
    flat = change(STIFF, 'type="sphere" size="0.01"', 'type="box" size="0.02 0.01 0.01"')
    tiny_hand.write(tmp_path, flat, change(TOML, 'site = "tip_center"\n', ""))
    radius, along = 0.05, LENGTH + 0.012
    middle = (0.0, np.hypot(along, radius + 0.01), 0.0)
    scene = Scene(tmp_path, Cylinder(radius), middle)
    grasp = GeometricProbe(scene).touch(np.array([0.0, 0.2]))
    assert isinstance(grasp, Grasp), grasp
    contact = grasp.contacts[0]
    on_surface = np.array(scene.position) + radius * contact.normal
    np.testing.assert_allclose(contact.position[:2], on_surface[:2], atol=5e-4)


TIPS = {
    "capsule": 'type="capsule" size="0.009 0.019"',
    "cylinder": 'type="cylinder" size="0.009 0.019"',
    "box": 'type="box" size="0.006 0.008 0.019"',
    "ellipsoid": 'type="ellipsoid" size="0.006 0.008 0.019"',
}
SWAY = 5e-4  # [rad, m]
SECOND_ORDER = 0.02  # [–] share of a motion so small that its square may bring
PLACE_TOL = 1e-5  # [m] of a touch whose gap is not quite nothing


def before_a_wall(folder, tip):
    """A hand of one finger beside a wall that it closes onto, free to move and turn."""
    axes = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
    arm = {f"{kind}_{a}": (kind, axis) for kind in ("slide", "hinge") for a, axis in axes.items()}
    joints = "".join(
        f'<joint name="{name}" type="{kind}" axis="{axis}" range="-1 1"/>'
        for name, (kind, axis) in arm.items()
    )
    (folder / "hook.xml").write_text(
        f"""<mujoco><compiler angle="radian"/><worldbody>
        <body name="palm">{joints}<geom type="sphere" size="0.005"/>
        <body name="finger"><joint name="finger" axis="0 -1 0" range="-1 1"/>
        <geom {tip} pos="0 0 0.1"/></body></body></worldbody></mujoco>"""
    )
    (folder / "hook.toml").write_text(
        f"""model = "hook.xml"
        arm = {list(arm)}
        palm = {{ body = "palm", pos = [0, 0, 0], approach = [0, 0, 1], opposition = [1, 0, 0] }}
        contact_points = [{{ link = "finger", flexion = {{ finger = 1 }} }}]"""
    )
    wall = Prism(((0.1, 0.2), (-0.1, 0.2), (-0.1, -0.2), (0.1, -0.2)), 0.6)
    return Scene(folder / "hook.toml", wall, (-0.11, 0.0, 0.1))


@pytest.mark.parametrize("tip", TIPS)
def test_a_touch_moves_along_a_link_as_its_grasp_says(tmp_path, tip):
    """Where a link lies along the object a little tilt moves its touch by much, but steadily."""
    scene = before_a_wall(tmp_path, TIPS[tip])
    robot, probe = scene.articulated, GeometricProbe(scene)
    first = probe.touch(np.zeros(7))
    assert isinstance(first, Grasp), first
    along = np.eye(3) - np.outer(first.normals[0], first.normals[0])
    rng = np.random.default_rng(3)
    for _ in range(5):
        second = probe.touch(first.q + SWAY * rng.normal(size=robot.n))
        assert isinstance(second, Grasp)
        predicted = along @ first.jacobian @ (second.q - first.q)
        moved = along @ (second.positions - first.positions)[0]
        assert np.linalg.norm(predicted) > 0.1 * SWAY
        np.testing.assert_allclose(
            moved, predicted, rtol=0.0, atol=PLACE_TOL + SECOND_ORDER * np.linalg.norm(predicted)
        )


@pytest.mark.parametrize("tip", TIPS)
def test_a_link_that_lies_along_the_object_is_felt_wherever_it_comes_from(tmp_path, tip):
    """Also where closing first comes nearer than the gap that counts as a touch, but not inside."""
    scene = before_a_wall(tmp_path, TIPS[tip])
    probe, rng = GeometricProbe(scene), np.random.default_rng(0)
    touches = [probe.touch(SWAY * rng.normal(size=7)) for _ in range(60)]
    assert [felt for felt in touches if isinstance(felt, Missed)] == []


@pytest.mark.parametrize("tip", TIPS)
def test_the_robot_carries_a_touch_as_its_grasp_says(tmp_path, tip):
    """`carried` is where landing takes the tips to be, and what the kinematic law presses."""
    scene = before_a_wall(tmp_path, TIPS[tip])
    robot = scene.articulated
    grasp = GeometricProbe(scene).touch(np.zeros(7))
    contact, step = grasp.contacts[0], 1e-6
    x, J = robot.carried(grasp, grasp.q)
    center = contact.position + contact.tip_radius * contact.normal
    np.testing.assert_allclose(x, center, atol=EXACT)
    np.testing.assert_allclose(J, grasp.jacobian, atol=EXACT)
    there = [[robot.carried(grasp, grasp.q + s * e)[0] for s in (step, -step)] for e in np.eye(7)]
    slopes = [(ahead - behind) / (2.0 * step) for ahead, behind in there]
    np.testing.assert_allclose(np.transpose(slopes), J, atol=1e-7)
    of_link = robot.jacobian(grasp.q, contact.point[None])
    np.testing.assert_allclose(grasp.jacobian - grasp.rolling, of_link, atol=EXACT)
    law = KinematicTask()
    pressed = replace(grasp, jacobian=of_link, rolling=None)
    np.testing.assert_allclose(law.error(grasp), law.error(pressed), atol=EXACT)


def test_a_capsule_rolls_as_a_ball_across_and_by_its_length_along(tmp_path):
    scene = before_a_wall(tmp_path, TIPS["capsule"])
    (contact,) = GeometricProbe(scene).touch(np.zeros(7)).contacts
    assert contact.tip_radius == 0.009
    # Tilted by 0.1 rad either way it touches at its ends.
    expected = np.zeros((3, 3))
    expected[2, 2] = 0.019 / np.sin(0.1)
    np.testing.assert_allclose(contact.stretch, expected, atol=1e-4)


ROUND = {  # about x, by 0 and by 90 degrees: what the tip is rounded by where it is nearest
    'type="sphere" size="0.01"': (0.01, 0.01),
    'type="capsule" size="0.009 0.019"': (0.009, 0.009),
    'type="cylinder" size="0.009 0.019"': (0.009, 0.009),
    'type="box" size="0.006 0.008 0.019"': (0.0, 0.0),
    'type="ellipsoid" size="0.006 0.008 0.019"': (0.0, 0.0),
}


@pytest.mark.parametrize("tip", ROUND)
def test_what_a_tip_is_rounded_by_is_its_kinds_radius_and_a_cylinders_only_at_its_side(
    tmp_path, tip
):
    for turn, radius in zip(("0 0 0", "1.5707963 0 0"), ROUND[tip], strict=True):
        scene = before_a_wall(tmp_path, f'{tip} euler="{turn}"')
        probe = GeometricProbe(scene)
        scene.articulated.place(probe._data, np.zeros(7))
        near = probe._nearest(0)
        assert near.radius == radius
        np.testing.assert_allclose(near.normal, [1, 0, 0], atol=1e-9)
        half = {"sphere": 0.01, "capsule": 0.009, "cylinder": 0.009}.get(tip.split('"')[1], 0.006)
        np.testing.assert_allclose([near.link[0], near.gap], [-half, 0.01 - half], atol=1e-8)
    if "cylinder" in tip:
        scene = before_a_wall(tmp_path, f'{tip} euler="0 1.5707963 0"')
        probe = GeometricProbe(scene)
        scene.articulated.place(probe._data, np.array([0.02, 0, 0, 0, 0, 0, 0]))
        assert probe._nearest(0).radius == 0.0


def test_of_a_link_of_several_geoms_the_nearest_touches(tmp_path):
    """A knob on either side of a finger, one of them higher."""
    for order in ((0.02, 0.01), (0.01, 0.02)):
        knobs = "".join(
            f'<geom type="sphere" size="0.004" pos="-{x} 0 {z}" mass="0.1"/>'
            for x, z in zip(order, (0.08, 0.12), strict=True)
        )
        scene = before_a_wall(tmp_path, f'type="sphere" size="0.004" pos="0 0 0.1"/>{knobs}<site')
        felt = GeometricProbe(scene).touch(np.zeros(7))
        assert isinstance(felt, Grasp), felt
        # The one that stands out further meets the wall first, where its own arc leads.
        x, z = order[order.index(0.02)], (0.08, 0.12)[order.index(0.02)]
        reach, angle = np.hypot(x, z), np.arctan2(x, z)
        closed = np.arcsin((0.01 - 0.004) / reach) - angle
        assert felt.q[-1] == pytest.approx(closed, abs=1e-6)
        np.testing.assert_allclose(felt.positions[0, 0], -0.01, atol=1e-6)


@pytest.mark.parametrize("tip", TIPS)
def test_a_touch_goes_with_hand_and_object_wherever_both_are_moved(tmp_path, tip):
    """Turned about the vertical, for objects stand upright."""
    scene = before_a_wall(tmp_path, TIPS[tip])
    turn, p = 2.2, np.array([0.3, -0.2, 0.4])
    R = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    wall = Prism(tuple(map(tuple, np.array(scene.object.polygon) @ R[:2, :2].T)), 0.6)
    place = tuple(R @ scene.position + p)
    moved = replace(scene.rebased(p, R), object=wall, position=place)
    q = np.array([0.0, 0.01, 0.05, 0.02, -0.03, 0.04, 0.0])
    one, other = (GeometricProbe(s).touch(q) for s in (scene, moved))
    assert isinstance(one, Grasp) and isinstance(other, Grasp)
    np.testing.assert_allclose(other.q, one.q, atol=1e-7)
    np.testing.assert_allclose(other.normals, one.normals @ R.T, atol=1e-6)
    np.testing.assert_allclose(other.positions, one.positions @ R.T + p, atol=1e-5)
    np.testing.assert_allclose(other.jacobian, R @ one.jacobian, atol=1e-4)
    turned = R @ one.contacts[0].stretch @ R.T
    np.testing.assert_allclose(other.contacts[0].stretch, turned, atol=1e-4)


def test_an_ellipsoid_rolls_by_its_mean_radius_there_and_the_rest_is_its_stretch(tmp_path):
    """Where its normal is n it touches at A² n/|A n|; between tilts of 0.1 rad to either side."""
    scene = before_a_wall(tmp_path, TIPS["ellipsoid"])
    (contact,) = GeometricProbe(scene).touch(np.zeros(7)).contacts
    R = mujoco_turn(scene, contact)
    A = np.array([0.006, 0.008, 0.019])
    n = R.T @ contact.normal
    run = []
    for turn in tangents(contact.normal):
        there = []
        for angle in (0.1, -0.1):
            tilted = np.cos(angle) * n + np.sin(angle) * (R.T @ turn)
            there.append(-(A**2) * tilted / np.linalg.norm(A * tilted))
        run.append(R @ (there[1] - there[0]) / (2.0 * np.sin(0.1)))
    T = np.array(tangents(contact.normal))
    M = T @ np.transpose(run)
    assert contact.tip_radius == pytest.approx(0.5 * np.trace(M), rel=1e-3)
    rest = T.T @ (M - contact.tip_radius * np.eye(2)) @ T
    np.testing.assert_allclose(contact.stretch, rest, atol=1e-4)


def mujoco_turn(scene, contact):
    """Of the finger as it touches (3, 3)."""
    robot = scene.articulated
    grasp = GeometricProbe(scene).touch(np.zeros(7))
    return robot._at(grasp.q).body("finger").xmat.reshape(3, 3).copy()


def tangents(normal):
    one = np.cross(normal, [0.0, 1.0, 0.0])
    one /= np.linalg.norm(one)
    return one, np.cross(normal, one)


@pytest.mark.parametrize(("apart", "touches"), [(0.0133, True), (0.0215, False)])
def test_a_finger_that_would_pass_the_object_by_closes_to_it_where_it_is_near(
    tmp_path, apart, touches
):
    """Its own way leads along x and y at once, the object stands in −y, within 2 cm or not."""
    (tmp_path / "plotter.xml").write_text(
        """<mujoco><worldbody><body name="palm"><geom type="sphere" size="0.001"/>
        <body name="finger"><joint name="x" type="slide" axis="1 0 0" range="-0.1 0.1"/>
        <joint name="y" type="slide" axis="0 1 0" range="-0.1 0.1"/>
        <geom type="sphere" size="0.005"/></body></body></worldbody></mujoco>"""
    )
    (tmp_path / "plotter.toml").write_text(
        """model = "plotter.xml"
        palm = { body = "palm" }
        contact_points = [{ link = "finger", flexion = { x = 1, y = 1 } }]"""
    )
    way = np.array([0.6, -0.8])
    middle = (apart + 0.015) * way
    scene = Scene(tmp_path / "plotter.toml", Cylinder(0.01), (*middle, 0.0))
    felt = GeometricProbe(scene, links="pass").touch(np.zeros(2))
    if not touches:
        assert felt == Missed(Miss.NO_TOUCH, "finger")
        return
    np.testing.assert_allclose(felt.q, apart * way, atol=1e-6)
    np.testing.assert_allclose(felt.normals, [[*-way, 0.0]], atol=1e-4)


def test_a_ball_has_no_stretch(world):
    for grasp in world.grasps:
        assert grasp.rolling is None
        assert all(contact.stretch is None for contact in grasp.contacts)


@pytest.mark.parametrize("hand", ["capsules", "boxes"])
def test_tips_that_are_no_balls_come_to_balance(hand):
    """Where nothing tells how touches run along capsules, forces and moments jump about."""
    scene = Scene(HANDS / f"{hand}.toml", Cylinder(0.05))
    trial = Trial(scene, stack_of("fmk"), probes=20)
    assert [trial.run((41, i)).verdict for i in range(2)] == ["good"] * 2


def test_a_face_is_met_flat(tmp_path):
    """A square block whose near face lies along the ray at angle α is met where sin says."""
    half = 0.04
    square = Prism(((half, -half), (half, half), (-half, half), (-half, -half)))
    for near in (0.02, 0.05, 0.08):  # y of the face
        position = (LENGTH, near + half)
        tiny_hand.write(tmp_path, STIFF)
        probe = GeometricProbe(Scene(tmp_path, square, (*position, 0.0)))
        grasp = probe.touch(np.array([0.0, 0.0]))
        assert isinstance(grasp, Grasp)
        expected = np.arcsin((near - TIP) / LENGTH)
        assert grasp.q[1] == pytest.approx(expected, abs=AGAIN_TOL)
        np.testing.assert_allclose(grasp.contacts[0].normal, [0, -1, 0], atol=NORMAL_TOL)


@pytest.mark.parametrize("share", [0.1, 0.04, 0.02])
def test_a_grazing_touch_is_a_touch(tmp_path, share):
    """The tip closes at 2 % of its speed, and yet goes 10 µm deep if it does not stop."""
    radius, bearing = 0.05, 1.5
    distance = distance_of_share(radius, share)
    expected = touch_angle(radius, distance, bearing)
    grasp = single(tmp_path, radius, distance, bearing).touch(np.array([0.0, 0.0]))
    assert isinstance(grasp, Grasp)
    center = LENGTH * np.array([np.cos(grasp.q[1]), np.sin(grasp.q[1])])
    axis = distance * np.array([np.cos(bearing), np.sin(bearing)])
    assert abs(np.linalg.norm(center - axis) - radius - TIP) < SURFACE_TOL
    assert grasp.q[1] < expected + SURFACE_TOL / (share * LENGTH)


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("room", [1e-2, 1e-3, 1e-4, 1e-5, 1e-6])
def test_a_touch_just_before_the_end_of_the_range_is_a_touch(tmp_path, side, room):
    bearing, radius = 1.5, 0.05
    for share in (0.3, 0.6, 0.9):
        distance = distance_of_share(radius, share, side)
        expected = touch_angle(radius, distance, bearing)
        probe = single(tmp_path, radius, distance, bearing, upper=expected + room)
        grasp = probe.touch(np.array([0.0, 0.0]))
        assert isinstance(grasp, Grasp)
        assert grasp.q[1] == pytest.approx(expected, abs=AGAIN_TOL)


def test_a_touch_just_beyond_the_end_of_the_range_is_none(tmp_path):
    bearing, radius = 1.5, 0.05
    distance = distance_of_share(radius, 0.6)
    expected = touch_angle(radius, distance, bearing)
    probe = single(tmp_path, radius, distance, bearing, upper=expected - 1e-6)
    assert probe.touch(np.array([0.0, 0.0])) == Missed(Miss.NO_TOUCH, "finger")


def test_a_finger_that_would_open_into_the_object_opens_all_the_way(tmp_path):
    radius, bearing = 0.02, 1.5
    distance = distance_of_share(radius, 0.9)
    expected = touch_angle(radius, distance, bearing)
    probe = single(tmp_path, radius, distance, bearing)
    deep = np.array([0.0, bearing + RETREAT])  # opened by RETREAT, its tip is inside
    grasp = probe.touch(deep)
    assert isinstance(grasp, Grasp)
    assert grasp.q[1] == pytest.approx(expected, abs=AGAIN_TOL)


@pytest.mark.parametrize("share", [0.2, 0.3, 0.4])
def test_a_finger_that_closed_by_a_whole_step_more_still_finds_the_object(tmp_path, share):
    """A rod so thin that at the target, and for a third of a radian before, the tip is past it."""
    radius, bearing = 0.005, 1.5
    distance = distance_of_share(radius, share)
    expected = touch_angle(radius, distance, bearing)
    left_behind = 2.0 * bearing - expected  # where the tip comes out on the other side
    step = StepLimit().joint
    assert left_behind < expected + 0.4 * step
    grasp = single(tmp_path, radius, distance, bearing).touch(np.array([0.0, expected + step]))
    assert isinstance(grasp, Grasp)
    assert grasp.q[1] == pytest.approx(expected, abs=AGAIN_TOL)


def test_a_finger_opens_no_wider_than_it_is_told_where_nothing_is_in_its_way(tmp_path):
    """Past the object by more than its retreat, it closes on the far side, on nothing."""
    radius, bearing = 0.005, 1.5
    distance = distance_of_share(radius, 0.3)
    left_behind = 2.0 * bearing - touch_angle(radius, distance, bearing)
    probe = single(tmp_path, radius, distance, bearing)
    missed = probe.touch(np.array([0.0, left_behind + RETREAT + 1e-3]))
    assert missed == Missed(Miss.NO_TOUCH, "finger")


# ---------------------------------------------------------------- ways to miss


def test_an_object_out_of_reach_is_not_touched():
    scene = Scene(position=(0.0, 0.0, -3.0))
    missed = GeometricProbe(scene).touch(scene.articulated.home)
    assert isinstance(missed, Missed)
    assert missed.reason is Miss.NO_TOUCH
    assert missed.where in ("finger_1", "finger_2", "finger_3")


def test_a_finger_past_the_object_closes_without_touching(tmp_path):
    distance = LENGTH + 0.05 + TIP + 1e-6
    assert single(tmp_path, 0.05, distance, 1.5).touch(np.array([0.0, 0.0])) == Missed(
        Miss.NO_TOUCH, "finger"
    )


def test_an_object_around_the_hand_is_begun_inside_of():
    scene = Scene("bhand", Cylinder(0.5, height=2.0), (0.0, 0.0, 0.0))
    missed = GeometricProbe(scene).touch(scene.articulated.home)
    assert isinstance(missed, Missed)
    assert missed.reason is Miss.INSIDE
    assert missed.where in ("finger_1", "finger_2", "finger_3")


def test_the_finger_that_misses_is_named(tmp_path):
    toml = tiny_hand.TOML.replace('name = "finger"', 'name = "little"')
    folder = tiny_hand.write(tmp_path, STIFF, toml)
    far, around = Scene(folder, Cylinder(0.05), (3, 0, 0)), Scene(folder, Cylinder(1), (0, 0, 0))
    assert GeometricProbe(far).touch(np.zeros(2)) == Missed(Miss.NO_TOUCH, "little")
    assert GeometricProbe(around).touch(np.zeros(2)) == Missed(Miss.INSIDE, "little")


@pytest.fixture(scope="module")
def crowded():
    """A scene and a grasp in it with links besides the tips in the object."""
    scene = Scene(object=Cylinder(0.05, TALL))
    grasp = GeometricProbe(scene, links="pass").touch(np.array(CROWDED))
    assert grasp.other_links
    return scene, grasp


def test_other_links_pass_through_the_object_and_are_named(crowded):
    scene, grasp = crowded
    again = GeometricProbe(scene, links="pass").touch(grasp.q)
    assert isinstance(again, Grasp)
    assert again.other_links == grasp.other_links
    data = mujoco.MjData(scene.model)
    scene.articulated.place(data, grasp.q)
    for name in grasp.other_links:
        assert name not in ("f1_tip", "f2_tip", "f3_tip", "object")
        link = scene.model.geom(name)
        assert link.contype[0] or link.conaffinity[0]
        gap = mujoco.mj_geomDistance(
            scene.model, data, link.id, scene.model.geom("object").id, 0.1, None
        )
        assert gap < 0.0


def test_other_links_can_block_instead(crowded):
    scene, grasp = crowded
    missed = GeometricProbe(scene, links="block").touch(grasp.q)
    assert isinstance(missed, Missed)
    assert missed.reason is Miss.OTHER_LINK
    assert missed.where in grasp.other_links


def test_links_that_a_move_leads_through_the_object_are_named(tmp_path):
    """A knuckle on the palm is lifted from below a short cylinder to above it, or not so far."""
    geom = '<geom name="knuckle" type="sphere" size=".005" pos=".06 0 0" mass="0"/>'
    xml = change(STIFF, '<site name="palm"/>', f'<site name="palm"/>{geom}')
    scene = Scene(tiny_hand.write(tmp_path, xml), Cylinder(0.02, 0.1), (0.06, 0.0, 0.25))
    probe = GeometricProbe(scene)
    below, beside, above = (np.array([lift, 1.5]) for lift in (0.0, 0.1, 0.5))
    assert probe.in_transit([below, above]) == ("knuckle",)
    assert probe.in_transit([below, beside]) == probe.in_transit([below]) == ()
    assert probe.in_transit([below, beside, above, below]) == ("knuckle",)


@pytest.mark.parametrize(("depth", "touches"), [(1e-5, True), (1e-6, True), (-1e-6, False)])
def test_a_link_touches_as_soon_as_it_is_in_the_object_by_a_thousandth_of_a_millimetre(
    tmp_path, depth, touches
):
    """A knuckle beside the finger, `depth` inside the cylinder."""
    radius, knuckle, bearing = 0.05, 0.005, 1.5
    distance = distance_of_share(radius, 0.6)
    where = distance - radius - knuckle + depth
    at = f"{where * np.cos(bearing):.17g} {where * np.sin(bearing):.17g} 0"
    geom = f'<geom name="knuckle" type="sphere" size="{knuckle}" pos="{at}" mass="0"/>'
    xml = change(STIFF, '<site name="palm"/>', f'<site name="palm"/>{geom}')
    position = (distance * np.cos(bearing), distance * np.sin(bearing), 0.0)
    scene = Scene(tiny_hand.write(tmp_path, xml), Cylinder(radius, TALL), position)
    for links in ("pass", "block"):
        felt = GeometricProbe(scene, links).touch(np.zeros(2))
        if touches and links == "block":
            assert felt == Missed(Miss.OTHER_LINK, "knuckle")
        else:
            assert isinstance(felt, Grasp)
            assert felt.other_links == (("knuckle",) if touches else ())


def test_where_no_other_link_touches_blocking_changes_nothing(world):
    clear = [t for g, t in zip(world.grasps, world.targets, strict=True) if not g.other_links]
    probe = GeometricProbe(world.scene, links="block")
    assert clear
    for target in clear[:5]:
        assert same(probe.touch(target), world.probe.touch(target))


def test_every_reason_reads_as_one():
    assert {miss.value for miss in Miss} == {
        "a finger closed without touching",
        "a fingertip began inside the object",
        "another link touches the object",
        "the hand stopped itself on the way",
        "the hand does not open",
        "a finger closed onto the hand itself",
        "a fingertip met what the object stands on",
        "a contact was lost while the hand held",
        "what a fingertip feels is no push on it",
        "a fingertip's sensor does not answer",
    }


# ---------------------------------------------------------------- errors


@pytest.mark.parametrize(
    "q", [np.zeros(10), np.zeros(12), np.zeros((11, 1)), 0.0, np.full(11, np.nan),
          np.r_[np.zeros(10), np.inf]],
    ids=lambda q: str(np.shape(q)),
)  # fmt: skip
def test_a_target_is_one_finite_angle_for_each_joint(world, q):
    with pytest.raises(InputError, match="q_target must be 11 finite angles, for wam_j1, "):
        world.probe.touch(q)


@pytest.mark.parametrize("q", [None, ["a"] * 11, [[0.0] * 5, [0.0] * 6]], ids=str)
def test_a_target_that_is_no_array_of_numbers_is_refused(world, q):
    with pytest.raises(InputError, match="q_target"):
        world.probe.touch(q)


def test_an_unknown_way_to_treat_links_lists_the_known_ones(world):
    with pytest.raises(InputError, match="unknown links 'stop'; choose one of: pass, block"):
        GeometricProbe(world.scene, links="stop")


def test_a_finger_that_nothing_closes_is_refused(tmp_path):
    toml = change(tiny_hand.TOML, '["proximal"]', "[]")
    scene = Scene(tiny_hand.write(tmp_path, toml=toml), Cylinder(0.02), (0.1, 0.1, 0.0))
    with pytest.raises(InputError, match="finger has no flexion joint"):
        GeometricProbe(scene)


def test_a_ball_touches_within_a_nanometre_and_what_is_no_ball_a_little_off():
    """Two flat things at gap 0 have no direction between them."""
    balls = GeometricProbe(Scene())
    for gap, touches in ((0.0, True), (0.9e-9, True), (-0.9e-9, True), (1.1e-9, False)):
        assert balls._touches(0, gap) is touches and balls._touches(0, -gap) is touches
    object.__setattr__(balls, "_round", (False,) * 3)
    gaps = (-0.9e-9, 0.0, 0.9e-9, 1.1e-9, 9.9e-9, 10.1e-9)
    assert [balls._touches(0, gap) for gap in gaps] == [False, False, False, True, True, False]
