"""The outline of an object: arcs and straight pieces that a tip rides around."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hqp_grasp.surface.supported import MOMENT_WORTH, zero_sum

DIRECTIONS = 720  # in which the hull of discs is looked up
FIRST_WINS = 1e-8  # [m] by which a later disc must stick out to count
SHORTEST = 5e-4  # [m] of a straight piece along which contacts may be moved
GRID = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)  # [rad] where balance is tried at least
SAME_ANGLE = 1e-4  # [rad] straight pieces nearer than this to an angle have it


@dataclass(frozen=True, eq=False)
class Outline:
    """A closed convex curve, counter-clockwise, by arc length s of a tip's centre riding on it.

    Piece p begins at start[p]; a share u of it later the normal has the angle θ = angle + u·width
    and the curve is at base + radius·n(θ) + u·along. Arcs have along 0, straight pieces width 0.
    """

    frame: np.ndarray  # E (2, 3): the plane's axes, world; points of the plane are E x
    angle: np.ndarray  # (P,) [rad] of the normal where the piece begins, growing
    width: np.ndarray  # (P,) [rad]
    base: np.ndarray  # (P, 2) [m]
    radius: np.ndarray  # (P,) [m]
    along: np.ndarray  # (P, 2) [m]
    tip_radius: float  # ρ [m] that arc lengths are of
    straight: np.ndarray = field(init=False)  # (P,) [m] length of a straight piece, 0 for arcs
    start: np.ndarray = field(init=False)  # (P,) [m]
    size: np.ndarray = field(init=False)  # (P,) [m] arc length of each piece
    length: float = field(init=False)  # [m] once around

    def __post_init__(self) -> None:
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731
        put("straight", np.linalg.norm(self.along, axis=1))
        put("size", self.straight + (self.radius + self.tip_radius) * self.width)
        ends = np.cumsum(self.size)
        put("start", np.append(0.0, ends[:-1]))
        put("length", float(ends[-1]))

    @classmethod
    def around(cls, c: np.ndarray, R: np.ndarray, frame: np.ndarray, tip_radius: float) -> Outline:
        """The hull of discs with centres c (N, 2) and radii R (N,) [m]."""
        theta = np.linspace(-np.pi, np.pi, DIRECTIONS, endpoint=False)
        support = directions(theta) @ c.T + (R - FIRST_WINS * np.arange(len(R)))
        best = support.argmax(axis=1)
        change = np.flatnonzero(best != np.roll(best, 1))
        if not len(change):
            whole, one = np.array([-np.pi]), best[:1]
            turn, still = np.array([2.0 * np.pi]), np.zeros((1, 2))
            return cls(frame, whole, turn, c[one], R[one], still, tip_radius)
        # From disc a to disc b the hull passes where n(θ)·(c_a − c_b) = R_b − R_a.
        a, b = best[change - 1], best[change]
        d = c[a] - c[b]
        apart = np.linalg.norm(d, axis=1)
        cosine = np.clip((R[b] - R[a]) / np.where(apart > 0.0, apart, 1.0), -1.0, 1.0)
        bearing = np.arctan2(d[:, 1], d[:, 0])
        half = np.pi / DIRECTIONS
        middle = theta[change] - half
        off = wrapped(bearing + np.stack([1.0, -1.0])[:, None] * np.arccos(cosine) - middle)
        off = off[np.abs(off).argmin(axis=0), np.arange(len(change))]
        t = middle + np.clip(off, -half, half)
        n = directions(t)
        P = 2 * len(t)  # straight pieces and arcs in turn
        angle, width, base = np.repeat(t, 2), np.zeros(P), np.empty((P, 2))
        radius, along = np.zeros(P), np.zeros((P, 2))
        base[0::2] = c[a] + R[a, None] * n
        along[0::2] = c[b] + R[b, None] * n - base[0::2]
        width[1::2] = np.diff(np.append(t, t[0] + 2.0 * np.pi))
        base[1::2], radius[1::2] = c[b], R[b]
        return cls(frame, angle, width, base, radius, along, tip_radius)

    def at(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Angle of the normal (k,) [rad] and point of the curve (k, 2) [m] at s (k,) [m]."""
        s = s % self.length
        p = np.clip(np.searchsorted(self.start, s, side="right") - 1, 0, len(self.start) - 1)
        u = np.clip((s - self.start[p]) / np.where(self.size[p] > 0.0, self.size[p], 1.0), 0.0, 1.0)
        theta = self.angle[p] + u * self.width[p]
        along = u[:, None] * self.along[p]
        return theta, self.base[p] + self.radius[p, None] * directions(theta) + along

    def locate(self, centers: np.ndarray) -> np.ndarray:
        """s (k,) [m] where a tip with its centre at (k, 2) [m] touches, or comes nearest."""
        is_straight = self.straight > 0.0
        unit = self.along / np.where(is_straight, self.straight, 1.0)[:, None]
        begin = self.base + np.where(is_straight, self.tip_radius, 0.0)[:, None] * directions(
            self.angle
        )
        away = centers[:, None, :] - begin
        on_line = np.clip((away * unit).sum(axis=-1), 0.0, self.straight)
        half = 0.5 * self.width
        bearing = np.arctan2(away[..., 1], away[..., 0]) - self.angle
        turn = np.clip(wrapped(bearing - half) + half, 0.0, self.width)
        reach = self.radius + self.tip_radius
        on_arc = reach[:, None] * directions(self.angle + turn)
        nearest = np.where(is_straight[:, None], on_line[..., None] * unit, on_arc)
        p = np.linalg.norm(away - nearest, axis=-1).argmin(axis=1)
        k = np.arange(len(centers))
        into = np.where(is_straight[p], on_line[k, p], reach[p] * turn[k, p])
        return np.asarray(self.start[p] + into)

    def way(self, s: np.ndarray, to: np.ndarray) -> np.ndarray:
        """Signed way from s to another place, the shorter way around [m]."""
        return np.asarray((to - s + 0.5 * self.length) % self.length - 0.5 * self.length)

    def balanced(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where contacts at s (k,) could go to balance: costs (C,) [m²] and places (C, k) [m].

        Two or three unit forces point at equal angles, so that their sum is zero; of more, the
        angles are the nearest to today's of which that is true, contacts keeping their order
        around, or those of straight pieces, each contact staying on its own or going to one beside.
        What is left of the moment, and the way there, make the cost.
        """
        theta = self.at(s)[0]
        order, shift = np.argsort(s), np.empty(len(s))
        shift[order] = _zero_sum(theta[order])
        straights = np.flatnonzero(self.straight > SHORTEST)
        around = (self.angle[straights][:, None, None] - shift[:, None] + shift).reshape(-1, len(s))
        beside = self._beside(theta, self.angle[straights])
        found = [self._on_arcs(s, shift), self._on_straights(s, np.concatenate([around, beside]))]
        return np.concatenate([v[0] for v in found]), np.concatenate([v[1] for v in found])

    def _on_arcs(self, s: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Balance with every contact on an arc.

        Between two changes of any contact's arc the moment is m(θ) = Σ n(θ + shift_i) × c_i
        = A cos θ + B sin θ: its zeros there, and the middle, are tried.
        """
        arcs = np.flatnonzero(self.straight == 0.0)
        cuts = np.append((self.angle[arcs][:, None] - shift).ravel(), GRID)
        cuts = np.sort(cuts % (2.0 * np.pi))
        ends = np.append(cuts[1:], cuts[0] + 2.0 * np.pi)
        middle = 0.5 * (cuts + ends)
        piece = self._arc(arcs, middle[:, None] + shift)
        x, y = self.base[piece, 0], self.base[piece, 1]
        A = (np.cos(shift) * y - np.sin(shift) * x).sum(axis=1)
        B = (-np.sin(shift) * y - np.cos(shift) * x).sum(axis=1)
        zero = np.arctan2(-A, B)
        theta, row = [middle], [np.arange(len(middle))]
        for root in (zero, zero + np.pi):
            root = middle + wrapped(root - middle)
            inside = (root >= cuts) & (root <= ends)
            theta.append(root[inside])
            row.append(np.flatnonzero(inside))
        t, i = np.concatenate(theta), np.concatenate(row)
        piece = piece[i]
        turn = np.minimum(
            (t[:, None] + shift - self.angle[piece]) % (2.0 * np.pi), self.width[piece]
        )
        to = self.start[piece] + (self.radius[piece] + self.tip_radius) * turn
        moment = A[i] * np.cos(t) + B[i] * np.sin(t)
        return self._cost(s, to, moment)

    def _beside(self, theta: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Angles (C, k) that sum to zero, each of its nearest straight piece, or of one beside."""
        k = len(theta)
        if k <= 3 or not len(faces):
            return np.zeros((0, k))
        own = np.abs(wrapped(faces - theta[:, None])).argmin(axis=1)
        choices = np.stack(np.meshgrid(*[(-1, 0, 1)] * k), axis=-1).reshape(-1, k)
        angles = faces[(own + choices) % len(faces)]
        zero = np.abs(directions(angles).sum(axis=1)).max(axis=1) < SAME_ANGLE
        return np.asarray(angles[zero])

    def _on_straights(self, s: np.ndarray, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Balance with a contact on a straight piece, along which it balances the moment.

        `theta` (C, k) [rad] are the angles of the normals tried.
        """
        k = len(s)
        straights = np.flatnonzero(self.straight > SHORTEST)
        arcs = np.flatnonzero(self.straight == 0.0)
        if not len(theta):
            return np.zeros(0), np.zeros((0, k))
        off = np.abs(wrapped(theta[..., None] - self.angle[straights]))  # (C, k, straights)
        is_straight = off.min(axis=-1) < SAME_ANGLE
        piece = np.where(is_straight, straights[off.argmin(axis=-1)], self._arc(arcs, theta))
        turn = np.where(is_straight, 0.0, (theta - self.angle[piece]) % (2.0 * np.pi))
        low = self.start[piece] + (self.radius[piece] + self.tip_radius) * turn
        low = self.way(s, low)
        high = low + np.where(is_straight, self.straight[piece], 0.0)
        n, x = directions(theta), self.base[piece]
        at_low = (n[..., 0] * x[..., 1] - n[..., 1] * x[..., 0]).sum(axis=1)
        # Moving by λ, each as far as its piece goes, changes the moment by what was moved.
        knots = np.sort(np.concatenate([low, high, np.zeros((len(low), 1))], axis=1), axis=1)
        moved = np.clip(knots[:, :, None], low[:, None], high[:, None])
        moment = at_low[:, None] + (moved - low[:, None]).sum(axis=-1)
        i = np.clip((moment < 0.0).sum(axis=1), 1, knots.shape[1] - 1)
        row = np.arange(len(low))
        m0, m1 = moment[row, i - 1], moment[row, i]
        share = np.clip(-m0 / np.where(m1 > m0, m1 - m0, 1.0), 0.0, 1.0)
        lam = knots[row, i - 1] + share * (knots[row, i] - knots[row, i - 1])
        way = np.clip(lam[:, None], low, high)
        left = at_low + (way - low).sum(axis=1)
        return self._cost(s, s + way, left)

    def _cost(
        self, s: np.ndarray, to: np.ndarray, moment: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        way = self.way(s, to)
        cost = (way * way).sum(axis=1) + (MOMENT_WORTH * moment) ** 2
        return cost, s + way

    def _arc(self, arcs: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """The arc whose normals include the angle θ."""
        first = self.angle[arcs[0]]
        turn = (theta - first) % (2.0 * np.pi)
        return np.asarray(arcs[np.searchsorted(self.angle[arcs] - first, turn, side="right") - 1])


def _zero_sum(theta: np.ndarray) -> np.ndarray:
    """Angles (k,) [rad] of unit vectors that sum to zero, near those given, in their order around.

    Equal angles where none are near.
    """
    e = zero_sum(np.column_stack([directions(theta), np.zeros(len(theta))]))
    angle = np.arctan2(e[:, 1], e[:, 0])
    if np.abs(directions(angle).sum(axis=0)).max() > SAME_ANGLE:
        angle = 2.0 * np.pi / len(theta) * np.arange(len(theta))
    return np.asarray(angle)


def directions(theta: np.ndarray) -> np.ndarray:
    """n(θ) = (cos θ, sin θ), (…, 2)."""
    return np.stack([np.cos(theta), np.sin(theta)], axis=-1)


def wrapped(angle: np.ndarray) -> np.ndarray:
    """The same angle within [−π, π)."""
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)
