"""The paper's way to compose laws: nullspace recursion and SR-inverse, in numpy only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hqp_grasp.errors import InputError, number
from hqp_grasp.hierarchy.certificate import EPS
from hqp_grasp.hierarchy.level import (
    CERTIFICATE_TOLERANCE,
    Level,
    LevelReport,
    Solution,
    stack,
    tolerance_of,
)


@dataclass(frozen=True)
class Projection:
    """Solve a hierarchy of equalities by successive projection into nullspaces.

    With damping 0 it is the strict recursion of Siciliano & Slotine (1991),
    x_k = x_{k−1} + (A_k N_{k−1})⁺ (b_k − A_k x_{k−1}), where N_k projects on the nullspace of all
    levels so far. With damping λ > 0 every level is met in the sense of the SR-inverse
    J* = Jᵀ(JJᵀ + λI)⁻¹ (Nakamura & Hanafusa 1986): it moves away from a reference q_c only as far
    as ‖A_k x − b_k‖² + λ‖x − q_c‖² falls. q_c is what the last of several levels asks where that
    level determines x by itself, else 0; for the two levels J x = ẋ ▷ x = q̇_c this is exactly
    q̇ = J*ẋ + (I − J*J) q̇_c (paper, eq. 13), and for one level q̇ = J*ẋ.
    """

    damping: float = 0.0  # λ, in the squared units of A
    rank_tolerance: float | None = None  # [–] σ counts above this × ‖A_k‖₂; None: max(m, n)·eps

    def __post_init__(self) -> None:
        damping = number("damping", self.damping)
        if not 0.0 <= damping < np.inf:
            raise InputError(f"damping must be ≥ 0; got {self.damping}")
        object.__setattr__(self, "damping", damping)
        object.__setattr__(self, "rank_tolerance", tolerance_of(self.rank_tolerance))

    def solve(self, levels: Sequence[Level]) -> Solution:
        """Answer levels of equality rows only; raise InputError for any inequality row."""
        rows = stack(levels)
        if not (rows.lower == rows.upper).all():
            k = next(k for k, v in enumerate(levels) if not (v.lower == v.upper).all())
            raise InputError(
                f"Projection takes equality rows only, and level {k} has inequalities: "
                "leave such levels out, or use HQP"
            )
        n = rows.A.shape[1]
        reference = np.zeros(n)
        if self.damping > 0.0 and len(levels) > 1:
            A, b = levels[-1].A, levels[-1].upper
            U, sigma, Vt, rank = self._svd(A, A)
            if rank == n:
                reference = Vt[:n].T @ ((U[:, :n].T @ b) / sigma[:n])
        x = np.zeros(n)
        Z = np.eye(n)  # orthonormal basis of the freedom left
        reports = []
        for level in levels:
            A, b = level.A, level.upper
            U, sigma, Vt, rank = self._svd(A @ Z, A)
            U, sigma, V = U[:, :rank], sigma[:rank], Vt[:rank].T
            if self.damping > 0.0:
                start = x + Z @ (Z.T @ (reference - x))
                gain = sigma / (sigma**2 + self.damping)
                x = start + Z @ (V @ (gain * (U.T @ (b - A @ start))))
            else:
                x = x + Z @ (V @ ((U.T @ (b - A @ x)) / sigma))
            Z = Z @ Vt[rank:].T
            reports.append((level, rank))
        return Solution(
            x=x,
            levels=tuple(_report(level, x, rank) for level, rank in reports),
            active=np.full(len(rows.A), 2, dtype=np.int8),
            multipliers=np.zeros((len(rows.A), len(levels))),
            method="projection" if self.damping == 0.0 else "SR-inverse",
        )

    def _svd(self, M: np.ndarray, A: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
        if 0 in M.shape:
            return np.eye(len(M)), np.zeros(0), np.eye(M.shape[1]), 0
        U, sigma, Vt = np.linalg.svd(M)
        relative = max(A.shape) * EPS if self.rank_tolerance is None else self.rank_tolerance
        largest = np.linalg.svd(A, compute_uv=False)[
            0
        ]  # ‖A‖₂; np.linalg.norm takes three times as long
        rank = int((sigma > relative * largest).sum())
        return U, sigma, Vt, rank


def _report(level: Level, x: np.ndarray, rank: int) -> LevelReport:
    w = level.residual(x)
    scale = np.abs(level.upper) + np.linalg.norm(level.A, axis=1) * np.linalg.norm(x)
    met = bool((np.abs(w) <= CERTIFICATE_TOLERANCE * scale).all())
    return LevelReport(level.name, w, rank, "met" if met else "nearest")
