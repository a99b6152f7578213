"""Robots that nobody here wrote grasp what suits them, each by a description of a few lines.

    python benchmarks/outside_robots.py --trials 20 --seed 277
    python benchmarks/outside_robots.py --only shadow --trials 20

Their files come from pip packages, which `make outside` installs; the descriptions are in robots/.
Beside the shares stand the deepest overlap of the robot's own links and the largest violation of a
limit, at any probe.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import cache

from grid import Runs, command, table

import hqp_grasp as hg
from hqp_grasp.errors import HqpGraspError
from hqp_grasp.world.clearance import SelfClearance
from hqp_grasp.world.robot import Robot

RUNS = Runs(20, 277)
OWN = ("overlap [mm]", "violation [rad]")
HEXAGON = hg.Prism.regular(6, 0.06)


@dataclass(frozen=True)
class Case:
    """A robot, one of its hands, and what it grasps."""

    robot: str
    thing: hg.Cylinder | hg.Prism
    hand: str | None = None
    stack: str = "fmk"  # of laws, unless others are asked for

    def trial(self, stack: str, probes: int) -> hg.Trial:
        """With these laws, or its own."""
        scene = hg.Scene(self.robot, self.thing, hand=self.hand)
        return hg.Trial(scene, hg.stack_of(stack or self.stack), probes)


CASES = {
    "allegro, 45 mm": Case("allegro", hg.Cylinder(0.045)),
    "shadow, 30 mm": Case("shadow", hg.Cylinder(0.03)),
    "robotiq, 20 mm": Case("robotiq", hg.Cylinder(0.02)),
    "robotiq, 30 mm": Case("robotiq", hg.Cylinder(0.03)),
    "inspire, 30 mm": Case("inspire", hg.Cylinder(0.03)),
    "fourier, 30 mm": Case("fourier", hg.Cylinder(0.03)),
    "g1 arms, 120 mm": Case("g1", hg.Cylinder(0.12), "both", "fm"),
    "baxter arms, 200 mm": Case("baxter", hg.Cylinder(0.2), "both", "fm"),
    "torso right, 50 mm": Case("umass_torso", hg.Cylinder(0.05), "right"),
    "torso left, 50 mm": Case("umass_torso", hg.Cylinder(0.05), "left"),
    "torso right, hexagon": Case("umass_torso", HEXAGON, "right"),
    "torso left, hexagon": Case("umass_torso", HEXAGON, "left"),
}


@cache
def links_of(robot: Robot) -> SelfClearance:
    """A robot's own links; a process looks for their pairs once."""
    return SelfClearance(robot, 1e-3)


def worst(cell: str, trial: hg.Trial, record: hg.Record) -> dict[str, float]:
    """The deepest overlap of the robot's own links, and the largest violation, at any probe."""
    links = links_of(trial.scene.articulated)
    near = [links.near(grasp.q, 1e-3).distance for grasp in record.grasps]
    overlap = max((float((-distance).max(initial=0.0)) for distance in near), default=0.0)
    violation = float(record.column("limit_violation").max())
    return dict(zip(OWN, (1e3 * overlap, violation), strict=True))


def main(
    runs: Runs = RUNS,
    probes: int = 40,
    stacks: tuple[str, ...] = ("",),
    only: str = "",
    verbose: bool = False,
) -> None:
    """Print, robot by robot, how many trials are good and how the others fail.

    Args:
        runs: trials
        probes: touches after the first
        stacks: of laws, by their letters; none: that of each case
        only: cases whose names begin so
        verbose: tell of each trial that is not good how it ended
    """
    chosen = {name: case for name, case in CASES.items() if name.startswith(only)}
    try:
        cells = {
            f"{name} {stack}".strip(): case.trial(stack, probes)
            for name, case in chosen.items()
            for stack in stacks
        }
    except HqpGraspError as error:
        sys.exit(f"{error}\n`make outside` installs what these robots need")
    found = runs.of(cells, worst)
    print(f"{runs}, {probes} probes\n")
    print(table(found, *OWN))
    for name, ends in found.items():
        for i, end in enumerate(ends):
            if verbose and end.verdict != "good":
                print(f"  {name}, trial {i}: {end.verdict}; {end.why}")
        most = [max(end.figures[own] for end in ends) for own in OWN]
        print(f"  {name}: at most {most[0]:.2g} mm, {most[1]:.2g} rad")


if __name__ == "__main__":
    command(main)
