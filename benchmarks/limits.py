"""What a limit that is active throughout does to the force law, in each form of the composition.

    python benchmarks/limits.py --joint bhand_f1_spread --half-width 0.1 --trials 10

One joint may move by no more than HALF_WIDTH from where the trial starts, while the kinematic law
asks for more at every probe. On the same grasps, those felt by the hierarchy's trials, a step is
taken in each form:

    hierarchy    HQP, the limits above the laws
    clipped      strict projection of the same laws, scaled to the caps, clipped to the ranges
    SR-inverse   the same laws with SR-inverses, scaled and clipped likewise
    paper        gradients in contact space and SR-inverse (eq. 11-13), scaled and clipped likewise
"""

from __future__ import annotations

import numpy as np
import tyro

import hqp_grasp as hg
from hqp_grasp.control.forms import FORMS, SR_DAMPING, TOUCH_RANK, clip_to_limits, form_of
from hqp_grasp.control.paper import paper_levels

WORSE = 1e-6  # [N] more than the hierarchy leaves
OBJECT = hg.Cylinder(radius=0.05)


def narrowed(joint: str, middle: float, half_width: float) -> hg.Robot:
    """The robot with one range narrowed to middle ± half_width [rad], where it was wider."""
    scene = hg.Scene(robot="wam_bhand", object=OBJECT)
    span = scene.model.jnt_range[scene.model.joint(joint).id]
    span[:] = max(span[0], middle - half_width), min(span[1], middle + half_width)
    return scene.articulated


def steps(stack: hg.Stack, grasp: hg.Grasp, hqp: hg.HQP) -> dict[str, np.ndarray]:
    """x (n,) [rad] in each form."""
    laws = stack.law_levels(grasp)
    strict = hg.Projection(rank_tolerance=hqp.rank_tolerance).solve(laws).x
    damped = hg.Projection(damping=SR_DAMPING)
    return {
        "hierarchy": hqp.solve(stack.levels(grasp)).x,
        "clipped": clip_to_limits(strict, stack, grasp),
        "SR-inverse": clip_to_limits(damped.solve(laws).x, stack, grasp),
        "paper": clip_to_limits(damped.solve(paper_levels(stack, grasp)).x, stack, grasp),
    }


def force_left(grasp: hg.Grasp, x: np.ndarray) -> float:
    """‖J_f x + f‖ [N], the net force of unit contact forces that the step leaves."""
    A, b = hg.ForceTask().rows(grasp)
    return float(np.linalg.norm(A @ x - b))


def main(
    seed: int = 0,
    trials: int = 10,
    probes: int = 30,
    joint: str = "bhand_f1_spread",
    half_width: float = 0.1,
    solver: str = "proxqp",
) -> None:
    """Print the force that each form leaves where a limit is active throughout.

    Args:
        seed: trial i draws from SeedSequence([seed, i])
        trials: random starts
        probes: touches after the first one, in each trial
        joint: whose range is narrowed
        half_width: of the range, around the start [rad]
        solver: of the hierarchy
    """
    scene = hg.Scene(robot="wam_bhand", object=OBJECT)
    probe = hg.GeometricProbe(scene)
    hqp = hg.HQP(solver, rank_tolerance=TOUCH_RANK)
    laws = hg.stack_of("fmk")
    runs: dict[str, list[hg.Record]] = {form: [] for form in FORMS}
    left: dict[str, list[float]] = {}
    outside: dict[str, float] = {}
    felt_outside, active = 0.0, 0
    for i in range(trials):
        rng = np.random.default_rng(np.random.SeedSequence((seed, i)))
        q_start = hg.Start().draw(scene, lambda _: probe, rng).grasp.q
        robot = narrowed(joint, q_start[scene.articulated.index(joint)], half_width)
        stack = laws.within(hg.StepLimit(), hg.ConfigurationLimit(robot))
        for name in FORMS:
            trial = hg.Trial(scene, stack, probes, form_of(name, solver))
            runs[name].append(trial.run((seed, i)))
        record = runs["hierarchy"][-1]
        active += int(record.column("limit_active").sum())
        felt_outside = max(felt_outside, *(robot.violation(grasp.q) for grasp in record.grasps))
        for grasp in record.grasps:
            for name, x in steps(stack, grasp, hqp).items():
                left.setdefault(name, []).append(force_left(grasp, x))
                outside[name] = max(outside.get(name, 0.0), robot.violation(grasp.q + x))
    taken = sum(len(record.grasps) - 1 + record.lost for record in runs["hierarchy"])
    print(f"cylinder of 5 cm, {joint} within ±{half_width} rad of its start, seed {seed}, {solver}")
    print(f"{trials} trials of {probes} probes, a limit active in {active} of {taken} steps")
    print(f"\nforce left by one step [N], over the {len(left['hierarchy'])} grasps felt")
    print(f"{'':16}{'median':>10}{'max':>10}{'more than hierarchy':>22}{'outside [rad]':>16}")
    least = np.array(left["hierarchy"])
    for name, values in left.items():
        more = np.mean(np.array(values) > least + WORSE)
        share = "–" if name == "hierarchy" else f"{more:.1%}"
        row = f"{name:16}{np.median(values):10.1e}{max(values):10.1e}"
        print(f"{row}{share:>22}{outside[name]:16.1e}")
    print(f"\nlargest violation felt in the hierarchy's trials: {felt_outside:g} rad")
    print(f"\nafter {probes} probes in each form")
    print(f"{'':16}{'median √ε_f [N]':>18}{'max':>10}{'lost':>8}")
    for form, records in runs.items():
        ends = [np.sqrt(r.rows[-1]["eps_f"]) for r in records if not r.lost]
        lost = sum(record.lost for record in records)
        middle, worst = (np.median(ends), max(ends)) if ends else (np.nan, np.nan)
        print(f"{form:16}{middle:18.1e}{worst:10.1e}{lost:8}")


if __name__ == "__main__":
    tyro.cli(main)
