"""A judge's verdict agrees with statics, and is the same wherever it is given."""

import multiprocessing

import mujoco
import numpy as np
import pytest

import hqp_grasp as hg
from hqp_grasp.errors import InputError
from hqp_grasp.judge import judge as module
from hqp_grasp.judge.bench import Bench, Touching
from hqp_grasp.judge.judge import AXES, SQUEEZES, Judge, Judged, _slipped, _Squeeze
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
    assert type(judged.sum_normal) is float and judged.sum_normal == pytest.approx(15.0, rel=0.1)
    assert judged.height == 0.0


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


# ---------------------------------------------------------------- one part after the other

STILL = np.array([0.1, 0.2, 0.3, 1.0, 0.0, 0.0, 0.0])


class Told:
    """A bench whose object slips by so much [m] and turns by so much [rad] under a load."""

    def __init__(self, robot=None, slip=lambda load: 0.0, turn=lambda load: 0.0, normal=4.0):
        self.robot, self.slip, self.turn = robot, slip, turn
        n = 1 if robot is None else robot.n
        self.told, self.kp, self.strength = np.zeros(n), np.full(n, 10.0), np.full(n, 0.45)
        self.q = np.linspace(0.0, 0.1, n)
        self.height, self.normal, self.heights = 1.0, normal, []
        self.runs, self.calls, self.felt = [], [], "a grasp"

    def run(self, told, duration, wrench=None):
        self.runs.append((told.copy(), duration, wrench))
        self.told = told.copy()
        if wrench is None:
            return None
        steps = round(duration / 0.004)
        poses = np.tile(STILL, (steps, 1))
        for pose, load in zip(poses, np.broadcast_to(wrench, (steps, 6)).sum(axis=1), strict=True):
            pose[0] += self.slip(load)
            pose[3:5] = np.cos(self.turn(load) / 2.0), np.sin(self.turn(load) / 2.0)
        return poses

    def grasp(self):
        return self.felt

    def touching(self):
        normals = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
        return Touching(np.zeros((2, 3)), normals, -0.5 * self.normal * normals, np.zeros(3))

    def saved(self):
        return "saved"

    def restore(self, state):
        self.calls.append(state)

    def remove_support(self):
        self.calls.append("no support")

    def remove_gravity(self):
        self.calls.append("no gravity")


@pytest.mark.parametrize("axis", [np.eye(6)[0], -np.eye(6)[2], np.eye(6)[4]])
def test_a_pull_grows_evenly_until_the_object_has_slipped_as_far_as_it_may(scene, axis):
    sign = axis.sum()
    for at in (0.4, 3.0, 7.31):
        bench = Told(slip=lambda load, at=at: 0.02 * (sign * load >= at))
        found = Judge(scene)._pull(bench, "state", axis, 5.0, 20.0)
        assert bench.calls == ["state"] and at <= found <= at + 5.0 * 0.004 + 1e-9
        wrenches = np.concatenate([wrench for _, _, wrench in bench.runs])
        np.testing.assert_allclose(wrenches, np.arange(len(wrenches))[:, None] * 0.02 * axis)
        assert len(bench.runs) == np.floor(at / 2.5) + 1  # nobody pulls on for long
    assert Judge(scene)._pull(Told(), "state", axis, 5.0, 20.0) == 20.0
    late = Told(slip=lambda load: 0.02 * (sign * load >= 20.5))
    assert Judge(scene)._pull(late, "state", axis, 5.0, 20.0) == 20.0


def test_a_pull_ends_at_the_judges_slip_or_turn_from_where_it_began(scene):
    judge = Judge(scene, slip=0.01, turn=0.2)
    creeping = Told(slip=lambda load: 0.001 * load)
    assert judge._pull(creeping, 0, np.eye(6)[0], 5.0, 20.0) == pytest.approx(10.0, abs=0.03)
    turning = Told(turn=lambda load: 0.05 * load)
    assert judge._pull(turning, 0, np.eye(6)[3], 5.0, 20.0) == pytest.approx(4.0, abs=0.03)


def test_dexgraspbenchs_pulls_are_ten_times_the_mass_for_two_seconds_each_way(scene):
    judge = Judge(scene, protocol="dexgraspbench", mass=0.3)
    bench = Told()
    found = judge._dexgraspbench(bench)
    assert bench.calls == ["no support", "no gravity", *["saved"] * 6]
    assert found.passed and not found.lifted and found.height == 0.0 and found.sum_normal == 4.0
    assert found.pulls == dict.fromkeys(AXES, 3.0)
    for (_, duration, wrench), way in zip(bench.runs, np.eye(3).repeat(2, axis=0), strict=True):
        assert duration == 2.0
        np.testing.assert_allclose(np.abs(wrench), [[*(3.0 * way), 0.0, 0.0, 0.0]])
    np.testing.assert_array_equal(sum(wrench for _, _, wrench in bench.runs), 0.0)


@pytest.mark.parametrize(
    ("slip", "turn", "passes"),
    [(0.049, 0.0, True), (0.051, 0.0, False), (0.0, 14.9, True), (0.0, 15.1, False)],
)
def test_dexgraspbench_passes_what_moves_by_5_cm_and_turns_by_15_degrees_at_most(
    scene, slip, turn, passes
):
    class Late(Told):
        def run(self, told, duration, wrench=None):
            poses = super().run(told, duration, wrench)
            poses[:-1] = STILL  # only at the end
            return poses

    bench = Late(slip=lambda load: slip * (load < 0), turn=lambda load: np.radians(turn))
    found = Judge(scene, protocol="dexgraspbench")._dexgraspbench(bench)
    assert found.passed is passes
    if slip and not passes:
        assert found.reason == "pulled away along -x, -y, -z"
        assert found.pulls["+x"] == 1.0 and found.pulls["-x"] == 0.0 == found.weakest_axis


@pytest.mark.parametrize(
    ("robot", "heights", "lifted"),
    [
        ("wam_bhand", (1.0, 1.051), True),
        ("wam_bhand", (1.0, 1.049), False),
        ("bhand", (1.0, 0.951), True),  # it hangs where it stood, a little lower
        ("bhand", (1.0, 0.949), False),
    ],
)
def test_what_has_risen_by_half_the_palms_way_is_lifted(monkeypatch, robot, heights, lifted):
    scene = hg.Scene(robot=robot)

    class Rising(Told):
        height = property(lambda self: self.heights.pop(0), lambda self, value: None)

    def bench(scene, grasp, physics):
        made = Rising(scene.articulated)
        made.told, made.heights = grasp.q.copy(), list(heights)
        made.felt = None
        return made

    monkeypatch.setattr(module, "Bench", bench)
    contacts = [hg.Contact(x, n) for x, n in ((np.zeros(3), [1, 0, 0]), (np.ones(3), [-1, 0, 0]))]
    grasp = scene.articulated.grasp(scene.articulated.home, [*contacts, contacts[0]])
    found = Judge(scene, lambda robot, grasp: np.zeros(robot.n)).judge(grasp)
    assert found.lifted is lifted and found.height == pytest.approx(heights[1] - heights[0])
    assert found.sum_normal == 4.0 and (found.reason == "dropped") is not lifted


def test_torques_grow_at_a_bounded_rate_and_no_farther_than_servos_are_strong(scene):
    robot = scene.articulated
    bench, fingers = Told(robot), [j for joints in robot.flexion for j in joints]
    squeeze = _Squeeze(bench, lambda robot, grasp: np.full(robot.n, 1.0), "felt")
    asked = [squeeze.cycle(np.zeros(robot.n)) for _ in range(6)]
    torque = np.array([(told - bench.q) * bench.kp for told, _, _ in bench.runs])
    # 2 N·m/s for 50 ms a time, up to the 0.45 N·m of this bench.
    due = [0.1, 0.2, 0.3, 0.4, 0.45, 0.45]
    np.testing.assert_allclose(torque[:, fingers], np.tile(due, (len(fingers), 1)).T)
    assert asked == [False] * 4 + [True] * 2
    told = np.array([told for told, _, _ in bench.runs])
    assert (told[:, list(robot.arm)] == 0.0).all() and {lasts for _, lasts, _ in bench.runs} == {
        0.05
    }


def test_where_a_contact_is_lost_the_law_reads_the_last_grasp_that_had_all(scene):
    bench, read = Told(scene.articulated), []
    bench.felt = None
    squeeze = _Squeeze(bench, lambda robot, grasp: read.append(grasp), "as it began")
    for felt in (None, "once more", None):
        bench.felt = felt
        squeeze.cycle(bench.told)
    assert read == ["as it began", "once more", "once more"]
    # A law without an answer keeps the torques of before.
    squeeze._law = lambda robot, grasp: np.full(robot.n, 0.1)
    squeeze.cycle(bench.told)
    before = squeeze._torque.copy()
    squeeze._law = lambda robot, grasp: None
    assert squeeze.cycle(bench.told) and before.any()
    np.testing.assert_array_equal(squeeze._torque, before)


def test_squeezing_settles_after_the_torques_are_there_and_ends_if_they_never_are(scene):
    def cycles(law):
        bench = Told(scene.articulated)
        _Squeeze(bench, law, "felt").tighten()
        return len(bench.runs)

    # 0.3 s of settling, or a rounding error more.
    assert cycles(lambda robot, grasp: np.full(robot.n, 0.25)) - 2 in (6, 7)
    alternating = iter(range(1000))
    never = cycles(lambda robot, grasp: np.full(robot.n, 1.0 - 2.0 * (next(alternating) % 2)))
    assert never == round((2 * 0.45 / 2.0 + 0.3) / 0.05)


def test_the_arm_follows_its_way_evenly_while_the_hand_presses_on(scene):
    robot = scene.articulated
    bench = Told(robot)
    squeeze = _Squeeze(bench, lambda robot, grasp: np.zeros(robot.n), "felt")
    way = [np.full(robot.n, 0.3), np.full(robot.n, 0.2)]
    squeeze.follow(way, 0.15)
    arm = [told[robot.arm[0]] for told, _, _ in bench.runs]
    np.testing.assert_allclose(arm, [0.1, 0.2, 0.3, 0.3 - 0.1 / 3, 0.2 + 0.1 / 3, 0.2])
    np.testing.assert_allclose([lasts for _, lasts, _ in bench.runs], 0.05)
    squeeze.hold(0.2)
    assert len(bench.runs) == 6 + 4 and (bench.told[list(robot.arm)] == 0.2).all()


def test_a_law_is_not_asked_any_more_once_the_object_is_lifted(scene, grasp):
    times = []

    def law(robot, felt):
        times.append(felt)
        return five_newton(robot, felt)

    Judge(scene, law, most_force=0.1, most_torque=0.01).judge(grasp)
    # Squeezing by the torque's rate and settling, the lift at 8 cm/s, and a second of holding.
    assert len(times) == pytest.approx((0.525 / 2.0 + 0.3 + 0.1 / 0.08 + 1.0) / 0.05, abs=3)


def test_a_judge_is_by_default_the_one_that_verdicts_are_quoted_by(scene):
    judge = Judge(scene)
    assert (judge.squeeze, judge.protocol) == ("hierarchy", "pulls")
    assert (judge.force, judge.mass, judge.friction, judge.believed) == (5.0, 0.1, 0.6, 0.5)
    assert (judge.lift, judge.slip, judge.turn) == (0.1, 0.01, np.radians(15.0))
    assert (judge.most_force, judge.most_torque) == (20.0, 1.0)
    assert (judge.rate, judge.twist_rate, judge.timestep) == (5.0, 0.25, 0.004)
    assert Judged(True, 0.1, 5.0) == Judged(True, 0.1, 5.0, {}, {}, False, "")
    assert Judged(False, 0.0, 0.0).weakest_axis == Judged(False, 0.0, 0.0).weakest_twist == 0.0


def test_a_judge_moves_to_another_scene_with_all_that_it_is(scene):
    judge, other = Judge(scene, "null-space", 7.0), hg.Scene(robot="bhand")
    moved = judge.within(other)
    assert (moved.scene, moved.squeeze, moved.force) == (other, "null-space", 7.0)


# ---------------------------------------------------------------- the bench


@pytest.fixture
def bench(scene, grasp):
    return Bench(scene, grasp, Physics(support="pedestal", mass=0.4, timestep=0.004))


def test_what_stands_is_carried_by_its_support_alone(bench):
    bench.run(bench.told, 0.3)
    touching = bench.touching()
    np.testing.assert_allclose(touching.elsewhere, [0.0, 0.0, 0.4 * GRAVITY], atol=0.05)
    np.testing.assert_allclose(touching.normal_force, 0.0, atol=0.02)
    felt = touching.normal_force > 1e-3  # [N], or it is no contact
    assert not felt.all()
    for places in (touching.positions, touching.normals):
        np.testing.assert_array_equal(np.isnan(places), np.tile(~felt, (3, 1)).T)
    assert bench.grasp() is None and bench.height == pytest.approx(0.2, abs=1e-3)


@pytest.mark.parametrize("pushed", [True, False])
def test_a_wrench_acts_at_the_objects_middle_in_the_world(bench, pushed):
    """Far from everything: v = F t / m, ω = M t / I; its poses are in the palm's frame."""
    bench.remove_support()
    bench.remove_gravity()
    at = bench.model.joint("object").qposadr[0]
    bench.state[1 + at] += 5.0
    wrench = np.zeros((25, 6))
    wrench[:, 1 if pushed else 5] = 1.0 if pushed else 1e-3
    poses = bench.run(bench.told, 0.1, wrench)
    assert poses.shape == (25, 7)
    model = bench.model
    speed = bench._forward().qvel[model.joint("object").dofadr[0] :][:6]
    inertia = model.body_inertia[bench._object]
    about = int(np.argmin(np.abs(inertia - np.median(inertia)) < 1e-12))
    due = np.zeros(6)
    due[1 if pushed else 5] = 0.1 / 0.4 if pushed else 1e-4 / inertia[about]
    np.testing.assert_allclose(speed, due, atol=1e-6 * np.abs(due).max())
    data = bench._forward()
    palm = bench.robot.model.body(bench.robot.groups[0].palm_body).name
    R, origin = data.body(palm).xmat.reshape(3, 3), data.body(palm).xpos
    place = R.T @ (data.body("object").xpos - origin)
    np.testing.assert_allclose(poses[-1, :3], place, atol=1e-3)
    turned = np.zeros(9)
    mujoco.mju_quat2Mat(turned, poses[-1, 3:])
    np.testing.assert_allclose(
        R @ turned.reshape(3, 3), data.body("object").xmat.reshape(3, 3), atol=1e-3
    )


def test_servos_are_led_evenly_to_where_they_are_told_and_what_is_saved_comes_back(bench):
    robot, before = bench.robot, bench.q
    np.testing.assert_array_equal(before, bench.told)
    kept = bench.saved()
    told = bench.told.copy()
    told[robot.arm[0]] += 0.05
    bench.run(told, 0.4)
    there, speed = bench.q, bench._forward().qvel[0]
    assert speed == pytest.approx(0.05 / 0.4, rel=0.1)  # still as fast as it was led
    assert there[0] == pytest.approx(told[0], abs=0.02) and there[0] < told[0] - 1e-4
    np.testing.assert_array_equal(bench.told, told)
    bench.run(told, 0.5)
    assert bench.q[0] == pytest.approx(told[0], abs=1e-3)
    again = bench.q
    for _ in range(2):  # what was saved is a copy, each time
        bench.told = before.copy()
        bench.restore(kept)
        np.testing.assert_array_equal(bench.q, before)
        bench.run(told, 0.4)
        bench.run(told, 0.5)
        np.testing.assert_array_equal(bench.q, again)


def test_a_bench_feels_contacts_where_and_as_they_press(bench, scene, grasp):
    joints = [j for each in bench.robot.flexion for j in each]
    for _ in range(20):
        told = bench.told.copy()
        told[joints] = bench.q[joints] + 0.5 / bench.kp[joints]
        bench.run(told, 0.05)
    touching, felt = bench.touching(), bench.grasp()
    np.testing.assert_allclose(touching.positions, grasp.positions, atol=3e-3)
    np.testing.assert_allclose(touching.normals, grasp.normals, atol=0.1)
    np.testing.assert_allclose(np.linalg.norm(touching.normals, axis=1), 1.0)
    assert (touching.normal_force > 3.0).all()
    lengths = np.linalg.norm(touching.forces, axis=1)
    assert (touching.normal_force > 0.85 * lengths).all()
    centers = bench.robot.centers(bench.q)
    for contact, force, place, center in zip(
        felt.contacts, touching.forces, touching.positions, centers, strict=True
    ):
        due = [*-force, *np.cross(place - center, -force)]  # on the tip, about its centre
        np.testing.assert_allclose(contact.wrench, due, atol=1e-12)
    np.testing.assert_array_equal(felt.q, bench.q)
    pressed = Touching(np.full((1, 3), np.nan), np.full((1, 3), np.nan), np.zeros((1, 3)), None)
    assert pressed.normal_force.tolist() == [0.0]


def test_servos_of_the_bench_are_those_of_the_robot(bench):
    robot, model = bench.robot, bench.model
    for j, name in enumerate(robot.joints):
        servo = next(
            i for i in range(model.nu) if model.actuator_trnid[i, 0] == model.joint(name).id
        )
        assert bench.kp[j] == model.actuator_gainprm[servo, 0]
        assert bench.strength[j] == model.actuator_forcerange[servo, 1]
    assert model.opt.noslip_iterations == 2 and model.opt.timestep == 0.004


@pytest.mark.parametrize(("deep", "refused"), [(0.9e-3, False), (1.1e-3, True)])
def test_a_link_may_be_a_millimetre_in_the_object(scene, grasp, deep, refused):
    """The object is moved into a fingertip along its normal."""
    contact = grasp.contacts[0]
    moved = np.array(scene.position) + deep * contact.normal * [1.0, 1.0, 0.0]
    inside = hg.Scene(object=scene.object, position=tuple(moved))
    physics = Physics(support="pedestal")
    if refused:
        with pytest.raises(InputError, match=r"tip is 1\.\d mm in the object"):
            Bench(inside, grasp, physics)
    else:
        Bench(inside, grasp, physics)
