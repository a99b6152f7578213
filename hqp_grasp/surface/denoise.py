"""What was felt with noise, as one convex object explains it best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import csr_array
from scipy.special import chdtri

from hqp_grasp.grasp import Grasp, Touch
from hqp_grasp.mechanics import tangents
from hqp_grasp.surface.felt import contradicted

LEAST_NOISE = 1e-6  # [rad] of normals that are known
KNOWN = 2e-5 * 5.0 ** np.arange(4)  # [m] to which tips' centres may be known, the best first
UNLIKELY = 0.01  # of a misfit, or centres are taken to be known less
STEPS = 40  # of Newton's method; five to fifteen are usual
SETTLED = 0.01  # [–] squares of standard errors that a step still gains, at which it ends


def denoised(touches: Sequence[Touch]) -> tuple[Touch, ...]:
    """The same touches, with the likeliest normals that contacts of one convex object can have.

    Joint angles tell the centre c = x + ρ n of a round tip; a normal is felt with the noise σ about
    each axis across it, and its point turns with it. Sought are normals of the least
    Σ |n − n_felt|²/σ² for which

        n_j · (x_i − x_j) ≤ 0    and    |(ρ_j + ρ_i)(n_j − n_i) − (c_j − c_i)| ≤ |c_j − c_i|:

    all points lie behind every tangent plane, and (which follows) normals turn no faster than on an
    edge that the tips ride around. Touches of one place so agree on their mean, and those of a face
    on its direction. The true normals are of this kind, so that the misfit is at most theirs, of a
    chi-squared distribution: where it is larger, centres are taken to be known less well.

    A contact's noise becomes that of the quadratic model about the answer. What has no noise, what
    newer touches contradict, and what nothing explains, stays as it is.
    """
    hits = [t.felt for t in touches if isinstance(t.felt, Grasp)]
    contacts = [contact for grasp in hits for contact in grasp.contacts]
    noise = np.array([contact.noise for contact in contacts])
    if not noise.any():
        return tuple(touches)
    x, n = (np.concatenate([getattr(g, name) for g in hits]) for name in ("positions", "normals"))
    rho = np.array([contact.tip_radius for contact in contacts])
    probes = np.repeat(np.arange(len(hits)), [grasp.k for grasp in hits])
    valid = np.flatnonzero(~contradicted(x, n, probes, noise, rho))
    c, sigma = x + rho[:, None] * n, np.maximum(noise, LEAST_NOISE)
    for known in KNOWN:
        fit = _fitted(c[valid], n[valid], sigma[valid], rho[valid], known)
        if fit is not None and fit[2] <= chdtri(2 * len(valid), UNLIKELY):
            break
    else:
        return tuple(touches)
    for i, normal, error in zip(valid, *fit[:2], strict=True):
        if noise[i] > 0.0:
            at = c[i] - rho[i] * normal
            contacts[i] = replace(contacts[i], position=at, normal=normal, noise=float(error))
    rest = iter(contacts)
    return tuple(
        replace(t, felt=replace(t.felt, contacts=tuple(next(rest) for _ in t.felt.contacts)))
        if isinstance(t.felt, Grasp)
        else t
        for t in touches
    )


def _fitted(
    c: np.ndarray, felt: np.ndarray, sigma: np.ndarray, rho: np.ndarray, known: float
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Normals (N, 3), their errors (N,) [rad], and the misfit: the squares of both kinds of errors.

    None where Newton's method does not get there.
    """
    n, step, share, misfit = felt, np.zeros_like(felt), 1.0, np.inf
    for _ in range(STEPS):
        tried = n + share * step
        tried = tried / np.linalg.norm(tried, axis=1)[:, None]
        off = (tried - felt) / sigma[:, None]
        r, pairs, slopes = _broken(c, tried, rho, known)
        now = float((off * off).sum() + r @ r)
        if now > misfit:
            share *= 0.5
            continue
        n, misfit, share = tried, now, 1.0
        T = tangents(n)  # (N, 2, 3)
        by_turn = (T[pairs] @ slopes[..., None])[..., 0]  # (R, 2, 2)
        columns = 2 * pairs[..., None] + np.arange(2)
        rows = np.repeat(np.arange(len(r)), 4)
        A = csr_array((by_turn.ravel(), (rows, columns.ravel())), shape=(len(r), 2 * len(n)))
        gradient = (T @ (off / sigma[:, None])[..., None]).ravel() + A.T @ r
        H = np.diag(np.repeat(sigma**-2.0, 2)) + (A.T @ A).toarray()
        turn = np.linalg.solve(H, -gradient)
        if -gradient @ turn < SETTLED:
            error = np.sqrt(np.diag(np.linalg.inv(H)).reshape(-1, 2).mean(axis=1))
            return n, np.minimum(error, sigma), misfit
        step = (turn.reshape(-1, 1, 2) @ T)[:, 0]
    return None


def _broken(
    c: np.ndarray, n: np.ndarray, rho: np.ndarray, known: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """By how many errors of the centres r (R,) pairs (R, 2) of touches break either rule.

    With the derivatives by both normals (R, 2, 3).
    """
    x = c - rho[:, None] * n
    over = n @ x.T - (n * x).sum(axis=1)[:, None]  # [j, i] of x_i over the plane of x_j
    j, i = np.nonzero(over > 0.0)
    slopes = np.stack([x[i] - x[j], -rho[i, None] * n[j]], axis=1)
    p, q = np.triu_indices(len(c), 1)
    both, way = (rho[p] + rho[q])[:, None], c[p] - c[q]
    w = both * (n[p] - n[q]) - way
    far = np.linalg.norm(w, axis=1)
    beyond = far - np.linalg.norm(way, axis=1)
    fast = beyond > 0.0
    beyond, far, half = beyond[fast], far[fast], 0.5 * both[fast]
    e, bent = w[fast] / far[:, None], np.sqrt(beyond / far)[:, None, None]
    # The root of the exact second derivative of beyond².
    away = half[..., None] * (bent * np.eye(3) + (1.0 - bent) * e[:, :, None] * e[:, None])
    r = np.concatenate([over[j, i], (0.5 * beyond[:, None] * e).ravel()])
    turning = np.repeat(np.column_stack([p[fast], q[fast]]), 3, axis=0)
    pairs = np.concatenate([np.column_stack([j, i]), turning])
    slopes = np.concatenate([slopes, np.stack([away, -away], axis=2).reshape(-1, 2, 3)])
    return r / known, pairs, slopes / known
