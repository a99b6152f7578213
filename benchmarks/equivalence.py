"""Three independent solutions of one hierarchy, on every grasp felt: one answer, with no limit.

    python benchmarks/equivalence.py --trials 10 --probes 40 --seed 0

Where no limit is active, proxqp, active-set and the projection give the same x. On every grasp the
paper's equation 11 is its hierarchy of two levels, J_f ẋ = J_f s_f ▷ ẋ = s_m with s the laws' steps
in contact space, and equation 13 is one damped level, ‖J q̇ − ẋ‖² + λ‖q̇ − q̇_c‖².

Where limits are active the forms part: the second table says what each leaves of the force law,
the first of the laws (see limits.py for the forms).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
import tyro
from limits import WORSE, force_left, steps

import hqp_grasp as hg
from hqp_grasp.control.forms import SR_DAMPING, TOUCH_RANK
from hqp_grasp.control.paper import contact_step, paper_levels

OBJECTS = {
    "cylinder, 5 cm": hg.Cylinder(radius=0.05),
    "cylinder, 6.5 cm": hg.Cylinder(radius=0.065),
    "hexagon, 6 cm": hg.Prism.regular(6, 0.06),
}
CAPS = {
    "wide": hg.StepLimit(joint=1.5, contact=0.3),
    "default": hg.StepLimit(),
    "tight": hg.StepLimit(joint=0.1, contact=0.01),
}
AGREE = 1e-8  # wanted of every gap


SOLVERS = ("proxqp", "active-set")


@dataclass
class Seen:
    """The grasps of one object and one choice of caps."""

    lost: int = 0  # trials
    gap_x: dict[str, list[float]] = field(default_factory=dict)  # [rad], no limit active
    gap_rows: list[float] = field(default_factory=list)  # of A x, in the laws' own units
    paper: dict[str, list[float]] = field(default_factory=dict)  # of eq. 11 [m] and 13 [rad]
    left: dict[str, list[float]] = field(default_factory=dict)  # force [N], a limit active

    @property
    def active(self) -> int:
        return len(self.left.get("hierarchy", []))

    @property
    def compared(self) -> int:
        return len(self.gap_rows)

    def add(self, stack: hg.Stack, grasp: hg.Grasp) -> None:
        """Compare all on one grasp."""
        self.add_paper(stack, grasp)
        levels, laws = stack.levels(grasp), stack.law_levels(grasp)
        hqps = [hg.HQP(solver, rank_tolerance=TOUCH_RANK) for solver in SOLVERS]
        found = {solver: hqp.solve(levels) for solver, hqp in zip(SOLVERS, hqps, strict=True)}
        if any(solution.limit_active for solution in found.values()):
            for name, x in steps(stack, grasp, hqps[0]).items():
                self.left.setdefault(name, []).append(force_left(grasp, x))
            return
        x = {solver: solution.x for solver, solution in found.items()}
        x["projection"] = hg.Projection(rank_tolerance=TOUCH_RANK).solve(laws).x
        for one, other in combinations(x, 2):
            gap = float(np.abs(x[one] - x[other]).max())
            self.gap_x.setdefault(f"{one} / {other}", []).append(gap)
        self.gap_rows.append(
            max(
                float(np.abs(level.A @ (x[one] - x[other])).max())
                for level in laws
                for one, other in combinations(x, 2)
            )
        )

    def add_paper(self, stack: hg.Stack, grasp: hg.Grasp) -> None:
        """Equations 11 and 13 against the hierarchies that they are."""
        force, moment = (hg.stack_of(letter) for letter in "fm")
        J_f = hg.ForceTask().contact_jacobian(grasp)
        eq_11 = [
            hg.Level.equal(J_f, J_f @ contact_step(force, grasp)),
            hg.Level.equal(np.eye(3 * grasp.k), contact_step(moment, grasp)),
        ]
        reach, rest = paper_levels(stack, grasp)
        root = np.sqrt(SR_DAMPING)
        eq_13 = hg.Level.equal(
            np.concatenate([reach.A, root * rest.A]), np.append(reach.lower, root * rest.lower)
        )
        known_11 = contact_step(hg.stack_of("fm"), grasp)
        known_13 = hg.Projection(damping=SR_DAMPING).solve([reach, rest]).x
        for solver in SOLVERS:
            hqp = hg.HQP(solver)
            for name, levels, known in (("11", eq_11, known_11), ("13", [eq_13], known_13)):
                gap = float(np.abs(hqp.solve(levels).x - known).max())
                self.paper.setdefault(f"eq. {name}, {solver}", []).append(gap)


def main(
    seed: int = 0,
    trials: int = 10,
    probes: int = 40,
    letters: str = "fmk",
) -> None:
    """Print the gaps between the solutions, and what limits change.

    Args:
        seed: trial i draws from SeedSequence([seed, i])
        trials: random starts of each object with each choice of caps
        probes: touches after the first one, in each trial
        letters: the laws in their order
    """
    seen: dict[tuple[str, str], Seen] = {}
    for shape, thing in OBJECTS.items():
        scene = hg.Scene(robot="wam_bhand", object=thing)
        probe = hg.GeometricProbe(scene)
        for name, cap in CAPS.items():
            stack = hg.stack_of(letters)
            stack = stack.within(cap, hg.ConfigurationLimit(scene.articulated))
            row = seen[shape, name] = Seen()
            for i in range(trials):
                record = hg.Trial(scene, stack, probes).run((seed, i), probe)
                row.lost += record.lost
                for grasp in record.grasps:
                    row.add(stack, grasp)
    print(f"{stack.name}, {trials} trials of {probes} probes each, seed {seed}")
    for name, cap in CAPS.items():
        print(f"  {name:8} caps: {cap.joint:g} rad, {cap.contact:g} m")
    print(f"\nlargest gaps (≤ {AGREE:g} wanted); no limit active: of x [rad], and of A x")
    pairs = [f"{one} / {other}" for one, other in combinations((*SOLVERS, "projection"), 2)]
    print(f"{'':26}{'grasps':>8}{'compared':>12}" + "".join(f"{p:>25}" for p in pairs) + "     A x")
    for (shape, name), row in seen.items():
        total = row.compared + row.active
        share = f"{row.compared} ({row.compared / total:.0%})"
        gaps = "".join(f"{max(row.gap_x.get(p, [np.nan])):25.1e}" for p in pairs)
        last = f"{max(row.gap_rows, default=np.nan):8.1e}"
        print(f"{shape:18}{name:8}{total:8}{share:>12}{gaps}{last}  lost {row.lost}")
    print("\nlargest gaps of the paper's equations to their hierarchies, on every grasp [m, rad]")
    forms_11_13 = [f"eq. {e}, {solver}" for e in (11, 13) for solver in SOLVERS]
    print(f"{'':26}" + "".join(f"{f:>20}" for f in forms_11_13))
    for (shape, name), row in seen.items():
        cells = "".join(f"{max(row.paper[f]):20.1e}" for f in forms_11_13)
        print(f"{shape:18}{name:8}{cells}")
    print("\na limit active: force left by one step [N], median and max; share above hierarchy's")
    forms = ("hierarchy", "clipped", "SR-inverse", "paper")
    head = "".join(f"{form:>{17 if form == 'hierarchy' else 22}}" for form in forms)
    print(f"{'':26}{'active':>7}{head}")
    for (shape, name), row in seen.items():
        if not row.active:
            continue
        least = np.array(row.left["hierarchy"])
        cells = []
        for form in forms:
            values = np.array(row.left[form])
            cell = f"{np.median(values):.0e} {values.max():.0e}"
            if form != "hierarchy":
                cell += f" {np.mean(values > least + WORSE):.0%}"
            cells.append(cell)
        text = f"{cells[0]:>17}" + "".join(f"{cell:>22}" for cell in cells[1:])
        print(f"{shape:18}{name:8}{row.active:7}{text}")


if __name__ == "__main__":
    tyro.cli(main)
