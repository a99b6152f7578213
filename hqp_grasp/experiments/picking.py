"""The command line of a pick: a scenario's object found, lifted, set down; a row a trial out."""

from __future__ import annotations

import dataclasses
import importlib
import sys
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import tyro

from hqp_grasp.errors import HqpGraspError, InputError, TrialError
from hqp_grasp.experiments.pick import COLUMNS, Pick
from hqp_grasp.experiments.plots import picked
from hqp_grasp.experiments.replay import frames_of_pick, write_replay
from hqp_grasp.experiments.scenario import Settings, replay_command, trial_of
from hqp_grasp.experiments.study import Study
from hqp_grasp.world.physics import Physics
from hqp_grasp.world.scene import Scene

NAMED = 3  # picks that failed in one way, whose replay is offered


@dataclass(frozen=True)
class PickSettings(Settings):
    """How to pick an object up; every value has a sensible default."""

    trials: int = 20
    """Random starts."""
    out: Path | None = None
    """Results folder; a rerun continues it. Default: out/pick-SCENARIO-STACK-FORM."""
    replay: int = 0
    """The trial that replay.html and pick.png show."""
    probe: Literal["physical"] = "physical"
    """A simulated hand, driven and felt as a real one; the object stands free on a pedestal."""
    mass: float = 0.5
    """The object's [kg]. The hand is not told."""
    force: float = 5.0
    """Mean normal force of a contact [N], at least: it grows with the load."""
    friction: float = 0.5
    """Friction that the hand believes in."""
    actual_friction: float = 0.6
    """Friction that the object has. The hand is not told."""
    lift: float = 0.1
    """How high [m]."""
    timestep: float = 0.004
    """Of the simulation [s]."""
    noise: Annotated[None, tyro.conf.Suppress] = None  # the sensors have a preset
    view: Annotated[bool, tyro.conf.Suppress] = False  # which shows touches, one trial's of many
    port: Annotated[int, tyro.conf.Suppress] = Settings.port


def main(name: str) -> None:
    """Pick the object of a scenario as the command line says."""
    module = importlib.import_module(f"hqp_grasp.scenarios.{name}")
    about = f"Find {name} by touch, hold it, lift it, shake it and set it down where it stood."
    prog = f"hqp-grasp pick {name}"
    if hasattr(module, "Arguments"):  # an object from a file, with settings among its arguments
        with_settings: Any = dataclasses.make_dataclass(
            "Arguments",
            [("settings", Annotated[PickSettings, tyro.conf.arg(name="")])],
            bases=(module.Arguments,),
            frozen=True,
        )
        chosen = tyro.cli(with_settings, prog=prog, description=about)
        scene, settings = chosen.scene(), chosen.settings
        name = f"{name}-{next(v for v in vars(chosen).values() if isinstance(v, Path)).stem}"
    else:
        scene = module.scene
        settings = tyro.cli(PickSettings, prog=prog, description=about)
    try:
        run(name, scene, settings)
    except KeyboardInterrupt:
        sys.exit("\ninterrupted: complete trials are kept, the same command continues")


def pick_of(scene: Scene, settings: PickSettings) -> Pick:
    """The pick that the settings describe."""
    world = Physics(
        support="pedestal",
        mass=settings.mass,
        friction=settings.actual_friction,
        timestep=settings.timestep,
    )
    trial = replace(trial_of(scene, settings), probe=world)
    return Pick(trial, settings.force, settings.friction, settings.lift)


def run(name: str, scene: Scene, settings: PickSettings) -> pa.Table:
    """Pick, print the summary, write DIR/picks.parquet, DIR/pick.png and DIR/replay.html.

    Raises InputError, before anything moves, for what cannot lift; TrialError where every pick
    ends in an error, or, if strict, where one does.
    """
    scene = settings.scene(scene)
    pick = pick_of(scene, settings)
    out = settings.out or Path("out") / f"pick-{name}-{settings.stack}-{settings.form}"
    study = Study(
        pick, settings.trials, settings.seed, settings.jobs, settings.strict, settings.cluster
    )
    if not 0 <= settings.replay < settings.trials:
        raise InputError(
            f"--replay takes a trial, 0 … {settings.trials - 1}; got {settings.replay}"
        )
    print(f"{name}: {settings.trials} picks, of {settings.mass:g} kg")

    def again(trial: int) -> str:
        return replay_command(scene, settings, trial, "pick_of", "picking")

    try:
        table = study.run(out, ["trial", "seed", *COLUMNS])
        failed = table.filter(pc.is_valid(table["error"]))
        if len(failed) == settings.trials:
            first = failed["trial"][0].as_py()
            raise TrialError(
                f"every pick ended in an error, trial {first} by {failed['error'][0]}", first
            )
    except TrialError as error:
        raise TrialError(f"{error}; replay it:\n{again(error.trial)}", error.trial) from error
    print(summary(table, settings.mass))
    for why, trials in kinds(table).items():
        for trial in trials[:NAMED]:
            print(f"\nreplay trial {trial}, {why}:\n{again(trial)}")
    print(f"\nresults  {out / Pick.file}")
    seed = (settings.seed, settings.replay)
    done = pick.attempt(seed)  # the same bits: its touches are not among the results
    title = f"{name}, trial {settings.replay}"
    for what, path in (("figure", out / "pick.png"), ("replay", out / "replay.html")):
        try:  # the results stand without either
            if what == "figure":
                picked(done.looks, title, path)
            else:
                write_replay(
                    scene, frames_of_pick(done.told, done.touches, done.looks), path, title
                )
            print(f"{what}   {path}")
        except HqpGraspError as error:
            print(f"{what}   none: {error}")
    return table


def kinds(table: pa.Table) -> dict[str, list[int]]:
    """The trials that did not lift and set down, by what became of them."""
    found: dict[str, list[int]] = {}
    for row in table.to_pylist():
        if row["error"]:
            kind = f"ended by {row['error'].partition(':')[0]}"
        elif not row["set_down"]:
            kind = "not where it stood"
        elif not row["lifted"]:
            kind = "not lifted"
        else:
            continue
        found.setdefault(kind, []).append(row["trial"])
    return found


def summary(table: pa.Table, mass: float) -> str:
    """What came of the picks, for people; `mass` [kg] is the object's."""
    rows = table.to_pylist()
    total = len(rows)
    lines = [
        f"\nlifted   {sum(row['lifted'] for row in rows)} of {total}",
        f"set down {sum(row['set_down'] for row in rows)} of {total} within 1 cm of where it stood",
    ]

    def told(name: str, form: str, scale: float = 1.0) -> str:
        values = [scale * row[name] for row in rows if row[name] is not None]
        return form.format(np.median(values), max(values)) if values else "–"

    weights = [row["felt_weight"] for row in rows if row["felt_weight"] is not None]
    if weights:
        off = np.abs(np.array(weights) / mass - 1.0)
        lines.append(
            f"weight   {np.median(weights):.3f} kg felt in the median, of {mass:g}; off by "
            f"{np.median(off):.1%} in the median, {off.max():.1%} at most"
        )
    lines += [
        f"forces   {told('sum_normal', '{:.1f} N of normal force in the median, {:.1f} at most')}",
        f"slip     {told('slip_mm', '{:.2f} mm in the median, {:.2f} at most')}, "
        f"{told('slip_deg', '{:.2f}° and {:.2f}')}",
        f"touches  {told('touches', '{:g} in the median, {:g} at most')}",
        f"limits   largest violation {told('limit_violation', '{1:g} rad')}",
    ]
    why = Counter(_without_figures(row["reason"]) for row in rows if row["reason"])
    lines += [f"reason   {count} × {reason}" for reason, count in why.most_common()]
    errors = Counter(row["error"].partition(":")[0] for row in rows if row["error"])
    lines += [f"error    {count} × {error}" for error, count in errors.most_common()]
    return "\n".join(lines)


def _without_figures(reason: str) -> str:
    """A reason's kind: its words up to the first figure."""
    words = reason.split()
    first = next((i for i, w in enumerate(words) if w[0].isdigit()), len(words))
    return " ".join(words[:first]).rstrip(",")
