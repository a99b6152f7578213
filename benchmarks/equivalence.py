"""Hierarchy and projection on every grasp felt: one answer where no limit is active.

    python benchmarks/equivalence.py --trials 10 --probes 40 --seed 0

Where limits are active the forms part: the second table says what each leaves of the force law,
the first of the laws (see limits.py for the forms).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import tyro
from limits import WORSE, force_left, steps

import hqp_grasp as hg
from hqp_grasp.control.forms import TOUCH_RANK

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


@dataclass
class Seen:
    """The grasps of one object and one choice of caps."""

    lost: int = 0  # trials
    gap_x: list[float] = field(default_factory=list)  # [rad], no limit active
    gap_rows: list[float] = field(default_factory=list)  # in the laws' own units
    left: dict[str, list[float]] = field(default_factory=dict)  # force [N], a limit active

    @property
    def active(self) -> int:
        return len(self.left.get("hierarchy", []))

    def add(self, stack: hg.Stack, grasp: hg.Grasp, hqp: hg.HQP) -> None:
        """Compare the forms on one grasp."""
        solution = hqp.solve(stack.levels(grasp))
        if solution.limit_active:
            for name, x in steps(stack, grasp, hqp).items():
                self.left.setdefault(name, []).append(force_left(grasp, x))
            return
        laws = stack.law_levels(grasp)
        away = solution.x - hg.Projection(rank_tolerance=hqp.rank_tolerance).solve(laws).x
        self.gap_x.append(float(np.abs(away).max()))
        self.gap_rows.append(max(float(np.abs(level.A @ away).max()) for level in laws))


def main(
    seed: int = 0,
    trials: int = 10,
    probes: int = 40,
    letters: str = "fmk",
    solver: str = "proxqp",
    shortcuts: bool = True,
) -> None:
    """Print the gaps between hierarchy and projection, and what limits change.

    Args:
        seed: trial i draws from SeedSequence([seed, i])
        trials: random starts of each object with each choice of caps
        probes: touches after the first one, in each trial
        letters: the laws in their order
        solver: of the hierarchy
        shortcuts: turned off, every call goes through the QP solver
    """
    hqp = hg.HQP(solver, rank_tolerance=TOUCH_RANK, shortcuts=shortcuts)
    seen: dict[tuple[str, str], Seen] = {}
    for shape, thing in OBJECTS.items():
        scene = hg.Scene(robot="wam_bhand", object=thing)
        probe = hg.GeometricProbe(scene)
        for name, cap in CAPS.items():
            stack = hg.stack_of(letters)
            stack = stack.within(cap, hg.ConfigurationLimit(scene.articulated))
            row = seen[shape, name] = Seen()
            for i in range(trials):
                record = hg.Trial(scene, stack, probes, hg.HierarchyForm(hqp)).run((seed, i), probe)
                row.lost += record.lost
                for grasp in record.grasps:
                    row.add(stack, grasp, hqp)
    print(f"{stack.name}, {trials} trials of {probes} probes each, seed {seed}, {solver}")
    for name, cap in CAPS.items():
        print(f"  {name:8} caps: {cap.joint:g} rad, {cap.contact:g} m")
    print(f"\nno limit active: gaps between hierarchy and projection (≤ {AGREE:g} wanted)")
    print(f"{'':26}{'grasps':>8}{'compared':>12}{'gap x [rad]':>13}{'gap A x':>10}{'lost':>6}")
    for (shape, name), row in seen.items():
        count = len(row.gap_x)
        share = f"{count} ({count / (count + row.active):.0%})"
        gaps = f"{max(row.gap_x, default=np.nan):13.1e}{max(row.gap_rows, default=np.nan):10.1e}"
        print(f"{shape:18}{name:8}{count + row.active:8}{share:>12}{gaps}{row.lost:6}")
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
