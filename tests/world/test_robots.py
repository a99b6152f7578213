"""The robots' files say what the published tables say, and two simulators read them alike."""

import tomllib
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest

ROBOTS = Path(__file__).parents[2] / "robots"
NAMES = ("bhand", "wam_bhand")
FINGERS = (1, 2, 3)
CONFIGURATIONS = 20  # random ones, per test
PUBLISHED_TOL = 1e-6  # [m], [rad]
AGREEMENT_TOL = 1e-9  # between simulators; the files carry 16 digits where they must

# The tables, as published. Lengths [m], angles [rad], masses [kg], inertias [kg m^2].
AW, A1, A2, A3, DW, D3 = 0.025, 0.050, 0.070, 0.050, 0.076, 0.0095
PHI2, PHI3 = 0.0, np.radians(42.0)
R, J = {1: -1, 2: 1, 3: 0}, {1: 1, 2: 1, 3: -1}
WAM_DH = (  # standard DH: alpha/pi, a, d
    (-0.5, 0.0, 0.0),
    (0.5, 0.0, 0.0),
    (-0.5, 0.045, 0.55),
    (0.5, -0.045, 0.0),
    (-0.5, 0.0, 0.3),
    (0.5, 0.0, 0.0),
    (0.0, 0.0, 0.0609),
)
SHOULDER = 0.346
WAM_JOINTS = {  # range, torque [N m], speed [rad/s], rotor inertia
    "wam_j1": (-2.6, 2.6, 77.3, 1.57, 0.201),
    "wam_j2": (-2.0, 2.0, 160.6, 1.05, 0.182),
    "wam_j3": (-2.8, 2.8, 95.6, 2.09, 0.067),
    "wam_j4": (-0.9, 3.1, 29.4, 2.09, 0.034),
    "wam_j5": (-4.76, 1.24, 11.6, 4.19, 0.00332),
    "wam_j6": (-1.6, 1.6, 11.6, 4.19, 0.00332),
    "wam_j7": (-3.0, 3.0, 2.7, 1.05, 0.000467),
}
# fmt: off
WAM_INERTIALS = (  # mass; centre of mass; Ixx Ixy Ixz Iyy Iyz Izz
    (10.7677, (-0.00443, 0.12189, -0.00066),
     (0.13488, -0.00213, -0.00012, 0.11328, 0.00069, 0.09046)),
    (3.8749, (-0.00237, 0.03106, 0.01542),
     (0.02141, 0.00027, 0.00002, 0.01378, -0.00182, 0.01559)),
    (1.8023, (-0.03826, 0.20751, 0.00003),
     (0.05911, -0.00250, 0.00001, 0.00325, -0.00002, 0.05927)),
    (2.4002, (0.00499, -0.00023, 0.13272),
     (0.01492, 0.00002, -0.00151, 0.01483, -0.00002, 0.00294)),
    (0.1238, (0.00009, 0.00511, 0.00436), (5.03e-5, 2e-7, -5e-8, 7.58e-5, -3.6e-6, 6.27e-5)),
    (0.4180, (-0.00012, -0.01703, 0.02468), (5.55e-4, 6e-7, -7e-7, 2.44e-4, -4.6e-5, 4.54e-4)),
    (0.0686, (-0.00008, 0.00016, -0.00324), (3.77e-5, -2e-7, 0.0, 3.81e-5, 0.0, 7.41e-5)),
)
# fmt: on
HAND_INERTIALS = {
    "bhand_palm": (0.60858, (0.00005, -0.00446, 0.03727), (6.99e-4, 5.04e-4, 6.23e-4)),
    "spread": (0.14109, (0.03062, -0.00007, -0.01120), (2.07e-5, 7.41e-5, 6.82e-5)),
    "proximal": (0.06214, (0.02313, 0.00079, 0.00053), (4.82e-6, 4.33e-5, 4.44e-5)),
    "distal": (0.04166, (0.02295, 0.00107, 0.00042), (3.12e-6, 1.69e-5, 1.58e-5)),
}
HAND_MASS = 1.20216  # the sum of the table; the data sheet says 0.98
HAND_RANGES = {"spread": np.pi, "proximal": np.radians(140.0), "distal": np.radians(45.0)}
HAND_SPEEDS = {"spread": np.pi / 0.5, "proximal": np.radians(140.0) / 1.0}
COUPLINGS = {  # dependent: (driver, ratio)
    "bhand_f2_spread": ("bhand_f1_spread", 1.0),
    "bhand_f1_distal": ("bhand_f1_proximal", 1 / 3),
    "bhand_f2_distal": ("bhand_f2_proximal", 1 / 3),
    "bhand_f3_distal": ("bhand_f3_proximal", 1 / 3),
}
HAND_JOINTS = [
    "bhand_f1_spread", "bhand_f1_proximal", "bhand_f1_distal",
    "bhand_f2_spread", "bhand_f2_proximal", "bhand_f2_distal",
    "bhand_f3_proximal", "bhand_f3_distal",
]  # fmt: skip


class Loaded:
    """One robot folder: its facts, its compiled model and a scratch state at home."""

    def __init__(self, name):
        self.name = name
        self.facts = tomllib.loads((ROBOTS / name / "robot.toml").read_text())
        self.path = ROBOTS / name / self.facts["model"]
        self.model = mujoco.MjModel.from_xml_path(str(self.path))
        self.data = mujoco.MjData(self.model)
        self.joints = [self.model.joint(j).name for j in range(self.model.njnt)]
        self.at(self.home)

    @property
    def home(self):
        return self.model.key(self.facts["home"]).qpos.copy()

    def at(self, q):
        self.data.qpos[:] = q
        mujoco.mj_forward(self.model, self.data)
        return self.data

    def random_configurations(self, seed=0):
        rng = np.random.default_rng(seed)
        low, high = self.model.jnt_range.T
        return rng.uniform(low, high, size=(CONFIGURATIONS, self.model.nq))

    def pose(self, site):
        s = self.data.site(site)
        return transform(s.xmat.reshape(3, 3), s.xpos)

    def jacobian(self, site):
        Jv, Jw = np.zeros((3, self.model.nv)), np.zeros((3, self.model.nv))
        mujoco.mj_jacSite(self.model, self.data, Jv, Jw, self.model.site(site).id)
        return Jv, Jw

    def hold(self, ctrl, seconds):
        """Simulates position actuators at ctrl and returns the trajectory of q, one row a step."""
        mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        self.data.ctrl[:] = ctrl
        q = []
        for _ in range(round(seconds / self.model.opt.timestep)):
            mujoco.mj_step(self.model, self.data)
            q.append(self.data.qpos.copy())
        return np.array(q)


@pytest.fixture(params=NAMES)
def robot(request):
    return Loaded(request.param)


@pytest.fixture
def hand():
    return Loaded("bhand")


@pytest.fixture
def arm():
    return Loaded("wam_bhand")


# --- the published kinematics, written out once more and independently


def transform(R, p):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, p
    return T


def turn_x(a):
    c, s = np.cos(a), np.sin(a)
    return transform([[1, 0, 0], [0, c, -s], [0, s, c]], np.zeros(3))


def turn_z(a):
    c, s = np.cos(a), np.sin(a)
    return transform([[c, -s, 0], [s, c, 0], [0, 0, 1]], np.zeros(3))


def shift(x=0.0, z=0.0):
    return transform(np.eye(3), [x, 0, z])


def modified_dh(a, alpha, d, theta):
    return turn_x(alpha) @ shift(x=a) @ turn_z(theta) @ shift(z=d)


def standard_dh(alpha, a, d, theta):
    return turn_z(theta) @ shift(z=d) @ shift(x=a) @ turn_x(alpha)


def wam_tool_plate(q):
    T = shift(z=SHOULDER)
    for (alpha, a, d), theta in zip(WAM_DH, q, strict=True):
        T = T @ standard_dh(alpha * np.pi, a, d, theta)
    return T


def bhand_tip(finger, spread, proximal, distal):
    r, j = R[finger], J[finger]
    return (
        modified_dh(r * AW, 0, DW, r * spread - np.pi / 2 * j)
        @ modified_dh(A1, np.pi / 2, 0, proximal + PHI2)
        @ modified_dh(A2, 0, 0, distal + PHI3)
        @ modified_dh(A3, -np.pi / 2, D3, 0)
    )


def hand_base(robot, q):
    return np.eye(4) if robot.name == "bhand" else wam_tool_plate(q[:7])


# --- kinematics


def test_forward_kinematics_match_the_published_dh_tables(robot):
    for q in robot.random_configurations():
        robot.at(q)
        angle = dict(zip(robot.joints, q, strict=True))
        base = hand_base(robot, q)
        for i in FINGERS:
            joints = [angle.get(f"bhand_f{i}_{link}", 0.0) for link in HAND_RANGES]
            published = base @ bhand_tip(i, *joints)
            np.testing.assert_allclose(
                robot.pose(f"f{i}_tip_center"), published, atol=PUBLISHED_TOL
            )


def test_the_palm_site_has_z_for_approach_and_x_for_opposition(robot):
    """Origin on the palm's face; x from the thumb to fingers 1 and 2 at zero spread."""
    q = robot.home
    for joint in ("bhand_f1_spread", "bhand_f2_spread"):
        q[robot.joints.index(joint)] = 0.0
    robot.at(q)
    palm = robot.pose(robot.facts["palm"])
    base = hand_base(robot, q)
    np.testing.assert_allclose(palm[:3, 3], (base @ shift(z=DW))[:3, 3], atol=PUBLISHED_TOL)
    np.testing.assert_allclose(palm[:3, 2], base[:3, 2], atol=PUBLISHED_TOL)
    tip = {i: robot.pose(f"f{i}_tip_center")[:3, 3] for i in FINGERS}
    opposition = (tip[1] + tip[2]) / 2 - tip[3]
    np.testing.assert_allclose(
        palm[:3, 0], opposition / np.linalg.norm(opposition), atol=PUBLISHED_TOL
    )


def test_a_positive_spread_swings_fingers_1_and_2_apart_as_mirror_images(hand):
    q = hand.home
    spread = [hand.joints.index(f"bhand_f{i}_spread") for i in (1, 2)]
    apart = []
    for angle in (0.0, 0.5, 1.0, 1.5):
        q[spread] = angle
        hand.at(q)
        one, two = (hand.pose(f"f{i}_tip_center")[:3, 3] for i in (1, 2))
        np.testing.assert_allclose(one * [-1, 1, 1], two, atol=AGREEMENT_TOL)
        apart.append(two[0] - one[0])
    assert np.all(np.diff(apart) > 0)


def test_mujoco_and_pinocchio_agree_on_position_jacobian_and_hessian(robot):
    pin_model = pin.buildModelFromMJCF(str(robot.path))
    pin_data = pin_model.createData()
    ids = [pin_model.getJointId(name) for name in robot.joints]
    assert pin_model.nv == robot.model.nv and max(ids) < pin_model.njoints
    at = [pin_model.joints[i].idx_v for i in ids]
    for q in robot.random_configurations(seed=1):
        robot.at(q)
        pin_q = pin.neutral(pin_model)
        pin_q[at] = q
        pin.computeJointKinematicHessians(pin_model, pin_data, pin_q)
        pin.updateFramePlacements(pin_model, pin_data)
        for i in FINGERS:
            site = f"f{i}_tip_center"
            frame = pin_model.getFrameId(site)
            here = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
            Jv, Jw = robot.jacobian(site)
            pin_J = pin.getFrameJacobian(pin_model, pin_data, frame, here)[:, at]
            pin_H = frame_hessian(pin_model, pin_data, frame, here)[:3][:, at][:, :, at]
            position = pin_data.oMf[frame].translation
            np.testing.assert_allclose(robot.data.site(site).xpos, position, atol=AGREEMENT_TOL)
            np.testing.assert_allclose(np.vstack([Jv, Jw]), pin_J, atol=AGREEMENT_TOL)
            np.testing.assert_allclose(hessian(Jv, Jw), pin_H, atol=AGREEMENT_TOL)


def test_the_closed_form_hessian_agrees_with_the_jacobians_rate(robot):
    rng = np.random.default_rng(2)
    rate, unused = np.zeros((2, 3, robot.model.nv))
    for q in robot.random_configurations(seed=2):
        robot.data.qvel[:] = rng.standard_normal(robot.model.nv)
        robot.at(q)
        for i in FINGERS:
            site = robot.data.site(f"f{i}_tip_center")
            body = robot.model.site_bodyid[site.id]
            mujoco.mj_jacDot(robot.model, robot.data, rate, unused, site.xpos, body)
            H = hessian(*robot.jacobian(site.name))
            np.testing.assert_allclose(H @ robot.data.qvel, rate, atol=AGREEMENT_TOL)


def hessian(Jv, Jw):
    """H[:, j, k] = ω_min(j,k) × Jv_max(j,k), min being the joint nearer the base."""
    n = Jv.shape[1]
    first, last = np.minimum.outer(range(n), range(n)), np.maximum.outer(range(n), range(n))
    return np.cross(Jw[:, first], Jv[:, last], axis=0)


def frame_hessian(model, data, frame, reference):
    """Pinocchio's Hessian (6, nv, nv), whose memory is column-major but labelled row-major."""
    T = pin.getFrameKinematicHessian(model, data, frame, reference)
    return T.ravel().reshape(T.shape, order="F")


# --- the tables


def test_joints_come_in_order_and_only_the_coupled_ones_are_dependent(robot):
    arm = list(robot.facts["arm"])
    assert arm == (list(WAM_JOINTS) if robot.name == "wam_bhand" else [])
    assert robot.joints == arm + HAND_JOINTS
    model = robot.model
    driven = [model.joint(model.actuator(a).trnid[0]).name for a in range(model.nu)]
    assert driven == [j for j in robot.joints if j not in COUPLINGS]
    assert list(robot.facts["velocity"]) == driven


def test_couplings_are_the_published_ones_and_hold_at_home(robot):
    model = robot.model
    found = {}
    for e in range(model.neq):
        assert model.eq_type[e] == mujoco.mjtEq.mjEQ_JOINT
        offset, ratio, *rest = model.eq_data[e, :5]
        assert offset == 0.0 and not np.any(rest)
        dependent, driver = model.joint(model.eq_obj1id[e]), model.joint(model.eq_obj2id[e])
        found[dependent.name] = (driver.name, ratio)
        home = robot.home
        assert home[dependent.qposadr[0]] == pytest.approx(
            ratio * home[driver.qposadr[0]], abs=1e-12
        )
    assert found.keys() == COUPLINGS.keys()
    for dependent, (driver, ratio) in COUPLINGS.items():
        assert found[dependent] == (driver, pytest.approx(ratio, abs=1e-15))


def test_ranges_torques_speeds_and_rotor_inertias_match_the_published_tables(robot):
    model, speed = robot.model, robot.facts["velocity"]
    for name in robot.joints:
        joint = model.joint(name)
        if name in WAM_JOINTS:
            low, high, torque, published_speed, rotor = WAM_JOINTS[name]
            assert tuple(joint.range) == (low, high)
            assert tuple(model.actuator(name).forcerange) == (-torque, torque)
            assert speed[name] == published_speed
            assert joint.armature[0] == rotor
        else:
            link = name.split("_")[-1]
            np.testing.assert_allclose(joint.range, (0.0, HAND_RANGES[link]), atol=1e-12)
            if name in speed:
                assert speed[name] == pytest.approx(HAND_SPEEDS[link], abs=0.005)


def test_a_fingers_torque_limit_gives_its_published_force_of_15_newton(hand):
    """By virtual work along the coupled closing motion: τ = F |∂x_tip/∂θ2|."""
    hand.at(np.zeros(hand.model.nq))
    Jv, _ = hand.jacobian("f3_tip_center")
    proximal, distal = (hand.joints.index(f"bhand_f3_{link}") for link in ("proximal", "distal"))
    lever = np.linalg.norm(Jv[:, proximal] + Jv[:, distal] / 3)
    assert hand.model.actuator("bhand_f3_proximal").forcerange[1] / lever == pytest.approx(
        15.0, abs=0.1
    )


def inertial(model, bodies):
    """Mass, centre and inertia at that centre of welded bodies, in the frame of the first."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    R0, p0 = data.xmat[bodies[0]].reshape(3, 3), data.xpos[bodies[0]]
    mass = model.body_mass[bodies]
    centres = (data.xipos[bodies] - p0) @ R0
    centre = mass @ centres / mass.sum()
    inertia = np.zeros((3, 3))
    for body, m, c in zip(bodies, mass, centres - centre, strict=True):
        Ri = R0.T @ data.ximat[body].reshape(3, 3)
        inertia += Ri @ np.diag(model.body_inertia[body]) @ Ri.T
        inertia += m * (c @ c * np.eye(3) - np.outer(c, c))
    return mass.sum(), centre, inertia


def test_hand_inertials_match_the_published_table_and_the_tip_is_part_of_the_distal_link(robot):
    model = robot.model
    links = ["bhand_palm"] + [j.removeprefix("bhand_") for j in HAND_JOINTS]
    total = 0.0
    for link in links:
        mass, centre, inertia = HAND_INERTIALS[link if link == "bhand_palm" else link[3:]]
        bodies = [model.body(link).id]
        if link.endswith("distal"):
            bodies.append(model.body(link.replace("distal", "tip")).id)
        found = inertial(model, bodies)
        np.testing.assert_allclose(found[0], mass, rtol=1e-6)
        np.testing.assert_allclose(found[1], centre, atol=1e-9)
        np.testing.assert_allclose(found[2], np.diag(inertia), atol=1e-12)
        total += found[0]
    assert total == pytest.approx(HAND_MASS, abs=1e-9)


# MuJoCo turns an inertia to its principal axes until the cosine of a turn is within 1e-12 of 1
# (mju_eig3; version 4.0 goes on), so tensors rebuilt from those axes are off by this turn [rad] …
LAST_TURN = np.sqrt(2e-12)


def test_arm_inertials_match_the_published_table(arm):
    for i, (mass, centre, (xx, xy, xz, yy, yz, zz)) in enumerate(WAM_INERTIALS, start=1):
        found = inertial(arm.model, [arm.model.body(f"wam_link{i}").id])
        assert found[0] == mass
        np.testing.assert_allclose(found[1], centre, atol=1e-12)
        table = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        # … times the difference of two principal moments: below the table's last digit.
        atol = LAST_TURN * np.ptp(np.linalg.eigvalsh(table))
        np.testing.assert_allclose(found[2], table, rtol=0, atol=atol)


def test_every_moving_body_has_an_inertia_that_a_solid_can_have(robot):
    assert not mujoco.MjSpec.from_file(str(robot.path)).compiler.balanceinertia
    moving = robot.model.body_weldid > 0
    assert np.all(robot.model.body_mass[moving] > 0)
    smallest, middle, largest = np.sort(robot.model.body_inertia[moving]).T
    assert np.all(smallest > 0)
    assert np.all(smallest + middle >= largest)


def test_gravity_is_compensated_on_every_body(robot):
    assert np.all(robot.model.body_gravcomp[1:] == 1.0)


def test_both_robots_carry_the_same_hand(hand, arm):
    one, two = hand.model, arm.model
    hand.at(np.zeros(one.nq))
    arm.at(np.zeros(two.nq))
    for b in range(1, one.nbody):
        a, c = one.body(b), two.body(one.body(b).name)
        np.testing.assert_array_equal(a.mass, c.mass)
        np.testing.assert_array_equal(a.inertia, c.inertia)
        np.testing.assert_array_equal(a.pos, c.pos * (a.name != "bhand_palm"))
        np.testing.assert_array_equal(one.geom_size[one.geom_bodyid == b],
                                      two.geom_size[two.geom_bodyid == c.id])  # fmt: skip
        np.testing.assert_array_equal(one.geom_pos[one.geom_bodyid == b],
                                      two.geom_pos[two.geom_bodyid == c.id])  # fmt: skip
    for a in range(one.nu):
        other = two.actuator(one.actuator(a).name)
        np.testing.assert_array_equal(one.actuator(a).gainprm, other.gainprm)
        np.testing.assert_array_equal(one.actuator(a).forcerange, other.forcerange)


# --- names, shapes and contacts


def test_every_name_in_robot_toml_exists(robot):
    facts, model = robot.facts, robot.model
    model.key(facts["home"]), model.site(facts["palm"])
    for joint in [facts["adduction"], *facts["arm"], *facts["velocity"]]:
        model.joint(joint)
    assert [p["name"] for p in facts["contact_points"]] == ["finger_1", "finger_2", "finger_3"]
    for point in facts["contact_points"]:
        site, geom = model.site(point["site"]), model.geom(point["geom"])
        assert model.geom_type[geom.id] == mujoco.mjtGeom.mjGEOM_SPHERE
        assert geom.size[0] == 0.008
        np.testing.assert_array_equal(geom.pos, site.pos)
        assert site.bodyid == geom.bodyid
        for joint in point["flexion"]:
            assert model.joint(joint).name not in COUPLINGS
        for key, kind in (("force", "mjSENS_FORCE"), ("torque", "mjSENS_TORQUE")):
            assert model.sensor(point[key]).type == getattr(mujoco.mjtSensor, kind)


def test_the_file_is_self_contained_and_every_colliding_shape_has_a_name(robot):
    text = robot.path.read_text()
    assert "<include" not in text and "<mesh" not in text and "file=" not in text
    for g in range(robot.model.ngeom):
        geom = robot.model.geom(g)
        assert bool(geom.name) == bool(geom.contype[0] or geom.conaffinity[0])


def test_the_tip_touches_before_its_distal_link_does(hand):
    """On any face whose normal lies between straight ahead and 10° behind the closing direction."""
    model = hand.model
    tip = model.geom("f3_tip")
    centre = np.array([A3, D3])
    capsule = model.geom("f3_distal")
    R_geom = np.zeros(9)
    mujoco.mju_quat2Mat(R_geom, capsule.quat)
    half = capsule.size[1] * R_geom.reshape(3, 3)[:2, 2]
    ends = np.array([capsule.pos[:2] + half, capsule.pos[:2] - half])
    for angle in np.radians(np.arange(0, 101, 5)):
        n = np.array([np.cos(angle), np.sin(angle)])
        assert centre @ n + tip.size[0] > np.max(ends @ n) + capsule.size[0]


def test_home_is_within_the_ranges_and_touches_nothing(robot):
    low, high = robot.model.jnt_range.T
    assert np.all(robot.home > low) and np.all(robot.home < high)
    robot.at(robot.home)
    assert robot.data.ncon == 0


def test_home_holds_the_palm_before_the_base_pointing_forward_and_down(arm):
    palm = arm.pose("palm")
    assert 0.5 < palm[0, 3] < 0.65 and abs(palm[1, 3]) < 1e-9
    below_horizontal = np.degrees(np.arcsin(-palm[2, 2]))
    assert palm[0, 2] > 0 and below_horizontal == pytest.approx(40.0, abs=1.0)


# --- physics


def test_position_actuators_hold_home_within_a_degree(robot):
    q = robot.hold(robot.model.key("home").ctrl, seconds=1.5)
    assert np.all(np.isfinite(q))
    assert np.max(np.abs(q - robot.home)) < np.radians(1.0)


def test_coupled_joints_follow_their_drivers_while_the_hand_closes(hand):
    command = np.array([0.9, 1.1, 1.2, 1.0])
    q = hand.hold(command, seconds=1.5)
    at = hand.joints.index
    for dependent, (driver, ratio) in COUPLINGS.items():
        error = q[:, at(dependent)] - ratio * q[:, at(driver)]
        assert np.max(np.abs(error)) < np.radians(1.0)
    reached = [q[-1, at(hand.model.actuator(a).name)] for a in range(4)]
    np.testing.assert_allclose(reached, command, atol=np.radians(1.0))


def test_the_distal_range_stops_the_proximal_joint_short_of_its_own(hand):
    command = hand.model.key("home").ctrl.copy()
    command[3] = np.radians(140.0)
    q = hand.hold(command, seconds=1.5)[-1]
    assert np.degrees(q[hand.joints.index("bhand_f3_distal")]) < 46.0
    assert np.degrees(q[hand.joints.index("bhand_f3_proximal")]) < 138.0


def test_a_push_on_a_tip_appears_with_opposite_sign_in_its_own_sensors_only(hand):
    """The sensor reads what holds the tip: minus the wrench applied about the tip's centre."""
    push_world, lever_world = np.array([0.3, -0.5, 0.4]), np.array([0.0, 0.004, 0.006])
    tip, link = hand.model.body("f3_tip").id, hand.model.body("f3_proximal").id
    readings = {}
    for pushed in (None, tip, link):
        mujoco.mj_resetDataKeyframe(hand.model, hand.data, 0)
        if pushed is not None:
            torque = np.cross(lever_world, push_world) * (pushed == tip)
            hand.data.xfrc_applied[pushed] = [*push_world, *torque]
        mujoco.mj_step(hand.model, hand.data, nstep=1500)
        R_world_site = hand.pose("f3_tip_sensor")[:3, :3]
        wrench = [
            R_world_site @ hand.data.sensor(f"f3_{kind}").data for kind in ("force", "torque")
        ]
        others = [hand.data.sensor(f"f{i}_force").data.copy() for i in (1, 2)]
        readings[pushed] = (*wrench, others)
    force, torque, others = readings[tip]
    tare_force, tare_torque, tare_others = readings[None]
    np.testing.assert_allclose(tare_force - force, push_world, atol=1e-3)
    np.testing.assert_allclose(tare_torque - torque, np.cross(lever_world, push_world), atol=1e-5)
    np.testing.assert_allclose(others, tare_others, atol=1e-3)
    np.testing.assert_allclose(readings[link][0], tare_force, atol=1e-3)


def test_a_robot_attaches_to_a_scene_with_its_keyframe_couplings_and_inertias(robot):
    scene = mujoco.MjSpec()
    robot_spec = mujoco.MjSpec.from_file(str(robot.path))
    scene.attach(robot_spec, prefix="left/", frame=scene.worldbody.add_frame(pos=[0, 0.35, 0.7]))
    model = scene.compile()
    assert (model.nq, model.nu, model.neq) == (robot.model.nq, robot.model.nu, robot.model.neq)
    np.testing.assert_array_equal(model.key("left/home").qpos, robot.home)
    np.testing.assert_array_equal(model.body_mass, robot.model.body_mass)
    np.testing.assert_array_equal(model.jnt_range, robot.model.jnt_range)
    np.testing.assert_array_equal(model.actuator_ctrlrange, robot.model.actuator_ctrlrange)
