"""What mink's tasks ask for, as weighted rows over all joints of a model."""

from __future__ import annotations

import threading

import mink
import mujoco
import numpy as np
from mink.tasks import BaseTask

from hqp_grasp.errors import InputError

ROUNDING = 1e-12  # [–] share of a dense Hessian's largest eigenvalue that counts as zero

_last = threading.local()  # each thread's configuration; a new one costs more than all its tasks


def configuration_of(model: mujoco.MjModel, q: np.ndarray, owner: str) -> mink.Configuration:
    """The model at q (nq,), good until it is asked for again."""
    if len(q) != model.nq:
        raise InputError(
            f"{owner} speaks of a model with {model.nq} joint coordinates, the grasp has "
            f"{len(q)}: was it built for another robot?"
        )
    configuration: mink.Configuration | None = getattr(_last, "configuration", None)
    if configuration is None or configuration.model is not model:
        configuration = _last.configuration = mink.Configuration(model, q)
    elif not np.array_equal(configuration.data.qpos, q):
        configuration.update(q)
    return configuration


def rows(task: BaseTask, configuration: mink.Configuration) -> tuple[np.ndarray, np.ndarray, float]:
    """W (m, nv), e (m,) and μ of mink's objective ‖W Δq − e‖² + μ‖Δq‖², costs and gain included.

    Rows without a cost ask for nothing, and are left out.
    """
    built_for = getattr(task, "nq", configuration.nq)
    if built_for != configuration.nq:
        raise InputError(
            f"{type(task).__name__} is of a model with {built_for} joint coordinates, the robot "
            f"has {configuration.nq}: was it built for another model?"
        )
    W, e, mu = task.compute_qp_residual(configuration) or _dense(task, configuration)
    require_width(task, W, configuration.nv)
    asks = W.any(axis=1) | (e != 0.0)
    return (W, e, mu) if asks.all() else (W[asks], e[asks], mu)


def _dense(
    task: BaseTask, configuration: mink.Configuration
) -> tuple[np.ndarray, np.ndarray, float]:
    """Rows whose least squares is ½ Δqᵀ H Δq + cᵀ Δq up to a constant: H = WᵀW, c = −Wᵀe."""
    name = type(task).__name__
    H, c = task.compute_qp_objective(configuration)
    if not (np.isfinite(H).all() and np.isfinite(c).all()):
        raise InputError(f"{name}: its objective (H, c) is not finite")
    value, V = np.linalg.eigh(H)
    zero = ROUNDING * np.abs(value).max(initial=0.0)
    kept = value > zero
    if (value < -zero).any():
        raise InputError(f"{name}: its Hessian has the negative eigenvalue {value[0]:.1e}")
    slope = V.T @ c
    if (np.abs(slope[~kept]) > np.sqrt(ROUNDING) * np.abs(slope).max(initial=0.0)).any():
        raise InputError(f"{name}: its objective falls for ever, c is outside the range of H")
    root = np.sqrt(value[kept])
    return root[:, None] * V[:, kept].T, -slope[kept] / root, 0.0


def require_width(owner: object, A: np.ndarray, nv: int) -> None:
    """Raise InputError unless rows are over the nv degrees of freedom of a configuration."""
    if A.ndim != 2 or A.shape[1] != nv:
        raise InputError(
            f"{type(owner).__name__} has rows of shape {A.shape}, the configuration {nv} "
            "degrees of freedom; was it built for another model?"
        )
