"""Contacts felt with noise: how well the grasp at the end balances, as it is.

    python benchmarks/noise.py --trials 200 --seed 50 --jobs 2

Normals are felt with 0.02 rad of noise about each axis, positions with 0.5 mm along each, drawn
anew at every touch. Prints the shares of trials that end within ε_f ≤ 5e-3 N² and √ε_m ≤ 4 mm·N,
the true ones.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context

import numpy as np
import tyro
from hqp_grasp.scenarios import cylinder, hexagon, irregular

import hqp_grasp as hg

SCENES = {"cylinder": cylinder.scene, "hexagon": hexagon.scene, "irregular": irregular.scene}
FORCE, MOMENT = 5e-3, 4e-3  # [N²], [N·m]


def one(name: str, form: str, probes: int, noise: hg.Noise, seed: int, i: int) -> np.ndarray:
    """True ε_f and ε_m after each probe (probes + 1, 2); NaN where the last touch missed."""
    stack = hg.ForceTask() >> hg.MomentTask() >> hg.KinematicTask()
    record = hg.Trial(SCENES[name], stack, probes, form=form, noise=noise).attempt((seed, i))
    return np.column_stack([record.column("eps_f_true"), record.column("eps_m_true")]).astype(float)


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
    print(f"form {form}, {noise}, seed {seed}, {trials} trials of {probes} probes\n")
    print(f"{'':12}{'within at the end':>20}{'ε_f [N²], median, 95 %':>28}", end="")
    print(f"{'√ε_m [mm·N], median, 95 %':>30}{'lost':>6}")
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        for name in SCENES:
            work = partial(one, name, form, probes, noise, seed)
            found = np.array(list(pool.map(work, range(trials), chunksize=10)))
            force, moment = found[:, -1, 0], np.sqrt(found[:, -1, 1])
            within = int(((force <= FORCE) & (moment <= MOMENT)).sum())
            f, m = np.nanpercentile(force, [50, 95]), 1e3 * np.nanpercentile(moment, [50, 95])
            told = f"{within} of {trials} ({within / trials:.0%})"
            print(f"{name:12}{told:>20}{f'{f[0]:.1e}, {f[1]:.1e}':>28}", end="")
            print(f"{f'{m[0]:.2f}, {m[1]:.2f}':>30}{int(np.isnan(force).sum()):>6}")


if __name__ == "__main__":
    tyro.cli(main)
