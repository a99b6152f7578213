"""Contact forces by a strict hierarchy, beside one weighted QP and one second-order cone program.

    python benchmarks/forces.py --problems 200 --seed 0

k contacts lie around a lumpy ball of 5 cm in the WAM's BarrettHand, on its tips and other links,
about as far from one another, and carry a felt wrench. A problem is such a grasp turned by a
degree or so: the warm start comes from the grasp as it was. All solve the same problem one after
the other, so that whatever else the machine does meets all alike:

    hierarchy cold         hg.Grip's levels, certified; daqp finds the active rows
    hierarchy warm         the same, from the answer before the turn
    active-set cold        the compiled search by itself, from nothing
    proxqp cold            proxqp instead of daqp
    weighted QP            daqp: torques, pyramids and normal forces are constraints, the other laws
                           one cost, each level weighing 10 times what the next one does
    cone program           clarabel: the same cost and limits, with round cones for pyramids

Times are CPU times of the solve alone, matrices built before. Net force worse: by how much more it
is missed than by the hierarchy, at most. Margins are to the round cones.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import clarabel
import daqp
import numpy as np
import tyro
from scipy import sparse
from scipy.spatial.transform import Rotation

import hqp_grasp as hg
from hqp_grasp.control.forces import Felt
from hqp_grasp.mechanics import friction_demand, margin, tangents

LINKS = ("f1_tip", "f2_tip", "f3_tip", "bhand_palm", "f1_proximal", "f2_proximal", "f3_proximal")
LIMITS = 3  # of the levels: torques, pyramids, normal forces
ASKEW = 0.3  # [rad] of contacts from even ones around
STEP = 10.0  # [–] by which a level weighs more than the next one
TURNED = 0.02  # [rad] about each axis, between the grasps that a warm start is between
WEIGHT = 1.0  # [N] standard deviation of the felt force along each axis


def drawn(robot: hg.Robot, k: int, rng: np.random.Generator) -> tuple[hg.Grasp, np.ndarray]:
    """k contacts around a lumpy ball, and the wrench that they carry (6,)."""
    a = 2.0 * np.pi * np.arange(k) / k + ASKEW * rng.normal(size=k)
    n = np.column_stack([np.cos(a), np.sin(a), ASKEW * rng.normal(size=k)])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    middle = robot.centers(robot.home).mean(axis=0)
    x = middle + 0.05 * n + 0.005 * rng.normal(size=(k, 3))
    wrench = WEIGHT * rng.normal(size=6) * np.repeat([1.0, 0.02], 3)
    return _grasp(robot, x, n), wrench


def _grasp(robot: hg.Robot, x: np.ndarray, n: np.ndarray) -> hg.Grasp:
    contacts = tuple(
        hg.Contact(p, m, body=LINKS[i % len(LINKS)])
        for i, (p, m) in enumerate(zip(x, n, strict=True))
    )
    return hg.Grasp(robot.home, contacts, np.zeros((3 * len(x), robot.n)))


def turned(robot: hg.Robot, grasp: hg.Grasp, rng: np.random.Generator) -> hg.Grasp:
    """Nearly the same grasp, each normal turned a little."""
    turns = Rotation.from_rotvec(TURNED * rng.normal(size=(grasp.k, 3)))
    return _grasp(robot, grasp.positions, turns.apply(np.array(grasp.normals)))


def cost(levels: list[hg.Level]) -> tuple[np.ndarray, np.ndarray]:
    """H, c of ½ xᵀH x + cᵀx: the laws, weighted; margins aim at their lower end."""
    laws = levels[LIMITS:]
    H, c = 0.0, 0.0
    for place, level in enumerate(reversed(laws)):
        aim = STEP ** (2 * place)
        H = H + aim * level.A.T @ level.A
        c = c - aim * level.A.T @ level.lower
    return np.asarray(H), np.asarray(c)


def weighted(levels: list[hg.Level]) -> Callable[[], np.ndarray | None]:
    """The weighted QP, ready to be solved."""
    H, c = cost(levels)
    A = np.concatenate([level.A for level in levels[:LIMITS]])
    upper = np.concatenate([level.upper for level in levels[:LIMITS]])
    lower = np.maximum(np.concatenate([level.lower for level in levels[:LIMITS]]), -1e30)
    sense = np.zeros(len(A), dtype=np.int32)

    def solve() -> np.ndarray | None:
        x, _, flag, _ = daqp.solve(H, c, A, upper, lower, sense)
        return x if flag == 1 else None

    return solve


def conic(levels: list[hg.Level], felt: Felt) -> Callable[[], np.ndarray | None]:
    """The second-order cone program, ready to be solved."""
    H, c = cost(levels)
    k, mu = felt.grasp.k, felt.friction
    both = [levels[0], levels[2]]
    rows = [level.A for level in both] + [-level.A for level in both]
    ends = [level.upper for level in both] + [-level.lower for level in both]
    rows.append(np.concatenate([np.zeros((k, 3 * k)), -np.eye(k)], axis=1))  # margins ≥ 0
    ends.append(np.zeros(k))
    cones = [clarabel.NonnegativeConeT(sum(map(len, ends)))]
    across = tangents(felt.grasp.normals)
    for i in range(k):  # |t_i| ≤ µ a_i − √(1 + µ²) s_i
        row = np.zeros((3, 4 * k))
        row[0, : 3 * k] = -mu * felt.pushes[i]
        row[0, 3 * k + i] = np.hypot(1.0, mu)
        row[1:, 3 * i : 3 * i + 3] = -across[i]
        rows.append(row)
        ends.append(np.zeros(3))
        cones.append(clarabel.SecondOrderConeT(3))
    P, A = sparse.csc_matrix(np.triu(H)), sparse.csc_matrix(np.concatenate(rows))
    b = np.concatenate(ends)
    settings = clarabel.DefaultSettings()
    settings.verbose = False

    def solve() -> np.ndarray | None:
        found = clarabel.DefaultSolver(P, c, A, b, cones, settings).solve()
        return np.array(found.x) if found.status == clarabel.SolverStatus.Solved else None

    return solve


def main(problems: int = 200, contacts: tuple[int, ...] = (3, 6, 8, 12), seed: int = 0) -> None:
    """Print times and what each way finds.

    Args:
        problems: grasps for each number of contacts
        contacts: how many a grasp has
        seed: draws the grasps
    """
    robot = hg.Scene(robot="wam_bhand").articulated
    grip = hg.Grip(robot)
    search, proxqp = hg.HQP("active-set"), hg.HQP("proxqp")
    for k in contacts:
        rng = np.random.default_rng([seed, k])
        demand: list[float] = []
        times: dict[str, list[float]] = {}
        solved: dict[str, int] = {}
        worse: dict[str, list[float]] = {}
        margins: dict[str, list[float]] = {}
        for problem in range(problems + 1):
            grasp, wrench = drawn(robot, k, rng)
            before = grip.hqp.solve(grip.levels(grip.felt(grasp, wrench)))
            felt = grip.felt(turned(robot, grasp, rng), wrench)
            levels = grip.levels(felt)

            def certified(
                hqp: hg.HQP, warm: hg.Solution | None, levels=levels
            ) -> np.ndarray | None:
                found = hqp.solve(levels, warm)
                return found.x if found.certified else None

            ways = {
                "hierarchy cold": lambda: certified(grip.hqp, None),
                "hierarchy warm": lambda before=before: certified(grip.hqp, before),
                "active-set cold": lambda: certified(search, None),
                "proxqp cold": lambda: certified(proxqp, None),
                "weighted QP": weighted(levels),
                "cone program": conic(levels, felt),
            }
            begin = time.process_time()
            friction_demand(felt.grasp.positions, felt.grasp.normals)
            if problem:
                demand.append(time.process_time() - begin)
            best = None
            for name, solve in ways.items():
                begin = time.process_time()
                x = solve()
                took = time.process_time() - begin
                if problem == 0:  # the first one loads what is compiled
                    continue
                times.setdefault(name, []).append(took)
                solved[name] = solved.get(name, 0) + (x is not None)
                if x is None:
                    continue
                left = float(np.linalg.norm(levels[LIMITS].residual(x)))
                best = left if best is None else best
                forces = x[: 3 * k].reshape(k, 3)
                least = float(margin(forces, felt.grasp.normals, felt.friction).min())
                worse.setdefault(name, []).append(left - best)
                margins.setdefault(name, []).append(least)
        middle, late = np.percentile(demand, [50, 95])
        print(f"{k} contacts, {problems} problems; friction demand {1e6 * middle:.0f} µs, ", end="")
        print(f"95 % {1e6 * late:.0f}")
        print("                   median    p95  × cold  solved  net force  least margin")
        print("                     [µs]   [µs]                 worse [N]    median [N]")
        cold = np.median(times["hierarchy cold"])
        for name, took in times.items():
            middle, late = np.percentile(took, [50, 95])
            print(
                f"  {name:15}  {1e6 * middle:6.0f} {1e6 * late:6.0f}  {middle / cold:6.2f}  "
                f"{solved[name]:6}  {max(worse[name]):9.1e}  {np.median(margins[name]):12.3f}"
            )


if __name__ == "__main__":
    tyro.cli(main)
