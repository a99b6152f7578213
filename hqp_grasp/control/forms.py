"""Ways to plan one step from a grasp, behind one signature."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from hqp_grasp.control.episode import Episode, MissPolicy
from hqp_grasp.control.limits import ConfigurationLimit, RetreatLimit, cap_ratio
from hqp_grasp.control.paper import laws, paper_levels, why_not
from hqp_grasp.control.progress import Progress
from hqp_grasp.control.step import Plan, scaled, strict_step
from hqp_grasp.control.targets import Target, nearest_free
from hqp_grasp.errors import instance, one_of, positive, whole
from hqp_grasp.grasp import Grasp
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.hierarchy.level import Level
from hqp_grasp.hierarchy.projection import Projection
from hqp_grasp.surface.believed import believed
from hqp_grasp.surface.felt import Felt
from hqp_grasp.surface.surface import Surface
from hqp_grasp.tasks import ForceTask, Priority, Stack
from hqp_grasp.tasks.contact_space import in_contact_space
from hqp_grasp.tasks.kinematic import is_kinematic

TOUCH_RANK = 1e-6  # [–] normals felt to 1e-7 say nothing about directions weaker than this
SR_DAMPING = 1e-5  # λ of eq. 13 [m²/rad²]


def _hqp() -> HQP:
    return HQP(rank_tolerance=TOUCH_RANK)


class Form(ABC):
    """From a stack with its limits and an episode to the next step. One of one's own has `plan`."""

    misses: ClassVar[MissPolicy] = MissPolicy()  # what the hand does after them

    def check(self, stack: Stack) -> None:  # noqa: B027 - every stack has a form, unless it objects
        """Raise InputError for a stack that this form cannot compose."""

    @abstractmethod
    def plan(self, stack: Stack, episode: Episode) -> Plan:
        """The step x = Δq from `episode.stand` that the laws ask for, within the limits."""


@dataclass(frozen=True)
class MemorylessForm(Form):
    """Limits and laws of the last grasp as one strict hierarchy in joint space, solved at once.

    Where the step that the laws would take without limits is too long for the caps, all of them
    ask for the same share of it.
    """

    hqp: HQP = field(default_factory=_hqp)

    def __post_init__(self) -> None:
        instance("MemorylessForm.hqp", self.hqp, HQP)

    def plan(self, stack: Stack, episode: Episode) -> Plan:
        grasp = episode.stand
        return strict_step(self.hqp, stack, grasp, scaled(stack.law_levels(grasp)), "memoryless")


@dataclass(frozen=True)
class PaperHierarchyForm(Form):
    """The paper's own two levels, J q̇ = ẋ of eq. 11 ▷ q̇ = q̇_c of eq. 9, strictly below limits.

    Without limits it is eq. 13 with λ → 0.
    """

    hqp: HQP = field(default_factory=_hqp)

    def __post_init__(self) -> None:
        instance("PaperHierarchyForm.hqp", self.hqp, HQP)

    def check(self, stack: Stack) -> None:
        laws(stack)

    def plan(self, stack: Stack, episode: Episode) -> Plan:
        grasp = episode.stand
        asked = scaled(paper_levels(stack, grasp))
        return strict_step(self.hqp, stack, grasp, asked, "paper-hierarchy")


@dataclass(frozen=True)
class ClippedForm(Form):
    """The strict projection of the same laws, scaled to the caps, then clipped to the ranges."""

    projection: Projection = field(default_factory=lambda: Projection(rank_tolerance=TOUCH_RANK))

    def __post_init__(self) -> None:
        instance("ClippedForm.projection", self.projection, Projection)

    def plan(self, stack: Stack, episode: Episode) -> Plan:
        hqp = HQP("active-set", rank_tolerance=self.projection.rank_tolerance)
        levels = lambda stack, grasp: stack.damped(stack.law_levels(grasp), grasp, hqp)  # noqa: E731
        return _clipped(self.projection, levels, stack, episode.stand, "clipped")


@dataclass(frozen=True)
class PaperForm(Form):
    """Gradients composed in contact space, mapped by the SR-inverse (eq. 11–13), then clipped."""

    projection: Projection = field(default_factory=lambda: Projection(damping=SR_DAMPING))

    def __post_init__(self) -> None:
        instance("PaperForm.projection", self.projection, Projection)

    def check(self, stack: Stack) -> None:
        laws(stack)

    def plan(self, stack: Stack, episode: Episode) -> Plan:
        return _clipped(self.projection, paper_levels, stack, episode.stand, "paper")


@dataclass(frozen=True)
class HierarchyForm(Form):
    """The strict hierarchy, after what all touches together say of the surface.

    Contacts go after the best of the places where their forces would balance (`Target`), each miss
    from one grasp to the next. The share of the way that the caps allow is taken; the laws below
    take the share of their own step for which that leaves room, half of it for each balanced grasp
    that such a step made worse. A target is passed over for the next where something keeps the hand
    from it. In the first touches, while fingers push along the surface rather than into it, the
    step is the PaperHierarchyForm's, unless it missed: that keeps the hand out of postures that
    balance but hold badly.

    Where no law has a goal, or no target is known, steps are the MemorylessForm's; the hand settles
    all the same (`Progress`). `Plan.planner` says which rule planned a step.
    """

    hqp: HQP = field(default_factory=_hqp)
    size: float = 0.05  # [m] radius of the object, where nothing felt tells more
    early: int = 10  # touches, in which fingers that push aside are first turned to push into it
    aside: float = 0.25 * np.pi  # [rad] their mean angle to the normals, above which they do
    surface: Surface | None = None  # the object's, where it is known; None: what was felt of it
    misses: ClassVar[MissPolicy] = MissPolicy(shares=(1.0, 0.5, 0.25, 0.1) * 2, restart=True)

    def __post_init__(self) -> None:
        instance("HierarchyForm.hqp", self.hqp, HQP)
        if self.surface is not None:
            instance("HierarchyForm.surface", self.surface, Surface)
        object.__setattr__(self, "size", positive("HierarchyForm.size [m]", self.size))
        object.__setattr__(self, "early", whole("HierarchyForm.early", self.early, 0))
        object.__setattr__(self, "aside", positive("HierarchyForm.aside [rad]", self.aside))

    def plan(self, stack: Stack, episode: Episode) -> Plan:
        begin = time.perf_counter()
        episode = episode.denoised()
        progress = Progress.of(stack, episode.touches)
        back = progress.way_back(episode.left, episode.stand)
        if back is not None:
            plan = self._back(stack, episode.stand, back)
        else:
            plan = self._towards_a_target(stack, episode, progress.damping) or MemorylessForm(
                self.hqp
            ).plan(stack, episode)
        return replace(plan, solve_us=1e6 * (time.perf_counter() - begin))

    def _towards_a_target(self, stack: Stack, episode: Episode, damping: float) -> Plan | None:
        """Towards the best target within reach; None where no law has a goal, or none is known."""
        grasp = episode.stand
        if grasp.k < 2 or all(task.goal is None for task in stack.tasks):
            return None
        early = len(episode.touches) <= self.early and not episode.missed
        if early and _angle_aside(stack, grasp) > self.aside and not why_not(stack):
            return PaperHierarchyForm(self.hqp).plan(stack, episode)
        apart = np.linalg.norm(grasp.positions - grasp.positions.mean(axis=0), axis=1).mean()
        felt = Felt.of(episode.touches, 2.0 * max(self.size, float(apart)))
        surface = self.surface or believed(felt, grasp, ForceTask().goal_at(grasp))
        targets = Target.each(surface, stack, grasp)
        if not targets:
            return None
        gain = min([1.0, *[task.gain for task in stack.tasks if in_contact_space(task)]])
        targets = targets[min(episode.missed, len(targets) - 1) :]
        target = targets[0] if episode.robot is None else nearest_free(targets, episode.robot, gain)
        asked = lambda share: target.levels(share, gain)  # noqa: E731
        return strict_step(
            self.hqp, stack, grasp, asked, "surface felt", gain, target.below(damping)
        )

    def _back(self, stack: Stack, grasp: Grasp, q: np.ndarray) -> Plan:
        """Straight back to q, joint by joint, as far as the caps allow.

        The hand has been there: no retreat is due.
        """
        limits = tuple(v for v in stack.limits if not isinstance(v, RetreatLimit))
        asked = scaled([Level.equal(np.eye(grasp.n), q - grasp.q, "back")])
        stack = replace(stack, limits=limits)
        plan = strict_step(self.hqp, stack, grasp, asked, "return to the best grasp")
        return replace(plan, exact=True)


def _angle_aside(stack: Stack, grasp: Grasp) -> float:
    """The fingers' mean angle [rad] to the normals, by the kinematic law; 0 where there is none."""
    angles = [task for task in stack.tasks if is_kinematic(task) and task.unit == "rad"]
    return max((float(task.error(grasp).mean()) for task in angles), default=0.0)


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


def _clipped(
    projection: Projection,
    levels: Callable[[Stack, Grasp], list[Level]],
    stack: Stack,
    grasp: Grasp,
    planner: str,
) -> Plan:
    begin = time.perf_counter()
    solution = projection.solve(levels(stack, grasp))
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
