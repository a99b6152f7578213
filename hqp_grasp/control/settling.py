"""When to go no further, and back to the best grasp felt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hqp_grasp.control.limits import cap_ratios
from hqp_grasp.grasp import Grasp, Touch
from hqp_grasp.mechanics import friction_demand
from hqp_grasp.tasks import ForceTask, KinematicTask, MomentTask, Stack, Task

Beside = tuple[Task, ...]  # laws at one priority

FORCE_GOAL = 1e-3  # [N²] ε_f of a balanced grasp, at most
MOMENT_GOAL = (2e-3) ** 2  # [(N·m)²] ε_m of one, at most
BEYOND = 4.0  # times the floor of noise, within which a felt error says nothing
BETTER = 2e-3  # [rad] by which the other laws' errors fall, or the grasp is no better
TELLING = 2.0  # standard errors that tell two values apart
SECURE = 0.2  # [–] friction demand of a grasp that holds on nearly all that hands touch, at most
HOPE = 20  # touches that bring no better grasp, before one that is secure is kept
PATIENCE = 3  # balanced grasps that are no better, before the hand settles
BACK = 1e-3  # [rad] from a posture, within which the hand is back there
SAME_ROUNDING = 1e-6  # [m] radii of one tip differ by, as long as it is a ball


@dataclass(frozen=True, eq=False)
class Course:
    """How the touches of a history went, by the laws of a stack.

    A grasp is balanced by those of force and moment that the stack has, and by their goals; under
    noise within BEYOND times its floor. It counts only where the laws above them are as near as
    they ever were: none of these is given up for balance. BETTER shows in as many grasps as average
    the noise to it. A grasp that is not there any more, because the object has moved, is forgotten.

    Where no grasp balances, as on walls that lean, friction may hold the object all the same: the
    hand keeps the grasp of least friction demand. It looks for a better one as long as there are
    touches left; but from one that is SECURE, only until HOPE touches have brought none.
    """

    stack: Stack
    history: Sequence[Touch]
    scores: np.ndarray  # of each touch: errors by what a balanced grasp has at most; inf: a miss
    nearest: int  # touch of least friction demand, or nearest to balance by the laws there are
    best: int  # touch with the best of the balanced grasps, −1: none
    worse: int  # balanced grasps that were worse than the best before
    over: bool  # whether it is time to go back

    @classmethod
    def of(cls, stack: Stack, history: Sequence[Touch]) -> Course:
        """Of a history with one grasp at least."""
        hits = [t.felt for t in history if isinstance(t.felt, Grasp)]
        felt = [isinstance(touch.felt, Grasp) for touch in history]
        balance = [any(isinstance(t, law) for t in stack.tasks) for law in (ForceTask, MomentTask)]
        scores, doubtful = np.full((2, len(history)), np.inf)
        errors, floor = (v[:, balance] for v in _errors(hits))
        goals = np.array([FORCE_GOAL, MOMENT_GOAL])[balance]
        scores[felt] = (errors / np.maximum(goals, BEYOND * floor)).max(axis=1, initial=0.0)
        doubtful[felt] = ((errors + floor) / goals).max(axis=1, initial=0.0)
        above, below = _above_and_below(stack)
        away = np.full((len(history), len(above)), np.inf)
        away[felt] = [_errors_of(above, grasp, hits) for grasp in hits]
        served = np.array(felt)
        for error in away.T:
            served &= error <= error[served].min() + BETTER
        met = [bool((errors <= BETTER).all()) for errors in away]
        noise = sum(contact.noise**2 for contact in hits[-1].contacts)  # [rad²] of the angles' sum
        patience = PATIENCE + noise / BETTER**2
        tells = max(BETTER, TELLING * np.sqrt(2.0 * noise))
        best, stale, lost, worse = -1, 0, False, 0
        least: tuple[float, ...] = ()
        for i, touch in enumerate(history):
            if scores[i] <= 1.0:
                if lost or stale >= patience or not served[i]:
                    continue
                value = (*away[i], *_errors_of(below, touch.felt, hits))  # type: ignore[arg-type]
                stale += 1
                worse += _differ(value, least, tells) > 0
                if best < 0 or _differ(value, least, BETTER) < 0:
                    best, least, stale = i, value, 0
            elif best >= 0 and any(balance):
                lost = lost or met[best] or stale >= patience
                stale += not lost
                if isinstance(touch.felt, Grasp) and _near(touch.q_target, history[best]):
                    best, stale, lost = -1, 0, False
        over = lost or stale >= patience
        nearest = best
        if best < 0:
            nearest, over = _nearest(history, served, doubtful, all(balance))
        return cls(stack, history, scores, nearest, best, worse, over)

    @property
    def unbalanced(self) -> list[Grasp]:
        """The grasps felt that do not balance."""
        touches = zip(self.history, self.scores, strict=True)
        return [t.felt for t, score in touches if isinstance(t.felt, Grasp) and score > 1.0]

    @property
    def ease(self) -> float:
        """Share of the lower laws' step to take: half of it for each balanced grasp it made worse.

        Tips that are no balls touch now with a flat and now with an edge, elsewhere than predicted,
        and the more so the farther a step turns them. With them half is taken also for each grasp
        felt that was not balanced, the first left out.
        """
        halvings = self.worse
        hits = [t.felt for t in self.history if isinstance(t.felt, Grasp)]
        radii = np.array([[contact.tip_radius for contact in grasp.contacts] for grasp in hits])
        if np.ptp(radii, axis=0).max() > SAME_ROUNDING:
            halvings += len(self.unbalanced) - 1
        return 0.5 ** max(halvings, 0)

    def way_back(self, left: int | None, grasp: Grasp | None = None) -> np.ndarray | None:
        """The posture (n,) [rad] to go to on the way back, or None while there is reason to go on.

        Balanced grasps are kept: once the laws below force and moment improve no more, once a step
        from a balanced grasp lost it, and when the touches `left` only just suffice. So is the
        nearest, where there is none. The way begins at `grasp`, or at the last one felt.
        """
        if not self.over and left is None:
            return None
        way = self._way(grasp)
        # A step further, and it would take one more to return.
        return way[0] if self.over or left <= 1 + len(way) else None  # type: ignore[operator]

    def _way(self, grasp: Grasp | None) -> list[np.ndarray]:
        """Postures (n,) [rad] to head for, touch by touch, until the nearest grasp is reached.

        They are of grasps felt before, within the caps of the one before or next to it in the
        history: straight on there may be nothing to touch.
        """
        goal = self.history[self.nearest].felt
        hits = [t.felt for t in self.history if isinstance(t.felt, Grasp)]
        q = np.array([felt.q for felt in hits])
        start = len(hits) - 1 if grasp is None else hits.index(grasp)
        ways: dict[int, list[np.ndarray]] = {start: []}
        for i in (queue := [start]):
            if hits[i] is goal:
                break
            touches = np.maximum(np.ceil(cap_ratios(q - q[i], self.stack, hits[i])), 1.0)
            touches[np.abs(q - q[i]).max(axis=1) < BACK] = 0.0  # the hand is there
            beside = [j for j in (i - 1, i + 1) if 0 <= j < len(hits)]
            for j in (*np.flatnonzero(touches <= 1.0).tolist(), *beside):
                if j not in ways:
                    ways[j] = [*ways[i], *[q[j]] * int(touches[j])]
                    queue.append(j)
        return ways[i] or [q[i]]


def _nearest(
    history: Sequence[Touch], served: np.ndarray, doubtful: np.ndarray, whole: bool
) -> tuple[int, bool]:
    """The touch to keep where none balances, and whether it is secure and nothing betters it.

    By the friction that it needs, where the laws balance the `whole` wrench; then, or else, by the
    `doubtful` scores.
    """
    nearest, least, stale, secure = -1, (np.pi, np.inf), 0, np.arctan(SECURE)
    for i, touch in enumerate(history):
        stale += 1
        if not served[i]:
            continue
        value = (_friction_angle(touch.felt) if whole else 0.0, doubtful[i])
        gone = value[0] > secure >= least[0] and _near(touch.q_target, history[nearest])
        if gone or nearest < 0 or _differ(value, least, BETTER) < 0:
            nearest, least, stale = i, value, 0
    return nearest, bool(whole and least[0] <= secure and stale >= HOPE)


@lru_cache(maxsize=512)
def _friction_angle(grasp: Grasp) -> float:
    """Angle [rad] whose tangent is the friction demand, the larger for noise of the normals."""
    noise = max(contact.noise for contact in grasp.contacts)
    return float(np.arctan(friction_demand(grasp.positions, grasp.normals))) + TELLING * noise


def _errors(hits: Sequence[Grasp]) -> tuple[np.ndarray, np.ndarray]:
    """ε_f [N²] and ε_m [(N·m)²] of each grasp (h, 2), and what noise makes of them on average."""
    n = np.array([grasp.normals for grasp in hits])
    x = np.array([grasp.positions for grasp in hits])
    f = n.sum(axis=1)
    m = np.cross(n, x - x.mean(axis=1, keepdims=True)).sum(axis=1)
    errors = np.column_stack([(f * f).sum(axis=1), (m * m).sum(axis=1)])
    return errors, np.array([grasp.floor for grasp in hits])


def _above_and_below(stack: Stack) -> tuple[list[Beside], list[Beside]]:
    """The laws other than force and moment, by priority: those above the last of these, and below.

    A law beside force or moment is as important as they are: it counts as above.
    """
    balance = [any(isinstance(t, ForceTask | MomentTask) for t in p) for p in stack.priorities]
    last = max((i for i, there in enumerate(balance) if there), default=-1)
    others = [
        tuple(t for t in tasks if not isinstance(t, ForceTask | MomentTask))
        for tasks in stack.priorities
    ]
    parts = others[: last + 1], others[last + 1 :]
    return tuple([beside for beside in part if beside] for part in parts)  # type: ignore[return-value]


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
    if isinstance(task, KinematicTask) and task.kind == "angle":
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
    return bool(np.abs(q - touch.felt.q).max() < BACK)  # type: ignore[union-attr]
