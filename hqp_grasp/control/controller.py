"""The controller: from all that was felt so far to where the hand goes next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hqp_grasp.control.forms import Form, Plan, form_of
from hqp_grasp.control.landing import land
from hqp_grasp.control.limits import (
    ClearanceLimit,
    ConfigurationLimit,
    HoldLimit,
    RetreatLimit,
    StepLimit,
)
from hqp_grasp.errors import HqpGraspError, InputError, flag, instance, whole
from hqp_grasp.grasp import Grasp, Miss, Missed, Touch
from hqp_grasp.hierarchy.level import Solution
from hqp_grasp.tasks import Priority, Stack, Task
from hqp_grasp.world.robot import Robot

SHARES = (1.0, 0.5, 0.25)  # of a step, tried in turn while it finds nothing to touch
RETREAT = 0.01  # [m] the palm withdraws by, for each time that a link was in the way
MAX_RETREATS = 6
IN_THE_WAY = (Miss.OTHER_LINK, Miss.TABLE)  # what the palm withdraws from
BROKEN = (Miss.SENSOR, Miss.STUCK)  # no fault of the step, and it may pass
PASSING = (*BROKEN, Miss.BLOCKED, Miss.LOST, Miss.UNCLEAR)  # what the first touch tries again
MAX_BROKEN = 4  # touches from one grasp that this may cost
AROUND = (0, 180, 90, 270, 45, 225, 135, 315)  # [°] about the vertical, tried in turn,
SEARCH = 0.02  # [m] beside a first touch that found nothing
SEARCH_STEPS = 3  # of Newton's method, to get there
SEARCH_RANK = 1e-3  # [–] of the palm's Jacobian, below which an arm cannot go there
CLIP_TOLERANCE = 1e-9  # [rad] a solver's rounding may leave a range by; more is a bug


@dataclass(frozen=True, eq=False)
class Step:
    """Where to touch next, and why."""

    q_target: np.ndarray | None  # (n,) [rad], within every limit; None: the controller gives up
    via: tuple[np.ndarray, ...] = ()  # postures (n,) [rad] to pass on the way, fingers open
    plan: Plan | None = None  # the step that the laws asked for
    share: float | None = None  # of the plan that is taken
    reason: str = ""  # why the controller gives up, or takes another step than planned

    @property
    def solution(self) -> Solution | None:
        """The solver's answer behind the plan, None where there was nothing to solve."""
        return None if self.plan is None else self.plan.solution


@dataclass(frozen=True, eq=False)
class _Stand:
    """Where a history leaves the hand."""

    grasp: Grasp | None = None  # to step from
    misses: tuple[Missed, ...] = ()  # of steps from it
    since: int | None = None  # touches since the hand began again from its first grasp
    lost: bool = False  # nothing felt since then
    way: tuple[np.ndarray, ...] = ()  # postures (n,) [rad] back to the grasp


@dataclass(frozen=True)
class Controller:
    """Laws within limits, as a rule for the next touch: no scene and no probe are needed.

    `step(history)` is a pure function of what was felt: nothing is remembered between calls, so a
    run can be stopped, stored (`save_history`) and resumed anywhere.

    form="hierarchy" solves the laws as a strict hierarchy in joint space within its limits, force
    and moment led by all that was felt; "memoryless" is the same by the last grasp alone; "clipped"
    takes the strict projection of its laws, scaled to the caps and clipped to the ranges; "paper"
    composes gradients in contact space and maps them by the SR-inverse (eq. 11–13), then clips
    likewise; "paper-hierarchy" puts the paper's two levels strictly below the limits. A `Form` of
    one's own stands in the place of these names. A stack without caps gets StepLimit(), one without
    ranges the robot's.

    After a miss the step is taken again from the last grasp, shorter: SHARES of it in turn. Where
    another link than the fingertips met the object, or a fingertip the table, the palm withdraws on
    the next step, by RETREAT more at each such miss. Where a sensor was silent, or the hand did not
    open, the same step is tried again. When nothing is left to try, "hierarchy" begins again from
    its first grasp, with careful steps. Where that brings no touch either, and for the other forms
    at once, or when the `budget` of touches is spent, the controller gives up. Where the very first
    touch finds nothing, the palm is sent SEARCH beside there, level, all around.
    """

    robot: Robot
    stack: Stack | Task
    form: str | Form = "hierarchy"
    budget: int | None = None  # touches in all, the first included
    landing: bool = True  # correct each step by the hand's kinematics, see `land`

    def __post_init__(self) -> None:
        instance("Controller.robot, such as Scene().articulated,", self.robot, Robot)
        if self.budget is not None:
            object.__setattr__(self, "budget", whole("Controller.budget", self.budget, 1))
        stack = Stack.of(self.stack)
        if not any(limit.priority is Priority.CAP for limit in stack.limits):
            stack = stack.within(StepLimit())
        if not any(limit.priority is Priority.RANGE for limit in stack.limits):
            stack = stack.within(ConfigurationLimit(self.robot))
        if self.robot.idle.any() and not any(isinstance(v, HoldLimit) for v in stack.limits):
            stack = stack.within(HoldLimit(self.robot))
        watched = any(isinstance(v, ClearanceLimit) for v in stack.limits)
        if self.robot.description.clearance > 0.0 and not watched:
            stack = stack.within(ClearanceLimit(self.robot))
        object.__setattr__(self, "stack", stack)
        if not isinstance(self.form, Form):
            object.__setattr__(self, "form", form_of(self.form))
        self.form.check(stack)  # type: ignore[union-attr]
        object.__setattr__(self, "landing", flag("Controller.landing", self.landing))

    def step(self, history: Sequence[Touch]) -> Step:
        """Return where to touch next, given every touch so far, hits and misses, in order.

        Raises InputError for an empty history, or one that is not of this robot.
        """
        stand = self._stand(history)
        grasp, misses = stand.grasp, stand.misses
        if self.budget is not None and len(history) >= self.budget:
            return Step(None, reason=f"the budget of {self.budget} touches is spent")
        if grasp is None:
            return self._search(history[0].q_target, misses)
        if self._spent(misses):
            last = misses[-1]
            why = f"{last.reason.value} ({last.where})"
            return Step(None, reason=f"{len(misses)} misses from one grasp, the last: {why}")
        in_the_way = [missed.reason in IN_THE_WAY for missed in misses]
        retreat = RETREAT * [*in_the_way[::-1], False].index(False)
        stack: Stack = self.stack  # type: ignore[assignment]
        if retreat > 0.0:
            stack = stack.within(RetreatLimit(self.robot, retreat))
        left = None if self.budget is None else self.budget - len(history)
        careful = {}  # a form that never begins again need not know the word
        if stand.since is not None and stand.since < self._careful_for:
            careful["careful"] = True
        plan = self.form.plan(stack, grasp, history, left, **careful)  # type: ignore[union-attr]
        short = _short(misses)
        x = (1.0 if plan.exact else self._shares[short]) * plan.x
        if self.landing and not plan.exact:
            x = land(self.robot, stack, grasp, x)
        reactions = {
            "from the first grasp again": stand.since == 0,
            f"palm back by {1e3 * retreat:g} mm": retreat > 0.0,
            f"{self._shares[short]:g} of the step": short,
            "the same again": misses and misses[-1].reason in BROKEN,
        }
        told = [what for what, done in reactions.items() if done]
        reason = ", ".join([*told, plan.reason] if plan.reason else told)
        return Step(self._clipped(grasp, x), stand.way, plan, self._shares[short], reason)

    def _search(self, q: np.ndarray, misses: Sequence[Missed]) -> Step:
        """The first touch, sent to q (n,) [rad], again; beside there once it found nothing."""
        if misses[-1].reason in PASSING and len(misses) < MAX_BROKEN:
            return Step(q, reason="the same again")
        tried = sum(missed.reason not in PASSING for missed in misses)
        if not 0 < tried <= len(AROUND) or not self.robot.arm:
            return Step(None, reason="no touch has felt a grasp: begin where the hand touches")
        angle = np.radians(AROUND[tried - 1])
        goal = self.robot.palm(q)[0] + SEARCH * np.array([np.cos(angle), np.sin(angle), 0.0])
        for _ in range(SEARCH_STEPS):
            way = np.append(goal - self.robot.palm(q)[0], np.zeros(3))
            q = q + np.linalg.pinv(self.robot.palm_jacobian(q), rcond=SEARCH_RANK) @ way
            q = np.clip(q, *self._ranges)
        return Step(q, reason=f"{1e3 * SEARCH:g} mm beside")

    @property
    def _ranges(self) -> tuple[np.ndarray, np.ndarray]:
        """The joints' ranges (n,) [rad], lower and upper, the narrowest of all limits."""
        limits = self.stack.limits  # type: ignore[union-attr]
        robots = [self.robot, *(v.robot for v in limits if isinstance(v, ConfigurationLimit))]
        lower = np.max([robot.q_lower for robot in robots], axis=0)
        return lower, np.min([robot.q_upper for robot in robots], axis=0)

    @property
    def _shares(self) -> tuple[float, ...]:
        return getattr(self.form, "shares", SHARES)

    @property
    def _careful_for(self) -> int:
        return getattr(self.form, "careful_for", 0)

    def _spent(self, misses: Sequence[Missed]) -> bool:
        """Whether nothing is left to try from a grasp after these misses."""
        return (
            _short(misses) == len(self._shares)
            or sum(missed.reason in IN_THE_WAY for missed in misses) == MAX_RETREATS
            or sum(missed.reason in BROKEN for missed in misses) == MAX_BROKEN
        )

    def _stand(self, history: Sequence[Touch]) -> _Stand:
        """Where all touches so far leave the hand."""
        if not len(history):
            raise InputError("the history is empty: it begins with the first touch")
        grasps: list[Grasp] = []
        stand = _Stand()
        self._require_own(history)
        for touch in history:
            since = None if stand.since is None else stand.since + 1
            if isinstance(touch.felt, Grasp):
                grasps.append(touch.felt)
                stand = _Stand(touch.felt, (), since)
                continue
            misses = (*stand.misses, touch.felt)
            unlucky = self._spent(misses) and touch.felt.reason not in BROKEN
            if self._careful_for and grasps and not stand.lost and unlucky:
                way = tuple(grasp.q for grasp in reversed(grasps[:-1]))
                stand = _Stand(grasps[0], (), 0, True, way)
            else:
                stand = _Stand(stand.grasp, misses, since, stand.lost)
        return stand

    def _require_own(self, history: Sequence[Touch]) -> None:
        """Raise InputError unless the touches are of this robot, and of one hand."""
        first: Grasp | None = None
        postures: list[np.ndarray] = []
        for touch in history:
            if not isinstance(touch, Touch):
                raise InputError(f"a history holds Touch values; got {touch!r}")
            if len(touch.q_target) != self.robot.n:
                raise InputError(
                    f"a touch has {len(touch.q_target)} joints, {self.robot} has {self.robot.n}: "
                    "is it of another robot?"
                )
            postures.append(touch.q_target)
            if isinstance(touch.felt, Grasp):
                postures.append(touch.felt.q)
                first = first or touch.felt
                if touch.felt.k != first.k:
                    raise InputError(
                        f"a touch felt {touch.felt.k} contacts, the first {first.k}: "
                        "is it of another hand?"
                    )
        q, lower, upper = np.array(postures), self.robot.q_lower, self.robot.q_upper
        # A hand may begin outside a range, but not by more than all of it.
        for at, i in np.argwhere(np.maximum(lower - q, q - upper) > upper - lower):
            raise InputError(
                f"a touch has {self.robot.joints[i]} at {q[at, i]:g}, and its range is "
                f"{lower[i]:g} … {upper[i]:g}: is it of another robot, or in degrees?"
            )

    def _clipped(self, grasp: Grasp, x: np.ndarray) -> np.ndarray:
        """q + x within the ranges, as the very last act: only rounding may be cut."""
        q = grasp.q + x
        lower, upper = self._ranges
        clipped = np.clip(q, lower, upper)
        left = np.abs(clipped - q) > CLIP_TOLERANCE
        started_inside = (grasp.q >= lower) & (grasp.q <= upper)
        if (left & started_inside).any():
            worst = np.abs(clipped - q).max()
            raise HqpGraspError(f"a step left its range by {worst} rad: please report this")
        return np.where(left, q, clipped)  # a joint that started outside may still be on its way


def _short(misses: Sequence[Missed]) -> int:
    """How many misses found nothing, for which the step gets shorter."""
    return sum(missed.reason not in IN_THE_WAY + BROKEN for missed in misses)
