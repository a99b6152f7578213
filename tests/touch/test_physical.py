"""The physical probe: what it feels is what is there, and what goes wrong is told by its reason."""

import pickle
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import hqp_grasp as hg
from hqp_grasp.experiments.record import balanced
from hqp_grasp.touch import physical
from hqp_grasp.touch.physical import payload, weight
from hqp_grasp.world.imperfections import FAULTS, PRESETS, Fault, SensorErrors

CONVERGED_FORCE = 0.001
CONVERGED_MOMENT = 0.002

POSTURE = np.array([0.62, 1.12, -0.73, 1.96, 0.63, -0.41, 0.49, 0.21, 1.01, 0.99, 0.98])
AWAY = np.array([0.62, 0.5, -0.73, 1.96, 0.63, -0.41, 0.49, 0.21, 1.01, 0.99, 0.98])
FELT = {"stiff": (0.02, 0.1), "medium": (0.05, 0.35), "default": (0.2, 1.4)}  # [mm], [°] at 1 N
PLACE = 0.5e-3  # [m] a contact in the world: coupling and servos bend, too
STEADY = 0.1  # [N] of 1 N


@pytest.fixture(scope="module")
def scene():
    return hg.Scene(object=hg.Cylinder(0.05))


def touch(scene, physics=None, force=1.0, **settings):
    hand = hg.SimulatedHand(scene, physics, **settings)
    hand.place(POSTURE)
    return hand, hg.PhysicalProbe(hand, scene.articulated, force).touch(POSTURE)


def test_before_the_first_touch_no_time_has_passed_and_afterwards_it_is_the_hand_s(scene):
    hand = hg.SimulatedHand(scene)
    hand.place(POSTURE)
    probe = hg.PhysicalProbe(hand, scene.articulated)
    assert probe.time == -np.inf
    probe.touch(POSTURE)
    assert probe.time == pytest.approx(hand.wait(0.0).time[-1], abs=0.01)


def degrees(a, b):
    return np.degrees(2.0 * np.arcsin(np.linalg.norm(a - b, axis=-1) / 2.0))


# ---------------------------------------------------------------- what is felt is what is


@pytest.mark.parametrize("contact", FELT)
def test_a_sample_without_noise_tells_the_contact_as_mujoco_has_it(scene, contact):
    hand, felt = touch(scene, hg.Physics(contact), links="pass")
    assert isinstance(felt, hg.Grasp)
    wrench = hand.wait(0.5).wrench[-1]
    truth = hand.truth()
    pushed = wrench - weight(payload(scene.articulated), truth.R_world_tip)
    for i, R in enumerate(truth.R_world_tip):
        np.testing.assert_allclose(R @ pushed[i, :3], truth.forces[i], atol=1e-3)
        position, normal = hg.sense(pushed[i], 0.008)
        true = R.T @ truth.grasp.contacts[i].normal
        assert 1e3 * np.linalg.norm(position + 0.008 * true) < FELT[contact][0]
        assert degrees(normal, true) < FELT[contact][1]


@pytest.mark.parametrize("support", ["fixed", "pedestal"])
def test_the_grasp_felt_is_the_one_that_is(scene, support):
    hand, felt = touch(scene, hg.Physics(support=support), links="pass")
    truth = hand.truth()
    assert isinstance(felt, hg.Grasp)
    np.testing.assert_allclose(felt.positions, truth.grasp.positions, atol=PLACE)
    assert degrees(felt.normals, truth.grasp.normals).max() < FELT["medium"][1]
    np.testing.assert_allclose(np.linalg.norm(truth.forces, axis=1), 1.0, atol=STEADY)
    wrenches = np.array([contact.wrench[:3] for contact in felt.contacts])
    np.testing.assert_allclose(wrenches, truth.forces, atol=STEADY)
    assert truth.moved == 0.0 if support == "fixed" else 0.0 < truth.moved < 5e-3


def test_it_touches_where_the_geometric_probe_does(scene):
    _, felt = touch(scene, links="pass")
    exact = hg.GeometricProbe(scene, "pass").touch(POSTURE)
    np.testing.assert_allclose(felt.positions, exact.positions, atol=PLACE)
    np.testing.assert_allclose(felt.q, exact.q, atol=0.01)


@pytest.mark.parametrize("contact", ["medium", "stiff"])
def test_closing_is_guarded(scene, contact):
    hand, felt = touch(scene, hg.Physics(contact), links="pass")
    assert isinstance(felt, hg.Grasp)
    assert hand.worst["force [N]"] < {"medium": 2.0, "stiff": 3.5}[contact]
    assert 0.0 < hand.worst["speed share"] <= 1.0
    assert 0.0 < hand.worst["torque share"] <= 1.0
    assert hand.worst["range [rad]"] == 0.0


def test_the_second_touch_begins_where_the_first_ended(scene):
    hand, first = touch(scene, links="pass")
    second = hg.PhysicalProbe(hand, scene.articulated).touch(first.q)
    np.testing.assert_allclose(second.positions, first.positions, atol=PLACE)


def test_bias_and_weight_are_none_of_what_is_felt(scene):
    biased = hg.Imperfections(force_bias=0.5, torque_bias=5e-3)
    _, plain = touch(scene, links="pass")
    _, felt = touch(scene, hg.Physics(imperfections=biased), links="pass")
    np.testing.assert_allclose(felt.positions, plain.positions, atol=1e-4)
    np.testing.assert_allclose(felt.normals, plain.normals, atol=5e-3)


# ---------------------------------------------------------------- misses


def test_fingers_that_close_on_nothing_say_so(scene):
    hand = hg.SimulatedHand(scene, links="pass")
    hand.place(AWAY)
    felt = hg.PhysicalProbe(hand, scene.articulated).touch(AWAY)
    assert isinstance(felt, hg.Missed)
    assert felt.reason in (hg.Miss.NO_TOUCH, hg.Miss.OWN_LINK, hg.Miss.OTHER_LINK)


def test_a_miss_ends_where_the_touch_began_with_open_fingers(scene):
    hand = hg.SimulatedHand(scene, links="pass")
    hand.place(POSTURE)
    before = hand.wait(0.0).q[-1]
    felt = hg.PhysicalProbe(hand, scene.articulated).touch(AWAY)
    assert isinstance(felt, hg.Missed)
    after = hand.wait(0.5).q[-1]
    np.testing.assert_allclose(after[:8], before[:8], atol=1e-3)
    assert (after[8:] < POSTURE[8:] - 0.3).all()


def test_postures_to_pass_are_passed_with_open_fingers(scene):
    class Noting(hg.SimulatedHand):
        moves = ()

        def move(self, q, duration):
            self.moves += (q.copy(),)
            return super().move(q, duration)

    hand = Noting(scene, links="pass")
    hand.place(POSTURE)
    higher = POSTURE.copy()
    higher[1] -= 0.1
    felt = hg.PhysicalProbe(hand, scene.articulated).touch(POSTURE, via=[higher, POSTURE])
    assert isinstance(felt, hg.Grasp)
    _, first, second, last = hand.moves
    for passed, asked in zip((first, second, last), (higher, POSTURE, POSTURE), strict=True):
        np.testing.assert_array_equal(passed[:8], asked[:8])
        assert (passed[8:] < asked[8:] - 0.3).all()


def test_a_trial_passes_what_the_controller_wants_passed(scene, monkeypatch):
    _, first = touch(scene, links="pass")
    passed = []

    def touch_twice(probe, q_target, via=()):
        passed.append([q.copy() for q in via])
        return first if len(passed) < 3 else hg.Missed(hg.Miss.NO_TOUCH, "finger_1")

    monkeypatch.setattr(hg.PhysicalProbe, "touch", touch_twice)
    hg.Trial(scene, hg.stack_of("fmk"), 25, probe="physical", start=first).run(0)
    (again,) = [via for via in passed if via]
    np.testing.assert_array_equal(again, [first.q])


def test_an_object_in_the_way_stops_the_hand_below_its_force_limit(scene):
    hand = hg.SimulatedHand(scene)
    hand.place(AWAY)
    pushed_into = POSTURE.copy()
    pushed_into[1] += 0.35
    felt = hg.PhysicalProbe(hand, scene.articulated).touch(pushed_into)
    assert isinstance(felt, hg.Missed)
    assert hand.worst["force [N]"] <= hand.limits.force
    assert hand.worst["speed share"] <= 1.0


@pytest.mark.parametrize(
    ("kind", "reasons"),
    [
        ("dropout", {hg.Miss.SENSOR}),
        ("freeze", {hg.Miss.SENSOR}),
        ("stall", {hg.Miss.OTHER_LINK, hg.Miss.SENSOR}),
    ],
)
def test_what_breaks_before_the_touch_is_told_and_hurts_nobody(scene, kind, reasons):
    fault = Fault(kind, finger=1, begin=0.9)
    physics = hg.Physics(imperfections=hg.Imperfections(faults=(fault,)))
    hand, felt = touch(scene, physics, links="pass")
    assert isinstance(felt, hg.Missed)
    assert felt.reason in reasons and felt.where == "finger_2"
    assert hand.worst["force [N]"] <= hand.limits.force


@pytest.mark.parametrize("begin", [0.5, 1.0, 1.4, 1.6, 1.8, 2.0])
@pytest.mark.parametrize("kind", FAULTS)
def test_whenever_something_breaks_the_answer_is_a_grasp_or_a_miss_within_the_limits(
    scene, kind, begin
):
    fault = Fault(kind, finger=0, begin=begin, duration=0.002 if kind == "spike" else np.inf)
    physics = hg.Physics(imperfections=hg.Imperfections(faults=(fault,)))
    hand, felt = touch(scene, physics, links="pass")
    assert isinstance(felt, hg.Grasp | hg.Missed)
    assert hand.worst["force [N]"] <= hand.limits.force
    if kind == "spike":
        assert isinstance(felt, hg.Grasp)
        error = degrees(felt.normals, hand.truth().grasp.normals)
        assert error.max() < 1.0


@pytest.mark.parametrize(("lower", "told"), [(0.046, True), (0.04, False)])
def test_what_faces_up_at_the_tables_height_is_the_table(lower, told):
    scene = hg.Scene(object=hg.Cylinder(0.05, height=0.1))  # its top stands for a table here
    hand, q = hg.SimulatedHand(scene, links="pass"), POSTURE.copy()
    q[1] -= lower
    for table, met in ((0.25, told), (0.24, False)):
        hand.place(q)
        felt = hg.PhysicalProbe(hand, scene.articulated, table=table).touch(q)
        assert (felt == hg.Missed(hg.Miss.TABLE, "finger_1")) if met else isinstance(felt, hg.Grasp)


def test_a_hand_does_not_move_while_a_sensor_is_silent(scene):
    fault = Fault("dropout", finger=2, begin=0.2, duration=0.6)
    hand = hg.SimulatedHand(scene, hg.Physics(imperfections=hg.Imperfections(faults=(fault,))))
    hand.wait(0.3)
    before, q = hand.wait(0.0).q[-1], hand.robot.home.copy()
    q[:4] += 0.1
    hand.move(q, 0.3)
    silent = hand.wait(0.3)
    assert silent.fault == "the sensor of finger_3 does not answer"
    np.testing.assert_allclose(silent.q, np.tile(before, (len(silent.q), 1)), atol=1e-4)
    hand.wait(0.3)
    left = hand.move(q, 0.3)
    while left > -0.2:
        arrived = hand.wait(0.4)
        left -= 0.4
    assert arrived.fault == "" and np.abs(arrived.q[-1] - q).max() < 1e-2


def test_a_silent_sensor_is_waited_for_but_not_for_ever(scene):
    for duration, heard in ((1.0, True), (np.inf, False)):
        fault = Fault("freeze", finger=0, begin=0.0, duration=duration)
        physics = hg.Physics(imperfections=hg.Imperfections(faults=(fault,)))
        _, felt = touch(scene, physics, links="pass")
        assert isinstance(felt, hg.Grasp) if heard else felt.reason is hg.Miss.SENSOR


@pytest.mark.parametrize("seed", range(3))
def test_a_bump_at_full_speed_stays_below_the_force_limit(scene, seed):
    hand = hg.SimulatedHand(scene, links="pass")
    hand.place(AWAY)
    q = POSTURE.copy()
    q[1] += 0.3
    q[:7] += np.random.default_rng(seed).uniform(-0.1, 0.1, 7)
    left, fault = hand.move(q, 0.1), ""
    while left > 0.0 and not fault:
        fault = hand.wait(0.5).fault
        left -= 0.5
    assert "at finger_" in fault or "does not follow" in fault
    assert 1.0 < hand.worst["force [N]"] < hand.limits.force
    standing = hand.wait(0.3).velocity[-1]
    assert np.abs(standing / hand.limits.speed).max() < 0.01


def test_joints_stay_off_the_ends_of_their_ranges(scene):
    hand = hg.SimulatedHand(scene, hg.Physics(imperfections=hg.Imperfections(servo_error=1e-3)))
    for end in (hand.limits.lower, hand.limits.upper):
        q = hand.robot.home.copy()
        q[8:] = end[8:]
        hand.wait(hand.move(q, 0.5) + 0.2)
    assert hand.worst["range [rad]"] == 0.0


# ---------------------------------------------------------------- imperfections


def errors(**about):
    return SensorErrors(hg.Imperfections(**about), 3, np.arange(11) < 7, np.random.default_rng(5))


def test_each_sensor_error_is_what_its_name_says():
    time, still = np.linspace(0.0, 60.0, 4001), np.zeros((4001, 3, 6))
    noise = errors(force_noise=0.02, torque_noise=2e-4).wrench(time, still)
    np.testing.assert_allclose(noise.std(axis=0)[:, :3], 0.02, rtol=0.1)
    np.testing.assert_allclose(noise.std(axis=0)[:, 3:], 2e-4, rtol=0.1)
    bias = errors(force_bias=0.1).wrench(time, still)
    assert np.ptp(bias, axis=0).max() == 0.0 and 0.02 < np.abs(bias[0, :, :3]).mean() < 0.3
    drift = errors(torque_drift=1e-4).wrench(time, still)
    assert np.abs(drift[0]).max() == 0.0 and 2e-5 < np.abs(drift[-1, :, 3:]).mean() < 3e-4
    steps = errors(force_step=0.1).wrench(time, still + 0.26)
    np.testing.assert_allclose(steps[..., :3], 0.3)
    np.testing.assert_allclose(steps[..., 3:], 0.26)


def test_encoders_err_by_a_constant_and_by_their_step():
    about = errors(encoder_offset=0.01, encoder_step=1e-3)
    q = np.full(11, 0.5)
    read = about.joints(q)
    assert 1e-3 < np.abs(read - q).mean() < 0.03
    np.testing.assert_allclose(read / 1e-3, np.round(read / 1e-3), atol=1e-9)


def test_an_arm_off_leaves_the_hand_right():
    offset = errors(arm_offset=0.01).encoder_offset
    assert (offset[:7] != 0.0).all() and (offset[7:] == 0.0).all()


def test_the_preset_differs_from_perfect_in_every_value_with_a_unit():
    preset = PRESETS["loadcell"]
    assert hg.Imperfections.preset("loadcell") is not None
    assert hg.Imperfections.preset(None) == hg.Imperfections()
    assert preset.force_noise > 0.0 and preset.latency > 0.0 and preset.encoder_offset > 0.0
    assert replace(preset, force_noise=0.0) == hg.Imperfections.preset("loadcell", force_noise=0.0)
    with pytest.raises(hg.InputError, match="choose one of: loadcell"):
        hg.Imperfections.preset("perfect")


def test_a_contact_tells_the_noise_that_its_sensor_has(scene):
    noisy = hg.Imperfections(force_noise=0.02, torque_noise=2e-4)
    # δ² = 2 (σ_f² + σ_m²/R²)/(F² samples): the tip is weighed, then felt, by 20 samples each; by
    # half as many where a finger does not come to rest.
    for physics, due in ((hg.Physics(imperfections=noisy), 0.0101), (None, 0.0)):
        _, felt = touch(scene, physics, links="pass")
        told = np.sqrt(np.mean([contact.noise**2 for contact in felt.contacts]))
        assert 0.85 * due <= told <= 1.4 * due + 1e-4


def test_a_spike_is_no_noise(scene):
    for begin in (1.6, 1.8, 2.0, 2.2, 2.4):
        fault = Fault("spike", finger=0, begin=begin, duration=0.002)
        about = hg.Imperfections(force_noise=0.02, torque_noise=2e-4, faults=(fault,))
        _, felt = touch(scene, hg.Physics(imperfections=about), links="pass")
        assert max(contact.noise for contact in felt.contacts) < 0.02


def test_latency_delays_what_is_felt(scene):
    late = hg.Physics(imperfections=hg.Imperfections(latency=0.02))
    prompt, delayed = hg.SimulatedHand(scene), hg.SimulatedHand(scene, late)
    q = prompt.robot.home.copy()
    q[8] += 0.3
    read = []
    for hand in (prompt, delayed):
        hand.move(q, 0.3)
        read.append(hand.wait(0.3).wrench[:, 0])
    np.testing.assert_array_equal(read[0][:-2], read[1][2:])


def test_backlash_keeps_a_joint_behind_by_half_the_play(scene):
    hand = hg.SimulatedHand(scene, hg.Physics(imperfections=hg.Imperfections(backlash=0.02)))
    q = hand.robot.home.copy()
    q[3] += 0.1
    hand.wait(hand.move(q, 0.5))
    np.testing.assert_allclose(hand.wait(0.5).q[-1][3], q[3] - 0.01, atol=1e-4)


# ---------------------------------------------------------------- trials


def trial(scene, preset=None):
    return hg.Trial(scene, hg.stack_of("fmk"), 12, links="pass", probe="physical", preset=preset)


def test_a_trial_balances_the_grasp_by_touch_alone(scene):
    record = trial(scene).run((3, 1))
    assert record.converged_at is not None
    assert record.rows[-1]["eps_f_true"] < 1e-3 and record.rows[-1]["eps_m_true"] < 4e-6


def test_a_trial_is_the_same_to_the_last_bit_in_another_process(scene):
    code = (
        "import sys, pickle, hqp_grasp as hg; "
        "scene = hg.Scene(object=hg.Cylinder(0.05)); "
        "trial = hg.Trial(scene, hg.stack_of('fmk'), 3, links='pass', "
        "probe='physical', preset='loadcell'); "
        "sys.stdout.buffer.write(pickle.dumps([g.q for g in trial.run((3, 1)).grasps]))"
    )
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    here = hg.Trial(
        scene, hg.stack_of("fmk"), 3, links="pass", probe="physical", preset="loadcell"
    ).run((3, 1))
    for one, same in zip(here.grasps, pickle.loads(other.stdout), strict=True):
        np.testing.assert_array_equal(one.q, same)


RECOVERIES = {
    "dropout": "the same again",
    "freeze": "the same again",
    "spike": None,
    "stall": "palm back by 10 mm",
}


@pytest.mark.parametrize("kind", FAULTS)
def test_a_trial_goes_on_after_a_fault_and_its_rows_tell_how(scene, kind):
    # The sensor is out as the fingers close for the first step; the joint is as the hand opens.
    begin, lasts = (4.2, 0.002) if kind == "spike" else (4.2, 4.0)
    about = hg.Imperfections(faults=(Fault(kind, 1, begin, lasts),))
    broken = replace(trial(scene), probe=hg.Physics(imperfections=about))
    record = broken.run((3, 1))
    reactions = {row["reaction"] for row in record.rows} - {None}
    assert RECOVERIES[kind] in (reactions or {None})
    assert record.converged_at is not None
    assert record.rows[-1]["peak_force"] < 15.0 and record.rows[-1]["peak_speed"] <= 1.0


def test_an_object_that_is_knocked_away_is_given_up_with_a_reason(scene):
    class Knocked:
        """Takes the object away after the second touch."""

        def __init__(self, hand):
            self.hand, self.touches = hg.PhysicalProbe(hand, scene.articulated), 0

        def touch(self, q_target):
            self.touches += 1
            if self.touches == 3:
                free = self.hand.driver
                free._state[1 + free.model.joint("object").qposadr[0] + 1] += 0.5
            return self.hand.touch(q_target)

    hand = hg.SimulatedHand(scene, hg.Physics(support="pedestal"), links="pass")
    hand.place(POSTURE)
    first = hg.PhysicalProbe(hand, scene.articulated).touch(POSTURE)
    record = hg.Trial(scene, hg.stack_of("fmk"), 25, start=first).run(0, Knocked(hand))
    ended = [row["outcome"] for row in record.rows if row["outcome"]]
    assert re.match(r"gave up: \d+ misses from one grasp, the last: a finger", ended[-1])
    assert [row["reaction"] for row in record.rows if row["reaction"]][-1] == "gave up"


def test_where_noise_has_a_floor_balance_is_judged_by_it(scene):
    record = trial(scene, "loadcell").run((3, 1))
    plain = trial(scene).run((3, 1))
    last, exact = record.rows[-1], plain.rows[-1]
    assert exact["floor_f"] < 1e-3 * CONVERGED_FORCE
    assert exact["floor_m"] < 1e-3 * CONVERGED_MOMENT**2
    floor = record.grasps[-1].floor
    assert (last["floor_f"], last["floor_m"]) == floor
    rows = {
        "eps_f": np.array([4.1, 3.9, 3.9, np.nan]) * floor[0],
        "eps_m": np.array([3.9, 3.9, 4.1, 0.0]) * floor[1],
        "floor_f": np.full(4, floor[0]),
        "floor_m": np.full(4, floor[1]),
    }
    assert balanced(rows).tolist() == [False, True, False, False]
    exactly = {name: rows[name] for name in ("eps_f", "eps_m")}
    assert not balanced(exactly).any()


def test_a_preset_needs_a_hand_that_can_be_imperfect(scene):
    with pytest.raises(hg.InputError, match="needs probe='physical'"):
        hg.Trial(scene, hg.stack_of("fmk"), preset="loadcell")
    with pytest.raises(hg.InputError, match="choose one of: geometric, physical"):
        hg.Trial(scene, hg.stack_of("fmk"), probe="real")


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"contact": "soft"}, "stiff, medium, default"),
        ({"support": "air"}, "fixed, pedestal, table"),
        ({"mass": 0.0}, "Physics.mass"),
        ({"imperfections": "loadcell"}, "must be Imperfections"),
    ],
)
def test_a_physics_that_cannot_be_is_refused(wrong, words):
    with pytest.raises(hg.InputError, match=words):
        hg.Physics(**wrong)


def test_a_hand_in_the_object_is_refused(scene):
    inside = POSTURE.copy()
    inside[3] -= 0.3
    with pytest.raises(hg.InputError, match="is in the object, with open fingers"):
        hg.SimulatedHand(scene).place(inside)


@pytest.mark.parametrize("beyond", [physical.BEYOND_NOISE, 0.0])
def test_noise_of_the_sensors_is_not_taken_for_touch(scene, monkeypatch, beyond):
    """What counts as touch follows from the noise heard in free air; else fingers stop short."""
    monkeypatch.setattr(physical, "BEYOND_NOISE", beyond)
    noisy = hg.Physics(timestep=0.004, imperfections=hg.Imperfections(force_noise=0.04))
    rngs = [np.random.default_rng(seed) for seed in range(3)]
    felt = [touch(scene, noisy, links="pass", rng=rng)[1] for rng in rngs]
    assert all(isinstance(v, hg.Grasp) for v in felt) == (beyond > 0.0)


# ---------------------------------------------------------------- another arm


@pytest.fixture(scope="module")
def torso():
    return hg.Scene(robot="umass_torso", object=hg.Cylinder(0.065))


def test_an_arm_that_touches_nothing_stands_where_kinematics_have_it(torso):
    hand, robot = hg.SimulatedHand(torso), torso.articulated
    read = hand.wait(0.1)
    assert robot.idle.sum() == 11
    np.testing.assert_array_equal(read.q[:, robot.idle], np.tile(robot.home[robot.idle], (10, 1)))
    assert not read.velocity[:, robot.idle].any()
    names = [robot.model.body(i).name for i in range(1, robot.model.nbody)]
    places = dict(zip(names, robot.bodies(robot.home)[0][1:], strict=True))
    hand.truth()  # where bodies are, now
    for name in names:
        if name.startswith("left"):
            np.testing.assert_allclose(hand._data.body(name).xpos, places[name], atol=1e-12)


def test_what_asks_that_arm_to_move_is_told_that_it_does_not(torso):
    hand, robot = hg.SimulatedHand(torso), torso.articulated
    hand.move(robot.home + 0.2 * robot.idle, 0.5)
    assert re.search(r"something holds left_\w+: it does not follow", hand.wait(0.9).fault)


def test_the_torso_feels_by_force_what_it_touches_by_geometry(torso):
    probe = hg.GeometricProbe(torso)
    exact = hg.Start().draw(torso, lambda _: probe, np.random.default_rng(0)).grasp
    hand = hg.SimulatedHand(torso)
    hand.place(exact.q)
    felt = hg.PhysicalProbe(hand, torso.articulated).touch(exact.q)
    assert isinstance(felt, hg.Grasp)
    np.testing.assert_allclose(felt.positions, exact.positions, atol=PLACE)
    idle = torso.articulated.idle
    np.testing.assert_allclose(felt.q[idle], exact.q[idle], atol=1e-12)
