"""Grips: contact forces by laws in strict order, from what is felt."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

import hqp_grasp as hg
from hqp_grasp.control.forces import (
    FrictionPyramids,
    GripStrength,
    JointTorques,
    LeastForce,
    Margins,
    NetForce,
    NetMoment,
    NormalForces,
    equal_normal,
    equal_torque,
    felt_wrench,
    normal_null_space,
)
from hqp_grasp.errors import InputError, ModelError
from hqp_grasp.hierarchy.level import CERTIFICATE_TOLERANCE
from hqp_grasp.mechanics import friction_demand, grasp_map, net_wrench
from hqp_grasp.world.description import RobotDescription
from hqp_grasp.world.robot import compiled
from hqp_grasp.world.statics import contact_jacobian, torque_limits, weight_torque

SMALL = 1e-6  # [N] what the certificate's tolerance leaves of forces of some N
LINKS = ("f1_tip", "f2_tip", "f3_tip", "bhand_palm", "f1_proximal", "f2_proximal", "f3_proximal")
assert CERTIFICATE_TOLERANCE * 100.0 <= SMALL


@pytest.fixture(scope="module")
def robot():
    about = RobotDescription.load("wam_bhand")
    return hg.Robot(about, compiled(about))


def walls(robot, k=3, lean=0.0, wrenches=None):
    """A grasp of k contacts around a cup whose walls lean by `lean` [rad]."""
    a = 2.0 * np.pi * np.arange(k) / k + 0.3
    around = np.column_stack([np.cos(a), np.sin(a), np.zeros(k)])
    x = robot.centers(robot.home).mean(axis=0) + 0.05 * around
    return touched(robot, x, np.cos(lean) * around + [0.0, 0.0, np.sin(lean)], wrenches)


def touched(robot, x, n, wrenches=None):
    wrenches = [None] * len(x) if wrenches is None else wrenches
    contacts = [
        hg.Contact(p, m, body=LINKS[i % len(LINKS)], wrench=w)
        for i, (p, m, w) in enumerate(zip(x, n, wrenches, strict=True))
    ]
    return hg.Grasp(robot.home, tuple(contacts), np.zeros((3 * len(x), robot.n)))


def drawn(robot, k, rng):
    n = rng.normal(size=(k, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    middle = robot.centers(robot.home).mean(axis=0)
    return touched(robot, middle + 0.05 * n + 0.005 * rng.normal(size=(k, 3)), n)


def report(squeeze, law):
    (found,) = [each for each in squeeze.reports if each.law == law]
    return found


def short(squeeze, law):
    return report(squeeze, law).short


@pytest.mark.parametrize("k", [2, 3, 4, 5])
def test_balanced_walls_are_squeezed_along_their_normals(robot, k):
    grasp = walls(robot, k)
    squeeze = hg.Grip(robot, force=4.0, friction=0.5).solve(grasp)
    np.testing.assert_allclose(squeeze.forces, -4.0 * grasp.normals, atol=SMALL)
    np.testing.assert_allclose(squeeze.margin, 4.0 * 0.5 / np.hypot(1.0, 0.5), atol=SMALL)
    assert [each.law for each in squeeze.short] == ["least force"]
    assert squeeze.certified and squeeze.reason == ""


@pytest.mark.parametrize("lean", [0.05, 0.2])
def test_leaning_walls_are_squeezed_across_by_friction(robot, lean):
    grasp = walls(robot, lean=lean)
    squeeze = hg.Grip(robot, force=4.0, friction=0.5).solve(grasp)
    level = -grasp.normals * [1.0, 1.0, 0.0] / np.cos(lean)
    np.testing.assert_allclose(squeeze.forces, 4.0 / np.cos(lean) * level, atol=SMALL)
    assert short(squeeze, "net force") == 0.0


def test_what_leans_more_than_friction_holds_loses_its_net_force_first(robot):
    squeeze = hg.Grip(robot, force=4.0, friction=0.2).solve(walls(robot, lean=0.5))
    assert short(squeeze, "friction pyramids") == short(squeeze, "normal forces") == 0.0
    assert short(squeeze, "net force") > 0.1
    told = str(report(squeeze, "net force"))
    assert told.startswith("net force: short by ") and told.endswith(" N")


def test_the_weight_that_is_felt_is_carried_without_being_told(robot):
    """Each tip feels the object press on it and hang on it."""
    n = walls(robot).normals
    weight = 3.0
    wrenches = np.zeros((3, 6))
    wrenches[:, :3] = 2.0 * n + [0.0, 0.0, -weight / 3]
    grasp = walls(robot, wrenches=wrenches)
    np.testing.assert_allclose(felt_wrench(grasp)[:3], [0.0, 0.0, weight], atol=1e-12)
    squeeze = hg.Grip(robot, force=8.0, friction=0.5).solve(grasp)
    np.testing.assert_allclose(squeeze.forces.sum(axis=0), [0.0, 0.0, weight], atol=SMALL)
    assert squeeze.margin.min() > 1.0
    told = hg.Grip(robot, force=8.0, friction=0.5).solve(walls(robot), felt_wrench(grasp))
    np.testing.assert_allclose(told.forces, squeeze.forces, atol=SMALL)


def test_the_felt_moment_counts_the_torques_on_the_tips(robot):
    rng = np.random.default_rng(3)
    grasp = drawn(robot, 3, rng)
    forces, spins, radius = rng.normal(size=(3, 3)), rng.normal(size=3), 0.01
    x, n = grasp.positions, grasp.normals
    contacts = []
    for contact, f, spin in zip(grasp.contacts, forces, spins, strict=True):
        about_centre = np.cross(-radius * contact.normal, -f) - spin * contact.normal
        wrench = np.concatenate([-f, about_centre])
        contacts.append(replace(contact, tip_radius=radius, wrench=wrench))
    felt = felt_wrench(replace(grasp, contacts=tuple(contacts)))
    wanted = net_wrench(forces, x, x.mean(axis=0))
    wanted[3:] += spins @ n
    np.testing.assert_allclose(felt, wanted, atol=1e-12)


def plates(robot):
    """Two contacts that face each other, 10 cm apart."""
    n = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    return touched(robot, robot.centers(robot.home).mean(axis=0) + 0.05 * n, n)


def test_eight_edges_carry_a_load_askew_that_four_would_not(robot):
    load = 4.5 / np.sqrt(2.0) * np.array([0.0, 1.0, 1.0, 0.0, 0.0, 0.0])  # 0.9 of two cones' most
    squeeze = hg.Grip(robot, force=5.0, friction=0.5).solve(plates(robot), load)
    assert short(squeeze, "net force") == short(squeeze, "grip strength") == 0.0


def test_no_contact_pushes_with_more_than_the_most_whatever_it_should_carry(robot):
    load = np.array([0.0, 0.0, 8.0, 0.0, 0.0, 0.0])
    squeeze = hg.Grip(robot, force=5.0, friction=0.5, most=6.0).solve(plates(robot), load)
    assert np.abs(squeeze.forces[:, 0]).max() == pytest.approx(6.0, abs=SMALL)
    assert short(squeeze, "net force") == pytest.approx(8.0 - 2 * 0.5 * 6.0, abs=SMALL)
    more = hg.Grip(robot, force=5.0, friction=0.5, most=25.0).solve(plates(robot), load)
    assert short(more, "net force") == 0.0  # it squeezes harder than it was asked to
    assert short(more, "grip strength") == pytest.approx(2 * 8.0 - 2 * 5.0, abs=SMALL)


@pytest.mark.parametrize("k", [2, 3, 4, 5])
def test_forces_keep_the_limits_whatever_is_felt(robot, k):
    rng = np.random.default_rng(k)
    grip = hg.Grip(robot, force=5.0, friction=0.5)
    low, high = torque_limits(robot)
    found = 0
    for _ in range(10):
        grasp = drawn(robot, k, rng)
        squeeze = grip.solve(grasp)
        if not squeeze.certified:
            assert squeeze.reason
            continue
        found += 1
        assert squeeze.margin.min() > -SMALL
        normal = -(grasp.normals * squeeze.forces).sum(axis=1)
        if short(squeeze, "normal forces") == 0.0:
            assert normal.min() > 1.0 - SMALL and normal.max() < 15.0 + SMALL
        torque = contact_jacobian(robot, grasp).T @ squeeze.forces.ravel()
        held = torque + weight_torque(robot, grasp.q)
        assert (held > low - SMALL).all() and (held < high + SMALL).all()
        still = np.isin(np.arange(robot.n), robot.arm)
        assert (squeeze.torque[still] == 0.0).all()
        np.testing.assert_allclose(squeeze.torque[~still], torque[~still], atol=1e-12)
    assert found >= 9


def test_lower_laws_take_only_what_higher_ones_leave(robot):
    """Without the laws below, each level is met just as well."""
    rng = np.random.default_rng(11)
    laws = [NetForce(), GripStrength(), Margins(), NetMoment(), LeastForce()]
    for _ in range(5):
        grasp = drawn(robot, 3, rng)
        whole = hg.Grip(robot).solve(grasp)
        for count in range(1, len(laws)):
            some = laws[0]
            for law in laws[1:count]:
                some = some >> law
            part = hg.Grip(
                robot,
                laws=some.within(*hg.GRIP_LAWS.limits)
                if count > 1
                else hg.Forces(((some,),), hg.GRIP_LAWS.limits),
            ).solve(grasp)
            for law in laws[:count]:
                assert short(whole, law.name) == pytest.approx(short(part, law.name), abs=SMALL)


def test_a_weak_motor_costs_strength_and_the_report_says_so():
    about = RobotDescription.load("bhand")
    robot = hg.Robot(about, compiled(about))
    x, n = robot.centers(robot.home), np.array([[0.0, 1, 0], [0, 1, 0], [0, -1.0, 0]])
    contacts = [hg.Contact(p, m, body=b) for p, m, b in zip(x, n, LINKS, strict=False)]
    grasp = hg.Grasp(robot.home, tuple(contacts), np.zeros((9, robot.n)))
    strong = hg.Grip(robot).solve(grasp)
    assert short(strong, "grip strength") == 0.0
    most = np.abs(strong.torque).max()
    robot.model.actuator_forcerange[:] = [-0.5 * most, 0.5 * most]
    weak = hg.Grip(robot).solve(grasp)
    assert short(weak, "grip strength") > 0.1 and short(weak, "joint torques") == 0.0
    alone, held = weak.torque, weak.torque + weight_torque(robot, grasp.q)
    used = np.maximum(np.abs(alone), np.abs(held))  # weight may not help beyond what a motor has
    assert used.max() == pytest.approx(0.5 * most, abs=SMALL)


def test_a_motor_whose_weight_takes_all_has_nothing_left_for_contacts(robot):
    """Nor is the object asked to hold the arm up."""
    about = RobotDescription.load("wam_bhand")
    weak = hg.Robot(about, compiled(about))
    weight = weight_torque(weak, weak.home)
    heavy = int(np.argmax(np.abs(weight)))
    full = weak.model.joint(weak.joints[heavy]).id
    tight = 0.5 * abs(weight[heavy])
    weak.model.actuator_forcerange[weak.model.actuator_trnid[:, 0] == full] = [-tight, tight]
    felt = hg.Grip(weak).felt(walls(weak))
    towards_weight = felt.torque_upper if weight[heavy] > 0.0 else felt.torque_lower
    assert towards_weight[heavy] == 0.0
    assert (felt.torque_lower <= 0.0).all() and (felt.torque_upper >= 0.0).all()
    assert hg.Grip(weak).solve(walls(weak)).certified


def test_the_forces_turn_with_the_grasp_and_its_order_does_not_matter(robot):
    """As long as no motor is at its limit, and no pyramid's face is felt."""
    grasp = walls(robot, lean=0.1)
    squeeze = hg.Grip(robot).solve(grasp)
    back = replace(grasp, contacts=grasp.contacts[::-1])
    np.testing.assert_allclose(hg.Grip(robot).solve(back).forces[::-1], squeeze.forces, atol=SMALL)


def test_warm_or_cold_and_by_any_solver_the_forces_are_the_same(robot):
    rng = np.random.default_rng(7)
    grip, warm = hg.Grip(robot), None
    for _ in range(10):
        grasp = drawn(robot, 3, rng)
        cold = grip.solve(grasp)
        assert cold.certified and cold.solution.method == "daqp"
        assert grip.solve(grasp, warm=cold).solution.method == "active-set"
        again = grip.solve(grasp, warm=warm)
        np.testing.assert_allclose(again.forces, cold.forces, atol=SMALL)
        other = replace(grip, hqp=hg.HQP("proxqp")).solve(grasp)
        np.testing.assert_allclose(other.forces, cold.forces, atol=SMALL)
        warm = cold
    four = drawn(robot, 4, rng)
    assert grip.solve(four, warm=warm).certified  # of three contacts: no help, and no harm


def about_a_ball(robot, k, rng):
    """Contacts around a lumpy ball, and what they carry."""
    a = 2.0 * np.pi * np.arange(k) / k + 0.3 * rng.normal(size=k)
    n = np.column_stack([np.cos(a), np.sin(a), 0.3 * rng.normal(size=k)])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    middle = robot.centers(robot.home).mean(axis=0)
    grasp = touched(robot, middle + 0.05 * n + 0.005 * rng.normal(size=(k, 3)), n)
    return grasp, rng.normal(size=6) * np.repeat([1.0, 0.02], 3)


def on_two_faces(robot, k, rng):
    """The same on two faces that are nearly parallel: corners of many rows."""
    side = np.where(np.arange(k) % 2, 1.0, -1.0)
    n = np.column_stack([side, 0.02 * rng.normal(size=(k, 2))])
    along = 0.02 * (np.arange(k) // 2) - 0.005 * k
    x = np.column_stack([0.04 * side, along, np.zeros(k)]) + 0.01 * rng.normal(size=(k, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    middle = robot.centers(robot.home).mean(axis=0)
    return touched(robot, middle + x, n), np.array([0.0, 0.0, 20.0 * rng.random(), 0.0, 0.0, 0.0])


@pytest.mark.parametrize("k", [2, 3, 6, 8, 12])
@pytest.mark.parametrize(
    ("shape", "friction"), [(about_a_ball, 0.05), (about_a_ball, 0.5), (on_two_faces, 0.5)]
)
def test_up_to_twelve_contacts_every_row_that_holds_the_forces_is_named(robot, shape, friction, k):
    """Margins that are short by a thousandth, and faces pressed on by as little, count too.

    To find one that was overlooked costs a hundred steps, and more than there is time for. Where
    the QP solver gives up, the search does it alone.
    """
    rng = np.random.default_rng([k, 2])
    grip = hg.Grip(robot, friction=friction)
    for _ in range(30):
        solution = grip.solve(*shape(robot, k, rng)).solution
        assert solution.certified
        assert not any("imbalance" in fault for fault in solution.failed), solution.failed


class Unsure(hg.HQP):
    """Finds the optimum, and cannot show it."""

    def solve(self, levels, warm=None):
        return replace(super().solve(levels, warm), certified=False, failed=("unsure: no proof",))


def test_an_answer_that_is_not_certified_is_never_used(robot):
    squeeze = hg.Grip(robot, hqp=Unsure()).solve(walls(robot))
    assert squeeze.forces is None and squeeze.torque is None and squeeze.margin is None
    assert not squeeze.certified and squeeze.reports == ()
    assert squeeze.reason == "forces not certified: unsure: no proof"


# ---------------------------------------------------------------- laws as values


@dataclass(frozen=True)
class Softer(hg.ForceLaw):
    """One contact pushes with half of the mean."""

    contact: int

    def level(self, felt):
        return hg.Level.equal(felt.pushes[[self.contact]], [0.5 * felt.force])


@dataclass(frozen=True)
class AtMost(hg.ForceLaw):
    """No contact pushes with more than so much [N]."""

    most: float

    def level(self, felt):
        k = felt.grasp.k
        return hg.Level(felt.pushes, np.full(k, -np.inf), np.full(k, self.most))


def test_a_law_of_ones_own_stands_above_those_that_it_composes_with(robot):
    grasp = walls(robot)
    squeeze = hg.Grip(robot, force=4.0, laws=Softer(1) >> hg.GRIP_LAWS).solve(grasp)
    assert -grasp.normals[1] @ squeeze.forces[1] == pytest.approx(2.0, abs=SMALL)
    assert short(squeeze, "softer") == short(squeeze, "net force") == 0.0
    assert [each.law for each in squeeze.reports[:4]] == [
        "joint torques",
        "friction pyramids",
        "normal forces",
        "softer",
    ]


def test_a_law_limits_where_it_stands_within(robot):
    laws = hg.GRIP_LAWS.within(AtMost(3.0))
    squeeze = hg.Grip(robot, force=4.0, laws=laws).solve(walls(robot))
    assert -(walls(robot).normals * squeeze.forces).sum(axis=1).max() < 3.0 + SMALL
    assert short(squeeze, "grip strength") == pytest.approx(3.0, abs=SMALL)
    assert short(squeeze, "at most") == 0.0


def test_laws_at_one_priority_share_a_level_and_are_reported_one_by_one(robot):
    both = (NetForce() + NetMoment() >> GripStrength()).within(JointTorques(), FrictionPyramids())
    grip = hg.Grip(robot, laws=both)
    squeeze = grip.solve(walls(robot, lean=1.2), wrench=[0.0, 0, 0, 0, 0, 0.02])
    names = [level.name for level in squeeze.solution.levels]
    assert names[2:] == ["net force + net moment", "grip strength"]
    together = np.hypot(short(squeeze, "net force"), short(squeeze, "net moment"))
    assert together == pytest.approx(np.linalg.norm(squeeze.solution.levels[2].residual))


def test_laws_are_equal_by_value_and_composed_in_the_order_that_is_read():
    assert NetForce() == NetForce() and hash(Softer(1)) == hash(Softer(1)) != hash(Softer(2))
    laws = (NetForce() >> (GripStrength() + Margins())).within(NormalForces())
    assert laws.levels == ((NormalForces(),), (NetForce(),), (GripStrength(), Margins()))


def test_what_is_no_law_of_force_is_refused():
    for wrong in (hg.ForceTask(), 3.0, None):
        with pytest.raises(InputError, match="law"):
            NetForce() >> wrong
        with pytest.raises(InputError, match="ForceLaw"):
            hg.GRIP_LAWS.within(wrong)
    with pytest.raises(InputError, match="one priority"):
        NetForce() + hg.GRIP_LAWS


def test_a_law_with_rows_of_another_width_is_named(robot):
    @dataclass(frozen=True)
    class Wide(hg.ForceLaw):
        def level(self, felt):
            return hg.Level.equal(np.eye(5), np.zeros(5))

    with pytest.raises(InputError, match=r"law of force 'wide' has rows of 5; 3 contacts have 9"):
        hg.Grip(robot, laws=Wide() >> hg.GRIP_LAWS).solve(walls(robot))


# ---------------------------------------------------------------- bad input


@pytest.mark.parametrize("name", ["force", "friction", "most"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_a_grip_asks_for_strength_and_friction_above_none(robot, name, value):
    with pytest.raises(InputError, match=rf"Grip.{name} must be finite and above 0"):
        hg.Grip(robot, **{name: value})


def test_a_grip_asks_for_no_more_than_one_contact_may_push_with(robot):
    with pytest.raises(InputError, match=r"20 N in the mean, is above the 15 N"):
        hg.Grip(robot, force=20.0)
    assert hg.Grip(robot, force=20.0, most=25.0).solve(walls(robot)).certified


def test_a_robot_whose_motors_have_no_limits_is_refused_before_anything_is_pressed():
    about = RobotDescription.load("bhand")
    robot = hg.Robot(about, compiled(about))
    robot.model.actuator_forcelimited[2] = 0
    with pytest.raises(ModelError, match="no force limit for the motors of: bhand_f2_proximal"):
        hg.Grip(robot)


def test_without_contacts_there_is_nothing_to_press_on(robot):
    missed = hg.Missed(hg.Miss.NO_TOUCH, "finger_1")
    with pytest.raises(InputError, match="must be a Grasp"):
        hg.Grip(robot).solve(missed)
    with pytest.raises(InputError, match="empty"):
        touched(robot, np.zeros((0, 3)), np.zeros((0, 3)))


def test_a_grasp_of_which_some_is_felt_is_refused(robot):
    grasp = walls(robot, wrenches=[np.ones(6), None, np.ones(6)])
    with pytest.raises(InputError, match=r"contacts \[1\] of the grasp have no wrench"):
        hg.Grip(robot).solve(grasp)
    assert hg.Grip(robot).solve(grasp, wrench=np.zeros(6)).certified


def test_one_contact_pushes_with_its_least_and_cannot_balance(robot):
    squeeze = hg.Grip(robot, force=5.0).solve(walls(robot, k=1))
    assert squeeze.certified
    assert short(squeeze, "net force") == pytest.approx(1.0, abs=SMALL)


# ---------------------------------------------------------------- simpler ways


@pytest.fixture(scope="module")
def first():
    """A first touch, and its robot."""
    found = hg.Start().draw(hg.Scene(), hg.GeometricProbe, np.random.default_rng(1))
    return found.scene.articulated, found.grasp


def normals_of(robot, grasp, torque):
    """Normal forces that flexion torques cause where contacts do not rub."""
    names = [point.name for point in robot.description.contact_points]
    J = contact_jacobian(robot, grasp).reshape(-1, 3, robot.n)
    found = []
    for contact, Ji in zip(grasp.contacts, J, strict=True):
        w = robot.closing[names.index(contact.name)]
        found.append((torque @ w) / (-contact.normal @ Ji @ w))
    return np.array(found)


@pytest.mark.parametrize("law", [equal_torque, equal_normal, normal_null_space])
def test_simpler_ways_push_with_the_same_sum_of_normal_forces(first, law):
    robot, grasp = first
    torque = law(robot, grasp, 15.0)
    normal = normals_of(robot, grasp, torque)
    assert normal.sum() == pytest.approx(15.0) and (normal > -SMALL).all()
    assert (torque[list(robot.arm)] == 0.0).all()
    fingers = torque[[j for (j,) in robot.flexion]]
    if law is equal_torque:
        np.testing.assert_allclose(fingers, fingers[0])
    if law is equal_normal:
        np.testing.assert_allclose(normal, 5.0)


def test_the_normals_null_space_leaves_less_than_equal_forces_do(first):
    robot, grasp = first
    x, c = grasp.positions, grasp.positions.mean(axis=0)
    far = np.linalg.norm(x - c, axis=1).mean()

    def left(normal):
        wrench = grasp_map(x, c) @ (-grasp.normals * normal[:, None]).ravel()
        return np.linalg.norm(wrench / np.repeat([1.0, far], 3))

    normal = normals_of(robot, grasp, normal_null_space(robot, grasp, 15.0))
    assert left(normal) < left(np.full(3, 5.0)) - 0.1
    for change in np.random.default_rng(0).normal(size=(50, 3)):
        near = np.maximum(normal + 0.1 * (change - change.mean()), 0.0)
        assert left(normal) <= left(near * 15.0 / near.sum()) + SMALL


def test_a_grip_balances_first_touches_where_friction_allows(first):
    robot, grasp = first
    demand = friction_demand(grasp.positions, grasp.normals)
    enough = hg.Grip(robot, friction=1.1 * demand / np.cos(np.pi / 8)).solve(grasp)
    assert short(enough, "net force") == 0.0


# ---------------------------------------------------------------- reports and levels


def test_each_law_at_one_priority_is_short_by_its_own_rows(robot):
    """The first three rows of the level are the force's, the last three the moment's."""
    both = (NetForce() + NetMoment() >> GripStrength()).within(JointTorques(), FrictionPyramids())
    for lean, load in ((1.2, [0.0, 0, 0, 0, 0, 0.02]), (1.3, [0.0, 0, 4.0, 0.1, 0, 0])):
        squeeze = hg.Grip(robot, laws=both).solve(walls(robot, lean=lean), wrench=load)
        residual = squeeze.solution.levels[2].residual
        assert len(residual) == 6 and residual.any()
        assert short(squeeze, "net force") == pytest.approx(np.linalg.norm(residual[:3]))
        assert short(squeeze, "net moment") == pytest.approx(np.linalg.norm(residual[3:]))


def test_reports_name_every_law_with_its_unit_limits_first(robot):
    squeeze = hg.Grip(robot, force=4.0, friction=0.2).solve(walls(robot, lean=0.5))
    assert [(each.law, each.unit) for each in squeeze.reports] == [
        ("joint torques", "N·m"),
        ("friction pyramids", "N"),
        ("normal forces", "N"),
        ("net force", "N"),
        ("grip strength", "N"),
        ("margins", "N"),
        ("net moment", "N·m"),
        ("least force", "N"),
    ]
    assert str(report(squeeze, "normal forces")) == "normal forces: met"
    assert {each.law for each in squeeze.short} == {r.law for r in squeeze.reports if r.short > 0}


def test_torques_told_are_within_the_motors_limits_to_the_last_bit():
    """An answer is right to rounding; a driver refuses what is beyond."""
    about = RobotDescription.load("bhand")
    robot = hg.Robot(about, compiled(about))
    x, n = robot.centers(robot.home), np.array([[0.0, 1, 0], [0, 1, 0], [0, -1.0, 0]])
    contacts = [hg.Contact(p, m, body=b) for p, m, b in zip(x, n, LINKS, strict=False)]
    grasp = hg.Grasp(robot.home, tuple(contacts), np.zeros((9, robot.n)))
    most = np.abs(hg.Grip(robot).solve(grasp).torque).max()
    for share in (0.3, 0.5, 0.7, 0.9):
        robot.model.actuator_forcerange[:] = [-share * most, share * most]
        grip = hg.Grip(robot)
        felt, squeeze = grip.felt(grasp), grip.solve(grasp)
        assert (squeeze.torque <= felt.torque_upper).all()
        assert (squeeze.torque >= felt.torque_lower).all()
        at = np.isclose(squeeze.torque, felt.torque_upper) | np.isclose(
            squeeze.torque, felt.torque_lower
        )
        assert at.any()


def test_levels_are_posed_as_their_laws_say(robot):
    """x = (f, s): nine forces and three margins."""
    grip = hg.Grip(robot, force=4.0, friction=0.5, most=9.0)
    felt = grip.felt(walls(robot))
    torques, pyramids, normals, force, strength, margins, moment, least = grip.levels(felt)
    assert all(level.A.shape[1] == 12 for level in grip.levels(felt))
    n = felt.grasp.normals
    f = np.random.default_rng(0).normal(size=(3, 3))
    x = np.concatenate([f.ravel(), [0.1, 0.2, 0.3]])
    np.testing.assert_allclose(normals.A @ x, -(n * f).sum(axis=1))
    np.testing.assert_array_equal(normals.lower, 0.2 * 4.0)
    np.testing.assert_array_equal(normals.upper, 9.0)
    np.testing.assert_allclose(force.A @ x, f.sum(axis=0))
    np.testing.assert_allclose(strength.A @ x, [-(n * f).sum()])
    assert strength.lower == strength.upper == [12.0]
    np.testing.assert_array_equal((margins.A @ x, margins.upper), ([0.1, 0.2, 0.3], [np.inf] * 3))
    slope = 0.5 * np.cos(np.pi / 8)
    np.testing.assert_allclose(margins.lower, 4.0 * slope / np.hypot(1.0, slope))
    around = felt.grasp.positions - felt.grasp.positions.mean(axis=0)
    np.testing.assert_allclose(moment.A @ x, np.cross(around, f).sum(axis=0))
    np.testing.assert_array_equal(least.A @ x, f.ravel())
    assert len(pyramids.A) == 3 * 8 + 3 and (pyramids.upper == 0.0).all()
    squeezed = np.concatenate([(-4.0 * n).ravel(), margins.lower])
    faces = pyramids.A @ squeezed
    np.testing.assert_allclose(faces[:24], 0.0, atol=1e-9)  # as far inside as that
    np.testing.assert_allclose(faces[24:], -margins.lower)
    moved = felt.torque.any(axis=1)
    np.testing.assert_allclose(torques.A @ x, (felt.torque @ f.ravel())[moved])


def test_by_default_a_grip_presses_with_five_newtons_and_fifteen_at_most(robot):
    assert (hg.Grip(robot).force, hg.Grip(robot).friction, hg.Grip(robot).most) == (5.0, 0.5, 15.0)
    assert NormalForces().least == 0.2 and hg.Grip(robot).laws == hg.GRIP_LAWS
    for least in (-0.1, 1.1):
        with pytest.raises(InputError, match="is a share of the mean"):
            NormalForces(least)
