"""Upright objects in closed form: signed distance and outward normal, seen from above."""

import numpy as np


def nearest_on_polygon(corners, p):
    """Signed distance from p (2,) to a convex counter-clockwise polygon (m, 2), and its normal."""
    corners, p = np.asarray(corners), np.asarray(p)
    edges = np.roll(corners, -1, axis=0) - corners
    outward = np.column_stack([edges[:, 1], -edges[:, 0]])
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    depth = ((p - corners) * outward).sum(axis=1)
    if depth.max() <= 0.0:
        return float(depth.max()), outward[depth.argmax()]
    along = ((p - corners) * edges).sum(axis=1) / (edges**2).sum(axis=1)
    away = p - (corners + np.clip(along, 0.0, 1.0)[:, None] * edges)
    distance = np.linalg.norm(away, axis=1)
    i = distance.argmin()
    return float(distance[i]), away[i] / distance[i]


def nearest_on_circle(radius, p):
    """Signed distance from p (2,) to a circle around the origin, and its outward normal."""
    r = np.linalg.norm(p)
    return float(r - radius), np.asarray(p) / r
