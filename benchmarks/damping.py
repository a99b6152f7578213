"""What the λ of eq. 13's SR-inverse, and the gain, do to the paper's own form.

    python benchmarks/damping.py --trials 100 --seed 53

"Good" and the kinds of failure are those of `hqp-grasp report`. Probes are those until it
stays balanced, median (worst); the last column is what is left at the last touch, in the median.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import tyro
from hqp_grasp.scenarios import cylinder, hexagon
from tqdm import tqdm

import hqp_grasp as hg
from hqp_grasp.control.forms import PaperForm
from hqp_grasp.experiments.executor import run_all

SCENES = {"cylinder": cylinder.scene, "hexagon": hexagon.scene}
DAMPINGS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7)  # λ [m²/rad²]
GAINS = (0.5, 1.0, 1.5)  # of force and moment law; 1 is the best descent that is sure
CELLS = tuple(product(SCENES, DAMPINGS, GAINS))
KINDS = ("lost", "not balanced", "link inside")


@dataclass(frozen=True)
class Work:
    """The trials of each cell, one after the other; trial i begins alike in all cells."""

    trials: int
    probes: int
    seed: int

    def __call__(self, number: int) -> tuple[str, int | None, float]:
        """Verdict, probe from which it stays balanced, and √ε_m [N·m] at the last touch."""
        cell, i = divmod(number, self.trials)
        scene, damping, gain = CELLS[cell]
        stack = hg.ForceTask(gain=gain) >> hg.MomentTask(gain=gain) >> hg.KinematicTask()
        form = PaperForm(hg.Projection(damping=damping))
        record = hg.Trial(SCENES[scene], stack, self.probes, form).attempt((self.seed, i))
        felt = [row["eps_m"] for row in record.rows if row["eps_m"] is not None]
        left = float(felt[-1]) ** 0.5 if felt else np.nan  # type: ignore[arg-type]
        return record.verdict, record.converged_at, left


def row(cell: tuple[str, float, float], found: Sequence[tuple[str, int | None, float]]) -> str:
    """What came of the trials of one cell."""
    scene, damping, gain = cell
    count = Counter(verdict for verdict, _, _ in found)
    at = [probe for _, probe, _ in found if probe is not None]
    told = "".join(f"{count[kind]:>14}" for kind in KINDS)
    probes_to = f"{np.median(at):g} ({max(at)})" if at else "–"
    left = 1e3 * np.nanmedian([moment for _, _, moment in found])
    name = f"{scene:10}{damping:7.0e}{gain:6g}"
    return f"{name}{count['good']:>6}{told}{probes_to:>12}{left:14.2g}"


def main(trials: int = 100, seed: int = 53, probes: int = 60, jobs: int = 2) -> None:
    """Print one row an object, λ and gain.

    Args:
        trials: random starts, the same for every row
        seed: trial i draws from SeedSequence([seed, i])
        probes: touches after the first
        jobs: processes
    """
    numbers = range(len(CELLS) * trials)
    done = dict(tqdm(run_all(Work(trials, probes, seed), numbers, jobs), total=len(numbers)))
    print(f"paper's form, force ▷ moment ▷ kinematic, {trials} starts of seed {seed}\n")
    kinds = "".join(f"{kind:>14}" for kind in KINDS)
    print(f"{'':10}{'λ':>7}{'gain':>6}{'good':>6}{kinds}{'probes':>12}{'√ε_m [mm·N]':>14}")
    for k, cell in enumerate(CELLS):
        print(row(cell, [done[k * trials + i] for i in range(trials)]))


if __name__ == "__main__":
    tyro.cli(main)
