"""How many probes the caps on a step cost: those taken, beside the fewest that the caps allow.

    python benchmarks/caps.py --trials 200 --seed 90

The fewest are those of a hand that knows at the start which grasp it will balance in, and goes
there as straight as joints and contacts can: the longest of all their ways, by its cap.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from grid import SCENES, Runs, command, table

import hqp_grasp as hg

RUNS = Runs(200, 90)
CAPS = (hg.StepLimit(), hg.StepLimit(joint=0.5, contact=0.05))
FEWEST = "fewest probes"


def fewest(cell: str, trial: hg.Trial, record: hg.Record) -> dict[str, float]:
    """Probes that the straight way from the first grasp to the balanced one takes."""
    if record.converged_at is None:
        return {FEWEST: np.nan}
    caps = next(limit for limit in hg.Stack.of(trial.stack).limits if type(limit) is hg.StepLimit)
    begin = record.grasps[0].q
    posture = [record.column(f"q_{joint}") for joint in record.joints]
    end = np.array(posture, dtype=float)[:, record.converged_at]
    centers = trial.scene.articulated.centers
    way = np.abs(centers(end) - centers(begin)).max() / caps.contact
    return {FEWEST: float(np.ceil(max(way, np.abs(end - begin).max() / caps.joint)))}


def main(runs: Runs = RUNS, probes: int = 40) -> None:
    """Print one row an object and pair of caps.

    Args:
        runs: trials
        probes: touches after the first
    """
    stack = hg.stack_of("fmk")
    cells = {
        f"{name}, {caps.joint:g} rad, {1e3 * caps.contact:g} mm": hg.Trial(
            scene, stack.within(caps), probes
        )
        for (name, scene), caps in product(SCENES.items(), CAPS)
    }
    print(f"{runs}, {probes} probes\n")
    print(table(runs.of(cells, fewest), FEWEST))


if __name__ == "__main__":
    command(main)
