"""Which surface to believe in, by what was felt."""

from __future__ import annotations

import numpy as np

from hqp_grasp.grasp import Grasp
from hqp_grasp.surface.felt import LEANING, SURE, Felt
from hqp_grasp.surface.rounded import Rounded
from hqp_grasp.surface.surface import Surface
from hqp_grasp.surface.walls import Walls

END = 0.9  # [–] part of a normal along the axis, above which it is of an end face, no rim
RIMS = 0.1  # [–] of the contacts, or one, may lean all the same


def believed(felt: Felt, grasp: Grasp, goal: float) -> Surface:
    """Walls along the axis along which nothing felt turns, or, where normals lean, all rounded.

    Walls, as a prism has them, are known from fewer touches; a contact on an end face or a rim has
    none to ride on. Edges of tips that are no balls lean where faces do not: they tell nothing.
    Walls that all lean by α leave (k sin α)² of the squared net force of k unit forces: they do not
    count as such where that is more than `goal` [N²], and more than noise explains.
    """
    axis = felt.axis(grasp)
    balls = np.array([contact.stretch is None for contact in grasp.contacts])
    on_sides = (np.abs(grasp.normals @ axis)[balls] < LEANING).all()
    lean = np.abs(felt.normals @ axis)
    upright = np.maximum(np.sqrt(goal) / grasp.k, SURE * felt.noise)
    leaning = (lean > upright) & (lean < END) & felt.by_balls
    if on_sides and leaning.sum() <= max(1.0, RIMS * len(lean)):
        tip_radius = float(np.mean([contact.tip_radius for contact in grasp.contacts]))
        return Walls.of(felt, axis, tip_radius)
    return Rounded.of(felt)
