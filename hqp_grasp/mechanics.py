"""Contact forces as statics sees them: what they add up to, and what friction they need.

Forces f_i (k, 3) [N] are those that the contacts apply *to the object*, world frame; those on the
fingertips are −f_i. Normals n_i point out of the object, so that a contact pushes by a_i = −n_i·f_i
≥ 0 and a unit force without friction is −n_i (paper, eq. 1). Leading axes are batches.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, QhullError

from hqp_grasp.errors import InputError, SolverError, positive
from hqp_grasp.grasp import UNIT_NORMAL_TOLERANCE, as_array
from hqp_grasp.kernels import njit

FLOOR = 0.2  # [–] of the mean normal force that each contact keeps: none only looks on
SECURE = 0.2  # [–] friction demand of a grasp that holds on nearly all that hands touch, at most
FLAT = 1e-9  # [–] singular value that counts as none, where the largest is about 1
MILD = 1e-2  # [–] singular value that is far from none
CENTRED = 0.25  # Newton decrement at which a point counts as the centre
SHARE = 0.9  # of the way to the boundary that a prediction goes
DEMANDED = 1e-9  # [–] to which the friction demand is found
STEPS = 500  # Newton steps at most


def tangents(normals: np.ndarray) -> np.ndarray:
    """Two unit vectors (…, k, 2, 3) across each unit normal (…, k, 3), and each other.

    The first is across the world's axis that the normal is farthest from: on upright walls it is
    level, and the second upright, so that pyramids carry weights by an edge.
    """
    least = np.abs(normals).argmin(axis=-1)
    first = cross(normals, np.eye(3)[least])
    first /= np.sqrt((first * first).sum(axis=-1, keepdims=True))
    return np.stack([first, cross(normals, first)], axis=-2)


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a × b along the last axis; np.cross costs several times as much on small arrays."""
    out = np.empty((*np.broadcast(a[..., 0], b[..., 0]).shape, 3))
    out[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    out[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    out[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return out


def net_wrench(forces: np.ndarray, positions: np.ndarray, about: np.ndarray) -> np.ndarray:
    """Σ f_i and Σ (x_i − c) × f_i, (…, 6) [N, N·m], of forces (…, k, 3), about c (…, 3) [m]."""
    lever = positions - about[..., None, :]
    return np.concatenate([forces.sum(axis=-2), cross(lever, forces).sum(axis=-2)], axis=-1)


def grasp_map(positions: np.ndarray, about: np.ndarray) -> np.ndarray:
    """G (…, 6, 3k): G f is the net wrench about c (…, 3) of forces f (…, 3k) at (…, k, 3).

    Blocks [I; [x_i − c]×] side by side (Murray, Li and Sastry, "A Mathematical Introduction to
    Robotic Manipulation", section 5.2, for point contacts and world axes).
    """
    x, y, z = np.moveaxis(positions - about[..., None, :], -1, 0)  # (…, k) each
    o = np.zeros_like(x)
    cross = np.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1).reshape(*x.shape, 3, 3)
    blocks = np.concatenate([np.broadcast_to(np.eye(3), cross.shape), cross], axis=-2)
    return np.moveaxis(blocks, -3, -2).reshape(*x.shape[:-1], 6, 3 * x.shape[-1])


def pyramids(normals: np.ndarray, friction: float, edges: int = 8) -> np.ndarray:
    """Friction pyramids inside the cones, (…, k, edges, 3): their rims, for a unit normal force.

    An edge is −n + µ (t₁ cos φ + t₂ sin φ); the pyramid is all that edges with weights ≥ 0 add up
    to. It keeps cos(π/edges) of the cone's friction, in the worst direction.
    """
    angle = 2.0 * np.pi * np.arange(edges) / edges
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    return friction * (circle @ tangents(normals)) - normals[..., None, :]


def pyramid_rows(normals: np.ndarray, friction: float, edges: int = 8) -> np.ndarray:
    """The same pyramids by their faces (…, k, edges, 3): f_i inside where every row·f_i ≤ 0.

    Rows have unit length, so that −row·f is the distance to that face [N].
    """
    angle = 2.0 * np.pi * (np.arange(edges) + 0.5) / edges
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    slope = friction * np.cos(np.pi / edges)
    rows = circle @ tangents(normals) + slope * normals[..., None, :]
    return rows / np.hypot(1.0, slope)


def margin(forces: np.ndarray, normals: np.ndarray, friction: ArrayLike) -> np.ndarray:
    """Distance of each force (…, k, 3) to the surface of its cone (…, k) [N], < 0 outside.

    (µ a − |t|)/√(1 + µ²), with a = −n·f the normal force and t the tangential one; measured on
    the side of the cone, past its tip too.
    """
    mu = np.asarray(friction, dtype=float)
    a = -(normals * forces).sum(axis=-1)
    t = np.linalg.norm(forces + a[..., None] * normals, axis=-1)
    return np.asarray((mu * a - t) / np.hypot(1.0, mu))


def arm(positions: np.ndarray) -> float:
    """The contacts' mean distance from their centroid [m], by which moments count as forces."""
    away = positions - positions.mean(axis=0)
    mean = float(np.sqrt((away * away).sum(axis=1)).mean())
    return mean if mean > 0.0 else 1.0  # all in one place: there are no moments


def friction_demand(positions: ArrayLike, normals: ArrayLike) -> float:
    """The least friction µ at which contacts (k, 3) [m], (k, 3) can balance: they hold above it.

    The least µ at which there are forces with |t_i| ≤ µ a_i, a_i ≥ 0.2 of their mean, and no net
    wrench; moments are about the contacts' centroid and over their mean distance from it. Inf where
    no µ does, as for one contact. For circular cones, to 1e-6; from above, for what is returned is
    what forces that were found need.
    With forces that balance f(w), affine in w, it is the minimum of max |t_i|/a_i, which has no
    local ones: minimised by the method of centres (Boyd and El Ghaoui, "Method of centers for
    minimizing generalized eigenvalues", 1993), each centre predicted from the last.
    """
    x = as_array("friction_demand: positions", positions, (None, 3))
    n = as_array("friction_demand: normals", normals, (len(x), 3))
    k = len(x)
    if k == 0:
        raise InputError("friction_demand needs a contact at least")
    if (np.abs((n * n).sum(axis=1) - 1.0) > 2.0 * UNIT_NORMAL_TOLERANCE).any():
        raise InputError(f"friction_demand: normals must be unit vectors; got {n.tolist()}")
    # Rows: the net wrench, and the sum of normal forces, which is k.
    M = np.concatenate([grasp_map(x, x.mean(axis=0)), -n.reshape(1, 3 * k) / np.sqrt(k)])
    M[3:6] /= arm(x)
    U, sigma, Vt = np.linalg.svd(M)
    rank = int((sigma > FLAT * sigma[0]).sum())
    rest = np.sqrt(k) * U[6]
    if (rest[rank:] ** 2).sum() > FLAT * k:  # what balances does not push
        return np.inf
    f = Vt[:rank].T @ (rest[:rank] / sigma[:rank])
    frame = np.concatenate([-n[:, None, :], tangents(n)], axis=1)  # (k, 3, 3)
    start = (frame @ f.reshape(k, 3, 1))[..., 0]
    basis = frame @ Vt[rank:].T.reshape(k, 3, 3 * k - rank)
    A = basis[:, 0]
    # A start: normal forces as equal as can be, by tangential ones of their size where those do.
    U, sigma, Vt = np.linalg.svd(A, full_matrices=False)
    along = U.T @ (1.0 - start[:, 0])
    for least in (MILD, FLAT):
        kept = sigma > least
        w = Vt[kept].T @ (along[kept] / sigma[kept])
        if (start[:, 0] + A @ w).min() > FLOOR + FLAT:
            break
    else:
        w = _widest(start[:, 0], A)
    return float(_least_friction(start, np.ascontiguousarray(basis), w))


def _widest(start: np.ndarray, A: np.ndarray) -> np.ndarray:
    """w that makes the least of start + A w (k,), whose sum is k, as large as can be."""
    k, p = A.shape
    found = linprog(
        np.append(np.zeros(p), -1.0),
        A_ub=np.column_stack([-A, np.ones(k)]),
        b_ub=start,
        bounds=(None, None),
    )
    if found.status != 0:
        raise SolverError(f"friction_demand: {found.message}")
    return np.asarray(found.x[:-1])


@njit(cache=True, error_model="numpy")
def _needed(start, basis, w, floor):  # type: ignore[no-untyped-def]
    """max |t_i|/a_i, inf where a normal force is not above the floor."""
    worst = 0.0
    for i in range(len(start)):
        force = start[i].copy()
        for j in range(len(w)):
            for c in range(3):
                force[c] += basis[i, c, j] * w[j]
        if not force[0] > floor:
            return np.inf
        worst = max(worst, np.hypot(force[1], force[2]) / force[0])
    return worst


@njit(cache=True, error_model="numpy")
def _solve(H, right):  # type: ignore[no-untyped-def]
    """Overwrite right (p, r) with H⁻¹ right by Cholesky; False where H is not positive."""
    p, r = right.shape
    for j in range(p):
        for i in range(j, p):
            s = H[i, j]
            for l in range(j):
                s -= H[i, l] * H[j, l]
            if i == j:
                if not s > 0.0:
                    return False
                H[j, j] = np.sqrt(s)
            else:
                H[i, j] = s / H[j, j]
    for c in range(r):
        for i in range(p):
            for l in range(i):
                right[i, c] -= H[i, l] * right[l, c]
            right[i, c] /= H[i, i]
        for i in range(p - 1, -1, -1):
            for l in range(i + 1, p):
                right[i, c] -= H[l, i] * right[l, c]
            right[i, c] /= H[i, i]
    return True


@njit(cache=True, error_model="numpy")
def _least_friction(start, basis, w):  # type: ignore[no-untyped-def]
    """Minimise max |t_i|/a_i over forces start + basis·w (k, 3), from a w inside.

    The centre at µ minimises −Σ log(µ² a_i² − |t_i|²) − Σ log(a_i − floor).
    """
    k, _, p = basis.shape
    best = _needed(start, basis, w, FLOOR)
    if p == 0 or best == np.inf:
        return best
    mu = 1.5 * best + DEMANDED
    H = np.empty((p, p))
    both = np.empty((p, 2))  # −gradient, and minus its change with µ; then the two steps
    dc = np.empty(p)
    for _ in range(STEPS):
        H[:] = 0.0
        both[:] = 0.0
        for i in range(k):
            a, u, v = start[i]
            for j in range(p):
                a += basis[i, 0, j] * w[j]
                u += basis[i, 1, j] * w[j]
                v += basis[i, 2, j] * w[j]
            room, above = (mu * a) ** 2 - u * u - v * v, a - FLOOR
            for j in range(p):
                A, U, V = basis[i, 0, j], basis[i, 1, j], basis[i, 2, j]
                dc[j] = 2.0 * (mu * mu * a * A - u * U - v * V)
                both[j, 0] += dc[j] / room + A / above
                both[j, 1] += 4.0 * mu * a * A / room - dc[j] * 2.0 * mu * a * a / room**2
                for l in range(j + 1):
                    B, S, T = basis[i, 0, l], basis[i, 1, l], basis[i, 2, l]
                    H[j, l] += dc[j] * dc[l] / room**2 + A * B / above**2
                    H[j, l] -= 2.0 * (mu * mu * A * B - U * S - V * T) / room
        downhill = both[:, 0].copy()
        if not _solve(H, both):
            break
        decrement = np.sqrt(max((downhill * both[:, 0]).sum(), 0.0))
        # Off the centre: towards it. On it: the step with µ too.
        centred = decrement < CENTRED
        step = both[:, 0] / (1.0 if centred else 1.0 + decrement)
        trial = w + step
        needed = _needed(start, basis, trial, FLOOR)
        if not needed < mu:
            break
        w = trial
        best = min(best, needed)
        if not centred:
            continue
        low, high = 0.0, mu
        while high > DEMANDED * (1.0 + mu) and low < SHARE * high:
            middle = 0.5 * (low + high)
            if _needed(start, basis, w - middle * both[:, 1], FLOOR) < mu - middle:
                low = middle
            else:
                high = middle
        down = SHARE * low
        if down < DEMANDED * (1.0 + mu):
            break
        w = w - down * both[:, 1]
        mu -= down
        best = min(best, _needed(start, basis, w, FLOOR))
    return best


def ferrari_canny(
    positions: ArrayLike, normals: ArrayLike, friction: float, edges: int = 8
) -> float:
    """ε [N per N]: the weakest wrench that normal forces of 1 N in all cannot resist; 0: some do.

    The largest ball about 0 inside the convex hull of the pyramids' edges, each with a unit normal
    force (Ferrari and Canny, "Planning optimal grasps", 1992, their L1 measure). Moments are about
    the contacts' centroid and over their mean distance from it.
    """
    x = as_array("ferrari_canny: positions", positions, (None, 3))
    n = as_array("ferrari_canny: normals", normals, (len(x), 3))
    mu = positive("ferrari_canny: friction", friction)
    rims = pyramids(n, mu, edges)  # (k, edges, 3)
    moments = np.cross((x - x.mean(axis=0))[:, None, :] / arm(x), rims)
    wrenches = np.concatenate([rims, moments], axis=2).reshape(-1, 6)
    spread = np.linalg.svd(wrenches - wrenches.mean(axis=0), compute_uv=False)
    if len(wrenches) < 7 or spread[-1] <= FLAT * spread[0]:
        return 0.0  # flat: what is across it is not resisted at all
    try:
        hull = ConvexHull(wrenches)
    except QhullError:  # flat to Qhull's rounding
        return 0.0
    return max(0.0, float(-hull.equations[:, -1].max()))
