"""Contact sensing: from one wrench back to the contact that caused it, on synthetic wrenches."""

import numpy as np
import pytest

import hqp_grasp as hg

SPHERE = 0.008  # [m]
TIPS = [SPHERE, (0.006, 0.01, 0.014), (0.012, 0.012, 0.007)]
EXACT = 1e-11  # [m] and [–]: the closed form has no more error than rounding
SPINS = [0.0, 1e-15, 1e-12, 1e-9, 1e-6, 1e-3, 1e-2]  # [m] torque about the normal, by force
FRICTION = 1.2


def contact(rng, tip, spin, force=1.0, friction=FRICTION):
    """A random contact on the tip: its wrench (6,), position (3,) and outward normal (3,)."""
    axes = np.broadcast_to(tip, 3)
    u = rng.normal(size=3)
    u /= np.linalg.norm(u)
    c, inward = axes * u, u / axes
    normal = -inward / np.linalg.norm(inward)
    slide = np.cross(normal, rng.normal(size=3))
    slide *= rng.uniform(0.0, friction) / np.linalg.norm(slide)
    f = force * (normal + slide)
    torque = np.cross(c, f) + spin * np.linalg.norm(f) * rng.choice([-1.0, 1.0]) * normal
    return np.concatenate([f, torque]), c, normal


def rotation(rng):
    """A random rotation (3, 3)."""
    Q, R = np.linalg.qr(rng.normal(size=(3, 3)))
    Q *= np.sign(np.diag(R))
    return Q * np.sign(np.linalg.det(Q))


@pytest.mark.parametrize("tip", TIPS, ids=str)
@pytest.mark.parametrize("spin", SPINS)
def test_the_contact_is_recovered_whatever_the_torque_about_its_normal(tip, spin):
    rng = np.random.default_rng(1)
    for _ in range(300):
        wrench, c, normal = contact(rng, tip, spin, force=rng.uniform(0.1, 20.0))
        position, sensed = hg.sense(wrench, tip)
        np.testing.assert_allclose(position, c, rtol=0, atol=EXACT)
        np.testing.assert_allclose(sensed, normal, rtol=0, atol=EXACT / min(np.ravel(tip)))


def test_a_push_through_the_centre_touches_where_it_comes_from():
    position, normal = hg.sense(np.array([0.0, 0.0, 2.0, 0.0, 0.0, 0.0]), SPHERE)
    np.testing.assert_allclose(position, [0.0, 0.0, -SPHERE])
    np.testing.assert_allclose(normal, [0.0, 0.0, 1.0])


@pytest.mark.parametrize("tip", TIPS, ids=str)
def test_any_wrench_of_a_push_gives_a_point_of_the_tip_that_the_force_enters(tip):
    rng = np.random.default_rng(2)
    axes = np.broadcast_to(tip, 3)
    for _ in range(500):
        wrench = np.concatenate([rng.normal(size=3), rng.normal(0.0, 0.02, 3)])
        position, normal = hg.sense(wrench, tip)
        assert abs(np.linalg.norm(position / axes) - 1.0) < EXACT
        np.testing.assert_allclose(np.linalg.norm(normal), 1.0, rtol=0, atol=EXACT)
        assert wrench[:3] @ normal > 0.0


def test_another_frame_gives_the_same_contact_turned():
    rng = np.random.default_rng(3)
    for _ in range(50):
        wrench, c, normal = contact(rng, SPHERE, 1e-3)
        R = rotation(rng)
        position, sensed = hg.sense(np.concatenate([R @ wrench[:3], R @ wrench[3:]]), SPHERE)
        np.testing.assert_allclose(position, R @ c, rtol=0, atol=EXACT)
        np.testing.assert_allclose(sensed, R @ normal, rtol=0, atol=1e-9)


@pytest.mark.parametrize("scale", [1e-150, 1e-6, 1e6, 1e150])
def test_the_contact_does_not_depend_on_how_hard_it_is_pushed(scale):
    wrench, c, _ = contact(np.random.default_rng(4), SPHERE, 1e-3)
    np.testing.assert_allclose(hg.sense(scale * wrench, SPHERE)[0], c, rtol=0, atol=EXACT)


def test_three_equal_semi_axes_are_a_sphere():
    wrench, _, _ = contact(np.random.default_rng(5), SPHERE, 1e-3)
    for one, other in zip(hg.sense(wrench, SPHERE), hg.sense(wrench, [SPHERE] * 3), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_line_of_force_that_meets_the_sphere_at_two_points_is_told_apart_by_the_push():
    wrench, c, normal = contact(np.random.default_rng(6), SPHERE, 0.0)
    position, sensed = hg.sense(-wrench, SPHERE)
    # Both ends of the line explain the pull; the one returned is where it would be a push.
    assert np.linalg.norm(position - c) > 1e-3
    assert -wrench[:3] @ sensed > 0.0 > -wrench[:3] @ normal


@pytest.mark.parametrize(
    ("wrench", "tip", "words"),
    [
        (np.zeros(6), SPHERE, "force is zero"),
        ([0, 0, 0, 1e-3, 0, 0], SPHERE, "force is zero"),
        ([1, 0, 0, 0, 0.02, 0], SPHERE, "passes the tip by"),
        (np.ones(3), SPHERE, r"shape \(6\)"),
        ([np.nan, 0, 0, 0, 0, 0], SPHERE, "finite"),
        (np.ones(6), 0.0, "above 0"),
        (np.ones(6), (0.01, -0.01, 0.01), "above 0"),
    ],
)
def test_what_no_contact_explains_is_refused_with_the_reason(wrench, tip, words):
    with pytest.raises(hg.InputError, match=words):
        hg.sense(wrench, tip)
