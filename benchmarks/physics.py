"""What touching by force costs and brings: closing, convergence, noise, faults, speed.

python benchmarks/physics.py closing --starts 60
python benchmarks/physics.py convergence --trials 100
python benchmarks/physics.py figure5 --trials 20
python benchmarks/physics.py faults --trials 100
python benchmarks/physics.py wrong-model --trials 20
python benchmarks/physics.py speed
"""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib
import mujoco
import numpy as np
import tyro

matplotlib.use("Agg")
import matplotlib.pyplot as plt

import hqp_grasp as hg
from hqp_grasp.experiments.record import CONVERGED_FORCE, CONVERGED_MOMENT
from hqp_grasp.experiments.start import FirstTouch
from hqp_grasp.grasp import BEYOND
from hqp_grasp.world.imperfections import FAULTS, Fault

OBJECTS = {
    "cylinder": hg.Cylinder(radius=0.05),
    "cylinder_65": hg.Cylinder(radius=0.065),
    "hexagon": hg.Prism.regular(6, 0.05),
}


@dataclass(frozen=True, eq=False)
class Outcome:
    """How one trial went, by true errors where they are known."""

    record: hg.Record

    @property
    def eps(self) -> np.ndarray:
        """ε_f [N²] and √ε_m [mm·N] at each probe (p, 2), NaN without contact."""
        true = "eps_f_true" in self.record.rows[0]
        names = ("eps_f_true", "eps_m_true") if true else ("eps_f", "eps_m")
        force, moment = (self.record.column(name).astype(float) for name in names)
        return np.column_stack([force, 1e3 * np.sqrt(moment)])

    def first(self, force: float, moment: float) -> float:
        """First probe from which both stay below to the end; NaN if none."""
        good = (self.eps <= [force, moment]).all(axis=1)
        kept = np.logical_and.accumulate(good[::-1])[::-1]
        return float(np.argmax(kept)) if kept.any() else np.nan


def trial_of(
    thing: object,
    probe: str | hg.Physics,
    probes: int,
    robot: str = "wam_bhand",
    **settings: object,
) -> hg.Trial:
    """The paper's laws on one of OBJECTS."""
    scene = hg.Scene(robot=robot, object=thing)
    stack = hg.stack_of("fmk").within(hg.StepLimit(), hg.ConfigurationLimit(scene.articulated))
    return hg.Trial(scene, stack, probes, probe=probe, **{"links": "pass", **settings})


def run(trial: hg.Trial, trials: int, seed: int) -> list[Outcome]:
    """Trials 0 to `trials`; errors are kept."""
    return [Outcome(trial.attempt((seed, i))) for i in range(trials)]


def lost(outcomes: list[Outcome]) -> str:
    """Trials without contact at the end, and their last words."""
    ended = [o.record for o in outcomes if o.record.lost]
    why = Counter(
        r.error or str([x["outcome"] for x in r.rows if x["outcome"]][-1]).partition(" (")[0]
        for r in ended
    )
    return "; ".join(f"{count} × {reason}" for reason, count in why.most_common())


def closing(starts: int = 60, seed: int = 100) -> None:
    """Peak and steady force of guarded closing, and the largest of everything limited."""
    scene = hg.Scene(object=OBJECTS["cylinder"])
    geometric = hg.GeometricProbe(scene, "pass")
    drawn = [
        hg.Start().draw(scene, lambda _: geometric, np.random.default_rng([seed, i])).grasp.q
        for i in range(starts)
    ]
    for contact in ("medium", "stiff"):
        hand = hg.SimulatedHand(scene, hg.Physics(contact), links="pass")
        probe = hg.PhysicalProbe(hand, scene.articulated)
        peaks, steady, missed = [], [], Counter()
        largest = dict.fromkeys(hand.worst, 0.0)
        for q in drawn:
            hand.place(q)
            hand.worst = dict.fromkeys(hand.worst, 0.0)
            felt = probe.touch(q)
            largest = {name: max(v, hand.worst[name]) for name, v in largest.items()}
            if isinstance(felt, hg.Missed):
                missed[felt.reason.value] += 1
            else:
                peaks.append(hand.worst["force [N]"])
                steady += np.linalg.norm(hand.truth().forces, axis=1).tolist()
        print(f"{contact}: {starts} touches at 1 N, missed: {dict(missed) or 0}")
        print(
            f"  peak force   where felt: median {np.median(peaks):.2f}, largest {max(peaks):.2f} N"
        )
        low, middle, high = np.percentile(steady, [2.5, 50, 97.5])
        within = np.mean(np.abs(np.array(steady) - 1.0) <= 0.1)
        print(f"  steady force {low:.2f} / {middle:.2f} / {high:.2f} N; {within:.1%} within 10 %")
        print(
            "  largest at any step, misses and ways back included: "
            + ", ".join(f"{n} {v:.3g}" for n, v in largest.items())
        )


def convergence(
    trials: int = 100,
    probes: int = 15,
    seed: int = 101,
    objects: tuple[str, ...] = tuple(OBJECTS),
    supports: tuple[str, ...] = ("fixed", "pedestal"),
    links: str = "pass",
    timestep: float = 0.002,
) -> None:
    """Noise-free: shares converged and probes needed, beside the geometric probe's."""
    print(f"{trials} starts of seed {seed}, {probes} probes: converged, median and worst probe")
    moment = 1e3 * CONVERGED_MOMENT
    for name in objects:
        for way in ("geometric", *supports):
            physics = hg.Physics(support=way, timestep=timestep) if way in supports else way
            begin = time.process_time()
            trial = trial_of(OBJECTS[name], physics, probes, links=links)
            outcomes = run(trial, trials, seed)
            first = np.array([o.first(CONVERGED_FORCE, moment) for o in outcomes])
            line = f"{np.isfinite(first).sum():4} of {trials}, median {np.nanmedian(first):g}"
            line += f", worst {np.nanmax(first):g}"
            if way == "pedestal":
                moved = [1e3 * float(o.record.rows[-1]["object_moved"] or 0) for o in outcomes]
                line += f", object moved {np.median(moved):.2f} mm in the median"
                touch = [
                    np.diff(1e3 * o.record.column("object_moved").astype(float)[-3:])
                    for o in outcomes
                ]
                line += f", {np.nanmedian(np.abs(touch)):.3f} mm a probe once converged"
            print(f"{name:12}{way:10}{line}; {time.process_time() - begin:.0f} s CPU")
            if lost(outcomes):
                print(f"{'':22}lost: {lost(outcomes)}")


def interval(values: np.ndarray) -> str:
    """Mean with its 95 % interval, and standard deviation, by bootstrap."""
    rng = np.random.default_rng(0)
    means = [rng.choice(values, len(values)).mean() for _ in range(2000)]
    spreads = [rng.choice(values, len(values)).std(ddof=1) for _ in range(2000)]
    (a, b), (c, d) = (np.percentile(v, [2.5, 97.5]) for v in (means, spreads))
    return f"{values.mean():6.2f} [{a:.2f}, {b:.2f}] ± {values.std(ddof=1):.2f} [{c:.2f}, {d:.2f}]"


def figure5(
    trials: int = 20,
    probes: int = 25,
    seed: int = 102,
    robot: str = "umass_torso",
    timestep: float = 0.004,
    plot: Path = Path("out/figure5.png"),
) -> None:
    """The paper's experiment on the physical robot: 20 trials of 25 probes, with noise."""
    sets: dict[str, list[Outcome]] = {}
    for name, preset in (("noise-free", None), ("loadcell", "loadcell")):
        begin = time.process_time()
        physics = hg.Physics(timestep=timestep)
        trial = trial_of(
            OBJECTS["cylinder_65"], physics, probes, robot, links="block", preset=preset
        )
        outcomes = run(trial, trials, seed)
        seconds = time.process_time() - begin
        ended = sets[name] = [o for o in outcomes if not o.record.lost]
        print(f"{name}: {len(ended)} of {trials} finish; {seconds:.1f} s CPU; {lost(outcomes)}")
        for column in ("adduction_deg", "elevation_deg"):
            last = np.array([o.record.column(column).astype(float)[-1] for o in ended])
            print(f"  {column:14} {interval(last)}, median {np.median(last):.2f}")
        felt = [[o.record.column(c).astype(float)[-1] for c in ("eps_f", "eps_m")] for o in ended]
        middle = np.nanmedian(felt, axis=0)
        print(f"  felt   ε_f {middle[0]:.1e} N², √ε_m {1e3 * np.sqrt(middle[1]):.2f} mm·N, medians")
        force, moment = np.nanmedian([o.eps[-1] for o in ended], axis=0)
        print(f"  true   ε_f {force:.1e} N², √ε_m {moment:.2f} mm·N, medians")
        floor = [[o.record.column(f"floor_{a}")[-1] for a in "fm"] for o in ended]
        force, moment = np.nanmedian(floor, axis=0)
        print(f"  floor  ε_f {force:.1e} N², √ε_m {1e3 * np.sqrt(moment):.2f} mm·N, by noise alone")
    draw_figure5(sets, plot)


def draw_figure5(sets: dict[str, list[Outcome]], path: Path) -> None:
    """True errors over the probes, and where the hands began and ended; noisy over noise-free."""
    figure, axes = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
    for (name, outcomes), colour in zip(sets.items(), ("#0072b2", "#d55e00"), strict=True):
        eps = np.array([o.eps for o in outcomes])  # (trials, probes, 2)
        for a, axis in enumerate(axes[:2]):
            low, middle, high = np.nanpercentile(eps[..., a], [5, 50, 95], axis=0)
            axis.fill_between(np.arange(len(low)), low, high, color=colour, alpha=0.2)
            axis.plot(middle, color=colour, label=name)
        posture = np.array(
            [
                [o.record.column(c).astype(float) for c in ("adduction_deg", "elevation_deg")]
                for o in outcomes
            ]
        )
        if name == "noise-free":
            axes[2].plot(*posture[:, :, 0].T, "k.", label="start")
        axes[2].plot(*posture[:, :, -1].T, "o", mfc="none", color=colour, label=f"end, {name}")
    for axis, label in zip(axes, ("true ε_f [N²]", "true √ε_m [mm·N]"), strict=False):
        axis.set(yscale="log", xlabel="probe", ylabel=label)
    axes[2].set(xlabel="adduction [°]", ylabel="elevation [°]")
    for axis, place in zip(axes, ("upper right", "upper right", "center right"), strict=True):
        axis.legend(loc=place)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def faults(trials: int = 100, probes: int = 12, seed: int = 103) -> None:
    """Each fault at a random moment: what became of the trial, and of the limits."""
    about = hg.Imperfections.preset("loadcell")
    trial = trial_of(OBJECTS["cylinder"], hg.Physics(), probes)
    print(f"{trials} trials of {probes} probes, seed {seed}, a fault in each but the first line's")
    for kind in (None, *FAULTS):
        ends, false_claims, errors, reactions = Counter(), 0, Counter(), Counter()
        largest = dict.fromkeys(("peak_force", "peak_speed", "peak_torque", "limit_violation"), 0.0)
        begin = time.process_time()
        for i in range(trials):
            broken = () if kind is None else (random_fault(kind, (seed, i)),)
            physics = hg.Physics(imperfections=replace(about, faults=broken))
            record = replace(trial, probe=physics).attempt((seed, i))
            last = record.rows[-1]
            if record.error is not None:
                errors[record.error] += 1
            claimed = record.converged_at is not None
            false_claims += claimed and unbalanced(last)
            missed = [row["reaction"] for row in record.rows if row["reaction"]]
            reactions.update(what.partition(" by ")[0] for what in missed)
            gave_up = "gave up" in missed
            end = "balanced" if claimed else "gave up" if gave_up else "not balanced"
            ends[end + (" after a miss" if claimed and missed else "")] += 1
            for name in largest:
                seen = record.column(name)
                largest[name] = max(largest[name], float(np.nanmax(seen, initial=0.0)))
        print(
            f"{kind or 'none':8}{', '.join(f'{n} {what}' for what, n in sorted(ends.items()))}; "
            f"wrongly felt balanced {false_claims}; exceptions {dict(errors) or 0}; largest "
            f"{largest['peak_force']:.1f} N, {largest['peak_speed']:.2f} of a speed, "
            f"{largest['peak_torque']:.2f} of a torque, {largest['limit_violation']:.4f} rad out; "
            f"{time.process_time() - begin:.0f} s CPU"
        )
        print(f"{'':8}reactions: {dict(reactions.most_common())}")


def random_fault(kind: str, seed: tuple[int, int]) -> Fault:
    """One that begins in the first 15 s, at one finger, and lasts up to 4 s."""
    rng = np.random.default_rng([*seed, 7])
    lasts = 0.002 if kind == "spike" else float(rng.uniform(0.5, 4.0))
    return Fault(kind, int(rng.integers(3)), float(rng.uniform(0.0, 15.0)), lasts)


def unbalanced(row: dict[str, object]) -> bool:
    """Truly beyond BEYOND times the floor, or not in contact."""
    for axis in "fm":
        true, floor = row[f"eps_{axis}_true"], row[f"floor_{axis}"]
        if true is None or floor is None or not true <= BEYOND * floor:
            return True
    return False


def _begun(trial: hg.Trial, seed: int, i: int) -> FirstTouch:
    geometric = hg.GeometricProbe(trial.scene, "pass")
    return hg.Start().draw(trial.scene, lambda _: geometric, np.random.default_rng([seed, i]))


def wrong_model(trials: int = 20, probes: int = 15, seed: int = 104) -> None:
    """What the controller believes is wrong: size of the object, its place, the arm, friction."""
    moment = 1e3 * CONVERGED_MOMENT
    cases: dict[str, tuple[hg.Trial, tuple[float, float, float] | None]] = {}
    thing = OBJECTS["cylinder"]
    right = trial_of(thing, hg.Physics(), probes)
    cases["nothing wrong"] = right, None
    for factor in (0.25, 4.0):
        form = hg.HierarchyForm(size=factor * 0.05)
        cases[f"object's size × {factor:g}"] = replace(right, form=form), None
    offset = hg.Imperfections(arm_offset=np.radians(1.0))
    cases["arm off by 1°"] = replace(right, probe=hg.Physics(imperfections=offset)), None
    for friction in (0.3, 0.9, 1.2):
        cases[f"friction {friction:g}"] = replace(right, probe=hg.Physics(friction=friction)), None
    cases["object 2 cm away"] = right, (0.02, 0.0, 0.0)
    for name, (trial, shift) in cases.items():
        outcomes = []
        for i in range(trials):
            case = trial
            if shift is not None:
                # The start is of the place where the object was thought to be.
                start = _begun(trial, seed, i).grasp
                turned = np.random.default_rng([seed, i]).uniform(0.0, 2.0 * np.pi)
                place = np.array(trial.scene.position)
                place[:2] += shift[0] * np.array([np.cos(turned), np.sin(turned)])
                moved = replace(trial.scene, position=tuple(place.tolist()))
                case = replace(trial, scene=moved, start=start)
            outcomes.append(Outcome(case.attempt((seed, i))))
        first = np.array([o.first(CONVERGED_FORCE, moment) for o in outcomes])
        done = np.isfinite(first)
        print(
            f"{name:20} {done.sum():3} of {trials} converge"
            + (f", median probe {np.median(first[done]):g}" if done.any() else "")
            + (f"; lost: {lost(outcomes)}" if lost(outcomes) else "")
        )


def speed(probes: int = 20, seed: int = 105) -> None:
    """CPU of a probe beside that of the same bare steps, in one interleaved run."""
    scene = hg.Scene(object=OBJECTS["cylinder"])
    geometric = hg.GeometricProbe(scene, "pass")
    start = hg.Start().draw(scene, lambda _: geometric, np.random.default_rng(seed)).grasp
    for timestep in (0.002, 0.004):
        hand = hg.SimulatedHand(scene, hg.Physics(timestep=timestep), links="pass")
        hand.place(start.q)
        probe, data = hg.PhysicalProbe(hand, scene.articulated), mujoco.MjData(hand.model)
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        runs, whole, bare, simulated = [], 0.0, 0.0, 0.0
        simulate = hand._run

        def noting(ctrl: np.ndarray, runs=runs, hand=hand, simulate=simulate):
            runs.append((hand._state.copy(), ctrl))
            return simulate(ctrl)

        hand._run = noting
        for _ in range(probes):
            runs.clear()
            begin = time.process_time()
            probe.touch(start.q)
            whole += time.process_time() - begin
            for state, ctrl in runs:
                mujoco.mj_setState(hand.model, data, state, kind)
                begin = time.process_time()
                for row in ctrl:
                    data.ctrl[:] = row
                    mujoco.mj_step(hand.model, data)
                bare += time.process_time() - begin
            simulated += timestep * sum(len(ctrl) for _, ctrl in runs)
        print(
            f"{1e3 * timestep:g} ms: {1e3 * whole / probes:.1f} ms CPU a probe, bare steps "
            f"{1e3 * bare / probes:.1f} ms: × {whole / bare:.2f}; "
            f"{simulated / whole:.0f} simulated seconds a second, "
            f"{simulated / probes:.2f} s a probe"
        )


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict(
        {
            "closing": closing,
            "convergence": convergence,
            "figure5": figure5,
            "faults": faults,
            "wrong-model": wrong_model,
            "speed": speed,
        }
    )
