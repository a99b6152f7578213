"""The surface felt, in three dimensions: the hull of ellipsoids behind all that was felt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hqp_grasp.mechanics import tangents
from hqp_grasp.surface.felt import SLACK, Felt, gaps
from hqp_grasp.surface.supported import Supported

NEGLECTED = 16.0  # [–] times the softness that a body's support is less than the hull's


@dataclass(frozen=True, eq=False)
class Rounded(Supported):
    """The roundest surface behind every tangent plane felt, through every point felt.

    At a contact touches, from inside, the largest ball that is behind all planes, of the radius

        b = min_k g_k/(1 − n_k·n),  g_k = n_k·(x_k − x).

    Along the surface it is stretched: an ellipsoid of the form Q = M + b² n nᵀ, M n = 0, is behind
    plane k where w_kᵀ M w_k ≤ g_k (g_k + 2 b n_k·n), w_k the part of n_k across n. That is linear
    in M: the largest is that of a Löwner ellipse. The surface is the hull of them all, h(u) the
    soft maximum of c_j·u + √(uᵀ Q_j u).
    """

    points: np.ndarray  # x (N, 3) [m] felt, world
    middles: np.ndarray  # c (N, 3) [m] of the ellipsoids
    shapes: np.ndarray  # Q (N, 3, 3) [m²]
    softness: float = 2e-5  # [m] by which the hull's edges are rounded

    @classmethod
    def of(cls, felt: Felt) -> Rounded:
        """The surface of what was felt."""
        x, n, b = felt.positions, felt.normals, felt.radii
        gap, cosine, tells = gaps(x, n, felt.noise, felt.tip_radii)
        far = np.linalg.norm(x - x[:, None], axis=-1)
        flat = np.where(tells, 0.0, far).max(axis=0)  # to the farthest point of the same face
        longest = np.clip(np.maximum(np.sqrt(0.5 * b * felt.widest), 2.0 * flat), b, felt.widest)
        M = _stretched(n, b, gap, cosine, tells, longest)
        Q = M + (b * b)[:, None, None] * n[:, :, None] * n[:, None, :]
        return cls(x, x - b[:, None] * n, Q)

    def support(self, u: np.ndarray) -> np.ndarray:
        return self.curved(u)[0]

    def doubt(self, x: np.ndarray) -> np.ndarray:
        return np.asarray(np.linalg.norm(x[:, None] - self.points, axis=-1).min(axis=1))

    def curved(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        N, tau = len(self.points), self.softness
        square = (u[:, :, None] * u[:, None]).reshape(-1, 9) @ self.shapes.reshape(N, 9).T
        h = u @ self.middles.T + np.sqrt(square)
        top = h.max(axis=1)
        i, j = np.nonzero(h > (top - NEGLECTED * tau)[:, None])  # the bodies j that count along u_i
        begin = np.flatnonzero(np.diff(i, prepend=-1))
        w = np.exp((h[i, j] - top[i]) / tau)
        total = np.add.reduceat(w, begin)
        w = w / total[i]
        Q, size = self.shapes[j], np.sqrt(square[i, j])
        out = np.einsum("pab,pb->pa", Q, u[i]) / size[:, None]
        x = self.middles[j] + out
        mean = np.add.reduceat(w[:, None] * x, begin)
        off = x - mean[i]
        own = (w / size)[:, None, None] * (Q - out[:, :, None] * out[:, None])
        among = (w / tau)[:, None, None] * off[:, :, None] * off[:, None]
        height = top + tau * np.log(total) - (mean * u).sum(axis=1)
        return mean + height[:, None] * u, np.add.reduceat(own + among, begin)


def _stretched(
    n: np.ndarray,
    b: np.ndarray,
    gap: np.ndarray,
    cosine: np.ndarray,
    tells: np.ndarray,
    longest: np.ndarray,
) -> np.ndarray:
    """The largest M_j (N, 3, 3) [m²] that all planes admit, with no semi-axis over `longest`.

    1/M is that of the least ellipse around the points w_k/√(g_k (g_k + 2 b n_k·n)) of the tangent
    plane, its middle at zero, by multiplicative updates of their weights (Titterington 1975). Four
    points at 1/longest bound it where planes do not.
    """
    T = tangents(n)  # (N, 2, 3)
    bound = np.sqrt(np.maximum(gap * (gap + 2.0 * b * cosine), SLACK**2))
    p = np.einsum("jai,ki->jka", T, n) / bound.T[..., None]
    p = np.where(tells.T[..., None], p, 0.0)
    angle = 0.25 * np.pi * np.arange(4)
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    p = np.concatenate([p, ring / longest[:, None, None]], axis=1)
    weight = np.full(p.shape[:2], 1.0 / p.shape[1])
    for _ in range(20):
        inverse = _inverse((weight[..., None] * p).swapaxes(1, 2) @ p)
        out = np.einsum("jka,jab,jkb->jk", p, inverse, p)
        weight = 0.5 * weight * out
    inverse = _inverse((weight[..., None] * p).swapaxes(1, 2) @ p)
    out = np.einsum("jka,jab,jkb->jk", p, inverse, p)
    M = inverse / out.max(axis=1)[:, None, None]
    value, vector = np.linalg.eigh(M)
    value = np.minimum(value, (longest**2)[:, None])
    M = (vector * value[:, None]) @ vector.swapaxes(1, 2)
    return np.asarray(T.swapaxes(1, 2) @ M @ T)


def _inverse(S: np.ndarray) -> np.ndarray:
    """Of symmetric (N, 2, 2); the determinant is kept from zero, by a share of the trace."""
    a, b, d = S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]
    det = np.maximum(a * d - b * b, 1e-12 * (a + d) ** 2)
    return np.stack([d, -b, -b, a], axis=-1).reshape(-1, 2, 2) / det[:, None, None]
