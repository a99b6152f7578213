"""The alignment law: the way a palm turns to face what its contacts touch, from wherever it is."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest

from hqp_grasp.errors import InputError, SingularTaskError
from hqp_grasp.grasp import Contact, Frame, Grasp
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.tasks import AlignTask, ForceTask, PostureTask
from hqp_grasp.world.scene import Scene

STEP = 6e-6  # [rad] of central differences, ε^(1/3)
FD_TOL = 1e-8
EXACT = 1e-12
SEEDS = range(4)

robot = Scene("wam_bhand").articulated
SPACE = np.zeros(3)


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rodrigues' formula."""
    x, y, z = unit(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * K @ K


def touching(frames: dict[str, tuple[np.ndarray, np.ndarray]], normals: dict[str, list]) -> Grasp:
    """Palms by R_world_palm and how they turn with the joints (3, n), and what each one feels."""
    n = next(iter(frames.values()))[1].shape[1]
    contacts = [Contact(SPACE, v, group=name) for name, felt in normals.items() for v in felt]
    palms = [
        Frame(name, SPACE, R, np.concatenate([np.zeros((3, n)), turning]))
        for name, (R, turning) in frames.items()
    ]
    return Grasp(np.zeros(n), contacts, np.zeros((3 * len(contacts), n)), frames=palms)


def on_the_arm(q: np.ndarray, normals: list[np.ndarray]) -> Grasp:
    return touching({"hand": (robot.palm(q)[1], robot.palm_jacobian(q)[3:])}, {"hand": normals})


def ball_joint(R: np.ndarray, normal: np.ndarray) -> Grasp:
    """A palm that turns freely: its joints are its angular velocity, world."""
    return touching({"hand": (R, np.eye(3))}, {"hand": [normal]})


@pytest.fixture(params=SEEDS, ids="seed{}".format)
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    return np.random.default_rng(request.param)


# ---------------------------------------------------------------- error and slope


def test_the_jacobian_is_the_derivative_of_the_error_normals_held(rng):
    q = robot.home + 0.5 * rng.normal(size=robot.n)
    normals = [unit(rng.normal(size=3)) for _ in range(3)]
    task = AlignTask()
    J = task.jacobian(on_the_arm(q, normals))
    assert J.shape == (2, robot.n)
    for j, step in enumerate(STEP * np.eye(robot.n)):
        up, down = (task.error(on_the_arm(q + s * step, normals)) for s in (1, -1))
        np.testing.assert_allclose(J[:, j], (up - down) / (2 * STEP), atol=FD_TOL)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 0.1, math.pi / 2, 3.0, math.pi - 1e-3])
def test_it_is_so_at_every_angle_and_the_angle_is_the_length_of_the_error(angle, rng):
    R = rotation(rng.normal(size=3), rng.normal())
    roll = rng.uniform(0, 2 * math.pi)
    axis = R @ [math.cos(roll), math.sin(roll), 0.0]
    normal = -rotation(axis, angle) @ R[:, 2]
    task = AlignTask()
    e, J = task.error(ball_joint(R, normal)), task.jacobian(ball_joint(R, normal))
    assert np.linalg.norm(e) == pytest.approx(angle, abs=1e-9)
    step = STEP * min(1.0, math.pi - angle)
    for j in range(3):
        turned = [rotation(np.eye(3)[j], s * step) @ R for s in (1, -1)]
        up, down = (task.error(ball_joint(S, normal)) for S in turned)
        slope = (up - down) / (2 * step)
        np.testing.assert_allclose(J[:, j], slope, atol=1e-6 * max(1.0, np.abs(J).max()))


def test_a_palm_that_faces_the_mean_of_its_normals_is_content(rng):
    R = rotation(rng.normal(size=3), rng.normal())
    aside = 0.3 * R[:, 0]
    normals = [unit(-R[:, 2] + aside), unit(-R[:, 2] - aside)]
    grasp = touching({"hand": (R, np.eye(3))}, {"hand": normals})
    np.testing.assert_allclose(AlignTask().error(grasp), 0.0, atol=EXACT)


def test_no_error_depends_on_the_frame_it_is_seen_from(rng):
    R, normal = rotation(rng.normal(size=3), rng.normal()), unit(rng.normal(size=3))
    S = rotation(rng.normal(size=3), rng.normal())
    here = ball_joint(R, normal)
    there = touching({"hand": (S @ R, S)}, {"hand": [S @ normal]})
    for ask in (AlignTask().error, AlignTask().jacobian):
        np.testing.assert_allclose(ask(there), ask(here), atol=EXACT)


def test_each_palm_looks_at_its_own_contacts(rng):
    R = {name: rotation(rng.normal(size=3), rng.normal()) for name in ("left", "right")}
    turning = {"left": np.eye(3, 6), "right": np.eye(3, 6, 3)}
    normals = {name: [unit(rng.normal(size=3)) for _ in range(2)] for name in R}
    both = touching({name: (R[name], turning[name]) for name in R}, normals)
    task = AlignTask()
    e, J = task.error(both), task.jacobian(both)
    assert e.shape == (4,) and not J[:2, 3:].any() and not J[2:, :3].any()
    for i, name in enumerate(R):
        alone = touching({name: (R[name], np.eye(3))}, {name: normals[name]})
        np.testing.assert_array_equal(e[2 * i : 2 * i + 2], task.error(alone))


# ---------------------------------------------------------------- the step


def test_rows_ask_for_the_newton_step_in_angular_velocities_of_the_palm(rng):
    """Same solutions as jacobian·x = −error, and a turn about the approach axis is let be."""
    R, normal = rotation(rng.normal(size=3), rng.normal()), unit(rng.normal(size=3))
    grasp, task = ball_joint(R, normal), AlignTask(gain=0.5, weight=3.0)
    A, b = task.rows(grasp)
    np.testing.assert_allclose(A, 3.0 * R.T[:2], atol=EXACT)
    np.testing.assert_allclose(A @ R[:, 2], 0.0, atol=EXACT)
    x = np.linalg.lstsq(A, b, rcond=None)[0]
    e, J = AlignTask().error(grasp), AlignTask().jacobian(grasp)
    np.testing.assert_allclose(J @ x, -0.5 * e, atol=EXACT)


@pytest.mark.parametrize("angle", [1.0, 3.1, math.pi - 1e-5, math.pi - 1e-11, math.pi])
def test_one_step_of_a_free_palm_brings_it_there_from_anywhere(angle, rng):
    """From the opposite way too."""
    R = rotation(rng.normal(size=3), rng.normal())
    normal = -rotation(R[:, 1] + 0.5 * R[:, 0], angle) @ R[:, 2]
    A, b = AlignTask().rows(ball_joint(R, normal))
    x = np.linalg.lstsq(A, b, rcond=None)[0]
    assert np.linalg.norm(x) == pytest.approx(angle, abs=1e-9)
    there = rotation(x, float(np.linalg.norm(x))) @ R
    np.testing.assert_allclose(there[:, 2], -normal, atol=1e-9)


def test_at_the_opposite_way_the_palm_turns_about_its_opposition_axis():
    grasp = ball_joint(np.eye(3), np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(AlignTask().error(grasp), [-math.pi, 0.0], atol=EXACT)
    A, b = AlignTask().rows(grasp)
    np.testing.assert_allclose(np.linalg.lstsq(A, b, rcond=None)[0], [math.pi, 0, 0], atol=EXACT)
    J = AlignTask().jacobian(grasp)
    np.testing.assert_allclose(J, [[1, 0, 0], [0, 0, 0]], atol=EXACT)


def test_an_arm_turns_its_palm_over_within_caps_below_a_law_and_above_another():
    q, normal = robot.home.copy(), robot.palm(robot.home)[1][:, 2]
    stack = AlignTask() >> PostureTask(robot.home)
    for _ in range(60):
        grasp = on_the_arm(q, [normal])
        levels = stack.levels(grasp)
        x = HQP("active-set").solve(levels[1:]).x  # contacts are nowhere: they are not held
        q = q + x * min(1.0, 0.2 / np.abs(x).max())
    assert np.linalg.norm(AlignTask().error(on_the_arm(q, [normal]))) < 1e-6


# ---------------------------------------------------------------- what it needs


def test_what_has_no_side_to_face_is_a_named_case():
    v = np.array([0.6, 0.0, 0.8])
    grasp = touching({"left": (np.eye(3), np.eye(3))}, {"left": [v, -v]})
    for ask in (AlignTask().error, AlignTask().jacobian, AlignTask().rows):
        with pytest.raises(SingularTaskError, match=r"normals of the group 'left' cancel"):
            ask(grasp)


def test_palms_and_their_contacts_are_asked_for_by_name():
    plain = Grasp(np.zeros(3), [Contact(SPACE, [0, 0, 1.0])], np.eye(3))
    with pytest.raises(InputError, match=r"AlignTask needs palms: give the Grasp frames"):
        AlignTask().rows(plain)
    other = touching({"left": (np.eye(3), np.eye(3))}, {"right": [np.array([0, 0, 1.0])]})
    with pytest.raises(InputError, match=r"no contact belongs to the group 'left'; .*: 'right'"):
        AlignTask().error(other)


def test_it_is_a_law_like_any_other():
    task = AlignTask(gain=0.5)
    assert (task.name, task.unit) == ("align", "rad")
    copy = pickle.loads(pickle.dumps(task))
    assert copy == task and hash(copy) == hash(task) and eval(repr(task)) == task
    assert (ForceTask() >> task).name == "force ▷ align"
