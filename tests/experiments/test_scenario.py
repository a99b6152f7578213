"""The command line of a scenario: one command in; a table, a file and a figure out."""

import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hqp_grasp.experiments import start
from hqp_grasp.experiments.plots import convergence
from hqp_grasp.experiments.scenario import summary
from hqp_grasp.experiments.study import Study

CYLINDER = Path(__file__).parents[2] / "scenarios" / "cylinder.py"
TRIALS, PROBES = 2, 6
TINY = ["--stack", "fmk", "--trials", str(TRIALS), "--probes", str(PROBES), "--jobs", "1"]


def call(*arguments):
    """Run the scenario as a script, in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [str(CYLINDER), *map(str, arguments)])
        runpy.run_path(str(CYLINDER), run_name="__main__")


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """The command as a newcomer types it, from some other folder: its folder and its output."""
    here = tmp_path_factory.mktemp("scenario")
    done = subprocess.run(
        [sys.executable, str(CYLINDER), *TINY, "--out", "results"],
        cwd=here,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return here / "results", done.stdout


# ---------------------------------------------------------------- the run


def test_a_run_writes_its_rows_and_its_figure(ran):
    out, _ = ran
    table = pq.read_table(out / "probes.parquet")
    assert table.num_rows == TRIALS * (PROBES + 1)
    assert (out / "convergence.png").read_bytes().startswith(b"\x89PNG")
    assert not list(out.rglob("*.part*.png"))


def test_a_run_says_what_it_does_and_where_the_results_are(ran):
    out, said = ran
    assert said.startswith(f"cylinder: force ▷ moment ▷ kinematic, {TRIALS} trials of {PROBES}")
    for path in ("results/probes.parquet", "results/convergence.png"):
        assert path in said and (out.parent / path).is_file()


def test_the_table_on_screen_is_the_summary_of_the_rows(ran):
    out, said = ran
    assert summary(pq.read_table(out / "probes.parquet")) in said


def test_no_contact_was_lost_and_no_limit_broken(ran):
    rows = pq.read_table(ran[0] / "probes.parquet").to_pylist()
    assert all(row["in_contact"] and row["limit_violation"] == 0.0 for row in rows)


# ---------------------------------------------------------------- the summary


def found(text, pattern):
    match = re.search(pattern, text)
    assert match, (pattern, text)
    return match.group(1)


def first_for_good(rows):
    """The probe from which force and moment stay within the documented bounds, or None."""
    first = None
    for row in rows:
        good = row["in_contact"] and row["eps_f"] <= 1e-3 and row["eps_m"] <= 2e-3**2
        if good and first is None:
            first = row["probe"]
        if not good:
            first = None
    return first


def check(table):
    """Every number of the summary, from the rows one by one."""
    text, rows = summary(table), table.to_pylist()
    trials = {}
    for row in rows:
        trials.setdefault(row["trial"], []).append(row)
    firsts = [first_for_good(trial) for trial in trials.values()]
    firsts = [first for first in firsts if first is not None]
    held = [trial for trial in trials.values() if trial[-1]["in_contact"]]
    assert int(found(text, r"converged +(\d+) of")) == len(firsts)
    if firsts:
        assert float(found(text, r"after ([\d.]+) probes")) == np.median(firsts)
        assert int(found(text, r"\(worst (\d+)\)")) == max(firsts)
    assert int(found(text, r"lost +(\d+) of")) == len(trials) - len(held)
    steps = [row for row in rows if row["step_share"] is not None]
    active = sum(row["limit_active"] for row in steps) / len(steps)
    assert int(found(text, r"active in (\d+)% of the steps")) == round(100 * active)
    worst = max(row["limit_violation"] for row in rows)
    assert float(found(text, r"largest violation (\S+) rad")) == pytest.approx(worst, rel=1e-5)
    gaps = [row["hqp_projection_gap"] for row in rows if row["hqp_projection_gap"] is not None]
    if gaps:
        said = found(text, r"projection ≤ (\S+) rad")
        assert float(said) == pytest.approx(max(gaps), rel=0.06)
        share = round(100 * len(gaps) / len(steps))
        assert int(found(text, r"over (\d+)% of steps")) == share
    start_force = np.median([trial[0]["eps_f"] for trial in trials.values()])
    assert float(found(text, r"net force², N² +(\S+) \(≤")) == pytest.approx(start_force, rel=1e-2)
    if held:
        end = [trial[-1]["adduction_deg"] for trial in held]
        mean, spread = re.search(r"adduction.* (\S+) ± (\S+)\n", text).groups()
        assert float(mean) == pytest.approx(np.mean(end), abs=0.006)
        assert float(spread) == pytest.approx(np.std(end), abs=0.006)
    rejected = sum(trial[0]["rejected"] for trial in trials.values())
    assert int(found(text, r"rejected (\d+) draws")) == rejected


def with_a_lost_trial(table):
    """The same rows, the last trial lost at its fourth probe."""
    rows = table.to_pylist()
    for row in rows[-3:]:
        for name in ("eps_f", "eps_m", "eps_k", "eps_k_eq7", "adduction_deg", "elevation_deg"):
            row[name] = None
        row |= {"in_contact": False, "hqp_projection_gap": None, "limit_active": False}
    for row in rows[-2:]:
        row |= {"step_share": None, "solve_us": None, "outcome": None, "other_links": ""}
    return pa.Table.from_pylist(rows, schema=table.schema)


def test_the_summarys_numbers_are_those_of_the_rows(ran):
    check(pq.read_table(ran[0] / "probes.parquet"))


def test_a_lost_trial_is_counted_and_drawn(ran, tmp_path):
    table = with_a_lost_trial(pq.read_table(ran[0] / "probes.parquet"))
    check(table)
    assert "lost          1 of 2" in summary(table)
    convergence(table, "one lost", tmp_path / "figure.png")
    assert (tmp_path / "figure.png").is_file()


def test_with_every_trial_lost_there_still_is_a_summary_and_a_figure(ran, tmp_path):
    table = with_a_lost_trial(pq.read_table(ran[0] / "probes.parquet").slice(PROBES + 1))
    check(table)
    convergence(table, "all lost", tmp_path / "figure.png")


def test_a_robot_without_adduction_has_a_summary_and_a_figure_too(ran, tmp_path):
    rows = pq.read_table(ran[0] / "probes.parquet")
    at = rows.schema.get_field_index("adduction_deg")
    table = rows.set_column(at, rows.schema.field(at), pa.nulls(rows.num_rows, pa.float64()))
    assert re.search(r"adduction, ° +– +–\n", summary(table))
    convergence(table, "no adduction", tmp_path / "figure.png")


# ---------------------------------------------------------------- help and mistakes


def test_help_teaches_every_option_with_its_unit_or_choices(capsys):
    with pytest.raises(SystemExit) as exit_:
        call("--help")
    assert exit_.value.code == 0
    said = " ".join(re.sub(r"[│╭╮╰╯─]", " ", capsys.readouterr().out).split())
    for option in ("stack", "trials", "probes", "seed", "jobs", "out", "form", "solver", "landing"):
        assert re.search(rf"--{option}[ ,]", said)
    assert "f (force), m (moment), k (kinematic)" in said
    assert "{angle,eq7}" in said and "{hierarchy,paper-hierarchy,clipped,paper}" in said
    assert "[rad]" in said and "[m]" in said
    assert "(default: fmk)" in said and "(default: 40)" in said
    assert "grasps Cylinder(radius=0.05" in said


@pytest.mark.parametrize(
    ("arguments", "choices"),
    [
        (["--stack", "fz"], ["'fz'", "f (force)", "m (moment)", "k (kinematic)"]),
        (["--stack", "ff"], ["'ff'", "each law once"]),
        (["--stack", ""], ["f (force)"]),
        (["--solver", "simplex"], ["'simplex'", "proxqp", "daqp"]),
        (["--trials", "0"], ["trials", "at least 1"]),
        (["--probes", "0"], ["at least 1 probe"]),
        (["--seed", "-1"], ["seed", "at least 0"]),
        (["--joint-cap", "-1"], ["StepLimit.joint", "above 0"]),
        (["--contact-cap", "nan"], ["StepLimit.contact", "above 0"]),
    ],
)
def test_a_mistake_is_answered_in_one_line_before_any_work(tmp_path, capsys, arguments, choices):
    out = tmp_path / "results"
    with pytest.raises(SystemExit) as exit_:
        call(*TINY, "--out", out, *arguments)
    said = str(exit_.value.code)  # a text is printed as it is, and the exit status is then 1
    assert said.startswith("cylinder: ") and "\n" not in said
    assert all(choice in said for choice in choices)
    assert capsys.readouterr().out == ""
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "choices"),
    [
        (["--kinematic-error", "eq9"], ["eq9", "angle", "eq7"]),
        (["--form", "hqp"], ["hqp", "hierarchy", "clipped", "paper"]),
        (["--links", "stop"], ["stop", "pass", "block"]),
        (["--trials", "many"], ["many", "--trials"]),
        (["--steps", "3"], ["--steps"]),
    ],
)
def test_a_wrong_choice_is_answered_with_the_valid_ones(tmp_path, capsys, arguments, choices):
    out = tmp_path / "results"
    with pytest.raises(SystemExit) as exit_:
        call(*TINY, "--out", out, *arguments)
    assert exit_.value.code not in (0, None)
    said = "".join(capsys.readouterr())
    assert all(choice in said for choice in choices)
    assert not out.exists()


def test_a_folder_that_cannot_be_written_is_said_in_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SystemExit, match=r"^cylinder: \S+ cannot be written"):
        call(*TINY, "--out", tmp_path / "file")


def test_a_folder_of_other_settings_is_said_in_one_line(ran):
    with pytest.raises(SystemExit, match=r"^cylinder: \S+ belongs to another configuration"):
        call(*TINY, "--out", ran[0], "--seed", "5")


def test_an_object_out_of_reach_is_said_in_one_line(monkeypatch, tmp_path):
    monkeypatch.setattr(start, "_reach", lambda *_: None)
    with pytest.raises(SystemExit, match=r"^cylinder: wam_bhand touches the object .* from none"):
        call(*TINY, "--out", tmp_path)


def test_an_interrupt_says_that_the_same_command_continues(monkeypatch, tmp_path):
    def interrupted(self, out):
        raise KeyboardInterrupt

    monkeypatch.setattr(Study, "run", interrupted)
    with pytest.raises(SystemExit, match="the same command continues"):
        call(*TINY, "--out", tmp_path)
