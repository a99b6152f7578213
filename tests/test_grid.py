"""Benchmarks over random starts: cells in pairs, gone on with where they ended."""

import importlib.util
import sys
from pathlib import Path

import pytest

import hqp_grasp as hg

ROOT = Path(__file__).parents[1]
spec = importlib.util.spec_from_file_location("grid", ROOT / "benchmarks" / "grid.py")
assert spec is not None and spec.loader is not None
grid = sys.modules["grid"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(grid)

SCENE = grid.SCENES["cylinder"]
CELLS = {laws: hg.Trial(SCENE, hg.stack_of(laws), 1) for laws in ("fmk", "fm")}


def first_force(name, trial, record):
    return {f"eps of {trial.probes}": record.column("eps_f").astype(float)[0]}


def runs(trials, out=None):
    return grid.Runs(trials, 5, 1, out)


def test_trial_i_begins_alike_in_every_cell_and_as_the_trial_of_that_seed():
    found = runs(2).of(CELLS, first_force)
    assert list(found) == ["fmk", "fm"]
    one, other = ([end.figures["eps of 1"] for end in ends] for ends in found.values())
    assert one == other and one[0] != one[1]
    assert one[1] == CELLS["fm"].attempt((5, 1)).rows[0]["eps_f"]


def test_apart_no_two_cells_begin_alike():
    found = runs(1).of(CELLS, first_force, apart=True)
    assert len({end.figures["eps of 1"] for ends in found.values() for end in ends}) == 2
    assert found["fm"][0].figures["eps of 1"] == CELLS["fm"].attempt((5, 1, 0)).rows[0]["eps_f"]


def test_more_trials_go_on_in_the_folder_and_other_cells_are_refused(tmp_path, monkeypatch):
    first = runs(1, tmp_path / "out").of(CELLS)
    tried = []
    attempt = hg.Trial.attempt
    monkeypatch.setattr(
        hg.Trial, "attempt", lambda self, seed: tried.append(seed) or attempt(self, seed)
    )
    more = runs(2, tmp_path / "out").of(CELLS)
    assert tried == [(5, 1), (5, 1)]
    assert [more[name][0] for name in CELLS] == [first[name][0] for name in CELLS]
    with pytest.raises(hg.HqpGraspError, match="another configuration"):
        runs(1, tmp_path / "out").of({"fmk": CELLS["fmk"]})


def test_a_trial_that_ends_in_an_error_is_told_and_costs_no_other():
    class Broken(hg.Form):
        def plan(self, stack, episode):
            raise hg.InputError("no plan today")

    trial = hg.Trial(SCENE, hg.stack_of("fm"), 1, form=Broken())
    found = runs(1).of({"broken": trial, "fm": CELLS["fm"]})
    assert found["broken"][0].verdict == "error" and "no plan today" in found["broken"][0].why
    assert found["fm"][0].verdict == "not balanced"


def test_a_table_has_a_row_a_cell_with_shares_probes_and_medians():
    ends = [
        grid.End("good", 3, True, "", {"left": 1.0}),
        grid.End("good", 5, True, "", {"left": 3.0}),
        grid.End("lost", None, False, "", {"left": float("nan")}),
    ]
    head, row = grid.table({"cell": ends}, "left").splitlines()
    assert " ".join(head.split()) == "good [95 %] secure median p99 worst left failures"
    assert " ".join(row.split()) == "cell 2 of 3 [21%, 94%] 2 4 5 5 2 1 lost"
