"""Laws that read only where the contacts are, and the small matrices they are made of."""

from __future__ import annotations

from abc import abstractmethod
from typing import TypeGuard

import numpy as np

from hqp_grasp.grasp import Grasp
from hqp_grasp.tasks.stack import Task

# v @ CROSS, reshaped to (3, 3), is [v]×.
CROSS = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0],
        [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    ]
)


class ContactSpaceTask(Task):
    """A law whose error depends on the joints only through where the contacts are.

    A new one is a subclass with `error` and `contact_jacobian`. Such laws can be composed in
    contact space too, as the paper does in its eq. 11.
    """

    @abstractmethod
    def contact_jacobian(self, grasp: Grasp) -> np.ndarray:
        """∂error/∂x (r, 3k), x being the points whose motion `grasp.jacobian` gives."""

    def jacobian(self, grasp: Grasp) -> np.ndarray:
        """∂error/∂q = ∂error/∂x · ∂x/∂q (r, n)."""
        return self.contact_jacobian(grasp) @ grasp.jacobian

    def potential(self, grasp: Grasp) -> float:
        """Squared error, ε = eᵀe [unit of the error, squared] (paper, eq. 1 and 4)."""
        e = self.error(grasp)
        return float(e @ e)

    def contact_gradient(self, grasp: Grasp) -> np.ndarray:
        """∂ε/∂x = 2 (∂e/∂x)ᵀ e (3k,) (paper, eq. 2–3 and 5–6)."""
        return 2.0 * (self.error(grasp) @ self.contact_jacobian(grasp))


def in_contact_space(task: Task) -> TypeGuard[ContactSpaceTask]:
    """Whether the law's error depends on the joints only through where the contacts are."""
    return isinstance(task, ContactSpaceTask)


def cross_matrices(v: np.ndarray) -> np.ndarray:
    """[v]× (…, 3, 3) of vectors v (…, 3): [v]× w = v × w."""
    return (v @ CROSS).reshape(*v.shape, 3)


def tangent_projectors(normals: np.ndarray) -> np.ndarray:
    """I − n nᵀ (k, 3, 3) of unit normals (k, 3): the part of a motion along the surface."""
    return np.eye(3) - normals[:, :, None] * normals[:, None, :]


def side_by_side(blocks: np.ndarray) -> np.ndarray:
    """The k blocks of (k, r, 3), one per contact, as one matrix (r, 3k)."""
    return blocks.transpose(1, 0, 2).reshape(blocks.shape[1], -1)
