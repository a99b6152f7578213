"""What all touches felt of the surface: points and outward normals, each with its doubt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hqp_grasp.errors import InputError
from hqp_grasp.grasp import Grasp, Touch
from hqp_grasp.surface.outline import wrapped

CONTRADICTION = 2e-4  # [m] a point may lie beyond the tangent plane of another
SLACK = 2e-6  # [m] rounding of what was felt
SURE = 2.5  # standard errors within which noise explains what was felt
SAME_PLACE = 1.5e-3  # [m] from one tip's centre to another's, of which noise is averaged out
LEAST_NOISE = 1e-6  # [rad]
KNOWN = 5e-5  # [m] to which kinematics know where a tip's centre was
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
        beyond = n @ x.T - (n * x).sum(axis=1)[:, None]
        apart = beyond > CONTRADICTION + doubt(x, noise, tip)
        kept = ~((apart | apart.T) & (probes > probes[:, None])).any(axis=1)
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


def steadied(history: Sequence[Touch]) -> tuple[Touch, ...]:
    """The same history, noise averaged out over all touches of one place, by any finger.

    They are those with the tips' centres within SAME_PLACE whose normals differ by no more than
    noise explains. Each counts by the inverse of its variance. What has no noise stays as it is.
    """
    contacts = [c for t in history if isinstance(t.felt, Grasp) for c in t.felt.contacts]
    if not any(c.noise for c in contacts):
        return tuple(history)
    noise = np.maximum([c.noise for c in contacts], LEAST_NOISE)
    n, rho = np.array([c.normal for c in contacts]), np.array([[c.tip_radius] for c in contacts])
    centers = np.array([c.position for c in contacts]) + rho * n
    near = np.linalg.norm(centers[:, None] - centers, axis=-1) < SAME_PLACE
    alike = np.linalg.norm(n[:, None] - n, axis=-1) <= SURE * np.hypot(noise[:, None], noise)
    weight = (near & alike) / noise**2
    n = weight @ n
    n /= np.linalg.norm(n, axis=1)[:, None]
    noise = 1.0 / np.sqrt(weight.sum(axis=1))
    averaged = (
        replace(c, position=x, normal=normal, noise=float(sigma))
        for c, x, normal, sigma in zip(contacts, centers - rho * n, n, noise, strict=True)
    )
    steady = []
    for touch in history:
        if isinstance(touch.felt, Grasp):
            those = tuple(next(averaged) for _ in touch.felt.contacts)
            touch = replace(touch, felt=replace(touch.felt, contacts=those))
        steady.append(touch)
    return tuple(steady)


def narrowed(c: np.ndarray, t: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angles t (N,) [rad] of normals felt with noise, within what convexity leaves; their errors.

    A ball's centre c (N, 2) [m], which kinematics tell, moves along a convex curve: all the other
    centres lie behind the tangent there. So neighbours bound the normal from either side, the
    closer, the more there are of them.
    What noise does not explain is left as it is felt.
    """
    d = c - c[:, None]
    far = np.linalg.norm(d, axis=-1)
    tells = far > KNOWN
    slack = np.arcsin(KNOWN / np.where(tells, far, KNOWN))
    bearing = wrapped(np.arctan2(d[..., 1], d[..., 0]) - t[:, None])
    right, left = tells & (bearing < 0.0), tells & (bearing > 0.0)
    low = np.where(right, bearing + 0.5 * np.pi - slack, -np.pi).max(axis=1)
    high = np.where(left, bearing - 0.5 * np.pi + slack, np.pi).min(axis=1)
    turn = np.where(low > high, 0.5 * (low + high), np.clip(0.0, low, high))
    left_over = np.maximum(high - low, 0.0) / np.sqrt(12.0)  # of a uniform distribution
    explained = np.abs(turn) <= SURE * noise  # else it is kinematics that err
    error = np.where(explained, np.minimum(noise, np.maximum(left_over, LEAST_NOISE)), noise)
    return wrapped(t + np.where(explained, turn, 0.0)), error


def doubt(x: np.ndarray, noise: np.ndarray, tip: np.ndarray) -> np.ndarray:
    """How far [m] over the plane of point j noise may lift point k, (N, N) [j, k]."""
    far = np.linalg.norm(x - x[:, None], axis=-1)
    return np.asarray(SURE * noise[:, None] * (far + tip[:, None]))


def balls(
    x: np.ndarray, n: np.ndarray, noise: np.ndarray, tip: np.ndarray, widest: float
) -> np.ndarray:
    """Radii (N,) [m] of the largest balls behind all planes, but for what noise may have lifted."""
    slack, same = SLACK + doubt(x, noise, tip), 0.5 * SURE**2 * (noise[:, None] + noise) ** 2
    return largest_balls(x, n, x, n, widest, slack, SAME_NORMAL + same)


def largest_balls(
    x: np.ndarray,
    n: np.ndarray,
    at: np.ndarray,
    normal: np.ndarray,
    widest: float,
    slack: np.ndarray | float = SLACK,
    same: np.ndarray | float = SAME_NORMAL,
) -> np.ndarray:
    """Radii (N,) [m] of balls that touch at x from inside, n being the outward normal there.

    They are the largest that stay behind the planes through `at` (M, d) with outward `normal`,
    but for `slack` (M, N) [m]; planes whose normal differs by 1 − n·n' ≤ `same` tell nothing.
    """
    turn = 1.0 - normal @ n.T
    gap = (normal * at).sum(axis=1)[:, None] - normal @ x.T  # [k, j] of point j behind plane k
    tells = turn > same
    bound = np.where(tells, (np.maximum(gap, 0.0) + slack) / np.where(tells, turn, 1.0), widest)
    return np.asarray(bound.min(axis=0, initial=widest))
