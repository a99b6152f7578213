"""The force law: contacts move until the unit forces they apply add up to zero."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from hqp_grasp.errors import positive
from hqp_grasp.grasp import Grasp
from hqp_grasp.tasks.contact_space import ContactSpaceTask, side_by_side, tangent_projectors


@dataclass(frozen=True)
class ForceTask(ContactSpaceTask):
    """Net force of unit contact forces f_i = −n_i, f = Σ f_i; ε_f = fᵀf (paper, eq. 1).

    `radius` is all the law assumes about the object: each contact moves as if on a sphere of
    that radius (paper, section 2.1). Small makes small steps, large makes large ones.
    """

    radius: float = 0.05  # r [m], of the sphere each contact is taken to move on
    goal: ClassVar[float] = 1e-3  # [N²] of three contacts

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "radius", positive("ForceTask.radius [m]", self.radius))

    def error(self, grasp: Grasp) -> np.ndarray:
        """Net force f = −Σ n_i (3,) [N], world."""
        return -grasp.normals.sum(axis=0)

    def goal_at(self, grasp: Grasp) -> float:
        """ε_f [N²] that is the same share of all contact forces as `goal` is of three."""
        return self.goal * (grasp.k / 3.0) ** 2

    def floor(self, grasp: Grasp) -> float:
        """ε_f [N²] that noise makes of a balanced grasp, on average."""
        return grasp.floor[0]

    def contact_jacobian(self, grasp: Grasp) -> np.ndarray:
        """∂f/∂x_i = −(I − n_i n_iᵀ)/(r + ρ_i), side by side (3, 3k) [N/m], world.

        With a round tip of radius ρ_i, x_i is its centre, which rides on a sphere of radius
        r + ρ_i; with ρ_i = 0 this is the paper's sphere.
        """
        reach = np.array([self.radius + c.tip_radius for c in grasp.contacts])
        return side_by_side(tangent_projectors(grasp.normals) / -reach[:, None, None])
