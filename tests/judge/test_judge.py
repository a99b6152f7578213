"""A judge's verdict agrees with statics, and is the same wherever it is given."""

import multiprocessing

import mujoco
import numpy as np
import pytest

import hqp_grasp as hg
from hqp_grasp.errors import InputError
from hqp_grasp.judge.bench import Bench
from hqp_grasp.judge.judge import AXES, SQUEEZES, Judge, _slipped
from hqp_grasp.world.physics import Physics

STACK = hg.ForceTask() >> hg.MomentTask() >> hg.KinematicTask()
LEVER = 0.105  # [m] of a fingertip about its joint
GRAVITY = 9.81  # [m/s²]


def squeezed(force):
    """The same torque at every finger."""

    def law(robot, grasp):
        torque = np.zeros(robot.n)
        torque[[j for joints in robot.flexion for j in joints]] = force * LEVER
        return torque

    return law


def five_newton(robot, grasp):
    return squeezed(5.0)(robot, grasp)


@pytest.fixture(scope="module")
def scene():
    return hg.Scene()


@pytest.fixture(scope="module")
def grasp(scene):
    record = hg.Trial(scene, STACK, probes=12).run((0, 2))
    assert record.verdict == "good"
    return record.grasps[-1]


@pytest.fixture(scope="module")
def verdict(scene, grasp):
    return Judge(scene, five_newton).judge(grasp)


def test_a_balanced_grasp_is_lifted_as_far_as_the_palm(verdict):
    assert verdict.lifted and verdict.passed and verdict.reason == ""
    assert verdict.height == pytest.approx(0.1, abs=2e-3)


def test_downwards_it_slips_where_friction_is_used_up(verdict):
    """Level normals: friction carries µ Σ normal, of which the weight has its part already."""
    friction = 0.6 * verdict.sum_normal - 0.1 * GRAVITY
    assert verdict.pulls["-z"] == pytest.approx(friction, rel=0.1)


def test_strength_grows_with_the_squeeze_and_with_friction(scene, grasp, verdict):
    harder = Judge(scene, squeezed(10.0)).judge(grasp)
    smoother = Judge(scene, five_newton, friction=0.4).judge(grasp)
    assert harder.sum_normal == pytest.approx(2.0 * verdict.sum_normal, rel=0.05)
    for axis in AXES:
        assert smoother.pulls[axis] < verdict.pulls[axis] < harder.pulls[axis]
        assert smoother.twists[axis] < verdict.twists[axis]


def test_the_weakest_axis_is_the_least_of_all(verdict):
    assert verdict.weakest_axis == min(verdict.pulls.values())
    assert verdict.weakest_twist == min(verdict.twists.values())


def test_what_nobody_squeezes_is_dropped(scene, grasp):
    judged = Judge(scene, squeezed(0.0)).judge(grasp)
    assert not judged.lifted and not judged.passed
    assert judged.reason == "dropped" and judged.weakest_axis == 0.0


def test_a_weight_beyond_friction_is_dropped(scene, grasp, verdict):
    too_much = 1.5 * 0.6 * verdict.sum_normal / GRAVITY
    assert not Judge(scene, five_newton, mass=too_much).judge(grasp).lifted
    assert Judge(scene, five_newton, mass=0.5 * too_much).judge(grasp).lifted


def test_a_verdict_is_the_same_to_the_last_bit_again_and_in_another_process(scene, grasp, verdict):
    again = Judge(scene, five_newton).judge(grasp)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        elsewhere = pool.apply(_judged_there, (scene, grasp))
    assert again == verdict == elsewhere


def _judged_there(scene, grasp):
    return Judge(scene, five_newton).judge(grasp)


def test_half_the_time_step_changes_the_weakest_axis_by_a_hundredth_at_most(scene, grasp, verdict):
    finer = Judge(scene, five_newton, timestep=0.002).judge(grasp)
    assert finer.weakest_axis == pytest.approx(verdict.weakest_axis, rel=0.01)


def test_dexgraspbench_passes_what_holds_a_newton_and_no_more_than_that(scene, grasp):
    assert Judge(scene, squeezed(5.0), protocol="dexgraspbench").judge(grasp).passed
    judged = Judge(scene, squeezed(0.2), protocol="dexgraspbench").judge(grasp)
    assert not judged.passed and judged.reason.startswith("pulled away along")


def test_a_hand_without_an_arm_has_the_support_taken_away():
    scene = hg.Scene(robot="bhand")
    began = hg.Start().draw(scene, hg.GeometricProbe, np.random.default_rng(5))
    for force, holds in ((8.0, True), (0.0, False)):
        judged = Judge(began.scene, squeezed(force)).judge(began.grasp)
        assert judged.lifted is holds
        assert abs(judged.height) < 0.01 or not holds


def test_where_the_arm_cannot_go_nothing_is_lifted(scene, grasp):
    judged = Judge(scene, five_newton, lift=2.0).judge(grasp)
    assert not judged.lifted and judged.reason == "out of reach"


def test_a_link_in_the_object_is_refused_before_anything_moves(scene, grasp):
    robot = scene.articulated
    q = grasp.q.copy()
    q[[j for joints in robot.flexion for j in joints]] += 0.1
    inside = robot.grasp(q, grasp.contacts)
    with pytest.raises(InputError, match=r"tip is .* mm in the object"):
        Judge(scene, five_newton).judge(inside)


def test_a_finger_below_the_object_is_not_stopped_by_what_it_stands_on(scene, grasp):
    """A fixed object has nothing below it: hands may have reached there."""
    bench = Bench(scene, grasp, Physics(support="pedestal"))
    model, data = bench.model, bench.data
    support = model.geom("support").id
    model.geom_pos[support] = data.xpos[model.body("f1_distal").id]  # where a finger is
    mujoco.mj_forward(model, data)
    pairs = [set(contact.geom.tolist()) for contact in data.contact[: data.ncon]]
    assert all(pair - {support} <= bench._things for pair in pairs if support in pair)


@pytest.mark.parametrize("name", ["mass", "friction", "lift", "slip", "rate", "timestep"])
def test_what_is_no_size_is_refused(scene, name):
    with pytest.raises(InputError, match=f"Judge.{name} must be finite and above 0"):
        Judge(scene, five_newton, **{name: 0.0})


@pytest.mark.parametrize("squeeze", SQUEEZES)
def test_every_squeeze_lifts_a_balanced_grasp_with_the_strength_asked_for(scene, grasp, squeeze):
    judged = Judge(scene, squeeze, force=5.0).judge(grasp)
    assert judged.lifted
    assert judged.sum_normal == pytest.approx(15.0, rel=0.1)


def test_forces_by_the_hierarchy_grow_with_what_is_lifted(scene, grasp):
    light, heavy = (Judge(scene, force=5.0, mass=mass).judge(grasp) for mass in (0.1, 1.0))
    assert light.lifted and heavy.lifted
    needed = 1.0 * GRAVITY / 0.5  # by the friction that is believed
    assert heavy.sum_normal == pytest.approx(needed, rel=0.02)
    assert heavy.sum_normal > 1.2 * light.sum_normal


def test_an_unknown_squeeze_is_answered_with_those_there_are(scene):
    with pytest.raises(InputError, match="choose one of: hierarchy, equal-torque, equal-normal"):
        Judge(scene, "harder")


def test_an_unknown_protocol_is_answered_with_those_there_are(scene):
    with pytest.raises(InputError, match="choose one of: pulls, dexgraspbench"):
        Judge(scene, five_newton, protocol="froggr")


def test_a_grasp_of_another_robot_is_refused(scene):
    other = hg.Grasp(np.zeros(3), [hg.Contact(np.zeros(3), [0, 0, 1.0])], np.zeros((3, 3)))
    with pytest.raises(InputError, match="needs a grasp of its joints"):
        Judge(scene, five_newton).judge(other)


def test_slip_is_told_from_distance_and_from_angle():
    turn = 0.3
    still = np.array([0.1, 0.2, 0.3, 1.0, 0.0, 0.0, 0.0])
    moved = still + np.array([0.011, 0, 0, 0, 0, 0, 0])
    turned = still.copy()
    turned[3:] = np.cos(turn / 2), 0.0, np.sin(turn / 2), 0.0
    poses = np.array([still, moved, turned, still * np.array([1, 1, 1, -1, 1, 1, 1])])
    assert _slipped(poses, still, 0.01, 0.29).tolist() == [False, True, True, False]
    assert not _slipped(poses, still, 0.012, 0.31).any()


def test_the_bench_feels_what_the_servos_press_with(scene, grasp):
    """Torques of the finger joints balance the forces at the tips: τ = −Jᵀ f."""
    bench = Bench(scene, grasp, Physics(support="pedestal", timestep=0.004))
    joints = [j for each in bench.robot.flexion for j in each]
    for _ in range(30):
        told = bench.told.copy()
        told[joints] = bench.q[joints] + 0.5 / bench.kp[joints]
        bench.run(told, 0.05)
    felt = bench.grasp()
    f = bench.touching().forces
    torque = felt.jacobian.T @ f.ravel()
    assert torque[joints] == pytest.approx(0.5, rel=0.02)
    weighs = f.sum(axis=0) + bench.touching().elsewhere
    assert weighs == pytest.approx([0.0, 0.0, 0.1 * GRAVITY], abs=0.05)
