"""When to go no further, and back to the best grasp felt."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hqp_grasp.control.limits import cap_ratio
from hqp_grasp.grasp import Grasp, Touch
from hqp_grasp.tasks import ForceTask, MomentTask, Stack

FORCE_GOAL = 1e-3  # [N²] ε_f of a balanced grasp, at most
MOMENT_GOAL = (2e-3) ** 2  # [(N·m)²] ε_m of one, at most
BETTER = 2e-3  # by which the lower laws' errors fall, or the grasp is no better
PATIENCE = 3  # balanced grasps that are no better, before the hand settles
BACK = 1e-3  # [rad] from a posture, within which the hand is back there


def way_back(stack: Stack, history: Sequence[Touch], left: int | None) -> np.ndarray | None:
    """The posture (n,) [rad] to return to, or None while there is reason to go on.

    Balanced grasps are kept: once the laws below force and moment improve no more, once a step from
    a balanced grasp lost it, and when the touches `left` only just suffice. A grasp that is not
    there any more, because the object has moved, is forgotten.
    """
    hits = [t.felt for t in history if isinstance(t.felt, Grasp)]
    score = iter(_scores(hits))
    scores = np.array([next(score) if isinstance(t.felt, Grasp) else np.inf for t in history])
    best, least, stale, lost = -1, np.inf, 0, False
    for i, touch in enumerate(history):
        if scores[i] <= 1.0:
            if lost or stale >= PATIENCE:
                continue
            value = _below(stack, touch.felt)  # type: ignore[arg-type]
            stale += 1
            if best < 0 or value < least - BETTER:
                best, least, stale = i, value, 0
        elif best >= 0:
            lost = True
            if isinstance(touch.felt, Grasp) and _near(touch.q_target, history[best]):
                best, stale, lost = -1, 0, False
    if best >= 0 and (lost or stale >= PATIENCE):
        return history[best].felt.q  # type: ignore[union-attr]
    if left is not None:
        best = best if best >= 0 else int(scores.argmin())
        q: np.ndarray = history[best].felt.q  # type: ignore[union-attr]
        if left <= 1.0 + cap_ratio(q - hits[-1].q, stack, hits[-1]):
            return q
    return None


def _scores(hits: Sequence[Grasp]) -> np.ndarray:
    """The larger of ε_f and ε_m in units of what a balanced grasp has at most."""
    n = np.array([grasp.normals for grasp in hits])
    x = np.array([grasp.positions for grasp in hits])
    f = n.sum(axis=1)
    m = np.cross(n, x - x.mean(axis=1, keepdims=True)).sum(axis=1)
    return np.maximum((f * f).sum(axis=1) / FORCE_GOAL, (m * m).sum(axis=1) / MOMENT_GOAL)


def _below(stack: Stack, grasp: Grasp) -> float:
    """Sum of the other laws' absolute errors."""
    others = (t for t in stack.tasks if not isinstance(t, ForceTask | MomentTask))
    return sum(float(np.abs(task.error(grasp)).sum()) for task in others)


def _near(q: np.ndarray, touch: Touch) -> bool:
    return bool(np.abs(q - touch.felt.q).max() < BACK)  # type: ignore[union-attr]
