"""Robots that nobody here wrote grasp what suits them, each by a description of a few lines.

    python benchmarks/outside_robots.py --trials 20 --seed 277
    python benchmarks/outside_robots.py --only shadow --trials 20

Their files come from pip packages, which `make outside` installs; the descriptions are in robots/.
"Good" is the verdict of `hqp-grasp report`; beside it stand the
deepest overlap of the robot's own links and the largest violation at any probe of a good trial.
"""

from __future__ import annotations

import sys
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from multiprocessing import get_context

import numpy as np
import tyro

import hqp_grasp as hg
from hqp_grasp.errors import HqpGraspError
from hqp_grasp.world.clearance import SelfClearance

HEXAGON = hg.Prism.regular(6, 0.06)


@dataclass(frozen=True)
class Case:
    """A robot, one of its hands, and what it grasps."""

    robot: str
    thing: hg.Cylinder | hg.Prism
    hand: str | None = None
    stack: str = "fmk"  # of laws, unless others are asked for

    @property
    def scene(self) -> hg.Scene:
        return hg.Scene(self.robot, self.thing, hand=self.hand)


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


@dataclass(frozen=True)
class End:
    """What became of one trial."""

    verdict: str
    probes: int | None  # touches after the first until it was balanced for good
    overlap: float  # [m] of the robot's own links, the deepest at any probe
    violation: float  # [rad] of a limit, the largest at any probe
    told: str  # why it failed, in the record's words


@cache
def trial_of(name: str, stack: str, probes: int) -> hg.Trial:
    """The trial; a process builds each scene once."""
    return hg.Trial(CASES[name].scene, hg.stack_of(stack), probes)


@cache
def links_of(name: str) -> SelfClearance:
    return SelfClearance(CASES[name].scene.articulated, 1e-3)


def one(name: str, stack: str, probes: int, seed: int, i: int) -> End:
    """Run trial i of a case."""
    record = trial_of(name, stack, probes).attempt((seed, i))
    near = [links_of(name).near(grasp.q, 1e-3) for grasp in record.grasps]
    overlap = max((float((-v.distance).max(initial=0.0)) for v in near), default=0.0)
    outcomes = [str(v) for v in record.column("outcome") if v is not None]
    told = record.error or (outcomes[-1] if outcomes else "")
    violation = float(record.column("limit_violation").max())
    return End(record.verdict, record.converged_at, overlap, violation, told)


def line(name: str, stack: str, ends: list[End]) -> str:
    """One row of the table."""
    good = [end for end in ends if end.verdict == "good"]
    kinds = Counter(end.verdict for end in ends if end.verdict != "good")
    figures = "".join(f"{'–':>{w}}" for w in (8, 7, 12, 12))
    if good:
        probes = [end.probes for end in good if end.probes is not None]
        overlap = 1e3 * max(end.overlap for end in good)
        violation = max(end.violation for end in good)
        figures = f"{np.median(probes):8.1f}{max(probes):7}{overlap:12.2g}{violation:12.2g}"
    failures = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
    return f"{name:22}{stack:5}{f'{len(good)} of {len(ends)}':>10}{figures}  {failures}"


def main(
    trials: int = 20,
    seed: int = 277,
    probes: int = 40,
    stacks: tuple[str, ...] = (),
    only: str = "",
    jobs: int = 2,
    verbose: bool = False,
) -> None:
    """Print, robot by robot, how many trials are good and how the others fail.

    Args:
        trials: random starts of each case
        seed: trial i draws from SeedSequence([seed, i])
        probes: touches after the first
        stacks: of laws, by their letters; none: that of each case
        only: cases whose names begin so
        jobs: processes
        verbose: tell of each trial that is not good how it ended
    """
    print(f"seed {seed}, {probes} probes\n")
    print(f"{'':22}{'laws':5}{'good':>10}{'median':>8}{'worst':>7}", end="")
    print(f"{'overlap mm':>12}{'violation':>12}  failures", flush=True)
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        for name in CASES:
            if not name.startswith(only):
                continue
            try:
                _ = CASES[name].scene
            except HqpGraspError as error:
                sys.exit(f"{error}\n`make outside` installs what these robots need")
            for stack in stacks or (CASES[name].stack,):
                work = ([v] * trials for v in (name, stack, probes, seed))
                ends = list(pool.map(one, *work, range(trials)))
                print(line(name, stack, ends), flush=True)
                for i, end in enumerate(ends):
                    if verbose and end.verdict != "good":
                        print(f"  trial {i}: {end.verdict}; {end.told}", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
