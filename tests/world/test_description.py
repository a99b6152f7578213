"""What a description can say, and every robot that is refused, with the words that say why."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
import tiny_hand
from tiny_hand import XML, change

from hqp_grasp.errors import InputError, ModelError
from hqp_grasp.experiments.robot_check import check
from hqp_grasp.grasp import Grasp
from hqp_grasp.touch.geometric import GeometricProbe
from hqp_grasp.world.clearance import SelfClearance
from hqp_grasp.world.description import CCD_TOLERANCE, RobotDescription, locate
from hqp_grasp.world.objects import Cylinder
from hqp_grasp.world.robot import Robot, compiled
from hqp_grasp.world.scene import Scene
from hqp_grasp.world.second_opinion import second_opinion

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
    <limit lower="0" upper="1.5" effort="1" velocity="1"/></joint>"""
BALL, BOX = '<sphere radius="0.01"/>', '<box size="0.02 0.03 0.04"/>'


def claw(folder, shape=BALL, toml=""):
    """Two fingers that close towards one another, from a URDF."""
    fingers = [
        FINGER.format(n=n, x=x, s=s, shape=shape)
        for n, x, s in (("left", -0.06, 1), ("right", 0.06, -1))
    ]
    (folder / "claw.urdf").write_text(URDF.format(fingers="".join(fingers)))
    points = '[[contact_points]]\nlink = "left"\n[[contact_points]]\nlink = "right"\n'
    (folder / "claw.toml").write_text(f'model = "claw.urdf"\n{toml}\n{points}')
    return folder / "claw.toml"


def robot_of(path, **given):
    about = RobotDescription.load(path, **given)
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
        assert robot.description.adduction == f"{name}_bhand_f1_spread"
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
        places.append((near.link[2], probe._patch(0, near)[0][2]))
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
LIFT = '<joint name="lift" type="slide" axis="0 0 1" range="-0.5 0.5"/>'
FREE = change(XML, LIFT, '<freejoint name="root"/>')
FREE = FREE[: FREE.index("  <keyframe>")] + "</mujoco>"
JOINED = '[[model]]\nfile = "tiny.xml"\n[[model]]\nfile = "tiny.xml"\n[[contact_points]]\n'
TWO = (
    SHORT + 'flexion = ["proximal"]\n[[contact_points]]\nlink = "palm"\nball = { radius = 0.01 }\n'
)
CONNECT = '<connect name="loop" body1="distal" body2="palm" anchor="0 0 0"/>'
REFUSALS = (
    lambda folder: written(folder, NEGATIVE),
    lambda folder: written(folder, change(XML, "0 0.5 0 0 0", "-1 -1 0 0 0")),
    lambda folder: written(folder, toml=TWO + 'flexion = ["lift"]\n'),
    lambda folder: written(folder, toml=TWO),
    lambda folder: written(folder, FREE),
    lambda folder: written(folder, change(XML, "<equality>", f"<equality>{CONNECT}")),
    lambda folder: robot_of(claw(folder, '<mesh filename="tip.dae"/>')),
    lambda folder: robot_of(claw(folder, '<mesh filename="package://claw/tip.stl"/>')),
    lambda folder: robot_of(claw(folder, '<mesh filename="tip.obj"/>')),
    lambda folder: written(folder, change(XML, ' angle="radian"', "")),
    lambda folder: written(folder, toml=SHORT.replace("contact_points", "contact_point")),
    lambda folder: written(folder, toml='lock = ["lft"]\n' + SHORT),
    lambda folder: written(folder, toml=SHORT.replace("distal", "dista")),
    lambda folder: written(folder, BARE, SHORT.replace("distal", "bare")),
    lambda folder: written(folder, toml="home = { proximal = 3.5 }\n" + SHORT),
    lambda folder: written(folder, toml=JOINED + 'link = "distal"\n'),
    lambda folder: written(folder, toml=SHORT.replace("tiny.xml", "no_such_package:hand.xml")),
)


def test_the_docs_quote_every_refusal_in_its_own_words(tmp_path):
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
