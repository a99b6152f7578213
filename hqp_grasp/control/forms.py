"""Three ways to plan one step from a grasp, behind one signature."""

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
from hqp_grasp.hierarchy.level import Solution
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
    """Limits and laws as one strict hierarchy in joint space, solved at once."""

    hqp: HQP = field(default_factory=lambda: HQP(rank_tolerance=TOUCH_RANK))

    def check(self, stack: Stack) -> None:
        """Every stack has this form."""

    def plan(self, stack: Stack, grasp: Grasp) -> Plan:
        laws = stack.law_levels(grasp)
        levels = stack.limit_levels(grasp) + laws
        begin = time.perf_counter()
        solution = self.hqp.solve(levels)
        solve_us = 1e6 * (time.perf_counter() - begin)
        gap = None
        if not solution.limit_active:
            projected = Projection(rank_tolerance=self.hqp.rank_tolerance).solve(laws)
            gap = float(np.abs(solution.x - projected.x).max())
        return Plan(solution.x, solution, solution.limit_active, gap, solve_us)


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


FORMS = ("hierarchy", "clipped", "paper")


def form_of(name: str, solver: str = "proxqp") -> Form:
    """The form of that name, one of FORMS; `solver` is the hierarchy's."""
    one_of("form", name, FORMS)
    if name == "hierarchy":
        return HierarchyForm(HQP(solver, rank_tolerance=TOUCH_RANK))
    return ClippedForm() if name == "clipped" else PaperForm()


def _clipped(solution: Solution, stack: Stack, grasp: Grasp, begin: float) -> Plan:
    solve_us = 1e6 * (time.perf_counter() - begin)
    x = clip_to_limits(solution.x, stack, grasp)
    return Plan(x, solution, not np.array_equal(x, solution.x), None, solve_us)


def clip_to_limits(x: np.ndarray, stack: Stack, grasp: Grasp) -> np.ndarray:
    """What is done to a step that knows no limits: scaled to the caps, then clipped to the ranges.

    The scale keeps the step's direction, the clip does not keep its priorities.
    """
    x = x / max(1.0, cap_ratio(x, stack, grasp))
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
