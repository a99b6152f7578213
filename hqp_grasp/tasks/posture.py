"""The posture law: the joints stay where they are, or go to a favourite posture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from hqp_grasp.errors import InputError
from hqp_grasp.grasp import Grasp, as_array
from hqp_grasp.tasks.stack import Task


@dataclass(frozen=True)
class PostureTask(Task):
    """Distance to a posture, q − target. Without a target: the least motion, x = 0.

    Its rows are the identity, so as the last level of a stack it makes the answer unique.
    """

    target: ArrayLike | None = None  # (n,) [rad]; None: wherever the hand is

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.target is not None:
            target = as_array("PostureTask.target", self.target, (None,))
            # A tuple, so that equal tasks compare, hash and print alike.
            object.__setattr__(self, "target", tuple(target.tolist()))

    def error(self, grasp: Grasp) -> np.ndarray:
        """q − target (n,) [rad]; zeros without a target."""
        if self.target is None:
            return np.zeros(grasp.n)
        target = np.array(self.target)
        if len(target) != grasp.n:
            raise InputError(
                f"PostureTask.target has {len(target)} joints; the grasp has {grasp.n} "
                "independent joints: give one value for each"
            )
        return grasp.q - target

    def jacobian(self, grasp: Grasp) -> np.ndarray:
        """∂(q − target)/∂q = I (n, n) [–]."""
        return np.eye(grasp.n)
