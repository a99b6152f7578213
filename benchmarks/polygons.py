"""How sure and how quick grasps are on convex polygons that nobody tuned to.

    python benchmarks/polygons.py --polygons 20 --starts 50 --seed 0
    python benchmarks/polygons.py --shapes box_6 box_8 box_10 triangle pentagon octagon --starts 80

A polygon has 5–8 sides, none under 2 cm, and holds a circle of 3–6 cm. "Good" is good in every
respect: balanced to the last probe, never a link inside, no limit violated, no error.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
import tyro
from tqdm import tqdm

import hqp_grasp as hg
from hqp_grasp.experiments.executor import run_all

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


@dataclass(frozen=True)
class Work:
    """The trials of each object, one after the other."""

    objects: tuple[hg.Cylinder | hg.Prism, ...]
    trials: int
    probes: int
    seed: int
    form: str

    def __call__(self, number: int) -> tuple[str, int | None]:
        """Verdict, and the probe from which it stays balanced."""
        s, i = divmod(number, self.trials)
        scene = hg.Scene(object=self.objects[s])
        trial = hg.Trial(scene, hg.stack_of("fmk"), self.probes, self.form)
        record = trial.attempt((self.seed, s, i))
        return record.verdict, record.converged_at


def main(
    shapes: tuple[str, ...] = (),
    polygons: int = 20,
    starts: int = 50,
    probes: int = 40,
    seed: int = 0,
    form: str = "hierarchy",
    jobs: int = 2,
) -> None:
    """Print for each shape how many starts are good, how the others fail, and how many probes.

    Args:
        shapes: named shapes, in the place of random polygons
        polygons: random polygons, the i-th from SeedSequence([seed, i])
        starts: of each shape
        probes: touches after the first one
        seed: of polygons and starts
        form: of the controller
        jobs: processes
    """
    objects = {name: NAMED[name] for name in shapes}
    if not shapes:
        rngs = [np.random.default_rng((seed, i)) for i in range(polygons)]
        objects = {f"polygon {i}": polygon(rng) for i, rng in enumerate(rngs)}
    work = Work(tuple(objects.values()), starts, probes, seed, form)
    numbers = range(len(objects) * starts)
    done = dict(tqdm(run_all(work, numbers, jobs), total=len(numbers)))
    print(f"{'':14}{'good':>12}{'median':>8}{'p99':>6}{'worst':>7}{f'≤ {QUICK}':>7}  failures")
    for s, name in enumerate(objects):
        print(line(name, [done[s * starts + i] for i in range(starts)]))
    print(line("all", list(done.values())))


def line(name: str, ends: list[tuple[str, int | None]]) -> str:
    """One row of the table."""
    kinds = Counter(end for end, _ in ends)
    good = kinds.pop("good", 0)
    settled = [probe for _, probe in ends if probe is not None]
    figures = "".join(f"{'–':>{w}}" for w in (8, 6, 7, 7))
    if settled:
        middle, high = np.percentile(settled, [50, 99])
        quick = sum(probe <= QUICK for probe in settled)
        figures = f"{middle:8.1f}{high:6.0f}{max(settled):7}{quick:7}"
    failures = ", ".join(f"{count} {end}" for end, count in kinds.items())
    return f"{name:14}{f'{good} of {len(ends)}':>12}{figures}  {failures}"


if __name__ == "__main__":
    tyro.cli(main)
