"""How many probes the caps on a step cost: those taken, beside the fewest that the caps allow.

    python benchmarks/caps.py --trials 200 --seed 90

The fewest are those of a hand that knows at the start which grasp it will balance in, and goes
there as straight as joints and contacts can: the longest of all their ways, by its cap.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import tyro
from hqp_grasp.scenarios import cylinder, cylinder_65, hexagon, irregular
from tqdm import tqdm

import hqp_grasp as hg
from hqp_grasp.experiments.executor import run_all

SCENES = {
    "cylinder": cylinder.scene,
    "cylinder_65": cylinder_65.scene,
    "hexagon": hexagon.scene,
    "irregular": irregular.scene,
}
CAPS = (hg.StepLimit(), hg.StepLimit(joint=0.5, contact=0.05))
CELLS = tuple(product(SCENES, CAPS))


@dataclass(frozen=True)
class Work:
    """The trials of each cell, one after the other; trial i begins alike in all of one object."""

    trials: int
    probes: int
    seed: int

    def __call__(self, number: int) -> tuple[bool, int, int] | None:
        """Whether it is good, probes until it balances, and the fewest; None: it never does."""
        cell, i = divmod(number, self.trials)
        scene, caps = CELLS[cell]
        trial = hg.Trial(SCENES[scene], hg.stack_of("fmk").within(caps), self.probes)
        record = trial.attempt((self.seed, i))
        if record.converged_at is None:
            return None
        begin = record.grasps[0]
        posture = [record.column(f"q_{joint}") for joint in record.joints]
        end = np.array(posture, dtype=float)[:, record.converged_at]
        centers = SCENES[scene].articulated.centers
        way = np.abs(centers(end) - centers(begin.q)).max() / caps.contact
        turn = np.abs(end - begin.q).max() / caps.joint
        return record.verdict == "good", record.converged_at, int(np.ceil(max(way, turn)))


def main(trials: int = 200, seed: int = 90, probes: int = 40, jobs: int = 2) -> None:
    """Print one row an object and pair of caps.

    Args:
        trials: random starts, the same for both caps
        seed: trial i draws from SeedSequence([seed, i])
        probes: touches after the first
        jobs: processes
    """
    numbers = range(len(CELLS) * trials)
    done = dict(tqdm(run_all(Work(trials, probes, seed), numbers, jobs), total=len(numbers)))
    print(f"{trials} starts of seed {seed}, {probes} probes; medians, means in brackets\n")
    print(f"{'':14}{'caps':>18}{'good':>6}{'probes':>14}{'fewest':>14}")
    for k, (scene, caps) in enumerate(CELLS):
        found = [done[k * trials + i] for i in range(trials)]
        good, taken, fewest = np.array([cell for cell in found if cell is not None]).T
        told = [f"{np.median(v):g} ({v.mean():.1f})" for v in (taken, fewest)]
        size = f"{caps.joint:g} rad, {1e3 * caps.contact:g} mm"
        print(f"{scene:14}{size:>18}{good.sum():>6}{told[0]:>14}{told[1]:>14}")


if __name__ == "__main__":
    tyro.cli(main)
