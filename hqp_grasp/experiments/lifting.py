"""From a grasp that was felt to an object lifted, shaken and set down, by a driven hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from hqp_grasp.control.hold import Hold, Press
from hqp_grasp.control.reach import carried
from hqp_grasp.errors import InputError, instance, positive
from hqp_grasp.grasp import Grasp, Miss, Missed
from hqp_grasp.touch.driver import Driver, require_press
from hqp_grasp.touch.geometric import RETREAT
from hqp_grasp.touch.physical import BACKING, PhysicalProbe
from hqp_grasp.world.robot import Robot

G = 9.81  # [m/s²]
TIGHTENING = 1.0  # [s] of pressing before the lift
LOOSENING = 0.005  # [m] raised slowly at first, while the grip grows with the load,
SLOWLY = 1.5  # [s] in this time
SPEED = 0.05  # [m/s] of the palm
STANDING = 1.0  # [s] held where it was lifted to, and weighed
SHAKE, SHAKING = 0.01, 0.3  # [m] up and down, [s] each way
SHAKES = 3
NEAR = 0.008  # [m] above where it stood, from which it is set down slowly,
FINE, FINING = 0.001, 0.15  # [m] at a time, [s] each,
FARTHER = 0.012  # [m] below, at most: what was held may have slipped
STANDS = 0.4  # share of its weight still carried, below which it stands
RELEASING, OPENING = 0.6, 0.5  # [s] of pressing ever less, of opening


@dataclass(frozen=True, eq=False)
class Moment:
    """One look at what the hand holds."""

    time: float  # [s] on the driver's clock
    phase: str  # tighten, loosen, lift, hold, shake, lower, release
    felt: Grasp | Missed
    press: Press


@dataclass(frozen=True, eq=False)
class Lift:
    """How it went, as far as it was felt."""

    moments: tuple[Moment, ...]
    lifted: bool  # carried to the top, and held there
    set_down: bool  # felt to stand before it was let go
    weight: float  # [kg] felt at the top; NaN where it was not lifted
    reason: str = ""  # what went wrong, or why it was set down early


def lift(
    probe: PhysicalProbe,
    hold: Hold,
    grasp: Grasp,
    height: float = 0.1,
    watch: Callable[[Moment], None] | None = None,
) -> Lift:
    """Lift what `probe` touches by `height` [m], shake it, set it down where it stood, let it go.

    `grasp` is what was felt last, its fingers still holding. First the hand presses, then it rises
    slowly while the grip grows with the load. Where the hold says so, or contacts are not felt any
    more, the object is set down at once. `watch` is called at every look. Raises InputError, before
    anything moves, where the arm cannot lift so far, or the driver cannot press.
    """
    instance("lift: probe", probe, PhysicalProbe)
    instance("lift: hold", hold, Hold)
    height = positive("lift: height", height)
    robot, driver = probe.robot, probe.driver
    require_press("lift: the driver", driver)
    if not robot.arm:
        raise InputError(f"{robot.description.name} has no arm to lift with")
    postures = {rise: _raised(robot, grasp.q, rise) for rise in (LOOSENING, NEAR, height)}
    postures[height + SHAKE] = _raised(robot, postures[height], SHAKE)
    below = [_raised(robot, grasp.q, -depth) for depth in np.arange(FINE, FARTHER, FINE)]
    looking = _Looking(probe, hold, watch, hold.step(grasp))
    driver.press(looking.press.torque)
    lifted, weight, reason = False, np.nan, ""
    try:
        looking.watched("tighten", TIGHTENING)
        looking.carry("loosen", postures[LOOSENING], SLOWLY)
        looking.carry("lift", postures[height], height / SPEED)
        looking.watched("hold", STANDING)
        loads = [m.press.load for m in looking.moments if m.phase == "hold"]
        weight, lifted = float(np.mean(loads)) / G, True
        for _ in range(SHAKES):
            looking.carry("shake", postures[height + SHAKE], SHAKING)
            looking.carry("shake", postures[height], SHAKING)
    except _UnsafeError as unsafe:
        reason = str(unsafe)
    looking.lowering, stands = True, False
    try:
        driver.press(looking.press.torque)  # once more, where the driver had stopped by itself
        looking.carry("lower", postures[NEAR], height / SPEED)
        fine = [_raised(robot, grasp.q, rise) for rise in np.arange(NEAR - FINE, 0.0, -FINE)]
        most = max((m.press.load for m in looking.moments), default=0.0)
        for q in (*fine, grasp.q, *below):
            if q is below[0] and looking.press.blind:
                break  # whether it stands would not be felt: where it stood is the best guess
            looking.carry("lower", q, FINING)
            stands = looking.press.blind == 0 and looking.press.load < STANDS * most
            if stands:
                break
        stopped = _let_go(driver, robot)
        left = f"let go, but not opened: {stopped}" if stopped else ""
    except _UnsafeError as unsafe:
        left = f"{unsafe}, while it was set down; the hand stands there, and was not opened"
    reason = "; ".join(filter(None, (reason, left)))
    return Lift(tuple(looking.moments), lifted, stands, weight, reason)


def _let_go(driver: Driver, robot: Robot) -> str:
    """Press ever less, then open; return what stopped the hand meanwhile, empty if nothing did.

    Palms on several sides draw off first: fingers that lean may be wedged on the object.
    """
    driver.press(np.zeros(robot.n))
    driver.wait(RELEASING)
    here = np.clip(driver.wait(0.0).q[-1], driver.limits.lower, driver.limits.upper)
    if len(robot.groups) > 1:
        here = robot.withdrawn(here, np.full(len(robot.groups), BACKING))
        fault = driver.wait(driver.move(here, OPENING)).fault
        if fault:
            return fault
    opened = here - RETREAT * robot.closing.sum(axis=0)
    opened = np.clip(opened, driver.limits.lower, driver.limits.upper)
    return driver.wait(driver.move(opened, OPENING)).fault


@dataclass
class _Looking:
    """A hand that presses: every look at what it holds, and what it presses with by now."""

    probe: PhysicalProbe
    hold: Hold
    watch: Callable[[Moment], None] | None
    press: Press
    moments: list[Moment] = field(default_factory=list)
    lowering: bool = False  # the object is being set down: there is no safer thing to do

    def look(self, phase: str) -> None:
        """Feel, and press accordingly; raise _UnsafeError where the object should be set down."""
        felt = self.probe.feel()
        self.press = self.hold.step(felt, self.press)
        moment = Moment(self.probe.time, phase, felt, self.press)
        self.moments.append(moment)
        if self.watch is not None:
            self.watch(moment)
        stopped = isinstance(felt, Missed) and felt.reason is Miss.BLOCKED
        if stopped or (self.press.reason and not self.lowering):
            raise _UnsafeError(self.press.reason)
        self.probe.driver.press(self.press.torque)

    def watched(self, phase: str, duration: float) -> None:
        """Look again and again until that much time has passed."""
        end = self.probe.time + duration
        while self.probe.time < end:
            self.look(phase)

    def carry(self, phase: str, q: np.ndarray, duration: float) -> None:
        """Bring the palm to its place at q (n,) [rad], looking."""
        self.watched(phase, self.probe.driver.carry(q, duration))


class _UnsafeError(Exception):
    """What is held should be set down, or is gone."""


def _raised(robot: Robot, q: np.ndarray, rise: float) -> np.ndarray:
    way = carried(robot, q, np.array([0.0, 0.0, rise]))
    if way is None:
        raise InputError(
            f"the arm of {robot.description.name} cannot move the palm by {1e3 * rise:g} mm "
            "upwards from where it holds the object"
        )
    return way[-1]
