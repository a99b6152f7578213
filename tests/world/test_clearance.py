"""Links of one robot that come near one another: which pairs, how near, and how that changes."""

import itertools
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
import pytest
import tiny_hand
from tiny_hand import change

from hqp_grasp.world.clearance import LinkBalls, SelfClearance
from hqp_grasp.world.description import RobotDescription
from hqp_grasp.world.robot import Robot, compiled, described

STEP = 1e-6  # [rad, m]
# Two arms on a base: a slide with a hinge, and a hinge with its follower. A post stands beside.
XML = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <geom name="floor" type="box" size="1 1 0.01" pos="0 0 -0.5"/>
    <body name="post" pos="0.2 0 0"><geom name="post" type="box" size="0.05 0.05 0.4"/></body>
    <body name="base">
      <inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>
      <joint name="yaw" axis="0 0 1" range="-3 3"/>
      <geom name="base" type="sphere" size="0.04"/>
      <body name="left" pos="-0.1 0 0.1">
        <joint name="slide" type="slide" axis="1 0 0" range="-0.2 0.2"/>
        <geom name="left" type="sphere" size="0.02"/>
        <body name="paddle" pos="0 0 0.2">
          <joint name="turn" axis="0 1 0" range="-2 2"/>
          <geom name="paddle" type="capsule" fromto="0 0 0 0.04 0.01 -0.02" size="0.01"/>
        </body>
      </body>
      <body name="right" pos="0.1 0 0.1">
        <joint name="swing" axis="0 1 0" range="-2 2"/>
        <geom name="right" type="sphere" size="0.03"/>
        <geom name="drawn" type="sphere" size="0.5" contype="0" conaffinity="0"/>
        <body name="ball" pos="0.1 0 0.2">
          <joint name="follow" axis="0 1 0" range="-2 2"/>
          <geom name="ball" type="sphere" size="0.02" pos="-0.05 0 0"/>
          <body name="welded">
            <geom name="welded" type="sphere" size="0.01" pos="-0.05 0 0.03"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="follow" joint2="swing" polycoef="0 -0.5 0 0 0"/></equality>
</mujoco>"""
TOML = 'model = "arms.xml"\n{more}\n[[contact_points]]\nlink = "paddle"\nflexion = ["turn"]\n'


def robot(folder, xml=XML, more=""):
    (folder / "arms.xml").write_text(xml)
    (folder / "robot.toml").write_text(TOML.format(more=more))
    about = RobotDescription.load(folder)
    return Robot(about, compiled(about))


def pairs(links):
    model = links.robot.model
    return {frozenset(model.geom(int(g)).name for g in pair) for pair in links.pairs}


def both(text):
    return {frozenset(pair.split("-")) for pair in text.split()}


MOVING = "left-right left-ball left-welded paddle-right paddle-ball paddle-welded base-paddle"
ALL = MOVING + " base-ball base-welded"


def test_pairs_are_those_that_collide_and_move_against_one_another(tmp_path):
    """Not of one link, nor of neighbours, nor of what stands by itself or is only drawn."""
    assert pairs(SelfClearance(robot(tmp_path), 0.005)) == both(ALL)
    quiet = change(
        XML, '"0.02" pos="-0.05 0 0"', '"0.02" pos="-0.05 0 0" contype="0" conaffinity="2"'
    )
    assert pairs(SelfClearance(robot(tmp_path, quiet), 0.005)) == both(ALL)


@pytest.mark.parametrize("order", ["left right", "right left"])
def test_what_the_model_excludes_is_no_pair_in_either_order(tmp_path, order):
    one, other = order.split()
    out = f'<contact><exclude body1="{one}" body2="{other}"/></contact></mujoco>'
    links = SelfClearance(robot(tmp_path, change(XML, "</mujoco>", out)), 0.005)
    assert pairs(links) == both(ALL) - both("left-right")


def test_distances_are_those_of_the_shapes_and_pairs_beyond_are_left_out(tmp_path):
    arms = robot(tmp_path)
    links, q = SelfClearance(arms, 0.005), np.array([0.7, 0.05, 0.3, -0.2])
    data = arms._at(q)
    at = {name: data.geom(name).xpos for name in ("left", "right", "ball", "welded")}
    radius = {"left": 0.02, "right": 0.03, "ball": 0.02, "welded": 0.01}
    for within in (0.5, 0.15, 0.05):
        near = links.near(q, within)
        assert (near.distance < within).all()
        found = dict(zip(map(frozenset, near.names), near.distance, strict=True))
        for one, other in itertools.combinations(radius, 2):
            pair = frozenset((one, other))
            if pair not in pairs(links):
                continue
            gap = np.linalg.norm(at[one] - at[other]) - radius[one] - radius[other]
            assert (pair in found) == (gap < within)
            assert found.get(pair, gap) == pytest.approx(gap, abs=1e-9)
    assert links.near(q, -1.0).jacobian.shape == (0, 4)


# The ball of the right arm is pushed into the left arm, beside it, and the other way round.
POSTURES = {
    "apart": [0.7, 0.05, 0.3, -0.2],
    "near": [-1.1, 0.09, -0.4, 0.1],
    "overlapping": [0.4, 0.16, 0.2, -0.1],
    "deep": [0.4, 0.175, -0.6, 0.05],
}


@pytest.mark.parametrize("posture", POSTURES)
def test_gradients_are_the_rates_of_the_distances_also_where_links_overlap(tmp_path, posture):
    links, q = SelfClearance(robot(tmp_path), 0.005), np.array(POSTURES[posture])
    near = links.near(q, 0.4)
    assert (near.distance < 0.0).any() == (posture in ("overlapping", "deep"))
    assert len(near.names) == len(pairs(links))
    rates = [
        (links.near(q + d, 0.4).distance - links.near(q - d, 0.4).distance) / (2.0 * STEP)
        for d in STEP * np.eye(4)
    ]
    np.testing.assert_allclose(near.jacobian, np.transpose(rates), atol=1e-6)
    assert np.abs(near.jacobian[:, 1:]).max(axis=0).min() > 1e-2
    np.testing.assert_allclose(near.jacobian[:, 0], 0.0, atol=1e-9)  # yaw carries both arms


def test_links_keep_what_is_asked_and_half_of_what_they_have_where_home_has_less(tmp_path):
    arms = robot(tmp_path, more="home = { slide = 0.146 }")
    links = SelfClearance(arms, 0.005)
    assert links.at_home == ()
    near = links.near(arms.home, 1.0)
    kept = dict(zip(map(frozenset, near.names), near.least, strict=True))
    (close,) = both("left-right")
    gap = dict(zip(map(frozenset, near.names), near.distance, strict=True))[close]
    assert gap == pytest.approx(0.004, abs=1e-9)
    assert kept.pop(close) == pytest.approx(0.002, abs=1e-9)
    assert set(kept.values()) == {0.005}
    wider = SelfClearance(arms, 0.003).near(arms.home, 1.0)
    assert dict(zip(map(frozenset, wider.names), wider.least, strict=True))[close] == (
        pytest.approx(0.002, abs=1e-9)
    )
    least = SelfClearance(arms, 0.0015).near(arms.home, 1.0).least
    np.testing.assert_allclose(least, 0.0015)


@pytest.mark.parametrize(("slide", "touches"), [(0.1502, True), (0.15 - 1e-5, False)])
def test_pairs_that_touch_at_home_are_let_be(tmp_path, slide, touches):
    links = SelfClearance(robot(tmp_path, more=f"home = {{ slide = {slide} }}"), 0.005)
    assert links.at_home == ((("left", "right"),) if touches else ())
    assert pairs(links) == both(ALL) - (both("left-right") if touches else set())


def test_collisions_are_the_pairs_that_overlap(tmp_path):
    links = SelfClearance(robot(tmp_path), 0.005)
    for slide, names in ((0.15 - 2e-6, ()), (0.15 + 2e-6, (("left", "right"),))):
        assert links.collisions(np.array([0.3, slide, 0.0, 0.0])) == names


# ---------------------------------------------------------------- nothing is overlooked


@pytest.fixture(scope="module")
def torso():
    """Two arms, two hands: some 900 pairs."""
    about = described("umass_torso")
    return SelfClearance(Robot(about, compiled(about)), about.clearance)


def postures(torso, count):
    """At work, and anywhere: (count, n) each."""
    rng, robot = np.random.default_rng(0), torso.robot
    around = robot.home + 0.2 * rng.normal(size=(count, robot.n))
    anywhere = rng.uniform(robot.q_lower, robot.q_upper, (count, robot.n))
    return [*np.clip(around, robot.q_lower, robot.q_upper), *anywhere]


def one_by_one(links, q, within):
    """Every pair measured by itself, and MuJoCo's own Jacobians: name, distance, gradient."""
    robot, model = links.robot, links.robot.model
    data = mujoco.MjData(model)
    robot.place(data, q)
    mujoco.mj_comPos(model, data)
    for pair in links.pairs.tolist():
        ends = np.zeros(6)
        distance = mujoco.mj_geomDistance(model, data, *pair, within, ends)
        if distance >= within:
            continue
        J = np.zeros((2, 3, model.nv))
        for J_end, end, geom in zip(J, (ends[:3], ends[3:]), pair, strict=True):
            mujoco.mj_jac(model, data, J_end, None, end, model.geom_bodyid[geom])
        u = np.sign(distance) * (ends[:3] - ends[3:])
        gradient = u / np.linalg.norm(u) @ (J[0] - J[1]) @ robot.coupling
        yield tuple(model.geom(g).name for g in pair), distance, gradient


@pytest.mark.parametrize("within", [0.0, 0.04, 0.3])
def test_pairs_are_those_found_one_by_one_with_their_distances_and_gradients(torso, within):
    seen = 0
    for q in postures(torso, 40):
        near, expected = torso.near(q, within), list(one_by_one(torso, q, within))
        assert near.names == tuple(name for name, _, _ in expected)
        assert near.distance.tolist() == [distance for _, distance, _ in expected]
        rows = np.reshape([gradient for _, _, gradient in expected], (-1, torso.robot.n))
        np.testing.assert_allclose(near.jacobian, rows, rtol=0.0, atol=1e-12)
        seen += len(expected)
    assert seen >= 10


def test_pairs_found_do_not_depend_on_what_was_asked_before_nor_on_the_thread(torso):
    some = postures(torso, 20)
    alone = [SelfClearance(torso.robot, torso.least).near(q, 0.04) for q in some]
    with ThreadPoolExecutor(4) as threads:
        for q, near, expected in zip(
            some * 3, threads.map(lambda q: torso.near(q, 0.04), some * 3), alone * 3, strict=True
        ):
            assert near.names == expected.names, q
            np.testing.assert_array_equal(near.distance, expected.distance)
            np.testing.assert_array_equal(near.jacobian, expected.jacobian)


def test_a_plane_of_the_robots_base_is_near_wherever_it_reaches(tmp_path):
    """It has no ball around it: its centre says nothing."""
    plane = '<geom name="deck" type="plane" size="1 1 1" pos="3 0 -0.2"/>'
    xml = change(XML, '<geom name="base" type="sphere" size="0.04"/>', plane)
    arms = robot(tmp_path, change(xml, '<joint name="yaw" axis="0 0 1" range="-3 3"/>', ""))
    links = SelfClearance(arms, 0.005)
    found = links.near(arms.home, 0.6)
    near = dict(zip(found.names, found.distance, strict=True))
    height = arms._at(arms.home).geom("ball").xpos[2] + 0.2
    assert near[("deck", "ball")] == pytest.approx(height - 0.02, abs=1e-9)


# ---------------------------------------------------------------- links as balls


def test_links_as_balls_leave_out_what_touches_and_keep_a_balls_own_size(tmp_path):
    arms = robot(tmp_path)
    balls = LinkBalls(arms)
    names = {arms.model.body(int(b)).name for b in balls.bodies}
    assert "left" in names and "right" in names and "paddle" not in names  # the paddle touches
    at = [i for i, b in enumerate(balls.bodies) if arms.model.body(int(b)).name == "left"]
    assert balls.radii[at] == pytest.approx([0.02])
    np.testing.assert_allclose(balls.centers[at], 0.0, atol=1e-12)


def test_a_capsule_is_the_balls_along_it(tmp_path):
    """Ends where the capsule ends; every point of its axis is within half a radius of a ball."""
    xml = XML.replace(
        '<geom name="right" type="sphere" size="0.03"/>',
        '<geom name="right" type="capsule" fromto="0.01 0.02 0 0.01 0.02 0.12" size="0.03"/>',
    )
    arms = robot(tmp_path, xml)
    balls = LinkBalls(arms)
    at = [i for i, b in enumerate(balls.bodies) if arms.model.body(int(b)).name == "right"]
    c = balls.centers[at]
    assert balls.radii[at] == pytest.approx([0.03] * len(at))
    np.testing.assert_allclose(c[:, :2], [[0.01, 0.02]] * len(at), atol=1e-9)
    assert c[:, 2].min() == pytest.approx(0.0, abs=1e-9)
    assert c[:, 2].max() == pytest.approx(0.12, abs=1e-9)
    assert np.diff(np.sort(c[:, 2])).max() <= 0.03 + 1e-9


def test_links_are_as_deep_as_the_deepest_ball_is_in_the_half_spaces(tmp_path):
    arms = robot(tmp_path)
    balls, q = LinkBalls(arms), np.array([0.3, 0.05, 0.0, 0.4])[: arms.n]
    data = arms._at(q)
    centers = np.array(
        [
            data.xpos[b] + data.xmat[b].reshape(3, 3) @ c
            for b, c in zip(balls.bodies, balls.centers, strict=True)
        ]
    )
    u = np.array([[0.0, 0.0, 1.0]])
    for height in (-1.0, 0.05, 1.0):
        deepest = (balls.radii + height - centers[:, 2]).max()
        assert balls.depth(q, u, np.array([height])) == pytest.approx(deepest, abs=1e-12)
    cube = np.vstack([np.eye(3), -np.eye(3)])
    side = np.array([0.5, 0.5, -0.9, 0.5, 0.5, 1.0])  # 0.9 m below: nothing is there
    assert balls.depth(q, cube, side) < 0.0


def test_a_robot_of_tips_alone_has_no_link_to_keep_out_of_the_object(tmp_path):
    about = RobotDescription.load(tiny_hand.write(tmp_path))
    robot = Robot(about, compiled(about))
    balls = LinkBalls(robot)
    assert balls.centers.shape == (0, 3) and balls.bodies.dtype == int
    u, h = np.array([[1.0, 0.0, 0.0]]), np.array([0.5])
    assert balls.depth(robot.home, u, h) == -np.inf
