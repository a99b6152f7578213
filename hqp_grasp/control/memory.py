"""What has been felt of the object, as a surface that predicts what has not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hqp_grasp.control.outline import Outline, directions, wrapped
from hqp_grasp.errors import InputError
from hqp_grasp.grasp import Grasp, Touch

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
WIDEST = 2.0  # [–] balls are this many times as large as the prior one at most
EDGE = 1e-3  # [m] a smaller ball is an edge
EDGE_TURN = 0.5  # [–] share of the angle left, by which an edge is taken to turn on
SHARPER = 0.6  # [–] radius that each further touch of a face leaves of its corners
FLATTER = 0.5  # [m] radius of what counts as flat
FLAT = 1e-3  # [m] a face is known to be flat where it was felt so far apart
CORNER = 2.4  # [rad] neighbouring faces turn by less where they meet


@dataclass(frozen=True, eq=False)
class SurfaceMemory:
    """Every contact felt, by any finger, and the roundest surface through all of them.

    Each contact says that the object, being convex, lies behind its tangent plane. The largest ball
    that touches the surface there from inside and stays behind every plane felt has the radius

        R_j = min_k n_k·(x_k − x_j)/(1 − n_k·n_j).

    The surface predicted is the hull of these balls: exact on cylinders and spheres from the first
    grasp, flat between points of one face, sharp at an edge felt beside its face, and elsewhere as
    round as what was felt allows.
    """

    positions: np.ndarray  # x (N, 3) [m], world
    normals: np.ndarray  # n (N, 3), outward, world
    probes: np.ndarray  # (N,) which touch of the history felt it
    radii: np.ndarray  # R (N,) [m]
    noise: np.ndarray  # (N,) [rad] standard errors of the normals
    tip_radii: np.ndarray  # (N,) [m] of what felt them
    widest: float  # [m] radius of balls that nothing felt bounds

    @classmethod
    def of(cls, history: Sequence[Touch], radius: float = 0.05) -> SurfaceMemory:
        """What the hits of a history felt, but for what newer ones contradict.

        `radius` [m] is the object's, where nothing felt bounds it.
        """
        hits = [(i, t.felt) for i, t in enumerate(history) if isinstance(t.felt, Grasp)]
        if not hits:
            raise InputError("nothing has been felt yet: a memory begins with the first grasp")
        x = np.concatenate([grasp.positions for _, grasp in hits])
        n = np.concatenate([grasp.normals for _, grasp in hits])
        probes = np.concatenate([np.full(grasp.k, i) for i, grasp in hits])
        noise = np.array([c.noise for _, grasp in hits for c in grasp.contacts])
        tip = np.array([c.tip_radius for _, grasp in hits for c in grasp.contacts])
        beyond = n @ x.T - (n * x).sum(axis=1)[:, None]
        apart = beyond > CONTRADICTION + _doubt(x, noise, tip)
        kept = ~((apart | apart.T) & (probes > probes[:, None])).any(axis=1)
        x, n, noise, tip = x[kept], n[kept], noise[kept], tip[kept]
        widest = WIDEST * radius
        balls = _balls(x, n, noise, tip, widest)
        return cls(x, n, probes[kept], balls, noise, tip, widest)

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

    def outline(self, axis: np.ndarray, tip_radius: float) -> Outline:
        """The surface as seen along `axis`: from normals across it, and around all other points."""
        across = np.abs(self.normals @ axis) < LEANING
        first = np.eye(3)[np.abs(axis).argmin()]
        first = first - (first @ axis) * axis
        first /= np.linalg.norm(first)
        frame = np.array([first, np.cross(axis, first)])
        x, R = self.positions[across] @ frame.T, self.radii[across]
        n = self.normals[across] @ frame.T
        n /= np.linalg.norm(n, axis=1)[:, None]
        felt = np.arctan2(n[:, 1], n[:, 0])
        if self.noise.any():
            tip = self.tip_radii[across]
            c = x + tip[:, None] * n
            felt, noise = narrowed(c, felt, self.noise[across])
            n = directions(felt)
            x = c - tip[:, None] * n
            R = _balls(x, n, noise, tip, self.widest)
        corners, sharp = _corners(x, n, felt)
        R = np.minimum(R, _beside_edges(x, n, R, felt))
        within = self.positions[~across] @ frame.T  # of end faces and their rims
        c = np.concatenate([x - R[:, None] * n, corners, within])
        R = np.concatenate([R, sharp, np.zeros(len(within))])
        return Outline.around(c, R, frame, tip_radius, felt)


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


def _doubt(x: np.ndarray, noise: np.ndarray, tip: np.ndarray) -> np.ndarray:
    """How far [m] over the plane of point j noise may lift point k, (N, N) [j, k]."""
    far = np.linalg.norm(x - x[:, None], axis=-1)
    return np.asarray(SURE * noise[:, None] * (far + tip[:, None]))


def _balls(
    x: np.ndarray, n: np.ndarray, noise: np.ndarray, tip: np.ndarray, widest: float
) -> np.ndarray:
    """Radii (N,) [m] of the largest balls behind all planes, but for what noise may have lifted."""
    slack, same = SLACK + _doubt(x, noise, tip), 0.5 * SURE**2 * (noise[:, None] + noise) ** 2
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


def _beside_edges(x: np.ndarray, n: np.ndarray, R: np.ndarray, felt: np.ndarray) -> np.ndarray:
    """Radii that let edges turn on, by a share of the angle that the points felt leave them."""
    edge = np.flatnonzero(R < EDGE)
    d = x - x[edge][:, None]
    bearing = (np.arctan2(d[..., 1], d[..., 0]) - felt[edge][:, None]) % (2.0 * np.pi)
    bearing = np.where(np.linalg.norm(d, axis=-1) > EDGE, bearing, np.pi)
    left = np.maximum(bearing.min(axis=1, initial=2.0 * np.pi) - 0.5 * np.pi, 0.0)
    right = np.maximum(1.5 * np.pi - bearing.max(axis=1, initial=0.0), 0.0)
    t = np.tile(felt[edge], 2) + EDGE_TURN * np.concatenate([left, -right])
    normal = np.column_stack([np.cos(t), np.sin(t)])
    return largest_balls(x, n, np.tile(x[edge], (2, 1)), normal, np.inf)


def _corners(x: np.ndarray, n: np.ndarray, felt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Discs (c, R) in the corners of faces and their neighbours, be those faces or edges.

    The largest that fits has R = min(d_a, d_b)/tan(half the turn), with d the way from the last
    point felt to the corner; the more often a face was found flat, the smaller it is taken to be.
    """
    order = np.argsort(felt)
    turn = np.diff(felt[order], append=felt[order[0]] + 2.0 * np.pi)
    last = np.flatnonzero(turn > np.sqrt(2.0 * SAME_NORMAL))  # of each group of equal normals
    G = len(last)
    if G < 2:
        return np.zeros((0, 2)), np.zeros(0)
    group = np.empty(len(felt), dtype=int)
    group[order] = np.searchsorted(last, np.arange(len(felt))) % G
    normal, h = n[order[last]], (n[order[last]] * x[order[last]]).sum(axis=1)
    tangent = np.column_stack([-normal[:, 1], normal[:, 0]])
    along = (x * tangent[group]).sum(axis=1)
    low, high = np.full(G, np.inf), np.full(G, -np.inf)
    np.minimum.at(low, group, along)
    np.maximum.at(high, group, along)
    first = np.append(last[-1] + 1 - len(felt), last[:-1] + 1)  # of each group
    spread = (felt[order[last]] - felt[order[first % len(felt)]]) % (2.0 * np.pi)
    flat = high - low
    flat[spread * FLATTER > flat] = 0.0
    flat = np.where(flat > FLAT, np.bincount(group, minlength=G) - 1.0, 0.0)
    a, b = np.arange(G), (np.arange(G) + 1) % G
    a = a[(turn[last] < CORNER) & (flat[a] + flat[b] > 0.0)]
    b, half = (a + 1) % G, 0.5 * turn[last[a]]
    planes = np.stack([normal[a], normal[b]], axis=1)
    solved = np.linalg.solve(
        planes, np.stack([[h[a], h[b]], np.ones((2, len(a)))], -1).swapaxes(0, 1)
    )
    corner, inward = solved[..., 0], solved[..., 1]
    to_a = np.maximum((corner * tangent[a]).sum(axis=1) - high[a], SLACK)
    to_b = np.maximum(low[b] - (corner * tangent[b]).sum(axis=1), SLACK)
    sharp = SHARPER ** np.minimum(flat[a] + flat[b], 30.0)
    sharp = sharp * np.minimum(to_a, to_b) / np.tan(half)
    c = corner - sharp[:, None] * inward
    behind = (c @ n.T + sharp[:, None] < (n * x).sum(axis=1) + 1e-5).all(axis=1)
    return c[behind], sharp[behind]
