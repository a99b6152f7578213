"""Lifting, step by step, with a driver that writes down what it is told."""

from types import SimpleNamespace

import numpy as np
import pytest

import hqp_grasp as hg
from hqp_grasp.control.hold import Press
from hqp_grasp.errors import InputError
from hqp_grasp.experiments.lifting import lift
from hqp_grasp.experiments.pick import _apart, _Log, _turned
from hqp_grasp.touch.driver import DriverLimits
from hqp_grasp.touch.simulated import Truth

RETREAT = 0.35

BALANCED = np.array([-0.089, 0.954, 0.153, 1.345, -0.114, 0.87, -0.405, 0.859, 1.206, 1.206, 0.915])
LOOK = 0.125  # [s] that a look takes here
BLOCKED = hg.Missed(hg.Miss.BLOCKED, "watchdog")


@pytest.fixture(scope="module")
def scene():
    return hg.Scene(object=hg.Cylinder(0.05))


@pytest.fixture(scope="module")
def grasp(scene):
    return hg.GeometricProbe(scene).touch(BALANCED)


class ToldDriver:
    """Goes where it is told; `told` is (call, height of the palm [mm] or torque, duration [s])."""

    rate = 100.0
    close = hold = stop = None

    def __init__(self, robot, grasp):
        self.robot, self.began, self.q, self.time = robot, robot.palm(grasp.q), grasp.q, 0.0
        torque = np.full(robot.n, 50.0)
        self.limits = DriverLimits(
            robot.q_lower, robot.q_upper, robot.velocity, torque, 15.0, 1.0, 20.0
        )
        self.told, self.fault = [], ""

    @property
    def rise(self):
        p, R = self.robot.palm(self.q)
        np.testing.assert_allclose(p[:2], self.began[0][:2], atol=2e-4)
        np.testing.assert_allclose(R, self.began[1], atol=1e-3)
        return float(p[2] - self.began[0][2])

    def carry(self, q, duration):
        self.q = q
        self.told.append(("carry", round(1e3 * self.rise, 0), duration))
        return duration

    def press(self, torque):
        self.told.append(("press", torque.copy(), None))

    def move(self, q, duration):
        self.q = q
        self.told.append(("move", q.copy(), duration))
        return duration

    def wait(self, duration):
        self.told.append(("wait", None, duration))
        return SimpleNamespace(q=self.q[None], fault=self.fault)

    def carries(self):
        return [(height, duration) for call, height, duration in self.told if call == "carry"]


class ToldProbe(hg.PhysicalProbe):
    def __init__(self, driver, robot, felt):
        for name, value in (("driver", driver), ("robot", robot), ("felt", felt)):
            object.__setattr__(self, name, value)

    def feel(self):
        self.driver.time += LOOK
        return self.felt(self.driver)

    time = property(lambda self: self.driver.time)


class ToldHold(hg.Hold):
    """Presses as it is told: `said(driver)` are fields of a Press."""

    def __init__(self, driver, said):
        object.__setattr__(self, "driver", driver)
        object.__setattr__(self, "said", said)

    def step(self, felt, last=None):
        torque = np.zeros(self.driver.robot.n)
        torque[8:] = 0.5 if last is None else 0.7
        return Press(torque, 5.0, None, **({"load": 5.0} | self.said(self.driver)))


def lifted(scene, grasp, said=lambda driver: {}, felt=None, **options):
    driver = ToldDriver(scene.articulated, grasp)
    probe = ToldProbe(driver, scene.articulated, felt or (lambda driver: grasp))
    return driver, lift(probe, ToldHold(driver, said), grasp, **options)


def stands_at(height, load=1.9):
    """5 N to carry, until the palm is at that height [m] or below, then `load` [N]."""
    return lambda driver: {"load": 5.0 if driver.rise > height + 5e-4 else load}


def test_a_lift_tightens_loosens_rises_stands_shakes_and_lowers_step_by_step(scene, grasp):
    seen = []
    driver, done = lifted(scene, grasp, stands_at(-0.003), watch=seen.append)
    shaken = [(110.0, 0.3), (100.0, 0.3)] * 3
    fine = [(float(height), 0.15) for height in range(7, -4, -1)]
    carries = driver.carries()
    assert carries == [(5.0, 1.5), (100.0, 2.0), *shaken, (8.0, 2.0), *fine]
    counts = {}
    for moment in done.moments:
        counts[moment.phase] = counts.get(moment.phase, 0) + 1
    assert list(counts) == ["tighten", "loosen", "lift", "hold", "shake", "lower"]
    # 1, 1.5, 2, 1, six times 0.3, and 2 and eleven times 0.15 s.
    assert list(counts.values()) == [8, 12, 16, 8, 6 * 3, 16 + 11 * 2]
    assert tuple(seen) == done.moments
    assert done.lifted and done.set_down and done.reason == ""
    assert done.weight == pytest.approx(5.0 / 9.81)
    assert [m.time for m in done.moments] == pytest.approx(
        LOOK * np.arange(1, len(done.moments) + 1)
    )


def test_what_stands_is_pressed_ever_less_and_let_go(scene, grasp):
    driver, _ = lifted(scene, grasp, stands_at(0.0))
    presses = [torque for call, torque, _ in driver.told if call == "press"]
    assert presses[0][8] == 0.5 and presses[1][8] == 0.7  # what the first step says, at once
    *_, (press, none, _), (_, _, first), (_, _, now), (move, opened, lasts), (_, _, moving) = (
        driver.told
    )
    assert (press, move) == ("press", "move") and not none.any()
    assert (first, now, lasts, moving) == (0.6, 0.0, 0.5, 0.5)
    robot = scene.articulated
    due = np.clip(grasp.q - RETREAT * robot.closing.sum(axis=0), robot.q_lower, robot.q_upper)
    np.testing.assert_allclose(opened, due, atol=1e-3)
    assert (opened[8:] < grasp.q[8:] - 0.1).all()


def test_a_hand_that_something_stops_as_it_opens_says_so(scene, grasp):
    driver = ToldDriver(scene.articulated, grasp)
    driver.fault = "it hit a wall"
    probe = ToldProbe(driver, scene.articulated, lambda driver: grasp)
    done = lift(probe, ToldHold(driver, stands_at(0.0)), grasp)
    assert done.reason == "let go, but not opened: it hit a wall" and done.set_down


def test_it_stands_where_less_than_four_tenths_of_the_weight_are_carried(scene, grasp):
    for load, stands in ((1.9, True), (2.1, False)):
        driver, done = lifted(scene, grasp, stands_at(0.0, load))
        assert done.set_down is stands and done.lifted
        lowest = driver.carries()[-1][0]
        assert lowest == 0.0 if stands else -12.0 <= lowest <= -11.0
        assert driver.told[-2][0] == "move"  # it is let go all the same


def test_who_feels_nothing_lowers_it_to_where_it_stood_and_no_farther(scene, grasp):
    driver, done = lifted(scene, grasp, lambda driver: {"load": 1.0, "blind": 1})
    assert driver.carries()[-1][0] == 0.0 and not done.set_down


@pytest.mark.parametrize(("height", "phase"), [(0.004, "loosen"), (0.09, "lift")])
def test_what_is_not_safe_is_set_down_at_once_with_the_reason(scene, grasp, height, phase):
    def said(driver):
        return stands_at(0.0)(driver) | {"reason": "it slips" if driver.rise > height else ""}

    driver, done = lifted(scene, grasp, said)
    assert done.moments[-1].phase == "lower" and done.set_down
    assert next(m.phase for m in done.moments if m.press.reason) == phase
    assert not done.lifted and np.isnan(done.weight) and done.reason == "it slips"
    assert (8.0, 2.0) in driver.carries() and (110.0, 0.3) not in driver.carries()


def test_shaken_loose_it_was_lifted_and_weighed(scene, grasp):
    def said(driver):
        return stands_at(0.0)(driver) | {"reason": "it slips" if driver.rise > 0.105 else ""}

    _, done = lifted(scene, grasp, said)
    assert done.lifted and done.weight == pytest.approx(5.0 / 9.81) and done.reason == "it slips"


def test_a_driver_that_stops_while_it_lowers_keeps_the_hand_closed_there(scene, grasp):
    def felt(driver):
        return BLOCKED if (8.0, 2.0) in driver.carries() else grasp

    def said(driver):
        return {"reason": "the watchdog" if (8.0, 2.0) in driver.carries() else ""}

    driver, done = lifted(scene, grasp, said, felt)
    end = "the watchdog, while it was set down; the hand stands there, and was not opened"
    assert done.reason == end and done.lifted and not done.set_down
    assert not any(call == "move" for call, _, _ in driver.told)
    # One that stopped before is told to press once more, and set down.
    driver, done = lifted(scene, grasp, lambda driver: {"reason": "stopped"}, lambda driver: grasp)
    assert done.reason == "stopped" and driver.told[-2][0] == "move"


def test_another_height_takes_another_time(scene, grasp):
    driver, _ = lifted(scene, grasp, stands_at(0.0), height=0.05)
    assert driver.carries()[1:3] == [(50.0, 1.0), (60.0, 0.3)]
    with pytest.raises(InputError, match="cannot move the palm by 2000 mm"):
        lifted(scene, grasp, height=2.0)
    with pytest.raises(InputError, match="lift: height must be finite and above 0"):
        lifted(scene, grasp, height=0.0)


# ---------------------------------------------------------------- what a simulation knows of it


def truth(place=(0, 0, 0.2), turned=0.0, in_palm=(0, 0, 0.1), spun=0.0, force=0.0, links=()):
    def pose(x, angle):
        return np.array([*x, np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0])

    forces = np.array([[0.0, 0.0, 0.0], [0.0, force, 0.0]])
    R = np.tile(np.eye(3), (2, 1, 1))
    return Truth(
        None, forces, R, pose(place, turned), pose(in_palm, spun), 0.0, 0.0, tuple(links), ()
    )


def logged(truths, end=None, phases=("tighten", "loosen", "lift", "hold", "lower"), lifted=True):
    """What a log makes of these truths, the first before the first look."""
    hand = SimpleNamespace(truth=lambda: hand.now, worst={"range [rad]": -0.2}, now=truths[0])
    log = _Log(hand)
    contacts = [hg.Contact([0.05, 0, 0.2], [1, 0, 0], wrench=[4.0, 0, -1.5, 0, 0, 0])]
    contacts.append(hg.Contact([-0.05, 0, 0.2], [-1, 0, 0], wrench=[-3.0, 0.5, -1.5, 0, 0, 0]))
    felt = hg.Grasp(np.array([0.1, 0.2]), contacts, np.zeros((6, 2)))
    press = Press(np.zeros(2), 6.0, None, 0.3, 3.0)
    for i, (phase, hand.now) in enumerate(zip(phases, truths[1:], strict=True)):
        log.look(SimpleNamespace(time=0.1 * i, phase=phase, felt=felt, press=press))
    hand.now = end or truths[0]
    done = SimpleNamespace(lifted=lifted, weight=0.3, reason="")
    return log, log.row(done, 0.1)


UP = [truth(), truth(), truth((0, 0, 0.21)), truth((0, 0, 0.3)), truth((0, 0, 0.295)), truth()]


def test_a_look_has_forces_on_the_object_and_where_it_is():
    log, row = logged(UP)
    look = log.looks[3]
    assert look["normal"] == [4.0, 3.0] and row["sum_normal"] == 7.0
    assert look["contacts"][:9] == [0.05, 0.0, 0.2, 1.0, 0.0, 0.0, -4.0, 0.0, 1.5]
    assert look["contacts"][15:] == [3.0, -0.5, 1.5]
    assert (look["strength"], look["used"], look["load"], look["q"]) == (6.0, 0.3, 3.0, [0.1, 0.2])
    assert look["object"][:3] == [0.0, 0.0, 0.295] and row["duration"] == look["time"] + 0.1


def test_what_rose_by_nine_tenths_of_the_way_was_lifted():
    assert logged(UP)[1]["height"] == pytest.approx(0.1) and logged(UP)[1]["lifted"] is True
    for rise, due in ((0.089, False), (0.091, True)):
        truths = [*UP[:3], truth((0, 0, 0.2 + rise)), UP[2], UP[5]]
        _, row = logged(truths)
        assert row["lifted"] is due and row["height"] == pytest.approx(rise)
        assert logged(truths, lifted=False)[1]["lifted"] is False
    # How high it flew after it was let go is no height.
    assert logged([*UP[:5], truth((0, 0, 0.9))])[1]["height"] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("end", "stands"),
    [
        ({}, True),
        ({"place": (0.006, 0.0, 0.1915)}, False),
        ({"place": (0.006, 0.0, 0.1925)}, True),
        ({"turned": np.radians(14.5)}, True),
        ({"turned": np.radians(15.5)}, False),
        ({"force": 0.09}, True),
        ({"force": 0.11}, False),
        ({"links": ("f1_distal",)}, False),
    ],
)
def test_set_down_is_within_a_centimetre_upright_and_let_go(end, stands):
    assert logged(UP, truth(**end))[1]["set_down"] is stands


def test_slip_is_in_the_palms_frame_from_the_first_look_that_holds():
    truths = [truth(in_palm=(0.5, 0, 0)), truth(in_palm=(0.4, 0, 0))]  # not held yet
    truths += [truth(), truth(in_palm=(0.002, 0, 0.1)), truth(in_palm=(0, 0.003, 0.1), spun=0.2)]
    _, row = logged([*truths, truth(in_palm=(1, 1, 1))])
    assert row["slip_mm"] == pytest.approx(3.0) and row["slip_deg"] == pytest.approx(11.459, 1e-3)
    assert row["limit_violation"] == 0.0 and row["reason"] is None
    assert _apart([]) == (0.0, 0.0)
    assert _turned(truth().place, -truth(turned=0.4).place) == pytest.approx(0.4)
