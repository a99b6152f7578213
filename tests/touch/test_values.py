"""What a driver promises and what it read, as values that nobody can change."""

import numpy as np
import pytest

import hqp_grasp as hg
from hqp_grasp.touch.driver import DriverLimits, Readings, require_press, require_touch

GOOD = {
    "lower": [-1.0, -2.0, 0.0],
    "upper": [1.0, 2.0, 0.5],
    "speed": [1.0, 2.0, 3.0],
    "torque": [10.0, 2.0, 4.0],
    "force": 15.0,
    "watchdog": 1.0,
    "grip": 20.0,
}


def limits(**changes):
    return DriverLimits(**GOOD | changes)


def readings(t=4, n=3, k=2, **changes):
    shapes = {"time": (t,), "q": (t, n), "velocity": (t, n), "wrench": (t, k, 6)}
    given = {name: np.arange(np.prod(shape)).reshape(shape) for name, shape in shapes.items()}
    flags = {"touched": [True] * k, "stalled": [False] * k}
    return Readings(**given | flags | changes)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"speed": [1.0, 0.0, 3.0]}, "DriverLimits.speed must be above 0"),
        ({"torque": [1.0, -1.0, 3.0]}, "DriverLimits.torque must be above 0"),
        ({"upper": [1.0, -2.0, 0.5]}, "every lower end must be below its upper one"),
        ({"upper": [1.0, -3.0, 0.5]}, "every lower end must be below its upper one"),
        ({"upper": [1.0, 2.0]}, r"DriverLimits.upper must have shape \(3\)"),
        ({"speed": [1.0, np.inf, 1.0]}, "DriverLimits.speed"),
        ({"force": 0.0}, "DriverLimits.force"),
        ({"watchdog": -1.0}, "DriverLimits.watchdog"),
        ({"grip": -1.0}, "DriverLimits.grip"),
    ],
)
def test_limits_that_cannot_be_are_refused_by_name(changes, says):
    with pytest.raises(hg.InputError, match=says):
        limits(**changes)


def test_limits_are_the_drivers_own_and_a_negative_lower_end_is_fine():
    lower = np.array(GOOD["lower"])
    kept = limits(lower=lower)
    lower[0] = 9.0
    np.testing.assert_array_equal(kept.lower, GOOD["lower"])
    for name in ("lower", "upper", "speed", "torque"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(kept, name)[0] = 1.0


def test_two_fifths_of_the_force_limit_may_be_held():
    """The rest is for bumps."""
    assert limits().hold == pytest.approx(6.0) and limits(force=5.0).hold == pytest.approx(2.0)
    assert limits().require_hold("close", 6.0) == 6.0
    with pytest.raises(hg.InputError, match=r"close is 6.1 N; this hand holds 6 N at most, 0.4 of"):
        limits().require_hold("close", 6.1)
    with pytest.raises(hg.InputError, match="above 0"):
        limits().require_hold("close", 0.0)


@pytest.mark.parametrize(
    ("torque", "says"),
    [
        ([0.0, 2.1, 4.0], "is 2.1 N·m at joint 1, whose limit is 2 N·m"),
        ([0.0, 1.9, -4.5], "is -4.5 N·m at joint 2, whose limit is 4 N·m"),
        ([0.1, 1.0, 1.0], "is 0.1 N·m at joint 0, which carries the palm"),
        ([0.0, np.nan, 1.0], "press"),
        ([0.0, 1.0], "press"),
    ],
)
def test_a_torque_beyond_its_limit_or_at_the_arm_is_refused(torque, says):
    with pytest.raises(hg.InputError, match=says):
        limits().require_torque("press", torque, [0])


def test_a_torque_at_its_limit_of_either_sign_is_fine_where_the_hand_can_press():
    for torque in ([0.0, 2.0, -4.0], [0.0, -2.0, 4.0]):
        np.testing.assert_array_equal(limits().require_torque("press", torque, [0]), torque)
    with pytest.raises(hg.InputError, match="grip is 0 N"):
        limits(grip=0.0).require_torque("press", [0.0, 1.0, 0.0], [0])
    assert DriverLimits(**{k: v for k, v in GOOD.items() if k != "grip"}).grip == 0.0


def test_readings_are_copies_that_cannot_be_changed_and_know_no_infinities():
    q = np.array([[1.0, np.inf, -np.inf], [np.nan, 2.0, 3.0]])
    read = readings(t=2, q=q)
    np.testing.assert_array_equal(read.q, [[1.0, np.nan, np.nan], [np.nan, 2.0, 3.0]])
    assert q[0, 1] == np.inf
    q[0, 0] = 5.0
    assert read.q[0, 0] == 1.0 and read.fault == ""
    for name in ("time", "q", "velocity", "wrench", "torque", "touched", "stalled"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(read, name)[0] = 0.0
    told = readings(torque=np.ones((4, 3)))
    assert (told.torque == 1.0).all() and np.isnan(read.torque).all()


@pytest.mark.parametrize("name", ["touched", "stalled"])
def test_readings_have_one_flag_for_each_tip(name):
    with pytest.raises(hg.InputError, match=f"Readings.{name} needs one flag for each of 2 tips"):
        readings(**{name: [True, False, True]})


class Half:
    limits, rate = limits(grip=0.0), 100.0

    def move(self): ...
    def close(self): ...
    def hold(self): ...
    def stop(self): ...
    def wait(self): ...


class Whole(Half):
    def press(self): ...
    def carry(self): ...


@pytest.mark.parametrize("call", ["limits", "rate", "move", "close", "hold", "stop", "wait"])
def test_what_touching_needs_is_named_where_it_lacks(call):
    require_touch("probe", Half())
    names = {name: getattr(Half, name) for name in dir(Half) if name[0] != "_" and name != call}
    with pytest.raises(hg.InputError, match=f"lacks {call}$"):
        require_touch("probe", type("Lame", (), names)())


def test_what_pressing_needs_is_named_where_it_lacks():
    with pytest.raises(hg.InputError, match=r"cannot press: .* lacks press, carry of a Driver"):
        require_press("hold", Half())
    with pytest.raises(hg.InputError, match=r"cannot press: its DriverLimits.grip is 0 N"):
        require_press("hold", Whole())
    able = Whole()
    able.limits = limits()
    require_press("hold", able)
