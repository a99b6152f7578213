"""The closed loop of touches: one seed in, one record out."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from operator import index

import numpy as np

from hqp_grasp.control.limits import ConfigurationLimit, StepLimit
from hqp_grasp.control.paper import laws, paper_levels
from hqp_grasp.errors import InputError, one_of
from hqp_grasp.experiments.start import first_touch
from hqp_grasp.grasp import Grasp, Missed
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.hierarchy.level import Level, Solution
from hqp_grasp.hierarchy.projection import Projection
from hqp_grasp.tasks import ForceTask, KinematicTask, MomentTask, Priority
from hqp_grasp.tasks.stack import Stack
from hqp_grasp.touch.geometric import GeometricProbe
from hqp_grasp.touch.probe import Probe
from hqp_grasp.world.robot import Robot
from hqp_grasp.world.scene import Scene

FORMS = ("hierarchy", "clipped", "paper")
SHARES = (1.0, 0.5, 0.25)  # of a step, tried in turn while it misses
CLIP_TOLERANCE = 1e-9  # [rad] a solver's rounding may leave a range by; more is a bug
TOUCH_RANK = 1e-6  # [–] normals felt to 1e-7 say nothing about directions weaker than this
LANDING_STEPS = 3
LANDED = 1e-6  # [m]
LANDING_DAMPING = 1e-2  # [m/rad] tips that move less than this with the joints are let be
SR_DAMPING = 1e-3  # λ of eq. 13 [m²/rad²]
CONVERGED_FORCE = 1e-3  # [N²]
CONVERGED_MOMENT = 2e-3  # √ε_m [N·m]

# Name, unit and meaning of every column that a probe fills.
COLUMNS = {
    "eps_f": "N^2: squared net force of unit contact forces",
    "eps_m": "(N m)^2: squared net moment about the contact centroid",
    "eps_k": "rad: mean angle between flexion velocity and normal",
    "eps_k_eq7": "m/rad: sum of eq. 7 over the contacts",
    "adduction_deg": "deg: the spread joint's angle",
    "elevation_deg": "deg: the palm's approach axis below the horizontal",
    "in_contact": "bool: every finger touches",
    "outcome": "touch, or why the probe missed",
    "other_links": "links beside the fingertips that touch the object",
    "step_share": "share of the planned step that was taken",
    "limit_active": "bool: a limit holds the step that led here",
    "limit_violation": "rad: how far the worst joint is outside its range, commanded or reached",
    "hqp_projection_gap": "rad: largest difference of hierarchy and projection, limits inactive",
    "solve_us": "us: solving the hierarchy",
    "method": "the way the solver found the step",
}


@dataclass(frozen=True, eq=False)
class Record:
    """What one trial brought: probes + 1 rows, the first being the first touch."""

    seed: tuple[int, ...]
    rows: tuple[dict[str, object], ...]  # COLUMNS of each probe, None where there is nothing
    grasps: tuple[Grasp, ...]  # every grasp felt, in order
    rejected: int  # starting postures drawn before that could not touch
    joints: tuple[str, ...]

    def column(self, name: str) -> np.ndarray:
        """One column over the probes; NaN where a number is missing."""
        one_of("column", name, self.rows[0])
        values = [row[name] for row in self.rows]
        return np.array([np.nan if value is None else value for value in values])

    @property
    def lost(self) -> bool:
        """True where the trial ended without contact."""
        return not self.rows[-1]["in_contact"]

    @property
    def converged_at(self) -> int | None:
        """First probe from which ε_f ≤ CONVERGED_FORCE and √ε_m ≤ CONVERGED_MOMENT to the end."""
        force, moment = self.column("eps_f"), np.sqrt(self.column("eps_m"))
        bad = ~((force <= CONVERGED_FORCE) & (moment <= CONVERGED_MOMENT))
        last = int(np.flatnonzero(bad)[-1]) if bad.any() else -1
        return None if last == len(bad) - 1 else last + 1


@dataclass(frozen=True)
class Trial:
    """A scene, a stack of laws, and how to step: run(seed) is a pure function of its seed.

    form="hierarchy" solves the joint-space hierarchy within its limits; "clipped" takes the strict
    projection of the same laws, scaled to the caps and clipped to the ranges; "paper" composes
    gradients in contact space and maps them by the SR-inverse (eq. 11–13), then clips likewise.
    A stack that names no limits gets StepLimit(), and one without ranges the robot's.

    `landing`: before it touches, the hand corrects its target by its own kinematics, so that the
    fingertips arrive where the linear prediction J x said (within the same limits).
    """

    scene: Scene
    stack: Stack
    probes: int = 60
    form: str = "hierarchy"
    hqp: HQP = field(default_factory=lambda: HQP(rank_tolerance=TOUCH_RANK))
    landing: bool = True
    links: str = "pass"  # or "block": see GeometricProbe

    def __post_init__(self) -> None:
        one_of("form", self.form, FORMS)
        one_of("links", self.links, ("pass", "block"))
        if self.form == "paper":
            laws(self.stack)  # raises for a stack that has no such form
        if self.probes < 1:
            raise InputError(f"a trial needs at least 1 probe; got {self.probes}")

    def run(self, seed: int | Sequence[int], probe: Probe | None = None) -> Record:
        """Draw a start, then step and touch `probes` times, or until the object is lost.

        On a miss the step from the last good grasp is halved, twice; then the trial is lost.
        """
        entropy = _entropy(seed)
        rng = np.random.default_rng(np.random.SeedSequence(entropy))
        robot = self.scene.articulated
        stack = self.stack
        if not stack.limits:
            stack = stack.within(StepLimit())
        if not any(limit.priority is Priority.RANGE for limit in stack.limits):
            stack = stack.within(ConfigurationLimit(robot))
        probe = probe or GeometricProbe(self.scene, self.links)
        start = first_touch(self.scene, probe, rng)
        grasp, warm = start.grasp, None
        grasps, rows = [grasp], [_felt(robot, grasp)]
        for _ in range(self.probes):
            step = _step(self, stack, grasp, warm)
            warm = step.solution
            touched: Grasp | Missed | None = None
            worst = 0.0
            for share in SHARES:
                q = self._target(robot, stack, grasp, share * step.x)
                worst = max(worst, robot.violation(q))
                touched = probe.touch(q)
                if isinstance(touched, Grasp):
                    break
            about = {
                "step_share": share,
                "limit_active": step.limit_active,
                "hqp_projection_gap": step.gap,
                "solve_us": step.solve_us,
                "method": step.solution.method,
            }
            if isinstance(touched, Missed):
                why = f"{touched.reason.value} ({touched.where})"
                rows.append(_nothing() | about | {"outcome": why, "limit_violation": worst})
                break
            assert touched is not None
            grasp = touched
            grasps.append(grasp)
            felt = _felt(robot, grasp)
            worst = max(worst, robot.violation(grasp.q))
            rows.append(felt | about | {"limit_violation": worst})
        rows += [_nothing() for _ in range(self.probes + 1 - len(rows))]
        return Record(entropy, tuple(rows), tuple(grasps), start.rejected, robot.joints)

    def _target(self, robot: Robot, stack: Stack, grasp: Grasp, x: np.ndarray) -> np.ndarray:
        """Where to close: q + x, landed, and clipped to the ranges as the very last act."""
        if self.landing:
            x = _land(robot, stack, grasp, x)
        q = grasp.q + x
        ranges = [v.robot for v in stack.limits if isinstance(v, ConfigurationLimit)]
        lower = np.max([robot.q_lower, *(r.q_lower for r in ranges)], axis=0)
        upper = np.min([robot.q_upper, *(r.q_upper for r in ranges)], axis=0)
        clipped = np.clip(q, lower, upper)
        left = np.abs(clipped - q) > CLIP_TOLERANCE
        started_inside = (grasp.q >= lower) & (grasp.q <= upper)
        if (left & started_inside).any():
            raise AssertionError(f"a step left its range by {np.abs(clipped - q).max()} rad")
        return np.where(left, q, clipped)  # a joint that started outside may still be on its way


def _entropy(seed: int | Sequence[int]) -> tuple[int, ...]:
    numbers: Sequence[int] = seed if isinstance(seed, Sequence) else (seed,)
    try:
        entropy = tuple(index(number) for number in numbers)
    except TypeError as error:
        raise InputError(f"a seed is a whole number, or several; got {seed!r}") from error
    if not entropy or min(entropy) < 0:
        raise InputError(f"a seed must be at least 0; got {seed!r}")
    return entropy


@dataclass(frozen=True, eq=False)
class _Step:
    x: np.ndarray
    solution: Solution
    limit_active: bool
    gap: float | None
    solve_us: float


def _step(trial: Trial, stack: Stack, grasp: Grasp, warm: Solution | None) -> _Step:
    """The step that the trial's form asks for at this grasp."""
    if trial.form == "hierarchy":
        law_levels = stack.law_levels(grasp)
        levels = stack.limit_levels(grasp) + law_levels
        begin = time.perf_counter()
        solution = trial.hqp.solve(levels, warm)
        solve_us = 1e6 * (time.perf_counter() - begin)
        gap = None
        if not solution.limit_active:
            projected = Projection(rank_tolerance=trial.hqp.rank_tolerance).solve(law_levels)
            gap = float(np.abs(solution.x - projected.x).max())
        return _Step(solution.x, solution, solution.limit_active, gap, solve_us)
    begin = time.perf_counter()
    if trial.form == "clipped":
        solution = Projection(rank_tolerance=trial.hqp.rank_tolerance).solve(
            stack.law_levels(grasp)
        )
    else:
        solution = Projection(damping=SR_DAMPING).solve(paper_levels(stack, grasp))
    solve_us = 1e6 * (time.perf_counter() - begin)
    robot = trial.scene.articulated
    x = clip_to_limits(solution.x, stack, grasp)
    x = np.clip(x, robot.q_lower - grasp.q, robot.q_upper - grasp.q)
    return _Step(x, solution, not np.array_equal(x, solution.x), None, solve_us)


def clip_to_limits(x: np.ndarray, stack: Stack, grasp: Grasp) -> np.ndarray:
    """What is done to a step that knows no limits: scaled to the caps, then clipped to the ranges.

    The scale keeps the step's direction, the clip does not keep its priorities.
    """
    ratio = 1.0
    clipped = x
    for limit in stack.limits:
        level = limit.level(grasp)
        if limit.priority is Priority.CAP and len(level.A):
            value = level.A @ x
            with np.errstate(divide="ignore", invalid="ignore"):
                share = np.where(value > 0.0, value / level.upper, value / level.lower)
            ratio = max(ratio, float(np.nanmax(share)))
    clipped = x / ratio
    for limit in stack.limits:
        if isinstance(limit, ConfigurationLimit):
            robot = limit.robot
            clipped = np.clip(clipped, robot.q_lower - grasp.q, robot.q_upper - grasp.q)
    return clipped


def _land(robot: Robot, stack: Stack, grasp: Grasp, x: np.ndarray) -> np.ndarray:
    """Correct x until the fingertips arrive where J x puts them, as far as the limits allow."""
    limits = stack.limit_levels(grasp)
    goal = robot.centers(grasp.q).ravel() + grasp.jacobian @ x
    damping = LANDING_DAMPING * np.eye(grasp.n)
    hqp = HQP()
    for _ in range(LANDING_STEPS):
        rest = goal - robot.centers(grasp.q + x).ravel()
        if np.abs(rest).max() < LANDED:
            break
        levels = [
            Level(v.A, np.minimum(v.lower - v.A @ x, 0.0), np.maximum(v.upper - v.A @ x, 0.0))
            for v in limits
        ]
        A = np.concatenate([robot.jacobian(grasp.q + x), damping])
        b = np.concatenate([rest, np.zeros(grasp.n)])
        x = x + hqp.solve([*levels, Level.equal(A, b, "landing")]).x
    return x


def _nothing() -> dict[str, object]:
    return dict.fromkeys(COLUMNS) | {
        "in_contact": False,
        "limit_active": False,
        "limit_violation": 0.0,
        "other_links": "",
    }


def _felt(robot: Robot, grasp: Grasp) -> dict[str, object]:
    """The columns that a grasp by itself fills."""
    adduction = robot.description.adduction
    angle = None if adduction is None else float(np.degrees(grasp.q[robot.index(adduction)]))
    return _nothing() | {
        "eps_f": ForceTask().potential(grasp),
        "eps_m": MomentTask().potential(grasp),
        "eps_k": float(KinematicTask(error="angle").error(grasp).mean()),
        "eps_k_eq7": float(KinematicTask(error="eq7").error(grasp).sum()),
        "adduction_deg": angle,
        "elevation_deg": float(np.degrees(np.arcsin(-robot.palm(grasp.q)[1][2, 2]))),
        "in_contact": True,
        "outcome": "touch",
        "other_links": ", ".join(grasp.other_links),
        "limit_violation": robot.violation(grasp.q),
    }
