"""The controller: from all that was felt so far to where the hand goes next."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hqp_grasp.control.episode import Episode, MissPolicy
from hqp_grasp.control.forms import Form, form_of
from hqp_grasp.control.landing import land
from hqp_grasp.control.limits import (
    ClearanceLimit,
    ConfigurationLimit,
    HoldLimit,
    RetreatLimit,
    StepLimit,
)
from hqp_grasp.control.reach import carried
from hqp_grasp.control.step import ROUNDING, Plan
from hqp_grasp.errors import HqpGraspError, InputError, flag, instance, whole
from hqp_grasp.grasp import Grasp, Missed, Touch
from hqp_grasp.hierarchy.level import Solution
from hqp_grasp.tasks import Priority, Stack, Task
from hqp_grasp.world.robot import Robot


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


@dataclass(frozen=True, init=False)
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

    What the hand does after misses is its form's `MissPolicy`. When nothing is left to try, or the
    `budget` of touches is spent, the controller gives up.
    """

    robot: Robot
    stack: Stack  # within limits of its own or the defaults
    form: Form
    budget: int | None  # touches in all, the first included
    landing: bool  # correct each step by the hand's kinematics, see `land`

    def __init__(
        self,
        robot: Robot,
        stack: Stack | Task,
        form: str | Form = "hierarchy",
        budget: int | None = None,
        landing: bool = True,
    ) -> None:
        instance("Controller.robot, such as Scene().articulated,", robot, Robot)
        budget = None if budget is None else whole("Controller.budget", budget, 1)
        stack = Stack.of(stack).on(robot.model)
        if not any(limit.priority is Priority.CAP for limit in stack.limits):
            stack = stack.within(StepLimit())
        if not any(limit.priority is Priority.RANGE for limit in stack.limits):
            stack = stack.within(ConfigurationLimit(robot))
        if robot.idle.any() and not any(isinstance(v, HoldLimit) for v in stack.limits):
            stack = stack.within(HoldLimit(robot))
        watched = any(isinstance(v, ClearanceLimit) for v in stack.limits)
        if robot.description.clearance > 0.0 and not watched:
            stack = stack.within(ClearanceLimit(robot))
        form = form if isinstance(form, Form) else form_of(form)
        form.check(stack)
        landing = flag("Controller.landing", landing)
        for name, value in {
            "robot": robot,
            "stack": stack,
            "form": form,
            "budget": budget,
            "landing": landing,
        }.items():
            object.__setattr__(self, name, value)

    def step(self, history: Sequence[Touch]) -> Step:
        """Return where to touch next, given every touch so far, hits and misses, in order.

        Raises InputError for an empty history, or one that is not of this robot.
        """
        if len(history):
            self._require_own(history)
        policy = self.form.misses
        episode = Episode.of(history, policy, self.budget, self.robot)
        grasp, misses = episode.grasp, episode.misses
        if episode.left is not None and episode.left <= 0:
            return Step(None, reason=f"the budget of {self.budget} touches is spent")
        if grasp is None:
            return self._search(history[0].q_target, policy.direction(misses), misses[-1])
        if policy.spent(misses):
            last = misses[-1]
            why = f"{last.reason.value} ({last.where})"
            return Step(None, reason=f"{len(misses)} misses from one grasp, the last: {why}")
        short = policy.shorter(misses)
        back = self._withdrawals(policy, misses)
        stack = self.stack.within(*(RetreatLimit(self.robot, far, g) for g, far in back.items()))
        plan = self.form.plan(stack, episode)
        share = policy.shares[short]
        x = (1.0 if plan.exact else share) * plan.x
        if self.landing and not plan.exact:
            x = land(self.robot, stack, grasp, x)
        reactions = {
            "from the first grasp again": episode.again,
            ", ".join(self._told(back)): back,
            f"{share:g} of the step": short,
            "the same again": misses and misses[-1].reason in policy.broken,
        }
        told = [what for what, done in reactions.items() if done]
        reason = ", ".join([*told, plan.reason] if plan.reason else told)
        return Step(self._clipped(grasp, x), episode.way, plan, share, reason)

    def _withdrawals(self, policy: MissPolicy, misses: Sequence[Missed]) -> dict[int, float]:
        """How far [m] groups withdraw, by group."""
        of = [self.robot.group_of(missed.where) for missed in misses]
        groups = range(len(self.robot.groups))
        far = {
            g: policy.withdrawal([m for m, group in zip(misses, of, strict=True) if group == g])
            for g in groups
        }
        return {g: distance for g, distance in far.items() if distance > 0.0}

    def _told(self, back: Mapping[int, float]) -> Iterator[str]:
        groups = self.robot.groups
        for g, distance in back.items():
            palm = f"palm {groups[g].name}" if len(groups) > 1 else "palm"
            yield f"{palm} back by {1e3 * distance:g} mm"

    def _search(self, q: np.ndarray, way: np.ndarray | None, missed: Missed) -> Step:
        """The first touch, sent to q (n,) [rad], again; the palm that missed goes `way` (3,) [m].

        Palms of other groups stay.
        """
        if way is not None and not way.any():
            return Step(q, reason="the same again")
        if way is None or not self.robot.arm:
            return Step(None, reason="no touch has felt a grasp: begin where the hand touches")
        group = self.robot.group_of(missed.where)
        postures = carried(self.robot, np.clip(q, *self._ranges), way, [group])
        if postures is None:
            return Step(q, reason="the same again: the arm cannot go beside")
        q = np.clip(postures[-1], *self._ranges)
        return Step(q, reason=f"{1e3 * np.linalg.norm(way):g} mm beside")

    @property
    def _ranges(self) -> tuple[np.ndarray, np.ndarray]:
        """The joints' ranges (n,) [rad], lower and upper, the narrowest of all limits."""
        limits = self.stack.limits
        robots = [self.robot, *(v.robot for v in limits if isinstance(v, ConfigurationLimit))]
        lower = np.max([robot.q_lower for robot in robots], axis=0)
        return lower, np.min([robot.q_upper for robot in robots], axis=0)

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
        left = np.abs(clipped - q) > ROUNDING
        started_inside = (grasp.q >= lower) & (grasp.q <= upper)
        if (left & started_inside).any():
            worst = np.abs(clipped - q).max()
            raise HqpGraspError(f"a step left its range by {worst} rad: please report this")
        return np.where(left, q, clipped)  # a joint that started outside may still be on its way
