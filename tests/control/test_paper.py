"""The paper's own form against its equations written out.

J_f, J_m are the laws' slopes in contact space, f, m their errors, J the grasp's Jacobian.
"""

import numpy as np
import pytest

from hqp_grasp.control.paper import contact_step, paper_levels
from hqp_grasp.errors import InputError
from hqp_grasp.grasp import Contact, Grasp
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.hierarchy.level import Level
from hqp_grasp.hierarchy.projection import Projection
from hqp_grasp.tasks import ForceTask, KinematicTask, MomentTask, PostureTask, stack_of
from hqp_grasp.tasks.stack import Stack

SEEDS = range(10)
TOL = 1e-10  # products of a few well-conditioned matrices in double precision


def random_grasp(seed, n=11, k=3):
    """Contacts anywhere, a hand that moves them anyhow."""
    rng = np.random.default_rng(seed)
    normals = rng.standard_normal((k, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    H = 0.1 * rng.standard_normal((3 * k, n, n))
    return Grasp(
        q=np.zeros(n),
        contacts=[
            Contact(0.05 * rng.standard_normal(3), normal, flexion=(n - k + i,))
            for i, normal in enumerate(normals)
        ],
        jacobian=0.3 * rng.standard_normal((3 * k, n)),
        hessian=H + H.transpose(0, 2, 1),
    )


def nullspace(J):
    """I − J⁺J through the eigenvectors of JᵀJ, another way than the code's."""
    values, vectors = np.linalg.eigh(J.T @ J)
    V = vectors[:, values > 1e-10 * values.max()]
    return np.eye(J.shape[1]) - V @ V.T


def step_down(task, grasp):
    """−gain ∂ε/∂x / (2‖J‖²), ∂ε/∂x = 2 Jᵀe."""
    J = task.contact_jacobian(grasp)
    return -task.gain * J.T @ task.error(grasp) / np.linalg.svd(J)[1][0] ** 2


@pytest.mark.parametrize("seed", SEEDS)
def test_the_contact_step_is_eq_11_with_its_projector_3k_by_3k(seed):
    grasp = random_grasp(seed)
    force, moment = ForceTask(gain=0.7), MomentTask(gain=0.4)
    J_f = force.contact_jacobian(grasp)
    expected = step_down(force, grasp) + nullspace(J_f) @ step_down(moment, grasp)
    np.testing.assert_allclose(contact_step(force >> moment, grasp), expected, atol=TOL)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_moments_step_leaves_the_net_force_alone(seed):
    grasp = random_grasp(seed)
    force = ForceTask()
    both, alone = contact_step(force >> MomentTask(), grasp), contact_step(Stack.of(force), grasp)
    J_f = force.contact_jacobian(grasp)
    np.testing.assert_allclose(J_f @ both, J_f @ alone, atol=TOL * np.linalg.norm(J_f))
    assert np.linalg.norm(both - alone) > 1e-4


@pytest.mark.parametrize("seed", SEEDS)
def test_eq_11_is_a_hierarchy_of_two_levels(seed):
    """J_f ẋ = J_f ẋ_f ▷ ẋ = ẋ_m, whatever the step lengths."""
    grasp = random_grasp(seed)
    force, moment = ForceTask(gain=0.7), MomentTask(gain=0.4)
    J_f = force.contact_jacobian(grasp)
    levels = [
        Level.equal(J_f, J_f @ step_down(force, grasp), "force"),
        Level.equal(np.eye(3 * grasp.k), step_down(moment, grasp), "moment"),
    ]
    solution = HQP().solve(levels)
    assert solution.is_optimal(levels)
    np.testing.assert_allclose(contact_step(force >> moment, grasp), solution.x, atol=TOL)


def test_the_order_of_the_laws_matters():
    grasp = random_grasp(0)
    one, other = (contact_step(stack_of(letters), grasp) for letters in ("fm", "mf"))
    assert np.linalg.norm(one - other) > 1e-4


@pytest.mark.parametrize("kind", ["angle", "eq7"])
@pytest.mark.parametrize("damping", [1e-6, 1e-3, 1.0])
def test_the_two_levels_damped_are_eq_13(kind, damping):
    for seed in SEEDS:
        grasp = random_grasp(seed)
        kinematic = KinematicTask(error=kind, gain=0.3)
        stack = ForceTask() >> MomentTask() >> kinematic
        J = grasp.jacobian
        J_star = J.T @ np.linalg.inv(J @ J.T + damping * np.eye(len(J)))
        rest = -0.3 * kinematic.gradient(grasp)
        expected = J_star @ contact_step(stack, grasp) + rest - J_star @ (J @ rest)
        x = Projection(damping=damping).solve(paper_levels(stack, grasp)).x
        np.testing.assert_allclose(x, expected, atol=TOL * (1.0 + np.abs(expected).max()))


def test_without_a_kinematic_law_the_secondary_step_is_zero():
    grasp = random_grasp(0)
    contact, rest = paper_levels(stack_of("fm"), grasp)
    np.testing.assert_array_equal(rest.upper, np.zeros(grasp.n))
    np.testing.assert_array_equal(contact.A, grasp.jacobian)


def test_a_gain_scales_the_step():
    grasp = random_grasp(0)
    whole, half = (contact_step(Stack.of(ForceTask(gain=gain)), grasp) for gain in (1.0, 0.5))
    np.testing.assert_allclose(half, 0.5 * whole, rtol=1e-12)


def sphere_grasp(normals, radius=0.05):
    """Contacts that slide on a sphere, by their own nine coordinates."""
    contacts = [Contact(radius * n, n) for n in normals]
    return Grasp(np.zeros(3 * len(normals)), contacts, np.eye(3 * len(normals)))


@pytest.mark.parametrize("seed", SEEDS)
def test_repeated_steps_on_a_sphere_bring_the_net_force_down(seed):
    rng = np.random.default_rng(seed)
    normals = rng.standard_normal((3, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    stack = ForceTask(radius=0.05, gain=0.2) >> MomentTask(gain=0.2)
    errors = []
    for _ in range(120):
        grasp = sphere_grasp(normals)
        errors.append(ForceTask().potential(grasp))
        x = Projection(damping=1e-3).solve(paper_levels(stack, grasp)).x
        normals = grasp.positions + x.reshape(3, 3)
        normals /= np.linalg.norm(normals, axis=1)[:, None]
    assert max(np.diff(errors)) <= 1e-9
    assert errors[-1] < 1e-3 * errors[0]


def test_at_rest_there_is_no_step():
    angles = np.radians([0.0, 120.0, 240.0])
    normals = np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles])
    step = contact_step(stack_of("fm"), sphere_grasp(normals))
    np.testing.assert_allclose(step, np.zeros(9), atol=1e-15)


@pytest.mark.parametrize("form", [contact_step, paper_levels])
def test_a_law_that_is_neither_is_refused_by_name(form):
    stack = ForceTask() >> PostureTask()
    with pytest.raises(InputError, match="posture is neither"):
        form(stack, random_grasp(0))
