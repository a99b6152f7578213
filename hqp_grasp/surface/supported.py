"""Convex surfaces that are known by their support points, and where grasps balance on them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from hqp_grasp.grasp import Grasp
from hqp_grasp.surface.surface import distinct, unit

STARTS = (300, 24)  # rotations from which balance is sought: anywhere, and near the grasp
DOUBT_WORTH = 0.5  # [–] m of way for which 1 m from what was felt is taken
MOMENT_WORTH = 50.0  # [–] m of way for which 1 N·m per N of moment left is taken


class Supported(ABC):
    """A convex surface, of which `support` tells the point that lies farthest along a direction.

    That is all a surface of one's own has to give. With h(u) = u·x(u) and unit vectors e_i that sum
    to zero, unit forces along the normals u_i = R e_i have no sum, and H(R) = Σ h(R e_i) changes
    with a turn ω of R by ω·Σ u_i × x(u_i): grasps balance at the critical points of H. Radii of
    tips change H by a constant.
    """

    @abstractmethod
    def support(self, u: np.ndarray) -> np.ndarray:
        """x(u) (m, 3) [m]: where the outward normal is the unit vector u (m, 3), world."""

    def curved(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """x(u) (m, 3) [m], and ∂x/∂u (m, 3, 3) [m] for turns of u (m, 3), by differences.

        In the tangent plane ∂x/∂u has the radii of curvature.
        """
        step, bend = 1e-5, np.zeros((len(u), 3, 3))  # [rad]
        for j in range(3):
            ahead, behind = (unit(u + sign * step * np.eye(3)[j]) for sign in (1.0, -1.0))
            bend[:, :, j] = (self.support(ahead) - self.support(behind)) / (2.0 * step)
        return self.support(u), bend

    def doubt(self, x: np.ndarray) -> np.ndarray:
        """How far (m,) [m] points x (m, 3) of the surface are from what is known for sure."""
        return np.zeros(len(x))

    def reach(self, u: np.ndarray) -> np.ndarray:
        """h(u) (m,) [m]: how far the object reaches along u (m, 3)."""
        return np.asarray((u * self.support(u)).sum(axis=1))

    def turn(self, grasp: Grasp) -> np.ndarray:
        """∂n_i/∂c_i (k, 3, 3) [1/m]: how each normal turns with its tip's centre, x + ρ u.

        It is the inverse of the tangent map ∂(x + ρ u)/∂u. A point of an edge or a corner turns
        a normal as fast as a ball of the size of rounding.
        """
        n, sharp = grasp.normals, 1e-6  # [m]
        rho = np.maximum([c.tip_radius for c in grasp.contacts], sharp)[:, None, None]
        along = n[:, :, None] * n[:, None, :]
        across = np.eye(3) - along
        bend = across @ self.curved(n)[1] @ across
        return np.asarray(np.linalg.inv(bend + rho * across + along) - along)

    def ways(self, grasp: Grasp) -> list[WayOver]:
        """Ways that differ to where unit forces along the normals balance, the cheapest first."""
        e = zero_sum(grasp.normals)
        R = _balanced(self, _starts(e, grasp.normals), e)
        u = R @ e.T
        cost, centers = _costs(self, grasp, u)
        chosen = distinct(cost, centers)
        return [WayOver(grasp, centers[i], u[i].T, float(cost[i])) for i in chosen]


@dataclass(frozen=True, eq=False)
class WayOver:
    """Straight from where contacts are to where they should be; normals turn by great circles."""

    grasp: Grasp
    centers: np.ndarray  # (k, 3) [m] where the tips' centres should be, world
    normals: np.ndarray  # (k, 3) there
    cost: float  # [m²]

    def at(self, share: float) -> tuple[np.ndarray, np.ndarray]:
        """The tips' centres (k, 3) [m] and the normals (k, 3) after a share of the way, world."""
        n, c = self.grasp.normals, self.grasp.centers
        cosine = (n * self.normals).sum(axis=1)[:, None]
        aside = self.normals - cosine * n
        sine = np.linalg.norm(aside, axis=1)[:, None]
        t = share * np.arctan2(sine, cosine)
        after = np.cos(t) * n + np.sin(t) * aside / np.maximum(sine, np.finfo(float).tiny)
        return c + share * (self.centers - c), unit(after)


def zero_sum(normals: np.ndarray) -> np.ndarray:
    """Unit vectors e (k, 3) that sum to zero, those nearest to k normals (k, 3).

    Two are opposite, three 120° apart: there are no others but for a rotation. Of more, the
    nearest are e_i ∝ n_i − µ with µ the geometric median of the normals, where Σ |n_i − µ| is
    least: its gradient is what has to vanish.
    """
    k = len(normals)
    if k < 4:
        t = 2.0 * np.pi * np.arange(k) / k
        return np.column_stack([np.cos(t), np.sin(t), np.zeros(k)])
    # Normals that are equal would have no direction from a median that lies on them.
    n = normals + 1e-3 * np.random.default_rng(k).standard_normal((k, 3))
    length = lambda mu: float(np.linalg.norm(n - mu, axis=1).sum())  # noqa: E731
    mu = n.mean(axis=0)
    for _ in range(100):
        r = np.linalg.norm(n - mu, axis=1)[:, None]
        e = (n - mu) / r
        slope = e.sum(axis=0)
        if np.linalg.norm(slope) < 1e-12:
            break
        H = np.eye(3) * (1.0 / r).sum() - (e / r).T @ e
        step = np.linalg.solve(H, slope)
        while length(mu + step) > length(mu) and np.linalg.norm(step) > 1e-15:
            step = 0.5 * step
        mu = mu + step
    return np.asarray(e)


def _starts(e: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Rotations (S, 3, 3) well spread, the one that brings e nearest to the normals, and near it.

    Each finger may have any e: to give two fingers of three each other's is a rotation too.
    """
    random = np.random.default_rng(len(e))
    spread = Rotation.random(STARTS[0], random)
    near = Rotation.from_rotvec(0.3 * random.standard_normal((STARTS[1], 3)))
    U, _, V = np.linalg.svd(normals.T @ e)
    nearest = U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V
    return np.concatenate([nearest[None], near.as_matrix() @ nearest, spread.as_matrix()])


def _balanced(surface: Supported, R: np.ndarray, e: np.ndarray, steps: int = 8) -> np.ndarray:
    """Rotations (S, 3, 3) from R on, of less moment: Levenberg and Marquardt's way."""
    m, J = _moments(surface, R @ e.T)
    damping = np.full(len(R), 1e-2)
    for _ in range(steps):
        A = J.swapaxes(1, 2) @ J
        size = np.trace(A, axis1=1, axis2=2)
        B = A + ((damping * size + 1e-18)[:, None, None]) * np.eye(3)
        turn = -np.linalg.solve(B, J.swapaxes(1, 2) @ m[..., None])[..., 0]
        far = np.linalg.norm(turn, axis=1)
        turn *= np.minimum(1.0, 0.4 / np.maximum(far, 1e-12))[:, None]
        tried = Rotation.from_rotvec(turn).as_matrix() @ R
        m1, J1 = _moments(surface, tried @ e.T)
        better = (m1 * m1).sum(axis=1) < (m * m).sum(axis=1)
        damping = np.where(better, 0.2 * damping, 5.0 * damping)
        R = np.where(better[:, None, None], tried, R)
        m, J = np.where(better[:, None], m1, m), np.where(better[:, None, None], J1, J)
    return R


def _moments(surface: Supported, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Σ u_i × x_i (S, 3) [m] for normals u (S, 3, k), and how it changes with a turn (S, 3, 3)."""
    u = u.swapaxes(1, 2)
    flat = u.reshape(-1, 3)
    x, bend = (v.reshape(*u.shape[:2], *v.shape[1:]) for v in surface.curved(flat))
    # A turn ω moves u by ω × u: ∂u/∂ω = −[u]×.
    by = -_cross_matrix(u)
    change = -_cross_matrix(x) @ by + _cross_matrix(u) @ bend @ by
    return np.cross(u, x).sum(axis=1), change.sum(axis=1)


def _costs(surface: Supported, grasp: Grasp, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Costs (S,) [m²] of ways to normals u (S, 3, k), and the tips' centres there (S, k, 3) [m]."""
    u = u.swapaxes(1, 2)
    flat = u.reshape(-1, 3)
    x = surface.support(flat)
    doubt = surface.doubt(x).reshape(u.shape[:2])
    x = x.reshape(u.shape)
    rho = np.array([[c.tip_radius] for c in grasp.contacts])
    centers = x + rho * u
    way = np.linalg.norm(centers - grasp.centers, axis=-1)
    moment = np.cross(u, x).sum(axis=1)
    cost = (way**2 + (DOUBT_WORTH * doubt) ** 2).sum(axis=1)
    return cost + MOMENT_WORTH**2 * (moment * moment).sum(axis=1), centers


def _cross_matrix(v: np.ndarray) -> np.ndarray:
    """[v]× (…, 3, 3) with [v]× w = v × w."""
    x, y, z = np.moveaxis(v, -1, 0)
    o = np.zeros_like(x)
    return np.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1).reshape(*v.shape, 3)
