"""The hull of ellipsoids behind all that was felt."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_supported import Ellipsoid, directions, grasp_at, unit

from hqp_grasp.surface.felt import Felt
from hqp_grasp.surface.rounded import Rounded
from hqp_grasp.surface.supported import Supported


def felt_of(body, m=60, seed=0):
    n = directions(m, seed)
    return body.support(n), n


def cylinder(m, radius=0.03, half=0.06, seed=0):
    """Points and normals of the side of an upright cylinder."""
    random = np.random.default_rng(seed)
    t = random.uniform(0.0, 2.0 * np.pi, m)
    n = np.column_stack([np.cos(t), np.sin(t), np.zeros(m)])
    return radius * n + np.column_stack([np.zeros((m, 2)), random.uniform(-half, half, m)]), n


def box(m, seed=0):
    """Points and normals of the faces of a box."""
    random = np.random.default_rng(seed)
    size = np.array([0.03, 0.04, 0.06])
    x = size * random.uniform(-1.0, 1.0, (m, 3))
    face, sign = random.integers(0, 3, m), random.choice([-1.0, 1.0], m)
    n = sign[:, None] * np.eye(3)[face]
    x[np.arange(m), face] = sign * size[face]
    return x, n


def rounded(x, n, radius=0.05, noise=0.0):
    """The surface of these points and normals, felt by tips of a centimetre."""
    of_each = np.ones(len(x))
    balls = of_each.astype(bool)
    return Rounded.of(Felt(x, n, of_each, noise * of_each, 0.01 * of_each, balls, 2.0 * radius))


@pytest.mark.parametrize(
    ("x", "n"),
    [
        felt_of(Ellipsoid((0.03, 0.02, 0.025))),
        cylinder(40),
        box(40),
        felt_of(Ellipsoid((0.05,) * 3)),
    ],
    ids=["ellipsoid", "cylinder", "box", "ball"],
)
def test_the_surface_stays_behind_every_plane_and_reaches_every_point(x, n):
    surface = rounded(x, n)
    over = surface.support(np.concatenate([directions(500), n])) @ n.T - (n * x).sum(axis=1)
    assert over.max() < 2e-4
    assert (n * (surface.support(n) - x)).sum(axis=1) == pytest.approx(np.zeros(len(x)), abs=2e-4)
    each = surface.shapes  # and every body touches its point with its normal
    at = np.einsum("nij,nj->ni", each, n)
    at = surface.middles + at / np.sqrt((at * n).sum(axis=1))[:, None]
    assert at == pytest.approx(x, abs=1e-9)


def test_a_ball_is_known_from_three_touches():
    x, n = felt_of(Ellipsoid((0.04,) * 3, middle=(0.1, 0.2, 0.3)), 3)
    u = directions(200)
    at = rounded(x, n, radius=0.04).support(u)
    assert np.linalg.norm(at - (0.1, 0.2, 0.3), axis=1) == pytest.approx(
        np.full(200, 0.04), abs=2e-4
    )


def test_the_middle_of_a_cylinder_is_known_from_touches_all_around():
    x, n = cylinder(60)
    t = np.linspace(0.0, 2.0 * np.pi, 50)
    u = np.column_stack([np.cos(t), np.sin(t), 0.0 * t])
    at = rounded(x, n).support(u)
    assert (at * u).sum(axis=1) == pytest.approx(np.full(50, 0.03), abs=2e-4)


def test_an_ellipsoid_is_known_the_better_the_more_it_was_felt():
    body = Ellipsoid((0.06, 0.04, 0.04))
    u = directions(300, seed=9)
    error = []
    for m in (10, 40, 160):
        surface = rounded(*felt_of(body, m))
        error.append(np.abs(((surface.support(u) - body.support(u)) * u).sum(axis=1)).mean())
    assert error[0] > error[1] > error[2]
    assert error[2] < 3e-4


def test_support_points_are_where_the_sum_of_supports_has_its_slope():
    surface = rounded(*felt_of(Ellipsoid((0.03, 0.02, 0.025))))
    u = directions(50, seed=4)
    across = np.eye(3) - u[:, :, None] * u[:, None]
    differences = across @ Supported.curved(surface, u)[1] @ across
    assert across @ surface.curved(u)[1] @ across == pytest.approx(differences, abs=1e-3)
    w, step = np.cross(u, directions(50, seed=5)), 1e-6

    def h(v):
        return (v * surface.support(v)).sum(axis=1)

    slope = (h(unit(u + step * w)) - h(unit(u - step * w))) / (2.0 * step)
    assert slope == pytest.approx((w * surface.support(u)).sum(axis=1), abs=1e-7)


@pytest.mark.parametrize("k", [2, 3, 5])
def test_what_balances_on_the_surface_felt_nearly_balances_on_the_true_one(k):
    body = Ellipsoid((0.05, 0.03, 0.04))
    surface = rounded(*felt_of(body, 200))
    way = surface.ways(grasp_at(body, directions(k)))[0]
    _, n = way.at(1.0)
    assert np.abs(n.sum(axis=0)).max() < 1e-6
    assert np.abs(np.cross(n, body.support(n)).sum(axis=0)).max() < 2e-3 * k


def test_noise_that_is_known_sharpens_no_surface():
    body, random = Ellipsoid((0.04,) * 3), np.random.default_rng(6)
    x, n = felt_of(body, 30)
    noisy = unit(n + 0.02 * random.standard_normal(n.shape))
    doubting = rounded(x, noisy, 0.04, noise=0.02)
    believing = rounded(x, noisy, 0.04)
    radii, sharp = (np.linalg.norm(s.points - s.middles, axis=1) for s in (doubting, believing))
    assert radii.min() > 0.9 * 0.04 > sharp.min()
    assert np.median(radii) == pytest.approx(0.04, rel=0.5)


def test_a_rigid_motion_of_what_was_felt_moves_the_surface_with_it():
    R, p = Rotation.random(random_state=3).as_matrix(), np.array([0.3, -0.2, 1.0])
    x, n = felt_of(Ellipsoid((0.05, 0.03, 0.04)), 12)
    u = directions(100)
    here, there = rounded(x, n), rounded(x @ R.T + p, n @ R.T)
    h = (u * (here.support(u) @ R.T @ R)).sum(axis=1)
    moved = u @ R.T
    assert (moved * (there.support(moved) - p)).sum(axis=1) == pytest.approx(h, abs=1e-3)


def test_a_face_felt_far_apart_is_flat_between():
    x, n = np.array([[0.0, 0, 0.02], [0.06, 0, 0.02], [0.03, 0, -0.02]]), np.eye(3)[[2, 2, 2]]
    n = n * np.array([[1.0], [1.0], [-1.0]])
    surface = rounded(x, n)
    t = np.array([-0.01, 0.01])
    at = surface.support(np.column_stack([np.sin(t), 0 * t, np.cos(t)]))
    assert at[1, 0] - at[0, 0] > 0.06
