"""What a description can say, and every robot that is refused, with the words that say why."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import tiny_hand
from tiny_hand import XML, change

import hqp_grasp as hg
from hqp_grasp.errors import InputError, ModelError
from hqp_grasp.experiments.robot_check import check
from hqp_grasp.grasp import Grasp
from hqp_grasp.touch.geometric import GeometricProbe
from hqp_grasp.world.clearance import SelfClearance
from hqp_grasp.world.description import RobotDescription, locate
from hqp_grasp.world.objects import Cylinder
from hqp_grasp.world.robot import Robot, compiled, described
from hqp_grasp.world.scene import Scene
from hqp_grasp.world.second_opinion import second_opinion

CCD_TOLERANCE = 1e-12
SLIDE_UNIT = 0.06

EXACT = 1e-12
SHORT = 'model = "tiny.xml"\n[[contact_points]]\nlink = "distal"\n'
URDF = """<robot name="claw">
  <link name="base"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0"
    iyz="0"/></inertial></link>
  {fingers}
</robot>"""
FINGER = """<link name="{n}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0"
    ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0 0 0.1"/><geometry>{shape}</geometry></collision></link>
  <joint name="{n}_joint" type="revolute"><parent link="base"/><child link="{n}"/>
    <origin xyz="{x} 0 0"/><axis xyz="0 {s} 0"/>
    <limit {limit} effort="1" velocity="1"/></joint>"""
BALL, BOX = '<sphere radius="0.01"/>', '<box size="0.02 0.03 0.04"/>'


LIMIT = 'lower="0" upper="1.5"'


def claw(folder, shape=BALL, toml="", limit=LIMIT, right=-1, kind="revolute", apart=0.06):
    """Two fingers from a URDF that close towards one another, for `right` = −1 positively."""
    fingers = [
        FINGER.format(n=n, x=x, s=s, shape=shape, limit=limit).replace("revolute", kind)
        for n, x, s in (("left", -apart, 1), ("right", apart, right))
    ]
    if kind == "prismatic":
        fingers = [re.sub('xyz="0 (-?1) 0"', r'xyz="\1 0 0"', finger) for finger in fingers]
    (folder / "claw.urdf").write_text(URDF.format(fingers="".join(fingers)))
    points = '[[contact_points]]\nlink = "left"\n[[contact_points]]\nlink = "right"\n'
    (folder / "claw.toml").write_text(f'model = "claw.urdf"\n{toml}\n{points}')
    return folder / "claw.toml"


def robot_of(path, **given):
    about = described(path, **given)
    return Robot(about, compiled(about))


def written(folder, xml=XML, toml=SHORT):
    return robot_of(tiny_hand.write(folder, xml, toml))


# ---------------------------------------------------------------- what is filled in


def test_three_lines_describe_a_hand(tmp_path):
    robot = written(tmp_path)
    assert robot.description.contact_points[0].name == "distal"
    assert robot.flexion == ((1,),)
    np.testing.assert_array_equal(robot.closing, [[0.0, 1.0]])
    assert robot.arm == (0,)  # the lift, which carries the one link there is
    np.testing.assert_array_equal(robot.home, [0.0, 0.2])  # its keyframe
    np.testing.assert_array_equal(robot.velocity, [0.25, 1.0])
    np.testing.assert_allclose(robot.workspace, robot.centers(robot.home)[0], atol=EXACT)


def test_a_urdf_keeps_its_fixed_links_and_closes_towards_its_middle(tmp_path):
    robot = robot_of(claw(tmp_path))
    assert robot.joints == ("left_joint", "right_joint")
    np.testing.assert_array_equal(robot.tip_radius, [0.01, 0.01])
    gap = [np.ptp(robot.centers(s * robot.closing.sum(axis=0))[:, 0]) for s in (0.0, 0.5)]
    assert gap[1] < gap[0]
    p, R = robot.palm(robot.home)
    np.testing.assert_allclose(np.abs(R[:, 0]), [1, 0, 0], atol=1e-6)  # opposition
    np.testing.assert_allclose(R[:, 2], [0, 0, 1], atol=1e-6)  # approach
    np.testing.assert_allclose(p, 0.0, atol=EXACT)


def test_a_finger_without_ranges_opens_and_closes_all_the_same(tmp_path):
    xml = change(XML, 'axis="0 0 1" range="0 3"', 'axis="0 0 1"')
    robot = written(tmp_path, xml, "drop_couplings = true\n" + SHORT)
    ends = [robot.opened(robot.home, share) for share in (0.0, 1.0)]
    assert np.isfinite(ends).all()
    assert ends[0][1] < robot.home[1] < ends[1][1]


def test_a_joint_whose_wide_side_is_negative_closes_negatively(tmp_path):
    xml = change(XML, 'axis="0 0 1" range="0 3"', 'axis="0 0 1" range="-3 0"')
    xml = change(change(xml, 'range="-0.1 0.8"', 'range="-2 2"'), 'qpos="0 0.2', 'qpos="0 -0.2')
    np.testing.assert_array_equal(written(tmp_path, xml).closing, [[0.0, -1.0]])


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
@pytest.mark.parametrize("right", [1, -1])
@pytest.mark.parametrize("limit", ["", LIMIT, 'lower="-1" upper="1"', 'lower="-2" upper="1"'])
def test_fingers_close_towards_one_another_whichever_way_their_axes_point(
    tmp_path, kind, right, limit
):
    """Also without ranges, and where the wider side of a range leads away."""
    robot = robot_of(claw(tmp_path, limit=limit, right=right, kind=kind))
    unit = 1.0 if kind == "revolute" else SLIDE_UNIT
    np.testing.assert_allclose(robot.closing, unit * np.diag([1.0, -right]), atol=EXACT)
    assert np.isfinite([robot.opened(robot.home, share) for share in (0.0, 1.0)]).all()


@pytest.mark.parametrize(
    ("apart", "limit"),
    [
        (0.06, 'lower="-0.05" upper="0"'),
        (0.011, 'lower="-0.05" upper="0"'),
        (0.011, 'lower="-0.01" upper="0.3"'),
        (0.0, 'lower="-0.05" upper="0"'),  # one place, and so no direction
    ],
)
def test_jaws_close_towards_one_another_wherever_home_is(tmp_path, apart, limit):
    """Where they are closed at home, they close against the end of their range."""
    robot = robot_of(claw(tmp_path, limit=limit, kind="prismatic", apart=apart))
    np.testing.assert_allclose(robot.closing, SLIDE_UNIT * np.eye(2), atol=EXACT)


def test_jaws_beside_one_another_at_home_are_closed(tmp_path):
    """As in some files the links' own origins are."""
    path = claw(tmp_path, limit='lower="-0.05" upper="0"', kind="prismatic", apart=0.0)
    urdf = tmp_path / "claw.urdf"
    urdf.write_text(urdf.read_text().replace('xyz="0.0 0 0"', 'xyz="0 0.01 0"', 1))
    robot = robot_of(path)
    assert np.ptp(robot.centers(robot.home), axis=0).tolist() == [0.0, 0.01, 0.0]
    np.testing.assert_allclose(robot.closing, SLIDE_UNIT * np.eye(2), atol=EXACT)


def test_the_check_of_jaws_at_one_place_names_no_direction(tmp_path):
    text = check(claw(tmp_path, limit='lower="-0.05" upper="0"', kind="prismatic", apart=0.0))
    assert text.count("at home it is amid the others") == 2 and "nan" not in text


@pytest.mark.parametrize("apart", [0.0, 0.01])
def test_hinges_closed_at_home_close_against_the_end_of_their_range(tmp_path, apart):
    robot = robot_of(claw(tmp_path, limit='lower="-1.5" upper="0"', apart=apart))
    np.testing.assert_array_equal(robot.closing, np.eye(2))


def test_a_finger_closes_to_a_point_that_it_would_go_past(tmp_path):
    """Half as high as the straight finger, on its narrower side; past it, 1 rad is further."""
    path = claw(tmp_path, limit='lower="-1.5" upper="1"')
    urdf = tmp_path / "claw.urdf"
    urdf.write_text(urdf.read_text().replace('xyz="0.06 0 0"', 'xyz="-0.04 0 -0.05"'))
    robot = robot_of(path)
    gaps = [np.linalg.norm(np.diff(robot.centers(np.array([s, 0.0])), axis=0)) for s in (0, 0.5, 1)]
    assert gaps[1] < gaps[0] < gaps[2]
    assert robot.closing[0, 0] == 1.0


@pytest.mark.parametrize("sign", [1, -1])
def test_fingers_side_by_side_bend_to_their_wider_side(tmp_path, sign):
    """Without a thumb nothing but the ranges tells."""
    low, high = sorted((-0.2 * sign, 1.5 * sign))
    path = claw(tmp_path, limit=f'lower="{low}" upper="{high}"', right=1)
    urdf = tmp_path / "claw.urdf"
    urdf.write_text(urdf.read_text().replace('axis xyz="0 1 0"', 'axis xyz="1 0 0"'))
    np.testing.assert_array_equal(robot_of(path).closing, sign * np.eye(2))


@pytest.mark.parametrize("sign", [1, -1])
def test_a_finger_that_goes_across_closes_to_where_it_comes_nearer(tmp_path, sign):
    """The thumb a little behind the plane of the straight finger, which it bends away from."""
    low, high = sorted((-0.2 * sign, 1.5 * sign))
    ranges = f"ranges = {{ left_joint = [{low}, {high}] }}"
    path = claw(tmp_path, limit='lower="-1.5" upper="1.5"', right=1, toml=ranges)
    urdf = tmp_path / "claw.urdf"
    text = urdf.read_text().replace('axis xyz="0 1 0"', 'axis xyz="1 0 0"')
    urdf.write_text(text.replace('xyz="0.06 0 0"', f'xyz="0.06 {0.01 * sign} -0.06"'))
    robot = robot_of(path)
    v = robot.jacobian(robot.home)[:3, 0]
    to = np.diff(robot.centers(robot.home), axis=0)[0]
    assert sign * v @ to < 0.0
    assert robot.closing[0, 0] == sign


def test_slides_without_end_bound_how_fast_a_link_moves(tmp_path):
    """No place of it moves faster than `reach` says, wherever up to 1 m the slide is."""
    lift = 'name="lift" type="slide" axis="0 0 1" range="-0.5 0.5"'
    for ends in ("", 'range="0 inf"'):
        xml = change(XML, lift, 'name="turn" axis="0 1 0" range="-1 1"')
        slide = f'<joint name="out" type="slide" axis="1 0 0" {ends}/><joint name="proximal"'
        xml = change(xml, '<joint name="proximal"', slide)
        robot = written(tmp_path, xml[: xml.index("  <equality>")] + "</mujoco>")
        assert np.isfinite(robot.reach).all()
        speeds = np.linalg.norm(robot.jacobian(np.array([0.0, 1.0, 0.2, 0.1])), axis=0)
        assert (speeds <= robot.reach[0] + EXACT).all()


def test_two_files_are_joined_with_pose_and_prefix(tmp_path):
    tiny_hand.write(tmp_path)
    toml = """
        [[model]]
        file = "tiny.xml"
        [[model]]
        file = "tiny.xml"
        prefix = "second_"
        at = "distal"
        pos = [0.1, 0.2, 0.3]
        rpy = [0.0, 0.0, 1.5707963267948966]
        [[contact_points]]
        link = "second_distal"
        flexion = ["second_proximal"]
    """
    (tmp_path / "two.toml").write_text(toml)
    robot = robot_of(tmp_path / "two.toml")
    assert robot.joints == ("lift", "proximal", "second_lift", "second_proximal")
    # Straight: the second's tip is 0.1 along its own x, which is the first's y.
    np.testing.assert_allclose(robot.centers(np.zeros(4)), [[0.16, 0.3, 0.3]], atol=1e-9)


def test_home_lock_ranges_couplings_and_speed_are_changed_as_said(tmp_path):
    xml = XML[: XML.index("  <keyframe>")] + "</mujoco>"
    toml = """
        model = "tiny.xml"
        home = { lift = 0.25, proximal = 0.5 }
        lock = ["lift"]
        drop_couplings = ["follow"]
        couplings = [{ joint = "distal", to = "proximal", ratio = -0.5, offset = 0.1 }]
        ranges = { distal = [-0.4, 0.8] }
        speed = 3.0
        contact_points = [{ link = "distal" }]
    """
    robot = written(tmp_path, xml, toml)
    assert robot.joints == ("proximal",)
    np.testing.assert_allclose(robot.coupling, [[0], [1], [-0.5]], atol=EXACT)
    np.testing.assert_allclose(robot.offset, [0.25, 0, 0.1], atol=EXACT)
    np.testing.assert_allclose([robot.q_lower, robot.q_upper], [[0.0], [1.0]], atol=EXACT)
    np.testing.assert_array_equal(robot.home, [0.5])
    np.testing.assert_array_equal(robot.velocity, [3.0])


def test_ranges_couplings_and_locks_are_radians_whatever_the_files_angles_are_in(tmp_path):
    xml = XML[: XML.index("  <keyframe>")] + "</mujoco>"
    xml = change(xml, 'angle="radian"', 'angle="degree"')
    xml = change(xml, 'axis="0 0 1" range="0 3"', 'axis="0 0 1" range="0 180" ref="30"')
    xml = change(xml, 'range="-0.1 0.8"', 'range="-6 45"')
    toml = """
        model = "tiny.xml"
        ranges = { proximal = [0.0, 1.5], lift = [-0.2, 0.2] }
        drop_couplings = true
        couplings = [{ joint = "distal", to = "proximal", ratio = 0.5, offset = 0.1 }]
        contact_points = [{ link = "distal" }]
    """
    robot = written(tmp_path, xml, toml)
    np.testing.assert_allclose([robot.q_lower[0], robot.q_upper[0]], [-0.2, 0.2], atol=1e-9)
    # half of it and 0.1 more must stay below the distal joint's 45°
    np.testing.assert_allclose(robot.q_upper[1], 2 * (np.pi / 4 - 0.1), atol=1e-9)
    np.testing.assert_allclose(robot.offset, [0, 0, 0.1], atol=EXACT)
    locked = written(tmp_path, xml, 'drop_couplings = true\nlock = ["proximal"]\n' + SHORT)
    np.testing.assert_allclose(locked.offset, [0, np.pi / 6, 0], atol=1e-9)


def test_all_couplings_can_be_dropped_at_once(tmp_path):
    robot = written(tmp_path, toml="drop_couplings = true\n" + SHORT)
    assert robot.joints == ("lift", "proximal", "distal")


def test_a_palm_is_a_place_on_a_body_with_two_axes(tmp_path):
    palm = (
        'palm = { body = "palm", pos = [0, 0, 0.1], approach = [0, 2, 0], opposition = [1, 1, 0] }'
    )
    p, R = written(tmp_path, toml=f"{palm}\n{SHORT}").palm(np.array([0.2, 0.0]))
    np.testing.assert_allclose(p, [0, 0, 0.3], atol=EXACT)
    np.testing.assert_allclose(R, np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]), atol=EXACT)


def test_a_ball_can_stand_for_a_links_shape(tmp_path):
    toml = SHORT + "ball = { pos = [0.05, 0, 0], radius = 0.004 }\n"
    robot = written(tmp_path, toml=toml)
    np.testing.assert_array_equal(robot.tip_radius, [0.004])
    np.testing.assert_allclose(robot.centers(np.zeros(2)), [[0.11, 0, 0]], atol=EXACT)


def test_a_carriage_holds_the_palm_as_a_start_does(tmp_path):
    palm = 'palm = { body = "base", approach = [0, 0, 1], opposition = [1, 0, 0] }'
    robot = robot_of(claw(tmp_path, toml=f"carriage = true\n{palm}"))
    assert robot.arm == tuple(range(6))
    p, R = robot.palm(robot.home)
    level, down = np.cos(np.radians(40)), np.sin(np.radians(40))
    np.testing.assert_allclose(R[:, 2], [level, 0, -down], atol=1e-9)
    np.testing.assert_allclose(p, 0.0, atol=1e-9)
    J = robot.palm_jacobian(robot.home)[:, :6]
    np.testing.assert_allclose(
        np.abs(J @ J.T), np.eye(6), atol=1e-9
    )  # all six ways, about the palm


def test_a_carriage_turns_about_the_palm_wherever_on_its_hand_that_is(tmp_path):
    """Fixed axes of the world at zero: x, y and z, then yaw, pitch and roll about its own."""
    at = "pos = [0.1, -0.2, 0.3], approach = [0, 1, 0], opposition = [1, 0, 0]"
    robot = robot_of(claw(tmp_path, toml=f'carriage = true\npalm = {{ body = "base", {at} }}'))
    p, R = robot.palm(robot.home)
    level, down = np.cos(np.radians(40)), np.sin(np.radians(40))
    np.testing.assert_allclose(p, 0.0, atol=1e-9)
    np.testing.assert_allclose(R[:, 2], [level, 0, -down], atol=1e-9)
    np.testing.assert_allclose(R[:, 0], [0, 1, 0], atol=1e-9)
    q = robot.home.copy()
    q[:6] = [0.1, 0.2, 0.3, 0.4, -0.5, 0.6]
    p, turned = robot.palm(q)
    np.testing.assert_allclose(p, [0.1, 0.2, 0.3], atol=1e-9)
    x, y, z = (
        pin.rpy.rpyToMatrix(*(a * e)) for a, e in zip((0.6, -0.5, 0.4), np.eye(3), strict=True)
    )
    np.testing.assert_allclose(turned, z @ y @ x @ R, atol=1e-9)


def test_a_carriage_turns_as_far_whatever_the_files_angles_are_in(tmp_path):
    palm = 'palm = { body = "palm", approach = [1, 0, 0], opposition = [0, 1, 0] }'
    xml = XML[: XML.index("  <keyframe>")] + "</mujoco>"
    lift = '<joint name="lift" type="slide" axis="0 0 1" range="-0.5 0.5"/>'
    xml = change(change(xml, lift, ""), 'angle="radian"', 'angle="degree"')
    xml = change(xml, 'axis="0 0 1" range="0 3"', 'axis="0 0 1" range="0 170"')
    robot = written(tmp_path, xml, f"carriage = true\ndrop_couplings = true\n{palm}\n{SHORT}")
    np.testing.assert_allclose(robot.q_upper[:6], [2, 2, 2, 2.6, 1.4, 2.6])


def test_pinocchio_is_asked_for_bodies_where_joints_are_named_alike(tmp_path):
    xml = change(XML, 'name="proximal" axis', 'name="distal_joint" axis')
    xml = xml.replace('joint2="proximal"', 'joint2="distal_joint"')
    xml = xml.replace("distal_joint", "palm")
    tiny_hand.write(tmp_path, xml, SHORT)
    (part,) = RobotDescription.load(tmp_path).files
    assert second_opinion(part).position < 1e-9


def test_a_file_of_an_installed_package_is_found_without_importing_it(tmp_path):
    found = locate("mujoco:__init__.py", tmp_path)
    assert found.parts[-2:] == ("mujoco", "__init__.py")
    with pytest.raises(ModelError, match="'no_such_package' is not installed"):
        locate("no_such_package:hand.xml", tmp_path)
    with pytest.raises(ModelError, match="no such file in the installed package 'numpy'"):
        locate("numpy:hand.xml", tmp_path)
    assert locate("hand.xml", tmp_path) == tmp_path / "hand.xml"


def test_either_hand_of_the_torso_grasps_and_the_other_is_idle():
    for name, other in (("right", "left"), ("left", "right")):
        robot = robot_of("umass_torso", hand=name)
        assert robot.n == 22 and robot.model.njnt == 30
        assert robot.joints[robot.groups[0].adduction or 0] == f"{name}_bhand_f1_spread"
        idle = [joint for joint, still in zip(robot.joints, robot.idle, strict=True) if still]
        assert len(idle) == 11 and all(joint.startswith(other) for joint in idle)
    with pytest.raises(InputError, match=r"unknown hand of umass_torso 'third'.*right, left"):
        RobotDescription.load("umass_torso", "third")


def test_the_torsos_shoulders_are_where_the_public_layout_has_them():
    robot = robot_of("umass_torso")
    data = mujoco.MjData(robot.model)
    robot.place(data, robot.home)
    for side, sign in (("right", -1.0), ("left", 1.0)):
        joint = robot.model.joint(f"{side}_wam_j1").id
        np.testing.assert_allclose(data.xaxis[joint], [0, sign, 0], atol=1e-9)
        np.testing.assert_allclose(
            data.body(f"{side}_wam_link1").xpos, [0, sign * 0.35, 0.7], atol=1e-9
        )
    assert SelfClearance(robot, 0.005).collisions(robot.home) == ()


# ---------------------------------------------------------------- keyframes, free bases, roots

SIX = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
NO_KEYS = XML[: XML.index("  <keyframe>")] + "</mujoco>"
LIFT = '<joint name="lift" type="slide" axis="0 0 1" range="-0.5 0.5"/>'
FREE = change(NO_KEYS, LIFT, '<freejoint name="root"/>')
BASED = 'palm = { body = "palm", approach = [1, 0, 0], opposition = [0, 1, 0] }\n'


def six(free="", qpos=SIX, inside="", names=True):
    """A hand of two fingers with three joints each, and a keyframe of its joints."""
    finger = """<body name="{f}1" pos="{x} 0 0"><joint {a} axis="0 {s} 0" range="-1 2"/>
        <geom type="capsule" size="0.01" fromto="0 0 0 0 0 0.04"/>
        <body name="{f}2" pos="0 0 0.05"><joint {b} axis="0 {s} 0" range="-1 2"/>
        <geom type="capsule" size="0.01" fromto="0 0 0 0 0 0.04"/>
        <body name="{f}3" pos="0 0 0.05"><joint {c} axis="0 {s} 0" range="-1 2"/>
        <geom type="sphere" size="0.01" pos="0 0 0.03"/></body></body></body>"""
    fingers = "".join(
        finger.format(
            f=f, x=x, s=s, **{k: f'name="{f}{k}"' if names else "" for k in ("a", "b", "c")}
        )
        for f, x, s in (("l", -0.06, 1), ("r", 0.06, -1))
    )
    key = f'<key name="home" qpos="{" ".join(map(str, qpos))}"/>' if len(qpos) else ""
    return (
        f'<mujoco model="six"><compiler angle="radian"/><worldbody><body name="palm">{free}'
        f'<geom size="0.02"/>{fingers}</body>{inside}</worldbody><keyframe>{key}</keyframe>'
        "</mujoco>"
    )


TIPS = '[[contact_points]]\nlink = "l3"\n[[contact_points]]\nlink = "r3"\n'
SIX_HAND = 'model = "tiny.xml"\n{}\n' + TIPS
SIX_PALM = 'palm = { body = "palm", approach = [0, 0, 1], opposition = [1, 0, 0] }\n'


@pytest.mark.parametrize("named", ["", 'home = "home"\n'])
def test_a_keyframe_on_a_carriage_is_the_fingers_and_not_the_carriages(tmp_path, named):
    toml = SIX_HAND.format(named + "carriage = true")
    robot = written(tmp_path, six(), toml)
    np.testing.assert_array_equal(robot.home, [0.0] * 6 + SIX)
    np.testing.assert_array_equal(Scene(tmp_path).articulated.home, robot.home)


def test_each_files_keyframe_places_its_own_joints(tmp_path):
    """The arm's file has another keyframe of that name, and its own order."""
    (tmp_path / "arm.xml").write_text(change(XML, 'qpos="0 0.2 0.1"', 'qpos="0.3 0.4 0.2"'))
    toml = """
        home = "{}"
        [[model]]
        file = "arm.xml"
        [[model]]
        file = "tiny.xml"
        prefix = "hand_"
        at = "distal"
        [[contact_points]]
        link = "hand_l3"
        [[contact_points]]
        link = "hand_r3"
    """
    robot = written(tmp_path, six(), toml.format("home"))
    np.testing.assert_array_equal(robot.home, [0.3, 0.4, *SIX])
    only = change(six(), 'key name="home"', 'key name="open"')
    np.testing.assert_array_equal(written(tmp_path, only, toml.format("open")).home, [0, 0, *SIX])
    refused(
        lambda: written(tmp_path, only, toml.format("shut")),
        "no keyframe 'shut' in arm.xml, tiny.xml", "keyframes are: home, open",
    )  # fmt: skip


def test_of_several_keyframes_the_named_one_counts(tmp_path):
    keys = '<key qpos="1 1 1 1 1 1"/><key name="shut" qpos="0 0 0 1 1 1"/></keyframe>'
    xml = six().replace("</keyframe>", keys)
    np.testing.assert_array_equal(written(tmp_path, xml, SIX_HAND.format("")).home, SIX)
    shut = written(tmp_path, xml, SIX_HAND.format('home = "shut"'))
    np.testing.assert_array_equal(shut.home, [0, 0, 0, 1, 1, 1])
    # a table stands alone: joints it leaves out are at zero
    table = written(tmp_path, xml, SIX_HAND.format("home = { rb = 0.5 }"))
    np.testing.assert_array_equal(table.home, [0, 0, 0, 0, 0.5, 0])


def test_a_keyframe_without_angles_leaves_the_joints_where_they_are(tmp_path):
    xml = change(six(qpos=()), "<keyframe>", '<keyframe><key name="home" time="1"/>')
    np.testing.assert_array_equal(written(tmp_path, xml, SIX_HAND.format("")).home, np.zeros(6))


@pytest.mark.parametrize(
    ("qpos", "words"),
    [
        ([0.1, 0.2, 0.3, 0.4, 0.5, 2.5], ("home", "'rc' at 2.5", "outside its range [-1, 2]")),
        ([0.1, 0.2, 0.3, 0.4, 0.5, "nan"], ("keyframe 'home'", "not all finite")),
        ([0.1, 0.2, 0.3, 0.4, 0.5, "inf"], ("keyframe 'home'", "not all finite")),
        ([0.1], ("keyframe 'home'", "has 1 numbers", "6 joints take 6")),
        ([0.1] * 7, ("keyframe 'home'", "has 7 numbers", "6 joints take 6")),
    ],
)
@pytest.mark.parametrize("carriage", ["", "carriage = true\n"])
def test_a_keyframe_that_cannot_be_is_refused(tmp_path, monkeypatch, qpos, words, carriage):
    monkeypatch.chdir(tmp_path)  # MuJoCo keeps a log of the NaNs it warns of
    refused(lambda: written(tmp_path, six(qpos=qpos), SIX_HAND.format(carriage)), *words)


def test_a_free_base_with_lock_keyframe_and_carriage_works(tmp_path):
    based = [0.5, 0.0, 0.2, 0.0, 1.0, 0.0, 0.0, *SIX]
    free = six('<freejoint name="root"/>', based)
    locked = written(tmp_path, free, SIX_HAND.format('lock = ["root"]\n' + SIX_PALM))
    np.testing.assert_array_equal(locked.home, SIX)
    p, R = locked.palm(locked.home)  # where the keyframe holds the base, upside down
    np.testing.assert_allclose(p, [0.5, 0, 0.2], atol=EXACT)
    np.testing.assert_allclose(R, np.diag([1.0, -1.0, -1.0]), atol=EXACT)
    toml = SIX_HAND.format('carriage = true\nlock = ["root"]\n' + SIX_PALM)
    carried = written(tmp_path, free, toml)
    np.testing.assert_array_equal(carried.home, [0.0] * 6 + SIX)
    fixed = SIX_HAND.format("carriage = true\n" + SIX_PALM)
    same = written(tmp_path, six(), fixed)
    np.testing.assert_allclose(carried.centers(carried.home), same.centers(same.home), atol=1e-9)
    # each way that is closed names the one that is open
    refused(lambda: written(tmp_path, free, fixed), "'root' moves 'palm'", 'lock = ["root"]')
    refused(lambda: written(tmp_path, free, SIX_HAND.format("")), 'lock = ["root"]')
    unnamed = six("<freejoint/>", based)
    refused(lambda: written(tmp_path, unnamed, SIX_HAND.format("")), 'lock = ["palm_joint"]')
    toml = SIX_HAND.format('carriage = true\nlock = ["palm_joint"]\n' + SIX_PALM)
    np.testing.assert_array_equal(written(tmp_path, unnamed, toml).home, carried.home)


def test_a_free_base_is_fixed_where_its_file_is_joined(tmp_path):
    (tmp_path / "arm.xml").write_text(XML)
    toml = """
        {}
        [[model]]
        file = "arm.xml"
        [[model]]
        file = "tiny.xml"
        prefix = "hand_"
        at = "distal"
        [[contact_points]]
        link = "hand_l3"
        [[contact_points]]
        link = "hand_r3"
    """
    free = six('<freejoint name="root"/>', [0, 0, 0.1, 1, 0, 0, 0, *SIX])
    robot = written(tmp_path, free, toml.format('lock = ["hand_root"]'))
    np.testing.assert_array_equal(robot.home, [0, 0.2, *SIX])
    at = robot.model.body("hand_palm").pos
    np.testing.assert_allclose(at, [0, 0, 0.1], atol=EXACT)
    refused(
        lambda: written(tmp_path, free, toml.format("")),
        "free base 'hand_root'", "'distal' cannot carry", 'lock = ["hand_root"]',
    )  # fmt: skip


@pytest.mark.parametrize("root", ["world", "odom"])
def test_the_floating_joint_of_a_urdf_can_be_locked(tmp_path, root):
    """Below a root link that is not named world, MuJoCo has it where no free joint may be."""
    path = claw(tmp_path)
    floating = f'''<link name="{root}"/><joint name="float" type="floating"><parent link="{root}"/>
        <child link="base"/><origin xyz="1 0 0"/></joint></robot>'''
    urdf = change((tmp_path / "claw.urdf").read_text(), "</robot>", floating)
    (tmp_path / "claw.urdf").write_text(urdf)
    refused(lambda: robot_of(path), "'float'", 'lock = ["float"]')
    path.write_text('lock = ["float"]\n' + path.read_text())
    robot = robot_of(path)
    assert robot.joints == ("left_joint", "right_joint")
    np.testing.assert_allclose(robot.centers(robot.home).mean(axis=0), [1, 0, 0.1], atol=EXACT)


def test_what_acts_on_a_locked_free_base_goes_with_it(tmp_path):
    acts = """<actuator><motor joint="root" gear="1 0 0 0 0 0"/><position joint="la"/></actuator>
        <sensor><jointpos joint="la"/></sensor></mujoco>"""
    xml = change(six('<freejoint name="root"/>', []), "</mujoco>", acts)
    robot = written(tmp_path, xml, SIX_HAND.format('lock = ["root"]'))
    assert (robot.n, robot.model.nu, robot.model.nsensor) == (6, 1, 1)


def test_the_check_takes_a_free_base(tmp_path):
    tiny_hand.write(
        tmp_path, six('<freejoint name="root"/>', []), SIX_HAND.format('lock = ["root"]')
    )
    assert "tiny.xml: not compared: a joint is neither hinge nor slide" in check(tmp_path)


def test_the_check_takes_a_file_of_one_joint(tmp_path):
    """Whose Jacobian Pinocchio gives as a vector."""
    xml = change(
        change(NO_KEYS, LIFT, ""), '<joint name="distal" axis="0 0 1" range="-0.1 0.8"/>', ""
    )
    xml = xml[: xml.index("  <equality>")] + "</mujoco>"
    tiny_hand.write(tmp_path, xml, SHORT)
    assert "1 independent joints, 1 in all" in check(tmp_path)


OTHERS = (
    '<body name="table" pos="0 0 -0.5"><joint name="door"/>'
    '<geom name="top" type="box" size="1 1 .1"/></body>'
    '<body name="cube" pos="1 0 0"><freejoint name="cube"/><geom size="0.02"/></body>'
    '<geom name="floor" type="plane" size="1 1 .1"/>'
)


def test_a_file_of_several_root_bodies_names_its_robot(tmp_path):
    qpos = [*SIX, 0.7, 1, 0, 0, 1, 0, 0, 0]
    xml = six(qpos=qpos, inside=OTHERS).replace(
        "</mujoco>",
        '<equality><weld body1="palm" body2="cube"/></equality>'
        '<actuator><motor joint="cube"/></actuator></mujoco>',
    )
    carriage = "carriage = true\n" + SIX_PALM
    refused(
        lambda: written(tmp_path, xml, SIX_HAND.format(carriage)),
        "one root body", "'palm', 'table', 'cube'", "geoms of the world", 'root = "BODY"',
    )  # fmt: skip
    for line in ('root = "palm"\n', ""):
        toml = SIX_HAND.format(line + carriage)
        if not line:
            toml = toml.replace('"tiny.xml"', '{ file = "tiny.xml", root = "palm" }')
        robot = written(tmp_path, xml, toml)
        np.testing.assert_array_equal(robot.home, [0.0] * 6 + SIX)
        assert robot.model.body(1).name == "palm" and robot.model.nu == 0
        assert "floor" not in [robot.model.geom(g).name for g in range(robot.model.ngeom)]
        assert "not compared" in check(tmp_path)
    refused(
        lambda: written(tmp_path, xml, SIX_HAND.format('root = "plam"')),
        "root of tiny.xml", "no root body 'plam'; did you mean 'palm'?",
    )  # fmt: skip
    two = 'root = "palm"\n[[model]]\nfile = "tiny.xml"\n' + TIPS
    refused(lambda: written(tmp_path, xml, two), "root belongs into [[model]]")


def test_a_carriage_refuses_a_root_with_joints_of_its_own(tmp_path):
    toml = "carriage = true\n" + BASED + SHORT
    refused(lambda: written(tmp_path, NO_KEYS, toml), "'lift' moves 'palm'", "body of its own")


@pytest.mark.parametrize("placed", ['euler="0.3 -0.2 2"', 'axisangle="1 2 3 0.7"', "frame"])
def test_a_carriage_holds_the_palm_whatever_the_file_places_it_by(tmp_path, placed):
    """Euler angles and frames of the file stay in force in MuJoCo beside a pose that is set."""
    xml = six()
    if placed == "frame":
        xml = change(
            xml, '<body name="palm">', '<frame pos="1 2 3" euler="1 0 0"><body name="palm">'
        )
        xml = change(xml, "</worldbody>", "</frame></worldbody>")
    else:
        xml = change(xml, '<body name="palm">', f'<body name="palm" {placed}>')
    robot = written(tmp_path, xml, SIX_HAND.format("carriage = true\n" + SIX_PALM))
    p, R = robot.palm(robot.home)
    level, down = np.cos(np.radians(40)), np.sin(np.radians(40))
    np.testing.assert_allclose(R[:, 2], [level, 0, -down], atol=1e-9)
    np.testing.assert_allclose(p, 0.0, atol=1e-9)


def test_a_scene_moves_all_of_a_robot_and_keeps_frames(tmp_path):
    """A body in a <frame>, files that stand side by side, and geoms of the world."""
    base = (0.0, 0.0, 1.0, np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
    xml = change(six(), '<body name="palm">', '<frame pos="1 0 0"><body name="palm">')
    xml = change(
        xml,
        "</worldbody>",
        '</frame><geom name="foot" pos="2 0 0" size="0.1"/><site name="mark" pos="2 0 0"/>'
        "</worldbody>",
    )
    tiny_hand.write(tmp_path, xml, SIX_HAND.format(""))
    alone, moved = Scene(tmp_path).articulated, Scene(tmp_path, base=base).articulated
    x = written(tmp_path, xml, SIX_HAND.format("")).centers(alone.home)
    np.testing.assert_allclose(alone.centers(alone.home), x, atol=EXACT)
    turned = np.column_stack([-x[:, 1], x[:, 0], x[:, 2] + 1.0])
    np.testing.assert_allclose(moved.centers(moved.home), turned, atol=EXACT)
    for thing in (moved.model.geom("foot"), moved.model.site("mark")):
        np.testing.assert_allclose(thing.pos, [0, 2, 1], atol=EXACT)
    toml = """
        [[model]]
        file = "tiny.xml"
        [[model]]
        file = "tiny.xml"
        prefix = "b_"
        pos = [0.0, 0.0, 0.5]
        [[contact_points]]
        link = "l3"
        [[contact_points]]
        link = "b_l3"
    """
    (tmp_path / "two.toml").write_text(toml)
    robot, scene = robot_of(tmp_path / "two.toml"), Scene(tmp_path / "two.toml").articulated
    assert np.ptp(robot.centers(robot.home)[:, 2]) == pytest.approx(0.5)
    np.testing.assert_allclose(scene.centers(robot.home), robot.centers(robot.home), atol=EXACT)


# ---------------------------------------------------------------- names, equalities, tendons


def test_joints_without_names_are_named_after_their_bodies_and_recorded(tmp_path):
    toml = SIX_HAND.format("carriage = true\n" + SIX_PALM + "velocity = { l1_joint = 0.5 }")
    robot = written(tmp_path, six(names=False), toml)
    joints = [f"{body}_joint" for body in ("l1", "l2", "l3", "r1", "r2", "r3")]
    assert robot.joints[6:] == tuple(joints) and len(set(robot.joints)) == 12
    np.testing.assert_array_equal(robot.home[6:], SIX)
    scene = Scene(tmp_path, Cylinder(0.03))
    record = hg.Trial(scene, hg.stack_of("f"), probes=1).run(seed=1)
    columns = [name for name in record.rows[0] if name.startswith("q_")]
    assert len(columns) == 12, columns


def test_names_that_are_given_are_never_taken_twice(tmp_path):
    """Bodies too: several joints of one body, a body without a name, and a name that is taken."""
    xml = change(NO_KEYS, LIFT, '<joint type="slide" axis="0 0 1"/><joint axis="0 0 1"/>')
    xml = change(xml, 'name="proximal" axis', 'name="palm_joint_2" axis')
    xml = change(xml, 'joint2="proximal"', 'joint2="palm_joint_2"')
    xml = change(xml, '<body name="proximal">', "<body>")
    robot = written(tmp_path, xml)
    assert robot.joints == ("palm_joint_1", "palm_joint_2_", "palm_joint_2")
    assert [robot.model.body(b).name for b in range(4)] == ["world", "palm", "palm_body", "distal"]


def test_a_home_that_a_coupled_joint_cannot_follow_is_told(tmp_path):
    toml = "home = { proximal = 0.4, distal = 0.7 }\n" + SHORT
    tiny_hand.write(tmp_path, NO_KEYS, toml)
    assert "home has distal at 0.7; it is coupled, and follows to 0.2" in check(tmp_path)
    assert "home has" not in check(tiny_hand.write(tmp_path, XML, SHORT))


@pytest.mark.parametrize("line", ["home = 5", "home = true", "velocity = 2", "ranges = [0, 1]"])
def test_a_table_of_joints_must_be_one(tmp_path, line):
    words = f"{line.split()[0]} must be a table of joints"
    refused(lambda: written(tmp_path, toml=f"{line}\n{SHORT}"), words)
    refused(lambda: written(tmp_path, toml=SHORT.replace('"tiny.xml"', "[]")), "model is empty")


GROUP = '[[groups]]\nname = "left"\ncontact_points = [{ link = "distal", name = "tip" }]\n'


def test_two_groups_of_one_name_are_refused(tmp_path):
    toml = 'model = "tiny.xml"\n' + GROUP + GROUP
    refused(lambda: written(tmp_path, NO_KEYS, toml), "two groups are named 'left'")


@pytest.mark.parametrize(
    ("hands", "words"),
    [
        ('both = ["left", "right"]', "two contact points of hand 'both' are named 'tip'"),
        ('both = ["left", "wrong"]', "hands.both: no group 'wrong'; they are: left, right"),
        ('both = ["left", "left"]', "two groups of hands.both are named 'left'"),
        ("both = []", "hands.both is empty: it names the groups that grasp together"),
        ('left = ["right"]', "two hands are named 'left'"),
        ('both = { groups = ["left"], starts = 1 }', "unknown entry 'starts'"),
    ],
)
def test_a_hand_of_groups_is_refused_for_what_is_wrong_with_it(tmp_path, hands, words):
    toml = f'model = "tiny.xml"\n[hands]\n{hands}\n' + GROUP + GROUP.replace("left", "right")
    refused(lambda: written(tmp_path, NO_KEYS, toml), words)


def test_hands_as_they_were_once_written_are_told_how_to_be_now(tmp_path):
    toml = 'model = "tiny.xml"\n' + GROUP.replace("groups", "hands")
    refused(lambda: written(tmp_path, NO_KEYS, toml), "hands names groups", "a group is [[groups]]")


TORSO = """<mujoco><compiler angle="radian"/><worldbody>
<body name="waist"><joint name="waist" axis="0 0 1" range="-1 1"/><geom size=".01"/>
  <body name="palm_a" pos="0 .1 0"><joint name="arm_a" axis="1 0 0" range="-1 1"/>
    <geom size=".01"/>
    <body name="tip_a" pos="0 0 .1"><joint name="close_a" axis="1 0 0" range="-1 1"/>
      <geom name="ball_a" size=".01" pos="0 0 .05"/></body></body>
  <body name="palm_b" pos="0 -.1 0"><joint name="arm_b" axis="1 0 0" range="-1 1"/>
    <geom size=".01"/>
    <body name="tip_b" pos="0 0 .1"><joint name="close_b" axis="1 0 0" range="-1 1"/>
      <geom name="ball_b" size=".01" pos="0 0 .05"/></body></body>
</body></worldbody>%s</mujoco>"""
ARMS = """
model = "tiny.xml"
hands.both = ["a", "b"]
[[groups]]
name = "a"
palm = { body = "palm_a" }
arm = ["arm_a"]
contact_points = [{ link = "tip_a", flexion = ["close_a"] }]
[[groups]]
name = "b"
palm = { body = "palm_b" }
arm = ["arm_b"]
contact_points = [{ link = "tip_b", flexion = ["close_b"] }]
"""


def two_arms(tmp_path, xml=TORSO % "", toml=ARMS, hand="both"):
    (tmp_path / "tiny.xml").write_text(xml)
    (tmp_path / "robot.toml").write_text(toml)
    about = RobotDescription.load(tmp_path, hand)
    return Robot(about, compiled(about))


def test_groups_that_grasp_together_keep_their_own_palms_arms_and_points(tmp_path):
    robot = two_arms(tmp_path)
    assert [g.name for g in robot.groups] == ["a", "b"]
    assert [g.points for g in robot.groups] == [(0,), (1,)]
    named = [[robot.joints[j] for j in g.arm] for g in robot.groups]
    assert named == [["arm_a"], ["arm_b"]] and robot.arm == (1, 3)
    for g, y in ((0, 0.1), (1, -0.1)):
        np.testing.assert_allclose(robot.palm(robot.home, g)[0], [0.0, y, 0.0], atol=1e-12)
    wheres = ["tip_a", "tip_b", "palm_a", "palm_b", "ball_b"]
    assert [robot.group_of(where) for where in wheres] == [0, 1, 0, 1, 1]
    J = robot.palm_jacobian(robot.home, 1)
    assert J[3:, 1].tolist() == [0.0, 0.0, 0.0] and J[3:, 3].tolist() == [1.0, 0.0, 0.0]
    alone = two_arms(tmp_path, hand="b")
    assert [g.name for g in alone.groups] == ["b"] and alone.idle.tolist() == [0, 1, 1, 0, 0]


def test_groups_that_share_an_arm_cannot_grasp_together(tmp_path):
    toml = ARMS.replace('arm = ["arm_b"]', 'arm = ["arm_b", "arm_a"]')
    refused(
        lambda: two_arms(tmp_path, toml=toml),
        "groups 'a' and 'b'",
        "share the arm joint 'arm_a'",
        "have an arm each",
    )
    two_arms(tmp_path, toml=toml, hand="b")


def test_a_coupling_across_groups_is_refused(tmp_path):
    equality = '<equality><joint joint1="close_b" joint2="close_a"/></equality>'
    refused(
        lambda: two_arms(tmp_path, TORSO % equality),
        "moves groups 'a' and 'b' by a coupling",
    )


SLIDING = TORSO % ""  # arm a moves its palm straight along the approach axis, z
SLIDING = change(SLIDING, 'name="arm_a" axis="1 0 0"', 'name="arm_a" type="slide" axis="0 0 1"')
BY_ARM = ARMS.replace('flexion = ["close_a"]', 'flexion = "arm"')


def test_an_arm_closes_one_contact_point_straight_along_its_palms_axis(tmp_path):
    robot = two_arms(tmp_path, SLIDING, BY_ARM)
    assert not robot.closing[0].any()
    np.testing.assert_allclose(robot.closing_at(robot.home)[0], [0.0, 1.0, 0.0, 0.0, 0.0])
    more = BY_ARM.replace(
        'flexion = "arm" }]', 'flexion = "arm" }, { link = "palm_a", flexion = "arm" }]'
    )
    refused(lambda: two_arms(tmp_path, SLIDING, more), "closes 'tip_a' and 'palm_a'", "close one")
    bare = BY_ARM.replace('arm = ["arm_a"]', "arm = []")
    refused(lambda: two_arms(tmp_path, SLIDING, bare), "has no arm to close with")


@pytest.mark.parametrize(
    ("xml", "old", "new"),
    [
        (TORSO % "", "", ""),  # its one hinge turns the palm on the spot
        (SLIDING, 'body = "palm_a"', 'body = "palm_a", approach = [0.0, 1.0, 0.0]'),
        (SLIDING, 'body = "palm_a"', 'body = "palm_b"'),
        (SLIDING, 'link = "tip_a"', 'link = "waist"'),
    ],
)
def test_an_arm_that_cannot_bring_its_point_on_along_the_axis_is_refused(tmp_path, xml, old, new):
    toml = change(BY_ARM, old, new) if old else BY_ARM
    refused(
        lambda: two_arms(tmp_path, xml, toml),
        "the arm of group 'a' of ",
        "arm_a, does not bring '",
        "on along the palm's approach axis",
        "another home, palm or arm",
    )


def test_a_palm_whose_arm_closes_must_be_described(tmp_path):
    toml = change(BY_ARM, 'palm = { body = "palm_a" }\n', "")
    refused(lambda: two_arms(tmp_path, SLIDING, toml), "group 'a' of ", "it needs palm = { body")


def test_a_word_that_is_no_way_to_close_is_refused(tmp_path):
    toml = change(ARMS, '["close_a"]', '"arms"')
    refused(lambda: two_arms(tmp_path, toml=toml), 'flexion must be "arm", a list', "got 'arms'")


def test_a_hands_own_home_stands_in_place_of_the_robots(tmp_path):
    both = 'hands.both = { groups = ["a", "b"], home = { arm_b = 0.3 } }'
    robot = two_arms(tmp_path, toml=ARMS.replace('hands.both = ["a", "b"]', both))
    assert robot.home.tolist() == [0.0, 0.0, 0.0, 0.3, 0.0]
    assert not two_arms(tmp_path, hand="a").home.any()


WELD = '<weld name="hold" body1="distal" body2="palm"/>'


def test_a_weld_of_links_is_refused_as_a_loop_is(tmp_path):
    xml = change(XML, "<equality>", f"<equality>{WELD}")
    refused(lambda: written(tmp_path, xml), "equality hold welds two links", "drop_couplings")
    robot = written(tmp_path, xml, 'drop_couplings = ["hold"]\n' + SHORT)
    assert robot.joints == ("lift", "proximal")  # the file's other coupling is kept
    site = '<weld name="hold" site1="tip_center" site2="palm"/>'
    refused(lambda: written(tmp_path, change(XML, "<equality>", f"<equality>{site}")), "welds two")
    world = '<connect name="loop" body1="distal" anchor="0 0 0"/>'
    refused(lambda: written(tmp_path, change(XML, "<equality>", f"<equality>{world}")), "loop of")


def test_an_equality_that_binds_no_joint_is_let_be(tmp_path):
    """One that is switched off, and one of two bodies that no joint moves apart."""
    off = WELD.replace("/>", ' active="false"/>')
    assert written(tmp_path, change(XML, "<equality>", f"<equality>{off}")).n == 2
    nail = change(XML, '<site name="tip_center"', '<body name="nail"/><site name="tip_center"')
    for end in ('body1="distal" body2="nail"', 'site1="tip_center" site2="other"'):
        both = change(
            nail, '<site name="tip_center"', '<site name="other"/><site name="tip_center"'
        )
        assert written(tmp_path, change(both, "<equality>", f"<equality><weld {end}/>")).n == 2
    mocap = change(FREE, "</worldbody>", '<body name="hook" mocap="true"/></worldbody>')
    mocap = change(mocap, "<equality>", '<equality><weld body1="hook" body2="palm"/>')
    assert written(tmp_path, mocap, 'lock = ["root"]\n' + SHORT).n == 1


def test_couplings_that_are_said_replace_the_files(tmp_path):
    line = 'couplings = [{ joint = "distal", to = "proximal", ratio = 0.25 }]\n'
    robot = written(tmp_path, NO_KEYS, line + SHORT)
    np.testing.assert_array_equal(robot.coupling, [[1, 0], [0, 1], [0, 0.25]])
    assert "left out, of the files' equalities: follow" in check(tmp_path)
    # all of them, loops too
    looped = change(NO_KEYS, "<equality>", f"<equality>{CONNECT}{WELD}")
    np.testing.assert_array_equal(written(tmp_path, looped, line + SHORT).coupling, robot.coupling)
    assert written(tmp_path, NO_KEYS, "couplings = []\n" + SHORT).n == 3
    # but for those that drop_couplings leaves in
    lift = 'couplings = [{ joint = "lift", to = "proximal", ratio = 0.1 }]\n'
    both = written(tmp_path, NO_KEYS, lift + "drop_couplings = []\n" + SHORT)
    np.testing.assert_allclose(both.coupling, [[0.1], [1], [0.5]])
    assert written(tmp_path, NO_KEYS, lift + SHORT).joints == ("proximal", "distal")
    assert "left out" not in check(tiny_hand.write(tmp_path, XML, SHORT))
    twice = line + "drop_couplings = []\n" + SHORT
    refused(lambda: written(tmp_path, NO_KEYS, twice), "contradict or repeat", "'distal'")


def test_a_urdfs_mimics_are_replaced_too(tmp_path):
    path = claw(tmp_path, toml='couplings = [{ joint = "right_joint", to = "left_joint" }]')
    xml = (tmp_path / "claw.urdf").read_text()
    mimic = '<mimic joint="left_joint" multiplier="0.5"/></joint>'
    head, _, tail = xml.rpartition("</joint>")
    (tmp_path / "claw.urdf").write_text(head + mimic + tail)
    about = RobotDescription.load(path)
    C = compiled(about)
    assert C.neq == 1 and C.eq_data[0, 1] == 1.0


TENDONS = """<tendon>
  <fixed name="pull"><joint joint="proximal" coef="1"/><joint joint="distal" coef="1"/></fixed>
  <fixed name="stop" limited="true" range="0 1"><joint joint="distal" coef="1"/></fixed>
  <spatial name="cord" range="0 0.2" limited="true"><site site="palm"/><site site="tip_center"/>
  </spatial>
  <fixed name="idle"><joint joint="proximal" coef="1"/></fixed></tendon>
  <actuator><position tendon="pull" kp="1"/></actuator></mujoco>"""


def test_the_check_names_the_tendons_that_are_not_read(tmp_path):
    xml = change(NO_KEYS, "</mujoco>", TENDONS)
    tiny_hand.write(tmp_path, xml, "drop_couplings = true\n" + SHORT)
    text = check(tmp_path)
    for words in (
        "tendons that are not read",
        "pull over proximal, distal: an actuator drives it",
        "stop over distal: its length is limited to 0 … 1",
        "cord over sites, along a path in space: its length is limited to 0 … 0.2",
    ):
        assert words in text, text
    assert "idle" not in text and "drop_couplings" not in text  # no equality is left to keep
    (line,) = [v for v in text.splitlines() if v.startswith("couplings = ")]
    told = written(tmp_path, xml, line + "\n" + SHORT)
    np.testing.assert_array_equal(told.coupling, [[1, 0], [0, 1], [0, 1]])
    assert "pull" not in check(tmp_path)
    # one that is limited is named still, and its joints are no longer asked about
    limited = change(xml, 'name="pull"', 'name="pull" limited="true" range="0 1"')
    text = check(tiny_hand.write(tmp_path, limited, line + "\n" + SHORT))
    assert "pull over proximal, distal" in text and "couplings = [" not in text
    lift = 'name="pull"><joint joint="lift" coef="1"/>'
    text = check(tiny_hand.write(tmp_path, change(xml, 'name="pull">', lift), SHORT))
    assert "drop_couplings = []  # keeps the files' own equalities" in text
    assert "tendons" not in check(tiny_hand.write(tmp_path, XML, SHORT))


# ---------------------------------------------------------------- files as others save them


def test_a_coupling_through_a_tendon_that_nothing_moves_is_refused(tmp_path):
    slack = '<tendon><fixed name="slack"><joint joint="lift" coef="0"/></fixed></tendon><equality>'
    xml = change(NO_KEYS, "<equality>", slack + '<tendon name="held" tendon1="slack"/>')
    refused(lambda: written(tmp_path, xml), "equality held", "no joint moves")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_a_description_may_begin_with_a_byte_order_mark(tmp_path, encoding, ending):
    tiny_hand.write(tmp_path)
    text = ('description = "Händchen"\n\t' + SHORT).replace("\n", ending)
    (tmp_path / "robot.toml").write_bytes(text.encode(encoding))
    assert robot_of(tmp_path).n == 2


@pytest.mark.parametrize("encoding", ["latin-1", "utf-16"])
def test_a_description_in_another_encoding_is_refused(tmp_path, encoding):
    tiny_hand.write(tmp_path)
    (tmp_path / "robot.toml").write_bytes(('description = "Händchen"\n' + SHORT).encode(encoding))
    refused(lambda: robot_of(tmp_path), "robot.toml is not UTF-8", "byte", "save it")


def test_a_description_that_cannot_be_read_says_so(tmp_path):
    (tmp_path / "robot.toml").mkdir()
    refused(lambda: robot_of(tmp_path), "no robot")


@pytest.mark.parametrize("encoding", ["latin-1", "utf-16"])
def test_a_model_in_another_encoding_is_named(tmp_path, encoding):
    tiny_hand.write(tmp_path, toml=SHORT)
    (tmp_path / "tiny.xml").write_bytes(change(XML, '"tip"', '"fühler"').encode(encoding))
    refused(lambda: robot_of(tmp_path), "tiny.xml is not a valid MJCF")
    path = claw(tmp_path)
    text = (tmp_path / "claw.urdf").read_text().replace('"base"', '"fuß"')
    (tmp_path / "claw.urdf").write_bytes(text.encode("latin-1"))
    refused(lambda: robot_of(path), "claw.urdf is not a valid URDF")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("clearance = nan", "clearance must be a finite number"),
        ("clearance = inf", "clearance must be a finite number"),
        ("clearance = -0.001", "clearance must be 0 or more"),
        ('clearance = "0.005"', "clearance must be a finite number"),
        ("clearance = true", "clearance must be a finite number"),
        ("home = { proximal = nan }", "home of proximal must be a finite number"),
        ("speed = -1.0", "speed must be finite and above 0"),
        ("speed = nan", "speed must be finite and above 0"),
        ("start = { advance = nan }", "start.advance must be a finite number"),
        ("start = { elevation = [nan, 1] }", "start.elevation"),
        ("ranges = { lift = [nan, 1] }", "ranges of lift"),
        ("ranges = { lift = [1, 0] }", "ranges of lift must be [low, high]"),
        ("workspace = [0, nan, 0]", "workspace"),
        ('couplings = [{ joint = "distal", to = "proximal", ratio = inf }]', "couplings.ratio"),
        ('palm = { body = "palm", pos = [nan, 0, 0] }', "palm.pos"),
    ],
)
def test_no_number_of_a_description_may_be_nan(tmp_path, line, words):
    refused(lambda: written(tmp_path, toml=f"{line}\n{SHORT}"), "robot.toml", words)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('pos="0.06 0 0"', 'pos="nan 0 0"', "body 'distal'"),
        ('pos="0.06 0 0"', 'pos="inf 0 0"', "body 'distal'"),
        ('range="0 3"', 'range="0 nan"', "joint 'proximal'"),
        ('type="sphere" size="0.01"', 'type="sphere" size="nan"', "nan"),
        ('type="sphere" size="0.01"', 'type="sphere" size="inf"', "inf"),
        ('<site name="palm"/>', '<site name="palm" pos="0 nan 0"/>', "site 'palm'"),
        ("0 0.5 0 0 0", "0 nan 0 0 0", "equality follow"),
    ],
)
def test_a_model_with_a_nan_is_refused_by_name(tmp_path, monkeypatch, old, new, words):
    monkeypatch.chdir(tmp_path)
    refused(lambda: written(tmp_path, change(NO_KEYS, old, new)), words)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('xyz="-0.06 0 0"', 'xyz="nan 0 0"', "body 'left'"),
        ('xyz="0 1 0"', 'xyz="0 nan 0"', "joint 'left_joint'"),
        ('radius="0.01"', 'radius="nan"', "nan"),
        ('mass value="1"', 'mass value="nan"', "'left'"),  # MuJoCo's own words
    ],
)
def test_a_urdf_with_a_nan_is_refused_by_name(tmp_path, monkeypatch, old, new, words):
    monkeypatch.chdir(tmp_path)
    path = claw(tmp_path)
    (tmp_path / "claw.urdf").write_text((tmp_path / "claw.urdf").read_text().replace(old, new))
    refused(lambda: robot_of(path), words)


def test_a_locked_joint_stands_within_its_range(tmp_path):
    xml = change(NO_KEYS, 'range="-0.5 0.5"', 'range="0.2 0.5"')
    robot = written(tmp_path, xml, 'lock = ["lift"]\n' + SHORT)
    np.testing.assert_array_equal(robot.offset, [0.2, 0, 0])
    toml = 'lock = ["lift"]\nhome = { lift = 0.9 }\n' + SHORT
    refused(lambda: written(tmp_path, xml, toml), "'lift'", "held at 0.9", "range [0.2, 0.5]")


def test_a_ball_joint_is_refused_without_the_advice_to_lock_it(tmp_path):
    xml = change(NO_KEYS, LIFT, '<joint name="wrist" type="ball"/>')
    with pytest.raises(ModelError, match=r"'wrist' .* neither hinge nor slide") as told:
        written(tmp_path, xml)
    assert "lock" not in str(told.value)
    refused(lambda: written(tmp_path, xml, 'lock = ["wrist"]\n' + SHORT), "lock", "'wrist'")
    refused(lambda: written(tmp_path, xml, "home = { wrist = 1.0 }\n" + SHORT), "home", "'wrist'")


def test_a_urdf_is_not_probed_physically_and_the_way_out_is_said(tmp_path):
    """Coupled or not: it has neither sites to feel at nor servos."""
    path = claw(tmp_path)
    nail = FINGER.format(n="nail", x=0, s=1, shape=BALL, limit=LIMIT).replace('"base"', '"left"')
    nail = nail.replace("</joint>", '<mimic joint="left_joint" multiplier="0.5"/></joint>')
    (tmp_path / "claw.urdf").write_text(
        change((tmp_path / "claw.urdf").read_text(), "</robot>", nail + "</robot>")
    )
    scene = Scene(path, Cylinder(0.03), (0.0, 0.0, 0.1))
    trial = hg.Trial(scene, hg.stack_of("fm"), probe="physical")
    refused(lambda: trial.run(seed=1), "site", "left of claw has none", "geometrically")


# ---------------------------------------------------------------- touching with any shape


@pytest.mark.parametrize("shape", [BALL, BOX, '<cylinder radius="0.01" length="0.03"/>'])
def test_links_of_any_shape_touch_a_cylinder_where_geometry_says(tmp_path, shape):
    path = claw(tmp_path, shape)
    scene = Scene(path, Cylinder(0.03), (0.0, 0.0, 0.1))
    grasp = GeometricProbe(scene).touch(np.zeros(2))
    assert isinstance(grasp, Grasp)
    for contact, side in zip(grasp.contacts, (-1.0, 1.0), strict=True):
        np.testing.assert_allclose(contact.normal, [side, 0, 0], atol=1e-5)
        assert abs(contact.position[0] - side * 0.03) < 1e-6
        assert abs(contact.position[1]) < 1e-6


@pytest.mark.parametrize(
    ("shape", "exact"),
    [('type="sphere" size="0.01"', False), ('type="box" size="0.01 0.01 0.01"', True)],
)
def test_normals_of_tips_that_are_no_balls_are_computed_to_the_last_digits(tmp_path, shape, exact):
    """Whether or not a site marks their middle; a ball's centre gives its normal."""
    xml = change(XML, 'type="sphere" size="0.01"', shape)
    robot = written(tmp_path, xml, tiny_hand.TOML)
    assert (robot.model.opt.ccd_tolerance == CCD_TOLERANCE) == exact


def test_a_flat_touches_in_its_middle_whichever_way_it_tilts(tmp_path):
    """The nearest point itself jumps by 40 mm, from one end of the flat to the other."""
    places = []
    for tilt in (-1e-4, 1e-4):
        path = claw(tmp_path, '<box size="0.02 0.02 0.04"/>')
        base = (-0.05, 0.0, 0.0, np.cos(tilt / 2), 0.0, np.sin(tilt / 2), 0.0)
        scene = Scene(path, Cylinder(0.03, 0.4), (0.0, 0.0, 0.1), base)
        probe = GeometricProbe(scene, links="pass")
        scene.articulated.place(probe._data, np.zeros(2))
        near = probe._nearest(0)
        places.append((near.link[2], probe._patch(0, near).position[2]))
    (low, middle), (high, other) = places
    assert abs(low - high) > 0.03
    assert abs(middle - 0.1) < 1e-3 and abs(other - 0.1) < 1e-3


# ---------------------------------------------------------------- robots that are refused


def refused(call, *words):
    with pytest.raises((ModelError, InputError)) as told:
        call()
    for word in words:
        assert word in str(told.value), told.value


def test_couplings_that_leave_a_joint_one_angle_are_refused(tmp_path):
    """As on the Robotiq 3F: j2 = −j1, both at least 0."""
    xml = change(change(XML, "0 0.5 0 0 0", "0 -1 0 0 0"), 'range="-0.1 0.8"', 'range="0 3"')
    refused(
        lambda: written(tmp_path, xml),
        "leave joint 'proximal'", "only the angle", "distal = -1·proximal", "drop_couplings",
    )  # fmt: skip


def test_couplings_that_leave_a_joint_no_angle_are_refused(tmp_path):
    """As on the Jaco."""
    xml = change(XML, "0 0.5 0 0 0", "-1 -1 0 0 0")
    refused(lambda: written(tmp_path, xml), "leave joint 'proximal'", "no angle at all")


def test_a_joint_that_closes_two_contact_points_is_refused(tmp_path):
    """As on Talos, whose one joint drives all tips."""
    toml = """
        [[contact_points]]
        link = "distal"
        flexion = ["proximal"]
        [[contact_points]]
        link = "palm"
        ball = { radius = 0.01 }
        flexion = ["lift"]
    """
    refused(
        lambda: written(tmp_path, toml='model = "tiny.xml"\n' + toml),
        "joint 'lift'", "closes 'palm' and moves 'distal' too",
    )  # fmt: skip


def test_a_free_joint_is_refused_with_the_line_that_fixes_it(tmp_path):
    xml = change(
        XML,
        '<joint name="lift" type="slide" axis="0 0 1" range="-0.5 0.5"/>',
        '<freejoint name="root"/>',
    )
    xml = xml[: xml.index("  <keyframe>")] + "</mujoco>"
    refused(lambda: written(tmp_path, xml), "neither hinge nor slide", 'lock = ["root"]')
    assert written(tmp_path, xml, 'lock = ["root"]\n' + SHORT).joints == ("proximal",)


def test_a_mesh_that_cannot_be_loaded_is_named_with_its_link(tmp_path):
    (tmp_path / "tip.dae").write_text("")
    path = claw(tmp_path, '<mesh filename="tip.dae"/>')
    refused(lambda: robot_of(path), "link 'left'", "tip.dae", "MuJoCo cannot load", ".stl")
    path = claw(tmp_path, '<mesh filename="package://claw/tip.stl"/>')
    refused(lambda: robot_of(path), "package://claw/tip.stl", "package_root")


def test_radians_read_as_degrees_are_refused(tmp_path):
    xml = change(XML, '<compiler angle="radian" autolimits="true"/>', "")
    refused(lambda: written(tmp_path, xml), "hundredths of a radian", "degrees = false")
    toml = SHORT.replace('"tiny.xml"', '{ file = "tiny.xml", degrees = false }')
    np.testing.assert_allclose(written(tmp_path, xml, toml).q_upper[1], 1.6)


def test_a_link_without_shape_is_refused_with_what_would_do(tmp_path):
    toml = SHORT.replace('"distal"', '"palm"')
    xml = change(XML, '<site name="palm"/>', '<site name="palm"/><body name="bare"/>')
    refused(
        lambda: written(tmp_path, xml, toml.replace('"palm"', '"bare"')),
        "link 'bare'", "no geom that collides", "ball = ",
    )  # fmt: skip
    refused(lambda: written(tmp_path, toml=SHORT.replace("distal", "dista")), "mean 'distal'?")


UNUSABLE = {  # limits of a URDF: what the message says of them
    'lower="0.2" upper="-0.2"': ("[0.2, -0.2]", "= [-0.2, 0.2] }"),
    'lower="0.2"': ("[0.2, 0]", "= [0, 0.2] }"),
    'upper="-0.2"': ("[0, -0.2]", "= [-0.2, 0] }"),
    'lower="0.1" upper="0.1"': ("[0.1, 0.1]", "= [LOW, HIGH] }"),
    'lower="0" upper="0"': ("[0, 0]", "= [LOW, HIGH] }"),
    'lower="0" upper="nan"': ("[0, nan]", "= [LOW, HIGH] }"),
}


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
@pytest.mark.parametrize("limit", UNUSABLE)
def test_a_range_without_angles_is_refused_with_what_to_write(tmp_path, kind, limit):
    def made(toml=""):
        return claw(tmp_path, limit=limit, kind=kind, toml=toml)

    refused(
        lambda: robot_of(made()), "joint 'left_joint' of claw.urdf", *UNUSABLE[limit],
        'lock = ["left_joint"]',
    )  # fmt: skip
    rest = "ranges = { right_joint = [0, 1], left_joint = [0, 0.5] }"
    np.testing.assert_array_equal(robot_of(made(rest)).q_upper, [0.5, 1.0])


def test_a_joint_that_is_locked_or_turns_without_end_needs_no_range(tmp_path):
    limit = 'lower="0.2" upper="-0.2"'
    robot = robot_of(claw(tmp_path, limit=limit, kind="continuous"))
    np.testing.assert_array_equal(robot.q_upper, [np.inf, np.inf])
    path = claw(tmp_path, limit=limit)
    text = path.read_text().replace('[[contact_points]]\nlink = "right"\n', "")
    path.write_text('ranges = { left_joint = [0, 1] }\nlock = ["right_joint"]\n' + text)
    assert robot_of(path).joints == ("left_joint",)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("", "", "[3, 0]"),
        ('range="3 0"', 'range="300 0"', "[300, 0]"),
        ('<compiler angle="radian"', '<compiler angle="degree"', "[0.0523599, 0]"),
        ('range="3 0"', 'range="3 0" limited="true"', "[3, 0]"),
        ('range="3 0"', 'range="3 3"', "[3, 3]"),
    ],
)
def test_a_range_without_angles_is_refused_in_an_mjcf(tmp_path, old, new, told):
    xml = change(XML, 'range="0 3"', 'range="3 0"').replace(old, new)
    degrees = '"tiny.xml", degrees = true }' if "degree" in new else '"tiny.xml" }'
    toml = SHORT.replace('"tiny.xml"', "{ file = " + degrees)
    refused(lambda: written(tmp_path, xml, toml), "joint 'proximal' of tiny.xml", told)


def test_a_range_of_the_default_class_counts_and_one_switched_off_does_not(tmp_path):
    default = '<default><joint range="3 0"/></default><worldbody>'
    xml = change(XML, 'axis="0 0 1" range="0 3"', 'axis="0 0 1"').replace("<worldbody>", default)
    refused(lambda: written(tmp_path, xml), "joint 'proximal'", "[3, 0]")
    off = change(XML, 'range="0 3"', 'range="3 0" limited="false"')
    toml = "drop_couplings = true\n" + SHORT
    assert written(tmp_path, off, toml).q_upper[1] == np.inf


def test_a_range_of_a_joined_file_is_refused_by_its_full_name(tmp_path):
    (tmp_path / "second.xml").write_text(change(XML, 'range="0 3"', 'range="3 0"'))
    toml = (
        '[[model]]\nfile = "tiny.xml"\n[[model]]\nfile = "second.xml"\nprefix = "b_"\n'
        '[[contact_points]]\nlink = "b_distal"\n'
    )
    refused(lambda: written(tmp_path, toml=toml), "'b_proximal' of second.xml", '"b_proximal" =')
    ranges = 'ranges = { "b_proximal" = [0, 1] }\n'
    assert written(tmp_path, toml=ranges + toml).q_upper[-1] == 1.0


def test_ranges_of_one_angle_are_refused_with_the_line_that_holds_a_joint(tmp_path):
    toml = "ranges = { proximal = [0.1, 0.1] }\n" + SHORT
    refused(lambda: written(tmp_path, toml=toml), "low < high", 'lock = ["proximal"]')


def test_a_home_outside_its_range_is_refused(tmp_path):
    toml = "home = { proximal = 3.5 }\n" + SHORT
    refused(lambda: written(tmp_path, toml=toml), "home", "'proximal' at 3.5", "outside its range")


def test_names_that_the_model_lacks_come_with_the_nearest(tmp_path):
    for line in ('lock = ["lft"]', "ranges = { lft = [0, 1] }", "home = { lft = 0.0 }"):
        refused(
            lambda line=line: written(tmp_path, toml=f"{line}\n{SHORT}"), "did you mean 'lift'?"
        )


def test_a_file_that_is_joined_needs_a_prefix_and_a_body_that_is_there(tmp_path):
    parts = '[[model]]\nfile = "tiny.xml"\n[[model]]\nfile = "tiny.xml"\n'
    points = '[[contact_points]]\nlink = "distal"\n'
    refused(lambda: written(tmp_path, toml=parts + points), 'prefix = "hand_"')
    at = 'prefix = "b_"\nat = "distl"\n'
    refused(lambda: written(tmp_path, toml=parts + at + points), "did you mean 'distal'?")


BARE = change(XML, '<site name="palm"/>', '<site name="palm"/><body name="bare"/>')
NEGATIVE = change(change(XML, "0 0.5 0 0 0", "0 -1 0 0 0"), 'range="-0.1 0.8"', 'range="0 3"')
TABLE = change(NO_KEYS, "</worldbody>", '<body name="table"/></worldbody>')
JOINED = '[[model]]\nfile = "tiny.xml"\n[[model]]\nfile = "tiny.xml"\n[[contact_points]]\n'
TWO = (
    SHORT + 'flexion = ["proximal"]\n[[contact_points]]\nlink = "palm"\nball = { radius = 0.01 }\n'
)
CONNECT = '<connect name="loop" body1="distal" body2="palm" anchor="0 0 0"/>'


def latin_1(folder):
    tiny_hand.write(folder)
    text = 'description = "Händchen"\n' + SHORT
    (folder / "robot.toml").write_bytes(text.encode("latin-1"))
    return robot_of(folder)


REFUSALS = (
    lambda folder: written(folder, NEGATIVE),
    lambda folder: written(folder, change(XML, "0 0.5 0 0 0", "-1 -1 0 0 0")),
    lambda folder: written(folder, toml=TWO + 'flexion = ["lift"]\n'),
    lambda folder: written(folder, toml=TWO),
    lambda folder: two_arms(folder, toml=ARMS.replace('["close_a"]', '"arms"')),
    lambda folder: two_arms(folder, toml=BY_ARM.replace('palm = { body = "palm_a" }\n', "")),
    lambda folder: two_arms(folder, toml=BY_ARM),
    lambda folder: written(folder, FREE),
    lambda folder: written(folder, change(XML, "<equality>", f"<equality>{CONNECT}")),
    lambda folder: written(folder, change(XML, "<equality>", f"<equality>{WELD}")),
    lambda folder: written(folder, change(NO_KEYS, LIFT, '<joint name="wrist" type="ball"/>')),
    lambda folder: written(folder, FREE, "carriage = true\n" + BASED + SHORT),
    lambda folder: written(folder, TABLE, "carriage = true\n" + BASED + SHORT),
    lambda folder: written(folder, change(XML, 'qpos="0 0.2 0.1"', 'qpos="0 0.2"')),
    lambda folder: written(folder, NO_KEYS, 'lock = ["lift"]\nhome = { lift = 0.9 }\n' + SHORT),
    lambda folder: written(folder, change(NO_KEYS, 'pos="0.06 0 0"', 'pos="nan 0 0"')),
    lambda folder: latin_1(folder),
    lambda folder: written(folder, toml="clearance = nan\n" + SHORT),
    lambda folder: robot_of(claw(folder, '<mesh filename="tip.dae"/>')),
    lambda folder: robot_of(claw(folder, '<mesh filename="package://claw/tip.stl"/>')),
    lambda folder: robot_of(claw(folder, '<mesh filename="tip.obj"/>')),
    lambda folder: written(folder, change(XML, ' angle="radian"', "")),
    lambda folder: written(folder, toml=SHORT.replace("contact_points", "contact_point")),
    lambda folder: written(folder, toml='lock = ["lft"]\n' + SHORT),
    lambda folder: written(folder, toml=SHORT.replace("distal", "dista")),
    lambda folder: written(folder, BARE, SHORT.replace("distal", "bare")),
    lambda folder: robot_of(claw(folder, limit='lower="0.2" upper="-0.2"')),
    lambda folder: written(folder, toml="home = { proximal = 3.5 }\n" + SHORT),
    lambda folder: written(folder, toml=JOINED + 'link = "distal"\n'),
    lambda folder: written(folder, toml=SHORT.replace("tiny.xml", "no_such_package:hand.xml")),
)


def test_the_docs_quote_every_refusal_in_its_own_words(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo keeps a log of the NaNs it warns of
    page = (Path(__file__).parents[2] / "docs" / "any-robot.md").read_text(encoding="utf-8")
    table = page.partition("## When it is refused")[2].partition("## ")[0]
    quoted = re.findall(r"^\| `(.+?)` \|", table, re.MULTILINE)
    (tmp_path / "tip.dae").write_text("")
    (tmp_path / "tip.obj").write_text("v 0 0 0\nv 0 0 1\nv 0 1 0\nv 1 0 0\n")
    told = []
    for refusal in REFUSALS:
        with pytest.raises((ModelError, InputError)) as error:
            refusal(tmp_path)
        told.append(str(error.value))
    assert len(quoted) == len(told)
    for words, message in zip(quoted, told, strict=True):
        assert re.search(".*".join(map(re.escape, words.split("…"))), message), (words, message)


# ---------------------------------------------------------------- the check


def test_the_check_says_how_a_robot_was_understood(tmp_path):
    text = check(claw(tmp_path), picture=tmp_path / "claw.png")
    for part in (
        "2 independent joints",
        "claw.urdf: MuJoCo and Pinocchio agree",
        "left on left: ball of 10 mm",
        "closes with left_joint +1 (found by itself",
        "moves towards the others",
        "none given; found from how the fingers close",
        'palm = { body = "base"',
        "workspace = [",
    ):
        assert part in text, text
    assert (tmp_path / "claw.png").stat().st_size > 10_000


def test_the_lines_that_the_check_proposes_can_be_added(tmp_path):
    path = claw(tmp_path)
    before = robot_of(path)
    lines = [v for v in check(path).splitlines() if v.startswith(("palm = ", "workspace = "))]
    assert len(lines) == 2
    after = robot_of(claw(tmp_path, toml="\n".join(lines)))
    for one, other in zip(before.palm(before.home), after.palm(after.home), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-3)


def test_pairs_that_touch_at_home_are_let_be_and_others_are_watched(tmp_path):
    links = SelfClearance(robot_of(claw(tmp_path, toml="[home]\nleft_joint = 0.0")), 0.005)
    assert len(links.pairs) == 1 and links.at_home == ()
    near = links.near(np.array([0.5, 0.5]), 0.2)
    np.testing.assert_allclose(
        near.distance,
        np.ptp([-0.06 + 0.1 * np.sin(0.5), 0.06 - 0.1 * np.sin(0.5)]) - 0.02,
        atol=1e-9,
    )
    step = 1e-6
    for j in range(2):
        q = np.array([0.5, 0.5])
        q[j] += step
        slope = (links.near(q, 0.2).distance - near.distance) / step
        np.testing.assert_allclose(near.jacobian[0, j], slope[0], atol=1e-5)
    assert links.collisions(np.array([0.6, 0.6])) == (("left:0", "right:0"),)
    closed = "[home]\nleft_joint = 0.6\nright_joint = 0.6"
    links = SelfClearance(robot_of(claw(tmp_path, toml=closed)), 0.005)
    assert links.at_home == (("left:0", "right:0"),)


# ---------------------------------------------------------------- of joined files, and frames


def as_degrees(xml):
    """The same model, its angles in degrees."""
    xml = change(xml, 'angle="radian"', 'angle="degree"')
    low, high = np.degrees([-0.1, 0.8])
    xml = change(xml, 'range="-0.1 0.8"', f'range="{low:.15g} {high:.15g}"')
    return change(xml, 'range="0 3"', f'range="0 {np.degrees(3):.15g}"')


@pytest.mark.parametrize("first", ["radian", "degree"])
@pytest.mark.parametrize("second", ["radian", "degree"])
def test_each_joined_file_keeps_its_own_unit_of_angles(tmp_path, first, second):
    """Ranges of the files and of the description, locks and couplings are all radians."""
    for name, unit in (("first", first), ("second", second)):
        xml = XML[: XML.index("  <equality>")] + "</mujoco>"
        (tmp_path / f"{name}.xml").write_text(as_degrees(xml) if unit == "degree" else xml)
    toml = """
        couplings = [{ joint = "b_distal", to = "b_proximal", ratio = 0.5, offset = 0.1 }]
        lock = ["distal"]
        home = { distal = 0.3 }
        {ranges}
        [[model]]
        file = "first.xml"
        [[model]]
        file = "second.xml"
        prefix = "b_"
        at = "palm"
        [[contact_points]]
        link = "b_distal"
        flexion = ["b_proximal"]
    """
    robots = []
    for ranges in ("", "ranges = { b_lift = [-0.1, 0.2], b_distal = [-0.05, 0.9] }"):
        (tmp_path / "two.toml").write_text(toml.replace("{ranges}", ranges))
        robots.append(robot_of(tmp_path / "two.toml"))
    plain, changed = robots
    assert plain.joints == ("lift", "proximal", "b_lift", "b_proximal")
    np.testing.assert_allclose(plain.lower, [-0.5, 0, -0.1, -0.5, 0, -0.1], atol=1e-9)
    np.testing.assert_allclose(plain.upper, [0.5, 3, 0.8, 0.5, 3, 0.8], atol=1e-9)
    np.testing.assert_allclose(changed.lower, [-0.5, 0, -0.1, -0.1, 0, -0.05], atol=1e-9)
    np.testing.assert_allclose(changed.upper, [0.5, 3, 0.8, 0.2, 3, 0.9], atol=1e-9)
    np.testing.assert_allclose(plain.offset, [0, 0, 0.3, 0, 0, 0.1], atol=1e-9)
    np.testing.assert_allclose(plain.q_upper, [0.5, 3, 0.5, 1.4], atol=1e-9)


@pytest.mark.parametrize("unit", ["radian", "degree"])
def test_a_lock_without_home_holds_a_joined_files_joint_where_the_file_puts_it(tmp_path, unit):
    ref = np.degrees(0.5) if unit == "degree" else 0.5
    xml = change(
        XML[: XML.index("  <equality>")] + "</mujoco>", 'range="0 3"', f'ref="{ref}" range="0 3"'
    )
    tiny_hand.write(tmp_path)
    (tmp_path / "second.xml").write_text(as_degrees(xml) if unit == "degree" else xml)
    toml = """
        lock = ["b_proximal", "b_lift"]
        [[model]]
        file = "tiny.xml"
        [[model]]
        file = "second.xml"
        prefix = "b_"
        [[contact_points]]
        link = "b_distal"
    """
    (tmp_path / "two.toml").write_text(toml)
    robot = robot_of(tmp_path / "two.toml")
    assert robot.joints == ("lift", "proximal", "b_distal")
    np.testing.assert_allclose(robot.offset[3:5], [0.0, 0.5], atol=1e-9)


def test_a_joined_file_stands_in_its_bodys_frame_turned_as_said(tmp_path):
    tiny_hand.write(tmp_path)
    for turn in ("quat = [2, 0, 2, 0]", "rpy = [0.0, 1.5707963267948966, 0.0]"):
        toml = f"""
            [[model]]
            file = "tiny.xml"
            [[model]]
            file = "tiny.xml"
            prefix = "b_"
            at = "distal"
            pos = [0.1, 0.2, 0.3]
            {turn}
            [[contact_points]]
            link = "b_distal"
            flexion = ["b_proximal"]
        """
        (tmp_path / "two.toml").write_text(toml)
        robot = robot_of(tmp_path / "two.toml")
        q = np.array([0.1, 0.4, 0.05, 0.0])
        # Its x points down then, its z along the x of the first's last link.
        bend = 1.5 * 0.4
        ahead, aside = (
            np.array([np.cos(bend), np.sin(bend), 0]),
            np.array([-np.sin(bend), np.cos(bend), 0]),
        )
        at = 0.06 * np.array([np.cos(0.4), np.sin(0.4), 0]) + 0.1 * ahead + 0.2 * aside
        tip = at + 0.05 * ahead + np.array([0, 0, 0.1 + 0.3 - 0.1])
        np.testing.assert_allclose(robot.centers(q), [tip], atol=1e-9)


def test_angles_given_as_rpy_turn_about_fixed_axes_x_first(tmp_path):
    tiny_hand.write(tmp_path)
    toml = """
        [[model]]
        file = "tiny.xml"
        [[model]]
        file = "tiny.xml"
        prefix = "b_"
        rpy = [0.3, -0.5, 0.9]
        [[contact_points]]
        link = "b_distal"
        flexion = ["b_proximal"]
    """
    (tmp_path / "two.toml").write_text(toml)
    robot = robot_of(tmp_path / "two.toml")
    R = pin.rpy.rpyToMatrix(0.3, -0.5, 0.9)
    np.testing.assert_allclose(robot.centers(np.zeros(4)), [R @ [0.1, 0, 0]], atol=1e-9)


def test_of_a_file_with_several_roots_the_keyframe_is_read_by_joint(tmp_path):
    """Also where what is left out has a ball joint and comes first."""
    other = (
        '<worldbody><geom size="1"/><body name="ball" pos="1 0 0"><joint name="round" type="ball"/>'
        '<geom size="0.1"/></body>'
    )
    xml = change(change(XML, "<worldbody>", other), 'qpos="0', 'qpos="1 0 0 0 0.4')
    tiny_hand.write(tmp_path, xml)
    toml = '[[model]]\nfile = "tiny.xml"\nroot = "palm"\n[[contact_points]]\nlink = "distal"\n'
    (tmp_path / "robot.toml").write_text(toml)
    about = RobotDescription.load(tmp_path)
    assert about.home == {"lift": 0.4, "proximal": 0.2, "distal": 0.1}
    robot = robot_of(tmp_path)
    np.testing.assert_array_equal(robot.home, [0.4, 0.2])
    assert robot.model.nbody == 4 and robot.model.ngeom == 1


def test_equalities_are_told_by_name_or_joint_with_whether_they_stay(tmp_path):
    more = '<equality>\n<joint joint1="lift" joint2="proximal" polycoef="0 0.1 0 0 0"/>'
    tiny_hand.write(tmp_path, change(XML, "<equality>", more), SHORT)
    assert RobotDescription.load(tmp_path).equalities == {"follow": True, "lift": True}
    tiny_hand.write(
        tmp_path, change(XML, "<equality>", more), 'drop_couplings = ["lift"]\n' + SHORT
    )
    assert RobotDescription.load(tmp_path).equalities == {"follow": True, "lift": False}
    tiny_hand.write(tmp_path, change(XML, "<equality>", more), "drop_couplings = true\n" + SHORT)
    assert RobotDescription.load(tmp_path).equalities == {"follow": False, "lift": False}


def test_a_carriage_carries_no_geoms_of_the_world(tmp_path):
    tiny_hand.write(tmp_path, change(XML, "<worldbody>", '<worldbody><geom size="1"/>'))
    palm = 'carriage = true\npalm = { body = "palm" }\nlock = ["lift"]\nworkspace = [0, 0, 0]\n'
    (tmp_path / "robot.toml").write_text(palm + SHORT)
    with pytest.raises(ModelError, match="'palm' and geoms of the world"):
        robot_of(tmp_path)


def test_starts_are_degrees_but_for_lengths_and_shares(tmp_path):
    angles = "adduction = [10, 20], elevation = [-5, 5]"
    start = f"start = {{ {angles}, offset = [-0.01, 0.02], joints = 0.1 }}"
    about = RobotDescription.load(tiny_hand.write(tmp_path, toml=f"{start}\n{SHORT}"))
    assert about.start["adduction"] == pytest.approx(np.radians([10, 20]))
    assert about.start["elevation"] == pytest.approx(np.radians([-5, 5]))
    assert about.start["offset"] == (-0.01, 0.02) and about.start["joints"] == 0.1


def test_speed_is_that_of_a_quarter_meter_or_a_radian_a_second_unless_said(tmp_path):
    for line, speeds in (("", [0.25, 1.0]), ("speed = 0.7", [0.7, 0.7])):
        np.testing.assert_array_equal(written(tmp_path, toml=f"{line}\n{SHORT}").velocity, speeds)
    assert RobotDescription.load(tmp_path).clearance == 0.005


# ---------------------------------------------------------------- palms that are found


def three(folder, turn=(0.0, 0.0, 0.0), at=(0.0, 0.0, 0.0), depth=0.1, more=""):
    """Three fingers around a turned base, or two against one, that point along its z axis."""
    fingers = ""
    for i, angle in enumerate((0.0, 2.3, 4.1)):
        x, y = 0.06 * np.cos(angle), 0.06 * np.sin(angle)
        fingers += (
            f'<body name="f{i}" pos="{x} {y} 0"><joint name="j{i}" axis="{-np.sin(angle)} '
            f'{np.cos(angle)} 0" range="-1.2 0.1"/><geom type="sphere" size="0.01" '
            f'pos="0 0 {depth}" mass="0.1"/></body>'
        )
    place = "{} {} {}".format(*at)
    euler = "{} {} {}".format(*turn)
    (folder / "three.xml").write_text(
        '<mujoco><compiler angle="radian" eulerseq="XYZ"/><worldbody><body name="base" '
        f'pos="{place}" euler="{euler}">{fingers}</body></worldbody></mujoco>'
    )
    points = "".join(f'[[contact_points]]\nlink = "f{i}"\n' for i in range(3))
    (folder / "three.toml").write_text(f'model = "three.xml"\n{more}\n{points}')
    return robot_of(folder / "three.toml")


def test_a_found_palm_goes_with_its_hand_wherever_that_stands(tmp_path):
    plain = three(tmp_path)
    p, R = plain.palm(plain.home)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    towards = plain.centers(plain.home + 0.5 * plain.closing.sum(axis=0)).mean(axis=0)
    np.testing.assert_allclose(R[:, 2], towards / np.linalg.norm(towards), atol=0.1)
    turn, at = (0.4, -0.8, 1.1), (0.3, 0.2, -0.5)
    moved = three(tmp_path, turn, at)
    T = pin.rpy.rpyToMatrix(*turn)
    np.testing.assert_array_equal(moved.closing, plain.closing)
    p_moved, R_moved = moved.palm(moved.home)
    np.testing.assert_allclose(p_moved, T @ p + at, atol=1e-9)
    sign = np.sign(R_moved[:, 0] @ T @ R[:, 0])  # an axis, which either way opposes
    np.testing.assert_allclose(R_moved, T @ R * [sign, sign, 1.0], atol=1e-9)


def test_opposition_is_along_which_fingers_come_together_most(tmp_path):
    robot = three(tmp_path)
    half = robot.home + 0.5 * robot.closing.sum(axis=0)
    v = np.array([robot.jacobian(half)[3 * i : 3 * i + 3] @ robot.closing[i] for i in range(3)])
    R = robot.palm(robot.home)[1]
    across = v - np.outer(v @ R[:, 2], R[:, 2])
    angles = np.linspace(0.0, np.pi, 181)
    spread = [((across @ (np.cos(a) * R[:, 0] + np.sin(a) * R[:, 1])) ** 2).sum() for a in angles]
    assert spread[0] == pytest.approx(max(spread))


def test_jaws_amid_their_palm_approach_across_the_plane_they_close_in(tmp_path):
    """Three slides towards the middle of their base: nothing else says where they point."""
    fingers = ""
    for i, angle in enumerate(2.0 * np.pi * np.arange(3) / 3.0):
        x, y = np.cos(angle), np.sin(angle)
        fingers += (
            f'<body name="f{i}" pos="{0.05 * x} {0.05 * y} 0"><joint name="j{i}" type="slide" '
            f'axis="{-x} {-y} 0" range="0 0.1"/><geom type="sphere" size="0.01"/></body>'
        )
    (tmp_path / "jaws.xml").write_text(
        '<mujoco><compiler angle="radian"/><worldbody><body name="base" pos="0 0 0.2" '
        f'euler="0.5 0 0">{fingers}</body></worldbody></mujoco>'
    )
    points = "".join(f'[[contact_points]]\nlink = "f{i}"\n' for i in range(3))
    (tmp_path / "jaws.toml").write_text(f'model = "jaws.xml"\n{points}')
    robot = robot_of(tmp_path / "jaws.toml")
    p, R = robot.palm(robot.home)
    np.testing.assert_allclose(p, [0, 0, 0.2], atol=1e-12)
    normal = np.array([0, -np.sin(0.5), np.cos(0.5)])
    assert abs(R[:, 2] @ normal) == pytest.approx(1.0)


def test_a_locked_joint_stands_within_a_range_of_degrees(tmp_path):
    xml = as_degrees(XML[: XML.index("  <equality>")] + "</mujoco>")
    xml = change(xml, 'range="0 1', 'range="20 1')
    robot = written(tmp_path, xml, 'lock = ["proximal"]\n' + SHORT)
    np.testing.assert_allclose(robot.offset, [0.0, np.radians(20.0), 0.0], atol=1e-9)
