"""What is said of a robot: in figures and units that can be checked against its description."""

import numpy as np
import pytest
import tiny_hand

from hqp_grasp.experiments.robot_check import _row, _shape, _spread, check
from hqp_grasp.world.description import RobotDescription
from hqp_grasp.world.robot import Robot, compiled

BHAND = """\
bhand_f1_spread         0.00 … 3.14     0.50    6.28  bhand_f2_spread = 1·
bhand_f1_proximal       0.00 … 2.36     0.78    2.44  bhand_f1_distal = 0.333·
"""
POINTS = """\
contact points
  finger_1 on f1_tip: ball of 8 mm (touches at a point)
    closes with bhand_f1_proximal +1
    at home it moves towards the others at +103 mm/rad
"""


@pytest.fixture(scope="module")
def bhand():
    about = RobotDescription.load("bhand")
    return Robot(about, compiled(about))


def test_a_hand_is_described_joint_by_joint_and_point_by_point(bhand):
    said = check("bhand")
    assert said.startswith("bhand: 4 independent joints, 8 in all; hands: hand (hand grasps)\n")
    assert "bhand.xml: MuJoCo and Pinocchio agree: " in said
    assert BHAND in said and POINTS in said
    assert "arm      none: the hand is placed where a start says" in said
    assert (
        'palm = { body = "bhand_palm", pos = [0.000, 0.000, 0.076], '
        "approach = [0.000, 0.000, 1.000], opposition = [0.000, -1.000, 0.000] }"
    ) in said
    assert "workspace = [0.720, 0.000, 0.200]" in said and "AWAY" not in said
    assert "clearance  0 mm, watched over 68 pairs of geoms" in said
    tips = [
        np.linalg.norm(x - x.mean(axis=0), axis=1).mean()
        for x in (bhand.centers(bhand.opened(bhand.home, s)) for s in np.linspace(0.0, 1.0, 21))
    ]
    widest, narrowest = 1e3 * tips[0], 1e3 * min(tips)
    assert f"tips are {widest:.0f} … {narrowest:.0f} mm from their middle" in said


def test_what_a_coupled_joint_follows_and_what_home_has_otherwise_is_said(tmp_path):
    xml = tiny_hand.change(tiny_hand.XML, "0 0.5 0 0 0", "0.05 0.5 0 0 0")
    said = check(tiny_hand.write(tmp_path, xml))
    assert "distal = 0.5· + 0.05" in said
    assert "home has distal at 0.1; it is coupled, and follows to 0.15" in said
    assert "arm      lift" in said and "from their middle" not in said  # one tip has none
    plain = check(tiny_hand.write(tmp_path))
    assert "distal = 0.5·\n" in plain and "home has" not in plain


def test_a_finger_that_opens_from_the_others_at_home_is_shouted(tmp_path):
    said = check("bhand")
    assert said.count("towards the others at +") == 3
    folder = tmp_path / "away"
    folder.mkdir()
    about = RobotDescription.load("bhand")
    text = (about.xml.parent / "robot.toml").read_text()
    old = next(
        line for line in text.splitlines() if "bhand_f3_proximal" in line and "flexion" in line
    )
    assert text.count(old) == 1
    new = "flexion = { bhand_f3_proximal = -1.0 }"
    (folder / "robot.toml").write_text(text.replace(old, new))
    for file in about.xml.parent.iterdir():
        if file.suffix == ".xml":
            (folder / file.name).write_bytes(file.read_bytes())
    assert "moves AWAY FROM the others at -112 mm/rad" in check(folder)


def test_a_palm_that_its_arm_closes_is_told_as_such_and_shouted_where_it_turns_away(tmp_path):
    about = RobotDescription.load("umass_torso", "palms")
    robot = Robot(about, compiled(about))
    x, way = robot.centers(robot.home), robot.palm(robot.home, 0)[1][:, 2]
    ahead = 1e3 * way @ (x[1] - x[0]) / np.linalg.norm(x[1] - x[0])
    assert ahead > 100.0
    said = check("umass_torso", "palms")
    assert (
        "    closes with the arm of right_palm, straight along its palm's approach axis\n"
        f"    at home it moves towards the others at +{ahead:.0f} mm/m\n"
    ) in said
    assert "AWAY" not in said and "as they close" not in said
    here = about.xml.parent
    text = (here / "robot.toml").read_text().replace('file = "', f'file = "{here.as_posix()}/')
    pad = 'name = "right_palm"\npalm = "right_palm"'
    assert text.count(pad) == 1
    back = 'name = "right_palm"\npalm = { body = "right_bhand_palm", approach = [0, 0, -1] }'
    (tmp_path / "robot.toml").write_text(text.replace(pad, back))
    assert f"AWAY FROM the others at -{ahead:.0f} mm/m" in check(tmp_path, "palms")


@pytest.mark.parametrize(
    ("geom", "says"),
    [
        ('type="sphere" size="0.01"', "ball of 10 mm (touches at a point)"),
        (
            'type="capsule" size="0.01 0.02"',
            "capsule of 10 mm (touches as a ball at its ends; laid along the object it counts by "
            "the middle of its touch, which runs along it by up to 3.5 mm for each degree",
        ),
        (
            'type="box" size="0.01 0.02 0.005"',
            "box (its touching patch counts by its middle, which runs along it by up to 3.5 mm for",
        ),
    ],
)
def test_a_tip_is_told_by_its_shape_and_what_a_degree_does_to_its_touch(tmp_path, geom, says):
    xml = tiny_hand.change(tiny_hand.XML, 'type="sphere" size="0.01"', geom)
    about = RobotDescription.load(tiny_hand.write(tmp_path, xml))
    model = compiled(about)
    assert _shape(model, model.geom("tip").id).startswith(says)


def test_rows_and_spreads_are_plain_numbers():
    assert _row(np.array([-0.0, 1.0, -0.12345])) == "[0.000, 1.000, -0.123]"
    x = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 3.0, 0.0]])
    assert _spread(x) == pytest.approx((2 * np.sqrt(2.0) + 2.0) / 3.0)
