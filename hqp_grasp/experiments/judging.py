"""The grasps of a results folder, judged: a study whose trials were found by another."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pyarrow as pa

from hqp_grasp.control.forces import Grip
from hqp_grasp.errors import InputError, ResultsError
from hqp_grasp.experiments.parts import read_results
from hqp_grasp.experiments.record import ALL_HAVE, kind_and_message
from hqp_grasp.experiments.replay import frames_of_rows, placed, rows_of
from hqp_grasp.experiments.report import interval
from hqp_grasp.experiments.study import Study
from hqp_grasp.experiments.table import table_of
from hqp_grasp.grasp import Contact, Grasp
from hqp_grasp.judge.judge import AXES, Judge
from hqp_grasp.mechanics import ferrari_canny, friction_demand
from hqp_grasp.world.scene import Scene

COLUMNS = {
    "probe": "count: the touch that is judged",
    "squeeze": "text: how the fingers pressed",
    "protocol": "text: pulls, or dexgraspbench",
    "force": "N: mean normal force of a contact that was asked for",
    "mass": "kg: of the object",
    "friction": "–: of the object",
    "lifted": "bool: it was lifted, and stayed so; null where the protocol lifts nothing",
    "height": "m: the object rose by",
    "sum_normal": "N: of all normal forces, before the pulls",
    "weakest_axis": "N: the least force along an axis at which it slipped; 0 where not lifted",
    **{f"pull_{axis}": f"N: along {axis}, at which it slipped" for axis in AXES},
    "weakest_twist": "N m: the least torque about an axis at which it slipped",
    **{f"twist_{axis}": f"N m: about {axis}, at which it slipped" for axis in AXES},
    "passed": "bool: lifted; by dexgraspbench: never pulled away",
    "reason": "text: why it did not pass; null where it did",
    "friction_demand": "–: least friction at which the contacts can balance",
    "ferrari_canny": "–: largest wrench in every direction that unit normal forces resist",
    "margin": "N: least distance of the hierarchy's forces to the surface of their cones",
    "error": "text: what ended the judgement, kind and message; null where nothing did",
}


@dataclass(frozen=True, eq=False)
class Found:
    """A grasp to judge, and where."""

    base: tuple[float, ...]  # of the robot, as a Scene has it
    probe: int
    q: np.ndarray  # (n,)
    positions: np.ndarray  # (k, 3) [m]
    normals: np.ndarray  # (k, 3)

    def placed(self, scene: Scene) -> tuple[Scene, Grasp]:
        """The scene with the robot in its place, and the grasp there."""
        scene = scene if self.base == scene.base else replace(scene, base=self.base)
        contacts = [Contact(x, n) for x, n in zip(self.positions, self.normals, strict=True)]
        return scene, scene.articulated.grasp(self.q, contacts)


@dataclass(frozen=True)
class Judging:
    """The last grasp of each trial of a study, or that of one probe, judged in several ways.

    It is repeated as a trial is: `Study(judging, trials, seed).run(out)` judges in parallel, on a
    cluster, and goes on where it was interrupted.
    """

    file: ClassVar[str] = "judged.parquet"
    scene: Scene
    found: tuple[Found | str, ...]  # of each trial; or why there is none
    judges: tuple[Judge, ...]

    @classmethod
    def of(
        cls, folder: str | Path, judges: Sequence[Judge], probe: int | None = None
    ) -> tuple[Judging, int]:
        """Those of a results folder, and the seed of its study; None: the last touch.

        The judges' scenes are taken from the folder. Raises ResultsError where there are none.
        """
        folder = Path(folder)
        scene = Scene.load(folder / "scene.json")
        needed = ALL_HAVE | {"outcome": "texts"}
        try:
            table = read_results(folder / "probes.parquet", needed)
        except ResultsError as error:
            raise ResultsError(f"{folder} holds no results to judge: {error}") from error
        trials = sorted(set(table["trial"].to_pylist()))
        if trials != list(range(len(trials))):
            raise ResultsError(f"{folder} lacks trials before {trials[-1]}; run its study again")
        found = tuple(_found(scene, rows_of(table, i), probe) for i in trials)
        return cls(scene, found, tuple(judges)), int(table["seed"][0].as_py())

    def attempt(self, seed: Sequence[int]) -> Judgements:
        """The rows of the trial that the last number names, one for each judge."""
        found = self.found[seed[-1]]
        if isinstance(found, str):
            none = {"lifted": False, "weakest_axis": 0.0, "reason": found}
            return Judgements(tuple(_about(judge) | none for judge in self.judges))
        scene, grasp = found.placed(self.scene)
        rows = (_judged(grasp, judge.within(scene)) for judge in self.judges)
        return Judgements(tuple({"probe": found.probe} | row for row in rows))

    def nothing(self, seed: Sequence[int], error: str) -> Judgements:
        """The rows of a trial whose judgement was ended by something."""
        return Judgements(tuple(_about(judge) | {"error": error} for judge in self.judges))


@dataclass(frozen=True)
class Judgements:
    """Rows of COLUMNS."""

    rows: tuple[Mapping[str, object], ...]

    def to_table(self) -> pa.Table:
        """As a table."""
        return table_of(self.rows, COLUMNS)


def _found(scene: Scene, rows: Sequence[Mapping[str, object]], probe: int | None) -> Found | str:
    touched = [i for i, row in enumerate(rows) if row["in_contact"]]
    if not touched:
        return "no grasp to judge: the object was never touched"
    at = touched[-1] if probe is None else probe
    if at not in touched:
        return f"no touch at {at}"
    frames = frames_of_rows(rows, scene.articulated.joints)
    frame = frames[at]
    return Found(placed(scene, frames).base, at, frame.q, frame.positions, frame.normals)


def _about(judge: Judge) -> dict[str, object]:
    row: dict[str, object] = dict.fromkeys(COLUMNS)
    squeeze = judge.squeeze if isinstance(judge.squeeze, str) else judge.squeeze.__qualname__
    row |= {"squeeze": squeeze, "protocol": judge.protocol, "passed": False}
    return row | {"force": judge.force, "mass": judge.mass, "friction": judge.friction}


def _judged(grasp: Grasp, judge: Judge) -> dict[str, object]:
    row = _about(judge) | _measured(grasp, judge)
    del row["probe"]
    try:
        told = judge.judge(grasp)
    except InputError as error:  # what cannot be squeezed so is not held
        return row | {"lifted": False, "weakest_axis": 0.0, "reason": str(error)}
    except Exception as error:  # one failing judgement must not cost the others
        return row | {"error": kind_and_message(error)}
    return row | {
        "lifted": told.lifted if judge.protocol == "pulls" else None,
        "height": told.height,
        "sum_normal": told.sum_normal,
        "weakest_axis": told.weakest_axis,
        **{f"pull_{axis}": force for axis, force in told.pulls.items()},
        "weakest_twist": told.weakest_twist,
        **{f"twist_{axis}": torque for axis, torque in told.twists.items()},
        "passed": told.passed,
        "reason": told.reason or None,
    }


def _measured(grasp: Grasp, judge: Judge) -> dict[str, object]:
    """The analytic measures beside the judge's."""
    try:
        squeeze = Grip(judge.scene.articulated, judge.force, judge.believed).solve(grasp)
        margin = None if squeeze.margin is None else float(squeeze.margin.min())
    except InputError:
        margin = None
    return {
        "friction_demand": friction_demand(grasp.positions, grasp.normals),
        "ferrari_canny": ferrari_canny(grasp.positions, grasp.normals, judge.friction),
        "margin": margin,
    }


def judge_folder(
    folder: str | Path,
    judges: Sequence[Judge],
    probe: int | None = None,
    jobs: int = 2,
    cluster: str | Path | None = None,
) -> pa.Table:
    """Judge the grasps of a results folder into DIR/judged.parquet; return the rows.

    What is done is kept in DIR/judged/, for each way of judging apart: the same call continues, and
    another does not mix with it.
    """
    folder = Path(folder)
    judging, seed = Judging.of(folder, judges, probe)
    study = Study(judging, len(judging.found), seed, jobs, cluster=cluster)
    about = json.dumps(study.configuration(), sort_keys=True)
    kept = folder / "judged" / hashlib.sha256(about.encode()).hexdigest()[:12]
    table = study.run(kept)
    (kept / Judging.file).replace(folder / Judging.file)
    return table


def summary(table: pa.Table) -> str:
    """What became of the judged grasps, for people: one line for each judge."""
    heads = f"{'':28}{'lifted or passed':>27}{'Σ normal':>10}{'weakest axis':>20}{'twist':>13}"
    lines = [heads, f"{'':28}{'[95 %]':>27}{'N':>10}{'N, median (least)':>20}{'N·m, median':>13}"]
    kinds = list(zip(*(table[n].to_pylist() for n in ("squeeze", "protocol")), strict=True))
    rows = table.to_pylist()
    for kind in dict.fromkeys(kinds):
        of = [row for row, its in zip(rows, kinds, strict=True) if its == kind]
        passed = sum(bool(row["passed"]) for row in of)
        low, high = interval(passed, len(of))
        share = f"{passed} of {len(of)} [{low:.1%}, {high:.1%}]"
        total, axis, twist = (
            np.array([row[n] for row in of if row[n] is not None], dtype=float)
            for n in ("sum_normal", "weakest_axis", "weakest_twist")
        )
        cells = [f"{', '.join(kind):28}{share:>27}"]
        cells.append(f"{np.median(total):>10.1f}" if len(total) else f"{'–':>10}")
        weakest = f"{np.median(axis):.1f} ({axis.min():.1f})" if len(axis) else "–"
        cells.append(f"{weakest:>20}")
        cells.append(f"{np.median(twist):>13.2f}" if len(twist) else f"{'–':>13}")
        lines.append("".join(cells))
    reasons = [str(row["reason"]) for row in rows if row["reason"]]
    for why in sorted(set(reasons), key=reasons.count, reverse=True)[:5]:
        lines.append(f"{reasons.count(why):5} × {why}")
    errors = [row for row in rows if row["error"]]
    if errors:
        lines.append(f"{len(errors)} judgements ended in an error, the first: {errors[0]['error']}")
    return "\n".join(lines)
