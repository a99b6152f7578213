"""How near the touches came to what the laws ask, which to keep, and when to go back to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hqp_grasp.control.limits import cap_ratios
from hqp_grasp.grasp import BEYOND, Grasp, Touch
from hqp_grasp.mechanics import SECURE, friction_demand
from hqp_grasp.surface.felt import SLACK, SURE
from hqp_grasp.tasks import Stack, Task

Beside = tuple[Task, ...]  # laws at one priority

BETTER = 2e-3  # [rad] by which the other laws' errors fall, or the grasp is no better
HOPE = 20  # touches that bring no better grasp, before one that is secure is kept
PATIENCE = 3  # balanced grasps that are no better, before the hand settles
BACK = 1e-3  # [rad] from a posture, within which the hand is back there


@dataclass(frozen=True, eq=False)
class Progress:
    """How the touches of a history went, by the laws of a stack.

    A grasp is balanced where every law that has a goal has reached it; under noise, where it is
    within BEYOND times its floor. It counts only where the laws above those are as near as they
    ever were: none of these is given up for balance. BETTER shows in as many grasps as average the
    noise to it. A grasp that is not there any more, because the object has moved, is forgotten.

    Where no grasp balances, as on walls that lean, friction may hold the object all the same: the
    hand keeps the grasp of least friction demand. It looks for a better one as long as there are
    touches left; but from one that is SECURE, only until HOPE touches have brought none.
    """

    stack: Stack
    touches: Sequence[Touch]
    scores: np.ndarray  # of each touch: errors by what a balanced grasp has at most; inf: a miss
    nearest: int  # touch to keep: the best, or that of least friction demand where none balances
    best: int  # touch with the best of the balanced grasps, −1: none
    worse: int  # balanced grasps that were worse than the best before
    over: bool  # whether it is time to go back

    @classmethod
    def of(cls, stack: Stack, touches: Sequence[Touch]) -> Progress:
        """Of touches with one grasp at least."""
        hits = [t.felt for t in touches if isinstance(t.felt, Grasp)]
        felt = [isinstance(touch.felt, Grasp) for touch in touches]
        goals = any(task.goal is not None for task in stack.tasks)
        scores, doubtful = np.full((2, len(touches)), np.inf)
        scores[felt], doubtful[felt] = np.transpose([_scores(stack, grasp) for grasp in hits])
        above, below = _above_and_below(stack)
        away = np.full((len(touches), len(above)), np.inf)
        away[felt] = [_errors_of(above, grasp, hits) for grasp in hits]
        served = np.array(felt)
        for error in away.T:
            served &= error <= error[served].min() + BETTER
        met = [bool((errors <= BETTER).all()) for errors in away]
        noise = sum(contact.noise**2 for contact in hits[-1].contacts)  # [rad²] of the angles' sum
        patience = PATIENCE + noise / BETTER**2
        tells = max(BETTER, SURE * np.sqrt(2.0 * noise))
        best, stale, lost, worse = -1, 0, False, 0
        least: tuple[float, ...] = ()
        for i, touch in enumerate(touches):
            if scores[i] <= 1.0 and isinstance(touch.felt, Grasp):
                if lost or stale >= patience or not served[i]:
                    continue
                value = (*away[i], *_errors_of(below, touch.felt, hits))
                stale += 1
                worse += _differ(value, least, tells) > 0
                if best < 0 or _differ(value, least, BETTER) < 0:
                    best, least, stale = i, value, 0
            elif best >= 0 and goals:
                lost = lost or met[best] or stale >= patience
                stale += not lost
                if isinstance(touch.felt, Grasp) and _near(touch.q_target, touches[best]):
                    best, stale, lost = -1, 0, False
        if best >= 0:
            return cls(stack, touches, scores, best, best, worse, lost or stale >= patience)
        rows = sum(len(task.error(hits[0])) for task in stack.tasks if task.goal is not None)
        nearest, over = _nearest(touches, served, doubtful, rows >= 6)  # of a wrench
        return cls(stack, touches, scores, nearest, best, worse, over)

    @property
    def damping(self) -> float:
        """Share of the lower laws' step to take: half of it for each balanced grasp it made worse.

        Tips that are no balls touch now with a flat and now with an edge, elsewhere than predicted,
        and the more so the farther a step turns them. With them half is taken also for each grasp
        felt that was not balanced, the first left out.
        """
        halvings = self.worse
        hits = [t.felt for t in self.touches if isinstance(t.felt, Grasp)]
        radii = np.array([[contact.tip_radius for contact in grasp.contacts] for grasp in hits])
        if np.ptp(radii, axis=0).max() > SLACK:
            halvings += int((np.isfinite(self.scores) & (self.scores > 1.0)).sum()) - 1
        return 0.5 ** max(halvings, 0)

    def way_back(self, left: int | None, grasp: Grasp) -> np.ndarray | None:
        """The posture (n,) [rad] to go to on the way back, or None while there is reason to go on.

        Balanced grasps are kept: once the laws below improve no more, once a step from a balanced
        grasp lost it, and when the touches `left` only just suffice. So is the nearest, where there
        is none. The way begins at `grasp`.
        """
        if not self.over and left is None:
            return None
        way = self._way(grasp)
        # A step further, and it would take one more to return.
        return way[0] if self.over or (left is not None and left <= 1 + len(way)) else None

    def _way(self, grasp: Grasp) -> list[np.ndarray]:
        """Postures (n,) [rad] to head for, touch by touch, until the nearest grasp is reached.

        They are of grasps felt before, within the caps of the one before or next to it in the
        history: straight on there may be nothing to touch.
        """
        goal = self.touches[self.nearest].felt
        hits = [t.felt for t in self.touches if isinstance(t.felt, Grasp)]
        q = np.array([felt.q for felt in hits])
        ways: dict[int, list[np.ndarray]] = {hits.index(grasp): []}
        for i in (queue := list(ways)):
            if hits[i] is goal:
                break
            count = np.maximum(np.ceil(cap_ratios(q - q[i], self.stack, hits[i])), 1.0)
            count[np.abs(q - q[i]).max(axis=1) < BACK] = 0.0  # the hand is there
            beside = [j for j in (i - 1, i + 1) if 0 <= j < len(hits)]
            for j in (*np.flatnonzero(count <= 1.0).tolist(), *beside):
                if j not in ways:
                    ways[j] = [*ways[i], *[q[j]] * int(count[j])]
                    queue.append(j)
        return ways[i] or [q[i]]


def _nearest(
    touches: Sequence[Touch], served: np.ndarray, doubtful: np.ndarray, whole: bool
) -> tuple[int, bool]:
    """The touch to keep where none balances, and whether it is secure and nothing betters it.

    By the friction that it needs, where the laws balance the `whole` wrench; then, or else, by the
    `doubtful` scores.
    """
    nearest, least, stale, secure = -1, (np.pi, np.inf), 0, np.arctan(SECURE)
    for i, touch in enumerate(touches):
        stale += 1
        if not served[i] or not isinstance(touch.felt, Grasp):
            continue
        value = (_friction_angle(touch.felt) if whole else 0.0, doubtful[i])
        gone = value[0] > secure >= least[0] and _near(touch.q_target, touches[nearest])
        if gone or nearest < 0 or _differ(value, least, BETTER) < 0:
            nearest, least, stale = i, value, 0
    return nearest, bool(whole and least[0] <= secure and stale >= HOPE)


@lru_cache(maxsize=512)
def _friction_angle(grasp: Grasp) -> float:
    """Angle [rad] whose tangent is the friction demand, the larger for noise of the normals."""
    noise = max(contact.noise for contact in grasp.contacts)
    return float(np.arctan(friction_demand(grasp.positions, grasp.normals))) + SURE * noise


@lru_cache(maxsize=512)
def _scores(stack: Stack, grasp: Grasp) -> tuple[float, float]:
    """The worst law's eᵀe by its goal, as felt, and as it may be: 0 where no law has a goal.

    Felt, it counts only beyond what noise alone makes of it.
    """
    felt, doubtful = 0.0, 0.0
    for task in stack.tasks:
        goal = task.goal_at(grasp)
        if goal is not None:
            e, floor = task.error(grasp), task.floor(grasp)
            felt = max(felt, float(e @ e) / max(goal, BEYOND * floor))
            doubtful = max(doubtful, (float(e @ e) + floor) / goal)
    return felt, doubtful


def _above_and_below(stack: Stack) -> tuple[list[Beside], list[Beside]]:
    """The laws without a goal, by priority: those above the last that has one, and those below.

    A law beside one with a goal is as important as that is: it counts as above.
    """
    last = max((i for i, p in enumerate(stack.priorities) if _has_goal(p)), default=-1)
    others = [tuple(t for t in tasks if t.goal is None) for tasks in stack.priorities]
    above, below = others[: last + 1], others[last + 1 :]
    return [beside for beside in above if beside], [beside for beside in below if beside]


def _has_goal(tasks: Beside) -> bool:
    return any(task.goal is not None for task in tasks)


def _errors_of(priorities: Sequence[Beside], grasp: Grasp, hits: Sequence[Grasp]) -> list[float]:
    """Sum of absolute errors of each priority's laws [rad].

    A law of another unit counts by how far a joint has to turn for it: by the norm of its Jacobian
    at the first grasp where it is not zero. Laws beside one another count by their weights.
    """
    sums = []
    for tasks in priorities:
        heaviest = max(task.weight for task in tasks)
        sums.append(
            sum(
                float(np.abs(task.error(grasp)).sum())
                * (task.weight / heaviest / _per_radian(task, hits))
                for task in tasks
            )
        )
    return sums


def _per_radian(task: Task, hits: Sequence[Grasp]) -> float:
    """How much of a law's error a radian makes [unit of the error / rad]: 1 of an angle's."""
    if task.unit == "rad":
        return 1.0
    norms = (float(np.linalg.norm(task.jacobian(grasp), 2)) for grasp in hits)
    return next((norm for norm in norms if norm > 0.0), 1.0)


def _differ(value: Sequence[float], other: Sequence[float], tells: float) -> int:
    """−1 where the first entry that differs by more than `tells` is less, 1 where more, else 0."""
    for one, two in zip(value, other, strict=False):
        if abs(one - two) > tells:
            return -1 if one < two else 1
    return 0


def _near(q: np.ndarray, touch: Touch) -> bool:
    """Whether q is the posture of that touch, a hit."""
    return isinstance(touch.felt, Grasp) and bool(np.abs(q - touch.felt.q).max() < BACK)
