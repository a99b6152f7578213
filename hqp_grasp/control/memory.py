"""What has been felt of the object, as a surface that predicts what has not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hqp_grasp.errors import InputError
from hqp_grasp.grasp import Grasp, Touch

CONTRADICTION = 2e-4  # [m] by which an older point may lie beyond what a newer touch allows
SLACK = 2e-6  # [m] of rounding in what was felt
SAME_NORMAL = 2e-4  # [–] 1 − n·n' below which two normals (1.1°) tell nothing of curvature
UPRIGHT = 0.3  # [–] part of a normal along the axis, above which it is not part of an outline
WIDEST = 2.0  # [–] times the prior radius: no ball is larger
ANGLES = 720  # directions in which the outline is looked up
EDGE = 1e-3  # [m] of radius, below which a point is on an edge
FLATNESS = 2.0  # [–] how fast corners are taken to be sharper where faces are known to be flat
MOST_TURN = 2.4  # [rad] between neighbouring faces that meet in a corner
EDGE_TURN = 0.5  # [–] share of the angle left, by which an edge is taken to turn on
UNKNOWN_COST = 0.5  # [–] m of way that 1 m of arc between felt points is worth
MOMENT_COST = 50.0  # [–] m of way that 1 m (N·m per N) of moment left is worth


@dataclass(frozen=True, eq=False)
class SurfaceMemory:
    """Every contact felt, by any finger, and the simplest surface through all of them.

    Each contact says that the object, being convex, lies behind its tangent plane. The largest ball
    that touches the surface there from inside, and stays behind every plane felt, has the radius
    R_j = min_k n_k·(x_k − x_j)/(1 − n_k·n_j). The surface predicted is the hull of these balls: exact
    on a cylinder or sphere from the first grasp, flat between two points of a face, sharp at an edge
    felt beside its face, and round in between, as round as what was felt allows.
    """

    positions: np.ndarray  # x (N, 3) [m], world
    normals: np.ndarray  # n (N, 3) outward, world
    probes: np.ndarray  # (N,) index of the touch that felt the point
    radii: np.ndarray  # R (N,) [m]

    @classmethod
    def of(cls, history: Sequence[Touch], radius: float = 0.05) -> SurfaceMemory:
        """All that the hits of a history felt and no later one contradicts.

        `radius` [m] is that of the object where nothing felt says so.
        """
        felt = [
            (contact.position, contact.normal, probe)
            for probe, touch in enumerate(history)
            if isinstance(touch.felt, Grasp)
            for contact in touch.felt.contacts
        ]
        if not felt:
            raise InputError("nothing has been felt yet: a memory begins with the first grasp")
        x = np.array([v[0] for v in felt])
        n = np.array([v[1] for v in felt])
        probes = np.array([v[2] for v in felt])
        h = (n * x).sum(axis=1)
        beyond = n @ x.T - h[:, None]  # [j, k] how far point k lies beyond the plane of j
        newer = probes[None, :] > probes[:, None]
        contradicted = newer & (np.maximum(beyond, beyond.T) > CONTRADICTION)
        kept = ~contradicted.any(axis=1)
        x, n, probes, h = x[kept], n[kept], probes[kept], h[kept]
        return cls(x, n, probes, _radii(x, n, WIDEST * radius))

    def axis(self, grasp: Grasp) -> np.ndarray:
        """The direction (3,) along which the surface felt does not turn, as far as it was felt.

        Where several are, the one that the tips of `grasp` lie least along.
        """
        p = grasp.positions
        p = p - p.mean(axis=0)
        early = 0.5 ** (self.probes - self.probes.min())
        M = (early[:, None] * self.normals).T @ self.normals / early.sum()
        tips = 1e-3 * (p.T @ p) / max(float((p * p).sum()), 1e-12)
        M = M + tips
        for _ in range(2):
            a = np.linalg.eigh(M)[1][:, 0]
            flat = self.normals[np.abs(self.normals @ a) < UPRIGHT]
            if len(flat) < 2:
                break
            M = flat.T @ flat / len(flat) + tips
        return a if a[np.argmax(np.abs(a))] > 0.0 else -a

    def outline(self, axis: np.ndarray, tip_radius: float) -> Outline:
        """The surface seen along `axis`, from where its normals are at right angles to it."""
        beside = np.abs(self.normals @ axis) < UPRIGHT
        e1 = np.eye(3)[np.argmin(np.abs(axis))]
        e1 = e1 - (e1 @ axis) * axis
        e1 /= np.linalg.norm(e1)
        E = np.array([e1, np.cross(axis, e1)])
        x, n = self.positions[beside] @ E.T, self.normals[beside] @ E.T
        n = n / np.linalg.norm(n, axis=1)[:, None]
        R = np.minimum(self.radii[beside], _continued(x, n, self.radii[beside]))
        felt = np.arctan2(n[:, 1], n[:, 0])
        c = x - R[:, None] * n
        corners, sharp = _corners(x, n, self.radii[beside], felt)
        c, R = np.concatenate([c, corners]), np.concatenate([R, sharp])
        return Outline.around(c, R, E, tip_radius, felt)


def _corners(
    x: np.ndarray, n: np.ndarray, R: np.ndarray, felt: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Discs between neighbouring faces: the longer a face is known to be flat, the smaller."""
    order = np.argsort(felt)
    turn = np.append(np.diff(felt[order]), felt[order[0]] + 2.0 * np.pi - felt[order[-1]])
    same = np.sqrt(2.0 * SAME_NORMAL)
    starts = np.flatnonzero(turn > same)  # order[starts] is the last of its group
    if len(starts) < 2:
        return np.zeros((0, 2)), np.zeros(0)
    group = np.zeros(len(felt), dtype=int)
    group[order] = np.searchsorted(starts, np.arange(len(felt))) % len(starts)
    G = len(starts)
    lead = order[starts]
    t = np.column_stack([-n[lead, 1], n[lead, 0]])
    along = (x * t[group]).sum(axis=1)
    low, high = np.full(G, np.inf), np.full(G, -np.inf)
    np.minimum.at(low, group, along)
    np.maximum.at(high, group, along)
    edge = np.zeros(G, dtype=bool)
    np.logical_or.at(edge, group, R < EDGE)
    flat = high - low
    h = (n[lead] * x[lead]).sum(axis=1)
    a, b = np.arange(G), (np.arange(G) + 1) % G
    ends = turn[starts]
    good = (ends < MOST_TURN) & ~edge[a] & ~edge[b] & (flat[a] + flat[b] > 2e-3)
    a, b = a[good], b[good]
    if not len(a):
        return np.zeros((0, 2)), np.zeros(0)
    na, nb = n[lead[a]], n[lead[b]]
    det = na[:, 0] * nb[:, 1] - na[:, 1] * nb[:, 0]
    solve = lambda u, v: np.column_stack([u * nb[:, 1] - v * na[:, 1], v * na[:, 0] - u * nb[:, 0]]) / det[:, None]  # noqa: E731
    corner = solve(h[a], h[b])
    inward = solve(np.ones(len(a)), np.ones(len(a)))
    da = np.maximum((corner * t[a]).sum(axis=1) - high[a], 0.0)
    db = np.maximum(low[b] - (corner * t[b]).sum(axis=1), 0.0)
    half = np.tan(0.5 * ends[good])
    most = np.minimum(da, db) / half
    sharp = most * (da / (da + FLATNESS * flat[a] + 1e-9)) * (db / (db + FLATNESS * flat[b] + 1e-9))
    c = corner - sharp[:, None] * inward
    ok = (c @ n.T + sharp[:, None] <= (n * x).sum(axis=1) + 1e-5).all(axis=1)
    return c[ok], sharp[ok]


def _continued(x: np.ndarray, n: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Radii bounded by the guess that an edge goes on turning, half as far as it may."""
    edge = np.flatnonzero(R < EDGE)
    if not len(edge):
        return R
    d = x[None] - x[edge][:, None]  # (E, N, 2)
    bearing = np.arctan2(d[..., 1], d[..., 0]) - np.arctan2(n[edge, 1], n[edge, 0])[:, None]
    bearing = np.where(np.linalg.norm(d, axis=-1) > EDGE, bearing % (2.0 * np.pi), np.pi)
    left = np.maximum(bearing.min(axis=1) - 0.5 * np.pi, 0.0)
    right = np.maximum(1.5 * np.pi - bearing.max(axis=1), 0.0)
    turn = EDGE_TURN * np.concatenate([left, -right])
    c, s = np.cos(turn), np.sin(turn)
    m = np.concatenate([n[edge], n[edge]])
    v = np.column_stack([c * m[:, 0] - s * m[:, 1], s * m[:, 0] + c * m[:, 1]])
    at = np.concatenate([x[edge], x[edge]])
    return _radii(x, n, np.inf, at, v)


def _radii(
    x: np.ndarray,
    n: np.ndarray,
    widest: float,
    at: np.ndarray | None = None,
    v: np.ndarray | None = None,
) -> np.ndarray:
    """The largest balls that touch at x with normals n from inside, behind the planes (at, v)."""
    at, v = (x, n) if at is None else (at, v)
    turn = 1.0 - v @ n.T
    gap = (v * at).sum(axis=1)[:, None] - v @ x.T  # [k, j] of point j to the plane of k
    tells = turn > SAME_NORMAL
    bound = np.where(tells, np.maximum(gap, 0.0) + SLACK, widest) / np.where(tells, turn, 1.0)
    return np.minimum(bound.min(axis=0), widest)


@dataclass(frozen=True, eq=False)
class Outline:
    """A closed convex curve of arcs and straight pieces, by arc length of a tip's centre on it."""

    frame: np.ndarray  # E (2, 3): two directions in the plane, world
    start: np.ndarray  # (S,) [m] arc length at which each piece begins
    angle: np.ndarray  # (S, 2) [rad] of the normal at both ends, growing
    center: np.ndarray  # (S, 2) [m] c of an arc x = c + R n; of a straight piece, its begin − R n
    radius: np.ndarray  # (S,) [m]
    along: np.ndarray  # (S, 2) [m] from begin to end of a straight piece, 0 for arcs
    length: float  # [m] once around
    tip_radius: float  # [m] that arc lengths are of
    felt: np.ndarray  # [rad] normals felt

    @classmethod
    def around(
        cls, c: np.ndarray, R: np.ndarray, E: np.ndarray, tip_radius: float, felt: np.ndarray
    ) -> Outline:
        """The hull of discs (c, R)."""
        theta = np.linspace(-np.pi, np.pi, ANGLES, endpoint=False)
        support = np.column_stack([np.cos(theta), np.sin(theta)]) @ c.T + R
        # Where two discs are as good as one, keep to the first.
        support -= 1e-8 * np.arange(len(R))
        best = support.argmax(axis=1)
        change = np.flatnonzero(best != np.roll(best, 1))
        if not len(change):
            angle = np.array([[-np.pi, np.pi]])
            return cls._joined(angle, c[best[:1]], R[best[:1]], np.zeros((1, 2)), E, tip_radius, felt)
        before, after = best[change - 1], best[change]
        # n(t)·(c_a − c_b) = R_b − R_a where the hull passes from disc a to disc b.
        d = c[before] - c[after]
        far = np.linalg.norm(d, axis=1)
        ratio = np.clip((R[after] - R[before]) / np.where(far > 0.0, far, 1.0), -1.0, 1.0)
        bearing = np.arctan2(d[:, 1], d[:, 0])
        middle = theta[change] - np.pi / ANGLES
        t = np.stack([bearing + np.arccos(ratio), bearing - np.arccos(ratio)])
        off = (t - middle + np.pi) % (2.0 * np.pi) - np.pi
        off = off[np.abs(off).argmin(axis=0), np.arange(len(change))]
        t = middle + np.clip(off, -np.pi / ANGLES, np.pi / ANGLES)
        n = np.column_stack([np.cos(t), np.sin(t)])
        begin, end = c[before] + R[before, None] * n, c[after] + R[after, None] * n
        following = np.append(t[1:], t[0] + 2.0 * np.pi)
        S = len(t)
        angle = np.empty((2 * S, 2))
        angle[0::2] = t[:, None]
        angle[1::2, 0], angle[1::2, 1] = t, following
        center, radius, along = np.empty((2 * S, 2)), np.empty(2 * S), np.zeros((2 * S, 2))
        center[0::2], radius[0::2], along[0::2] = begin, 0.0, end - begin
        center[1::2], radius[1::2] = c[after], R[after]
        return cls._joined(angle, center, radius, along, E, tip_radius, felt)

    @classmethod
    def _joined(
        cls,
        angle: np.ndarray,
        center: np.ndarray,
        radius: np.ndarray,
        along: np.ndarray,
        E: np.ndarray,
        rho: float,
        felt: np.ndarray,
    ) -> Outline:
        lengths = np.linalg.norm(along, axis=1) + (radius + rho) * (angle[:, 1] - angle[:, 0])
        ends = np.cumsum(lengths)
        start = np.concatenate([[0.0], ends[:-1]])
        return cls(E, start, angle, center, radius, along, float(ends[-1]), rho, np.sort(felt))

    def at(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Angle of the normal (k,) [rad] and point of the surface (k, 2) [m] at arc lengths s (k,)."""
        s = np.asarray(s) % self.length
        i = np.clip(np.searchsorted(self.start, s, side="right") - 1, 0, len(self.start) - 1)
        straight = np.linalg.norm(self.along[i], axis=1)
        whole = straight + (self.radius[i] + self.tip_radius) * (self.angle[i, 1] - self.angle[i, 0])
        share = np.clip((s - self.start[i]) / np.where(whole > 0.0, whole, 1.0), 0.0, 1.0)
        t = self.angle[i, 0] + share * (self.angle[i, 1] - self.angle[i, 0])
        n = np.column_stack([np.cos(t), np.sin(t)])
        return t, self.center[i] + self.radius[i, None] * n + share[:, None] * self.along[i]

    def locate(self, p: np.ndarray) -> np.ndarray:
        """Arc lengths (k,) of the points nearest to tip centres p (k, 2)."""
        n0 = np.column_stack([np.cos(self.angle[:, 0]), np.sin(self.angle[:, 0])])
        straight = np.linalg.norm(self.along, axis=1)
        is_straight = straight > 0.0
        unit = self.along / np.where(is_straight, straight, 1.0)[:, None]
        reach = self.radius + self.tip_radius
        away = p[:, None, :] - self.center - np.where(is_straight, self.tip_radius, 0.0)[:, None] * n0
        width = self.angle[:, 1] - self.angle[:, 0]
        bearing = np.arctan2(away[:, :, 1], away[:, :, 0]) - self.angle[:, 0]
        half = 0.5 * width
        turn = np.clip((bearing - half + np.pi) % (2.0 * np.pi) - np.pi + half, 0.0, width)
        t = self.angle[:, 0] + turn
        on_arc = np.stack([np.cos(t), np.sin(t)], axis=-1) * reach[:, None]
        u = np.clip((away * unit).sum(axis=-1), 0.0, straight)
        nearest = np.where(is_straight[:, None], u[:, :, None] * unit, on_arc)
        i = np.linalg.norm(away - nearest, axis=-1).argmin(axis=1)
        k = np.arange(len(p))
        return np.where(is_straight[i], self.start[i] + u[k, i], self.start[i] + reach[i] * turn[k, i])

    def balanced(self, s: np.ndarray) -> list[tuple[float, np.ndarray]]:
        """Every place (k,) where k forces at equal angles balance, near places s (k,) first.

        k = 2 or 3, s in the order of the contacts. Each with its cost [m²].
        """
        k = len(s)
        order = np.argsort(s)
        if k == 3 and ((order == [0, 2, 1]).all() or (order == [1, 0, 2]).all() or (order == [2, 1, 0]).all()):
            slots = np.array([0, 2, 1])  # finger i takes the slot slots[i], counter-clockwise
        else:
            slots = np.arange(k)
        shift = 2.0 * np.pi * slots / k
        arcs = np.flatnonzero((self.along == 0.0).all(axis=1))
        first = self.angle[0, 0]
        breaks = np.concatenate([self.angle[arcs, 0][:, None] - shift, ]).ravel()
        grid = first + np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
        cuts = np.sort((np.concatenate([breaks, grid]) - first) % (2.0 * np.pi)) + first
        ends = np.append(cuts[1:], cuts[0] + 2.0 * np.pi)
        middle = 0.5 * (cuts + ends)
        which = self._arc(arcs, middle[:, None] + shift)  # (I, k) pieces
        c = self.center[which]
        # m(t) = Σ n(t + shift) × c = A cos t + B sin t on each interval
        cos, sin = np.cos(shift), np.sin(shift)
        A = (c[..., 1] * cos - c[..., 0] * sin).sum(axis=1)
        B = (-c[..., 1] * sin - c[..., 0] * cos).sum(axis=1)
        root = np.arctan2(-A, B)
        candidates = [middle]
        rows = [np.arange(len(middle))]
        for turn in (0.0, np.pi):
            t = root + turn
            t = middle + (t - middle + np.pi) % (2.0 * np.pi) - np.pi
            inside = (t >= cuts) & (t <= ends)
            candidates.append(t[inside])
            rows.append(np.flatnonzero(inside))
        t = np.concatenate(candidates)
        i = np.concatenate(rows)
        pieces = which[i]
        turned = t[:, None] + shift
        w = self.angle[pieces, 0]
        turned = w + (turned - w) % (2.0 * np.pi)
        places = self.start[pieces] + (self.radius[pieces] + self.tip_radius) * np.minimum(turned - w, self.angle[pieces, 1] - w)
        m = A[i] * np.cos(t) + B[i] * np.sin(t)
        way = self.way(s, places)
        unknown = self.unknown(pieces, turned)
        cost = (way * way + (UNKNOWN_COST * unknown) ** 2).sum(axis=1) + (MOMENT_COST * m) ** 2
        found = [(float(v), s + d) for v, d in zip(cost, way, strict=True)]
        straight = np.linalg.norm(self.along, axis=1)
        for piece in np.flatnonzero(straight > 1e-4):
            for slot in range(k):
                found.append(self._on_straight(s, shift, slot, piece, straight, arcs))
        return sorted(found, key=lambda v: v[0])

    def _on_straight(self, s, shift, slot, piece, straight, arcs):
        t = self.angle[piece, 0] + shift - shift[slot]
        lo, hi, m0, unknown = np.empty(len(s)), np.empty(len(s)), 0.0, 0.0
        pieces = self._arc(arcs, t)
        for i in range(len(s)):
            near = np.abs((self.angle[:, 0] - t[i] + np.pi) % (2.0 * np.pi) - np.pi) < 1e-4
            near &= straight > 1e-4
            j = piece if i == slot else (np.flatnonzero(near)[0] if near.any() else -1)
            if j >= 0:
                lo[i], hi[i] = self.start[j], self.start[j] + straight[j]
                x, angle = self.center[j], self.angle[j, 0]
            else:
                j = pieces[i]
                angle = t[i]
                lo[i] = hi[i] = self.start[j] + (self.radius[j] + self.tip_radius) * ((t[i] - self.angle[j, 0]) % (2.0 * np.pi))
                x = self.center[j]
                unknown += float(self.unknown(np.array([j]), np.array([angle]))[0]) ** 2
            m0 += np.cos(angle) * x[1] - np.sin(angle) * x[0]
        near_lo = s + self.way(s, lo)
        hi = near_lo + (hi - lo)
        knots = np.sort(np.concatenate([near_lo - s, hi - s, [0.0]]))
        moment = m0 + (np.clip(s + knots[:, None], near_lo, hi) - near_lo).sum(axis=1)
        shifted = np.interp(0.0, moment, knots)
        goal = np.clip(s + shifted, near_lo, hi)
        m = m0 + (goal - near_lo).sum()
        return float(((goal - s) ** 2).sum() + (MOMENT_COST * m) ** 2 + UNKNOWN_COST**2 * unknown), goal

    def _arc(self, arcs: np.ndarray, t: np.ndarray) -> np.ndarray:
        """The arc (…,) whose normals include the angle t (…,)."""
        first = self.angle[arcs[0], 0]
        i = np.searchsorted(self.angle[arcs, 0], first + (t - first) % (2.0 * np.pi), side="right") - 1
        return arcs[np.clip(i, 0, len(arcs) - 1)]

    def unknown(self, pieces: np.ndarray, t: np.ndarray) -> np.ndarray:
        """How long the arc is between the felt normals on either side of the angle t [m]."""
        i = np.searchsorted(self.felt, (t + np.pi) % (2.0 * np.pi) - np.pi)
        width = (self.felt[i % len(self.felt)] - self.felt[i - 1]) % (2.0 * np.pi)
        return self.radius[pieces] * width

    def way(self, s: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Signed way from s to places, the shorter way around."""
        half = 0.5 * self.length
        return (places - s + half) % self.length - half
