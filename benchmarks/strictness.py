"""Strict priorities for mink's tasks on the WAM with the BarrettHand, beside mink itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import mink
import mujoco
import numpy as np
import tyro

from hqp_grasp import HQP, Robot, RobotDescription, Solution
from hqp_grasp.control.ik import ik_levels

DT = 0.01  # [s]
OUTSIDE = 0.1  # [rad] beyond its range, where a joint starts in the second case
SHOULDER = np.array([0.0, 0.0, 0.346])  # [m]
NEAR, FAR = 1e-3, 1.0  # [m] from the palm to its targets, so that few, or most, can be met
BEYOND = 3.0  # [m] from the shoulder to the targets that are out of reach for certain
WEIGHTS = (1.0, 0.1, 0.01)  # what a user of mink gives in the place of priorities
WORSE = 1e-9  # [–] of the residual that the first task has alone
ROUNDING = 1e-13  # [–] of what it asks for
MINK_SOLVERS = ("daqp", "proxqp")


@dataclass
class World:
    """The robot, limits on every joint, couplings as a constraint, and random draws."""

    rng: np.random.Generator
    robot: Robot = field(init=False)
    model: mujoco.MjModel = field(init=False)
    cap: np.ndarray = field(init=False)  # (nv,) [rad] in one step
    limits: list[mink.Limit] = field(init=False)
    couplings: mink.EqualityConstraintTask = field(init=False)

    def __post_init__(self) -> None:
        about = RobotDescription.load("wam_bhand")
        self.model = mujoco.MjModel.from_xml_path(str(about.xml))
        self.robot = Robot(about, self.model)
        # A coupled joint is as fast as its driver makes it.
        speed = np.abs(self.robot.coupling) @ self.robot.velocity
        self.cap = DT * speed
        names = [self.model.joint(j).name for j in range(self.model.njnt)]
        self.limits = [
            mink.ConfigurationLimit(self.model),
            mink.VelocityLimit(self.model, dict(zip(names, speed, strict=True))),
        ]
        self.couplings = mink.EqualityConstraintTask(self.model, cost=1.0)

    def inside(self) -> np.ndarray:
        """A random q (n,) within the ranges; one joint in five stands at an end of its own."""
        low, high = self.robot.q_lower, self.robot.q_upper
        share = self.rng.uniform(size=self.robot.n)
        at_end = self.rng.uniform(size=self.robot.n) < 0.2
        return low + np.where(at_end, np.round(share), share) * (high - low)

    def outside(self) -> np.ndarray:
        """A random q (n,) with one joint OUTSIDE its range."""
        q, j = self.inside(), self.rng.integers(self.robot.n)
        q[j] = self.rng.choice([self.robot.q_lower[j] - OUTSIDE, self.robot.q_upper[j] + OUTSIDE])
        return q

    def configuration(self, q: np.ndarray) -> mink.Configuration:
        return mink.Configuration(self.model, q=self.robot.coupling @ q + self.robot.offset)

    def palm(self, start: np.ndarray, distance: float) -> mink.FrameTask:
        """The palm, without its orientation, to a point this far from `start` [m]."""
        direction = self.rng.normal(size=3)
        task = mink.FrameTask("palm", "site", position_cost=1.0, orientation_cost=0.0)
        point = start + distance * direction / np.linalg.norm(direction)
        task.set_target(mink.SE3.from_translation(point))
        return task

    def tasks(self, configuration: mink.Configuration) -> list[mink.Task]:
        """The palm's place, above its orientation, above the home posture."""
        palm = configuration.get_transform_frame_to_world("palm", "site").translation()
        distance = float(np.exp(self.rng.uniform(np.log(NEAR), np.log(FAR))))
        turn = mink.FrameTask("palm", "site", position_cost=0.0, orientation_cost=1.0)
        wxyz = self.rng.normal(size=4)
        turn.set_target(mink.SE3.from_rotation(mink.SO3(wxyz / np.linalg.norm(wxyz))))
        posture = mink.PostureTask(self.model, cost=1.0)
        posture.set_target(self.robot.coupling @ self.robot.home + self.robot.offset)
        return [self.palm(palm, distance), turn, posture]

    def violation(self, configuration: mink.Configuration, x: np.ndarray) -> np.ndarray:
        """(nv,) [rad] by which each joint is outside its range after the step x."""
        q = configuration.q + x
        return np.maximum(np.maximum(self.robot.lower - q, q - self.robot.upper), 0.0)


def mink_step(
    configuration: mink.Configuration, tasks: Sequence[mink.Task], solver: str, **given: Any
) -> np.ndarray | None:
    """mink's answer Δq (nv,), or None where it raises."""
    try:
        return DT * mink.solve_ik(configuration, tasks, DT, solver, **given)
    except mink.NoSolutionFound:
        return None


@dataclass
class Strictness:
    """How lower tasks treated the first one, in so many configurations."""

    configurations: int = 0
    limit_active: int = 0
    unmet: int = 0  # configurations in which the limits do not let the first task be met
    worsened: int = 0  # by the tasks below, in strict order
    worsened_by_weights: int = 0  # by the tasks below, in mink's weighted sum
    uncertified: int = 0


def strictness(world: World, count: int, hqp: HQP) -> Strictness:
    """Solve the first task alone, then above two others; compare its residual."""
    seen = Strictness()
    for _ in range(count):
        configuration = world.configuration(world.inside())
        tasks = world.tasks(configuration)
        W, e, _ = tasks[0].compute_qp_residual(configuration)

        def left(x: np.ndarray, W: np.ndarray = W, e: np.ndarray = e) -> float:
            return float(np.linalg.norm(W @ x - e))

        given = {"limits": world.limits, "constraints": [world.couplings]}
        alone = hqp.solve(ik_levels(configuration, tasks[:1], DT, **given))
        levels = ik_levels(configuration, tasks, DT, **given)
        above = hqp.solve(levels)
        allowed = (1.0 + WORSE) * left(alone.x) + ROUNDING * float(np.linalg.norm(e))
        seen.configurations += 1
        seen.limit_active += above.limit_active
        seen.unmet += left(alone.x) > WORSE * np.linalg.norm(e)
        seen.worsened += left(above.x) > allowed
        seen.uncertified += not above.is_optimal(levels)
        for task, weight in zip(tasks, WEIGHTS, strict=True):
            task.cost = weight * task.cost
        weighted = mink_step(configuration, tasks, "daqp", **given)
        # A QP solver's own accuracy is no fault of the weights: a ten-thousandth more is.
        loose = (1.0 + 1e-4) * left(alone.x) + 1e-4 * float(np.linalg.norm(e))
        seen.worsened_by_weights += weighted is None or left(weighted) > loose
    return seen


@dataclass
class Answered:
    """One of the cases in which a weighted QP has no solution."""

    configurations: int = 0
    answered: int = 0
    within_caps: int = 0
    reported: int = 0  # the level that could not be met says so
    certified: int = 0
    right: int = 0  # the answer does what the case asks for
    mink_raises: dict[str, int] = field(default_factory=lambda: dict.fromkeys(MINK_SOLVERS, 0))


def start_outside(world: World, count: int, hqp: HQP) -> Answered:
    """One joint starts outside its range; right: each joint comes back as fast as it may."""

    def right(configuration: mink.Configuration, solution: Solution) -> bool:
        before = world.violation(configuration, np.zeros(world.model.nv))
        due = np.maximum(before - np.minimum(0.95 * before, world.cap), 0.0)  # 0.95: mink's gain
        return bool((world.violation(configuration, solution.x) <= due + 1e-12).all())

    def draw() -> tuple[mink.Configuration, list[mink.Task], list[mink.Task]]:
        configuration = world.configuration(world.outside())
        return configuration, world.tasks(configuration), [world.couplings]

    return _answered(world, count, hqp, draw, "ConfigurationLimit", right)


def hard_target(world: World, count: int, hqp: HQP) -> Answered:
    """A constraint asks for a point out of reach; right: ranges and couplings hold."""

    def right(configuration: mink.Configuration, solution: Solution) -> bool:
        J = world.couplings.compute_jacobian(configuration)
        return bool(
            (world.violation(configuration, solution.x) <= 1e-12).all()
            and np.abs(J @ solution.x + world.couplings.compute_error(configuration)).max() < 1e-12
        )

    def draw() -> tuple[mink.Configuration, list[mink.Task], list[mink.Task]]:
        configuration = world.configuration(world.inside())
        constraints = [world.couplings, world.palm(SHOULDER, BEYOND)]
        return configuration, world.tasks(configuration), constraints

    return _answered(world, count, hqp, draw, "FrameTask", right)


def _answered(
    world: World,
    count: int,
    hqp: HQP,
    draw: Callable[[], tuple[mink.Configuration, list[mink.Task], list[mink.Task]]],
    unmet: str,
    right: Callable[[mink.Configuration, Solution], bool],
) -> Answered:
    seen = Answered()
    for _ in range(count):
        configuration, tasks, constraints = draw()
        given = {"limits": world.limits, "constraints": constraints}
        levels = ik_levels(configuration, tasks, DT, **given)
        solution = hqp.solve(levels)
        seen.configurations += 1
        seen.answered += bool(np.isfinite(solution.x).all())
        seen.within_caps += bool((np.abs(solution.x) <= world.cap * (1.0 + 1e-9)).all())
        first = next(report for report in solution.levels if report.name == unmet)
        seen.reported += first.status == "nearest"
        seen.certified += solution.is_optimal(levels)
        seen.right += right(configuration, solution)
        for solver in MINK_SOLVERS:
            seen.mink_raises[solver] += mink_step(configuration, tasks, solver, **given) is None
    return seen


def main(seed: int = 0, configurations: int = 300, solver: str = "proxqp") -> None:
    """Print how strict the priorities are, and what becomes of starts and targets out of range.

    Args:
        seed: of all random draws
        configurations: in each of the three parts
        solver: of the hierarchy; mink is asked with its own
    """
    hqp = HQP(solver)
    parts = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(3)]
    strict = strictness(World(parts[0]), configurations, hqp)
    print(f"WAM with BarrettHand, 15 joints, 4 couplings, dt {DT} s, seed {seed}, {solver}")
    print(f"\npalm's place above its orientation above posture: {strict.configurations}")
    print(f"  an inequality holds the step       {strict.limit_active}")
    print(f"  the first task cannot be met       {strict.unmet}")
    print(f"  lower tasks worsen the first       {strict.worsened}")
    print(f"  … in mink, weights {WEIGHTS}  {strict.worsened_by_weights}")
    print(f"  not certified                      {strict.uncertified}")
    for title, part, case in (
        (f"one joint starts {OUTSIDE} rad outside its range", start_outside, parts[1]),
        (f"a constraint asks for a point {BEYOND} m away", hard_target, parts[2]),
    ):
        seen = part(World(case), configurations, hqp)
        print(f"\n{title}: {seen.configurations}")
        print(f"  answered                           {seen.answered}")
        print(f"  within the speed caps              {seen.within_caps}")
        print(f"  reported as nearest                {seen.reported}")
        print(f"  certified                          {seen.certified}")
        print(f"  joints return, couplings hold      {seen.right}")
        for name, raised in seen.mink_raises.items():
            print(f"  mink raises, with {name:<8}         {raised}")


if __name__ == "__main__":
    tyro.cli(main)
