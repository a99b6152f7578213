"""The command line of a scenario: one command in; a table, a file and a figure out."""

import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from hqp_grasp.control.controller import Controller
from hqp_grasp.errors import ReachError, SolverError
from hqp_grasp.experiments import start
from hqp_grasp.experiments.plots import convergence, convergence_figure
from hqp_grasp.experiments.scenario import (
    Settings,
    _physical,
    replay_command,
    run,
    summary,
    trial_of,
)
from hqp_grasp.experiments.study import Study
from hqp_grasp.experiments.trial import Trial
from hqp_grasp.world.scene import Prism, Scene

FLOOR = 1e-16

CYLINDER = Path(__file__).parents[2] / "scenarios" / "cylinder.py"
ROBOT = Path(__file__).parents[2] / "robots" / "wam_bhand"
TRIALS, PROBES = 2, 6
TINY = [
    "--stack",
    "fmk",
    "--trials",
    str(TRIALS),
    "--probes",
    str(PROBES),
    "--jobs",
    "1",
    "--seed",
    "2",
]


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


def test_no_trial_was_lost_and_no_limit_broken(ran):
    rows = pq.read_table(ran[0] / "probes.parquet").to_pylist()
    assert all(row["limit_violation"] == 0.0 for row in rows)
    assert all(row["in_contact"] for row in rows if row["probe"] == PROBES)


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


def judged(table):
    """The contract's count of good trials and of the others' kinds, written anew."""
    column = {name: np.array(table.column(name).to_pylist()) for name in table.column_names}
    force, moment = column["eps_f"].astype(float), column["eps_m"].astype(float)
    count = dict.fromkeys(("good", "error", "lost", "not balanced", "link inside", "violation"), 0)
    for trial in np.unique(column["trial"]):
        at = np.flatnonzero(column["trial"] == trial)
        at = at[np.argsort(column["probe"][at])]
        fine = (force[at] <= 1e-3) & (moment[at] <= 4e-6)
        faults = {
            "error": (column["error"][at] != None).any(),  # noqa: E711
            "lost": not column["in_contact"][at[-1]],
            "not balanced": not fine[-1],
            "link inside": (column["other_links"][at[1:]] != "").any(),
            "violation": (column["limit_violation"][at].astype(float) > 0.0).any(),
        }
        count[next((kind for kind, so in faults.items() if so), "good")] += 1
    return count


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
    kinds = judged(table)
    assert int(found(text, rf"good +(\d+) of {len(trials)} in every respect")) == kinds.pop("good")
    assert " · ".join(f"{kind} {count}" for kind, count in kinds.items()) in text
    methods = [row["method"] for row in rows if row["method"] is not None]
    for method in set(methods):
        share = 100 * methods.count(method) / len(methods)
        assert float(found(text, rf"methods.*{method} ([\d.]+)%")) == pytest.approx(share, abs=0.06)
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


def test_secure_trials_and_why_others_do_not_balance_are_told(ran):
    table = pq.read_table(ran[0] / "probes.parquet")
    said = summary(table)
    d = table.filter(pc.equal(table["probe"], PROBES))["friction_demand"].to_numpy()
    assert f"secure{(d <= 0.2).sum():9} of {TRIALS} at the end" in said
    assert f"the median holds if µ ≥ {np.median(d):.2f}" in said
    at = table.column_names.index("unbalanced")
    for why in (None, "walls lean"):
        column = pa.array([why] * len(table), pa.string())
        told = summary(table.set_column(at, "unbalanced", column))
        assert (f"not balanced, most often ({TRIALS}): walls lean" in told) is (why is not None)


@pytest.mark.parametrize("how", [{"noise": (0.02, 5e-4)}, {"probe": "physical"}])
def test_the_table_on_screen_judges_by_what_is_where_that_is_known(how, tmp_path, capsys):
    """It read what was felt: one trial under noise in three was good, and none was told."""
    settings = Settings(trials=2, probes=2, jobs=1, out=tmp_path / "out", **how)
    run("cylinder", Scene(), settings)
    assert summary(pq.read_table(tmp_path / "out" / "probes.parquet")) in capsys.readouterr().out


def test_a_lost_trial_is_counted_and_drawn(ran, tmp_path):
    table = with_a_lost_trial(pq.read_table(ran[0] / "probes.parquet"))
    check(table)
    assert "good          1 of 2 in every respect\n         error 0 · lost 1 · " in summary(table)
    convergence(table, "one lost", tmp_path / "figure.png")
    assert (tmp_path / "figure.png").is_file()


def spoilt(table, trial, probe, **values):
    """The same rows, one with other values."""
    rows = table.to_pylist()
    rows[trial * (PROBES + 1) + probe] |= values
    return pa.Table.from_pylist(rows, schema=table.schema)


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("violation", {"limit_violation": 1e-3}),
        ("link inside", {"other_links": "palm"}),
        ("not balanced", {"eps_f": 0.5, "other_links": "palm"}),
        ("not balanced", {"eps_m": 4.1e-6}),
        ("lost", {"in_contact": False, "eps_f": None, "eps_m": None, "limit_violation": 1.0}),
        ("error", {"in_contact": False, "eps_f": None, "eps_m": None, "error": "SolverError: x"}),
    ],
)
def test_each_kind_of_failure_is_counted_once_by_the_gravest_fault(ran, kind, values):
    table = spoilt(pq.read_table(ran[0] / "probes.parquet"), 1, PROBES, **values)
    assert judged(table) == {**dict.fromkeys(judged(table), 0), "good": 1, kind: 1}
    check(table)


def test_a_relapse_starts_the_count_of_probes_anew(ran):
    table = pq.read_table(ran[0] / "probes.parquet")
    before = first_for_good(table.to_pylist()[: PROBES + 1])
    table = spoilt(table, 0, 0, eps_f=0.0, eps_m=0.0)
    assert first_for_good(table.to_pylist()[: PROBES + 1]) == before > 1
    check(table)


def test_the_shares_of_the_methods_are_told_largest_first(ran):
    table = pq.read_table(ran[0] / "probes.parquet")
    table = spoilt(table, 0, 2, method="one row at a time")
    assert re.search(r"methods  \S+ [5-9].\.\d%, .*one row at a time 8\.3%", summary(table))
    check(table)


# ---------------------------------------------------------------- the figure


def drawn(axes):
    """The lines on some axes, their x and y."""
    return [(line.get_xdata(), line.get_ydata()) for line in axes.get_lines()]


def test_every_error_is_drawn_on_its_own_axes(ran):
    table = with_a_lost_trial(pq.read_table(ran[0] / "probes.parquet"))
    by_trial = {
        name: table.column(name).to_numpy().astype(float).reshape(TRIALS, -1)
        for name in ("eps_f", "eps_m", "eps_k", "adduction_deg", "elevation_deg")
    }
    left, middle, right = convergence_figure(table, "three panels").axes
    for axes, which, values in (
        (left, 0, by_trial["eps_f"]),
        (left, 1, 1e3 * np.sqrt(by_trial["eps_m"])),
        (middle, 0, by_trial["eps_k"]),
    ):
        probes, median = drawn(axes)[which]
        np.testing.assert_array_equal(probes, np.arange(PROBES + 1))
        np.testing.assert_allclose(median, np.maximum(np.nanmedian(values, axis=0), FLOOR))
    (start, end) = drawn(right)
    last = PROBES - 3  # of the lost trial
    for (x, y), at in ((start, [0, 0]), (end, [PROBES, last])):
        np.testing.assert_array_equal(x, by_trial["adduction_deg"][range(TRIALS), at])
        np.testing.assert_array_equal(y, by_trial["elevation_deg"][range(TRIALS), at])


def test_every_axis_says_what_it_shows_and_in_which_unit(ran):
    figure = convergence_figure(pq.read_table(ran[0] / "probes.parquet"), "three panels")
    left, middle, right = figure.axes
    assert figure.get_suptitle() == "three panels"
    assert [text.get_text() for text in left.get_legend().get_texts()] == [
        r"$\varepsilon_f$ [N²]",
        r"$\sqrt{\varepsilon_m}$ [mm·N]",
    ]
    assert left.get_xlabel() == middle.get_xlabel() == "probe" and left.get_yscale() == "log"
    assert middle.get_ylabel() == r"$\varepsilon_k$ [rad]" and middle.get_ylim()[0] == 0.0
    assert (right.get_xlabel(), right.get_ylabel()) == ("adduction [°]", "elevation [°]")
    assert [text.get_text() for text in right.get_legend().get_texts()] == ["start", "end"]


def test_the_band_around_the_median_spans_all_trials(ran):
    table = pq.read_table(ran[0] / "probes.parquet")
    angle = table.column("eps_k").to_numpy().reshape(TRIALS, -1)
    _, middle, _ = convergence_figure(table, "").axes
    (corners,) = (path.vertices for path in middle.collections[0].get_paths())
    for probe in range(PROBES + 1):
        at = corners[corners[:, 0] == probe, 1]
        felt = angle[np.isfinite(angle[:, probe]), probe]
        assert (at.min(), at.max()) == (felt.min(), felt.max())


def test_the_figure_leaves_matplotlibs_backend_to_its_user(ran, tmp_path):
    code = (
        "import matplotlib; matplotlib.use('svg');"
        "import hqp_grasp, sys; from pathlib import Path; import pyarrow.parquet as pq;"
        "from hqp_grasp.experiments.scenario import convergence;"
        f"convergence(pq.read_table({str(ran[0] / 'probes.parquet')!r}), '', Path('figure.png'));"
        "assert matplotlib.get_backend() == 'svg';"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path)
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")


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
    assert "f (force), m (moment), k (kinematic), a (align)" in said
    assert "{angle,eq7}" in said and "{hierarchy,memoryless,paper-hierarchy,clipped,paper}" in said
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
        (["--probes", "0"], ["probes must be at least 1"]),
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


# ---------------------------------------------------------------- failing trials


@pytest.fixture
def failing(monkeypatch):
    """Trial 1 ends in a SolverError at its first step."""
    begin, step, trial = Trial.begin, Controller.step, [0]

    def beginning(self, entropy, probe):
        trial[0] = entropy[-1]
        return begin(self, entropy, probe)

    def raising(self, history):
        if trial[0] == 1:
            raise SolverError("no method found an answer")
        return step(self, history)

    monkeypatch.setattr(Trial, "begin", beginning)
    monkeypatch.setattr(Controller, "step", raising)


def replayed(said):
    """Run the one command in `said` here, in this process."""
    (line,) = (line for line in said.splitlines() if line.startswith(sys.executable))
    python, option, code = shlex.split(line)
    assert (python, option) == (sys.executable, "-c")
    exec(code, {})


def test_a_failing_trial_is_counted_by_kind_and_its_replay_is_one_line(failing, tmp_path, capsys):
    call(*TINY, "--out", tmp_path, "--joint-cap", "0.3", "--seed", "2")
    said = capsys.readouterr().out
    assert "good          1 of 2 in every respect\n         error 1 · lost 0 · " in said
    assert "errors   SolverError 1\n" in said
    assert "replay trial 1, the first that ended in an error:" in said
    assert (tmp_path / "convergence.png").is_file()
    check(pq.read_table(tmp_path / "probes.parquet"))
    with pytest.raises(SolverError, match="no method found an answer"):
        replayed(said)


def test_the_replay_runs_exactly_that_trial(ran, capsys):
    settings = Settings(
        probes=2, joint_cap=0.2, stack="fm", trials=9, jobs=7, out=Path("x"), seed=3
    )
    scene = Scene(object=Prism.regular(6, 0.05))
    replayed(replay_command(scene, settings, 5))
    assert repr(trial_of(scene, settings).run((3, 5))) in capsys.readouterr().out
    assert not any(
        word in replay_command(scene, settings, 5) for word in ("jobs", "trials", "out=")
    )


def test_the_replay_is_a_command_that_the_shell_takes(failing, tmp_path):
    command = replay_command(Scene(robot=ROBOT), Settings(probes=1), 0)
    said = subprocess.run(command, shell=True, capture_output=True, text=True, check=True).stdout
    assert said.startswith("<Record of seed (0, 0): 2 rows")


def test_strict_stops_at_the_first_failing_trial_and_says_how_to_replay_it(failing, tmp_path):
    message = r"^cylinder: trial 1 of seed 2 ended by SolverError: no .*; replay it:\n"
    with pytest.raises(SystemExit, match=message) as exit_:
        call(*TINY, "--out", tmp_path, "--strict")
    assert pq.read_table(tmp_path / "probes.parquet").num_rows == 2 * (PROBES + 1)
    with pytest.raises(SolverError):
        replayed(exit_.value.code)


def test_where_every_trial_fails_that_is_said_and_the_status_is_not_zero(monkeypatch, tmp_path):
    def broken(*_):
        raise SolverError("no answer")

    monkeypatch.setattr(start.Start, "draw", broken)
    message = (
        r"^cylinder: every trial ended in an error, trial 0 by SolverError: no answer; "
        r"replay it:\n"
    )
    with pytest.raises(SystemExit, match=message) as exit_:
        call(*TINY, "--out", tmp_path)
    errors = pq.read_table(tmp_path / "probes.parquet").column("error")
    assert errors.null_count == 0
    assert not (tmp_path / "convergence.png").exists()
    with pytest.raises(SolverError):
        replayed(exit_.value.code)


def test_where_no_start_is_found_that_is_said_after_the_first_trial(monkeypatch, tmp_path):
    def out_of_reach(*_):
        raise ReachError("the object is out of reach; move it")

    monkeypatch.setattr(start.Start, "draw", out_of_reach)
    message = (
        r"^cylinder: trial 0 of seed 2 ended by ReachError: the object is out of reach; move it; "
        r"no other trial is run; replay it:\n"
    )
    with pytest.raises(SystemExit, match=message) as exit_:
        call(*TINY, "--out", tmp_path)
    rows = pq.read_table(tmp_path / "probes.parquet")
    assert rows.num_rows == PROBES + 1 and rows["error"].null_count == 0
    with pytest.raises(ReachError):
        replayed(exit_.value.code)


def test_an_interrupt_says_that_the_same_command_continues(monkeypatch, tmp_path):
    def interrupted(self, out, columns):
        raise KeyboardInterrupt

    monkeypatch.setattr(Study, "run", interrupted)
    with pytest.raises(SystemExit, match="the same command continues"):
        call(*TINY, "--out", tmp_path)


def test_what_a_simulated_hand_adds_is_told_at_the_end_and_at_its_most():
    nan = np.nan
    shaped = {
        "eps_f_true": [[9.0, 4e-4], [9.0, 2e-4], [9.0, nan]],
        "eps_m_true": [[9.0, 1e-6], [9.0, 9e-6], [9.0, nan]],
        "friction_demand_true": [[nan, nan]] * 3,
        "floor_f": [[7.0, 1e-5], [7.0, 3e-5], [7.0, nan]],
        "floor_m": [[7.0, 4e-8], [7.0, 4e-8], [7.0, nan]],
        "object_moved": [[0.0, 1e-3], [0.0, 3e-3], [0.0, 2e-3]],
        "peak_force": [[1.0, 2.25], [3.5, 1.0], [nan, 0.5]],
        "peak_speed": [[0.2, 0.81], [0.3, 0.1], [nan, 0.5]],
        "peak_torque": [[0.2, 0.31], [0.424, 0.1], [nan, 0.4]],
    }
    shaped = {name: np.array(values) for name, values in shaped.items()}
    columns = {name: values.ravel() for name, values in shaped.items()}
    assert _physical(columns, shaped) == [
        "true     ε_f 3.0e-04 N², √ε_m 2.24 mm·N at the end, medians",
        "floor    ε_f 2.0e-05 N², √ε_m 0.20 mm·N: what noise makes of balance",
        "hand     at most 3.50 N at a fingertip, 81% of a joint's speed limit, "
        "42% of its torque limit",
        "         the object moved by 2.00 mm in the median",
    ]
    fixed = shaped | {"object_moved": np.zeros((3, 2))}
    assert [line.split()[0] for line in _physical(columns, fixed)] == ["true", "floor", "hand"]
    assert _physical({"eps_f": columns["eps_f_true"]}, shaped) == []


def test_starts_and_ends_are_told_by_their_medians_means_and_worst(ran):
    table = pq.read_table(ran[0] / "probes.parquet")
    rows = {line[:22].strip(): line[22:] for line in summary(table).splitlines()}
    for label, name, form in (
        ("net force², N²", "eps_f", lambda v: f"{np.median(v):.2e} (≤ {v.max():.2e})"),
        ("flexion angle, rad", "eps_k", lambda v: f"{v.mean():.3f} ± {v.std():.3f}"),
        ("elevation, °", "elevation_deg", lambda v: f"{v.mean():.2f} ± {v.std():.2f}"),
    ):
        values = table[name].to_numpy().reshape(TRIALS, -1)
        told = [rows[label][:22].strip(), rows[label][22:].strip()]
        assert told == [form(values[:, 0]), form(values[:, -1])]
    moment = 1e3 * np.sqrt(table["eps_m"].to_numpy().reshape(TRIALS, -1)[:, 0])
    assert f"{np.median(moment):.2e} (≤ {moment.max():.2e})" in rows["net moment, mm·N"]
