"""How long one probe takes on the cylinder, part by part.

    python benchmarks/probing.py --trials 5 --probes 40 --seed 0
    python benchmarks/probing.py --robots bhand wam_bhand umass_torso --joints 8 16 24 32 40

The parts are repeated on the grasps that the trials felt, the touches are those of the trials. The
second command has a line for each robot, and for hands of two fingers on a carriage that are made
for the purpose, with so many joints in all.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

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
        begin = time.thread_time()
        touched = self.probe.touch(q_target)
        self.calls.append((begin, time.thread_time(), touched))
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
        begin = time.thread_time()
        function(grasp)
        times.append(time.thread_time() - begin)
    return times[1:]


def pincer(joints: int, folder: Path) -> Path:
    """A description of two fingers on a carriage, with that many joints in all, at least 8."""
    each = [(joints - 6) // 2, joints - 6 - (joints - 6) // 2]
    fingers, points = "", ""
    for side, count in zip((-1, 1), each, strict=True):
        length = 0.12 / count
        chain = "".join(
            f"<body name='f{side}_{i}' pos='{0.07 * side if not i else 0} 0 {length if i else 0}'>"
            f"<joint axis='0 {-side} 0' range='{-1.0 / count} {1.5 / count}' "
            f"name='f{side}_{i}'/><inertial mass='1' pos='0 0 0' diaginertia='1 1 1'/>"
            for i in range(count)
        )
        tip = f"<geom type='sphere' size='0.01' pos='0 0 {length}'/>"
        fingers += chain + tip + "</body>" * count
        points += f"[[contact_points]]\nlink = 'f{side}_{count - 1}'\n"
    palm = "<body name='palm'><inertial mass='1' pos='0 0 0' diaginertia='1 1 1'/>"
    xml = (
        f"<mujoco><compiler angle='radian'/><worldbody>{palm}{fingers}</body></worldbody></mujoco>"
    )
    path = folder / f"pincer of {joints}.toml"
    path.with_suffix(".xml").write_text(f"{xml}</worldbody></mujoco>")
    path.write_text(
        f"model = 'pincer of {joints}.xml'\ncarriage = true\nworkspace = [0.6, 0.0, 0.3]\n"
        f"palm = {{ body = 'palm' }}\n{points}"
    )
    return path


def growth(robots: tuple[str, ...], joints: tuple[int, ...], seed: int, solver: str) -> None:
    """Print median microseconds of each part of a probe, a robot a line."""
    print(f"cylinder of 5 cm, seed {seed}, {solver}, median µs\n")
    print(f"{'':16}{'joints':>8}{'touch':>8}{'laws':>8}{'limits':>8}{'hierarchy':>11}")
    with tempfile.TemporaryDirectory() as folder:
        every = [*robots, *(pincer(n, Path(folder)) for n in joints)]
        for robot in every:
            scene = hg.Scene(robot=robot, object=hg.Cylinder(radius=0.05))
            trial = hg.Trial(scene, hg.stack_of("fmk"), probes=20)
            probe = TimedProbe(GeometricProbe(scene))
            if scene.articulated.arm:
                record = trial.attempt((seed, 0), probe)
            else:  # a hand by itself is placed by the draw, and begins from there
                began = hg.Start().draw(scene, GeometricProbe, np.random.default_rng(seed))
                probe = TimedProbe(GeometricProbe(began.scene))
                placed = hg.Trial(began.scene, trial.stack, 20, start=began.grasp)
                record = placed.attempt((seed, 0), probe)
            stack = trial.controller(scene).stack
            assert isinstance(stack, hg.Stack)
            hqp = hg.HQP(solver, rank_tolerance=TOUCH_RANK)
            levels = [stack.levels(grasp) for grasp in record.grasps]
            each = iter(levels)
            touches = [1e6 * (end - begin) for begin, end, _ in probe.calls]
            solve = timed(lambda _, hqp=hqp, each=each: hqp.solve(next(each)), record.grasps)  # type: ignore[misc]
            parts = [timed(f, record.grasps) for f in (stack.law_levels, stack.limit_levels)]
            columns = [np.median(touches), *(1e6 * np.median(v) for v in (*parts, solve))]
            name = robot.stem if isinstance(robot, Path) else robot
            row = "".join(f"{v:{w}.0f}" for v, w in zip(columns, (8, 8, 8, 11), strict=True))
            print(f"{name:16}{scene.articulated.n:8}{row}", flush=True)


def main(
    seed: int = 0,
    trials: int = 5,
    probes: int = 40,
    solver: str = "proxqp",
    robots: tuple[str, ...] = (),
    joints: tuple[int, ...] = (),
) -> None:
    """Print microseconds of each part of a probe, and touches a second on one core.

    Args:
        seed: trial i draws from SeedSequence([seed, i])
        trials: random starts
        probes: touches after the first one, in each trial
        solver: of the hierarchy
        robots: names or paths; then a line for each
        joints: of hands made for the purpose; likewise
    """
    if robots or joints:
        growth(robots, joints, seed, solver)
        return
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
