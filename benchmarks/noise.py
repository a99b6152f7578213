"""Contacts felt with noise: how well the grasp at the end balances, as it is.

    python benchmarks/noise.py --trials 80 --seed 62

Normals are felt with 0.02 rad of noise about each axis, positions with 0.5 mm along each, drawn
anew at every touch. Prints the shares of trials that end within ε_f ≤ 5e-3 N² and √ε_m ≤ 4 mm·N,
the true ones.
"""

from __future__ import annotations

import numpy as np
from grid import SCENES, Runs, command

import hqp_grasp as hg

RUNS = Runs(200, 50)
FORCE, MOMENT = 5e-3, 4e-3  # [N²], [N·m]
OWN = ("within", "ε_f [N²]", "√ε_m [mm·N]")


def true(cell: str, trial: hg.Trial, record: hg.Record) -> dict[str, float]:
    """True errors at the end, NaN where the last touch missed, and whether they are within."""
    force, square = (float(record.column(f"eps_{law}_true").astype(float)[-1]) for law in "fm")
    within = force <= FORCE and square <= MOMENT**2
    return dict(zip(OWN, (float(within), force, 1e3 * square**0.5), strict=True))


def main(
    runs: Runs = RUNS,
    form: str = "hierarchy",
    normal: float = 0.02,
    position: float = 5e-4,
    probes: int = 40,
) -> None:
    """Print one line an object: how many end within, median and 95th percentile of the errors.

    Args:
        runs: trials
        form: of stepping
        normal: noise of normals [rad]
        position: noise of positions [m]
        probes: touches after the first
    """
    noise, stack = hg.Noise(normal, position), hg.stack_of("fmk")
    names = ("cylinder", "hexagon", "irregular")
    cells = {n: hg.Trial(SCENES[n], stack, probes, form, noise=noise) for n in names}
    found = runs.of(cells, true)
    print(f"form {form}, {noise}, {runs}, {probes} probes\n")
    for name, ends in found.items():
        within, force, moment = (np.array([end.figures[own] for end in ends]) for own in OWN)
        f, m = (np.nanpercentile(values, [50, 95]) for values in (force, moment))
        print(
            f"{name:10} {within.sum():3.0f} of {len(ends)} within; ε_f {f[0]:.1e}, {f[1]:.1e} N²; "
            f"√ε_m {m[0]:.2f}, {m[1]:.2f} mm·N; {np.isnan(force).sum()} lost"
        )


if __name__ == "__main__":
    command(main)
