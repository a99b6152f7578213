"""What a surface must tell: how far it reaches, and how contacts get to where forces balance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from hqp_grasp.grasp import Grasp

DISTINCT = 10  # ways, at most
APART = 0.01  # [m] the place of a contact differs by, between two ways


class Way(Protocol):
    """For every contact of a grasp, a way over the surface to where the forces would balance."""

    @property
    def cost(self) -> float:
        """How long and how doubtful the way is [m²]."""
        ...

    def at(self, share: float) -> tuple[np.ndarray, np.ndarray]:
        """The tips' centres (k, 3) [m] and the normals (k, 3) after a share of the way, world."""
        ...


@runtime_checkable
class Surface(Protocol):
    """A belief about the object, for tips whose centres ride on it at their radius."""

    def turn(self, grasp: Grasp) -> np.ndarray:
        """∂n_i/∂c_i (k, 3, 3) [1/m]: how each normal turns with its tip's centre, world."""
        ...

    def ways(self, grasp: Grasp) -> Sequence[Way]:
        """Ways to places where unit forces along the normals balance, the cheapest first."""
        ...

    def reach(self, u: np.ndarray) -> np.ndarray:
        """How far (m,) [m] the object reaches along unit vectors u (m, 3): max u·x, world."""
        ...


def spread(count: int) -> np.ndarray:
    """Unit vectors (count, 3), evenly spread: on a spiral of equal steps in height."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turn = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(count)
    ring = np.sqrt(1.0 - z * z)
    return np.column_stack([ring * np.cos(turn), ring * np.sin(turn), z])


def distinct(cost: np.ndarray, places: np.ndarray) -> list[int]:
    """The cheapest, each with a place (C, k, d) [m] apart from the others'."""
    left = np.ones(len(cost), dtype=bool)
    chosen: list[int] = []
    while left.any() and len(chosen) < DISTINCT:
        i = int(np.argmin(np.where(left, cost, np.inf)))
        left &= np.linalg.norm(places - places[i], axis=-1).max(axis=1) > APART
        chosen.append(i)
    return chosen


def unit(v: np.ndarray) -> np.ndarray:
    """Vectors (…, 3) of length 1."""
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))
