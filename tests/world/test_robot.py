"""A robot read from its folder: couplings, ranges, and the motion of its contact points."""

import re

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import tiny_hand
from tiny_hand import TOML, XML, change

from hqp_grasp.errors import InputError, ModelError
from hqp_grasp.grasp import Contact
from hqp_grasp.world.description import RobotDescription
from hqp_grasp.world.robot import Robot
from hqp_grasp.world.scene import Scene

NAMES = ("bhand", "wam_bhand")
POSTURES = 10  # random ones, per test
EXACT = 1e-12  # plain arithmetic on numbers of order one
AGREEMENT_TOL = 1e-9
FD_STEP = 1e-5  # [rad] central differences: error about 1e-10
FD_TOL = 1e-8

TWO_TENDONS = change(
    change(
        XML,
        '<joint name="follow" joint1="distal" joint2="proximal" polycoef="0 0.5 0 0 0"/>',
        '<tendon name="follow" tendon1="cable" polycoef="0.05 0 0 0 0"/>',
    ),
    "  <equality>",
    """
  <tendon>
    <fixed name="cable">
      <joint joint="proximal" coef="-0.02"/>
      <joint joint="distal" coef="0.04"/>
    </fixed>
  </tendon>
  <equality>""",
)


@pytest.fixture(scope="module", params=NAMES)
def robot(request):
    return Scene(robot=request.param).articulated


@pytest.fixture(scope="module")
def data(robot):
    return mujoco.MjData(robot.model)


def postures(robot, seed, count=POSTURES):
    rng = np.random.default_rng(seed)
    return rng.uniform(robot.q_lower, robot.q_upper, size=(count, robot.n))


def build(folder, xml=XML, toml=TOML):
    description = RobotDescription.load(tiny_hand.write(folder, xml, toml))
    return Robot(description, description.spec().compile())


# ---------------------------------------------------------------- motion of the contact points


def test_the_jacobian_is_the_rate_of_the_centres(robot):
    for q in postures(robot, seed=0):
        J = robot.jacobian(q)
        assert J.shape == (9, robot.n)
        for j, step in enumerate(FD_STEP * np.eye(robot.n)):
            ahead = robot.centers(q + step).ravel()
            behind = robot.centers(q - step).ravel()
            np.testing.assert_allclose(J[:, j], (ahead - behind) / (2 * FD_STEP), atol=FD_TOL)


def test_the_palms_jacobian_is_the_rate_of_its_place_and_of_its_turning(robot):
    for q in postures(robot, seed=6, count=3):
        J = robot.palm_jacobian(q)
        for j, step in enumerate(FD_STEP * np.eye(robot.n)):
            (ahead, R_ahead), (behind, R_behind) = robot.palm(q + step), robot.palm(q - step)
            np.testing.assert_allclose(J[:3, j], (ahead - behind) / (2 * FD_STEP), atol=FD_TOL)
            turn = (R_ahead - R_behind) / (2 * FD_STEP) @ robot.palm(q)[1].T  # [ω]×
            np.testing.assert_allclose(J[3:, j], [turn[2, 1], turn[0, 2], turn[1, 0]], atol=FD_TOL)


def test_the_hessian_is_the_rate_of_the_jacobian_and_symmetric(robot):
    for q in postures(robot, seed=1):
        H = robot.hessian(q)
        assert H.shape == (9, robot.n, robot.n)
        np.testing.assert_allclose(H, H.transpose(0, 2, 1), atol=EXACT)
        for j, step in enumerate(FD_STEP * np.eye(robot.n)):
            ahead = robot.jacobian(q + step)
            behind = robot.jacobian(q - step)
            np.testing.assert_allclose(H[:, :, j], (ahead - behind) / (2 * FD_STEP), atol=FD_TOL)


def test_the_jacobian_is_mujocos_times_the_coupling(robot, data):
    for q in postures(robot, seed=2):
        robot.place(data, q)
        J = robot.jacobian(q)
        mujoco.mj_forward(robot.model, data)
        for i, point in enumerate(robot.description.contact_points):
            full = np.zeros((3, robot.model.nv))
            mujoco.mj_jacSite(robot.model, data, full, None, robot.model.site(point.site).id)
            np.testing.assert_allclose(J[3 * i : 3 * i + 3], full @ robot.coupling, atol=EXACT)


def test_pinocchio_agrees_on_position_jacobian_and_hessian(robot):
    model = pin.buildModelFromMJCF(str(robot.description.xml))
    other = model.createData()
    names = [robot.model.joint(j).name for j in range(robot.model.njnt)]
    at = [model.joints[model.getJointId(name)].idx_v for name in names]
    C = robot.coupling
    for q in postures(robot, seed=3):
        pin_q = pin.neutral(model)
        pin_q[at] = C @ q + robot.offset
        pin.computeJointKinematicHessians(model, other, pin_q)
        pin.updateFramePlacements(model, other)
        x, J, H = robot.centers(q), robot.jacobian(q), robot.hessian(q)
        for i, point in enumerate(robot.description.contact_points):
            frame, rows = model.getFrameId(point.site), slice(3 * i, 3 * i + 3)
            axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
            position = other.oMf[frame].translation
            pin_J = pin.getFrameJacobian(model, other, frame, axes)[:3, at] @ C
            pin_H = pin.getFrameKinematicHessian(model, other, frame, axes)
            # Its memory is column-major, but labelled row-major.
            pin_H = pin_H.ravel().reshape(pin_H.shape, order="F")[:3][:, at][:, :, at]
            np.testing.assert_allclose(x[i], position, atol=AGREEMENT_TOL)
            np.testing.assert_allclose(J[rows], pin_J, atol=AGREEMENT_TOL)
            np.testing.assert_allclose(H[rows], C.T @ pin_H @ C, atol=AGREEMENT_TOL)


def test_slides_several_joints_on_a_body_and_fixed_points_move_as_differences_say(tmp_path):
    xml = change(
        XML,
        '<joint name="lift" type="slide" axis="0 0 1" range="-0.5 0.5"/>',
        """<joint name="lift" type="slide" axis="0.6 0 0.8" range="-0.5 0.5"/>
           <joint name="yaw" axis="0 0.6 0.8" pos="0.1 0 0.02" range="-1 1"/>
           <joint name="roll" axis="1 0 0" pos="0 0.03 0" range="-1 1"/>
           <joint name="push" type="slide" axis="0 1 0" range="-1 1"/>""",
    )
    xml = change(xml, 'qpos="0 0.2 0.1"', 'qpos="0 0 0 0 0.2 0.1"')
    xml = change(
        xml,
        "<worldbody>",
        '<worldbody><geom name="post" type="sphere" size="0.01"/><site name="post"/>',
    )
    toml = change(TOML, "lift = 0.1", "lift = 0.1\nyaw = 1\nroll = 1\npush = 1")
    toml += '[[contact_points]]\nname = "p"\nsite = "post"\ngeom = "post"\nflexion = []\n'
    robot = build(tmp_path, xml, toml)
    for q in postures(robot, seed=4):
        J, H = robot.jacobian(q), robot.hessian(q)
        np.testing.assert_array_equal(J[3:], 0.0)
        np.testing.assert_array_equal(H[3:], 0.0)
        for j, step in enumerate(FD_STEP * np.eye(robot.n)):
            ahead, J_ahead = robot.centers(q + step).ravel(), robot.jacobian(q + step)
            behind, J_behind = robot.centers(q - step).ravel(), robot.jacobian(q - step)
            np.testing.assert_allclose(J[:, j], (ahead - behind) / (2 * FD_STEP), atol=FD_TOL)
            np.testing.assert_allclose(
                H[:, :, j], (J_ahead - J_behind) / (2 * FD_STEP), atol=FD_TOL
            )


def test_the_tiny_finger_is_where_trigonometry_puts_it(tmp_path):
    robot = build(tmp_path)
    for q in postures(robot, seed=5):
        lift, angle = q
        bent = 1.5 * angle
        x = [0.06 * np.cos(angle) + 0.04 * np.cos(bent), 0.06 * np.sin(angle) + 0.04 * np.sin(bent)]
        np.testing.assert_allclose(robot.centers(q), [[*x, lift]], atol=EXACT)
        np.testing.assert_allclose(robot.palm(q)[1][:, 2], [0, 0, 1], atol=EXACT)


# ---------------------------------------------------------------- couplings


def test_the_barrett_couplings_are_a_third_and_a_mirror(robot):
    names = [robot.model.joint(j).name for j in range(robot.model.njnt)]
    drivers = {name: (name, 1.0) for name in robot.joints}
    drivers["bhand_f2_spread"] = ("bhand_f1_spread", 1.0)
    for i in (1, 2, 3):
        drivers[f"bhand_f{i}_distal"] = (f"bhand_f{i}_proximal", 1 / 3)
    C = np.zeros((len(names), robot.n))
    for row, name in enumerate(names):
        driver, ratio = drivers[name]
        C[row, robot.joints.index(driver)] = ratio
    np.testing.assert_allclose(robot.coupling, C, atol=EXACT)
    np.testing.assert_array_equal(robot.offset, np.zeros(len(names)))
    assert robot.n == {"bhand": 4, "wam_bhand": 11}[robot.description.name]


def equality_residual(robot, q):
    """How far MuJoCo itself finds its equality constraints violated at C q + c₀."""
    data = mujoco.MjData(robot.model)
    robot.place(data, q)
    mujoco.mj_forward(robot.model, data)
    assert data.ne == robot.model.neq
    return np.abs(data.efc_pos[: data.ne]).max()


@pytest.mark.parametrize(
    ("xml", "ratio", "offset"),
    [
        pytest.param(XML, 0.5, 0.0, id="joint"),
        pytest.param(change(XML, "0 0.5 0 0 0", "0.07 -0.25 0 0 0"), -0.25, 0.07, id="offset"),
        # MuJoCo measures both joints from their reference positions.
        pytest.param(
            change(
                change(XML, 'range="0 3"', 'range="0 3" ref="0.3"'),
                'range="-0.1 0.8"',
                'range="-0.1 0.8" ref="0.2"',
            ),
            0.5,
            0.2 - 0.5 * 0.3,
            id="reference",
        ),
        pytest.param(change(XML, ' joint2="proximal"', ""), 0.0, 0.0, id="held"),
        # −0.02 q_p + 0.04 q_d = 0.05
        pytest.param(TWO_TENDONS, 0.5, 1.25, id="tendon"),
        pytest.param(
            change(
                change(
                    TWO_TENDONS,
                    'tendon1="cable" polycoef="0.05 0 0 0 0"',
                    'tendon1="cable" tendon2="drive" polycoef="0.05 0.1 0 0 0"',
                ),
                "  </tendon>",
                '<fixed name="drive"><joint joint="proximal" coef="1"/></fixed>\n  </tendon>',
            ),
            3.0,
            1.25,
            id="two tendons",
        ),
        pytest.param(
            change(
                change(TWO_TENDONS, 'range="0 3"', 'range="0 3" ref="0.3"'),
                'range="-0.1 0.8"',
                'range="-0.1 0.8" ref="0.2"',
            ),
            0.5,
            0.2 - 0.5 * 0.3 + 1.25,
            id="tendon reference",
        ),
    ],
)
def test_couplings_come_from_joint_and_tendon_equalities(tmp_path, xml, ratio, offset):
    robot = build(tmp_path, change(xml, 'range="-0.1 0.8"', 'range="-9 9"'))
    assert robot.joints == ("lift", "proximal")
    np.testing.assert_allclose(robot.coupling, [[1, 0], [0, 1], [0, ratio]], atol=EXACT)
    np.testing.assert_allclose(robot.offset, [0, 0, offset], atol=EXACT)
    rng = np.random.default_rng(6)
    for q in rng.uniform(-1, 1, size=(POSTURES, 2)):
        assert equality_residual(robot, q) < EXACT


def test_a_coupling_driven_by_a_coupled_joint_is_carried_to_the_independent_one(tmp_path):
    xml = change(
        XML,
        '<geom name="tip"',
        """<body name="last"><inertial mass="1" pos="0 0 0" diaginertia="1e-3 1e-3 1e-3"/>
           <joint name="last" axis="0 0 1" range="-1 1"/></body>
           <geom name="tip\"""",
    )
    xml = change(
        xml,
        "  <equality>",
        '  <equality>\n<joint joint1="last" joint2="distal" polycoef="0.1 2 0 0 0"/>',
    )
    robot = build(tmp_path, change(xml, 'qpos="0 0.2 0.1"', 'qpos="0 0.2 0.1 0.3"'))
    np.testing.assert_allclose(robot.coupling[:, 1], [0, 1, 0.5, 1.0], atol=EXACT)
    np.testing.assert_allclose(robot.offset, [0, 0, 0, 0.1], atol=EXACT)
    assert equality_residual(robot, np.array([0.1, 0.4])) < EXACT


def test_an_equality_that_is_switched_off_couples_nothing(tmp_path):
    xml = change(XML, '<joint name="follow"', '<joint name="follow" active="false"')
    robot = build(tmp_path, xml, change(TOML, "lift = 0.1", "lift = 0.1\ndistal = 1.0"))
    assert robot.joints == ("lift", "proximal", "distal")
    np.testing.assert_array_equal(robot.coupling, np.eye(3))


# ---------------------------------------------------------------- ranges


def test_the_ranges_of_q_keep_every_coupled_joint_inside_exactly(robot):
    for q in (robot.q_lower, robot.q_upper, robot.home):
        full = robot.coupling @ q + robot.offset
        assert (full >= robot.lower).all() and (full <= robot.upper).all()
        assert robot.violation(q) == 0.0
    # and are no smaller than that asks: one step further leaves some range
    for j in range(robot.n):
        for end, way in ((robot.q_lower, -1.0), (robot.q_upper, 1.0)):
            q = end.copy()
            q[j] += way * 1e-14
            assert robot.violation(q) > 0.0


def test_the_distal_range_ends_the_closing_before_the_proximal_one_does(robot):
    proximal = robot.index("bhand_f3_proximal")
    np.testing.assert_allclose(np.degrees(robot.q_upper[proximal]), 135.0, atol=EXACT * 100)


def test_random_ratios_and_offsets_never_leave_a_range_by_rounding(tmp_path):
    """The ends are exact in floating point, not up to an ulp."""
    rng = np.random.default_rng(7)
    for _ in range(40):
        ratio = rng.choice([-1, 1]) * rng.uniform(0.1, 3)
        rest = rng.uniform(-0.5, 0.5)
        middle = ratio * rng.uniform(0.5, 2.5) + rest  # where the proximal joint is inside its own
        low, high = middle - rng.uniform(0.05, 0.5), middle + rng.uniform(0.05, 0.5)
        xml = change(XML, "0 0.5 0 0 0", f"{rest:.17g} {ratio:.17g} 0 0 0")
        xml = change(xml, "-0.1 0.8", f"{low:.17g} {high:.17g}")
        robot = build(tmp_path, xml, change(TOML, 'home = "home"', "home = {}"))
        for q in (robot.q_lower, robot.q_upper):
            assert robot.violation(q) == 0.0
        for share in rng.uniform(size=5):
            q = robot.q_lower + share * (robot.q_upper - robot.q_lower)
            assert robot.violation(q) == 0.0
        ends = sorted(((low - rest) / ratio, (high - rest) / ratio))
        assert robot.q_lower[1] == pytest.approx(max(0.0, ends[0]), abs=EXACT)
        assert robot.q_upper[1] == pytest.approx(min(3.0, ends[1]), abs=EXACT)


def test_violation_is_what_the_worst_joint_exceeds_its_range_by(tmp_path):
    robot = build(tmp_path)
    assert robot.violation(np.array([0.0, 1.0])) == 0.0
    assert robot.violation(np.array([0.6, 1.0])) == pytest.approx(0.1, abs=EXACT)
    assert robot.violation(np.array([0.0, -0.15])) == pytest.approx(0.15, abs=EXACT)
    assert robot.violation(np.array([0.0, 2.0])) == pytest.approx(0.2, abs=EXACT)  # distal at 1.0


def test_a_joint_without_a_range_is_never_outside(tmp_path):
    xml = change(XML, '<joint name="proximal" axis="0 0 1" range="0 3"/>',
                 '<joint name="proximal" axis="0 0 1"/>')  # fmt: skip
    xml = change(xml, ' range="-0.1 0.8"', "")
    robot = build(tmp_path, xml)
    assert robot.q_lower[1] == -np.inf and robot.q_upper[1] == np.inf
    assert robot.violation(np.array([0.0, 1e6])) == 0.0


def test_home_velocity_flexion_and_radius_are_the_files(tmp_path):
    robot = build(tmp_path)
    np.testing.assert_array_equal(robot.home, [0.0, 0.2])
    np.testing.assert_array_equal(robot.velocity, [0.1, 2.0])
    np.testing.assert_array_equal(robot.tip_radius, [0.01])
    assert robot.flexion == ((1,),)
    assert robot.index("proximal") == 1
    assert robot.description.name == tmp_path.name


def test_a_new_hand_is_a_folder_named_by_its_path_or_as_text(tmp_path):
    folder = tiny_hand.write(tmp_path)
    assert Scene(robot=folder).articulated.joints == ("lift", "proximal")
    assert Scene(robot=str(folder)).articulated.joints == ("lift", "proximal")


# ---------------------------------------------------------------- errors


def test_an_unknown_robot_lists_the_known_ones():
    with pytest.raises(InputError, match=r"unknown robot 'hook'.*bhand, .*umass_torso, wam_bhand"):
        RobotDescription.load("hook")


def test_a_robot_that_is_neither_name_nor_path_lists_the_known_ones():
    with pytest.raises(InputError, match="robot"):
        RobotDescription.load(3)


def test_a_folder_without_robot_toml_is_no_robot(tmp_path):
    with pytest.raises(ModelError, match=r"no robot\.toml"):
        RobotDescription.load(tmp_path)


@pytest.mark.parametrize("entry", ["model", "contact_points"])
def test_a_missing_entry_is_named(tmp_path, entry):
    if entry == "model":
        toml = change(TOML, 'model = "tiny.xml"', "")
    else:
        toml = TOML.split("[[contact_points]]")[0]
    with pytest.raises(ModelError, match=rf"robot\.toml lacks the entry '{entry}'"):
        build(tmp_path, toml=toml)


def test_a_contact_point_without_link_and_geom_is_refused(tmp_path):
    toml = change(change(TOML, 'geom = "tip"', ""), 'site = "tip_center"', "")
    with pytest.raises(ModelError, match=r"robot\.toml lacks the entry 'link'"):
        build(tmp_path, toml=toml)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('palm = "palm"', 'plam = "palm"', "unknown entry 'plam'; did you mean 'palm'?"),
        ("[velocity]", "[velocities]", "unknown entry 'velocities'; did you mean 'velocity'?"),
        ('arm = ["lift"]', 'arm = ["lift"]\naduction = "lift"', "did you mean 'adduction'?"),
        ('geom = "tip"', 'gemo = "tip"', "unknown entry 'gemo'; did you mean 'geom'?"),
        ('site = "tip_center"', 'site = "tip_center"\nsize = 1', "'size'; did you mean 'site'?"),
        ('home = "home"', 'home = "home"\nxyz = 1', "unknown entry 'xyz'; entries are: model, "),
    ],
)
def test_a_misspelt_entry_comes_with_the_nearest_valid_one(tmp_path, old, new, message):
    """Also where nothing is missing: an optional entry would be ignored without a word."""
    with pytest.raises(ModelError, match=rf"robot\.toml: .*{re.escape(message)}"):
        build(tmp_path, toml=change(TOML, old, new))


def test_a_robot_toml_that_is_not_toml_is_refused(tmp_path):
    with pytest.raises(ModelError, match=r"robot\.toml is not valid TOML"):
        build(tmp_path, toml="model = tiny.xml")


@pytest.mark.parametrize("velocity", ['"slow"', "-0.1", "0", "nan", "inf"])
def test_a_velocity_that_is_no_number_above_zero_is_refused(tmp_path, velocity):
    with pytest.raises(ModelError, match="velocity"):
        build(tmp_path, toml=change(TOML, "lift = 0.1", f"lift = {velocity}"))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("[velocity]\nlift = 0.1\nproximal = 2.0", "velocity = 2.0"),
        ('arm = ["lift"]', "arm = 1"),
        ('model = "tiny.xml"', "model = 1"),
        ('flexion = ["proximal"]', "flexion = 1"),
        ('site = "tip_center"', "site = 1"),
        ("[[contact_points]]", "[contact_points]"),
    ],
)
def test_entries_of_the_wrong_kind_are_refused(tmp_path, old, new):
    with pytest.raises(ModelError, match=r"robot\.toml"):
        build(tmp_path, toml=change(TOML, old, new))


def test_an_mjcf_that_is_missing_or_broken_is_named(tmp_path):
    with pytest.raises(ModelError, match=r"tiny\.xml is not a valid MJCF"):
        build(tmp_path, xml="<mujoco>")
    with pytest.raises(ModelError, match=r"gone\.xml is not a valid MJCF"):
        build(tmp_path, toml=change(TOML, "tiny.xml", "gone.xml"))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('site = "tip_center"', 'site = "tip"', "no site 'tip' in .*sites are: palm, tip_center"),
        ('geom = "tip"', 'geom = "nail"', "no geom 'nail' in .*geoms are: tip"),
        ('palm = "palm"', 'palm = "hand"', "no site 'hand' in .*sites are: palm, tip_center"),
        ('home = "home"', 'home = "rest"', "no keyframe 'rest' in .*keyframes are: home"),
        ('arm = ["lift"]', 'arm = ["hoist"]', "no independent joint 'hoist'.*lift, proximal"),
        ("lift = 0.1", "hoist = 0.1", "no independent joint 'hoist'.*lift, proximal"),
        ('["proximal"]', '["distal"]', "no independent joint 'distal'.*lift, proximal"),
        ('palm = "palm"', 'palm = "palm"\nadduction = "spread"', "no independent joint 'spread'"),
    ],
)
def test_a_name_that_the_model_lacks_comes_with_those_it_has(tmp_path, old, new, message):
    with pytest.raises(ModelError, match=message):
        build(tmp_path, toml=change(TOML, old, new))


def test_where_there_is_nothing_to_choose_from_the_message_says_none(tmp_path):
    xml = XML[: XML.index("  <keyframe>")] + "</mujoco>"
    with pytest.raises(ModelError, match=r"no keyframe 'home' in .*keyframes are: none"):
        build(tmp_path, xml)


@pytest.mark.parametrize("qpos", ["0 0.2", "0 0.2 0.1 0.3"])
def test_a_keyframe_of_the_wrong_length_is_refused(tmp_path, qpos):
    """MuJoCo refuses one that is too long, and fills one that is too short with zeros."""
    folder = tiny_hand.write(tmp_path, change(XML, 'qpos="0 0.2 0.1"', f'qpos="{qpos}"'))
    with pytest.raises((InputError, ModelError), match=r"keyframe 'home'.*3"):
        Scene(robot=folder).articulated  # noqa: B018


@pytest.mark.parametrize("joint", ['<freejoint name="lift"/>', '<joint name="lift" type="ball"/>'])
def test_only_hinges_and_slides_are_accepted(tmp_path, joint):
    xml = change(XML, '<joint name="lift" type="slide" axis="0 0 1" range="-0.5 0.5"/>', joint)
    qpos = "1 " + "0 " * (3 if "ball" in joint else 6)
    xml = change(xml, 'qpos="0 0.2 0.1"', f'qpos="{qpos} 0.2 0.1"')
    with pytest.raises(ModelError, match=r"joint 'lift' of .* is neither hinge nor slide"):
        build(tmp_path, xml)


def test_a_nonlinear_coupling_is_refused_by_name(tmp_path):
    with pytest.raises(ModelError, match="equality follow is not linear"):
        build(tmp_path, change(XML, "0 0.5 0 0 0", "0 0.5 0.1 0 0"))


def test_couplings_that_contradict_one_another_are_refused(tmp_path):
    again = '<joint joint1="distal" joint2="proximal" polycoef="0 0.3 0 0 0"/>'
    with pytest.raises(ModelError, match="contradict or repeat"):
        build(tmp_path, change(XML, "  <equality>", f"  <equality>\n    {again}"))


def test_a_coupling_through_a_tendon_that_is_not_fixed_is_refused(tmp_path):
    head, tail = TWO_TENDONS.split('<fixed name="cable">')
    tail = tail[tail.index("</fixed>") + len("</fixed>") :]
    spatial = '<spatial name="cable"><site site="palm"/><site site="tip_center"/></spatial>'
    with pytest.raises(ModelError, match="tendon 'cable' couples joints but is not fixed"):
        build(tmp_path, head + spatial + tail)


def test_a_tip_of_any_convex_shape_is_accepted(tmp_path):
    for shape in ("box", "capsule", "cylinder", "ellipsoid"):
        xml = change(XML, 'type="sphere" size="0.01"', f'type="{shape}" size="0.01 0.01 0.01"')
        robot = build(tmp_path, xml)
        np.testing.assert_array_equal(robot.tip_radius, [0.0])  # no ball


@pytest.mark.parametrize("where", ["0.03 0 0", "0.04 0 0.001"])
def test_a_site_beside_the_centre_of_its_tip_is_refused(tmp_path, where):
    """Contact positions are computed from the site, gaps from the geom: they must coincide."""
    xml = change(
        XML, '<site name="tip_center" pos="0.04 0 0"/>', f'<site name="tip_center" pos="{where}"/>'
    )
    with pytest.raises(ModelError, match="tip_center"):
        build(tmp_path, xml)


@pytest.mark.parametrize(
    "q", [[0.0], [0.0, 0.0, 0.0], [[0.0, 0.0]], [np.nan, 0.0], [0.0, np.inf]], ids=str
)
def test_q_must_be_one_finite_angle_for_each_joint(tmp_path, q):
    robot = build(tmp_path)
    with pytest.raises(InputError, match="q_target must be 2 finite angles, for lift, proximal"):
        robot.require_q("q_target", q)


# ---------------------------------------------------------------- bounds, links, opening


def test_no_place_of_a_link_moves_faster_than_reach_and_the_straight_finger_as_fast(tmp_path):
    """The ball's centre is 0.1 m from the proximal axis, 0.04 m from the distal one, at half."""
    np.testing.assert_allclose(build(tmp_path).reach, [[1.0, 0.1 + 0.5 * 0.04]], atol=EXACT)
    beside = change(XML, 'axis="0 0 1" range="0 3"', 'axis="0 0 1" pos="0 -0.03 0.04" range="0 3"')
    robot = build(tmp_path, beside)
    np.testing.assert_allclose(robot.reach, [[1.0, 0.1 + 0.05 + 0.5 * 0.04]], atol=EXACT)
    box = 'type="box" size="0.01 0.02 0.02"'  # 0.03 to its corners
    toml = change(TOML, 'site = "tip_center"\n', "")
    robot = build(tmp_path, change(XML, 'type="sphere" size="0.01"', box), toml)
    np.testing.assert_allclose(robot.reach, [[1.0, 0.13 + 0.5 * 0.07]], atol=EXACT)


def test_a_slide_on_the_way_carries_a_link_further_from_the_joints_below(tmp_path):
    xml = change(XML, 'name="lift" type="slide" axis="0 0 1" range="-0.5 0.5"',
                 'name="lift" axis="0 1 0" range="-0.5 0.5"')  # fmt: skip
    slide = '<joint name="out" type="slide" axis="1 0 0" range="-0.3 0.2"/><joint name="proximal"'
    xml = change(change(xml, '<joint name="proximal"', slide), 'qpos="0', 'qpos="0 0')
    robot = build(tmp_path, xml, change(TOML, "lift = 0.1", "lift = 0.1\nout = 0.1"))
    np.testing.assert_allclose(robot.reach, [[0.1 + 0.3, 1.0, 0.1 + 0.5 * 0.04]], atol=EXACT)
    for q in postures(robot, seed=11):
        speeds = np.linalg.norm(robot.jacobian(q), axis=0)
        assert (speeds <= robot.reach[0] + EXACT).all()


def test_reach_bounds_every_contact_point(robot):
    for q in postures(robot, seed=12):
        speeds = np.linalg.norm(robot.jacobian(q).reshape(3, 3, -1), axis=1)
        assert (speeds <= robot.reach + EXACT).all()


def test_a_point_of_a_link_goes_with_it(robot):
    """Its place on the link is kept, and its rate is the link's Jacobian there."""
    rng = np.random.default_rng(13)
    for q in postures(robot, seed=13, count=3):
        for i in range(3):
            x = robot.centers(q)[i] + rng.normal(scale=0.02, size=3)
            point = np.zeros((3, 3))
            point[i] = robot.on_link(q, i, x)
            np.testing.assert_allclose(robot.centers(q, point)[i], x, atol=EXACT)
            J = robot.link_jacobian(q, i, x)
            np.testing.assert_allclose(J, robot.jacobian(q, point)[3 * i : 3 * i + 3], atol=EXACT)
            rates = [
                (robot.centers(q + d, point)[i] - robot.centers(q - d, point)[i]) / (2 * FD_STEP)
                for d in FD_STEP * np.eye(robot.n)
            ]
            np.testing.assert_allclose(J, np.transpose(rates), atol=FD_TOL)


def test_what_is_returned_is_the_callers_own(robot):
    q = robot.home.copy()
    kept = [np.copy(a) for a in (*robot.bodies(q), robot.jacobian(q), robot.palm(q)[0])]
    handed = (*robot.bodies(q), robot.jacobian(q), robot.palm(q)[0])
    opened = robot.opened(q)
    for array in (*handed, opened):
        array += 1.0
    np.testing.assert_array_equal(q, robot.home)
    again = (*robot.bodies(q), robot.jacobian(q), robot.palm(q)[0])
    for one, other in zip(again, kept, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_posture_that_is_changed_in_place_is_another_posture(robot):
    q = robot.home.copy()
    first = robot.centers(q).copy()
    q[0] += 0.1
    assert np.abs(robot.centers(q) - first).max() > 1e-3
    q[0] -= 0.1
    np.testing.assert_allclose(robot.centers(q), first, atol=EXACT)


TWO_MOTORS = change(
    change(XML, 'range="-0.1 0.8"', 'range="-0.1 0.8" ref="0"'), "  <equality>", "  <!-- "
).replace("</equality>", " -->")


def test_a_finger_opens_until_its_first_joint_ends_and_closes_until_its_last_does(tmp_path):
    """By shares of all that it can, from wherever it is; the arm stays."""
    toml = change(TOML, 'flexion = ["proximal"]', "flexion = { proximal = 1.0, distal = -0.5 }")
    robot = build(tmp_path, TWO_MOTORS, toml)
    np.testing.assert_allclose(robot.closing, [[0.0, 1.0, -0.5]], atol=EXACT)
    q = np.array([0.2, 1.0, 0.6])  # it opens by 0.4, and closes by 2.0 and, distal, by 1.4
    np.testing.assert_allclose(robot.opened(q), [0.2, 0.6, 0.8], atol=EXACT)
    np.testing.assert_allclose(robot.opened(q, 1.0), [0.2, 3.0, -0.1], atol=EXACT)
    half = -0.5 * 0.4 + 0.5 * 2.0
    np.testing.assert_allclose(robot.opened(q, 0.5), [0.2, 1.0 + half, 0.6 - half / 2], atol=EXACT)
    np.testing.assert_array_equal(q, [0.2, 1.0, 0.6])


def test_a_finger_without_ranges_opens_and_closes_by_a_radian(tmp_path):
    xml = change(TWO_MOTORS, 'axis="0 0 1" range="0 3"', 'axis="0 0 1"')
    robot = build(tmp_path, xml)
    q = np.array([0.1, 5.0, 0.3])
    np.testing.assert_allclose(robot.opened(q), [0.1, 4.0, 0.3], atol=EXACT)
    np.testing.assert_allclose(robot.opened(q, 1.0), [0.1, 6.0, 0.3], atol=EXACT)


@pytest.mark.parametrize(
    ("angle", "weight"), [(0, 1.0), (40, 1.0), (50, 0.0), (130, 0.0), (140, -1.0), (180, -1.0)]
)
def test_joints_that_bend_a_finger_alike_close_it_and_others_do_not(tmp_path, angle, weight):
    """Parallel to the last one by a cosine of 0.7, signed."""
    axis = f"{np.sin(np.radians(angle))} 0 {np.cos(np.radians(angle))}"
    xml = change(TWO_MOTORS, 'name="proximal" axis="0 0 1"', f'name="proximal" axis="{axis}"')
    robot = build(tmp_path, xml, change(TOML, 'flexion = ["proximal"]', ""))
    np.testing.assert_allclose(robot.closing, [[0.0, weight, 1.0]], atol=EXACT)


def test_a_grasp_is_complete_with_what_the_robot_knows(robot):
    """Of a ball that is felt with noise the place is that which its normal tells."""
    q, rng = robot.home, np.random.default_rng(14)
    centers = robot.centers(q)
    normals = rng.normal(size=(3, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    places = centers + rng.normal(scale=0.01, size=(3, 3))
    for noise in (0.0, 0.01):
        contacts = [Contact(p, n, noise=noise) for p, n in zip(places, normals, strict=True)]
        grasp = robot.grasp(q, contacts, ("link",))
        expected = centers - 0.008 * normals if noise else places
        np.testing.assert_allclose(grasp.positions, expected, atol=EXACT)
        np.testing.assert_allclose(grasp.normals, normals, atol=EXACT)
        assert grasp.other_links == ("link",) and grasp.rolling is None
        np.testing.assert_array_equal(grasp.jacobian, robot.jacobian(q))
        np.testing.assert_array_equal(grasp.hessian, robot.hessian(q))
        np.testing.assert_array_equal(grasp.coupling, robot.coupling)
        for i, contact in enumerate(grasp.contacts):
            assert contact.name == robot.description.contact_points[i].name
            assert contact.flexion == robot.flexion[i] and contact.tip_radius == 0.008
            site = robot.model.site(robot.description.contact_points[i].site)
            assert robot.model.body(contact.body).id == site.bodyid[0]
            np.testing.assert_allclose(contact.point, site.pos, atol=EXACT)
    with pytest.raises(InputError, match=r"touches with 3 points .*; got 2 contacts"):
        robot.grasp(q, contacts[:2])


JAWS = """
<mujoco>
  <compiler autolimits="true"/>
  <worldbody>
    <body name="palm">
      <inertial mass="1" pos="0 0 0" diaginertia="1e-3 1e-3 1e-3"/>
      <joint name="lift" type="slide" axis="0 0 1" range="-0.5 0.5"/>
      <site name="palm"/>
      {jaws}
    </body>
  </worldbody>
</mujoco>"""
JAW = """
<body name="{name}">
  <inertial mass="1" pos="0 0 0" diaginertia="1e-3 1e-3 1e-3"/>
  <joint name="{name}" type="slide" axis="{axis} 0 0" range="{low} {high}"/>
  <geom name="{name}" type="sphere" size="0.005" pos="0 0 0.1" mass="0"/>
  <site name="{name}" pos="0 0 0.1"/>
</body>"""


@pytest.mark.parametrize(("axis", "opens"), [(1, 1), (1, -1), (-1, 1), (-1, -1)])
def test_jaws_that_are_closed_at_home_close_against_the_way_they_can_go(tmp_path, axis, opens):
    """The other way they open, whatever the sign of the joint and the side of its range."""
    ranges = {"one": sorted((0.0, 0.04 * opens)), "other": sorted((0.0, -0.04 * opens))}
    jaws = "".join(
        JAW.format(name=name, axis=axis, low=low, high=high) for name, (low, high) in ranges.items()
    )
    points = "".join(
        f'[[contact_points]]\nname = "{name}"\nsite = "{name}"\ngeom = "{name}"\n'
        for name in ranges
    )
    (tmp_path / "tiny.xml").write_text(JAWS.format(jaws=jaws))
    about = 'model = "tiny.xml"\npalm = "palm"\narm = ["lift"]\n'
    about += "[velocity]\nlift = 0.1\none = 0.1\nother = 0.1\n"
    (tmp_path / "robot.toml").write_text(about + points)
    robot = Scene(tmp_path).articulated
    np.testing.assert_array_equal(np.sign(robot.closing), [[0, -opens, 0], [0, 0, opens]])
