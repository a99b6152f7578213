"""How sure and how quick grasps are on convex polygons that nobody tuned to.

    python benchmarks/polygons.py --polygons 20 --starts 50 --seed 0
    python benchmarks/polygons.py --shapes cylinder hexagon --starts 200 --seed 0

A polygon has 5–8 sides, none under 2 cm, and holds a circle of 3–6 cm. "Good" is good in every
respect: balanced to the last probe, never a link inside, no limit violated, no error.
"""

from __future__ import annotations

from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
import tyro

import hqp_grasp as hg
from hqp_grasp.grasp import Contact, Grasp, Missed
from hqp_grasp.touch.geometric import GeometricProbe

SIDES = (5, 8)
SHORTEST = 0.02  # [m]
INRADIUS = (0.03, 0.06)  # [m]
FARTHEST = 0.10  # [m] of a corner from the middle of the largest circle inside
QUICK = 20  # probes
NOISY_FORCE, NOISY_MOMENT = 5e-3, 4e-3  # [N²], [N·m] true errors that count under noise
NAMED: dict[str, hg.Cylinder | hg.Prism] = {
    "cylinder": hg.Cylinder(0.05),
    "cylinder_65": hg.Cylinder(0.065),
    "hexagon": hg.Prism.regular(6, 0.06),
    **{f"box_{cm}": hg.Prism.regular(4, cm / 100.0) for cm in (6, 8, 10)},
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


@dataclass
class NoisyProbe:
    """A probe whose positions and normals are off by independent Gaussian noise."""

    probe: GeometricProbe
    rng: np.random.Generator
    position: float  # [m] standard deviation on each axis
    normal: float  # [–] the same
    last: Grasp | Missed | None = None  # what is, where the answer was what is felt

    def felt(self, true: Grasp) -> Grasp:
        """What is felt of a grasp."""
        contacts = []
        for c in true.contacts:
            n = c.normal + self.normal * self.rng.normal(size=3)
            x = c.position + self.position * self.rng.normal(size=3)
            contacts.append(Contact(x, n / np.linalg.norm(n)))
        return self.probe.scene.articulated.grasp(true.q, contacts, true.other_links)

    def touch(self, q_target: np.ndarray) -> Grasp | Missed:
        """Touch, and feel it with noise."""
        self.last = self.probe.touch(q_target)
        return self.felt(self.last) if isinstance(self.last, Grasp) else self.last


def start(
    scene: hg.Scene, form: str, probes: int, noise: bool, entropy: tuple[int, ...]
) -> tuple[str, int | None]:
    """How the trial from one start ended, and when it was balanced for good."""
    trial = hg.Trial(scene, hg.stack_of("fmk"), probes, form)
    if not noise:
        record = trial.attempt(entropy)
        return record.verdict, record.converged_at
    first = trial.start.draw(scene, GeometricProbe, np.random.default_rng(entropy)).grasp  # type: ignore[union-attr]
    probe = NoisyProbe(GeometricProbe(scene), np.random.default_rng((*entropy, 1)), 5e-4, 0.02)
    noisy = hg.Trial(scene, trial.stack, probes, form, start=probe.felt(first))
    record = noisy.attempt(entropy, probe)
    if record.error is not None or not isinstance(probe.last, Grasp):
        return "error" if record.error is not None else "lost", None
    balanced = (
        hg.ForceTask().potential(probe.last) <= NOISY_FORCE
        and np.sqrt(hg.MomentTask().potential(probe.last)) <= NOISY_MOMENT
    )
    return "good" if balanced else "not balanced", None


def main(
    shapes: tuple[str, ...] = (),
    polygons: int = 20,
    starts: int = 50,
    probes: int = 40,
    seed: int = 0,
    form: str = "hierarchy",
    noise: bool = False,
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
        noise: on normals (0.02 rad) and positions (0.5 mm); good is then what truly is at the end
        jobs: processes
    """
    objects = {name: NAMED[name] for name in shapes}
    if not shapes:
        rngs = [np.random.default_rng((seed, i)) for i in range(polygons)]
        objects = {f"polygon {i}": polygon(rng) for i, rng in enumerate(rngs)}
    print(f"{'':14}{'good':>12}{'median':>8}{'p99':>6}{'worst':>7}{f'≤ {QUICK}':>7}  failures")
    every: list[tuple[str, int | None]] = []
    with ProcessPoolExecutor(jobs) as pool:
        for s, (name, thing) in enumerate(objects.items()):
            one = partial(start, hg.Scene(object=thing), form, probes, noise)
            ends = list(pool.map(one, [(seed, s, i) for i in range(starts)], chunksize=4))
            print(line(name, ends), flush=True)
            every += ends
    print(line("all", every))


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
