"""What the touches so far leave the hand with, and what it does when they miss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hqp_grasp.errors import InputError
from hqp_grasp.grasp import Grasp, Miss, Missed, Touch
from hqp_grasp.surface.denoise import denoised
from hqp_grasp.world.robot import Robot


@dataclass(frozen=True)
class MissPolicy:
    """What the hand does after misses.

    The step is taken again from the last grasp, shorter. Where another link than the contact points
    met the object, or an open finger was in it, or a tip met the table, the palm of that group
    withdraws on the next step. Where a sensor was silent, or the hand did not open, the same step
    is tried again. When nothing is left to try, the hand begins again from its first grasp; where
    that brings no touch either, it gives up. Where the very first touch finds nothing, the palm is
    sent beside there, level, all around.
    """

    shares: tuple[float, ...] = (1.0, 0.5, 0.25)  # of a step, in turn while it touches nothing
    retreat: float = 0.01  # [m] of the palm, for each time that a link was in the way
    retreats: int = 6  # times, at most
    repeats: int = 4  # touches from one grasp that broken sensors may cost
    restart: bool = False  # whether the hand begins again from its first grasp, once
    beside: float = 0.02  # [m] of the palm, from a first touch that found nothing
    around: tuple[float, ...] = (0, 180, 90, 270, 45, 225, 135, 315)  # [°] about the vertical
    in_the_way: tuple[Miss, ...] = (Miss.OTHER_LINK, Miss.TABLE, Miss.INSIDE)  # a palm withdraws
    broken: tuple[Miss, ...] = (Miss.SENSOR, Miss.STUCK)  # no fault of the step, and it may pass
    passing: tuple[Miss, ...] = (Miss.BLOCKED, Miss.LOST, Miss.UNCLEAR)  # so may a first touch's

    def spent(self, misses: Sequence[Missed]) -> bool:
        """Whether nothing is left to try from a grasp after these misses."""
        return (
            self.shorter(misses) == len(self.shares)
            or sum(missed.reason in self.in_the_way for missed in misses) == self.retreats
            or sum(missed.reason in self.broken for missed in misses) == self.repeats
        )

    def shorter(self, misses: Sequence[Missed]) -> int:
        """How many misses found nothing, for which the step gets shorter."""
        return sum(missed.reason not in self.in_the_way + self.broken for missed in misses)

    def withdrawal(self, misses: Sequence[Missed]) -> float:
        """How far [m] a palm withdraws, for the last misses of its group, if in the way."""
        in_the_way = [m.reason in self.in_the_way for m in reversed(misses)]
        return self.retreat * [*in_the_way, False].index(False)

    def direction(self, misses: Sequence[Missed]) -> np.ndarray | None:
        """Where to send the palm (3,) [m] after first touches that missed; None: nowhere is left.

        Zeros where the same is worth another try.
        """
        passing = self.broken + self.passing
        if misses[-1].reason in passing and len(misses) < self.repeats:
            return np.zeros(3)
        tried = sum(missed.reason not in passing for missed in misses)
        if not 0 < tried <= len(self.around):
            return None
        angle = np.radians(self.around[tried - 1])
        return self.beside * np.array([np.cos(angle), np.sin(angle), 0.0])


@dataclass(frozen=True, eq=False)
class Episode:
    """What a history leaves the hand with, read once, from the first touch to the last."""

    touches: tuple[Touch, ...]
    grasp: Grasp | None = None  # to step from: the last felt, or the first once it began again
    misses: tuple[Missed, ...] = ()  # of steps from it
    again: bool = False  # the hand begins again from its first grasp
    way: tuple[np.ndarray, ...] = ()  # postures (n,) [rad] back to it
    left: int | None = None  # touches still to be had; None: as many as it takes
    robot: Robot | None = None  # that touches; None: nothing is known of how far it reaches

    @classmethod
    def of(
        cls,
        history: Sequence[Touch],
        policy: MissPolicy | None = None,
        budget: int | None = None,
        robot: Robot | None = None,
    ) -> Episode:
        """Read `history`; raise InputError where it is empty."""
        if not len(history):
            raise InputError("the history is empty: it begins with the first touch")
        policy, grasps, lost = policy or MissPolicy(), list[Grasp](), False
        now = cls(())
        for touch in history:
            if isinstance(touch.felt, Grasp):
                grasps.append(touch.felt)
                now, lost = cls((), touch.felt), False
                continue
            misses = (*now.misses, touch.felt)
            unlucky = policy.spent(misses) and touch.felt.reason not in policy.broken
            if policy.restart and grasps and not lost and unlucky:
                way = tuple(grasp.q for grasp in reversed(grasps[:-1]))
                now, lost = cls((), grasps[0], (), True, way), True
            else:
                now = cls((), now.grasp, misses)
        left = None if budget is None else budget - len(history)
        return replace(now, touches=tuple(history), left=left, robot=robot)

    @property
    def stand(self) -> Grasp:
        """The grasp to step from; raise InputError where nothing has been felt."""
        if self.grasp is None:
            raise InputError("nothing has been felt yet: a step begins at a grasp")
        return self.grasp

    @property
    def missed(self) -> int:
        """How many touches have missed since the last that did not."""
        return [isinstance(touch.felt, Grasp) for touch in reversed(self.touches)].index(True)

    def denoised(self) -> Episode:
        """The same episode, with the likeliest normals that one convex object can have."""
        touches = denoised(self.touches)
        pairs = zip(self.touches, touches, strict=True)
        grasps = (new.felt for old, new in pairs if old.felt is self.grasp)
        grasp = next(felt for felt in grasps if isinstance(felt, Grasp))
        return replace(self, touches=touches, grasp=grasp)
