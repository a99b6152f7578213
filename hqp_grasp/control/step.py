"""One step, written once: a share of what is asked that fits the caps, limits ▷ laws, certified."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hqp_grasp.control.limits import cap_ratio, room_left
from hqp_grasp.grasp import Grasp
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.hierarchy.level import Level, Solution
from hqp_grasp.hierarchy.projection import Projection
from hqp_grasp.tasks import Stack

ROUNDING = 1e-9  # [–, rad] of a solver, over a cap or a range; more is a bug
SHORTENINGS = 3  # of what is asked, until its step fits the caps


@dataclass(frozen=True, eq=False)
class Plan:
    """A step x = Δq, and how it was found."""

    x: np.ndarray  # (n,) [rad]
    solution: Solution
    limit_active: bool  # a limit holds or has cut the step
    gap: float | None  # [rad] ‖x − projection‖∞ where no limit is active, else None
    solve_us: float  # [µs]
    exact: bool = False  # x leads to a posture, joint by joint: it is not to be landed
    planner: str = ""  # the rule that planned: "memoryless", "paper-hierarchy", …
    reason: str = ""  # why it is another step than the laws ask for


def fitting(
    asked: Callable[[float], list[Level]],
    below: list[Level],
    stack: Stack,
    grasp: Grasp,
    hqp: HQP,
    gain: float = 1.0,
) -> tuple[list[Level], np.ndarray, bool]:
    """What to ask for, so that its step fits the caps; that step; whether it is less than all.

    `asked(share)` gives the levels for a share of the way, at most `gain`. Caps alone would give
    the first law all that they allow, joint by joint, and leave the others the rest: priorities
    would hold, and the step lose its direction. So all are asked for the same share, those `below`
    too. Where the whole way fits, it is gone, and those below take the room that it leaves.
    """
    projection = Projection(rank_tolerance=hqp.rank_tolerance)
    search = HQP("active-set", rank_tolerance=hqp.rank_tolerance)
    held = lambda levels: stack.damped(levels, grasp, search)  # noqa: E731
    levels, x, less = _shared(lambda s: held(asked(s)), stack, grasp, projection, gain)
    if not below:
        return levels, x, less
    if less:
        rest = scaled(below)
        together = lambda share: held([*asked(share), *rest(share / gain)])  # noqa: E731
        return _shared(together, stack, grasp, projection, gain)
    below = held([*levels, *below])[len(levels) :]
    more = projection.solve([*levels, *below]).x - x
    room = room_left(x, more, stack, grasp)
    left = [Level.equal(v.A, v.A @ x + room * (v.upper - v.A @ x), v.name) for v in below]
    return [*levels, *left], x + room * more, room < 1.0


def _shared(
    asked: Callable[[float], list[Level]],
    stack: Stack,
    grasp: Grasp,
    projection: Projection,
    gain: float,
) -> tuple[list[Level], np.ndarray, bool]:
    share = gain
    for _ in range(SHORTENINGS):
        levels = asked(share)
        x = projection.solve(levels).x
        ratio = cap_ratio(x, stack, grasp)
        if ratio <= 1.0 + ROUNDING:
            break
        share /= ratio
    return levels, x, share < gain


def scaled(levels: list[Level]) -> Callable[[float], list[Level]]:
    """A share of each level's demand."""
    return lambda share: [Level.equal(v.A, share * v.upper, v.name) for v in levels]


def strict_step(
    hqp: HQP,
    stack: Stack,
    grasp: Grasp,
    asked: Callable[[float], list[Level]],
    planner: str,
    gain: float = 1.0,
    below: list[Level] | None = None,
) -> Plan:
    """The certified answer of the limits and as many of the levels asked for as have one.

    In a strict hierarchy the answer of the first levels is theirs whatever is asked below: where
    the whole is not certified, the last level is left out, and so on. Where not even limits are
    certified, the hand stays.
    """
    begin = time.perf_counter()
    wanted, unlimited, shortened = fitting(asked, below or [], stack, grasp, hqp, gain)
    levels = [*stack.limit_levels(grasp), *wanted]
    least = max(1, len(levels) - len(wanted))
    solution, left_out = hqp.solve(levels), []
    while not solution.certified and len(levels) > least:
        left_out.append(levels.pop().name)
        solution = hqp.solve(levels)
    limit_active = shortened or solution.limit_active
    x, reason = solution.x, ""
    if not solution.certified:
        x, reason = np.zeros(grasp.n), "the hand stays: no answer is certified"
    elif left_out:
        reason = f"without {' and '.join(left_out[::-1])}: their answer is not certified"
    gap = None if limit_active or reason else float(np.abs(x - unlimited).max())
    solve_us = 1e6 * (time.perf_counter() - begin)
    return Plan(x, solution, limit_active, gap, solve_us, planner=planner, reason=reason)
