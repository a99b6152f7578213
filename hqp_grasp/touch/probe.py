"""The door to a hand: anything that can touch, a simulation or the driver of a real one."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from hqp_grasp.grasp import Grasp, Missed


class Probe(Protocol):
    """Anything that can touch: a simulation, or the driver of a real hand."""

    def touch(self, q_target: np.ndarray) -> Grasp | Missed:
        """Go to q_target (n,) [rad], close, and say what was felt."""
        ...
