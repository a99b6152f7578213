"""Throw random hierarchies at the solver; none may raise, diverge, or claim too much.

    python benchmarks/fuzz.py --problems 100000 --seed 0 --solver daqp --jobs 2

An answer is certified, or says that it is not; at most 10 of 100,000 may have to. The general kind
draws rank tolerances too, and rows of rounding dust; forces and joints are of the shapes that hands
and whole robots pose.

Problem i of seed s draws from SeedSequence([s, i]) and from nothing else, so that a failure listed
as `i` is repeated by `--seed s --first i --problems 1`. The answer may also be compared with the
reference optimum of the tests, computed slowly in many digits.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from tqdm import tqdm

from hqp_grasp import HQP, InputError, Level

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from oracle import OracleError, lexicographic_optimum
from problems import Rows, anything, forces, joints, near_singular_at_any_angle, three_level

CHUNK = 50  # problems handed to a worker at once
SHOWN = 40  # failures listed at most
AGREEMENT = 1e-6  # of ‖x‖, and of a level's miss in units of its rows, with the reference
FLOOR = 1e-9  # of the size of the problem: AGREEMENT × FLOOR of it is rounding


@dataclass(frozen=True)
class Options:
    """Random hierarchies: never an exception, never a non-finite x, never a false certificate."""

    problems: int = 5000
    """How many."""
    seed: int = 0
    """Problem i draws from SeedSequence([seed, i])."""
    first: int = 0
    """Index of the first problem: to repeat one, or to continue."""
    solver: str = "proxqp"
    """What solves them."""
    kind: Literal[
        "all",
        "general",
        "forces",
        "joints",
        "three_level-easy",
        "three_level-mid",
        "three_level-hard",
        "near_singular",
    ] = "all"
    """all: a tenth forces, a tenth joints, the others general. general: n 1–40, 1–8 levels,
    anything goes. forces: of 3, 5, 6 or 8 contacts, pyramids of 4–16 edges, torques within a box.
    joints: a step of 43, most limits touched, couplings. three_level: 11 unknowns, a box, three
    tasks. near_singular: two of three tasks at an angle of 1e-1 … 1e-16 rad."""
    against_oracle: bool = False
    """Compare with the reference optimum too (some 20 problems a second and job)."""
    budget: int = HQP().budget
    """Multiply-adds for one solve."""
    jobs: int = 2
    """Worker processes."""


@dataclass(frozen=True)
class Outcome:
    """What became of one problem."""

    index: int
    method: str  # what led to the answer, "none" where nothing did
    seconds: float  # of CPU time
    fault: str = ""  # empty: as it should be
    detail: str = ""
    shortest: bool = True  # shown to be


def make(kind: str, seed: int, index: int) -> tuple[list[Rows], float | None]:
    """The problem that (kind, seed, index) names, and its rank tolerance."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, index]))
    if kind == "all":
        kind = str(rng.choice(["forces", "joints", "general"], p=[0.1, 0.1, 0.8]))
    if kind == "general":
        return anything(rng)
    if kind in ("forces", "joints"):
        return (forces if kind == "forces" else joints)(rng), None
    if kind == "near_singular":
        return near_singular_at_any_angle(rng), None
    return three_level(rng, kind.removeprefix("three_level-")), None


def attempt(options: Options, index: int) -> Outcome:
    """Solve one problem and look for faults."""
    problem, tolerance = make(options.kind, options.seed, index)
    levels = [Level(*rows) for rows in problem]
    hqp = HQP(options.solver, tolerance, options.budget)
    started = time.process_time()
    try:
        answer = hqp.solve(levels)
    # That no exception of any kind comes is what is measured: each is counted, and told at the end.
    except Exception as error:
        seconds = time.process_time() - started
        return Outcome(index, "none", seconds, type(error).__name__, str(error))
    seconds = time.process_time() - started
    shortest = not answer.failed or "least norm" not in answer.failed[-1]
    outcome = partial(Outcome, index, answer.method, seconds, shortest=shortest)
    if not np.isfinite(answer.x).all():
        return outcome("not finite", str(answer.x))
    if not answer.certified:
        return outcome("not certified", "; ".join(answer.failed))
    if not answer.is_optimal(levels):
        return outcome("falsely certified", "")
    if options.against_oracle:
        try:
            x, misses = lexicographic_optimum(problem)
        except OracleError as error:
            return outcome("no reference", str(error))
        detail = disagreement(levels, answer.x, x, misses)
        if detail:
            return outcome("not the optimum", detail)
    return outcome()


def disagreement(levels: list[Level], x: np.ndarray, known: np.ndarray, misses: list) -> str:
    """Where x leaves the reference: a level's miss, or a length that is not the least."""
    length = np.linalg.norm(x) + FLOOR * reach(levels)
    for k, (level, miss) in enumerate(zip(levels, misses, strict=True)):
        nearest = np.clip(level.A @ x, level.lower, level.upper)
        unit = np.abs(nearest) + np.linalg.norm(level.A, axis=1) * length
        ours, theirs = np.linalg.norm(level.residual(x)), np.linalg.norm(miss)
        if abs(ours - theirs) > AGREEMENT * np.linalg.norm(unit):
            return f"level {k} is missed by {ours:.3e}, least is {theirs:.3e}"
    excess = np.linalg.norm(x) - np.linalg.norm(known)
    if excess > AGREEMENT * length:
        return f"x is {excess:.1e} longer than need be"
    return ""


def reach(levels: list[Level]) -> float:
    """The largest distance from x = 0 to a bound that it breaks: the size of the problem."""
    return max(
        (
            abs(w) / norm
            for level in levels
            for w, norm in zip(
                level.residual(np.zeros(level.A.shape[1])),
                np.linalg.norm(level.A, axis=1),
                strict=True,
            )
            if norm
        ),
        default=0.0,
    )


def attempts(options: Options, indices: range) -> list[Outcome]:
    """A chunk of problems, in one worker."""
    return [attempt(options, index) for index in indices]


def warm_up(options: Options) -> None:
    """Compile, or load what was compiled: no part of what a call costs."""
    HQP(options.solver).solve([Level(*rows) for rows in make(options.kind, 0, 0)[0]])


def run(options: Options) -> Iterator[Outcome]:
    """Outcomes in the order of their index."""
    stop = options.first + options.problems
    chunks = [range(i, min(i + CHUNK, stop)) for i in range(options.first, stop, CHUNK)]
    work = partial(attempts, options)
    if options.jobs == 1:
        for chunk in chunks:
            yield from work(chunk)
        return
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")  # one BLAS thread a worker, read as it starts
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(options.jobs, spawn, warm_up, (options,)) as pool:
        for outcomes in pool.map(work, chunks):
            yield from outcomes


def report(options: Options, outcomes: list[Outcome]) -> int:
    """Print the tables; return the number of failures."""
    total = len(outcomes)
    print(f"\n{total} problems, {options.kind}, seed {options.seed}, solver {options.solver}\n")
    print(f"{'method':<20}{'problems':>10}{'share':>9}{'median':>12}{'p99':>12}{'slowest':>12}")
    for method, count in Counter(o.method for o in outcomes).most_common():
        times = 1e6 * np.array([o.seconds for o in outcomes if o.method == method])
        median, late = np.median(times), np.percentile(times, 99)
        print(
            f"{method:<20}{count:>10}{count / total:>9.2%}{median:>9.0f} µs{late:>9.0f} µs"
            f"{times.max():>9.0f} µs"
        )
    slowest = max(outcomes, key=lambda o: o.seconds)
    print(f"\nslowest call {1e3 * slowest.seconds:.1f} ms of CPU time, problem {slowest.index}")
    print(f"not shown to be the shortest: {sum(not o.shortest for o in outcomes)}")
    failures = [o for o in outcomes if o.fault]
    print(f"\n{'fault':<20}{'problems':>10}")
    for fault in ("not finite", "falsely certified", "not certified"):
        print(f"{fault:<20}{sum(o.fault == fault for o in failures):>10}")
    if options.against_oracle:
        print(f"{'not the optimum':<20}{sum(o.fault == 'not the optimum' for o in failures):>10}")
    known = {"not finite", "falsely certified", "not certified", "not the optimum"}
    others = Counter(o.fault for o in failures if o.fault not in known)
    for fault, count in others.most_common():
        print(f"{fault:<20}{count:>10}")
    if not others:
        print(f"{'exceptions':<20}{0:>10}")
    for o in failures[:SHOWN]:
        print(f"  --seed {options.seed} --first {o.index} --problems 1: {o.fault} {o.detail[:300]}")
    if len(failures) > SHOWN:
        rest = ", ".join(str(o.index) for o in failures[SHOWN:])
        print(f"  and {rest}")
    return len(failures)


def main(options: Options) -> None:
    if min(options.problems, options.jobs) < 1 or min(options.seed, options.first) < 0:
        sys.exit("fuzz: problems and jobs must be ≥ 1, seed and first ≥ 0")
    try:
        HQP(options.solver, budget=options.budget)
    except InputError as error:
        sys.exit(f"fuzz: {error}")
    warm_up(options)
    progress = tqdm(run(options), total=options.problems, unit="problem", smoothing=0.05)
    sys.exit(1 if report(options, list(progress)) else 0)


if __name__ == "__main__":
    main(tyro.cli(Options))
