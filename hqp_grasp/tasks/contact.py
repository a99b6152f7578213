"""The contact law: contacts move along the surface, neither into it nor away from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hqp_grasp.grasp import Grasp
from hqp_grasp.tasks.stack import Task


@dataclass(frozen=True)
class ContactTask(Task):
    """No motion along the normals, n_iᵀ J_i x = 0 for each contact.

    The force and moment laws assume that contacts move in their tangent planes; this holds the
    hand to it. Its error is always zero, so `gain` has no effect.
    """

    def error(self, grasp: Grasp) -> np.ndarray:
        """Zeros (k,) [m]: contacts are on the surface already."""
        return np.zeros(grasp.k)

    def jacobian(self, grasp: Grasp) -> np.ndarray:
        """n_iᵀ ∂x_i/∂q, one row per contact (k, n) [m/rad]."""
        return grasp.normal_jacobian()
