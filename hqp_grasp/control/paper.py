"""The paper's own composition: gradients in contact space, mapped by the SR-inverse."""

from __future__ import annotations

import numpy as np

from hqp_grasp.errors import InputError
from hqp_grasp.grasp import Grasp
from hqp_grasp.hierarchy.level import Level
from hqp_grasp.tasks import KinematicTask
from hqp_grasp.tasks.contact_space import ContactSpaceTask, in_contact_space
from hqp_grasp.tasks.kinematic import is_kinematic
from hqp_grasp.tasks.stack import Stack


def contact_step(stack: Stack, grasp: Grasp) -> np.ndarray:
    """ẋ (3k,) [m]: each law's gradient step, in the nullspace of the laws before it (eq. 11).

    The printed projector has its factors in the wrong order; it is I − J⁺J (3k × 3k). The paper
    leaves the step length open: here it is gain / L with L = 2‖J‖², the largest curvature of
    ε = eᵀe, so that gain 1 has the best descent that is sure.
    """
    step = np.zeros(3 * grasp.k)
    above = np.zeros((0, 3 * grasp.k))
    for task in laws(stack):
        if not in_contact_space(task):
            continue
        J = task.contact_jacobian(grasp)
        curvature = 2.0 * np.linalg.norm(J, 2) ** 2
        if curvature > 0.0:
            gradient = task.contact_gradient(grasp)
            step -= _nullspace(above) @ ((task.gain / curvature) * gradient)
        above = np.concatenate([above, J])
    return step


def paper_levels(stack: Stack, grasp: Grasp) -> list[Level]:
    """J q̇ = ẋ ▷ q̇ = q̇_c, the two levels that `Projection(damping=λ)` composes as eq. 13 does.

    q̇_c = −gain ∂ε_c/∂q of the stack's kinematic law (eq. 9), 0 where it has none.
    """
    rest = np.zeros(grasp.n)
    for task in laws(stack):
        if is_kinematic(task):
            rest += task.step(grasp)
    return [
        Level.equal(grasp.jacobian, contact_step(stack, grasp), "contact step"),
        Level.equal(np.eye(grasp.n), rest, "kinematic"),
    ]


def laws(stack: Stack) -> list[ContactSpaceTask | KinematicTask]:
    """The laws in the paper's order: contact-space laws, one a priority, then the kinematic.

    Raises InputError for a stack that the paper's form cannot compose.
    """
    if reason := why_not(stack):
        raise InputError(reason)
    return [task for task in stack.tasks if in_contact_space(task) or is_kinematic(task)]


def why_not(stack: Stack) -> str:
    """Why the paper's form cannot compose these laws; empty where it can."""
    below = False
    for beside in stack.priorities:
        if len(beside) > 1:
            return "the paper's form has one law a priority: compose with >>, not +"
        task = beside[0]
        if not (in_contact_space(task) or is_kinematic(task)):
            return (
                "the paper's form composes contact-space laws and KinematicTask; "
                f"{task.name} is neither"
            )
        if below:
            return "the paper's form has its kinematic law last; use another form"
        below = is_kinematic(task)
    return ""


def _nullspace(J: np.ndarray) -> np.ndarray:
    return np.eye(J.shape[1]) - np.linalg.pinv(J) @ J
