"""Errors of sensors, encoders and servos: how large, of which axis, from when until when."""

import dataclasses

import numpy as np
import pytest

import hqp_grasp as hg
from hqp_grasp.world.imperfections import PRESETS, Fault, Imperfections, SensorErrors

SPIKE = 50.0

K, N = 400, 500  # tips and joints, so that one run shows a spread
RATE = 0.01  # [s]


def errors(k=K, n=N, arm=200, **about):
    return SensorErrors(Imperfections(**about), k, np.arange(n) < arm, np.random.default_rng(3))


def read(about, time, true=None):
    k = len(about._bias)
    return about.wrench(time, np.zeros((len(time), k, 6)) if true is None else true)


@pytest.mark.parametrize("kind", ["noise", "bias"])
@pytest.mark.parametrize(("of", "axes"), [("force", slice(0, 3)), ("torque", slice(3, 6))])
def test_each_of_force_and_torque_errs_by_its_own_standard_deviation(kind, of, axes):
    felt = read(errors(**{f"{of}_{kind}": 0.2}), np.zeros(4))
    others = np.delete(felt, np.r_[axes], axis=2)
    assert (others == 0.0).all()
    assert felt[..., axes].std() == pytest.approx(0.2, rel=0.1)
    changes = np.ptp(felt[..., axes], axis=0)
    assert (changes > 0.0).all() if kind == "noise" else (changes == 0.0).all()


@pytest.mark.parametrize(("of", "axes"), [("force", slice(0, 3)), ("torque", slice(3, 6))])
def test_drift_is_steady_and_said_by_the_minute(of, axes):
    felt = read(errors(**{f"{of}_drift": 0.2}), np.array([0.0, 30.0, 60.0]))
    assert (felt[0] == 0.0).all() and (np.delete(felt, np.r_[axes], axis=2) == 0.0).all()
    np.testing.assert_allclose(felt[2], 2.0 * felt[1])
    assert felt[2][:, axes].std() == pytest.approx(0.2, rel=0.1)


@pytest.mark.parametrize(("of", "axes"), [("force", slice(0, 3)), ("torque", slice(3, 6))])
def test_a_step_rounds_what_all_other_errors_left(of, axes):
    true = np.random.default_rng(0).normal(size=(3, K, 6))
    felt = read(errors(**{f"{of}_step": 0.05, f"{of}_bias": 0.2}), np.zeros(3), true)
    biased = read(errors(**{f"{of}_bias": 0.2}), np.zeros(3), true)
    np.testing.assert_allclose(felt[..., axes] / 0.05, np.round(felt[..., axes] / 0.05), atol=1e-9)
    assert np.abs(felt - biased).max() == pytest.approx(0.025, rel=0.01)
    np.testing.assert_array_equal(np.delete(felt - true, np.r_[axes], axis=2), 0.0)


def test_a_perfect_sensor_says_what_is_and_no_sensor_spoils_what_it_is_told():
    true = np.random.default_rng(1).normal(size=(3, K, 6))
    np.testing.assert_array_equal(read(errors(), np.zeros(3), true), true)
    kept = true.copy()
    faults = tuple(Fault(kind, 0, 0.0) for kind in ("dropout", "spike", "freeze"))
    read(errors(force_noise=1.0, torque_bias=1.0, force_step=0.1, faults=faults), np.zeros(3), true)
    read(errors(faults=faults), np.zeros(3), true)
    np.testing.assert_array_equal(true, kept)


def test_encoders_of_the_arm_err_by_both_offsets_and_round_to_the_nearest_step():
    offset = errors(encoder_offset=0.1, arm_offset=0.3).encoder_offset
    assert offset[:200].std() == pytest.approx(0.4, rel=0.15)
    assert offset[200:].std() == pytest.approx(0.1, rel=0.15)
    q = np.linspace(-1.0, 1.0, N)
    about = errors(encoder_offset=0.1)
    np.testing.assert_array_equal(about.joints(q), q + about.encoder_offset)
    steps = errors(encoder_step=0.01).joints(q)
    np.testing.assert_allclose(steps / 0.01, np.round(steps / 0.01), atol=1e-9)
    assert np.abs(steps - q).max() <= 0.005 + 1e-12


def test_each_move_misses_anew_by_the_servos_standard_deviation():
    about = errors(servo_error=0.2)
    first, second = about.miss(4000), about.miss(4000)
    assert first.std() == pytest.approx(0.2, rel=0.1) and (first != second).all()
    np.testing.assert_array_equal(errors().miss(5), np.zeros(5))


# ---------------------------------------------------------------- faults

TIME = RATE * np.arange(1, 101)


def faulty(kind, **lasting):
    true = np.random.default_rng(2).normal(size=(100, 3, 6))
    about = errors(3, 4, 2, faults=(Fault(kind, 1, 0.305, **lasting),))
    return read(about, TIME, true), true, about


@pytest.mark.parametrize("kind", ["dropout", "freeze", "spike"])
def test_a_fault_is_of_one_finger_from_when_it_begins_while_it_lasts(kind):
    felt, true, _ = faulty(kind, duration=0.2)
    changed = (felt != true).any(axis=2)
    assert not changed[:, [0, 2]].any()
    times = TIME[changed[:, 1]]
    first, last = {"dropout": (0.31, 0.5), "freeze": (0.32, 0.5), "spike": (0.31, 0.31)}[kind]
    assert times[0] == pytest.approx(first) and times[-1] == pytest.approx(last)
    endless, _, _ = faulty(kind)
    assert (endless[-1, 1] == true[-1, 1]).all() == (kind == "spike")


def test_a_dropout_reads_zero_a_spike_adds_along_z_and_a_freeze_repeats_one_sample():
    felt, _, _ = faulty("dropout", duration=0.2)
    assert (felt[30:50, 1] == 0.0).all()
    felt, true, _ = faulty("spike", duration=0.2)
    np.testing.assert_allclose((felt - true)[30, 1], [0, 0, SPIKE, 0, 0, 0])
    felt, true, about = faulty("freeze")
    np.testing.assert_array_equal(felt[30:, 1], np.tile(true[30, 1], (70, 1)))
    later = read(about, 1.0 + TIME, true + 1.0)
    np.testing.assert_array_equal(later[:, 1], np.tile(true[30, 1], (100, 1)))


def test_a_stall_leaves_the_sensors_alone_and_is_told_by_finger():
    felt, true, about = faulty("stall", duration=0.2)
    np.testing.assert_array_equal(felt, true)
    at = (0.3, 0.31, 0.5, 0.51)
    assert [about.stalled(time) for time in at] == [[], [1], [1], []]
    assert errors(faults=(Fault("dropout", 1, 0.0),)).stalled(1.0) == []


# ---------------------------------------------------------------- values


def test_everything_is_off_unless_it_is_said():
    plain = Imperfections()
    for at in dataclasses.fields(plain):
        assert getattr(plain, at.name) == (() if at.name == "faults" else 0.0)


def test_the_preset_is_the_small_load_cell_that_its_comments_tell_of():
    cell = PRESETS["loadcell"]
    assert cell.force_step == 1 / 160 and cell.torque_step == 1e-3 / 32
    assert cell.force_noise == pytest.approx(3 * cell.force_step, rel=0.1)
    for name in ("noise", "bias", "drift"):  # at 1 cm
        force, torque = getattr(cell, f"force_{name}"), getattr(cell, f"torque_{name}")
        assert torque == pytest.approx(0.01 * force)
    assert cell.force_drift == cell.force_noise and cell.force_bias == 5 * cell.force_noise
    assert cell.latency == 2e-3
    assert 1e3 * cell.encoder_offset == pytest.approx(2.0, rel=0.15)  # [mm] at 1 m
    assert 2 * np.pi / cell.encoder_step == pytest.approx(40960)
    assert (cell.servo_error, cell.gravity_error) == (1e-3, 0.02)
    assert (cell.backlash, cell.arm_offset, cell.faults) == (0.0, 0.0, ())


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (lambda: Imperfections(force_noise=-0.1), "Imperfections.force_noise"),
        (lambda: Imperfections(latency=np.nan), "Imperfections.latency"),
        (lambda: Imperfections(gravity_error=np.inf), "Imperfections.gravity_error"),
        (lambda: Imperfections(faults=[Fault("stall", 0, 0.0)]), "must be a tuple of Fault"),
        (lambda: Imperfections(faults=("stall",)), "must be a tuple of Fault"),
        (lambda: Fault("drop", 0, 0.0), "unknown fault 'drop'"),
        (lambda: Fault("stall", -1, 0.0), "Fault.finger"),
        (lambda: Fault("stall", 0, "now"), "Fault.begin"),
        (lambda: Fault("stall", 0, np.nan), "Fault.begin"),
        (lambda: Fault("stall", 0, 0.0, np.nan), "Fault.duration"),
        (lambda: Fault("stall", 0, 0.0, 0.0), "Fault.duration"),
    ],
)
def test_an_imperfection_that_cannot_be_is_refused_by_name(wrong, words):
    with pytest.raises(hg.InputError, match=words):
        wrong()


def test_a_compensation_may_err_to_either_side():
    assert Imperfections(gravity_error=-0.02).gravity_error == -0.02


@pytest.mark.parametrize("kind", ["spike", "freeze", "dropout"])
def test_before_and_after_its_time_a_fault_is_nothing_and_in_it_its_finger_alone_is_broken(kind):
    fault = Fault(kind, 1, begin=1.0, duration=0.5)
    sensors = SensorErrors(
        Imperfections(faults=(fault,)), 3, np.zeros(11, bool), np.random.default_rng(0)
    )

    def said(begin):
        time = begin + 0.01 * np.arange(10)
        true = time[:, None, None] * np.ones((10, 3, 6))
        return true, sensors.wrench(time, true)

    for begin in (0.0, 0.9, 1.5, 9.0):  # up to 0.99, and from 1.5 on
        true, felt = said(begin)
        np.testing.assert_array_equal(felt, true)
    for begin in (1.0, 1.2, 1.4):
        true, felt = said(begin)
        np.testing.assert_array_equal(felt[:, [0, 2]], true[:, [0, 2]])
        if kind == "dropout":
            assert not felt[:, 1].any()
        elif kind == "freeze":
            np.testing.assert_array_equal(felt[:, 1], 1.0)  # what it said as it broke
        else:
            off = felt - true
            assert off[0, 1, 2] == 50.0 and np.count_nonzero(off) == 1  # [N] one sample of it
