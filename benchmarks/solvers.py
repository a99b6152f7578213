"""The hierarchy's speed and rightness beside mink, pink, daqp's own hierarchy and the projection.

    python benchmarks/solvers.py --problems 1000 --seed 0
    python benchmarks/solvers.py --sizes --problems 200 --plot out/solvers.png

Every method answers the same rows (tests/problems.py), in one run: they take turns, in a random
order, at blocks of problems. What is timed:

    HQP         levels built from arrays, solved from cold, certified; "named" is the share of the
                answers that the solver of that name found
    hg.solve_ik the same by way of mink's tasks and limits, its own signature
    mink, pink  solve_ik with daqp: one QP, the tasks weighted by costs from 1e3 down to 1e-3.
                The robot is a chain of hinges whose ranges are the box; tasks return the rows
                ready made, so that a robot's kinematics is in none of the times
    daqp        one call with break_points; it scales rows, and so resolves what cannot be met
                in a norm of its own. `rotated` first turns each level's rows among themselves to
                one length, which leaves nothing to scale; that turn is in none of the times
    projection  the strict recursion; it knows no limits

Wrong is an answer farther than 1e-6 from the reference optimum (tests/oracle.py).
"""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import daqp
import mink
import mujoco
import numpy as np
import tyro

import hqp_grasp as hg
from hqp_grasp.control.ik import solve_ik

try:
    import pink
    import pinocchio
except ImportError:  # the extra `bench` brings it
    pink = None

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from oracle import lexicographic_optimum
from problems import AMPLITUDE, Rows, scaling, three_level

BOX = 0.25  # of every problem [rad]
STEEP, FLAT = 3.0, -3.0  # exponents of the first and the last cost given to mink and pink
WRONG = 1e-6  # distance from the reference in any component
BLOCK = 50  # problems that a method answers in a row, before the next has its turn
WARM_UP = 3  # calls at the beginning of a block that are not counted
REFERENCE = "mink"
SIZES, SIZES_LEVELS = (6, 11, 16, 24, 32, 40, 50, 60), 4
LEVELS, LEVELS_SIZE = (2, 3, 4, 5, 6, 7, 8), 20
DRAWN = ("HQP proxqp", "HQP active-set", "mink", "pink", "daqp rotated", "projection")

FAILURES = (mink.NoSolutionFound, hg.SolverError, ArithmeticError)  # to answer at all
if pink is not None:
    FAILURES = (*FAILURES, pink.exceptions.NoSolutionFound)

Problem = Sequence[Rows]  # a box over all unknowns, then equality rows
Answer = tuple[np.ndarray, bool]  # x, and whether the solver asked for found it
Method = Callable[[Problem], Callable[[], Answer]]  # what is done before the clock runs, and after


def hierarchy(solver: str) -> Method:
    hqp = hg.HQP(solver)

    def prepare(problem: Problem) -> Callable[[], Answer]:
        def call() -> Answer:
            solution = hqp.solve([hg.Level(*rows) for rows in problem])
            return solution.x, solution.method == solver

        return call

    return prepare


def costs(tasks: int) -> np.ndarray:
    return np.logspace(STEEP, FLAT, tasks) if tasks > 1 else np.ones(1)


class MinkRows(mink.Task):
    """A x = b as a task of mink's."""

    def __init__(self, rows: Rows, cost: float):
        super().__init__(cost=np.full(len(rows.A), cost))
        self.A, self.minus_b = rows.A, -rows.upper

    def compute_error(self, configuration: mink.Configuration) -> np.ndarray:
        return self.minus_b

    def compute_jacobian(self, configuration: mink.Configuration) -> np.ndarray:
        return self.A


@cache
def mink_robot(n: int) -> tuple[mink.Configuration, list[mink.Limit]]:
    """A chain of n hinges at zero, in the middle of their ranges."""
    link = f'<body><joint type="hinge" axis="0 1 0" range="-{BOX} {BOX}"/><geom size="0.01"/>'
    chain = f"{link * n}{'</body>' * n}"
    xml = f'<mujoco><compiler angle="radian"/><worldbody>{chain}</worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(xml)
    return mink.Configuration(model), [mink.ConfigurationLimit(model, gain=1.0)]


def by_mink(problem: Problem) -> Callable[[], Answer]:
    configuration, limits = mink_robot(problem[0].A.shape[1])
    tasks = [MinkRows(r, c) for r, c in zip(problem[1:], costs(len(problem) - 1), strict=True)]
    return lambda: (mink.solve_ik(configuration, tasks, 1.0, "daqp", limits=limits), True)


def by_our_ik(solver: str) -> Method:
    def prepare(problem: Problem) -> Callable[[], Answer]:
        configuration, limits = mink_robot(problem[0].A.shape[1])
        tasks = [MinkRows(rows, 1.0) for rows in problem[1:]]
        return lambda: (solve_ik(configuration, tasks, 1.0, solver, limits=limits), True)

    return prepare


def pink_method() -> Method:
    """pink's solve_ik; its classes are made here because the package may be absent."""

    class PinkRows(pink.tasks.Task):
        def __init__(self, rows: Rows, cost: float):
            super().__init__(cost=np.full(len(rows.A), cost))
            self.A, self.minus_b = rows.A, -rows.upper

        def compute_error(self, configuration: Any) -> np.ndarray:
            return self.minus_b

        def compute_jacobian(self, configuration: Any) -> np.ndarray:
            return self.A

        def __repr__(self) -> str:
            return "PinkRows"

    @cache
    def robot(n: int) -> tuple[Any, list[Any]]:
        model = pinocchio.Model()
        parent = 0
        for j in range(n):
            place = pinocchio.SE3.Identity()
            parent = model.addJoint(parent, pinocchio.JointModelRY(), place, f"joint{j}")
        model.lowerPositionLimit[:] = -BOX
        model.upperPositionLimit[:] = BOX
        configuration = pink.Configuration(model, model.createData(), np.zeros(n))
        return configuration, [pink.limits.ConfigurationLimit(model, config_limit_gain=1.0)]

    def prepare(problem: Problem) -> Callable[[], Answer]:
        configuration, limits = robot(problem[0].A.shape[1])
        tasks = [PinkRows(r, c) for r, c in zip(problem[1:], costs(len(problem) - 1), strict=True)]
        return lambda: (pink.solve_ik(configuration, tasks, 1.0, "daqp", limits=limits), True)

    return prepare


def by_daqp(problem: Problem) -> Callable[[], Answer]:
    """One call of daqp with prioritised constraints; the box are its simple bounds."""

    def call() -> Answer:
        A = np.concatenate([rows.A for rows in problem[1:]])
        lower = np.concatenate([rows.lower for rows in problem])
        upper = np.concatenate([rows.upper for rows in problem])
        breaks = np.cumsum([len(rows.A) for rows in problem], dtype=np.int32)
        sense = np.zeros(len(upper), dtype=np.int32)
        x, _, flag, _ = daqp.solve(
            None, None, A, upper, lower, sense, breaks, rho_soft=1e-8, primal_tol=1e-9
        )
        if flag < 1:
            raise ArithmeticError(f"exit flag {flag}")
        return x, True

    return call


def turned(rows: Rows) -> Rows:
    """The same equality level, its rows rotated among themselves to equal length."""
    A, b = rows.A.copy(), rows.upper.copy()
    mean = np.mean(np.einsum("ij,ij->i", A, A))
    for i in range(len(A) - 1):  # row i gets the mean length, by turning it with a later one
        squares = np.einsum("ij,ij->i", A[i:], A[i:])
        j = i + int(np.argmax((squares - mean) * np.sign(mean - squares[0])))
        if j == i:
            continue  # it has it
        # ‖cos a_i + sin a_j‖² = mean, a quadratic in tan
        cross = A[i] @ A[j]
        quadratic = (A[j] @ A[j] - mean, 2.0 * cross, A[i] @ A[i] - mean)
        tan = np.roots(quadratic).real[0]
        cos = 1.0 / np.hypot(1.0, tan)
        turn = cos * np.array([[1.0, tan], [-tan, 1.0]])
        A[[i, j]], b[[i, j]] = turn @ A[[i, j]], turn @ b[[i, j]]
    return Rows(A, b, b)


def by_daqp_rotated(problem: Problem) -> Callable[[], Answer]:
    return by_daqp([problem[0], *(turned(rows) for rows in problem[1:])])


def by_projection(problem: Problem) -> Callable[[], Answer]:
    form = hg.Projection()
    return lambda: (form.solve([hg.Level(*rows) for rows in problem[1:]]).x, True)


def methods() -> dict[str, Method]:
    """What is compared, by name."""
    chosen: dict[str, Method] = {}
    for solver in ("proxqp", "active-set", "daqp"):
        chosen[f"HQP {solver}"] = hierarchy(solver)
    chosen["hg.solve_ik"] = by_our_ik("active-set")
    chosen["mink"] = by_mink
    if pink is not None:
        chosen["pink"] = pink_method()
    chosen["daqp break_points"] = by_daqp
    chosen["daqp rotated"] = by_daqp_rotated
    chosen["projection"] = by_projection
    return chosen


@dataclass
class Seen:
    """What one method did on one kind of problem."""

    times: list[float] = field(default_factory=list)  # [s]
    named: int = 0  # answers that the solver asked for found
    failed: int = 0
    wrong: int = 0

    def percentile(self, share: float) -> float:
        return 1e6 * float(np.percentile(self.times, share)) if self.times else np.nan


def compare(
    compared: dict[str, Method],
    draw: Callable[[np.random.Generator], Problem],
    entropy: Sequence[int],
    problems: int,
    checked: int,
) -> dict[str, Seen]:
    """Time all methods on problems i = 0, 1, … drawn from SeedSequence([…, i]).

    Interleaved in blocks: within one a method runs as it would in a loop of its own.
    """
    seen = {name: Seen() for name in compared}
    order = np.random.default_rng(np.random.SeedSequence(entropy))
    for first in range(0, problems, BLOCK):
        indices = range(first, min(first + BLOCK, problems))
        seeds = (np.random.SeedSequence([*entropy, i]) for i in indices)
        block = [draw(np.random.default_rng(s)) for s in seeds]
        optima = [lexicographic_optimum(p)[0] for p in block[: max(0, checked - first)]]
        for name in order.permutation(list(compared)):
            run_block(seen[name], [compared[name](problem) for problem in block], optima)
    return seen


def run_block(row: Seen, calls: list[Callable[[], Answer]], optima: list[np.ndarray]) -> None:
    """Time the calls one after the other, after a few that are not counted."""
    gc.collect()
    gc.disable()
    for i, call in enumerate([*calls[:WARM_UP], *calls], start=-min(WARM_UP, len(calls))):
        begin = time.perf_counter()
        try:
            x, named = call()
        except FAILURES:
            row.failed += i >= 0
            continue
        end = time.perf_counter()
        if i < 0:
            continue
        row.times.append(end - begin)
        row.named += named
        row.wrong += i < len(optima) and not np.abs(x - optima[i]).max() <= WRONG
    gc.enable()


def table(title: str, seen: dict[str, Seen], checked: int) -> None:
    """Print times, ratios to the reference, and how many answers are wrong."""
    print(f"\n{title}")
    print(
        f"{'':27}{'median':>8}{'ratio':>7}{'p99':>8}{'ratio':>7}{'p99/med':>9}"
        f"{'named':>9}{'wrong':>11}{'failed':>8}"
    )
    base = seen[REFERENCE]
    for name, row in seen.items():
        middle, late = row.percentile(50), row.percentile(99)
        named = f"{row.named / max(1, len(row.times)):.1%}"
        print(
            f"{name:27}{middle:8.0f}{middle / base.percentile(50):7.2f}"
            f"{late:8.0f}{late / base.percentile(99):7.2f}{late / middle:9.1f}"
            f"{named:>9}{f'{row.wrong} of {checked}':>11}{row.failed:8}"
        )


def draw_growth(growth: dict[str, dict[int, dict[str, Seen]]], path: Path) -> None:
    """Medians (lines) and p99 (dotted) over unknowns and over levels."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(growth), figsize=(10, 4.2), sharey=True)
    for axis, (label, points) in zip(axes, growth.items(), strict=True):
        at = list(points)
        for c, name in enumerate(n for n in DRAWN if n in points[at[0]]):
            middle = [points[v][name].percentile(50) for v in at]
            late = [points[v][name].percentile(99) for v in at]
            axis.plot(at, middle, color=f"C{c}", label=name, marker=".")
            axis.plot(at, late, color=f"C{c}", linestyle=":")
        axis.set(xlabel=label, yscale="log")
        axis.grid(alpha=0.3, which="both")
    axes[0].set_ylabel("time of one call [µs]: median, p99 dotted")
    axes[0].legend(fontsize=8)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    print(f"\nfigure  {path}")


def main(
    problems: int = 1000,
    checked: int = 50,
    seed: int = 0,
    sizes: bool = False,
    plot: Path = Path("out/solvers.png"),
) -> None:
    """Print medians, p99 and wrong answers of every method, in µs and as ratios to mink's.

    Args:
        problems: of each kind
        checked: of them, compared with the reference optimum (slow)
        seed: problem i of a kind draws from SeedSequence([seed, …, i])
        sizes: grow the number of unknowns and of levels instead, and plot it
        plot: where to
    """
    compared = methods()
    checked = min(checked, problems)
    note = "" if pink else "; pink is not installed: pip install pin-pink"
    print(f"{problems} problems each, seed {seed}, times in µs, ratios to {REFERENCE}'s{note}")
    if not sizes:
        for k, difficulty in enumerate(AMPLITUDE):
            seen = compare(
                compared,
                lambda rng, d=difficulty: three_level(rng, d),
                (seed, k),
                problems,
                checked,
            )
            title = f"{difficulty}: 11 unknowns, a box, then 3, 3 and 11 rows"
            table(title, seen, checked)
        return
    growth: dict[str, dict[int, dict[str, Seen]]] = {}
    for stream, label, points in (
        (10, f"unknowns (with {SIZES_LEVELS} levels)", [(n, SIZES_LEVELS) for n in SIZES]),
        (11, f"levels (with {LEVELS_SIZE} unknowns)", [(LEVELS_SIZE, count) for count in LEVELS]),
    ):
        growth[label] = {}
        for n, count in points:
            grown = n if stream == 10 else count
            seen = compare(
                compared,
                lambda rng, n=n, count=count: scaling(rng, n, count),
                (seed, stream, grown),
                problems,
                checked,
            )
            growth[label][grown] = seen
            table(f"{n} unknowns, {count} levels", seen, checked)
    draw_growth(growth, plot)


if __name__ == "__main__":
    tyro.cli(main)
