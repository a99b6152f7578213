"""Ways to plan one step from a grasp, behind one signature."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from hqp_grasp.control.limits import ConfigurationLimit
from hqp_grasp.control.paper import laws, paper_levels
from hqp_grasp.errors import one_of
from hqp_grasp.grasp import Grasp
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.hierarchy.level import Level, Solution
from hqp_grasp.hierarchy.projection import Projection
from hqp_grasp.tasks import Priority, Stack

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


class Form(Protocol):
    """From a stack with its limits and a grasp to the next step."""

    def check(self, stack: Stack) -> None:
        """Raise InputError for a stack that this form cannot compose."""
        ...

    def plan(self, stack: Stack, grasp: Grasp) -> Plan:
        """The step x = Δq that the laws ask for, within the limits."""
        ...


@dataclass(frozen=True)
class HierarchyForm:
    """Limits and laws as one strict hierarchy in joint space, solved at once.

    Where the step that the laws would take without limits is too long for the caps, all of them
    ask for the same share of it. Caps alone would give the first law all that they allow, joint by
    joint, and leave the others the rest: priorities would hold, and the step lose its direction.
    """

    hqp: HQP = field(default_factory=lambda: HQP(rank_tolerance=TOUCH_RANK))

    def check(self, stack: Stack) -> None:
        """Every stack has this form."""

    def plan(self, stack: Stack, grasp: Grasp) -> Plan:
        return _hierarchy(self.hqp, stack, grasp, stack.law_levels(grasp))


@dataclass(frozen=True)
class PaperHierarchyForm:
    """The paper's own two levels, J q̇ = ẋ of eq. 11 ▷ q̇ = q̇_c of eq. 9, strictly below limits.

    Without limits it is eq. 13 with λ → 0.
    """

    hqp: HQP = field(default_factory=lambda: HQP(rank_tolerance=TOUCH_RANK))

    def check(self, stack: Stack) -> None:
        laws(stack)

    def plan(self, stack: Stack, grasp: Grasp) -> Plan:
        return _hierarchy(self.hqp, stack, grasp, paper_levels(stack, grasp))


@dataclass(frozen=True)
class ClippedForm:
    """The strict projection of the same laws, scaled to the caps, then clipped to the ranges."""

    projection: Projection = field(default_factory=lambda: Projection(rank_tolerance=TOUCH_RANK))

    def check(self, stack: Stack) -> None:
        """Every stack has this form."""

    def plan(self, stack: Stack, grasp: Grasp) -> Plan:
        begin = time.perf_counter()
        solution = self.projection.solve(stack.law_levels(grasp))
        return _clipped(solution, stack, grasp, begin)


@dataclass(frozen=True)
class PaperForm:
    """Gradients composed in contact space, mapped by the SR-inverse (eq. 11–13), then clipped."""

    projection: Projection = field(default_factory=lambda: Projection(damping=SR_DAMPING))

    def check(self, stack: Stack) -> None:
        laws(stack)

    def plan(self, stack: Stack, grasp: Grasp) -> Plan:
        begin = time.perf_counter()
        solution = self.projection.solve(paper_levels(stack, grasp))
        return _clipped(solution, stack, grasp, begin)


FORMS = ("hierarchy", "paper-hierarchy", "clipped", "paper")


def form_of(name: str, solver: str = "proxqp") -> Form:
    """The form of that name, one of FORMS; `solver` is that of the hierarchies."""
    one_of("form", name, FORMS)
    hqp = HQP(solver, rank_tolerance=TOUCH_RANK)
    if name == "hierarchy":
        return HierarchyForm(hqp)
    if name == "paper-hierarchy":
        return PaperHierarchyForm(hqp)
    return ClippedForm() if name == "clipped" else PaperForm()


def _hierarchy(hqp: HQP, stack: Stack, grasp: Grasp, levels: list[Level]) -> Plan:
    """The step of `levels` below the limits, all asking for the share of it that fits the caps."""
    begin = time.perf_counter()
    unlimited = Projection(rank_tolerance=hqp.rank_tolerance).solve(levels).x
    share = 1.0 / max(1.0, cap_ratio(unlimited, stack, grasp))
    asked = [Level.equal(level.A, share * level.upper, level.name) for level in levels]
    solution = hqp.solve(stack.limit_levels(grasp) + asked)
    solve_us = 1e6 * (time.perf_counter() - begin)
    limit_active = share < 1.0 or solution.limit_active
    gap = None if limit_active else float(np.abs(solution.x - unlimited).max())
    return Plan(solution.x, solution, limit_active, gap, solve_us)


def _clipped(solution: Solution, stack: Stack, grasp: Grasp, begin: float) -> Plan:
    solve_us = 1e6 * (time.perf_counter() - begin)
    x = clip_to_limits(solution.x, stack, grasp)
    return Plan(x, solution, not np.array_equal(x, solution.x), None, solve_us)


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


def cap_ratio(x: np.ndarray, stack: Stack, grasp: Grasp) -> float:
    """How many times too long x is for the caps of its stack; 1 or less: it fits."""
    ratio = 0.0
    for limit in stack.limits:
        if limit.priority is Priority.CAP:
            level = limit.level(grasp)
            value = level.A @ x
            bound = np.where(value > 0.0, level.upper, -level.lower)
            ratio = max(ratio, float((np.abs(value) / bound).max(initial=0.0)))
    return ratio
