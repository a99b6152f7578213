"""The surface felt as walls along an axis, as a prism has them: an outline, and end faces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hqp_grasp.grasp import Grasp
from hqp_grasp.surface.felt import LEANING, SAME_NORMAL, SLACK, Felt
from hqp_grasp.surface.outline import Outline, directions
from hqp_grasp.surface.surface import distinct, unit

FLATTEST = 1e-3  # [–] of normals, below which lifting contacts leaves their moment as it is
SHARPER = 0.6  # [–] radius that each further touch of a face leaves of its corners
FLAT = 1e-3  # [m] a face is known to be flat where it was felt so far apart


@dataclass(frozen=True, eq=False)
class Walls:
    """The hull of the largest balls behind all planes felt, seen along an axis.

    It is exact on cylinders from the first grasp, flat between points of one face, sharp at an edge
    felt beside its face, and elsewhere as round as what was felt allows.
    """

    felt: Felt
    axis: np.ndarray  # a (3,), across which the outline lies
    outline: Outline

    @classmethod
    def of(cls, felt: Felt, axis: np.ndarray, tip_radius: float) -> Walls:
        """The outline from normals across the axis, of which there are some, around all points.

        `tip_radius` [m] is that of the tips whose centres ride on it.
        """
        across = np.abs(felt.normals @ axis) < LEANING
        first = np.eye(3)[np.abs(axis).argmin()]
        first = first - (first @ axis) * axis
        first /= np.linalg.norm(first)
        frame = np.array([first, np.cross(axis, first)])
        x, R = felt.positions[across] @ frame.T, felt.radii[across]
        n = felt.normals[across] @ frame.T
        n /= np.linalg.norm(n, axis=1)[:, None]
        t = np.arctan2(n[:, 1], n[:, 0])
        corners, sharp = _corners(x, n, t)
        within = felt.positions[~across] @ frame.T  # of end faces and their rims
        c = np.concatenate([x - R[:, None] * n, corners, within])
        R = np.concatenate([R, sharp, np.zeros(len(within))])
        return cls(felt, axis, Outline.around(c, R, frame, tip_radius))

    def turn(self, grasp: Grasp) -> np.ndarray:
        """∂n_i/∂c_i (k, 3, 3) [1/m]: around the axis as the nearest ball felt, not along it."""
        radius = self._radii(grasp) + self.outline.tip_radius
        around = np.cross(self.axis, grasp.normals)
        blocks = around[:, :, None] * around[:, None]
        return np.asarray(blocks / np.maximum(radius, SLACK)[:, None, None])

    def _radii(self, grasp: Grasp) -> np.ndarray:
        """Of the balls of the nearest points felt (k,) [m]."""
        away = np.linalg.norm(grasp.positions[:, None] - self.felt.positions, axis=2)
        return np.asarray(self.felt.radii[away.argmin(axis=1)])

    def reach(self, u: np.ndarray) -> np.ndarray:
        """As far (m,) [m] along u (m, 3) as was felt: where walls end is not known."""
        return np.asarray((u @ self.felt.positions.T).max(axis=1))

    def ways(self, grasp: Grasp) -> list[WayAround]:
        """Ways around the outline that differ, the cheapest first.

        Where a tip that is no ball touches with an edge of its own, its normal leans, and it
        belongs at the height of its ball's middle. From there heights z_i change by the least that
        makes Σ z_i n_i vanish, as the moment of forces across the axis does: two or three forces
        balance at one height only, of more there is a choice.
        """
        s = self.outline.locate(grasp.centers @ self.outline.frame.T)
        cost, places = self.outline.balanced(s)
        middles = grasp.positions - self._radii(grasp)[:, None] * grasp.normals
        balls = np.array([contact.stretch is None for contact in grasp.contacts])
        own, ways = np.where(balls[:, None], grasp.centers, middles) @ self.axis, []
        for i in distinct(cost, places[:, :, None]):
            n = directions(self.outline.at(places[i])[0]).T
            height = own - np.linalg.pinv(n, rcond=FLATTEST) @ (n @ own)
            ways.append(WayAround(self, grasp, s, places[i], height, float(cost[i])))
        return ways


@dataclass(frozen=True, eq=False)
class WayAround:
    """Along the outline, where the normal turns as the outline does, and to other heights."""

    walls: Walls
    grasp: Grasp
    s: np.ndarray  # (k,) [m] where on the outline contacts are
    places: np.ndarray  # (k,) [m] where they should be
    height: np.ndarray  # (k,) [m] along the axis, where they should be
    cost: float  # [m²]

    def at(self, share: float) -> tuple[np.ndarray, np.ndarray]:
        """The tips' centres (k, 3) [m] and the normals (k, 3) after a share of the way, world."""
        outline, a = self.walls.outline, self.walls.axis
        n, c, E = self.grasp.normals, self.grasp.centers, outline.frame
        rho = np.array([[contact.tip_radius] for contact in self.grasp.contacts])
        (t0, x0), (t1, x1) = outline.at(self.s), outline.at(self.s + share * (self.places - self.s))
        cos, sin = np.cos(t1 - t0)[:, None], np.sin(t1 - t0)[:, None]
        side = n @ E.T
        turned = cos * side + sin * np.column_stack([-side[:, 1], side[:, 0]])
        after = unit(turned @ E + (1.0 - share) * np.outer(n @ a, a))
        across = x1 - x0 + rho * ((after - n) @ E.T)
        return c + across @ E + np.outer(share * (self.height - c @ a), a), after


def _corners(x: np.ndarray, n: np.ndarray, felt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Discs (c, R) in the corners of faces and their neighbours, be those faces or edges.

    The largest that fits has R = min(d_a, d_b)/tan(half the turn), with d the way from the last
    point felt to the corner; the more often a face was found flat, the smaller it is taken to be.
    """
    order = np.argsort(felt)
    turn = np.diff(felt[order], append=felt[order[0]] + 2.0 * np.pi)
    same = np.sqrt(2.0 * SAME_NORMAL)  # [rad]
    last = np.flatnonzero(turn > same)  # of each group of equal normals
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
    flat = np.where(high - low > FLAT, np.bincount(group, minlength=G) - 1.0, 0.0)
    a, b = np.arange(G), (np.arange(G) + 1) % G
    a = a[(turn[last] < np.pi - same) & (flat[a] + flat[b] > 0.0)]
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
