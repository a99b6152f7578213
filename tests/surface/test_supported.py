"""Surfaces by their support points: how normals turn on them, and where grasps balance."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hqp_grasp.grasp import Contact, Grasp
from hqp_grasp.surface.supported import Supported, _moments, zero_sum

RHO = 0.01  # [m] of the tips


class Ellipsoid(Supported):
    """A surface of one's own: all that it takes."""

    def __init__(self, semi_axes, R=None, middle=(0.0, 0.0, 0.0)):
        R = np.eye(3) if R is None else R
        self.Q, self.middle = R @ np.diag(np.square(semi_axes)) @ R.T, np.array(middle)

    def support(self, u):
        v = u @ self.Q
        return self.middle + v / np.sqrt((v * u).sum(axis=1))[:, None]


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def directions(m, seed=0):
    return unit(np.random.default_rng(seed).standard_normal((m, 3)))


def grasp_at(surface, normals):
    x = surface.support(normals)
    contacts = tuple(Contact(p, n, tip_radius=RHO) for p, n in zip(x, normals, strict=True))
    return Grasp(np.zeros(3), contacts, np.zeros((3 * len(x), 3)))


@pytest.mark.parametrize("k", range(2, 9))
def test_nearest_unit_vectors_sum_to_zero(k):
    e = zero_sum(directions(k))
    assert np.linalg.norm(e, axis=1) == pytest.approx(np.ones(k))
    assert np.abs(e.sum(axis=0)).max() < 1e-9


def test_vectors_that_sum_to_zero_stay():
    e = zero_sum(directions(5))
    assert np.abs(zero_sum(e) - e).max() < 0.01


def test_normals_of_one_face_spread_until_they_balance_the_others():
    normals = np.array([[1.0, 0, 0]] * 3 + [[-1.0, 0, 0]] * 2)
    e = zero_sum(normals)
    assert np.abs(e.sum(axis=0)).max() < 1e-9
    assert (e * normals).sum(axis=1).min() > 0.5


@pytest.mark.parametrize("k", range(2, 9))
def test_the_moment_is_how_the_sum_of_supports_changes_with_a_turn(k):
    surface, e = Ellipsoid((0.06, 0.04, 0.03)), zero_sum(directions(k))

    def H(R):
        u = e @ R.T
        return (u * surface.support(u)).sum()

    R, step = Rotation.random(random_state=1).as_matrix(), 1e-6
    turns = [Rotation.from_rotvec(step * w).as_matrix() for w in (*np.eye(3), *-np.eye(3))]
    differences = [H(A @ R) for A in turns]
    moment, change = _moments(surface, (R @ e.T)[None])
    assert np.subtract(differences[:3], differences[3:]) / (2 * step) == pytest.approx(
        moment[0], abs=1e-8
    )
    after = np.array([_moments(surface, (A @ R @ e.T)[None])[0][0] for A in turns])
    assert (after[:3] - after[3:]).T / (2 * step) == pytest.approx(change[0], abs=1e-6)


@pytest.mark.parametrize("k", range(2, 9))
def test_ways_lead_to_grasps_that_balance(k):
    surface = Ellipsoid((0.06, 0.04, 0.03))
    grasp = grasp_at(surface, directions(k))
    ways = surface.ways(grasp)
    assert len(ways) > 2
    assert [way.cost for way in ways] == sorted(way.cost for way in ways)
    for way in ways[:3]:
        centers, normals = way.at(1.0)
        x = centers - RHO * normals
        assert x == pytest.approx(surface.support(normals), abs=1e-6)
        assert np.abs(normals.sum(axis=0)).max() < 1e-9
        assert np.abs(np.cross(normals, x).sum(axis=0)).max() < 1e-5


def test_ways_differ():
    ways = Ellipsoid((0.06, 0.04, 0.03)).ways(
        grasp_at(Ellipsoid((0.06, 0.04, 0.03)), directions(3))
    )
    ends = np.array([way.at(1.0)[0] for way in ways])
    apart = np.linalg.norm(ends[:, None] - ends, axis=-1).max(axis=-1)
    assert (apart + np.eye(len(ways))).min() > 0.01


def test_a_way_leads_straight_from_the_contacts_to_places_on_the_surface():
    surface = Ellipsoid((0.06, 0.04, 0.03))
    grasp = grasp_at(surface, directions(3))
    way = surface.ways(grasp)[0]
    begin, normals = way.at(0.0)
    assert begin == pytest.approx(grasp.positions + RHO * grasp.normals, abs=1e-12)
    assert normals == pytest.approx(grasp.normals, abs=1e-12)
    end, last = way.at(1.0)
    assert end == pytest.approx(surface.support(last) + RHO * last, abs=1e-9)
    middle, half = way.at(0.5)
    assert middle == pytest.approx(0.5 * (begin + end), abs=1e-12)
    assert half == pytest.approx(unit(normals + last), abs=1e-12)


def test_three_fingers_on_a_ball_go_the_least_way():
    ball = Ellipsoid((0.05, 0.05, 0.05))
    grasp = grasp_at(ball, unit(zero_sum(np.eye(3)) + 0.1 * directions(3)))
    _, normals = ball.ways(grasp)[0].at(1.0)
    assert np.linalg.norm(normals - grasp.normals, axis=1).max() < 0.2


def test_a_rigid_motion_of_everything_moves_the_ways_with_it():
    R, p = Rotation.random(random_state=3).as_matrix(), np.array([0.3, -0.2, 1.0])
    here = Ellipsoid((0.06, 0.04, 0.03))
    there = Ellipsoid((0.06, 0.04, 0.03), R, p)
    normals = directions(3)
    one = here.ways(grasp_at(here, normals))[0]
    other = there.ways(grasp_at(there, normals @ R.T))[0]
    assert one.cost == pytest.approx(other.cost, rel=1e-4)
    assert one.at(1.0)[0] @ R.T + p == pytest.approx(other.at(1.0)[0], abs=1e-4)


def test_normals_turn_by_the_curvature_of_what_the_tips_centre_rides_on():
    surface = Ellipsoid((0.06, 0.04, 0.03))
    grasp = grasp_at(surface, directions(4))
    n = grasp.normals
    turn = surface.turn(grasp)
    step = 1e-5 * np.cross(n, directions(4, seed=2))
    n1 = unit(n + step)
    moved = surface.support(n1) - surface.support(n) + RHO * (n1 - n)
    assert np.einsum("kij,kj->ki", turn, moved) == pytest.approx(n1 - n, abs=1e-8)
    assert np.abs(np.einsum("kij,kj->ki", turn, n)).max() < 1e-9


def test_on_a_ball_every_turn_is_the_papers():
    ball = Ellipsoid((0.05, 0.05, 0.05))
    grasp = grasp_at(ball, directions(3))
    across = np.eye(3) - grasp.normals[:, :, None] * grasp.normals[:, None]
    assert ball.turn(grasp) == pytest.approx(across / (0.05 + RHO), rel=1e-5, abs=1e-5)
