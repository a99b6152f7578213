"""Every control law, against worlds where its assumptions hold exactly."""

from __future__ import annotations

import dataclasses
import math
import pickle
from collections.abc import Callable

import numpy as np
import pytest

from hqp_grasp.errors import InputError, SingularTaskError
from hqp_grasp.grasp import Contact, Grasp
from hqp_grasp.tasks import (
    ContactSpaceTask,
    ContactTask,
    ForceTask,
    KinematicTask,
    MomentTask,
    PostureTask,
    Task,
)

EPS = float(np.finfo(float).eps)
STEP = EPS ** (1 / 3)  # central differences: truncation and round-off meet at ε^(2/3) ≈ 4e-11
FD_TOL = 1e-6  # allows for the third derivatives and 1/radius factors of these worlds
EXACT = 1e3 * EPS  # plain arithmetic on numbers of order one

SEEDS = range(4)
RADIUS = 0.05  # [m]
FIXED_POINT = (0.3, -0.2, 0.1)  # [m]

ALL_TASKS = [
    ForceTask(RADIUS),
    MomentTask(),
    MomentTask(FIXED_POINT),
    KinematicTask("angle", "rows"),
    KinematicTask("eq7", "rows"),
    PostureTask(np.linspace(-1, 1, 10)),
    PostureTask(),
    ContactTask(),
]
MEASURING_TASKS = ALL_TASKS[:-2]  # the last two ask for no motion: their error is always zero


# ---------------------------------------------------------------- the model world


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rodrigues' formula."""
    a = unit(axis)
    K = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    return np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * K @ K


class Hand:
    """An arm of revolute joints that carries fingers of revolute joints, one point on each tip."""

    def __init__(self, rng: np.random.Generator, fingers: tuple[int, ...], arm: int = 4) -> None:
        self.arm = arm
        self.fingers = fingers
        self.n = arm + sum(fingers)
        self.axes = np.array([unit(rng.normal(size=3)) for _ in range(self.n)])
        self.offsets = 0.3 * rng.normal(size=(self.n, 3))  # [m] joint j in its parent's frame
        self.tips = 0.3 * rng.normal(size=(len(fingers), 3))  # [m] in the last link's frame
        ends = arm + np.cumsum(fingers)
        self.gammas = [tuple(range(end - g, end)) for g, end in zip(fingers, ends, strict=True)]

    def chain(self, i: int) -> list[int]:
        return [*range(self.arm), *self.gammas[i]]

    def points(self, q: np.ndarray) -> np.ndarray:
        """Fingertip points (k, 3)."""
        return np.array([self.trace(q, i)[2] for i in range(len(self.fingers))])

    def trace(self, q: np.ndarray, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Axes and origins of the joints of chain i, each (joints, 3), and its point (3,)."""
        R, p = np.eye(3), np.zeros(3)
        omega, origin = [], []
        for j in self.chain(i):
            p = p + R @ self.offsets[j]
            omega.append(R @ self.axes[j])
            origin.append(p)
            R = R @ rotation(self.axes[j], q[j])
        return np.array(omega), np.array(origin), p + R @ self.tips[i]

    def derivatives(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Jacobian (3k, n) and Hessian (3k, n, n) of the points, in closed form."""
        k, n = len(self.fingers), self.n
        J, H = np.zeros((k, 3, n)), np.zeros((k, 3, n, n))
        for i in range(k):
            omega, origin, x = self.trace(q, i)
            v = np.cross(omega, x - origin)
            joints = np.arange(len(v))
            nearer, farther = np.minimum.outer(joints, joints), np.maximum.outer(joints, joints)
            chain = np.array(self.chain(i))
            J[i][:, chain] = v.T
            H[i][:, chain[:, None], chain] = np.cross(omega[nearer], v[farther]).transpose(2, 0, 1)
        return J.reshape(3 * k, n), H.reshape(3 * k, n, n)


class World:
    """A hand that touches at q₀, and the surface each contact moves on from there."""

    def __init__(
        self, seed: int, fingers: tuple[int, ...] = (1, 1, 1), tip_radius: float = 0.0
    ) -> None:
        rng = np.random.default_rng(seed)
        self.hand = Hand(rng, fingers)
        self.q0 = rng.normal(size=self.hand.n)
        self.normals0 = np.array([unit(rng.normal(size=3)) for _ in fingers])
        self.x0 = self.hand.points(self.q0)
        self.tip_radius = tip_radius

    @property
    def grasp(self) -> Grasp:
        return self.at(self.q0, self.normals0, self.x0)

    def at(self, q: np.ndarray, normals: np.ndarray, positions: np.ndarray) -> Grasp:
        J, H = self.hand.derivatives(q)
        contacts = tuple(
            Contact(x, n, flexion=gamma, tip_radius=self.tip_radius)
            for x, n, gamma in zip(positions, normals, self.hand.gammas, strict=True)
        )
        return Grasp(q, contacts, J, hessian=H)

    def on_spheres(self, centres: np.ndarray, q: np.ndarray) -> Grasp:
        """Tip centres go to `centres`; each contact slides on its own sphere of RADIUS."""
        reach = RADIUS + self.tip_radius
        spheres = self.x0 - reach * self.normals0
        normals = np.array([unit(c - s) for c, s in zip(centres, spheres, strict=True)])
        return self.at(q, normals, spheres + RADIUS * normals)

    def on_planes(self, centres: np.ndarray, q: np.ndarray) -> Grasp:
        """Tip centres go to `centres`; each contact slides on its own plane."""
        off = ((centres - self.x0) * self.normals0).sum(axis=1, keepdims=True)
        return self.at(q, self.normals0, centres - off * self.normals0)

    def with_normals_held(self, centres: np.ndarray, q: np.ndarray) -> Grasp:
        """Tip centres go to `centres`; nothing is known of the object but its normals."""
        return self.at(q, self.normals0, centres)

    def surface(self, task: Task) -> Callable[[np.ndarray, np.ndarray], Grasp]:
        """The world in which `task` makes no approximation."""
        if isinstance(task, ForceTask):
            return self.on_spheres
        if isinstance(task, MomentTask):
            return self.on_planes
        return self.with_normals_held


def differences(f: Callable[[np.ndarray], np.ndarray], at: np.ndarray) -> np.ndarray:
    """∂f/∂at by central differences; the last axis runs over `at`."""
    columns = []
    for j in range(at.size):
        step = np.zeros(at.size)
        step[j] = STEP
        up, down = (np.asarray(f(at + s * step.reshape(at.shape))) for s in (1, -1))
        columns.append((up - down) / (2 * STEP))
    return np.stack(columns, axis=-1)


def moved(grasp: Grasp, R: np.ndarray, p: np.ndarray) -> Grasp:
    """The same grasp, seen from a world turned by R and shifted by p."""
    k, n = grasp.k, grasp.n
    assert grasp.hessian is not None
    contacts = tuple(
        dataclasses.replace(c, position=R @ c.position + p, normal=R @ c.normal)
        for c in grasp.contacts
    )
    J = (R @ grasp.jacobian.reshape(k, 3, n)).reshape(3 * k, n)
    H = np.einsum("ab,kbij->kaij", R, grasp.hessian.reshape(k, 3, n, n)).reshape(3 * k, n, n)
    return Grasp(grasp.q, contacts, J, hessian=H)


def plain_grasp(positions: np.ndarray, normals: np.ndarray) -> Grasp:
    """A grasp whose joints are the contact coordinates themselves."""
    contacts = tuple(Contact(x, n) for x, n in zip(positions, normals, strict=True))
    return Grasp(np.zeros(positions.size), contacts, np.eye(positions.size))


def one_finger(J_gamma: np.ndarray, normal: np.ndarray, hessian: np.ndarray | None) -> Grasp:
    """One contact whose joints are all flexions."""
    g = J_gamma.shape[1]
    contact = Contact(np.zeros(3), normal, name="tip_1", flexion=tuple(range(g)))
    return Grasp(np.zeros(g), (contact,), J_gamma, hessian=hessian)


AZIMUTHS = 0.3 + np.array([0, 2, 4]) * math.pi / 3  # 120° apart
THREE_ON_A_CIRCLE = np.stack([np.cos(AZIMUTHS), np.sin(AZIMUTHS), np.zeros(3)], axis=1)
TWO_OPPOSITE = np.array([[0.48, -0.8, 0.36], [-0.48, 0.8, -0.36]])


@pytest.fixture(params=SEEDS, ids=lambda s: f"seed{s}")
def seed(request: pytest.FixtureRequest) -> int:
    return int(request.param)


def task_id(task: Task) -> str:
    kind = getattr(task, "kind", getattr(task, "reference", ""))
    return f"{task.name}-{'fixed' if isinstance(kind, tuple) else kind}".rstrip("-")


every_task = pytest.mark.parametrize("task", ALL_TASKS, ids=task_id)
every_error = pytest.mark.parametrize("error", ["angle", "eq7"])
both_tips = pytest.mark.parametrize("tip_radius", [0.0, 0.01], ids=["point", "round_tip"])
contact_space_laws = pytest.mark.parametrize(
    "task", [t for t in ALL_TASKS if isinstance(t, ContactSpaceTask)], ids=task_id
)


# ---------------------------------------------------------------- the model world is right


def test_the_model_hand_has_the_jacobian_and_hessian_it_claims(seed: int) -> None:
    world = World(seed, fingers=(1, 2, 3))
    J, H = world.hand.derivatives(world.q0)
    J_fd = differences(lambda q: world.hand.points(q).ravel(), world.q0)
    H_fd = differences(lambda q: world.hand.derivatives(q)[0], world.q0)
    np.testing.assert_allclose(J, J_fd, atol=FD_TOL)
    np.testing.assert_allclose(H, H_fd, atol=FD_TOL)


# ---------------------------------------------------------------- every law


@pytest.mark.parametrize("task", MEASURING_TASKS, ids=task_id)
@both_tips
def test_every_jacobian_is_the_derivative_of_its_error(
    task: Task, tip_radius: float, seed: int
) -> None:
    world = World(seed, fingers=(1, 2, 3), tip_radius=tip_radius)
    touch = world.surface(task)
    fd = differences(lambda q: task.error(touch(world.hand.points(q), q)), world.q0)
    J = task.jacobian(world.grasp)
    assert J.shape == (len(task.error(world.grasp)), world.hand.n)
    np.testing.assert_allclose(J, fd, atol=FD_TOL)


@every_task
def test_rows_ask_for_a_newton_step(task: Task, seed: int) -> None:
    grasp = World(seed, fingers=(1, 2, 3)).grasp
    scaled = with_settings(task, gain=0.5, weight=3.0)
    A, b = scaled.rows(grasp)
    np.testing.assert_allclose(A, 3.0 * task.jacobian(grasp), rtol=EXACT)
    np.testing.assert_allclose(b, -1.5 * task.error(grasp), rtol=EXACT)


@every_task
def test_no_law_depends_on_the_frame_it_is_seen_from(task: Task, seed: int) -> None:
    grasp = World(seed, fingers=(1, 2, 3)).grasp
    rng = np.random.default_rng(100 + seed)
    R, p = rotation(rng.normal(size=3), rng.normal()), rng.normal(size=3)
    task_there = task
    if isinstance(task, MomentTask) and not isinstance(task.reference, str):
        task_there = MomentTask(R @ np.array(task.reference) + p)
    there = moved(grasp, R, p)
    S = R if isinstance(task, ContactSpaceTask) else np.eye(len(task.error(grasp)))
    np.testing.assert_allclose(task_there.error(there), S @ task.error(grasp), atol=EXACT)
    J, J_there = task.jacobian(grasp), task_there.jacobian(there)
    np.testing.assert_allclose(J_there, S @ J, atol=EXACT * max(1, np.abs(J).max()))


@every_task
def test_tasks_survive_pickling_and_compare_by_value(task: Task) -> None:
    copy = pickle.loads(pickle.dumps(task))
    assert copy == task and hash(copy) == hash(task) and repr(copy) == repr(task)
    assert copy != with_settings(task, gain=0.3)


@every_task
def test_a_task_is_frozen_and_its_repr_rebuilds_it(task: Task) -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        task.gain = 2.0  # type: ignore[misc]
    assert eval(repr(task)) == task


def test_each_law_has_its_short_name() -> None:
    names = [t.name for t in ALL_TASKS]
    assert sorted(set(names)) == ["contact", "force", "kinematic", "moment", "posture"]


def with_settings(task: Task, gain: float, weight: float = 1.0) -> Task:
    if isinstance(task, KinematicTask):
        return KinematicTask(task.kind, task.form, gain=gain, weight=weight)
    return dataclasses.replace(task, gain=gain, weight=weight)


# ---------------------------------------------------------------- force and moment


@contact_space_laws
@both_tips
def test_contact_jacobian_and_gradient_are_derivatives_on_the_law_s_own_surface(
    task: ContactSpaceTask, tip_radius: float, seed: int
) -> None:
    world = World(seed, tip_radius=tip_radius)
    touch = world.surface(task)
    fd = differences(lambda x: task.error(touch(x, world.q0)), world.x0)
    np.testing.assert_allclose(task.contact_jacobian(world.grasp), fd, atol=FD_TOL)
    fd = differences(lambda x: np.array(task.potential(touch(x, world.q0))), world.x0)
    np.testing.assert_allclose(task.contact_gradient(world.grasp), fd, atol=FD_TOL)


@contact_space_laws
def test_gradient_is_twice_jacobian_transpose_times_error(
    task: ContactSpaceTask, seed: int
) -> None:
    grasp = World(seed).grasp
    e, J = task.error(grasp), task.contact_jacobian(grasp)
    assert task.potential(grasp) == pytest.approx(float(e @ e), rel=EXACT)
    np.testing.assert_allclose(task.contact_gradient(grasp), 2 * J.T @ e, atol=EXACT * 1e2)


@contact_space_laws
@pytest.mark.parametrize("normals", [THREE_ON_A_CIRCLE, TWO_OPPOSITE], ids=["three", "two"])
def test_force_and_moment_vanish_at_a_known_good_grasp(
    task: ContactSpaceTask, normals: np.ndarray
) -> None:
    grasp = plain_grasp(RADIUS * normals + np.array([0.4, 0.1, 0.2]), normals)
    assert np.abs(task.error(grasp)).max() < EXACT
    assert np.abs(task.contact_gradient(grasp)).max() < EXACT * 1e2


def test_error_is_the_sum_of_forces_and_of_their_moments(seed: int) -> None:
    grasp = World(seed).grasp
    f = [-c.normal for c in grasp.contacts]
    centroid = np.mean([c.position for c in grasp.contacts], axis=0)
    for task, c in ((MomentTask(), centroid), (MomentTask(FIXED_POINT), np.array(FIXED_POINT))):
        m = sum(
            np.cross(contact.position - c, fi)
            for contact, fi in zip(grasp.contacts, f, strict=True)
        )
        np.testing.assert_allclose(task.error(grasp), m, atol=EXACT)
    np.testing.assert_allclose(ForceTask().error(grasp), sum(f), atol=EXACT)


def test_a_round_tip_adds_its_radius_to_the_sphere_its_centre_moves_on(
    seed: int,
) -> None:
    point, round_tip = World(seed).grasp, World(seed, tip_radius=0.01).grasp
    ratio = RADIUS / (RADIUS + 0.01)
    np.testing.assert_allclose(
        ForceTask(RADIUS).contact_jacobian(round_tip),
        ratio * ForceTask(RADIUS).contact_jacobian(point),
        atol=EXACT * 1e2,
    )


def test_force_jacobian_has_full_rank_unless_all_normals_are_parallel(seed: int) -> None:
    world = World(seed)
    J = ForceTask(RADIUS).contact_jacobian(world.grasp)
    assert np.linalg.matrix_rank(J @ J.T) == 3
    n = world.normals0[0]
    parallel = plain_grasp(world.x0, np.array([n, n, -n]))
    J = ForceTask(RADIUS).contact_jacobian(parallel)
    assert np.linalg.matrix_rank(J @ J.T, tol=1e-9 / RADIUS**2) == 2


def test_parallel_normals_that_do_not_cancel_are_stationary_for_force() -> None:
    n = unit(np.array([1.0, 2.0, -0.5]))
    grasp = plain_grasp(np.eye(3), np.array([n, n, -n]))
    assert ForceTask().potential(grasp) == pytest.approx(1.0)
    assert np.abs(ForceTask().contact_gradient(grasp)).max() < EXACT * 1e2


def test_moment_jacobians_about_centroid_and_point_differ_only_while_there_is_net_force(
    seed: int,
) -> None:
    def gap(normals: np.ndarray) -> float:
        grasp = plain_grasp(World(seed).x0, normals)
        centroid, point = MomentTask(), MomentTask(FIXED_POINT)
        return float(np.abs(centroid.contact_jacobian(grasp) - point.contact_jacobian(grasp)).max())

    assert gap(World(seed).normals0) > 1e-3
    assert gap(THREE_ON_A_CIRCLE) < EXACT


def test_moment_about_the_centroid_ignores_where_the_origin_is(seed: int) -> None:
    grasp = World(seed).grasp
    far = moved(grasp, np.eye(3), np.array([1.0, -2.0, 3.0]))
    np.testing.assert_allclose(MomentTask().error(far), MomentTask().error(grasp), atol=EXACT)
    assert np.abs(MomentTask((0, 0, 0)).error(far) - MomentTask().error(grasp)).max() > 1e-3


@contact_space_laws
def test_part_of_a_newton_step_removes_that_part_of_the_error(
    task: ContactSpaceTask, seed: int
) -> None:
    """What is left beyond it is of second order: a step half as long leaves a quarter."""
    world = World(seed)
    A, b = task.rows(world.grasp)
    x = np.linalg.lstsq(A, b, rcond=None)[0]
    touch = world.surface(task)

    def left(part: float) -> float:
        q = world.q0 + part * x
        e = task.error(touch(world.hand.points(q), q))
        return float(np.linalg.norm(e - (1 - part) * task.error(world.grasp)))

    part = 1e-3 / max(1.0, float(np.linalg.norm(x)))
    assert left(part / 2) == pytest.approx(left(part) / 4, rel=0.05)


# ---------------------------------------------------------------- kinematic


@every_error
@pytest.mark.parametrize("fingers", [(1, 1, 1), (2, 2, 2), (3, 3, 3), (4, 4), (3, 1, 2)], ids=str)
def test_kinematic_gradient_matches_differences_for_any_number_of_flexions(
    error: str, fingers: tuple[int, ...], seed: int
) -> None:
    world = World(seed, fingers)
    task = KinematicTask(error, gain=1.0)

    def at(q: np.ndarray) -> Grasp:
        return world.at(q, world.normals0, world.x0)

    fd = differences(lambda q: task.error(at(q)), world.q0)
    np.testing.assert_allclose(task.jacobian(world.grasp), fd, atol=FD_TOL)
    fd = differences(lambda q: np.array(task.potential(at(q))), world.q0)
    np.testing.assert_allclose(task.gradient(world.grasp), fd, atol=FD_TOL)


@every_error
def test_contacts_may_have_different_numbers_of_flexions(error: str, seed: int) -> None:
    """Padding to the longest changes nothing: each row is what the contact has alone."""
    world = World(seed, fingers=(1, 3, 2))
    task, grasp = KinematicTask(error), world.grasp
    assert grasp.hessian is not None
    for i, contact in enumerate(grasp.contacts):
        own = slice(3 * i, 3 * i + 3)
        alone = Grasp(grasp.q, (contact,), grasp.jacobian[own], hessian=grasp.hessian[own])
        np.testing.assert_allclose(task.error(grasp)[i], task.error(alone)[0], atol=EXACT)
        np.testing.assert_allclose(task.jacobian(grasp)[i], task.jacobian(alone)[0], atol=1e-10)


def test_angle_is_measured_between_the_flexion_velocity_and_the_line_of_the_normal(
    seed: int,
) -> None:
    world = World(seed)
    for i, e in enumerate(KinematicTask("angle").error(world.grasp)):
        v = world.grasp.contact_jacobian(i)[:, world.hand.gammas[i][0]]
        c = abs(world.normals0[i] @ v) / np.linalg.norm(v)
        assert e == pytest.approx(math.acos(c), abs=1e-9)
        assert 0 <= e <= math.pi / 2


def test_eq7_is_the_reciprocal_of_the_force_transmission_ratio(seed: int) -> None:
    world = World(seed, fingers=(1, 2, 3))
    for i, e in enumerate(KinematicTask("eq7").error(world.grasp)):
        J, n = world.grasp.contact_jacobian(i)[:, list(world.hand.gammas[i])], world.normals0[i]
        assert e == pytest.approx(math.sqrt(n @ J @ J.T @ n), rel=1e-12)


def test_eq9_as_printed_is_the_gradient(seed: int) -> None:
    world = World(seed, fingers=(2, 2, 2))
    grasp, total = world.grasp, np.zeros(world.hand.n)
    assert grasp.hessian is not None
    for i, gamma in enumerate(world.hand.gammas):
        n = world.normals0[i]
        w = grasp.contact_jacobian(i)[:, list(gamma)].T @ n
        dw = np.einsum("agl,a->gl", grasp.hessian[3 * i : 3 * i + 3][:, list(gamma)], n)
        total += w @ dw / math.sqrt(w @ w)
    np.testing.assert_allclose(KinematicTask("eq7").gradient(grasp), total, atol=EXACT)


@pytest.mark.parametrize("side", [1, -1], ids=["outward", "inward"])
def test_eq10_needs_the_sign_of_the_normal_speed(side: int, seed: int) -> None:
    """Turning the normal over changes neither error nor gradient; eq. 10 as printed would flip."""
    world = World(seed, fingers=(1,))
    n, j = world.normals0[0], world.hand.gammas[0][0]
    n = n * side * np.sign(n @ world.grasp.contact_jacobian(0)[:, j])
    grasp = world.at(world.q0, n[None], world.x0)
    assert grasp.hessian is not None
    printed = np.einsum("a,al->l", n, grasp.hessian[:, j])  # eq. 10
    np.testing.assert_allclose(KinematicTask("eq7").gradient(grasp), side * printed, atol=EXACT)


@every_error
def test_errors_do_not_know_which_way_the_normal_points(error: str, seed: int) -> None:
    world, task = World(seed, fingers=(1, 2, 3)), KinematicTask(error)
    over = world.at(world.q0, -world.normals0, world.x0)
    np.testing.assert_allclose(task.error(over), task.error(world.grasp), atol=EXACT)
    np.testing.assert_allclose(task.jacobian(over), task.jacobian(world.grasp), atol=EXACT * 1e2)


def test_angle_vanishes_where_flexion_pushes_along_the_normal_and_eq7_where_it_slides() -> None:
    n = np.array([0.0, 0.6, 0.8])
    tangent = np.array([1.0, 0.0, 0.0])
    H = np.random.default_rng(0).normal(size=(3, 1, 1))
    for motion, angle, eq7 in ((0.1 * n, 0.0, 0.1), (0.1 * tangent, math.pi / 2, 0.0)):
        grasp = one_finger(motion[:, None], n, H)
        assert KinematicTask("angle").error(grasp)[0] == pytest.approx(angle, abs=1e-15)
        assert KinematicTask("eq7").error(grasp)[0] == pytest.approx(eq7, abs=1e-15)


@pytest.mark.parametrize(
    ("error", "at_rest", "aside"),
    [("angle", [0, 0, 0.1], [0.1, 0, 0]), ("eq7", [0.1, 0, 0], [0, 0, 0.1])],
)
def test_near_its_minimum_a_row_stays_bounded_and_at_it_the_row_is_zero(
    error: str, at_rest: list[float], aside: list[float]
) -> None:
    """ε has a kink at 0: the row keeps its length down to it, and asks for ever less."""
    task = KinematicTask(error, "rows", gain=1.0)
    H = np.random.default_rng(1).normal(size=(3, 1, 1))
    normal = np.array([0.0, 0.0, 1.0])
    lengths, wanted = [], []
    for tilt in (1e-2, 1e-4, 1e-6, 1e-8):
        J = (np.array(at_rest) + tilt * np.array(aside))[:, None]
        A, b = task.rows(one_finger(J, normal, H))
        lengths.append(abs(A[0, 0]))
        wanted.append(abs(b[0]))
        assert b[0] == pytest.approx(-tilt * (1 if error == "angle" else 0.1), rel=1e-3)
    np.testing.assert_allclose(lengths, lengths[-1], rtol=0.2)
    assert wanted == sorted(wanted, reverse=True)
    A, b = task.rows(one_finger(np.array(at_rest)[:, None], normal, H))
    assert A[0, 0] == 0.0 and b[0] == 0.0


def test_at_a_right_angle_the_row_still_points_the_way_out() -> None:
    """At |n·J_γ| = 0 the angle is largest; a zero row there would hold the law in place."""
    H = np.array([0.0, 0.0, 1.0]).reshape(3, 1, 1)
    grasp = one_finger(np.array([[0.1], [0], [0]]), np.array([0.0, 0.0, 1.0]), H)
    A, b = KinematicTask("angle", "rows", gain=1.0).rows(grasp)
    assert b[0] == pytest.approx(-math.pi / 2)
    assert A[0, 0] == pytest.approx(-10.0)


@every_error
def test_gradient_form_asks_every_joint_to_descend(error: str, seed: int) -> None:
    grasp = World(seed).grasp
    task = KinematicTask(error, form="gradient", gain=0.1, weight=2.0)
    A, b = task.rows(grasp)
    np.testing.assert_array_equal(A, 2.0 * np.eye(grasp.n))
    np.testing.assert_allclose(b, -0.2 * task.gradient(grasp), rtol=EXACT)
    small = World(seed)
    q = small.q0 + 1e-3 * b / 2
    assert task.potential(small.at(q, small.normals0, small.x0)) < task.potential(grasp)


def with_closings(grasp: Grasp, closings: dict[int, np.ndarray]) -> Grasp:
    contacts = [
        dataclasses.replace(c, closing=closings.get(i)) for i, c in enumerate(grasp.contacts)
    ]
    return dataclasses.replace(grasp, contacts=tuple(contacts))


@pytest.mark.parametrize("told", [(0, 1, 2), (0, 2), (1,)], ids=str)
def test_a_contact_that_tells_its_closing_is_judged_by_the_way_it_moves_then(
    told: tuple[int, ...], seed: int
) -> None:
    """Whatever joints close it, those of the arm among them; the others as before."""
    world = World(seed, fingers=(2, 3, 1))
    rng = np.random.default_rng(200 + seed)
    closings = {i: rng.normal(size=world.hand.n) for i in told}
    task = KinematicTask()

    def at(q: np.ndarray) -> Grasp:
        return with_closings(world.at(q, world.normals0, world.x0), closings)

    grasp = at(world.q0)
    error = task.error(grasp)
    for i, w in closings.items():
        v = grasp.contact_jacobian(i) @ w
        cosine = abs(world.normals0[i] @ v) / np.linalg.norm(v)
        assert error[i] == pytest.approx(math.acos(cosine), abs=1e-9)
    for i in {0, 1, 2} - set(told):
        assert error[i] == pytest.approx(task.error(world.grasp)[i], abs=EXACT)
    fd = differences(lambda q: task.error(at(q)), world.q0)
    np.testing.assert_allclose(task.jacobian(grasp), fd, atol=FD_TOL)


def test_closing_has_a_direction_and_no_length_and_eq7_does_not_read_it(seed: int) -> None:
    world = World(seed, fingers=(2, 3, 1))
    rng = np.random.default_rng(300 + seed)
    w = {i: rng.normal(size=world.hand.n) for i in range(3)}
    one, other = (with_closings(world.grasp, {i: s * w[i] for i in w}) for s in (1.0, -1e-3))
    for ask in (KinematicTask().error, KinematicTask().jacobian):
        np.testing.assert_allclose(ask(one), ask(other), atol=EXACT * 1e2)
    eq7 = KinematicTask("eq7")
    np.testing.assert_array_equal(eq7.error(one), eq7.error(world.grasp))
    np.testing.assert_array_equal(eq7.jacobian(one), eq7.jacobian(world.grasp))


def test_one_flexion_joint_told_as_a_closing_gives_the_same_bits(seed: int) -> None:
    world = World(seed)
    w = {i: 0.06 * (-1) ** i * np.eye(world.hand.n)[j] for i, (j,) in enumerate(world.hand.gammas)}
    for ask in (KinematicTask().error, KinematicTask().jacobian):
        np.testing.assert_array_equal(ask(with_closings(world.grasp, w)), ask(world.grasp))


@pytest.mark.parametrize("tilt", [1.0, 0.1, 1e-3, 0.0])
def test_what_several_joints_close_asks_for_no_more_than_brings_its_angle_to_zero(
    tilt: float,
) -> None:
    """The slope keeps its length down to zero, and so would a step down it."""
    normal = np.array([math.sin(tilt), 0.0, math.cos(tilt)])
    J, H = np.zeros((3, 2)), np.zeros((3, 2, 2))
    J[2] = 0.05
    H[0, 0, 0] = 0.1  # the first joint turns the way of closing by as much as it turns itself
    one = one_finger(J, normal, H)
    both = with_closings(one, {0: np.array([1.0, 1.0])})
    task = KinematicTask(gain=0.6)
    np.testing.assert_allclose(task.step(both), [min(0.6, tilt), 0.0], atol=EXACT * 1e2)
    single = with_closings(one, {0: np.array([0.0, 1.0])})
    np.testing.assert_array_equal(task.step(single), -0.6 * task.gradient(single))


def test_two_equally_fast_joints_have_a_direction_once_it_is_told_how_they_close() -> None:
    J = 0.1 * np.eye(3)[:, :2]
    grasp = one_finger(J, unit(np.array([1.0, 1.0, 0.0])), np.zeros((3, 2, 2)))
    (error,) = KinematicTask().error(with_closings(grasp, {0: np.array([1.0, 1.0])}))
    assert error == pytest.approx(0.0, abs=EXACT)


def test_a_closing_that_closes_nothing_is_a_named_case() -> None:
    J = 0.1 * np.eye(3)[:, :2]
    grasp = one_finger(J, np.array([0.0, 0.0, 1.0]), np.zeros((3, 2, 2)))
    with pytest.raises(InputError, match=r"contact 0 \('tip_1'\) has no flexion joint"):
        KinematicTask().error(with_closings(grasp, {0: np.zeros(2)}))


def test_two_equally_fast_directions_are_a_named_case() -> None:
    J = 0.1 * np.eye(3)[:, :2]
    grasp = one_finger(J, unit(np.ones(3)), np.zeros((3, 2, 2)))
    with pytest.raises(SingularTaskError, match=r"contact 0 \('tip_1'\).*\(0, 1\).*equally fast"):
        KinematicTask("angle").error(grasp)
    assert KinematicTask("eq7").error(grasp)[0] == pytest.approx(0.1 * math.sqrt(2 / 3))


@pytest.mark.parametrize("g", [1, 2])
def test_a_flexion_that_does_not_move_its_contact_is_a_named_case(g: int) -> None:
    grasp = one_finger(np.zeros((3, g)), np.array([0.0, 0.0, 1.0]), np.zeros((3, g, g)))
    with pytest.raises(SingularTaskError, match=r"do not move it.*check Contact\.flexion"):
        KinematicTask("angle").error(grasp)
    assert KinematicTask("eq7").error(grasp)[0] == 0.0
    assert np.abs(KinematicTask("eq7").jacobian(grasp)).max() == 0.0


def test_of_several_contacts_the_one_that_its_flexion_does_not_move_is_named() -> None:
    contacts = [
        Contact(np.zeros(3), np.array([0.0, 0.0, 1.0]), name=f"tip_{i + 1}", flexion=(i,))
        for i in range(3)
    ]
    J = np.zeros((9, 3))
    J[[0, 6], [0, 2]] = 0.1  # the second joint moves nothing
    with pytest.raises(
        SingularTaskError, match=r"contact 1 \('tip_2'\): its flexion joints \(1,\)"
    ):
        KinematicTask("angle").error(Grasp(np.zeros(3), tuple(contacts), J))


# ---------------------------------------------------------------- posture and contact


def test_without_a_target_posture_asks_for_no_motion(seed: int) -> None:
    grasp = World(seed).grasp
    A, b = PostureTask().rows(grasp)
    np.testing.assert_array_equal(A, np.eye(grasp.n))
    np.testing.assert_array_equal(b, np.zeros(grasp.n))


def test_one_posture_step_reaches_its_target(seed: int) -> None:
    grasp = World(seed).grasp
    target = np.linspace(-1, 1, grasp.n)
    A, b = PostureTask(target).rows(grasp)
    np.testing.assert_allclose(grasp.q + np.linalg.solve(A, b), target, atol=EXACT)
    np.testing.assert_array_equal(PostureTask(grasp.q).error(grasp), np.zeros(grasp.n))


def test_contact_rows_are_the_change_of_distance_to_each_tangent_plane(seed: int) -> None:
    world = World(seed)

    def distances(q: np.ndarray) -> np.ndarray:
        return ((world.hand.points(q) - world.x0) * world.normals0).sum(axis=1)

    fd = differences(distances, world.q0)
    A, b = ContactTask().rows(world.grasp)
    np.testing.assert_allclose(A, fd, atol=FD_TOL)
    np.testing.assert_array_equal(b, np.zeros(3))


# ---------------------------------------------------------------- wrong input


@pytest.mark.parametrize("make", [ForceTask, MomentTask, KinematicTask, PostureTask, ContactTask])
@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf, "fast", None])
@pytest.mark.parametrize("setting", ["gain", "weight"])
def test_gain_and_weight_must_be_positive_numbers(
    make: Callable[..., Task], bad: object, setting: str
) -> None:
    if make is KinematicTask and (setting, bad) == ("gain", None):
        return  # its forms have gains of their own
    with pytest.raises(InputError, match=rf"Task\.{setting} must be .*above 0; got"):
        make(**{setting: bad})


@pytest.mark.parametrize("radius", [0.0, -0.05, math.nan, "wide"])
def test_the_sphere_of_the_force_law_must_have_a_radius(radius: object) -> None:
    with pytest.raises(InputError, match=r"ForceTask\.radius \[m\] must be .*above 0"):
        ForceTask(radius)  # type: ignore[arg-type]


def test_an_unknown_choice_lists_the_valid_ones() -> None:
    with pytest.raises(InputError, match=r"unknown KinematicTask error 'eq8'.*angle, eq7"):
        KinematicTask(error="eq8")
    with pytest.raises(InputError, match=r"unknown KinematicTask form 'row'.*rows, gradient"):
        KinematicTask(form="row")
    with pytest.raises(InputError, match=r"unknown MomentTask\.reference 'origin'.*centroid"):
        MomentTask("origin")


def test_points_and_postures_must_have_their_shape() -> None:
    with pytest.raises(InputError, match=r"MomentTask\.reference must have shape \(3\)"):
        MomentTask((0.0, 1.0))
    with pytest.raises(InputError, match=r"MomentTask\.reference must be finite"):
        MomentTask((0.0, math.nan, 1.0))
    with pytest.raises(InputError, match=r"PostureTask\.target must have shape"):
        PostureTask(np.eye(2))
    with pytest.raises(InputError, match=r"target has 2 joints; the grasp has 7"):
        PostureTask((0.0, 1.0)).rows(World(0).grasp)


def test_kinematic_says_what_the_grasp_lacks() -> None:
    normal = np.array([0.0, 0.0, 1.0])
    no_hessian = one_finger(np.array([[0.1], [0.0], [0.1]]), normal, None)
    assert KinematicTask().error(no_hessian).shape == (1,)
    with pytest.raises(InputError, match=r"hessian = ∂²x/∂q² of shape \(3, 1, 1\)"):
        KinematicTask().jacobian(no_hessian)
    no_flexion = plain_grasp(np.eye(3), THREE_ON_A_CIRCLE)
    with pytest.raises(InputError, match=r"contact 0 has no flexion joint; give Contact\.flexion"):
        KinematicTask().error(no_flexion)


def test_a_law_without_its_two_methods_cannot_be_built() -> None:
    with pytest.raises(TypeError, match="abstract"):
        Task()  # type: ignore[abstract]


def test_a_new_law_needs_only_an_error_and_a_jacobian() -> None:
    class HeightTask(Task):
        def error(self, grasp: Grasp) -> np.ndarray:
            return grasp.positions[:, 2]

        def jacobian(self, grasp: Grasp) -> np.ndarray:
            return grasp.jacobian[2::3]

    task, grasp = HeightTask(gain=0.5), plain_grasp(np.eye(3), THREE_ON_A_CIRCLE)
    A, b = task.rows(grasp)
    assert task.name == "height"
    assert A.shape == (3, 9)
    np.testing.assert_array_equal(b, [0, 0, -0.5])


def test_a_kinematic_task_is_replaced_field_by_field_as_any_dataclass_is():
    task = KinematicTask(error="eq7", form="gradient", gain=0.5)
    assert dataclasses.replace(task, gain=0.75) == KinematicTask("eq7", "gradient", gain=0.75)
    assert dataclasses.replace(task, error="angle").kind == "angle"
    assert dataclasses.replace(task, kind="angle") == KinematicTask(form="gradient", gain=0.5)


def test_laws_are_by_default_the_papers_for_an_object_of_five_centimetres() -> None:
    force, moment = ForceTask(), MomentTask()
    angle, rows = KinematicTask(), KinematicTask(form="rows")
    assert force.radius == 0.05 and moment.reference == "centroid"  # [m]
    assert (force.goal, moment.goal) == (1e-3, pytest.approx(4e-6))  # [N²], [(N·m)²]
    assert (angle.kind, angle.form, angle.gain, rows.gain) == ("angle", "gradient", 0.6, 0.25)
    assert (force.gain, moment.gain) == (1.0, 1.0)
    assert {law.weight for law in (force, moment, angle, rows)} == {1.0}


@pytest.mark.parametrize("k", [2, 3, 6])
@pytest.mark.parametrize("far", [0.05, 0.1, 0.25])
def test_goals_grow_with_contacts_and_beyond_a_hand_with_their_distance(k: int, far: float) -> None:
    """As what friction makes good does; wherever the object stands."""
    t = 2.0 * np.pi * np.arange(k) / k
    n = np.column_stack([np.cos(t), np.sin(t), np.zeros(k)])
    goals = []
    for at in (np.zeros(3), np.array([0.7, -0.4, 0.2])):
        contacts = [Contact(at + far * v, v) for v in n]
        goals.append(MomentTask().goal_at(Grasp(np.zeros(2), contacts, np.zeros((3 * k, 2)))))
    beyond = max(1.0, far / 0.1)  # [m] within which one hand grasps
    np.testing.assert_allclose(goals, 4e-6 * (k / 3.0 * beyond) ** 2)
    grasp = Grasp(np.zeros(2), contacts, np.zeros((3 * k, 2)))
    assert ForceTask().goal_at(grasp) == pytest.approx(1e-3 * (k / 3.0) ** 2)
    assert KinematicTask().goal_at(grasp) is None
