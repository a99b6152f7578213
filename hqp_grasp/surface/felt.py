"""What all touches felt of the surface: points and outward normals, each with its doubt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hqp_grasp.errors import InputError
from hqp_grasp.grasp import Grasp, Touch

CONTRADICTION = 2e-4  # [m] a point may lie beyond the tangent plane of another
SLACK = 2e-6  # [m] rounding of what was felt
SURE = 2.5  # standard errors within which noise explains what was felt
SAME_NORMAL = 2e-4  # [–] 1 − n·n' below which two normals (1.1° apart) tell nothing of curvature
UNDECIDED = 1e-5  # [–] mean squares of normals along a direction, below which tips decide
LEANING = 0.3  # [–] part of a normal along the axis, above which it is of an end face or its rim
UPRIGHT = 2e-3  # [–] the same, below which normals count alike for the axis, others the less
AXIS_STEPS = 10  # after which the axis that rims would turn stands still, to 1e-5


@dataclass(frozen=True, eq=False)
class Felt:
    """Every contact felt, by any finger, but for what newer ones contradict.

    Each says that the object, being convex, lies behind its tangent plane. The largest ball that
    touches the surface there from inside and stays behind every plane felt has the radius

        R_j = min_k n_k·(x_k − x_j)/(1 − n_k·n_j),

    at most `widest` where nothing bounds it.
    """

    positions: np.ndarray  # x (N, 3) [m], world
    normals: np.ndarray  # n (N, 3), outward, world
    probes: np.ndarray  # (N,) which touch of the history felt it
    noise: np.ndarray  # (N,) [rad] standard errors of the normals
    tip_radii: np.ndarray  # (N,) [m] of what felt them
    by_balls: np.ndarray  # (N,) whether that was a ball, which has no edges of its own
    widest: float  # [m]

    @classmethod
    def of(cls, history: Sequence[Touch], widest: float = 0.1) -> Felt:
        """What the hits of a history felt; raise InputError where there are none."""
        hits = [(i, t.felt) for i, t in enumerate(history) if isinstance(t.felt, Grasp)]
        if not hits:
            raise InputError("nothing has been felt yet: a memory begins with the first grasp")
        x = np.concatenate([grasp.positions for _, grasp in hits])
        n = np.concatenate([grasp.normals for _, grasp in hits])
        probes = np.concatenate([np.full(grasp.k, i) for i, grasp in hits])
        noise = np.array([c.noise for _, grasp in hits for c in grasp.contacts])
        tip = np.array([c.tip_radius for _, grasp in hits for c in grasp.contacts])
        by_balls = np.array([c.stretch is None for _, grasp in hits for c in grasp.contacts])
        kept = ~contradicted(x, n, probes, noise, tip)
        return cls(x[kept], n[kept], probes[kept], noise[kept], tip[kept], by_balls[kept], widest)

    @cached_property
    def radii(self) -> np.ndarray:
        """R (N,) [m]."""
        return balls(self.positions, self.normals, self.noise, self.tip_radii, self.widest)

    def axis(self, grasp: Grasp) -> np.ndarray:
        """The direction (3,) along which nothing curves, as far as was felt.

        It is that of the first normals, and then of all that do not lean towards it, each by the
        inverse of its lean: the sum of leans, not of their squares, is least, and a rim felt now
        and then does not turn it. Where normals leave it open, it is the one that the contacts of
        `grasp` lie least along.
        """
        p = grasp.positions - grasp.positions.mean(axis=0)
        spread = UNDECIDED * (p.T @ p) / max(float((p * p).sum()), np.finfo(float).tiny)
        weight = 0.5 ** (self.probes - self.probes.min())
        for _ in range(AXIS_STEPS):
            M = (weight[:, None] * self.normals).T @ self.normals / weight.sum() + spread
            axis = np.linalg.eigh(M)[1][:, 0]
            lean = np.abs(self.normals @ axis)
            weight = (lean < LEANING) / np.maximum(lean, UPRIGHT)
            if not weight.any():
                break
        return np.asarray(axis * np.sign(axis[np.abs(axis).argmax()]))


def contradicted(
    x: np.ndarray, n: np.ndarray, probes: np.ndarray, noise: np.ndarray, tip: np.ndarray
) -> np.ndarray:
    """Which contacts (N,) newer ones contradict: one lies beyond the tangent plane of the other."""
    beyond = n @ x.T - (n * x).sum(axis=1)[:, None]
    apart = beyond > CONTRADICTION + doubt(x, noise, tip)
    return np.asarray(((apart | apart.T) & (probes > probes[:, None])).any(axis=1))


def doubt(x: np.ndarray, noise: np.ndarray, tip: np.ndarray) -> np.ndarray:
    """How far [m] over the plane of point j noise may lift point k, (N, N) [j, k]."""
    far = np.linalg.norm(x - x[:, None], axis=-1)
    return np.asarray(SURE * noise[:, None] * (far + tip[:, None]))


def gaps(
    x: np.ndarray, n: np.ndarray, noise: np.ndarray, tip: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How far [m] point j is behind plane k at most, n_k·n_j, and whether they tell a curvature.

    Each is (N, N) [k, j]. Normals that noise or rounding makes of one say nothing of it.
    """
    cosine = n @ n.T
    behind = np.maximum((n * x).sum(axis=1)[:, None] - n @ x.T, 0.0)
    same = SAME_NORMAL + 0.5 * SURE**2 * (noise[:, None] + noise) ** 2
    return behind + SLACK + doubt(x, noise, tip), cosine, 1.0 - cosine > same


def balls(
    x: np.ndarray, n: np.ndarray, noise: np.ndarray, tip: np.ndarray, widest: float
) -> np.ndarray:
    """Radii (N,) [m] of the largest balls behind all planes, but for what noise may have lifted."""
    gap, cosine, tells = gaps(x, n, noise, tip)
    bound = np.where(tells, gap / np.where(tells, 1.0 - cosine, 1.0), widest)
    return np.asarray(bound.min(axis=0, initial=widest))
