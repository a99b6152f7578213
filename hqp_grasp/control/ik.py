"""Differential inverse kinematics in strict priority, for mink's tasks, limits and constraints."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import mink
import numpy as np
from mink.tasks import BaseTask

from hqp_grasp.errors import InputError, flag, instance, not_negative, positive
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.hierarchy.level import Level
from hqp_grasp.tasks.limit import Priority
from hqp_grasp.tasks.mink_rows import require_width, rows

Tasks = BaseTask | Sequence[BaseTask]  # that share a level


def solve_ik(
    configuration: mink.Configuration,
    priorities: Sequence[Tasks],
    dt: float,
    solver: str = "active-set",
    damping: float = 0.0,
    safety_break: bool = False,
    limits: Sequence[mink.Limit] | None = None,
    constraints: Sequence[mink.Task] | None = None,
) -> np.ndarray:
    """Return the velocity (nv,) that serves `priorities` in order, the first above all others.

    The arguments of mink.solve_ik in its order, with lists of tasks in the place of tasks; what
    each means is said at `ik_levels`. Nothing is infeasible: what cannot be met is met as nearly
    as the levels above allow. HQP(solver).solve(ik_levels(…)) tells which, and by how much.
    The compiled search answers unless another solver is named: it is the fastest, and exact.

    Raises InputError for malformed arguments, SolverError where no answer is certified, and with
    `safety_break`, as mink does, mink.NotWithinConfigurationLimits for a start outside the joint
    ranges.
    """
    instance("configuration", configuration, mink.Configuration)
    dt = positive("dt", dt)
    if flag("safety_break", safety_break):
        configuration.check_limits(safety_break=True)
    hqp = HQP(solver)
    levels = ik_levels(configuration, priorities, dt, damping, limits, constraints, hqp)
    return hqp.solve(levels).certified_x / float(dt)


def ik_levels(
    configuration: mink.Configuration,
    priorities: Sequence[Tasks],
    dt: float,
    damping: float = 0.0,
    limits: Sequence[mink.Limit] | None = None,
    constraints: Sequence[mink.Task] | None = None,
    hqp: HQP | None = None,
) -> list[Level]:
    """Return the levels over Δq (nv,): speed caps, joint ranges, other limits, constraints, tasks.

    Each limit and each constraint is a level of its own, those of a kind in the order given; where
    all can be met that order plays no part. `limits` None means mink's ConfigurationLimit.

    A priority is mink's objective ‖W Δq − e‖² + μ‖Δq‖², costs and gains included. μ, which is
    `damping` plus the tasks' Levenberg–Marquardt terms, would leave no freedom below: where
    μ > 0, `hqp` first solves the damped priority under the levels above, and the level asks for
    the W Δq found. A task with a dense Hessian H and slope c gives the rows √H Δq = −√H⁺ c.
    """
    instance("configuration", configuration, mink.Configuration)
    dt, damping = positive("dt", dt), not_negative("damping", damping)
    nv = configuration.nv
    if limits is None:
        limits = [mink.ConfigurationLimit(configuration.model)]
    limits = _listed(limits, "limits")
    for limit in limits:
        _require(limit, mink.Limit, "limits")
    levels = [_limit_level(limit, configuration, dt) for limit in sorted(limits, key=_priority)]
    for task in () if constraints is None else _listed(constraints, "constraints"):
        _require(task, mink.Task, "constraints")
        J, error = task.compute_jacobian(configuration), task.compute_error(configuration)
        require_width(task, J, nv)
        levels.append(Level.equal(J, -task.gain * error, type(task).__name__))
    dampings = [0.0] * len(levels)
    for priority in _listed(priorities, "priorities"):
        tasks = [priority] if isinstance(priority, BaseTask) else _listed(priority, "priorities")
        W, e, mu = _rows(tasks, configuration)
        levels.append(Level.equal(W, e, " + ".join(type(task).__name__ for task in tasks)))
        dampings.append(mu + damping)
    return (hqp or HQP("active-set")).damped(levels, dampings) if any(dampings) else levels


def _priority(limit: mink.Limit) -> Priority:
    if isinstance(limit, mink.VelocityLimit | mink.FreeJointVelocityLimit):
        return Priority.CAP
    return Priority.RANGE if isinstance(limit, mink.ConfigurationLimit) else Priority.CLEARANCE


def _limit_level(limit: mink.Limit, configuration: mink.Configuration, dt: float) -> Level:
    """Rows G Δq ≤ h; those of caps as shares of the cap [–]; opposite rows become one."""
    name, nv = type(limit).__name__, configuration.nv
    G, h = limit.compute_qp_inequalities(configuration, dt)
    if G is None or h is None:
        G, h = np.zeros((0, nv)), np.zeros(0)
    require_width(limit, G, nv)
    kept = h != np.inf
    if not kept.all():
        G, h = G[kept], h[kept]
    if _priority(limit) is Priority.CAP:
        unit = np.where(h > 0.0, h, 1.0)
        G, h = G / unit[:, None], h / unit
    half = len(h) // 2
    up, down = h[:half], -h[half:]
    if len(h) == 2 * half and (G[:half] == -G[half:]).all() and (down <= up).all():
        return Level(G[:half], down, up, name)
    return Level(G, np.full(len(h), -np.inf), h, name)


def _rows(
    tasks: Sequence[BaseTask], configuration: mink.Configuration
) -> tuple[np.ndarray, np.ndarray, float]:
    """W (m, nv), e (m,) and μ of tasks at equal priority."""
    Ws, es, mu = [np.zeros((0, configuration.nv))], [np.zeros(0)], 0.0
    for task in tasks:
        _require(task, BaseTask, "priorities")
        W, e, own = rows(task, configuration)
        Ws.append(W)
        es.append(e)
        mu += own
    return np.concatenate(Ws), np.concatenate(es), mu


def _listed(values: object, argument: str) -> list[Any]:
    if not isinstance(values, Iterable):
        raise InputError(f"{argument} must be a list, even of one; got {type(values).__name__}")
    return list(values)


def _require(value: object, kind: type, argument: str) -> None:
    if not isinstance(value, kind):
        raise InputError(
            f"{argument} must hold mink.{kind.__name__} objects; got {type(value).__name__}"
        )
