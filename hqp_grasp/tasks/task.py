"""The base of every control law: an error, its Jacobian, and the rows that drive it to zero."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hqp_grasp.errors import InputError
from hqp_grasp.grasp import Grasp

if TYPE_CHECKING:
    from hqp_grasp.stack import Stack

# v @ CROSS, reshaped to (3, 3), is [v]×.
CROSS = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0],
        [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    ]
)


@dataclass(frozen=True, kw_only=True)
class Task(ABC):
    """A control law: an error that should vanish, and how it changes with the joints.

    A new law is a subclass with two methods, `error` and `jacobian`. It reads a Grasp and
    nothing else, and is complete once built.
    """

    gain: float = 1.0  # [–] share of the error to remove in one probe; 1 is a full Newton step
    weight: float = 1.0  # [–] scales the rows; matters only beside other tasks on one level

    def __post_init__(self) -> None:
        for setting in ("gain", "weight"):
            value = positive(f"{type(self).__name__}.{setting}", getattr(self, setting))
            object.__setattr__(self, setting, value)

    @property
    def name(self) -> str:
        """The law's short name: "force" for ForceTask."""
        return type(self).__name__.removesuffix("Task").lower()

    @abstractmethod
    def error(self, grasp: Grasp) -> np.ndarray:
        """The quantity that should vanish, (r,)."""

    @abstractmethod
    def jacobian(self, grasp: Grasp) -> np.ndarray:
        """∂error/∂q (r, n) [unit of the error / rad]."""

    def rows(self, grasp: Grasp) -> tuple[np.ndarray, np.ndarray]:
        """The equality rows (A, b) asked of x = Δq over one probe: jacobian·x = −gain·error."""
        A = self.weight * self.jacobian(grasp)
        b = (-self.weight * self.gain) * self.error(grasp)
        return A, b

    # Stack lives above the tasks, and `a >> b` must build one: hence the import at call time.
    def __rshift__(self, other: Task | Stack) -> Stack:
        """`a >> b`: b subject to a (the paper's a ▷ b)."""
        from hqp_grasp.stack import Stack

        return Stack.of(self) >> other

    def __add__(self, other: Task | Stack) -> Stack:
        """`a + b`: both at the same priority."""
        from hqp_grasp.stack import Stack

        return Stack.of(self) + other


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


def positive(name: str, value: object) -> float:
    """Return `value` as a finite float above zero, else raise InputError."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be a number above 0; got {value!r}") from error
    if not (np.isfinite(number) and number > 0.0):
        raise InputError(f"{name} must be finite and above 0; got {number}")
    return number


def cross_matrices(v: np.ndarray) -> np.ndarray:
    """[v]× (…, 3, 3) of vectors v (…, 3): [v]× w = v × w."""
    return (v @ CROSS).reshape(*v.shape, 3)


def tangent_projectors(normals: np.ndarray) -> np.ndarray:
    """I − n nᵀ (k, 3, 3) of unit normals (k, 3): the part of a motion along the surface."""
    return np.eye(3) - normals[:, :, None] * normals[:, None, :]


def side_by_side(blocks: np.ndarray) -> np.ndarray:
    """The k blocks of (k, r, 3), one per contact, as one matrix (r, 3k)."""
    return blocks.transpose(1, 0, 2).reshape(blocks.shape[1], -1)
