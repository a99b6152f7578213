"""Readings that say nothing: whatever a driver tells, a touch ends in a grasp or a reason."""

from dataclasses import replace

import numpy as np
import pytest

import hqp_grasp as hg

POSTURE = np.array([0.62, 1.12, -0.73, 1.96, 0.63, -0.41, 0.49, 0.21, 1.01, 0.99, 0.98])


@pytest.fixture(scope="module")
def scene():
    return hg.Scene(object=hg.Cylinder(0.05))


class Spoilt:
    """A good hand, whose readings are spoilt from a moment on [s]."""

    def __init__(self, hand, begin, spoil, duration=np.inf):
        self.hand, self.begin, self.spoil, self.end = hand, begin, spoil, begin + duration
        self.limits, self.rate = hand.limits, hand.rate
        self.stopped = False
        self.kept = hand.wait(0.0)

    def __getattr__(self, call):
        return getattr(self.hand, call)

    def stop(self):
        self.stopped = True
        self.hand.stop()

    def wait(self, duration):
        readings = self.hand.wait(duration)
        if not self.begin <= readings.time[-1] < self.end:
            self.kept = readings
            return readings
        return self.spoil(readings, self.kept)


def with_nan(name, *at):
    def spoil(readings, _):
        array = getattr(readings, name).copy()
        array[(..., *at)] = np.nan
        return replace(readings, **{name: array})

    return spoil


def last_only(readings, _):
    wrench = readings.wrench.copy()
    wrench[-1, 2, 4] = np.nan
    return replace(readings, wrench=wrench)


def same_stamp(readings, _):
    return replace(readings, time=np.full_like(readings.time, readings.time[0]))


def repeated(_, kept):
    return kept


def stamps_alone_advance(readings, kept):
    t = len(readings.time)
    return replace(
        readings,
        q=np.tile(kept.q[-1], (t, 1)),
        velocity=np.tile(kept.velocity[-1], (t, 1)),
        wrench=np.tile(kept.wrench[-1], (t, 1, 1)),
    )


SPOILT = {
    "a force": (with_nan("wrench", 1, 0), "finger_2"),
    "a torque at a tip": (with_nan("wrench", 0, 5), "finger_1"),
    "one sample": (last_only, "finger_3"),
    "all wrenches": (with_nan("wrench"), "finger_1"),
    "an angle": (with_nan("q", 3), "wam_j4"),
    "infinite angles": (lambda r, _: replace(r, q=r.q + np.inf), "wam_j1"),
    "the clock": (with_nan("time"), "time stamps"),
    "one stamp for all": (same_stamp, "time stamps"),
    "the same readings again": (repeated, "time stamps"),
}
MOMENTS = (0.0, 0.3, 0.9, 1.3, 1.8, 2.2)  # [s] before, while it opens, moves, closes, holds


@pytest.mark.parametrize("begin", MOMENTS)
@pytest.mark.parametrize("what", SPOILT)
def test_what_says_nothing_is_a_sensor_that_does_not_answer_and_the_hand_stops(scene, what, begin):
    spoil, where = SPOILT[what]
    hand = hg.SimulatedHand(scene, links="pass")
    hand.place(POSTURE)
    driver = Spoilt(hand, begin, spoil)
    felt = hg.PhysicalProbe(driver, scene.articulated).touch(POSTURE)
    assert isinstance(felt, hg.Missed) and felt.reason is hg.Miss.SENSOR
    assert where in felt.where
    hand.wait(0.3)
    np.testing.assert_allclose(hand.wait(0.1).velocity[-1], 0.0, atol=0.02)


@pytest.mark.parametrize("begin", MOMENTS)
def test_a_hand_whose_readings_stand_still_ends_in_a_reason(scene, begin):
    hand = hg.SimulatedHand(scene, links="pass")
    hand.place(POSTURE)
    felt = hg.PhysicalProbe(Spoilt(hand, begin, stamps_alone_advance), scene.articulated).touch(
        POSTURE
    )
    assert isinstance(felt, hg.Missed)
    assert hand.worst["force [N]"] <= hand.limits.force


def test_a_sensor_that_comes_back_is_waited_for(scene):
    hand = hg.SimulatedHand(scene, links="pass")
    hand.place(POSTURE)
    driver = Spoilt(hand, 0.0, with_nan("wrench", 1), duration=1.0)
    assert isinstance(hg.PhysicalProbe(driver, scene.articulated).touch(POSTURE), hg.Grasp)


@pytest.mark.parametrize("what", ["velocity", "torque"])
def test_what_a_probe_does_not_read_may_be_missing(scene, what):
    hand = hg.SimulatedHand(scene, links="pass")
    hand.place(POSTURE)
    driver = Spoilt(hand, 0.0, with_nan(what))
    assert isinstance(hg.PhysicalProbe(driver, scene.articulated).touch(POSTURE), hg.Grasp)


@pytest.mark.parametrize("what", SPOILT)
def test_feeling_tells_the_same(scene, what):
    spoil, where = SPOILT[what]
    hand = hg.SimulatedHand(scene, links="pass")
    hand.place(POSTURE)
    driver = Spoilt(hand, np.inf, spoil)
    probe = hg.PhysicalProbe(driver, scene.articulated)
    assert isinstance(probe.touch(POSTURE), hg.Grasp)
    assert isinstance(probe.feel(), hg.Grasp)
    driver.begin = 0.0
    felt = probe.feel()
    assert isinstance(felt, hg.Missed) and felt.reason is hg.Miss.SENSOR and where in felt.where


def test_a_sensor_that_freezes_while_the_hand_presses_is_told(scene):
    fault = hg.world.imperfections.Fault("freeze", finger=1, begin=4.0)
    hand = hg.SimulatedHand(scene, hg.Physics(imperfections=hg.Imperfections(faults=(fault,))))
    hand.place(POSTURE)
    probe = hg.PhysicalProbe(hand, scene.articulated)
    assert isinstance(probe.touch(POSTURE), hg.Grasp)
    torque = np.zeros(11)
    torque[8:] = 0.3
    hand.press(torque)
    while hand.wait(0.1).time[-1] < 4.1:
        assert isinstance(probe.feel(), hg.Grasp | hg.Missed)
    assert probe.feel() == hg.Missed(hg.Miss.SENSOR, "finger_2")


def test_readings_need_numbers_of_the_right_shape():
    hand = hg.SimulatedHand(hg.Scene())
    good = hand.wait(0.05)
    for name, value, says in (
        ("q", good.q[:, 0], "Readings.q must have shape"),
        ("velocity", good.velocity[:, :3], "Readings.velocity must have shape"),
        ("torque", good.torque[1:], "Readings.torque must have shape"),
        ("wrench", [["x"]], "Readings.wrench must be an array of numbers"),
        ("time", np.zeros(0), "at least one sample"),
    ):
        with pytest.raises(hg.InputError, match=says):
            replace(good, **{name: value})
    untold = hg.Readings(good.time, good.q, good.velocity, good.wrench, good.touched, good.stalled)
    assert np.isnan(untold.torque).all() and untold.torque.shape == good.q.shape
