"""Intrinsic contact sensing: where a round fingertip is touched, from the wrench it feels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hqp_grasp.errors import InputError
from hqp_grasp.grasp import as_array


def sense(wrench: np.ndarray, tip: float | Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return position (3,) [m] and the object's outward unit normal (3,) of the contact.

    `wrench` (6,) is the force [N] and the torque [N·m] that the object applies to the tip, about
    the tip's centre; `tip` is the sphere's radius, or the ellipsoid's three semi-axes [m]. All is
    in the tip's frame, the position from its centre. The object may only push: force · normal > 0.

    One contact transmits a force f at c and a torque q about the normal there, m = c × f + q
    (Bicchi, Salisbury and Brock, "Contact sensing from force measurements", 1993). With
    A = diag(1/a, 1/b, 1/c) the ellipsoid is |u| = 1 for u = A c, its normal is along A u, and the
    equation turns into that of the unit sphere, m' = u × f' + K u with f' = A f and
    m' = A⁻¹ m det A; so one closed form serves both. On the unit sphere, with f' of length 1 and
    s = u · f' < 0, it follows that K s = f'·m' and K² − s² = |m'|² − 1, which give K and s, then
    u = (K m' + f' × m' + s f') / (K² + 1). Of K and s the larger is computed first: no
    cancellation, also where the torque about the normal vanishes.

    Raises InputError for a wrench without force, or one that no single contact can cause.
    """
    felt = as_array("sense: wrench", wrench, (6,))
    axes = as_array("sense: tip", [tip] * 3 if np.ndim(tip) == 0 else tip, (3,))
    if not (axes > 0.0).all():
        raise InputError(f"sense: a tip's radius or semi-axes are above 0 [m]; got {tip!r}")
    f = felt[:3] / axes
    length = np.linalg.norm(f)
    if length == 0.0:
        raise InputError("sense: the force is zero, so nothing touches; sense only what is felt")
    f = f / length
    m = felt[3:] * axes / (length * axes.prod())
    spin = float(f @ m)
    excess = float(m @ m) - 1.0  # > 0 where the line of force passes the tip by
    root = np.hypot(excess, 2.0 * spin)
    if excess > 0.0:
        if spin == 0.0:
            raise InputError(
                "sense: the line of force passes the tip by, and there is no torque about it: "
                "no contact pushes so; is the torque about the tip's centre, and the radius right?"
            )
        K = -np.sign(spin) * np.sqrt((root + excess) / 2.0)
        s = spin / K
    else:
        s = -np.sqrt((root - excess) / 2.0)
        K = spin / s if s else 0.0
    u = (K * m + np.cross(f, m) + s * f) / (K * K + 1.0)
    u /= np.linalg.norm(u)
    inward = u / axes
    return u * axes, -inward / np.linalg.norm(inward)
