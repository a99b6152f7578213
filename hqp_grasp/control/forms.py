"""Ways to plan one step from a grasp, behind one signature."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal, Protocol, runtime_checkable

import numpy as np

from hqp_grasp.control.aim import Aim
from hqp_grasp.control.limits import ConfigurationLimit, RetreatLimit, cap_ratio
from hqp_grasp.control.memory import SurfaceMemory, steadied
from hqp_grasp.control.paper import laws, paper_levels, why_not
from hqp_grasp.control.settling import Course
from hqp_grasp.errors import instance, one_of
from hqp_grasp.grasp import Grasp, Missed, Touch
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.hierarchy.level import Level, Solution
from hqp_grasp.hierarchy.projection import Projection
from hqp_grasp.tasks import ForceTask, KinematicTask, MomentTask, Priority, Stack

LEANING = 0.25 * np.pi  # [rad] mean angle of fingers to normals, above which they push aside
RECENT = 10  # touches, whose misses make the hand aim elsewhere
TRIED = 4  # aims, at most
REACHED = 0.2  # [–] share of the way that ranges may keep the hand from, or the next is tried
NEAR = 1e-3  # [m] ways shorter than this count as that long
SHORTENINGS = 3  # of the way to an aim, until its step fits the caps
CAP_TOLERANCE = 1e-9  # [–] over a cap
TOUCH_RANK = 1e-6  # [–] normals felt to 1e-7 say nothing about directions weaker than this
SR_DAMPING = 1e-5  # λ of eq. 13 [m²/rad²]


@dataclass(frozen=True, eq=False)
class Plan:
    """A step x = Δq, and how it was found."""

    x: np.ndarray  # (n,) [rad]
    solution: Solution
    limit_active: bool  # a limit holds or has cut the step
    gap: float | None  # [rad] ‖x − projection‖∞ where no limit is active, else None
    solve_us: float  # [µs]
    exact: bool = False  # x leads to a posture, joint by joint: it is not to be landed
    planner: str = ""  # the rule that planned: "surface memory", "memoryless", …
    reason: str = ""  # why it is another step than the laws ask for


@runtime_checkable
class Form(Protocol):
    """From a stack with its limits and a grasp to the next step."""

    def check(self, stack: Stack) -> None:
        """Raise InputError for a stack that this form cannot compose."""
        ...

    def plan(
        self,
        stack: Stack,
        grasp: Grasp,
        history: Sequence[Touch] = (),
        left: int | None = None,
        careful: bool = False,
    ) -> Plan:
        """The step x = Δq that the laws ask for, within the limits.

        `grasp` is the one to step from, the last felt; `history` is all that was felt, for a form
        that remembers; `left` is how many more touches there may be. `careful` asks for a surer
        step, even if it is a shorter one: the hand was lost and begins again.
        """
        ...


@dataclass(frozen=True)
class MemorylessForm:
    """Limits and laws of the last grasp as one strict hierarchy in joint space, solved at once.

    Where the step that the laws would take without limits is too long for the caps, all of them
    ask for the same share of it. Caps alone would give the first law all that they allow, joint by
    joint, and leave the others the rest: priorities would hold, and the step lose its direction.
    """

    hqp: HQP = field(default_factory=lambda: HQP(rank_tolerance=TOUCH_RANK))

    def __post_init__(self) -> None:
        instance("MemorylessForm.hqp", self.hqp, HQP)

    def check(self, stack: Stack) -> None:
        """Every stack has this form."""

    def plan(
        self,
        stack: Stack,
        grasp: Grasp,
        history: Sequence[Touch] = (),
        left: int | None = None,
        careful: bool = False,
    ) -> Plan:
        return _memoryless(self.hqp, stack, grasp)


@dataclass(frozen=True)
class PaperHierarchyForm:
    """The paper's own two levels, J q̇ = ẋ of eq. 11 ▷ q̇ = q̇_c of eq. 9, strictly below limits.

    Without limits it is eq. 13 with λ → 0.
    """

    hqp: HQP = field(default_factory=lambda: HQP(rank_tolerance=TOUCH_RANK))

    def __post_init__(self) -> None:
        instance("PaperHierarchyForm.hqp", self.hqp, HQP)

    def check(self, stack: Stack) -> None:
        laws(stack)

    def plan(
        self,
        stack: Stack,
        grasp: Grasp,
        history: Sequence[Touch] = (),
        left: int | None = None,
        careful: bool = False,
    ) -> Plan:
        return _paper_hierarchy(self.hqp, stack, grasp)


@dataclass(frozen=True)
class ClippedForm:
    """The strict projection of the same laws, scaled to the caps, then clipped to the ranges."""

    projection: Projection = field(default_factory=lambda: Projection(rank_tolerance=TOUCH_RANK))

    def __post_init__(self) -> None:
        instance("ClippedForm.projection", self.projection, Projection)

    def check(self, stack: Stack) -> None:
        """Every stack has this form."""

    def plan(
        self,
        stack: Stack,
        grasp: Grasp,
        history: Sequence[Touch] = (),
        left: int | None = None,
        careful: bool = False,
    ) -> Plan:
        begin = time.perf_counter()
        solution = self.projection.solve(stack.law_levels(grasp))
        return _clipped(solution, stack, grasp, begin, "clipped")


@dataclass(frozen=True)
class PaperForm:
    """Gradients composed in contact space, mapped by the SR-inverse (eq. 11–13), then clipped."""

    projection: Projection = field(default_factory=lambda: Projection(damping=SR_DAMPING))

    def __post_init__(self) -> None:
        instance("PaperForm.projection", self.projection, Projection)

    def check(self, stack: Stack) -> None:
        laws(stack)

    def plan(
        self,
        stack: Stack,
        grasp: Grasp,
        history: Sequence[Touch] = (),
        left: int | None = None,
        careful: bool = False,
    ) -> Plan:
        begin = time.perf_counter()
        solution = self.projection.solve(paper_levels(stack, grasp))
        return _clipped(solution, stack, grasp, begin, "paper")


@dataclass(frozen=True)
class HierarchyForm:
    """The strict hierarchy, after what all touches together say of the surface.

    Force and moment go after the best of the places where the contacts would balance (`Aim`), and
    the other laws take what is left. The share of the way that the caps allow is taken; below it,
    the share of the other laws' step for which they leave room, half of it for each balanced grasp
    that such a step made worse. An aim is passed over for the next where, by the Jacobian, limits
    other than caps keep the hand from its end, and so is one aim for every two misses among the
    last touches.

    While fingers push along the surface rather than into it, by their mean angle to the normal, and
    where it is to be careful, the step is the PaperHierarchyForm's: slower and surer. The first is
    for the first touches only, and keeps the hand out of postures that balance but hold badly.
    After every two misses from one grasp another of these ways, and the MemorylessForm's, is taken.

    Without a ForceTask and a MomentTask, and for other than two or three contacts, steps are the
    MemorylessForm's; the hand settles all the same (`Course`). `Plan.planner` says which rule
    planned a step.
    """

    hqp: HQP = field(default_factory=lambda: HQP(rank_tolerance=TOUCH_RANK))
    shares: ClassVar[tuple[float, ...]] = (1.0, 0.5) * 4  # of a step, while nothing is touched
    careful_for: ClassVar[int] = 10  # touches, after the hand began again from its first grasp

    def __post_init__(self) -> None:
        instance("HierarchyForm.hqp", self.hqp, HQP)

    def check(self, stack: Stack) -> None:
        """Every stack has this form."""

    def plan(
        self,
        stack: Stack,
        grasp: Grasp,
        history: Sequence[Touch] = (),
        left: int | None = None,
        careful: bool = False,
    ) -> Plan:
        begin = time.perf_counter()
        history = history or (Touch(grasp.q, grasp),)
        last = [touch.felt for touch in history].index(grasp)
        history = steadied(history)
        grasp = history[last].felt  # type: ignore[assignment]
        course = Course.of(stack, history)
        back = course.way_back(left, grasp)
        if back is not None:
            return self._back(stack, grasp, back, begin)
        way = self._way(stack, grasp, history, careful)
        if way == "paper":
            return _paper_hierarchy(self.hqp, stack, grasp)
        aims = self._aims(stack, grasp, history, course) if way == "aim" else []
        if not aims:
            return _memoryless(self.hqp, stack, grasp)
        gain = min(1.0, *(t.gain for t in stack.tasks if isinstance(t, ForceTask | MomentTask)))
        missing = []
        for aim in aims:
            missing.append(self._missing(aim, gain, stack))
            if missing[-1] < REACHED:
                break
        aim = aims[int(np.argmin(missing))]
        return self._towards(aim, gain, stack, course.ease, begin)

    def _way(
        self, stack: Stack, grasp: Grasp, history: Sequence[Touch], careful: bool
    ) -> Literal["paper", "aim", "memoryless"]:
        there = [any(isinstance(v, law) for v in stack.tasks) for law in (ForceTask, MomentTask)]
        if not all(there) or grasp.k not in (2, 3):
            return "memoryless"
        careful = careful or (len(history) <= self.careful_for and _fingers_lean(stack, grasp))
        ways: list[Literal["paper", "aim", "memoryless"]] = ["aim", "memoryless"]
        if careful and not why_not(stack):
            ways.insert(0, "paper")
        misses = _misses_since_a_grasp(history) % len(self.shares)  # after so many it begins again
        return ways[misses // 2 % len(ways)]

    def _aims(
        self, stack: Stack, grasp: Grasp, history: Sequence[Touch], course: Course
    ) -> list[Aim]:
        """Where to go, the best first, after what misses passed over."""
        radius = next(task.radius for task in stack.tasks if isinstance(task, ForceTask))
        aims = Aim.each(SurfaceMemory.of(history, radius), grasp, course.unbalanced)
        misses = sum(isinstance(touch.felt, Missed) for touch in history[-RECENT:])
        return aims[min(misses // 2, max(len(aims) - 1, 0)) :][:TRIED]

    def _towards(self, aim: Aim, gain: float, stack: Stack, ease: float, begin: float) -> Plan:
        grasp, share = aim.grasp, gain
        projection = Projection(rank_tolerance=self.hqp.rank_tolerance)
        for _ in range(SHORTENINGS):
            aimed, rest = aim.levels(stack, share, share / gain)
            rest = [Level.equal(v.A, ease * v.upper, v.name) for v in rest]
            unlimited = projection.solve(aimed + rest).x
            ratio = cap_ratio(unlimited, stack, grasp)
            if ratio <= 1.0 + CAP_TOLERANCE:
                break
            share /= ratio
        return _planned(
            self.hqp, stack, grasp, aimed + rest, unlimited, share < gain, begin, "surface memory"
        )

    def _missing(self, aim: Aim, gain: float, stack: Stack) -> float:
        """Share of the whole way that limits other than caps keep the hand from.

        Where the answer is not certified, no way is shown to lead there: all of it.
        """
        uncapped = [v.level(aim.grasp) for v in stack.limits if v.priority is not Priority.CAP]
        motion = aim.predicted(gain)[0].ravel()
        way = Level.equal(aim.grasp.jacobian, motion, "whole way")
        solution = self.hqp.solve([*uncapped, way])
        if not solution.certified:
            return 1.0
        x = solution.x
        left, asked = np.linalg.norm(way.A @ x - motion), np.linalg.norm(motion)
        return float(left) / max(float(asked), NEAR)

    def _back(self, stack: Stack, grasp: Grasp, q: np.ndarray, begin: float) -> Plan:
        """Straight back to q, joint by joint, as far as the caps allow.

        The hand has been there: no retreat is due.
        """
        limits = tuple(v for v in stack.limits if not isinstance(v, RetreatLimit))
        stack = replace(stack, limits=limits)
        x = q - grasp.q
        share = 1.0 / max(1.0, cap_ratio(x, stack, grasp))
        level = Level.equal(np.eye(grasp.n), share * x, "back")
        plan = _planned(
            self.hqp, stack, grasp, [level], x, share < 1.0, begin, "return to the best grasp"
        )
        return replace(plan, exact=True)


def _fingers_lean(stack: Stack, grasp: Grasp) -> bool:
    """Whether the kinematic law's mean angle says that fingers push along the surface."""
    laws = [v for v in stack.tasks if isinstance(v, KinematicTask) and v.kind == "angle"]
    return any(float(law.error(grasp).mean()) > LEANING for law in laws)


def _misses_since_a_grasp(history: Sequence[Touch]) -> int:
    """How many touches have missed since the last that did not."""
    felt = [i for i, touch in enumerate(history) if isinstance(touch.felt, Grasp)]
    return len(history) - 1 - felt[-1]


FORMS = ("hierarchy", "memoryless", "paper-hierarchy", "clipped", "paper")


def form_of(name: str, solver: str = "proxqp") -> Form:
    """The form of that name, one of FORMS; `solver` is that of the hierarchies."""
    one_of("form", name, FORMS)
    hqp = HQP(solver, rank_tolerance=TOUCH_RANK)
    if name == "hierarchy":
        return HierarchyForm(hqp)
    if name == "memoryless":
        return MemorylessForm(hqp)
    if name == "paper-hierarchy":
        return PaperHierarchyForm(hqp)
    return ClippedForm() if name == "clipped" else PaperForm()


def _memoryless(hqp: HQP, stack: Stack, grasp: Grasp) -> Plan:
    return _hierarchy(hqp, stack, grasp, stack.law_levels(grasp), "memoryless")


def _paper_hierarchy(hqp: HQP, stack: Stack, grasp: Grasp) -> Plan:
    return _hierarchy(hqp, stack, grasp, paper_levels(stack, grasp), "paper-hierarchy")


def _hierarchy(hqp: HQP, stack: Stack, grasp: Grasp, levels: list[Level], planner: str) -> Plan:
    """The step of `levels` below the limits, all asking for the share of it that fits the caps."""
    begin = time.perf_counter()
    unlimited = Projection(rank_tolerance=hqp.rank_tolerance).solve(levels).x
    share = 1.0 / max(1.0, cap_ratio(unlimited, stack, grasp))
    asked = [Level.equal(level.A, share * level.upper, level.name) for level in levels]
    return _planned(hqp, stack, grasp, asked, unlimited, share < 1.0, begin, planner)


def _planned(
    hqp: HQP,
    stack: Stack,
    grasp: Grasp,
    asked: list[Level],
    unlimited: np.ndarray,
    shortened: bool,
    begin: float,
    planner: str,
) -> Plan:
    """The certified answer of the limits and as many of the levels asked for as have one.

    In a strict hierarchy the answer of the first levels is theirs whatever is asked below: where
    the whole is not certified, the last level is left out, and so on. Where not even limits are
    certified, the hand stays.
    """
    levels = [*stack.limit_levels(grasp), *asked]
    least = max(1, len(levels) - len(asked))
    solution, left_out = hqp.solve(levels), []
    while not solution.certified and len(levels) > least:
        left_out.append(levels.pop().name)
        solution = hqp.solve(levels)
    limit_active = shortened or solution.limit_active
    x, reason = solution.x, ""
    if not solution.certified:
        x, reason = np.zeros(grasp.n), "the hand stays: no answer is certified"
    elif left_out:
        reason = f"without {' and '.join(left_out[::-1])}: their answer is not certified"
    gap = None if limit_active or reason else float(np.abs(x - unlimited).max())
    solve_us = 1e6 * (time.perf_counter() - begin)
    return Plan(x, solution, limit_active, gap, solve_us, planner=planner, reason=reason)


def _clipped(solution: Solution, stack: Stack, grasp: Grasp, begin: float, planner: str) -> Plan:
    solve_us = 1e6 * (time.perf_counter() - begin)
    x = clip_to_limits(solution.x, stack, grasp)
    limit_active = not np.array_equal(x, solution.x)
    return Plan(x, solution, limit_active, None, solve_us, planner=planner)


def clip_to_limits(x: np.ndarray, stack: Stack, grasp: Grasp) -> np.ndarray:
    """What is done to a step that knows no limits.

    It is scaled to the caps, moved the least way that keeps clear, and clipped to the ranges. The
    scale keeps the step's direction; the others do not keep its priorities.
    """
    x = x / max(1.0, cap_ratio(x, stack, grasp))
    for limit in stack.limits:
        if limit.priority is Priority.CLEARANCE:
            level = limit.level(grasp)
            x = x - np.linalg.pinv(level.A) @ level.residual(x)
    for limit in stack.limits:
        if isinstance(limit, ConfigurationLimit):
            robot = limit.robot
            x = np.clip(x, robot.q_lower - grasp.q, robot.q_upper - grasp.q)
    return x
