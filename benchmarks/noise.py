"""Contacts felt with noise: how well the grasp at the end balances, as it is.

    python benchmarks/noise.py --trials 80 --seed 62 --jobs 2

Normals are felt with 0.02 rad of noise about each axis, positions with 0.5 mm along each, drawn
anew at every touch. Prints the shares of trials that end within ε_f ≤ 5e-3 N² and √ε_m ≤ 4 mm·N,
the true ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import tyro
from hqp_grasp.scenarios import cylinder, hexagon, irregular
from tqdm import tqdm

import hqp_grasp as hg
from hqp_grasp.experiments.executor import run_all

SCENES = {"cylinder": cylinder.scene, "hexagon": hexagon.scene, "irregular": irregular.scene}
FORCE, MOMENT = 5e-3, 4e-3  # [N²], [N·m]


@dataclass(frozen=True)
class Work:
    """The trials of each object, one after the other."""

    form: str
    noise: hg.Noise
    trials: int
    probes: int
    seed: int

    def __call__(self, number: int) -> tuple[float, float]:
        """True ε_f [N²] and ε_m [(N·m)²] at the end; NaN where the last touch missed."""
        s, i = divmod(number, self.trials)
        scene, stack = tuple(SCENES.values())[s], hg.stack_of("fmk")
        trial = hg.Trial(scene, stack, self.probes, self.form, noise=self.noise)
        record = trial.attempt((self.seed, i))
        force, moment = (record.column(f"eps_{a}_true").astype(float)[-1] for a in "fm")
        return float(force), float(moment)


def main(
    form: str = "hierarchy",
    normal: float = 0.02,
    position: float = 5e-4,
    trials: int = 200,
    probes: int = 40,
    seed: int = 50,
    jobs: int = 2,
) -> None:
    """Print one line an object.

    Args:
        form: of stepping
        normal: noise of normals [rad]
        position: noise of positions [m]
        trials: random starts
        probes: touches after the first
        seed: trial i draws from SeedSequence([seed, i])
        jobs: processes
    """
    noise = hg.Noise(normal, position)
    work, numbers = Work(form, noise, trials, probes, seed), range(len(SCENES) * trials)
    done = dict(tqdm(run_all(work, numbers, jobs), total=len(numbers)))
    print(f"form {form}, {noise}, seed {seed}, {trials} trials of {probes} probes\n")
    print(f"{'':12}{'within at the end':>20}{'ε_f [N²], median, 95 %':>28}", end="")
    print(f"{'√ε_m [mm·N], median, 95 %':>30}{'lost':>6}")
    for s, name in enumerate(SCENES):
        force, square = np.array([done[s * trials + i] for i in range(trials)]).T
        moment = np.sqrt(square)
        within = int(((force <= FORCE) & (moment <= MOMENT)).sum())
        f, m = np.nanpercentile(force, [50, 95]), 1e3 * np.nanpercentile(moment, [50, 95])
        told = f"{within} of {trials} ({within / trials:.0%})"
        print(f"{name:12}{told:>20}{f'{f[0]:.1e}, {f[1]:.1e}':>28}", end="")
        print(f"{f'{m[0]:.2f}, {m[1]:.2f}':>30}{int(np.isnan(force).sum()):>6}")


if __name__ == "__main__":
    tyro.cli(main)
