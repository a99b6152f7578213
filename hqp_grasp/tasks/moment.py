"""The moment law: contacts move until the moments of their unit forces add up to zero."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from hqp_grasp.errors import one_of
from hqp_grasp.grasp import Grasp, as_array
from hqp_grasp.tasks.contact_space import (
    ContactSpaceTask,
    cross_matrices,
    side_by_side,
    tangent_projectors,
)

HAND = 0.1  # [m] of contacts from their centroid, on average, within which one hand grasps


@dataclass(frozen=True)
class MomentTask(ContactSpaceTask):
    """Net moment of unit contact forces, m = Σ (x_i − c) × f_i; ε_m = mᵀm (paper, eq. 4).

    Each contact moves as if on an infinite plane (paper, section 2.2): its normal stays. The
    reference c matters only while the net force is not zero.
    """

    reference: str | ArrayLike = "centroid"  # c: the contacts' mean, or a point (3,) [m], world
    goal: ClassVar[float] = (2e-3) ** 2  # [(N·m)²] of three contacts within HAND

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.reference, str):
            one_of("MomentTask.reference", self.reference, ["centroid"])
        else:
            point = as_array("MomentTask.reference", self.reference, (3,))
            # A tuple, so that equal tasks compare, hash and print alike.
            object.__setattr__(self, "reference", tuple(point.tolist()))

    def error(self, grasp: Grasp) -> np.ndarray:
        """Net moment m = Σ (x_i − c) × f_i = Σ n_i × (x_i − c) (3,) [N·m], world."""
        x = grasp.positions
        c = x.sum(axis=0) / grasp.k if isinstance(self.reference, str) else np.array(self.reference)
        moments = cross_matrices(grasp.normals) @ (x - c)[:, :, None]
        return moments.sum(axis=0)[:, 0]

    def goal_at(self, grasp: Grasp) -> float:
        """ε_m [(N·m)²]: `goal` by the number of contacts, and by how far they lie beyond HAND.

        What friction has to make good is the moment by the contacts' forces and distances.
        """
        far = np.linalg.norm(grasp.positions - grasp.positions.mean(axis=0), axis=1).mean()
        return self.goal * (grasp.k / 3.0 * max(1.0, float(far) / HAND)) ** 2

    def floor(self, grasp: Grasp) -> float:
        """ε_m [(N·m)²] that noise makes of a balanced grasp, on average."""
        return grasp.floor[1]

    def contact_jacobian(self, grasp: Grasp) -> np.ndarray:
        """∂m/∂x_i, side by side (3, 3k) [N], world.

        About a fixed point −[f_i]× (I − n_i n_iᵀ), which is −[f_i]× since f_i = −n_i; about the
        centroid, which moves along, (−[f_i]× + [f]×/k)(I − n_i n_iᵀ), f being the net force.
        The centre of a round tip moves on a plane exactly as the touching point does.
        """
        normals = grasp.normals
        blocks = cross_matrices(normals)
        if isinstance(self.reference, str):
            f = -normals.sum(axis=0)
            blocks = blocks + cross_matrices(f / grasp.k) @ tangent_projectors(normals)
        return side_by_side(blocks)
