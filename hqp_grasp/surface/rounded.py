"""The surface felt, in three dimensions: the hull of ellipsoids behind all that was felt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hqp_grasp.mechanics import tangents
from hqp_grasp.surface.felt import SURE, Felt, doubt
from hqp_grasp.surface.supported import Supported

SOFTNESS = (1e-3, 2e-4, 2e-5)  # [m] by which the hull's edges are rounded, ever less
ROUNDING = 2e-6  # [m] of what was felt
LONGEST = 0.1  # [m] semi-axis of an ellipsoid
NEGLECTED = 16.0  # [–] times the softness that a body's support is less than the hull's
SAME_NORMAL = 2e-4  # [–] 1 − n·n' below which two normals (1.1° apart) tell nothing of curvature


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
    softness: float = SOFTNESS[-1]  # [m]

    @classmethod
    def of(cls, felt: Felt, size: float) -> Rounded:
        """The surface of what was felt; `size` [m] is the object's radius, where nothing tells."""
        same = 0.5 * SURE**2 * (felt.noise[:, None] + felt.noise) ** 2
        slack = doubt(felt.positions, felt.noise, felt.tip_radii)
        return cls.behind(felt.positions, felt.normals, size, slack, same)

    @classmethod
    def behind(
        cls,
        x: np.ndarray,
        n: np.ndarray,
        radius: float = 0.05,
        slack: np.ndarray | float = 0.0,
        same: np.ndarray | float = 0.0,
    ) -> Rounded:
        """The surface through x (N, 3) [m] with outward normals n (N, 3), world.

        `radius` [m] is that of curvature where nothing felt tells it. Noise may have lifted point j
        over plane k by `slack` (N, N) [m] [k, j], and two normals tell nothing where 1 − n·n' is
        less than `same` (N, N) [–].
        """
        cosine = n @ n.T
        gap = np.maximum((n * x).sum(axis=1)[:, None] - n @ x.T, 0.0) + slack + ROUNDING
        tells = 1.0 - cosine > SAME_NORMAL + same
        b = np.where(tells, gap / np.where(tells, 1.0 - cosine, 1.0), 2.0 * radius).min(axis=0)
        b = np.minimum(b, 2.0 * radius)
        far = np.linalg.norm(x - x[:, None], axis=-1)
        flat = np.where(tells, 0.0, far).max(axis=0)
        longest = np.minimum(np.maximum(np.sqrt(b * radius), 2.0 * flat), LONGEST)
        M = _stretched(n, b, gap, cosine, tells, np.maximum(longest, b))
        Q = M + (b * b)[:, None, None] * n[:, :, None] * n[:, None, :]
        return cls(x, x - b[:, None] * n, Q)

    def support(self, u: np.ndarray) -> np.ndarray:
        return self.curved(u)[0]

    def smoother(self) -> Sequence[Supported]:
        return [replace(self, softness=v) for v in SOFTNESS if v > self.softness]

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
    bound = np.sqrt(np.maximum(gap * (gap + 2.0 * b * cosine), ROUNDING**2))
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
