"""What the λ of eq. 13's SR-inverse, and the gain, do to the paper's own form.

    python benchmarks/damping.py --trials 100 --seed 53

The last column is √ε_m at the last touch, the median.
"""

from __future__ import annotations

from itertools import product

from grid import SCENES, Runs, command, table

import hqp_grasp as hg
from hqp_grasp.control.forms import PaperForm

RUNS = Runs(100, 53)
DAMPINGS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7)  # λ [m²/rad²]
GAINS = (0.5, 1.0, 1.5)  # of force and moment law; 1 is the best descent that is sure
LEFT = "√ε_m [mm·N]"


def left(cell: str, trial: hg.Trial, record: hg.Record) -> dict[str, float]:
    """√ε_m at the last touch that felt something."""
    eps = [float(row["eps_m"]) for row in record.rows if row["eps_m"] is not None]  # type: ignore[arg-type]
    return {LEFT: 1e3 * eps[-1] ** 0.5 if eps else float("nan")}


def main(runs: Runs = RUNS, probes: int = 60) -> None:
    """Print one row an object, λ and gain.

    Args:
        runs: trials
        probes: touches after the first
    """
    cells = {}
    for name, damping, gain in product(("cylinder", "hexagon"), DAMPINGS, GAINS):
        stack = hg.ForceTask(gain=gain) >> hg.MomentTask(gain=gain) >> hg.KinematicTask()
        form = PaperForm(hg.Projection(damping=damping))
        cells[f"{name}, λ {damping:.0e}, {gain:g}"] = hg.Trial(SCENES[name], stack, probes, form)
    print(f"paper's form, force ▷ moment ▷ kinematic, {runs}; object, λ, gain\n")
    print(table(runs.of(cells, left), LEFT))


if __name__ == "__main__":
    command(main)
