"""Touches of known bodies, felt with noise: how near to the truth they are brought."""

import dataclasses

import numpy as np
import pytest

from hqp_grasp.grasp import Contact, Grasp, Miss, Missed, Touch
from hqp_grasp.surface import denoise
from hqp_grasp.surface.denoise import KNOWN, denoised

TIP, NOISE = 0.008, 0.02  # [m], [rad]
PARTS = ("position", "normal", "noise")
HEXAGON = np.radians(60.0 * np.arange(6))


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def sphere(N, rng):
    n = unit(rng.normal(size=(N, 3)))
    return 0.05 * n, n


def ellipsoid(N, rng):
    n, axes = unit(rng.normal(size=(N, 3))), np.array([0.06, 0.04, 0.03])
    return axes**2 * n / np.linalg.norm(axes * n, axis=1)[:, None], n


def circle(N, rng):
    t = rng.uniform(0.0, 2.0 * np.pi, N)
    n = np.column_stack([np.cos(t), np.sin(t), np.zeros(N)])
    return 0.05 * n + np.outer(rng.uniform(-0.02, 0.02, N), [0.0, 0.0, 1.0]), n


def prism(N, rng):
    """Half of the touches are on faces, half on the edges between them."""
    side, half = rng.integers(6, size=N), 0.05 * np.tan(np.pi / 6.0)
    on_edge = np.arange(N) % 2 == 0
    t = HEXAGON[side] + np.where(on_edge, rng.uniform(0.0, np.pi / 3.0, N), 0.0)
    n = np.column_stack([np.cos(t), np.sin(t), np.zeros(N)])
    a = HEXAGON[side]
    along = np.where(on_edge, half, rng.uniform(-half, half, N))
    x = 0.05 * np.cos(a) - along * np.sin(a), 0.05 * np.sin(a) + along * np.cos(a)
    return np.column_stack([*x, rng.uniform(-0.03, 0.03, N)]), n


def felt(x, n, noise, rng, tip=TIP):
    """Touches with one contact each, as a round tip feels it: the point lies where n says."""
    noise = np.broadcast_to(noise, len(x))
    noisy = unit(n + noise[:, None] * rng.normal(size=n.shape))
    return [
        touched(Contact(at, normal, tip_radius=tip, noise=sigma))
        for at, normal, sigma in zip(x + tip * (n - noisy), noisy, noise, strict=True)
    ]


def touched(*contacts):
    grasp = Grasp(np.zeros(2), contacts, np.zeros((3 * len(contacts), 2)))
    return Touch(grasp.q, grasp)


def told(touches):
    """Positions, normals (N, 3) and noise (N,) of the contacts in a history."""
    contacts = [c for touch in touches for c in touch.felt.contacts]
    return tuple(np.array([getattr(c, v) for c in contacts]) for v in PARTS)


def off(n, true):
    """Root mean square about one axis [rad]."""
    return np.sqrt(((n - true) ** 2).sum(axis=1).mean() / 2.0)


@pytest.mark.parametrize(
    ("body", "share"), [(sphere, 1.0), (ellipsoid, 1.0), (circle, 0.9), (prism, 0.5)]
)
def test_errors_fall_and_are_told_as_large_as_they_are(body, share):
    """Sixty touches all over a ball are too far apart to bound one another: no worse then."""
    rng, before, after, errors, beyond = np.random.default_rng(3), [], [], [], []
    for _ in range(6):
        x, true = body(60, rng)
        touches = felt(x, true, NOISE, rng)
        _, n, error = told(denoised(touches))
        before.append(off(told(touches)[1], true))
        after.append(off(n, true))
        errors.append(np.sqrt((error**2).mean()))
        beyond.append(np.linalg.norm(n - true, axis=1) > 2.45 * error)  # 5 % of a Gaussian's
    assert np.mean(after) <= share * np.mean(before)
    assert np.mean(errors) == pytest.approx(np.mean(after), rel=0.25)
    assert np.mean(beyond) < 0.1


def test_touches_of_one_place_are_averaged_by_the_inverse_of_their_variance():
    rng, noise, x, true = np.random.default_rng(1), np.array([0.01, 0.01, 0.02, 0.02]), 0.05, []
    at, normal = np.tile([[x, 0.0, 0.0]], (4, 1)), np.tile([[1.0, 0.0, 0.0]], (4, 1))
    for _ in range(100):
        touches = felt(at, normal, noise, rng)
        positions, n, error = told(denoised(touches))
        mean = unit(noise**-2.0 @ told(touches)[1])
        np.testing.assert_allclose(n, np.tile(mean, (4, 1)), atol=3e-3)
        np.testing.assert_allclose(positions + TIP * n, at + TIP * normal, atol=1e-15)
        true.append(off(n, normal))
    expected = 0.01 / np.sqrt(2.5)
    assert np.sqrt(np.mean(np.square(true))) == pytest.approx(expected, rel=0.15)
    assert np.mean(error) == pytest.approx(expected, rel=0.2)


def test_what_has_no_noise_stays_as_it_is():
    rng = np.random.default_rng(0)
    x, n = prism(30, rng)
    exact = felt(x, n, 0.0, rng)
    assert all(a is b for a, b in zip(denoised(exact), exact, strict=True))
    noise = np.where(np.arange(30) % 3 == 0, 0.0, NOISE)
    mixed = felt(x, n, noise, rng)
    better = denoised(mixed)
    for after, before in zip(told(better), told(mixed), strict=True):
        np.testing.assert_array_equal(after[noise == 0.0], before[noise == 0.0])
    unsure = noise > 0.0
    before = off(told(mixed)[1][unsure], n[unsure])
    assert off(told(better)[1][unsure], n[unsure]) < 0.5 * before


def test_misses_stay_where_they_were():
    rng = np.random.default_rng(0)
    touches = felt(*circle(4, rng), NOISE, rng)
    missed = Touch(touches[0].q_target, Missed(Miss.NO_TOUCH, "finger_1"))
    with_miss = denoised([touches[0], missed, *touches[1:]])
    assert with_miss[1] is missed
    without = told(denoised(touches))
    for a, b in zip(told([with_miss[0], *with_miss[2:]]), without, strict=True):
        np.testing.assert_array_equal(a, b)


def test_what_newer_touches_contradict_tells_nothing_of_them():
    """The object moved by 2 cm: the new touches are denoised as if there were no others."""
    rng = np.random.default_rng(3)
    x, n = prism(30, rng)
    old = felt(x + 0.02 * np.eye(3)[0], n, NOISE, rng)[:3]
    x, n = prism(60, rng)
    new = felt(x, n, NOISE, rng)
    both, alone = told(denoised([*old, *new])), told(denoised(new))
    ahead = np.einsum("ia,ja->ij", n, told(old)[0]) > np.einsum("ia,ia->i", n, x)[:, None]
    assert ahead.any(axis=0).all()  # each is
    for a, b in zip(both, alone, strict=True):
        np.testing.assert_array_equal(a[3:], b)


def test_what_nothing_explains_stays_as_it_is(monkeypatch):
    """A dent, that no convex object has, and a method that does not get there."""
    x = np.array([[-0.01, 0.0, 0.0], [0.0, 0.0, -0.005], [0.01, 0.0, 0.0]])
    n = unit(np.array([[0.3, 0.0, 1.0], [0.0, 0.0, 1.0], [-0.3, 0.0, 1.0]]))
    contacts = [Contact(a, b, tip_radius=TIP, noise=1e-3) for a, b in zip(x, n, strict=True)]
    dent = [touched(*contacts)]
    assert denoised(dent)[0] is dent[0]
    rng = np.random.default_rng(0)
    touches = felt(*prism(30, rng), NOISE, rng)
    assert denoised(touches)[0] is not touches[0]
    monkeypatch.setattr(denoise, "STEPS", 1)
    assert all(a is b for a, b in zip(denoised(touches), touches, strict=True))


def test_faces_that_meet_at_an_edge_are_not_blurred():
    """Two millimetres beside an edge on either side, noise leaves 60° between the faces."""
    rng, back = np.random.default_rng(5), np.tile([2e-3, 4e-3, 8e-3], 2)
    a = np.repeat([0.0, np.pi / 3.0], 3)
    true = np.column_stack([np.cos(a), np.sin(a), np.zeros(6)])
    way = np.column_stack([-np.sin(a), np.cos(a), np.zeros(6)])
    x = way * np.where(a > 0.0, back, -back)[:, None]
    _, n, _ = told(denoised(felt(x, true, NOISE, rng)))
    turn = np.degrees(np.arccos(n[:3].mean(axis=0) @ n[3:].mean(axis=0)))
    assert turn == pytest.approx(60.0, abs=1.0)
    assert off(n, true) < NOISE


@pytest.mark.parametrize("tip", [0.0, TIP])
def test_a_face_is_found_as_flat_as_its_centres_are(tip):
    rng, N = np.random.default_rng(2), 15
    x = np.column_stack([rng.uniform(-0.03, 0.03, (N, 2)), np.zeros(N)])
    true = np.tile([0.0, 0.0, 1.0], (N, 1))
    _, n, error = told(denoised(felt(x, true, NOISE, rng, tip)))
    inside = np.argsort(np.linalg.norm(x, axis=1))[:5]
    assert off(n[inside], true[inside]) < 0.1 * NOISE
    assert error[inside].max() < 0.3 * NOISE


def test_it_turns_and_shifts_with_the_world():
    rng = np.random.default_rng(4)
    touches = felt(*ellipsoid(24, rng), NOISE, rng)
    Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    Q *= np.sign(np.linalg.det(Q))
    shift = np.array([0.3, -0.2, 0.5])
    elsewhere = [
        touched(dataclasses.replace(c, position=Q @ c.position + shift, normal=Q @ c.normal))
        for c in (touch.felt.contacts[0] for touch in touches)
    ]
    x, n, error = told(denoised(touches))
    moved = told(denoised(elsewhere))
    np.testing.assert_allclose(moved[0], x @ Q.T + shift, atol=1e-5)
    np.testing.assert_allclose(moved[1], n @ Q.T, atol=1e-3)
    np.testing.assert_allclose(moved[2], error, rtol=0.1)


def test_centres_that_scatter_are_believed_no_more_than_they_deserve():
    """Half a millimetre of error in the centres, unsaid: no normal is made worse by it."""
    rng, before, after, errors = np.random.default_rng(6), [], [], []
    for _ in range(6):
        x, true = circle(40, rng)
        touches = felt(x + 25 * KNOWN[0] * rng.normal(size=x.shape), true, NOISE, rng)
        _, n, error = told(denoised(touches))
        before.append(off(told(touches)[1], true))
        after.append(off(n, true))
        errors.append(np.sqrt((error**2).mean()))
    assert np.mean(after) < np.mean(before)
    assert np.mean(errors) == pytest.approx(np.mean(after), rel=0.5)
