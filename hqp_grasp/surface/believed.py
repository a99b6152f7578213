"""Which surface to believe in, by what was felt."""

from __future__ import annotations

import numpy as np

from hqp_grasp.grasp import Grasp
from hqp_grasp.surface.felt import SURE, Felt
from hqp_grasp.surface.rounded import Rounded
from hqp_grasp.surface.surface import Surface
from hqp_grasp.surface.walls import Walls

LEANS = (0.03, 0.9)  # [–] part of a normal along the axis that neither walls nor end faces have
RIMS = 0.1  # [–] of the contacts, or one, may lean all the same


def believed(felt: Felt, grasp: Grasp, size: float = 0.05) -> Surface:
    """Walls along the axis along which nothing felt turns, or, where normals lean, all rounded.

    Walls, as a prism has them, are known from fewer touches. Edges of tips that are no balls lean
    where faces do not: they tell nothing of it. `size` [m] is the object's radius,
    where nothing felt tells more.
    """
    axis = felt.axis(grasp)
    lean = np.abs(felt.normals @ axis)
    leaning = (lean < LEANS[1]) & (lean > np.maximum(LEANS[0], SURE * felt.noise)) & felt.by_balls
    if leaning.sum() <= max(1.0, RIMS * len(lean)):
        tip_radius = float(np.mean([contact.tip_radius for contact in grasp.contacts]))
        walls = Walls.of(felt, axis, tip_radius)
        if walls is not None:
            return walls
    return Rounded.of(felt, size)
