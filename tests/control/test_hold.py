"""Holding: how hard to press, from what is felt, as a pure function."""

from dataclasses import replace

import numpy as np
import pytest

import hqp_grasp as hg
from hqp_grasp.control.forces import Squeeze
from hqp_grasp.errors import InputError
from hqp_grasp.world.description import RobotDescription
from hqp_grasp.world.robot import compiled

RELAXING = 0.97
RESERVE = 0.5

MU = 0.5
BLIND = hg.Missed(hg.Miss.SENSOR, "finger_1")


@pytest.fixture(scope="module")
def robot():
    about = RobotDescription.load("wam_bhand")
    return hg.Robot(about, compiled(about))


@pytest.fixture
def hold(robot):
    return hg.Hold(hg.Grip(robot, force=5.0, friction=MU))


def carrying(robot, load, normal=5.0, most_at=0):
    """Three contacts around a cylinder that press with `normal` [N] and carry `load` [N] (3,)."""
    a = 2.0 * np.pi * np.arange(3) / 3 + 0.3
    n = np.column_stack([np.cos(a), np.sin(a), np.zeros(3)])
    x = robot.centers(robot.home).mean(axis=0) + 0.05 * n
    links = ("f1_tip", "f2_tip", "f3_tip")
    contacts = [
        # A contact's wrench is what the object does to the hand.
        hg.Contact(p, m, body=b, wrench=np.array([*(normal * m), 0, 0, 0]) - [0, 0, up, 0, 0, 0])
        for p, m, b, up in zip(x, n, links, load, strict=True)
    ]
    return hg.Grasp(robot.home, tuple(contacts), np.zeros((9, robot.n)))


def test_without_load_the_grip_is_as_strong_as_it_was_asked_to_be(robot, hold):
    press = hold.step(carrying(robot, [0.0, 0.0, 0.0]))
    assert press.strength == 5.0 and press.load == 0.0 and not press.reason


def test_the_grip_grows_until_the_load_uses_its_share_of_the_friction(robot, hold):
    load = 9.0
    press = hold.step(carrying(robot, np.full(3, load / 3)), hold.step(carrying(robot, [0, 0, 0])))
    assert press.load == pytest.approx(load)
    assert load / (3 * press.strength) == pytest.approx(RESERVE * MU)
    assert -press.squeeze.forces[:, 2].sum() == pytest.approx(-load, abs=1e-3)


def test_one_contact_beyond_the_friction_believed_in_makes_all_press_harder(robot, hold):
    press = hold.step(carrying(robot, [3.5, 0.0, 0.0]))
    assert press.used == pytest.approx(0.7)
    assert press.strength == pytest.approx(5.0 * 0.7 / MU)


def test_the_grip_relaxes_slowly_and_never_below_what_was_asked(robot, hold):
    press = hold.step(carrying(robot, np.full(3, 3.0)))
    strong = press.strength
    for n in range(1, 40):
        press = hold.step(carrying(robot, [0.0, 0.0, 0.0]), press)
        assert press.strength == pytest.approx(max(5.0, strong * RELAXING**n))
    assert press.strength == 5.0


def test_the_same_was_felt_the_same_is_pressed_and_nothing_is_remembered(robot, hold):
    felt = carrying(robot, np.full(3, 2.0))
    first = hold.step(felt)
    hold.step(carrying(robot, np.full(3, 4.0)), first)
    again = hold.step(felt)
    assert np.array_equal(first.torque, again.torque) and first.strength == again.strength


def test_blind_steps_keep_the_torques_and_then_say_why_to_set_down(robot, hold):
    press = begun = hold.step(carrying(robot, np.full(3, 2.0)))
    for n in range(1, hold.patience + 1):
        press = hold.step(BLIND, press)
        assert np.array_equal(press.torque, begun.torque) and press.blind == n
        assert bool(press.reason) == (n == hold.patience)
    assert "finger_1" in press.reason


def test_a_grasp_felt_again_in_time_is_no_reason(robot, hold):
    felt = carrying(robot, np.full(3, 2.0))
    press = hold.step(felt)
    for felt_now in (BLIND, BLIND, felt, BLIND, BLIND):
        press = hold.step(felt_now, press)
    assert press.blind == 2 and not press.reason


def test_a_driver_that_stopped_is_a_reason_at_once(robot, hold):
    stopped = hg.Missed(hg.Miss.BLOCKED, "watchdog")
    assert "watchdog" in hold.step(stopped, hold.step(carrying(robot, [0, 0, 0]))).reason


def test_contacts_that_cannot_be_pressed_harder_and_slip_are_a_reason(robot, hold):
    press = hold.step(carrying(robot, np.zeros(3)))
    for n in range(hold.patience):
        assert not press.reason
        press = hold.step(carrying(robot, np.full(3, 9.0), normal=hold.grip.most), press)
        assert press.strength == hold.grip.most, n
    assert "0.6" in press.reason and "0.5 is believed" in press.reason


def test_a_hand_that_has_not_followed_yet_is_not_blamed(robot, hold):
    press = hold.step(carrying(robot, np.zeros(3)))
    for _ in range(2 * hold.patience):
        press = hold.step(carrying(robot, np.full(3, 5.0), normal=6.0), press)
    assert press.strength == hold.grip.most and not press.reason


def test_where_no_wrench_is_felt_the_grip_is_what_was_asked_and_relaxes_to_it(robot, hold):
    felt = carrying(robot, np.full(3, 3.0))
    silent = replace(felt, contacts=tuple(replace(c, wrench=None) for c in felt.contacts))
    press = hold.step(silent)
    assert (press.strength, press.used, press.load) == (5.0, 0.0, 0.0)
    strong = hold.step(felt)
    assert hold.step(silent, strong).strength == pytest.approx(0.97 * strong.strength)


def test_what_a_contact_uses_is_its_own_and_the_load_is_what_all_carry_upwards(robot, hold):
    press = hold.step(carrying(robot, [1.0, -0.5, 2.0], normal=4.0))
    assert press.used == pytest.approx(2.0 / 4.0) and press.load == pytest.approx(2.5)
    one = hold.step(carrying(robot, [0.0, 0.0, 2.5]))
    # Half of the friction believed in for all together; the worst contact all of it.
    assert one.strength == pytest.approx(max(5.0, 2.5 / (3 * 0.5 * 0.5), 5.0 * 0.5 / 0.5))
    sideways = carrying(robot, np.zeros(3))
    pushed = [replace(sideways.contacts[0], wrench=[9.0, 0, 0, 0, 0, 0]), *sideways.contacts[1:]]
    n = sideways.normals[0]
    press = hold.step(replace(sideways, contacts=tuple(pushed)))
    assert press.used == pytest.approx(np.sqrt(1.0 - n[0] ** 2) / n[0])


class Fails(hg.Grip):
    """Finds no forces."""

    def solve(self, grasp, wrench=None, warm=None):
        return Squeeze(None, None, None, reason="no forces found: singular")


def test_where_no_forces_are_found_the_last_torques_are_kept_and_what_is_felt_is_told(robot, hold):
    begun = hold.step(carrying(robot, np.full(3, 2.0)))
    failing = hg.Hold(Fails(robot, 5.0, MU))
    press = begun
    for n in range(1, 4):
        press = failing.step(carrying(robot, np.full(3, 1.0)), press)
        assert np.array_equal(press.torque, begun.torque) and press.strength == begun.strength
        assert press.blind == n and press.load == pytest.approx(3.0)
        assert press.used == pytest.approx(0.2)
    assert press.reason == "no forces found: singular"
    with pytest.raises(InputError, match="Hold: no forces found: singular"):
        failing.step(carrying(robot, np.zeros(3)))


def test_a_hand_has_followed_once_nine_tenths_of_what_was_asked_are_felt(robot, hold):
    most, strained = hold.grip.most, np.full(3, 9.0)
    for share, counts in ((0.89, 0), (0.91, 1)):
        press = hold.step(carrying(robot, strained, normal=most))
        assert press.strength == most and press.straining == 0
        press = hold.step(carrying(robot, share * strained, normal=share * most), press)
        assert press.straining == counts
    press = hold.step(carrying(robot, np.zeros(3), normal=most), press)
    assert press.straining == 0  # in a row
    assert hg.Hold(hold.grip).patience == 3


@pytest.mark.parametrize("felt", [BLIND, hg.Missed(hg.Miss.NO_TOUCH, "finger_2")])
def test_holding_begins_with_a_grasp(hold, felt):
    with pytest.raises(InputError, match="begins with a grasp"):
        hold.step(felt)


@pytest.mark.parametrize("bad", [{"grip": None}, {"patience": 0}])
def test_a_hold_says_what_it_needs(robot, bad):
    with pytest.raises(InputError):
        hg.Hold(**({"grip": hg.Grip(robot)} | bad))
