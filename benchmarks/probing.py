"""How long one probe takes on the cylinder, part by part.

    python benchmarks/probing.py --trials 5 --probes 40 --seed 0

The parts are repeated on the grasps that the trials felt, the touches are those of the trials.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np
import tyro

import hqp_grasp as hg
from hqp_grasp.control.forms import TOUCH_RANK
from hqp_grasp.grasp import Missed
from hqp_grasp.touch.geometric import GeometricProbe

WANTED = 500  # touches a second on one core


@dataclass
class TimedProbe:
    """A probe that notes when it was called, when it answered, and what."""

    probe: GeometricProbe
    calls: list[tuple[float, float, hg.Grasp | Missed]] = field(default_factory=list)

    def touch(self, q_target: np.ndarray) -> hg.Grasp | Missed:
        begin = time.perf_counter()
        touched = self.probe.touch(q_target)
        self.calls.append((begin, time.perf_counter(), touched))
        return touched

    def since(self, record: hg.Record) -> tuple[list[float], list[float]]:
        """Seconds of each touch after the first grasp of `record`, and of each whole cycle."""
        first = next(i for i, call in enumerate(self.calls) if call[2] is record.grasps[0])
        ends = [end for _, end, _ in self.calls[first:]]
        touches = [end - begin for begin, end, _ in self.calls[first + 1 :]]
        return touches, list(np.diff(ends))


def timed(function: Callable[[hg.Grasp], object], grasps: Iterable[hg.Grasp]) -> list[float]:
    """Seconds of each call, the first left out."""
    times = []
    for grasp in grasps:
        begin = time.perf_counter()
        function(grasp)
        times.append(time.perf_counter() - begin)
    return times[1:]


def main(seed: int = 0, trials: int = 5, probes: int = 40, solver: str = "proxqp") -> None:
    """Print microseconds of each part of a probe, and touches a second on one core.

    Args:
        seed: trial i draws from SeedSequence([seed, i])
        trials: random starts
        probes: touches after the first one, in each trial
        solver: of the hierarchy
    """
    scene = hg.Scene(robot="wam_bhand", object=hg.Cylinder(radius=0.05))
    robot = scene.articulated
    stack = hg.stack_of("fmk").within(hg.StepLimit(), hg.ConfigurationLimit(robot))
    hqp = hg.HQP(solver, rank_tolerance=TOUCH_RANK)
    trial = hg.Trial(scene, stack, probes, hg.HierarchyForm(hqp))
    trial.run((seed, trials))  # compiles and fills caches
    touches: list[float] = []
    cycles: list[float] = []
    records = []
    for i in range(trials):
        probe = TimedProbe(GeometricProbe(scene))
        records.append(trial.run((seed, i), probe))
        of_touch, of_cycle = probe.since(records[-1])
        touches += of_touch
        cycles += of_cycle
    grasps = [grasp for record in records for grasp in record.grasps]

    def kinematics(grasp: hg.Grasp) -> None:
        robot.jacobian(grasp.q)
        robot.hessian(grasp.q)

    levels = [stack.levels(grasp) for grasp in grasps]
    each = iter(levels)
    rows = {
        "Jacobians, Hessian": timed(kinematics, grasps),
        "laws, from a grasp": timed(stack.law_levels, grasps),
        "limits, from a grasp": timed(stack.limit_levels, grasps),
        f"hierarchy solve ({solver})": timed(lambda _: hqp.solve(next(each)), grasps),
        "touch": touches,
        "whole cycle": cycles,
    }
    shape = " + ".join(str(len(level.A)) for level in levels[0])
    print(f"cylinder of 5 cm, {len(grasps)} grasps of {trials} trials, seed {seed}")
    print(f"{robot.n} unknowns, {shape} rows\n")
    print(f"{'µs':28}{'median':>10}{'p99':>10}")
    for label, times in rows.items():
        middle, worst = 1e6 * np.percentile(times, [50, 99])
        print(f"{label:28}{middle:10.0f}{worst:10.0f}")
    print(f"\n{'a second, on one core':28}{'median':>10}{'mean':>10}")
    for label, times in (("touches", touches), ("cycles", cycles)):
        print(f"{label:28}{1 / np.median(times):10.0f}{len(times) / sum(times):10.0f}")
    print(f"\n≥ {WANTED} touches a second are wanted")
    print("a cycle is: step from the grasp, landing, touch, errors and the comparison of forms")


if __name__ == "__main__":
    tyro.cli(main)
