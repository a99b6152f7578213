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

import mujoco
import numpy as np
import tyro

import hqp_grasp as hg
from hqp_grasp.experiments.record import CONVERGED_FORCE, CONVERGED_MOMENT
from hqp_grasp.experiments.start import FirstTouch
from hqp_grasp.touch.imperfections import FAULTS, Fault

OBJECTS = {
    "cylinder": hg.Cylinder(radius=0.05),
    "cylinder_65": hg.Cylinder(radius=0.065),
    "hexagon": hg.Prism.regular(6, 0.05),
}
TIP = 0.008  # [m] radius of a fingertip
BEYOND = 4.0  # times the floor, from which on a grasp is truly unbalanced


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


def trial_of(thing: object, probe: str | hg.Physics, probes: int, **settings: object) -> hg.Trial:
    """The paper's laws on one of OBJECTS."""
    scene = hg.Scene(object=thing)
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
            peaks.append(hand.worst["force [N]"])
            largest = {name: max(v, hand.worst[name]) for name, v in largest.items()}
            if isinstance(felt, hg.Missed):
                missed[felt.reason.value] += 1
            else:
                steady += np.linalg.norm(hand.truth().forces, axis=1).tolist()
        print(f"{contact}: {starts} touches at 1 N, missed: {dict(missed) or 0}")
        print(f"  peak force   median {np.median(peaks):.2f}, largest {max(peaks):.2f} N")
        low, middle, high = np.percentile(steady, [2.5, 50, 97.5])
        within = np.mean(np.abs(np.array(steady) - 1.0) <= 0.1)
        print(f"  steady force {low:.2f} / {middle:.2f} / {high:.2f} N; {within:.1%} within 10 %")
        print("  largest at any step: " + ", ".join(f"{n} {v:.3g}" for n, v in largest.items()))


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


def figure5(trials: int = 20, probes: int = 25, seed: int = 102, timestep: float = 0.002) -> None:
    """The paper's experiment on the physical robot: 20 trials of 25 probes, with noise."""
    about = hg.Imperfections.preset("loadcell")
    floor_f, floor_m = about.floor(1.0, TIP, OBJECTS["cylinder_65"].radius)
    print(
        f"floor at 1 N: ε_f {floor_f:.1e} N², √ε_m {1e3 * np.sqrt(floor_m):.2f} mm·N "
        "(sensor noise alone)"
    )
    for name, preset in (("noise-free", None), ("loadcell", "loadcell")):
        begin = time.process_time()
        trial = trial_of(
            OBJECTS["cylinder_65"], hg.Physics(timestep=timestep), probes, preset=preset
        )
        outcomes = run(trial, trials, seed)
        seconds = time.process_time() - begin
        ended = [o for o in outcomes if not o.record.lost]
        print(f"{name}: {len(ended)} of {trials} finish; {seconds:.1f} s CPU; {lost(outcomes)}")
        for column in ("adduction_deg", "elevation_deg"):
            last = np.array([o.record.column(column).astype(float)[-1] for o in ended])
            print(f"  {column:14} {interval(last)}")
        felt = [[o.record.column(c).astype(float)[-1] for c in ("eps_f", "eps_m")] for o in ended]
        middle = np.nanmedian(felt, axis=0)
        print(f"  felt   ε_f {middle[0]:.1e} N², √ε_m {1e3 * np.sqrt(middle[1]):.2f} mm·N, medians")
        force, moment = np.nanmedian([o.eps[-1] for o in ended], axis=0)
        print(f"  true   ε_f {force:.1e} N², √ε_m {moment:.2f} mm·N, medians")


def faults(trials: int = 100, probes: int = 12, seed: int = 103) -> None:
    """Each fault at a random moment: what became of the trial, and of the limits."""
    about = hg.Imperfections.preset("loadcell")
    floor_f, _ = about.floor(1.0, TIP, 0.05)
    trial = trial_of(OBJECTS["cylinder"], hg.Physics(), probes)
    starts = [_begun(trial, seed, i) for i in range(trials)]
    for kind in (None, *FAULTS):
        ends, false_claims, errors, worst = Counter(), 0, Counter(), Counter()
        for i, start in enumerate(starts):
            rng = np.random.default_rng([seed, i, 7])
            broken: tuple[Fault, ...] = ()
            if kind is not None:
                lasts = 0.002 if kind == "spike" else float(rng.uniform(0.5, 4.0))
                broken = (Fault(kind, int(rng.integers(3)), float(rng.uniform(0.0, 15.0)), lasts),)
            physics = hg.Physics(imperfections=replace(about, faults=broken))
            hand = hg.SimulatedHand(start.scene, physics, "pass", rng)
            hand.place(start.grasp.q)
            probe = hg.PhysicalProbe(hand, start.scene.articulated)
            history, true = [hg.Touch(start.grasp.q, probe.touch(start.grasp.q))], [np.nan]
            controller = trial.controller(start.scene, i)
            reason = ""
            try:
                while len(history) <= probes and not reason:
                    step = controller.step(history)
                    if step.q_target is None:
                        reason = step.reason.partition(":")[0].partition(",")[0]
                        break
                    history.append(hg.Touch(step.q_target, probe.touch(step.q_target)))
                    grasp = hand.truth().grasp
                    true.append(np.nan if grasp is None else hg.ForceTask().potential(grasp))
            except Exception as error:  # counted: the campaign is about these
                errors[f"{type(error).__name__}: {error}"] += 1
            felt = history[-1].felt
            balanced = isinstance(felt, hg.Grasp) and (
                hg.ForceTask().potential(felt) <= BEYOND * floor_f
            )
            false_claims += balanced and not true[-1] <= BEYOND * floor_f
            ends["balanced" if balanced else ("gave up" if reason else "not balanced")] += 1
            worst.update({k: max(0.0, v - worst[k]) for k, v in hand.worst.items()})
        print(
            f"{kind or 'none':8} {trials} trials: {dict(ends)}; reported balanced and truly far "
            f"from it {false_claims}; exceptions {dict(errors) or 0}; largest "
            + ", ".join(f"{n} {v:.3g}" for n, v in worst.items())
        )


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
        stack = (
            hg.ForceTask(radius=factor * 0.05) >> hg.MomentTask() >> hg.KinematicTask()
        ).within(*right.stack.limits)
        cases[f"sphere radius × {factor:g}"] = replace(right, stack=stack), None
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
