"""The command line of a scenario: settings in, trials run, a table and a figure out."""

from __future__ import annotations

import shlex
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import tyro

from hqp_grasp.control.forms import form_of
from hqp_grasp.control.limits import ConfigurationLimit, StepLimit
from hqp_grasp.errors import HqpGraspError, InputError, ResultsError, TrialError
from hqp_grasp.experiments.plain import speak_plainly
from hqp_grasp.experiments.plots import convergence
from hqp_grasp.experiments.record import (
    CONVERGED_FORCE,
    CONVERGED_MOMENT,
    TRUE_COLUMNS,
    VERDICTS,
    balanced,
    holds,
    known,
    says_something,
    secures,
    verdicts,
)
from hqp_grasp.experiments.replay import frames_of_rows, need_viser, rows_of, write_replay
from hqp_grasp.experiments.study import Study
from hqp_grasp.experiments.trial import Trial
from hqp_grasp.experiments.view import PORT, serve
from hqp_grasp.grasp import BEYOND
from hqp_grasp.mechanics import SECURE
from hqp_grasp.tasks import Stack, stack_of
from hqp_grasp.touch.noisy import Noise
from hqp_grasp.world.scene import Scene

# What the table on screen and the figure are made of.
COLUMNS = (
    *("trial", "probe", "rejected", "error", "unbalanced"),
    *("eps_f", "eps_m", "goal_f", "goal_m", "eps_k", "friction_demand", "adduction_deg"),
    *("elevation_deg", "in_contact", "other_links", "in_transit", "step_share"),
    *("limit_active", "limit_violation", "hqp_projection_gap", "method"),
)
# Settings that no trial reads.
ABOUT_THE_RUN = {"trials", "seed", "jobs", "cluster", "out", "strict", "replay", "view", "port"}


@dataclass(frozen=True)
class Settings:
    """How to run a scenario; every value has a sensible default."""

    stack: str = "fmk"
    """Laws in their order, one letter each: f (force), m (moment), k (kinematic), a (align)."""
    trials: int = 40
    """Random starts."""
    probes: int = 40
    """Touches after the first one, in each trial."""
    seed: int = 0
    """Trial i draws from SeedSequence([seed, i])."""
    jobs: int = 2
    """Processes."""
    cluster: str | None = None
    """Run on a Dask cluster instead: the address of its scheduler, tcp://host:8786, or its
    scheduler file."""
    out: Path | None = None
    """Results folder; a rerun continues it. Default: out/SCENARIO-STACK-FORM."""
    strict: bool = False
    """Stop at the first trial that ends in an error; else it is recorded and the others go on."""
    form: Literal["hierarchy", "memoryless", "paper-hierarchy", "clipped", "paper"] = "hierarchy"
    """hierarchy: strict priorities within limits, led by all that was felt. memoryless: the same by
    the last grasp alone. paper-hierarchy: the paper's levels, strictly, within limits. clipped:
    projection of memoryless, then clipped to the limits. paper: gradients in contact space and
    SR-inverse (eq. 11-13), then clipped."""
    kinematic_error: Literal["angle", "eq7"] = "angle"
    """The kinematic law's error: the angle the paper plots, or its eq. 7 to the letter."""
    solver: str = "proxqp"
    """QP solver behind the hierarchy: proxqp, daqp, or any that qpsolvers lists."""
    joint_cap: float = field(default=StepLimit.joint)
    """Longest step of a joint [rad]."""
    contact_cap: float = field(default=StepLimit.contact)
    """Longest step of a contact along an axis [m]."""
    landing: bool = True
    """Correct each step by the hand's own kinematics before it touches."""
    probe: Literal["geometric", "physical"] = "geometric"
    """geometric: exact distances. physical: a simulated hand, driven and felt as a real one."""
    preset: Literal["loadcell"] | None = None
    """Imperfections of the physical probe's hand; without, there are none."""
    noise: tuple[float, float] | None = None
    """Feel each contact with errors of this size: its normal [rad] and its position [m]. For the
    geometric probe."""
    links: Literal["block", "pass"] = "block"
    """Whether links other than the fingertips are stopped by the object, or pass through it, as in
    the paper."""
    robot: str | None = None
    """Another robot than the scenario's: a name, or the path of a description."""
    hand: str | None = None
    """What grasps, of a robot with several hands: right, left, both, palms, as it names them."""
    replay: int = 0
    """The trial that replay.html plays."""
    view: bool = False
    """Open the live viewer at the end."""
    port: int = PORT
    """Where the viewer listens, on this machine only; 0: any free port."""

    def scene(self, scene: Scene) -> Scene:
        """The scenario's scene with the robot that was asked for, in that robot's workspace."""
        if self.robot is None and self.hand is None:
            return scene
        robot = scene.robot if self.robot is None else self.robot
        return replace(scene, robot=robot, hand=self.hand, position=None)


def main(name: str, scene: Scene | Callable[[], Scene], settings: Settings | None = None) -> None:
    """Run a scenario from the command line; what is wrong is said in one line.

    A scene from a file is given as the function that reads it.
    """
    speak_plainly()
    try:
        scene = scene if isinstance(scene, Scene) else scene()
        chosen = settings or tyro.cli(
            Settings, prog=f"hqp-grasp run {name}", description=_about(name, scene)
        )
        run(name, scene, chosen)
        if chosen.view:
            serve(_out(name, chosen), port=chosen.port)
    except HqpGraspError as error:
        sys.exit(f"{name}: {error}")
    except KeyboardInterrupt:
        sys.exit("\ninterrupted: complete trials are kept, the same command continues")


def _about(name: str, scene: Scene) -> str:
    return (
        f"{name}: {scene.robot} grasps {scene.object} by touch. Contacts are lifted, displaced "
        "and placed again until net force, net moment and finger posture are right."
    )


def trial_of(scene: Scene, settings: Settings) -> Trial:
    """The trial that the settings describe."""
    scene = settings.scene(scene)
    stack = stack_of(settings.stack, settings.kinematic_error)
    stack = stack.within(
        StepLimit(settings.joint_cap, settings.contact_cap), ConfigurationLimit(scene.articulated)
    )
    return Trial(
        scene=scene,
        stack=stack,
        probes=settings.probes,
        form=form_of(settings.form, settings.solver),
        landing=settings.landing,
        links=settings.links,
        probe=settings.probe,
        preset=settings.preset,
        noise=None if settings.noise is None else Noise(*settings.noise),
    )


def run(name: str, scene: Scene, settings: Settings) -> pa.Table:
    """Run, print the table, write DIR/probes.parquet, DIR/convergence.png and DIR/replay.html.

    Raises TrialError where every trial ends in an error, or, if strict, where one does.
    """
    scene = settings.scene(scene)
    trial = trial_of(scene, settings)
    out = _out(name, settings)
    study = Study(
        trial, settings.trials, settings.seed, settings.jobs, settings.strict, settings.cluster
    )
    if not 0 <= settings.replay < settings.trials:
        raise InputError(
            f"--replay takes a trial, 0 … {settings.trials - 1}; got {settings.replay}"
        )
    if settings.view:
        need_viser()  # said before the work, not after it
    about = f"{name}: {Stack.of(trial.stack).name}, {settings.trials} trials"
    print(f"{about} of {settings.probes} probes")
    try:
        table = study.run(out, (*COLUMNS, *trial.true_columns))
        ended = table.filter(pc.is_valid(table["error"]))
        failed = ended["trial"].unique().to_pylist()
        if len(failed) == settings.trials:
            raise TrialError(
                f"every trial ended in an error, trial {failed[0]} by {ended['error'][0]}",
                failed[0],
            )
    except TrialError as error:
        command = replay_command(scene, settings, error.trial)
        raise TrialError(f"{error}; replay it:\n{command}", error.trial) from error
    print(summary(table))
    if failed:
        command = replay_command(scene, settings, failed[0])
        print(f"\nreplay trial {failed[0]}, the first that ended in an error:\n{command}")
    print(f"\nresults  {out / 'probes.parquet'}")
    figure = out / "convergence.png"
    try:
        convergence(table, about, figure)
        print(f"figure   {figure}")
    except ResultsError as error:  # the results stand without it
        print(f"figure   none: {error}")
    _replay(scene, settings.replay, out, name)
    return table


def _out(name: str, settings: Settings) -> Path:
    return settings.out or Path("out") / f"{name}-{settings.stack}-{settings.form}"


def _replay(scene: Scene, trial: int, out: Path, name: str) -> None:
    """Write the replay, or say why there is none: the results stand without it."""
    path = out / "replay.html"
    try:
        table = pq.read_table(out / "probes.parquet", filters=[("trial", "=", trial)])
        frames = frames_of_rows(rows_of(table, trial), scene.articulated.joints)
        write_replay(scene, frames, path, f"{name}, trial {trial}")
        print(f"replay   {path}")
    except HqpGraspError as error:
        print(f"replay   none: {error}")


def replay_command(
    scene: Scene, settings: Settings, trial: int, made: str = "trial_of", by: str = "scenario"
) -> str:
    """A line for the shell that runs one trial alone, and shows the whole error.

    `made` is the function that makes the trial of scene and settings, `by` the module it is in.
    """
    decisive = [f for f in fields(settings) if f.name not in ABOUT_THE_RUN]
    chosen = {f.name: getattr(settings, f.name) for f in decisive}
    changed = [f"{f.name}={chosen[f.name]!r}" for f in decisive if chosen[f.name] != f.default]
    code = (
        "from pathlib import *; from hqp_grasp import *; "
        f"from hqp_grasp.experiments.{by} import *; "
        f"trial = {made}({scene!r}, {type(settings).__name__}({', '.join(changed)})); "
        f"print(trial.run(({settings.seed}, {trial})))"
    )
    if '"' not in code:
        code = code.replace("'", '"')  # so that the shell's quotes need no escaping
    return shlex.join([sys.executable, "-c", code])


def summary(table: pa.Table) -> str:
    """What came of the trials, for people."""
    texts = ("other_links", "in_transit", "method", "error", "unbalanced")
    there = [n for n in (*COLUMNS, *TRUE_COLUMNS) if n in table.column_names and n not in texts]
    columns = {n: table[n].to_numpy() for n in there}
    trials = len(np.unique(columns["trial"]))
    shaped = {n: np.asarray(v).reshape(trials, -1) for n, v in columns.items()}
    touched = shaped["in_contact"].astype(bool)
    force, moment = shaped["eps_f"].astype(float), 1e3 * np.sqrt(shaped["eps_m"].astype(float))
    good = balanced(columns).reshape(trials, -1)
    stays = np.flip(np.logical_and.accumulate(np.flip(good, axis=1), axis=1), axis=1)
    converged = stays.any(axis=1)
    first = stays.argmax(axis=1)[converged]
    lines = [f"\n{'':22}{'start':>22}{'end':>22}"]
    rows = (
        ("net force², N²", force, "{:.2e}"),
        ("net moment, mm·N", moment, "{:.2e}"),
        ("flexion angle, rad", shaped["eps_k"].astype(float), "{:.3f}"),
        ("adduction, °", shaped["adduction_deg"].astype(float), "{:.2f}"),
        ("elevation, °", shaped["elevation_deg"].astype(float), "{:.2f}"),
    )
    for label, values, form in rows:
        cells = []
        for at in (0, -1):
            picked = values[touched[:, at], at]
            if not len(picked) or not np.isfinite(picked).all():
                cells.append("–")
            elif "°" in label or "rad" in label:
                cells.append(f"{form.format(picked.mean())} ± {form.format(picked.std())}")
            else:
                cells.append(f"{form.format(np.median(picked))} (≤ {form.format(picked.max())})")
        lines.append(f"{label:22}{cells[0]:>22}{cells[1]:>22}")
    force_goal, moment_goal = (
        values[np.isfinite(values)][-1] if np.isfinite(values).any() else usual
        for values, usual in (
            (shaped["goal_f"].astype(float), CONVERGED_FORCE),
            (np.sqrt(shaped["goal_m"].astype(float)), CONVERGED_MOMENT),
        )
    )
    after = f", after {np.median(first):g} probes (worst {first.max()})" if len(first) else ""
    lines.append(
        f"\nconverged{converged.sum():6} of {trials}{after}: "
        f"ε_f ≤ {force_goal:g} N², √ε_m ≤ {1e3 * moment_goal:.3g} mm·N, kept to the end"
        + (f", or {BEYOND:g} × the floor" if "floor_f" in columns else "")
    )
    lines += _physical(columns, shaped)
    verdict = Counter(verdicts(table).values())
    others = " · ".join(f"{kind} {verdict[kind]}" for kind in VERDICTS if kind != "good")
    lines.append(f"good{verdict['good']:11} of {trials} in every respect")
    lines.append(f"         {others}")
    secure = sum(secures(table).values())
    demand = known(table, "friction_demand").reshape(trials, -1)[touched[:, -1], -1]
    lines.append(
        f"secure{secure:9} of {trials} at the end: they need a friction of {SECURE:g} at most"
        + (f"; the median {holds(float(np.median(demand)))}" if len(demand) else "")
    )
    first_rows = table.filter(pc.equal(table["probe"], 0))
    reasons = Counter(first_rows["unbalanced"].drop_null().to_pylist()).most_common(1)
    if reasons:
        lines.append(f"         not balanced, most often ({reasons[0][1]}): {reasons[0][0]}")
    ended = table.filter(pc.and_(pc.is_valid(table["error"]), pc.equal(table["probe"], 0)))
    errors = ended["error"].to_pylist()
    if errors:
        kinds = Counter(error.partition(":")[0] for error in errors).most_common()
        lines.append(f"errors   {', '.join(f'{kind} {count}' for kind, count in kinds)}")
    steps = shaped["step_share"].astype(float)
    taken = np.isfinite(steps)
    active = shaped["limit_active"].astype(bool) & taken
    lines.append(f"limits   active in {active.sum() / max(1, taken.sum()):.0%} of the steps")
    lines.append(f"         largest violation {np.nanmax(columns['limit_violation']):g} rad")
    gap = columns["hqp_projection_gap"].astype(float)
    if np.isfinite(gap).any():
        share = np.isfinite(gap).sum() / max(1, taken.sum())
        lines.append(
            f"gap      QP − projection ≤ {np.nanmax(gap):.1e} rad, over {share:.0%} of steps"
        )
    counts = table["method"].drop_null().value_counts().to_pylist()
    methods = Counter({count["values"]: count["counts"] for count in counts})
    shares = (f"{method} {n / methods.total():.1%}" for method, n in methods.most_common())
    lines.append(f"methods  {', '.join(shares) or '–'} of the steps")
    other = says_something(table, "other_links").reshape(trials, -1) & touched
    lines.append(
        f"links    another link is in the object in {other.mean():.1%} of the probes, "
        f"at the end of {other[:, -1].sum()} trials"
    )
    met = says_something(table, "in_transit").reshape(trials, -1) & taken
    lines.append(
        f"         one meets it on the way in {met.sum() / max(1, taken.sum()):.1%} of moves"
    )
    lines.append(f"rejected {shaped['rejected'][:, 0].sum()} draws that could not start")
    return "\n".join(lines)


def _physical(columns: dict[str, np.ndarray], shaped: dict[str, np.ndarray]) -> list[str]:
    """What a simulated hand adds: its sensors' floor, what is true, how hard it was used."""
    if "floor_f" not in columns:
        return []
    at_end = {name: shaped[name][:, -1].astype(float) for name in TRUE_COLUMNS}
    at_end = {name: values[np.isfinite(values)] for name, values in at_end.items()}
    lines = []
    for label, force, moment in (
        ("true     {} at the end, medians", "eps_f_true", "eps_m_true"),
        ("floor    {}: what noise makes of balance", "floor_f", "floor_m"),
    ):
        if len(at_end[force]):
            f, m = np.median(at_end[force]), 1e3 * np.sqrt(np.median(at_end[moment]))
            lines.append(label.format(f"ε_f {f:.1e} N², √ε_m {m:.2f} mm·N"))
    peaks = ("peak_force", "peak_speed", "peak_torque")
    most = {name: np.nanmax(columns[name].astype(float)) for name in peaks}
    lines.append(
        f"hand     at most {most['peak_force']:.2f} N at a fingertip, {most['peak_speed']:.0%} of "
        f"a joint's speed limit, {most['peak_torque']:.0%} of its torque limit"
    )
    moved = at_end["object_moved"]
    if moved.any():
        lines.append(f"         the object moved by {1e3 * np.median(moved):.2f} mm in the median")
    return lines
