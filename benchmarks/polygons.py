"""How sure and how quick grasps are on convex polygons that nobody tuned to.

    python benchmarks/polygons.py --polygons 20 --starts 50 --seed 0
    python benchmarks/polygons.py --shapes box_6 box_8 box_10 triangle pentagon octagon --starts 80

A polygon has 5–8 sides, none under 2 cm, and holds a circle of 3–6 cm.
"""

from __future__ import annotations

import numpy as np
from grid import Runs, command, table

import hqp_grasp as hg

RUNS = Runs(50, 0)
SIDES = (5, 8)
SHORTEST = 0.02  # [m]
INRADIUS = (0.03, 0.06)  # [m]
FARTHEST = 0.10  # [m] of a corner from the middle of the largest circle inside
QUICK = 20  # probes
NAMED: dict[str, hg.Cylinder | hg.Prism] = {
    "cylinder": hg.Cylinder(0.05),
    "cylinder_65": hg.Cylinder(0.065),
    "hexagon": hg.Prism.regular(6, 0.06),
    "triangle": hg.Prism.regular(3, 0.09),
    **{f"box_{cm}": hg.Prism.regular(4, cm / 100.0) for cm in (6, 8, 10)},
    "pentagon": hg.Prism.regular(5, 0.06),
    "octagon": hg.Prism.regular(8, 0.04),
}


def polygon(rng: np.random.Generator) -> hg.Prism:
    """A random prism: three sides touch the circle inside, the others lie up to half as far out."""
    while True:
        m = int(rng.integers(SIDES[0], SIDES[1] + 1))
        angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, m))
        inradius = rng.uniform(*INRADIUS)
        out = rng.uniform(1.0, 1.5, m)
        out[rng.permutation(m)[:3]] = 1.0
        normals, h = np.column_stack([np.cos(angles), np.sin(angles)]), inradius * out
        if np.diff(angles, append=angles[0] + 2.0 * np.pi).max() >= 0.95 * np.pi:
            continue
        touching = np.sort(angles[out == 1.0])
        if np.diff(touching, append=touching[0] + 2.0 * np.pi).max() >= np.pi:
            continue  # the circle could grow
        planes = np.stack([normals, np.roll(normals, -1, axis=0)], axis=1)
        levels = np.column_stack([h, np.roll(h, -1)])
        corners = np.linalg.solve(planes, levels[:, :, None])[:, :, 0]
        sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
        inside = (corners @ normals.T <= h + 1e-9).all()
        near = np.linalg.norm(corners, axis=1).max() <= FARTHEST
        if inside and near and sides.min() >= SHORTEST:
            return hg.Prism(tuple(map(tuple, corners)))


def quick(cell: str, trial: hg.Trial, record: hg.Record) -> dict[str, float]:
    """Whether it stays balanced from probe QUICK on at the latest."""
    return {"quick": float(record.converged_at is not None and record.converged_at <= QUICK)}


def main(
    runs: Runs = RUNS,
    shapes: tuple[str, ...] = (),
    polygons: int = 20,
    probes: int = 40,
    form: str = "hierarchy",
) -> None:
    """Print for each shape how many starts are good, how the others fail, and how many probes.

    Args:
        runs: trials of each shape; the seed draws polygons too
        shapes: named shapes, in the place of random polygons
        polygons: random polygons, the i-th from SeedSequence([seed, i])
        probes: touches after the first one
        form: of the controller
    """
    objects = {name: NAMED[name] for name in shapes}
    if not shapes:
        rngs = [np.random.default_rng((runs.seed, i)) for i in range(polygons)]
        objects = {f"polygon {i}": polygon(rng) for i, rng in enumerate(rngs)}
    stack = hg.stack_of("fmk")
    cells = {
        name: hg.Trial(hg.Scene(object=thing), stack, probes, form)
        for name, thing in objects.items()
    }
    found = runs.of(cells, quick, apart=True)
    every = [end for ends in found.values() for end in ends]
    print(table(found | {"all": every}))
    print(f"\n{sum(end.figures['quick'] == 1.0 for end in every)} balanced within {QUICK} probes")


if __name__ == "__main__":
    command(main)
