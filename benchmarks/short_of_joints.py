"""How much of the force descent is realised where a hand has fewer joints than it needs.

    python benchmarks/short_of_joints.py --configurations 2000 --seed 0

The BarrettHand by itself, its palm fixed: 4 joints for the 9 coordinates of 3 contacts. Joints are
uniform over their ranges, normals over those that a closing finger can press. The share is what the
best step along a form's direction takes off ‖J_f x + f‖², of what the best of all steps x takes:

    hierarchy    force ▷ moment ▷ kinematic in joint space
    eq. 11–13    the same laws composed in contact space, then mapped by the SR-inverse
"""

from __future__ import annotations

import numpy as np
import tyro

import hqp_grasp as hg
from hqp_grasp.control.forms import SR_DAMPING, TOUCH_RANK
from hqp_grasp.control.paper import paper_levels

NEGLIGIBLE = 1e-6  # [N²] ideal descents below this have no share


def drawn(robot: hg.Robot, rng: np.random.Generator) -> hg.Grasp:
    """A random posture with random normals against the ways that the fingers close."""
    q = rng.uniform(robot.q_lower, robot.q_upper)
    J = robot.jacobian(q).reshape(-1, 3, robot.n)
    contacts = []
    for i, centre in enumerate(robot.centers(q)):
        n = rng.normal(size=3)
        n *= -np.sign(n @ J[i] @ robot.closing[i]) / np.linalg.norm(n)
        contacts.append(hg.Contact(centre - robot.tip_radius[i] * n, n))
    return robot.grasp(q, contacts)


def descent(A: np.ndarray, f: np.ndarray, x: np.ndarray) -> float:
    """What the best step along x takes off ‖A x + f‖² [N²]; none where x ascends."""
    along = A @ x
    length = float(along @ along)
    return float(max(0.0, -(along @ f)) ** 2 / length) if length > 0.0 else 0.0


def main(configurations: int = 2000, seed: int = 0, solver: str = "proxqp") -> None:
    """Print the share of the ideal force descent in both forms.

    Args:
        configurations: random postures and normals
        seed: of them
        solver: of the hierarchy
    """
    robot = hg.Scene(robot="bhand").articulated
    stack = hg.Stack(hg.stack_of("fmk").priorities, hold_contacts=False)
    hqp = hg.HQP(solver, rank_tolerance=TOUCH_RANK)
    damped = hg.Projection(damping=SR_DAMPING)
    rng = np.random.default_rng(seed)
    alone = hg.Stack.of(hg.ForceTask())
    shares: dict[str, list[float]] = {}
    for _ in range(configurations):
        grasp = drawn(robot, rng)
        A, minus_f = hg.ForceTask().rows(grasp)
        ideal = descent(A, -minus_f, np.linalg.pinv(A) @ minus_f)
        if ideal < NEGLIGIBLE:
            continue
        steps = {
            "hierarchy": hqp.solve(stack.law_levels(grasp)).x,
            "eq. 11–13": damped.solve(paper_levels(stack, grasp)).x,
            "the same, force alone": damped.solve(paper_levels(alone, grasp)).x,
        }
        for form, x in steps.items():
            shares.setdefault(form, []).append(descent(A, -minus_f, x) / ideal)
    count = len(shares["hierarchy"])
    print(f"bhand, palm fixed, {count} of {configurations} configurations, seed {seed}\n")
    print(
        f"{'share of the ideal':24}{'mean':>8}{'median':>8}{'5 %':>8}{'least':>8}{'below 0.99':>12}"
    )
    for form, values in shares.items():
        middle, low = np.percentile(values, [50, 5])
        below = f"{np.mean(np.array(values) < 0.99):.1%}"
        row = f"{form:24}{np.mean(values):8.2f}{middle:8.2f}{low:8.2f}{min(values):8.2f}"
        print(f"{row}{below:>12}")


if __name__ == "__main__":
    tyro.cli(main)
