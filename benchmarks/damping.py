"""What the λ of eq. 13's SR-inverse, and the gain, do to the paper's own form.

    python benchmarks/damping.py --trials 100 --seed 53
    python benchmarks/damping.py --trials 100 --seed 53 --stack fm --gains 1

"Good" and the kinds of failure are those of `python -m hqp_grasp report`; the last column is what
is left at the last touch, in the median.
"""

from __future__ import annotations

from collections import Counter
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
KINDS = ("lost", "not balanced", "link inside")


@dataclass(frozen=True)
class Work:
    """One trial of one cell of the table; trial i of each cell begins alike."""

    cells: tuple[tuple[str, float, float], ...]  # object, λ, gain
    stack: str
    trials: int
    probes: int
    seed: int

    def __call__(self, number: int) -> tuple[str, int | None, float]:
        """Verdict, probe from which it stays balanced, and √ε_m [N·m] at the last touch."""
        cell, i = divmod(number, self.trials)
        scene, damping, gain = self.cells[cell]
        laws = {"f": hg.ForceTask(gain=gain), "m": hg.MomentTask(gain=gain)}
        stack = hg.Stack(tuple((laws.get(v) or hg.KinematicTask(),) for v in self.stack))
        form = PaperForm(hg.Projection(damping=damping))
        record = hg.Trial(SCENES[scene], stack, self.probes, form).attempt((self.seed, i))
        moment = record.column("eps_m")
        return record.verdict, record.converged_at, float(moment[np.isfinite(moment)][-1]) ** 0.5


def main(
    trials: int = 100,
    seed: int = 53,
    probes: int = 60,
    stack: str = "fmk",
    gains: tuple[float, ...] = (0.5, 1.0, 1.5),
    jobs: int = 2,
) -> None:
    """Print one row a λ and gain, on two objects.

    Args:
        trials: random starts, the same for every row
        seed: trial i draws from SeedSequence([seed, i])
        probes: touches after the first
        stack: laws in their order, the kinematic law last
        gains: of the force and the moment law, 1 being the best descent that is sure
        jobs: processes
    """
    cells = tuple(product(SCENES, DAMPINGS, gains))
    work, numbers = Work(cells, stack, trials, probes, seed), range(len(cells) * trials)
    done = dict(tqdm(run_all(work, numbers, jobs), total=len(numbers)))
    print(f"paper's form, stack {stack}, {trials} starts of seed {seed}, {probes} probes\n")
    kinds = "".join(f"{kind:>14}" for kind in KINDS)
    print(f"{'':10}{'λ':>7}{'gain':>6}{'good':>6}{kinds}{'probes':>12}{'√ε_m [mm·N]':>14}")
    for cell, (scene, damping, gain) in enumerate(cells):
        found = [done[cell * trials + i] for i in range(trials)]
        count = Counter(verdict for verdict, _, _ in found)
        at = [probe for _, probe, _ in found if probe is not None]
        told = "".join(f"{count[kind]:>14}" for kind in KINDS)
        probes_to = f"{np.median(at):g} ({max(at)})" if at else "–"
        left = 1e3 * np.median([moment for _, _, moment in found])
        row = f"{scene:10}{damping:7.0e}{gain:6g}{count['good']:>6}{told}"
        print(f"{row}{probes_to:>12}{left:14.2g}")


if __name__ == "__main__":
    tyro.cli(main)
