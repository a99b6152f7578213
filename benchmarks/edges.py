"""Where three fingertips balance on an outline, when its faces alone do not allow it.

    python benchmarks/edges.py                      # the irregular scenario
    python benchmarks/edges.py --corners FILE

Three unit forces balance where their normals stand 120° apart. A face offers one normal; an edge,
felt by a round tip, every normal between those of its two faces, along an arc of the tip's radius.
Printed: the least ε_f on faces alone, and every triple of faces and edges that balances, each
contact with the arc, in mm of the tip's centre, on which ε_f ≤ 1e-3 N² can be had when the other
two are at their best. A contact on a face may be anywhere on it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np
import tyro
from hqp_grasp.scenarios.irregular import CORNERS

from hqp_grasp.experiments.record import CONVERGED_FORCE
from hqp_grasp.world.objects import read_corners

TIP = 8.0  # [mm] radius of the BarrettHand's fingertips here
STEP = 1e-3  # [rad] of normals tried along an edge's arc
SWEEPS = 40  # in which two contacts find their best, each in turn


@dataclass(frozen=True)
class Spot:
    """A face or an edge, and the directions of its normals."""

    name: str
    low: float  # [rad]
    width: float  # [rad], 0 for a face

    def clipped(self, angle: np.ndarray) -> np.ndarray:
        """The directions of this spot that are nearest to `angle`."""
        middle = self.low + self.width / 2.0
        away = (angle - middle + np.pi) % (2.0 * np.pi) - np.pi
        return middle + np.clip(away, -self.width / 2.0, self.width / 2.0)


def spots(corners: np.ndarray) -> tuple[list[Spot], list[Spot]]:
    """Faces, face i from corner i on, and edges, edge i at corner i."""
    sides = np.roll(corners, -1, axis=0) - corners
    normals = np.arctan2(-sides[:, 0], sides[:, 1])
    before = np.roll(normals, 1)
    faces = [Spot(f"face {i}", n, 0.0) for i, n in enumerate(normals, 1)]
    arcs = zip(before, (normals - before) % (2.0 * np.pi), strict=True)
    return faces, [Spot(f"edge {i}", low, width) for i, (low, width) in enumerate(arcs, 1)]


def force(angles: np.ndarray) -> np.ndarray:
    """ε_f [N²] of unit forces along directions (…, 3)."""
    return np.cos(angles).sum(axis=-1) ** 2 + np.sin(angles).sum(axis=-1) ** 2


def least_force(triple: tuple[Spot, ...], first: np.ndarray) -> np.ndarray:
    """Least ε_f (s,) with the first contact at directions (s,), the others where they like."""
    best = np.full(len(first), np.inf)
    for side in (1.0, -1.0):
        angles = np.array([first, *(first + side * turn for turn in (2.0944, -2.0944))])
        for _ in range(SWEEPS):
            for i in (1, 2):
                rest = np.delete(angles, i, axis=0)
                against = np.arctan2(-np.sin(rest).sum(axis=0), -np.cos(rest).sum(axis=0))
                angles[i] = triple[i].clipped(against)
        best = np.minimum(best, force(angles.T))
    return best


def allowed(triple: tuple[Spot, ...], i: int) -> float:
    """Share of contact i's normals that balance with the other two at their best."""
    spot = triple[i]
    others = (other for j, other in enumerate(triple) if j != i)
    count = max(1, round(spot.width / STEP))
    tried = spot.low + spot.width * (np.arange(count) + 0.5) / count
    return float((least_force((spot, *others), tried) <= CONVERGED_FORCE).mean())


def main(corners: Path | None = None) -> None:
    """Print what balances."""
    outline = read_corners(corners) if corners else np.array(CORNERS)
    faces, edges = spots(outline)
    for corner, face in zip(outline, faces, strict=True):
        x, y = 1e3 * corner
        print(f"corner ({x:6.1f}, {y:6.1f}) mm, then {face.name} at {np.degrees(face.low):6.1f}°")
    triples = list(combinations_with_replacement(faces, 3))
    values = force(np.array([[spot.low for spot in triple] for triple in triples]))
    least = int(values.argmin())
    names = ", ".join(spot.name for spot in triples[least])
    print(f"\nleast ε_f on faces alone {values[least]:.2g} N²: {names}\n")
    print(f"balanced, ε_f ≤ {CONVERGED_FORCE:g} N², and the arc for each contact")
    for triple in combinations_with_replacement([*faces, *edges], 3):
        shares = [allowed(triple, i) for i in range(3)]
        if all(shares):
            told = (
                f"{spot.name} {f'{share * TIP * spot.width:.2f} mm' if spot.width else 'anywhere'}"
                for spot, share in zip(triple, shares, strict=True)
            )
            print("  " + ", ".join(told))


if __name__ == "__main__":
    tyro.cli(main)
