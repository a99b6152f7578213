"""Ways to plan one step from a grasp, behind one signature."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from hqp_grasp.control.limits import ConfigurationLimit
from hqp_grasp.control.memory import UPRIGHT, Outline, SurfaceMemory
from hqp_grasp.control.paper import laws, paper_levels
from hqp_grasp.errors import one_of
from hqp_grasp.grasp import Grasp, Miss, Touch
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.hierarchy.level import Level, Solution
from hqp_grasp.hierarchy.projection import Projection
from hqp_grasp.tasks import ForceTask, KinematicTask, MomentTask, Priority, Stack

SETTLED = 2e-3
PATIENCE = 5
RECENT = 10  # touches
TRIED = 4
DISTINCT = 10
APART = 0.01  # [m]
ROOM = 0.01  # [m] from end faces
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


class Form(Protocol):
    """From a stack with its limits and a grasp to the next step."""

    def check(self, stack: Stack) -> None:
        """Raise InputError for a stack that this form cannot compose."""
        ...

    def plan(self, stack: Stack, grasp: Grasp, history: Sequence[Touch] = (), left: int | None = None) -> Plan:
        """The step x = Δq that the laws ask for, within the limits.

        `grasp` is the last felt; `history` is all that was felt, for a form that remembers.
        """
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

    def plan(self, stack: Stack, grasp: Grasp, history: Sequence[Touch] = (), left: int | None = None) -> Plan:
        return _hierarchy(self.hqp, stack, grasp, stack.law_levels(grasp))


@dataclass(frozen=True)
class PaperHierarchyForm:
    """The paper's own two levels, J q̇ = ẋ of eq. 11 ▷ q̇ = q̇_c of eq. 9, strictly below limits.

    Without limits it is eq. 13 with λ → 0.
    """

    hqp: HQP = field(default_factory=lambda: HQP(rank_tolerance=TOUCH_RANK))

    def check(self, stack: Stack) -> None:
        laws(stack)

    def plan(self, stack: Stack, grasp: Grasp, history: Sequence[Touch] = (), left: int | None = None) -> Plan:
        return _hierarchy(self.hqp, stack, grasp, paper_levels(stack, grasp))


@dataclass(frozen=True)
class ClippedForm:
    """The strict projection of the same laws, scaled to the caps, then clipped to the ranges."""

    projection: Projection = field(default_factory=lambda: Projection(rank_tolerance=TOUCH_RANK))

    def check(self, stack: Stack) -> None:
        """Every stack has this form."""

    def plan(self, stack: Stack, grasp: Grasp, history: Sequence[Touch] = (), left: int | None = None) -> Plan:
        begin = time.perf_counter()
        solution = self.projection.solve(stack.law_levels(grasp))
        return _clipped(solution, stack, grasp, begin)


@dataclass(frozen=True)
class PaperForm:
    """Gradients composed in contact space, mapped by the SR-inverse (eq. 11–13), then clipped."""

    projection: Projection = field(default_factory=lambda: Projection(damping=SR_DAMPING))

    def check(self, stack: Stack) -> None:
        laws(stack)

    def plan(self, stack: Stack, grasp: Grasp, history: Sequence[Touch] = (), left: int | None = None) -> Plan:
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


@dataclass(frozen=True)
class MemoryForm:
    """A strict hierarchy whose force and moment laws know all that was felt."""

    hqp: HQP = field(default_factory=lambda: HQP(rank_tolerance=TOUCH_RANK))
    shares = (1.0, 0.5) * 4

    def check(self, stack: Stack) -> None:
        """Every stack has this form."""

    def plan(
        self,
        stack: Stack,
        grasp: Grasp,
        history: Sequence[Touch] = (),
        left: int | None = None,
    ) -> Plan:
        force = next((t for t in stack.tasks if isinstance(t, ForceTask)), None)
        moment = any(isinstance(t, MomentTask) for t in stack.tasks)
        if force is None or not moment or grasp.k not in (2, 3):
            return _hierarchy(self.hqp, stack, grasp, stack.law_levels(grasp))
        history = history or [Touch(grasp.q, grasp)]
        begin = time.perf_counter()
        back = way_back(stack, history, left)
        if back is not None:
            return self._return(stack, grasp, back, begin)
        memory = SurfaceMemory.of(history, force.radius)
        misses = sum(not isinstance(touch.felt, Grasp) for touch in history[-RECENT:])
        best = None
        for aim in Aim.all_of(memory, grasp)[misses // 2 :][:TRIED]:
            found = self._towards(aim, stack, grasp)
            if best is None or found[0] < best[0]:
                best = found
            if found[0] < 0.1:
                break
        _, share, beta, solution, unlimited = best
        solve_us = 1e6 * (time.perf_counter() - begin)
        limit_active = share < 1.0 or beta < 1.0 or solution.limit_active
        gap = None if limit_active else float(np.abs(solution.x - unlimited).max())
        return Plan(solution.x, solution, limit_active, gap, solve_us)

    def _towards(self, aim, stack, grasp):
        share = 1.0
        projection = Projection(rank_tolerance=self.hqp.rank_tolerance)
        for _ in range(3):
            aimed, rest = aim.levels(stack, grasp, share)
            x = projection.solve(aimed).x
            ratio = cap_ratio(x, stack, grasp)
            if ratio <= 1.0 + 1e-9:
                break
            share /= ratio
        unlimited = projection.solve(aimed + rest).x
        beta = cap_share(x, unlimited - x, stack, grasp)
        rest = [Level.equal(v.A, v.A @ x + beta * (v.upper - v.A @ x), v.name) for v in rest]
        solution = self.hqp.solve(stack.limit_levels(grasp) + aimed + rest)
        way = aimed[-1]
        left = np.linalg.norm(way.A @ solution.x - way.upper) / max(np.linalg.norm(way.upper), 1e-3)
        return left, share, beta, solution, unlimited

    def _return(self, stack: Stack, grasp: Grasp, q: np.ndarray, begin: float) -> Plan:
        x = q - grasp.q
        share = 1.0 / max(1.0, cap_ratio(x, stack, grasp))
        level = Level.equal(np.eye(grasp.n), share * x, "return")
        solution = self.hqp.solve([*stack.limit_levels(grasp), level])
        solve_us = 1e6 * (time.perf_counter() - begin)
        return Plan(solution.x, solution, share < 1.0 or solution.limit_active, None, solve_us, True)


def way_back(stack: Stack, history: Sequence[Touch], left: int | None) -> np.ndarray | None:
    """Posture to return to."""
    score = np.array([_score(touch) for touch in history])
    best, value, stale, departures = -1, np.inf, 0, 0
    for i, touch in enumerate(history):
        if score[i] < 1.0:
            v = _below(stack, touch.felt)
            stale += 1
            if v < value - SETTLED or best < 0:
                best, value, stale = i, v, 0
        elif best >= 0:
            departures += 1
            if np.abs(touch.q_target - history[best].felt.q).max() < 1e-3:
                if isinstance(touch.felt, Grasp):  # the object has moved
                    best, value, stale, departures = -1, np.inf, 0, 0
    if best >= 0 and (departures or stale >= PATIENCE):
        return history[best].felt.q
    if left is not None:
        if best < 0:
            best = int(score.argmin())
        last = next(t.felt for t in reversed(history) if isinstance(t.felt, Grasp))
        if left <= 1 + np.abs(history[best].felt.q - last.q).max() / 0.35:
            return history[best].felt.q
    return None


def _below(stack: Stack, grasp: Grasp) -> float:
    return sum(float(np.abs(t.error(grasp)).sum()) for t in stack.tasks if not isinstance(t, ForceTask | MomentTask))


def _score(touch: Touch) -> float:
    if not isinstance(touch.felt, Grasp):
        return np.inf
    f = ForceTask().error(touch.felt)
    m = MomentTask().error(touch.felt)
    return max(f @ f / 1e-3, m @ m / 4e-6)


def cap_share(x: np.ndarray, more: np.ndarray, stack: Stack, grasp: Grasp) -> float:
    """The share of `more` that x has room for within the caps."""
    share = 1.0
    for limit in stack.limits:
        if limit.priority is Priority.CAP:
            level = limit.level(grasp)
            value, step = level.A @ x, level.A @ more
            room = np.where(step > 0.0, level.upper - value, value - level.lower)
            grows = np.abs(step) > 1e-12
            share = min(share, float((room[grows] / np.abs(step[grows])).min(initial=1.0)))
    return max(share, 0.0)


@dataclass(frozen=True)
class Aim:
    """Where contacts should go."""

    axis: np.ndarray
    outline: Outline
    s: np.ndarray
    goal: np.ndarray
    height: float  # [m] along the axis, of all contacts
    end: np.ndarray  # (k,) bool: the contact is on an end face or its rim
    cost: float

    @classmethod
    def all_of(cls, memory: SurfaceMemory, grasp: Grasp) -> list[Aim]:
        """Distinct, the best first."""
        rho = np.array([c.tip_radius for c in grasp.contacts])
        a = memory.axis(grasp)
        outline = memory.outline(a, float(rho.mean()))
        p = grasp.positions + rho[:, None] * grasp.normals
        s = outline.locate(p @ outline.frame.T)
        found = outline.balanced(s)
        cost = np.array([v[0] for v in found])
        goals = np.array([v[1] for v in found])
        end = np.abs(grasp.normals @ a) > UPRIGHT
        height = _height(memory, grasp, a, end)
        aims = []
        left = np.ones(len(cost), dtype=bool)
        while left.any() and len(aims) < DISTINCT:
            i = int(np.argmin(np.where(left, cost, np.inf)))
            left &= np.abs(goals - goals[i]).max(axis=1) > APART
            aims.append(cls(a, outline, s, goals[i], height, end, float(cost[i])))
        return aims

    def levels(self, stack: Stack, grasp: Grasp, share: float) -> tuple[list[Level], list[Level]]:
        E, a = self.outline.frame, self.axis
        n = grasp.normals
        rho = np.array([c.tip_radius for c in grasp.contacts])
        t0, x0 = self.outline.at(self.s)
        t1, x1 = self.outline.at(self.s + share * (self.goal - self.s))
        turn = t1 - t0
        p = grasp.positions + rho[:, None] * n
        rise = share * (self.height - p @ a)
        u = n @ E.T
        c, s = np.cos(turn), np.sin(turn)
        u1 = np.column_stack([c * u[:, 0] - s * u[:, 1], s * u[:, 0] + c * u[:, 1]])
        n1 = u1 @ E + (1 - share) * (n @ a)[:, None] * a
        n1 /= np.linalg.norm(n1, axis=1)[:, None]
        dx = (x1 - x0) @ E + rise[:, None] * a
        dp = dx + rho[:, None] * (n1 - n)
        if self.end.any():
            t1, x1 = self.outline.at(self.goal)
            side = np.column_stack([np.cos(t1), np.sin(t1)])
            p1 = (x1 + rho[:, None] * side) @ E + self.height * a
            dp = np.where(self.end[:, None], share * (p1 - p), dp)
            toward = (1.0 - share) * n + share * (side @ E)
            toward /= np.linalg.norm(toward, axis=1)[:, None]
            n1 = np.where(self.end[:, None], toward, n1)
            dx = dp - rho[:, None] * (n1 - n)
        x = grasp.positions - grasp.positions.mean(axis=0)
        levels, below, pending = [], [], 2
        if stack.hold_contacts:
            levels.append(Level.equal(grasp.normal_jacobian(), (n * dp).sum(axis=1), "contact"))
        # secants
        d2 = (dp * dp).sum(axis=1)
        moved = d2 > 1e-12
        d = dp / np.where(moved, np.sqrt(d2), 1.0)[:, None]
        q = dp / np.where(moved, d2, 1.0)[:, None]
        P = np.eye(3) - d[:, :, None] * d[:, None, :]
        df = n - n1
        dm = np.cross(n1, x + dx) - np.cross(n, x)
        for tasks in stack.priorities:
            rows, rest = [], []
            for task in tasks:
                A, b = task.rows(grasp)
                if isinstance(task, ForceTask | MomentTask):
                    de = df if isinstance(task, ForceTask) else dm
                    J = task.contact_jacobian(grasp).reshape(3, -1, 3).transpose(1, 0, 2)
                    if isinstance(task, ForceTask):
                        J = J @ (np.eye(3) - a[:, None] * a)
                    J = J @ P + de[:, :, None] * q[:, None, :]
                    A = task.weight * J.transpose(1, 0, 2).reshape(3, -1) @ grasp.jacobian
                    b = task.weight * de.sum(axis=0)
                rows.append(A)
                rest.append(b)
            (levels if pending else below).append(Level.equal(np.concatenate(rows), np.concatenate(rest), " + ".join(t.name for t in tasks)))
            pending -= sum(isinstance(task, ForceTask | MomentTask) for task in tasks)
            if not pending and not below:
                levels.append(self.way_level(grasp, dp, n))
                pending = 0
        return levels, below

    def way_level(self, grasp, dp, n):
        k = grasp.k
        t0, _ = self.outline.at(self.s)
        t = np.column_stack([-np.sin(t0), np.cos(t0)]) @ self.outline.frame
        J = grasp.jacobian.reshape(k, 3, -1)
        A = np.einsum("ka,kan->kn", t, J)
        z = np.einsum("a,kan->kn", self.axis, J)
        h = dp @ self.axis
        return Level.equal(np.concatenate([A, z]), np.concatenate([(t * dp).sum(axis=1), h]), "way")


def _height(memory: SurfaceMemory, grasp: Grasp, a: np.ndarray, end: np.ndarray) -> float:
    """Where along the axis contacts should be."""
    k = grasp.k
    x, n, R = memory.positions, memory.normals, memory.radii
    lean = n @ a
    side = np.abs(lean) < UPRIGHT
    middle = x @ a - R * lean
    if end.all():
        z = float(middle[side].mean()) if side.any() else float((x @ a).mean())
    else:
        z = float(middle[-k:][~end].mean())
    top, bottom = x[lean > UPRIGHT] @ a, x[lean < -UPRIGHT] @ a
    z = min(z, top.min(initial=np.inf) - ROOM)
    low = bottom.max(initial=-np.inf) + ROOM
    return z if z >= low else float(0.5 * (z + low))
