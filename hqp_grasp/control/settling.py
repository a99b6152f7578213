"""When to go no further, and back to the best grasp felt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hqp_grasp.control.limits import cap_ratio
from hqp_grasp.grasp import Grasp, Touch
from hqp_grasp.tasks import ForceTask, MomentTask, Stack

FORCE_GOAL = 1e-3  # [N²] ε_f of a balanced grasp, at most
MOMENT_GOAL = (2e-3) ** 2  # [(N·m)²] ε_m of one, at most
BEYOND = 4.0  # times the floor of noise, within which a felt error says nothing
BETTER = 2e-3  # by which the lower laws' errors fall, or the grasp is no better
TELLING = 2.0  # standard errors that tell two values apart
PATIENCE = 3  # balanced grasps that are no better, before the hand settles
BACK = 1e-3  # [rad] from a posture, within which the hand is back there
SAME_ROUNDING = 1e-6  # [m] radii of one tip differ by, as long as it is a ball


@dataclass(frozen=True, eq=False)
class Course:
    """How the touches of a history went, by the laws of a stack.

    Under noise a grasp is balanced within BEYOND times its floor, and BETTER shows in as many
    grasps as average the noise to it. A grasp that is not there any more, because the object has
    moved, is forgotten.
    """

    stack: Stack
    history: Sequence[Touch]
    scores: np.ndarray  # of each touch: errors by what a balanced grasp has at most; inf: a miss
    nearest: int  # touch that is nearest to balance, where noise counts against a grasp
    best: int  # touch with the best of the balanced grasps, −1: none
    worse: int  # balanced grasps that were worse than the best before
    over: bool  # whether it is time to go back

    @classmethod
    def of(cls, stack: Stack, history: Sequence[Touch]) -> Course:
        """Of a history with one grasp at least."""
        hits = [t.felt for t in history if isinstance(t.felt, Grasp)]
        felt = [isinstance(touch.felt, Grasp) for touch in history]
        scores, doubtful = np.full((2, len(history)), np.inf)
        errors, floor = _errors(hits)
        goals = np.array([FORCE_GOAL, MOMENT_GOAL])
        scores[felt] = (errors / np.maximum(goals, BEYOND * floor)).max(axis=1)
        doubtful[felt] = ((errors + floor) / goals).max(axis=1)
        noise = sum(contact.noise**2 for contact in hits[-1].contacts)  # [rad²] of the angles' sum
        patience = PATIENCE + noise / BETTER**2
        tells = max(BETTER, TELLING * np.sqrt(2.0 * noise))
        best, least, stale, lost, worse = -1, np.inf, 0, False, 0
        for i, touch in enumerate(history):
            if scores[i] <= 1.0:
                if lost or stale >= patience:
                    continue
                value = _below(stack, touch.felt)  # type: ignore[arg-type]
                stale += 1
                worse += value > least + tells
                if best < 0 or value < least - BETTER:
                    best, least, stale = i, value, 0
            elif best >= 0:
                lost = True
                if isinstance(touch.felt, Grasp) and _near(touch.q_target, history[best]):
                    best, stale, lost = -1, 0, False
        return cls(
            stack, history, scores, int(doubtful.argmin()), best, worse, lost or stale >= patience
        )

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

    def way_back(self, left: int | None) -> np.ndarray | None:
        """The posture (n,) [rad] to return to, or None while there is reason to go on.

        Balanced grasps are kept: once the laws below force and moment improve no more, once a step
        from a balanced grasp lost it, and when the touches `left` only just suffice.
        """
        best = self.best
        if best >= 0 and self.over:
            return self.history[best].felt.q  # type: ignore[union-attr]
        if left is not None:
            best = best if best >= 0 else self.nearest
            q: np.ndarray = self.history[best].felt.q  # type: ignore[union-attr]
            last = [t.felt for t in self.history if isinstance(t.felt, Grasp)][-1]
            # A step further, and it would take one more to return.
            if left <= 1.0 + np.ceil(cap_ratio(q - last.q, self.stack, last)):
                return q
        return None


def _errors(hits: Sequence[Grasp]) -> tuple[np.ndarray, np.ndarray]:
    """ε_f [N²] and ε_m [(N·m)²] of each grasp (h, 2), and what noise makes of them on average."""
    n = np.array([grasp.normals for grasp in hits])
    x = np.array([grasp.positions for grasp in hits])
    f = n.sum(axis=1)
    m = np.cross(n, x - x.mean(axis=1, keepdims=True)).sum(axis=1)
    errors = np.column_stack([(f * f).sum(axis=1), (m * m).sum(axis=1)])
    return errors, np.array([grasp.floor for grasp in hits])


def _below(stack: Stack, grasp: Grasp) -> float:
    """Sum of the other laws' absolute errors."""
    others = (t for t in stack.tasks if not isinstance(t, ForceTask | MomentTask))
    return sum(float(np.abs(task.error(grasp)).sum()) for task in others)


def _near(q: np.ndarray, touch: Touch) -> bool:
    return bool(np.abs(q - touch.felt.q).max() < BACK)  # type: ignore[union-attr]
