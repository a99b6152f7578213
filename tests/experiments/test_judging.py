"""Judging a results folder: every trial in every way, again and in part, as a study does it."""

import dataclasses
import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest

import hqp_grasp as hg
from hqp_grasp.__main__ import app
from hqp_grasp.errors import InputError, ResultsError
from hqp_grasp.experiments.judging import (
    COLUMNS,
    Judging,
    _about,
    _found,
    _measured,
    judge_folder,
    summary,
)
from hqp_grasp.experiments.replay import rows_of
from hqp_grasp.experiments.study import Study
from hqp_grasp.experiments.table import table_of
from hqp_grasp.judge.judge import AXES, Judge

STACK = hg.ForceTask() >> hg.MomentTask() >> hg.KinematicTask()
SEED, TRIALS, PROBES = 31, 2, 8


@pytest.fixture(scope="module")
def scene():
    return hg.Scene()


@pytest.fixture(scope="module")
def folder(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("study")
    Study(hg.Trial(scene, STACK, probes=PROBES), TRIALS, SEED).run(out)
    return out


@pytest.fixture(scope="module")
def judges(scene):
    return [Judge(scene, how) for how in ("hierarchy", "equal-torque")]


@pytest.fixture(scope="module")
def judged(folder, judges):
    return judge_folder(folder, judges, jobs=1)


def test_every_trial_has_a_row_for_every_judge(folder, judged):
    assert judged.column_names[:3] == ["trial", "seed", "cpu"]
    assert set(COLUMNS) <= set(judged.column_names)
    rows = judged.to_pylist()
    assert [(r["trial"], r["squeeze"]) for r in rows] == [
        (i, how) for i in range(TRIALS) for how in ("hierarchy", "equal-torque")
    ]
    assert all(r["seed"] == SEED and r["lifted"] and r["probe"] == PROBES for r in rows)
    assert pq.read_table(folder / "judged.parquet").equals(judged)


def test_a_row_says_what_the_judge_says_of_the_grasp_that_was_felt(scene, judges, judged):
    grasp = hg.Trial(scene, STACK, probes=PROBES).run((SEED, 1)).grasps[-1]
    told, row = judges[0].judge(grasp), judged.to_pylist()[2]
    assert row["weakest_axis"] == told.weakest_axis and row["sum_normal"] == told.sum_normal
    assert [row[f"pull_{axis}"] for axis in AXES] == [told.pulls[axis] for axis in AXES]
    assert [row[f"twist_{axis}"] for axis in AXES] == [told.twists[axis] for axis in AXES]
    assert row["friction_demand"] == pytest.approx(
        hg.mechanics.friction_demand(grasp.positions, grasp.normals), abs=1e-9
    )


def test_what_is_done_is_not_done_again(folder, judges, judged, monkeypatch):
    monkeypatch.setattr(Judge, "judge", lambda *_: pytest.fail("judged again"))
    assert judge_folder(folder, judges, jobs=1).equals(judged)


def test_the_first_touch_is_judged_beside_the_last(folder, scene, judged):
    first = judge_folder(folder, [Judge(scene)], probe=0, jobs=1)
    assert first["probe"].to_pylist() == [0] * TRIALS
    last = [r["weakest_axis"] for r in judged.to_pylist() if r["squeeze"] == "hierarchy"]
    assert np.all(np.array(first["weakest_axis"].to_pylist()) < last)


def test_a_trial_without_a_grasp_is_not_held_and_says_why(folder, judges):
    judging, _ = Judging.of(folder, judges)
    lost = dataclasses.replace(judging, found=("no grasp to judge: the object was never touched",))
    for row in lost.attempt((SEED, 0)).to_table().to_pylist():
        assert row["lifted"] is False and row["passed"] is False and row["error"] is None
        assert row["reason"].startswith("no grasp to judge")


def test_a_failing_judgement_costs_no_other(folder, judges, monkeypatch):
    judging, _ = Judging.of(folder, judges)
    judge = Judge.judge

    def failing(self, grasp):
        if self.squeeze == "hierarchy":
            raise ZeroDivisionError("broken")
        return judge(self, grasp)

    monkeypatch.setattr(Judge, "judge", failing)
    broken, whole = judging.attempt((SEED, 0)).to_table().to_pylist()
    assert broken["error"] == "ZeroDivisionError: broken" and broken["lifted"] is None
    assert whole["error"] is None and whole["lifted"]


def test_what_cannot_be_squeezed_so_is_not_held_and_no_error(folder, judges, monkeypatch):
    def refused(self, grasp):
        raise InputError("closing 'finger_1' does not push on the object here")

    monkeypatch.setattr(Judge, "judge", refused)
    judging, _ = Judging.of(folder, judges)
    for row in judging.attempt((SEED, 0)).to_table().to_pylist():
        assert row["error"] is None and not row["lifted"] and "does not push" in row["reason"]


def test_hands_without_an_arm_are_judged_where_they_touched(tmp_path):
    scene = hg.Scene(robot="bhand")
    Study(hg.Trial(scene, STACK, probes=6), 1, SEED).run(tmp_path)
    (row,) = judge_folder(tmp_path, [Judge(scene)], jobs=1).to_pylist()
    assert row["lifted"] and row["error"] is None and row["weakest_axis"] > 1.0


def test_a_folder_without_results_is_refused(folder, judges, tmp_path):
    with pytest.raises(ResultsError, match="holds no scene"):
        judge_folder(tmp_path, judges)
    shutil.copy(folder / "scene.json", tmp_path)
    with pytest.raises(ResultsError, match="no results to judge"):
        judge_folder(tmp_path, judges)


def test_the_summary_has_a_line_for_every_judge(judged):
    lines = summary(judged).splitlines()
    assert lines[2].startswith("hierarchy, pulls") and f"{TRIALS} of {TRIALS} [" in lines[2]
    assert lines[3].startswith("equal-torque, pulls")


def test_the_summary_counts_and_tells_medians_and_the_worst():
    kinds = (("hierarchy", "pulls"), ("equal-torque", "pulls"))
    rows = [dict.fromkeys(COLUMNS) | {"squeeze": a, "protocol": b} for a, b in kinds for _ in "abc"]
    found = zip((1.0, 4.0, 9.0, 2.0, None, None), (0.1, 0.3, 0.2, None, None, None), strict=True)
    for i, (axis, twist) in enumerate(found):
        rows[i] |= {"weakest_axis": axis, "weakest_twist": twist, "sum_normal": 10.0 + i}
        rows[i] |= {"passed": axis is not None, "reason": None if axis else "dropped"}
    rows[4] |= {"reason": "out of reach"}
    rows[5] |= {"reason": None, "error": "E: why", "sum_normal": None}
    lines = summary(table_of(rows, COLUMNS)).splitlines()
    assert [" ".join(line.split()) for line in lines[2:]] == [
        "hierarchy, pulls 3 of 3 [43.8%, 100.0%] 11.0 4.0 (1.0) 0.20",
        "equal-torque, pulls 1 of 3 [6.1%, 79.2%] 13.5 2.0 (2.0) –",
        "1 × out of reach",
        "1 judgements ended in an error, the first: E: why",
    ]
    few = [row | {"weakest_axis": None, "sum_normal": None} for row in rows[:1]]
    assert summary(table_of(few, COLUMNS)).splitlines()[2].split()[-3:] == ["–", "–", "0.10"]
    many = [row | {"reason": why} for row, why in zip(rows, "bcbcca", strict=True)]
    why = summary(table_of(many, COLUMNS)).splitlines()[4:7]
    assert why == ["    3 × c", "    2 × b", "    1 × a"]


def without_touch(row):
    return row | {"in_contact": False} | dict.fromkeys(n for n in row if n.startswith("contact_"))


def test_the_grasp_judged_is_the_last_that_was_felt_or_that_of_the_probe(folder, judges, scene):
    rows = rows_of(pq.read_table(folder / "probes.parquet"), 0)
    last = Judging.of(folder, judges)[0].found[0]
    assert last.probe == PROBES
    normal = [rows[PROBES][f"contact_2_n{axis}"] for axis in "xyz"]
    np.testing.assert_array_equal(last.normals[1], normal)
    lost = [*rows[:-1], without_touch(rows[-1])]
    assert _found(scene, lost, None).probe == PROBES - 1
    assert _found(scene, lost, PROBES) == f"no touch at {PROBES}"
    assert _found(scene, rows, PROBES + 1) == f"no touch at {PROBES + 1}"
    assert _found(scene, rows, 2).probe == 2
    nowhere = [without_touch(row) for row in rows]
    for probe in (None, 0):  # as where no start was found: it costs no other trial
        never = "no grasp to judge: the object was never touched"
        assert _found(scene, nowhere, probe) == never


def test_beside_the_verdict_stand_measures_by_the_judges_force_and_frictions(folder, scene):
    judge = Judge(scene, "equal-torque", force=4.0, friction=0.7, believed=0.3)
    judging, _ = Judging.of(folder, [judge])
    _, grasp = judging.found[0].placed(scene)
    told = _measured(grasp, judge)
    squeeze = hg.Grip(scene.articulated, 4.0, 0.3).solve(grasp)
    assert told["margin"] == squeeze.margin.min()
    assert told["ferrari_canny"] == hg.mechanics.ferrari_canny(grasp.positions, grasp.normals, 0.7)
    about = _about(judge)
    assert (about["force"], about["mass"], about["friction"]) == (4.0, 0.1, 0.7)
    assert (about["squeeze"], about["protocol"]) == ("equal-torque", "pulls")
    assert _about(dataclasses.replace(judge, squeeze=_measured))["squeeze"] == "_measured"


def test_the_command_judges_a_folder(folder, judged, capsys):
    app.cli(args=["judge", str(folder), "--squeeze", "hierarchy", "equal-torque", "--jobs", "1"])
    out = capsys.readouterr().out
    assert "hierarchy, pulls" in out and str(folder / "judged.parquet") in out
